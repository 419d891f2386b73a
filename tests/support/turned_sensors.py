"""Sensors at rest in several orientations, simulated in NumPy from (2.22) and (2.23), without allanjax."""

from typing import NamedTuple

import numpy as np

G = 9.8118
EARTH_RATE_DEG_H = 15.041067
#: The six positions: which axis points up or down, and the upward direction.
SIX = {
    f"{a} {way}": s * np.eye(3)[i] for i, a in enumerate("xyz") for way, s in (("up", 1.0), ("down", -1.0))
}


class Errors(NamedTuple):
    """Scale factors and non-orthogonality S + N (3 × 3), biases, and second-order scale factors, SI."""

    SN: np.ndarray
    b: np.ndarray
    S2: np.ndarray

    def readings(self, f: np.ndarray) -> np.ndarray:
        """I = f + b + S·f + N·f + S2·f² (2.23), of inputs in rows."""
        return f + self.b + f @ self.SN.T + self.S2 * f**2


ERRORS = Errors(
    SN=1e-6 * np.array([[1200.0, 350.0, -240.0], [110.0, -640.0, 420.0], [-70.0, 90.0, 800.0]]),
    b=np.array([0.012, -0.021, 0.033]),
    S2=np.zeros(3),
)


def white_noise(rng: np.random.Generator, n: int, N: float, rate: float) -> np.ndarray:
    """Samples of white noise of density N², three axes side by side."""
    return N * np.sqrt(rate) * rng.standard_normal((n, 3))


def random_walk(rng: np.random.Generator, n: int, K: float, rate: float) -> np.ndarray:
    """Samples of a random walk of K [per √s], three axes side by side."""
    return np.cumsum(K / np.sqrt(rate) * rng.standard_normal((n, 3)), axis=0)


def markov_noise(rng: np.random.Generator, n: int, sigma: float, time: float, rate: float) -> np.ndarray:
    """Samples of a first-order Gauss–Markov process of this standard deviation, stationary; three axes."""
    from scipy.signal import lfilter

    a = np.exp(-1.0 / (rate * time))
    draws = sigma * np.sqrt(1.0 - a**2) * rng.standard_normal((n, 3))
    draws[0] /= np.sqrt(1.0 - a**2)
    return lfilter([1.0], [1.0, -a], draws, axis=0)

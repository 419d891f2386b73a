"""Known noise: records, covariances and the Cramér-Rao bound, in NumPy and independent of the package.

Coefficients go by the symbols Q, N, B, q (Markov, with its correlation time T), K, R (ramp) and A (line, with
its frequency f). Amplitudes are in units of N, times in seconds.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.fft import dct
from scipy.linalg import cho_factor, cho_solve
from scipy.signal import lfilter

RATE = 100.0
T0 = 1.0 / RATE
FULL_BLOCK = 128

SHOWN = {"q": "q_c", "T": "T_c"}
SHAPES = "Tf"
DETERMINISTIC = "RAf"


@dataclass(frozen=True)
class Case:
    """A true model: coefficients by symbol (T is the Markov correlation time), in units of N and s.

    For `simulate` they may be arrays with a value for each record.
    """

    name: str
    truth: dict[str, float]

    @property
    def amplitudes(self) -> list[str]:
        return [c for c in self.truth if c not in SHAPES]

    @property
    def random(self) -> dict[str, float]:
        """The coefficients of the covariance."""
        return {c: v for c, v in self.truth.items() if c not in DETERMINISTIC}


# --- The noise: covariances, Allan variances and records ---------------------------------------------------


def covariance_shape(symbol: str, n: int, correlation_time: float) -> np.ndarray:
    """Generalized covariance H(k) of the rate at lags 0 ... n-1 samples, unit coefficient, averaged samples.

    cov(Σ a_p x_p, Σ b_q x_q) = Σ Σ a_p b_q H(p - q) for all filters a, b without response to a constant.
    """
    k = np.arange(n, dtype=float)
    H = np.zeros(n)
    if symbol == "Q":
        H[:2] = 2.0 * RATE**2, -(RATE**2)
    elif symbol == "N":
        H[0] = RATE
    elif symbol == "K":
        H = -k * T0 / 2.0
        H[0] = -T0 / 6.0
    elif symbol == "B":
        # -(1/2π) times the second difference of k² ln k.
        far = k[2:]
        growing = (far + 1.0) ** 2 * np.log1p(1.0 / far) + (far - 1.0) ** 2 * np.log1p(-1.0 / far)
        H[2:] = -(2.0 * np.log(far) + growing) / (2.0 * np.pi)
        H[1] = -4.0 * np.log(2.0) / (2.0 * np.pi)
    elif symbol == "q":
        x = T0 / correlation_time
        H = np.expm1(-x) ** 2 * np.exp(-(k - 1.0) * x)
        H[0] = 2.0 * (x + np.expm1(-x))
        H *= correlation_time / 2.0 / x**2
    return H


def allan_shape(symbol: str, T: np.ndarray, correlation_time: float = 1.0) -> np.ndarray:
    """Allan variance with unit coefficient (Hou 2004, 4.29 to 4.60)."""
    x = T / correlation_time
    return {
        "Q": 3.0 / T**2,
        "N": 1.0 / T,
        "B": np.full_like(T, 2.0 * np.log(2.0) / np.pi),
        "K": T / 3.0,
        "q": correlation_time**2 / T * (1.0 - (3.0 - 4.0 * np.exp(-x) + np.exp(-2.0 * x)) / (2.0 * x)),
    }[symbol]


def simulate(case: Case, n: int, records: int, rng: np.random.Generator) -> np.ndarray:
    """Records [n, records]: samples are means over their intervals, all terms exact in law.

    (Markov but for terms of order (t0/T_c)² in the scatter of the mean between two states.) A is the
    amplitude that the samples of a line show; its phase is random.
    """
    x = np.zeros((n, records))
    for symbol in case.amplitudes:
        c = np.asarray(case.truth[symbol], float)
        if symbol == "N":
            x += c * np.sqrt(RATE) * rng.standard_normal((n, records))
        elif symbol == "Q":
            x += c * RATE * np.diff(rng.standard_normal((n + 1, records)), axis=0)
        elif symbol == "K":
            # The mean of a Brownian path between two ends: their mean, and the area of the bridge.
            step = rng.standard_normal((n, records)) * np.sqrt(T0)
            bridge = rng.standard_normal((n, records)) * np.sqrt(T0 / 12.0)
            x += c * (np.cumsum(step, axis=0) - step / 2.0 + bridge)
        elif symbol == "q":
            T = np.broadcast_to(np.asarray(case.truth["T"], float), records)
            decay = np.exp(-T0 / T)
            drive = c * np.sqrt(T / 2.0) * np.sqrt(1.0 - decay**2) * rng.standard_normal((n + 1, records))
            drive[0] /= np.sqrt(1.0 - decay**2)
            state = np.stack([lfilter([1.0], [1.0, -a], d) for a, d in zip(decay, drive.T, strict=True)], 1)
            x += (state[1:] + state[:-1]) / 2.0
            x += c * np.sqrt(T0 / 12.0) * rng.standard_normal((n, records))
        elif symbol == "B":
            # Increments by circulant embedding (Davies & Harte 1987).
            H = covariance_shape("B", n + 2, 1.0)
            H = np.concatenate([H[1:2], H])
            gamma = 2.0 * H[1:-1] - H[2:] - H[:-2]
            power = np.fft.rfft(np.concatenate([gamma, gamma[-2:0:-1]])).real
            assert power.min() > -1e-9 * power.max()
            size = 2 * (len(gamma) - 1)
            noise = np.fft.rfft(rng.standard_normal((size, records)), axis=0)
            increments = np.fft.irfft(np.sqrt(np.maximum(power, 0.0))[:, None] * noise, size, axis=0)
            x += c * np.cumsum(increments[:n], axis=0)
        elif symbol == "R":
            x += c * (np.arange(n)[:, None] + 0.5) * T0
        elif symbol == "A":
            cycles = np.asarray(case.truth["f"], float) * T0 * np.arange(n)[:, None]
            x += c * np.cos(2.0 * np.pi * (cycles + rng.uniform(size=records)))
    return x


# --- The Cramér-Rao bound ----------------------------------------------------------------------------------


def _combined(case: Case, shape: Callable[[str, float], np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Anything linear in H: of the whole record, and its derivatives by the covariance's coefficients."""
    Tc = case.truth.get("T", 1.0)
    shapes = {c: shape(c, Tc) for c in case.random if c not in SHAPES}
    total = sum(case.truth[c] ** 2 * shapes[c] for c in shapes)
    by = []
    for c in case.random:
        if c == "T":
            h = 1e-4 * Tc
            by.append(case.truth["q"] ** 2 * (shape("q", Tc + h) - shape("q", Tc - h)) / (2.0 * h))
        else:
            by.append(2.0 * case.truth[c] * shapes[c])
    return total, np.array(by)


def mean_derivatives(case: Case, n: int) -> np.ndarray:
    """Derivatives [params, n] of the mean by ramp, amplitude and frequency of the line, and its phase.

    The bound depends on the phase as little as the line has few cycles; it is taken as one radian.
    """
    t = (np.arange(n) + 0.5) * T0
    rows = []
    for c in case.truth:
        if c == "R":
            rows.append(t)
        elif c == "A":
            angle = 2.0 * np.pi * case.truth["f"] * t + 1.0
            by_phase = -case.truth["A"] * np.sin(angle)
            rows += [np.cos(angle), 2.0 * np.pi * t * by_phase, by_phase]
    return np.array(rows).reshape(-1, n)


def bound(case: Case, n: int, block: int = FULL_BLOCK) -> np.ndarray:
    """Cramér-Rao standard deviations from ½ tr(C⁻¹C_i C⁻¹C_j) + m_i'C⁻¹m_j of the record without its mean.

    In the basis of cosines (DCT-II without its constant), where long records are simple.
    Cosines have no response to a constant rate, so the unknown bias is profiled out, and unlike the Fourier
    basis of the differenced record they leak little: random walk plus white noise is diagonal in them but for
    the averaging. The lowest `block` coefficients are taken with their full covariance, the others as if
    independent, with their exact variances: of n it is the exact bound.
    """
    block = min(block, n - 1)
    S, S_by = _combined(case, lambda symbol, T: _variances_of(symbol, n, T))
    S, S_by = S[block:], S_by[:, block:]
    m = dct(mean_derivatives(case, n), norm="ortho", axis=1)[:, 1:]
    of_mean = (m[:, block:] / S) @ m[:, block:].T
    information = 0.5 * (S_by / S) @ (S_by / S).T
    if block:
        low, low_by = _combined(case, lambda symbol, T: _block_of(symbol, n, T, block))
        factor = cho_factor(low)
        information += _information([cho_solve(factor, d) for d in low_by])
        of_mean += m[:, :block] @ cho_solve(factor, m[:, :block].T)
    return _in_order(case, information, of_mean)


def _in_order(case: Case, of_covariance: np.ndarray, of_mean: np.ndarray) -> np.ndarray:
    """Standard deviations in the order of the coefficients: the two informations have nothing in common."""
    std = dict(zip(case.random, np.sqrt(np.diag(np.linalg.inv(of_covariance))), strict=True))
    deterministic = [c for c in case.truth if c in DETERMINISTIC]
    if deterministic:
        # The phase is last, and nobody's coefficient.
        std |= dict(zip(deterministic, np.sqrt(np.diag(np.linalg.inv(of_mean))), strict=False))
    return np.array([std[c] for c in case.truth])


def _information(products: list[np.ndarray]) -> np.ndarray:
    return np.array([[0.5 * np.sum(a * b.T) for b in products] for a in products])


@lru_cache(maxsize=16)
def _variances_of(symbol: str, n: int, correlation_time: float) -> np.ndarray:
    return cosine_variances(covariance_shape(symbol, n, correlation_time))


@lru_cache(maxsize=16)
def _block_of(symbol: str, n: int, correlation_time: float, block: int) -> np.ndarray:
    return _cosine_block(covariance_shape(symbol, n, correlation_time), block)


def _cosine_block(H: np.ndarray, block: int) -> np.ndarray:
    """Covariance of the cosine coefficients 1 ... block."""
    n = len(H)
    circle = np.fft.rfft(np.concatenate([H, [0.0], H[:0:-1]]))
    j = np.arange(1, block + 1)[:, None]
    A = np.sqrt(2.0 / n) * np.cos(np.pi * j * (np.arange(n) + 0.5) / n)
    product = np.empty((block, block))
    for i in range(0, block, 128):
        rows = np.fft.irfft(np.fft.rfft(A[i : i + 128], 2 * n, axis=1) * circle, 2 * n, axis=1)[:, :n]
        product[i : i + 128] = rows @ A.T
    return (product + product.T) / 2.0


def cosine_variances(H: np.ndarray) -> np.ndarray:
    """Variances of the cosine coefficients 1 ... n-1: Σ_k H(k) times their autocorrelation, by FFT."""
    n = len(H)
    k = np.arange(n)
    even = np.fft.rfft((1.0 - k / n) * H, 2 * n).real[1:n]
    odd = -np.fft.rfft(H, 2 * n).imag[1:n]
    return 2.0 * even - H[0] - 2.0 * odd / (n * np.sin(np.pi * k[1:] / n))


# Scenarios are written for so many samples. Longer records have their noise stretched along with them, so
# that every term stays as well seen as it was.
_LENGTH = 1 << 14
# A stretch by s of all times but the sample interval multiplies a coefficient by s to this power.
_STRETCH = {"Q": 0.0, "N": 0.0, "B": -0.5, "q": -1.0, "K": -1.0, "R": -1.5, "A": -0.5, "T": 1.0, "f": 0.0}
# Frequencies of lines are uniform [Hz].
LINE_BAND = (0.05 * RATE, 0.4 * RATE)


@dataclass(frozen=True)
class Scenario:
    """A set of terms, and the middle (geometric mean) of each coefficient's range at 2¹⁴ samples."""

    name: str
    middle: dict[str, float]
    factor: float = 3.0

    def ranges(self, n: int) -> dict[str, tuple[float, float]]:
        """Least and largest value of each coefficient in records of n samples."""
        half = np.sqrt(self.factor)
        found = {}
        for c, value in self.middle.items():
            value *= (n / _LENGTH) ** _STRETCH[c]
            found[c] = LINE_BAND if c == "f" else (value / half, value * half)
        return found

    def as_case(self) -> Case:
        """The middle of all ranges, at 2¹⁴ samples."""
        return Case(self.name, self.middle)

    def draw(
        self, n: int, records: int, rng: np.random.Generator, strength: tuple[float, float] = (1.0, 1.0)
    ) -> Case:
        """Coefficients for so many records: frequencies uniform, others log-uniform.

        Amplitudes but that of white noise are multiplied by a strength, one for each record, drawn between
        these log-uniformly.
        """
        truth = {}
        for c, (low, high) in self.ranges(n).items():
            u = rng.uniform(size=records)
            truth[c] = low + u * (high - low) if c == "f" else low * (high / low) ** u
        if strength != (1.0, 1.0):
            weaker = strength[0] * (strength[1] / strength[0]) ** rng.uniform(size=records)
            truth = {c: v if c in ("N", *SHAPES) else v * weaker for c, v in truth.items()}
        return Case(self.name, truth)


def one(case: Case, k: int) -> Case:
    """The k-th record's truth."""
    return Case(case.name, {c: float(v[k]) for c, v in case.truth.items()})


SCENARIOS = {
    s.name: s
    for s in (
        Scenario("N", {"N": 1.0}),
        Scenario("N+K", {"N": 1.0, "K": 2.0}),
        Scenario("Q+N+K", {"Q": 0.1, "N": 1.0, "K": 2.0}),
        Scenario("N+B", {"N": 1.0, "B": 2.0}),
        Scenario("N+B+K", {"N": 1.0, "B": 4.0, "K": 5.0}),
        Scenario("N+Markov", {"N": 1.0, "q": 40.0, "T": 0.1}),
        Scenario("N+Markov+K", {"N": 1.0, "q": 40.0, "T": 0.1, "K": 6.0}),
        Scenario("N+K+R", {"N": 1.0, "K": 2.0, "R": 2.5}),
        Scenario("Q+N+B+K+R", {"Q": 0.1, "N": 1.0, "B": 5.0, "K": 5.0, "R": 6.0}, factor=2.0),
        Scenario("N+sinusoid", {"N": 1.0, "A": 3.0, "f": 1.0}),
    )
}

"""Phase covariances G of unit coefficients as theory has them, and what follows from them by dense matrices.

G(t) of the running integral of the rate is known up to a constant and a multiple of t², which no difference
of cluster averages sees. Nothing here is taken from the package.
"""

from collections.abc import Callable, Sequence

import numpy as np
from scipy.linalg import toeplitz

Law = Callable[[np.ndarray], np.ndarray]


def _flicker(t: np.ndarray) -> np.ndarray:
    return t**2 * np.log(np.where(t > 0.0, t, 1.0)) / (2.0 * np.pi)


def markov(T_c: float) -> Law:
    """Noise of density q_c = 1 behind a low-pass of this correlation time (4.60)."""
    return lambda t: -(T_c**3) / 2.0 * (np.expm1(-t / T_c) + t / T_c)


#: Laws with all coefficients 1: (4.29), (4.33), (4.38), (4.52), and the ramp (4.56), whose products repeat.
LAWS: dict[str, Law] = {
    "quantization": lambda t: 1.0 * (t == 0.0),
    "white": lambda t: -t / 2.0,
    "flicker": _flicker,
    "walk": lambda t: t**3 / 12.0,
    "ramp": lambda t: t**4 / 24.0,
}


def mixed(*parts: tuple[float, Law]) -> Law:
    """Law of independent noises with these coefficients."""
    return lambda t: sum(c**2 * law(t) for c, law in parts)  # type: ignore[return-value]


def autocovariance(law: Law, n: int, rate: float) -> np.ndarray:
    """Of means over sample intervals at lags 0 … n−1, −δ²G/h²; right for filters that sum to zero."""
    g = law(np.arange(n + 1) / rate)
    g = np.append(g[1], g)
    return -(g[2:] - 2.0 * g[1:-1] + g[:-2]) * rate**2


def dense(law: Law, n: int, rate: float) -> np.ndarray:
    """Covariance of n samples."""
    return toeplitz(autocovariance(law, n, rate))


# Weights of phases in a second difference.
_SECOND = np.array([1.0, -2.0, 1.0])


def allan_filter(m: int) -> np.ndarray:
    """Weights of samples in the difference of two adjacent cluster averages."""
    return np.repeat([-1.0, 1.0], m) / m


def allan_variance(law: Law, n: int, rate: float, sizes: Sequence[int]) -> np.ndarray:
    """Expected Allan variances."""
    R = autocovariance(law, n, rate)
    return np.array([_product(allan_filter(m), R) / 2.0 for m in sizes])


def _product(w: np.ndarray, R: np.ndarray) -> float:
    lags = np.correlate(w, w, "full")[len(w) - 1 :]
    return lags[0] * R[0] + 2.0 * lags[1:] @ R[1 : len(lags)]


def allan_covariance(
    law: Law, n: int, rate: float, sizes: Sequence[int], strides: Sequence[int], repeated: Law | None = None
) -> np.ndarray:
    """Covariance of Allan variances, pair of differences by pair: mean of 2(C² − C_repeated²)/4."""
    G, G_repeated = (np.zeros(n + 1) if g is None else g(np.arange(n + 1) / rate) for g in (law, repeated))
    s = np.arange(1 - n, n)
    starts = [
        (np.arange(n) % stride == 0) & (np.arange(n) <= n - 2 * m)
        for m, stride in zip(sizes, strides, strict=True)
    ]
    V = np.empty((len(sizes), len(sizes)))
    for i, mi in enumerate(sizes):
        for j, mj in enumerate(sizes[: i + 1]):
            pairs = np.correlate(starts[i].astype(float), starts[j].astype(float), "full")
            used = pairs > 0
            lag = abs(s[used] + np.arange(3)[:, None, None] * mi - np.arange(3)[:, None] * mj)
            C, C_repeated = (np.einsum("p,q,pqs->s", *(_SECOND,) * 2, g[lag]) for g in (G, G_repeated))
            scale = 4.0 * (mi * mj / rate**2) ** 2 * pairs.sum()
            V[i, j] = V[j, i] = 2.0 * pairs[used] @ (C**2 - C_repeated**2) / scale
    return V

"""Records of white noise and a random walk from NumPy alone, many at once as the axes of one recording."""

from collections.abc import Sequence

import numpy as np

import allanjax as aj

RATE = 100.0
N = 2048


def walk(K: float, shape: tuple[int, int], rng: np.random.Generator) -> np.ndarray:
    """Means of a random walk over sample intervals: middle of two ends, and the bridge between them."""
    steps = rng.standard_normal(shape) / np.sqrt(RATE)
    bridge = rng.standard_normal(shape) / np.sqrt(12.0 * RATE)
    return K * (np.cumsum(steps, axis=0) - steps / 2.0 + bridge)


def records(N_coefficient: float, K: float, count: int, seed: int, n: int = N) -> aj.Recording:
    """A recording whose axes are independent records."""
    rng = np.random.default_rng(seed)
    values = N_coefficient * np.sqrt(RATE) * rng.standard_normal((n, count)) + walk(K, (n, count), rng)
    axes = tuple(aj.Axis(f"gyro_{k}", "gyro", "rad/s") for k in range(count))
    return aj.Recording(values, RATE, axes)


def variances(N_coefficient: float, K: float, n: int, rate: float = RATE) -> np.ndarray:
    """What white noise and a walk give to the variances of the sines of n − 1 differences, [2, n − 1]."""
    # Their covariance is tridiagonal, hence diagonal in sines: 2·N²·rate and −N²·rate beside it of white
    # noise, K²h·2/3 and K²h/6 of the means of a walk.
    cosine = np.cos(np.pi * np.arange(1, n) / n)
    white, slow = 2.0 * rate * (1.0 - cosine), (2.0 + cosine) / (3.0 * rate)
    return np.stack([N_coefficient**2 * white, K**2 * slow])


def bound(N_coefficient: float, K: float, lengths: Sequence[int] = (N,), rate: float = RATE) -> np.ndarray:
    """Cramér and Rao's standard deviations of N and K by records of these lengths."""
    parts = np.concatenate([variances(N_coefficient, K, n, rate) for n in lengths], axis=1)
    share = parts / parts.sum(axis=0)
    # Fisher's information about ln N and ln K: half the squares of the slopes of ln variance.
    return np.sqrt(np.diag(np.linalg.inv(2.0 * share @ share.T))) * [N_coefficient, K]

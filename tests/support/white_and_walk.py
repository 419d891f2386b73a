"""Records of white noise and a random walk from NumPy alone, many at once as the axes of one recording."""

import numpy as np
from scipy.linalg import toeplitz

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


def information(N_coefficient: float, K: float, n: int = N) -> np.ndarray:
    """Fisher's of the powers N² and K², ½ tr(C⁻¹C_i C⁻¹C_j), of the differences of successive samples."""
    white, of_walk = np.zeros(n - 1), np.zeros(n - 1)
    white[:2] = 2.0 * RATE, -RATE
    of_walk[:2] = 2.0 / 3.0 / RATE, 1.0 / 6.0 / RATE
    parts = [toeplitz(white), toeplitz(of_walk)]
    C = N_coefficient**2 * parts[0] + K**2 * parts[1]
    scaled = [np.linalg.solve(C, part) for part in parts]
    return np.array([[0.5 * np.sum(a * b.T) for b in scaled] for a in scaled])


def bound(N_coefficient: float, K: float, n: int = N) -> np.ndarray:
    """Cramér and Rao's standard deviations of N and K."""
    powers = np.sqrt(np.diag(np.linalg.inv(information(N_coefficient, K, n))))
    return powers / (2.0 * np.array([N_coefficient, K]))

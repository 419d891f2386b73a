"""Records of white noise and a random walk from NumPy alone, many at once as the axes of one recording."""

import numpy as np

import allanjax as aj

RATE = 100.0
N = 2048


def walk(K: float, shape: tuple[int, int], rng: np.random.Generator) -> np.ndarray:
    """Means of a random walk over sample intervals: middle of two ends, and the bridge between them."""
    steps = rng.standard_normal(shape) / np.sqrt(RATE)
    bridge = rng.standard_normal(shape) / np.sqrt(12.0 * RATE)
    return K * (np.cumsum(steps, axis=0) - steps / 2.0 + bridge)


def records(N_coefficient: float, K: float, count: int, seed: int) -> aj.Recording:
    rng = np.random.default_rng(seed)
    values = N_coefficient * np.sqrt(RATE) * rng.standard_normal((N, count)) + walk(K, (N, count), rng)
    axes = tuple(aj.Axis(f"gyro_{k}", "gyro", "rad/s") for k in range(count))
    return aj.Recording(values, RATE, axes)

"""Draws of the samples before rounding or clipping, given what was recorded.

Between the limits set by the resolution or range of the output, a sample is Gaussian around the slow part of
the record. Drawing it restores the normal law on which everything else relies.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.ndimage import uniform_filter1d
from scipy.special import ndtr, ndtri

# Most and fewest sweeps, and the change of the deviation, in standard errors, below which they end.
_SWEEPS, _LEAST, _CHANCE = 12, 6, 1.0
# Number of samples in a local mean.
_WINDOW = 200
# Smallest tail probability from which samples are drawn.
_DEEP = 1e-12


def draw_between(
    x: Float[np.ndarray, " n"], lower: Float[np.ndarray, " n"], upper: Float[np.ndarray, " n"], seed: int
) -> tuple[Float[np.ndarray, " n"], float]:
    """Draw of samples between `lower` and `upper` (equal for exact samples), and their local deviation."""
    rng = np.random.default_rng(seed)
    open_, y = upper > lower, x.astype(float)
    lower, upper = lower[open_], upper[open_]
    width = min(_WINDOW, len(x) // 8)
    centre, sigma = uniform_filter1d(y, width, mode="reflect"), float(np.std(np.diff(y)) / np.sqrt(2.0))
    for k in range(_SWEEPS):
        slow = centre[open_]
        a, b = ((limit - slow) / max(sigma, 1e-300) for limit in (lower, upper))
        # In the tail of both limits, the smaller probability has the digits.
        flip = a > 0.0
        a, b = np.where(flip, -b, a), np.where(flip, -a, b)
        low, high = ndtr(a), ndtr(b)
        u = low + (high - low) * rng.random(len(a))
        z = ndtri(np.clip(u, _DEEP, 1.0 - _DEEP))
        y[open_] = slow + sigma * np.where(flip, -z, z)
        centre = uniform_filter1d(y, width, mode="reflect")
        before, sigma = sigma, float(np.sqrt(np.mean((y - centre) ** 2) * width / (width - 1.0)))
        if k + 1 >= _LEAST and abs(sigma - before) < _CHANCE * sigma / np.sqrt(2.0 * len(y)):
            break
    return y, sigma

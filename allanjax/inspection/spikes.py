"""Isolated spikes: single samples far from both of their neighbours."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

# Standard deviations of what is left of a sample less the mean of its neighbours beyond which it is a spike:
# Gaussian noise has one in 10¹⁵ samples.
_FAR = 8.0
# Median of the magnitude of a normal variate.
_MEDIAN = 0.6745
# Largest share of an axis's samples that are spikes: of more, the noise itself has heavy tails.
_MOST = 0.01


def spikes_in(x: Float[np.ndarray, " n"]) -> Bool[np.ndarray, " n"]:
    """Which samples are spikes; none where there are too many for that.

    What is left of a sample less the mean of its neighbours is compared with the median of its magnitude.
    Neighbours of a spike stand out by half as much with the other sign, and not once it is taken away; a
    step, a knock or a burst is no spike.
    """
    left = np.zeros(len(x))
    left[1:-1] = x[1:-1] - 0.5 * (x[:-2] + x[2:])
    scale = float(np.median(abs(left))) / _MEDIAN
    far, found = abs(left) > _FAR * scale, np.zeros(len(x), bool)
    # Where the scale is zero the output is rounded, and its steps are no spikes.
    if not scale > 0.0 or far.mean() > 3.0 * _MOST:
        return found
    places = np.flatnonzero(far)
    around = np.pad(left, 2)[places[:, None] + np.arange(5)]
    size = around[:, 2].copy()
    largest = abs(size) >= abs(around).max(axis=1)
    around[:, 1:4] += 0.5 * size[:, None] * [1.0, -2.0, 1.0]
    found[places] = largest & (abs(around).max(axis=1) <= _FAR * scale)
    return found if found.mean() <= _MOST else np.zeros(len(x), bool)

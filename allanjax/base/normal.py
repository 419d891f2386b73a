"""Quantiles of the normal distribution, and the standard deviation of its bulk."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

#: Half-widths of two-sided 95 % and 68 % intervals, in standard deviations.
TWO_SIDED_95, TWO_SIDED_68 = 1.959964, 0.994458
#: Distance of a one-sided 95 % limit from the value, in standard deviations.
ONE_SIDED_95 = 1.644854

# Mean of the smallest three quarters of the magnitudes of standard normal values.
_BULK = 0.5149033


def bulk_std(x: Float[np.ndarray, " n"]) -> float:
    """Standard deviation of normal values among which a few are outliers.

    It is that of the smallest three quarters of the magnitudes. Their mean, unlike a median, which is one of
    the values, hardly changes if values are rounded.
    """
    count = max(3 * len(x) // 4, 1)
    return float(np.mean(np.partition(abs(x), count - 1)[:count])) / _BULK

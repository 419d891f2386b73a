"""Which units of a fleet are unlike the others."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from allanjax.coefficients import TWO_SIDED_95

FALSE_ALARMS = 0.01
"""Probability that anything at all is marked in a fleet whose units are alike."""

# Median of the distance from the centre, in standard deviations of a normal law.
_MEDIAN_DISTANCE = 0.6745
# Robust standard deviations beyond which a unit is suspected, and tested.
_SUSPECT = 3.0
# Logarithms agree no better than rounding.
_ROUNDING = 1e-9
_FEWEST_UNITS = 3


def outlying(
    value: Float[np.ndarray, " units"],
    lower: Float[np.ndarray, " units"],
    upper: Float[np.ndarray, " units"],
    upper_limit: Float[np.ndarray, " units"],
    detected: Bool[np.ndarray, " units"],
    probability: float,
) -> Bool[np.ndarray, " units"]:
    """Mark the units whose coefficient is unlike that of the others.

    Units are taken to scatter about a common centre by a log-normal law of unknown width, and each estimate
    about its own unit's coefficient as its interval says: the variance of ln(value) is τ² + s², with s from
    the end of the interval that faces the centre. Suspects are the units beyond three standard deviations
    of the median, where τ is such that half of the units are within 0.6745 standard deviations of it (the
    median absolute deviation, if all s are zero); a third of the units at most. Suspects are then tested as
    in Rosner's generalized extreme Studentized deviate test (Technometrics 25, 1983): from the least extreme
    on, a suspect is compared with the units that are no more extreme, by mean and τ after Paule and Mandel
    (J. Res. NBS 87, 1982) and the critical value of the largest deviate of so many; once one exceeds it, it
    is marked together with all more extreme ones. A median absolute deviation alone would take far larger
    deviations to be as sure: of ten units, a deviation of eight τ is found in 76 % of cases instead of 3 %
    (at 0.2 % false alarms).

    Units without a detected coefficient are never marked. High values are compared with the limits of such
    units too, as if the coefficient were at its limit: it is lower, which makes a high value more unusual
    still. For low values such units are left out.

    Args:
        value, lower, upper: estimates and the ends of their 95 % intervals, in any one unit.
        upper_limit: 95 % limit of what was not detected.
        detected: whether there is an estimate.
        probability: that any unit is marked if all are alike; half of it high and half of it low. It holds
            to a tenth from twenty units on; of six to ten units it is up to 1.6 times as large.

    Returns:
        Whether each unit is marked; none of fewer than three.
    """
    from scipy.stats import t

    usable = detected & (value > 0.0) & (lower > 0.0) & np.isfinite(upper)
    comparable = usable | (~detected & (upper_limit > 0.0) & np.isfinite(upper_limit))
    marked = np.zeros(len(value), bool)
    if usable.sum() == 0 or comparable.sum() < _FEWEST_UNITS:
        return marked
    x = np.log(np.where(comparable, np.where(usable, value, upper_limit), 1.0))
    below = np.where(usable, x - np.log(np.where(usable, lower, 1.0)), 0.0) / TWO_SIDED_95
    above = np.where(usable, np.log(np.where(usable, upper, 1.0)) - x, 0.0) / TWO_SIDED_95
    s_high, distance_high = _scaled(x, below, above, comparable)
    s_low, distance_low = _scaled(x, below, above, usable)
    is_high = distance_high > _SUSPECT
    distance = np.where(usable, np.where(is_high, distance_high, -distance_low), 0.0)
    order = np.argsort(-distance)
    suspects = order[distance[order] > _SUSPECT][: comparable.sum() // 3]
    # A limit far above says nothing of its unit.
    comparable &= usable | ~is_high
    for k in range(len(suspects), 0, -1):
        last = suspects[k - 1]
        sign, s, others = (1.0, s_high, comparable) if is_high[last] else (-1.0, s_low, usable)
        rest = np.setdiff1d(np.flatnonzero(others), suspects[: k - 1])
        m = len(rest)
        if m < _FEWEST_UNITS:
            continue
        mean, width = _normal_law(x[rest], s[rest])
        quantile = t.isf(probability / (2 * m), m - 2)
        critical = (m - 1) * quantile / np.sqrt((m - 2 + quantile**2) * m)
        if sign * (x[last] - mean) / np.hypot(width, s[last]) > critical:
            marked[suspects[:k]] = True
            break
    return marked


def _scaled(
    x: Float[np.ndarray, " units"],
    below: Float[np.ndarray, " units"],
    above: Float[np.ndarray, " units"],
    units: Bool[np.ndarray, " units"],
) -> tuple[Float[np.ndarray, " units"], Float[np.ndarray, " units"]]:
    """Each value's own standard deviation, and its distance from the median of these units in robust ones."""
    centre = np.median(x[units])
    s = np.maximum(np.where(x > centre, below, above), _ROUNDING)
    width = _median_width(abs(x - centre)[units], s[units])
    return s, (x - centre) / np.hypot(width, s)


def _median_width(distance: Float[np.ndarray, " units"], s: Float[np.ndarray, " units"]) -> float:
    """Scatter τ for which half of the distances are within their median under a normal law."""
    from scipy.optimize import brentq

    def excess(width: float) -> float:
        return float(np.median(distance / np.hypot(width, s))) - _MEDIAN_DISTANCE

    return 0.0 if excess(0.0) <= 0.0 else float(brentq(excess, 0.0, 2.0 * distance.max() / _MEDIAN_DISTANCE))


def _normal_law(x: Float[np.ndarray, " units"], s: Float[np.ndarray, " units"]) -> tuple[float, float]:
    """Mean, and scatter τ for which χ² about the mean is the number of its degrees of freedom."""
    from scipy.optimize import brentq

    def mean(width: float) -> float:
        return float(np.average(x, weights=1.0 / (width**2 + s**2)))

    def excess(width: float) -> float:
        return float(np.sum((x - mean(width)) ** 2 / (width**2 + s**2))) - (len(x) - 1)

    width = 0.0 if excess(0.0) <= 0.0 else float(brentq(excess, 0.0, 2.0 * np.ptp(x)))
    return mean(width), width

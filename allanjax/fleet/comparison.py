"""Which units of a fleet are outlying, and whether the fleet consists of two groups.

The logarithms x of a coefficient of equal units scatter about their median m by a normal law of
unknown width τ, and the estimates about these by their errors s. A unit's distance from the others is
z = (x − m) / √(τ² + s² + s_m²), with the error s_m of the median. τ² + s² is told by the inner three
quarters of the units, whatever the outlying ones are; their number makes z a Student variate. A
sensor's axes are tested together, by their mean, and each by itself. All units and coefficients of a
fleet share the probability of a false mark, by Holm's method.

Several records of a unit are compared with one another in the same way, as values of many small parts, each
about a median of its own; so are the units of several groups that are too small by themselves. What is
outlying among its unit's records is left out of the unit's value.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.special import gammainc, gammaincinv, stdtr

from allanjax.base.normal import TWO_SIDED_95
from allanjax.base.testing import holm

FALSE_ALARMS = 0.01
"""Probability that any unit is marked in a fleet of equal units."""

FEWEST_UNITS = 4
"""Least number of units among which one can be outlying; of three, two may agree by chance."""

# Share of the units, those nearest to the median, that tell the scatter: a quarter may be outlying,
# and two of six.
_INNER = 0.75
# Degrees of freedom of the scatter for each of these units, if they are many; of few, their median takes
# one, and those that are farther off than the inner ones part of another. Measured on tails of 10⁻² to
# 2·10⁻⁵ of 4 to 100 normal values, in one part or in 2 to 24 of 2 to 5.
_FREEDOM = 0.8
# Least scatter [ln] where most units have limits, which do not tell it: a judgement.
_UNSEEN = 0.5
# Tail probability below which an axis of an outlying unit is marked: a judgement.
_ALSO = 0.02
# Least variance of a logarithm: rounding.
_ROUNDING = 1e-18

# Fewest units of a group that is found; fewer are outlying.
_FEWEST_OF_GROUP = 6
# Gap between two groups in standard deviations of the units of either. Of fleets of 12 normal values,
# 4 in 10,000 have it, and of larger ones fewer.
_GAP = 5.0

#: A number of each unit, a flag of each, the part it belongs to, and a flag of each on each axis.
Numbers: TypeAlias = Float[np.ndarray, " units"]
Flags: TypeAlias = Bool[np.ndarray, " units"]
Parts: TypeAlias = Int[np.ndarray, " units"]
Marks: TypeAlias = Bool[np.ndarray, "units axes"]


@dataclass(frozen=True, eq=False)
class Values:
    """Logarithms of one coefficient of many units or records, on one axis or as means over several.

    Attributes:
        x: ln of the estimates, and of upper limits below their median; NaN for what is not compared.
        below, above: standard deviations of x, from the interval's lower and upper end; 0 for limits.
        known: whether x is an estimate.
        part: number of the part that each belongs to, if not all are one.
    """

    x: Numbers
    below: Numbers
    above: Numbers
    known: Flags
    part: Parts

    @property
    def places(self) -> list[Int[np.ndarray, " members"]]:
        """Places of the values of each part; of several parts, those of one value are not compared."""
        has_value = np.isfinite(self.x)
        found = [np.flatnonzero(has_value & (self.part == part)) for part in np.unique(self.part)]
        return [own for own in found if len(own) > (len(found) > 1)]

    @property
    def distance(self) -> Numbers:
        """Distance of x from the median of its part; NaN for what is not compared."""
        distance = np.full(len(self.x), np.nan)
        for own in self.places:
            distance[own] = self.x[own] - np.median(self.x[own])
        return distance


def log_values(
    value: Numbers, lower: Numbers, upper: Numbers, upper_limit: Numbers, detected: Flags, part: Parts
) -> Values:
    """Logarithms of estimates with 95 % intervals, and of 95 % limits of what was not detected; by part.

    A unit with neither (NaN, or an interval without width, as of a value that was held) is not
    compared, nor is one whose limit is above the median of the estimates.
    """
    has_interval = (lower > 0.0) & (value >= lower) & (upper >= value) & (upper > lower)
    known: Flags = detected & has_interval & np.isfinite(upper)
    median = np.median(value[known]) if known.any() else 0.0
    low = ~detected & (upper_limit > 0.0) & (upper_limit < median)
    x = np.log(np.where(known, value, np.where(low, upper_limit, np.nan)))
    below = np.where(known, x - np.log(np.where(known, lower, 1.0)), 0.0)
    above = np.where(known, np.log(np.where(known, upper, 1.0)) - x, 0.0)
    return Values(x, below / TWO_SIDED_95, above / TWO_SIDED_95, known, part)


def outlying(families: Sequence[Sequence[Values]], alarms: float = FALSE_ALARMS) -> list[Marks]:
    """Mark the units of a fleet that differ from the others of their group, on the axes where they do.

    Args:
        families: of each coefficient of a sensor in a group, the values on its axes, with the same
            units on each.
        alarms: probability that any unit is marked in a fleet of equal units.

    Returns:
        Of each family, whether each unit is marked on each axis; none is among fewer than four units.
        An outlying unit is marked on the worst axis, and on those where less than 2 % of units would
        be so far out.
    """
    each = [np.stack([p_values(axis) for axis in axes], axis=1) for axes in families]
    first = [_first_of_two(axes[0].part) for axes in families]
    tested = list[float | None]()
    for p, places, axes in zip(each, first, families, strict=True):
        together = _together(p, axes)
        together[places < np.arange(len(places))] = np.nan
        tested += [None if np.isnan(own) else own for own in together.tolist()]
    corrected = iter(holm(tested))
    marks = []
    for p, places in zip(each, first, strict=True):
        is_odd = [c is not None and c < alarms for _, c in zip(p, corrected, strict=False)]
        worst = p == np.fmin.reduce(p, axis=1)[:, None]
        marks.append(np.array(is_odd)[places, None] & ((p < _ALSO) | worst))
    return marks


def _first_of_two(part: Parts) -> Parts:
    """Place of each value; for the second of two in a part, as far from their median, that of the first."""
    places = np.arange(len(part))
    for of in np.unique(part):
        own = np.flatnonzero(part == of)
        if len(own) == 2:
            places[own] = own[0]
    return places


def _together(each: Float[np.ndarray, "units axes"], axes: Sequence[Values]) -> Numbers:
    """p-values of units on all axes, given those on each; NaN for units that are not tested.

    The mean over the axes shows what is slightly off on all of them, an axis by itself a single bad
    one: each has half the probability of a false mark.
    """
    least = np.fmin.reduce(each, axis=1)
    if len(axes) == 1:
        return least
    return np.minimum(2.0 * np.fmin(len(axes) * least, p_values(mean_of(axes))), 1.0)


def mean_of(axes: Sequence[Values]) -> Values:
    """Means of the distances from the axes' medians, of units that have a value on each axis."""
    errors = [[axis.below, axis.above] for axis in axes]
    below, above = np.sqrt(np.sum(np.square(errors), axis=0)) / len(axes)
    distance = np.mean([axis.distance for axis in axes], axis=0)
    return Values(distance, below, above, np.all([axis.known for axis in axes], axis=0), axes[0].part)


def p_values(values: Values) -> Numbers:
    """Two-sided p-values of the units' distances from the median; NaN for units that are not tested.

    Limits count among the others, as if the coefficients were at these, which is cautious for high
    values; the scatter is that of the estimates. Where most units have limits, it is at least 0.5 [ln].
    """
    distance, places = values.distance, values.places
    is_compared = np.isfinite(distance)
    known, free = values.known & is_compared, is_compared.copy()
    # Of several parts, each has a value that is its median, or as near to it as another; of one, the median
    # is lost instead.
    lost = int(len(places) < 2)
    for own in () if lost else places:
        free[own[np.argmin(abs(distance[own]))]] = False
    count = int(free.sum())
    if count - lost < FEWEST_UNITS - 1 or not (known & free).any():
        return np.full(len(values.x), np.nan)
    # The end of the interval that faces the others.
    error = np.where(distance > 0.0, values.below, values.above) ** 2
    usual = float(np.median(error[known]))
    most_known = 2 * known.sum() >= is_compared.sum()
    telling = distance[free & (known if most_known else is_compared)]
    # Of scatter and usual errors together.
    spread = max(_variance(telling, count, lost), usual + (_ROUNDING if most_known else _UNSEEN**2))
    own_spread = spread - usual + error
    inner = min(_inner(count), len(telling))
    few = inner + inner / (count - lost) - 2.0
    # Errors are known: the larger a unit's own, the more degrees of freedom.
    degrees = (min(few, _FREEDOM * inner) if lost else _FREEDOM * inner) * (own_spread / spread) ** 2
    of_median = np.zeros(len(distance))
    for own in places:
        of_median[own] = 0.5 * np.pi * np.median(own_spread[own]) / len(own)
    tail = 2.0 * stdtr(degrees, -abs(distance) / np.sqrt(own_spread + of_median))
    return np.where(known, tail, np.nan)


def _inner(count: int) -> int:
    """How many of so many units tell the scatter."""
    return min(round(_INNER * count), count - 1)


def _variance(distance: Numbers, count: int, lost: int = 1) -> float:
    """Variance of so many normal values by the inner ones of the distances from their median.

    It is that of all but one: the value whose distance is of interest is not among the inner ones. Of the
    distances from several medians, none is lost for these. Values whose distance is not given are farther
    off than the others.
    """
    nearest = np.sort(distance**2)[: _inner(count)]
    share = len(nearest) / (count - lost)
    # Variance of the share of a standard normal law that is nearest to zero.
    part = gammainc(1.5, gammaincinv(0.5, share)) / share
    return float(nearest.mean() / part)


class Split(NamedTuple):
    """Units in two groups.

    Attributes:
        gap: gap between the groups as a multiple of that from which on they are two.
        ratio: ratio of their medians.
        is_upper: whether each unit is in the group above the gap.
    """

    gap: float
    ratio: float
    is_upper: Flags


def two_groups(axes: Sequence[Values]) -> Split:
    """Units parted at the widest gap of a coefficient that leaves six and a third of all on each side.

    Units have the means of their values over the axes. The gap is compared with five standard
    deviations of the units about the median of their group, errors and scatter both, in the group
    where that is larger. It is 0 if there are too few units, or if one of them has no value.
    """
    distances = np.stack([axis.distance for axis in axes])
    has_value = np.isfinite(distances)
    count = distances.shape[1]
    least = max(_FEWEST_OF_GROUP, int(np.ceil(count / 3.0)))
    if count < 2 * least or not has_value.any(axis=0).all():
        return Split(0.0, 1.0, np.zeros(count, bool))
    x = np.where(has_value, distances, 0.0).sum(axis=0) / has_value.sum(axis=0)
    ordered = np.sort(x)
    gaps = np.diff(ordered)[least - 1 : count - least]
    lower, upper = np.split(ordered, [int(np.argmax(gaps)) + least])
    variance = max(_ROUNDING, *(_variance(part - np.median(part), len(part)) for part in (lower, upper)))
    gap = float(gaps.max() / (_GAP * np.sqrt(variance)))
    return Split(gap, float(np.exp(np.median(upper) - np.median(lower))), x >= upper[0])

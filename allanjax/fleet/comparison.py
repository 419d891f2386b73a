"""Comparison of the units of a fleet: which differ from the others, and which groups they fall into."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.special import gammaln, logsumexp, ndtr

from allanjax.base.normal import TWO_SIDED_95
from allanjax.record.units import Sensor

FALSE_ALARMS = 0.01
"""Probability that any unit is marked in a fleet of equal units."""

FEWEST_UNITS = 3
"""Least number of units among which one can be outlying."""

# Prior of the scatter of like units [ln]: a Student's t folded at zero, of this scale and these degrees of
# freedom. White noise comes from the electronics and is much the same in units of one make; what drifts is
# not.
_SCATTER = {"angle_random_walk": 0.12, "quantization": 0.12}
_SCATTER_OF_OTHERS = 0.4
_DEGREES = 8.0
WIDTHS = np.concatenate([[0.0], np.geomspace(0.005, 5.0, 48)])
"""Scatters of equal units [ln] that are summed over."""

# Median of the distance from the centre, in standard deviations of a normal law.
_MEDIAN_DISTANCE = 0.6745
# Robust standard deviations beyond which a unit is tested: a judgement.
_SUSPECT = 2.5
# Tail probability below which an axis of an outlying unit is marked: a judgement.
_ALSO = 0.02
# Share of the probability of a false mark that each test gets: several suspects are tested, each as if it
# were the only one, and units may scatter more than the prior expects. Measured by the study fleet_outliers.
_SHARE = 0.5
# Least standard deviation of a logarithm: rounding.
_ROUNDING = 1e-9
# Odds of several groups against one from which on groups are reported, times the number of coefficients: a
# judgement.
_ODDS = 5.0
# Prior probability that a unit is odd, and range of its coefficient [ln]: judgements.
_ODD, _RANGE = 0.05, np.log(1000.0)
# Fewest units of the lowest group.
_FEWEST_BETTER = 2
# Number of the widest gaps between units at which groups may part.
_GAPS = 8
# Standard deviation [ln] of a limit that is used in place of an estimate: a judgement.
_LIMIT_SCATTER = 0.3
# Degrees of freedom of Student's law by which a unit's coefficients scatter about those of its group, so that
# an odd one does not outvote the others; and the least scatter of a group [ln]: judgements.
_FREEDOM, _LEAST_WIDTH = 3.0, 0.05


#: A number of each unit, a flag of each, and a number for each of `WIDTHS`.
Numbers: TypeAlias = Float[np.ndarray, " units"]
Flags: TypeAlias = Bool[np.ndarray, " units"]
Widths: TypeAlias = Float[np.ndarray, " widths"]


@dataclass(frozen=True, eq=False)
class Values:
    """Logarithms of one coefficient of many units, on one axis or pooled over several.

    Attributes:
        x: ln of the estimates; of the limits, where there is no estimate.
        below, above: standard deviations of x, from the interval's lower and upper end.
        known: whether there is an estimate with an interval.
        limited: whether there is an upper limit instead.
    """

    x: Numbers
    below: Numbers
    above: Numbers
    known: Flags
    limited: Flags

    @property
    def comparable(self) -> Flags:
        """Whether a unit has an estimate or a limit."""
        return self.known | self.limited

    @property
    def testable(self) -> bool:
        """Whether there are enough units for `outlying` to mark one."""
        return bool(self.known.any() and self.comparable.sum() >= FEWEST_UNITS)

    def towards(self, centre: float) -> Numbers:
        """Standard deviations of x on the side that faces the centre; limits have none."""
        s = np.where(self.x > centre, self.below, self.above)
        return np.where(self.known, np.maximum(s, _ROUNDING), _ROUNDING)


@dataclass(frozen=True, eq=False)
class Family:
    """One coefficient of the units of a group, on all axes of a sensor.

    Attributes:
        sensor, coefficient: sensor, label of the coefficient.
        recordings: names of the units.
        rows: their rows in the table, −1 where there is none.
        axes: logarithms of the coefficient on each axis.
    """

    sensor: Sensor
    coefficient: str
    recordings: Sequence[str]
    rows: Int[np.ndarray, "units axes"]
    axes: list[Values]


def log_values(
    value: Numbers, lower: Numbers, upper: Numbers, upper_limit: Numbers, detected: Flags
) -> Values:
    """Logarithms of estimates with 95 % intervals, and of 95 % limits of what was not detected.

    A unit with neither (NaN, or an interval without width, as of a value that was held) is not compared.
    """
    has_interval = (lower > 0.0) & (value >= lower) & (upper >= value) & (upper > lower)
    known: Flags = detected & has_interval & np.isfinite(upper)
    limited: Flags = ~detected & (upper_limit > 0.0) & np.isfinite(upper_limit)

    def log(numbers: Numbers, of: Flags) -> Numbers:
        return np.log(np.where(of, numbers, 1.0))

    x = log(value, known) + log(upper_limit, limited)
    below = np.where(known, x - log(lower, known), 0.0) / TWO_SIDED_95
    above = np.where(known, log(upper, known) - x, 0.0) / TWO_SIDED_95
    return Values(x, below, above, known, limited)


def pooled(axes: list[Values]) -> Values:
    """Values pooled over the axes: the mean of each unit's distances from the axes' medians.

    Axes weigh by the inverse of the variance that their own interval and the usual scatter give them. A unit
    with an estimate on one axis at least is known by its estimates, one without by its limits.
    """
    # One row per axis.
    known, limited, below, above = (
        np.stack([getattr(axis, name) for axis in axes]) for name in ("known", "limited", "below", "above")
    )
    deviation = np.stack([axis.x - _median(axis) for axis in axes])
    is_known: Flags = np.any(known, axis=0)
    is_limited: Flags = np.any(limited, axis=0) & ~is_known
    weight = np.where(is_known, known, limited) / (
        _SCATTER["angle_random_walk"] ** 2 + ((below + above) / 2.0) ** 2
    )
    total = np.maximum(weight.sum(axis=0), _ROUNDING)
    below, above = (np.sqrt(np.sum((weight * s) ** 2, axis=0)) / total for s in (below, above))
    mean = np.sum(weight * deviation, axis=0) / total
    return Values(mean, below, above, is_known, is_limited)


def outlying(axes: list[Values], probability: float, coefficient: str = "") -> Bool[np.ndarray, "units axes"]:
    """Mark the units whose coefficient differs from that of the others, on the axes where it does.

    On each axis the units scatter about a centre by a log-normal law of unknown width τ, and the estimates
    about their units' coefficients by their intervals: the variance of ln(value) is τ² + s², with s from the
    end of the interval that faces the centre. The probability that a suspect is so far out is integrated over
    the centre (flat prior) and τ, given the other units. τ has a folded Student's t with 8 degrees of freedom
    as prior, with a scale of 12 % (angle random walk, quantization) or 40 % (others). Many units overrule it;
    with three to ten it makes a judgement possible: three units alone may agree by chance.

    Each axis is tested separately, and all axes of a unit together by their mean, which detects both a single
    bad axis and a unit that is slightly high on every axis. Suspects are the units beyond 2.5 robust standard
    deviations from the median, at most a third of all. They are tested as in Rosner's generalized extreme
    Studentized deviate test (Technometrics 25, 1983): starting with the least extreme, each is compared with
    the less extreme units; the first that differs is marked together with all more extreme ones, so that
    several outlying units do not hide each other.

    In an outlying unit, each axis is marked that would be so far out by chance in less than 2 % of all units.

    Units without a detected coefficient are never marked. High values are also compared with their limits, as
    if the coefficients were at these, which is cautious. For low values such units are left out.

    Args:
        axes: values on axes of one kind, with the same units on each.
        probability: probability that any unit is marked if all are equal.
        coefficient: label of the coefficient, for the prior of τ.

    Returns:
        Whether each unit is marked on each axis; none is with fewer than three units.
    """
    log_prior = log_prior_of(coefficient)
    probability *= _SHARE
    columns = [*axes, pooled(axes)] if len(axes) > 1 else axes
    unlike = [_unlike(column, probability / len(columns), log_prior) for column in columns]
    usual, marked = ~np.any(unlike, axis=0), np.stack(unlike[: len(axes)], axis=1)
    for unit in map(int, np.flatnonzero(~usual)):
        chances = np.array([_chance(axis, unit, usual, log_prior) for axis in axes])
        marked[unit] |= (chances < _ALSO) | (~marked[unit].any() & (chances == chances.min()))
        marked[unit] &= [axis.known[unit] for axis in axes]
    return marked


def _unlike(values: Values, probability: float, log_prior: Widths) -> Flags:
    """Whether each unit is unlike the others in one column."""
    marked = np.zeros(len(values.x), bool)
    if not values.testable:
        return marked
    high, low = _distance(values, values.comparable), _distance(values, values.known)
    is_high = high > _SUSPECT
    distance = np.where(values.known, np.where(is_high, high, -low), 0.0)
    order = np.argsort(-distance)
    # The most extreme first.
    suspects = order[distance[order] > _SUSPECT][: values.comparable.sum() // 3]
    # A limit far above the others does not describe its unit.
    comparable = values.comparable & (values.known | ~is_high)
    for k in range(len(suspects), 0, -1):
        suspect = suspects[k - 1]
        others = comparable if is_high[suspect] else values.known
        rest = np.setdiff1d(np.flatnonzero(others), suspects[:k])
        if len(rest) + 1 < FEWEST_UNITS:
            continue
        # Either side, and the most extreme of all.
        if _tail(values, suspect, rest, log_prior) < probability / (2.0 * (len(rest) + 1)):
            marked[suspects[:k]] = True
            break
    return marked


def _distance(values: Values, units: Flags) -> Numbers:
    """Distance of each value from the median of these units in robust standard deviations."""
    centre = float(np.median(values.x[units]))
    s = values.towards(centre)
    width = median_width(abs(values.x - centre)[units], s[units])
    return (values.x - centre) / np.hypot(width, s)


def _chance(values: Values, unit: int, usual: Flags, log_prior: Widths) -> float:
    """Probability of a value so far out on its side in a unit like the usual ones; 1 if it is unknown."""
    rest = np.flatnonzero((values.known if (values.known & usual).sum() > 1 else values.comparable) & usual)
    if not values.known[unit] or len(rest) + 1 < FEWEST_UNITS:
        return 1.0
    return _tail(values, unit, rest, log_prior)


def _tail(values: Values, unit: int, rest: Int[np.ndarray, " rest"], log_prior: Widths) -> float:
    """Probability of a value at least as far from the others on its side, integrated over centre and τ."""
    centre = float(np.median(values.x[rest]))
    s = values.towards(centre)
    evidence, mean, total = by_width(values.x[rest], s[rest])
    log_posterior = log_prior + evidence
    posterior = np.exp(log_posterior - log_posterior.max())
    deviation = abs(values.x[unit] - centre) + np.sign(centre - values.x[unit]) * (mean - centre)
    tails = ndtr(-deviation / np.sqrt(WIDTHS**2 + s[unit] ** 2 + 1.0 / total))
    return float(np.sum(posterior * tails) / np.sum(posterior))


def by_width(x: Numbers, s: Numbers) -> tuple[Widths, Widths, Widths]:
    """Log-likelihood of normal values, their weighted mean, and its precision, for each scatter of units.

    The likelihood is integrated over a centre of flat prior density 1.
    """
    precision = 1.0 / (WIDTHS[:, None] ** 2 + s**2)
    total = precision.sum(axis=1)
    mean = np.sum(precision * x, axis=1) / total
    misfit = np.sum(precision * (x - mean[:, None]) ** 2, axis=1)
    parts = np.sum(np.log(precision), axis=1) - np.log(total) - misfit
    return 0.5 * (parts - (len(x) - 1) * np.log(2.0 * np.pi)), mean, total


def log_prior_of(coefficient: str) -> Widths:
    """Log prior probability of each width; the probabilities add up to 1."""
    scale = _SCATTER.get(coefficient, _SCATTER_OF_OTHERS)
    weight = (1.0 + (WIDTHS / scale) ** 2 / _DEGREES) ** (-0.5 * (_DEGREES + 1.0)) * np.gradient(WIDTHS)
    return np.log(weight / weight.sum())


def _median(values: Values) -> float:
    """Median of the estimates, or of the limits where there are none."""
    units = values.known if values.known.any() else values.limited
    return float(np.median(values.x[units])) if units.any() else 0.0


def median_width(distance: Numbers, s: Numbers) -> float:
    """Robust scatter τ of units beyond their own standard deviations, by their median distance."""
    width = float(np.median(distance)) / _MEDIAN_DISTANCE
    return float(np.sqrt(max(width**2 - float(np.median(s)) ** 2, 0.0)))


class Split(NamedTuple):
    """Division of units into groups.

    Attributes:
        family: coefficient that shows it.
        labels: group of each unit, in ascending order of the coefficient from 0 on.
        ratios: ratio of each group's median to that of the group below.
    """

    family: Family
    labels: Int[np.ndarray, " units"]
    ratios: list[float]


def _pooled_values(family: Family, units: Sequence[str]) -> tuple[Numbers, Numbers]:
    """ln of a coefficient of these units, up to a constant, and its error; NaN where it is unknown.

    It is pooled from its values on each axis. A limit counts as a value if it is below all values: the
    coefficient is lower still.
    """
    values = pooled(family.axes)
    lowest = values.x[values.known].min() if values.known.any() else np.inf
    counted = values.known | (values.limited & (values.x < lowest))
    places = [units.index(name) for name in family.recordings]
    x, s = np.full((2, len(units)), np.nan)
    x[places] = np.where(counted, values.x, np.nan)
    s[places] = np.where(values.known, (values.below + values.above) / 2.0, _LIMIT_SCATTER)
    return x, np.where(np.isfinite(x), s, np.nan)


def found_split(families: Sequence[Family], units: Sequence[str]) -> Split | None:
    """Groups that the units fall into, by the coefficient that shows them most clearly, or None.

    Each coefficient's units are put in order and parted at their widest gaps. A part is a group, whose units
    scatter log-normally about a centre of its own, or its units are odd ones; parts of fewer than three
    units, or of an eighth of all, are not taken for groups; parts of two are, of six units or fewer, and
    below all others, for bad units are not better than the rest. The scatter has the prior of
    `outlying`; parameters are integrated over; groups are reported if the odds against the
    best single group, with whatever units are odd then, are five times the number of coefficients to one.

    A unit belongs to the group that is nearest in its coefficients together, each with long tails: one bad
    coefficient does not carry it into another group.
    """
    values = [_pooled_values(family, units) for family in families]
    splits = [_split(*of, log_prior_of(f.coefficient)) for of, f in zip(values, families, strict=True)]
    best = max(range(len(splits)), key=lambda k: splits[k][0], default=0)
    if not splits or splits[best][0] < np.log(_ODDS * len(families)):
        return None
    labels = _nearest(values, splits[best][1])
    medians = [np.nanmedian(values[best][0][labels == g]) for g in range(int(labels.max()) + 1)]
    return Split(families[best], labels, list(np.exp(np.diff(medians))))


def _split(x: Numbers, s: Numbers, prior: Widths) -> tuple[float, Int[np.ndarray, " units"]]:
    """Log odds of several groups against one, and the groups; −1 for units that are odd or unknown."""
    units, labels = np.flatnonzero(np.isfinite(x)), np.full(len(x), -1)
    order = units[np.argsort(x[units])]
    m = len(order)
    smallest = 2 if m <= 2 * FEWEST_UNITS else max(FEWEST_UNITS, int(np.ceil(m / 8.0)))
    if m < smallest + _FEWEST_BETTER:
        return -np.inf, labels
    x, s = x[order], s[order]
    gaps = np.argsort(-np.diff(x))[:_GAPS]
    single, several = -np.inf, -np.inf
    for count in range(len(gaps) + 1):
        parts = np.split(np.arange(m), np.sort(gaps[:count]) + 1)
        one, more, groups = _weighed(x, s, parts, smallest, prior)
        single = max(single, one)
        if more > several:
            several, labels[order] = more, groups
    return several - single, labels


def _weighed(
    x: Numbers, s: Numbers, parts: Sequence[Int[np.ndarray, " _"]], smallest: int, prior: Widths
) -> tuple[float, float, Int[np.ndarray, " units"]]:
    """Log evidence of one group and of several, the parts being groups or odd units, and the labels."""
    sizes = np.array([len(part) for part in parts])
    odd = sizes * np.log(_ODD / _RANGE)
    group = np.full((len(parts), len(WIDTHS)), -np.inf)
    for k, part in enumerate(parts):
        # Two units that are far better than the others are not both bad ones.
        if len(part) >= (smallest if k else _FEWEST_BETTER):
            evidence = by_width(x[part], np.maximum(s[part], _ROUNDING))[0]
            group[k] = evidence - np.log(_RANGE) + len(part) * np.log1p(-_ODD)
    gain = group - odd[:, None]
    one = logsumexp(prior + odd.sum() + gain.max(axis=0))
    # Assignment of the other units to groups: all shares of the groups are equally likely.
    is_group = gain > 0.0
    members, number = is_group.T @ sizes, is_group.sum(axis=0)
    whose = is_group.T @ gammaln(sizes + 1.0) + gammaln(np.maximum(number, 1))
    total = prior + odd.sum() + np.maximum(gain, 0.0).sum(axis=0) + whose - gammaln(members + number)
    total = np.where(number > 1, total, -np.inf)
    if not (number > 1).any():
        return float(one), -np.inf, np.full(len(x), -1)
    labels = np.full(len(x), -1)
    for label, place in enumerate(np.flatnonzero(is_group[:, np.argmax(total)]).tolist()):
        labels[parts[place]] = label
    return float(one), float(logsumexp(total)), labels


def _nearest(
    values: Sequence[tuple[Numbers, Numbers]], labels: Int[np.ndarray, " units"]
) -> Int[np.ndarray, " units"]:
    """Group that each unit is nearest to, in all coefficients together."""
    groups = int(labels.max()) + 1
    cost = np.zeros((len(labels), groups))
    for x, s in values:
        is_known = np.isfinite(x)
        for g in range(groups):
            members = is_known & (labels == g)
            if not members.any():
                continue
            centre = np.median(x[members])
            width = median_width(abs(x - centre)[members], s[members])
            z = (x - centre) / np.hypot(max(width, _LEAST_WIDTH), s)
            cost[:, g] += np.where(is_known, (_FREEDOM + 1.0) / 2.0 * np.log1p(z**2 / _FREEDOM), 0.0)
    nearest = np.argmin(cost, axis=1)
    return nearest if len(np.unique(nearest)) == groups else np.where(labels >= 0, labels, nearest)

"""Grades, types or batches of a fleet that its user has not named, by their coefficients."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Int
from scipy.special import gammaln, logsumexp

from allanjax.fleet.outlying_units import (
    FEWEST_UNITS,
    WIDTHS,
    Numbers,
    Widths,
    log_evidence,
    log_prior_of,
    median_width,
    pooled,
)
from allanjax.fleet.table import Family
from allanjax.record.units import Sensor

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


@dataclass(frozen=True, eq=False)
class Pooled:
    """One coefficient of all units, its axes pooled.

    Attributes:
        sensor, coefficient: sensor and label of the coefficient.
        x, s: ln of the coefficient, up to a constant, and its standard deviation; NaN where it is unknown.
    """

    sensor: Sensor
    coefficient: str
    x: Numbers
    s: Numbers


@dataclass(frozen=True, eq=False)
class Split:
    """Division of units into groups.

    Attributes:
        pooled: coefficient that shows it.
        labels: group of each unit, in ascending order of the coefficient from 0 on.
        log_odds: log odds against a single group.
    """

    pooled: Pooled
    labels: Int[np.ndarray, " units"]
    log_odds: float

    @property
    def ratios(self) -> list[float]:
        """Ratio of each group's median to that of the group below."""
        medians = [np.nanmedian(self.pooled.x[self.labels == g]) for g in range(self.groups)]
        return list(np.exp(np.diff(medians)))

    @property
    def groups(self) -> int:
        """Number of groups."""
        return int(self.labels.max()) + 1


def pooled_values(family: Family, units: Sequence[str]) -> Pooled:
    """Coefficient of these units, pooled from its values on each axis.

    A limit counts as a value if it is below all values: the coefficient is lower still.
    """
    values = pooled(family.axes)
    lowest = values.x[values.known].min() if values.known.any() else np.inf
    counted = values.known | (values.limited & (values.x < lowest))
    places = [units.index(name) for name in family.recordings]
    x, s = np.full((2, len(units)), np.nan)
    x[places] = np.where(counted, values.x, np.nan)
    s[places] = np.where(values.known, (values.below + values.above) / 2.0, _LIMIT_SCATTER)
    return Pooled(family.sensor, family.coefficient, x, np.where(np.isfinite(x), s, np.nan))


def found_split(families: Sequence[Pooled]) -> Split | None:
    """Groups that the units fall into, by the coefficient that shows them most clearly, or None.

    Each coefficient's units are put in order and parted at their widest gaps. A part is a group, whose units
    scatter log-normally about a centre of its own, or its units are odd ones; parts of fewer than three
    units, or of an eighth of all, are not taken for groups; parts of two are, of six units or fewer, and
    below all others, for bad units are not better than the rest. The scatter has the prior of
    `outlying_units.outlying`; parameters are integrated over; groups are reported if the odds against the
    best single group, with whatever units are odd then, are five times the number of coefficients to one.

    A unit belongs to the group that is nearest in its coefficients together, each with long tails: one bad
    coefficient does not carry it into another group.
    """
    splits = [split for family in families if (split := _split(family)) is not None]
    best = max(splits, key=lambda split: split.log_odds, default=None)
    if best is None or best.log_odds < np.log(_ODDS * len(families)):
        return None
    return Split(best.pooled, _nearest(families, best.labels), best.log_odds)


def _split(values: Pooled) -> Split | None:
    """Division by one coefficient, in which units that are odd or unknown have the label −1."""
    units = np.flatnonzero(np.isfinite(values.x))
    order = units[np.argsort(values.x[units])]
    m = len(order)
    smallest = 2 if m <= 2 * FEWEST_UNITS else max(FEWEST_UNITS, int(np.ceil(m / 8.0)))
    if m < smallest + _FEWEST_BETTER:
        return None
    x, s = values.x[order], values.s[order]
    gaps = np.argsort(-np.diff(x))[:_GAPS]
    prior = log_prior_of(values.coefficient)
    single, several, labels = -np.inf, -np.inf, None
    for count in range(len(gaps) + 1):
        parts = np.split(np.arange(m), np.sort(gaps[:count]) + 1)
        one, more, groups = _weighed(x, s, parts, smallest, prior)
        single = max(single, one)
        if more > several:
            several, labels = more, groups
    if labels is None:
        return None
    of_units = np.full(len(values.x), -1)
    of_units[order] = labels
    return Split(values, of_units, several - single)


def _weighed(
    x: Numbers,
    s: Numbers,
    parts: Sequence[Int[np.ndarray, " _"]],
    smallest: int,
    prior: Widths,
) -> tuple[float, float, Int[np.ndarray, " units"]]:
    """Log evidence of one group and of several, the parts being groups or odd units, and the labels."""
    sizes = np.array([len(part) for part in parts])
    odd = sizes * np.log(_ODD / _RANGE)
    group = np.full((len(parts), len(WIDTHS)), -np.inf)
    for k, part in enumerate(parts):
        # Two units that are far better than the others are not both bad ones.
        if len(part) >= (smallest if k else _FEWEST_BETTER):
            precision = 1.0 / (WIDTHS[:, None] ** 2 + np.maximum(s[part], 1e-9) ** 2)
            mean = np.sum(precision * x[part], axis=1) / precision.sum(axis=1)
            group[k] = log_evidence(precision, x[part], mean) - np.log(_RANGE) + len(part) * np.log1p(-_ODD)
    gain = group - odd[:, None]
    one = logsumexp(prior + odd.sum() + gain.max(axis=0))
    # Which units of those that are not odd are whose: any shares of the groups are as likely.
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


def _nearest(families: Sequence[Pooled], labels: Int[np.ndarray, " units"]) -> Int[np.ndarray, " units"]:
    """Group that each unit is nearest to, in all coefficients together."""
    groups = int(labels.max()) + 1
    cost = np.zeros((len(labels), groups))
    for family in families:
        is_known = np.isfinite(family.x)
        for g in range(groups):
            members = is_known & (labels == g)
            if not members.any():
                continue
            centre = np.median(family.x[members])
            width = median_width(abs(family.x - centre)[members], family.s[members])
            z = (family.x - centre) / np.hypot(max(width, _LEAST_WIDTH), family.s)
            cost[:, g] += np.where(is_known, (_FREEDOM + 1.0) / 2.0 * np.log1p(z**2 / _FREEDOM), 0.0)
    nearest = np.argmin(cost, axis=1)
    return nearest if len(np.unique(nearest)) == groups else np.where(labels >= 0, labels, nearest)

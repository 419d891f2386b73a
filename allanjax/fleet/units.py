"""Units of a fleet that have several records: their values, and the scatter within and between them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from allanjax.comparison.random_effects import Laws, Pooled, random_effects
from allanjax.fleet.comparison import Flags, Marks, Numbers, Values, outlying


def united(records: Values, left_out: Flags) -> Values:
    """Values of units by their records, whose parts are the units; those left out are no part of it.

    A unit's estimate is the mean of its records', weighted by their errors and the scatter within units. A
    unit without an estimate has its lowest limit.
    """
    known, unit, x = records.known & ~left_out, records.part, records.x
    several = [of for of in _laws(records, known) if of.dof]
    scatter = Pooled(several).scatter() if several else 0.0
    ends = np.stack([records.below, records.above])
    weight = np.where(known, 1.0 / (ends.mean(axis=0) ** 2 + scatter + ~known), 0.0)
    total = np.bincount(unit, weight)
    has_estimate, total = total > 0.0, np.where(total > 0.0, total, np.nan)
    mean = np.bincount(unit, weight * np.where(known, x, 0.0)) / total
    below, above = (np.sqrt(np.bincount(unit, weight**2 * (end**2 + scatter))) / total for end in ends)
    limit = np.full(len(total), np.nan)
    np.fmin.at(limit, unit, np.where(records.known, np.nan, x))
    x = np.where(has_estimate, mean, limit)
    return Values(x, np.nan_to_num(below), np.nan_to_num(above), has_estimate, np.zeros(len(total), int))


def scatters(records: Values, left_out: Flags) -> list[tuple[float, float, float, float]]:
    """Scatter of a coefficient's ln within and between units: size, 95 % interval, limit; NaN if unknown."""
    units = _laws(records, records.known & ~left_out)
    found, variance = [(np.nan,) * 4] * 2, 0.0
    if any(of.dof for of in units):
        within = Pooled(units)
        variance = within.scatter()
        found[0] = float(np.sqrt(variance)), *within.scatter_ends(0.025), within.scatter_ends(0.05)[1]
    if len(units) > 1:
        means = [of.fitted(variance) for of in units]
        of = random_effects(*np.transpose([(of.mean, of.std) for of in means]))
        found[1] = of.scatter, *of.scatter_interval, of.scatter_limit
    return found


def _laws(records: Values, known: Flags) -> list[Laws]:
    """The estimates of each unit that has any."""
    own = [np.flatnonzero(known & (records.part == unit)) for unit in np.unique(records.part)]
    error = 0.5 * (records.below + records.above)
    return [Laws(records.x[k], error[k]) for k in own if len(k)]


def over_others(records: Values) -> Numbers:
    """Distance of each record's estimate from the median of its unit's other records; NaN of one alone."""
    distance = np.full(len(records.x), np.nan)
    x = np.where(records.known, records.x, np.nan)
    for own in records.places:
        for k in own if len(own) > 1 else ():
            distance[k] = x[k] - np.nanmedian(x[own[own != k]])
    return distance


def joined(groups: Sequence[Values]) -> Values:
    """Values of several groups as one, about the median of their group, with the parts of each."""
    if len(groups) == 1:
        return groups[0]
    x = [of.x - np.nanmedian(of.x) if np.isfinite(of.x).any() else of.x for of in groups]
    begins = np.cumsum([0, *(of.part.max() + 1 for of in groups[:-1])])
    part = [of.part + begin for of, begin in zip(groups, begins, strict=True)]
    below, above, known = ([getattr(of, key) for of in groups] for key in ("below", "above", "known"))
    return Values(*map(np.concatenate, (x, below, above, known, part)))


def odd_records(families: Sequence[Sequence[Values]], alarms: float) -> list[Marks]:
    """Marks of records that differ from the others of their unit, at most half of these; see `outlying`.

    Estimates are compared, without limits. Of two records that differ, and of two halves, those farther from
    the median of all are odd.
    """
    estimates = [
        [replace(axis, x=np.where(axis.known, axis.x, np.nan)) for axis in axes] for axes in families
    ]
    return [*map(_minority, outlying(estimates, alarms), estimates)]


def _minority(marks: Marks, axes: Sequence[Values]) -> Marks:
    """The marks of at most half of a unit's records, those farther from the median of all records."""
    distances = [abs(axis.x - np.nanmedian(axis.x)) for axis in axes if np.isfinite(axis.x).any()]
    far, kept = np.fmax.reduce([*distances, np.zeros(len(marks))], axis=0), np.zeros_like(marks)
    for unit in np.unique(axes[0].part):
        own = np.flatnonzero(axes[0].part == unit)
        odd = own[marks[own].any(axis=1)]
        odd = odd[np.argsort(-far[odd])][: len(own) // 2]
        kept[odd] = marks[odd]
    return kept

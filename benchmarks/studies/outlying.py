"""Does a fleet name the unit that is 1.3 times off, and no other?

Simulated estimates and intervals, without fits: three coefficients of gyros and accelerometers on three axes.
Logarithms of equal units scatter by 3 to 20 % (that of N; B and K up to three times as much), in half of the
fleets by the unit, in half by each axis; estimates have errors of 1 to 30 %, which differ from axis to axis
by up to a factor of 2. K is undetected where it is below a limit, which varies by 10 %: on one axis in six.
Grades are of equal size, each 4 times the one before, known by `--group` or not. Thresholds were set on other
seeds.

*Any mark*: share of the fleets without an outlying unit that name one (at most 0.01). *Visible*: ln 1.3 in
standard deviations of the mean over the axes, of scatter and error together; what is demanded (0.95) is that
a unit is named from 13 of these on among 12 units, 9 among 24, 7.5 among 50, and 7 among 100. Fewer units
tell their scatter less well, and all units and coefficients share one false mark in a hundred fleets.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from allanjax.fleet.comparison import FALSE_ALARMS, Values, log_values, outlying, two_groups
from allanjax.fleet.units import odd_records, united
from benchmarks.common.study import run_tasks, share, table

QUICK: dict[str, Any] = {"fleets": 4, "powers": 2, "units": (12,)}
SCATTERS, ERRORS = (0.03, 0.05, 0.1, 0.2), (0.01, 0.03, 0.1, 0.3)
RATIO, OFF = 4.0, 1.3
#: Number of grades, and whether these are known by `--group`.
GRADES = ((1, True), (2, True), (3, True), (2, False), (3, False))
#: By the number of units, from how many standard deviations on an outlying one is to be named.
DEMANDED = {12: 13.0, 24: 9.0, 50: 7.5, 100: 7.0}
#: How an odd unit is off: on how many axes, how many times, and how many units are, as a share.
WAYS = ((1, 2.0, 0.0), (1, 4.0, 0.0), (3, 2.0, 0.0), (3, 2.0, 0.2))

Fleet = list[list[Values]]


def run(
    *, fleets: int = 1000, powers: int = 100, units: tuple[int, ...] = (12, 24, 50, 100), seed: int = 20
) -> Iterator[str]:
    tasks = [(seed, n, *grades, fleets) for n in units for grades in GRADES]
    found = dict(zip(tasks, run_tasks(false_marks, tasks), strict=True))
    rows = [[n, *(share(found[seed, n, *grades, fleets]) for grades in GRADES)] for n in units]
    head = [f"{count} grade{'s' * (count > 1)}{', not known' * (not known)}" for count, known in GRADES]
    every = np.concatenate(list(found.values()))
    yield f"## Any mark: {fleets} fleets a cell\n\n{table(['units', *head], rows)}\n\nAll: {share(every)}"
    tasks = [(seed, n, w, e, powers) for n in units for w in SCATTERS for e in ERRORS]
    named = dict(zip(tasks, run_tasks(power, tasks), strict=True))
    rows, demanded = [], {n: list[np.ndarray]() for n in units}
    for n in units:
        for w in SCATTERS:
            cells = []
            for e in ERRORS:
                for of_unit, hits in enumerate(named[seed, n, w, e, powers]):
                    visible = np.log(OFF) / np.hypot(w if of_unit else w / np.sqrt(3.0), e / np.sqrt(3.0))
                    cells.append(f"{hits.mean():.2f} ({visible:.1f})")
                    if visible >= DEMANDED[n]:
                        demanded[n].append(hits)
            rows.append(
                [n, f"{100 * w:.0f} %", *(" ".join(cells[k : k + 2]) for k in range(0, len(cells), 2))]
            )
    head = ["units", "scatter", *(f"errors {100 * e:.0f} %" for e in ERRORS)]
    yield f"## One unit {OFF} times off: named (visible), scatter of the axes and of the unit"
    yield table(head, rows)
    rows = [[n, DEMANDED[n], share(np.concatenate([[], *demanded[n]]))] for n in units]
    yield f"Of those visible as demanded:\n\n{table(['units', 'visible by', 'named'], rows)}"
    tasks = [(seed, n, *way, powers) for n in units for way in WAYS]
    odd = dict(zip(tasks, run_tasks(other_ways, tasks), strict=True))
    rows = []
    for axes, off, several in WAYS:
        shares = [odd[seed, n, axes, off, several, powers] for n in units]
        cells = [f"{found[:, 0].mean():.2f} {found[:, 1].mean():.2f}" for found in shares]
        rows.append([axes, off, f"{100 * several:.0f} % of units" if several else "one", *cells])
    head = ["axes", "times", "odd units", *(f"{n} units" for n in units)]
    yield "## Other odd units, scatter 5 %, errors 3 %: odd units named, fleets with another one named"
    yield table(head, rows)
    tasks = [(seed, n, ratio, w, powers) for n in units for ratio in (2.0, 4.0) for w in (0.05, 0.1, 0.2)]
    parted = run_tasks(groups, tasks)
    rows = [
        [n, ratio, f"{100 * w:.0f} %", *map(share, x.T)]
        for (_, n, ratio, w, _), x in zip(tasks, parted, strict=True)
    ]
    yield "## Groups that nobody named: two halves apart by a ratio, or one of a sixth of the units"
    yield table(["units", "apart by", "scatter", "halves are groups", "a sixth is a group"], rows)

    tasks = [(seed, *way, powers) for way in ((6, 2), (12, 2), (12, 3), (24, 5))]
    found = run_tasks(records, tasks)
    rows = [[n, days, *map(share, x.T)] for (_, n, days, _), x in zip(tasks, found, strict=True)]
    yield f"## Several records of a unit: any mark; a record {OFF} times off named (scatter 2 %, errors 1 %)"
    yield table(["units", "records of each", "a record", "a unit", "the odd record"], rows)


def drawn(
    rng: np.random.Generator, units: int, width: float, error: float, of_unit: bool, shift: Any = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """ln of the estimates [units, axes], shifted, and their errors."""
    own = width * rng.standard_normal((units, 1 if of_unit else 3)) * np.ones(3)
    errors = np.minimum(error * np.exp2(rng.uniform(-0.5, 0.5, own.shape)), 0.3)
    return own + shift + errors * rng.standard_normal(own.shape), errors


def values_of(x: np.ndarray, s: np.ndarray, limit: Any = -np.inf) -> list[Values]:
    """Values on each axis; below its limit a coefficient is not detected."""
    value, low, high, limit = np.exp([x, x - 1.96 * s, x + 1.96 * s, limit * np.ones_like(x)])
    seen = value > limit
    one = np.zeros(len(x), int)
    return [log_values(value[:, k], low[:, k], high[:, k], limit[:, k], seen[:, k], one) for k in range(3)]


def fleet_of(
    rng: np.random.Generator, units: int, width: float, error: float, of_unit: bool, shift: Any = 0.0
) -> Fleet:
    """Six coefficients of equal units, the first shifted."""
    families = []
    for k in range(6):
        drift = rng.uniform(1.0, 3.0) if k % 3 else 1.0
        x, s = drawn(rng, units, width * drift, error, of_unit, 0.0 if k else shift)
        # K, below the limit on about one axis in six.
        limit = -width * drift + 0.1 * rng.standard_normal(x.shape) if k % 3 == 2 else -np.inf
        families.append(values_of(x, s, limit))
    return families


def false_marks(seed: int, units: int, grades: int, known: bool, fleets: int) -> np.ndarray:
    """Whether fleets without an outlying unit have any mark."""
    rng, found = np.random.default_rng([seed, units, grades, known]), np.zeros(fleets, bool)
    for k in range(fleets):
        width, error = rng.uniform(0.03, 0.2), np.exp(rng.uniform(np.log(0.01), np.log(0.3)))
        sizes = [len(part) for part in np.array_split(np.arange(units), grades)]
        if known:
            parts = [fleet_of(rng, size, width, error, bool(k % 2)) for size in sizes]
        else:
            grade = np.repeat(np.arange(grades), sizes)[:, None]
            parts = divided(fleet_of(rng, units, width, error, bool(k % 2), np.log(RATIO) * grade))
        found[k] = any(marks.any() for marks in outlying([family for part in parts for family in part]))
    return found


def divided(fleet: Fleet) -> list[Fleet]:
    """The fleet, or the two groups that it falls into."""
    best = max((two_groups(family) for family in fleet), key=lambda split: split.gap)
    if best.gap <= 1.0:
        return [fleet]
    return [
        [[Values(*(x[own] for x in vars(axis).values())) for axis in family] for family in fleet]
        for own in (~best.is_upper, best.is_upper)
    ]


def power(seed: int, units: int, width: float, error: float, fleets: int) -> np.ndarray:
    """Whether the odd unit is named, the scatter being of axes and of units [2, fleets]."""
    rng = np.random.default_rng([seed, units, int(1000 * width), int(1000 * error)])
    shift, found = np.zeros((units, 1)), np.zeros((2, fleets), bool)
    shift[0] = np.log(OFF)
    for k in np.ndindex(found.shape):
        found[k] = outlying(fleet_of(rng, units, width, error, bool(k[0]), shift))[0][0].any()
    return found


def other_ways(seed: int, units: int, axes: int, off: float, several: float, fleets: int) -> np.ndarray:
    """Share of the odd units that is named, and whether any other is [fleets, 2]."""
    rng = np.random.default_rng([seed, units, axes, int(100 * off), int(100 * several)])
    odd, found = max(int(several * units), 1), np.zeros((fleets, 2))
    shift = np.zeros((units, 3))
    shift[:odd, :axes] = np.log(off)
    for k in range(fleets):
        marks = [of.any(axis=1) for of in outlying(fleet_of(rng, units, 0.05, 0.03, bool(k % 2), shift))]
        found[k] = marks[0][:odd].mean(), np.any([of[odd:].any() for of in marks])
    return found


def records(seed: int, units: int, days: int, fleets: int) -> np.ndarray:
    """Whether a record of like ones is marked, a unit is, and a record that is off is [fleets, 3]."""
    rng, found = np.random.default_rng([seed, units, days]), np.zeros((fleets, 3), bool)
    unit = np.repeat(np.arange(units), days)
    for k in range(fleets):
        between, within, error = np.exp(rng.uniform(np.log([0.03, 0.003, 0.01]), np.log([0.2, 0.1, 0.3])))
        families = []
        for _ in range(6):
            own = between * rng.standard_normal((units, 3))[unit]
            x, s = drawn(rng, units * days, within, error, bool(k % 2))
            families.append([replace(axis, part=unit) for axis in values_of(own + x, s)])
        odd = odd_records(families, FALSE_ALARMS / 2.0)
        means = [[*map(united, axes, marks.T)] for axes, marks in zip(families, odd, strict=True)]
        marked = any(marks.any() for marks in outlying(means, FALSE_ALARMS / 2.0))
        x, s = drawn(rng, units * days, 0.02, 0.01, bool(k % 2))
        x[1] += np.log(OFF)
        off = odd_records([[replace(axis, part=unit) for axis in values_of(x, s)]], FALSE_ALARMS / 2.0)
        found[k] = any(marks.any() for marks in odd), marked, off[0][1].any()
    return found


def groups(seed: int, units: int, ratio: float, width: float, fleets: int) -> np.ndarray:
    """Whether two halves are told as groups, and whether a sixth of the units is [fleets, 2]."""
    rng = np.random.default_rng([seed, units, int(10 * ratio), int(1000 * width)])
    found = np.zeros((fleets, 2), bool)
    for k in range(fleets):
        for way, count in enumerate((units // 2, units // 6)):
            shift = np.log(ratio) * (np.arange(units) < count)[:, None]
            parts = divided(fleet_of(rng, units, width, 0.03, bool(k % 2), shift))
            found[k, way] = len(parts) > 1
    return found

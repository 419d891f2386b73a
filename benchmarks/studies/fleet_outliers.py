"""Which units of a fleet are marked as outlying? Simulated fleets of values and intervals, without fits.

    python benchmarks/studies/fleet_outliers.py [--seed 3] [--fleets 400] [--powers 12] [--workers 2]

Units are alike up to a log-normal scatter, of the unit or of each of its axes; each estimate has an error
that its interval tells. Beside allanjax's rule runs the one that it had before (rosner.py): each axis by
itself, the scatter known from the fleet alone. Both share 1 % of false alarms among all coefficients of a
fleet.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np
import paths

from allanjax.fleet.outlying_units import FALSE_ALARMS
from allanjax.fleet.summary import judged
from allanjax.fleet.table import table_of
from benchmarks.common import rosner
from benchmarks.common.machine import describe
from benchmarks.common.report import publish, run_tasks, share, table

UNITS = (3, 4, 6, 12, 24)
SCATTERS = (0.0, 0.05, 0.10, 0.15)
BEYOND = (0.2, 0.3)
ERRORS = (0.01, 0.03, 0.10)
FACTORS = (1.5, 2.0, 4.0)
COEFFICIENTS = (
    ("gyro", "angle_random_walk"),
    ("gyro", "bias_instability"),
    ("gyro", "rate_random_walk"),
    ("accel", "angle_random_walk"),
    ("accel", "bias_instability"),
    ("accel", "rate_random_walk"),
)
SIZES = ((4, 8), (8, 4), (6, 6), (3, 9), (4, 4, 4), (6, 18))
RATIOS = (4.0, 7.0, 10.0)
CHUNK = 100


def drawn(
    rng: np.random.Generator, units: int, scatter: float, error: float | None, of_unit: bool
) -> tuple[np.ndarray, np.ndarray]:
    """ln of the estimates [units, axes] of like units, and their errors (0.01 to 0.1 each, if not given)."""
    x = scatter * rng.standard_normal((units, 1 if of_unit else 3)) * np.ones(3)
    s = rng.uniform(0.01, 0.1, x.shape) if error is None else np.full(x.shape, error)
    return x + s * rng.standard_normal(x.shape), s


def rows_of(
    sensor: str, coefficient: str, x: np.ndarray, s: np.ndarray, group: np.ndarray | None = None
) -> list[dict]:
    """As rows of a fleet's table."""
    return [
        {
            "recording": f"{u:03}",
            "file": "",
            "group": "" if group is None else str(group[u]),
            "axis": f"{sensor}_{k}",
            "sensor": sensor,
            "coefficient": coefficient,
            "value": np.exp(x[u, k]),
            "std": s[u, k] * np.exp(x[u, k]),
            "lower_95": np.exp(x[u, k] - 1.96 * s[u, k]),
            "upper_95": np.exp(x[u, k] + 1.96 * s[u, k]),
            "unit": "",
            "detected": True,
            "measured": True,
            "outlying": False,
            "warnings": "",
        }
        for u, k in np.ndindex(x.shape)
    ]


def marked_by_allanjax(rows: list[dict]) -> tuple[np.ndarray, tuple[str, ...]]:
    """Marks of the first coefficient's units and axes, whether others have any, and what is said."""
    result, notes = judged(table_of(rows))
    return result["outlying"].to_numpy(), notes


def marked_by_rosner(x: np.ndarray, s: np.ndarray, columns: int) -> np.ndarray:
    """Marks [units, axes], of one coefficient of a fleet with so many coefficients on all axes."""
    probability = FALSE_ALARMS / columns
    return np.stack([rosner.outlying(x[:, k], s[:, k], probability) for k in range(x.shape[1])], axis=1)


def false_alarms(seed: int, units: int, beyond: float, fleets: int) -> np.ndarray:
    """Fleets of like units: any mark of allanjax, any of Rosner's test, any group seen [fleets, 3].

    White noise scatters by one of SCATTERS (by `beyond`, if that is given), B and K once or three times as
    much, of the unit or of each axis.
    """
    rng = np.random.default_rng([seed, units, int(1000 * beyond)])
    found = np.zeros((fleets, 3), bool)
    for k in range(fleets):
        scatter, drift, of_unit = beyond or rng.choice(SCATTERS), rng.choice([1.0, 3.0]), bool(k % 2)
        rows, old = [], []
        for sensor, coefficient in COEFFICIENTS:
            width = scatter * (1.0 if coefficient == "angle_random_walk" else drift)
            x, s = drawn(rng, units, width, None, of_unit)
            rows += rows_of(sensor, coefficient, x, s)
            old.append(marked_by_rosner(x, s, 3 * len(COEFFICIENTS)).any())
        marks, notes = marked_by_allanjax(rows)
        found[k] = marks.any(), any(old), any("groups" in note for note in notes)
    return found


def power(seed: int, units: int, factor: float, scatter: float, error: float, fleets: int) -> np.ndarray:
    """Fleets with a bad unit: all axes marked, or any, by either rule; a bad axis alone [fleets, 5]."""
    rng = np.random.default_rng([seed, units, int(100 * factor), int(1000 * scatter), int(1000 * error)])
    found = np.zeros((fleets, 5), bool)
    for k in range(fleets):
        of_unit = bool(k % 2)
        (x, s), (y, r) = (drawn(rng, units, scatter, error, of_unit) for _ in range(2))
        one = x.copy()
        x[0] += np.log(factor)
        one[0, 0] += np.log(factor)
        other = rows_of("accel", "angle_random_walk", y, r)
        marks = marked_by_allanjax(rows_of("gyro", "angle_random_walk", x, s) + other)[0][:3]
        axis = marked_by_allanjax(rows_of("gyro", "angle_random_walk", one, s) + other)[0][:3]
        old = marked_by_rosner(x, s, 6)[0]
        found[k] = marks.all(), marks.any(), old.all(), old.any(), axis[0] and not axis[1:].any()
    return found


def grades(
    seed: int, sizes: tuple[int, ...], ratio: float, scatter: float, sensors: int, fleets: int
) -> np.ndarray:
    """Fleets of several grades with a bad unit (2 to 4 times) in each [fleets, 7].

    Without groups: said, half a grade or more marked, any good unit marked, share of bad units marked; with
    groups: any good unit, share of the bad ones; half a grade marked by Rosner's test.
    """
    rng = np.random.default_rng([seed, *sizes, int(10 * ratio), int(1000 * scatter), sensors])
    grade = np.repeat(np.arange(len(sizes)), sizes)
    bad = np.cumsum([0, *sizes[:-1]])
    good = np.ones(len(grade), bool)
    good[bad] = False
    found = np.zeros((fleets, 7))
    for k in range(fleets):
        error = rng.uniform(0.01, 0.1)
        parts = []
        for _ in range(sensors):
            x, s = drawn(rng, len(grade), scatter, error, bool(k % 2))
            parts.append((x + np.log(ratio) * grade[:, None], s))
        parts[0][0][bad] += np.log(rng.uniform(2.0, 4.0, len(bad)))[:, None]

        def marked(group: np.ndarray | None, parts: list = parts) -> tuple[np.ndarray, tuple[str, ...]]:
            rows = [
                row
                for sensor, (x, s) in zip(("gyro", "accel"), parts, strict=False)
                for row in rows_of(sensor, "angle_random_walk", x, s, group)
            ]
            marks, notes = marked_by_allanjax(rows)
            return marks.reshape(len(parts), len(grade), 3).any(axis=(0, 2)), notes

        without, notes = marked(None)
        named, _ = marked(grade)
        old = np.any([marked_by_rosner(x, s, 3 * sensors) for x, s in parts], axis=(0, 2))

        def whole(marks: np.ndarray) -> float:
            return max(marks[(grade == g) & good].mean() for g in range(len(sizes)))

        found[k] = (
            any("groups" in note for note in notes),
            whole(without) >= 0.5,
            without[good].any(),
            without[bad].mean(),
            named[good].any(),
            named[bad].mean(),
            whole(old) >= 0.5,
        )
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seed", type=int, default=3)
    parser.add_argument("--fleets", type=int, default=400)
    parser.add_argument("--powers", type=int, default=12)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--results", type=Path, default=paths.RESULTS / "fleet_outliers.md")
    options = parser.parse_args()
    begun = time.perf_counter()

    cases = [(options.seed, m, 0.0, options.fleets) for m in UNITS]
    cases += [(options.seed, m, b, options.fleets // 4) for m in UNITS for b in BEYOND]
    alarms = _run(false_alarms, cases, options.workers)
    powers = _run(
        power,
        [
            (options.seed, m, f, w, e, options.powers)
            for m in UNITS
            for f in FACTORS
            for w in SCATTERS
            for e in ERRORS
        ],
        options.workers,
    )
    graded = _run(
        grades,
        [
            (options.seed, sizes, ratio, scatter, sensors, max(options.powers // 4, 1))
            for sizes in SIZES
            for ratio in RATIOS
            for scatter in (0.05, 0.15)
            for sensors in (1, 2)
        ],
        options.workers,
    )
    text = _report(options, alarms, powers, graded, time.perf_counter() - begun)
    publish(text, options.results)


def _run(function: object, tasks: list[tuple], workers: int) -> dict[tuple, np.ndarray]:
    return {task[1:-1]: found for task, found, _ in run_tasks(function, tasks, workers)}  # type: ignore[arg-type]


def _report(options: argparse.Namespace, alarms: dict, powers: dict, graded: dict, seconds: float) -> str:
    alarm_rows = []
    for m in UNITS:
        within = alarms[m, 0.0]
        beyond = [alarms[m, b] for b in BEYOND]
        alarm_rows.append(
            [
                str(m),
                str(len(within)),
                *(share(within[:, c]) for c in range(3)),
                *(share(b[:, 0]) for b in beyond),
            ]
        )
    power_rows = []
    for m in UNITS:
        for f in FACTORS:
            of = {(w, e): v.mean(axis=0) for (k, g, w, e), v in powers.items() if k == m and g == f}
            row = [str(m), f"{f:g}"]
            for w in SCATTERS:
                mean = np.mean([of[w, e] for e in ERRORS], axis=0)
                row.append(f"{mean[0]:.2f} {mean[1]:.2f} · {mean[2]:.2f} {mean[3]:.2f}")
            row.append(f"{np.mean([v[4] for v in of.values()]):.2f}")
            power_rows.append(row)
    grade_rows = []
    for sizes in SIZES:
        for sensors in (1, 2):
            of = [v for (z, _, _, n), v in graded.items() if z == sizes and n == sensors]
            mean = np.concatenate(of).mean(axis=0)
            grade_rows.append(
                [" + ".join(map(str, sizes)), str(sensors), *(f"{x:.3f}" for x in (*mean[:4], *mean[4:]))]
            )
    head_alarms = ["units", "fleets", "any mark", "any mark, rule before", "groups seen"]
    head_alarms += [f"any mark at {100 * b:.0f} %" for b in BEYOND]
    head_power = ["units", "bad", *(f"scatter {100 * w:.0f} %" for w in SCATTERS), "one bad axis"]
    head_grades = ["units", "sensors", "said", "half a grade marked", "a good unit marked", "bad units found"]
    head_grades += ["good, --group", "bad, --group", "half a grade, rule before"]
    return ABOUT.format(
        seed=options.seed,
        machine=describe(("numpy", "scipy", "pandas", "allanjax")),
        minutes=seconds / 60.0,
        alarms=table(head_alarms, alarm_rows),
        powers=table(head_power, power_rows),
        fleets=options.powers,
        grades=table(head_grades, grade_rows),
        each=max(options.powers // 4, 1) * len(RATIOS) * 2,
    )


ABOUT = """# Outlying units of simulated fleets

Values and their intervals, three axes a sensor, no fits. Seed {seed}; constants of the rule (prior of the
scatter, share of the probability, odds of groups) were set on other seeds. The rule before took each axis by
itself and knew the scatter from the fleet alone (`benchmarks/common/rosner.py`). Reproduce with
`python benchmarks/studies/fleet_outliers.py`.

{machine}
- {minutes:.0f} minutes

## False alarms: fleets of like units

Six coefficients on three axes; log-normal scatter of 0, 5, 10 or 15 % of white noise, and once or three times
that of B and K, of the unit or of each axis; errors of 1 to 10 %. Share of fleets with any mark at all (aim:
at most 0.01), and of those that are said to fall into groups. Last columns: any mark, where the scatter is 20
or 30 % (that of B and K up to 90 %), beyond what is usual.

{alarms}

## Power: one bad unit

Two coefficients; the bad unit is at so many times the others on all axes of one. Shares of {fleets} fleets at
each of the errors 1, 3 and 10 %: marked on all axes, marked on any · the same for the rule before. Last
column: one bad axis, marked and no other.

{powers}

## Grades

Fleets of several grades, each 4, 7 or 10 times the one before, scatter 5 or 15 %, errors of 1 to 10 %, one
unit of each at 2 to 4 times its grade; {each} fleets a row. Of one sensor, whose bad units may lie among the
other grade's and cannot be told then, or of two, of which one has the bad units. Without groups and with
them.

{grades}
"""


if __name__ == "__main__":
    main()

"""Which units of a fleet are marked as outlying, and does a fleet use its workers?

Outlying units: simulated values and their intervals, without fits. Units are alike up to a log-normal
scatter, of the unit or of each of its axes; each estimate has an error of 1 to 10 % that its interval tells.
Constants of the rule were set on other seeds. False alarms: six coefficients on three axes, of which B and K
scatter once or three times as much as white noise (aim: any mark in at most 1 % of the fleets). Power: two
coefficients, a bad unit at so many times the others on all axes of one, or on one axis alone. Grades: fleets
of several grades, each 4, 7 or 10 times the one before, one unit of each at 2 to 4 times its grade; of one
sensor, whose bad units may lie among the other grade's and cannot be told then, or of two, of which one has
the bad units.

Workers: recordings of six axes at 100 Hz, Parquet, terms chosen by the fit; every run is a process with a
local cluster of its own, started and closed within the time.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from allanjax.fleet.table import judged, table_of
from benchmarks.common.study import run_tasks, share, table

PACKAGES = ("pandas", "dask", "distributed")
QUICK: dict[str, Any] = {"fleets": 4, "powers": 1, "units": (4,), "grades": 1, "recordings": 0}
SCATTERS, BEYOND, ERRORS, FACTORS = (0.0, 0.05, 0.10, 0.15), (0.2, 0.3), (0.01, 0.03, 0.10), (1.5, 2.0, 4.0)
COEFFICIENTS = ("angle_random_walk", "bias_instability", "rate_random_walk")
SIZES = ((4, 8), (8, 4), (6, 6), (3, 9), (4, 4, 4), (6, 18))
RATIOS = (4.0, 7.0, 10.0)
AXES = [f"{sensor}_{axis}" for sensor in ("gyro", "accel") for axis in "xyz"]

Estimates = tuple[np.ndarray, np.ndarray]


def run(
    *,
    fleets: int = 400,
    powers: int = 12,
    units: tuple[int, ...] = (3, 4, 6, 12, 24),
    grades: int = len(SIZES),
    recordings: int = 200,
    samples: int = 60_000,
    seed: int = 3,
) -> Iterator[str]:
    widths = (0.0, *BEYOND)
    tasks = [(seed, m, b, fleets if b == 0.0 else max(fleets // 4, 1)) for m in units for b in widths]
    alarms = dict(zip(((m, b) for _, m, b, _ in tasks), run_tasks(false_alarms, tasks), strict=True))
    rows = [
        [m, *(share(alarms[m, 0.0][:, c]) for c in (0, 1)), *(share(alarms[m, b][:, 0]) for b in BEYOND)]
        for m in units
    ]
    head = ["units", "any mark", "groups seen", *(f"any mark, scatter {100 * b:.0f} %" for b in BEYOND)]
    yield f"## False alarms: {fleets} fleets of like units\n\n{table(head, rows)}"
    tasks = [(seed, m, f, w, e, powers) for m in units for f in FACTORS for w in SCATTERS for e in ERRORS]
    found = run_tasks(power, tasks)
    rows = []
    for m in units:
        for f in FACTORS:
            of = {
                w: np.concatenate([x for x, t in zip(found, tasks, strict=True) if t[1:4] == (m, f, w)])
                for w in SCATTERS
            }
            cells = [f"{x[:, 0].mean():.2f} {x[:, 1].mean():.2f}" for x in of.values()]
            rows.append([m, f"{f:g}", *cells, f"{np.mean([x[:, 2].mean() for x in of.values()]):.2f}"])
    head = ["units", "bad by", *(f"scatter {100 * w:.0f} %" for w in SCATTERS), "one bad axis, and no other"]
    yield "## Power: one bad unit, marked on all axes, on any\n\n" + table(head, rows)
    tasks = [
        (seed, sizes, ratio, w, sensors, max(powers // 4, 1))
        for sizes in SIZES[:grades]
        for ratio in RATIOS
        for w in (0.05, 0.15)
        for sensors in (1, 2)
    ]
    found = run_tasks(graded, tasks)
    rows = []
    for sizes in SIZES[:grades]:
        for sensors in (1, 2):
            of = [x for x, t in zip(found, tasks, strict=True) if (t[1], t[4]) == (sizes, sensors)]
            means = np.concatenate(of).mean(axis=0)
            rows.append([" + ".join(map(str, sizes)), sensors, *(f"{x:.3f}" for x in means)])
    head = ["units", "sensors", "groups said", "half a grade marked", "a good unit marked", "bad units found"]
    yield "## Grades, without `--group` and with it"
    yield table([*head, "good, --group", "bad, --group"], rows)
    if recordings:
        yield f"## Workers: {recordings} recordings of six axes × {samples:,} samples"
        with tempfile.TemporaryDirectory() as folder:
            os.environ["ALLANJAX_CACHE"] = str(Path(folder) / "cache")
            yield from workers(Path(folder), recordings, samples)


# --- Outlying units ----------------------------------------------------------------------------------------


def drawn(
    rng: np.random.Generator, units: int, scatter: float, error: float | None, of_unit: bool
) -> Estimates:
    """ln of the estimates [units, axes] of like units, and their errors (0.01 to 0.1 each, if not given)."""
    x = scatter * rng.standard_normal((units, 1 if of_unit else 3)) * np.ones(3)
    s = rng.uniform(0.01, 0.1, x.shape) if error is None else np.full(x.shape, error)
    return x + s * rng.standard_normal(x.shape), s


def rows_of(sensor: str, coefficient: str, of: Estimates, group: np.ndarray | None = None) -> list[dict]:
    """As rows of a fleet's table."""
    x, s = of
    same = {"file": "", "sensor": sensor, "coefficient": coefficient, "unit": "", "warnings": ""}
    same |= {"detected": True, "measured": True, "outlying": False}
    return [
        same
        | {"recording": f"{u:03}", "group": "" if group is None else str(group[u]), "axis": f"{sensor}_{k}"}
        | {"value": np.exp(x[u, k]), "std": s[u, k] * np.exp(x[u, k])}
        | {"lower_95": np.exp(x[u, k] - 1.96 * s[u, k]), "upper_95": np.exp(x[u, k] + 1.96 * s[u, k])}
        for u, k in np.ndindex(x.shape)
    ]


def marked(rows: list[dict]) -> tuple[np.ndarray, bool]:
    """Marks of all rows, and whether groups are seen."""
    result, notes = judged(table_of(rows))
    return result["outlying"].to_numpy(), any("groups" in note for note in notes)


def false_alarms(seed: int, units: int, beyond: float, fleets: int) -> np.ndarray:
    """Fleets of like units: any mark, any group seen [fleets, 2]."""
    rng, found = np.random.default_rng([seed, units, int(1000 * beyond)]), np.zeros((fleets, 2), bool)
    for k in range(fleets):
        scatter, drift, of_unit = beyond or rng.choice(SCATTERS), rng.choice([1.0, 3.0]), bool(k % 2)
        rows = []
        for sensor in ("gyro", "accel"):
            for coefficient in COEFFICIENTS:
                width = scatter * (1.0 if coefficient == "angle_random_walk" else drift)
                rows += rows_of(sensor, coefficient, drawn(rng, units, width, None, of_unit))
        marks, groups = marked(rows)
        found[k] = marks.any(), groups
    return found


def power(seed: int, units: int, factor: float, scatter: float, error: float, fleets: int) -> np.ndarray:
    """Fleets with a bad unit: all its axes marked, any; a bad axis marked, and no other [fleets, 3]."""
    rng = np.random.default_rng([seed, units, int(100 * factor), int(1000 * scatter), int(1000 * error)])
    found = np.zeros((fleets, 3), bool)
    for k in range(fleets):
        (x, s), other = (drawn(rng, units, scatter, error, bool(k % 2)) for _ in range(2))
        one = x.copy()
        x[0] += np.log(factor)
        one[0, 0] += np.log(factor)
        more = rows_of("accel", "angle_random_walk", other)
        marks, axis = (marked(rows_of("gyro", "angle_random_walk", (y, s)) + more)[0][:3] for y in (x, one))
        found[k] = marks.all(), marks.any(), axis[0] and not axis[1:].any()
    return found


def graded(
    seed: int, sizes: tuple[int, ...], ratio: float, scatter: float, sensors: int, fleets: int
) -> np.ndarray:
    """Fleets of several grades with a bad unit in each [fleets, 6], without groups and with them."""
    rng = np.random.default_rng([seed, *sizes, int(10 * ratio), int(1000 * scatter), sensors])
    grade, bad = np.repeat(np.arange(len(sizes)), sizes), np.cumsum([0, *sizes[:-1]])
    good = ~np.isin(np.arange(len(grade)), bad)
    found = np.zeros((fleets, 6))
    for k in range(fleets):
        error, parts = rng.uniform(0.01, 0.1), []
        for _ in range(sensors):
            x, s = drawn(rng, len(grade), scatter, error, bool(k % 2))
            parts.append((x + np.log(ratio) * grade[:, None], s))
        parts[0][0][bad] += np.log(rng.uniform(2.0, 4.0, len(bad)))[:, None]
        of = []
        for group in (None, grade):
            kinds = zip(("gyro", "accel"), parts, strict=False)
            tables = [rows_of(sensor, "angle_random_walk", part, group) for sensor, part in kinds]
            marks, groups = marked([row for rows in tables for row in rows])
            of.append((marks.reshape(sensors, len(grade), 3).any(axis=(0, 2)), groups))
        (without, groups), (named, _) = of
        whole = max(without[(grade == g) & good].mean() for g in range(len(sizes)))
        of_good = without[good].any(), named[good].any()
        found[k] = groups, whole >= 0.5, of_good[0], without[bad].mean(), of_good[1], named[bad].mean()
    return found


# --- Workers -----------------------------------------------------------------------------------------------


def workers(folder: Path, recordings: int, samples: int) -> Iterator[str]:
    (folder / "logs").mkdir()
    for k in range(recordings):
        noise = np.random.default_rng(k).standard_normal((2, samples, 6))
        x = np.repeat([0.35, 4e-3], 3) * (noise[0] + 5e-3 * np.cumsum(noise[1], axis=0))
        pd.DataFrame(x, columns=AXES).to_parquet(folder / "logs" / f"unit_{k:03d}.parquet")
    # The first run compiles.
    runs = (("unit_00[01].parquet", 2), ("*.parquet", 1), ("*.parquet", 2))
    taken = []
    for k, (pattern, count) in enumerate(runs):
        options = {"--out": folder / str(k), "--workers": count, "--rate": 100}
        options |= {"--gyro-unit": "deg/s", "--accel-unit": "g"}
        program = [str(Path(sys.executable).with_name("allanjax")), "fleet", str(folder / "logs" / pattern)]
        begun = time.perf_counter()
        command = program + [str(part) for option in options.items() for part in option]
        subprocess.run(command, check=True, capture_output=True)
        taken.append(time.perf_counter() - begun)
    names = ["two recordings, nothing compiled yet", "1 worker", "2 workers"]
    yield table(["run", "seconds"], [[n, f"{s:.1f}"] for n, s in zip(names, taken, strict=True)])

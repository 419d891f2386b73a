"""Are the coefficients of tables 5.2, 5.4 and 5.5 of Hou (2004) recovered from simulated records?

Each record is analysed by `fit`, which is not told which terms there are; as the thesis did it, by lines of
fixed slope in the log-log plot of the Allan deviation, with the error of its (4.66); and by the slopes of the
power spectral density, as in its table 3.5. The truth is the thesis's own value.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

import allanjax as aj
from allanjax.record.units import unit_scale
from benchmarks.common.study import table
from benchmarks.studies.chapter3 import read_slope

QUICK: dict[str, Any] = {"hours": 0.1, "units": 1}


class Row(NamedTuple):
    """A coefficient of an axis: the thesis's value, and by each way a value, its error, whether it covers."""

    unit: str
    axis: str
    label: str
    truth: Any
    ways: dict[str, tuple[float, float, bool] | None]


def run(*, hours: float = 2.0, units: int = 3, seed: int = 1) -> Iterator[str]:
    rows: list[Row] = []
    spurious: list[str] = []
    for number, preset in enumerate(list(aj.SENSORS.values())[:units]):
        for recording in preset.simulate(3600.0 * hours, seed + number):
            more, beyond = analysed(preset, recording)
            rows += more
            spurious += [f"{preset.name} {name}" for name in beyond]
    yield f"{hours:g} h of each unit; ± is the standard error, * where 95 % intervals lack the truth."
    ways = list(rows[0].ways)
    shown = [
        [r.unit, r.axis, r.label.replace("_", " "), f"{r.truth.value:g} ± {r.truth.error:g} {r.truth.unit}"]
        + [cell(r.ways[way]) for way in ways]
        for r in rows
    ]
    yield table(["unit", "axis", "coefficient", "truth (thesis)", *ways], shown)
    lines = []
    for way in ways:
        found = [(r.ways[way], r.truth.value) for r in rows if r.ways[way] is not None]
        off = np.abs([w[0] / truth - 1.0 for w, truth in found])
        told = f"{100 * np.median(off):.3g} %", f"{100 * off.max():.3g} %"
        lines.append([way, f"{len(found)} of {len(rows)}", sum(w[2] for w, _ in found), *told])
    yield table(["way", "found", "truth in the 95 % interval", "median error", "largest"], lines)
    yield f"Terms that `fit` detects and that are not there: {', '.join(spurious) or 'none'}."


def analysed(preset: Any, recording: aj.Recording) -> tuple[list[Row], list[str]]:
    """Rows of a recording, and what was detected beyond the truth."""
    fit, curve = aj.fit(recording), aj.allan_deviation(recording)
    slopes = aj.power_spectrum(recording).readings()
    rows, beyond = [], []
    for column, axis in enumerate(recording.axes):
        coefficients = preset[axis.name].coefficients
        for term, truth in coefficients.items():
            label, value = term.name(), truth.value
            reading = read_slope(curve, column, term)
            read, error = (x / unit_scale(truth.unit) for x in (reading.value, reading.error))
            found = fit[axis.name][label] if fit[axis.name].converged else None
            by_fit = interval(found.in_unit(truth.unit), value) if found and found.detected else None
            slope = slopes[axis.name][label]
            ways = {
                "fit": by_fit,
                "slope of the Allan deviation": (read, error, abs(read - value) <= 1.96 * error),
                "slope of the PSD": None if slope is None else interval(slope.in_unit(truth.unit), value),
            }
            rows.append(Row(preset.name, axis.name, label, truth, ways))
        own = fit[axis.name].coefficients.values() if fit[axis.name].converged else ()
        true = {term.name() for term in coefficients}
        beyond += [f"{axis.name} {c.label}" for c in own if c.detected and c.label not in true]
    return rows, beyond


def interval(c: Any, truth: float) -> tuple[float, float, bool]:
    return c.value, c.std, c.interval[0] <= truth <= c.interval[1]


def cell(way: tuple[float, float, bool] | None) -> str:
    return "–" if way is None else f"{way[0]:.4g} ± {way[1]:.2g}{'' if way[2] else ' *'}"

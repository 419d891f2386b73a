"""Recover the coefficients of tables 5.2, 5.4 and 5.5 of Hou (2004) from simulated two-hour records.

    python benchmarks/studies/thesis_tables.py [--hours 2] [--seed 1] [--results PATH]

Each record is analysed twice: by `allanjax.fit`, which is not told which terms are there, and as the thesis
did it, by lines of fixed slope in the log-log plot of the Allan deviation, with the error of its (4.66); and
by the slopes of the power spectral density, as its table 3.5. The truth is the thesis's own value.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import paths

from allanjax.allan.deviation import allan_deviation
from allanjax.base.wording import format_with_error
from allanjax.estimate.fit import fit
from allanjax.noise.estimate import Estimate
from allanjax.noise.sensors import SENSORS, Tabulated
from allanjax.record.units import unit_scale
from allanjax.spectrum.psd import power_spectrum
from benchmarks.common.machine import describe
from benchmarks.common.readings import Reading, read_slope
from benchmarks.common.report import publish, table

# Table 3.5: angle random walk read off the density, deg/√h.
TABLE_3_5 = {("cimu", "gyro_x"): 0.0015, ("motionpak2", "gyro_x"): 0.5}


@dataclass(frozen=True)
class Row:
    """One coefficient of one axis: the table's figures, what the fit found (None: no result), the plot's."""

    sensor: str
    axis: str
    label: str
    truth: Tabulated
    found: Estimate | None
    reading: Reading
    slope: Estimate | None

    @property
    def slope_covers(self) -> bool:
        return self.slope is not None and self.slope.interval[0] <= self.truth.value <= self.slope.interval[1]

    @property
    def fit_covers(self) -> bool:
        if self.found is None:
            return False
        lower, upper = self.found.interval
        return lower <= self.truth.value <= upper

    @property
    def reading_covers(self) -> bool:
        return abs(self.reading.value - self.truth.value) <= 1.96 * self.reading.error


def analyse(hours: float, seed: int) -> Iterator[tuple[list[Row], str]]:
    """Rows and a line on the timing, for each simulated recording."""
    for number, preset in enumerate(SENSORS.values()):
        start = time.perf_counter()
        recordings = preset.simulate(3600.0 * hours, seed + number)
        simulated = time.perf_counter() - start
        for recording in recordings:
            start = time.perf_counter()
            result = fit(recording)
            fitted = time.perf_counter() - start
            curve = allan_deviation(recording)
            slopes = power_spectrum(recording).readings()
            rows = []
            for column, axis in enumerate(recording.axes):
                for term, truth in preset[axis.name].coefficients.items():
                    label, scale = term.name(), unit_scale(truth.unit)
                    found = (
                        result[axis.name][label].in_unit(truth.unit) if result[axis.name].converged else None
                    )
                    reading = read_slope(curve, column, term)
                    in_unit = Reading(reading.value / scale, reading.error / scale)
                    slope = slopes[axis.name][label]
                    slope = None if slope is None else slope.in_unit(truth.unit)
                    rows.append(Row(preset.name, axis.name, label, truth, found, in_unit, slope))
            extra = [
                f"{c.axis.name} {c.label}"
                for c in (c for axis in result.results if axis.converged for c in axis.coefficients.values())
                if c.detected and c.label not in {t.name() for t in preset[c.axis.name].coefficients}
            ]
            yield (
                rows,
                f"- {preset.name}, {len(recording.axes)} axes × {recording.n:,} samples at "
                f"{recording.rate:g} Hz: "
                f"fitted in {fitted:.1f} s (the unit was simulated in {simulated:.1f} s); "
                f"terms found that are not there: {', '.join(extra) or 'none'}",
            )


def comparison(rows: list[Row]) -> str:
    """The comparison in Markdown."""
    head = [
        "unit",
        "axis",
        "coefficient",
        "truth (thesis ± its error)",
        "fit ± 1σ",
        "95 % interval",
        "covers",
    ]
    lines = []
    for row in rows:
        found, reading, unit = row.found, row.reading, row.truth.unit
        digits = 2 - math.floor(math.log10(row.truth.value)) + 1
        if found is None:
            estimate, interval = "no result", ""
        else:
            estimate = format_with_error(found.value, found.std) if found.detected else "not detected"
            interval = " … ".join(f"{end:.5g}" for end in found.interval)
        lines.append(
            [
                row.sensor,
                row.axis,
                row.label.replace("_", " "),
                f"{row.truth.value:g} ± {row.truth.error:g} {unit}",
                estimate,
                interval,
                "yes" if row.fit_covers else "**no**",
                f"{reading.value:.{digits}f} ± {reading.error:.{digits}f}",
                "yes" if row.reading_covers else "**no**",
            ]
        )
    return table([*head, "slope reading ± (4.66)", "covers"], lines)


def density_table(rows: list[Row]) -> str:
    """What the slopes of the power spectral density give, in Markdown, beside table 3.5."""
    head = ["unit", "axis", "coefficient", "truth", "table 3.5", "slope of the PSD ± 1σ", "95 % interval"]
    lines = []
    for row in rows:
        printed = TABLE_3_5.get((row.sensor, row.axis)) if row.label == "angle_random_walk" else None
        cells = ["none", "", ""]
        if row.slope is not None:
            value = format_with_error(row.slope.value, row.slope.std)
            interval = " … ".join(f"{end:.5g}" for end in row.slope.interval)
            cells = [value, interval, "yes" if row.slope_covers else "**no**"]
        truth = f"{row.truth.value:g} {row.truth.unit}"
        name = row.label.replace("_", " ")
        lines.append([row.sensor, row.axis, name, truth, "" if printed is None else f"{printed:g}", *cells])
    read = [row for row in rows if row.slope is not None]
    errors = [abs(row.slope.value / row.truth.value - 1.0) for row in read if row.slope is not None]
    return (
        f"{table([*head, 'covers'], lines)}\n\n- {len(read)} of {len(rows)} coefficients were read; of these "
        f"the 95 % interval holds the truth for {sum(row.slope_covers for row in read)}. The median error is "
        f"{100 * np.median(errors):.3g} %, the largest {100 * np.max(errors):.3g} %."
    )


def summary(rows: list[Row]) -> str:
    """Counts of covered coefficients, and the typical errors."""
    count = len(rows)
    detected = [(row.found, row.truth) for row in rows if row.found is not None and row.found.detected]
    by_fit = [found.value / truth.value - 1.0 for found, truth in detected]
    by_slope = [row.reading.value / row.truth.value - 1.0 for row in rows]
    return "\n".join(
        (
            f"- Fit: the 95 % interval holds the truth for {sum(r.fit_covers for r in rows)} of {count} "
            f"coefficients. {len(detected)} were detected; their median error is "
            f"{100 * np.median(np.abs(by_fit)):.3g} %, the largest {100 * np.max(np.abs(by_fit)):.3g} %.",
            f"- Slope reading: value ± 1.96 × (4.66) holds it for {sum(r.reading_covers for r in rows)} "
            f"of {count}; the median error is {100 * np.median(np.abs(by_slope)):.3g} %, the largest "
            f"{100 * np.max(np.abs(by_slope)):.3g} %.",
        )
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--hours", type=float, default=2.0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--results", type=Path, default=paths.RESULTS / "thesis_tables.md")
    options = parser.parse_args()
    rows: list[Row] = []
    timings: list[str] = []
    for found, timing in analyse(options.hours, options.seed):
        rows += found
        timings.append(timing)
        print(timing, flush=True)
    text = (
        f"# The thesis's tables, recovered\n\n{options.hours:g} h simulated for each unit, "
        f"seed {options.seed}; the fit chooses among the five basic terms itself.\n\n"
        f"{comparison(rows)}\n\n{summary(rows)}\n\n## Slopes of the power spectral density (table 3.5)\n\n"
        "Read by `power_spectrum(recording).readings()`, each over an octave or more of its slope.\n\n"
        f"{density_table(rows)}\n\n## Time\n\n{chr(10).join(timings)}\n\n## Machine\n\n{describe()}\n"
    )
    publish(text, options.results)


if __name__ == "__main__":
    main()

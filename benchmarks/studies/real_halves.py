"""Does the extended model of one half of a real recording reproduce the other half, and what is told of it?

    python benchmarks/studies/real_halves.py [--data FOLDER] [--pictures FOLDER] [--results PATH]

Two units of the ADIS16405, six axes, 10⁶ samples at 100 Hz each. The first half is criticized; the second
half's Allan deviation at octaves is compared with that of the extended model and with the band that 95 % of
records of the model are in. Then the whole recording is criticized, and its story searched for what is known
of these sensors.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

import numpy as np
import paths
from scipy.stats import chi2

import allanjax as aj
from benchmarks.common.machine import describe
from benchmarks.common.report import publish, table

UNITS = ("adis16405_unit1", "adis16405_unit2")
# Cluster times below this one [s] have errors of their own, and how large these may be.
SHORT, WANTED = 1.0, 0.05
ACCELEROMETERS = {"accel_x", "accel_y", "accel_z"}
EVENTS = ("event", "disturbance", "variance_change", "outliers", "bias_step")


def expected(model: aj.Model, n: int, sizes: np.ndarray, rate: float) -> tuple[np.ndarray, np.ndarray]:
    """Allan deviations of the model, and the degrees of freedom of their squares' estimates.

    An estimate is a sum of the periodogram, whose ordinates are independent and exponential, by the gain of
    the differences of cluster means; this neglects only the record's ends.
    """
    f = np.arange(1, n // 2) * rate / n
    power = np.asarray(model.sampled_psd(f, rate))
    w = np.pi * f / rate
    degrees = []
    for m in sizes:
        parts = power * np.sin(m * w) ** 4 / (m * np.sin(w)) ** 2
        degrees.append(2.0 * parts.sum() ** 2 / np.sum(parts**2))
    return np.sqrt(np.asarray(model.sampled(rate).allan_variance(sizes / rate))), np.array(degrees)


def halves(recording: aj.Recording, first: aj.Critique) -> list[list[str]]:
    """A row for each axis: how the second half's Allan deviation compares with the model of the first."""
    middle = recording.duration / 2.0
    parts = [recording.between(0.0, middle), recording.between(middle)]
    before, after = (aj.allan_deviation(part, cluster_times="octave") for part in parts)
    times = after.cluster_time
    rows = []
    for k, (name, model) in enumerate(first.models.items()):
        deviation, degrees = expected(model, after.n, after.cluster_size, recording.rate)
        low, high = (np.sqrt(chi2.ppf(q, degrees) / degrees) for q in (0.025, 0.975))
        ratio, small = after.deviation[:, k] / deviation, times < SHORT
        inside = (low <= ratio) & (ratio <= high)
        # The logarithm of a deviation scatters by 1/√(2 degrees), that of a ratio of two by √2 times this.
        apart = np.abs(np.log(after.deviation[:, k] / before.deviation[:, k]))
        alike = apart < 1.96 / np.sqrt(degrees)
        outside = np.where(inside, 0.0, np.abs(np.log(ratio)))
        worst, short = int(np.argmax(outside)), int(np.argmax(small * np.abs(1.0 / ratio - 1.0)))
        rows.append(
            [
                recording.name,
                name,
                f"{inside.sum()} of {len(times)}",
                f"{inside[small].sum()} of {small.sum()}",
                f"{ratio[worst]:.3f} at {times[worst]:.4g} s" if outside[worst] else "–",
                f"{100.0 * (1.0 / ratio[short] - 1.0):+.1f} % at {times[short]:.2g} s",
                f"{alike.sum()} of {len(times)}",
            ]
        )
    return rows


# --- The story ---------------------------------------------------------------------------------------------


def _frequency(low: float, high: float) -> Callable[[aj.Finding], bool]:
    return lambda f: "frequency" in f.parameters and low <= f.parameters["frequency"].value <= high


def _line(f: aj.Finding) -> bool:
    return f.cause in ("sinusoid", "resonance") and _frequency(0.45, 0.65)(f) and {*f.axes} >= ACCELEROMETERS


KNOWN: dict[str, Callable[[aj.Finding], bool]] = {
    "the accelerometers' line near 0.55 Hz": _line,
    "with its harmonics": lambda f: _line(f) and "harmonics" in f.details,
    "the bandwidth": lambda f: f.cause == "low_pass",
    "gyro_z's resonance near 20 Hz": lambda f: (
        f.cause == "resonance" and _frequency(18.0, 22.0)(f) and "gyro_z" in f.axes
    ),
    "a resonance near 10 Hz": lambda f: f.cause == "resonance" and _frequency(8.0, 12.0)(f),
    "rounding": lambda f: f.cause == "rounding",
    "events by time": lambda f: f.cause in EVENTS,
}


def told(critique: aj.Critique) -> list[aj.Finding]:
    return [f for f in critique.findings if f.cause != "unexplained"]


def says(critique: aj.Critique, is_it: Callable[[aj.Finding], bool]) -> str:
    """The places in the story of the findings of this kind; ten are printed."""
    found = [str(k) for k, f in enumerate(told(critique), 1) if is_it(f)]
    return f"finding{'s' if len(found) > 1 else ''} {', '.join(found)}" if found else "no"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, default=paths.DATA, help="by default $ALLANJAX_DATA")
    parser.add_argument("--pictures", type=Path, help="folder for the pictures of the whole recordings")
    parser.add_argument("--results", type=Path, default=paths.RESULTS / "real_halves.md")
    arguments = parser.parse_args()
    if arguments.data is None:
        parser.error("the folder of the recordings is not known: give --data or set ALLANJAX_DATA")
    aj.enable_compilation_cache()
    rows, stories = [], {}
    for unit in UNITS:
        recording = aj.read(arguments.data / f"{unit}.parquet", rate=100, gyro_unit="deg/s", accel_unit="g")
        rows += halves(recording, aj.critique(recording.between(0.0, recording.duration / 2.0)))
        stories[unit] = aj.critique(recording)
        if arguments.pictures:
            stories[unit].plot(arguments.pictures / unit)
    publish(report(rows, stories), arguments.results)


def report(rows: list[list[str]], stories: dict[str, aj.Critique]) -> str:
    head = ["unit", "axis", "inside", "below 1 s", "worst outside", "model off below 1 s", "halves alike"]
    counts = [
        ["findings", *(str(len(told(c))) for c in stories.values())],
        ["lines that are printed", *(str(len(str(c).splitlines())) for c in stories.values())],
        *([text, *(says(c, is_it) for c in stories.values())] for text, is_it in KNOWN.items()),
    ]
    return "\n".join(
        [
            "# One half of a real recording by the extended model of the other",
            "",
            describe(),
            "",
            "The first half is criticized, and the second half's Allan deviation at each octave is compared",
            "with that of the extended model. Inside: cluster times, of all and of those below 1 s, at which",
            "it is in the band that 95 % of records of the model are in, by χ² laws whose degrees of freedom",
            "follow from its spectrum. The band is the model's own: it does not know how uncertain the",
            "coefficients are; a step or a ramp of the first half is no part of it. Worst outside: measured",
            "over model where it is outside and differs most. Model off: largest error of the model's",
            f"deviation below 1 s (wanted: within {100 * WANTED:.0f} % for gyro_z). Halves alike: cluster",
            "times at which the two measured halves differ by no more than two records of the model do with",
            "95 %.",
            "",
            table(head, rows),
            "",
            "## What the story of the whole recording says",
            "",
            "Findings are numbered by how much they change; `print` tells ten.",
            "",
            table(["", *stories], counts),
            "",
            *(f"### {unit}\n\n```\n{critique}\n```\n" for unit, critique in stories.items()),
        ]
    )


if __name__ == "__main__":
    main()

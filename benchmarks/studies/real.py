"""Does the extended model of one half of a real recording reproduce the other, and do both objectives agree?

Two units of the ADIS16405, six axes, 10⁶ samples at 100 Hz each. The first half is criticized, and the second
half's Allan deviation at each octave is compared with that of the extended model. *Inside*: cluster times, of
all and of those below 1 s, at which it is in the band that 95 % of records of the model are in, by χ² laws
whose degrees of freedom follow from its spectrum. The band does not know how uncertain the coefficients are;
a step or a ramp of the first half is no part of it. *Worst outside*: measured over model where it is outside
and differs most. *Halves alike*: cluster times at which the two measured halves differ by no more than two
records of the model do with 95 %.

The objectives: N + B + K fitted to means over 0.1 s (gyros) and 2 s (accelerometers), which leave out what
these terms do not describe, by Allan deviation and spectrum; apart: the distance of the two in joint standard
deviations.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from scipy.stats import chi2

import allanjax as aj
from benchmarks.common.study import data, table

QUICK: dict[str, Any] = {"units": 1, "samples": 16_384, "critiques": False}
SHORT, COARSE = 1.0, {"gyro": 10, "accel": 200}
ACCELEROMETERS = {"accel_x", "accel_y", "accel_z"}


def run(*, units: int = 2, samples: int = 1_000_000, critiques: bool = True) -> Iterator[str]:
    aj.enable_compilation_cache()
    recordings = [
        aj.read(data(f"adis16405_unit{k}.parquet"), rate=100, gyro_unit="deg/s", accel_unit="g")
        for k in (1, 2)
    ]
    recordings = [r.between(0.0, samples / r.rate) for r in recordings[:units]]
    rows = []
    for recording in recordings:
        for sensor, size in COARSE.items():
            names = [axis.name for axis in recording.axes if axis.sensor == sensor]
            rows += objectives(averaged(recording.select(*names), size))
    head = ["unit", "rate", "axis", "coefficient", "Allan", "Whittle", "apart [σ]", "model off [%]"]
    yield "## Both objectives\n\n" + table(head, rows)
    if not critiques:
        return
    rows, stories = [], {}
    for recording in recordings:
        rows += halves(recording, aj.critique(recording.between(0.0, recording.duration / 2.0)))
        stories[recording.name] = aj.critique(recording)
    head = ["unit", "axis", "inside", "below 1 s", "worst outside", "model off below 1 s", "halves alike"]
    yield "## Halves\n\n" + table(head, rows)
    counts = [["findings", *(str(len(told(c))) for c in stories.values())]]
    counts += [[text, *(says(c, is_it) for c in stories.values())] for text, is_it in KNOWN.items()]
    yield "## What the story of the whole recording says\n\n" + table(["", *stories], counts)
    for unit, critique in stories.items():
        yield f"### {unit}\n\n```\n{critique}\n```"


def averaged(recording: aj.Recording, size: int) -> aj.Recording:
    n = recording.n // size * size
    values = recording.values[:n].reshape(-1, size, len(recording.axes)).mean(axis=1)
    return aj.Recording(values, recording.rate / size, recording.axes, name=recording.name)


def objectives(recording: aj.Recording) -> list[list[str]]:
    """One row an axis and coefficient: both estimates, and their difference in standard deviations."""
    fits = [aj.fit(recording, "N + B + K", objective, as_is=True) for objective in ("allan", "whittle")]
    found = []
    for axis in recording.axes:
        allan, whittle = (fit[axis.name] for fit in fits)
        off = f"{100 * allan.discrepancy:.1f}, {100 * whittle.discrepancy:.1f}"
        for label, a in allan.coefficients.items():
            w = whittle[label]
            # The same data: their difference scatters less than either, so this is a lenient scale.
            sigmas = (w.value - a.value) / np.hypot(a.std, w.std)
            apart = f"{sigmas:+.2f}" if a.detected and w.detected else "–"
            shown = [c.in_unit().describe() for c in (a, w)]
            found.append([recording.name, f"{recording.rate:g} Hz", axis.name, a.title, *shown, apart, off])
    return found


def expected(model: aj.Model, n: int, sizes: np.ndarray, rate: float) -> tuple[np.ndarray, np.ndarray]:
    """Allan deviations of the model, and the degrees of freedom of their squares' estimates.

    An estimate is a sum of the periodogram, whose ordinates are independent and exponential, by the gain of
    the differences of cluster means; this neglects only the record's ends.
    """
    f = np.arange(1, n // 2) * rate / n
    power, w = np.asarray(model.sampled_psd(f, rate)), np.pi * f / rate
    parts = (power * np.sin(m * w) ** 4 / (m * np.sin(w)) ** 2 for m in sizes)
    degrees = np.array([2.0 * p.sum() ** 2 / np.sum(p**2) for p in parts])
    return np.sqrt(np.asarray(model.sampled(rate).allan_variance(sizes / rate))), degrees


def halves(recording: aj.Recording, first: aj.Critique) -> list[list[str]]:
    """A row for each axis: how the second half's Allan deviation compares with the model of the first."""
    middle = recording.duration / 2.0
    parts = [recording.between(0.0, middle), recording.between(middle)]
    before, after = (aj.allan_deviation(part, cluster_times="octave") for part in parts)
    times, rows = after.cluster_time, []
    for k, (name, model) in enumerate(first.models.items()):
        deviation, degrees = expected(model, after.n, after.cluster_size, recording.rate)
        low, high = (np.sqrt(chi2.ppf(q, degrees) / degrees) for q in (0.025, 0.975))
        ratio, small = after.deviation[:, k] / deviation, times < SHORT
        inside = (low <= ratio) & (ratio <= high)
        # The logarithm of a deviation scatters by 1/√(2 degrees), that of a ratio of two by √2 times this.
        alike = np.abs(np.log(after.deviation[:, k] / before.deviation[:, k])) < 1.96 / np.sqrt(degrees)
        outside = np.where(inside, 0.0, np.abs(np.log(ratio)))
        worst, short = int(np.argmax(outside)), int(np.argmax(small * np.abs(1.0 / ratio - 1.0)))
        counts = [f"{inside.sum()} of {len(times)}", f"{inside[small].sum()} of {small.sum()}"]
        off = [f"{ratio[worst]:.3f} at {times[worst]:.4g} s" if outside[worst] else "–"]
        off += [f"{100.0 * (1.0 / ratio[short] - 1.0):+.1f} % at {times[short]:.2g} s"]
        rows.append([recording.name, name, *counts, *off, f"{alike.sum()} of {len(times)}"])
    return rows


def _frequency(f: aj.Finding, low: float, high: float) -> bool:
    return "frequency" in f.parameters and low <= f.parameters["frequency"].value <= high


def _line(f: aj.Finding) -> bool:
    return f.cause in ("sinusoid", "resonance") and _frequency(f, 0.45, 0.65) and {*f.axes} >= ACCELEROMETERS


EVENTS = ("event", "disturbance", "variance_change", "outliers", "bias_step")
#: What is known of these sensors.
KNOWN: dict[str, Callable[[aj.Finding], bool]] = {
    "the accelerometers' line near 0.55 Hz": _line,
    "with its harmonics": lambda f: _line(f) and "harmonics" in f.details,
    "the bandwidth": lambda f: f.cause == "low_pass",
    "gyro_z's resonance near 20 Hz": lambda f: (
        f.cause == "resonance" and _frequency(f, 18.0, 22.0) and "gyro_z" in f.axes
    ),
    "a resonance near 10 Hz": lambda f: f.cause == "resonance" and _frequency(f, 8.0, 12.0),
    "rounding": lambda f: f.cause == "rounding",
    "events by time": lambda f: f.cause in EVENTS,
}


def told(critique: aj.Critique) -> list[aj.Finding]:
    return [f for f in critique.findings if f.cause != "unexplained"]


def says(critique: aj.Critique, is_it: Callable[[aj.Finding], bool]) -> str:
    """The places of the findings of this kind among all, by how much they change; ten are printed."""
    found = [str(k) for k, f in enumerate(told(critique), 1) if is_it(f)]
    return f"finding{'s' if len(found) > 1 else ''} {', '.join(found)}" if found else "no"

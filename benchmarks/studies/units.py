"""Are wrong units noticed and right ones believed, of gyros and accelerometers, in records and in curves?

The probabilities in `inspection/units.py` were set on seeds below 100,000; results are of seeds from a million
on. Sensors are drawn from navigation to consumer grade, both of one grade or of neighbouring ones: noise,
biases and the share of samples that are rounded to the steps of a common sensor as they are drawn in
`common/hidden_sensors.py` and below. Records have 60 s at 50 to 400 Hz at any attitude; a tenth are without
gravity, as simulations are; some have only gyros, only accelerometers, or one axis of each. Their labels are
right or wrong, in one of the ways that are listed.

*Named*: the true unit is the one that is proposed. *Doubted*: the label is doubted, without a unit or with
another one. *Missed*: nothing is said of this sensor. *Also*: the other sensor, whose label is right, is
doubted, too. A wrong label that makes a sensor of another grade, as rad/s over deg/s makes a consumer gyro
of 2 deg/√h one of 115 deg/√h but deg/s over rad/s makes it a fibre-optic gyro of 0.03 deg/√h, can only be
noticed beside the other sensor.
"""

from __future__ import annotations

import tempfile
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import allanjax as aj
from benchmarks.common.hidden_sensors import GRADES, log_uniform
from benchmarks.common.study import run_tasks, table

QUICK: dict[str, Any] = {"right": 20, "wrong": 2, "curves": 2}
NAMES = tuple(f"{sensor}_{axis}" for sensor in ("gyro", "accel") for axis in "xyz")
ORDER = ("navigation", "tactical", "consumer")
DEG, G = np.pi / 180.0, 9.80665
SECONDS = 60.0
AXES = ("all axes", "gyros", "accelerometers", "one axis of each")
Pair = tuple[str, str]
# Units by their factor to SI; those of increments are times the rate, counts have the step of the sensor.
SCALES = {"rad/s": 1.0, "deg/s": DEG, "mdeg/s": DEG / 1e3, "deg/h": DEG / 3600.0}
SCALES |= {"m/s²": 1.0, "g": G, "mg": G / 1e3, "µg": G / 1e6}
INCREMENTS = {"rad": 1.0, "deg": DEG, "m/s": 1.0}
# Steps of common sensors [deg/s and g].
STEPS = {"gyro": (1.0 / 131.0, 1.0 / 16.4, 0.00875, 0.07), "accel": (1.0 / 16384.0, 1.0 / 2048.0, 0.061e-3)}
# Standard deviations of the biases of the axes of an accelerometer [g].
ACCEL_BIASES = {"navigation": 1e-4, "tactical": 1e-3, "consumer": 0.02}
# True units of gyros and accelerometers, and what the labels say.
RIGHT: tuple[Pair, ...] = (
    *(("deg/s", "g"), ("rad/s", "m/s²"), ("deg/s", "m/s²"), ("rad/s", "g"), ("mdeg/s", "mg")),
    *(("rad", "m/s"), ("deg", "m/s"), ("deg/h", "µg")),
)
RIGHT_CURVES: tuple[Pair, ...] = (("deg/s", "g"), ("rad/s", "m/s²"), ("deg/h", "µg"), ("deg/h", "m/s²"))
# True units, and labels of which both are wrong, that of the gyros, or that of the accelerometers.
WRONG: tuple[tuple[Pair, Pair], ...] = (
    *((("deg/s", "g"), ("rad/s", "m/s²")), (("rad/s", "m/s²"), ("deg/s", "g"))),
    *((("mdeg/s", "mg"), ("deg/s", "g")), (("mdeg/s", "mg"), ("rad/s", "m/s²"))),
    *((("rad", "m/s"), ("rad/s", "m/s²")), (("deg", "m/s"), ("deg/s", "m/s²"))),
    *((("counts", "counts"), ("deg/s", "g")), (("counts", "counts"), ("rad/s", "m/s²"))),
    *((("deg/s", "g"), ("rad/s", "g")), (("deg/s", "m/s²"), ("rad/s", "m/s²"))),
    *((("rad/s", "m/s²"), ("deg/s", "m/s²")), (("mdeg/s", "g"), ("deg/s", "g"))),
    *((("deg/h", "g"), ("deg/s", "g")), (("deg/s", "g"), ("deg/h", "g"))),
    *((("deg/s", "g"), ("deg/s", "m/s²")), (("rad/s", "m/s²"), ("rad/s", "g"))),
    *((("deg/s", "mg"), ("deg/s", "g")), (("rad/s", "m/s"), ("rad/s", "m/s²"))),
)
WRONG_CURVES: tuple[tuple[Pair, Pair], ...] = (
    *((("deg/s", "g"), ("rad/s", "m/s²")), (("deg/h", "µg"), ("deg/s", "g"))),
    *((("deg/s", "g"), ("deg/h", "g")), (("deg/h", "g"), ("deg/s", "g"))),
    *((("rad/s", "m/s²"), ("deg/s", "m/s²")), (("deg/s", "m/s²"), ("rad/s", "m/s²"))),
    *((("deg/h", "µg"), ("deg/h", "m/s²")), (("deg/h", "g"), ("deg/h", "m/s²"))),
    *((("deg/h", "mg"), ("deg/h", "µg")),),
)


class Drawn(NamedTuple):
    """Samples [n, 6] in SI, white noise of the axes [rad/√s, m/s/√s], rate [Hz], steps in SI, and grade."""

    values: np.ndarray
    white: np.ndarray
    rate: float
    steps: dict[str, float]
    grade: str


def draw(seed: int) -> Drawn:
    rng = np.random.default_rng([seed, 61])
    rate, first = float(rng.choice([50.0, 100.0, 125.0, 200.0, 400.0])), int(rng.integers(3))
    second = int(np.clip(first + rng.choice([0, 0, 0, -1, 1]), 0, 2))
    n, columns, white, steps = round(SECONDS * rate), [], [], {}
    attitude = rng.standard_normal(3)
    attitude = np.eye(3)[rng.integers(3)] if rng.random() < 0.7 else attitude / np.linalg.norm(attitude)
    gravity = G * attitude * (rng.random() > 0.1)
    for sensor, level in (("gyro", first), ("accel", second)):
        limits, bias = GRADES[sensor, ORDER[level]]
        noise = log_uniform(rng, *limits)
        mean = gravity + G * ACCEL_BIASES[ORDER[level]] * rng.standard_normal(3)
        if sensor == "gyro":
            turned = rng.standard_normal(3)
            mean = bias * rng.standard_normal(3) + 7.292e-5 * turned / np.linalg.norm(turned)
        each = noise * rng.uniform(0.7, 1.4, 3)
        x = mean + each * np.sqrt(rate) * rng.standard_normal((n, 3))
        step = float(rng.choice(STEPS[sensor])) * (DEG if sensor == "gyro" else G)
        # Finer than the noise, as a designer chooses it.
        step *= 2.0 ** min(0, np.floor(np.log2(noise * np.sqrt(rate) / step)))
        steps[sensor] = step
        columns.append(np.rint(x / step) * step if rng.random() < 0.5 else x)
        white += [*each]
    return Drawn(np.hstack(columns), np.array(white), rate, steps, f"{ORDER[first]}")


def scale(unit: str, drawn: Drawn, sensor: str) -> float:
    """Factor of samples in a unit to SI rates."""
    if unit == "counts":
        return drawn.steps[sensor]
    return INCREMENTS[unit] * drawn.rate if unit in INCREMENTS else SCALES[unit]


def labelled(drawn: Drawn, true: Pair, label: Pair, axes: str) -> aj.Recording:
    """A table with times, numbers in the true units and these labels."""
    per = np.repeat([scale(unit, drawn, sensor) for unit, sensor in zip(true, ("gyro", "accel"))], 3)
    numbers = drawn.values / per
    if "counts" in true:
        numbers = np.rint(numbers)
    labels = [f"{name} [{unit}]" for name, unit in zip(NAMES, 3 * label[:1] + 3 * label[1:], strict=True)]
    kept = {"gyros": range(3), "accelerometers": range(3, 6), "one axis of each": (2, 5)}.get(axes, range(6))
    times = {"time [s]": np.arange(len(numbers)) / drawn.rate}
    return aj.Recording.from_dataframe(times | {labels[k]: numbers[:, k] for k in kept})


def curve(drawn: Drawn, true: Pair, label: Pair) -> aj.AllanDeviation:
    """A curve of octaves up to 10 s, as another program writes it."""
    tau = 2.0 ** np.arange(np.floor(np.log2(10.0 * drawn.rate))) / drawn.rate
    per = np.repeat([SCALES[unit] for unit in true], 3)
    labels = [f"{name} [{unit}]" for name, unit in zip(NAMES, 3 * label[:1] + 3 * label[1:], strict=True)]
    rows = np.column_stack([tau, drawn.white / np.sqrt(tau)[:, None] / per])
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "curve.csv"
        np.savetxt(path, rows, "%.9g", ",", header=",".join(["tau [s]", *labels]), comments="")
        return aj.read_curve(path, drawn.rate, SECONDS)


Said = dict[str, str]


def judged(facts: Any, true: Pair, label: Pair, sensors: set[str]) -> Said:
    """What is said of the unit of each sensor."""
    found = {}
    for sensor, unit, own in zip(("gyro", "accel"), true, label, strict=True):
        texts = [fact.text for fact in facts if fact.kind == f"{sensor} unit"]
        advice = [text.partition("; ")[2] for text in texts]
        named = "probably counts" if unit == "counts" else f"pass --{sensor}-unit {unit.replace('²', '^2')}"
        proposed = [text.partition(", or")[0] for text in advice]
        if sensor in sensors and unit == own:
            found[sensor] = "doubted" if texts else "believed"
        elif sensor in sensors:
            right = any(text.endswith(named) or "counts" in named in text for text in proposed)
            found[sensor] = "named" if right else "doubted" if texts else "missed"
    return found


def of_record(seed: int, true: Pair, label: Pair, axes: str) -> tuple[str, Said]:
    drawn = draw(seed)
    recording = labelled(drawn, true, label, axes)
    sensors = {axis.sensor for axis in recording.axes}
    return drawn.grade, judged(aj.inspect(recording).facts, true, label, sensors)


def of_curve(seed: int, true: Pair, label: Pair) -> tuple[str, Said]:
    drawn = draw(seed)
    return drawn.grade, judged(aj.fit(curve(drawn, true, label), "N").facts, true, label, {"gyro", "accel"})


def run(*, right: int = 400, wrong: int = 60, curves: int = 60, seed: int = 1_000_000) -> Iterator[str]:
    """Right: records of each kind, and curves, with right labels; wrong, curves: of each error."""
    rows = []
    for k, axes in enumerate((*AXES, "curves")):
        pairs, function = (RIGHT, of_record) if axes in AXES else (RIGHT_CURVES, of_curve)
        more = (axes,) if axes in AXES else ()
        first = seed + right * k
        tasks = [(first + j, pairs[j % len(pairs)], pairs[j % len(pairs)], *more) for j in range(right)]
        found = run_tasks(function, tasks)
        alarms = [task for task, (_, said) in zip(tasks, found, strict=True) if "doubted" in said.values()]
        which = "; ".join(f"{task[0]}: {', '.join(task[1])}" for task in alarms)
        rows.append([axes, right, len(alarms), which])
    yield "## Right labels\n\n" + table(["axes", "records", "alarms", "which"], rows)
    head = ["true", "label", "sensor", *ORDER, "also"]
    for title, errors, function, count in (
        ("records", WRONG, of_record, wrong),
        ("curves", WRONG_CURVES, of_curve, curves),
    ):
        more = AXES[:1] if title == "records" else ()
        rows = []
        for k, (true, label) in enumerate(errors):
            tasks = [(seed + 10_000 * (k + 1) + j, true, label, *more) for j in range(count)]
            rows += rows_of(true, label, run_tasks(function, tasks))
        yield f"## Wrong labels of {title}\n\n" + table(head, rows)


def rows_of(true: Pair, label: Pair, found: Sequence[tuple[str, Said]]) -> Iterator[list[object]]:
    """Yield, of each sensor with a wrong label, how often it is named, doubted or missed, by grade."""
    for k, sensor in enumerate(("gyro", "accel")):
        if true[k] == label[k]:
            continue
        counts = []
        for grade in ORDER:
            said = Counter(each[sensor] for own, each in found if own == grade)
            counts.append(" / ".join(str(said[word]) for word in ("named", "doubted", "missed")))
        other = ("accel", "gyro")[k]
        also = sum(each[other] == "doubted" for _, each in found) if true[1 - k] == label[1 - k] else "–"
        yield [", ".join(true), ", ".join(label), sensor, *counts, also]

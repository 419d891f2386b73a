"""Are wrong units noticed and right ones believed, of gyros and accelerometers, in records and in curves?

The probabilities in `inspection/units.py` were set on seeds below 10,000; results are of seeds from a million
on. Sensors are of navigation, tactical and consumer grade, with noise and biases of the gyros as in
`common/hidden_sensors.py`. An eighth of the accelerometers is of the next better grade than the gyros, and an
eighth of the next worse, as long as the ratio of their noise is no more than twice beyond that of units that
were tested. Half of the outputs are rounded to steps of a common sensor. Records have 40 s at 50 to 200 Hz,
at any attitude; a tenth are without gravity, as simulations are. Curves are those of white noise.

Of a sensor whose label is wrong, by the grade of the gyros: how often the true unit is proposed / the label
is doubted without that / nothing is said. *Also*: how often the other sensor, whose label is right, is
doubted, too. Some errors only make a sensor of another grade: rad/s over deg/s makes a tactical gyro of
0.05 deg/√h one of 2.9 deg/√h, and without gravity an accelerometer in g is a better one in m/s².
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

QUICK: dict[str, Any] = {"right": 8, "wrong": 1, "curves": 1}
NAMES = tuple(f"{sensor}_{axis}" for sensor in ("gyro", "accel") for axis in "xyz")
ORDER = ("navigation", "tactical", "consumer")
DEG, G = np.pi / 180.0, 9.80665
SECONDS = 40.0
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
# Ratios of the noise of gyros [deg/√h] and accelerometers [m/s/√h]; of units that were tested, 0.17 to 30.
# Accelerometers with less noise than 0.03 m/s/√h may be beside better gyros.
LEAST, MOST = 0.12, 60.0
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
    rate, first = float(rng.choice([50.0, 100.0, 125.0, 200.0])), int(rng.integers(3))
    second = int(np.clip(first + rng.choice([0, 0, 0, 0, 0, 0, -1, 1]), 0, 2))
    noises = {}
    while not noises or not LEAST * min(noises["accel"] * 60.0 / 0.03, 1.0) < ratio(noises) < MOST:
        levels = {"gyro": first, "accel": second}
        noises = {k: log_uniform(rng, *GRADES[k, ORDER[level]][0]) for k, level in levels.items()}
    n, columns, white, steps = round(SECONDS * rate), [], [], {}
    attitude = rng.standard_normal(3)
    attitude = np.eye(3)[rng.integers(3)] if rng.random() < 0.7 else attitude / np.linalg.norm(attitude)
    gravity = G * attitude * (rng.random() > 0.1)
    for sensor, level in (("gyro", first), ("accel", second)):
        noise, bias = noises[sensor], GRADES[sensor, ORDER[level]][1]
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


def ratio(noises: dict[str, float]) -> float:
    """Noise of gyros [deg/√h] per that of accelerometers [m/s/√h]."""
    return noises["gyro"] / DEG / noises["accel"]


def scale(unit: str, drawn: Drawn, sensor: str) -> float:
    """Factor of samples in a unit to SI rates."""
    if unit == "counts":
        return drawn.steps[sensor]
    return INCREMENTS[unit] * drawn.rate if unit in INCREMENTS else SCALES[unit]


def labelled(drawn: Drawn, true: Pair, label: Pair, axes: str) -> aj.Recording:
    """A table with times, numbers in the true units and these labels."""
    per = np.repeat(
        [scale(unit, drawn, sensor) for unit, sensor in zip(true, ("gyro", "accel"), strict=True)], 3
    )
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
        doubts = [fact for fact in facts if fact.kind == f"{sensor} unit"]
        named = f"pass --{sensor}-unit {unit.replace('²', '^2')},"
        if sensor in sensors and unit == own:
            found[sensor] = "doubted" if doubts else "believed"
        elif sensor in sensors and unit == "counts":
            found[sensor] = "named" if any("counts" in doubt.meaning for doubt in doubts) else "missed"
        elif sensor in sensors:
            right = any(f"{doubt.remedy},".startswith(named) for doubt in doubts)
            found[sensor] = "named" if right else "doubted" if doubts else "missed"
    return found


def said_of(seed: int, true: Pair, label: Pair, axes: str) -> tuple[str, Said]:
    """Grade of the gyros that are drawn, and what is said of the units of a record or a curve."""
    drawn = draw(seed)
    if axes == "curves":
        fit = aj.fit(curve(drawn, true, label), "N")
        return drawn.grade, judged(fit.facts, true, label, {"gyro", "accel"})
    recording = labelled(drawn, true, label, axes)
    return drawn.grade, judged(aj.inspect(recording).facts, true, label, {a.sensor for a in recording.axes})


def run(*, right: int = 600, wrong: int = 60, curves: int = 60, seed: int = 1_000_000) -> Iterator[str]:
    """Right: records of each kind, and curves, with right labels; wrong, curves: of each error."""
    believed = [(axes, pairs) for axes, pairs in (*((a, RIGHT) for a in AXES), ("curves", RIGHT_CURVES))]
    errors = [("all axes", wrong, *pair) for pair in WRONG] + [
        ("curves", curves, *pair) for pair in WRONG_CURVES
    ]
    tasks: list[tuple[int, Pair, Pair, str]] = []
    for axes, pairs in believed:
        units = [pairs[j % len(pairs)] for j in range(right)]
        tasks += [(seed + len(tasks) + j, unit, unit, axes) for j, unit in enumerate(units)]
    for axes, count, true, label in errors:
        tasks += [(seed + len(tasks) + j, true, label, axes) for j in range(count)]
    found = list(zip(tasks, run_tasks(said_of, tasks), strict=True))
    rows: list[list[object]] = []
    for axes, _ in believed:
        alarms = [task for task, (_, said) in found[:right] if "doubted" in said.values()]
        which = "; ".join(f"{task[0]}: {', '.join(task[1])}" for task in alarms)
        rows.append([axes, right, len(alarms), which])
        found = found[right:]
    yield "## Right labels\n\n" + table(["axes", "records", "alarms", "which"], rows)
    rows = []
    for axes, count, true, label in errors:
        rows += rows_of(axes, true, label, [said for _, said in found[:count]])
        found = found[count:]
    head = ["of", "true", "label", "sensor", *ORDER, "also"]
    yield "## Wrong labels\n\n" + table(head, rows)


def rows_of(axes: str, true: Pair, label: Pair, found: Sequence[tuple[str, Said]]) -> Iterator[list[object]]:
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
        kind = "curves" if axes == "curves" else "records"
        yield [kind, ", ".join(true), ", ".join(label), sensor, *counts, also]

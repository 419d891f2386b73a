"""What a fact advises is done: the fit that follows has the noise of the sensor, or says why it has none."""

import re

import numpy as np
import pytest

import allanjax as aj

RATE, N = 100.0, 30_000
#: White noise of the gyros [deg/s/√Hz] and of the accelerometers [g/√Hz], of consumer sensors.
GYRO, ACCEL = 0.008, 2e-4
NAMES = ("gx", "gy", "gz", "ax", "ay", "az")
UNITS = {"gyro": "deg/s", "accel": "g"}
#: Options of `read`; all others are those of `fit`.
READING = ("start", "stop", "rate", "time", "time_unit", "gyro_unit", "accel_unit", "gaps", "columns")
TIME = np.arange(N) / RATE


def at_rest():
    noise = np.random.default_rng(61).standard_normal((N, 6)) * np.repeat([GYRO, ACCEL], 3) * np.sqrt(RATE)
    return np.add(noise, [0.1, -0.2, 0.05, 0.01, -0.02, 1.0])


def in_si(x):
    x *= np.repeat([np.pi / 180.0, 9.80665], 3)


def engine(x):
    x[N // 4 :] += 40.0 * (at_rest()[N // 4 :][::-1] - at_rest().mean(axis=0))


def turned(x):
    x[:, :3] += 30.0 * np.sin(TIME / 5.0)[:, None]


def clipped(x):
    x[:, 0] = np.clip(x[:, 0], None, 0.12)


def warm(x):
    x[:, 0] += 0.5 * np.sin(TIME / 40.0)


#: Each case: what happens to the samples, units of the labels, kind of the fact, and further columns.
CASES = {
    "degrees under rad": (None, ("rad/s", "m/s²"), "gyro unit", {}),
    "g under m/s²": (None, ("deg/s", "m/s²"), "accel unit", {}),
    "radians under deg": (in_si, None, "gyro unit", {}),
    "loud engine": (engine, None, "disturbances", {}),
    "turned": (turned, None, "at rest", {}),
    "clipped": (clipped, None, "saturation", {}),
    "temperature": (warm, None, "temperature", {"temp": np.sin(TIME / 40.0)}),
}


def advised(fact):
    """Options of each piece of advice; None for a value that users know."""
    text = re.sub(r"\([^()]*\)", "", fact.remedy)
    for clause in re.split(r"; |,? or |, (?=--)", text):
        options = re.findall(r"--([a-z-]+)(?: (?!and\b)([^\s,;-][^\s,;]*))?", clause)
        if options:
            yield {name.replace("-", "_"): value or None for name, value in options}


def fitted(path, options):
    """The fit of a file with options of reading and fitting."""
    known = {"rate": RATE} | options
    recording = aj.read(path, **{name: value for name, value in known.items() if name in READING})
    return aj.fit(recording, **{name: value for name, value in known.items() if name not in READING})


@pytest.mark.parametrize("case", CASES)
def test_what_a_fact_advises_leads_to_the_noise_of_the_sensor(case, tmp_path):
    change, labels, kind, more = CASES[case]
    x = at_rest()
    if change is not None:
        change(x)
    labels = labels or tuple(UNITS.values())
    heads = [f"{name} [{labels[k // 3]}]" for k, name in enumerate(NAMES)]
    table = np.column_stack([x, *more.values()])
    path = tmp_path / "imu.csv"
    np.savetxt(path, table, fmt="%.9g", delimiter=",", header=",".join([*heads, *more]), comments="")
    found = {fact.kind: fact for fact in aj.inspect(aj.read(path, rate=RATE)).facts}
    steps = [*advised(found[kind])]
    assert steps or kind == "saturation"
    for options in steps:
        # A part at rest, which the user knows: there is none.
        if None in options.values() and "vibrating" not in options and "as_is" not in options:
            continue
        given = {name: True if value is None else value for name, value in options.items()}
        given |= {name: float(value) for name, value in given.items() if name in ("start", "stop", "rate")}
        fit = fitted(path, given)
        confirmed = any(given.get(f"{s}_unit") == label for s, label in zip(UNITS, labels, strict=True))
        whole = {"as_is", "vibrating"} & given.keys() or confirmed or case == "loud engine"
        for axis in fit.axes:
            sensor = axis[:-2]
            if not whole and sensor == found[kind].axes[0][:-2]:
                true = {"gyro": GYRO * np.pi / 180.0, "accel": ACCEL * 9.80665}[sensor]
                # Of 30,000 samples N is known to 1 %.
                assert fit[axis]["N"].value == pytest.approx(true, rel=0.05), (options, axis)
            assert fit[axis].converged, (options, axis)

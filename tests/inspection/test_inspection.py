"""What an inspection reports of a recording before its coefficients are estimated."""

import json
import re

import bench
import numpy as np
import pandas as pd
import pytest
import scipy.signal
from commands import run, without_progress
from golden_records import CLEAN, PLAIN, SHAPED
from numpy.testing import assert_allclose

import allanjax as aj

RATE, N = 100.0, 30_000
NAMES = ("gyro_x", "gyro_y", "gyro_z", "accel_x", "accel_y", "accel_z")
DEG, G = np.pi / 180.0, 9.80665
# White noise of a consumer sensor from sample to sample at 100 Hz, unequal, and its means with gravity.
SIGMA = np.array([0.1 * DEG, 0.14 * DEG, 0.08 * DEG, 0.02, 0.03, 0.025])
LEVEL = np.array([0.1 * DEG, -0.2 * DEG, 0.3 * DEG, 0.05, -0.05, G])
TIME = np.arange(N) / RATE


def values(seed, n=N):
    """White noise and random walks of which the two are equal at 30 s, as in a consumer sensor."""
    normal = np.random.default_rng(seed).standard_normal((2, n, 6))
    walk = np.cumsum(normal[1], axis=0) * np.sqrt(3.0) / 30.0 / RATE
    return SIGMA * (normal[0] + walk) + LEVEL


def recording(x, rate=RATE, **more):
    """Recording of the first axes; numbers are those of the units."""
    options = {"names": NAMES[: x.shape[1]], "gyro_unit": "rad/s", "accel_unit": "m/s²", "name": "bench"}
    return aj.Recording.from_array(x, rate, **(options | more))


def own(x):
    return recording(x / [DEG, DEG, DEG, G, G, G], gyro_unit="deg/s", accel_unit="g")


def motion(seed, n):
    """Handling: a few Hz, on all axes, of unit scatter."""
    band = scipy.signal.butter(2, (0.3, 8.0), "bandpass", fs=RATE, output="sos")
    x = scipy.signal.sosfilt(band, np.random.default_rng(seed).standard_normal((n + 500, 6)), axis=0)[500:]
    return x / np.std(x, axis=0)


def ringing(at, t):
    return np.where(t >= at, np.exp(-np.maximum(t - at, 0.0) / 0.3) * np.sin(200.0 * t), 0.0)


HARDER = np.array([0.5, 1.0, 0.4, 0.3, 0.2, 0.6])
# What is done to a record z in units of the axes' noise, of which some are hit harder; from when to when; the
# axis that is named, and the size there in units of its noise, or as a ratio; its tolerance.
HAPPENED = {
    # Of twelve windows the largest excess at any scale is up to twice the usual.
    "noisier": (lambda z, t: np.where(t < 4.0, 19.0 * z * HARDER, 0.0), 0.0, 4.0, 1, 20.0, 0.5),
    "knock": (lambda z, t: 200.0 * HARDER * ringing(120.0, t), 120.0, 121.0, 1, 185.0, 0.1),
    # Means over sixteen windows of 32 samples on either side: ±0.07; what wanders farther off adds nothing.
    "step": (lambda z, t: HARDER * (np.sin(t / 30.0) - 8.0 * (t >= 110.0)), 110.0, 110.0, 1, -8.15, 0.05),
    "shift": (lambda z, t: 20.0 * HARDER * np.clip(t / 20.0 - 7.5, 0.0, 1.0), 150.0, 170.0, 1, 20.0, 0.05),
    # The first window of 0.32 s, from what is left after the search.
    "warm-up": (lambda z, t: 50.0 * HARDER * np.exp(-t / 10.0), 0.0, 20.0, 1, 49.0, 0.05),
    "silent": (lambda z, t: np.where(t < 270.0, 0.0, -z) * (np.arange(6) == 4), 270.0, 300.0, 4, 0.0, 0.0),
}


@pytest.mark.parametrize("kind", HAPPENED)
def test_what_happened_is_named_measured_and_left_out(kind):
    (done, first, last, axis, size, close), x = HAPPENED[kind], values(5)
    touched = x + SIGMA * done((x - LEVEL) / SIGMA, TIME[:, None])
    if kind == "silent":
        touched[27_000:, 4] = 0.123
    result = aj.inspect(own(touched))
    (event,) = (event for event in result.events if event.matters)
    unit, slow = 1.0 if kind == "noisier" else SIGMA[axis], kind in ("warm-up", "shift")
    assert (event.kind, event.axis, event.size / unit) == (kind, axis, pytest.approx(size, rel=close))
    # To a few windows of 0.32 s, and what is slow to its faint end.
    assert event.first / RATE == pytest.approx(first, abs=5.0)
    assert event.last / RATE == pytest.approx(last, abs=40.0 if slow else 2.0)
    start, stop = result.longest_part
    assert stop <= first + 0.01 or start >= last - 0.01
    # The longer side, but for some seconds beside the event.
    assert stop - start > max(first, 300.0 - last) - (45.0 if slow else 6.0)
    (text,) = result.about("disturbances")
    assert text.startswith(result.left_out)
    sizes = [f"{abs(event.size) / DEG:.2g} deg/s"] * (kind in ("step", "spike", "shift"))
    for word in (f"{start:g}", f"{stop:g}", *sizes, *([NAMES[axis]] * (kind != "noisier"))):
        assert word in text
    # Of what is left: mean and rms by definition, but for windows at its ends.
    rows = slice(round(start * RATE), round(stop * RATE))
    assert_allclose((result.mean - touched[rows].mean(axis=0)) / SIGMA, 0.0, atol=0.02)
    assert_allclose(result.rms, touched[rows].std(axis=0), rtol=0.01)
    assert result.quiet(own(touched)).n == rows.stop - rows.start
    asked = aj.inspect(own(touched), as_is=True)
    assert (asked.longest_part, asked.refusal, bool(asked.about("disturbances"))) == (None, "", True)
    # What is accumulated cannot be cut any more: a refusal that names the part to read.
    assert result.uncut().longest_part is None
    assert f"start={start:g}, stop={stop:g}" in result.uncut().refusal
    moved = aj.inspect(own(touched), may_move=True).longest_part
    assert (moved is None) == (kind in ("step", "shift", "warm-up"))


def test_what_changes_no_coefficient_is_a_note():
    x = values(6)
    x[15_000] += 12.0 * SIGMA
    result = aj.inspect(recording(x))
    assert (result.warnings, result.longest_part, result.refusal, len(result.notes)) == ((), None, "", 1)
    assert [(event.kind, event.matters) for event in result.events] == [("spike", False)]


def test_parts_between_knocks_are_joined_and_three_tenths_of_the_record_must_be_quiet():
    for count, refused in ((4, False), (50, True)):
        at = [300.0 * (k + 0.5) / count for k in range(count)]
        x = values(7) + 300.0 * SIGMA * sum(ringing(time, TIME[:, None]) for time in at)
        result = aj.inspect(recording(x))
        assert (bool(result.refusal), len(result.parts)) == (refused, 0 if refused else count + 1)
        for first, last in result.parts:
            assert all(time < first or time > last for time in at)
        quiet = result.quiet(recording(x))
        # But for a few seconds around each knock, cut to whole ones.
        assert refused or quiet.n + sum(map(len, quiet.others)) > RATE * (300.0 - 6.0 * count)
    failed = aj.fit(recording(x[:, :3]), "N + K")["gyro_x"]
    assert (failed.converged, "knocks" in failed.reason, "--as-is" in failed.reason) == (False, True, True)


def vibration(kind, shape, seed):
    """Vibration of unit scatter: an engine's lines with harmonics, or a fan's broad band."""
    rng, t = np.random.default_rng(seed), TIME[:, None]
    if kind == "fan":
        band = scipy.signal.butter(2, (10.0, 30.0), "bandpass", fs=RATE, output="sos")
        return scipy.signal.sosfilt(band, rng.standard_normal(shape), axis=0) / np.sqrt(20.0 / 50.0)
    waves = [np.sin(2.0 * np.pi * 13.7 * k * t + rng.uniform(0.0, 6.0, 6)) for k in (1, 2, 3)]
    return np.sqrt(2.0 / 3.0) * sum(waves)


@pytest.mark.parametrize("kind", ["engine", "fan", "gain", "held", "nulled", "slightly louder"])
@pytest.mark.parametrize("quiet", [slice(0, 3000), slice(12_000, 15_000)])
def test_the_quiet_part_is_the_sensor_if_the_rest_vibrates(kind, quiet):
    """A tenth of the record is quiet. Its N, and where it is, are known; what is not vibration is unclear."""
    x = values(8) - LEVEL
    calm = np.zeros(len(x), bool)
    calm[quiet] = True
    if kind in ("engine", "fan"):
        x[~calm] += (5.0 * SIGMA * vibration(kind, x.shape, 9))[~calm]
    elif kind == "gain":
        x[~calm] *= 3.0
    elif kind == "held":
        x[calm] = np.repeat(x[calm].reshape(-1, 10, 6).mean(axis=1), 10, axis=0)
    elif kind == "nulled":
        x[calm] = 0.0
    else:
        x[~calm] *= 1.3
    given = own(LEVEL + x)
    result = aj.inspect(given)
    if kind == "nulled" and not quiet.start:
        # An end that is constant on all axes is no record.
        assert (given.n, result.refusal) == (N - 3000, "")
        return
    if kind == "slightly louder":
        # That is how N varies.
        assert (result.parts, result.refusal) == ((), "")
        assert not result.about("disturbances")
        return
    start, stop = quiet.start / RATE, quiet.stop / RATE
    if kind in ("engine", "fan"):
        assert result.longest_part == pytest.approx((start, stop), abs=2.0)
        fit = aj.fit(given.select("gyro_x", "accel_y"), "N")
        for name, density in (("gyro_x", SIGMA[0] / 10.0), ("accel_y", SIGMA[4] / 10.0)):
            # Some 2,700 samples: 1.4 %.
            assert fit[name]["N"].value == pytest.approx(density, rel=0.05)
        return
    assert "the quiet part may not be the sensor" in result.refusal
    # Each part can be selected, and the louder one is a recording by itself.
    spans = [
        tuple(map(float, found))
        for found in re.findall(r"--start ([0-9.]+) --stop ([0-9.]+)", result.refusal)
    ]
    assert spans[0] == pytest.approx((start, stop), abs=2.0)
    assert spans[1] == pytest.approx((stop, 300.0), abs=2.0)
    assert aj.inspect(given.between(*spans[1])).refusal == ""


def test_noise_of_any_colour_is_nothing_unusual():
    for name in (*PLAIN, *SHAPED, *CLEAN):
        result = aj.inspect(bench.recording(name))
        assert (result.left_out, result.at_rest, result.events) == ("", True, ()), name


def test_what_is_unlike_the_rest():
    """20 s are found where all axes are 7 % louder; a step of 0.4 of the noise from some 40 s to the next."""
    for louder, step, found in ((1.04, 0.1, False), (1.11, 0.0, True), (1.0, 1.0, True)):
        z = np.random.default_rng(22).standard_normal((N, 6))
        z[15_000:17_000] *= louder
        z[6000:] += step
        assert bool(aj.inspect(recording(LEVEL + SIGMA * z)).events) == found


def test_a_stream_that_was_handled_says_what_to_read(tmp_path):
    x = values(10)
    x[:500] += 100.0 * SIGMA * motion(10, 500)
    accumulator = aj.AllanAccumulator(RATE, NAMES)
    for part in np.array_split(x, 5):
        accumulator.update(part)
    whole = aj.inspect(recording(x))
    accumulator.snapshot(tmp_path / "rig.npz")
    for one in (accumulator, aj.AllanAccumulator.restore(tmp_path / "rig.npz")):
        assert one.inspect().longest_part == whole.longest_part
    left, right = aj.AllanAccumulator(RATE, NAMES), aj.AllanAccumulator(RATE, NAMES, start=12_345)
    left.update(x[:12_345])
    right.update(x[12_345:])
    # Windows begin elsewhere: the part is the same to a second or so.
    assert_allclose(left.merge(right).inspect().longest_part, whole.longest_part, atol=1.5)
    fit = accumulator.fit("N + K")
    assert not fit.converged
    assert "start={:g}, stop={:g}".format(*whole.longest_part) in fit["gyro_x"].reason
    # What it says to read has a result.
    calm = aj.AllanAccumulator(RATE, NAMES)
    calm.update(x[slice(*(round(time * RATE) for time in whole.longest_part))])
    assert calm.fit("N + K")["gyro_x"].measured


def _share(path, sensor):
    """Rms difference of neighbouring clusters of 0.32 s to 5 s, at most, as a share of the limit at rest."""
    total, shares = np.concatenate([[0.0], np.cumsum(path)])[::32], []
    for lag in (1, 2, 4, 8, 16):
        means = (total[lag:] - total[:-lag]) / (32 * lag)
        limit = {"gyro": 0.3 * DEG, "accel": 0.15}[sensor] * np.sqrt(2.0 / min(0.32 * lag, 1.0))
        shares.append(np.sqrt(np.mean((means[lag:] - means[:-lag]) ** 2)) / limit)
    return max(shares)


WAVES, BUZZ = motion(1, N)[:, 0], np.sqrt(2.0) * np.sin(2.0 * np.pi * 25.0 * TIME + 0.3)
# Axes, motions, and the size that is the largest of a sensor at rest.
MOTIONS = [
    (1, WAVES, 1.0 / _share(WAVES, "gyro")), (4, WAVES, 1.0 / _share(WAVES, "accel")),
    (1, TIME / 300.0, 3.0 * DEG), (4, TIME / 300.0, 0.5), (1, BUZZ, 10.0 * DEG), (4, BUZZ, 2.0),
]  # fmt: skip


@pytest.mark.parametrize(("axis", "path", "limit"), MOTIONS)
def test_motion_is_what_no_sensor_does(axis, path, limit):
    """At nine tenths of the limit nothing is reported, and at 1.1 of it the axis is not at rest."""
    for share, moving in ((0.9, ()), (1.1, (axis,))):
        x = values(11)
        x[:, axis] += share * limit * path
        result = aj.inspect(recording(x))
        assert (result.moving, result.refusal) == (moving, "")
        assert (not result.at_rest, bool(result.about("at rest"))) == (bool(moving), bool(moving))
    assert NAMES[axis] in result.about("at rest")[0]
    # Meant to be.
    assert aj.inspect(recording(x), vibrating=True).about("at rest") == ()
    # Two axes that move are a moving platform.
    x[:, axis - 1] += 1.1 * limit * path
    assert aj.inspect(recording(x)).moving == tuple(range(6))


# Factors of the numbers or a bias [deg/s], and their units; the option that is named, if there is a warning.
PLAUSIBLE = [
    ({"accel": 1 / G}, "--accel-unit g"), ({"accel_unit": "g"}, "--accel-unit m/s^2"),
    ({"accel": 1000 / G}, "--accel-unit mg"), ({"accel": 1 / G, "accel_unit": "mg"}, "--accel-unit g"),
    ({"accel": 1 / RATE}, "--accel-unit m/s"), ({"accel": 10 / RATE, "accel_unit": "m/s"}, "--rate 10"),
    ({"accel": 1 / RATE, "accel_unit": "m/s"}, ""),
    # Gravity ± 20 %, or a tenth of it.
    ({"accel": 1.19}, ""), ({"accel": 1.21}, "--accel-unit"), ({"accel": 0.79}, "--accel-unit"),
    ({"accel": 0.09}, ""), ({"accel": 0.12}, "--accel-unit"),
    # A unit is named that makes it gravity within 5 %.
    ({"accel": 1.04 / G}, "--accel-unit g"), ({"accel": 1.3 / G}, "right"),
    ({"gyro": 1 / DEG}, "--gyro-unit deg/s"),
    ({"gyro": 1 / DEG, "gyro_unit": "deg/s"}, ""), ({"bias": 19.0}, ""), ({"bias": -21.0}, "--gyro-unit"),
]  # fmt: skip


def test_units_that_can_and_cannot_be():
    for change, option in PLAUSIBLE:
        factors = np.repeat([change.get("gyro", 1.0), change.get("accel", 1.0)], 3)
        x = (values(12) + change.get("bias", 0.0) * DEG * np.eye(6)[0]) * factors
        units = {name: unit for name, unit in change.items() if name.endswith("_unit")}
        result = aj.inspect(recording(x, **units))
        kind = "accel unit" if any("accel" in key for key in change) else "gyro unit"
        assert [fact.kind for fact in result.facts] == [kind] * bool(option), change
        assert all(option in fact.text and fact.grave for fact in result.facts), change
        if len(words := option.split()) == 2:
            followed = units | {words[0][2:].replace("-", "_"): words[1]}
            rate = float(followed.pop("rate", RATE))
            assert aj.inspect(recording(x, rate, **followed)).facts == ()


def labelled(x, gyro, accel, **options):
    """Recording of a table whose labels have these units, whatever the numbers are."""
    units = 3 * [gyro] + 3 * [accel]
    columns = {f"{name} [{unit}]": y for name, unit, y in zip(NAMES, units, x.T, strict=True)}
    return aj.Recording.from_dataframe({"time [s]": TIME, **columns}, **options)


@pytest.mark.parametrize(("scale", "gyro", "accel"), [(DEG, "deg/s", "g"), (1.0, "rad/s", "m/s^2")])
def test_a_wrong_label_of_one_sensor_puts_that_of_the_other_in_doubt(scale, gyro, accel):
    """Gyros of 0.3 deg/√h and no bias, which would be plausible in either unit alone."""
    rng = np.random.default_rng(31)
    white = np.array(3 * [0.3 * DEG] + 3 * [0.06]) / 60.0 * np.sqrt(RATE)
    x = (white * rng.standard_normal((len(TIME), 6)) + [0, 0, 0, 0, 0, G]) / np.repeat([scale, G], 3)
    x[:, 3:] *= 1.0 if accel == "g" else G
    wrong = ("rad/s", "m/s^2") if gyro == "deg/s" else ("deg/s", "g")
    for options, units in (({}, f"--accel-unit {accel}|--gyro-unit {gyro}"), ({"accel_unit": accel}, "")):
        facts = aj.inspect(labelled(x, *wrong, **options)).facts
        assert "gyro unit" in [fact.kind for fact in facts if fact.grave]
        assert all(any(unit in fact.text for fact in facts) for unit in units.split("|"))
    # What a user knows is not doubted, nor what the labels say right.
    for sure in (labelled(x, *wrong, gyro_unit=gyro, accel_unit=accel), labelled(x, gyro, accel)):
        assert not [fact for fact in aj.inspect(sure).facts if "unit" in fact.kind]
    # Without accelerometers that are wrong, the noise beside theirs tells.
    facts = aj.inspect(labelled(x, wrong[0], accel)).facts
    assert [(fact.kind, fact.axes) for fact in facts] == [("gyro unit", tuple(NAMES[:3]))]
    # A user who insists is warned, since 0.0052 or 17 deg/√h are noise that some gyros have, but not refused.
    facts = aj.inspect(labelled(x, wrong[0], accel, gyro_unit=wrong[0])).facts
    assert [(fact.kind, fact.consequence) for fact in facts] == [("gyro unit", "none")]


# Units of the numbers and of the labels; what the warnings of gyros and accelerometers name, with its factor.
# Factors are 180/π, 9.80665, and those of prefixes and the rate of 100 Hz.
MISLABELLED = [
    (("deg/s", "g"), ("rad/s", "m/s^2"), ("deg/s", "0.01745"), ("g", "9.807")),
    (("rad/s", "m/s^2"), ("deg/s", "g"), ("rad/s", "57.3"), ("m/s^2", "0.102")),
    (("mdeg/s", "mg"), ("deg/s", "g"), ("mdeg/s", "0.001"), ("mg", "0.001")),
    (("rad", "m/s"), ("rad/s", "m/s^2"), ("rad", "100"), ("m/s", "100")),
    (("deg/h", "m/s^2"), ("deg/s", "m/s^2"), ("deg/h", "2.778×10⁻⁴"), None),
    (("deg/s", "g"), ("deg/s", "m/s^2"), None, ("g", "9.807")),
    (("deg/s", "m/s^2"), ("rad/s", "m/s^2"), ("deg/s", "0.01745"), None),
    (("rad/s", "g"), ("deg/s", "g"), ("rad/s", "57.3"), None),
]
OF_UNIT = {"rad/s": 1.0, "deg/s": DEG, "mdeg/s": DEG / 1e3, "deg/h": DEG / 3600.0, "rad": RATE}
OF_UNIT |= {"m/s^2": 1.0, "g": G, "mg": G / 1e3, "m/s": RATE}


@pytest.mark.parametrize(("true", "label", "gyro", "accel"), MISLABELLED)
def test_a_wrong_label_is_named_with_its_factor_and_the_noise_in_the_right_unit(true, label, gyro, accel):
    """Consumer sensors; SIGMA's middle gyro has 0.6 deg/√h, and the middle accelerometer 0.15 m/s/√h."""
    x = values(41) / np.repeat([OF_UNIT[unit] for unit in true], 3)
    found = {fact.kind: fact for fact in aj.inspect(labelled(x, *label)).facts}
    wanted = {"gyro": (gyro, 0.6, "deg/√h"), "accel": (accel, 0.15, "m/s/√h")}
    assert {*found} == {f"{sensor} unit" for sensor, (named, *_) in wanted.items() if named}
    for kind, fact in found.items():
        (unit, factor), noise, density = wanted[kind.split()[0]]
        assert fact.grave
        assert f"(a factor of {factor})" in fact.text
        assert f"; pass --{kind.replace(' ', '-')} {unit}," in fact.text
        told = re.search(rf"in which the noise is ([\d.]+) {density}", fact.text)[1]
        # N of 30,000 samples within 3 %, at the scale where it is least.
        assert float(told) == pytest.approx(noise, rel=0.05)
    assert not [f for f in aj.inspect(labelled(x, *true)).facts if "unit" in f.kind]


def test_whole_numbers_are_counts_whatever_the_unit_that_is_given():
    """Of 1/131 deg/s and 1/2048 g, as a MEMS sensor writes them; whole mg and mdeg/s are in use."""
    counts = np.rint(values(42) / np.repeat([DEG / 131.0, G / 2048.0], 3))
    stated = recording(counts, gyro_unit="deg/s", accel_unit="g")
    for given in (labelled(counts, "rad/s", "m/s^2"), stated):
        facts = [fact for fact in aj.inspect(given).facts if "unit" in fact.kind]
        assert [(fact.kind, fact.grave) for fact in facts] == [("gyro unit", True), ("accel unit", True)]
        assert all("probably counts" in fact.text for fact in facts)
        assert not aj.fit(given, "N", plain=True)["gyro_x"].measured
    assert not aj.inspect(recording(counts, gyro_unit="deg/s/131", accel_unit="g/2048")).about("gyro unit")
    fine = np.rint(values(42) / np.repeat([DEG / 1e3, G / 1e3], 3))
    assert not [f for f in aj.inspect(labelled(fine, "mdeg/s", "mg")).facts if "unit" in f.kind]


def test_whole_numbers_are_a_doubt_of_what_a_user_says_and_no_veto():
    """Betaflight logs whole deg/s beside counts of accelerometers; a label of deg/s would not be believed."""
    rng = np.random.default_rng(44)
    x = np.hstack(
        [rng.normal([0.2, -0.1, 0.4], [1.2, 1.6, 1.9], (N, 3)), rng.normal([30, -40, 2050], 9, (N, 3))]
    )
    own = np.rint(x)
    stated = recording(own, gyro_unit="deg/s", accel_unit="g/2048")
    (fact,) = (fact for fact in aj.inspect(stated).facts if "unit" in fact.kind)
    assert (fact.kind, fact.grave) == ("gyro unit", False)
    assert aj.fit(stated, "N", plain=True)["gyro_x"].measured
    (fact,) = (fact for fact in aj.inspect(labelled(own, "deg/s", "g/2048")).facts if "unit" in fact.kind)
    assert fact.grave


def test_one_sensor_alone_is_judged_by_what_it_shows():
    """Of gyros, the noise and the bias; of accelerometers, gravity; a single tilted axis tells little."""
    x = values(43)
    for sensor, kept, factor, warned in (
        *(("gyro", slice(3), 1.0, False), ("gyro", slice(3), 1.0 / DEG, True)),
        *(("accel", slice(3, 6), 1.0, False), ("accel", slice(3, 6), 1.0 / G, True)),
    ):
        found = aj.inspect(recording(x[:, kept] * factor, names=NAMES[kept]))
        assert [fact.grave for fact in found.facts if "unit" in fact.kind] == [True] * warned, sensor
    alone = aj.Recording.from_dataframe({"time [s]": TIME, "accel_z [m/s^2]": x[:, 5] / G})
    assert [(f.kind, f.consequence) for f in aj.inspect(alone).facts] == [("accel unit", "none")]


def test_a_stream_knows_which_units_were_given(tmp_path):
    x = values(44) / np.repeat([DEG, G], 3)
    path = tmp_path / "log.csv"
    labels = [f"{name} [{unit}]" for name, unit in zip(NAMES, 3 * ["rad/s"] + 3 * ["m/s^2"], strict=True)]
    np.savetxt(path, x, "%.9g", ",", header=",".join(labels), comments="")
    for options in ({}, {"gyro_unit": "deg/s"}, {"gyro_unit": "deg/s", "accel_unit": "g"}):
        whole = aj.inspect(aj.read(path, rate=RATE, **options))
        stream = aj.accumulate(aj.read_chunks(path, rate=RATE, **options)).inspect()
        kinds = [[fact.kind for fact in found.facts if "unit" in fact.kind] for found in (whole, stream)]
        assert kinds[0] == kinds[1] == ["gyro unit", "accel unit"][len(options) :]


def test_noise_that_no_gyro_has_and_orientations_that_can_be():
    """White noise [deg/√h] below that of the best gyro made, 3e-5, or above that of any at rest, 18."""
    white = np.random.default_rng(3).standard_normal((20_000, 3)) * DEG / 60.0 * np.sqrt(RATE)
    for density, warned in ((2e-5, True), (5e-5, False), (17.0, False), (21.0, True)):
        assert bool(aj.inspect(recording(density * white)).about("gyro unit")) == warned
    # At least an eighth of that of accelerometers [deg/√h beside m/s/√h], beside MEMS.
    rng = np.random.default_rng(4)
    cases = [(0.08, 0.05, "deg/s", True), (0.14, 0.05, "deg/s", False), (0.08, 0.02, "deg/s", False)]
    for ratio, accel, unit, warned in [*cases, (0.14, 0.05, "rad/s", False)]:
        white = np.array(3 * [ratio * accel * DEG] + 3 * [accel]) / 60.0 * np.sqrt(RATE)
        x = white * rng.standard_normal((20_000, 6)) + [0, 0, 0, 0, 0, G]
        x[:, :3] /= DEG if unit == "deg/s" else 1.0
        assert bool(aj.inspect(recording(x, gyro_unit=unit)).about("gyro unit")) == warned
    # On its side; without gravity, as a simulation; a single accelerometer that is tilted.
    x = values(13)
    level = recording(x[:, 3:4] + 0.5, names=["accel_x"])
    for made in (recording(x[:, [0, 1, 2, 5, 3, 4]]), recording(x - LEVEL), level):
        assert aj.inspect(made).warnings == ()


def test_rates_and_lengths():
    """Stamps beside a rate may be in s, ms, µs or ns, and 5 % off."""
    for step, words in ((1e-3, "1000 Hz"), (10.4, ""), (9.6, ""), (10.6, "94.34 Hz"), (1e4, ""), (1e7, "")):
        given = recording(values(14), auxiliary={"time": np.arange(N) * step})
        (warning,) = aj.inspect(given).about("rate") or ("",)
        assert words in warning if words else not warning
    for n, words in ((6000, ()), (5999, ("60 s",)), (1000, ("10 s",)), (999, ("9.99 s", "3 %"))):
        found = aj.inspect(recording(values(15, n))).about("length")
        assert len(found) == bool(words)
        assert all(word in found[0] for word in words)
    slow = (aj.inspect(recording(values(15, n), 10.0)).about("length") for n in (999, 1000))
    assert [*map(bool, slow)] == [True, False]


def test_noise_below_the_resolution_and_samples_that_are_held():
    """The share of equal neighbours is 60 % where the noise is 0.4 steps; then few values are left."""
    for steps, means in ((0.4, ""), (1.0, "widened"), (1.8, "widened"), (3.0, "not a measurement")):
        x = LEVEL + SIGMA * steps * np.round((values(15) - LEVEL) / SIGMA / steps)
        result = aj.inspect(recording(x))
        expected = {("resolution", means)} if means else set()
        assert {(f.kind, f.consequence) for f in result.facts} == expected
        for k, fact in enumerate(result.facts):
            assert fact.axes == (NAMES[k],)
            # The rms of rounded noise about the means of 64 samples, of one degree of freedom less, in steps.
            rms = np.sqrt(x[: len(x) // 64 * 64, k].reshape(-1, 64).var(axis=1).mean())
            assert fact.size == pytest.approx(rms / SIGMA[k] / steps, rel=0.01)
    # Of 15 neighbours in a block of 16, eight are equal if each sample comes twice.
    for held, share in ((2, 53), (4, 80), (1, 0)):
        x = np.repeat(values(15, N // held), held, axis=0)
        found = aj.inspect(recording(x)).about("repeated samples")
        assert len(found) == (6 if share else 0)
        assert all(f"{axis}: {share} %" in text for axis, text in zip(NAMES, found, strict=False))


def white(n=20_000, seed=30):
    """White noise on three gyros and the density of each [rad/√s]."""
    return SIGMA[:3] * np.random.default_rng(seed).standard_normal((n, 3)), SIGMA[:3] / np.sqrt(RATE)


def between(x, native):
    """Samples at a native rate, interpolated to the record's."""
    own = np.arange(int(len(x) * native / RATE) + 2) / native
    there = x[: len(own)] * np.sqrt(native / RATE)
    return np.column_stack([np.interp(np.arange(len(x)) / RATE, own, y) for y in there.T])


def put(x, rows, axis, value):
    x = x.copy()
    x[rows, axis] = value(x[rows, axis]) if callable(value) else value
    return x


SOME, MANY = (np.random.default_rng(4).choice(20_000, count, replace=False) for count in (30, 300))
TONE = np.sin(140.0 * TIME[:20_000])
LOUD = 30.0 * SIGMA[1] * np.random.default_rng(5).standard_normal(600)
# What is done to white noise, the kind of fact, its axes, and what it means for them.
FACTS = {
    "clipped": (lambda x: put(x, ..., 2, lambda y: np.minimum(y, SIGMA[2])), "saturation", "z", "grave"),
    "31 Hz": (lambda x: between(x, 31.25), "interpolation", "xyz", "grave"),
    "80 Hz": (lambda x: between(x, 80.0), "interpolation", "xyz", "grave"),
    "50 Hz": (lambda x: between(x, 50.0), "interpolation", "xyz", "grave"),
    "moved": (lambda x: x + 0.2 * WAVES[:20_000, None] * [1, 0, 0], "at rest", "x", "grave"),
    "few levels": (lambda x: put(x, ..., 0, lambda y: 1.5 * SIGMA[0] * np.round(y / 1.5 / SIGMA[0])),
                   "resolution", "x", "widened"),
    "spikes": (lambda x: put(x, SOME, 1, lambda y: y + 90.0 * SIGMA[1]), "spikes", "y", "widened"),
    "many spikes": (lambda x: put(x, MANY, 1, lambda y: y + 15.0 * SIGMA[1]), "spikes", "y", "widened"),
    "outliers": (lambda x: put(x, MANY, 1, lambda y: y + 5.0 * SIGMA[1]), "spikes", "y", "widened"),
    "burst": (lambda x: put(x, slice(9000, 9600), 1, LOUD), "disturbances", "y", "widened"),
    "line": (lambda x: put(x, ..., 1, lambda y: y + SIGMA[1] * TONE), "lines", "y", "widened"),
}  # fmt: skip


@pytest.mark.parametrize("what", FACTS)
def test_a_fact_reaches_whoever_uses_the_record(what):
    """N holds within 4 σ on every axis that is measured, with half its usual error on those not concerned."""
    spoil, kind, axes, means = FACTS[what]
    x, N = white()
    given = recording(spoil(x))
    consequence = {"grave": "not a measurement", "": "none"}.get(means, means)
    fit = aj.fit(given, "N", "whittle" if what == "line" else "allan", plain=True)
    names = tuple(f"gyro_{axis}" for axis in axes)
    (fact,) = (fact for fact in fit.facts if fact.kind == kind)
    assert (fact.axes, fact.consequence) == (names, consequence)
    # Before the fit nobody knows whether it has a term for lines.
    before, after = ([f for f in of.facts if f.kind != "lines"] for of in (aj.inspect(given), fit))
    assert before == after
    assert aj.inspect(given).facts == aj.select_terms(given, "N + K").facts
    assert aj.inspect(given).parts == fit.parts
    assert aj.check(given)[kind].verdict == ("stop" if means == "grave" else "look")
    assert (fact.text in fit.warnings) == (means != "")
    written = [(f["kind"], f["text"], f["size"]) for f in aj.to_dict(fit)["facts"]]
    assert (fact.kind, fact.text, fact.size) in written
    # Of a stream in two pieces what takes the samples themselves is reported as left out.
    pieces = aj.AllanAccumulator(RATE, given.names), aj.AllanAccumulator(RATE, given.names, start=9999)
    for piece, samples in zip(pieces, np.split(given.values, [9999]), strict=True):
        for part in np.array_split(samples, 5):
            piece.update(part)
    of_stream = pieces[0].merge(pieces[1]).inspect().facts
    assert "not examined" in [other.kind for other in of_stream]
    if kind in ("saturation", "resolution"):
        (same,) = (other for other in of_stream if other.kind == kind)
        assert (same.axes, same.consequence) == (names, consequence)
        assert same.size == pytest.approx(fact.size, rel=0.02)
    assert tuple(fit.not_measured) == (names if means == "grave" else ())
    for name, result, true in zip(fit.axes, fit.results, N, strict=True):
        if result.measured and what != "line":
            c, usual = result["N"], true / np.sqrt(2 * 20_000)
            assert abs(c.value - true) < 4.0 * c.std, name
            assert c.std < (2.0 if name not in names else 60.0) * usual, name
            assert c.interval[0] < c.value < c.interval[1]


def loud(first, last, every=4096, by=20.0):
    """Six axes that are louder in a span of samples, and in others as long."""
    rows = np.flatnonzero((np.arange(4096) - first) % every < last - first)
    return put(values(17, 4096), rows, slice(None), lambda y: LEVEL + by * (y - LEVEL))


# Samples, how many times faster than true their stamps are, other columns; and the remedies that are printed,
# with the words that follow each, or None where there is nothing to follow it by.
STRETCH, WARM = "--start and --stop", np.sin(TIME[:4096] / 4.0)
REMEDIES = {
    "two times": (values(17, 4096), 2.5, {"uptime": TIME[:4096]},
                  {"--time uptime": "", "--time none --rate 100": ""}),
    "moved": (loud(300, 400, 400, 200.0), 1.0, {}, {STRETCH: "--stop 2.5", "--vibrating --as-is": ""}),
    "vibrating": (loud(0, 4096, by=150.0), 1.0, {}, {STRETCH: None, "--vibrating": ""}),
    "touched": (loud(300, 400, 400), 1.0, {}, {STRETCH: "--stop 2.5", "--as-is": ""}),
    # The same spectrum, only louder: a gain may have changed.
    "loud": (loud(1200, 4096), 1.0, {},
             {"--start 0.0 --stop 11.4": "", "--start 11.5 --stop 41.0": "", "--as-is": ""}),
    "warm": (values(17, 4096) + 2.0 * SIGMA * WARM[:, None], 1.0, {"temperature": WARM},
             {"--objective whittle --regressors temperature": ""}),
}  # fmt: skip
# Options that belong together, with their values.
OPTION = re.compile(r"(?:(?: |^)(?:and )?--[a-z-]+(?: (?!and)[a-z/0-9.^]+(?![\w ]*=))?)+")


@pytest.mark.usefixtures("elsewhere")
@pytest.mark.parametrize("what", REMEDIES)
def test_every_remedy_that_a_check_names_leads_to_a_result(what):
    x, faster, others, remedies = REMEDIES[what]
    units = 3 * ["rad/s"] + 3 * ["m/s^2"]
    columns = {f"{name} [{unit}]": y for name, unit, y in zip(NAMES, units, x.T, strict=True)}
    pd.DataFrame({"time [s]": TIME[:4096] / faster, **columns, **others}).to_csv("log.csv", index=False)
    (check,) = json.loads(run("check", "log.csv", "--json").stdout)["checks"]
    text = " ".join(line["reason"] for line in check["lines"])
    assert {" ".join(option.split()) for option in OPTION.findall(text)} == {*remedies}
    for remedy, words in remedies.items():
        if words is not None:
            words = words or remedy
            done = run("characterize", "log.csv", *words.split(), "--terms", "N", "--json")
            assert (done.exit_code, without_progress(done.stderr)) == (0, ""), words

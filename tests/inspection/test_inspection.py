"""What is seen in a recording before its coefficients are estimated."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import scipy.signal
from places import DATA

import allanjax as aj
from allanjax.estimate.fit import inspected
from allanjax.inspection import Windows, look
from allanjax.inspection.scores import shortest_half
from allanjax.record.recording import Axis, Recording
from benchmarks.common.hidden_effects import draw

RATE = 100.0
NAMES = ("gyro_x", "gyro_y", "gyro_z", "accel_x", "accel_y", "accel_z")
DEG = np.pi / 180.0
# White noise of a consumer sensor from sample to sample at 100 Hz, and gravity.
SIGMA = np.array([0.1 * DEG] * 3 + [0.02] * 3)
LEVEL = np.array([0.1 * DEG, -0.2 * DEG, 0.3 * DEG, 0.05, -0.05, 9.80665])


def values(seed: int, n: int = 30_000) -> np.ndarray:
    """White noise and random walks of which the two are equal at 30 s, as in a consumer sensor."""
    normal = np.random.default_rng(seed).standard_normal((2, n, 6))
    walk = np.cumsum(normal[1], axis=0) * np.sqrt(3.0) / 30.0 / RATE
    return SIGMA * (normal[0] + walk) + LEVEL


def recording(x: np.ndarray, **units: str) -> Recording:
    units = {"gyro_unit": "rad/s", "accel_unit": "m/s²"} | units
    return Recording.from_array(x, RATE, names=NAMES[: x.shape[1]], name="bench", **units)


def motion(seed: int, n: int) -> np.ndarray:
    """Handling: a few Hz, on all axes."""
    band = scipy.signal.butter(2, (0.3, 8.0), "bandpass", fs=RATE, output="sos")
    x = scipy.signal.sosfilt(band, np.random.default_rng(seed).standard_normal((n + 500, 6)), axis=0)[500:]
    return x / np.std(x, axis=0)


# --- Windows ---------------------------------------------------------------------------------------------


def test_windows_are_sums_of_squares_by_brute_force() -> None:
    x = np.random.default_rng(0).standard_normal((100_000, 2))
    w = Windows.of(x)
    assert (w.size, len(w), len(w.rest)) == (128, 781, 32)
    for k, scale in enumerate(2 ** np.arange(7)):
        means = x[: 781 * 128].reshape(781, -1, scale, 2).mean(axis=2)
        expected = np.sum((means[:, 1::2] - means[:, ::2]) ** 2, axis=1)
        np.testing.assert_allclose(w.power[k], expected, rtol=1e-12)
        assert (w.pairs[k] == 64 // scale).all()


@pytest.mark.parametrize("chunk", [17, 5000, 40_000])
def test_windows_of_a_stream_are_those_of_the_whole(chunk: int) -> None:
    x = np.random.default_rng(1).standard_normal((70_001, 2))
    stream = Windows.of(x[:0])
    for k in range(0, len(x), chunk):
        stream = stream.updated(x[k : k + chunk])
    whole = Windows.of(x)
    assert stream.size == whole.size
    for name in ("count", "mean", "low", "high", "power", "pairs", "peak", "repeats", "rest"):
        np.testing.assert_allclose(getattr(stream, name), getattr(whole, name), rtol=1e-9, err_msg=name)


def test_merged_windows_hold_every_sample() -> None:
    x = np.random.default_rng(2).standard_normal((70_001, 2))
    merged = Windows.of(x[:33_333]).merge(Windows.of(x[33_333:])).closed()
    assert merged.n == len(x)
    assert merged.count.sum() == len(x)
    np.testing.assert_allclose(merged.count @ merged.mean, x.sum(axis=0), rtol=1e-9)
    np.testing.assert_allclose([merged.low.min(), merged.high.max()], [x.min(), x.max()])


def test_shortest_half_is_not_moved_by_others() -> None:
    x = np.random.default_rng(3).standard_normal(4001)
    x[:1600] += 1000.0
    middle, scatter = shortest_half(x[None])
    halves = [(b - a, 0.5 * (a + b)) for a, b in zip(np.sort(x)[:2001], np.sort(x)[2000:], strict=True)]
    np.testing.assert_allclose([scatter[0] * 1.349, middle[0]], min(halves))
    # The quiet 60 % of the values are normal: their shortest 2000 of 2401 are 83 %, ±1.38 σ.
    assert abs(middle[0]) < 0.3
    assert scatter[0] == pytest.approx(2.0 * 1.38 / 1.349, rel=0.1)


# --- Handling ----------------------------------------------------------------------------------------------


def test_handled_at_both_ends() -> None:
    """5 s at the start and 3 s at the end, a hundred times the noise: the fit is that of what is between."""
    x = values(4)[:, [0, 5]]
    clean = Recording.from_array(
        x, RATE, names=["gyro_x", "accel_z"], gyro_unit="rad/s", accel_unit="m/s²", name="bench"
    )
    touched = x.copy()
    for first, last in ((0, 500), (29_700, 30_000)):
        touched[first:last] += 100.0 * SIGMA[[0, 5]] * motion(first, last - first)[:, [0, 5]]
    seen = aj.inspect(dataclasses.replace(clean, values=touched))
    assert aj.inspect(clean).stretch is None
    assert seen.stretch is not None
    assert 5.0 <= seen.stretch[0] <= 8.0
    assert 295.0 <= seen.stretch[1] <= 297.0
    fit = aj.fit(dataclasses.replace(clean, values=touched), "N + K")
    first_line = str(fit).splitlines()[0]
    assert first_line.startswith("warning: 0")
    assert "times noisier than the rest: coefficients are of" in fit.warnings[0]
    assert fit.stretch == seen.stretch
    for axis, sigma in (("gyro_x", SIGMA[0]), ("accel_z", SIGMA[5])):
        n = fit[axis]["angle_random_walk"]
        # Within 4 of its standard deviations of the truth, which is 0.2 % of it or so.
        assert abs(n.value - sigma / np.sqrt(RATE)) < 4.0 * n.std
        assert n.std < 0.01 * n.value
    assert "mean 9.8" in str(fit)
    assert fit["accel_z"].rms == pytest.approx(SIGMA[5], rel=0.2)
    exported = aj.to_dict(fit)
    assert exported["warnings"] == list(fit.warnings)
    assert exported["stretch_s"] == list(seen.stretch)
    assert exported["axes"][1]["mean_si"] == pytest.approx(9.80665, abs=0.1)
    assert "noisier" in fit._repr_html_().split("<table>")[0]
    as_is = aj.inspect(dataclasses.replace(clean, values=touched), as_is=True)
    assert as_is.stretch is None
    assert as_is.refusal == ""
    assert any("as asked" in warning for warning in as_is.warnings)


TOUCHED = {
    "noisier": lambda x, t: np.where((t < 4.0)[:, None], 20.0 * SIGMA * motion(1, len(t)), 0.0),
    "knock": lambda x, t: (
        100.0 * SIGMA * (np.exp(-(t - 120.0) / 0.3) * np.sin(200.0 * t) * (t >= 120.0))[:, None]
    ),
    "spike": lambda x, t: 500.0 * SIGMA * (np.arange(len(t)) == 12_345)[:, None],
    "step": lambda x, t: 5.0 * SIGMA * (t >= 110.0)[:, None],
    "shift": lambda x, t: 20.0 * SIGMA * np.clip((t - 150.0) / 20.0, 0.0, 1.0)[:, None],
    "warm-up": lambda x, t: 50.0 * SIGMA * np.exp(-t / 10.0)[:, None],
    "silent": lambda x, t: np.where((t >= 270.0)[:, None], -x, 0.0),
}
PLACES = {
    "noisier": (0.0, 4.0),
    "knock": (120.0, 121.0),
    "spike": (123.45, 123.46),
    "step": (110.0, 110.0),
    "shift": (150.0, 170.0),
    "warm-up": (0.0, 20.0),
    "silent": (270.0, 300.0),
}


@pytest.mark.parametrize("kind", TOUCHED)
def test_what_happened_is_named_and_left_out(kind: str) -> None:
    x, (first, last) = values(5), PLACES[kind]
    seen = aj.inspect(recording(x + TOUCHED[kind](x, np.arange(len(x)) / RATE)))
    assert [event.kind for event in seen.events if event.matters] == [kind]
    assert seen.stretch is not None
    start, stop = seen.stretch
    assert stop <= first + 0.01 or start >= last - 0.01
    # The longer side, but for some seconds beside the event.
    assert stop - start > max(first, 300.0 - last) - (60.0 if kind in ("warm-up", "shift") else 10.0)
    word = {"shift": "moves by", "silent": "does not change at all", "spike": "single value"}.get(kind, kind)
    assert word in seen.warnings[0]


def test_what_changes_no_coefficient_is_a_note() -> None:
    x = values(6)
    x[15_000] += 12.0 * SIGMA
    seen = aj.inspect(recording(x))
    assert seen.warnings == ()
    assert seen.stretch is None


def test_no_quiet_part_is_long_enough() -> None:
    x, t = values(7), np.arange(30_000) / RATE
    for k in range(6):
        x += 300.0 * SIGMA * (np.exp(-abs(t - 25.0 - 50.0 * k) / 0.5) * np.sin(200.0 * t))[:, None]
    touched = recording(x[:, :1])
    seen = aj.inspect(touched)
    assert "6 knocks" in seen.refusal
    fit = aj.fit(touched, "N + K")
    assert not fit.converged
    assert "--as-is" in fit["gyro_x"].reason
    assert "6 knocks" in fit["gyro_x"].reason
    with pytest.raises(aj.FitError, match="no result"):
        fit["gyro_x"]["angle_random_walk"]
    # Once in the warning, not once more in every row.
    assert str(fit).count("6 knocks") == 1
    assert aj.to_dict(fit)["axes"][0]["converged"] is False


def test_handled_for_most_of_the_time() -> None:
    """The quieter part may be the sensor at rest: no coefficients of the louder one."""
    x = values(8)
    x[6000:] += 10.0 * SIGMA * np.random.default_rng(8).standard_normal((24_000, 6))
    assert "quieter than the rest" in aj.inspect(recording(x)).refusal


def test_a_model_with_a_step_expects_it() -> None:
    x = values(9)[:, :1]
    x[4000:] += 10.0 * SIGMA[0]
    stepped = recording(x)
    assert aj.inspect(stepped).stretch is not None
    model = aj.AngleRandomWalk() + aj.BiasStep(time=40.0).hold("time")
    expected = inspected(stepped, model, (), as_is=False, vibrating=False)
    assert expected.stretch is None
    assert expected.said == ""


# Of 40 records the expected false alarms are 0.3 at the 0.8 % measured; two would be at odds of 1 : 25.
def test_noise_of_any_colour_is_nothing_unusual() -> None:
    causes = [None, "sinusoid", "resonance", "low_pass", "rounding", "telegraph", "markov", "drift_ramp"]
    alarmed = []
    for seed in range(40):
        hidden = draw(70_000 + seed, causes[seed % 8], duration=600.0, rate=100.0)
        units = {"gyro": "rad/s", "accel": "m/s²"}
        axes = [Axis(name, hidden.sensor["kind"], units[hidden.sensor["kind"]]) for name in hidden.names]
        seen = look(Windows.of(hidden.values), axes, hidden.rate)
        alarmed += [(seed, seen.said)] if seen.said or not seen.at_rest else []
    assert len(alarmed) <= 1, alarmed


# --- Streams -----------------------------------------------------------------------------------------------


def test_a_stream_that_was_handled_says_what_to_read(tmp_path: Path) -> None:
    x = values(10)
    x[:500] += 100.0 * SIGMA * motion(10, 500)
    accumulator = aj.AllanAccumulator(RATE, NAMES)
    for k in range(0, len(x), 7001):
        accumulator.update(x[k : k + 7001])
    whole = aj.inspect(recording(x))
    assert accumulator.inspect().stretch == whole.stretch
    accumulator.snapshot(tmp_path / "rig.npz")
    assert aj.AllanAccumulator.restore(tmp_path / "rig.npz").inspect().stretch == whole.stretch
    left, right = aj.AllanAccumulator(RATE, NAMES), aj.AllanAccumulator(RATE, NAMES, start=12_345)
    left.update(x[:12_345])
    right.update(x[12_345:])
    merged = left.merge(right).inspect().stretch
    # Windows begin elsewhere: the stretch is the same to a second or so.
    np.testing.assert_allclose(merged, whole.stretch, atol=1.5)
    fit = accumulator.fit("N + K")
    assert not fit.converged
    start, stop = whole.stretch or (0.0, 0.0)
    assert f"start={start:g}, stop={stop:g}" in fit["gyro_x"].reason


# --- Motion ------------------------------------------------------------------------------------------------


def test_motion_is_said_and_may_be_meant() -> None:
    n = 6000
    moved = recording(values(11, n) + motion(11, n) * np.array([20.0 * DEG] * 3 + [2.0] * 3))
    seen = aj.inspect(moved)
    assert not seen.at_rest
    # Warned of, not refused.
    assert seen.refusal == ""
    for word in ("does not look like a static recording", "gyro", "accel", "--vibrating"):
        assert word in seen.warnings[0]
    assert aj.inspect(moved, vibrating=True).warnings == ()


@pytest.mark.skipif(not DATA.exists(), reason="the real recordings are not here")
def test_a_flight_and_a_hand_are_not_static() -> None:
    flight = np.genfromtxt(DATA / "euroc_slice.csv", delimiter=",", skip_header=1)[:, 1:]
    flown = Recording.from_array(flight, 200.0, names=NAMES, gyro_unit="rad/s", accel_unit="m/s²")
    assert "static" in aj.inspect(flown).warnings[0]
    hand = np.genfromtxt(DATA / "xio_sensor_data.csv", delimiter=",", skip_header=1)[:, 1:7]
    moved = Recording.from_array(hand, 100.0, names=NAMES, gyro_unit="deg/s", accel_unit="g")
    assert "static" in aj.inspect(moved).warnings[0]
    # Before it was picked up: at rest.
    at_rest = aj.inspect(moved.between(0.0, 9.0))
    assert not any("static" in warning for warning in at_rest.warnings)


# --- Units, rates, resolution ------------------------------------------------------------------------------


def scaled(gyro: float, accel: float, **units: str) -> list[str]:
    x = values(12) * np.array([gyro] * 3 + [accel] * 3)
    return list(aj.inspect(recording(x, **units)).warnings)


G = 9.80665


@pytest.mark.parametrize(
    ("gyro", "accel", "units", "said"),
    [
        (1.0, 1.0 / G, {}, "--accel-unit g"),
        (1.0, 1.0, {"accel_unit": "g"}, "--accel-unit m/s^2"),
        (1.0, 1000.0 / G, {}, "--accel-unit mg"),
        (1.0, 1.0 / G, {"accel_unit": "mg"}, "--accel-unit g"),
        (1.0, 1.0 / RATE, {}, "--accel-unit m/s"),
        (1.0 / DEG, 1.0, {}, "--gyro-unit deg/s"),
        (1.0, 1.0, {"gyro_unit": "deg/s"}, "--gyro-unit rad/s"),
        (1.0, 10.0 / RATE, {"accel_unit": "m/s"}, "--rate 10"),
    ],
)
def test_a_unit_that_cannot_be(gyro: float, accel: float, units: dict[str, str], said: str) -> None:
    warnings = scaled(gyro, accel, **units)
    assert len(warnings) == 1
    assert said in warnings[0]


def test_the_remedy_for_a_header_with_a_wrong_unit(tmp_path: Path) -> None:
    """An option may not contradict a header: the warning says to correct it, and then it is gone."""
    path, x = tmp_path / "imu.csv", values(12)[:, 3:] / G
    lines = [",".join(map(repr, row)) for row in x.tolist()]
    written = "\n".join(["accel_x [m/s^2],accel_y [m/s^2],accel_z [m/s^2]", *lines])
    path.write_text(written)
    (warning,) = aj.inspect(aj.read(path, rate=RATE)).warnings
    assert warning.endswith("--accel-unit g, or correct the header if it says another unit")
    with pytest.raises(aj.UnitError, match="correct the header"):
        aj.read(path, rate=RATE, accel_unit="g")
    path.write_text(written.replace("m/s^2", "g"))
    assert aj.inspect(aj.read(path, rate=RATE)).warnings == ()


def test_units_that_can_be() -> None:
    assert scaled(1.0, 1.0) == []
    assert scaled(1.0 / DEG, 1.0 / G, gyro_unit="deg/s", accel_unit="g") == []
    assert scaled(1.0, 1.0 / RATE, accel_unit="m/s") == []
    x = values(13)
    # On its side; without gravity, as a simulation; one accelerometer that is level.
    assert aj.inspect(recording(x[:, [0, 1, 2, 5, 3, 4]])).warnings == ()
    assert aj.inspect(recording(x - LEVEL)).warnings == ()
    level = Recording.from_array(x[:, 3:4] + 0.5, RATE, names=["accel_x"], accel_unit="m/s²")
    assert aj.inspect(level).warnings == ()


def test_a_rate_beside_stamps_that_say_another() -> None:
    x = values(14)
    stamps = np.arange(len(x)) * 0.001
    given = Recording.from_array(
        x, RATE, names=NAMES, gyro_unit="rad/s", accel_unit="m/s²", auxiliary={"time": stamps}
    )
    (warning,) = aj.inspect(given).warnings
    assert "1000 Hz" in warning
    assert "100 Hz" in warning
    right = dataclasses.replace(given, auxiliary={"time": stamps * 1e4})
    assert aj.inspect(right).warnings == ()


def test_coarse_data() -> None:
    x = values(15)
    steps = 5.0 * SIGMA
    rounded = recording(steps * np.round((x - LEVEL) / steps) + LEVEL)
    warnings = aj.inspect(rounded).warnings
    assert len(warnings) == 6
    assert "distinct values: its noise is below its resolution" in warnings[0]
    held = aj.inspect(recording(np.repeat(x[:15_000], 2, axis=0)))
    # Of 15 neighbours in a block of 16, eight are pairs.
    assert "53 % of its samples repeat" in held.warnings[0]
    short = aj.inspect(recording(x[:100]))
    assert "1 s: too short for B and K" in short.warnings[0]
    assert "10 % at best" in short.warnings[0]


def test_what_moves_is_no_measurement_of_the_sensor():
    """Two axes that move by what no sensor does are a moving platform; of one alone the others are known."""
    rng = np.random.default_rng(12)
    t = np.arange(20_000) / 100.0
    white = 1e-3 * rng.standard_normal((len(t), 3))
    swing = np.stack([0.2 * np.sin(2.0 * np.pi * 0.3 * t + k) for k in range(3)], axis=1)
    names = ["gyro_x", "gyro_y", "gyro_z"]
    for moving, measured in (([1, 1, 0], [False] * 3), ([1, 0, 0], [False, True, True])):
        recording = aj.Recording.from_array(white + moving * swing, 100.0, gyro_unit="rad/s", names=names)
        found = aj.fit(recording, "N + K")
        assert [result.measured for result in found.values()] == measured
        assert "this does not look like a static recording" in found.warnings[0]
        assert np.isnan(found["gyro_x"]["N"].std)
        assert "not a measurement of this sensor" in str(found["gyro_x"]["N"])
        vibrating = aj.fit(recording, "N + K", vibrating=True)
        # White noise of 1e-3 rad/s at 100 Hz: N = 1e-4 rad/√s; of 20,000 samples to 1 % (4 σ: 2 %).
        assert vibrating["gyro_z"].measured
        assert vibrating["gyro_z"]["N"].value == pytest.approx(1e-4, rel=0.03)


def test_a_shift_of_a_single_window_has_the_size_of_the_motion():
    """A swing of ±0.3 rad/s at 0.35 Hz: its means over windows of 1.6 s differ by 0.6·sinc(0.55) at most."""
    rate, n = 20.0, 36_000
    rng = np.random.default_rng(35)
    x = rng.standard_normal((n, 1)) * 1e-4 * np.sqrt(rate)
    f = rng.uniform(0.02, 1.5)
    x[:, 0] += 0.3 * np.sin(2.0 * np.pi * f * np.arange(n) / rate + 35)
    seen = aj.inspect(aj.Recording.from_array(x, rate, gyro_unit="rad/s", names=["gyro_x"]))
    (event,) = (e for e in seen.events if e.kind == "shift")
    assert (event.last - event.first) / rate <= 1.6
    assert 0.02 < event.size < 0.6 * np.sinc(1.6 * f)
    assert "moves by 0 " not in str(seen)

"""Recordings in memory."""

import math

import numpy as np
import pytest

from allanjax.base.errors import RecordingError, UnitError
from allanjax.record.recording import Recording

DEG = math.pi / 180
G0 = 9.80665


@pytest.fixture
def noise():
    return np.random.default_rng(0).normal(size=(100, 6))


@pytest.fixture
def recording(noise):
    temperature = np.linspace(20, 30, 100)
    return Recording.from_array(
        noise, 50.0, gyro_unit="deg/s", accel_unit="g", auxiliary={"temperature": temperature}, name="unit"
    )


def test_six_columns_are_gyro_then_accel(recording, noise):
    assert recording.names == ("gyro_x", "gyro_y", "gyro_z", "accel_x", "accel_y", "accel_z")
    assert any("column order taken as gyro_x" in note for note in recording.notes)
    np.testing.assert_allclose(recording.values[:, :3], noise[:, :3] * DEG)
    np.testing.assert_allclose(recording.values[:, 3:], noise[:, 3:] * G0)
    np.testing.assert_allclose(recording.own_values, noise)
    assert [axis.unit for axis in recording.axes] == ["deg/s"] * 3 + ["g"] * 3
    assert (recording.n, recording.rate, recording.duration) == (100, 50.0, 2.0)
    np.testing.assert_allclose(recording.time[[0, 1, -1]], [0.0, 0.02, 1.98])


@pytest.mark.parametrize(
    ("count", "units", "names"),
    [
        (3, {"gyro_unit": "rad/s"}, ("gyro_x", "gyro_y", "gyro_z")),
        (3, {"accel_unit": "m/s²"}, ("accel_x", "accel_y", "accel_z")),
        (1, {"gyro_unit": "rad/s"}, ("gyro",)),
        (1, {"accel_unit": "m/s²"}, ("accel",)),
    ],
)
def test_default_names(noise, count, units, names):
    recording = Recording.from_array(noise[:, :count], 1.0, **units)
    assert recording.names == names
    assert recording.notes


def test_one_dimensional_array(noise):
    recording = Recording.from_array(noise[:, 0], 1.0, gyro_unit="rad/s")
    np.testing.assert_array_equal(recording.values, noise[:, :1])


def test_increments_are_multiplied_by_the_rate(noise):
    recording = Recording.from_array(
        noise[:, :2], 200.0, names=["gyro_z", "accel_x"], gyro_unit="arcsec", accel_unit="mm/s"
    )
    np.testing.assert_allclose(recording.values[:, 0], noise[:, 0] * 200 * DEG / 3600)
    np.testing.assert_allclose(recording.values[:, 1], noise[:, 1] * 0.2)
    np.testing.assert_allclose(recording.own_values, noise[:, :2])
    assert "increments multiplied by the rate: gyro_z, accel_x" in recording.notes


def test_select(recording):
    assert recording.select("accel").names == ("accel_x", "accel_y", "accel_z")
    assert recording["gyro_z"].names == ("gyro_z",)
    assert recording["accel_y", "gyro"].names == ("accel_y", "gyro_x", "gyro_y", "gyro_z")
    np.testing.assert_array_equal(recording["accel_y"].values[:, 0], recording.values[:, 4])
    assert "temperature" in recording["gyro"].auxiliary
    with pytest.raises(RecordingError, match=r"no axis 'mag'.*gyro_x"):
        recording.select("mag")


def test_between(recording):
    part = recording.between(0.5, 1.5)
    np.testing.assert_array_equal(part.values, recording.values[25:75])
    np.testing.assert_array_equal(part.auxiliary["temperature"], recording.auxiliary["temperature"][25:75])
    assert part.notes[-1] == "samples 25 to 74 of 100 taken"
    assert recording.between(stop=1.0).n == 50
    with pytest.raises(RecordingError, match=r"unit: too short: 5 samples.*start="):
        recording.between(1.9)


def test_display(recording):
    assert repr(recording).startswith("<Recording 'unit': gyro_x [deg/s], ")
    assert "100 samples at 50 Hz, 2 s" in repr(recording)
    table = recording._repr_html_().replace(" style='text-align:left'", "")
    mean = recording.own_values[:, 3].mean()
    assert f"<td>accel_x</td><td>accel</td><td>g</td><td>{mean:.6g}</td>" in table
    assert "column order" in table


def _bad(noise, value):
    values = noise.copy()
    values[[7, 9], 1] = value
    return values


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda x: {"values": _bad(x, np.nan)}, ["'gyro_y'", "2 values", "row 7", "nan", "start="]),
        (lambda x: {"values": _bad(x, np.inf)}, ["'gyro_y'", "2 values", "row 7", "inf", "start="]),
        (lambda x: {"values": 0.0 * x}, ["'gyro_x'", "constant", "columns="]),
        (lambda x: {"values": x[:15]}, ["too short: 15 samples", "16", "longer"]),
        (lambda x: {"values": x[:20].T[:, :3][:0]}, ["shape", "values.T"]),
        (lambda x: {"values": x.T}, ["(6, 100)", "transposed", "values.T"]),
        (lambda x: {"values": x[None]}, ["(1, 100, 6)", "reshape"]),
        (lambda x: {"values": x[:, :4]}, ["4 columns without names", "names="]),
        (lambda x: {"values": x[:, :3]}, ["3 columns without names", "gyro_unit= and accel_unit=", "names="]),
        (lambda x: {"names": ["gyro_x"]}, ["1 names for 6 columns", "names="]),
        (lambda x: {"names": ["gx", "gy", "gz", "ax", "ay", "mag"]}, ["'mag'", "auxiliary="]),
        (lambda x: {"names": ["gx", "gyro_x", "gz", "ax", "ay", "az"]}, ["'gx' and 'gyro_x'", "both gyro_x"]),
        (lambda x: {"auxiliary": {"temperature": np.ones(3)}}, ["'temperature'", "(3,)", "(100,)"]),
        *((lambda x, rate=rate: {"rate": rate}, ["positive", "rate="]) for rate in (0, -1.0, np.nan, np.inf)),
    ],
)
@pytest.mark.usefixtures("unchecked_shapes")
def test_bad_arrays(noise, change, said):
    arguments = {"values": noise, "rate": 50.0, "gyro_unit": "deg/s", "accel_unit": "g", "name": "unit 7"}
    with pytest.raises(RecordingError) as caught:
        Recording.from_array(**(arguments | change(noise)))
    assert str(caught.value).startswith("unit 7: ")
    for text in said:
        assert text in str(caught.value)


def test_missing_and_unknown_units(noise):
    names = ["gyro_x", "accel_x"]
    with pytest.raises(UnitError, match=r"'accel_x' has no unit; pass accel_unit= \(--accel-unit\)"):
        Recording.from_array(noise[:, :2], 1.0, names=names, gyro_unit="deg/s")
    with pytest.raises(UnitError, match=r"'gyro_x': unknown unit 'g' for a gyro.*accelerometer"):
        Recording.from_array(noise[:, :2], 1.0, names=names, gyro_unit="g", accel_unit="g")
    with pytest.raises(UnitError, match="increments"):
        Recording.from_array(noise[:, 0], 1.0, names=["delta_angle_x"], gyro_unit="deg/s")


@pytest.mark.parametrize("rate", [None, "100", np.array([100.0]), np.nan, np.inf, 1j, 0, -1.0])
def test_a_rate_that_is_no_positive_number_is_refused(rate):
    with pytest.raises(RecordingError, match="sample rate must be a positive number of Hz"):
        Recording.from_array(np.arange(100.0), rate, names=["gyro_x"], gyro_unit="rad/s")

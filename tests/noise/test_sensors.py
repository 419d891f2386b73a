"""The presets against tables 5.2, 5.4 and 5.5 of Hou (2004), converted by hand."""

import math

import numpy as np
import pytest

from allanjax.base.errors import AllanjaxError, RecordingError
from allanjax.noise.sensors import SENSORS

ARCSEC = math.pi / 648000
DEG = math.pi / 180
HOUR = 3600.0

# (unit, axis): the rate [Hz] and each coefficient in SI.
TABLES = {
    ("cimu", "gyro_x"): (200, {"quantization": 0.9732 * ARCSEC, "angle_random_walk": 0.0015 * DEG / 60}),
    ("cimu", "gyro_y"): (200, {"quantization": 0.5174 * ARCSEC, "angle_random_walk": 0.0019 * DEG / 60}),
    ("cimu", "gyro_z"): (200, {"quantization": 0.5770 * ARCSEC, "angle_random_walk": 0.0018 * DEG / 60}),
    ("cimu", "accel_x"): (200, {"quantization": 1.6801 / HOUR, "drift_ramp": 2.6364 / HOUR**2}),
    ("cimu", "accel_y"): (200, {"quantization": 1.2980 / HOUR, "drift_ramp": 0.8915 / HOUR**2}),
    ("cimu", "accel_z"): (200, {"quantization": 0.8785 / HOUR, "drift_ramp": 0.3915 / HOUR**2}),
    ("hg1700", "gyro_x"): (100, {"quantization": 5.1154 * ARCSEC, "angle_random_walk": 0.0936 * DEG / 60}),
    ("hg1700", "gyro_y"): (100, {"quantization": 1.2742 * ARCSEC, "angle_random_walk": 0.0883 * DEG / 60}),
    ("hg1700", "gyro_z"): (100, {"quantization": 1.2316 * ARCSEC, "angle_random_walk": 0.0753 * DEG / 60}),
    ("hg1700", "accel_x"): (100, {"quantization": 2.1188 / HOUR, "rate_random_walk": 0.7637 / HOUR / 60}),
    ("hg1700", "accel_y"): (100, {"quantization": 2.1988 / HOUR, "rate_random_walk": 1.1572 / HOUR / 60}),
    ("hg1700", "accel_z"): (100, {"quantization": 2.1845 / HOUR, "rate_random_walk": 3.3514 / HOUR / 60}),
    ("motionpak2", "gyro_x"): (
        100,
        {"angle_random_walk": 0.5121 * DEG / 60, "bias_instability": 13.58 * DEG / HOUR},
    ),
    ("motionpak2", "gyro_y"): (
        100,
        {"angle_random_walk": 0.4859 * DEG / 60, "bias_instability": 11.69 * DEG / HOUR},
    ),
    ("motionpak2", "gyro_z"): (
        100,
        {"angle_random_walk": 0.4891 * DEG / 60, "bias_instability": 16.79 * DEG / HOUR},
    ),
    ("motionpak2", "accel_x"): (1000, {"angle_random_walk": 0.01664 / 60, "bias_instability": 4.36 / HOUR}),
    ("motionpak2", "accel_y"): (1000, {"angle_random_walk": 0.01593 / 60, "bias_instability": 4.09 / HOUR}),
    ("motionpak2", "accel_z"): (1000, {"angle_random_walk": 0.01612 / 60, "bias_instability": 4.36 / HOUR}),
}

# The errors, in the tables' own units and order.
ERRORS = {
    "cimu": [0.0738, 0.0005, 0.0197, 0.0006, 0.0155, 0.0006, 0.1275, 0.8795, 0.0985, 0.2974, 0.0666, 0.1309],
    "hg1700": [
        0.0683,
        0.0312,
        0.0032,
        0.0295,
        0.0028,
        0.0251,
        0.0673,
        0.2548,
        0.1176,
        0.3860,
        0.0583,
        1.1180,
    ],
    "motionpak2": [0.0068, 1.36, 0.0065, 1.17, 0.0065, 1.68, 3e-5, 0.04, 3e-5, 0.08, 3e-5, 0.08],
}


def test_every_axis_of_every_unit_is_there():
    assert list(TABLES) == [(name, axis.name) for name, preset in SENSORS.items() for axis in preset.axes]


@pytest.mark.parametrize(("name", "axis"), TABLES)
def test_coefficients_are_the_tables(name, axis):
    rate, values = TABLES[name, axis]
    assert SENSORS[name].rate(axis) == rate
    found = SENSORS[name].model(axis).values
    # The cutoff frequency is infinite: the thesis reads the flat part of the curve.
    assert {k: v for k, v in found.items() if v != math.inf} == pytest.approx(values, rel=1e-12)


@pytest.mark.parametrize("name", ERRORS)
def test_errors_are_the_tables(name):
    found = [c.error for axis in SENSORS[name].axes for c in axis.coefficients.values()]
    assert found == ERRORS[name]


def test_one_recording_for_each_rate():
    gyros, accels = SENSORS["motionpak2"].simulate(5.0, 1)
    assert gyros.names == ("gyro_x", "gyro_y", "gyro_z")
    assert accels.names == ("accel_x", "accel_y", "accel_z")
    assert (gyros.rate, gyros.n, accels.rate, accels.n) == (100.0, 500, 1000.0, 5000)
    (cimu,) = SENSORS["cimu"].simulate(1.0, 1)
    assert len(cimu.axes) == 6
    again = SENSORS["motionpak2"].simulate(5.0, 1)[0]
    np.testing.assert_array_equal(again.values, gyros.values)
    # White noise of N√rate: its standard deviation to four standard errors, and the flicker is far below.
    expected = 0.5121 * DEG / 60 * math.sqrt(100)
    assert gyros.values[:, 0].std() == pytest.approx(expected, rel=4 / math.sqrt(2 * 500))


def test_unknown_axes_and_empty_records_are_refused():
    with pytest.raises(AllanjaxError, match="cimu has no axis 'gyro_w'; it has gyro_x"):
        SENSORS["cimu"].model("gyro_w")
    for duration in (0.0, -1.0, math.nan, math.inf):
        with pytest.raises(AllanjaxError, match="duration must be positive and finite"):
            SENSORS["cimu"].simulate(duration, 1)
    with pytest.raises(RecordingError, match="10 samples"):
        SENSORS["cimu"].simulate(10 / 200, 1)

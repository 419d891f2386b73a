"""Leveling and gyro-compassing: against closed forms, a simulation of two positions, and refusals."""

import math

import numpy as np
import pytest

import allanjax as aj
from allanjax.base.earth import EARTH_RATE

DEG = math.pi / 180.0
N, K = 6e-7, 2e-9
EARTH = EARTH_RATE * math.cos(51.0 * DEG)


def test_white_noise_takes_the_time_of_the_thesis():
    """(2.53): T = [N/(ω_e cos φ dA)]², between two times of the grid, where a power law is exact."""
    found = aj.align({"gyro_x": aj.AngleRandomWalk(N)}, 51.0, "0.1 deg", rate=100.0)["gyro_x"]
    assert found.needed == pytest.approx((N / (EARTH * 0.1 * DEG)) ** 2, rel=1e-9)
    assert found.white_time == pytest.approx(found.needed, rel=1e-9)
    np.testing.assert_allclose(found.error, N / EARTH / np.sqrt(found.time), rtol=1e-9)
    assert found.falling
    assert found.out_of_reach == 0.0


def test_a_walk_makes_an_optimum():
    """The variance N²/T + K²T/12 is least at T = √12·N/K and N·K/√3 there, to a grid of 8 an octave.

    It is within 2 % of the least at 0.82 of that time, hence T within 10 % (a step of the grid) of it.
    """
    models = {"gyro_x": aj.AngleRandomWalk(N) + aj.RateRandomWalk(K)}
    least = math.sqrt(N * K / math.sqrt(3.0)) / EARTH
    found = aj.align(models, 51.0, 1.5 * least, rate=10.0)["gyro_x"]
    assert found.best == pytest.approx(least, rel=1e-3)
    assert found.best_time == pytest.approx(0.82 * math.sqrt(12.0) * N / K, rel=0.1)
    # The smaller root of N²/T + K²T/12 = wanted².
    wanted = (1.5 * least * EARTH) ** 2
    root = (wanted - math.sqrt(wanted**2 - N**2 * K**2 / 3.0)) / (K**2 / 6.0)
    assert found.needed == pytest.approx(root, rel=1e-3)
    assert found.needed > found.white_time
    beyond = aj.align(models, 51.0, 0.9 * least, rate=10.0)
    assert math.isinf(beyond["gyro_x"].needed)
    assert beyond["gyro_x"].out_of_reach == 1.0
    assert not beyond["gyro_x"].falling
    assert "is out of reach; white noise alone would take" in str(beyond)


def test_half_the_difference_of_two_positions_is_as_accurate_as_told():
    """4,000 gyros by NumPy, turned half-way: a standard deviation scatters by 1.1 %, within 4 %."""
    rng = np.random.default_rng(5)
    count, n, h = 4000, 400, 1.0
    steps, bridge = rng.standard_normal((2, count, n)) * K * math.sqrt(h)
    walk = np.cumsum(steps, axis=1) - steps / 2.0 + bridge / math.sqrt(12.0)
    z = N / math.sqrt(h) * rng.standard_normal((count, n)) + walk + 1e-3 * rng.standard_normal((count, 1))
    azimuth = (z[:, : n // 2].mean(axis=1) - z[:, n // 2 :].mean(axis=1)) / 2.0 / EARTH
    found = aj.align({"gyro_x": aj.AngleRandomWalk(N) + aj.RateRandomWalk(K)}, 51.0, rate=1.0)["gyro_x"]
    told = np.interp(n * h, found.time, found.error)
    assert azimuth.std() == pytest.approx(told, rel=0.04)


def test_tilt_is_an_accelerometers_error_over_gravity():
    """(2.45): 100 µg that remain are 20.6 arcsec."""
    models = {"accel_x": aj.AngleRandomWalk(1e-9)}
    found = aj.align(models, 0.0, rate=10.0, accel_bias="100 µg")["accel_x"]
    assert found.angle == "tilt"
    assert found.best == pytest.approx(1e-4, rel=1e-6)


@pytest.fixture(scope="module")
def fit():
    """Two gyros of a navigator, two hours at 2 Hz, of white noise and a walk."""
    model = aj.AngleRandomWalk(N) + aj.RateRandomWalk(K)
    recording = aj.simulate_recording({"gyro_x": model, "gyro_y": model}, 14_400, 2.0, 4)
    return aj.fit(recording, "N + K", as_is=True)


def test_intervals_of_a_fit_hold_the_truth(fit):
    """Best azimuth, its time and the time needed, of two gyros: of six intervals of 95 % one may miss."""
    least = math.sqrt(N * K / math.sqrt(3.0)) / EARTH
    exact = aj.align({"gyro_x": aj.AngleRandomWalk(N) + aj.RateRandomWalk(K)}, 51.0, 1.5 * least, rate=2.0)
    truth, found = exact["gyro_x"], aj.align(fit, 51.0, 1.5 * least)
    hits = []
    for result in found.values():
        for name in ("best", "best_time", "needed"):
            low, high = getattr(result, f"{name}_interval")
            hits.append(low <= getattr(truth, name) <= high)
            assert low <= getattr(result, name) <= high
            assert high < 10.0 * low
        assert result.out_of_reach < 0.05
    assert sum(hits) >= 5


def test_an_azimuth_at_the_edge_may_be_out_of_reach(fit):
    least = aj.align(fit, 51.0)["gyro_x"].best
    found = aj.align(fit, 51.0, least * 1.001)["gyro_x"]
    assert 0.1 < found.out_of_reach < 0.9
    assert math.isinf(found.needed_interval[1])
    assert "out of reach with probability" in found.verdict()
    assert "never" in found.verdict()


def test_the_table_frame_and_document(fit):
    found = aj.align(fit, 51.0, "1 deg")
    text = str(found)
    for words in ("at 51° of latitude", "best azimuth", "deg", "within 1 % of it", "white noise alone"):
        assert words in text
    frame, document = found.to_dataframe(), found.to_dict()
    assert frame[frame.axis == "gyro_x"].error.min() == document["axes"][0]["best"]


def test_the_title_names_what_the_sensors_do():
    gyro, accel = {"gyro_x": aj.AngleRandomWalk(N)}, {"accel_x": aj.AngleRandomWalk(N)}
    told = [str(aj.align(of, 51.0, rate=1.0)) for of in (gyro, accel, gyro | accel)]
    assert told[0].startswith("gyro-compassing at 51°")
    assert told[1].startswith("leveling at 51°")
    assert told[2].startswith("leveling and gyro-compassing at 51°")
    assert not any("interval" in text for text in told)


def test_a_gyro_that_cannot_find_north_says_so(small_fit):
    found = aj.align(small_fit, 51.0)
    assert "gyro_x" in found
    assert "gyro_z" not in found
    assert "azimuth not found: its error is never below" in str(found)


@pytest.mark.parametrize(
    ("latitude", "azimuth", "options", "message"),
    [
        (90.0, None, {}, "no horizontal part to tell north by"),
        (-89.5, None, {}, "below 89 deg"),
        (91.0, None, {}, "the latitude must be from -90 to 90"),
        (math.nan, None, {}, "the latitude must be from"),
        (51.0, "0.1 m", {}, "cannot convert"),
        (51.0, 0.0, {}, "give one that is positive"),
        (51.0, -1.0, {}, "azimuth must be finite and not negative"),
        (51.0, None, {"gravity": -1.0}, "gravity must be positive"),
    ],
)
def test_what_is_wrong_is_refused(latitude, azimuth, options, message):
    with pytest.raises(aj.AllanjaxError, match=message):
        aj.align({"gyro_x": aj.AngleRandomWalk(N)}, latitude, azimuth, rate=1.0, **options)


def test_no_level_axis_is_refused():
    with pytest.raises(aj.AllanjaxError, match="no level axis, x or y; there are gyro_z"):
        aj.align({"gyro_z": aj.AngleRandomWalk(N)}, 51.0, rate=1.0)

"""Leveling and gyro-compassing: against closed forms, draws, and refusals."""

import dataclasses
import math

import bench
import numpy as np
import pytest
from refusals import refuses

import allanjax as aj

DEG = math.pi / 180.0
N, K = 6e-7, 2e-9
WALKING = aj.AngleRandomWalk(N) + aj.RateRandomWalk(K)
EARTH = 7.292115e-5 * math.cos(51.0 * DEG)
#: The least error of white noise and a walk, N·K/√3 of the variance.
LEAST = math.sqrt(N * K / math.sqrt(3.0)) / EARTH


def test_white_noise_takes_the_time_of_the_thesis():
    """(2.53): T = [N/(ω_e cos φ dA)]², between two times of the grid, where a power law is exact."""
    found = aj.align({"gyro_x": aj.AngleRandomWalk(N)}, 51.0, "0.1 deg", rate=100.0)["gyro_x"]
    assert found.wanted == pytest.approx(0.1 * DEG)
    assert found.needed == pytest.approx((N / (EARTH * 0.1 * DEG)) ** 2, rel=1e-9)
    assert found.white_time == pytest.approx(found.needed, rel=1e-9)
    np.testing.assert_allclose(found.error, N / EARTH / np.sqrt(found.time), rtol=1e-9)
    assert found.time[[0, 1]] == pytest.approx([0.02, 0.04])
    assert 0.9 * 1e5 < found.time[-1] <= 1e5
    # Within 1 % of the least: the last time.
    assert (found.best, found.best_time) == (found.error[-1], found.time[-1])
    assert (found.falling, found.out_of_reach) == (True, 0.0)
    pairs = found.needed_interval, found.best_interval, found.best_time_interval
    assert np.isnan([*np.ravel(pairs), *found.lower]).all()


def test_a_walk_makes_an_optimum():
    """The variance N²/T + K²T/12 is least at T = √12·N/K and N·K/√3 there; within 2 % from 0.82 T on."""
    models = {"gyro_x": WALKING}
    found = aj.align(models, 51.0, 1.5 * LEAST, rate=10.0)["gyro_x"]
    expected = N**2 / found.time + K**2 * found.time / 12.0
    np.testing.assert_allclose((found.error * EARTH) ** 2, expected, rtol=2e-6)
    assert found.best == pytest.approx(LEAST, rel=1e-3)
    assert found.best_time == pytest.approx(0.82 * math.sqrt(12.0) * N / K, rel=0.1)
    # The smaller root of N²/T + K²T/12 = wanted².
    wanted = (1.5 * LEAST * EARTH) ** 2
    root = (wanted - math.sqrt(wanted**2 - N**2 * K**2 / 3.0)) / (K**2 / 6.0)
    assert found.needed == pytest.approx(root, rel=1e-3)
    assert found.white_time == pytest.approx(N**2 / wanted, rel=1e-6)
    assert not found.falling
    beyond = aj.align(models, 51.0, 0.9 * LEAST, rate=10.0)["gyro_x"]
    assert (beyond.needed, beyond.out_of_reach) == (math.inf, 1.0)
    assert ("out of reach" in beyond.verdict, "probability" in beyond.verdict) == (True, False)


def test_biases_that_remain_are_angles():
    """(2.45): 100 µg that remain are 20.6 arcsec; with another gravity they are more."""
    biases = {"accel_bias": "100 µg", "gravity": 9.8, "gyro_bias": "0.01 deg/h"}
    quiet = dict.fromkeys(("accel_y", "gyro_y"), aj.AngleRandomWalk(1e-10))
    accel, gyro = aj.align(quiet, 51.0, 1e-3, rate=10.0, **biases).values()
    assert (accel.angle, accel.wanted, gyro.angle, gyro.wanted) == ("tilt", None, "azimuth", 1e-3)
    expected = [1e-4 * 9.80665 / 9.8, 0.01 * DEG / 3600.0 / EARTH]
    np.testing.assert_allclose([accel.error[-1], gyro.error[-1]], expected, rtol=1e-5)


def test_intervals_of_a_posterior_are_those_of_its_draws():
    """Each variance is linear in the powers of the terms: all numbers by their definition from 400 draws."""
    posterior, latitude, bias = bench.posterior("small", ("gyro_x", "accel_z")), -40.0, 1e-9
    earth = 7.292115e-5 * math.cos(latitude * DEG)
    best = aj.align(posterior, latitude, gyro_bias=bias)["gyro_x"].best
    found = aj.align(posterior, latitude, 1.02 * best, gyro_bias=bias)["gyro_x"]
    at, half = found.time, found.time / 2.0
    values = [m.values for m in posterior["gyro_x"].models(400)]
    white, flicker = (np.array([v[k] for v in values]) for k in ("angle_random_walk", "bias_instability"))
    # Allan variances of N and B at half of the time, by themselves of amplitude one; that of the flicker
    # noise's means over a sample interval is below 2 ln 2/π at the first clusters.
    of_flicker = np.array(aj.BiasInstability(1.0).sampled(100.0).allan_variance(half))
    variance = (np.outer(white**2, 1.0 / half) + np.outer(flicker**2, of_flicker)) / 2.0
    np.testing.assert_allclose(of_flicker[-8:], 2.0 * math.log(2.0) / math.pi, rtol=1e-3)
    told = np.stack([variance.mean(axis=0), *np.quantile(variance, [0.025, 0.975], axis=0)])
    errors, expected = (np.sqrt(x + bias**2) / earth for x in (variance, told))
    np.testing.assert_allclose([found.error, found.lower, found.upper], expected, rtol=1e-6)
    least = errors.min(axis=1)
    first = at[np.argmax(errors <= 1.01 * least[:, None], axis=1)]
    # Errors fall before their optimum: the time by interpolation of the logs.
    falling = (row[: np.argmin(row) + 1] for row in errors)
    wanted = -math.log(found.wanted)
    logs = [np.interp(wanted, -np.log(x), np.log(at[: len(x)]), right=math.inf) for x in falling]
    reached = np.exp(logs)
    for name, values in {"best": least, "best_time": first, "needed": reached}.items():
        quantiles = [np.quantile(values, q, method="nearest") for q in (0.025, 0.975)]
        np.testing.assert_allclose(getattr(found, f"{name}_interval"), quantiles, rtol=1e-6)
    assert found.out_of_reach == np.isinf(reached).mean()
    assert 0.1 < found.out_of_reach < 0.9
    assert math.isinf(found.needed_interval[1])
    assert "never" in found.verdict


def test_intervals_of_a_fit_hold_the_truth():
    """Best azimuth, its time and the time needed, of two gyros: of six intervals of 95 % one may miss."""
    hits = []
    for name, own in bench.truth("walk").truth.items():
        model = aj.AngleRandomWalk(own["angle_random_walk"]) + aj.RateRandomWalk(own["rate_random_walk"])
        wanted = 1.5 * aj.align({name: model}, 51.0, rate=100.0)[name].best
        exact = aj.align({name: model}, 51.0, wanted, rate=100.0)[name]
        result = aj.align(bench.fit("walk", "N + K"), 51.0, wanted)[name]
        for number in ("best", "best_time", "needed"):
            low, high = getattr(result, f"{number}_interval")
            hits.append(low <= getattr(exact, number) <= high)
            assert low <= getattr(result, number) <= high < 3.0 * low
        assert result.out_of_reach < 0.05
        # Of half of the record in each position.
        assert 0.9 * 163.84 < result.time[-1] <= 163.84
    assert sum(hits) >= 5


def test_only_level_axes_are_told_with_their_numbers():
    found = aj.align(bench.fit("small"), 51.0)
    assert list(found) == ["gyro_x", "gyro_y"]
    # An error of more than 30 degrees is none.
    assert "no azimuth" in str(found)
    models = {"gyro_x": WALKING, "accel_y": aj.AngleRandomWalk(1e-4)}
    found = aj.align(models, 51.0, "1 deg", rate=2.0)
    frame, document = found.to_dataframe(), found.to_dict()
    assert document["latitude_rad"] == pytest.approx(51.0 * DEG)
    for axis, told in zip(found.values(), document["axes"], strict=True):
        rows = frame[frame.axis == axis.axis.name]
        np.testing.assert_array_equal(rows[["time", "error"]].T, [axis.time, axis.error])
        assert set(rows.angle) == {axis.angle}
        for name in ("angle", "best", "best_time", "falling", "wanted"):
            assert told[name] == getattr(axis, name)
        assert told["best_interval"] == [None, None]
        unit = {"azimuth": DEG, "tilt": DEG / 3600.0}[axis.angle]
        assert float(axis.rows()[0][2]) == pytest.approx(axis.best / unit, rel=5e-3)
    assert [told["needed"] for told in document["axes"]] == [found["gyro_x"].needed, None]


REFUSED = [
    ("gyro_x", {"latitude": -89.5}, "89 deg"), ("gyro_x", {"latitude": math.nan}, "latitude"),
    ("gyro_x", {"azimuth": "0.1 m"}, "convert"), ("gyro_x", {"azimuth": 0.0}, "azimuth"),
    ("gyro_x", {"gravity": -1.0}, "gravity"), ("gyro_x", {"gyro_bias": "x"}, "gyro_bias"),
    ("gyro_x", {"accel_bias": -1.0}, "accel_bias"), ("gyro_z", {}, "gyro_z"),
]  # fmt: skip


def test_what_is_wrong_is_refused():
    for axis, options, word in REFUSED:
        refuses(word, aj.align, {axis: aj.AngleRandomWalk(N)}, **{"latitude": 51.0, "rate": 1.0} | options)
    fit = bench.fit("white", "N")
    short = dataclasses.replace(fit, curve=dataclasses.replace(fit.curve, n=3))
    refuses("samples", aj.align, short, 51.0)

"""Growth of a navigator's errors: against dense covariances, the thesis, mpmath, and draws."""

import dataclasses
import json
import math
import re

import bench
import dense
import mpmath as mp
import numpy as np
import pytest
from altered_fits import without_result
from numpy.testing import assert_allclose, assert_array_equal
from refusals import refuses
from scipy.linalg import expm

import allanjax as aj

DEG = math.pi / 180.0
RATE, RADIUS, G = 20.0, 6_371_000.0, 9.80665
QUIET = aj.AngleRandomWalk(1e-12)


def test_the_thesis_numbers():
    """100 µg and 0.2 deg/h after 10 s and 1,000 s, with g = 10 m/s² (2.38–2.40), to the digits printed."""
    by_accel = aj.navigate({"accel_x": QUIET}, [10, 1000], rate=RATE, accel_bias=1e-3)
    assert_allclose(by_accel["position"].of("north"), [0.05, 500.0], rtol=1e-6)
    by_gyro = aj.navigate({"gyro_y": QUIET}, [10, 1000], rate=RATE, gyro_bias="0.2 deg/h", gravity=10.0)
    found, rad = by_gyro["position"].of("north"), 0.2 * DEG / 3600.0
    assert (f"{found[0]:.4f}", found[1]) == ("0.0016", pytest.approx(1600.0, rel=0.011))
    assert_allclose(by_gyro["velocity"].of("north"), 10.0 * rad * np.array([50.0, 5e5]), rtol=1e-6)
    assert_allclose(by_gyro["attitude"].of("east"), rad * np.array([10.0, 1000.0]), rtol=1e-6)


MODELS = {
    "N": aj.AngleRandomWalk(1e-3), "B": aj.BiasInstability(2e-4), "K": aj.RateRandomWalk(1e-4),
    "Q": aj.Quantization(1e-5), "markov": aj.Markov(1e-4, 3.0), "sinusoid": aj.Sinusoid(1e-3, 3.3),
    "ramp": aj.DriftRamp(1e-7), "N + K": aj.AngleRandomWalk(1e-3) + aj.RateRandomWalk(1e-4),
}  # fmt: skip
MODELS["filter"] = aj.LowPass1(4.0) * MODELS.pop("N + K")
BEFORE, AFTER = 90, 60


def weights(stiffness):
    """What each sample's error does to φ, v and p after 60 samples: φ' = ε − k·v, v' = φ, p' = v."""
    # With the samples of the calibration before, whose mean is taken out.
    A = np.zeros((4, 4))
    A[0, 3], A[0, 1], A[1, 0], A[2, 1] = 1.0, -stiffness, 1.0, 1.0
    step = expm(A / RATE)
    states = [np.linalg.matrix_power(step[:3, :3], k) @ step[:3, 3] for k in range(AFTER - 1, -1, -1)]
    after = np.stack(states, axis=1)
    before = np.repeat(-after.mean(axis=1, keepdims=True) * AFTER / BEFORE, BEFORE, axis=1)
    return np.concatenate([before, after], axis=1)


@pytest.mark.parametrize("name", MODELS)
def test_errors_are_those_of_a_dense_covariance(name):
    """A gravity of 0.01·R makes a loop of 63 s; rounding of G's cancelling parts allows 10⁻⁷."""
    model, gravity = MODELS[name], 0.01 * RADIUS
    axes = dict.fromkeys(("gyro_y", "gyro_z", "accel_x", "accel_z"), model)
    axes |= dict.fromkeys(("gyro_x", "accel_y"), aj.AngleRandomWalk(2e-3))
    C, of_white = dense.covariance(model, BEFORE + AFTER, RATE), 2e-3**2 * RATE * np.eye(BEFORE + AFTER)
    for schuler in (False, True):
        options = {"rate": RATE, "at_rest": BEFORE / RATE, "gravity": gravity, "schuler": schuler}
        found = aj.navigate(axes, [AFTER / RATE], **options)

        def errors(C, k):
            return np.sqrt(np.einsum("ai,ij,aj->a", w := weights(k), C, w))

        # The tilt loop has ω² = g/R, the vertical channel −2g/R, the heading none.
        k = 0.01 * schuler
        level, vertical = errors(C, k), errors(C, -2.0 * k)
        tilt = np.stack([level, errors(of_white, k)], axis=1)
        expected = {
            "attitude": (tilt[0, 1], tilt[0, 0], errors(C, 0.0)[0]),
            "velocity": (*np.hypot(tilt[0], gravity * tilt[1]), vertical[0]),
            "position": (*np.hypot(tilt[1], gravity * tilt[2]), vertical[1]),
        }
        for quantity, error in expected.items():
            assert found[quantity].channels == ("north", "east", "down")
            assert_allclose(found[quantity].error[:, 0], error, rtol=1e-7)
        for axis, error in (("gyro_y", gravity * level[2]), ("accel_x", level[1])):
            parts = [p[0] for cause, p in found["position"].causes["north"].items() if cause.startswith(axis)]
            assert math.hypot(*parts) == pytest.approx(error, rel=1e-7)


@pytest.mark.parametrize(
    ("rate", "times"), [(1000.0, [1e-3, 1.0]), (2.0, [0.5, 500, 805, 806, 807, 5000, 2e4])]
)
def test_responses_to_a_bias_are_exact_from_a_millisecond_to_hours(rate, times):
    """mpmath with 50 digits, on both sides of 806 s, where the series ends; a bias by itself."""
    models = {"gyro_y": QUIET, "accel_x": QUIET, "accel_z": QUIET}
    found = aj.navigate(models, times, rate=rate, schuler=True, gyro_bias=3e-6, accel_bias=2e-3)

    def exact(order, k):
        with mp.workdps(50):
            w, found = mp.sqrt(k), []
            for t in map(mp.mpf, times):
                sine = mp.sin(w * t) / w
                found.append(float(mp.re([sine, (1 - mp.cos(w * t)) / w**2, (t - sine) / w**2][order - 1])))
            return np.array(found)

    for channel, cause, size, k, orders in (
        ("east", "gyro_y bias", 3e-6, G / RADIUS, {"attitude": 1}),
        ("north", "gyro_y bias", 3e-6 * G, G / RADIUS, {"velocity": 2, "position": 3}),
        ("north", "accel_x bias", 2e-3, G / RADIUS, {"velocity": 1, "position": 2}),
        ("down", "accel_z bias", 2e-3, -2.0 * G / RADIUS, {"velocity": 1, "position": 2}),
    ):
        for quantity, order in orders.items():
            expected = np.abs(size * exact(order, k))
            assert_allclose(found[quantity].causes[channel][cause], expected, rtol=3e-12)


@pytest.fixture(scope="module")
def result():
    return aj.navigate(bench.fit("small"), at_rest=50.0, gyro_bias="2 deg/h", accel_bias=1e-3)


def test_a_fit_is_told_with_causes_and_intervals(result):
    time, frame = result["attitude"].time, result.to_dataframe()
    document, units = json.loads(json.dumps(result.to_dict(), allow_nan=False)), ("rad", "m/s", "m")
    assert list(result) == ["attitude", "velocity", "position"]
    assert time[[0, -1]] == pytest.approx([1.0, 1000.0])
    for (quantity, growth), unit in zip(result.items(), units, strict=True):
        assert growth.channels == ("north", "east", "down")
        assert np.all((growth.lower < growth.error) & (growth.error < growth.upper))
        numbers = {"error": growth.error, "lower_95": growth.lower, "upper_95": growth.upper}
        for k, channel in enumerate(growth.channels):
            parts = growth.causes[channel]
            assert_allclose(sum(p**2 for p in parts.values()), growth.error[k] ** 2, rtol=1e-9)
            largest = [max(parts, key=lambda name, j=j: parts[name][j]) for j in range(len(time))]
            assert growth.largest(channel) == largest
            rows = frame[(frame.quantity == quantity) & (frame.channel == channel)]
            told = document["errors"][quantity]["channels"][channel]
            # Without an accelerometer along x and y the errors are lower bounds.
            is_bound = quantity != "attitude" and channel != "down"
            assert (channel in growth.bounds, told["is_bound"], *rows.is_bound.unique()) == (is_bound,) * 3
            for name, own in numbers.items():
                assert_array_equal(rows[name], own[k])
                assert told[name] == [float(x) if np.isfinite(x) else None for x in own[k]]
            assert np.isinf(growth.upper[k]).all() == is_bound
            assert set(rows.unit) == {unit}
    assert (document["at_rest_s"], document["rate_hz"], document["gravity_m_s2"]) == (50.0, 100.0, G)
    # There is an accelerometer along z only.
    assert any("velocity and position north" in note for note in result.notes)


def test_intervals_of_a_posterior_are_those_of_its_draws():
    """Each variance is linear in the powers of the terms: quantiles of 400 draws, and biases beside them."""
    posterior, t = bench.posterior("small", ("gyro_x", "accel_z")), np.array([1.0, 10.0, 60.0])
    found = aj.navigate(posterior, t, at_rest=40.0, gyro_bias=3e-6, accel_bias=2e-4)
    for name, quantity, channel, bias in (
        ("gyro_x", "attitude", "north", 3e-6 * t),
        ("accel_z", "position", "down", 2e-4 * t**2 / 2.0),
    ):
        models, variances = posterior[name].models(400), bias**2
        for k, term in enumerate(models[0].terms):
            # That of a term of amplitude one by itself.
            unit = aj.navigate({name: type(term)(1.0)}, t, rate=100.0, at_rest=40.0)[quantity].of(channel)
            amplitude = term.amplitude_parameter().name
            squares = np.square([getattr(model.terms[k], amplitude) for model in models])
            variances = variances + np.outer(squares, unit**2)
        growth, k = found[quantity], found[quantity].channels.index(channel)
        expected = [variances.mean(axis=0), *np.quantile(variances, [0.025, 0.975], axis=0)]
        assert_allclose([growth.error[k], growth.lower[k], growth.upper[k]], np.sqrt(expected), rtol=1e-9)


def test_tables_tell_decades(result):
    """Of 30 times of an exact model between 0.7 s and 2,000 s, neighbours are 0.12 decades apart."""

    def cells(shown):
        rows = [line.replace(",", "") for line in str(shown).splitlines() if line[-1:].isdigit()]
        # The last column is the share of the largest cause.
        return [[float(x) for x in re.findall(r"(?<!\w)[\d.]+", row)[:-1]] for row in rows]

    attitude = result["attitude"]
    for row, at in zip(cells(result)[:4], (0, 6, 12, 18), strict=True):
        numbers = [x[0, at] / DEG for x in (attitude.error, attitude.lower, attitude.upper)]
        assert_allclose(row, [10.0 ** (at / 6), *numbers], rtol=6e-3)
    exact = aj.navigate({"gyro_x": QUIET}, np.geomspace(0.7, 2000.0, 30), rate=RATE)
    assert "interval" not in str(exact)
    assert np.isnan(exact["attitude"].lower).all()
    assert_allclose(np.log10([row[0] for row in cells(exact)[:5]]), [0, 1, 2, 3, np.log10(2000.0)], atol=0.07)


def test_what_a_result_is_good_for_is_noted():
    """A quarter of the Schuler period, half of the record, axes without a measurement."""
    models = {"gyro_y": QUIET, "accel_x": QUIET}
    assert aj.navigate(models, [10.0], rate=1.0).quarter_period == pytest.approx(1266.05, abs=0.1)
    for last, schuler, word in ((1266.0, False, ""), (1267.0, False, "schuler="), (1267.0, True, "unstable")):
        notes = aj.navigate(models, [last], rate=1.0, schuler=schuler).notes
        assert " ".join(notes).count(word) == 1 if word else notes == ()
    bad = without_result(bench.fit("small"), "gyro_x")
    # The record has 163.84 s.
    for time, extrapolated in ((20.0, False), (23.0, True)):
        notes = " ".join(aj.navigate(bad, [time], at_rest=60.0).notes)
        assert ("extrapolate" in notes) == extrapolated
        assert "gyro_x is left out" in notes
    refuses("rate", aj.navigate, bad, rate=100.0)
    with pytest.raises(aj.FitError, match="measurement"):
        aj.navigate(dataclasses.replace(bad, results=bad.results[:1]))


REFUSED = [
    ({"rate": None}, "rate"), ({"data": {}}, "models"), ({"data": {"gyro_q": QUIET}}, "gyro_q"),
    ({"data": {"gyro_x": aj.Model(())}}, "without terms"),
    ({"times": [0.1]}, "times"), ({"at_rest": 0.0}, "at_rest"),
    ({"rate": 1e4, "times": [1e3]}, "210 s"), ({"gyro_bias": -1.0}, "gyro_bias"),
    ({"gyro_bias": "1 m/s²"}, "m/s²"), ({"gravity": 0.0}, "gravity"),
]  # fmt: skip


def test_axes_that_are_nearly_alike_are_not_taken_for_the_same():
    nearly = {axis: aj.Sinusoid(1e-6, f).hold(frequency=f) for axis, f in (("x", 0.1), ("z", 0.1000004))}
    both = aj.navigate({f"gyro_{axis}": term for axis, term in nearly.items()}, rate=10.0)["attitude"]
    alone = aj.navigate({"gyro_z": nearly["z"]}, rate=10.0)["attitude"].of("down")
    assert_allclose(both.of("down"), alone, rtol=1e-12)
    assert np.max(abs(both.of("north") / alone - 1.0)) > 1e-6


def test_what_is_wrong_is_refused(result):
    for options, word in REFUSED:
        refuses(word, aj.navigate, **{"data": {"gyro_x": QUIET}, "rate": 1.0} | options)
    with pytest.raises(aj.AllanjaxError, match="height"):
        result["height"]
    refuses("up", result["position"].of, "up")

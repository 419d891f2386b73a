"""What fits take and refuse, and what must not matter to them: units, biases, neighbours, starts."""

import dataclasses
import re

import bench
import golden_records as golden
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
from dense_fits import recording
from white_and_walk import RATE, records

import allanjax as aj

N = 2048
WHITE = aj.AngleRandomWalk()
SOME = records(1e-3, 3e-3, 2, seed=5)


def named(**changes):
    """The record with other samples or channels."""
    return dataclasses.replace(SOME, **changes)


WITH_CHANNELS = named(auxiliary={"temperature": np.arange(N) / 1.0, "constant": np.full(N, 3.0)})
LONG = np.random.default_rng(1).standard_normal(100_001)
FIVE = aj.Markov() + aj.Markov() + aj.Markov() + aj.Markov() + aj.Markov()
CURVE = aj.allan_deviation(SOME)


def short(n):
    return recording(SOME.values[:n], RATE)


REFUSED = {
    "fit: objective": (lambda: aj.fit(SOME, "N", "spectrum"), aj.AllanjaxError, "whittle"),
    "fit: objective as model": (lambda: aj.fit(SOME, "whittle"), aj.AllanjaxError, "objective="),
    "fit: regressors of Allan": (
        lambda: aj.fit(WITH_CHANNELS, "N", regressors=["temperature"]),
        aj.AllanjaxError,
        "whittle",
    ),
    "fit: no such channel": (
        lambda: aj.fit(WITH_CHANNELS, "N", "whittle", regressors=["p"]),
        aj.AllanjaxError,
        "'p'",
    ),
    "fit: constant channel": (
        lambda: aj.fit(WITH_CHANNELS, "N", "whittle", regressors=["constant"]),
        aj.AllanjaxError,
        "constant",
    ),
    "fit: no noise": (
        lambda: aj.fit(SOME, aj.Model((aj.DriftRamp(),)), "whittle"),
        aj.FitError,
        "AngleRandomWalk",
    ),
    "fit: too short": (lambda: aj.fit(short(20), FIVE), aj.FitError, "10 parameters"),
    "fit: response of Allan": (lambda: aj.fit(SOME, "low_pass1 * N"), aj.FitError, "whittle"),
    "fit: bandwidth": (
        lambda: aj.fit(SOME, aj.Butterworth(51.0) * WHITE, "whittle"),
        aj.AllanjaxError,
        "half",
    ),
    "fit: step of Allan": (lambda: aj.fit(SOME, WHITE + aj.BiasStep(time=3.0)), aj.FitError, "whittle"),
    "fit: step without time": (lambda: aj.fit(SOME, WHITE + aj.BiasStep(), "whittle"), aj.FitError, "time"),
    "exact: no model": (lambda: aj.fit(SOME, None, "exact"), aj.FitError, "select_terms"),
    "exact: ramp": (lambda: aj.fit(SOME, "N + R", "exact"), aj.FitError, "drift_ramp"),
    "exact: power law": (lambda: aj.fit(SOME, "N + power_law", "exact"), aj.FitError, "hold"),
    "exact: long": (lambda: aj.fit(recording(LONG, RATE), "N", "exact", as_is=True), aj.FitError, "100,000"),
    "wavelet: ramp": (lambda: aj.fit(SOME, "N + R", "wavelet", wavelet="db2"), aj.FitError, "drift_ramp"),
    "wavelet: line": (
        lambda: aj.fit(SOME, "N + sinusoid", "wavelet", wavelet="db2"),
        aj.FitError,
        "sinusoid",
    ),
    "wavelet: short": (
        lambda: aj.fit(short(60), "N + B + K", "wavelet", wavelet="sym4"),
        aj.FitError,
        "3 parameters",
    ),
    "wavelet: posterior": (
        lambda: aj.sample(aj.fit(SOME, "N + K", "wavelet", as_is=True)),
        aj.FitError,
        "whittle",
    ),
    "fit: axis": (lambda: aj.fit(SOME, "N", as_is=True)["gyro_x"], aj.FitError, "gyro_0"),
    "fit: coefficient": (lambda: aj.fit(SOME, "N", as_is=True)["gyro_0"]["markov"], aj.FitError, "markov"),
    "many: line": (lambda: aj.fit_many(CURVE, WHITE + aj.Sinusoid()), aj.FitError, "sinusoid"),
    "many: resonance": (lambda: aj.fit_many(CURVE, WHITE + aj.Resonance()), aj.FitError, "resonance"),
    "many: step": (lambda: aj.fit_many(CURVE, WHITE + aj.BiasStep(time=3.0)), aj.FitError, "bias_step"),
    "many: kind": (
        lambda: aj.fit_many(aj.allan_deviation(SOME, kind="hadamard"), "N"),
        aj.AllanjaxError,
        "hadamard",
    ),
    "many: times": (lambda: aj.fit_many(CURVE, "N", cluster_times=4), aj.AllanjaxError, "cluster_times"),
    "many: lengths": (lambda: aj.fit_many([SOME, short(2000)], "N"), aj.AllanjaxError, "2000"),
    "many: nothing": (lambda: aj.fit_many([], "N"), aj.AllanjaxError, "recordings"),
    "many: one": (lambda: aj.fit_many(SOME, "N"), aj.AllanjaxError, "recordings"),
    "many: short": (
        lambda: aj.fit_many(aj.allan_deviation(SOME.values[:8], RATE), "N + B + K"),
        aj.FitError,
        "too few",
    ),
    "terms: line": (lambda: aj.select_terms(SOME, WHITE + aj.Sinusoid()), aj.AllanjaxError, "sinusoid"),
    "terms: resonance": (
        lambda: aj.select_terms(SOME, WHITE + aj.Resonance()),
        aj.AllanjaxError,
        "resonance",
    ),
    "terms: two times": (lambda: aj.select_terms(SOME, "N + markov + telegraph"), aj.AllanjaxError, "time"),
    "terms: three times": (
        lambda: aj.select_terms(SOME, "N + markov + markov + markov"),
        aj.AllanjaxError,
        "cannot be compared|time",
    ),
    "terms: held": (
        lambda: aj.select_terms(SOME, aj.AngleRandomWalk(0.1).hold("coefficient") + aj.RateRandomWalk()),
        aj.AllanjaxError,
        "held",
    ),
    "terms: seven": (
        lambda: aj.select_terms(SOME, "Q + N + B + K + R + markov + A"),
        aj.AllanjaxError,
        "six|power_law",
    ),
    "terms: short": (lambda: aj.select_terms(short(63), "N + K"), aj.FitError, "63"),
    "horizon: short": (lambda: aj.horizon(bench.fit("small"), 0.001), aj.AllanjaxError, "0.02 s"),
    "horizon: long": (lambda: aj.horizon(bench.fit("small"), 150.0), aj.AllanjaxError, "81.92"),
    "horizon: process": (
        lambda: aj.horizon(bench.fit("small"), 10.0, process="flicker"),
        aj.AllanjaxError,
        "flicker",
    ),
    "horizon: certain": (
        lambda: aj.horizon(bench.fit("small"), 10.0, probability=1.0),
        aj.AllanjaxError,
        "probability",
    ),
    "horizon: axis": (
        lambda: aj.horizon(bench.fit("small"), 10.0, axes="gyro_w"),
        aj.AllanjaxError,
        "gyro_w",
    ),
    "check: file": (lambda: aj.check("nothing.csv"), aj.RecordingError, "nothing.csv"),
    "check: unit": (
        lambda: aj.check(pd.DataFrame({"gyro_x": np.arange(99.0)}), rate=10.0),
        aj.UnitError,
        "unit",
    ),
    "check: line": (lambda: aj.check(short(64))["color"], aj.AllanjaxError, "color"),
    "stream: wavelet": (
        lambda: aj.AllanAccumulator(RATE, ["gyro_x"]).fit("N", "wavelet"),
        aj.AllanjaxError,
        "samples",
    ),
}


def refusal(call, error):
    """What it says, or nothing where nothing is refused."""
    try:
        call()
    except error as raised:
        return str(raised)
    return ""


@pytest.mark.parametrize("function", sorted({what.partition(":")[0] for what in REFUSED}))
def test_what_cannot_be_done_is_refused(function):
    for what, (call, error, word) in REFUSED.items():
        if what.partition(":")[0] == function:
            assert re.search(word, refusal(call, error)), what


def test_an_axis_that_did_not_converge_is_no_result():
    fit = aj.fit(SOME, "N + K")
    failed = dataclasses.replace(fit.results[0], converged=False, reason="the start was hopeless")
    refused = dataclasses.replace(fit, results=(failed, fit.results[1]))
    assert not refused.converged
    assert refused.without_result == {"gyro_0": "the start was hopeless"}
    for ask in (
        lambda: failed.coefficients,
        lambda: failed.covariance,
        lambda: failed.model,
        lambda: failed["angle_random_walk"],
        lambda: refused.coefficients,
        lambda: refused.to_dataframe(),
        lambda: aj.sample(refused, progress=False),
    ):
        with pytest.raises(aj.FitError, match="the start was hopeless"):
            ask()


def same(one, other, factor=1.0, tolerance=3e-3):
    """Coefficients that differ by a factor: each fit stops within a thousandth of a standard deviation."""
    for result, again in zip(one.results, other.results, strict=True):
        for label, c in result.coefficients.items():
            d = again[label]
            assert d.value == pytest.approx(
                factor * c.value, abs=tolerance * factor * max(c.std, 1e-12), rel=1e-6
            )
            assert d.std == pytest.approx(factor * c.std, rel=1e-2)
            assert d.detected == c.detected
            assert d.upper_limit == pytest.approx(factor * c.upper_limit, rel=0.02)
        assert again.chi2 == pytest.approx(result.chi2, rel=1e-2)


@pytest.mark.parametrize("objective", ["allan", "whittle", "wavelet", "exact"])
def test_scale_bias_and_neighbours_do_not_matter(objective):
    """Nor whether the unit is another: 180/π times as many degrees."""

    def fit(values, axes=SOME.axes):
        return aj.fit(aj.Recording(values, RATE, axes), "N + K", objective, as_is=True, vibrating=True)

    one = fit(SOME.values)
    same(one, fit(1e4 * SOME.values), 1e4)
    same(one, fit(SOME.values + 9.81))
    for k, result in enumerate(one.results):
        alone = fit(SOME.values[:, [k]], SOME.axes[k : k + 1])
        same(dataclasses.replace(one, results=(result,)), alone)
    in_degrees = aj.fit(
        np.degrees(SOME.values),
        "N + K",
        objective,
        rate=RATE,
        gyro_unit="deg/s",
        as_is=True,
        names=["gyro_0", "gyro_1"],
    )
    same(one, in_degrees)


def test_arrays_and_frames_are_recordings():
    frame = pd.DataFrame({f"gyro_{k} [rad/s]": SOME.values[:, k] for k in range(2)})
    same(aj.fit(SOME, "N + K"), aj.fit(frame, "N + K", rate=RATE))


def test_starts_are_used_and_held_shapes_stay():
    rng = np.random.default_rng(4)
    x = golden.white(rng, 16_384, 1e-2) + golden.gauss_markov(rng, 16_384, 0.05, 0.3)
    asked = WHITE + aj.Markov(0.02, 0.5).hold("correlation_time")
    result, free = (
        aj.fit(recording(x, RATE), model, "whittle", as_is=True, vibrating=True)["gyro_0"]
        for model in (asked, "N + markov")
    )
    held, c = result["markov_correlation_time"], free["markov_correlation_time"]
    assert (held.value, held.std, held.held, held.interval) == (0.5, 0.0, True, (0.5, 0.5))
    assert result["markov_amplitude"].std >= 0.0
    assert abs(c.value - 0.3) < 4.0 * c.std
    # A held time is one parameter less.
    assert result.dof == free.dof + 1


class PowerLaw(aj.NoiseTerm):
    """A slope between random walk and flicker: S(f) ∝ f^(−1/2)."""

    coefficient: float | None = aj.parameter("H", time_exponent=0.25)

    def phase_covariance(self, lag):
        return -(self.coefficient**2) * jnp.where(lag > 0.0, lag, 1.0) ** 1.5 * (lag > 0.0)


def test_a_users_own_term_is_fitted():
    """S(f) ∝ f^(−1/2), drawn as a sum of Gauss–Markov processes: of a power law of exponent ½."""
    rng, density = np.random.default_rng(11), 1e-5
    x = golden.white(rng, 16_384, 1e-3) + golden.power_law(rng, 16_384, density, 0.5)
    c = aj.fit(recording(x, RATE), WHITE + PowerLaw(), as_is=True, vibrating=True)["gyro_0"]["power_law"]
    # G = −A²(2π)^½ t^1.5/(2Γ(2.5)cos(π/4)).
    truth = np.sqrt(density * np.sqrt(2.0 * np.pi) / (2.0 * 1.32934 * np.sqrt(0.5)))
    assert c.detected
    assert abs(c.value - truth) < 4.0 * c.std


def test_many_recordings_are_stacked_and_one_without_result_spoils_no_other():
    x = np.column_stack([SOME.values, SOME.values[:, :1]])
    gyros = aj.Recording(x[:, :2], RATE, SOME.axes, name="a")
    accel = aj.Recording(x[:, 2:], RATE, (aj.Axis("accel_0", "accel", "g"),))
    many = aj.fit_many([gyros, accel], "N + K")
    assert many.names == ("a/gyro_0", "a/gyro_1", "1/accel_0")
    alone = aj.fit_many(aj.allan_deviation(x, RATE), "N + K")
    assert alone.names == ("0", "1", "2")
    np.testing.assert_allclose(many.value, alone.value, rtol=1e-6)
    assert alone.value[0] == pytest.approx(alone.value[2], rel=1e-9)
    table = many.to_dataframe()
    assert list(table["unit"][::2]) == ["deg/√h", "deg/√h", "m/s/√h"]
    # 1 rad/√s is 180/π · 60 deg/√h, 1 m/s/√s is 60 m/s/√h.
    for column, values in (
        ("value", many.value),
        ("std", many.std),
        ("upper_95", many.upper),
        ("lower_95", many.lower),
    ):
        expected = values[:, 0] * np.array([3437.7467707849, 3437.7467707849, 60.0])
        np.testing.assert_allclose(table[column][::2], expected, rtol=1e-9)
    x[:, 1] = 1.0
    spoilt = aj.fit_many(aj.allan_deviation(x, RATE), "N + K")
    np.testing.assert_array_equal(spoilt.converged, [True, False, True])
    np.testing.assert_allclose(spoilt.value[[0, 2]], alone.value[[0, 2]], rtol=1e-6)
    assert np.isnan(spoilt.value[1]).all()
    assert not spoilt.detected[1].any()

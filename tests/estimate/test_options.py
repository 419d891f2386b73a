"""What fits take and refuse, and what must not matter to them: units, biases, neighbours, starts."""

import dataclasses

import bench
import numpy as np
import pandas as pd
import pytest
from altered_fits import without_result
from dense_fits import recording
from white_and_walk import RATE, records

import allanjax as aj

WHITE, STEP = aj.AngleRandomWalk(), aj.BiasStep(time=3.0)
SOME = records(1e-3, 3e-3, 2, seed=5)
CHANNELS = {"temperature": np.arange(2048.0), "constant": np.full(2048, 3.0)}
WITH_CHANNELS = dataclasses.replace(SOME, auxiliary=CHANNELS)
CURVE, HADAMARD = (aj.allan_deviation(SOME, kind=kind) for kind in ("allan", "hadamard"))


def short(n):
    return recording(SOME.values[:n], RATE)


def small(seconds=10.0, **options):
    return aj.horizon(bench.fit("small"), seconds, **options)


REFUSED = {
    aj.AllanjaxError: [
        (lambda: aj.fit(SOME, "N", "spectrum"), "whittle"),
        (lambda: aj.fit(WITH_CHANNELS, "N", regressors=["temperature"]), "whittle"),
        (lambda: aj.fit(WITH_CHANNELS, "N", "whittle", regressors=["p"]), "'p'"),
        (lambda: aj.fit(WITH_CHANNELS, "N", "whittle", regressors=["constant"]), "constant"),
        (lambda: aj.fit(SOME, aj.Butterworth(51.0) * WHITE, "whittle"), "half"),
        (lambda: aj.fit_many(HADAMARD, "N"), "hadamard"),
        (lambda: aj.fit_many(CURVE, "N", cluster_times=4), "cluster_times"),
        (lambda: aj.fit_many([SOME, short(2000)], "N"), "2000"),
        (lambda: aj.fit_many([], "N"), "recordings"),
        (lambda: aj.fit_many(SOME, "N"), "recordings"),
        (lambda: aj.select_terms(SOME, WHITE + aj.Sinusoid()), "sinusoid"),
        (lambda: aj.select_terms(SOME, WHITE + aj.Resonance()), "resonance"),
        (lambda: aj.select_terms(SOME, "N + markov + telegraph"), "time"),
        (lambda: aj.select_terms(SOME, "N + markov + markov + markov"), "cannot be compared|time"),
        (lambda: aj.select_terms(SOME, WHITE + aj.RateRandomWalk(0.1).hold("coefficient")), "held"),
        (lambda: aj.select_terms(SOME, "Q + N + B + K + R + markov + A"), "six|power_law"),
        (lambda: small(0.001), "0.02 s"),
        (lambda: small(150.0), "81.92"),
        (lambda: small(process="flicker"), "flicker"),
        (lambda: small(probability=1.0), "probability"),
        (lambda: small(axes="gyro_w"), "gyro_w"),
        (lambda: aj.check(short(64))["color"], "color"),
        (lambda: aj.AllanAccumulator(RATE, ["gyro_x"]).fit("N", "wavelet"), "samples"),
    ],
    aj.FitError: [
        (lambda: aj.fit(SOME, aj.Model((aj.DriftRamp(),)), "whittle"), "AngleRandomWalk"),
        (lambda: aj.fit(short(20), "markov + markov + markov + markov + markov"), "10 parameters"),
        (lambda: aj.fit(SOME, "low_pass1 * N"), "whittle"),
        (lambda: aj.fit(SOME, WHITE + STEP), "whittle"),
        (lambda: aj.fit(SOME, WHITE + aj.BiasStep(), "whittle"), "time"),
        (lambda: aj.fit(SOME, None, "exact"), "select_terms"),
        (lambda: aj.fit(SOME, "N + R", "exact"), "drift_ramp"),
        (lambda: aj.fit(SOME, "N + power_law", "exact"), "hold"),
        (lambda: aj.fit(recording(np.resize(SOME.values, 100_001), RATE), "N", "exact"), "100,000"),
        (lambda: aj.fit(SOME, "N + R", "wavelet", wavelet="db2"), "drift_ramp"),
        (lambda: aj.fit(SOME, "N + sinusoid", "wavelet", wavelet="db2"), "sinusoid"),
        (lambda: aj.fit(short(60), "N + B + K", "wavelet", wavelet="sym4"), "3 parameters"),
        (lambda: aj.sample(aj.fit(SOME, "N + K", "wavelet", as_is=True)), "whittle"),
        (lambda: aj.fit(SOME, "N", as_is=True)["gyro_x"], "gyro_0"),
        (lambda: aj.fit(SOME, "N", as_is=True)["gyro_0"]["markov"], "markov"),
        (lambda: aj.fit_many(CURVE, WHITE + aj.Sinusoid()), "sinusoid"),
        (lambda: aj.fit_many(CURVE, WHITE + aj.Resonance()), "resonance"),
        (lambda: aj.fit_many(CURVE, WHITE + STEP), "bias_step"),
        (lambda: aj.fit_many(aj.allan_deviation(SOME.values[:8], RATE), "N + B + K"), "too few"),
        (lambda: aj.select_terms(short(63), "N + K"), "63"),
    ],
    aj.RecordingError: [(lambda: aj.check("nothing.csv"), "nothing.csv")],
    aj.UnitError: [(lambda: aj.check(pd.DataFrame({"gyro_x": np.arange(99.0)}), rate=10.0), "unit")],
}


@pytest.mark.parametrize("error", REFUSED)
def test_what_cannot_be_done_is_refused(error):
    for call, word in REFUSED[error]:
        with pytest.raises(error, match=word):
            call()


def test_an_axis_that_did_not_converge_is_no_result():
    refused = without_result(aj.fit(SOME, "N + K"), "gyro_0")
    failed = refused.results[0]
    assert not refused.converged
    assert refused.without_result == {"gyro_0": "the start was hopeless"}
    asks = [lambda name=name: getattr(failed, name) for name in ("coefficients", "covariance", "model")]
    asks += [lambda: failed["angle_random_walk"], lambda: refused.coefficients, refused.to_dataframe]
    for ask in [*asks, lambda: aj.sample(refused, progress=False)]:
        with pytest.raises(aj.FitError, match="the start was hopeless"):
            ask()


def same(one, other, factor=1.0):
    """Coefficients that differ by a factor: each fit stops within a thousandth of a standard deviation."""
    for result, again in zip(one.results, other.results, strict=True):
        for label, c in result.coefficients.items():
            d, close = again[label], 3e-3 * factor * max(c.std, 1e-12)
            assert d.value == pytest.approx(factor * c.value, abs=close, rel=1e-6)
            assert d.std == pytest.approx(factor * c.std, rel=1e-2)
            assert d.detected == c.detected
            assert d.upper_limit == pytest.approx(factor * c.upper_limit, rel=0.02)
        assert again.chi2 == pytest.approx(result.chi2, rel=1e-2)


@pytest.mark.parametrize("objective", ["allan", "whittle", "wavelet", "exact"])
def test_scale_bias_and_neighbours_do_not_matter(objective):
    """Nor whether the unit is another, in a table: 180/π times as many degrees."""

    def fit(values, axes=SOME.axes):
        return aj.fit(aj.Recording(values, RATE, axes), "N + K", objective, as_is=True, vibrating=True)

    one = fit(SOME.values)
    same(one, fit(1e4 * SOME.values), 1e4)
    same(one, fit(SOME.values + 9.81))
    for k, result in enumerate(one.results):
        same(dataclasses.replace(one, results=(result,)), fit(SOME.values[:, [k]], SOME.axes[k : k + 1]))
    degrees = pd.DataFrame(np.degrees(SOME.values), columns=["gyro_0 [deg/s]", "gyro_1 [deg/s]"])
    same(one, aj.fit(degrees, "N + K", objective, rate=RATE, as_is=True))


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
    for column in ("value", "std", "upper", "lower"):
        expected = getattr(many, column)[:, 0] * [3437.7467707849, 3437.7467707849, 60.0]
        shown = table[column if column in table else f"{column}_95"]
        np.testing.assert_allclose(shown[::2], expected, rtol=1e-9)
    x[:, 1] = 1.0
    spoilt = aj.fit_many(aj.allan_deviation(x, RATE), "N + K")
    np.testing.assert_array_equal(spoilt.converged, [True, False, True])
    np.testing.assert_allclose(spoilt.value[[0, 2]], alone.value[[0, 2]], rtol=1e-6)
    assert np.isnan(spoilt.value[1]).all()
    assert not spoilt.detected[1].any()

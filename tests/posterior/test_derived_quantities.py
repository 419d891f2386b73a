"""What follows from a posterior: curves, drift, the minimum of the Allan deviation, tables, ArviZ."""

import dataclasses

import numpy as np
import pytest
from dense_fits import drawn

import allanjax as aj

RATE, N = 10.0, 256
WHITE, WALK = 0.1, 0.25
DEGREE = np.pi / 180.0


@pytest.fixture(scope="module")
def posterior():
    """Of N and K, both clear, of two gyros and an accelerometer in deg/s and g; one is not sampled."""
    x = drawn(aj.AngleRandomWalk(WHITE) + aj.RateRandomWalk(WALK), N, RATE, 3, 3)
    axes = [("gyro_x", "gyro", "deg/s"), ("gyro_y", "gyro", "deg/s"), ("accel_z", "accel", "g")]
    whole = aj.Recording(x, RATE, tuple(aj.Axis(*axis) for axis in axes))
    fit = aj.fit(whole, "N + K", "whittle", as_is=True, vibrating=True)
    return aj.sample(fit, ["gyro_x", "accel_z"], seed=1, progress=False)


def test_drift_follows_from_the_draws(posterior):
    """σ_A² = N²/T + K²T/3, the thesis's (4.36) and (4.53): √2·t·σ_A after t."""
    axis = posterior["gyro_x"]
    fixed = dataclasses.replace(axis, draws=np.tile([WHITE, WALK], (50, 1)))
    for t, drift in fixed.predicted_drift((0.5, 10.0, 20.0, 3600.0)).items():
        exact = np.sqrt(2.0) * t * np.sqrt(WHITE**2 / t + WALK**2 * t / 3.0)
        assert drift.median == pytest.approx(exact, rel=1e-9)
        assert drift.in_unit().median == pytest.approx(np.degrees(exact), rel=1e-9)
        assert (drift.unit, drift.usual_unit, drift.in_unit().unit) == ("rad", "deg", "deg")
        assert ("extrapolated" in drift.describe()) == (2.0 * t > N / RATE)
    t, (white, walk) = 5.0, axis.draws.T
    curve = np.sqrt(2.0) * t * np.sqrt(white**2 / t + walk**2 * t / 3.0)
    drift = axis.predicted_drift((t,))[t]
    # Of an evenly spaced choice of the draws.
    ends = [*drift.interval, *drift.interval_68, drift.median]
    for end, u in zip(ends, (0.025, 0.975, 0.16, 0.84, 0.5), strict=True):
        assert np.mean(curve < end) == pytest.approx(u, abs=0.02 + 0.04 * np.sqrt(u * (1.0 - u)))
    assert drift.std == pytest.approx(curve.std(), rel=0.1)
    assert posterior["accel_z"].predicted_drift()[600.0].unit == "m/s"
    assert set(axis.predicted_drift()) == {60.0, 600.0, 3600.0}
    for bad in ((0.0,), (-1.0,), (np.nan,), (np.inf,)):
        with pytest.raises(aj.AllanjaxError, match="positive"):
            axis.predicted_drift(bad)


def test_the_minimum_of_the_curve_and_its_place(posterior):
    """N²/T + K²T/3 is least, 2NK/√3, at T = √3·N/K."""
    axis = posterior["gyro_x"]

    def of(N_, K):
        return dataclasses.replace(axis, draws=np.tile([N_, K], (20, 1))).bias_instability_minimum()

    minimum = of(WHITE, WHITE / 2.0)
    assert minimum.deviation.median == pytest.approx(WHITE / np.sqrt(np.sqrt(3.0)), rel=1e-3)
    assert minimum.cluster_time.median == pytest.approx(np.sqrt(3.0) * 2.0, rel=2e-2)
    assert (minimum.at_start, minimum.at_end, minimum.deviation.remark) == (0.0, 0.0, "")
    assert (minimum.deviation.usual_unit, minimum.cluster_time.unit) == ("deg/h", "s")
    falling, rising = of(WHITE, 1e-3 * WHITE), of(WHITE, 100.0 * WHITE)
    assert (falling.at_start, falling.at_end) == (rising.at_end, rising.at_start) == (0.0, 1.0)
    assert falling.cluster_time.median == pytest.approx(N / RATE / 2.0)
    assert "upper bound" in falling.deviation.describe()
    assert rising.deviation.remark
    assert posterior["accel_z"].bias_instability_minimum().deviation.usual_unit == "µg"


def test_models_curves_and_correlations_are_of_the_draws(posterior):
    axis = posterior["gyro_x"]
    assert [type(m) for m in axis.models(7)] == 7 * [aj.Model]
    picked = axis.draws[np.linspace(0, len(axis.draws) - 1, 7).round().astype(int)]
    white, walk = picked.T[:, :, None]
    time, f = np.array([0.1, 3.0, 12.0]), np.array([0.1, 1.0, 4.0])
    curves = np.sqrt(white**2 / time + walk**2 * time / 3.0)
    np.testing.assert_allclose(axis.deviation_curves(time, 7), curves, rtol=1e-9)
    # Means of a walk over h have K²h²(2 + cos x)/(6(1 − cos x)), x = 2πfh; times h, and one-sided.
    x = 2.0 * np.pi * f / RATE
    slow = walk**2 / RATE**2 * (2.0 + np.cos(x)) / (6.0 * (1.0 - np.cos(x)))
    np.testing.assert_allclose(axis.density_curves(f, 7), 2.0 * (white**2 + slow), rtol=1e-6)
    correlation = axis.correlation
    assert list(correlation.columns) == list(correlation.index) == list(axis.labels)
    np.testing.assert_allclose(correlation, np.corrcoef(axis.draws.T))


def test_the_table_has_quantiles_of_the_draws(posterior):
    with pytest.raises(aj.AllanjaxError, match="bias"):
        posterior["gyro_x"]["bias"]
    table = posterior.to_dataframe()
    assert len(table) == 4
    for axis, unit, scale in (("gyro_x", "deg/√h", DEGREE / 60.0), ("accel_z", "m/s/√h", 1.0 / 60.0)):
        row = table[(table.axis == axis) & (table.coefficient == "angle_random_walk")].iloc[0]
        draws = posterior[axis].draws[:, 0]
        shown = row[["lower_95", "lower_68", "median", "upper_68", "upper_95", "upper_limit_95", "std"]]
        quantiles = [*np.quantile(draws, [0.025, 0.16, 0.5, 0.84, 0.975, 0.95]), draws.std()]
        np.testing.assert_allclose(shown.to_numpy(float) * scale, quantiles, rtol=1e-9)
        assert (row.unit, row.detected) == (unit, True)


def test_to_arviz(posterior):
    arviz = pytest.importorskip("arviz")
    axis = posterior["gyro_x"]
    data = posterior.to_arviz()["gyro_x"]
    assert dict(data["posterior"].sizes) == {"chain": 32, "draw": len(axis.chain)}
    np.testing.assert_array_equal(data["posterior"]["rate_random_walk"], axis.chain[:, :, 1].T)
    np.testing.assert_array_equal(data["sample_stats"]["lp"], axis.log_probability.T)
    densities = [axis.priors[k].log_density(axis.chain[:, :, i]) for i, k in enumerate(axis.labels)]
    likelihood = axis.log_probability - sum(np.asarray(d) for d in densities)
    np.testing.assert_allclose(data["sample_stats"]["log_likelihood_total"], likelihood.T)
    r_hat = arviz.rhat(data["posterior"])
    assert [float(r_hat[label]) for label in axis.labels] == pytest.approx(list(axis.r_hat), abs=2e-3)

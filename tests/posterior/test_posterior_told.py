"""What follows from a posterior, and how it is told."""

import builtins
import dataclasses

import numpy as np
import pytest
from gamma_levels import DEGREE, K, N, spectral_levels, with_likelihood

from allanjax.base.errors import AllanjaxError
from allanjax.noise.model import Model
from allanjax.posterior.priors import default_priors
from allanjax.posterior.sample import sample


@pytest.fixture(scope="module")
def posterior(small_fit):
    """Of N and K, both of them clear, of a gyro and an accelerometer."""
    with pytest.MonkeyPatch.context() as patch:
        fit = with_likelihood(patch, small_fit, spectral_levels(), chosen=False)
        return sample(fit, ["gyro_x", "accel_z"], seed=1)


# --- What follows from it -----------------------------------------------------------------------------------


def test_derived_quantities_follow_from_the_draws(posterior):
    axis = posterior["gyro_x"]
    fixed = dataclasses.replace(axis, draws=np.tile([N, K], (50, 1)))
    for t, drift in fixed.predicted_drift((0.5, 60.0, 150.0, 3600.0)).items():
        # σ_A² = N²/T + K²T/3, the thesis's (4.36) and (4.53).
        exact = np.sqrt(2.0) * t * np.sqrt(N**2 / t + K**2 * t / 3.0)
        assert drift.median == pytest.approx(exact, rel=1e-9)
        assert drift.in_unit().median == pytest.approx(np.degrees(exact), rel=1e-9)
        assert (drift.unit, drift.usual_unit, drift.in_unit().unit) == ("rad", "deg", "deg")
        assert ("extrapolated" in drift.describe()) == (2.0 * t > 200.0)
    # Quantiles of a monotonic function of draws; the duration is 200 s.
    t = 60.0
    curve = np.sqrt(2.0) * t * np.sqrt(axis.draws[:, 0] ** 2 / t + axis.draws[:, 1] ** 2 * t / 3.0)
    drift = axis.predicted_drift((t,))[t]
    low, high = drift.interval
    assert np.mean(curve < low) == pytest.approx(0.025, abs=0.02)
    assert np.mean(curve < high) == pytest.approx(0.975, abs=0.02)
    assert drift.interval_68[0] < drift.median < drift.interval_68[1]
    assert posterior["accel_z"].predicted_drift()[600.0].unit == "m/s"
    for bad in ((0.0,), (-1.0,), (np.nan,), (np.inf,)):
        with pytest.raises(AllanjaxError, match="positive"):
            axis.predicted_drift(bad)


def test_the_minimum_of_the_curve_and_its_place(posterior):
    axis = posterior["gyro_x"]
    # N²/T + K²T/3 is least, 2NK/√3, at T = √3·N/K.
    walk = N / 5.0
    fixed = dataclasses.replace(axis, draws=np.tile([N, walk], (20, 1)))
    minimum = fixed.bias_instability_minimum()
    assert minimum.deviation.median == pytest.approx(np.sqrt(2.0 * N * walk / np.sqrt(3.0)), rel=1e-4)
    assert minimum.cluster_time.median == pytest.approx(np.sqrt(3.0) * 5.0, rel=1e-2)
    assert minimum.deviation.usual_unit == "deg/h"
    assert minimum.cluster_time.unit == "s"
    assert minimum.deviation.remark == ""
    falling = dataclasses.replace(axis, draws=np.tile([N, 1e-3 * K], (20, 1))).bias_instability_minimum()
    assert falling.at_end == 1.0
    assert falling.cluster_time.median == pytest.approx(100.0)
    assert "upper bound" in falling.deviation.describe()
    assert posterior["accel_z"].bias_instability_minimum().deviation.usual_unit == "µg"


def test_models_curves_and_correlations_are_of_the_draws(posterior):
    axis = posterior["gyro_x"]
    models = axis.models(7)
    assert len(models) == 7
    assert all(isinstance(m, Model) for m in models)
    time = np.array([0.1, 3.0, 50.0])
    expected = [np.sqrt(np.asarray(m.sampled(100.0).allan_variance(time))) for m in models]
    np.testing.assert_allclose(axis.deviation_curves(time, 7), expected, rtol=1e-9)
    f = np.array([0.01, 1.0, 40.0])
    expected = [2.0 * np.asarray(m.sampled(100.0).sampled_psd(f, 100.0)) for m in models]
    np.testing.assert_allclose(axis.density_curves(f, 7), expected, rtol=1e-9)
    correlation = axis.correlation
    assert list(correlation.columns) == list(correlation.index) == list(axis.labels)
    np.testing.assert_allclose(correlation, np.corrcoef(axis.draws.T))


def test_log_probability_is_of_the_values_in_si(posterior):
    axis, likelihood = posterior["gyro_x"], spectral_levels()
    priors = default_priors(likelihood)
    for values, log_probability in zip(axis.chain[10, :5], axis.log_probability[10, :5], strict=True):
        log_prior = sum(
            float(priors[label].log_density(x)) for label, x in zip(axis.labels, values, strict=True)
        )
        assert log_probability == pytest.approx(float(likelihood(values)) + log_prior, rel=1e-9)


def test_absent_terms_are_not_in_the_curves(two_terms):
    likelihood = spectral_levels((N, 0.0), found=(True, False))
    axis = sample(two_terms(likelihood), "gyro_x")["gyro_x"]
    assert [m.term_labels for m in axis.models(2)] == 2 * [("angle_random_walk",)]
    time = np.array([1.0, 100.0])
    np.testing.assert_allclose(axis.deviation_curves(time, 1)[0], axis.draws[0, 0] / np.sqrt(time), rtol=1e-9)


# --- How it is told -----------------------------------------------------------------------------------------


def test_the_posterior_is_a_mapping_and_a_table(posterior):
    assert list(posterior) == ["gyro_x", "accel_z"]
    assert len(posterior) == 2
    assert dict(posterior.items())["accel_z"] is posterior["accel_z"]
    with pytest.raises(AllanjaxError, match="gyro_q"):
        posterior["gyro_q"]
    with pytest.raises(AllanjaxError, match="angle_random_walk, rate_random_walk"):
        posterior["gyro_x"]["bias"]
    table = posterior.to_dataframe()
    row = table[(table.axis == "gyro_x") & (table.coefficient == "angle_random_walk")].iloc[0]
    quantiles = np.quantile(posterior["gyro_x"].draws[:, 0], [0.025, 0.16, 0.5, 0.84, 0.975])
    shown = row[["lower_95", "lower_68", "median", "upper_68", "upper_95"]].to_numpy(float)
    np.testing.assert_allclose(shown, quantiles / (DEGREE / 60.0))
    assert row.unit == "deg/√h"
    text = str(posterior)
    assert "angle random walk" in text
    assert "velocity random walk" in text
    assert "converged" in text
    assert "<table>" in posterior._repr_html_()


def test_to_arviz(posterior):
    arviz = pytest.importorskip("arviz")
    axis = posterior["gyro_x"]
    data = posterior.to_arviz()["gyro_x"]
    assert dict(data["posterior"].sizes) == {"chain": 32, "draw": len(axis.chain)}
    np.testing.assert_array_equal(data["posterior"]["rate_random_walk"], axis.chain[:, :, 1].T)
    np.testing.assert_array_equal(data["sample_stats"]["lp"], axis.log_probability.T)
    expected = float(spectral_levels()(axis.chain[4, 3]))
    assert float(data["sample_stats"]["log_likelihood_total"][3, 4]) == pytest.approx(expected, rel=1e-9)
    r_hat = arviz.rhat(data["posterior"])
    assert float(r_hat["rate_random_walk"]) == pytest.approx(axis.r_hat[1], abs=2e-3)


def test_without_arviz_the_error_says_what_to_install(posterior, monkeypatch):
    original = builtins.__import__

    def without(name, *arguments, **options):
        if name == "arviz":
            raise ImportError(name)
        return original(name, *arguments, **options)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(AllanjaxError, match=r"pip install \"allanjax\[arviz\]\""):
        posterior["gyro_x"].to_arviz()


def test_progress_goes_to_stderr_only_if_wanted(two_terms, capsys):
    fit = two_terms(spectral_levels())
    sample(fit, "gyro_x")
    assert capsys.readouterr() == ("", "")
    sample(fit, "gyro_x", progress=True)
    out, err = capsys.readouterr()
    assert out == ""
    assert "gyro_x" in err
    assert "steps" in err


def test_a_real_fit_agrees_with_its_posterior(small_fit):
    """Well determined coefficients: median and interval are those of the fit."""
    posterior = sample(small_fit, "accel_z")["accel_z"]
    fitted = small_fit["accel_z"]
    assert posterior.converged
    for label in posterior.labels:
        marginal, coefficient = posterior[label], fitted[label]
        assert abs(marginal.median - coefficient.value) < 0.5 * coefficient.std
        # Relative error of a sampled standard deviation, and half the difference of the two approximations.
        assert marginal.std == pytest.approx(coefficient.std, rel=0.3)
    for label, c in fitted.coefficients.items():
        assert label in posterior.coefficients
        if not c.detected:
            assert posterior[label].upper_limit == pytest.approx(c.upper_limit, rel=1.0)

"""The posterior: the sampler against quadrature, absent terms, what is derived, how it is told."""

import builtins
import dataclasses
import warnings

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import allanjax.likelihood
from allanjax.absent import absent_amplitude
from allanjax.errors import AllanjaxError, FitError
from allanjax.model import Model
from allanjax.posterior import PosteriorWarning, sample
from allanjax.priors import LogUniform, ModifiedLogUniform, Uniform, default_priors
from allanjax.sampling import LogPosterior, Options, Target, first_walkers, run, split_r_hat
from allanjax.terms import AngleRandomWalk, Markov, RateRandomWalk

DEGREE, HOUR = np.pi / 180.0, 3600.0
N, K = 0.3 * DEGREE / 60.0, 40.0 * DEGREE / HOUR**1.5
FREQUENCY = np.geomspace(1e-3, 50.0, 40)
ORDINATES = np.maximum(1.0, 200.0 * FREQUENCY)


class SpectralLevels(eqx.Module):
    """Gamma laws of spectral levels, the mean linear in the squares of all amplitudes."""

    parameters: tuple = eqx.field(static=True)
    start: np.ndarray
    scatter: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    knee: np.ndarray
    found: np.ndarray
    levels: np.ndarray

    def __call__(self, values):
        mean = self.densities(values**2)
        return -jnp.sum(ORDINATES * (jnp.log(mean) + self.levels / mean))

    @staticmethod
    def densities(power):
        shapes = np.stack([np.ones(len(FREQUENCY)), 1.0 / (2.0 * np.pi * FREQUENCY) ** 2])
        return power @ shapes


def spectral_levels(truth=(N, K), seed=0, found=(True, True)):
    random = np.random.default_rng(seed)
    truth = np.array(truth)
    mean = np.asarray(SpectralLevels.densities(truth**2))
    derivative = np.asarray(SpectralLevels.densities(np.eye(2))) / mean
    sd = np.sqrt(1.0 / np.sum(ORDINATES * derivative**2, axis=1))
    knee = np.sqrt(sd)
    return SpectralLevels(
        parameters=(AngleRandomWalk() + RateRandomWalk()).parameters,
        start=truth * np.array(found),
        scatter=sd / 2.0 / np.maximum(truth, knee),
        lower=np.zeros(2),
        upper=1e3 * np.maximum(truth, knee),
        knee=knee,
        found=np.array(found),
        levels=random.gamma(ORDINATES) / ORDINATES * mean,
    )


def quadrature(likelihood, priors, points=401):
    """Marginal distribution functions of N and K on a two-dimensional grid: (values, probability) of each."""
    grids = []
    for i, p in enumerate(likelihood.parameters):
        top = likelihood.start[i] + 8.0 * likelihood.scatter[i] + 5.0 * likelihood.knee[i]
        bottom = max(likelihood.start[i] - 8.0 * likelihood.scatter[i], 0.0)
        grids.append(np.linspace(bottom, top, points))
        assert priors[p.label] is not None
    power = np.stack(np.meshgrid(*grids, indexing="ij"), axis=-1) ** 2
    mean = np.maximum(np.asarray(SpectralLevels.densities(power)), 1e-300)
    log_density = -np.sum(ORDINATES * (np.log(mean) + likelihood.levels / mean), axis=-1)
    for i, p in enumerate(likelihood.parameters):
        log_prior = np.asarray(priors[p.label].log_density(grids[i]))
        log_density += log_prior[:, None] if i == 0 else log_prior
    density = np.exp(log_density - log_density.max())
    marginals = []
    for i, grid in enumerate(grids):
        margin = density.sum(axis=1 - i)
        steps = (margin[1:] + margin[:-1]) / 2.0
        marginals.append((grid, np.concatenate([[0.0], np.cumsum(steps)]) / steps.sum()))
    return marginals


def with_likelihood(patch, fit, likelihood, chosen=True):
    """The fit with N and K as its model, every axis of which has this likelihood."""
    patch.setattr(allanjax.likelihood, "likelihood", lambda fit, axis: likelihood)
    patch.setattr(type(fit), "chosen", chosen)
    results = tuple(dataclasses.replace(r, _coefficients={}) for r in fit.results)
    return dataclasses.replace(fit, template=AngleRandomWalk() + RateRandomWalk(), results=results)


@pytest.fixture
def two_terms(small_fit, monkeypatch):
    return lambda likelihood, chosen=True: with_likelihood(monkeypatch, small_fit, likelihood, chosen)


@pytest.fixture(scope="module")
def posterior(small_fit):
    """Of N and K, both of them clear, of a gyro and an accelerometer."""
    with pytest.MonkeyPatch.context() as patch:
        fit = with_likelihood(patch, small_fit, spectral_levels(), chosen=False)
        return sample(fit, ["gyro_x", "accel_z"], seed=1)


def assert_quantiles(draws, tau_draws, grid, probability, label):
    """Sample quantiles lie within 4.5 Monte-Carlo standard errors of those by quadrature.

    At probability u the error is √(u(1−u)/ESS) in probability; some forty comparisons in all.
    """
    for u in (0.025, 0.16, 0.5, 0.84, 0.95, 0.975):
        at = np.interp(u, probability, grid)
        error = np.sqrt(u * (1.0 - u) / (len(draws) / tau_draws))
        assert abs(np.mean(draws < at) - u) < 4.5 * error, (label, u)


# --- The sampler --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("truth", [(N, K), (N, 0.03 * K)], ids=["clear", "truncated at zero"])
def test_marginals_are_those_of_quadrature(two_terms, truth):
    likelihood = spectral_levels(truth)
    posterior = sample(two_terms(likelihood, chosen=False), "gyro_x", seed=3)["gyro_x"]
    assert posterior.converged
    assert posterior.labels == ("angle_random_walk", "rate_random_walk")
    exact = quadrature(likelihood, default_priors(likelihood))
    for i, (grid, probability) in enumerate(exact):
        chain = posterior.chain[:, :, i].ravel()
        assert np.all(chain >= 0.0)
        assert_quantiles(chain, posterior.tau[i], grid, probability, posterior.labels[i])
        marginal = posterior[posterior.labels[i]]
        ess = chain.size / posterior.tau[i]
        # The quantile's standard error by the density there: 4.5 of them.
        for value, u in ((marginal.median, 0.5), (marginal.upper_limit, 0.95)):
            assert np.interp(value, grid, probability) == pytest.approx(u, abs=4.5 * 0.5 / np.sqrt(ess))


def test_a_gaussian_with_other_kinds_of_parameters_is_recovered():
    """Of a line, a time and a number the coordinates differ; the posterior is Gaussian in SI or in ln."""
    p = Markov().parameters()
    kinds = {"line": 20.0, "time": 100.0, "number": 3.0}
    template = (AngleRandomWalk() + RateRandomWalk() + Markov()).parameters[:3]
    parameters = tuple(
        dataclasses.replace(
            q,
            label=kind,
            parameter=dataclasses.replace(p[0], kind=kind, lower=0.5 if kind == "number" else 0.0),
        )
        for q, kind in zip(template, kinds, strict=True)
    )

    class Gaussian(eqx.Module):
        parameters: tuple = eqx.field(static=True)
        start: np.ndarray
        scatter: np.ndarray
        lower: np.ndarray
        upper: np.ndarray
        knee: np.ndarray
        found: np.ndarray

        def __call__(self, values):
            z = [
                (values[0] - 20.0) / 0.01,
                jnp.log(values[1] / 100.0) / 0.2,
                jnp.log((values[2] - 0.5) / 2.5) / 0.3,
            ]
            return -0.5 * (z[0] ** 2 + (z[1] - 0.5 * z[0]) ** 2 + z[2] ** 2)

    likelihood = Gaussian(
        parameters,
        np.array([20.0, 100.0, 3.0]),
        np.array([0.01, 20.0, 0.8]),
        np.array([19.0, 1.0, 0.6]),
        np.array([21.0, 1e4, 50.0]),
        np.full(3, np.nan),
        np.ones(3, bool),
    )
    target = Target.of(LogPosterior.of(likelihood, default_priors(likelihood)), np.arange(3), 16)
    random = np.random.RandomState(1)
    start = first_walkers(target, 32, random)
    chains = run(target, start, random, Options(32, 20_000, 50.0, 0.05, 1.01), lambda *_: None)
    values = target.posterior.values(chains.y).reshape(-1, 3)
    z = np.stack(
        [
            (values[:, 0] - 20.0) / 0.01,
            np.log(values[:, 1] / 100.0) / 0.2,
            np.log((values[:, 2] - 0.5) / 2.5) / 0.3,
        ]
    )
    ess = z.shape[1] / chains.tau.max()
    # Default priors are uniform in these coordinates; 4.5 standard errors of mean, variance and correlation.
    np.testing.assert_allclose(z.mean(axis=1), 0.0, atol=4.5 * np.sqrt(1.25 / ess))
    np.testing.assert_allclose(z.var(axis=1), [1.0, 1.25, 1.0], rtol=4.5 * np.sqrt(2.0 / ess))
    assert np.corrcoef(z)[0, 1] == pytest.approx(0.5 / np.sqrt(1.25), abs=4.5 / np.sqrt(ess))
    # The density in SI differs from that in coordinates by the Jacobian: dx/dy = x − bound.
    jacobian = target.posterior.log_jacobian(target.base)
    np.testing.assert_allclose(jacobian, np.log([1.0, 100.0, 2.5]), atol=1e-12)


def test_r_hat_sees_walkers_that_disagree_drift_or_differ_in_spread():
    random = np.random.default_rng(0)
    chain = random.standard_normal((4000, 8))
    assert split_r_hat(chain) < 1.003
    assert split_r_hat(chain + np.linspace(0.0, 1.0, 8)) > 1.02
    assert split_r_hat(chain + np.linspace(0.0, 1.0, 4000)[:, None]) > 1.01
    assert split_r_hat(chain * np.linspace(1.0, 3.0, 8)) > 1.02
    assert np.isnan(split_r_hat(np.ones((100, 4))))


def test_seeds_and_axes_have_their_own_streams(two_terms):
    fit = two_terms(spectral_levels())
    both = sample(fit, ["gyro_x", "gyro_y"], seed=5)
    again = sample(fit, ["gyro_y"], seed=5)
    other = sample(fit, ["gyro_y"], seed=6)
    np.testing.assert_array_equal(both["gyro_y"].draws, again["gyro_y"].draws)
    assert not np.array_equal(both["gyro_x"].chain[0], both["gyro_y"].chain[0])
    assert not np.array_equal(other["gyro_y"].chain[0], again["gyro_y"].chain[0])
    np.random.seed(1)  # noqa: NPY002 - the global state must not matter
    np.testing.assert_array_equal(sample(fit, "gyro_y", seed=5)["gyro_y"].draws, again["gyro_y"].draws)


def test_a_chain_that_is_too_short_warns_what_to_do(two_terms):
    fit = two_terms(spectral_levels())
    with pytest.warns(PosteriorWarning, match=r"gyro_x.*random_walk.*τ.*R̂.*max_steps=120"):
        posterior = sample(fit, "gyro_x", max_steps=30)
    assert not posterior.converged
    assert posterior["gyro_x"].steps == 30
    assert "NOT CONVERGED" in str(posterior)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert sample(fit, "gyro_x").converged


# --- Priors -------------------------------------------------------------------------------------------------


def test_a_users_prior_is_obeyed(two_terms):
    likelihood = spectral_levels((N, 0.03 * K))
    # The data allow K = 0 … knee; the prior only a band of it.
    knee = likelihood.knee[1]
    prior = LogUniform(0.2 * knee, 0.6 * knee)
    fit = two_terms(likelihood, chosen=False)
    posterior = sample(fit, "gyro_x", priors={"rate_random_walk": prior})["gyro_x"]
    walk = posterior.chain[:, :, 1]
    assert walk.min() >= prior.lower
    assert walk.max() <= prior.upper
    assert posterior.priors["rate_random_walk"] == prior
    priors = default_priors(likelihood) | {"rate_random_walk": prior}
    grid = np.linspace(prior.lower, prior.upper, 400)
    likelihoods = [
        np.exp(float(likelihood(np.array([N, c])) - likelihood(np.array([N, grid[0]])))) for c in grid
    ]
    # N is known to a part in a thousand and hardly correlated with K.
    density = np.array(likelihoods) * np.exp(np.asarray(priors["rate_random_walk"].log_density(grid)))
    probability = np.concatenate([[0.0], np.cumsum((density[1:] + density[:-1]) / 2.0)])
    median = np.interp(0.5 * probability[-1], probability, grid)
    assert posterior["rate_random_walk"].median == pytest.approx(median, rel=0.04)


def test_default_priors_are_those_documented():
    likelihood = spectral_levels()
    priors = default_priors(likelihood)
    assert priors["rate_random_walk"] == ModifiedLogUniform(
        float(likelihood.knee[1]), float(likelihood.upper[1])
    )


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        ({"priors": {"rate_walk": Uniform(0.0, 1.0)}}, "rate_walk.*angle_random_walk, rate_random_walk"),
        ({"priors": {"rate_random_walk": 3.0}}, "must be a Prior"),
        ({"walkers": 7}, "even number"),
        ({"walkers": 2}, "at least 4"),
        ({"max_steps": 0}, "max_steps"),
        ({"seed": -1}, "seed"),
        ({"axes": "gyro_q"}, "gyro_q"),
        ({"axes": []}, "at least one axis"),
    ],
)
def test_what_cannot_be_done_is_refused(two_terms, arguments, complaint):
    with pytest.raises(AllanjaxError, match=complaint):
        sample(two_terms(spectral_levels()), **({"axes": "gyro_x"} | arguments))


def test_an_axis_without_a_fit_has_no_posterior(half_failed_fit):
    with pytest.raises(FitError, match="gyro_y: no posterior, the start was hopeless"):
        sample(half_failed_fit)


# --- Terms that are absent ----------------------------------------------------------------------------------


@pytest.mark.parametrize("truth", [0.0, 0.03 * K], ids=["absent", "weak"])
def test_upper_limit_of_an_absent_term_is_that_of_quadrature(two_terms, truth):
    likelihood = spectral_levels((N, truth), seed=2, found=(True, False))
    posterior = sample(two_terms(likelihood), "gyro_x")["gyro_x"]
    assert posterior.labels == ("angle_random_walk",)
    marginal = posterior["rate_random_walk"]
    grid, probability = quadrature(likelihood, default_priors(likelihood))[1]
    # 256 draws: below 1 % each in several repetitions.
    assert marginal.upper_limit == pytest.approx(np.interp(0.95, probability, grid), rel=0.03)
    assert marginal.median == pytest.approx(np.interp(0.5, probability, grid), rel=0.03)
    assert not marginal.sampled
    assert not marginal.detected
    assert marginal.interval == (0.0, marginal.upper_limit)
    assert (
        marginal.describe() == f"not detectable, below {marginal.in_unit().upper_limit:.3g} deg/h/√h (95 %)"
    )


def test_reweighting_is_exact_where_the_terms_are_strongly_correlated():
    """Two amplitudes of nearly the same spectrum: at the limit of one the other has moved by many σ."""

    class Twins(eqx.Module):
        parameters: tuple = eqx.field(static=True)
        start: np.ndarray
        scatter: np.ndarray
        lower: np.ndarray
        upper: np.ndarray
        knee: np.ndarray
        found: np.ndarray

        def __call__(self, values):
            a, b = values**2
            return -0.5 * (((a + b - 1.0) / 0.01) ** 2 + ((a - b - 1.0) / 0.08) ** 2)

    likelihood = Twins(
        (AngleRandomWalk() + RateRandomWalk()).parameters,
        np.array([1.0, 0.0]),
        np.array([0.005, 0.1]),
        np.zeros(2),
        np.full(2, 30.0),
        np.array([0.1, 0.2]),
        np.array([True, False]),
    )
    priors = default_priors(likelihood)
    target = Target.of(LogPosterior.of(likelihood, priors), np.array([0]), 16)
    random = np.random.RandomState(0)
    # At b = 0, a² is Gaussian around 1 with 1/σ² = 1/0.01² + 1/0.08²; a by its square root.
    a = np.sqrt(1.0 + random.standard_normal(4000) / np.hypot(100.0, 12.5))
    # Such draws have the density 2a·p(a²); the posterior has 1/(a + knee) instead of 2a.
    weight = 1.0 / (a * (a + 0.1))
    a = random.choice(a, 1000, p=weight / weight.sum())
    y = np.log1p(a / 0.1)[:, None]
    result = absent_amplitude(target, 1, y, 256, random)
    x, b = np.meshgrid(np.linspace(0.85, 1.05, 1501), np.linspace(0.0, 0.6, 1201), indexing="ij")
    log_density = -0.5 * (((x**2 + b**2 - 1) / 0.01) ** 2 + ((x**2 - b**2 - 1) / 0.08) ** 2)
    density = (np.exp(log_density) / (x + 0.1) / (b + 0.2)).sum(axis=0)
    probability = np.concatenate([[0.0], np.cumsum((density[1:] + density[:-1]) / 2.0)])
    exact = np.interp([0.5, 0.95], probability / probability[-1], b[0])
    np.testing.assert_allclose([result.quantile(0.5), result.quantile(0.95)], exact, rtol=0.02)
    assert result.effective_draws > 50.0
    # Savage's ratio: of posterior and prior density at zero, both known here.
    width = b[0, 1] - b[0, 0]
    prior_at_zero = 1.0 / (0.2 * np.log1p(30.0 / 0.2))
    factor = density[0] / (probability[-1] * width) / prior_at_zero
    assert result.bayes_factor == pytest.approx(factor, rel=0.03)


def test_detection_is_by_the_bayes_factor(two_terms):
    fit = two_terms(spectral_levels((N, 3.0 * K)), chosen=False)
    clear = sample(fit, "gyro_x")["gyro_x"]["rate_random_walk"]
    assert clear.detected
    assert clear.bayes_factor < 1.0 / 20.0
    assert clear.interval[0] > 0.0
    assert "±" in clear.describe()
    fit = two_terms(spectral_levels((N, 0.03 * K)), chosen=False)
    weak = sample(fit, "gyro_x")["gyro_x"]["rate_random_walk"]
    assert not weak.detected
    assert weak.bayes_factor > 1.0
    assert weak.interval == (0.0, weak.upper_limit)
    assert weak.describe().startswith("not detectable, below ")


# --- What follows from it -----------------------------------------------------------------------------------


def test_derived_quantities_follow_from_the_draws(posterior):
    axis = posterior["gyro_x"]
    fixed = dataclasses.replace(axis, draws=np.tile([N, K], (50, 1)))
    for t, drift in fixed.predicted_drift((0.5, 60.0, 3600.0)).items():
        # σ_A² = N²/T + K²T/3, the thesis's (4.36) and (4.53).
        exact = np.sqrt(2.0) * t * np.sqrt(N**2 / t + K**2 * t / 3.0)
        assert drift.median == pytest.approx(exact, rel=1e-9)
        assert drift.in_unit().median == pytest.approx(np.degrees(exact), rel=1e-9)
        assert drift.unit == "deg"
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
    assert minimum.deviation.unit == "deg/h"
    assert minimum.cluster_time.unit == "s"
    assert minimum.deviation.remark == ""
    falling = dataclasses.replace(axis, draws=np.tile([N, 1e-3 * K], (20, 1))).bias_instability_minimum()
    assert falling.at_end == 1.0
    assert falling.cluster_time.median == pytest.approx(100.0)
    assert "upper bound" in falling.deviation.describe()
    assert posterior["accel_z"].bias_instability_minimum().deviation.unit == "µg"


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
    table = posterior.table()
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

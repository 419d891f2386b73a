"""The posterior: the sampler against quadrature, priors, absent terms."""

import dataclasses
import re
import warnings

import jax.numpy as jnp
import numpy as np
import pytest
from gamma_levels import K, Likelihood, N, quadrature, spectral_levels

from allanjax.base.errors import AllanjaxError, FitError
from allanjax.estimate.fit import fit as fit_recording
from allanjax.noise.terms import AngleRandomWalk, Markov, RateRandomWalk
from allanjax.posterior.likelihood import likelihood_of
from allanjax.posterior.marginals import bayes_factor
from allanjax.posterior.priors import LogUniform, ModifiedLogUniform, Uniform, default_priors
from allanjax.posterior.result import PosteriorWarning
from allanjax.posterior.sample import sample
from allanjax.posterior.sampling import Convergence, LogPosterior, Target, first_walkers, run, split_r_hat
from allanjax.posterior.unsampled_limits import absent_amplitude
from allanjax.record.recording import Recording


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

    class Gaussian(Likelihood):
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
    chains = run(target, start, random, Convergence(20_000, 50.0, 0.05, 1.01), lambda *_: None)
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


def test_the_way_from_a_far_start_is_not_in_the_chain():
    """Two standard normal coordinates, from a start ten standard deviations away.

    Of the way there five autocorrelation times are left out: so much at least must be gone, for with it the
    variance would be twice as large. Without, mean and variance are known by the number of independent draws.
    """
    random = np.random.RandomState(2)
    start = 10.0 + random.standard_normal((32, 2))
    wanted = Convergence(20_000, 50.0, 0.05, 1.01)
    chains = run(lambda y: -0.5 * np.sum(y**2, axis=1), start, random, wanted, lambda *_: None)
    assert chains.converged
    assert chains.steps - len(chains.y) == np.ceil(5.0 * chains.tau.max())
    assert len(chains.log_density) == len(chains.y)
    np.testing.assert_allclose(chains.log_density, -0.5 * np.sum(chains.y**2, axis=2), rtol=1e-12)
    ess = chains.y.shape[0] * chains.y.shape[1] / chains.tau.max()
    np.testing.assert_allclose(chains.y.mean(axis=(0, 1)), 0.0, atol=4.5 / np.sqrt(ess))
    np.testing.assert_allclose(chains.y.var(axis=(0, 1)), 1.0, atol=4.5 * np.sqrt(2.0 / ess))


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
    # The data allow K = 0 … prior_scale; the prior only a band of it.
    prior_scale = likelihood.prior_scale[1]
    prior = LogUniform(0.2 * prior_scale, 0.6 * prior_scale)
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
        float(likelihood.prior_scale[1]), float(likelihood.upper[1])
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
    with pytest.raises(FitError, match="gyro_y: no result to sample around, the start was hopeless"):
        likelihood_of(half_failed_fit, "gyro_y")


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
    middle, weight = (grid[1:] + grid[:-1]) / 2.0, np.diff(probability)
    std = np.sqrt(weight @ middle**2 - (weight @ middle) ** 2)
    assert marginal.std == pytest.approx(std, rel=0.05)
    assert marginal.interval_68[0] == 0.0
    assert marginal.interval_68[1] == pytest.approx(np.interp(0.68, probability, grid), rel=0.03)
    assert not marginal.sampled
    assert not marginal.detected
    assert marginal.interval == (0.0, marginal.upper_limit)
    told = re.fullmatch(r"not detectable, below ([\d.,]+) deg/h/√h \(95 %\)", marginal.in_unit().describe())
    assert float(told[1].replace(",", "")) == pytest.approx(marginal.in_unit().upper_limit, rel=5e-3)


def test_reweighting_is_exact_where_the_terms_are_strongly_correlated():
    """Two amplitudes of nearly the same spectrum: at the limit of one the other has moved by many σ."""

    class Twins(Likelihood):
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
    # Such draws have the density 2a·p(a²); the posterior has 1/(a + prior_scale) instead of 2a.
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


@pytest.mark.parametrize("prior", [None, LogUniform(0.02 * K, 2.0 * K)])
def test_draws_of_the_prior_say_nothing_about_zero(prior):
    """Their Bayes factor is one, to the hundredth that evenly spaced quantiles are good for."""
    ours = spectral_levels((N, 3.0 * K))
    priors = default_priors(ours) | ({} if prior is None else {"rate_random_walk": prior})
    posterior = LogPosterior.of(ours, priors)
    draws = posterior.priors[1].quantile((np.arange(40_000) + 0.5) / 40_000)
    assert np.any(draws < 0.3 * ours.prior_scale[1])
    assert bayes_factor(posterior, 1, draws) == pytest.approx(1.0, abs=0.01)


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


def test_the_posterior_of_a_record_with_missing_samples_is_as_wide_as_its_fit():
    """A fifth lost from white noise: the scatter of N is that of n(1 − f) samples, and that of f·n draws.

    Chains of this length know a standard deviation to some 3 %, hence 10 % of a ratio of two.
    """
    rng = np.random.default_rng(17)
    x = rng.standard_normal((20_000, 1))
    x[rng.random(20_000) < 0.2] = np.nan
    recording = Recording.from_array(x, 100.0, gyro_unit="rad/s", names=["gyro_x"], gaps="fill")
    share = float(np.mean(recording.missing))
    fit = fit_recording(recording, "N")
    as_if_complete = dataclasses.replace(fit, results=[dataclasses.replace(fit["gyro_x"], widening=1.0)])
    wide, narrow = (sample(f, seed=3, min_length=30.0)["gyro_x"]["N"] for f in (fit, as_if_complete))
    expected = np.sqrt(1.0 / (1.0 - share) + share)
    assert wide.std / narrow.std == pytest.approx(expected, rel=0.1)
    assert wide.std == pytest.approx(fit["gyro_x"]["N"].std, rel=0.1)
    assert wide.interval[0] < 0.1 < wide.interval[1]

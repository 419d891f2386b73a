"""Posteriors against quadrature of dense likelihoods: density, marginals, limits, Bayes factors, priors."""

import functools
import itertools

import numpy as np
import pytest
from dense_fits import Gaussian, Spectrum, Variances, drawn, recording
from scipy import stats
from scipy.integrate import quad
from scipy.special import i0e, logsumexp

import allanjax as aj

RATE, N = 10.0, 256
WHITE, WALK = aj.AngleRandomWalk(0.1), aj.RateRandomWalk(0.25)
LABELS = ("angle_random_walk", "rate_random_walk")
T = np.arange(N) / RATE


def fit_of(x, model, objective="whittle"):
    return aj.fit(recording(x, RATE), model, objective, as_is=True)


@pytest.fixture(scope="module")
def records():
    """White noise with a walk that is clear, at the edge of detection, and hardly there; white noise."""
    walks = {"clear": (0.25, 3), "edge": (0.06, 10), "weak": (0.02, 8)}
    found = {k: drawn(WHITE + aj.RateRandomWalk(K), N, RATE, s)[:, 0] for k, (K, s) in walks.items()}
    return found | {"absent": drawn(WHITE, N, RATE, 20)[:, 0]}


@pytest.fixture(scope="module")
def posteriors(records):
    """Of N + K, both sampled, each when it is asked for."""

    def of(kind):
        return aj.sample(fit_of(records[kind], "N + K"), seed=3, progress=False)["gyro_0"]

    return functools.cache(of)


@pytest.fixture(scope="module")
def absent(records):
    """Of white noise, of which the terms were chosen, with limits of the others."""
    return aj.sample(fit_of(records["absent"], None), seed=4, progress=False)["gyro_0"]


class Grid:
    """The posterior of N and another term on a grid, by independent levels about the dense covariance."""

    # The other's amplitudes are quantiles of its prior, each of the same prior probability.
    def __init__(self, x, axis, other=None, label="rate_random_walk"):
        dense = Spectrum(x, RATE, fit_of(x, "N + K")["gyro_0"].spectrum.bins.edges)
        terms = aj.AngleRandomWalk(1.0), other or aj.RateRandomWalk(1.0)
        white, own = map(dense.means, terms)
        size = np.sqrt(np.sum(dense.level * dense.count / white) / dense.count.sum())
        n, c = np.linspace(0.3, 2.0, 400) * size, axis.priors[label].quantile(np.linspace(0.0, 1.0, 1601))
        means = (value**2 * white + c[:, None] ** 2 * own for value in n)
        density = np.array([-0.5 * (np.log(mean) + dense.level / mean) @ dense.count for mean in means])
        density += np.asarray(axis.priors["angle_random_walk"].log_density(n))[:, None]
        joint = np.exp(density - density.max())
        self.marginals = {"N": (n, joint.sum(axis=1)), "K": (c, joint.sum(axis=0))}
        #: Savage's ratio, of posterior and prior density at zero.
        self.bayes_factor = joint[:, 0].sum() / joint.mean(axis=1).sum()

    def probability(self, name, value):
        """Probability that N or K is below a value."""
        x, p = self.marginals[name]
        steps = np.append(0.0, np.cumsum(p[1:] + p[:-1]))
        return np.interp(value, x, steps / steps[-1])

    def std(self, name):
        x, p = self.marginals[name]
        return np.sqrt(p @ x**2 / p.sum() - (p @ x / p.sum()) ** 2)


@pytest.mark.parametrize("kind", ["clear", "edge", "weak"])
def test_marginals_are_those_of_quadrature(records, posteriors, kind):
    """Within 4.5 Monte-Carlo standard errors: of a probability u it is √(u(1 − u)/ESS)."""
    axis, grid = posteriors(kind), Grid(records[kind], posteriors(kind))
    assert axis.converged
    assert axis.labels == LABELS
    for i, (label, name) in enumerate(zip(LABELS, "NK", strict=True)):
        c, draws = axis[label], axis.chain[:, :, i].ravel()
        ess = draws.size / axis.tau[i]
        assert draws.min() >= 0.0
        assert c.detected == (name == "N" or kind == "clear")
        levels = {c.median: 0.5, c.upper_limit: 0.95}
        if c.detected:
            levels |= dict(zip([*c.interval, *c.interval_68], [0.025, 0.975, 0.16, 0.84], strict=True))
        else:
            assert (c.interval, c.interval_68[0]) == ((0.0, c.upper_limit), 0.0)
            levels |= {c.interval_68[1]: 0.68}
        for value, u in levels.items():
            error = np.sqrt(u * (1.0 - u) / ess)
            assert grid.probability(name, value) == pytest.approx(u, abs=4.5 * error), (label, u)
        assert c.std == pytest.approx(grid.std(name), rel=4.5 * np.sqrt(1.5 / ess))
    # Posterior over prior probability of what cannot be distinguished from zero, a third of the scale.
    factor, prior = axis["rate_random_walk"].bayes_factor, axis.priors["rate_random_walk"]
    before = 0.3 / np.log1p(prior.upper / prior.scale)
    exact = grid.probability("K", prior.scale * np.expm1(0.3)) / before
    error = np.sqrt(exact / before / (axis.chain[:, :, 1].size / axis.tau[1]))
    assert factor == pytest.approx(exact, abs=4.5 * error + 1e-3)
    low, high = {"clear": (0.0, 0.05), "edge": (0.1, 0.5), "weak": (1.0, np.inf)}[kind]
    assert low <= factor < high


@pytest.mark.parametrize("term", [aj.RateRandomWalk(1.0), aj.BiasInstability(1.0), aj.Quantization(1.0)])
def test_limits_of_terms_not_sampled_are_those_of_quadrature(records, absent, term):
    """256 draws of N: below 1 % each in several repetitions. Flicker's levels above 64 are approximate."""
    axis, label = absent, term.name()
    assert axis.labels == ("angle_random_walk",)
    c, grid = axis[label], Grid(records["absent"], axis, term, label)
    for value, u in ((c.upper_limit, 0.95), (c.median, 0.5), (c.interval_68[1], 0.68)):
        assert grid.probability("K", value * 1.04) > u > grid.probability("K", value / 1.04), u
    assert c.std == pytest.approx(grid.std("K"), rel=0.05)
    assert c.bayes_factor == pytest.approx(grid.bayes_factor, rel=0.05)
    assert (c.sampled, c.detected, c.interval, c.interval_68[0]) == (False, False, (0.0, c.upper_limit), 0.0)
    # It is not in the curves.
    assert [m.term_labels for m in axis.models(2)] == 2 * [("angle_random_walk",)]
    np.testing.assert_allclose(axis.deviation_curves(np.array([4.0]), 1), axis.draws[:1] / 2.0, rtol=1e-9)


def test_default_priors_are_those_documented(records, posteriors):
    """Uniform to a power of one standard deviation, by dense information; then four logarithmic decades."""
    for kind in ("clear", "weak"):
        axis, fit = posteriors(kind), fit_of(records[kind], "N + K")["gyro_0"]
        dense = Spectrum(records[kind], RATE, fit.spectrum.bins.edges)
        mean = dense.means(fit.model)
        for label, unit in zip(LABELS, (aj.AngleRandomWalk(1.0), aj.RateRandomWalk(1.0)), strict=True):
            scale = np.sum(0.5 * dense.count * (dense.means(unit) / mean) ** 2) ** -0.25
            prior = axis.priors[label]
            assert isinstance(prior, aj.ModifiedLogUniform)
            assert prior.scale == pytest.approx(scale, rel=0.01)
            assert prior.upper >= 0.99e4 * prior.scale
    # Of shapes: logarithmic in the distance from the bound, over what the record can show.
    fit = fit_of(drawn(WHITE + aj.Markov(0.5, 1.5), N, RATE, 7)[:, 0], "N + markov")
    with pytest.warns(aj.PosteriorWarning):
        priors = aj.sample(fit, max_steps=20, progress=False)["gyro_0"].priors
    assert priors["markov_correlation_time"] == aj.LogUniform(2.0 / RATE, N / RATE)


def same_density(axis, dense, tolerance, count=12):
    """The log-posterior along the chain less the priors is a log-likelihood but for a constant [nats]."""
    steps = np.linspace(0, axis.chain[..., 0].size - 1, count).astype(int)
    points = axis.chain.reshape(-1, len(axis.labels))[steps]
    prior = sum(np.asarray(axis.priors[k].log_density(points[:, i])) for i, k in enumerate(axis.labels))
    exact = np.array([dense(dict(zip(axis.labels, p, strict=True))) for p in points.tolist()])
    assert np.ptp(exact) > 1.0
    difference = axis.log_probability.ravel()[steps] - prior - exact
    np.testing.assert_allclose(difference, difference.mean(), atol=tolerance)


def short(fit, axis="gyro_0"):
    """A short chain, for its density alone."""
    with pytest.warns(aj.PosteriorWarning):
        return aj.sample(fit, axis, max_steps=40, seed=2, progress=False)[axis]


def law(dense, model, widening=1.0):
    """Log-likelihood as a function of values."""
    return lambda values: -dense.value(model.with_values(**values)) / widening**2


def test_the_likelihood_is_the_dense_one(records, posteriors):
    """Of the samples' differences, to what bins of a sixth of an octave cost; of levels to rounding."""
    for kind in ("clear", "weak"):
        x, axis = records[kind], posteriors(kind)
        same_density(axis, law(Gaussian(x, RATE), WHITE + WALK), 0.1)
        edges = fit_of(x, "N + K")["gyro_0"].spectrum.bins.edges
        same_density(axis, law(Spectrum(x, RATE, edges), WHITE + WALK), 1e-3)


def test_the_likelihood_of_filters_and_resonances_is_the_dense_one():
    """Of the density at two nodes of a bin."""
    model = aj.LowPass1(1.5) * WHITE + aj.Resonance(0.3, 2.5, 5.0)
    x = drawn(model, N, RATE, 6)[:, 0]
    fit = fit_of(x, model)
    same_density(short(fit), law(Spectrum(x, RATE, fit["gyro_0"].spectrum.bins.edges), model), 0.05)


def test_regressors_and_ramps_of_either_sign_are_integrated_out():
    """The regressor over a flat prior; the ramp is a mixture of both signs."""
    z = np.cumsum(np.random.default_rng(7).normal(size=N)) / 10.0
    x = drawn(WHITE, N, RATE, 5)[:, 0] - 0.02 * T + 0.1 * z
    fit = aj.fit(recording(x, RATE, z=z), "N + R", "whittle", regressors=["z"], as_is=True)
    base = np.linalg.qr(np.column_stack([np.ones(N), z]), mode="complete")[0][:, 2:].T

    def exact(v):
        variance = v["angle_random_walk"] ** 2 * RATE
        left = [base @ (x - s * v["drift_ramp"] * T) for s in (-1.0, 1.0)]
        return logsumexp([-0.5 * y @ y / variance for y in left]) - 0.5 * (N - 2) * np.log(variance)

    same_density(short(fit), exact, 0.02)


def test_a_line_is_averaged_over_its_phase():
    """White noise: the average of exp over phases is a Bessel function of the line's own amplitude."""
    # Beyond 64 coefficients from the line its best fit is taken out whatever the point: some tenths of a nat.
    x = drawn(WHITE, N, RATE, 6)[:, 0] + 0.25 * np.cos(2.0 * np.pi * 2.345 * T + 1.0)
    z = x - x.mean()

    def exact(v):
        variance = v["angle_random_walk"] ** 2 * RATE
        wave = np.exp(2j * np.pi * v["sinusoid_frequency"] * T)
        wave = wave - wave.mean()
        p, amplitude = abs(z @ wave) / variance, v["sinusoid_amplitude"]
        energy = np.sum(abs(wave) ** 2) / 2.0 / variance
        noise = -0.5 * (N - 1) * np.log(variance) - 0.5 * z @ z / variance
        return noise + np.log(i0e(amplitude * p)) + amplitude * p - 0.5 * amplitude**2 * energy

    same_density(short(fit_of(x, "N + sinusoid")), exact, 0.7, 20)


def test_allan_variances_have_correlated_chi_square_laws():
    """Of every second one: normal scores of cube roots, with the correlations of quadratic forms."""
    n, model = 128, WHITE + WALK
    x = drawn(model, n, RATE, 7)[:, 0]
    fit = fit_of(x, "N + K", "allan")
    dense = Variances.of_allan(x, RATE, fit.curve.cluster_size[::2])

    def exact(v):
        mean, C = dense.moments(model.with_values(**v))
        relative = C / np.outer(mean, mean)
        own, ratio = np.diag(relative), dense.found / mean
        u = (np.cbrt(ratio) - 1.0 + own / 9.0) / np.sqrt(own / 9.0) * np.sqrt(own)
        L = np.linalg.cholesky(relative + 1e-4 * np.diag(own))
        density = -0.5 * np.sum(np.linalg.solve(L, u) ** 2) - np.sum(np.log(np.diag(L)))
        # Densities of the variances themselves.
        return density - np.sum(2.0 / 3.0 * np.log(ratio) + np.log(mean))

    same_density(short(fit), exact, 0.15)


def test_a_record_with_missing_samples_has_a_wider_posterior():
    """By the factor of its fit, √(1/(1 − f) + f): of one axis a fifth is missing, of the other nothing."""
    x = drawn(WHITE + WALK, N, RATE, 9, 2)
    x[np.random.default_rng(17).random(N) < 0.2, 0] = np.nan
    whole = aj.Recording.from_array(x, RATE, gyro_unit="rad/s", names=["gyro_0", "gyro_1"], gaps="fill")
    fit = aj.fit(whole, "N + K", "whittle", as_is=True)
    share = np.mean(np.isnan(x[:, 0]))
    factor = np.sqrt(1.0 / (1.0 - share) + share)
    assert [r.widening for r in fit.results] == pytest.approx([factor, 1.0])
    for k, by in enumerate((factor, 1.0)):
        dense = Spectrum(whole.values[:, k], RATE, fit.results[k].spectrum.bins.edges)
        same_density(short(fit, f"gyro_{k}"), law(dense, WHITE + WALK, by), 1e-3)


@pytest.mark.parametrize("objective", ["whittle", "allan"])
def test_the_posterior_of_an_incomplete_model_is_as_wide_as_its_intervals(objective):
    """White noise with a line that the model lacks: the posterior's deviation is the fit's to a fourth."""
    # The one is of a skew law, the other its curvature; of a model taken for true it is less than half of it.
    x = np.random.default_rng(9).normal(size=512) + 0.7 * np.sin(np.pi * np.arange(512) / 10.0)
    fit = fit_of(x, "N", objective)
    assert fit["gyro_0"].discrepancy > 0.05
    std = aj.sample(fit, seed=5, progress=False)["gyro_0"]["N"].std
    assert std == pytest.approx(fit["gyro_0"]["N"].std, rel=0.25)
    assert std > 2.0 * x.std() / np.sqrt(RATE) / np.sqrt(2.0 * 512)


def test_a_users_prior_is_obeyed(records):
    """A band of what the data allow: the median by quadrature."""
    x, prior = records["weak"], aj.LogUniform(0.01, 0.05)
    axis = aj.sample(fit_of(x, "N + K"), priors={"rate_random_walk": prior}, seed=1, progress=False)["gyro_0"]
    assert axis.priors["rate_random_walk"] == prior
    assert prior.lower <= axis.chain[:, :, 1].min() <= axis.chain[:, :, 1].max() <= prior.upper
    grid, c = Grid(x, axis), axis["rate_random_walk"]
    assert grid.probability("K", 1.04 * c.median) > 0.5 > grid.probability("K", c.median / 1.04)
    # Zero is excluded beforehand.
    assert c.bayes_factor == 0.0


def test_a_chain_has_its_diagnostics(posteriors, absent):
    emcee = pytest.importorskip("emcee")
    for axis in (*map(posteriors, ("clear", "edge", "weak")), absent):
        # Five autocorrelation times of burn-in, and fifty of chain.
        assert axis.steps - len(axis.chain) == np.ceil(5.0 * max(axis.tau.max(), 1.0))
        assert (len(axis.chain) > 50.0 * axis.tau).all()
        tau = emcee.autocorr.integrated_time(axis.chain, tol=0, quiet=True)
        np.testing.assert_allclose(axis.tau, tau, rtol=0.15)
        assert (axis.r_hat < 1.01).all()
        assert 0.2 < axis.acceptance < 0.9
        assert (axis.rate, axis.duration) == (RATE, N / RATE)
        thin = max(1, int(axis.tau.max() / 2.0))
        np.testing.assert_array_equal(axis.draws, axis.chain[::thin].reshape(-1, len(axis.labels)))


def test_a_chain_that_is_too_short_warns_what_to_do(records):
    fit = fit_of(records["clear"], "N + K")
    with pytest.warns(aj.PosteriorWarning, match=r"gyro_0.*random_walk.*max_steps=120"):
        posterior = aj.sample(fit, max_steps=30, progress=False)
    assert not posterior.converged
    assert posterior["gyro_0"].steps == 30
    assert "NOT CONVERGED" in str(posterior)


@pytest.mark.filterwarnings("ignore::allanjax.PosteriorWarning")
def test_seeds_and_axes_have_their_own_streams(records, capsys):
    fit = fit_of(np.column_stack([records["clear"]] * 2), "N + K")
    both, one, other = (
        aj.sample(fit, axes, seed=seed, max_steps=20, progress=False)
        for axes, seed in ((None, 5), ("gyro_1", 5), (["gyro_1"], 6))
    )
    assert capsys.readouterr() == ("", "")
    np.testing.assert_array_equal(both["gyro_1"].draws, one["gyro_1"].draws)
    assert not np.array_equal(both["gyro_0"].draws, both["gyro_1"].draws)
    assert not np.array_equal(one["gyro_1"].draws, other["gyro_1"].draws)
    assert one["gyro_1"].chain.shape[1] == 32
    assert aj.sample(fit, "gyro_0", max_steps=20, walkers=8, progress=True)["gyro_0"].chain.shape[1] == 8
    out, err = capsys.readouterr()
    assert out == ""
    assert "gyro_0" in err


REFUSED = [
    ("rate_walk", {"priors": {"rate_walk": aj.Uniform(0.0, 1.0)}}),
    ("rate_random_walk", {"priors": {"rate_random_walk": 3.0}}),
    ("walkers", {"walkers": 7}), ("walkers", {"walkers": 2}), ("max_steps", {"max_steps": 9}),
    ("min_length", {"min_length": 0.0}), ("max_change", {"max_change": 0.0}),
    ("max_r_hat", {"max_r_hat": 1.0}), ("absent_draws", {"absent_draws": 1}), ("seed", {"seed": -1}),
    ("gyro_q", {"axes": "gyro_q"}), ("axis", {"axes": []}),
]  # fmt: skip


def test_what_cannot_be_done_is_refused(records):
    fit = fit_of(records["clear"], "N + K")
    for word, arguments in REFUSED:
        with pytest.raises(aj.AllanjaxError, match=word):
            aj.sample(fit, **({"axes": "gyro_0", "progress": False} | arguments))


def test_held_parameters_and_shapes_of_what_is_absent(records):
    model = aj.AngleRandomWalk(0.1).hold("coefficient") + aj.RateRandomWalk()
    axis = aj.sample(fit_of(records["clear"], model), seed=1, progress=False)["gyro_0"]
    assert axis.labels == ("rate_random_walk",)
    assert (axis["N"].value, axis["N"].held, axis["N"].sampled) == (0.1, True, False)
    dense = Spectrum(records["clear"], RATE, np.arange(1, N + 1))
    std = dense.std(WHITE + aj.RateRandomWalk(axis["K"].median), ["rate_random_walk"])["rate_random_walk"]
    assert axis["K"].std == pytest.approx(std, rel=0.15)


PRIORS = [
    aj.Uniform(0.2, 7.0), aj.Uniform(-1.0, 1.0), aj.LogUniform(1e-3, 2.0), aj.LogUniform(0.7, 50.0, 0.5),
    aj.LogNormal(3.0, 2.5), aj.ModifiedLogUniform(1e-2, 40.0), aj.ModifiedLogUniform(5.0, 1.0),
]  # fmt: skip


@pytest.mark.parametrize("prior", PRIORS, ids=str)
def test_density_integrates_to_one_and_quantile_is_its_inverse(prior):
    density = lambda x: float(np.exp(prior.log_density(x)))  # noqa: E731
    for u in (0.0, 0.03, 0.4, 0.9, 1.0):
        end = prior.quantile(u)
        # Piecewise between quantiles, since densities span decades.
        pieces = prior.quantile(np.linspace(1e-9, 1.0 - 1e-9, 40))
        pieces = [prior.lower, *pieces[pieces < end], end]
        below = sum(quad(density, a, b, epsrel=1e-9)[0] for a, b in itertools.pairwise(pieces))
        assert below == pytest.approx(u, abs=1e-7)
    outside = np.array([prior.lower - 0.5, prior.lower - 1e-9, prior.upper * 1.001, prior.upper + 100.0])
    assert np.all(np.asarray(prior.log_density(outside[np.isfinite(outside)])) == -np.inf)
    assert np.all(np.isfinite(prior.log_density(prior.quantile(np.linspace(0.01, 0.99, 9)))))


def test_densities_are_those_of_scipy():
    x = np.geomspace(0.02, 1.9, 11)
    laws = {2: stats.loguniform(1e-3, 2.0), 4: stats.lognorm(np.log(2.5), scale=3.0)}
    for k, law in laws.items():
        np.testing.assert_allclose(PRIORS[k].log_density(x), law.logpdf(x), rtol=1e-12, atol=1e-12)
    # Gregory (2005): uniform far below the scale, 1/x far above it.
    gregory = PRIORS[5]
    assert gregory.log_density(0.0) == pytest.approx(-np.log(1e-2 * np.log(1.0 + 40.0 / 1e-2)))
    assert np.exp(gregory.log_density(2.0) - gregory.log_density(20.0)) == pytest.approx(10.0, rel=5e-3)


IMPROPER = [
    (aj.Uniform, 1.0, 1.0), (aj.Uniform, 0.0, np.inf), (aj.LogUniform, 0.0, 1.0), (aj.LogUniform, 2.0, 1.0),
    (aj.LogUniform, 0.4, 1.0, 0.5), (aj.LogNormal, 0.0, 2.0), (aj.LogNormal, 1.0, 1.0),
    *((aj.ModifiedLogUniform, *numbers) for numbers in ((0.0, 1.0), (np.nan, 1.0), (1.0, 0.0))),
]  # fmt: skip


@pytest.mark.parametrize(("kind", "numbers"), [(kind, numbers) for kind, *numbers in IMPROPER])
def test_improper_priors_are_refused(kind, numbers):
    with pytest.raises(aj.AllanjaxError, match="give "):
        kind(*numbers)

"""Whittle's likelihood against dense Gaussian likelihoods of the same 512 samples, and fits with a known
truth.

The dense likelihoods are restricted: of contrasts orthogonal to the mean (and to regressors), which make the
generalized covariance of a random walk or flicker a proper one.
"""

import dataclasses

import equinox as eqx
import jax
import numpy as np
import pytest
from scipy.linalg import eigh, toeplitz
from scipy.optimize import minimize
from scipy.special import logsumexp

import allanjax as aj
from allanjax.posterior.likelihood import AllanLikelihood, likelihood_of

RATE, N_SAMPLES = 10.0, 512
TIME = np.arange(N_SAMPLES) / RATE
K_SIGMA = 4.0
N, K, B, Q = 0.1, 0.03, 0.1, 0.03


def autocovariance(G):
    g = G(np.arange(N_SAMPLES + 1) / RATE)
    g = np.append(g[1], g)
    return -(g[2:] - 2.0 * g[1:-1] + g[:-2]) * RATE**2


def flicker(t):
    positive = np.where(t > 0.0, t, 1.0)
    return positive**2 * np.log(positive) / (2.0 * np.pi)


UNIT = {
    "K": toeplitz(autocovariance(lambda t: t**3 / 12.0)),
    "B": toeplitz(autocovariance(flicker)),
    "Q": toeplitz(autocovariance(lambda t: 1.0 * (t == 0.0))),
    "0": np.zeros((N_SAMPLES, N_SAMPLES)),
}


def contrasts(*columns):
    """Orthonormal rows orthogonal to a constant and these columns; no cosine transform."""
    fixed = np.column_stack([np.ones(N_SAMPLES), *columns])
    return np.linalg.qr(fixed, mode="complete")[0][:, fixed.shape[1] :].T


class Dense:
    """The restricted Gaussian log-likelihood of N² + c²·(unit covariance), by simultaneous
    diagonalization.
    """

    def __init__(self, other, *projected):
        self.H = contrasts(*projected)
        self.eigenvalues, vectors = eigh(self.H @ UNIT[other] @ self.H.T)
        self.to_modes = vectors.T @ self.H

    def __call__(self, x, n, c=0.0):
        variance = n**2 * RATE + c**2 * self.eigenvalues
        return -0.5 * float(np.sum((self.to_modes @ x) ** 2 / variance + np.log(variance)))

    def maximum(self, x, start):
        """The amplitudes; the logarithm of the second may run off to zero."""
        found = minimize(
            lambda u: -self(x, *np.exp(u)),
            np.log(start),
            method="Nelder-Mead",
            options={"xatol": 1e-5, "fatol": 1e-7},
        )
        return np.exp(found.x)


@pytest.fixture(scope="module")
def dense():
    return {other: Dense(other) for other in "KBQ0"}


def draws(other, c, axes, seed):
    """White noise and another by the square root of its dense covariance, without its mean: [samples,
    axes].
    """
    random = np.random.default_rng(seed)
    H = contrasts()
    power, vectors = eigh(H @ UNIT[other] @ H.T)
    root = H.T @ (vectors * np.sqrt(np.maximum(power, 0.0)))
    white = N * np.sqrt(RATE) * random.normal(size=(N_SAMPLES, axes))
    return white + c * root @ random.normal(size=(N_SAMPLES - 1, axes))


def recording(x, **auxiliary):
    x = np.asarray(x).reshape(len(x), -1)
    axes = tuple(aj.Axis(f"gyro_{k}", "gyro", "rad/s") for k in range(x.shape[1]))
    return aj.Recording(x, RATE, axes, auxiliary)


OTHERS = {"K": (aj.RateRandomWalk, K), "B": (aj.BiasInstability, B), "Q": (aj.Quantization, Q)}


@pytest.fixture(scope="module")
def pairs():
    """White noise with a random walk, flicker or quantization: records and fits, four axes each."""
    found = {}
    for seed, (other, (term, c)) in enumerate(OTHERS.items()):
        x = draws(other, c, 4, 100 + seed)
        found[other] = (x, aj.fit(recording(x), aj.AngleRandomWalk() + term(), "whittle", as_is=True))
    return found


@eqx.filter_jit
def evaluate(ours, points):
    return jax.vmap(ours)(points)


WHITE_ONLY = aj.Model((aj.AngleRandomWalk(),))

# --- Two random terms ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    # Coefficients correlate a little under flicker, and under quantization, whose two end readings all share.
    ("other", "share"),
    [("K", 0.01), ("B", 0.07), ("Q", 0.25)],
)
def test_the_estimate_is_that_of_maximum_likelihood(pairs, dense, other, share):
    """Within this share of a standard error of the maximum of the exact likelihood."""
    x, fit = pairs[other]
    for k, result in enumerate(fit.results):
        values, std = np.array([(c.value, c.std) for c in result.coefficients.values()]).T
        assert (result.converged, result.discrepancy) == (True, 0.0)
        exact = dense[other].maximum(x[:, k], (N, OTHERS[other][1]))
        if values[1] == 0.0:  # at the boundary
            assert exact[1] < 0.01 * result.coefficients[list(result.coefficients)[1]].upper_limit
        else:
            assert (np.abs(values - exact) < share * std).all()


@pytest.mark.parametrize(("other", "tolerance"), [("K", 0.05), ("B", 0.4)])
def test_likelihood_differences_are_those_of_the_dense_one(pairs, dense, other, tolerance):
    """Over points up to some forty nats below; bins of a sixth of an octave and correlations cost the
    tolerance.
    """
    x, fit = pairs[other]
    ours = likelihood_of(fit, "gyro_0")
    assert ours.parameters[0].label == "angle_random_walk"
    c = OTHERS[other][1]
    points = [(N, c), (1.1 * N, c), (N, 1.5 * c), (0.9 * N, 0.6 * c), (1.05 * N, 3.0 * c), (N, 0.2 * c)]
    found = np.asarray(evaluate(ours, np.array(points)))
    exact = np.array([dense[other](x[:, 0], *point) for point in points])
    np.testing.assert_allclose(found - found[0], exact - exact[0], atol=tolerance)
    assert np.ptp(exact) > 5.0


def test_what_was_simulated_is_found(pairs):
    """Within 4 standard deviations where a term is found; most upper limits are above the truth (95 %
    should).
    """
    above = []
    for other, (_, c) in OTHERS.items():
        for result in pairs[other][1].values():
            first, second = result.coefficients.values()
            assert abs(first.value - N) < K_SIGMA * first.std
            if second.detected:
                assert abs(second.value - c) < K_SIGMA * second.std
            above.append(second.upper_limit > c)
    # Fewer than 8 of 12 would happen once in 3,000 even if they covered 90 %.
    assert sum(above) >= 8


def test_scale_and_bias_change_nothing(pairs):
    x, fit = pairs["K"]
    model = aj.AngleRandomWalk() + aj.RateRandomWalk()
    for other, factor in ((10.0 * x, 10.0), (1e-6 * x, 1e-6), (x + 9.81, 1.0)):
        again = aj.fit(recording(other), model, "whittle")
        for name in fit.axes:
            for label, c in fit[name].coefficients.items():
                d = again[name][label]
                # The solver stops within a thousandth of a standard deviation.
                assert d.value == pytest.approx(factor * c.value, abs=3e-3 * factor * c.std)
                assert d.detected == c.detected
                assert d.upper_limit == pytest.approx(factor * c.upper_limit, rel=0.02)
            assert again[name].chi2 == pytest.approx(fit[name].chi2, rel=1e-2)


# --- Ramps, lines and regressors ----------------------------------------------------------------------------


def test_a_ramp_is_a_mixture_of_both_signs(dense):
    x = draws("0", 0.0, 1, 5)[:, 0] - 0.03 * TIME
    fit = aj.fit(recording(x), aj.AngleRandomWalk() + aj.DriftRamp(), "whittle")
    ours = likelihood_of(fit, "gyro_0")

    def exact(n, R):
        return logsumexp([dense["0"](x - s * R * TIME, n) for s in (-1.0, 1.0)]) - np.log(2.0)

    points = [(N, 0.0), (N, 0.003), (N, 0.03), (N, 0.04), (1.1 * N, 0.02), (0.9 * N, 0.001)]
    found = np.asarray(evaluate(ours, np.array(points)))
    np.testing.assert_allclose(found - found[0], [exact(*p) - exact(*points[0]) for p in points], atol=1e-6)
    # And its estimate is plain regression: white noise has but one level.
    ramp = fit["gyro_0"]["drift_ramp"]
    slope, covariance = np.polyfit(TIME, x, 1, cov=True)
    assert ramp.value == pytest.approx(abs(slope[0]), abs=0.02 * ramp.std)
    assert ramp.std == pytest.approx(np.sqrt(covariance[0, 0]), rel=0.02)
    assert ramp.detected


def test_a_line_is_averaged_over_its_phase(dense):
    f, A = 2.345, 0.15
    x = draws("0", 0.0, 1, 6)[:, 0] + A * np.cos(2.0 * np.pi * f * TIME + 1.0)
    fit = aj.fit(recording(x), aj.AngleRandomWalk() + aj.Sinusoid(), "whittle")
    ours = likelihood_of(fit, "gyro_0")

    def exact(n, A, f):
        phases = 2.0 * np.pi * np.arange(64) / 64
        waves = [A * np.cos(2.0 * np.pi * f * TIME + phase) for phase in phases]
        return logsumexp([dense["0"](x - wave, n) for wave in waves]) - np.log(64.0)

    points = [
        (N, A, f),
        (N, 0.0, f),
        (1.1 * N, 0.1, f + 0.003),
        (N, 0.17, f - 0.005),
        (0.95 * N, 0.05, f + 0.02),
    ]
    found = np.asarray(evaluate(ours, np.array(points)))
    reference = np.array([exact(*point) for point in points])
    # Beyond 64 coefficients from the line, where 1 % of its 29 nats are, its best fit is taken out
    # whatever the
    # point: that costs √(2·29·0.01) = 0.76 nats, give or take.
    np.testing.assert_allclose(found - found[0], reference - reference[0], atol=1.5)
    assert np.ptp(reference) > 20.0
    result = fit["gyro_0"]
    bound = np.sqrt(6.0) * N * np.sqrt(RATE) / (np.pi * A * N_SAMPLES / RATE * np.sqrt(N_SAMPLES))
    assert abs(result["sinusoid_frequency"].value - f) < K_SIGMA * bound
    assert result["sinusoid_frequency"].std == pytest.approx(bound, rel=0.4)
    assert abs(result["sinusoid_amplitude"].value - A) < K_SIGMA * N * np.sqrt(2.0 * RATE / N_SAMPLES)


@pytest.fixture(scope="module")
def regressed():
    random = np.random.default_rng(7)
    temperature = 20.0 + np.cumsum(random.normal(size=N_SAMPLES)) / 10.0
    x = draws("K", K, 1, 8)[:, 0] + 0.05 * temperature
    model = aj.AngleRandomWalk() + aj.RateRandomWalk()
    fit = aj.fit(recording(x, temperature=temperature), model, "whittle", regressors=["temperature"])
    return x, temperature, fit


def test_a_regressor_is_projected_out(regressed):
    x, temperature, fit = regressed
    restricted = Dense("K", temperature)
    ours = likelihood_of(fit, "gyro_0")
    points = [(N, K), (1.1 * N, K), (N, 1.5 * K), (0.9 * N, 0.6 * K), (1.05 * N, 3.0 * K), (N, 0.2 * K)]
    found = np.asarray(evaluate(ours, np.array(points)))
    exact = np.array([restricted(x, *point) for point in points])
    np.testing.assert_allclose(found - found[0], exact - exact[0], atol=0.02)
    values, std = np.array([(c.value, c.std) for c in fit["gyro_0"].coefficients.values()]).T
    # The degrees of freedom are shared out before, by the noise of the round before.
    assert (np.abs(values - restricted.maximum(x, (N, K))) < 0.1 * std).all()


def test_its_coefficient_is_that_of_generalized_least_squares(regressed):
    x, temperature, fit = regressed
    n, k = (c.value for c in fit["gyro_0"].coefficients.values())
    H = contrasts()
    V = H @ (n**2 * RATE * np.eye(N_SAMPLES) + k**2 * UNIT["K"]) @ H.T
    z, y = H @ temperature, H @ x
    precision = z @ np.linalg.solve(V, z)
    beta, std = fit["gyro_0"].regression["temperature"]
    assert std == pytest.approx(precision**-0.5, rel=0.01)
    assert beta == pytest.approx(z @ np.linalg.solve(V, y) / precision, abs=0.02 * std)
    assert abs(beta - 0.05) < K_SIGMA * std


def test_errors_say_what_to_do(regressed):
    x, temperature, _ = regressed
    whole = recording(x, temperature=temperature, constant=np.full(N_SAMPLES, 3.0))
    with pytest.raises(aj.AllanjaxError, match='must be one of "allan", "whittle", "wavelet", "exact", not'):
        aj.fit(whole, WHITE_ONLY, "spectrum")
    with pytest.raises(aj.AllanjaxError, match='give objective="whittle"'):
        aj.fit(whole, WHITE_ONLY, regressors=["temperature"])
    with pytest.raises(
        aj.AllanjaxError, match="no auxiliary channel 'pressure'; it has temperature, constant"
    ):
        aj.fit(whole, WHITE_ONLY, "whittle", regressors=["pressure"])
    with pytest.raises(aj.AllanjaxError, match="constant"):
        aj.fit(whole, WHITE_ONLY, "whittle", regressors=["constant"])
    with pytest.raises(aj.FitError, match="needs a noise term besides lines and ramps"):
        aj.fit(whole, aj.Model((aj.DriftRamp(),)), "whittle")


# --- Misfit, and the other objective ------------------------------------------------------------------------


@pytest.fixture(scope="module")
def humped():
    """White noise, and the same with a line that the model lacks, fitted with both objectives.

    So small a line (half of the noise's variance) that the curve is off by a factor in one octave only.
    """
    clean = draws("0", 0.0, 1, 9)[:, 0]
    line = 0.7 * clean.std() * np.sin(2.0 * np.pi * np.arange(N_SAMPLES) / 20.0)
    both = recording(np.column_stack([clean, clean + line]))
    return {objective: aj.fit(both, WHITE_ONLY, objective) for objective in ("whittle", "allan")}


def test_a_line_that_the_model_lacks_is_said_so(humped):
    fits = humped["whittle"]
    good, bad = fits["gyro_0"], fits["gyro_1"]
    assert (good.discrepancy, good.p_value > 1e-6) == (0.0, True)
    assert bad.discrepancy > 0.05
    assert bad.p_value < 1e-6
    assert "model incomplete" in bad.verdict()
    assert bad["angle_random_walk"].std > 3.0 * good["angle_random_walk"].std


@pytest.mark.parametrize("objective", ["whittle", "allan"])
def test_the_posterior_of_an_incomplete_model_is_as_wide_as_its_intervals(humped, objective):
    """The standard deviation under the likelihood, by quadrature, is the fit's to a fourth.

    Both have the discrepancy in them, but the one is of a skew law and the other its curvature; of a model
    taken for the truth it would be several times narrower.
    """
    fit = humped[objective]
    c = fit["gyro_1"]["angle_random_walk"]
    widths = {}
    for discrepancy in (fit["gyro_1"].discrepancy, 0.0):
        taken = dataclasses.replace(fit["gyro_1"], discrepancy=discrepancy)
        ours = likelihood_of(dataclasses.replace(fit, results=(fit["gyro_0"], taken)), "gyro_1")
        points = np.linspace(0.2, 4.0, 2001) * c.value
        log_density = np.asarray(evaluate(ours, points[:, None]))
        density = np.exp(log_density - log_density.max())
        mean = points @ density / density.sum()
        widths[discrepancy] = np.sqrt((points - mean) ** 2 @ density / density.sum())
    with_it, without = widths.values()
    assert with_it == pytest.approx(c.std, rel=0.25)
    assert with_it > 3.0 * without


@pytest.fixture(scope="module")
def by_allan(pairs):
    return aj.fit(recording(pairs["K"][0]), aj.AngleRandomWalk() + aj.RateRandomWalk())


@pytest.mark.parametrize("objective", ["whittle", "allan"])
def test_the_scale_of_a_prior_is_what_these_data_could_just_tell_from_zero(pairs, by_allan, dense, objective):
    """The amplitude whose square is one standard deviation, by the information of the dense likelihood.

    ½ Σ (λ/variance)² over its modes at the fit. Cosine levels have all of it, Allan variances at two cluster
    times an octave of 512 samples half, which is a fifth in the amplitude.
    """
    fit = pairs["K"][1] if objective == "whittle" else by_allan
    walk = dense["K"].eigenvalues
    for name in fit.axes:
        ours = likelihood_of(fit, name)
        n, k = (fit[name][label].value for label in ("angle_random_walk", "rate_random_walk"))
        variance = n**2 * RATE + k**2 * walk
        for scale, power in zip(ours.prior_scale, (RATE * np.ones_like(walk), walk), strict=True):
            exact = np.sum(0.5 * (power / variance) ** 2) ** -0.25
            assert scale == pytest.approx(exact, rel=0.05 if objective == "whittle" else 0.3)


def test_the_likelihood_of_the_allan_variances_peaks_near_their_fit(by_allan):
    for name in by_allan.axes:
        ours = likelihood_of(by_allan, name)
        assert isinstance(ours, AllanLikelihood)
        values, std = np.array([(c.value, c.std) for c in by_allan[name].coefficients.values()]).T
        assert np.isfinite(evaluate(ours, np.tile([values[0], 0.0], (81, 1)))).all()  # without the walk
        if values[1] == 0.0:
            continue
        steps = np.linspace(-2.0, 2.0, 9)
        points = values + std * np.stack(np.meshgrid(steps, steps, indexing="ij"), axis=-1)
        grid = np.asarray(evaluate(ours, points.reshape(-1, 2))).reshape(9, 9)
        a, b = np.unravel_index(np.nanargmax(grid), grid.shape)
        assert abs(steps[a]) <= 1.0
        assert abs(steps[b]) <= 1.0
        assert grid[0, 4] < grid[a, b] - 0.5
        assert grid[8, 4] < grid[a, b] - 0.5


def test_both_objectives_agree_within_their_scatter(pairs, by_allan):
    """They look at the same record, so that they differ by less than the larger standard deviation's
    double.
    """
    for one, other in zip(by_allan.results, pairs["K"][1].results, strict=True):
        for label, c in one.coefficients.items():
            if c.detected:
                assert abs(c.value - other[label].value) < 2.0 * c.std

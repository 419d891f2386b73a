"""Intervals, limits and what counts as detected, by their definitions."""

import numpy as np
import pytest
from dense_fits import Spectrum, drawn, recording
from scipy.optimize import brentq
from scipy.signal import lfilter
from scipy.stats import chi2, ncx2, norm

import allanjax as aj

RATE, N = 10.0, 256
WHITE, WALK = aj.AngleRandomWalk(0.1), aj.RateRandomWalk(0.06)
# Probabilities that data are smaller than they are, were the truth at the ends of an estimate.
LEVELS = {"interval": (0.975, 0.025), "interval_68": (0.84, 0.16), "upper_limit": (0.05,)}


def ends_of(c):
    """Each end of an estimate, with the probability of smaller data if the truth were there."""
    for name, levels in LEVELS.items():
        ends = getattr(c, name)
        yield from zip(ends if name != "upper_limit" else (ends,), levels, strict=True)


@pytest.mark.parametrize("n", [65, 200])
def test_white_noise_has_the_intervals_of_its_chi_square_law(n):
    """All squares together are χ² with n − 1 degrees of freedom.

    Between hypotheses half a standard deviation apart the score is interpolated: a tenth of one.
    """
    x = drawn(WHITE, n, RATE, 3)[:, 0]
    result = aj.fit(recording(x, RATE), "N", "whittle", as_is=True)["gyro_0"]
    c = result["N"]
    square = np.sum((x - x.mean()) ** 2) / RATE
    assert c.value == pytest.approx(np.sqrt(square / (n - 1)), rel=1e-6)
    assert c.std == pytest.approx(c.value / np.sqrt(2.0 * (n - 1)), rel=1e-5)
    for end, level in ends_of(c):
        assert end == pytest.approx(np.sqrt(square / chi2.ppf(level, n - 1)), abs=0.1 * c.std)
    assert result.covariance == pytest.approx(c.std**2, rel=1e-9)


def test_amplitudes_have_the_limits_of_the_likelihoods_profile():
    """Scores at hypotheses and the ratio of likelihoods agree where an amplitude is known to a tenth."""
    model = WHITE + aj.RateRandomWalk(1.0)
    x = drawn(model, N, RATE, 2)[:, 0]
    result = aj.fit(recording(x, RATE), model, "whittle", as_is=True)["gyro_0"]
    dense = Spectrum(x, RATE, result.spectrum.bins.edges)
    found = model.with_values(**{label: c.value for label, c in result.coefficients.items()})
    least = dense.value(found)
    for label, other in (
        ("rate_random_walk", "angle_random_walk"),
        ("angle_random_walk", "rate_random_walk"),
    ):
        for end, level in ends_of(result[label]):
            at = dense.maximum(found.with_values(**{label: end}), [other])
            root = np.sqrt(2.0 * (dense.value(at) - least)) * np.sign(result[label].value - end)
            assert root == pytest.approx(norm.ppf(level), abs=0.12), (label, level)
    # Covariances are those of the amplitudes themselves.
    information = dense.information(found, list(result.coefficients))
    values = np.array([c.value for c in result.coefficients.values()])
    np.testing.assert_allclose(
        result.covariance, np.linalg.inv(information) * np.outer(values, values), rtol=0.01
    )


def test_a_term_that_is_absent_has_the_limit_of_its_score():
    """By the law of the score under the limit itself, of weighted Gamma variates, drawn 40,000 times.

    What the data want less than nothing counts as nothing: the score at zero is taken off, so that limits
    are never too low, and the fewer levels tell of a walk the higher.
    """
    n, told = 65, 0
    x = drawn(WHITE, n, RATE, 6, 8)
    fit = aj.fit(recording(x, RATE), "N + K", "whittle", as_is=True)
    gammas = np.random.default_rng(1).chisquare(1.0, (40_000, n - 1))
    for k, result in enumerate(fit.results):
        c = result["K"]
        if c.value > 0.0:
            continue
        told += 1
        assert (c.std, c.interval[0], c.interval_68[0], c.detected) == (0.0, 0.0, 0.0, False)
        dense = Spectrum(x[:, k], RATE, np.arange(1, n + 1))
        white, walk = (dense.means(aj.Model((t,))) for t in (aj.AngleRandomWalk(1.0), aj.RateRandomWalk(1.0)))

        def score(v, dense=dense, white=white, walk=walk):
            """How improbably small the data's estimate of the walk is, the white noise adjusted to v."""

            def slope(p):
                mean = p * white + v * walk
                return np.sum(white / mean * (1.0 - dense.level / mean))

            mean = brentq(slope, 1e-9, 1.0) * white + v * walk
            D = np.stack([white, walk]) / mean
            weights = np.linalg.solve(D @ D.T, D)[1]
            return norm.ppf(np.mean(gammas @ weights < weights @ (dense.level / mean)))

        assert -3.7 < score(c.upper_limit**2) < -1.6
        assert c.interval_68[1] < c.upper_limit < c.interval[1]
        assert score(c.interval_68[1] ** 2) < -0.95
        assert score(c.interval[1] ** 2) < -1.7
    assert told >= 3


def column(term, n):
    """Columns of what a deterministic term adds, and the model to fit."""
    t = np.arange(n) / RATE
    if term == "ramp":
        return t[:, None], aj.AngleRandomWalk() + aj.DriftRamp()
    if term == "step":
        return (t >= 9.0)[:, None].astype(float), aj.AngleRandomWalk() + aj.BiasStep(time=9.0)
    wave = np.stack([np.cos(2.0 * np.pi * 2.345 * t), np.sin(2.0 * np.pi * 2.345 * t)], axis=1)
    return wave, aj.AngleRandomWalk() + aj.Sinusoid(None, 2.345).hold("frequency")


@pytest.mark.parametrize("term", ["ramp", "step", "line"])
def test_ramps_steps_and_lines_have_the_noncentral_chi_square_law(term):
    """Of the square of their estimate by regression, from nothing to 40 standard deviations of amplitude.

    Upper ends never rest on less than the median of pure noise; far from zero a normal law stands for the
    noncentral one, to 2·10⁻⁴ of probability. A line is known by the coefficients about it: 6 % of that.
    """
    columns, model = column(term, N)
    degrees = columns.shape[1]
    centred = columns - columns.mean(axis=0)
    unit = np.sqrt(np.trace(np.linalg.inv(centred.T @ centred)) / degrees) * 0.1 * np.sqrt(RATE)
    noise = drawn(WHITE, N, RATE, 4, 5)
    x = noise + unit * columns[:, :1] * np.array([0.0, 1.0, 2.5, 6.0, 40.0])
    fit = aj.fit(recording(x, RATE), model, "whittle", as_is=True)
    label = next(p.label for p in model.parameters if p.term == 1 and p.parameter.is_amplitude)
    for k, result in enumerate(fit.results):
        c, white = result[label], result["N"].value * np.sqrt(RATE)
        b = np.linalg.lstsq(centred, x[:, k] - x[:, k].mean(), rcond=None)[0]
        square = float(b @ (centred.T @ centred) @ b) / white**2
        # The mean of both variances where there are two.
        assert c.std in (0.0, pytest.approx(white * unit / (0.1 * np.sqrt(RATE)), rel=2e-3))
        for end, level in ends_of(c):
            own = max(square, chi2.ppf(0.5, degrees)) if level < 0.5 else square
            if end > 0.0:
                size = (end * 0.1 * np.sqrt(RATE) / (white * unit)) ** 2
                assert ncx2.cdf(own, degrees, size) == pytest.approx(
                    level, abs=0.06 if term == "line" else 4e-3
                )
            else:
                assert chi2.cdf(own, degrees) <= level + 1e-3
        # Its estimate is the median of that law, and zero below that of noise.
        if c.value > 0.0:
            size = (c.value * 0.1 * np.sqrt(RATE) / (white * unit)) ** 2
            assert ncx2.cdf(square, degrees, size) == pytest.approx(0.5, abs=0.06 if term == "line" else 4e-3)
        assert c.detected == (c.interval[0] > 0.0)


def test_a_line_that_was_searched_for_competes_with_all_that_noise_has():
    """The strongest line of white noise is none, though at a frequency named beforehand it would be one.

    The highest of some 256 peaks of 512 samples has a half square of ln 256 = 5.5 and more. Searched for, one
    axis in 740 has a line: two of 24 would be once in 2,000 times.
    """
    x = np.random.default_rng(8).normal(size=(512, 24))
    searched = aj.fit(recording(x, RATE), aj.AngleRandomWalk() + aj.Sinusoid(), "whittle", as_is=True)
    found = [result["sinusoid_amplitude"] for result in searched.results]
    assert sum(c.detected for c in found) <= 1
    assert sum(c.interval[0] > 0.0 for c in found) > 12
    # One of nine standard deviations is found as well as Cramér and Rao allow: σ_f = √6σ/(πAT√n).
    n, f, A = 512, 2.345, 9.0 * np.sqrt(2.0 / 512)
    wave = A * np.cos(2.0 * np.pi * f * np.arange(n) / RATE + 1.0)
    fit = aj.fit(
        recording(x[:, :4] + wave[:, None], RATE), aj.AngleRandomWalk() + aj.Sinusoid(), "whittle", as_is=True
    )
    bound = np.sqrt(6.0) / (np.pi * A * n / RATE * np.sqrt(n))
    for result in fit.results:
        place, size = result["sinusoid_frequency"], result["sinusoid_amplitude"]
        assert place.detected
        assert size.detected
        assert abs(place.value - f) < 4.0 * bound
        assert place.std == pytest.approx(bound, rel=0.4)
        assert place.interval[1] - place.value == pytest.approx(1.95996 * place.std, rel=1e-4)
        assert place.interval_68[0] - place.value == pytest.approx(-0.99446 * place.std, rel=1e-4)
        assert abs(size.value - A) < 4.0 * np.sqrt(2.0 / n)


@pytest.mark.parametrize(("time", "beyond"), [(2.0, False), (20_000.0, True)])
def test_a_correlation_time_beyond_the_record_is_above_a_limit(time, beyond):
    """What is seen of a process that lasts a hundred records is a random walk, of any longer time as well."""
    n, rate = 16_384, 100.0
    rng = np.random.default_rng(30)
    kept = np.exp(-1.0 / (rate * time))
    x = lfilter([np.sqrt(1.0 - kept**2)], [1.0, -kept], rng.standard_normal(2 * n))[n:] * np.sqrt(
        max(time, 1.0)
    )
    fit = aj.fit(
        recording(x + rng.standard_normal(n), rate), "N + markov", "whittle", as_is=True, vibrating=True
    )
    result = fit["gyro_0"]
    c, row = result["markov_correlation_time"], list(result.coefficients).index("markov_correlation_time")
    assert result.measured
    if not beyond:
        assert (c.lower_limit, c.upper_limit) == (None, None)
        # One of twenty intervals misses: four standard deviations, in logarithms.
        assert abs(np.log(c.value / time)) < 4.0 * c.std / c.value
        assert c.interval[0] < c.value < c.interval[1] < np.inf
        return
    assert np.isnan(c.std)
    assert (c.upper_limit, c.interval[1]) == (None, np.inf)
    assert c.interval[0] <= c.lower_limit < time
    spread = np.sqrt(result.covariance[row, row]) / c.value
    assert c.lower_limit == pytest.approx(c.value * np.exp(-1.64485 * spread), rel=1e-3)
    assert c.describe().startswith("above ")

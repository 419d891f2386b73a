"""Intervals, limits and what counts as detected, by their definitions."""

import numpy as np
import pytest
from dense_fits import Spectrum, drawn, fitted, recording
from scipy.optimize import brentq
from scipy.signal import lfilter
from scipy.stats import chi2, ncx2, norm

import allanjax as aj

RATE, N = 10.0, 256
WHITE, WALK = aj.AngleRandomWalk(0.1), aj.RateRandomWalk(0.06)


def ends_of(c):
    """Each end of an estimate, with the probability of smaller data if the truth were there."""
    return zip([*c.interval, *c.interval_68, c.upper_limit], (0.975, 0.025, 0.84, 0.16, 0.05), strict=True)


@pytest.mark.parametrize("n", [65, 200])
def test_white_noise_has_the_intervals_of_its_chi_square_law(n):
    """All squares together are χ² with n − 1 degrees of freedom."""
    # Between hypotheses half a standard deviation apart the score is interpolated: a tenth of one.
    x = drawn(WHITE, n, RATE, 3)[:, 0]
    result = aj.fit(recording(x, RATE), "N", "whittle", as_is=True)["gyro_0"]
    c = result["N"]
    square = np.sum((x - x.mean()) ** 2) / RATE
    assert c.value == pytest.approx(np.sqrt(square / (n - 1)), rel=1e-6)
    assert c.std == pytest.approx(c.value / np.sqrt(2.0 * (n - 1)), rel=1e-5)
    for end, level in ends_of(c):
        assert end == pytest.approx(np.sqrt(square / chi2.ppf(level, n - 1)), abs=0.1 * c.std)
    assert result.covariance == pytest.approx(c.std**2, rel=1e-9)


def test_what_has_an_amplitude_has_a_time_detected_or_not():
    """In white noise most processes that are fitted are not detected."""
    x = np.random.default_rng(1).standard_normal((4096, 12))
    found = aj.fit(recording(x, RATE), "N + markov", as_is=True).results
    present = [r["markov_amplitude"].value > 0.0 for r in found]
    assert [bool(np.isfinite(r["markov_correlation_time"].value)) for r in found] == present
    assert any(p and not r["markov_amplitude"].detected for p, r in zip(present, found, strict=True))


def test_amplitudes_have_the_limits_of_the_likelihoods_profile():
    """Scores at hypotheses and the ratio of likelihoods agree where an amplitude is known to a tenth."""
    model = WHITE + aj.RateRandomWalk(1.0)
    x = drawn(model, N, RATE, 3)[:, 0]
    result, found, labels = fitted(model, x, "whittle", RATE)
    dense = Spectrum(x, RATE, result.spectrum.bins.edges)
    for label in labels:
        for end, level in ends_of(result[label]):
            root = dense.ratio(found, label, end) * np.sign(result[label].value - end)
            assert root == pytest.approx(norm.ppf(level), abs=0.12), (label, level)
    # Covariances are those of the amplitudes themselves.
    values = list(found.values.values())
    own = np.linalg.inv(dense.information(found, labels)) * np.outer(values, values)
    np.testing.assert_allclose(result.covariance, own, rtol=0.01)


def test_a_term_that_is_absent_has_the_limit_of_its_score():
    """By the law of the score under the limit itself, of weighted Gamma variates, drawn 40,000 times."""
    # What the data want less than nothing counts as nothing: the score at zero is taken off, so that limits
    # are never too low, and the fewer levels tell of a walk the higher.
    n, told = 65, 0
    x = drawn(WHITE, n, RATE, 6, 8)
    gammas = np.random.default_rng(1).chisquare(1.0, (40_000, n - 1))
    for k, result in enumerate(aj.fit(recording(x, RATE), "N + K", "whittle", as_is=True).results):
        if (c := result["K"]).value > 0.0:
            continue
        told += 1
        assert (c.std, c.interval[0], c.interval_68[0], c.detected) == (0.0, 0.0, 0.0, False)
        dense = Spectrum(x[:, k], RATE, np.arange(1, n + 1))
        white, walk = (dense.means(t) for t in (aj.AngleRandomWalk(1.0), aj.RateRandomWalk(1.0)))

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


T = np.arange(N) / RATE
WAVE = 2.0 * np.pi * 2.345 * T
#: Columns of what a deterministic term adds, and the term.
COLUMNS = {
    "ramp": (T[:, None], aj.DriftRamp()),
    "step": (1.0 * (T >= 9.0)[:, None], aj.BiasStep(time=9.0)),
    "line": (np.stack([np.cos(WAVE), np.sin(WAVE)], 1), aj.Sinusoid(None, 2.345).hold("frequency")),
}


@pytest.mark.parametrize("name", COLUMNS)
def test_ramps_steps_and_lines_have_the_noncentral_chi_square_law(name):
    """Of the square of their estimate by regression, from nothing to 40 standard deviations of amplitude."""
    # Upper ends never rest on less than the median of pure noise; far from zero a normal law stands for the
    # noncentral one, to 2·10⁻⁴ of probability. A line is known by the coefficients about it: 6 % of that.
    columns, term = COLUMNS[name]
    degrees, within = columns.shape[1], 0.06 if name == "line" else 4e-3
    centred = columns - columns.mean(axis=0)
    # Deviation of an amplitude under unit noise; the mean of both variances where there are two.
    unit = np.sqrt(np.trace(np.linalg.inv(centred.T @ centred)) / degrees)
    sizes = 0.1 * np.sqrt(RATE) * unit * np.array([0.0, 1.0, 2.5, 6.0, 40.0])
    x = drawn(WHITE, N, RATE, 4, 5) + columns[:, :1] * sizes
    label = next(p.label for p in aj.Model((term,)).parameters if p.parameter.is_amplitude)
    fit = aj.fit(recording(x, RATE), aj.AngleRandomWalk() + term, "whittle", as_is=True)
    for k, result in enumerate(fit.results):
        c, std = result[label], result["N"].value * np.sqrt(RATE) * unit
        fitted_line = centred @ np.linalg.lstsq(centred, x[:, k] - x[:, k].mean(), rcond=None)[0]
        square = np.sum(fitted_line**2) * (unit / std) ** 2
        assert c.std in (0.0, pytest.approx(std, rel=2e-3))
        for end, level in ends_of(c):
            own = max(square, chi2.ppf(0.5, degrees)) if level < 0.5 else square
            if end > 0.0:
                assert ncx2.cdf(own, degrees, (end / std) ** 2) == pytest.approx(level, abs=within)
            else:
                assert chi2.cdf(own, degrees) <= level + 1e-3
        # Its estimate is the median of that law, and zero below that of noise.
        if c.value > 0.0:
            assert ncx2.cdf(square, degrees, (c.value / std) ** 2) == pytest.approx(0.5, abs=within)
        assert c.detected == (c.interval[0] > 0.0)


def test_a_line_that_was_searched_for_competes_with_all_that_noise_has():
    """The strongest line of white noise is none, though at a frequency named beforehand it would be one."""
    # The highest of some 256 peaks of 512 samples has a half square of ln 256 = 5.5 and more. Searched for,
    # one axis in 740 has a line: two of 24 would be once in 2,000 times.
    n, f, A, model = 512, 2.345, 9.0 * np.sqrt(2.0 / 512), aj.AngleRandomWalk() + aj.Sinusoid()
    x = np.random.default_rng(8).normal(size=(n, 24))
    searched = aj.fit(recording(x, RATE), model, "whittle", as_is=True)
    found = [result["sinusoid_amplitude"] for result in searched.results]
    assert sum(c.detected for c in found) <= 1
    assert sum(c.interval[0] > 0.0 for c in found) > 12
    # One of nine standard deviations is found as well as Cramér and Rao allow: σ_f = √6σ/(πAT√n).
    wave = A * np.cos(2.0 * np.pi * f * np.arange(n) / RATE + 1.0)
    fit = aj.fit(recording(x[:, :4] + wave[:, None], RATE), model, "whittle", as_is=True)
    bound = np.sqrt(6.0) / (np.pi * A * n / RATE * np.sqrt(n))
    for result in fit.results:
        place, size = result["sinusoid_frequency"], result["sinusoid_amplitude"]
        assert (place.detected, size.detected) == (True, True)
        assert abs(place.value - f) < 4.0 * bound
        assert place.std == pytest.approx(bound, rel=0.4)
        assert place.interval[1] - place.value == pytest.approx(1.95996 * place.std, rel=1e-4)
        assert place.interval_68[0] - place.value == pytest.approx(-0.99446 * place.std, rel=1e-4)
        assert abs(size.value - A) < 4.0 * np.sqrt(2.0 / n)


@pytest.mark.parametrize(("time", "beyond"), [(2.0, False), (20_000.0, True)])
def test_a_correlation_time_beyond_the_record_is_above_a_limit(time, beyond):
    """What is seen of a process that lasts a hundred records is a random walk, of any longer time as well."""
    n, rate, rng = 16_384, 100.0, np.random.default_rng(30)
    kept = np.exp(-1.0 / (rate * time))
    x = lfilter([np.sqrt(1.0 - kept**2)], [1.0, -kept], rng.standard_normal(2 * n))[n:]
    x = np.sqrt(max(time, 1.0)) * x + rng.standard_normal(n)
    (result,) = aj.fit(recording(x, rate), "N + markov", "whittle", as_is=True, vibrating=True).results
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
    assert c.describe().startswith("> ")

"""Lines, ramps and regressors: their columns, where lines are found, and what taking them out leaves."""

import dataclasses

import numpy as np
import pytest
from scipy.fft import dct
from scipy.stats import chi2, ncx2

from allanjax.estimate.coefficients import deterministic_coefficients
from allanjax.estimate.deterministic import AxisSpectrum, amplitude_quantile, line_columns, take_out_lines
from allanjax.noise.terms import AngleRandomWalk, Sinusoid
from allanjax.record.recording import Axis
from allanjax.spectrum.cosine import Bins, cosine_transform, ramp_column

RATE = 100.0
GYRO = Axis("gyro_x", "gyro", "rad/s")
# Once in 16,000.
K_SIGMA = 4.0

# --- Columns ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("n", [50, 333])
@pytest.mark.parametrize("steps", [0.2, 1.0, 3.7, 20.0, 21.0, 48.999_999, "last", "Nyquist"])
def test_line_columns_are_the_transform_of_the_samples(n, steps):
    """At frequencies of `steps` coefficients: between them, on them (even and odd), and at the ends."""
    j = np.arange(1, n)
    f = {"last": n - 1.0, "Nyquist": float(n)}.get(steps, steps) * RATE / (2 * n)
    angle = 2.0 * np.pi * f / RATE * (np.arange(n) + 0.5)
    direct = [dct(wave, norm="ortho")[1:] for wave in (np.cos(angle), np.sin(angle))]
    np.testing.assert_allclose(line_columns(f, j, n, RATE).T, direct, atol=1e-9)


def test_a_ramp_column_is_the_transform_of_time():
    found = dct(np.arange(77) / RATE, norm="ortho")[1:]
    np.testing.assert_allclose(ramp_column(77, RATE), found, atol=1e-12)


# --- Finding lines ------------------------------------------------------------------------------------------


def wave(f, amplitude, phase, n):
    return amplitude * np.cos(2.0 * np.pi * f * np.arange(n) / RATE + phase)


def frequency_bound(amplitude, n, sigma=1.0):
    """Cramér and Rao's bound for one line in white noise.

    With x_k = A cos(2πf t_k + φ), time from the middle, the information of f is Σ (2πt_k A sin)²/σ², the
    mean of sin² ½ and that of t² T²/12: 1/σ_f² = (2πA)²·n·T²/(24σ²), so that σ_f = √6 σ/(πAT√n). That of A is
    n/(2σ²).
    """
    return np.sqrt(6.0) * sigma / (np.pi * amplitude * n / RATE * np.sqrt(n))


def check_lines(found, truth, n):
    for line, (f, amplitude) in zip(found, truth, strict=True):
        bound = frequency_bound(amplitude, n)
        assert abs(line.frequency - f) < K_SIGMA * bound
        assert abs(line.amplitude - amplitude) < K_SIGMA * np.sqrt(2.0 / n)
        # The noise level is that of 1,000 coefficients; neighbours' remains raise it a little.
        assert line.frequency_std == pytest.approx(bound, rel=0.15)
        assert line.amplitude_std == pytest.approx(np.sqrt(2.0 / n), rel=0.1)


@pytest.mark.parametrize(
    ("amplitudes", "seed"), [((0.3, 0.2), 0), ((1.0, 0.9), 1), ((1.0, 0.9), 2), ((0.2, 0.4), 3)]
)
@pytest.mark.parametrize("apart", [5.0, 5.37])
def test_two_lines_five_fourier_bins_apart_are_told_apart(amplitudes, seed, apart):
    n, random = 4096, np.random.default_rng(seed)
    first = random.uniform(5.0, 40.0)
    truth = [(first, amplitudes[0]), (first + apart * RATE / n, amplitudes[1])]
    x = random.normal(size=n) + sum(wave(f, A, random.uniform(0.0, 2.0 * np.pi), n) for f, A in truth)
    _, lines = take_out_lines(x - x.mean(), RATE, [(None, False), (None, False)])
    check_lines(sorted(lines, key=lambda line: line.frequency), truth, n)


@pytest.mark.parametrize("n", [1000, 2000, 4096])
def test_a_line_of_a_dozen_standard_errors_is_found_anywhere(n):
    amplitude = 18.0 / np.sqrt(n)
    for seed in range(6):  # 18/√2 = 12.7 standard errors, eighty nats
        random = np.random.default_rng(seed)
        f = random.uniform(1.0, 49.0)
        x = random.normal(size=n) + wave(f, amplitude, random.uniform(0.0, 2.0 * np.pi), n)
        _, (line,) = take_out_lines(x - x.mean(), RATE, [(None, False)])
        assert abs(line.frequency - f) < K_SIGMA * frequency_bound(amplitude, n)


@pytest.mark.parametrize(("n", "seed"), [(2000, 25), (4096, 15), (4096, 19), (8192, 21)])
def test_a_strong_line_is_found_anywhere(n, seed):
    random = np.random.default_rng(seed)
    f = random.uniform(1.0, 45.0)
    x = wave(f, 10.0, random.uniform(0.0, 6.28), n) + random.normal(size=n)
    _, (line,) = take_out_lines(x - x.mean(), RATE, [(None, False)])
    assert abs(line.frequency - f) < K_SIGMA * frequency_bound(10.0, n)


def test_a_held_frequency_stays_and_a_start_moves():
    n, random = 4096, np.random.default_rng(5)
    x = random.normal(size=n) + wave(12.3, 0.5, 1.0, n) + wave(31.0, 0.4, 2.0, n)
    for wanted in ([(31.02, False), (12.3, True)], [(None, False), (12.3, True)]):
        _, (searched, held) = take_out_lines(x - x.mean(), RATE, wanted)
        assert (held.frequency, held.frequency_std) == (12.3, 0.0)
        assert abs(held.amplitude - 0.5) < K_SIGMA * np.sqrt(2.0 / n)
        assert abs(searched.frequency - 31.0) < K_SIGMA * frequency_bound(0.4, n)


def test_what_is_left_is_the_noise():
    """Outside the lines' neighbourhood nothing of them; inside, the coefficients still have their own
    line.
    """
    n, random = 4096, np.random.default_rng(6)
    noise = random.normal(size=n)
    c, (line,) = take_out_lines(noise + wave(20.0, 3.0, 0.4, n), RATE, [(None, False)])
    clean, whole = cosine_transform(noise), cosine_transform(noise + wave(20.0, 3.0, 0.4, n))
    far = np.setdiff1d(np.arange(1, n), line.indices) - 1
    assert len(line.indices) == 129
    # A line's tail falls as 1/distance: what its estimate errs by (1 part in 130) has a 130th of a part
    # there.
    np.testing.assert_allclose(c[far], clean[far], atol=0.05)
    np.testing.assert_allclose(c[line.indices - 1], whole[line.indices - 1], atol=1e-9)
    np.testing.assert_array_equal(c[line.indices - 1], line.coefficients)
    plain, none = take_out_lines(noise, RATE, [])
    np.testing.assert_allclose(plain, clean, atol=1e-12)
    assert none == ()


# --- Projection ---------------------------------------------------------------------------------------------


def spectrum_with_columns():
    n, random = 600, np.random.default_rng(7)
    bins = Bins.of(n, RATE, [(20.0, 0.0)])
    temperature = np.cumsum(random.normal(size=n))
    x = random.normal(size=n) + 0.1 * np.cumsum(random.normal(size=n)) + wave(20.0, 2.0, 0.3, n)
    x += 0.4 * temperature + 1.5 * np.arange(n) / RATE
    c, lines = take_out_lines(x - x.mean(), RATE, [(20.0, False)])
    columns = [("temperature", cosine_transform(temperature)), (1, ramp_column(n, RATE))]
    spectrum = AxisSpectrum.of(bins, c, columns, {2: lines[0]})
    whole = np.zeros((n - 1, 2))
    whole[lines[0].indices - 1] = line_columns(lines[0].frequency, lines[0].indices, n, RATE)
    return spectrum, c, np.column_stack([*(column for _, column in columns), whole])


@pytest.mark.parametrize("absent", [(), (1,), (2,), (1, 2)])
def test_projection_is_weighted_least_squares(absent):
    """Against numpy's lstsq on all whitened coefficients, and dof against the leverage of its hat matrix."""
    spectrum, c, D = spectrum_with_columns()
    bins, real = spectrum.bins, spectrum.bins.size > 0
    assert spectrum.owners == ("temperature", 1, 2, 2)
    used = spectrum.used(absent)
    np.testing.assert_array_equal(used, [True, 1 not in absent, 2 not in absent, 2 not in absent])
    variance = 1.0 + 50.0 / np.maximum(bins.edges[:-1], 1.0)
    found = spectrum.project(variance, used)

    of_coefficient = np.repeat(variance[real], bins.size[real])
    A, b = D[:, used] / np.sqrt(of_coefficient)[:, None], c / np.sqrt(of_coefficient)
    beta = np.linalg.lstsq(A, b, rcond=None)[0]
    rss = (b - A @ beta) ** 2 * of_coefficient
    leverage = np.sum(np.linalg.qr(A)[0] ** 2, axis=1)
    starts = bins.edges[:-1][real] - 1
    np.testing.assert_allclose(found.amplitude[used], beta, rtol=1e-8)
    assert not found.amplitude[~used].any()
    np.testing.assert_allclose(found.covariance[np.ix_(used, used)], np.linalg.inv(A.T @ A), rtol=1e-8)
    dof = np.add.reduceat(1.0 - leverage, starts)
    dof[dof < 1e-3] = 0.0  # where nothing is left to know a level from
    np.testing.assert_allclose(found.dof[real], dof, atol=1e-9)
    assert found.dof.sum() == pytest.approx(len(c) - used.sum(), abs=1e-3)
    known = dof > 0.0
    assert (~known).sum() <= 1
    rss = np.add.reduceat(rss, starts)
    np.testing.assert_allclose((found.level * found.dof)[real][known], rss[known], rtol=1e-6)


def test_a_bin_without_freedom_counts_for_nothing():
    bins = Bins.of(200, RATE)
    c = np.random.default_rng(8).normal(size=199)
    only_first = np.zeros(199)
    only_first[0] = 3.0
    spectrum = AxisSpectrum.of(bins, c, [("a", only_first)], {})
    found = spectrum.project(np.full(len(bins.edges[:-1]), 2.0), spectrum.used())
    assert found.amplitude[0] == pytest.approx(c[0] / 3.0)
    assert found.covariance[0, 0] == pytest.approx(2.0 / 9.0)
    assert (found.dof[0], found.level[0]) == (0.0, 2.0)
    np.testing.assert_allclose(found.dof[1:], bins.size[1:])


def test_a_line_that_was_searched_for_competes_with_all_that_noise_has():
    """The strongest line of white noise is none, though at a frequency named beforehand it would be one.

    Of 40 records the highest of some 256 peaks has a half square of ln 256 = 5.5 and more: one alone is as
    high with a probability of 0.4 % and less, and most of these are taken for lines. Searched for, one record
    in 740 has a line.
    """
    n, random = 512, np.random.default_rng(8)
    model = AngleRandomWalk() + Sinusoid()
    searched, named = 0, 0
    for _ in range(40):
        x = random.normal(size=n)
        _, (line,) = take_out_lines(x - x.mean(), RATE, [(None, False)])
        square = (line.amplitude / line.amplitude_std) ** 2
        known = dataclasses.replace(line, frequency_std=0.0)
        for found, counts in ((line, True), (known, False)):
            c = deterministic_coefficients(model, 1, GYRO, square, line.amplitude_std, 2, found, n)
            searched += counts and c["sinusoid_amplitude"].detected
            named += not counts and c["sinusoid_amplitude"].detected
    assert searched <= 1
    assert named > 20


# --- The law of an amplitude --------------------------------------------------------------------------------

DRAWS = 20_000
SQUARES = np.linspace(0.0, 12.0, 121) ** 2


@pytest.fixture(scope="module", params=[1, 2])
def limits(request):
    """Degrees, and limits at four probabilities as functions of the root of the square, on a fine grid."""
    degrees = request.param
    return degrees, {
        p: [amplitude_quantile(float(s), degrees, p) for s in SQUARES] for p in (0.975, 0.95, 0.05, 0.025)
    }


@pytest.mark.parametrize("amplitude", [0.7, 2.5, 6.0])
def test_limits_cover_by_simulation(limits, amplitude):
    """Within 4 binomial standard errors; where upper limits are raised to noise's median, they may cover
    more.
    """
    degrees, at = limits
    components = np.random.default_rng(9).normal(size=(DRAWS, degrees))
    components[:, 0] += amplitude
    root = np.linalg.norm(components, axis=1)

    def limit(p):
        return np.interp(root, np.sqrt(SQUARES), at[p])

    for p in (0.975, 0.95):
        below = np.mean(limit(p) <= amplitude)
        assert below == pytest.approx(p, abs=K_SIGMA * np.sqrt(p * (1.0 - p) / DRAWS))
    for p in (0.05, 0.025):
        above = np.mean(limit(p) >= amplitude)
        margin = K_SIGMA * np.sqrt(p * (1.0 - p) / DRAWS)
        assert above > 1.0 - p - margin
        if amplitude > 4.0:
            assert above < 1.0 - p + margin


@pytest.mark.parametrize("degrees", [1, 2])
def test_noise_alone_has_a_lower_limit_above_zero_as_often_as_it_says(degrees):
    threshold = float(chi2.ppf(0.975, degrees))
    assert amplitude_quantile(0.999 * threshold, degrees, 0.975) == 0.0
    assert amplitude_quantile(1.001 * threshold, degrees, 0.975) > 0.0


def test_upper_limits_never_shrink_below_that_of_median_noise(limits):
    degrees, at = limits
    median = chi2.ppf(0.5, degrees)
    for p in (0.05, 0.025):
        floor = at[p][0]
        assert min(at[p]) == floor
        # The limit inverts the noncentral law at the median.
        assert ncx2.cdf(median, degrees, floor**2) == pytest.approx(p, rel=1e-6)
    assert (np.diff([at[p] for p in at], axis=1) >= 0.0).all()


@pytest.mark.parametrize("degrees", [1, 2])
@pytest.mark.parametrize("square", [399.0, 401.0, 1000.0, 1e4])
def test_far_from_zero_too_it_inverts_the_noncentral_law(degrees, square):
    for p in (0.025, 0.16, 0.5, 0.84, 0.975):
        found = amplitude_quantile(square, degrees, float(p))
        assert ncx2.cdf(square, degrees, found**2) == pytest.approx(p, abs=2e-4)

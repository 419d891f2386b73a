"""The cosine spectrum's expectations against dense covariance matrices, and its bins."""

import functools

import jax.numpy as jnp
import mpmath as mp
import numpy as np
import pytest
from scipy.fft import dct
from scipy.linalg import toeplitz
from scipy.special import sici

import allanjax as aj
from allanjax.base.chi_squared import exact_cube_root_score
from allanjax.estimate.spectral.columns import columns_of
from allanjax.spectrum.cosine import Bins, cosine_transform

RATE = 4.0
SINGLE = 64


class HalfFlicker(aj.NoiseTerm):
    """S(f) ∝ f^(−1/2), a term without any closed form in the package."""

    coefficient: float | None = aj.parameter("H", time_exponent=0.25)

    def phase_covariance(self, lag):
        return -(self.coefficient**2) * jnp.where(lag > 0.0, lag, 1.0) ** 1.5 * (lag > 0.0)


def of_interval_means(G):
    """Autocovariance of means over sample intervals: −δ²G/h² (generalized, for filters that sum to zero)."""

    def autocovariance(n):
        g = G(np.arange(n + 1) / RATE)
        g = np.append(g[1], g)
        return -(g[2:] - 2.0 * g[1:-1] + g[:-2]) * RATE**2

    return autocovariance


def markov(T_c):
    """Means over an interval x correlation times long: σ²·2(x − 1 + e^−x)/x², then σ²·((1 − e^−x)/x)²
    e^−x(d−1).
    """
    x = 1.0 / (RATE * T_c)
    at_zero = float(2 * (mp.mpf(x) + mp.expm1(-mp.mpf(x))) / mp.mpf(x) ** 2)

    def autocovariance(n):
        later = (np.expm1(-x) / x) ** 2 * np.exp(-x * np.arange(n - 1))
        return T_c / 2.0 * np.append(at_zero, later)

    return autocovariance


def flicker(t):
    positive = np.where(t > 0.0, t, 1.0)
    return positive**2 * np.log(positive) / (2.0 * np.pi)


def flicker_up_to(f0):
    def G(t):  # noqa: N802
        x = np.where(t > 0.0, 2.0 * np.pi * f0 * t, 1.0)
        cin = np.euler_gamma + np.log(x) - sici(x)[1]
        shape = 0.5 - np.cos(x) / 2.0 + x * np.sin(x) / 2.0 + x**2 * cin / 2.0
        return np.where(t > 0.0, shape, 0.0) / np.pi / (2.0 * np.pi * f0) ** 2

    return of_interval_means(G)


def resonance(f0, Q_f):
    def autocovariance(n):
        t, w0 = np.arange(n) / RATE, 2.0 * np.pi * f0
        a = w0 / (2.0 * Q_f)
        wd = np.sqrt(w0**2 - a**2)
        return np.exp(-a * t) * (np.cos(wd * t) + a / wd * np.sin(wd * t))

    return autocovariance


# The term, its autocovariance, and the tolerance in bins: there the record is taken to be long compared
# with a
# period, which costs flicker 0.3 % in the first of them and Markov noise up to 0.5 %. (The end effect of
# quantization is there.) Two nodes a bin are right to the fourth power of its width: 10⁻⁵ of what falls or
# rises
# with the square of the frequency.
CASES = {
    "quantization": (aj.Quantization(1.0), of_interval_means(lambda t: 1.0 * (t == 0.0)), 2e-5),
    "angle random walk": (aj.AngleRandomWalk(1.0), of_interval_means(lambda t: -t / 2.0), 1e-10),
    "bias instability": (aj.BiasInstability(1.0), of_interval_means(flicker), 5e-3),
    "rate random walk": (aj.RateRandomWalk(1.0), of_interval_means(lambda t: t**3 / 12.0), 2e-5),
    "half flicker": (HalfFlicker(1.0), of_interval_means(lambda t: -(t**1.5)), 5e-3),
    **{
        f"markov {T_c:g} s": (aj.Markov(1.0, T_c), markov(T_c), 6e-3)
        for T_c in (0.03, 1.0, 8.0, 60.0, 250.0, 5e3)
    },
}


@functools.cache
def dense(name, n):
    """Covariance of the coefficients c_1 … c_{n−1}."""
    V = toeplitz(CASES[name][1](n))
    return dct(dct(V, norm="ortho", axis=0), norm="ortho", axis=1)[1:, 1:]


def expected(bins, term):
    """Mean expected square of the coefficients in each bin, of a term with its amplitude."""
    amplitude = getattr(term, term.amplitude_parameter().name)
    return amplitude**2 * columns_of([term], bins)[0].mean(axis=0)


CHECKED = [(name, 1000) for name in CASES] + [(name, 65) for name in CASES if name != "half flicker"]


@pytest.mark.parametrize(("name", "n"), CHECKED)
def test_expected_squares_are_those_of_the_dense_covariance(name, n):
    term, _, in_bins = CASES[name]
    bins = Bins.of(n, RATE)
    squares = np.diag(dense(name, n))
    exact = bins.sums(squares) / bins.size
    found = expected(bins, term)
    np.testing.assert_allclose(found[:SINGLE], exact[:SINGLE], rtol=1e-6)
    np.testing.assert_allclose(found[SINGLE:], exact[SINGLE:], rtol=in_bins)


@pytest.mark.parametrize(("f0", "Q_f"), [(0.8, 12.0), (0.1, 3.0), (1.5, 40.0)])
def test_a_resonance_is_right_around_its_line(f0, Q_f):
    """What the record's ends cut off is 1/(its lifetimes in the record), 4 to 9 % here; all its power is
    there.
    """
    n = 1000
    bins = Bins.of(n, RATE, [(f0, 0.0)])
    V = toeplitz(resonance(f0, Q_f)(n))
    squares = np.diag(dct(dct(V, norm="ortho", axis=0), norm="ortho", axis=1))[1:]
    found = expected(bins, aj.Resonance(1.0, f0, Q_f))
    exact = bins.sums(squares) / bins.size
    strong = exact > 0.05 * exact.max()
    np.testing.assert_allclose(found[strong], exact[strong], rtol=2.0 * Q_f / (np.pi * f0 * n / RATE))
    assert found @ bins.size == pytest.approx(squares.sum(), rel=5e-3)


def squares_with_cutoff(f0, n=1000):
    V = toeplitz(flicker_up_to(f0)(n))
    return np.diag(dct(dct(V, norm="ortho", axis=0), norm="ortho", axis=1))[1:]


@pytest.mark.parametrize("f0", [0.4, 3.0])
def test_flicker_with_a_cutoff_is_right_below_it(f0):
    """The first ten coefficients are another test's; an edge leaks into its neighbours."""
    bins = Bins.of(1000, RATE)
    below = (bins.edges[:-1] > 10) & (bins.frequency + bins.size * RATE / 4000 < 0.8 * f0)
    exact = (bins.sums(squares_with_cutoff(f0)) / bins.size)[below]
    np.testing.assert_allclose(expected(bins, aj.BiasInstability(1.0, f0))[below], exact, rtol=0.02)


def test_flicker_with_a_cutoff_is_exact_at_the_lowest_frequencies_too():
    bins = Bins.of(1000, RATE)
    found = expected(bins, aj.BiasInstability(1.0, 0.8))[:5]
    np.testing.assert_allclose(found, squares_with_cutoff(0.8)[:5], rtol=0.01)


@pytest.mark.parametrize("name", [name for name in CASES if name not in ("quantization",)])
def test_coefficients_hardly_correlate(name):
    """Squared correlations: of any pair below 4 %, of one with all others below 9 %, and 0.2 % from the
    60th on.
    """
    C = dense(name, 1000)
    squares = C**2 / np.outer(np.diag(C), np.diag(C))
    np.fill_diagonal(squares, 0.0)
    assert squares.max() < 0.04
    assert squares.sum(axis=1).max() < 0.09
    if name == "markov 1 s":  # shorter than the 60th coefficient's period: its corner is higher up
        assert squares.sum(axis=1).max() < 0.004
    else:
        assert squares.sum(axis=1)[60:].max() < 0.002
    if name in ("angle random walk", "rate random walk"):
        assert squares.sum(axis=1).max() < 1e-9


# --- Bins ---------------------------------------------------------------------------------------------------

MANY_N = [4, 10, 63, 64, 65, 66, 67, 70, 75, 100, 129, 512, 1000, 4097, 12_345, 1_000_000]


def check_partition(bins, n):
    first, size = bins.edges[:-1], bins.size
    assert (np.diff(first) > 0).all()
    assert first[0] == 1
    np.testing.assert_array_equal(first[1:], (first + size)[:-1])
    assert first[-1] + size[-1] == n
    top = min(SINGLE, n - 1)
    np.testing.assert_array_equal(size[:top], 1)


@pytest.mark.parametrize("n", MANY_N)
def test_bins_hold_every_coefficient_once(n):
    check_partition(Bins.of(n, RATE), n)


@pytest.mark.parametrize("n", [66, 100, 700, 4096, 100_003])
def test_bins_around_lines_do_too(n):
    random = np.random.default_rng(n)
    spacing = RATE / (2 * n)
    anywhere = [
        (f,) for f in (0.1 * spacing, spacing, 64.5 * spacing, RATE / 4, RATE / 2 - spacing, RATE / 2)
    ]
    anywhere += [tuple(random.uniform(spacing, RATE / 2.0, count)) for count in (1, 2) for _ in range(20)]
    for around in [*anywhere, (0.5, 0.5), (0.5, 0.5 + spacing)]:
        bins = Bins.of(n, RATE, [(f, 0.0) for f in around])
        check_partition(bins, n)
        first = bins.edges[:-1]
        for f in around:
            # The twelve coefficients on both sides of a line are single.
            j = round(2 * n * f / RATE)
            near = (first > max(j - 12, 0)) & (first < min(j + 12, n))
            assert (bins.size[near] == 1).all()


@pytest.mark.parametrize("width", [0.01, 0.1])
def test_bins_around_a_resonance_resolve_its_width_and_grow_away_from_it(width):
    """An eighth of the width at the peak; never wider than the logarithmic bins; fewer than of a line."""
    n, f0 = 200_000, 1.0
    bins = Bins.of(n, RATE, [(f0, width)])
    check_partition(bins, n)
    wide = bins.size * RATE / (2.0 * n)
    assert wide[abs(bins.frequency - f0) < width].max() < 1.1 * width / 8.0 + RATE / (2.0 * n)
    assert np.all(wide[64:] < 1.05 * (2.0 ** (1.0 / 6.0) - 1.0) * bins.frequency[64:] + RATE / n)
    assert len(bins.size) < len(Bins.of(n, RATE, [(f0, 0.0)]).size) - 10


def test_frequencies_are_the_middles():
    bins = Bins.of(1000, RATE)
    for k, (first, size) in enumerate(zip(bins.edges, bins.size, strict=False)):
        assert bins.frequency[k] == pytest.approx(np.mean(np.arange(first, first + size)) * RATE / 2000.0)


@pytest.mark.parametrize("columns", [(), (3,), (2, 2)])
def test_sums_are_over_each_bin(columns):
    n = 500
    products = np.random.default_rng(0).normal(size=(n - 1, *columns))
    bins = Bins.of(n, RATE, [(1.1, 0.0)])
    found = bins.sums(products)
    for k, (first, size) in enumerate(zip(bins.edges[:-1], bins.size, strict=True)):
        expected = sum((products[j - 1] for j in range(first, first + size)), np.zeros(columns))
        np.testing.assert_allclose(found[k], expected, atol=1e-12)


# --- The transform and its scores ---------------------------------------------------------------------------


def test_coefficients_are_the_sums_of_the_docstring_without_the_bias():
    n = 97
    x = np.random.default_rng(1).normal(size=(n, 2))
    k = np.arange(n) + 0.5
    direct = [np.sqrt(2.0 / n) * np.cos(np.pi * j / n * k) @ x for j in range(1, n)]
    np.testing.assert_allclose(cosine_transform(x), direct, atol=1e-12)
    np.testing.assert_allclose(cosine_transform(x + 123.0), cosine_transform(x), atol=1e-10)
    np.testing.assert_allclose(np.sum(cosine_transform(x) ** 2, axis=0), n * np.var(x, axis=0))


@pytest.mark.parametrize("dof", [1.0, 2.0, 7.0, 100.0, 3000.0])
def test_scores_are_standardized(dof):
    """Mean 0 and variance 1 by simulation, within 4 standard errors (of a nearly normal law)."""
    draws = 200_000
    ratio = np.random.default_rng(2).chisquare(dof, draws) / dof
    z = np.asarray(exact_cube_root_score(ratio, dof))
    assert abs(z.mean()) < 4.0 / np.sqrt(draws)
    assert abs(z.var() - 1.0) < 4.0 * np.sqrt(2.0 / draws)

"""Expected squares of the cosine coefficients of noise terms against dense covariance matrices, once.

Fits by Whittle's likelihood rest on them; no public number is the expectation of one term alone.
"""

import dense
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.fft import dct

import allanjax as aj
from allanjax.estimate.spectral.components import columns_of
from allanjax.spectrum.cosine import Bins

RATE = 4.0
SINGLE = 64
# The term, and the tolerance in bins, where the record is taken to be long compared with a period: that costs
# flicker 0.3 % in the first of them and Markov noise up to 0.5 %. Two nodes a bin are right to the fourth
# power of its width.
CASES = {
    "quantization": (aj.Quantization(1.0), 2e-5), "white": (aj.AngleRandomWalk(1.0), 1e-10),
    "flicker": (aj.BiasInstability(1.0), 5e-3), "walk": (aj.RateRandomWalk(1.0), 2e-5),
    "fast markov": (aj.Markov(1.0, 0.06), 6e-3), "markov": (aj.Markov(1.0, 8.0), 6e-3),
    "slow markov": (aj.Markov(1.0, 250.0), 6e-3),
}  # fmt: skip


def squares(term, n: int) -> np.ndarray:
    """Variances of the coefficients c_1 … c_{n−1}."""
    V = dense.covariance(term, n, RATE)
    return np.diag(dct(dct(V, norm="ortho", axis=0), norm="ortho", axis=1))[1:]


def expected(bins: Bins, term) -> np.ndarray:
    """Mean expected square of the coefficients in each bin, of a term with its amplitude."""
    amplitude = getattr(term, term.amplitude_parameter().name)
    return amplitude**2 * columns_of([term], bins)[0].mean(axis=0)


@pytest.mark.parametrize("name", CASES)
def test_expected_squares_are_those_of_the_dense_covariance(name):
    term, in_bins = CASES[name]
    for n in (65, 1000):
        bins = Bins.of(n, RATE)
        found, exact = expected(bins, term), bins.sums(squares(term, n)) / bins.size
        assert_allclose(found[:SINGLE], exact[:SINGLE], rtol=1e-6)
        assert_allclose(found[SINGLE:], exact[SINGLE:], rtol=in_bins)


def test_expected_squares_of_what_has_an_edge_or_a_line():
    """Flicker noise with a cutoff: exact at the lowest frequencies, up to the cutoff but for what leaks.

    Resonances around their line: what the record's ends cut off is 1/(its lifetimes in the record), 4 to 9 %;
    all their power is there.
    """
    n = 1000
    for f0 in (0.4, 3.0):
        term, bins = aj.BiasInstability(1.0, f0), Bins.of(n, RATE)
        found, exact = expected(bins, term), bins.sums(squares(term, n)) / bins.size
        below = bins.frequency + bins.size * RATE / (4.0 * n) < 0.8 * f0
        assert_allclose(found[below], exact[below], rtol=0.02)
        assert_allclose(found[:5], exact[:5], rtol=0.01)
    for f0, Q_f in ((0.8, 12.0), (0.1, 3.0), (1.5, 40.0)):
        term, bins = aj.Resonance(1.0, f0, Q_f), Bins.of(n, RATE, [(f0, 0.0)])
        found, exact = expected(bins, term), bins.sums(squares(term, n)) / bins.size
        strong = exact > 0.05 * exact.max()
        assert_allclose(found[strong], exact[strong], rtol=2.0 * Q_f / (np.pi * f0 * n / RATE))
        assert found @ bins.size == pytest.approx(exact @ bins.size, rel=5e-3)


def test_bins_hold_every_coefficient_once():
    """Single ones up to 64, twelve on either side of a line, then six bins an octave."""
    for n in (4, 63, 64, 65, 66, 100, 1000, 12_345):
        spacing = RATE / (2 * n)
        for around in ([], [0.1 * spacing], [64.5 * spacing, 1.1], [RATE / 2.0 - spacing]):
            bins = Bins.of(n, RATE, [(f, 0.0) for f in around])
            assert (bins.edges[0], bins.edges[-1]) == (1, n)
            np.testing.assert_array_equal(bins.size, np.diff(bins.edges))
            first = bins.edges[:-1]
            assert_allclose(bins.frequency, (first + (bins.size - 1) / 2.0) * spacing)
            single = first <= min(SINGLE, n - 1)
            for j in np.round(np.array(around) / spacing):
                single |= (first > max(j - 12, 0)) & (first < min(j + 12, n))
            assert (bins.size[single] == 1).all()
            wide = bins.size[SINGLE:] * spacing
            assert np.all(wide < 1.05 * (2.0 ** (1.0 / 6.0) - 1.0) * bins.frequency[SINGLE:] + 2.0 * spacing)

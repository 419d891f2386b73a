"""The solver."""

import numpy as np
from scipy.stats import chi2

import allanjax as aj
from allanjax.estimate.gls import solve
from allanjax.estimate.spectral_design import SpectralDesign
from allanjax.spectrum.cosine import CosineBins


def test_a_model_is_incomplete_beyond_all_doubt_only():
    """Levels that depart from white noise by more and more: from p = 10⁻⁶ on, and not before.

    The solver's limit is Wilson and Hilferty's, good to a factor of two of p out there.
    """
    bins = CosineBins.of(500, 4.0)
    design = SpectralDesign.of(aj.Model((aj.AngleRandomWalk(),)), bins, bins.size.astype(float))
    m = len(bins.size)
    ripple = np.where(np.arange(m) % 2, 1.0, -1.0)
    V = np.exp(np.linspace(0.6, 1.8, 60)[:, None] * ripple)
    ones = np.ones((len(V), 1))
    found = solve(design, V, np.ones(1, bool), ones > 0.0, 0.25 * ones, np.zeros((len(V), 0)))
    assert np.all(found.converged)
    p = chi2.sf(found.chi2, np.sum(bins.size > 0) - 1)
    clear = abs(np.log(p / 1e-6)) > np.log(2.0)
    assert np.sum((p < 1e-2) & (p > 1e-6)) > 3
    np.testing.assert_array_equal((found.discrepancy > 0.0)[clear], (p < 1e-6)[clear])

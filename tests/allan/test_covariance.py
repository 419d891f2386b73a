"""Covariance and degrees of freedom of Allan variances under a noise model, by dense matrices.

Wavelet variances of the Haar wavelet are half the overlapping Allan variances; their covariance is public.
"""

import numpy as np
import pytest
from dense_fits import Variances
from numpy.testing import assert_allclose

import allanjax as aj

RATE = 4.0


def model_of(
    quantization=1e-9, white=1e-9, flicker=1e-9, walk=1e-9, markov=1e-9, T_c=1.0, ramp=1e-12
) -> aj.Model:
    """One structure for all cases, compiled once: what a case leaves out is there with next to nothing."""
    model = aj.Quantization(quantization) + aj.AngleRandomWalk(white) + aj.BiasInstability(flicker)
    return model + aj.RateRandomWalk(walk) + aj.Markov(markov, T_c) + aj.DriftRamp(ramp)


# Tolerance relative to the variances: between kinks polynomials are summed exactly, the others nearly.
CASES = {
    "quantization": (model_of(quantization=1.0), 1e-8),
    "white": (model_of(white=1.0), 1e-8),
    "walk": (model_of(walk=1.0), 1e-7),
    "flicker": (model_of(flicker=1.3), 1e-3),
    "all powers": (model_of(quantization=0.5, white=1.0, walk=0.1), 1e-7),
    "white and ramp": (model_of(white=1.0, ramp=0.05), 1e-7),
    "walk and ramp": (model_of(walk=1.0, ramp=0.05), 1e-7),
    "short markov": (model_of(markov=1.0, T_c=0.6), 1e-3),
    "long markov": (model_of(white=1.0, markov=1.0, T_c=15.0), 1e-3),
}


@pytest.mark.parametrize("name", CASES)
def test_covariance_is_the_sum_over_all_pairs_of_differences(name):
    """A ramp is the same in every record."""
    model, tolerance = CASES[name]
    for n in (16, 17, 300):
        x = np.random.default_rng(n).normal(size=n)
        found = aj.wavelet_variance(x, RATE, model=model)
        sizes = (found.scale * RATE).astype(int)
        np.testing.assert_array_equal(sizes, 2 ** np.arange(len(sizes)))
        dense = Variances.of_allan(x, RATE, sizes)
        mean, C = dense.moments(model)
        C -= dense.moments(model.terms[-1])[1]
        scale = np.sqrt(np.outer(np.diag(C), np.diag(C)))
        assert_allclose(4.0 * found.covariance(model) / scale, C / scale, atol=tolerance)
        assert_allclose(2.0 * found.expectation(model), mean, rtol=1e-7)
        assert_allclose(found.edf[:, 0], 2.0 * mean**2 / np.diag(C), rtol=2.0 * tolerance)
    ramp = model_of(ramp=1.0)
    assert abs(found.covariance(ramp)).max() < 1e-12 * found.expectation(ramp).max()

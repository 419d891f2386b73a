"""Covariance and degrees of freedom of Allan variances under a noise model, by dense matrices.

Wavelet variances of the Haar wavelet are half the overlapping Allan variances, and their covariance is
public; fits have degrees of freedom and standard errors under their own model.
"""

import dense
import numpy as np
import pytest
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
    for n in (16, 17, 600):
        found = aj.wavelet_variance(np.random.default_rng(n).normal(size=n), RATE, model=model)
        sizes = (found.scale * RATE).astype(int)
        np.testing.assert_array_equal(sizes, 2 ** np.arange(len(sizes)))
        C, repeated = (dense.covariance(of, n, RATE) for of in (model, model.terms[-1]))
        expected = dense.allan_covariance(C[0], sizes, np.ones_like(sizes), repeated[0])
        sd = np.sqrt(np.diag(expected))
        scale = np.outer(sd, sd)
        assert_allclose(4.0 * found.covariance(model) / scale, expected / scale, atol=tolerance)
        mean = np.array([dense.allan_variance(C, m) for m in sizes])
        assert_allclose(2.0 * found.expectation(model), mean, rtol=1e-7)
        assert_allclose(found.edf[:, 0], 2.0 * mean**2 / sd**2, rtol=2.0 * tolerance)
    ramp = model_of(ramp=1.0)
    assert abs(found.covariance(ramp)).max() < 1e-12 * found.expectation(ramp).max()


@pytest.mark.parametrize("estimator", ["exact", "pyramid"])
def test_fits_have_the_errors_of_generalized_least_squares(estimator):
    """Standard errors from (J' V⁻¹ J)⁻¹, and 2·E²/V degrees of freedom, with V at the fitted model itself.

    The covariance between any two cluster sizes is in the errors, which agree to 10⁻⁴.
    """
    labels, n = ("angle_random_walk", "rate_random_walk"), 2048
    model, rng = aj.AngleRandomWalk() + aj.RateRandomWalk(), np.random.default_rng(5)
    # White noise of N = 1 and the means of a random walk of K = 0.05 over sample intervals, on a bias.
    steps, bridge = rng.normal(size=(2, n)) / np.sqrt(RATE)
    walk = np.cumsum(steps) - steps / 2.0 + bridge / np.sqrt(12.0)
    x = 3.0 + np.sqrt(RATE) * rng.normal(size=n) + 0.05 * walk
    if estimator == "exact":
        fit = aj.fit(aj.Recording.from_array(x, RATE, gyro_unit="rad/s", names=["gyro_x"]), model)
    else:
        stream = aj.AllanAccumulator(RATE, ["gyro_x"])
        stream.update(x)
        fit = stream.fit(model)
    curve, found = fit.curve, [fit["gyro_x"][label] for label in labels]
    assert curve.estimator == estimator
    value, sizes = np.array([coefficient.value for coefficient in found]), curve.cluster_size
    unit = [dense.covariance(of, n, RATE) for of in (aj.AngleRandomWalk(1.0), aj.RateRandomWalk(1.0))]
    V = dense.allan_covariance(value**2 @ [C[0] for C in unit], sizes, curve.strides)
    means = np.array([[dense.allan_variance(C, m) for C in unit] for m in sizes])
    assert_allclose(curve.edf[:, 0], 2.0 * (means @ value**2) ** 2 / np.diag(V), rtol=1e-6)
    J = 2.0 * value * means
    errors = np.sqrt(np.diag(np.linalg.inv(J.T @ np.linalg.solve(V, J))))
    assert_allclose([coefficient.std for coefficient in found], errors, rtol=1e-3)
    assert (abs(value - [1.0, 0.05]) < 4.0 * errors).all()

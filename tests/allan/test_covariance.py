"""Covariance and degrees of freedom of Allan variances under a noise model, by dense matrices.

Wavelet variances of the Haar wavelet are half the overlapping Allan variances, and their covariance is
public; fits have degrees of freedom and standard errors under their own model.
"""

import numpy as np
import pytest
from phase_laws import LAWS, allan_covariance, allan_variance, markov, mixed

import allanjax as aj

RATE = 4.0
# One structure for all cases, compiled once: what a case leaves out is there with next to nothing.
LABELS = {
    "quantization": aj.Quantization(1e-9),
    "white": aj.AngleRandomWalk(1e-9),
    "flicker": aj.BiasInstability(1e-9),
    "walk": aj.RateRandomWalk(1e-9),
    "markov": aj.Markov(1e-9, 1.0),
    "ramp": aj.DriftRamp(1e-12),
}

# Coefficients, the Markov noise's correlation time [s], and the tolerance relative to the variances: between
# kinks polynomials are summed exactly, the others nearly.
CASES = {
    "quantization": ({"quantization": 1.0}, 1.0, 1e-8),
    "white": ({"white": 1.0}, 1.0, 1e-8),
    "walk": ({"walk": 1.0}, 1.0, 1e-7),
    "flicker": ({"flicker": 1.3}, 1.0, 1e-3),
    "all powers": ({"quantization": 0.5, "white": 1.0, "walk": 0.1}, 1.0, 1e-7),
    "white and ramp": ({"white": 1.0, "ramp": 0.05}, 1.0, 1e-7),
    "walk and ramp": ({"walk": 1.0, "ramp": 0.05}, 1.0, 1e-7),
    "short markov": ({"markov": 1.0}, 0.6, 1e-3),
    "long markov": ({"white": 1.0, "markov": 1.0}, 15.0, 1e-3),
}


def model_of(coefficients: dict[str, float], T_c: float) -> aj.Model:
    terms = []
    for name, term in LABELS.items():
        amplitude = term.amplitude_parameter().name
        terms.append(term.replace(**{amplitude: coefficients.get(name, getattr(term, amplitude))}))
    return aj.Model(tuple(terms)).with_values(markov_correlation_time=T_c)


def law_of(coefficients: dict[str, float], T_c: float):
    laws = LAWS | {"markov": markov(T_c)}
    return mixed(*((c, laws[name]) for name, c in coefficients.items()))


@pytest.mark.parametrize("name", CASES)
def test_covariance_is_the_sum_over_all_pairs_of_differences(name):
    coefficients, T_c, tolerance = CASES[name]
    model, law = model_of(coefficients, T_c), law_of(coefficients, T_c)
    ramp = {k: c for k, c in coefficients.items() if k == "ramp"}
    repeated = law_of(ramp, T_c) if ramp else None
    for n in (16, 17, 600):
        found = aj.wavelet_variance(np.random.default_rng(n).normal(size=n), RATE, model=model)
        sizes = (found.scale * RATE).astype(int)
        np.testing.assert_array_equal(sizes, 2 ** np.arange(len(sizes)))
        expected = allan_covariance(law, n, RATE, sizes, np.ones_like(sizes), repeated)
        sd = np.sqrt(np.diag(expected))
        np.testing.assert_allclose(
            4.0 * found.covariance(model) / np.outer(sd, sd), expected / np.outer(sd, sd), atol=tolerance
        )
        mean = allan_variance(law, n, RATE, sizes)
        np.testing.assert_allclose(2.0 * found.expectation(model), mean, rtol=1e-7)
        np.testing.assert_allclose(found.edf[:, 0], 2.0 * mean**2 / sd**2, rtol=2.0 * tolerance)


def test_a_ramp_alone_does_not_scatter():
    found = aj.wavelet_variance(np.random.default_rng(1).normal(size=600), RATE)
    ramp = model_of({"ramp": 1.0}, 1.0)
    assert abs(found.covariance(ramp)).max() < 1e-12 * found.expectation(ramp).max()


# --- Fits ---------------------------------------------------------------------------------------------------


def recorded(n: int) -> np.ndarray:
    """White noise of N = 1 and the means of a random walk of K = 0.05 over sample intervals, on a bias."""
    rng = np.random.default_rng(5)
    steps, bridge = rng.normal(size=(2, n)) / np.sqrt(RATE)
    walk = np.cumsum(steps) - steps / 2.0 + bridge / np.sqrt(12.0)
    return 3.0 + np.sqrt(RATE) * rng.normal(size=n) + 0.05 * walk


@pytest.mark.parametrize("estimator", ["exact", "pyramid"])
def test_fits_have_the_errors_of_generalized_least_squares(estimator):
    """Standard errors from (J' V⁻¹ J)⁻¹, and 2·E²/V degrees of freedom, with V at the fitted model itself.

    The covariance between any two cluster sizes is in the errors, which agree to 10⁻⁴.
    """
    model, n = aj.AngleRandomWalk() + aj.RateRandomWalk(), 2048
    if estimator == "exact":
        fit = aj.fit(aj.Recording.from_array(recorded(n), RATE, gyro_unit="rad/s", names=["gyro_x"]), model)
    else:
        stream = aj.AllanAccumulator(RATE, ["gyro_x"])
        stream.update(recorded(n))
        fit = stream.fit(model)
    curve, found = fit.curve, [fit["gyro_x"][label] for label in ("angle_random_walk", "rate_random_walk")]
    assert curve.estimator == estimator
    laws = LAWS["white"], LAWS["walk"]
    value = np.array([coefficient.value for coefficient in found])
    sizes, law = curve.cluster_size, mixed(*zip(value, laws, strict=True))
    V, mean = allan_covariance(law, n, RATE, sizes, curve.strides), allan_variance(law, n, RATE, sizes)
    np.testing.assert_allclose(curve.edf[:, 0], 2.0 * mean**2 / np.diag(V), rtol=1e-6)
    J = 2.0 * value * np.stack([allan_variance(of, n, RATE, sizes) for of in laws], axis=1)
    covariance = np.linalg.inv(J.T @ np.linalg.solve(V, J))
    errors = np.sqrt(np.diag(covariance))
    np.testing.assert_allclose([coefficient.std for coefficient in found], errors, rtol=1e-3)
    assert (abs(value - [1.0, 0.05]) < 4.0 * errors).all()

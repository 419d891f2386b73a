"""The covariance of means of stretches, against time series' and spectra's."""

import numpy as np
import pytest

import allanjax as aj
from allanjax.calibration.noise import covariance_of_means, parts_of_model, white_covariance

RATE = 50.0
# Of different lengths, apart, and not in the order of time.
START, LENGTH = np.array([0.0, 900.0, 200.0]), np.array([150.0, 300.0, 500.0])
# White noise beside, so that all of the matrix matters.
WHITE = aj.AngleRandomWalk(2e-3)


def covariance(*terms) -> np.ndarray:
    return covariance_of_means(parts_of_model(aj.Model(tuple(terms)), RATE), START, LENGTH)


def dense(kernel, step: float, contrast: bool) -> np.ndarray:
    """The same from the covariance of the rate at times t and s, summed over all pairs of midpoints."""
    time = np.arange(step / 2.0, 1200.0, step)
    rows = np.stack([(time >= a) & (time < a + d) for a, d in zip(START, LENGTH, strict=True)]).astype(float)
    rows /= rows.sum(axis=1, keepdims=True)
    if contrast:
        rows -= 1.0 / len(time)
    return rows @ kernel(time[:, None], time[None, :]) @ rows.T


def test_white_noise():
    np.testing.assert_allclose(covariance(WHITE), np.diag(4e-6 / LENGTH), rtol=1e-5, atol=1e-14)


def test_random_walk_about_its_average():
    """K² min(t, s); the sum over midpoints of 1 s is exact to (1 s/150 s)² = 4e-5."""
    expected = dense(lambda t, s: 9e-10 * np.minimum(t, s), 1.0, contrast=True)
    np.testing.assert_allclose(
        covariance(aj.RateRandomWalk(3e-5)), expected, rtol=1e-3, atol=1e-4 * expected.max()
    )


def test_a_markov_process_has_a_mean():
    """(q²T_c/2)·exp(−|t − s|/T_c), not taken from its average."""
    expected = dense(lambda t, s: 1e-8 * 200.0 / 2.0 * np.exp(-abs(t - s) / 200.0), 1.0, contrast=False)
    np.testing.assert_allclose(covariance(aj.Markov(1e-4, 200.0)), expected, rtol=1e-4)


def test_a_ramp_about_its_average():
    middle = START + LENGTH / 2.0 - 600.0
    np.testing.assert_allclose(covariance(aj.DriftRamp(1e-6)), 1e-12 * np.outer(middle, middle), rtol=1e-6)


def test_flicker_noise_about_its_average():
    """∫ S(f) H_k(f)* H_l(f) df of the spectrum B²/(2πf), where H are the transforms of the contrasts.

    A thousand frequencies a decade from 1e-7 Hz to 30 Hz, beyond which 1e-6 of the power is left.
    """
    f = np.geomspace(1e-7, 30.0, 8500)

    def transform(a: float, d: float) -> np.ndarray:
        return np.sinc(f * d) * np.exp(-2j * np.pi * f * (a + d / 2.0))

    H = np.stack([transform(a, d) - transform(0.0, 1200.0) for a, d in zip(START, LENGTH, strict=True)])
    power = 2.0 * 4e-8 / (2.0 * np.pi * f)
    expected = np.trapezoid((power * H[:, None] * H[None].conj()).real, f, axis=-1)
    np.testing.assert_allclose(
        covariance(aj.BiasInstability(2e-4)), expected, rtol=2e-3, atol=1e-3 * expected.max()
    )


def test_behind_a_filter_slow_noise_is_the_same():
    """A bandwidth of 2 Hz moves the ends of stretches of 150 s and more by a tenth of a second."""
    terms = WHITE + aj.RateRandomWalk(3e-5)
    plain = covariance_of_means(parts_of_model(terms, RATE), START, LENGTH)
    parts = parts_of_model(aj.LowPass1(2.0) * terms, RATE)
    np.testing.assert_allclose(
        covariance_of_means(parts, START, LENGTH), plain, rtol=5e-3, atol=1e-3 * plain.max()
    )
    np.testing.assert_allclose(white_covariance(parts, LENGTH), np.diag(4e-6 / LENGTH), rtol=2e-3)


def test_a_step_is_no_noise():
    with pytest.raises(aj.AllanjaxError, match="no noise"):
        parts_of_model(aj.Model(()) + WHITE + aj.BiasStep(1e-3, 10.0), RATE)

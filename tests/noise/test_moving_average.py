"""The moving average as a response, against means of faster samples, sums over aliases and simulations."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import allanjax as aj
from allanjax.noise.moving_average import HALF_POWER
from allanjax.noise.notation import parse_model

RATE = 50.0
# Durations [samples]: two values of a whole number, others between.
DURATIONS = [1.0, 1.2, 2.0, 3.7, 8.0, 20.5]


def mean_over(samples):
    return aj.MovingAverage.of(samples / RATE)


@pytest.mark.parametrize("samples", DURATIONS)
def test_the_power_response_is_the_sum_over_all_aliases(samples):
    """sinc²((f + k·rate)τ) summed over k, over the sum at 0; beyond ±K it falls off as 2/(π²K·samples²)."""
    f, K = np.linspace(0.0, RATE / 2.0, 40), 200_000
    k = np.arange(-K, K + 1)
    folded = np.array([np.sum(np.sinc((x / RATE + k) * samples) ** 2) for x in f])
    np.testing.assert_allclose(mean_over(samples).power(f, RATE), folded / folded[0], atol=1e-5)


@pytest.mark.parametrize("samples", [2, 3, 8])
def test_a_mean_of_whole_samples_is_the_filter_of_equal_taps(samples):
    f = np.linspace(0.0, RATE / 2.0, 40)
    taps = np.exp(-2j * np.pi * f[:, None] / RATE * np.arange(samples)).mean(axis=1)
    np.testing.assert_allclose(mean_over(samples).power(f, RATE), abs(taps) ** 2, atol=1e-14)


def test_half_of_the_power_of_slow_noise_is_gone_at_the_bandwidth():
    assert mean_over(60.0).power(mean_over(60.0).bandwidth, RATE) == pytest.approx(0.5, rel=1e-3)
    assert np.sinc(HALF_POWER) ** 2 == pytest.approx(0.5, rel=1e-12)
    assert mean_over(8.0).half_power == mean_over(8.0).bandwidth == pytest.approx(HALF_POWER * RATE / 8.0)


TERMS = [
    aj.AngleRandomWalk(1e-3),
    aj.Quantization(2e-4),
    aj.RateRandomWalk(5e-3),
    aj.BiasInstability(3e-3),
    aj.Markov(1e-2, 0.3),
    aj.Resonance(2e-3, 7.0, 6.0),
]


@pytest.mark.parametrize("term", TERMS, ids=["N", "Q", "K", "B", "Markov", "resonance"])
@pytest.mark.parametrize("samples", [2, 5])
def test_allan_variance_is_that_of_means(term, samples):
    """Weights of phase readings of an Allan variance of running means, over all pairs of readings."""
    term = term.sampled(RATE)
    model = (mean_over(samples) * term).sampled(RATE)
    for m in (1, 2, 7, 20):
        second = np.zeros(2 * m + 1)
        second[[0, m, 2 * m]] = 1.0, -2.0, 1.0
        weights = np.convolve(second, np.full(samples, 1.0 / samples))
        k = np.arange(len(weights))
        G = np.asarray(term.phase_covariance(k / RATE))
        expected = weights @ G[abs(k[:, None] - k)] @ weights / (2.0 * (m / RATE) ** 2)
        assert float(model.allan_variance(m / RATE)) == pytest.approx(expected, rel=1e-8)


@pytest.mark.parametrize("samples", [1.2, 3.7])
def test_white_noise_after_an_integrator_is_that_of_many_short_means(samples):
    """Its samples are means of 40 values a sample interval, over as much of the duration as there is."""
    fine, n = 40, 40_000
    x = np.random.default_rng(8).normal(size=fine * n) * np.sqrt(fine * RATE)
    total = np.concatenate([[0.0], np.cumsum(x)])
    width = round(samples * fine)
    means = (total[width::fine] - total[:-width:fine]) / width
    # N is that of the samples, which have the aliases, too.
    N = np.sqrt(np.sum(np.sinc(np.arange(-10_000, 10_001) * samples) ** 2))
    model = (mean_over(samples) * aj.AngleRandomWalk(N)).sampled(RATE)
    phase = np.concatenate([[0.0], np.cumsum(means)]) / RATE
    for m in (1, 3, 10):
        d = phase[2 * m :] - 2.0 * phase[m:-m] + phase[: -2 * m]
        measured = np.mean(d**2) / (2.0 * (m / RATE) ** 2)
        # Four standard deviations of an overlapping Allan variance with about n/m degrees of freedom.
        assert measured == pytest.approx(
            float(model.allan_variance(m / RATE)), rel=4.0 * np.sqrt(2.0 * m / n)
        )


@pytest.mark.parametrize("samples", [1.2, 3.0])
def test_a_simulation_has_the_models_allan_variance(samples):
    """White noise and a walk through it; 10⁵ samples, four standard deviations of √(2m/n)."""
    model = mean_over(samples) * (aj.AngleRandomWalk(1e-3) + aj.RateRandomWalk(1e-3))
    n = 100_000
    x = np.asarray(aj.simulate(model, n, RATE, 3))
    phase = np.concatenate([[0.0], np.cumsum(x)]) / RATE
    for m in (1, 2, 4, 16, 64):
        d = phase[2 * m :] - 2.0 * phase[m:-m] + phase[: -2 * m]
        measured = np.mean(d**2) / (2.0 * (m / RATE) ** 2)
        expected = float(model.sampled(RATE).allan_variance(m / RATE))
        assert measured == pytest.approx(expected, rel=4.0 * np.sqrt(2.0 * m / n))


def test_it_compiles_and_is_differentiable():
    def variance(bandwidth):
        return (
            (aj.MovingAverage(bandwidth) * aj.BiasInstability(1.0))
            .sampled(RATE)
            .allan_variance(jnp.array(0.2))
        )

    f, h = HALF_POWER * RATE / 3.3, 1e-3
    by_difference = float((variance(f + h) - variance(f - h)) / (2.0 * h))
    assert float(jax.jit(jax.jacfwd(variance))(f)) == pytest.approx(by_difference, rel=1e-5)
    by_numpy = (aj.MovingAverage(f) * aj.BiasInstability(1.0)).sampled(RATE).allan_variance(0.2)
    assert float(variance(f)) == pytest.approx(float(by_numpy), rel=1e-9)


def test_it_is_written_and_read():
    model = aj.MovingAverage(12.5) * aj.AngleRandomWalk(1e-3) + aj.RateRandomWalk(1e-5)
    assert parse_model("moving_average(f_c=12.5 Hz) * (N=1e-3 rad/√s) + K=1e-5 rad/s/√s") == model
    assert eval(repr(model), vars(aj)) == model
    assert aj.MovingAverage.of(0.02).duration == pytest.approx(0.02)


@pytest.mark.parametrize("bandwidth", [0.3, 23.0])
def test_less_than_a_sample_and_more_than_64_are_refused(bandwidth):
    with pytest.raises(aj.AllanjaxError, match=r"from 0.3461 Hz \(64 samples\) to 22.15 Hz"):
        (aj.MovingAverage(bandwidth) * aj.AngleRandomWalk(1e-3)).sampled(RATE)

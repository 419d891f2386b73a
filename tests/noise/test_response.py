"""Noise after a filter: closed forms against convolutions of autocovariances, and simulated records."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.signal import freqz, lfilter

import allanjax as aj
from allanjax.noise.notation import parse_model

RATE = 50.0
ONE, TWO = aj.LowPass1(4.0), aj.LowPass2(5.0, 0.9)
TERMS = [
    aj.AngleRandomWalk(1e-3),
    aj.Quantization(2e-4),
    aj.RateRandomWalk(5e-3),
    aj.BiasInstability(3e-3),
    aj.Markov(1e-2, 0.3),
    aj.Markov(2e-2, 5e-4),
    aj.Resonance(2e-3, 7.0, 6.0),
]
IDS = ["N", "Q", "K", "B", "slow Markov", "fast Markov", "resonance"]


def impulse_response(filter_, n):
    """First samples of the filter's response to a pulse."""
    return np.asarray(filter_.filtered(jnp.zeros(n).at[0].set(1.0), RATE))


@pytest.mark.parametrize("filter_", [ONE, TWO], ids=["one pole", "two poles"])
@pytest.mark.parametrize("term", TERMS, ids=IDS)
def test_allan_variance_is_that_of_the_filtered_autocovariance(filter_, term):
    """Σ_p Σ_q a_p a_q G(t_p − t_q) with weights a of phase readings: those of Allan's, after the filter.

    The filter's pulses are convolved with the Allan variance's weights by NumPy, and the sum is taken over
    all pairs with the G of the term itself. Nothing of the closed forms is in it.
    """
    term = term.sampled(RATE)
    model = (filter_ * term).sampled(RATE)
    pulse = impulse_response(filter_, 300)
    for m in (1, 2, 5, 20):
        second = np.zeros(2 * m + 1)
        second[[0, m, 2 * m]] = 1.0, -2.0, 1.0
        weights = np.convolve(second, pulse)
        k = np.arange(len(weights))
        G = np.asarray(term.phase_covariance(np.arange(len(weights)) / RATE))
        expected = weights @ G[abs(k[:, None] - k)] @ weights / (2.0 * (m / RATE) ** 2)
        found = float(model.allan_variance(m / RATE))
        assert found == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("filter_", [ONE, TWO], ids=["one pole", "two poles"])
def test_the_power_response_is_that_of_the_pulse(filter_):
    pulse = impulse_response(filter_, 400)
    f = np.linspace(0.0, RATE / 2.0, 101)
    _, H = freqz(pulse, 1.0, 2.0 * np.pi * f / RATE)
    np.testing.assert_allclose(filter_.power(f, RATE), abs(H) ** 2, rtol=1e-9)
    assert filter_.power(0.0, RATE) == pytest.approx(1.0, rel=1e-12)


def test_one_pole_is_the_recursive_filter():
    x = np.random.default_rng(1).normal(size=500)
    w = np.exp(-2.0 * np.pi * 4.0 / RATE)
    np.testing.assert_allclose(
        ONE.filtered(jnp.asarray(x), RATE), lfilter([1.0 - w], [1.0, -w], x), rtol=1e-9
    )


@pytest.mark.parametrize("filter_", [ONE, TWO], ids=["one pole", "two poles"])
def test_the_spectrum_is_the_product(filter_):
    terms = aj.AngleRandomWalk(1e-3) + aj.RateRandomWalk(5e-3)
    after = aj.Resonance(2e-3, 7.0, 6.0)
    f = np.linspace(0.1, 24.0, 50)
    found = (filter_ * terms + after).sampled(RATE).sampled_psd(f, RATE)
    inside = np.asarray(filter_.power(f, RATE)) * np.asarray(terms.sampled_psd(f, RATE))
    np.testing.assert_allclose(
        found, inside + np.asarray(after.sampled(RATE).sampled_psd(f, RATE)), rtol=1e-12
    )


def test_slow_noise_is_left_as_it_is():
    """σ²(T) → N²/T, K²T/3: for times far above that of the filter, to its square."""
    T = 2000.0
    for term in (aj.AngleRandomWalk(1e-3), aj.RateRandomWalk(5e-3), aj.BiasInstability(3e-3)):
        found = float((ONE * term).sampled(RATE).allan_variance(T))
        assert found == pytest.approx(float(term.allan_variance(T)), rel=3e-4)


@pytest.mark.parametrize("filter_", [ONE, TWO], ids=["one pole", "two poles"])
def test_a_simulation_has_the_models_allan_variance(filter_):
    """White noise, a Markov process and a resonance after it; 2·10⁵ samples.

    The tolerances are four standard deviations of an overlapping Allan variance: √(2/edf), edf about n/m.
    """
    model = filter_ * (aj.AngleRandomWalk(1e-3) + aj.Markov(1e-3, 0.2)) + aj.Resonance(1e-3, 9.0, 5.0)
    n = 200_000
    x = np.asarray(aj.simulate(model, n, RATE, 3))
    phase = np.concatenate([[0.0], np.cumsum(x)]) / RATE
    for m in (1, 4, 16, 64, 256):
        d = phase[2 * m :] - 2.0 * phase[m:-m] + phase[: -2 * m]
        measured = np.mean(d**2) / (2.0 * (m / RATE) ** 2)
        expected = float(model.sampled(RATE).allan_variance(m / RATE))
        # The resonance's power has f0·T/Q degrees of freedom, too.
        assert measured == pytest.approx(expected, rel=4.0 * np.sqrt(2.0 * max(m, 8) / n))


def test_it_is_differentiable_and_compiles():
    def variance(bandwidth):
        return (aj.LowPass1(bandwidth) * aj.BiasInstability(1.0)).sampled(RATE).allan_variance(jnp.array(0.2))

    slope = jax.jit(jax.jacfwd(variance))(4.0)
    h = 1e-4
    assert float(slope) == pytest.approx(float((variance(4.0 + h) - variance(4.0 - h)) / (2.0 * h)), rel=1e-5)


def test_the_algebra():
    N, K, wave = aj.AngleRandomWalk(1e-3), aj.RateRandomWalk(2e-5), aj.Resonance(1e-3, 7.0, 6.0)
    model = ONE * (N + K) + wave
    assert model.term_labels == ("angle_random_walk", "rate_random_walk", "resonance")
    assert [p.label for p in model.parameters][-1] == "low_pass1_bandwidth"
    assert model.values["low_pass1_bandwidth"] == 4.0
    assert model.with_values(low_pass1_bandwidth=3.0).response.bandwidth == 3.0
    assert (wave + ONE * N + K).inside == (False, True, False)
    assert model.without(["rate_random_walk"]).inside == (True, False)
    assert model.without(["angle_random_walk", "rate_random_walk"]).response is None
    assert eval(repr(model), vars(aj)) == model
    text = "low_pass1(bandwidth=4 Hz) * (N=1e-3 rad/√s + K=2e-5 rad/s/√s)"
    assert parse_model(text) == ONE * (N + K)
    assert parse_model("low_pass2 * N + B").response == aj.LowPass2()


def test_what_cannot_be_is_refused():
    N = aj.AngleRandomWalk(1e-3)
    with pytest.raises(aj.AllanjaxError, match="one response"):
        ONE * (TWO * N)
    with pytest.raises(aj.AllanjaxError, match="one response"):
        ONE * N + TWO * N
    with pytest.raises(aj.AllanjaxError, match="after the filter"):
        ONE * aj.DriftRamp(1e-6)
    with pytest.raises(aj.AllanjaxError, match="after the filter"):
        (ONE * aj.Telegraph(1e-3, 2.0)).sampled(RATE).allan_variance(1.0)
    with pytest.raises(aj.AllanjaxError, match="at which rate"):
        (ONE * N).allan_variance(1.0)
    with pytest.raises(aj.AllanjaxError, match="no response 'low'"):
        parse_model("low * N")
    recording = aj.simulate_recording({"gyro_x": N}, 4096, RATE, 1)
    with pytest.raises(aj.FitError, match="is estimated from the spectrum of a recording only"):
        aj.fit(recording, aj.LowPass1() * aj.AngleRandomWalk())

"""Noise after a filter: closed forms against convolutions of autocovariances, and simulated records."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.signal import bessel, butter, freqz, freqz_sos, lfilter, sosfilt

import allanjax as aj
from allanjax.noise.notation import parse_model

RATE = 50.0
ONE, TWO = aj.LowPass1(4.0), aj.LowPass2(5.0, 0.9)
# The third at a quarter of the sample rate, where a pole is 0, the fourth above it.
BUTTERWORTH = [aj.Butterworth(f, m) for f, m in [(4.0, 1), (6.0, 2), (12.5, 3), (17.0, 4)]]
BIQUAD = aj.Biquad(7.0, 0.577)
FILTERS = [ONE, TWO, BIQUAD, *BUTTERWORTH]
FILTER_IDS = ["one pole", "two poles", "biquad", *(f"Butterworth {k}" for k in range(1, 5))]
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


@pytest.mark.parametrize("filter_", FILTERS, ids=FILTER_IDS)
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
        # With a pole moved away from 0 by 10⁻⁵.
        assert found == pytest.approx(expected, rel=1e-4 if filter_ is BUTTERWORTH[2] else 1e-6)


@pytest.mark.parametrize("filter_", FILTERS, ids=FILTER_IDS)
def test_the_power_response_is_that_of_the_pulse(filter_):
    pulse = impulse_response(filter_, 400)
    f = np.linspace(0.0, RATE / 2.0, 101)
    _, H = freqz(pulse, 1.0, 2.0 * np.pi * f / RATE)
    np.testing.assert_allclose(filter_.power(f, RATE), abs(H) ** 2, rtol=1e-9, atol=1e-13)
    assert filter_.power(0.0, RATE) == pytest.approx(1.0, rel=1e-12)


def test_one_pole_is_the_recursive_filter():
    x = np.random.default_rng(1).normal(size=500)
    w = np.exp(-2.0 * np.pi * 4.0 / RATE)
    np.testing.assert_allclose(
        ONE.filtered(jnp.asarray(x), RATE), lfilter([1.0 - w], [1.0, -w], x), rtol=1e-9
    )


@pytest.mark.parametrize("order", [1, 2, 3, 4])
@pytest.mark.parametrize("bandwidth", [0.01, 4.0, 12.5, 24.0])
def test_butterworth_is_the_filter_that_scipy_designs(order, bandwidth):
    x = np.random.default_rng(1).normal(size=500)
    filter_ = aj.Butterworth(bandwidth, order)
    design = butter(order, bandwidth, fs=RATE, output="sos")
    np.testing.assert_allclose(
        filter_.filtered(jnp.asarray(x), RATE), sosfilt(design, x), rtol=1e-9, atol=1e-12
    )
    f = np.linspace(0.0, 24.9, 100)
    H = freqz_sos(design, 2.0 * np.pi * f / RATE)[1]
    np.testing.assert_allclose(filter_.power(f, RATE), abs(H) ** 2, rtol=1e-9, atol=1e-24)
    w, c = filter_.poles(RATE)
    s = np.sin(np.pi * f / RATE)[:, None] ** 2
    of_poles = np.sum(c * (1.0 - w**2) / ((1.0 - w) ** 2 + 4.0 * w * s), axis=1)
    assert np.max(abs(of_poles.imag)) < 1e-12
    # A pole at 0 is moved by 10⁻⁵.
    moved = bandwidth == 12.5 and order % 2
    np.testing.assert_allclose(
        of_poles.real + filter_.constant(RATE), abs(H) ** 2, atol=3e-5 if moved else 1e-9
    )


@pytest.mark.parametrize("bandwidth", [0.01, 4.0, 12.5, 24.0])
def test_a_biquad_is_the_bessel_filter_that_scipy_designs(bandwidth):
    """Bessel's filter of two poles has Q = 1/√3, and with this norm the same asymptote as Butterworth's."""
    x = np.random.default_rng(1).normal(size=500)
    filter_ = aj.Biquad(bandwidth, 1.0 / np.sqrt(3.0))
    design = bessel(2, bandwidth, fs=RATE, output="sos", norm="phase")
    np.testing.assert_allclose(
        filter_.filtered(jnp.asarray(x), RATE), sosfilt(design, x), rtol=1e-9, atol=1e-12
    )
    f = np.linspace(0.0, 24.9, 100)
    H = freqz_sos(design, 2.0 * np.pi * f / RATE)[1]
    np.testing.assert_allclose(filter_.power(f, RATE), abs(H) ** 2, rtol=1e-9, atol=1e-24)
    slow = aj.Biquad(0.01, 0.8)
    assert slow.power(slow.half_power, RATE) == pytest.approx(0.5, rel=1e-5)


@pytest.mark.parametrize("filter_", FILTERS, ids=FILTER_IDS)
@pytest.mark.parametrize("term", TERMS, ids=IDS)
def test_what_a_filter_adds_is_the_product_less_the_density(filter_, term):
    """R·S at frequencies up to half the sample rate, S as what its parts say."""

    def density(parts, s):
        w, c = parts.poles
        of_poles = np.sum(c * (1.0 - w**2) / ((1.0 - w) ** 2 + 4.0 * w * s[:, None]), axis=1).real
        return parts.white + 4.0 * s * parts.difference + parts.walk / (4.0 * s) + of_poles

    f = np.linspace(0.5, 24.5, 60)
    s = np.sin(np.pi * f / RATE) ** 2
    parts = term.sampled(RATE).parts(RATE)
    before, added = density(parts, s), density(filter_.change(parts, RATE), s)
    atol = (3e-5 if filter_ is BUTTERWORTH[2] else 1e-8) * before.max()
    np.testing.assert_allclose(added, (filter_.power(f, RATE) - 1.0) * before, atol=atol)


@pytest.mark.parametrize("filter_", FILTERS, ids=FILTER_IDS)
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


@pytest.mark.parametrize("filter_", FILTERS, ids=FILTER_IDS)
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


@pytest.mark.parametrize("order", [1, 2, 3, 4])
def test_a_butterworth_filter_is_differentiable(order):
    def variance(bandwidth):
        model = aj.Butterworth(bandwidth, order) * aj.BiasInstability(1.0)
        return model.sampled(RATE).allan_variance(jnp.array(0.2))

    slope = jax.jit(jax.jacfwd(variance))
    for f, h in ((4.0, 1e-4), (0.24 * RATE, 1e-3)):
        by_difference = float((variance(f + h) - variance(f - h)) / (2.0 * h))
        assert float(slope(f)) == pytest.approx(by_difference, rel=1e-4)
    assert np.isfinite(float(slope(RATE / 4.0)))


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


def test_the_order_of_a_butterworth_filter_is_the_users():
    N = aj.AngleRandomWalk(1e-3)
    assert parse_model("butterworth * N").response == aj.Butterworth(order=2)
    model = aj.Butterworth(4.0, 3).hold("bandwidth") * N
    assert parse_model("butterworth(f_c=4 Hz held, order=3) * (N=1e-3 rad/√s)") == model
    assert eval(repr(model), vars(aj)) == model
    assert model.values == {"angle_random_walk": 1e-3, "butterworth_bandwidth": 4.0}
    assert parse_model("low_pass(order=2)") == aj.Model((aj.LowPass(order=2),))
    assert repr(aj.LowPass(order=2)) == "LowPass(order=2)"
    for order in (0, 5, 2.0, "2"):
        with pytest.raises(aj.AllanjaxError, match="the order must be 1, 2, 3 or 4"):
            aj.Butterworth(4.0, order)
    with pytest.raises(aj.AllanjaxError, match="order is a whole number"):
        parse_model("butterworth(order=two) * N")
    with pytest.raises(aj.AllanjaxError, match="it has bandwidth, order"):
        parse_model("butterworth(degree=2) * N")
    with pytest.raises(aj.AllanjaxError, match="one response"):
        aj.Butterworth(4.0, 2) * N + aj.Butterworth(4.0, 3) * N
    with pytest.raises(aj.AllanjaxError, match="must be below half the sample rate, 25 Hz, got 26"):
        (aj.Butterworth(26.0) * N).sampled(RATE)


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

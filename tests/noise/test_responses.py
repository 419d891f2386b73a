"""Responses: their power by SciPy's filters, noise after them by dense covariances, and a user's own."""

import dense
import numpy as np
import pytest
from noise_terms import RANDOM, RATE, RESPONSES
from numpy.testing import assert_allclose
from scipy import signal

import allanjax as aj

F = np.linspace(0.0, RATE / 2.0, 41)
# What may pass a filter: terms that have parts of each kind, white, differences, walks, poles and pairs.
PASSING = ("quantization", "white", "walk", "flicker", "markov", "short markov", "wandering resonance")
# A pole at zero, a quarter of the rate: G is that of one moved by 10⁻⁵.
MOVED = "butterworth 3"


def test_power_is_that_of_the_pulse():
    """The cosine sum of the pulse's autocorrelation; its rounding is what the deepest stop band shows."""
    for name, filter_ in RESPONSES.items():
        r = dense.pulse_autocorrelation(filter_, RATE)
        cosines = np.cos(2.0 * np.pi * np.outer(np.arange(len(r)), F) / RATE)
        expected = 2.0 * r @ cosines - r[0]
        assert_allclose(filter_.power(F, RATE), expected, rtol=1e-9, atol=1e-13, err_msg=name)
        assert filter_.power(0.0, RATE) == pytest.approx(1.0, rel=1e-12)


def test_digital_filters_are_those_that_scipy_designs():
    """Deep in the stop band, at low and high bandwidths; Bessel's of two poles has Q = 1/√3."""
    f = np.linspace(0.0, 0.499 * RATE, 60)
    options = {"fs": RATE, "output": "sos"}
    for at in RATE * np.array([2e-4, 0.1, 0.25, 0.496]):
        designs = {aj.Butterworth(at, k): signal.butter(k, at, **options) for k in (1, 2, 3, 4)}
        designs[aj.Biquad(at, 1.0 / np.sqrt(3.0))] = signal.bessel(2, at, **options, norm="phase")
        for filter_, sos in designs.items():
            power = abs(signal.freqz_sos(sos, f, fs=RATE)[1]) ** 2
            assert_allclose(filter_.power(f, RATE), power, rtol=1e-8, atol=1e-24)
    # From 0.995 of half the rate on the filter is that of 0.995.
    most, more = (aj.Butterworth(x * RATE / 2.0, 3).power(f, RATE) for x in (0.995, 0.999))
    assert_allclose(more, most, rtol=1e-12)


@pytest.mark.parametrize("name", RESPONSES)
def test_g_after_a_filter_is_that_of_the_dense_covariance(name):
    """The autocovariance of a term is convolved with that of the pulse: nothing of the closed forms."""
    m = np.array([1, 2, 5, 31])
    for inner in PASSING:
        model = RESPONSES[name] * RANDOM[inner] + aj.AngleRandomWalk(1e-9)
        C = dense.covariance(model, 62, RATE)
        expected = [dense.allan_variance(C, k) for k in m]
        found = model.sampled(RATE).allan_variance(m / RATE)
        assert_allclose(found, expected, rtol=1e-4 if name == MOVED else 1e-7, err_msg=inner)


def test_the_density_is_the_product_and_what_comes_after_is_left_alone():
    terms, after = aj.AngleRandomWalk(1e-3) + aj.RateRandomWalk(5e-3), aj.Resonance(2e-3, 7.0, 6.0)
    filter_, f = RESPONSES["biquad"], F[1:-1]
    model, power = (after + filter_ * terms).sampled(RATE), filter_.power(f, RATE)
    expected = power * terms.sampled_psd(f, RATE) + after.sampled(RATE).sampled_psd(f, RATE)
    assert_allclose(model.sampled_psd(f, RATE), expected, rtol=1e-12)
    assert_allclose(model.psd(f), power * terms.psd(f) + after.psd(f), rtol=1e-12)


def test_bandwidths_halve_the_power_of_an_analog_filter():
    for filter_ in (aj.LowPass1(0.01), aj.LowPass2(0.01, 2.3), aj.Biquad(0.01, 0.8), aj.Butterworth(0.01, 3)):
        assert filter_.power(filter_.half_power, RATE) == pytest.approx(0.5, rel=2e-3)
    mean = aj.MovingAverage.of(60.0 / RATE)
    assert mean.power(mean.bandwidth, RATE) == pytest.approx(0.5, rel=1e-3)
    assert np.sinc(mean.half_power * mean.duration) ** 2 == pytest.approx(0.5, rel=1e-12)
    assert mean.duration == pytest.approx(1.5)


class Echo(aj.Response):
    """Half of what came in one sample before and half of now, as a user would write it; no recursion."""

    bandwidth: float | None = aj.parameter("f_c", "frequency")

    def power(self, frequency, rate):
        return np.cos(np.pi * np.asarray(frequency) / rate) ** 2

    def phase_covariance(self, process, lag, rate):
        G = process.phase_covariance(abs(np.asarray(lag)[..., None] + np.array([-1.0, 0.0, 1.0]) / rate))
        return G @ np.array([0.25, 0.5, 0.25])

    def filtered(self, x, rate):
        return (x + np.concatenate([[0.0], x[:-1]])) / 2.0


class Recursive(Echo):
    def transfer(self, rate):
        return np.array([0.5, 0.5]), np.ones(1)


def test_a_users_response_works_as_the_packages_own():
    model = (Recursive(3.0) * RANDOM["walk"] + RANDOM["white"]).sampled(RATE)
    C, T = dense.covariance(model, 40, RATE), np.array([1, 2, 13])
    for one in (model, model.state_space(RATE)):
        expected = [dense.allan_variance(C, m) for m in T]
        assert_allclose(one.allan_variance(T / RATE), expected, rtol=1e-9)
    assert model.values["recursive_bandwidth"] == 3.0


ONE, WHITE = aj.LowPass1(4.0), aj.AngleRandomWalk(1e-3)
REFUSED = [
    (lambda: ONE * (aj.LowPass2(5.0) * WHITE), "one response"),
    (lambda: aj.Butterworth(4.0, 2) * WHITE + aj.Butterworth(4.0, 3) * WHITE, "one response"),
    (lambda: ONE * aj.DriftRamp(1e-6), "drift_ramp"),
    (lambda: (ONE * aj.Telegraph(1e-3, 2.0)).sampled(RATE).allan_variance(1.0), "Telegraph"),
    (lambda: (ONE * aj.BiasInstability(1.0, 2.0)).sampled(RATE).allan_variance(1.0), "after"),
    (lambda: (ONE * WHITE).allan_variance(1.0), "rate"),
    (lambda: (Echo(3.0) * WHITE).state_space(RATE), "echo"), (lambda: aj.LowPass1(0.0), "bandwidth"),
    (lambda: aj.LowPass2(4.0, 0.5), "quality_factor"), (lambda: aj.Biquad(4.0, 0.5), "quality_factor"),
    *((lambda order=order: aj.Butterworth(4.0, order), "order") for order in (0, 5, 2.0, "2")),
    (lambda: (aj.Butterworth(20.1) * WHITE).sampled(RATE), "bandwidth"),
    (lambda: (aj.MovingAverage(0.27) * WHITE).sampled(RATE), "bandwidth"),
    (lambda: (aj.MovingAverage(17.8) * WHITE).sampled(RATE), "bandwidth"),
]  # fmt: skip


def test_what_cannot_be_is_refused():
    for attempt, word in REFUSED:
        with pytest.raises(aj.AllanjaxError, match=word):
            attempt()
    # The ends of what is possible.
    assert (aj.Butterworth(20.0) * WHITE).sampled(RATE).rate == RATE
    assert (aj.MovingAverage.of(64.0 / RATE) * WHITE).sampled(RATE).rate == RATE

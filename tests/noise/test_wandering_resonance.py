"""A resonance whose frequency is spread over the record."""

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import norm

import allanjax as aj

RATE = 100.0
F = np.array([5.0, 18.0, 19.5, 20.0, 20.4, 22.0, 35.0])


def density(f, f0, Q):
    """Of unit variance."""
    w0, w = 2.0 * np.pi * f0, 2.0 * np.pi * f
    return 2.0 * w0**3 / Q / ((w0**2 - w**2) ** 2 + (w0 * w / Q) ** 2)


def test_without_spread_it_is_a_resonance():
    one, other = aj.WanderingResonance(2.0, 20.0, 15.0, 1e-9), aj.Resonance(2.0, 20.0, 15.0)
    time = np.array([0.01, 0.3, 5.0])
    np.testing.assert_allclose(one.allan_variance(time), other.allan_variance(time), rtol=1e-9)
    np.testing.assert_allclose(one.psd(F), other.psd(F), rtol=1e-12)
    np.testing.assert_allclose(
        one.sampled(RATE).sampled_psd(F, RATE), other.sampled(RATE).sampled_psd(F, RATE), rtol=1e-12
    )


@pytest.mark.parametrize("spread", [0.2, 0.6])
def test_its_density_is_the_mean_over_frequencies(spread):
    """By adaptive integration over the normal law; eleven nodes are right to half a per cent."""
    term = aj.WanderingResonance(1.0, 20.0, 15.0, spread)
    expected = [
        quad(lambda x, f=f: norm.pdf(x) * density(f, 20.0 + spread * x, 15.0), -8.0, 8.0, limit=200)[0]
        for f in F
    ]
    np.testing.assert_allclose(term.psd(F), expected, rtol=5e-3)


def test_its_allan_variance_is_that_of_its_density():
    """(4.10): σ²(T) = 4∫ S sin⁴(πfT)/(πfT)² df over positive frequencies, twice that of the thesis's half."""
    term = aj.WanderingResonance(1.0, 20.0, 15.0, 0.5)
    f = np.linspace(1e-3, 400.0, 2_000_001)
    for T in (0.01, 0.02, 0.11):
        x = np.pi * f * T
        expected = np.trapezoid(4.0 * np.asarray(term.psd(f)) * np.sin(x) ** 4 / x**2, f)
        assert float(term.allan_variance(np.array([T]))[0]) == pytest.approx(expected, rel=1e-3)


def test_a_frequency_that_wanders_is_told_from_a_broad_peak():
    """Eighty stretches of 10 s, each with a frequency of its own: quality and spread within four deviations.

    A plain resonance has to be as broad as the wandering makes it.
    """
    rng, parts = np.random.default_rng(3), []
    for k in range(80):
        f0 = 20.0 + 0.5 * rng.standard_normal()
        parts.append(np.asarray(aj.simulate(aj.Resonance(1.0, f0, 40.0), 1000, RATE, k)))
    x = np.concatenate(parts) + 0.2 * rng.standard_normal(80_000)
    recording = aj.Recording.from_array(x[:, None], RATE, gyro_unit="rad/s", names=["gyro_x"])
    terms = aj.AngleRandomWalk() + aj.WanderingResonance(frequency=20.0)
    (found,) = aj.fit(recording, terms, objective="whittle", as_is=True).results
    spread, quality = found["wandering_resonance_spread"], found["wandering_resonance_quality_factor"]
    # The eighty frequencies are themselves a sample, whose deviation is known to 8 %.
    assert abs(spread.value - 0.5) < 4.0 * np.hypot(spread.std, 0.04)
    assert abs(quality.value - 40.0) < 4.0 * quality.std
    plain = aj.fit(recording, "N + resonance", objective="whittle", as_is=True)["gyro_x"]
    assert plain["resonance_quality_factor"].value < 40.0 - 4.0 * plain["resonance_quality_factor"].std

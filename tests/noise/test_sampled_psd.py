"""Spectra of samples against sums over aliases or lags, term by term, and the numerical default against
both.
"""

import math

import jax.numpy as jnp
import numpy as np
import pytest
from scipy import integrate, special

import allanjax as aj

RATE = 4.0
Q, N, B, K, R = 2.3e-6, 1.7e-4, 4.1e-5, 6.2e-6, 3.3e-7
Q_C, T_C = 5.2e-5, 8.0
SIGMA, F_R, Q_F = 2.9e-4, 0.8, 12.0
F = 3.7e-5
FLOOR = 1e-3

# Five decades up to just below the Nyquist frequency, none of them a frequency where a term changes.
FREQUENCIES = RATE * np.array(
    [5.2e-6, 5e-5, 7e-4, 3.1e-3, 0.011, 0.063, 0.13, 0.19, 0.21, 0.29, 0.37, 0.45, 0.499]
)


class FlickerAngle(aj.NoiseTerm):
    """That of the docstring of NoiseTerm."""

    coefficient: float | None = aj.parameter("F", time_exponent=1.0)

    def phase_covariance(self, lag):
        return -(self.coefficient**2) * jnp.log(jnp.maximum(lag, FLOOR))


class HalfFlicker(aj.NoiseTerm):
    """A slope between random walk and flicker, S(f) ∝ f^(−1/2): G is −H²·t^1.5."""

    coefficient: float | None = aj.parameter("H", time_exponent=0.25)

    def phase_covariance(self, lag):
        return -(self.coefficient**2) * jnp.where(lag > 0.0, lag, 1.0) ** 1.5 * (lag > 0.0)


def alias_sum(psd, f, exponent=None, aliases=4000):
    """Σ_m S(f + m·rate)·sinc²((f + m·rate)/rate), the tails as integrals of a power of the frequency.

    With `exponent` p, S falls as f^−p beyond; the midpoint rule for |m| > aliases then errs by a relative
    (p + 2)²/(24 aliases²) of a tail that is itself below 1/aliases of the sum. Without one, S has ended.
    """
    m = np.arange(-aliases, aliases + 1)
    found = []
    for one in np.atleast_1d(f):
        u = one / RATE + m
        total = np.sum(psd(np.abs(u) * RATE) * np.sinc(u) ** 2)
        if exponent is not None:
            for end in (aliases + 0.5 + one / RATE, aliases + 0.5 - one / RATE):
                at_end = psd(end * RATE) * (np.sin(np.pi * one / RATE) / (np.pi * end)) ** 2
                total += at_end * end / (exponent + 1.0)
        found.append(total)
    return np.array(found)


def resonance(quality_factor):
    def density(f):
        w0, w = 2.0 * np.pi * F_R, 2.0 * np.pi * f
        shape = (w0**2 - w**2) ** 2 + (w0 * w / quality_factor) ** 2
        return 2.0 * SIGMA**2 * w0**3 / quality_factor / shape

    return density


def flicker_up_to(cutoff):
    return lambda f: np.where(f <= cutoff, B**2 / (2.0 * np.pi * f), 0.0)


def flicker_angle(f):
    """Of −F² ln max(t, ε): the transform is F²(π/2 − Si(2πfε))/πf; the rate has (2πf)² times that."""
    x = 2.0 * np.pi * f * FLOOR
    far = np.maximum(x, 30.0)
    # π/2 − Si(x) = cos(x)/x (1 − 2!/x² + …) + sin(x)/x² (1 − 3!/x² + …) where the difference would cancel.
    ahead = np.cos(far) / far * (1 - 2 / far**2 + 24 / far**4) + np.sin(far) / far**2 * (1 - 6 / far**2)
    left = np.where(x < 30.0, np.pi / 2.0 - special.sici(x)[0], ahead)
    return (2.0 * np.pi * f) ** 2 * F**2 * left / (np.pi * f)


def half_flicker(f):
    """The transform of −|t|^1.5 is −2Γ(2.5)cos(2.5π/2)/(2πf)^2.5, times (2πf)² for the rate."""
    return -2.0 * F**2 * math.gamma(2.5) * math.cos(1.25 * math.pi) / np.sqrt(2.0 * np.pi * f)


def resonance_samples(f):
    """The cosine sum over lags, direct, of σ² e^{−at}[cos ω_d t + (a/ω_d) sin ω_d t]; it has ended after
    2000.
    """
    w0 = 2.0 * np.pi * F_R
    a, wd = w0 / (2.0 * Q_F), w0 * np.sqrt(1.0 - 1.0 / (4.0 * Q_F**2))
    t = np.arange(2000) / RATE
    covariance = SIGMA**2 * np.exp(-a * t) * (np.cos(wd * t) + a / wd * np.sin(wd * t))
    assert covariance[-1] < 1e-20 * covariance[0]
    twice = np.where(t > 0, 2.0, 1.0)
    return (twice * covariance) @ np.cos(2.0 * np.pi * np.outer(t, f)) / RATE


def first_differences(f):
    """Of Q·rate·(e_{k+1} − e_k): variance 2, −1 at one lag; in extended precision, for the cancellation."""
    a = 2.0 * np.pi * np.asarray(f, np.longdouble) / RATE
    return np.asarray((Q * RATE) ** 2 * (2.0 - 2.0 * np.cos(a)) / RATE, float)


def markov(q_c, t_c):
    return lambda f: (q_c * t_c) ** 2 / (1.0 + (2.0 * np.pi * f * t_c) ** 2)


# The term, and the independent sum. Closed forms are exact, and the sums' own tails are right to some 1e-9.
CLOSED = {
    "quantization": (aj.Quantization(Q), first_differences),
    "angle random walk": (aj.AngleRandomWalk(N), lambda f: alias_sum(lambda f: N**2 + 0.0 * f, f, 0.0)),
    "bias instability": (
        aj.BiasInstability(B),
        lambda f: alias_sum(lambda f: B**2 / (2.0 * np.pi * f), f, 1.0),
    ),
    "rate random walk": (
        aj.RateRandomWalk(K),
        lambda f: alias_sum(lambda f: (K / (2.0 * np.pi * f)) ** 2, f, 2.0),
    ),
    "markov": (aj.Markov(Q_C, T_C), lambda f: alias_sum(markov(Q_C, T_C), f, 2.0)),
    "fast markov": (aj.Markov(Q_C, 0.03), lambda f: alias_sum(markov(Q_C, 0.03), f, 2.0)),
    "slow markov": (aj.Markov(Q_C, 1e5), lambda f: alias_sum(markov(Q_C, 1e5), f, 2.0)),
    "cutoff below Nyquist": (aj.BiasInstability(B, 0.8), lambda f: alias_sum(flicker_up_to(0.8), f)),
    "cutoff above": (aj.BiasInstability(B, 9.9), lambda f: alias_sum(flicker_up_to(9.9), f)),
    "resonance": (aj.Resonance(SIGMA, F_R, Q_F).sampled(RATE), resonance_samples),
}
# Terms without a closed form, for which the default is all there is.
NUMERICAL = {
    "the flicker angle of a docstring": (
        FlickerAngle(F),
        lambda f: alias_sum(flicker_angle, f, aliases=30_000),
    ),
    "half flicker": (HalfFlicker(F), lambda f: alias_sum(half_flicker, f, 0.5)),
    "an overdamped line": (
        aj.Resonance(SIGMA, F_R, 2.0),
        lambda f: alias_sum(resonance(2.0), f, 4.0),
    ),
}
SMOOTH = [name for name in CLOSED if not name.startswith(("cutoff", "resonance"))]


@pytest.mark.parametrize("name", CLOSED)
def test_closed_forms_are_the_sum_over_aliases_or_lags(name):
    term, independent = CLOSED[name]
    found = np.asarray(term.sampled_psd(FREQUENCIES, RATE))
    np.testing.assert_allclose(found, independent(FREQUENCIES), rtol=1e-8)


def test_a_cutoff_far_above_the_rate_leaves_out_less_than_it_says():
    # Sixteen aliases each way are summed; the rest is below 1e-3 of the first.
    found = np.asarray(aj.BiasInstability(B, 400.0).sampled_psd(FREQUENCIES, RATE))
    expected = alias_sum(flicker_up_to(400.0), FREQUENCIES)
    np.testing.assert_allclose(found, expected, rtol=1e-3)
    assert (found <= expected * (1.0 + 1e-12)).all()


@pytest.mark.parametrize("name", [*SMOOTH, *NUMERICAL])
def test_the_numerical_default_agrees_to_one_in_ten_thousand(name):
    term, independent = (CLOSED | NUMERICAL)[name]
    found = np.asarray(aj.NoiseTerm.sampled_psd(term, FREQUENCIES, RATE))
    np.testing.assert_allclose(found, independent(FREQUENCIES), rtol=1e-4)


@pytest.mark.parametrize("name", ["cutoff below Nyquist", "resonance"])
def test_the_numerical_default_holds_away_from_what_is_sharp(name):
    """A covariance that swings is sampled coarsely far out: 1e-3 where the spectrum has no edge or line
    nearby.
    """
    term, independent = CLOSED[name]
    away = FREQUENCIES < F_R / 2.0
    found = np.asarray(aj.NoiseTerm.sampled_psd(term, FREQUENCIES, RATE))
    np.testing.assert_allclose(found[away], independent(FREQUENCIES[away]), rtol=1e-3)


@pytest.mark.parametrize("quality_factor", [Q_F, 50.0])
def test_a_resonance_averaged_over_the_sample_interval(quality_factor):
    found = np.asarray(aj.Resonance(SIGMA, F_R, quality_factor).sampled_psd(FREQUENCIES, RATE))
    np.testing.assert_allclose(found, alias_sum(resonance(quality_factor), FREQUENCIES, 4.0), rtol=1e-2)


@pytest.mark.parametrize(
    "term", [aj.DriftRamp(R), aj.Sinusoid(1e-3, 0.37), aj.Sinusoid(1e-3, 0.37).sampled(RATE)]
)
def test_deterministic_terms_have_no_density(term):
    np.testing.assert_array_equal(term.sampled_psd(FREQUENCIES.reshape(-1, 1), RATE), np.zeros((13, 1)))


def test_a_model_adds_its_terms_up():
    terms = [
        aj.AngleRandomWalk(N),
        aj.RateRandomWalk(K),
        aj.Markov(Q_C, T_C),
        FlickerAngle(F),
        aj.DriftRamp(R),
    ]
    model = aj.Model(tuple(terms))
    each = [np.asarray(term.sampled_psd(FREQUENCIES, RATE)) for term in terms]
    np.testing.assert_allclose(model.sampled_psd(FREQUENCIES, RATE), np.sum(each, axis=0), rtol=1e-13)
    with pytest.raises(aj.AllanjaxError, match="angle_random_walk has no value"):
        aj.Model((aj.AngleRandomWalk(),)).sampled_psd(FREQUENCIES, RATE)


def test_shapes_are_those_of_the_frequencies():
    for term in (FlickerAngle(F), aj.BiasInstability(B, 0.8), aj.AngleRandomWalk(N)):
        flat = np.asarray(term.sampled_psd(FREQUENCIES, RATE))
        column = np.asarray(term.sampled_psd(FREQUENCIES.reshape(13, 1), RATE))
        np.testing.assert_allclose(column, flat[:, None], rtol=1e-12)
    assert aj.AngleRandomWalk(N).sampled_psd(0.3, RATE).shape == ()
    assert FlickerAngle(F).sampled_psd(0.3, RATE).shape == ()


@pytest.mark.parametrize("correlation_time", [0.02, 0.4, T_C, 300.0])
def test_the_density_integrates_to_the_variance_of_interval_means(correlation_time):
    """∬ of the autocovariance σ² e^{−|t−s|/T_c} over a sample interval; both by quadrature."""
    term = aj.Markov(Q_C, correlation_time)
    h, variance = 1.0 / RATE, Q_C**2 * correlation_time / 2.0
    lags, _ = integrate.quad(lambda t: 2.0 * (h - t) * np.exp(-t / correlation_time), 0.0, h, epsrel=1e-12)
    # Uniform steps in asinh(f·T_c) spread the bump evenly.
    y, w = np.polynomial.legendre.leggauss(400)
    end = np.arcsinh(RATE / 2.0 * correlation_time * 2.0 * np.pi)
    y, w = end * (y + 1.0) / 2.0, end * w / 2.0
    scale = 1.0 / (2.0 * np.pi * correlation_time)
    power = 2.0 * np.sum(w * np.cosh(y) * scale * np.asarray(term.sampled_psd(np.sinh(y) * scale, RATE)))
    assert power == pytest.approx(variance * lags / h**2, rel=1e-9)


def test_quantization_without_a_sample_interval_says_what_to_do():
    with pytest.raises(aj.AllanjaxError, match=r"model\.sampled\(rate\)\.psd"):
        aj.SENSORS["cimu"]["gyro_x"].model.psd(1.0)
    assert float(aj.SENSORS["cimu"]["gyro_x"].model.sampled(200.0).psd(1.0)) > 0.0

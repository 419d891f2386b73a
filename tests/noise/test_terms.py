"""Noise terms: Allan variances in closed form (mpmath), spectra by definition, and G by the dense covariance.

Errata of the thesis that matter here: Ci in (4.44) lacks a minus sign; the PSD (4.63) of a line is twice what
(4.64) takes; (4.48) needs the Ci of (4.46).
"""

import math

import dense
import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
import pytest
from noise_terms import DETERMINISTIC, RANDOM, RATE, TERMS, TRANSIENT
from scipy.fft import dct
from scipy.integrate import quad
from scipy.stats import norm

import allanjax as aj

# (4.60) subtracts nearly equal numbers at T ≪ T_c: 50 digits leave enough.
mp.mp.dps = 50
# From far below to far above all characteristic times. Flicker with a cutoff changes its formula about 0.5 s.
TIMES = np.array([1e-4, 3e-3, 0.05, 0.3, 0.5, 1.0, 2.7, 9.0, 41.0, 700.0, 20001.0])


# --- Closed forms of the continuous rate --------------------------------------------------------------------


def eq_4_48(term, T):
    x = mp.pi * mp.mpf(term.cutoff_frequency) * T
    tail = mp.sin(x) ** 3 / (2 * x**2) * (mp.sin(x) + 4 * x * mp.cos(x))
    return 2 * mp.mpf(term.coefficient) ** 2 / mp.pi * (mp.log(2) - tail + mp.ci(2 * x) - mp.ci(4 * x))


def eq_4_60(term, T):
    tc = mp.mpf(term.correlation_time)
    bracket = 3 - 4 * mp.exp(-T / tc) + mp.exp(-2 * T / tc)
    return (mp.mpf(term.amplitude) * tc) ** 2 / T * (1 - tc / (2 * T) * bracket)


def eq_4_64(term, T):
    x = mp.pi * mp.mpf(term.frequency) * T
    return (mp.mpf(term.amplitude) * mp.sin(x) ** 2 / x) ** 2


def power_law(term, T):
    """(4.25) of A²f^(−α): ∫ u^(−s)(3/8 − cos(2u)/2 + cos(4u)/8) du, s = α + 2, continued from Mellin's."""
    s = mp.mpf(term.exponent) + 2
    waves = (-(mp.mpf(2) ** (s - 1)) / 2 + mp.mpf(4) ** (s - 1) / 8) * mp.gamma(1 - s) * mp.sin(mp.pi * s / 2)
    return 4 * mp.mpf(term.amplitude) ** 2 / (mp.pi * T) * (mp.pi * T) ** (s - 2) * waves


def of_exponential(weight, pole, T):
    """σ² = [4D(T) − D(2T)]/2T², D(T) = Var θ(T) = 2∫(T − t)R(t) dt, for R(t) = Re[weight·e^{pole·t}]."""

    def spread(t):
        return 2 * mp.re(weight * (mp.exp(pole * t) - 1 - pole * t) / pole**2)

    return (4 * spread(T) - spread(2 * T)) / (2 * T**2)


def oscillator(power, f0, Q):
    """Closed form of an oscillator, whose R is power·Re[(1 − ia/ω_d)·e^{(−a + iω_d)t}]."""
    w0 = 2 * mp.pi * mp.mpf(f0)
    a = w0 / (2 * mp.mpf(Q))
    wd = mp.sqrt(w0**2 - a**2)
    return lambda T: of_exponential(power * (1 - 1j * a / wd), mp.mpc(-a, wd), T)


def low_pass(term, T):
    w, N2 = 2 * mp.pi * mp.mpf(term.bandwidth), mp.mpf(term.coefficient) ** 2
    if term.order == 1:
        return of_exponential(N2 * w / 2, -w, T)
    return oscillator(N2 * w / mp.sqrt(8), term.bandwidth, mp.sqrt(0.5))(T)


def resonance(term, T):
    return oscillator(mp.mpf(term.amplitude) ** 2, term.frequency, term.quality_factor)(T)


def square(x):
    return mp.mpf(x) ** 2


CLOSED = {
    "quantization": lambda t, T: 3 * square(t.coefficient) / T**2,  # (4.29)
    "white": lambda t, T: square(t.coefficient) / T,  # (4.36)
    "flicker": lambda t, T: 2 * mp.log(2) / mp.pi * square(t.coefficient),  # (4.50)
    "flicker to 0.9 Hz": eq_4_48,
    "flicker to 70 Hz": eq_4_48,
    "walk": lambda t, T: square(t.coefficient) * T / 3,  # (4.53)
    "ramp": lambda t, T: square(t.coefficient * T) / 2,  # (4.56)
    "markov": eq_4_60,
    "short markov": eq_4_60,
    "long markov": eq_4_60,
    "line": eq_4_64,
    "resonance": resonance,
    "damped resonance": resonance,
    "low pass": low_pass,
    "low pass of order 2": low_pass,
    "telegraph": lambda t, T: of_exponential(square(t.amplitude) / 4, -2 / mp.mpf(t.dwell_time), T),
    **{name: power_law for name in RANDOM if name.startswith("power law")},
}


@pytest.mark.parametrize("name", CLOSED)
def test_allan_variance_is_the_closed_form(name):
    """One call, as a curve is drawn, and cluster time by cluster time."""
    term = TERMS[name]
    expected = [float(CLOSED[name](term, mp.mpf(T))) for T in TIMES]
    np.testing.assert_allclose(term.allan_variance(TIMES), expected, rtol=1e-8)
    np.testing.assert_allclose([float(term.allan_variance(T)) for T in TIMES], expected, rtol=1e-8)


def test_whole_exponents_are_the_classical_terms():
    """At α = 1 the law has a limit of its own, near it a gauge of its own."""
    A, T, f = 3.1e-4, np.geomspace(1e-3, 1e4, 9), np.array([1e-4, 0.3, 11.0, 19.9])
    classical = {
        0.0: aj.AngleRandomWalk(A),
        1.0: aj.BiasInstability(math.sqrt(2.0 * math.pi) * A),
        1.0 + 1e-9: aj.BiasInstability(math.sqrt(2.0 * math.pi) * A),
        2.0: aj.RateRandomWalk(2.0 * math.pi * A),
    }
    for exponent, term in classical.items():
        law = aj.PowerLaw(A, exponent)
        np.testing.assert_allclose(law.allan_variance(T), term.allan_variance(T), rtol=1e-7)
        np.testing.assert_allclose(law.psd(f), term.psd(f), rtol=1e-7)
        np.testing.assert_allclose(law.sampled_psd(f, RATE), term.sampled_psd(f, RATE), rtol=1e-7)


# --- Spectra ------------------------------------------------------------------------------------------------


def oscillator_psd(f, sigma, f0, Q):
    return 2.0 * sigma**2 / (2.0 * np.pi * f0 * Q) / ((1.0 - (f / f0) ** 2) ** 2 + (f / f0 / Q) ** 2)


# Two-sided, of the continuous rate, and the power of f with which they fall; of quantization (4.28).
PSD = {
    "quantization": (lambda t, f: 4.0 * t.coefficient**2 * RATE * np.sin(np.pi * f / RATE) ** 2, None),
    "white": (lambda t, f: t.coefficient**2 + 0.0 * f, 0.0),  # (4.31)
    "flicker": (lambda t, f: t.coefficient**2 / (2.0 * np.pi * f), 1.0),  # (4.38)
    "flicker to 0.9 Hz": (lambda t, f: (f <= 0.9) * t.coefficient**2 / (2.0 * np.pi * f), math.inf),
    "flicker to 70 Hz": (lambda t, f: (f <= 70.0) * t.coefficient**2 / (2.0 * np.pi * f), math.inf),
    "walk": (lambda t, f: (t.coefficient / (2.0 * np.pi * f)) ** 2, 2.0),  # (4.52)
    "markov": (lambda t, f: (t.amplitude * 8.0) ** 2 / (1.0 + (2.0 * np.pi * f * 8.0) ** 2), 2.0),  # (4.59)
    "short markov": (lambda t, f: (t.amplitude * 3e-3) ** 2 / (1.0 + (2.0 * np.pi * f * 3e-3) ** 2), 2.0),
    "ramp": (lambda t, f: t.coefficient**2 / (2.0 * np.pi * f) ** 3, None),  # (4.58)
    "line": (lambda t, f: 0.0 * f, None),
    "resonance": (lambda t, f: oscillator_psd(f, t.amplitude, 5.3, 12.0), 4.0),
    "damped resonance": (lambda t, f: oscillator_psd(f, t.amplitude, 0.7, 0.6), 4.0),
    "low pass": (lambda t, f: t.coefficient**2 / (1.0 + (f / 2.2) ** 2), None),
    "low pass of order 2": (lambda t, f: t.coefficient**2 / (1.0 + (f / 3.1) ** 4), None),
    "telegraph": (lambda t, f: (t.amplitude / 2.0) ** 2 * 0.3 / (1.0 + (np.pi * f * 0.3) ** 2), None),
    **{
        name: (lambda t, f: t.amplitude**2 * f ** -float(t.exponent), float(term.exponent))
        for name, term in RANDOM.items()
        if name.startswith("power law")
    },
}


def test_psd_is_the_law():
    f = np.array([1e-4, 0.013, 0.31, 0.9, 1.1, 5.0, 5.5, 17.0, 71.0, 1003.0])
    for name, (law, _) in PSD.items():
        term = TERMS[name].sampled(RATE) if name == "quantization" else TERMS[name]
        np.testing.assert_allclose(term.psd(f), law(term, f), rtol=1e-10, err_msg=name)
        np.testing.assert_allclose(term.psd(-f[2]), law(term, f[2]), rtol=1e-10, err_msg=name)


def test_a_wandering_resonance_is_the_mean_over_its_frequencies():
    """By adaptive integration over the normal law; eleven nodes are right to half a per cent."""
    term, f = RANDOM["wandering resonance"], np.array([2.0, 6.1, 6.8, 7.0, 7.3, 8.2, 15.0])
    expected = [
        quad(
            lambda x, f=f: norm.pdf(x) * oscillator_psd(f, term.amplitude, 7.0 + 0.3 * x, 9.0),
            -8.0,
            8.0,
            limit=200,
        )[0]
        for f in f
    ]
    np.testing.assert_allclose(term.psd(f), expected, rtol=5e-3)
    still, one = aj.WanderingResonance(2.0, 7.0, 9.0, 1e-9), aj.Resonance(2.0, 7.0, 9.0)
    np.testing.assert_allclose(still.allan_variance(TIMES), one.allan_variance(TIMES), rtol=1e-8)
    np.testing.assert_allclose(still.sampled_psd(f, RATE), one.sampled_psd(f, RATE), rtol=1e-8)


def alias_sum(psd, f, falls, aliases=4000):
    """Sum of S(f + m·rate)·sinc²((f + m·rate)/rate), the tails as integrals of the power f^−falls.

    The midpoint rule errs by a relative (falls + 2)²/(24·aliases²) of a tail below 1/aliases of the sum.
    """
    u = f[:, None] / RATE + np.arange(-aliases, aliases + 1)
    total = np.sum(psd(np.abs(u) * RATE) * np.sinc(u) ** 2, axis=1)
    for side in (1.0, -1.0):
        end = aliases + 0.5 + side * f / RATE
        total += psd(end * RATE) * (np.sin(np.pi * f / RATE) / np.pi) ** 2 / end / (falls + 1.0)
    return total


# Up to just below half the rate, away from the edge of cut-off flicker's alias.
FREQUENCIES = RATE * np.array([5.2e-6, 5e-5, 7e-4, 3.1e-3, 0.011, 0.063, 0.13, 0.21, 0.29, 0.45, 0.499])


def test_psd_of_means_is_the_sum_over_aliases():
    """Of what is averaged over the sample interval. A resonance sums eight aliases, to 10⁻⁴ or better."""
    for name, (law, falls) in PSD.items():
        if falls is not None:
            expected = alias_sum(lambda f, name=name, law=law: law(TERMS[name], f), FREQUENCIES, falls)
            found = TERMS[name].sampled_psd(FREQUENCIES, RATE)
            rtol = 1e-4 if "resonance" in name else 1e-7
            np.testing.assert_allclose(found, expected, rtol=rtol, err_msg=name)


def test_psd_of_deterministic_terms_is_zero():
    for term in (DETERMINISTIC | TRANSIENT).values():
        assert not np.any(term.sampled_psd(FREQUENCIES, RATE))
        assert term.sampled_psd(FREQUENCIES[:, None], RATE).shape == (len(FREQUENCIES), 1)


def test_infinite_densities_at_zero_give_no_warning(recwarn):
    for f in (0.0, np.array([0.0, 1.0]), [0.0, 1.0]):
        for name in ("walk", "flicker", "ramp", "power law 2.6"):
            assert np.isinf(np.ravel(TERMS[name].psd(f))[0])
    assert not [w for w in recwarn if issubclass(w.category, RuntimeWarning)]


# --- Samples: everything from the dense covariance by G -----------------------------------------------------

N = 96


def dense_of(term):
    return dense.covariance(term, N, RATE)


@pytest.mark.parametrize("name", TERMS)
def test_g_is_that_of_the_dense_covariance(name):
    """Third differences of G are free of its gauge; Allan and Hadamard variances at clusters of samples."""
    term, C = TERMS[name].sampled(RATE), dense_of(TERMS[name])
    G = np.asarray(term.phase_covariance(np.arange(N + 1) / RATE))
    found = -np.diff(np.concatenate([G[1:2], G]), 2) * RATE**2
    scale = np.abs(np.diff(C[0])).max()
    np.testing.assert_allclose(np.diff(found), np.diff(C[0]), rtol=1e-7, atol=1e-8 * scale)
    for m in (1, 2, 5, 31):
        assert float(term.allan_variance(m / RATE)) == pytest.approx(dense.allan_variance(C, m), rel=1e-8)
        third = np.repeat([1.0, -2.0, 1.0], m) / m
        expected = third @ C[: 3 * m, : 3 * m] @ third / 6.0
        # A ramp has none, but for the rounding of 30·T² in G.
        tolerance = 1e-12 * abs(C).max() if name != "ramp" else 1e-12 * (term.coefficient * 3 * m / RATE) ** 2
        assert float(term.hadamard_variance(m / RATE)) == pytest.approx(expected, rel=1e-7, abs=tolerance)


def panels():
    """Frequencies and weights for integrals of densities up to half the rate, to f^−0.6 near zero."""
    x, w = np.polynomial.legendre.leggauss(16)
    breaks = [0.0, *np.geomspace(1e-40, 1e-3, 220), *np.linspace(1e-3, 0.5, 1500)]
    edges = np.unique([*breaks, 0.9 / RATE, 10.0 / RATE]) * RATE
    f = edges[:-1, None] + np.diff(edges)[:, None] * (x + 1.0) / 2.0
    return f.ravel(), (np.diff(edges)[:, None] * w / 2.0).ravel()


@pytest.mark.parametrize("name", RANDOM)
def test_the_density_of_samples_integrates_to_their_allan_variance(name):
    """The differences of sums of m samples have the response 2 sin⁴(ma)/(m sin a)², a = πf/rate.

    A deterministic term has no density, a transient no G: they are told of elsewhere.
    """
    term, C = RANDOM[name].sampled(RATE), dense_of(RANDOM[name])
    f, weight = panels()
    density, a = term.sampled_psd(f, RATE), np.pi * f / RATE
    for m in (1, 3, 16):
        found = 2.0 * np.sum(weight * density * 2.0 * np.sin(m * a) ** 4 / (m * np.sin(a)) ** 2)
        assert found == pytest.approx(dense.allan_variance(C, m), rel=1e-8)


@pytest.mark.parametrize(
    "name", ["resonance", "wandering resonance", "low pass", "telegraph", "low pass of order 2"]
)
def test_means_of_readings_have_their_own_density(name):
    """Records that are averaged over four readings: of what is read at instants, R of means of four."""
    M, n, f = 4, 3000, np.array([1e-3, 0.4, 1.3, 2.9, 4.99])
    R = dense.of_samples(RANDOM[name], n + M, RATE)
    triangle = (M - abs(np.arange(-M + 1, M))) / M**2
    both = np.concatenate([R[M - 1 : 0 : -1], R])
    means = np.convolve(both, triangle, "valid")[:n:M]
    twice = np.where(np.arange(len(means)) > 0, 2.0, 1.0) * means
    expected = twice @ np.cos(2.0 * np.pi * np.outer(np.arange(len(means)), f) * M / RATE) * M / RATE
    found = RANDOM[name].sampled(RATE).sampled_psd(f, RATE / M)
    np.testing.assert_allclose(found, expected, rtol=1e-7)


def test_so_has_what_remembers_far_longer_than_a_reading():
    """R of means is a geometric series from the first lag on: in mpmath, of one, two and five readings."""
    term, f = aj.Telegraph(2.0, 7e3), np.array([1e-5, 0.3, 3.9])
    for M in (1, 2, 5):
        q, S = mp.exp(-2 / (mp.mpf(RATE) * 7000)), []
        r_0 = sum(q ** abs(i - j) for i in range(M) for j in range(M)) / M**2
        r_1 = sum(q ** (M + i - j) for i in range(M) for j in range(M)) / M**2
        for x in f:
            turn = mp.expjpi(2 * mp.mpf(float(x)) * M / mp.mpf(RATE))
            S.append(float((r_0 + 2 * mp.re(r_1 * turn / (1 - q**M * turn))) * M / mp.mpf(RATE)))
        np.testing.assert_allclose(term.sampled(RATE).sampled_psd(f, RATE / M), S, rtol=1e-8)


def test_the_ends_of_a_record_add_to_its_cosine_spectrum():
    """Expected squares of the cosine transform of first differences, from their dense covariance."""
    term, n = RANDOM["quantization"], 64
    transform = dct(np.eye(n), axis=0, norm="ortho")
    expected = np.diag(transform @ dense.covariance(term, n, RATE) @ transform.T)
    f = np.arange(n) * RATE / (2.0 * n)
    found = RATE * term.sampled_psd(f, RATE) + term.end_effect(f, RATE) / n
    np.testing.assert_allclose(found[1:], expected[1:], rtol=1e-10)
    assert not np.any(RANDOM["walk"].end_effect(f, RATE))


@pytest.mark.parametrize("spread", [None, 0.3])
def test_the_mean_square_scatters_as_power_scatter_says(spread):
    """Var = 2ΣΣR²/n² for Gaussian noise. The formula is one for 1/Q_f² ≪ 1, here a hundredth.

    A wandering resonance is eleven oscillators, each of which scatters by itself.
    """
    n, (nodes, weights) = 40_000, np.polynomial.hermite_e.hermegauss(11)
    term, frequencies, shares = aj.Resonance(2.0, 7.0, 9.0), np.array([7.0]), np.ones(1)
    if spread:
        term = aj.WanderingResonance(2.0, 7.0, 9.0, spread)
        frequencies, shares = 7.0 + spread * nodes, weights / weights.sum()
    each = [dense.oscillator(np.arange(n) / RATE, f, 9.0) for f in frequencies]
    squares = sum(s**2 * R**2 for s, R in zip(shares, each, strict=True))
    expected = 2.0 * (2.0 * np.sum((n - np.arange(n)) * squares) - n * squares[0]) / n**2
    assert float(term.power_scatter(n / RATE)) == pytest.approx(expected, rel=0.02)


def test_transients_are_their_columns():
    t = np.arange(9) / 2.0 + 0.25
    np.testing.assert_allclose(aj.BiasStep(2.0, 1.25).column(t), t >= 1.25)
    np.testing.assert_allclose(aj.BiasStep(2.0, 1.3, sign=-1).column(t), -1.0 * (t > 1.3))
    np.testing.assert_allclose(aj.WarmUp(2.0, 1.3, sign=-1).column(t), -np.exp(-t / 1.3))
    np.testing.assert_allclose(aj.DriftRamp(2.0, sign=-1).column(t), -t)
    # Read at the middle of each sample's interval, 0.4 s late: −3·(channel − 20), constant before its first.
    samples = np.array([20.0, 24.0, 22.0, 30.0])
    effect = aj.ChannelEffect(1.0, lag=0.4, sign=-1, channel="temperature", reference=20.0)
    assert effect.missing_channel == "temperature"
    assert effect.given({"pressure": samples}, 1.0) == effect
    given = effect.given({"temperature": samples}, 0.5)
    assert given.missing_channel == ""
    expected = 20.0 - np.interp(t - 0.4, [1.0, 3.0, 5.0, 7.0], samples)
    np.testing.assert_allclose(given.column(t), expected, atol=1e-12)
    for term in TRANSIENT.values():
        assert not np.any(term.allan_variance(t))
        assert not np.any(term.psd(t))


# --- Terms of a user's own ----------------------------------------------------------------------------------


class HalfFlicker(aj.NoiseTerm):
    """S(f) ∝ f^(−1/2), as a user would write it: G is −H²·t^1.5."""

    coefficient: float | None = aj.parameter("H", time_exponent=0.25)

    def phase_covariance(self, lag):
        return -(self.coefficient**2) * jnp.where(lag > 0.0, lag, 1.0) ** 1.5 * (lag > 0.0)


def test_a_users_term_needs_no_more_than_g():
    """Its PSD is −2H²Γ(2.5)cos(2.5π/2)/√(2πf), and that of its samples is summed from G to 10⁻⁴."""
    H = 3.7e-5
    scale = -2.0 * H**2 * math.gamma(2.5) * math.cos(1.25 * math.pi) / math.sqrt(2.0 * math.pi)
    law, term = aj.PowerLaw(math.sqrt(scale), 0.5), HalfFlicker(H)

    @jax.jit
    def found(T, f):
        """NumPy's numbers of a compiled function, and JAX's."""
        curve = (aj.AngleRandomWalk(1e-5) + term).allan_variance
        return term.allan_variance(TIMES), curve(T), term.hadamard_variance(T), term.sampled_psd(f, RATE)

    own, summed, third, samples = found(TIMES, FREQUENCIES)
    np.testing.assert_allclose(own, law.allan_variance(TIMES), rtol=1e-9)
    np.testing.assert_allclose(summed, law.allan_variance(TIMES) + 1e-10 / TIMES, rtol=1e-9)
    np.testing.assert_allclose(third, law.hadamard_variance(TIMES), rtol=1e-9)
    expected = alias_sum(lambda f: scale / np.sqrt(f), FREQUENCIES, 0.5)
    np.testing.assert_allclose(samples, expected, rtol=1e-4)
    assert [(p.name, p.symbol, p.time_exponent) for p in term.parameters()] == [("coefficient", "H", 0.25)]
    assert (aj.AngleRandomWalk(1.0) + term).term_labels == ("angle_random_walk", "half_flicker")


def test_a_term_that_lacks_something_says_what():
    class Nameless(aj.NoiseTerm):
        time: float | None = aj.parameter("τ", "time")

    class Empty(aj.NoiseTerm):
        coefficient: float | None = aj.parameter("c")

    with pytest.raises(aj.AllanjaxError, match="amplitude"):
        Nameless()
    for call in (
        lambda: Empty(1.0).allan_variance(1.0),
        lambda: Empty(1.0).psd(1.0),
        lambda: Empty(1.0).column(1.0),
    ):
        with pytest.raises(NotImplementedError, match="Empty"):
            call()

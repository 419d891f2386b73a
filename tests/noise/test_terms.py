"""Noise terms: Allan variances by theory's G (mpmath), spectra by definition, G by the dense covariance."""

import functools
import math

import dense
import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
import pytest
from compilations import compilations
from noise_terms import OTHER_VALUES, RANDOM, RATE, RESPONSES, TERMS, TRANSIENT, by_slots, finite
from numpy.testing import assert_allclose, assert_array_equal
from scipy.fft import dct
from scipy.stats import norm

import allanjax as aj

# (4.60) subtracts nearly equal numbers at T ≪ T_c: 50 digits leave enough.
mp.mp.dps = 50
# From far below to far above all characteristic times. Flicker with a cutoff changes its formula about 0.5 s.
TIMES = np.array([1e-4, 3e-3, 0.05, 0.3, 0.5, 1.0, 2.7, 9.0, 41.0, 700.0, 20001.0])


def of_exponential(weight, pole):
    """G(T) = −∫(T − t)R(t) dt for R(t) = Re[weight·e^{pole·t}]."""
    return lambda T: -mp.re(weight * (mp.exp(pole * T) - 1 - pole * T) / pole**2)


def oscillator(power, f0, Q):
    """R of an oscillator is power·Re[(1 − ia/ω_d)·e^{(−a + iω_d)t}]."""
    w0 = 2 * mp.pi * mp.mpf(f0)
    a = w0 / 2 / mp.mpf(Q)
    wd = mp.sqrt(w0**2 - a**2)
    return power * (1 - 1j * a / wd), mp.mpc(-a, wd)


def low_pass(term):
    w, N2 = 2 * mp.pi * mp.mpf(term.bandwidth), mp.mpf(term.coefficient) ** 2
    two = oscillator(N2 * w / mp.sqrt(8), term.bandwidth, mp.sqrt(0.5))
    return two if term.order == 2 else (N2 * w / 2, -w)


# Weight and pole of what is read at instants.
EXPONENTIALS = {
    aj.Sinusoid: lambda t: (mp.mpf(t.amplitude) ** 2 / 2, 2j * mp.pi * mp.mpf(t.frequency)),
    aj.Resonance: lambda t: oscillator(mp.mpf(t.amplitude) ** 2, t.frequency, t.quality_factor),
    aj.LowPass: low_pass,
    aj.Telegraph: lambda t: (mp.mpf(t.amplitude) ** 2 / 4, -2 / mp.mpf(t.dwell_time)),
}


def allan_variance(term, T):
    """σ² = (3G(0) − 4G(T) + G(2T))/T² of the continuous rate."""
    kind = type(term)
    own = of_exponential(*EXPONENTIALS[kind](term)) if kind in EXPONENTIALS else None
    G = own or dense.PHASE[kind.__name__](term)
    return (3 * G(mp.mpf(0)) - 4 * G(T) + G(2 * T)) / T**2


def oscillator_psd(f, sigma, f0, Q):
    return sigma**2 / (np.pi * f0 * Q) / ((1.0 - (f / f0) ** 2) ** 2 + (f / f0 / Q) ** 2)


# Two-sided, of the continuous rate; of quantization (4.28).
PSD = {
    aj.Quantization: lambda t, f: 4.0 * t.coefficient**2 * RATE * np.sin(np.pi * f / RATE) ** 2,
    aj.AngleRandomWalk: lambda t, f: t.coefficient**2 + 0.0 * f,  # (4.31)
    aj.BiasInstability: lambda t, f: (f <= t.cutoff_frequency) * t.coefficient**2 / (2.0 * np.pi * f),
    aj.RateRandomWalk: lambda t, f: (t.coefficient / (2.0 * np.pi * f)) ** 2,  # (4.52)
    aj.DriftRamp: lambda t, f: t.coefficient**2 / (2.0 * np.pi * f) ** 3,  # (4.58)
    aj.Markov: lambda t, f: t.amplitude**2 / (1.0 / t.correlation_time**2 + (2.0 * np.pi * f) ** 2),
    aj.Sinusoid: lambda t, f: 0.0 * f,
    aj.Resonance: lambda t, f: oscillator_psd(f, t.amplitude, t.frequency, t.quality_factor),
    aj.LowPass: lambda t, f: t.coefficient**2 / (1.0 + (f / t.bandwidth) ** (2 * t.order)),
    aj.Telegraph: lambda t, f: t.amplitude**2 / (4.0 / t.dwell_time + t.dwell_time * (2.0 * np.pi * f) ** 2),
    aj.PowerLaw: lambda t, f: t.amplitude**2 * f ** -float(t.exponent),
}
# The power of f with which the density falls of what is averaged over the sample interval.
FALLS = {aj.AngleRandomWalk: 0.0, aj.BiasInstability: 1.0, aj.RateRandomWalk: 2.0, aj.Markov: 2.0}
FALLS |= {aj.Resonance: 4.0}


def alias_sum(psd, f, falls, aliases=4000):
    """Sum of S(f + m·rate)·sinc²((f + m·rate)/rate), the tails as integrals of the power f^−falls."""
    u = f[:, None] / RATE + np.arange(-aliases, aliases + 1)
    total = np.sum(psd(np.abs(u) * RATE) * np.sinc(u) ** 2, axis=1)
    for side in (1.0, -1.0):
        end = aliases + 0.5 + side * f / RATE
        total += psd(end * RATE) * (np.sin(np.pi * f / RATE) / np.pi) ** 2 / end / (falls + 1.0)
    return total


# Up to just below half the rate, away from the edge of cut-off flicker's alias.
FREQUENCIES = RATE * np.array([5.2e-6, 5e-5, 7e-4, 3.1e-3, 0.011, 0.063, 0.13, 0.21, 0.29, 0.45, 0.499])


@pytest.mark.parametrize("name", [name for name, term in TERMS.items() if type(term) in PSD])
def test_curves_are_the_closed_forms(name):
    """Of Allan variances and densities; a resonance sums eight aliases, to 10⁻⁴ or better."""
    term, kind = TERMS[name], type(TERMS[name])
    expected = [float(allan_variance(term, mp.mpf(T))) for T in TIMES]
    for found in (term.allan_variance(TIMES), [term.allan_variance(T) for T in TIMES]):
        assert_allclose(found, expected, rtol=1e-8)
    f = np.array([1e-4, 0.013, 0.31, 0.9, 1.1, 5.0, 5.5, 17.0, 71.0, 1003.0])
    seen = term.sampled(RATE) if kind is aj.Quantization else term
    assert_allclose(seen.psd(f), PSD[kind](term, f), rtol=1e-10)
    assert_allclose(seen.psd(-f[2]), PSD[kind](term, f[2]), rtol=1e-10)
    falls = math.inf if name.startswith("flicker to") else FALLS.get(kind, getattr(term, "exponent", None))
    if falls is not None:
        summed = alias_sum(lambda f: PSD[kind](term, f), FREQUENCIES, float(falls))
        assert_allclose(term.sampled_psd(FREQUENCIES, RATE), summed, rtol=1e-4 if falls == 4.0 else 1e-7)


def test_whole_exponents_are_the_classical_terms():
    """At α = 1 the law has a limit of its own, near it a gauge of its own."""
    A, f = 3.1e-4, np.array([1e-4, 0.3, 11.0, 19.9])
    flicker = aj.BiasInstability(math.sqrt(2.0 * math.pi) * A)
    classical = {0.0: aj.AngleRandomWalk(A), 1.0: flicker, 1.0 + 1e-9: flicker}
    for exponent, term in (classical | {2.0: aj.RateRandomWalk(2.0 * math.pi * A)}).items():
        law = aj.PowerLaw(A, exponent)
        assert_allclose(law.allan_variance(TIMES), term.allan_variance(TIMES), rtol=1e-7)
        assert_allclose(law.psd(f), term.psd(f), rtol=1e-7)
        assert_allclose(law.sampled_psd(f, RATE), term.sampled_psd(f, RATE), rtol=1e-7)


def test_a_wandering_resonance_is_the_mean_over_its_frequencies():
    """Over the normal law to ±8 σ; the oscillators are right to half a per cent."""
    f, (x, w) = np.array([2.0, 6.1, 6.8, 7.0, 7.3, 8.2, 15.0]), np.polynomial.legendre.leggauss(400)
    expected = 8.0 * oscillator_psd(f[:, None], 1.3e-4, 7.0 + 0.3 * 8.0 * x, 9.0) @ (w * norm.pdf(8.0 * x))
    assert_allclose(RANDOM["wandering resonance"].psd(f), expected, rtol=5e-3)
    still, one = aj.WanderingResonance(2.0, 7.0, 9.0, 1e-9), aj.Resonance(2.0, 7.0, 9.0)
    assert_allclose(still.allan_variance(TIMES), one.allan_variance(TIMES), rtol=1e-8)
    assert_allclose(still.sampled_psd(f, RATE), one.sampled_psd(f, RATE), rtol=1e-8)


def test_infinite_densities_at_zero_give_no_warning(recwarn):
    for name in ("walk", "flicker", "ramp", "power law 2.6"):
        assert all(np.isinf(np.ravel(TERMS[name].psd(f))[0]) for f in (0.0, [0.0, 1.0]))
    assert not recwarn.list


@pytest.mark.parametrize("name", TERMS)
def test_samples_have_the_dense_covariance(name):
    """Third differences of G are free of its gauge; Allan and Hadamard variances at clusters of samples."""
    term, C = TERMS[name].sampled(RATE), dense.covariance(TERMS[name], 96, RATE)
    G = np.asarray(term.phase_covariance(np.arange(97) / RATE))
    found = -np.diff(np.concatenate([G[1:2], G]), 2) * RATE**2
    scale = np.abs(np.diff(C[0])).max()
    assert_allclose(np.diff(found), np.diff(C[0]), rtol=1e-7, atol=1e-8 * scale)
    for m in (1, 2, 5, 31):
        assert term.allan_variance(m / RATE) == pytest.approx(dense.allan_variance(C, m), rel=1e-8)
        third = np.repeat([1.0, -2.0, 1.0], m) / m
        expected = third @ C[: 3 * m, : 3 * m] @ third / 6.0
        # A ramp has none, but for the rounding of 30·T² in G.
        tolerance = 1e-12 * abs(C).max() if name != "ramp" else 1e-12 * (term.coefficient * 3 * m / RATE) ** 2
        assert term.hadamard_variance(m / RATE) == pytest.approx(expected, rel=1e-7, abs=tolerance)


def test_means_of_readings_have_their_own_density():
    """Records that are averaged over four readings: of what is read at instants, R of means of four."""
    M, n, f = 4, 3000, np.array([1e-3, 0.4, 1.3, 2.9, 4.99])
    triangle = (M - abs(np.arange(-M + 1, M))) / M**2
    lag = np.arange(n // M) * M
    for name in ("resonance", "wandering resonance", "low pass", "telegraph", "low pass of order 2"):
        R = dense.of_samples(RANDOM[name], n + M, RATE)
        means = np.convolve(np.concatenate([R[M - 1 : 0 : -1], R]), triangle, "valid")[:n:M]
        expected = np.where(lag, 2.0, 1.0) * means @ np.cos(2.0 * np.pi * np.outer(lag, f) / RATE) * M / RATE
        found = RANDOM[name].sampled(RATE).sampled_psd(f, RATE / M)
        assert_allclose(found, expected, rtol=1e-7, err_msg=name)


def test_so_has_what_remembers_far_longer_than_a_reading():
    """R of means is a geometric series from the first lag on: in mpmath, of five readings."""
    M, q, found = 5, mp.exp(-2 / (mp.mpf(RATE) * 7000)), aj.Telegraph(2.0, 7e3).sampled(RATE)
    pairs = [i - j for i in range(M) for j in range(M)]
    r_0, r_1 = sum(q ** abs(k) for k in pairs) / M**2, sum(q ** (M + k) for k in pairs) / M**2
    for f in (1e-5, 0.3, 3.9):
        turn = mp.expjpi(2 * mp.mpf(f) * M / mp.mpf(RATE))
        expected = (r_0 + 2 * mp.re(r_1 * turn / (1 - q**M * turn))) * M / mp.mpf(RATE)
        assert found.sampled_psd(np.array([f]), RATE / M)[0] == pytest.approx(float(expected), rel=1e-8)


def test_the_ends_of_a_record_add_to_its_cosine_spectrum():
    """Expected squares of the cosine transform of first differences, from their dense covariance."""
    term, n = RANDOM["quantization"], 64
    transform = dct(np.eye(n), axis=0, norm="ortho")
    expected = np.diag(transform @ dense.covariance(term, n, RATE) @ transform.T)
    f = np.arange(n) * RATE / (2.0 * n)
    found = RATE * term.sampled_psd(f, RATE) + term.end_effect(f, RATE) / n
    assert_allclose(found[1:], expected[1:], rtol=1e-10)
    assert not np.any(RANDOM["walk"].end_effect(f, RATE))


def test_the_mean_square_scatters_as_power_scatter_says():
    """Var = 2ΣΣR²/n²; the formula is one for 1/Q_f² ≪ 1, here a hundredth. One that wanders is several."""
    k, nodes = np.arange(40_000), np.linspace(-3.0, 3.0, 21)
    weights = norm.pdf(nodes)
    wandering = aj.WanderingResonance(2.0, 7.0, 9.0, 0.3), 7.0 + 0.3 * nodes, weights / weights.sum()
    for term, frequencies, shares in ((aj.Resonance(2.0, 7.0, 9.0), [7.0], [1.0]), wandering):
        each = zip(frequencies, shares, strict=True)
        squares = sum((share * dense.oscillator(k / RATE, f, 9.0)) ** 2 for f, share in each)
        expected = 2.0 * (2.0 * np.sum((1.0 - k / len(k)) * squares) - squares[0]) / len(k)
        assert term.power_scatter(len(k) / RATE) == pytest.approx(expected, rel=0.02)


def test_transients_are_their_columns():
    t = np.arange(9) / 2.0 + 0.25
    assert_allclose(aj.BiasStep(2.0, 1.25).column(t), t >= 1.25)
    assert_allclose(aj.BiasStep(2.0, 1.3, sign=-1).column(t), -1.0 * (t > 1.3))
    assert_allclose(aj.WarmUp(2.0, 1.3, sign=-1).column(t), -np.exp(-t / 1.3))
    assert_allclose(aj.DriftRamp(2.0, sign=-1).column(t), -t)
    # Read at the middle of each sample's interval, 0.4 s late: −3·(channel − 20), constant before its first.
    samples = np.array([20.0, 24.0, 22.0, 30.0])
    effect = aj.ChannelEffect(1.0, lag=0.4, sign=-1, channel="temperature", reference=20.0)
    assert effect.given({"pressure": samples}, 1.0) == effect
    given = effect.given({"temperature": samples}, 0.5)
    assert (effect.missing_channel, given.missing_channel) == ("temperature", "")
    assert_allclose(given.column(t), 20.0 - np.interp(t - 0.4, [1, 3, 5, 7], samples), atol=1e-12)
    for term in (term for name, term in (TERMS | TRANSIENT).items() if name not in RANDOM):
        assert_array_equal(term.sampled_psd(FREQUENCIES[:, None], RATE), np.zeros((len(FREQUENCIES), 1)))
    for term in TRANSIENT.values():
        assert not np.any([term.allan_variance(t), term.psd(t)])


class HalfFlicker(aj.NoiseTerm):
    """S(f) ∝ f^(−1/2), as a user would write it: G is −H²·t^1.5."""

    coefficient: float | None = aj.parameter("H", time_exponent=0.25)

    def phase_covariance(self, lag):
        return -(self.coefficient**2) * jnp.where(lag > 0.0, lag, 1.0) ** 1.5 * (lag > 0.0)


def test_a_users_term_needs_no_more_than_g():
    """Its PSD is −2H²Γ(2.5)cos(2.5π/2)/√(2πf), and that of its samples is summed from G to 10⁻⁴."""
    term = HalfFlicker(3.7e-5)
    scale = -2.0 * 3.7e-5**2 * math.gamma(2.5) * math.cos(1.25 * math.pi) / math.sqrt(2.0 * math.pi)
    law = aj.PowerLaw(math.sqrt(scale), 0.5)

    @jax.jit
    def found(T, f):
        curve = (aj.AngleRandomWalk(1e-5) + term).allan_variance
        return term.allan_variance(TIMES), curve(T), term.hadamard_variance(T), term.sampled_psd(f, RATE)

    *curves, samples = found(TIMES, FREQUENCIES)
    allan = law.allan_variance(TIMES)
    assert_allclose(curves, [allan, allan + 1e-10 / TIMES, law.hadamard_variance(TIMES)], rtol=1e-9)
    assert_allclose(samples, alias_sum(lambda f: scale / np.sqrt(f), FREQUENCIES, 0.5), rtol=1e-4)
    assert [(p.name, p.symbol, p.time_exponent) for p in term.parameters()] == [("coefficient", "H", 0.25)]
    assert (aj.AngleRandomWalk(1.0) + term).term_labels == ("angle_random_walk", "half_flicker")


def test_a_term_that_lacks_something_says_what():
    class Empty(aj.NoiseTerm):
        coefficient: float | None = aj.parameter("c")

    class Nameless(aj.NoiseTerm):
        time: float | None = aj.parameter("τ", "time")

    with pytest.raises(aj.AllanjaxError, match="amplitude"):
        Nameless()
    for call in (Empty(1.0).allan_variance, Empty(1.0).psd, Empty(1.0).column):
        with pytest.raises(NotImplementedError, match="Empty"):
            call(np.ones(1))


# Clusters about the times of the terms; frequencies up to half the rate.
T, F = np.array([1.0, 7.0, 330.0]) / RATE, np.array([0.013, 1.7, 17.0])
# As a fit has them: its likelihoods take the spectrum after a response.
INNER = aj.AngleRandomWalk(1e-3) + aj.Markov(1e-3, 0.7)
MODELS = {
    **{name: aj.Model((term,)).sampled(RATE) for name, term in TERMS.items()},
    **{f"{name}, continuous": aj.Model((TERMS[name],)) for name in ("line", "resonance", "low pass")},
    **{name: (filter_ * INNER).sampled(RATE) for name, filter_ in RESPONSES.items()},
}
# Without a curve that compiles: eleven oscillators, and G after a filter, which has parts of its own for each
# kind of noise; of these two are enough.
DENSITY_ONLY = {"wandering resonance", *RESPONSES} - {"two poles", "mean of 3.7"}
# A pole at zero, where G (not the power) is that of one moved by 10⁻⁵; a kink of the power at whole samples.
KINKED = "mean of 5"


def values_of(name, values, times, frequencies):
    """Allan variances, where they are compiled, densities of samples, and what the ends of a record add."""
    model, slot = MODELS[name].with_values(**values), OTHER_VALUES.get(name, name)
    found = [] if slot in DENSITY_ONLY else [model.allan_variance(times)]
    found += [model.sampled_psd(frequencies, RATE)]
    found += [term.end_effect(frequencies, RATE) for term in model.terms if name == "quantization"]
    return (jnp if isinstance(times, jax.Array) else np).concatenate(found)


@jax.jit
def compiled(given, times):
    """Values of all models and their derivatives along directions, in the logarithms of the parameters."""

    def along(name, values, directions):
        def of_logs(step):
            moved = {k: x * jnp.exp(step * directions[k]) for k, x in values.items()}
            return values_of(name, moved, times, jnp.asarray(F))

        return jax.jvp(of_logs, (0.0,), (1.0,))

    return {name: along(name, *data) for name, data in given.items()}


def run(values, directions, times=T):
    data = {name: (values[name], directions[name]) for name in values}
    return by_slots(lambda given: compiled(given, times), data)


VALUES = {name: finite(model) for name, model in MODELS.items()}
DIRECTIONS = {n: dict(zip(v, (0.3, 0.45, 0.6, 0.75, 0.9), strict=False)) for n, v in VALUES.items()}


@functools.cache
def found(of_filters):
    return run({name: v for name, v in VALUES.items() if (name in RESPONSES) == of_filters}, DIRECTIONS)


@pytest.mark.parametrize("name", MODELS)
def test_values_are_numpys_and_derivatives_those_of_differences(name):
    (value, slope), step = found(name in RESPONSES)[name], 2e-5
    with compilations() as names:
        expected, above, below = (
            values_of(name, {k: x * math.exp(s * DIRECTIONS[name][k]) for k, x in VALUES[name].items()}, T, F)
            for s in (0.0, step, -step)
        )
        assert isinstance(MODELS[name].hadamard_variance(T), np.ndarray)
    assert (names, type(expected)) == ([], np.ndarray)
    assert_allclose(value, expected, rtol=1e-9, atol=1e-13 * abs(expected).max())
    if name != KINKED:
        difference = (above - below) / (2.0 * step)
        assert_allclose(slope, difference, rtol=5e-6, atol=1e-7 * abs(expected).max())


def test_values_and_derivatives_are_finite_at_the_edges():
    """Far below and above every characteristic time, where G has other formulas; and at no noise at all."""
    for group in (set(MODELS) - set(RESPONSES), set(RESPONSES)):
        values = {name: VALUES[name] for name in MODELS if name in group}
        for times in ([1e-9] * 3, [1e-3] * 3, [1e3] * 3, [1.003e7] * 3, [1e-9, 1.0, 1.003e7]):
            for name, numbers in run(values, DIRECTIONS, np.array(times)).items():
                assert np.isfinite(numbers).all(), (name, times)
        silent = {
            name: v | {p.label: 0.0 for p in MODELS[name].parameters if p.parameter.is_amplitude}
            for name, v in values.items()
        }
        assert not any(np.any(numbers) for numbers in run(silent, DIRECTIONS).values())

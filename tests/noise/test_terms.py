"""Noise terms against the thesis's closed forms and the integral (4.25) behind them, both in mpmath.

Errata of the thesis that matter here: Ci in (4.44) lacks a minus sign; the PSD (4.63) of a line is twice what
(4.64) takes; (4.48) needs the Ci of (4.46).
"""

import math

import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
import pytest
from jax.test_util import check_grads

import allanjax  # noqa: F401  (double precision)
from allanjax.base.errors import AllanjaxError
from allanjax.noise.terms import (
    AngleRandomWalk,
    BiasInstability,
    DriftRamp,
    Markov,
    NoiseTerm,
    Quantization,
    RateRandomWalk,
    Resonance,
    Sinusoid,
    parameter,
)

# (4.60) subtracts nearly equal numbers at T ≪ T_c: 50 digits leave enough.
mp.mp.dps = 50

Q, N, B, K, R = 2.3e-6, 1.7e-4, 4.1e-5, 6.2e-6, 3.3e-7
Q_C, T_C = 5.2e-5, 8.0
OMEGA0, F0 = 7.7e-4, 0.371234
SIGMA, F_R, Q_F = 2.9e-4, 0.8, 12.0
CUTOFF = 0.5

# From far below to far above the characteristic times 1/CUTOFF, T_C, 1/F0, 1/F_R.
# At 0.7 s the formulas of flicker with a cutoff change between T and 2T.
TIMES = [1e-4, 3e-3, 0.05, 0.4, 0.7, 1.0, 2.7, 9.0, 41.0, 700.0, 2e4]


def ci(x):
    return mp.ci(x)


def eq_4_48(T):
    x = mp.pi * mp.mpf(CUTOFF) * T
    tail = mp.sin(x) ** 3 / (2 * x**2) * (mp.sin(x) + 4 * x * mp.cos(x))
    return 2 * mp.mpf(B) ** 2 / mp.pi * (mp.log(2) - tail + ci(2 * x) - ci(4 * x))


def eq_4_60(T):
    tc = mp.mpf(T_C)
    bracket = 3 - 4 * mp.exp(-T / tc) + mp.exp(-2 * T / tc)
    return (mp.mpf(Q_C) * tc) ** 2 / T * (1 - tc / (2 * T) * bracket)


CLOSED_FORMS = {
    "4.29": (Quantization(Q), lambda T: 3 * mp.mpf(Q) ** 2 / T**2),
    "4.36": (AngleRandomWalk(N), lambda T: mp.mpf(N) ** 2 / T),
    "4.48": (BiasInstability(B, CUTOFF), eq_4_48),
    "4.50": (BiasInstability(B), lambda T: 2 * mp.log(2) / mp.pi * mp.mpf(B) ** 2),
    "4.53": (RateRandomWalk(K), lambda T: mp.mpf(K) ** 2 * T / 3),
    "4.56": (DriftRamp(R), lambda T: (mp.mpf(R) * T) ** 2 / 2),
    "4.60": (Markov(Q_C, T_C), eq_4_60),
    "4.64": (
        Sinusoid(OMEGA0, F0),
        lambda T: (mp.mpf(OMEGA0) * mp.sin(mp.pi * F0 * T) ** 2 / (mp.pi * F0 * T)) ** 2,
    ),
}


@pytest.mark.parametrize("equation", CLOSED_FORMS)
def test_allan_variance_is_the_closed_form(equation):
    term, closed = CLOSED_FORMS[equation]
    expected = [float(closed(mp.mpf(T))) for T in TIMES]
    np.testing.assert_allclose(term.allan_variance(np.array(TIMES)), expected, rtol=1e-8)


# --- Quadrature of (4.25) -----------------------------------------------------------------------------------


def allan_integral(psd, T, marks=()):
    """(4.25), σ² = 4∫S sin⁴(πfT)/(πfT)² df, S being evaluated by mpmath; it has features near `marks` [Hz].

    Up to a whole period past the marks it is integrated as it stands. Beyond, sin⁴u is a constant, 3/8, and
    two waves, −cos(2u)/2 + cos(4u)/8, which die out along u = end + iv, whither Cauchy lets the path turn.
    """
    with mp.workdps(16):
        T = mp.mpf(T)
        near = sorted(mp.pi * mp.mpf(f) * T for f in marks)
        near = [u for u in near if u < 20 * mp.pi]
        periods = int(mp.ceil(max([mp.mpf(1), *(2 * u / mp.pi for u in near)])))
        end = periods * mp.pi

        # mpmath's tolerance is absolute: bring the integrand to about one.
        scale = psd(1 / T)

        def density(u):
            return psd(u / (mp.pi * T)) / (scale * u**2)

        decades = [mp.pi / 8**j for j in range(1, 6)]
        grid = sorted({*near, *decades, *(k * mp.pi for k in range(periods + 1))})
        head = mp.quad(lambda u: density(u) * mp.sin(u) ** 4 if u else mp.mpf(0), grid)
        mean = 3 * end / 8 * mp.quad(lambda v: density(end * v), [1, 4, 16, 256, mp.inf])
        fourth, second = (
            mp.re(1j * mp.quad(lambda v, k=k: density(end + 1j * v) * mp.exp(-k * v), [0, 1, 4, 20]))
            for k in (4, 2)
        )
        return 4 * scale / (mp.pi * T) * (head + mean + fourth / 8 - second / 2)


def resonance_psd(f):
    w0, w = 2 * mp.pi * F_R, 2 * mp.pi * f
    return 2 * mp.mpf(SIGMA) ** 2 * w0**3 / Q_F / ((w0**2 - w**2) ** 2 + (w0 * w / Q_F) ** 2)


WIDTH = F_R / (2 * Q_F)
SPECTRA = {
    # (4.31), (4.38) without a cutoff, (4.52), (4.59): mpmath's PSD, marks, cluster times.
    "white": (AngleRandomWalk(N), lambda f: mp.mpf(N) ** 2, (), [0.01, 1.0, 300.0]),
    "flicker": (BiasInstability(B), lambda f: mp.mpf(B) ** 2 / (2 * mp.pi * f), (), [0.01, 300.0]),
    "walk": (RateRandomWalk(K), lambda f: (mp.mpf(K) / (2 * mp.pi * f)) ** 2, (), [0.01, 1.0, 300.0]),
    "markov": (
        Markov(Q_C, T_C),
        lambda f: (mp.mpf(Q_C) * T_C) ** 2 / (1 + (2 * mp.pi * f * T_C) ** 2),
        (1 / (2 * math.pi * T_C), 10 / T_C),
        [1e-3 * T_C, 0.1 * T_C, T_C, 7.0 * T_C, 300.0 * T_C],
    ),
    "resonance": (
        Resonance(SIGMA, F_R, Q_F),
        resonance_psd,
        (F_R - 5 * WIDTH, F_R - WIDTH, F_R, F_R + WIDTH, F_R + 5 * WIDTH, 3 * F_R),
        [1e-3 / F_R, 0.1 / F_R, 0.5 / F_R, 1.0 / F_R, 2.3 / F_R, 9.4 / F_R],
    ),
}


@pytest.mark.parametrize("name", SPECTRA)
def test_allan_variance_is_the_integral_over_the_spectrum(name):
    term, psd, marks, times = SPECTRA[name]
    expected = [float(allan_integral(psd, T, marks)) for T in times]
    np.testing.assert_allclose(term.allan_variance(np.array(times)), expected, rtol=1e-8)
    frequency = np.geomspace(1e-4, 1e3, 15)
    np.testing.assert_allclose(term.psd(frequency), [float(psd(mp.mpf(f))) for f in frequency], rtol=1e-10)


@pytest.mark.parametrize("fT", [1e-3, 0.1, 0.3, 1.0, 7.3, 40.0])
def test_flicker_up_to_a_cutoff_is_the_integral_4_39(fT):
    periods = [0, *(k * mp.pi for k in range(1, int(fT) + 1)), mp.pi * mp.mpf(fT)]
    with mp.workdps(20):
        integral = mp.quad(lambda u: mp.sin(u) ** 4 / u**3 if u else mp.mpf(0), periods)
        expected = float(2 * mp.mpf(B) ** 2 / mp.pi * integral)
    np.testing.assert_allclose(BiasInstability(B, CUTOFF).allan_variance(fT / CUTOFF), expected, rtol=1e-8)


@pytest.mark.parametrize("clusters", [1, 2, 7, 30])
def test_quantization_is_an_integral_up_to_the_nyquist_frequency(clusters):
    """Exact twice: (4.28) left of ≈ with the filter of sums of n samples, right of ≈ with that of (4.25).

    Both leave 3/8, the mean of sin⁴ over whole periods, which is why T must be a multiple of T_z.
    """
    T_z = mp.mpf("0.01")
    T = clusters * T_z
    grid = [k / (2 * T) for k in range(clusters + 1)]
    psd = lambda f: 4 * mp.mpf(Q) ** 2 / T_z * mp.sin(mp.pi * f * T_z) ** 2  # noqa: E731
    with mp.workdps(20):
        sampled = mp.quad(
            lambda f: (
                4 * psd(f) * mp.sin(mp.pi * f * T) ** 4 / (clusters * mp.sin(mp.pi * f * T_z)) ** 2
                if f
                else mp.mpf(0)
            ),
            grid,
        )
        continuous = mp.quad(
            lambda f: (
                4 * (2 * mp.pi * f * Q) ** 2 * T_z * mp.sin(mp.pi * f * T) ** 4 / (mp.pi * f * T) ** 2
                if f
                else mp.mpf(0)
            ),
            grid,
        )
    term = Quantization(Q).sampled(100.0)
    np.testing.assert_allclose(term.allan_variance(float(T)), [float(sampled)], rtol=1e-10)
    np.testing.assert_allclose(term.allan_variance(float(T)), [float(continuous)], rtol=1e-10)
    np.testing.assert_allclose(term.psd(np.array([3.0, 50.0])), [float(psd(3)), float(psd(50))], rtol=1e-10)


def test_sampled_line_has_its_amplitude_in_the_samples():
    """cos at the sample instants through sums of n samples: Ω0² sin⁴(πf0T)/(n sin πf0t0)²."""
    rate, f0, n = 100.0, 13.0, np.array([1, 2, 5, 16, 40])
    expected = (OMEGA0 * np.sin(np.pi * f0 * n / rate) ** 2 / (n * np.sin(np.pi * f0 / rate))) ** 2
    term = Sinusoid(OMEGA0, f0).sampled(rate)
    np.testing.assert_allclose(term.allan_variance(n / rate), expected, rtol=1e-10)


def test_sampled_resonance_sums_its_autocovariance():
    """Allan variance of a stationary sequence with R(t) = σ²e^{−at}[cos ω_d t + (a/ω_d) sin ω_d t]."""
    rate, f0 = 100.0, 13.0
    w0 = 2 * np.pi * f0
    a = w0 / (2 * Q_F)
    wd = np.sqrt(w0**2 - a**2)
    for n in (1, 2, 5, 40):
        t = np.abs(np.subtract.outer(np.arange(2 * n), np.arange(2 * n))) / rate
        covariance = SIGMA**2 * np.exp(-a * t) * (np.cos(wd * t) + a / wd * np.sin(wd * t))
        filter_ = np.repeat([-1.0, 1.0], n) / n
        expected = filter_ @ covariance @ filter_ / 2
        found = Resonance(SIGMA, f0, Q_F).sampled(rate).allan_variance(n / rate)
        np.testing.assert_allclose(found, expected, rtol=1e-9)


def test_hadamard_variance_of_power_laws():
    """White N²/T, random walk K²T/6 (SP 1065, table of σ_H²), and no ramp."""
    T = np.array([0.1, 3.0, 50.0])
    np.testing.assert_allclose(AngleRandomWalk(N).hadamard_variance(T), N**2 / T, rtol=1e-10)
    np.testing.assert_allclose(RateRandomWalk(K).hadamard_variance(T), K**2 * T / 6, rtol=1e-10)
    # A ramp's third difference vanishes, but for the rounding of terms like R²T².
    assert np.all(np.abs(DriftRamp(R).hadamard_variance(T)) < 1e-14 * R**2 * T**2)


# --- Gradients ----------------------------------------------------------------------------------------------

ALL_TERMS = {
    **{type(term).__name__ + key: term for key, (term, _) in CLOSED_FORMS.items()},
    "Resonance": Resonance(SIGMA, F_R, Q_F),
    "ResonanceSampled": Resonance(SIGMA, F_R, Q_F).sampled(20.0),
    "SinusoidSampled": Sinusoid(OMEGA0, F0).sampled(20.0),
}


def curve_of(term):
    """log σ² as a function of the logarithms of the parameters, and these logarithms."""
    free = [p.name for p in term.parameters() if term.is_free(p)]

    def curve(logs, T):
        values = {name: jnp.exp(x) for name, x in zip(free, logs, strict=True)}
        return term.replace(**values).allan_variance(T)

    return curve, jnp.log(jnp.array([getattr(term, name) for name in free]))


@pytest.mark.parametrize("name", ALL_TERMS)
def test_gradients_are_those_of_finite_differences(name):
    curve, logs = curve_of(ALL_TERMS[name])
    T = jnp.array([0.05, 1.1, 45.0])
    scale = curve(logs, T)
    relative = jax.jit(lambda x: curve(x, T) / scale)
    check_grads(relative, (logs,), order=1, modes=("fwd", "rev"), atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("name", ALL_TERMS)
def test_values_and_gradients_are_finite_at_the_edges(name):
    """T ≪ and ≫ every characteristic time; the clusters of a call may span all of that, or one only."""
    curve, logs = curve_of(ALL_TERMS[name])
    value_and_gradient = jax.jit(lambda logs, T: (curve(logs, T), jax.jacrev(curve)(logs, T)))
    for T in ([1e-9] * 3, [1e-6] * 3, [1e-3] * 3, [1e3] * 3, [1.003e7] * 3, [1e-9, 1.0, 1.003e7]):
        value, gradient = value_and_gradient(logs, jnp.array(T))
        assert np.isfinite(value).all(), T
        assert np.isfinite(gradient).all(), T
        # The derivative by the logarithm of an amplitude.
        np.testing.assert_allclose(gradient[:, 0], 2.0 * value, rtol=1e-6, atol=1e-300)


@pytest.mark.parametrize("name", ALL_TERMS)
def test_a_zero_coefficient_gives_zero_and_finite_gradients(name):
    term = ALL_TERMS[name]
    amplitude = term.parameters()[0].name
    T = jnp.array([1e-3, 1.0, 1e3])
    curve = lambda a: term.replace(**{amplitude: a}).allan_variance(T)  # noqa: E731
    assert np.all(np.asarray(curve(jnp.zeros(()))) == 0.0)
    assert np.all(np.asarray(jax.jacfwd(curve)(jnp.zeros(()))) == 0.0)


@pytest.mark.parametrize("f0", [1e-7, 1e4])
def test_cutoff_gradients_are_finite_and_right_at_extremes(f0):
    def curve(log_f0):
        return BiasInstability(B, jnp.exp(log_f0)).allan_variance(1.0)

    slope = jax.grad(curve)(jnp.log(f0))
    # (4.39): σ² = (2B²/π) I(x), so that dσ²/d ln f0 = (2B²/π) sin⁴x/x², x = πf0T.
    x = math.pi * f0
    assert slope == pytest.approx(2 * B**2 / math.pi * math.sin(x) ** 4 / x**2, rel=1e-6, abs=1e-12 * B**2)


# --- Declarations -------------------------------------------------------------------------------------------


def test_parameters_names_and_units_of_every_term():
    declared = {
        t.name(): [(p.name, p.kind, p.time_exponent) for p in t.parameters()]
        for t in (
            Quantization,
            AngleRandomWalk,
            BiasInstability,
            RateRandomWalk,
            DriftRamp,
            Markov,
            Sinusoid,
            Resonance,
        )
    }
    assert declared == {
        "quantization": [("coefficient", "amplitude", 1.0)],
        "angle_random_walk": [("coefficient", "amplitude", 0.5)],
        "bias_instability": [("coefficient", "amplitude", 0.0), ("cutoff_frequency", "frequency", 0.0)],
        "rate_random_walk": [("coefficient", "amplitude", -0.5)],
        "drift_ramp": [("coefficient", "amplitude", -1.0)],
        "markov": [("amplitude", "amplitude", -0.5), ("correlation_time", "time", 0.0)],
        "sinusoid": [("amplitude", "amplitude", 0.0), ("frequency", "line", 0.0)],
        "resonance": [
            ("amplitude", "amplitude", 0.0),
            ("frequency", "line", 0.0),
            ("quality_factor", "number", 0.0),
        ],
    }


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Quantization(-1.0), "coefficient must be ≥ 0"),
        (lambda: AngleRandomWalk(math.nan), "coefficient must be ≥ 0"),
        (lambda: Markov(1.0, 0.0), "correlation_time must be > 0"),
        (lambda: Resonance(1.0, 2.0, 0.5), "quality_factor must be > 0.5"),
        (lambda: Markov().hold("time"), "markov has no parameter 'time'"),
        (lambda: Markov().hold("correlation_time"), "cannot hold correlation_time without a value"),
    ],
)
def test_impossible_values_are_refused(make, message):
    with pytest.raises(AllanjaxError, match=message):
        make()


def test_incomplete_classes_are_refused():
    class Nameless(NoiseTerm):
        time: float | None = parameter("τ", "time")

    class Empty(NoiseTerm):
        coefficient: float | None = parameter("c")

    with pytest.raises(AllanjaxError, match="first parameter of a noise term must be its amplitude"):
        Nameless()
    with pytest.raises(NotImplementedError, match="Empty defines no phase_covariance"):
        Empty(1.0).allan_variance(1.0)
    with pytest.raises(NotImplementedError, match="Empty defines no psd"):
        Empty(1.0).psd(1.0)

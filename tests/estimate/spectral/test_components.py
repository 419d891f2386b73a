"""Expected squares of cosine coefficients, against sums over all pairs of samples, and against Allan's G."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import quad
from scipy.linalg import toeplitz
from scipy.signal import bilinear_zpk, butter, freqz, freqz_sos, lfilter, sosfilt, zpk2sos

import allanjax as aj
from allanjax.estimate.spectral import components
from allanjax.estimate.spectral.columns import columns_of
from allanjax.estimate.spectral.levels import levels_of
from allanjax.noise.moving_average import HALF_POWER
from allanjax.spectrum.cosine import Bins, Part

N = 300


def bins_of_singles(n, rate=1.0):
    """A bin for each coefficient."""
    return Bins(n, rate, (Part(n, rate, np.arange(1, n + 1), 1),))


def single_coefficients(n):
    """Levels of single coefficients without columns, and how many they are."""
    return levels_of(bins_of_singles(n), np.zeros((0, 2, n - 1)), 8), n - 1


def by_all_pairs(covariance):
    """E c_j² of the cosine coefficients from the covariance of all samples."""
    n = len(covariance)
    basis = np.sqrt(2.0 / n) * np.cos(np.pi * np.arange(1, n)[:, None] / n * (np.arange(n) + 0.5))
    return np.einsum("ij,jk,ik->i", basis, covariance, basis)


def lags(n):
    return abs(np.subtract.outer(np.arange(n), np.arange(n))).astype(float)


@pytest.mark.parametrize("time", [0.05, 1.0, 30.0, 1e4])
def test_markov_is_the_sum_over_all_pairs(time):
    """Means over the interval: r_0 and r_1 by numerical integration of the covariance."""
    x = 1.0 / time
    r0 = quad(lambda t: 2.0 * (1.0 - t) * np.exp(-x * t), 0.0, 1.0)[0]
    r1 = quad(lambda t: (1.0 - abs(t)) * np.exp(-x * (1.0 + t)), -1.0, 1.0, points=[0.0])[0]
    d = lags(N)
    expected = by_all_pairs(np.where(d == 0, r0, r1 * np.exp(-x * np.maximum(d - 1.0, 0.0))))
    levels, m = single_coefficients(N)
    found = np.asarray(components.markov(levels, jnp.log(time)))[0, :m]
    # Of 10⁴ samples the covariance is nearly constant, and the sum over pairs keeps six digits.
    np.testing.assert_allclose(found, expected, rtol=1e-9 if time < 1e3 else 1e-6)


@pytest.mark.parametrize(("f0", "Q"), [(0.1, 3.0), (0.3, 20.0), (0.01, 0.7), (0.45, 1.5)])
def test_oscillator_is_the_sum_over_all_pairs(f0, Q):
    w0 = 2.0 * np.pi * f0
    decay = w0 / (2.0 * Q)
    wd = np.sqrt(w0**2 - decay**2)
    d = lags(N)
    expected = by_all_pairs(np.exp(-decay * d) * (np.cos(wd * d) + decay / wd * np.sin(wd * d)))
    levels, m = single_coefficients(N)
    shape = jnp.array([np.log(w0), np.log(Q - 0.5)])
    found = np.asarray(components.oscillator(levels, shape, jnp.asarray(False)))[0, :m]
    np.testing.assert_allclose(found, expected, rtol=1e-8)


@pytest.mark.parametrize(
    "term", [aj.Quantization(1.0), aj.AngleRandomWalk(1.0), aj.RateRandomWalk(1.0), aj.BiasInstability(1.0)]
)
def test_columns_are_sums_over_all_pairs_of_the_phase_covariance(term):
    """E c_j² = −(1/h²) Σ G δ²r: here by brute force, the covariance of increments of the phase."""
    n, rate = 200, 4.0
    G = np.asarray(term.phase_covariance(jnp.arange(n + 1) / rate))
    d = lags(n).astype(int)
    second = -(G[d + 1] - 2.0 * G[d] + G[abs(d - 1)]) * rate**2
    expected = by_all_pairs(second)
    found = columns_of([term], bins_of_singles(n, rate))[0, 0]
    # Above the 64th coefficient it is the density, without what the record's ends add to flicker noise.
    walk = isinstance(term, aj.RateRandomWalk)
    np.testing.assert_allclose(found[:64], expected[:64], rtol=2e-3 if walk else 1e-6)
    np.testing.assert_allclose(found[64:], expected[64:], rtol=5e-3)


@pytest.mark.parametrize("bandwidth", [0.02, 0.15, 0.4])
def test_one_pole_is_the_digital_filter(bandwidth):
    """y_k = w·y_{k−1} + (1 − w)·x_k has the response that scipy computes from its coefficients."""
    w = np.exp(-2.0 * np.pi * bandwidth)
    levels, m = single_coefficients(N)
    _, H = freqz([1.0 - w], [1.0, -w], np.asarray(levels.angle)[0, :m])
    shape = jnp.array([np.log(2.0 * np.pi * bandwidth), 0.0])
    found = np.asarray(components.response(levels, shape, jnp.asarray(components.ONE_POLE)))[0, :m]
    np.testing.assert_allclose(found, abs(H) ** 2, rtol=1e-12)


@pytest.mark.parametrize(
    ("kind", "limited"),
    [
        (components.ONE_POLE, components.ONE_POLE_BAND_LIMITED),
        (components.TWO_POLES, components.TWO_POLES_BAND_LIMITED),
    ],
)
def test_responses_read_at_the_instants_are_sums_over_aliases(kind, limited):
    """White noise through the continuous filter, its aliases summed, over their sum at frequency zero."""
    wc, Q, n = 2.0 * np.pi * 0.12, 0.9, 500
    levels, m = single_coefficients(n)
    a = np.asarray(levels.angle)[0, :m]
    shape = jnp.array([np.log(wc), np.log(Q - 0.5)])

    def density(a):
        u = (a / wc) ** 2
        return (
            1.0 / (1.0 + u)
            if limited == components.ONE_POLE_BAND_LIMITED
            else 1.0 / ((1.0 - u) ** 2 + u / Q**2)
        )

    np.testing.assert_allclose(
        np.asarray(components.response(levels, shape, jnp.asarray(limited)))[0, :m], density(a), rtol=1e-12
    )
    k = np.arange(-20_000, 20_001)
    folded = np.array([density(x + 2.0 * np.pi * k).sum() for x in (0.0, *a[:: m // 20])])
    found = np.asarray(components.response(levels, shape, jnp.asarray(kind)))[0, :m][:: m // 20]
    # One pole's aliases fall off with the square: 3·10⁻⁶ of them lie beyond those that are summed.
    np.testing.assert_allclose(found, folded[1:] / folded[0], rtol=2e-5)


BUTTERWORTH = [components.BUTTERWORTH_1 + k for k in range(4)]


@pytest.mark.parametrize("kind", BUTTERWORTH)
@pytest.mark.parametrize("bandwidth", [1e-5, 0.02, 0.15, 0.4, 0.49])
def test_butterworth_is_the_filter_that_scipy_designs(kind, bandwidth):
    """Also near half the sample rate, where the power of the fourth order is 10⁻⁴⁰ of what it was."""
    levels, m = single_coefficients(N)
    a = np.asarray(levels.angle)[0, :m]
    _, H = freqz_sos(butter(kind - components.BUTTERWORTH_1 + 1, bandwidth, fs=1.0, output="sos"), a)
    shape = jnp.array([np.log(2.0 * np.pi * bandwidth), 0.0])
    found = np.asarray(components.response(levels, shape, jnp.asarray(kind)))[0, :m]
    np.testing.assert_allclose(found, abs(H) ** 2, rtol=1e-7, atol=1e-24)
    t = np.tan(a / 2.0) / np.tan(np.pi * bandwidth)
    order = kind - components.BUTTERWORTH_1 + 1
    np.testing.assert_allclose(found, 1.0 / (1.0 + t ** (2 * order)), rtol=1e-10)


@pytest.mark.parametrize("kind", BUTTERWORTH)
@pytest.mark.parametrize("log_wc", [-20.0, -3.0, 0.5, np.log(np.pi), 5.0])
def test_the_derivatives_of_a_butterworth_response_are_finite(kind, log_wc):
    """At the ends of the bounds, too, where levels only pad the arrays, and at half the sample rate."""
    levels, m = single_coefficients(N)
    angle = np.asarray(levels.angle).copy()
    angle[:, m - 1] = np.pi
    levels = levels._replace(angle=angle)

    def of(shape):
        return components.response(levels, shape, jnp.asarray(kind))

    shape = jnp.array([log_wc, 0.0])
    slope = np.asarray(jax.jacfwd(of)(shape))
    assert np.all(np.isfinite(slope))
    assert not np.any(slope[..., 1])
    assert np.all(np.asarray(of(shape))[:, m - 1] < 1e-20)
    step = jnp.array([1e-5, 0.0])
    by_difference = (np.asarray(of(shape + step)) - np.asarray(of(shape - step))) / 2e-5
    np.testing.assert_allclose(slope[..., 0], by_difference, rtol=1e-6, atol=1e-9)


def test_one_program_serves_all_kinds_of_response():
    levels, _ = single_coefficients(N)
    traced = []

    @jax.jit
    def of(kind):
        traced.append(kind)
        return components.response(levels, jnp.array([-1.0, 0.0]), kind)

    for kind in range(11):
        of(jnp.asarray(kind))
    assert len(traced) == 1


def analog_two_poles(bandwidth, Q):
    """Zeros, poles and gain of the analog filter whose bilinear transform has this bandwidth."""
    w = 2.0 * np.tan(np.pi * bandwidth)
    return [], np.roots([1.0, w / Q, w**2]), w**2


def pulse_of(kind, bandwidth, Q, n):
    """Response of a filter to a pulse, by SciPy and by the recursion of an oscillator read at instants."""
    pulse = np.zeros(n)
    pulse[0] = 1.0
    if kind >= components.BUTTERWORTH_1:
        return sosfilt(butter(kind - components.BUTTERWORTH_1 + 1, bandwidth, fs=1.0, output="sos"), pulse)
    wc = 2.0 * np.pi * bandwidth
    if kind == components.BIQUAD:
        z, p, k = analog_two_poles(bandwidth, Q)
        return sosfilt(zpk2sos(*bilinear_zpk(z, p, k, 1.0)), pulse)
    if kind == components.ONE_POLE:
        return lfilter([1.0 - np.exp(-wc)], [1.0, -np.exp(-wc)], pulse)
    return np.asarray(aj.LowPass2(bandwidth, Q).filtered(jnp.asarray(pulse), 1.0))


@pytest.mark.parametrize("kind", [components.ONE_POLE, components.TWO_POLES, components.BIQUAD, *BUTTERWORTH])
@pytest.mark.parametrize("bandwidth", [0.01, 0.1, 0.25, 0.4])
@pytest.mark.parametrize("M", [1, 3])
def test_ends_of_filtered_white_noise_are_what_is_beside_the_response(kind, bandwidth, M):
    """E c² by the dense covariance of 200 values, means of M samples; the filter settled before the first."""
    n, Q = 200, 1.3
    pulse = pulse_of(kind, bandwidth, Q, 2000)
    echo = np.correlate(pulse, pulse, "full")[len(pulse) - 1 :]
    means = np.kron(np.eye(n), np.full((1, M), 1.0 / M))
    expected = by_all_pairs(means @ toeplitz(echo[: M * n]) @ means.T)
    levels, m = single_coefficients(n)
    levels = levels._replace(angle=levels.angle / M, interval=np.asarray(float(M)))
    shape = jnp.array([np.log(2.0 * np.pi * bandwidth), np.log(Q - 0.5)])
    ends = np.asarray(components.response_ends(levels, shape, jnp.asarray(kind)))[0, :m]
    if M == 1:
        within = np.asarray(components.response(levels, shape, jnp.asarray(kind)))[0, :m]
        np.testing.assert_allclose(within + ends, expected, rtol=1e-6, atol=1e-15)
        # Deep in the stop band hardly anything is left beside them.
        if kind == components.BUTTERWORTH_4 and bandwidth == 0.1:
            assert np.all(within[-50:] < 0.02 * ends[-50:])
    # Without the ends it is what more and more values have, of the same autocovariance.
    a = np.pi * np.arange(1, n) / n
    lag = np.arange(1, 1500 // M)
    near = np.arange(1 - M, M)
    triangle = (M - abs(near)) / M**2
    at_zero, of_means = triangle @ echo[abs(near)], echo[M * lag[:, None] + near] @ triangle
    density = at_zero + 2.0 * np.cos(a[:, None] * lag) @ of_means
    np.testing.assert_allclose(density + ends, expected, rtol=1e-6, atol=1e-13)


@pytest.mark.parametrize("kind", range(11))
def test_ends_are_differentiable_and_add_nothing_without_a_response(kind):
    levels, _ = single_coefficients(N)

    def of(shape):
        return components.response_ends(levels, shape, jnp.asarray(kind))

    shape = jnp.array([-0.7, 0.1])
    found, slope = np.asarray(of(shape)), np.asarray(jax.jacfwd(of)(shape))
    none = (components.NONE, components.ONE_POLE_BAND_LIMITED, components.TWO_POLES_BAND_LIMITED)
    assert np.any(found) == (kind not in none)
    for k, step in enumerate(1e-5 * np.eye(2)):
        by_difference = (np.asarray(of(shape + step)) - np.asarray(of(shape - step))) / 2e-5
        np.testing.assert_allclose(slope[..., k], by_difference, rtol=1e-6, atol=1e-10)
    for log_wc in (-20.0, np.log(np.pi / 2.0), 5.0):
        at = jnp.array([log_wc, 0.1])
        assert np.all(np.isfinite(np.asarray(of(at))))
        assert np.all(np.isfinite(np.asarray(jax.jacfwd(of)(at))))


def test_nothing_depends_on_an_absent_response():
    levels, _ = single_coefficients(N)
    found = components.response(levels, jnp.array([0.0, 0.0]), jnp.asarray(components.NONE))
    np.testing.assert_array_equal(np.asarray(found), 1.0)


def test_means_of_segments_are_averages_of_readings():
    """An oscillator averaged over five readings before the transform: the covariance of such means."""
    M, n, w0, Q = 5, 120, 0.4, 4.0
    decay = w0 / (2.0 * Q)
    wd = np.sqrt(w0**2 - decay**2)
    d = lags(M * n)
    readings = np.exp(-decay * d) * (np.cos(wd * d) + decay / wd * np.sin(wd * d))
    means = np.kron(np.eye(n), np.full((1, M), 1.0 / M))
    expected = by_all_pairs(means @ readings @ means.T)
    levels, m = single_coefficients(n)
    levels = levels._replace(angle=levels.angle / M, interval=np.full_like(levels.interval, M))
    shape = jnp.array([np.log(w0), np.log(Q - 0.5)])
    found = np.asarray(components.oscillator(levels, shape, jnp.asarray(False)))[0, :m]
    np.testing.assert_allclose(found, expected, rtol=1e-8)


@pytest.mark.parametrize("duration", [1.0, 1.3, 2.0, 2.85, 7.0, 16.4])
def test_a_moving_average_is_that_of_white_noise_read_at_the_instants(duration):
    """E c² by the dense covariance (τ − |d|)+ of 200 values: the overlap of two means of length τ."""
    n = 200
    d = np.arange(n)
    expected = by_all_pairs(toeplitz(np.maximum(duration - d, 0.0)))
    total = duration + 2.0 * np.maximum(duration - d[1:], 0.0).sum()
    levels, m = single_coefficients(n)
    shape = jnp.array([np.log(2.0 * np.pi * HALF_POWER / duration), 0.0])
    kind = jnp.asarray(components.MOVING_AVERAGE)
    within = np.asarray(components.response(levels, shape, kind))[0, :m]
    ends = np.asarray(components.response_ends(levels, shape, kind))[0, :m]
    np.testing.assert_allclose(within + ends, expected / total, rtol=1e-9, atol=1e-14)
    # Beside the zeros of the response the ends are what is left.
    if duration == 7.0:
        k = np.argmin(within)
        assert within[k] < 0.5 * ends[k]
    if duration > 1.0:
        assert np.all(
            np.isfinite(jax.jacfwd(lambda shape: components.response_ends(levels, shape, kind))(shape))
        )


def test_the_ends_of_a_moving_average_are_steady_at_low_frequencies():
    """Where the closed form loses its digits, it is its limit: compared with sums over lags."""
    n, duration = 4_000_000, 37.6
    j = np.array([1, 50, 120, 130, 1000])
    a = np.pi * j / n
    d = np.arange(1, 38)
    r = np.maximum(duration - d, 0.0)
    total = duration + 2.0 * r.sum()
    expected = (
        -2.0 / n * (r * (d * np.cos(a[:, None] * d) + np.sin(a[:, None] * d) / np.sin(a[:, None]))).sum(1)
    )
    levels, _ = single_coefficients(200)
    levels = levels._replace(angle=np.stack([a, a]), length=np.asarray(float(n)), parity=np.zeros(5))
    shape = jnp.array([np.log(2.0 * np.pi * HALF_POWER / duration), 0.0])
    found = components.response_ends(levels, shape, jnp.asarray(components.MOVING_AVERAGE))[0]
    np.testing.assert_allclose(found, expected / total, rtol=2e-5)

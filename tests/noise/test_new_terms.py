"""Power laws, filtered white noise, telegraph noise, steps and warm-ups against integrals, sums and records
of NumPy's own.
"""

import math

import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
import pytest
from scipy import integrate, signal

import allanjax as aj
from allanjax.estimate.spectral.columns import columns_of
from allanjax.noise.notation import parse_model
from allanjax.spectrum.cosine import Bins, cosine_transform, term_column

RATE = 100.0
A, N, J, T_D, F_C = 3.1e-4, 1.7e-4, 4.3e-4, 0.3, 2.2
# Once in 16,000.
K_SIGMA = 4.0
EXPONENTS = [-0.5, 0.0, 0.5, 0.97, 1.0, 1.03, 1.5, 2.0, 2.6]
# LowPass and Telegraph with their autocovariances at lags t ≥ 0.
W_C = 2.0 * math.pi * F_C
STATIONARY = {
    "order 1": (aj.LowPass(N, F_C), lambda t: N**2 * W_C / 2.0 * np.exp(-W_C * t)),
    "order 2": (
        aj.LowPass(N, F_C, order=2),
        lambda t: (
            N**2
            * W_C
            / math.sqrt(8.0)
            * np.exp(-W_C * t / math.sqrt(2.0))
            * (np.cos(W_C * t / math.sqrt(2.0)) + np.sin(W_C * t / math.sqrt(2.0)))
        ),
    ),
    "telegraph": (aj.Telegraph(J, T_D), lambda t: J**2 / 4.0 * np.exp(-2.0 * t / T_D)),
}


# --- Allan variances and spectra ----------------------------------------------------------------------------


@pytest.mark.parametrize("exponent", EXPONENTS)
def test_allan_variance_of_a_power_law_is_the_integral_4_25(exponent):
    """4∫S sin⁴(πfT)/(πfT)² df = (4A²/πT)(πT)^α ∫u^(−α−2) sin⁴u du, to u = 300π as it stands.

    Beyond, sin⁴u = 3/8 − cos(2u)/2 + cos(4u)/8: the mean in closed form, the waves by parts.
    """
    s, end = exponent + 2.0, 300.0 * math.pi
    x, w = np.polynomial.legendre.leggauss(24)
    u = (np.arange(1, 300)[:, None] + (x + 1.0) / 2.0) * math.pi
    integral = float(mp.quad(lambda u: mp.sin(u) ** 4 / u**s if u else mp.mpf(0), [0, 0.1, 1, mp.pi]))
    integral += np.sum(w * math.pi / 2.0 * u**-s * np.sin(u) ** 4)
    integral += 3.0 / 8.0 * end ** (1.0 - s) / (s - 1.0)
    integral += s * end ** (-s - 1.0) * (-1.0 / 2.0 / 4.0 + 1.0 / 8.0 / 16.0)
    T = np.array([1e-4, 0.03, 1.0, 40.0, 2e4])
    expected = 4.0 * A**2 / (math.pi * T) * (math.pi * T) ** exponent * integral
    np.testing.assert_allclose(aj.PowerLaw(A, exponent).allan_variance(T), expected, rtol=1e-8)


def test_whole_exponents_are_the_classical_terms():
    T = np.geomspace(1e-3, 1e4, 9)
    white = aj.PowerLaw(A, 0.0).allan_variance(T)
    np.testing.assert_allclose(white, A**2 / T, rtol=1e-12)
    flicker = aj.PowerLaw(A, 1.0).allan_variance(T)
    np.testing.assert_allclose(flicker, np.full(9, 4.0 * math.log(2.0) * A**2), rtol=1e-12)
    walk = aj.PowerLaw(A, 2.0).allan_variance(T)
    np.testing.assert_allclose(walk, (2.0 * math.pi * A) ** 2 * T / 3.0, rtol=1e-12)
    for term, exponent in (
        (aj.AngleRandomWalk(A), 0.0),
        (aj.BiasInstability(math.sqrt(2.0 * math.pi) * A), 1.0),
        (aj.RateRandomWalk(2.0 * math.pi * A), 2.0),
    ):
        law, f = aj.PowerLaw(A, exponent), np.array([1e-4, 0.3, 20.0, 49.0])
        np.testing.assert_allclose(law.allan_variance(T), term.allan_variance(T), rtol=1e-12)
        np.testing.assert_allclose(law.psd(f), term.psd(f), rtol=1e-12)
        np.testing.assert_allclose(law.sampled_psd(f, RATE), term.sampled_psd(f, RATE), rtol=1e-8)


@pytest.mark.parametrize("exponent", EXPONENTS)
def test_aliases_of_a_power_law_add_up(exponent):
    f, aliases = RATE * np.array([1e-5, 0.01, 0.3, 0.499]), 3000
    u = f[:, None] / RATE + np.arange(-aliases, aliases + 1)
    total = np.sum((np.abs(u) * RATE) ** -exponent * np.sinc(u) ** 2, axis=1)
    # The tails by the midpoint rule, which errs by 1/aliases² of them.
    for side in (1.0, -1.0):
        end = aliases + 0.5 + side * f / RATE
        tail = end ** (-exponent - 1.0) / (exponent + 1.0) * RATE**-exponent
        total += (np.sin(np.pi * f / RATE) / np.pi) ** 2 * tail
    term = aj.PowerLaw(A, exponent)
    np.testing.assert_allclose(term.sampled_psd(f, RATE), A**2 * total, rtol=1e-7)
    if exponent in (-0.5, 1.03, 2.6):
        # From G instead of the aliases.
        np.testing.assert_allclose(aj.NoiseTerm.sampled_psd(term, f, RATE), A**2 * total, rtol=3e-4)


@pytest.mark.parametrize("exponent", [-0.5, 0.899, 0.901, 1.0, 1.0 + 1e-9, 2.0, 2.9])
def test_a_power_law_has_derivatives_by_its_exponent(exponent):
    def curve(exponent):
        term = aj.PowerLaw(A, exponent)
        values = jnp.concatenate([term.allan_variance(T), term.sampled_psd(T, RATE)])
        return jnp.log(values)

    T, h = jnp.array([1e-3, 0.7, 30.0]), 1e-5
    slope = jax.jit(jax.jacfwd(curve))(exponent)
    np.testing.assert_allclose(jax.jit(jax.jacrev(curve))(exponent), slope, rtol=1e-10)
    numerical = (curve(exponent + h) - curve(exponent - h)) / (2.0 * h)
    np.testing.assert_allclose(slope, numerical, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("name", STATIONARY)
def test_allan_variance_is_the_double_integral_of_the_autocovariance(name):
    """Var θ(T) = D(T) = 2∫(T − t)R(t) dt, and σ² = (4D(T) − D(2T))/2T²."""
    term, R = STATIONARY[name]
    for T in (1e-3, 0.05, 0.3, 2.0, 100.0):
        # Nothing is left of R after eight seconds.
        D = [
            integrate.quad(
                lambda t, T=T, k=k: 2.0 * (k * T - t) * R(t),
                0.0,
                min(k * T, 8.0),
                epsabs=0.0,
                epsrel=1e-13,
                limit=200,
            )[0]
            for k in (1.0, 2.0)
        ]
        expected = (4.0 * D[0] - D[1]) / (2.0 * T**2)
        # The difference of the two integrals has T/10 of them left.
        np.testing.assert_allclose(term.allan_variance(T), expected, rtol=1e-8)


@pytest.mark.parametrize("name", STATIONARY)
def test_psd_is_the_transform_of_the_autocovariance(name):
    term, R = STATIONARY[name]
    for f in (0.01, 0.7, F_C, 9.0):
        wave = {"weight": "cos", "wvar": 2.0 * math.pi * f, "limit": 400, "epsabs": 1e-10}
        expected = 2.0 * R(0.0) * integrate.quad(lambda t: R(t) / R(0.0), 0.0, 8.0, **wave)[0]
        np.testing.assert_allclose(term.psd(f), expected, rtol=1e-6)
    if name.startswith("order"):
        np.testing.assert_allclose(term.psd(np.array([0.0, F_C])), [N**2, N**2 / 2.0], rtol=1e-12)


@pytest.mark.parametrize("name", STATIONARY)
def test_samples_have_the_autocovariance_at_their_instants(name):
    term, R = STATIONARY[name]
    for rate in (3.0, RATE):
        f, d = rate * np.array([1e-4, 0.02, 0.31, 0.5]), np.arange(round(8.0 * rate))
        twice = np.where(d > 0, 2.0, 1.0)
        expected = (twice * R(d / rate)) @ np.cos(2.0 * np.pi * np.outer(d, f) / rate) / rate
        np.testing.assert_allclose(term.sampled_psd(f, rate), expected, rtol=1e-7)
        for n in (1, 2, 30):
            t = np.abs(np.subtract.outer(np.arange(2 * n), np.arange(2 * n))) / rate
            filter_ = np.repeat([-1.0, 1.0], n) / n
            found = term.sampled(rate).allan_variance(n / rate)
            np.testing.assert_allclose(found, filter_ @ R(t) @ filter_ / 2.0, rtol=1e-8)


# --- Simulation ---------------------------------------------------------------------------------------------

RANDOM = {
    **{f"power law {a}": aj.PowerLaw(A, a) for a in (-0.5, 0.6, 1.4, 2.6)},
    **{name: term for name, (term, _) in STATIONARY.items()},
}


@pytest.mark.parametrize("name", RANDOM)
def test_simulated_spectrum_is_that_of_the_samples(name):
    """Coefficients 65 … n−1 over their expectations, in octaves: χ² of as many degrees of freedom.

    Where the density is not the expectation (see `cosine`) it is off by at most 1 %, which is a quarter of
    the lowest octave's standard error. Telegraph noise has in all octaves the scatter of its number of jumps.
    """
    n = 1 << 15
    term = RANDOM[name]
    c = cosine_transform(np.asarray(aj.simulate(term, n, RATE, 7)))
    j = np.arange(1, n)
    ratio = c**2 / (RATE * np.asarray(term.sampled_psd(j * RATE / (2.0 * n), RATE)))
    jumps = 1.0 / (n / RATE / T_D) if name == "telegraph" else 0.0
    for k in range(6, 15):
        octave = ratio[(j > 1 << k) & (j <= 1 << (k + 1))]
        assert abs(octave.mean() - 1.0) < K_SIGMA * math.sqrt(2.0 / len(octave) + jumps), k


def test_a_telegraph_path_jumps_between_two_levels():
    n = 1 << 16
    x = np.asarray(aj.simulate(aj.Telegraph(J, T_D), n, RATE, 3))
    np.testing.assert_allclose(np.unique(x), [-J / 2.0, J / 2.0])
    # An odd number of Poisson(1/(rate·T_d)) jumps between two samples.
    mean = 1.0 / (RATE * T_D)
    odd = sum(math.exp(-mean) * mean**k / math.factorial(k) for k in range(1, 20, 2))
    changes = np.count_nonzero(np.diff(x))
    assert abs(changes - n * odd) < K_SIGMA * math.sqrt(n * odd * (1.0 - odd))
    starts = [float(aj.simulate(aj.Telegraph(2.0, T_D), 1, RATE, key)[0]) for key in range(40)]
    assert abs(sum(starts)) < K_SIGMA * math.sqrt(40.0)


def test_simulated_transients_are_their_columns():
    t = (np.arange(500) + 0.5) / RATE
    np.testing.assert_allclose(aj.simulate(aj.BiasStep(J, 2.0), 500, RATE, 0), J * (t > 2.0), rtol=1e-15)
    np.testing.assert_allclose(aj.simulate(aj.WarmUp(J, 2.0), 500, RATE, 0), J * np.exp(-t / 2.0), rtol=1e-13)
    for term in (aj.BiasStep(J, 2.0), aj.WarmUp(J, 2.0)):
        assert not np.any(term.allan_variance(t))
        assert not np.any(term.sampled_psd(t, RATE))


# --- Fits ---------------------------------------------------------------------------------------------------


def recorded(x, rate=RATE):
    return aj.Recording.from_array(x[:, None], rate, gyro_unit="rad/s", names=["gyro_x"])


def synthesized(density, n, rng):
    """Gaussian noise of this two-sided density, cut out of an eight times longer circle."""
    f = np.arange(1, 4 * n + 1) * RATE / (8.0 * n)
    z = (rng.standard_normal(4 * n) + 1j * rng.standard_normal(4 * n)) / math.sqrt(2.0)
    return np.fft.irfft(np.append(0.0, z * np.sqrt(density(f) * RATE * 8.0 * n)), 8 * n)[:n]


def check_recovered(found, truth):
    for label, value in truth.items():
        assert found[label].std > 0.0
        assert abs(found[label].value - value) < K_SIGMA * found[label].std, label
        assert found[label].std < 0.3 * value, label


def test_fit_of_white_noise_and_a_power_law_finds_its_exponent():
    n, rng, exponent, amplitude = 1 << 15, np.random.default_rng(11), 1.5, 4e-5

    def means(f):
        u = f[:, None] / RATE + np.arange(-3, 4)
        return amplitude**2 * np.sum((np.abs(u) * RATE) ** -exponent * np.sinc(u) ** 2, axis=1)

    x = synthesized(means, n, rng) + N * math.sqrt(RATE) * rng.standard_normal(n)
    found = aj.fit(recorded(x), aj.AngleRandomWalk() + aj.PowerLaw(), "whittle")["gyro_x"]
    truth = {"angle_random_walk": N, "power_law_amplitude": amplitude, "power_law_exponent": exponent}
    check_recovered(found, truth)
    assert found.p_value > 1e-3


def test_fit_of_filtered_white_noise_finds_the_bandwidth():
    n, rng, bandwidth = 1 << 14, np.random.default_rng(12), 7.0
    # A stationary first-order autoregression of variance N²·π·f_c.
    step = math.exp(-2.0 * math.pi * bandwidth / RATE)
    drive = rng.standard_normal(n) * np.append(1.0, np.full(n - 1, math.sqrt(1.0 - step**2)))
    x = N * math.sqrt(math.pi * bandwidth) * signal.lfilter([1.0], [1.0, -step], drive)
    found = aj.fit(recorded(x), aj.LowPass(), "whittle")["gyro_x"]
    check_recovered(found, {"low_pass": N, "low_pass_bandwidth": bandwidth})
    assert found.p_value > 1e-3


@pytest.fixture(scope="module")
def white():
    return N * math.sqrt(RATE) * np.random.default_rng(13).standard_normal(1 << 14)


@pytest.fixture(scope="module")
def step_fit(white):
    t = (np.arange(len(white)) + 0.5) / RATE
    # The sign is lost, as a ramp's is.
    model = aj.AngleRandomWalk() + aj.BiasStep(time=50.0).hold("time")
    return aj.fit(recorded(white - J * (t >= 50.0)), model, "whittle")


def test_fit_of_a_step_at_a_known_time(step_fit, white):
    found = step_fit["gyro_x"]
    check_recovered(found, {"angle_random_walk": N, "bias_step_amplitude": J})
    n, before = len(white), 5000
    # Cramér and Rao's bound of the difference of two means.
    bound = N * math.sqrt(RATE * (1.0 / before + 1.0 / (n - before)))
    assert found["bias_step_amplitude"].std == pytest.approx(bound, rel=0.05)
    assert found["bias_step_time"].held
    assert found.p_value > 1e-3


def test_fit_of_a_warm_up_of_known_time_constant(white):
    t = (np.arange(len(white)) + 0.5) / RATE
    # A value that is not held is held all the same: the record is not searched.
    model = aj.AngleRandomWalk() + aj.WarmUp(time_constant=20.0)
    found = aj.fit(recorded(white + J * np.exp(-t / 20.0)), model, "whittle")["gyro_x"]
    check_recovered(found, {"angle_random_walk": N, "warm_up_amplitude": J})
    assert found["warm_up_time_constant"].held


def test_a_step_is_sampled_drawn_and_exported(step_fit, tmp_path):
    posterior = aj.sample(step_fit)["gyro_x"]
    sampled, fitted = posterior["bias_step_amplitude"], step_fit["gyro_x"]["bias_step_amplitude"]
    assert abs(sampled.median - fitted.value) < 0.5 * fitted.std
    assert sampled.std == pytest.approx(fitted.std, rel=0.15)
    aj.plot_allan(step_fit, path=tmp_path / "allan.png")
    aj.write_json(step_fit, tmp_path / "fit.json")
    assert (tmp_path / "allan.png").stat().st_size > 10_000
    assert "bias_step_time" in (tmp_path / "fit.json").read_text(encoding="utf-8")


# --- Declarations -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: aj.PowerLaw(A, 3.0), "exponent must be < 3"),
        (lambda: aj.PowerLaw(A, -1.0), "exponent must be > -1"),
        (lambda: aj.LowPass(N, 0.0), "bandwidth must be > 0"),
        (lambda: aj.LowPass(N, 1.0, order=3), "the order must be 1 or 2"),
        (lambda: aj.BiasStep(-1.0, 1.0), "amplitude must be ≥ 0"),
    ],
)
def test_impossible_values_are_refused(make, message):
    with pytest.raises(aj.AllanjaxError, match=message):
        make()


def test_fits_refuse_what_they_cannot_do(white):
    recording = recorded(white)
    for term in (aj.BiasStep(time=50.0), aj.WarmUp(time_constant=50.0)):
        with pytest.raises(aj.FitError, match='no Allan variance of its own: give objective="whittle"'):
            aj.fit(recording, aj.AngleRandomWalk() + term)
        with pytest.raises(aj.AllanjaxError, match="cannot be compared by evidence"):
            aj.select_terms(recording, aj.AngleRandomWalk() + term)
    with pytest.raises(aj.FitError, match=r'BiasStep\(time=120.0\).hold\("time"\)'):
        aj.fit(recording, aj.AngleRandomWalk() + aj.BiasStep(), "whittle")
    with pytest.raises(aj.FitError, match=r'WarmUp\(time_constant=120.0\).hold\("time_constant"\)'):
        aj.fit(recording, aj.AngleRandomWalk() + aj.WarmUp(), "whittle")
    with pytest.raises(aj.FitError, match=r"bias_step does not vary within the record of 163\.84 s"):
        aj.fit(recording, aj.AngleRandomWalk() + aj.BiasStep(time=164.0), "whittle")
    for term in (aj.PowerLaw(), aj.LowPass()):
        with pytest.raises(aj.AllanjaxError, match="cannot be compared by evidence"):
            aj.select_terms(recording, aj.AngleRandomWalk() + term)


def test_terms_of_ones_own_have_columns_too():
    class Parabola(aj.NoiseTerm):
        coefficient: float | None = aj.parameter("P", time_exponent=-2.0)
        deterministic = True

        def column(self, time):
            return time**2

    t = (np.arange(77) + 0.5) / RATE
    np.testing.assert_allclose(term_column(Parabola(), 77, RATE), cosine_transform(t**2), atol=1e-12)
    with pytest.raises(NotImplementedError, match="Sinusoid defines no column"):
        term_column(aj.Sinusoid(1.0, 1.0), 77, RATE)


def test_new_terms_are_written_as_text():
    model = parse_model(
        "A=0.1 deg/√h + low_pass(coefficient=0.2 deg/√h, bandwidth=30 Hz) + telegraph + "
        "bias_step(time=2 min held) + warm_up(τ=1 h)",
        "gyro",
    )
    labels = ("power_law", "low_pass", "telegraph", "bias_step", "warm_up")
    assert model.term_labels == labels
    assert model["bias_step"].time == 120.0
    assert model["bias_step"].held == {"time"}
    assert model["warm_up"].time_constant == 3600.0
    assert parse_model("N").term_labels == ("angle_random_walk",)


def test_expectations_at_low_frequencies_keep_their_digits_in_long_records():
    """A random walk's cosine coefficients have the samples' density exactly, whatever the record's length."""
    for n in (1 << 13, 1 << 14, 100_000):
        bins = Bins.of(n, RATE)
        density = RATE * np.asarray(aj.RateRandomWalk(1.0).sampled_psd(bins.frequency[:64], RATE))
        found = columns_of([aj.RateRandomWalk(1.0)], bins)[0].mean(axis=0)[:64]
        np.testing.assert_allclose(found, density, rtol=1e-4)

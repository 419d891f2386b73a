"""Responses: their power by SciPy's filters, noise after them by dense covariances, and a user's own."""

import re
import shutil
import subprocess

import dense
import numpy as np
import pytest
from noise_terms import DETERMINISTIC, RANDOM, RATE, RESPONSES
from numpy.testing import assert_allclose, assert_array_equal
from refusals import refuses
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
        designs = {aj.Butterworth(at, k): signal.butter(k, at, **options) for k in range(1, 9)}
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
    for order in (2, 3, 4):
        means = aj.MovingAverage.of(1.5, order)
        assert np.sinc(1.5 * means.half_power) ** (2 * order) == pytest.approx(0.5, rel=1e-12)


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
    expected = [dense.allan_variance(C, m) for m in T]
    assert_allclose(model.allan_variance(T / RATE), expected, rtol=1e-9)
    space = model.state_space(RATE)
    assert_allclose([dense.allan_variance_of_states(space, m) for m in T], expected, rtol=1e-9)
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
    *((lambda order=order: aj.Butterworth(4.0, order), "order") for order in (0, 9, 2.0, "2")),
    (lambda: aj.MovingAverage(4.0, 5), "order"),
    (lambda: (aj.Butterworth(20.1) * WHITE).sampled(RATE), "bandwidth"),
    (lambda: (aj.MovingAverage(0.27) * WHITE).sampled(RATE), "bandwidth"),
    (lambda: (aj.MovingAverage(17.8) * WHITE).sampled(RATE), "bandwidth"),
]  # fmt: skip


def test_what_cannot_be_is_refused():
    for attempt, word in REFUSED:
        refuses(word, attempt)
    # The ends of what is possible.
    assert (aj.Butterworth(20.0) * WHITE).sampled(RATE).rate == RATE
    assert (aj.MovingAverage.of(64.0 / RATE) * WHITE).sampled(RATE).rate == RATE


# Flicker and power laws have none that is exact.
EXACT = {n: t for n, t in RANDOM.items() if not n.startswith(("flicker", "power law"))} | DETERMINISTIC
SUM = aj.AngleRandomWalk(1e-4) + aj.RateRandomWalk(1e-4) + aj.Quantization(2e-6) + aj.Markov(1e-3, 0.15)
WAVE = aj.Resonance(1e-3, 7.0, 20.0)
MODELS = {
    **{name: aj.Model((term,)) for name, term in EXACT.items()},
    "sum": SUM + WAVE,
    **{name: r * (SUM + WAVE) + aj.Sinusoid(1e-4, 3.3) for name, r in RESPONSES.items()},
}


@pytest.mark.parametrize("name", MODELS)
def test_samples_have_the_covariance_of_the_model(name):
    """From the first sample on; what is a line or stationary by instants, with its true variance."""
    model, space = MODELS[name], MODELS[name].state_space(RATE)
    found, expected = dense.of_states(space, 64)[0], dense.covariance(model, 64, RATE)
    steps, own = (np.diff(np.diff(C, axis=0), axis=1) for C in (expected, found))
    assert_allclose(own, steps, rtol=0.0, atol=1e-9 * abs(steps).max())
    if not re.search("walk|ramp|sum", name) and name not in RESPONSES:
        assert_allclose(found, expected, rtol=0.0, atol=1e-9 * abs(expected).max())
    if name == "walk":
        # It begins at zero: the mean over the first interval has K²/(3·rate), and its end K²/rate.
        assert_allclose(np.diag(space.P0) * RATE / 6.2e-6**2, [1 / 3, 1.0], rtol=1e-12)
    # The curves of the matrices alone; the Allan variance by sums over samples.
    m = np.array([1, 2, 7, 32])
    allan = [dense.allan_variance(expected, k) for k in m]
    assert_allclose([dense.allan_variance_of_states(space, k) for k in m], allan, rtol=1e-7)
    f = np.array([0.011, 0.31, 3.0, 7.1, 19.0])
    psd = model.sampled(RATE).sampled_psd(f, RATE)
    # In a stop band up to eight states cancel, each to the rounding of the largest density.
    own, rounding = dense.spectrum_of_states(space, f), 8.0 * np.finfo(float).eps * psd.max()
    assert_allclose(own, psd, rtol=1e-8, atol=rounding)


@pytest.mark.parametrize("term", [aj.BiasInstability(1e-4), aj.PowerLaw(1e-4, 0.5), aj.PowerLaw(1e-4, 1.9)])
def test_flicker_is_within_three_percent(term):
    for rate, duration in ((50.0, 3600.0), (1000.0, 1e5)):
        space = aj.Model((term,)).state_space(rate, duration=duration)
        m = np.unique(np.geomspace(1.0, duration * rate / 2.0, 97).astype(int))
        f = np.geomspace(1.0 / duration, rate / 2.0, 401)
        allan = [dense.allan_variance_of_states(space, k) for k in m.tolist()]
        assert_allclose(allan, term.allan_variance(m / rate), rtol=0.03)
        assert_allclose(dense.spectrum_of_states(space, f), term.sampled_psd(f, rate), rtol=0.03)


def test_names_and_units_are_those_of_the_sensor():
    model = aj.AngleRandomWalk(1e-3) + aj.Quantization(1e-5) + aj.Markov(1e-3, 3.0) + aj.DriftRamp(1e-6)
    space = model.state_space(RATE, sensor="accel")
    names = "quantization_now quantization_before markov_mean markov_end drift_ramp_value drift_ramp_slope"
    assert space.names == tuple(names.split())
    assert space.units == ("m/s", "m/s", "m/s²", "m/s²", "m/s²", "m/s³")
    assert model.state_space(RATE).units[::5] == ("rad", "rad/s²")
    assert (space.rate, space.sensor, space.size) == (RATE, "accel", 6)


MATRICES = ("A", "H", "Q", "R", "P0")


def test_files_hold_the_matrices(tmp_path):
    space = MODELS["sum"].state_space(RATE)
    space.to_numpy(tmp_path / "noise.npz")
    text = space.to_matlab()
    with np.load(tmp_path / "noise.npz") as file:
        for name in MATRICES:
            rows = re.search(rf"^{name} = \[(.*?)\];$", text, re.M | re.S)[1].split(";")
            for found in (file[name], np.array([row.split() for row in rows], float)):
                assert_array_equal(found, getattr(space, name))
        told = tuple(file["names"]), tuple(file["units"]), file["rate"]
        assert told == (space.names, space.units, RATE)
    names = re.findall(r"'([^']*)'", re.search(r"^names = {(.*)};$", text, re.M)[1])
    assert tuple(names) == space.names
    assert "A = zeros(0, 0);" in MODELS["white"].state_space(RATE).to_matlab()


@pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler")
def test_a_c_header_compiles_and_holds_the_matrices(tmp_path):
    space = MODELS["sum"].state_space(RATE)
    (tmp_path / "imu.h").write_text(space.to_c_header("imu"), encoding="utf-8")
    loops = "".join(
        f'for (int i = 0; i < {getattr(space, name).size}; i++) printf("%.17g\\n", (&imu_{name}[0][0])[i]);'
        for name in MATRICES
    )
    returned = f"return IMU_STATES != {space.size} || IMU_RATE != {RATE};"
    source = f'#include <stdio.h>\n#include "imu.h"\nint main(void) {{ {loops} {returned} }}'
    (tmp_path / "main.c").write_text(source, encoding="utf-8")
    subprocess.run(["cc", "-std=c99", "-Wall", "-Werror", "main.c"], cwd=tmp_path, check=True)
    printed = subprocess.run([tmp_path / "a.out"], check=True, capture_output=True, text=True).stdout
    expected = np.concatenate([getattr(space, name).ravel() for name in MATRICES])
    assert_array_equal(np.array(printed.split(), float), expected)


class Bare(aj.NoiseTerm):
    coefficient: float | None = aj.parameter("c", time_exponent=0.0)


UNWRITTEN = [
    (aj.BiasInstability(1e-4), {}, "duration"), (aj.BiasInstability(1e-4, 3.0), {"duration": 9.0}, "cutoff"),
    (aj.PowerLaw(1e-4, -0.5), {"duration": 100.0}, "PowerLaw"), (aj.WarmUp(1e-4, 3.0), {}, "warm_up"),
    (aj.BiasStep(1e-4, 3.0), {}, "bias_step"), (Bare(1.0), {}, "bare"),
    (aj.AngleRandomWalk(), {}, "angle_random_walk"),
    (aj.AngleRandomWalk(1.0), {"duration": -1.0}, "duration"),
    (aj.AngleRandomWalk(1.0), {"rate": 0.0}, "rate"),
]  # fmt: skip


def test_what_has_no_state_space_is_named():
    for model, options, word in UNWRITTEN:
        refuses(word, (aj.Model(()) + model).state_space, **{"rate": RATE} | options)

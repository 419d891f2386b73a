"""State spaces: the same noise as the model's, by covariances, likelihoods and a Kalman filter of our own."""

import re
import shutil
import subprocess

import numpy as np
import pytest
from scipy import stats

import allanjax as aj

RATE = 50.0
TERMS = {
    "white": aj.AngleRandomWalk(1e-3),
    "walk": aj.RateRandomWalk(1e-4),
    "quantization": aj.Quantization(2e-5),
    "markov": aj.Markov(1e-3, 3.0),
    "short markov": aj.Markov(1e-2, 0.004),
    "low-pass": aj.LowPass(1e-3, 8.0),
    "second-order low-pass": aj.LowPass(1e-3, 8.0, 2),
    "resonance": aj.Resonance(1e-3, 7.0, 20.0),
    "damped resonance": aj.Resonance(1e-3, 0.7, 0.6),
    "wandering resonance": aj.WanderingResonance(1e-3, 7.0, 20.0, 0.1),
    "line": aj.Sinusoid(1e-3, 3.3),
    "telegraph": aj.Telegraph(1e-3, 4.0),
    "ramp": aj.DriftRamp(1e-6),
}
SUM = aj.AngleRandomWalk(1e-4) + aj.RateRandomWalk(1e-4) + aj.Quantization(2e-5) + aj.Markov(1e-3, 3.0)
RESPONSES = [
    aj.LowPass1(5.0),
    aj.LowPass2(5.0, 3.0),
    aj.Butterworth(5.0, 4),
    aj.Biquad(5.0, 2.0),
    aj.MovingAverage.of(5 / RATE),
    aj.MovingAverage(3.33),
]
MODELS = {
    **{name: aj.Model((term,)) for name, term in TERMS.items()},
    "sum": SUM + aj.Resonance(1e-3, 7.0, 20.0),
    **{repr(r): r * (SUM + aj.Resonance(1e-3, 7.0, 20.0)) + aj.Sinusoid(1e-4, 3.3) for r in RESPONSES},
}


def covariance(space: aj.StateSpace, n: int) -> np.ndarray:
    """Covariance of the first n samples, step by step from the matrices."""
    z, P, found = space.H, space.P0, np.zeros((n, n))
    for j in range(n):
        column = P @ space.H.T
        for k in range(j, n):
            found[j, k] = found[k, j] = (z @ column)[0, 0]
            column = space.A @ column
        found[j, j] += space.R[0, 0]
        P = space.A @ P @ space.A.T + space.Q
    return found


@pytest.mark.parametrize("name", MODELS)
def test_increments_of_samples_have_the_covariance_of_the_model(name):
    """Fourth differences of the phase covariance: rounding leaves them about eleven digits here."""
    model, n = MODELS[name].sampled(RATE), 60
    G = np.asarray(model.phase_covariance(np.arange(n + 3) / RATE))
    both = np.concatenate([G[2:0:-1], G])
    expected = np.convolve(both, [1.0, -4.0, 6.0, -4.0, 1.0], "valid")[:n] * RATE**2
    difference = np.diff(np.eye(n + 1), axis=0)
    found = difference @ covariance(model.state_space(RATE), n + 1) @ difference.T
    for start in (0, 17):  # From the first sample on, as later.
        np.testing.assert_allclose(
            found[start, start:], expected[: n - start], rtol=0.0, atol=1e-8 * abs(expected).max()
        )


@pytest.mark.parametrize("name", MODELS)
def test_spectrum_and_allan_variance_are_the_models(name):
    model = MODELS[name].sampled(RATE)
    space = model.state_space(RATE)
    time = np.array([1, 2, 3, 7, 50, 400]) / RATE
    frequency = np.array([0.01, 0.3, 3.0, 7.1, 13.0])
    np.testing.assert_allclose(space.allan_variance(time), model.allan_variance(time), rtol=1e-8)
    np.testing.assert_allclose(
        space.spectrum(frequency), model.sampled_psd(frequency, RATE), rtol=1e-8, atol=0.0
    )


@pytest.mark.parametrize(
    "term", [aj.BiasInstability(1e-4), aj.PowerLaw(1e-4, 0.5), aj.PowerLaw(1e-4, 1.9)], ids=repr
)
@pytest.mark.parametrize(("rate", "duration"), [(50.0, 3600.0), (1000.0, 1e5)])
def test_flicker_is_within_three_percent(term, rate, duration):
    """At clusters and frequencies that the fit of the processes has not seen."""
    model = aj.Model((term,)).sampled(rate)
    space = model.state_space(rate, duration=duration)
    time = np.unique(np.geomspace(1.0, duration * rate / 2.0, 97).round()) / rate
    frequency = np.geomspace(1.0 / duration, rate / 2.0, 401)
    np.testing.assert_allclose(space.allan_variance(time), model.allan_variance(time), rtol=0.03)
    np.testing.assert_allclose(space.spectrum(frequency), model.sampled_psd(frequency, rate), rtol=0.03)


def innovations(space: aj.StateSpace, z: np.ndarray, P0: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Innovations of a textbook Kalman filter, and their variances."""
    x, P, found, variances = np.zeros(space.size), P0, np.empty(len(z)), np.empty(len(z))
    A, h, Q, R = space.A, space.H[0], space.Q, space.R[0, 0]
    for k, sample in enumerate(z):
        seen = P @ h
        variances[k] = h @ seen + R
        found[k] = sample - h @ x
        gain = seen / variances[k]
        x, P = A @ (x + gain * found[k]), A @ (P - np.outer(gain, seen)) @ A.T + Q
    return found, variances


LIKELY = ["white", "markov", "quantization", "second-order low-pass", "resonance", "wandering resonance"]


@pytest.mark.parametrize("name", [*LIKELY, "LowPass1(bandwidth=5)", "Biquad(bandwidth=5, quality_factor=2)"])
def test_likelihood_of_a_kalman_filter_is_that_of_the_dense_covariance(name):
    """The covariance is from the spectrum of the samples, by a quadrature of ours, for stationary noise."""
    if "(" in name:
        response = next(r for r in RESPONSES if repr(r) == name)
        model = response * (aj.AngleRandomWalk(1e-3) + aj.Markov(1e-3, 3.0))
    else:
        model = MODELS[name] + aj.AngleRandomWalk(1e-3)
    model, n = model.sampled(RATE), 80
    space = model.state_space(RATE)
    # Midpoints over the circle converge exponentially, as the samples' covariance decays.
    m = 2**16
    f = (np.arange(m) + 0.5) / m * RATE / 2.0
    density = np.asarray(model.sampled_psd(f, RATE)) * RATE
    lags = np.arange(n)
    autocovariance = np.array([np.mean(density * np.cos(2.0 * np.pi * f / RATE * d)) for d in lags])
    dense = autocovariance[abs(lags[:, None] - lags)]
    z = np.asarray(aj.simulate(model, n, RATE, 3))
    e, variance = innovations(space, z, space.P0)
    found = -0.5 * np.sum(np.log(2.0 * np.pi * variance) + e**2 / variance)
    expected = stats.multivariate_normal(np.zeros(n), dense).logpdf(z)
    assert found == pytest.approx(expected, rel=1e-8)


SIMULATED = {
    "sum": MODELS["sum"] + aj.Sinusoid(1e-3, 3.3) + aj.DriftRamp(1e-6),
    "filtered": aj.LowPass1(5.0) * SUM + aj.AngleRandomWalk(1e-4),
    "flicker": aj.AngleRandomWalk(1e-4) + aj.BiasInstability(1e-3) + aj.Quantization(1e-6),
}


@pytest.mark.parametrize("name", SIMULATED)
def test_innovations_of_simulated_records_are_white_and_of_their_variance(name):
    """One record a model; at a level of 0.1 % each, and the simulations do not use the matrices."""
    n, model = 8000, SIMULATED[name]
    space = model.state_space(RATE, duration=n / RATE)
    z = np.asarray(aj.simulate(model, n, RATE, 11))
    # Simulations differ in the level at which a record begins.
    e, variance = innovations(space, z - z[0], space.P0 + 1e-2 * np.eye(space.size))
    u = (e / np.sqrt(variance))[200:]
    count = len(u)
    r = np.array([u[d:] @ u[: count - d] for d in range(1, 41)]) / (u @ u)
    ljung_box = count * (count + 2) * np.sum(r**2 / (count - np.arange(1, 41)))
    assert stats.chi2.sf(ljung_box, 40) > 1e-3
    assert abs(u @ u / count - 1.0) < 3.3 * np.sqrt(2.0 / count)


def test_tables_and_units():
    model = aj.AngleRandomWalk(1e-3) + aj.Quantization(1e-5) + aj.Markov(1e-3, 3.0) + aj.DriftRamp(1e-6)
    space = model.state_space(RATE, sensor="accel")
    assert space.names == (
        *("quantization_now", "quantization_before", "markov_mean", "markov_end"),
        *("drift_ramp_value", "drift_ramp_slope"),
    )
    assert space.units == ("m/s", "m/s", "m/s²", "m/s²", "m/s²", "m/s³")
    assert "R = (0.00707 m/s²)²" in str(space)
    assert "drift_ramp_slope" in str(space)


MATRICES = ("A", "H", "Q", "R", "P0")


def test_numpy_file(tmp_path):
    space = MODELS["sum"].state_space(RATE)
    space.to_numpy(tmp_path / "noise.npz")
    with np.load(tmp_path / "noise.npz") as file:
        for name in MATRICES:
            np.testing.assert_array_equal(file[name], getattr(space, name))
        assert tuple(file["names"]) == space.names
        assert tuple(file["units"]) == space.units
        assert file["rate"] == RATE


def test_matlab_script():
    space = MODELS["sum"].state_space(RATE)
    text = space.to_matlab()
    for name in MATRICES:
        rows = re.search(rf"^{name} = \[(.*?)\];$", text, re.M | re.S)[1].split(";")
        found = np.array([[float(x) for x in row.split()] for row in rows])
        np.testing.assert_array_equal(found, getattr(space, name))
    names = re.findall(r"'([^']*)'", re.search(r"^names = {(.*)};$", text, re.M)[1])
    assert tuple(names) == space.names
    assert "A = zeros(0, 0);" in MODELS["white"].state_space(RATE).to_matlab()


@pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler")
def test_c_header(tmp_path):
    space = MODELS["sum"].state_space(RATE)
    (tmp_path / "imu.h").write_text(space.to_c_header("imu"), encoding="utf-8")
    n = space.size
    shapes = {"A": (n, n), "H": (1, n), "Q": (n, n), "R": (1, 1), "P0": (n, n)}
    loops = "".join(
        f'for (int i = 0; i < {r * c}; i++) printf("%.17g\\n", (&imu_{name}[0][0])[i]);'
        for name, (r, c) in shapes.items()
    )
    source = f'#include <stdio.h>\n#include "imu.h"\nint main(void) {{ {loops} return IMU_STATES != {n}; }}'
    (tmp_path / "main.c").write_text(source, encoding="utf-8")
    command = ["cc", "-std=c99", "-Wall", "-Werror", "-o", str(tmp_path / "main"), str(tmp_path / "main.c")]
    subprocess.run(command, check=True)
    printed = subprocess.run([tmp_path / "main"], check=True, capture_output=True, text=True).stdout
    expected = np.concatenate([getattr(space, name).ravel() for name in MATRICES])
    np.testing.assert_array_equal(np.array(printed.split(), float), expected)


class Bare(aj.NoiseTerm):
    """A term of a user's, without a state space."""

    coefficient: float | None = aj.parameter("c", time_exponent=0.0)


@pytest.mark.parametrize(
    ("model", "options", "message"),
    [
        (aj.BiasInstability(1e-4), {}, "bias_instability has no finite state space, .* duration=3600"),
        (aj.BiasInstability(1e-4, 3.0), {"duration": 9.0}, "bias_instability with a cutoff"),
        (aj.PowerLaw(1e-4, -0.5), {"duration": 100.0}, "PowerLaw.*no sum of Gauss–Markov processes"),
        (aj.WarmUp(1e-4, 3.0), {}, "warm_up happens once"),
        (aj.BiasStep(1e-4, 3.0), {}, "bias_step happens once"),
        (Bare(1.0), {}, "bare has no finite state space"),
        (aj.AngleRandomWalk(), {}, "angle_random_walk has no value"),
        (aj.AngleRandomWalk(1.0), {"duration": -1.0}, "duration of a state space must be positive"),
    ],
)
def test_what_has_no_state_space_is_named(model, options, message):
    with pytest.raises(aj.AllanjaxError, match=message):
        aj.Model((model,)).state_space(RATE, **options)


def test_a_response_without_a_filter_is_named():
    class Odd(aj.Response):
        bandwidth: float | None = aj.parameter("f_c", "frequency")

        def power(self, frequency, rate):
            return np.ones_like(frequency)

        def phase_covariance(self, process, lag, rate):
            return process.phase_covariance(lag)

        def filtered(self, x, rate):
            return x

    with pytest.raises(aj.AllanjaxError, match="odd has no finite state space"):
        (Odd(3.0) * aj.AngleRandomWalk(1e-3)).state_space(RATE)

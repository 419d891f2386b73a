"""Simulated records against theory: their Allan variances, written out in NumPy, scatter about the model's.

Tolerances are four standard errors, from the scatter of independent records.
"""

import math

import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
import pytest

from allanjax.base.errors import AllanjaxError, RecordingError, UnitError
from allanjax.noise.model import Model
from allanjax.noise.numerics import increment_autocovariance
from allanjax.noise.simulate import simulate, simulate_recording
from allanjax.noise.terms import (
    AngleRandomWalk,
    BiasInstability,
    DriftRamp,
    LowPass,
    Markov,
    NoiseTerm,
    Quantization,
    RateRandomWalk,
    Resonance,
    Sinusoid,
    parameter,
)

RATE = 50.0
LENGTH = 1000
RECORDS = 300
SIZES = np.array([1, 2, 3, 5, 8, 16, 31, 64, 125, 250, 400])
# Sample interval over a correlation time of 0.7 s.
X = 1.0 / (RATE * 0.7)


class GaussMarkov(NoiseTerm):
    """A user's Markov term, from its phase covariance alone."""

    amplitude: float | None = parameter("q", time_exponent=-0.5)
    memory: float | None = parameter("τ", "time")

    def phase_covariance(self, lag):
        x = lag / self.memory
        return -(self.amplitude**2) * self.memory**3 / 2 * (x - 1 + jnp.exp(-x))


class PowerLaw(NoiseTerm):
    """Rate noise between flicker and random walk, S ∝ f^−3/2."""

    coefficient: float | None = parameter("P")

    def phase_covariance(self, lag):
        return self.coefficient**2 * jnp.where(lag > 0, lag, 1.0) ** 2.5 * (lag > 0)


class CorrelatedAngle(NoiseTerm):
    """An angle that is itself stationary."""

    coefficient: float | None = parameter("A", time_exponent=1.0)

    def phase_covariance(self, lag):
        return self.coefficient**2 * jnp.exp(-lag / 0.3)


class White(NoiseTerm):
    coefficient: float | None = parameter("N", time_exponent=0.5)

    def phase_covariance(self, lag):
        return -(self.coefficient**2) * lag / 2


MODELS = {
    "quantization": Quantization(1e-5),
    "angle random walk": AngleRandomWalk(1e-4),
    "bias instability": BiasInstability(1e-4),
    "bias instability with cutoff": BiasInstability(1e-4, 2.0),
    "rate random walk": RateRandomWalk(1e-4),
    "markov": Markov(1e-4, 0.7),
    "markov shorter than a sample": Markov(1e-4, 0.004),
    "markov longer than the record": Markov(1e-4, 3e3),
    "resonance of the continuous rate": Resonance(1e-4, 6.0, 8.0),
    "resonance of the samples": Resonance(1e-4, RATE / 8, 8.0).sampled(RATE),
    "line of the continuous rate": Sinusoid(1e-4, 6.3),
    "line of the samples": Sinusoid(1e-4, RATE / 8 * 1.03).sampled(RATE),
    "user's markov": GaussMarkov(1e-4, 0.7),
    "user's power law": PowerLaw(1e-4),
    "user's correlated angle": CorrelatedAngle(1e-5),
    "sum of five": Quantization(4e-6)
    + AngleRandomWalk(1e-4)
    + BiasInstability(2e-4)
    + RateRandomWalk(1e-4)
    + DriftRamp(5e-5),
    "sum with two of a kind": Markov(1e-3, 0.05) + Markov(2e-4, 2.0) + AngleRandomWalk(5e-5),
}


def brute_force_allan(x, m):
    """Overlapping Allan variance (4.9) at m samples a cluster, of records along the first axis."""
    theta = np.concatenate([np.zeros((len(x), 1)), np.cumsum(x, axis=1)], axis=1)
    d = theta[:, 2 * m :] - 2 * theta[:, m:-m] + theta[:, : -2 * m]
    return np.mean(d**2, axis=1) / (2 * m**2)


def records(model, n, count, seed=0):
    keys = jax.random.split(jax.random.key(seed), count)
    return np.asarray(jax.jit(jax.vmap(lambda key: model.simulate(key, n, RATE)))(keys))


@pytest.mark.parametrize("name", MODELS)
def test_simulated_allan_variances_are_the_models(name):
    model = Model(()) + MODELS[name]
    x = records(model, LENGTH, RECORDS)
    estimates = np.stack([brute_force_allan(x, m) for m in SIZES], axis=1)
    error = estimates.std(axis=0, ddof=1) / math.sqrt(RECORDS)
    expected = np.asarray(model.allan_variance(SIZES / RATE))
    # The rest is for a line, whose variances hardly scatter.
    assert np.all(np.abs(estimates.mean(axis=0) - expected) < 4 * error + 1e-6 * expected)


def test_a_ramp_is_deterministic():
    x = np.asarray(simulate(DriftRamp(3e-4), 200, RATE, 1))
    np.testing.assert_allclose(np.diff(x), 3e-4 / RATE, rtol=1e-9)
    for m in (1, 7, 100):
        np.testing.assert_allclose(brute_force_allan(x[None], m), (3e-4 * m / RATE) ** 2 / 2, rtol=1e-9)


def test_long_records_of_a_users_term_gain_no_spurious_drift():
    """G grows with the lag, and its rounding must not add up: here to a random walk of the rate."""
    n, m = 2**18, 2**14
    x = records(White(1.0), n, 40)
    estimates = brute_force_allan(x, m)
    error = estimates.std(ddof=1) / math.sqrt(len(x))
    assert abs(estimates.mean() - RATE / m) < 4 * error


# Variance of each sample: that of a mean over the sample interval, or of the process at an instant.
STATIONARY = {
    "markov": (Markov(1e-4, 0.7), 1e-4**2 * 0.35 * 2.0 * (X + math.expm1(-X)) / X**2),
    "resonance": (Resonance(1e-4, 0.5, 8.0).sampled(RATE), 1e-4**2),
    "low pass": (LowPass(1e-4, 0.5).sampled(RATE), 1e-4**2 * math.pi * 0.5),
    "low pass of order 2": (
        LowPass(1e-4, 0.5, order=2).sampled(RATE),
        1e-4**2 * math.pi * 0.5 / math.sqrt(2.0),
    ),
}


@pytest.mark.parametrize("name", STATIONARY)
def test_stationary_noise_is_stationary_from_the_first_sample_on(name):
    """All of these remember for far longer than eight samples: a start at rest would show."""
    term, variance = STATIONARY[name]
    x = records(term, 8, 4000, seed=3)
    error = variance * math.sqrt(2.0 / len(x))
    assert np.all(np.abs(x.var(axis=0) - variance) < 4 * error)


def test_the_power_of_a_resonance_scatters_as_it_says():
    """Over 100 s of 600 periods its formula is good to 2 %; four standard errors of 800 records are 20 %."""
    duration, sigma = 100.0, 3e-4
    term = Resonance(sigma, 6.0, 8.0)
    x = records(term.sampled(RATE), round(duration * RATE), 800, seed=4)
    power = np.mean(x**2, axis=1) / sigma**2
    assert power.mean() == pytest.approx(1.0, abs=4 * power.std() / math.sqrt(len(x)))
    assert float(term.power_scatter(duration)) == pytest.approx(power.var(), rel=4 * math.sqrt(2.0 / len(x)))


def test_increments_have_the_autocovariance_of_the_phase():
    """Flicker's fourth difference at long lags, where rounding of G would drown it, with 15 more digits."""
    found = np.asarray(increment_autocovariance(BiasInstability(1.0).phase_covariance, 200, 1.0))
    with mp.workdps(30):
        G = [mp.mpf(k) ** 2 * mp.log(max(k, 1)) / (2 * mp.pi) for k in range(203)]
        weights = dict(zip(range(-2, 3), (1, -4, 6, -4, 1), strict=True))
        exact = [float(sum(w * G[abs(k + d)] for d, w in weights.items())) for k in range(200)]
    np.testing.assert_allclose(found, exact, rtol=1e-5)


def test_one_sample_and_odd_lengths():
    model = AngleRandomWalk(1.0) + BiasInstability(1.0) + Markov(1.0, 2.0) + RateRandomWalk(1.0)
    for n in (1, 2, 3, 17, 1009):
        x = simulate(model, n, RATE, 0)
        assert x.shape == (n,)
        assert np.isfinite(x).all()


# --- The interface ------------------------------------------------------------------------------------------


def test_same_key_same_samples():
    model = AngleRandomWalk(1.0) + BiasInstability(1.0)
    x = simulate(model, 100, RATE, 5)
    np.testing.assert_array_equal(x, simulate(model, 100, RATE, jax.random.key(5)))
    assert not np.allclose(x, simulate(model, 100, RATE, 6))


def test_a_line_shows_its_amplitude_whatever_its_frequency():
    x = np.asarray(simulate(Sinusoid(2.0, 0.31 * RATE), 5000, RATE, 0))
    assert np.sqrt(2.0) * x.std() == pytest.approx(2.0, rel=1e-3)


def test_new_values_do_not_compile_again():
    compiled = []

    class Counted(AngleRandomWalk):
        def simulate(self, key, n, rate):
            compiled.append(n)
            return super().simulate(key, n, rate)

    def model(scale):
        return (
            Counted(scale)
            + BiasInstability(scale)
            + Markov(scale, 3 * scale)
            + Sinusoid(scale, scale).hold("frequency")
        )

    x, y = simulate(model(1.0), 64, RATE, 0), simulate(model(2.0), 64, RATE, 0)
    assert compiled == [64]
    assert not np.allclose(x, y)
    simulate(model(1.0), 65, RATE, 0)
    assert compiled == [64, 65]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"model": AngleRandomWalk()}, "angle_random_walk has no value"),
        ({"model": AngleRandomWalk(1.0) + Markov(1.0)}, "markov_correlation_time has no value"),
        ({"n": 0}, "positive integer, not 0"),
        ({"n": 2.5}, "positive integer, not 2.5"),
        ({"rate": 0.0}, "rate must be positive and finite, not 0"),
        ({"rate": math.nan}, "rate must be positive and finite, not nan"),
        ({"rate": math.inf}, "rate must be positive and finite, not inf"),
    ],
)
def test_impossible_requests_are_refused(change, message):
    arguments = {"model": AngleRandomWalk(1.0), "n": 10, "rate": 1.0, "key": 0} | change
    with pytest.raises(AllanjaxError, match=message):
        simulate(**arguments)


def test_recordings_of_several_axes():
    models = {
        "gyro_x": AngleRandomWalk(1e-3),
        "gyro_y": AngleRandomWalk(1e-3),
        "accel_z": RateRandomWalk(0.1),
    }
    recording = simulate_recording(
        models, 400, RATE, 3, bias={"accel_z": 9.81}, gyro_unit="°/h", accel_unit="mg", name="bench"
    )
    assert recording.names == ("gyro_x", "gyro_y", "accel_z")
    assert [axis.unit for axis in recording.axes] == ["deg/h", "deg/h", "mg"]
    assert (recording.name, recording.rate, recording.n) == ("bench", RATE, 400)
    gx, gy, az = recording.values.T
    assert gx.std() == pytest.approx(1e-3 * math.sqrt(RATE), rel=4 / math.sqrt(2 * 400))
    assert abs(np.corrcoef(gx, gy)[0, 1]) < 4 / math.sqrt(400)
    assert az[0] == pytest.approx(9.81, abs=0.1)
    np.testing.assert_allclose(recording.own_values[:, 2], az / 9.80665e-3)
    again = simulate_recording(models, 400, RATE, 3)
    np.testing.assert_array_equal(again.values[:, :2], recording.values[:, :2])
    assert [axis.unit for axis in again.axes] == ["deg/s", "deg/s", "m/s²"]


def test_impossible_recordings_are_refused():
    white = AngleRandomWalk(1.0)
    with pytest.raises(AllanjaxError, match="a bias is given for 'gyro_y', which has no model"):
        simulate_recording({"gyro_x": white}, 100, RATE, 0, bias={"gyro_y": 1.0})
    with pytest.raises(AllanjaxError, match="no axis"):
        simulate_recording({}, 100, RATE, 0)
    with pytest.raises(RecordingError, match="temperature"):
        simulate_recording({"temperature": white}, 100, RATE, 0)
    with pytest.raises(RecordingError):
        simulate_recording({"gyro_x": white}, 5, RATE, 0)
    with pytest.raises(UnitError, match="deg/s"):
        simulate_recording({"accel_x": white}, 100, RATE, 0, accel_unit="deg/s")

"""Simulated records: their law exactly, as the linear map of normal variates that a simulation is."""

import functools
import math
import re

import dense
import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree
from noise_terms import DETERMINISTIC, RANDOM, RATE, RESPONSES, TRANSIENT, by_slots, finite
from numpy.testing import assert_allclose, assert_array_equal
from scipy.stats import binom

import allanjax as aj

N, LONG = 24, 1 << 17
INNER = aj.AngleRandomWalk(1e-3) + aj.RateRandomWalk(4e-3)


class OwnMarkov(aj.NoiseTerm):
    amplitude: float | None = aj.parameter("q", time_exponent=-0.5)
    memory: float | None = aj.parameter("τ", "time")

    def phase_covariance(self, lag):
        x = lag / self.memory
        return -(self.amplitude**2) * self.memory**3 / 2 * (x - 1 + jnp.exp(-x))


# As samples are seen; one of a user's; and after filters, of which the other orders are no others.
FILTERS = {name: r for name, r in RESPONSES.items() if not re.match("butterworth [124]", name)}
GAUSSIAN = {
    **{name: aj.Model((term,)).sampled(RATE) for name, term in RANDOM.items() if name != "telegraph"},
    "own": aj.Model((OwnMarkov(5.2e-5, 8.0),)),
    **{name: (filter_ * INNER).sampled(RATE) for name, filter_ in FILTERS.items()},
}


def linear(draw):
    """A simulation as a function of its normal variates, and as many zeros."""

    def drawn_from(normal):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(jax.random, "normal", lambda key, shape=(), dtype=float: normal(shape))
            return draw(jax.random.key(0))

    shapes = []
    jax.eval_shape(lambda: drawn_from(lambda shape: shapes.append(shape) or jnp.zeros(shape)))
    zeros, parts = ravel_pytree([np.zeros(shape) for shape in shapes])

    def of_variates(z):
        left = iter(parts(z))
        return drawn_from(lambda shape: next(left))

    return of_variates, zeros


def rows(draw, cotangents):
    """Linear combinations of the samples, by the variates."""
    f, zeros = linear(draw)
    back = jax.vjp(f, zeros)[1]
    return jax.vmap(lambda c: back(c)[0])(cotangents)


@functools.cache
def maps(of_filters):
    """Matrices L of x = Lz by rows, from one compiled program for all terms and one for all filters."""

    def matrix(name, values):
        model = GAUSSIAN[name].with_values(**values)
        return rows(lambda key: model.simulate(key, N, RATE), np.eye(N))

    matrices = jax.jit(lambda given: {name: matrix(name, values) for name, values in given.items()})
    return by_slots(matrices, {k: finite(m) for k, m in GAUSSIAN.items() if (k in FILTERS) == of_filters})


# A mean is taken without delay on a circle of eight thousand samples; the density of flicker with a cutoff
# ends at an edge, and that of a differentiated one at zero, which short circles do not follow. A user's own G
# is rounded.
TOLERANCES = {"mean of 5": 2e-5, "mean of 3.7": 2e-5, "flicker to 0.9 Hz": 5e-4, "power law -0.5": 2e-6}
TOLERANCES |= {"own": 1e-7}
# All of these but the last two remember for longer than a sample: a start at rest would show.
STATIONARY = ["markov", "short markov", "resonance", "damped resonance", "wandering resonance", "low pass"]
STATIONARY += ["low pass of order 2", "white", "quantization"]


@pytest.mark.parametrize("name", GAUSSIAN)
def test_simulations_have_the_covariance_of_the_model(name):
    """Differences of successive samples; of what is stationary, the samples themselves from the first on."""
    L = maps(name in FILTERS)[name]
    found = L @ L.T
    expected = dense.covariance(RANDOM["markov"] if name == "own" else GAUSSIAN[name], N, RATE)
    if name in STATIONARY:
        assert_allclose(found, expected, rtol=1e-9, atol=1e-10 * abs(expected).max())
    found, expected = (np.diff(np.diff(C, axis=0), axis=1) for C in (found, expected))
    assert_allclose(found, expected, rtol=0.0, atol=TOLERANCES.get(name, 1e-8) * abs(expected).max())


def test_walks_and_flicker_begin_near_zero():
    """The mean of a walk over the first sample interval; flicker's level is that of its first increment."""
    step = dense.allan_variance(dense.covariance(RANDOM["flicker"], 2, RATE), 1) * 2.0
    for name, expected in {"walk": RANDOM["walk"].coefficient ** 2 / RATE / 3.0, "flicker": step}.items():
        assert np.sum(maps(False)[name][0] ** 2) == pytest.approx(expected, rel=1e-6)


def test_long_records_of_a_users_term_gain_no_spurious_drift():
    """G grows with the lag, and its rounding must not add up, here to a walk: the exact Allan variance."""
    n, m = 1 << 16, 1 << 13
    w = np.pad(np.repeat([-1.0, 1.0], m) / m, (n - 2 * m, 0))
    found = jax.jit(lambda w: rows(lambda key: OwnMarkov(5.2e-5, 8.0).simulate(key, n, RATE), w))(w[None])
    assert np.sum(found**2) / 2.0 == pytest.approx(RANDOM["markov"].allan_variance(m / RATE), rel=0.02)


def test_increments_far_apart_have_the_covariance_of_the_phase():
    """Flicker's fourth difference at long lags, where rounding of G would drown it, with 15 more digits."""
    lags = [0, 40, 90, 200, 400]
    steps = np.diff(np.eye(512), axis=0)[lags]
    found = jax.jit(lambda w: rows(lambda key: RANDOM["flicker"].simulate(key, 512, RATE), w))(steps)
    with mp.workdps(30):
        G = [mp.mpf(k) ** 2 * mp.log(max(k, 1)) / (2 * mp.pi) for k in range(403)]
        weights = dict(zip(range(-2, 3), (1, -4, 6, -4, 1), strict=True))
        exact = [float(sum(w * G[abs(k + d)] for d, w in weights.items())) for k in lags]
    assert_allclose(found @ found[0] / 4.1e-5**2, exact, rtol=1e-6)


CHANNEL = aj.ChannelEffect(2.0, lag=0.0, channel="temperature")
COLUMNS = {
    **{name: term for name, term in (DETERMINISTIC | TRANSIENT).items() if name not in ("line", "effect")},
    "falling ramp": aj.DriftRamp(3e-5, sign=-1),
    "given": CHANNEL.given({"temperature": np.arange(LONG) / RATE}, RATE),
}
DRAWN = COLUMNS | {
    "telegraph": RANDOM["telegraph"], "line": DETERMINISTIC["line"], "effect": TRANSIENT["effect"],
    "line of samples": DETERMINISTIC["line"].sampled(RATE),
    "line of phase 0.7": aj.Sinusoid(2.0, 3.7112, phase=0.7),
}  # fmt: skip
MIDDLES = (np.arange(LONG) + 0.5) / RATE


@pytest.fixture(scope="module")
def drawn():
    draws = jax.jit(lambda key: {name: term.simulate(key, LONG, RATE) for name, term in DRAWN.items()})
    return [jax.device_get(draws(jax.random.key(seed))) for seed in (3, 4)]


def test_telegraph_paths_jump_between_two_levels(drawn):
    """By an odd number of Poisson(1/(rate·T_d)) jumps, from either level: counts within four deviations."""
    x = drawn[0]["telegraph"]
    assert_allclose(np.unique(x), [-4.3e-4 / 2.0, 4.3e-4 / 2.0])
    law = binom(len(x) - 1, (1.0 - math.exp(-2.0 / (RATE * 0.3))) / 2.0)
    assert abs(np.count_nonzero(np.diff(x)) - law.mean()) < 4.0 * law.std()
    start = jax.jit(jax.vmap(lambda key: RANDOM["telegraph"].simulate(key, 1, RATE)[0]))
    starts = np.asarray(start(jax.random.split(jax.random.key(1), 64)))
    assert 32 - 16 < np.count_nonzero(starts > 0.0) < 32 + 16


def test_lines_have_their_amplitude_and_a_phase_of_their_own(drawn):
    """Ω0 is that of the samples, or of the continuous line that they are means of, damped by a sinc."""
    waves, damped = np.exp(2j * np.pi * 3.7112 * MIDDLES), np.sinc(3.7112 / RATE)
    records = drawn[0]["line of samples"], drawn[0]["line"], drawn[1]["line"]
    seen, first, second = (2.0 * np.mean(x * waves.conj()) for x in records)
    # Over ten thousand periods what is left of the other frequencies is less than a thousandth.
    assert_allclose(abs(np.array([seen, first / damped, second / damped])), 7.7e-4, rtol=2e-3)
    assert abs(first - second) > 1e-4
    expected = 2.0 * damped * np.real(waves * np.exp(0.7j))
    assert_allclose(drawn[1]["line of phase 0.7"], expected, atol=1e-9)


def test_ramps_and_transients_are_their_columns(drawn):
    """Of unit amplitude in the middles of the samples; a channel that is not given leaves its effect out."""
    for name, term in COLUMNS.items():
        size = getattr(term, term.parameters()[0].name)
        assert_allclose(drawn[0][name], size * term.column(MIDDLES), rtol=1e-9, atol=1e-300, err_msg=name)
    assert not np.any(drawn[0]["effect"])


WARM = aj.RateRandomWalk(0.1) + aj.ChannelEffect(0.5, lag=0.0, channel="temperature")
MODELS = {"gyro_x": aj.AngleRandomWalk(1e-3), "gyro_y": "N=0.2 deg/√s", "accel_z": WARM}


def test_recordings_of_several_axes():
    """White noise of N√rate, to four standard errors; each axis has a draw of its own."""
    n, options = 2048, {"bias": {"accel_z": 9.81}, "accel_unit": "mg", "name": "bench"}
    recording = aj.simulate_recording(MODELS, n, RATE, 3, gyro_unit="°/h", **options)
    assert (recording.names, recording.name, recording.rate, recording.n) == (tuple(MODELS), "bench", RATE, n)
    assert [axis.unit for axis in recording.axes] == ["deg/h", "deg/h", "mg"]
    gx, gy, az = recording.values.T
    assert gx.std() == pytest.approx(1e-3 * math.sqrt(RATE), rel=4 / math.sqrt(2 * n))
    assert gy.std() == pytest.approx(math.radians(0.2) * math.sqrt(RATE), rel=4 / math.sqrt(2 * n))
    assert abs(np.corrcoef(gx, gy)[0, 1]) < 4 / math.sqrt(n)
    assert az[0] == pytest.approx(9.81, abs=4 * 0.1 / math.sqrt(RATE))
    assert_allclose(recording.own_values[:, 2], az / 9.80665e-3)
    assert recording.notes[0] == "simulated"
    assert "temperature" in recording.notes[1]
    level = {"temperature": np.full(n, 40.0)}
    warm = aj.simulate_recording(MODELS, n, RATE, jax.random.key(3), auxiliary=level)
    assert ([axis.unit for axis in warm.axes], len(warm.notes)) == (["deg/s", "deg/s", "m/s²"], 1)
    assert_array_equal(warm.values[:, 0], gx)
    assert_allclose(warm.values[:, 2] - (az - 9.81), 20.0)
    assert not np.any(aj.simulate_recording(MODELS, n, RATE, 4).values[:, 0] == gx)


WHITE = aj.AngleRandomWalk(1.0)
REFUSED = [
    (aj.AllanjaxError, "angle_random_walk", "N", 10, {}), (aj.AllanjaxError, "samples", WHITE, 0, {}),
    (aj.AllanjaxError, "markov_correlation_time", WHITE + aj.Markov(1.0), 10, {}),
    (aj.AllanjaxError, "samples", WHITE, 2.5, {}), (aj.AllanjaxError, "rate", WHITE, 10, {"rate": 0.0}),
    (aj.AllanjaxError, "rate", WHITE, 10, {"rate": math.inf}), (aj.AllanjaxError, "models", {}, 99, {}),
    (aj.AllanjaxError, "gyro_y", {"gyro_x": WHITE}, 99, {"bias": {"gyro_y": 1.0}}),
    (aj.RecordingError, "heat", {"heat": WHITE}, 99, {}), (aj.RecordingError, "16", {"gyro": WHITE}, 15, {}),
    (aj.RecordingError, "'t'", {"gyro_x": WHITE}, 15, {"auxiliary": {"t": np.ones(14)}}),
    (aj.UnitError, "deg/s", {"accel_x": WHITE}, 99, {"accel_unit": "deg/s"}),
    (aj.UnitError, "deg/√h", {"accel_x": "N=1 deg/√h"}, 99, {}),
]  # fmt: skip


def test_what_cannot_be_simulated_is_refused():
    for error, word, models, n, options in REFUSED:
        call = aj.simulate_recording if isinstance(models, dict) else aj.simulate
        with pytest.raises(error, match=word):
            call(models, n, **({"rate": RATE, "key": 0} | options))


def test_presets_have_a_recording_for_each_rate():
    gyros, accels = aj.SENSORS["motionpak2"].simulate(1.0, 1)
    assert (gyros.rate, gyros.n, accels.rate, accels.n) == (100.0, 100, 1000.0, 1000)
    for duration in (0.0, -1.0, math.nan, math.inf):
        with pytest.raises(aj.AllanjaxError, match="duration"):
            aj.SENSORS["cimu"].simulate(duration, 1)

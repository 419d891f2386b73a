"""Numbers for a filter of two parameters: what it predicts and what is true, by other computations."""

import functools

import bench
import numpy as np
import pytest
from altered_fits import without_result
from dense import autocovariance
from dense_fits import recording
from scipy.signal import correlate

import allanjax as aj

RATE, N, SECONDS = 50.0, 16_384, 2.0
WHITE, WALK = aj.AngleRandomWalk(1e-3).hold("coefficient"), aj.RateRandomWalk(4e-4).hold("coefficient")


def held(term):
    """The term or response with all its parameters held: known exactly, so that nothing scatters."""
    return term.hold(*(p.name for p in term.parameters()))


MODELS = {name: WHITE + WALK + held(term) for name, term in {
    "Q": aj.Quantization(2e-5), "B": aj.BiasInstability(6e-4), "R": aj.DriftRamp(1e-3),
    "markov": aj.Markov(1e-3, 3.0), "resonance": aj.Resonance(4e-3, 0.7, 20.0),
    "line": aj.Sinusoid(3e-3, 0.6),
}.items()}  # fmt: skip
MODELS |= {"N + K": WHITE + WALK, "filtered": WHITE + WALK + held(aj.LowPass1(2.0)) * WHITE}


def fit_of(model, seed=3):
    """Fit of a model that is held, to a record of it."""
    x = np.asarray(aj.simulate(model, N, RATE, seed))
    return aj.fit(recording(x, RATE), model, "whittle", as_is=True, vibrating=True)


class Filter:
    """Of N = 1, memory N/K and a correlation time: Riccati's equation, and errors sample by sample."""

    def __init__(self, memory, time=np.inf):
        self.kept = k = np.exp(-1.0 / (time * RATE))
        R, Q = RATE, 1.0 / memory**2 / RATE
        if np.isfinite(time):
            Q = time / 2.0 / memory**2 * (1.0 - k**2)
        # P = k²PR/(P + R) + Q.
        P = max(np.roots([1.0, R * (1.0 - k**2) - Q, -Q * R]))
        self.R, self.Q, self.P, self.gain = R, Q, P * R / (P + R), P / (P + R)

    def predicted(self, steps):
        """Variance that it predicts of the integral after so many samples."""
        # Of the bias and the integral: the bias moves, then the integral takes a sample of it.
        A, move = np.array([[self.kept, 0.0], [self.kept / RATE, 1.0]]), np.array([1.0, 1.0 / RATE])
        C, found = np.diag([self.P, 0.0]), [0.0]
        for _ in range(int(max(steps))):
            C = A @ C @ A.T + self.Q * np.outer(move, move) + np.diag([0.0, self.R / RATE**2])
            found.append(C[1, 1])
        return np.array(found)[steps.astype(int)]

    def true(self, model, steps):
        """True variance: the error is a sum of samples whose weights sum to zero; its past is cut off."""
        past = int(25.0 / self.gain)
        R = autocovariance(model, past + int(max(steps)), RATE)
        found = []
        for n in np.asarray(steps).astype(int):
            share = np.sum(self.kept ** np.arange(1, n + 1))
            w = -share * self.gain * (self.kept * (1.0 - self.gain)) ** np.arange(past)[::-1]
            w = np.concatenate([w, np.ones(n)]) / RATE
            r = correlate(w, w, "full", "fft")[len(w) - 1 :]
            found.append(r[0] * R[0] + 2.0 * r[1:] @ R[1 : len(w)])
        return np.array(found)


@pytest.mark.parametrize("name", MODELS)
def test_true_errors_are_those_of_the_phase_covariance(name):
    """Of bias instability to the 3 % of its Gauss–Markov processes."""
    model = MODELS[name]
    found = aj.horizon(fit_of(model), SECONDS)["gyro_0"]
    steps, rough = np.rint(found.time * RATE), 0.03 if name == "B" else 1e-4
    # The pair, the raw coefficients and the bound are three filters of different memories.
    pair = Filter(found.white.value / found.walk.value)
    np.testing.assert_allclose(found.error**2, pair.true(model, steps), rtol=rough)
    if name != "filtered":  # Of two white noises neither is the raw one.
        assert (found.raw_white, found.raw_walk) == pytest.approx((1e-3, 4e-4))
        np.testing.assert_allclose(found.raw_error**2, Filter(2.5).true(model, steps), rtol=rough)
        np.testing.assert_allclose(found.raw_prediction**2, 1e-6 * Filter(2.5).predicted(steps), rtol=1e-6)
    bounding = Filter(found.bounding_white / found.bounding_walk)
    np.testing.assert_allclose(found.bound**2, found.bounding_white**2 * bounding.predicted(steps), rtol=1e-6)
    # The bound is nowhere below, and touches; the pair is right at the horizon, and as far off as it says.
    assert (found.bound**2 / bounding.true(model, steps)).min() == pytest.approx(1.0, abs=rough)
    predicted = found.white.value**2 * pair.predicted(steps)
    assert predicted[-1] == pytest.approx(found.error[-1] ** 2, rel=1e-6)
    off = np.abs(np.log(predicted / found.error**2)).max()
    assert found.mismatch == pytest.approx(np.exp(off / 2.0), rel=1e-5)
    # Shares are those of single terms.
    if name not in ("N + K", "filtered"):
        own = found.shares["angle_random_walk"] + found.shares["rate_random_walk"]
        alone = pair.true(WHITE + WALK, steps[-1:])[0] / found.error[-1] ** 2
        assert own == pytest.approx(alone, abs=0.01)
    assert sum(found.shares.values()) == pytest.approx(1.0)
    assert (found.white.std, found.sets, found.bias_std) == (0.0, 1, np.inf)
    if name == "N + K":
        # Up to the difference between a walk and its means over samples.
        assert [found.white.value, found.walk.value] == pytest.approx([1e-3, 4e-4], rel=1e-5)
        assert found.inflation == pytest.approx({"white": 1.0, "walk": 1.0}, rel=1e-5)
        assert [found.mismatch, found.raw_factor] == pytest.approx([1.0, 1.0], rel=1e-4)


def test_the_pair_is_the_closest_of_all_and_the_bound_the_tightest():
    """Of nine other memories none predicts the errors better, or bounds them with a lower mean logarithm."""
    model = MODELS["resonance"]
    found = aj.horizon(fit_of(model), SECONDS)["gyro_0"]
    steps = np.rint(found.time * RATE)
    for memory in np.geomspace(0.3, 10.0, 9):
        other = Filter(memory)
        truth, unit = other.true(model, steps), other.predicted(steps)
        ratio = np.log(truth / unit)
        # Grids of memories are a fifth apart.
        assert np.abs(ratio - ratio[-1]).max() > 1.9 * np.log(found.mismatch)
        assert ratio.max() + np.log(unit).mean() > np.log(found.bound**2).mean() - 5e-3


def test_a_gauss_markov_filter_is_found_again_and_predicts_as_it_says():
    """Up to what the mean of the record, 327 s, takes from a process of 3 s: half a per cent."""
    model = WHITE + held(aj.Markov(1e-3, 3.0))
    found = aj.horizon(fit_of(model), SECONDS, process="markov")["gyro_0"]
    assert [found.white.value, found.walk.value] == pytest.approx([1e-3, 1e-3], rel=3e-3)
    assert found.correlation_time.value == pytest.approx(3.0, rel=1e-6)
    assert found.bias_std == pytest.approx(1e-3 * np.sqrt(1.5), rel=3e-3)
    steps = np.rint(found.time * RATE)
    own = Filter(found.white.value / found.walk.value, 3.0)
    np.testing.assert_allclose(found.error**2, own.true(model, steps), rtol=5e-3)
    np.testing.assert_allclose(found.error**2, found.white.value**2 * own.predicted(steps), rtol=5e-3)
    bounding = Filter(found.bounding_white / found.bounding_walk, found.bounding_time)
    assert found.bounding_bias_std == pytest.approx(found.bounding_walk * np.sqrt(found.bounding_time / 2.0))
    assert (found.bound**2 / bounding.true(model, steps)).min() == pytest.approx(1.0, abs=5e-3)


def test_estimated_coefficients_scatter_as_their_fit_says():
    """White noise and a walk that are estimated: the pair is theirs, its intervals those of the fit."""
    fit = bench.fit("walk", "N + K", "whittle")
    found = aj.horizon(fit, 10.0)
    for name, result in found.items():
        for symbol, c in (("N", result.white), ("K", result.walk)):
            own = fit[name][symbol]
            assert c.value == pytest.approx(own.value, rel=0.04)
            # Standard deviations of 400 draws are known to 4 %; the grid of memories is a fifth apart.
            assert c.interval[0] < own.value < c.interval[1]
            width = np.log(c.interval[1] / c.interval[0])
            assert symbol == "N" or width == pytest.approx(4.0 * own.std / own.value, rel=0.35)
            assert c.interval[0] <= c.interval_68[0] <= c.interval_68[1] <= c.interval[1]
            assert c.std == pytest.approx(np.diff(c.interval_68)[0] / 2.0)
        # With a higher probability the bound is wider.
        more, less = (aj.horizon(fit, 10.0, axes=name, probability=p)[name] for p in (0.99, 0.5))
        assert more.bound[-1] > result.bound[-1] > less.bound[-1]
        assert result.bound[-1] > result.error[-1]


def test_likely_sets_are_averaged_over():
    fit = bench.fit("small")
    for name, result in aj.horizon(fit, 10.0).items():
        assert result.sets == len(fit.selection[name].indistinguishable)
        assert sum(result.shares.values()) == pytest.approx(1.0)
        assert result.white.interval[0] <= result.white.value <= result.white.interval[1]


def test_an_axis_without_a_measurement_is_refused_by_name():
    fit = without_result(bench.fit("small"), "gyro_x")
    with pytest.raises(aj.FitError, match="gyro_x"):
        aj.horizon(fit, 10.0, axes="gyro_x")
    assert list(aj.horizon(fit, 10.0)) == ["gyro_y", "gyro_z", "accel_z"]
    none = functools.reduce(without_result, fit.axes[1:], fit)
    with pytest.raises(aj.FitError, match="no axis"):
        aj.horizon(none, 10.0)

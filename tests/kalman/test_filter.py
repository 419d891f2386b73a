"""Filters, smoothers and banks, by dense covariances of the models, a textbook filter and Bayes' rule."""

import dataclasses
from types import SimpleNamespace

import dense
import numpy as np
import pytest
from dense_fits import Gaussian
from numpy.testing import assert_allclose, assert_array_equal
from refusals import refuses
from scipy import stats

import allanjax as aj

# All short records are of one padded length: programs are those of four numbers of states.
RATE, N = 50.0, 70
WHITE = aj.AngleRandomWalk(1e-3)
SUM = WHITE + aj.RateRandomWalk(1e-3) + aj.Quantization(2e-5) + aj.Markov(1e-3, 3.0)
# Lines and ramps leave no noise in a sample without others.
TERMS = {
    "white": WHITE, "walk": aj.RateRandomWalk(1e-4), "quantization": aj.Quantization(2e-5),
    "markov": aj.Markov(1e-3, 3.0), "short markov": aj.Markov(1e-2, 0.004), "low-pass": aj.LowPass(1e-3, 8.0),
    "second-order low-pass": aj.LowPass(1e-3, 8.0, 2), "resonance": aj.Resonance(1e-3, 7.0, 20.0),
    "wandering resonance": aj.WanderingResonance(1e-3, 7.0, 20.0, 0.1), "telegraph": aj.Telegraph(1e-3, 0.3),
    "line": aj.Sinusoid(1e-3, 3.3) + WHITE, "ramp": aj.DriftRamp(1e-2) + WHITE, "sum": SUM,
}  # fmt: skip
RESPONSES = (
    aj.LowPass1(5.0), aj.LowPass2(5.0, 3.0), aj.Butterworth(5.0, 4), aj.Biquad(5.0, 2.0),
    aj.MovingAverage.of(5 / RATE), aj.MovingAverage(3.33),
)  # fmt: skip
MODELS = TERMS | {repr(r): r * SUM + aj.AngleRandomWalk(1e-4) for r in RESPONSES}


def samples(model, n: int = N, seed: int = 1, constant: float = 3.0) -> np.ndarray:
    """Samples of the law of the dense covariance, which begin at the constant."""
    C, D = dense.covariance(model, n, RATE), np.diff(np.eye(n), axis=0)
    steps = np.linalg.cholesky(D @ C @ D.T) @ np.random.default_rng(seed).standard_normal(n - 1)
    return constant + np.append(0.0, np.cumsum(steps))


def recording(z: np.ndarray) -> aj.Recording:
    return aj.Recording.from_array(z, RATE, gyro_unit="rad/s", names=["gyro_x"])


def filtered(z, model, **options) -> aj.FilteredAxis:
    return aj.kalman_filter(recording(z), model, **options).results[0]


@pytest.mark.parametrize("name", MODELS)
def test_likelihood_is_that_of_the_dense_covariance(name):
    """Of the differences, whose covariance is by G(t): rounding leaves it ten digits at worst (LowPass2)."""
    model = MODELS[name]
    z = samples(model)
    assert filtered(z, model).log_likelihood == pytest.approx(-Gaussian(z, RATE).value(model), rel=1e-8)


def test_likelihood_of_flicker_is_that_of_its_sum_of_processes_and_near_its_own():
    """The sum's dense covariance to 1e-8; flicker itself is approximated to 3 % in its spectrum."""
    model = WHITE + aj.BiasInstability(1e-2)
    z, D = samples(model), np.diff(np.eye(N), axis=0)
    found = filtered(z, model).log_likelihood
    own = D @ dense.of_states(model.state_space(RATE, duration=N / RATE), N)[0] @ D.T
    law = stats.multivariate_normal(np.zeros(N - 1), own)
    assert found == pytest.approx(law.logpdf(np.diff(z)), rel=1e-8)
    # A variance that is 3 % off in some directions: 70·0.03²/4 nats of bias, and its scatter.
    assert found == pytest.approx(-Gaussian(z, RATE).value(model), abs=0.3)


def test_the_constant_is_that_of_generalized_least_squares():
    """Unknown, known to be about zero, and none: estimate, deviation and likelihood."""
    z, std = samples(SUM, constant=0.01), 0.02
    C, one = dense.of_states(SUM.state_space(RATE), N)[0], np.ones(N)
    information = one @ np.linalg.solve(C, one)
    unknown, known, none = (filtered(z, SUM, constant_std=s) for s in (None, std, 0.0))
    for found, all_of_it in ((unknown, information), (known, information + std**-2)):
        assert found.constant == pytest.approx(one @ np.linalg.solve(C, z) / all_of_it, rel=1e-7)
        assert found.constant_std == pytest.approx(all_of_it**-0.5, rel=1e-7)
    assert (none.constant, none.constant_std) == (pytest.approx(0.0, abs=1e-15), 0.0)
    for found, covariance in ((known, C + std**2), (none, C)):
        law = stats.multivariate_normal(np.zeros(N), covariance)
        assert found.log_likelihood == pytest.approx(law.logpdf(z), rel=1e-8)
    assert np.isnan(unknown.innovation[0])
    assert known.innovation_std[0] == pytest.approx((C[0, 0] + std**2) ** 0.5, rel=1e-9)


@pytest.mark.parametrize("smooth", [False, True])
@pytest.mark.parametrize("name", ["sum", "LowPass1(bandwidth=5)"])
def test_bias_and_states_are_the_conditional_means(name, smooth):
    """By dense conditioning, the constant with a variance large enough to be unknown to seven digits."""
    model = MODELS[name]
    z, lost = samples(model), np.isin(np.arange(N), [7, 20, 21, 22, N - 1])
    found = filtered(z, model, smooth=smooth, missing=lost)
    assert (found.slow, found.smoothed) == (("rate_random_walk", "markov"), smooth)
    space = model.state_space(RATE)
    drift = np.array([n.endswith("_mean") for n in space.names], float)
    C, joint = dense.of_states(space, N)
    size, wide = space.size, 1e3 * np.abs(C).max()
    rows, constant = np.vstack([np.eye(size), drift]), np.append(np.zeros(size), 1.0)
    with_samples = joint @ np.kron(np.eye(N), space.H).T
    for k in (3, 7, 21, 40, N - 1):
        there = ~lost & (smooth | (np.arange(N) <= k))
        here = slice(k * size, (k + 1) * size)
        cross = rows @ with_samples[here] + wide * constant[:, None]
        prior = rows @ joint[here, here] @ rows.T + wide * np.outer(constant, constant)
        weights = np.linalg.solve((C + wide)[np.ix_(there, there)], cross[:, there].T).T
        mean = weights @ (z[there] - 3.0)
        std = np.sqrt(np.diag(prior - weights @ cross[:, there].T))
        assert_allclose(found.states[k], mean[:-1], atol=0.02 * np.max(std), rtol=1e-3)
        assert found.bias[k] == pytest.approx(mean[-1] + 3.0, abs=5e-3 * (std + abs(mean))[-1])
        assert_allclose(found.state_stds[k], std[:-1], rtol=5e-3, atol=1e-3 * std.max())
        assert found.bias_std[k] == pytest.approx(std[-1], rel=5e-3, abs=1e-9)
    ends = stats.norm.interval(0.95, found.bias, found.bias_std)
    assert_allclose(found.bias_interval - found.bias, ends - found.bias, rtol=1e-7)


def by_numbers(z: np.ndarray, N: float, K: float):
    """Innovations, and the smoothed means of a walk in white noise, with their variances."""
    # The walk x goes on by w, its mean over the interval is x + m, Var w = q, Var m = q/3, Cov = q/2. After
    # Bryson and Frazier: r and n are the later innovations' gradient in the error of x, and its variance.
    q, R, n = K**2 / RATE, N**2 * RATE, len(z)
    e, s, P, gain = (np.empty(n) for _ in range(4))
    x, p, mean = 0.0, 0.0, np.empty(n)
    for k in range(n):
        P[k], s[k], e[k] = p, p + q / 3.0 + R, z[k] - x
        gain[k] = (p + q / 2.0) / s[k]
        mean[k], x, p = x, x + gain[k] * e[k], p + q - gain[k] ** 2 * s[k]
    r, v = np.empty(n), np.empty(n)
    later, spread = 0.0, 0.0
    for k in range(n - 1, -1, -1):
        r[k], v[k] = later, spread
        later, spread = e[k] / s[k] + (1.0 - gain[k]) * later, 1.0 / s[k] + (1.0 - gain[k]) ** 2 * spread
    own = P + q / 3.0
    ahead = P + q / 2.0 - gain * own
    return e, s, mean + own * e / s + ahead * r, own - own**2 / s - ahead**2 * v


@pytest.mark.parametrize("K", [1e-3, 2.5e-6])
def test_a_long_record_is_filtered_and_smoothed_as_by_numbers(K):
    """A memory of a hundred samples, and of 20,000."""
    n, model = 80_000, WHITE + aj.RateRandomWalk(K)
    steps, white = np.random.default_rng(5).standard_normal((2, n))
    z = 1e-3 * np.sqrt(RATE) * white + K / np.sqrt(RATE) * np.cumsum(steps)
    found = filtered(z, model, smooth=True, constant_std=0.0)
    e, s, means, variances = by_numbers(z, 1e-3, K)
    assert_allclose(found.innovation_std, np.sqrt(s), rtol=1e-9)
    assert_allclose(found.innovation, e, rtol=0.0, atol=1e-6 * np.sqrt(s.max()))
    assert_allclose(found.bias_std, np.sqrt(variances), rtol=1e-6)
    assert_allclose(found.bias, means, rtol=0.0, atol=1e-5 * np.sqrt(variances.max()))
    law = -0.5 * np.sum(np.log(2.0 * np.pi * s) + e**2 / s)
    assert found.log_likelihood == pytest.approx(law, abs=1e-6)


@pytest.mark.parametrize(("n", "gap"), [(N, slice(10, 25)), (250, slice(50, 190)), (250, slice(160, 249))])
def test_missing_samples_of_a_recording_are_not_seen(n, gap):
    """Gaps shorter and longer than a block of samples, and one almost to the end."""
    z, lost = samples(SUM, n), np.isin(np.arange(n), np.arange(n)[gap])
    made = recording(z)
    values = np.where(lost[:, None], 99.0, made.values)
    spoilt = dataclasses.replace(made, values=values, missing=lost[:, None])
    found = aj.kalman_filter(spoilt, SUM).results[0]
    assert found.log_likelihood == pytest.approx(-Gaussian(z, RATE, lost).value(SUM), rel=1e-8)
    assert_array_equal(found.missing, lost)
    assert np.isnan(found.innovation[lost]).all()
    assert found.to_dict()["missing"] == lost.sum()
    # Nothing is learnt within the gap, while the walk goes on.
    first, last = gap.start, gap.stop - 1
    assert np.all(np.diff(found.bias_std[first - 1 : last + 1]) > 0.0)
    assert found.bias_std[last + 1] < found.bias_std[last]


def test_drift_is_what_lasts_ten_samples_and_does_not_oscillate():
    long, short = (aj.Markov(1e-3, time / RATE) for time in (11.0, 9.0))
    slow = [filtered(samples(WHITE), WHITE + term).slow for term in (long, short, TERMS["resonance"])]
    assert slow == [("markov",), (), ()]


def test_tests_of_innovations_are_those_of_their_definitions():
    """Ljung and Box with 40 lags, of pairs that are there; NIS two-sided, of noise larger and smaller."""
    z, k = samples(WHITE, 250), np.arange(250)
    for scale, lost in ((1.0, k < 0), (0.8, (k >= 90) & (k < 100)), (1.2, k == 3)):
        found = filtered(scale * z, WHITE, missing=lost)
        u = (found.innovation / found.innovation_std)[1:]
        assert_array_equal(found.standardized[1:], u)
        there = ~np.isnan(u)
        v, n = np.where(there, u, 0.0), there.sum()
        lags = range(1, min(40, n // 5) + 1)
        r2 = [(v[d:] @ v[:-d] / (v @ v)) ** 2 / (there[d:] & there[:-d]).sum() for d in lags]
        statistic, total = n * (n + 2) * sum(r2), v @ v
        assert found.whiteness.statistic == pytest.approx(statistic)
        assert found.whiteness.dof == 40
        assert found.whiteness.p_value == pytest.approx(stats.chi2.sf(statistic, 40))
        assert (found.nis.statistic, found.nis.dof) == (pytest.approx(total), n)
        expected = 2.0 * min(stats.chi2.sf(total, n), stats.chi2.cdf(total, n))
        assert found.nis.p_value == pytest.approx(expected, rel=1e-6, abs=1e-12)


def test_each_axis_has_its_model():
    values = np.column_stack([samples(WHITE), samples(WHITE, seed=2)])
    both = aj.Recording.from_array(values, RATE, gyro_unit="rad/s", names=["gyro_x", "gyro_y"])
    loud = aj.AngleRandomWalk(2e-3)
    models = {"gyro_x": "N=1e-3 rad/√s", "gyro_y": SimpleNamespace(model=aj.Model((loud,)))}
    found = aj.kalman_filter(both, models)
    assert [axis.model for axis in found.results] == [aj.Model((WHITE,)), aj.Model((loud,))]
    each = [Gaussian(z, RATE).value(m) for z, m in zip(values.T, (WHITE, loud), strict=True)]
    assert found.log_likelihood == pytest.approx(-sum(each), rel=1e-9)
    refuses("gyro_y", aj.kalman_filter, both, {"gyro_x": WHITE})


def test_tables_have_the_numbers():
    z, lost = samples(SUM), np.arange(N) == 3
    result = aj.kalman_filter(recording(z), SUM, missing=lost)
    found, frame = result["gyro_x"], result.to_dataframe()
    assert_allclose(frame["time"], np.arange(N) / RATE)
    columns = [found.bias, found.bias_std, *found.bias_interval]
    assert_array_equal(frame[["bias", "bias_std", "bias_lower_95", "bias_upper_95"]].T, columns)
    end = found.names.index("markov_end")
    shown = frame[["markov_end", "markov_end_std"]].T
    assert_array_equal(shown, [found.states[:, end], found.state_stds[:, end]])
    assert_array_equal(np.isnan(frame["sample"]), lost)
    own = aj.Recording.from_array(z, RATE, accel_unit="m/s²", names=["accel_x"])
    assert aj.kalman_filter(own, SUM)["accel_x"].units == ("m/s²", "m/s²", "m/s", "m/s", "m/s²", "m/s²")
    assert found.units == ("rad/s", "rad/s", "rad", "rad", "rad/s", "rad/s")
    told = result.to_dict()["axes"][0]
    assert (told["bias"], told["bias_std"]) == (found.bias[-1], found.bias_std[-1])
    assert (told["drift"], told["samples"]) == (["rate_random_walk", "markov"], N)
    assert told["nis"]["statistic"] == found.nis.statistic


# Three models and one padded length: one program.
SLOW, LENGTH = 10.0, 240
QUIETLY, LOUDLY, DRIFTINGLY = (1e-3, 1e-4), (4e-3, 1e-4), (1e-3, 1e-2)
OF_BANK = {
    name: aj.AngleRandomWalk(n) + aj.RateRandomWalk(k)
    for name, (n, k) in {"quiet": QUIETLY, "noisy": LOUDLY, "drifting": DRIFTINGLY}.items()
}
QUIET, NOISY, _ = OF_BANK.values()


def of_parts(*parts: tuple[float, float]) -> aj.Recording:
    """Record of parts of equal length, each of an LENGTH and a K; the walk goes on through all."""
    rng, each = np.random.default_rng(1), LENGTH // len(parts)
    white = np.concatenate([n * np.sqrt(SLOW) * rng.standard_normal(each) for n, _ in parts])
    steps = np.concatenate([k / np.sqrt(SLOW) * rng.standard_normal(each) for _, k in parts])
    return aj.Recording.from_array(0.01 + white + np.cumsum(steps), SLOW, gyro_unit="rad/s", names=["gyro_x"])


def test_weights_are_bayes_rule():
    """Written out with probabilities, normalized at each sample; so are bias and its spread."""
    change, record = 0.02, of_parts(QUIETLY, LOUDLY)
    lost = np.arange(LENGTH) == 100
    bank = aj.adaptive_filter(record, OF_BANK, switching=change * SLOW, missing=lost)
    found, frame = bank.results[0], bank.to_dataframe()
    assert found.labels == tuple(OF_BANK)
    for k, label in enumerate(OF_BANK):
        assert_array_equal(frame[f"weight_{label}"], found.weights[:, k])
        assert_array_equal(frame[f"probability_{label}"], found.probability[:, k])
    filters = [aj.kalman_filter(record, model, missing=lost).results[0] for model in OF_BANK.values()]
    density = [np.exp(-0.5 * f.standardized**2) / (np.sqrt(2.0 * np.pi) * f.innovation_std) for f in filters]
    density = np.where(np.isnan(density), 1.0, density).T
    transition = np.full((3, 3), change / 2.0) + (1.0 - 1.5 * change) * np.eye(3)
    weights, total = np.full(3, 1.0 / 3.0), 0.0
    for k in range(LENGTH):
        weights = transition @ weights * density[k]
        total += np.log(weights.sum())
        weights = weights / weights.sum()
        assert_allclose(found.weights[k], weights, rtol=1e-8)
        bias = weights @ [f.bias[k] for f in filters]
        assert found.bias[k] == pytest.approx(bias, rel=1e-9)
        if k:
            variance = weights @ [f.bias_std[k] ** 2 + (f.bias[k] - bias) ** 2 for f in filters]
            assert found.bias_std[k] == pytest.approx(np.sqrt(variance), rel=1e-6)
    assert found.log_likelihood == pytest.approx(total, rel=1e-9)
    later = np.ones(3)
    for k in range(LENGTH - 1, -1, -1):
        both = found.weights[k] * later
        assert_allclose(found.probability[k], both / both.sum(), rtol=1e-7)
        later = transition @ (density[k] * later)
        later = later / later.sum()
    low, high = found.bias_interval
    assert_allclose(high - low, 2.0 * 1.959964 * found.bias_std, rtol=1e-6)


@pytest.mark.parametrize(("second", "label"), [(LOUDLY, "noisy"), (DRIFTINGLY, "drifting")])
def test_a_change_half_way_is_found_and_dated(second, label):
    """LENGTH four times as large, K a hundred times: both show in a second or two."""
    found = aj.adaptive_filter(of_parts(QUIETLY, second), OF_BANK)["gyro_x"]
    assert [(c.before, c.after) for c in found.changes] == [("quiet", label)]
    assert found.changes[0].time == pytest.approx(12.0, abs=2.0)
    assert found.weights[110, 0] > 0.95
    assert found.weights[-1, found.labels.index(label)] > 0.9
    assert found.switching == 1e-3


def test_a_model_that_was_ruled_out_comes_back_only_if_it_may():
    record = of_parts(QUIETLY, LOUDLY, QUIETLY)
    can = aj.adaptive_filter(record, OF_BANK).results[0]
    assert [c.after for c in can.changes] == ["noisy", "quiet"]
    never = aj.adaptive_filter(record, OF_BANK, switching=0.0).results[0]
    assert never.changes == ()
    # Without a change the probability by all samples is the last weight.
    assert_allclose(never.probability, np.tile(never.weights[-1], (LENGTH, 1)), atol=1e-9)


WRONG = [
    (aj.AngleRandomWalk(), {}, "angle_random_walk"), (aj.DriftRamp(1e-3), {}, "noise term"),
    (WHITE, {"constant_std": -1.0}, "constant_std"), (WHITE, {"constant_std": np.inf}, "constant_std"),
    (WHITE, {"missing": np.zeros(3, bool)}, "missing"),
    (WHITE, {"missing": np.ones(LENGTH, bool)}, "all samples are missing"),
    ([QUIET], {}, "two models"), ([QUIET, NOISY], {"switching": 5.0}, "change"),
    ([QUIET, NOISY], {"constant_std": -1.0}, "constant_std"),
    ([QUIET, NOISY], {"switching": -0.1}, "change"), ([QUIET, aj.AngleRandomWalk()], {}, "angle_random_walk"),
]  # fmt: skip


def test_what_cannot_be_filtered_is_said():
    for models, options, word in WRONG:
        call = aj.adaptive_filter if isinstance(models, list) else aj.kalman_filter
        refuses(word, call, of_parts(QUIETLY), models, **options)

"""Filters and smoothers, by dense covariances of the models and by a textbook filter."""

import dataclasses

import numpy as np
import pytest
from scipy import stats

import allanjax as aj
from allanjax.kalman.innovations import normalized_square, whiteness
from allanjax.kalman.likelihood import innovations_under, log_likelihoods
from allanjax.kalman.recursion import run_filter, run_smoother
from allanjax.kalman.system import FilterModel, in_blocks, padded

RATE, N = 50.0, 70
WHITE = aj.AngleRandomWalk(1e-3)
SUM = WHITE + aj.RateRandomWalk(1e-3) + aj.Quantization(2e-5) + aj.Markov(1e-3, 3.0)
# Lines and ramps leave no noise in a sample without others.
TERMS = {
    "white": WHITE,
    "walk": aj.RateRandomWalk(1e-4),
    "quantization": aj.Quantization(2e-5),
    "markov": aj.Markov(1e-3, 3.0),
    "short markov": aj.Markov(1e-2, 0.004),
    "low-pass": aj.LowPass(1e-3, 8.0),
    "second-order low-pass": aj.LowPass(1e-3, 8.0, 2),
    "resonance": aj.Resonance(1e-3, 7.0, 20.0),
    "wandering resonance": aj.WanderingResonance(1e-3, 7.0, 20.0, 0.1),
    # It has to jump within the record.
    "telegraph": aj.Telegraph(1e-3, 0.3),
    "line": aj.Sinusoid(1e-3, 3.3) + WHITE,
    "ramp": aj.DriftRamp(1e-2) + WHITE,
    "sum": SUM,
}
RESPONSES = [
    *(aj.LowPass1(5.0), aj.LowPass2(5.0, 3.0), aj.Butterworth(5.0, 4), aj.Biquad(5.0, 2.0)),
    *(aj.MovingAverage.of(5 / RATE), aj.MovingAverage(3.33)),
]
MODELS = {**TERMS, **{repr(r): r * SUM + aj.AngleRandomWalk(1e-4) for r in RESPONSES}}


def dense_of_increments(model: aj.Model, n: int) -> np.ndarray:
    """Covariance of differences of n samples: fourth differences of the phase covariance."""
    G = np.asarray(aj.Model(()).__add__(model).sampled(RATE).phase_covariance(np.arange(n + 1) / RATE))
    both = np.concatenate([G[2:0:-1], G])
    c = np.convolve(both, [1.0, -4.0, 6.0, -4.0, 1.0], "valid")[: n - 1] * RATE**2
    lag = np.arange(n - 1)
    return c[abs(lag[:, None] - lag)]


def dense(space: aj.StateSpace, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Covariance of n samples, [n, n], and of their states with them, [n·states, n], by the recursion."""
    size = space.size
    joint, P = np.zeros((n * size, n * size)), space.P0
    for j in range(n):
        column = P
        for k in range(j, n):
            joint[k * size : (k + 1) * size, j * size : (j + 1) * size] = column
            joint[j * size : (j + 1) * size, k * size : (k + 1) * size] = column.T
            column = space.A @ column
        P = space.A @ P @ space.A.T + space.Q
    H = np.kron(np.eye(n), space.H)
    return H @ joint @ H.T + space.R[0, 0] * np.eye(n), joint, joint @ H.T


def samples(model, n: int, seed: int = 1, constant: float = 3.0) -> np.ndarray:
    return np.asarray(aj.simulate(model, n, RATE, seed)) + constant


def recording(z: np.ndarray) -> aj.Recording:
    return aj.Recording.from_array(z, RATE, gyro_unit="rad/s", names=["gyro_x"])


@pytest.mark.parametrize("name", MODELS)
def test_likelihood_is_that_of_the_dense_covariance(name):
    """Of the differences, whose covariance is by G(t): rounding leaves it ten digits at worst (LowPass2)."""
    model = MODELS[name]
    z = samples(model, N)
    found = aj.kalman_filter(recording(z), model).results[0].log_likelihood
    expected = stats.multivariate_normal(np.zeros(N - 1), dense_of_increments(model, N)).logpdf(np.diff(z))
    assert found == pytest.approx(expected, rel=1e-8)


def test_likelihood_of_flicker_is_that_of_its_sum_of_processes_and_near_its_own():
    """The sum's dense covariance to 1e-8; flicker itself is approximated to 3 % in its spectrum."""
    model = WHITE + aj.BiasInstability(1e-2)
    z = samples(model, N)
    found = aj.kalman_filter(recording(z), model).results[0].log_likelihood
    D = np.diff(np.eye(N), axis=0)
    own = D @ dense(model.state_space(RATE, duration=N / RATE), N)[0] @ D.T
    law = stats.multivariate_normal(np.zeros(N - 1), own)
    assert found == pytest.approx(law.logpdf(np.diff(z)), rel=1e-8)
    exact = stats.multivariate_normal(np.zeros(N - 1), dense_of_increments(model, N)).logpdf(np.diff(z))
    # A variance that is 3 % off in some directions: 70·0.03²/4 nats of bias, and its scatter.
    assert found == pytest.approx(exact, abs=0.3)


def test_a_known_prior_of_the_constant_is_part_of_the_likelihood():
    model, std = SUM, 0.02
    z = samples(model, N, constant=0.01)
    found = aj.kalman_filter(recording(z), model, constant_std=std).results[0]
    C = dense(model.state_space(RATE), N)[0] + std**2
    assert found.log_likelihood == pytest.approx(
        stats.multivariate_normal(np.zeros(N), C).logpdf(z), rel=1e-8
    )
    none = aj.kalman_filter(recording(z - 0.01), model, constant_std=0.0).results[0]
    C = dense(model.state_space(RATE), N)[0]
    expected = stats.multivariate_normal(np.zeros(N), C).logpdf(z - 0.01)
    assert none.log_likelihood == pytest.approx(expected, rel=1e-8)


@pytest.mark.parametrize("smooth", [False, True])
@pytest.mark.parametrize("name", ["sum", "quantization", "resonance", "LowPass1(bandwidth=5)"])
def test_bias_and_states_are_the_conditional_means(name, smooth):
    """By dense conditioning, the constant with a variance large enough to be unknown to seven digits."""
    model = MODELS[name] + aj.AngleRandomWalk(1e-4)
    z, lost = samples(model, N), np.zeros(N, bool)
    lost[[7, 20, 21, 22, N - 1]] = True
    found = aj.kalman_filter(recording(z), model, smooth=smooth, missing=lost).results[0]
    own = FilterModel.of(aj.Model(()).__add__(model), RATE, N / RATE, "gyro")
    C, joint, with_samples = dense(own.space, N)
    size, wide = own.space.size, 1e3 * np.abs(C).max()
    for k in (3, 7, 21, 40, N - 1):
        there = ~lost & (smooth | (np.arange(N) <= k))
        rows = np.concatenate([np.eye(size), own.drift[None]])
        constant = np.append(np.zeros(size), 1.0)
        cross = rows @ with_samples[k * size : (k + 1) * size] + wide * constant[:, None]
        prior = rows @ joint[k * size : (k + 1) * size, k * size : (k + 1) * size] @ rows.T
        prior = prior + wide * np.outer(constant, constant)
        weights = np.linalg.solve((C + wide)[np.ix_(there, there)], cross[:, there].T).T
        mean = weights @ (z[there] - 3.0)
        std = np.sqrt(np.diag(prior - weights @ cross[:, there].T))
        scale = std + np.abs(mean)
        np.testing.assert_allclose(found.states[k], mean[:-1], atol=0.02 * np.max(std), rtol=1e-3)
        assert found.bias[k] == pytest.approx(mean[-1] + 3.0, abs=5e-3 * scale[-1])
        np.testing.assert_allclose(found.state_stds[k], std[:-1], rtol=5e-3, atol=1e-3 * std.max())
        assert found.bias_std[k] == pytest.approx(std[-1], rel=5e-3, abs=1e-9)


def test_gains_that_change_slowly_are_interpolated_closely():
    """80,000 samples with a memory of 20,000, of which blocks are skipped, beside every sample's gain."""
    n = 80_000
    model = WHITE + aj.RateRandomWalk(2.5e-6) + aj.Markov(1e-6, 900.0)
    own = FilterModel.of(model, RATE, n / RATE, "gyro")
    system = padded(own.space, own.drift[None])
    every = system._replace(skip=system.skip._replace(allowed=np.asarray(False)))
    assert bool(system.skip.allowed)
    z = np.random.default_rng(5).standard_normal(n) * 1e-2
    record = in_blocks(z, None)
    (fast, told, states), (slow, expected, all_states) = run_filter(system, record), run_filter(every, record)
    assert not np.array_equal(told.std, expected.std)
    np.testing.assert_allclose(told.std[:n], expected.std[:n], rtol=1e-6)
    spread = np.asarray(expected.std)[:n, :, None]
    assert np.max(np.abs(told.value - expected.value)[:n, :, :1] / spread) < 1e-5
    np.testing.assert_allclose(fast.std[:n], slow.std[:n], rtol=1e-9)
    told, expected = run_smoother(system, states, record), run_smoother(every, all_states, record)
    assert not np.array_equal(told.std, expected.std)
    np.testing.assert_allclose(told.std[:n], expected.std[:n], rtol=1e-6)
    spread = np.asarray(expected.std)[:n, :, None]
    assert np.max(np.abs(told.value - expected.value)[:n, :, :1] / spread) < 1e-5


def test_where_gains_are_kept_results_are_those_of_every_gain():
    """A memory of some hundred samples: both programs stop computing gains; a textbook filter does not."""
    n, model = 6000, WHITE + aj.RateRandomWalk(1e-3)
    space = model.state_space(RATE)
    z = samples(model, n, constant=0.0)
    found = aj.kalman_filter(recording(z), model, constant_std=0.0).results[0]
    x, P, A, h = np.zeros(space.size), space.P0, space.A, space.H[0]
    for k in range(n):
        s = h @ P @ h + space.R[0, 0]
        e = z[k] - h @ x
        assert found.innovation[k] == pytest.approx(e, abs=1e-9 * np.sqrt(s))
        assert found.innovation_std[k] == pytest.approx(np.sqrt(s), rel=1e-9)
        gain = P @ h / s
        x, P = A @ (x + gain * e), A @ (P - s * np.outer(gain, gain)) @ A.T + space.Q


def test_a_smoother_that_keeps_its_gains_is_one_that_does_not():
    """Of two halves of a record, which see each other for a few hundred samples only."""
    n, model = 4000, WHITE + aj.RateRandomWalk(1e-3)
    z = samples(model, n)
    whole = aj.kalman_filter(recording(z), model, smooth=True).results[0]
    part = aj.kalman_filter(recording(z[1000:3001]), model, smooth=True).results[0]
    np.testing.assert_allclose(
        part.bias[900:1100], whole.bias[1900:2100], rtol=0.0, atol=1e-6 * whole.bias_std.max()
    )
    np.testing.assert_allclose(part.bias_std[900:1100], whole.bias_std[1900:2100], rtol=1e-6)
    own = FilterModel.of(model, RATE, n / RATE, "gyro")
    states = run_filter(padded(own.space, own.drift[None]), in_blocks(z, None))[2]
    assert np.asarray(states.settled).any()
    assert run_smoother(padded(own.space, own.drift[None]), states, in_blocks(z, None)).std.shape[1] == 1


@pytest.mark.parametrize(("n", "gap"), [(N, slice(10, 25)), (400, slice(50, 290)), (400, slice(260, 399))])
def test_missing_samples_of_a_recording_are_not_seen(n, gap):
    """Gaps shorter and longer than a block of samples, and one almost to the end."""
    z = samples(SUM, n)
    lost = np.zeros(n, bool)
    lost[gap] = True
    spoilt = np.where(lost, 99.0, z)
    drawn = dataclasses.replace(recording(spoilt), missing=lost[:, None])
    found = aj.kalman_filter(drawn, SUM).results[0]
    D = dense_of_increments(SUM, n)
    # Differences over the gap are sums of single ones.
    sums = np.diff(np.eye(n)[~lost], axis=0)[:, :]
    single = np.linalg.lstsq(np.diff(np.eye(n), axis=0).T, sums.T, rcond=None)[0].T
    law = stats.multivariate_normal(np.zeros(len(sums)), single @ D @ single.T)
    assert found.log_likelihood == pytest.approx(law.logpdf(np.diff(z[~lost])), rel=1e-8)
    assert np.isnan(found.innovation[lost]).all()
    # Nothing is learnt within the gap, while the walk goes on.
    first, last = gap.start, gap.stop - 1
    assert np.all(np.diff(found.bias_std[first - 1 : last + 1]) > 0.0)
    assert found.bias_std[last + 1] < found.bias_std[last]


def test_several_models_at_once_have_the_likelihoods_of_each():
    z = samples(SUM, N)
    models = [SUM, WHITE + aj.Markov(2e-3, 1.0)]
    found = log_likelihoods(*innovations_under(models, z, RATE))
    each = [aj.kalman_filter(recording(z), model).log_likelihood for model in models]
    np.testing.assert_allclose(found, each, rtol=1e-12)


@pytest.mark.parametrize(
    ("term", "slow"),
    [(aj.Markov(1e-3, 3.0), True), (aj.Markov(1e-3, 0.004), False), (aj.Resonance(1e-3, 7.0, 20.0), False)],
)
def test_drift_is_what_lasts_and_does_not_oscillate(term, slow):
    own = FilterModel.of(WHITE + term + aj.Quantization(1e-5), RATE, 1.0, "gyro")
    assert own.slow == ((term.name(),) if slow else ())


def test_tests_of_innovations_are_those_of_their_definitions():
    u = np.random.default_rng(3).standard_normal(400)
    r = np.array([u[d:] @ u[:-d] for d in range(1, 41)]) / (u @ u)
    statistic = 400 * 402 * np.sum(r**2 / (400 - np.arange(1, 41)))
    found = whiteness(u)
    assert found.statistic == pytest.approx(statistic)
    assert found.p_value == pytest.approx(stats.chi2.sf(statistic, 40))
    for scale in (1.0, 0.8, 1.2):
        size = normalized_square(scale * u)
        total = scale**2 * (u @ u)
        expected = 2.0 * min(stats.chi2.sf(total, 400), stats.chi2.cdf(total, 400))
        assert size.p_value == pytest.approx(expected, abs=1e-12)


def test_wrong_models_are_seen_in_the_innovations():
    z = samples(WHITE + aj.Markov(3e-3, 1.0), 4000)
    wrong = aj.kalman_filter(recording(z), WHITE).results[0]
    assert wrong.whiteness.p_value < 1e-6
    loud = aj.AngleRandomWalk(1.5e-3) + aj.Markov(3e-3, 1.0)
    assert aj.kalman_filter(recording(z), loud).results[0].nis.p_value < 1e-6


def test_fits_and_mappings_give_each_axis_its_model():
    values = np.column_stack([samples(WHITE, 3000), samples(WHITE, 3000, seed=2)])
    both = aj.Recording.from_array(values, RATE, gyro_unit="rad/s", names=["gyro_x", "gyro_y"])
    fit = aj.fit(both, "N", as_is=True)
    found = aj.kalman_filter(both, fit)
    assert found["gyro_y"].model.values == pytest.approx({"angle_random_walk": fit["gyro_y"]["N"].value})
    with pytest.raises(aj.AllanjaxError, match="no model for gyro_y"):
        aj.kalman_filter(both, {"gyro_x": WHITE})


@pytest.mark.parametrize(
    ("model", "options", "message"),
    [
        (aj.AngleRandomWalk(), {}, "angle_random_walk has no value"),
        (aj.DriftRamp(1e-3), {}, "nothing random in a sample"),
        (WHITE, {"constant_std": -1.0}, "constant_std must be finite"),
        (WHITE, {"missing": np.zeros(3, bool)}, "missing must have the shape"),
        (WHITE, {"missing": np.ones(N, bool)}, "all samples are missing"),
    ],
)
def test_what_cannot_be_filtered_is_said(model, options, message):
    with pytest.raises(aj.AllanjaxError, match=message):
        aj.kalman_filter(recording(samples(WHITE, N)), model, **options)


def test_words_tables_and_figures(tmp_path):
    found = aj.kalman_filter(recording(samples(SUM, N)), SUM)
    assert "rad/s" in str(found)
    assert "nats" in str(found)
    frame = found.to_dataframe()
    assert len(frame) == N
    np.testing.assert_array_equal(frame["bias"], found["gyro_x"].bias)
    assert "markov_end_std" in frame
    figure = found.plot(path=tmp_path / "filter.png")
    band = figure.axes[0].collections[0].get_paths()[0].vertices[:, 1]
    low, high = found["gyro_x"].bias_interval
    assert band.max() == pytest.approx(np.max(high), rel=1e-3)
    assert band.min() == pytest.approx(np.min(low), rel=1e-3)
    with pytest.raises(aj.AllanjaxError, match="name at least one axis"):
        found.plot("gyro_q")


def test_a_long_record_is_drawn_in_means_that_set_the_scale():
    """900 samples in 300 means of three, and of two where one is missing, whose range the bias is seen in."""
    z, lost = samples(SUM, 900), np.zeros(900, bool)
    lost[1] = True
    panel = aj.kalman_filter(recording(z), SUM, missing=lost).plot().axes[0]
    means = z.reshape(300, 3).mean(axis=1)
    means[0] = (z[0] + z[2]) / 2.0
    line = next(line for line in panel.lines if "samples" in str(line.get_label()))
    scale = np.pi / 180.0 if "deg/s" in panel.get_ylabel() else 1.0
    np.testing.assert_allclose(line.get_ydata() * scale, means, rtol=1e-9)
    low, high = panel.get_ylim()
    assert means.min() > low * scale > means.min() - 0.1 * np.ptp(means)
    assert means.max() < high * scale < means.max() + 0.1 * np.ptp(means)

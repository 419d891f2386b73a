"""Filters of two parameters: what they predict and what is true, by other computations and by simulation."""

import dataclasses

import numpy as np
import pytest
from scipy.signal import fftconvolve

import allanjax as aj
from allanjax.estimate.coasting import (
    Filters,
    actual,
    bounding_pair,
    coasting_steps,
    equal_pair,
    memories,
    predicted,
)

RATE = 50.0
MEMORY = np.array([0.7, 10.0])
# A walk, and Gauss–Markov processes that are forgotten within the horizon, and much later.
TIMES = [np.inf, 0.5, 80.0]


@pytest.mark.parametrize("time", TIMES)
@pytest.mark.parametrize("memory", MEMORY)
def test_the_prediction_is_that_of_a_kalman_filter(memory, time):
    """Riccati's recursion of bias and integral, sample by sample."""
    kept = np.exp(-1.0 / (time * RATE))
    R, Q = RATE, 1.0 / memory**2 / RATE
    if np.isfinite(time):
        Q = time / 2.0 / memory**2 * (1.0 - kept**2)
    P = 1.0
    for _ in range(20_000):
        P = kept**2 * P * R / (P + R) + Q
    covariance = np.diag([P * R / (P + R), 0.0])
    found = []
    for _ in range(100):
        # The bias moves, then the integral takes a sample of it.
        A = np.array([[kept, 0.0], [kept / RATE, 1.0]])
        move = np.array([1.0, 1.0 / RATE])
        covariance = A @ covariance @ A.T + Q * np.outer(move, move) + np.diag([0.0, R / RATE**2])
        found.append(covariance[1, 1])
    filters = Filters(np.array([memory]), np.array([time]), RATE)
    np.testing.assert_allclose(predicted(filters, np.arange(1.0, 101.0))[0], found, rtol=1e-9)


def test_a_process_of_endless_memory_is_a_walk():
    steps = coasting_steps(10.0, RATE)
    walk = predicted(Filters.of_walk(MEMORY, RATE), steps)
    endless = predicted(Filters.of_markov(MEMORY, np.array([1e7]), RATE), steps)
    # The two differ by the ratio of the memory, and of the horizon, to the correlation time.
    np.testing.assert_allclose(endless, walk, rtol=1e-5)


TERMS = [
    aj.AngleRandomWalk(1e-3),
    aj.RateRandomWalk(1e-4),
    aj.Quantization(1e-5),
    aj.Markov(1e-4, 30.0),
    aj.Resonance(1e-3, 7.0, 20.0),
    aj.Sinusoid(1e-3, 3.3),
    aj.DriftRamp(1e-7),
    aj.LowPass1(5.0) * (aj.AngleRandomWalk(1e-3) + aj.RateRandomWalk(1e-4)),
]


def weights_of(memory, time, n, past):
    """Weights of the samples in the error of a filter that has seen `past` and integrates n."""
    filters = Filters(np.array([memory]), np.array([time]), RATE)
    g, kept = filters.gain[0], np.exp(-1.0 / (time * RATE))
    share = np.sum(kept ** np.arange(1, n + 1))
    of_past = -share * g * (kept * (1.0 - g)) ** np.arange(past)[::-1]
    return filters, np.concatenate([of_past, np.ones(n)]) / RATE


# What has no mean is tested apart for processes that return to zero.
CASES = [(term, np.inf) for term in [*TERMS, aj.BiasInstability(2e-4)]]
CASES += [(TERMS[k], time) for k in (0, 3, 5) for time in TIMES[1:]]


@pytest.mark.parametrize(("term", "time"), CASES, ids=repr)
def test_true_variances_are_those_of_the_phase_covariance(term, time):
    """The error is a sum of angles whose weights annihilate lines; its past is cut off after 300 s.

    Of bias instability to the 3 % of its Gauss–Markov processes, and of a ramp to what is cut off.
    """
    model = term if isinstance(term, aj.Model) else aj.Model((term,))
    for memory in MEMORY:
        filters, weights = weights_of(memory, time, n := 100, 15_000)
        of_angles = np.diff(np.concatenate([[0.0], weights, [0.0]])) * -RATE
        lag = np.arange(len(of_angles)) / RATE
        G = np.asarray(model.sampled(RATE).phase_covariance(lag))
        r = np.correlate(of_angles, of_angles, "full")[len(lag) - 1 :]
        expected = r[0] * G[0] + 2.0 * (r[1:] @ G[1:])
        # The mean of so long a record is nearly zero.
        found = actual(model, filters, np.array([float(n)]), 3600.0 if np.isinf(time) else 1e9).sum()
        rough = {"BiasInstability": 0.03, "DriftRamp": 1e-2}.get(type(term).__name__, 1e-5)
        assert found == pytest.approx(expected, rel=rough)


@pytest.mark.parametrize("time", TIMES[1:])
@pytest.mark.parametrize("term", [aj.RateRandomWalk(1e-4), aj.DriftRamp(1e-7)], ids=repr)
def test_what_has_no_mean_counts_from_that_of_the_record(term, time):
    """By the covariance of all samples about their mean, averaged over places in a record of 800 s.

    A filter that has seen 5 s cannot end within the first of them: 1 % of the record, hence 3 %.
    """
    n, size, past = 100, 40_000, 250
    filters, weights = weights_of(0.7, time, n, past)
    if isinstance(term, aj.DriftRamp):
        at = np.arange(size) / RATE
        rows, size_of_step = [term.coefficient * (at - at.mean())], 1.0
    else:
        # A row a step of the walk, of which every hundredth is taken, about the mean of the record.
        after = np.arange(size) >= np.arange(50, size, 100)[:, None]
        rows, size_of_step = after - after.mean(axis=1, keepdims=True), 100.0 * term.coefficient**2 / RATE
    errors = fftconvolve(np.asarray(rows), weights[None, ::-1], "valid", axes=1)
    expected = size_of_step * np.mean(np.sum(errors**2, axis=0))
    found = actual(aj.Model((term,)), filters, np.array([float(n)]), size / RATE).sum()
    assert found == pytest.approx(expected, rel=0.03)


def test_white_noise_and_a_walk_are_found_again():
    """Up to the difference between a walk and its means over samples, some 1e-6 here."""
    model = aj.AngleRandomWalk(2e-3) + aj.RateRandomWalk(1e-4)
    grid, steps = memories(3600.0, RATE, [20.0]), coasting_steps(10.0, RATE)
    filters = Filters.of_walk(grid, RATE)
    truth, unit = actual(model, filters, steps, 3600.0).sum(axis=0), predicted(filters, steps)
    k, N, ratio = equal_pair(truth, unit)
    assert pytest.approx(2e-3, rel=1e-5) == N
    assert N / grid[k] == pytest.approx(1e-4, rel=1e-5)
    assert ratio == pytest.approx(1.0, abs=1e-5)
    k, N = bounding_pair(truth, unit)
    assert pytest.approx(2e-3, rel=1e-5) == N


def test_a_bound_is_nowhere_below_and_no_other_is_tighter():
    model = aj.AngleRandomWalk(1e-3) + aj.BiasInstability(3e-4) + aj.Quantization(1e-5)
    grid, steps = memories(3600.0, RATE), coasting_steps(10.0, RATE)
    filters = Filters.of_walk(grid, RATE)
    truth, unit = actual(model, filters, steps, 3600.0).sum(axis=0), predicted(filters, steps)
    k, N = bounding_pair(truth, unit)
    assert np.all(N**2 * unit[k] >= truth[k] * (1.0 - 1e-12))
    mean = np.log(N**2 * unit[k]).mean()
    for j in range(len(grid)):
        for other in np.geomspace(1e-4, 1e-2, 200):
            if np.all(other**2 * unit[j] >= truth[j]):
                assert np.log(other**2 * unit[j]).mean() >= mean - 1e-9


def test_white_noise_and_a_markov_process_are_found_again():
    """Up to the difference between a process and its means over samples, (h/T)²/12 at most, some 1e-7."""
    model = aj.AngleRandomWalk(2e-3) + aj.Markov(1e-4, 30.0)
    filters = Filters.of_markov(memories(3600.0, RATE, [20.0]), np.array([3.0, 30.0, 300.0]), RATE)
    steps = coasting_steps(10.0, RATE)
    truth, unit = actual(model, filters, steps, 1e9).sum(axis=0), predicted(filters, steps)
    k, N, ratio = equal_pair(truth, unit)
    assert pytest.approx(2e-3, rel=1e-5) == N
    assert filters.memory[k] == pytest.approx(20.0)
    assert filters.correlation_time[k] == pytest.approx(30.0)
    assert ratio == pytest.approx(1.0, abs=1e-5)


def normalized(z: np.ndarray, N: float, K: float, seconds: float, time: float = np.inf) -> float:
    """Mean square of a filter's errors over its prediction, sample by sample."""
    rate, n = 100.0, round(seconds * 100.0)
    R, P, bias, errors, prediction = N**2 * rate, N**2, 0.0, [], 0.0
    kept = np.exp(-1.0 / (time * rate))
    Q = K**2 / rate if np.isinf(time) else K**2 * time / 2.0 * (1.0 - kept**2)
    total, powers = np.cumsum(z) / rate, kept ** np.arange(1, n + 1)
    grown = np.cumsum(powers / kept)
    for k, sample in enumerate(z[:-n]):
        gain = P / (P + R)
        bias = kept * bias + gain * (sample - kept * bias)
        after = P * R / (P + R)
        P = kept**2 * after + Q
        if k > 20_000 and k % n == 0:
            errors.append(total[k + n] - total[k] - powers.sum() * bias / rate)
            prediction = (powers.sum() ** 2 * after + Q * np.sum(grown**2)) / rate**2 + N**2 * seconds
    return float(np.mean(np.square(errors)) / prediction)


def test_errors_of_a_new_record_are_as_predicted(small_fit):
    """Flicker noise that a fit of 200 s knows to 6 %, and 300 errors of 10 s, hence 8 %: together 15 %."""
    found = aj.horizon(small_fit, 10.0, axes="gyro_x")["gyro_x"]
    model = "N=0.2 deg/√h + B=20 deg/h"
    z = np.asarray(aj.simulate_recording({"gyro_x": model}, 320_000, 100.0, 77).values[:, 0])
    assert 0.8 < normalized(z, found.white.value, found.walk.value, 10.0) < 1.25
    # The raw N, and the walk that the fit of the five terms does not detect: far too sure.
    assert found.raw_walk == 0.0
    assert normalized(z, found.raw_white, 1e-9, 10.0) > 5.0
    assert found.raw_factor > 2.0
    assert normalized(z, found.bounding_white, found.bounding_walk, 10.0) < 1.0


def test_errors_of_flicker_are_as_predicted_by_a_gauss_markov_filter():
    """Some 300 errors of 10 s, whose mean square scatters by 8 %, and flicker by sums within 3 %."""
    model = aj.AngleRandomWalk(6e-5) + aj.BiasInstability(1e-4)
    filters = Filters.of_markov(memories(3200.0, 100.0, count=25), np.geomspace(0.1, 3200.0, 11), 100.0)
    steps = coasting_steps(10.0, 100.0)
    k, N, _ = equal_pair(actual(model, filters, steps, 3200.0).sum(axis=0), predicted(filters, steps))
    z = np.asarray(aj.simulate(model, 320_000, 100.0, 77))
    K, time = N / filters.memory[k], filters.correlation_time[k]
    assert 0.8 < normalized(z - z.mean(), N, K, 10.0, time) < 1.25


@pytest.fixture(scope="module")
def found(small_fit):
    return aj.horizon(small_fit, 10.0)


def test_likely_sets_are_averaged_over(found, small_fit):
    for result in found.values():
        assert result.sets == len(small_fit.selection[result.axis.name].indistinguishable)
        assert sum(result.shares.values()) == pytest.approx(1.0)
        assert result.white.interval[0] <= result.white.value <= result.white.interval[1]
        assert result.walk.interval[0] <= result.walk.value <= result.walk.interval[1]


def test_without_a_selection_there_is_one_set(small_recording):
    fit = aj.fit(small_recording["gyro_x"], aj.AngleRandomWalk() + aj.RateRandomWalk() + aj.Quantization())
    result = aj.horizon(fit, 10.0)["gyro_x"]
    assert result.sets == 1
    # White noise and a walk are the filter's own.
    N, K = (fit["gyro_x"][name].value for name in ("N", "K"))
    assert result.white.value == pytest.approx(N, rel=0.01)
    assert result.walk.value == pytest.approx(K, rel=0.05)
    assert result.bounding_walk > result.walk.value


def test_the_table_says_units_factors_and_causes(found):
    text = str(found)
    for words in ("corrections every 10 s", "deg/√h ×", "raw none", "m/s/√h", "times what"):
        assert words in text
    assert list(found["gyro_x"].to_dataframe())[:3] == ["axis", "time", "error"]


def test_the_table_of_a_gauss_markov_process_has_its_time_and_size(small_fit):
    found = aj.horizon(small_fit, 10.0, axes="gyro_z", process="markov")
    result = found["gyro_z"]
    for words in ("Gauss–Markov bias", "T*: correlation time", "K*·√(T*/2)", "deg/h"):
        assert words in str(found)
    variance = result.walk.value**2 * result.correlation_time.value / 2.0
    assert result.bias_std == pytest.approx(np.sqrt(variance))
    assert "T*" in repr(result)
    # With a number more the errors at shorter times are met no worse, but for the grid.
    assert result.mismatch < 1.05 * aj.horizon(small_fit, 10.0, axes="gyro_z")["gyro_z"].mismatch


def test_a_gauss_markov_filter_follows_the_drift():
    """One that soon forgets its bias would predict a vibration best, with twice the error of a walk's."""
    model = aj.AngleRandomWalk(1e-4) + aj.RateRandomWalk(1e-4) + aj.Resonance(3e-3, 11.0, 12.0)
    z = np.asarray(aj.simulate(model, 60_000, RATE, 5))
    terms = "N + K + resonance(frequency=11 Hz)"
    fit = aj.fit(z, terms, "whittle", rate=RATE, gyro_unit="rad/s", as_is=True)
    walk, markov = (aj.horizon(fit, 1.0, process=p)["gyro"].error[-1] for p in ("walk", "markov"))
    assert markov < 1.1 * walk


def test_a_fit_that_was_saved_gives_the_same(found, small_fit, tmp_path):
    aj.write_json(small_fit, tmp_path / "small.json")
    again = aj.horizon(aj.load(tmp_path / "small.json"), 10.0)
    for one, other in zip(found.values(), again.values(), strict=True):
        assert one.white.value == pytest.approx(other.white.value, rel=1e-6)
        assert one.walk.value == pytest.approx(other.walk.value, rel=1e-6)


@pytest.mark.parametrize(
    ("seconds", "options", "message"),
    [
        (0.001, {}, "from two samples, 0.02 s, to half the record, 100 s"),
        (150.0, {}, "to half the record"),
        (10.0, {"process": "flicker"}, "must be walk or markov, not 'flicker'"),
        (10.0, {"probability": 1.0}, "probability of a bound must be from 0.5 to below 1"),
        (10.0, {"axes": "gyro_w"}, "no axis 'gyro_w'"),
    ],
)
def test_what_is_out_of_range_is_refused(small_fit, seconds, options, message):
    with pytest.raises(aj.AllanjaxError, match=message):
        aj.horizon(small_fit, seconds, **options)


def test_an_axis_without_a_measurement_is_refused_by_name(small_fit):
    results = tuple(dataclasses.replace(r, converged=False, reason="no start") for r in small_fit.results)
    fit = dataclasses.replace(small_fit, results=results)
    with pytest.raises(aj.FitError, match="gyro_x: no result: no start"):
        aj.horizon(fit, 10.0, axes="gyro_x")
    with pytest.raises(aj.FitError, match="no axis has a measurement"):
        aj.horizon(fit, 10.0)

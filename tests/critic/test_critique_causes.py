"""How single causes judge: pairs of steps, noise that is louder for a while, spikes, bumps, sets of terms."""

import dataclasses
import itertools

import numpy as np
import pytest
from critic_views import view_of
from one_axis import searched
from scipy.fft import dct
from scipy.linalg import toeplitz
from scipy.signal import butter, freqz, lfilter
from scipy.stats import kstest

from allanjax.critic.bank import Bank, step_coefficients
from allanjax.critic.causes.bias_step import BiasStep
from allanjax.critic.causes.outliers import Outliers, _scores
from allanjax.critic.causes.spectral_shape import SpectralShape
from allanjax.critic.causes.temperature import Temperature
from allanjax.critic.causes.variance_change import VarianceChange
from allanjax.critic.factor import _ends, _grid
from allanjax.critic.gap_filling import impute_gaussian
from allanjax.critic.grouping import grouped
from allanjax.critic.noise import FIXED, MARKOV, RAMP, Noise, family_of
from allanjax.critic.policy import FALSE_ALARMS, AcceptanceRule
from allanjax.critic.step import Step
from allanjax.critic.template_pairs import best_pair
from allanjax.critic.view import EVERYTHING
from allanjax.critic.windows import conspicuous
from allanjax.estimate.evidence import evidences
from allanjax.noise.butterworth import Butterworth
from allanjax.record.completion import in_time, predicted
from benchmarks.common.hidden_effects import draw

# One length for most: one compilation.
N, RATE = 30_000, 50.0


def quantized(n, rng, white=0.3):
    """Increments of a rounded angle, of unit step, over white noise."""
    return np.diff(rng.uniform(-0.5, 0.5, n + 1)) + white * rng.standard_normal(n)


# --- Other channels -----------------------------------------------------------------------------------------


def test_a_counter_is_no_temperature():
    """A channel that is a straight line is a clock, whatever ramp there is in the record; a curve is none."""
    t = np.linspace(0.0, 1.0, N)
    x = np.random.default_rng(31).standard_normal(N) + 3.0 * t
    for channel, is_one in ((np.arange(N) * 7.0 + 3.0, False), (t + 0.3 * np.sin(5.0 * t), True)):
        view = dataclasses.replace(view_of(x), auxiliary={"channel": channel})
        assert (Temperature().p_value(view) is not None) is is_one
        if not is_one:
            assert Temperature().detect(view) is None


# --- Two steps ----------------------------------------------------------------------------------------------


def test_two_shapes_are_the_best_of_all_pairs():
    """Against least squares in time, an offset fitted too, for each of all pairs of places."""
    n, rng = 240, np.random.default_rng(1)
    k = np.arange(n)
    x = rng.standard_normal(n) + 2.5 * (k >= 90) - 2.2 * (k >= 150)
    places = np.arange(4.0, n - 3.0, 4.0)
    power = {"angle_random_walk": 1.0 / RATE}
    noise = Noise(power, float("nan"), False, 0.0, family_of(n, RATE), -1)
    pair = best_pair(Bank(step_coefficients(places, n, n - 1)), view_of(x), noise)

    def fitted(i, j):
        D = np.column_stack([np.ones(n), k >= places[i], k >= places[j]]).astype(float)
        beta, (rest,), *_ = np.linalg.lstsq(D, x, rcond=None)
        return 0.5 * (np.sum((x - x.mean()) ** 2) - rest), beta[1:]

    every = {ij: fitted(*ij)[0] for ij in itertools.combinations(range(len(places)), 2)}
    assert tuple(sorted(pair.members)) == max(every, key=every.get)
    assert pair.amplitude == pytest.approx(fitted(*pair.members)[1], rel=1e-9)
    gains = np.array(list(every.values()))
    price = gains.max() - np.logaddexp.reduce(gains) + np.log(len(gains))
    # One place after the other, the pairs' mean is known to a factor of e.
    assert pair.log_trials_factor == pytest.approx(price, abs=1.0)


def test_a_step_remains_where_a_second_one_does_not_hold():
    """A second step gains just enough beside the one that there is, but not on held-out data."""
    hidden = draw(16, "bias_step", 2.0, duration=600.0, rate=100.0)
    x = hidden.values[:, 0]
    view = view_of(x, rate=100.0)
    found = BiasStep().detect(view)
    assert found is not None
    assert found.held_out() > 0.0
    time = found.parameters["time"]
    assert abs(time.value - hidden.effects[0].parameters["time"]) < 3.0 * time.std


def test_two_steps_that_undo_each_other_are_both_found():
    """Neither is conspicuous alone: there and back in a twentieth of the record."""
    n, rng = N, np.random.default_rng(2)
    k = np.arange(n)
    there, back = 0.46, 0.51
    x = rng.standard_normal(n) + 0.35 * ((k >= there * n) & (k < back * n))
    found = searched(view_of(x), [BiasStep()])
    assert [step.candidate.cause for step in found.steps] == ["bias_step", "bias_step"]
    steps = sorted(found.steps, key=lambda step: step.candidate.support)
    for step, time, amplitude in zip(steps, (there, back), (0.35, -0.35), strict=True):
        for name, truth in (("time", time * n / RATE), ("amplitude", amplitude)):
            q = step.candidate.parameters[name]
            assert abs(q.value - truth) < 4.0 * q.std, name
        assert step.gain > 0.0
    # What had been taken for drift is none.
    assert set(found.start.noise.terms) > {"angle_random_walk"} == set(found.end.noise.terms)


# --- Noise that is louder for a while -----------------------------------------------------------------------


@pytest.mark.parametrize(("kind", "seed"), [("white", 3), ("all", 4)])
def test_which_noise_is_louder_and_by_how_much(kind, seed):
    """White noise under five times as much quantization noise; or all of it grows."""
    n, rng = N, np.random.default_rng(seed)
    k = np.arange(n)
    inside = (k >= 10_000) & (k < 17_500)
    ratio = 1.4 if kind == "white" else 1.08
    if kind == "white":
        x = quantized(n, rng, 0.0) + 0.2 * np.where(inside, ratio, 1.0) * rng.standard_normal(n)
    else:
        x = np.where(inside, ratio, 1.0) * quantized(n, rng, 0.2)
    candidate = VarianceChange().detect(view_of(x))
    assert candidate.details["noise"] == kind
    assert candidate.held_out() > 0.0
    for name, truth in (("start", 10_000 / RATE), ("end", 17_500 / RATE), ("ratio", ratio)):
        q = candidate.parameters[name]
        assert abs(q.value - truth) < 4.0 * q.std, name
    # Taken out, nothing of it is left.
    assert VarianceChange().p_value(candidate.after) > 0.01


def test_a_change_that_lasts_ends_with_the_record():
    n, rng = N, np.random.default_rng(5)
    x = np.where(np.arange(n) >= 19_000, 1.1, 1.0) * rng.standard_normal(n)
    found = VarianceChange().detect(view_of(x)).parameters
    assert found["end"].value == n / RATE
    assert abs(found["start"].value - 19_000 / RATE) < 4.0 * found["start"].std
    assert found["ratio"].value > 1.0


# --- Spikes -------------------------------------------------------------------------------------------------


def test_the_ends_of_a_quantized_record_are_no_outliers():
    """Their scores, in 300 records: as often beyond 3.3 σ as in a normal law (0.58 expected of two ends)."""
    rng, far, uncorrected = np.random.default_rng(6), 0, 0
    for _ in range(300):
        view = view_of(quantized(512, rng, 0.1))
        plain = view.loo_residuals[0] / view.loo_residuals[1]
        ends = [0, -1]
        far += int(np.sum(abs(_scores(view, view.loo_residuals[1])[ends]) > 3.3))
        uncorrected += int(np.sum(abs(plain[ends]) > 3.3))
    assert far <= 4
    # Else the test would show nothing.
    assert uncorrected > 15


def test_neighbours_of_an_outlier_are_found_with_it():
    rng = np.random.default_rng(7)
    x = rng.standard_normal(N)
    x[[5000, 5001, 12_000]] += [60.0, 35.0, -20.0]
    found = Outliers().detect(view_of(x))
    assert [t.value for t in found.details["times"]] == pytest.approx([100.0, 100.02, 240.0])
    assert found.p_value < 1e-6 < found.held_out()
    # Nothing is left of them.
    assert Outliers().detect(found.after) is None


def test_outliers_that_come_to_light_one_after_the_other_are_one_finding():
    rng = np.random.default_rng(9)
    steps = []
    for places in ([3000, 20_000], [10_000]):
        x = rng.standard_normal(N)
        x[places] += 20.0
        view = view_of(x)
        candidate = Outliers().detect(view)
        steps.append(Step(candidate, candidate.held_out(), (), view))
    between = Step(Outliers().detect(view), 1.0, (), view)
    between = dataclasses.replace(between, candidate=dataclasses.replace(between.candidate, cause="warm_up"))
    one, other = grouped([steps[0], between, steps[1]])
    assert other is between
    assert [t.value for t in one.candidate.details["times"]] == pytest.approx([60.0, 200.0, 400.0])
    assert one.candidate.parameters["count"].value == 3
    assert one.gain == steps[0].gain + steps[1].gain


# --- Bumps --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("n", [3000, 60_000])
def test_the_most_conspicuous_bump_has_a_uniform_p_value(n):
    """300 records of independent coefficients; a share below 5 % of 0.05 ± 3 standard errors."""
    rng = np.random.default_rng(8)
    p = [conspicuous(rng.standard_normal(n) ** 2).p_value for _ in range(300)]
    assert kstest(p, "uniform").pvalue > 1e-3
    assert np.mean(np.array(p) < 0.05) == pytest.approx(0.05, abs=3.0 * np.sqrt(0.05 * 0.95 / 300))


# --- Sets of terms ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("allowed", [EVERYTHING, ("quantization", "angle_random_walk", "rate_random_walk")])
def test_the_chosen_set_is_the_best_of_all_sets(seed, allowed):
    """Against the evidence of every set carried to its maximum."""
    rng = np.random.default_rng(seed)
    x = quantized(5000, rng) + np.cumsum(0.01 * rng.standard_normal(5000))
    view = view_of(x, allowed)
    family, weighing = view.family, view.model_evidence
    grid = family.columns[len(FIXED) :]
    share = np.ones((1, len(family.size)))
    every = evidences(family.jobs, weighing.levels, family.columns[: len(FIXED)], grid, family.size, share)
    possible = ~family.jobs.ramp if RAMP not in allowed else np.ones(len(family.jobs.ramp), bool)
    for i, name in enumerate((*FIXED, MARKOV)):
        possible &= ~family.jobs.terms[:, i] if name not in allowed else True
    values = {}
    for k in np.flatnonzero(possible):
        key = (*family.jobs.terms[k], family.jobs.ramp[k])
        values.setdefault(key, []).append(every.log_evidence[0][k])
    best = max(np.logaddexp.reduce(v) - np.log(len(v)) for v in values.values())
    assert view.noise.log_evidence == pytest.approx(best, abs=1e-3)


# --- Ramps --------------------------------------------------------------------------------------------------


def test_a_ramp_that_the_noise_has_is_no_part_of_the_residuals():
    """Left in, it would make them louder at the record's ends: by half for this one."""
    n, rng = N, np.random.default_rng(10)
    white = rng.standard_normal(n)
    view = view_of(white + 2.4 * np.linspace(-0.5, 0.5, n), ("angle_random_walk", RAMP))
    assert view.noise.terms == ("angle_random_walk", RAMP)
    ends = np.abs(np.linspace(-1.0, 1.0, n)) > 0.9
    # Against the true white noise, whose two estimated parameters are known to n^(−1/2).
    assert np.mean(view.whitened[ends] ** 2) == pytest.approx(np.mean(white[ends] ** 2), rel=0.02)
    assert view.recoloured(view.whitened) == pytest.approx(view.samples, abs=1e-9)
    assert VarianceChange().p_value(view) > 0.01


# --- Behind a filter ----------------------------------------------------------------------------------------

# Butterworth of second order, −3 dB at 56 % of the Nyquist frequency.
CORNER = 14.0


def behind_a_filter(n, rng):
    """White noise of unit deviation, filtered."""
    b, a = butter(2, CORNER, fs=RATE)
    return lfilter(b, a, rng.standard_normal(n + 500))[500:]


@pytest.mark.parametrize("gaps", ["scattered", "long"])
def test_samples_are_filled_in_by_the_spectrum_that_the_record_has(gaps):
    """The filter has not been found yet; what is filled in must not be rough behind it."""
    rng = np.random.default_rng(2)
    x, missing = behind_a_filter(N, rng), np.zeros(N, bool)
    if gaps == "long":
        missing[20_000:20_600] = True
    else:
        first = rng.choice(N - 10, 900, replace=False)
        for k, length in zip(first, np.minimum(rng.geometric(0.7, len(first)), 6), strict=True):
            missing[k : k + length] = True
    c = impute_gaussian(view_of(np.where(missing, 0.0, x)), missing).coefficients
    frequency = np.arange(1, N) * RATE / (2.0 * N)
    expected = abs(freqz(*butter(2, CORNER, fs=RATE), frequency, fs=RATE)[1]) ** 2
    # In a thousand coefficients each, down to 45 dB below the passband.
    for low, high in itertools.pairwise(np.flatnonzero(frequency < 24.0)[::1000]):
        ratio = np.mean(c[low:high] ** 2 / expected[low:high])
        # Four standard errors of a thousand squares, and a twentieth for the spectrum's bins.
        assert ratio == pytest.approx(1.0, abs=4.0 * np.sqrt(2.0 / 1000) + 0.05)


def test_a_long_gap_is_bridged_as_by_exact_prediction():
    """Half of a record in noise that wanders, beside a few single samples: against a dense solution."""
    n, rng = 3000, np.random.default_rng(3)
    v = 1.0 + (300.0 / np.arange(1.0, n)) ** 2
    missing = np.zeros(n, bool)
    missing[700:2200] = missing[[100, 101, 2500]] = True
    d = in_time(np.sqrt(v) * rng.standard_normal(n - 1))
    D = dct(np.eye(n)[missing], norm="ortho", axis=1)[:, 1:]
    precision = (D / v) @ D.T
    exact = -np.linalg.solve(precision, (D / v) @ dct(np.where(missing, 0.0, d), norm="ortho")[1:])
    off = predicted(d, missing, v)[missing] - exact
    # A hundredth of what one sample's own chance adds.
    assert off @ precision @ off < 0.01


def only_finding(x):
    """What a search for filters and resonances alone finds, and the record without it."""
    found = searched(view_of(x), [SpectralShape()])
    (step,) = found.steps
    assert step.candidate.cause == "low_pass"
    return step, found.end


def test_a_filter_is_found_above_noise_that_is_added_behind_it():
    """Noise 40 dB below, as of outliers too small to be seen: it must not decide what the filter is."""
    rng = np.random.default_rng(4)
    x = behind_a_filter(N, rng) + 1e-2 * rng.standard_normal(N)
    step, _ = only_finding(x)
    bandwidth = step.candidate.parameters["bandwidth"]
    assert abs(bandwidth.value - CORNER) < 3.0 * bandwidth.std
    assert bandwidth.std < 0.02 * CORNER
    assert step.candidate.parameters["order"].value == 2.0
    # A filter is known by so many coefficients that its evidence and what it foretells are nearly the same.
    assert step.gain == pytest.approx(step.candidate.gain, rel=0.02)


@pytest.mark.parametrize("seed", range(8))
def test_no_filter_is_found_in_unfiltered_noise(seed):
    """Also where one is tried that stops nearly all: a record whose ends are replaced is another record."""
    samples = draw(seed, None, duration=600.0, rate=100.0).values[:, 0]
    candidate = SpectralShape().detect(view_of(samples))
    assert candidate is None or candidate.gain < AcceptanceRule(FALSE_ALARMS).least_log_odds("spectral_shape")


def test_an_analog_filter_is_found_and_its_deep_stop_band_does_no_harm():
    """Sampled after filtering: sixteen times as fast, aliases and all."""
    over = 16
    white = np.random.default_rng(5).standard_normal(N * over)
    x = lfilter(*butter(2, CORNER / 3.0, fs=RATE * over), white)[::over]
    step, _ = only_finding(x)
    bandwidth = step.candidate.parameters["bandwidth"]
    assert abs(bandwidth.value - CORNER / 3.0) < 3.0 * bandwidth.std
    assert bandwidth.std < 0.02 * CORNER
    assert step.candidate.parameters["order"].value == 2.0
    assert step.candidate.gain > 100.0


@pytest.mark.parametrize(("order", "bandwidth"), [(2, 12.0), (2, 20.0), (4, 15.0)])
def test_the_ends_of_a_filtered_record_are_those_of_its_covariance(order, bandwidth):
    """By brute force: the diagonal of D C Dᵀ, less the response, where it is nothing but ends."""
    n, rate = 3000, 100.0
    taps = butter(order, bandwidth, fs=rate)
    echo = lfilter(*taps, np.r_[1.0, np.zeros(n - 1)])
    covariance = toeplitz(np.correlate(echo, np.r_[echo, np.zeros(n - 1)], "valid")[::-1])
    exact = np.diag(dct(dct(covariance, norm="ortho", axis=0), norm="ortho", axis=1))[1:]
    frequency = np.arange(1, n) * rate / (2.0 * n)
    response = abs(freqz(*taps, frequency, fs=rate)[1]) ** 2
    ends = np.interp(frequency, _grid(rate), _ends(Butterworth(bandwidth, order), rate)) / n
    there = (ends > 0.1 * response) & (frequency < 0.998 * rate / 2.0)
    assert there.sum() > 20
    np.testing.assert_allclose(ends[there], (exact - response)[there], rtol=0.02)


def test_nothing_is_left_of_what_a_strong_filter_stops():
    """Deep in the stop band the two ends of the record are loud; they are neither noise nor an effect."""
    x = behind_a_filter(N, np.random.default_rng(6))
    _, after = only_finding(x)
    squares = after.whitened**2 - 1.0
    # 3.9: one of the 20 mean squares, of variance 2/N each, in 500 records.
    z = squares.reshape(20, -1).mean(axis=1) / np.sqrt(2.0 * 20 / N)
    assert np.max(abs(z)) < 3.9
    high = after.family.frequency > 0.45 * RATE
    whitened = (after.residual**2 / after.variance())[high]
    assert abs(whitened.mean() - 1.0) < 4.0 * np.sqrt(2.0 / high.sum())

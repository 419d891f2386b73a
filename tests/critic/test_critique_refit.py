"""What is found is fitted beside what else is found, and known no better than the noise is."""

import numpy as np
import pytest
import scipy.signal
from critic_views import view_of
from one_axis import searched

from allanjax.critic.causes.bias_step import BiasStep
from allanjax.critic.causes.outliers import Outliers
from allanjax.critic.causes.spectral_shape import SpectralShape
from allanjax.critic.causes.warm_up import WarmUp
from allanjax.critic.refit import refitted
from allanjax.critic.step import Step, replay

# One length for all: one compilation.
N, RATE = 30_000, 50.0
TIME = np.arange(N) / RATE


def found_by(x, *causes):
    return searched(view_of(x), causes)


def numbers(candidate):
    return {k: (q.value, q.std) for k, q in candidate.parameters.items() if isinstance(q.value, float)}


def least_squares(x, *shapes):
    """Amplitudes of known shapes in white noise of unit variance, an offset fitted too, and deviations."""
    D = np.column_stack([np.ones(N), *shapes])
    covariance = np.linalg.inv(D.T @ D)
    return (covariance @ D.T @ x)[1:], np.sqrt(np.diag(covariance))[1:]


# A warm-up that is over when the bias jumps back: each takes part of the other for its own.
T, PLACE = 60.0, 100.0
SHAPES = np.exp(-TIME / T), (TIME >= PLACE).astype(float)


@pytest.mark.parametrize("seed", range(3))
def test_what_overlaps_in_time_is_known_as_by_least_squares(seed):
    x = np.random.default_rng(seed).standard_normal(N) + 1.5 * SHAPES[0] - 1.2 * SHAPES[1]
    found = found_by(x, BiasStep(), WarmUp())
    assert sorted(step.candidate.cause for step in found.steps) == ["bias_step", "warm_up"]
    steps = {step.candidate.cause: numbers(step.candidate) for step in found.steps}
    amplitudes, deviations = least_squares(x, *SHAPES)
    for cause, truth, best, deviation in zip(
        ("warm_up", "bias_step"), (1.5, -1.2), amplitudes, deviations, strict=True
    ):
        value, std = steps[cause]["amplitude"]
        assert abs(value - truth) < 3.0 * std
        # With time constant and place known: no more can be known, and these two cost a little.
        assert 0.98 * deviation < std < 2.5 * deviation
        # Place and time constant, not quite known, move it by about as much as its own deviation.
        assert abs(value - best) < 1.5 * deviation


def test_of_two_findings_that_are_nothing_beside_each_other_one_is_dropped():
    """A step that was taken for a warm-up, and what a step explains of the rest."""
    x = np.random.default_rng(3).standard_normal(N) + 0.6 * (TIME < 40.0)
    view = view_of(x)
    wrong = WarmUp().detect(view)
    first = Step.of(wrong, 1.0, (), view)
    right = BiasStep().again(wrong.after)
    second = Step.of(right, 1.0, (), wrong.after)
    both = right.after.with_findings("warm_up", "bias_step")
    steps, end = refitted([first, second], both, [BiasStep(), WarmUp()])
    assert len(steps) == len(end.found) == 1
    assert steps[0].candidate.cause == end.found[0]
    # All that is left taken out is its own.
    assert x - end.samples == pytest.approx(steps[0].change.path, abs=1e-12)


def test_steps_are_strung_together_to_the_end_that_they_have():
    x = np.random.default_rng(4).standard_normal(N) + 1.5 * SHAPES[0] - 1.2 * SHAPES[1]
    found = found_by(x, BiasStep(), WarmUp())
    for before, after in zip(found.steps[:-1], found.steps[1:], strict=True):
        assert after.before.samples == pytest.approx(before.candidate.after.samples, abs=1e-12)
    assert found.steps[0].before.samples == pytest.approx(x, abs=1e-12)
    assert found.steps[-1].candidate.after.samples == pytest.approx(found.end.samples, abs=1e-12)
    # In the other order it is the same end.
    other = replay(found.start, found.steps[::-1])
    assert other[-1].candidate.after.samples == pytest.approx(found.end.samples, abs=1e-12)


@pytest.mark.parametrize("seed", range(2))
def test_a_filter_is_not_bent_by_a_bump_behind_it(seed):
    """White noise and a damped oscillator, its poles sampled exactly, through a Butterworth filter."""
    rng = np.random.default_rng(seed)
    f0, Q, bandwidth = 6.0, 15.0, 9.0
    pole = np.exp(2.0 * np.pi * f0 / RATE * (-0.5 / Q + 1j * np.sqrt(1.0 - 0.25 / Q**2)))
    bump = scipy.signal.lfilter([1.0], [1.0, -2.0 * pole.real, abs(pole) ** 2], rng.standard_normal(N + 1000))
    noise = rng.standard_normal(N + 1000) + 0.3 * bump / bump[1000:].std()
    x = scipy.signal.lfilter(*scipy.signal.butter(2, bandwidth, fs=RATE), noise)[1000:]
    found = found_by(x, SpectralShape())
    assert sorted(step.candidate.cause for step in found.steps) == ["low_pass", "resonance"]
    steps = {step.candidate.cause: numbers(step.candidate) for step in found.steps}
    value, std = steps["low_pass"]["bandwidth"]
    assert abs(value - bandwidth) < min(3.0 * std, 0.03 * bandwidth)
    value, std = steps["resonance"]["frequency"]
    assert abs(value - f0) < 3.0 * std


def test_deviations_allow_for_noise_that_may_drift():
    """Of steps in white noise with a random walk that is at times seen and at times not."""
    z, records = [], 60
    for seed in range(records):
        rng = np.random.default_rng([5, seed])
        walk = np.cumsum(0.0006 * rng.standard_normal(N))
        x = rng.standard_normal(N) + walk + 0.35 * (TIME >= 0.4 * N / RATE)
        candidate = BiasStep().again(view_of(x))
        if candidate is not None:
            value, std = numbers(candidate)["amplitude"]
            z.append((value - 0.35) / std)
    assert len(z) > records / 2
    # Three standard errors of a share of normal deviates within three σ, and of their mean square.
    assert np.mean(np.abs(z) < 3.0) > 0.997 - 3.0 * np.sqrt(0.003 / len(z)) - 1.0 / len(z)
    assert np.mean(np.square(z)) < 1.0 + 3.0 * np.sqrt(2.0 / len(z))


def test_the_scale_of_outliers_is_theirs_in_quantization_noise():
    """Prediction errors of neighbours are no outliers, and those too small to be seen are allowed for."""
    z, records = [], 40
    for seed in range(records):
        rng = np.random.default_rng([6, seed])
        x = np.diff(rng.uniform(-0.5, 0.5, N + 1)) + 0.3 * rng.standard_normal(N)
        places = rng.choice(N, 20, replace=False)
        x[places] += 8.0 * rng.standard_normal(20)
        value, std = numbers(Outliers().detect(view_of(x)))["scale"]
        z.append(np.log(value / 8.0) / (std / value))
    # Three standard errors of the mean, and of the mean square, of normal deviates.
    assert abs(np.mean(z)) < 3.0 / np.sqrt(records)
    assert np.mean(np.square(z)) < 1.0 + 3.0 * np.sqrt(2.0 / records)

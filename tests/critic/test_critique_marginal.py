"""The odds of an effect, against sums over all levels that the noise may have and all its shapes."""

import dataclasses

import numpy as np
import pytest
from dense_records import POWERS, RATE, N, covariances, simulated, view_of
from scipy.fft import dct
from scipy.stats import kstest

from allanjax.critic.bank import step_bank
from allanjax.critic.causes.bias_step import BiasStep
from allanjax.critic.causes.variance_change import VarianceChange
from allanjax.critic.model_evidence import Sets
from allanjax.critic.policy import FALSE_ALARMS, AcceptanceRule
from allanjax.critic.template_evidence import _products, log_evidence
from allanjax.critic.view import Candidate

DECADES = np.log1p(1e4)
#: Amplitudes that such records hardly tell from none: below, the prior is uniform.
PRIOR_SCALES = {"angle_random_walk": 0.25, "rate_random_walk": 0.12}
LEVELS, LARGEST = 30, 300.0


def levels(name):
    """Coefficients, and the logarithms of their prior probabilities, half of which is that of none."""
    top = np.log1p(LARGEST)
    y = (np.arange(LEVELS) + 0.5) * top / LEVELS
    return [(0.0, 0.0), *((PRIOR_SCALES[name] * np.expm1(u), np.log(top / LEVELS / DECADES)) for u in y)]


def summed_odds(x, steps):
    """A sum over white noise, random walk, steps and amplitudes of both signs; covariances are dense ones.

    White noise is diagonal in any basis: that of the random walk's eigenvectors will do for all levels.
    """
    D = dct(np.eye(N), norm="ortho", axis=0)[1:]
    walk, axes = np.linalg.eigh(D @ covariances(N)["rate_random_walk"] @ D.T)
    c, h = axes.T @ D @ x, axes.T @ D @ steps.T
    units, width = np.linspace(-20.0, 20.0, 401, retstep=True)
    prior = -np.log(2.0 * DECADES * (1.0 + abs(units))) + np.log(width)
    without, with_step = [], []
    for a, price in levels("angle_random_walk"):
        for b, other in levels("rate_random_walk"):
            if a == b == 0.0:
                continue
            v = a**2 * RATE + b**2 * walk
            snr = (h.T @ (c / v)) / np.sqrt((h**2).T @ (1.0 / v))
            each = np.logaddexp.reduce(np.outer(units, snr) + (prior - 0.5 * units**2)[:, None], axis=0)
            without.append(price + other - 0.5 * c @ (c / v) - 0.5 * np.log(v).sum())
            with_step.append(without[-1] + np.logaddexp.reduce(each) - np.log(len(each)))
    return np.logaddexp.reduce(with_step) - np.logaddexp.reduce(without)


def odds(x):
    """As the search finds them: from the best of steps in each noise, which is chosen anew without it."""
    view = dataclasses.replace(view_of(x), allowed=tuple(POWERS))
    bank, places = step_bank(N)
    found = []
    for noise in view.noises:
        for _ in range(2):
            scan = bank.scan(view, noise)
            k, a = scan.best, float(scan.amplitude[scan.best])
            after = view.with_samples(x - a * (np.arange(N) >= places[k]))
            noise = after.noise
        found.append(log_evidence(view, after, bank, k, a) - view.log_evidence)
    return max(found), summed_odds(x, (np.arange(N) >= places[:, None]).astype(float))


def test_the_odds_of_a_step_are_those_of_all_noise_and_all_steps():
    """That of the best noise with the best step to the best one without is off by 0.7 nats rms."""
    heights, seeds = (0.0, 1.5, 3.0, 6.0), range(4)
    found = np.array(
        [
            odds(simulated(N, 1, np.random.default_rng(seed))[0] + height * (np.arange(N) >= 50))
            for height in heights
            for seed in seeds
        ]
    )
    error = found[:, 0] - found[:, 1]
    # Laplace's integral over coefficients of which one may be nought, in 128 samples.
    assert np.sqrt(np.mean(error**2)) < 0.5
    assert np.max(abs(error)) < 1.0
    # There are steps among these, and records without one.
    assert found[:, 1].min() < -1.0
    assert found[:, 1].max() > 10.0


def test_products_leave_out_what_is_free():
    """A ramp in one set of two, and another step: as the matched filters do, which are least squares."""
    rng = np.random.default_rng(7)
    x = simulated(N, 1, rng)[0] + 0.05 * np.arange(N) + 2.0 * (np.arange(N) >= 90)
    bank, places = step_bank(N)
    other = bank.shapes[len(places) // 4]
    view = dataclasses.replace(view_of(x), nuisances=(other,))
    noise = view.model_evidence.best(("angle_random_walk", "rate_random_walk", "drift_ramp"), ("drift_ramp",))
    level = sum(p * view.family.unit(name, 0)[0] for name, p in noise.power.items())
    sets = Sets(np.zeros(2), np.stack([level, level]), np.array([True, False]))
    # What was found twice is no reason to fail.
    cross, gram = _products(dataclasses.replace(view, nuisances=(other, other)), bank, sets)
    for row, ramp in enumerate(sets.ramp):
        scan = bank.scan(view, dataclasses.replace(noise, ramp=bool(ramp)))
        others = abs(gram[row]) > 1e-6 * gram[row].max()
        # Levels of bins and of single coefficients differ by less than a percent.
        assert (cross / np.sqrt(gram))[row, others] == pytest.approx(scan.snr[others], abs=0.02)
        assert cross[row, others] / gram[row, others] == pytest.approx(scan.amplitude[others], abs=0.02)


def test_the_p_value_of_a_change_of_variance_is_uniform():
    """Changes that last and those that do not are counted, each as often as it may be there."""
    rng, n, rate = np.random.default_rng(11), 8192, 10.0
    found = []
    for _ in range(200):
        x = rng.standard_normal(n)
        view = view_of(x, rate=rate)
        found.append(VarianceChange().p_value(view))
    # One in a thousand sets of uniform values is rejected.
    assert kstest(found, "uniform").pvalue > 1e-3


def test_of_six_axes_each_may_have_a_sixth_of_the_false_findings():
    """Odds that an axis has by chance once in a hundred records are found in six axes six times as often."""
    x = np.zeros(N)
    step = Candidate("bias_step", {}, 2.0, 1e-3, view_of(x), lambda: 1.0, (0.0, 1.0), "time")
    cause = BiasStep()
    for axes in (1, 6):
        accepted = AcceptanceRule.of(FALSE_ALARMS / axes, [cause])
        least = 1.0 + float(np.log(axes))
        for gain in (least - 0.01, least + 0.01):
            assert accepted.accepts(dataclasses.replace(step, gain=gain)) is (gain > least)
        probable = dataclasses.replace(step, gain=10.0, p_value=1.01 * FALSE_ALARMS / axes)
        assert not accepted.accepts(probable)

"""Sets of terms that a fit leaves likely: what rivals are drawn from."""

import numpy as np
import pytest

import allanjax as aj
from allanjax.estimate.likely_models import _powers, likely_models

# Octaves of a record of 2¹⁶ samples at 10 Hz, and roughly the degrees of freedom of their variances.
T = 0.1 * 2.0 ** np.arange(16)
DEGREES = np.maximum(6553.6 / T - 1.0, 1.0)
MODEL = aj.AngleRandomWalk(3e-5) + aj.RateRandomWalk(1e-7)
COLUMNS = np.stack([1.0 / T, T / 3.0], axis=1)
POWER = np.array([9e-10, 1e-14])


@pytest.fixture(scope="module")
def scattered() -> np.ndarray:
    """Powers found in 300 sets of independent variances around the truth."""
    rng = np.random.default_rng(5)
    variances = (COLUMNS @ POWER) * rng.chisquare(DEGREES, (300, len(T))) / DEGREES
    return np.stack([_powers(COLUMNS, v, DEGREES).value for v in variances])


def test_powers_scatter_around_the_truth_as_their_information_says(scattered: np.ndarray) -> None:
    """Mean and standard deviation over 300 sets, which are known to 6 and 4 %."""
    found = _powers(COLUMNS, COLUMNS @ POWER, DEGREES)
    assert found.value == pytest.approx(POWER, rel=1e-4)
    expected = np.sqrt(np.diag(np.linalg.inv(found.information)))
    # Three standard errors of a mean, and four of a standard deviation.
    assert np.all(np.abs(scattered.mean(axis=0) - POWER) < 3.0 * expected / np.sqrt(300.0))
    assert scattered.std(axis=0) == pytest.approx(expected, rel=0.16)


def test_draws_are_as_wide_as_the_powers_scatter(scattered: np.ndarray) -> None:
    """Ratios of the 84 % to the 16 % quantiles; of 300 sets the logarithm of one is known to 8 %."""
    draws = _powers(COLUMNS, COLUMNS @ POWER, DEGREES).drawn(2000, np.random.default_rng(1))
    of_draws, of_sets = (
        np.diff(np.log(np.quantile(x, (0.16, 0.84), axis=0)), axis=0) for x in (draws, scattered)
    )
    assert of_draws == pytest.approx(of_sets, rel=0.25)


def test_a_term_that_is_not_there_has_draws_below_its_limit() -> None:
    """White noise alone: the walk's draws reach what would be seen, and are told as limited."""
    variance = COLUMNS[:, 0] * POWER[0] * (1.0 - 0.05 * (T > 100.0))
    found = _powers(COLUMNS, variance, DEGREES)
    assert found.value[1] == 0.0
    walk = found.drawn(2000, np.random.default_rng(2))[:, 1]
    # The walk with which the longest variances would be some two standard deviations too large.
    each = np.sqrt(2.0 / DEGREES) * variance / COLUMNS[:, 1]
    assert 0.5 < np.quantile(walk, 0.95) / (1.96 / np.sqrt(np.sum(each**-2.0))) < 2.0


def test_rivals_have_the_walk_that_the_fit_has_not() -> None:
    """A walk too small to be chosen: some rival set has it, with draws on both sides of the truth."""
    weak = aj.AngleRandomWalk(3e-5) + aj.RateRandomWalk(5e-8)
    recording = aj.simulate_recording({"gyro_x": weak}, 36_000, 10.0, 77)
    fit = aj.fit(recording, as_is=True)
    sets = likely_models(fit, "gyro_x", 4000, np.random.default_rng(0))
    walks = [s.power[:, s.labels.index("rate_random_walk")] for s in sets if "rate_random_walk" in s.labels]
    walks = np.sqrt(np.concatenate(walks))
    assert len(sets) > 2
    assert np.quantile(walks, 0.025) < 5e-8 < np.quantile(walks, 0.975)

"""Intervals mean what they say: short versions of `benchmarks/studies/coverage.py` and `detection_edge.py`.

Records are simulated with NumPy alone, many at once as the axes of one recording. Rates are compared within
four binomial standard errors, so that one comparison in 16,000 fails by chance.
"""

import numpy as np
import pytest
from scipy.linalg import toeplitz
from scipy.stats import kstest
from white_and_walk import RATE, N, records, walk

import allanjax as aj

RECORDS = 240
MODEL = aj.AngleRandomWalk() + aj.RateRandomWalk()


def bound(N_coefficient: float, K: float) -> np.ndarray:
    """Cramér–Rao standard deviations of N and K: ½ tr(C⁻¹C_i C⁻¹C_j) of the differenced record."""
    white = np.zeros(N - 1)
    white[:2] = 2.0 * RATE, -RATE
    random_walk = np.zeros(N - 1)
    random_walk[:2] = 2.0 / 3.0 / RATE, 1.0 / 6.0 / RATE
    parts = [2.0 * N_coefficient * toeplitz(white), 2.0 * K * toeplitz(random_walk)]
    C = N_coefficient**2 * toeplitz(white) + K**2 * toeplitz(random_walk)
    scaled = [np.linalg.solve(C, part) for part in parts]
    information = np.array([[0.5 * np.sum(a * b.T) for b in scaled] for a in scaled])
    return np.sqrt(np.diag(np.linalg.inv(information)))


def rate_is(count: int, expected: float, of: int = RECORDS) -> bool:
    return abs(count / of - expected) < 4.0 * np.sqrt(expected * (1.0 - expected) / of)


@pytest.fixture(scope="module")
def clear() -> aj.Recording:
    """A rate random walk that is plainly there."""
    return records(1.0, 5.0, RECORDS, seed=1)


@pytest.mark.parametrize("objective", ["allan", "whittle"])
def test_intervals_cover_and_estimates_are_efficient(clear, objective) -> None:
    # Of so many axes at once, one that looks touched by chance would cut them all.
    fit = aj.fit(clear, MODEL, objective, as_is=True, vibrating=True)
    for label, truth, best in zip(MODEL.term_labels, (1.0, 5.0), bound(1.0, 5.0), strict=True):
        found = [result[label] for result in fit.values()]
        assert rate_is(sum(c.interval[0] <= truth <= c.interval[1] for c in found), 0.95), label
        assert rate_is(sum(c.interval_68[0] <= truth <= c.interval_68[1] for c in found), 0.68), label
        rmse = np.sqrt(np.mean([(c.value - truth) ** 2 for c in found]))
        # The bound, 10 % for the Allan variances, and four standard errors of an RMSE, 1/√(2·RECORDS).
        allowed = (1.1 if objective == "allan" else 1.05) * (1.0 + 4.0 / np.sqrt(2.0 * RECORDS))
        assert rmse < allowed * best, label


@pytest.mark.parametrize("objective", ["allan", "whittle"])
@pytest.mark.parametrize("K", [0.5, 1.0, 2.0])
def test_intervals_and_limits_cover_through_the_edge_of_detection(K, objective) -> None:
    faint = records(1.0, K, RECORDS, seed=2)
    fit = aj.fit(faint, MODEL, objective, as_is=True, vibrating=True)
    found = [r["rate_random_walk"] for r in fit.results]
    detected = sum(c.detected for c in found)
    if K == 1.0:
        assert 0.05 * RECORDS < detected < 0.95 * RECORDS  # this is the edge
    # One-sided coverage may exceed its level where zero is never excluded, and must not fall below.
    spare = 4.0 * np.sqrt(0.05 * 0.95 / RECORDS)
    assert sum(c.upper_limit >= K for c in found) / RECORDS > 0.95 - spare
    assert sum(c.interval[0] <= K <= c.interval[1] for c in found) / RECORDS > 0.95 - spare


def test_the_posteriors_ranks_of_the_truth_are_uniform() -> None:
    """Simulation-based calibration (Talts et al. 2018): the truth is drawn from the prior that is given."""
    rng = np.random.default_rng(3)
    priors = {"angle_random_walk": aj.LogUniform(0.5, 2.0), "rate_random_walk": aj.LogUniform(2.0, 12.0)}
    count = 24
    truths = {label: prior.quantile(rng.random(count)) for label, prior in priors.items()}
    truths = {label: np.asarray(values) for label, values in truths.items()}
    white = rng.standard_normal((N, count)) * np.sqrt(RATE) * truths["angle_random_walk"]
    values = white + walk(1.0, (N, count), rng) * truths["rate_random_walk"]
    axes = tuple(aj.Axis(f"gyro_{k}", "gyro", "rad/s") for k in range(count))
    fit = aj.fit(aj.Recording(values, RATE, axes), MODEL, "whittle", as_is=True, vibrating=True)
    # Thirty autocorrelation times of thirty-two walkers are some thousand draws, enough for a rank of 24.
    length = {"min_length": 30.0, "max_change": 0.1, "max_r_hat": 1.02}
    posterior = aj.sample(fit, priors=priors, progress=False, **length)
    for label, truth in truths.items():
        column = list(priors).index(label)
        ranks = [np.mean(p.draws[:, column] < truth[k]) for k, p in enumerate(posterior.values())]
        # Uniform but once in a thousand times.
        assert kstest(ranks, "uniform").pvalue > 1e-3, label

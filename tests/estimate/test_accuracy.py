"""Coefficients are as accurate as the record allows, and intervals hold what they promise.

Records and the Cramér-Rao bound come from NumPy alone; benchmarks/studies/accuracy.py has more models and
records.
"""

import numpy as np
import pytest

import allanjax as aj

RATE = 100.0
N_SAMPLES = 2048
RECORDS = 120
TERMS = {"Q": aj.Quantization(), "N": aj.AngleRandomWalk(), "K": aj.RateRandomWalk()}
LABELS = {"Q": "quantization", "N": "angle_random_walk", "K": "rate_random_walk"}


def simulate(truth, rng):
    """Rates [samples, records], means over their intervals."""
    size = (N_SAMPLES, RECORDS)
    x = truth["N"] * np.sqrt(RATE) * rng.standard_normal(size)
    x += truth.get("Q", 0.0) * RATE * np.diff(rng.standard_normal((N_SAMPLES + 1, RECORDS)), axis=0)
    # The mean of a Brownian path between two ends: the mean of both, and the area of the bridge.
    steps, area = rng.standard_normal((2, *size)) / np.sqrt(RATE)
    return x + truth["K"] * (np.cumsum(steps, axis=0) - steps / 2.0 + area / np.sqrt(12.0))


def cramer_rao(truth):
    """Standard deviations from ½ tr(C⁻¹C_i C⁻¹C_j), C being the covariance of the differenced rates."""
    t0 = 1.0 / RATE
    lags = np.abs(np.subtract.outer(np.arange(N_SAMPLES - 1), np.arange(N_SAMPLES - 1)))
    # Autocovariances at lags 0, 1, ... of the differences of each term with unit coefficient.
    shapes = {
        "Q": np.array([6.0, -4.0, 1.0]) / t0**2,
        "N": np.array([2.0, -1.0]) / t0,
        "K": np.array([2.0 / 3.0, 1.0 / 6.0]) * t0,
    }
    padded = {c: np.pad(shapes[c], (0, N_SAMPLES - len(shapes[c])))[lags] for c in truth}
    inverse = np.linalg.inv(sum(truth[c] ** 2 * padded[c] for c in truth))
    products = [inverse @ (2.0 * truth[c] * padded[c]) for c in truth]
    information = [[0.5 * np.sum(a * b.T) for b in products] for a in products]
    return np.sqrt(np.diag(np.linalg.inv(information)))


@pytest.mark.parametrize("truth", [{"N": 1.0, "K": 5.0}, {"Q": 0.1, "N": 1.0, "K": 5.0}], ids="+".join)
def test_rmse_is_near_the_cramer_rao_bound_and_intervals_cover_the_truth(truth):
    rng = np.random.default_rng(20240 + len(truth))
    axes = tuple(aj.Axis(f"gyro_{i}", "gyro", "rad/s") for i in range(RECORDS))
    recording = aj.Recording(simulate(truth, rng), RATE, axes, {}, "", ())

    # Of 120 axes at once, one that looks touched by chance would cut them all.
    fit = aj.fit(recording, aj.Model(tuple(TERMS[c] for c in truth)), as_is=True, vibrating=True)

    assert fit.converged
    bound = cramer_rao(truth)
    # Standard errors: 1/√(2R) of an RMSE relative to the bound, √(p(1−p)/R) of a fraction.
    rmse_limit = 1.10 * (1.0 + 3.0 / np.sqrt(2.0 * RECORDS))
    slack = 4.0 * np.sqrt(0.95 * 0.05 / RECORDS)
    for symbol, sd in zip(truth, bound, strict=True):
        found = [axis[LABELS[symbol]] for axis in fit.values()]
        error = np.array([c.value for c in found]) - truth[symbol]
        inside = np.mean([c.interval[0] <= truth[symbol] <= c.interval[1] for c in found])
        assert np.sqrt(np.mean(error**2)) <= rmse_limit * sd, symbol
        assert abs(np.mean(error)) <= 0.1 * sd + 4.0 * sd / np.sqrt(RECORDS), symbol
        assert abs(inside - 0.95) <= slack, symbol
        assert np.mean([c.std for c in found]) == pytest.approx(sd, rel=0.15), symbol

"""Calibrations of many simulated sensors: how often intervals hold the truth, and p-values."""

import numpy as np
import pytest
from turned_sensors import BIAS, EIGHTEEN, ERRORS, SIX, SN, Errors, G, at_rest

import allanjax as aj

pytestmark = pytest.mark.study
N, K, T, PAUSE = 1e-3, 1e-5, 600.0, 20.0


def walk(rng, n):
    """White noise and a random walk at 1 Hz; its mean belongs to the bias."""
    drift = np.cumsum(K * rng.standard_normal((n, 3)), axis=0)
    return N * rng.standard_normal((n, 3)) + drift, drift.mean(axis=0)


def markov(rng, n):
    """White noise and a first-order Gauss–Markov process of 2e-4 m/s² and 900 s, which has a mean of zero."""
    from scipy.signal import lfilter

    a = np.exp(-1.0 / 900.0)
    draws = 2e-4 * np.sqrt(1.0 - a**2) * rng.standard_normal((n, 3))
    draws[0] /= np.sqrt(1.0 - a**2)
    return N * rng.standard_normal((n, 3)) + lfilter([1.0], [1.0, -a], draws, axis=0), np.zeros(3)


NOISES = {
    "walk": (walk, aj.AngleRandomWalk(N) + aj.RateRandomWalk(K)),
    "markov": (markov, aj.AngleRandomWalk(N) + aj.Markov(2e-4 * np.sqrt(2.0 / 900.0), 900.0)),
}


def calibrated(rng, draw, model, ups, errors, **options):
    """A calibration of positions of ten minutes, 20 s apart, by their means; and the bias of the drift."""
    step = round(T + PAUSE)
    noise, bias = draw(rng, step * len(ups))
    means = [errors.readings(G * up) + noise[k * step :][: round(T)].mean(axis=0) for k, up in enumerate(ups)]
    recordings = [at_rest(m, 60, 0.1) for m in means]
    starts = [k * (T + PAUSE) for k in range(len(ups))]
    return aj.calibrate(recordings, gravity=G, model=model, starts=starts, as_is=True, **options), bias


@pytest.mark.parametrize("name", NOISES)
def test_intervals_hold_the_truth(name):
    """300 calibrations of three axes: a share of 0.95 scatters by 0.007, the mean of p-values by 0.017."""
    draw, model = NOISES[name]
    rng, hits, p = np.random.default_rng(11), [], []
    ups = EIGHTEEN[:6]
    for _ in range(300):
        found, bias = calibrated(rng, draw, model, ups, ERRORS, orientations=list(SIX))
        p.append(found.misfit["accel"].p_value)
        for i, axis in enumerate(found.values()):
            truth = {"bias": BIAS[i] + bias[i], "scale_factor": SN[i, i]}
            truth |= {f"misalignment_{a}": SN[i, j] for j, a in enumerate("xyz") if j != i}
            hits.append([c.interval[0] <= truth[k] <= c.interval[1] for k, c in axis.coefficients.items()])
    coverage = np.mean(hits, axis=0)
    assert np.all((coverage >= 0.92) & (coverage <= 0.98)), coverage
    assert np.mean(p) == pytest.approx(0.5, abs=0.06)


def test_free_orientations_hold_the_truth():
    """100 calibrations; 600 intervals, of which six a calibration are not quite independent: 0.95 ± 0.013."""
    rng, errors, hits, p = np.random.default_rng(6), Errors(np.tril(SN), BIAS, np.zeros(3)), [], []
    for _ in range(100):
        found, _ = calibrated(rng, *NOISES["walk"], EIGHTEEN, errors)
        p.append(found.misfit["accel"].p_value)
        for i, axis in enumerate(found.values()):
            truth = {"scale_factor": SN[i, i]} | {
                f"misalignment_{a}": SN[i, j] for j, a in enumerate("xyz"[:i])
            }
            hits += [axis[k].interval[0] <= x <= axis[k].interval[1] for k, x in truth.items()]
    assert 0.91 <= np.mean(hits) <= 0.98
    assert 0.35 < np.mean(p) < 0.65

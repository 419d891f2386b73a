"""Calibrations of many simulated sensors of free orientations: how often intervals hold the truth, p-values.

The study `calibration` has those of six known positions.
"""

import numpy as np
import pytest
from turned_sensors import BIAS, EIGHTEEN, SN, Errors, G, at_rest

import allanjax as aj

N, K, T, STEP = 1e-3, 1e-5, 600, 620


@pytest.mark.study
def test_free_orientations_hold_the_truth():
    """100 calibrations of positions of ten minutes, 20 s apart, by their means.

    600 intervals, of which six a calibration are not quite independent: 0.95 ± 0.013.
    """
    rng, errors, hits, p = np.random.default_rng(6), Errors(np.tril(SN), BIAS, np.zeros(3)), [], []
    n, model = STEP * len(EIGHTEEN), aj.AngleRandomWalk(N) + aj.RateRandomWalk(K)
    for _ in range(100):
        noise = N * rng.standard_normal((n, 3)) + np.cumsum(K * rng.standard_normal((n, 3)), axis=0)
        at = [noise[k : k + T].mean(axis=0) for k in range(0, n, STEP)]
        recordings = [
            at_rest(errors.readings(G * up) + e, 60, 0.1) for up, e in zip(EIGHTEEN, at, strict=True)
        ]
        starts = np.arange(0.0, n, STEP).tolist()
        found = aj.calibrate(recordings, gravity=G, model=model, starts=starts, as_is=True)
        p.append(found.misfit["accel"].p_value)
        for i, axis in enumerate(found.values()):
            truth = {"scale_factor": SN[i, i]} | {
                f"misalignment_{a}": SN[i, j] for j, a in enumerate("xyz"[:i])
            }
            hits += [axis[k].interval[0] <= x <= axis[k].interval[1] for k, x in truth.items()]
    assert 0.91 <= np.mean(hits) <= 0.98
    assert 0.35 < np.mean(p) < 0.65

"""Are innovations under the true model white and of the right size, and how fast are filter and smoother?

p-values of the tests of whiteness (Ljung–Box, 40 lags) and of size (NIS) in records that NumPy made, filtered
by the true model, should be uniform: Kolmogorov's test of that, and shares of p-values below 0.05. Times are
of 10⁶ samples under Q + N + K + Markov, programs compiled before; all states are told at every sample, with
their standard deviations. How good the exact likelihood's fit is, the study `accuracy` tells.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Any

import numpy as np
from scipy.stats import kstest

import allanjax as aj
from benchmarks.common.ours import recording_of
from benchmarks.common.study import run_tasks, share, table
from benchmarks.common.truth import Case, simulate

QUICK: dict[str, Any] = {"records": 4, "long": 20_000}
CASES = (Case("N + K", {"N": 1.0, "K": 1.0}), Case("N + Markov", {"N": 1.0, "q": 10.0, "T": 0.5}))
CHUNK = 20


def run(
    *, records: int = 400, samples: int = 1500, long: int = 1_000_000, seed: int = 8_400_000
) -> Iterator[str]:
    tasks = [
        (case, samples, min(CHUNK, records - first), (seed, k, first))
        for k, case in enumerate(CASES)
        for first in range(0, records, CHUNK)
    ]
    done = run_tasks(p_values, tasks)
    rows = []
    for case in CASES:
        p = np.concatenate([found for found, task in zip(done, tasks, strict=True) if task[0] is case])
        for k, test in enumerate(("whiteness", "size")):
            rows.append([case.name, test, f"{kstest(p[:, k], 'uniform').pvalue:.2g}", share(p[:, k] < 0.05)])
    yield f"## Innovations, {records} records of {samples:,} samples of each model"
    yield table(["model", "test", "Kolmogorov's p", "p < 0.05"], rows)
    yield "## Speed\n\n" + speed(long)


def p_values(case: Case, samples: int, records: int, seed: tuple[int, ...]) -> np.ndarray:
    x = simulate(case, samples, records, np.random.default_rng(seed))
    v = case.truth
    model = aj.AngleRandomWalk(v["N"]) + (
        aj.RateRandomWalk(v["K"]) if "K" in v else aj.Markov(v["q"], v["T"])
    )
    return np.array(
        [[r.whiteness.p_value, r.nis.p_value] for r in aj.kalman_filter(recording_of(x), model).results]
    )


def speed(n: int) -> str:
    model = (
        aj.Quantization(1e-6) + aj.AngleRandomWalk(1e-3) + aj.RateRandomWalk(1e-5) + aj.Markov(1e-4, 100.0)
    )
    recording = recording_of(np.random.default_rng(1).standard_normal((n, 1)) * 1e-2)
    rows = []
    for name, smooth in (("filter", False), ("filter and smoother", True)):
        aj.kalman_filter(recording, model, smooth=smooth)
        begun, used = time.perf_counter(), time.process_time()
        aj.kalman_filter(recording, model, smooth=smooth)
        taken = time.perf_counter() - begun, time.process_time() - used
        rows.append([name, f"{n:,}", *(f"{t:.2f} s" for t in taken)])
    return table(["program", "samples", "time", "processor time"], rows)

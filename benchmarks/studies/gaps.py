"""Are coefficients of records with lost samples right, and their intervals, by each way of going on?

Recordings of three gyros, made by NumPy and SciPy alone: N = 1e-3 rad/√s and K = 1e-4 rad/√s³, plain or
behind a Butterworth filter of second order at 22 Hz. Of the samples 5 % are lost, half of them singly and
half in bursts of 0.2 to 2 s, or all of them in five pauses. The plain sensor is fitted with N + K, the
filtered one by `fit` as it is; where samples are lost singly there are no stretches to fit. "Bias" is the
mean of the estimate over the truth, less one; coverage the share of 95 % intervals with the truth, of a limit
where there is no interval; "no measurement" the share whose fit says so itself, which counts for neither.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from scipy.signal import butter, sosfilt

import allanjax as aj
from benchmarks.common.study import run_tasks, share, table

QUICK: dict[str, Any] = {"recordings": 1, "samples": 8192, "sensors": ("pauses",)}
RATE, SETTLED, WHITE, WALK, BANDWIDTH = 100.0, 2000, 1e-3, 1e-4, 22.0
SENSORS = {
    "plain": "white noise and a walk",
    "filtered": "the same behind a filter",
    "pauses": "white noise and a walk, five pauses",
}
PAUSES = 5
WAYS = {
    "whole": "nothing lost",
    "fill": "gaps='fill'",
    "segments": "gaps='segments'",
    "longest": "the longest stretch alone",
    "joined": "gaps closed, as if nothing had been lost",
    "mean": "the mean in the gaps",
    "held": "the last value in the gaps",
    "line": "a straight line across the gaps",
}


def run(
    *,
    recordings: int = 80,
    samples: int = 40_000,
    sensors: tuple[str, ...] = tuple(SENSORS),
    seed: int = 7_000_000,
) -> Iterator[str]:
    tasks = [(seed + k, sensor, samples) for sensor in sensors for k in range(recordings)]
    found: dict[tuple[str, str, str], list[tuple[float, bool, bool]]] = {}
    for task, result in zip(tasks, run_tasks(outcomes, tasks), strict=True):
        for way, label, *numbers in result:
            found.setdefault((task[1], way, label), []).append(tuple(numbers))
    rows = []
    for sensor, way in dict.fromkeys(key[:2] for key in found):
        row, kept = [SENSORS[sensor], WAYS[way]], np.zeros(1)
        for label in ("N", "K"):
            ratio, inside, kept = (np.array(y) for y in zip(*found[sensor, way, label], strict=True))
            good = ratio[kept]
            error = good.std() / np.sqrt(max(len(good), 1))
            bias = f"{100.0 * (good.mean() - 1.0):+.2f} ± {100.0 * error:.2f}" if len(good) else "–"
            row += [bias, share(inside[kept])]
        rows.append([*row, f"{1.0 - kept.mean():.2f}"])
    head = ["sensor", "gaps", "bias of N [%]", "coverage of N", "bias of K [%]", "coverage of K"]
    yield f"{3 * recordings} records of {samples:,} samples of each sensor, 100 Hz, seeds from {seed} on."
    yield table([*head, "no measurement"], rows)


def record(seed: int, sensor: str, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Samples [n, 3] of a sensor, and which of them are lost."""
    rng, total = np.random.default_rng(seed), n + SETTLED
    walk = WALK / np.sqrt(RATE) * np.cumsum(rng.standard_normal((total, 3)), axis=0)
    x = WHITE * np.sqrt(RATE) * rng.standard_normal((total, 3)) + walk
    if sensor == "filtered":
        x = sosfilt(butter(2, BANDWIDTH, fs=RATE, output="sos"), x, axis=0)
    lost = np.zeros(n, bool)
    if sensor == "pauses":
        pause = n // 100
        for first in rng.choice(np.arange(1, 99), PAUSES, replace=False) * pause:
            lost[first : first + pause] = True
        return x[SETTLED:], lost
    lost, bursts = rng.random(n) < 0.025, 0
    while bursts < 0.025 * n:
        length = int(rng.integers(20, 201))
        first = int(rng.integers(1, n - length - 1))
        lost[first : first + length] = True
        bursts += length
    lost[0] = lost[-1] = False
    return x[SETTLED:], lost


def answered(x: np.ndarray, lost: np.ndarray, way: str) -> np.ndarray:
    """The samples as they are fitted."""
    there, everywhere = np.flatnonzero(~lost), np.arange(len(x))
    if way in ("whole", "joined"):
        return x if way == "whole" else x[there]
    if way == "line":
        return np.column_stack([np.interp(everywhere, there, y[there]) for y in x.T])
    if way == "held":
        return x[np.maximum.accumulate(np.where(lost, 0, everywhere))]
    return np.where(lost[:, None], x[there].mean(axis=0) if way == "mean" else np.nan, x)


def outcomes(seed: int, sensor: str, n: int) -> list[tuple[str, str, float, bool, bool]]:
    """Of every way, axis and coefficient: estimate over truth, whether it is covered and measured."""
    x, lost = record(seed, sensor, n)
    found = []
    for way in WAYS:
        in_stretches = way in ("segments", "longest")
        if in_stretches and sensor != "pauses":
            continue
        gaps = "segments" if in_stretches else "fill"
        recording = aj.Recording.from_array(answered(x, lost, way), RATE, gyro_unit="rad/s", gaps=gaps)
        if way == "longest":
            recording = recording.between(0.0, recording.duration)
        for result in aj.fit(recording, None if sensor == "filtered" else "N + K", as_is=True).results:
            for label, truth in (("N", WHITE), ("K", WALK)):
                if not (result.converged and result.measured):
                    found.append((way, label, np.nan, False, False))
                    continue
                c = result[label]
                inside = c.interval[0] <= truth <= c.interval[1]
                if not np.isfinite(c.interval[0]):
                    inside = c.upper_limit is not None and truth <= c.upper_limit
                found.append((way, label, c.value / truth, bool(inside), True))
    return found

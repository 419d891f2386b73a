"""Are coefficients of records with lost samples right, and their intervals, by each way of going on?

    python benchmarks/studies/gaps.py [--pauses] [--first-seed 7000000] [--records 80] [--workers 2]

Records of three gyros, made by NumPy and SciPy alone, of which one sample in twenty is lost, half of them
singly and half in bursts of 0.2 to 2 s, or all of them in five pauses. `gaps="fill"` and "segments" beside
what is done elsewhere, and beside the whole record.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import paths
from scipy.signal import butter, sosfilt

from benchmarks.common.machine import describe
from benchmarks.common.report import publish, run_tasks, share, table

RATE, N, SETTLED = 100.0, 40_000, 2000
WHITE, WALK, BANDWIDTH = 1e-3, 1e-4, 22.0
SENSORS = ("white noise and a walk", "the same behind a filter", "white noise and a walk, five pauses")
# Stretches are of some use where gaps are few: a pause has so many samples.
PAUSES, PAUSE = 5, N // 100
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
COMMAND = "python benchmarks/studies/gaps.py"
ABOUT = """# Records with lost samples

{count} records of each sensor, {n} samples at {rate:g} Hz in recordings of three gyros, from seed {seed} on:
N = {white:g} rad/√s and K = {walk:g} rad/√s³, plain or behind a Butterworth filter of second order at
{bandwidth:g} Hz. Of the samples 5 % are lost, half of them singly and half in bursts of 20 to 200, or all of
them in five pauses of {pause}. The plain sensor is fitted with N + K, the filtered one by `fit` as it is.
Where samples are lost singly there are no stretches to fit. "bias" is the mean of the estimate over the
truth, less one, with its standard error; coverage the share of 95 % intervals with the truth, of a limit
where there is no interval; "no measurement" the share whose fit says so itself, which counts for neither.
Reproduce with `{command}`.

{machine}

{table}
"""


def record(seed: int, sensor: str) -> tuple[np.ndarray, np.ndarray]:
    """Samples [n, 3] of a sensor, and which of them are lost."""
    rng = np.random.default_rng(seed)
    h, n = 1.0 / RATE, N + SETTLED
    walk = WALK * np.sqrt(h) * np.cumsum(rng.standard_normal((n, 3)), axis=0)
    x = WHITE / np.sqrt(h) * rng.standard_normal((n, 3)) + walk
    if sensor == SENSORS[1]:
        x = sosfilt(butter(2, BANDWIDTH, fs=RATE, output="sos"), x, axis=0)
    if sensor == SENSORS[2]:
        lost = np.zeros(N, bool)
        for first in rng.choice(np.arange(1, N // PAUSE - 1), PAUSES, replace=False) * PAUSE:
            lost[first : first + PAUSE] = True
        return x[SETTLED:], lost
    lost = rng.random(N) < 0.025
    bursts = 0
    while bursts < 0.025 * N:
        length = int(rng.integers(20, 201))
        first = int(rng.integers(1, N - length - 1))
        lost[first : first + length] = True
        bursts += length
    lost[0] = lost[-1] = False
    return x[SETTLED:], lost


def answered(x: np.ndarray, lost: np.ndarray, way: str) -> np.ndarray:
    """The samples as they are fitted."""
    there = np.flatnonzero(~lost)
    if way == "whole":
        return x
    if way == "joined":
        return x[there]
    if way == "line":
        return np.column_stack([np.interp(np.arange(len(x)), there, y[there]) for y in x.T])
    filled = x.copy()
    if way == "held":
        last = np.maximum.accumulate(np.where(lost, 0, np.arange(len(x))))
        return x[last]
    filled[lost] = np.nan if way in ("fill", "segments", "longest") else x[there].mean(axis=0)
    return filled


def outcomes(seed: int, sensor: str) -> list[tuple[str, str, float, bool, bool]]:
    """Of every way, axis and coefficient: estimate over truth, whether it is covered and measured."""
    import allanjax as aj

    x, lost = record(seed, sensor)
    found = []
    for way in WAYS:
        in_stretches = way in ("segments", "longest")
        if in_stretches and sensor != SENSORS[2]:
            continue
        values = answered(x, lost, way)
        gaps = "segments" if in_stretches else "fill"
        recording = aj.Recording.from_array(values, RATE, gyro_unit="rad/s", gaps=gaps)
        if way == "longest":
            recording = recording.between(0.0, recording.duration)
        model = None if sensor == SENSORS[1] else "N + K"
        fit = aj.fit(recording, model, as_is=True)
        for result in fit.results:
            for label, truth in (("N", WHITE), ("K", WALK)):
                if not (result.converged and result.measured):
                    found.append((way, label, np.nan, False, False))
                    continue
                c = result[label]
                low, high = c.interval
                inside = low <= truth <= high
                if not np.isfinite(low):
                    inside = c.upper_limit is not None and truth <= c.upper_limit
                found.append((way, label, c.value / truth, bool(inside), True))
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--first-seed", type=int, default=7_000_000)
    parser.add_argument("--records", type=int, default=80, help="recordings of three gyros, of each sensor")
    parser.add_argument("--workers", type=int, default=2, help="processes")
    parser.add_argument("--pauses", action="store_true", help="only records with pauses, to gaps_pauses.md")
    parser.add_argument("--quick", action="store_true", help="few records, to see that all of it runs")
    parser.add_argument("--results", type=Path, default=None)
    options = parser.parse_args()
    if options.quick:
        options.records = 2
    seeds = range(options.first_seed, options.first_seed + options.records)
    sensors = SENSORS[2:] if options.pauses else SENSORS
    results = options.results or paths.RESULTS / ("gaps_pauses.md" if options.pauses else "gaps.md")
    tasks = [(seed, sensor) for sensor in sensors for seed in seeds]
    found: dict[tuple[str, str, str], list[tuple[float, bool, bool]]] = {}
    for done, (task, result, _) in enumerate(run_tasks(outcomes, tasks, options.workers), 1):
        for way, label, *numbers in result:
            found.setdefault((task[1], way, label), []).append(tuple(numbers))
        if done % 10 == 0:
            print(f"{done} of {len(tasks)} recordings", flush=True)
    rows = []
    for sensor in sensors:
        for way, words in WAYS.items():
            if (sensor, way, "N") not in found:
                continue
            row = [sensor, words]
            for label in ("N", "K"):
                ratio, inside, measured = (np.array(y) for y in zip(*found[sensor, way, label], strict=True))
                kept = measured.astype(bool)
                if not kept.any():
                    row += ["–", "–"]
                    continue
                good = ratio[kept]
                error = good.std() / np.sqrt(len(good))
                row += [f"{100.0 * (good.mean() - 1.0):+.2f} ± {100.0 * error:.2f}", share(inside[kept])]
            row.append(f"{1.0 - kept.mean():.2f}")
            rows.append(row)
    head = [
        "sensor",
        "gaps",
        "bias of N [%]",
        "coverage of N",
        "bias of K [%]",
        "coverage of K",
        "no measurement",
    ]
    which = ["--pauses"] if options.pauses else []
    text = ABOUT.format(
        count=3 * options.records,
        n=N,
        rate=RATE,
        seed=options.first_seed,
        white=WHITE,
        walk=WALK,
        bandwidth=BANDWIDTH,
        pause=PAUSE,
        command=" ".join([COMMAND, *which, f"--records {options.records} --first-seed {options.first_seed}"]),
        machine=describe(),
        table=table(head, rows),
    )
    publish(text, results, options.quick)


if __name__ == "__main__":
    main()

"""Do the intervals of a joint fit's common values and scatters cover the truth, and does it find weak terms?

Fleets of recordings (164 s at 100 Hz) with N + B + K, each coefficient log-normal about the common value
with a known relative scatter. A recording determines N to 0.6 % and B to about 8 %, and K is detected in
few. Nine axes of a recording are nine fleets. Covered: share of fleets whose 95 % interval holds the common
value, and the scatter. Falsely: share in which equal recordings differ (p < 0.05), and in which one is the
odd one. Then fits that choose their terms, of recordings of N with or without a K that is as large at 35 s:
how often single recordings and all together find it. At last two real sensors, ADIS16405. The only other
program for several recordings, the R package mgmwm (Bakalli et al. 2023), fits them one common model and has
no scatter between them.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

import allanjax as aj
from benchmarks.common.study import UnavailableError, data, run_tasks, share, table

QUICK: dict[str, Any] = {"fleets": 1, "counts": (3,), "scatters": (0.1,), "chosen": 1, "real": False}
N = 0.15 * np.pi / 180.0 / 60.0
TRUTH = {"angle_random_walk": N, "bias_instability": 1.2 * N, "rate_random_walk": N * np.sqrt(3.0) / 40.0}
LENGTH, RATE, AXES = 16_384, 100.0, 9


def run(
    *,
    fleets: int = 3,
    counts: tuple[int, ...] = (3, 6, 12, 30),
    scatters: tuple[float, ...] = (0.0, 0.1, 0.2),
    chosen: int = 12,
    real: bool = True,
    seed: int = 3,
) -> Iterator[str]:
    cases = [(count, scatter) for count in counts for scatter in scatters]
    tasks = [(*case, 1000 * seed + k) for case in cases for k in range(fleets)]
    found, rows = run_tasks(fleet, tasks), []
    for case in cases:
        own = [x for task, xs in zip(tasks, found, strict=True) if task[:2] == case for x in xs]
        for label in TRUTH:
            of = np.array([x[1:] for x in own if x[0] == label])
            told = [share(of[:, 0]), share(of[:, 1])]
            told += [share(of[:, k]) if case[1] == 0.0 else "" for k in (2, 3)]
            told += [f"{np.mean(of[:, 4]):.2f}", f"{np.median(of[:, 5]):.3f}"]
            rows.append([case[0], f"{100 * case[1]:g} %", label.replace("_", " "), *told])
    for label in TRUTH:
        of = np.array([x[1:3] for xs in found for x in xs if x[0] == label])
        rows.append(["all", "", label.replace("_", " "), *map(share, of.T), "", "", "", ""])
    head = ["recordings", "scatter", "coefficient", "common covered", "scatter covered", "falsely unlike"]
    yield table([*head, "falsely odd", "detected alone", "error of common"], rows)
    tasks = [(8, with_k, 9000 + 100 * seed + k) for with_k in (True, False) for k in range(chosen)]
    found = np.array(run_tasks(terms, tasks)).reshape(2, chosen, 5)
    heads = [
        "in the records",
        "K, or another that may be K",
        "K",
        "K by one alone",
        "K by each alone",
        "another",
    ]
    cells = [[name, *map(share, x.T)] for name, x in zip(("N + K", "N"), found, strict=True)]
    yield "Terms chosen by 8 recordings without scatter together:\n\n" + table(heads, cells)
    if real:
        yield from of_real_sensors()


def recording(
    rng: np.random.Generator, truth: dict[str, float], scatter: float, axes: int, name: str
) -> aj.Recording:
    """A recording with these coefficients on average."""
    import jax

    columns = []
    for _ in range(axes):
        values = {label: c * np.exp(scatter * rng.standard_normal()) for label, c in truth.items()}
        model = aj.AngleRandomWalk() + aj.BiasInstability() + aj.RateRandomWalk()
        model = model.without([t for t in model.term_labels if t not in truth]).with_values(**values)
        key = jax.random.key(int(rng.integers(2**31)))
        columns.append(np.asarray(aj.simulate(model, LENGTH, RATE, key)))
    names = [f"gyro_{k + 1}" for k in range(axes)]
    return aj.Recording.from_array(np.stack(columns, 1), RATE, gyro_unit="rad/s", names=names, name=name)


def fleet(count: int, scatter: float, seed: int) -> list[tuple[Any, ...]]:
    """Of each axis and coefficient what the joint fit of so many recordings got right."""
    rng, rows = np.random.default_rng([seed, count, int(1000 * scatter)]), []
    recordings = [recording(rng, TRUTH, scatter, AXES, f"day {k + 1}") for k in range(count)]
    joint = aj.joint_fit(recordings, "N + B + K", as_is=True)
    for axis in joint.results:
        for label, c in axis.coefficients.items():
            (low, high), e = c.common.interval, c.effects
            covered = low <= TRUTH[label] <= high
            # Of an undetected coefficient there is no scatter.
            true = scatter * TRUTH[label]
            among = c.scatter.interval[0] <= true <= c.scatter.interval[1] if c.common.detected else True
            alone = float(np.mean([x.detected for x in c.records.values()]))
            error = abs(c.common.value / TRUTH[label] - 1.0)
            rows.append((label, covered, among, e.p_value < 0.05, bool(e.odd_one), alone, error))
    return rows


def terms(count: int, with_k: bool, seed: int) -> list[Any]:
    """Whether K or a rival is found, K itself, by one recording, by what share, and whether another is."""
    rng = np.random.default_rng(seed)
    truth = {"angle_random_walk": N} | ({"rate_random_walk": N * np.sqrt(3.0) / 35.0} if with_k else {})
    recordings = [recording(rng, truth, 0.0, 1, f"day {k + 1}") for k in range(count)]
    fits = [aj.fit(r, as_is=True, plain=True) for r in recordings]
    axis = aj.joint_fit(fits)["gyro_1"]
    single = [f["gyro_1"].coefficients["rate_random_walk"].detected for f in fits]
    found = set(axis.coefficients)
    others = found - {"angle_random_walk", "rate_random_walk"}
    named = "rate_random_walk" in {t for of in axis.rivals.values() for t in of} | found
    return [named, "rate_random_walk" in found, any(single), float(np.mean(single)), bool(others)]


def of_real_sensors() -> Iterator[str]:
    try:
        paths = [data(f"adis16405_unit{k}.parquet") for k in (1, 2)]
    except UnavailableError as error:
        yield f"The real recordings are left out: {error}."
        return
    joint = aj.joint_fit(paths, rate=100.0, gyro_unit="deg/s", accel_unit="g")
    yield f"Two ADIS16405 for 2.8 h:\n\n```text\n{joint}\n```"

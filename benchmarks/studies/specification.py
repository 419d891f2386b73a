"""Does `check_spec` pass a sensor at its limit in 5 % of the records, and fail it in 5 %?

Sensors whose true value is exactly the limit, the least favourable case: at a probability of 95 % a unit may
pass, and at 5 % fail, in 5 % of the records each. Records at 100 Hz of given terms come from NumPy, and so
do the true values of N, K or B, and of the least Allan deviation: within the record for N + K, 0.664 B for
N + B, whose curve falls to the end. Cells: share of the axes that pass and that fail, with the terms given
and with the terms chosen by `fit`, and the mean probability, 0.5 if it is uniform.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

import allanjax as aj
from benchmarks.common.study import run_tasks, share, table
from benchmarks.common.truth import RATE, Case, allan_shape, simulate

QUICK: dict[str, Any] = {"records": 2, "lengths": (4096,)}
# K and B whose Allan deviations meet that of N after 2 s and 0.5 s.
CASES = {"N + K": {"N": 1.0, "K": np.sqrt(3.0) / 2.0}, "N + B": {"N": 1.0, "B": np.sqrt(np.pi / np.log(2.0))}}
N = 1e-4
AXES = 9


def run(
    *, records: int = 25, lengths: tuple[int, ...] = (4096, 32768), seed: int = 7_411_205
) -> Iterator[str]:
    tasks = [
        (name, n, chosen, records, seed + 10 * k)
        for k, (name, n, chosen) in enumerate(
            (c, n, x) for c in CASES for n in lengths for x in (False, True)
        )
    ]
    rows = [row for rows in run_tasks(judged, tasks) for row in rows]
    yield f"## At the limit, {records * AXES} axes each"
    yield table(["truth", "length", "terms", "limit", "pass", "fail", "probability"], rows)


def judged(name: str, n: int, chosen: bool, records: int, seed: int) -> list[list[str]]:
    truth = CASES[name]
    least = least_deviation(truth, n)
    figures = {
        "random_walk": f"{N / np.pi * 180.0 * 60.0} deg/√h",
        "reading": "minimum",
        "meaning": "maximum",
    }
    figures["in_run_bias_instability"] = f"{N * least} rad/s"
    if "K" in truth:
        figures["rate_random_walk"] = f"{N * truth['K']} rad/s/√s"
    else:
        figures["bias_instability"] = f"{N * truth['B']} rad/s"
    rng, found = np.random.default_rng(seed), {}
    for _ in range(records):
        values = N * simulate(Case(name, truth), n, AXES, rng)
        names = [f"gyro_{k}" for k in range(1, AXES + 1)]
        recording = aj.Recording.from_array(values, RATE, gyro_unit="rad/s", names=names)
        fit = aj.fit(recording, None if chosen else name, as_is=True)
        for result in aj.check_spec(fit, {"gyro": figures}).results:
            found.setdefault(result.limit.title, []).append((result.verdict, result.probability[0]))
    terms, rows = "chosen" if chosen else "given", []
    for title, results in found.items():
        verdicts = [verdict for verdict, _ in results]
        mean = np.nanmean([p for _, p in results])
        shares = [share([verdict == wanted for verdict in verdicts]) for wanted in ("pass", "fail")]
        rows.append([name, f"{n / RATE:g} s", terms, title, *shares, f"{mean:.3f}"])
    return rows


def least_deviation(truth: dict[str, float], n: int) -> float:
    if "B" in truth:
        return float(np.sqrt(2.0 * np.log(2.0) / np.pi) * truth["B"])
    time = np.geomspace(1.0 / RATE, n / RATE / 2.0, 2000)
    return float(np.sqrt(sum(c**2 * allan_shape(symbol, time) for symbol, c in truth.items()).min()))

"""Seconds and compilations of `fit` for recordings of twenty lengths, one after the other in one process.

    python benchmarks/studies/twenty_lengths.py [--model "N + B + K"] [--against CHECKOUT] [--quick]
                                                [--results PATH]

White noise and a random walk of six axes, at rates that differ, too, by NumPy alone. Each code runs in a
process of its own and without a cache of compiled programs, the other one from its checkout.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import paths

from benchmarks.common.machine import describe
from benchmarks.common.report import publish, table

AXES = ("gyro_x", "gyro_y", "gyro_z", "accel_x", "accel_y", "accel_z")
LENGTHS = np.rint(np.geomspace(10_000, 1_000_000, 20)).astype(int).tolist()
QUICK = LENGTHS[:3]
COMPILATION = "/jax/core/compile/backend_compile_duration"
THIS, BEFORE = "this code", "the code before"
# What the first recording compiles is of no interest here.
AFTER_FIRST = slice(1, None)


def measured(model: str, lengths: list[int]) -> list[list[float]]:
    """Seconds, seconds of processors, and compilations of each fit, [lengths, 3]."""
    import jax

    import allanjax as aj

    compilations = [0]

    def count(event: str, seconds: float, **_: object) -> None:
        compilations[0] += event == COMPILATION

    jax.monitoring.register_event_duration_secs_listener(count)
    found = []
    for k, n in enumerate(lengths):
        rng = np.random.default_rng(k)
        white, drift = rng.standard_normal((2, n, len(AXES)))
        x = 1e-3 * white + np.cumsum(1e-6 * drift, axis=0)
        recording = aj.Recording.from_array(
            x, 50.0 + 10.0 * k, gyro_unit="rad/s", accel_unit="m/s²", names=AXES
        )
        compilations[0] = 0
        begun, processors = time.perf_counter(), time.process_time()
        aj.fit(recording, model or None)
        found.append([time.perf_counter() - begun, time.process_time() - processors, compilations[0]])
        print(f"{n:10,} samples: {found[-1]}", file=sys.stderr, flush=True)
    return found


def of_checkout(checkout: Path, model: str, lengths: list[int]) -> np.ndarray:
    """What `measured` says of the code of a checkout, [lengths, 3]."""
    environment = {name: x for name, x in os.environ.items() if name != "JAX_COMPILATION_CACHE_DIR"}
    environment |= {"PYTHONPATH": str(checkout.resolve()), "ALLANJAX_CACHE": "off"}
    command = [sys.executable, __file__, "--model", model, "--measure", json.dumps(lengths)]
    done = subprocess.run(command, env=environment, stdout=subprocess.PIPE, check=True)
    return np.array(json.loads(done.stdout))


def rows(lengths: list[int], runs: dict[str, np.ndarray]) -> list[list[str]]:
    """A row a length, and one of their sums after the first."""
    found = []
    for k, n in enumerate(lengths):
        row = [f"{n:,}"]
        for run in runs.values():
            row += [f"{run[k, 0]:.2f}", f"{run[k, 1]:.2f}", f"{run[k, 2]:.0f}"]
        found.append(row)
    total = ["all but the first"]
    for run in runs.values():
        seconds, processors, compilations = run[AFTER_FIRST].sum(axis=0)
        total += [f"{seconds:.1f}", f"{processors:.1f}", f"{compilations:.0f}"]
    return [*found, total]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--model", default="N + B + K", help='"" for the terms that `fit` chooses')
    parser.add_argument("--against", type=Path, help="checkout of the code before, which runs the same")
    parser.add_argument("--quick", action="store_true", help="three lengths")
    parser.add_argument("--results", type=Path, default=paths.RESULTS / "twenty_lengths.md")
    parser.add_argument("--measure", type=json.loads, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.measure:
        print(json.dumps(measured(arguments.model, arguments.measure)))
        return
    load = os.getloadavg()[0]
    lengths = QUICK if arguments.quick else LENGTHS
    checkouts = {THIS: Path(__file__).parents[2]}
    if arguments.against:
        checkouts[BEFORE] = arguments.against
    runs = {name: of_checkout(path, arguments.model, lengths) for name, path in checkouts.items()}
    head = ["samples"]
    for name in runs:
        head += [f"{name} [s]", "processors [s]", "compilations"]
    text = "\n".join(
        [
            "# Recordings of twenty lengths",
            "",
            describe(),
            f"- load of the machine when this began: {load:.1f}",
            "",
            f"`fit` of {arguments.model or 'the terms that it chooses'}, six axes, one recording after the",
            "other in one process, without a cache of compiled programs.",
            "",
            table(head, rows(lengths, runs)),
            "",
        ]
    )
    publish(text, arguments.results, arguments.quick)


if __name__ == "__main__":
    main()

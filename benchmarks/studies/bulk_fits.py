"""Fits a second of `fit_many`, beside a fit of one unit after the other and beside log-log least squares.

    python benchmarks/studies/bulk_fits.py [--units 1000] [--samples 16384,1048576] [--repeats 7]
                                           [--results PATH]

Units of N + B + K at 100 Hz, all with the Allan deviations at octaves of their own; these are not in the
times. A hundred records are simulated and repeated to make up the units. All ways run in turn, round after
round, so that a busy machine slows all of them.
"""

from __future__ import annotations

import argparse
import dataclasses
import os
import time
from collections.abc import Callable, Mapping
from pathlib import Path

import jax
import numpy as np
import paths
from scipy.optimize import least_squares

import allanjax as aj
from allanjax.estimate.axis_fits import fit_allan
from benchmarks.common.machine import describe
from benchmarks.common.report import publish, table

RATE = 100.0
MODEL = aj.AngleRandomWalk() + aj.BiasInstability() + aj.RateRandomWalk()
TRUTH = aj.AngleRandomWalk(1e-2) + aj.BiasInstability(4e-3) + aj.RateRandomWalk(7e-4)
LABELS = MODEL.term_labels
RECORDS = 100
# Units that the slower ways fit in each round.
ONE_BY_ONE = 20
LOG_LOG = 50
BULK, SINGLE, SCIPY = "fit_many", "one by one", "log-log least squares"


def curves(n: int, units: int) -> aj.AllanDeviation:
    """The Allan deviations of so many units."""
    keys = jax.random.split(jax.random.PRNGKey(0), RECORDS)
    parts = [aj.allan_deviation(aj.simulate(TRUTH, n, RATE, key), RATE) for key in keys]
    record = np.arange(units) % RECORDS
    return dataclasses.replace(
        parts[0],
        deviation=np.concatenate([part.deviation for part in parts], axis=1)[:, record],
        edf=np.concatenate([part.edf for part in parts], axis=1)[:, record],
    )


def one_by_one(curve: aj.AllanDeviation, units: range) -> np.ndarray:
    """Coefficients [units, 3], each unit by `fit`'s own way."""
    axis = aj.Axis("unit", "gyro", "rad/s")
    found = []
    for k in units:
        unit = dataclasses.replace(curve, deviation=curve.deviation[:, [k]], edf=curve.edf[:, [k]])
        (result,), _ = fit_allan(unit, [axis], MODEL, np.ones((1, len(MODEL)), bool))
        found.append([result[label].value for label in LABELS])
    return np.array(found)


def log_log(curve: aj.AllanDeviation, units: range) -> np.ndarray:
    """Coefficients [units, 3] by unweighted least squares of the logarithms, with SciPy."""
    shapes = np.array(
        [
            term.allan_variance(curve.cluster_time)
            for term in (aj.AngleRandomWalk(1.0), aj.BiasInstability(1.0), aj.RateRandomWalk(1.0))
        ]
    ).T
    found = []
    for k in units:
        measured = np.log(curve.variance[:, k])
        start = np.log(curve.variance[:, k].min() / shapes.max(axis=0))

        def residual(u: np.ndarray, measured: np.ndarray = measured) -> np.ndarray:
            return np.log(shapes @ np.exp(u)) - measured

        def jacobian(u: np.ndarray, measured: np.ndarray = measured) -> np.ndarray:
            powers = shapes * np.exp(u)
            return powers / powers.sum(axis=1, keepdims=True)

        best = least_squares(residual, start, jacobian, method="lm")
        found.append(np.exp(best.x / 2.0))
    return np.array(found)


def rates(runs: Mapping[str, tuple[Callable[[], object], int]], repeats: int) -> dict[str, np.ndarray]:
    """Fits a second of each way, [repeats]; one more round before compiles."""
    found: dict[str, list[float]] = {name: [] for name in runs}
    for _ in range(repeats + 1):
        for name, (run, units) in runs.items():
            begun = time.perf_counter()
            run()
            found[name].append(units / (time.perf_counter() - begun))
    return {name: np.array(of_way[1:]) for name, of_way in found.items()}


def rows(n: int, units: int, repeats: int) -> list[list[str]]:
    curve = curves(n, units)
    begun = time.perf_counter()
    many = aj.fit_many(curve, MODEL)
    first = time.perf_counter() - begun
    few = range(ONE_BY_ONE)
    np.testing.assert_allclose(many.value[: len(few)], one_by_one(curve, few), rtol=1e-6, atol=1e-15)
    estimates = {BULK: many.value[:RECORDS], SCIPY: log_log(curve, range(RECORDS))}
    found = rates(
        {
            BULK: (lambda: aj.fit_many(curve, MODEL), units),
            SINGLE: (lambda: one_by_one(curve, few), len(few)),
            SCIPY: (lambda: log_log(curve, range(LOG_LOG)), LOG_LOG),
        },
        repeats,
    )
    truth = np.array([TRUTH.values[label] for label in LABELS])
    shown = []
    for name, of_way in found.items():
        error = ["", "", ""]
        if name in estimates:
            error = [f"{e:.1%}" for e in np.sqrt(np.mean((estimates[name] / truth - 1.0) ** 2, axis=0))]
        ratio = np.median(found[BULK] / of_way)
        shown.append([f"{n:,}", name, f"{np.median(of_way):,.0f}", f"{of_way.max():,.0f}", f"{ratio:.3g}"])
        shown[-1] += [f"{first:.1f}" if name == BULK else "", *error]
    return shown


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--units", type=int, default=1000)
    parser.add_argument("--samples", default="16384,1048576")
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--results", type=Path, default=paths.RESULTS / "bulk_fits.md")
    arguments = parser.parse_args()
    load = os.getloadavg()[0]
    head = ["samples a unit", "", "fits a second, median", "most", "fit_many is faster by"]
    head += ["first call [s]", "RMS error of N", "of B", "of K"]
    body = [
        row for n in arguments.samples.split(",") for row in rows(int(n), arguments.units, arguments.repeats)
    ]
    text = "\n".join(
        [
            "# Fits in bulk",
            "",
            describe(),
            f"- load of the machine when this began: {load:.1f}; JAX on {jax.default_backend()}",
            "",
            f"{arguments.units:,} units of N + B + K, Allan deviations at octaves, after compilation.",
            "",
            table(head, body),
            "",
            f'"{SINGLE}" is what `fit` does with the curve of one unit, and gives the same coefficients and',
            f'intervals as `fit_many`. "{SCIPY}" is `scipy.optimize.least_squares` of the logarithms of the',
            "Allan variances with its analytic Jacobian, a unit at a time: unweighted, and without any",
            f"uncertainty. Medians of {arguments.repeats} rounds; factors are medians of each round's.",
            "",
        ]
    )
    publish(text, arguments.results)


if __name__ == "__main__":
    main()

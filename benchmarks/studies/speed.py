"""How fast are Allan deviations and fits in bulk, beside other packages?

White noise at octaves of the cluster time, all in one process in turn, round after round: medians over the
rounds, and ratios as medians of each round's ratio, so that a busy machine slows both sides. Exact estimates
are overlapping Allan variances. Programs are compiled before. What a recording costs from its file to its
numbers is the question of `seconds`.
"""

from __future__ import annotations

import contextlib
import dataclasses
import io
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from scipy.optimize import least_squares

import allanjax as aj
from benchmarks.common.study import table

PACKAGES = ("allantools", "allan-variance", "avar")
QUICK: dict[str, Any] = {"lengths": (10_000,), "repeats": 1}
QUICK |= {"units": 20, "unit_samples": 2048}
REFERENCE, ONE_PASS = "allantools oadev", "np.sum"
MODEL = aj.AngleRandomWalk() + aj.BiasInstability() + aj.RateRandomWalk()
TRUTH = aj.AngleRandomWalk(1e-2) + aj.BiasInstability(4e-3) + aj.RateRandomWalk(7e-4)


def run(
    *,
    lengths: tuple[int, ...] = (100_000, 1_000_000, 10_000_000),
    repeats: int = 7,
    units: int = 1000,
    unit_samples: int = 16384,
) -> Iterator[str]:
    yield "## Allan deviations [ms], one axis"
    yield allan_table(lengths, repeats)
    model = aj.AngleRandomWalk(1e-3) + aj.RateRandomWalk(1e-5) + aj.Markov(1e-4, 100.0)
    record = np.random.default_rng(1).standard_normal(lengths[0])[:, None]
    states = aj.Recording.from_array(record, 100.0, gyro_unit="rad/s", names=["gyro"])
    runs = {str(s): lambda s=s: aj.kalman_filter(states, model, smooth=s) for s in (False, True)}
    times = [taken.min() for taken in in_turn(runs, 2).values()]
    yield (
        f"A Kalman filter of {len(record):,} samples under N + K + Markov, all states told: "
        f"{times[0]:.2f} s; with the smoother {times[1]:.2f} s."
    )
    yield (
        f"## Fits in bulk: {units:,} units of N + B + K, {unit_samples:,} samples\n\nTheir Allan deviations "
        'at octaves are not in the times. "One by one" is `fit_many` of a single unit; log-log least squares '
        "is SciPy's, unweighted and without any uncertainty."
    )
    yield table(["", "fits a second", "fit_many is faster by"], bulk_rows(unit_samples, units, repeats))


def ways() -> dict[str, Callable[[np.ndarray], Any]]:
    import allantools
    import avar
    from allan_variance import compute_avar

    def by_avar(x: np.ndarray) -> None:
        with contextlib.redirect_stdout(io.StringIO()):
            avar.variance(x, 2 ** np.arange((len(x) // 2).bit_length()))

    def by_allan_variance(x: np.ndarray) -> None:
        octaves = (len(x) // 2).bit_length()
        compute_avar(x, 1.0, tau_max=2.0 ** (octaves - 1), n_clusters=octaves)

    return {
        "allanjax, exact": lambda x: aj.allan_deviation(x, 1.0),
        "allanjax, pyramid": lambda x: aj.allan_deviation(x, 1.0, estimator="pyramid"),
        REFERENCE: lambda x: allantools.oadev(x, 1.0, data_type="freq", taus="octave"),
        "allan-variance": by_allan_variance,
        "avar": by_avar,
        ONE_PASS: np.sum,
    }


def in_turn(runs: dict[str, Callable[[], object]], repeats: int) -> dict[str, np.ndarray]:
    """Seconds of each, [repeats], in turn; one more round before that compiles and is not counted."""
    times: dict[str, list[float]] = {name: [] for name in runs}
    for _ in range(repeats + 1):
        for name, call in runs.items():
            begun = time.perf_counter()
            call()
            times[name].append(time.perf_counter() - begun)
    return {name: np.array(taken[1:]) for name, taken in times.items()}


def allan_table(lengths: tuple[int, ...], repeats: int) -> str:
    rows = []
    for n in lengths:
        x = np.random.default_rng(0).normal(size=n)
        # That they compute the same.
        theirs = ways()[REFERENCE](x)[1]
        for estimator, count in (("exact", len(theirs)), ("pyramid", 4)):
            found = aj.allan_deviation(x, 1.0, estimator=estimator).deviation[:, 0]
            np.testing.assert_allclose(found[:count], theirs[:count], rtol=1e-8)
        times = in_turn({name: lambda x=x, f=f: f(x) for name, f in ways().items()}, repeats)
        for name, taken in times.items():
            ratios = np.median(times[REFERENCE] / taken), np.median(taken / times[ONE_PASS])
            told = [f"{1e3 * seconds:.3g}" for seconds in (np.median(taken), taken.min())]
            rows.append([f"{n:,}", name, *told, *(f"{r:.1f}" for r in ratios)])
    return table(["samples", "", "median", "least", f"faster than {REFERENCE} by", "passes of np.sum"], rows)


def bulk_rows(n: int, units: int, repeats: int) -> list[list[str]]:
    """Ten records are simulated and repeated to make up the units."""
    parts = [aj.allan_deviation(np.asarray(aj.simulate(TRUTH, n, 100.0, k)), 100.0) for k in range(10)]
    record = np.arange(units) % 10
    deviation, edf = (
        np.concatenate(x, axis=1)[:, record] for x in zip(*((p.deviation, p.edf) for p in parts), strict=True)
    )
    curve = dataclasses.replace(parts[0], deviation=deviation, edf=edf)
    terms = aj.AngleRandomWalk(1.0), aj.BiasInstability(1.0), aj.RateRandomWalk(1.0)
    shapes = np.stack([term.allan_variance(curve.cluster_time) for term in terms], axis=1)
    measured = np.log(parts[0].variance[:, 0])

    def jacobian(u: np.ndarray) -> np.ndarray:
        powers = shapes * np.exp(u)
        return powers / powers.sum(axis=1, keepdims=True)

    def log_log() -> None:
        start = measured.min() - np.log(shapes.max(axis=0))
        least_squares(lambda u: np.log(shapes @ np.exp(u)) - measured, start, jacobian, method="lm")

    runs = {
        "fit_many": (lambda: aj.fit_many(curve, MODEL), units),
        "one by one": (lambda: aj.fit_many(parts[0], MODEL), 1),
        "log-log least squares": (log_log, 1),
    }
    times = in_turn({name: call for name, (call, _) in runs.items()}, repeats)
    rates = {name: runs[name][1] / taken for name, taken in times.items()}
    own = rates["fit_many"]
    return [[name, f"{np.median(r):,.0f}", f"{np.median(own / r):.3g}"] for name, r in rates.items()]

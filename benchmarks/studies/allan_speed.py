"""The Allan deviation's speed beside other packages', its growth with the record, and its compile time.

    python benchmarks/studies/allan_speed.py [--samples 10000000] [--repeats 7] [--lengths 100000,…]
                                             [--results PATH]

White noise at octaves of the cluster time. All run in this process in turn, round after round; times are
medians over the rounds and ratios are medians of each round's ratio, so that a busy machine slows both sides.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import os
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TypeVar

import allantools
import avar
import jax
import numpy as np
import paths
from allan_variance import compute_avar

import allanjax as aj
from benchmarks.common.machine import describe
from benchmarks.common.report import publish, table

REFERENCE = "allantools oadev"
ONE_PASS = "np.sum"
AXES = 6

Key = TypeVar("Key", str, tuple[str, int])


def with_numpy(x: np.ndarray) -> np.ndarray:
    """Overlapping Allan variances as fast as NumPy allows: one running sum, slices, no new arrays."""
    n = len(x)
    phases = np.empty(n + 1)
    phases[0] = 0.0
    np.subtract(x, x.mean(), out=phases[1:])
    np.cumsum(phases[1:], out=phases[1:])
    work = np.empty(n)
    sizes = 2 ** np.arange((n // 2).bit_length())
    variances = np.empty(len(sizes))
    for k, m in enumerate(sizes):
        d = np.subtract(phases[2 * m :], phases[m:-m], out=work[: n + 1 - 2 * m])
        d -= phases[m:-m]
        d += phases[: -2 * m]
        variances[k] = np.dot(d, d) / len(d) / (2.0 * m**2)
    return variances


def by_allan_variance(x: np.ndarray) -> None:
    octaves = (len(x) // 2).bit_length()
    compute_avar(x, 1.0, tau_max=2.0 ** (octaves - 1), n_clusters=octaves)


def by_avar(x: np.ndarray) -> None:
    with contextlib.redirect_stdout(io.StringIO()):
        avar.variance(x, 2 ** np.arange((len(x) // 2).bit_length()))


RUNS: dict[str, Callable[[np.ndarray], object]] = {
    "allanjax, exact": lambda x: aj.allan_deviation(x, 1.0),
    "allanjax, pyramid": lambda x: aj.allan_deviation(x, 1.0, estimator="pyramid"),
    REFERENCE: lambda x: allantools.oadev(x, 1.0, data_type="freq", taus="octave"),
    "NumPy by hand": with_numpy,
    "allan-variance": by_allan_variance,
    "avar": by_avar,
    ONE_PASS: np.sum,
}
OURS = {name: run for name, run in RUNS.items() if name.startswith("allanjax")}


def seconds(runs: Mapping[Key, Callable], x: np.ndarray, repeats: int) -> dict[Key, np.ndarray]:
    """Times of each, [repeats], in turn; one more round before that compiles and is not counted."""
    times: dict[Key, list[float]] = {name: [] for name in runs}
    for _ in range(repeats + 1):
        for name, run in runs.items():
            begun = time.perf_counter()
            run(x)
            times[name].append(time.perf_counter() - begun)
    return {name: np.array(taken[1:]) for name, taken in times.items()}


def check(x: np.ndarray) -> None:
    """That they compute the same."""
    exact = aj.allan_deviation(x, 1.0)
    pyramid = aj.allan_deviation(x, 1.0, estimator="pyramid")
    _, theirs, *_ = allantools.oadev(x, 1.0, data_type="freq", taus="octave")
    np.testing.assert_allclose(exact.deviation[: len(theirs), 0], theirs, rtol=1e-8)
    np.testing.assert_allclose(exact.variance[:, 0], with_numpy(x), rtol=1e-8)
    np.testing.assert_allclose(pyramid.deviation[:4, 0], theirs[:4], rtol=1e-8)


def comparison(samples: int, repeats: int) -> str:
    x = np.random.default_rng(0).normal(size=samples)
    check(x)
    times = seconds(RUNS, x, repeats)
    rows = []
    for name, taken in times.items():
        faster, passes = (np.median(times[REFERENCE] / taken), np.median(taken / times[ONE_PASS]))
        rows.append([name, f"{1e3 * np.median(taken):.0f}", f"{1e3 * taken.min():.0f}"])
        rows[-1] += [f"{faster:.1f}", f"{passes:.1f}"]
    return table(
        ["", "median [ms]", "least [ms]", f"times faster than {REFERENCE}", "passes of np.sum"], rows
    )


def growth(lengths: list[int], repeats: int) -> str:
    rows = []
    for n in lengths:
        times = seconds(OURS | {ONE_PASS: np.sum}, np.random.default_rng(0).normal(size=n), repeats)
        rows.append([f"{n:,}"])
        for taken in times.values():
            rows[-1] += [f"{1e3 * np.median(taken):.3g}", f"{1e9 * np.median(taken) / n:.2f}"]
    head = [f"{name} [{unit}]" for name in (*OURS, ONE_PASS) for unit in ("ms", "ns a sample")]
    return table(["samples", *head], rows)


def axes_together(samples: int, repeats: int) -> str:
    x = np.random.default_rng(0).normal(size=(samples, AXES))
    records = {1: np.ascontiguousarray(x[:, 0]), AXES: x}
    runs = {
        (name, axes): lambda _, run=RUNS[name], record=record: run(record)
        for name in (*OURS, ONE_PASS)
        for axes, record in records.items()
    }
    times = seconds(runs, x, repeats)
    rows = []
    for name in (*OURS, ONE_PASS):
        one, all_of_them = (times[name, axes] for axes in records)
        ratio = np.median(all_of_them / one)
        rows.append(
            [name, f"{1e3 * np.median(one):.0f}", f"{1e3 * np.median(all_of_them):.0f}", f"{ratio:.1f}"]
        )
    return table(["", "one axis [ms]", f"{AXES} axes [ms]", "ratio"], rows)


def compile_times(samples: int) -> str:
    """Of a new process's first call, less the next one; without a cache of compiled programs."""
    code = (
        "import sys, time, numpy as np, allanjax as aj\n"
        "x, taken = np.random.default_rng(0).normal(size=int(sys.argv[2])), []\n"
        "for _ in range(4):\n"
        "    begun = time.perf_counter()\n"
        "    aj.allan_deviation(x, 1.0, estimator=sys.argv[1])\n"
        "    taken.append(time.perf_counter() - begun)\n"
        "print(taken[0] - min(taken))\n"
    )
    rows = []
    for estimator in ("exact", "pyramid"):
        command = [sys.executable, "-c", code, estimator, str(samples)]
        runs = [
            float(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
            for _ in range(3)
        ]
        rows.append([estimator, f"{min(runs):.2f}", f"{np.median(runs):.2f}"])
    return table(["", "least of 3 [s]", "median [s]"], rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--samples", type=int, default=10_000_000)
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--lengths", default="100000,1000000,10000000,100000000,300000000")
    parser.add_argument("--results", type=Path, default=paths.RESULTS / "allan_speed.md")
    arguments = parser.parse_args()
    n, repeats = arguments.samples, arguments.repeats
    load = os.getloadavg()[0]
    text = "\n".join(
        [
            "# Speed of the Allan deviation",
            "",
            describe(),
            f"- load of the machine when this began: {load:.1f}; JAX on {jax.default_backend()}",
            "",
            f"## {n:,} samples of white noise, octaves of the cluster time, after compilation",
            "",
            comparison(n, repeats),
            "",
            f"All exact ones are overlapping Allan variances. Medians of {repeats} rounds in which each runs",
            "once; the ratios are medians of each round's. allan-variance has its nearest setting: as many",
            "cluster sizes over the same range.",
            "",
            "## Compilation, once for each number of axes (pyramid), and octave of lengths (exact)",
            "",
            compile_times(n),
            "",
            "## Growth with the record",
            "",
            growth([int(length) for length in arguments.lengths.split(",")], repeats),
            "",
            f"## {n:,} samples of one axis and of {AXES}",
            "",
            axes_together(n, max(3, repeats // 2)),
            "",
            f"The {AXES} values of an instant lie side by side and are read there, all axes at once. Ratios",
            "are medians of each round's.",
            "",
        ]
    )
    publish(text, arguments.results)


if __name__ == "__main__":
    main()

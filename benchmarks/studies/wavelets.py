"""Wavelet variances or Allan variances: RMSE over the Cramér-Rao bound and coverage on the same records.

    python benchmarks/studies/wavelets.py [--records 100] [--n 16384] [--seed 8300] [--results PATH]

Simulator and bound are the benchmark's own (truth.py) and share no code with allanjax. Each record is fitted
with the true model's terms by each kind of variance.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

import numpy as np
import paths

from benchmarks.common.machine import describe
from benchmarks.common.ours import columns_of, fit_all, model_of, recording_of
from benchmarks.common.report import publish, table
from benchmarks.common.truth import RATE, SHOWN, Case, bound, simulate

CASES = (
    Case("N+K", {"N": 1.0, "K": 2.0}),
    Case("N+B+K", {"N": 1.0, "B": 3.0, "K": 5.0}),
    Case("N+Markov+K", {"N": 1.0, "q": 40.0, "T": 0.1, "K": 6.0}),
)
FITTERS: dict[str, dict[str, Any]] = {
    "Allan, 4 an octave": {"objective": "allan"},
    "haar": {"objective": "wavelet", "wavelet": "haar"},
    "db2": {"objective": "wavelet", "wavelet": "db2"},
    "sym4": {"objective": "wavelet", "wavelet": "sym4"},
}


def rows_of(case: Case, n: int, records: int, seed: int) -> tuple[list[list[str]], list[str]]:
    """Rows of the table for one case, and the time of each fitter."""
    x = simulate(case, n, records, np.random.default_rng(seed))
    truth, scale = np.array(list(case.truth.values())), bound(case, n)
    cells: list[list[str]] = [[] for _ in truth]
    times = []
    for name, options in FITTERS.items():
        begun = time.perf_counter()
        axes, _ = fit_all(recording_of(x), model_of(case.truth), **options)
        times.append(f"{name} {(time.perf_counter() - begun) / records * 1e3:.0f} ms")
        found = columns_of(axes, case)
        good = np.isfinite(found["value"][:, 0])
        error = (found["value"][good] - truth) / scale
        inside = (found["lower"][good] <= truth) & (truth <= found["upper"][good])
        for k in range(len(truth)):
            rmse = np.sqrt(np.mean(error[:, k] ** 2))
            bias, cover = error[:, k].mean(), inside[:, k].mean()
            cells[k].append(
                f"{bias:+.2f}, {rmse:.2f}, {cover:.3f}" + ("" if good.all() else f" of {good.sum()}")
            )
    symbols = [f"{SHOWN.get(c, c)} = {v:g}" for c, v in case.truth.items()]
    named = [case.name, *[""] * (len(truth) - 1)]
    rows = [[a, b, *c] for a, b, c in zip(named, symbols, cells, strict=True)]
    return rows, [f"- {case.name}: {', '.join(times)} a record, compilation included"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--records", type=int, default=100)
    parser.add_argument("--n", type=int, default=16384)
    parser.add_argument("--seed", type=int, default=8300)
    parser.add_argument("--results", type=Path, default=paths.RESULTS / "wavelets.md")
    options = parser.parse_args()
    rows: list[list[str]] = []
    times: list[str] = []
    for k, case in enumerate(CASES):
        more, spent = rows_of(case, options.n, options.records, options.seed + k)
        rows, times = rows + more, times + spent
        print("\n".join(spent), flush=True)
    error = 1.0 / np.sqrt(2.0 * options.records)
    text = (
        f"# Wavelet variances against Allan variances\n\n{options.records} records of {options.n:,} "
        f"samples at {RATE:g} Hz a model, seeds {options.seed} and following. Bias and RMSE in multiples of "
        "the Cramér-Rao bound of the whole record, and the share of 95 % intervals with the truth in them. "
        f"Standard error of an RMSE of 1: {error:.3f}; of a coverage of 0.95: "
        f"{np.sqrt(0.0475 / options.records):.3f}. Every kind is fitted by the same generalized least "
        "squares with its own covariance; haar is the Allan variance at octaves.\n\n"
        f"{table(['true model', 'coefficient', *FITTERS], rows)}\n\n{chr(10).join(times)}\n\n"
        f"## Machine\n\n{describe()}\n"
    )
    publish(text, options.results)


if __name__ == "__main__":
    main()

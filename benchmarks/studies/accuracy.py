"""Accuracy of the coefficients: allanjax, its peers and a plain log-log fit against the Cramér-Rao bound.

    python benchmarks/studies/accuracy.py [--quick] [--cases N+K,Q+N+K] [--lengths 16384:400] [--results PATH]

Simulated records of known noise are given to each fitter. Nothing that generates or judges them comes from
allanjax: the simulator, the generalized covariances and the bound are NumPy (truth.py). Coefficients are in
units of N (all fitters are equivariant to scale), times in seconds.
"""

from __future__ import annotations

import argparse
import time
import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import paths

import allanjax as aj
from benchmarks.common.machine import describe
from benchmarks.common.ours import LABELS, columns_of, fit_all, model_of, recording_of
from benchmarks.common.peers import PEERS
from benchmarks.common.report import publish, table
from benchmarks.common.truth import RATE, SHOWN, T0, Case, allan_shape, bound, exact_bound, simulate

CHUNK = 50
BASIC = "QNBKR"

CASES = (
    Case("N+K", {"N": 1.0, "K": 2.0}),
    Case("Q+N+K", {"Q": 0.1, "N": 1.0, "K": 2.0}),
    Case("N+B", {"N": 1.0, "B": 2.0}),
    Case("N+B+K", {"N": 1.0, "B": 3.0, "K": 5.0}),
    Case("N+Markov+K", {"N": 1.0, "q": 40.0, "T": 0.1, "K": 6.0}),
)


# --- The fitters -------------------------------------------------------------------------------------------


def by_allanjax(case: Case, x: np.ndarray) -> dict[str, np.ndarray]:
    """What allanjax says with the true terms, [records, params] for each field; NaN without a result."""
    axes, _ = fit_all(recording_of(x), model_of(case.truth))
    return columns_of(axes, case)


def by_selection(x: np.ndarray) -> np.ndarray:
    """Which of the basic terms `fit(recording)` detects, [records, terms]; NaN where it did not converge."""
    rows = []
    for axis in aj.fit(recording_of(x), as_is=True, vibrating=True).results:
        try:
            rows.append([float(axis[LABELS[c]].detected) for c in BASIC])
        except aj.AllanjaxError:
            rows.append([np.nan] * len(BASIC))
    return np.array(rows)


# --- The comparison ----------------------------------------------------------------------------------------


@dataclass
class Outcome:
    """What came of one case at one record length."""

    case: Case
    n: int
    bound: np.ndarray
    ours: dict[str, np.ndarray]
    peers: dict[str, np.ndarray]
    selection: np.ndarray | None
    simulator_deviation: float

    @property
    def truth(self) -> np.ndarray:
        return np.array(list(self.case.truth.values()))

    def errors(self, estimates: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Bias and RMSE over the records that have a result, in Cramér-Rao standard deviations."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)
            error = (estimates - self.truth) / self.bound
            return np.nanmean(error, axis=0), np.sqrt(np.nanmean(error**2, axis=0))


def compare(case: Case, n: int, records: int, seed: int) -> Outcome:
    """All fitters on the same records."""
    rng = np.random.default_rng(seed)
    ours: list[dict[str, np.ndarray]] = []
    peers: dict[str, list[np.ndarray]] = {name: [] for name in PEERS}
    selection: list[np.ndarray] = []
    curves: list[np.ndarray] = []
    for first in range(0, records, CHUNK):
        x = simulate(case, n, min(CHUNK, records - first), rng)
        curves.append(_allan(x))
        ours.append(by_allanjax(case, x))
        if "q" not in case.truth:
            selection.append(by_selection(x))
        for name, run in PEERS.items():
            peers[name].append(run(case, x))
    curve = np.concatenate(curves, axis=1)
    T = T0 * 2.0 ** np.arange(len(curve))
    shapes = {c: allan_shape(c, T, case.truth.get("T", 1.0)) for c in case.amplitudes}
    expected = sum(case.truth[c] ** 2 * shapes[c] for c in case.amplitudes)
    z = (curve.mean(axis=1) - expected) / (curve.std(axis=1, ddof=1) / np.sqrt(records))
    return Outcome(
        case,
        n,
        bound(case, n),
        {name: np.concatenate([part[name] for part in ours]) for name in ours[0]},
        {name: np.concatenate(parts) for name, parts in peers.items()},
        np.concatenate(selection) if selection else None,
        float(np.abs(z).max()),
    )


def _allan(x: np.ndarray) -> np.ndarray:
    """Overlapping Allan variances at octaves, [m, records]."""
    phase = np.concatenate([np.zeros((1, x.shape[1])), np.cumsum(x, axis=0)]) * T0
    sizes = 2 ** np.arange(int(np.log2(len(x) // 8)))
    second = (phase[2 * m :] - 2.0 * phase[m:-m] + phase[: -2 * m] for m in sizes)
    mean_squares = np.array([np.mean(d**2, axis=0) for d in second])
    return mean_squares / (2.0 * (sizes[:, None] * T0) ** 2)


# --- The report --------------------------------------------------------------------------------------------

RMSE_TARGET = 1.10
COVERAGE_TARGET = (0.92, 0.98)


def accuracy_table(outcomes: list[Outcome]) -> str:
    rows = []
    for o in outcomes:
        columns = [o.errors(estimates) for estimates in (o.ours["value"], *o.peers.values())]
        for k, symbol in enumerate(o.case.truth):
            cells = [f"{b[k]:+.2f}, {r[k]:.2f}" if np.isfinite(r[k]) else "n/a" for b, r in columns]
            name = SHOWN.get(symbol, symbol)
            relative = f"{100.0 * o.bound[k] / o.truth[k]:.2f} %"
            rows.append([o.case.name if k == 0 else "", f"{name} = {o.truth[k]:g}", relative, *cells])
    return table(["true model", "coefficient", "bound", "allanjax", *PEERS], rows)


def interval_table(outcomes: list[Outcome]) -> str:
    rows = []
    for o in outcomes:
        value, std, low, high = (o.ours[name] for name in ("value", "std", "lower", "upper"))
        good = np.isfinite(value[:, 0])
        inside, above, below = (
            np.mean(hit[good], axis=0)
            for hit in ((low <= o.truth) & (o.truth <= high), o.truth > high, o.truth < low)
        )
        one_sigma = np.mean(np.abs(value - o.truth)[good] <= std[good], axis=0)
        detected = o.ours["detected"][good].mean(axis=0)
        for k, symbol in enumerate(o.case.truth):
            error = np.sqrt(max(inside[k] * (1.0 - inside[k]), 0.01) / good.sum())
            rows.append(
                [
                    o.case.name if k == 0 else "",
                    SHOWN.get(symbol, symbol),
                    f"{inside[k]:.3f} ± {error:.3f}",
                    f"{above[k]:.3f}",
                    f"{below[k]:.3f}",
                    f"{one_sigma[k]:.3f}",
                    f"{np.nanmean(std[:, k]) / o.bound[k]:.2f}",
                    f"{detected[k]:.3f}",
                    f"{good.mean():.3f}" if k == 0 else "",
                ]
            )
    head = ["true model", "coefficient", "95 % interval", "truth above", "truth below", "value ± std"]
    return table([*head, "mean std / bound", "detected", "converged"], rows)


def selection_table(outcomes: list[Outcome]) -> str:
    rows = []
    for o in outcomes:
        if o.selection is None:
            continue
        good = np.isfinite(o.selection[:, 0])
        found = o.selection[good] > 0.0
        true = np.array([c in o.case.truth for c in BASIC])
        complete, spurious = found[:, true].all(axis=1), found[:, ~true].any(axis=1)
        others = ", ".join(
            f"{c} {rate:.3f}"
            for c, rate, known in zip(BASIC, found.mean(axis=0), true, strict=True)
            if not known and rate > 0.0
        )
        fractions = (complete.mean(), spurious.mean(), (complete & ~spurious).mean(), good.mean())
        rows.append([o.case.name, *(f"{fraction:.3f}" for fraction in fractions), others])
    head = ["true model", "all its terms found", "a term too many", "exactly its terms", "converged"]
    return table([*head, "terms too many"], rows)


def misses(outcomes: list[Outcome]) -> list[str]:
    """What falls short of the targets."""
    found = []
    for o in outcomes:
        _, rmse = o.errors(o.ours["value"])
        good = np.isfinite(o.ours["value"][:, 0])
        inside = (o.ours["lower"] <= o.truth) & (o.truth <= o.ours["upper"])
        coverage = inside[good].mean(axis=0)
        for k, symbol in enumerate(o.case.truth):
            where = f"{o.case.name}, n = {o.n}, {SHOWN.get(symbol, symbol)}"
            if rmse[k] > RMSE_TARGET:
                found.append(f"{where}: RMSE {rmse[k]:.2f} (± {rmse[k] / np.sqrt(2.0 * good.sum()):.2f})")
            if not COVERAGE_TARGET[0] <= coverage[k] <= COVERAGE_TARGET[1]:
                found.append(f"{where}: coverage {coverage[k]:.3f}")
    return found


def bound_check(cases: list[Case], n: int = 2048) -> str:
    """The bound by cosines against the exact one."""
    rows = []
    for case in cases:
        ratio = bound(case, n) / exact_bound(case, n)
        cells = (f"{SHOWN.get(c, c)} {r:.4f}" for c, r in zip(case.truth, ratio, strict=True))
        rows.append([case.name, ", ".join(cells)])
    return table(["true model", f"bound by cosines / exact bound, n = {n}"], rows)


INTRODUCTION = """# Accuracy

Records of known noise, simulated at {rate:g} Hz, are fitted by allanjax with the true model's terms, and by
its peers. Errors are in units of the Cramér-Rao bound of the *whole record* (exact Gaussian likelihood, bias
unknown), below which no unbiased estimator can go. Simulator, bound and log-log fit are the benchmark's own
and share no code with allanjax. Reproduce with `python benchmarks/studies/accuracy.py`.

{machine}

## How the others are run

- **allan-variance**: `compute_avar` and `estimate_parameters` with their defaults (100 cluster times up to
  n/10) and the true effects. It has no Markov noise; its users fit flicker in its place.
- **avar**: `windows`, `variance` (64 cluster times a decade up to n/2, its default) and the interactive class
  `fit`, started at the *true* values and driven by the key event "o" without a display. It adjusts magnitudes
  only, so T_c is held at the truth; it has no bias instability. "to n/10" leaves out the long cluster times.
- **log-log**: unweighted least squares of ln σ(T), four cluster times an octave up to n/2 (or n/10), started
  at the true values, each coefficient within e⁹ of its truth.

Coefficients: N = 1 sets the unit; times in s.
"""


def report(groups: list[tuple[int, list[Outcome]]], check: str, seconds: float) -> str:
    parts = [INTRODUCTION.format(rate=RATE, machine=describe())]
    for records, outcomes in groups:
        n = outcomes[0].n
        worst = max(o.simulator_deviation for o in outcomes)
        parts += [
            f"## {n} samples ({n * T0:.0f} s), {records} records a model\n",
            "Bias, RMSE; both in multiples of the bound, which is given in per cent of the coefficient. "
            f"Standard error of an RMSE of 1: {1.0 / np.sqrt(2.0 * records):.3f}.\n",
            accuracy_table(outcomes) + "\n",
            "allanjax's intervals: fraction of records that have the truth inside the 95 % interval (with "
            "its standard error), above it, below it; inside value ± std (Gaussian: 0.683).\n",
            interval_table(outcomes) + "\n",
            "`fit(recording)` without a model, which chooses among the five basic terms:\n",
            selection_table(outcomes) + "\n",
            "Simulator: the mean Allan variances of the records are within "
            f"{worst:.1f} standard errors of theory at every octave.\n",
        ]
    short = misses([o for _, outcomes in groups for o in outcomes])
    low, high = COVERAGE_TARGET
    parts += [
        f"## Against the targets (RMSE ≤ {RMSE_TARGET:.2f} bounds, coverage {low:.2f} to {high:.2f})\n",
        "\n".join(f"- {line}" for line in short) + "\n" if short else "All met.\n",
        "## The bound\n",
        check + "\n",
        f"Whole run: {seconds / 60.0:.0f} min.\n",
    ]
    return "\n".join(parts)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="few short records, to see that all of it runs")
    parser.add_argument("--cases", help="true models, e.g. N+K,N+B; all by default")
    parser.add_argument("--lengths", help="record lengths and counts, e.g. 16384:400,65536:200")
    parser.add_argument("--results", type=Path, default=paths.RESULTS / "accuracy.md")
    options = parser.parse_args()
    names = options.cases.split(",") if options.cases else [case.name for case in CASES]
    cases = [case for case in CASES if case.name in names]
    lengths = options.lengths or ("16384:50" if options.quick else "16384:400,65536:200")
    started = time.perf_counter()
    groups = []
    for length in lengths.split(","):
        n, records = (int(part) for part in length.split(":"))
        outcomes = []
        for case in cases:
            begun = time.perf_counter()
            outcomes.append(compare(case, n, records, seed=n + CASES.index(case)))
            print(f"{case.name}, {n} samples: {time.perf_counter() - begun:.0f} s", flush=True)
        tables = (accuracy_table(outcomes), interval_table(outcomes), selection_table(outcomes))
        print("\n\n".join(tables), flush=True)
        groups.append((records, outcomes))
    text = report(groups, bound_check(cases), time.perf_counter() - started)
    publish(text, options.results, options.quick)


if __name__ == "__main__":
    main()

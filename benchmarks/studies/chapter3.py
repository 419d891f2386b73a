"""Table 3.6 of Hou (2004) in numbers: what each method of its chapter 3 is good for, on the same records.

    python benchmarks/studies/chapter3.py [--records 60] [--n 65536] [--seed 36000] [--quick] [--results PATH]

Simulator and Cramér-Rao bound are the benchmark's own (truth.py) and share no code with allanjax. All methods
are told which terms there are. Readings are those of the thesis: lines of fixed slope in the Allan deviation
(4.29 to 4.56) and its hump (4.61), slopes of the density, the autocorrelation's 1/e (3.33) after a wavelet
approximation. The adaptive bank has a model at each corner of a grid around the truth, and tells the mean
of the coefficients by the last weights; quantization is given to it.
"""

from __future__ import annotations

import argparse
import itertools
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import paths

import allanjax as aj
from benchmarks.common.machine import describe
from benchmarks.common.ours import LABELS, columns_of, fit_all, model_of, recording_of
from benchmarks.common.readings import SLOPES, read_slope
from benchmarks.common.report import publish, table
from benchmarks.common.truth import RATE, SHOWN, T0, Case, bound, simulate

GRADES = (
    Case("navigation: Q, N, Markov", {"Q": 0.5, "N": 1.0, "q": 2.0, "T": 20.0}),
    Case("tactical: Q, N, K", {"Q": 0.2, "N": 1.0, "K": 0.3}),
    Case("consumer: N, B", {"N": 1.0, "B": 1.5}),
)
# The Allan deviation of a Gauss-Markov process is largest, 0.437 q√T_c, at 1.89 T_c (Hou 2004, 4.61).
PEAK_TIME, PEAK = 1.89, 0.437
# Corners of the bank's grid: factors of a coefficient, each record's grid shifted by a random part of a step.
FACTORS = np.array([0.4, 0.632, 1.0, 1.58, 2.5])

Values = np.ndarray


def by_autocorrelation(case: Case, x: np.ndarray, rng: np.random.Generator) -> Values:
    """Gauss-Markov parameters by (3.32) and (3.33) of the level that `denoise` gives for the true model."""
    found = np.full((x.shape[1], len(case.truth)), np.nan)
    if "q" not in case.truth:
        return found
    recording = recording_of(x)
    level = aj.denoise(recording_of(x[:, :1]), true_model(case.truth)).results[0].level
    smooth = aj.wavelet_decomposition(recording).approximation(level)
    readings = aj.autocorrelation(smooth, longest_lag=len(x) * T0 / 2.0).markov()
    for row, axis in zip(found, readings.results, strict=True):
        variance, correlation_time = (np.nan if e is None else e.value for e in axis.estimates.values())
        at = list(case.truth).index
        row[at("T")], row[at("q")] = correlation_time, np.sqrt(2.0 * variance / correlation_time)
    return found


def by_density(case: Case, x: np.ndarray, rng: np.random.Generator) -> Values:
    """Slopes of the density, averaged over frequency (table 3.4)."""
    readings = aj.power_spectrum(recording_of(x)).readings()
    rows = []
    for axis in readings.results:
        found = [None if c in "qT" else axis[LABELS[c]] for c in case.truth]
        rows.append([np.nan if e is None else e.value for e in found])
    return np.array(rows)


def by_allan_lines(case: Case, x: np.ndarray, rng: np.random.Generator) -> Values:
    """Lines of fixed slope in the Allan deviation, and its hump."""
    curve = aj.allan_deviation(recording_of(x))
    terms = {term.name(): term for term in SLOPES}
    rows = []
    for column in range(x.shape[1]):
        value = {c: read_slope(curve, column, terms[LABELS[c]]).value for c in case.truth if c not in "qT"}
        if "q" in case.truth:
            value |= hump(curve, column)
        rows.append([value[c] for c in case.truth])
    return np.array(rows)


def hump(curve: aj.AllanDeviation, column: int) -> dict[str, float]:
    """Parameters of a Gauss-Markov process from the largest deviation beyond the least one."""
    T, deviation = curve.cluster_time, curve.deviation[:, column]
    least = int(np.argmin(deviation[: len(T) // 2]))
    k = least + int(np.argmax(deviation[least:]))
    correlation_time = T[k] / PEAK_TIME
    return {"T": correlation_time, "q": deviation[k] / (PEAK * np.sqrt(correlation_time))}


def by_fit(objective: str) -> Callable[[Case, np.ndarray, np.random.Generator], Values]:
    """A fit of allanjax with this objective."""

    def fitted(case: Case, x: np.ndarray, rng: np.random.Generator) -> Values:
        axes, _ = fit_all(recording_of(x), model_of(case.truth), objective)
        return columns_of(axes, case)["value"]

    return fitted


def by_bank(case: Case, x: np.ndarray, rng: np.random.Generator) -> Values:
    """Mean of the coefficients of a bank's models by their weights after the last sample."""
    free = [c for c in case.truth if c != "Q"]
    rows = []
    for column in range(x.shape[1]):
        middle = {c: case.truth[c] * FACTORS[1] ** rng.uniform(-0.5, 0.5) for c in free}
        corners = [
            case.truth | {c: middle[c] * f for c, f in zip(free, factors, strict=True)}
            for factors in itertools.product(FACTORS, repeat=len(free))
        ]
        bank = {f"corner {k}": true_model(corner) for k, corner in enumerate(corners)}
        weights = aj.adaptive_filter(recording_of(x[:, [column]]), bank, switching=0.0).results[0].weights[-1]
        value = weights @ np.array([list(corner.values()) for corner in corners])
        rows.append([value[k] if c in free else np.nan for k, c in enumerate(case.truth)])
    return np.array(rows)


def true_model(value: dict[str, float]) -> aj.Model:
    """The model with these values."""
    terms = {"Q": aj.Quantization, "N": aj.AngleRandomWalk, "B": aj.BiasInstability, "K": aj.RateRandomWalk}
    parts = [terms[c](value[c]) for c in value if c in terms]
    return aj.Model((*parts, *([aj.Markov(value["q"], value["T"])] if "q" in value else [])))


METHODS: dict[str, Callable[[Case, np.ndarray, np.random.Generator], Values]] = {
    "autocorrelation": by_autocorrelation,
    "slopes of the PSD": by_density,
    "slopes of the Allan deviation": by_allan_lines,
    "adaptive bank": by_bank,
    "wavelet variance, fitted": by_fit("wavelet"),
    "Allan variance, fitted": by_fit("allan"),
    "spectrum, fitted": by_fit("whittle"),
    "exact likelihood": by_fit("exact"),
}
# Methods that are slow get fewer records.
FEWER = {"adaptive bank": 6, "exact likelihood": 3}


def rows_of(case: Case, n: int, records: int, seed: int) -> list[list[str]]:
    """Rows of the table of one grade."""
    x = simulate(case, n, records, np.random.default_rng(seed))
    truth, scale = np.array(list(case.truth.values())), bound(case, n)
    rows = []
    for name, method in METHODS.items():
        own = x[:, : max(records // FEWER.get(name, 1), 2)]
        # Programs are compiled before the clock starts.
        method(case, own[:, :1], np.random.default_rng(seed))
        begun = time.perf_counter()
        value = method(case, own, np.random.default_rng(seed + 1))
        seconds = (time.perf_counter() - begun) / own.shape[1]
        cells = []
        for k in range(len(truth)):
            good = np.isfinite(value[:, k])
            error = (value[good, k] - truth[k]) / scale[k]
            if not good.any():
                cells.append("—")
                continue
            cell = f"{error.mean():+.1f}, {np.sqrt(np.mean(error**2)):.1f}"
            cells.append(cell if good.all() else f"{cell} ({good.mean():.0%} read)")
        rows.append([name, str(own.shape[1]), *cells, f"{seconds:.2g}"])
        print(case.name, rows[-1], flush=True)
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--records", type=int, default=60)
    parser.add_argument("--n", type=int, default=65536)
    parser.add_argument("--seed", type=int, default=36000)
    parser.add_argument("--quick", action="store_true", help="few short records, to see that all of it runs")
    parser.add_argument("--results", type=Path, default=paths.RESULTS / "chapter3.md")
    options = parser.parse_args()
    n, records = (8192, 4) if options.quick else (options.n, options.records)
    parts = [
        "# The methods of chapter 3, measured\n\n"
        f"Records of {n:,} samples at {RATE:g} Hz ({n * T0:.0f} s) of three grades of sensors, seeds from "
        f"{options.seed} on; coefficients in units of N and s. Cells: bias, RMSE, both in multiples of the "
        "Cramér-Rao bound of the whole record; seconds a record, programs compiled before. All methods know "
        "which terms there are. What a method has no reading of is marked —; the share of records in which "
        "there is one is in brackets. The adaptive bank has models at five values a coefficient, "
        f"{FACTORS[0]:g} to {FACTORS[-1]:g} times the truth, shifted at random by up to half a step, and is "
        "given Q. Standard error of an RMSE of 1 from "
        f"{records} records: {1.0 / np.sqrt(2.0 * records):.2f}.\n\n{describe()}\n"
    ]
    for k, case in enumerate(GRADES):
        rows = rows_of(case, n, records, options.seed + 10 * k)
        scale = bound(case, n) / np.array(list(case.truth.values()))
        named = [
            f"{SHOWN.get(c, c)} = {v:g} (bound {100 * s:.2g} %)"
            for (c, v), s in zip(case.truth.items(), scale, strict=True)
        ]
        parts.append(f"## {case.name}\n\n{table(['method', 'records', *named, 's'], rows)}\n")
    publish("\n".join(parts), options.results, options.quick)


if __name__ == "__main__":
    main()

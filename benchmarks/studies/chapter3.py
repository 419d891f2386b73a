"""What is each method of chapter 3 of Hou (2004) good for, on the same records (its table 3.6 in numbers)?

Records of three grades of sensors, simulated independently of the package; coefficients in units of N and s.
Cells: bias, RMSE, both in multiples of the Cramér-Rao bound of the whole record; seconds a record, programs
compiled before. All methods know which terms there are. Readings are those of the thesis: lines of fixed
slope in the Allan deviation (4.29 to 4.56) and its hump (4.61), slopes of the density, the autocorrelation's
1/e (3.33) of the wavelet approximation that `denoise` takes for the true model. The adaptive bank has a model
at each corner of a grid around the truth, 0.4 to 2.5 times of it, shifted at random by up to half a step, and
is given Q; it tells the mean of the coefficients by the last weights.
"""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

import allanjax as aj
from allanjax.allan.deviation import AllanDeviation
from allanjax.base.wording import percent
from allanjax.noise.terms import (
    AngleRandomWalk,
    BiasInstability,
    DriftRamp,
    NoiseTerm,
    Quantization,
    RateRandomWalk,
)
from benchmarks.common.ours import LABELS, columns_of, fit_all, model_of, recording_of, true_model
from benchmarks.common.study import rms, table
from benchmarks.common.truth import RATE, SHOWN, T0, Case, bound, simulate

# Slope of each term in the plot, and the cluster time [s] at which its line has the coefficient's value.
SLOPES: dict[type[NoiseTerm], tuple[float, float]] = {
    Quantization: (-1.0, math.sqrt(3.0)),
    AngleRandomWalk: (-0.5, 1.0),
    BiasInstability: (0.0, 1.0),
    RateRandomWalk: (0.5, 3.0),
    DriftRamp: (1.0, math.sqrt(2.0)),
}
# A point belongs to a term's region if the curve's slope there is this close to the term's.
SLOPE_TOLERANCE = 0.15
# The thesis reads up to clusters whose error by (4.66) is a third.
LARGEST_ERROR = 1.0 / 3.0


@dataclass(frozen=True)
class Reading:
    """A coefficient read off the plot, and its standard error by (4.66); both in SI."""

    value: float
    error: float


def read_slope(curve: AllanDeviation, column: int, term: type[NoiseTerm]) -> Reading:
    """Fit a line of the term's slope to the longest run of points that have about this slope.

    Where no point has it, the one that comes nearest is taken. The error is that of the run's longest
    clusters. The flat part of a curve with bias instability stands at √(2 ln 2/π) B (4.51).
    """
    slope, unit_time = SLOPES[term]
    usable = curve.thesis_relative_error <= LARGEST_ERROR
    T, deviation = np.log(curve.cluster_time[usable]), np.log(curve.deviation[usable, column])
    misfit = np.abs(np.gradient(deviation, T) - slope)
    run = longest_run(misfit <= max(SLOPE_TOLERANCE, misfit.min()))
    level = float(np.exp(np.mean(deviation[run] - slope * (T[run] - math.log(unit_time)))))
    value = level / math.sqrt(2.0 * math.log(2.0) / math.pi) if term is BiasInstability else level
    return Reading(value, value * float(curve.thesis_relative_error[usable][run][-1]))


def longest_run(belongs: Float[np.ndarray, " m"]) -> slice:
    """The longest stretch of consecutive True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], belongs, [False]]).astype(int)))
    starts, stops = edges[::2], edges[1::2]
    longest = int(np.argmax(stops - starts))
    return slice(int(starts[longest]), int(stops[longest]))


QUICK: dict[str, Any] = {"records": 2, "samples": 2048, "grades": 1}
GRADES = (
    Case("tactical: Q, N, K", {"Q": 0.2, "N": 1.0, "K": 0.3}),
    Case("navigation: Q, N, Markov", {"Q": 0.5, "N": 1.0, "q": 2.0, "T": 20.0}),
    Case("consumer: N, B", {"N": 1.0, "B": 1.5}),
)
#: The Allan deviation of a Gauss-Markov process is largest, 0.437 q√T_c, at 1.89 T_c (Hou 2004, 4.61).
PEAK_TIME, PEAK = 1.89, 0.437
FACTORS = np.array([0.4, 0.632, 1.0, 1.58, 2.5])

Method = Callable[[Case, np.ndarray, np.random.Generator], np.ndarray]


def run(*, records: int = 60, samples: int = 65536, grades: int = 3, seed: int = 36000) -> Iterator[str]:
    yield (
        f"{samples:,} samples at {RATE:g} Hz ({samples * T0:.0f} s). Standard error of an RMSE of 1 from "
        f"{records} records: {1.0 / np.sqrt(2.0 * records):.2f}. In brackets the share that could be read."
    )
    for k, case in enumerate(GRADES[:grades]):
        bounds = zip(case.truth.items(), bound(case, samples), strict=True)
        named = [f"{SHOWN.get(c, c)} = {v:g} (bound {100 * s / v:.2g} %)" for (c, v), s in bounds]
        rows = rows_of(case, samples, records, seed + 10 * k)
        yield f"## {case.name}\n\n{table(['method', 'records', *named, 's'], rows)}"


def rows_of(case: Case, n: int, records: int, seed: int) -> list[list[str]]:
    x = simulate(case, n, records, np.random.default_rng(seed))
    truth, scale = np.array(list(case.truth.values())), bound(case, n)
    rows = []
    for name, method in METHODS.items():
        own = x[:, : max(records // FEWER.get(name, 1), 2)]
        method(case, own[:, :1], np.random.default_rng(seed))
        begun = time.perf_counter()
        value = method(case, own, np.random.default_rng(seed + 1))
        seconds = (time.perf_counter() - begun) / own.shape[1]
        cells = []
        for k in range(len(truth)):
            good = np.isfinite(value[:, k])
            error = (value[good, k] - truth[k]) / scale[k]
            read = "" if good.all() else f" ({percent(float(good.mean()))})"
            cells.append(f"{error.mean():+.1f}, {rms(error):.1f}{read}" if good.any() else "–")
        rows.append([name, str(own.shape[1]), *cells, f"{seconds:.2g}"])
    return rows


def by_autocorrelation(case: Case, x: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    found = np.full((x.shape[1], len(case.truth)), np.nan)
    if "q" not in case.truth:
        return found
    level = aj.denoise(recording_of(x[:, :1]), true_model(case.truth)).results[0].level
    smooth = aj.wavelet_decomposition(recording_of(x)).approximation(level)
    readings = aj.autocorrelation(smooth, longest_lag=len(x) * T0 / 2.0).markov()
    for row, axis in zip(found, readings.results, strict=True):
        variance, correlation_time = (np.nan if e is None else e.value for e in axis.estimates.values())
        at = list(case.truth).index
        row[at("T")], row[at("q")] = correlation_time, np.sqrt(2.0 * variance / correlation_time)
    return found


def by_density(case: Case, x: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    rows = []
    for axis in aj.power_spectrum(recording_of(x)).readings().results:
        found = [None if c in "qT" else axis[LABELS[c]] for c in case.truth]
        rows.append([np.nan if e is None else e.value for e in found])
    return np.array(rows)


def by_allan_lines(case: Case, x: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    curve = aj.allan_deviation(recording_of(x))
    terms = {term.name(): term for term in SLOPES}
    rows = []
    for column in range(x.shape[1]):
        value = {c: read_slope(curve, column, terms[LABELS[c]]).value for c in case.truth if c not in "qT"}
        if "q" in case.truth:
            # The hump: the largest deviation beyond the least one.
            T, deviation = curve.cluster_time, curve.deviation[:, column]
            least = int(np.argmin(deviation[: len(T) // 2]))
            k = least + int(np.argmax(deviation[least:]))
            value["T"] = T[k] / PEAK_TIME
            value["q"] = deviation[k] / (PEAK * np.sqrt(value["T"]))
        rows.append([value[c] for c in case.truth])
    return np.array(rows)


def by_fit(objective: str) -> Method:
    def fitted(case: Case, x: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        return columns_of(fit_all(recording_of(x), model_of(case.truth), objective)[0], case)["value"]

    return fitted


def by_bank(case: Case, x: np.ndarray, rng: np.random.Generator) -> np.ndarray:
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


METHODS: dict[str, Method] = {
    "autocorrelation": by_autocorrelation,
    "slopes of the PSD": by_density,
    "slopes of the Allan deviation": by_allan_lines,
    "adaptive bank": by_bank,
    "wavelet variance, fitted": by_fit("wavelet"),
    "Allan variance, fitted": by_fit("allan"),
    "spectrum, fitted": by_fit("whittle"),
    "exact likelihood": by_fit("exact"),
}
#: Slow methods get fewer records.
FEWER = {"adaptive bank": 6, "exact likelihood": 3}

"""How small a rate random walk is seen, and do intervals and upper limits hold it there?

Records of N + K, N = 1, simulated independently of the package. K is in units of its detection limit: there
K² is three of the Cramér-Rao standard deviations that it has for K → 0. An interval that begins at zero may
hold K in 97.5 %. The matched likelihood ratio is that of N and K = limit, both known, against N alone, which
at the limit no test can beat.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from scipy.fft import dct

from benchmarks.common.ours import FIELDS, LABELS, columns_of, fit_all, model_of, recording_of
from benchmarks.common.study import run_tasks, share, table
from benchmarks.common.truth import T0, Case, bound, cosine_variances, derivatives, simulate

QUICK: dict[str, Any] = {"records": 3, "null": 3, "samples": 2048, "multiples": (1.0, 3.0)}
CHUNK = 25
FALSE_ALARMS = 0.01
FITS = {
    "Allan, N+K given": ("NK", "allan"),
    "Whittle, N+K given": ("NK", "whittle"),
    "Allan, terms chosen": ("", "allan"),
    "Whittle, terms chosen": ("", "whittle"),
}
STATISTICS = ("Allan: K̂", "Whittle: K̂", "evidence of N+K over N", "likelihood ratio, N and K = limit known")

Outcome = dict[str, np.ndarray]


def run(
    *,
    records: int = 300,
    null: int = 600,
    samples: int = 16384,
    multiples: tuple[float, ...] = (0.2, 0.4, 0.6, 0.8, 1.0, 1.25, 1.5, 2.0, 3.0),
    seed: int = 1000,
) -> Iterator[str]:
    little = 1e-4 / np.sqrt(samples * T0) / (samples * T0)
    edge = float(np.sqrt(6.0 * little * bound(Case("", {"N": 1.0, "K": little}), samples)[1]))
    sizes = (0.0, *multiples)
    tasks = [(m * edge, edge, samples, records if m else null, seed + k) for k, m in enumerate(sizes)]
    sweep = dict(zip(sizes, run_tasks(outcomes, tasks), strict=True))
    yield f"{samples:,} samples, {records} records a K ({null} without it); the limit is K = {edge:.4g}."
    held = {m: [judged(o[name], m * edge) for name in FITS] for m, o in sweep.items()}
    rows = [[f"{m:g}", *(share(h[k]) for k in (0, 1) for h in found)] for m, found in held.items() if m]
    yield "## Coverage of K\n\nShare of 95 % intervals that hold K, and of one-sided 95 % limits above it."
    yield table(["K / limit", *(f"{name}: {w}" for w in ("interval", "limit") for name in FITS)], rows)
    yield "## Detection, as reported\n\nThe row of K = 0 has the false alarms."
    yield table(["K / limit", *FITS], [[f"{m:g}", *(share(h[2]) for h in f)] for m, f in held.items()])
    yield (
        f"## Detection at {100 * FALSE_ALARMS:g} % false alarms\n\nThresholds on each statistic are exceeded "
        "in so many of the records without K."
    )
    cut = np.quantile(sweep[0.0]["statistics"], 1.0 - FALSE_ALARMS, axis=0)
    rows = [[f"{m:g}", *(share(x) for x in (o["statistics"] > cut).T)] for m, o in sweep.items() if m]
    yield table(["K / limit", *STATISTICS], rows)


def outcomes(K: float, edge: float, samples: int, records: int, seed: int) -> Outcome:
    """Of each record: what each fit says of K [records, fields], and the detection statistics."""
    rng = np.random.default_rng(seed)
    parts: dict[str, list[np.ndarray]] = {name: [] for name in (*FITS, "statistics")}
    laws = [cosine_variances(derivatives(Case("", {"N": 1.0, "K": k}), samples)[0]) for k in (0.0, edge)]
    for first in range(0, records, CHUNK):
        size = min(CHUNK, records - first)
        x = simulate(Case("", {"N": 1.0, "K": K}), samples, size, rng)
        statistics = []
        for name, (given, objective) in FITS.items():
            axes, ranking = fit_all(recording_of(x), model_of(given) if given else None, objective)
            columns = columns_of(axes, Case("", {"K": K}))
            parts[name].append(np.stack([column[:, 0] for column in columns.values()], axis=1))
            if given:
                statistics.append(columns["value"][:, 0])
            elif objective == "allan":
                sets = [{s.terms: s.log_evidence for s in axis.ranking} for axis in ranking.results]
                statistics.append(np.array([s[LABELS["N"], LABELS["K"]] - s[(LABELS["N"],)] for s in sets]))
        c = dct(x, norm="ortho", axis=0)[1:].T
        statistics.append(0.5 * c**2 @ (1.0 / laws[0] - 1.0 / laws[1]))
        parts["statistics"].append(np.stack(statistics, axis=1))
    return {name: np.concatenate(part) for name, part in parts.items()}


def judged(found: np.ndarray, K: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of the records with a result: K inside the interval, below the upper limit, detected."""
    o = dict(zip(FIELDS, found[np.isfinite(found[:, 0])].T, strict=True))
    return (o["lower"] <= K) & (o["upper"] >= K), o["limit"] >= K, o["detected"] > 0.0

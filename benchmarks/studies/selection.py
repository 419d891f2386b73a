"""Which terms does `fit(recording)` choose, of those clearly seen and of those that hardly are?

Records of known terms, simulated independently of the package; `fit` ranks all sets of the five basic terms
and a Markov process by their evidence. Coefficients are log-uniform over a factor of three (of the five
terms: two) around values that are clearly seen, with Cramér-Rao bounds of at most some 20 %; at the edge all
amplitudes but N are multiplied by 0.08 to 0.6, log-uniform.

*Ranked first*: the true set has the highest evidence. *Not told apart*: odds against the best set below 20.
*Detected*: coefficients that the fit calls so.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from typing import Any

import numpy as np

from benchmarks.common.ours import TERM_LABELS, fit_all, recording_of
from benchmarks.common.study import run_tasks, share, table
from benchmarks.common.truth import SCENARIOS, SHAPES, simulate

QUICK: dict[str, Any] = {"records": 3, "samples": (2048,), "clear": ("N", "N+K"), "edge": ("N+K",)}
STRENGTH = {"clear": (1.0, 1.0), "edge": (0.08, 0.6)}
CHUNK = 25
SYMBOLS = {label: symbol for symbol, label in TERM_LABELS.items()}
PROBABILITIES = (0.0, 0.3, 0.5, 0.7, 0.85, 0.95, 0.99, 1.0)
#: Columns of an outcome, a row a record; two more are the stated probability and the sets not told apart.
COLUMNS = ("ranked first", "first or not told apart", "chosen exactly", "a term too many chosen")
COLUMNS += ("a spurious term detected", "a true term not detected", "converged")
FIRST, PROBABILITY, COUNT = 0, 7, 8

Found = tuple[np.ndarray, list[str]]


def run(
    *,
    records: int = 300,
    samples: tuple[int, ...] = (16384, 131072),
    clear: tuple[str, ...] = ("N", "N+K", "Q+N+K", "N+B", "N+B+K", "N+Markov+K", "N+K+R", "Q+N+B+K+R"),
    edge: tuple[str, ...] = ("N+K", "N+B", "N+Markov", "Q+N+K", "N+B+K"),
    seed: int = 0,
) -> Iterator[str]:
    for which, cases in (("clear", clear), ("edge", edge)):
        everything = []
        for n in samples if which == "clear" else samples[:1]:
            # Long records take their time.
            count = records if n <= 20_000 else max(records // 3, 1)
            tasks = [(name, n, count, seed + n + k, which) for k, name in enumerate(cases)]
            found = dict(zip(cases, run_tasks(outcomes, tasks), strict=True))
            everything += [rows for rows, _ in found.values()]
            yield f"## Terms {'clearly seen' if which == 'clear' else 'at the edge'}: {n:,} samples"
            yield f"{count} records of each set.\n\n{selection_table(found)}"
        yield (
            "How often the most probable set is true, by its stated probability. All sets are equally "
            "probable to the package; here only those of the tables occur, equally often."
        )
        yield calibration_table(np.concatenate(everything))


def outcomes(name: str, n: int, records: int, seed: int, which: str) -> Found:
    """What was ranked, chosen and detected in each record, and the symbols that should not have been."""
    scenario, rng = SCENARIOS[name], np.random.default_rng(seed)
    true = frozenset(TERM_LABELS[c] for c in scenario.middle if c not in SHAPES)
    rows, spurious = [], []
    for first in range(0, records, CHUNK):
        size = min(CHUNK, records - first)
        x = simulate(scenario.draw(n, size, rng, STRENGTH[which]), n, size, rng)
        axes, ranking = fit_all(recording_of(x))
        for ranked, axis in zip(ranking.results, axes, strict=True):
            chosen = detected = frozenset(ranked.chosen.terms)
            if axis is not None:
                detected = {c.term for c in axis.coefficients.values() if c.is_amplitude and c.detected}
            among = true in (frozenset(s.terms) for s in ranked.indistinguishable)
            row = [frozenset(ranked.best.terms) == true, among, chosen == true, bool(chosen - true)]
            row += [bool(detected - true), bool(true - detected), axis is not None]
            rows.append([*row, ranked.best.probability, len(ranked.indistinguishable)])
            spurious += [SYMBOLS[term] for term in detected - true]
    return np.array(rows, float), spurious


def selection_table(found: dict[str, Found]) -> str:
    rows = []
    together = np.concatenate([o for o, _ in found.values()])
    for name, (o, spurious) in [*found.items(), ("all", (together, []))]:
        which = ", ".join(f"{c} {spurious.count(c)}" for c in sorted(set(spurious)))
        shares = map(share, o[:, : len(COLUMNS)].T)
        rows.append([name, *shares, f"{o[:, COUNT].mean():.1f}", which])
    return table(["true terms", *COLUMNS, "sets not told apart", "spurious (records)"], rows)


def calibration_table(o: np.ndarray) -> str:
    rows = []
    for low, high in pairwise(PROBABILITIES):
        inside = (o[:, PROBABILITY] >= low) & ((o[:, PROBABILITY] < high) | (high == 1.0))
        if inside.any():
            mean = o[inside, PROBABILITY].mean()
            rows.append([f"{low:g} to {high:g}", inside.sum(), f"{mean:.3f}", share(o[inside, FIRST])])
    return table(["stated probability of the best set", "records", "mean", "true"], rows)

"""Which terms does `fit(recording)` choose? Ranking by evidence, from records whose terms are known.

    python benchmarks/studies/selection.py [--quick] [--cases N,N+K]
                                           [--lengths 16384:300,131072:100] [--edge] [--results PATH]

Every record has coefficients of its own, drawn from a range in which all its terms are clearly seen
(draws.py); with `--edge` from weaker ones, down to what can hardly be seen. Simulator: truth.py, independent
of the package.
"""

from __future__ import annotations

import argparse
import time
from itertools import pairwise
from pathlib import Path

import numpy as np
import paths

from benchmarks.common.draws import SCENARIOS
from benchmarks.common.machine import describe
from benchmarks.common.ours import TERM_LABELS, fit_all, recording_of
from benchmarks.common.report import publish, run_tasks, share, standard_error, table
from benchmarks.common.truth import SHAPES, simulate

CASES = ("N", "N+K", "Q+N+K", "N+B", "N+B+K", "N+Markov+K", "N+K+R", "Q+N+B+K+R")
LENGTHS = "16384:300,131072:100"
# At the edge of detection: the sets, the factors of all amplitudes but that of white noise, and how many.
EDGE_CASES = ("N+K", "N+B", "N+Markov", "Q+N+K", "N+B+K")
CLEAR, EDGE, EDGE_LENGTHS = (1.0, 1.0), (0.08, 0.6), "16384:300"
CHUNK = 25
FOUND_TARGET, SPURIOUS_TARGET = 0.95, 0.02
SYMBOLS = {label: symbol for symbol, label in TERM_LABELS.items()}
PROBABILITIES = (0.0, 0.3, 0.5, 0.7, 0.85, 0.95, 0.99, 1.0)
# Columns of an outcome: one row a record.
FIRST, AMONG, CHOSEN, EXTRA, MISSING, DETECTED, UNDETECTED, CONVERGED, PROBABILITY, COUNT = range(10)


def outcomes(
    name: str, n: int, records: int, seed: int, strength: tuple[float, float]
) -> tuple[np.ndarray, list[str]]:
    """What was ranked, chosen and detected in each record, and the symbols that should not have been."""
    scenario = SCENARIOS[name]
    rng = np.random.default_rng(seed)
    true = frozenset(TERM_LABELS[c] for c in scenario.middle if c not in SHAPES)
    rows, spurious = [], []
    for first in range(0, records, CHUNK):
        size = min(CHUNK, records - first)
        x = simulate(scenario.draw(n, size, rng, strength), n, size, rng)
        axes, ranking = fit_all(recording_of(x))
        for ranked, axis in zip(ranking.results, axes, strict=True):
            chosen = frozenset(ranked.chosen.terms)
            detected = (
                {c.term for c in axis.coefficients.values() if c.is_amplitude and c.detected}
                if axis is not None
                else chosen
            )
            rows.append(
                (
                    frozenset(ranked.best.terms) == true,
                    true in (frozenset(s.terms) for s in ranked.indistinguishable),
                    chosen == true,
                    bool(chosen - true),
                    bool(true - chosen),
                    bool(detected - true),
                    bool(true - detected),
                    axis is not None,
                    ranked.best.probability,
                    len(ranked.indistinguishable),
                )
            )
            spurious += [SYMBOLS[term] for term in detected - true]
    return np.array(rows, float), spurious


def selection_table(found: dict[str, tuple[np.ndarray, list[str]]]) -> str:
    rows = []
    everything = np.concatenate([rows for rows, _ in found.values()])
    for name, (o, spurious) in [*found.items(), ("all", (everything, []))]:
        columns = (FIRST, AMONG, CHOSEN, EXTRA, DETECTED, UNDETECTED)
        which = ", ".join(f"{c} {spurious.count(c)}" for c in sorted(set(spurious)))
        rows.append(
            [
                name,
                *(share(o[:, k]) for k in columns),
                f"{o[:, COUNT].mean():.1f}",
                f"{o[:, CONVERGED].mean():.3f}",
                which,
            ]
        )
    head = [
        "true terms",
        "ranked first",
        "first or not told apart",
        "chosen exactly",
        "a term too many chosen",
    ]
    head += ["a spurious term detected", "a true term not detected", "sets not told apart", "converged"]
    return table([*head, "spurious (records)"], rows)


def calibration_table(o: np.ndarray) -> str:
    """How often the most probable set is true, by its stated probability."""
    rows = []
    for low, high in pairwise(PROBABILITIES):
        inside = (o[:, PROBABILITY] >= low) & ((o[:, PROBABILITY] < high) | (high == 1.0))
        if inside.any():
            mean = o[inside, PROBABILITY].mean()
            rows.append([f"{low:g} to {high:g}", str(inside.sum()), f"{mean:.3f}", share(o[inside, FIRST])])
    return table(["stated probability of the best set", "records", "mean", "true"], rows)


def misses(groups: dict[int, dict[str, tuple[np.ndarray, list[str]]]], edge: bool) -> list[str]:
    """What falls short of the targets."""
    short = []
    for n, found in groups.items():
        for name, (o, spurious) in found.items():
            among, detected = o[:, AMONG].mean(), o[:, DETECTED].mean()
            if among < FOUND_TARGET and not edge:
                error = standard_error(among, len(o))
                short.append(
                    f"{name}, n = {n}: true set first or not told apart in {among:.3f} ± {error:.3f}"
                )
            if detected > SPURIOUS_TARGET:
                error = standard_error(detected, len(o))
                which = ", ".join(sorted(set(spurious)))
                short.append(f"{name}, n = {n}: spurious {which} detected in {detected:.3f} ± {error:.3f}")
    return short


INTRODUCTION = """# Choice of terms

Records of known terms, simulated independently of the package, go through `fit(recording)`, which ranks all
sets of the five basic terms and a Markov process by their evidence. Every record has coefficients of its own,
log-uniform over a factor of three (the five terms: two) around values that are clearly seen: their Cramér-Rao
bounds are at most some 20 %. Longer records have their noise stretched along. {strength}Reproduce with
`python benchmarks/studies/selection.py{option}`.

{machine}

- *ranked first*: the true set has the highest evidence. *Not told apart*: odds against the best set below 20.
- *chosen*: the set that the fit uses. *Detected*: coefficients that the fit calls so.
"""


def report(groups: dict[int, dict[str, tuple[np.ndarray, list[str]]]], seconds: float, edge: bool) -> str:
    strength = (
        f"Here all amplitudes but N are multiplied by {EDGE[0]} to {EDGE[1]}, log-uniform. " if edge else ""
    )
    option = " --edge" if edge else ""
    parts = [INTRODUCTION.format(machine=describe(), strength=strength, option=option)]
    for n, found in groups.items():
        records = len(next(iter(found.values()))[0])
        parts += [f"## {n} samples, {records} records of each set\n", selection_table(found) + "\n"]
    everything = np.concatenate([o for found in groups.values() for o, _ in found.values()])
    short = misses(groups, edge)
    parts += [
        "## Calibration of the probabilities\n",
        "All sets are equally probable to the package; here only those of the tables occur, equally often.\n",
        calibration_table(everything) + "\n",
        f"## Against the targets ({'' if edge else f'first or not told apart ≥ {FOUND_TARGET}, '}"
        f"spurious ≤ {SPURIOUS_TARGET})\n",
        "\n".join(f"- {line}" for line in short) + "\n" if short else "All met.\n",
        f"Whole run: {seconds / 60.0:.0f} min.\n",
    ]
    return "\n".join(parts)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="few short records, to see that all of it runs")
    parser.add_argument("--cases", help="true sets, e.g. N,N+K; all by default")
    parser.add_argument("--lengths", help="record lengths and counts, e.g. 16384:300")
    parser.add_argument("--edge", action="store_true", help="terms that can hardly be seen")
    parser.add_argument("--seed", type=int, default=0, help="added to the seeds")
    parser.add_argument("--workers", type=int, default=2, help="processes")
    parser.add_argument("--results", type=Path, help="file of the results")
    options = parser.parse_args()
    known = EDGE_CASES if options.edge else CASES
    names = options.cases.split(",") if options.cases else list(known)
    usual = EDGE_LENGTHS if options.edge else LENGTHS
    lengths = options.lengths or (f"16384:{CHUNK}" if options.quick else usual)
    strength = EDGE if options.edge else CLEAR
    results = options.results or paths.RESULTS / ("selection_edge.md" if options.edge else "selection.md")
    started = time.perf_counter()
    tasks = []
    for length in lengths.split(","):
        n, records = (int(part) for part in length.split(":"))
        tasks += [(name, n, records, options.seed + n + known.index(name), strength) for name in names]
    done = {}
    for (name, n, records, *_), result, seconds in run_tasks(outcomes, tasks, options.workers):
        done[n, name] = result
        print(
            f"{n} samples, {records} records, {seconds:.0f} s\n{selection_table({name: result})}", flush=True
        )
    groups = {n: {name: done[n, name] for name in names} for n in dict.fromkeys(task[1] for task in tasks)}
    text = report(groups, time.perf_counter() - started, options.edge)
    publish(text, results, options.quick)


if __name__ == "__main__":
    main()

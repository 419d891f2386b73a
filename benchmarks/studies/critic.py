"""Does the critic find what is hidden, name it rightly, and keep silent where nothing is?

    python benchmarks/studies/critic.py [--quick] [--causes sinusoid,markov] [--records 20] [--clean 300]
                                        [--sweep 20] [--pairs 60] [--duration S --rate HZ] [--workers 2]
                                        [--out DIR] [--results PATH]

Studies of `critique(recording)` on records of tests/support/hidden_effects.py, which shares no code with the
package: what hidden effects are called, alone and two at once, how small they may be, and whether p-values
are uniform on clean records. Every record is a row of JSON in --out, written as it is done: a run that was
stopped goes on where it was, and rows of several machines in one folder are reported together (`--records 0
--clean 0 --sweep 0 --pairs 0` only reports).
"""

from __future__ import annotations

import argparse
import itertools
import json
import time
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import paths
from scipy.stats import kstest

import allanjax as aj
from allanjax.critic.critique import critique
from allanjax.critic.view import FALSE_ALARMS
from benchmarks.common.hidden_effects import CAUSES, TERMS, draw
from benchmarks.common.hidden_verdict import (
    NEAR,
    NEAR_PLACE,
    PARAMETERS,
    Compared,
    compared,
    model_without,
    others,
    recording_of,
    right,
)
from benchmarks.common.machine import describe
from benchmarks.common.report import publish, run_tasks, share, table
from benchmarks.common.sweeps import APART, SWEEP, half_detected

MULTIPLES = (2.0, 5.0)
#: Two effects in one record; basic terms, which a fit must lack to hide them, are not among these.
OF_PAIRS = 3.0
PAIRED = [c for c in CAUSES if c not in TERMS]
SWEPT = ("sinusoid", "bias_step", "warm_up", "temperature", "variance_change")
QUANTILES = (0.05, 0.25, 0.5, 0.75, 0.95)
QUICK: dict[str, Any] = {"records": 1, "clean": 2, "sweep": 1, "pairs": 2, "duration": 100.0, "rate": 50.0}

Row = dict[str, Any]


class Task(NamedTuple):
    """One record. cause: "" for a clean one, of any multiple; duration and rate: None as the generator draws.

    study: "confusion", "pairs" (of causes, as "a+b"), "sensitivity", or "white", the latter in sensors with
    white noise alone.
    """

    study: str
    cause: str
    multiple: float
    seed: int
    duration: float | None
    rate: float | None


# --- One record --------------------------------------------------------------------------------------------


def examine(*task: Any) -> Row:
    """What the critic says about a record, and whether it is so."""
    t = Task(*task)
    without = "QBKMR" if t.study == "white" else ""
    size = {"duration": t.duration, "rate": t.rate}
    hidden = draw(t.seed, t.cause.split("+") if t.cause else None, t.multiple, without=without, **size)
    recording, model = recording_of(hidden), model_without(hidden)
    row: Row = t._asdict() | {"n": recording.n, "sensor": hidden.sensor, "error": ""}
    begun = time.perf_counter()
    try:
        fit = aj.fit(recording, model) if model is not None else None
        found = critique(recording, fit)
    except (aj.AllanjaxError, ArithmeticError, ValueError, np.linalg.LinAlgError) as error:
        return row | {"error": f"{type(error).__name__}: {error}"}
    row["seconds"] = time.perf_counter() - begun
    row["named"] = sorted({f.cause for f in found.findings})
    row["others"] = others(found, hidden.effects)
    row["right"], row["missed"] = None, [e.cause for e in hidden.effects if right(found, e) is None]
    row["off"] = []
    for effect in hidden.effects:
        if (finding := right(found, effect)) is not None:
            parameters = compared(finding, effect, recording.n / recording.rate)
            row["off"] += [f"{effect.cause}'s {k}" for k, p in parameters.items() if not p.within_3_sigma]
            row["right"] = {
                "evidence": finding.evidence,
                "gain": finding.gain,
                "p_value": finding.p_value,
                "rivals": {rival.cause: rival.odds for rival in finding.rivals},
                "parameters": parameters,
            }
    if not t.cause:
        row["p_values"] = {f"test of {name}": p for axis in found.results for name, p in axis.tests.items()}
        row["p_values"] |= {d.statistic: d.p_value for axis in found.results for d in axis.before}
    return row


def tasks_of(options: argparse.Namespace) -> list[Task]:
    """All records that were asked for."""
    names = options.causes.split(",") if options.causes else list(CAUSES)
    size = options.duration, options.rate
    tasks = [Task("confusion", "", 1.0, seed, *size) for seed in range(options.clean)]
    for multiple in MULTIPLES:
        tasks += [
            Task("confusion", c, multiple, seed, *size) for c in names for seed in range(options.records)
        ]
    pairs = list(itertools.combinations([c for c in PAIRED if c in names], 2))
    some = np.random.default_rng(0).permutation(len(pairs))[: options.pairs]
    tasks += [Task("pairs", "+".join(pairs[k]), OF_PAIRS, seed, *size) for seed, k in enumerate(some)]
    for study in ("sensitivity", "white"):
        for k, multiple in enumerate(SWEEP):
            seeds = range(APART * (k + 1), APART * (k + 1) + options.sweep)
            tasks += [Task(study, c, multiple, seed, *size) for c in SWEPT if c in names for seed in seeds]
    return tasks


def rows_in(folder: Path) -> dict[Task, Row]:
    """Of all files there."""
    rows = {}
    for path in sorted(folder.glob("*.jsonl")):
        for line in path.read_text(encoding="utf-8").splitlines():
            row = json.loads(line)
            rows[Task(*(row[field] for field in Task._fields))] = row
    return rows


# --- What hidden effects are called ------------------------------------------------------------------------


def parameters_of(row: Row) -> dict[str, Compared]:
    return {name: Compared(*values) for name, values in row["right"]["parameters"].items()}


def percent(hits: Iterable[bool]) -> str:
    hits = list(hits)
    return f"{100.0 * np.mean(hits):.0f}" if hits else "–"


def naming_table(rows: list[Row]) -> str:
    lines = []
    for cause in CAUSES:
        if mine := [row for row in rows if row["cause"] == cause]:
            named = [row for row in mine if row["right"]]
            lines.append(
                [
                    cause,
                    str(len(mine)),
                    percent(bool(row["right"]) for row in mine),
                    percent(all(p.within_3_sigma for p in parameters_of(row).values()) for row in named),
                    percent(all(p.is_near for p in parameters_of(row).values()) for row in named),
                    percent(row["right"]["gain"] > 0.0 for row in named),
                    percent(bool(row["others"]) for row in mine),
                ]
            )
    head = ["hidden", "records", "rightly named, %", "all parameters within 3σ, %", "all parameters near, %"]
    return table([*head, "held-out gain > 0, %", "something else claimed, %"], lines)


def matrix_table(rows: list[Row]) -> str:
    """Hidden causes by named ones: records."""
    counts: dict[str, Counter[str]] = {}
    for row in rows:
        counts.setdefault(row["cause"] or "none", Counter()).update(row["named"] or ["nothing"])
    known = [*CAUSES, "unexplained", "nothing"]
    seen = set().union(*counts.values())
    columns = [c for c in known if c in seen] + sorted(seen - set(known))
    lines = [[c, *(str(counts[c][d] or "") for d in columns)] for c in [*CAUSES, "none"] if c in counts]
    return table(["hidden \\ named", *columns], lines)


def parameter_table(rows: list[Row]) -> str:
    lines = []
    for cause, names in PARAMETERS.items():
        found = [parameters_of(row) for row in rows if row["cause"] == cause and row["right"]]
        for name in names:
            if mine := [p[name] for p in found if name in p]:
                ratio = np.median([p.error / max(p.near, p.slack) for p in mine])
                lines.append(
                    [
                        cause,
                        name,
                        str(len(mine)),
                        percent(p.within_3_sigma for p in mine),
                        percent(p.is_near for p in mine),
                        f"{ratio:.2g}",
                    ]
                )
    head = ["hidden", "parameter", "records", "within 3σ, %", "near, %", "median error / near"]
    return table(head, lines)


def alarm_text(clean: list[Row]) -> str:
    alarms = [row for row in clean if row["named"]]
    which = Counter(cause for row in alarms for cause in row["named"]).most_common()
    text = (
        f"{len(clean)} records, share with any finding: {share(np.array([bool(r['named']) for r in clean]))}"
    )
    text += f" (asked for: {FALSE_ALARMS:g})."
    if alarms:
        text += f" Found: {', '.join(f'{cause} {count}' for cause, count in which)}."
        text += f" Seeds: {', '.join(str(row['seed']) for row in alarms)}."
    return text


def pairs_text(rows: list[Row]) -> str:
    """How many of two effects in one record are named, and which are not."""
    missed, count = sum(len(row["missed"]) for row in rows), 2 * len(rows)
    besides, all_near = sum(bool(row["others"]) for row in rows), sum(not row["off"] for row in rows)
    text = (
        f"{len(rows)} records of two effects each, by chance, at {OF_PAIRS:g} times the limit: "
        f"{count - missed} of {count} effects are rightly named, in {all_near} records with all of their "
        f"parameters within 3σ; anything else is claimed in {besides}."
    )
    shown = "missed", "others", "off"
    lines = [
        [r["cause"].replace("+", ", "), *(", ".join(r[k]) for k in shown)]
        for r in rows
        if any(r[k] for k in shown)
    ]
    return text + "\n\n" + table(["hidden", "missed", "claimed besides", "not within 3σ"], lines)


# --- How small they may be ---------------------------------------------------------------------------------


def sensitivity_table(rows: list[Row]) -> str:
    lines = []
    for study, sensor in (("sensitivity", "as drawn"), ("white", "white noise only")):
        for cause in SWEPT:
            mine = [row for row in rows if row["study"] == study and row["cause"] == cause]
            if not mine:
                continue
            multiples = np.array([row["multiple"] for row in mine])
            hits = np.array([bool(row["right"]) for row in mine])
            middle = "–"
            if 0 < hits.sum() < len(hits):
                middle = "{:.2f} ± {:.2f}".format(*half_detected(multiples, hits))
            shares = [percent(hits[multiples == m]) for m in SWEEP]
            lines.append([cause, sensor, str(len(mine)), middle, *shares])
    return table(["hidden", "sensor", "records", "half detected at", *(f"{m:g}" for m in SWEEP)], lines)


# --- Whether p-values are uniform --------------------------------------------------------------------------


def p_value_table(clean: list[Row]) -> str:
    found: dict[str, list[float]] = {}
    for row in clean:
        for name, p in row["p_values"].items():
            found.setdefault(name, []).append(p)
    lines = []
    for name, values in sorted(found.items()):
        p = np.array(values)
        quantiles = [f"{q:.3f}" for q in np.quantile(p, QUANTILES)]
        below = [f"{np.mean(p < level):.3f}" for level in (0.01, 0.001)]
        lines.append([name, str(len(p)), f"{kstest(p, 'uniform').pvalue:.2g}", *quantiles, *below])
    head = ["statistic", "records", "KS p", *(f"{100 * q:g} %" for q in QUANTILES), "p < 0.01", "p < 0.001"]
    return table(head, lines)


# --- The report --------------------------------------------------------------------------------------------

INTRODUCTION = f"""# The critic

`critique(recording)` on records of an independent generator (tests/support/hidden_effects.py): gyros and
accelerometers of navigation to consumer grade, {{length}}, with quantization, flicker, random walk, Markov
noise and a ramp by chance, and a temperature in some. The critic is handed samples, rate, units and auxiliary
channels. An effect's multiple is its size over the smallest that a detector which knows the noise and the
effect's shape finds (a matched filter's SNR of 5). Basic terms are hidden by a fit that lacks them. Reproduce
with `python benchmarks/studies/critic.py`.

{{machine}}

- *Rightly named*: among the findings, of the right axes. *Something else claimed*: any other finding.
- *Near*: within {100 * NEAR:g} % of the true value; of a place in time, within {100 * NEAR_PLACE:g} % of
  the record; an exponent within 0.15, a disturbance's ends within 2 s. These two and the lag of a
  temperature count as within 3σ too where they are near.
- Outliers, disturbances, filters and what is done to samples have a size of their own, at any multiple.
"""


def report(rows: list[Row], seconds: float) -> str:
    failed = [row for row in rows if row["error"]]
    rows = [row for row in rows if not row["error"]]
    clean = [row for row in rows if not row["cause"]]
    hidden = [row for row in rows if row["study"] == "confusion" and row["cause"]]
    pairs = [row for row in rows if row["study"] == "pairs"]
    swept = [row for row in rows if row["study"] in ("sensitivity", "white")]
    size = next((f"{r['duration']:g} s at {r['rate']:g} Hz" for r in rows if r["duration"]), "")
    length = size or "10 to 60 minutes at 50 to 400 Hz"
    parts = [INTRODUCTION.format(machine=describe(), length=length)]
    for multiple in MULTIPLES:
        if mine := [row for row in hidden if row["multiple"] == multiple]:
            parts += [
                f"## What effects of {multiple:g} times the limit are called\n",
                naming_table(mine) + "\n",
                "Records by what was hidden and what was named, several if several were:\n",
                matrix_table(mine) + "\n",
                "Parameters of effects that were rightly named:\n",
                parameter_table(mine) + "\n",
            ]
    if pairs:
        parts += ["## Two effects at once\n", pairs_text(pairs) + "\n"]
    if swept:
        parts += [
            "## How small effects may be\n",
            "Multiple of the limit at which half are found and rightly named (probit regression), and the "
            f"share found at each, in %; false alarms {FALSE_ALARMS:g}.\n",
            sensitivity_table(swept) + "\n",
        ]
    if clean:
        parts += [
            "## Clean records\n",
            alarm_text(clean) + "\n",
            "P-values, uniform if all is right (those of `lattice` and `repeated_values` are of counts):\n",
            p_value_table(clean) + "\n",
        ]
    for row in failed:
        parts.append(f"- failed: {row['cause'] or 'clean'}, seed {row['seed']}: {row['error']}")
    spent = sum(row["seconds"] for row in rows)
    parts.append(f"{len(rows)} records, {spent / 60.0:.0f} min in all; this run: {seconds / 60.0:.0f} min.\n")
    return "\n".join(parts)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="few short records, to see that all of it runs")
    parser.add_argument("--causes", help="hidden causes, e.g. sinusoid,markov; all by default")
    parser.add_argument("--records", type=int, default=20, help="of each cause and multiple")
    parser.add_argument("--clean", type=int, default=300, help="records without any effect")
    parser.add_argument("--sweep", type=int, default=20, help="records of each step of a sweep")
    parser.add_argument("--pairs", type=int, default=60, help="records with two effects")
    parser.add_argument("--duration", type=float, help="of all records [s]; by default drawn, 600 to 3600")
    parser.add_argument("--rate", type=float, help="of all records [Hz]; by default drawn, 50 to 400")
    parser.add_argument("--workers", type=int, default=2, help="processes")
    parser.add_argument("--out", type=Path, default=Path("build/critic"), help="folder of the records' rows")
    parser.add_argument("--results", type=Path, default=paths.RESULTS / "critic.md")
    options = parser.parse_args()
    if options.quick:
        parser.set_defaults(**QUICK)
        options = parser.parse_args()
    started = time.perf_counter()
    options.out.mkdir(parents=True, exist_ok=True)
    rows = rows_in(options.out)
    tasks = [task for task in tasks_of(options) if task not in rows]
    with (options.out / "rows.jsonl").open("a", encoding="utf-8") as file:
        for task, row, seconds in run_tasks(examine, tasks, options.workers):
            rows[Task(*task)] = row
            print(json.dumps(row, default=float), file=file, flush=True)
            said = row["error"] or ", ".join(row["named"]) or "nothing"
            print(f"{row['cause'] or 'clean'} ×{row['multiple']:g}, {seconds:.0f} s: {said}", flush=True)
    size = options.duration, options.rate
    mine = [row for task, row in rows.items() if (task.duration, task.rate) == size]
    text = report(mine, time.perf_counter() - started)
    publish(text, options.results, options.quick)


if __name__ == "__main__":
    main()

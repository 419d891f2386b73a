"""How many hidden effects can be told from noise at all? The critic beside a judge who has less to find out.

    python benchmarks/studies/critic_bound.py [--quick] [--records 40] [--clean 150] [--sweep 20]
                                              [--multiple 2] [--causes bias_step,markov] [--workers 2]
                                              [--results PATH]

The detection limit is that of a detector which knows the noise. Nobody who is handed samples does, and noise
that wanders looks like a step, a warm-up or a random walk. What is lost by that is computed here (judge.py):
the likelihood integrated over all that is not known, with the effect and without. The judge knows what the
critic does not: the record's white noise and quantization, and which one effect may be there. The critic
looks for twenty-one causes at once. Both see the same records.
"""

from __future__ import annotations

import argparse
import functools
import time
from pathlib import Path
from typing import Any

import numpy as np
import paths
from scipy.special import logsumexp

import allanjax as aj
from allanjax.critic.critique import critique
from benchmarks.common.hidden_effects import TERMS, Hidden, draw
from benchmarks.common.hidden_sensors import power_limit
from benchmarks.common.hidden_verdict import model_without, recording_of, right
from benchmarks.common.judge import DURATION, LOWEST, RATE, SIZE_WITHIN, Judge, ground
from benchmarks.common.machine import describe
from benchmarks.common.report import publish, run_tasks, share, table
from benchmarks.common.sweeps import APART, SWEEP, half_detected

PATHS = ("bias_step", "warm_up", "telegraph")
STOCHASTIC = ("drift_ramp", "rate_random_walk", "markov")
#: Terms that a sensor may have, and their odds.
ODDS = {"B": 0.5, "K": 0.5, "M": 0.2}
RAMP_ODDS = 0.2
FALSE_ALARMS = 0.01
#: Of which the smallest that are found are looked for, with sensors as drawn and with white noise alone.
SWEPT, SENSORS = ("bias_step",), {"as drawn": "", "white noise only": "BKMR"}
SHARE = f"{100 * FALSE_ALARMS:g} %"


# --- What may be hidden ------------------------------------------------------------------------------------


@functools.cache
def searched(cause: str) -> np.ndarray:
    """Coefficients [shapes, lowest] of the shapes that an effect may have."""
    if cause == "bias_step":
        return steps(np.linspace(0.1, 0.9, 161) * DURATION)
    constants = np.geomspace(DURATION / 30.0, DURATION / 3.0, 24)
    return np.apply_along_axis(ground().coefficients, 1, np.exp(-seconds() / constants[:, None]))


def seconds() -> np.ndarray:
    return np.arange(ground().n) / RATE


def steps(times: np.ndarray) -> np.ndarray:
    """Coefficients of unit steps: of a step from sample k on, −√(2/n)·sin(a_j k)/(2 sin(a_j/2))."""
    n = ground().n
    a = np.pi * np.arange(1, LOWEST + 1) / n
    return -np.sqrt(2.0 / n) * np.sin(np.outer(np.ceil(times * RATE), a)) / (2.0 * np.sin(0.5 * a))


def true_path(hidden: Hidden) -> np.ndarray:
    """Coefficients of the first effect, but for its amplitude."""
    effect = hidden.effects[0]
    p: dict[str, Any] = effect.parameters
    match effect.cause:
        case "bias_step":
            relative = p.get("amplitude_2", 0.0) / p["amplitude"]
            return np.array([1.0, relative]) @ steps(np.array([p["time"], p.get("time_2", 0.0)]))
        case "warm_up":
            return ground().coefficients(np.exp(-seconds() / p["time_constant"]))
    switches = np.array(p["switches"])
    return (-1.0) ** np.arange(len(switches)) @ steps(switches)


def price_of_switches(judge: Judge, hidden: Hidden, noise: np.ndarray) -> float:
    """What not knowing when a telegraph switches costs, its dwell time known [nats].

    Every switch in turn, the others being where they are: of the paths, those like the true one.
    """
    p: dict[str, Any] = hidden.effects[0].parameters
    switches, ramp = np.array(p["switches"]), ground().ramp
    v = np.repeat(noise, ground().size.astype(int))
    heights = p["amplitude"] / judge.white * (-1.0) ** np.arange(len(switches))
    rest = judge.c - heights @ steps(switches)
    if judge.has_ramp:
        rest = rest - ramp * ((ramp / v) @ rest) / ((ramp / v) @ ramp)
    total, bounds = -DURATION / p["dwell_time"], np.concatenate([[0.0], switches, [DURATION]])
    for k, (height, switch) in enumerate(zip(heights, switches, strict=True)):
        places, width = np.linspace(bounds[k], bounds[k + 2], 200, retstep=True)
        other = rest - height * (steps(places) - steps(np.array([switch])))
        gained = -0.5 * (other**2 - rest**2) @ (1.0 / v)
        total += float(logsumexp(gained) + np.log(width / p["dwell_time"]))
    return total


def odds_of_path(cause: str, hidden: Hidden, multiple: float, seed: int) -> dict[str, float]:
    """Log of the Bayes factor of a known path, of its true shape and of any that it may have."""
    judge, found = Judge(hidden, multiple, seed), {}
    noise, sets = judge.noise(hidden.sensor), subsets()
    without = judge.evidence(sets, RAMP_ODDS)
    if hidden.effects:
        shapes = judge.beside(true_path(hidden)[None], noise)
        found["told"] = judge.evidence(sets, RAMP_ODDS, shapes) - without
    if cause == "telegraph":
        found["odds"] = found["told"] + price_of_switches(judge, hidden, noise)
    else:
        shapes = judge.beside(searched(cause), noise)
        found["odds"] = judge.evidence(sets, RAMP_ODDS, shapes) - without
    return found


def subsets() -> dict[str, float]:
    """The terms that a sensor may have, and the odds of each set."""
    found = {"": 1.0}
    for x, odds in ODDS.items():
        found = {letters: p * (1.0 - odds) for letters, p in found.items()} | {
            letters + x: p * odds for letters, p in found.items()
        }
    return found


def odds_of_term(cause: str, hidden: Hidden, multiple: float, seed: int) -> dict[str, float]:
    """Log of the odds of a term against none, and against each other one that the model may lack as well."""
    judge, g = Judge(hidden, multiple, seed), ground()
    lacked = TERMS[cause] if hidden.effects else ""
    letters = "".join(x for x in judge.letters if x not in lacked)
    ramp = float(judge.has_ramp and lacked != "R")
    noise = judge.noise(hidden.sensor, lacked)
    low, high = judge.multiples

    def limit(level: np.ndarray) -> float:
        return power_limit(np.repeat(level / noise, g.size.astype(int)))

    def with_term(x: str) -> float:
        levels = np.exp(g.markov) if x == "M" else g.unit[x][None]
        limits = np.log([limit(level) for level in levels])

        def added(u: np.ndarray) -> np.ndarray:
            level, own = g.unit[x if x != "M" else "K"], np.exp(limits[0])
            if x == "M":
                level, time = g.markov_level(u[:, 1])
                own = np.exp(np.interp(np.log(time), np.log(g.times), limits))
            return ((low * (high / low) ** u[:, 0]) ** 2 * own)[:, None] * level

        return judge.evidence({letters: 1.0}, ramp, extra=added, extras=g.count(x))

    weights = {x: with_term(x) for x in "BKM" if x not in letters}
    if not ramp:
        weights["R"] = judge.evidence({letters: 1.0}, ramp, judge.beside(g.ramp[None], noise))
    own = weights.pop(TERMS[cause])
    found = {"odds": own - judge.evidence({letters: 1.0}, ramp)}
    return found | {"over_rivals": own - max(weights.values(), default=-np.inf)}


# --- Records -----------------------------------------------------------------------------------------------


def examine(study: str, cause: str, multiple: float, seed: int) -> dict[str, Any]:
    """What the judge, and of a "hidden" effect the critic, say of one record; other studies: of `SENSORS`."""
    size = {"duration": DURATION, "rate": RATE}
    if study == "clean":
        hidden = draw(seed, None, without=TERMS.get(cause, ""), **size)
    else:
        hidden = draw(seed, cause, multiple, without=SENSORS.get(study, ""), **size)
    weigh = odds_of_path if cause in PATHS else odds_of_term
    row: dict[str, Any] = weigh(cause, hidden, multiple, seed)
    if study == "hidden":
        recording, model = recording_of(hidden), model_without(hidden)
        fit = aj.fit(recording, model) if model is not None else None
        found = critique(recording, fit)
        row["right"] = right(found, hidden.effects[0]) is not None
    return row


def threshold_of(clean: np.ndarray) -> float:
    """Of the odds, that so many records without the effect exceed."""
    # Of telegraphs there is no evidence without one to start from.
    return float(np.quantile(clean, 1.0 - FALSE_ALARMS)) if len(clean) else 0.0


def verdicts(cause: str, mine: list[dict[str, Any]], clean: np.ndarray) -> list[str]:
    """A line of the table."""
    threshold = threshold_of(clean)
    found = [row["odds"] > threshold and row.get("over_rivals", 1.0) > 0.0 for row in mine]
    told = share(np.array([row["told"] > threshold for row in mine])) if "told" in mine[0] else "–"
    even = [row["odds"] > 0.0 and row.get("over_rivals", 1.0) > 0.0 for row in mine]
    judged = [share(np.array(x)) for x in (even, found)] if len(clean) else [share(np.array(even)), "–"]
    critic = share(np.array([row["right"] for row in mine]))
    return [cause, str(len(mine)), critic, *judged, f"{threshold:.1f}" if len(clean) else "–", told]


def smallest(rows: dict[tuple, dict[str, Any]], thresholds: dict[str, float]) -> str:
    """Multiples that the judge finds in half of the records."""
    lines = []
    for sensor in SENSORS:
        for cause in SWEPT:
            mine = [
                (t[2], row["odds"] > thresholds[cause]) for t, row in rows.items() if t[:2] == (sensor, cause)
            ]
            if mine:
                multiples, hits = (np.array(x) for x in zip(*mine, strict=True))
                middle = "{:.2f} ± {:.2f}".format(*half_detected(multiples, hits))
                lines.append([cause, sensor, str(len(mine)), middle])
    return table(["hidden", "sensor", "records", "judge finds half at"], lines)


INTRODUCTION = f"""# What can be told from noise at all

Records of tests/support/hidden_effects.py, {DURATION:g} s at {RATE:g} Hz, with effects of
{{multiple:g}} times the limit of a detector that knows the noise.

- *Critic*: rightly named by `critique(recording)`, which looks for all causes and has findings in about one
  of a hundred clean records.
- *Judge*: the likelihood integrated over all levels that the noise may have, with the effect and without. It
  knows the white noise and the quantization, and which one effect may be there (its size within a factor of
  {SIZE_WITHIN:g}). It says so where that is more probable than not, or with {SHARE} of false alarms for this
  effect alone (the threshold: of {{clean}} records without it). A term that the model lacks must also be more
  probable than each other one that it may lack.
- *Told the shape*: the judge knows the place in time, the time constant or all switches as well.
- Of steps the judge looks for one, though a fourth of the records have a second one. Of telegraphs it weighs
  paths like the true one alone and knows the dwell time; there is no threshold.

Reproduce with `python benchmarks/studies/critic_bound.py`.

{{machine}}

"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="few records, to see that all of it runs")
    parser.add_argument("--records", type=int, default=40, help="of each cause")
    parser.add_argument("--clean", type=int, default=150, help="without the effect, which set the threshold")
    parser.add_argument("--sweep", type=int, default=20, help="records of each multiple that is swept")
    parser.add_argument("--causes", default=",".join((*PATHS, *STOCHASTIC)))
    parser.add_argument("--multiple", type=float, default=2.0, help="of the limit")
    parser.add_argument("--workers", type=int, default=2, help="processes")
    parser.add_argument("--results", type=Path, default=paths.RESULTS / "critic_bound.md")
    options = parser.parse_args()
    if options.quick:
        options.records, options.clean, options.sweep = 4, 6, 2
    causes, begun = options.causes.split(","), time.perf_counter()
    tasks: list[tuple] = [
        (study, cause, options.multiple, seed)
        for cause in causes
        for study, count in (("hidden", options.records), ("clean", options.clean))
        for seed in range(count)
        if study == "hidden" or cause != "telegraph"
    ]
    tasks += [
        (sensor, cause, multiple, APART * (k + 1) + seed)
        for sensor in SENSORS
        for cause in SWEPT
        if cause in causes
        for k, multiple in enumerate(SWEEP)
        for seed in range(options.sweep)
    ]
    rows: dict[tuple, dict[str, Any]] = {}
    for task, row, spent in run_tasks(examine, tasks, options.workers):
        rows[task] = row
        print(*task, row, f"{spent:.1f} s", flush=True)
    of = {
        (study, c): [r for t, r in rows.items() if t[:2] == (study, c)]
        for c in causes
        for study in ("hidden", "clean")
    }
    odds = {c: np.array([row["odds"] for row in of["clean", c]]) for c in causes}
    lines = [verdicts(c, of["hidden", c], odds[c]) for c in causes]
    thresholds = {c: threshold_of(odds[c]) for c in causes}
    head = [
        "hidden",
        "records",
        "critic",
        "judge, even odds",
        f"judge, {SHARE} false alarms",
        "threshold, nats",
    ]
    text = INTRODUCTION.format(machine=describe(), multiple=options.multiple, clean=options.clean)
    text += table([*head, "judge, told the shape"], lines)
    text += "\n\nHow small effects may be that the judge still finds, at the same thresholds (the critic: "
    text += "[critic.md](critic.md), where it does not know what it looks for):\n\n"
    text += smallest(rows, thresholds)
    text += f"\n\nThis run: {(time.perf_counter() - begun) / 60.0:.0f} min.\n"
    publish(text, options.results, options.quick)


if __name__ == "__main__":
    main()

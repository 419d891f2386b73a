"""Does the critic find and name what is hidden, how small may it be, and is it silent where nothing is?

`critique(recording)` on records of an independent generator (benchmarks/common/hidden_effects.py): gyros and
accelerometers of navigation to consumer grade, 10 to 60 minutes at 50 to 400 Hz, with quantization, flicker,
random walk, Markov noise and a ramp by chance, and a temperature in some. The critic is handed samples, rate,
units and auxiliary channels. An effect's multiple is its size over the smallest that a detector which knows
the noise and the effect's shape finds (a matched filter's SNR of 5). Basic terms are hidden by a fit that
lacks them. Outliers, disturbances, filters and what is done to samples have a size of their own.

*Rightly named*: among the findings, of the right axes. *Something else claimed*: any other finding. *Near*:
within 20 % of the true value; of a place in time within 2 % of the record, an exponent within 0.15, a
disturbance's ends within 2 s.
"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Iterator
from typing import Any

import numpy as np
from scipy.optimize import minimize
from scipy.stats import kstest, norm

import allanjax as aj
from benchmarks.common.hidden_effects import CAUSES, TERMS, draw
from benchmarks.common.hidden_verdict import PARAMETERS, compared, model_without, others, recording_of, right
from benchmarks.common.study import percent, run_tasks, share, table

QUICK: dict[str, Any] = {"records": 1, "clean": 1, "pairs": 0, "sweep": 0, "duration": 160.0, "rate": 50.0}
QUICK |= {"causes": ("sinusoid", "bias_step"), "multiples": (5.0,)}
#: Two effects in one record; basic terms, which a fit must lack to hide them, are not among these.
OF_PAIRS = 3.0
SWEPT = ("sinusoid", "bias_step", "warm_up", "temperature", "variance_change")
SWEEP = (0.6, 0.8, 1.0, 1.25, 1.5, 1.9, 2.4)
APART = 10_000

Row = dict[str, Any]


def run(
    *,
    records: int = 20,
    clean: int = 300,
    pairs: int = 60,
    sweep: int = 20,
    causes: tuple[str, ...] = CAUSES,
    multiples: tuple[float, ...] = (2.0, 5.0),
    duration: float = 0.0,
    rate: float = 0.0,
    seed: int = 0,
) -> Iterator[str]:
    size = duration, rate
    tasks = [("clean", "", 1.0, seed + k, *size) for k in range(clean)]
    tasks += [("hidden", c, m, seed + k, *size) for m in multiples for c in causes for k in range(records)]
    two = list(itertools.combinations([c for c in causes if c not in TERMS], 2))
    some = np.random.default_rng(0).permutation(len(two))[:pairs]
    tasks += [("pairs", "+".join(two[k]), OF_PAIRS, seed + i, *size) for i, k in enumerate(some)]
    tasks += [
        (study, c, m, seed + APART * (k + 1) + s, *size)
        for study in ("sensitivity", "white")
        for k, m in enumerate(SWEEP)
        for c in SWEPT
        if c in causes
        for s in range(sweep)
    ]
    found = run_tasks(examine, tasks)
    failed, rows = [r for r in found if r["error"]], [r for r in found if not r["error"]]
    for multiple in multiples:
        mine = [r for r in rows if r["study"] == "hidden" and r["multiple"] == multiple]
        yield f"## What effects of {multiple:g} times the limit are called\n\n{naming_table(mine, causes)}"
        yield f"Records by what was hidden and what was named, several if so:\n\n{matrix_table(mine)}"
        yield "Parameters of effects that were rightly named:\n\n" + parameter_table(mine)
    if mine := [r for r in rows if r["study"] == "pairs"]:
        yield "## Two effects at once\n\n" + pairs_text(mine)
    if mine := [r for r in rows if r["study"] in ("sensitivity", "white")]:
        yield (
            "## How small effects may be\n\nMultiple of the limit at which half are rightly named (probit "
            "regression), and the share at each, in %, in sensors as drawn and with white noise alone."
        )
        yield sensitivity_table(mine)
    if mine := [r for r in rows if not r["cause"]]:
        alarms = [r for r in mine if r["named"]]
        which = Counter(cause for r in alarms for cause in r["named"])
        told = f" ({dict(which)}; seeds {[r['seed'] for r in alarms]})" if alarms else ""
        any_finding = share([bool(r["named"]) for r in mine])
        yield f"## Clean records, seeds from {seed} on\n\nAny finding in {any_finding} of {len(mine)}{told}."
        yield "P-values, uniform if all is right (`lattice` and `repeated_values` are of counts):"
        yield p_table(mine)
    yield "\n".join(f"- failed: {r['cause'] or 'clean'}, seed {r['seed']}: {r['error']}" for r in failed)


def examine(study: str, cause: str, multiple: float, seed: int, duration: float, rate: float) -> Row:
    """What the critic says about a record, and whether it is so."""
    size = {"duration": duration or None, "rate": rate or None}
    without = "QBKMR" if study == "white" else ""
    hidden = draw(seed, cause.split("+") if cause else None, multiple, without=without, **size)
    recording, model = recording_of(hidden), model_without(hidden)
    row: Row = {"study": study, "cause": cause, "multiple": multiple, "seed": seed, "error": ""}
    try:
        found = aj.critique(recording, *([aj.fit(recording, model)] if model is not None else []))
    except (aj.AllanjaxError, ArithmeticError, ValueError, np.linalg.LinAlgError) as error:
        return row | {"error": f"{type(error).__name__}: {error}"}
    row["named"] = sorted({f.cause for f in found.findings})
    row["others"], row["off"], row["parameters"], row["gain"] = others(found, hidden.effects), [], None, None
    row["missed"] = [e.cause for e in hidden.effects if right(found, e) is None]
    for effect in hidden.effects:
        if (finding := right(found, effect)) is not None:
            parameters = compared(finding, effect, recording.n / recording.rate)
            row["off"] += [f"{effect.cause}'s {k}" for k, p in parameters.items() if not p.within_3_sigma]
            row["parameters"], row["gain"] = parameters, finding.gain
    if not cause:
        row["p_values"] = {f"test of {name}": p for axis in found.results for name, p in axis.tests.items()}
        row["p_values"] |= {d.statistic: d.p_value for axis in found.results for d in axis.before}
    return row


def naming_table(rows: list[Row], causes: tuple[str, ...]) -> str:
    lines = []
    for cause in causes:
        mine = [r for r in rows if r["cause"] == cause]
        named = [r for r in mine if not r["missed"]]
        each = [list(r["parameters"].values()) for r in named]
        sigma = percent(all(p.within_3_sigma for p in of) for of in each)
        near = percent(all(p.is_near for p in of) for of in each)
        gain = percent(r["gain"] > 0.0 for r in named if r["gain"] is not None)
        claimed = percent(bool(r["others"]) for r in mine)
        lines.append([cause, len(mine), percent(not r["missed"] for r in mine), sigma, near, gain, claimed])
    head = ["hidden", "records", "rightly named, %", "all parameters within 3σ, %", "all near, %"]
    return table([*head, "held-out gain > 0, %", "something else claimed, %"], lines)


def matrix_table(rows: list[Row]) -> str:
    counts: dict[str, Counter[str]] = {}
    for r in rows:
        counts.setdefault(r["cause"], Counter()).update(r["named"] or ["nothing"])
    order = [*CAUSES, "unexplained", "nothing"]
    columns = sorted({name for named in counts.values() for name in named}, key=order.index)
    lines = [[c, *(n[d] or "" for d in columns)] for c, n in counts.items()]
    return table(["hidden \\ named", *columns], lines)


def parameter_table(rows: list[Row]) -> str:
    lines = []
    for cause, names in PARAMETERS.items():
        found = [r["parameters"] for r in rows if r["cause"] == cause and not r["missed"]]
        for name in names:
            if mine := [p[name] for p in found if name in p]:
                ratio = np.median([p.error / max(p.near, p.slack) for p in mine])
                shares = percent(p.within_3_sigma for p in mine), percent(p.is_near for p in mine)
                lines.append([cause, name, len(mine), *shares, f"{ratio:.2g}"])
    return table(["hidden", "parameter", "records", "within 3σ, %", "near, %", "median error / near"], lines)


def pairs_text(rows: list[Row]) -> str:
    missed, count = sum(len(r["missed"]) for r in rows), 2 * len(rows)
    shown = "missed", "others", "off"
    lines = [
        [r["cause"].replace("+", ", "), *(", ".join(r[k]) for k in shown)]
        for r in rows
        if any(r[k] for k in shown)
    ]
    return (
        f"{len(rows)} records of two effects each, by chance, at {OF_PAIRS:g} times the limit: "
        f"{count - missed} of {count} effects are rightly named, in "
        f"{sum(not r['off'] for r in rows)} records with all of their parameters within 3σ; "
        f"anything else is claimed in {sum(bool(r['others']) for r in rows)}.\n\n"
    ) + table(["hidden", "missed", "claimed besides", "not within 3σ"], lines)


def sensitivity_table(rows: list[Row]) -> str:
    lines = []
    for study, cause in dict.fromkeys((r["study"], r["cause"]) for r in rows):
        mine = [r for r in rows if (r["study"], r["cause"]) == (study, cause)]
        multiples = np.array([r["multiple"] for r in mine])
        hits = np.array([not r["missed"] for r in mine])
        middle = half_detected(multiples, hits) if 0 < hits.sum() < len(hits) else "–"
        sensor = "as drawn" if study == "sensitivity" else "white noise only"
        lines.append([cause, sensor, len(mine), middle, *(percent(hits[multiples == m]) for m in SWEEP)])
    return table(["hidden", "sensor", "records", "half named at", *(f"{m:g}" for m in SWEEP)], lines)


def half_detected(multiples: np.ndarray, hits: np.ndarray) -> str:
    """The multiple of which half are found, and its standard error: probit regression on its logarithm."""
    x = np.log(multiples)

    def probability(theta: np.ndarray) -> np.ndarray:
        return np.clip(norm.cdf((x - theta[0]) / np.exp(theta[1])), 1e-9, 1.0 - 1e-9)

    def loss(theta: np.ndarray) -> float:
        p = probability(theta)
        return -float(np.sum(np.where(hits, np.log(p), np.log1p(-p))))

    # A detector whose threshold is sharper than this would need finer steps to be seen.
    bounds = [(x.min(), x.max()), (np.log(0.03), np.log(3.0))]
    best = minimize(loss, [x.mean(), np.log(0.2)], bounds=bounds, method="L-BFGS-B").x
    p, z = probability(best), (x - best[0]) / np.exp(best[1])
    gradient = norm.pdf(z) * np.stack([np.ones_like(z), z]) / np.exp(best[1])
    covariance = np.linalg.pinv((gradient / (p * (1.0 - p))) @ gradient.T)
    return f"{np.exp(best[0]):.2f} ± {np.exp(best[0]) * np.sqrt(covariance[0, 0]):.2f}"


def p_table(clean: list[Row]) -> str:
    found: dict[str, list[float]] = {}
    for r in clean:
        for name, p in r["p_values"].items():
            found.setdefault(name, []).append(p)
    lines = []
    for name, values in sorted(found.items()):
        p = np.array(values)
        quantiles = [f"{q:.3f}" for q in np.quantile(p, (0.05, 0.5, 0.95))]
        below = [f"{np.mean(p < level):.3f}" for level in (0.01, 0.001)]
        lines.append([name, len(p), f"{kstest(p, 'uniform').pvalue:.2g}", *quantiles, *below])
    return table(["statistic", "records", "KS p", "5 %", "50 %", "95 %", "p < 0.01", "p < 0.001"], lines)

"""How near is each coefficient to the Cramér-Rao bound, and do intervals hold the truth as often as they say?

Records are simulated by NumPy alone, and have coefficients of their own: log-uniform over a factor of three
around values that are clearly seen, frequencies of lines uniform from 5 to 40 Hz; longer records have their
noise stretched along. Fits know the terms. The posterior is that of `sample` with the prior that the truth
was drawn from, so that the rank of the truth among its draws is uniform if all is right (Talts et al. 2018,
arXiv:1804.06788). Errors are in units of the bound of the whole record (exact Gaussian likelihood, bias
unknown), at the truth of each record.

The peers have records of one truth. **allan-variance**: `compute_avar` and `estimate_parameters` as they come
(its users fit flicker in the place of Markov noise). **log-log**: unweighted least squares of ln σ(T), four
cluster times an octave, started at the true values.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from scipy.optimize import least_squares
from scipy.stats import chi2

import allanjax as aj
from benchmarks.common.ours import FIELDS, LABELS, columns_of, fit_all, model_of, recording_of
from benchmarks.common.study import rms, run_tasks, table
from benchmarks.common.truth import SCENARIOS, SHOWN, T0, Case, allan_shape, bound, one, simulate

# Names of the terms in allan-variance; its users have flicker for everything between white noise and walk.
EFFECTS = {"Q": "quantization", "N": "white", "B": "flicker", "q": "flicker", "K": "walk"}


def by_allan_variance(case: Case, x: np.ndarray) -> np.ndarray:
    """allan-variance: its `compute_avar` and `estimate_parameters` as they come."""
    from allan_variance import compute_avar, estimate_parameters

    tau, variance = compute_avar(x, T0)
    effects = [EFFECTS[c] for c in case.amplitudes]
    table, _ = estimate_parameters(tau, variance, effects)
    missing = np.full(x.shape[1], np.nan)
    columns = [missing if c in "qT" else table[EFFECTS[c]].to_numpy() for c in case.truth]
    return np.stack(columns, axis=1)


def by_log_log(case: Case, x: np.ndarray, longest: float = 0.5) -> np.ndarray:
    """Unweighted least squares of ln σ(T), four cluster times an octave, started at the truth."""
    n = len(x)
    sizes = np.unique(np.rint(2.0 ** (np.arange(4 * int(np.log2(n)) - 3) / 4.0)).astype(int))
    sizes = sizes[sizes <= longest * n]
    phase = np.concatenate([np.zeros((1, x.shape[1])), np.cumsum(x, axis=0)]) * T0
    T = sizes * T0
    variances = [np.mean((phase[2 * m :] - 2 * phase[m:-m] + phase[: -2 * m]) ** 2, axis=0) for m in sizes]
    target = 0.5 * np.log(np.array(variances) / (2.0 * T[:, None] ** 2))
    start = np.log(list(case.truth.values()))

    def curve(p: np.ndarray) -> np.ndarray:
        value = dict(zip(case.truth, np.exp(p), strict=True))
        total = [value[c] ** 2 * allan_shape(c, T, value.get("T", 1.0)) for c in case.amplitudes]
        return 0.5 * np.log(sum(total))

    bounds = (start - 9.0, start + 9.0)
    found = [least_squares(lambda p, y=y: curve(p) - y, start, bounds=bounds).x for y in target.T]
    return np.exp(found)


PEERS: dict[str, Callable[[Case, np.ndarray], np.ndarray]] = {
    "allan-variance": by_allan_variance,
    "log-log": by_log_log,
    "log-log, to n/10": lambda case, x: by_log_log(case, x, 0.1),
}


PACKAGES = ("allan-variance",)
QUICK: dict[str, Any] = {"records": 4, "samples": (1024,), "cases": ("N+K",), "peers": ("log-log",)}
QUICK |= {"ways": ("allan", "whittle", "exact")}
#: Ways to the coefficients: options of `fit`. The exact likelihood is for short records.
WAYS: dict[str, dict[str, str]] = {
    "allan": {"objective": "allan"},
    "whittle": {"objective": "whittle"},
    "exact": {"objective": "exact"},
    "haar": {"objective": "wavelet", "wavelet": "haar"},
    "db2": {"objective": "wavelet", "wavelet": "db2"},
    "sym4": {"objective": "wavelet", "wavelet": "sym4"},
}
POSTERIOR, SHORT = "posterior", 2048
CHUNK, BLOCK = 25, 100
#: Draws of a posterior among which the truth is ranked, and bins of the ranks.
DRAWS, BINS = 199, 20
TARGET_68, TARGET_95, TARGET_RMSE = (0.63, 0.73), (0.92, 0.98), 1.10
OF_PEERS = (
    Case("N+K", {"N": 1.0, "K": 2.0}),
    Case("Q+N+K", {"Q": 0.1, "N": 1.0, "K": 2.0}),
    Case("N+B", {"N": 1.0, "B": 2.0}),
    Case("N+B+K", {"N": 1.0, "B": 3.0, "K": 5.0}),
    Case("N+Markov+K", {"N": 1.0, "q": 40.0, "T": 0.1, "K": 6.0}),
)

Outcome = dict[str, np.ndarray]


def run(
    *,
    records: int = 300,
    samples: tuple[int, ...] = (1500, 16384),
    cases: tuple[str, ...] = ("N+K", "Q+N+K", "N+B+K", "N+Markov+K", "N+sinusoid"),
    ways: tuple[str, ...] = ("allan", "whittle", "exact", "haar", "sym4", POSTERIOR),
    peers: tuple[str, ...] = tuple(PEERS),
    seed: int = 0,
) -> Iterator[str]:
    short: list[str] = []
    for n in samples:
        mine = tuple(way for way in ways if way in ("allan", "whittle") or (way == "exact") == (n <= SHORT))
        blocks = [(first, min(BLOCK, records - first)) for first in range(0, records, BLOCK)]
        tasks = [
            (c, n, count, (seed, n, k, first), mine) for k, c in enumerate(cases) for first, count in blocks
        ]
        done = run_tasks(outcomes, tasks)
        found = {c: merged([o for o, t in zip(done, tasks, strict=True) if t[0] == c]) for c in cases}
        yield f"## {n:,} samples ({n * T0:.0f} s), {records} records of each model"
        yield (
            "Shares of the 68 and of the 95 % intervals with the truth (standard errors "
            f"{np.sqrt(0.2176 / records):.3f} and {np.sqrt(0.0475 / records):.3f}) · bias and RMSE over the "
            f"bound (that of an RMSE of 1: {1.0 / np.sqrt(2.0 * records):.3f}); the median bound of each "
            "coefficient in per cent. p: χ² of the histogram of the truth's ranks among the draws."
        )
        yield own_table(found, mine)
        missed = [miss for c, o in found.items() for way in mine for miss in misses(c, o, way)]
        short += [f"- {n} samples, {miss}" for miss in missed]
    yield (
        f"## Against the targets\n\nCoverage {TARGET_68[0]} to {TARGET_68[1]} and {TARGET_95[0]} to "
        f"{TARGET_95[1]}, RMSE at most {TARGET_RMSE} bounds:\n\n" + ("\n".join(short) or "All met.")
    )
    if peers:
        n, count = max(samples), min(records, 100)
        tasks = [(case, n, count, seed + k, peers) for k, case in enumerate(OF_PEERS) if case.name in cases]
        rows = [row for rows in run_tasks(beside_peers, tasks) for row in rows]
        yield f"## Beside others, {count} records of {n:,} samples\n\nBias, RMSE; both over the bound."
        yield table(["true model", "coefficient", "allanjax", *peers], rows)
    worst = max(float(np.max(np.abs(bound(c, 1024) / bound(c, 1024, block=1024) - 1.0))) for c in OF_PEERS)
    yield f"The bound is by cosines; at 1,024 samples it is within {100 * worst:.2f} % of the exact one."


def outcomes(name: str, n: int, records: int, seed: tuple[int, ...], ways: tuple[str, ...]) -> Outcome:
    """Truth, bound, and what each way says [records, params, fields]; the ranks [records, params]."""
    scenario, rng = SCENARIOS[name], np.random.default_rng(seed)
    parts: list[Outcome] = []
    for first in range(0, records, CHUNK):
        size = min(CHUNK, records - first)
        case = scenario.draw(n, size, rng)
        recording = recording_of(simulate(case, n, size, rng))
        found = {
            "truth": np.stack(list(case.truth.values()), axis=1),
            "bound": np.stack([bound(one(case, k), n, block=0) for k in range(size)]),
        }
        for way in ways:
            if way != POSTERIOR:
                axes, _ = fit_all(recording, model_of(scenario.middle), **WAYS[way])
                found[way] = np.stack(list(columns_of(axes, case).values()), axis=2)
        if POSTERIOR in ways:
            fit = aj.fit(recording, model_of(scenario.middle), "whittle", as_is=True, vibrating=True)
            found |= sampled(fit, name, n, found["truth"], rng.integers(2**31, size=size))
        parts.append(found)
    return merged(parts)


def merged(parts: list[Outcome]) -> Outcome:
    return {key: np.concatenate([part[key] for part in parts]) for key in parts[0]}


def sampled(fit: aj.Fit, name: str, n: int, truth: np.ndarray, seeds: np.ndarray) -> Outcome:
    """Marginals and ranks with the prior that the truth was drawn from."""
    ranges = SCENARIOS[name].ranges(n)
    priors = {LABELS[c]: (aj.Uniform if c == "f" else aj.LogUniform)(*ends) for c, ends in ranges.items()}
    marginals, ranks = np.full((*truth.shape, len(FIELDS)), np.nan), np.full(truth.shape, np.nan)
    for k, axis in enumerate(fit.results):
        if not axis.converged:
            continue
        own, options = axis.axis.name, {"min_length": 30.0, "max_change": 0.1, "max_r_hat": 1.02}
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            posterior = aj.sample(fit, own, priors=priors, seed=int(seeds[k]), progress=False, **options)[own]
        marginals[k] = np.stack(list(columns_of([posterior], SCENARIOS[name].as_case()).values()), axis=2)[0]
        pick = np.random.default_rng(seeds[k]).permutation(len(posterior.draws))[:DRAWS]
        order = [posterior.labels.index(LABELS[c]) for c in ranges]
        if len(pick) == DRAWS:
            ranks[k] = np.sum(posterior.draws[pick][:, order] < truth[k], axis=0)
    return {POSTERIOR: marginals, "ranks": ranks}


def judged(o: Outcome, way: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of the records with a result: whether 68 and 95 % intervals hold the truth, errors over the bound."""
    good = np.isfinite(o[way][:, 0, 0])
    of = dict(zip(FIELDS, np.moveaxis(o[way][good], 2, 0), strict=True))
    truth = o["truth"][good]
    inside = [(of[f"lower{x}"] <= truth) & (truth <= of[f"upper{x}"]) for x in ("_68", "")]
    return inside[0], inside[1], (of["value"] - truth) / o["bound"][good]


def own_table(found: dict[str, Outcome], ways: tuple[str, ...]) -> str:
    rows = []
    for name, o in found.items():
        for k, c in enumerate(SCENARIOS[name].middle):
            relative = 100.0 * np.median(o["bound"][:, k] / o["truth"][:, k])
            row = [name if k == 0 else "", SHOWN.get(c, c), f"{relative:.2g} %"]
            for way in ways:
                narrow, wide, z = (x[:, k] for x in judged(o, way))
                lost = f" ({len(o[way]) - len(z)} without)" if len(z) < len(o[way]) else ""
                row.append(f"{narrow.mean():.3f} {wide.mean():.3f} · {z.mean():+.2f} {rms(z):.2f}{lost}")
            if "ranks" in o:
                ranks = o["ranks"][np.isfinite(o["ranks"][:, k]), k]
                counts = np.bincount((ranks * BINS // (DRAWS + 1)).astype(int), minlength=BINS)
                expected = max(counts.sum(), 1) / BINS
                row.append(f"{chi2.sf(np.sum((counts - expected) ** 2) / expected, BINS - 1):.3f}")
            rows.append(row)
    ranked = ["p of ranks"] * any("ranks" in o for o in found.values())
    return table(["true model", "coefficient", "bound", *ways, *ranked], rows)


def misses(name: str, o: Outcome, way: str) -> list[str]:
    """What falls short of the targets."""
    narrow, wide, z = judged(o, way)
    found = []
    for k, c in enumerate(SCENARIOS[name].middle):
        where = f"{name}, {SHOWN.get(c, c)}, {way}:"
        for level, hits, (low, high) in ((68, narrow, TARGET_68), (95, wide, TARGET_95)):
            if not low <= hits[:, k].mean() <= high:
                found.append(f"{where} {level} % intervals hold {hits[:, k].mean():.3f}")
        if rms(z[:, k]) > TARGET_RMSE:
            found.append(f"{where} RMSE of {rms(z[:, k]):.2f} bounds")
    return found


def beside_peers(case: Case, n: int, records: int, seed: int, peers: tuple[str, ...]) -> list[list[str]]:
    """Rows of one model: bias and RMSE of allanjax and of others on the same records."""
    x = simulate(case, n, records, np.random.default_rng([seed, n]))
    truth, scale = np.array(list(case.truth.values())), bound(case, n)
    estimates = [columns_of(fit_all(recording_of(x), model_of(case.truth))[0], case)["value"]]
    estimates += [PEERS[name](case, x) for name in peers]
    rows = []
    for k, c in enumerate(case.truth):
        errors = [(e[np.isfinite(e[:, k]), k] - truth[k]) / scale[k] for e in estimates]
        cells = [f"{z.mean():+.2f}, {rms(z):.2f}" if len(z) else "–" for z in errors]
        rows.append([case.name if k == 0 else "", f"{SHOWN.get(c, c)} = {truth[k]:g}", *cells])
    return rows

"""Do the intervals cover, and do the estimates reach the Cramér-Rao bound? Calibration by simulation.

    python benchmarks/studies/coverage.py [--quick] [--no-posterior] [--cases N+K,Q+N+K] [--records 300]
                                          [--lengths 16384,262144] [--workers 2] [--results PATH]

Every record has coefficients of its own, drawn from the prior that the sampler is given (draws.py). So the
rank of the truth among draws of its posterior is uniform if all is right (Talts et al. 2018,
arXiv:1804.06788). Simulator and bound (truth.py) are independent of the package.
"""

from __future__ import annotations

import argparse
import time
import warnings
from pathlib import Path

import numpy as np
import paths
from scipy.stats import chi2

import allanjax as aj
from benchmarks.common.draws import SCENARIOS, one
from benchmarks.common.machine import describe
from benchmarks.common.ours import FIELDS, LABELS, columns_of, fit_all, model_of, recording_of
from benchmarks.common.report import publish, run_tasks, standard_error, table
from benchmarks.common.truth import RATE, SHOWN, T0, bound, simulate

CASES = ("N+K", "Q+N+K", "N+B+K", "N+Markov+K", "N+sinusoid")
CHUNK = 25
BLOCK = 100
# Draws of a posterior among which the truth is ranked, and bins of the ranks, 0 ... DRAWS.
DRAWS, BINS = 199, 20
# Chains of so many autocorrelation times have some 400 independent draws.
LENGTH_IN_TAU = 30.0
METHODS = {"Allan": "GLS", "Whittle": "Whittle", "posterior": "posterior"}
TARGET_68, TARGET_95 = (0.63, 0.73), (0.92, 0.98)
EFFICIENCY_TARGET = {"Allan": 1.10, "Whittle": 1.05}
LEAST_P = 0.01

Outcome = dict[str, np.ndarray]


# --- One block of records ----------------------------------------------------------------------------------


def outcomes(name: str, n: int, records: int, seed: tuple[int, ...], posterior: bool) -> Outcome:
    """Truth, bound, and what each method says [records, params, fields]; the ranks [records, params]."""
    scenario, rng = SCENARIOS[name], np.random.default_rng(seed)
    model = model_of(scenario.middle)
    parts: dict[str, list[np.ndarray]] = {}
    for first in range(0, records, CHUNK):
        size = min(CHUNK, records - first)
        case = scenario.draw(n, size, rng)
        recording = recording_of(simulate(case, n, size, rng))
        axes, _ = fit_all(recording, model, "allan")
        whittle = aj.fit(recording, model, "whittle", as_is=True, vibrating=True)
        found = {
            "truth": np.stack(list(case.truth.values()), axis=1),
            "bound": np.stack([bound(one(case, k), n, block=0) for k in range(size)]),
            "Allan": stacked(columns_of(axes, case)),
            "Whittle": stacked(
                columns_of([axis if axis.converged else None for axis in whittle.results], case)
            ),
        }
        if posterior:
            seeds = rng.integers(2**31, size=size)
            found |= sampled(whittle, name, n, found["truth"], seeds)
        for key, value in found.items():
            parts.setdefault(key, []).append(value)
    return {key: np.concatenate(part) for key, part in parts.items()}


def stacked(columns: dict[str, np.ndarray]) -> np.ndarray:
    return np.stack(list(columns.values()), axis=2)


def sampled(fit: aj.Fit, name: str, n: int, truth: np.ndarray, seeds: np.ndarray) -> Outcome:
    """Posteriors with the priors that the truth was drawn from: marginals, ranks, settled chains, seconds."""
    from allanjax.posterior.priors import LogUniform, Uniform
    from allanjax.posterior.sample import sample

    ranges = SCENARIOS[name].ranges(n)
    priors = {LABELS[c]: (Uniform if c == "f" else LogUniform)(*ends) for c, ends in ranges.items()}
    marginals = np.full((*truth.shape, len(FIELDS)), np.nan)
    ranks = np.full(truth.shape, np.nan)
    settled, seconds = np.zeros(len(truth)), np.zeros(len(truth))
    for k, axis in enumerate(fit.results):
        if not axis.converged:
            continue
        begun = time.perf_counter()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            posterior = sample(
                fit,
                axis.axis.name,
                priors=priors,
                seed=int(seeds[k]),
                min_length=LENGTH_IN_TAU,
                max_change=0.1,
                max_r_hat=1.02,
                progress=False,
            )[axis.axis.name]
        seconds[k], settled[k] = time.perf_counter() - begun, posterior.converged
        marginals[k] = stacked(columns_of([posterior], SCENARIOS[name].as_case()))[0]
        pick = np.random.default_rng(seeds[k]).permutation(len(posterior.draws))[:DRAWS]
        order = [posterior.labels.index(LABELS[c]) for c in ranges]
        ranks[k] = (
            np.sum(posterior.draws[pick][:, order] < truth[k], axis=0) if len(pick) == DRAWS else np.nan
        )
    return {"posterior": marginals, "ranks": ranks, "settled": settled, "seconds": seconds}


# --- The report --------------------------------------------------------------------------------------------


def covered(o: Outcome, method: str) -> tuple[np.ndarray, np.ndarray]:
    """Whether the 68 and the 95 % intervals hold the truth [records with a result, params]."""
    good = np.isfinite(o[method][:, 0, 0])
    fields = dict(zip(FIELDS, np.moveaxis(o[method][good], 2, 0), strict=True))
    truth = o["truth"][good]
    return (
        (fields["lower_68"] <= truth) & (truth <= fields["upper_68"]),
        (fields["lower"] <= truth) & (truth <= fields["upper"]),
    )


def pulls(o: Outcome, method: str) -> np.ndarray:
    """Errors in Cramér-Rao standard deviations at the record's truth [records with a result, params]."""
    z = (o[method][:, :, 0] - o["truth"]) / o["bound"]
    return z[np.isfinite(z[:, 0])]


def rank_p(ranks: np.ndarray) -> float:
    """p of χ² of the histogram of ranks."""
    counts = np.bincount((ranks[np.isfinite(ranks)] * BINS // (DRAWS + 1)).astype(int), minlength=BINS)
    expected = counts.sum() / BINS
    return float(chi2.sf(np.sum((counts - expected) ** 2) / expected, BINS - 1))


def methods_of(o: Outcome) -> list[str]:
    return [method for method in METHODS if method in o]


def coverage_table(found: dict[str, Outcome]) -> str:
    rows = []
    for name, o in found.items():
        columns = [(covered(o, method), len(pulls(o, method))) for method in methods_of(o)]
        for k, c in enumerate(SCENARIOS[name].middle):
            relative = 100.0 * o["bound"][:, k] / o["truth"][:, k]
            row = [name if k == 0 else "", SHOWN.get(c, c), f"{np.median(relative):.2g} %"]
            for hits, count in columns:
                for hit in hits:
                    rate = float(hit[:, k].mean())
                    row.append(f"{rate:.3f} ± {standard_error(rate, count):.3f}")
            rows.append(row)
    first = next(iter(found.values()))
    head = [f"{METHODS[method]} {level} %" for method in methods_of(first) for level in (68, 95)]
    return table(["true model", "coefficient", "median bound", *head], rows)


def efficiency_table(found: dict[str, Outcome]) -> str:
    rows = []
    for name, o in found.items():
        for k, c in enumerate(SCENARIOS[name].middle):
            row = [name if k == 0 else "", SHOWN.get(c, c)]
            for method in methods_of(o):
                z = pulls(o, method)[:, k]
                row.append(f"{z.mean():+.2f}, {np.sqrt(np.mean(z**2)):.3f}")
            if "ranks" in o:
                row.append(f"{rank_p(o['ranks'][:, k]):.3f}")
            missing = [f"{np.mean(~np.isfinite(o[m][:, 0, 0])):.3f}" for m in methods_of(o)]
            row.append(", ".join(missing) if k == 0 else "")
            if "ranks" in o:
                sampling = f"{o['settled'].mean():.3f}, {o['seconds'].mean():.2f} s"
                row.append(sampling if k == 0 else "")
            rows.append(row)
    first = next(iter(found.values()))
    head = ["true model", "coefficient", *(METHODS[m] for m in methods_of(first))]
    ranked = "ranks" in first
    head += ["p of the ranks"] * ranked + ["no result"] + ["chains settled, time each"] * ranked
    return table(head, rows)


def misses(groups: dict[int, dict[str, Outcome]]) -> list[str]:
    """What falls short of the targets, and by how many standard errors."""
    short = []
    for n, found in groups.items():
        for name, o in found.items():
            for k, c in enumerate(SCENARIOS[name].middle):
                where = f"{name}, n = {n}, {SHOWN.get(c, c)}"
                for method in methods_of(o):
                    targets = ((0.68, TARGET_68), (0.95, TARGET_95))
                    for hit, (level, (low, high)) in zip(covered(o, method), targets, strict=True):
                        rate = float(hit[:, k].mean())
                        if not low <= rate <= high:
                            off = (rate - level) / np.sqrt(level * (1.0 - level) / len(hit))
                            what = f"{METHODS[method]} {100 * level:.0f} % interval covers {rate:.3f}"
                            short.append(f"{where}: {what} ({off:+.1f} standard errors)")
                    if method in EFFICIENCY_TARGET:
                        z = pulls(o, method)[:, k]
                        rms = np.sqrt(np.mean(z**2))
                        if rms > EFFICIENCY_TARGET[method]:
                            error = np.std(z**2) / (2.0 * rms * np.sqrt(len(z)))
                            short.append(f"{where}: {METHODS[method]} RMSE {rms:.3f} ± {error:.3f} bounds")
                if "ranks" in o and rank_p(o["ranks"][:, k]) < LEAST_P:
                    short.append(f"{where}: ranks not uniform, p = {rank_p(o['ranks'][:, k]):.2g}")
    return short


INTRODUCTION = """# Coverage and efficiency

Records simulated at {rate:g} Hz, {records} of each model and length. Every record has coefficients of its
own: log-uniform over a factor of three around values that are clearly seen, frequencies of lines uniform from
5 to 40 Hz. Longer records have their noise stretched along. Three methods: GLS, `fit(recording, model)`, is
generalized least squares of the Allan variances; Whittle is `fit(recording, model, "whittle")`; posterior is
`sample` of the latter with the prior that the truth was drawn from. Simulator and Cramér-Rao bound share no
code with the package. Reproduce with `python benchmarks/studies/coverage.py`.

{machine}
"""
ABOUT_COVERAGE = """Share of records whose interval holds the truth, with its standard error. The bound is
that of the whole record in per cent of the coefficient, median over the records.
"""
ABOUT_EFFICIENCY = """Bias, RMSE; both in multiples of the Cramér-Rao bound at each record's truth. The
posterior's estimate is its median, which knows the prior too. Standard error of an RMSE of 1: {error:.3f}.
"""
ABOUT_RANKS = """p: χ² test of the histogram, {bins} bins, of the truth's ranks among {draws} draws.
"""


def report(groups: dict[int, dict[str, Outcome]], seconds: float) -> str:
    some = next(iter(next(iter(groups.values())).values()))
    records = len(some["truth"])
    parts = [INTRODUCTION.format(rate=RATE, records=records, machine=describe())]
    for n, found in groups.items():
        about = ABOUT_EFFICIENCY.format(error=1.0 / np.sqrt(2.0 * records))
        if "ranks" in some:
            about += ABOUT_RANKS.format(bins=BINS, draws=DRAWS)
        parts += [
            f"## {n} samples ({n * T0:.0f} s)\n",
            ABOUT_COVERAGE,
            coverage_table(found) + "\n",
            about,
            efficiency_table(found) + "\n",
        ]
    short = misses(groups)
    parts += [
        "## Against the targets\n",
        f"Coverage {TARGET_68[0]} to {TARGET_68[1]} and {TARGET_95[0]} to {TARGET_95[1]}; RMSE ≤ "
        f"{EFFICIENCY_TARGET['Whittle']:.2f} bounds (Whittle), ≤ {EFFICIENCY_TARGET['Allan']:.2f} (GLS); "
        f"ranks p ≥ {LEAST_P}.\n",
        "\n".join(f"- {line}" for line in short) + "\n" if short else "All met.\n",
        f"Whole run: {seconds / 60.0:.0f} min.\n",
    ]
    return "\n".join(parts)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="few short records, to see that all of it runs")
    parser.add_argument("--no-posterior", action="store_true", help="intervals of the fits only")
    parser.add_argument("--cases", help="true models, e.g. N+K,Q+N+K; all by default")
    parser.add_argument("--records", type=int, default=300, help="of each model and length")
    parser.add_argument("--lengths", default="16384,262144", help="samples of a record")
    parser.add_argument("--workers", type=int, default=2, help="processes")
    parser.add_argument("--results", type=Path, default=paths.RESULTS / "coverage.md")
    options = parser.parse_args()
    if options.quick:
        options.records, options.lengths = CHUNK, "16384"
    names = options.cases.split(",") if options.cases else list(CASES)
    lengths = [int(n) for n in options.lengths.split(",")]
    started = time.perf_counter()
    tasks = [
        (
            name,
            n,
            min(BLOCK, options.records - first),
            (n, CASES.index(name), first),
            not options.no_posterior,
        )
        for n in lengths
        for name in names
        for first in range(0, options.records, BLOCK)
    ]
    blocks: dict[tuple[int, str], list[tuple[int, Outcome]]] = {}
    for task, result, seconds in run_tasks(outcomes, tasks, options.workers):
        name, n, records, (*_, first), _ = task
        blocks.setdefault((n, name), []).append((first, result))
        print(f"{name}, {n} samples: {records} records in {seconds:.0f} s", flush=True)
        if sum(len(o["truth"]) for _, o in blocks[n, name]) == options.records:
            found = {name: merged(blocks[n, name])}
            print(coverage_table(found) + "\n" + efficiency_table(found), flush=True)
    groups = {n: {name: merged(blocks[n, name]) for name in names} for n in lengths}
    text = report(groups, time.perf_counter() - started)
    publish(text, options.results, options.quick)


def merged(blocks: list[tuple[int, Outcome]]) -> Outcome:
    """Blocks of records in their order."""
    parts = [o for _, o in sorted(blocks, key=lambda block: block[0])]
    return {key: np.concatenate([o[key] for o in parts]) for key in parts[0]}


if __name__ == "__main__":
    main()

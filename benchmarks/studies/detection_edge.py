"""A rate random walk at the edge of detection: do intervals and upper limits cover, and who sees it first?

    python benchmarks/studies/detection_edge.py [--quick] [--records 300] [--null 600] [--results PATH]

Records of N + K (truth.py, independent of the package) with K from 0 to 3 limits. At the limit the Cramér-Rao
standard deviation of K² for vanishing K is a third of K². Writes a table and, beside it, a picture.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import matplotlib
import numpy as np
import paths
from scipy.fft import dct

from allanjax.estimate.selection import AxisSelection
from benchmarks.common.machine import describe
from benchmarks.common.ours import FIELDS, LABELS, columns_of, fit_all, model_of, recording_of
from benchmarks.common.report import publish, run_tasks, share, standard_error, table
from benchmarks.common.truth import RATE, T0, Case, bound, derivatives, simulate
from benchmarks.common.truth import cosine_variances as variances_of

matplotlib.use("Agg")
from matplotlib import pyplot as plt

N_SAMPLES = 1 << 14
CHUNK = 25
MULTIPLES = (0.2, 0.4, 0.6, 0.8, 1.0, 1.25, 1.5, 2.0, 3.0)
FALSE_ALARMS = 0.01
COVERAGE_TARGET = (0.92, 0.98)
FITS = {
    "Allan, N+K given": ("N", "allan"),
    "Whittle, N+K given": ("N", "whittle"),
    "Allan, terms chosen": ("", "allan"),
    "Whittle, terms chosen": ("", "whittle"),
}
STATISTICS = ("Allan: K̂", "Whittle: K̂", "evidence of N+K over N", "likelihood ratio, N and K = limit known")


def limit(n: int) -> float:
    """The K whose square is three Cramér-Rao standard deviations of K² at vanishing K."""
    little = 1e-4 / np.sqrt(n * T0) / (n * T0)
    return float(np.sqrt(3.0 * 2.0 * little * bound(Case("N+K", {"N": 1.0, "K": little}), n)[1]))


def outcomes(K: float, edge: float, records: int, seed: int) -> dict[str, np.ndarray]:
    """Of each record: what each fit says of K [records, fields], and the detection statistics.

    The matched statistic is that of N = 1 and K = `edge` against N = 1 alone.
    """
    rng = np.random.default_rng(seed)
    parts: dict[str, list[np.ndarray]] = {name: [] for name in (*FITS, "statistics")}
    null, there = (variances_of(derivatives(Case("", {"N": 1.0, "K": k}), N_SAMPLES)[0]) for k in (0.0, edge))
    for first in range(0, records, CHUNK):
        size = min(CHUNK, records - first)
        x = simulate(Case("N+K", {"N": 1.0, "K": K}), N_SAMPLES, size, rng)
        recording = recording_of(x)
        of_K = Case("", {"K": K})
        statistics = []
        for name, (given, objective) in FITS.items():
            axes, ranking = fit_all(recording, model_of("NK") if given else None, objective)
            columns = columns_of(axes, of_K)
            parts[name].append(np.stack([column[:, 0] for column in columns.values()], axis=1))
            if given:
                statistics.append(columns["value"][:, 0])
            elif objective == "allan":
                statistics.append(np.array([odds(axis) for axis in ranking.results]))
        c = dct(x, norm="ortho", axis=0)[1:].T
        statistics.append(0.5 * c**2 @ (1.0 / null - 1.0 / there))
        parts["statistics"].append(np.stack(statistics, axis=1))
    return {name: np.concatenate(part) for name, part in parts.items()}


def odds(axis: AxisSelection) -> float:
    """Log-evidence of N + K less that of N."""
    by_set = {s.terms: s.log_evidence for s in axis.ranking}
    alone, walk = LABELS["N"], LABELS["K"]
    return by_set[alone, walk] - by_set[(alone,)]


def hits(found: np.ndarray, K: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of the records with a result: K inside the interval, below the upper limit, detected."""
    o = dict(zip(FIELDS, found[np.isfinite(found[:, 0])].T, strict=True))
    return (o["lower"] <= K) & (o["upper"] >= K), o["limit"] >= K, o["detected"] > 0.0


def coverage_table(sweep: dict[float, dict[str, np.ndarray]], edge: float) -> str:
    rows = []
    for multiple, found in sweep.items():
        if multiple == 0.0:
            continue
        inside, below = [], []
        for name in FITS:
            interval, upper, _ = hits(found[name], multiple * edge)
            inside.append(share(interval))
            below.append(share(upper))
        rows.append([f"{multiple:g}", *inside, *below])
    head = [f"{name}: {what}" for what in ("interval", "limit") for name in FITS]
    return table(["K / limit", *head], rows)


def detection_table(sweep: dict[float, dict[str, np.ndarray]], edge: float) -> str:
    rows = []
    for multiple, found in sweep.items():
        rows.append([f"{multiple:g}", *(share(hits(found[name], multiple * edge)[2]) for name in FITS)])
    return table(["K / limit", *FITS], rows)


def thresholds(null: dict[str, np.ndarray]) -> np.ndarray:
    """Of each statistic, exceeded by the chosen share of the records without K."""
    return np.quantile(null["statistics"], 1.0 - FALSE_ALARMS, axis=0)


def equal_alarms(sweep: dict[float, dict[str, np.ndarray]]) -> dict[float, np.ndarray]:
    """Detections [records, statistics] with thresholds from the records without K."""
    cut = thresholds(sweep[0.0])
    return {multiple: found["statistics"] > cut for multiple, found in sweep.items() if multiple > 0.0}


def equal_table(sweep: dict[float, dict[str, np.ndarray]]) -> str:
    rows = [[f"{m:g}", *(share(hit) for hit in found.T)] for m, found in equal_alarms(sweep).items()]
    return table(["K / limit", *STATISTICS], rows)


def against_allan(sweep: dict[float, dict[str, np.ndarray]]) -> str:
    """Detections at the limit, in pairs on the same records."""
    found = equal_alarms(sweep)[1.0].astype(float)
    rows = []
    for k, name in enumerate(STATISTICS[1:], 1):
        gain = found[:, k] - found[:, 0]
        rows.append([name, f"{gain.mean():+.3f} ± {gain.std(ddof=1) / np.sqrt(len(gain)):.3f}"])
    return table(
        ["at the limit, equal false alarms", "detection rate less that of the Allan curve's fit"], rows
    )


def misses(sweep: dict[float, dict[str, np.ndarray]], edge: float) -> list[str]:
    """What falls short of the targets."""
    short = []
    low, high = COVERAGE_TARGET
    for multiple, found in sweep.items():
        for name in FITS:
            converged = np.isfinite(found[name][:, 0]).mean()
            if converged < 1.0:
                short.append(f"{name}, K = {multiple:g} limits: {converged:.3f} converged")
            if multiple == 0.0:
                continue
            for what, hit in zip(
                ("interval", "upper limit"), hits(found[name], multiple * edge), strict=False
            ):
                # Nothing can be said against a limit that covers more often where K is hardly there.
                if hit.mean() < low or (hit.mean() > high and multiple >= 1.0):
                    short.append(f"{name}, K = {multiple:g} limits: {what} covers {share(hit)}")
    gain = equal_alarms(sweep)[1.0].mean(axis=0)
    short += [
        f"{name} detects {rate:.3f} at the limit, the Allan curve's fit {gain[0]:.3f}"
        for name, rate in zip(STATISTICS[1:3], gain[1:3], strict=True)
        if rate <= gain[0]
    ]
    return short


def draw(sweep: dict[float, dict[str, np.ndarray]], edge: float, path: Path) -> None:
    """Coverage of intervals and limits, and detection rates, over K."""
    multiples = [m for m in sweep if m > 0.0]
    figure, panels = plt.subplots(2, 2, figsize=(10, 7.5), sharex=True, layout="constrained")
    records = len(next(iter(sweep[multiples[0]].values())))
    for panel, index, title in (
        (panels[0, 0], 0, "95 % interval covers"),
        (panels[0, 1], 1, "95 % upper limit covers"),
        (panels[1, 0], 2, "detected, as reported"),
    ):
        for style, name in zip(("o-", "s-", "o--", "s--"), FITS, strict=True):
            rates = [hits(sweep[m][name], m * edge)[index].mean() for m in multiples]
            panel.plot(multiples, rates, style, markersize=4, label=name)
        panel.set_title(title)
        if index < 2:
            error = 1.96 * standard_error(0.95, records)
            panel.axhline(0.95, color="black", linewidth=1)
            panel.axhspan(0.95 - error, 0.95 + error, color="0.88", zorder=0)
            for end in COVERAGE_TARGET:
                panel.axhline(end, color="black", linewidth=0.5, linestyle=":")
            panel.set_ylim(0.8, 1.005)
    rates = np.array([hit.mean(axis=0) for hit in equal_alarms(sweep).values()])
    for style, name, rate in zip(("o-", "s-", "d-", "k:"), STATISTICS, rates.T, strict=True):
        panels[1, 1].plot(multiples, rate, style, markersize=4, label=name)
    panels[1, 1].set_title(f"detected at {100 * FALSE_ALARMS:g} % false alarms")
    for panel in panels.flat:
        panel.set_xscale("log")
        panel.set_xticks(multiples, [f"{m:g}" for m in multiples])
        panel.minorticks_off()
        panel.grid(alpha=0.3)
    for panel in panels[1]:
        panel.axvline(1.0, color="0.6", linewidth=1)
        panel.set_xlabel("K / detection limit")
    panels[0, 0].legend(fontsize=8)
    panels[1, 1].legend(fontsize=8)
    figure.savefig(path, dpi=110)
    plt.close(figure)


INTRODUCTION = """# The edge of detection

A rate random walk in white noise, N = 1, {n} samples at {rate:g} Hz, {records} records for each K ({null}
without it). K is in units of its detection limit, {edge:.4g}: there K² is three of the Cramér-Rao standard
deviations that it has for K → 0. Simulator and bound share no code with the package. Reproduce with
`python benchmarks/studies/detection_edge.py`.

{machine}

![Coverage and detection]({picture})
"""

ABOUT_COVERAGE = """Share of records whose 95 % interval holds K, and whose one-sided 95 % upper limit is
above K. An interval that begins at zero may cover 97.5 %. N+K given: `fit(recording, N + K, objective)`;
terms chosen: `fit(recording, objective=...)`.
"""

ABOUT_THRESHOLDS = """Thresholds on each statistic are exceeded in so many of the records without K. They are
the estimates of K of both fits of N+K, the evidence of N+K over that of N, and the likelihood ratio of N and
K = limit, both known, against N alone, which at the limit no test can beat.
"""


def report(sweep: dict[float, dict[str, np.ndarray]], edge: float, picture: str, seconds: float) -> str:
    short = misses(sweep, edge)
    records, null = (len(sweep[m]["statistics"]) for m in (1.0, 0.0))
    low, high = COVERAGE_TARGET
    return "\n".join(
        [
            INTRODUCTION.format(
                n=N_SAMPLES,
                rate=RATE,
                records=records,
                null=null,
                edge=edge,
                machine=describe(),
                picture=picture,
            ),
            "## Coverage of K\n",
            ABOUT_COVERAGE,
            coverage_table(sweep, edge) + "\n",
            "## Detection, as reported\n",
            "`coefficient.detected`. The first row, K = 0, has the false alarms.\n",
            detection_table(sweep, edge) + "\n",
            f"## Detection at {100.0 * FALSE_ALARMS:g} % false alarms\n",
            ABOUT_THRESHOLDS,
            equal_table(sweep) + "\n",
            against_allan(sweep) + "\n",
            f"## Against the targets (coverage {low} to {high}, detections beat the Allan curve's fit)\n",
            "\n".join(f"- {line}" for line in short) + "\n" if short else "All met.\n",
            f"Whole run: {seconds / 60.0:.0f} min.\n",
        ]
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="few records, to see that all of it runs")
    parser.add_argument("--records", type=int, default=300, help="for each K")
    parser.add_argument("--null", type=int, default=600, help="records without K")
    parser.add_argument("--workers", type=int, default=2, help="processes")
    parser.add_argument("--results", type=Path, default=paths.RESULTS / "detection_edge.md")
    options = parser.parse_args()
    if options.quick:
        options.records = options.null = CHUNK
    started = time.perf_counter()
    edge = limit(N_SAMPLES)
    print(f"K at the limit: {edge:.4g}", flush=True)
    tasks = [
        (m * edge, edge, options.records if m else options.null, 1000 + k)
        for k, m in enumerate((0.0, *MULTIPLES))
    ]
    done = {}
    for task, result, seconds in run_tasks(outcomes, tasks, options.workers):
        m = round(task[0] / edge, 6)
        done[tasks.index(task)] = result
        print(f"K = {m:.2g} limits: {seconds:.0f} s", flush=True)
        print(coverage_table({m: result}, edge) + "\n" + detection_table({m: result}, edge), flush=True)
    sweep = {m: done[k] for k, m in enumerate((0.0, *MULTIPLES))}
    picture = options.results.with_suffix(".png")
    text = report(sweep, edge, picture.name, time.perf_counter() - started)
    publish(text, options.results, options.quick)
    if options.results.exists() and not options.quick:
        draw(sweep, edge, picture)


if __name__ == "__main__":
    main()

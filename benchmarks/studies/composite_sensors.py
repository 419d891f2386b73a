"""What does the critic make of sensors with several effects on top of each other?

    python benchmarks/studies/composite_sensors.py [--first-seed 1000] [--count 60] [--clean 100] [--cases]

Six-axis recordings of `common/composite_sensors.py`, whose effects, filters and strengths the critic was not
made with: seeds below 1000 are for work on the study, those from 1000 on for its results. `--cases` runs the
three fixed cases alone: white noise and a walk through a filter, with a resonance behind it or inside.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import numpy as np
import paths

from benchmarks.common.composite_cases import CASES, K_TRUE, LONGEST, N_TRUE, RATE, SAMPLES, SIGMA, case
from benchmarks.common.composite_judge import CLUSTERS, LABELS, NAMED, Outcome, judged
from benchmarks.common.composite_scene import ASKED
from benchmarks.common.composite_sensors import KINDS
from benchmarks.common.machine import describe
from benchmarks.common.report import publish, run_tasks, standard_error, table

WITHIN = 0.05


# --- The fixed cases ---------------------------------------------------------------------------------------

ABOUT_CASES = """# Fixed composite cases

One gyro, {samples:,} samples at {rate:g} Hz: white noise of {N:g} rad/s/√Hz and a random walk of {K:g}
rad/s/√s through one pole at 15 Hz; resonances of {sigma:g} rad/s each, at 20 Hz with Q = 15 and, in the
last case, at 35 Hz with Q = 6 too. Seed {seed}. Allan deviation: the largest relative error of the extended
model's at cluster times up to {longest:g} s, against the expected one (integral of the generator's
spectrum); beside it that against the record's own without what was found in it, where there are
{clusters:,} clusters or more. N is compared with that of the samples at low frequencies, aliases included.
Targets: within 3 %, N within 2 %, at most one finding more than was planted. Reproduce with `{command}`.

{machine}

{table}
"""


def run_cases(options: argparse.Namespace) -> str:
    rows = []
    for task, row, _ in run_tasks(case, [(name, options.first_seed) for name in CASES], options.workers):
        print(f"{task[0]}: {', '.join(row[1:])}", file=sys.stderr, flush=True)
        rows.append(row)
    rows.sort(key=lambda row: list(CASES).index(row[0]))
    head = ["case", "Allan deviation", "beside the record", "N", "findings", "causes", "s"]
    return ABOUT_CASES.format(
        samples=SAMPLES,
        rate=RATE,
        N=N_TRUE,
        K=K_TRUE,
        sigma=SIGMA,
        seed=options.first_seed,
        longest=LONGEST,
        clusters=CLUSTERS,
        command=command(),
        machine=describe(("jax", "numpy", "scipy", "allanjax")),
        table=table(head, rows),
    )


# --- The report --------------------------------------------------------------------------------------------

ABOUT = """# Composite sensors

{count} six-axis recordings of seeds {first} to {last} with 0 to 6 effects, {clean} clean ones of seeds from
{first} on; 200,000 to 1,000,000 samples at 50 to 400 Hz{samples}. An effect is asked for on the axes where
somebody who knows all spectra expects a gain of {gain:g} nats or more from it; it is named where a finding
with a right name lies at its frequency or time, and counts as named if it is on all axes that were asked for.
Effects in parts of the record that the first look leaves out ({cut}) are not asked for. Allan deviations of
the models are compared with those of the samples without what the critique found in them in time
(`stages[-1].x`), at all cluster times with {clusters:,} clusters or more. Intervals are those of
`critique.refit()`, the joint fit of what is left: of N where the axis has one level (no stretch of another
variance, no rounding), of K where it is there or detected, of T_c where the sensor has a Gauss–Markov
process. A recording that failed has no axis right and names nothing. Reproduce with `{command}`.

{machine}
- {minutes:.0f} minutes

{targets}

## Effects by kind

{kinds}

## Allan deviation

{errors}
{failures}"""


def command() -> str:
    return " ".join(["python", "benchmarks/studies/composite_sensors.py", *sys.argv[1:]])


def rate_of(hits: list[bool]) -> str:
    if not hits:
        return "–"
    rate = float(np.mean(hits))
    return f"{rate:.3f} ± {standard_error(rate, len(hits)):.3f}"


def targets(found: list[Outcome], clean: list[Outcome]) -> str:
    """The table of targets."""
    off = [e for o in found for e in o.off.values()]
    covered = [pair for o in found for pair in o.covered]
    whole = [n == hits for o in found for _, n, hits in o.named]
    some = [o for o in found if o.effects and not o.error]
    told_of, planted = sum(o.told for o in some), sum(o.effects - o.cut for o in some)
    asked = sum(o.asked for o in some)
    alarms = [bool(o.told or o.error) for o in clean]
    right = [e <= WITHIN for e in off]
    rows = [["Allan deviation within 5 %: share of axes", "≥ 0.97", rate_of(right), f"{len(off)} axes"]]
    for symbols in (tuple(LABELS), *((s,) for s in LABELS)):
        hits = [hit for symbol, hit in covered if symbol in symbols]
        name = f"95 % intervals hold {', '.join(symbols)}"
        rows.append([name, "0.90 to 0.98", rate_of(hits), f"{len(hits)} intervals"])
    hits = [hit for o in clean for _, hit in o.covered]
    rows.append(["the same, all, in clean recordings", "", rate_of(hits), f"{len(hits)} intervals"])
    ratio, of_asked = told_of / max(planted, 1), told_of / max(asked, 1)
    at = f"{len(some)} recordings"
    rows += [
        ["effects asked for, named on the right axes", "≥ 0.95", rate_of(whole), f"{len(whole)} effects"],
        ["findings told over effects planted", "≤ 1.3", f"{ratio:.2f} ({told_of} of {planted})", at],
        ["findings told over effects asked for", "", f"{of_asked:.2f} ({told_of} of {asked})", at],
        ["clean recordings with a finding", "≤ 0.01", rate_of(alarms), f"{len(clean)} recordings"],
    ]
    for name, values in (
        ("seconds", [o.seconds for o in found]),
        ("peak memory [MB]", [o.megabytes for o in found if o.megabytes]),
    ):
        if values:
            shown = f"median {np.median(values):.0f}, largest {np.max(values):.0f}"
            rows.append([f"{name} per recording", "", shown, f"{len(values)} recordings"])
    rows.append(["failures", "0", str(sum(bool(o.error) for o in [*found, *clean])), ""])
    return table(["target", "aim", "measured", "n"], rows)


def kinds_table(found: list[Outcome]) -> str:
    rows = []
    for kind in KINDS:
        of = [(n, hits) for o in found for k, n, hits in o.named if k == kind]
        if of:
            axes = f"{sum(h for _, h in of)} of {sum(n for n, _ in of)}"
            row = [rate_of([n == h for n, h in of]), f"{sum(n == h for n, h in of)} of {len(of)}", axes]
            rows.append([kind, *row, ", ".join(sorted(NAMED[kind]))])
    return table(["kind", "named on all axes", "effects", "axes", "right names"], rows) if rows else "None."


def errors_table(found: list[Outcome]) -> str:
    off = np.array([e for o in found for e in o.off.values()])
    if not len(off):
        return "None."
    shares = [f"{np.mean(off <= limit):.3f}" for limit in (0.02, 0.03, 0.05, 0.10, 0.30)]
    return table(["within 2 %", "3 %", "5 %", "10 %", "30 %"], [shares])


def report(found: list[Outcome], clean: list[Outcome], options: argparse.Namespace, seconds: float) -> str:
    failed = [f"- {o.seed}: {o.error}" for o in [*found, *clean] if o.error]
    return ABOUT.format(
        count=len(found),
        first=options.first_seed,
        last=options.first_seed + options.count - 1,
        clean=len(clean),
        samples=f", here {options.samples:,} samples" if options.samples else "",
        gain=ASKED,
        cut=sum(o.cut for o in found),
        clusters=CLUSTERS,
        command=command(),
        machine=describe(("jax", "numpy", "scipy", "allanjax")),
        minutes=seconds / 60.0,
        targets=targets(found, clean),
        kinds=kinds_table(found),
        errors=errors_table(found),
        failures="\n## Failures\n\n" + "\n".join(failed) + "\n" if failed else "",
    )


def line_of(outcome: Outcome) -> str:
    """Progress, in a line."""
    if outcome.error:
        return f"{outcome.seed}: {outcome.error}"
    missed = [f"{kind} {hits}/{n}" for kind, n, hits in outcome.named if hits < n]
    worst = ""
    if outcome.off:
        axis = max(outcome.off, key=outcome.off.__getitem__)
        worst = f", Allan deviation {100.0 * outcome.off[axis]:.1f} % off at worst ({axis})"
    return (
        f"{outcome.seed}: {outcome.samples} samples, {outcome.effects} effects ({outcome.asked} asked for), "
        f"{outcome.told} told [{', '.join(outcome.causes)}], missed: {', '.join(missed) or 'none'}{worst}, "
        f"{outcome.seconds:.0f} s, {outcome.megabytes:.0f} MB"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--first-seed", type=int, default=1000)
    parser.add_argument("--count", type=int, default=60, help="recordings with effects")
    parser.add_argument("--clean", type=int, default=100, help="recordings without")
    parser.add_argument("--samples", type=int, help="of every recording, to see that it runs")
    parser.add_argument("--cases", action="store_true", help="the three fixed cases alone")
    parser.add_argument("--only", type=int, help="the first so many of the fixed cases")
    parser.add_argument("--workers", type=int, default=2, help="processes")
    parser.add_argument("--results", type=Path, help="benchmarks/results/composite_sensors.md or _cases.md")
    options = parser.parse_args()
    name = "composite_cases.md" if options.cases else "composite_sensors.md"
    options.results = options.results or paths.RESULTS / name
    if options.cases:
        for extra in list(CASES)[options.only :] if options.only else []:
            del CASES[extra]
        publish(run_cases(options), options.results, bool(options.only))
        return
    begun = time.perf_counter()
    tasks = [(options.first_seed + k, False, options.samples) for k in range(options.count)]
    tasks += [(options.first_seed + k, True, options.samples) for k in range(options.clean)]
    found: list[Outcome] = []
    clean: list[Outcome] = []
    for done, (task, outcome, _) in enumerate(run_tasks(judged, tasks, options.workers), 1):
        (clean if task[1] else found).append(outcome)
        what = "clean " if task[1] else ""
        print(f"{done}/{len(tasks)} {what}{line_of(outcome)}", file=sys.stderr, flush=True)
    found.sort(key=lambda o: o.seed)
    text = report(found, sorted(clean, key=lambda o: o.seed), options, time.perf_counter() - begun)
    publish(text, options.results, bool(options.samples))


if __name__ == "__main__":
    main()

"""Is the extended model of sensors with several effects on top of each other right, and is each told once?

Six-axis recordings of benchmarks/common/composite_sensors.py, whose effects, filters and strengths the critic
was not made with, 50 to 400 Hz: seeds below 1000 are for work on the study, those from 1000 on for its
results. An effect is asked for on the axes where somebody who knows all spectra expects a gain of 25 nats or
more; it is named where a finding with a right name lies at its frequency or time, on all of these axes.
Effects in parts of the record that the first look leaves out are not asked for. Allan deviations of the
models are compared with those of the samples without what the critique found in time, at all cluster times
with 1,000 clusters or more. Intervals are those of `critique.refit()`: of N where the axis has one level (no
stretch of another variance, no rounding), of K where it is there or detected, of T_c where the sensor has a
Gauss–Markov process. A recording that failed has no axis right and names nothing.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from benchmarks.common.composite_judge import LABELS, NAMED, Outcome, judged
from benchmarks.common.composite_sensors import KINDS
from benchmarks.common.study import run_tasks, share, table

QUICK: dict[str, Any] = {"records": 1, "clean": 0, "samples": 16_384}


def run(*, records: int = 60, clean: int = 100, samples: int = 0, seed: int = 1000) -> Iterator[str]:
    """Samples: of every recording; 0 for 200,000 to 1,000,000."""
    counts = {False: records, True: clean}
    done = run_tasks(judged, [(seed + k, c, samples) for c, count in counts.items() for k in range(count)])
    yield f"## {records} recordings with effects and {clean} without, seeds from {seed} on"
    yield target_table(done[:records], done[records:])
    yield kinds_table(done[:records])
    yield "\n".join(f"- {o.seed} failed: {o.error}" for o in done if o.error)


def target_table(found: list[Outcome], clean: list[Outcome]) -> str:
    off = np.array([e for o in found for e in o.off.values()])
    covered = [pair for o in found for pair in o.covered]
    some = [o for o in found if o.effects and not o.error]
    told, planted = sum(o.told for o in some), sum(o.effects - o.cut for o in some)
    rows = [["Allan deviation within 5 %: share of axes", "≥ 0.97", share(off <= 0.05), f"{len(off)} axes"]]
    for symbols in (tuple(LABELS), *((s,) for s in LABELS)):
        hits = [hit for symbol, hit in covered if symbol in symbols]
        name = f"95 % intervals hold {', '.join(symbols)}"
        rows.append([name, "0.90 to 0.98", share(hits), f"{len(hits)} intervals"])
    whole = [n == hits for o in found for _, n, hits in o.named]
    ratio = f"{told / max(planted, 1):.2f} ({told} of {planted})"
    alarms = share([bool(o.told or o.error) for o in clean])
    seconds = [o.seconds for o in found] or [0.0]
    rows += [
        ["effects asked for, named on all right axes", "≥ 0.95", share(whole), f"{len(whole)} effects"],
        ["findings told over effects planted", "≤ 1.3", ratio, f"{len(some)} recordings"],
        ["clean recordings with a finding", "≤ 0.01", alarms, f"{len(clean)} recordings"],
        ["seconds a recording: median, largest", "", f"{np.median(seconds):.0f}, {max(seconds):.0f}", ""],
        ["failures", "0", sum(bool(o.error) for o in [*found, *clean]), ""],
    ]
    return table(["target", "aim", "measured", "of"], rows)


def kinds_table(found: list[Outcome]) -> str:
    rows = []
    for kind in KINDS:
        if of := [(n, hits) for o in found for k, n, hits in o.named if k == kind]:
            axes = f"{sum(h for _, h in of)} of {sum(n for n, _ in of)}"
            whole, names = [n == h for n, h in of], ", ".join(sorted(NAMED[kind]))
            rows.append([kind, share(whole), f"{sum(whole)} of {len(of)}", axes, names])
    return table(["kind", "named on all axes", "effects", "axes", "right names"], rows)

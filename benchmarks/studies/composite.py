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

import time
import traceback
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

import allanjax as aj
from benchmarks.common.composite_scene import AxisTruth, Effect
from benchmarks.common.composite_sensors import KINDS, Composite, composite
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


#: Clusters from which on an Allan deviation is compared.
CLUSTERS = 1000
#: Names of causes that are right for each kind of effect.
NAMED: dict[str, set[str]] = {
    "filter": {"low_pass"},
    "resonance": {"resonance"},
    "line": {"sinusoid"},
    "wandering line": {"sinusoid", "resonance"},
    "knock": {"disturbance"},
    "event": {"disturbance", "variance_change"},
    "rounding": {"rounding"},
    "rounding behind a matrix": {"rounding", "quantization"},
    "variance": {"variance_change"},
    "periodic outliers": {"outliers"},
    "random outliers": {"outliers"},
    "repeats": {"repeated_samples"},
    "temperature": {"temperature"},
    "step": {"bias_step"},
}
#: Of those that several axes have in common, a finding of a waveform that they share is right, too.
SHARED, SHARING = {"knock", "event", "resonance"}, "common_mode"
#: Labels of the coefficients that the truth has.
LABELS = {"N": "angle_random_walk", "K": "rate_random_walk", "T_c": "markov_correlation_time"}


@dataclass
class Outcome:
    """What a recording brought; one that failed has an `error` and nothing else.

    Attributes:
        off: largest relative error of the Allan deviation, by axis.
        covered: symbol and whether its interval holds the truth.
        named: kind, axes asked for, those of them on which it was named.
        cut: effects in parts of the record that the fit left out.
        alone: of axes with nothing but what `fit` corrects for.
    """

    seed: int
    effects: int
    told: int = 0
    seconds: float = 0.0
    error: str = ""
    off: dict[str, float] = field(default_factory=dict)
    covered: list[tuple[str, bool]] = field(default_factory=list)
    named: list[tuple[str, int, int]] = field(default_factory=list)
    cut: int = 0


# --- What the critic's API gives ---------------------------------------------------------------------------


def explained(critique: aj.Critique, axis: str, record: np.ndarray) -> tuple[np.ndarray, aj.Model]:
    """Samples [SI] without what was found in them in time, and the model of the noise that is left.

    The record as it came and the whole model, lines and steps included, where nothing was found in time.
    """
    model, stages = critique.models[axis].sampled(critique.rate), critique[axis].stages
    if not stages:
        return record, model
    labels = [name for name, term in zip(model.term_labels, model, strict=True) if term.deterministic]
    return np.asarray(stages[-1].x), model.without(labels)


# --- Judgement ---------------------------------------------------------------------------------------------


def overlapping(x: np.ndarray, sizes: np.ndarray) -> np.ndarray:
    """Overlapping Allan deviations of samples."""
    phase = np.concatenate([[0.0], np.cumsum(x - x.mean())])
    second = (phase[2 * m :] - 2.0 * phase[m:-m] + phase[: -2 * m] for m in sizes)
    return np.array([np.sqrt(0.5 * np.mean(d**2)) / m for d, m in zip(second, sizes, strict=True)])


def cluster_sizes(most: int) -> np.ndarray:
    """Each up to 8 samples, then steps of a sixth."""
    grown = np.round(8.0 * 1.17 ** np.arange(1, 100)).astype(int)
    sizes = np.concatenate([np.arange(1, 9), grown])
    return np.unique(sizes[sizes <= max(most, 1)])


def off_by(model: Any, x: np.ndarray, rate: float) -> float:
    """Largest relative error of the model's Allan deviation where 1,000 clusters or more were averaged."""
    sizes = cluster_sizes(len(x) // CLUSTERS)
    expected = np.sqrt(np.asarray(model.allan_variance(sizes / rate)))
    return float(np.max(np.abs(expected / overlapping(x, sizes) - 1.0)))


def coverage(coefficients: dict[str, Any], truth: AxisTruth) -> list[tuple[str, bool]]:
    """Whether the 95 % intervals that are stated hold N, K and T_c.

    N where the axis has one level, K wherever it is detected or there, T_c where the sensor has one.
    """
    found = []
    for symbol, label in LABELS.items():
        true = getattr(truth, symbol)
        if (estimate := coefficients.get(label)) is None or (symbol == "N" and not truth.one_level):
            continue
        if not (true or (symbol == "K" and estimate.detected)):
            continue
        estimate = estimate.in_unit(estimate.si_unit)
        low, high = estimate.interval
        if estimate.measured and not estimate.held and np.isfinite([low, high]).all():
            found.append((symbol, bool(low <= true <= high)))
    return found


def there(finding: Any, effect: Effect) -> bool:
    """Whether a finding lies where the effect does."""
    if "frequency" in effect.parameters and effect.kind != "knock":
        if "frequency" not in finding.parameters:
            return finding.cause == SHARING
        f, f0 = finding.parameters["frequency"].value, float(effect.parameters["frequency"])
        if effect.kind == "resonance":
            return abs(f / f0 - 1.0) < 0.1 + 0.5 / float(effect.parameters["quality"])
        orders = np.arange(1, 2 + int(effect.parameters["harmonics"]))
        width = 0.002 * f0 + 5.0 * float(effect.parameters.get("spread", 0.0))
        return bool(np.any(np.abs(f - orders * f0) < orders * width))
    if effect.span is None or finding.domain != "time":
        return True
    slack = max(1.0, 0.25 * (effect.span[1] - effect.span[0]))
    if effect.kind == "step":
        slack = 60.0
    return finding.span[0] < effect.span[1] + slack and finding.span[1] > effect.span[0] - slack


def named_axes(findings: list[Any], effect: Effect) -> set[str]:
    names = NAMED[effect.kind] | ({SHARING} if effect.kind in SHARED else set())
    right = [f for f in findings if f.cause in names and there(f, effect)]
    return {axis for f in right for axis in f.axes}


def left_out(critique: Any, effect: Effect) -> bool:
    """Whether it lies in a part of the record that the first look did not give to the fit."""
    if (stretch := critique.fit.longest_part) is None or effect.span is None:
        return False
    return effect.span[1] <= stretch[0] or effect.span[0] >= stretch[1]


def judged(seed: int, clean: bool, samples: int) -> Outcome:
    """One recording, made, criticized and judged."""
    aj.enable_compilation_cache()
    made = composite(seed, clean, samples or None)
    outcome = Outcome(seed, len(made.effects))
    options = {"gyro_unit": made.gyro_unit, "accel_unit": made.accel_unit, "auxiliary": made.auxiliary}
    recording = aj.Recording.from_array(made.values, made.rate, names=list(made.names), **options)
    begun = time.perf_counter()
    try:
        critique = aj.critique(recording)
        outcome.seconds = time.perf_counter() - begun
        judge(outcome, critique, recording, made)
    except Exception as error:
        outcome.seconds = outcome.seconds or time.perf_counter() - begun
        where = traceback.extract_tb(error.__traceback__)[-1]
        outcome.error = f"{type(error).__name__} in {Path(where.filename).name}:{where.lineno}: {error}"
        outcome.off = dict.fromkeys(made.names, np.inf)
        outcome.named = [(e.kind, len(e.asked), 0) for e in made.effects if e.asked]
        return outcome
    outcome.told = len(critique.findings)
    return outcome


def judge(outcome: Outcome, critique: Any, recording: aj.Recording, made: Composite) -> None:
    findings, fit = list(critique.findings), critique.refit()
    for k, axis in enumerate(recording.names):
        rest, model = explained(critique, axis, recording.values[:, k])
        outcome.off[axis] = off_by(model, rest, critique.rate)
        if axis in fit.axes and fit[axis].converged:
            outcome.covered += coverage(fit[axis].coefficients, made.axes[axis])
    for effect in made.effects:
        if left_out(critique, effect):
            outcome.cut += 1
        elif effect.asked:
            hits = named_axes(findings, effect) & set(effect.asked)
            outcome.named.append((effect.kind, len(effect.asked), len(hits)))

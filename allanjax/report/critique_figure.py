"""Figures of a critique: the measurement and its simulations, before and after each finding."""

from __future__ import annotations

import functools
import itertools
import os
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from allanjax.critic.comparison import SimulationEnvelope, StageResiduals, octave_bins, summaries
from allanjax.critic.result import AxisCritique, Critique, Finding
from allanjax.record.recording import Axis
from allanjax.report.allan_panel import CLUSTER_TIME, unit_of
from allanjax.report.critique_story import UNEXPLAINED, changes, format_remainder, sentence
from allanjax.report.critique_words import p_value, what, wrap
from allanjax.report.figure import POINTS, Unit, add_grid, facts_of, literal, save_and_close, style
from allanjax.spectrum.psd import density_unit

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_BEFORE, _AFTER = "#D55E00", "#0072B2"
_SPAN = "#E69F00"
# Width and height of a figure [inches], and characters in a line of its text.
_SIZE = (10.0, 7.0)
_COLUMNS = 66
# Points that a series is thinned to.
_POINTS = 600
# Widths of a span that are drawn on either side of it; share of the record from which on it is not marked.
_MARGIN = 4.0
_EVERYWHERE = 0.95
# Most discrepancies that are listed of those that a finding removed.
_TOLD = 3
# Causes that are shown by the rms of the whitened residuals, by their extremes, and by single samples.
_LOUDNESS = frozenset({"variance_change"})
_EXTREMES = frozenset({"outliers", "disturbance", "unexplained"})
_SAMPLES = frozenset({"rounding", "saturation", "repeated_samples"})
# Samples that are shown one by one, and blocks whose means are shown.
_SHOWN_SAMPLES, _BLOCKS = 150, 200
# Correlations are drawn in bins of so many of `octave_bins`, which have so many coefficients at least.
_MERGED, _LEAST = 3, 16
# Factors by which a PSD's scale exceeds the simulations' medians: single coefficients may be next to nothing.
_BELOW, _ABOVE = 30.0, 10.0


def plot_critique(
    critique: Critique,
    path: str | os.PathLike[str] | None = None,
    findings: Collection[Finding] | None = None,
) -> tuple[Figure, ...]:
    """Draw a figure for every finding, and one for each axis without findings.

    Panels: Allan deviation and power spectral density, measured (points) and where 95 % of simulations lie
    (bands), before the finding and after; the place of the effect; and what is said about it. Allan
    deviations are those of the record continued by its mirror image (the total deviation), without a ramp.

    Args:
        critique: what `critique` returns.
        path: where to save them, as NAME_gyro_x_sinusoid.png; it is made if need be.
        findings: some of the critique's, if only their figures are wanted.

    Returns:
        The matplotlib figures.
    """
    if path is not None:
        Path(path).mkdir(parents=True, exist_ok=True)
    figures = []
    with style():
        for (finding, draw), name in zip(_jobs(critique), figure_names(critique), strict=True):
            if findings is None or finding in findings:
                figures.append(save_and_close(draw(), None if path is None else Path(path) / name))
    return tuple(figures)


def _jobs(critique: Critique) -> Iterator[tuple[Finding | None, Callable[[], Figure]]]:
    """Findings, None for an axis without, and what draws them, in the order of `figure_names`."""
    for axis in critique.results:
        record = functools.lru_cache(maxsize=2)(functools.partial(_record, critique, axis))
        for k, finding in enumerate(axis.findings):
            stages = (k, min(k + 1, len(axis.stages) - 1))
            yield finding, functools.partial(_of_finding, critique, finding, record, stages)
        if not axis.findings:
            yield None, functools.partial(_of_clean, critique, axis, record)
    for finding in critique.shared_findings:
        yield finding, functools.partial(_of_shared, critique, finding)


def figure_names(critique: Critique) -> tuple[str, ...]:
    """File names of a critique's figures, numbered where a cause was found several times."""
    names: list[str] = []
    for axis in critique.results:
        names += [f"{axis.axis.name}_{finding.cause}" for finding in axis.findings] or [axis.axis.name]
    names += [f"{'_'.join(finding.axes)}_{finding.cause}" for finding in critique.shared_findings]
    earlier = [names[:k].count(name) for k, name in enumerate(names)]
    start = critique.name or "recording"
    return tuple(
        f"{start}_{name}{f'_{k + 1}' if k else ''}.png" for name, k in zip(names, earlier, strict=True)
    )


def _record(critique: Critique, axis: AxisCritique, stage: int) -> StageResiduals:
    """Residuals of an axis at a stage."""
    return StageResiduals.of(axis.axis, 1.0, critique.rate, axis.stages[stage])


def _of_finding(
    critique: Critique, finding: Finding, record: Callable[[int], StageResiduals], stages: tuple[int, int]
) -> Figure:
    import matplotlib.pyplot as plt

    before, after = (record(k) for k in stages)
    figure, ((allan, psd), (effect, text)) = plt.subplots(2, 2, figsize=_SIZE, layout="constrained")
    _title(figure, critique, f"{', '.join(finding.axes)}: {finding.cause.replace('_', ' ')}", before)
    if before is after:
        shown: Any = ((before, "", _AFTER, "o"),)
    else:
        shown = ((before, "before", _BEFORE, "o"), (after, "after", _AFTER, "s"))
    _draw_curves((allan, psd), shown, before.axis)
    if finding.domain == "frequency":
        _draw_spectrum(effect, before, finding)
    elif finding.cause in _LOUDNESS:
        _draw_loudness(effect, before, finding)
    elif finding.cause in _SAMPLES:
        _draw_samples(effect, before)
    elif finding.cause in _EXTREMES:
        _draw_extremes(effect, before, finding)
    else:
        _draw_path(effect, before, after)
    _draw_text(text, finding, before.axis)
    return figure


def _of_shared(critique: Critique, finding: Finding) -> Figure:
    """Figure of a finding that axes share, with the curves of the first axis."""
    import matplotlib.pyplot as plt

    records = [_record(critique, critique[name], -1) for name in finding.axes]
    figure, ((allan, psd), (effect, text)) = plt.subplots(2, 2, figsize=_SIZE, layout="constrained")
    _title(figure, critique, f"{', '.join(finding.axes)}: {finding.cause.replace('_', ' ')}", records[0])
    _draw_curves((allan, psd), ((records[0], "", _AFTER, "o"),), records[0].axis)
    allan.set_title(finding.axes[0], fontsize=8.5, loc="left")
    _draw_correlation(effect, records)
    _draw_text(text, finding, records[0].axis)
    return figure


def _of_clean(critique: Critique, axis: AxisCritique, stage: Callable[[int], StageResiduals]) -> Figure:
    import matplotlib.pyplot as plt

    record = stage(0)
    figure, panels = plt.subplots(1, 2, figsize=(_SIZE[0], _SIZE[1] / 2.0), layout="constrained")
    _title(figure, critique, f"{axis.axis.name}: nothing found", record)
    _draw_curves(panels, ((record, "", _AFTER, "o"),), axis.axis)
    return figure


def _title(figure: Figure, critique: Critique, text: str, record: StageResiduals) -> None:
    name = f"{critique.name}, {text}" if critique.name else text
    figure.suptitle(f"{literal(name)}\n{facts_of(record.n, critique.rate)}", x=0.01, ha="left", fontsize=11)


def _draw_curves(panels: Any, stages: Any, axis: Axis) -> None:
    """Draw both curves of every stage, points being measured and bands simulated."""
    units = (unit_of(axis), Unit(*density_unit(axis)))
    names = ((CLUSTER_TIME, "Allan deviation"), ("frequency f [Hz]", "one-sided PSD"))
    for record, label, colour, marker in stages:
        for panel, unit, comparison in zip(panels, units, summaries(record), strict=True):
            _draw_comparison(panel, comparison, unit, label, colour, marker)
    _limit(panels[1])
    for panel, unit, (x, y) in zip(panels, units, names, strict=True):
        panel.set(xscale="log", yscale="log", xlabel=x, ylabel=f"{y} [{unit.name}]")
        add_grid(panel)
        panel.legend(frameon=False, fontsize=7.5)


def _limit(panel: Axes) -> None:
    """Limit the vertical scale to the medians of the simulations, which are the lines without markers."""
    lines = [line for line in panel.get_lines() if line.get_marker() == "None"]
    medians = np.concatenate([np.asarray(line.get_ydata(), float) for line in lines])
    low, high = panel.get_ylim()
    panel.set_ylim(max(low, float(medians.min()) / _BELOW), min(high, float(medians.max()) * _ABOVE))


def _draw_comparison(
    panel: Axes, comparison: SimulationEnvelope, unit: Unit, label: str, colour: str, marker: str
) -> None:
    x = comparison.place
    end = f" {label}" if label else ""
    low, median, high = (y / unit.scale for y in (comparison.low, comparison.median, comparison.high))
    panel.fill_between(
        x, low, high, color=colour, alpha=0.25, linewidth=0.0, label=f"95 % of simulations{end}"
    )
    panel.plot(x, median, color=colour, linewidth=1.0)
    panel.plot(
        x,
        comparison.measured / unit.scale,
        marker,
        color=colour if label == "after" else POINTS,
        markersize=2.4,
        markeredgewidth=0.0,
        label=f"measured{end}",
        zorder=3,
    )


def _window(record: StageResiduals, span: tuple[float, float]) -> tuple[slice, bool]:
    """Samples to show around a span, and whether the span is not nearly all of the record."""
    duration = record.n / record.rate
    start, end = span
    width = max(end - start, 0.01 * duration)
    shown = (max(start - _MARGIN * width, 0.0), min(end + _MARGIN * width, duration))
    first, last = (int(np.clip(round(t * record.rate), 0, record.n)) for t in shown)
    return slice(first, last), end - start < _EVERYWHERE * duration


def _blocks(length: int, most: int) -> tuple[Any, Any]:
    """First samples of about equal blocks, and the blocks' lengths."""
    edges = np.unique(np.linspace(0, length, min(most, length) + 1).astype(int))
    return edges[:-1], np.diff(edges)


def _finish(panel: Axes, ylabel: str) -> None:
    panel.set_xlabel("time since start [s]")
    panel.set_ylabel(ylabel)
    panel.legend(frameon=False, fontsize=7.5)


def _shade(panel: Axes, span: tuple[float, float]) -> None:
    panel.axvspan(*span, color=_SPAN, alpha=0.25, linewidth=0.0, label="effect", zorder=0)


def _draw_extremes(panel: Axes, record: StageResiduals, finding: Finding) -> None:
    """Draw mean and extremes of blocks of the whitened residuals, and single outliers."""
    shown, partial = _window(record, finding.span)
    e = record.whitened[shown]
    edges, length = _blocks(len(e), _POINTS)
    time = (shown.start + edges + 0.5 * length) / record.rate
    low, high = np.minimum.reduceat(e, edges), np.maximum.reduceat(e, edges)
    panel.fill_between(time, low, high, color="0.75", linewidth=0.5, label="range of samples")
    panel.plot(time, np.add.reduceat(e, edges) / length, color=_AFTER, linewidth=0.9, label="mean")
    times = finding.parameters["times"].value if finding.cause == "outliers" else ()
    if isinstance(times, tuple) and times:
        t = np.asarray(times, float)
        k = np.clip(np.rint(t * record.rate).astype(int), 0, record.n - 1)
        panel.plot(t, record.whitened[k], "o", mfc="none", mec=_BEFORE, markersize=4.0, label="outliers")
    elif partial:
        _shade(panel, finding.span)
    _finish(panel, "whitened residual [σ]")


def _draw_loudness(panel: Axes, record: StageResiduals, finding: Finding) -> None:
    """Draw the root mean square of the whitened residuals in blocks, and the band of simulations."""
    edges, length = _blocks(record.n, _BLOCKS)
    time = (edges + 0.5 * length) / record.rate
    rms = np.sqrt(np.add.reduceat(record.whitened**2, edges) / length)
    spread = 1.96 * np.sqrt(0.5 / length)
    panel.fill_between(
        time, 1.0 - spread, 1.0 + spread, color=_AFTER, alpha=0.25, linewidth=0.0, label="95 % of simulations"
    )
    panel.plot(time, rms, "o", color=POINTS, markersize=2.4, markeredgewidth=0.0, label="measured")
    if finding.span[1] - finding.span[0] < _EVERYWHERE * record.n / record.rate:
        _shade(panel, finding.span)
    _finish(panel, "rms of whitened residuals [σ]")


def _draw_samples(panel: Axes, record: StageResiduals) -> None:
    """Draw single samples as recorded, where most of them equal the one before."""
    unit = unit_of(record.axis)
    x = record.stage.x
    same = np.concatenate([[0], np.cumsum(x[1:] == x[:-1])])
    length = min(_SHOWN_SAMPLES, record.n)
    first = int(np.argmax(same[length - 1 :] - same[: record.n - length + 1]))
    shown = slice(first, first + length)
    time = np.arange(shown.start, shown.stop) / record.rate
    y = (x[shown] - x.mean()) / unit.scale
    panel.step(time, y, where="mid", color="0.75", linewidth=0.7)
    panel.plot(time, y, "o", color=POINTS, markersize=2.4, markeredgewidth=0.0, label="samples as recorded")
    _finish(panel, f"samples − mean [{unit.name}]")


def _draw_path(panel: Axes, before: StageResiduals, after: StageResiduals) -> None:
    """Draw means of blocks of samples, and the effect that was found."""
    unit = unit_of(before.axis)
    edges, length = _blocks(before.n, _BLOCKS)
    time = (edges + 0.5 * length) / before.rate
    x, effect = ((y - y.mean()) / unit.scale for y in (before.stage.x, before.stage.x - after.stage.x))
    mean = np.add.reduceat(x, edges) / length
    name = f"means of {before.n / len(edges) / before.rate:.2g} s, before"
    panel.plot(time, mean, "o", color=POINTS, markersize=2.4, markeredgewidth=0.0, label=name)
    panel.plot(
        np.arange(before.n)[:: max(before.n // 5000, 1)] / before.rate,
        effect[:: max(before.n // 5000, 1)],
        color=_BEFORE,
        linewidth=1.2,
        label="effect",
    )
    quantity = "rate" if before.axis.sensor == "gyro" else "acceleration"
    _finish(panel, f"{quantity} − mean [{unit.name}]")


def _draw_correlation(panel: Axes, records: list[StageResiduals]) -> None:
    """Draw the correlation of the axes' whitened coefficients in bins, and the band of simulations."""
    n, rate = records[0].n, records[0].rate
    edges = octave_bins(n)[::_MERGED]
    first, count = edges[:-1] - 1, np.diff(edges)
    frequency = (edges[:-1] + edges[1:] - 1) * rate / (4.0 * n)
    enough = count >= _LEAST
    spread = 1.96 / np.sqrt(count[enough])
    panel.fill_between(
        frequency[enough],
        -spread,
        spread,
        color=_AFTER,
        alpha=0.2,
        linewidth=0.0,
        label="95 % of simulations",
    )
    for one, other in itertools.combinations(records, 2):
        products = (
            np.add.reduceat(a * b, first)
            for a, b in (
                (one.whitened_coefficients, other.whitened_coefficients),
                (one.whitened_coefficients, one.whitened_coefficients),
                (other.whitened_coefficients, other.whitened_coefficients),
            )
        )
        cross, first_power, second_power = products
        r = (cross / np.sqrt(first_power * second_power))[enough]
        panel.plot(
            frequency[enough],
            r,
            "o-",
            markersize=2.4,
            linewidth=0.8,
            label=f"{one.axis.name}, {other.axis.name}",
        )
    panel.axhline(0.0, color="0.5", linewidth=0.6)
    panel.set(xscale="log", xlabel="frequency f [Hz]", ylabel="correlation of whitened residuals [1]")
    panel.legend(frameon=False, fontsize=7.5)


def _draw_spectrum(panel: Axes, record: StageResiduals, finding: Finding) -> None:
    """Draw the whitened spectrum around the effect's frequencies."""
    low, high = finding.span
    nyquist, width = 0.5 * record.rate, finding.span[1] - finding.span[0]
    shown = (max(low - _MARGIN * width, 0.0), min(high + _MARGIN * width, nyquist))
    frequency = np.arange(1, record.n) * record.rate / (2.0 * record.n)
    near = (shown[0] <= frequency) & (frequency <= shown[1])
    power, f = record.whitened_coefficients[near] ** 2, frequency[near]
    edges = np.unique(np.linspace(0, len(f), min(_POINTS, len(f)) + 1).astype(int))[:-1]
    # Where many coefficients share a point, the largest of a line: it must not be averaged away.
    line = finding.cause == "sinusoid"
    total = np.add.reduceat(power, edges) / np.diff(np.append(edges, len(f)))
    shown_power = np.maximum.reduceat(power, edges) if line else total
    panel.plot(f[edges], shown_power, color=POINTS, linewidth=0.8, label="measured before")
    panel.axhline(1.0, color=_AFTER, linewidth=1.0, label="simulated, mean")
    if width < _EVERYWHERE * nyquist:
        panel.axvspan(low, high, color=_SPAN, alpha=0.25, linewidth=0.0, label="effect", zorder=0)
    panel.set(
        xlabel="frequency f [Hz]", ylabel=f"power over its expectation{', largest' if line else ''} [1]"
    )
    panel.set_yscale("log")
    panel.set_ylim(bottom=max(panel.get_ylim()[0], 0.1))
    panel.legend(frameon=False, fontsize=7.5)


def _draw_text(panel: Axes, finding: Finding, axis: Axis) -> None:
    panel.set_axis_off()
    lines = [sentence(finding), ""]
    if finding.cause != "unexplained":
        lines.append(f"{p_value(finding.p_value)}, evidence {finding.evidence:,.0f} nats")
        lines += changes(finding, axis)
        mended = [pair for pair in finding.discrepancies if pair[0].p_value < UNEXPLAINED]
        lines += ["", "before → after:"] if mended else []
        for before, after in sorted(mended, key=lambda pair: pair[0].p_value)[:_TOLD]:
            lines.append(f"{what(before)} → {format_remainder(before, after)}")
    text = literal("\n".join(wrap(line, _COLUMNS) for line in lines))
    written = panel.text(0.0, 1.0, text, va="top", transform=panel.transAxes, linespacing=1.35)
    written.set_in_layout(False)

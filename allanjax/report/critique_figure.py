"""Figures of a critique: the measurement and its simulations, before and after each finding."""

from __future__ import annotations

import functools
import itertools
import os
from collections.abc import Callable, Collection, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Int
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from allanjax.base.normal import TWO_SIDED_95
from allanjax.base.tables import wrapped
from allanjax.base.wording import plain
from allanjax.critic.comparison import StageResiduals, octave_bins, summaries
from allanjax.critic.finding import Finding
from allanjax.critic.merging import EVENT, OUTLIERS
from allanjax.critic.parameters import values_of
from allanjax.critic.result import AxisCritique, Critique
from allanjax.record.recording import Axis
from allanjax.report.critique_story import (
    UNEXPLAINED,
    changes,
    format_remainder,
    sentence,
    significance,
    what,
)
from allanjax.report.figure import (
    CLUSTER_TIME,
    COLOURS,
    FONT_SIZE,
    FREQUENCY,
    TIME,
    Heading,
    Sheet,
    band_entry,
    dots,
    dress,
    facts_of,
    ink,
    label_in,
    literal,
    mark_off_scale,
    save,
    style,
    unit_of,
)
from allanjax.spectrum.psd import density_unit


class Job(NamedTuple):
    """Figure to be drawn: of a finding, None for an axis without; in which axis; if by request only."""

    finding: Finding | None
    axis: str
    is_extra: bool = False

    def is_wanted(self, findings: Collection[Finding] | None) -> bool:
        """Whether it is among the findings that were asked for."""
        return not self.is_extra if findings is None else self.finding in findings


def jobs(critique: Critique) -> list[Job]:
    """Figures of the findings in their order, of axes without, and of parts of findings of several axes."""
    listed = critique.findings
    clean = [Job(None, axis.axis.name) for axis in critique.results if not axis.findings]
    extra = [Job(f, f.axes[0], True) for axis in critique.results for f in axis.findings if f not in listed]
    return [*(Job(f, f.shown) for f in listed), *clean, *extra]


def figure_names(critique: Critique) -> tuple[str, ...]:
    """File names of a critique's figures, numbered where a cause was found several times."""
    return file_names(critique, [job for job in jobs(critique) if not job.is_extra])


def file_names(critique: Critique, jobs: Sequence[Job]) -> tuple[str, ...]:
    """Names after the axis that is shown, or the axes that share what was found, and the cause."""
    names: list[str] = []
    for finding, axis, _ in jobs:
        where = "_".join(finding.axes) if finding in critique.shared_findings and finding else axis
        names.append(where if finding is None else f"{where}_{finding.cause}")
    earlier = [names[:k].count(name) for k, name in enumerate(names)]
    start = critique.name or "recording"
    return tuple(
        f"{start}_{name}{f'_{k + 1}' if k else ''}.png" for name, k in zip(names, earlier, strict=True)
    )


_AFTER, _SPAN, _BEFORE = COLOURS[0], COLOURS[1], COLOURS[3]
# Style of a band in which simulations or an effect lie.
_BAND: dict[str, Any] = {"alpha": 0.25, "linewidth": 0.0}
# A record, what is said of it, its colour and its marker.
_Stage = tuple[StageResiduals, str, str, str]
_SHEET = Sheet(3.9, 2.5, gap=1.0, between=1.0)
# Characters in a line of the text.
_COLUMNS = 58
# Points that a series is thinned to.
_POINTS = 600
# Widths of a span that are drawn on either side of it; share of the record from which on it is not marked.
_MARGIN = 4.0
_EVERYWHERE = 0.95
# Most discrepancies that are listed of those that a finding removed.
_LISTED = 3
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
    """Draw one figure per finding, and one for each axis without findings.

    Panels: Allan deviation and power spectral density, measured (points) and where 95 % of simulations lie
    (bands), before the finding and after; the place of the effect; and its description. Allan
    deviations are those of the record continued by its mirror image (the total deviation), without a ramp.

    A finding in several axes is drawn in that in which it matters most. The figures are not pyplot's, so that
    no number of them is too many.

    Args:
        critique: what `critique` returns.
        path: where to save them, as NAME_gyro_x_sinusoid.png; it is made if need be.
        findings: some of the critique's or of its axes', if only their figures are wanted.

    Returns:
        The matplotlib figures.
    """
    if path is not None:
        Path(path).mkdir(parents=True, exist_ok=True)
    drawn = [job for job in jobs(critique) if job.is_wanted(findings)]
    names = file_names(critique, drawn)
    # Axis by axis, since the curves of an axis are used again.
    order = sorted(range(len(drawn)), key=lambda k: critique.axes.index(drawn[k].axis))
    figures: dict[int, Figure] = {}
    axis, record = "", None
    with style():
        for k in order:
            if record is None or drawn[k].axis != axis:
                axis = drawn[k].axis
                record = functools.lru_cache(maxsize=2)(functools.partial(_record, critique, critique[axis]))
            figures[k] = _draw(critique, drawn[k], record)
            if path is not None:
                save(figures[k], Path(path) / names[k])
    return tuple(figures[k] for k in range(len(drawn)))


def _draw(critique: Critique, job: Job, record: Callable[[int], StageResiduals]) -> Figure:
    """Figure of a job; `record` gives the axis at a stage."""
    axis, finding = critique[job.axis], job.finding
    if finding is None:
        return _of_clean(critique, axis, record)
    if finding in critique.shared_findings:
        return _of_shared(critique, finding)
    own = next(f for f in (finding, finding.strongest) if f in axis.findings)
    k = axis.findings.index(own)
    return _of_finding(critique, finding, own, record, (k, min(k + 1, len(axis.stages) - 1)))


def _record(critique: Critique, axis: AxisCritique, stage: int) -> StageResiduals:
    """Residuals of an axis at a stage."""
    return StageResiduals(axis.axis, 1.0, critique.rate, axis.stages[stage])


def _of_finding(
    critique: Critique,
    finding: Finding,
    own: Finding,
    record: Callable[[int], StageResiduals],
    stages: tuple[int, int],
) -> Figure:
    """Figure of a finding, of which `own` is what was found in the axis that is shown."""
    before, after = (record(k) for k in stages)
    shown = [(before, "", _AFTER, "o")]
    if before is not after:
        shown = [(before, "before", _BEFORE, "o"), (after, "after", _AFTER, "s")]
    figure, _, effect = _four_panels(critique, finding, shown)
    draw = _draw_spectrum if finding.domain == "frequency" else _EFFECTS.get(finding.cause, _draw_path)
    # Single samples and frequencies are those of the axis.
    is_own = finding.cause == OUTLIERS or finding.domain == "frequency"
    draw(effect, before, after, own if is_own else finding)
    return figure


def _of_shared(critique: Critique, finding: Finding) -> Figure:
    """Figure of a finding that axes share, with the curves of the first axis."""
    records = [_record(critique, critique[name], -1) for name in finding.axes]
    figure, _, effect = _four_panels(critique, finding, [(records[0], "", _AFTER, "o")])
    _draw_correlation(effect, records)
    return figure


def _of_clean(critique: Critique, axis: AxisCritique, stage: Callable[[int], StageResiduals]) -> Figure:
    stages = [(stage(0), "", _AFTER, "o")]
    figure, (panels,) = _panels(critique, f"{axis.axis.name}: no finding", stages, [2])
    _draw_curves(panels, stages, axis.axis)
    return figure


def _four_panels(critique: Critique, finding: Finding, stages: Sequence[_Stage]) -> tuple[Figure, Axes, Axes]:
    """Figure with both curves and the description; its Allan panel, and the empty one for the effect."""
    record = stages[0][0]
    title = f"{', '.join(finding.axes)}: {finding.named(finding.cause)}"
    figure, ((allan, psd), (effect, text)) = _panels(critique, title, stages, [2, 2])
    _draw_curves((allan, psd), stages, record.axis)
    _draw_text(text, finding, record.axis)
    return figure, allan, effect


def _panels(
    critique: Critique, title: str, stages: Sequence[_Stage], rows: Sequence[int]
) -> tuple[Figure, list[list[Axes]]]:
    """Figure that pyplot knows nothing of, with its heading and the key of the curves, and its panels."""
    key = []
    for _, label, colour, marker in stages:
        end = f" {label}" if label else ""
        key += [_measured(label, colour, marker), band_entry(f"95 % of simulations{end}", colour, 0.25)]
    record = stages[0][0]
    name = f"{critique.name}, {title}" if critique.name else title
    figure, panels = _SHEET.draw(Heading(name, facts_of(record.n, critique.rate), key), rows, Figure)
    FigureCanvasAgg(figure)
    return figure, panels


def _measured(label: str, colour: str, marker: str) -> Line2D:
    """Entry of the key for the measured points of a stage."""
    end = f" {label}" if label else ""
    shown = colour if label == "after" else ink(0.3)
    return Line2D([], [], label=f"measured{end}", **dots(marker=marker, color=shown))


def _draw_curves(panels: Sequence[Axes], stages: Sequence[_Stage], axis: Axis) -> None:
    """Draw both curves of every stage, points being measured and bands simulated."""
    units = (unit_of(axis), density_unit(axis))
    names = ((CLUSTER_TIME, "Allan deviation"), (FREQUENCY, "one-sided PSD"))
    for panel, (unit, _), (x_label, y_label) in zip(panels, units, names, strict=True):
        name = axis.name if panel is panels[0] else ""
        dress(panel, name, x_label, label_in(y_label, unit), log="xy")
    medians, points = [], []
    for record, label, colour, marker in stages:
        entry = _measured(label, colour, marker)
        look = dots(marker=marker, color=entry.get_color(), label=entry.get_label(), zorder=3)
        for panel, (_, scale), curve in zip(panels, units, summaries(record), strict=True):
            x, median, y = curve.place, curve.median / scale, curve.measured / scale
            panel.fill_between(x, curve.low / scale, curve.high / scale, color=colour, **_BAND)
            panel.plot(x, median, color=colour, linewidth=1.0)
            panel.plot(x, y, **look)
        medians.append(median)
        points.append((x, y, entry.get_color()))
    # Those of the PSD limit its vertical scale.
    low, high = panels[1].get_ylim()
    middle = np.concatenate(medians)
    panels[1].set_ylim(max(low, middle.min() / _BELOW), min(high, middle.max() * _ABOVE))
    for x, y, shown in points:
        mark_off_scale(panels[1], x, y, shown)


def _add_key(panel: Axes) -> None:
    """Write the key of a panel above it."""
    panel.legend(
        frameon=False,
        fontsize=FONT_SIZE - 1.0,
        loc="lower left",
        bbox_to_anchor=(0.0, 1.0),
        ncols=4,
        borderaxespad=0.2,
        borderpad=0.0,
        columnspacing=1.2,
        handlelength=1.5,
    )


def _around(span: tuple[float, float], end: float, least: float = 0.0) -> tuple[float, float]:
    """What is shown around a span, whose width is taken to be `least` at least, between 0 and the end."""
    margin = _MARGIN * max(span[1] - span[0], least)
    return max(span[0] - margin, 0.0), min(span[1] + margin, end)


def _shade(panel: Axes, span: tuple[float, float], total: float) -> None:
    """Mark the span of an effect, unless that is nearly everywhere."""
    if span[1] - span[0] < _EVERYWHERE * total:
        panel.axvspan(*span, color=_SPAN, label="effect", zorder=0, **_BAND)


def _blocks(length: int, most: int) -> tuple[Int[np.ndarray, " blocks"], Int[np.ndarray, " blocks"]]:
    """First samples of about equal blocks, and the blocks' lengths."""
    edges = np.unique(np.linspace(0, length, min(most, length) + 1).astype(int))
    return edges[:-1], np.diff(edges)


def _finish(panel: Axes, ylabel: str) -> None:
    dress(panel, x=TIME, y=ylabel)
    _add_key(panel)


def _draw_extremes(panel: Axes, record: StageResiduals, after: StageResiduals, finding: Finding) -> None:
    """Draw mean and extremes of blocks of the whitened residuals, and single outliers."""
    duration = record.n / record.rate
    shown = _around(finding.span, duration, 0.01 * duration)
    first, last = (int(np.clip(round(t * record.rate), 0, record.n)) for t in shown)
    e = record.whitened[first:last]
    edges, length = _blocks(len(e), _POINTS)
    time = (first + edges + 0.5 * length) / record.rate
    low, high = np.minimum.reduceat(e, edges), np.maximum.reduceat(e, edges)
    panel.fill_between(time, low, high, color=ink(0.75), linewidth=0.5, label="range of samples")
    panel.plot(time, np.add.reduceat(e, edges) / length, color=_AFTER, linewidth=0.9, label="mean")
    if "times" in finding.details:
        t = np.array(values_of(finding.details["times"])[0], float)
        k = np.clip(np.rint(t * record.rate).astype(int), 0, record.n - 1)
        panel.plot(t, record.whitened[k], "o", mfc="none", mec=_BEFORE, markersize=4.0, label="outliers")
    else:
        _shade(panel, finding.span, duration)
    _finish(panel, label_in("whitened residual", "σ"))


def _draw_loudness(panel: Axes, record: StageResiduals, after: StageResiduals, finding: Finding) -> None:
    """Draw the root mean square of the whitened residuals in blocks, and the band of simulations."""
    edges, length = _blocks(record.n, _BLOCKS)
    time = (edges + 0.5 * length) / record.rate
    rms = np.sqrt(np.add.reduceat(record.whitened**2, edges) / length)
    spread = TWO_SIDED_95 * np.sqrt(0.5 / length)
    band = {"color": _AFTER, "label": "95 % of simulations", **_BAND}
    panel.fill_between(time, 1.0 - spread, 1.0 + spread, **band)
    panel.plot(time, rms, label="measured", **dots())
    _shade(panel, finding.span, record.n / record.rate)
    _finish(panel, label_in("rms of\nwhitened residuals", "σ"))


def _draw_samples(panel: Axes, record: StageResiduals, after: StageResiduals, finding: Finding) -> None:
    """Draw single samples as recorded, where most of them equal the one before."""
    unit, scale = unit_of(record.axis)
    x = record.stage.x
    same = np.concatenate([[0], np.cumsum(x[1:] == x[:-1])])
    length = min(_SHOWN_SAMPLES, record.n)
    first = int(np.argmax(same[length - 1 :] - same[: record.n - length + 1]))
    time = np.arange(first, first + length) / record.rate
    y = (x[first : first + length] - x.mean()) / scale
    panel.step(time, y, where="mid", color=ink(0.75), linewidth=0.7)
    panel.plot(time, y, label="samples as recorded", **dots())
    _finish(panel, label_in("samples − mean", unit))


def _draw_path(panel: Axes, before: StageResiduals, after: StageResiduals, finding: Finding) -> None:
    """Draw means of blocks of samples, and the effect that was found."""
    unit, scale = unit_of(before.axis)
    edges, length = _blocks(before.n, _BLOCKS)
    time = (edges + 0.5 * length) / before.rate
    x, effect = ((y - y.mean()) / scale for y in (before.stage.x, before.stage.x - after.stage.x))
    name = f"means of {plain(before.n / len(edges) / before.rate, 2)} s"
    panel.plot(time, np.add.reduceat(x, edges) / length, label=name, **dots())
    some = np.arange(before.n)[:: max(before.n // 5000, 1)]
    panel.plot(some / before.rate, effect[some], color=_BEFORE, linewidth=1.2, label="effect")
    quantity = "rate" if before.axis.sensor == "gyro" else "acceleration"
    _finish(panel, label_in(f"{quantity} − mean", unit))


def _draw_spectrum(panel: Axes, record: StageResiduals, after: StageResiduals, finding: Finding) -> None:
    """Draw the whitened spectrum around the effect's frequencies."""
    nyquist = 0.5 * record.rate
    lowest, highest = _around(finding.span, nyquist)
    frequency = np.arange(1, record.n) * record.rate / (2.0 * record.n)
    near = (lowest <= frequency) & (frequency <= highest)
    power, f = record.whitened_coefficients[near] ** 2, frequency[near]
    edges, length = _blocks(len(f), _POINTS)
    # Where many coefficients share a point, the largest of a line: it must not be averaged away.
    line = finding.cause == "sinusoid"
    shown = np.maximum.reduceat(power, edges) if line else np.add.reduceat(power, edges) / length
    panel.plot(f[edges], shown, color=ink(0.3), linewidth=0.8, label="measured")
    panel.axhline(1.0, color=_AFTER, linewidth=1.0, label="simulated, mean")
    _shade(panel, finding.span, nyquist)
    panel.set_yscale("log")
    panel.set_ylim(bottom=max(panel.get_ylim()[0], 0.1))
    dress(panel, x=FREQUENCY, y=f"{'largest ' if line else ''}power\nover its expectation", log="y")
    _add_key(panel)


# What shows a cause, if not means of samples or a spectrum.
_EFFECTS = {
    "variance_change": _draw_loudness,
    **dict.fromkeys(("outliers", "disturbance", EVENT, "unexplained"), _draw_extremes),
    **dict.fromkeys(("rounding", "saturation", "repeated_samples"), _draw_samples),
}


def _draw_correlation(panel: Axes, records: list[StageResiduals]) -> None:
    """Draw the correlation of the axes' whitened coefficients in bins, and the band of simulations."""
    n, rate = records[0].n, records[0].rate
    edges = octave_bins(n)[::_MERGED]
    first, count = edges[:-1] - 1, np.diff(edges)
    enough = count >= _LEAST
    frequency = ((edges[:-1] + edges[1:] - 1) * rate / (4.0 * n))[enough]
    spread = TWO_SIDED_95 / np.sqrt(count[enough])
    panel.fill_between(
        frequency, -spread, spread, color=_AFTER, alpha=0.2, linewidth=0.0, label="95 % of simulations"
    )
    for one, other in itertools.combinations(records, 2):
        a, b = one.whitened_coefficients, other.whitened_coefficients
        cross, power, other_power = (np.add.reduceat(product, first) for product in (a * b, a * a, b * b))
        r = (cross / np.sqrt(power * other_power))[enough]
        name = f"{one.axis.name}, {other.axis.name}"
        panel.plot(frequency, r, "o-", markersize=2.4, linewidth=0.8, label=name)
    panel.axhline(0.0, color=ink(0.5), linewidth=0.6)
    dress(panel, x=FREQUENCY, y="correlation\nof whitened residuals", log="x")
    _add_key(panel)


def _draw_text(panel: Axes, finding: Finding, axis: Axis) -> None:
    panel.set_axis_off()
    lines = [sentence(finding), ""]
    if finding.cause != "unexplained":
        evidence = "" if finding.evidence is None else f"evidence {finding.evidence:,.0f} nats"
        test = significance(finding)
        lines.append(", ".join(text for text in ("" if test in lines[0] else test, evidence) if text))
        lines += changes(finding, axis)
        mended = [pair for pair in finding.discrepancies if pair[0].p_value < UNEXPLAINED]
        lines += ["", "before → after:"] if mended else []
        for before, after in sorted(mended, key=lambda pair: pair[0].p_value)[:_LISTED]:
            lines.append(f"{what(before)} → {format_remainder(before, after)}")
    text = literal("\n".join(wrapped(line, _COLUMNS, rest="") for line in lines))
    written = panel.text(0.0, 1.0, text, va="top", transform=panel.transAxes, linespacing=1.35)
    written.set_in_layout(False)

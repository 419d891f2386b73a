"""Figures of a critique: the measurement and its simulations, with each finding and without it."""

from __future__ import annotations

import dataclasses
import functools
import itertools
import os
from collections import Counter
from collections.abc import Callable, Collection, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.stats import norm

from allanjax.base.normal import TWO_SIDED_95
from allanjax.base.tables import wrapped
from allanjax.base.wording import plain
from allanjax.critic.finding import EVENT, OUTLIERS, UNEXPLAINED, Finding, numbers_in
from allanjax.critic.profiles import Curve, summaries
from allanjax.critic.result import Critique
from allanjax.critic.stage import Stage, octave_bins
from allanjax.presentation import draw
from allanjax.presentation.critique_story import (
    sentence,
)
from allanjax.presentation.draw import Heading, Sheet
from allanjax.record.recording import Axis
from allanjax.spectrum.psd import density_unit


def _named(critique: Critique, findings: Collection[Finding] | None) -> dict[str, tuple[Finding | None, str]]:
    """Findings in their order, or None for each axis, each with the axis that is shown, by file names.

    Findings may be parts of those of the recording. Names are after the axis that is shown, or the axes that
    share what was found, and the cause; numbered where a cause was found several times.
    """
    if findings is None:
        return {f"{critique.name or 'recording'}_{axis}": (None, axis) for axis in critique.axes}
    listed = critique.findings
    pairs = [(finding, finding.shown) for finding in listed]
    pairs += [(f, f.axes[0]) for axis in critique.results for f in axis.findings if f not in listed]
    named, count = dict[str, tuple[Finding | None, str]](), Counter[str]()
    for finding, axis in (pair for pair in pairs if pair[0] in findings):
        where = "_".join(finding.axes) if finding in critique.shared_findings else axis
        name = f"{critique.name or 'recording'}_{where}_{finding.cause}"
        count[name] += 1
        named[f"{name}_{count[name]}" if count[name] > 1 else name] = finding, axis
    return named


_AFTER, _SPAN, _BEFORE = draw.COLOURS[0], draw.COLOURS[1], draw.COLOURS[3]
_SHEET = Sheet(3.9, 2.5, gap=1.0, between=1.0)
# Characters in a line of the text, and the height of a line [inches].
_COLUMNS, _LINE = 58, 0.17
# Ends [σ] and number of the classes of a histogram.
_WIDE, _CLASSES = 6.0, 96
# Points that a series is thinned to.
_POINTS = 600
# Widths of a span that are drawn on either side of it; share of the record from which on it is not marked.
_MARGIN = 4.0
_EVERYWHERE = 0.95
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
    """Draw one figure per axis, or one for each of some findings.

    Panels: Allan deviation and power spectral density, measured (points) and where 95 % of simulations lie
    (bands), of the plain model and with all findings. Those of a finding are without it and with it; two more
    panels show the place of the effect, and its description. Allan deviations are those of the record
    continued by its mirror image (the total deviation), without a ramp.

    A finding in several axes is drawn in that in which it matters most. The figures are not pyplot's, so that
    no number of them is too many.

    Args:
        critique: what `critique` returns.
        path: where to save them, as NAME_gyro_x.png or NAME_gyro_x_sinusoid.png; it is made if need be.
        findings: some or all of the critique's or of its axes' findings, of which figures are wanted.
    """
    return tuple(critique_figures(critique, path, findings).values())


def critique_figures(
    critique: Critique,
    path: str | os.PathLike[str] | None = None,
    findings: Collection[Finding] | None = None,
    suffix: str = "png",
) -> dict[str, Figure]:
    """Figures of a critique by the names of their files with this suffix; see `plot_critique`."""
    shown = _named(critique, findings)

    @functools.lru_cache(maxsize=2)
    def record(axis: str, stage: int) -> Stage:
        """An axis at a stage; a copy, as the critique shall not keep the arrays that figures need."""
        return dataclasses.replace(critique[axis].stages[stage])

    with draw.style():
        # Axis by axis, since the curves of an axis are used again.
        names = sorted(shown, key=lambda name: critique.axes.index(shown[name][1]))
        drawn = {name: _draw(critique, *shown[name], record) for name in names}
    figures = {f"{name}.{suffix}": drawn[name] for name in shown}
    if path is not None:
        Path(path).mkdir(parents=True, exist_ok=True)
        for name, figure in figures.items():
            draw.saved(figure, Path(path) / name)
    return figures


class _Shown(NamedTuple):
    """An axis at a stage, and what its points and its band are; "" if they are not drawn."""

    record: Stage
    measured: str = "measured"
    simulated: str = "95 % of simulations"
    colour: str = _AFTER
    marker: str = "o"

    def points(self) -> dict[str, Any]:
        """Style of the measured points."""
        colour = draw.ink(0.3) if self.measured == "measured" else self.colour
        return draw.dots(marker=self.marker, color=colour, label=self.measured)


def _both(before: Stage, after: Stage, less: str, without: str, having: str) -> list[_Shown]:
    """An axis without something and with it: two measured curves, or two simulated ones, or both."""
    same_noise = before.powers == after.powers and before.factor is after.factor
    measured = "" if before.same_record(after) else f"measured, less {less}"
    first = "" if same_noise else f"95 % of simulations {without}"
    second = "95 % of simulations" if same_noise else f"95 % of simulations {having}"
    return [_Shown(before, simulated=first, colour=_BEFORE), _Shown(after, measured, second, _AFTER, "s")]


def _draw(
    critique: Critique, finding: Finding | None, axis: str, record: Callable[[str, int], Stage]
) -> Figure:
    """Figure of a finding, or of an axis without; `record` gives an axis at a stage."""
    if finding is None:
        stages = [_Shown(record(axis, 0))]
        if critique[axis].findings:
            ends = record(axis, 0), record(axis, -1)
            stages = _both(*ends, "what was found", "of the plain model", "with all findings")
        return _panels(critique, stages)[0]
    if finding in critique.shared_findings:
        # With the curves of the first axis.
        records = [record(name, -1) for name in finding.axes]
        figure, effect = _panels(critique, [_Shown(records[0])], finding)
        _draw_correlation(effect, records)
        return figure
    own = next(f for f in (finding, finding.strongest) if f in critique[axis].findings)
    after = record(axis, -1)
    before, stages = after, [_Shown(after)]
    if own.stage >= 0:
        before = record(axis, own.stage)
        stages = _both(before, after, "the effect", "without it", "with it")
    figure, effect = _panels(critique, stages, finding)
    cause = str(finding.details.get("domain", finding.cause))
    draw_effect = _draw_spectrum if finding.domain == "frequency" else _EFFECTS.get(cause, _draw_path)
    # Single samples and frequencies are those of the axis.
    is_own = finding.cause == OUTLIERS or finding.domain == "frequency"
    draw_effect(effect, before, after, own if is_own else finding)
    return figure


def _panels(
    critique: Critique, stages: Sequence[_Shown], finding: Finding | None = None
) -> tuple[Figure, Axes]:
    """Figure that pyplot knows nothing of, with both curves; and the last panel.

    For a finding that is the empty one for its effect, with the description beside it.
    """
    key = []
    for stage in stages:
        key += [draw.line_entry(**stage.points())] if stage.measured else []
        key += [draw.band_entry(stage.simulated, stage.colour, 0.25)] if stage.simulated else []
    record, lines, sheet = stages[0].record, [], _SHEET
    count = len(critique[record.axis.name].findings)
    title = f"{record.axis.name}: {count or 'no'} finding{'' if count == 1 else 's'}"
    if finding is not None:
        title = f"{', '.join(finding.axes)}: {finding.named(finding.cause)}"
        lines = _description(finding)
        below = max(sheet.bottom, _LINE * (len(lines) + 1) - sheet.height)
        sheet = dataclasses.replace(sheet, bottom=below)
    name = f"{critique.name}, {title}" if critique.name else title
    heading = Heading(name, draw.facts_of(record.n, critique.rate), key)
    figure, panels = sheet.draw(heading, [2, 1] if finding else [2], None, single=False)
    _draw_curves(panels[0], stages, record.axis)
    if finding is not None:
        left, top = panels[0][1].get_position().x0, panels[1][0].get_position().y1
        figure.text(left, top, draw.literal("\n".join(lines)), va="top", linespacing=1.35)
    return figure, panels[-1][0]


def _draw_curves(panels: Sequence[Axes], stages: Sequence[_Shown], axis: Axis) -> None:
    """Draw both curves of every stage, points being measured and bands simulated."""
    units = (draw.unit_of(axis), density_unit(axis))
    names = ((axis.name, draw.CLUSTER_TIME, "Allan deviation"), ("", draw.FREQUENCY, "one-sided PSD"))
    curves = zip(*(summaries(stage.record) for stage in stages), strict=True)
    for panel, (unit, scale), (name, x, y), shown in zip(panels, units, names, curves, strict=True):
        draw.dress(panel, name, x, draw.label_in(y, unit), log="xy")
        own = [Curve(c.place, *(values / scale for values in c[1:])) for c in shown]
        for stage, c in zip(stages, own, strict=True):
            if stage.simulated:
                panel.fill_between(c.place, c.low, c.high, **draw.band(stage.colour))
                panel.plot(c.place, c.median, color=stage.colour, linewidth=1.0)
            if stage.measured:
                panel.plot(c.place, c.measured, zorder=3, **stage.points())
    # The medians of the PSD limit its vertical scale.
    low, high = panels[1].get_ylim()
    middle = np.concatenate([c.median for c in own])
    panels[1].set_ylim(max(low, middle.min() / _BELOW), min(high, middle.max() * _ABOVE))
    for stage, c in zip(stages, own, strict=True):
        if not stage.measured:
            continue
        draw.mark_off_scale(panels[1], c.place, c.measured, stage.points()["color"])


def _finish(panel: Axes, y: str, x: str = draw.TIME, log: str = "") -> None:
    """Label a panel, with its key above it."""
    draw.dress(panel, x=x, y=y, log=log)
    look: dict[str, Any] = {"frameon": False, "fontsize": draw.FONT_SIZE - 1.0, "handlelength": 1.5}
    place: dict[str, Any] = {"loc": "lower left", "bbox_to_anchor": (0.0, 1.0), "borderaxespad": 0.2}
    panel.legend(ncols=4, borderpad=0.0, columnspacing=1.2, **look, **place)


def _around(span: tuple[float, float], end: float, least: float = 0.0) -> tuple[float, float]:
    """What is shown around a span, whose width is taken to be `least` at least, between 0 and the end."""
    margin = _MARGIN * max(span[1] - span[0], least)
    return max(span[0] - margin, 0.0), min(span[1] + margin, end)


def _shade(panel: Axes, span: tuple[float, float], total: float) -> None:
    """Mark the span of an effect, unless that is nearly everywhere."""
    if span[1] - span[0] < _EVERYWHERE * total:
        panel.axvspan(*span, **draw.band(_SPAN, label="effect", zorder=0))


def _draw_extremes(panel: Axes, record: Stage, after: Stage, finding: Finding) -> None:
    """Draw mean and extremes of blocks of the whitened residuals, and single outliers."""
    duration = record.n / record.rate
    shown = _around(finding.span, duration, 0.01 * duration)
    first, last = (int(np.clip(round(t * record.rate), 0, record.n)) for t in shown)
    e = record.whitened[first:last]
    edges, length = draw.blocks(len(e), _POINTS)
    time = (first + edges + 0.5 * length) / record.rate
    low, high = np.minimum.reduceat(e, edges), np.maximum.reduceat(e, edges)
    panel.fill_between(time, low, high, color=draw.ink(0.75), linewidth=0.5, label="range of samples")
    panel.plot(time, np.add.reduceat(e, edges) / length, color=_AFTER, linewidth=0.9, label="mean")
    if t := numbers_in(finding.details, "times"):
        k = np.clip(np.rint(np.array(t) * record.rate).astype(int), 0, record.n - 1)
        panel.plot(t, record.whitened[k], "o", mfc="none", mec=_BEFORE, markersize=4.0, label="outliers")
    else:
        _shade(panel, finding.span, duration)
    _finish(panel, draw.label_in("whitened residual", "σ"))


def _draw_loudness(panel: Axes, record: Stage, after: Stage, finding: Finding) -> None:
    """Draw the root mean square of the whitened residuals in blocks, and the band of simulations."""
    edges, length = draw.blocks(record.n, _BLOCKS)
    time = (edges + 0.5 * length) / record.rate
    rms = np.sqrt(np.add.reduceat(record.whitened**2, edges) / length)
    spread = TWO_SIDED_95 * np.sqrt(0.5 / length)
    look = draw.band(_AFTER, label="95 % of simulations")
    panel.fill_between(time, 1.0 - spread, 1.0 + spread, **look)
    panel.plot(time, rms, label="measured", **draw.dots())
    _shade(panel, finding.span, record.n / record.rate)
    _finish(panel, draw.label_in("rms of\nwhitened residuals", "σ"))


def _draw_distribution(panel: Axes, record: Stage, after: Stage, finding: Finding) -> None:
    """Draw the histogram of the whitened residuals over that of simulations."""
    e = record.whitened
    edges = np.linspace(-_WIDE, _WIDE, _CLASSES + 1)
    counts = np.histogram(e, edges)[0]
    expected = record.n * np.diff(norm.cdf(edges))
    middle = 0.5 * (edges[1:] + edges[:-1])
    spread = TWO_SIDED_95 * np.sqrt(expected)
    low = np.maximum(expected - spread, 1e-3)
    panel.fill_between(middle, low, expected + spread, **draw.band(_AFTER, label="95 % of simulations"))
    panel.plot(middle[counts > 0], counts[counts > 0], label="measured", **draw.dots())
    panel.set_yscale("log")
    panel.set_ylim(bottom=0.5)
    _finish(panel, "samples\nper class", "whitened residual [σ]")


def _draw_samples(panel: Axes, record: Stage, after: Stage, finding: Finding) -> None:
    """Draw single samples as recorded, where most of them equal the one before."""
    unit, scale = draw.unit_of(record.axis)
    x = record.x
    same = np.concatenate([[0], np.cumsum(x[1:] == x[:-1])])
    length = min(_SHOWN_SAMPLES, record.n)
    first = int(np.argmax(same[length - 1 :] - same[: record.n - length + 1]))
    time = np.arange(first, first + length) / record.rate
    y = (x[first : first + length] - x.mean()) / scale
    panel.step(time, y, where="mid", color=draw.ink(0.75), linewidth=0.7)
    panel.plot(time, y, label="samples as recorded", **draw.dots())
    _finish(panel, draw.label_in("samples − mean", unit))


def _draw_path(panel: Axes, before: Stage, after: Stage, finding: Finding) -> None:
    """Draw means of blocks of samples, and the effect that was found."""
    unit, scale = draw.unit_of(before.axis)
    edges, length = draw.blocks(before.n, _BLOCKS)
    time = (edges + 0.5 * length) / before.rate
    x, effect = ((y - y.mean()) / scale for y in (before.x, before.x - after.x))
    name = f"means of {plain(before.n / len(edges) / before.rate, 2)} s"
    panel.plot(time, np.add.reduceat(x, edges) / length, label=name, **draw.dots())
    some = draw.extremes(effect)
    panel.plot(some / before.rate, effect[some], color=_BEFORE, linewidth=1.2, label="effect")
    quantity = "rate" if before.axis.sensor == "gyro" else "acceleration"
    _finish(panel, draw.label_in(f"{quantity} − mean", unit))


def _draw_spectrum(panel: Axes, record: Stage, after: Stage, finding: Finding) -> None:
    """Draw the whitened spectrum around the effect's frequencies."""
    nyquist = 0.5 * record.rate
    lowest, highest = _around(finding.span, nyquist)
    frequency = np.arange(1, record.n) * record.rate / (2.0 * record.n)
    near = (lowest <= frequency) & (frequency <= highest)
    power, f = record.whitened_coefficients[near] ** 2, frequency[near]
    edges, length = draw.blocks(len(f), _POINTS)
    # Where many coefficients share a point, the largest of a line: it must not be averaged away.
    line = finding.cause == "sinusoid"
    shown = np.maximum.reduceat(power, edges) if line else np.add.reduceat(power, edges) / length
    panel.plot(f[edges], shown, color=draw.ink(0.3), linewidth=0.8, label="measured")
    panel.axhline(1.0, color=_AFTER, linewidth=1.0, label="simulated, mean")
    _shade(panel, finding.span, nyquist)
    panel.set_yscale("log")
    panel.set_ylim(bottom=max(panel.get_ylim()[0], 0.1))
    _finish(panel, f"{'largest ' if line else ''}power\nover its expectation", draw.FREQUENCY, "y")


# What shows a cause, if not means of samples or a spectrum.
_EFFECTS = {
    **dict.fromkeys(("variance_change", "level"), _draw_loudness),
    **dict.fromkeys(("outliers", "disturbance", EVENT), _draw_extremes),
    "values": _draw_distribution,
    **dict.fromkeys(("rounding", "saturation", "repeated_samples"), _draw_samples),
}


def _draw_correlation(panel: Axes, records: list[Stage]) -> None:
    """Draw the correlation of the axes' whitened coefficients in bins, and the band of simulations."""
    n, rate = records[0].n, records[0].rate
    edges = octave_bins(n)[::_MERGED]
    first, count = edges[:-1] - 1, np.diff(edges)
    enough = count >= _LEAST
    frequency = ((edges[:-1] + edges[1:] - 1) * rate / (4.0 * n))[enough]
    spread = TWO_SIDED_95 / np.sqrt(count[enough])
    look = draw.band(_AFTER, 0.2, label="95 % of simulations")
    panel.fill_between(frequency, -spread, spread, **look)
    for one, other in itertools.combinations(records, 2):
        a, b = one.whitened_coefficients, other.whitened_coefficients
        cross, power, other_power = (np.add.reduceat(product, first) for product in (a * b, a * a, b * b))
        r = (cross / np.sqrt(power * other_power))[enough]
        name = f"{one.axis.name}, {other.axis.name}"
        panel.plot(frequency, r, "o-", markersize=2.4, linewidth=0.8, label=name)
    panel.axhline(0.0, color=draw.ink(0.5), linewidth=0.6)
    _finish(panel, "correlation\nof whitened residuals", draw.FREQUENCY, "x")


def _description(finding: Finding) -> list[str]:
    """Lines of the text beside the effect."""
    lines = [sentence(finding), ""]
    if finding.cause != UNEXPLAINED:
        lines.append("" if finding.evidence is None else f"log Bayes factor {finding.evidence:,.0f} nats")
    return [part for line in lines for part in wrapped(line, _COLUMNS, rest="").split("\n")]

"""Pictures of a critique: the measurement beside its simulations, before and after each finding."""

from __future__ import annotations

import os
import textwrap
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from allanjax.critique.comparison import Comparison, Whitened, summaries
from allanjax.critique.result import AxisCritique, Critique, Finding
from allanjax.critique.story import changes, describe, p_value, sentence
from allanjax.figure import POINTS, Unit, facts_of, finished, look
from allanjax.recording import Axis
from allanjax.spectrum import density_unit
from allanjax.units import default_coefficient_unit, unit_scale

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_BEFORE, _AFTER = "#D55E00", "#0072B2"
_SPAN = "#E69F00"
_SIZE = (10.0, 7.0)
_COLUMNS = 66
# Points that a series is thinned to.
_POINTS = 600
# A span is drawn with so many times its width on either side, and needs none where it is nearly all there is.
_MARGIN = 4.0
_EVERYWHERE = 0.95
# So many discrepancies after a finding are told.
_TOLD = 3
# Causes that the whitened residuals show better than the samples.
_IN_RESIDUALS = frozenset({"outliers", "variance_change", "disturbance", "repeated_samples"})


def plot_critique(critique: Critique, folder: str | os.PathLike[str] | None = None) -> tuple[Figure, ...]:
    """Draw a figure for every finding, and one for each axis without findings.

    Panels: Allan deviation and power spectral density, measured (points) and where 95 % of simulations lie
    (bands), before the finding and after; the place of the effect; and what is said about it. Allan
    deviations are those of the record continued by its mirror image (the total deviation), without a ramp.

    Args:
        critique: what `critique` returns.
        folder: where to save them, as NAME_gyro_x_sinusoid.png; it is made if need be.

    Returns:
        The matplotlib figures.
    """
    with look():
        figures = []
        for axis in critique:
            records = [_record(critique, axis, k) for k in range(len(axis.stages))]
            for k, finding in enumerate(axis.findings):
                after = records[min(k + 1, len(records) - 1)]
                figures.append(_of_finding(critique, finding, records[k], after))
            if not axis.findings:
                figures.append(_of_clean(critique, axis, records[0]))
        for finding in critique.shared_findings:
            axis = critique[finding.axes[0]]
            first, last = _record(critique, axis, 0), _record(critique, axis, -1)
            figures.append(_of_finding(critique, finding, first, last))
        if folder is not None:
            Path(folder).mkdir(parents=True, exist_ok=True)
        paths = (None if folder is None else Path(folder) / name for name in figure_names(critique))
        return tuple(finished(figure, path) for figure, path in zip(figures, paths, strict=True))


def figure_names(critique: Critique) -> tuple[str, ...]:
    """Names of the files of these figures, numbered where a cause was found several times."""
    names: list[str] = []
    for axis in critique:
        names += [f"{axis.axis.name}_{finding.cause}" for finding in axis.findings] or [axis.axis.name]
    names += [f"{'_'.join(finding.axes)}_{finding.cause}" for finding in critique.shared_findings]
    earlier = [names[:k].count(name) for k, name in enumerate(names)]
    start = critique.name or "recording"
    return tuple(
        f"{start}_{name}{f'_{k + 1}' if k else ''}.png" for name, k in zip(names, earlier, strict=True)
    )


def _record(critique: Critique, axis: AxisCritique, stage: int) -> Whitened:
    return Whitened.of(axis.axis, 1.0, critique.rate, axis.stages[stage])


def _of_finding(critique: Critique, finding: Finding, before: Whitened, after: Whitened) -> Figure:
    import matplotlib.pyplot as plt

    figure, ((allan, psd), (effect, text)) = plt.subplots(2, 2, figsize=_SIZE, layout="constrained")
    _title(figure, critique, f"{', '.join(finding.axes)}: {finding.cause.replace('_', ' ')}", before)
    stages = ((before, "before", _BEFORE, "o"), (after, "after", _AFTER, "s"))
    _draw_curves((allan, psd), stages, before.axis)
    if finding.domain == "time":
        _draw_series(effect, before, finding)
    else:
        _draw_spectrum(effect, before, finding)
    _draw_text(text, finding, before.axis)
    return figure


def _of_clean(critique: Critique, axis: AxisCritique, record: Whitened) -> Figure:
    import matplotlib.pyplot as plt

    figure, panels = plt.subplots(1, 2, figsize=(_SIZE[0], _SIZE[1] / 2.0), layout="constrained")
    _title(figure, critique, f"{axis.axis.name}: nothing found", record)
    _draw_curves(panels, ((record, "", _AFTER, "o"),), axis.axis)
    return figure


def _title(figure: Figure, critique: Critique, text: str, record: Whitened) -> None:
    name = f"{critique.name}, {text}" if critique.name else text
    figure.suptitle(f"{name}\n{facts_of(record.n, critique.rate)}", x=0.01, ha="left", fontsize=11)


def _draw_curves(panels: Any, stages: Any, axis: Axis) -> None:
    """Both curves of every stage: points measured, bands simulated."""
    deviation = default_coefficient_unit(axis.sensor, 0.0)
    units = (Unit(deviation, unit_scale(deviation, axis.sensor)), Unit(*density_unit(axis)))
    names = (("cluster time T [s]", "Allan deviation"), ("frequency f [Hz]", "one-sided PSD"))
    for record, label, colour, marker in stages:
        for panel, unit, comparison in zip(panels, units, summaries(record), strict=True):
            _draw_comparison(panel, comparison, unit, label, colour, marker)
    for panel, unit, (x, y) in zip(panels, units, names, strict=True):
        panel.set(xscale="log", yscale="log", xlabel=x, ylabel=f"{y} [{unit.name}]")
        panel.grid(True, which="major", color="0.88", linewidth=0.6)
        panel.set_axisbelow(True)
        panel.tick_params(which="both", direction="in")
        panel.legend(frameon=False, fontsize=7.5)


def _draw_comparison(
    panel: Axes, comparison: Comparison, unit: Unit, label: str, colour: str, marker: str
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


def _draw_series(panel: Axes, record: Whitened, finding: Finding) -> None:
    """Samples, or whitened residuals, in time: mean and extremes of blocks; the effect's time shaded."""
    residuals = finding.cause in _IN_RESIDUALS
    duration = record.n / record.rate
    start, end = finding.span
    width = max(end - start, 0.01 * duration)
    shown = (max(start - _MARGIN * width, 0.0), min(end + _MARGIN * width, duration))
    first, last = (int(np.clip(round(t * record.rate), 0, record.n)) for t in shown)
    unit = default_coefficient_unit(record.axis.sensor, 0.0)
    y = record.e if residuals else (record.x - record.x.mean()) / unit_scale(unit, record.axis.sensor)
    y = y[first:last]
    edges = np.unique(np.linspace(0, len(y), min(_POINTS, len(y)) + 1).astype(int))[:-1]
    mean = np.add.reduceat(y, edges) / np.diff(np.append(edges, len(y)))
    time = (first + edges + 0.5 * np.diff(np.append(edges, len(y)))) / record.rate
    low, high = np.minimum.reduceat(y, edges), np.maximum.reduceat(y, edges)
    panel.fill_between(time, low, high, color="0.75", linewidth=0.5, label="range of samples")
    panel.plot(time, mean, color=_AFTER, linewidth=0.9, label="mean")
    if end - start < _EVERYWHERE * duration:
        panel.axvspan(start, end, color=_SPAN, alpha=0.25, linewidth=0.0, label="effect", zorder=0)
    panel.set_xlabel("time since start [s]")
    panel.set_ylabel("whitened residual [σ]" if residuals else f"samples before − mean [{unit}]")
    panel.legend(frameon=False, fontsize=7.5)


def _draw_spectrum(panel: Axes, record: Whitened, finding: Finding) -> None:
    """Whitened spectrum around the effect's frequencies."""
    low, high = finding.span
    nyquist, width = 0.5 * record.rate, finding.span[1] - finding.span[0]
    shown = (max(low - _MARGIN * width, 0.0), min(high + _MARGIN * width, nyquist))
    frequency = np.arange(1, record.n) * record.rate / (2.0 * record.n)
    near = (shown[0] <= frequency) & (frequency <= shown[1])
    power, f = record.z[near] ** 2, frequency[near]
    edges = np.unique(np.linspace(0, len(f), min(_POINTS, len(f)) + 1).astype(int))[:-1]
    # Where many coefficients share a point, the largest: a line must not be averaged away.
    panel.plot(
        f[edges], np.maximum.reduceat(power, edges), color=POINTS, linewidth=0.8, label="measured before"
    )
    panel.axhline(1.0, color=_AFTER, linewidth=1.0, label="simulated, mean")
    if width < _EVERYWHERE * nyquist:
        panel.axvspan(low, high, color=_SPAN, alpha=0.25, linewidth=0.0, label="effect", zorder=0)
    panel.set(xlabel="frequency f [Hz]", ylabel="power over its expectation, largest [1]", yscale="log")
    panel.set_ylim(bottom=0.1)
    panel.legend(frameon=False, fontsize=7.5)


def _draw_text(panel: Axes, finding: Finding, axis: Axis) -> None:
    panel.set_axis_off()
    lines = [sentence(finding), "", f"{p_value(finding.p_value)}, evidence {finding.evidence:,.0f} nats"]
    lines += [line.strip() for line in changes(finding, axis)]
    lines += [f"after: {describe(after)}" for _, after in finding.discrepancies[:_TOLD]]
    text = "\n".join(textwrap.fill(line, _COLUMNS) for line in lines)
    written = panel.text(0.0, 1.0, text, va="top", transform=panel.transAxes, linespacing=1.35)
    written.set_in_layout(False)

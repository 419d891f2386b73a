"""The picture of a fit: Allan deviations, the model and its terms, and what the model leaves."""

from __future__ import annotations

import os
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from allanjax.allan import AllanDeviation
from allanjax.errors import AllanjaxError
from allanjax.recording import Axis
from allanjax.result import AxisFit, Fit, title_of
from allanjax.units import unit_scale

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Okabe and Ito's colours, for the colour-blind; the dashes tell terms apart in black and white.
_COLOURS = ("#0072B2", "#E69F00", "#009E73", "#D55E00", "#CC79A7", "#56B4E9")
_DASHES: tuple[Any, ...] = ("--", "-.", (0, (1, 1)), (0, (5, 1, 1, 1, 1, 1)), (0, (8, 2)), (0, (3, 1)))
_POINTS = "0.3"
_DISPLAY_UNIT = {"gyro": "deg/h", "accel": "µg"}
_SENSOR = {"gyro": "gyros", "accel": "accelerometers"}

# Inches. Panels have fixed places, so that nothing can overlap however many terms a model has.
_LEFT, _RIGHT, _TOP, _BOTTOM = 0.85, 0.2, 0.9, 0.1
_PANEL_WIDTH, _PANEL_HEIGHT, _STRIP_HEIGHT = 4.1, 2.5, 0.8
_HEADING, _GAP, _X_LABEL, _LINE = 0.3, 0.25, 0.45, 0.155
_KEY_COLUMNS = 62
_FONT_SIZE = 8.5

# Estimates with a larger relative error do not set the scale of the residuals.
_PRECISE = 0.2


@dataclass(frozen=True)
class _Unit:
    name: str
    scale: float


@dataclass(frozen=True)
class _KeyEntry:
    """A line of a panel's key: a term's curve, or only a remark."""

    text: str
    style: dict[str, Any] | None = None


def plot_allan(
    fit_or_curve: Fit | AllanDeviation,
    axes: Sequence[str] | None = None,
    path: str | os.PathLike[str] | None = None,
) -> Figure:
    """Draw Allan deviation against cluster time, one panel an axis, gyros above accelerometers.

    Points are the estimates with their 68 % intervals. For a fit, a line is the model, broken lines are its
    terms, with their coefficients below the panel, and a strip shows measured over model minus one; a grey
    band in it is the model's own error where the model is incomplete. Deviations are in deg/h and µg.

    Args:
        fit_or_curve: what `fit` or `allan_deviation` returns.
        axes: names of the axes to draw, e.g. `["gyro_x", "gyro_z"]`; all of them by default. For the curve of
            an array: `["0", "1", ...]`.
        path: a file to save the picture to, by its suffix .png, .svg or .pdf.

    Returns:
        The matplotlib figure.

    Raises:
        AllanjaxError: there is no such axis.
    """
    import matplotlib
    import matplotlib.pyplot as plt

    fit = fit_or_curve if isinstance(fit_or_curve, Fit) else None
    curve = fit_or_curve.curve if isinstance(fit_or_curve, Fit) else fit_or_curve
    names = [str(k) for k in range(curve.deviation.shape[1])]
    if curve.axes is not None:
        names = [axis.name for axis in curve.axes]
    rows = _rows(names, curve.axes, axes)
    with matplotlib.rc_context({"font.size": _FONT_SIZE, "axes.linewidth": 0.7}):
        keys = {k: [] if fit is None else _key(fit, fit.results[k]) for row in rows for k in row}
        cells = _Cells(
            rows=len(rows),
            columns=max(len(row) for row in rows),
            key_lines=max(sum(entry.text.count("\n") + 1 for entry in key) for key in keys.values()),
            has_strip=fit is not None,
        )
        figure = plt.figure(figsize=cells.size)
        _draw_title(figure, curve, fit, cells)
        for i, row in enumerate(rows):
            _draw_row(figure, cells, i, row, names, curve, fit, keys)
        if path is not None:
            figure.savefig(path, dpi=130)
    # A notebook shows the figure returned; left open there, it would show it twice.
    if "inline" in matplotlib.get_backend():
        plt.close(figure)
    return figure


def _rows(names: Sequence[str], axes: Sequence[Axis] | None, chosen: Sequence[str] | None) -> list[list[int]]:
    """Indices of the axes to draw, one row a sensor."""
    if chosen is not None and not chosen:
        raise AllanjaxError(f"name at least one axis to plot of {', '.join(names)}")
    for name in chosen or ():
        if name not in names:
            raise AllanjaxError(f"no axis {name!r} to plot; there are {', '.join(names)}")
    indices = range(len(names)) if chosen is None else [names.index(name) for name in chosen]
    if axes is None:
        return [list(indices)]
    rows = [[k for k in indices if axes[k].sensor == sensor] for sensor in _SENSOR]
    return [row for row in rows if row]


@dataclass(frozen=True)
class _Cells:
    """Where panels are, in inches."""

    rows: int
    columns: int
    key_lines: int
    has_strip: bool

    @property
    def height(self) -> float:
        strip = _STRIP_HEIGHT if self.has_strip else 0.0
        key = _LINE * self.key_lines + (0.15 if self.key_lines else 0.0)
        return _HEADING + _PANEL_HEIGHT + strip + _X_LABEL + key

    @property
    def size(self) -> tuple[float, float]:
        width = _LEFT + _RIGHT + self.columns * _PANEL_WIDTH + (self.columns - 1) * _GAP
        return width, _TOP + _BOTTOM + self.rows * self.height

    def add(self, figure: Figure, row: int, column: int, below: float, height: float) -> Axes:
        """Axes whose top lies `below` the cell's."""
        width, total = self.size
        left = _LEFT + column * (_PANEL_WIDTH + _GAP)
        bottom = total - _TOP - row * self.height - below - height
        return figure.add_axes((left / width, bottom / total, _PANEL_WIDTH / width, height / total))


def _draw_title(figure: Figure, curve: AllanDeviation, fit: Fit | None, cells: _Cells) -> None:
    from matplotlib.lines import Line2D

    width, height = cells.size
    at: dict[str, Any] = {"x": _LEFT / width, "va": "top"}
    name = _shortened(fit.name if fit is not None and fit.name else _kind(curve), int(width * 8))
    figure.text(y=1.0 - 0.12 / height, s=name, fontsize=13, fontweight="bold", **at)
    facts = f"{_duration(curve.n / curve.rate)} at {curve.rate:g} Hz, {curve.n:,} samples"
    figure.text(y=1.0 - 0.4 / height, s=facts, color="0.35", fontsize=9.5, **at)
    points: dict[str, Any] = {"color": _POINTS, "marker": "o", "markersize": 3, "linewidth": 0.8}
    handles = [Line2D([], [], label="measured, 68 % interval", **points)]
    if fit is not None:
        handles.append(Line2D([], [], color="black", linewidth=1.4, label="model, sum of its terms"))
    figure.legend(
        handles=handles,
        loc="upper left",
        bbox_to_anchor=(_LEFT / width, 1.0 - 0.65 / height),
        ncols=2,
        frameon=False,
        borderpad=0.0,
        borderaxespad=0.0,
    )


def _draw_row(
    figure: Figure,
    cells: _Cells,
    row: int,
    indices: Sequence[int],
    names: Sequence[str],
    curve: AllanDeviation,
    fit: Fit | None,
    keys: dict[int, list[_KeyEntry]],
) -> None:
    panels: dict[int, Axes] = {}
    strips: dict[int, Axes] = {}
    unit = _unit(None if curve.axes is None else curve.axes[indices[0]])
    for column, k in enumerate(indices):
        panels[k] = lowest = cells.add(figure, row, column, _HEADING, _PANEL_HEIGHT)
        panels[k].set_title(names[k], loc="left", fontweight="bold")
        _draw_measured(panels[k], curve, k, unit)
        if fit is not None:
            strips[k] = lowest = cells.add(figure, row, column, _HEADING + _PANEL_HEIGHT, _STRIP_HEIGHT)
            if fit.results[k].converged:
                _draw_model(panels[k], fit, fit.results[k], unit)
            key_height = _LINE * cells.key_lines
            _draw_key(
                cells.add(figure, row, column, cells.height - key_height - 0.15, key_height), cells, keys[k]
            )
        lowest.set_xlabel("cluster time T [s]")
    if fit is not None:
        _draw_residuals(strips, fit)
    _set_scales(panels, strips, curve, unit)
    panels[indices[0]].set_ylabel(f"{_kind(curve)}\n[{unit.name}]" if unit.name else _kind(curve))
    if strips:
        strips[indices[0]].set_ylabel("measured /\nmodel − 1 [%]")


def _draw_measured(panel: Axes, curve: AllanDeviation, k: int, unit: _Unit) -> None:
    deviation = curve.deviation[:, k]
    lower, upper = curve.confidence_interval(0.68)
    spread = np.stack([deviation - lower[:, k], upper[:, k] - deviation])
    panel.errorbar(
        curve.cluster_time,
        deviation / unit.scale,
        np.maximum(spread, 0.0) / unit.scale,
        label="measured",
        zorder=3,
        **_marks(2.6),
    )


def _draw_model(panel: Axes, fit: Fit, result: AxisFit, unit: _Unit) -> None:
    rate = fit.curve.rate
    # At whole numbers of samples only: between them a line above the Nyquist frequency is something else.
    sizes = np.unique(np.rint(np.geomspace(1.0, fit.curve.cluster_size[-1], 400)))
    time = sizes / rate
    model = result.model.sampled(rate)
    total = np.zeros(len(time))
    for label, term in zip(model.term_labels, model.terms, strict=True):
        variance = np.asarray(term.allan_variance(time))
        total += variance
        panel.plot(
            time, np.sqrt(variance) / unit.scale, label=title_of(label, result.axis), **_style(fit, label)
        )
    panel.plot(time, np.sqrt(total) / unit.scale, color="black", linewidth=1.4, label="model", zorder=2.5)


def _draw_residuals(strips: Mapping[int, Axes], fit: Fit) -> None:
    """Measured over model minus one, in the same scale along the row."""
    curve = fit.curve
    lower, upper = curve.confidence_interval(0.68)
    residuals, spreads, reach = {}, {}, 2.0
    for k in strips:
        result = fit.results[k]
        if not result.converged:
            continue
        model = fit.model_deviation(result.axis.name, curve.cluster_time)
        measured = curve.deviation[:, k]
        residuals[k] = 100.0 * (measured / model - 1.0)
        spread = np.stack([measured - lower[:, k], upper[:, k] - measured])
        spreads[k] = 100.0 * np.maximum(spread, 0.0) / model
        precise = abs(residuals[k][curve.edf[:, k] > 0.5 / _PRECISE**2])
        reach = max(reach, 1.2 * precise.max(initial=0.0), 120.0 * result.discrepancy)
    for k, strip in strips.items():
        strip.set_ylim(-reach, reach)
        if k not in residuals:
            strip.text(0.5, 0.5, "no result", transform=strip.transAxes, ha="center", va="center")
            continue
        strip.axhline(0.0, color="black", linewidth=1.0)
        if (off := 100.0 * fit.results[k].discrepancy) > 0.0:
            strip.axhspan(-off, off, color="0.88", zorder=0)
        strip.errorbar(curve.cluster_time, residuals[k], spreads[k], label="residual", **_marks(2.2))
        for marker, end, beyond in (("^", reach, residuals[k] > reach), ("v", -reach, residuals[k] < -reach)):
            strip.plot(
                curve.cluster_time[beyond],
                np.full(beyond.sum(), end),
                marker,
                color=_POINTS,
                markersize=3.5,
                clip_on=False,
                label="beyond the strip",
            )


def _marks(size: float) -> dict[str, Any]:
    return {"fmt": "o", "color": _POINTS, "markersize": size, "markeredgewidth": 0.0, "elinewidth": 0.8}


def _set_scales(
    panels: Mapping[int, Axes], strips: Mapping[int, Axes], curve: AllanDeviation, unit: _Unit
) -> None:
    """Same scales along a row, so that axes compare; terms far below the measured curve leave the panel."""
    from matplotlib.ticker import LogLocator, NullFormatter

    measured = curve.deviation[:, list(panels)] / unit.scale
    positive = measured[measured > 0.0]
    first, last = curve.cluster_time[[0, -1]]
    firsts = (*list(panels.values())[:1], *list(strips.values())[:1])
    for axes in (*panels.values(), *strips.values()):
        axes.set_xscale("log")
        axes.set_xlim(first / 1.4, last * 1.4)
        axes.grid(True, which="major", color="0.88", linewidth=0.6)
        axes.set_axisbelow(True)
        axes.tick_params(which="both", direction="in", labelleft=axes in firsts)
    for panel in panels.values():
        panel.set_yscale("log")
        panel.set_ylim(positive.min(initial=1e6) / 3.0, positive.max(initial=1e-6) * 2.0)
        panel.tick_params(labelbottom=not strips)
    for axis in [a.xaxis for a in (*panels.values(), *strips.values())] + [p.yaxis for p in panels.values()]:
        axis.set_minor_locator(LogLocator(subs=(2.0, 5.0)))
        axis.set_minor_formatter(NullFormatter())


def _key(fit: Fit, result: AxisFit) -> list[_KeyEntry]:
    """Every term with its coefficients, detected or not, and how well the model fits."""
    entries = []
    if result.converged:
        for term in fit.template.term_labels:
            found = [c for c in result.coefficients.values() if c.term == term]
            amplitude, name = found[0], title_of(term, result.axis)
            if amplitude.detected and len(found) > 1:
                text = f"{name}: " + ", ".join(f"{c.parameter.symbol} = {c.describe()}" for c in found)
            else:
                text = f"{name}{'' if amplitude.detected else ':'} {amplitude.describe()}"
            drawn = term in result.model.term_labels
            entries.append(_KeyEntry(_wrapped(text), _style(fit, term) if drawn else None))
    return [*entries, _KeyEntry(_wrapped(result.verdict()))]


def _draw_key(key: Axes, cells: _Cells, entries: Sequence[_KeyEntry]) -> None:
    key.set_axis_off()
    key.set_xlim(0.0, _PANEL_WIDTH)
    key.set_ylim(cells.key_lines, 0.0)
    y = 0
    for entry in entries:
        if entry.style is not None:
            key.plot([0.0, 0.32], [y + 0.5] * 2, **entry.style)
        colour = "black" if entry.style is not None else "0.4"
        key.text(0.42, y, entry.text, va="top", color=colour, linespacing=1.25, fontsize=_FONT_SIZE - 0.5)
        y += entry.text.count("\n") + 1


def _style(fit: Fit, term_label: str) -> dict[str, Any]:
    """Line of a term: the same in every panel."""
    i = fit.template.term_labels.index(term_label)
    return {"color": _COLOURS[i % len(_COLOURS)], "linestyle": _DASHES[i % len(_DASHES)], "linewidth": 1.3}


def _unit(axis: Axis | None) -> _Unit:
    if axis is None:
        return _Unit("", 1.0)
    name = _DISPLAY_UNIT[axis.sensor]
    return _Unit(name, unit_scale(name, axis.sensor))


def _kind(curve: AllanDeviation) -> str:
    return {"allan": "Allan", "modified": "modified Allan", "hadamard": "Hadamard"}[curve.kind] + " deviation"


def _shortened(text: str, length: int) -> str:
    return text if len(text) <= length else f"{text[: length - 1]}…"


def _wrapped(text: str) -> str:
    return "\n".join(textwrap.wrap(text, _KEY_COLUMNS, break_long_words=False))


def _duration(seconds: float) -> str:
    if seconds < 120.0:
        return f"{seconds:.3g} s"
    return f"{seconds / 60.0:.3g} min" if seconds < 7200.0 else f"{seconds / 3600.0:.3g} h"

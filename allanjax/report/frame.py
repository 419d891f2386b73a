"""The frame of figures with a panel an axis: panels in rows, their keys, strips of residuals and scales."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool

from allanjax.base.errors import AllanjaxError
from allanjax.base.wording import plain
from allanjax.record.recording import Axis
from allanjax.report.figure import (
    FONT_SIZE,
    MODEL,
    SENSORS,
    KeyEntry,
    Points,
    add_grid,
    add_legend,
    mark_2_and_5,
    marks,
    place,
    points_entry,
    save,
    save_and_close,
    style,
    write_title,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Inches. Panels have fixed places, so that nothing can overlap however many terms a model has.
_LEFT, _RIGHT, _TOP, _BOTTOM = 0.85, 0.2, 0.9, 0.1
_PANEL_WIDTH, _PANEL_HEIGHT, _STRIP_HEIGHT = 4.1, 2.5, 0.8
_HEADING, _GAP, _X_LABEL, _LINE, _BELOW = 0.3, 0.25, 0.45, 0.155, 0.15
#: Estimates with a larger relative error do not set the scale of the residuals: a judgement.
PRECISE = 0.2


@dataclass(frozen=True)
class Residual:
    """Measured values over the model minus one, in per cent.

    Attributes:
        points: residuals over cluster times or frequencies.
        precise: whether the strip's scale is made for each of them.
        off: relative error of the model itself.
    """

    points: Points
    precise: Bool[np.ndarray, " m"]
    off: float = 0.0


@dataclass(frozen=True)
class Panel:
    """What is drawn of an axis.

    Attributes:
        name: the axis's.
        label: of the vertical scale, the same along a row.
        points: what was measured; the scales are made for it.
        draw: draws all else into axes whose scales are set.
        key: entries of the key below.
        residual: None for an axis that has no result.
    """

    name: str
    label: str
    points: Sequence[Points]
    draw: Callable[[Axes], None]
    key: Sequence[KeyEntry]
    residual: Residual | None = None


@dataclass(frozen=True)
class Frame:
    """A figure of panels in rows.

    Attributes:
        title: title of the figure.
        facts: length and rate of the record.
        x_label: label of the horizontal scales.
        has_model: whether a model is drawn.
        has_strip: whether a strip of residuals is below each panel.
        has_points: whether anything was measured.
    """

    title: str
    facts: str
    x_label: str
    has_model: bool
    has_strip: bool
    has_points: bool = True

    def draw(
        self, rows: Sequence[Sequence[Panel]], path: str | os.PathLike[str] | None, ax: Axes | None
    ) -> Figure:
        """Draw the panels, saved if there is a path; or the only one of them into `ax`."""
        import matplotlib.pyplot as plt

        with style():
            if ax is not None:
                return self._draw_into(ax, [panel for row in rows for panel in row], path)
            lines = max(sum(_lines(entry) for entry in panel.key) for row in rows for panel in row)
            key = _LINE * lines
            strip = _STRIP_HEIGHT if self.has_strip else 0.0
            row_height = _HEADING + _PANEL_HEIGHT + strip + _X_LABEL + key + (_BELOW if lines else 0.0)
            columns = max(map(len, rows))
            width = _LEFT + _RIGHT + columns * _PANEL_WIDTH + (columns - 1) * _GAP
            height = _TOP + _BOTTOM + len(rows) * row_height
            figure = plt.figure(figsize=(width, height))
            self._draw_title(figure)
            for i, row in enumerate(rows):
                top, count = height - _TOP - i * row_height, len(row)
                panels = _cells(figure, count, top - _HEADING, _PANEL_HEIGHT)
                strips = _cells(figure, count, top - (_HEADING + _PANEL_HEIGHT), strip) if strip else []
                for axes, panel in zip(panels, row, strict=True):
                    axes.set_title(panel.name, loc="left", fontweight="bold")
                if lines:
                    keys = _cells(figure, count, top - (row_height - key - _BELOW), key)
                    for axes, panel in zip(keys, row, strict=True):
                        _draw_key(axes, lines, panel.key)
                self._draw_row(row, panels, strips)
            return save_and_close(figure, path)

    def _draw_into(self, ax: Axes, panels: Sequence[Panel], path: str | os.PathLike[str] | None) -> Figure:
        """Draw a panel into the caller's axes; the figure, saved if there is a path, is theirs to close."""
        if len(panels) > 1:
            raise AllanjaxError('ax= has room for one axis: name it, e.g. axes="gyro_x"')
        self._draw_row(panels, [ax], [])
        figure = ax.get_figure(root=True)
        assert figure is not None
        if path is not None:
            save(figure, path)
        return figure

    def _draw_row(self, row: Sequence[Panel], panels: Sequence[Axes], strips: Sequence[Axes]) -> None:
        _set_scales(row, panels, strips)
        for panel, axes in zip(row, panels, strict=True):
            for points in panel.points:
                points.draw(axes)
            panel.draw(axes)
        panels[0].set_ylabel(row[0].label)
        if strips:
            _draw_residuals(strips, [panel.residual for panel in row])
            strips[0].set_ylabel("measured /\nmodel − 1 [%]")
        for lowest in strips or panels:
            lowest.set_xlabel(self.x_label)

    def _draw_title(self, figure: Figure) -> None:
        """Write the title, the facts about the record, and the key of points and model."""
        from matplotlib.lines import Line2D

        most = int(figure.get_figwidth() * 8)
        title = self.title if len(self.title) <= most else f"{self.title[: most - 1]}…"
        write_title(figure, _LEFT, title, self.facts)
        handles = [points_entry("measured, 68 % interval")] if self.has_points else []
        if self.has_model:
            handles.append(Line2D([], [], **{**MODEL, "label": "model, sum of its terms"}))
        add_legend(figure, handles, "upper left", _LEFT, 0.65, ncols=2)


def _cells(figure: Figure, count: int, top: float, height: float) -> list[Axes]:
    """Add axes side by side, whose top is at this height [inches]."""
    lefts = (_LEFT + column * (_PANEL_WIDTH + _GAP) for column in range(count))
    return [place(figure, left, top - height, _PANEL_WIDTH, height) for left in lefts]


def rows_of(
    names: Sequence[str], axes: Sequence[Axis] | None, chosen: Sequence[str] | str | None
) -> list[list[int]]:
    """Indices of the axes to draw, in a row for each sensor; `chosen` may be a single name."""
    chosen = [chosen] if isinstance(chosen, str) else chosen
    if chosen is not None and not chosen:
        raise AllanjaxError(f"name at least one axis to plot of {', '.join(names)}")
    for name in chosen or ():
        if name not in names:
            raise AllanjaxError(f"no axis {name!r} to plot; there are {', '.join(names)}")
    indices = range(len(names)) if chosen is None else [names.index(name) for name in chosen]
    if axes is None:
        return [list(indices)]
    rows = [[k for k in indices if axes[k].sensor == sensor] for sensor in SENSORS]
    return [row for row in rows if row]


def _draw_residuals(strips: Sequence[Axes], residuals: Sequence[Residual | None]) -> None:
    """Draw the strips, in the same scale along the row: linear for precise values, logarithmic beyond."""
    from matplotlib.ticker import NullLocator

    there = [r for r in residuals if r is not None]
    precise = [abs(r.points.y[r.precise]).max(initial=100.0 * r.off) for r in there]
    reach = _round(max([2.0, *precise]))
    ends = [end for r in there for end in (r.points.y.min(), r.points.y.max())]
    high, low = _round(max([reach, *ends])), -min(_round(max([reach, *(-end for end in ends)])), 100.0)
    # The ends of the linear part, where their labels are clear of the others.
    inner = [end for end, of in ((-reach, low), (reach, high)) if of / end >= 3.0]
    for strip, r in zip(strips, residuals, strict=True):
        strip.set_yscale("symlog", linthresh=reach)
        strip.set_ylim(1.1 * low, 1.1 * high)
        strip.set_yticks([low, *inner, 0.0, high])
        strip.yaxis.set_major_formatter(lambda y, _: plain(y).replace("-", "−"))
        strip.yaxis.set_minor_locator(NullLocator())
        if r is None:
            strip.text(0.5, 0.5, "no result", transform=strip.transAxes, ha="center", va="center")
            continue
        strip.axhline(0.0, color="black", linewidth=1.0)
        if r.off > 0.0:
            strip.axhspan(-100.0 * r.off, 100.0 * r.off, color="0.88", zorder=0)
        strip.errorbar(r.points.x, r.points.y, r.points.spread, label="residual", **marks(2.2))


def _round(x: float) -> float:
    """The next of 1, 2, 3, 5, 7, 10, … from x on."""
    power = 10.0 ** np.floor(np.log10(x))
    return float(next(m * power for m in (1.0, 2.0, 3.0, 5.0, 7.0, 10.0) if m * power >= x))


def _set_scales(row: Sequence[Panel], panels: Sequence[Axes], strips: Sequence[Axes]) -> None:
    """Set the same scales along a row, so that axes compare; terms far below the points leave the panel."""
    x, y = (
        np.concatenate(of) for of in zip(*((p.x, p.y) for panel in row for p in panel.points), strict=True)
    )
    positive = y[y > 0.0]
    for axes in (*panels, *strips):
        axes.set_xscale("log")
        axes.set_xlim(x.min() / 1.4, x.max() * 1.4)
        add_grid(axes)
        axes.tick_params(which="both", labelleft=axes in (*panels[:1], *strips[:1]))
    for panel in panels:
        panel.set_yscale("log")
        panel.set_ylim(positive.min(initial=1e6) / 3.0, positive.max(initial=1e-6) * 2.0)
        panel.tick_params(labelbottom=not strips)
    mark_2_and_5(*(axes.xaxis for axes in (*panels, *strips)), *(panel.yaxis for panel in panels))


def _draw_key(key: Axes, lines: int, entries: Sequence[KeyEntry]) -> None:
    """Write the key below a panel, each entry with its curve."""
    key.set_axis_off()
    key.set_xlim(0.0, _PANEL_WIDTH)
    key.set_ylim(lines, 0.0)
    y = 0
    for entry in entries:
        if entry.style is not None:
            key.plot([0.0, 0.32], [y + 0.5] * 2, **entry.style)
        colour = "black" if entry.style is not None else "0.4"
        key.text(0.42, y, entry.text, va="top", color=colour, linespacing=1.25, fontsize=FONT_SIZE - 0.5)
        y += _lines(entry)


def _lines(entry: KeyEntry) -> int:
    return entry.text.count("\n") + 1

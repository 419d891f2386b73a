"""The frame of figures with a panel an axis: panels in rows, their keys, strips of residuals and scales."""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from jaxtyping import Bool, Float

from allanjax.base.errors import AllanjaxError
from allanjax.record.recording import Axis
from allanjax.report.figure import (
    FONT_SIZE,
    POINTS,
    SENSORS,
    KeyEntry,
    add_grid,
    literal,
    marks,
    save,
    save_and_close,
    style,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

# Inches. Panels have fixed places, so that nothing can overlap however many terms a model has.
_LEFT, _RIGHT, _TOP, _BOTTOM = 0.85, 0.2, 0.9, 0.1
_PANEL_WIDTH, _PANEL_HEIGHT, _STRIP_HEIGHT = 4.1, 2.5, 0.8
_HEADING, _GAP, _X_LABEL, _LINE = 0.3, 0.25, 0.45, 0.155
# Residuals beyond so many per cent are marked at the edge, so that a line does not hide all else.
_WIDEST = 100.0
#: Estimates with a larger relative error do not set the scale of the residuals: a judgement.
PRECISE = 0.2


@dataclass(frozen=True)
class Residual:
    """Measured values over the model minus one, in per cent.

    Attributes:
        x: [m] cluster times or frequencies.
        value: [m] residuals.
        spread: [2, m] length of the error bars below and above.
        precise: [m] whether the strip's scale is made for the residual.
        off: relative error of the model itself.
    """

    x: Float[np.ndarray, " m"]
    value: Float[np.ndarray, " m"]
    spread: Float[np.ndarray, "2 m"]
    precise: Bool[np.ndarray, " m"]
    off: float


@dataclass(frozen=True)
class Heading:
    """Names of the axes and what is said above all panels.

    Attributes:
        names: names of the axes.
        title: title of the figure.
        facts: length and rate of the record.
        has_model: whether a model is drawn.
        has_strip: whether a strip of residuals is below each panel.
    """

    names: Sequence[str]
    title: str
    facts: str
    has_model: bool
    has_strip: bool


class Panels(ABC):
    """Content of a figure with a panel an axis; a panel is known by the index of its axis.

    Attributes:
        X_LABEL: label of the horizontal axes.
    """

    X_LABEL: ClassVar[str]

    @abstractmethod
    def y_label(self, k: int) -> str:
        """Label of the vertical axis, for the row that an axis is in."""

    @abstractmethod
    def key(self, k: int) -> list[KeyEntry]:
        """Entries of the key below a panel."""

    @abstractmethod
    def draw(self, panel: Axes, k: int) -> dict[str, Line2D]:
        """Draw what was measured and the model; returns the lines of its terms, by their labels."""

    @abstractmethod
    def extent(self, row: Sequence[int]) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, "m columns"]]:
        """Ascending x, and the values measured, that the scales of these axes' panels are made for."""

    def residual(self, k: int) -> Residual | None:
        """Residual of an axis, None where it has no result."""
        return None

    def finish(self, panel: Axes, k: int, drawn: dict[str, Line2D]) -> None:
        """Add to a panel what needs its scales to be set."""
        return

    def add_legend(self, panel: Axes) -> None:
        """Add what replaces the key in axes of the caller's."""
        return

    def figure(
        self,
        rows: Sequence[Sequence[int]],
        heading: Heading,
        path: str | os.PathLike[str] | None,
        ax: Axes | None,
    ) -> Figure:
        """Draw the panels in rows, saved if there is a path; or the only one of them into `ax`."""
        import matplotlib.pyplot as plt

        with style():
            if ax is not None:
                k = _only_one(rows)
                self._draw_row({k: ax}, {})
                self.add_legend(ax)
                return _figure_of(ax, path)
            keys = {k: self.key(k) for row in rows for k in row}
            cells = _Cells.of(rows, keys, heading.has_strip)
            figure = plt.figure(figsize=cells.size)
            _draw_title(figure, cells, heading)
            for i, row in enumerate(rows):
                panels = {k: cells.panel(figure, i, column) for column, k in enumerate(row)}
                strips = (
                    {k: cells.strip(figure, i, j) for j, k in enumerate(row)} if heading.has_strip else {}
                )
                for column, k in enumerate(row):
                    panels[k].set_title(heading.names[k], loc="left", fontweight="bold")
                    if keys[k]:
                        _draw_key(cells.key(figure, i, column), cells, keys[k])
                self._draw_row(panels, strips)
            return save_and_close(figure, path)

    def _draw_row(self, panels: Mapping[int, Axes], strips: Mapping[int, Axes]) -> None:
        """Draw the panels of a row and their strips."""
        drawn = {k: self.draw(panel, k) for k, panel in panels.items()}
        if strips:
            residuals = {k: residual for k in strips if (residual := self.residual(k)) is not None}
            _draw_residuals(strips, residuals)
        _set_scales(panels, strips, *self.extent(list(panels)))
        for k, panel in panels.items():
            self.finish(panel, k, drawn[k])
        for lowest in (strips or panels).values():
            lowest.set_xlabel(self.X_LABEL)
        first = next(iter(panels))
        panels[first].set_ylabel(self.y_label(first))
        if strips:
            strips[first].set_ylabel("measured /\nmodel − 1 [%]")


def rows_of(
    names: Sequence[str], axes: Sequence[Axis] | None, chosen: Sequence[str] | None
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


def _only_one(rows: Sequence[Sequence[int]]) -> int:
    """Index of the single axis to draw.

    Raises:
        AllanjaxError: there are several.
    """
    indices = [k for row in rows for k in row]
    if len(indices) > 1:
        raise AllanjaxError('ax= has room for one axis: name it, e.g. axes="gyro_x"')
    return indices[0]


def _figure_of(ax: Axes, path: str | os.PathLike[str] | None) -> Figure:
    """Figure that the caller's axes are in, saved if there is a path; it is the caller's to close."""
    figure = ax.get_figure(root=True)
    assert figure is not None
    if path is not None:
        save(figure, path)
    return figure


@dataclass(frozen=True)
class _Cells:
    """Cells in rows and columns, each with a heading, a panel, its strip and its key [inches]."""

    rows: int
    columns: int
    key_lines: int
    has_strip: bool

    @classmethod
    def of(cls, rows: Sequence[Sequence[int]], keys: Mapping[int, list[KeyEntry]], has_strip: bool) -> _Cells:
        """Cells large enough for these panels and keys."""
        lines = max(sum(entry.text.count("\n") + 1 for entry in key) for key in keys.values())
        return cls(len(rows), max(len(row) for row in rows), lines, has_strip)

    @property
    def height(self) -> float:
        """Height of a row."""
        strip = _STRIP_HEIGHT if self.has_strip else 0.0
        key = _LINE * self.key_lines + (0.15 if self.key_lines else 0.0)
        return _HEADING + _PANEL_HEIGHT + strip + _X_LABEL + key

    @property
    def size(self) -> tuple[float, float]:
        """Width and height of the figure."""
        width = _LEFT + _RIGHT + self.columns * _PANEL_WIDTH + (self.columns - 1) * _GAP
        return width, _TOP + _BOTTOM + self.rows * self.height

    def panel(self, figure: Figure, row: int, column: int) -> Axes:
        """Add the axes of a panel."""
        return self._add(figure, row, column, _HEADING, _PANEL_HEIGHT)

    def strip(self, figure: Figure, row: int, column: int) -> Axes:
        """Add the axes of the strip below a panel."""
        return self._add(figure, row, column, _HEADING + _PANEL_HEIGHT, _STRIP_HEIGHT)

    def key(self, figure: Figure, row: int, column: int) -> Axes:
        """Add the axes of the key below a panel and its strip."""
        height = _LINE * self.key_lines
        return self._add(figure, row, column, self.height - height - 0.15, height)

    def _add(self, figure: Figure, row: int, column: int, below: float, height: float) -> Axes:
        """Add axes whose top lies `below` the cell's."""
        width, total = self.size
        left = _LEFT + column * (_PANEL_WIDTH + _GAP)
        bottom = total - _TOP - row * self.height - below - height
        return figure.add_axes((left / width, bottom / total, _PANEL_WIDTH / width, height / total))


def _draw_title(figure: Figure, cells: _Cells, heading: Heading) -> None:
    """Write the title, the facts about the record, and the key of points and model."""
    from matplotlib.lines import Line2D

    width, height = cells.size
    at: dict[str, Any] = {"x": _LEFT / width, "va": "top"}
    title = literal(_shortened(heading.title, int(width * 8)))
    figure.text(y=1.0 - 0.12 / height, s=title, fontsize=13, fontweight="bold", **at)
    figure.text(y=1.0 - 0.4 / height, s=heading.facts, color="0.35", fontsize=9.5, **at)
    points: dict[str, Any] = {"color": POINTS, "marker": "o", "markersize": 3, "linewidth": 0.8}
    handles = [Line2D([], [], label="measured, 68 % interval", **points)]
    if heading.has_model:
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


def _draw_residuals(strips: Mapping[int, Axes], residuals: Mapping[int, Residual]) -> None:
    """Draw the strips, in the same scale along the row; an axis without a residual has no result."""
    reach = 2.0
    for r in residuals.values():
        reach = max(reach, min(1.2 * abs(r.value[r.precise]).max(initial=0.0), _WIDEST), 120.0 * r.off)
    for k, strip in strips.items():
        strip.set_ylim(-reach, reach)
        if k not in residuals:
            strip.text(0.5, 0.5, "no result", transform=strip.transAxes, ha="center", va="center")
            continue
        x, value, off = residuals[k].x, residuals[k].value, 100.0 * residuals[k].off
        strip.axhline(0.0, color="black", linewidth=1.0)
        if off > 0.0:
            strip.axhspan(-off, off, color="0.88", zorder=0)
        strip.errorbar(x, value, residuals[k].spread, label="residual", **marks(2.2))
        for marker, end, beyond in (("^", reach, value > reach), ("v", -reach, value < -reach)):
            strip.plot(
                x[beyond],
                np.full(beyond.sum(), end),
                marker,
                color=POINTS,
                markersize=3.5,
                clip_on=False,
                label="beyond the strip",
            )


def _set_scales(
    panels: Mapping[int, Axes],
    strips: Mapping[int, Axes],
    x: Float[np.ndarray, ...],
    measured: Float[np.ndarray, "m axes"],
) -> None:
    """Set the same scales along a row, so that axes compare.

    Terms far below what was measured leave the panel.
    """
    from matplotlib.ticker import LogLocator, NullFormatter

    positive = measured[measured > 0.0]
    firsts = (*list(panels.values())[:1], *list(strips.values())[:1])
    for axes in (*panels.values(), *strips.values()):
        axes.set_xscale("log")
        axes.set_xlim(x[0] / 1.4, x[-1] * 1.4)
        add_grid(axes)
        axes.tick_params(which="both", labelleft=axes in firsts)
    for panel in panels.values():
        panel.set_yscale("log")
        panel.set_ylim(positive.min(initial=1e6) / 3.0, positive.max(initial=1e-6) * 2.0)
        panel.tick_params(labelbottom=not strips)
    for axis in [a.xaxis for a in (*panels.values(), *strips.values())] + [p.yaxis for p in panels.values()]:
        axis.set_minor_locator(LogLocator(subs=(2.0, 5.0)))
        axis.set_minor_formatter(NullFormatter())


def _draw_key(key: Axes, cells: _Cells, entries: Sequence[KeyEntry]) -> None:
    """Write the key below a panel, each entry with its curve."""
    key.set_axis_off()
    key.set_xlim(0.0, _PANEL_WIDTH)
    key.set_ylim(cells.key_lines, 0.0)
    y = 0
    for entry in entries:
        if entry.style is not None:
            key.plot([0.0, 0.32], [y + 0.5] * 2, **entry.style)
        colour = "black" if entry.style is not None else "0.4"
        key.text(0.42, y, entry.text, va="top", color=colour, linespacing=1.25, fontsize=FONT_SIZE - 0.5)
        y += entry.text.count("\n") + 1


def _shortened(text: str, length: int) -> str:
    return text if len(text) <= length else f"{text[: length - 1]}…"

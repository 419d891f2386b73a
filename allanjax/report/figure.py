"""What the pictures share: places, colours, keys, scales, and the strip of residuals."""

from __future__ import annotations

import os
import textwrap
import warnings
import weakref
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Bool, Float

from allanjax.base.errors import AllanjaxError
from allanjax.base.wording import duration
from allanjax.estimate.result import AxisFit, Fit
from allanjax.noise.estimate import title_of
from allanjax.record.recording import Axis

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Okabe and Ito's colours, for the colour-blind; the dashes tell terms apart in black and white.
COLOURS = ("#0072B2", "#E69F00", "#009E73", "#D55E00", "#CC79A7", "#56B4E9")
_DASHES: tuple[Any, ...] = ("--", "-.", (0, (1, 1)), (0, (5, 1, 1, 1, 1, 1)), (0, (8, 2)), (0, (3, 1)))
POINTS = "0.3"
_SENSOR = {"gyro": "gyros", "accel": "accelerometers"}

# Inches. Panels have fixed places, so that nothing can overlap however many terms a model has.
_LEFT, _RIGHT, _TOP, _BOTTOM = 0.85, 0.2, 0.9, 0.1
_PANEL_WIDTH, _PANEL_HEIGHT, _STRIP_HEIGHT = 4.1, 2.5, 0.8
_HEADING, _GAP, _X_LABEL, _LINE = 0.3, 0.25, 0.45, 0.155
_KEY_COLUMNS = 62
_FONT_SIZE = 8.5
_WINDOWLESS = frozenset({"agg", "cairo", "pdf", "pgf", "ps", "svg", "template"})
# The figure that was drawn last where there are no windows, if it was not saved.
_waiting: weakref.WeakSet[Figure] = weakref.WeakSet()
# Residuals beyond so many per cent are marked at the edge: a line must not hide all else.
_WIDEST = 100.0


@dataclass(frozen=True)
class Unit:
    """A unit for people, and its factor to SI."""

    name: str
    scale: float


@dataclass(frozen=True)
class KeyEntry:
    """A line of a panel's key: a term's curve, or only a remark."""

    text: str
    style: dict[str, Any] | None = None


@dataclass(frozen=True)
class Residual:
    """Measured over model minus one, in percent.

    Attributes:
        value: [m] residuals.
        spread: [2, m] length of the error bars below and above.
        precise: [m] whether the residual has a say in the strip's scale.
        off: the model's own relative error.
    """

    value: Float[np.ndarray, " m"]
    spread: Float[np.ndarray, "2 m"]
    precise: Bool[np.ndarray, " m"]
    off: float


def style() -> AbstractContextManager[None]:
    """The settings under which a picture is drawn."""
    import matplotlib

    return matplotlib.rc_context({"font.size": _FONT_SIZE, "axes.linewidth": 0.7, "text.usetex": False})


def literal(text: str) -> str:
    """The text for a picture as it is: a name may have dollars, which are no formula's."""
    return text.encode("utf-8", "replace").decode("utf-8").replace("$", r"\$")


def save(figure: Figure, path: str | os.PathLike[str]) -> None:
    """Save a figure, whatever characters are in its names."""
    with warnings.catch_warnings():
        # The font may lack some of them.
        warnings.filterwarnings("ignore", "Glyph .* missing from")
        figure.savefig(path, dpi=130)


def save_and_close(figure: Figure, path: str | os.PathLike[str] | None) -> Figure:
    """The figure, saved if there is a path.

    Figures do not pile up in pyplot: one that is saved is closed there, and so is, where there are no windows
    to show it in, the one before it. A closed figure can be saved and shown by itself as before.
    """
    import matplotlib
    import matplotlib.pyplot as plt

    if path is not None:
        save(figure, path)
    backend = matplotlib.get_backend().lower()
    # A notebook shows the figure returned; left open there, it would show it twice.
    if "inline" in backend or (path is not None and not plt.isinteractive()):
        _close(figure)
    elif backend in _WINDOWLESS:
        for former in tuple(_waiting):
            _close(former)
        _waiting.clear()
        # For `plt.savefig` and the like.
        _waiting.add(figure)
    return figure


def _close(figure: Figure) -> None:
    """Take a figure out of pyplot; its canvas stays one that can draw."""
    import matplotlib.pyplot as plt
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    plt.close(figure)
    FigureCanvasAgg(figure)


def rows_of(
    names: Sequence[str], axes: Sequence[Axis] | None, chosen: Sequence[str] | None
) -> list[list[int]]:
    """Indices of the axes to draw, one row a sensor; a single name stands for itself."""
    chosen = [chosen] if isinstance(chosen, str) else chosen
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


def figure_with(ax: Axes, path: str | os.PathLike[str] | None) -> Figure:
    """The figure that the caller's axes are in, saved if there is a path; it is the caller's to close."""
    figure = ax.get_figure(root=True)
    assert figure is not None
    if path is not None:
        save(figure, path)
    return figure


def only_one(rows: Sequence[Sequence[int]]) -> int:
    """The single axis that there is to draw.

    Raises:
        AllanjaxError: there are several.
    """
    indices = [k for row in rows for k in row]
    if len(indices) > 1:
        raise AllanjaxError('ax= has room for one axis: name it, e.g. axes="gyro_x"')
    return indices[0]


@dataclass(frozen=True)
class Cells:
    """Where panels are, in inches: a heading, the panel, its strip and its key, in rows and columns."""

    rows: int
    columns: int
    key_lines: int
    has_strip: bool

    @classmethod
    def of(cls, rows: list[list[int]], keys: Mapping[int, list[KeyEntry]], has_strip: bool) -> Cells:
        """The cells that hold these panels and keys."""
        lines = max(sum(entry.text.count("\n") + 1 for entry in key) for key in keys.values())
        return cls(len(rows), max(len(row) for row in rows), lines, has_strip)

    @property
    def height(self) -> float:
        strip = _STRIP_HEIGHT if self.has_strip else 0.0
        key = _LINE * self.key_lines + (0.15 if self.key_lines else 0.0)
        return _HEADING + _PANEL_HEIGHT + strip + _X_LABEL + key

    @property
    def size(self) -> tuple[float, float]:
        width = _LEFT + _RIGHT + self.columns * _PANEL_WIDTH + (self.columns - 1) * _GAP
        return width, _TOP + _BOTTOM + self.rows * self.height

    def panel(self, figure: Figure, row: int, column: int) -> Axes:
        return self._add(figure, row, column, _HEADING, _PANEL_HEIGHT)

    def strip(self, figure: Figure, row: int, column: int) -> Axes:
        return self._add(figure, row, column, _HEADING + _PANEL_HEIGHT, _STRIP_HEIGHT)

    def key(self, figure: Figure, row: int, column: int) -> Axes:
        height = _LINE * self.key_lines
        return self._add(figure, row, column, self.height - height - 0.15, height)

    def _add(self, figure: Figure, row: int, column: int, below: float, height: float) -> Axes:
        """Axes whose top lies `below` the cell's."""
        width, total = self.size
        left = _LEFT + column * (_PANEL_WIDTH + _GAP)
        bottom = total - _TOP - row * self.height - below - height
        return figure.add_axes((left / width, bottom / total, _PANEL_WIDTH / width, height / total))


def draw_title(figure: Figure, cells: Cells, name: str, facts: str, has_model: bool) -> None:
    """The name, the facts about the record, and what points and the black line are."""
    from matplotlib.lines import Line2D

    width, height = cells.size
    at: dict[str, Any] = {"x": _LEFT / width, "va": "top"}
    title = literal(_shortened(name, int(width * 8)))
    figure.text(y=1.0 - 0.12 / height, s=title, fontsize=13, fontweight="bold", **at)
    figure.text(y=1.0 - 0.4 / height, s=facts, color="0.35", fontsize=9.5, **at)
    points: dict[str, Any] = {"color": POINTS, "marker": "o", "markersize": 3, "linewidth": 0.8}
    handles = [Line2D([], [], label="measured, 68 % interval", **points)]
    if has_model:
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


def draw_residuals(
    strips: Mapping[int, Axes], x: Float[np.ndarray, " m"], residuals: Mapping[int, Residual]
) -> None:
    """The strips, in the same scale along the row; an axis without a residual has no result."""
    reach = 2.0
    for r in residuals.values():
        reach = max(reach, min(1.2 * abs(r.value[r.precise]).max(initial=0.0), _WIDEST), 120.0 * r.off)
    for k, strip in strips.items():
        strip.set_ylim(-reach, reach)
        if k not in residuals:
            strip.text(0.5, 0.5, "no result", transform=strip.transAxes, ha="center", va="center")
            continue
        value, off = residuals[k].value, 100.0 * residuals[k].off
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


def marks(size: float) -> dict[str, Any]:
    """How points with error bars look."""
    return {"fmt": "o", "color": POINTS, "markersize": size, "markeredgewidth": 0.0, "elinewidth": 0.8}


def set_scales(
    panels: Mapping[int, Axes],
    strips: Mapping[int, Axes],
    x: Float[np.ndarray, ...],
    measured: Float[np.ndarray, "m axes"],
) -> None:
    """Same scales along a row, so that axes compare; terms far below what was measured leave the panel."""
    from matplotlib.ticker import LogLocator, NullFormatter

    positive = measured[measured > 0.0]
    firsts = (*list(panels.values())[:1], *list(strips.values())[:1])
    for axes in (*panels.values(), *strips.values()):
        axes.set_xscale("log")
        axes.set_xlim(x[0] / 1.4, x[-1] * 1.4)
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


def term_entry(fit: Fit, result: AxisFit, term: str, remark: str = "") -> KeyEntry:
    """A term with its coefficients, detected or not."""
    found = [c.in_unit() for c in result.coefficients.values() if c.term == term]
    amplitude, name = found[0], title_of(term, result.axis)
    if amplitude.detected and len(found) > 1:
        text = f"{name}: " + ", ".join(f"{c.symbol} = {c.describe()}" for c in found)
    else:
        text = f"{name}{'' if amplitude.detected else ':'} {amplitude.describe()}"
    drawn = term in result.term_labels and not remark
    return KeyEntry(wrapped(text + remark), term_style(fit, term) if drawn else None)


def draw_key(key: Axes, cells: Cells, entries: Sequence[KeyEntry]) -> None:
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


def term_style(fit: Fit, term_label: str) -> dict[str, Any]:
    """Line of a term: the same in every panel."""
    i = fit.template.term_labels.index(term_label)
    return {"color": COLOURS[i % len(COLOURS)], "linestyle": _DASHES[i % len(_DASHES)], "linewidth": 1.3}


def wrapped(text: str) -> str:
    """The text in lines of the key's width, not broken between a number and its per cent."""
    lines = textwrap.wrap(text.replace(" %", "\u00a0%"), _KEY_COLUMNS, break_long_words=False)
    return "\n".join(lines).replace("\u00a0", " ")


def facts_of(n: int, rate: float) -> str:
    """E.g. "200 s at 100 Hz, 20,000 samples"."""
    return f"{duration(n / rate)} at {rate:g} Hz, {n:,} samples"


def _shortened(text: str, length: int) -> str:
    return text if len(text) <= length else f"{text[: length - 1]}…"

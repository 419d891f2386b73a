"""Colours, marks, keys, places and files of all pictures."""

from __future__ import annotations

import os
import textwrap
import warnings
import weakref
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from allanjax.allan.deviation import AllanDeviation, rate_unit
from allanjax.base.errors import AllanjaxError
from allanjax.base.wording import duration, plain
from allanjax.estimate.result import AxisFit, Fit
from allanjax.noise.estimate import title_of
from allanjax.noise.terms import NoiseTerm
from allanjax.record.recording import Axis
from allanjax.record.units import Sensor

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

# Okabe and Ito's colours, for the colour-blind; the dashes tell terms apart in black and white.
COLOURS = ("#0072B2", "#E69F00", "#009E73", "#D55E00", "#CC79A7", "#56B4E9")
DASHES: tuple[Any, ...] = ("--", "-.", (0, (1, 1)), (0, (5, 1, 1, 1, 1, 1)), (0, (8, 2)), (0, (3, 1)))
POINTS = "0.3"
#: Style of single points without error bars.
DOTS: dict[str, Any] = {
    "marker": "o",
    "linestyle": "none",
    "color": POINTS,
    "markersize": 2.4,
    "markeredgewidth": 0.0,
}
#: Sensors in words, in the order in which they are drawn.
SENSORS: dict[Sensor, str] = {"gyro": "gyros", "accel": "accelerometers"}
#: Style of a model's line, the sum of its terms.
MODEL: dict[str, Any] = {"color": "black", "linewidth": 1.4, "label": "model", "zorder": 2.5}
#: Style of what the terms are corrected for: filter, resonances and lines.
FURTHER: dict[str, Any] = {"color": "0.55", "linewidth": 0.8, "linestyle": (0, (1, 1))}

# Characters in a line of the key, as many as fit below a panel.
_KEY_COLUMNS = 62
FONT_SIZE = 8.5
CLUSTER_TIME = "cluster time T [s]"
FREQUENCY = "frequency f [Hz]"
_WINDOWLESS = frozenset({"agg", "cairo", "pdf", "pgf", "ps", "svg", "template"})
# The figure that was drawn last where there are no windows, if it was not saved.
_waiting: weakref.WeakSet[Figure] = weakref.WeakSet()


@dataclass(frozen=True)
class Points:
    """Measured values over x with error bars of these lengths below and above, in the unit shown."""

    x: Float[np.ndarray, " m"]
    y: Float[np.ndarray, " m"]
    spread: Float[np.ndarray, "2 m"]
    label: str = "measured"
    style: dict[str, Any] = field(default_factory=dict)

    @classmethod
    def of(
        cls,
        x: Float[np.ndarray, " m"],
        y: Float[np.ndarray, " m"],
        interval: Sequence[Float[np.ndarray, " m"]],
        scale: float = 1.0,
    ) -> Points:
        """Values and intervals in the unit of this size."""
        lower, upper = interval
        # Of few degrees of freedom, the interval may lie beside the estimate.
        return cls(x, y / scale, np.maximum(np.stack([y - lower, upper - y]), 0.0) / scale)

    def draw(self, panel: Axes) -> None:
        """Draw the points with their error bars."""
        style = {**marks(2.6), **self.style}
        panel.errorbar(self.x, self.y, self.spread, label=self.label, zorder=3, **style)


def allan_points(curve: AllanDeviation, k: int, scale: float = 1.0) -> Points:
    """Estimates of an axis with their 68 % intervals, in the unit of this size."""
    ends = [end[:, k] for end in curve.confidence_interval(0.68)]
    return Points.of(curve.cluster_time, curve.deviation[:, k], ends, scale)


class KeyEntry(NamedTuple):
    """Entry of a panel's key: a term with the style of its curve, or only a remark."""

    text: str
    style: dict[str, Any] | None = None


def style() -> AbstractContextManager[None]:
    """Settings under which a figure is drawn."""
    import matplotlib

    return matplotlib.rc_context({"font.size": FONT_SIZE, "axes.linewidth": 0.7, "text.usetex": False})


def literal(text: str) -> str:
    """Text for a figure as it is: dollars in a name do not begin a formula."""
    return text.encode("utf-8", "replace").decode("utf-8").replace("$", r"\$")


def save(figure: Figure, path: str | os.PathLike[str]) -> None:
    """Save a figure, whatever characters are in its names."""
    with warnings.catch_warnings():
        # The font may lack some of them.
        warnings.filterwarnings("ignore", "Glyph .* missing from")
        figure.savefig(path, dpi=130)


def save_and_close(figure: Figure, path: str | os.PathLike[str] | None) -> Figure:
    """Figure, saved if there is a path, and closed in pyplot where nobody will show it.

    So figures do not pile up in pyplot: one that is saved is closed, and so is, where there are no windows,
    the one before it. A closed figure can be saved and shown by itself as before.
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


def check_room(ax: Axes | None, count: int) -> None:
    """Raise AllanjaxError if so many panels are to be drawn into the caller's axes."""
    if ax is not None and count > 1:
        raise AllanjaxError('ax= has room for one axis: name it, e.g. axes="gyro_x"')


def figure_of(ax: Axes, path: str | os.PathLike[str] | None) -> Figure:
    """Figure of the caller's axes, saved if there is a path; it is theirs to close."""
    figure = ax.get_figure(root=True)
    assert figure is not None
    if path is not None:
        save(figure, path)
    return figure


def place(figure: Figure, left: float, bottom: float, width: float, height: float) -> Axes:
    """Add axes in a place of the figure [inches]."""
    whole, total = figure.get_size_inches()
    return figure.add_axes((left / whole, bottom / total, width / whole, height / total))


def write_title(figure: Figure, left: float, title: str, facts: str, **style: Any) -> None:
    """Write a title and, below it in grey, facts; so far from the left edge [inches]."""
    width, height = figure.get_size_inches()
    at: dict[str, Any] = {"x": left / width, "va": "top"}
    figure.text(y=1.0 - 0.12 / height, s=literal(title), fontsize=13, fontweight="bold", **at)
    figure.text(y=1.0 - 0.4 / height, s=literal(facts), color="0.35", **{"fontsize": 9.5, **at, **style})


def add_legend(
    figure: Figure, handles: Sequence[Artist], loc: Any, x: float, top: float, **style: Any
) -> None:
    """Add a key to a figure, whose corner `loc` is at x, and so far from the upper edge [inches]."""
    width, height = figure.get_size_inches()
    figure.legend(
        handles=list(handles),
        loc=loc,
        bbox_to_anchor=(x / width, 1.0 - top / height),
        frameon=False,
        borderpad=0.0,
        borderaxespad=0.0,
        **style,
    )


def points_entry(label: str, colour: str = POINTS) -> Line2D:
    """Entry of a figure's key for points with error bars."""
    from matplotlib.lines import Line2D

    return Line2D([], [], color=colour, marker="o", markersize=3, linewidth=0.8, label=label)


def add_grid(panel: Axes) -> None:
    """Add a faint grid below the curves; ticks point inwards."""
    panel.grid(True, which="major", color="0.88", linewidth=0.6)
    panel.set_axisbelow(True)
    panel.tick_params(which="both", direction="in")


def mark_2_and_5(*axes: Any) -> None:
    """Mark 2 and 5 times powers of ten on logarithmic axes, without numbers."""
    from matplotlib.ticker import LogLocator, NullFormatter

    for axis in axes:
        axis.set_minor_locator(LogLocator(subs=(2.0, 5.0)))
        axis.set_minor_formatter(NullFormatter())


def marks(size: float) -> dict[str, Any]:
    """Style of points with error bars."""
    return {"fmt": "o", "color": POINTS, "markersize": size, "markeredgewidth": 0.0, "elinewidth": 0.8}


def term_entries(
    fit: Fit, result: AxisFit, hidden: Callable[[NoiseTerm], bool], remark: str
) -> list[KeyEntry]:
    """Entries of all terms with their coefficients, detected or not; a remark on those found but hidden."""
    entries = []
    for term, kind in zip(fit.template.term_labels, fit.template.terms, strict=True):
        if term in result.further:
            continue
        found = [c.in_unit() for c in result.coefficients.values() if c.term == term]
        amplitude, name = found[0], title_of(term, result.axis.sensor)
        if amplitude.detected and len(found) > 1:
            text = f"{name}: " + ", ".join(f"{c.symbol} = {c.describe()}" for c in found)
        else:
            text = f"{name}{'' if amplitude.detected else ':'} {amplitude.describe()}"
        is_hidden = hidden(kind)
        if is_hidden and term in result.term_labels:
            text += remark
        drawn = term in drawn_terms(result) and not is_hidden
        entries.append(KeyEntry(wrapped(text), term_style(fit, result, term) if drawn else None))
    if result.correction:
        entries.append(KeyEntry(wrapped(result.correction), FURTHER))
    elif (response := fit.template.response) is not None:
        own = [c.in_unit() for c in result.coefficients.values() if c.term == response.name()]
        values = ", ".join(f"{c.symbol} = {c.describe()}" for c in own)
        entries.append(KeyEntry(wrapped(f"{title_of(response.name(), result.axis.sensor)}: {values}"), None))
    return entries


def drawn_terms(result: AxisFit) -> set[str]:
    """Labels of the terms of a fitted model that have lines: not those that cannot be told from none."""
    of_terms = [c for c in result.coefficients.values() if c.is_amplitude]
    hidden = {c.term for c in of_terms if c.measured and not (c.detected or c.rivals)}
    return set(result.term_labels) - hidden


def term_style(fit: Fit, result: AxisFit, term_label: str) -> dict[str, Any]:
    """Style of a term's line, the same in every panel."""
    if term_label in result.further:
        return FURTHER
    i = fit.template.term_labels.index(term_label)
    return {"color": COLOURS[i % len(COLOURS)], "linestyle": DASHES[i % len(DASHES)], "linewidth": 1.3}


def wrapped(text: str) -> str:
    """Text in lines of the key's width, not broken between a number and its per cent."""
    lines = textwrap.wrap(text.replace(" %", "\u00a0%"), _KEY_COLUMNS, break_long_words=False)
    return "\n".join(lines).replace("\u00a0", " ")


def facts_of(n: int, rate: float) -> str:
    """Length and rate of a record, e.g. "200 s at 100 Hz, 20,000 samples"."""
    return f"{duration(n / rate)} at {rate:g} Hz, {n:,} samples"


def unit_of(axis: Axis | None) -> tuple[str, float]:
    """Unit in which an axis's deviations are drawn, and its factor to SI."""
    return ("", 1.0) if axis is None else rate_unit(axis)


def label_in(quantity: str, unit: str) -> str:
    """Label of a vertical axis, with its unit if it has one."""
    return f"{quantity}\n[{unit}]" if unit else quantity


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
        check_room(ax, len(panels))
        self._draw_row(panels, [ax], [])
        return figure_of(ax, path)

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

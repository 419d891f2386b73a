"""What all pictures are drawn with: colours, marks, keys, places of panels, and files."""

from __future__ import annotations

import dataclasses
import os
import warnings
import weakref
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, cast

import numpy as np
from jaxtyping import Bool, Float, Int

from allanjax.allan.deviation import AllanDeviation, rate_unit
from allanjax.base import tables
from allanjax.base.errors import AllanjaxError
from allanjax.base.wording import duration, plain, significant, superscript
from allanjax.estimate.result import AxisFit, Fit
from allanjax.inspection.facts import why_no_measurement
from allanjax.noise.estimate import Estimate, title_of
from allanjax.noise.terms import NoiseTerm
from allanjax.record.recording import Axis
from allanjax.record.units import Sensor

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Okabe and Ito's colours, for the colour-blind; the dashes distinguish terms in black and white.
COLOURS = ("#0072B2", "#E69F00", "#009E73", "#D55E00", "#CC79A7", "#56B4E9")
DASHES: tuple[Any, ...] = ("--", "-.", (0, (1, 1)), (0, (5, 1, 1, 1, 1, 1)), (0, (8, 2)), (0, (3, 1)))
#: Sensors in words, in the order in which they are drawn.
SENSORS: dict[Sensor, str] = {"gyro": "gyros", "accel": "accelerometers"}
#: Style of the mark at the place where a model fits worst.
WORST: dict[str, Any] = {"color": COLOURS[3], "linewidth": 1.2, "linestyle": ":"}

# Characters in a line of the key, as many as fit below a panel.
_KEY_COLUMNS = 50
FONT_SIZE = 9.0
#: Distance between a panel and the strip below it [inches], by which the labels of their ticks are clear.
APART = 0.1
CLUSTER_TIME = "cluster time T [s]"
FREQUENCY = "frequency f [Hz]"
TIME = "time since start [s]"
_FORMATS = ("png", "svg", "pdf")
_WINDOWLESS = frozenset({"agg", "cairo", "pdf", "pgf", "ps", "svg", "template"})
# The figure that was drawn last where there are no windows, if it was not saved.
_waiting: weakref.WeakSet[Figure] = weakref.WeakSet()


def ink(paleness: float = 0.0) -> str:
    """Colour between that of text (0) and that of the background (1), in light and in dark styles."""
    from matplotlib import rcParams
    from matplotlib.colors import to_hex, to_rgb

    text, paper = (np.array(to_rgb(rcParams[name])) for name in ("text.color", "axes.facecolor"))
    red, green, blue = text + paleness * (paper - text)
    return to_hex((red, green, blue))


def dots(size: float = 2.4, **more: Any) -> dict[str, Any]:
    """Style of measured points."""
    look = {"marker": "o", "linestyle": "none", "color": ink(0.3), "markersize": size, "markeredgewidth": 0.0}
    return {**look, **more}


def band(colour: Any, alpha: float = 0.25, **more: Any) -> dict[str, Any]:
    """Style of a band, which covers more on dark paper, lest it vanish there."""
    from matplotlib import rcParams
    from matplotlib.colors import to_rgb

    dark = sum(to_rgb(rcParams["axes.facecolor"])) < 1.5
    return {"color": colour, "alpha": min((1.5 if dark else 1.0) * alpha, 1.0), "linewidth": 0.0, **more}


def model_line(label: str = "model") -> dict[str, Any]:
    """Style of a model's line, the sum of its terms."""
    return {"color": ink(), "linewidth": 1.4, "label": label, "zorder": 2.5}


#: How a lower bound is drawn, and what the key says of it.
AT_LEAST = {"linestyle": ":"}
LEAST_KNOWN = "at least this, as not all of N, B and K are given"


def model_band() -> dict[str, Any]:
    """Style of the interval of a model's line."""
    return {"color": ink(0.85), "linewidth": 0.0, "label": "model, 95 %", "zorder": 1.5}


@dataclasses.dataclass(frozen=True)
class Points:
    """Measured values over x with error bars of these lengths below and above, in the unit shown."""

    x: Float[np.ndarray, " m"]
    y: Float[np.ndarray, " m"]
    spread: Float[np.ndarray, "2 m"]
    label: str = "measured"
    style: dict[str, Any] = dataclasses.field(default_factory=dict)

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

    def draw(self, panel: Axes, size: float = 2.6) -> None:
        """Draw the points with their error bars; the panel's limits are set."""
        look = dots(size, label=self.label, zorder=3, elinewidth=0.8, **self.style)
        panel.errorbar(self.x, self.y, self.spread, **look)


def allan_points(curve: AllanDeviation, k: int, scale: float = 1.0) -> Points:
    """Estimates of an axis with their 68 % intervals, in the unit of this size."""
    ends = [end[:, k] for end in curve.confidence_interval(0.68)]
    return Points.of(curve.cluster_time, curve.deviation[:, k], ends, scale)


def times_of(curve: AllanDeviation, most: int = 400) -> Float[np.ndarray, " t"]:
    """Cluster times at which a model's curve is drawn [s].

    They are whole numbers of samples: between them a sinusoid above the Nyquist frequency would be another.
    """
    return np.unique(np.rint(np.geomspace(1.0, curve.cluster_size[-1], most))) / curve.rate


class KeyEntry(NamedTuple):
    """Entry of a panel's key: a term with the style of its curve, or only a remark, and the text's colour."""

    text: str
    style: dict[str, Any] | None = None
    colour: Any = None

    def lines(self) -> list[str]:
        """The text in lines of the key's width, never broken within a word or a formula."""
        return tables.wrapped(self.text, _KEY_COLUMNS, rest="").split("\n")


def style() -> AbstractContextManager[None]:
    """Settings under which a figure is drawn."""
    import matplotlib

    # With a place for titles, Matplotlib does not look for one.
    return matplotlib.rc_context(
        {"font.size": FONT_SIZE, "axes.linewidth": 0.7, "axes.titley": 1.0, "text.usetex": False}
    )


def literal(text: str) -> str:
    """Text for a figure as it is: dollars in a name do not begin a formula."""
    return text.encode("utf-8", "replace").decode("utf-8").replace("$", r"\$")


def new_figure(size: tuple[float, float], path: str | os.PathLike[str] | None, single: bool) -> Figure:
    """Empty figure of this size [inches], which pyplot knows only if it is to be shown, and is a single one.

    So figures do not pile up in pyplot: it knows none that is saved and, where there are no windows, only the
    last one, for `plt.savefig` and the like.
    """
    import matplotlib

    backend = matplotlib.get_backend().lower()
    if "inline" not in backend and (not single or (path is not None and not matplotlib.is_interactive())):
        # Without pyplot, which takes long to load.
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        figure = Figure(figsize=size)
        FigureCanvasAgg(figure)
        return figure
    import matplotlib.pyplot as plt

    if "inline" in backend:
        # A notebook shows the figure returned, once pyplot has made one; left open, it would show it twice.
        figure = plt.figure(figsize=size)
        plt.close(figure)
        return figure
    former = list(_waiting)
    _waiting.clear()
    if backend in _WINDOWLESS:
        for one in former:
            plt.close(one)
    figure = plt.figure(figsize=size)
    _waiting.add(figure)
    return figure


def saved(figure: Figure, path: str | os.PathLike[str] | None) -> Figure:
    """The figure, saved if there is a path: as PNG, SVG or PDF by its suffix, whatever names are in it.

    Raises:
        AllanjaxError: another suffix.
    """
    if path is None:
        return figure
    suffix = os.path.splitext(path)[1].removeprefix(".").lower()
    if suffix and suffix not in _FORMATS:
        raise AllanjaxError(f"{os.fspath(path)!r}: a figure is saved as .png, .svg or .pdf, not .{suffix}")
    with warnings.catch_warnings():
        # The font may lack some of the characters.
        warnings.filterwarnings("ignore", "Glyph .* missing from")
        # As small as at Pillow's own level, in half of the time.
        options: dict[str, Any] = {} if suffix in ("svg", "pdf") else {"pil_kwargs": {"compress_level": 3}}
        figure.savefig(path, dpi=130, **options)
    return figure


def place_below(panel: Axes, height: float, apart: float = APART) -> Axes:
    """Add axes below a panel, so high and so far from it [inches]."""
    box, total = panel.get_position(), panel.figure.bbox.height / panel.figure.dpi
    return panel.figure.add_axes((box.x0, box.y0 - (apart + height) / total, box.width, height / total))


class Heading(NamedTuple):
    """Title of a figure, with the record below it in grey, and the key of the whole figure."""

    title: str
    subtitle: str
    key: Sequence[Artist] = ()

    def _lines(self, width: float) -> tuple[str, list[str], int, int]:
        """The title, the lines below it, and columns and lines of the key, on so many inches."""
        most = int(width * 8)
        title = self.title if len(self.title) <= most else f"{self.title[: most - 1]}…"
        lines = tables.wrapped(self.subtitle, int(width * 12.5), rest="").split("\n")
        widths = [0.6 + 0.065 * len(str(entry.get_label())) for entry in self.key] or [0.0]
        columns = len(widths) if sum(widths) < width else max(int(width / max(widths)), 1)
        return title, lines, columns, -(-len(self.key) // columns)

    def height(self, width: float) -> float:
        """Height from the upper edge to the first panels [inches]; `width` is that of the panels together."""
        _, lines, _, entries = self._lines(width)
        return 0.45 + 0.17 * len(lines) + 0.2 * entries + _HEADING

    def draw(self, figure: Figure, left: float, right: float = 0.2) -> None:
        """Write it, so far from the left and the right edge [inches]."""
        width, height = figure.get_size_inches()
        title, lines, columns, _ = self._lines(width - left - right)
        at: dict[str, Any] = {"x": left / width, "va": "top"}
        figure.text(y=1.0 - 0.12 / height, s=literal(title), fontsize=13, fontweight="bold", **at)
        text = literal("\n".join(lines))
        figure.text(y=1.0 - 0.4 / height, s=text, color=ink(0.35), fontsize=FONT_SIZE, **at)
        figure.legend(
            handles=list(self.key),
            loc="upper left",
            bbox_to_anchor=(left / width, 1.0 - (0.43 + 0.17 * len(lines)) / height),
            frameon=False,
            borderpad=0.0,
            borderaxespad=0.0,
            ncols=columns,
            columnspacing=1.4,
        )


@dataclasses.dataclass(frozen=True)
class Sheet:
    """Places of panels in a figure [inches], fixed so that nothing can overlap.

    Attributes:
        width, height: of a panel.
        gap, between: between columns and between rows.
        left, right, bottom: margins.
    """

    width: float
    height: float
    gap: float = 0.75
    between: float = 0.85
    left: float = 0.95
    right: float = 0.2
    bottom: float = 0.55

    def draw(
        self,
        heading: Heading,
        rows: Sequence[int],
        path: str | os.PathLike[str] | None,
        single: bool = True,
    ) -> tuple[Figure, list[list[Axes]]]:
        """Figure with so many panels in each row, and the panels; for the rest see `new_figure`."""
        inner = max(rows) * (self.width + self.gap) - self.gap
        # A title needs some width.
        width = self.left + self.right + max(inner, 3.0)
        top = heading.height(width - self.left - self.right)
        height = top + self.bottom + len(rows) * (self.height + self.between) - self.between
        figure = new_figure((width, height), path, single)
        heading.draw(figure, self.left, self.right)
        lefts = [(self.left + j * (self.width + self.gap)) / width for j in range(max(rows))]
        bottoms = [
            1.0 - (top + self.height + i * (self.height + self.between)) / height for i in range(len(rows))
        ]
        size = self.width / width, self.height / height
        pairs = zip(bottoms, rows, strict=True)
        return figure, [[figure.add_axes((x, y, *size)) for x in lefts[:count]] for y, count in pairs]


def line_entry(x: Any = (), y: Any = (), **look: Any) -> Artist:
    """Line or marks of this style: without points an entry of a figure's key, which has a label."""
    from matplotlib.lines import Line2D

    return Line2D(x, y, **look)


def measured_entry() -> Artist:
    """Entry of a figure's key for what was measured."""
    return points_entry("measured, 68 % interval")


def model_entry() -> Artist:
    """Entry of a figure's key for a model."""
    return line_entry(**model_line("model, with 95 % interval"))


def points_entry(label: str, colour: Any = None) -> Artist:
    """Entry of a figure's key for points with error bars."""
    return line_entry(color=colour or ink(0.3), marker="o", markersize=3, linewidth=0.8, label=label)


def band_entry(label: str, colour: Any, alpha: float = 1.0) -> Artist:
    """Entry of a figure's key for a band."""
    from matplotlib.patches import Patch

    return Patch(label=label, **band(colour, alpha))


def dress(panel: Axes, name: str = "", x: str = "", y: str = "", log: str = "") -> None:
    """Give a panel its name, labels, logarithmic axes (of "xy"), faint grid and ticks that point inwards."""
    panel.set_axisbelow(True)
    panel.tick_params(which="both", direction="in")
    scales: tuple[Any, ...] = (panel.xaxis, panel.yaxis)
    for axis in scales:
        if axis.axis_name in log:
            _set_log(panel, axis)
        axis.grid(True, linewidth=0.6, color=ink(0.88))
    for text, write in ((x, panel.set_xlabel), (y, panel.set_ylabel)):
        if text:
            write(text)
    if name:
        panel.set_title(name, loc="left", fontweight="bold")


def _set_log(panel: Axes, axis: Any) -> None:
    """Give a panel a logarithmic scale, with marks at 1, 2 and 5 times powers of ten.

    Numbers are plain text, as formulas would take most of the time.
    """
    from matplotlib.ticker import LogLocator, NullFormatter

    panel.set(**{f"{axis.axis_name}scale": "log"})
    setattr(panel, f"fmt_{axis.axis_name}data", "{:.4g}".format)
    axis.set_minor_locator(LogLocator(subs=(2.0, 5.0), numticks=100))
    axis.set_minor_formatter(NullFormatter())
    axis.set_major_formatter(_power_of_ten)


def _power_of_ten(value: float, _: int | None) -> str:
    return f"10{superscript(round(np.log10(value)))}"


def extremes(y: Float[np.ndarray, " n"], most: int = 4000) -> Int[np.ndarray, " m"]:
    """Indices of the points that a long curve is drawn through: the ends of the range of each stretch."""
    stretch = -(-len(y) // most)
    parts = np.pad(y, (0, -len(y) % stretch), mode="edge").reshape(-1, stretch)
    ends = np.arange(len(parts)) * stretch + [parts.argmin(axis=1), parts.argmax(axis=1)]
    return np.unique(np.minimum([*ends.ravel(), 0, len(y)], len(y) - 1))


def blocks(length: int, most: int) -> tuple[Int[np.ndarray, " blocks"], Int[np.ndarray, " blocks"]]:
    """First samples of about equal blocks, and the blocks' lengths."""
    edges = np.unique(np.linspace(0, length, min(most, length) + 1).astype(int))
    return edges[:-1], np.diff(edges)


def mark_off_scale(panel: Axes, x: Float[np.ndarray, " m"], y: Float[np.ndarray, " m"], colour: Any) -> None:
    """Mark points beyond the ends of a panel's vertical scale by triangles at its edges."""
    low, high = panel.get_ylim()
    for beyond, at, marker in ((y > high, 0.97, "^"), (y < low, 0.03, "v")):
        look = dots(3.5, marker=marker, color=colour, label="off scale")
        panel.plot(x[beyond], np.full(beyond.sum(), at), transform=panel.get_xaxis_transform(), **look)


def term_entries(
    fit: Fit, result: AxisFit, hidden: Callable[[NoiseTerm], bool], remark: str, notes: Mapping[str, str] = {}
) -> list[KeyEntry]:
    """Entries of all terms, those not detected together in one; a remark on terms that are not drawn.

    `notes` are what is written after the coefficients of some terms.
    """
    entries, absent = [], []
    styles, further = term_styles(fit, result), result.further
    if not result.measured:
        why = "the model does not fit" if result.is_far_off else why_no_measurement(result.not_measured)
        text = f"not a measurement of this sensor: {why}; values of the fitted curve:"
        entries.append(KeyEntry(text, colour=COLOURS[3]))
    for term, kind in zip(fit.template.term_labels, fit.template.terms, strict=True):
        if term in further:
            continue
        own = [c.in_unit() for c in result.coefficients.values() if c.term == term]
        amplitude, name = own[0], title_of(term, result.axis.sensor)
        limit = amplitude.upper_limit if amplitude.measured and not amplitude.detected else None
        if limit is not None and not amplitude.rivals:
            # Each limit with its term in one line.
            absent.append(f"{name} < {significant(limit)} {amplitude.unit}".replace(" ", "\u00a0"))
            continue
        if not amplitude.value > 0.0 and (amplitude.source == "curve" or not amplitude.measured):
            continue
        is_hidden = hidden(kind)
        if amplitude.detected or not amplitude.measured:
            text = f"{name} " + ", ".join(f"{c.symbol} = {_amount(c)}" for c in own) + notes.get(term, "")
        else:
            text = f"{name} {amplitude.describe()}"
        text += remark if is_hidden and term in result.term_labels else ""
        entries.append(KeyEntry(text, None if is_hidden else styles.get(term)))
    if absent:
        entries.append(KeyEntry(f"not detected (95 % limits): {', '.join(absent)}"))
    if result.correction:
        entries.append(KeyEntry(result.correction, _further()))
    elif (response := fit.template.response) is not None:
        own = [c.in_unit() for c in result.coefficients.values() if c.term == response.name()]
        values = ", ".join(f"{c.symbol} = {_amount(c)}" for c in own)
        entries.append(KeyEntry(f"{title_of(response.name(), result.axis.sensor)}: {values}"))
    return entries


def _amount(c: Estimate) -> str:
    """A coefficient with its error, or the bare value where it is not a measurement."""
    return c.describe() if c.measured else f"{significant(c.value)} {c.unit}"


def verdict_entry(result: AxisFit, unit: Literal["s", "Hz"]) -> KeyEntry:
    """How well the model fits the curve that is drawn, over cluster times [s] or frequencies [Hz].

    What is wrong with the other curve is in the figure of that.
    """
    misfit = next((m for m in (result.misfit, result.other_misfit) if m and m.unit == unit), None)
    if result.converged and not result.measured:
        return KeyEntry(str(misfit) if misfit else "the model follows this curve", WORST if misfit else None)
    if misfit is None or result.worst is misfit:
        return KeyEntry(result.verdict, WORST if misfit else None)
    return KeyEntry(f"{result.word}; here {misfit}", WORST)


def worst_place(result: AxisFit, unit: Literal["s", "Hz"]) -> float:
    """Where the model fits the curve that is drawn worst; nan if it fits."""
    return next((m.at for m in (result.misfit, result.other_misfit) if m and m.unit == unit), np.nan)


def _further() -> dict[str, Any]:
    """Style of what the terms are corrected for: filter, resonances and lines."""
    return {"color": ink(0.55), "linewidth": 0.8, "linestyle": (0, (1, 1))}


def term_styles(fit: Fit, result: AxisFit) -> dict[str, dict[str, Any]]:
    """Styles, the same in every panel, of the terms of a fitted model that have lines, by label.

    Those are the ones detected, and those that have rivals.
    """
    of_terms = [c for c in result.coefficients.values() if c.is_amplitude]
    hidden = {c.term for c in of_terms if c.measured and not (c.detected or c.rivals)}
    known, further = fit.template.term_labels, result.further
    styles = {label: _further() for label in result.term_labels if label in further}
    for label in set(result.term_labels) - hidden - set(further):
        styles[label] = line_style(known.index(label), 1.3)
    return styles


def line_style(k: int, width: float) -> dict[str, Any]:
    """Style of the kth of several lines."""
    return {"color": COLOURS[k % len(COLOURS)], "linestyle": DASHES[k % len(DASHES)], "linewidth": width}


def facts_of(n: int, rate: float) -> str:
    """Length and rate of a record, e.g. "200 s at 100 Hz, 20,000 samples"."""
    return f"{duration(n / rate)} at {rate:g} Hz, {n:,} samples"


def facts_of_curve(curve: AllanDeviation) -> str:
    """Length and rate of a curve's record, or its cluster times if these are not known."""
    if curve.determined:
        return facts_of(curve.n, curve.rate) + curve.describe_others()
    first, last = (duration(float(curve.cluster_time[k])) for k in (0, -1))
    return f"Allan curve from {first} to {last}; {curve.unknown[0]}"


def heading_of(fit: Fit | None, title: str, facts: str, axes: Sequence[str] | str | None) -> Heading:
    """Heading of a measured curve, and of its fit, which has a name and perhaps dead axes."""
    if fit is not None and not fit.curve.determined:
        return Heading(fit.name or title, facts, [points_entry("measured"), line_entry(**model_line())])
    if fit is None:
        return Heading(title, facts, [measured_entry()])
    if axes is None:
        dead = (f"; {a.axis.name} is not drawn: {a.reason}" for a in fit.dead)
        facts += "".join(dead)
    return Heading(fit.name or title, facts, [measured_entry(), model_entry()])


def unit_of(axis: Axis | None) -> tuple[str, float]:
    """Unit in which an axis's deviations are drawn, and its factor to SI."""
    return ("", 1.0) if axis is None else rate_unit(axis)


def label_in(quantity: str, unit: str) -> str:
    """Label of a vertical axis, with its unit if it has one."""
    return f"{quantity}\n[{unit}]" if unit else quantity


# Inches. Panels have fixed places, so that nothing can overlap however many terms a model has.
_PANEL_WIDTH, _STRIP_HEIGHT = 3.5, 0.8
_HEADING, _X_LABEL, _LINE, _BELOW = 0.3, 0.45, 0.165, 0.25
#: Estimates with a larger relative error do not set the scale of the residuals: a judgement.
PRECISE = 0.2
# Ratio of the largest residual to the largest precise one up to which a strip's scale is linear.
_LINEAR = 4.0


@dataclasses.dataclass(frozen=True)
class Residual:
    """Measured values over the model minus one, in per cent.

    Attributes:
        points: residuals over cluster times or frequencies.
        precise: whether the strip's scale is made for each of them.
        chance: where 95 % of each would lie by chance if the model were right.
    """

    points: Points
    precise: Bool[np.ndarray, " m"]
    chance: Float[np.ndarray, "2 m"]


@dataclasses.dataclass(frozen=True)
class Panel:
    """What is drawn of an axis.

    Attributes:
        name: the axis's.
        label: of the vertical scale, the same along a row.
        points: what was measured; logarithmic scales, the same along a row, are made for it.
        draw: draws all else into axes whose scales are set.
        key: entries of the key below.
        residual: None for an axis that has no result.
        worst: where the model fits worst, which is marked; nan for nowhere.
    """

    name: str
    label: str
    points: Sequence[Points]
    draw: Callable[[Axes], None]
    key: Sequence[KeyEntry]
    residual: Residual | None = None
    worst: float = float("nan")


def draw_panels(
    heading: Heading,
    x_label: str,
    rows: Sequence[Sequence[int]],
    panel_of: Callable[[int], Panel],
    path: str | os.PathLike[str] | None,
    ax: Axes | None,
) -> Figure:
    """Draw the panels of axes in rows, saved if there is a path; or the only one of them into `ax`.

    A strip of residuals is below each panel if any axis has residuals.
    """
    if ax is not None and sum(map(len, rows)) > 1:
        raise AllanjaxError('ax= takes a single axis: name it, e.g. axes="gyro_x"')
    with style():
        of_rows = [[panel_of(k) for k in row] for row in rows]
        if ax is not None:
            _draw_row(of_rows[0], [ax], [], x_label)
            # The figure is the caller's to close.
            return saved(cast("Figure", ax.get_figure(root=True)), path)
        every = [panel for row in of_rows for panel in row]
        lines = max(sum(len(entry.lines()) for entry in panel.key) for panel in every)
        strip = 0.0
        if any(panel.residual is not None for panel in every):
            strip = _STRIP_HEIGHT
            chance = band_entry("95 % by chance if the model is right", ink(0.85))
            heading = heading._replace(key=[*heading.key, chance])
        # From the panel to the key.
        apart = strip + APART * (strip > 0.0) + _X_LABEL
        below = apart + (_LINE * lines + _BELOW if lines else 0.0)
        # Panels without points have scales of their own.
        gap, left = (0.25, 0.85) if any(panel.points for panel in every) else (0.75, 1.1)
        sheet = Sheet(_PANEL_WIDTH, 2.3, gap, between=below + _HEADING, left=left, bottom=below)
        figure, places = sheet.draw(heading, [len(row) for row in rows], path)
        for row, panels in zip(of_rows, places, strict=True):
            strips = [place_below(axes, strip) for axes in panels] if strip else []
            for axes, panel in zip(panels, row, strict=True):
                axes.set_title(panel.name, loc="left", fontweight="bold")
                _draw_key(axes, apart, panel.key)
            _draw_row(row, panels, strips, x_label)
        return saved(figure, path)


def _draw_row(row: Sequence[Panel], panels: Sequence[Axes], strips: Sequence[Axes], x_label: str) -> None:
    _set_scales(row, panels, strips)
    for panel, axes in zip(row, panels, strict=True):
        for points in panel.points:
            points.draw(axes)
        panel.draw(axes)
    for panel, axes in zip([*row, *row], [*panels, *strips], strict=False):
        if np.isfinite(panel.worst):
            axes.axvline(panel.worst, label="worst place", **WORST)
    panels[0].set_ylabel(row[0].label)
    if strips:
        _draw_residuals(strips, [panel.residual for panel in row])
        strips[0].set_ylabel("measured /\nmodel − 1 [%]")
    for lowest in strips or panels:
        lowest.set_xlabel(x_label)


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
    """Draw the strips, in the same scale along the row, which shows all points.

    It is linear, or only for precise values if others are much larger, and logarithmic beyond.
    """
    from matplotlib.ticker import NullLocator

    there = [r for r in residuals if r is not None]
    reach = _round(max([2.0, *(abs(r.points.y[r.precise]).max(initial=0.0) for r in there)]))
    ends = [end for r in there for end in (r.points.y.min(), r.points.y.max())]
    high, low = _round(max([reach, *ends])), -min(_round(max([reach, *(-end for end in ends)])), 100.0)
    linear = max(high, -low) <= _LINEAR * reach
    # The ends of the linear part, where their labels are clear of the others.
    inner = [end for end, of in ((-reach, low), (reach, high)) if of / end >= (2.0 if linear else 3.0)]
    marks = [low, *inner, 0.0, high]
    for strip, r in zip(strips, residuals, strict=True):
        if not linear:
            strip.set_yscale("symlog", linthresh=reach)
        strip.set_ylim(1.1 * low, 1.1 * high)
        strip.set_yticks(marks)
        strip.grid(True, linewidth=0.6, color=ink(0.88))
        strip.tick_params(which="both", direction="in", labelleft=strip is strips[0])
        strip.yaxis.set_major_formatter(lambda y, _: plain(y).replace("-", "−"))
        strip.yaxis.set_minor_locator(NullLocator())
        if r is None:
            strip.text(0.5, 0.5, "no result", transform=strip.transAxes, ha="center", va="center")
            continue
        strip.axhline(0.0, color=ink(), linewidth=1.0)
        strip.fill_between(r.points.x, *r.chance, color=ink(0.85), linewidth=0.0, zorder=0, label="chance")
        dataclasses.replace(r.points, label="residual").draw(strip, 2.2)


def _round(x: float) -> float:
    """The next of 1, 2, 3, 5, 7, 10, … from x on."""
    power = 10.0 ** np.floor(np.log10(x))
    return float(next(m * power for m in (1.0, 2.0, 3.0, 5.0, 7.0, 10.0) if m * power >= x))


def _set_scales(row: Sequence[Panel], panels: Sequence[Axes], strips: Sequence[Axes]) -> None:
    """Set the same scales along a row, so that axes compare; terms far below the points leave the panel.

    Panels without points set their own.
    """
    if not any(panel.points for panel in row):
        for axes in panels:
            dress(axes)
        return
    x, y = (
        np.concatenate(of) for of in zip(*((p.x, p.y) for panel in row for p in panel.points), strict=True)
    )
    positive = y[y > 0.0]
    for panel in panels:
        dress(panel, log="xy")
        panel.set_ylim(positive.min(initial=1e6) / 3.0, positive.max(initial=1e-6) * 2.0)
        panel.tick_params(labelleft=panel is panels[0], labelbottom=not strips)
    for strip in strips:
        _set_log(strip, strip.xaxis)
    for axes in (*panels, *strips):
        axes.set_xlim(x.min() / 1.4, x.max() * 1.4)


def _draw_key(panel: Axes, apart: float, entries: Sequence[KeyEntry]) -> None:
    """Write the key so far below a panel [inches], each entry with its curve."""
    from matplotlib.transforms import Affine2D

    figure = cast("Figure", panel.figure)
    # Inches from the corner of the figure, which a notebook may cut off.
    inches = Affine2D().scale(*1.0 / figure.get_size_inches()) + figure.transFigure
    x, y = inches.inverted().transform(panel.bbox.p0) - (0.0, apart)
    for entry in entries:
        if entry.style is not None:
            figure.add_artist(
                line_entry([x, x + 0.32], [y - _LINE / 2.0] * 2, transform=inches, **entry.style)
            )
        colour = entry.colour or ink(0.4 if entry.style is None else 0.0)
        lines = entry.lines()
        look: dict[str, Any] = {"va": "top", "linespacing": 1.25, "fontsize": FONT_SIZE - 0.5}
        figure.text(x + 0.42, y, literal("\n".join(lines)), color=colour, transform=inches, **look)
        y -= _LINE * len(lines)

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
from jaxtyping import Float

from allanjax.allan.deviation import AllanDeviation, rate_unit
from allanjax.base.wording import duration
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

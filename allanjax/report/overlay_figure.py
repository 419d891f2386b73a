"""Figure of several Allan curves over one another: like units, or one before and after."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from jaxtyping import Float

from allanjax.allan.deviation import AllanDeviation
from allanjax.base.errors import AllanjaxError
from allanjax.estimate.result import AxisFit, Fit
from allanjax.record.recording import Axis
from allanjax.report.allan_panel import (
    CLUSTER_TIME,
    Drawable,
    deviation_label,
    draw_measured,
    fit_and_curve,
    kind_of,
    times_to_draw,
    unit_of,
)
from allanjax.report.figure import COLOURS, KeyEntry, Unit, facts_of, wrapped
from allanjax.report.frame import Heading, Panels, rows_of
from allanjax.report.guides import draw_slopes

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

# Markers that tell curves apart in black and white.
_MARKERS = "os^Dv*"


@dataclass(frozen=True)
class _Curve:
    """One of the curves: its label, the fit that it comes from if any, and its style."""

    label: str
    fit: Fit | None
    curve: AllanDeviation
    colour: str
    marker: str

    def index(self, name: str) -> int:
        """Place of the axis of this name among the curve's."""
        return self.curve.names.index(name)

    def result(self, name: str) -> AxisFit | None:
        """Fit of the axis of this name, if there is one."""
        found = None if self.fit is None else self.fit.results[self.index(name)]
        return found if found is not None and found.converged else None


def plot_several(
    data: Sequence[Drawable],
    axes: Sequence[str] | None,
    path: str | os.PathLike[str] | None,
    labels: Sequence[str] | None,
    ax: Axes | None,
) -> Figure:
    """Draw several curves over one another; see `plot_allan`."""
    curves = _curves(data, labels)
    # The axes of all, in the order in which they come.
    known: dict[str, Axis | None] = {}
    for c in curves:
        known |= zip(c.curve.names, c.curve.axes or [None] * len(c.curve.names), strict=True)
    of_curves = [axis for axis in known.values() if axis]
    if of_curves and len(of_curves) < len(known):
        raise AllanjaxError("some of the curves are of arrays without a unit: draw them by themselves")
    rows = rows_of(list(known), of_curves or None, axes)
    facts = "; ".join(dict.fromkeys(facts_of(c.curve.n, c.curve.rate) for c in curves))
    has_model = any(c.fit is not None for c in curves)
    heading = Heading(list(known), kind_of(curves[0].curve), facts, has_model, has_strip=False)
    return _OverlayPanels(curves, list(known), list(known.values())).figure(rows, heading, path, ax)


@dataclass(frozen=True)
class _OverlayPanels(Panels):
    """Several curves over one another, those of axes of one name in one panel.

    Attributes:
        curves: what is drawn.
        names, axes: all their axes; None for those of arrays without a unit.
    """

    X_LABEL: ClassVar[str] = CLUSTER_TIME

    curves: Sequence[_Curve]
    names: Sequence[str]
    axes: Sequence[Axis | None]

    def y_label(self, k: int) -> str:
        return deviation_label(self.curves[0].curve, self._unit(k))

    def key(self, k: int) -> list[KeyEntry]:
        return [_entry(c, self.names[k]) for c in self._of(k)]

    def draw(self, panel: Axes, k: int) -> dict[str, Line2D]:
        unit, name = self._unit(k), self.names[k]
        for c in self._of(k):
            draw_measured(panel, c.curve, c.index(name), unit, c.label, color=c.colour, fmt=c.marker)
            if c.fit is not None and c.result(name) is not None:
                time = times_to_draw(c.curve)
                y = c.fit.model_deviation(name, time) / unit.scale
                panel.plot(time, y, color=c.colour, linewidth=1.2, label=f"{c.label}: model", zorder=2.5)
        return {}

    def extent(self, row: Sequence[int]) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, "m columns"]]:
        drawn = [(c.curve, c.index(self.names[k])) for k in row for c in self._of(k)]
        times = np.sort(np.concatenate([curve.cluster_time for curve, _ in drawn]))
        measured = np.concatenate([curve.deviation[:, i] for curve, i in drawn])
        return times, measured[:, None] / self._unit(row[0]).scale

    def finish(self, panel: Axes, k: int, drawn: dict[str, Line2D]) -> None:
        draw_slopes(panel)

    def add_legend(self, panel: Axes) -> None:
        handles, texts = panel.get_legend_handles_labels()
        drawn = dict(zip(texts, handles, strict=True))
        shown = [c.label for c in self.curves if c.label in drawn]
        panel.legend([drawn[label] for label in shown], shown, frameon=False)

    def _of(self, k: int) -> list[_Curve]:
        """Curves that have the axis of a panel."""
        return [c for c in self.curves if self.names[k] in c.curve.names]

    def _unit(self, k: int) -> Unit:
        return unit_of(self.axes[k])


def _curves(data: Sequence[Drawable], labels: Sequence[str] | None) -> list[_Curve]:
    if not data:
        raise AllanjaxError("nothing to draw: give a fit, or several in a list")
    if labels is not None and len(labels) != len(data):
        raise AllanjaxError(f"{len(labels)} labels for {len(data)} curves: give one for each")
    pairs = [fit_and_curve(x) for x in data]
    kinds = {curve.kind for _, curve in pairs}
    if len(kinds) > 1:
        raise AllanjaxError(f"{' and '.join(sorted(kinds))} deviations do not compare: draw them apart")
    own = [str(getattr(x, "name", "") or k) for k, x in enumerate(data, 1)]
    # Two of one name would look like one.
    own = own if len(set(own)) == len(own) else [str(k) for k in range(1, len(own) + 1)]
    return [
        _Curve(str(label), fit, curve, COLOURS[k % len(COLOURS)], _MARKERS[k % len(_MARKERS)])
        for k, (label, (fit, curve)) in enumerate(zip(labels or own, pairs, strict=True))
    ]


def _entry(c: _Curve, name: str) -> KeyEntry:
    """Entry of a curve in the key: its label and, of a fit, the coefficients that were detected."""
    result, text = c.result(name), c.label
    if c.fit is not None and result is None:
        text += ": no result"
    elif result is not None:
        found = [x for x in result.coefficients.values() if x.detected]
        values = ", ".join(f"{x.symbol} = {x.in_unit().describe()}" for x in found)
        text += f": {values or 'nothing detected'}"
    style = {"color": c.colour, "marker": c.marker, "markevery": [1], "markersize": 3.5, "linewidth": 1.2}
    return KeyEntry(wrapped(text), style)

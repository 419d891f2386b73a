"""Figure of several Allan curves over one another: like units, or one before and after."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

from allanjax.allan.deviation import AllanDeviation
from allanjax.base.errors import AllanjaxError
from allanjax.estimate.result import AxisFit, Fit
from allanjax.record.recording import Axis
from allanjax.report.allan_panel import (
    CLUSTER_TIME,
    Drawable,
    allan_points,
    fit_and_curve,
    kind_of,
    label_in,
    times_to_draw,
    unit_of,
)
from allanjax.report.figure import COLOURS, KeyEntry, facts_of, wrapped
from allanjax.report.frame import Frame, Panel, rows_of
from allanjax.report.guides import draw_slopes

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Markers that tell curves apart in black and white.
_MARKERS = "os^Dv*"


class _Curve(NamedTuple):
    """One of the curves: its label, the fit that it comes from if any, and its style."""

    label: str
    fit: Fit | None
    curve: AllanDeviation
    colour: str
    marker: str

    def result(self, name: str) -> AxisFit | None:
        """Fit of the axis of this name, if it has a result."""
        found = None if self.fit is None else self.fit.results[self.curve.names.index(name)]
        return found if found is not None and found.converged else None


def plot_several(
    data: Sequence[Drawable],
    axes: Sequence[str] | str | None,
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
    names = list(known)
    facts = "; ".join(dict.fromkeys(facts_of(c.curve.n, c.curve.rate) for c in curves))
    has_model = any(c.fit is not None for c in curves)
    frame = Frame(kind_of(curves[0].curve), facts, CLUSTER_TIME, has_model, has_strip=False)
    panels = [
        _panel([c for c in curves if name in c.curve.names], name, axis, ax is not None)
        for name, axis in known.items()
    ]
    return frame.draw([[panels[k] for k in row] for row in rows_of(names, of_curves or None, axes)], path, ax)


def _panel(curves: Sequence[_Curve], name: str, axis: Axis | None, has_legend: bool) -> Panel:
    """Curves of the axes of one name; the legend is for axes of the caller's, which have no key."""
    unit, scale = unit_of(axis)

    def draw(panel: Axes) -> None:
        for c in curves:
            if c.fit is not None and c.result(name) is not None:
                time = times_to_draw(c.curve)
                y = c.fit.model_deviation(name, time) / scale
                panel.plot(time, y, color=c.colour, linewidth=1.2, label=f"{c.label}: model", zorder=2.5)
        draw_slopes(panel)
        if has_legend:
            panel.legend(handles=panel.containers[-len(curves) :], frameon=False)

    points = [
        dataclasses.replace(
            allan_points(c.curve, c.curve.names.index(name), scale),
            label=c.label,
            style={"color": c.colour, "fmt": c.marker},
        )
        for c in curves
    ]
    label = label_in(kind_of(curves[0].curve), unit)
    return Panel(name, label, points, draw, [_entry(c, name) for c in curves])


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

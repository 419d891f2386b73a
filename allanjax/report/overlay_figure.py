"""Several Allan curves over one another: units of a kind, one before and after."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from allanjax.allan.deviation import AllanDeviation
from allanjax.base.errors import AllanjaxError
from allanjax.estimate.result import AxisFit, Fit
from allanjax.report.allan_panel import (
    Drawable,
    deviation_label,
    draw_measured,
    fit_and_curve,
    kind_of,
    times_to_draw,
    unit_of,
)
from allanjax.report.figure import (
    COLOURS,
    Cells,
    KeyEntry,
    draw_key,
    draw_title,
    facts_of,
    figure_with,
    only_one,
    rows_of,
    save_and_close,
    set_scales,
    style,
    wrapped,
)
from allanjax.report.guides import draw_slopes

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# For black and white.
_MARKERS = "os^Dv*"


@dataclass(frozen=True)
class _Curve:
    """One of the curves: its name, what it is, and how it looks."""

    label: str
    fit: Fit | None
    curve: AllanDeviation
    colour: str
    marker: str

    def result(self, name: str) -> AxisFit | None:
        """The fit of the axis of this name, if there is one."""
        found = None if self.fit is None else self.fit.results[self.curve.names.index(name)]
        return found if found is not None and found.converged else None


def plot_several(
    data: Sequence[Drawable],
    axes: Sequence[str] | None,
    path: str | os.PathLike[str] | None,
    labels: Sequence[str] | None,
    ax: Axes | None,
) -> Figure:
    """Draw them; see `plot_allan`."""
    import matplotlib.pyplot as plt

    curves = _curves(data, labels)
    # The axes of all, in the order in which they come.
    known = {name: c.curve.axes and c.curve.axes[k] for c in curves for k, name in enumerate(c.curve.names)}
    names, of_curves = list(known), [axis for axis in known.values() if axis]
    if of_curves and len(of_curves) < len(names):
        raise AllanjaxError("some of the curves are of arrays without a unit: draw them by themselves")
    rows = rows_of(names, of_curves or None, axes)
    with style():
        if ax is not None:
            name = names[only_one(rows)]
            _draw({name: ax}, curves, known[name])
            ax.set_xlabel("cluster time T [s]")
            handles, texts = ax.get_legend_handles_labels()
            drawn = dict(zip(texts, handles, strict=True))
            shown = [c.label for c in curves if c.label in drawn]
            ax.legend([drawn[label] for label in shown], shown, frameon=False)
            return figure_with(ax, path)
        keys = {
            k: [_entry(c, names[k]) for c in curves if names[k] in c.curve.names] for row in rows for k in row
        }
        cells = Cells.of(rows, keys, has_strip=False)
        figure = plt.figure(figsize=cells.size)
        facts = dict.fromkeys(facts_of(c.curve.n, c.curve.rate) for c in curves)
        has_model = any(c.fit is not None for c in curves)
        draw_title(figure, cells, kind_of(curves[0].curve), "; ".join(facts), has_model=has_model)
        for i, row in enumerate(rows):
            panels = {names[k]: cells.panel(figure, i, column) for column, k in enumerate(row)}
            for column, k in enumerate(row):
                panels[names[k]].set_title(names[k], loc="left", fontweight="bold")
                panels[names[k]].set_xlabel("cluster time T [s]")
                draw_key(cells.key(figure, i, column), cells, keys[k])
            _draw(panels, curves, known[names[row[0]]])
        return save_and_close(figure, path)


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


def _draw(panels: dict[str, Axes], curves: Sequence[_Curve], axis: Any) -> None:
    """The panels of a row, in one scale; `axis` is one of them."""
    unit = unit_of(axis)
    seen_x, seen_y = [], []
    for name, panel in panels.items():
        for c in curves:
            if name not in c.curve.names:
                continue
            k, curve = c.curve.names.index(name), c.curve
            draw_measured(panel, curve, k, unit, c.label, color=c.colour, fmt=c.marker)
            seen_x.append(curve.cluster_time)
            seen_y.append(curve.deviation[:, k] / unit.scale)
            if c.fit is not None and c.result(name) is not None:
                time = times_to_draw(curve)
                y = c.fit.model_deviation(name, time) / unit.scale
                label = f"{c.label}: model"
                panel.plot(time, y, color=c.colour, linewidth=1.2, label=label, zorder=2.5)
    times, y = np.sort(np.concatenate(seen_x)), np.concatenate(seen_y)
    set_scales(dict(enumerate(panels.values())), {}, times, y[:, None])
    for panel in panels.values():
        draw_slopes(panel)
    next(iter(panels.values())).set_ylabel(deviation_label(curves[0].curve, unit))


def _entry(c: _Curve, name: str) -> KeyEntry:
    """Its name and, of a fit, what was found."""
    result, text = c.result(name), c.label
    if c.fit is not None and result is None:
        text += ": no result"
    elif result is not None:
        found = [x for x in result.coefficients.values() if x.detected]
        values = ", ".join(f"{x.symbol} = {x.in_unit().describe()}" for x in found)
        text += f": {values or 'nothing detected'}"
    style = {"color": c.colour, "marker": c.marker, "markevery": [1], "markersize": 3.5, "linewidth": 1.2}
    return KeyEntry(wrapped(text), style)

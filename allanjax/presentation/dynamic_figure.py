"""Figure of a dynamic Allan deviation: time against cluster time, with what a critique found over time."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any

import numpy as np

from allanjax.allan.deviation import DynamicAllan
from allanjax.base.wording import duration
from allanjax.presentation import draw
from allanjax.presentation.draw import Heading, Sheet

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from allanjax.critic.result import Critique

_SHEET = Sheet(4.2, 2.4, right=1.1)
# Factor from the median at which the colours end.
_FACTOR, _TICKS = 2.0, (0.5, 0.7, 1.0, 1.4, 2.0)


def plot_dynamic(
    dynamic: DynamicAllan,
    path: str | os.PathLike[str] | None = None,
    *,
    critique: Critique | None = None,
) -> Figure:
    """Draw the Allan deviation of each window over that of the median window, one panel per axis.

    Colours are the ratio on a logarithmic scale. Broken lines are the steps and the beginnings and ends of
    changes that a critique of the record found on the axis.
    """
    from matplotlib.colors import LogNorm

    names = dynamic.names
    key = [draw.line_entry(**_line(), label="found by the critique")] if critique is not None else []
    facts = f"{len(dynamic.time)} windows of {duration(dynamic.window)}"
    heading = Heading(f"{dynamic.name}: Allan deviation through time".removeprefix(": "), facts, key)
    across = min(3, len(names))
    rows = [min(across, len(names) - k) for k in range(0, len(names), across)]
    figure, panels = _SHEET.draw(heading, rows, path)
    ratio = dynamic.deviation / np.median(dynamic.deviation, axis=0)
    edges = np.append(dynamic.time - 0.5 * dynamic.window, dynamic.time[-1] + 0.5 * dynamic.window)
    scale = LogNorm(1.0 / _FACTOR, _FACTOR)
    for k, panel in enumerate(panel for row in panels for panel in row):
        draw.dress(panel, names[k], draw.TIME, draw.CLUSTER_TIME, log="y")
        step = (dynamic.cluster_time[-1] / dynamic.cluster_time[0]) ** (0.5 / (len(dynamic.cluster_time) - 1))
        heights = np.append(dynamic.cluster_time / step, dynamic.cluster_time[-1] * step)
        shown = panel.pcolormesh(edges, heights, ratio[:, :, k].T, norm=scale, cmap="RdBu_r", rasterized=True)
        for time in changes(critique, names[k]):
            panel.axvline(time, **_line())
    place = panels[0][-1].get_position()
    bar = figure.colorbar(shown, figure.add_axes((place.x1 + 0.01, place.y0, 0.012, place.height)))
    bar.set_ticks(_TICKS, labels=[f"{tick:g}" for tick in _TICKS], minor=False)
    bar.ax.minorticks_off()
    bar.set_label("deviation over the median")
    return draw.saved(figure, path)


def _line() -> dict[str, Any]:
    """Style of a time at which a critique found a change."""
    return {"color": draw.ink(), "linestyle": "--", "linewidth": 0.9}


def changes(critique: Critique | None, axis: str) -> list[float]:
    """Times within the record at which findings on an axis begin or end [s]."""
    if critique is None:
        return []
    spans = [f.span for f in critique.findings if f.domain == "time" and axis in f.axes]
    return sorted({float(t) for span in spans for t in span if 0.0 < t < 0.999 * critique.duration})

"""Figure of a comparison: Allan deviations and models of all sensors over one another."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any

import numpy as np

from allanjax.comparison.compare import Comparison, axes_of
from allanjax.noise.estimate import Estimate
from allanjax.presentation import draw
from allanjax.presentation.allan_figure import draw_slopes
from allanjax.presentation.draw import Heading, KeyEntry, Panel
from allanjax.record.recording import Axis
from allanjax.record.units import SI

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Cluster times of models without a record [s], and markers of the sensors.
_TIMES = np.geomspace(0.01, 1e4, 150)
_MARKERS = "os^Dv*"


def plot_comparison(comparison: Comparison, path: str | os.PathLike[str] | None = None) -> Figure:
    """Draw the Allan deviations of all sensors over one another, one panel per axis.

    Points are measured, with 68 % intervals; lines are models. A data sheet has one line for all axes of a
    sensor. The key has the coefficients.
    """
    names = axes_of(comparison.sensors)
    sensors: list[Any] = [name.partition("_")[0] for name in names]
    axes = [Axis(name, kind, SI[kind]["rate"]) for name, kind in zip(names, sensors, strict=True)]
    heading = Heading("Comparison", ", ".join(comparison.labels), [draw.measured_entry(), draw.model_entry()])
    rows = draw.rows_of(names, axes, None)
    return draw.draw_panels(
        heading, draw.CLUSTER_TIME, rows, lambda k: _panel(comparison, axes[k]), path, None
    )


def _panel(comparison: Comparison, axis: Axis) -> Panel:
    """Curves and models of all sensors on an axis."""
    unit, scale = draw.unit_of(axis)
    lines, points, key = [], [], []
    for k, one in enumerate(comparison.sensors):
        look = {"color": draw.COLOURS[k % 6], "linestyle": ("-", *draw.DASHES)[k % 6], "linewidth": 1.2}
        has_curve = one.curve is not None and axis.name in one.curve.names
        if has_curve:
            assert one.curve is not None
            style = {"color": look["color"], "marker": _MARKERS[k % 6]}
            own = draw.allan_points(one.curve[axis.name], 0, scale)
            points.append(draw.Points(own.x, own.y, own.spread, one.label, style))
        if (model := one.model(axis.name)) is not None:
            time = one.curve.cluster_time if has_curve and one.curve is not None else _TIMES
            y = np.sqrt(np.asarray(model.sampled(one.rate).allan_variance(time))) / scale
            lines.append((time, y, look))
        if model is not None or has_curve:
            known = [c for c in one.of(axis.name).values() if c.is_amplitude and (c.detected or c.held)]
            values = ", ".join(_value(c) for c in known if c.symbol in "NBKQR")
            absent = "not a measurement" if model is None else "nothing detected"
            key.append(KeyEntry(f"{one.label}: {values or absent}", look))

    def fill(panel: Axes) -> None:
        for x, y, look in lines:
            panel.plot(x, y, zorder=2.5, **look)
        draw_slopes(panel)

    if not points:
        hidden = {"marker": "none"}
        points = [draw.Points(x, y, np.zeros((2, len(x))), style=hidden) for x, y, _ in lines]
    return Panel(axis.name, draw.label_in("Allan deviation", unit), points, fill, key)


def _value(c: Estimate) -> str:
    """Symbol and value of a coefficient in its usual unit."""
    return f"{c.symbol} = {c.in_unit().describe().removesuffix(' (held)')}"

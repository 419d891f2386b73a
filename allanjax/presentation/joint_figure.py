"""Figure of a joint fit: each coefficient in every recording, the common value and the scatter about it."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from allanjax.comparison.repeatability import JointCoefficient, JointFit
from allanjax.presentation import draw
from allanjax.presentation.draw import Heading, Sheet

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_COMMON, _ODD = draw.COLOURS[0], draw.COLOURS[3]
# Inches for each recording, and for the letters of its name; most letters of a name, its end.
_ROW, _LETTER, _LETTERS = 0.19, 0.075, 24


def plot_joint(
    joint: JointFit, axes: Sequence[str] | str | None = None, path: str | os.PathLike[str] | None = None
) -> Figure:
    """Draw a forest plot of each coefficient: one row of panels per axis, one line per recording.

    Points are the recordings' values with their 95 % intervals, hollow triangles the 95 % limits of what a
    recording does not detect, and red is the odd one. The dark band is the 95 % interval of the common value,
    the pale one the range in which 95 % of recordings lie if their scatter is detected.

    Raises:
        AllanjaxError: there is no such axis.
    """
    results = [joint.results[k] for k in draw.rows_of(joint.axes, None, axes)[0]]
    names = [name if len(name) <= _LETTERS else f"…{name[1 - _LETTERS :]}" for name in joint.names]
    left = 0.3 + _LETTER * max(map(len, names))
    sheet = Sheet(2.6, _ROW * (len(names) + 1), gap=0.3, between=0.95, left=left)
    with draw.style():
        key = [
            draw.points_entry("recording, 95 % interval"),
            draw.line_entry(marker="v", mfc="none", linewidth=0.0, color=draw.ink(0.6), label="95 % limit"),
            draw.points_entry("odd one", _ODD),
            draw.line_entry(color=_COMMON, linewidth=1.4, label="common value"),
            draw.band_entry("its 95 % interval", _COMMON, 0.35),
            draw.band_entry("95 % of recordings", _COMMON, 0.12),
        ]
        heading = Heading(f"{len(names)} recordings", "values of the joint fit", key)
        figure, rows = sheet.draw(heading, [len(axis.coefficients) for axis in results], path)
        for axis, panels in zip(results, rows, strict=True):
            for k, (c, panel) in enumerate(zip(axis.coefficients.values(), panels, strict=True)):
                unit = "" if c.common.usual_unit == "1" else f" [{c.common.usual_unit}]"
                draw.dress(panel, axis.axis.name, x=f"{c.common.title}{unit}")
                panel.set_ylim(len(names) - 0.3, -0.7)
                panel.set_yticks(range(len(names)), [] if k else [draw.literal(name) for name in names])
                _draw(panel, c, joint.names)
        return draw.saved(figure, path)


def _draw(panel: Axes, c: JointCoefficient, names: Sequence[str]) -> None:
    """Draw one coefficient: bands behind, recordings in front, from the top."""
    common, scatter = c.common.in_unit(), c.scatter.in_unit()
    shown = [common.value, *common.interval] if common.detected else [0.0, common.upper_limit or 0.0]
    if common.detected:
        panel.axvspan(*common.interval, **draw.band(_COMMON, 0.35))
        panel.axvline(common.value, color=_COMMON, linewidth=1.4)
        if scatter.detected:
            reach = 2.0 * np.hypot(scatter.value, common.std) / common.value
            ends = common.value * np.exp([-reach, reach])
            panel.axvspan(*ends, **draw.band(_COMMON, 0.12))
            shown += ends.tolist()
    for name, of in c.records.items():
        x, y, odd = of.in_unit(), names.index(name), name == c.effects.odd_one
        colour = _ODD if odd else draw.ink(0.3)
        if x.detected:
            panel.plot(x.interval, [y, y], color=colour, linewidth=0.9)
            panel.plot(x.value, y, **draw.dots(3.6, color=colour))
        elif x.upper_limit is not None:
            panel.plot(x.upper_limit, y, "v", color=draw.ink(0.6), mfc="none", markersize=4.0)
        shown += x.interval if x.detected else (x.upper_limit or x.value,)
    low, high = np.nanmin(shown), np.nanmax(shown)
    margin = 0.08 * (high - low) or 0.1 * abs(high) or 1.0
    values = [x.in_unit().value for x in c.records.values()]
    # Wider intervals leave the panel.
    reach = margin + (max(np.ptp(values), 4.0 * common.std) or high - low)
    panel.set_xlim(max(low, min(values) - reach) - margin, min(high, max(values) + reach) + margin)

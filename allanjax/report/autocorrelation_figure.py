"""Figure of autocorrelations over the lag."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from allanjax.base.normal import TWO_SIDED_95
from allanjax.report.figure import (
    POINTS,
    add_grid,
    check_room,
    facts_of,
    figure_of,
    label_in,
    place,
    rows_of,
    save_and_close,
    style,
    write_title,
)
from allanjax.spectrum.autocorrelation import Autocorrelation, square_unit

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Inches.
_LEFT, _RIGHT, _WIDTH, _HEIGHT, _GAP, _TOP, _BELOW = 1.1, 0.2, 3.6, 2.2, 0.75, 0.9, 0.75


def plot_autocorrelation(
    found: Autocorrelation,
    axes: Sequence[str] | str | None = None,
    path: str | os.PathLike[str] | None = None,
    *,
    ax: Axes | None = None,
) -> Figure:
    """Draw autocorrelations over the lag, as figure 3.8 of Hou (2004), gyros above accelerometers.

    The grey band is ± 1.96 standard errors of the model, if there are any; the dotted lines are the value at
    lag zero over e, and the lag at which the curve comes there.

    Args:
        found: what `autocorrelation` returns.
        axes: names of the axes to draw; all of them by default.
        path: a file to save the picture to, by its suffix .png, .svg or .pdf.
        ax: matplotlib axes to draw a single axis into, without title.

    Raises:
        AllanjaxError: there is no such axis, or `ax` is given for more than one axis.
    """
    import matplotlib.pyplot as plt

    rows = rows_of(found.names, found.axes, axes)
    check_room(ax, sum(map(len, rows)))
    if ax is not None:
        _draw(ax, found, rows[0][0])
        return figure_of(ax, path)
    with style():
        columns = max(map(len, rows))
        width = _LEFT + columns * (_WIDTH + _GAP) - _GAP + _RIGHT
        height = _TOP + len(rows) * (_HEIGHT + _BELOW)
        figure = plt.figure(figsize=(width, height))
        write_title(figure, _LEFT, "Autocorrelation", facts_of(found.n, found.rate))
        for i, row in enumerate(rows):
            for column, k in enumerate(row):
                bottom = height - _TOP - (i + 1) * (_HEIGHT + _BELOW) + _BELOW
                panel = place(figure, _LEFT + column * (_WIDTH + _GAP), bottom, _WIDTH, _HEIGHT)
                panel.set_title(found.names[k], loc="left", fontweight="bold")
                _draw(panel, found, k)
                if column:
                    panel.set_ylabel("")
        return save_and_close(figure, path)


def _draw(panel: Axes, found: Autocorrelation, k: int) -> None:
    unit, scale = ("", 1.0) if found.axes is None else square_unit(found.axes[k])
    value, error = found.value[:, k] / scale, found.standard_error[:, k] / scale
    if np.isfinite(error).all():
        band: dict[str, Any] = {"color": "0.85", "linewidth": 0.0, "label": "95 % under the model"}
        panel.fill_between(found.lag, value - TWO_SIDED_95 * error, value + TWO_SIDED_95 * error, **band)
    panel.plot(found.lag, value, color=POINTS, linewidth=1.0, label="estimate")
    below = np.flatnonzero(math.e * value < value[0])
    if below.size:
        dotted: dict[str, Any] = {"color": "0.5", "linewidth": 0.8, "linestyle": ":"}
        panel.axhline(value[0] / math.e, **dotted)
        panel.axvline(found.lag[below[0]], **dotted)
    panel.set_xlim(-0.02 * found.lag[-1], found.lag[-1])
    panel.set_xlabel("lag [s]")
    panel.set_ylabel(label_in("autocorrelation", unit))
    add_grid(panel)

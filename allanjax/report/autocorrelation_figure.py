"""Figure of autocorrelations over the lag."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from allanjax.base.normal import TWO_SIDED_95
from allanjax.base.wording import plain
from allanjax.report.figure import (
    Heading,
    Sheet,
    check_single,
    dress,
    facts_of,
    figure_of,
    ink,
    label_in,
    rows_of,
    save_and_close,
    style,
)
from allanjax.spectrum.autocorrelation import Autocorrelation, square_unit

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_SHEET = Sheet(3.4, 2.2, left=1.1)


def plot_autocorrelation(
    result: Autocorrelation,
    axes: Sequence[str] | str | None = None,
    path: str | os.PathLike[str] | None = None,
    *,
    ax: Axes | None = None,
) -> Figure:
    """Draw autocorrelations over the lag, as figure 3.8 of Hou (2004), gyros above accelerometers.

    The grey band is ± 1.96 standard errors of the model, if there are any; the dotted lines are the value at
    lag zero over e, and the lag at which the curve comes there.

    Args:
        result: what `autocorrelation` returns.
        axes: names of the axes to draw; all of them by default.
        path: a file to save the picture to, by its suffix .png, .svg or .pdf.
        ax: matplotlib axes to draw a single axis into, without title.

    Raises:
        AllanjaxError: there is no such axis, or `ax` is given for more than one axis.
    """
    rows = rows_of(result.names, result.axes, axes)
    check_single(ax, sum(map(len, rows)))
    if ax is not None:
        _draw(ax, result, rows[0][0])
        return figure_of(ax, path)
    with style():
        heading = Heading("Autocorrelation", facts_of(result.n, result.rate))
        figure, panels = _SHEET.draw(heading, [len(row) for row in rows])
        for row, axes_of in zip(rows, panels, strict=True):
            for k, panel in zip(row, axes_of, strict=True):
                _draw(panel, result, k)
                panel.set_title(result.names[k], loc="left", fontweight="bold")
                if panel is not axes_of[0]:
                    panel.set_ylabel("")
        return save_and_close(figure, path)


def _draw(panel: Axes, result: Autocorrelation, k: int) -> None:
    unit, scale = ("", 1.0) if result.axes is None else square_unit(result.axes[k])
    value, error = result.value[:, k] / scale, result.standard_error[:, k] / scale
    if np.isfinite(error).all():
        band: dict[str, Any] = {"color": ink(0.85), "linewidth": 0.0, "label": "95 % under the model"}
        panel.fill_between(result.lag, value - TWO_SIDED_95 * error, value + TWO_SIDED_95 * error, **band)
    panel.plot(result.lag, value, color=ink(0.3), linewidth=1.0, label="estimate")
    below = np.flatnonzero(math.e * value < value[0])
    if below.size:
        dotted: dict[str, Any] = {"color": ink(0.5), "linewidth": 0.8, "linestyle": ":"}
        panel.axhline(value[0] / math.e, **dotted)
        panel.axvline(result.lag[below[0]], **dotted)
    panel.set_xlim(-0.02 * result.lag[-1], result.lag[-1])
    panel.yaxis.set_major_formatter(lambda y, _: plain(y).replace("-", "−"))
    dress(panel, x="lag [s]", y=label_in("autocorrelation", unit))

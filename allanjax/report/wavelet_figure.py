"""Figures of wavelet variances, and of a recording taken apart into octaves."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from allanjax.base.wording import plain
from allanjax.report.figure import (
    COLOURS,
    TIME,
    Frame,
    Heading,
    Panel,
    Points,
    Sheet,
    dress,
    facts_of,
    ink,
    label_in,
    rows_of,
    save_and_close,
    style,
    unit_of,
)
from allanjax.spectrum.autocorrelation import square_unit
from allanjax.wavelets.decomposition import WaveletDecomposition
from allanjax.wavelets.variance import WaveletVariance

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_SHEET = Sheet(5.6, 0.8, between=0.12, left=1.6)
# More samples than this are drawn as the range of each of so many stretches.
_DRAWN = 4000


def plot_wavelet_variance(
    variance: WaveletVariance,
    axes: Sequence[str] | str | None = None,
    path: str | os.PathLike[str] | None = None,
    *,
    ax: Axes | None = None,
) -> Figure:
    """Draw wavelet variances with their 68 % intervals against the scale, gyros above accelerometers.

    Args:
        variance: what `wavelet_variance` returns.
        axes: names of the axes to draw; all of them by default.
        path: a file to save the picture to, by its suffix .png, .svg or .pdf.
        ax: matplotlib axes to draw a single axis into, without title and key.

    Raises:
        AllanjaxError: there is no such axis, or `ax` is given for more than one axis.
    """
    ends = variance.confidence_interval(0.68)

    def panel(k: int) -> Panel:
        unit, scale = ("", 1.0) if variance.axes is None else square_unit(variance.axes[k])
        points = Points.of(variance.scale, variance.variance[:, k], [end[:, k] for end in ends], scale)
        return Panel(variance.names[k], label_in("wavelet variance", unit), [points], lambda _: None, [])

    facts = f"{variance.wavelet}, {facts_of(variance.n, variance.rate)}"
    frame = Frame("Wavelet variance", facts, "scale [s]", False, False)
    rows = rows_of(variance.names, variance.axes, axes)
    return frame.draw([[panel(k) for k in row] for row in rows], path, ax)


def plot_decomposition(
    decomposition: WaveletDecomposition,
    axis: str | None = None,
    levels: Sequence[int] | None = None,
    path: str | os.PathLike[str] | None = None,
) -> Figure:
    """Draw an axis as measured, its details and the last approximation, one below the other, over time.

    As figure 3.6 of Hou (2004), with what was taken out between. Long records are drawn as the range of each
    of some thousand stretches.

    Args:
        decomposition: what `wavelet_decomposition` returns.
        axis: name of the axis; the first by default.
        levels: levels of the details to draw, and the last of them is that of the approximation; by default
            all.
        path: a file to save the picture to, by its suffix .png, .svg or .pdf.

    Raises:
        AllanjaxError: there is no such axis or level.
    """
    recording = decomposition.recording
    k = rows_of(recording.names, None, axis)[0][0]
    name = recording.names[k]
    unit, scale = unit_of(recording.axes[k])
    shown = sorted(levels) if levels else list(range(1, decomposition.levels + 1))
    parts = [("measured", recording)]
    for level in shown:
        low, high = (plain(float(f), 2) for f in decomposition.band[level - 1])
        parts.append((f"level {level}\n{low}–{high} Hz", decomposition.details(level)))
    lowest = plain(float(decomposition.band[shown[-1] - 1, 0]), 2)
    parts.append((f"below\n{lowest} Hz", decomposition.approximation(shown[-1])))
    with style():
        record = f"{decomposition.wavelet}, {facts_of(recording.n, recording.rate)}"
        heading = Heading(f"{name}, wavelet decomposition [{unit}]", record)
        figure, panels = _SHEET.draw(heading, [1] * len(parts))
        for row, ((label, part), (panel,)) in enumerate(zip(parts, panels, strict=True)):
            dress(panel)
            _draw_range(panel, part.values[:, k] / scale, recording.rate, row in (0, len(parts) - 1))
            panel.set_ylabel(label, rotation=0, ha="right", va="center")
            panel.yaxis.set_label_coords(-0.11, 0.5)
            panel.set_xlim(0.0, recording.n / recording.rate)
            panel.tick_params(labelbottom=row == len(parts) - 1)
        panel.set_xlabel(TIME)
        return save_and_close(figure, path)


def _draw_range(panel: Axes, x: Any, rate: float, measured: bool) -> None:
    """Draw samples over time, of a long record the range of each stretch."""
    colour = ink(0.3) if measured else COLOURS[0]
    if len(x) <= _DRAWN:
        panel.plot(np.arange(len(x)) / rate, x, color=colour, linewidth=0.7)
        return
    stretch = -(-len(x) // _DRAWN)
    starts = np.arange(0, len(x), stretch)
    low, high = np.minimum.reduceat(x, starts), np.maximum.reduceat(x, starts)
    panel.fill_between((starts + stretch / 2.0) / rate, low, high, color=colour, linewidth=0.4)

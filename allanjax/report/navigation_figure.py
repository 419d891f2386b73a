"""Figure of a navigator's errors over time: a panel a quantity and direction, with what causes them."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any

import numpy as np

from allanjax.base.wording import duration
from allanjax.navigation.navigator import SHOWN, ErrorGrowth, Navigation
from allanjax.report.figure import (
    COLOURS,
    DASHES,
    MODEL,
    add_grid,
    add_legend,
    place,
    save_and_close,
    style,
    write_title,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Inches.
_LEFT, _RIGHT, _TOP, _BOTTOM, _LINE = 0.85, 0.2, 0.95, 0.1, 0.2
_WIDTH, _HEIGHT, _GAP, _ROW = 2.9, 2.1, 0.55, 0.65
# Causes below this share of the error at all times are not drawn.
_DRAWN = 0.05


def plot_navigation(result: Navigation, path: str | os.PathLike[str] | None = None) -> Figure:
    """Draw errors against time, with their 95 % intervals and what each cause does by itself.

    Rows are attitude, velocity and position, columns north, east and down. The black line is the error, the
    grey band its interval; causes have a colour a term, and those below 5 % of the error at all times are
    left out. A dotted line is a quarter of the Schuler period, where the times reach it.

    Args:
        result: what `navigate` returned.
        path: a file to save the picture to, by its suffix .png, .svg or .pdf.
    """
    import matplotlib.pyplot as plt
    from matplotlib.lines import Line2D

    growths = list(result.values())
    columns = list(dict.fromkeys(channel for growth in growths for channel in growth.channels))
    styles = _styles(growths)
    lines = -(-(len(styles) + 1) // max(len(columns), 1))
    width = _LEFT + _RIGHT + len(columns) * (_WIDTH + _GAP) - _GAP
    height = _TOP + len(growths) * (_HEIGHT + _ROW) + _BOTTOM + lines * _LINE
    with style():
        figure = plt.figure(figsize=(width, height))
        write_title(figure, _LEFT, result.name or "Errors of a navigator at rest", _facts(result))
        for i, growth in enumerate(growths):
            for j, channel in enumerate(columns):
                if channel in growth.channels:
                    bottom = height - _TOP - (i + 1) * (_HEIGHT + _ROW) + _ROW
                    panel = place(figure, _LEFT + j * (_WIDTH + _GAP), bottom, _WIDTH, _HEIGHT)
                    _draw(panel, growth, channel, styles)
                    if growth.time[-1] > result.quarter_period:
                        panel.axvline(result.quarter_period, color="0.4", linewidth=0.8, linestyle=":")
        # Models that are taken as exact have none.
        interval = ", with its 95 % interval" if np.isfinite(growths[0].lower).any() else ""
        handles = [Line2D([], [], **{**MODEL, "label": f"error, 1σ{interval}"})]
        handles += [Line2D([], [], label=name, **of) for name, of in styles.items()]
        place_of_key = height - _BOTTOM - lines * _LINE
        add_legend(figure, handles, "upper left", _LEFT, place_of_key, ncols=len(columns))
        return save_and_close(figure, path)


def _facts(result: Navigation) -> str:
    loop = "Schuler loop included" if result.schuler else "short-term"
    return f"biases averaged over {duration(result.calibration)} at rest, {result.rate:g} Hz, {loop}"


def _styles(growths: list[ErrorGrowth]) -> dict[str, dict[str, Any]]:
    """Styles of causes that matter somewhere, by sensor and term, the same in all panels."""
    names = [
        _kind(cause)
        for growth in growths
        for channel in growth.channels
        for cause, part in growth.causes[channel].items()
        if (part**2 >= _DRAWN * growth.of(channel) ** 2).any()
    ]
    return {
        # Where colours come again, their dashes are others.
        name: {
            "color": COLOURS[k % len(COLOURS)],
            "linestyle": DASHES[(k + k // len(COLOURS)) % len(DASHES)],
            "linewidth": 1.2,
        }
        for k, name in enumerate(dict.fromkeys(names))
    }


def _kind(cause: str) -> str:
    """A cause without the letter of its axis, e.g. "gyro angle random walk"."""
    axis, _, term = cause.partition(" ")
    return f"{axis.partition('_')[0]} {term}"


def _draw(panel: Axes, growth: ErrorGrowth, channel: str, styles: dict[str, dict[str, Any]]) -> None:
    unit, scale = SHOWN[growth.quantity]
    k, error = growth.channels.index(channel), growth.of(channel)
    panel.set(xscale="log", yscale="log", xlabel="time since the start [s]")
    panel.set_title(f"{growth.quantity} {channel} [{unit}]", loc="left", fontweight="bold")
    add_grid(panel)
    panel.fill_between(growth.time, growth.lower[k] / scale, growth.upper[k] / scale, color="0.85", zorder=1)
    for cause, part in growth.causes[channel].items():
        if (part**2 >= _DRAWN * error**2).any():
            panel.plot(growth.time, part / scale, label=cause, **styles[_kind(cause)])
    panel.plot(growth.time, error / scale, **MODEL)
    panel.set_ylim(error.min() / scale / 3.0, error.max() / scale * 3.0)

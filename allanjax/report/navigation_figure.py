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
    TIME,
    Heading,
    Sheet,
    dress,
    ink,
    model_line,
    save_and_close,
    style,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_SHEET = Sheet(2.9, 2.1, gap=0.55)
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
    from matplotlib.lines import Line2D

    growths = list(result.values())
    columns = list(dict.fromkeys(channel for growth in growths for channel in growth.channels))
    styles = _styles(growths)
    with style():
        # Models that are taken as exact have no interval.
        interval = ", with its 95 % interval" if np.isfinite(growths[0].lower).any() else ""
        key = [Line2D([], [], **model_line(f"error, 1σ{interval}"))]
        key += [Line2D([], [], label=name, **of) for name, of in styles.items()]
        heading = Heading(result.name or "Errors of a navigator at rest", _conditions(result), key)
        figure, panels = _SHEET.draw(heading, [len(columns)] * len(growths))
        for growth, row in zip(growths, panels, strict=True):
            for channel, panel in zip(columns, row, strict=True):
                if channel not in growth.channels:
                    panel.remove()
                    continue
                _draw(panel, growth, channel, styles)
                if growth.time[-1] > result.quarter_period:
                    panel.axvline(result.quarter_period, color=ink(0.4), linewidth=0.8, linestyle=":")
        return save_and_close(figure, path)


def _conditions(result: Navigation) -> str:
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
    dress(panel, f"{growth.quantity} {channel} [{unit}]", TIME, log="xy")
    lower, upper = growth.lower[k] / scale, growth.upper[k] / scale
    panel.fill_between(growth.time, lower, upper, color=ink(0.85), zorder=1)
    for cause, part in growth.causes[channel].items():
        if (part**2 >= _DRAWN * error**2).any():
            panel.plot(growth.time, part / scale, label=cause, **styles[_kind(cause)])
    panel.plot(growth.time, error / scale, **model_line())
    panel.set_ylim(error.min() / scale / 3.0, error.max() / scale * 3.0)

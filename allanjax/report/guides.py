"""Guides in an Allan plot: the slopes of the noise terms, and N, B and K on their lines."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float

from allanjax.estimate.result import AxisFit

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.lines import Line2D

SLOPES = {-1.0: "−1", -0.5: "−½", 0.0: "0", 0.5: "+½", 1.0: "+1"}
"""Slopes of quantization, angle random walk, bias instability, rate random walk and ramp, as written."""

# Terms whose coefficient is written on its line, and the text.
_WRITTEN = {
    "angle_random_walk": "{symbol} = {value}",
    "bias_instability": "0.664 {symbol}, {symbol} = {value}",
    "rate_random_walk": "{symbol} = {value}",
}
_FAINT, _FAINT_TEXT, _SIZE = "0.78", "0.55", 6.5
# Mean width of a character, height of a line, and distance of a text from its line, over the font's size.
_WIDTH, _HEIGHT, _AWAY = 0.56, 1.0, 0.95
# Places along a line that are tried.
_PLACES = 60


def draw_slopes(panel: Axes) -> None:
    """Draw faint lines of the slopes through the middle of a panel whose scales are set."""
    (left, right), (bottom, top) = (np.log10(ends) for ends in (panel.get_xlim(), panel.get_ylim()))
    x0, y0 = (left + right) / 2.0, (bottom + top) / 2.0
    for slope, name in SLOPES.items():
        # Where it leaves the panel.
        reach = min((right - left) / 2.0, np.inf if slope == 0.0 else (top - bottom) / 2.0 / abs(slope))
        ends = np.array([-reach, reach])
        panel.plot(
            10.0 ** (x0 + ends),
            10.0 ** (y0 + slope * ends),
            color=_FAINT,
            linewidth=0.7,
            linestyle=(0, (1, 4)),
            zorder=0.5,
            label=f"slope {name}",
        )
        end = 0.93 * reach
        panel.text(
            10.0 ** (x0 + end),
            10.0 ** (y0 + slope * end),
            name,
            color=_FAINT_TEXT,
            fontsize=_SIZE,
            ha="center",
            va="center",
            zorder=0.6,
            bbox={"facecolor": "white", "edgecolor": "none", "pad": 0.6},
        )


def write_values(panel: Axes, result: AxisFit, drawn: dict[str, Line2D]) -> None:
    """Write N, B and K with their units on the lines of their terms, where there is most room.

    Args:
        panel: panel with all its points and lines, its scales set.
        result: fit of the axis.
        drawn: line of each term, by its label.
    """
    from matplotlib.patheffects import withStroke

    others = [_pixels(panel, line) for line in panel.get_lines() if line.get_zorder() > 1.0]
    # Error bars, as a few points of each.
    share = np.linspace(0.0, 1.0, 7)[:, None]
    bars = [bar for of in panel.collections if hasattr(of, "get_segments") for bar in of.get_segments()]
    pixels = [panel.transData.transform(np.maximum(bar, 1e-300)) for bar in bars]
    others += [ends[0] + share * (ends[1] - ends[0]) for ends in pixels if len(ends) == 2]
    written = [text.get_window_extent() for text in panel.texts]
    taken = [np.array([[box.x0, box.y0], [box.x1, box.y1]]) for box in written]
    for label, line in drawn.items():
        c = result.coefficients.get(label)
        if c is None or c.term not in _WRITTEN or not c.detected:
            continue
        shown = c.in_unit()
        value = shown.describe().split(" ± ")[0].removesuffix(" (held)").removeprefix("(")
        value = value if value.endswith(shown.unit) else f"{value} {shown.unit}"
        text = _WRITTEN[c.term].format(symbol=c.symbol, value=value)
        own = _pixels(panel, line)
        place = _roomiest(panel, own, text, [x for x in others if not np.array_equal(x, own)], taken)
        if place is None:
            continue
        middle, angle, corners = place
        x, y = panel.transData.inverted().transform(middle)
        panel.text(
            x,
            y,
            text,
            color=line.get_color(),
            fontsize=_SIZE,
            rotation=np.degrees(angle),
            rotation_mode="anchor",
            ha="center",
            va="center",
            zorder=4.0,
            path_effects=[withStroke(linewidth=1.5, foreground="white")],
        )
        taken.append(np.array([corners.min(axis=0), corners.max(axis=0)]))


def _pixels(panel: Axes, line: Line2D) -> Float[np.ndarray, "points 2"]:
    """Points of a line on the screen, in pixels."""
    points = np.asarray(line.get_xydata(), float)
    return panel.transData.transform(points[(points > 0.0).all(axis=1)])


def _roomiest(
    panel: Axes,
    line: Float[np.ndarray, "points 2"],
    text: str,
    others: Sequence[Float[np.ndarray, "_ 2"]],
    taken: Sequence[Float[np.ndarray, "2 2"]],
) -> tuple[Float[np.ndarray, " 2"], float, Float[np.ndarray, "4 2"]] | None:
    """Middle, angle and corners of the place beside a line that is farthest from everything else.

    None if there is no place inside the panel that another text has not taken.
    """
    size = _SIZE * panel.figure.dpi / 72.0
    half = np.array([0.5 * _WIDTH * len(text), 0.5 * _HEIGHT]) * size
    box = panel.bbox
    lower, upper = np.array([box.x0, box.y0]) + 4.0, np.array([box.x1, box.y1]) - 4.0
    if len(line) < 2 or not others:
        return None
    obstacles = np.concatenate(others)
    obstacles = obstacles[((obstacles > lower - 50.0) & (obstacles < upper + 50.0)).all(axis=1)]
    # Places along the line, at equal distances on the screen, on either side of it, near and not so near.
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(line, axis=0).T))])
    at = np.linspace(0.0, along[-1], _PLACES)
    before, after = (np.clip(at + sign * half[0], 0.0, along[-1]) for sign in (-1.0, 1.0))
    points, starts, ends = (
        np.stack([np.interp(s, along, line[:, i]) for i in (0, 1)], axis=1) for s in (at, before, after)
    )
    direction = (ends - starts) / np.maximum(np.hypot(*(ends - starts).T), 1e-9)[:, None]
    normal = np.stack([-direction[:, 1], direction[:, 0]], axis=1)
    away = np.repeat([_AWAY, -_AWAY, 1.7 * _AWAY, -1.7 * _AWAY], _PLACES)[:, None] * size
    points, direction, normal = (np.tile(x, (4, 1)) for x in (points, direction, normal))
    middle = points + away * normal
    # A grid of points of each text's box.
    u, v = np.meshgrid(np.linspace(-1.0, 1.0, 9), np.linspace(-1.0, 1.0, 3))
    grid = (
        middle[:, None]
        + (u.ravel() * half[0])[:, None] * direction[:, None]
        + (v.ravel() * half[1])[:, None] * normal[:, None]
    )
    corners = grid[:, [0, 8, 18, 26]]
    fits = _free(corners, lower, upper, taken)
    if not fits.any():
        return None
    distance = np.full(len(grid), -1.0)
    for k in np.flatnonzero(fits):
        distance[k] = np.sqrt(((grid[k][:, None] - obstacles) ** 2).sum(axis=2).min())
    best = int(np.argmax(distance))
    return middle[best], float(np.arctan2(direction[best, 1], direction[best, 0])), corners[best]


def _free(
    corners: Float[np.ndarray, "places 4 2"],
    lower: Float[np.ndarray, " 2"],
    upper: Float[np.ndarray, " 2"],
    taken: Sequence[Float[np.ndarray, "2 2"]],
) -> Bool[np.ndarray, " places"]:
    """Whether each box is inside the panel and clear of those taken."""
    low, high = corners.min(axis=1), corners.max(axis=1)
    fits = (low > lower).all(axis=1) & (high < upper).all(axis=1)
    for a, b in taken:
        fits &= ((high < a - 2.0) | (low > b + 2.0)).any(axis=1)
    return fits

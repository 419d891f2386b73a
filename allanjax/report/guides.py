"""Guides in an Allan plot: the slopes of the noise terms, and N, B and K on their lines."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Complex, Float

from allanjax.base.wording import without_error
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
# Points of the screen, x + iy, and the lower left and upper right corner of a box.
_Pixels = Complex[np.ndarray, " _"]
_Box = tuple[complex, complex]


def draw_slopes(panel: Axes) -> None:
    """Draw faint lines of the slopes through the middle of a panel whose scales are set."""
    (left, right), (bottom, top) = (np.log10(ends) for ends in (panel.get_xlim(), panel.get_ylim()))
    x0, y0 = (left + right) / 2.0, (bottom + top) / 2.0
    for slope, name in SLOPES.items():
        # Where it leaves the panel.
        reach = min((right - left) / 2.0, np.inf if slope == 0.0 else (top - bottom) / 2.0 / abs(slope))
        ends = np.array([-reach, reach])
        look: dict[str, Any] = {"color": _FAINT, "linewidth": 0.7, "linestyle": (0, (1, 4)), "zorder": 0.5}
        panel.plot(10.0 ** (x0 + ends), 10.0 ** (y0 + slope * ends), label=f"slope {name}", **look)
        end = 0.93 * reach
        box = {"facecolor": "white", "edgecolor": "none", "pad": 0.6}
        style: dict[str, Any] = {"color": _FAINT_TEXT, "fontsize": _SIZE, "zorder": 0.6, "bbox": box}
        panel.text(10.0 ** (x0 + end), 10.0 ** (y0 + slope * end), name, ha="center", va="center", **style)


def write_values(panel: Axes, result: AxisFit, drawn: dict[str, Line2D]) -> None:
    """Write N, B and K with their units on the lines `drawn` of their terms, where there is most room."""
    from matplotlib.patheffects import withStroke

    others = [_pixels(panel, line.get_xydata()) for line in panel.get_lines() if line.get_zorder() > 1.0]
    # Error bars, as a few points of each.
    bars = [bar for of in panel.collections if hasattr(of, "get_segments") for bar in of.get_segments()]
    ends = [_pixels(panel, np.maximum(bar, 1e-300)) for bar in bars]
    others += [np.linspace(pair[0], pair[1], 7) for pair in ends if len(pair) == 2]
    written = [text.get_window_extent() for text in panel.texts]
    taken = [(complex(*box.p0), complex(*box.p1)) for box in written]
    for label, line in drawn.items():
        c = result.coefficients.get(label)
        if c is None or c.term not in _WRITTEN or not c.detected:
            continue
        shown = c.in_unit()
        value = f"{without_error(shown.value, shown.std)} {shown.unit}"
        text = _WRITTEN[c.term].format(symbol=c.symbol, value=value)
        own = _pixels(panel, line.get_xydata())
        place = _roomiest(panel, own, len(text), [x for x in others if not np.array_equal(x, own)], taken)
        if place is None:
            continue
        middle, angle, box = place
        x, y = panel.transData.inverted().transform((middle.real, middle.imag))
        panel.text(
            x,
            y,
            text,
            color=line.get_color(),
            fontsize=_SIZE,
            rotation=angle,
            rotation_mode="anchor",
            ha="center",
            va="center",
            zorder=4.0,
            path_effects=[withStroke(linewidth=1.5, foreground="white")],
        )
        taken.append(box)


def _pixels(panel: Axes, points: Any) -> _Pixels:
    """Points on the screen, x + iy in pixels, without those that are not on a logarithmic scale."""
    xy = np.asarray(points, float)
    return panel.transData.transform(xy[(xy > 0.0).all(axis=1)]) @ (1.0, 1.0j)


def _roomiest(
    panel: Axes, line: _Pixels, letters: int, others: Sequence[_Pixels], taken: Sequence[_Box]
) -> tuple[complex, float, _Box] | None:
    """Middle, angle [deg] and corners of the place beside a line that is farthest from everything else.

    None if there is no place inside the panel that another text has not taken.
    """
    from scipy.spatial import KDTree

    if len(line) < 2 or not others:
        return None
    size = _SIZE * panel.figure.dpi / 72.0
    half = 0.5 * _WIDTH * letters * size
    lower, upper = complex(*panel.bbox.p0) + 4.0 + 4.0j, complex(*panel.bbox.p1) - 4.0 - 4.0j
    # Places along the line, at equal distances on the screen, on either side of it, near and not so near.
    along = np.concatenate([[0.0], np.cumsum(abs(np.diff(line)))])
    at = np.linspace(0.0, along[-1], _PLACES)
    points, starts, ends = (np.interp(s, along, line) for s in (at, at - half, at + half))
    direction = np.tile((ends - starts) / np.maximum(abs(ends - starts), 1e-9), 4)
    away = np.repeat([_AWAY, -_AWAY, 1.7 * _AWAY, -1.7 * _AWAY], _PLACES) * size
    middle = np.tile(points, 4) + away * 1.0j * direction
    # A grid of points of each text's box.
    u, v = np.meshgrid(np.linspace(-half, half, 9), np.linspace(-0.5, 0.5, 3) * _HEIGHT * size)
    grid = middle[:, None] + direction[:, None] * (u + 1.0j * v).ravel()
    low, high = (end(grid.real, axis=1) + 1.0j * end(grid.imag, axis=1) for end in (np.min, np.max))
    fits = _parts(low - lower, upper - high).min(axis=0) > 0.0
    for a, b in taken:
        fits &= _parts(a - high, low - b).max(axis=0) > 2.0
    if not fits.any():
        return None
    obstacles = np.concatenate(others)
    obstacles = obstacles[_parts(obstacles - lower, upper - obstacles).min(axis=0) > -50.0]
    distance, _ = KDTree(_parts(obstacles).T).query(_parts(grid[fits]).T)
    best = np.flatnonzero(fits)[np.argmax(distance.min(axis=0))]
    return middle[best], np.degrees(np.angle(direction[best])), (low[best], high[best])


def _parts(*z: Complex[np.ndarray, ...]) -> Float[np.ndarray, ...]:
    """Real and imaginary parts, one after the other."""
    return np.stack([part for x in z for part in (x.real, x.imag)])

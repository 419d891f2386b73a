"""Guides in an Allan plot: the slopes of the noise terms, and N, B and K on their lines."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Complex

from allanjax.base.wording import without_error
from allanjax.noise.estimate import Estimate

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.lines import Line2D

SLOPES = {-1.0: "−1", -0.5: "−½", 0.0: "0", 0.5: "+½", 1.0: "+1"}
"""Slopes of quantization, angle random walk, bias instability, rate random walk and ramp, as written."""

# Terms whose coefficient is written on its line, and what of the coefficient the line's height is.
_WRITTEN = {"angle_random_walk": "", "bias_instability": "0.664 B, ", "rate_random_walk": ""}
_FAINT, _FAINT_TEXT, _SIZE = "0.78", "0.55", 6.5
# Half the mean width of a character, and distance of a text from its line, over the font's size.
_HALF_WIDTH, _AWAY = 0.3, 0.95
# Places along a line that are tried, and what must be free around a text [pixels].
_PLACES, _FREE = 60, 3.0


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


def write_values(panel: Axes, coefficients: Mapping[str, Estimate], drawn: Mapping[str, Line2D]) -> None:
    """Write N, B and K with their units on the lines `drawn` of their terms, where that hides least."""
    from matplotlib.patheffects import withStroke

    outline = [withStroke(linewidth=1.5, foreground="white")]
    look: dict[str, Any] = {
        "fontsize": _SIZE,
        "rotation_mode": "anchor",
        "path_effects": outline,
        "zorder": 4,
    }
    lines = {line: _pixels(panel, line.get_xydata()) for line in panel.get_lines() if line.get_zorder() > 1.0}
    bars = [bar for of in panel.collections if hasattr(of, "get_segments") for bar in of.get_segments()]
    taken = [_pixels(panel, np.linspace(bar[0], bar[-1], 7)) for bar in bars]
    for label, line in drawn.items():
        c = coefficients.get(label)
        if c is None or c.term not in _WRITTEN or not c.detected:
            continue
        shown = c.in_unit()
        text = f"{_WRITTEN[c.term]}{c.symbol} = {without_error(shown.value, shown.std)} {shown.unit}"
        others = np.concatenate([*taken, *(own for other, own in lines.items() if other is not line)])
        if (found := _place(panel, lines[line], len(text), others)) is None:
            continue
        middle, angle, box = found
        x, y = panel.transData.inverted().transform((middle.real, middle.imag))
        at: dict[str, Any] = {"rotation": angle, "ha": "center", "va": "center"}
        panel.text(x, y, text, color=line.get_color(), **at, **look)
        taken.append(box)


def _pixels(panel: Axes, points: Any) -> Complex[np.ndarray, " _"]:
    """Points on the screen, x + iy in pixels, without those that are not on a logarithmic scale."""
    xy = np.asarray(points, float)
    return panel.transData.transform(xy[(xy > 0.0).all(axis=1)]) @ (1.0, 1.0j)


def _place(
    panel: Axes, line: Complex[np.ndarray, " _"], letters: int, others: Complex[np.ndarray, " _"]
) -> tuple[complex, float, Complex[np.ndarray, " _"]] | None:
    """Middle, angle [deg] and points of a text beside a line, where fewest of the others' points are.

    None if there is no place inside the panel.
    """
    size = _SIZE * panel.figure.dpi / 72.0
    half = _HALF_WIDTH * letters * size
    u, v = np.meshgrid(np.linspace(-half, half, 25), np.linspace(-0.5, 0.5, 3) * size)
    lower, upper = complex(*panel.bbox.p0), complex(*panel.bbox.p1)
    along = np.concatenate([[0.0], np.cumsum(abs(np.diff(line)))])
    best: tuple[float, Any] = (np.inf, None)
    for at in np.linspace(half, along[-1] - half, _PLACES) if along[-1] > 2.0 * half else ():
        start, point, end = (complex(np.interp(at + s, along, line)) for s in (-half, 0.0, half))
        turn = (end - start) / abs(end - start)
        for away in (_AWAY, -_AWAY):
            middle = point + away * size * 1.0j * turn
            box = middle + turn * (u + 1.0j * v).ravel()
            gaps = np.concatenate([box - lower, upper - box])
            near = (others - middle) / turn
            hits = np.sum((abs(near.real) < half + _FREE) & (abs(near.imag) < 0.5 * size + _FREE))
            # Of places that are alike, the one in the middle.
            badness = float(hits) + abs(at / along[-1] - 0.5)
            if min(gaps.real.min(), gaps.imag.min()) > _FREE and badness < best[0]:
                best = badness, (middle, float(np.degrees(np.angle(turn))), box)
    return best[1]

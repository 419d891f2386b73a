"""Figures of Kalman filters: bias with its band over the samples, innovations, probabilities of models."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from allanjax.base.normal import TWO_SIDED_95
from allanjax.kalman.filtering import Adapted, AdaptedAxis, BiasTracks, FilteredAxis
from allanjax.record.units import rate_unit_of
from allanjax.report.figure import (
    COLOURS,
    TIME,
    Heading,
    Sheet,
    band_entry,
    dots,
    dress,
    facts_of,
    ink,
    label_in,
    place_below,
    rows_of,
    save_and_close,
    style,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Inches: the strip is below the panel.
_STRIP, _APART = 0.9, 0.1
_SHEET = Sheet(6.2, 1.8, between=_APART + _STRIP + 0.6, left=1.1, bottom=_APART + _STRIP + 0.55)
# Most points that are drawn of a record, others being left out at even distances; and of its means.
_MOST, _MEANS = 4000, 300
_BLUE = COLOURS[0]


def plot_bias_tracks(
    result: BiasTracks[Any],
    axes: Sequence[str] | str | None = None,
    path: str | os.PathLike[str] | None = None,
) -> Figure:
    """Draw the bias with its 95 % band over the samples, an axis a row, and a strip below.

    The strip is of standardized innovations, which should be white and 95 % of them within the grey band; of
    an adaptive filter of the models' probabilities, by all samples, and dotted by those up to each. Of long
    records means of as many samples are drawn, some hundreds, and every so many innovations.

    Args:
        result: what `kalman_filter` or `adaptive_filter` returns.
        axes: names of the axes to draw; all of them by default.
        path: a file to save the picture to, by its suffix .png, .svg or .pdf.

    Raises:
        AllanjaxError: there is no such axis.
    """
    chosen = [result.results[k] for k in rows_of(result.axes, None, axes)[0]]
    strip: Any
    if isinstance(result, Adapted):
        title, strip, entries = "Adaptive filter", _draw_probabilities, _lines(chosen[0])
    else:
        title, strip, entries = "Kalman filter", _draw_innovations, []
    return _figure(result.name or title, chosen, strip, [*_key(), *entries], path)


def _draw_innovations(panel: Axes, result: FilteredAxis) -> None:
    some = _some(len(result.samples))
    panel.axhspan(-TWO_SIDED_95, TWO_SIDED_95, color=ink(0.9), linewidth=0.0)
    panel.plot(result.time[some], result.standardized[some], **dots())
    panel.set_ylabel("innovation\n[σ]")


def _draw_probabilities(panel: Axes, result: AdaptedAxis) -> None:
    some = _some(len(result.samples))
    for k, line in enumerate(_lines(result)):
        of: dict[str, Any] = {"color": line.get_color(), "label": line.get_label()}
        panel.plot(result.time[some], result.probability[some, k], **of)
        panel.plot(result.time[some], result.weights[some, k], ":", linewidth=0.8, **of)
    panel.set_ylim(-0.05, 1.05)
    panel.set_ylabel("probability")


def _lines(result: AdaptedAxis) -> list[Any]:
    """Entries of the key for the models."""
    from matplotlib.lines import Line2D

    colours = [COLOURS[(k + 1) % len(COLOURS)] for k in range(len(result.labels))]
    return [Line2D([], [], color=c, label=label) for c, label in zip(colours, result.labels, strict=True)]


def _some(n: int) -> Any:
    """Indices of the samples that are drawn."""
    return np.unique(np.linspace(0, n - 1, min(n, _MOST)).round().astype(int))


def _samples() -> dict[str, Any]:
    return dots(2.0, color=ink(0.6), label="means of samples")


def _key() -> list[Any]:
    """Entries of the key for samples, bias and band."""
    from matplotlib.lines import Line2D

    lines = [Line2D([], [], **_samples()), Line2D([], [], color=_BLUE, label="bias")]
    return [*lines, band_entry("95 % interval", _BLUE, 0.3)]


def _draw_bias(panel: Axes, result: FilteredAxis | AdaptedAxis, scale: float) -> None:
    """Draw samples, of long records their means, and the bias with its 95 % band.

    The samples' scale is that of the panel, for at first the band is as wide as they scatter.
    """
    missing = result.missing if isinstance(result, FilteredAxis) else False
    samples = np.where(missing, np.nan, result.samples)
    length = -(-len(samples) // _MEANS)
    parts = np.append(samples, np.full(-len(samples) % length, np.nan)).reshape(-1, length)
    count = np.isfinite(parts).sum(axis=1)
    seen = count > 0
    means = np.nansum(parts, axis=1)[seen] / count[seen]
    middle = (np.flatnonzero(seen) * length + (length - 1) / 2.0) / result.rate
    panel.plot(middle, means / scale, **_samples())
    panel.set_ylim(panel.get_ylim())
    some = _some(len(samples))
    at = some[np.isfinite(result.bias_std[some])]
    value, half = result.bias[at] / scale, TWO_SIDED_95 * result.bias_std[at] / scale
    band: dict[str, Any] = {"alpha": 0.3, "linewidth": 0.0, "label": "95 % interval"}
    panel.fill_between(result.time[at], value - half, value + half, color=_BLUE, **band)
    panel.plot(result.time[at], value, color=_BLUE, linewidth=1.2, label="bias")


def _figure(
    title: str,
    results: Sequence[Any],
    strip: Any,
    key: Sequence[Any],
    path: str | os.PathLike[str] | None,
) -> Figure:
    """Figure of a panel and a strip for each axis, one below the other."""
    with style():
        heading = Heading(title, facts_of(len(results[0].samples), results[0].rate), key)
        figure, panels = _SHEET.draw(heading, [1] * len(results))
        for result, (upper,) in zip(results, panels, strict=True):
            unit, scale = rate_unit_of(result.axis.unit, result.axis.sensor)
            lower = place_below(upper, _APART, _STRIP)
            _draw_bias(upper, result, scale)
            strip(lower, result)
            for panel in (upper, lower):
                panel.set_xlim(0.0, max(float(result.time[-1]), 1.0 / result.rate))
            dress(upper, result.axis.name, y=label_in("bias", unit))
            dress(lower, x=TIME if upper is panels[-1][0] else "")
            upper.tick_params(labelbottom=False)
        return save_and_close(figure, path)

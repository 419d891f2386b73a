"""The picture of a fit: Allan deviations, the model and its terms, and what the model leaves."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from allanjax.allan.deviation import AllanDeviation
from allanjax.base.errors import AllanjaxError
from allanjax.estimate.result import AxisFit, Fit
from allanjax.noise.estimate import title_of
from allanjax.noise.terms.transient import Transient
from allanjax.record.recording import Recording
from allanjax.report.allan_panel import (
    Drawable,
    deviation_label,
    draw_measured,
    fit_and_curve,
    kind_of,
    times_to_draw,
    unit_of,
)
from allanjax.report.figure import (
    Cells,
    KeyEntry,
    Residual,
    Unit,
    draw_key,
    draw_residuals,
    draw_title,
    facts_of,
    figure_with,
    only_one,
    rows_of,
    save_and_close,
    set_scales,
    style,
    term_entry,
    term_style,
    wrapped,
)
from allanjax.report.guides import draw_slopes, write_values
from allanjax.report.overlay_figure import plot_several

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D


# Estimates with a larger relative error do not set the scale of the residuals.
_PRECISE = 0.2


def plot_allan(
    data: Drawable | Sequence[Drawable],
    axes: Sequence[str] | str | None = None,
    path: str | os.PathLike[str] | None = None,
    *,
    labels: Sequence[str] | None = None,
    ax: Axes | None = None,
) -> Figure:
    """Draw Allan deviation against cluster time, one panel an axis, gyros above accelerometers.

    Points are the estimates with their 68 % intervals. For a fit, a line is the model, broken lines are its
    terms, with N, B and K written on them and all coefficients below the panel, and a strip shows measured
    over model minus one; a grey band in it is the model's own error where the model is incomplete. Deviations
    are in deg/h and µg. Faint lines have the slopes −1, −½, 0, +½ and +1. Several curves are drawn over one
    another, those of axes of one name in one panel, with their models but not the terms.

    Args:
        data: what `fit` or `allan_deviation` returns, or a recording; or several of them, e.g. two units, or
            one before and after.
        axes: names of the axes to draw, e.g. `["gyro_x", "gyro_z"]`; all of them by default. For the curve of
            an array: `["0", "1", ...]`.
        path: a file to save the picture to, by its suffix .png, .svg or .pdf.
        labels: what to call the curves of several; by default their recordings' names.
        ax: matplotlib axes to draw a single axis into, without title, strip and key.

    Returns:
        The matplotlib figure.

    Raises:
        AllanjaxError: there is no such axis; not a label for each curve; `ax` for more than one axis.
    """
    import matplotlib.pyplot as plt

    wanted = [axes] if isinstance(axes, str) else axes
    if not isinstance(data, Fit | AllanDeviation | Recording) and isinstance(data, Sequence):
        return plot_several(data, wanted, path, labels, ax)
    if labels is not None:
        raise AllanjaxError("labels= names several curves: give them as a list, or leave it out")
    fit, curve = fit_and_curve(data)
    rows = rows_of(curve.names, curve.axes, wanted)
    with style():
        if ax is not None:
            _draw_into(ax, only_one(rows), fit, curve)
            return figure_with(ax, path)
        keys = {k: [] if fit is None else _key(fit, fit.results[k]) for row in rows for k in row}
        cells = Cells.of(rows, keys, has_strip=fit is not None)
        figure = plt.figure(figsize=cells.size)
        title = fit.name if fit is not None and fit.name else kind_of(curve)
        draw_title(figure, cells, title, facts_of(curve.n, curve.rate), has_model=fit is not None)
        for i, row in enumerate(rows):
            _draw_row(figure, cells, i, row, curve, fit, keys)
        return save_and_close(figure, path)


def _draw_into(panel: Axes, k: int, fit: Fit | None, curve: AllanDeviation) -> None:
    """One axis in a panel of the caller's."""
    unit = unit_of(None if curve.axes is None else curve.axes[k])
    draw_measured(panel, curve, k, unit)
    lines = {} if fit is None or not fit.results[k].converged else _draw_model(panel, fit, k, unit)
    set_scales({k: panel}, {}, curve.cluster_time, curve.deviation[:, [k]] / unit.scale)
    draw_slopes(panel)
    if fit is not None and lines:
        write_values(panel, fit.results[k], lines)
    panel.set_xlabel("cluster time T [s]")
    panel.set_ylabel(deviation_label(curve, unit))


def _draw_row(
    figure: Figure,
    cells: Cells,
    row: int,
    indices: Sequence[int],
    curve: AllanDeviation,
    fit: Fit | None,
    keys: dict[int, list[KeyEntry]],
) -> None:
    panels: dict[int, Axes] = {}
    strips: dict[int, Axes] = {}
    lines: dict[int, dict[str, Line2D]] = {}
    unit = unit_of(None if curve.axes is None else curve.axes[indices[0]])
    for column, k in enumerate(indices):
        panels[k] = lowest = cells.panel(figure, row, column)
        panels[k].set_title(curve.names[k], loc="left", fontweight="bold")
        draw_measured(panels[k], curve, k, unit)
        if fit is not None:
            strips[k] = lowest = cells.strip(figure, row, column)
            if fit.results[k].converged:
                lines[k] = _draw_model(panels[k], fit, k, unit)
            draw_key(cells.key(figure, row, column), cells, keys[k])
        lowest.set_xlabel("cluster time T [s]")
    if fit is not None:
        draw_residuals(strips, curve.cluster_time, _residuals(strips, fit))
    set_scales(panels, strips, curve.cluster_time, curve.deviation[:, list(panels)] / unit.scale)
    for k, panel in panels.items():
        draw_slopes(panel)
        if fit is not None and k in lines:
            write_values(panel, fit.results[k], lines[k])
    panels[indices[0]].set_ylabel(deviation_label(curve, unit))
    if strips:
        strips[indices[0]].set_ylabel("measured /\nmodel − 1 [%]")


def _draw_model(panel: Axes, fit: Fit, k: int, unit: Unit) -> dict[str, Line2D]:
    """The model and its terms; the lines of these, by their labels."""
    result, time = fit.results[k], times_to_draw(fit.curve)
    model = result.model.sampled(fit.curve.rate)
    total = np.zeros(len(time))
    lines = {}
    for label, term in zip(result.term_labels, model.terms, strict=True):
        if isinstance(term, Transient):
            continue
        variance = np.asarray(term.allan_variance(time))
        total += variance
        style = term_style(fit, label)
        y = np.sqrt(variance) / unit.scale
        (lines[label],) = panel.plot(time, y, label=title_of(label, result.axis), **style)
    panel.plot(time, np.sqrt(total) / unit.scale, color="black", linewidth=1.4, label="model", zorder=2.5)
    return lines


def _residuals(strips: Mapping[int, Axes], fit: Fit) -> dict[int, Residual]:
    curve = fit.curve
    lower, upper = curve.confidence_interval(0.68)
    found = {}
    for k in strips:
        result = fit.results[k]
        if not result.converged:
            continue
        model = fit.model_deviation(result.axis.name, curve.cluster_time)
        measured = curve.deviation[:, k]
        spread = np.stack([measured - lower[:, k], upper[:, k] - measured])
        found[k] = Residual(
            100.0 * (measured / model - 1.0),
            100.0 * np.maximum(spread, 0.0) / model,
            curve.edf[:, k] > 0.5 / _PRECISE**2,
            result.misfit.rms if result.measured and result.misfit else 0.0,
        )
    return found


def _key(fit: Fit, result: AxisFit) -> list[KeyEntry]:
    """Every term with its coefficients, and how well the model fits."""
    entries = []
    if result.converged:
        for label, term in zip(fit.template.term_labels, fit.template.terms, strict=True):
            hidden = isinstance(term, Transient) and label in result.term_labels
            remark = " (no Allan variance: not drawn)" if hidden else ""
            entries.append(term_entry(fit, result, label, remark))
    return [*entries, KeyEntry(wrapped(result.verdict()))]

"""Figure of a fit: Allan deviations, the model and its terms, and the residuals."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from allanjax.allan.deviation import AllanDeviation
from allanjax.base.errors import AllanjaxError
from allanjax.estimate.result import AxisFit, Fit
from allanjax.noise.estimate import title_of
from allanjax.noise.terms import NoiseTerm
from allanjax.noise.terms.transient import Transient
from allanjax.record.recording import Recording
from allanjax.report.allan_panel import (
    CLUSTER_TIME,
    Drawable,
    allan_points,
    fit_and_curve,
    kind_of,
    label_in,
    times_to_draw,
    unit_of,
)
from allanjax.report.figure import (
    MODEL,
    KeyEntry,
    Points,
    drawn_terms,
    facts_of,
    term_entries,
    term_style,
    wrapped,
)
from allanjax.report.frame import PRECISE, Frame, Panel, Residual, rows_of
from allanjax.report.guides import draw_slopes, write_values
from allanjax.report.overlay_figure import plot_several

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D


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
    if not isinstance(data, Fit | AllanDeviation | Recording) and isinstance(data, Sequence):
        return plot_several(data, axes, path, labels, ax)
    if labels is not None:
        raise AllanjaxError("labels= names several curves: give them as a list, or leave it out")
    fit, curve = fit_and_curve(data)
    title = fit.name if fit is not None and fit.name else kind_of(curve)
    has_fit = fit is not None
    frame = Frame(title, facts_of(curve.n, curve.rate), CLUSTER_TIME, has_fit, has_fit)
    rows = rows_of(curve.names, curve.axes, axes)
    return frame.draw([[_panel(curve, fit, k) for k in row] for row in rows], path, ax)


def _panel(curve: AllanDeviation, fit: Fit | None, k: int) -> Panel:
    """Allan deviations of an axis and, of a fit, the model, its terms and residuals."""
    unit, scale = unit_of(None if curve.axes is None else curve.axes[k])
    name, label = curve.names[k], label_in(kind_of(curve), unit)
    points = [allan_points(curve, k, scale)]
    if fit is None:
        return Panel(name, label, points, draw_slopes, ())
    result = fit.results[k]
    verdict = KeyEntry(wrapped(result.verdict()))
    if not result.converged:
        return Panel(name, label, points, draw_slopes, [verdict])
    entries = term_entries(fit, result, _is_transient, " (no Allan variance: not drawn)")

    def draw(panel: Axes) -> None:
        lines = _draw_model(panel, fit, result, scale)
        draw_slopes(panel)
        write_values(panel, result, lines)

    return Panel(name, label, points, draw, [*entries, verdict], _residual(fit, k))


def _draw_model(panel: Axes, fit: Fit, result: AxisFit, scale: float) -> dict[str, Line2D]:
    """Draw the model and its terms; returns the lines of the terms, by their labels."""
    time = times_to_draw(fit.curve)
    total = np.zeros(len(time))
    lines = {}
    for label, term in zip(result.term_labels, result.model.sampled(fit.curve.rate).terms, strict=True):
        if _is_transient(term):
            continue
        variance = np.asarray(term.allan_variance(time))
        total += variance
        if label in drawn_terms(result):
            y, name = np.sqrt(variance) / scale, title_of(label, result.axis)
            (lines[label],) = panel.plot(time, y, label=name, **term_style(fit, label))
    panel.plot(time, np.sqrt(total) / scale, **MODEL)
    return lines


def _residual(fit: Fit, k: int) -> Residual:
    """Measured deviations over the model's."""
    curve, result = fit.curve, fit.results[k]
    model = fit.model_deviation(result.axis.name, curve.cluster_time)
    measured = allan_points(curve, k)
    points = Points(measured.x, 100.0 * (measured.y / model - 1.0), 100.0 * measured.spread / model)
    off = result.misfit.rms if result.measured and result.misfit else 0.0
    return Residual(points, curve.edf[:, k] > 0.5 / PRECISE**2, off)


def _is_transient(term: NoiseTerm) -> bool:
    return isinstance(term, Transient)

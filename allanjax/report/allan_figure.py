"""Figure of a fit: Allan deviations, the model and its terms, and the residuals."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from jaxtyping import Float

from allanjax.allan.deviation import AllanDeviation
from allanjax.base.errors import AllanjaxError
from allanjax.estimate.result import AxisFit, Fit
from allanjax.noise.estimate import title_of
from allanjax.noise.terms.transient import Transient
from allanjax.record.recording import Recording
from allanjax.report.allan_panel import (
    CLUSTER_TIME,
    Drawable,
    deviation_label,
    draw_measured,
    fit_and_curve,
    kind_of,
    times_to_draw,
    unit_of,
)
from allanjax.report.figure import (
    MODEL,
    KeyEntry,
    Unit,
    drawn_terms,
    facts_of,
    term_entry,
    term_style,
    wrapped,
)
from allanjax.report.frame import PRECISE, Heading, Panels, Residual, rows_of
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
    wanted = [axes] if isinstance(axes, str) else axes
    if not isinstance(data, Fit | AllanDeviation | Recording) and isinstance(data, Sequence):
        return plot_several(data, wanted, path, labels, ax)
    if labels is not None:
        raise AllanjaxError("labels= names several curves: give them as a list, or leave it out")
    fit, curve = fit_and_curve(data)
    title = fit.name if fit is not None and fit.name else kind_of(curve)
    has_fit = fit is not None
    heading = Heading(curve.names, title, facts_of(curve.n, curve.rate), has_fit, has_fit)
    return _AllanPanels(fit, curve).figure(rows_of(curve.names, curve.axes, wanted), heading, path, ax)


@dataclass(frozen=True)
class _AllanPanels(Panels):
    """Allan deviations and, of a fit, the model, its terms and residuals."""

    X_LABEL: ClassVar[str] = CLUSTER_TIME

    fit: Fit | None
    curve: AllanDeviation

    def y_label(self, k: int) -> str:
        return deviation_label(self.curve, self._unit(k))

    def key(self, k: int) -> list[KeyEntry]:
        return [] if self.fit is None else _key(self.fit, self.fit.results[k])

    def draw(self, panel: Axes, k: int) -> dict[str, Line2D]:
        draw_measured(panel, self.curve, k, self._unit(k))
        if self.fit is None or not self.fit.results[k].converged:
            return {}
        return _draw_model(panel, self.fit, k, self._unit(k))

    def extent(self, row: Sequence[int]) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, "m columns"]]:
        return self.curve.cluster_time, self.curve.deviation[:, list(row)] / self._unit(row[0]).scale

    def residual(self, k: int) -> Residual | None:
        assert self.fit is not None
        return _residual(self.fit, k)

    def finish(self, panel: Axes, k: int, drawn: dict[str, Line2D]) -> None:
        draw_slopes(panel)
        if self.fit is not None and drawn:
            write_values(panel, self.fit.results[k], drawn)

    def _unit(self, k: int) -> Unit:
        return unit_of(None if self.curve.axes is None else self.curve.axes[k])


def _draw_model(panel: Axes, fit: Fit, k: int, unit: Unit) -> dict[str, Line2D]:
    """Draw the model and its terms; returns the lines of the terms, by their labels."""
    result, time = fit.results[k], times_to_draw(fit.curve)
    model = result.model.sampled(fit.curve.rate)
    total = np.zeros(len(time))
    lines = {}
    for label, term in zip(result.term_labels, model.terms, strict=True):
        if isinstance(term, Transient):
            continue
        variance = np.asarray(term.allan_variance(time))
        total += variance
        if label in drawn_terms(result):
            y, name = np.sqrt(variance) / unit.scale, title_of(label, result.axis)
            (lines[label],) = panel.plot(time, y, label=name, **term_style(fit, label))
    panel.plot(time, np.sqrt(total) / unit.scale, **MODEL)
    return lines


def _residual(fit: Fit, k: int) -> Residual | None:
    """Measured deviations over the model's, None for an axis without result."""
    curve, result = fit.curve, fit.results[k]
    if not result.converged:
        return None
    lower, upper = curve.confidence_interval(0.68)
    model = fit.model_deviation(result.axis.name, curve.cluster_time)
    measured = curve.deviation[:, k]
    spread = np.stack([measured - lower[:, k], upper[:, k] - measured])
    return Residual(
        curve.cluster_time,
        100.0 * (measured / model - 1.0),
        100.0 * np.maximum(spread, 0.0) / model,
        curve.edf[:, k] > 0.5 / PRECISE**2,
        result.misfit.rms if result.measured and result.misfit else 0.0,
    )


def _key(fit: Fit, result: AxisFit) -> list[KeyEntry]:
    """Entries of every term with its coefficients, and the verdict on the fit."""
    entries = []
    if result.converged:
        for label, term in zip(fit.template.term_labels, fit.template.terms, strict=True):
            hidden = isinstance(term, Transient) and label in result.term_labels
            remark = " (no Allan variance: not drawn)" if hidden else ""
            entries.append(term_entry(fit, result, label, remark))
    return [*entries, KeyEntry(wrapped(result.verdict()))]

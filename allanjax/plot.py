"""The picture of a fit: Allan deviations, the model and its terms, and what the model leaves."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from allanjax.allan import AllanDeviation
from allanjax.figure import (
    Cells,
    KeyEntry,
    Residual,
    Unit,
    draw_key,
    draw_residuals,
    draw_title,
    facts_of,
    finished,
    look,
    marks,
    rows_of,
    set_scales,
    term_entry,
    term_style,
    wrapped,
)
from allanjax.recording import Axis
from allanjax.result import AxisFit, Fit, title_of
from allanjax.terms.transient import Transient
from allanjax.units import default_coefficient_unit, unit_scale

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Estimates with a larger relative error do not set the scale of the residuals.
_PRECISE = 0.2


def plot_allan(
    fit_or_curve: Fit | AllanDeviation,
    axes: Sequence[str] | None = None,
    path: str | os.PathLike[str] | None = None,
) -> Figure:
    """Draw Allan deviation against cluster time, one panel an axis, gyros above accelerometers.

    Points are the estimates with their 68 % intervals. For a fit, a line is the model, broken lines are its
    terms, with their coefficients below the panel, and a strip shows measured over model minus one; a grey
    band in it is the model's own error where the model is incomplete. Deviations are in deg/h and µg.

    Args:
        fit_or_curve: what `fit` or `allan_deviation` returns.
        axes: names of the axes to draw, e.g. `["gyro_x", "gyro_z"]`; all of them by default. For the curve of
            an array: `["0", "1", ...]`.
        path: a file to save the picture to, by its suffix .png, .svg or .pdf.

    Returns:
        The matplotlib figure.

    Raises:
        AllanjaxError: there is no such axis.
    """
    import matplotlib.pyplot as plt

    fit = fit_or_curve if isinstance(fit_or_curve, Fit) else None
    curve = fit_or_curve.curve if isinstance(fit_or_curve, Fit) else fit_or_curve
    names = [str(k) for k in range(curve.deviation.shape[1])]
    if curve.axes is not None:
        names = [axis.name for axis in curve.axes]
    rows = rows_of(names, curve.axes, axes)
    with look():
        keys = {k: [] if fit is None else _key(fit, fit.results[k]) for row in rows for k in row}
        cells = Cells.of(rows, keys, has_strip=fit is not None)
        figure = plt.figure(figsize=cells.size)
        title = fit.name if fit is not None and fit.name else _kind(curve)
        draw_title(figure, cells, title, facts_of(curve.n, curve.rate), has_model=fit is not None)
        for i, row in enumerate(rows):
            _draw_row(figure, cells, i, row, names, curve, fit, keys)
        return finished(figure, path)


def _draw_row(
    figure: Figure,
    cells: Cells,
    row: int,
    indices: Sequence[int],
    names: Sequence[str],
    curve: AllanDeviation,
    fit: Fit | None,
    keys: dict[int, list[KeyEntry]],
) -> None:
    panels: dict[int, Axes] = {}
    strips: dict[int, Axes] = {}
    unit = _unit(None if curve.axes is None else curve.axes[indices[0]])
    for column, k in enumerate(indices):
        panels[k] = lowest = cells.panel(figure, row, column)
        panels[k].set_title(names[k], loc="left", fontweight="bold")
        _draw_measured(panels[k], curve, k, unit)
        if fit is not None:
            strips[k] = lowest = cells.strip(figure, row, column)
            if fit.results[k].converged:
                _draw_model(panels[k], fit, fit.results[k], unit)
            draw_key(cells.key(figure, row, column), cells, keys[k])
        lowest.set_xlabel("cluster time T [s]")
    if fit is not None:
        draw_residuals(strips, curve.cluster_time, _residuals(strips, fit))
    set_scales(panels, strips, curve.cluster_time, curve.deviation[:, list(panels)] / unit.scale)
    panels[indices[0]].set_ylabel(f"{_kind(curve)}\n[{unit.name}]" if unit.name else _kind(curve))
    if strips:
        strips[indices[0]].set_ylabel("measured /\nmodel − 1 [%]")


def _draw_measured(panel: Axes, curve: AllanDeviation, k: int, unit: Unit) -> None:
    deviation = curve.deviation[:, k]
    lower, upper = curve.confidence_interval(0.68)
    spread = np.stack([deviation - lower[:, k], upper[:, k] - deviation])
    panel.errorbar(
        curve.cluster_time,
        deviation / unit.scale,
        np.maximum(spread, 0.0) / unit.scale,
        label="measured",
        zorder=3,
        **marks(2.6),
    )


def _draw_model(panel: Axes, fit: Fit, result: AxisFit, unit: Unit) -> None:
    rate = fit.curve.rate
    # At whole numbers of samples only: between them a line above the Nyquist frequency is something else.
    sizes = np.unique(np.rint(np.geomspace(1.0, fit.curve.cluster_size[-1], 400)))
    time = sizes / rate
    model = result.model.sampled(rate)
    total = np.zeros(len(time))
    for label, term in zip(model.term_labels, model.terms, strict=True):
        if isinstance(term, Transient):
            continue
        variance = np.asarray(term.allan_variance(time))
        total += variance
        panel.plot(
            time, np.sqrt(variance) / unit.scale, label=title_of(label, result.axis), **term_style(fit, label)
        )
    panel.plot(time, np.sqrt(total) / unit.scale, color="black", linewidth=1.4, label="model", zorder=2.5)


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
            hidden = isinstance(term, Transient) and label in result.model.term_labels
            remark = " (no Allan variance: not drawn)" if hidden else ""
            entries.append(term_entry(fit, result, label, remark))
    return [*entries, KeyEntry(wrapped(result.verdict()))]


def _unit(axis: Axis | None) -> Unit:
    if axis is None:
        return Unit("", 1.0)
    name = default_coefficient_unit(axis.sensor, 0.0)
    return Unit(name, unit_scale(name, axis.sensor))


def _kind(curve: AllanDeviation) -> str:
    return {"allan": "Allan", "modified": "modified Allan", "hadamard": "Hadamard"}[curve.kind] + " deviation"

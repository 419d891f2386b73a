"""Figures of a posterior: its marginals, and the bands of its curves."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from allanjax.allan.deviation import AllanDeviation
from allanjax.base.errors import AllanjaxError
from allanjax.base.wording import format_with_error, significant
from allanjax.estimate.result import Fit
from allanjax.noise.estimate import Estimate
from allanjax.posterior.result import AxisPosterior, Posterior
from allanjax.record.units import unit_scale
from allanjax.report.allan_panel import CLUSTER_TIME, unit_of
from allanjax.report.figure import COLOURS, FONT_SIZE, POINTS, add_grid, literal, marks, save_and_close, style
from allanjax.spectrum.psd import density_unit

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_COLOUR = COLOURS[0]

# Inches: places are fixed, so that nothing can overlap.
_LEFT, _RIGHT, _TOP, _BOTTOM = 0.95, 0.2, 0.95, 0.55
_PANEL_WIDTH, _PANEL_HEIGHT, _GAP, _ROW_GAP = 4.1, 2.6, 1.0, 0.75
_CORNER_LEFT, _CORNER_TOP, _CORNER_BOTTOM = 1.15, 0.85, 0.75
_CORNER_PANEL, _CORNER_GAP = 1.7, 0.12

# Draws that a band is made of, and points of a curve of either kind.
_DRAWS = 300
_CURVE_POINTS, _DENSITY_POINTS = 200, 160
# Contours of a joint posterior hold these shares of it.
_SHARES = (0.68, 0.95)
# Bins of a marginal.
_BINS = 40


def plot_corner(posterior: AxisPosterior, path: str | os.PathLike[str] | None = None) -> Figure:
    """Draw every sampled parameter's posterior, and that of every pair of them.

    On the diagonal: the marginal density (filled), its median and 68 % interval (lines; broken is the prior
    density, drawn where it is high enough to be seen). Below it: contours that hold 68 and 95 % of the draws.
    Every axis is in the coefficient's usual unit.

    Args:
        posterior: of one axis, e.g. `posterior["gyro_x"]`.
        path: a file to save the picture to, by its suffix .png, .svg or .pdf.

    Returns:
        The matplotlib figure; its axes are in rows from the top, those of a row from the left.
    """
    import matplotlib.pyplot as plt

    marginals = [posterior.coefficients[label] for label in posterior.labels]
    scales = np.array([unit_scale(m.usual_unit, m.axis.sensor) for m in marginals])
    draws = posterior.draws / scales
    count = len(marginals)
    side = count * _CORNER_PANEL + (count - 1) * _CORNER_GAP
    # One parameter leaves no room for the title.
    width = max(_CORNER_LEFT + side + _RIGHT, 4.0)
    height = _CORNER_TOP + side + _CORNER_BOTTOM
    ranges = [_range(x) for x in draws.T]
    with style():
        figure = plt.figure(figsize=(width, height))
        figure.text(
            0.12 / width,
            1.0 - 0.12 / height,
            f"{posterior.axis.name}: posterior",
            fontsize=13,
            fontweight="bold",
            va="top",
        )
        key = "line: median and 68 %; broken: prior; contours: 68 and 95 %"
        remark = key if posterior.converged else f"NOT CONVERGED. {key}"
        figure.text(0.12 / width, 1.0 - 0.4 / height, remark, color="0.35", va="top")
        for row in range(count):
            for column in range(row + 1):
                left = _CORNER_LEFT + column * (_CORNER_PANEL + _CORNER_GAP)
                bottom = _CORNER_BOTTOM + (count - 1 - row) * (_CORNER_PANEL + _CORNER_GAP)
                place = (left / width, bottom / height, _CORNER_PANEL / width, _CORNER_PANEL / height)
                panel = figure.add_axes(place)
                if row == column:
                    prior = _prior_density(posterior, row, ranges[row], scales[row])
                    _draw_margin(panel, draws[:, row], ranges[row], prior)
                    panel.set_title(_heading(marginals[row]), fontsize=FONT_SIZE)
                else:
                    _draw_pair(panel, draws[:, column], draws[:, row], ranges[column], ranges[row])
                _label(panel, marginals, row, column)
        return save_and_close(figure, path)


def _label(panel: Axes, marginals: Sequence[Estimate], row: int, column: int) -> None:
    """Write names with units, at the outer edges only."""
    from matplotlib.ticker import MaxNLocator, ScalarFormatter

    last = row == len(marginals) - 1
    left = column == 0 and row > 0
    panel.tick_params(which="both", direction="in", labelbottom=last, labelleft=left)
    panel.xaxis.set_major_locator(MaxNLocator(3, prune="both"))
    if row != column:
        panel.yaxis.set_major_locator(MaxNLocator(3, prune="both"))
    for axis in (panel.xaxis, panel.yaxis):
        formatter = ScalarFormatter(useOffset=False)
        formatter.set_powerlimits((-3, 5))
        axis.set_major_formatter(formatter)
    if last:
        panel.set_xlabel(_name(marginals[column]))
    if left:
        panel.set_ylabel(_name(marginals[row]))
        panel.yaxis.set_label_coords(-0.36, 0.5)


def _name(m: Estimate) -> str:
    """E.g. "bias instability\nB [deg/h]"."""
    unit = "" if m.usual_unit == "1" else f" [{m.usual_unit}]"
    return f"{_wrapped(m.title)}\n{m.symbol}{unit}"


def _wrapped(text: str) -> str:
    import textwrap

    return "\n".join(textwrap.wrap(text, 22))


def _heading(m: Estimate) -> str:
    shown = m.in_unit()
    if m.detected:
        return format_with_error(shown.value, shown.std)
    return "not detected" if shown.upper_limit is None else f"below {significant(shown.upper_limit)} (95 %)"


def _range(x: Float[np.ndarray, " draws"]) -> tuple[float, float]:
    """Range in which nearly all draws lie."""
    low, high = np.quantile(x, [0.001, 0.999])
    margin = 0.08 * (high - low)
    if not margin > 0.0:
        margin = 0.1 * abs(low) or 1.0
    # An amplitude's panel does not begin below zero.
    return max(low - margin, 0.0) if x.min() >= 0.0 else low - margin, high + margin


def _draw_margin(
    panel: Axes,
    x: Float[np.ndarray, " draws"],
    limits: tuple[float, float],
    prior: tuple[Float[np.ndarray, " points"], Float[np.ndarray, " points"]],
) -> None:
    density, edges = np.histogram(x, bins=_BINS, range=limits)
    density = density / (len(x) * np.diff(edges))
    panel.stairs(density, edges, fill=True, color=_COLOUR, alpha=0.25)
    panel.stairs(density, edges, color=_COLOUR, linewidth=1.0)
    panel.plot(*prior, color="0.45", linewidth=1.0, linestyle="--", label="prior")
    low, median, high = np.quantile(x, [0.16, 0.5, 0.84])
    panel.axvline(median, color="black", linewidth=1.2)
    for end in (low, high):
        panel.axvline(end, color="black", linewidth=0.7)
    panel.set_xlim(limits)
    panel.set_ylim(0.0, 1.08 * density.max())
    panel.set_yticks([])


def _prior_density(
    posterior: AxisPosterior, index: int, limits: tuple[float, float], scale: float
) -> tuple[Float[np.ndarray, " points"], Float[np.ndarray, " points"]]:
    """Points of the prior density, per unit that is shown."""
    x = np.linspace(*limits, 200)
    prior = posterior.priors[posterior.labels[index]]
    return x, np.exp(np.asarray(prior.log_density(x * scale))) * scale


def _draw_pair(
    panel: Axes,
    x: Float[np.ndarray, " draws"],
    y: Float[np.ndarray, " draws"],
    x_limits: tuple[float, float],
    y_limits: tuple[float, float],
) -> None:
    from scipy.ndimage import gaussian_filter

    counts, x_edges, y_edges = np.histogram2d(x, y, bins=_BINS, range=(x_limits, y_limits))
    # Mirrored, lest the density fade towards the bound of an amplitude.
    smooth = gaussian_filter(counts, 1.3, mode="reflect")
    descending = np.sort(smooth.ravel())[::-1]
    held = np.cumsum(descending) / descending.sum()
    # Levels above which the cells hold these shares, ascending.
    levels = sorted({float(descending[np.searchsorted(held, share)]) for share in _SHARES})
    centres = (x_edges[1:] + x_edges[:-1]) / 2.0, (y_edges[1:] + y_edges[:-1]) / 2.0
    panel.contourf(*centres, smooth.T, [*levels, 1.01 * smooth.max()], colors=_COLOUR, alpha=0.25)
    panel.contourf(*centres, smooth.T, [levels[-1], 1.01 * smooth.max()], colors=_COLOUR, alpha=0.3)
    panel.contour(*centres, smooth.T, levels, colors=_COLOUR, linewidths=0.8)
    panel.set_xlim(x_limits)
    panel.set_ylim(y_limits)


def plot_posterior(
    posterior: Posterior,
    curve: AllanDeviation | Fit | None = None,
    axes: Sequence[str] | None = None,
    path: str | os.PathLike[str] | None = None,
    spectrum: Any = None,
) -> Figure:
    """Draw the models' Allan deviation and, beside it, their PSD, with 68 and 95 % of the posterior as bands.

    One row an axis. Points are the Allan deviations measured, with 68 % intervals, and the measured PSD if
    it is given. The bands are those of the model curve under the posterior, at each time or frequency by
    itself; terms that were not sampled are left out. PSDs are one-sided, with the aliases of the samples.

    Args:
        posterior: what `sample` returns.
        curve: the Allan deviations to draw, or a fit that has them; by default those of the fit sampled.
        axes: names of the axes to draw; by default all that were sampled.
        path: a file to save the picture to, by its suffix .png, .svg or .pdf.
        spectrum: what `power_spectrum` returns, with `frequency` [Hz] and one-sided `density` of each axis.

    Returns:
        The matplotlib figure.

    Raises:
        AllanjaxError: there is no such axis.
    """
    import matplotlib.pyplot as plt

    names = tuple(posterior.axes if axes is None else axes)
    if not names:
        raise AllanjaxError(f"name at least one axis to plot of {', '.join(posterior.axes)}")
    chosen = [posterior[name] for name in names]
    measured = posterior.fit.curve if curve is None else curve.curve if isinstance(curve, Fit) else curve
    width = _LEFT + 2.0 * _PANEL_WIDTH + _GAP + _RIGHT
    height = _TOP + len(chosen) * _PANEL_HEIGHT + (len(chosen) - 1) * _ROW_GAP + _BOTTOM
    with style():
        figure = plt.figure(figsize=(width, height))
        _draw_title(figure, posterior, measured, width, height)
        for row, result in enumerate(chosen):
            bottom = height - _TOP - row * (_PANEL_HEIGHT + _ROW_GAP) - _PANEL_HEIGHT
            left, right = (
                figure.add_axes((x / width, bottom / height, _PANEL_WIDTH / width, _PANEL_HEIGHT / height))
                for x in (_LEFT, _LEFT + _PANEL_WIDTH + _GAP)
            )
            _draw_deviation(left, result, measured, _axis_index(measured, result))
            _draw_density(right, result, spectrum, measured.n)
            state = "" if result.converged else ", NOT CONVERGED"
            left.set_title(f"{result.axis.name}{state}", loc="left", fontweight="bold")
            for panel in (left, right):
                _finish(panel)
        return save_and_close(figure, path)


def _axis_index(curve: AllanDeviation, result: AxisPosterior) -> int:
    names = [] if curve.axes is None else [axis.name for axis in curve.axes]
    if result.axis.name not in names:
        raise AllanjaxError(f"the curve to draw has no axis {result.axis.name!r}; it has {', '.join(names)}")
    return names.index(result.axis.name)


def _draw_title(
    figure: Figure, posterior: Posterior, curve: AllanDeviation, width: float, height: float
) -> None:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    at: dict[str, Any] = {"x": _LEFT / width, "va": "top"}
    name = posterior.fit.name or "posterior"
    figure.text(
        y=1.0 - 0.12 / height,
        s=literal(name if len(name) < 70 else f"{name[:69]}…"),
        fontsize=13,
        fontweight="bold",
        **at,
    )
    facts = f"{curve.n:,} samples at {curve.rate:g} Hz; model under the posterior"
    figure.text(y=1.0 - 0.4 / height, s=facts, color="0.35", fontsize=9.5, **at)
    handles = [
        Line2D(
            [], [], color=POINTS, marker="o", markersize=3, linewidth=0.8, label="measured, 68 % interval"
        ),
        Line2D([], [], color=_COLOUR, linewidth=1.2, label="model, median"),
        Patch(color=_COLOUR, alpha=0.45, linewidth=0.0, label="68 %"),
        Patch(color=_COLOUR, alpha=0.2, linewidth=0.0, label="95 %"),
    ]
    figure.legend(
        handles=handles,
        loc="upper right",
        bbox_to_anchor=(1.0 - _RIGHT / width, 1.0 - 0.38 / height),
        ncols=4,
        frameon=False,
        borderpad=0.0,
        borderaxespad=0.0,
    )


def _draw_band(
    panel: Axes, x: Float[np.ndarray, " points"], curves: Float[np.ndarray, "draws points"]
) -> None:
    low_95, low_68, median, high_68, high_95 = np.quantile(curves, [0.025, 0.16, 0.5, 0.84, 0.975], axis=0)
    panel.fill_between(x, low_95, high_95, color=_COLOUR, alpha=0.2, linewidth=0.0, label="95 %")
    panel.fill_between(x, low_68, high_68, color=_COLOUR, alpha=0.3, linewidth=0.0, label="68 %")
    panel.plot(x, median, color=_COLOUR, linewidth=1.2, label="median", zorder=2.5)


def _draw_deviation(panel: Axes, result: AxisPosterior, curve: AllanDeviation, k: int) -> None:
    unit = unit_of(result.axis)
    sizes = np.unique(np.rint(np.geomspace(1.0, curve.cluster_size[-1], _CURVE_POINTS)))
    time = sizes / curve.rate
    _draw_band(panel, time, result.deviation_curves(time, _DRAWS) / unit.scale)
    lower, upper = curve.confidence_interval(0.68)
    deviation = curve.deviation[:, k]
    spread = np.maximum(np.stack([deviation - lower[:, k], upper[:, k] - deviation]), 0.0)
    panel.errorbar(
        curve.cluster_time,
        deviation / unit.scale,
        spread / unit.scale,
        label="measured",
        zorder=3,
        **marks(2.6),
    )
    positive = deviation[deviation > 0.0] / unit.scale
    panel.set_xlim(time[0] / 1.4, time[-1] * 1.4)
    panel.set_ylim(positive.min(initial=np.inf) / 2.5, positive.max(initial=0.0) * 2.0)
    panel.set_xlabel(CLUSTER_TIME)
    panel.set_ylabel(f"Allan deviation [{unit.name}]")


def _draw_density(panel: Axes, result: AxisPosterior, spectrum: Any, n: int) -> None:
    name, scale = density_unit(result.axis)
    f = np.geomspace(result.rate / n, result.rate / 2.0, _DENSITY_POINTS)
    curves = result.density_curves(f, _DRAWS) / scale
    if spectrum is not None:
        k = _spectrum_index(spectrum, result)
        density = np.asarray(spectrum.density)
        density = (density if density.ndim == 1 else density[:, k]) / scale
        frequency = np.asarray(spectrum.frequency)
        shown = (frequency > 0.0) & (density > 0.0)
        panel.plot(
            frequency[shown],
            density[shown],
            "o",
            color=POINTS,
            markersize=2.0,
            markeredgewidth=0.0,
            alpha=0.6,
            label="measured",
        )
    _draw_band(panel, f, curves)
    # Single ordinates scatter over decades below the density; a few of them leave the panel.
    panel.set_xlim(f[0] / 1.4, f[-1] * 1.4)
    panel.set_ylim(curves.min() / 30.0, curves.max() * 5.0)
    panel.set_xlabel("frequency [Hz]")
    panel.set_ylabel(f"one-sided PSD [{name}]")


def _spectrum_index(spectrum: Any, result: AxisPosterior) -> int:
    axes = getattr(spectrum, "axes", None)
    names = [] if axes is None else [axis.name for axis in axes]
    if result.axis.name not in names:
        raise AllanjaxError(f"the spectrum has no axis {result.axis.name!r}; it has {', '.join(names)}")
    return names.index(result.axis.name)


def _finish(panel: Axes) -> None:
    from matplotlib.ticker import LogLocator, NullFormatter

    panel.set_xscale("log")
    panel.set_yscale("log")
    add_grid(panel)
    for axis in (panel.xaxis, panel.yaxis):
        axis.set_minor_locator(LogLocator(subs=(2.0, 5.0)))
        axis.set_minor_formatter(NullFormatter())

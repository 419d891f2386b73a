"""Figures of a posterior: its marginals, and the bands of its curves."""

from __future__ import annotations

import os
import textwrap
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, ScalarFormatter
from scipy.ndimage import gaussian_filter

from allanjax.allan.deviation import AllanDeviation
from allanjax.base.wording import format_with_error, significant
from allanjax.estimate.result import Fit
from allanjax.noise.estimate import Estimate
from allanjax.posterior.priors import Prior
from allanjax.posterior.result import AxisPosterior, Posterior
from allanjax.presentation import draw
from allanjax.presentation.draw import Heading, Sheet
from allanjax.record.units import unit_scale
from allanjax.spectrum.psd import density_unit

_COLOUR = draw.COLOURS[0]
# Draws of a parameter, and the ends of its scale.
_Draws = Float[np.ndarray, " draws"]
_Ends = tuple[float, float]

_SHEET = Sheet(3.5, 2.3, gap=0.95)
_CORNER = Sheet(1.7, 1.7, gap=0.3, between=0.12, left=1.15, bottom=0.75)

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
    marginals = [posterior.coefficients[label] for label in posterior.labels]
    scales = np.array([unit_scale(m.usual_unit, m.axis.sensor) for m in marginals])
    draws = posterior.draws / scales
    ranges = [_range(x) for x in draws.T]
    count = len(marginals)
    with draw.style():
        lines = "lines: median and 68 % interval, prior (broken); contours: 68 and 95 %"
        remark = lines if posterior.converged else f"not converged; {lines}"
        heading = Heading(f"{posterior.axis.name}: posterior", remark)
        figure, panels = _CORNER.draw(heading, range(1, count + 1), path)
        for row, column in [(i, j) for i in range(count) for j in range(i + 1)]:
            panel = panels[row][column]
            if row == column:
                prior = posterior.priors[posterior.labels[row]]
                _draw_margin(panel, draws[:, row], ranges[row], prior, scales[row])
                panel.set_title(_heading(marginals[row]), fontsize=draw.FONT_SIZE)
            else:
                _draw_pair(panel, draws[:, column], draws[:, row], ranges[column], ranges[row])
            _label(panel, marginals, row, column)
        return draw.saved(figure, path)


def _label(panel: Axes, marginals: Sequence[Estimate], row: int, column: int) -> None:
    """Write names with units, at the outer edges only."""
    last = row == len(marginals) - 1
    left = column == 0 and row > 0
    panel.tick_params(which="both", direction="in", labelbottom=last, labelleft=left)
    panel.xaxis.set_major_locator(MaxNLocator(2))
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
    title = "\n".join(textwrap.wrap(m.title, 22))
    return f"{title}\n{m.symbol}{unit}"


def _heading(m: Estimate) -> str:
    shown = m.in_unit()
    if m.detected:
        return format_with_error(shown.value, shown.std) if shown.is_normal else shown.describe_interval()
    return "not detected" if shown.upper_limit is None else f"< {significant(shown.upper_limit)} (95 %)"


def _range(x: _Draws) -> _Ends:
    """Range in which nearly all draws lie."""
    low, high = np.quantile(x, [0.001, 0.999])
    margin = 0.08 * (high - low)
    if not margin > 0.0:
        margin = 0.1 * abs(low) or 1.0
    # An amplitude's panel does not begin below zero.
    return max(low - margin, 0.0) if x.min() >= 0.0 else low - margin, high + margin


def _draw_margin(panel: Axes, x: _Draws, ends: _Ends, prior: Prior, scale: float) -> None:
    """Draw the density of draws, and that of the prior, per unit that is shown."""
    density, edges = np.histogram(x, bins=_BINS, range=ends)
    density = density / (len(x) * np.diff(edges))
    panel.stairs(density, edges, fill=True, color=_COLOUR, alpha=0.25)
    panel.stairs(density, edges, color=_COLOUR, linewidth=1.0)
    some = np.linspace(*ends, 200)
    prior_density = np.exp(np.asarray(prior.log_density(some * scale))) * scale
    panel.plot(some, prior_density, color=draw.ink(0.3), linewidth=1.0, linestyle="--", label="prior")
    low, median, high = np.quantile(x, [0.16, 0.5, 0.84])
    panel.axvline(median, color=draw.ink(), linewidth=1.2)
    for end in (low, high):
        panel.axvline(end, color=draw.ink(), linewidth=0.7)
    panel.set_xlim(ends)
    panel.set_ylim(0.0, 1.08 * density.max())
    panel.set_yticks([])


def _draw_pair(panel: Axes, x: _Draws, y: _Draws, x_ends: _Ends, y_ends: _Ends) -> None:
    counts, x_edges, y_edges = np.histogram2d(x, y, bins=_BINS, range=(x_ends, y_ends))
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
    panel.set_xlim(x_ends)
    panel.set_ylim(y_ends)


def plot_posterior(
    posterior: Posterior,
    curve: AllanDeviation | Fit | None = None,
    axes: Sequence[str] | str | None = None,
    path: str | os.PathLike[str] | None = None,
    spectrum: Any = None,
) -> Figure:
    """Draw the models' Allan deviation and, beside it, their PSD, with 68 and 95 % of the posterior as bands.

    One row per axis. Points are the Allan deviations measured, with 68 % intervals, and the measured PSD if
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
    chosen = [posterior.results[k] for k in draw.rows_of(posterior.axes, None, axes)[0]]
    measured = posterior.fit.curve if curve is None else curve.curve if isinstance(curve, Fit) else curve
    with draw.style():
        key = [
            draw.measured_entry(),
            draw.line_entry(color=_COLOUR, linewidth=1.2, label="median of the model's curves"),
            draw.band_entry("68 % of them", _COLOUR, 0.45),
            draw.band_entry("95 %", _COLOUR, 0.2),
        ]
        heading = Heading(posterior.fit.name or "Posterior", draw.facts_of(measured.n, measured.rate), key)
        figure, panels = _SHEET.draw(heading, [2] * len(chosen), path)
        for result, (left, right) in zip(chosen, panels, strict=True):
            _draw_deviation(left, result, measured)
            _draw_density(right, result, spectrum, measured.n)
            state = "" if result.converged else ", not converged"
            draw.dress(left, f"{result.axis.name}{state}", log="xy")
            draw.dress(right, log="xy")
        return draw.saved(figure, path)


def _draw_band(
    panel: Axes, x: Float[np.ndarray, " points"], curves: Float[np.ndarray, "draws points"]
) -> None:
    low_95, low_68, median, high_68, high_95 = np.quantile(curves, [0.025, 0.16, 0.5, 0.84, 0.975], axis=0)
    panel.fill_between(x, low_95, high_95, **draw.band(_COLOUR, 0.2, label="95 %"))
    panel.fill_between(x, low_68, high_68, **draw.band(_COLOUR, 0.3, label="68 %"))
    panel.plot(x, median, color=_COLOUR, linewidth=1.2, label="median", zorder=2.5)


def _draw_deviation(panel: Axes, result: AxisPosterior, curve: AllanDeviation) -> None:
    unit, scale = draw.unit_of(result.axis)
    time = draw.times_of(curve, _CURVE_POINTS)
    _draw_band(panel, time, result.deviation_curves(time, _DRAWS) / scale)
    points = draw.allan_points(curve[result.axis.name], 0, scale)
    points.draw(panel)
    positive = points.y[points.y > 0.0]
    panel.set_xlim(time[0] / 1.4, time[-1] * 1.4)
    panel.set_ylim(positive.min(initial=np.inf) / 2.5, positive.max(initial=0.0) * 2.0)
    panel.set(xlabel=draw.CLUSTER_TIME, ylabel=draw.label_in("Allan deviation", unit))


def _draw_density(panel: Axes, result: AxisPosterior, spectrum: Any, n: int) -> None:
    unit, scale = density_unit(result.axis)
    f = np.geomspace(result.rate / n, result.rate / 2.0, _DENSITY_POINTS)
    curves = result.density_curves(f, _DRAWS) / scale
    if spectrum is not None:
        density, frequency = spectrum[result.axis.name].density[:, 0] / scale, spectrum.frequency
        shown = (frequency > 0.0) & (density > 0.0)
        panel.plot(frequency[shown], density[shown], label="measured", **draw.dots(2.0, alpha=0.6))
    _draw_band(panel, f, curves)
    # Single ordinates scatter over decades below the density; a few of them leave the panel.
    panel.set_xlim(f[0] / 1.4, f[-1] * 1.4)
    panel.set_ylim(curves.min() / 30.0, curves.max() * 5.0)
    if spectrum is not None:
        draw.mark_off_scale(panel, frequency[shown], density[shown], draw.ink(0.3))
    panel.set(xlabel=draw.FREQUENCY, ylabel=draw.label_in("one-sided PSD", unit))

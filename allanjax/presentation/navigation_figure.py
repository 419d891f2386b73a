"""Figures of Kalman filters, of a navigator's errors and of a calibration's residuals."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from allanjax.base.normal import TWO_SIDED_95
from allanjax.base.wording import duration, format_p_value
from allanjax.calibration.result import Calibration
from allanjax.kalman.filtering import Adapted, AdaptedAxis, BiasTracks, FilteredAxis
from allanjax.navigation.navigator import SHOWN, ErrorGrowth, Navigation
from allanjax.presentation import draw
from allanjax.presentation.draw import Heading, Sheet
from allanjax.record.units import Sensor, rate_unit_of, unit_scale

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Height of the strip below a panel [inches].
_STRIP = 0.9
_BELOW = draw.APART + _STRIP
_TRACKS = Sheet(6.2, 1.8, between=_BELOW + 0.6, left=1.1, bottom=_BELOW + 0.55)
# Most points that are drawn of a record, others being left out at even distances; and of its means.
_MOST, _MEANS = 4000, 300
_BLUE = draw.COLOURS[0]
_ENDS: dict[str, Any] = {"color": _BLUE, "linewidth": 0.8, "linestyle": "--"}
_ERRORS = Sheet(2.9, 2.1, gap=0.55)
# Causes below this share of the error at all times are not drawn.
_DRAWN = 0.05
_UNITS: dict[Sensor, str] = {"gyro": "deg/h", "accel": "µg"}


def plot_bias_tracks(
    result: BiasTracks[Any],
    axes: Sequence[str] | str | None = None,
    path: str | os.PathLike[str] | None = None,
) -> Figure:
    """Draw the bias with its 95 % band over the samples, one row per axis, and a strip below.

    The strip shows standardized innovations, which should be white, 95 % of them within the broken lines; of
    an adaptive filter the models' probabilities given all samples, and dotted given those up to each. Long
    records are drawn as some hundred means of as many samples, and every so many innovations.

    Raises:
        AllanjaxError: there is no such axis.
    """
    results = [result.results[k] for k in draw.rows_of(result.axes, None, axes)[0]]
    adapted = isinstance(result, Adapted)
    title = result.name or ("Adaptive filter" if adapted else "Kalman filter")
    with draw.style():
        key = [draw.line_entry(**_samples()), draw.line_entry(color=_BLUE, label="bias")]
        key.append(draw.band_entry("95 % interval", _BLUE, 0.3))
        if adapted:
            key += [draw.line_entry(**look) for look in _models(results[0])]
        else:
            key.append(draw.line_entry(label="95 % of innovations by chance", **_ENDS))
        heading = Heading(title, draw.facts_of(len(results[0].samples), results[0].rate), key)
        figure, panels = _TRACKS.draw(heading, [1] * len(results), path)
        for track, (upper,) in zip(results, panels, strict=True):
            unit, scale = rate_unit_of(track.axis.unit, track.axis.sensor)
            lower = draw.place_below(upper, _STRIP)
            _draw_bias(upper, track, scale)
            (_draw_probabilities if adapted else _draw_innovations)(lower, track)
            for panel in (upper, lower):
                panel.set_xlim(0.0, max(float(track.time[-1]), 1.0 / track.rate))
            draw.dress(upper, track.axis.name, y=draw.label_in("bias", unit))
            draw.dress(lower, x=draw.TIME if upper is panels[-1][0] else "")
            upper.tick_params(labelbottom=False)
        return draw.saved(figure, path)


def _draw_innovations(panel: Axes, result: FilteredAxis) -> None:
    some = _some(len(result.samples))
    panel.plot(result.time[some], result.standardized[some], **draw.dots(1.4))
    for end in (-TWO_SIDED_95, TWO_SIDED_95):
        panel.axhline(end, **_ENDS)
    panel.set_ylabel("innovation\n[σ]")


def _draw_probabilities(panel: Axes, result: AdaptedAxis) -> None:
    some = _some(len(result.samples))
    for k, look in enumerate(_models(result)):
        panel.plot(result.time[some], result.probability[some, k], **look)
        panel.plot(result.time[some], result.weights[some, k], ":", linewidth=0.8, **look)
    panel.set_ylim(-0.05, 1.05)
    panel.set_ylabel("probability")


def _models(result: AdaptedAxis) -> list[dict[str, Any]]:
    """Styles of the models' lines."""
    colours = draw.COLOURS[1:] + draw.COLOURS[:1]
    return [{"color": colours[k % len(colours)], "label": label} for k, label in enumerate(result.labels)]


def _some(n: int) -> Any:
    """Indices of the samples that are drawn."""
    return np.unique(np.linspace(0, n - 1, min(n, _MOST)).round().astype(int))


def _samples() -> dict[str, Any]:
    return draw.dots(2.0, color=draw.ink(0.6), label="means of samples")


def _draw_bias(panel: Axes, result: FilteredAxis | AdaptedAxis, scale: float) -> None:
    """Draw samples, of long records their means, and the bias with its 95 % band.

    The samples' scale is that of the panel, for at first the band is as wide as they scatter.
    """
    missing = result.missing if isinstance(result, FilteredAxis) else False
    samples = np.where(missing, np.nan, result.samples)
    length = -(-len(samples) // _MEANS)
    parts = np.append(samples, np.full(-len(samples) % length, np.nan)).reshape(-1, length)
    count = np.isfinite(parts).sum(axis=1)
    some = count > 0
    means = np.nansum(parts, axis=1)[some] / count[some]
    middle = (np.flatnonzero(some) * length + (length - 1) / 2.0) / result.rate
    panel.plot(middle, means / scale, **_samples())
    panel.set_ylim(panel.get_ylim())
    at = _some(len(samples))
    at = at[np.isfinite(result.bias_std[at])]
    value, half = result.bias[at] / scale, TWO_SIDED_95 * result.bias_std[at] / scale
    look = draw.band(_BLUE, 0.3, label="95 % interval")
    panel.fill_between(result.time[at], value - half, value + half, **look)
    panel.plot(result.time[at], value, color=_BLUE, linewidth=1.2, label="bias")


def plot_navigation(result: Navigation, path: str | os.PathLike[str] | None = None) -> Figure:
    """Draw errors against time, with their 95 % intervals and what each cause does by itself.

    Rows are attitude, velocity and position, columns north, east and down. The black line is the error, the
    grey band its interval; each term has a colour, and causes below 5 % of the error at all times are left
    out. An error that is a lower bound (`ErrorGrowth.bounds`) is dotted and has no interval. A dotted line is
    a quarter of the Schuler period, where the times reach it.
    """
    growths = list(result.values())
    columns = list(dict.fromkeys(channel for growth in growths for channel in growth.channels))
    styles = _styles(growths)
    with draw.style():
        # Models that are taken as exact have no interval.
        interval = ", with its 95 % interval" if np.isfinite(growths[0].upper).any() else ""
        key = []
        if any(set(growth.channels) - {*growth.bounds} for growth in growths):
            key = [draw.line_entry(**draw.model_line(f"error, 1σ{interval}"))]
        if any(growth.bounds for growth in growths):
            least = draw.model_line(f"error, 1σ: {draw.LEAST_KNOWN}")
            key.append(draw.line_entry(**least | draw.AT_LEAST))
        key += [draw.line_entry(label=name, **of) for name, of in styles.items()]
        loop = "Schuler loop included" if result.schuler else "short-term"
        facts = f"biases averaged over {duration(result.at_rest)} at rest, {result.rate:g} Hz, {loop}"
        moving = result.profile.describe() if result.profile else "at rest"
        heading = Heading(result.name or f"Errors of a navigator {moving}", facts, key)
        figure, panels = _ERRORS.draw(heading, [len(columns)] * len(growths), path)
        for growth, row in zip(growths, panels, strict=True):
            for channel, panel in zip(columns, row, strict=True):
                if channel not in growth.channels:
                    panel.remove()
                    continue
                _draw(panel, growth, channel, styles)
                if growth.time[-1] > result.quarter_period:
                    panel.axvline(result.quarter_period, color=draw.ink(0.4), linewidth=0.8, linestyle=":")
        return draw.saved(figure, path)


def _styles(growths: list[ErrorGrowth]) -> dict[str, dict[str, Any]]:
    """Styles of causes that matter somewhere, by sensor and term, the same in all panels."""
    names = [_kind(cause) for growth in growths for of in growth.channels for cause in _causes(growth, of)]
    return {
        # Where colours come again, their dashes are others.
        name: {
            "color": draw.COLOURS[k % len(draw.COLOURS)],
            "linestyle": draw.DASHES[(k + k // len(draw.COLOURS)) % len(draw.DASHES)],
            "linewidth": 1.2,
        }
        for k, name in enumerate(dict.fromkeys(names))
    }


def _causes(growth: ErrorGrowth, channel: str) -> dict[str, Any]:
    """Causes of an error that are drawn."""
    least = _DRAWN * growth.of(channel) ** 2
    return {cause: part for cause, part in growth.causes[channel].items() if (part**2 >= least).any()}


def _kind(cause: str) -> str:
    """A cause without the letter of its axis, e.g. "gyro angle random walk"."""
    axis, _, term = cause.partition(" ")
    return f"{axis.partition('_')[0]} {term}"


def _draw(panel: Axes, growth: ErrorGrowth, channel: str, styles: dict[str, dict[str, Any]]) -> None:
    unit, scale = SHOWN[growth.quantity]
    k, error = growth.channels.index(channel), growth.of(channel)
    draw.dress(panel, f"{growth.quantity} {channel} [{unit}]", draw.TIME, log="xy")
    look = draw.model_line()
    if channel in growth.bounds:
        look |= draw.AT_LEAST
    else:
        lower, upper = growth.lower[k] / scale, growth.upper[k] / scale
        panel.fill_between(growth.time, lower, upper, color=draw.ink(0.85), zorder=1)
    for cause, part in _causes(growth, channel).items():
        panel.plot(growth.time, part / scale, label=cause, **styles[_kind(cause)])
    panel.plot(growth.time, error / scale, **look)
    panel.set_ylim(error.min() / scale / 3.0, error.max() / scale * 3.0)


def plot_calibration(
    calibration: Calibration,
    axes: Sequence[str] | str | None = None,
    path: str | os.PathLike[str] | None = None,
) -> Figure:
    """Draw the residuals of each position with ± 1σ of the noise model, one panel per axis.

    Raises:
        AllanjaxError: there is no such axis.
    """
    names = [name for misfit in calibration.misfit.values() for name in misfit.names]
    chosen = [names[k] for k in draw.rows_of(names, None, axes)[0]]
    of_sensors = calibration.misfit.items()
    rows = [(sensor, m, [k for k, n in enumerate(m.names) if n in chosen]) for sensor, m in of_sensors]
    rows = [row for row in rows if row[2]]
    labels = [position.label for position in calibration.positions]
    at = np.arange(len(labels))
    # The labels hang down aslant.
    below = 0.5 + 0.05 * max(map(len, labels))
    sheet = Sheet(2.7, 2.1, gap=0.25, between=below + 0.3, bottom=below)
    with draw.style():
        checks = [
            f"{draw.SENSORS[s]}: {format_p_value(m.p_value) if m.dof else 'no check'}" for s, m, _ in rows
        ]
        key = [draw.points_entry("measured − fitted mean, ± 1σ of the noise")]
        heading = Heading(f"Calibration from {len(at)} positions", "; ".join(checks), key)
        figure, panels = sheet.draw(heading, [len(kept) for _, _, kept in rows], path)
        for (sensor, misfit, kept), row in zip(rows, panels, strict=True):
            scale = unit_scale(_UNITS[sensor], sensor)
            reach = np.nanmax(np.abs(misfit.residuals) + misfit.residual_std) / scale * 1.15 or 1.0
            for column, (k, panel) in enumerate(zip(kept, row, strict=True)):
                value, spread = misfit.residuals[:, k] / scale, misfit.residual_std[:, k] / scale
                panel.axhline(0.0, color=draw.ink(), linewidth=1.0)
                panel.errorbar(at, value, spread, label="residual", elinewidth=0.8, **draw.dots(3.5))
                draw.dress(panel, misfit.names[k], y="" if column else f"residual [{_UNITS[sensor]}]")
                panel.set_ylim(-reach, reach)
                panel.set_xlim(-0.5, len(at) - 0.5)
                panel.set_xticks(at, labels, rotation=45, ha="right", rotation_mode="anchor")
                panel.tick_params(labelleft=column == 0)
        return draw.saved(figure, path)

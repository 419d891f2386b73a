"""Figures of spectra with a fitted model, autocorrelations, wavelet variances and wavelet decompositions."""

from __future__ import annotations

import functools
import math
import os
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from allanjax.base.chi_squared import chi_squared_factors, quantile
from allanjax.base.errors import AllanjaxError
from allanjax.base.normal import TWO_SIDED_95
from allanjax.base.wording import plain
from allanjax.estimate.result import AxisFit, Fit
from allanjax.noise.estimate import Estimate, title_of
from allanjax.noise.parameter import Parametrized
from allanjax.presentation import draw
from allanjax.presentation.draw import Heading, KeyEntry, Panel, Points, Residual, Sheet
from allanjax.spectrum.autocorrelation import Autocorrelation, square_unit
from allanjax.spectrum.psd import PowerSpectrum, density_unit

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from allanjax.noise.model import Model
    from allanjax.noise.process import Process
    from allanjax.noise.terms import NoiseTerm
    from allanjax.wavelets.decomposition import WaveletDecomposition
    from allanjax.wavelets.variance import WaveletVariance

# Residuals are averaged to as many points as an Allan curve that is fitted has.
_RESIDUALS_PER_OCTAVE = 4
_OCTAVES = Sheet(5.6, 0.8, between=0.12, left=1.6)


def plot_psd(
    spectrum: PowerSpectrum,
    fit: Fit | None = None,
    axes: Sequence[str] | str | None = None,
    path: str | os.PathLike[str] | None = None,
    *,
    ax: Axes | None = None,
) -> Figure:
    """Draw the one-sided power spectral density against frequency, gyros above accelerometers.

    Points are the estimates, averaged after Hou (2004) table 3.4, with their 68 % intervals. Without a fit,
    the grey band is the flat part, whose mean density 2·N² gives the N below the panel, eq. (3.41). With one,
    the black line is the density that samples of the model have, aliases included; broken lines are its terms
    as in `plot_allan`, a vertical line is a sinusoid, and a strip shows measured over model minus one,
    averaged to four points per octave. A drift ramp has no density.
    Densities are in (deg/h)²/Hz and µg²/Hz.

    Args:
        spectrum: what `power_spectrum` returns.
        fit: a fit of the same recording.
        axes: names of the axes to draw, e.g. `["gyro_x", "gyro_z"]`; all of them by default. For the spectrum
            of an array: `["0", "1", ...]`.
        path: a file to save the picture to, by its suffix .png, .svg or .pdf.
        ax: matplotlib axes to draw a single axis into, without title, strip and key.

    Returns:
        The matplotlib figure.

    Raises:
        AllanjaxError: there is no such axis, the fit is one of another recording, or `ax` is given for more
            than one axis.
    """
    spectrum = spectrum.averaged()
    facts = draw.facts_of(spectrum.n, spectrum.rate)
    if fit is not None and fit.curve.others and spectrum.n == fit.curve.n:
        facts += f" (the longest of {1 + len(fit.curve.others)} segments)"
    heading = draw.heading_of(fit, "Power spectral density", facts, axes)
    rows = draw.rows_of(spectrum.names, spectrum.axes, axes)
    # In axes of the caller's there is no key to say what the band is; a fit has an N of its own.
    has_band = ax is None and spectrum.axes is not None and fit is None
    panel_of = functools.partial(_panel, spectrum, fit, has_band)
    return draw.draw_panels(heading, draw.FREQUENCY, rows, panel_of, path, ax)


def plot_spectrum(
    spectrum: PowerSpectrum,
    axes: Sequence[str] | str | None = None,
    path: str | os.PathLike[str] | None = None,
    *,
    ax: Axes | None = None,
) -> Figure:
    """Draw a spectrum without a model; see `plot_psd`."""
    return plot_psd(spectrum, axes=axes, path=path, ax=ax)


def _panel(spectrum: PowerSpectrum, fit: Fit | None, has_band: bool, k: int) -> Panel:
    """Power spectral density of an axis and, of a fit, the model, its terms and residuals."""
    unit, scale = ("", 1.0) if spectrum.axes is None else density_unit(spectrum.axes[k])
    name, label = spectrum.names[k], draw.label_in("one-sided PSD", unit)
    ends = [end[:, k] for end in spectrum.confidence_interval(0.68)]
    points = [Points.of(spectrum.frequency, spectrum.density[:, k], ends, scale)]
    if fit is None:
        walk = _random_walk(spectrum, name) if has_band else None

        def fill(panel: Axes) -> None:
            if walk is not None and walk.band is not None:
                panel.axvspan(*walk.band, color=draw.ink(0.93), linewidth=0.0, zorder=0, label="flat part")

        return Panel(name, label, points, fill, [_walk_entry(walk)] if has_band else [])
    result = _result(spectrum, fit, name)
    verdict = draw.verdict_entry(result, "Hz")
    if not result.converged:
        return Panel(name, label, points, lambda _: None, [verdict])
    own = fit.as_for(name)
    entries = draw.term_entries(own, result, _is_nowhere, " (no density: not drawn)")
    return Panel(
        *(name, label, points),
        lambda panel: _draw_model(panel, spectrum, own, result, scale),
        [*entries, verdict],
        residual(spectrum, k, own),
        draw.worst_place(result, "Hz"),
    )


def _result(spectrum: PowerSpectrum, fit: Fit, name: str) -> AxisFit:
    end = "pass the power_spectrum of the fitted recording"
    if spectrum.axes is None or name not in fit.axes:
        raise AllanjaxError(f"the fit has no axis {name!r}, only {', '.join(fit.axes)}; {end}")
    if not np.isclose(spectrum.rate, fit.curve.rate, rtol=1e-9):
        rates = f"the spectrum has samples at {spectrum.rate:g} Hz, the fit at {fit.curve.rate:g} Hz"
        raise AllanjaxError(f"{rates}; {end}")
    return fit[name]


def _random_walk(spectrum: PowerSpectrum, name: str) -> Estimate | None:
    """N of an axis by the flat part of its spectrum; None if it is nowhere flat."""
    try:
        return spectrum.random_walk(name)
    except AllanjaxError:
        return None


def _draw_model(panel: Axes, spectrum: PowerSpectrum, fit: Fit, result: AxisFit, scale: float) -> None:
    rate = spectrum.rate
    model = result.model.sampled(rate)
    frequency = frequencies(spectrum, model)
    styles = draw.term_styles(fit, result)
    for label, term in zip(result.term_labels, model.processes, strict=True):
        name, look = title_of(label, result.axis.sensor), styles.get(label)
        if look and not term.deterministic:
            density = 2.0 * np.asarray(term.sampled_psd(frequency, rate))
            panel.plot(frequency, density / scale, label=name, **look)
        elif look:
            for line in _line_of(term):
                panel.axvline(line, label=name, **look)
    total = fit.stated(result.axis.name).density(frequency)
    panel.plot(frequency, total / scale, **draw.model_line())


def frequencies(spectrum: PowerSpectrum, model: Model) -> Float[np.ndarray, " f"]:
    """Frequencies at which the model is drawn [Hz], dense enough for the peak of a resonance."""
    lowest, highest = spectrum.frequency[[0, -1]]
    parts = [np.geomspace(lowest, highest, 400)]
    away = np.geomspace(1e-5, 0.5, 40)
    for p in model.parameters:
        if p.parameter.kind == "line" and not model.terms[p.term].deterministic:
            parts += [(p.start or 0.0) * factor for factor in (1.0 - away, 1.0 + away)]
    f = np.unique(np.concatenate(parts))
    return f[(lowest <= f) & (f <= highest)]


def residual(spectrum: PowerSpectrum, k: int, fit: Fit) -> Residual:
    """Mean residual of each group of points; single points of few degrees of freedom would only clutter."""
    first_ordinate = np.cumsum(spectrum.count) - spectrum.count + 1
    starts = np.unique(np.floor(_RESIDUALS_PER_OCTAVE * np.log2(first_ordinate)), return_index=True)[1]
    result = fit[spectrum.names[k]]
    model = _mean_density(spectrum, fit, result)
    count = np.add.reduceat(spectrum.count, starts)
    ratio = np.add.reduceat(spectrum.count * spectrum.density[:, k] / model, starts) / count
    dof = spectrum.degrees_of_freedom(count)
    lower, upper = chi_squared_factors(dof, 0.68)
    spread = ratio * np.stack([1.0 - lower, upper - 1.0])
    # A sinusoid stands out of a density, as it should.
    edges = np.append(spectrum.frequency[starts], spectrum.rate / 2.0)
    lines = np.array([f for term in result.model.terms for f in _line_of(term)])
    has_line = np.histogram(lines, edges)[0] > 0
    has_line |= np.roll(has_line, 1) | np.roll(has_line, -1)
    points = Points(
        np.add.reduceat(spectrum.count * spectrum.frequency, starts) / count,
        100.0 * (ratio - 1.0),
        100.0 * np.maximum(spread, 0.0),
    )
    chance = 100.0 * (quantile(np.array([[0.025], [0.975]]), dof) / dof - 1.0)
    return Residual(points, (dof > 2.0 / draw.PRECISE**2) & ~has_line, chance)


def _mean_density(spectrum: PowerSpectrum, fit: Fit, result: AxisFit) -> Float[np.ndarray, " m"]:
    """Mean density that a fit states over the ordinates of each point, where a resonance may be narrow."""
    last = np.cumsum(spectrum.count)
    spacing = 2.0 * spectrum.frequency[0] / (1.0 + spectrum.count[0])
    edges = spacing * (np.append(0.0, last) + 0.5)
    f = np.unique(np.concatenate([frequencies(spectrum, result.model), edges, spectrum.frequency]))
    density = fit.stated(result.axis.name).density(f)
    total = np.append(0.0, np.cumsum(0.5 * np.diff(f) * (density[1:] + density[:-1])))
    mean = np.diff(total[np.searchsorted(f, edges)]) / np.diff(edges)
    return np.where(spectrum.count == 1, density[np.searchsorted(f, spectrum.frequency)], mean)


def _line_of(term: Process) -> list[float]:
    """Frequency of a deterministic line [Hz], none for another term."""
    if not (term.deterministic and isinstance(term, Parametrized)):
        return []
    return [float(getattr(term, p.name)) for p in term.parameters() if p.kind == "line"]


def _is_nowhere(term: NoiseTerm) -> bool:
    """Whether a term is neither a density nor a line."""
    return term.deterministic and not any(p.kind == "line" for p in term.parameters())


def _walk_entry(walk: Estimate | None) -> KeyEntry:
    """Entry of N from the flat part."""
    if walk is None or walk.band is None:
        return KeyEntry("no N from the PSD: it is nowhere flat over an octave")
    low, high = walk.band
    text = f"N from the flat part: {walk.in_unit().describe()} ({plain(low, 3)} to {plain(high, 3)} Hz)"
    return KeyEntry(text, {"color": draw.ink(0.93), "linewidth": 7.0, "solid_capstyle": "butt"})


def plot_autocorrelation(
    result: Autocorrelation,
    axes: Sequence[str] | str | None = None,
    path: str | os.PathLike[str] | None = None,
    *,
    ax: Axes | None = None,
) -> Figure:
    """Draw autocorrelations over the lag, as figure 3.8 of Hou (2004), gyros above accelerometers.

    The grey band is ± 1.96 standard errors of the model, if there are any; the dotted lines are the value at
    lag zero over e, and the lag at which the curve comes there.
    """
    rows = draw.rows_of(result.names, result.axes, axes)
    heading = Heading("Autocorrelation", draw.facts_of(result.n, result.rate))

    def panel(k: int) -> Panel:
        unit, scale = ("", 1.0) if result.axes is None else square_unit(result.axes[k])
        label, fill = (
            draw.label_in("autocorrelation", unit),
            functools.partial(_draw_correlation, result, k, scale),
        )
        return Panel(result.names[k], label, (), fill, ())

    return draw.draw_panels(heading, "lag [s]", rows, panel, path, ax)


def _draw_correlation(result: Autocorrelation, k: int, scale: float, panel: Axes) -> None:
    value, error = result.value[:, k] / scale, result.standard_error[:, k] / scale
    some = draw.extremes(value)
    lag, value, error = result.lag[some], value[some], error[some]
    if np.isfinite(error).all():
        band: dict[str, Any] = {"color": draw.ink(0.85), "linewidth": 0.0, "label": "95 % under the model"}
        panel.fill_between(lag, value - TWO_SIDED_95 * error, value + TWO_SIDED_95 * error, **band)
    panel.plot(lag, value, color=draw.ink(0.3), linewidth=1.0, label="estimate")
    below = np.flatnonzero(math.e * value < value[0])
    if below.size:
        dotted: dict[str, Any] = {"color": draw.ink(0.5), "linewidth": 0.8, "linestyle": ":"}
        panel.axhline(value[0] / math.e, **dotted)
        panel.axvline(lag[below[0]], **dotted)
    panel.set_xlim(-0.02 * lag[-1], lag[-1])
    panel.yaxis.set_major_formatter(lambda y, _: plain(y).replace("-", "−"))


def plot_wavelet_variance(
    variance: WaveletVariance,
    axes: Sequence[str] | str | None = None,
    path: str | os.PathLike[str] | None = None,
    *,
    ax: Axes | None = None,
) -> Figure:
    """Draw wavelet variances with their 68 % intervals against the scale, gyros above accelerometers."""
    ends = variance.confidence_interval(0.68)

    def panel(k: int) -> Panel:
        unit, scale = ("", 1.0) if variance.axes is None else square_unit(variance.axes[k])
        points = Points.of(variance.scale, variance.variance[:, k], [end[:, k] for end in ends], scale)
        return Panel(variance.names[k], draw.label_in("wavelet variance", unit), [points], lambda _: None, [])

    facts = f"{variance.wavelet}, {draw.facts_of(variance.n, variance.rate)}"
    rows = draw.rows_of(variance.names, variance.axes, axes)
    heading = draw.heading_of(None, "Wavelet variance", facts, axes)
    return draw.draw_panels(heading, "scale [s]", rows, panel, path, ax)


def plot_decomposition(
    decomposition: WaveletDecomposition,
    axis: str | None = None,
    levels: Sequence[int] | None = None,
    path: str | os.PathLike[str] | None = None,
) -> Figure:
    """Draw an axis as measured, its details and the last approximation, one below the other, over time.

    As figure 3.6 of Hou (2004), with what was taken out between.

    Args:
        decomposition: what `wavelet_decomposition` returns.
        axis: name of the axis; the first by default.
        levels: levels of the details to draw, and of the approximation the last of them; by default all.
        path: file for the figure, with the suffix .png, .svg or .pdf.

    Raises:
        AllanjaxError: there is no such axis or level.
    """
    recording = decomposition.recording
    k = draw.rows_of(recording.names, None, axis)[0][0]
    name = recording.names[k]
    unit, scale = draw.unit_of(recording.axes[k])
    shown = sorted(levels) if levels else list(range(1, decomposition.levels + 1))
    parts = [("measured", recording)]
    for level in shown:
        low, high = (plain(float(f), 2) for f in decomposition.band[level - 1])
        parts.append((f"level {level}\n{low}–{high} Hz", decomposition.details(level)))
    lowest = plain(float(decomposition.band[shown[-1] - 1, 0]), 2)
    parts.append((f"below\n{lowest} Hz", decomposition.approximation(shown[-1])))
    with draw.style():
        record = f"{decomposition.wavelet}, {draw.facts_of(recording.n, recording.rate)}"
        heading = Heading(f"{name}, wavelet decomposition [{unit}]", record)
        figure, panels = _OCTAVES.draw(heading, [1] * len(parts), path)
        for row, ((label, part), (panel,)) in enumerate(zip(parts, panels, strict=True)):
            draw.dress(panel)
            y = part.values[:, k] / scale
            some = draw.extremes(y)
            colour = draw.ink(0.3) if row in (0, len(parts) - 1) else draw.COLOURS[0]
            panel.plot(some / recording.rate, y[some], color=colour, linewidth=0.7)
            panel.set_ylabel(label, rotation=0, ha="right", va="center")
            panel.yaxis.set_label_coords(-0.11, 0.5)
            panel.set_xlim(0.0, recording.n / recording.rate)
            panel.tick_params(labelbottom=row == len(parts) - 1)
        panel.set_xlabel(draw.TIME)
        return draw.saved(figure, path)

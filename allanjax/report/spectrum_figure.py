"""Figure of a spectrum: power spectral densities, a fitted model and its terms."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float, Int

from allanjax.base.chi_squared import chi_squared_factors, quantile
from allanjax.base.errors import AllanjaxError
from allanjax.base.wording import plain
from allanjax.estimate.result import AxisFit, Fit
from allanjax.noise.estimate import Estimate, title_of
from allanjax.noise.parameter import Parametrized
from allanjax.report.figure import (
    FREQUENCY,
    PRECISE,
    Frame,
    KeyEntry,
    Panel,
    Points,
    Residual,
    drawn_terms,
    facts_of,
    ink,
    label_in,
    model_line,
    rows_of,
    term_entries,
    term_style,
    verdict_entry,
    worst_place,
    wrapped,
)
from allanjax.spectrum.psd import PowerSpectrum, density_unit

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from allanjax.noise.model import Model
    from allanjax.noise.process import Process
    from allanjax.noise.terms import NoiseTerm

# Residuals are averaged to as many points as an Allan curve that is fitted has.
_RESIDUALS_PER_OCTAVE = 4


def plot_psd(
    spectrum: PowerSpectrum,
    fit: Fit | None = None,
    axes: Sequence[str] | str | None = None,
    path: str | os.PathLike[str] | None = None,
    *,
    ax: Axes | None = None,
) -> Figure:
    """Draw one-sided power spectral density against frequency, gyros above accelerometers.

    Points are the estimates, averaged after Hou (2004) table 3.4, with their 68 % intervals. Without a fit,
    the grey band is the flat part from which N below the panel follows by eq. (3.41). With one, the black
    line is the density that samples of the model have, aliases included; broken lines are its terms as in
    `plot_allan`, a vertical line is a sinusoid, and a strip shows measured over model minus one, averaged to
    four points an octave. A drift ramp has no density.
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
    title = fit.name if fit is not None and fit.name else "power spectral density"
    has_fit = fit is not None
    facts = facts_of(spectrum.n, spectrum.rate)
    frame = Frame(title, facts, FREQUENCY, has_fit, has_fit)
    rows = rows_of(spectrum.names, spectrum.axes, axes)
    # In axes of the caller's there is no key to say what the band is; a fit has an N of its own.
    has_band = ax is None and spectrum.axes is not None and fit is None
    return frame.draw([[_panel(spectrum, fit, k, has_band) for k in row] for row in rows], path, ax)


def plot_spectrum(
    spectrum: PowerSpectrum,
    axes: Sequence[str] | str | None = None,
    path: str | os.PathLike[str] | None = None,
    *,
    ax: Axes | None = None,
) -> Figure:
    """Draw a spectrum without a model; see `plot_psd`."""
    return plot_psd(spectrum, axes=axes, path=path, ax=ax)


def _panel(spectrum: PowerSpectrum, fit: Fit | None, k: int, has_band: bool) -> Panel:
    """Power spectral density of an axis and, of a fit, the model, its terms and residuals."""
    unit, scale = ("", 1.0) if spectrum.axes is None else density_unit(spectrum.axes[k])
    result = None if fit is None else _result(spectrum, fit, k)
    fit = fit if fit is None or result is None or not result.converged else fit.as_for(result.axis.name)
    walk = _random_walk(spectrum, k) if has_band else None
    key = [] if result is None else [verdict_entry(result, "Hz")]
    if fit is not None and result is not None and result.converged:
        key = [*term_entries(fit, result, _is_nowhere, " (no density: not drawn)"), *key]
    if has_band:
        key.append(_walk_entry(walk))

    def draw(panel: Axes) -> None:
        if walk is not None and walk.band is not None:
            panel.axvspan(*walk.band, color=ink(0.93), linewidth=0.0, zorder=0, label="flat part")
        if fit is not None and result is not None and result.converged:
            _draw_model(panel, spectrum, fit, result, scale)

    ends = [end[:, k] for end in spectrum.confidence_interval(0.68)]
    points = [Points.of(spectrum.frequency, spectrum.density[:, k], ends, scale)]
    residual = _residual(spectrum, k, result) if result is not None and result.converged else None
    worst = worst_place(result, "Hz") if residual is not None and result is not None else np.nan
    return Panel(spectrum.names[k], label_in("one-sided PSD", unit), points, draw, key, residual, worst)


def _result(spectrum: PowerSpectrum, fit: Fit, k: int) -> AxisFit:
    name, end = spectrum.names[k], "give it the power_spectrum of the recording that was fitted"
    if spectrum.axes is None or name not in fit.axes:
        raise AllanjaxError(f"the fit has no axis {name!r}, only {', '.join(fit.axes)}; {end}")
    if not np.isclose(spectrum.rate, fit.curve.rate, rtol=1e-9):
        rates = (
            f"the spectrum is of samples at {spectrum.rate:g} Hz, the fit of samples at {fit.curve.rate:g} Hz"
        )
        raise AllanjaxError(f"{rates}; {end}")
    return fit[name]


def _random_walk(spectrum: PowerSpectrum, k: int) -> Estimate | None:
    """N of an axis by the flat part of its spectrum; None if it is nowhere flat."""
    try:
        return spectrum.random_walk(spectrum.names[k])
    except AllanjaxError:
        return None


def _draw_model(panel: Axes, spectrum: PowerSpectrum, fit: Fit, result: AxisFit, scale: float) -> None:
    rate = spectrum.rate
    model = result.model.sampled(rate)
    frequency = _frequencies(spectrum, model)
    total = np.zeros(len(frequency))
    for label, term in zip(result.term_labels, model.processes, strict=True):
        style: dict[str, Any] = {
            "label": title_of(label, result.axis.sensor),
            **term_style(fit, result, label),
        }
        drawn = label in drawn_terms(result)
        if not term.deterministic:
            density = 2.0 * np.asarray(term.sampled_psd(frequency, rate))
            total += density
            if drawn:
                panel.plot(frequency, density / scale, **style)
        elif drawn:
            for line in _line_of(term):
                panel.axvline(line, **style)
    panel.plot(frequency, total / scale, **model_line())


def _frequencies(spectrum: PowerSpectrum, model: Model) -> Float[np.ndarray, " f"]:
    """Frequencies at which the model is drawn [Hz], dense enough for the peak of a resonance."""
    lowest, highest = spectrum.frequency[[0, -1]]
    found = [np.geomspace(lowest, highest, 400)]
    away = np.geomspace(1e-5, 0.5, 40)
    for p in model.parameters:
        if p.parameter.kind == "line" and not model.terms[p.term].deterministic:
            found += [float(model.values[p.label] or 0.0) * factor for factor in (1.0 - away, 1.0 + away)]
    f = np.unique(np.concatenate(found))
    return f[(lowest <= f) & (f <= highest)]


def _residual(spectrum: PowerSpectrum, k: int, result: AxisFit) -> Residual:
    """Mean residual of each group of points; single points of few degrees of freedom would only clutter."""
    starts = _residual_groups(spectrum)
    rate = spectrum.rate
    model = 2.0 * np.asarray(result.model.sampled(rate).sampled_psd(spectrum.frequency, rate))
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
    return Residual(points, (dof > 2.0 / PRECISE**2) & ~has_line, chance)


def _residual_groups(spectrum: PowerSpectrum) -> Int[np.ndarray, " groups"]:
    """First point of each group of the strip."""
    first_ordinate = np.cumsum(spectrum.count) - spectrum.count + 1
    return np.unique(np.floor(_RESIDUALS_PER_OCTAVE * np.log2(first_ordinate)), return_index=True)[1]


def _line_of(term: Process) -> list[float]:
    """Frequency of a deterministic line [Hz], none for another term."""
    if not (term.deterministic and isinstance(term, Parametrized)):
        return []
    return [float(getattr(term, p.name)) for p in term.parameters() if p.kind == "line"]


def _is_nowhere(term: NoiseTerm) -> bool:
    """Whether a term is neither a density nor a line."""
    return term.deterministic and not any(p.kind == "line" for p in term.parameters())


def _walk_entry(walk: Estimate | None) -> KeyEntry:
    """Entry of N from the flat part, by (3.41)."""
    if walk is None or walk.band is None:
        return KeyEntry(wrapped("no N from the PSD: it is nowhere flat over an octave"))
    low, high = walk.band
    text = f"N from the flat part: {walk.in_unit().describe()} ({plain(low, 3)} to {plain(high, 3)} Hz)"
    return KeyEntry(wrapped(text), {"color": ink(0.93), "linewidth": 7.0, "solid_capstyle": "butt"})

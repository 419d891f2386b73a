"""The picture of a spectrum: power spectral densities, and a fitted model and its terms over them."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Int

from allanjax.base.errors import AllanjaxError
from allanjax.base.wording import plain
from allanjax.estimate.result import AxisFit, Fit
from allanjax.noise.estimate import Estimate, title_of
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
    marks,
    only_one,
    rows_of,
    save_and_close,
    set_scales,
    style,
    term_entry,
    term_style,
    wrapped,
)
from allanjax.spectrum.flat_band import chi_squared_factors
from allanjax.spectrum.psd import PowerSpectrum, density_unit

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from allanjax.noise.model import Model
    from allanjax.noise.terms import NoiseTerm

# Estimates with a larger relative error do not set the scale of the residuals.
_PRECISE = 0.2
# Residuals are averaged to as many points as an Allan curve that is fitted has.
_RESIDUALS_PER_OCTAVE = 4
_BAND = "0.93"


def plot_psd(
    spectrum: PowerSpectrum,
    fit: Fit | None = None,
    axes: Sequence[str] | str | None = None,
    path: str | os.PathLike[str] | None = None,
    *,
    ax: Axes | None = None,
) -> Figure:
    """Draw one-sided power spectral density against frequency, gyros above accelerometers.

    Points are the estimates, averaged after Hou (2004) table 3.4, with their 68 % intervals; the grey band is
    the flat part from which N below the panel follows by eq. (3.41). For a fit, the black line is the density
    that samples of the model have, aliases included; broken lines are its terms as in `plot_allan`, a
    vertical line is a sinusoid, and a strip shows measured over model minus one, averaged to four points an
    octave. A drift ramp has no density.
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
    import matplotlib.pyplot as plt

    spectrum = spectrum.averaged()
    rows = rows_of(spectrum.names, spectrum.axes, [axes] if isinstance(axes, str) else axes)
    results = {} if fit is None else {k: _result(spectrum, fit, k) for row in rows for k in row}
    if ax is not None:
        with style():
            _draw_into(ax, only_one(rows), spectrum, fit, results)
            return figure_with(ax, path)
    with style():
        walks = {k: _random_walk(spectrum, k) for row in rows for k in row}
        keys = {k: _key(fit, results.get(k), walks[k], spectrum) for k in walks}
        cells = Cells.of(rows, keys, has_strip=fit is not None)
        figure = plt.figure(figsize=cells.size)
        title = fit.name if fit is not None and fit.name else "power spectral density"
        draw_title(figure, cells, title, facts_of(spectrum.n, spectrum.rate), has_model=fit is not None)
        for i, row in enumerate(rows):
            _draw_row(figure, cells, i, row, spectrum, fit, results, walks, keys)
        return save_and_close(figure, path)


def plot_spectrum(
    spectrum: PowerSpectrum,
    axes: Sequence[str] | str | None = None,
    path: str | os.PathLike[str] | None = None,
    *,
    ax: Axes | None = None,
) -> Figure:
    """Draw a spectrum without a model; see `plot_psd`."""
    return plot_psd(spectrum, axes=axes, path=path, ax=ax)


def _draw_into(
    panel: Axes, k: int, spectrum: PowerSpectrum, fit: Fit | None, results: Mapping[int, AxisFit]
) -> None:
    """One axis in a panel of the caller's."""
    unit = _unit(spectrum, k)
    _draw_measured(panel, spectrum, k, unit)
    if fit is not None and results[k].converged:
        _draw_model(panel, spectrum, fit, results[k], unit)
    set_scales({k: panel}, {}, spectrum.frequency, spectrum.density[:, [k]] / unit.scale)
    panel.set_xlabel("frequency f [Hz]")
    panel.set_ylabel(_label(unit))


def _unit(spectrum: PowerSpectrum, k: int) -> Unit:
    return Unit("", 1.0) if spectrum.axes is None else Unit(*density_unit(spectrum.axes[k]))


def _label(unit: Unit) -> str:
    return "one-sided PSD" + (f"\n[{unit.name}]" if unit.name else "")


def _result(spectrum: PowerSpectrum, fit: Fit, k: int) -> AxisFit:
    name = spectrum.names[k]
    if spectrum.axes is None or name not in fit.axes:
        raise AllanjaxError(
            f"the fit has no axis {name!r}, only {', '.join(fit.axes)}; "
            "give it the power_spectrum of the recording that was fitted"
        )
    if not np.isclose(spectrum.rate, fit.curve.rate, rtol=1e-9):
        raise AllanjaxError(
            f"the spectrum's samples come at {spectrum.rate:g} Hz, the fit's at {fit.curve.rate:g} Hz; "
            "give it the power_spectrum of the recording that was fitted"
        )
    return fit[name]


def _random_walk(spectrum: PowerSpectrum, k: int) -> Estimate | None:
    """N of the axis, unless its samples have no unit or its density is nowhere flat."""
    if spectrum.axes is None:
        return None
    try:
        return spectrum.random_walk(spectrum.names[k])
    except AllanjaxError:
        return None


def _draw_row(
    figure: Figure,
    cells: Cells,
    row: int,
    indices: Sequence[int],
    spectrum: PowerSpectrum,
    fit: Fit | None,
    results: Mapping[int, AxisFit],
    walks: Mapping[int, Estimate | None],
    keys: Mapping[int, list[KeyEntry]],
) -> None:
    panels: dict[int, Axes] = {}
    strips: dict[int, Axes] = {}
    residuals: dict[int, Residual] = {}
    unit = _unit(spectrum, indices[0])
    starts = _residual_groups(spectrum)
    for column, k in enumerate(indices):
        panels[k] = lowest = cells.panel(figure, row, column)
        panels[k].set_title(spectrum.names[k], loc="left", fontweight="bold")
        walk = walks[k]
        if walk is not None and walk.band is not None:
            panels[k].axvspan(*walk.band, color=_BAND, linewidth=0.0, zorder=0, label="flat part")
        _draw_measured(panels[k], spectrum, k, unit)
        if fit is not None:
            strips[k] = lowest = cells.strip(figure, row, column)
            if results[k].converged:
                _draw_model(panels[k], spectrum, fit, results[k], unit)
                residuals[k] = _residual(spectrum, k, starts, results[k])
        if keys[k]:
            draw_key(cells.key(figure, row, column), cells, keys[k])
        lowest.set_xlabel("frequency f [Hz]")
    middle = np.add.reduceat(spectrum.count * spectrum.frequency, starts)
    draw_residuals(strips, middle / np.add.reduceat(spectrum.count, starts), residuals)
    set_scales(panels, strips, spectrum.frequency, spectrum.density[:, list(panels)] / unit.scale)
    panels[indices[0]].set_ylabel(_label(unit))
    if strips:
        strips[indices[0]].set_ylabel("measured /\nmodel − 1 [%]")


def _draw_measured(panel: Axes, spectrum: PowerSpectrum, k: int, unit: Unit) -> None:
    density = spectrum.density[:, k]
    lower, upper = spectrum.confidence_interval(0.68)
    # Of two degrees of freedom, the interval may lie beside the estimate.
    spread = np.maximum(np.stack([density - lower[:, k], upper[:, k] - density]), 0.0)
    panel.errorbar(
        spectrum.frequency,
        density / unit.scale,
        spread / unit.scale,
        label="measured",
        zorder=3,
        **marks(2.6),
    )


def _draw_model(panel: Axes, spectrum: PowerSpectrum, fit: Fit, result: AxisFit, unit: Unit) -> None:
    rate = spectrum.rate
    model = result.model.sampled(rate)
    frequency = _frequencies(spectrum, model)
    total = np.zeros(len(frequency))
    for label, term in zip(result.term_labels, model.terms, strict=True):
        title, style = title_of(label, result.axis), term_style(fit, label)
        if term.deterministic:
            for line in _line_of(term):
                panel.axvline(line, label=title, **style)
            continue
        density = 2.0 * np.asarray(term.sampled_psd(frequency, rate))
        total += density
        panel.plot(frequency, density / unit.scale, label=title, **style)
    panel.plot(frequency, total / unit.scale, color="black", linewidth=1.4, label="model", zorder=2.5)


def _frequencies(spectrum: PowerSpectrum, model: Model) -> Float[np.ndarray, " f"]:
    """Where to draw the model [Hz]: dense enough for a curve, and for the peak of a resonance."""
    lowest, highest = spectrum.frequency[[0, -1]]
    found = [np.geomspace(lowest, highest, 400)]
    away = np.geomspace(1e-5, 0.5, 40)
    for p in model.parameters:
        if p.parameter.kind == "line" and not model.terms[p.term].deterministic:
            found += [float(model.values[p.label] or 0.0) * factor for factor in (1.0 - away, 1.0 + away)]
    f = np.unique(np.concatenate(found))
    return f[(lowest <= f) & (f <= highest)]


def _residual(
    spectrum: PowerSpectrum, k: int, starts: Int[np.ndarray, " groups"], result: AxisFit
) -> Residual:
    """Mean over groups of points: single points of few degrees of freedom would only clutter the strip."""
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
    return Residual(
        100.0 * (ratio - 1.0),
        100.0 * np.maximum(spread, 0.0),
        (dof > 2.0 / _PRECISE**2) & ~has_line,
        off=0.0,
    )


def _residual_groups(spectrum: PowerSpectrum) -> Int[np.ndarray, " groups"]:
    """First point of each group of the strip."""
    first_ordinate = np.cumsum(spectrum.count) - spectrum.count + 1
    return np.unique(np.floor(_RESIDUALS_PER_OCTAVE * np.log2(first_ordinate)), return_index=True)[1]


def _line_of(term: NoiseTerm) -> list[float]:
    """Frequency [Hz] of a deterministic line; nothing for another term."""
    if not term.deterministic:
        return []
    return [float(getattr(term, p.name)) for p in term.parameters() if p.kind == "line"]


def _key(
    fit: Fit | None, result: AxisFit | None, walk: Estimate | None, spectrum: PowerSpectrum
) -> list[KeyEntry]:
    """Every term with its coefficients, and N from the flat part."""
    entries = []
    if fit is not None and result is not None:
        if not result.converged:
            entries.append(KeyEntry(wrapped(result.verdict())))
        else:
            for label, term in zip(fit.template.term_labels, fit.template.terms, strict=True):
                hidden = term.deterministic and not any(p.kind == "line" for p in term.parameters())
                shown = label in result.term_labels
                remark = " (no density: not drawn)" if hidden and shown else ""
                entries.append(term_entry(fit, result, label, remark))
    if walk is not None and walk.band is not None:
        low, high = walk.band
        text = f"N by eq. (3.41): {walk.in_unit().describe()} ({plain(low, 3)} to {plain(high, 3)} Hz)"
        entries.append(KeyEntry(wrapped(text), {"color": _BAND, "linewidth": 7.0, "solid_capstyle": "butt"}))
    elif spectrum.axes is not None:
        entries.append(KeyEntry(wrapped("N by eq. (3.41): nowhere flat over an octave")))
    return entries

"""Figure of a spectrum: power spectral densities, a fitted model and its terms."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from jaxtyping import Float, Int

from allanjax.base.errors import AllanjaxError
from allanjax.base.wording import plain
from allanjax.estimate.result import AxisFit, Fit
from allanjax.noise.estimate import Estimate, title_of
from allanjax.report.figure import (
    MODEL,
    KeyEntry,
    Unit,
    drawn_terms,
    facts_of,
    marks,
    term_entry,
    term_style,
    wrapped,
)
from allanjax.report.frame import PRECISE, Heading, Panels, Residual, rows_of
from allanjax.spectrum.flat_band import chi_squared_factors
from allanjax.spectrum.psd import PowerSpectrum, density_unit

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

    from allanjax.noise.model import Model
    from allanjax.noise.terms import NoiseTerm

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
    spectrum = spectrum.averaged()
    rows = rows_of(spectrum.names, spectrum.axes, [axes] if isinstance(axes, str) else axes)
    results = {} if fit is None else {k: _result(spectrum, fit, k) for row in rows for k in row}
    # In axes of the caller's there is no key to say what the band is.
    walks = {} if ax is not None else {k: _random_walk(spectrum, k) for row in rows for k in row}
    title = fit.name if fit is not None and fit.name else "power spectral density"
    has_fit = fit is not None
    heading = Heading(spectrum.names, title, facts_of(spectrum.n, spectrum.rate), has_fit, has_fit)
    return _SpectrumPanels(spectrum, fit, results, walks).figure(rows, heading, path, ax)


def plot_spectrum(
    spectrum: PowerSpectrum,
    axes: Sequence[str] | str | None = None,
    path: str | os.PathLike[str] | None = None,
    *,
    ax: Axes | None = None,
) -> Figure:
    """Draw a spectrum without a model; see `plot_psd`."""
    return plot_psd(spectrum, axes=axes, path=path, ax=ax)


@dataclass(frozen=True)
class _SpectrumPanels(Panels):
    """Power spectral densities and, of a fit, the model, its terms and residuals.

    Attributes:
        spectrum: averaged densities.
        fit: fit of the same recording.
        results: fits of the axes to draw, by their index in the spectrum.
        walks: N by the flat part of each spectrum, None where it has none.
    """

    X_LABEL: ClassVar[str] = "frequency f [Hz]"

    spectrum: PowerSpectrum
    fit: Fit | None
    results: Mapping[int, AxisFit]
    walks: Mapping[int, Estimate | None]

    def y_label(self, k: int) -> str:
        unit = self._unit(k)
        return "one-sided PSD" + (f"\n[{unit.name}]" if unit.name else "")

    def key(self, k: int) -> list[KeyEntry]:
        return _key(self.fit, self.results.get(k), self.walks[k], self.spectrum)

    def draw(self, panel: Axes, k: int) -> dict[str, Line2D]:
        walk = self.walks.get(k)
        if walk is not None and walk.band is not None:
            panel.axvspan(*walk.band, color=_BAND, linewidth=0.0, zorder=0, label="flat part")
        _draw_measured(panel, self.spectrum, k, self._unit(k))
        if self.fit is not None and self.results[k].converged:
            _draw_model(panel, self.spectrum, self.fit, self.results[k], self._unit(k))
        return {}

    def extent(self, row: Sequence[int]) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, "m columns"]]:
        return self.spectrum.frequency, self.spectrum.density[:, list(row)] / self._unit(row[0]).scale

    def residual(self, k: int) -> Residual | None:
        return _residual(self.spectrum, k, self.results[k]) if self.results[k].converged else None

    def _unit(self, k: int) -> Unit:
        axes = self.spectrum.axes
        return Unit("", 1.0) if axes is None else Unit(*density_unit(axes[k]))


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
    """N of an axis by the flat part of its spectrum; None if it is nowhere flat or has no unit."""
    if spectrum.axes is None:
        return None
    try:
        return spectrum.random_walk(spectrum.names[k])
    except AllanjaxError:
        return None


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
        style: dict[str, Any] = {"label": title_of(label, result.axis), **term_style(fit, label)}
        drawn = label in drawn_terms(result)
        if not term.deterministic:
            density = 2.0 * np.asarray(term.sampled_psd(frequency, rate))
            total += density
            if drawn:
                panel.plot(frequency, density / unit.scale, **style)
        elif drawn:
            for line in _line_of(term):
                panel.axvline(line, **style)
    panel.plot(frequency, total / unit.scale, **MODEL)


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
    return Residual(
        np.add.reduceat(spectrum.count * spectrum.frequency, starts) / count,
        100.0 * (ratio - 1.0),
        100.0 * np.maximum(spread, 0.0),
        (dof > 2.0 / PRECISE**2) & ~has_line,
        off=0.0,
    )


def _residual_groups(spectrum: PowerSpectrum) -> Int[np.ndarray, " groups"]:
    """First point of each group of the strip."""
    first_ordinate = np.cumsum(spectrum.count) - spectrum.count + 1
    return np.unique(np.floor(_RESIDUALS_PER_OCTAVE * np.log2(first_ordinate)), return_index=True)[1]


def _line_of(term: NoiseTerm) -> list[float]:
    """Frequency of a deterministic line [Hz], none for another term."""
    if not term.deterministic:
        return []
    return [float(getattr(term, p.name)) for p in term.parameters() if p.kind == "line"]


def _key(
    fit: Fit | None, result: AxisFit | None, walk: Estimate | None, spectrum: PowerSpectrum
) -> list[KeyEntry]:
    """Entries of every term with its coefficients, and of N by the flat part."""
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

"""Fits of single axes to Allan or wavelet variances, their verdict by the spectrum, and the fitted curve."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import TypeAlias

import numpy as np
from jaxtyping import Float

from allanjax.allan.deviation import AllanDeviation
from allanjax.base.chi_squared import beyond_doubt, upper_tail
from allanjax.base.errors import FitError
from allanjax.estimate.design import (
    AllanDesign,
    find_starts,
    free_powers,
    geometry_of,
    shape_candidates,
)
from allanjax.estimate.deterministic import AxisSpectrum, InUse, Line, Peaks, needs_record
from allanjax.estimate.gls import Solution, solve
from allanjax.estimate.inference import (
    Estimates,
    coefficients_of,
    count_estimated,
    deterministic_coefficients,
    infer,
)
from allanjax.estimate.result import AxisFit, Misfit, misfit_of, widened
from allanjax.estimate.spectral.components import columns_of
from allanjax.estimate.spectral.fit import chi_squared
from allanjax.estimate.whittle import axis_fit, fit_spectrum
from allanjax.noise.estimate import Estimate
from allanjax.noise.model import Model
from allanjax.noise.terms.deterministic import Transient
from allanjax.record.recording import Axis, Recording
from allanjax.wavelets.variance import WaveletFilter, mean_squares
from allanjax.wavelets.variance import geometry_of as wavelet_geometry

# Cluster sizes and terms to which a fit's arrays are padded: with four per octave, sizes of 6·10⁷ samples.
ALLAN_CAPACITY = (96, 6)
_Spectra: TypeAlias = Sequence[AxisSpectrum]


def fit_allan(
    curve: AllanDeviation, spectra: _Spectra | None, axes: Sequence[Axis], template: Model, active: InUse
) -> tuple[AxisFit, ...]:
    """Fit every axis by generalized least squares of its Allan variances, with the lines of its spectrum."""
    design = AllanDesign.of(template, curve, ALLAN_CAPACITY)
    return _fit_estimates(design, curve.variance, spectra, axes, template, active)


def fit_wavelet(
    recording: Recording, spectra: _Spectra, template: Model, active: InUse, wavelet: str
) -> tuple[AxisFit, ...]:
    """Fit every axis of a recording by generalized least squares of its wavelet variances.

    Raises:
        FitError: a term that these variances do not determine, or too few levels.
    """
    found = WaveletFilter.of(wavelet)
    for term in template.terms:
        if term.deterministic or term.narrow_band:
            raise FitError(
                f"the {wavelet} wavelet variances do not determine {term.name()}; leave it out, or use "
                'wavelet="haar"'
            )
    levels = np.arange(1, found.most_levels(recording.n) + 1)
    check_count(len(levels), "wavelet variances", recording.n, template, recording.name)
    geometry = wavelet_geometry(found, levels, recording.n, recording.rate)
    design = AllanDesign.of_geometry(template, geometry, ALLAN_CAPACITY[1])
    variance = np.stack([mean_squares(x, found, len(levels)) for x in recording.values.T], axis=1)
    return _fit_estimates(design, variance, spectra, recording.axes, template, active)


def check_count(count: int, estimates: str, n: int, template: Model, name: str) -> None:
    """Raise FitError unless n samples give more of the `estimates` than there are free parameters."""
    free_count = sum(p.free for p in template.parameters)
    if count <= free_count:
        raise FitError(
            f"{name or 'the recording'}: {n} samples give {count} {estimates}, too few for {free_count} "
            "parameters; record for longer or use fewer terms"
        )


def check_terms(template: Model, reason: str) -> None:
    """Raise FitError for a term that must be estimated from the record itself, with the reason and remedy."""
    for term in template.terms:
        if needs_record(term):
            raise FitError(f"{term.name()} {reason}")


def _fit_estimates(
    design: AllanDesign,
    variances: Float[np.ndarray, "m axes"],
    spectra: _Spectra | None,
    axes: Sequence[Axis],
    template: Model,
    active: InUse,
) -> tuple[AxisFit, ...]:
    """Fits of every axis to its estimates; see `fit_allan`."""
    results, geometry = [], design.geometry
    for k, axis in enumerate(axes):
        model, here = template, active[[k]]
        lines, peaks = (spectra[k].lines, spectra[k].peaks) if spectra else ({}, ())
        if lines:
            # The record determines a line far better than its Allan variances do.
            model = _with_lines(template, lines)
            design = AllanDesign.of_geometry(model, geometry, len(design.scatters))
        variance = variances[:, [k]].T
        solution, estimates, (misfit,) = solve_and_infer(model, design, variance, here, peaks)
        others: dict[str, Estimate] = {}
        for i, line in lines.items():
            estimate = line.beta, line.amplitude_std**2 * np.eye(2)
            others |= deterministic_coefficients(template, i, axis, *estimate, line, geometry.n)
        coefficients = coefficients_of(template, axis, model, estimates, others, geometry.n, geometry.rate)
        dof = len(variances) - count_estimated(template, active[k])
        result = axis_fit(axis, template, active[k], coefficients, solution, dof, misfit)
        # With one or two degrees of freedom, as at the longest cluster times, the χ² tail is not valid.
        results.append(dataclasses.replace(result, p_value=np.nan))
    return tuple(results)


def _with_lines(template: Model, lines: Mapping[int, Line]) -> Model:
    """The model with these lines held where they were found; an amplitude that is held keeps its value."""
    terms = list(template.terms)
    for k, line in lines.items():
        amplitude, frequency = (p.name for p in terms[k].parameters())
        size = {amplitude: float(np.hypot(*line.beta))} if terms[k].has_free_amplitude else {}
        terms[k] = terms[k].hold(amplitude, **{frequency: line.frequency}, **size)
    return dataclasses.replace(template, terms=tuple(terms))


def solve_and_infer(
    model: Model,
    design: AllanDesign,
    variance: Float[np.ndarray, "axes m"],
    active: InUse,
    peaks: Peaks = (),
) -> tuple[Solution, Estimates, list[Misfit | None]]:
    """Best solution of each axis over its starts, its coefficients, and its misfit.

    The design is for these estimates; resonances start from the peaks [Hz].
    """
    from scipy.ndimage import median_filter

    place, m = design.geometry, variance.shape[1]
    free, candidates = free_powers(model), shape_candidates(model, float(place.duration), place.rate, peaks)
    # A single estimate that is small by chance must not lower all powers.
    smooth = np.exp(median_filter(np.log(np.maximum(variance, 1e-300)), (1, 5), mode="nearest"))
    units = np.stack([design.means(shape) for shape in candidates])[:, : len(model), :m]
    starts = find_starts(model, candidates, units, smooth, place.n / place.sizes[:m], active)
    solution = solve(design, variance, free, active, *starts)
    tangent, off = design.tangent(solution.shape), solution.converged & (solution.power_error > 0.0)
    mean, scatter = tangent.mean(solution.power), tangent.variances(solution.power)
    each = zip(off, np.sqrt(variance / mean), 2.0 * mean**2 / scatter, strict=True)
    time = place.cluster_time[:m]
    misfits = [misfit_of(time, ratio, edf, "s") if is_off else None for is_off, ratio, edf in each]
    solution = widened(solution, misfits)
    return solution, infer(model, tangent, variance, active, solution), misfits


def judged(template: Model, spectrum: AxisSpectrum, active: InUse, result: AxisFit) -> AxisFit:
    """Fit of an axis's variances with the verdict of its spectrum, or Whittle's fit where the two disagree.

    The law of the levels is known at all frequencies, but that of variances at long cluster times is not.
    """
    random = np.array([not term.deterministic for term in template.terms])
    sufficient, fits = result.converged and result.discrepancy == 0.0, False
    if sufficient:
        noise = [term for term in result.model.sampled(spectrum.bins.rate).terms if not term.deterministic]
        power = [getattr(term, term.amplitude_parameter().name) ** 2 for term in noise]
        mean = np.array(power) @ columns_of(noise, spectrum.bins).mean(axis=1)
        projection = spectrum.project(mean, spectrum.used(active))
        chi2 = chi_squared(projection.level / mean, projection.dof)
        dof = projection.estimates - count_estimated(template, active & random)
        fits = bool(chi2 <= beyond_doubt(dof))
    if not fits:
        other = fit_spectrum(template, result.axis, spectrum, active)
        # A doubtful spectrum does not overrule variances that refuse the model.
        refused = result.converged and not sufficient and (other.discrepancy > 0.0 or other.doubtful)
        if not refused:
            return other if other.converged else result
        chi2, dof = other.chi2, other.dof
    return dataclasses.replace(result, chi2=chi2, dof=dof, p_value=float(upper_tail(chi2, dof)))


def with_curve(
    curve: AllanDeviation, template: Model, results: Sequence[AxisFit]
) -> tuple[tuple[AxisFit, ...], AllanDeviation]:
    """Fits, those of spectra with the misfit of their Allan deviations, and the curve.

    It gets its degrees of freedom 2μ²/Var under the fitted models.
    """
    geometry, edf, found = geometry_of(curve, template), np.array(curve.edf), []
    alone = geometry.chosen(np.equal(*geometry.pairs))
    # Effects that are projected out of the spectrum are still in the Allan deviations.
    profiled = any(isinstance(term, Transient) for term in template.terms)
    for k, result in enumerate(results):
        if result.converged:
            mean, scatter = map(np.asarray, alone.moments(result.model.sampled(curve.rate).processes))
            edf[:, k] = 2.0 * mean**2 / scatter * curve.gain
            if result.spectrum is not None and not (profiled or result.regression):
                ratio = curve.deviation[:, k] / np.sqrt(mean)
                misfit = misfit_of(curve.cluster_time, ratio, edf[:, k], "s")
                # The misfit of a fitted spectrum is that of its levels, unless that of the Allan deviations
                # is excessive.
                if result.misfit is not None and result.measured and misfit.excessive:
                    result = result.unmeasured(misfit=misfit)
                else:
                    result = dataclasses.replace(result, allan_misfit=misfit.beside(result.misfit))
        found.append(result)
    return tuple(found), dataclasses.replace(curve, edf=edf)

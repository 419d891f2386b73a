"""Fits of single axes: by Whittle's likelihood, and by Allan or wavelet variances.

The levels of the cosine spectrum are χ² around their expectations (see `cosine`); the joint spectral model
computes these for all terms and the response at once (`spectral`). The inference is as for Allan variances,
with the levels in their place. Lines, ramps and regressors are estimated alongside (`deterministic`).
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Mapping, Sequence
from typing import Any, TypeAlias

import numpy as np
from jaxtyping import Float

from allanjax.allan.deviation import AllanDeviation
from allanjax.base.chi_squared import beyond_doubt, upper_tail
from allanjax.base.errors import FitError
from allanjax.base.threads import for_each
from allanjax.estimate.design import (
    AllanDesign,
    Solution,
    find_starts,
    free_powers,
    free_shapes,
    geometry_of,
    shape_candidates,
    solve,
)
from allanjax.estimate.deterministic import AxisSpectrum, InUse, Line, Peaks, Projection, needs_record
from allanjax.estimate.inference import (
    Estimates,
    coefficients_of,
    count_estimated,
    deterministic_coefficients,
    infer,
)
from allanjax.estimate.misfit import Misfit, misfit_of, spectral_misfit, widened
from allanjax.estimate.result import (
    AxisFit,
    extended_model,
    fitted_model,
)
from allanjax.estimate.spectral.components import BROAD, QUICK, columns_of
from allanjax.estimate.spectral.fit import (
    Arrangement,
    LevelFit,
    best_of,
    chi_squared,
    fit_levels,
    share_with_error,
)
from allanjax.noise.estimate import Estimate
from allanjax.noise.model import Model
from allanjax.noise.terms import Markov, PowerLaw, Resonance
from allanjax.noise.terms.deterministic import Transient
from allanjax.record.recording import Axis, Recording
from allanjax.spectrum.cosine import smoothed
from allanjax.wavelets.variance import WaveletFilter, mean_squares, wavelet_geometry

# Cluster sizes and terms to which a fit's arrays are padded: with four per octave, sizes of 6·10⁷ samples.
ALLAN_CAPACITY = (96, 6)
# Probability below which it is doubtful that a spectrum follows the model.
_DOUBTFUL = 1e-3
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
    """Fit every axis of a recording by generalized least squares of its wavelet variances."""
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
        found = coefficients_of(template, axis, model, estimates, others, geometry.n, geometry.rate)
        dof = len(variances) - count_estimated(template, active[k])
        result = axis_fit(axis, template, active[k], *found, solution, dof, misfit)
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
    model: Model, design: AllanDesign, variance: Float[np.ndarray, "axes m"], active: InUse, peaks: Peaks = ()
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


def fit_judged(
    curve: AllanDeviation, spectra: _Spectra, axes: Sequence[Axis], template: Model, active: InUse
) -> tuple[AxisFit, ...]:
    """Fit every axis to its Allan variances, with the verdict of its spectrum; see `judged`."""
    fits = fit_allan(curve, spectra, axes, template, active)
    each = zip(spectra, active, fits, strict=True)
    return tuple(for_each(lambda of_axis: judged(template, *of_axis), each))


def judged(template: Model, spectrum: AxisSpectrum, active: InUse, result: AxisFit) -> AxisFit:
    """Fit of an axis's variances with the verdict of its spectrum, or Whittle's fit where the two disagree.

    The law of the levels is known at all frequencies, but that of variances at long cluster times is not.
    """
    random = np.array([not term.deterministic for term in template.terms])
    sufficient = result.converged and result.discrepancy == 0.0
    fits, misfit = False, None
    if result.converged:
        noise = [term for term in result.model.sampled(spectrum.bins.rate).terms if not term.deterministic]
        power = [getattr(term, term.amplitude_parameter().name) ** 2 for term in noise]
        mean = np.array(power) @ columns_of(noise, spectrum.bins).mean(axis=1)
        projection = spectrum.project(mean, spectrum.used(active))
        chi2 = chi_squared(projection.level / mean, projection.dof)
        dof = projection.estimates - count_estimated(template, active & random)
        fits = sufficient and bool(chi2 <= beyond_doubt(dof))
        misfit = spectral_misfit(spectrum.bins.frequency, projection.level, mean, projection.dof)
    if fits:
        p_value = float(upper_tail(chi2, dof))
        return dataclasses.replace(result, misfit=misfit, chi2=chi2, dof=dof, p_value=p_value)
    other = fit_spectrum(template, result.axis, spectrum, active)
    # A doubtful spectrum does not overrule variances that refuse the model.
    refused = result.converged and not sufficient and not other.p_value > _DOUBTFUL
    if not refused:
        return other if other.converged else result
    test = {name: getattr(other, name) for name in ("chi2", "dof", "p_value")}
    return dataclasses.replace(result, other_misfit=misfit, **test)


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
                result = dataclasses.replace(result, other_misfit=misfit)
                # A spectrum whose few lowest levels are far off may still pass its test.
                if result.discrepancy > 0.0 and result.measured and misfit and misfit.excessive:
                    result = result.unmeasured(misfit=misfit)
        found.append(result)
    return tuple(found), dataclasses.replace(curve, edf=edf)


# Rounds of projecting out deterministic parts and fitting the noise, after which both have settled.
_ROUNDS = 3
# Levels with fewer degrees of freedom are smoothed for the start values.
_FEW = 8.0
# Share of their weight that levels keep beside the ends of a record, above which these do not matter.
_NEARLY_ALL = 0.9
# Candidates of start values that are evaluated together.
_BLOCK = 32
# Relative error of the power around a resonance, up to this factor from its frequency, beyond which it is not
# the oscillator's shape, a judgement; and how certain that has to be, in standard deviations.
_SHAPED, _AROUND, _CERTAIN = 0.05, 1.5, 5.0
# Powers and shapes.
_Start: TypeAlias = tuple[Float[np.ndarray, " terms"], Float[np.ndarray, " shapes"]]


def fit_spectra(
    template: Model, axes: Sequence[Axis], spectra: Sequence[AxisSpectrum], active: InUse
) -> tuple[AxisFit, ...]:
    """Fit every axis to its spectral statistics; see `fit_spectrum`."""
    each = zip(axes, spectra, active, strict=True)
    return tuple(fit_spectrum(template, *of_axis) for of_axis in each)


def fit_spectrum(
    template: Model, axis: Axis, spectrum: AxisSpectrum, active: InUse, at_low: bool = False
) -> AxisFit:
    """Fit a model to the spectral statistics of one axis by maximum likelihood.

    Terms that are not active have an upper limit. `at_low`: N is the density at low frequencies, which
    includes that of wide resonances and of short processes; the fitted model has them apart.
    """
    random = np.array([not term.deterministic for term in template.terms])
    if not (random & active).any():
        raise FitError(
            "Whittle's likelihood needs a random term besides lines and ramps; add AngleRandomWalk()"
        )
    noise, here, used = template.without(absent(template, random)), active[random], spectrum.used(active)
    arrangement, projection, fit = _fit_noise(noise, spectrum, used, here)
    bins, level, mean = spectrum.bins, projection.level, fit.maximum.mean
    misfit = spectral_misfit(bins.frequency, level, mean, projection.dof) if fit.solution.converged else None
    is_off = fit.solution.power_error > 0.0
    white = noise.term_labels.index("angle_random_walk") if at_low else 0
    plateaus = _plateaus(arrangement, projection, fit) if at_low else {}
    tangent, found = arrangement.tangent(fit, plateaus, white)
    solution = widened(Solution(*(np.asarray(x)[None] for x in found)), [misfit if is_off else None])
    estimates = infer(noise, tangent, level[None], here[None], solution)
    others: dict[str, Estimate] = {}
    for k in np.flatnonzero(~random).tolist():
        own = np.array([owner == k for owner in spectrum.owners])
        joint = spectrum.project(mean, own | used)
        estimate = joint.amplitude[own], joint.covariance[np.ix_(own, own)]
        line = spectrum.lines.get(k)
        others |= deterministic_coefficients(template, k, axis, *estimate, line, bins.n, bool(active[k]))
    values, covariance = coefficients_of(template, axis, noise, estimates, others, bins.n, bins.rate)
    degrees = projection.estimates - count_estimated(template, active & random)
    result = axis_fit(axis, template, active, values, covariance, solution, degrees, misfit)
    std = np.sqrt(np.diag(projection.covariance)).tolist()
    amplitudes = zip(spectrum.owners, projection.amplitude.tolist(), std, strict=True)
    regression = {owner: (x, error) for owner, x, error in amplitudes if isinstance(owner, str)}
    more: dict[str, Any] = {"regression": regression, "spectrum": spectrum}
    if plateaus:
        alone = template.with_values(angle_random_walk=float(np.sqrt(fit.solution.power[white])))
        more["_model"] = extended_model(alone, values, absent(template, active))
    return dataclasses.replace(result, **more)


def _fit_noise(
    noise: Model, spectrum: AxisSpectrum, used: InUse, active: InUse
) -> tuple[Arrangement, Projection, LevelFit]:
    """Fit the active random terms, alternating with the projection of the deterministic columns in use.

    What the ends of the record contribute to the levels follows from the fit, too.
    """
    empty, starts = Arrangement.of(noise, spectrum.bins), list[_Start]()
    share = np.ones(len(spectrum.squares))
    variance = smooth = smoothed(spectrum.squares, spectrum.bins.size)
    for _ in range(_ROUNDS if used.any() else 2):
        projection = spectrum.project(variance, used)
        projection = projection._replace(dof=projection.dof * share)
        arrangement = empty.with_data(projection.level, projection.dof)
        # Single coefficients scatter too much for start values.
        rough = np.where(projection.dof < _FEW, smooth, projection.level)
        starts = starts or _starts(arrangement, rough, active, spectrum)
        # The likelihood may have several maxima in a correlation time: all starts are tried.
        fit = best_of([fit_levels(arrangement, active, *start, smooth) for start in starts])
        starts, variance = [fit.solution[:2]], fit.maximum.mean
        share = share_with_error(spectrum.bins.size, arrangement.error_of_ends(*fit.solution[1::-1]))
        if not used.any() and np.all(share > _NEARLY_ALL):
            break
    return arrangement, projection, fit


def _starts(
    arrangement: Arrangement, level: np.ndarray, active: InUse, spectrum: AxisSpectrum
) -> list[_Start]:
    """Powers and shapes to start from, found in these levels."""
    noise, bins, dof = arrangement.model, spectrum.bins, 2.0 * arrangement.levels.shape
    candidates = shape_candidates(noise, bins.n / bins.rate, bins.rate, spectrum.peaks)
    blocks = np.array_split(candidates, -(-len(candidates) // _BLOCK))
    each = (len(noise), len(level))
    unit = np.concatenate([np.broadcast_to(arrangement.expected(x), (len(x), *each)) for x in blocks])
    power, shape = find_starts(noise, candidates, unit, level[None], dof, active[None])
    return list(zip(power[0], shape[0], strict=True))


def _plateaus(
    arrangement: Arrangement, projection: Projection, fit: LevelFit
) -> dict[int, Mapping[str, float]]:
    """Terms that are white at low frequencies, where nothing distinguishes them from white noise.

    These include resonances of which the data show another shape than the oscillator's. See
    `Arrangement.tangent`.
    """
    bins, ratio = arrangement.bins, projection.level / fit.maximum.mean
    found: dict[int, Mapping[str, float]] = {}
    shapes = zip(free_shapes(arrangement.model), np.exp(fit.solution.shape), strict=True)
    values = {p.label: float(p.parameter.lower + x) for p, x in shapes}
    for place, term in enumerate(arrangement.model.with_values(**values).terms):
        if isinstance(term, PowerLaw):
            found[place] = {"": 1.0}
        elif isinstance(term, Markov):
            T = float(term.correlation_time or 0.0)
            if T * bins.rate < QUICK:
                found[place] = {"": T**2, "correlation_time": 2.0}
        elif isinstance(term, Resonance):
            f, Q = float(term.frequency or 0.0), float(term.quality_factor or 0.0)
            near = (abs(np.log(bins.frequency / f)) < np.log(_AROUND)) & (projection.dof > 0.5)
            w, k = 0.5 * fit.degrees[near], 0.5 * projection.dof[near]
            # Squared relative deviations of gamma laws have means 1/k and variances (2 + 6/k)/k².
            chance = np.sum(w / k) + _CERTAIN * np.sqrt(np.sum((w / k) ** 2 * (2.0 + 6.0 / k)))
            if Q < BROAD or w @ (ratio[near] - 1.0) ** 2 > chance + _SHAPED**2 * w.sum():
                slopes = {"frequency": -1.0, "quality_factor": 0.5 / Q - 1.0, "spread": 0.0}
                found[place] = {"": 1.0 / (np.pi * f * Q), **slopes}
    return found


def absent(template: Model, active: InUse) -> list[str]:
    """Labels of the terms that are not active."""
    return list(itertools.compress(template.term_labels, ~active))


def axis_fit(
    axis: Axis,
    template: Model,
    active: InUse,
    coefficients: dict[str, Estimate],
    covariance: np.ndarray,
    solution: Solution,
    dof: int,
    misfit: Misfit | None,
) -> AxisFit:
    """Result of one axis from its solution [1]; without intervals and limits if the misfit is excessive."""
    converged = bool(solution.converged[0])
    result = AxisFit(
        axis=axis,
        converged=converged,
        reason="" if converged else "the fit did not converge; try fewer terms or other start values",
        chi2=float(solution.chi2[0]),
        dof=dof,
        p_value=float(upper_tail(solution.chi2[0], dof)),
        discrepancy=float(solution.discrepancy[0]),
        _coefficients=coefficients,
        _covariance=covariance,
        _model=fitted_model(template, coefficients, absent(template, active)),
        misfit=misfit if converged else None,
    )
    return result.unmeasured() if result.is_far_off else result

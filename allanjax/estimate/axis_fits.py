"""Fits of single axes: by Whittle's likelihood, the exact likelihood, and Allan or wavelet variances.

The levels of the cosine spectrum are χ² around their expectations (see `cosine`); the joint spectral model
computes these for all terms and the response at once (`spectral`). The inference is as for Allan variances,
with the levels in their place. Lines, ramps and regressors are estimated alongside (`deterministic`).

For the exact Gaussian likelihood, computed by a Kalman filter, the mean of the record is unknown: the
likelihood is that of the differences of successive samples. From the maximum of Whittle's likelihood, Fisher
scoring climbs the exact one. With the innovations e, their variances s, and their derivatives by central
differences, score and information are

    −Σ e ∂_i e/s − ½ Σ ∂_i s/s·(1 − e²/s)    and    Σ ∂_i e ∂_j e/s + ½ Σ ∂_i s ∂_j s/s²

(Harvey 1989, Forecasting, Structural Time Series Models and the Kalman Filter, 3.4.5): a step is least
squares. Intervals of amplitudes come from the likelihood ratio, with the other parameters moving along their
regression on the amplitude; intervals of shapes come from the information matrix.

Fits of one noise model to the Allan variances of many axes go in blocks that share the cores.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Bool, Float

from allanjax.allan.deviation import AllanDeviation, allan_deviation
from allanjax.allan.estimators import Spacing
from allanjax.base.chi_squared import beyond_doubt, upper_tail
from allanjax.base.equality import ByValue
from allanjax.base.errors import AllanjaxError, FitError
from allanjax.base.tables import Column, Tabled, columns_from
from allanjax.base.threads import for_each
from allanjax.base.wording import significant
from allanjax.estimate.design import (
    INSIDE,
    AllanDesign,
    Solution,
    find_starts,
    free_powers,
    free_shapes,
    geometry_of,
    model_to_fit,
    shape_candidates,
    solve,
)
from allanjax.estimate.deterministic import AxisSpectrum, InUse, Line, Peaks, Projection, needs_record
from allanjax.estimate.inference import (
    Estimates,
    coefficients_of,
    count_estimated,
    deterministic_coefficients,
    ends_of,
    estimates_of,
    infer,
    reported,
)
from allanjax.estimate.result import (
    AxisFit,
    Misfit,
    extended_model,
    fitted_model,
    misfit_of,
    spectral_misfit,
    widened,
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
from allanjax.kalman.recursion import innovations_under, log_likelihoods
from allanjax.noise.estimate import Estimate, usual_unit
from allanjax.noise.model import Model
from allanjax.noise.notation import ModelLike
from allanjax.noise.terms import Markov, PowerLaw, Resonance
from allanjax.noise.terms.deterministic import Transient
from allanjax.record.recording import Axis, Recording
from allanjax.record.units import unit_scale
from allanjax.spectrum.cosine import smoothed
from allanjax.wavelets.variance import WaveletFilter, mean_squares
from allanjax.wavelets.variance import geometry_of as wavelet_geometry

if TYPE_CHECKING:
    import pandas as pd

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
    bins, level, mean, misfit = spectrum.bins, projection.level, fit.maximum.mean, None
    if fit.solution.converged and fit.solution.power_error > 0.0:
        misfit = spectral_misfit(bins.frequency, level, mean, projection.dof)
    white = noise.term_labels.index("angle_random_walk") if at_low else 0
    plateaus = _plateaus(arrangement, projection, fit) if at_low else {}
    tangent, found = arrangement.tangent(fit, plateaus, white)
    solution = widened(Solution(*(np.asarray(x)[None] for x in found)), [misfit])
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
                slopes = {"frequency": -1.0, "quality_factor": 0.5 / Q - 1.0}
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


_Vector: TypeAlias = Float[np.ndarray, " p"]
_Square: TypeAlias = Float[np.ndarray, "p p"]
_Flags: TypeAlias = Bool[np.ndarray, " p"]

#: Most samples of a record.
MOST = 100_000
# Difference for the derivatives, and least power, in units of a power and in ln of shapes.
_DIFFERENCE, _LEAST = 1e-3, 1e-12
# Most steps; gain of a step [nats] below which the maximum is reached; and in ln of a shape the longest step,
# and bounds about its start.
_MOST_STEPS, _REACHED, _LONGEST, _REACH = 30, 1e-5, 1.0, 4.0
# Hypothetical powers: number and lowest of those below the estimate, and those above, in standard deviations.
_BELOW, _LOWEST = 12, -7.0
_ABOVE = np.array([0.0, 0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 4.0, 6.0, 10.0, 20.0, 50.0, 200.0])


def check_exact(model: Model | None, recording: Recording) -> None:
    """Raise FitError if the exact likelihood cannot be used, with an alternative."""
    whittle = 'use objective="whittle" (--objective whittle)'
    if model is None:
        raise FitError(
            'objective="exact" needs a model, e.g. "N + K" (--terms); select_terms ranks the terms'
        )
    if recording.n > MOST:
        raise FitError(
            f"{recording.name or 'the recording'}: the exact likelihood takes at most {MOST:,} samples, not "
            f"{recording.n:,}; {whittle}, which is as precise for long records, or average the samples"
        )
    for label, term in zip(model.term_labels, model.terms, strict=True):
        if term.deterministic:
            raise FitError(
                f"{label} is deterministic, but the exact likelihood is of random terms; {whittle}"
            )
        if isinstance(term, PowerLaw) and any(term.is_free(p) for p in term.parameters()[1:]):
            raise FitError(f"{label} has no state space with a free exponent; hold it, or {whittle}")


def fit_exact(recording: Recording, k: int, template: Model, active: InUse) -> tuple[AxisFit, bool]:
    """Fit one axis by its exact likelihood, starting from Whittle's, and whether that was possible.

    Where the model does not fit the spectrum, the result is that of Whittle's likelihood.
    """
    spectrum = AxisSpectrum.of(template, recording.values[:, k], recording.rate)
    start = fit_spectrum(template, recording.axes[k], spectrum, active)
    if not start.converged or start.discrepancy > 0.0:
        return start, False
    problem = _Problem(template, start, recording, k)
    at = problem.maximum()
    if at is None:
        reason = "the maximum of the exact likelihood was not reached; try fewer terms"
        return dataclasses.replace(start, converged=False, reason=reason), True
    estimates = estimates_of(template, active[None], *(x[None] for x in problem.inferred(at)))
    others = {label: c for label, c in start.coefficients.items() if c.term in problem.left_out}
    place = recording.n, recording.rate
    values, covariance = coefficients_of(template, start.axis, template, estimates, others, *place)
    model = fitted_model(template, values, absent(template, active))
    return dataclasses.replace(start, _coefficients=values, _covariance=covariance, _model=model), True


class _Place(NamedTuple):
    """Parameters, their likelihood, its score and information, the next step, and its expected gain."""

    theta: _Vector
    log_likelihood: float
    score: _Vector
    information: _Square
    step: _Vector
    gain: float

    def covariance(self, of: _Flags) -> _Square:
        """Covariance of these parameters if the others are known."""
        return np.linalg.pinv(self.information * np.outer(of, of), rcond=1e-14, hermitian=True)


class _Problem:
    """Samples and parameters: powers of all terms, each in its `unit`, and ln(shape − lower bound) if free.

    `moves` tells which are fitted; `left_out` are labels of absent terms with shapes, which are not.
    """

    def __init__(self, template: Model, found: AxisFit, recording: Recording, k: int) -> None:
        missing = None if recording.missing is None else recording.missing[:, k]
        self.template, self.data = template, (recording.values[:, k], recording.rate, missing)
        shapes, every = free_shapes(template), found.coefficients
        parameters = (*(p for p in template.parameters if p.parameter.is_amplitude), *shapes)
        value, terms = np.array([every[p.label].value for p in parameters]), len(template)
        limit = np.array([every[p.label].upper_limit or 0.0 for p in parameters])
        self.labels, self.is_power = [p.label for p in parameters], np.arange(len(value)) < terms
        self.left_out = {p.term_label for p in shapes if p.term < terms and not value[p.term] > 0.0}
        self.moves = np.array([p.free and p.term_label not in self.left_out for p in parameters])
        amplitude = np.where(value > 0.0, value, np.maximum(limit / 2.0, 1e-150))
        self.unit = np.where(self.is_power, amplitude**2, 1.0)
        self.origin, end = np.array([(p.parameter.lower, p.parameter.upper) for p in parameters]).T
        # The shape of an absent term does not matter.
        distance = np.where(np.isfinite(value) & ~self.is_power, value - self.origin, 1.0)
        self.start = np.where(self.is_power, value**2 / self.unit, np.log(distance))
        self.lower = np.where(self.is_power, 0.0, self.start - _REACH)
        highest = np.maximum(np.log(end - self.origin) - INSIDE, self.start)
        self.upper = np.where(self.is_power, np.inf, np.minimum(highest, self.start + _REACH))

    def innovations(self, thetas: Float[np.ndarray, "points p"]) -> tuple[np.ndarray, np.ndarray]:
        """Innovations [points, n − 1] under models with these parameters, and their variances."""
        shape = self.origin + np.exp(np.where(self.is_power, 0.0, thetas))
        rows = np.where(self.is_power, np.sqrt(np.maximum(thetas, _LEAST) * self.unit), shape).tolist()
        models = [self.template.with_values(**dict(zip(self.labels, row, strict=True))) for row in rows]
        return innovations_under(models, *self.data)

    def place(self, theta: _Vector) -> _Place:
        """Likelihood and its derivatives at these parameters."""
        from scipy.optimize import lsq_linear

        move = np.diag(_DIFFERENCE * np.where(self.is_power, np.maximum(theta, 1e-2), 1.0))[self.moves]
        # At zero power the difference is one-sided.
        up, down = theta + move, np.where(self.is_power, np.maximum(theta - move, 0.0), theta - move)
        e, s = self.innovations(np.concatenate([theta[None], up, down]))
        width = np.sum(up - down, axis=1)[:, None]
        of_e, of_s = ((x[1 : len(up) + 1] - x[len(up) + 1 :]) / width for x in (e, s))
        columns = np.concatenate([of_e / np.sqrt(s[0]), of_s / s[0] / np.sqrt(2.0)], axis=1).T
        target = np.concatenate([-e[0] / np.sqrt(s[0]), (e[0] ** 2 / s[0] - 1.0) / np.sqrt(2.0)])
        R = np.nan_to_num(np.linalg.qr(np.column_stack([columns, target]), mode="r"))
        m, b, A, step = self.moves, R[:, -1], np.zeros((len(R), len(theta))), np.zeros(len(theta))
        A[:, m] = R[:, :-1]
        longest = np.where(self.is_power, np.inf, _LONGEST)
        low, high = np.maximum(self.lower - theta, -longest), np.minimum(self.upper - theta, longest)
        # Fisher scoring within the bounds.
        step[m] = lsq_linear(A[:, m], b, (low[m], high[m] + 1e-12), "bvls").x
        gain = float(b @ A @ step - 0.5 * np.sum((A @ step) ** 2))
        log_likelihood = log_likelihoods(e[:1], s[:1])
        return _Place(theta, float(log_likelihood[0]), A.T @ b, A.T @ A, step, gain)

    def maximum(self) -> _Place | None:
        """Maximum of the likelihood, if it was reached."""
        at, share = self.place(self.start), 1.0
        for _ in range(_MOST_STEPS):
            if at.gain < _REACHED:
                return at if np.isfinite(at.log_likelihood) else None
            new = self.place(np.clip(at.theta + share * at.step, self.lower, self.upper))
            higher = new.log_likelihood >= at.log_likelihood - 1e-9
            at, share = (new, 1.0) if higher else (at, share / 3.0)
        return None

    def inferred(self, at: _Place) -> tuple[_Vector, _Vector, np.ndarray, np.ndarray]:
        """Powers, shapes, their covariance and the ends of the powers' intervals, as `estimates_of` wants."""
        terms, value = len(self.template), at.theta * self.unit
        inside = self.moves & (at.theta > self.lower) & (at.theta < self.upper)
        ends = np.full((terms, 5), np.nan)
        for k in np.flatnonzero(self.moves[:terms]).tolist():
            ends[k] = self._ends(at, k, inside)
        return value[:terms], value[terms:], at.covariance(inside) * np.outer(self.unit, self.unit), ends

    def _ends(self, at: _Place, k: int, inside: _Flags) -> Float[np.ndarray, " 5"]:
        """Ends of the intervals of a power, where the signed roots of the likelihood ratio have their levels.

        For an absent term the likelihood is modified to have its maximum at zero: its negative slope there is
        removed, so that the term's limit does not shrink.
        """
        covariance = at.covariance(inside | (np.arange(len(inside)) == k))
        sd, here = float(np.sqrt(covariance[k, k])), float(at.theta[k])
        below = np.linspace(max(here + _LOWEST * sd, 0.0), here, _BELOW)
        v = np.unique([*below, *(here + _ABOVE * sd)])
        least = np.where(self.is_power, 0.05 * at.theta, at.theta - _LONGEST)
        most = np.minimum(np.where(self.is_power, np.inf, at.theta + _LONGEST), self.upper)
        thetas = np.clip(at.theta + (v - here)[:, None] * covariance[k] / sd**2, least, most)
        thetas[:, k] = v
        ratio = np.maximum(2.0 * (at.log_likelihood - log_likelihoods(*self.innovations(thetas))), 0.0)
        slope = 0.0 if inside[k] else max(-float(at.score[k]), 0.0) * sd
        root = np.where(v == here, 0.0, np.sqrt(ratio + slope**2) - slope)
        both = np.stack([v * self.unit[k], root])[:, None]
        return ends_of((*both[..., v <= here][..., ::-1],), (*both[..., v >= here],), np.full(1, np.inf))[0]


# Axes per block: for so many, the data of the compiled programs stay in a core's cache.
_TOGETHER = 64
# Arrays are padded to a multiple of so many cluster sizes: at octaves, two programs serve all records.
_CAPACITY = 8


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class BulkFit(ByValue, Tabled):
    """The fit of one model to many axes: arrays [axes] or [axes, coefficients], in SI.

    Axes that did not converge have NaN for their coefficients and detect nothing.

    Attributes:
        template: the model whose terms were fitted.
        curve: the Allan deviations it was fitted to.
        value: the estimates; zero for the amplitude of a term that improves nothing.
        std: their standard deviations.
        lower, upper: ends of the 95 % intervals; the lower one is zero where zero is not excluded.
        upper_limit: one-sided 95 % limits of amplitudes; NaN for other coefficients.
        detected: whether zero is excluded.
        converged: whether the axis has a result.
        chi2, dof: misfit of the Allan variances to the model within their own scatter.
        discrepancy: as in `AxisFit`.
        measured: whether the coefficients are a measurement. They are not where the fitted curve is far off
            (see `AxisFit.misfit`): there is then no standard deviation, interval or limit.
    """

    template: Model
    curve: AllanDeviation
    value: Float[np.ndarray, "axes coefficients"]
    std: Float[np.ndarray, "axes coefficients"]
    lower: Float[np.ndarray, "axes coefficients"]
    upper: Float[np.ndarray, "axes coefficients"]
    upper_limit: Float[np.ndarray, "axes coefficients"]
    detected: Bool[np.ndarray, "axes coefficients"]
    converged: Bool[np.ndarray, " axes"]
    chi2: Float[np.ndarray, " axes"]
    dof: int
    discrepancy: Float[np.ndarray, " axes"]
    measured: Bool[np.ndarray, " axes"]

    @property
    def coefficients(self) -> tuple[str, ...]:
        """Labels of the coefficients, in the order of the arrays' columns."""
        return tuple(p.label for p in reported(self.template))

    @property
    def names(self) -> tuple[str, ...]:
        """The axes' names; their numbers where the curve is that of an array."""
        return self.curve.names

    def __len__(self) -> int:
        return len(self.value)

    def to_dataframe(self) -> pd.DataFrame:
        """One row per axis and coefficient, with the columns of `Fit.to_dataframe`.

        Numbers are in the usual units; for the curve of an array, whose sensor is unknown, in the array's own
        unit and seconds, with an empty `unit`.
        """
        import pandas as pd

        sensors = [a.sensor for a in self.curve.axes] if self.curve.axes else [None] * len(self)
        parameters = [p.parameter for p in reported(self.template)]
        usual = {s: [usual_unit(p, s) if s else "" for p in parameters] for s in set(sensors)}
        scales = {s: [unit_scale(u, s) if u else 1.0 for u in units] for s, units in usual.items()}
        unit, scale = np.array([usual[s] for s in sensors], object), np.array([scales[s] for s in sensors])
        columns: dict[str, Any] = {
            "axis": np.array(self.names, object)[:, None],
            "coefficient": np.array(self.coefficients, object),
            "value": self.value / scale,
            "std": self.std / scale,
            "lower_95": self.lower / scale,
            "upper_95": self.upper / scale,
            "unit": unit,
            "detected": self.detected,
            "upper_limit_95": self.upper_limit / scale,
            "measured": self.measured[:, None],
        }
        return pd.DataFrame({key: np.broadcast_to(x, unit.shape).ravel() for key, x in columns.items()})

    def _tables(self) -> list[list[Column]]:
        rows = []
        for (label, unit), of_label in self.to_dataframe().groupby(["coefficient", "unit"], sort=False):
            seen = of_label["value"][of_label["detected"]]
            ends = [significant(x, 4) for x in seen.quantile([0.05, 0.5, 0.95])] if len(seen) else [""] * 3
            rows.append([str(label), str(unit), *ends, f"{len(seen)} of {len(of_label)} axes"])
        return [columns_from(("coefficient", "unit", "5 %", "median", "95 %", "detected"), rows)]

    def _title(self) -> str:
        return (
            f"{len(self)} axes of {self.curve.n:,} samples at {self.curve.rate:g} Hz, "
            f"{np.count_nonzero(self.converged)} converged; values where detected"
        )


def fit_many(
    data: AllanDeviation | Sequence[Recording], model: ModelLike, *, cluster_times: Spacing = "octave"
) -> BulkFit:
    """Estimate the coefficients of one noise model for each of many axes, thousands per second.

    The result for an axis is that of `fit` with `objective="allan"` for the same Allan variances, by default
    at octaves of the cluster time: some 5 % less precise in the middle of the curve than `fit`, which has
    four cluster times per octave, and twenty times faster.

    Args:
        data: a curve of any number of axes, e.g. `allan_deviation(x, rate)` of an array [samples, units]; or
            recordings of equal length and rate, whose axes are then named "recording/axis".
        model: the terms, with start values and held parameters as in `fit`.
        cluster_times: spacing of the cluster times of recordings, see `allan_deviation`; a curve has its own.

    Raises:
        FitError: a line, resonance or transient, which needs the record itself; too few cluster times.
        AllanjaxError: no recordings, or of different lengths or rates; a modified or Hadamard curve.
    """
    curve = _curve_of(data, cluster_times)
    template, variance = model_to_fit(model, curve.axes or ()), curve.variance.T
    own = "is estimated from the record itself, not from Allan variances"
    check_terms(template, f"{own}; leave it out, or fit each recording with allanjax.fit")
    check_count(len(curve.cluster_size), "Allan variances", curve.n, template, "the curve")
    capacity = -(-len(curve.cluster_size) // _CAPACITY) * _CAPACITY
    design = AllanDesign.of(template, curve, (capacity, 0))
    blocks = for_each(
        lambda k: _of_block(template, design, variance[k : k + _TOGETHER]),
        range(0, len(variance), _TOGETHER),
    )
    arrays = {name: np.concatenate([block[name] for block in blocks]) for name in blocks[0]}
    dof = len(curve.cluster_size) - count_estimated(template, np.ones(len(template), bool))
    return BulkFit(template=template, curve=curve, dof=dof, **arrays)


def _of_block(template: Model, design: AllanDesign, variance: Float[np.ndarray, "axes m"]) -> dict[str, Any]:
    """Arrays of a `BulkFit` for at most `_TOGETHER` axes; a smaller block is filled up with its last axis."""
    count, active = len(variance), np.ones((_TOGETHER, len(template)), bool)
    V = np.pad(variance, ((0, _TOGETHER - count), (0, 0)), mode="edge")
    solution, found, misfits = solve_and_infer(template, design, V, active)
    converged = solution.converged
    measured = converged & [m is None or not m.excessive for m in misfits]
    lower, upper, _, _, limit = found.ends.transpose(2, 0, 1)
    known = {"std": found.std, "lower": lower, "upper": upper, "upper_limit": limit}
    arrays = {name: np.where(measured[:, None], x, np.nan) for name, x in known.items()} | {
        "value": np.where(converged[:, None], found.value, np.nan),
        "detected": found.detected & measured[:, None],
        "converged": converged,
        "chi2": solution.chi2,
        "discrepancy": solution.discrepancy,
        "measured": measured,
    }
    return {name: x[:count] for name, x in arrays.items()}


def _curve_of(data: AllanDeviation | Sequence[Recording], cluster_times: Spacing) -> AllanDeviation:
    """The Allan deviations of all axes."""
    if isinstance(data, AllanDeviation):
        if data.kind != "allan":
            raise AllanjaxError(f"a fit needs the Allan deviation, not a {data.kind} one; leave out kind")
        if not (isinstance(cluster_times, str) and cluster_times == "octave"):
            raise AllanjaxError("a curve has its own cluster times; leave out cluster_times")
        return data
    if isinstance(data, Recording) or not all(isinstance(r, Recording) for r in data) or not len(data):
        raise AllanjaxError("pass an AllanDeviation or a sequence of recordings, e.g. [recording]")
    names, curves = [recording.name or str(k) for k, recording in enumerate(data)], []
    for name, recording in zip(names, data, strict=True):
        if (recording.n, recording.rate) != (data[0].n, data[0].rate):
            raise AllanjaxError(
                f"{name} has {recording.n} samples at {recording.rate:g} Hz, but {names[0]} {data[0].n} at "
                f"{data[0].rate:g} Hz; cut them to one length with between(), or fit it separately"
            )
        axes = [dataclasses.replace(axis, name=f"{name}/{axis.name}") for axis in recording.axes]
        alone = dataclasses.replace(recording, axes=tuple(axes), others=())
        curves.append(allan_deviation(alone, cluster_times=cluster_times))
    deviation, edf = (np.hstack([getattr(curve, name) for curve in curves]) for name in ("deviation", "edf"))
    every = tuple(axis for curve in curves for axis in curve.axes or ())
    return dataclasses.replace(curves[0], deviation=deviation, edf=edf, axes=every)

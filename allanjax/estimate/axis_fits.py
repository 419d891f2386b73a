"""Fits of single axes to Allan or wavelet variances, their verdict by the spectrum, and the fitted curve."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import jax
import numpy as np
from jaxtyping import ArrayLike, Bool, Float, Shaped

from allanjax.allan.covariance import AllanCovariance
from allanjax.allan.deviation import AllanDeviation
from allanjax.base.chi_squared import beyond_doubt, upper_tail
from allanjax.base.errors import FitError
from allanjax.estimate.design import (
    AllanDesign,
    Starts,
    Tangent,
    find_starts,
    free_powers,
    free_shapes,
    moments_behind,
    quadrature_order,
)
from allanjax.estimate.deterministic import lines_of, needs_record, take_out_lines
from allanjax.estimate.gls import Solution, solve
from allanjax.estimate.inference import (
    Inference,
    coefficients_of,
    deterministic_coefficients,
    infer,
)
from allanjax.estimate.result import AxisFit, Misfit, misfit_of, widened
from allanjax.estimate.spectral.components import columns_of
from allanjax.estimate.spectral.fit import chi_squared
from allanjax.estimate.whittle import axis_fit, estimated, fit_whittle, spectrum_of, with_misfit
from allanjax.noise.model import Model
from allanjax.noise.terms.deterministic import Transient
from allanjax.record.recording import Axis, Recording
from allanjax.wavelets.variance import WaveletFilter, geometry_of, mean_squares

# Cluster sizes and terms to which a fit's arrays are padded: with four per octave, sizes of 6·10⁷ samples.
ALLAN_CAPACITY = (96, 6)
# Difference of minus twice the log-likelihood below which two solutions are the same.
_AS_LIKELY = 0.02
# Expectation and variance of estimates of power.
_Moments = tuple[Float[np.ndarray, " m"], Float[np.ndarray, " m"]]


def fit_allan(
    curve: AllanDeviation,
    axes: Sequence[Axis],
    template: Model,
    active: Bool[np.ndarray, "axes terms"],
    values: Float[np.ndarray, "n axes"] | None = None,
) -> tuple[tuple[AxisFit, ...], AllanDeviation]:
    """Fit every axis by generalized least squares; the curve gets its degrees of freedom under the fit.

    Args:
        curve: the Allan variances.
        axes: its axes.
        template: the model.
        active: the terms that each axis has.
        values: the record, which is needed to find lines and resonances.
    """
    design = AllanDesign.of(template, curve.n, curve.rate, curve.cluster_size, curve.strides, ALLAN_CAPACITY)
    place = curve.n, curve.rate
    results = _fit_estimates(design, curve.variance, place, axes, template, active, values)
    return results, _with_model_edf(curve, results, _moments_under(curve, template, results))


def fit_wavelet(
    recording: Recording, template: Model, active: Bool[np.ndarray, "axes terms"], wavelet: str
) -> tuple[AxisFit, ...]:
    """Fit every axis of a recording by generalized least squares of its wavelet variances.

    Raises:
        FitError: a term that these variances do not determine, or too few levels.
    """
    found, place = WaveletFilter.of(wavelet), (recording.n, recording.rate)
    for term in template.terms:
        if term.deterministic or term.narrow_band:
            raise FitError(
                f"the {wavelet} wavelet variances do not determine {term.name()}; leave it out, or use "
                'wavelet="haar"'
            )
    levels = np.arange(1, found.most_levels(recording.n) + 1)
    check_count(len(levels), "wavelet variances", recording.n, template, recording.name)
    design = AllanDesign.of_geometry(
        template, recording.rate, geometry_of(found, levels, *place), ALLAN_CAPACITY[1]
    )
    variance = np.stack([mean_squares(x, found, len(levels)) for x in recording.values.T], axis=1)
    return _fit_estimates(design, variance, place, recording.axes, template, active, None)


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
    place: tuple[int, float],
    axes: Sequence[Axis],
    template: Model,
    active: Bool[np.ndarray, "axes terms"],
    values: Float[np.ndarray, "n axes"] | None,
) -> tuple[AxisFit, ...]:
    """Fits of every axis to its estimates; see `fit_allan`.

    `place`: number of samples and their rate [Hz].
    """
    records = [None] * len(axes) if values is None else values.T
    # The record determines a line far better than its Allan variances do, which start from this line.
    indices, wanted = lines_of(template)
    free = free_powers(template) & ~np.isin(np.arange(len(template)), indices)
    results = []
    for k, (axis, x) in enumerate(zip(axes, records, strict=True)):
        here, variance = active[[k]], variances[:, [k]].T
        starts = find_starts(template, design, variance, here, [x], *place)
        lines = {}
        if wanted and x is not None:
            lines = dict(zip(indices, take_out_lines(x - x.mean(), place[1], wanted)[1], strict=True))
        for i, line in lines.items():
            if template.terms[i].has_free_amplitude:
                starts.power[:, :, i] = line.amplitude**2
            starts.shape[:, :, [p.term == i for p in free_shapes(template)]] = np.log(line.frequency)
        solution, inference, (misfit,) = solve_and_infer(design, variance, free, here, starts)
        (coefficients,) = coefficients_of(template, [axis], here, solution, inference, *place)
        for i, line in lines.items():
            square = (line.amplitude / line.amplitude_std) ** 2
            of_square = (square, line.amplitude_std, 2, line, place[0])
            coefficients = coefficients.with_values(deterministic_coefficients(template, i, axis, *of_square))
        dof = len(variances) - estimated(template, active[k])
        solution = jax.tree.map(lambda x: x[0], solution)
        result = axis_fit(axis, template, active[k], coefficients, solution, dof, misfit)
        # With one or two degrees of freedom, as at the longest cluster times, the χ² tail is not valid.
        results.append(dataclasses.replace(result, p_value=np.nan))
    return tuple(results)


def solve_and_infer(
    design: AllanDesign,
    variance: Float[np.ndarray, "axes m"],
    free: Bool[np.ndarray, " terms"],
    active: Bool[np.ndarray, "axes terms"],
    starts: Starts,
) -> tuple[Solution, Inference, list[Misfit | None]]:
    """Best solution of each axis over its starts, the inference around it, and its misfit."""
    powers, shapes = starts.power.swapaxes(0, 1), starts.shape.swapaxes(0, 1)
    solution = solve(design, variance, free, active, powers[0], shapes[0])
    # The cost may have several minima in a correlation time: all starts are tried.
    for power, shape in zip(powers[1:], shapes[1:], strict=True):
        doubtful = np.asarray(~solution.converged | design.has_shapes)
        if not doubtful.any():
            break
        other = solve(design, variance, free, active, power, shape)
        better = other.converged & ~(other.cost >= solution.cost - _AS_LIKELY) | ~solution.converged
        solution = _choose(doubtful & better, other, solution)
    tangent = design.tangent(np.asarray(solution.shape))
    misfits = _misfits(tangent, design.geometry.cluster_time, variance, solution)
    solution = widened(solution, misfits)
    return solution, infer(tangent, variance, free, active, solution), misfits


def _misfits(
    tangent: Tangent,
    cluster_time: Float[np.ndarray, " capacity"],
    variance: Float[np.ndarray, "axes m"],
    solution: Solution,
) -> list[Misfit | None]:
    """Misfit of each axis's curve; None where the model suffices."""
    found: list[Misfit | None] = [None] * len(variance)
    for k in np.flatnonzero(np.asarray(solution.converged) & (np.asarray(solution.power_error) > 0.0)):
        own, power = tangent.of_axes(np.array([k])), np.asarray(solution.power)[None, [k]]
        mean, scatter = (power @ own.means)[0, 0], own.variances(power)[0, 0]
        ratio = np.sqrt(variance[k] / mean)
        found[k] = misfit_of(cluster_time[: len(mean)], ratio, 2.0 * mean**2 / scatter, "s")
    return found


def _choose(rows: Bool[np.ndarray, " axes"], new: Solution, old: Solution) -> Solution:
    """New solution for these axes, old one for the others."""

    def of(new: ArrayLike, old: ArrayLike) -> Shaped[np.ndarray, "axes ..."]:
        return np.where(rows.reshape(-1, *[1] * (np.ndim(new) - 1)), new, old)

    return jax.tree.map(of, new, old)


def judged(
    recording: Recording, k: int, template: Model, active: Bool[np.ndarray, " terms"], result: AxisFit
) -> AxisFit:
    """Fit of an axis's variances with the verdict of its spectrum, or Whittle's fit where the two disagree.

    The law of the levels is known at all frequencies, but that of variances at long cluster times is not.
    """
    random = np.array([not term.deterministic for term in template.terms])
    sufficient = result.converged and result.discrepancy == 0.0
    if sufficient:
        spectrum = spectrum_of(template, recording.values[:, k], recording.rate)
        noise = [term for term in result.model.sampled(recording.rate).terms if not term.deterministic]
        power = [getattr(term, term.amplitude_parameter().name) ** 2 for term in noise]
        mean = np.array(power) @ columns_of(noise, spectrum.bins).mean(axis=1)
        projection = spectrum.project(mean, spectrum.used(np.flatnonzero(~active).tolist()))
        chi2 = chi_squared(projection.level / mean, projection.dof)
        dof = round(projection.estimates) - estimated(template, active & random)
        if chi2 <= beyond_doubt(dof):
            return _with_verdict(result, chi2, dof)
    other = fit_whittle(recording, k, template, active)
    # A doubtful spectrum does not overrule variances that refuse the model.
    if result.converged and not sufficient and (other.discrepancy > 0.0 or other.doubtful):
        return _with_verdict(result, other.chi2, other.dof)
    return other if other.converged else result


def _with_verdict(result: AxisFit, chi2: float, dof: int) -> AxisFit:
    return dataclasses.replace(result, chi2=chi2, dof=dof, p_value=float(upper_tail(chi2, dof)))


def with_curve(
    curve: AllanDeviation, template: Model, results: Sequence[AxisFit]
) -> tuple[tuple[AxisFit, ...], AllanDeviation]:
    """Fits of spectra with the misfit of the Allan deviations, and the curve with its degrees of freedom."""
    moments = _moments_under(curve, template, results)
    curve = _with_model_edf(curve, results, moments)
    # Effects that are projected out of the spectrum are still in the Allan deviations.
    profiled = any(isinstance(term, Transient) for term in template.terms)
    found = []
    for k, (result, (mean, _)) in enumerate(zip(results, moments, strict=True)):
        if result.converged and result.spectrum is not None and not (profiled or result.regression):
            ratio = curve.deviation[:, k] / np.sqrt(mean)
            misfit = misfit_of(curve.cluster_time, ratio, curve.edf[:, k], "s")
            # The misfit of a fitted spectrum is that of its levels, unless that of the Allan deviations is
            # excessive.
            if result.misfit is not None and result.measured and misfit.excessive:
                result = with_misfit(result, misfit)
            else:
                result = dataclasses.replace(result, allan_misfit=misfit.beside(result.misfit))
        found.append(result)
    return tuple(found), curve


def _with_model_edf(
    curve: AllanDeviation, results: Sequence[AxisFit], moments: Sequence[_Moments]
) -> AllanDeviation:
    """Curve with degrees of freedom 2μ²/Var under the fitted models."""
    edf = np.array(curve.edf)
    for k, (result, (mean, variance)) in enumerate(zip(results, moments, strict=True)):
        if result.converged:
            edf[:, k] = 2.0 * mean**2 / variance * curve.gain
    return dataclasses.replace(curve, edf=edf)


def _moments_under(curve: AllanDeviation, template: Model, results: Sequence[AxisFit]) -> list[_Moments]:
    """Moments of the Allan variances of each axis under its fitted model."""
    of_curve, order = (curve.n, curve.rate, curve.cluster_size), quadrature_order(template)
    geometry = AllanCovariance.of(*of_curve, order, curve.strides)
    nothing = np.full(len(curve.cluster_size), np.nan)
    return [
        moments_behind(_with_all_terms(template, result).sampled(curve.rate), geometry)
        if result.converged
        else (nothing, nothing)
        for result in results
    ]


def _with_all_terms(template: Model, result: AxisFit) -> Model:
    """The fitted model; absent terms are included with an amplitude of zero and an arbitrary shape."""
    values = {}
    for p in template.parameters:
        value = result[p.label].value if p.label in result.coefficients else p.start
        absent = 0.0 if p.parameter.is_amplitude else p.parameter.lower + 1.0
        values[p.label] = absent if value is None or np.isnan(value) else float(value)
    return template.with_values(**values)

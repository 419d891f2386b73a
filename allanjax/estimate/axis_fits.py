"""Fits of single axes: from Allan variances or a spectrum to coefficients, misfit and model."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Shaped

from allanjax.allan.deviation import AllanDeviation
from allanjax.base.chi_squared import upper_tail
from allanjax.estimate.coefficients import Coefficients, coefficients_of, deterministic_coefficients, reported
from allanjax.estimate.design import AllanDesign
from allanjax.estimate.deterministic import lines_of, take_out_lines
from allanjax.estimate.gls import Solution, solve
from allanjax.estimate.inference import Inference, infer
from allanjax.estimate.misfit import Misfit, misfit_of, widened
from allanjax.estimate.result import AxisFit, fitted_model
from allanjax.estimate.starts import Starts, find_starts
from allanjax.estimate.whittle import WhittleFit, fit_axis
from allanjax.noise.model import Model
from allanjax.noise.terms.transient import Transient
from allanjax.record.recording import Axis, Recording


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
        values: the record, without which lines and resonances cannot be found.
    """
    design = AllanDesign.of(template, curve.n, curve.rate, curve.cluster_size, curve.strides)
    variance = curve.variance.T
    records = [None] * len(axes) if values is None else values.T
    starts = find_starts(design, variance, active, records, curve.n, curve.rate)
    free = design.free
    # The record determines a line far better than its Allan variances do, which start from this line.
    indices, wanted = lines_of(template)
    lines = [
        {}
        if x is None
        else dict(zip(indices, take_out_lines(x - x.mean(), curve.rate, wanted)[1], strict=True))
        for x in records
    ]
    for k, of_axis in enumerate(lines):
        for i, line in of_axis.items():
            if free[i]:
                starts.power[k, :, i] = line.amplitude**2
            for column, p in enumerate(design.shapes):
                if p.term == i:
                    starts.shape[k, :, column] = np.log(line.frequency)
    free = free & ~np.isin(np.arange(len(template)), indices)
    solution, inference, misfits = solve_and_infer(design, variance, free, active, starts)
    results = []
    found = coefficients_of(template, axes, active, solution, inference, curve.n, curve.rate)
    for k, (axis, coefficients) in enumerate(zip(axes, found, strict=True)):
        for i, line in lines[k].items():
            square = (line.amplitude / line.amplitude_std) ** 2
            of_line = (square, line.amplitude_std, 2, line, curve.n)
            coefficients = coefficients.with_values(deterministic_coefficients(template, i, axis, *of_line))
        dof = len(curve.cluster_size) - estimated(template, active[k])
        of_axis = jax.tree.map(lambda x, k=k: x[k], solution)
        result = _axis_fit(axis, template, active[k], coefficients, of_axis, dof)
        results.append(with_misfit(result, misfits[k]))
    return tuple(results), _with_model_edf(curve, design, results, np.asarray(inference.estimate_variance))


def solve_and_infer(
    design: AllanDesign,
    variance: Float[np.ndarray, "axes m"],
    free: Bool[np.ndarray, " terms"],
    active: Bool[np.ndarray, "axes terms"],
    starts: Starts,
) -> tuple[Solution, Inference, list[Misfit | None]]:
    """Best solution from the starts of each axis, the inference around it, and its misfit."""
    solution = solve(design, variance, free, active, starts.power[:, 0], starts.shape[:, 0])
    # The cost may have several minima in a correlation time: all starts are tried.
    for k in range(1, starts.power.shape[1]):
        doubtful = ~np.asarray(solution.converged) | design.movable.any()
        if not doubtful.any():
            break
        other = solve(design, variance, free, active, starts.power[:, k], starts.shape[:, k])
        better = np.asarray(other.converged & ~(other.cost >= solution.cost) | ~solution.converged)
        solution = _choose(doubtful & better, other, solution)
    misfits = _misfits(design, variance, solution)
    solution = widened(solution, misfits)
    inference = infer(design, variance, free, active, solution)
    return *jax.device_get((solution, inference)), misfits


def _misfits(
    design: AllanDesign, variance: Float[np.ndarray, "axes m"], solution: Solution
) -> list[Misfit | None]:
    """Misfit of each axis's curve; None where the model suffices."""
    found: list[Misfit | None] = [None] * len(variance)
    incomplete = np.flatnonzero(np.asarray(solution.converged) & (np.asarray(solution.power_error) > 0.0))
    if len(incomplete):
        place = (solution.power, solution.shape)
        mean, scatter = (np.asarray(of(design, *place)) for of in (_means, _variances))
    for k in incomplete:
        found[k] = misfit_of(
            np.asarray(design.geometry.cluster_time),
            np.sqrt(variance[k] / mean[k]),
            2.0 * mean[k] ** 2 / scatter[k],
            "s",
        )
    return found


def fit_whittle(
    recording: Recording,
    k: int,
    template: Model,
    active: Bool[np.ndarray, " terms"],
    regressors: Mapping[str, Float[np.ndarray, " n"]],
) -> AxisFit:
    """Fit one axis of a recording by maximum likelihood of its cosine spectrum."""
    axis = recording.axes[k]
    found = fit_axis(template, axis, recording.values[:, k], recording.rate, active, regressors)
    return result_of(found, template, axis, active)


def result_of(found: WhittleFit, template: Model, axis: Axis, active: Bool[np.ndarray, " terms"]) -> AxisFit:
    """Result of one axis from its fit by Whittle's likelihood."""
    random = np.array([not term.deterministic for term in template.terms])
    dof = round(found.estimates) - estimated(template, active & random)
    result = _axis_fit(axis, template, active, found.coefficients, found.solution, dof)
    result = dataclasses.replace(result, regression=found.regression, spectrum=found.spectrum)
    return with_misfit(result, found.misfit)


def with_misfit(result: AxisFit, misfit: Misfit | None) -> AxisFit:
    """Result with its misfit, if any; if that is excessive, coefficients lose intervals and limits."""
    if misfit is None or not result.converged:
        return result
    if not misfit.excessive:
        return dataclasses.replace(result, misfit=misfit)
    return result.unmeasured(misfit=misfit)


def _choose(rows: Bool[np.ndarray, " axes"], new: Solution, old: Solution) -> Solution:
    """New solution for these axes, old one for the others."""

    def of(new: ArrayLike, old: ArrayLike) -> Shaped[np.ndarray, "axes ..."]:
        return np.where(rows.reshape(-1, *[1] * (np.ndim(new) - 1)), new, old)

    return jax.tree.map(of, new, old)


def estimated(template: Model, active: Bool[np.ndarray, " terms"]) -> int:
    """Number of coefficients that are estimated, by which the degrees of freedom of χ² are reduced."""
    return sum(p.free and bool(active[p.term]) for p in reported(template))


def _axis_fit(
    axis: Axis,
    template: Model,
    active: Bool[np.ndarray, " terms"],
    coefficients: Coefficients,
    solution: Solution,
    dof: int,
) -> AxisFit:
    """Result of one axis from its solution and coefficients."""
    inactive = [label for label, here in zip(template.term_labels, active, strict=True) if not here]
    return AxisFit(
        axis=axis,
        converged=bool(solution.converged),
        reason="" if solution.converged else "the fit did not converge; try fewer terms or other starts",
        chi2=float(solution.chi2),
        dof=dof,
        p_value=float(upper_tail(solution.chi2, dof)),
        discrepancy=float(solution.discrepancy),
        _coefficients=coefficients.values,
        _covariance=coefficients.covariance,
        _model=fitted_model(template, coefficients.values, inactive),
    )


def with_curve(
    curve: AllanDeviation, template: Model, results: Sequence[AxisFit]
) -> tuple[tuple[AxisFit, ...], AllanDeviation]:
    """Fits of spectra with the misfit of the Allan deviations, and the curve with its degrees of freedom."""
    design = AllanDesign.of(template, curve.n, curve.rate, curve.cluster_size, curve.strides)
    place = _parameters(design, results)
    curve = _with_model_edf(curve, design, results, np.asarray(_variances(design, *place)))
    mean = np.asarray(_means(design, *place))
    # Effects that are projected out of the spectrum are still in the Allan deviations.
    profiled = any(isinstance(term, Transient) for term in template.terms)
    found = []
    for k, result in enumerate(results):
        misfit = None
        if result.misfit is not None and result.measured and not (profiled or result.regression):
            ratio = curve.deviation[:, k] / np.sqrt(mean[k])
            misfit = misfit_of(curve.cluster_time, ratio, curve.edf[:, k], "s")
        # The misfit of a fitted spectrum is that of its levels, unless that of the Allan deviations is
        # excessive.
        found.append(with_misfit(result, misfit) if misfit is not None and misfit.excessive else result)
    return tuple(found), curve


def _with_model_edf(
    curve: AllanDeviation,
    design: AllanDesign,
    results: Sequence[AxisFit],
    variance: Float[np.ndarray, "axes m"],
) -> AllanDeviation:
    """Curve with degrees of freedom 2μ²/Var under the fitted models."""
    mean = np.asarray(_means(design, *_parameters(design, results)))
    edf = np.array(curve.edf)
    for k, result in enumerate(results):
        if result.converged:
            edf[:, k] = 2.0 * mean[k] ** 2 / variance[k]
    return dataclasses.replace(curve, edf=edf)


def _parameters(
    design: AllanDesign, results: Sequence[AxisFit]
) -> tuple[Float[np.ndarray, "axes terms"], Float[np.ndarray, "axes shapes"]]:
    """Powers and transformed shapes of the fitted models; zero for axes without a fit."""
    power = np.zeros((len(results), len(design.model)))
    shape = np.zeros((len(results), len(design.shapes)))
    amplitudes = [p for p in design.model.parameters if p.parameter.is_amplitude]
    for k, result in enumerate(results):
        if result.converged:
            values = {label: c.value for label, c in result.coefficients.items()}
            power[k] = [float(values.get(p.label, p.start) or 0.0) ** 2 for p in amplitudes]
            shape[k] = [np.log(values[p.label] - p.parameter.lower) for p in design.shapes]
    # The shape of an absent term does not matter.
    return power, np.nan_to_num(shape)


@eqx.filter_jit
def _means(
    design: AllanDesign, power: Float[ArrayLike, "axes terms"], shape: Float[ArrayLike, "axes shapes"]
) -> Float[Array, "axes m"]:
    """Expected Allan variances of every axis."""
    return jax.vmap(lambda v, u: v @ design.means(u))(jnp.asarray(power), jnp.asarray(shape))


@eqx.filter_jit
def _variances(
    design: AllanDesign, power: Float[ArrayLike, "axes terms"], shape: Float[ArrayLike, "axes shapes"]
) -> Float[Array, "axes m"]:
    """Variances of the Allan variance estimates of every axis."""

    def of_axis(power: Array, shape: Array) -> Array:
        return design.variances(design.covariance(power, design.products(shape)))

    return jax.vmap(of_axis)(jnp.asarray(power), jnp.asarray(shape))

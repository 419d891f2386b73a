"""Fit a noise model to a recording, by its Allan variances or by Whittle's likelihood."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Num

from allanjax.allan import AllanDeviation, allan_deviation
from allanjax.coefficients import Coefficients, coefficients_of, deterministic_coefficients, reported
from allanjax.design import AllanDesign
from allanjax.deterministic import lines_of, take_out_lines
from allanjax.errors import AllanjaxError, FitError
from allanjax.gls import Solution, solve
from allanjax.inference import HYPOTHESES, infer
from allanjax.model import Model
from allanjax.recording import Axis, Recording
from allanjax.result import AxisFit, Fit
from allanjax.selection import TermSelection, basic_terms, select_terms
from allanjax.starts import find_starts
from allanjax.terms import Markov, NoiseTerm
from allanjax.terms.transient import Transient
from allanjax.whittle import fit_axis

# Denser cluster times than octaves gain some 5 % in the middle of the curve; beyond four an octave, nothing.
_PER_OCTAVE = 4

Objective = Literal["allan", "whittle"]


def fit(
    recording: Recording,
    model: Model | NoiseTerm | None = None,
    objective: Objective = "allan",
    *,
    regressors: Sequence[str] = (),
) -> Fit:
    """Estimate the coefficients of a noise model from every axis of a recording.

    `objective="allan"`: the overlapping Allan variances at four cluster times an octave are fitted by
    generalized least squares, weighted with their full covariance at the fitted model itself (see `gls`).
    `objective="whittle"`: maximum likelihood of the cosine spectrum (see `cosine`), which uses all that
    the record knows of its spectrum: more efficient where terms are alike in the Allan curve, and for
    lines by far. Ramps, lines and regressors are profiled out exactly.

    Args:
        recording: what `read` returns, or `Recording.from_array`.
        model: the terms, added up with `+`; parameters with a value start there, those held stay there. The
            time of a step and the time constant of a warm-up must have a value and are held; such terms
            need "whittle".
            Without one, the terms are those that `select_terms` chooses for each axis among the five basic
            ones and a Markov process; for the basic terms not chosen there is an upper limit.
        objective: "allan" or "whittle".
        regressors: names of auxiliary channels (temperature, say) whose multiples may be part of the rate;
            with "whittle" only.

    Returns:
        The fit. Axes that did not converge say so, and raise FitError when asked for coefficients.

    Raises:
        FitError: if the record is too short for the model; a step or warm-up without a time, or with "allan".
        AllanjaxError: an unknown objective; a regressor that is no auxiliary channel, or is constant.
    """
    if objective not in ("allan", "whittle"):
        raise AllanjaxError(f'the objective must be "allan" or "whittle", not {objective!r}')
    given = _regressors(recording, regressors, objective)
    selection = None
    if model is None:
        selection = select_terms(recording)
        sets = [axis.chosen.terms for axis in selection]
        # A Markov process is part of the template where it is needed only: it costs time.
        template = basic_terms() + Markov() if any("markov" in s for s in sets) else basic_terms()
        active = np.array([[label in s for label in template.term_labels] for s in sets])
    else:
        template = _with_known_transients(Model(()) + model, objective)
        active = np.ones((len(recording.axes), len(template)), bool)
    curve = allan_deviation(recording, cluster_times=_PER_OCTAVE)
    free_count = sum(p.free for p in template.parameters)
    if len(curve.cluster_size) <= free_count:
        raise FitError(
            f"{recording.name or 'the recording'}: {recording.n} samples give "
            f"{len(curve.cluster_size)} Allan variances, too few for {free_count} parameters; "
            "record longer or use fewer terms"
        )
    if objective == "allan":
        results, variance = _fit_allan(recording, template, curve, active)
        curve = _with_model_edf(curve, results, variance)
    else:
        axes = range(len(recording.axes))
        results = tuple(_fit_whittle(recording, k, template, active[k], given) for k in axes)
        curve = _with_model_edf(curve, results, _variances_under(template, curve, results))
    return Fit(
        recording.name,
        template,
        curve,
        results,
        recording.notes + _ambiguities(selection),
        objective,
        selection,
    )


def _with_known_transients(template: Model, objective: Objective) -> Model:
    """The model with the shapes of its steps and warm-ups held: a record is not searched for them."""
    terms = list(template.terms)
    for k, term in enumerate(template.terms):
        if not isinstance(term, Transient):
            continue
        if objective == "allan":
            raise FitError(f'{term.name()} has no Allan variance of its own: give objective="whittle"')
        shapes = [p.name for p in term.parameters()[1:]]
        for shape in shapes:
            if getattr(term, shape) is None:
                raise FitError(
                    f"a fit does not search for the {shape} of a {term.name()}: give it, e.g. "
                    f'{type(term).__name__}({shape}=120.0).hold("{shape}"); the critique finds it'
                )
        terms[k] = term.hold(*shapes)
    return Model(tuple(terms))


def _regressors(
    recording: Recording, names: Sequence[str], objective: Objective
) -> dict[str, Float[np.ndarray, " n"]]:
    """The auxiliary channels of these names, without their means."""
    if names and objective != "whittle":
        raise AllanjaxError('regressors are profiled out of the spectrum only: give objective="whittle"')
    channels = {}
    for name in names:
        if name not in recording.auxiliary:
            there = ", ".join(recording.auxiliary) or "none"
            raise AllanjaxError(
                f"{recording.name or 'the recording'} has no auxiliary channel {name!r}; it has {there}"
            )
        channel = np.asarray(recording.auxiliary[name], float)
        channels[name] = channel - channel.mean()
        if not np.isfinite(channel).all() or not channels[name].any():
            raise AllanjaxError(
                f"auxiliary channel {name!r} is constant or not finite: nothing to regress on"
            )
    return channels


def _ambiguities(selection: TermSelection | None) -> tuple[str, ...]:
    """For people: which terms the data could not tell apart."""
    notes = []
    for axis in selection or ():
        if found := axis.ambiguities():
            notes.append(f"{axis.axis.name}: the data do not tell {'; '.join(found[:3])}")
    return tuple(notes)


def _fit_allan(
    recording: Recording, template: Model, curve: AllanDeviation, active: Bool[np.ndarray, "axes terms"]
) -> tuple[tuple[AxisFit, ...], Float[np.ndarray, "axes m"]]:
    """Every axis by generalized least squares, and the variances of its Allan variances under the fit."""
    design = AllanDesign.of(template, recording.n, recording.rate, curve.cluster_size)
    variance = curve.variance.T
    starts = find_starts(design, variance, active, recording.values, recording.rate)
    free = np.array([term.is_free(term.parameters()[0]) for term in template.terms])
    # A line is seen in the record far better than in its Allan variances, which get to know of it.
    indices, wanted = lines_of(template)
    lines = [
        dict(zip(indices, take_out_lines(x - x.mean(), recording.rate, wanted)[1], strict=True))
        for x in recording.values.T
    ]
    for k, of_axis in enumerate(lines):
        for i, line in of_axis.items():
            if free[i]:
                starts.power[k, :, i] = line.amplitude**2
            for column, p in enumerate(design.shapes):
                if p.term == i:
                    starts.shape[k, :, column] = np.log(line.frequency)
    free = free & ~np.isin(np.arange(len(template)), indices)
    solution = solve(design, variance, free, active, starts.power[:, 0], starts.shape[:, 0])
    # A correlation time has several places to settle: all starts are tried.
    for k in range(1, starts.power.shape[1]):
        doubtful = ~np.asarray(solution.converged) | design.movable.any()
        if not doubtful.any():
            break
        other = solve(design, variance, free, active, starts.power[:, k], starts.shape[:, k])
        better = np.asarray(other.converged & ~(other.cost >= solution.cost) | ~solution.converged)
        solution = _choose(doubtful & better, other, solution)
    inference = infer(design, variance, free, active, solution, np.asarray(HYPOTHESES))
    solution, inference = jax.device_get((solution, inference))
    results = []
    for k, axis in enumerate(recording.axes):
        of_axis = jax.tree.map(lambda x, k=k: x[k], (solution, inference))
        coefficients = coefficients_of(template, axis, active[k], *of_axis)
        for i, line in lines[k].items():
            square = (line.amplitude / line.amplitude_std) ** 2
            of_line = (square, line.amplitude_std, 2, line, recording.n)
            coefficients = coefficients.with_values(deterministic_coefficients(template, i, axis, *of_line))
        dof = len(curve.cluster_size) - _estimated(template, active[k])
        results.append(_axis_fit(axis, template, active[k], coefficients, of_axis[0], dof))
    return tuple(results), inference.estimate_variance


def _fit_whittle(
    recording: Recording,
    k: int,
    template: Model,
    active: Bool[np.ndarray, " terms"],
    regressors: Mapping[str, Float[np.ndarray, " n"]],
) -> AxisFit:
    """One axis by maximum likelihood."""
    axis = recording.axes[k]
    found = fit_axis(template, axis, recording.values[:, k], recording.rate, active, regressors)
    random = np.array([not term.deterministic for term in template.terms])
    dof = round(found.estimates) - _estimated(template, active & random)
    result = _axis_fit(axis, template, active, found.coefficients, found.solution, dof)
    return dataclasses.replace(result, regression=found.regression, spectrum=found.spectrum)


def _choose(rows: Bool[np.ndarray, " axes"], new: Solution, old: Solution) -> Solution:
    """The new solution for these axes, the old one for the others."""

    def of(new: ArrayLike, old: ArrayLike) -> Num[np.ndarray, "axes ..."]:
        return np.where(rows.reshape(-1, *[1] * (np.ndim(new) - 1)), new, old)

    return jax.tree.map(of, new, old)


def _estimated(template: Model, active: Bool[np.ndarray, " terms"]) -> int:
    return sum(p.free and bool(active[p.term]) for p in reported(template))


def _axis_fit(
    axis: Axis,
    template: Model,
    active: Bool[np.ndarray, " terms"],
    coefficients: Coefficients,
    solution: Solution,
    dof: int,
) -> AxisFit:
    """What a solution and its coefficients mean for one axis."""
    from scipy.stats import chi2

    values = {label: c.value for label, c in coefficients.values.items() if np.isfinite(c.value)}
    amplitudes = [values.get(p.label, 0.0) for p in reported(template) if p.parameter.kind == "amplitude"]
    absent = np.array(template.term_labels)[~active | (np.array(amplitudes) == 0.0)]
    return AxisFit(
        axis=axis,
        converged=bool(solution.converged),
        reason="" if solution.converged else "the fit did not converge; try fewer terms or other starts",
        chi2=float(solution.chi2),
        dof=dof,
        p_value=float(chi2.sf(solution.chi2, dof)),
        discrepancy=float(solution.discrepancy) / 2.0,
        _coefficients=coefficients.values,
        _covariance=coefficients.covariance,
        _model=template.with_values(**values).without(list(absent)),
    )


def _with_model_edf(
    curve: AllanDeviation, results: tuple[AxisFit, ...], variance: Float[np.ndarray, "axes m"]
) -> AllanDeviation:
    """The curve with degrees of freedom 2μ²/Var under the fitted models."""
    edf = np.array(curve.edf)
    for k, result in enumerate(results):
        if result.converged:
            mean = np.asarray(result.model.sampled(curve.rate).allan_variance(curve.cluster_time))
            edf[:, k] = 2.0 * mean**2 / variance[k]
    return dataclasses.replace(curve, edf=edf)


def _variances_under(
    template: Model, curve: AllanDeviation, results: tuple[AxisFit, ...]
) -> Float[np.ndarray, "axes m"]:
    """Variances of the Allan variances, where the fit has not looked at them."""
    design = AllanDesign.of(template, curve.n, curve.rate, curve.cluster_size)
    power = np.zeros((len(results), len(template)))
    shape = np.zeros((len(results), len(design.shapes)))
    for k, result in enumerate(results):
        if result.converged:
            values = {label: c.value for label, c in result.coefficients.items()}
            amplitudes = [p for p in template.parameters if p.parameter.kind == "amplitude"]
            power[k] = [float(values.get(p.label, p.start) or 0.0) ** 2 for p in amplitudes]
            shape[k] = [np.log(values[p.label] - p.parameter.lower) for p in design.shapes]
    # The shape of an absent term does not matter.
    return np.asarray(_variances(design, power, np.nan_to_num(shape)))


@eqx.filter_jit
def _variances(
    design: AllanDesign, power: Float[ArrayLike, "axes terms"], shape: Float[ArrayLike, "axes shapes"]
) -> Float[Array, "axes m"]:
    def of_axis(power: Array, shape: Array) -> Array:
        return design.variances(design.covariance(power, design.products(shape)))

    return jax.vmap(of_axis)(jnp.asarray(power), jnp.asarray(shape))

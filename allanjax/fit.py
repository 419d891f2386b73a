"""Fit a noise model to the Allan variance of a recording."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable

import jax
import numpy as np
from jaxtyping import ArrayLike, Bool, Float, Num

from allanjax.allan import AllanDeviation, allan_deviation
from allanjax.design import Design
from allanjax.errors import FitError
from allanjax.gls import Solution, solve
from allanjax.inference import ESTIMATE, HYPOTHESES, Inference, infer
from allanjax.model import Model
from allanjax.recording import Axis, Recording
from allanjax.result import AxisFit, Coefficient, Fit
from allanjax.starts import find_starts
from allanjax.terms import (
    AngleRandomWalk,
    BiasInstability,
    DriftRamp,
    NoiseTerm,
    Quantization,
    RateRandomWalk,
)

# Denser cluster times than octaves gain some 5 % in the middle of the curve; beyond four an octave, nothing.
_PER_OCTAVE = 4
# A term belongs to the reduced model if zero is rejected at this many standard deviations (one-sided 0.13 %:
# there are five to choose from).
_DETECTION = 3.0
# A term is needed if the discrepancy grows by this factor without it (from nothing, if there was none).
_SPOILT = 1.2
# One term is exchanged for another if that lowers minus twice the log-likelihood by more than this.
_BETTER = 4.0
_TWO_SIDED_95 = 1.960
_ONE_SIDED_95 = 1.645


def basic_terms() -> Model:
    """The thesis's five basic terms: quantization, random walk, bias instability, rate random walk, ramp."""
    return Quantization() + AngleRandomWalk() + BiasInstability() + RateRandomWalk() + DriftRamp()


def fit(recording: Recording, model: Model | NoiseTerm | None = None) -> Fit:
    """Estimate the coefficients of a noise model from every axis of a recording.

    The overlapping Allan variances at four cluster times an octave are fitted by generalized least squares,
    weighted with their full covariance at the fitted model itself (Design note: `gls`), all axes at once.

    Args:
        recording: what `read` returns, or `Recording.from_array`.
        model: the terms, added up with `+`; parameters with a value start there, those held stay there.
            Without one, the thesis's five basic terms, reduced for each axis to those that the data support;
            for the others there is an upper limit.

    Returns:
        The fit. Axes that did not converge say so, and raise FitError when asked for coefficients.

    Raises:
        FitError: if the record is too short for the model.
    """
    template = basic_terms() if model is None else Model(()) + model
    curve = allan_deviation(recording, cluster_times=_PER_OCTAVE)
    free_count = sum(p.free for p in template.parameters)
    if len(curve.cluster_size) <= free_count:
        raise FitError(
            f"{recording.name or 'the recording'}: {recording.n} samples give "
            f"{len(curve.cluster_size)} Allan variances, too few for {free_count} parameters; "
            "record longer or use fewer terms"
        )
    design = Design.of(template, recording.n, recording.rate, curve.cluster_size)
    variance = curve.variance.T
    starts = find_starts(design, variance, recording.values, recording.rate)
    free = np.array([term.is_free(term.parameters()[0]) for term in template.terms])
    active = np.ones((len(recording.axes), len(template)), bool)

    def attempt(active: Bool[np.ndarray, "axes terms"]) -> Solution:
        solution = solve(design, variance, free, active, starts.power[:, 0], starts.shape[:, 0])
        for k in range(1, starts.power.shape[1]):
            doubtful = ~np.asarray(solution.converged) | np.asarray(solution.discrepancy > 0.0)
            if not doubtful.any():
                break
            other = solve(design, variance, free, active, starts.power[:, k], starts.shape[:, k])
            better = np.asarray(other.converged & ~(other.cost >= solution.cost) | ~solution.converged)
            solution = _choose(doubtful & better, other, solution)
        return solution

    def at_zero(
        active: Bool[np.ndarray, "axes terms"], solution: Solution
    ) -> Float[np.ndarray, "axes terms"]:
        return np.asarray(infer(design, variance, free, active, solution, np.asarray(1)).pivot_at)[:, :, 0]

    solution = attempt(active)
    if model is None:
        active, solution = _reduce(attempt, at_zero, active, solution)
    inference = infer(design, variance, free, active, solution, np.asarray(HYPOTHESES))
    solution, inference = jax.device_get((solution, inference))
    results = tuple(
        _axis_fit(axis, template, curve, active[k], *jax.tree.map(lambda x, k=k: x[k], (solution, inference)))
        for k, axis in enumerate(recording.axes)
    )
    curve = _with_model_edf(curve, results, inference)
    return Fit(recording.name, template, curve, results, recording.notes)


def _choose(rows: Bool[np.ndarray, " axes"], new: Solution, old: Solution) -> Solution:
    """The new solution for these axes, the old one for the others."""

    def of(new: ArrayLike, old: ArrayLike) -> Num[np.ndarray, "axes ..."]:
        return np.where(rows.reshape(-1, *[1] * (np.ndim(new) - 1)), new, old)

    return jax.tree.map(of, new, old)


def _reduce(
    attempt: Callable[[Bool[np.ndarray, "axes terms"]], Solution],
    at_zero: Callable[[Bool[np.ndarray, "axes terms"], Solution], Float[np.ndarray, "axes terms"]],
    active: Bool[np.ndarray, "axes terms"],
    solution: Solution,
) -> tuple[Bool[np.ndarray, "axes terms"], Solution]:
    """Reduce the terms to those that the data support, for every axis.

    Terms without power go, then the least significant one, as long as zero is not rejected and the rest
    still fits: a term without which the model's curve is further off is kept for good. Where the rest fits
    badly, each exchange of a term for a neighbour in slope is tried.
    """
    needed = np.zeros_like(active)
    while True:
        state = zip(active, needed, np.asarray(solution.power), at_zero(active, solution), strict=True)
        reduced = np.array([_drop(*of_axis) for of_axis in state])
        if np.array_equal(reduced, active):
            break
        new = attempt(reduced)
        spoilt = np.asarray((new.discrepancy > _SPOILT * solution.discrepancy) | ~new.converged)
        needed |= spoilt[:, None] & active & ~reduced
        active = np.where(spoilt[:, None], active, reduced)
        solution = _choose(~spoilt, new, solution)

    terms = active.shape[1]
    exchanges = [(i, j) for i, j in itertools.permutations(range(terms), 2) if abs(i - j) <= 2]
    for out, into in exchanges:
        bad = np.asarray(solution.discrepancy) > 0.0
        possible = bad & active[:, out] & ~active[:, into]
        if possible.any():
            exchanged = active.copy()
            exchanged[possible, out], exchanged[possible, into] = False, True
            new = attempt(exchanged)
            closer = (new.cost < solution.cost - _BETTER) & (new.discrepancy <= solution.discrepancy)
            better = np.asarray(new.converged & closer) & possible
            active = np.where(better[:, None], exchanged, active)
            solution = _choose(better, new, solution)
    return active, solution


def _drop(
    active: Bool[np.ndarray, " terms"],
    needed: Bool[np.ndarray, " terms"],
    power: Float[np.ndarray, " terms"],
    at_zero: Float[np.ndarray, " terms"],
) -> Bool[np.ndarray, " terms"]:
    """The terms of one axis without those that have no power, or without the least significant one."""
    dispensable = active & ~needed
    empty = dispensable & (power == 0.0)
    if empty.any():
        return active & ~empty
    weakest = np.argmin(np.where(dispensable, at_zero, np.inf))
    if dispensable[weakest] and at_zero[weakest] < _DETECTION and active.sum() > 1:
        return active & (np.arange(len(active)) != weakest)
    return active


def _axis_fit(
    axis: Axis,
    template: Model,
    curve: AllanDeviation,
    active: Bool[np.ndarray, " terms"],
    solution: Solution,
    inference: Inference,
) -> AxisFit:
    """What a solution and its inference mean for one axis."""
    from scipy.stats import chi2

    # Parameters that are infinite, or held without ever having had a value, are no coefficients.
    parameters = [p for p in template.parameters if p.free or (p.start is not None and np.isfinite(p.start))]
    shapes = [p for p in parameters if p.free and p.parameter.kind != "amplitude"]
    covariance = np.asarray(inference.covariance)
    coefficients: dict[str, Coefficient] = {}
    found: dict[int, bool] = {}
    jacobian = np.zeros((len(parameters), len(covariance)))
    for row, p in enumerate(parameters):
        is_amplitude = p.parameter.kind == "amplitude"
        column = p.term if is_amplitude else len(template) + (shapes.index(p) if p.free else 0)
        limit = None
        if not p.free:
            value = float(p.start or 0.0)
            interval, std = (value, value), 0.0
            found.setdefault(p.term, True)
        elif is_amplitude:
            value = float(np.sqrt(solution.power[p.term]))
            lower, upper, limit = np.sqrt(
                [
                    _crossing(inference.power_at[p.term], inference.pivot_at[p.term], level, value > 0.0)
                    for level in (_TWO_SIDED_95, -_TWO_SIDED_95, -_ONE_SIDED_95)
                ]
            )
            interval = (float(lower), float(upper))
            found[p.term] = bool(active[p.term] and lower > 0.0)
            jacobian[row, column] = 0.5 / value if value > 0.0 else 0.0
            std = float(jacobian[row, column] * np.sqrt(covariance[column, column]))
        else:
            distance = np.exp(solution.shape[column - len(template)])
            sd = np.sqrt(covariance[column, column])
            ratio = np.exp(min(_TWO_SIDED_95 * sd, 700.0))
            value = float(p.parameter.lower + distance)
            interval = (
                float(p.parameter.lower + distance / ratio),
                float(p.parameter.lower + distance * ratio),
            )
            jacobian[row, column] = distance
            std = float(distance * sd)
        coefficients[p.label] = Coefficient(
            label=p.label,
            term=p.term_label,
            parameter=p.parameter,
            axis=axis,
            value=value,
            std=std,
            interval=interval,
            upper_limit=None if limit is None else float(limit),
            detected=found[p.term],
            held=not p.free,
        )
    estimated = {p.label for p in parameters if p.free and active[p.term]}
    dof = len(curve.cluster_size) - len(estimated)
    absent = np.array(template.term_labels)[~active | (solution.power == 0.0)]
    values = {label: c.value for label, c in coefficients.items() if np.isfinite(c.value)}
    return AxisFit(
        axis=axis,
        converged=bool(solution.converged),
        reason="" if solution.converged else "the fit did not converge; try fewer terms or other starts",
        chi2=float(solution.chi2),
        dof=dof,
        p_value=float(chi2.sf(solution.chi2, dof)),
        discrepancy=float(solution.discrepancy) / 2.0,
        _coefficients=coefficients,
        _covariance=jacobian @ covariance @ jacobian.T,
        _model=template.with_values(**values).without(list(absent)),
    )


def _crossing(
    power: Float[ArrayLike, " grid"], pivot: Float[ArrayLike, " grid"], level: float, present: bool
) -> float:
    """The hypothetical power at which the data are `level` standard deviations away.

    Positive levels are sought below the estimate (zero if none is reached), negative ones above (infinity).
    """
    power, pivot = np.asarray(power), np.asarray(pivot)
    # Without this term the others may leave no noise at all: such a hypothesis is out of the question.
    side = np.where(np.arange(len(power)) < ESTIMATE, np.inf, -np.inf)
    pivot = np.where(np.isfinite(pivot), pivot, side)
    # Where others' powers ended at zero the data may still pull at this one. It is taken as if they were
    # content with the estimate; so is an absent term of which they would like less than nothing, lest its
    # limit shrink.
    at_estimate = pivot[ESTIMATE] if np.isfinite(pivot[ESTIMATE]) else 0.0
    pivot = pivot - (at_estimate if present else min(at_estimate, 0.0))
    beyond = pivot >= level if level > 0.0 else pivot <= level
    below, above = np.flatnonzero(beyond[:ESTIMATE]), ESTIMATE + np.flatnonzero(beyond[ESTIMATE:])
    if level > 0.0:
        if not below.size:
            return 0.0
        g, inside = below[-1], below[-1] + 1
    else:
        if not above.size:
            return float("inf")
        g, inside = above[0], max(above[0] - 1, ESTIMATE)
    if pivot[g] == pivot[inside] or not np.isfinite(pivot[g]):
        return float(power[inside])
    share = (level - pivot[inside]) / (pivot[g] - pivot[inside])
    return float(power[inside] + share * (power[g] - power[inside]))


def _with_model_edf(
    curve: AllanDeviation, results: tuple[AxisFit, ...], inference: Inference
) -> AllanDeviation:
    """The curve with degrees of freedom 2μ²/Var under the fitted models."""
    edf = np.array(curve.edf)
    for k, result in enumerate(results):
        if result.converged:
            mean = np.asarray(result.model.sampled(curve.rate).allan_variance(curve.cluster_time))
            edf[:, k] = 2.0 * mean**2 / np.diag(inference.estimate_covariance[k])
    return dataclasses.replace(curve, edf=edf)

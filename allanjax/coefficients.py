"""From a solution and its inference to named coefficients with their intervals."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import numpy as np
from jaxtyping import ArrayLike, Bool, Float

from allanjax.deterministic import Line, amplitude_quantile
from allanjax.gls import Solution
from allanjax.inference import ESTIMATE, Inference
from allanjax.model import Model, ModelParameter
from allanjax.recording import Axis
from allanjax.result import Coefficient
from allanjax.terms import Parameter

# Normal quantiles of two-sided 68 and 95 % intervals, and of one-sided 95 % limits.
TWO_SIDED_68 = 0.9945
TWO_SIDED_95 = 1.960
ONE_SIDED_95 = 1.645
# A line searched for is detected if noise would not have its like anywhere in the record, once in so many.
_FALSE_LINE = 1.35e-3


@dataclasses.dataclass(frozen=True, eq=False)
class Coefficients:
    """The coefficients of one axis by label, and their covariance [SI] in the same order."""

    values: Mapping[str, Coefficient]
    covariance: Float[np.ndarray, "params params"]

    def with_values(self, values: Mapping[str, Coefficient]) -> Coefficients:
        """A copy with these coefficients, uncorrelated with the others."""
        new = {**self.values, **values}
        covariance = self.covariance.copy()
        for k, label in enumerate(new):
            if label in values:
                covariance[k, :] = covariance[:, k] = 0.0
                covariance[k, k] = values[label].std ** 2
        return Coefficients(new, covariance)


def reported(model: Model) -> tuple[ModelParameter, ...]:
    """The parameters that are coefficients: infinite ones are none, nor those held without a value."""
    return tuple(p for p in model.parameters if p.free or (p.start is not None and np.isfinite(p.start)))


def coefficients_of(
    model: Model, axis: Axis, active: Bool[np.ndarray, " terms"], solution: Solution, inference: Inference
) -> Coefficients:
    """The coefficients of one axis from its solution; terms not active have upper limits only."""
    parameters = reported(model)
    shapes = [p for p in parameters if p.free and p.parameter.kind != "amplitude"]
    covariance = np.asarray(inference.covariance)
    values: dict[str, Coefficient] = {}
    jacobian = np.zeros((len(parameters), len(covariance)))
    has_power = active & (np.asarray(solution.power) > 0.0)
    found = has_power.copy()
    for row, p in enumerate(parameters):
        limit = None
        is_amplitude = p.parameter.kind == "amplitude"
        column = p.term if is_amplitude else len(model) + shapes.index(p) if p.free else None
        if column is None or not p.free:
            value, std = float(p.start or 0.0), 0.0
            interval = interval_68 = (value, value)
            found[p.term] |= is_amplitude
        elif not is_amplitude and not has_power[p.term]:
            value = std = float("nan")
            interval = interval_68 = (p.parameter.lower, p.parameter.upper)
        elif is_amplitude:
            power = float(solution.power[p.term])
            value = np.sqrt(power)
            levels = (TWO_SIDED_95, -TWO_SIDED_95, TWO_SIDED_68, -TWO_SIDED_68, -ONE_SIDED_95)
            grid = (inference.power_at[p.term], inference.pivot_at[p.term])
            ends = [float(np.sqrt(_crossing(*grid, level, power > 0.0))) for level in levels]
            interval, interval_68, limit = (ends[0], ends[1]), (ends[2], ends[3]), ends[4]
            found[p.term] = bool(active[p.term] and interval[0] > 0.0)
            jacobian[row, column] = 0.5 / value if value > 0.0 else 0.0
            std = float(jacobian[row, column] * np.sqrt(covariance[column, column]))
        else:
            distance = float(np.exp(solution.shape[column - len(model)]))
            sd = float(np.sqrt(covariance[column, column]))
            value = p.parameter.lower + distance
            interval, interval_68 = (
                _around(p.parameter, distance, level * sd) for level in (TWO_SIDED_95, TWO_SIDED_68)
            )
            jacobian[row, column] = distance
            std = distance * sd
        values[p.label] = Coefficient(
            label=p.label,
            term=p.term_label,
            parameter=p.parameter,
            axis=axis,
            value=float(value),
            std=std,
            interval=interval,
            interval_68=interval_68,
            upper_limit=limit,
            detected=bool(found[p.term]),
            held=not p.free,
        )
    return Coefficients(values, jacobian @ covariance @ jacobian.T)


def deterministic_coefficients(
    model: Model,
    term: int,
    axis: Axis,
    square: float,
    unit: float,
    components: int,
    line: Line | None,
    n: int,
    active: bool = True,
) -> dict[str, Coefficient]:
    """The coefficients of a ramp or a line, by the noncentral χ² law of the square of its estimate.

    Args:
        model: the model, and `term` the index of the ramp or line in it.
        axis: whose it is.
        square: squared estimate in units of its variance.
        unit: standard deviation of each component, SI.
        components: 1 of a ramp or a step, 2 of a line.
        line: where the line was found.
        n: samples of the record: a line that was searched for competes with n/2 frequencies without one.
        active: whether the term is in the model.
    """
    from scipy.stats import norm

    searched = line is not None and line.frequency_std > 0.0
    chance = np.exp(-square / 2.0) * n if searched else 0.0
    found: dict[str, Coefficient] = {}
    for p in reported(model):
        if p.term != term:
            continue
        limit = None
        if not p.free:
            value, std = float(p.start or 0.0), 0.0
            interval = interval_68 = (value, value)
            detected = True
        elif p.parameter.kind == "amplitude":
            levels = np.array([TWO_SIDED_95, -TWO_SIDED_95, TWO_SIDED_68, -TWO_SIDED_68, -ONE_SIDED_95, 0.0])
            ends = [unit * amplitude_quantile(square, components, float(level)) for level in norm.cdf(levels)]
            interval, interval_68, limit = (ends[0], ends[1]), (ends[2], ends[3]), ends[4]
            value = ends[5] if active else 0.0
            detected = active and interval[0] > 0.0 and chance < _FALSE_LINE
            std = unit if value > 0.0 else 0.0
        else:
            assert line is not None
            value, std = line.frequency, line.frequency_std
            interval, interval_68 = ((value - z * std, value + z * std) for z in (TWO_SIDED_95, TWO_SIDED_68))
            detected = next(iter(found.values())).detected
        found[p.label] = Coefficient(
            label=p.label,
            term=p.term_label,
            parameter=p.parameter,
            axis=axis,
            value=value,
            std=std,
            interval=interval,
            interval_68=interval_68,
            upper_limit=limit,
            detected=detected,
            held=not p.free,
        )
    return found


def _around(p: Parameter, distance: float, width: float) -> tuple[float, float]:
    """Interval of a parameter whose distance from its lower bound is known to this width in ln."""
    ratio = np.exp(min(width, 700.0))
    return float(p.lower + distance / ratio), float(min(p.lower + distance * ratio, p.upper))


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

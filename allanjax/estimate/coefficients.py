"""Named coefficients and their intervals, from a solution and its inference."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Bool, Float

from allanjax.base.normal import ONE_SIDED_95, TWO_SIDED_68, TWO_SIDED_95
from allanjax.estimate.design import of_owners
from allanjax.estimate.deterministic import Line, amplitude_quantile
from allanjax.estimate.gls import Solution
from allanjax.estimate.inference import ABOVE, ESTIMATE, Inference
from allanjax.noise.estimate import Estimate
from allanjax.noise.model import Model, ModelParameter
from allanjax.noise.terms import Parameter
from allanjax.record.recording import Axis

# Nearer to a bound than this share of what is between two of them a shape is at it.
_INSIDE = 0.0125
# A limit so many times as far from a bound as the estimate is none.
_NOWHERE = 1e4
# A line searched for is detected if noise would not have its like anywhere in the record, once in so many.
_FALSE_LINE = 1.35e-3


@dataclasses.dataclass(frozen=True, eq=False)
class Coefficients:
    """The coefficients of one axis by label, and their covariance [SI] in the same order."""

    values: Mapping[str, Estimate]
    covariance: Float[np.ndarray, "params params"]

    def with_values(self, values: Mapping[str, Estimate]) -> Coefficients:
        """A copy with these coefficients, uncorrelated with the others."""
        new = {**self.values, **values}
        covariance = self.covariance.copy()
        for k, label in enumerate(new):
            if label in values:
                covariance[k, :] = covariance[:, k] = 0.0
                covariance[k, k] = values[label].std ** 2
        return Coefficients(new, covariance)


def reported(model: Model) -> tuple[ModelParameter, ...]:
    """Parameters of a model that are coefficients: not infinite ones, nor held ones without a value."""
    return tuple(p for p in model.parameters if p.free or (p.start is not None and np.isfinite(p.start)))


@dataclasses.dataclass(frozen=True, eq=False)
class Estimates:
    """The coefficients of several axes in SI, [axes, coefficients] in the order of `reported`.

    Attributes:
        value, std: estimates and their standard deviations; NaN for the shape of an absent term.
        interval, interval_68: [axes, coefficients, 2] ends of the 95 and 68 % intervals.
        upper_limit: one-sided 95 % limits of amplitudes; NaN for what has none.
        detected: whether the term's amplitude excludes zero.
        covariance: [axes, coefficients, coefficients].
    """

    value: Float[np.ndarray, "axes params"]
    std: Float[np.ndarray, "axes params"]
    interval: Float[np.ndarray, "axes params 2"]
    interval_68: Float[np.ndarray, "axes params 2"]
    upper_limit: Float[np.ndarray, "axes params"]
    detected: Bool[np.ndarray, "axes params"]
    covariance: Float[np.ndarray, "axes params params"]


def estimates_of(
    model: Model, active: Bool[np.ndarray, "axes terms"], solution: Solution, inference: Inference
) -> Estimates:
    """The coefficients of every axis from its solution; terms not active have upper limits only.

    Args:
        model: the model.
        active: the terms that each axis has.
        solution, inference: what `gls.solve` and `infer` return, of as many axes.
    """
    parameters = reported(model)
    shapes = [p for p in parameters if p.free and not p.parameter.is_amplitude]
    power, shape = np.asarray(solution.power), np.asarray(solution.shape)
    covariance = np.asarray(inference.covariance)
    power_at, pivot_at = np.asarray(inference.power_at), np.asarray(inference.pivot_at)
    ceiling = np.asarray(inference.ceiling)
    count = (len(power), len(parameters))
    value, std, limit = np.zeros(count), np.zeros(count), np.full(count, np.nan)
    interval, interval_68 = np.zeros((*count, 2)), np.zeros((*count, 2))
    detected = np.zeros(count, bool)
    jacobian = np.zeros((*count, covariance.shape[-1]))
    has_power = active & (power > 0.0)
    found = has_power.copy()
    for row, p in enumerate(parameters):
        is_amplitude = p.parameter.is_amplitude
        if not p.free:
            value[:, row] = p.start or 0.0
            interval[:, row] = interval_68[:, row] = value[:, row, None]
            if is_amplitude:
                found[:, p.term] = True
        elif is_amplitude:
            column = p.term
            value[:, row] = np.sqrt(power[:, column])
            present = power[:, column] > 0.0
            levels = (TWO_SIDED_95, -TWO_SIDED_95, TWO_SIDED_68, -TWO_SIDED_68, -ONE_SIDED_95)
            at = (power_at[:, column], pivot_at[:, column], ceiling[:, column])
            ends = np.stack([np.sqrt(_crossings(*at, level, present)) for level in levels], axis=1)
            interval[:, row], interval_68[:, row], limit[:, row] = ends[:, :2], ends[:, 2:4], ends[:, 4]
            found[:, column] = active[:, column] & (ends[:, 0] > 0.0)
            jacobian[:, row, column] = np.divide(
                0.5, value[:, row], out=np.zeros(len(power)), where=value[:, row] > 0.0
            )
            std[:, row] = jacobian[:, row, column] * np.sqrt(covariance[:, column, column])
        else:
            column = len(model) + shapes.index(p)
            distance, sd = np.exp(shape[:, column - len(model)]), np.sqrt(covariance[:, column, column])
            present = of_owners(model, has_power)[:, p.term]
            value[:, row] = np.where(present, p.parameter.lower + distance, np.nan)
            std[:, row] = np.where(present, distance * sd, np.nan)
            jacobian[:, row, column] = np.where(present, distance, 0.0)
            nowhere = np.array([p.parameter.lower, p.parameter.upper])
            interval[:, row], interval_68[:, row] = (
                np.where(present[:, None], _around(p.parameter, distance, level * sd), nowhere)
                for level in (TWO_SIDED_95, TWO_SIDED_68)
            )
        # The response comes after all terms.
        detected[:, row] = of_owners(model, found)[:, p.term]
    covariance = jacobian @ covariance @ jacobian.transpose(0, 2, 1)
    return Estimates(value, std, interval, interval_68, limit, detected, covariance)


def coefficients_of(
    model: Model,
    axes: Sequence[Axis],
    active: Bool[np.ndarray, "axes terms"],
    solution: Solution,
    inference: Inference,
    n: int,
    rate: float,
) -> tuple[Coefficients, ...]:
    """Coefficients of several axes by their labels, from `estimates_of`.

    Shapes that may be anywhere beyond what n samples at `rate` [Hz] can show have a limit, and no error.
    """
    estimates = estimates_of(model, active, solution, inference)
    found: list[dict[str, Estimate]] = [{} for _ in axes]
    for row, p in enumerate(reported(model)):
        limited = p.free and p.parameter.is_amplitude
        for k, axis in enumerate(axes):
            c = Estimate(
                label=p.label,
                term=p.term_label,
                parameter=p.parameter,
                axis=axis,
                value=float(estimates.value[k, row]),
                std=float(estimates.std[k, row]),
                interval=_pair(estimates.interval[k, row]),
                interval_68=_pair(estimates.interval_68[k, row]),
                upper_limit=float(estimates.upper_limit[k, row]) if limited else None,
                detected=bool(estimates.detected[k, row]),
                held=not p.free,
            )
            found[k][p.label] = c if limited or c.held else _within(c, p.parameter, n, rate)
    return tuple(map(Coefficients, found, estimates.covariance))


def _within(c: Estimate, p: Parameter, n: int, rate: float) -> Estimate:
    """Estimate of a shape, turned into a limit where its interval reaches beyond what the record can show."""
    if not (c.detected and c.std > 0.0):
        return c
    # Bounds are open, and searches keep a little away from them.
    inside = _INSIDE * (p.upper - p.lower) if np.isfinite(p.upper) else 0.0
    low, high = {"time": (2.0 / rate, n / rate), "number": (p.lower + inside, p.upper - inside)}.get(
        p.kind, (rate / n, rate / 2.0)
    )
    below, above = c.interval[0] <= low, c.interval[1] >= high
    if not (below or above):
        return c
    distance = c.value - p.lower
    ratio = float(np.exp(min(ONE_SIDED_95 * c.std / distance, 700.0)))
    # At a bound itself the data say nothing of the logarithm of the distance from it.
    below, above = (True, True) if ratio > _NOWHERE else (below, above)
    ends = (p.lower if below else c.interval[0], p.upper if above else c.interval[1])
    ends_68 = (p.lower if below else c.interval_68[0], p.upper if above else c.interval_68[1])
    return dataclasses.replace(
        c,
        std=float("nan"),
        interval=ends,
        interval_68=ends_68,
        lower_limit=p.lower + distance / ratio if above and not below else None,
        upper_limit=p.lower + distance * ratio if below and not above else None,
    )


def _pair(ends: Float[np.ndarray, " 2"]) -> tuple[float, float]:
    return float(ends[0]), float(ends[1])


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
) -> dict[str, Estimate]:
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
    from scipy.special import ndtr

    searched = line is not None and line.frequency_std > 0.0
    chance = np.exp(-square / 2.0) * n if searched else 0.0
    found: dict[str, Estimate] = {}
    for p in reported(model):
        if p.term != term:
            continue
        limit = None
        if not p.free:
            value, std = float(p.start or 0.0), 0.0
            interval = interval_68 = (value, value)
            detected = True
        elif p.parameter.is_amplitude:
            levels = np.array([TWO_SIDED_95, -TWO_SIDED_95, TWO_SIDED_68, -TWO_SIDED_68, -ONE_SIDED_95, 0.0])
            ends = [unit * amplitude_quantile(square, components, float(level)) for level in ndtr(levels)]
            interval, interval_68, limit = (ends[0], ends[1]), (ends[2], ends[3]), ends[4]
            value = ends[5] if active else 0.0
            detected = bool(active and interval[0] > 0.0 and chance < _FALSE_LINE)
            std = unit if value > 0.0 else 0.0
        else:
            assert line is not None
            value, std = line.frequency, line.frequency_std
            interval, interval_68 = ((value - z * std, value + z * std) for z in (TWO_SIDED_95, TWO_SIDED_68))
            detected = next(iter(found.values())).detected
        found[p.label] = Estimate(
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


def _around(
    p: Parameter, distance: Float[np.ndarray, " axes"], width: Float[np.ndarray, " axes"]
) -> Float[np.ndarray, "axes 2"]:
    """Intervals of a parameter whose distance from its lower bound is known to this width in ln."""
    # Beyond this they are anywhere.
    ratio = np.exp(np.minimum(width, 300.0))
    return np.stack([p.lower + distance / ratio, np.minimum(p.lower + distance * ratio, p.upper)], axis=1)


def _crossings(
    power: Float[np.ndarray, "axes grid"],
    pivot: Float[np.ndarray, "axes grid"],
    ceiling: Float[np.ndarray, " axes"],
    level: float,
    present: Bool[np.ndarray, " axes"],
) -> Float[np.ndarray, " axes"]:
    """The hypothetical powers at which the data are `level` standard deviations away.

    Positive levels are sought below the estimate (zero if none is reached), negative ones above (the ceiling,
    where a large model error lets the data refuse none of them).
    """
    below = level > 0.0
    side = slice(ESTIMATE, None, -1) if below else slice(ABOVE, None)
    power, pivot = power[:, side], pivot[:, side]
    # Without this term the others may leave no noise at all: such a hypothesis is out of the question.
    pivot = np.where(np.isfinite(pivot), pivot, np.inf if below else np.nan)
    # Where others' powers ended at zero the data may still pull at this one. It is taken as if they were
    # content with the estimate; so is an absent term of which they would like less than nothing, lest its
    # limit shrink.
    at_estimate = np.where(np.isfinite(pivot[:, 0]), pivot[:, 0], 0.0)
    pivot = pivot - np.where(present, at_estimate, np.minimum(at_estimate, 0.0))[:, None]
    # The nearest hypothesis beyond the level, and its neighbour on the estimate's side.
    beyond = pivot >= level if below else pivot <= level
    outer = np.argmax(beyond, axis=1)
    inner = np.maximum(outer - 1, 0)
    axis = np.arange(len(power))
    (from_, to), (near, far) = ((x[axis, inner], x[axis, outer]) for x in (power, pivot))
    between = np.isfinite(far) & (far != near)
    with np.errstate(invalid="ignore"):  # NaN where there is no distance at the estimate itself
        share = np.divide(level - near, far - near, out=np.zeros(len(power)), where=between)
    nowhere = np.zeros(len(power)) if below else np.maximum(ceiling, power[:, 0])
    return np.where(beyond.any(axis=1), from_ + share * (to - from_), nowhere)

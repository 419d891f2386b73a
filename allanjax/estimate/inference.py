"""Inference from a solution: covariance, tests of hypothetical powers, and coefficients with intervals."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Bool, Float, Int

from allanjax.base.chi_squared import cube_root_score
from allanjax.base.normal import ONE_SIDED_95, TWO_SIDED_68, TWO_SIDED_95
from allanjax.estimate.design import Solution, Tangent, free_powers, of_owners
from allanjax.estimate.deterministic import Line, amplitude_quantiles
from allanjax.noise.estimate import Estimate
from allanjax.noise.model import Model, ModelParameter
from allanjax.noise.terms import AngleRandomWalk, Quantization
from allanjax.record.recording import Axis

# Ends of intervals and the one-sided limit, in standard deviations below the value.
_LEVELS = np.array([TWO_SIDED_95, -TWO_SIDED_95, TWO_SIDED_68, -TWO_SIDED_68, -ONE_SIDED_95])
# A shape is at a bound if it is closer than this share of the distance between its bounds.
_MARGIN = 0.0125
# A limit that is so many times as far from a bound as the estimate is not reported.
_NOWHERE = 1e4
# A line at an unknown frequency is detected if noise has a line as strong in at most one of so many records.
_FALSE_LINE = 1.35e-3
# Hypothetical powers below and above the estimate, in standard deviations; the last below is zero power. If
# the scatter grows with the power, as for few long clusters, limits may be far above.
_ABOVE = np.array([0.0, 0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 4.0, 6.0, 10.0, *10.0 * 2.0 ** np.arange(1, 31)])
_BELOW = np.full(len(_ABOVE), -np.inf)
_BELOW[:11] = [0.0, -0.5, -1.0, -1.5, -2.0, -2.5, -3.0, -4.0, -5.0, -6.0, -8.0]
# No interval ends beyond this score.
_FAR_ENOUGH = 2.0
# Probability that a ceiling is too low.
_CHANCE = 0.025
_PerAxis: TypeAlias = Float[np.ndarray, " axes"]
_Curves: TypeAlias = Float[np.ndarray, "axes m"]
_Terms: TypeAlias = Float[np.ndarray, "axes terms"]
_Grid: TypeAlias = Float[np.ndarray, "axes grid"]
_Ends: TypeAlias = Float[np.ndarray, "axes 5"]
_Flags: TypeAlias = Bool[np.ndarray, "axes _"]
_Index: TypeAlias = Int[np.ndarray, " axes"]
_Columns: TypeAlias = Float[np.ndarray, "axes m k"]
_PerColumn: TypeAlias = Float[np.ndarray, "axes k"]
_Square: TypeAlias = Float[np.ndarray, "axes k k"]


@np.errstate(all="ignore")
def infer(model: Model, tangent: Tangent, V: _Curves, active: _Flags, solution: Solution) -> Estimates:
    """The coefficients of every axis, with intervals of each power by tests of hypothetical powers.

    Hypotheses lead from the estimate down to v = 0, and up, until the data exclude one. The distance of the
    data is the score statistic: the mean, covariance and derivatives at the hypothesis (the other powers
    fitted anew), so that it is right at the boundary v = 0 as well as where the scatter grows with v. It
    exists for inactive terms too, whose upper limits it gives.
    """
    power, owner = solution.power, tangent.owner
    has_shape = active[:, owner] & (power[:, owner] > 0.0)
    free = np.broadcast_to(free_powers(model), active.shape)
    # A slow term resembles others, which may be there below their limits. Those with a shape have none.
    slow = np.array([not isinstance(term, AngleRandomWalk | Quantization) for term in model.terms])
    hidden = free & ~active & slow & ~np.isin(np.arange(power.shape[1]), owner)
    fitted = active & free
    axes = Hypotheses(tangent, V, active, fitted, hidden, power, solution.power_error, has_shape)
    covariance = axes.linearized(power, np.concatenate([axes.fitted, has_shape], axis=1))[2]
    # Both sides of every term of every axis are tested together.
    axis, term, side = (x.ravel() for x in np.indices((*power.shape, 2)))
    each = axes.of_axes(axis)
    each = each._replace(hidden=each.hidden & slow[term][:, None])
    v, distance = each.tested(term, side == 0)
    ends = ends_of((v[::2], distance[::2]), (v[1::2], distance[1::2]), axes.ceiling().ravel())
    return estimates_of(model, active, power, solution.shape, covariance, ends.reshape(*power.shape, -1))


class Hypotheses(NamedTuple):
    """Several axes at their solutions, and the distance of their data from hypotheses about a term's power.

    `V` holds the estimates. `active` marks the terms in use, `fitted` those whose power is estimated,
    `hidden` others that may have some power under a hypothesis, and `has_shape` the shapes that the data
    determine, which a term without power does not have.
    """

    tangent: Tangent
    V: _Curves
    active: _Flags
    fitted: _Flags
    hidden: _Flags
    power: _Terms
    error: _PerAxis
    has_shape: _Flags

    def of_axes(self, axes: Int[np.ndarray, " few"]) -> Hypotheses:
        return Hypotheses(self.tangent.of_axes(axes), *(x[axes] for x in self[1:]))

    def linearized(
        self, power: _Terms, estimated: _Flags
    ) -> tuple[_Square, _Square, _Square, Float[np.ndarray, "axes params"]]:
        """Derivatives X of the relative residuals r, C⁻¹X, covariance, and one-step estimates at hypotheses.

        The estimates are linear, covariance·X'C⁻¹r; parameters that are not estimated have zeros.
        """
        at, mean = self.tangent, self.tangent.mean(power)
        by_shape = at.by_shape.reshape(*at.by_shape.shape[:2], -1)
        moved = (power[:, None] @ by_shape).reshape(*mean.shape, -1)
        units = np.broadcast_to(at.means.swapaxes(1, 2), (*mean.shape, power.shape[1]))
        X = np.concatenate([units, moved], axis=2) / mean[:, :, None] * estimated[:, None]
        weighed = at.weighed(power, self.error, X)
        normal, size = _scaled(X.swapaxes(1, 2) @ weighed)
        # A zero column (not estimated) gets a unit on the diagonal.
        rest = np.where(estimated, 0.0, 1.0) + 1e-12
        sizes = size[:, :, None] * size[:, None]
        covariance = np.linalg.inv(normal + rest[:, :, None] * np.eye(rest.shape[1])) / sizes
        covariance *= estimated[:, :, None] & estimated[:, None]
        score = weighed.swapaxes(1, 2) @ (self.V / mean - 1.0)[:, :, None]
        return X, weighed, covariance, (covariance @ score)[..., 0]

    def scores(self, term: _Index, power: _Terms, estimated: _Flags) -> _PerAxis:
        """Distance of the data from these powers, that of one term being tested, as a normal score.

        With few clusters estimates are skewed, so that a positive deviation is less surprising than a
        negative one: the score is that of a shifted gamma law.
        """
        X, weighed, covariance, step = self.linearized(power, estimated)
        axis = np.arange(len(term))
        row, std = covariance[axis, term][:, :, None], np.sqrt(covariance[axis, term, term])
        skewness = skewness_of(X @ row, weighed @ row, std[:, None], power[axis, term][:, None])[:, 0]
        t, g = step[axis, term] / std, np.where(np.abs(skewness) > 1e-3, skewness, 1e-3)
        return np.sign(g) * cube_root_score(np.maximum(1.0 + g * t / 2.0, 0.0), g**2 / 4.0)

    def profiled(self, power: _Terms, allowed: _Flags) -> _Terms:
        """Powers, the allowed ones fitted to the data with weights from the covariance at `power`.

        Negative ones are left out, one set after another.
        """
        means, mean = self.tangent.means, self.tangent.mean(power)
        A = (means / mean[:, None]).swapaxes(1, 2)
        rest = (self.V - self.tangent.mean(np.where(allowed, 0.0, power))) / mean
        weighed = self.tangent.weighed(power, self.error, A).swapaxes(1, 2)
        normal, size = _scaled(weighed @ A)
        target, positive = (weighed @ rest[:, :, None])[..., 0] / size, allowed
        for _ in range(power.shape[1]):
            system = np.where(positive[..., None] & positive[:, None], normal, 0.0)
            system += np.where(positive, 1e-12, 1.0)[..., None] * np.eye(power.shape[1])
            x = np.linalg.solve(system, np.where(positive, target, 0.0)[..., None])[..., 0]
            if not np.any(x < 0.0):
                break
            positive = positive & (x >= 0.0)
        return np.where(allowed, np.maximum(x, 0.0) / size, power)

    def tested(self, term: _Index, below: Bool[np.ndarray, " axes"]) -> tuple[_Grid, _Grid]:
        """Hypothetical powers of a term for each axis, and the data's distance from them.

        They lead away from the estimate until the data exclude one. The distance is that beyond the one at
        the estimate, positive where the data favour this. The other powers are fitted anew at each, with the
        weights of the last.
        """
        left, owner = np.arange(len(term)), self.tangent.owner
        alone = np.eye(self.power.shape[1], dtype=bool)[term]
        # The term under test is estimated even if inactive; its shape may be unknown.
        shaped = self.has_shape & (owner != term[:, None])
        estimated = np.concatenate([self.fitted | alone, shaped], axis=1)
        sd = np.sqrt(self.linearized(self.power, estimated)[2][left, term, term])
        estimate, sign = self.power[left, term], np.where(below, 1.0, -1.0)
        steps = np.where(below[:, None], _BELOW, _ABOVE)
        v = np.maximum(estimate[:, None] + steps * sd[:, None], 0.0)
        distance, at = np.full(v.shape, np.nan), self.power * self.active
        for k in range(v.shape[1]):
            some, here = self.of_axes(left), alone[left]
            # The only term cannot vanish altogether.
            tried = np.maximum(v[:, k], 1e-9 * estimate)[:, None]
            others = (some.fitted | some.hidden) & ~here
            new = some.profiled(np.where(here, tried[left], at[left]), others)
            present = some.fitted | here | (some.hidden & (new > 0.0))
            there = new[:, owner] > 0.0
            own = owner == term[left, None]
            shaped = np.where(own, there & some.active[:, owner], some.has_shape & there)
            score = some.scores(term[left], new, np.concatenate([present, shaped], axis=1))
            if k == 0:
                # Not zero where other powers ended at zero. Also for an absent term whose score is negative,
                # so that its limit does not shrink.
                start = np.where(np.isfinite(score), score, 0.0)
                start = np.where(estimate > 0.0, start, np.minimum(start, 0.0))
            at[left], distance[left, k] = new, sign[left] * (score - start[left])
            left = left[~(distance[left, k] > _FAR_ENOUGH) & (v[left, k] != v[left, -1])]
            if not len(left):
                break
        return v, distance

    def ceiling(self) -> _Terms:
        """Upper bound of each term's power, beyond which one of the estimates would be improbably small.

        Other terms can only add to an estimate, so that V ≥ v·mean·e^(error·z)·χ²/ν, with a normal z. With m
        estimates the chance of either is `_CHANCE`/2m, and P(χ² < x) < (x/2)^(ν/2)/Γ(ν/2 + 1). ν is that of
        the term that scatters most.
        """
        from scipy.special import gammaln, ndtri

        means, units = self.tangent.means, np.eye(self.power.shape[1])
        each = np.stack([self.tangent.variances(unit[None]) for unit in units], axis=1)
        relative = np.max(np.where(means > 0.0, each / means**2, 0.0), axis=1)
        half, chance = 1.0 / np.maximum(relative, 1e-9), _CHANCE / (2.0 * self.V.shape[1])
        least = (np.log(chance) + gammaln(half + 1.0)) / half - np.log(half)
        least = least + self.error[:, None] * ndtri(chance)
        highest = np.where(means > 0.0, self.V[:, None] / means, np.inf) * np.exp(-least)[:, None]
        return np.min(highest, axis=2)


def skewness_of(X: _Columns, weighed: _Columns, std: _PerColumn, power: _PerColumn) -> _PerColumn:
    """Skewness of linear estimates, given X and C⁻¹X times their columns of the covariance, and their powers.

    The third cumulant of Σ x_j V_j/μ_j is 8 tr(...)³ of quadratic forms. The triple products are replaced by
    pairs, κ_ijk = ⅔(R_ij R_jk + R_jk R_ki + R_ki R_ij), which is exact for a single estimate (χ²).
    """
    third = 2.0 * np.sum(weighed * X**2, axis=1)
    # An estimate that cannot be negative is not more skewed than a χ² of its mean and variance.
    return np.minimum(third / std**3, 2.0 * std / np.maximum(power, 1e-300))


def _scaled(normal: _Square) -> tuple[_Square, _PerColumn]:
    """Normal equations with a unit diagonal, and the root of their diagonal; 1 where it is zero."""
    size = np.sqrt(np.einsum("aii->ai", normal))
    size = np.where(size > 0.0, size, 1.0)
    return normal / (size[:, :, None] * size[:, None]), size


@np.errstate(divide="ignore", invalid="ignore")
def ends_of(below: tuple[_Grid, _Grid], above: tuple[_Grid, _Grid], ceiling: _PerAxis) -> _Ends:
    """Lower and upper end of the 95 % and of the 68 % interval of a power, and its one-sided 95 % limit.

    `below` and `above` are hypothetical powers from the estimate on, and the data's distances from them as
    normal scores. The `ceiling` is the upper end if the model error is so large that the data exclude none.
    """
    # Without this term the others may leave no noise at all: such a hypothesis is excluded.
    lower = below[0], np.where(np.isfinite(below[1]), below[1], np.inf), 0.0
    upper = above[0], np.where(np.isfinite(above[1]), above[1], np.nan), np.maximum(ceiling, above[0][:, 0])
    axis, found = np.arange(len(ceiling)), []
    for level in _LEVELS:
        power, distance, nowhere = lower if level > 0.0 else upper
        # The nearest hypothesis beyond the level, and its neighbour on the estimate's side.
        beyond = distance >= abs(level)
        outer = np.argmax(beyond, axis=1)
        inner = np.maximum(outer - 1, 0)
        (from_, to), (near, far) = ((x[axis, inner], x[axis, outer]) for x in (power, distance))
        # No share where there is no distance at the estimate itself.
        share = np.where(np.isfinite(far) & (far != near), (abs(level) - near) / (far - near), 0.0)
        found.append(np.where(beyond.any(axis=1), from_ + share * (to - from_), nowhere))
    return np.stack(found, axis=1)


def reported(model: Model) -> tuple[ModelParameter, ...]:
    """Parameters of a model that are coefficients: all but infinite ones and held ones without a value."""
    return tuple(p for p in model.parameters if p.free or (p.start is not None and np.isfinite(p.start)))


def count_estimated(model: Model, active: Bool[np.ndarray, " terms"]) -> int:
    """Number of coefficients that are estimated, by which the degrees of freedom of χ² are reduced."""
    here = of_owners(model, active)
    return sum(p.free and bool(here[p.term]) for p in model.parameters)


class Estimates(NamedTuple):
    """The coefficients of several axes in SI, in the order of `reported`, and their covariance.

    `value` and `std` are NaN for the shape of an absent term. `ends` has the lower and the upper end of the
    95 % and of the 68 % interval, and the one-sided 95 % limit, which is NaN except for amplitudes.
    `detected` tells whether the interval of the term's amplitude excludes zero.
    """

    value: Float[np.ndarray, "axes params"]
    std: Float[np.ndarray, "axes params"]
    ends: Float[np.ndarray, "axes params 5"]
    detected: Bool[np.ndarray, "axes params"]
    covariance: Float[np.ndarray, "axes params params"]


@np.errstate(divide="ignore", invalid="ignore")
def estimates_of(
    model: Model,
    active: _Flags,
    power: _Terms,
    shape: Float[np.ndarray, "axes shapes"],
    covariance: _Square,
    of_powers: Float[np.ndarray, "axes terms 5"],
) -> Estimates:
    """The coefficients of every axis from its powers and shapes; inactive terms have limits only.

    The covariance is that of powers and shapes, `of_powers` are the ends of the powers' intervals.
    """
    parameters, sd = reported(model), np.sqrt(np.einsum("aii->ai", covariance))
    count = (len(power), len(parameters))
    value, ends = np.zeros(count), np.full((*count, 5), np.nan)
    # Derivatives of the coefficients by powers and shapes.
    slopes = np.zeros((*count, sd.shape[1]))
    found = active & (power > 0.0)
    there, shapes = of_owners(model, found.copy()), itertools.count(len(model))
    for row, p in enumerate(parameters):
        own = p.parameter
        if not p.free:
            value[:, row] = ends[:, row, :4] = p.start or 0.0
            if own.is_amplitude:
                found[:, p.term] = True
        elif own.is_amplitude:
            value[:, row], ends[:, row] = np.sqrt(power[:, p.term]), np.sqrt(of_powers[:, p.term])
            found[:, p.term] = active[:, p.term] & (ends[:, row, 0] > 0.0)
            slopes[:, row, p.term] = np.where(power[:, p.term] > 0.0, 0.5 / value[:, row], 0.0)
        else:
            k, present = next(shapes), there[:, p.term]
            distance = np.exp(shape[:, k - len(model)])
            value[:, row] = np.where(present, own.lower + distance, np.nan)
            slopes[:, row, k] = np.where(present, distance, 0.0)
            # In ln of the distance from the bound; wider ones are unbounded.
            ratio = np.exp(np.clip(-_LEVELS[:4] * sd[:, [k]], -300.0, 300.0))
            around = np.minimum(own.lower + distance[:, None] * ratio, own.upper)
            ends[:, row, :4] = np.where(present[:, None], around, [own.lower, own.upper] * 2)
    # The response comes after all terms.
    detected = of_owners(model, found)[:, [p.term for p in parameters]]
    std = np.where(np.isnan(value), np.nan, np.einsum("arp,ap->ar", slopes, sd))
    return Estimates(value, std, ends, detected, slopes @ covariance @ slopes.swapaxes(1, 2))


def coefficients_of(
    template: Model,
    axis: Axis,
    noise: Model,
    found: Estimates,
    others: Mapping[str, Estimate],
    n: int,
    rate: float,
) -> tuple[dict[str, Estimate], Float[np.ndarray, "params params"]]:
    """Coefficients of one axis by their labels, with their covariance [SI] in the same order.

    They are the estimates of its noise, and others, independent of these. Shapes that may lie beyond the
    observable range of n samples at `rate` [Hz] have a limit and no error.
    """
    rows = zip(reported(noise), *(x[0].tolist() for x in found[:4]), strict=True)
    own = {p.label: _within(estimate_of(p, axis, *row), n, rate) for p, *row in rows}
    both, order = {**own, **others}, [p.label for p in reported(template)]
    covariance, places = np.zeros((len(order), len(order))), [order.index(label) for label in own]
    covariance[np.ix_(places, places)] = found.covariance[0]
    for k, label in enumerate(order):
        if label in others:
            covariance[k, k] = others[label].std ** 2
    return {label: both[label] for label in order}, np.nan_to_num(covariance)


def estimate_of(
    p: ModelParameter, axis: Axis, value: float, std: float, ends: Sequence[float], seen: bool, **more: Any
) -> Estimate:
    """Estimate of a parameter, with `ends` as those of `Estimates`, that is detected if it is seen."""
    more |= {"label": p.label, "term": p.term_label, "parameter": p.parameter, "held": not p.free}
    more |= {"interval": (ends[0], ends[1]), "interval_68": (ends[2], ends[3])}
    limit = ends[4] if p.free and p.parameter.is_amplitude else None
    if limit is not None and seen and ends[0] > 0.0:
        # 1σ is nowhere beyond the 95 % interval, whose law may be skewed.
        std = float(min(std, value - ends[0], ends[1] - value))
    return Estimate(axis=axis, value=value, std=std, upper_limit=limit, detected=seen, **more)


def _within(c: Estimate, n: int, rate: float) -> Estimate:
    """Estimate, of a shape turned into a limit if its interval extends beyond the observable range."""
    p: Any = c.parameter
    if c.held or p.is_amplitude or not (c.detected and c.std > 0.0):
        return c
    # Bounds are open, and searches keep a little away from them.
    margin = _MARGIN * (p.upper - p.lower) if np.isfinite(p.upper) else 0.0
    observable = {"time": (2.0 / rate, n / rate), "number": (p.lower + margin, p.upper - margin)}
    low, high = observable.get(p.kind, (rate / n, rate / 2.0))
    below, above = c.interval[0] <= low, c.interval[1] >= high
    if not (below or above):
        return c
    distance = c.value - p.lower
    ratio = float(np.exp(min(ONE_SIDED_95 * c.std / distance, 700.0)))
    # At a bound itself the data do not determine the logarithm of the distance from it.
    below, above = below or ratio > _NOWHERE, above or ratio > _NOWHERE
    cut = [(p.lower if below else a, p.upper if above else b) for a, b in (c.interval, c.interval_68)]
    return dataclasses.replace(
        c,
        std=float("nan"),
        interval=cut[0],
        interval_68=cut[1],
        lower_limit=p.lower + distance / ratio if above and not below else None,
        upper_limit=p.lower + distance * ratio if below and not above else None,
    )


def deterministic_coefficients(
    model: Model,
    term: int,
    axis: Axis,
    amplitude: Float[np.ndarray, " components"],
    covariance: Float[np.ndarray, "components components"],
    line: Line | None,
    n: int,
    active: bool = True,
) -> dict[str, Estimate]:
    """The coefficients of a ramp or a line, by the noncentral χ² law of the square of its estimate.

    The `amplitude` [SI] has one component for a ramp or a step, two for a line. A line at an unknown
    frequency competes with n/2 frequencies without one. Of a term that is not `active` there is a limit.
    """
    from scipy.special import ndtr

    square = float(amplitude @ np.linalg.solve(covariance, amplitude))
    unit = float(np.sqrt(np.trace(covariance) / len(amplitude)))
    searched = line is not None and line.frequency_std > 0.0
    chance, detected = np.exp(-square / 2.0) * n if searched else 0.0, True
    found: dict[str, Estimate] = {}
    for p in (p for p in reported(model) if p.term == term):
        value, std, seen = float(p.start or 0.0), 0.0, True
        ends = [value] * 5
        if p.free and p.parameter.is_amplitude:
            levels = ndtr(np.append(_LEVELS, 0.0))
            *ends, value = (unit * amplitude_quantiles(square, len(amplitude), levels)).tolist()
            value = value if active else 0.0
            std = unit if value > 0.0 else 0.0
            seen = detected = bool(active and ends[0] > 0.0 and chance < _FALSE_LINE)
        elif p.free:
            assert line is not None
            value, std, seen = line.frequency, line.frequency_std, detected
            ends = (value - _LEVELS * std).tolist()
        found[p.label] = estimate_of(p, axis, value, std, ends, seen)
    return found

"""Inference from a solution: covariance, tests of hypothetical powers, and coefficients with intervals."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import gammaln, ndtri
from jaxtyping import Array, ArrayLike, Bool, Float

from allanjax.base.arrays import namespace
from allanjax.base.cache import compiled_once
from allanjax.base.chi_squared import cube_root_score
from allanjax.base.linalg import inverse, non_negative_least_squares
from allanjax.base.normal import ONE_SIDED_95, TWO_SIDED_68, TWO_SIDED_95
from allanjax.estimate.design import Design, of_owners
from allanjax.estimate.deterministic import Line, amplitude_quantile
from allanjax.estimate.gls import Solution
from allanjax.noise.estimate import Estimate
from allanjax.noise.model import Model, ModelParameter
from allanjax.noise.terms import Parameter
from allanjax.record.recording import Axis

# A shape is at a bound if it is closer than this share of the distance between its bounds.
_INSIDE = 0.0125
# A limit that is so many times as far from a bound as the estimate is not reported.
_NOWHERE = 1e4
# A line at an unknown frequency is detected if noise has a line as strong in at most one of so many records.
_FALSE_LINE = 1.35e-3


class Inference(NamedTuple):
    """Covariance and hypothesis tests of one axis around its estimate.

    `covariance` is that of (powers, shapes); `power_at` and `pivot_at` are, per term, hypothetical powers
    and the data's distance from each as a normal score, positive if the data favour a larger power: up to
    `ESTIMATE` those below the estimate, from `ABOVE` on those above. `ceiling` is, per term, a power that is
    excluded even without other terms, see `ceiling`.
    """

    covariance: Float[Array, "params params"]
    estimate_variance: Float[Array, " m"]
    power_at: Float[Array, "terms grid"]
    pivot_at: Float[Array, "terms grid"]
    ceiling: Float[Array, " terms"]


class _Linearized(NamedTuple):
    """One-step estimates at a hypothesis, linear in the relative residuals of the Allan variances.

    `weights` [params, m] multiply the residuals; `weighted` is their product with the residuals' covariance.
    """

    covariance: Float[Array, "params params"]
    step: Float[Array, " params"]
    weights: Float[Array, "params m"]
    weighted: Float[Array, "params m"]
    estimate_variance: Float[Array, " m"]


def gamma_score(t: Float[Array, ...], skewness: Float[Array, ...]) -> Float[Array, ...]:
    """Normal score of a standardized deviation t of a shifted gamma law with this skewness.

    With few clusters estimates are skewed, so that a positive t is less surprising than a negative one.
    """
    xp = namespace(t, skewness)
    g = xp.where(xp.abs(skewness) > 1e-3, skewness, 1e-3)
    return xp.sign(g) * cube_root_score(xp.maximum(1.0 + g * t / 2.0, 0.0), g**2 / 4.0)


#: Hypothetical powers, in standard deviations from the estimate; the first is zero power.
DOWN = np.array([-np.inf, -8.0, -6.0, -5.0, -4.0, -3.0, -2.5, -2.0, -1.5, -1.0, -0.5, 0.0])
# If the scatter grows with the power, as for few long clusters, limits may be far above.
_NEAR = [0.0, 0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 4.0, 6.0, 10.0]
UP = np.array([*_NEAR, *10.0 * 2.0 ** np.arange(1, 31)])
#: Indices of the estimate itself, of hypotheses below and above.
ESTIMATE = len(DOWN) - 1
ABOVE = len(DOWN)
#: No interval ends beyond this score.
FAR_ENOUGH = -2.0
#: Probability that a ceiling is too low.
CHANCE = 0.025


def infer(
    design: Design,
    V: Float[np.ndarray, "axes m"],
    free: Bool[np.ndarray, " terms"],
    active: Bool[np.ndarray, "axes terms"],
    solution: Solution,
) -> Inference:
    """Covariance of the parameters, and for each term the distance of the data from hypothetical powers.

    The first hypothesis is v = 0. Upwards, hypotheses continue until the data exclude one, and the other
    powers are fitted anew at each, since far away a linear prediction of them is useless. Hypotheses that are
    not tested are NaN.

    The distance is the score statistic: the mean, covariance and derivatives at the hypothesis (the other
    powers adjusted to it), so that it is right at the boundary v = 0 as well as where the scatter grows
    with v. It exists for inactive terms too, whose upper limits it gives. All arrays are NumPy's.
    """
    of_program, structure = jax.tree.flatten((design, V, free, active, solution))
    with compiled_once((structure, *map(np.shape, of_program))):
        return jax.device_get(_infer_axes(design, V, free, active, solution))


@eqx.filter_jit
def _infer_axes(
    design: Design,
    V: Float[ArrayLike, "axes m"],
    free: Bool[ArrayLike, " terms"],
    active: Bool[ArrayLike, "axes terms"],
    solution: Solution,
) -> Inference:
    shared = jnp.asarray(free)
    return jax.vmap(lambda V, active, s: _infer(design, V, shared, active, s))(V, active, solution)


def without_padding(inference: Inference, m: int, terms: int, shapes: int) -> Inference:
    """Inference for so many estimates, terms and shapes, from that of a padded design."""
    places, first = np.arange(inference.covariance.shape[-1]), inference.power_at.shape[1]
    own = places[(places < terms) | (places >= first) & (places < first + shapes)]
    return Inference(
        inference.covariance[:, own[:, None], own],
        inference.estimate_variance[:, :m],
        inference.power_at[:, :terms],
        inference.pivot_at[:, :terms],
        inference.ceiling[:, :terms],
    )


def _infer(
    design: Design,
    V: Float[Array, " m"],
    free: Bool[Array, " terms"],
    active: Bool[Array, " terms"],
    s: Solution,
) -> Inference:
    axis = _Axis.of(design, V, active, s)
    owner, terms = axis.owner, len(s.power)
    is_active = jnp.concatenate([active & free, axis.has_shape]).astype(float)
    # The term under test is estimated even if inactive; at v = 0 its shape cannot be.
    alone = jnp.eye(terms, dtype=bool)
    own_shape = alone[:, owner]
    tested = jnp.concatenate([(active & free) | alone, axis.has_shape & ~own_shape], axis=1).astype(float)

    def of_term(k: Array, found: tuple[Array, Array]) -> tuple[Array, Array]:
        power_at, pivot_at = axis.hypotheses(active & free, k, alone[k], own_shape[k], tested[k])
        return found[0].at[k].set(power_at), found[1].at[k].set(pivot_at)

    nothing = jnp.full((terms, len(DOWN) + len(UP)), jnp.nan)
    power_at, pivot_at = jax.lax.fori_loop(0, design.terms, of_term, (nothing, nothing))
    found = axis.linearized(s.power, is_active)
    highest = ceiling(design, V, axis.means, axis.products, s.power_error)
    return Inference(found.covariance, found.estimate_variance, power_at, pivot_at, highest)


class _Axis(NamedTuple):
    """One axis at its solution, and the distance of its data from hypotheses about a term's power.

    Attributes:
        design, V, active, s: the design, the estimates of power, the terms in use, and the solution.
        owner: the term of each shape.
        means, products: what unit powers contribute at the solution's shapes.
        by_shape: derivatives of the means by the shapes, [terms, m, shapes].
        has_shape: which shapes the data determine; a term without power has none.
    """

    design: Design
    V: Float[Array, " m"]
    active: Bool[Array, " terms"]
    s: Solution
    owner: Array
    means: Float[Array, "terms m"]
    products: Array
    by_shape: Float[Array, "terms m shapes"]
    has_shape: Bool[Array, " shapes"]

    @classmethod
    def of(cls, design: Design, V: Float[Array, " m"], active: Bool[Array, " terms"], s: Solution) -> _Axis:
        owner = jnp.asarray(design.owner)
        means, products = design.means(s.shape), design.products(s.shape)
        by_shape = jnp.zeros((*means.shape, len(s.shape)))
        if design.has_shapes:
            by_shape = jax.jacfwd(design.means)(s.shape)
        has_shape = active[owner] & (s.power[owner] > 0.0) & design.movable
        return cls(design, V, active, s, owner, means, products, by_shape, has_shape)

    def linearized(self, power: Float[Array, " terms"], estimated: Float[Array, " params"]) -> _Linearized:
        """One-step estimates at a hypothesis of those parameters that are estimated."""
        design, V = self.design, self.V
        mean = design.mean(power, self.means)
        covariance = design.covariance(power, self.products)
        moved = jnp.einsum("k,kms->ms", power, self.by_shape)
        raw = jnp.concatenate([self.means.T, moved], axis=1) / mean[:, None]
        raw = raw * estimated
        columns = jnp.concatenate([raw, (V / mean - 1.0)[:, None]], axis=1)
        whitened, weighed = design.whiten_and_weigh(covariance, mean, self.s.power_error, columns)
        D, residual = whitened[:, :-1], whitened[:, -1]
        size = jnp.sqrt(jnp.sum(D**2, axis=0))
        size = jnp.where(size > 0.0, size, 1.0)
        # A zero column (not estimated) gets a unit on the diagonal, and its variance is zeroed later.
        normal = (D / size).T @ (D / size) + jnp.diag(1.0 - estimated) + 1e-12 * jnp.eye(len(size))
        normal_inverse = inverse(normal) / (size[:, None] * size)
        return _Linearized(
            covariance=normal_inverse * (estimated[:, None] * estimated),
            step=normal_inverse @ (D.T @ residual),
            weights=normal_inverse @ weighed[:-1],
            weighted=normal_inverse @ raw.T,
            estimate_variance=design.variances(covariance),
        )

    def score(self, term: Array, v: Array, at: Array, fitted: Array) -> Float[Array, ""]:
        """Distance of the data from these powers as a normal score; the term's own power is v."""
        there = self.linearized(at, fitted)
        variance = there.covariance[term, term]
        # Third cumulant of Σ x_j V_j/μ_j: 8 tr(...)³ of quadratic forms, the triple products replaced by
        # pairs, κ_ijk = ⅔(R_ij R_jk + R_jk R_ki + R_ki R_ij); exact for a single estimate (χ²).
        third = 2.0 * jnp.sum(there.weights[term] * there.weighted[term] ** 2)
        # An estimate that cannot be negative is not more skewed than a χ² of its mean and variance.
        skewness = jnp.minimum(third / variance**1.5, 2.0 * jnp.sqrt(variance) / jnp.maximum(v, 1e-300))
        return gamma_score(there.step[term] / jnp.sqrt(variance), skewness)

    def profiled(self, power: Array, allowed: Array) -> Float[Array, " terms"]:
        """Powers, the allowed ones fitted to the data with weights from the covariance at `power`."""
        mean = self.design.mean(power, self.means)
        covariance = self.design.covariance(power, self.products)
        columns = jnp.concatenate([self.means, self.V[None]]) / mean
        columns = self.design.whiten(covariance, mean, self.s.power_error, columns.T).values
        A = columns[:, :-1]
        target = columns[:, -1] - A @ jnp.where(allowed, 0.0, power)
        return jnp.where(allowed, non_negative_least_squares(A, target, allowed), power)

    def hypotheses(
        self, fitted_too: Array, term: Array, alone: Array, own_shape: Array, estimated: Array
    ) -> tuple[Float[Array, " grid"], Float[Array, " grid"]]:
        """Hypothetical powers of a term, and the data's distance from each.

        Args:
            fitted_too: terms that are fitted anew above the estimate.
            term: the term's index, and `alone`, `own_shape` the same as flags of terms and of shapes.
            estimated: flags of the parameters that are estimated together with its power.
        """
        s, active, owner = self.s, self.active, self.owner
        terms = len(s.power)
        local = self.linearized(s.power, estimated).covariance
        sd = jnp.sqrt(local[term, term])
        # The only term cannot vanish altogether.
        least = 1e-9 * s.power[term]
        slope = jnp.where(estimated[:terms] > 0.0, local[:terms, term] / local[term, term], 0.0)
        down = jnp.maximum(s.power[term] + jnp.asarray(DOWN) * sd, 0.0)
        up = s.power[term] + jnp.asarray(UP) * sd

        def below(k: Array, scores: Array) -> Array:
            v = jnp.maximum(down[k], least)
            others = jnp.maximum(s.power + slope * (v - s.power[term]), 0.05 * s.power)
            at = jnp.where(alone, v, jnp.where(active, others, 0.0))
            shaped = jnp.where(own_shape, (v > 0.0) & active[owner], self.has_shape)
            fitted = jnp.concatenate([estimated[:terms], shaped])
            return scores.at[k].set(self.score(term, v, at, fitted))

        def above(state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
            k, scores, others = state
            v = jnp.maximum(up[k], least)
            at = self.profiled(jnp.where(alone, v, others), fitted_too & ~alone)
            shaped = jnp.where(own_shape, (v > 0.0) & active[owner], self.has_shape & (at[owner] > 0.0))
            fitted = jnp.concatenate([estimated[:terms], shaped])
            return k + 1, scores.at[k].set(self.score(term, v, at, fitted)), at

        def goes_on(state: tuple[Array, Array, Array]) -> Array:
            k, scores, _ = state
            reached = scores[k - 1] - jnp.minimum(scores[0], 0.0) < FAR_ENOUGH
            return (k == 0) | (~reached & (k < len(UP)))

        nothing = jnp.full(len(UP), jnp.nan)
        pivots = jax.lax.fori_loop(0, len(DOWN), below, jnp.zeros_like(down))
        _, further, _ = jax.lax.while_loop(goes_on, above, (jnp.asarray(0), nothing, s.power * active))
        return jnp.concatenate([down, up]), jnp.concatenate([pivots, further])


def ceiling(
    design: Design, V: Float[Array, " m"], means: Float[Array, "terms m"], products: Array, power_error: Array
) -> Float[Array, " terms"]:
    """Upper bound of each term's power, beyond which one of the estimates would be improbably small.

    Other terms can only add to an estimate, so that V ≥ v·mean·e^(power_error·z)·χ²/ν, with a normal z. With
    m estimates the chance of either is `CHANCE`/2m, and P(χ² < x) < (x/2)^(ν/2)/Γ(ν/2 + 1). ν is that of the
    term that scatters most.
    """
    each = jax.vmap(lambda power: design.variances(design.covariance(power, products)))(jnp.eye(len(means)))
    relative = jnp.max(jnp.where(means > 0.0, each / means**2, 0.0), axis=0)
    half, chance = 1.0 / jnp.maximum(relative, 1e-9), CHANCE / (2.0 * design.rows)
    least = (jnp.log(chance) + gammaln(half + 1.0)) / half - jnp.log(half) + power_error * ndtri(chance)
    return jnp.min(jnp.where(means > 0.0, V / means, jnp.inf) * jnp.exp(-least), axis=1)


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
    """Parameters of a model that are coefficients: all but infinite ones and held ones without a value."""
    return tuple(p for p in model.parameters if p.free or (p.start is not None and np.isfinite(p.start)))


@dataclasses.dataclass(frozen=True, eq=False)
class Estimates:
    """The coefficients of several axes in SI, [axes, coefficients] in the order of `reported`.

    Attributes:
        value, std: estimates and their standard deviations; NaN for the shape of an absent term.
        interval, interval_68: [axes, coefficients, 2] ends of the 95 and 68 % intervals.
        upper_limit: one-sided 95 % limits of amplitudes; NaN where there is none.
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

    Shapes that may lie beyond the observable range of n samples at `rate` [Hz] have a limit and no error.
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
    """Estimate of a shape, turned into a limit if its interval extends beyond the observable range of the
    record."""
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
    # At a bound itself the data do not determine the logarithm of the distance from it.
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
        axis: the axis.
        square: squared estimate in units of its variance.
        unit: standard deviation of each component, SI.
        components: 1 of a ramp or a step, 2 of a line.
        line: where the line was found.
        n: samples of the record; a line at an unknown frequency competes with n/2 frequencies without one.
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
    """Intervals of a parameter, given the standard deviation of ln(distance from its lower bound)."""
    # Wider ones are unbounded.
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
    if the model error is so large that the data exclude none).
    """
    below = level > 0.0
    side = slice(ESTIMATE, None, -1) if below else slice(ABOVE, None)
    power, pivot = power[:, side], pivot[:, side]
    # Without this term the others may leave no noise at all: such a hypothesis is excluded.
    pivot = np.where(np.isfinite(pivot), pivot, np.inf if below else np.nan)
    # If other powers ended at zero, the score at the estimate may not be zero; it is then subtracted, and
    # also for an absent term whose score is negative, so that its limit does not shrink.
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

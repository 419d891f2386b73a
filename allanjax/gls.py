"""Iterated generalized least squares on the Allan variance, compiled and vectorised over axes.

The estimating equation is D'C⁻¹(V − μ) = 0 with mean μ, its derivatives D and the covariance C of the
estimates V all at the current model: unbiased whatever the shape of V's law, and nearly as good as the whole
record's likelihood. Inside, each variance is written in units of its model mean.

Where a model cannot follow the curve within the scatter (χ² beyond its 99.9 % point), the covariance
gains a discrepancy: a relative error s of the model curve, correlated over about an octave, with s such that χ²
equals its degrees of freedom. Intervals then say how well the coefficients are known *given that the model is
incomplete*, instead of being absurdly narrow.
"""

from __future__ import annotations

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int

from allanjax.covariance import AllanCovariance
from allanjax.model import Model, ModelParameter
from allanjax.terms import NoiseTerm

# Relative to the estimates' own variance: rounding and quadrature errors stay below it, and no direction
# of the data is trusted more than that.
_RIDGE = 1e-4
_OUTER_STEPS = 60
_INNER_STEPS = 50
# A step that moves the fitted curve by less than this, in standard deviations, ends the iteration.
_TOLERANCE = 1e-3
# An iteration warms up with large discrepancies: nearly a log-log fit, which finds its way from anywhere;
# then runs without, and, if that leaves too large a χ², with the discrepancy that the data call for.
_WARM_UP, _PLAIN, _DISCREPANT, _DONE = range(4)
_WARM_UP_DISCREPANCY = np.array([0.5, 0.2, 0.05, 0.0])


class Design(eqx.Module):
    """A model at fixed cluster sizes: the map from parameters to means and covariance of the estimates.

    Amplitudes enter by their squares v ("power" of a term); other free parameters by ln(value − lower).
    """

    model: Model = eqx.field(static=True)
    geometry: AllanCovariance
    fixed_means: tuple[Float[Array, " m"] | None, ...]
    fixed_kernels: tuple[Float[Array, "pairs lags"] | None, ...]
    octaves: Float[Array, "m m"]

    @classmethod
    def of(cls, model: Model, geometry: AllanCovariance) -> Design:
        """The design of a model (as sampled) for overlapping Allan variances of this geometry."""
        means, kernels = _constants(model, geometry)
        distance = np.abs(np.subtract.outer(*2 * [np.log2(geometry.sizes)]))
        return cls(model, geometry, means, kernels, np.exp(-distance))

    @property
    def shapes(self) -> tuple[ModelParameter, ...]:
        """The free parameters that are not amplitudes."""
        return _shapes(self.model)

    def units(self, shape: Float[Array, " shapes"]) -> list[NoiseTerm]:
        """The terms with unit amplitude at these shape parameters (transformed)."""
        terms = [_unit(t) for t in self.model.terms]
        for p, u in zip(self.shapes, shape, strict=True):
            value = p.parameter.lower + jnp.exp(u)
            terms[p.term] = terms[p.term].replace(**{p.parameter.name: value})
        return terms

    def means(self, shape: Float[Array, " shapes"]) -> Float[Array, "terms m"]:
        """Allan variance of each term with unit amplitude."""
        T = self.geometry.cluster_time
        return jnp.stack(
            [t.allan_variance(T) if b is None else b for t, b in zip(self.units(shape), self.fixed_means, strict=True)]
        )

    def kernels(self, shape: Float[Array, " shapes"]) -> list[Float[Array, "pairs lags"]]:
        """Covariance kernel of each term with unit amplitude."""
        pairs = zip(self.units(shape), self.fixed_kernels, strict=True)
        return [self.geometry.kernel(t) if k is None else k for t, k in pairs]

    def covariance(
        self, power: Float[Array, " terms"], kernels: list[Float[Array, "pairs lags"]]
    ) -> Float[Array, "m m"]:
        """Covariance of the estimates where each term has this power."""
        total = sum((v * k for v, k in zip(power, kernels, strict=True)), jnp.zeros(()))
        lines = [
            v * k for v, k, t in zip(power, kernels, self.model.terms, strict=True) if t.deterministic
        ]
        return self.geometry.matrix(total, sum(lines, jnp.zeros_like(total)))


class Solution(NamedTuple):
    """The estimate of one axis: powers [terms], transformed shapes, and how it was reached."""

    power: Float[Array, " terms"]
    shape: Float[Array, " shapes"]
    chi2: Float[Array, ""]
    discrepancy: Float[Array, ""]
    converged: Bool[Array, ""]
    cost: Float[Array, ""]


class Inference(NamedTuple):
    """What the data say about one axis around its estimate.

    `covariance` is that of (powers, shapes); `power_at` and `pivot_at` are, per term, hypothetical powers
    and the standardized distance of the data from each, positive where the data want more.
    """

    covariance: Float[Array, "params params"]
    estimate_covariance: Float[Array, "m m"]
    power_at: Float[Array, "terms grid"]
    pivot_at: Float[Array, "terms grid"]


class _State(NamedTuple):
    power: Float[Array, " terms"]
    shape: Float[Array, " shapes"]
    robust: tuple[Float[Array, " terms"], Float[Array, " shapes"]]
    discrepancy: Float[Array, ""]
    phase: Int[Array, ""]
    step: Int[Array, ""]
    chi2: Float[Array, ""]
    at_rest: Bool[Array, ""]


def _shapes(model: Model) -> tuple[ModelParameter, ...]:
    return tuple(p for p in model.parameters if p.free and p.parameter.kind != "amplitude")


def _unit(term: NoiseTerm) -> NoiseTerm:
    return term.replace(**{term.parameters()[0].name: 1.0})


@eqx.filter_jit
def _constants(
    model: Model, geometry: AllanCovariance
) -> tuple[tuple[Array | None, ...], tuple[Array | None, ...]]:
    """Means and kernels of the terms without free shape, which no iteration need repeat."""
    shape_terms = {p.term for p in _shapes(model)}
    units = [None if k in shape_terms else _unit(t) for k, t in enumerate(model.terms)]
    means = tuple(None if t is None else t.allan_variance(geometry.cluster_time) for t in units)
    return means, tuple(None if t is None else geometry.kernel(t) for t in units)


def _whitener(
    design: Design, covariance: Float[Array, "m m"], mean: Float[Array, " m"], discrepancy: Float[Array, ""]
) -> Float[Array, "m m"]:
    """Cholesky factor L of the covariance of V/mean: L⁻¹(V/mean − 1) has unit covariance."""
    relative = covariance / (mean[:, None] * mean)
    relative = relative + _RIDGE * jnp.diag(jnp.diag(relative)) + discrepancy**2 * design.octaves
    return jnp.linalg.cholesky(relative)


def _solve_triangular(L: Float[Array, "m m"], x: Float[Array, "m ..."]) -> Float[Array, "m ..."]:
    return jax.scipy.linalg.solve_triangular(L, x, lower=True)


def _discrepancy(
    design: Design,
    covariance: Float[Array, "m m"],
    mean: Float[Array, " m"],
    V: Float[Array, " m"],
    dof: Float[Array, ""],
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """χ² of the curve, and the relative model error s that brings it down to its degrees of freedom."""
    residual = V / mean - 1.0

    def chi2(s: Float[Array, ""]) -> Float[Array, ""]:
        return jnp.sum(_solve_triangular(_whitener(design, covariance, mean, s), residual) ** 2)

    plain = chi2(jnp.zeros(()))
    # Wilson & Hilferty's (1931) 99.9 % point of χ².
    limit = dof * (1.0 - 2.0 / (9.0 * dof) + 3.09 * jnp.sqrt(2.0 / (9.0 * dof))) ** 3

    def halve(_: Int[Array, ""], bracket: tuple[Array, Array]) -> tuple[Array, Array]:
        low, high = bracket
        middle = (low + high) / 2.0
        too_small = chi2(jnp.exp(middle)) > dof
        return jnp.where(too_small, middle, low), jnp.where(too_small, high, middle)

    low, high = jax.lax.fori_loop(0, 24, halve, (jnp.log(1e-5), jnp.log(10.0)))
    return plain, jnp.where(plain > limit, jnp.exp((low + high) / 2.0), 0.0)


def _solve(
    design: Design,
    V: Float[Array, " m"],
    free: Bool[Array, " terms"],
    active: Bool[Array, " terms"],
    power: Float[Array, " terms"],
    shape: Float[Array, " shapes"],
) -> Solution:
    """The estimate from a start. Inactive terms have no power; those not free keep theirs."""
    owner = jnp.asarray([p.term for p in design.shapes], int)
    power = jnp.where(active, power, 0.0)
    dof = jnp.maximum(len(V) - jnp.sum(active & free) - jnp.sum(active[owner]), 1.0)

    def scatter(power: Array, shape: Array) -> tuple[Array, Array]:
        return power @ design.means(shape), design.covariance(power, design.kernels(shape))

    def best_powers(shape: Array, L: Array, reference: Array) -> tuple[Array, Array]:
        """Powers for a shape, and the whitened residual they leave (variable projection)."""
        A = _solve_triangular(L, (design.means(shape) / reference).T)
        target = _solve_triangular(L, V / reference) - A @ jnp.where(free, 0.0, power)
        v = jnp.where(free, non_negative_least_squares(A, target, active & free), power)
        return v, target - A @ jnp.where(free, v, 0.0)

    def improve(state: _State) -> tuple[Array, Array, Array]:
        """One generalized least squares fit, and how far it moved the curve, in standard deviations."""
        reference, covariance = scatter(state.power, state.shape)
        L = _whitener(design, covariance, reference, state.discrepancy)
        shape = state.shape
        if len(shape):

            def residual(u: Array, _: None) -> Array:
                u = jnp.clip(jnp.where(active[owner], u, shape), shape - 3.0, shape + 3.0)
                return best_powers(u, L, reference)[1]

            solver = optx.LevenbergMarquardt(rtol=1e-6, atol=1e-6)
            found = optx.least_squares(residual, solver, shape, max_steps=_INNER_STEPS, throw=False)
            shape = jnp.clip(jnp.where(active[owner], found.value, shape), shape - 3.0, shape + 3.0)
        # Reweighting may step to and fro across the solution; shorter steps end that.
        pace = jnp.where(state.step < 8, 1.0, 0.5)
        shape = state.shape + pace * (shape - state.shape)
        power = state.power + pace * (best_powers(shape, L, reference)[0] - state.power)
        moved = _solve_triangular(L, power @ design.means(shape) / reference - 1.0)
        return power, shape, jnp.linalg.norm(moved)

    def step(state: _State) -> _State:
        power, shape, moved = improve(state)
        k = state.step + 1
        at_rest = moved < _TOLERANCE
        reference, covariance = scatter(power, shape)
        chi2, s = _discrepancy(design, covariance, reference, V, dof)
        warmed = (state.phase == _WARM_UP) & (k == len(_WARM_UP_DISCREPANCY))
        ends = at_rest | (k == _OUTER_STEPS)
        plain_ends = (state.phase == _PLAIN) & ends
        incomplete = plain_ends & ~(at_rest & (s == 0.0))
        last_ends = (state.phase == _DISCREPANT) & ends
        phase = jnp.select(
            [warmed, incomplete, plain_ends | last_ends], [_PLAIN, _DISCREPANT, _DONE], state.phase
        )
        discrepancy = jnp.select(
            [phase == _WARM_UP, phase == _DISCREPANT, phase == _DONE],
            # A little more than none, lest a start that happens to fit go round in circles.
            [jnp.asarray(_WARM_UP_DISCREPANCY)[k % 4], jnp.maximum(s, 1e-3), state.discrepancy],
            0.0,
        )
        return _State(
            power=jnp.where(incomplete, state.robust[0], power),
            shape=jnp.where(incomplete, state.robust[1], shape),
            robust=jax.tree.map(lambda new, old: jnp.where(warmed, new, old), (power, shape), state.robust),
            discrepancy=discrepancy,
            phase=phase,
            step=jnp.where(phase == state.phase, k, 0),
            chi2=chi2,
            at_rest=at_rest,
        )

    state = _State(
        power=power,
        shape=shape,
        robust=(power, shape),
        discrepancy=jnp.asarray(_WARM_UP_DISCREPANCY[0]),
        phase=jnp.asarray(_WARM_UP),
        step=jnp.asarray(0),
        chi2=jnp.asarray(jnp.inf),
        at_rest=jnp.asarray(False),
    )
    state = jax.lax.while_loop(lambda state: state.phase != _DONE, step, state)
    reference, covariance = scatter(state.power, state.shape)
    L = _whitener(design, covariance, reference, state.discrepancy)
    whitened = _solve_triangular(L, V / reference - 1.0)
    # Minus twice the Gaussian log-likelihood, to choose among starts.
    cost = jnp.sum(whitened**2) + 2.0 * jnp.sum(jnp.log(jnp.diag(L) * reference))
    converged = state.at_rest & jnp.isfinite(cost)
    return Solution(state.power, state.shape, state.chi2, state.discrepancy, converged, cost)


def non_negative_least_squares(
    A: Float[Array, "m terms"], b: Float[Array, " m"], allowed: Bool[Array, " terms"]
) -> Float[Array, " terms"]:
    """x ≥ 0 that minimizes |Ax − b|, zero where not allowed; differentiable in A and b.

    Principal pivoting (Portugal, Júdice & Vicente 1994): a set of positive entries is changed until all of
    them are positive and no gradient says that another should be. Exchanging all offenders at once
    is fast; Murty's rule, only the last of them, always ends, and takes over after a few rounds.
    """
    size = jnp.sqrt(jnp.sum(A**2, axis=0))
    A = A / size
    normal, target = A.T @ A, A.T @ b

    def solution(positive: Bool[Array, " terms"]) -> Float[Array, " terms"]:
        both = positive[:, None] & positive
        return jnp.linalg.solve(
            jnp.where(both, normal, 0.0) + jnp.diag(jnp.where(positive, 0.0, 1.0)), jnp.where(positive, target, 0.0)
        )

    def offenders(positive: Bool[Array, " terms"]) -> Bool[Array, " terms"]:
        x = solution(positive)
        wanted = target - normal @ x > 1e-12 * jnp.linalg.norm(b)
        return allowed & jnp.where(positive, x < 0.0, wanted)

    def exchange(state: tuple[Array, Array]) -> tuple[Array, Array]:
        positive, k = state
        bad = offenders(positive)
        last = jnp.arange(len(bad)) == len(bad) - 1 - jnp.argmax(bad[::-1])
        return positive ^ jnp.where(k < 5, bad, bad & last), k + 1

    def goes_on(state: tuple[Array, Array]) -> Bool[Array, ""]:
        return jnp.any(offenders(state[0])) & (state[1] < 100)

    positive, _ = jax.lax.while_loop(goes_on, exchange, (allowed, jnp.asarray(0)))
    return jnp.maximum(solution(positive), 0.0) / size


@eqx.filter_jit
def solve(
    design: Design,
    V: Float[Array, "axes m"],
    free: Bool[Array, " terms"],
    active: Bool[Array, "axes terms"],
    power: Float[Array, "axes starts terms"],
    shape: Float[Array, "axes starts shapes"],
) -> Solution:
    """The best of the solutions from several starts, for each axis."""

    def axis(V: Array, active: Array, power: Array, shape: Array) -> Solution:
        found = jax.vmap(lambda v, u: _solve(design, V, free, active, v, u))(power, shape)
        best = jnp.argmin(jnp.where(found.converged, found.cost, jnp.inf))
        return jax.tree.map(lambda x: x[best], found)

    return jax.vmap(axis)(V, active, power, shape)


# Hypothetical powers, in standard deviations from the estimate.
_GRID = np.array([-8, -6, -5, -4, -3, -2.5, -2, -1.5, -1, -0.5, 0, 0.5, 1, 1.5, 2, 2.5, 3, 4, 6, 10, 20, 50, 200.0])


@eqx.filter_jit
def infer(
    design: Design,
    V: Float[Array, "axes m"],
    free: Bool[Array, " terms"],
    active: Bool[Array, "axes terms"],
    solution: Solution,
) -> Inference:
    """Covariance of the parameters, and for each term the data's distance from hypothetical powers.

    The distance is the score statistic: the mean, covariance and derivatives at the hypothesis (the other
    powers adjusted to it), so that it is right at the boundary v = 0 as well as where the scatter grows
    with v. It exists for inactive terms too, whose upper limits it gives.
    """
    return jax.vmap(lambda V, active, s: _infer(design, V, free, active, s))(V, active, solution)


def _infer(
    design: Design, V: Float[Array, " m"], free: Bool[Array, " terms"], active: Bool[Array, " terms"], s: Solution
) -> Inference:
    terms = len(s.power)
    # A power that ended at zero is as good as absent for the others.
    active = active & (s.power > 0.0)
    owner = jnp.asarray([p.term for p in design.shapes], int)
    means, kernels = design.means(s.shape), design.kernels(s.shape)
    by_shape = jax.jacfwd(design.means)(s.shape)  # [terms, m, shapes]

    def analyse(power: Array, estimated: Array) -> tuple[Array, Array, Array]:
        """Parameter covariance and one-step estimate of the powers at a hypothesis."""
        mean = power @ means
        covariance = design.covariance(power, kernels)
        L = _whitener(design, covariance, mean, s.discrepancy)
        D = jnp.concatenate([means.T, jnp.einsum("k,kms->ms", power, by_shape)], axis=1)
        D = _solve_triangular(L, D / mean[:, None]) * estimated
        size = jnp.sqrt(jnp.sum(D**2, axis=0))
        size = jnp.where(size > 0.0, size, 1.0)
        # A zero column (not estimated) gets a unit on the diagonal, and no variance afterwards.
        normal = (D / size).T @ (D / size) + jnp.diag(1.0 - estimated) + 1e-12 * jnp.eye(len(size))
        inverse = jnp.linalg.inv(normal) / (size[:, None] * size)
        step = inverse @ (D.T @ _solve_triangular(L, V / mean - 1.0))
        return inverse * (estimated[:, None] * estimated), step, covariance

    is_active = jnp.concatenate([active & free, active[owner]]).astype(float)
    parameter_covariance, _, estimate_covariance = analyse(s.power, is_active)

    def hypotheses(term: Array) -> tuple[Array, Array]:
        # The term under test is estimated even if inactive; at v = 0 its shape cannot be.
        alone = jnp.arange(terms) == term
        own_shape = owner == term
        estimated = jnp.concatenate([(active & free) | alone, active[owner] & ~own_shape]).astype(float)
        local, _, _ = analyse(s.power, estimated)
        sd = jnp.sqrt(local[term, term])
        powers = jnp.maximum(s.power[term] + jnp.asarray(_GRID) * sd, 0.0)
        slope = jnp.where(estimated[:terms] > 0.0, local[:terms, term] / local[term, term], 0.0)

        def distance(v: Array) -> Array:
            others = jnp.maximum(s.power + slope * (v - s.power[term]), 0.05 * s.power)
            at = jnp.where(alone, v, jnp.where(active, others, 0.0))
            shaped = jnp.where(v > 0.0, 1.0, ~own_shape) * active[owner]
            fitted = jnp.concatenate([estimated[:terms], shaped])
            covariance, step, _ = analyse(at, fitted)
            return step[term] / jnp.sqrt(covariance[term, term])

        return powers, jax.lax.map(distance, powers)

    power_at, pivot_at = jax.vmap(hypotheses)(jnp.arange(terms))
    return Inference(parameter_covariance, estimate_covariance, power_at, pivot_at)

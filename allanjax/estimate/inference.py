"""Covariance of the estimates, and the distance of the data from hypothetical powers of each term."""

from __future__ import annotations

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import gammaln, ndtri
from jaxtyping import Array, ArrayLike, Bool, Float

from allanjax.base.chi_squared import cube_root_score
from allanjax.base.linalg import inverse, non_negative_least_squares
from allanjax.estimate.design import Design
from allanjax.estimate.gls import Solution


class Inference(NamedTuple):
    """Covariance and hypothesis tests of one axis around its estimate.

    `covariance` is that of (powers, shapes); `power_at` and `pivot_at` are, per term, hypothetical powers
    and the data's distance from each as a normal score, positive where the data want more: up to `ESTIMATE`
    those below the estimate, from `ABOVE` on those above. `ceiling` is, per term, a power that the term
    alone rules out, see `ceiling`.
    """

    covariance: Float[Array, "params params"]
    estimate_variance: Float[Array, " m"]
    power_at: Float[Array, "terms grid"]
    pivot_at: Float[Array, "terms grid"]
    ceiling: Float[Array, " terms"]


class _Linearized(NamedTuple):
    """One-step estimates at a hypothesis, linear in the relative residuals of the Allan variances.

    `weights` [params, m] are those of the residuals, `weighted` their product with the residuals' covariance.
    """

    covariance: Float[Array, "params params"]
    step: Float[Array, " params"]
    weights: Float[Array, "params m"]
    weighted: Float[Array, "params m"]
    estimate_variance: Float[Array, " m"]


def _normal_score(t: Float[Array, ""], skewness: Float[Array, ""]) -> Float[Array, ""]:
    """Normal score of a standardized deviation t of a shifted gamma law with this skewness.

    Few clusters make estimates skew, so that a positive t is less surprising than a negative one.
    """
    g = jnp.where(jnp.abs(skewness) > 1e-3, skewness, 1e-3)
    return jnp.sign(g) * cube_root_score(jnp.maximum(1.0 + g * t / 2.0, 0.0), g**2 / 4.0)


# Hypothetical powers, in standard deviations from the estimate; the first is zero power.
_BELOW = np.array([-np.inf, -8.0, -6.0, -5.0, -4.0, -3.0, -2.5, -2.0, -1.5, -1.0, -0.5, 0.0])
# Where the scatter grows with the power, as of few long clusters, limits may be far up.
_NEAR = [0.0, 0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 4.0, 6.0, 10.0]
_ABOVE = np.array([*_NEAR, *10.0 * 2.0 ** np.arange(1, 31)])
#: Indices of the estimate itself, of hypotheses below and above.
ESTIMATE = len(_BELOW) - 1
ABOVE = len(_BELOW)
# Beyond this score no interval's end lies.
_FAR_ENOUGH = -2.0
# Of a ceiling: the chance that it is too low.
_CHANCE = 0.025


@eqx.filter_jit
def infer(
    design: Design,
    V: Float[ArrayLike, "axes m"],
    free: Bool[ArrayLike, " terms"],
    active: Bool[ArrayLike, "axes terms"],
    solution: Solution,
) -> Inference:
    """Covariance of the parameters, and for each term the data's distance from hypothetical powers.

    The first hypothesis is v = 0. Upwards, hypotheses go on until the data refuse one, and the other powers
    are fitted to the data anew at each: far away, where they would have gone along with the term under test
    says nothing. What is not looked at is NaN.

    The distance is the score statistic: the mean, covariance and derivatives at the hypothesis (the other
    powers adjusted to it), so that it is right at the boundary v = 0 as well as where the scatter grows
    with v. It exists for inactive terms too, whose upper limits it gives.
    """
    shared = jnp.asarray(free)
    return jax.vmap(lambda V, active, s: _infer(design, V, shared, active, s))(V, active, solution)


def without_padding(inference: Inference, m: int, terms: int, shapes: int) -> Inference:
    """Inference of so many estimates, terms and shapes, by a design with room for more."""
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

    nothing = jnp.full((terms, len(_BELOW) + len(_ABOVE)), jnp.nan)
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
        has_shape: which shapes the data know: that of a term without power is nowhere in them.
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
        # A zero column (not estimated) gets a unit on the diagonal, and no variance afterwards.
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
        """Distance of the data from these powers, of which that of the term is v, as a normal score."""
        there = self.linearized(at, fitted)
        variance = there.covariance[term, term]
        # Third cumulant of Σ x_j V_j/μ_j: 8 tr(...)³ of quadratic forms, the triple products replaced by
        # pairs, κ_ijk = ⅔(R_ij R_jk + R_jk R_ki + R_ki R_ij); exact for a single estimate (χ²).
        third = 2.0 * jnp.sum(there.weights[term] * there.weighted[term] ** 2)
        # An estimate that cannot be negative is no more skew than a χ² of its own mean and variance.
        skewness = jnp.minimum(third / variance**1.5, 2.0 * jnp.sqrt(variance) / jnp.maximum(v, 1e-300))
        return _normal_score(there.step[term] / jnp.sqrt(variance), skewness)

    def profiled(self, power: Array, allowed: Array) -> Float[Array, " terms"]:
        """Powers of which the allowed ones are fitted to the data, weighted by the covariance at `power`."""
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
            estimated: flags of the parameters that are estimated with it.
        """
        s, active, owner = self.s, self.active, self.owner
        terms = len(s.power)
        local = self.linearized(s.power, estimated).covariance
        sd = jnp.sqrt(local[term, term])
        # A term that is alone cannot vanish altogether.
        least = 1e-9 * s.power[term]
        slope = jnp.where(estimated[:terms] > 0.0, local[:terms, term] / local[term, term], 0.0)
        down = jnp.maximum(s.power[term] + jnp.asarray(_BELOW) * sd, 0.0)
        up = s.power[term] + jnp.asarray(_ABOVE) * sd

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
            reached = scores[k - 1] - jnp.minimum(scores[0], 0.0) < _FAR_ENOUGH
            return (k == 0) | (~reached & (k < len(_ABOVE)))

        nothing = jnp.full(len(_ABOVE), jnp.nan)
        pivots = jax.lax.fori_loop(0, len(_BELOW), below, jnp.zeros_like(down))
        _, further, _ = jax.lax.while_loop(goes_on, above, (jnp.asarray(0), nothing, s.power * active))
        return jnp.concatenate([down, up]), jnp.concatenate([pivots, further])


def ceiling(
    design: Design, V: Float[Array, " m"], means: Float[Array, "terms m"], products: Array, power_error: Array
) -> Float[Array, " terms"]:
    """Upper bound of each term's power, beyond which one of the estimates would be improbably small.

    Other terms can only add to an estimate, so that V ≥ v·mean·e^(power_error·z)·χ²/ν, with a normal z. With
    m estimates the chance of either is `_CHANCE`/2m, and P(χ² < x) < (x/2)^(ν/2)/Γ(ν/2 + 1). The ν are those
    of the term that scatters most.
    """
    each = jax.vmap(lambda power: design.variances(design.covariance(power, products)))(jnp.eye(len(means)))
    relative = jnp.max(jnp.where(means > 0.0, each / means**2, 0.0), axis=0)
    half, chance = 1.0 / jnp.maximum(relative, 1e-9), _CHANCE / (2.0 * design.rows)
    least = (jnp.log(chance) + gammaln(half + 1.0)) / half - jnp.log(half) + power_error * ndtri(chance)
    return jnp.min(jnp.where(means > 0.0, V / means, jnp.inf) * jnp.exp(-least), axis=1)

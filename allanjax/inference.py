"""What the Allan variances say about each coefficient around its estimate."""

from __future__ import annotations

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from allanjax.design import Design
from allanjax.gls import Solution
from allanjax.linalg import inverse, whiten


class Inference(NamedTuple):
    """What the data say about one axis around its estimate.

    `covariance` is that of (powers, shapes); `power_at` and `pivot_at` are, per term, hypothetical powers
    and the standardized distance of the data from each, positive where the data want more.
    """

    covariance: Float[Array, "params params"]
    estimate_covariance: Float[Array, "m m"]
    power_at: Float[Array, "terms grid"]
    pivot_at: Float[Array, "terms grid"]


# Hypothetical powers, in standard deviations from the estimate.
_GRID = np.array(
    [-8, -6, -5, -4, -3, -2.5, -2, -1.5, -1, -0.5, 0, 0.5, 1, 1.5, 2, 2.5, 3, 4, 6, 10, 20, 50, 200.0]
)


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
    design: Design,
    V: Float[Array, " m"],
    free: Bool[Array, " terms"],
    active: Bool[Array, " terms"],
    s: Solution,
) -> Inference:
    terms = len(s.power)
    # A power that ended at zero is as good as absent for the others.
    active = active & (s.power > 0.0)
    owner = jnp.asarray([p.term for p in design.shapes], int)
    means, products = design.means(s.shape), design.products(s.shape)
    by_shape = jax.jacfwd(design.means)(s.shape)  # [terms, m, shapes]

    def analyse(power: Array, estimated: Array) -> tuple[Array, Array, Array]:
        """Parameter covariance and one-step estimate of the powers at a hypothesis."""
        mean = power @ means
        covariance = design.covariance(power, products)
        D = jnp.concatenate([means.T, jnp.einsum("k,kms->ms", power, by_shape)], axis=1)
        residual = V / mean - 1.0
        columns = jnp.concatenate([D / mean[:, None], residual[:, None]], axis=1)
        columns = whiten(design.relative(covariance, mean, s.discrepancy), columns).values
        D, residual = columns[:, :-1] * estimated, columns[:, -1]
        size = jnp.sqrt(jnp.sum(D**2, axis=0))
        size = jnp.where(size > 0.0, size, 1.0)
        # A zero column (not estimated) gets a unit on the diagonal, and no variance afterwards.
        normal = (D / size).T @ (D / size) + jnp.diag(1.0 - estimated) + 1e-12 * jnp.eye(len(size))
        normal_inverse = inverse(normal) / (size[:, None] * size)
        step = normal_inverse @ (D.T @ residual)
        return normal_inverse * (estimated[:, None] * estimated), step, covariance

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

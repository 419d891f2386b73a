"""Normal scores of χ² variates by their cube root, which is nearly normal (Wilson & Hilferty 1931)."""

from __future__ import annotations

import jax.numpy as jnp
from jax.scipy.special import gammaln
from jaxtyping import Array, ArrayLike, Float

# Normal score of p = 10⁻⁶: beyond it a misfit is no matter of chance.
_BEYOND_DOUBT = 4.75


def cube_root_score(ratio: Float[ArrayLike, ...], variance: Float[ArrayLike, ...]) -> Float[Array, ...]:
    """Normal score of a χ² (or gamma) variate over its mean, given the variance of this ratio.

    The usual approximation to the moments of the cube root, mean 1 − variance/9 and variance/9: for few
    degrees of freedom see `exact_cube_root_score`.
    """
    g = jnp.asarray(variance) / 9.0
    return (jnp.cbrt(ratio) - 1.0 + g) / jnp.sqrt(g)


def exact_cube_root_score(ratio: Float[ArrayLike, ...], dof: Float[ArrayLike, ...]) -> Float[Array, ...]:
    """Normal score of a χ² variate over its mean, with the exact moments of the cube root.

    They are E (χ²)^p = 2^p Γ(dof/2 + p)/Γ(dof/2), of which the usual approximation is 15 % off at one degree
    of freedom; beyond a thousand the approximation is exact enough.
    """
    dof = jnp.maximum(jnp.asarray(dof), 1e-3)
    few = jnp.minimum(dof, 1e3) / 2.0
    first, second = (
        jnp.exp(gammaln(few + p) - gammaln(few) - p * jnp.log(few)) for p in (1.0 / 3.0, 2.0 / 3.0)
    )
    g = 2.0 / (9.0 * dof)
    mean = jnp.where(dof < 1e3, first, 1.0 - g)
    return (jnp.cbrt(jnp.asarray(ratio)) - mean) / jnp.sqrt(jnp.where(dof < 1e3, second - first**2, g))


def beyond_doubt(dof: Float[ArrayLike, ""]) -> Float[Array, ""]:
    """χ² that a model which is right exceeds with a probability of 10⁻⁶ only."""
    dof = jnp.asarray(dof)
    g = 2.0 / (9.0 * dof)
    return dof * (1.0 - g + _BEYOND_DOUBT * jnp.sqrt(g)) ** 3

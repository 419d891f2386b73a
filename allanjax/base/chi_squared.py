"""The χ² distribution: tail probabilities, quantiles, and normal scores from the cube root.

The cube root is nearly normal (Wilson & Hilferty 1931). `scipy.stats.chi2` has the same tails and quantiles,
but takes half a second to load.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from allanjax.base.arrays import namespace
from allanjax.base.errors import AllanjaxError

if TYPE_CHECKING:
    # They load JAX.
    from jaxtyping import Array, ArrayLike

# Normal score of p = 10⁻⁶: a larger misfit is not due to chance.
_BEYOND_DOUBT = 4.75
# Smallest tail probability at which normal scores are computed from the distribution itself.
_SMALLEST_TAIL = 1e-14


def upper_tail(x: ArrayLike, dof: ArrayLike) -> Float[np.ndarray, ...]:
    """Probability that a χ² variate exceeds x; NaN without degrees of freedom."""
    from scipy.special import gammaincc

    nu = np.asarray(dof, float)
    return np.where(nu > 0.0, gammaincc(nu / 2.0, np.asarray(x, float) / 2.0), np.nan)


def quantile(probability: ArrayLike, dof: ArrayLike) -> Float[np.ndarray, ...]:
    """Quantile of the χ² distribution at a probability; NaN without degrees of freedom."""
    from scipy.special import gammaincinv

    return 2.0 * gammaincinv(np.asarray(dof, float) / 2.0, np.asarray(probability, float))


def chi_squared_factors(
    dof: ArrayLike, level: float
) -> tuple[Float[np.ndarray, ...], Float[np.ndarray, ...]]:
    """Confidence limits of a variance relative to its estimate, from the χ² distribution."""
    if not 0 < level < 1:
        raise AllanjaxError(f"the confidence level must lie between 0 and 1, not {level}")
    nu = np.asarray(dof)
    return nu / quantile((1 + level) / 2, nu), nu / quantile((1 - level) / 2, nu)


def cube_root_score(ratio: Float[ArrayLike, ...], variance: Float[ArrayLike, ...]) -> Float[Array, ...]:
    """Normal score of the ratio of a χ² (or gamma) variate to its mean, given the variance of the ratio.

    Uses the approximate moments of the cube root, mean 1 − variance/9 and variance/9; for few degrees of
    freedom see `normal_score`.
    """
    xp = namespace(ratio, variance)
    g = xp.asarray(variance) / 9.0
    return (xp.cbrt(ratio) - 1.0 + g) / xp.sqrt(g)


def normal_score(ratio: Float[ArrayLike, ...], dof: Float[ArrayLike, ...]) -> Float[np.ndarray, ...]:
    """Normal score of the ratio of a χ² variate to its mean; in the far tails that of the cube root.

    The cube root has its exact moments there, E (χ²)^p = 2^p Γ(dof/2 + p)/Γ(dof/2). The usual approximation
    is 15 % off at one degree of freedom and accurate enough beyond a thousand.
    """
    from scipy.special import gammainc, gammaincc, gammaln, ndtri

    nu = np.maximum(np.asarray(dof, float), 1e-3)
    x = nu / 2.0 * np.asarray(ratio)
    below, above = gammainc(nu / 2.0, x), gammaincc(nu / 2.0, x)
    few = np.minimum(nu, 1e3) / 2.0
    first, second = (
        np.exp(gammaln(few + p) - gammaln(few) - p * np.log(few)) for p in (1.0 / 3.0, 2.0 / 3.0)
    )
    g = 2.0 / (9.0 * nu)
    mean, variance = np.where(nu < 1e3, [first, second - first**2], [1.0 - g, g])
    far = (np.cbrt(np.asarray(ratio)) - mean) / np.sqrt(variance)
    central = np.minimum(below, above) > _SMALLEST_TAIL
    return np.where(central, np.where(below < above, ndtri(below), -ndtri(above)), far)


def beyond_doubt(dof: Float[ArrayLike, ""]) -> Float[Array, ""]:
    """Value of χ² that a correct model exceeds with a probability of only 10⁻⁶."""
    xp = namespace(dof)
    dof = xp.asarray(dof)
    g = 2.0 / (9.0 * dof)
    return dof * (1.0 - g + _BEYOND_DOUBT * xp.sqrt(g)) ** 3

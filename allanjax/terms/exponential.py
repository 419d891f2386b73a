"""Autocovariances that decay exponentially, R(t) = Re[c·e^{λ|t|}]: their G, and the spectrum of samples."""

from __future__ import annotations

import math

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float, Num

from allanjax.terms.base import in_gauge


def exponential_remainder(z: Num[Array, ...]) -> Num[Array, ...]:
    """e^z − 1 − z, up to a multiple of z² common to the call (see `in_gauge`); real or complex."""

    def series(z: Num[Array, ...]) -> Num[Array, ...]:
        total = jnp.zeros_like(z)
        for k in range(19, 2, -1):
            total = total * z + 1.0 / math.factorial(k)
        return total * z**3

    return in_gauge(series, lambda z: jnp.expm1(z) - z, z)


def exponential_covariance(
    pole: Num[Array, ""], weight: Num[ArrayLike, ""], lag: Float[Array, ...], sample_interval: float
) -> Float[Array, ...]:
    """Phase covariance G at lags [s] of R(t) = Re[weight·e^{pole·t}], pole in 1/s with a negative real part.

    G is −R integrated twice, or, with a sample interval [s], summed twice: its second difference at multiples
    of that is −sample_interval²·R exactly.
    """
    remainder = exponential_remainder(pole * lag)
    t0 = sample_interval
    if t0 == 0.0:
        return -jnp.real(weight / pole**2 * remainder)
    kappa = weight * t0**2 / (4.0 * jnp.sinh(pole * t0 / 2.0) ** 2)
    slope = jnp.real(kappa * (jnp.expm1(pole * t0) - pole * t0)) / t0 - t0 * jnp.real(weight) / 2.0
    return slope * lag - jnp.real(kappa * remainder)


def exponential_density(
    pole: Num[Array, ""], weight: Num[ArrayLike, ""], frequency: Float[ArrayLike, ...], rate: float
) -> Float[Array, ...]:
    """Two-sided PSD at frequencies [Hz] of R(t) = Re[weight·e^{pole·t}] read at the sample instants.

    The geometric series of R(d/rate).
    """
    a = 2.0 * jnp.pi * jnp.asarray(frequency) / rate
    up, down = (-jnp.expm1(pole / rate + sign * 1j * a) for sign in (1.0, -1.0))
    return jnp.real(weight * (1.0 / up + 1.0 / down - 1.0)) / rate

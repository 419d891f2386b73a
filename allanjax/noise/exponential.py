"""Exponential autocovariances R(t) = Re[c·e^{λ|t|}]: their phase covariance G and spectrum as sampled."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from jaxtyping import Array, ArrayLike, Float, Num

from allanjax.base.arrays import namespace
from allanjax.noise.numerics import in_gauge


def exponential_remainder(z: Num[Array, ...]) -> Num[Array, ...]:
    """Remainder e^z − 1 − z, up to a multiple of z² common to the call (see `in_gauge`); real or complex."""

    xp = namespace(z)

    def series(z: Num[Array, ...]) -> Num[Array, ...]:
        total = xp.zeros_like(z)
        for k in range(19, 2, -1):
            total = total * z + 1.0 / math.factorial(k)
        return total * z**3

    return in_gauge(series, lambda z: xp.expm1(z) - z, z)


def is_continuous(sample_interval: Any) -> bool:
    """Whether a sample interval stands for the continuous rate, 0; one that is traced does not."""
    return isinstance(sample_interval, float) and sample_interval == 0.0


def exponential_covariance(
    pole: Num[Array, ""], weight: Num[ArrayLike, ""], lag: Float[Array, ...], sample_interval: float
) -> Float[Array, ...]:
    """Phase covariance G at lags [s] of R(t) = Re[weight·e^{pole·t}], pole in 1/s with a negative real part.

    G is −R integrated twice, or, with a sample interval [s], summed twice: its second difference at multiples
    of that is −sample_interval²·R exactly.
    """
    xp = namespace(pole, weight, lag)
    remainder = exponential_remainder(pole * lag)
    t0 = sample_interval
    if is_continuous(t0):
        return -xp.real(weight / pole**2 * remainder)
    kappa = weight * t0**2 / (4.0 * xp.sinh(pole * t0 / 2.0) ** 2)
    slope = xp.real(kappa * (xp.expm1(pole * t0) - pole * t0)) / t0 - t0 * xp.real(weight) / 2.0
    return slope * lag - xp.real(kappa * remainder)


def averaged_lags(x: Any) -> tuple[Any, Any]:
    """Autocovariance of averages over an interval of x correlation times, at lags 0 and 1 interval.

    Of R(t) = e^{−|t|}, t in correlation times; that at d intervals is the second times e^{−x(d − 1)}.
    """
    xp = namespace(x)
    # (e^{-x} − 1 + x)/x², by a series where that would cancel.
    at_zero = xp.where(
        x < 1e-3, 1.0 - x / 3.0 + x**2 / 12.0, 2.0 * (x + xp.expm1(-x)) / xp.maximum(x, 1e-3) ** 2
    )
    return at_zero, (xp.expm1(-x) / x) ** 2


def mean_lags(x: Any, M: Any) -> tuple[Any, Any, Any]:
    """Autocovariance of means of M readings of R_k = e^{x·|k|}, at lags 0 and 1 mean; and 1 − e^{Mx}.

    With q = e^x: r_0 = [M(1 + q)/(1 − q) − 2q(1 − q^M)/(1 − q)²]/M² and, from d = 1 on,
    r_d = q^{M(d−1)}·q(1 − q^M)²/(M(1 − q))², a geometric series.
    """
    xp = namespace(x, M)
    q, y, z = xp.exp(x), -xp.expm1(x), -xp.expm1(M * x)
    # A series where the terms of r_0 would cancel.
    series = 1.0 + x * (M**2 - 1.0) / (3.0 * M) + x**2 * (M**2 - 1.0) / 12.0
    r_0 = xp.where(xp.abs(M * x) < 1e-3, series, ((1.0 + q) / (M * y)) - 2.0 * q * z / (M * y) ** 2)
    return r_0, q * (z / (M * y)) ** 2, z


def exponential_density(
    pole: Num[ArrayLike, ""],
    weight: Num[ArrayLike, ""],
    frequency: Float[ArrayLike, ...],
    rate: float,
    sample_interval: float,
) -> Float[Array, ...]:
    """Two-sided PSD at frequencies [Hz] of R(t) = Re[weight·e^{pole·t}] read at the sample instants.

    Samples at `rate` are means of M readings, a sample interval [s] apart, see `mean_lags`. M is 1 at the
    readings' own rate, and for a sample interval of 0.
    """
    xp = namespace(pole, weight, frequency, rate, sample_interval)
    M = 1.0 if is_continuous(sample_interval) else 1.0 / (rate * sample_interval)
    r_0, r_1, z = mean_lags(pole / rate / M, M)
    # Σ_d Q^{d−1}·2 cos(ad) = 2(cos a − Q)/(1 − 2Q cos a + Q²), Q = 1 − z = q^M, by what is small near Q = 1.
    s = xp.sin(np.pi * xp.asarray(frequency) / rate) ** 2
    below = z**2 + 4.0 * (1.0 - z) * s
    both = 2.0 * (z - 2.0 * s) * xp.conj(below) / (xp.real(below) ** 2 + xp.imag(below) ** 2)
    return xp.real(weight * (r_0 + r_1 * both)) / rate

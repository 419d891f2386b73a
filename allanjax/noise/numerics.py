"""Densities and covariances of samples, computed from a phase covariance G(t) alone."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import erfc
from jaxtyping import Array, Float, Num, PRNGKeyArray

from allanjax.base.arrays import namespace

#: G at lags ≥ 0 [s].
PhaseCovariance: TypeAlias = Callable[[Float[Array, "..."]], Float[Array, "..."]]

# Lags that `sampled_density` sums one by one; beyond, it replaces the sum by an integral.
_SINGLE_LAGS = 512


def _derivative(function: Callable[[Array], Array]) -> Callable[[Array], Array]:
    """Derivative of an elementwise function, from one call so that it keeps to one gauge."""
    return lambda x: jax.jvp(function, (x,), (jnp.ones_like(x),))[1]


def _second_difference(x: Float[Array, " k"]) -> Float[Array, " k-2"]:
    return x[2:] - 2.0 * x[1:-1] + x[:-2]


def gaussian_sequence(key: PRNGKeyArray, autocovariance: Float[Array, " half+1"]) -> Float[Array, " 2*half"]:
    """Stationary Gaussian sequence on a circle of 2·half samples with this autocovariance.

    Successive samples up to half + 1 of them are a draw of the process on a line (circulant embedding).
    """
    half = autocovariance.shape[0] - 1
    circle = jnp.concatenate([autocovariance, autocovariance[-2:0:-1]])
    # A true embedding has eigenvalues ≥ 0; rounding leaves some at −1e-16 of the largest.
    eigenvalues = jnp.maximum(jnp.fft.rfft(circle).real, 0.0)
    # The transform of real white noise is complex white noise, but real at its two ends.
    real, imaginary = jax.random.normal(key, (2, half + 1))
    ends = (jnp.arange(half + 1) % half) == 0
    noise = jnp.where(ends, real, jax.lax.complex(real, imaginary) / jnp.sqrt(2.0))
    return jnp.fft.irfft(jnp.sqrt(2.0 * half * eigenvalues) * noise, 2 * half)


def in_gauge(small: Callable, large: Callable, x: Num[Array, ...]) -> Num[Array, ...]:
    """Value of `small(x)` if all of x is below one in magnitude, else of `large(x)`.

    The two must differ by c0 + c1·x² only. Near zero that difference would swallow the digits that
    survive the second difference, far out it would dominate them; so the whole call takes one side.
    """
    xp = namespace(x)
    is_small = xp.max(xp.abs(x)) < 1.0
    if xp is np:
        return small(x) if is_small else large(x)
    return jnp.where(is_small, small(jnp.where(is_small, x, jnp.zeros_like(x))), large(x))


def sampled_density(G_of: PhaseCovariance, a: Float[Array, ""], rate: float) -> Float[Array, ""]:
    """Two-sided PSD of samples at `rate` [Hz], at a radians per sample, from their phase covariance.

    Lags are taken singly at first, then in stretches that grow up to half a period, as integrals. H need
    not decay: the sum fades out smoothly over many periods, which leaves what oscillates untouched.
    """
    h = 1.0 / rate

    def fading(d: Array) -> Array:
        return erfc(4.0 * (d * a / (12.0 * jnp.pi) - 2.0)) / 2.0

    G = G_of(jnp.arange(_SINGLE_LAGS + 2) * h)
    single = -_second_difference(jnp.concatenate([G[1:2], G])) / h**2
    lag = jnp.arange(_SINGLE_LAGS + 1)
    total = jnp.sum(jnp.where(lag > 0, 2.0, 1.0) * single * fading(lag) * jnp.cos(a * lag))

    def summand(d: Array) -> Array:
        # Another call may have another gauge: it is matched at the last single lag.
        H = -_derivative(_derivative(G_of))(jnp.append(d, _SINGLE_LAGS) * h)
        return 2.0 * (H[:-1] - H[-1] + single[-1]) * fading(d) * jnp.cos(a * d)

    x, w = np.polynomial.legendre.leggauss(12)
    growing = jnp.minimum(_SINGLE_LAGS * 1.5 ** jnp.arange(22.0), jnp.pi / a)
    lengths = jnp.append(growing, jnp.full(36, jnp.pi / a))
    starts = _SINGLE_LAGS + 0.5 + jnp.append(0.0, jnp.cumsum(lengths))
    d = starts[:-1, None] + lengths[:, None] * (x + 1.0) / 2.0
    integral = jnp.dot((lengths[:, None] / 2.0 * w).ravel(), summand(d.ravel()))
    # Euler and Maclaurin's first correction, of a sum over the integers that starts half a step before.
    correction = _derivative(summand)(starts[:1])[0] / 24.0
    return (total + integral + correction) / rate


def increment_autocovariance(G_of: PhaseCovariance, n: int, rate: float) -> Float[Array, " n"]:
    """Autocovariance of x[k+1] − x[k] at lags 0 … n−1 samples: the fourth difference of G.

    Rounding of a growing G drowns that difference at long lags. Where G is smooth over a sample, its
    inner second difference is therefore expanded, δ²G = h²G⁽²⁾ + h⁴G⁽⁴⁾/12 + h⁶G⁽⁶⁾/360 + …, with
    δ²G⁽⁴⁾ for h²G⁽⁶⁾, and only the outer one is taken.
    """
    h = 1.0 / rate
    lag = jnp.arange(n + 2) * h
    G = G_of(lag)
    both_sides = jnp.concatenate([G[2:0:-1], G])
    direct = jnp.convolve(both_sides, jnp.asarray([1.0, -4.0, 6.0, -4.0, 1.0]), mode="valid") / h**2

    # From lag 1 on: G may have a kink at zero, where no derivative exists.
    second = _derivative(_derivative(G_of))
    G2, G4 = second(lag[1:]), _derivative(_derivative(second))(lag[1:])
    last = _second_difference(h**4 * G4) / 360.0
    inner = (h**2 * G2 + h**4 * G4 / 12.0)[1:-1] + last
    expanded = jnp.pad(_second_difference(inner) / h**2, (3, 0))
    # The truncation error is far less than the last term of the expansion.
    error = jnp.pad(jnp.abs(_second_difference(last)) / h**2, (3, 0), constant_values=jnp.inf)
    rounding = 64.0 * jnp.finfo(float).eps * jax.lax.cummax(jnp.abs(G))[2:] / h**2
    return jnp.where(error <= jnp.maximum(1e-9 * jnp.abs(expanded), rounding), expanded, direct)

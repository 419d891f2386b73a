"""Noise as a process: one phase covariance, from which everything else follows.

Let θ(t) be the running integral of the rate output (angle of a gyro, velocity of an accelerometer). Every
random term of the thesis has stationary second differences of θ, so it is described completely by a
generalized covariance G(t): for filters a, b with Σa = Σa·t = 0,

    cov(Σ a_p θ(t_p), Σ b_q θ(t_q)) = Σ_p Σ_q a_p b_q G(t_p − t_q).

G is known only up to c0 + c1·t², which such filters remove.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, ClassVar, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import erfc
from jaxtyping import Array, ArrayLike, Float, Num, PRNGKeyArray

from allanjax.base.arrays import as_array, namespace
from allanjax.base.errors import AllanjaxError
from allanjax.base.module import Module

#: Real numbers in an array of any shape, such as a spectrum, and what may be made one, such as frequencies.
Reals: TypeAlias = Float[Array, "..."]
RealsLike: TypeAlias = Float[ArrayLike, "..."]
#: Samples of one axis.
Samples: TypeAlias = Float[Array, " n"]
#: G at lags ≥ 0 [s].
PhaseCovariance: TypeAlias = Callable[[Reals], Reals]

# Lags that `sampled_density` sums one by one; beyond, it replaces the sum by an integral.
_SINGLE_LAGS = 512


def _derivative(function: Callable[[Array], Array]) -> Callable[[Array], Array]:
    """Derivative of an elementwise function, from one call so that it keeps to one gauge."""
    return lambda x: jax.jvp(function, (x,), (jnp.ones_like(x),))[1]


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
    """Value of `small(x)` where all of x along its last axis is below one in magnitude, else of `large(x)`.

    The two must differ by c0 + c1·x² only. Near zero that difference would swallow the digits that
    survive the second difference, far out it would dominate them; so all of a row takes one side.
    """
    xp = namespace(x)
    is_small = xp.max(xp.abs(xp.atleast_1d(x)), axis=-1, keepdims=x.ndim > 0) < 1.0
    if xp is np and is_small.all():
        return small(x)
    return xp.where(is_small, small(xp.where(is_small, x, 0.0)), large(x))


def sampled_density(G_of: PhaseCovariance, a: Float[Array, ""], rate: float) -> Float[Array, ""]:
    """Two-sided PSD of samples at `rate` [Hz], at a radians per sample, from their phase covariance.

    Lags are taken singly at first, then as integrals over intervals that grow up to half a period. H need not
    decay: the sum fades out smoothly over many periods, which leaves oscillations untouched.
    """
    h = 1.0 / rate

    def fading(d: Array) -> Array:
        return erfc(4.0 * (d * a / (12.0 * jnp.pi) - 2.0)) / 2.0

    G = G_of(jnp.arange(_SINGLE_LAGS + 2) * h)
    single = -jnp.diff(jnp.concatenate([G[1:2], G]), 2) / h**2
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
    # The first Euler–Maclaurin correction, for a sum over the integers that starts half a step before.
    correction = _derivative(summand)(starts[:1])[0] / 24.0
    return (total + integral + correction) / rate


def increment_autocovariance(G_of: PhaseCovariance, n: int, rate: float) -> Samples:
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
    last = jnp.diff(h**4 * G4, 2) / 360.0
    inner = (h**2 * G2 + h**4 * G4 / 12.0)[1:-1] + last
    expanded = jnp.pad(jnp.diff(inner, 2) / h**2, (3, 0))
    # The truncation error is far less than the last term of the expansion.
    error = jnp.pad(jnp.abs(jnp.diff(last, 2)) / h**2, (3, 0), constant_values=jnp.inf)
    rounding = 64.0 * jnp.finfo(float).eps * jax.lax.cummax(jnp.abs(G))[2:] / h**2
    return jnp.where(error <= jnp.maximum(1e-9 * jnp.abs(expanded), rounding), expanded, direct)


def exponential_remainder(z: Num[Array, ...]) -> Num[Array, ...]:
    """Remainder e^z − 1 − z, up to a multiple of z² common to a row (see `in_gauge`); real or complex."""

    xp = namespace(z)

    def series(z: Num[Array, ...]) -> Num[Array, ...]:
        total = xp.zeros_like(z)
        for k in range(19, 2, -1):
            total = total * z + 1.0 / math.factorial(k)
        return total * z**3

    return in_gauge(series, lambda z: xp.expm1(z) - z, z)


def is_continuous(sample_interval: Any) -> bool:
    """Whether a sample interval is 0, for the continuous rate; a traced one is not."""
    return isinstance(sample_interval, float) and sample_interval == 0.0


def exponential_covariance(
    pole: Num[Array, ""], weight: Num[ArrayLike, ""], lag: Reals, sample_interval: float
) -> Reals:
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
    frequency: RealsLike,
    rate: float,
    sample_interval: float,
) -> Reals:
    """Two-sided PSD at frequencies [Hz] of R(t) = Re[weight·e^{pole·t}] read at the sample instants.

    Samples at `rate` are means of M readings, a sample interval [s] apart, see `mean_lags`. M is 1 at the
    readings' own rate, and for a sample interval of 0.
    """
    xp = namespace(pole, weight, frequency, rate, sample_interval)
    M = 1.0 if is_continuous(sample_interval) else 1.0 / (rate * sample_interval)
    r_0, r_1, z = mean_lags(pole / rate / M, M)
    # Σ_d Q^{d−1}·2 cos(ad) = 2(cos a − Q)/(1 − 2Q cos a + Q²), Q = 1 − z = q^M, in terms small near Q = 1,
    # and in real arithmetic, which is faster.
    s = xp.sin(np.pi * xp.asarray(frequency) / rate) ** 2
    square, slope, own = z**2, 4.0 * (1.0 - z), 2.0 * weight * r_1
    re, im = xp.real(square) + xp.real(slope) * s, xp.imag(square) + xp.imag(slope) * s
    first, second = own * z, -2.0 * own
    above = (xp.real(first) + xp.real(second) * s) * re + (xp.imag(first) + xp.imag(second) * s) * im
    return (xp.real(weight * r_0) + above / (re**2 + im**2)) / rate


def linear_recurrence(factor: Num[ArrayLike, ""], drive: Num[Array, " n"]) -> Num[Array, " n"]:
    """Solution of y[k] = factor·y[k−1] + drive[k], y[−1] = 0; real or complex.

    The record is cut into many short blocks that are computed side by side (one vector operation per step);
    then the blocks' last values recur, and each block receives the contribution of its predecessors.
    """
    n = drive.shape[0]
    length = max(1, int(n**0.5))
    blocks = -(-n // length)
    columns = jnp.pad(drive, (0, blocks * length - n)).reshape(blocks, length).T
    factor = jnp.asarray(factor, drive.dtype)

    def step(y: Array, x: Array) -> tuple[Array, Array]:
        y = factor * y + x
        return y, y

    last, within = jax.lax.scan(step, jnp.zeros(blocks, drive.dtype), columns)
    powers = jnp.cumprod(jnp.full(length, factor))

    def carry_on(carried: Array, end: Array) -> tuple[Array, Array]:
        return powers[-1] * carried + end, carried

    _, carried = jax.lax.scan(carry_on, jnp.zeros((), drive.dtype), last)
    return (within + powers[:, None] * carried).T.reshape(-1)[:n]


class Poles(NamedTuple):
    """Sum of c(1 − w²)/D(w) over poles w, complex ones in pairs: a power response, or a density of samples.

    Attributes:
        pole: the w of each.
        weight: the c of each.
    """

    pole: Any
    weight: Any


#: A sum without poles.
NO_POLES = Poles(np.zeros(0), np.zeros(0))


class Parts(NamedTuple):
    """Density of samples [rate²] in parts: white + difference·4s + walk/4s + poles."""

    white: Any
    difference: Any
    walk: Any
    poles: Poles

    def phase_covariance(self, lag: Reals, rate: float) -> Reals:
        """Phase covariance G at lags [s] that are multiples of 1/rate; between them it is interpolated."""
        xp = namespace(self, lag)
        h = 1.0 / rate
        linear = (self.white + self.walk / 6.0) * h * lag / 2.0
        total = self.difference * h**2 * (lag == 0.0) + self.walk * lag**3 / (12.0 * h) - linear
        rates = xp.log(self.poles.pole) * rate

        def one(pole: Any, weight: Any) -> Any:
            return exponential_covariance(pole, weight, lag, h)

        if xp is jnp:
            return total + jnp.sum(jax.vmap(one)(rates, self.poles.weight), axis=0)
        return total + sum(map(one, rates, self.poles.weight))


# Samples of the smallest half circle on which oscillating noise is drawn: on one shorter than its memory its
# covariance would have negative eigenvalues.
_LEAST_CIRCLE = 1 << 16


@jax.jit
def _summed_density(process: Process, angle: Float[Array, " f"], rate: float) -> Float[Array, " f"]:
    """Density of the samples [rate²/Hz] at angular frequencies per sample, summed numerically."""
    return jax.vmap(lambda a: sampled_density(process.phase_covariance, a, rate))(angle)


class Process(Module):
    """A random process with a phase covariance, and its Allan variance, spectrum and simulation."""

    #: True for a line, a ramp, a step: the same in every record, so that its square does not scatter.
    deterministic: ClassVar[bool] = False
    #: True if the term oscillates for long: all its power fluctuates together, see `power_scatter`.
    narrow_band: ClassVar[bool] = False

    def phase_covariance(self, lag: Reals) -> Reals:
        """Generalized covariance G [rad² or (m/s)²] of the integrated rate at lags ≥ 0 [s].

        Known up to c0 + c1·t², two constants that the lags along the last axis of a call have in common.
        """
        raise NotImplementedError(f"{type(self).__name__} does not define phase_covariance(lag)")

    def psd(self, frequency: RealsLike) -> Reals:
        """Two-sided power spectral density of the rate, (rad/s)²/Hz or (m/s²)²/Hz, at frequencies [Hz].

        Zero for a line, whose power is all at its own frequency, and for what happens once.
        """
        if self.deterministic:
            return namespace(self, frequency).zeros(np.shape(frequency))
        raise NotImplementedError(f"{type(self).__name__} does not define psd(frequency)")

    def sampled_psd(self, frequency: RealsLike, rate: float) -> Reals:
        """Two-sided PSD of the samples with aliases, (rad/s)²/Hz or (m/s²)²/Hz, up to the Nyquist frequency.

        The samples are means over 1/rate, so that minus the second difference of G takes the place of
        their autocovariance H, and S(f) = Σ_d H(d) cos(2πf·d/rate) / rate. This default sums it numerically
        over a dozen periods, enough for a covariance that is smooth or has ended by then; narrow-band terms
        and those with a closed form override it. Zero for a deterministic term.
        """
        xp, f = as_array(frequency, self, rate)
        if self.deterministic:
            return xp.zeros(f.shape)
        # With derivatives of G, which are JAX's.
        return _summed_density(self, 2.0 * np.pi * f.ravel() / rate, rate).reshape(f.shape)

    def simulate(self, key: PRNGKeyArray, n: int, rate: float) -> Samples:
        """Simulated samples of the rate (n means over sample intervals) at `rate` [Hz], exact in law.

        The default draws the increments of the rate, whose autocovariance is that of the second difference
        of θ, by circulant embedding (Davies & Harte 1987), and adds them up from zero: the level itself has
        no law when the term is not stationary.
        """
        from scipy.fft import next_fast_len

        half = next_fast_len(max(n, _LEAST_CIRCLE if self.oscillates else 2), real=True)
        autocovariance = increment_autocovariance(self.phase_covariance, half + 1, rate)
        return linear_recurrence(1.0, gaussian_sequence(key, autocovariance)[:n])

    def parts(self, rate: float) -> Parts:
        """Parts of the density of samples at `rate` [Hz], for filtering by a `Response`."""
        name = type(self).__name__
        raise AllanjaxError(
            f"{name} cannot pass through a response: write it after the filter, response * (…) + {name}(…)"
        )

    @property
    def oscillates(self) -> bool:
        """Whether G oscillates with a period of its own, so that sums over lags need more nodes."""
        return self.narrow_band

    def end_effect(self, frequency: RealsLike, rate: float) -> Reals:
        """Power [rate²] that a record's two ends add to its cosine spectrum, times its number of samples.

        It spreads over all frequencies, and matters for terms whose own density falls off towards low ones.
        Zero unless overridden; see `cosine` for the lowest frequencies, where it is never neglected.
        """
        return namespace(self, frequency).zeros(np.shape(frequency))

    def power_scatter(self, duration: Float[ArrayLike, ""]) -> Float[Array, ""]:
        """Relative variance of a narrow-band process's mean square over a record of this duration [s]."""
        raise NotImplementedError(f"{type(self).__name__} is narrow-band and must define power_scatter")

    def allan_variance(self, cluster_time: RealsLike) -> Reals:
        """Allan variance [rate²] at cluster times [s]: [6G(0) − 8G(T) + 2G(2T)]/(2T²)."""
        return self._filter_variance(cluster_time, (6.0, -8.0, 2.0), 2.0)

    def hadamard_variance(self, cluster_time: RealsLike) -> Reals:
        """Hadamard variance [rate²] at cluster times [s]: [20G(0) − 30G(T) + 12G(2T) − 2G(3T)]/(6T²)."""
        return self._filter_variance(cluster_time, (20.0, -30.0, 12.0, -2.0), 6.0)

    @np.errstate(divide="ignore", invalid="ignore")
    def _filter_variance(self, cluster_time: RealsLike, weights: Sequence[float], divisor: float) -> Reals:
        """Weighted sum of G at 0, 1, … cluster times, over divisor·T²."""
        xp, T = as_array(cluster_time, self)
        G = self.phase_covariance(T[..., None] * xp.arange(len(weights)))
        return G @ xp.asarray(weights) / (divisor * T**2)


def numbers_as_data(processes: tuple[Process, ...]) -> tuple[Process, ...]:
    """Processes whose numbers are arrays, so that other values need no compilation of a jitted function.

    Infinite values, such as a cutoff, select a formula and stay numbers.
    """
    return jax.tree.map(lambda x: np.asarray(x) if isinstance(x, float) and abs(x) < np.inf else x, processes)

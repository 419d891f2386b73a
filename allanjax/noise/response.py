"""Responses: filters that the samples of a sensor have passed, and noise after them.

The power response of a filter with poles w_i, at s = sin²(πf/rate), is a sum of c_i(1 − w_i²)/D(w_i) with
D(w) = (1 − w)² + 4ws; so is the density of noise with exponential covariances, but for parts that are white
(1), a difference (4s) or a walk (1/4s). Products are split into parts of the same kind by partial fractions,

    (1 − Q²)/D(Q) · c(1 − w²)/D(w) = α(1 − Q²)/D(Q) + β(1 − w²)/D(w),

    α = c(1 − w²)Q/[(Q − w)(1 − Qw)],    β = −c(1 − Q²)w/[(Q − w)(1 − Qw)],

each of which has its phase covariance in closed form. A filter with zeros at half the sample rate has a
constant part, too: its numerator is of the same degree in s as its denominator.
"""

from __future__ import annotations

import abc
import functools
import math
from typing import Any, Self, TypeAlias

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, PRNGKeyArray

from allanjax.base.arrays import as_array, namespace
from allanjax.base.errors import AllanjaxError
from allanjax.noise.parameter import Parametrized, Value, option, parameter
from allanjax.noise.process import (
    Parts,
    Poles,
    Process,
    Reals,
    RealsLike,
    Samples,
    is_continuous,
    linear_recurrence,
)

#: Coefficients b and a of a digital filter, see `Response.transfer`.
Transfer: TypeAlias = tuple[Float[np.ndarray, " q"], Float[np.ndarray, " p"]]


class Response(Parametrized):
    """A filter that noise passes, written as a factor: `LowPass1(28.0) * (AngleRandomWalk() + Markov())`.

    It acts on the samples, and is 1 at frequency zero, so that coefficients of slow noise are those of the
    sensor without it.
    """

    @abc.abstractmethod
    def power(self, frequency: RealsLike, rate: float) -> Reals:
        """Power response at frequencies [Hz] for samples at `rate` [Hz]."""

    @abc.abstractmethod
    def phase_covariance(self, process: Any, lag: Reals, rate: float) -> Reals:
        """Phase covariance G of a `Process` after the filter, at lags [s] for samples at `rate` [Hz]."""

    @abc.abstractmethod
    def filtered(self, x: Samples, rate: float) -> Samples:
        """Samples after the filter, which starts at rest."""

    def transfer(self, rate: float) -> Transfer:
        """Coefficients b and a of y_k = Σ b_j x_{k−j} − Σ_{j≥1} a_j y_{k−j}, a_0 = 1, at `rate` [Hz].

        Any filter with the same power response would do: noise after it has the same law.
        """
        raise AllanjaxError(
            f"{self.name()} has no finite state space: define its transfer(rate), or leave the response out"
        )

    @property
    def half_power(self) -> float:
        """Frequency at which the power response, as that of an analog filter, has fallen by half [Hz]."""
        bandwidth = float(getattr(self, self.parameters()[0].name))
        if not hasattr(self, "quality_factor"):
            return bandwidth
        # Of two poles, |1 − x² + ix/Q|² = 2.
        middle = 1.0 - 0.5 / float(self.quality_factor) ** 2
        return bandwidth * math.sqrt(middle + math.hypot(middle, 1.0))

    @property
    def ahead(self) -> int:
        """Number of later samples that a filtered sample depends on; 0 for a causal filter."""
        return 0

    def sampled(self, rate: float) -> Self:
        """The filter for samples at `rate` [Hz]; AllanjaxError if there is none."""
        return self


class RecursiveFilter(Response):
    """A response that has poles, and a bandwidth."""

    bandwidth: eqx.AbstractVar[Value]

    def _angle(self, rate: float) -> Any:
        """Bandwidth in radians per sample interval."""
        return 2.0 * math.pi * namespace(self, rate).asarray(self.bandwidth, float) / rate

    @abc.abstractmethod
    def poles(self, rate: float) -> Poles:
        """Poles of the power response for samples at `rate` [Hz]."""

    def constant(self, rate: float) -> Float[ArrayLike, ""]:
        """The constant part of the power response besides its poles; 0 unless a filter overrides it."""
        return 0.0

    def power(self, frequency: RealsLike, rate: float) -> Reals:
        """Power response at frequencies [Hz] for samples at `rate` [Hz]."""
        xp, f = as_array(frequency, self, rate)
        s = xp.sin(math.pi * f / rate) ** 2
        # A filter's parameters may be arrays that broadcast against the frequencies.
        w, c = (x[(..., *(None,) * (s.ndim + 1 - x.ndim))] for x in self.poles(rate))
        of_poles = xp.sum(c * (1.0 - w**2) / ((1.0 - w) ** 2 + 4.0 * w * s), axis=0)
        return xp.real(of_poles) + self.constant(rate)

    def phase_covariance(self, process: Any, lag: Reals, rate: float) -> Reals:
        """Phase covariance G, after the filter, of a process with the method `parts(rate)`."""
        change = self.change(process.parts(rate), rate)
        return process.phase_covariance(lag) + change.phase_covariance(lag, rate)

    def change(self, parts: Parts, rate: float) -> Parts:
        """Density after the filter less the density before it."""
        xp = namespace(self, parts, rate)
        w, c = self.poles(rate)
        constant = self.constant(rate)
        Q, W = (x[:, None] for x in parts.poles)
        apart = (Q - w) * (1.0 - Q * w)
        inside = W[:, 0] * (xp.sum(c * (1.0 - w**2) * Q / apart, axis=1) + constant - 1.0)
        own = c * (parts.white - parts.difference * (1.0 - w) ** 2 / w - parts.walk * w / (1.0 - w) ** 2)
        own = own - xp.sum(W * (1.0 - Q**2) * c * w / apart, axis=0)
        return Parts(
            white=xp.real(xp.sum(parts.difference * c * (1.0 - w**2) / w)) + (constant - 1.0) * parts.white,
            difference=(constant - 1.0) * parts.difference,
            # The response is 1 at frequency zero, poles and constant together.
            walk=0.0,
            poles=Poles(xp.concatenate([Q[:, 0], w]), xp.concatenate([inside, own])),
        )


def one_pole(wc: Any) -> Poles:
    """Poles of the power response of one pole at the bandwidth ω_c [radians per sample]."""
    w = namespace(wc).exp(-wc)[None] + 0j
    return Poles(w, (1.0 - w) / (1.0 + w))


def two_poles(wc: Any, quality: Any) -> Poles:
    """Poles of the power response of a damped oscillator of the frequency ω_c [radians per sample]."""
    xp = namespace(wc, quality)
    decay = wc / (2.0 * quality)
    wd = xp.sqrt(wc**2 - decay**2)
    w, c = xp.exp(-decay + 1j * wd), 1.0 - 1j * decay / wd
    c = c / xp.real(c * (1.0 + w) / (1.0 - w))
    return Poles(xp.stack([w, xp.conj(w)]), xp.stack([c, xp.conj(c)]) / 2.0)


class LowPass1(RecursiveFilter):
    """Low-pass filter of one pole, y_k = w·y_{k−1} + (1 − w)·x_k with w = exp(−2πf_c/rate).

    `bandwidth` f_c in Hz, at which the power of slow noise is halved if f_c is far below the sample rate.
    """

    bandwidth: Value = parameter("f_c", "frequency")

    def poles(self, rate: float) -> Poles:
        return one_pole(self._angle(rate))

    def filtered(self, x: Samples, rate: float) -> Samples:
        w = jnp.exp(-self._angle(rate))
        return linear_recurrence(w, (1.0 - w) * x)

    def transfer(self, rate: float) -> Transfer:
        angle = self._angle(rate)
        return np.array([-np.expm1(-angle)]), np.array([1.0, -np.exp(-angle)])


class LowPass2(RecursiveFilter):
    """Low-pass filter of two poles, a damped oscillator that is read at the instants of the samples.

    `bandwidth` f_c = ω_c/2π in Hz; `quality_factor` Q_c above ½, 1/√2 of a Butterworth filter.
    """

    bandwidth: Value = parameter("f_c", "frequency")
    quality_factor: Value = parameter("Q_c", "number", lower=0.5, default=math.sqrt(0.5))

    def poles(self, rate: float) -> Poles:
        return two_poles(self._angle(rate), self.quality_factor)

    def _zero(self, rate: float) -> tuple[Any, Any]:
        """Coefficients b_0 and b_1: a zero, from the response at frequency zero and at half the rate."""
        xp, w = namespace(self, rate), self.poles(rate).pole[0]
        ends = xp.sqrt(self.power(xp.array([0.0, rate / 2.0]), rate))
        low, high = ends[0] * xp.abs(1.0 - w) ** 2, ends[1] * xp.abs(1.0 + w) ** 2
        return (low + high) / 2.0, (low - high) / 2.0

    def filtered(self, x: Samples, rate: float) -> Samples:
        w, (b0, b1) = self.poles(rate).pole[0], self._zero(rate)
        drive = b0 * x + b1 * jnp.concatenate([jnp.zeros(1), x[:-1]])
        return jnp.imag(w * linear_recurrence(w, drive + 0j)) / jnp.imag(w)

    def transfer(self, rate: float) -> Transfer:
        return np.array(self._zero(rate)), np.poly(self.poles(rate).pole).real


# Digital filters by the bilinear transformation as responses: Butterworth's, and any of two poles.
#
# With t = tan(πf_c/rate) and v = tan²(πf/rate) its power response 1/(1 + (v/t²)^m) has its poles at v =
# −q², q = t·e^{iφ}, φ = π(2k + 1 − m)/2m, k = 0 … m − 1. In w = (1 − q)/(1 + q) they are inside the unit
# circle, and
#
#     R = g + Σ c(1 − w²)/D(w),    c = q/[m(1 − q²)],    g = −Σ cq = 1/[1 + (−1)^m t^{−2m}],
#
# D(w) = (1 − w)² + 4ws, s = sin²(πf/rate): partial fractions in s, v = s/(1 − s). The filter itself is a
# chain of stages y_k = w·y_{k−1} + (1 − w)/2·(x_k + x_{k−1}), what the bilinear transformation makes of one
# pole (Oppenheim & Schafer, Discrete-Time Signal Processing, 7.1). Of two poles q_1, q_2 of any quality
# factor the 1/m is 1/(1 − q_k²/q_j²) of each.

#: Largest bandwidth, in units of half the sample rate: at 1 the filter would pass everything.
LARGEST_BANDWIDTH = 0.995

# Tangents t = tan(πf_c/rate) of odd orders are moved away from 1 as far as this.
_NEAR_ONE = 1e-5


def apart_from_one(tangent: Any, order: int) -> Any:
    """Tangent with which no pole is at 0, where partial fractions do not exist: odd orders, t = 1.

    There the result is accurate to 10⁻⁵ for quantization noise, to 10⁻⁵ of the bandwidth for other noise.
    """
    xp = namespace(tangent)
    return tangent + xp.where(xp.abs(tangent - 1.0) < _NEAR_ONE, 2.0 * _NEAR_ONE, 0.0) * (order % 2)


def bilinear_poles(q: Any, shares: Any = None) -> Poles:
    """Poles of the power response of a filter of these q, given their shares if these are known."""
    shares = _shares(q) if shares is None else shares
    return Poles((1.0 - q) / (1.0 + q), shares * q / (1.0 - q**2))


def _shares(q: Any) -> Any:
    """Share of each q in the partial fractions, ∏ 1/(1 − q_k²/q_j²) over the others."""
    xp, m = namespace(q), len(q)
    others = [[j for j in range(m) if j != k] for k in range(m)]
    return xp.prod(1.0 / (1.0 - (q[:, None] / q[np.array(others, int)]) ** 2), axis=1)


def biquad_poles(tangent: Any, quality: Any) -> Any:
    """The q of a filter of two poles for t = tan(πf_c/rate)."""
    xp = namespace(tangent, quality)
    real = 0.5 / xp.asarray(quality, float)
    q = tangent * (real + 1j * xp.sqrt(1.0 - real**2))
    return xp.stack([q, xp.conj(q)])


def butterworth_poles(tangent: Any, order: int) -> Any:
    """The q of a Butterworth filter for t = tan(πf_c/rate)."""
    angle = np.pi * (2.0 * np.arange(order) + 1.0 - order) / (2.0 * order)
    return np.exp(1j * angle)[(..., *(None,) * np.ndim(tangent))] * tangent


class _Bilinear(RecursiveFilter):
    """A filter of analog poles −q, which the bilinear transformation makes digital."""

    @abc.abstractmethod
    def _analog(self, tangent: Any) -> Any:
        """The poles' q for t = tan(πf_c/rate)."""

    def sampled(self, rate: float) -> Self:
        value, half = self.bandwidth, rate / 2.0
        if isinstance(value, int | float | np.floating) and value > half:
            raise AllanjaxError(
                f"{self.name()}: bandwidth must be below half the sample rate, {half:g} Hz, not {value:g}"
            )
        return self

    def filtered(self, x: Samples, rate: float) -> Samples:
        q = self._analog(self._tangent(rate))
        y = x + 0j
        for w in jnp.asarray((1.0 - q) / (1.0 + q)):
            before = jnp.concatenate([jnp.zeros(1), y[:-1]])
            y = linear_recurrence(w, (1.0 - w) / 2.0 * (y + before))
        return jnp.real(y)

    def transfer(self, rate: float) -> Transfer:
        q = self._analog(self._tangent(rate))
        w = (1.0 - q) / (1.0 + q)
        return np.prod((1.0 - w) / 2.0).real * np.poly(-np.ones(len(w))), np.poly(w).real

    def _half_angle(self, rate: float) -> Any:
        """Half the bandwidth in radians per sample interval."""
        return namespace(self, rate).minimum(self._angle(rate), LARGEST_BANDWIDTH * math.pi) / 2.0

    def _tangent(self, rate: float) -> Any:
        """Tangent t = tan(πf_c/rate)."""
        return namespace(self, rate).tan(self._half_angle(rate))

    def _apart(self, rate: float) -> Any:
        """The poles' q, which partial fractions need apart from one."""
        return self._analog(self._tangent(rate))

    def poles(self, rate: float) -> Poles:
        return bilinear_poles(self._apart(rate))

    def constant(self, rate: float) -> Float[ArrayLike, ""]:
        """The constant part: what is left of 1 at frequency zero."""
        return -namespace(self, rate).sum(self._apart(rate) * self.poles(rate).weight).real

    def _passed(self, frequency: RealsLike, rate: float) -> tuple[Any, Any]:
        """Shares of t² and v in t² + v, up to a common factor, neither of which is infinite."""
        xp, half = namespace(self, frequency, rate), self._half_angle(rate)
        a = math.pi * xp.asarray(frequency, float) / rate
        return (xp.cos(a) * xp.sin(half)) ** 2, (xp.sin(a) * xp.cos(half)) ** 2


class Biquad(_Bilinear):
    """Digital low-pass filter of two poles, bilinear: an IIR section as in many sensors, or `bessel(2, …)`.

    Its power response is 1/[(1 − x)² + x/Q_c²], x = [tan(πf/rate)/tan(πf_c/rate)]². `bandwidth` f_c in Hz,
    below half the sample rate; `quality_factor` Q_c above ½, 1/√2 of a Butterworth filter.
    """

    bandwidth: Value = parameter("f_c", "frequency")
    quality_factor: Value = parameter("Q_c", "number", lower=0.5, default=math.sqrt(0.5))

    def power(self, frequency: RealsLike, rate: float) -> Reals:
        """Power response at frequencies [Hz] for samples at `rate` [Hz], exact deep in the stop band."""
        passed, stopped = self._passed(frequency, rate)
        return passed**2 / ((passed - stopped) ** 2 + passed * stopped / self.quality_factor**2)

    def _analog(self, tangent: Any) -> Any:
        return biquad_poles(tangent, self.quality_factor)


class Butterworth(_Bilinear):
    """Digital Butterworth low-pass filter, bilinear: SciPy's `butter(order, f_c, fs=rate)`.

    Its power response is 1/(1 + [tan(πf/rate)/tan(πf_c/rate)]^{2·order}). `bandwidth` f_c in Hz, at which the
    power is halved, below half the sample rate; from 0.995 of that on the filter is the one of 0.995. `order`
    1 to 8; a fit keeps it.
    """

    bandwidth: Value = parameter("f_c", "frequency")
    order: int = option(default=2, most=8)

    def power(self, frequency: RealsLike, rate: float) -> Reals:
        """Power response at frequencies [Hz] for samples at `rate` [Hz], exact deep in the stop band."""
        passed, stopped = self._passed(frequency, rate)
        return passed**self.order / (passed**self.order + stopped**self.order)

    def _apart(self, rate: float) -> Any:
        return self._analog(apart_from_one(self._tangent(rate), self.order))

    def _analog(self, tangent: Any) -> Any:
        return butterworth_poles(tangent, self.order)


# The moving average as a response: an integrating converter, or samples that are means of faster ones.
#
# White noise averaged over τ and read every h has the autocovariance (τ − |d|h)+, straight between
# multiples of h. With τ/h = m + δ, 0 ≤ δ < 1, it is that of means of m values and of m + 1 values in the
# proportion of 1 − δ to δ, and so is the power response,
#
#     R = [(1 − δ)F_m + δF_{m+1}]/[(1 − δ)m² + δ(m + 1)²],    F_m = sin²(πmf/rate)/sin²(πf/rate),
#
# with all aliases of sinc²(fτ). Of other noise it is taken to be the same factor. A cascade of several equal
# ones, the sinc filter of a converter, has a power of R, and as autocovariance the convolution of so many.

#: Product of half-power bandwidth and duration for each order: sinc^{2·order}(x) = 1/2, Brent's method.
HALF_POWERS = (0.4429464706894523, 0.31891669868522327, 0.26193816997314145, 0.2275119577344974)
HALF_POWER = HALF_POWERS[0]
#: Longest duration [samples]; a filter that averages more leaves no noise to analyse.
LONGEST = 64

_LARGEST = HALF_POWER * (1.0 + 1e-9)
# Samples on either side beyond which the response of a mean without delay is negligible.
_REACH = 2048
# Lengths [samples] to start from: zeros of the response give the likelihood a maximum at each of them.
_STARTS = (1.5, 2, 2.5, 3, 3.5, *range(4, LONGEST))


class MovingAverage(Response):
    """Mean of the input over the last τ = 0.443/f_c, `order` times one after the other, as in a converter.

    `bandwidth` f_c in Hz, at which one mean halves the power of slow noise; a mean of m samples has
    0.443·rate/m. It lies between 0.443/64 of the sample rate (64 samples) and 0.443 (one sample, which
    changes nothing). `order` 1 to 4; a fit keeps it.
    """

    bandwidth: Value = parameter("f_c", "frequency", starts=tuple(HALF_POWER / m for m in _STARTS))
    order: int = option(default=1, most=len(HALF_POWERS))

    @classmethod
    def of(cls, duration: float, order: int = 1) -> Self:
        """Means over a duration [s]."""
        return cls(HALF_POWER / duration, order)

    @property
    def duration(self) -> float:
        """The duration τ of one mean [s]."""
        return HALF_POWER / float(self.bandwidth)

    @property
    def half_power(self) -> float:
        """Frequency at which all means together halve the power of slow noise [Hz]."""
        return HALF_POWERS[self.order - 1] / self.duration

    def sampled(self, rate: float) -> Self:
        value = self.bandwidth
        lowest, highest = HALF_POWER * rate / LONGEST, _LARGEST * rate
        if isinstance(value, int | float | np.floating) and not (lowest * (1.0 - 1e-9) <= value <= highest):
            raise AllanjaxError(
                f"moving_average: bandwidth must be from {lowest:.4g} Hz (64 samples) to {highest:.4g} Hz "
                f"(one sample) at {rate:g} Hz, not {value:g}"
            )
        return self

    def power(self, frequency: RealsLike, rate: float) -> Reals:
        """Power response at frequencies [Hz] for samples at `rate` [Hz]."""
        xp, f = as_array(frequency, self, rate)
        samples = self._samples(rate)
        x = f / rate
        m = xp.floor(samples)
        share = samples - m

        def mean(m: Any) -> Any:
            """F_m."""
            return (m * xp.sinc(m * x) / xp.sinc(x)) ** 2

        norm = (1.0 - share) * m**2 + share * (m + 1.0) ** 2
        return (((1.0 - share) * mean(m) + share * mean(m + 1.0)) / norm) ** self.order

    def phase_covariance(self, process: Any, lag: Reals, rate: float) -> Reals:
        """Phase covariance G after the filter: that before it, weighted (τ − |d|h)+ at d samples away."""
        xp = namespace(self, process, lag, rate)
        samples = self._samples(rate)
        count = LONGEST if xp is jnp else math.ceil(samples)
        weight = of_means(samples, count, self.order)
        d = np.arange(len(weight)) - len(weight) // 2
        moved = abs(xp.asarray(lag)[..., None] + d / rate)
        # In one row, since G is known up to a multiple of lag² that lags of a row have in common.
        rows = moved.reshape(*moved.shape[:-2], -1)
        return process.phase_covariance(rows).reshape(moved.shape) @ weight / xp.sum(weight)

    @property
    def ahead(self) -> int:
        return _REACH

    def filtered(self, x: Samples, rate: float) -> Samples:
        """Samples after the filter, without delay; the straight line from first to last is unchanged."""
        n = len(x)
        line = x[0] + (x[-1] - x[0]) * jnp.arange(n) / (n - 1)
        amplitude = jnp.sqrt(self.power(jnp.fft.rfftfreq(n, 1.0 / rate), rate))
        return jnp.fft.irfft(amplitude * jnp.fft.rfft(x - line), n) + line

    def transfer(self, rate: float) -> Transfer:
        """Coefficients of means over whole samples; else of the minimum-delay filter with this response."""
        samples = float(self._samples(rate))
        count = math.ceil(samples - 1e-9)
        if abs(samples - count) <= 1e-9:
            b = np.full(count, 1.0 / count)
        else:
            b = _spectral_factor(np.maximum(samples - np.arange(count + 1), 0.0))
        return repeated(b / b.sum(), self.order), np.ones(1)

    def _samples(self, rate: float) -> Any:
        """The duration in sample intervals, between 1 and 64."""
        xp = namespace(self, rate)
        return xp.clip(HALF_POWER * rate / xp.asarray(self.bandwidth, float), 1.0, float(LONGEST))


def of_means(samples: Any, count: int, order: int) -> Float[Array, " lags"]:
    """Autocovariance of `order` means of white noise over so many samples, up to `count`, at all lags."""
    xp = namespace(samples)
    return repeated(xp.maximum(samples - abs(np.arange(1 - count, count)), 0.0), order)


def repeated(pulse: Any, order: int) -> Any:
    """Convolution of a pulse with itself, of so many."""
    return functools.reduce(namespace(pulse).convolve, [pulse] * order, np.ones(1))


def _spectral_factor(weight: Float[np.ndarray, " q"]) -> Float[np.ndarray, " q"]:
    """Filter b of this autocorrelation Σ_i b_i b_{i+d}, by Newton's method (Wilson 1969, SIAM J. NA 6:1)."""
    from scipy.linalg import hankel, toeplitz

    # From any filter without zeros inside the unit circle; it stays so.
    b = np.zeros_like(weight)
    b[0] = np.sqrt(weight[0] + 2.0 * weight[1:].sum())
    for _ in range(60):
        first = np.pad(b[:1], (0, len(b) - 1))
        both = hankel(b) + toeplitz(first, b)
        step = np.linalg.solve(both, weight - np.correlate(b, b, "full")[len(b) - 1 :])
        b = b + step
        if np.abs(step).max() <= 1e-14 * np.abs(b).max():
            break
    return b


# Samples that a filter is given to settle before a simulation begins.
_SETTLING = 8192


class FilteredProcess(Process):
    """A process after a response, for samples at `rate` [Hz]; 0 if that is not known yet.

    The process must have the method `parts(rate)`, which returns the parts of its density.
    """

    process: Process
    response: Response
    rate: float

    @property
    def oscillates(self) -> bool:
        return self.process.oscillates

    @property
    def narrow_band(self) -> bool:  # type: ignore[override]  # of the process, not of the class
        return self.process.narrow_band

    def power_scatter(self, duration: Float[ArrayLike, ""]) -> Float[Array, ""]:
        return self.process.power_scatter(duration)

    def phase_covariance(self, lag: Reals) -> Reals:
        return self.response.phase_covariance(self.process, lag, self._known_rate)

    def psd(self, frequency: RealsLike) -> Reals:
        return self.response.power(frequency, self._known_rate) * self.process.psd(frequency)

    def sampled_psd(self, frequency: RealsLike, rate: float) -> Reals:
        return self.response.power(frequency, rate) * self.process.sampled_psd(frequency, rate)

    def end_effect(self, frequency: RealsLike, rate: float) -> Reals:
        return self.response.power(frequency, rate) * self.process.end_effect(frequency, rate)

    def simulate(self, key: PRNGKeyArray, n: int, rate: float) -> Samples:
        """Simulated samples; the filter has run over thousands of samples before the first."""
        x = self.process.simulate(key, n + _SETTLING, rate)
        # It starts at rest at the first of these, which is added again: it leaves constants unchanged.
        first = _SETTLING - self.response.ahead
        return self.response.filtered(x - x[0], rate)[first : first + n] + x[0]

    @property
    def _known_rate(self) -> float:
        if is_continuous(self.rate):
            raise AllanjaxError("a response depends on the sample rate: use model.sampled(rate)")
        return self.rate

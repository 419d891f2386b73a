"""Digital filters by the bilinear transformation as responses: Butterworth's, and any of two poles.

With t = tan(πf_c/rate) and v = tan²(πf/rate) its power response 1/(1 + (v/t²)^m) has its poles at v = −q²,
q = t·e^{iφ}, φ = π(2k + 1 − m)/2m, k = 0 … m − 1. In w = (1 − q)/(1 + q) they are inside the unit circle, and

    R = g + Σ c(1 − w²)/D(w),    c = q/[m(1 − q²)],    g = 1/[1 + (−1)^m t^{−2m}],

D(w) = (1 − w)² + 4ws, s = sin²(πf/rate): partial fractions in s, v = s/(1 − s). The filter itself is a chain
of stages y_k = w·y_{k−1} + (1 − w)/2·(x_k + x_{k−1}), what the bilinear transformation makes of one pole
(Oppenheim & Schafer, Discrete-Time Signal Processing, 7.1). Of two poles q_1, q_2 of any quality factor the
1/m is 1/(1 − q_k²/q_j²) of each.
"""

from __future__ import annotations

import abc
import math
from typing import Any, Self

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from allanjax.base.arrays import namespace
from allanjax.base.errors import AllanjaxError
from allanjax.noise.parameter import Value, option, parameter
from allanjax.noise.recursion import linear_recurrence
from allanjax.noise.response import Poles, RecursiveFilter, second_order_half_power

#: Largest bandwidth, in units of half the sample rate: at 1 the filter would let all pass.
LARGEST_BANDWIDTH = 0.995

# Tangents t = tan(πf_c/rate) of odd orders are moved away from 1 as far as this.
_NEAR_ONE = 1e-5


class _Bilinear(RecursiveFilter):
    """A filter of analog poles −q, which the bilinear transformation makes digital."""

    bandwidth: eqx.AbstractVar[Value]

    @abc.abstractmethod
    def _analog(self, tangent: Any) -> Any:
        """The poles' q for t = tan(πf_c/rate)."""

    def sampled(self, rate: float) -> Self:
        value, half = self.bandwidth, rate / 2.0
        if isinstance(value, int | float | np.floating) and value > half:
            raise AllanjaxError(
                f"{self.name()}: bandwidth must be below half the sample rate, {half:g} Hz, got {value:g}"
            )
        return self

    def filtered(self, x: Float[Array, " n"], rate: float) -> Float[Array, " n"]:
        q = self._analog(self._tangent(rate))
        y = x + 0j
        for w in jnp.asarray((1.0 - q) / (1.0 + q)):
            before = jnp.concatenate([jnp.zeros(1), y[:-1]])
            y = linear_recurrence(w, (1.0 - w) / 2.0 * (y + before))
        return jnp.real(y)

    def transfer(self, rate: float) -> tuple[Float[np.ndarray, " q"], Float[np.ndarray, " p"]]:
        q = self._analog(self._tangent(rate))
        w = (1.0 - q) / (1.0 + q)
        return np.prod((1.0 - w) / 2.0).real * np.poly(-np.ones(len(w))), np.poly(w).real

    def _half_angle(self, rate: float) -> Any:
        """Half the bandwidth in radians per sample interval."""
        xp = namespace(self, rate)
        return math.pi * xp.minimum(xp.asarray(self.bandwidth, float) / rate, LARGEST_BANDWIDTH / 2.0)

    def _tangent(self, rate: float) -> Any:
        """Tangent t = tan(πf_c/rate)."""
        return namespace(self, rate).tan(self._half_angle(rate))

    def _passed(self, frequency: Float[ArrayLike, ...], rate: float) -> tuple[Any, Any]:
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

    def poles(self, rate: float) -> Poles:
        q = self._analog(self._tangent(rate))
        return Poles((1.0 - q) / (1.0 + q), self._share(q) * q / (1.0 - q**2))

    def constant(self, rate: float) -> Float[ArrayLike, ""]:
        q = self._analog(self._tangent(rate))
        xp = namespace(self, rate)
        return xp.real(xp.sum(-self._share(q) * q**2 / (1.0 - q**2)))

    def power(self, frequency: Float[ArrayLike, ...], rate: float) -> Float[Array, ...]:
        """Power response at frequencies [Hz] for samples at `rate` [Hz], exact deep in the stop band."""
        passed, stopped = self._passed(frequency, rate)
        return passed**2 / ((passed - stopped) ** 2 + passed * stopped / self.quality_factor**2)

    @property
    def half_power(self) -> float:
        return second_order_half_power(float(self.bandwidth), float(self.quality_factor))

    def _analog(self, tangent: Any) -> Any:
        xp = namespace(self, tangent)
        real = 0.5 / xp.asarray(self.quality_factor, float)
        q = tangent * (real + 1j * xp.sqrt(1.0 - real**2))
        return xp.stack([q, xp.conj(q)])

    @staticmethod
    def _share(q: Any) -> Any:
        return 1.0 / (1.0 - (q / q[::-1]) ** 2)


class Butterworth(_Bilinear):
    """Digital Butterworth low-pass filter, bilinear: SciPy's `butter(order, f_c, fs=rate)`.

    Its power response is 1/(1 + [tan(πf/rate)/tan(πf_c/rate)]^{2·order}). `bandwidth` f_c in Hz, at which the
    power is halved, below half the sample rate; from 0.995 of that on the filter is the one of 0.995. `order`
    1 to 4, which no fit estimates.
    """

    bandwidth: Value = parameter("f_c", "frequency")
    order: int = option(default=2)

    def __check_init__(self) -> None:
        if not isinstance(self.order, int) or self.order not in range(1, 5):
            raise AllanjaxError(f"butterworth: the order must be 1, 2, 3 or 4, got {self.order!r}")

    def poles(self, rate: float) -> Poles:
        q = self._analog(self._apart(rate))
        return Poles((1.0 - q) / (1.0 + q), q / (self.order * (1.0 - q**2)))

    def constant(self, rate: float) -> Float[ArrayLike, ""]:
        return 1.0 / (1.0 + (-1.0) ** self.order * self._apart(rate) ** (-2 * self.order))

    def power(self, frequency: Float[ArrayLike, ...], rate: float) -> Float[Array, ...]:
        """Power response at frequencies [Hz] for samples at `rate` [Hz], exact deep in the stop band."""
        passed, stopped = self._passed(frequency, rate)
        return passed**self.order / (passed**self.order + stopped**self.order)

    def _apart(self, rate: float) -> Any:
        """Tangent with which no pole is at 0, where partial fractions do not exist: odd orders, t = 1.

        Of quantization noise they are good to 10⁻⁵ there, of other noise to 10⁻⁵ of the bandwidth.
        """
        xp, t = namespace(self, rate), self._tangent(rate)
        return t + xp.where(xp.abs(t - 1.0) < _NEAR_ONE, 2.0 * _NEAR_ONE, 0.0) * (self.order % 2)

    def _analog(self, tangent: Any) -> Any:
        m = self.order
        return tangent * np.exp(0.5j * np.pi * (2.0 * np.arange(m) + 1.0 - m) / m)

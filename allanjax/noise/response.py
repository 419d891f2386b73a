"""Responses: filters that the samples of a sensor have passed, and what they make of noise.

The power response of a filter with poles w_i, at s = sin²(πf/rate), is a sum of c_i(1 − w_i²)/D(w_i) with
D(w) = (1 − w)² + 4ws; so is the density of noise with exponential covariances, but for parts that are white
(1), a difference (4s) or a walk (1/4s). Products are taken apart into parts of the same kind,

    (1 − Q²)/D(Q) · c(1 − w²)/D(w) = α(1 − Q²)/D(Q) + β(1 − w²)/D(w),

    α = c(1 − w²)Q/[(Q − w)(1 − Qw)],    β = −c(1 − Q²)w/[(Q − w)(1 − Qw)],

each of which has its phase covariance in closed form. A filter with zeros at half the sample rate has a
constant part, too: its numerator is of the same degree in s as its denominator.
"""

from __future__ import annotations

import abc
import math
from typing import Any, NamedTuple, Self

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from allanjax.base.arrays import namespace
from allanjax.base.errors import AllanjaxError
from allanjax.noise.exponential import exponential_covariance
from allanjax.noise.parameter import Parametrized, Value, parameter
from allanjax.noise.recursion import linear_recurrence


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
    """Density of samples [rate²] taken apart: white + difference·4s + walk/4s + poles."""

    white: Any
    difference: Any
    walk: Any
    poles: Poles

    def phase_covariance(self, lag: Float[Array, ...], rate: float) -> Float[Array, ...]:
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


class Response(Parametrized):
    """A filter that noise passes, written as a factor: `LowPass1(28.0) * (AngleRandomWalk() + Markov())`.

    It is that of the samples: 1 at frequency zero, so that coefficients of slow noise are those of
    the sensor without it.
    """

    @abc.abstractmethod
    def power(self, frequency: Float[ArrayLike, ...], rate: float) -> Float[Array, ...]:
        """Power response at frequencies [Hz] for samples at `rate` [Hz]."""

    @abc.abstractmethod
    def phase_covariance(self, process: Any, lag: Float[Array, ...], rate: float) -> Float[Array, ...]:
        """Phase covariance G of a `Process` after the filter, at lags [s] for samples at `rate` [Hz]."""

    @abc.abstractmethod
    def filtered(self, x: Float[Array, " n"], rate: float) -> Float[Array, " n"]:
        """Samples after the filter, which starts at rest."""

    def transfer(self, rate: float) -> tuple[Float[np.ndarray, " q"], Float[np.ndarray, " p"]]:
        """Coefficients b and a of y_k = Σ b_j x_{k−j} − Σ_{j≥1} a_j y_{k−j}, a_0 = 1, at `rate` [Hz].

        A filter that has the power response; any other has the same law of noise after it.
        """
        raise AllanjaxError(
            f"{self.name()} has no finite state space: define its transfer(rate), or leave the response out"
        )

    @property
    def half_power(self) -> float:
        """Frequency at which the power response, as that of an analog filter, has fallen by half [Hz]."""
        return float(getattr(self, self.parameters()[0].name))

    @property
    def ahead(self) -> int:
        """How many later samples have a say in what `filtered` makes of one; 0 of a filter in time."""
        return 0

    def sampled(self, rate: float) -> Self:
        """The filter for samples at `rate` [Hz]; AllanjaxError if there is none."""
        return self


class RecursiveFilter(Response):
    """A response that has poles."""

    @abc.abstractmethod
    def poles(self, rate: float) -> Poles:
        """Poles of the power response for samples at `rate` [Hz]."""

    def constant(self, rate: float) -> Float[ArrayLike, ""]:
        """What the power response is beside its poles; 0 unless a filter says otherwise."""
        return 0.0

    def power(self, frequency: Float[ArrayLike, ...], rate: float) -> Float[Array, ...]:
        """Power response at frequencies [Hz] for samples at `rate` [Hz]."""
        xp = namespace(self, frequency, rate)
        s = xp.sin(math.pi * xp.asarray(frequency, float) / rate)[..., None] ** 2
        w, c = self.poles(rate)
        of_poles = xp.sum(c * (1.0 - w**2) / ((1.0 - w) ** 2 + 4.0 * w * s), axis=-1)
        return xp.real(of_poles) + self.constant(rate)

    def phase_covariance(self, process: Any, lag: Float[Array, ...], rate: float) -> Float[Array, ...]:
        """Phase covariance G after the filter of a process that says what it consists of by `parts(rate)`."""
        change = self.change(process.parts(rate), rate)
        return process.phase_covariance(lag) + change.phase_covariance(lag, rate)

    def change(self, parts: Parts, rate: float) -> Parts:
        """What the filter adds to a density: the density after it less that before."""
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


def second_order_half_power(bandwidth: float, quality_factor: float) -> float:
    """Frequency at which an analog filter of two poles has lost half of the power: |1 − x² + ix/Q|² = 2."""
    middle = 1.0 - 0.5 / quality_factor**2
    return bandwidth * math.sqrt(middle + math.hypot(middle, 1.0))


class LowPass1(RecursiveFilter):
    """Low-pass filter of one pole, y_k = w·y_{k−1} + (1 − w)·x_k with w = exp(−2πf_c/rate).

    `bandwidth` f_c in Hz, at which the power of slow noise is halved if f_c is far below the sample rate.
    """

    bandwidth: Value = parameter("f_c", "frequency")

    def poles(self, rate: float) -> Poles:
        xp = namespace(self, rate)
        w = xp.exp(-2.0 * math.pi * xp.asarray(self.bandwidth, float) / rate)[None] + 0j
        return Poles(w, (1.0 - w) / (1.0 + w))

    def filtered(self, x: Float[Array, " n"], rate: float) -> Float[Array, " n"]:
        w = jnp.exp(-2.0 * math.pi * jnp.asarray(self.bandwidth) / rate)
        return linear_recurrence(w, (1.0 - w) * x)

    def transfer(self, rate: float) -> tuple[Float[np.ndarray, " q"], Float[np.ndarray, " p"]]:
        x = 2.0 * math.pi * self.bandwidth / rate
        return np.array([-np.expm1(-x)]), np.array([1.0, -np.exp(-x)])


class LowPass2(RecursiveFilter):
    """Low-pass filter of two poles, a damped oscillator that is read at the instants of the samples.

    `bandwidth` f_c = ω_c/2π in Hz; `quality_factor` Q_c above ½, 1/√2 of a Butterworth filter.
    """

    bandwidth: Value = parameter("f_c", "frequency")
    quality_factor: Value = parameter("Q_c", "number", lower=0.5, default=math.sqrt(0.5))

    def poles(self, rate: float) -> Poles:
        xp = namespace(self, rate)
        wc = 2.0 * math.pi * xp.asarray(self.bandwidth, float) / rate
        decay = wc / (2.0 * self.quality_factor)
        wd = xp.sqrt(wc**2 - decay**2)
        w, c = xp.exp(-decay + 1j * wd), 1.0 - 1j * decay / wd
        c = c / xp.real(c * (1.0 + w) / (1.0 - w))
        pair = xp.stack([w, xp.conj(w)])
        return Poles(pair, xp.stack([c, xp.conj(c)]) / 2.0)

    @property
    def half_power(self) -> float:
        return second_order_half_power(float(self.bandwidth), float(self.quality_factor))

    def _zero(self, rate: float) -> tuple[Any, Any]:
        """Coefficients b_0 and b_1: a zero, from the response at frequency zero and at half the rate."""
        xp, w = namespace(self, rate), self.poles(rate).pole[0]
        ends = xp.sqrt(self.power(xp.array([0.0, rate / 2.0]), rate))
        low, high = ends[0] * xp.abs(1.0 - w) ** 2, ends[1] * xp.abs(1.0 + w) ** 2
        return (low + high) / 2.0, (low - high) / 2.0

    def filtered(self, x: Float[Array, " n"], rate: float) -> Float[Array, " n"]:
        w, (b0, b1) = self.poles(rate).pole[0], self._zero(rate)
        drive = b0 * x + b1 * jnp.concatenate([jnp.zeros(1), x[:-1]])
        return jnp.imag(w * linear_recurrence(w, drive + 0j)) / jnp.imag(w)

    def transfer(self, rate: float) -> tuple[Float[np.ndarray, " q"], Float[np.ndarray, " p"]]:
        return np.array(self._zero(rate)), np.poly(self.poles(rate).pole).real

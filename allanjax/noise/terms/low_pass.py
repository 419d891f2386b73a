"""White noise after a low-pass filter: the sensor's own, or one in its signal processing."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Num, PRNGKeyArray

from allanjax.base.arrays import namespace
from allanjax.base.errors import AllanjaxError
from allanjax.noise.model import NoiseTerm
from allanjax.noise.numerics import exponential_covariance, exponential_density, linear_recurrence
from allanjax.noise.parameter import Value, option, parameter
from allanjax.noise.state_space import Block, exponential_block, oscillator_block
from allanjax.noise.terms.resonance import Resonance


class LowPass(NoiseTerm):
    """White noise after a Butterworth filter, S(f) = N²/(1 + (f/f_c)^(2·order)).

    Not in the thesis. `coefficient` N in rad/√s or m/s/√s (that of the white noise, two-sided PSD N²),
    `bandwidth` f_c in Hz (−3 dB), `order` 1 or 2. The filter's output is read at the sample instants: order 1
    is a first-order autoregression then. Its covariance is R(t) = Re[c·e^{λt}] with λ = −ω_c, c = N²ω_c/2,
    or, for order 2, that of an oscillator of quality factor 1/√2: λ = ω_c(−1 + i)/√2, c = (1 − i)·N²ω_c/√8.
    """

    coefficient: Value = parameter("N_f", time_exponent=0.5)
    bandwidth: Value = parameter("f_c", "frequency")
    order: int = option(default=1)
    #: Sample interval [s]; 0 for the continuous rate.
    sample_interval: float = 0.0

    def __check_init__(self) -> None:
        if self.order not in (1, 2):
            raise AllanjaxError(f"low_pass: the order must be 1 or 2, got {self.order!r}")

    def sampled(self, rate: float) -> LowPass:
        return self.replace(sample_interval=1.0 / rate)

    def _pole(self) -> tuple[Num[Array, ""], Num[Array, ""]]:
        """Pole λ and weight c of the autocovariance R(t) = Re[c·e^{λt}]."""
        w = 2.0 * np.pi * namespace(self).asarray(self.bandwidth, float)
        power = self.coefficient**2 * w
        if self.order == 1:
            return -w, power / 2.0
        return w * (-1.0 + 1j) / math.sqrt(2.0), power * (1.0 - 1j) / math.sqrt(8.0)

    def phase_covariance(self, lag: Float[Array, ...]) -> Float[Array, ...]:
        return exponential_covariance(*self._pole(), lag, self.sample_interval)

    def psd(self, frequency: Float[ArrayLike, ...]) -> Float[Array, ...]:
        ratio = namespace(self, frequency).asarray(frequency, float) / self.bandwidth
        return self.coefficient**2 / (1.0 + ratio ** (2 * self.order))

    def sampled_psd(self, frequency: Float[ArrayLike, ...], rate: float) -> Float[Array, ...]:
        return exponential_density(*self._pole(), frequency, rate, self.sample_interval)

    def state_block(self, rate: float, duration: float | None) -> Block:
        pole, weight = self._pole()
        if self.order == 1:
            return exponential_block(float(weight), float(-pole / rate))
        return oscillator_block(float(weight.real), complex(pole / rate))

    def simulate(self, key: PRNGKeyArray, n: int, rate: float) -> Float[Array, " n"]:
        """Simulated samples by the exact recursion of the filter's state."""
        pole, weight = self._pole()
        sigma = jnp.sqrt(jnp.real(weight))
        if self.order == 2:
            oscillator = Resonance(sigma, self.bandwidth, math.sqrt(0.5), sample_interval=1.0 / rate)
            return oscillator.simulate(key, n, rate)
        innovation = jnp.where(jnp.arange(n) == 0, 1.0, jnp.sqrt(-jnp.expm1(2.0 * pole / rate)))
        return linear_recurrence(jnp.exp(pole / rate), sigma * innovation * jax.random.normal(key, (n,)))

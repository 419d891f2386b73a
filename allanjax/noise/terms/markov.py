"""Exponentially correlated (first-order Gauss–Markov) noise (thesis 4.3.6)."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, PRNGKeyArray

from allanjax.base.arrays import namespace
from allanjax.noise.model import NoiseTerm
from allanjax.noise.numerics import averaged_lags, exponential_remainder, linear_recurrence
from allanjax.noise.parameter import Value, parameter
from allanjax.noise.response import Parts, Poles
from allanjax.noise.state_space import Block, mean_block

# Sample intervals over the correlation time from which on only two lags are left.
_SHORT = 30.0


class Markov(NoiseTerm):
    """First-order Gauss–Markov noise of the rate (4.59, 4.60), standard deviation q_c·√(T_c/2).

    `amplitude` q_c in rad/s/√s or m/s²/√s; `correlation_time` T_c in s.
    """

    amplitude: Value = parameter("q_c", time_exponent=-0.5)
    correlation_time: Value = parameter("T_c", "time")

    def phase_covariance(self, lag: Float[Array, ...]) -> Float[Array, ...]:
        T_c = self.correlation_time
        return -(self.amplitude**2) * T_c**3 / 2.0 * exponential_remainder(-lag / T_c)

    def psd(self, frequency: Float[ArrayLike, ...]) -> Float[Array, ...]:
        w = 2.0 * np.pi * namespace(self, frequency).asarray(frequency) * self.correlation_time
        return (self.amplitude * self.correlation_time) ** 2 / (1.0 + w**2)

    def sampled_psd(self, frequency: Float[ArrayLike, ...], rate: float) -> Float[Array, ...]:
        """PSD of means over the sample interval, whose autocovariance is geometric from the first lag on."""
        xp = namespace(self, frequency, rate)
        a = 2.0 * np.pi * xp.asarray(frequency) / rate
        x = 1.0 / (rate * self.correlation_time)
        at_zero, at_one = averaged_lags(x)
        # cos a − e^{-x} and 1 − 2e^{-x} cos a + e^{-2x}, without cancellation where both are small.
        s = 2.0 * xp.sin(a / 2.0) ** 2
        numerator = -s - xp.expm1(-x)
        denominator = xp.expm1(-x) ** 2 + 2.0 * xp.exp(-x) * s
        variance = self.amplitude**2 * self.correlation_time / 2.0
        return variance / rate * (at_zero + 2.0 * at_one * numerator / denominator)

    def parts(self, rate: float) -> Parts:
        """Parts of the density of means over sample intervals: a pole and what the lag zero has beyond it.

        Of a process that is over within a sample, the two lags that are left.
        """
        xp = namespace(self, rate)
        x = 1.0 / (rate * xp.asarray(self.correlation_time, float))
        variance = self.amplitude**2 * self.correlation_time / 2.0
        short = x > _SHORT
        slow, fast = xp.where(short, _SHORT, x), xp.where(short, x, _SHORT)
        r0, r1 = averaged_lags(slow)
        q0, q1 = averaged_lags(fast)
        weight = r1 * xp.exp(slow)
        white = xp.where(short, q0 + 2.0 * q1, r0 - weight)
        pole = xp.where(short, 0.5, xp.exp(-slow))
        poles = Poles(pole[None] + 0j, xp.where(short, 0.0, variance * weight)[None] + 0j)
        return Parts(variance * white, xp.where(short, -variance * q1, 0.0), 0.0, poles)

    def state_block(self, rate: float, duration: float | None) -> Block:
        variance = self.amplitude**2 * self.correlation_time / 2.0
        return mean_block(variance, 1.0 / (rate * self.correlation_time))

    def simulate(self, key: PRNGKeyArray, n: int, rate: float) -> Float[Array, " n"]:
        """Simulated samples: an exact recursion of the state, and Gaussian means between its values."""
        x = 1.0 / (rate * self.correlation_time)
        sigma = self.amplitude * jnp.sqrt(self.correlation_time / 2.0)
        state_key, mean_key = jax.random.split(key)
        drive = jax.random.normal(state_key, (n + 1,)) * sigma
        innovation = jnp.sqrt(-jnp.expm1(-2.0 * x))
        state = linear_recurrence(jnp.exp(-x), drive * jnp.where(jnp.arange(n + 1) == 0, 1.0, innovation))
        slope = jnp.tanh(x / 2.0) / x
        # Var(mean | both ends)/σ² = 2/x − 4 tanh(x/2)/x² → x/6 as x → 0.
        conditional = jnp.where(
            x < 0.01, x / 6.0 * (1.0 - x**2 / 10.0), 2.0 / x - 4.0 * jnp.tanh(x / 2.0) / x**2
        )
        between = sigma * jnp.sqrt(conditional) * jax.random.normal(mean_key, (n,))
        return slope * (state[1:] + state[:-1]) + between

"""Angle (velocity) random walk (thesis 4.3.2) and rate random walk (4.3.4)."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, PRNGKeyArray

from allanjax.base.arrays import namespace
from allanjax.noise.model import NoiseTerm
from allanjax.noise.numerics import linear_recurrence
from allanjax.noise.parameter import Value, parameter
from allanjax.noise.response import NO_POLES, Parts
from allanjax.noise.state_space import Block, block, white_block


class AngleRandomWalk(NoiseTerm):
    """White noise of the rate: σ²(T) = N²/T (4.36); velocity random walk for an accelerometer.

    `coefficient` N in rad/√s or m/s/√s (two-sided PSD N²; the thesis calls it Q).
    """

    coefficient: Value = parameter("N", time_exponent=0.5)

    def phase_covariance(self, lag: Float[Array, ...]) -> Float[Array, ...]:
        return -(self.coefficient**2) * lag / 2.0

    def psd(self, frequency: Float[ArrayLike, ...]) -> Float[Array, ...]:
        return namespace(self, frequency).full(np.shape(frequency), self.coefficient**2)

    def sampled_psd(self, frequency: Float[ArrayLike, ...], rate: float) -> Float[Array, ...]:
        return self.psd(frequency)

    def simulate(self, key: PRNGKeyArray, n: int, rate: float) -> Float[Array, " n"]:
        return self.coefficient * jnp.sqrt(rate) * jax.random.normal(key, (n,))

    def parts(self, rate: float) -> Parts:
        return Parts(self.coefficient**2 * rate, 0.0, 0.0, NO_POLES)

    def state_block(self, rate: float, duration: float | None) -> Block:
        return white_block(self.coefficient**2 * rate)


class RateRandomWalk(NoiseTerm):
    """Integrated white noise of the rate: σ²(T) = K²T/3 (4.53).

    `coefficient` K in rad/s/√s or m/s²/√s.
    """

    coefficient: Value = parameter("K", time_exponent=-0.5)

    def phase_covariance(self, lag: Float[Array, ...]) -> Float[Array, ...]:
        return self.coefficient**2 * lag**3 / 12.0

    @np.errstate(divide="ignore")
    def psd(self, frequency: Float[ArrayLike, ...]) -> Float[Array, ...]:
        xp = namespace(self, frequency)
        return (self.coefficient / (2.0 * np.pi * xp.asarray(frequency))) ** 2

    @np.errstate(divide="ignore")
    def sampled_psd(self, frequency: Float[ArrayLike, ...], rate: float) -> Float[Array, ...]:
        """PSD of the samples, K²/rate²·(2 + cos a)/(12 sin²(a/2)), a = 2πf/rate."""
        xp = namespace(self, frequency, rate)
        a = 2.0 * np.pi * xp.asarray(frequency) / rate
        return (self.coefficient / rate) ** 2 * (2.0 + xp.cos(a)) / (12.0 * xp.sin(a / 2.0) ** 2)

    def simulate(self, key: PRNGKeyArray, n: int, rate: float) -> Float[Array, " n"]:
        """Simulated means of a Brownian path over sample intervals: from its end points and bridges."""
        steps, bridge = jax.random.normal(key, (2, n)) / jnp.sqrt(rate)
        path_end = linear_recurrence(1.0, steps)
        return self.coefficient * (path_end - steps / 2.0 + bridge / jnp.sqrt(12.0))

    def parts(self, rate: float) -> Parts:
        """Parts of (2 + cos a)/(12 sin²(a/2)) = 1/(4s) − 1/6, times K²/rate."""
        walk = self.coefficient**2 / rate
        return Parts(-walk / 6.0, 0.0, walk, NO_POLES)

    def state_block(self, rate: float, duration: float | None) -> Block:
        """States: the mean of the path over a sample interval, and its end."""
        noise = self.coefficient**2 / rate * np.array([[1.0 / 3.0, 0.5], [0.5, 1.0]])
        transition = np.array([[0.0, 1.0], [0.0, 1.0]])
        return block(transition, [1.0, 0.0], noise, noise, ("mean", "end"), level=(False, True))

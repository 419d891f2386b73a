"""Random telegraph noise: a bias that jumps between two levels (burst or popcorn noise)."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, PRNGKeyArray

from allanjax.base.arrays import namespace
from allanjax.noise.model import NoiseTerm
from allanjax.noise.numerics import exponential_covariance, exponential_density
from allanjax.noise.parameter import Value, parameter
from allanjax.noise.state_space import Block, exponential_block


class Telegraph(NoiseTerm):
    """Bias that jumps between two levels, as often down as up (Machlup 1954, J. Appl. Phys. 25:341).

    `amplitude` is the difference of the levels [rad/s or m/s²], `dwell_time` T_d the mean time in each [s].
    R(t) = (amplitude²/4)·e^{−2|t|/T_d}: to second order it is a Markov process of correlation time T_d/2,
    which has the same spectrum; its simulated paths do jump. Samples are read at their instants.
    """

    amplitude: Value = parameter("J", time_exponent=0.0)
    dwell_time: Value = parameter("T_d", "time")
    #: Sample interval [s]; 0 for the continuous rate.
    sample_interval: float = 0.0

    def sampled(self, rate: float) -> Telegraph:
        return self.replace(sample_interval=1.0 / rate)

    def phase_covariance(self, lag: Float[Array, ...]) -> Float[Array, ...]:
        pole = -2.0 / namespace(self).asarray(self.dwell_time, float)
        return self.amplitude**2 / 4.0 * exponential_covariance(pole, 1.0, lag, self.sample_interval)

    def psd(self, frequency: Float[ArrayLike, ...]) -> Float[Array, ...]:
        """Two-sided PSD (amplitude²/4)·T_d/(1 + (πf·T_d)²)."""
        x = np.pi * namespace(self, frequency).asarray(frequency) * self.dwell_time
        return self.amplitude**2 / 4.0 * self.dwell_time / (1.0 + x**2)

    def sampled_psd(self, frequency: Float[ArrayLike, ...], rate: float) -> Float[Array, ...]:
        pole = -2.0 / namespace(self).asarray(self.dwell_time, float)
        return self.amplitude**2 / 4.0 * exponential_density(pole, 1.0, frequency, rate, self.sample_interval)

    def state_block(self, rate: float, duration: float | None) -> Block:
        """State of the same covariance; the jumps of the noise are not Gaussian."""
        return exponential_block(self.amplitude**2 / 4.0, 2.0 / (rate * self.dwell_time))

    def simulate(self, key: PRNGKeyArray, n: int, rate: float) -> Float[Array, " n"]:
        """Simulated path with exponential dwell times: an odd Poisson number of jumps changes the level.

        The levels have mean zero, and either is as likely at the start.
        """
        first_key, jump_key = jax.random.split(key)
        odd = -jnp.expm1(-2.0 / (rate * self.dwell_time)) / 2.0
        changes = jnp.cumsum(jax.random.bernoulli(jump_key, odd, (n,)))
        level = (changes + jax.random.bernoulli(first_key)) % 2
        return self.amplitude * (level - 0.5)

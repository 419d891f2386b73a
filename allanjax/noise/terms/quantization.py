"""Quantization noise (thesis 4.3.1)."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, PRNGKeyArray

from allanjax.base.arrays import namespace
from allanjax.base.errors import AllanjaxError
from allanjax.noise.model import NoiseTerm
from allanjax.noise.parameter import Value, parameter
from allanjax.noise.response import NO_POLES, Parts
from allanjax.noise.state_space import Block, block


class Quantization(NoiseTerm):
    """White error of the angle (velocity) at each reading: σ²(T) = 3Q²/T² (4.29).

    `coefficient` Q in rad or m/s. A rounding of the angle to steps S has Q = S/√12.
    """

    coefficient: Value = parameter("Q", time_exponent=1.0)
    #: Sample interval [s]; only the PSD needs it (4.28).
    sample_interval: float = 0.0

    def sampled(self, rate: float) -> Quantization:
        return self.replace(sample_interval=1.0 / rate)

    def phase_covariance(self, lag: Float[Array, ...]) -> Float[Array, ...]:
        return namespace(self, lag).where(lag == 0.0, self.coefficient**2, 0.0)

    def psd(self, frequency: Float[ArrayLike, ...]) -> Float[Array, ...]:
        """Two-sided PSD of sampled data, 4Q² sin²(πfT_z)/T_z ≈ (2πf)² T_z Q² (4.28).

        Raises:
            AllanjaxError: no sample interval.
        """
        xp, T_z = namespace(self, frequency), self.sample_interval
        if isinstance(T_z, float) and T_z == 0.0:
            raise AllanjaxError(
                "the PSD of quantization depends on the sample rate: use model.sampled(rate).psd(f)"
            )
        return 4.0 * self.coefficient**2 / T_z * xp.sin(np.pi * xp.asarray(frequency) * T_z) ** 2

    def sampled_psd(self, frequency: Float[ArrayLike, ...], rate: float) -> Float[Array, ...]:
        return self.sampled(rate).psd(frequency)

    def end_effect(self, frequency: Float[ArrayLike, ...], rate: float) -> Float[Array, ...]:
        """Power of the first and last reading's errors, which no neighbouring increment takes back."""
        xp = namespace(self, frequency, rate)
        a = 2.0 * np.pi * xp.asarray(frequency) / rate
        return 2.0 * (self.coefficient * rate) ** 2 * (1.0 + xp.cos(a))

    def simulate(self, key: PRNGKeyArray, n: int, rate: float) -> Float[Array, " n"]:
        return self.coefficient * rate * jnp.diff(jax.random.normal(key, (n + 1,)))

    def parts(self, rate: float) -> Parts:
        return Parts(0.0, (self.coefficient * rate) ** 2, 0.0, NO_POLES)

    def state_block(self, rate: float, duration: float | None) -> Block:
        """States: the errors of the angle at the end of a sample interval and at its beginning."""
        noise = self.coefficient**2 * np.diag([1.0, 0.0])
        transition = np.array([[0.0, 0.0], [1.0, 0.0]])
        start = self.coefficient**2 * np.eye(2)
        names = ("now", "before")
        return block(transition, [rate, -rate], noise, start, names, time_exponents=(1.0, 1.0))

"""Drift rate ramp (thesis 4.3.5)."""

from __future__ import annotations

from typing import ClassVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, PRNGKeyArray

from allanjax.base.arrays import namespace
from allanjax.noise.model import NoiseTerm
from allanjax.noise.parameter import Value, option, parameter
from allanjax.noise.state_space import Block, block


class DriftRamp(NoiseTerm):
    """Linear drift of the rate, Ω = R·t: σ²(T) = R²T²/2 (4.56).

    `coefficient` R in rad/s² or m/s³; the Allan curve determines |R| only, and with the
    `sign` −1 it falls. The ramp is deterministic, but
    R²t⁴/24 serves as its phase covariance: second differences over T_i and T_j then have the product
    R²T_i²T_j², as they should.
    """

    coefficient: Value = parameter("R", time_exponent=-1.0)
    sign: int = option(1)
    deterministic: ClassVar[bool] = True

    def phase_covariance(self, lag: Float[Array, ...]) -> Float[Array, ...]:
        return self.coefficient**2 * lag**4 / 24.0

    @np.errstate(divide="ignore")
    def psd(self, frequency: Float[ArrayLike, ...]) -> Float[Array, ...]:
        """Flicker-acceleration spectrum R²/(2πf)³, which has the same slope in the Allan plot (4.58)."""
        xp = namespace(self, frequency)
        return self.coefficient**2 / xp.abs(2.0 * np.pi * xp.asarray(frequency, float)) ** 3

    def column(self, time: Float[Array | np.ndarray, " n"]) -> Float[Array, " n"]:
        return self.sign * namespace(self, time).asarray(time)

    def simulate(self, key: PRNGKeyArray, n: int, rate: float) -> Float[Array, " n"]:
        return self.coefficient * self.column((jnp.arange(n) + 0.5) / rate)

    def state_block(self, rate: float, duration: float | None) -> Block:
        """States: the drift at the middle of a sample interval, and its slope, of unknown sign."""
        at_first = np.array([0.5 / rate, 1.0])
        transition = np.array([[1.0, 1.0 / rate], [0.0, 1.0]])
        start = self.coefficient**2 * np.outer(at_first, at_first)
        names, exponents = ("value", "slope"), (0.0, -1.0)
        return block(transition, [1.0, 0.0], np.zeros((2, 2)), start, names, time_exponents=exponents)

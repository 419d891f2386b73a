"""Transients: deterministic effects that happen once, at a known place in the record."""

from __future__ import annotations

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, PRNGKeyArray

from allanjax.base.arrays import namespace
from allanjax.base.errors import AllanjaxError
from allanjax.noise.model import NoiseTerm
from allanjax.noise.parameter import Value
from allanjax.noise.state_space import Block


class Transient(NoiseTerm):
    """Deterministic effect `amplitude`·`column(time)`, known but for its amplitude.

    Its second differences depend on where in the record they are, so that it has neither a spectrum nor an
    Allan variance of its own: both are zero here. Fits take it out of the record (`objective="whittle"`),
    with its shape held, and report the magnitude of its amplitude.
    """

    amplitude: eqx.AbstractVar[Value]
    deterministic: ClassVar[bool] = True

    def phase_covariance(self, lag: Float[Array, ...]) -> Float[Array, ...]:
        return namespace(self, lag).zeros(np.shape(lag))

    def psd(self, frequency: Float[ArrayLike, ...]) -> Float[Array, ...]:
        return namespace(self, frequency).zeros(np.shape(frequency))

    def state_block(self, rate: float, duration: float | None) -> Block:
        raise AllanjaxError(
            f"{self.name()} happens once and is not noise: subtract amplitude·column(time) from the samples, "
            f"and leave the term out, model.without(['{self.name()}'])"
        )

    def simulate(self, key: PRNGKeyArray, n: int, rate: float) -> Float[Array, " n"]:
        return self.amplitude * self.column((jnp.arange(n) + 0.5) / rate)

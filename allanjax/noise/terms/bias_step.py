"""Bias step: the bias changes once, and stays."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from allanjax.noise.parameter import Value, parameter
from allanjax.noise.terms.transient import Transient


class BiasStep(Transient):
    """Zero before `time` [s since the record's start], then `amplitude` [rad/s or m/s²].

    Not in the thesis. A sample belongs to where its interval has its middle.
    """

    amplitude: Value = parameter("Δ", time_exponent=0.0)
    time: Value = parameter("t_s", "time")

    def column(self, time: Float[Array, " n"]) -> Float[Array, " n"]:
        return jnp.where(time >= self.time, 1.0, 0.0)

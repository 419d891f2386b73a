"""Warm-up: the bias settles exponentially after switching on."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from allanjax.noise.parameter import Value, parameter
from allanjax.noise.terms.transient import Transient


class WarmUp(Transient):
    """`amplitude`·e^{−t/τ}, t since the record's start: a first-order approach to thermal equilibrium.

    Not in the thesis. `amplitude` in rad/s or m/s², `time_constant` τ in s.
    """

    amplitude: Value = parameter("W", time_exponent=0.0)
    time_constant: Value = parameter("τ", "time")

    def column(self, time: Float[Array, " n"]) -> Float[Array, " n"]:
        return jnp.exp(-time / self.time_constant)

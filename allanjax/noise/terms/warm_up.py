"""Warm-up: exponential settling of the bias after switching on."""

from __future__ import annotations

import numpy as np
from jaxtyping import Array, Float

from allanjax.base.arrays import namespace
from allanjax.noise.parameter import Value, parameter
from allanjax.noise.terms.transient import Transient


class WarmUp(Transient):
    """Exponential settling `amplitude`·e^{−t/τ}, t since the record's start.

    Not in the thesis: a first-order approach to thermal equilibrium. `amplitude` in rad/s or m/s²,
        `time_constant` τ in s.
    """

    amplitude: Value = parameter("W", time_exponent=0.0)
    time_constant: Value = parameter("τ", "time")

    def column(self, time: Float[Array | np.ndarray, " n"]) -> Float[Array, " n"]:
        return namespace(self, time).exp(-time / self.time_constant)

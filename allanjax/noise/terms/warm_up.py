"""Warm-up: exponential settling of the bias after switching on."""

from __future__ import annotations

import numpy as np
from jaxtyping import Array, Float

from allanjax.base.arrays import namespace
from allanjax.noise.parameter import Value, option, parameter
from allanjax.noise.terms.transient import Transient


class WarmUp(Transient):
    """Exponential settling `amplitude`·e^{−t/τ}, t since the record's start.

    Not in the thesis: a first-order approach to thermal equilibrium. `amplitude` in rad/s or m/s²,
    `time_constant` τ in s; with the `sign` −1 the bias begins below where it settles.
    """

    amplitude: Value = parameter("W", time_exponent=0.0)
    time_constant: Value = parameter("τ", "time")
    sign: int = option(1)

    def column(self, time: Float[Array | np.ndarray, " n"]) -> Float[Array, " n"]:
        return self.sign * namespace(self, time).exp(-time / self.time_constant)

"""Bias step: a single lasting change of the bias."""

from __future__ import annotations

import numpy as np
from jaxtyping import Array, Float

from allanjax.base.arrays import namespace
from allanjax.noise.parameter import Value, option, parameter
from allanjax.noise.terms.transient import Transient


class BiasStep(Transient):
    """Step of the bias by `amplitude` [rad/s or m/s²] at `time` [s since the record's start].

    Not in the thesis. A sample lies before or after the step with the middle of its interval. With the `sign`
    −1 it is a step down.
    """

    amplitude: Value = parameter("Δ", time_exponent=0.0)
    time: Value = parameter("t_s", "time")
    sign: int = option(1)

    def column(self, time: Float[Array | np.ndarray, " n"]) -> Float[Array, " n"]:
        return namespace(self, time).where(time >= self.time, 1.0 * self.sign, 0.0)

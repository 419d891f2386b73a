"""Bias step: a single lasting change of the bias."""

from __future__ import annotations

import numpy as np
from jaxtyping import Array, Float

from allanjax.base.arrays import namespace
from allanjax.noise.parameter import Value, parameter
from allanjax.noise.terms.transient import Transient


class BiasStep(Transient):
    """Step of the bias by `amplitude` [rad/s or m/s²] at `time` [s since the record's start].

    Not in the thesis. A sample lies before or after the step with the middle of its interval.
    """

    amplitude: Value = parameter("Δ", time_exponent=0.0)
    time: Value = parameter("t_s", "time")

    def column(self, time: Float[Array | np.ndarray, " n"]) -> Float[Array, " n"]:
        return namespace(self, time).where(time >= self.time, 1.0, 0.0)

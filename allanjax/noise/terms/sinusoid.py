"""Sinusoidal noise (thesis 4.3.7)."""

from __future__ import annotations

import math
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, PRNGKeyArray

from allanjax.base.arrays import namespace
from allanjax.noise.model import NoiseTerm
from allanjax.noise.numerics import in_gauge
from allanjax.noise.parameter import Value, parameter
from allanjax.noise.state_space import Block, block


class Sinusoid(NoiseTerm):
    """A line of the rate, Ω0·cos(2πf0·t + φ): σ²(T) = Ω0² [sin²(πf0T)/(πf0T)]² (4.64).

    `amplitude` Ω0 in rad/s or m/s²; `frequency` f0 in Hz. (4.64) is for a sensor that averages over its
    sample interval, as in (4.1), which damps a line by sin(πf0t0)/(πf0t0). In fits and simulations at a
    known rate (`sampled`) Ω0 is the amplitude that the samples show. A simulation draws the phase φ at the
    record's start, unless it has a value [rad]; fits have no use for one.

    The thesis's (4.63) in (4.25) gives twice (4.64). A line of amplitude Ω0 has the PSD
    (Ω0²/4)[δ(f−f0) + δ(f+f0)], and (4.64) is right.
    """

    amplitude: Value = parameter("Ω0", time_exponent=0.0)
    frequency: Value = parameter("f0", "line")
    #: Sample interval [s]; 0 for the continuous rate.
    sample_interval: float = 0.0
    phase: Value = None
    deterministic: ClassVar[bool] = True

    @property
    def oscillates(self) -> bool:
        return True

    def sampled(self, rate: float) -> Sinusoid:
        return self.replace(sample_interval=1.0 / rate)

    def _damping(self) -> Float[Array, ""]:
        """Ratio of the samples' amplitude to that of the continuous line that they are means of."""
        return namespace(self).sinc(self.frequency * self.sample_interval)

    def phase_covariance(self, lag: Float[Array, ...]) -> Float[Array, ...]:
        xp, w = namespace(self, lag), 2.0 * np.pi * self.frequency

        def series(x: Float[Array, ...]) -> Float[Array, ...]:
            total = xp.zeros_like(x)
            for k in range(10, 1, -1):
                total = total * x**2 + (-1) ** k / math.factorial(2 * k)
            return total * x**4

        wave = in_gauge(series, lambda x: -2.0 * xp.sin(x / 2.0) ** 2, w * lag)
        return self.amplitude**2 / (2.0 * w**2) * wave / self._damping() ** 2

    def psd(self, frequency: Float[ArrayLike, ...]) -> Float[Array, ...]:
        """Zero density: a line's power Ω0²/2 is all at its own frequency."""
        return namespace(self, frequency).zeros(np.shape(frequency))

    def state_block(self, rate: float, duration: float | None) -> Block:
        """States: the line, and itself a quarter of a period before; their phase is unknown."""
        a = 2.0 * np.pi * self.frequency / rate
        transition = np.array([[np.cos(a), np.sin(a)], [-np.sin(a), np.cos(a)]])
        start = self.amplitude**2 / 2.0 * np.eye(2)
        return block(transition, [1.0, 0.0], np.zeros((2, 2)), start, ("cosine", "sine"))

    def simulate(self, key: PRNGKeyArray, n: int, rate: float) -> Float[Array, " n"]:
        """Simulated line with its phase, a random one if it has none."""
        amplitude = self.amplitude * (jnp.sinc(self.frequency / rate) if self.sample_interval == 0.0 else 1.0)
        cycles = self.frequency / rate * jnp.arange(n) % 1.0
        start = jax.random.uniform(key)
        if self.phase is not None:
            # At the middle of the first sample's interval.
            start = self.phase / (2.0 * jnp.pi) + 0.5 * self.frequency / rate
        return amplitude * jnp.cos(2.0 * jnp.pi * (cycles + start))

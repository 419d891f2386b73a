"""Resonance whose frequency wanders during the record."""

from __future__ import annotations

import functools
import math
import operator
from collections.abc import Iterable
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, PRNGKeyArray

from allanjax.base.arrays import namespace
from allanjax.noise.model import NoiseTerm
from allanjax.noise.parameter import Value, parameter
from allanjax.noise.response import Parts, Poles
from allanjax.noise.state_space import Block, together
from allanjax.noise.terms.resonance import Resonance

# Nodes of the quadrature over the frequency: the spectrum stays smooth for spreads up to the width f0/Q_f.
_NODES, _WEIGHTS = np.polynomial.hermite_e.hermegauss(11)
_SHARES = _WEIGHTS / _WEIGHTS.sum()


class WanderingResonance(NoiseTerm):
    """Noise of a damped oscillator (`Resonance`) whose frequency is spread by a normal law over the record.

    Not in the thesis, but in sensors whose resonances move, with temperature say. `amplitude` is the RMS of
    the rate [rad/s or m/s²], `frequency` f0 in Hz the mean, `quality_factor` Q_f above ½ that at any moment,
    `spread` Δf in Hz the standard deviation of the frequency. The spectrum is that of eleven oscillators, at
    the nodes of Gauss and Hermite.
    """

    amplitude: Value = parameter("σ", time_exponent=0.0)
    frequency: Value = parameter("f0", "line")
    quality_factor: Value = parameter("Q_f", "number", lower=0.5)
    spread: Value = parameter("Δf", "frequency")
    #: Sample interval [s]; 0 for the continuous rate.
    sample_interval: float = 0.0
    narrow_band: ClassVar[bool] = True

    def sampled(self, rate: float) -> WanderingResonance:
        return self.replace(sample_interval=1.0 / rate)

    def _oscillators(self) -> list[Resonance]:
        """Oscillators that together have the spectrum; at the lowest of frequencies they stay above zero."""
        xp = namespace(self)
        frequencies = xp.asarray(self.frequency, float)[..., None] + _NODES * self.spread
        lowest = 0.01 * xp.asarray(self.frequency, float)
        return [
            Resonance(
                self.amplitude * math.sqrt(share),
                xp.maximum(frequencies[..., k], lowest),
                self.quality_factor,
                sample_interval=self.sample_interval,
            )
            for k, share in enumerate(_SHARES)
        ]

    def phase_covariance(self, lag: Float[Array, ...]) -> Float[Array, ...]:
        return _sum(one.phase_covariance(lag) for one in self._oscillators())

    def power_scatter(self, duration: Float[ArrayLike, ""]) -> Float[Array, ""]:
        """Relative variance of the mean square: the oscillators' powers fluctuate each by itself."""
        own = (one.power_scatter(duration) for one in self._oscillators())
        return _sum(share**2 * scatter for share, scatter in zip(_SHARES, own, strict=True))

    def psd(self, frequency: Float[ArrayLike, ...]) -> Float[Array, ...]:
        return _sum(one.psd(frequency) for one in self._oscillators())

    def sampled_psd(self, frequency: Float[ArrayLike, ...], rate: float) -> Float[Array, ...]:
        return _sum(one.sampled_psd(frequency, rate) for one in self._oscillators())

    def parts(self, rate: float) -> Parts:
        xp = namespace(self, rate)
        poles = [one.parts(rate).poles for one in self._oscillators()]
        joined = (xp.concatenate(x) for x in zip(*poles, strict=True))
        return Parts(0.0, 0.0, 0.0, Poles(*joined))

    def state_block(self, rate: float, duration: float | None) -> Block:
        blocks = (one.state_block(rate, duration) for one in self._oscillators())
        return together([b.labelled(str(k + 1)) for k, b in enumerate(blocks)])

    def simulate(self, key: PRNGKeyArray, n: int, rate: float) -> Float[Array, " n"]:
        """Simulated samples: a stationary process with this spectrum."""
        keys = jax.random.split(key, len(_SHARES))
        draws = [one.simulate(k, n, rate) for k, one in zip(keys, self._oscillators(), strict=True)]
        return jnp.sum(jnp.stack(draws), axis=0)


def _sum(values: Iterable[Array]) -> Array:
    """Sum of at least one array."""
    return functools.reduce(operator.add, values)

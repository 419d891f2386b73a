"""Deterministic terms: rate ramp (thesis 4.3.5), line (4.3.7), and transients, which happen once."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import ClassVar, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from allanjax.base.arrays import as_array, namespace
from allanjax.base.errors import AllanjaxError
from allanjax.noise.model import NoiseTerm
from allanjax.noise.parameter import Value, option, parameter
from allanjax.noise.process import Reals, RealsLike, Samples, in_gauge
from allanjax.noise.state_space import Block

_Times: TypeAlias = Float[Array | np.ndarray, " n"]


class DriftRamp(NoiseTerm):
    """Linear drift of the rate, Ω = R·t: σ²(T) = R²T²/2 (4.56).

    `coefficient` R in rad/s² or m/s³. The Allan curve determines |R| only; with `sign` −1 the rate falls. The
    ramp is deterministic, but R²t⁴/24 serves as its phase covariance: second differences over T_i and T_j
    then have the product R²T_i²T_j², as they should.
    """

    coefficient: Value = parameter("R", time_exponent=-1.0)
    sign: int = option(1)
    deterministic: ClassVar[bool] = True

    def phase_covariance(self, lag: Reals) -> Reals:
        return self.coefficient**2 * lag**4 / 24.0

    @np.errstate(divide="ignore")
    def psd(self, frequency: RealsLike) -> Reals:
        """Flicker-acceleration spectrum R²/(2πf)³, which has the same slope in the Allan plot (4.58)."""
        xp, f = as_array(frequency, self)
        return self.coefficient**2 / xp.abs(2.0 * np.pi * f) ** 3

    def column(self, time: _Times) -> Samples:
        return self.sign * namespace(self, time).asarray(time)

    def simulate(self, key: PRNGKeyArray, n: int, rate: float) -> Samples:
        return self.coefficient * self.column((jnp.arange(n) + 0.5) / rate)

    def state_block(self, rate: float, duration: float | None) -> Block:
        """States: the drift at the middle of a sample interval, and its slope, of unknown sign."""
        at_first = np.array([0.5 / rate, 1.0])
        transition = np.array([[1.0, 1.0 / rate], [0.0, 1.0]])
        start = self.coefficient**2 * np.outer(at_first, at_first)
        names, exponents = ("value", "slope"), (0.0, -1.0)
        return Block(transition, [1.0, 0.0], np.zeros((2, 2)), start, names, time_exponents=exponents)


class Sinusoid(NoiseTerm):
    """A line of the rate, Ω0·cos(2πf0·t + φ): σ²(T) = Ω0² [sin²(πf0T)/(πf0T)]² (4.64).

    `amplitude` Ω0 in rad/s or m/s²; `frequency` f0 in Hz. (4.64) is for a sensor that averages over its
    sample interval, as in (4.1), which damps a line by sin(πf0t0)/(πf0t0). In fits and simulations at a
    known rate (`sampled`) Ω0 is the amplitude of the samples. A simulation draws the phase φ at the record's
    start unless it has a value [rad]; fits ignore it.

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

    def phase_covariance(self, lag: Reals) -> Reals:
        xp, w = namespace(self, lag), 2.0 * np.pi * self.frequency

        def series(x: Reals) -> Reals:
            total = xp.zeros_like(x)
            for k in range(10, 1, -1):
                total = total * x**2 + (-1) ** k / math.factorial(2 * k)
            return total * x**4

        wave = in_gauge(series, lambda x: -2.0 * xp.sin(x / 2.0) ** 2, w * lag)
        # Samples are means of the continuous line, which damps it.
        damping = namespace(self).sinc(self.frequency * self.sample_interval)
        return self.amplitude**2 / (2.0 * w**2) * wave / damping**2

    def state_block(self, rate: float, duration: float | None) -> Block:
        """States: the line, and itself a quarter of a period before; their phase is unknown."""
        a = 2.0 * np.pi * self.frequency / rate
        transition = np.array([[np.cos(a), np.sin(a)], [-np.sin(a), np.cos(a)]])
        start = self.amplitude**2 / 2.0 * np.eye(2)
        return Block(transition, [1.0, 0.0], np.zeros((2, 2)), start, ("cosine", "sine"))

    def simulate(self, key: PRNGKeyArray, n: int, rate: float) -> Samples:
        """Simulated line with its phase, a random one if it has none."""
        amplitude = self.amplitude * (jnp.sinc(self.frequency / rate) if self.sample_interval == 0.0 else 1.0)
        cycles = self.frequency / rate * jnp.arange(n) % 1.0
        start = jax.random.uniform(key)
        if self.phase is not None:
            # At the middle of the first sample's interval.
            start = self.phase / (2.0 * jnp.pi) + 0.5 * self.frequency / rate
        return amplitude * jnp.cos(2.0 * jnp.pi * (cycles + start))


class Transient(NoiseTerm):
    """Deterministic effect `amplitude`·`column(time)`, known but for its amplitude.

    Its second differences depend on their place in the record, so it has neither a spectrum nor an Allan
    variance of its own: both are zero here. Fits subtract it from the record (`objective="whittle"`), with
    its shape held, and report the magnitude of its amplitude.
    """

    amplitude: eqx.AbstractVar[Value]
    deterministic: ClassVar[bool] = True

    def phase_covariance(self, lag: Reals) -> Reals:
        return namespace(self, lag).zeros(np.shape(lag))

    def state_block(self, rate: float, duration: float | None) -> Block:
        raise AllanjaxError(
            f"{self.name()} happens once and is not noise: subtract amplitude·column(time) from the samples, "
            f"and leave the term out, model.without(['{self.name()}'])"
        )

    def simulate(self, key: PRNGKeyArray, n: int, rate: float) -> Samples:
        return self.amplitude * self.column((jnp.arange(n) + 0.5) / rate)


class BiasStep(Transient):
    """Step of the bias by `amplitude` [rad/s or m/s²] at `time` [s since the record's start].

    Not in the thesis. The middle of a sample's interval decides whether it is before or after the step. With
    `sign` −1 it is a step down.
    """

    amplitude: Value = parameter("Δ", time_exponent=0.0)
    time: Value = parameter("t_s", "time")
    sign: int = option(1)

    def column(self, time: _Times) -> Samples:
        return namespace(self, time).where(time >= self.time, 1.0 * self.sign, 0.0)


class WarmUp(Transient):
    """Exponential settling `amplitude`·e^{−t/τ}, t since the record's start.

    Not in the thesis: a first-order approach to thermal equilibrium. `amplitude` in rad/s or m/s²,
    `time_constant` τ in s; with `sign` −1 the bias begins below its final value.
    """

    amplitude: Value = parameter("W", time_exponent=0.0)
    time_constant: Value = parameter("τ", "time")
    sign: int = option(1)

    def column(self, time: _Times) -> Samples:
        return self.sign * namespace(self, time).exp(-time / self.time_constant)


class ChannelEffect(Transient):
    """Effect `sign`·`amplitude`·[channel(t − lag) − `reference`] of another recorded channel.

    Not in the thesis. The amplitude is in rad/s or m/s² per unit of the channel, which is taken as constant
    before its first sample. A simulation leaves the effect out until `given` has provided the samples.
    """

    amplitude: Value = parameter("c", time_exponent=0.0)
    lag: Value = parameter("t_l", "time", lower=-1e-9)
    sign: int = option(1)
    channel: str = eqx.field(static=True, default="")
    reference: Value = 0.0
    samples: _Times | None = None
    rate: float = eqx.field(static=True, default=0.0)

    @property
    def missing_channel(self) -> str:
        return self.channel if self.samples is None else ""

    def given(self, channels: Mapping[str, Float[np.ndarray, " n"]], rate: float) -> ChannelEffect:
        if self.channel not in channels:
            return self
        return self.replace(samples=np.asarray(channels[self.channel], float), rate=float(rate))

    def column(self, time: _Times) -> Samples:
        if self.samples is None:
            raise AllanjaxError(f"{self.name()} needs the samples of {self.channel!r}")
        xp = namespace(self, time)
        at = (xp.arange(len(self.samples)) + 0.5) / self.rate
        return self.sign * (xp.interp(time - self.lag, at, self.samples) - self.reference)

    def simulate(self, key: PRNGKeyArray, n: int, rate: float) -> Samples:
        return jnp.zeros(n) if self.samples is None else super().simulate(key, n, rate)

    def __repr__(self) -> str:
        return f"{super().__repr__()[:-1]}, channel={self.channel!r})"

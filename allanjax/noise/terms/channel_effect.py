"""Effect of another channel, such as temperature, on the rate."""

from __future__ import annotations

from collections.abc import Mapping

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from allanjax.base.arrays import namespace
from allanjax.base.errors import AllanjaxError
from allanjax.noise.parameter import Value, option, parameter
from allanjax.noise.terms.transient import Transient


class ChannelEffect(Transient):
    """Effect `sign`·`amplitude`·[channel(t − lag) − `reference`] of a channel that was recorded, too.

    Not in the thesis. The amplitude is in rad/s or m/s² per unit of the channel. Until it is given the
    channel's samples (`given`), a simulation leaves the effect out; before its first sample a channel had
    that value.
    """

    amplitude: Value = parameter("c", time_exponent=0.0)
    lag: Value = parameter("t_l", "time", lower=-1e-9)
    sign: int = option(1)
    channel: str = eqx.field(static=True, default="")
    reference: Value = 0.0
    samples: Float[Array | np.ndarray, " n"] | None = None
    rate: float = eqx.field(static=True, default=0.0)

    @property
    def missing_channel(self) -> str:
        return self.channel if self.samples is None else ""

    def given(self, channels: Mapping[str, Float[np.ndarray, " n"]], rate: float) -> ChannelEffect:
        if self.channel not in channels:
            return self
        return self.replace(samples=np.asarray(channels[self.channel], float), rate=float(rate))

    def column(self, time: Float[Array | np.ndarray, " n"]) -> Float[Array, " n"]:
        if self.samples is None:
            raise AllanjaxError(f"{self.name()} needs the samples of {self.channel!r}")
        xp = namespace(self, time)
        at = (xp.arange(len(self.samples)) + 0.5) / self.rate
        return self.sign * (xp.interp(time - self.lag, at, self.samples) - self.reference)

    def simulate(self, key: PRNGKeyArray, n: int, rate: float) -> Float[Array, " n"]:
        return jnp.zeros(n) if self.samples is None else super().simulate(key, n, rate)

    def __repr__(self) -> str:
        return f"{super().__repr__()[:-1]}, channel={self.channel!r})"

"""Resonance: narrow-band noise of a damped oscillator driven by white noise."""

from __future__ import annotations

from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Complex, Float, PRNGKeyArray

from allanjax.base.arrays import namespace
from allanjax.noise.model import NoiseTerm
from allanjax.noise.numerics import (
    exponential_covariance,
    exponential_density,
    is_continuous,
    linear_recurrence,
)
from allanjax.noise.parameter import Value, parameter
from allanjax.noise.response import Parts, Poles
from allanjax.noise.state_space import Block, oscillator_block

# Aliases on either side that are summed.
_ALIASES = 8


class Resonance(NoiseTerm):
    """Noise of a damped oscillator, Ω'' + (ω0/Q_f)Ω' + ω0²Ω = white noise.

    Not in the thesis, but in sensors. `amplitude` is the RMS of the rate [rad/s or m/s²], `frequency` f0 =
    ω0/2π in Hz, `quality_factor` Q_f above ½ (underdamped). Its autocovariance is R(t) = σ² e^{−at}[cos ω_d t
    + (a/ω_d) sin ω_d t] with a = ω0/2Q_f, ω_d² = ω0² − a²; G is −R integrated twice. In fits and simulations
    at a known rate (`sampled`) the oscillator is read at the sample instants; otherwise averaged between
    them.
    """

    amplitude: Value = parameter("σ", time_exponent=0.0)
    frequency: Value = parameter("f0", "line")
    quality_factor: Value = parameter("Q_f", "number", lower=0.5)
    #: Sample interval [s]; 0 for the continuous rate.
    sample_interval: float = 0.0
    narrow_band: ClassVar[bool] = True

    def sampled(self, rate: float) -> Resonance:
        return self.replace(sample_interval=1.0 / rate)

    def _poles(self) -> tuple[Complex[Array, ""], Complex[Array, ""]]:
        """Pole λ and weight c of the autocovariance R(t) = σ² Re[c·e^{λt}]."""
        xp = namespace(self)
        w0 = 2.0 * np.pi * xp.asarray(self.frequency, float)
        a = w0 / (2.0 * self.quality_factor)
        wd = w0 * xp.sqrt(1.0 - 1.0 / (4.0 * self.quality_factor**2))
        return -a + wd * 1j, 1.0 - a / wd * 1j

    def phase_covariance(self, lag: Float[Array, ...]) -> Float[Array, ...]:
        pole, c = self._poles()
        return self.amplitude**2 * exponential_covariance(pole, c, lag, self.sample_interval)

    def power_scatter(self, duration: Float[ArrayLike, ""]) -> Float[Array, ""]:
        """Relative variance 2∫R²/(R(0)²·duration) = Q_f/(π f0·duration), for Q_f not near ½."""
        return self.quality_factor / (np.pi * self.frequency * namespace(self, duration).asarray(duration))

    def psd(self, frequency: Float[ArrayLike, ...]) -> Float[Array, ...]:
        """Two-sided PSD 2σ²(ω0³/Q_f)/[(ω0² − ω²)² + (ω0ω/Q_f)²]."""
        w0 = 2.0 * np.pi * self.frequency
        w = 2.0 * np.pi * namespace(self, frequency).asarray(frequency)
        shape = (w0**2 - w**2) ** 2 + (w0 * w / self.quality_factor) ** 2
        return 2.0 * self.amplitude**2 * w0**3 / self.quality_factor / shape

    def sampled_psd(self, frequency: Float[ArrayLike, ...], rate: float) -> Float[Array, ...]:
        """PSD of the oscillator at the sample instants, or of its means between them."""
        if is_continuous(self.sample_interval):
            # For means, Σ_m psd(f + m·rate)·sinc²: aliases fall off with the sixth power.
            xp = namespace(self, frequency, rate)
            aliases = xp.asarray(frequency, float)[..., None] + rate * np.arange(-_ALIASES, _ALIASES + 1)
            return xp.sum(self.psd(aliases) * xp.sinc(aliases / rate) ** 2, axis=-1)
        pole, c = self._poles()
        return self.amplitude**2 * exponential_density(pole, c, frequency, rate, self.sample_interval)

    def parts(self, rate: float) -> Parts:
        xp = namespace(self, rate)
        pole, c = self._poles()
        w, half = xp.exp(pole / rate), self.amplitude**2 * c / 2.0
        poles = Poles(xp.stack([w, xp.conj(w)]), xp.stack([half, xp.conj(half)]))
        return Parts(0.0, 0.0, 0.0, poles)

    def state_block(self, rate: float, duration: float | None) -> Block:
        return oscillator_block(self.amplitude**2, complex(self._poles()[0] / rate))

    def simulate(self, key: PRNGKeyArray, n: int, rate: float) -> Float[Array, " n"]:
        """Simulated samples by the exact recursion of position and velocity, as one complex mode."""
        if is_continuous(self.sample_interval):
            return super().simulate(key, n, rate)
        pole, _ = self._poles()
        w0 = 2.0 * jnp.pi * self.frequency
        step = jnp.exp(pole / rate)
        # z = velocity − λ̄·position obeys z' = λz + drive, and position = Im z / Im λ. Stationary moments
        # of z follow from those of position (σ²) and velocity (σ²ω0²), which are uncorrelated.
        power = 2.0 * self.amplitude**2 * w0**2
        pseudo = self.amplitude**2 * (w0**2 + jnp.conj(pole) ** 2)
        first, second = jax.random.normal(key, (2, n))

        def draw(share: Float[Array, ""], pseudo_share: Complex[Array, ""]) -> Complex[Array, " n"]:
            """Complex Gaussians with E|z|² = share·power and E z² = pseudo_share·pseudo."""
            p, s = share * power, pseudo_share * pseudo
            re, im, cross = (p + s.real) / 2.0, (p - s.real) / 2.0, s.imag / 2.0
            tilt = cross / jnp.sqrt(re)
            return jnp.sqrt(re) * first + 1j * (
                tilt * first + jnp.sqrt(jnp.maximum(im - tilt**2, 0.0)) * second
            )

        drive = draw(1.0 - jnp.abs(step) ** 2, 1.0 - step**2)
        start = draw(jnp.asarray(1.0), jnp.asarray(1.0 + 0j))
        mode = linear_recurrence(step, jnp.where(jnp.arange(n) == 0, start, drive))
        return mode.imag / pole.imag

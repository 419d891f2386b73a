"""Bias instability: flicker noise of the rate (thesis 4.3.3)."""

from __future__ import annotations

import math

import jax.numpy as jnp
from jax.scipy.special import sici, zeta
from jaxtyping import Array, ArrayLike, Float

from allanjax.noise.model import NoiseTerm
from allanjax.noise.parameter import Value, parameter

# Aliases on either side summed where a cutoff rules out a closed form; the rest is below 1e-3 of the first.
_ALIASES = 16


class BiasInstability(NoiseTerm):
    """Flicker (1/f) noise of the rate up to a cutoff f0 (4.38, 4.48): σ(T) → 0.664·B (4.51).

    `coefficient` B in rad/s or m/s². `cutoff_frequency` f0 in Hz: infinite (the default) is the plain
    1/f law, None has a fit estimate it, a number is a start for the fit (hold it with `hold`).

    The thesis's (4.44) has the wrong sign, Ci(x) = −∫ₓ^∞ cos t/t dt; (4.46)–(4.48) use the right one.
    """

    coefficient: Value = parameter("B", time_exponent=0.0)
    cutoff_frequency: Value = parameter("f0", "frequency", default=math.inf)

    def _has_no_cutoff(self) -> bool:
        """Whether the noise is flicker at all frequencies."""
        return isinstance(self.cutoff_frequency, float) and math.isinf(self.cutoff_frequency)

    @property
    def oscillates(self) -> bool:
        return not self._has_no_cutoff()

    def phase_covariance(self, lag: Float[Array, ...]) -> Float[Array, ...]:
        B2 = self.coefficient**2
        if self._has_no_cutoff():
            t = jnp.where(lag > 0.0, lag, 1.0)
            return B2 / (2.0 * jnp.pi) * t**2 * jnp.log(t) * (lag > 0.0)
        w0 = 2.0 * jnp.pi * self.cutoff_frequency
        return B2 / (jnp.pi * w0**2) * _cutoff_flicker(w0 * lag)

    def psd(self, frequency: Float[ArrayLike, ...]) -> Float[Array, ...]:
        f = jnp.abs(jnp.asarray(frequency))
        return jnp.where(f <= self.cutoff_frequency, self.coefficient**2 / (2.0 * jnp.pi * f), 0.0)

    def at_low_frequencies(self) -> BiasInstability:
        return self.replace(cutoff_frequency=math.inf)

    def sampled_psd(self, frequency: Float[ArrayLike, ...], rate: float) -> Float[Array, ...]:
        """PSD with aliases, Σ_m psd(f + m·rate)·sinc²: without a cutoff a sum of Hurwitz's zeta."""
        u = jnp.asarray(frequency, float) / rate
        sine = (jnp.sin(jnp.pi * u) / jnp.pi) ** 2 * self.coefficient**2 / (2.0 * jnp.pi * rate)
        if self._has_no_cutoff():
            return sine * (zeta(3.0, u) + zeta(3.0, 1.0 - u))
        m = jnp.arange(-_ALIASES, _ALIASES + 1)
        f = jnp.abs(u[..., None] + m)
        return sine * jnp.sum(jnp.where(f * rate <= self.cutoff_frequency, f**-3.0, 0.0), axis=-1)


def _cutoff_flicker(x: Float[Array, ...]) -> Float[Array, ...]:
    """Scaled G of flicker noise with a cutoff at x = 2πf0·t, in a gauge that vanishes like x⁴.

    ½ − cos(x)/2 + x sin(x)/2 + x² Cin(x)/2 − ¾x².

    Cin(x) = ∫₀ˣ (1 − cos t)/t dt = γ + ln x − Ci(x). Power series: ½ Σ_{k≥2} (−1)^k x^{2k}/((k−1)(2k)!).
    """
    near = x < 3.0
    y = jnp.where(near, x, 0.0) ** 2
    series = jnp.zeros_like(x)
    for k in range(16, 1, -1):
        series = series * y + (-1) ** k / ((k - 1) * math.factorial(2 * k))
    far = jnp.where(near, 3.0, x)
    cin = jnp.euler_gamma + jnp.log(far) - sici(far)[1]
    closed = 0.5 - jnp.cos(far) / 2.0 + far * jnp.sin(far) / 2.0 + far**2 * (cin / 2.0 - 0.75)
    return jnp.where(near, 0.5 * series * y**2, closed)

"""Bias instability: flicker noise of the rate (thesis 4.3.3)."""

from __future__ import annotations

import functools
import math

import numpy as np
from jaxtyping import Array, ArrayLike, Float

from allanjax.base.arrays import namespace, special_functions
from allanjax.base.errors import AllanjaxError
from allanjax.noise.model import NoiseTerm
from allanjax.noise.parameter import Value, parameter
from allanjax.noise.response import Parts, Poles
from allanjax.noise.state_space import Block
from allanjax.noise.terms.gauss_markov_sum import gauss_markov_sum
from allanjax.noise.terms.markov import Markov

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
        xp = namespace(self, lag)
        B2 = self.coefficient**2
        if self._has_no_cutoff():
            t = xp.where(lag > 0.0, lag, 1.0)
            return B2 / (2.0 * np.pi) * t**2 * xp.log(t) * (lag > 0.0)
        w0 = 2.0 * np.pi * self.cutoff_frequency
        return B2 / (np.pi * w0**2) * _cutoff_flicker(w0 * lag)

    def parts(self, rate: float) -> Parts:
        if not self._has_no_cutoff():
            return super().parts(rate)
        B2 = self.coefficient**2
        parts, xp = _flicker_parts(), namespace(self, rate)
        poles = Poles(xp.asarray(parts.poles.pole), B2 * xp.asarray(parts.poles.weight))
        return Parts(B2 * parts.white, B2 * parts.difference, 0.0, poles)

    def state_block(self, rate: float, duration: float | None) -> Block:
        """States of Gauss–Markov processes whose sum is flicker noise up to a duration [s]."""
        if not self._has_no_cutoff():
            raise AllanjaxError(
                f"{self.name()} with a cutoff has no finite state space: fit it without one, or Markov()"
            )
        return gauss_markov_sum(self, rate, duration)

    @np.errstate(divide="ignore")
    def psd(self, frequency: Float[ArrayLike, ...]) -> Float[Array, ...]:
        xp = namespace(self, frequency)
        f = xp.abs(xp.asarray(frequency, float))
        return xp.where(f <= self.cutoff_frequency, self.coefficient**2 / (2.0 * np.pi * f), 0.0)

    def at_low_frequencies(self) -> BiasInstability:
        return self.replace(cutoff_frequency=math.inf)

    @np.errstate(divide="ignore", invalid="ignore")
    def sampled_psd(self, frequency: Float[ArrayLike, ...], rate: float) -> Float[Array, ...]:
        """PSD with aliases, Σ_m psd(f + m·rate)·sinc²: without a cutoff a sum of Hurwitz's zeta."""
        xp = namespace(self, frequency, rate)
        u = xp.asarray(frequency, float) / rate
        sine = (xp.sin(np.pi * u) / np.pi) ** 2 * self.coefficient**2 / (2.0 * np.pi * rate)
        if self._has_no_cutoff():
            zeta = special_functions(xp).zeta
            return sine * (zeta(3.0, u) + zeta(3.0, 1.0 - u))
        f = xp.abs(u[..., None] + np.arange(-_ALIASES, _ALIASES + 1))
        return sine * xp.sum(xp.where(f * rate <= self.cutoff_frequency, f**-3.0, 0.0), axis=-1)


# Decay rates per sample, uniform in the logarithm, of Markov processes of variance B²/π whose sum is flicker
# noise; the trapezoidal rule converges exponentially. Filters leave those slower than the first as they are.
_STEP = 0.5
_DECAY = np.exp(np.arange(-25.0, 45.0, _STEP))


@functools.cache
def _flicker_parts() -> Parts:
    """Parts of flicker noise with B = 1, but for what is slower than any filter."""
    each = [Markov(math.sqrt(2.0 * x), 1.0 / x).parts(1.0) for x in _DECAY]
    share = _STEP / math.pi
    pole, weight = (np.concatenate(x) for x in zip(*(p.poles for p in each), strict=True))
    white, difference = (share * sum(getattr(p, name) for p in each) for name in ("white", "difference"))
    there = weight != 0.0
    return Parts(white, difference, 0.0, Poles(pole[there], share * weight[there]))


def _cutoff_flicker(x: Float[Array, ...]) -> Float[Array, ...]:
    """Scaled G of flicker noise with a cutoff at x = 2πf0·t, in a gauge that vanishes like x⁴.

    ½ − cos(x)/2 + x sin(x)/2 + x² Cin(x)/2 − ¾x².

    Cin(x) = ∫₀ˣ (1 − cos t)/t dt = γ + ln x − Ci(x). Power series: ½ Σ_{k≥2} (−1)^k x^{2k}/((k−1)(2k)!).
    """
    xp = namespace(x)
    near = x < 3.0
    y = xp.where(near, x, 0.0) ** 2
    series = xp.zeros_like(x)
    for k in range(16, 1, -1):
        series = series * y + (-1) ** k / ((k - 1) * math.factorial(2 * k))
    far = xp.where(near, 3.0, x)
    cin = np.euler_gamma + xp.log(far) - special_functions(xp).sici(far)[1]
    closed = 0.5 - xp.cos(far) / 2.0 + far * xp.sin(far) / 2.0 + far**2 * (cin / 2.0 - 0.75)
    return xp.where(near, 0.5 * series * y**2, closed)

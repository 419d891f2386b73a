"""The moving average as a response: an integrating converter, or samples that are means of faster ones.

White noise averaged over τ and read every h has the autocovariance (τ − |d|h)+, straight between multiples of
h. With τ/h = m + δ, 0 ≤ δ < 1, it is that of means of m values and of m + 1 values in the proportion of
1 − δ to δ, and so is the power response,

    R = [(1 − δ)F_m + δF_{m+1}]/[(1 − δ)m² + δ(m + 1)²],    F_m = sin²(πmf/rate)/sin²(πf/rate),

with all aliases of sinc²(fτ). Of other noise it is taken to be the same factor.
"""

from __future__ import annotations

import math
from typing import Any, Self

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from allanjax.base.arrays import namespace
from allanjax.base.errors import AllanjaxError
from allanjax.noise.parameter import Value, parameter
from allanjax.noise.process import Process
from allanjax.noise.response import Response

#: Product of bandwidth and duration: sinc²(x) = 1/2, Brent's method.
HALF_POWER = 0.44294647068945237
#: Longest duration [samples]; a filter that averages more leaves nothing to see.
LONGEST = 64

_LARGEST = HALF_POWER * (1.0 + 1e-9)
# Samples on either side beyond which a mean without delay, by a Fourier transform, is as good as over.
_REACH = 2048
# Zeros of the response make a maximum of the likelihood of every number of samples [samples].
_STARTS = (1.5, 2, 2.5, 3, 3.5, *range(4, LONGEST))


class MovingAverage(Response):
    """Mean of what came in over the last τ = 0.443/f_c, as of an integrating converter.

    `bandwidth` f_c in Hz, at which the power of slow noise is halved; a mean of m samples has 0.443·rate/m.
    It is between 0.443/64 and 0.443 of the sample rate: from 64 samples to one, which changes nothing.
    """

    bandwidth: Value = parameter("f_c", "frequency", starts=tuple(HALF_POWER / m for m in _STARTS))

    @classmethod
    def of(cls, duration: float) -> Self:
        """Mean over a duration [s]."""
        return cls(HALF_POWER / duration)

    @property
    def duration(self) -> float:
        """The duration τ [s]."""
        return HALF_POWER / float(self.bandwidth)

    def sampled(self, rate: float) -> Self:
        value = self.bandwidth
        lowest, highest = HALF_POWER * rate / LONGEST, _LARGEST * rate
        if isinstance(value, int | float | np.floating) and not (lowest * (1.0 - 1e-9) <= value <= highest):
            raise AllanjaxError(
                f"moving_average: bandwidth must be from {lowest:.4g} Hz (64 samples) to {highest:.4g} Hz "
                f"(one sample) at {rate:g} Hz, got {value:g}"
            )
        return self

    def power(self, frequency: Float[ArrayLike, ...], rate: float) -> Float[Array, ...]:
        """Power response at frequencies [Hz] for samples at `rate` [Hz]."""
        xp = namespace(self, frequency, rate)
        samples = self._samples(rate)
        x = xp.asarray(frequency, float) / rate
        m = xp.floor(samples)
        share = samples - m

        def mean(m: Any) -> Any:
            """F_m."""
            return (m * xp.sinc(m * x) / xp.sinc(x)) ** 2

        norm = (1.0 - share) * m**2 + share * (m + 1.0) ** 2
        return ((1.0 - share) * mean(m) + share * mean(m + 1.0)) / norm

    def phase_covariance(self, process: Process, lag: Float[Array, ...], rate: float) -> Float[Array, ...]:
        """Phase covariance G after the filter: that before it, weighted (τ − |d|h)+ at d samples away."""
        xp = namespace(self, process, lag, rate)
        samples = self._samples(rate)
        count = LONGEST if xp is jnp else math.ceil(samples)
        d = np.arange(1 - count, count)
        weight = xp.maximum(samples - abs(d), 0.0)
        # In one call: G is up to a multiple of lag² that is common to a call.
        moved = process.phase_covariance(abs(xp.asarray(lag)[..., None] + d / rate))
        return moved @ weight / xp.sum(weight)

    @property
    def ahead(self) -> int:
        return _REACH

    def filtered(self, x: Float[Array, " n"], rate: float) -> Float[Array, " n"]:
        """Samples after the filter, which delays nothing; it leaves the line from first to last as it is."""
        n = len(x)
        line = x[0] + (x[-1] - x[0]) * jnp.arange(n) / (n - 1)
        amplitude = jnp.sqrt(self.power(jnp.fft.rfftfreq(n, 1.0 / rate), rate))
        return jnp.fft.irfft(amplitude * jnp.fft.rfft(x - line), n) + line

    def transfer(self, rate: float) -> tuple[Float[np.ndarray, " q"], Float[np.ndarray, " p"]]:
        """Coefficients of a mean over whole samples, else of the filter of least delay of this response."""
        samples = float(self._samples(rate))
        count = math.ceil(samples - 1e-9)
        if abs(samples - count) <= 1e-9:
            return np.full(count, 1.0 / count), np.ones(1)
        weight = np.maximum(samples - np.arange(count + 1), 0.0)
        b = _spectral_factor(weight)
        return b / b.sum(), np.ones(1)

    def _samples(self, rate: float) -> Any:
        """The duration in sample intervals, between 1 and 64."""
        xp = namespace(self, rate)
        return xp.clip(HALF_POWER * rate / xp.asarray(self.bandwidth, float), 1.0, float(LONGEST))


def _spectral_factor(weight: Float[np.ndarray, " q"]) -> Float[np.ndarray, " q"]:
    """Filter b of this autocorrelation Σ_i b_i b_{i+d}, by Newton's method (Wilson 1969, SIAM J. NA 6:1)."""
    from scipy.linalg import hankel, toeplitz

    # From any filter without zeros inside the unit circle; it stays so.
    b = np.zeros_like(weight)
    b[0] = np.sqrt(weight[0] + 2.0 * weight[1:].sum())
    for _ in range(60):
        first = np.pad(b[:1], (0, len(b) - 1))
        both = hankel(b) + toeplitz(first, b)
        step = np.linalg.solve(both, weight - np.correlate(b, b, "full")[len(b) - 1 :])
        b = b + step
        if np.abs(step).max() <= 1e-14 * np.abs(b).max():
            break
    return b

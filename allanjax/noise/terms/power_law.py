"""Power-law noise of any exponent between differentiated flicker and a drifting random walk."""

from __future__ import annotations

import numpy as np
from jaxtyping import Array, ArrayLike, Float

from allanjax.base.arrays import namespace, special_functions
from allanjax.noise.model import NoiseTerm
from allanjax.noise.parameter import Value, parameter
from allanjax.noise.state_space import Block
from allanjax.noise.terms.gauss_markov_sum import gauss_markov_sum

# Distance of the exponent from 1 within which G is computed in the gauge of flicker noise.
_NEAR = 0.1
# Terms of Hurwitz's series that are summed one by one; the error is then below 1e-9 of the sum.
_SINGLE = 10


class PowerLaw(NoiseTerm):
    """Noise of PSD S(f) = A²·(f/1 Hz)^(−α), −1 < α < 3 (Mandelbrot & Van Ness 1968, SIAM Rev. 10:422).

    `amplitude` A in rad/√s or m/s/√s, the root PSD at 1 Hz; `exponent` α. α = 0 is an angle random walk
    N = A, α = 1 bias instability B = √(2π)·A, α = 2 rate random walk K = 2π·A. The Allan variance goes as
    T^(α−1); for exponents outside of these bounds it does not exist.
    """

    amplitude: Value = parameter("A", time_exponent=0.5)
    exponent: Value = parameter("α", "number", lower=-1.0, upper=3.0)

    def phase_covariance(self, lag: Float[Array, ...]) -> Float[Array, ...]:
        """Phase covariance −A²(2π)^α·t^(α+1)/[2Γ(α+2) cos(πα/2)], less a multiple of t² infinite at α = 1."""
        # cos(πα/2) = −sin(πε/2), ε = α − 1, and ε/sin(πε/2) = 2Γ(1 + ε/2)Γ(1 − ε/2)/π, smooth at zero.
        xp = namespace(self, lag)
        gammaln = special_functions(xp).gammaln
        e = xp.asarray(self.exponent, float) - 1.0
        reflected = gammaln(1.0 + e / 2.0) + gammaln(1.0 - e / 2.0)
        scale = 2.0 * xp.exp(e * np.log(2.0 * np.pi) + reflected - gammaln(3.0 + e))
        log = xp.log(xp.where(lag > 0.0, lag, 1.0))
        near = xp.abs(e) < _NEAR
        # t^ε/ε, or (t^ε − 1)/ε. Far from α = 1 the t² of the second would dominate the digits of t^(α+1).
        power = xp.where(near, log * _relative_expm1(xp.where(near, e, 0.0) * log), 0.0)
        power += xp.where(near, 0.0, xp.exp(e * log) / xp.where(near, 1.0, e))
        return self.amplitude**2 * scale * power * lag**2 * (lag > 0.0)

    @np.errstate(divide="ignore")
    def psd(self, frequency: Float[ArrayLike, ...]) -> Float[Array, ...]:
        xp = namespace(self, frequency)
        return self.amplitude**2 * xp.abs(xp.asarray(frequency, float)) ** -self.exponent

    @np.errstate(divide="ignore", invalid="ignore")
    def sampled_psd(self, frequency: Float[ArrayLike, ...], rate: float) -> Float[Array, ...]:
        """PSD with aliases: A²·rate^−α·sin²(πu)/π²·[ζ(α+2, u) + ζ(α+2, 1−u)], u = f/rate."""
        xp = namespace(self, frequency, rate)
        u = xp.asarray(frequency, float) / rate
        aliases = _hurwitz(2.0 + self.exponent, u) + _hurwitz(2.0 + self.exponent, 1.0 - u)
        return self.amplitude**2 * rate**-self.exponent * (xp.sin(np.pi * u) / np.pi) ** 2 * aliases

    def state_block(self, rate: float, duration: float | None) -> Block:
        """States of Gauss–Markov processes whose sum is the noise up to a duration [s], if there are such."""
        return gauss_markov_sum(self, rate, duration)


def _relative_expm1(x: Float[Array, ...]) -> Float[Array, ...]:
    """Quotient (e^x − 1)/x, smooth at zero."""
    xp = namespace(x)
    small = xp.abs(x) < 1e-2
    series = 1.0 + x / 2.0 * (1.0 + x / 3.0 * (1.0 + x / 4.0 * (1.0 + x / 5.0 * (1.0 + x / 6.0))))
    far = xp.where(small, 1.0, x)
    return xp.where(small, series, xp.expm1(far) / far)


def _hurwitz(s: Value, q: Float[Array, ...]) -> Float[Array, ...]:
    """Hurwitz's zeta Σ_k (q + k)^(−s), s > 1, by Euler–Maclaurin: JAX's has no derivative by s."""
    k = np.arange(_SINGLE)
    x = q + _SINGLE
    tail = x / (s - 1.0) + 0.5 + s / (12.0 * x) * (1.0 - (s + 1.0) * (s + 2.0) / (60.0 * x**2))
    return namespace(s, q).sum((q[..., None] + k) ** -s, axis=-1) + tail * x**-s

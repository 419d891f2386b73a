"""Expected squares of cosine coefficients, in closed form and exact, of noise with exponential covariances.

The orthonormal cosine transform of n values with autocovariance r_0, r_d = r_1·Q^{d−1} (d ≥ 1) has

    E c_j² = r_0 + r_1·{2(y − 2s)/D − [1 − (−1)^j Qⁿ]/n · 4y²(1 − s)/D²},

    y = 1 − Q,  s = sin²(a_j/2),  D = y² + 4(1 − y)s,  a_j = πj/n:

the geometric sums of `spectrum.cosine`'s exact expression. The second part in the braces is what the record's
two ends add. Q may be complex, the real part then counts; so Markov processes, oscillators and poles of a
filter are of one form, and no lag is ever summed.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Num

from allanjax.estimate.spectral.levels import Levels
from allanjax.noise.butterworth import LARGEST_BANDWIDTH
from allanjax.noise.exponential import averaged_lags, mean_lags


def geometric(
    levels: Levels,
    first: Float[Array, "*m"],
    second: Float[Array, "*m"],
    y: Float[Array, "*m"],
    last: Float[Array, "*m"],
) -> Float[Array, "nodes m"]:
    """Expected squares for the autocovariance r_0 = first, r_d = second·(1 − y)^{d−1}; `last` is (1 − y)ⁿ."""
    s = jnp.sin(levels.angle * levels.interval / 2.0) ** 2
    D = y**2 + 4.0 * (1.0 - y) * s
    ends = (1.0 - levels.parity * last) / levels.length * 4.0 * y**2 * (1.0 - s) / D
    return first + second * (2.0 * (y - 2.0 * s) - ends) / D


def complex_geometric(
    levels: Levels,
    weight: Num[Array, ""],
    first: Num[Array, "*m"],
    second: Num[Array, "*m"],
    y: Num[Array, "*m"],
    last: Num[Array, "*m"],
) -> Float[Array, "nodes m"]:
    """Real part of the weight times what `geometric` is for complex numbers, not near Q = 0.

    With D = 4(1 − y)·(s + z) what depends on the level is in real arithmetic, which is faster.
    """
    s = jnp.sin(levels.angle * levels.interval / 2.0) ** 2
    q = 4.0 * (1.0 - y)
    z = y**2 / q
    u, v = s + jnp.real(z), jnp.imag(z)
    square = u**2 + v**2
    high = -4.0 * weight * second / q
    low = -high * (z + y / 2.0)
    inner = jnp.real(weight * first + high) + (jnp.real(low) * u + jnp.imag(low) * v) / square
    end = weight * second * y**2 / (q**2 * levels.length)
    beyond = end * last
    even = jnp.real(end) - levels.parity * jnp.real(beyond)
    odd = jnp.imag(end) - levels.parity * jnp.imag(beyond)
    return inner - 4.0 * (1.0 - s) * (even * (u**2 - v**2) + 2.0 * odd * u * v) / square**2


def markov(levels: Levels, log_time: Float[Array, ""]) -> Float[Array, "nodes m"]:
    """Expected squares for a Gauss–Markov process of variance 1, averaged over each value's interval.

    `log_time` is the logarithm of its correlation time in sample intervals.
    """
    x = levels.interval * jnp.exp(-log_time)
    return geometric(levels, *averaged_lags(x), -jnp.expm1(-x), jnp.exp(-levels.length * x))


def oscillator(levels: Levels, shape: Float[Array, " 2"], band_limited: Array) -> Float[Array, "nodes m"]:
    """Expected squares for a damped oscillator of variance 1, driven by white noise.

    Args:
        levels: the levels.
        shape: ln ω0 [radians per sample interval], and ln(Q − ½).
        band_limited: whether nothing above half the sample rate is folded back; otherwise the oscillator is
            read at the instants of the samples.
    """
    w0, Q = jnp.exp(shape[0]), 0.5 + jnp.exp(shape[1])
    decay = w0 / (2.0 * Q)
    wd = jnp.sqrt(w0**2 - decay**2)
    pole = jnp.asarray(-decay + 1j * wd)
    last = jnp.exp(levels.length * levels.interval * pole)
    lags = mean_lags(pole, jnp.asarray(levels.interval))
    read = complex_geometric(levels, jnp.asarray(1.0 - 1j * decay / wd), *lags, last)
    a = levels.angle
    density = 2.0 * w0**3 / Q / ((w0**2 - a**2) ** 2 + (w0 * a / Q) ** 2)
    return jnp.where(band_limited, density, read)


#: Kinds of response: none; one pole or two, read at the instants of the samples; the same band-limited; and
#: digital Butterworth filters of order 1 to 4.
NONE, ONE_POLE, TWO_POLES, ONE_POLE_BAND_LIMITED, TWO_POLES_BAND_LIMITED = range(5)
BUTTERWORTH_1, BUTTERWORTH_2, BUTTERWORTH_3, BUTTERWORTH_4 = range(5, 9)

#: Largest bandwidth of a Butterworth filter [radians per sample interval]: at π it would let all pass.
BUTTERWORTH_LIMIT = LARGEST_BANDWIDTH * np.pi


def response(levels: Levels, shape: Float[Array, " 2"], kind: Array) -> Float[Array, "nodes m"]:
    """Power response of a filter, 1 at frequency zero.

    Args:
        levels: the levels.
        shape: ln ω_c [radians per sample interval], and ln(Q − ½) of two poles.
        kind: the kind of response.
    """
    wc, Q = jnp.exp(shape[0]), 0.5 + jnp.exp(shape[1])
    a = levels.angle
    s = jnp.sin(a / 2.0) ** 2
    y = -jnp.expm1(-wc)
    one = y**2 / (y**2 + 4.0 * (1.0 - y) * s)
    decay = wc / (2.0 * Q)
    wd = jnp.sqrt(wc**2 - decay**2)
    pole = -decay + 1j * wd
    c, z = 1.0 - 1j * decay / wd, -jnp.expm1(pole)
    # Of an oscillator read at the instants, over that at frequency zero.
    apart = z**2 / (4.0 * (1.0 - z))
    left = c * (apart + 0.5 * z)
    beside, across = s + jnp.real(apart), jnp.imag(apart)
    two = (jnp.real(left) * beside + jnp.imag(left) * across) / (beside**2 + across**2)
    two = two / jnp.real(c * (1.0 + 2.0 * (1.0 - z) / z))
    u = (a / wc) ** 2
    limited = [1.0 / (1.0 + u), 1.0 / ((1.0 - u) ** 2 + u / Q**2)]
    found = [jnp.ones_like(a), one, two, *limited]
    which = [kind == k for k in range(len(found))]
    return jnp.select(which, found, _butterworth(a, wc, kind))


def _butterworth(angle: Float[Array, "nodes m"], wc: Array, kind: Array) -> Float[Array, "nodes m"]:
    """Power response 1/(1 + [tan(a/2)/tan(ω_c/2)]^{2m}) of the digital Butterworth filter of order m.

    Powers of sines and cosines, neither of which is infinite at half the sample rate.
    """
    half = jnp.minimum(wc, BUTTERWORTH_LIMIT) / 2.0
    passed = (jnp.cos(angle / 2.0) * jnp.sin(half)) ** 2
    stopped = (jnp.sin(angle / 2.0) * jnp.cos(half)) ** 2
    high, low = passed, stopped
    for order in (BUTTERWORTH_2, BUTTERWORTH_3, BUTTERWORTH_4):
        high = high * jnp.where(kind >= order, passed, 1.0)
        low = low * jnp.where(kind >= order, stopped, 1.0)
    return high / (high + low)

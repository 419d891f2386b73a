"""Components of a spectrum: the levels that are fitted, and their expectations under noise terms and filters.

The expectations are in closed form and exact. The orthonormal cosine transform of n values with
autocovariance r_0, r_d = r_1·Q^{d−1} (d ≥ 1) has

    E c_j² = r_0 + r_1·{2(y − 2s)/D − [1 − (−1)^j Qⁿ]/n · 4y²(1 − s)/D²},

    y = 1 − Q,  s = sin²(a_j/2),  D = y² + 4(1 − y)s,  a_j = πj/n:

the geometric sums of `spectrum.cosine`'s exact expression. The second part in the braces is the contribution
of the record's two ends. Q may be complex; the real part is then taken. So Markov processes, oscillators and
the poles of a filter have one form, and no sum over lags is needed.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Num, Shaped

from allanjax.base.arrays import namespace
from allanjax.noise.numerics import averaged_lags, mean_lags
from allanjax.noise.response import HALF_POWER, LARGEST_BANDWIDTH, LONGEST
from allanjax.noise.terms import NoiseTerm
from allanjax.spectrum.cosine import Bins, Part, exact_expectation

#: Numbers of levels to which arrays are padded, so that few compiled programs serve every record.
CAPACITIES = (384, 1024)
# Parts of a spectrum are padded to a multiple of this.
_PARTS = 8
# Lags are padded to a multiple of this, so that compiled functions are reused.
_LAGS = 256


class Levels(NamedTuple):
    """Levels of the cosine spectrum and what their expectations depend on, in units of the sample interval.

    A level follows a χ² law around its expectation, with 2·shape degrees of freedom; shape 0 marks padding.

    Attributes:
        level: mean squares of coefficients [rate²].
        shape: half the degrees of freedom of each.
        angle: frequencies in radians per sample interval at two nodes of each level, whose mean and variance
            are those of its coefficients (2, m).
        square: sin² of half the angle between the values that were transformed, at the nodes (2, m).
        part: which part of the spectrum each level is of; a record has one.
        interval: number of samples that were averaged to each value before the transform of a part.
        length: number of values in the transform of a part.
        parity: (−1)^j for a level of a single coefficient j, else 0.
        columns: expectations [rate²] of the terms without a free shape at the nodes, for unit power
            (columns, 2, m).
    """

    level: Any
    shape: Any
    angle: Any
    square: Any
    part: Any
    interval: Any
    length: Any
    parity: Any
    columns: Any

    def with_data(self, level: Float[np.ndarray, " m"], dof: Float[np.ndarray, " m"]) -> Levels:
        """Copy with these mean squares [rate²] and degrees of freedom, without padding."""
        capacity = len(self.shape)
        return self._replace(level=padded(level, capacity, 1.0), shape=padded(dof / 2.0, capacity, 0.0))


def room_for(count: int, rooms: tuple[int, ...]) -> int:
    """The smallest of these sizes that holds `count`, or the least sufficient multiple of the last."""
    return next((room for room in rooms if room >= count), -(-count // rooms[-1]) * rooms[-1])


def padded(x: Shaped[np.ndarray, "... m"], capacity: int, fill: float) -> Shaped[np.ndarray, "... capacity"]:
    """Values of m levels, terms or shapes, padded with `fill`."""
    return np.pad(x, [(0, 0)] * (x.ndim - 1) + [(0, capacity - x.shape[-1])], constant_values=fill)


def levels_of(
    bins: Bins, columns: Float[np.ndarray, "terms 2 m"], slots: int, capacity: int | None = None
) -> Levels:
    """Levels of bins, without data yet.

    Args:
        bins: the bins.
        columns: expectations of terms without a free shape at the nodes, for unit power.
        slots: number of columns after padding.
        capacity: number of levels after padding; by default the least that suffices.
    """
    angle, square, which, parity = ([] for _ in range(4))
    for k, part in enumerate(bins.parts):
        first, size = part.edges[:-1], np.diff(part.edges)
        angle.append(2.0 * np.pi * part.node_frequencies / bins.rate)
        square.append(np.sin(np.pi * part.node_frequencies / part.rate) ** 2)
        which.append(np.full(len(size), k))
        parity.append(np.where(size == 1, 1.0 - 2.0 * (first % 2), 0.0))
    m, parts = len(bins.size), -(-len(bins.parts) // _PARTS) * _PARTS
    capacity = room_for(m, CAPACITIES) if capacity is None else capacity
    room = [(0, slots - len(columns)), (0, 0), (0, 0)]
    return Levels(
        level=padded(np.ones(m), capacity, 1.0),
        shape=np.zeros(capacity),
        angle=padded(np.concatenate(angle, axis=1), capacity, np.pi / 2.0),
        square=padded(np.concatenate(square, axis=1), capacity, 0.5),
        part=padded(np.concatenate(which), capacity, 0),
        interval=padded(np.array([np.rint(bins.rate / part.rate) for part in bins.parts]), parts, 1.0),
        length=padded(np.array([float(part.n) for part in bins.parts]), parts, 1.0),
        parity=padded(np.concatenate(parity), capacity, 0.0),
        columns=padded(np.pad(columns, room), capacity, 0.0),
    )


class Place(NamedTuple):
    """Where the expectations for a part of a spectrum are evaluated.

    Attributes:
        frequency: nodes of the bins [Hz] (2, m).
        rate: rate of the values that were transformed [Hz].
        length: number of values in a transform.
        lags, weights: lags [s] and weights of G there, whose sums are the exact expectations of the lowest
            coefficients; empty if these are not part of the spectrum.
    """

    frequency: Any
    rate: Any
    length: Any
    lags: Any
    weights: Any

    @classmethod
    def of(cls, part: Part) -> Place:
        """Place of a part of a spectrum."""
        lags, weights = np.zeros(0), np.zeros((0, 0))
        if part.low:
            lags, weights = exact_expectation(part.n, part.rate, part.low)
            pad = -len(lags) % _LAGS
            lags, weights = np.pad(lags, (0, pad)), np.pad(weights, ((0, 0), (0, pad)))
        return cls(part.node_frequencies, np.asarray(part.rate), np.asarray(float(part.n)), lags, weights)

    def expected(self, term: NoiseTerm) -> Float[Array, "2 m"]:
        """Expected squares [rate²] of the coefficients at the nodes, exact for the lowest ones."""
        xp = namespace(self, term)
        above = self._from_density(term)
        # An oscillating covariance needs too many lags; its difference from a smooth one has a short memory.
        smooth = term.at_low_frequencies() if term.oscillates else term
        if smooth is None or not len(self.lags):
            return above
        low = self.weights @ xp.asarray(smooth.phase_covariance(xp.asarray(self.lags)))
        count = len(low)
        if smooth is not term:
            low = low + (above - self._from_density(smooth))[:, :count]
        return xp.concatenate([xp.broadcast_to(low, (2, count)), above[:, count:]], axis=1)

    def _from_density(self, term: NoiseTerm) -> Float[Array, "2 m"]:
        """Expected squares [rate²] from the density of the samples, neglecting the record's finite length."""
        ends = term.end_effect(self.frequency, self.rate) / self.length
        return term.sampled_psd(self.frequency, self.rate) * self.rate + ends


def columns_of(terms: Sequence[NoiseTerm], bins: Bins) -> Float[np.ndarray, "terms 2 m"]:
    """Expected squares [rate²] of random terms of unit amplitude at two nodes of each bin.

    The terms' other parameters must have values.
    """
    places = [Place.of(part) for part in bins.parts]
    found = np.zeros((len(terms), 2, len(bins.size)))
    for column, term in zip(found, terms, strict=True):
        unit = term.with_unit_amplitude().sampled(bins.rate)
        column[:] = np.concatenate([np.asarray(place.expected(unit)) for place in places], axis=1)
    return found


def oscillation(
    levels: Levels, first: Float[Array, ""], second: Float[Array, ""], is_markov: Bool[Array, ""]
) -> tuple[Array, Array, Array]:
    """Expected squares of a slot of variance 1 at the nodes, and their derivatives by its two shapes."""
    Q = 0.5 + jnp.exp(second)
    root = jnp.sqrt(jnp.where(is_markov, 1.0, 4.0 * Q**2 - 1.0))
    rate = jnp.exp(jnp.where(is_markov, -first, first))
    decay = jnp.where(is_markov, rate, rate / (2.0 * Q))
    turn = jnp.where(is_markov, 0.0, decay * root)
    pole = jax.lax.complex(-decay, turn)
    weight = jax.lax.complex(jnp.ones(()), jnp.where(is_markov, 0.0, -1.0 / root))
    by_second = jax.lax.complex(decay, decay / root) / Q
    weight_by_second = jax.lax.complex(jnp.zeros(()), 4.0 * Q / root**3)
    value, slope = _geometric(levels, pole, is_markov)
    by_first = _real_product(weight * jnp.where(is_markov, -pole, pole), slope)
    other = _real_product(weight_by_second, value) + _real_product(weight * by_second, slope)
    other = jnp.where(is_markov, 0.0, other * (Q - 0.5))
    return _real_product(weight, value), by_first, other


# A complex array as its real and imaginary parts, of which compiled programs make faster loops.
_Pair = tuple[Array, Array]


def _product(a: _Pair, b: _Pair) -> _Pair:
    return a[0] * b[0] - a[1] * b[1], a[0] * b[1] + a[1] * b[0]


def _real_product(scalar: Array, b: _Pair) -> Array:
    return jnp.real(scalar) * b[0] - jnp.imag(scalar) * b[1]


def _geometric(levels: Levels, pole: Array, is_markov: Array) -> tuple[_Pair, _Pair]:
    """Expected squares of e^{pole·d}, complex, and their derivative by the pole, of the form above."""
    M, n = jnp.asarray(levels.interval), jnp.asarray(levels.length)

    def lags(pole: Array) -> tuple[Array, Array]:
        x = -jnp.real(pole) * M
        (a0, a1), (r0, r1, _) = averaged_lags(x), mean_lags(pole, M)
        return jnp.where(is_markov, a0, r0), jnp.where(is_markov, a1, r1)

    (r0, r1), (d0, d1) = jax.jvp(lags, (pole,), (jnp.ones_like(pole),))
    y, last = -jnp.expm1(pole * M), jnp.exp(pole * M * n)
    by_y = -M * (1.0 - y)
    # What the ends add to a part, and its derivative, each with a share that only single coefficients have.
    of_ends = (y**2, -last * y**2, 2.0 * y * by_y, -(M * n * last * y**2 + 2.0 * last * y * by_y))
    of_parts = jnp.stack([r0, r1, d0, d1, y, by_y, y**2, 4.0 * (1.0 - y), *(4.0 / n * x for x in of_ends)])
    at = jnp.take(jnp.stack([jnp.real(of_parts), jnp.imag(of_parts)]), levels.part, axis=2)
    r0_, r1_, d0_, d1_, y_, by_y_, square, four, *ends = ((at[0, k], at[1, k]) for k in range(12))
    s = jnp.asarray(levels.square)
    D = square[0] + four[0] * s, square[1] + four[1] * s
    size = D[0] ** 2 + D[1] ** 2
    inverse = D[0] / size, -D[1] / size
    b, by_b = (
        tuple((1.0 - s) * (x + levels.parity * single) for x, single in zip(one, other, strict=True))
        for one, other in (ends[:2], ends[2:])
    )
    a = 2.0 * y_[0] - 4.0 * s, 2.0 * y_[1] + 0.0 * s
    of_b = _product(b, inverse)
    G = _product((a[0] - of_b[0], a[1] - of_b[1]), inverse)
    inner = _product(_product(a, (a[0] - 2.0 * of_b[0], a[1] - 2.0 * of_b[1])), inverse)
    inner, of_by_b = _product(by_y_, inner), _product(by_b, inverse)
    numerator = [2.0 * by_y_[k] - of_by_b[k] - inner[k] for k in (0, 1)]
    slope = _product((numerator[0], numerator[1]), inverse)
    value, of_d, of_slope = _product(r1_, G), _product(d1_, G), _product(r1_, slope)
    by_pole = [d0_[k] + of_d[k] + of_slope[k] for k in (0, 1)]
    return (r0_[0] + value[0], r0_[1] + value[1]), (by_pole[0], by_pole[1])


#: Kinds of response: none; one pole or two, read at the instants of the samples; a moving average; digital
#: filters of two poles; and Butterworth's of order 1 to 4.
NONE, ONE_POLE, TWO_POLES, MOVING_AVERAGE, BIQUAD = range(5)
BUTTERWORTH_1, BUTTERWORTH_2, BUTTERWORTH_3, BUTTERWORTH_4 = range(5, 9)
# Largest bandwidth of a digital filter [radians per sample interval], and the bandwidth of a moving
# average times its duration.
_DIGITAL_LIMIT = LARGEST_BANDWIDTH * np.pi
_MEAN = 2.0 * np.pi * HALF_POWER


def bandwidths(kind: int) -> tuple[float, float]:
    """Least and largest bandwidth of a kind of response [radians per sample interval]."""
    if kind == MOVING_AVERAGE:
        return _MEAN / LONGEST, _MEAN
    return math.exp(-20.0), _DIGITAL_LIMIT if kind >= BIQUAD else math.exp(5.0)


def response(
    levels: Levels, shape: Float[Array, " 2"], kind: Array, centre: Float[Array, " 2"]
) -> Float[Array, "nodes m"]:
    """Power response of a filter, 1 at frequency zero.

    Args:
        levels: the levels.
        shape: ln ω_c [radians per sample interval], and ln(Q − ½) of two poles.
        kind: the kind of response.
        centre: the shape itself, or for a difference the one beside it.
    """
    wc, Q = jnp.exp(shape[0]), 0.5 + jnp.exp(shape[1])
    a = jnp.asarray(levels.angle)
    branches = (
        lambda: jnp.ones_like(a),
        lambda: _one_pole(a, wc),
        lambda: _two_poles(a, wc, Q),
        lambda: _mean(a, wc, jnp.exp(centre[0])),
        lambda: _biquad(a, wc, Q),
        lambda: _butterworth(a, wc, kind),
    )
    return jax.lax.switch(jnp.minimum(kind, len(branches) - 1), branches)


def _one_pole(angle: Float[Array, "nodes m"], wc: Array) -> Float[Array, "nodes m"]:
    y = -jnp.expm1(-wc)
    return y**2 / (y**2 + 4.0 * (1.0 - y) * jnp.sin(angle / 2.0) ** 2)


def _two_poles(angle: Float[Array, "nodes m"], wc: Array, Q: Array) -> Float[Array, "nodes m"]:
    """Response of an oscillator that is read at instants, relative to that at frequency zero."""
    decay, s = wc / (2.0 * Q), jnp.sin(angle / 2.0) ** 2
    wd = jnp.sqrt(wc**2 - decay**2)
    c, z = 1.0 - 1j * decay / wd, -jnp.expm1(-decay + 1j * wd)
    apart = z**2 / (4.0 * (1.0 - z))
    left = c * (apart + 0.5 * z)
    beside, across = s + jnp.real(apart), jnp.imag(apart)
    two = (jnp.real(left) * beside + jnp.imag(left) * across) / (beside**2 + across**2)
    return two / jnp.real(c * (1.0 + 2.0 * (1.0 - z) / z))


def response_and_slope(levels: Levels, shape: Float[Array, " 2"], kind: Array) -> tuple[Array, Array]:
    """Response of white noise in a record, whose two ends add to it, and its derivatives [2, nodes, m].

    Central differences make half as large a program as derivatives in closed form; their error is 10⁻⁸.
    """

    def passed(at: Array) -> Array:
        return response(levels, at, kind, shape) + response_ends(levels, at, kind, shape)

    def filtered() -> tuple[Array, Array]:
        def at(k: Array, every: Array) -> Array:
            return every.at[k].set(passed(shape + _STEP * jnp.asarray(_AROUND)[k]))

        # Other filters than these have no quality factor.
        count = jnp.where((kind == TWO_POLES) | (kind == BIQUAD), 5, 3)
        R, *around = jax.lax.fori_loop(0, count, at, jnp.zeros((5, *nodes)))
        return R, jnp.stack([around[0] - around[1], around[2] - around[3]]) / (2.0 * _STEP)

    nodes = levels.angle.shape
    return jax.lax.cond(kind == NONE, lambda: (jnp.ones(nodes), jnp.zeros((2, *nodes))), filtered)


# Step of a difference, and where a response is evaluated for it.
_STEP, _AROUND = 1e-4, np.array([[0.0, 0.0], [1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])


def _samples(wc: Array, centre: Array) -> tuple[Float[Array, "2 1 1"], Float[Array, "2 1 1"]]:
    """Whole samples of a moving average's duration and one more, and the share of each in the power.

    The number of whole samples is that of a bandwidth beside it: for a derivative there is no kink.
    """
    duration, m = jnp.clip(_MEAN / jnp.stack([wc, centre]), 1.0, LONGEST)
    m = jnp.floor(m)
    rest = duration - m
    both, share = jnp.stack([m, m + 1.0]), jnp.stack([1.0 - rest, rest])
    return both[:, None, None], (share / (share @ both**2))[:, None, None]


def _mean(angle: Float[Array, "nodes m"], wc: Array, centre: Array) -> Float[Array, "nodes m"]:
    """Power response of a moving average, see `noise.response`."""
    m, share = _samples(wc, centre)
    return jnp.sum(share * jnp.sin(m * angle / 2.0) ** 2, axis=0) / jnp.sin(angle / 2.0) ** 2


def _ends_of_mean(levels: Levels, wc: Array, centre: Array) -> Float[Array, "nodes m"]:
    """`response_ends` of a moving average: −2/n · Σ_d r_d·[d·cos(ad) + sin(ad)/sin(a)].

    The sum over the r_d = m − d of a mean of m samples is S' + S/sin(a), S = (m·sin(a) − sin(ma))/4s. The
    transform of a stream's means does not notice the ends of a filter that is shorter than those.
    """
    m, share = _samples(wc, centre)
    small = levels.angle * LONGEST < _NEARLY_CONSTANT
    a = jnp.where(small, 1.0, levels.angle)
    s = jnp.sin(a / 2.0) ** 2
    apart = m * jnp.sin(a) - jnp.sin(m * a)
    slope = m * (jnp.cos(a) - jnp.cos(m * a)) / (4.0 * s) - apart * jnp.sin(a) / (8.0 * s**2)
    total = jnp.where(small, m * (m**2 - 1.0) / 3.0, slope + apart / (4.0 * s * jnp.sin(a)))
    both = jnp.sum(share * total, axis=0)
    M, n = jnp.take(levels.interval, levels.part), jnp.take(levels.length, levels.part)
    return jnp.where(M == 1.0, -2.0 * both / n, 0.0)


# Duration, in radians of a level's frequency, below which the ends of a moving average contribute a constant.
_NEARLY_CONSTANT = 0.01


def _shares(angle: Float[Array, "nodes m"], wc: Array) -> tuple[Array, Array]:
    """Shares of tan²(ω_c/2) and tan²(a/2) in their sum, up to a common factor."""
    half = jnp.minimum(wc, _DIGITAL_LIMIT) / 2.0
    return (jnp.cos(angle / 2.0) * jnp.sin(half)) ** 2, (jnp.sin(angle / 2.0) * jnp.cos(half)) ** 2


def _biquad(angle: Float[Array, "nodes m"], wc: Array, Q: Array) -> Float[Array, "nodes m"]:
    """Power response of a digital filter of two poles, see `noise.response`."""
    passed, stopped = _shares(angle, wc)
    return passed**2 / ((passed - stopped) ** 2 + passed * stopped / Q**2)


def _butterworth(angle: Float[Array, "nodes m"], wc: Array, kind: Array) -> Float[Array, "nodes m"]:
    """Power response 1/(1 + [tan(a/2)/tan(ω_c/2)]^{2m}) of the digital Butterworth filter of order m.

    Powers of sines and cosines, neither of which is infinite at half the sample rate.
    """
    passed, stopped = _shares(angle, wc)
    high, low = passed, stopped
    for order in (BUTTERWORTH_2, BUTTERWORTH_3, BUTTERWORTH_4):
        high = high * jnp.where(kind >= order, passed, 1.0)
        low = low * jnp.where(kind >= order, stopped, 1.0)
    return high / (high + low)


def response_ends(
    levels: Levels, shape: Float[Array, " 2"], kind: Array, centre: Float[Array, " 2"]
) -> Float[Array, "nodes m"]:
    """Contribution of a record's two ends to the expected squares of filtered white noise of unit power.

    The filter has settled when the record begins. Its output has r_d = Σ e·w^{d−1} over its poles w, d ≥ 1,
    so that it is the second part of the braces of this module's formula, of means of samples, too. It is
    about 1/n of the noise in the pass band, and most of what is left deep in the stop band. The response is
    that of `response`, of which it is no part.

    Args:
        levels: the levels.
        shape: ln ω_c [radians per sample interval], and ln(Q − ½) of two poles.
        kind: the kind of response.
        centre: the shape itself, or for a difference the one beside it.
    """
    return jax.lax.cond(
        kind == MOVING_AVERAGE,
        lambda: _ends_of_mean(levels, *jnp.exp(jnp.stack([shape[0], centre[0]]))),
        lambda: _ends_of_poles(levels, shape, kind),
    )


def _ends_of_poles(levels: Levels, shape: Float[Array, " 2"], kind: Array) -> Float[Array, "nodes m"]:
    """`response_ends` of a filter of poles."""
    # Poles along the first axis.
    w, e = (x[:, None] for x in _poles_of_response(shape, kind))
    M, n = jnp.asarray(levels.interval), jnp.asarray(levels.length)
    last_of_mean = _power(w, M)
    y = 1.0 - last_of_mean
    # Means of M samples: the first lag, over that of samples, is the square of (1 − w^M)/(M(1 − w)).
    e = e * (y / (M * (1.0 - w))) ** 2 * y**2 / n
    of_parts = jnp.stack([y**2, 4.0 * last_of_mean, e, -e * _power(w, M * n)])
    at = jnp.take(jnp.stack([jnp.real(of_parts), jnp.imag(of_parts)]), levels.part, axis=3)[..., None, :]
    square, four, of_all, of_single = ((at[0, k], at[1, k]) for k in range(4))
    s = jnp.asarray(levels.square)
    D = square[0] + four[0] * s, square[1] + four[1] * s
    size = D[0] ** 2 + D[1] ** 2
    inverse = D[0] / size, -D[1] / size
    both = tuple(x + levels.parity * single for x, single in zip(of_all, of_single, strict=True))
    ends = _product(both, _product(inverse, inverse))[0]
    return -4.0 * (1.0 - s) * jnp.sum(ends, axis=0)


# Angles φ of the poles q = tan(ω_c/2)·e^{iφ} of Butterworth filters of order 1 to 4, one per conjugate pair,
# and how many poles each stands for: see `noise.response`.
_ANGLES = np.pi * np.array([[0.0, 0.0], [1.0 / 4.0, 0.0], [0.0, 1.0 / 3.0], [1.0 / 8.0, 3.0 / 8.0]])
_COUNTS = np.array([[1.0, 0.0], [2.0, 0.0], [1.0, 2.0], [2.0, 2.0]])
_ORDERS = np.arange(1.0, 5.0)[:, None]


def _poles_of_response(shape: Float[Array, " 2"], kind: Array) -> tuple[Num[Array, " 2"], Num[Array, " 2"]]:
    """Poles w of a filter, and the e of the autocovariance Re Σ e·w^{d−1}, d ≥ 1, of white noise after it."""
    wc, Q = jnp.exp(shape[0]), 0.5 + jnp.exp(shape[1])
    decay = wc / (2.0 * Q)
    wd = jnp.sqrt(wc**2 - decay**2)
    one, two = jnp.exp(-wc), jnp.exp(-decay + 1j * wd)
    c = 1.0 - 1j * decay / wd
    c = c / jnp.real(c * (1.0 + two) / (1.0 - two))
    t = jnp.tan(jnp.minimum(wc, _DIGITAL_LIMIT) / 2.0)
    q = t * np.exp(1j * _ANGLES)
    real = 0.5 / Q
    of_two = t * (real + 1j * jnp.sqrt(1.0 - real**2))
    share = 2.0 / (1.0 - (of_two / jnp.conj(of_two)) ** 2)
    # Per kind of response; a pole of weight 0 is unused.
    idle = jnp.full((BUTTERWORTH_1, 2), 0.5 + 0j)
    poles = idle.at[ONE_POLE, 0].set(one).at[TWO_POLES, 0].set(two)
    poles = poles.at[BIQUAD, 0].set((1.0 - of_two) / (1.0 + of_two))
    weights = (0.0 * idle).at[ONE_POLE, 0].set(one * (1.0 - one) / (1.0 + one)).at[TWO_POLES, 0].set(two * c)
    weights = weights.at[BIQUAD, 0].set(share * of_two / (1.0 + of_two) ** 2)
    poles = jnp.concatenate([poles, (1.0 - q) / (1.0 + q)])
    weights = jnp.concatenate([weights, _COUNTS / _ORDERS * q / (1.0 + q) ** 2])
    return poles[kind], weights[kind]


def _power(w: Num[Array, ""], exponent: Float[Array, "*m"]) -> Num[Array, "*m"]:
    """Power of a complex number inside the unit circle, of 0, too."""
    log_size = 0.5 * jnp.log(jnp.maximum(jnp.real(w) ** 2 + jnp.imag(w) ** 2, 1e-300))
    turn = exponent * jnp.arctan2(jnp.imag(w), jnp.real(w))
    return jnp.exp(exponent * log_size) * (jnp.cos(turn) + 1j * jnp.sin(turn))

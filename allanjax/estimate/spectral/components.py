"""Components of a spectrum: the levels that are fitted, and their expectations under noise terms and filters.

The expectations are in closed form and exact. The orthonormal cosine transform of n values with
autocovariance r_0, r_d = r_1·Q^{d−1} (d ≥ 1) has

    E c_j² = r_0 + r_1·{2(y − 2s)/D − [1 − (−1)^j Qⁿ]/n · 4y²(1 − s)/D²},

    y = 1 − Q,  s = sin²(a_j/2),  D = y² + 4(1 − y)s,  a_j = πj/n:

the geometric sums of `spectrum.cosine`'s exact expression. The second part in the braces is the contribution
of the record's two ends. Q may be complex; the real part is then taken. So Markov processes, oscillators and
the poles of a filter have one form, and no sum over lags is needed. All is in units of the sample interval.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from allanjax.base.arrays import namespace
from allanjax.noise import response as filters
from allanjax.noise.process import Poles, averaged_lags
from allanjax.noise.response import Response
from allanjax.noise.terms import NoiseTerm
from allanjax.noise.terms.random import LEAST_FREQUENCY, LEAST_WIDTH, NODES, SHARES
from allanjax.spectrum.cosine import Bins, Part, exact_expectation

#: Quality factor below which a resonance, and correlation time [samples] below which a Markov process, may be
#: white noise behind a filter.
WIDE, QUICK = 4.0, 20.0
#: Quality factor below which a resonance counts as white noise: its density at low frequencies is more than a
#: sixth of that at its peak. A judgement.
BROAD = 2.5
# Lags are padded to a multiple of this, so that compiled functions are reused.
_LAGS = 256
# Step of a difference, relative to the scale on which a function changes: its error is 10⁻¹⁰.
_STEP = 1e-5
# Number of samples of a record whose ends contribute nothing.
_ENDLESS = 1e30
# Relative distance from whole samples at which a moving average has as many.
_SAME = 1e-9
# Share of an oscillation that is left at the end of a record, for each sample, below which nothing is left.
_NOTHING = 1e-13


class Levels(NamedTuple):
    """Levels of the cosine spectrum and what their expectations depend on, in units of the sample interval.

    A level [rate²] follows a χ² law around its expectation, with 2·shape degrees of freedom; shape 0 for no
    data. The angles are at two nodes of each level (2, m), whose mean and variance are those of its
    coefficients, and the squares sin² of half the angle between the values that were transformed. Each value
    is the mean of `interval` samples, and a transform has `length` of them: one number for all levels of a
    record. The parity is (−1)^j for a level of a single coefficient j, else 0. Columns are the expectations
    of the terms without a free shape, for unit power (columns, 2, m).
    """

    level: Any
    shape: Any
    angle: Any
    square: Any
    interval: Any
    length: Any
    parity: Any
    columns: Any

    @classmethod
    def of(cls, bins: Bins, columns: Float[np.ndarray, "columns 2 m"]) -> Levels:
        """Levels of bins, without data yet; for the columns see the class."""
        frequency = np.concatenate([part.node_frequencies for part in bins.parts], axis=1)
        angle = 2.0 * np.pi * frequency / bins.rate
        # Of each part, and of each level if there are several parts.
        of_parts = np.array([(np.rint(bins.rate / part.rate), part.n) for part in bins.parts], float)
        sizes = [np.diff(part.edges) for part in bins.parts]
        if len(bins.parts) > 1:
            of_parts = np.repeat(of_parts, [len(size) for size in sizes], axis=0)
        interval, length = of_parts.T
        first = np.concatenate([part.edges[:-1] for part in bins.parts])
        parity = np.where(np.concatenate(sizes) == 1, 1.0 - 2.0 * (first % 2), 0.0)
        level, square = np.ones(len(first)), np.sin(angle * interval / 2.0) ** 2
        return cls(level, 0.0 * level, angle, square, interval, length, parity, columns)

    @property
    def endless(self) -> Levels:
        """Copy for a record so long that its ends add nothing."""
        return self._replace(length=_ENDLESS + 0.0 * self.length)


class Place(NamedTuple):
    """Where the expectations for a part of a spectrum are evaluated: frequencies of the nodes [Hz] (2, m).

    Of the lowest coefficients they are sums over lags [s] with weights of G, if these are part of it.
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
        # Where a term has next to nothing, rounding and the difference may leave less.
        return xp.maximum(xp.concatenate([xp.broadcast_to(low, (2, count)), above[:, count:]], axis=1), 0.0)

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


def markov(levels: Levels, shapes: Float[np.ndarray, "... k 1"], sloped: bool = False) -> tuple[Any, Any]:
    """Expected squares at the nodes of Markov processes of variance 1 [..., k, 2, m], by ln T_c.

    If it is wanted, also their derivatives by the shapes [..., k, shapes, 2, m].
    """
    x, s = levels.interval * np.exp(-shapes[..., None]), levels.square
    y, at_end = -np.expm1(-x), levels.parity * np.exp(-x * levels.length)
    inverse, own = 1.0 / (y**2 + 4.0 * (1.0 - y) * s), 2.0 * (y - 2.0 * s)
    ends = y**2 * (1.0 - at_end) * (4.0 / levels.length * (1.0 - s))
    (r_0, r_1), of_ends = averaged_lags(x), ends * inverse
    both = (own - of_ends) * inverse
    value = r_0 + r_1 * both
    if not sloped:
        return value, None
    # Derivatives by x of y, of the ends, and of D over D; then of the two lags.
    of_y = 1.0 - y
    of_them = ends * (2.0 * of_y / y) + 4.0 * (1.0 - s) * y**2 * at_end
    slope = (2.0 * of_y - of_them * inverse - of_y * own * inverse * (own - 2.0 * of_ends)) * inverse
    near = x < 1e-3
    by_0 = np.where(near, x / 6.0 - 1.0 / 3.0, -2.0 * (np.expm1(-x) / x + r_0) / x)
    by_1 = 2.0 * r_1 * np.where(near, x / 12.0 - 0.5, 1.0 / np.expm1(x) - 1.0 / x)
    return value, -x[..., None, :, :] * (by_0 + by_1 * both + r_1 * slope)[..., None, :, :]


def oscillator(levels: Levels, shapes: Float[np.ndarray, "... k 2"], sloped: bool = False) -> tuple[Any, Any]:
    """As `markov`, for oscillators of variance 1 by ln ω_0 and ln(Q − ½), in a record.

    Since s is linear in D, the expectation is the real part of a polynomial in z = 1/D without a constant,
    and so are its derivatives: that of z by the pole is (A·z − 1)·z, A = y(2 − y).
    """
    w, excess = np.exp(shapes[..., 0]), np.exp(shapes[..., 1])
    Q, root = 0.5 + excess, 2.0 * np.sqrt(excess * (1.0 + excess))
    pole, weight, powers = w / (2.0 * Q) * (-1.0 + 1j * root), 1.0 - 1j / root, 3 if sloped else 2
    q, y, at_end = np.exp(pole), -np.expm1(pole), np.exp(pole * levels.length)
    A, square, s = y * (2.0 - y), y * y, levels.square.ravel()

    def coefficients(parity: float) -> Float[np.ndarray, "... k rows 2*powers"]:
        """Of the real and imaginary parts of z, z² …, for the value and if wanted its derivatives."""
        more, left = parity * at_end, (1.0 - parity * at_end) / levels.length
        value = np.array([A + left * square, -left * A * A, 0.0 * y][:powers])
        rows = [weight * value]
        if sloped:
            cubic = 2.0 * A * value[1]
            by_pole = np.array([A * (1.0 - left) - 2.0 - more * square, 0.0 * y, cubic])
            by_pole[1] = A * (A * (1.0 + more) + left * (4.0 * q + 3.0 * square))
            turned = 2j * Q / root
            by_Q = 2.0 * excess / root**2 * (turned * value + w * by_pole)
            rows += [w * turned * by_pole, by_Q]
        parts = np.concatenate([np.real(rows), -np.imag(rows)], axis=1)
        return np.ascontiguousarray(np.moveaxis(parts, (0, 1), (-2, -1)))

    # In real arithmetic, which is faster.
    above, slope = square[..., None], (4.0 * q)[..., None]
    real, imaginary = above.real + slope.real * s, above.imag + slope.imag * s
    inverse = 1.0 / (real**2 + imaginary**2)
    z = np.empty((*w.shape, 2, powers, len(s)))
    re, im = z[..., 0, :, :], z[..., 1, :, :]
    re[..., 0, :], im[..., 0, :] = real * inverse, -imaginary * inverse
    for k in range(1, powers):
        re[..., k, :] = re[..., 0, :] * re[..., k - 1, :] - im[..., 0, :] * im[..., k - 1, :]
        im[..., k, :] = re[..., 0, :] * im[..., k - 1, :] + im[..., 0, :] * re[..., k - 1, :]
    z = z.reshape(*w.shape, 2 * powers, len(s))
    found = coefficients(0.0) @ z
    # The parity matters for oscillators that last as long as the record.
    if np.any(lasting := abs(at_end) > _NOTHING * levels.length):
        z, own = z[lasting], found[lasting]
        for sign in (-1.0, 1.0):
            at = np.flatnonzero(np.tile(levels.parity == sign, 2))
            own[..., at] = coefficients(sign)[lasting] @ z[..., at]
        found[lasting] = own
    found = found.reshape(*found.shape[:-1], *levels.square.shape)
    return found[..., 0, :, :], found[..., 1:, :, :] if sloped else None


def wandering(levels: Levels, shapes: Float[np.ndarray, "... k 3"], sloped: bool = False) -> tuple[Any, Any]:
    """As `oscillator`, for one of a spread frequency, also by ln Δω: sums over those that it consists of."""
    w, excess, spread = (x[..., None] for x in np.moveaxis(np.exp(shapes), -1, 0))
    nodes = w + NODES * spread
    stays = nodes > LEAST_FREQUENCY * w
    nodes = np.where(stays, nodes, LEAST_FREQUENCY * w)
    own, least = excess**-4.0, (LEAST_WIDTH * spread / w) ** 4
    of_each = np.broadcast_to(-0.25 * np.log(own + least), nodes.shape)
    value, slopes = oscillator(levels, np.stack([np.log(nodes), of_each], axis=-1), sloped)
    total = np.einsum("s,...sij->...ij", SHARES, value)
    if not sloped:
        return total, None
    # Derivatives of the nodes' frequencies and quality factors, in ln, by the three shapes.
    known = own / (own + least)
    by_frequency = np.where(stays, w / nodes, 1.0), 0.0 * nodes, np.where(stays, NODES * spread / nodes, 0.0)
    by_quality = 1.0 - known, known, known - 1.0
    each = [np.stack(np.broadcast_arrays(*by)) for by in zip(by_frequency, by_quality, strict=True)]
    weights = np.moveaxis(np.array(each), (0, 1), (-3, -2)) * SHARES
    return total, np.einsum("...pqs,...sqij->...pij", weights, slopes)


#: Kinds of components: without a free shape, so that their levels are columns; with closed forms of their
#: shapes; and others.
COLUMN, MARKOV, OSCILLATOR, WANDERING, OTHER = range(5)
#: The closed forms.
CLOSED = {MARKOV: markov, OSCILLATOR: oscillator, WANDERING: wandering}


class Kind(NamedTuple):
    """Kind of a response: its class, and its order, the number of poles or of means."""

    response: Any
    order: int

    @property
    def is_shaped(self) -> bool:
        """Whether it has a quality factor."""
        return self in (TWO_POLES, BIQUAD)

    @property
    def is_mean(self) -> bool:
        """Whether it is a moving average."""
        return self.response is filters.MovingAverage

    @property
    def narrowing(self) -> float:
        """Ratio of the half-power frequency to the bandwidth: below 1 of several means."""
        return filters.HALF_POWERS[self.order - 1] / filters.HALF_POWER if self.is_mean else 1.0

    @property
    def of_one_sample(self) -> float:
        """Corner of means over one sample [radians per sample]; those over m have an m-th of it."""
        return 2.0 * math.pi * filters.HALF_POWER * self.narrowing

    def of(self, bandwidth: float, quality: float) -> Response:
        """Response of this kind; filters without a quality factor ignore it."""
        if self.is_shaped:
            return self.response(bandwidth, quality)
        return self.response(bandwidth, **({"order": self.order} if self.response.option_names() else {}))


#: Kinds of response: none; one pole or two, read at the instants of the samples; digital filters of two
#: poles; moving averages and Butterworth's of each order.
NONE, ONE_POLE, TWO_POLES = Kind(None, 0), Kind(filters.LowPass1, 1), Kind(filters.LowPass2, 2)
BIQUAD = Kind(filters.Biquad, 2)
MEANS = tuple(Kind(filters.MovingAverage, m) for m in range(1, 5))
BUTTERWORTH = tuple(Kind(filters.Butterworth, m) for m in range(1, 9))


def kind_of(response: Response | None) -> Kind:
    """Kind of a response."""
    if response is None:
        return NONE
    return Kind(type(response), response.options.get("order", len(response.parameters())))


def bandwidths(kind: Kind) -> tuple[float, float]:
    """Least and largest bandwidth of a kind of response [radians per sample interval]."""
    if kind.is_mean:
        return 2.0 * np.pi * filters.HALF_POWER / filters.LONGEST, 2.0 * np.pi * filters.HALF_POWER
    is_digital = kind == BIQUAD or kind in BUTTERWORTH
    return math.exp(-20.0), filters.LARGEST_BANDWIDTH * np.pi if is_digital else math.exp(5.0)


def _poles(kind: Kind, wc: Any, Q: Any) -> Poles:
    """Poles of a filter of a bandwidth [radians per sample interval], see `noise.response`."""
    if kind == ONE_POLE:
        return filters.one_pole(wc)
    if kind == TWO_POLES:
        return filters.two_poles(wc, Q)
    tangent = np.tan(np.minimum(wc, filters.LARGEST_BANDWIDTH * np.pi) / 2.0)
    if kind == BIQUAD:
        return filters.bilinear_poles(filters.biquad_poles(tangent, Q))
    tangent = filters.apart_from_one(tangent, kind.order)
    return filters.bilinear_poles(filters.butterworth_poles(tangent, kind.order), 1.0 / kind.order)


def passed(levels: Levels, kind: Kind, wc: Any, Q: Any = None) -> Float[np.ndarray, "... 2 m"]:
    """Expected squares at the nodes of white noise of unit power after a filter, of a bandwidth [..., 1, 1].

    That is its power response, and what the ends of a record add if the filter has settled when it begins:
    about 1/n of the noise in the pass band, and most of what is left deep in the stop band. The filtered
    noise has r_d = Re Σ c·w^d over the filter's poles w, d ≥ 1.
    """
    if kind.is_mean:
        samples = np.clip(2.0 * np.pi * filters.HALF_POWER / wc, 1.0, filters.LONGEST)
        of_each = [np.asarray(filters.of_means(x, math.ceil(x), kind.order)) for x in samples.ravel()]
        found = [_of_lags(levels, r) / np.sum(r) for r in of_each]
        return np.reshape(found, (*samples.shape[:-2], *levels.square.shape))
    poles = _poles(kind, wc, Q)
    # Of conjugate pairs the first halves, then a real pole, if there is one.
    pairs = len(poles.pole) // 2
    w, c = (x.reshape(*x.shape, *(1,) * (3 - x.ndim))[: len(x) - pairs] for x in poles)
    c[:pairs] *= 2.0
    s, y = levels.square, 1.0 - w
    z = 1.0 / (y**2 + 4.0 * w * s)
    if kind == TWO_POLES:
        power = np.real(c * (1.0 - w**2) * z)[0]
    else:
        # Exact deep in the stop band; the bilinear transformation puts zeros at half the sample rate.
        factors = y**2 * (1.0 if kind == ONE_POLE else 1.0 - s) * z
        power = np.prod(factors[:pairs].real ** 2 + factors[:pairs].imag ** 2, axis=0)
        power = power * factors[-1].real if len(w) > pairs else power
    ends = c * w * y**2 * (1.0 - levels.parity * w**levels.length) * (4.0 / levels.length)
    return power - np.sum(np.real(ends * z**2), axis=0) * (1.0 - s)


def _of_lags(levels: Levels, r: Float[np.ndarray, " lags"]) -> Float[np.ndarray, "2 m"]:
    """Expected squares at the nodes of noise of this autocovariance at all lags, the middle one 0.

    That is its density at the angles a, and what the ends add, −2/n · Σ_d r_d·[d·cos(ad) + sin(ad)/sin(a)],
    all of which are polynomials of Chebyshev in cos(a).
    """
    from numpy.polynomial.chebyshev import chebder, chebval

    own, d = r[len(r) // 2 :], np.arange(len(r) // 2 + 1)
    ends = d * own + np.append(chebder(own / np.maximum(d, 1)), 0.0)
    cosine = 1.0 - 2.0 * levels.square
    power = chebval(cosine, np.append(own[0], 2.0 * own[1:]))
    return power - 2.0 / levels.length * chebval(cosine, ends)


def _of_means(levels: Levels, samples: float, order: int, whole: int) -> tuple[Any, Any]:
    """Expected squares at the nodes of means over so many samples, and their derivative by these.

    The derivative is that on the side where `whole` samples are the largest whole number below.
    """
    lag = abs(np.arange(-whole - 1, whole + 2))
    once = np.maximum(samples - lag, 0.0)
    both = filters.repeated(once, order), order * np.convolve(lag <= whole, filters.repeated(once, order - 1))
    (value, size), (slope, more) = ((_of_lags(levels, r), np.sum(r)) for r in both)
    return value / size, (slope - value * more / size) / size


def passed_and_slopes(levels: Levels, shape: Float[np.ndarray, " 2"], kind: Kind) -> tuple[Any, Any]:
    """`passed` of a kind of response, and its derivatives by ln ω_c and ln(Q − ½) (3, 2, m).

    The third is half the jump of the first, which a moving average has at whole samples.
    """
    slopes = np.zeros((3, *levels.angle.shape))
    if kind == NONE:
        return np.ones_like(levels.angle), slopes
    if kind.is_mean:
        samples = 2.0 * math.pi * filters.HALF_POWER * math.exp(-shape[0])
        wider, narrower = _pieces(samples)
        value, first = _of_means(levels, samples, kind.order, wider)
        _, last = _of_means(levels, samples, kind.order, narrower or wider)
        slopes[0], slopes[2] = -samples * (first + last) / 2.0, -samples * (last - first) / 2.0
        return value, slopes
    moves = np.array([[0.0, 0.0], [1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
    wc, excess = np.exp(shape + _STEP * moves[: 5 if kind.is_shaped else 3]).T[:, :, None, None]
    around = passed(levels, kind, wc, 0.5 + excess)
    slopes[: len(around) // 2] = (around[1::2] - around[2::2]) / (2.0 * _STEP)
    return around[0], slopes


def _pieces(samples: float) -> tuple[int, int]:
    """Whole samples below a duration, and below one that is slightly shorter."""
    longer = math.floor(samples * (1.0 + _SAME))
    return longer, math.ceil(samples * (1.0 - _SAME)) - 1


def piece_of(kind: Kind, bandwidth: float) -> tuple[float, float]:
    """Bandwidths between which the response is smooth around this one [radians per sample interval]."""
    if not kind.is_mean:
        return 0.0, math.inf
    unit = 2.0 * math.pi * filters.HALF_POWER
    longer, shorter = _pieces(unit / bandwidth)
    return unit / (longer + 1.0), unit / shorter if shorter else math.inf


# Number of rows of a program of JAX, in which batches are evaluated; levels of a record are padded to a
# multiple of so many.
_ROWS, _LEVELS = 16, 512


def in_batches(
    function: Callable[[Any, Array], Array], data: Any, rows: Float[np.ndarray, "b k"]
) -> Float[np.ndarray, "b ..."]:
    """Function of JAX of data and of each row, compiled once for any number of rows and other such data."""
    whole = np.resize(rows, (-(-len(rows) // _ROWS) * _ROWS, rows.shape[1]))
    parts = [_mapped(function, data, some) for some in np.split(whole, len(whole) // _ROWS)]
    return np.concatenate(parts)[: len(rows)]


@eqx.filter_jit
def _mapped(function: Callable[[Any, Array], Array], data: Any, rows: ArrayLike) -> Array:
    return jax.lax.map(lambda row: function(data, row), jnp.asarray(rows))


class Others(eqx.Module):
    """Terms of unit amplitude whose free shapes have no closed form, and the places where they are evaluated.

    Each shape has the index of its term, its name and its lower bound.
    """

    terms: tuple[NoiseTerm, ...]
    shapes: tuple[tuple[int, str, float], ...] = eqx.field(static=True)
    places: tuple[Place, ...]

    @classmethod
    def of(
        cls, terms: tuple[NoiseTerm, ...], shapes: tuple[tuple[int, str, float], ...], bins: Bins
    ) -> Others:
        """Terms as they are observed in these bins, of which those of a record are padded."""
        places = [Place.of(part) for part in bins.parts]
        if len(places) == 1:
            more = [(0, 0), (0, -len(bins.size) % _LEVELS)]
            frequency = np.pad(places[0].frequency, more, constant_values=bins.rate / 4.0)
            places[0] = places[0]._replace(frequency=frequency)
        return cls(
            tuple(term.with_unit_amplitude().sampled(bins.rate) for term in terms), shapes, tuple(places)
        )

    def squares(self, values: Float[np.ndarray, "b shapes"], m: int) -> Float[np.ndarray, "b terms 2 m"]:
        """Expected squares at the nodes of m levels for these values of ln(shape − lower bound)."""
        return in_batches(_squares, self, values)[..., :m]

    def squares_and_slopes(self, values: Float[np.ndarray, " shapes"], m: int) -> tuple[Any, Any]:
        """Expected squares (terms, 2, m), and of the term of each shape the derivatives by it."""
        moves = _STEP * np.eye(len(values))
        here, *around = self.squares(values + np.concatenate([0.0 * values[None], moves, -moves]), m)
        slopes = (np.array(around[: len(values)]) - around[len(values) :]) / (2.0 * _STEP)
        return here, slopes[np.arange(len(values)), [k for k, *_ in self.shapes]]


def _squares(others: Others, values: Float[Array, " shapes"]) -> Float[Array, "terms 2 padded"]:
    terms = list(others.terms)
    for (k, name, lower), value in zip(others.shapes, values, strict=True):
        terms[k] = terms[k].replace(**{name: lower + jnp.exp(value)})
    every = [jnp.concatenate([place.expected(term) for place in others.places], axis=1) for term in terms]
    return jnp.stack(every)

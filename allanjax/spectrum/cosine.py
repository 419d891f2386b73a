"""The cosine spectrum of a record: levels whose law, under any model, is known almost exactly.

The orthonormal cosine transform (DCT-II) of n rate samples has coefficients

    c_j = √(2/n) Σ_k x_k cos(a_j (k + ½)),    a_j = πj/n,    j = 1 … n−1,

at frequencies j·rate/2n. The bias is in c_0 alone, which is left out. White noise and a random walk have
uncorrelated coefficients exactly (the mean-free random walk's principal components *are* cosines), flicker
and Markov noise almost: the squared correlations of a coefficient with all others sum to 3 % (flicker) and at
most 9 % (Markov) at the lowest frequency, to 0.1 % at the sixtieth. Quantization is an exception: its first
and its last reading are in all coefficients, which matters where hardly any other noise is. So this is
Whittle's likelihood, but accurate for drifting sensors: its usual form, the periodogram of the differenced
record, has leakage from the record's ends that is common to all low frequencies.

The expectation of c_j² follows from the phase covariance G (`noise.model`) without approximation,

    E c_j² = −(1/h²) Σ_s G(s·h) δ²r_j(s),   r_j(d) = (1 − d/n) cos(a_j d) − sin(a_j d)/(n sin a_j),

h being the sample interval, r_j the autocorrelation of the cosine and δ² its second difference. That is
done for the lowest frequencies, where the record's finite length matters; above, E c_j² is rate times the
PSD of the samples, aliases included. High frequencies are averaged in bins: c_j² over its expectation is
χ² with one degree of freedom, and the mean of k of them has k.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from allanjax.allan.covariance import discrete_gauss
from allanjax.allan.estimators import check_finite
from allanjax.base.equality import ByValue
from allanjax.base.errors import AllanjaxError, FitError
from allanjax.noise.terms import DriftRamp, NoiseTerm

# Coefficients up to this one are a bin each, and have their exact expectation.
_SINGLE = 64
#: Bins per octave above these.
PER_OCTAVE = 6
# Samples up to which a transform of any length is fast, and prime factors of fast lengths.
_SHORT, _PRIMES = 1 << 18, (2, 3, 5, 7, 11, 13, 17, 19, 23, 29, 31, 37, 41, 43, 47, 53, 59, 61)
# Nodes of the quadratures over lags, between two of their edges.
_LAG_ORDER = 12
# Bins on either side of a line that are of one width; and the factor by which they grow beyond.
_AROUND = 12
_GROWTH = 1.25


def cosine_transform(x: Float[np.ndarray, "n ..."]) -> Float[np.ndarray, "n-1 ..."]:
    """Cosine coefficients c_1 … c_{n−1} of samples, along the first axis."""
    from scipy.fft import dct

    # Each transform is contiguous in memory.
    return dct(x.T, type=2, norm="ortho", workers=-1).T[1:]


def fast_length(n: int) -> int:
    """The largest length of at most n samples whose transform is fast, without a prime factor above 61.

    Of a million samples it leaves out some ten; short records are left as they are.
    """
    while n > _SHORT:
        rest = n
        for prime in _PRIMES:
            while rest % prime == 0:
                rest //= prime
        if rest == 1:
            break
        n -= 1
    return n


class Part(NamedTuple):
    """Part of a spectrum: the transforms of segments of one length and rate; for a record, all of it.

    Attributes:
        n: number of values in a segment.
        rate: their rate [Hz].
        edges: first coefficient of each bin, and the one after the last. They begin at 1, with bins of single
            coefficients up to 64, or well above 64.
        segments: number of segments.
    """

    n: int
    rate: float
    edges: Int[np.ndarray, " m+1"]
    segments: int

    @property
    def middle(self) -> Float[np.ndarray, " m"]:
        """Middle of each bin [Hz]."""
        return (self.edges[:-1] + self.edges[1:] - 1) * self.rate / (4.0 * self.n)

    @property
    def low(self) -> int:
        """Number of lowest coefficients that the record's finite length affects; each is a bin."""
        if self.edges[0] > 1:
            return 0
        return min(int(np.argmax(np.append(np.diff(self.edges) > 1, True))), _SINGLE)

    @property
    def node_frequencies(self) -> Float[np.ndarray, "2 m"]:
        """Two frequencies [Hz] per bin, with the mean and the variance of its coefficients' frequencies."""
        away = np.sqrt((np.diff(self.edges) ** 2 - 1.0) / 12.0)
        return self.middle + np.stack([-away, away]) * self.rate / (2.0 * self.n)


@dataclasses.dataclass(frozen=True, eq=False)
class Bins(ByValue):
    """Bins of the cosine coefficients of a record, or of the parts of a stream's spectrum.

    Attributes:
        n: number of samples.
        rate: sample rate [Hz].
        parts: the transforms, lowest frequencies first.
    """

    n: int
    rate: float
    parts: tuple[Part, ...]

    @functools.cached_property
    def size(self) -> Int[np.ndarray, " m"]:
        """Number of coefficients in each bin, of all segments together."""
        return np.concatenate([part.segments * np.diff(part.edges) for part in self.parts])

    @functools.cached_property
    def frequency(self) -> Float[np.ndarray, " m"]:
        """Middle of each bin [Hz], increasing."""
        return np.concatenate([part.middle for part in self.parts])

    @classmethod
    def of(
        cls,
        n: int,
        rate: float,
        around: Sequence[tuple[float, float]] = (),
        per_octave: int = PER_OCTAVE,
    ) -> Bins:
        """Bins of single coefficients, then logarithmic ones, and finer ones around lines and resonances.

        `around` are the frequency and width [Hz] of each of these; a width of 0 stands for any.
        """
        top = min(_SINGLE, n - 1)
        growing = top * 2.0 ** (np.arange(1, np.ceil(per_octave * np.log2(n / top))) / per_octave)
        edges = [np.rint(growing) + 1.0]
        for frequency, width in around:
            j = 2.0 * n * frequency / rate
            unit = max(2.0 * n * width / rate / 8.0, 1.0)
            steps = unit * np.arange(1.0, _AROUND + 1.0)
            # Farther out they would be wider than the logarithmic bins.
            while steps[-1] * (_GROWTH - 1.0) < j * np.log(2.0) / per_octave:
                steps = np.append(steps, np.ceil(steps[-1] * _GROWTH))
            near = steps[steps < max(0.6 * j, _AROUND + 1.0)] - unit / 2.0
            edges += [np.rint(np.rint(j) + 0.5 - near), np.rint(np.rint(j) + 0.5 + near)]
        above = np.unique(np.concatenate(edges))
        above = above[(above > top + 1) & (above < n)]
        every = np.unique(np.concatenate([np.arange(1, top + 2), above, [n]]).astype(int))
        return cls(n, rate, (Part(n, rate, every, 1),))

    @property
    def edges(self) -> Int[np.ndarray, " m+1"]:
        """First coefficient of each bin of a record, and the one after the last."""
        (whole,) = self.parts
        return whole.edges

    def sums(self, products: Float[np.ndarray, "n-1 ..."]) -> Float[np.ndarray, "m ..."]:
        """Sums of products of a record's coefficients over each bin."""
        return _binned(products, self.edges)

    def statistics(
        self, c: Float[np.ndarray, "n-1 axes"], ramp: Float[np.ndarray, " n-1"]
    ) -> SpectralStatistics:
        """Statistics [axes, m] from the coefficients of the axes and those of a ramp."""
        # Axis by axis, since large arrays take time to allocate.
        squares, cross = np.array([(self.sums(x * x), self.sums(x * ramp)) for x in c.T]).swapaxes(0, 1)
        return SpectralStatistics(squares, cross, np.broadcast_to(self.sums(ramp * ramp), squares.shape))

    def per_octave(self) -> Float[np.ndarray, " m"]:
        """Number of bins in the octave around each bin."""
        inside = abs(np.log2(self.frequency[:, None] / self.frequency)) <= 0.5
        return inside.sum(axis=1).astype(float)


def smoothed(squares: Float[np.ndarray, " m"], size: Float[np.ndarray, " m"]) -> Float[np.ndarray, " m"]:
    """Mean squares in seven bins around each, from sums over bins of so many coefficients."""
    total, count = (np.convolve(x, np.ones(7), "same") for x in (squares, size))
    return np.maximum(total / np.maximum(count, 1e-9), 1e-300)


def bin_edges(first: int, stop: int, bins: int) -> Int[np.ndarray, " bins+1"]:
    """Edges of logarithmic bins of the coefficients first … stop−1; if first is 1, single ones up to 64."""
    single = np.arange(1, _SINGLE + 1) if first == 1 else np.zeros(0, int)
    rest = np.rint(np.geomspace(first + len(single), stop, bins - len(single) + 1)).astype(int)
    return np.append(single, rest)


@functools.lru_cache(maxsize=16)
def exact_expectation(
    n: int, rate: float, top: int
) -> tuple[Float[np.ndarray, " lags"], Float[np.ndarray, "top lags"]]:
    """Lags [s], and weights of G there whose sum is the exact E c_j² for j = 1 … top."""
    spacing = max(n // (top // 2), 1)
    edges = np.concatenate([2.0 ** np.arange(np.log2(spacing)), np.linspace(spacing, n, max(top // 2, 1))])
    edges = np.unique(np.rint(edges)).astype(int)
    nodes, weights = discrete_gauss(np.diff(edges), _LAG_ORDER)
    s = (edges[:-1, None] + nodes).ravel()
    used = weights.ravel() > 0.0
    s, w = s[used], weights.ravel()[used]
    j = np.arange(1, top + 1)[:, None]
    a = np.pi * j / n
    curvature = 4.0 * np.sin(a / 2.0) ** 2
    # δ²r_j(s) between its kinks at 0 and n, where a one-sided difference is left.
    inside = -curvature * (1.0 - s / n) * np.cos(a * s)
    inside += (2.0 * np.sin(a) + curvature / np.sin(a)) / n * np.sin(a * s)
    at_zero = 2.0 * ((1.0 - 1.0 / n) * np.cos(a) - 1.0 / n - 1.0)
    at_end = np.where(j % 2, -1.0, 1.0) * (1.0 + np.cos(a)) / n
    all_weights = -(rate**2) * np.concatenate([at_zero, 2.0 * w * inside, 2.0 * at_end], axis=1)
    return np.concatenate([[0.0], s, [n]]) / rate, all_weights


class SpectralStatistics(NamedTuple):
    """Sufficient statistics of an axis (or of several, stacked) for Whittle's likelihood, as sums over bins.

    Attributes:
        squares: sums of c_j².
        cross: sums of c_j times the coefficient of a ramp.
        gram: sums of the ramp's squared coefficients.
    """

    squares: Any
    cross: Any
    gram: Any


def term_column(term: NoiseTerm, n: int, rate: float) -> Float[np.ndarray, " n-1"]:
    """Cosine coefficients of a deterministic term of unit amplitude (`NoiseTerm.column`) in n samples.

    Raises:
        FitError: it does not vary within the record, so it cannot be separated from the bias.
    """
    column = np.asarray(term.column((np.arange(n) + 0.5) / rate))
    if not np.ptp(column) > 0.0:
        raise FitError(
            f"{term.name()} does not vary within the record of {n / rate:g} s; leave it out, or give times "
            "since the record's start"
        )
    return cosine_transform(column)


def joint_statistics(
    segments: Sequence[Float[np.ndarray, "_ axes"]], rate: float
) -> tuple[Bins, SpectralStatistics]:
    """Bins and statistics [axes, m] of segments of a record, one after the other, each less its own mean.

    Coefficients of different segments are independent for white noise and random walks, and nearly so for
    flicker and Markov noise. `Bins.n` is the length of the first segment, the longest.
    """
    parts: list[Part] = []
    sums = []
    for x in (x[: fast_length(len(x))] for x in segments):
        bins = Bins.of(len(x), rate)
        parts += bins.parts
        sums.append(bins.statistics(cosine_transform(x - x.mean(axis=0)), ramp_column(len(x), rate)))
    joint = SpectralStatistics(*(np.concatenate(some, axis=1) for some in zip(*sums, strict=True)))
    return Bins(parts[0].n, rate, tuple(parts)), joint


@functools.lru_cache(maxsize=2)
def ramp_column(n: int, rate: float) -> Float[np.ndarray, " n-1"]:
    """Cosine coefficients of a ramp of 1 per second in n samples."""
    return term_column(DriftRamp(), n, rate)


# Averaged cosine spectra of a stream: statistics for Whittle's likelihood of a record of any length.
#
# Means of D successive samples are themselves samples of the same sensor, read D times more slowly: phase
# differences over a longer interval. So the spectrum of a long record can be assembled from several rates,
# each for suitable frequencies. Level k is the series of means over D^k samples. At each level but the last
# the series is cut into segments of L values, these are transformed one by one (see `cosine`), and the
# squares of their coefficients are summed, but for the lowest: there neighbouring segments are correlated,
# and the next level has these frequencies. The last level is short enough to be kept and transformed at once.
# A record that is short enough has that level only, and its statistics are those of the record itself.
#
# Blocks and segments are aligned to the stream's sample numbers, and a piece of a stream keeps the values of
# incomplete segments at its ends. So merged pieces give the same as the entire stream.

# Values of a level that are averaged to one of the next.
_FACTOR = 8
# Values in a segment.
_SEGMENT = 2**13
# Lowest coefficient of a level that is used; the next level is used up to _FACTOR times that coefficient.
_LOWEST = 2**8
# Longest last level, which is kept and transformed at once.
_KEPT = 2**18
# Bins of the last level: the same number for every length, at least six per octave.
_LAST_BINS = 128
# Segments that are transformed together, which bounds the memory.
_TOGETHER = 64


@dataclasses.dataclass(frozen=True, eq=False)
class SegmentedLevel:
    """Level of a piece of a stream: its complete segments as sums, and the values at its ends.

    Attributes:
        first: number of its first value, in the stream's level.
        head: values before the first boundary of segments; all of them if there is none.
        tail: values after the last boundary.
        count: number of complete segments between.
        squares, cross: sums over these segments, in bins, of c_j² and of c_j times the coefficient of a ramp
            of 1 per sample.
    """

    first: int
    head: Float[np.ndarray, "head axes"]
    tail: Float[np.ndarray, "tail axes"]
    count: int
    squares: Float[np.ndarray, "m axes"]
    cross: Float[np.ndarray, "m axes"]

    @classmethod
    def of(cls, x: Float[np.ndarray, "n axes"], first: int, edges: Int[np.ndarray, " m+1"]) -> SegmentedLevel:
        """Level of the values x, numbered from `first`."""
        begin = min(-first % _SEGMENT, len(x))
        count = (len(x) - begin) // _SEGMENT
        end = begin + count * _SEGMENT
        squares, coefficients = np.zeros((2, edges[-1] - edges[0], x.shape[1]))
        segments = x[begin:end].reshape(count, _SEGMENT, x.shape[1])
        for k in range(0, count, _TOGETHER):
            c = _coefficients(segments[k : k + _TOGETHER])[:, edges[0] - 1 : edges[-1] - 1]
            squares += np.einsum("sja,sja->ja", c, c)
            coefficients += c.sum(axis=0)
        cross = coefficients * _segment_ramp(edges)
        # Copies, since views would keep all of x in memory.
        return cls(
            first, x[:begin].copy(), x[end:].copy(), count, _binned(squares, edges), _binned(cross, edges)
        )

    @property
    def stop(self) -> int:
        """Number of the value after its last one, in the stream's level."""
        return self.first + len(self.head) + self.count * _SEGMENT + len(self.tail)

    @property
    def bounded(self) -> bool:
        """Whether there is a boundary between segments in it."""
        return len(self.head) == -self.first % _SEGMENT

    @property
    def end(self) -> Float[np.ndarray, "k axes"]:
        """Values after the last boundary, or all if there is none."""
        return self.tail if self.bounded else self.head

    def merge(
        self, between: Float[np.ndarray, "k axes"], right: SegmentedLevel, edges: Int[np.ndarray, " m+1"]
    ) -> SegmentedLevel:
        """Level of this piece and the next one together.

        `between` are the values from the last boundary of this level to the first one of the next.
        """
        joint = SegmentedLevel.of(between, self.stop - len(self.end), edges)
        return SegmentedLevel(
            self.first,
            self.head if self.bounded else joint.head,
            right.tail if right.bounded else joint.tail,
            self.count + joint.count + right.count,
            self.squares + joint.squares + right.squares,
            self.cross + joint.cross + right.cross,
        )


@dataclasses.dataclass(frozen=True, eq=False)
class SegmentSpectra:
    """Spectral statistics of a piece of a stream, of bounded size whatever its length.

    Adjacent pieces are joined by `merge`, in any grouping, and give the statistics of the whole to rounding.
    A stream that comes in chunks is `total = total.merge(of(chunk, rate, total.stop))`, best in chunks of at
    least 10⁵ samples.

    Attributes:
        rate: sample rate [Hz].
        start, stop: numbers of the first sample and of the one after the last, in the stream.
        segmented: levels that are cut into segments.
        last: values of the level above them.
    """

    rate: float
    start: int
    stop: int
    segmented: tuple[SegmentedLevel, ...]
    last: Float[np.ndarray, "n axes"]

    @classmethod
    def of(cls, values: Float[np.ndarray, "n axes"], rate: float, start: int = 0) -> SegmentSpectra:
        """Statistics of these samples [rad/s or m/s²].

        Args:
            values: the samples, one column per axis.
            rate: sample rate [Hz].
            start: number of the first in the stream.

        Raises:
            AllanjaxError: another shape, values that are not finite, a rate that is not positive.
        """
        values = np.asarray(values, float)
        if values.ndim != 2:
            raise AllanjaxError(f"values must have the shape [samples, axes], not {values.shape}")
        if not 0.0 < rate < np.inf:
            raise AllanjaxError(f"the sample rate must be positive and finite, not {rate} Hz")
        check_finite(values, start)
        # Values that are kept are copied, since the array may be a buffer that is filled again.
        last = values if len(values) > _KEPT else values.copy()
        return cls(float(rate), start, start + len(values), (), last)._shortened()

    @property
    def n(self) -> int:
        """Number of samples."""
        return self.stop - self.start

    def merge(self, right: SegmentSpectra) -> SegmentSpectra:
        """Statistics of this piece and the next one together.

        Raises:
            AllanjaxError: the other piece does not begin where this one ends, or is of another stream.
        """
        if right.start != self.stop:
            raise AllanjaxError(
                f"the piece that begins at sample {right.start} does not follow the one that ends before "
                f"{self.stop}: merge adjacent pieces in order, each with its start="
            )
        if right.rate != self.rate or right.last.shape[1] != self.last.shape[1]:
            raise AllanjaxError(
                f"pieces of {self.last.shape[1]} axes at {self.rate:.9g} Hz and of {right.last.shape[1]} at "
                f"{right.rate:.9g} Hz do not belong to one stream"
            )
        left, levels = self, max(len(self.segmented), len(right.segmented))
        while len(left.segmented) < levels:
            left = left._with_level()
        while len(right.segmented) < levels:
            right = right._with_level()
        merged = []
        straddling = self.last[:0]
        for k, (a, b) in enumerate(zip(left.segmented, right.segmented, strict=True)):
            between = np.concatenate([a.end, straddling, b.head])
            merged.append(a.merge(between, b, _edges(k)))
            # The block of the next level with samples of both pieces, if they complete it.
            length = _FACTOR ** (k + 1)
            block = self.stop // length
            complete = self.start <= block * length < self.stop and (block + 1) * length <= right.stop
            at = block * _FACTOR - (a.stop - len(a.end))
            straddling = _blocks(between[at : at + _FACTOR]) if complete else between[:0]
        last = np.concatenate([left.last, straddling, right.last])
        return SegmentSpectra(self.rate, self.start, right.stop, tuple(merged), last)._shortened()

    def of_axes(self, keep: Bool[np.ndarray, " axes"]) -> SegmentSpectra:
        """Statistics of some of the axes."""
        of_axes = ("head", "tail", "squares", "cross")
        segmented = tuple(
            dataclasses.replace(level, **{name: getattr(level, name)[:, keep] for name in of_axes})
            for level in self.segmented
        )
        return dataclasses.replace(self, segmented=segmented, last=self.last[:, keep])

    def statistics(self) -> tuple[Bins, SpectralStatistics]:
        """Bins of the spectrum, the lowest frequency first, and sums over each bin, [axes, m].

        The ramp of these sums is one of 1 per second.

        Raises:
            FitError: fewer than 64 samples.
        """
        if self.n < 64:
            raise FitError(f"{self.n} samples are too few for a spectrum; record at least 64")
        n, depth = len(self.last), len(self.segmented)
        c = cosine_transform(self.last - self.last.mean(axis=0))
        ramp = ramp_column(n, self.rate / _FACTOR**depth)
        if not depth:
            bins = Bins.of(n, self.rate)
            return bins, bins.statistics(c, ramp)
        edges = bin_edges(1, -(-n * _LOWEST * _FACTOR // _SEGMENT), _LAST_BINS)
        parts = [Part(n, self.rate / _FACTOR**depth, edges, 1)]
        c, ramp = c[: edges[-1] - 1], ramp[: edges[-1] - 1, None]
        sums = [[_binned(x, edges) for x in (c**2, c * ramp, ramp**2)]]
        for k in reversed(range(depth)):
            level, edges, rate = self.segmented[k], _edges(k), self.rate / _FACTOR**k
            parts.append(Part(_SEGMENT, rate, edges, level.count))
            gram = level.count * _binned(_segment_ramp(edges) ** 2, edges)
            sums.append([level.squares, level.cross / rate, gram / rate**2])
        squares, cross, gram = (np.concatenate(x).T for x in zip(*sums, strict=True))
        statistics = SpectralStatistics(squares, cross, np.broadcast_to(gram, squares.shape))
        return Bins(self.n, self.rate, tuple(parts)), statistics

    def _with_level(self) -> SegmentSpectra:
        """These statistics with the last level cut into segments, and a shorter one after it."""
        first = -(-self.start // _FACTOR ** len(self.segmented))
        level = SegmentedLevel.of(self.last, first, _edges(len(self.segmented)))
        return dataclasses.replace(
            self, segmented=(*self.segmented, level), last=_blocks(self.last[-first % _FACTOR :])
        )

    def _shortened(self) -> SegmentSpectra:
        """These statistics with as many levels as it takes for the last one to be short."""
        spectra = self
        while len(spectra.last) > _KEPT:
            spectra = spectra._with_level()
        return spectra


def _blocks(x: Float[np.ndarray, "n axes"]) -> Float[np.ndarray, "blocks axes"]:
    """Means of successive values, which are the values of the next level."""
    count = len(x) // _FACTOR
    return x[: count * _FACTOR].reshape(count, _FACTOR, x.shape[1]).mean(axis=1)


def _edges(level: int) -> Int[np.ndarray, " m+1"]:
    """Edges of the bins of a level that is cut into segments."""
    stop = _LOWEST * _FACTOR if level else _SEGMENT
    return bin_edges(_LOWEST, stop, round(PER_OCTAVE * np.log2(stop / _LOWEST)))


def _binned(
    products: Float[np.ndarray, "k ..."], edges: Int[np.ndarray, " m+1"]
) -> Float[np.ndarray, "m ..."]:
    """Sums of products of coefficients over each bin."""
    return np.add.reduceat(products, edges[:-1] - edges[0], axis=0)


def _coefficients(segments: Float[np.ndarray, "s k axes"]) -> Float[np.ndarray, "s k-1 axes"]:
    """Cosine coefficients of each segment without its mean."""
    centred = segments - segments.mean(axis=1, keepdims=True)
    return np.moveaxis(cosine_transform(np.moveaxis(centred, 1, 0)), 0, 1)


def _segment_ramp(edges: Int[np.ndarray, " m+1"]) -> Float[np.ndarray, "k 1"]:
    """Coefficients of a ramp of 1 per sample in a segment, those within these edges."""
    return _whole_segment_ramp()[edges[0] - 1 : edges[-1] - 1, None]


@functools.cache
def _whole_segment_ramp() -> Float[np.ndarray, " k"]:
    """All coefficients of a ramp of 1 per sample in a segment."""
    return ramp_column(_SEGMENT, 1.0)

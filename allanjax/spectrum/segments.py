"""Averaged cosine spectra of a stream: statistics for Whittle's likelihood of a record of any length.

Means of D successive samples are themselves samples of the same sensor, read D times more slowly: phase
differences over a longer interval. So the spectrum of a long record can be put together from several rates,
each for the frequencies that it suits. Level k is the series of means over D^k samples. At each level but the
last the series is cut into segments of L values, these are transformed one by one (see `cosine`), and the
squares of their coefficients are summed, but for the lowest: there neighbouring segments are correlated, and
the next level has these frequencies. The last level is short enough to be kept and transformed as a whole. A
record that is short enough has that level only, and its statistics are those of the record itself.

Blocks and segments are aligned to the stream's sample numbers, and a piece of a stream keeps the values at
its ends that belong to segments of which it has a part. So pieces can be merged, and give what the whole
would.
"""

from __future__ import annotations

import dataclasses
import functools

import numpy as np
from jaxtyping import Bool, Float, Int

from allanjax.base.errors import AllanjaxError, FitError
from allanjax.spectrum.cosine import (
    PER_OCTAVE,
    Bins,
    Part,
    SpectralStatistics,
    bin_edges,
    cosine_transform,
    ramp_column,
)

# Values of a level that are averaged to one of the next.
_FACTOR = 8
# Values in a segment.
_SEGMENT = 2**13
# Lowest coefficient of a level that is used; the next level is used up to _FACTOR times that coefficient.
_LOWEST = 2**8
# Longest last level, which is kept and transformed as a whole.
_KEPT = 2**18
# Bins of the last level: the same number for every length, and six an octave or more.
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
    A stream that comes in chunks is `total = total.merge(of(chunk, rate, total.stop))`, best by chunks of 10⁵
    samples and more.

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
            values: the samples, one column an axis.
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
        bad = ~np.isfinite(values)
        if bad.any():
            row, axis = np.argwhere(bad)[0]
            raise AllanjaxError(
                f"sample {start + row} of axis {axis} is not finite: give samples without gaps, or a stretch"
            )
        # The values that are kept are copied: the array may be a buffer that is filled again.
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
                f"a piece that begins at sample {right.start} does not follow one that ends before "
                f"{self.stop}; merge adjacent pieces in order, each with its start="
            )
        if right.rate != self.rate or right.last.shape[1] != self.last.shape[1]:
            raise AllanjaxError(
                f"pieces of {self.last.shape[1]} axes at {self.rate:.9g} Hz and of {right.last.shape[1]} at "
                f"{right.rate:.9g} Hz are not of one stream"
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
        segmented = tuple(
            SegmentedLevel(
                level.first,
                level.head[:, keep],
                level.tail[:, keep],
                level.count,
                level.squares[:, keep],
                level.cross[:, keep],
            )
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

"""Noise and mean of a recording in windows, in bounded memory however long it is."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Bool, Float, Int

#: Largest number of windows; a long recording has between half as many and so many.
MOST = 1024
#: Samples of the shortest window.
SHORTEST = 16
# Samples that are processed at once: what a processor's cache holds.
_AT_ONCE = 1 << 15
# Samples at the start of each piece from which the resolution is determined.
_SAMPLED = 4096
# Fields with one entry per window, and the dimension of the array along which windows are.
_ALONG = dict.fromkeys(("count", "mean", "low", "high", "peak", "repeats"), 0) | {"power": 1, "pairs": 1}
# Functions that combine the statistics of two halves into those of one window.
_OF_TWO = dict.fromkeys(("count", "repeats", "power", "pairs"), np.add) | {
    "low": np.minimum,
    "high": np.maximum,
    "peak": np.maximum,
}


@dataclasses.dataclass(frozen=True, eq=False)
class Windows:
    """Adjacent windows of a recording, with statistics of each.

    Attributes:
        size: samples of a window, a power of two; one at the seam of two merged pieces may be shorter.
        count: samples of each window.
        mean, low, high: mean, least and largest of its samples [rad/s or m/s²].
        power: sums of squares of the differences between the means of neighbouring clusters of 1, 2, 4, …,
            size/2 samples, which do not overlap; `pairs` are how many.
        peak: largest difference of two neighbouring samples.
        repeats: number of samples equal to the one before; 15 of 16 neighbours are compared.
        resolution: smallest step between samples on each axis.
        rest: samples after the last window, fewer than its size.
    """

    size: int
    count: Int[np.ndarray, " w"]
    mean: Float[np.ndarray, "w axes"]
    low: Float[np.ndarray, "w axes"]
    high: Float[np.ndarray, "w axes"]
    power: Float[np.ndarray, "scales w axes"]
    pairs: Int[np.ndarray, "scales w"]
    peak: Float[np.ndarray, "w axes"]
    repeats: Int[np.ndarray, "w axes"]
    resolution: Float[np.ndarray, " axes"]
    rest: Float[np.ndarray, "r axes"]

    @classmethod
    def of(cls, values: Float[np.ndarray, "n axes"], size: int | None = None) -> Windows:
        """Windows of these samples, of `size` samples each; by default `MOST` windows at most."""
        if size is None:
            size = SHORTEST
            while len(values) // size > MOST:
                size *= 2
        whole = len(values) // size
        step = max(_AT_ONCE // size, 1)
        parts = [
            _statistics(values[k * size : min(k + step, whole) * size], size, size)
            for k in range(0, whole, step)
        ]
        joined = _statistics(values[:0], size, size)._joined(*parts)
        rest = np.array(values[whole * size :])
        return dataclasses.replace(joined, resolution=_resolution(values), rest=rest)

    def __len__(self) -> int:
        return len(self.count)

    @property
    def repeated(self) -> Float[np.ndarray, "w axes"]:
        """Share of the samples in each window that are equal to the one before."""
        compared = (SHORTEST - 1) * (self.count // SHORTEST)
        return self.repeats / np.maximum(compared, 1)[:, None]

    @property
    def n(self) -> int:
        """Number of samples, those after the last window included."""
        return int(self.count.sum()) + len(self.rest)

    @property
    def edges(self) -> Int[np.ndarray, " w+1"]:
        """Indices of the first sample of each window, and of the one after the last window."""
        return np.concatenate([[0], np.cumsum(self.count)])

    def updated(self, values: Float[np.ndarray, "n axes"]) -> Windows:
        """These windows and those of the samples that follow, twice as long once there would be too many."""
        held, left = self, np.concatenate([self.rest, values])
        while (free := MOST - len(held)) * held.size + held.size <= len(left):
            taken = free * held.size
            held = held._joined(Windows.of(left[:taken], held.size))._coarser()
            left = left[taken:]
        return held._joined(Windows.of(left, held.size))

    def merge(self, right: Windows) -> Windows:
        """Windows of this piece and the next one, with one of the samples that are left at the seam."""
        if self.n == 0:
            return right
        left = self.closed()
        while left.size < right.size:
            left = left._coarser()
        while right.size < left.size:
            right = right._coarser()
        joined = left._joined(right)
        while len(joined) > MOST:
            joined = joined._coarser()
        return joined

    def closed(self) -> Windows:
        """These windows with the remaining samples in a shorter last one, or, if few, in the last one."""
        if len(self.rest) == 0:
            return self
        last = self._joined(_statistics(self.rest, self.size, len(self.rest)))
        if 2 * len(self.rest) >= self.size or len(self) == 0:
            return last
        before, two = last.between(0, len(self) - 1), last.between(len(self) - 1, len(self) + 1)
        return before._joined(two._paired())

    def of_axes(self, keep: Bool[np.ndarray, " axes"]) -> Windows:
        """Windows of some of the axes."""
        columns = ("mean", "low", "high", "power", "peak", "repeats", "resolution", "rest")
        return dataclasses.replace(self, **{name: getattr(self, name)[..., keep] for name in columns})

    def between(self, first: int, last: int) -> Windows:
        """Windows `first` up to but not including `last`."""
        return dataclasses.replace(self._rows(slice(first, last)), rest=self.rest[:0])

    def _rows(self, rows: slice) -> Windows:
        """Some of the windows."""
        part = {name: getattr(self, name)[(slice(None),) * along + (rows,)] for name, along in _ALONG.items()}
        return dataclasses.replace(self, **part)

    def _joined(self, *others: Windows) -> Windows:
        """Windows of this piece followed by those of others, of the same size."""
        pieces = (self, *others)
        joined = {
            name: np.concatenate([getattr(piece, name) for piece in pieces], axis=along)
            for name, along in _ALONG.items()
        }
        resolution = np.min([piece.resolution for piece in pieces], axis=0)
        return Windows(self.size, **joined, resolution=resolution, rest=pieces[-1].rest)

    def _coarser(self) -> Windows:
        """Windows twice as long, each of two; an odd one at the end stays as it is."""
        half = len(self) // 2
        a, b = self.between(0, 2 * half), self._rows(slice(2 * half, None))
        whole = (a.count[::2] == self.size) & (a.count[1::2] == self.size)
        d = np.where(whole[:, None], a.mean[1::2] - a.mean[::2], 0.0)
        longer = a._paired()._with_scale(d * d, whole)
        odd = b._with_scale(np.zeros(b.mean.shape), np.zeros(len(b), bool))
        return longer._joined(odd)

    def _with_scale(self, power: Float[np.ndarray, "w axes"], pairs: Bool[np.ndarray, " w"]) -> Windows:
        """These as windows of twice the size, with the sums of squares at one more cluster size."""
        return dataclasses.replace(
            self,
            size=2 * self.size,
            power=np.concatenate([self.power, power[None]]),
            pairs=np.concatenate([self.pairs, pairs[None].astype(int)]),
        )

    def _paired(self) -> Windows:
        """Pairs of windows as one window each, but for the differences between the two."""
        a, b = self._rows(slice(0, None, 2)), self._rows(slice(1, None, 2))
        paired = {name: of_two(getattr(a, name), getattr(b, name)) for name, of_two in _OF_TWO.items()}
        mean = (a.count[:, None] * a.mean + b.count[:, None] * b.mean) / paired["count"][:, None]
        return dataclasses.replace(self, **paired, mean=mean)


def _statistics(values: Float[np.ndarray, "n axes"], size: int, length: int) -> Windows:
    """Windows of `length` samples without a rest: `size`, or fewer for a single short one."""
    axes = values.shape[1]
    # Axis by axis, so that neighbouring samples are adjacent in memory.
    x = np.ascontiguousarray(values.T).reshape(axes, -1, length)
    count = np.full(x.shape[1], length)
    low, high, repeats = x.min(axis=2).T, x.max(axis=2).T, _repeats(x).T
    peak = np.zeros(low.shape)
    power = np.empty((size.bit_length() - 1, *low.shape))
    pairs = np.empty((len(power), len(count)), int)
    for k in range(len(power)):
        even, odd = x[:, :, :-1:2], x[:, :, 1::2]
        d = odd - even
        if k == 0 and length > 1:
            peak = np.maximum(d.max(axis=2), -d.min(axis=2)).T
        power[k], pairs[k] = np.einsum("awk,awk->wa", d, d), d.shape[2]
        x = 0.5 * (odd + even)
    mean = x[:, :, 0].T if length == size else values.mean(axis=0)[None]
    resolution = np.full(axes, np.inf)
    return Windows(size, count, mean, low, high, power, pairs, peak, repeats, resolution, values[:0])


def _repeats(x: Float[np.ndarray, "*w n"]) -> Int[np.ndarray, " *w"]:
    """Number of samples equal to the one before, counted in blocks of the shortest window."""
    count = x.shape[-1] // SHORTEST
    blocks = x[..., : count * SHORTEST].reshape(*x.shape[:-1], count, SHORTEST)
    return np.count_nonzero(blocks[..., 1:] == blocks[..., :-1], axis=(-2, -1))


def _resolution(values: Float[np.ndarray, "n axes"]) -> Float[np.ndarray, " axes"]:
    """Smallest step between different samples among the first ones; infinite where none differ."""
    x = np.sort(values[:_SAMPLED], axis=0)
    if len(x) < 2:
        return np.full(values.shape[1], np.inf)
    d = np.diff(x, axis=0)
    # Differences due to floating-point rounding are not steps.
    return np.where(d > 1e-9 * np.ptp(x, axis=0), d, np.inf).min(axis=0)

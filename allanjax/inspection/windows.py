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
# Samples at the start of each piece among which the resolution is looked for.
_SAMPLED = 4096
# Fields with one row a window.
_ROWS = ("count", "mean", "low", "high", "peak", "repeats")


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
        repeats: samples equal to the one before, but for each sixteenth: 15 of 16 neighbours are compared.
        resolution: smallest step between samples that was seen on each axis.
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
            _statistics(values[k * size : min(k + step, whole) * size], size) for k in range(0, whole, step)
        ]
        parts = parts or [_statistics(values[:0], size)]
        mean, low, high, power, peak, repeats = (
            np.concatenate(p, axis=p[0].ndim - 2) for p in zip(*parts, strict=True)
        )
        scales = 2 ** np.arange(len(power))
        return cls(
            size,
            np.full(whole, size),
            mean,
            low,
            high,
            power,
            np.repeat((size // (2 * scales))[:, None], whole, axis=1),
            peak,
            repeats,
            _resolution(values),
            np.array(values[whole * size :]),
        )

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
        while (room := MOST - len(held)) * held.size + held.size <= len(left):
            taken = room * held.size
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
        last = self._joined(self._short())
        if 2 * len(self.rest) >= self.size or len(self) == 0:
            return last
        before, two = last.between(0, len(self) - 1), last.between(len(self) - 1, len(self) + 1)
        one = two._paired(two.power[:, :1] + two.power[:, 1:], two.pairs[:, :1] + two.pairs[:, 1:])
        return before._joined(one)

    def of_axes(self, keep: Bool[np.ndarray, " axes"]) -> Windows:
        """Windows of some of the axes."""
        columns = ("mean", "low", "high", "power", "peak", "repeats", "resolution", "rest")
        return dataclasses.replace(self, **{name: getattr(self, name)[..., keep] for name in columns})

    def between(self, first: int, last: int) -> Windows:
        """Windows `first` up to but not including `last`."""
        rows = slice(first, last)
        return dataclasses.replace(
            self,
            **{name: getattr(self, name)[rows] for name in _ROWS},
            power=self.power[:, rows],
            pairs=self.pairs[:, rows],
            rest=self.rest[:0],
        )

    def _short(self) -> Windows:
        """Window of the remaining samples."""
        r = self.rest
        power, pairs = np.zeros((len(self.power), 1, r.shape[1])), np.zeros((len(self.power), 1), int)
        means, peak, repeats = r, np.zeros((1, r.shape[1])), _repeats(r.T)[None]
        for k in range(len(power)):
            even, odd = means[: len(means) // 2 * 2 : 2], means[1::2]
            d = odd - even
            if len(d) == 0:
                break
            power[k, 0], pairs[k] = np.sum(d * d, axis=0), len(d)
            if k == 0:
                peak = abs(d).max(axis=0)[None]
            means = 0.5 * (odd + even)
        return dataclasses.replace(
            self.between(0, 0),
            count=np.array([len(r)]),
            mean=r.mean(axis=0)[None],
            low=r.min(axis=0)[None],
            high=r.max(axis=0)[None],
            power=power,
            pairs=pairs,
            peak=peak,
            repeats=repeats,
        )

    def _joined(self, right: Windows) -> Windows:
        """Windows of this piece followed by the other's, of the same size."""
        return Windows(
            size=self.size,
            **{name: np.concatenate([getattr(self, name), getattr(right, name)]) for name in _ROWS},
            power=np.concatenate([self.power, right.power], axis=1),
            pairs=np.concatenate([self.pairs, right.pairs], axis=1),
            resolution=np.fmin(self.resolution, right.resolution),
            rest=right.rest,
        )

    def _coarser(self) -> Windows:
        """Windows twice as long, each of two; an odd one at the end stays as it is."""
        half = len(self) // 2
        a, b = self.between(0, 2 * half), self.between(2 * half, len(self))
        whole = (a.count[::2] == self.size) & (a.count[1::2] == self.size)
        d = np.where(whole[:, None], a.mean[1::2] - a.mean[::2], 0.0)
        power = np.concatenate([a.power[:, ::2] + a.power[:, 1::2], (d * d)[None]])
        pairs = np.concatenate([a.pairs[:, ::2] + a.pairs[:, 1::2], whole[None].astype(int)])
        coarse = dataclasses.replace(a._paired(power, pairs), size=2 * self.size)
        none = np.zeros((1, len(b), self.power.shape[2]))
        odd = dataclasses.replace(
            b,
            power=np.concatenate([b.power, none]),
            pairs=np.concatenate([b.pairs, np.zeros((1, len(b)), int)]),
            rest=self.rest,
        )
        return coarse._joined(odd)

    def _paired(
        self, power: Float[np.ndarray, "scales w/2 axes"], pairs: Int[np.ndarray, "scales w/2"]
    ) -> Windows:
        """Pairs of windows as one window each, with these sums of squares."""
        count = self.count[::2] + self.count[1::2]
        total = self.count[:, None] * self.mean
        return dataclasses.replace(
            self,
            count=count,
            mean=(total[::2] + total[1::2]) / count[:, None],
            low=np.minimum(self.low[::2], self.low[1::2]),
            high=np.maximum(self.high[::2], self.high[1::2]),
            power=power,
            pairs=pairs,
            peak=np.maximum(self.peak[::2], self.peak[1::2]),
            repeats=self.repeats[::2] + self.repeats[1::2],
        )


def _statistics(values: Float[np.ndarray, "n axes"], size: int) -> tuple[np.ndarray, ...]:
    """Mean, least and largest sample, sums of squares, largest step and repeats of each window."""
    axes = values.shape[1]
    # Axis by axis, so that neighbouring samples are adjacent in memory.
    x = np.ascontiguousarray(values.T).reshape(axes, -1, size)
    low, high = x.min(axis=2), x.max(axis=2)
    repeats = _repeats(x).T
    power = np.empty((size.bit_length() - 1, x.shape[1], axes))
    peak = np.zeros(low.T.shape)
    for k in range(len(power)):
        d = x[:, :, 1::2] - x[:, :, ::2]
        if k == 0:
            peak = np.maximum(d.max(axis=2), -d.min(axis=2)).T
        power[k] = np.einsum("awk,awk->wa", d, d)
        x = 0.5 * (x[:, :, 1::2] + x[:, :, ::2])
    return x[:, :, 0].T, low.T, high.T, power, peak, repeats


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
    # Differences by rounding to floating point are no steps.
    return np.where(d > 1e-9 * np.ptp(x, axis=0), d, np.inf).min(axis=0)

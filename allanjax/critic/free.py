"""Descriptions that name nothing: a free level of the spectrum or of the noise over time, free values.

What they gain over a model, on data that they were not estimated from, is what the model leaves unexplained.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.special import ndtr

from allanjax.critic.comparison import StageResiduals

# Ordinates of one half in the narrowest window of a free level, number of intervals of a free distribution.
_NARROWEST, _INTERVALS = 16, 24
# Share of the gain outside a place, at either end.
_OUTSIDE = 0.05


class FreeLevel(NamedTuple):
    """What a free level gains on data that it was not estimated from [nats], in windows of equal length."""

    gain: Float[np.ndarray, " windows"]
    length: float

    def place(self) -> tuple[float, float]:
        """Part of the spectrum or of the record with most of the gain, in places of the squares."""
        share = np.cumsum(np.maximum(self.gain, 0.0))
        first, last = np.searchsorted(share, share[-1] * np.array([_OUTSIDE, 1.0 - _OUTSIDE]))
        return first * self.length, (last + 1) * self.length

    def within(self, start: float, end: float) -> float:
        """Gain of the windows that overlap a part of the spectrum or of the record, numbered from 0."""
        first, last = int(start / self.length), int(np.ceil(end / self.length))
        return float(np.sum(self.gain[first : max(last, first + 1)]))


def free_level(squares: Float[np.ndarray, " n"]) -> FreeLevel:
    """Gain of a free level of squares of mean 1: every other pair under the best level of the rest.

    The level is constant in windows of 2^k times the narrowest one. The best partition follows from the
    bottom up, each window at the price of having been chosen among all (a regression tree, Donoho 1997).
    """
    length = 2 * _NARROWEST
    windows = len(squares) // length
    pairs = squares[: windows * length].reshape(windows, -1, 2, 2)
    halves = pairs[:, :, 0].sum(axis=(1, 2)), pairs[:, :, 1].sum(axis=(1, 2))
    gain = np.zeros(windows)
    for one, other in (halves, halves[::-1]):
        level = _levels(one, float(_NARROWEST))
        gain += 0.5 * (other - other / level - _NARROWEST * np.log(level))
    return FreeLevel(gain, float(length))


def _levels(sums: Float[np.ndarray, " windows"], count: float) -> Float[np.ndarray, " windows"]:
    """Best level of each window, given the sums over its `count` squares."""
    depth = int(np.ceil(np.log2(max(len(sums), 1))))
    sizes = np.where(np.arange(2**depth) < len(sums), count, 0.0)
    pyramid = [(np.pad(sums, (0, len(sizes) - len(sums))), sizes)]
    for _ in range(depth):
        pyramid.append((pyramid[-1][0].reshape(-1, 2).sum(axis=1), pyramid[-1][1].reshape(-1, 2).sum(axis=1)))
    price = np.log(2.0 * len(sizes)) + 1.0
    best, whole = np.zeros(2 * len(sizes)), []
    for total, size in pyramid:
        ratio = np.maximum(total, 1e-12) / np.maximum(size, 1e-12)
        own = np.where(size > 0.0, 0.5 * (total - size - size * np.log(ratio)) - price, 0.0)
        apart = best.reshape(-1, 2).sum(axis=1)
        whole.append((own >= apart, own > 0.0, ratio))
        best = np.maximum(np.maximum(own, 0.0), apart)
    level, settled = np.ones(1), np.zeros(1, bool)
    for k, (is_whole, differs, ratio) in enumerate(reversed(whole)):
        if k:
            level, settled = np.repeat(level, 2), np.repeat(settled, 2)
        level = np.where(is_whole & differs & ~settled, ratio, level)
        settled |= is_whole
    return np.asarray(level[: len(sums)])


def free_distribution(values: Float[np.ndarray, " n"]) -> float:
    """Gain of a free distribution of standardized values over the normal one [nats].

    The shares of intervals that are equally probable under the normal law come from every other pair, the
    gain from the rest.
    """
    share = ndtr((values - values.mean()) / values.std())
    place = np.minimum((share * _INTERVALS).astype(int), _INTERVALS - 1)
    some = np.arange(len(values)) // 2 % 2 == 0
    one, other = (np.bincount(place[half], minlength=_INTERVALS) + 0.5 for half in (some, ~some))
    logs = (np.log(x * _INTERVALS / x.sum()) for x in (other, one))
    return float(sum((x - 0.5) @ log for x, log in zip((one, other), logs, strict=True)))


class Free(NamedTuple):
    """What descriptions that name nothing gain over a model: of the spectrum, the level and the values."""

    spectrum: FreeLevel
    level: FreeLevel
    values: float

    @classmethod
    def of(cls, record: StageResiduals) -> Free:
        """Descriptions of an axis at one stage."""
        e = record.whitened
        return cls(
            free_level(record.whitened_coefficients**2),
            free_level(e**2 / np.mean(e**2)),
            free_distribution(e),
        )

    def place(self, domain: str, record: StageResiduals) -> tuple[float, float]:
        """Part of the record [s] or of the spectrum [Hz] with most of what is gained in a domain."""
        if domain == "level":
            start, end = self.level.place()
            return start / record.rate, end / record.rate
        spacing = record.rate / (2.0 * record.n)
        start, end = self.spectrum.place()
        return start * spacing, end * spacing

    def within(self, domain: str, span: tuple[float, float], record: StageResiduals) -> float:
        """Gain in a domain [nats]: of all values, or in a part of the record [s] or of the spectrum [Hz]."""
        if domain == "values":
            return self.values
        per_unit = record.rate if domain == "level" else 2.0 * record.n / record.rate
        start, end = (per_unit * x for x in span)
        return (self.level if domain == "level" else self.spectrum).within(max(start, 0.0), end)

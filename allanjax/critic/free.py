"""Descriptions that name nothing: a free level of the spectrum or of the noise over time, free values.

What they gain over a model, on data that they were not estimated from, is what the model leaves unexplained.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.special import ndtr

from allanjax.critic.stage import Stage

# Ordinates of one half in the narrowest window of a free level, number of intervals of a free distribution.
_NARROWEST, _INTERVALS = 16, 24
# Share of the gain outside a place, at either end.
_OUTSIDE = 0.05


class Free(NamedTuple):
    """What a description that names nothing gains over a model [nats], in windows of a width [s or Hz]."""

    gain: Float[np.ndarray, " windows"]
    width: float

    @property
    def total(self) -> float:
        """Gain of all windows."""
        return float(self.gain.sum())

    def place(self) -> tuple[float, float]:
        """Part of the record or of the spectrum with most of the gain."""
        share = np.cumsum(np.maximum(self.gain, 0.0))
        first, last = np.searchsorted(share, share[-1] * np.array([_OUTSIDE, 1.0 - _OUTSIDE]))
        return float(first * self.width), float((last + 1) * self.width)

    def within(self, start: float, end: float) -> float:
        """Gain of the windows that overlap a part of the record or of the spectrum."""
        first, last = int(max(start, 0.0) / self.width), int(np.ceil(end / self.width))
        return float(np.sum(self.gain[first : max(last, first + 1)]))


def descriptions(stage: Stage, step: float | None) -> dict[str, Free]:
    """Descriptions of an axis at one stage, by the domain that they describe: one window for the values.

    The `step` between the values as recorded, if any, is not described: it is a finding if it matters.
    """
    e, rate = stage.whitened, stage.rate
    width = 0.0 if step is None else step * float(np.exp(-0.5 * np.mean(np.log(stage.variance))))
    return {
        "spectrum": free_level(stage.whitened_coefficients**2, rate / (2.0 * stage.n)),
        "level": free_level(e**2 / np.mean(e**2), 1.0 / rate),
        "values": Free(np.array([free_distribution(e, width)]), stage.n / rate),
    }


def free_level(squares: Float[np.ndarray, " n"], spacing: float) -> Free:
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
    return Free(gain, length * spacing)


def _levels(sums: Float[np.ndarray, " windows"], count: float) -> Float[np.ndarray, " windows"]:
    """Best level of each window, given the sums over its `count` squares."""
    finest = 1 << (len(sums) - 1).bit_length()
    total, size = (np.pad(x, (0, finest - len(sums))) for x in (sums, np.full(len(sums), count)))
    price = np.log(2.0 * finest) + 1.0
    level, best = np.ones(finest), np.zeros(finest)
    while True:
        ratio = np.maximum(total, 1e-12) / np.maximum(size, 1e-12)
        own = np.where(size > 0.0, 0.5 * (total - size - size * np.log(ratio)) - price, 0.0)
        whole, width = own > best, finest // len(total)
        level = np.where(np.repeat(whole, width), np.repeat(ratio, width), level)
        if len(total) == 1:
            return level[: len(sums)]
        best, total, size = (x.reshape(-1, 2).sum(axis=1) for x in (np.maximum(own, best), total, size))


def free_distribution(values: Float[np.ndarray, " n"], width: float) -> float:
    """Gain of a free distribution of standardized values over the normal one [nats].

    The shares of intervals that are equally probable under the normal law come from every other pair, the
    gain from the rest. Values rounded to this width are drawn within it by the normal law.
    """
    # The variance without that of rounding (Sheppard), which does not hold if it is most of it.
    variance = np.var(values)
    deviation = np.sqrt(max(variance - width**2 / 12.0, 0.1 * variance))
    low, high = (ndtr((values - values.mean() + side * width) / deviation) for side in (-0.5, 0.5))
    share = low + (high - low) * np.random.default_rng(0).random(len(values))
    place = np.minimum((share * _INTERVALS).astype(int), _INTERVALS - 1)
    pairs = place[: len(place) // 4 * 4].reshape(-1, 2, 2)
    one, other = (np.bincount(pairs[:, k].ravel(), minlength=_INTERVALS) + 0.5 for k in (0, 1))
    logs = (np.log(x * _INTERVALS / x.sum()) for x in (other, one))
    return float(sum((x - 0.5) @ log for x, log in zip((one, other), logs, strict=True)))

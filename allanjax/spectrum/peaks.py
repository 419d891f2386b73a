"""Peaks of a cosine spectrum: of lines, and the broader ones of resonances.

A peak is a window of coefficients whose mean square is higher than the level there. Its gain is the logarithm
of the likelihood ratio of a free level in the window, less that of the number of windows of this width.
"""

from __future__ import annotations

from typing import NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Float

from allanjax.spectrum.cosine import Bins

#: Coefficients below this one contain drift; narrowest window.
LOWEST, NARROWEST = 16, 8
# Half the width, in octaves, of what the median around a place is taken of; and bins in an octave.
_AROUND, _PER_OCTAVE = 0.45, 24
# Coefficients whose median is a first guess of the level.
_BLOCK = 64
#: Median of χ² with one degree of freedom.
MEDIAN = 0.4549

_Squares: TypeAlias = Float[np.ndarray, " n-1"]


class Peak(NamedTuple):
    """Window of a spectrum with an excess.

    Attributes:
        gain: gain in log-likelihood of a higher level there [nats].
        middle, width: middle and width of the window, in coefficients.
    """

    gain: float
    middle: float
    width: float

    @property
    def slimness(self) -> float:
        """Middle over width, about the quality factor of a resonance."""
        return self.middle / self.width


def peaks_of(
    squares: _Squares, level: _Squares, most: int, widest: float = np.inf, lowest: int = LOWEST
) -> list[Peak]:
    """Peaks with the highest gains above a level, no two of which overlap, from coefficient `lowest` on."""
    total, n = np.concatenate([[0.0], np.cumsum(squares / level)]), len(level) + 1
    windows, width = [np.zeros((3, 0))], NARROWEST
    while width <= min((n - 1 - lowest) // 4, widest):
        step = max(width // 4, 1)
        excess = (total[lowest + width :: step] - total[lowest : n - width : step]) / width
        # Of four successive windows, which overlap, one at most is chosen.
        highest = np.maximum.reduceat(excess, np.arange(0, len(excess), 4))
        groups = np.argpartition(-highest, min(2 * most, len(highest) - 1))[: 2 * most]
        four = np.minimum(4 * groups[:, None] + np.arange(4), len(excess) - 1)
        k = four[np.arange(len(four)), np.argmax(excess[four], axis=1)]
        k = k[excess[k] > 1.0]
        gain = 0.5 * width * (excess[k] - 1.0 - np.log(excess[k])) - np.log((n - 1) / width)
        windows.append(np.array([gain, lowest + k * step + width / 2.0 + 1.0, np.full(len(k), width)]))
        width *= 2
    every = np.concatenate(windows, axis=1)
    every, chosen = every[:, np.lexsort(-every[::-1])], list[Peak]()
    while len(chosen) < most and every.size:
        chosen.append(Peak(*every[:, 0].tolist()))
        _, middle, wide = every
        every = every[:, abs(middle - middle[0]) > 0.5 * (wide + wide[0])]
    return chosen


def lines_in(squares: _Squares, most: int, lowest: int = LOWEST) -> list[int]:
    """Numbers of the coefficients with the narrowest peaks, the strongest first."""
    peaks = peaks_of(squares, level_nearby(squares), most, NARROWEST, lowest)
    firsts = [int(peak.middle - peak.width / 2.0) for peak in peaks]
    return [first + int(np.argmax(squares[first - 1 : first - 1 + NARROWEST])) for first in firsts]


def level_nearby(squares: _Squares) -> _Squares:
    """Level of each coefficient by medians of blocks, which a line does not change."""
    blocks = squares[: max(len(squares) // _BLOCK, 1) * _BLOCK].reshape(-1, min(_BLOCK, len(squares)))
    median = np.maximum(np.median(blocks, axis=1) / MEDIAN, 1e-300)
    return median[np.minimum(np.arange(len(squares)) // _BLOCK, len(median) - 1)]


def level_beside(squares: _Squares) -> _Squares:
    """Level of each coefficient beside peaks of any width below half an octave.

    It is the higher one of the medians on either side, since an edge is no peak.
    """
    n = len(squares) + 1
    bins = Bins.of(n, 1.0, (), _PER_OCTAVE)
    level, place = np.log(np.maximum(bins.sums(squares), 1e-300) / bins.size), np.log2(bins.frequency)
    away, medians = place - place[:, None], []
    for inside in ((away >= 0.0) & (away <= _AROUND), (away <= 0.0) & (away >= -_AROUND)):
        ordered, count = np.sort(np.where(inside, level, np.inf), axis=1), inside.sum(axis=1)
        middle = np.stack([(count - 1) // 2, count // 2], axis=1)
        medians.append(np.take_along_axis(ordered, middle, axis=1).mean(axis=1))
    return np.exp(np.interp(np.log2(np.arange(1.0, n) / (2.0 * n)), place, np.maximum(*medians)))

"""What a record's spectrum consists of: terms, a response, resonances, and lines that are taken out."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from allanjax.estimate.deterministic import line_columns, take_out_lines
from allanjax.estimate.spectral.components import NONE
from allanjax.estimate.spectral.model import FULL
from allanjax.estimate.structure.search import Record, completed, narrow, refitted, searched
from allanjax.estimate.structure.structure import FIXED, LOWEST, OUTSIDE, Structure
from allanjax.spectrum.cosine import Bins, cosine_transform

# Coefficients on either side of a line that have its power, and that are looked at.
_CORE, _AROUND = 4, 40
# Share of the excess there that a line's core has; log odds of a peak in white noise; peaks that are tried.
_NEARLY_ALL, _SURE, _TRIED = 0.9, 10.0, 64
# Coefficients whose median is a first guess of the level, and the median of χ² with one degree of freedom.
_BLOCK, _MEDIAN = 64, 0.4549
# Looks for lines, each after those found before are taken out.
_LOOKS = 3


class Content(NamedTuple):
    """What a spectrum consists of.

    Attributes:
        structure: terms, response and resonances.
        lines: frequencies of the lines [Hz].
        bins: bins that are fine around the resonances.
        c: cosine coefficients without the lines.
    """

    structure: Structure
    lines: list[float]
    bins: Bins
    c: Float[np.ndarray, " n-1"]

    @property
    def further(self) -> list[int]:
        """Components that are no plain terms, then a negative number for each line."""
        own = [
            k
            for k in np.flatnonzero(self.structure.active).tolist()
            if k == OUTSIDE or k >= FULL.first_oscillator
        ]
        return own + [-1 - k for k in range(len(self.lines))]

    @property
    def plain_terms(self) -> list[int]:
        """Components with some power that are basic terms or Markov processes."""
        markovs = range(FULL.first_markov, FULL.first_oscillator)
        return [k for k in self.structure.there if k < OUTSIDE or k in markovs]

    @property
    def is_plain(self) -> bool:
        """Whether there is nothing besides plain terms."""
        of = self.structure
        return not (of.kind != NONE or len(of.oscillators) or len(of.markovs) or self.lines)


def content_of(x: Float[np.ndarray, " n"], rate: float) -> Content:
    """What the spectrum of these samples consists of."""
    n, lines, x = len(x), list[float](), x - x.mean()
    c = cosine_transform(x)
    for _ in range(_LOOKS):
        if not (more := _conspicuous(c, rate)):
            break
        lines, c = _without_lines(x, rate, lines + more)
    spectrum, found = searched(Record(c**2, rate), Structure.plain(list(range(len(FIXED)))))
    if sharp := narrow(found.structure, n):
        more = [found.structure.frequency(k) * rate / (2.0 * np.pi) for k in sharp]
        lines, c = _without_lines(x, rate, lines + more)
        record, rest = Record(c**2, rate), without(found.structure, sharp)
        spectrum, found = searched(record, refitted(record, rest)[1].structure)
    structure = completed(spectrum, found).structure
    return Content(without(structure, narrow(structure, n)), lines, spectrum.bins, c)


def _conspicuous(c: Float[np.ndarray, " n-1"], rate: float) -> list[float]:
    """Frequencies of peaks that are as narrow as lines and far above their surroundings [Hz]."""
    n, square = len(c) + 1, c**2
    blocks = square[: len(c) // _BLOCK * _BLOCK].reshape(-1, _BLOCK)
    rough = np.repeat(np.median(blocks, axis=1) / _MEDIAN, _BLOCK)
    sure = 2.0 * (np.log(n) + _SURE)
    found: list[int] = []
    for j in np.argsort(square[: len(rough)] / rough)[::-1][:_TRIED].tolist():
        if square[j] < sure * rough[j] or j < LOWEST or any(abs(j - k) <= _CORE for k in found):
            continue
        around = square[max(j - _AROUND, 0) : j + _AROUND + 1]
        level = float(np.median(around)) / _MEDIAN
        core = square[max(j - _CORE, 0) : j + _CORE + 1] - level
        if square[j] > sure * level and core.sum() > _NEARLY_ALL * (around - level).sum():
            found.append(j)
    return [(j + 1) * rate / (2.0 * n) for j in found]


def _without_lines(
    x: Float[np.ndarray, " n"], rate: float, lines: Sequence[float]
) -> tuple[list[float], Float[np.ndarray, " n-1"]]:
    """Lines near these frequencies [Hz], and the coefficients without them."""
    c, taken = take_out_lines(x, rate, [(f, False) for f in lines])
    for line in taken:
        own = line_columns(line.frequency, line.indices, len(x), rate)
        c[line.indices - 1] -= own @ np.linalg.lstsq(own, line.coefficients, rcond=None)[0]
    return [line.frequency for line in taken], c


def without(structure: Structure, resonances: Sequence[int]) -> Structure:
    for k in resonances:
        structure = structure.without(FULL.first_oscillator + k)
    return structure

"""Characterization of text while a logger writes it to a file, or while it comes through a pipe."""

from __future__ import annotations

import math
import os
import re
import select
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO, TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from allanjax.base.errors import AllanjaxError, FitError, RecordingError, UnitError
from allanjax.base.wording import percent
from allanjax.estimate.check import in_words, length_for, random_terms, trial_lengths
from allanjax.fleet.stream import AllanAccumulator
from allanjax.inspection.facts import warnings_of
from allanjax.noise.estimate import SYMBOLS
from allanjax.record.io.chunks import chunks_of
from allanjax.record.io.formats import name_of
from allanjax.record.io.text import growing_text
from allanjax.record.validation import Source

if TYPE_CHECKING:
    from allanjax.estimate.result import AxisFit, Fit
    from allanjax.fleet.options import FitOptions
    from allanjax.inspection import Inspection
    from allanjax.record.io.chunks import ChunkedRecording

# Lines from which columns, units and rate are recognised; and pause [s] between two looks for more lines.
_FIRST, _PAUSE = 200, 0.1
# Size [bytes] of what is read at a time, and of the lines that do not wait for more: a gap ends them.
_PIECE, _BATCH = 1 << 16, 1 << 18
# Time [s] after which a file that does not grow has ended.
_LAST = 60.0
# Share of the time that fits may take, which leaves the machine to the logger.
_SHARE = 0.05


@dataclass(frozen=True)
class Aim:
    """A relative standard deviation to which a coefficient, "N", "B" or "K", is to be known on every axis."""

    symbol: str
    relative_std: float

    @classmethod
    def parse(cls, text: str) -> Aim:
        """The aim in words such as "B 10 %"; AllanjaxError if they are others."""
        found = re.fullmatch(r"\s*([NBK])\s*(\d+(?:\.\d+)?)\s*%\s*", text)
        if found is None or float(found[2]) == 0.0:
            raise AllanjaxError(
                f"{text!r} is no aim; give N, B or K and a relative standard deviation, e.g. 'B 10 %'"
            )
        return cls(found[1], float(found[2]) / 100.0)

    def seconds(self, fit: Fit) -> float:
        """Length [s] of a record that reaches the aim on all axes: that of the fit once it is reached.

        It is nan if it is unknown, as before the coefficient is detected on every axis.
        """
        n, rate = fit.curve.n, fit.curve.rate
        terms, trials = random_terms(), list(trial_lengths(random_terms(), rate, n))
        symbols = [SYMBOLS[term.name()] for term in terms]
        gradient = np.array([float(symbol == self.symbol) for symbol in symbols])

        def needed(result: AxisFit) -> float | None:
            if not result.converged:
                return None
            found = {c.symbol: c for c in result.coefficients.values() if c.detected and c.measured}
            c = found.get(self.symbol)
            if c is None or c.std == 0.0:
                return None
            if c.std <= self.relative_std * c.value:
                return n / rate
            power = np.array([found[x].value ** 2 if x in found else 0.0 for x in symbols])
            size = 2.0 * c.value
            return length_for(size * self.relative_std * c.value, size * c.std, gradient, power, trials)

        lengths = [needed(result) for result in fit.results]
        return max((math.nan if length is None else length for length in lengths), key=_unknown_last)

    def words(self, fit: Fit, seconds: float) -> str:
        """How far a fit is from the aim, which needs so many `seconds`: "B to 10 % in about 40 min more"."""
        aim, now = percent(self.relative_std), fit.curve.n / fit.curve.rate
        fitted = [c for result in fit.results if result.converged for c in result.coefficients.values()]
        if not any(c.symbol == self.symbol for c in fitted):
            return f"{self.symbol} is not among the terms"
        if math.isnan(seconds):
            return f"{self.symbol} to {aim} cannot be predicted before it is known on every axis"
        if seconds <= now:
            return f"{self.symbol} known to {aim}"
        return f"{self.symbol} to {aim} in about {in_words(seconds - now)} more"


def _unknown_last(length: float) -> tuple[bool, float]:
    return math.isnan(length), length


def lines_of(stream: IO[bytes], growing: bool, every: float, stopped: Callable[[], bool]) -> Iterator[bytes]:
    """Yield whole lines of a stream as they come, those of at least `every` [s] or 256 kB at a time.

    Args:
        stream: a pipe, or a file.
        growing: whether more may follow at the end of the stream, as in a file that is being written.
        every: least time [s] between small batches.
        stopped: whether to end before the stream does.

    Raises:
        RecordingError: the file has become shorter.
    """
    rest, ended, least = b"", False, _FIRST
    begin = grown = time.monotonic()
    while not (ended or stopped()):
        piece = b""
        if growing:
            piece = stream.read(_PIECE)
            if os.fstat(stream.fileno()).st_size < stream.tell():
                raise RecordingError("the file has become shorter; watch the file that is written now")
        elif select.select([stream], [], [], _PAUSE)[0]:
            piece = os.read(stream.fileno(), _PIECE)
            ended = not piece
        if piece:
            grown = time.monotonic()
        elif growing:
            ended = time.monotonic() - grown > _LAST
            time.sleep(_PAUSE)
        rest += piece
        is_due = len(rest) >= _BATCH or time.monotonic() - begin >= every
        if is_due and rest.count(b"\n") >= least:
            whole, _, rest = rest.rpartition(b"\n")
            least, begin = 1, time.monotonic()
            yield whole + b"\n"
    whole, mark, _ = rest.rpartition(b"\n")
    if mark:
        yield whole + mark


class Watch:
    """Fits of a record that grows, in constant memory.

    A gap, a bad value or a disturbance ends a piece of the record, and a new piece begins after it.

    Attributes:
        longest: the fit of the longest piece so far; None before there is one.
    """

    def __init__(
        self, batches: Iterator[bytes], options: FitOptions, label: str, warn: Callable[[str], None]
    ) -> None:
        """Watch batches of lines; messages name the file `label`, and `warn` is told why a piece ends."""
        self.longest: Fit | None = None
        self._batches, self._options, self._source, self._warn = batches, options, Source(label), warn

    def fits(self) -> Iterator[Fit]:
        """Yield the fit of the present piece from time to time, and when it ends.

        Raises:
            RecordingError: the first lines are not those of a recording.
        """
        # A logger that starts may leave a gap.
        known = starts = False
        for table in growing_text(self._batches, self._source):
            first = next(table.rows(_PIECE))
            try:
                name = name_of(Path(self._source.label))
                recording = chunks_of(table, name, self._options.reading, len(first[0]))
                known = True
                yield from self._fits_of(recording)
            except (RecordingError, FitError) as error:
                if not known and (starts or isinstance(error, UnitError)):
                    raise
                starts = True
                self._end_piece(error)

    def _end_piece(self, why: AllanjaxError) -> None:
        # What follows the reason is advice for files that have ended.
        self._warn(f"{str(why).partition('; ')[0]}; a new piece of the record begins here")

    def _samples(self, recording: ChunkedRecording) -> Iterator[Float[np.ndarray, "n axes"]]:
        """Yield the samples of a piece up to its end, which a gap or a bad value may be."""
        try:
            yield from recording
        except RecordingError as error:
            self._end_piece(error)

    def _fits_of(self, recording: ChunkedRecording) -> Iterator[Fit]:
        """Yield the fit of a piece from time to time, and when it ends."""
        so_far = AllanAccumulator(recording.rate, recording.axes, name=recording.name, given=recording.given)
        seen: Inspection | None = None
        fitted, due = 0, 0.0
        for samples in self._samples(recording):
            more = AllanAccumulator(recording.rate, recording.axes, start=so_far.n)
            more.update(samples)
            joined = so_far.merge(more)
            looked = self._inspected(joined)
            if self._is_disturbed(looked):
                break
            so_far, seen = joined, looked
            begin = time.monotonic()
            if begin >= due:
                yield self._fit(so_far, seen)
                # The first fit also compiles.
                took = time.monotonic() - begin if fitted else 0.0
                fitted, due = so_far.n, time.monotonic() + took / _SHARE
        if seen is not None and so_far.n > fitted:
            yield self._fit(so_far, seen)

    def _is_disturbed(self, seen: Inspection) -> bool:
        """Whether a piece was disturbed, so that it ends before its last samples, which is reported."""
        disturbed = bool(seen.refusal) or seen.longest_part is not None
        if disturbed:
            why = next(iter(warnings_of(seen.facts)), seen.refusal)
            self._end_piece(FitError(f"{self._source.label}: {why}"))
        return disturbed

    def _inspected(self, piece: AllanAccumulator) -> Inspection:
        seen = piece.inspect(as_is=self._options.as_is, vibrating=self._options.vibrating)
        # What follows is advice for files that have ended.
        facts = (replace(fact, remedy="") if fact.kind == "not examined" else fact for fact in seen.facts)
        return replace(seen, facts=tuple(facts))

    def _fit(self, piece: AllanAccumulator, seen: Inspection) -> Fit:
        """Fit of a piece that has been inspected."""
        fit = piece.fit_inspected(seen, self._options.model, self._options.objective)
        if self.longest is None or fit.curve.n >= self.longest.curve.n:
            self.longest = fit
        return fit

"""Grid: the even times at which samples were taken, as the evidence of their stamps decides.

Stamps may be even, or even but rounded, or times of arrival that scatter about even ones: then no sample is
missing. They may be whole multiples of an interval apart: then samples are missing. They may be pieces of
different rates. What they exclude is refused, also where a user asks for it, unless it is forced.
"""

from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from allanjax.base.errors import RecordingError
from allanjax.base.wording import percent, plain
from allanjax.record.completion import MOST_MISSING
from allanjax.record.io.times import IGNORE, MAX_RATE_DIFFERENCE
from allanjax.record.shapes import Chosen, Places, Seconds
from allanjax.record.validation import MIN_SAMPLES, Source, check_length

# An interval longer than the median by this factor is a gap if the stamps after it are half an interval later
# than expected from those before it; else a stamp is late. So many stamps on either side are compared.
_GAP, _ABOUT = 1.5, 8
# Largest rms jitter of the other intervals, over their mean.
_MAX_JITTER = 0.2
# Share of the record from which on a gap is rather left out than filled in.
_LONG = 0.01
# If a larger share of the intervals is long, a message does not describe single gaps.
_MANY_GAPS = 0.05
# Samples are missing if this share of the long intervals is this near to whole multiples of the usual one.
_MOSTLY, _NEAR_WHOLE = 0.95, 0.2
# A late stamp is followed by a short interval: the most of these, per long interval, if samples are missing.
_EARLY = 0.25
# Deviations from an even grid, in intervals, below which no sample can be missing.
_WITHIN = 0.5
# Share of stamps that go back, below which the clock was set.
_SET = 0.01
# Intervals unlike the usual one show by their distances whether they come from rounding: so many are needed,
# and they come at random if the standard deviation of the distances is this share of their mean.
_SHOWING, _AT_RANDOM = 10, 0.5
# Stamps with a coarser resolution than this, in intervals, show their rate as a line in their spectrum, which
# has at most so many steps.
_COARSE, _BINS = 0.15, 1 << 20
# The power of a line, in that of chance; and so many stamps over which its phase is followed.
_LINE, _FOLLOWED = 50.0, 512
# Rounding of the numbers of steps in an interval.
_SLACK = 1e-3
# Stamps that scatter about even times do not wander off, as they would if samples were lost: the means of
# their deviations over so many parts of the record scatter less than this factor times single deviations.
_PARTS, _BOUNDED = 16, 0.5
# So many stamps are needed to tell this, a quarter of which deviate by this part of an interval.
_FEWEST, _SCATTER = 512, 0.1
# Stamps are times of arrival in bursts if the usual interval is below this part of the mean one. They may
# wander by so much of the record, as their clock does; no more can be missing.
_IN_BURSTS, _WANDER = 0.5, 1e-3
# Parts in which the interval is compared to find pieces of different rates, and the most pieces.
_BLOCKS, _PIECES = 64, 5


class Grid(NamedTuple):
    """Even times of samples.

    Attributes:
        rate: sample rate [Hz].
        note: where it comes from.
        jitter: rms jitter of the intervals between stamps [s].
        places: numbers of the samples on the grid, missing ones included.
        stamped: rate according to the stamps [Hz], which may differ from a given rate.
        even: whether the samples are even, whatever their stamps; then no sample is missing.
    """

    rate: float
    note: str
    jitter: float
    places: Places
    stamped: float
    even: bool = False


class Piece(NamedTuple):
    """Part of a record with a rate of its own.

    Attributes:
        first, end: its first stamp, and the one after its last.
        rate: sample rate [Hz].
    """

    first: int
    end: int
    rate: float


@dataclass(frozen=True)
class Stamps:
    """Times of samples [s], as they were stamped.

    Attributes:
        seconds: times in order.
        step: resolution of the stamps [s]; 0 if unknown.
        label: label of their column.
        source: their origin.
        more: whether further ones follow, so that the longest part without gaps is unknown.
    """

    seconds: Seconds
    step: float
    label: str
    source: Source
    more: bool = False

    def grid(self, rate: float | None, *, gaps: bool, uniform: bool, force: bool) -> Grid:
        """Return the even times that the stamps tell.

        Args:
            rate: given rate [Hz], which has precedence; a note tells if the stamps' differs.
            gaps: whether samples may be missing.
            uniform: whether the samples are said to be even.
            force: whether what the stamps exclude is accepted.

        Raises:
            RecordingError: the stamps do not tell even times; with the remedies that work.
        """
        if uniform:
            if not force:
                self._refuse_excluded()
            return self._even(rate, "for evenly spaced samples")
        pieces = self._pieces()
        if pieces:
            raise self.source.error(self._of_pieces(pieces), "rate")
        if self._is_coarse:
            if self.why_even:
                return self._even(rate, self.why_even)
            if self._demodulated is not None:
                return self._with_lost(self._demodulated, rate, gaps)
            # Stamps that do not tell which samples are missing do not tell where to fill them in.
            gaps = gaps and not self._beats
        try:
            return self._stamped(rate, gaps)
        except RecordingError:
            if not self.why_even:
                raise
            return self._even(rate, self.why_even)

    @cached_property
    def _intervals(self) -> Float[np.ndarray, " intervals"]:
        return np.diff(self.seconds)

    @cached_property
    def _typical(self) -> float:
        """The median interval [s]."""
        return float(np.median(self._intervals))

    @cached_property
    def _unlike(self) -> Int[np.ndarray, " unlike"]:
        """The numbers of the intervals that differ from the usual one by more than rounding."""
        return np.flatnonzero(abs(self._intervals - self._typical) > 0.5 * self.step)

    @cached_property
    def _is_coarse(self) -> bool:
        """Whether intervals differ as the resolution of the stamps is not small beside them."""
        is_coarse = self.step > _COARSE * np.mean(self._intervals) and self._intervals.min() >= 0.0
        return bool(is_coarse and len(self._unlike) >= _SHOWING)

    @cached_property
    def _beats(self) -> bool:
        """Whether rounded intervals differ as regularly as rounding makes them, not as by loss."""
        spacings = np.diff(self._unlike)
        return self._is_coarse and bool(np.std(spacings) < _AT_RANDOM * np.mean(spacings))

    @cached_property
    def _demodulated(self) -> Places | None:
        """The places of samples on a grid some of whose stamps are missing, all rounded to steps.

        The spectrum of the stamps has a line at the rate, also where it is below the resolution's. It is
        sought from the mean rate up to that with the most samples missing, and the grid follows its phase.
        None if there is no such line.
        """
        numbers = np.rint((self.seconds - self.seconds[0]) / self.step).astype(int)
        numbers = numbers[numbers < _BINS]
        size, n = int(numbers[-1]) + 1, len(self.seconds)
        # Long gaps would hide the line of a rate near that of the steps, which is seen near zero.
        long = np.flatnonzero(np.diff(numbers) > _ABOUT * self._typical / self.step)
        within = np.ones(size)
        for first, last in zip(numbers[long], numbers[long + 1], strict=True):
            within[first + 1 : last] = 0.0
        density = len(numbers) / within.sum()
        power = abs(np.fft.rfft(np.bincount(numbers) - density * within)) ** 2
        mean = len(numbers) / (size * self.step)
        rates = np.arange(mean, mean / (1.0 - MOST_MISSING), 0.5 / (size * self.step))
        # Two samples are as many steps apart as the interval has, or one more.
        least = int(np.diff(numbers).min())
        turns = rates * self.step
        rates = rates[(turns * least < 1.0 + _SLACK) & (turns * (least + 1) > 1.0 - _SLACK)]
        # Rates above half that of the steps are seen as others below it.
        turns = rates * self.step
        seen = np.rint(abs(turns - np.rint(turns)) * size).astype(int)
        own = power[np.minimum(seen, len(power) - 1)] if len(rates) else np.zeros(1)
        if not own.max() > _LINE * len(numbers):
            return None
        best = float(rates[int(np.argmax(own))])
        alike = rates[own > 0.5 * own.max()]
        if (abs(alike / best - 1.0) > MAX_RATE_DIFFERENCE).any():
            # Steps longer than the interval do not tell a rate from its mirror image.
            return None
        interval = 1.0 / best
        phases = np.exp(2j * np.pi * self.seconds / interval)
        sums = np.add.reduceat(phases, np.arange(0, n, _FOLLOWED))
        centers = np.minimum(np.arange(len(sums)) * _FOLLOWED + _FOLLOWED // 2, n - 1)
        phase = np.interp(np.arange(n), centers, np.unwrap(np.angle(sums)))
        places = np.rint(self.seconds / interval - phase / (2.0 * np.pi)).astype(int)
        places -= places[0]
        # Each sample has a place of its own.
        return np.maximum.accumulate(places - np.arange(n)) + np.arange(n)

    @cached_property
    def after_gaps(self) -> Chosen:
        """Which samples follow a gap, or follow the clock being set back; rounding makes no gaps."""
        if not self._is_coarse:
            return after_gaps(self.seconds)
        if self._demodulated is not None:
            return np.concatenate([[False], np.diff(self._demodulated) > 1])
        # Rounding makes an interval longer by one step at most.
        beyond = self._intervals > self._typical + 1.5 * self.step
        return after_gaps(self.seconds) & np.concatenate([[False], beyond])

    def _with_lost(self, places: Places, rate: float | None, gaps: bool) -> Grid:
        """Return the grid of samples at these places, some of which are missing."""
        if not gaps:
            raise self.source.error(self._missing(_lost_from(places)), "gaps")
        stamped = 1.0 / _interval(self.seconds, places)
        jitter = float(np.std(self._intervals - np.diff(places) / stamped))
        return self._grid(rate, stamped, jitter, places)

    def _stamped(self, rate: float | None, gaps: bool) -> Grid:
        """Return the grid if the stamps are nearly even; RecordingError if they are not."""
        times, intervals = self.seconds, self._intervals
        if (intervals <= 0.0).any():
            raise self.source.error(self._backwards(), "jitter")
        long = intervals > _GAP * self._typical
        # If there are many, late stamps cannot be identified by their neighbours.
        if not gaps or np.mean(long) <= _MANY_GAPS:
            long = gaps_in(times)
        if long.any() and self.why_even:
            return self._even(rate, self.why_even)
        jitter, regular = float(np.std(intervals[~long])), float(np.mean(intervals[~long]))
        steps = np.where(long, np.maximum(np.rint(intervals / regular), 2.0), 1.0)
        on_grid, lost = float(np.std(intervals - steps * regular)), int(steps.sum()) - len(intervals)
        if gaps:
            jitter = on_grid
        filled = on_grid <= _MAX_JITTER * regular and lost <= MOST_MISSING * (lost + len(times))
        drawn = lost if filled and not self._beats else 0
        if jitter > _MAX_JITTER * regular or (np.mean(long) > _MANY_GAPS and not gaps):
            raise self.source.error(self._irregular(long, drawn, gaps), "jitter")
        if np.any(long) and not gaps:
            gap = self._gap(np.flatnonzero(long), drawn)
            raise self.source.error(f"{gap}, or if no sample is missing, {IGNORE}", "gaps")
        places = np.concatenate([[0], np.cumsum(steps)]).astype(int)
        return self._grid(rate, int(places[-1]) / float(times[-1] - times[0]), jitter, places)

    def _even(self, rate: float | None, how: str) -> Grid:
        """Return the grid of even samples at the mean rate of the stamps, or at the given rate."""
        if not self.seconds[-1] > self.seconds[0]:
            raise self.source.error(f"the times in column {self.label!r} do not increase; {IGNORE}", "jitter")
        jitter, places = float(np.std(self._intervals)), np.arange(len(self.seconds))
        return self._grid(rate, 1.0 / _interval(self.seconds), jitter, places, how)

    def _grid(
        self,
        rate: float | None,
        stamped: float,
        jitter: float,
        places: Places,
        even: str = "",
    ) -> Grid:
        """Return the grid at the given rate, or else that of the stamps; `even` is why it is even, if so."""
        how = f", the mean of column {self.label!r} {even}"
        if not even:
            how = f" from column {self.label!r}, jitter {format_jitter(jitter)}"
        note = f"{stamped:.9g} Hz{how}"
        if rate is not None:
            differ = abs(stamped / rate - 1.0) > MAX_RATE_DIFFERENCE
            note = f"{rate:.9g} Hz as given, {'not' if differ else 'and'} {note}"
        return Grid(rate or stamped, f"sample rate {note}", jitter, places, stamped, bool(even))

    @cached_property
    def why_even(self) -> str:
        """Why the samples must be even although their stamps are not, as part of a note; "" if not."""
        times, n = self.seconds, len(self.seconds)
        if not times[-1] > times[0]:
            return ""
        interval = _interval(times)
        off = times - times.mean() - interval * (np.arange(n) - 0.5 * (n - 1))
        spread = float(np.ptp(off))
        # Intervals, or other numbers that do not pass, are no times.
        if not n * interval > spread:
            return ""
        # The line through the stamps is known to a part of their deviations. Few long intervals may as well
        # be missing samples.
        if self.step and spread <= 1.1 * self.step and len(self._unlike) >= _SHOWING:
            return f"for even samples, whose stamps are rounded to {_short(self.step)}"
        # A missing sample would shift those after it by a whole interval.
        if spread < _WITHIN * interval:
            return f"for even samples, as all stamps are within {_short(spread)} of even ones"
        if n < _FEWEST or self._unsteadiness > MAX_RATE_DIFFERENCE or self._lost:
            return ""
        # One stamp in a thousand that is wrong is no scatter.
        usual = float(np.quantile(abs(off), 0.75))
        means = off[: n // _PARTS * _PARTS].reshape(_PARTS, -1).mean(axis=1)
        if usual > _SCATTER * interval and float(np.std(means)) < _BOUNDED * float(np.std(off)):
            return f"for even samples, whose stamps scatter by {_short(float(np.std(off)))} about even times"
        wander = float(np.ptp(means))
        if self._typical < _IN_BURSTS * interval and wander < _WANDER * n * interval:
            return f"for even samples, which arrive in bursts and wander by {_short(wander)} about even times"
        return ""

    @cached_property
    def _lost(self) -> int:
        """How many samples are missing if intervals are whole multiples of the usual one; else 0."""
        if self._is_coarse:
            if self._demodulated is not None:
                return _lost_from(self._demodulated)
            if self._beats:
                return 0
        intervals = self._intervals
        if not self._typical > 0.0:
            return 0
        # The mean of single intervals is exact where these are rounded to steps.
        typical = float(np.mean(intervals[abs(intervals / self._typical - 1.0) < 0.5]))
        ratio = intervals / typical
        steps = np.rint(ratio)
        long, early = steps >= 2.0, ratio < 0.5
        near = _NEAR_WHOLE + self.step / typical
        if not long.any() or np.mean(abs(ratio - steps)[long] < near) < _MOSTLY:
            return 0
        return int((steps[long] - 1.0).sum()) if early.sum() <= _EARLY * long.sum() else 0

    def _pieces(self) -> list[Piece]:
        """Return the pieces of a record whose rate changes a few times; [] if it is steady, or drifts."""
        intervals = self._intervals
        if len(intervals) < 4 * _BLOCKS or self._unsteadiness <= MAX_RATE_DIFFERENCE:
            return []
        usual = np.zeros(_BLOCKS)
        for k, block in enumerate(np.array_split(intervals, _BLOCKS)):
            typical = np.median(block)
            # Rounding makes an interval longer or shorter by a step.
            usual[k] = np.mean(block[abs(block - typical) <= max(0.5 * typical, 1.5 * self.step)])
        edges = np.linspace(0, len(intervals), _BLOCKS + 1).astype(int)
        # A block within which the rate changes has an interval of its own.
        levels = np.flatnonzero(abs(np.diff(usual)) < MAX_RATE_DIFFERENCE * usual[:-1]).tolist()
        if len(levels) < _BLOCKS - 1 - 2 * _PIECES:
            return []
        runs: list[list[int]] = []
        for k in levels:
            level = usual[runs[-1]].mean() if runs else np.inf
            if not abs(usual[k] / level - 1.0) < MAX_RATE_DIFFERENCE:
                runs.append([])
            runs[-1].append(k)
        if not 2 <= len(runs) <= _PIECES:
            return []
        found, first = [], 0
        for run, following in zip(runs, [*runs[1:], None], strict=True):
            own, end = float(usual[run].mean()), len(self.seconds)
            if following is not None:
                other = usual[following].mean()
                between = slice(edges[run[-1]], edges[following[0] + 1])
                is_other = abs(intervals[between] - other) < abs(intervals[between] - own)
                # The place where most intervals before it are of one rate, and most after it of the other.
                agree = np.cumsum(np.where(is_other, -1, 1))
                end = between.start + int(np.argmax(agree)) + 2
            found.append(Piece(first, end, 1.0 / own))
            first = end
        return found

    def _refuse_excluded(self) -> None:
        """Raise RecordingError if the stamps exclude that samples are evenly spaced."""
        forced = "; if the stamps are wrong, add force=True"
        pieces = self._pieces()
        if pieces:
            raise self.source.error(f"{self._of_pieces(pieces)}{forced}", "rate")
        if self._lost and not self.why_even:
            lack = f"the samples are not evenly spaced: {self._lack(self._lost)}"
            raise self.source.error(f"{lack}; omit time='uniform'{forced}", "gaps")

    def _lack(self, lost: int) -> str:
        """Return that samples are missing, in words."""
        every = lost + len(self.seconds)
        interval = float(self.seconds[-1] - self.seconds[0]) / (every - 1)
        return (
            f"intervals are whole multiples of {_short(interval, 3)}, so that {lost:,} of {every:,} samples "
            f"({percent(lost / every)}) are missing"
        )

    def _missing(self, lost: int) -> str:
        """Return that samples are missing, and what to do, in words."""
        text, share = f"column {self.label!r}: {self._lack(lost)}", lost / (lost + len(self.seconds))
        segment = "read the longest part without gaps, with gaps='segments'"
        fill = "fill them in with gaps='fill'"
        if share > MOST_MISSING:
            return f"{text}; at most {percent(MOST_MISSING)} can be filled in: {segment}"
        return f"{text}; {segment}, or {fill}" if self._has_long_gap else f"{text}; {fill}, or {segment}"

    @cached_property
    def _has_long_gap(self) -> bool:
        """Whether a single gap is a noticeable part of the record."""
        return bool(self._intervals.max() > _LONG * (self.seconds[-1] - self.seconds[0]))

    def _of_pieces(self, pieces: list[Piece]) -> str:
        """Return the rates of pieces, and how to read the longest, in words."""
        times = self.seconds
        told = []
        for piece in pieces:
            until = "" if piece.end == len(times) else f" until {plain(times[piece.end - 1], 6)} s"
            told.append(f"{piece.rate:.4g} Hz{until}")
        longest = max(pieces, key=lambda piece: times[piece.end - 1] - times[piece.first])
        return (
            f"column {self.label!r} has {', then '.join(told)}, but a recording has one rate; read a part, "
            f"the longest with {self._part(longest.first, longest.end)}"
        )

    def _part(self, first: int, end: int) -> str:
        """Return the options that read only these samples."""
        options = [_start(self.seconds[first])] if first else []
        if end < len(self.seconds):
            options.append(_stop(self.seconds[end - 1]))
        return " and ".join(options)

    def _irregular(self, long: Bool[np.ndarray, " n"], drawn: int, gaps: bool) -> str:
        """Return how irregular stamps are, and what to do, in words."""
        may_fill = not gaps and not self.more
        if self._lost and may_fill:
            return self._missing(self._lost)
        evenly = "" if self._lost else self._evenly()
        fill = "if samples are missing, fill them in with gaps='fill'; " if drawn and may_fill else ""
        return (
            f"column {self.label!r} is irregular: the mean interval is {np.mean(self._intervals):.6g} s, the "
            f"rms jitter {np.std(self._intervals):.3g} s, and {percent(float(np.mean(long)))} of the "
            f"intervals are gaps (longer than {_GAP} times the median); jitter up to {percent(_MAX_JITTER)} "
            f"is accepted; {evenly}{fill}{IGNORE}; do not resample, which smooths the noise"
        )

    @cached_property
    def _unsteadiness(self) -> float:
        """The relative difference of the mean intervals of both halves, beyond that by jitter."""
        times = self.seconds
        half, span = len(times) // 2, float(times[-1] - times[0])
        drift = abs(float(times[-1] - times[-1 - half]) - float(times[half] - times[0]))
        beyond = max(drift - 4.0 * float(np.std(self._intervals)), 0.0)
        return beyond / (0.5 * span) if span > 0.0 else np.inf

    def _evenly(self) -> str:
        """Return the remedy for evenly spaced samples with uneven stamps; "" if these may show others."""
        if self._beats or self._unsteadiness > MAX_RATE_DIFFERENCE or not _interval(self.seconds) > 0.0:
            return ""
        rate = f"{1.0 / _interval(self.seconds):.6g} Hz"
        return f"if the samples are evenly spaced (at {rate} on average), pass time='uniform'; "

    def _backwards(self) -> str:
        """Return a message on stamps that repeat or go back, and what can be read instead."""
        times, intervals = self.seconds, self._intervals
        uniform, back = self._evenly(), np.flatnonzero(intervals < 0.0)
        first = int(back[0] if back.size else np.argmax(intervals == 0.0)) + 1
        what, why = "repeats the previous time", "the stamps are too coarse"
        segments = ""
        if back.size:
            what = f"goes back by {-intervals[first - 1]:.6g} s"
            why = "late stamps" if uniform else "the clock was set, or packets are out of order"
            longest = max(np.split(times, np.flatnonzero(after_gaps(times))), key=len)
            with suppress(RecordingError):
                check_length(0 if self.more else len(longest), self.source)
                Stamps(longest, self.step, self.label, self.source).grid(
                    None, gaps=False, uniform=False, force=False
                )
                segments = (
                    f"read the longest part without such a step ({len(longest):,} samples) with "
                    "gaps='segments'; "
                )
                if len(back) < _SET * len(times):
                    # A clock that was set a few times is otherwise right.
                    why, uniform = "the clock was set", ""
        return (
            f"column {self.label!r} {what} at {self.source.locate(first)} ({np.sum(intervals <= 0.0)} in "
            f"total: {why}); {uniform}{segments}{IGNORE}"
        )

    def _gap(self, gaps: Int[np.ndarray, " gaps"], drawn: int) -> str:
        """Return a message on gaps after these samples, and what to read instead.

        `drawn` is how many missing samples can be filled in.
        """
        times, first = self.seconds, int(gaps[0])
        gap = self._intervals[first]
        text = (
            f"column {self.label!r} has a gap of {gap:.6g} s ({gap / self._typical:.3g} intervals) before "
            f"{self.source.locate(first + 1)}"
        )
        if self.more:
            stop, start = _stop(times[first]), _start(times[first + 1])
            return f"{text}; read the part before it with {stop} or after it with {start}"
        edges = np.concatenate([[0], gaps + 1, [len(times)]])
        k = int(np.argmax(np.diff(edges)))
        begin, end = edges[k : k + 2].tolist()
        remedies = []
        if end - begin > MIN_SAMPLES:
            remedies.append(
                f"read a part without gaps, the longest with {self._part(begin, end)} or gaps='segments'"
            )
        if drawn:
            fill = f"fill in the {drawn} missing of {drawn + len(times)} samples with gaps='fill'"
            # Of many gaps the longest part between is short.
            is_short = 2 * (end - begin) < len(times) and not self._has_long_gap
            remedies.insert(0 if is_short else 1, fill)
        count = "the only gap" if len(gaps) == 1 else f"the first of {len(gaps)} gaps"
        return f"{text}, {count}; {', or '.join(remedies) or 'too few samples remain for a recording'}"


def after_gaps(times: Seconds) -> Chosen:
    """Return which samples follow a gap in the times, or follow the clock being set back."""
    return np.concatenate([[False], gaps_in(times) | (np.diff(times) < 0.0)])


def regular_intervals(times: Seconds) -> Float[np.ndarray, " intervals"]:
    """Return the intervals between successive times that are not gaps."""
    intervals = np.diff(times)
    return intervals[~gaps_in(times)] if intervals.size else intervals


def format_jitter(jitter: float) -> str:
    """Return a jitter [s] as text; below a nanosecond it is due to rounding of the stamps."""
    return f"{plain(jitter * 1e6, 3)} µs rms" if jitter >= 1e-9 else "below 1 ns"


def gaps_in(times: Seconds) -> Bool[np.ndarray, " intervals"]:
    """Return which of the intervals are gaps."""
    intervals = np.diff(times)
    typical = np.median(intervals)
    gaps = intervals > _GAP * typical
    if typical <= 0.0:
        return gaps
    rows = np.flatnonzero(gaps)[:, None]
    # Delay of each nearby stamp, in intervals, against what the stamp before the interval implies.
    about = np.clip(rows + np.arange(-_ABOUT, _ABOUT) + 1, 0, len(intervals))
    delays = (times[about] - times[rows]) / typical - (about - rows)
    gaps[rows[:, 0]] = np.median(delays[:, _ABOUT:], axis=1) - np.median(delays[:, :_ABOUT], axis=1) > 0.5
    return gaps


def _short(time: float, digits: int = 2) -> str:
    """Return a short time with its unit, e.g. "5 ms"."""
    for unit, size in (("s", 1.0), ("ms", 1e-3), ("µs", 1e-6)):
        if time >= size:
            return f"{plain(time / size, digits)} {unit}"
    return f"{plain(time / 1e-9, digits)} ns"


def _start(time: float) -> str:
    """Return the option to start at a time, rounded up to ms to avoid a gap before it."""
    return f"start={np.ceil(time * 1e3 - 1e-7) / 1e3 + 0.0:.3f}"


def _stop(time: float) -> str:
    """Return the option to stop before a time, rounded down to ms to avoid a gap after it."""
    return f"stop={np.floor(time * 1e3 + 1e-7) / 1e3:.3f}"


def _lost_from(places: Places) -> int:
    """Return how many places no sample has."""
    return int(places[-1]) + 1 - len(places)


def _interval(times: Seconds, places: Places | None = None) -> float:
    """Return the interval [s] of the straight line through stamps; by default, all samples are there."""
    number = np.arange(len(times)) if places is None else places
    number = number - number.mean()
    return float(number @ times / (number @ number))

"""Record: the rows of a table that are samples, at their times, without those that are none."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Int

from allanjax.base.errors import MixedRatesError
from allanjax.base.wording import counted
from allanjax.record.columns import Column, axes_by_sensor, with_unit
from allanjax.record.completion import Gap, Segments, on_grid, segments_of, without_repeats
from allanjax.record.io.absent import without_samples
from allanjax.record.io.grid import Stamps
from allanjax.record.io.layout import Layout
from allanjax.record.io.options import ReadOptions
from allanjax.record.io.table import Columns, Table, as_float, is_numeric
from allanjax.record.io.times import MAX_RATE_DIFFERENCE, Clock, sorted_by
from allanjax.record.shapes import Channel, Chosen, Seconds, Values, Which
from allanjax.record.validation import MIN_SAMPLES, Source, check_length, check_rate

# Least and largest share of the rows of a table in which a sensor was sampled that shares it with others.
_LEAST_FRESH, _MOST_FRESH = 0.02, 0.92
# This share of its intervals (of all rows if two sensors alternate) is even, to this part of the interval.
_REGULAR, _SAME = 0.95, 0.45


class Rows(NamedTuple):
    """Some rows of a table, as numbers.

    Attributes:
        values: samples in the units of the table.
        auxiliary: other columns by name.
        seconds: times [s] from the first row of the table.
        source: origin of the rows.
        absent: where a sensor has no sample, with values of nan.
    """

    values: Values
    auxiliary: Mapping[str, Channel]
    seconds: Seconds
    source: Source
    absent: Which

    def taken(self, rows: slice | Chosen) -> "Rows":
        """Return some of the rows; RecordingError if they are too few for a recording."""
        auxiliary = {name: column[rows] for name, column in self.auxiliary.items()}
        source = self.source.after(rows.start) if isinstance(rows, slice) else self.source.at(rows)
        values = self.values[rows]
        check_length(len(values), source)
        return Rows(values, auxiliary, self.seconds[rows], source, self.absent[rows])

    @property
    def interval(self) -> float:
        """Mean interval of the times [s]."""
        return float(self.seconds[-1] - self.seconds[0]) / (len(self.seconds) - 1)


@dataclass(frozen=True)
class Record:
    """Samples of a table on an even grid.

    Attributes:
        rows: samples, nan where one is missing, and auxiliary columns.
        lost: which samples are missing and to be filled in given the others.
        rate: sample rate [Hz].
        others: other segments of the record, separated by missing samples.
        places: number of the first sample of each of these, counted from that of `rows`.
        gaps: where samples are missing between segments; None if that is unknown without time stamps.
        jitter: rms jitter of the time stamps [s]; None without time stamps.
        begun: UNIX time of the first sample [s], if the stamps tell it.
        notes: assumptions and findings that users should know.
    """

    rows: Rows
    lost: Which
    rate: float
    others: tuple[Rows, ...]
    places: tuple[int, ...]
    gaps: tuple[Gap, ...] | None
    jitter: float | None
    begun: float | None
    notes: tuple[str, ...]

    @classmethod
    def of(cls, table: Table, layout: Layout, columns: Columns, options: ReadOptions) -> "Record":
        """Return the samples in the columns of a table.

        Raises:
            RecordingError: values or times that are no numbers, too few samples, or times that are not even.
        """
        rate, rate_notes = stated_rate(table, layout, options.rate)
        columns = _to_the_end(layout, columns)
        times = Times.of(table, layout, columns, rate, options)
        order = None if options.uniform else sorted_by(times.seconds)
        if order is not None:
            columns, times = tuple(column[order] for column in columns), times.sorted(order)
            table = replace(table, source=table.source.at(order))
        part, part_notes = _part(table, layout, columns, times.seconds, options)
        notes = [*rate_notes, *times.notes, *part_notes]
        part, absent_notes = _without_absent(part, layout)
        notes += absent_notes
        if layout.clock:
            part, own_notes = _own(part, layout, options)
            notes += own_notes
        stamps = times.of_rows(part)
        even = stamps is None or options.uniform or bool(options.allows_gaps and stamps.why_even)
        others: tuple[Rows, ...] = ()
        gaps: tuple[Gap, ...] | None = None if stamps is None or options.uniform else ()
        if options.gaps == "segments":
            longest, segments = _segments(part, None if even else stamps)
            others = tuple(map(part.taken, segments.others))
            gaps = segments.gaps(part.seconds, 1.0 / longest.interval) or gaps
            notes += segments.notes(len(part.values))
            part, stamps = longest, times.of_rows(longest)
        jitter = None
        if stamps is not None:
            grid = stamps.grid(
                options.rate,
                gaps=options.allows_gaps and not even,
                uniform=options.uniform,
                force=options.force,
            )
            values, auxiliary = on_grid(part.values, part.auxiliary, grid.places)
            part = part._replace(values=values, auxiliary=auxiliary)
            rate, jitter = grid.rate, grid.jitter
            notes.append(grid.note)
        assert rate is not None
        begun = None if times.begun is None else times.begun + float(part.seconds[0])
        lost = np.isnan(part.values) if options.gaps == "fill" else part.absent
        places = [round(float(other.seconds[0] - part.seconds[0]) * rate) for other in others]
        return cls(part, lost, rate, others, tuple(places), gaps, jitter, begun, tuple(notes))


class Times(NamedTuple):
    """Times of all rows of a table.

    Attributes:
        seconds: times [s] from the first row.
        clock: the clock that tells them; None if they follow from the rate.
        step: resolution of the stamps [s].
        begun: UNIX time of the first row [s], if it is known.
        notes: assumptions that users should know.
    """

    seconds: Seconds
    clock: Clock | None
    step: float
    begun: float | None
    notes: tuple[str, ...]

    @classmethod
    def of(
        cls, table: Table, layout: Layout, columns: Columns, rate: float | None, options: ReadOptions
    ) -> "Times":
        """Return the times of the rows in these columns of a table."""
        if not layout.clock:
            assert rate is not None
            return cls(np.arange(len(columns[0])) / rate, None, 0.0, None, ())
        stamps = layout.stamps(columns)
        clock = Clock.of(layout.clock, stamps, options.time_unit, rate, table.source)
        seconds, notes = clock.seconds(stamps, table.source)
        return cls(seconds, clock, clock.step(stamps), clock.begun(stamps), (*clock.notes, *notes))

    def sorted(self, order: Int[np.ndarray, " n"]) -> "Times":
        """Return the times in this order."""
        seconds, moved = self.seconds[order], np.count_nonzero(order != np.arange(len(order)))
        note = f"{moved:,} rows that are out of order are sorted by their times"
        return self._replace(seconds=seconds - seconds[0], notes=(*self.notes, note))

    def of_rows(self, rows: Rows) -> Stamps | None:
        """Return the stamps of some rows; None without a clock."""
        if self.clock is None:
            return None
        return Stamps(rows.seconds, self.step, self.clock.label, rows.source)


def _part(
    table: Table, layout: Layout, columns: Columns, seconds: Seconds, options: ReadOptions
) -> tuple[Rows, list[str]]:
    """Return the rows from start to stop, as numbers, and notes."""
    rows = rows_of_times(seconds, options.start, options.stop)
    notes = [*notes_on_part(rows, len(seconds), float(seconds[-1]), table.source)]
    source = table.source.after(rows.start)
    # Each axis is contiguous in memory, since most of the work is axis by axis.
    axes = [as_float(columns[c.index][rows], c.label, source, options.allows_gaps) for c in layout.columns]
    auxiliary = {}
    for column in layout.auxiliary:
        numbers, note = _auxiliary(column, columns[column.index][rows], source)
        notes.append(note)
        if numbers is not None:
            auxiliary[column.name] = numbers
    values = np.array(axes).T
    return Rows(values, auxiliary, seconds[rows], source, np.zeros(values.shape, bool)), notes


def _without_absent(part: Rows, layout: Layout) -> tuple[Rows, tuple[str, ...]]:
    """Return rows with nan where a sensor has no sample, without such rows at the ends, and notes."""
    found = without_samples(part.values, layout.columns)
    if not found.at.any():
        return part._replace(values=found.values), found.notes
    values = np.where(found.at, np.nan, found.values)
    part = part._replace(values=values, absent=found.at).taken(found.ends)
    cut = len(values) - len(part.values)
    if not cut:
        return part, found.notes
    return part, (
        *found.notes,
        f"left out: {counted(cut, 'row')} at the ends without a sample of all sensors",
    )


def _auxiliary(column: Column, values: Channel, source: Source) -> tuple[Channel | None, str]:
    """Return an auxiliary column as floats, or None if it is text, and a note on it."""
    if not is_numeric(values):
        cell = str(values[0])[:40]
        return None, f"column {column.label!r} skipped as it is not numeric: {cell!r} at {source.locate(0)}"
    numbers = values.astype(float)
    label, missing = with_unit(column.name, column.unit), np.count_nonzero(~np.isfinite(numbers))
    return numbers, f"auxiliary: {label}{f' ({missing} values missing)' if missing else ''}"


def _own(part: Rows, layout: Layout, options: ReadOptions) -> tuple[Rows, list[str]]:
    """Return the rows in which sensors were sampled, each once, and notes on the others."""
    notes = []
    kept = np.ones(len(part.values), bool)
    if not options.uniform:
        kept = without_repeats(part.values, part.seconds)
    if not kept.all():
        notes.append(f"left out: {counted(int(np.count_nonzero(~kept)), 'packet')} recorded twice")
    own = own_rows(part.taken(kept), layout.columns)
    if not own.all():
        left = counted(int(np.count_nonzero(~own)), "row")
        notes.append(f"left out: {left} that repeat the previous values, or have none")
    kept[kept] = own
    return part if kept.all() else part.taken(kept), notes


def own_rows(part: Rows, columns: Sequence[Column]) -> Chosen:
    """Return the rows of a table in which its sensors were sampled.

    If several sensors share a table, a row repeats the previous values of those that were not sampled then,
    leaves their cells empty, or marks them as absent.

    Raises:
        MixedRatesError: the sensors have different rates.
    """
    values, seconds = part.values, part.seconds
    fresh = {}
    for sensor, of_sensor in axes_by_sensor(columns).items():
        own = values[:, of_sensor]
        empty = np.isnan(own).all(axis=1)
        # The first row repeats none, but may be one of those that would.
        changed = np.concatenate([[empty.any()], (own[1:] != own[:-1]).any(axis=1)])
        fresh[sensor] = changed & ~empty & ~part.absent[:, of_sensor].all(axis=1)
    # A sensor that does not change is dead.
    living = [rows for rows in fresh.values() if rows.mean() > _LEAST_FRESH]
    in_turn = len(living) == 2 and np.mean(living[0] ^ living[1]) > _REGULAR
    for sensor, rows in fresh.items():
        if _LEAST_FRESH < rows.mean() < _MOST_FRESH:
            # A sensor with its own rate has nearly all intervals the same.
            intervals = np.diff(seconds[rows])
            typical = np.median(intervals)
            if in_turn or np.mean(abs(intervals - typical) < _SAME * typical) > _REGULAR:
                continue
        fresh[sensor] = np.ones(len(values), bool)
    one, other = (*fresh.values(), *fresh.values())[:2]
    if np.mean(one ^ other) <= 1.0 - _REGULAR:
        return one | other
    rates = {sensor: rows.sum() / max(seconds[-1] - seconds[0], 1e-9) for sensor, rows in fresh.items()}
    listed = " and ".join(f"{sensor} at {rate:.4g} Hz" for sensor, rate in rates.items())
    error = part.source.error(
        f"the sensors were sampled at different times, {listed} (other rows have none of their samples), but "
        "a recording has one rate; read one sensor with columns='gyro' or columns='accel'"
    )
    raise MixedRatesError(str(error), tuple(map(str, fresh)))


def _to_the_end(layout: Layout, columns: Columns) -> Columns:
    """Return columns up to the last row with a time or a sample; sensors beside these may have more."""
    if not layout.clock:
        return columns
    used = [columns[column.index] for column in (*layout.clock, *layout.columns)]
    if any(column[-1] == column[-1] for column in used if len(column)):
        return columns
    there = np.flatnonzero(np.any([column == column for column in used], axis=0))
    end = int(there[-1]) + 1 if there.size else len(columns[0])
    return tuple(column[:end] for column in columns)


def _segments(part: Rows, stamps: Stamps | None) -> tuple[Rows, Segments]:
    """Return the longest segment without missing samples; and all, of which others have the same rate.

    Without stamps, samples are even.
    """
    after = np.zeros(len(part.values), bool) if stamps is None else stamps.after_gaps
    segments = segments_of(part.values, after)
    longest = part.taken(segments.longest)
    alike = []
    for rows in segments.others:
        if abs(part.taken(rows).interval / longest.interval - 1.0) < MAX_RATE_DIFFERENCE:
            alike.append(rows)
    return longest, segments._replace(others=tuple(alike))


def notes_on_part(rows: slice, n: int, duration: float, source: Source) -> tuple[str, ...]:
    """Return a note on the rows that are read of n, if these are not all.

    Raises:
        RecordingError: none or too few of the n rows, which last `duration` [s].
    """
    if rows.start == rows.stop:
        raise source.error(
            f"start= and stop= leave no sample of its {duration:.6g} s; pass start= and stop= within it"
        )
    check_length(rows.stop - rows.start, source, n >= MIN_SAMPLES)
    if rows == slice(0, n):
        return ()
    return (f"samples {rows.start:,} to {rows.stop - 1:,} of {n:,} read",)


def stated_rate(table: Table, layout: Layout, given: float | None) -> tuple[float | None, tuple[str, ...]]:
    """Return the given sample rate [Hz], with a note if the file states another; else that of the file.

    Raises:
        RecordingError: there is neither a rate nor a clock.
    """
    found = table.rate if given is None else given
    if found is None and not layout.clock:
        others = ", ".join(column.label for column in layout.auxiliary)
        stamps = f"if one of {others} has time stamps, name it with time=, or " if others else ""
        raise table.source.error(f"no sample rate; pass rate= in Hz; {stamps}add a column `time [s]`")
    rate = None if found is None else check_rate(found, table.source)
    if rate is None or table.rate is None or abs(table.rate / rate - 1.0) <= MAX_RATE_DIFFERENCE:
        return rate, ()
    return rate, (f"sample rate {rate:g} Hz as given, although the file states {table.rate:g} Hz",)


def rows_of_times(seconds: Seconds, start: float | None, stop: float | None) -> slice:
    """Return the rows from the first time at or after `start` up to the first at or after `stop`, in s."""
    # Tolerance of half a nanosecond for the rounding of stamps.
    first = 0 if start is None else _first_at(seconds, start - 5e-10)
    last = len(seconds) if stop is None else _first_at(seconds, stop - 5e-10)
    return slice(first, max(first, last))


def _first_at(seconds: Seconds, moment: float) -> int:
    """Return the index of the first time at or after a moment."""
    late = seconds >= moment
    return int(np.argmax(late)) if late.any() else len(seconds)

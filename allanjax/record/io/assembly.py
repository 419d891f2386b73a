"""Assembly of a recording from the columns of a file."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from allanjax.base.errors import RecordingError
from allanjax.record.columns import Column
from allanjax.record.gaps import Gap, on_grid, rows_between, stretches_of, without_repeats
from allanjax.record.io.layout import find_layout
from allanjax.record.io.options import ReadOptions
from allanjax.record.io.table import Table, as_float, is_numeric
from allanjax.record.io.timestamps import MAX_RATE_DIFFERENCE, after_gaps, rate_from_times, seconds_from_first
from allanjax.record.recording import Recording, build
from allanjax.record.validation import Source, check_length, check_rate


def assemble(table: Table, name: str, options: ReadOptions) -> Recording:
    """Make a recording from a table, or say by a RecordingError or UnitError what is missing or wrong."""
    source, columns = table.source, table.columns()
    layout = find_layout(table, columns, options)
    notes = [*table.notes, *layout.notes]
    rate = stated_rate(table, options.rate)
    jitter: float | None = None
    samples = len(columns[0])
    check_length(samples, source)
    times: np.ndarray | None = None
    if layout.time:
        stamps = [(column, columns[column.index]) for column in layout.time]
        times, _, time_notes = seconds_from_first(stamps, options.time_unit, rate, source)
        notes += time_notes
        rows = rows_of_times(times, options.start, options.stop)
        check_stretch(rows, float(times[-1]), source)
    else:
        if rate is None:
            raise no_rate_error(source)
        rows = rows_between(samples, rate, options.start, options.stop)
        check_stretch(rows, samples / rate, source)
    source = source.after(rows.start)
    check_length(rows.stop - rows.start, source)
    if rows != slice(0, samples):
        notes.append(f"samples {rows.start} to {rows.stop - 1} of {samples} taken")
    gaps = options.allows_gaps
    values = np.column_stack([as_float(columns[c.index][rows], c.label, source, gaps) for c in layout.axes])
    auxiliary = {}
    for column in layout.auxiliary:
        numbers, note = _auxiliary(column, columns[column.index][rows], source)
        notes.append(note)
        if numbers is not None:
            auxiliary[column.name] = numbers
    stretch = _Stretch(values, auxiliary, None if times is None else times[rows])
    others: tuple[_Stretch, ...] = ()
    missing = () if layout.time else None
    if gaps:
        stretch, others, source, more, missing = _with_gaps(stretch, rate, options, source)
        notes += more
    if stretch.times is not None:
        found = rate_from_times(stretch.times, layout.time_label, rate, source, gaps=gaps)
        rate, jitter = found.rate, found.jitter
        notes.append(found.note)
        if gaps:
            stretch = _Stretch(*on_grid(stretch.values, stretch.auxiliary, found.places), None)
    if rate is None:
        raise no_rate_error(source)
    units = table.units_with(options)
    fill = options.gaps == "fill"
    of_stretch = (stretch.values, rate, layout.axes, units, stretch.auxiliary, name, notes, source, jitter)
    return build(*of_stretch, fill, [other.values for other in others], missing)


class _Stretch(NamedTuple):
    """Samples of a stretch in the file's units, auxiliary channels, and times [s] if there are any."""

    values: Float[np.ndarray, "samples axes"]
    auxiliary: Mapping[str, Float[np.ndarray, " samples"]]
    times: Float[np.ndarray, " samples"] | None

    @property
    def interval(self) -> float:
        """Mean interval of its stamps; 1 without any."""
        return 1.0 if self.times is None else float(self.times[-1] - self.times[0]) / (len(self.times) - 1)

    def taken(self, rows: slice | Bool[np.ndarray, " samples"]) -> "_Stretch":
        """These rows of it."""
        auxiliary = {name: column[rows] for name, column in self.auxiliary.items()}
        return _Stretch(self.values[rows], auxiliary, None if self.times is None else self.times[rows])


def _with_gaps(
    stretch: _Stretch, rate: float | None, options: ReadOptions, source: Source
) -> tuple[_Stretch, tuple[_Stretch, ...], Source, tuple[str, ...], tuple[Gap, ...] | None]:
    """Stretch without packets recorded twice, of "segments" the longest without gaps, others, notes, gaps."""
    notes: tuple[str, ...] = ()
    if stretch.times is not None:
        kept = without_repeats(stretch.values, stretch.times)
        if not kept.all():
            notes += (f"{np.count_nonzero(~kept)} packets recorded twice left out",)
            stretch = stretch.taken(kept)
    if options.gaps == "fill":
        return stretch, (), source, notes, None if stretch.times is None else ()
    n, times = len(stretch.values), stretch.times
    found = stretches_of(stretch.values, np.zeros(n, bool) if times is None else after_gaps(times))
    source = source.after(found.longest.start)
    check_length(found.longest.stop - found.longest.start, source)
    longest = stretch.taken(found.longest)

    def is_alike(rows: slice) -> bool:
        return abs(stretch.taken(rows).interval / longest.interval - 1.0) < MAX_RATE_DIFFERENCE

    found = found._replace(others=tuple(filter(is_alike, found.others)))
    at = times if times is not None else np.arange(n) / (rate or 1.0)
    missing = found.gaps(at, 1.0 / longest.interval if times is not None else rate or 1.0)
    others = tuple(map(stretch.taken, found.others))
    seen = missing if missing or times is not None else None
    return longest, others, source, (*notes, *found.told(n)), seen


def no_rate_error(source: Source) -> RecordingError:
    """RecordingError for samples without a rate, neither given nor in time stamps."""
    return source.error(
        "no sample rate: pass rate= in Hz (--rate), or name a column of time stamps by time= (--time) "
        "or in the header, e.g. `time [s]`"
    )


def check_stretch(rows: slice, duration: float, source: Source) -> None:
    """Raise `RecordingError` if no row is left of a recording that lasts `duration` [s]."""
    if rows.start == rows.stop:
        raise source.error(
            f"nothing is left of its {duration:.6g} s; give a time within them by start= or stop= "
            "(--start, --stop)"
        )


def stated_rate(table: Table, given: float | None) -> float | None:
    """Sample rate [Hz] that is given or that the file states; if both, they must agree."""
    if given is None:
        return None if table.rate is None else check_rate(table.rate, table.source)
    rate = check_rate(given, table.source)
    if table.rate is not None and abs(table.rate / rate - 1.0) > MAX_RATE_DIFFERENCE:
        raise table.source.error(
            f"rate {rate:g} Hz contradicts the file, which states {table.rate:g} Hz; leave out rate= "
            "(--rate) or correct the file"
        )
    return rate


def rows_of_times(times: np.ndarray, start: float | None, stop: float | None) -> slice:
    """Rows from the first time at or after `start` up to the first at or after `stop`, in s."""
    # Tolerance of half a nanosecond for the rounding of stamps.
    first = 0 if start is None else _first_at(times, start - 5e-10)
    last = len(times) if stop is None else _first_at(times, stop - 5e-10)
    return slice(first, max(first, last))


def _first_at(times: np.ndarray, moment: float) -> int:
    """Index of the first time at or after a moment."""
    late = times >= moment
    return int(np.argmax(late)) if late.any() else len(times)


def _auxiliary(column: Column, values: np.ndarray, source: Source) -> tuple[np.ndarray | None, str]:
    """Auxiliary column as floats, or None if it is text, and a note on it."""
    if not is_numeric(values):
        cell = str(values[0])[:40]
        return None, f"column {column.label!r} skipped: not numeric, {cell!r} at {source.locate(0)}"
    numbers = values.astype(float)
    unit = f" [{column.unit}]" if column.unit else ""
    missing = np.count_nonzero(~np.isfinite(numbers))
    return numbers, f"auxiliary: {column.name}{unit}{f' ({missing} values missing)' if missing else ''}"

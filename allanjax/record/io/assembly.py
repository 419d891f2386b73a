"""Assembly of a recording from the columns of a file."""

import numpy as np

from allanjax.base.errors import RecordingError
from allanjax.record.columns import Column
from allanjax.record.io.layout import find_layout
from allanjax.record.io.options import ReadOptions
from allanjax.record.io.table import Table, as_float, is_numeric
from allanjax.record.io.timestamps import (
    MAX_RATE_DIFFERENCE,
    gap_in_record,
    rate_from_times,
    seconds_from_first,
)
from allanjax.record.recording import Recording, build, rows_between
from allanjax.record.validation import Source, check_length, check_rate


def assemble(table: Table, name: str, options: ReadOptions) -> Recording:
    """Make a recording from a table.

    Raises:
        RecordingError, UnitError: the table or the arguments are not usable.
    """
    source = table.source
    layout = find_layout(table, options)
    notes = [*table.notes, *layout.notes]
    rate = stated_rate(table, options.rate)
    samples = len(table.columns[0])
    check_length(samples, source)
    if layout.time:
        stamps = [(column, table.columns[i]) for i, column in layout.time]
        times, _, time_notes = seconds_from_first(stamps, options.time_unit, rate, source)
        notes += time_notes
        rows = rows_of_times(times, options.start, options.stop)
        check_stretch(rows, float(times[-1]), source)
        source = source.after(rows.start)
        check_length(rows.stop - rows.start, source)
        label = " + ".join(column.label for column, _ in stamps)
        rate, note = rate_from_times(times[rows], label, rate, source, gap_in_record)
        notes.append(note)
    elif rate is None:
        raise no_rate_error(source)
    else:
        rows = rows_between(samples, rate, options.start, options.stop)
        check_stretch(rows, samples / rate, source)
        source = source.after(rows.start)
    if rows != slice(0, samples):
        notes.append(f"samples {rows.start} to {rows.stop - 1} of {samples} taken")
    values = np.column_stack(
        [as_float(table.columns[i][rows], column.label, source) for i, column in layout.axes]
    )
    auxiliary = {}
    for i, column in layout.auxiliary:
        numbers = _auxiliary(column, table.columns[i][rows], source, notes)
        if numbers is not None:
            auxiliary[column.name] = numbers
    return build(
        values,
        rate,
        [column for _, column in layout.axes],
        options.gyro_unit,
        options.accel_unit,
        auxiliary,
        name,
        notes,
        source,
    )


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


def stated_rate(table: Table, rate: float | None) -> float | None:
    """Sample rate [Hz] that is given or that the file states; if both, they must agree."""
    if rate is None:
        return None if table.rate is None else check_rate(table.rate, table.source)
    if (
        table.rate is not None
        and abs(table.rate / check_rate(rate, table.source) - 1.0) > MAX_RATE_DIFFERENCE
    ):
        raise table.source.error(
            f"rate {rate:g} Hz contradicts the file, which states {table.rate:g} Hz; leave out rate= "
            "(--rate) "
            "or correct the file"
        )
    return check_rate(rate, table.source)


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


def _auxiliary(column: Column, values: np.ndarray, source: Source, notes: list[str]) -> np.ndarray | None:
    """Auxiliary column as floats, or None with a note if it is text."""
    unit = f" [{column.unit}]" if column.unit else ""
    if not is_numeric(values):
        notes.append(
            f"column {column.label!r} skipped: not numeric, {str(values[0])[:40]!r} at {source.locate(0)}"
        )
        return None
    numbers = values.astype(float)
    missing = int(np.count_nonzero(~np.isfinite(numbers)))
    lacking = f" ({missing} values missing)" if missing else ""
    notes.append(f"auxiliary: {column.name}{unit}{lacking}")
    return numbers

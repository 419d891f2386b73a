"""Assembly of a recording from the columns of a file."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from allanjax.base.errors import RecordingError
from allanjax.record.columns import Column
from allanjax.record.gaps import Gap, on_grid, stretches_of, without_repeats
from allanjax.record.io.layout import Layout, find_layout
from allanjax.record.io.options import ReadOptions
from allanjax.record.io.table import Columns, Table, as_float, is_numeric
from allanjax.record.io.timestamps import (
    MAX_RATE_DIFFERENCE,
    after_gaps,
    rate_from_times,
    seconds_from_first,
    uniform_rate,
)
from allanjax.record.recording import Recording, build
from allanjax.record.validation import Source, check_length, check_rate

# Shares of rows: at least and at most so many are samples of a sensor that shares a table, and of these (of
# all rows, if two take turns) so many are at even intervals, to this part of the interval.
_LEAST_FRESH, _MOST_FRESH, _REGULAR, _ALIKE = 0.02, 0.92, 0.95, 0.45


def assemble(table: Table, name: str, options: ReadOptions) -> Recording:
    """Make a recording from a table, or say by a RecordingError or UnitError what is missing or wrong."""
    columns, notes = table.columns(), [*table.notes]
    check_length(len(columns[0]), table.source)
    layout = find_layout(table, columns, options, notes)
    rate = stated_rate(table, options.rate, notes)
    stretch, source = _read(columns, layout, rate, options, table.source, notes)
    jitter: float | None = None
    if layout.time and options.uniform:
        found = uniform_rate(stretch.times, layout.time_label, options.rate, source)
        rate, jitter = found.rate, found.jitter
        notes.append(found.note)
        stretch = stretch._replace(times=np.arange(len(stretch.times)) / rate)
    stamped = bool(layout.time) and not options.uniform
    others: tuple[_Stretch, ...] = ()
    missing: tuple[Gap, ...] | None = () if stamped else None
    if options.gaps == "segments":
        stretch, others, source, missing = _segments(stretch, source, notes)
        missing = missing if missing or stamped else None
    if stamped:
        gaps = options.allows_gaps
        found = rate_from_times(stretch.times, layout.time_label, options.rate, source, gaps=gaps)
        rate, jitter = found.rate, found.jitter
        notes.append(found.note)
        if gaps:
            values, auxiliary = on_grid(stretch.values, stretch.auxiliary, found.places)
            stretch = stretch._replace(values=values, auxiliary=auxiliary)
    if rate is None:
        raise no_rate_error(source)
    units, fill = table.units_with(options), options.gaps == "fill"
    of_stretch = (stretch.values, rate, layout.axes, units, stretch.auxiliary, name, notes, source, jitter)
    return build(*of_stretch, fill, [other.values for other in others], missing)


class _Stretch(NamedTuple):
    """Samples of a stretch in the file's units, auxiliary channels, and times [s]."""

    values: Float[np.ndarray, "samples axes"]
    auxiliary: Mapping[str, Float[np.ndarray, " samples"]]
    times: Float[np.ndarray, " samples"]

    @property
    def interval(self) -> float:
        """Mean interval of its times [s]."""
        return float(self.times[-1] - self.times[0]) / (len(self.times) - 1)

    def taken(self, rows: slice | Bool[np.ndarray, " samples"]) -> "_Stretch":
        """These rows of it."""
        auxiliary = {name: column[rows] for name, column in self.auxiliary.items()}
        return _Stretch(self.values[rows], auxiliary, self.times[rows])


def _read(
    columns: Columns,
    layout: Layout,
    rate: float | None,
    options: ReadOptions,
    source: Source,
    notes: list[str],
) -> tuple[_Stretch, Source]:
    """Rows from the start to the stop, without those that repeat others, and their place."""
    samples = len(columns[0])
    if layout.time:
        stamps = [(column, columns[column.index]) for column in layout.time]
        times, _, time_notes = seconds_from_first(stamps, options.time_unit, rate, source)
        notes += time_notes
    elif rate is None:
        raise no_rate_error(source)
    else:
        times = np.arange(samples) / rate
    rows = rows_of_times(times, options.start, options.stop)
    check_stretch(rows, float(times[-1]), source)
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
    stretch = _Stretch(values, auxiliary, times[rows])
    if not layout.time:
        return stretch, source
    kept = np.ones(len(values), bool) if options.uniform else without_repeats(values, stretch.times)
    if not kept.all():
        notes.append(f"{np.count_nonzero(~kept)} packets recorded twice left out")
    own = own_rows(values[kept], stretch.times[kept], layout.axes, source)
    if not own.all():
        notes.append(f"{np.count_nonzero(~own)} rows left out, which repeat the last values")
    kept[kept] = own
    stretch, source = stretch.taken(kept), source.at(kept)
    check_length(len(stretch.values), source)
    return stretch, source


def own_rows(
    values: Float[np.ndarray, "samples axes"],
    times: Float[np.ndarray, " samples"],
    axes: Sequence[Column],
    source: Source,
) -> Bool[np.ndarray, " samples"]:
    """Rows of a table in which its sensors were sampled.

    Where several sensors share a table, a row repeats the last values of those that were not sampled then.

    Raises:
        RecordingError: gyros and accelerometers were sampled at different times.
    """
    fresh = {}
    for sensor in dict.fromkeys(column.sensor for column in axes):
        own = values[:, [column.sensor == sensor for column in axes]]
        fresh[sensor] = np.concatenate([[False], (own[1:] != own[:-1]).any(axis=1)])
    # One that does not change is dead.
    living = [rows for rows in fresh.values() if rows.mean() > _LEAST_FRESH]
    in_turn = len(living) == 2 and np.mean(living[0] ^ living[1]) > _REGULAR
    for sensor, rows in fresh.items():
        held = _LEAST_FRESH < rows.mean() < _MOST_FRESH
        if not held or not (in_turn or _is_regular(times[rows])):
            fresh[sensor] = np.ones(len(values), bool)
    one, other = (*fresh.values(), *fresh.values())[:2]
    if np.mean(one ^ other) <= 1.0 - _REGULAR:
        return one | other
    rates = {sensor: rows.sum() / max(times[-1] - times[0], 1e-9) for sensor, rows in fresh.items()}
    listed = " and ".join(f"{sensor} at {rate:.4g} Hz" for sensor, rate in rates.items())
    raise source.error(
        f"its sensors were sampled at different times, {listed} (other rows repeat their last values), and a "
        "recording has one rate: read one of them by columns='gyro' or columns='accel' (--columns gyro, "
        "--columns accel)"
    )


def _is_regular(times: Float[np.ndarray, " samples"]) -> bool:
    """Whether nearly all intervals are alike, as those of a sensor with a rate of its own."""
    intervals = np.diff(times)
    typical = np.median(intervals)
    return bool(np.mean(abs(intervals - typical) < _ALIKE * typical) > _REGULAR)


def _segments(
    stretch: _Stretch, source: Source, notes: list[str]
) -> tuple[_Stretch, tuple[_Stretch, ...], Source, tuple[Gap, ...]]:
    """The longest stretch without gaps, others, its place, and the gaps."""
    found = stretches_of(stretch.values, after_gaps(stretch.times))
    source = source.after(found.longest.start)
    check_length(found.longest.stop - found.longest.start, source)
    longest = stretch.taken(found.longest)

    def is_alike(rows: slice) -> bool:
        return abs(stretch.taken(rows).interval / longest.interval - 1.0) < MAX_RATE_DIFFERENCE

    found = found._replace(others=tuple(filter(is_alike, found.others)))
    notes += found.told(len(stretch.values))
    others = tuple(map(stretch.taken, found.others))
    return longest, others, source, found.gaps(stretch.times, 1.0 / longest.interval)


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


def stated_rate(table: Table, given: float | None, notes: list[str]) -> float | None:
    """Sample rate [Hz] that is given, with a note if the file states another; else that of the file."""
    if given is None:
        return None if table.rate is None else check_rate(table.rate, table.source)
    rate = check_rate(given, table.source)
    if table.rate is not None and abs(table.rate / rate - 1.0) > MAX_RATE_DIFFERENCE:
        notes.append(f"sample rate {rate:g} Hz as given, although the file states {table.rate:g} Hz")
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

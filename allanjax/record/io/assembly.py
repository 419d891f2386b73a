"""Assembly of a recording from the columns of a file."""

import dataclasses
import difflib
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from allanjax.base.errors import MixedRatesError, RecordingError
from allanjax.record.columns import (
    Axis,
    Column,
    axes_of,
    by_unit,
    default_names,
    distinct,
    recognise,
    scales_of,
    split_unit,
)
from allanjax.record.completion import Gap, on_grid, rows_between, segments_of, without_repeats
from allanjax.record.io.formats import format_of, name_of
from allanjax.record.io.options import ReadOptions
from allanjax.record.io.table import Columns, Table, as_float, is_numeric
from allanjax.record.io.timestamps import (
    MAX_RATE_DIFFERENCE,
    Rate,
    after_gaps,
    check_rate_kept,
    rate_from_times,
    seconds_from_first,
    uniform_rate,
)
from allanjax.record.recording import Recording, build
from allanjax.record.units import SENSORS
from allanjax.record.validation import (
    Source,
    bad_cells,
    check_finite,
    check_length,
    check_rate,
    constant_error,
    usable,
)

# Entries in a list of columns that skip a column.
_SKIP = ("-", "_", "")


@dataclass(frozen=True)
class Layout:
    """Columns of a table by role; `time` has no column, one, or seconds and nanoseconds."""

    axes: tuple[Column, ...]
    time: tuple[Column, ...]
    auxiliary: tuple[Column, ...]

    @property
    def time_label(self) -> str:
        """Label of the time stamps."""
        return " + ".join(column.label for column in self.time)


def find_layout(table: Table, columns: Columns, options: ReadOptions, notes: list[str]) -> Layout:
    """Find the layout of a table from the user's columns, else from the labels, else from the given units.

    `columns` are its first rows, or all. Assumptions are added to the notes.
    """
    if options.columns is not None:
        found = _chosen(table, len(columns), options.columns)
    elif table.labels is not None:
        repeated = _repeated(table.labels)
        if repeated:
            raise table.source.error(
                f"the header names {', '.join(map(repr, repeated))} more than once; correct it, "
                "or name all columns with columns= (--columns)"
            )
        found = _recognised(table.labels)
    else:
        names = default_names(len(columns), options.units, "columns= (--columns)", table.source)
        found = _recognised(names)
        notes.append(f"the file has no header; columns assumed to be {', '.join(names)}")
    found = [
        replace(c, role="time") if c.role == "auxiliary" and columns[c.index].dtype.kind == "M" else c
        for c in found
    ]
    time = _chosen_time(table, found, columns, options, notes)
    sensors = {column.sensor for column in found if column.role == "axis"}
    named = [c if (axis := by_unit(c)).sensor in sensors else axis for c in found]
    axes = tuple(c for c in named if c.role == "axis" and c.index not in {column.index for column in time})
    clusters = next((c for c in found if c.role == "cluster time"), None)
    if clusters is not None and not time:
        raise table.source.error(
            f"column {clusters.label!r} has cluster times, so that this is an Allan curve and no recording; "
            "read it with read_curve, or give --curve to characterize and compare"
        )
    if not axes:
        raise table.source.error(
            f"no gyro or accelerometer column among {', '.join(column.label for column in found)}; "
            "name the columns with columns= (--columns), e.g. time,gyro_x,gyro_y,gyro_z"
        )
    axes = distinct(axes, table.source)
    for sensor in SENSORS:
        missing = {f"{sensor}_{axis}" for axis in "xyz"} - {axis.name for axis in axes}
        if len(missing) == 1:
            notes.append(f"no column for {missing.pop()}; the other two axes are read")
    renamed = [f"{c.name} from {c.label!r}" for c in axes if split_unit(c.label)[0] != c.name]
    if renamed:
        notes.append(f"axes: {', '.join(renamed)}")
    used = {column.index for column in (*axes, *time)}
    auxiliary = tuple(c for c in found if c.role not in ("axis", "time") and c.index not in used)
    return Layout(axes, time, auxiliary)


def _recognised(labels: Sequence[str]) -> list[Column]:
    """Return the columns recognised by their labels."""
    return [replace(recognise(label), index=i) for i, label in enumerate(labels)]


def _repeated(names: Sequence[str]) -> list[str]:
    """Return the names that occur more than once."""
    return sorted({name for name in names if names.count(name) > 1})


def _chosen(table: Table, count: int, columns: str | Sequence[str]) -> list[Column]:
    """Columns in the user's list: some names of the header, or names of all `count` by position."""
    entries = [entry.strip() for entry in (columns.split(",") if isinstance(columns, str) else columns)]
    names = [entry for entry in entries if entry not in _SKIP]
    if repeated := _repeated(names):
        raise table.source.error(f"columns= names {', '.join(repeated)} more than once; name each once")
    if table.labels is not None:
        matches = [_match(table, name, len(entries) == count) for name in names]
        if len(names) == len(entries) and all(matches):
            picked = {
                i: split_unit(name)[1] for name, match in zip(names, matches, strict=True) for i in match
            }
            # Time stamps are kept for the rate, and a stated unit has precedence.
            return [
                replace(c, unit=picked.get(c.index) or c.unit)
                for c in _recognised(table.labels)
                if c.index in picked or c.role in ("time", "counter")
            ]
        unknown = [name for name, match in zip(names, matches, strict=True) if not match]
        if len(entries) != count and unknown:
            near = difflib.get_close_matches(unknown[0], [split_unit(label)[0] for label in table.labels], 1)
            hint = f" (did you mean {near[0]}?)" if near else ""
            raise table.source.error(
                f"columns= (--columns) asks for {', '.join(unknown)}{hint}, but the file has "
                f"{', '.join(table.labels)}; choose from these, or give one name per column in order, with - "
                "to skip one"
            )
    if len(entries) != count:
        has = "no names" if table.labels is None else f"the names {', '.join(table.labels)}"
        raise table.source.error(
            f"columns= has {len(entries)} entries, but the file has {count} columns, with {has}; "
            "list names of the header, or one entry per column, with - to skip one"
        )
    found = [c for c in _recognised(entries) if entries[c.index] not in _SKIP]
    # Without a unit from the user, that of the header applies.
    units = [None] * count if table.labels is None else [split_unit(label)[1] for label in table.labels]
    return [replace(c, unit=c.unit or units[c.index]) for c in found]


def _match(table: Table, name: str, by_position: bool) -> tuple[int, ...]:
    """Return the indices of the columns whose label, label without unit, or recognised name is `name`.

    The name of a sensor matches all its axes. If columns may be named by position, an ambiguous name matches
    none.
    """
    labels = table.labels or ()
    columns = [recognise(label) for label in labels]
    stem = split_unit(name)[0]
    keys: list[tuple[str, Iterable[str]]] = [
        (name, (label.strip() for label in labels)),
        (stem, (split_unit(label)[0] for label in labels)),
        (stem, (column.name for column in columns)),
        (stem, (column.sensor or "" for column in columns)),
    ]
    for wanted, candidates in keys:
        found = tuple(i for i, key in enumerate(candidates) if key.casefold() == wanted.casefold())
        if len(found) > 1 and stem not in SENSORS:
            if by_position:
                return ()
            listed = ", ".join(repr(labels[i]) for i in found)
            raise table.source.error(f"columns= names {name!r}, which matches {listed}; use the full name")
        if found:
            return found
    return ()


def _chosen_time(
    table: Table, found: Sequence[Column], columns: Columns, options: ReadOptions, notes: list[str]
) -> tuple[Column, ...]:
    """Return the column of time stamps, or the pair of seconds and nanoseconds; empty if there is none."""
    time = options.time
    if time is False or (time is not None and time.casefold() == "none"):
        return ()
    if time is not None and not options.uniform:
        for key in ("label", "name"):
            named = [column for column in found if getattr(column, key).casefold() == time.casefold()]
            if len(named) == 1:
                return (named[0],)
        listed = ", ".join(column.label for column in found)
        raise table.source.error(
            f"no time column {time!r} among {listed}; correct time= (--time), or ignore the time stamps "
            "with time='none' (--time none)"
        )
    # An empty column is not one.
    candidates = [c for c in found if c.role == "time" and (columns[c.index] == columns[c.index]).any()]
    if not candidates and (options.rate or table.rate):
        # Without a rate, the unit of a counter is unknown.
        counters = [c for c in found if c.role == "counter" and columns[c.index].dtype.kind in "iu"]
        candidates = [c for c in counters if np.median(np.diff(columns[c.index].astype(float))) > 0.0][:1]
    parts = {column.time_part: column for column in candidates if column.time_part is not None}
    pairs = [
        (column, parts[prefix, "ns"])
        for (prefix, unit), column in parts.items()
        if unit == "s" and (prefix, "ns") in parts
    ]
    choices: list[tuple[Column, ...]] = [*((column,) for column in candidates), *pairs]
    if not choices:
        return ()
    # A pair is one clock; the stamp of a header is the time of sampling, others may be that of arrival.
    best = max(choices, key=lambda choice: (len(choice), "header" in choice[0].label.lower()))
    ignored = [column.label for column in candidates if column not in best]
    if ignored:
        used = " and ".join(column.label for column in best)
        notes.append(f"times from {used}; {', '.join(ignored)} ignored")
    return best


# Shares of rows: the least and the largest that are samples of a sensor that shares a table, and the share of
# these (of all rows if two sensors alternate) at even intervals, to this part of the interval.
_LEAST_FRESH, _MOST_FRESH, _REGULAR, _SAME = 0.02, 0.92, 0.95, 0.45


def assemble(table: Table, name: str, options: ReadOptions) -> Recording:
    """Make a recording from a table; RecordingError or UnitError if something is missing or wrong."""
    columns, notes = table.columns(), [*table.notes]
    layout = find_layout(table, columns, options, notes)
    check_length(len(columns[0]), table.source)
    rate = stated_rate(table, options.rate, notes)
    segment, source = _read(columns, layout, rate, options, table.source, notes)
    others: tuple[_Segment, ...] = ()
    stamped = bool(layout.time) and not options.uniform
    missing: tuple[Gap, ...] | None = () if stamped else None
    measured: Rate | None = None
    if layout.time and options.uniform:
        measured = uniform_rate(segment.times, layout.time_label, options.rate, source)
        even = np.arange(len(segment.times)) / measured.rate
        segment = segment._replace(times=even, zero=segment.begun)
    if options.gaps == "segments":
        segment, others, source, gaps = _segments(segment, source, notes)
        missing = gaps or missing
    if stamped:
        how = {"gaps": options.allows_gaps}
        measured = rate_from_times(segment.times, layout.time_label, options.rate, source, **how)
        if options.allows_gaps:
            values, auxiliary = on_grid(segment.values, segment.auxiliary, measured.places)
            segment = segment._replace(values=values, auxiliary=auxiliary)
    jitter = None
    if measured is not None:
        rate, jitter = measured.rate, measured.jitter
        notes.append(measured.note)
    assert rate is not None
    units, fill = table.units_with(options), options.gaps == "fill"
    of_segment = (segment.values, rate, layout.axes, units, segment.auxiliary, name, notes, source, jitter)
    made = build(*of_segment, fill, [other.values for other in others], missing)
    return replace(made, begun=segment.begun)


class _Segment(NamedTuple):
    """Samples in the file's units, auxiliary channels, times [s], and the UNIX time of zero [s]."""

    values: Float[np.ndarray, "samples axes"]
    auxiliary: Mapping[str, Float[np.ndarray, " samples"]]
    times: Float[np.ndarray, " samples"]
    zero: float | None = None

    @property
    def begun(self) -> float | None:
        """UNIX time of its first sample [s], if it is known."""
        return None if self.zero is None else self.zero + float(self.times[0])

    @property
    def interval(self) -> float:
        """Mean interval of its times [s]."""
        return float(self.times[-1] - self.times[0]) / (len(self.times) - 1)

    def taken(self, rows: slice | Bool[np.ndarray, " samples"]) -> "_Segment":
        """Return these rows."""
        auxiliary = {name: column[rows] for name, column in self.auxiliary.items()}
        return _Segment(self.values[rows], auxiliary, self.times[rows], self.zero)


def _read(
    columns: Columns,
    layout: Layout,
    rate: float | None,
    options: ReadOptions,
    source: Source,
    notes: list[str],
) -> tuple[_Segment, Source]:
    """Return the rows from start to stop, without repeated ones, and their source."""
    samples, zero = len(columns[0]), None
    if layout.time:
        stamps = [(column, columns[column.index]) for column in layout.time]
        times, _, time_notes, zero = seconds_from_first(stamps, options.time_unit, rate, source)
        notes += time_notes
    elif rate is None:
        raise no_rate_error(source)
    else:
        times = np.arange(samples) / rate
    rows = rows_of_times(times, options.start, options.stop)
    check_rows(rows, float(times[-1]), source)
    source = source.after(rows.start)
    check_length(rows.stop - rows.start, source)
    if rows != slice(0, samples):
        notes.append(f"samples {rows.start:,} to {rows.stop - 1:,} of {samples:,} read")
    gaps = options.allows_gaps
    # Each axis is contiguous in memory, since most of the work is axis by axis.
    values = np.array([as_float(columns[c.index][rows], c.label, source, gaps) for c in layout.axes]).T
    auxiliary = {}
    for column in layout.auxiliary:
        numbers, note = _auxiliary(column, columns[column.index][rows], source)
        notes.append(note)
        if numbers is not None:
            auxiliary[column.name] = numbers
    segment = _Segment(values, auxiliary, times[rows], zero)
    if not layout.time:
        return segment, source
    kept = np.ones(len(values), bool) if options.uniform else without_repeats(values, segment.times)
    if not kept.all():
        notes.append(f"{np.count_nonzero(~kept)} packets that were recorded twice are left out")
    own = own_rows(values[kept], segment.times[kept], layout.axes, source)
    if not own.all():
        notes.append(f"{np.count_nonzero(~own)} rows that repeat the previous values are left out")
    kept[kept] = own
    segment, source = segment.taken(kept), source.at(kept)
    check_length(len(segment.values), source)
    return segment, source


def own_rows(
    values: Float[np.ndarray, "samples axes"],
    times: Float[np.ndarray, " samples"],
    axes: Sequence[Column],
    source: Source,
) -> Bool[np.ndarray, " samples"]:
    """Return the rows of a table in which its sensors were sampled.

    If several sensors share a table, a row repeats the previous values of those that were not sampled then.
    """
    fresh = {}
    for sensor in dict.fromkeys(column.sensor for column in axes):
        own = values[:, [column.sensor == sensor for column in axes]]
        fresh[sensor] = np.concatenate([[False], (own[1:] != own[:-1]).any(axis=1)])
    # A sensor that does not change is dead.
    living = [rows for rows in fresh.values() if rows.mean() > _LEAST_FRESH]
    in_turn = len(living) == 2 and np.mean(living[0] ^ living[1]) > _REGULAR
    for sensor, rows in fresh.items():
        if _LEAST_FRESH < rows.mean() < _MOST_FRESH:
            # A sensor with its own rate has nearly all intervals the same.
            intervals = np.diff(times[rows])
            typical = np.median(intervals)
            if in_turn or np.mean(abs(intervals - typical) < _SAME * typical) > _REGULAR:
                continue
        fresh[sensor] = np.ones(len(values), bool)
    one, other = (*fresh.values(), *fresh.values())[:2]
    if np.mean(one ^ other) <= 1.0 - _REGULAR:
        return one | other
    rates = {sensor: rows.sum() / max(times[-1] - times[0], 1e-9) for sensor, rows in fresh.items()}
    listed = " and ".join(f"{sensor} at {rate:.4g} Hz" for sensor, rate in rates.items())
    error = source.error(
        f"the sensors were sampled at different times, {listed} (other rows repeat the previous values), but "
        "a recording has one rate; read one sensor with columns='gyro' or columns='accel' (--columns gyro, "
        "--columns accel)"
    )
    raise MixedRatesError(str(error), tuple(map(str, fresh)))


def _segments(
    record: _Segment, source: Source, notes: list[str]
) -> tuple[_Segment, tuple[_Segment, ...], Source, tuple[Gap, ...]]:
    """Return the longest segment without gaps, other segments, its source, and the gaps."""
    segments = segments_of(record.values, after_gaps(record.times))
    source = source.after(segments.longest.start)
    check_length(segments.longest.stop - segments.longest.start, source)
    longest = record.taken(segments.longest)

    def has_same_rate(rows: slice) -> bool:
        return abs(record.taken(rows).interval / longest.interval - 1.0) < MAX_RATE_DIFFERENCE

    segments = segments._replace(others=tuple(filter(has_same_rate, segments.others)))
    notes += segments.notes(len(record.values))
    others = tuple(map(record.taken, segments.others))
    return longest, others, source, segments.gaps(record.times, 1.0 / longest.interval)


def no_rate_error(source: Source) -> RecordingError:
    """Return the RecordingError for samples without a rate and without time stamps."""
    return source.error(
        "no sample rate; pass rate= in Hz (--rate), or name a column of time stamps with time= (--time) "
        "or in the header, e.g. `time [s]`"
    )


def check_rows(rows: slice, duration: float, source: Source) -> None:
    """Raise `RecordingError` if no rows remain of a recording that lasts `duration` [s]."""
    if rows.start == rows.stop:
        raise source.error(
            f"start= and stop= (--start, --stop) leave no sample of its {duration:.6g} s; give times within "
            "the record"
        )


def stated_rate(table: Table, given: float | None, notes: list[str]) -> float | None:
    """Return the given sample rate [Hz], with a note if the file states another; else that of the file."""
    if given is None:
        return None if table.rate is None else check_rate(table.rate, table.source)
    rate = check_rate(given, table.source)
    if table.rate is not None and abs(table.rate / rate - 1.0) > MAX_RATE_DIFFERENCE:
        notes.append(f"sample rate {rate:g} Hz as given, although the file states {table.rate:g} Hz")
    return rate


def rows_of_times(times: np.ndarray, start: float | None, stop: float | None) -> slice:
    """Return the rows from the first time at or after `start` up to the first at or after `stop`, in s."""
    # Tolerance of half a nanosecond for the rounding of stamps.
    first = 0 if start is None else _first_at(times, start - 5e-10)
    last = len(times) if stop is None else _first_at(times, stop - 5e-10)
    return slice(first, max(first, last))


def _first_at(times: np.ndarray, moment: float) -> int:
    """Return the index of the first time at or after a moment."""
    late = times >= moment
    return int(np.argmax(late)) if late.any() else len(times)


def _auxiliary(column: Column, values: np.ndarray, source: Source) -> tuple[np.ndarray | None, str]:
    """Return an auxiliary column as floats, or None if it is text, and a note on it."""
    if not is_numeric(values):
        cell = str(values[0])[:40]
        return None, f"column {column.label!r} skipped as it is not numeric: {cell!r} at {source.locate(0)}"
    numbers = values.astype(float)
    unit = f" [{column.unit}]" if column.unit else ""
    missing = np.count_nonzero(~np.isfinite(numbers))
    return numbers, f"auxiliary: {column.name}{unit}{f' ({missing} values missing)' if missing else ''}"


# Time stamps before a chunk that are checked together with those of the chunk.
_BEFORE = 1024


@dataclasses.dataclass(frozen=True, eq=False)
class ChunkedRecording:
    """Recording in a file whose samples are read again in each iteration.

    An iteration yields arrays [≤ chunk, axes] in SI (rad/s and m/s²), in order; together they are the
    `values` that `read` returns plus dead axes (constant, or nan throughout), which `read` leaves out. It
    raises RecordingError at the first bad value, gap in the time stamps or damaged row, and at the end if all
    axes are dead.

    Attributes:
        rate: sample rate in Hz.
        axes: axes, one per column.
        name: name of the file without its suffix.
        notes: assumptions and findings of the reader that users should know.
        n: number of samples, if it is known before they are read.
    """

    rate: float
    axes: tuple[Axis, ...]
    name: str
    notes: tuple[str, ...]
    n: int | None
    _part: "_PartOfFile"

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the axes."""
        return tuple(axis.name for axis in self.axes)

    def __repr__(self) -> str:
        axes = ", ".join(f"{axis.name} [{axis.unit}]" for axis in self.axes)
        size = "" if self.n is None else f"{self.n} samples "
        return f"<ChunkedRecording {self.name!r}: {axes}; {size}at {self.rate:g} Hz, not read yet>"

    @property
    def own_scales(self) -> Float[np.ndarray, " axes"]:
        """Factor of each axis from its own unit to the SI rate."""
        return scales_of(self.axes, self.rate)

    def __iter__(self) -> Iterator[Float[np.ndarray, "chunk axes"]]:
        labels = [column.label for column in self._part.layout.axes]
        place, count = self._part.table.source, 0
        first, varies, silent = np.zeros(len(labels)), np.zeros(len(labels), bool), np.ones(len(labels), bool)
        for axes, _, source in self._part.pieces(self.rate):
            pairs = zip(axes, labels, strict=True)
            values = np.column_stack([as_float(x, label, source) for x, label in pairs])
            numbers = usable(values)
            for k, label in enumerate(labels):
                if silent[k] and not numbers[:, k].any():
                    values[:, k] = np.nan
                    continue
                if silent[k] and count:
                    raise bad_cells(label, count, 0, place)
                if not numbers[:, k].all():
                    check_finite(values[:, k], label, source)
            silent &= ~numbers.any(axis=0)
            if not count:
                place, first = source, values[0].copy()
            count += len(values)
            if not varies.all():
                varies |= ((values != first) & numbers).any(axis=0)
            values *= self.own_scales
            yield values
        check_length(count, place)
        if silent.all():
            raise bad_cells(labels[0], count, 0, place)
        if not varies.any():
            k = int(np.argmin(silent))
            raise constant_error(labels[k], float(first[k]), place)


def read_chunks(path: str | os.PathLike[str], *, chunk: int = 2**20, **reading: Any) -> ChunkedRecording:
    """Open a static recording to read it in chunks: text (also gzip), .npy, Parquet or HDF5.

    Columns are recognised as in `read`. The sample rate is that of the time stamps in the first chunk unless
    it is given; later stamps must agree with it. Columns that are not axes are left out.

    Args:
        path: the file.
        chunk: rows to read at a time.
        **reading: as in `read`: rate, gyro_unit, accel_unit, columns, time, time_unit, start, stop,
            topic, instance.

    Raises:
        RecordingError: the file or the arguments are unusable, as far as the first chunk shows.
        UnitError: a unit is missing, unknown or contradictory.
    """
    return open_chunks(path, ReadOptions(**reading), chunk)


def open_chunks(
    path: str | os.PathLike[str], options: ReadOptions, chunk: int = 2**20, label: str | None = None
) -> ChunkedRecording:
    """Open a recording with these options, as `read_chunks` does; messages name the file `label`."""
    path = Path(path)
    source = Source(label or str(path))
    if chunk < 1:
        raise source.error(f"chunk must be at least 1 row, not {chunk}; 2**20 is usual")
    if options.allows_gaps:
        raise source.error(
            "gaps= (--gaps) needs the whole record: read it with read() (without --stream), or read a part "
            "without gaps with start= and stop= (--start, --stop)"
        )
    kind = format_of(path, source)
    if not kind.in_chunks:
        raise source.error(
            f"a file of this kind ({kind.name}) cannot be read in chunks: read it as a whole with read() "
            "(without --stream), or save it as .npy, Parquet, HDF5 or CSV, e.g. with "
            "write(read(path), 'imu.parquet')"
        )
    table = kind.table(path, source, options)
    first = next(table.rows(chunk), None)
    if first is None:
        raise table.no_rows()
    notes = [*table.notes]
    layout = find_layout(table, first, options, notes)
    rate = stated_rate(table, options.rate, notes)
    axes, axis_notes = axes_of(layout.axes, table.units_with(options), source)
    n, start, stop = table.n, options.start, options.stop
    part = _PartOfFile(table, layout, options.time_unit, start, stop, chunk)
    if layout.time:
        stamps = [(column, first[column.index]) for column in layout.time]
        seconds, unit, time_notes, _ = seconds_from_first(stamps, options.time_unit, rate, table.source)
        notes += time_notes
        part = dataclasses.replace(part, time_unit=unit or options.time_unit)
        if all(is_numeric(first[column.index]) for column in layout.axes):
            values = np.column_stack([first[column.index] for column in layout.axes])
            if not own_rows(values, seconds, layout.axes, source).all():
                raise source.error(
                    "only read() (without --stream) leaves out rows that repeat previous values"
                )
        times, place = part.first_times()
        check_length(len(times), place)
        if options.uniform:
            found = uniform_rate(times, layout.time_label, options.rate, place)
            part = dataclasses.replace(part, layout=dataclasses.replace(layout, time=()))
        else:
            found = rate_from_times(times, layout.time_label, options.rate, place, more=True)
        rate, part = found.rate, dataclasses.replace(part, stamped=found.stamped)
        notes.append(found.note + (f", from the first {chunk} samples" if len(times) == chunk else ""))
        n = n if start is None and stop is None else None
    elif rate is None:
        raise no_rate_error(source)
    elif n is not None:
        rows = rows_between(n, rate, start, stop)
        if rows != slice(0, n):
            notes.append(f"samples {rows.start:,} to {rows.stop - 1:,} of {n:,} read")
        check_rows(rows, n / rate, source)
        n = rows.stop - rows.start
        check_length(n, source)
    if layout.auxiliary:
        notes.append(f"not read: {', '.join(column.name for column in layout.auxiliary)}")
    return ChunkedRecording(rate, axes, name_of(path), (*notes, *axis_notes), n, part)


@dataclasses.dataclass(frozen=True)
class _PartOfFile:
    """Part of a file from `start` to `stop` [s], read chunk by chunk."""

    table: Table
    layout: Layout
    time_unit: str | None
    start: float | None
    stop: float | None
    chunk: int
    stamped: float | None = None

    def first_times(self) -> tuple[Float[np.ndarray, " samples"], Source]:
        """Return the times [s] of the first samples, at most a chunk, and their place in the file."""
        times, place = np.zeros(0), self.table.source
        for _, more, source in self.pieces(None):
            place = place if len(times) else source
            times = np.concatenate([times, more])[: self.chunk]
            if len(times) == self.chunk:
                break
        return times, place

    def pieces(self, rate: float | None) -> Iterator[tuple[Columns, Float[np.ndarray, " stamps"], Source]]:
        """Yield axes in the file's units, times [s] and place in the file of successive rows of the part.

        Time stamps are checked against their rate if it is known.
        Without stamps, times follow from the rate, which is then known.
        """
        row, elapsed, before = 0, 0.0, np.zeros(0)
        last: Columns | None = None
        for columns in self.table.rows(self.chunk):
            size = len(columns[0])
            stamps = tuple(columns[column.index] for column in self.layout.time)
            if stamps:
                # Times continue from the last stamps of the previous chunk.
                joined = (
                    stamps if last is None else tuple(map(np.concatenate, zip(last, stamps, strict=True)))
                )
                source = self.table.source.after(row - (len(joined[0]) - size))
                pairs = list(zip(self.layout.time, joined, strict=True))
                times = elapsed + seconds_from_first(pairs, self.time_unit, None, source).seconds[-size:]
            else:
                times = (row + np.arange(size)) / (rate or 1.0)
            rows = rows_of_times(times, None if len(before) else self.start, self.stop)
            if rows.stop > rows.start:
                together, place = (
                    np.concatenate([before, times[rows]]),
                    self.table.source.after(row + rows.start),
                )
                if stamps and self.stamped is not None and len(together) > 1:
                    check_rate_kept(together, self.layout.time_label, self.stamped, place.after(-len(before)))
                before = together[-_BEFORE:]
                axes = tuple(columns[column.index][rows] for column in self.layout.axes)
                yield axes, times[rows], place
            if rows.stop < size:
                return
            row, last, elapsed = row + size, tuple(x[-1:] for x in stamps), float(times[-1])

"""Recordings that are read in chunks, again in each iteration."""

import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from allanjax.record.columns import Axis, scales_of
from allanjax.record.completion import rows_between
from allanjax.record.io.absent import without_samples
from allanjax.record.io.formats import format_of, name_of
from allanjax.record.io.grid import Stamps
from allanjax.record.io.kinds import named_later, of_one_sensor
from allanjax.record.io.layout import Layout
from allanjax.record.io.options import ReadOptions
from allanjax.record.io.record import (
    Rows,
    notes_on_part,
    own_rows,
    rows_of_times,
    stated_rate,
)
from allanjax.record.io.table import Columns, Table, as_float, is_numeric
from allanjax.record.io.times import IGNORE, MAX_RATE_DIFFERENCE, Clock, Seconds
from allanjax.record.units import Sensor
from allanjax.record.validation import (
    MIN_SAMPLES,
    Source,
    bad_cells,
    check_finite,
    check_length,
    constant_error,
    usable,
)

# The last time stamps before a chunk, so many, are checked together with those of the chunk.
_BEFORE = 1024


@dataclass(frozen=True, eq=False)
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
        n: number of samples, if it is known before they are read.
        given: sensors whose unit was given, as in `Recording`.
    """

    rate: float
    axes: tuple[Axis, ...]
    name: str
    n: int | None
    given: Mapping[Sensor, float]
    _notes: tuple[str, ...]
    _part: "_PartOfFile"

    @property
    def notes(self) -> tuple[str, ...]:
        """Assumptions and findings that users should know; complete when all samples have been read."""
        return (*self._part.table.notes, *self._notes)

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
        labels = [column.label for column in self._part.layout.columns]
        place, count = self._part.table.source, 0
        first = np.zeros(len(labels))
        varies = np.zeros(len(labels), bool)
        silent = np.ones(len(labels), bool)
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
            absent = without_samples(values, self._part.layout.columns)
            if absent.notes:
                raise source.error(
                    f"{absent.notes[0]}; only read() (without --stream) does so: read a part with start= and "
                    "stop=, or all of it without --stream"
                )
            if not count:
                place, first = source, values[0].copy()
            count += len(values)
            if not varies.all():
                varies |= ((values != first) & numbers).any(axis=0)
            values *= self.own_scales
            yield values
        check_length(count, place, self._part.is_cut)
        if silent.all():
            raise bad_cells(labels[0], count, 0, place)
        if not varies.any():
            k = int(np.argmin(silent))
            raise constant_error(labels[k], float(first[k]), place)


def read_chunks(path: str | os.PathLike[str], *, chunk: int = 2**18, **reading: Any) -> ChunkedRecording:
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
    path: str | os.PathLike[str], options: ReadOptions, chunk: int = 2**18, label: str | None = None
) -> ChunkedRecording:
    """Open a recording with these options, as `read_chunks` does; messages name the file `label`."""
    path = Path(path)
    source = Source(label or str(path))
    kind = format_of(path, source)
    if not kind.in_chunks:
        raise source.error(
            f"a file of this kind ({kind.name}) cannot be read in chunks: read it as a whole with read() "
            "(without --stream), or save it as .npy, Parquet, HDF5 or CSV, e.g. with "
            "write(read(path), 'imu.parquet')"
        )
    return chunks_of(kind.table(path, source, options), name_of(path), options, chunk)


def chunks_of(table: Table, name: str, options: ReadOptions, chunk: int) -> ChunkedRecording:
    """The recording in a table, to read it in chunks with these options, as `read_chunks` does."""
    source = table.source
    if chunk < 1:
        raise source.error(f"chunk must be at least 1 row, not {chunk}; 2**18 is usual")
    if options.allows_gaps:
        raise source.error(
            "gaps= needs the whole record: read it with read() (without --stream), or read a part without "
            "gaps with start= and stop="
        )
    first = next(table.rows(chunk), None)
    if first is None:
        raise source.no_rows()
    if of_one_sensor(table, first, options)[0] is not table:
        raise source.error("rows of several sensors are read only by read() (without --stream)")
    layout = Layout.of(table, first, options)
    rate, notes = stated_rate(table, layout, options.rate)
    if layout.auxiliary:
        notes += (f"not read: {', '.join(column.name for column in layout.auxiliary)}",)
    named = named_later(table, first, options)
    part = _PartOfFile(table, layout, None, options.start, options.stop, chunk, named=named)
    notes = (*layout.notes, *notes)
    found = ChunkedRecording(rate or 0.0, layout.axes, name, table.n, layout.given, notes, part)
    return _timed(found, rate, first, options) if layout.clock else _counted(found)


def _counted(found: ChunkedRecording) -> ChunkedRecording:
    """Return a recording without time stamps with its number of samples, if that is known."""
    part, n = found._part, found.n
    if n is None:
        return found
    rows = rows_between(n, found.rate, part.start, part.stop)
    notes = notes_on_part(rows, n, n / found.rate, part.table.source)
    return replace(found, n=rows.stop - rows.start, _notes=(*found._notes, *notes))


def _timed(
    found: ChunkedRecording, rate: float | None, first: Columns, options: ReadOptions
) -> ChunkedRecording:
    """Return a recording with the rate that the stamps in its first rows tell."""
    part = found._part
    layout, source = part.layout, part.table.source
    stamps = layout.stamps(first)
    clock = Clock.of(layout.clock, stamps, options.time_unit, rate, source)
    part = replace(part, clock=clock, step=clock.step(stamps))
    columns = [first[column.index] for column in layout.columns]
    if all(map(is_numeric, columns)):
        seconds, _ = clock.seconds(stamps, source)
        values = np.column_stack(columns)
        rows = Rows(values, {}, seconds, source, np.zeros(values.shape, bool))
        if not own_rows(rows, layout.columns).all():
            raise source.error("only read() (without --stream) leaves out rows that repeat previous values")
    times, place = part.first_times()
    check_length(len(times), place, part.is_cut)
    grid = Stamps(times, part.step, clock.label, place, more=True).grid(
        options.rate, gaps=False, uniform=options.uniform, force=options.force
    )
    part = replace(
        part, stamped=grid.stamped, layout=replace(layout, clock=() if grid.even else layout.clock)
    )
    note = grid.note + (f", from the first {part.chunk} samples" if len(times) == part.chunk else "")
    notes, n = (*found._notes, *clock.notes, note), None if part.is_cut else found.n
    return replace(found, rate=grid.rate, n=n, _notes=notes, _part=part)


@dataclass(frozen=True)
class _PartOfFile:
    """Part of a file from `start` to `stop` [s], read chunk by chunk."""

    table: Table
    layout: Layout
    clock: Clock | None
    start: float | None
    stop: float | None
    chunk: int
    stamped: float | None = None
    step: float = 0.0
    named: Mapping[int, object] = field(default_factory=dict)

    @property
    def is_cut(self) -> bool:
        """Whether it may be less than the whole."""
        return (self.start, self.stop) != (None, None)

    def first_times(self) -> tuple[Seconds, Source]:
        """Return the times [s] of the first samples, at most a chunk, and their place in the file."""
        times, place = np.zeros(0), self.table.source
        for _, more, source in self.pieces(None):
            place = place if len(times) else source
            times = np.concatenate([times, more])[: self.chunk]
            if len(times) == self.chunk:
                break
        return times, place

    def pieces(self, rate: float | None) -> Iterator[tuple[Columns, Seconds, Source]]:
        """Yield axes in the file's units, times [s] and place in the file of successive rows of the part.

        Time stamps are checked against their rate if it is known.
        Without stamps, times follow from the rate, which is then known.
        """
        row, elapsed = 0, 0.0
        before = np.zeros(0)
        last: Columns = ()
        for columns in self.table.rows(self.chunk):
            size, stamps = len(columns[0]), self.layout.stamps(columns)
            for k, name in self.named.items():
                if np.count_nonzero(columns[k] != name) >= MIN_SAMPLES:
                    raise self.table.source.error(
                        f"rows are of several sensors, {name} and {columns[k][-1]} among them, which only "
                        f"read() (without --stream) tells apart; choose one there with instance={str(name)!r}"
                    )
            if self.clock is not None and stamps:
                # Times continue from the last stamps of the previous chunk.
                joined = tuple(map(np.concatenate, zip(last, stamps, strict=True))) if last else stamps
                place = self.table.source.after(row - (len(joined[0]) - size))
                times = elapsed + self.clock.seconds(joined, place)[0][-size:]
            else:
                times = (row + np.arange(size)) / (rate or 1.0)
            rows = rows_of_times(times, None if len(before) else self.start, self.stop)
            if rows.stop > rows.start:
                together = np.concatenate([before, times[rows]])
                place = self.table.source.after(row + rows.start)
                if stamps and self.stamped is not None and len(together) > 1:
                    self._check_rate_kept(together, place.after(-len(before)))
                before = together[-_BEFORE:]
                axes = tuple(columns[column.index][rows] for column in self.layout.columns)
                yield axes, times[rows], place
            if rows.stop < size:
                return
            row, elapsed = row + size, float(times[-1])
            last = tuple(x[-1:] for x in stamps)

    def _check_rate_kept(self, times: Seconds, source: Source) -> None:
        """Raise RecordingError if later times are unusable or have another rate than the first."""
        assert self.clock
        assert self.stamped
        label = self.clock.label
        later = Stamps(times, self.step, label, source, more=True).grid(
            None, gaps=False, uniform=False, force=False
        )
        if abs(later.stamped / self.stamped - 1.0) > MAX_RATE_DIFFERENCE:
            raise source.error(
                f"column {label!r} has {self.stamped:.6g} Hz at first, but {later.stamped:.6g} Hz from "
                f"{source.locate(0)} on; read a part with one rate with start= and stop=, "
                f"or {IGNORE}",
                "rate",
            )

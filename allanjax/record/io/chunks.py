"""Recordings that are read chunk by chunk because they do not fit into memory."""

import dataclasses
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from allanjax.record.axes import Axis, axes_of, scales_of
from allanjax.record.gaps import rows_between
from allanjax.record.io.assembly import check_stretch, no_rate_error, own_rows, rows_of_times, stated_rate
from allanjax.record.io.formats import format_of, name_of
from allanjax.record.io.layout import Layout, find_layout
from allanjax.record.io.options import ReadOptions
from allanjax.record.io.table import Columns, Table, as_float, is_numeric
from allanjax.record.io.timestamps import check_rate_kept, rate_from_times, seconds_from_first, uniform_rate
from allanjax.record.validation import (
    Source,
    bad_cells,
    check_finite,
    check_length,
    constant_error,
    usable,
)

# Time stamps before a chunk that are checked together with those of the chunk.
_BEFORE = 1024


@dataclasses.dataclass(frozen=True, eq=False)
class ChunkedRecording:
    """Recording in a file whose samples are read anew whenever it is iterated over.

    An iteration gives arrays [≤ chunk, axes] in SI (rad/s and m/s²), in order; together they are the `values`
    that `read` would give, and also dead axes, which `read` leaves out: constant, or nan throughout. It
    raises RecordingError at the first bad value, gap of the time stamps or damaged row, and at the end if all
    axes are dead.

    Attributes:
        rate: sample rate in Hz.
        axes: axes, one per column.
        name: name of the file without its suffix.
        notes: assumptions and findings of the reader that the user should know.
        n: number of samples, if it is known before they are read.
    """

    rate: float
    axes: tuple[Axis, ...]
    name: str
    notes: tuple[str, ...]
    n: int | None
    _stretch: "_Stretch"

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
        labels = [column.label for column in self._stretch.layout.axes]
        place, count = self._stretch.table.source, 0
        first, varies, silent = np.zeros(len(labels)), np.zeros(len(labels), bool), np.ones(len(labels), bool)
        for axes, _, source in self._stretch.pieces(self.rate):
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
    """Open a static recording to read it a chunk at a time: text (also gzip), .npy, Parquet or HDF5.

    Columns are recognised as by `read`. The sample rate is that of the first chunk's time stamps, unless it
    is given; later stamps must agree with it. Columns that are no axis are left out.

    Args:
        path: the file.
        chunk: rows to read at a time.
        **reading: as for `read`: rate, gyro_unit, accel_unit, columns, time, time_unit, start, stop,
            topic, instance.

    Raises:
        RecordingError: the file or the arguments are not usable, as far as the first chunk shows.
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
            "gaps= (--gaps) needs the whole record: read it by read(), or leave out --stream; or take "
            "stretches without gaps by start= and stop= (--start, --stop)"
        )
    kind = format_of(path, source)
    if not kind.in_chunks:
        raise source.error(
            f"a file of this kind ({kind.name}) can not be read in chunks: read it as a whole by read() "
            "(without --stream), or save it once as .npy, Parquet, HDF5 or CSV, e.g. by "
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
    stretch = _Stretch(table, layout, options.time_unit, start, stop, chunk)
    if layout.time:
        stamps = [(column, first[column.index]) for column in layout.time]
        seconds, unit, time_notes = seconds_from_first(stamps, options.time_unit, rate, table.source)
        notes += time_notes
        stretch = dataclasses.replace(stretch, time_unit=unit or options.time_unit)
        _check_one_rate(first, seconds, layout, source)
        times, place = stretch.first_times()
        check_length(len(times), place)
        if options.uniform:
            found = uniform_rate(times, layout.time_label, options.rate, place)
            stretch = dataclasses.replace(stretch, layout=dataclasses.replace(layout, time=()))
        else:
            found = rate_from_times(times, layout.time_label, options.rate, place, more=True)
        rate, stretch = found.rate, dataclasses.replace(stretch, stamped=found.stamped)
        notes.append(found.note + (f", of the first {chunk} samples" if len(times) == chunk else ""))
        n = n if start is None and stop is None else None
    elif rate is None:
        raise no_rate_error(source)
    elif n is not None:
        rows = rows_between(n, rate, start, stop)
        if rows != slice(0, n):
            notes.append(f"samples {rows.start} to {rows.stop - 1} of {n} taken")
        check_stretch(rows, n / rate, source)
        n = rows.stop - rows.start
        check_length(n, source)
    if layout.auxiliary:
        notes.append(f"not read: {', '.join(column.name for column in layout.auxiliary)}")
    return ChunkedRecording(rate, axes, name_of(path), (*notes, *axis_notes), n, stretch)


def _check_one_rate(columns: Columns, times: np.ndarray, layout: Layout, source: Source) -> None:
    """Raise RecordingError if rows repeat others as those of two sensors in one table do."""
    if all(is_numeric(columns[column.index]) for column in layout.axes):
        values = np.column_stack([columns[column.index] for column in layout.axes])
        if not own_rows(values, times, layout.axes, source).all():
            raise source.error(
                "rows that repeat the last values are left out only without --stream, by read()"
            )


class _Piece(NamedTuple):
    """Successive rows of a stretch: axes in the file's units, times [s], and their place in the file."""

    axes: Columns
    times: Float[np.ndarray, " stamps"]
    source: Source


@dataclasses.dataclass(frozen=True)
class _Stretch:
    """Part of a file from `start` to `stop` [s], read chunk by chunk."""

    table: Table
    layout: Layout
    time_unit: str | None
    start: float | None
    stop: float | None
    chunk: int
    stamped: float | None = None

    def first_times(self) -> tuple[Float[np.ndarray, " samples"], Source]:
        """Times [s] of the first samples, at most a chunk of them, and their place in the file."""
        times, place = np.zeros(0), self.table.source
        for piece in self.pieces(None):
            place = place if len(times) else piece.source
            times = np.concatenate([times, piece.times])
            if len(times) >= self.chunk:
                break
        return times[: self.chunk], place

    def pieces(self, rate: float | None) -> Iterator[_Piece]:
        """Pieces of the stretch, in order; time stamps are checked against their rate if it is known.

        Without stamps times follow from the rate, which is known then.
        """
        row, elapsed, seen = 0, 0.0, np.zeros(0)
        last: Columns | None = None
        for columns in self.table.rows(self.chunk):
            size = len(columns[0])
            stamps = tuple(columns[column.index] for column in self.layout.time)
            if stamps:
                # The last stamps of the chunk before, from which on the times of this one are counted.
                joined = (
                    stamps if last is None else tuple(map(np.concatenate, zip(last, stamps, strict=True)))
                )
                source = self.table.source.after(row - (len(joined[0]) - size))
                pairs = list(zip(self.layout.time, joined, strict=True))
                times = elapsed + seconds_from_first(pairs, self.time_unit, None, source).seconds[-size:]
            else:
                times = (row + np.arange(size)) / (rate or 1.0)
            rows = rows_of_times(times, None if len(seen) else self.start, self.stop)
            piece = self._piece(columns, rows, times[rows], row)
            if len(piece.times):
                together = np.concatenate([seen, piece.times])
                if stamps and self.stamped is not None and len(together) > 1:
                    place = piece.source.after(-len(seen))
                    check_rate_kept(together, self.layout.time_label, self.stamped, place)
                seen = together[-_BEFORE:]
                yield piece
            if rows.stop < size:
                return
            row, last, elapsed = row + size, tuple(x[-1:] for x in stamps), float(times[-1])

    def _piece(self, columns: Columns, rows: slice, times: np.ndarray, row: int) -> _Piece:
        """Piece from these rows of a chunk that begins at row `row` of the file."""
        axes = tuple(columns[column.index][rows] for column in self.layout.axes)
        return _Piece(axes, times, self.table.source.after(row + rows.start))

"""Layout of a table: which columns are axes, time stamps and auxiliary channels."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from allanjax.record.axes import default_names, distinct
from allanjax.record.columns import Column, by_unit, recognise, split_unit
from allanjax.record.io.options import ReadOptions
from allanjax.record.io.table import Columns, Table
from allanjax.record.units import SENSORS

# Entries in a list of columns that skip a column.
_SKIP = ("-", "_", "")


@dataclass(frozen=True)
class Layout:
    """Columns of a table by what they are; `time` holds none, one, or seconds and nanoseconds."""

    axes: tuple[Column, ...]
    time: tuple[Column, ...]
    auxiliary: tuple[Column, ...]

    @property
    def time_label(self) -> str:
        """Label of the time stamps."""
        return " + ".join(column.label for column in self.time)


def find_layout(table: Table, columns: Columns, options: ReadOptions, notes: list[str]) -> Layout:
    """Find the layout of a table, by the user's columns, else by the labels, else by the units given.

    Adds what was assumed to the notes.

    Args:
        table: the table.
        columns: its first rows, or all.
        options: the user's options.
        notes: the notes so far.

    Raises:
        RecordingError: the columns are not recognised, or two have the same name.
    """
    if options.columns is not None:
        found = _chosen(table, len(columns), options.columns)
    elif table.labels is not None:
        repeated = _repeated(table.labels)
        if repeated:
            raise table.source.error(
                f"the header names {', '.join(map(repr, repeated))} more than once; correct it, "
                "or name all columns by columns= (--columns)"
            )
        found = _recognised(table.labels)
    else:
        names = default_names(len(columns), options.units, "columns= (--columns)", table.source)
        found = _recognised(names)
        notes.append(f"the file has no header; column order taken as {', '.join(names)}")
    found = [
        replace(c, role="time") if c.role == "auxiliary" and columns[c.index].dtype.kind == "M" else c
        for c in found
    ]
    time = _chosen_time(table, found, columns, options, notes)
    sensors = {column.sensor for column in found if column.role == "axis"}
    named = [c if (axis := by_unit(c)).sensor in sensors else axis for c in found]
    axes = tuple(c for c in named if c.role == "axis" and c.index not in {column.index for column in time})
    if not axes:
        raise table.source.error(
            f"no gyro or accelerometer column among {', '.join(column.label for column in found)}; "
            "name the columns by columns= (--columns), e.g. time,gyro_x,gyro_y,gyro_z"
        )
    axes = distinct(axes, table.source)
    notes += _missing_axes(axes)
    renamed = [f"{c.name} from {c.label!r}" for c in axes if split_unit(c.label)[0] != c.name]
    if renamed:
        notes.append(f"axes: {', '.join(renamed)}")
    used = {column.index for column in (*axes, *time)}
    auxiliary = tuple(c for c in found if c.role in ("auxiliary", "counter") and c.index not in used)
    return Layout(axes, time, auxiliary)


def _recognised(labels: Sequence[str]) -> list[Column]:
    """Columns by their labels."""
    return [replace(recognise(label), index=i) for i, label in enumerate(labels)]


def _repeated(names: Sequence[str]) -> list[str]:
    """Names that occur more than once."""
    return sorted({name for name in names if names.count(name) > 1})


def _chosen(table: Table, count: int, columns: str | Sequence[str]) -> list[Column]:
    """Columns of `count` by the user's list: a choice of the header's names, or names by position."""
    entries = [entry.strip() for entry in (columns.split(",") if isinstance(columns, str) else columns)]
    names = [entry for entry in entries if entry not in _SKIP]
    if repeated := _repeated(names):
        raise table.source.error(
            f"columns= names {', '.join(repeated)} more than once; name each column once"
        )
    if table.labels is not None:
        matches = [_match(table, name, len(entries) == count) for name in names]
        if len(names) == len(entries) and all(matches):
            picked = {
                i: split_unit(name)[1] for name, match in zip(names, matches, strict=True) for i in match
            }
            # Time stamps are kept, because the rate is taken from them, and a unit that is stated is taken.
            return [
                replace(c, unit=picked.get(c.index) or c.unit)
                for c in _recognised(table.labels)
                if c.index in picked or c.role in ("time", "counter")
            ]
        unknown = [name for name, match in zip(names, matches, strict=True) if not match]
        if len(entries) != count and unknown:
            raise table.source.error(
                f"columns= (--columns) asks for {', '.join(unknown)}, and the file has "
                f"{', '.join(table.labels)}; choose among these, or give one name per column in order, - to "
                "skip one"
            )
    if len(entries) != count:
        has = "no names" if table.labels is None else f"the names {', '.join(table.labels)}"
        raise table.source.error(
            f"columns= has {len(entries)} entries, but the file has {count} columns, with {has}; "
            "list names of the header, or one entry per column with - for those to skip"
        )
    found = [c for c in _recognised(entries) if entries[c.index] not in _SKIP]
    # Where the user gives no unit, it is that of the header.
    units = [None] * count if table.labels is None else [split_unit(label)[1] for label in table.labels]
    return [replace(c, unit=c.unit or units[c.index]) for c in found]


def _match(table: Table, name: str, by_position: bool) -> tuple[int, ...]:
    """Indices of the columns whose label, or label without unit, or recognised name is `name`.

    A sensor's name is all its axes. Where all columns may be named by their positions, a name that several
    have is none of them.
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
            raise table.source.error(
                f"columns= names {name!r}, which may be any of {listed}; use the full name"
            )
        if found:
            return found
    return ()


def _chosen_time(
    table: Table, found: Sequence[Column], columns: Columns, options: ReadOptions, notes: list[str]
) -> tuple[Column, ...]:
    """Column of time stamps, or the pair of seconds and nanoseconds; none if there is none to use."""
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
            f"no time column {time!r} among {listed}; correct time= (--time), or ignore the stamps by "
            "time='none' (--time none)"
        )
    # One that is empty is none.
    candidates = [c for c in found if c.role == "time" and (columns[c.index] == columns[c.index]).any()]
    if not candidates and (options.rate or table.rate):
        # Without a rate it is not known what a counter counts.
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
    # A pair is one clock; a header's stamp is the time of sampling, others may be that of arrival.
    best = max(choices, key=lambda choice: (len(choice), "header" in choice[0].label.lower()))
    ignored = [column.label for column in candidates if column not in best]
    if ignored:
        used = " and ".join(column.label for column in best)
        notes.append(f"time from {used}; {', '.join(ignored)} ignored")
    return best


def _missing_axes(axes: Sequence[Column]) -> list[str]:
    """Notes on sensors that have two axes of x, y and z."""
    names, notes = {axis.name for axis in axes}, []
    for sensor in SENSORS:
        missing = {f"{sensor}_{axis}" for axis in "xyz"} - names
        if len(missing) == 1:
            notes.append(f"no column of {missing.pop()}: the other two axes are read without it")
    return notes

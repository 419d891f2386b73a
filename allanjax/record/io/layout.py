"""Layout of a table: which columns are axes, time stamps and auxiliary channels."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from allanjax.record.axes import check_axes, default_names
from allanjax.record.columns import Column, recognise, split_unit
from allanjax.record.io.options import ReadOptions, TimeChoice
from allanjax.record.io.table import Table
from allanjax.record.units import SENSORS

#: Index of a column in the table, and what it is.
Indexed = tuple[int, Column]

# Entries in a list of columns that skip a column.
_SKIP = ("-", "_", "")


@dataclass(frozen=True)
class Layout:
    """Indices and meanings of a table's columns; `time` holds none, one, or seconds and nanoseconds."""

    axes: tuple[Indexed, ...]
    time: tuple[Indexed, ...]
    auxiliary: tuple[Indexed, ...]
    notes: tuple[str, ...]


def find_layout(table: Table, options: ReadOptions) -> Layout:
    """Find the layout of a table, by the user's columns, else by the labels, else by the units given.

    Raises:
        RecordingError: the columns are not recognised, two are the same axis, or a triad lacks one.
    """
    notes: list[str] = []
    if options.columns is not None:
        found = _chosen(table, options.columns)
    elif table.labels is not None:
        _check_labels(table)
        found = [(i, recognise(label)) for i, label in enumerate(table.labels)]
    else:
        units = options.gyro_unit, options.accel_unit
        names = default_names(len(table.columns), *units, "columns= (--columns)", table.source)
        found = [(i, recognise(name)) for i, name in enumerate(names)]
        notes.append(f"the file has no header; column order taken as {', '.join(names)}")
    found = [
        (i, replace(column, role="time"))
        if column.role == "auxiliary" and table.columns[i].dtype.kind == "M"
        else (i, column)
        for i, column in found
    ]
    chosen_time = _chosen_time(table, found, options.time, notes)
    taken = {i for i, _ in chosen_time}
    axes = tuple((i, column) for i, column in found if column.role == "axis" and i not in taken)
    if not axes:
        raise table.source.error(
            f"no gyro or accelerometer column among {', '.join(column.label for _, column in found)}; "
            "name the columns by columns= (--columns), e.g. time,gyro_x,gyro_y,gyro_z"
        )
    check_axes([column for _, column in axes], table.source)
    if options.columns is None:
        _check_triads(table, [column for _, column in axes])
    renamed = [
        f"{column.name} from {column.label!r}"
        for _, column in axes
        if split_unit(column.label)[0] != column.name
    ]
    if renamed:
        notes.append(f"axes: {', '.join(renamed)}")
    auxiliary = tuple((i, column) for i, column in found if column.role == "auxiliary" and i not in taken)
    return Layout(axes, chosen_time, auxiliary, tuple(notes))


def _chosen(table: Table, columns: str | Sequence[str]) -> list[Indexed]:
    """Columns by the user's list: a choice of the header's names, or names by position."""
    entries = [entry.strip() for entry in (columns.split(",") if isinstance(columns, str) else columns)]
    names = [entry for entry in entries if entry not in _SKIP]
    repeated = sorted({name for name in names if names.count(name) > 1})
    if repeated:
        raise table.source.error(
            f"columns= names {', '.join(repeated)} more than once; name each column once"
        )
    if table.labels is not None:
        matches = [_match(table, name) for name in names]
        if len(names) == len(entries) and all(matches):
            picked = {i for match in matches for i in match}
            recognised = [(i, recognise(label)) for i, label in enumerate(table.labels)]
            # Time stamps are kept, because the rate is taken from them.
            return [(i, column) for i, column in recognised if i in picked or column.role == "time"]
        unknown = [name for name, match in zip(names, matches, strict=True) if not match]
        if len(entries) != len(table.columns) and unknown:
            raise table.source.error(
                f"columns= (--columns) asks for {', '.join(unknown)}, and the file has "
                f"{', '.join(table.labels)}; choose among these, or give one name per column in order, - to "
                "skip one"
            )
    if len(entries) != len(table.columns):
        has = "no names" if table.labels is None else f"the names {', '.join(table.labels)}"
        raise table.source.error(
            f"columns= has {len(entries)} entries, but the file has {len(table.columns)} columns, with "
            f"{has}; "
            "list names of the header, or one entry per column with - for those to skip"
        )
    return [(i, _renamed(table, i, entry)) for i, entry in enumerate(entries) if entry not in _SKIP]


def _match(table: Table, name: str) -> tuple[int, ...]:
    """Indices of the columns whose label, or label without unit, or recognised name is `name`."""
    labels = table.labels or ()
    wanted = name.casefold()
    for key in (str.strip, lambda label: split_unit(label)[0], lambda label: recognise(label).name):
        found = tuple(i for i, label in enumerate(labels) if key(label).casefold() == wanted)
        if len(found) > 1:
            listed = ", ".join(repr(labels[i]) for i in found)
            raise table.source.error(
                f"columns= names {name!r}, which may be any of {listed}; use the full name"
            )
        if found:
            return found
    return ()


def _renamed(table: Table, index: int, name: str) -> Column:
    """Column with the name that the user gave, and the unit of its label."""
    column = recognise(name)
    if table.labels is None or column.unit is not None:
        return column
    return replace(column, unit=split_unit(table.labels[index])[1])


def _chosen_time(
    table: Table, found: Sequence[Indexed], time: TimeChoice, notes: list[str]
) -> tuple[Indexed, ...]:
    """Column of time stamps, or the pair of seconds and nanoseconds; none if there is none to use."""
    if time is False or (time is not None and time.casefold() == "none"):
        return ()
    if time is not None:
        for key in (lambda column: column.label, lambda column: column.name):
            named = [(i, column) for i, column in found if key(column).casefold() == time.casefold()]
            if len(named) == 1:
                return (named[0],)
        listed = ", ".join(column.label for _, column in found)
        raise table.source.error(
            f"no time column {time!r} among {listed}; correct time= (--time), or pass time='none'"
        )
    candidates = [(i, column) for i, column in found if column.role == "time"]
    choices = [(item,) for item in candidates] + _pairs(candidates)
    if not choices:
        return ()
    # A pair is one clock; a header's stamp is the time of sampling, others may be that of arrival.
    best = max(choices, key=lambda choice: (len(choice), "header" in choice[0][1].label.lower()))
    ignored = [column.label for i, column in candidates if i not in {index for index, _ in best}]
    if ignored:
        used = " and ".join(column.label for _, column in best)
        notes.append(f"time from {used}; {', '.join(ignored)} ignored")
    return best


def _pairs(candidates: Sequence[Indexed]) -> list[tuple[Indexed, ...]]:
    """Pairs of columns with the seconds and nanoseconds of the same stamps."""
    seconds = {c.time_part[0]: (i, c) for i, c in candidates if c.time_part and c.time_part[1] == "s"}
    nanoseconds = {c.time_part[0]: (i, c) for i, c in candidates if c.time_part and c.time_part[1] == "ns"}
    return [(seconds[key], nanoseconds[key]) for key in seconds if key in nanoseconds]


def _check_labels(table: Table) -> None:
    """Raise RecordingError if a label occurs more than once."""
    labels = table.labels or ()
    repeated = sorted({label for label in labels if labels.count(label) > 1})
    if repeated:
        raise table.source.error(
            f"the header names {', '.join(map(repr, repeated))} more than once; correct it, "
            "or name all columns by columns= (--columns)"
        )


def _check_triads(table: Table, columns: Sequence[Column]) -> None:
    """Raise RecordingError if a sensor has two axes of x, y and z."""
    for sensor in SENSORS:
        triad = [f"{sensor}_{axis}" for axis in "xyz"]
        present = [name for name in triad if any(column.name == name for column in columns)]
        if len(present) == 2:
            missing = next(name for name in triad if name not in present)
            raise table.source.error(
                f"{' and '.join(present)} but no {missing}; add the column, or if it is absent on "
                "purpose choose the "
                f"columns by columns= (--columns), e.g. {','.join(column.name for column in columns)}"
            )

"""Layout: which columns of a table are axes, which are its clock, and in which units."""

import difflib
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from allanjax.base.errors import UnitError
from allanjax.record.columns import (
    EXAMPLE,
    Axis,
    Column,
    axes_of,
    begins_with,
    by_unit,
    default_names,
    distinct,
    in_directions,
    may_be_time,
    recognise,
    split_unit,
    together,
    triads,
    unclaimed,
    with_unit,
)
from allanjax.record.io.absent import unwrapped
from allanjax.record.io.options import ReadOptions
from allanjax.record.io.table import Columns, Table, is_numeric
from allanjax.record.io.times import are_times, unevenness
from allanjax.record.shapes import Cells
from allanjax.record.units import SENSORS, Sensor, convert, is_unit, unit_scale
from allanjax.record.validation import check_names

# Entries in a list of columns that skip a column.
_SKIP = ("-", "_", "")
# Names of axes in a list of columns.
_NAMES: dict[Sensor, list[str]] = {sensor: [f"{sensor}_{axis}" for axis in "xyz"] for sensor in SENSORS}
# Least share of rows in which times do not decrease.
_RISING = 0.9


@dataclass(frozen=True)
class Layout:
    """Columns of a table by what they are.

    Attributes:
        columns: columns of the axes.
        axes: these axes, with the units of their samples.
        clock: columns of the time stamps: none, one, or whole seconds and parts of them.
        auxiliary: other columns.
        given: sensors whose unit was given, and the factor from their labels' unit to it; 1 without labels.
        notes: assumptions that users should know.
    """

    columns: tuple[Column, ...]
    axes: tuple[Axis, ...]
    clock: tuple[Column, ...]
    auxiliary: tuple[Column, ...]
    given: Mapping[Sensor, float]
    notes: tuple[str, ...]

    @classmethod
    def of(cls, table: Table, first: Columns, options: ReadOptions) -> "Layout":
        """Find the layout from the columns that are asked for, or else from labels, or else from units.

        Args:
            table: the table.
            first: its first rows, or all.
            options: options of reading.

        Raises:
            RecordingError, UnitError: no axis, no unit, an ambiguous name, or an option without a use.
        """
        found, notes = _found(table, first, options)
        clock, clock_notes = _clock(table, found, first, options)
        in_clock = {column.index for column in clock}
        sensors = {column.sensor for column in found if column.role == "axis"}
        named = []
        for column in found:
            axis = by_unit(column)
            named.append(column if axis.sensor in sensors else axis)
        columns = tuple(in_directions([c for c in named if c.role == "axis" and c.index not in in_clock]))
        _check_is_recording(table, found, columns, clock)
        columns = distinct(columns, table.source)
        _check_all_used(table, columns, clock, first, options)
        if table.labels is not None and options.columns is None and not table.complete:
            _check_none_missed(table, found, columns, clock, first)
        samples = partial(_samples, columns, first)
        labelled = [sensor for sensor in SENSORS if all(c.unit for c in columns if c.sensor == sensor)]
        units = table.units_with(options, labelled)
        axes, axis_notes = axes_of(columns, units, table.source, samples)
        used = in_clock | {column.index for column in columns}
        auxiliary = tuple(c for c in found if c.index not in used and _is_channel(c, first[c.index]))
        every = (*notes, *clock_notes, *_notes_on(columns), *_notes_on_others(auxiliary), *axis_notes)
        return cls(columns, axes, clock, auxiliary, _given(columns, options), every)

    def stamps(self, columns: Columns) -> tuple[Cells, ...]:
        """Return the time stamps in these columns of the table."""
        return tuple(columns[column.index] for column in self.clock)


def _samples(columns: Sequence[Column], first: Columns) -> Sequence[Cells]:
    """Return the samples in columns, of which those that have wrapped are shifted back."""
    samples = [first[column.index] for column in columns]
    if not all(map(is_numeric, samples)):
        return samples
    return [*unwrapped(np.array(samples, float).T, columns)[0].T]


def _is_channel(column: Column, values: Cells) -> bool:
    """Return whether a column beside axes and clock is read; of other times, numbers that may be others."""
    if column.role == "time":
        return recognise(column.label).role == "auxiliary" and is_numeric(values)
    return column.role != "axis"


def _found(table: Table, first: Columns, options: ReadOptions) -> tuple[list[Column], list[str]]:
    """Return the columns of a table that may be used, and notes."""
    notes = []
    if options.columns is not None:
        found = _chosen(table, len(first), options.columns)
    elif table.labels is not None:
        repeated = _repeated([*filter(None, table.labels)])
        if repeated:
            raise table.source.error(
                f"several columns are called {', '.join(map(repr, repeated))}; correct the header, or name "
                f"all with columns={_side_by_side(table.labels)}"
            )
        found = _recognised(table.labels)
    else:
        # Times are usually in the first column.
        axes = 3 * sum(unit is not None for unit in options.units.values())
        timed = 0 < axes == len(first) - 1 and is_numeric(first[0]) and _increases(first[0])
        row = f" (the first row is {', '.join(str(column[0])[:12] for column in first[:10])})"
        own = default_names(len(first) - timed, options.units, table.source, row)
        names = ("time", *own) if timed else own
        found = _recognised(names)
        notes.append(f"the columns have no names; they are assumed to be {', '.join(names)}")
    found = [_as_time(column, first[column.index], table) for column in found]
    return _of_one_sensor(together(found), options, notes), notes


def _of_one_sensor(found: list[Column], options: ReadOptions, notes: list[str]) -> list[Column]:
    """Return columns called x, y and z as axes if the unit of one sensor is given and no axis has a name."""
    sensors: list[Sensor] = [sensor for sensor, unit in options.units.items() if unit is not None]
    bare = [column for column in found if column.name.casefold() in ("x", "y", "z")]
    if len(sensors) != 1 or not bare or any(column.role == "axis" for column in found):
        return found
    notes.append(f"{', '.join(column.label for column in bare)} are taken as axes of the {sensors[0]}")
    for column in bare:
        name = f"{sensors[0]}_{column.name.casefold()}"
        found[found.index(column)] = replace(column, role="axis", sensor=sensors[0], name=name)
    return found


def _recognised(labels: Sequence[str]) -> list[Column]:
    """Return the columns recognised by their labels; one without a label has its number."""
    return [replace(recognise(label or f"column {i + 1}"), index=i) for i, label in enumerate(labels)]


def _as_time(column: Column, values: Cells, table: Table) -> Column:
    """Return a column of dates or in a unit of time as one of times; others unchanged."""
    if column.label in table.auxiliary:
        return replace(column, role="auxiliary", sensor=None)
    if column.role != "auxiliary":
        return column
    if values.dtype.kind == "M":
        return replace(column, role="time")
    time = may_be_time(column)
    if time is None and column.unit is not None and is_unit(column.unit, "s"):
        time = replace(column, role="time")
    # Durations beside samples, such as a latency, do not increase from row to row.
    passes = _increases(values) if is_numeric(values) else are_times(values)
    return time if time is not None and passes else column


def _side_by_side(labels: Sequence[str]) -> str:
    """Return lists of names that read one sensor each, with the times before it; "" if there are none."""
    found = [by_unit(column) for column in _recognised(labels)]
    times = [c.index for c in found if c.role == "time" or (c.unit and is_unit(c.unit, "s"))]
    told = []
    for sensor in SENSORS:
        axes = [c.index for c in found if c.role == "axis" and c.sensor == sensor]
        own = [k for k in times if axes and k < axes[0]]
        if len(axes) == len("xyz") and own:
            names = {own[-1]: "time"} | {k: f"{sensor}_{axis}" for k, axis in zip(axes, "xyz", strict=True)}
            told.append(f"'{','.join(names.get(k, '-') for k in range(len(labels)))}'")
    return " or columns=".join(told)


def _increases(values: Cells) -> bool:
    """Return whether values mostly increase from row to row, or stay, as in bursts."""
    steps = np.diff(values.astype(float))
    return bool((steps > 0.0).any() and np.mean(steps >= 0.0) > _RISING)


def _repeated(names: Sequence[str]) -> list[str]:
    """Return the names that occur more than once."""
    return sorted({name for name in names if names.count(name) > 1})


def _chosen(table: Table, count: int, columns: str | Sequence[str]) -> list[Column]:
    """Return the columns that are asked for: names of the header, or names of all columns by position."""
    check_names(columns, "columns=", table.source)
    entries = [entry.strip() for entry in (columns.split(",") if isinstance(columns, str) else columns)]
    names = [entry for entry in entries if entry not in _SKIP]
    repeated = _repeated(names)
    if repeated:
        raise table.source.error(
            f"columns= names {', '.join(repeated)} more than once; name each once in columns="
        )
    if table.labels is not None:
        matches = [_match(table, name, len(entries) == count) for name in names]
        if len(names) == len(entries) and all(matches):
            return _picked(table.labels, names, matches)
        unknown = [name for name, match in zip(names, matches, strict=True) if not match]
        if len(entries) != count and unknown:
            stems = [split_unit(label)[0] for label in table.labels]
            near = difflib.get_close_matches(unknown[0], stems, 1)
            hint = f" (did you mean {near[0]}?)" if near else ""
            raise table.source.error(
                f"columns= asks for {', '.join(unknown)}{hint}, but the file has {', '.join(table.labels)}; "
                "choose from these in columns=, or give one name per column in order, with - to skip one"
            )
    if len(entries) != count:
        has = "no names" if table.labels is None else f"the names {', '.join(table.labels)}"
        raise table.source.error(
            f"columns= has {len(entries)} entries, but the file has {count} columns, with {has}; "
            "list names of the header in columns=, or one entry per column, with - to skip one"
        )
    found = [c for c in _recognised(entries) if entries[c.index] not in _SKIP]
    # Without a unit from the user, that of the header applies.
    units = [None] * count if table.labels is None else [split_unit(label)[1] for label in table.labels]
    return [replace(c, unit=c.unit or units[c.index]) for c in found]


def _picked(labels: Sequence[str], names: Sequence[str], matches: Sequence[Sequence[int]]) -> list[Column]:
    """Return the columns of a header that these names match, and its time stamps."""
    units: dict[int, str | None] = {}
    for name, match in zip(names, matches, strict=True):
        units |= dict.fromkeys(match, split_unit(name)[1])
    columns = together(_recognised(labels))
    kept = [c for c in columns if c.index in units or c.role in ("time", "counter")]
    return [replace(c, unit=units.get(c.index) or c.unit) for c in kept]


def _match(table: Table, name: str, by_position: bool) -> tuple[int, ...]:
    """Return the indices of the columns whose label, label without unit, or recognised name is `name`.

    The name of a sensor matches all its axes. If columns may be named by position, an ambiguous name matches
    none.
    """
    labels = table.labels or ()
    columns = together(_recognised(labels))
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
            first = labels[found[0]]
            raise table.source.error(
                f"columns= names {name!r}, which matches {listed}; use the full name, such as "
                f"columns='{first}', or name all columns in their order, - skips one"
            )
        if found:
            return found
    return ()


def _clock(
    table: Table, found: Sequence[Column], first: Columns, options: ReadOptions
) -> tuple[tuple[Column, ...], list[str]]:
    """Return the column of time stamps, or those of a pair, and notes; empty without any."""
    if options.timeless:
        return (), []
    wanted = options.time_column
    if wanted is not None:
        for key in ("label", "name"):
            named = [column for column in found if getattr(column, key).casefold() == wanted.casefold()]
            if len(named) == 1:
                return (named[0],), []
        listed = ", ".join(column.label for column in found)
        raise table.source.error(
            f"no time column {wanted!r} among {listed}; correct time=, or ignore the time stamps with "
            "time='none'"
        )
    # An empty column is not one.
    candidates = [c for c in found if c.role == "time" and (first[c.index] == first[c.index]).any()]
    if not candidates and (options.rate or table.rate):
        # Without a rate, the unit of a counter is unknown.
        counters = [c for c in found if c.role == "counter" and first[c.index].dtype.kind in "iu"]
        candidates = [c for c in counters if np.median(np.diff(first[c.index].astype(float))) > 0.0][:1]
    if not candidates and not (options.rate or table.rate):
        candidates = [c for c in found if c.role == "auxiliary" and are_times(first[c.index])]
    parts = {column.time_part: column for column in candidates if column.time_part is not None}
    choices: list[tuple[Column, ...]] = [(column,) for column in candidates]
    for (prefix, unit), column in parts.items():
        whole = parts.get((prefix, "s"))
        if unit != "s" and whole is not None and _are_parts(first[whole.index], first[column.index], unit):
            choices.append((whole, column))
    if not choices:
        return (), []

    def merit(choice: tuple[Column, ...]) -> tuple[int, int, bool]:
        # A pair is one clock; the stamp of a header is the time of sampling, others may be that of arrival.
        return len(choice), -unevenness(first[choice[0].index]), "header" in choice[0].label.lower()

    best = max(choices, key=merit)
    ignored = [column.label for column in candidates if column not in best]
    if not ignored:
        return best, []
    return best, [f"times from {' and '.join(c.label for c in best)}; {', '.join(ignored)} ignored"]


def _are_parts(seconds: Cells, parts: Cells, unit: str) -> bool:
    """Return whether times are whole seconds, and others, in a unit, always below a second."""
    if is_numeric(seconds) and (seconds % 1 > 0).any():
        return False
    return not is_numeric(parts) or not ((parts < 0) | (parts >= convert(1.0, "s", unit))).any()


def _check_is_recording(
    table: Table, found: Sequence[Column], axes: Sequence[Column], clock: Sequence[Column]
) -> None:
    """Raise RecordingError if a table has no axes, or is an Allan curve."""
    clusters = next((c for c in found if c.role == "cluster time"), None)
    if clusters is not None and not clock:
        raise table.source.error(
            f"column {clusters.label!r} has cluster times, so that this is an Allan curve and no recording; "
            "read it with read_curve, or give --curve to characterize and compare"
        )
    if not axes:
        some = _likely([column for column in found if column.role == "auxiliary"])
        # A clock of two columns keeps their names.
        clocks = {clock[0]: "time"} if len(clock) == 1 else {column: column.label for column in clock}
        names = ",".join((clocks | some).get(column, "-") for column in found)
        told = f" if {', '.join(column.label for column in some)} are these" if some else ""
        raise table.source.error(
            f"no gyro or accelerometer column among {', '.join(column.label for column in found)}; "
            f"name the columns in their order, - skips one, such as columns='{names}'{told}"
        )


def _likely(unknown: Sequence[Column]) -> dict[Column, str]:
    """Return columns that may be axes, and of which: those called x, y and z, or else the last ones."""
    named = [column for three in triads(unknown)[:2] for column in three]
    # Samples usually come last, of two sensors or of one.
    size = next((n for n in (6, 3) if len(unknown) >= n), len(unknown))
    chosen = named or unknown[len(unknown) - size :]
    names = EXAMPLE[1:]
    if named and chosen[0].name.casefold().startswith(("a", "f")):
        names = (*names[3:], *names[:3])
    proposed = dict(zip(chosen, names, strict=False))
    for first in range(0, len(chosen), 3):
        ends = {column: column.name[-1:].casefold() for column in chosen[first : first + 3]}
        if set(ends.values()) == set("xyz"):
            proposed |= {c: f"{proposed[c].rpartition('_')[0]}_{end}" for c, end in ends.items()}
    return proposed


def _check_all_used(
    table: Table, axes: Sequence[Column], clock: Sequence[Column], first: Columns, options: ReadOptions
) -> None:
    """Raise RecordingError if a unit was given that nothing has."""
    sensors = {column.sensor for column in axes}
    for sensor, unit in options.units.items():
        if unit is not None and sensor not in sensors and not table.complete:
            read = ", ".join(column.label for column in axes)
            others = "" if table.labels is None else f" among {', '.join(table.labels)}"
            name = "accelerometer" if sensor == "accel" else sensor
            raise table.source.error(
                f"{sensor}_unit= is given, but there is no {name}{others}; omit it, or name the columns with "
                f"columns=, one entry per column (axes are now {read})"
            )
    if options.time_unit is not None and not clock:
        named = ", or name their column with time=" if len(first) > len(axes) else ""
        raise table.source.error(f"time_unit= is given, but no time stamps are read; omit it{named}")


def _check_none_missed(
    table: Table, found: Sequence[Column], axes: Sequence[Column], clock: Sequence[Column], first: Columns
) -> None:
    """Raise RecordingError if only one sensor has been recognised, and other columns may be another one."""
    missing = [sensor for sensor in SENSORS if sensor not in {column.sensor for column in axes}]
    used = {column.index for column in (*axes, *clock)}
    others = [c for c in found if c.index not in used and c.role == "auxiliary" and _varies(first[c.index])]
    may_be = unclaimed(others, missing[0]) if len(missing) == 1 else ()
    if not may_be:
        return
    own = {column.index: _entry(column) for column in (*axes, *clock)}
    both = own | {c.index: name for c, name in zip(may_be, _NAMES[missing[0]], strict=False)}
    is_known = all(recognise(column.label).role != "auxiliary" for column in (*axes, *clock))
    others_only = axes[0].sensor if is_known else _in_order(own, len(first))
    what = "a gyro" if missing[0] == "gyro" else "an accelerometer"
    raise table.source.error(
        f"columns {', '.join(repr(column.label) for column in may_be)} may be {what}, but no name says so; "
        f"if they are, name all in their order, - skips one: columns='{_in_order(both, len(first))}', or "
        f"read only {', '.join(column.label for column in axes)} with columns='{others_only}'"
    )


def _varies(values: Cells) -> bool:
    """Return whether a column has numbers that are not all the same."""
    numbers = values[values == values] if values.dtype.kind in "fiu" else values[:0]
    return bool(numbers.size) and bool(numbers.min() < numbers.max())


def _entry(column: Column) -> str:
    """Return what stands for a column in a list of columns: its label, which says all about it."""
    return with_unit(column.name, column.unit) if "," in column.label else column.label


def _in_order(entries: Mapping[int, str], count: int) -> str:
    """Return a list of so many columns, - where there is no entry."""
    return ",".join(entries.get(k, "-") for k in range(count))


def _given(axes: Sequence[Column], options: ReadOptions) -> dict[Sensor, float]:
    """Return the sensors whose unit was given, and the factor from their labels' unit to it."""
    found: dict[Sensor, float] = {}
    for sensor, unit in options.units.items():
        labelled = next((recognise(c.label).unit for c in axes if c.sensor == sensor), None)
        if unit is not None:
            found[sensor] = 1.0
            with suppress(UnitError):
                found[sensor] = unit_scale(unit, sensor) / unit_scale(labelled or unit, sensor)
    return found


def _notes_on_others(auxiliary: Sequence[Column]) -> list[str]:
    """Return a note on columns that are no axes although their names begin with that of a gyro."""
    others = ", ".join(repr(column.label) for column in auxiliary if begins_with(column, "gyro"))
    return [f"{others} read beside the axes, as the names are not those of axes"] if others else []


def _notes_on(axes: Sequence[Column]) -> list[str]:
    """Return notes on a missing axis and on names."""
    notes = []
    for sensor in SENSORS:
        missing = {f"{sensor}_{axis}" for axis in "xyz"} - {axis.name for axis in axes}
        if len(missing) == 1:
            notes.append(f"no column for {missing.pop()}; the other two axes are read")
    renamed = [f"{c.name} from {c.label!r}" for c in axes if split_unit(c.label)[0] != c.name]
    if renamed:
        notes.append(f"axes: {', '.join(renamed)}")
    return notes

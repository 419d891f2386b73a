"""Tables whose rows are of several sensors or fields, which a column names."""

import re
from collections.abc import Iterator, Mapping
from dataclasses import replace

import numpy as np

from allanjax.base.errors import MixedRatesError
from allanjax.record.columns import recognise, split_unit, with_unit
from allanjax.record.io.options import ReadOptions
from allanjax.record.io.table import Columns, Table, is_numeric
from allanjax.record.io.times import unevenness
from allanjax.record.shapes import Cells, Chosen
from allanjax.record.units import SENSORS, Sensor
from allanjax.record.validation import MIN_SAMPLES

# Rows in which kinds are looked for, and the most kinds that there are.
_FIRST_ROWS, _MOST_KINDS = 1000, 50
_AXES = ("x", "y", "z")
#: Names of the columns of a long table, in which each row has one value, as InfluxDB writes it.
LONG = _TIME, _FIELD, _VALUE = ("_time", "_field", "_value")
# Names of columns that tell which of several sensors of one kind a row is of, and the most such sensors.
_NAMES = re.compile(
    r"(?:.*[\W_])?(?:sensor|imu|device|instance|board|node|module)s?"
    r"(?:[\W_]?(?:id|name|no|nr|num|number|index|idx))?|id|i",
    re.IGNORECASE,
)
_MOST_SENSORS = 16


def of_one_sensor(table: Table, columns: Columns, options: ReadOptions) -> tuple[Table, Columns]:
    """Return the rows of one sensor, if a column names that of each row; others unchanged.

    Raises:
        MixedRatesError: there are rows of gyros and of accelerometers, and none was chosen with `columns`.
        RecordingError: there are rows of several sensors, and none was chosen with `instance`.
    """
    if table.is_apart:
        return table, columns
    return _of_one_instance(*_of_one_kind(table, columns, options), options)


def _names_sensors(label: str) -> bool:
    """Return whether a column with this label may name the sensor of each row."""
    return _NAMES.fullmatch(split_unit(label)[0]) is not None and recognise(label).role == "auxiliary"


def named_later(table: Table, first: Columns, options: ReadOptions) -> dict[int, object]:
    """Return the columns that may name several sensors in later rows, and the one of all first rows."""
    if table.is_apart:
        return {}
    labels = enumerate(_labels_with(table, len(first), options))
    found = {k: first[k] for k, label in labels if _names_sensors(label)}
    return {k: column[0] for k, column in found.items() if (column == column[0]).all()}


def _of_one_instance(table: Table, columns: Columns, options: ReadOptions) -> tuple[Table, Columns]:
    """Return the rows of one of several sensors of one kind."""
    found = next(_instances(table, columns, options), None)
    wanted = None if options.instance is None else str(options.instance).strip()
    if found is None:
        if wanted is not None:
            raise table.source.error("no column names several sensors of one kind; omit instance=")
        return table, columns
    label, kinds = found
    if wanted not in kinds:
        told = f"column {label!r} names {len(kinds)} sensors: {', '.join(kinds)}"
        missing = "" if wanted is None else f", and not {wanted}"
        first = next(iter(kinds))
        example = first if first.isdigit() else f"'{first}'"
        raise table.source.error(f"{told}{missing}; choose one with instance={example}")
    rows = kinds[wanted]
    note = f"{rows.sum():,} of {len(rows):,} rows are of sensor {wanted}, as column {label!r} says"
    kept = tuple(column[rows] for column in columns)
    return _part(table, kept, table.labels, rows, note), kept


def _instances(
    table: Table, columns: Columns, options: ReadOptions
) -> Iterator[tuple[str, dict[str, Chosen]]]:
    """Yield columns that name the sensors of rows, and the rows of each.

    Such a column has the name of one, or splits rows that are not even in time into ones that are.
    """
    labels = _labels_with(table, len(columns), options)
    times = [x for x, label in zip(columns, labels, strict=True) if recognise(label).role == "time"]
    for label, column in zip(labels, columns, strict=True):
        if recognise(label).role != "auxiliary" or label in table.auxiliary:
            continue
        kinds = _kinds(column)
        if len(kinds) > 1 and (_names_sensors(label) or any(_are_apart(x, kinds) for x in times)):
            yield label, kinds


def _labels_with(table: Table, count: int, options: ReadOptions) -> tuple[str, ...]:
    """Return the labels of a table, or else those given for all its columns; "" for those without one."""
    given = options.columns or ()
    entries = tuple(given.split(",") if isinstance(given, str) else given)
    if len(entries) == count:
        return entries
    return table.labels or ("",) * count


def _kinds(column: Cells) -> dict[str, Chosen]:
    """Return the rows with each value of a column if these are few words or whole numbers; else {}."""
    is_number = column.dtype.kind in "iuf"
    # A few values show in some rows from all parts of the record.
    some = column[:: max(len(column) // _FIRST_ROWS, 1)]
    if not (is_number or column.dtype.kind in "OUS") or len(set(some.tolist())) > _MOST_SENSORS:
        return {}
    import pandas as pd

    codes, values = pd.factorize(column, sort=is_number)
    if len(values) > _MOST_SENSORS or (is_number and (values % 1).any()):
        return {}
    names = [f"{value:.0f}" if is_number else str(value).strip() for value in values]
    kinds = {name: codes == code for code, name in enumerate(names)}
    return {name: rows for name, rows in kinds.items() if np.count_nonzero(rows) >= MIN_SAMPLES}


def _are_apart(times: Cells, kinds: dict[str, Chosen]) -> bool:
    """Return whether times are even in each kind of rows, at the same time, but not in all."""
    own = [times[rows] for rows in kinds.values()]
    if times.dtype.kind not in "iufM" or not max(x[0] for x in own) < min(x[-1] for x in own):
        return False
    return unevenness(times) > 0 and not any(map(unevenness, own))


def _part(table: Table, columns: Columns, labels: tuple[str, ...] | None, rows: Chosen, note: str) -> Table:
    """Return a table of some of the rows of another one, with a note."""
    part = Table.of(columns, labels, table.source.at(rows), table.rate, (*table.notes, note))
    return replace(part, units=table.units, auxiliary=table.auxiliary, complete=table.complete)


def _of_one_kind(table: Table, columns: Columns, options: ReadOptions) -> tuple[Table, Columns]:
    """Return the rows of gyros or of accelerometers, with names of their axes; a long table with its fields.

    Other tables are unchanged.

    Raises:
        RecordingError: a long table has several values of a field at a time.
        MixedRatesError: there are rows of several sensors, and none was chosen with `columns`.
    """
    labels = table.labels or _labels(columns)
    if set(labels) >= set(LONG):
        return _wide(table, dict(zip(labels, columns, strict=True)))
    stems = [_last_of(label) for label in labels]
    words = [k for k, column in enumerate(columns) if not is_numeric(column) and column.dtype.kind != "M"]
    if not set(_AXES) <= set(stems) or not words:
        return table, columns
    for k in words:
        kinds = _sensors(columns[k])
        if not kinds:
            continue
        found = tuple(sensor for sensor in SENSORS if sensor in kinds.values())
        chosen = found[0] if len(found) == 1 else options.columns
        if chosen not in found:
            error = table.source.error(
                f"rows of {' and '.join(found)} alternate, as column {labels[k]!r} says; read one sensor "
                "with columns='gyro' or columns='accel'"
            )
            raise MixedRatesError(str(error), found)
        wanted = [kind for kind, sensor in kinds.items() if sensor == chosen]
        rows = np.isin(columns[k].astype(str), wanted)
        named = [_renamed(label, str(chosen)) for label in labels]
        # Several words for one kind may name several sensors.
        others = [i for i in range(len(columns)) if i != k or len(wanted) > 1]
        note = f"{rows.sum():,} of {len(rows):,} rows are of the {chosen}, as column {labels[k]!r} says"
        kept = tuple(columns[i][rows] for i in others)
        return _part(table, kept, tuple(named[i] for i in others), rows, note), kept
    return table, columns


def _wide(table: Table, columns: Mapping[str, Cells]) -> tuple[Table, Columns]:
    """Return a table with a column for each field of a long one, in the order of its times."""
    import pandas as pd

    frame = pd.DataFrame({name: columns[name] for name in LONG})
    repeated = np.flatnonzero(frame.duplicated([_TIME, _FIELD]))
    if repeated.size:
        row = int(repeated[0])
        raise table.source.error(
            f"several values of {frame[_FIELD][row]!r} at {frame[_TIME][row]} ({table.source.locate(row)}): "
            "the table has several series; export one of them"
        )
    wide = frame.pivot(index=_TIME, columns=_FIELD, values=_VALUE).loc[frame[_TIME].unique()]
    made = (wide.index.to_numpy(object), *(wide[name].to_numpy() for name in wide))
    labels = (_TIME, *map(str, wide))
    note = f"long table: {len(frame):,} rows have one value each, of {', '.join(labels[1:])}"
    rows = np.flatnonzero(~frame.duplicated([_TIME]))
    return _part(table, made, labels, rows, note), made


def _labels(columns: Columns) -> tuple[str, ...]:
    """Return labels for columns without names, by how many of them hold numbers."""
    numbers = sum(map(is_numeric, columns))
    names = {3: _AXES, 4: ("time", *_AXES)}.get(numbers, tuple(map(str, range(numbers))))
    own = iter(names)
    return tuple(next(own) if is_numeric(column) else f"column {k + 1}" for k, column in enumerate(columns))


def _sensors(column: Cells) -> dict[str, Sensor]:
    """Return the words in a column that name a sensor, and these sensors."""
    kinds = sorted(set(column[:_FIRST_ROWS].astype(str)))
    if len(kinds) > _MOST_KINDS:
        return {}
    named = {kind: recognise(kind).sensor for kind in kinds}
    return {kind: sensor for kind, sensor in named.items() if sensor is not None}


def _renamed(label: str, sensor: str) -> str:
    """Return the label of an axis with the name of its sensor; others unchanged."""
    axis, unit = _last_of(label), split_unit(label)[1]
    if axis not in _AXES:
        return label
    return with_unit(f"{sensor}_{axis}", unit)


def _last_of(label: str) -> str:
    """Return the last word of a label such as `values.x`."""
    return split_unit(label)[0].casefold().rpartition(".")[2]

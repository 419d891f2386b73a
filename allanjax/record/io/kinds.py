"""Tables whose rows are of several sensors or fields, which a column of words names."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from allanjax.base.errors import MixedRatesError
from allanjax.record.columns import recognise, split_unit, with_unit
from allanjax.record.io.options import ReadOptions
from allanjax.record.io.table import Columns, Table, is_numeric
from allanjax.record.shapes import Cells
from allanjax.record.units import SENSORS, Sensor

# Rows in which kinds are looked for, and the most kinds that there are.
_FIRST_ROWS, _MOST_KINDS = 1000, 50
_AXES = ("x", "y", "z")
#: Names of the columns of a long table, in which each row has one value, as InfluxDB writes it.
LONG = _TIME, _FIELD, _VALUE = ("_time", "_field", "_value")


def of_one_kind(table: Table, columns: Columns, options: ReadOptions) -> tuple[Table, Columns]:
    """Return the rows of one sensor, with names of its axes; a long table with a column per field.

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
        others = [i for i in range(len(columns)) if i != k]
        note = f"{rows.sum():,} of {len(rows):,} rows are of the {chosen}, as column {labels[k]!r} says"
        kept = tuple(columns[i][rows] for i in others)
        labels, notes = tuple(named[i] for i in others), (*table.notes, note)
        part = Table.of(kept, labels, table.source.at(rows), table.rate, notes)
        return replace(part, units=table.units), kept
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
    part = Table.of(made, labels, table.source.at(rows), table.rate, (*table.notes, note))
    return replace(part, units=table.units), made


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

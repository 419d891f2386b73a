"""Arrays, data frames and mappings as tables."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float

from allanjax.base.errors import AllanjaxError, RecordingError
from allanjax.record.columns import axes_of, default_names, recognise
from allanjax.record.io.options import ReadOptions
from allanjax.record.io.table import Table, spread
from allanjax.record.validation import Source, as_columns, check_names


def table_of(data: Any, options: ReadOptions) -> Table:
    """Return the table of a data frame, a mapping of columns, or an array [samples, axes].

    Raises:
        AllanjaxError: other data; an array without a unit or names.
        RecordingError: as for `table_of_array`.
    """
    columns = columns_of(data)
    if columns is not None:
        return table_of_frame(columns)
    values, _ = samples_in(data, options.rate)
    if options.gyro_unit is options.accel_unit is options.columns is None:
        raise AllanjaxError(
            'an array needs the unit of its samples: pass gyro_unit= or accel_unit=, e.g. gyro_unit="deg/s"'
        )
    return table_of_array(values, options.columns, options, Source("array"))


def table_of_frame(columns: Mapping[str, np.ndarray]) -> Table:
    """Return the table of a data frame's columns."""
    return Table.of(tuple(columns.values()), tuple(columns), Source("data frame"))


def table_of_array(
    values: Float[np.ndarray, "*shape"],
    names: str | Sequence[str] | None,
    options: ReadOptions,
    source: Source,
    auxiliary: Mapping[str, Any] | None = None,
) -> Table:
    """Return the table of an array of samples, one column per axis, with auxiliary columns beside them.

    Raises:
        RecordingError: another shape, or names or auxiliary columns that do not belong to it.
    """
    columns = tuple(as_columns(values, source).T)
    extra = {key: np.asarray(column) for key, column in (auxiliary or {}).items()}
    for key, column in extra.items():
        if column.shape != columns[0].shape:
            raise source.error(
                f"auxiliary column {key!r} has the shape {column.shape}, not {columns[0].shape}"
            )
    notes: tuple[str, ...] = ()
    if names is None:
        names = default_names(len(columns), options.units, source)
        notes = (f"column order taken as {', '.join(names)}",)
    check_names(names, "names=", source)
    if len(names) != len(columns):
        raise source.error(f"{len(names)} names for {len(columns)} columns; give one per column in names=")
    # A table may have other columns beside axes, an array may not.
    axes_of([recognise(label) for label in names], options.units, source)
    table = Table.of((*columns, *extra.values()), (*names, *extra), source, notes=notes)
    return replace(table, auxiliary=frozenset(extra), complete=True)


def is_frame(data: Any) -> bool:
    """Whether data are a data frame or a mapping, whose columns have names."""
    return isinstance(data, Mapping) or hasattr(data, "columns")


def columns_of(data: Any) -> dict[str, np.ndarray] | None:
    """Return the columns of a data frame (and its index if that holds times) or a mapping; else None."""
    if isinstance(data, Mapping):
        columns = {str(label): _as_array(column, str(label)) for label, column in data.items()}
        return _spread(columns) if all(column.ndim for column in columns.values()) else None
    if not hasattr(data, "columns"):
        return None
    columns = {}
    index = data.index
    label = str(index.name or ("time" if index.dtype.kind == "M" else ""))
    if recognise(label).role == "time":
        columns[label] = np.asarray(index)
    return columns | _spread({str(label): _as_array(data[label], str(label)) for label in data.columns})


def _spread(columns: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Columns in which those of arrays or lists are columns of their elements."""
    found: dict[str, np.ndarray] = {}
    for label, column in columns.items():
        try:
            found |= spread(label, column)
        except (TypeError, ValueError) as error:
            wrong = "cells are lists of different lengths or no numbers; give a column per axis"
            raise Source("data frame").error(f"column {label!r}: {wrong}") from error
    return found


def _as_array(values: Any, label: str) -> np.ndarray:
    """A column as an array; a masked or complex one as numbers."""
    special = isinstance(values, np.ma.MaskedArray) or np.iscomplexobj(values)
    return real_numbers(values, Source(f"column {label!r}")) if special else np.asarray(values)


def samples_in(data: Any, rate: float | None) -> tuple[Float[np.ndarray, "*shape"], float]:
    """Return samples as an array of floats, and their rate; AllanjaxError if they are none or have none."""
    from allanjax.record.io.chunks import ChunkedRecording

    remedy = (
        "pass what allanjax.read returns, a data frame, or an array with rate= and gyro_unit= or accel_unit="
    )
    if isinstance(data, ChunkedRecording):
        remedy = "use allanjax.accumulate(recording).fit(), or read all of it with allanjax.read"
    kind = type(data).__name__
    message = f"{'an' if kind[0] in 'AEIOaeio' else 'a'} {kind} is not a recording; {remedy}"
    try:
        values = real_numbers(data, Source("array"))
    except RecordingError:
        raise
    except (TypeError, ValueError) as error:
        raise AllanjaxError(message) from error
    if values.ndim == 0:
        raise AllanjaxError(message)
    if rate is None:
        raise AllanjaxError("an array needs its sample rate: pass rate= in Hz")
    return values, rate


def real_numbers(values: Any, source: Source) -> Float[np.ndarray, "*shape"]:
    """Values as an array of floats, nan where a masked array has none.

    Raises:
        RecordingError: complex numbers.
        TypeError, ValueError: other values than numbers.
    """
    if np.iscomplexobj(values):
        raise source.error("complex numbers are no samples; give their real part or their magnitude")
    if isinstance(values, np.ma.MaskedArray):
        return np.ma.filled(values.astype(float), np.nan)
    return np.asarray(values, dtype=float)

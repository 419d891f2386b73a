"""Recordings from whatever a user gives: arrays, lists, data frames, files."""

import os
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, TypeAlias, Union

import numpy as np
from jaxtyping import ArrayLike, Float

from allanjax.base.errors import AllanjaxError
from allanjax.record.columns import names_of, recognise
from allanjax.record.io import read
from allanjax.record.io.assembly import ChunkedRecording, assemble
from allanjax.record.io.options import GapChoice, ReadOptions
from allanjax.record.io.table import Table
from allanjax.record.recording import Axis, Recording
from allanjax.record.validation import Source, as_columns, check_rate, check_values

if TYPE_CHECKING:
    import pandas as pd

#: A recording as functions take it: itself, samples, a data frame or a path.
RecordingLike: TypeAlias = Union[
    Recording, ArrayLike, Sequence, Mapping[str, ArrayLike], "pd.DataFrame", str, os.PathLike[str]
]


def as_recording(
    data: RecordingLike,
    rate: float | None = None,
    gyro_unit: str | None = None,
    accel_unit: str | None = None,
    names: Sequence[str] | None = None,
    gaps: GapChoice | None = None,
) -> Recording:
    """Recording from samples, a data frame or a file; a recording is returned as it is.

    Args:
        data: a recording; samples [samples, axes] or [samples], as `Recording.from_array` takes them; a data
            frame or a mapping of columns, recognised by their names as those of a file; a file's path.
        rate, gyro_unit, accel_unit: sample rate [Hz] and units of the samples; a recording has its own, and
            columns may state theirs.
        names: names of the columns; for a data frame and a file the columns to take, as in `read`.
        gaps: what to do about samples that are missing, as in `read`; of an array those that are nan.

    Raises:
        RecordingError, UnitError: something is missing or wrong; the message says what to give.
        AllanjaxError: what is given is no recording.
    """
    if isinstance(data, Recording):
        given = {"rate": rate, "gyro_unit": gyro_unit, "accel_unit": accel_unit, "names": names}
        given["gaps"] = gaps
        superfluous = [name for name, value in given.items() if value is not None]
        if superfluous:
            raise AllanjaxError(
                f"a recording has its own rate, units and names, and no gaps: leave out "
                f"{', '.join(superfluous)}"
            )
        return data
    if isinstance(data, str | os.PathLike):
        return read(data, rate=rate, gyro_unit=gyro_unit, accel_unit=accel_unit, columns=names, gaps=gaps)
    options = ReadOptions(rate, gyro_unit, accel_unit, names, gaps=gaps)
    columns = _columns(data)
    if columns is not None:
        table = Table.of(tuple(columns.values()), tuple(columns), Source("data frame"))
        return assemble(table, "", options)
    values, rate = _samples(data, rate)
    if gyro_unit is None and accel_unit is None and names is None:
        raise AllanjaxError(
            'an array needs the unit of its samples: give gyro_unit= or accel_unit=, e.g. gyro_unit="deg/s"'
        )
    return Recording.from_array(
        values, rate, gyro_unit=gyro_unit, accel_unit=accel_unit, names=names, gaps=gaps or "error"
    )


def from_dataframe(
    frame: "pd.DataFrame",
    rate: float | None = None,
    *,
    gyro_unit: str | None = None,
    accel_unit: str | None = None,
    names: Sequence[str] | None = None,
) -> Recording:
    """Make a recording from a data frame; see `Recording.from_dataframe`."""
    return as_recording(frame, rate, gyro_unit, accel_unit, names)


def samples_of(
    data: RecordingLike,
    rate: float | None = None,
    gyro_unit: str | None = None,
    accel_unit: str | None = None,
    names: Sequence[str] | None = None,
) -> tuple[Float[np.ndarray, "samples axes"], float, tuple[Axis, ...] | None]:
    """Samples, rate [Hz] and axes of the data; axes are None for an array without units.

    Raises:
        RecordingError, UnitError, AllanjaxError: as `as_recording`; another shape.
    """
    told = isinstance(data, Recording | str | os.PathLike) or _columns(data) is not None
    if told or not gyro_unit is accel_unit is names is None:
        recording = as_recording(data, rate, gyro_unit, accel_unit, names)
        return recording.values, recording.rate, recording.axes
    samples, rate = _samples(data, rate)
    source = Source("array")
    return as_columns(samples, source), check_rate(rate, source), None


def living_samples(
    data: RecordingLike,
    rate: float | None,
    gyro_unit: str | None,
    accel_unit: str | None,
    names: Sequence[str] | None,
) -> tuple[Float[np.ndarray, "samples axes"], float, tuple[Axis, ...] | None]:
    """What `samples_of` gives; RecordingError for samples that are not finite, constant, or too few."""
    values, rate, axes = samples_of(data, rate, gyro_unit, accel_unit, names)
    name = data.name or "recording" if isinstance(data, Recording) else "array"
    check_values(values, names_of(axes, values.shape[1]), Source(name))
    return values, rate, axes


def _columns(data: Any) -> dict[str, np.ndarray] | None:
    """Columns of a data frame (with its index if it holds times) or a mapping; None for other data."""
    index: Any = getattr(data, "index", None)
    times = {}
    if hasattr(index, "dtype"):
        label = str(index.name or ("time" if index.dtype.kind == "M" else ""))
        if recognise(label).role == "time":
            times = {label: np.asarray(index)}
    if isinstance(data, Mapping):
        columns = {str(label): np.asarray(column) for label, column in data.items()}
        return columns if all(column.ndim for column in columns.values()) else None
    if not hasattr(data, "columns"):
        return None
    return times | {str(label): np.asarray(data[label]) for label in data.columns}


def _samples(data: Any, rate: float | None) -> tuple[np.ndarray, float]:
    """Samples as an array of floats, and their rate, which must be given."""
    remedy = (
        "give what allanjax.read returns, an array with rate= and gyro_unit= or accel_unit=, or a data frame"
    )
    if isinstance(data, ChunkedRecording):
        remedy = "accumulate it, allanjax.accumulate(recording).fit(), or read the whole with allanjax.read"
    kind = type(data).__name__
    message = f"{'an' if kind[0] in 'AEIOaeio' else 'a'} {kind} is no recording: {remedy}"
    try:
        values = np.asarray(data, dtype=float)
    except (TypeError, ValueError) as error:
        raise AllanjaxError(message) from error
    if values.ndim == 0:
        raise AllanjaxError(message)
    if rate is None:
        raise AllanjaxError("an array needs its sample rate: give rate in Hz")
    return values, rate

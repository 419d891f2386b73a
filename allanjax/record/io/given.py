"""Recordings from arrays, lists, data frames and files."""

import os
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, TypeAlias, Union

import numpy as np
from jaxtyping import ArrayLike, Float

from allanjax.base.errors import AllanjaxError, RecordingError
from allanjax.record.columns import names_of
from allanjax.record.io import read
from allanjax.record.io.chunks import ChunkedRecording
from allanjax.record.io.options import GapChoice
from allanjax.record.io.table import columns_of
from allanjax.record.recording import Axis, Recording
from allanjax.record.validation import Source, as_columns, check_rate, check_values, real_numbers

if TYPE_CHECKING:
    import pandas as pd

#: Data that functions accept as a recording: a recording, samples, a data frame or a path.
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
    """Return a recording from samples, a data frame or a file; a recording is returned unchanged.

    Args:
        data: a recording; samples [samples, axes] or [samples] as for `Recording.from_array`; a data frame or
            a mapping of columns, recognised by their names as in a file; the path of a file.
        rate, gyro_unit, accel_unit: sample rate [Hz] and units of the samples; a recording has its own, and
            columns may state theirs.
        names: names of the columns; for a data frame or a file the columns to use, as in `read`.
        gaps: what to do about missing samples, as in `read`; in an array these are nan.

    Raises:
        RecordingError, UnitError: something is missing or wrong; the message states what to give.
        AllanjaxError: the data are not a recording.
    """
    if isinstance(data, Recording):
        given = {"rate": rate, "gyro_unit": gyro_unit, "accel_unit": accel_unit, "names": names, "gaps": gaps}
        superfluous = [name for name, value in given.items() if value is not None]
        if superfluous:
            raise AllanjaxError(
                f"a recording has its own rate, units and names, and no gaps: omit {', '.join(superfluous)}"
            )
        return data
    if isinstance(data, str | os.PathLike):
        return read(data, rate=rate, gyro_unit=gyro_unit, accel_unit=accel_unit, columns=names, gaps=gaps)
    columns = columns_of(data)
    if columns is not None:
        return Recording.from_dataframe(
            columns, rate, gyro_unit=gyro_unit, accel_unit=accel_unit, names=names, gaps=gaps
        )
    values, rate = _samples(data, rate)
    if gyro_unit is None and accel_unit is None and names is None:
        raise AllanjaxError(
            'an array needs the unit of its samples: pass gyro_unit= or accel_unit=, e.g. gyro_unit="deg/s"'
        )
    return Recording.from_array(
        values, rate, gyro_unit=gyro_unit, accel_unit=accel_unit, names=names, gaps=gaps or "error"
    )


def samples_of(
    data: RecordingLike,
    rate: float | None = None,
    gyro_unit: str | None = None,
    accel_unit: str | None = None,
    names: Sequence[str] | None = None,
) -> tuple[Float[np.ndarray, "samples axes"], float, tuple[Axis, ...] | None]:
    """Return samples, rate [Hz] and axes of the data; axes are None for an array without units.

    Raises:
        RecordingError, UnitError, AllanjaxError: as for `as_recording`; another shape.
    """
    labelled = isinstance(data, Recording | str | os.PathLike) or columns_of(data) is not None
    if labelled or not gyro_unit is accel_unit is names is None:
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
    """Return `samples_of` the data; RecordingError if they are not finite, constant, or too few."""
    values, rate, axes = samples_of(data, rate, gyro_unit, accel_unit, names)
    name = data.name or "recording" if isinstance(data, Recording) else "array"
    check_values(values, names_of(axes, values.shape[1]), Source(name))
    return values, rate, axes


def _samples(data: Any, rate: float | None) -> tuple[np.ndarray, float]:
    """Return the samples as an array of floats, and their rate, which must be given."""
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

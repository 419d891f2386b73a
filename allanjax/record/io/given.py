"""Recordings from arrays, lists, data frames and files."""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias, Union

import numpy as np
from jaxtyping import ArrayLike, Float

from allanjax.base.errors import AllanjaxError
from allanjax.record.columns import names_of
from allanjax.record.io import table_at
from allanjax.record.io.memory import is_frame, samples_in, table_of
from allanjax.record.io.options import GapChoice, ReadOptions
from allanjax.record.recording import Recording, recording_of
from allanjax.record.validation import Source, as_columns, check_rate, check_values

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
    options = ReadOptions(rate, gyro_unit, accel_unit, names, gaps=gaps)
    if isinstance(data, str | os.PathLike):
        table, name = table_at(data, options)
    else:
        table, name = table_of(data, options), ""
    return recording_of(table, name, options)


@dataclass(frozen=True, eq=False)
class Samples:
    """Samples [samples, axes] in an array's own unit, and their rate [Hz]; there are no axes."""

    values: Float[np.ndarray, "samples axes"]
    rate: float
    axes: None = None


def samples_of(
    data: RecordingLike,
    rate: float | None = None,
    gyro_unit: str | None = None,
    accel_unit: str | None = None,
    names: Sequence[str] | None = None,
) -> Recording | Samples:
    """Return a recording as `as_recording` does, or the samples of an array without units.

    Raises:
        RecordingError, UnitError, AllanjaxError: as for `as_recording`; another shape.
    """
    named = is_frame(data) or isinstance(data, Recording | str | os.PathLike)
    if named or not gyro_unit is accel_unit is names is None:
        return as_recording(data, rate, gyro_unit, accel_unit, names)
    values, rate = samples_in(data, rate)
    source = Source("array")
    return Samples(as_columns(values, source), check_rate(rate, source))


def living_samples(
    data: RecordingLike,
    rate: float | None,
    gyro_unit: str | None,
    accel_unit: str | None,
    names: Sequence[str] | None,
) -> Recording | Samples:
    """Return `samples_of` the data; RecordingError if they are not finite, constant, or too few."""
    found = samples_of(data, rate, gyro_unit, accel_unit, names)
    name = found.name or "recording" if isinstance(found, Recording) else "array"
    check_values(found.values, names_of(found.axes, found.values.shape[1]), Source(name))
    return found

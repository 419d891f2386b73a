"""Reading and writing recordings."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from allanjax.base.errors import RecordingError, expect
from allanjax.record.io.options import GapChoice, ReadOptions, TimeChoice

if TYPE_CHECKING:
    from allanjax.record.io.table import Table
    from allanjax.record.recording import Recording

__all__ = ["ReadOptions", "read", "read_recording", "write"]


def read(
    path: str | os.PathLike[str],
    *,
    rate: float | None = None,
    gyro_unit: str | None = None,
    accel_unit: str | None = None,
    columns: str | Sequence[str] | None = None,
    time: TimeChoice = None,
    time_unit: str | None = None,
    start: float | None = None,
    stop: float | None = None,
    topic: str | None = None,
    instance: int | str | None = None,
    gaps: GapChoice | None = None,
    force: bool = False,
) -> Recording:
    """Read a static recording: text, NumPy, Parquet, HDF5, MATLAB, TDMS, a ROS bag or a flight log.

    Text may be gzip-compressed; a ROS 2 bag may be a folder; flight logs are PX4's .ulg and ArduPilot's .bin.
    If a package is missing, the message names the extra to install, e.g. `allanjax[ros]`.

    Columns are recognised by their names (`gyro_x`, `angular_velocity.x`, `ax`, `time`, ...), with units in
    brackets (`gyro_x [deg/s]`); other numeric columns become `auxiliary`. The recording's `notes` list the
    assumptions that were made.

    Args:
        path: the file, or the folder of a ROS 2 bag.
        rate: sample rate in Hz; needed without time stamps. Like the units and columns below, it overrides
            what the file states, and a note records that.
        gyro_unit: unit of the gyros, e.g. `deg/s`; for counts the size of one, `0.07 deg/s`, `deg/s/131`.
        accel_unit: unit of the accelerometers, e.g. `g`; for counts the size of one, `g/16384`.
        columns: column names to read, optionally with other units, or a sensor, `gyro`; or one name per
            column in order, with `-` to skip one; a list or comma-separated.
        time: name of the column of time stamps, or of a sample counter if the rate is known; `none` or
            False to ignore them; `uniform` for evenly spaced samples at their mean rate, also after a name,
            `t_boot,uniform`.
        time_unit: unit of the time stamps: s, ms, us, ns, min, h, `0.1 ms`.
        start: first time to read, in s from the file's first sample.
        stop: time to stop before, in s from the file's first sample.
        topic: topic of a ROS bag with several of sensor_msgs/Imu, or message of a flight log, e.g.
            `sensor_gyro`; two, separated by a comma, if gyros and accelerometers are separate.
        instance: number or name of the sensor in a file that has several: in a flight log by default the
            first; in a table as a column such as `sensor_id` says.
        gaps: what to do about missing samples, in the time stamps or as empty cells: "error", the default,
            reports where they are and what to do; "segments" reads the longest segment without gaps and
            keeps others for Allan deviations and noise terms (`others` of the recording, up to 15 of 64
            samples or more); "fill" draws them from their distribution given the others, and fits widen
            their intervals accordingly (see `completion`).

    Raises:
        RecordingError: the file or the arguments are unusable; the message states where and what to do.
        UnitError: a unit is missing, unknown or contradictory.
    """
    return read_recording(
        path,
        ReadOptions(
            rate, gyro_unit, accel_unit, columns, time, time_unit, start, stop, topic, instance, gaps, force
        ),
    )


def read_recording(path: str | os.PathLike[str], options: ReadOptions, label: str | None = None) -> Recording:
    """Read a static recording with these options, as `read` does; messages name the file `label`."""
    from allanjax.record.recording import recording_of

    table, name = table_at(path, options, label)
    return recording_of(table, name, options)


def table_at(
    path: str | os.PathLike[str], options: ReadOptions, label: str | None = None
) -> tuple[Table, str]:
    """Return the table of a file, and a name for its recording; messages name the file `label`."""
    from allanjax.record.io.formats import format_of, name_of
    from allanjax.record.validation import Source

    path = Path(path)
    source = Source(label or str(path))
    return format_of(path, source).table(path, source, options), name_of(path)


def write(recording: Recording, path: str | os.PathLike[str]) -> None:
    """Write a recording in its own units as .csv, .parquet or .npz, with a column `time [s]`.

    Raises:
        RecordingError: another suffix, or a folder that does not exist.
    """
    import numpy as np
    import pyarrow
    import pyarrow.csv
    import pyarrow.parquet

    from allanjax.record.recording import Recording

    expect(recording, Recording, "write takes a recording first, and then a path")
    path = Path(path)
    if path.is_dir():
        raise RecordingError(f"{path} is a folder; give a file, .csv, .parquet or .npz")
    if not path.parent.is_dir():
        raise RecordingError(f"{path}: there is no folder {path.parent}; create it, or write elsewhere")
    match path.suffix.lower():
        case ".csv":
            pyarrow.csv.write_csv(pyarrow.table(recording.columns), path)
        case ".parquet":
            pyarrow.parquet.write_table(pyarrow.table(recording.columns), path)
        case ".npz":
            with path.open("wb") as stream:
                np.savez(stream, **recording.columns)  # type: ignore[arg-type]
        case suffix:
            raise RecordingError(
                f"{path}: cannot write {suffix or 'a file without suffix'}; use .csv, .parquet or .npz"
            )

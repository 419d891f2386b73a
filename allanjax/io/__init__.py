"""Reading and writing recordings."""

import os
from collections.abc import Sequence
from pathlib import Path

from allanjax.io.assembly import assemble
from allanjax.io.binary import hdf5_error, read_mat, read_npy, read_npz, read_parquet
from allanjax.io.layout import TimeChoice
from allanjax.io.table import Table
from allanjax.io.text import read_text
from allanjax.io.writers import write
from allanjax.recording import Recording
from allanjax.validation import Source

__all__ = ["read", "write"]

_HDF5_MAGIC = b"\x89HDF\r\n\x1a\n"


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
) -> Recording:
    """Read a static recording: text (CSV, TSV, ..., also gzip), NumPy, Parquet, or MATLAB up to -v7.

    Columns are recognised by their names (`gyro_x`, `angular_velocity.x`, `ax`, `time`, ...), with units in
    brackets (`gyro_x [deg/s]`); other columns of numbers become `auxiliary`. `notes` of the recording say
    what was assumed.

    Args:
        path: the file.
        rate: sample rate in Hz; needed without time stamps, and checked against them if there are any.
        gyro_unit: unit of the gyros, e.g. `deg/s`, where the header has none.
        accel_unit: unit of the accelerometers, e.g. `g`, where the header has none.
        columns: names of the header to read, or one name per column in order, `-` to skip one; a list or
            comma-separated.
        time: name of the column of time stamps; `none` or False to ignore them.
        time_unit: unit of the time stamps: s, ms, us or ns.
        start: first time to read, in s from the file's first sample.
        stop: time to stop before, in s from the file's first sample.

    Raises:
        RecordingError: the file or the arguments are not usable; the message says where and what to do.
        UnitError: a unit is missing, unknown or contradictory.
    """
    path = Path(path)
    return assemble(
        _read_table(path),
        path.name.removesuffix(".gz").rsplit(".", 1)[0],
        rate=rate,
        gyro_unit=gyro_unit,
        accel_unit=accel_unit,
        columns=columns,
        time=time,
        time_unit=time_unit,
        start=start,
        stop=stop,
    )


def _read_table(path: Path) -> Table:
    """Read by what the file begins with, whatever its suffix."""
    label = str(path)
    source = Source(label)
    if path.is_dir():
        raise source.error("a directory; give a file")
    try:
        with path.open("rb") as stream:
            magic = stream.read(520)
    except FileNotFoundError as error:
        raise source.error("no such file; check the path") from error
    except OSError as error:
        raise source.error(
            f"can not be opened: {error.strerror}; check the file and its permissions"
        ) from error
    if not magic:
        raise source.error("the file is empty; give a file with one row of numbers per sample")
    if magic.startswith(b"PAR1"):
        return read_parquet(path, label)
    if magic.startswith(b"\x93NUMPY"):
        return read_npy(path, label)
    if magic.startswith(b"PK\x03\x04"):
        return read_npz(path, label)
    # MATLAB's -v7.3 has a text header of 512 bytes before the HDF5 file.
    if _HDF5_MAGIC in (magic[:8], magic[512:520]):
        raise hdf5_error(source)
    if magic.startswith(b"MATLAB") or path.suffix.lower() == ".mat":
        return read_mat(path, label)
    return read_text(path, label)

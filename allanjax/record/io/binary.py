"""Readers for binary files: NumPy, Parquet."""

import math
import re
import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from allanjax.record.columns import split_unit
from allanjax.record.io.table import Columns, Format, Table, check_claim, damage_reported
from allanjax.record.validation import Source

# Names of scalars that state the sample rate, or the sample interval.
_RATES = re.compile(r"(?:sample_?|sampling_?)?(?:rate|freq|frequency)|fs|f_s", re.IGNORECASE)
_INTERVALS = re.compile(r"dt|(?:sample|sampling)_?(?:interval|period|time)", re.IGNORECASE)
# Largest number of rows for which a much wider matrix counts as transposed.
_FEW_AXES = 12


def open_npy(path: Path, source: Source) -> Table:
    """Return an array [samples] or [samples, columns], or with named columns, through a memory map."""
    columns, labels = _npy_columns(path, source)
    n = len(columns[0])

    def rows(chunk: int) -> Iterator[Columns]:
        for first in range(0, n, chunk):
            # A new map for each chunk, because the pages of a map stay in memory as long as the map.
            columns, _ = _npy_columns(path, source)
            yield tuple(np.array(column[first : first + chunk]) for column in columns)

    return Table(rows, labels, source, n)


def _npy_columns(path: Path, source: Source) -> tuple[Columns, tuple[str, ...] | None]:
    """Return the columns of an .npy file through a memory map, and their names if it has any."""
    with damage_reported(source, ".npy", "save a plain array of numbers, and copy the whole file"):
        array = np.load(path, "r", allow_pickle=False)
        names = array.dtype.names
        if names and (array.ndim != 1 or any(array[name].dtype.kind not in "fiubMSU" for name in names)):
            raise source.error(f"the array has the dtype {array.dtype}; save columns of plain numbers")
    return tuple(array[name] for name in names) if names else _columns_of(array, "the array", source), names


def read_npz(path: Path, source: Source) -> Table:
    """Return named arrays: columns, `gyro` and `accel` [samples, 3], scalars `rate`, `fs` or `dt`."""
    if not zipfile.is_zipfile(path):
        raise source.error("a damaged .npz file or another archive; save it again, or save a workbook as CSV")
    with damage_reported(source, ".npz", "save plain arrays of numbers"):
        with zipfile.ZipFile(path) as archive:
            members = [member for member in archive.infolist() if member.filename.endswith(".npy")]
            if not members:
                raise source.error("a zip archive without NumPy arrays (a spreadsheet?); save it as CSV")
            check_claim(sum(member.file_size for member in members), path, source)
            for member in members:
                _check_member(archive, member, source)
        with np.load(path, allow_pickle=False) as arrays:
            named = {name: arrays[name] for name in arrays.files}
    return from_named(named, source)


def _check_member(archive: zipfile.ZipFile, member: zipfile.ZipInfo, source: Source) -> None:
    """Raise RecordingError if an array in an .npz file claims to be larger than its data."""
    with archive.open(member) as stream:
        old = np.lib.format.read_magic(stream) == (1, 0)
        read_header = np.lib.format.read_array_header_1_0 if old else np.lib.format.read_array_header_2_0
        shape, _, dtype = read_header(stream)
    if math.prod(shape) * dtype.itemsize > member.file_size:
        raise source.error(
            f"{member.filename!r} claims the shape {shape} but has {member.file_size} bytes; save it again"
        )


def open_parquet(path: Path, source: Source) -> Table:
    """Return all columns of a Parquet file."""
    import pyarrow.parquet as pq

    with damage_reported(source, "Parquet", "write the file again"), pq.ParquetFile(path) as file:
        n, labels = file.metadata.num_rows, tuple(file.schema_arrow.names)
        check_claim(n * len(labels), path, source)

    def rows(chunk: int) -> Iterator[Columns]:
        with damage_reported(source, "Parquet", "write the file again"), pq.ParquetFile(path) as file:
            for batch in file.iter_batches(min(chunk, max(n, 1))):
                yield tuple(column.to_numpy(zero_copy_only=False) for column in batch.columns)

    return Table(rows, labels, source, n)


def from_named(arrays: Mapping[str, np.ndarray], source: Source) -> Table:
    """Return a table of named arrays: columns, matrices [samples, columns], scalars that state the rate.

    Raises:
        RecordingError: the arrays do not fit together.
    """
    rate: float | None = None
    notes: list[str] = []
    columns: dict[str, np.ndarray] = {}
    matrices = 0
    for name, array in arrays.items():
        if array.dtype.kind not in "fiubM":
            notes.append(f"{name!r} skipped as it is not numeric")
        elif array.size == 1:
            stem = split_unit(name)[0].split(".")[-1]
            value = float(array.ravel()[0])
            if _RATES.fullmatch(stem) or (_INTERVALS.fullmatch(stem) and value):
                rate = value if _RATES.fullmatch(stem) else 1.0 / value
                notes.append(f"sample rate {rate:.9g} Hz from {name!r}")
        else:
            parts = _columns_of(array, repr(name), source)
            matrices += len(parts) > 1
            columns |= dict(zip(_labels(name, len(parts)), parts, strict=True))
    if not columns:
        raise source.error("no array of samples; save one column per axis, or gyro and accel [samples, 3]")
    lengths = {name: len(column) for name, column in columns.items()}
    if len(set(lengths.values())) > 1:
        listed = ", ".join(f"{name} {length}" for name, length in list(lengths.items())[:8])
        raise source.error(f"the arrays differ in length ({listed}); save arrays of the same length")
    # A single unnamed matrix is read like one in a .npy file.
    unnamed = (
        matrices == 1 and len(arrays) - (rate is not None) == 1 and not next(iter(columns)).endswith("_x")
    )
    labels = None if unnamed else tuple(columns)
    return Table.of(tuple(columns.values()), labels, source, rate, tuple(notes))


def _labels(name: str, count: int) -> tuple[str, ...]:
    """Return the labels of the columns of a named array."""
    if count == 1:
        return (name,)
    stem, unit = split_unit(name)
    ends = "xyz" if count == 3 else range(count)
    return tuple(f"{stem}_{end}" + (f" [{unit}]" if unit else "") for end in ends)


def _columns_of(array: np.ndarray, name: str, source: Source) -> Columns:
    """Return the columns of a vector (also [n, 1] or [1, n]) or of a matrix [samples, columns]."""
    if array.dtype.kind not in "fiubM":
        raise source.error(f"{name} has the dtype {array.dtype}; save an array of real numbers")
    if array.ndim == 2 and 1 in array.shape:
        array = array.ravel()
    if array.ndim == 1:
        return (array,)
    if array.ndim != 2:
        raise source.error(f"{name} has the shape {array.shape}; save it as [samples, columns]")
    rows, columns = array.shape
    if rows <= _FEW_AXES and columns > 4 * rows:
        raise source.error(f"{name} of shape {array.shape} seems transposed; save its transpose (array.T)")
    return tuple(array.T)


PARQUET = Format("parquet", lambda magic: magic.startswith(b"PAR1"), open_parquet, (".parquet",))
NPY = Format("npy", lambda magic: magic.startswith(b"\x93NUMPY"), open_npy, (".npy",))
NPZ = Format("npz", lambda magic: magic.startswith(b"PK\x03\x04"), read_npz, (".npz",), in_chunks=False)

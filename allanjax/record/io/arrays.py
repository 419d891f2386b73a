"""Readers for files of named arrays: NumPy, Parquet, MATLAB, HDF5 (by h5py), LabVIEW's TDMS (by nptdms)."""

import logging
import math
import re
import struct
import warnings
import zipfile
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from allanjax.base.errors import UnitError
from allanjax.record.columns import elements_of, recognise, split_unit, with_unit
from allanjax.record.io.table import (
    Columns,
    Format,
    Table,
    check_claim,
    damage_reported,
    optional_package,
    spread,
)
from allanjax.record.units import Sensor, is_unit, parse_sample_unit
from allanjax.record.validation import Source

# Names of scalars that state the sample rate, or the sample interval.
_RATES = re.compile(r"(?:sample_?|sampling_?)?(?:rate|freq|frequency)|fs|f_s", re.IGNORECASE)
_INTERVALS = re.compile(r"dt|(?:sample|sampling)_?(?:interval|period|time)", re.IGNORECASE)
# Names of texts that state the unit of a sensor.
_UNIT = re.compile(r"(?:.*\.)?(?:units?[._](\w+)|(\w+?)_?units?)", re.IGNORECASE)
# Largest number of rows for which a much wider matrix counts as transposed.
_FEW_AXES = 12
# Remedy in messages: other formats for the data.
_SAVE_AGAIN = "or in MATLAB save it with save('file.mat', ..., '-v7'), or save it as CSV, Parquet or .npz"
# Kinds of elements in a file, and the kinds in an array after its flags, shape and name.
_MATRIX, _COMPRESSED = 14, 15
_NUMBERS = frozenset({*range(1, 8), 9, 12, 13})
_TEXT = frozenset({*range(1, 8), 16, 17, 18})
_SPARSE = 5
# By class of an array, how many elements come first, and the kinds of the others: cells, structs and objects
# of arrays, text, and numbers. Unknown classes may have any kind.
_CLASSES = dict.fromkeys(range(16), (3, _NUMBERS)) | {4: (3, _TEXT)}
_CLASSES |= {kind: (names, frozenset({_MATRIX})) for kind, names in ((1, 3), (2, 5), (3, 6))}
# Flag for complex numbers.
_COMPLEX = 0x0800
_HEADER = 128


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
        if not names:
            return _columns_of(array, "the array", source), None
        fields = {name: array[name] for name in names}
        if array.ndim != 1 or any(x.dtype.kind not in "fiubMSU" or x.ndim > 2 for x in fields.values()):
            raise source.error(f"the array has the dtype {array.dtype}; save columns of plain numbers")
    every: dict[str, np.ndarray] = {}
    for name, values in fields.items():
        every |= spread(name, values)
    return tuple(every.values()), tuple(every)


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
                with archive.open(member) as stream:
                    npy = np.lib.format
                    old = npy.read_magic(stream) == (1, 0)
                    read_header = npy.read_array_header_1_0 if old else npy.read_array_header_2_0
                    header = read_header(stream)
                size = member.file_size
                if math.prod(header[0]) * header[2].itemsize > size:
                    claim = f"{member.filename!r} claims the shape {header[0]} but has {size} bytes"
                    raise source.error(f"{claim}; save it again")
        with np.load(path, allow_pickle=False) as arrays:
            named = {name: arrays[name] for name in arrays.files}
    return from_named(named, source)


def open_parquet(path: Path, source: Source) -> Table:
    """Return all columns of a Parquet file."""
    import pyarrow.parquet as pq

    with damage_reported(source, "Parquet", "write it again"), pq.ParquetFile(path) as file:
        n, labels = file.metadata.num_rows, tuple(file.schema_arrow.names)
        check_claim(n * len(labels), path, source)
        # Cells may be lists, whose length the first row tells.
        first = next(file.iter_batches(1), None)
        every = labels if first is None else tuple(_spread(labels, first.columns))

    def rows(chunk: int) -> Iterator[Columns]:
        # By default whole groups of rows are read before their first row.
        opened = pq.ParquetFile(path, pre_buffer=False, buffer_size=1 << 20)
        with damage_reported(source, "Parquet", "write it again"), opened as file:
            for batch in file.iter_batches(min(chunk, max(n, 1))):
                columns = _spread(labels, batch.columns)
                if tuple(columns) != every:
                    raise ValueError("the lists in a column differ in length")
                yield tuple(columns.values())

    return Table(rows, every, source, n)


def _spread(labels: Sequence[str], columns: Sequence[Any]) -> dict[str, np.ndarray]:
    """Return columns of a Parquet file by label, those of lists as columns of their elements."""
    found: dict[str, np.ndarray] = {}
    for label, column in zip(labels, columns, strict=True):
        found |= spread(label, _column(column))
    return found


def _column(column: Any) -> np.ndarray:
    """Return a column of a Parquet file; pyarrow's own conversion loads pandas, which takes long."""
    import pyarrow

    if column.null_count or not pyarrow.types.is_floating(column.type):
        return np.asarray(column.to_numpy(zero_copy_only=False))
    return np.from_dlpack(column)


def from_named(arrays: Mapping[str, np.ndarray], source: Source) -> Table:
    """Return a table of named arrays: columns, matrices [samples, columns], scalars that state the rate."""
    rate: float | None = None
    notes: list[str] = []
    columns: dict[str, np.ndarray] = {}
    matrices = 0
    units, unit_notes = stated_units(arrays)
    for name, array in arrays.items():
        if _UNIT.fullmatch(name) and unit_notes:
            continue
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
            labels = [name] if len(parts) == 1 else elements_of(name, len(parts))
            columns |= dict(zip(labels, parts, strict=True))
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
    named = None if unnamed else tuple(columns)
    return replace(Table.of(tuple(columns.values()), named, source, rate, (*notes, *unit_notes)), units=units)


def stated_units(values: Mapping[str, Any]) -> tuple[dict[Sensor, str], tuple[str, ...]]:
    """Return the units of sensors that texts called `gyro_unit`, `units.accel` or alike state, and notes."""
    units: dict[Sensor, str] = {}
    notes = []
    for name, value in values.items():
        match = _UNIT.fullmatch(name)
        sensor = recognise(match[1] or match[2]).sensor if match else None
        if sensor is not None:
            with suppress(UnitError):
                units[sensor] = parse_sample_unit(str(value), sensor).name
                notes.append(f"unit {units[sensor]} from {name!r}")
    return units, tuple(notes)


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


def open_hdf5(path: Path, source: Source) -> Table:
    """Return named datasets like the arrays of an .npz file; those in groups are named `group.dataset`."""
    with _opened(path, source) as file:
        datasets = _datasets(file)
        check_claim(sum(dataset.nbytes for dataset in datasets.values()), path, source)
        table = from_named({name: _outline(dataset) for name, dataset in datasets.items()}, source)
        names = [name for name, dataset in datasets.items() if _is_samples(dataset)]

    def rows(chunk: int) -> Iterator[Columns]:
        with _opened(path, source) as file:
            datasets = _datasets(file)
            for first in range(0, table.n or 0, chunk):
                part = slice(first, first + chunk)
                samples = (datasets[name] for name in names)
                blocks = (x[part] if _row_axis(x) == 0 else x[:, part].T for x in samples)
                yield tuple(column for x in blocks for column in x.reshape(len(x), -1).T)

    return replace(table, rows=rows)


@contextmanager
def _opened(path: Path, source: Source) -> Iterator[Any]:
    """Context of an opened HDF5 file; RecordingError if it cannot be read."""
    h5py = optional_package("h5py", "hdf5", "an HDF5 file (MATLAB -v7.3)", source, f", {_SAVE_AGAIN}")
    with damage_reported(source, "HDF5", f"copy it again, {_SAVE_AGAIN}"), h5py.File(path, "r") as file:
        yield file


def _datasets(file: Any) -> Mapping[str, Any]:
    """Return numeric datasets by name, without text and empty arrays, which MATLAB writes as numbers."""
    import h5py

    found: dict[str, Any] = {}

    def visit(name: str, item: Any) -> None:
        if not isinstance(item, h5py.Dataset) or name.startswith("#"):
            return
        if item.attrs.get("MATLAB_class") != b"char" and "MATLAB_empty" not in item.attrs:
            # A slash in a unit does not separate groups.
            named = re.sub(r"/(?![^\[]*\])", ".", name)
            stated = (item.attrs.get(key) for key in ("units", "unit"))
            unit = next((x for x in stated if isinstance(x, str) and is_unit(x)), None)
            found[with_unit(named, unit)] = item

    file.visititems(visit)
    return found


def _outline(dataset: Any) -> np.ndarray:
    """An array with the shape of a dataset, without its memory; the dataset itself if it has no rows."""
    if not _is_samples(dataset):
        return np.asarray(dataset[()])
    shape = dataset.shape if _row_axis(dataset) == 0 else dataset.shape[::-1]
    return np.broadcast_to(np.zeros((), dataset.dtype), shape[:1] if shape[1:] == (1,) else shape)


def _is_samples(dataset: Any) -> bool:
    """Return whether a dataset is an array of numbers, not a scalar."""
    return dataset.dtype.kind in "fiub" and dataset.size > 1


def _row_axis(dataset: Any) -> int:
    """Return the axis of the rows of a dataset; MATLAB transposes matrices, and vectors may be either."""
    if dataset.ndim != 2:
        return 0
    axis = int("MATLAB_class" in dataset.attrs)
    return 1 - axis if dataset.shape[axis] == 1 else axis


def read_mat(path: Path, source: Source) -> Table:
    """Named arrays of a MATLAB file up to -v7, as for an .npz file; fields of a struct are arrays, too."""
    from scipy.io import loadmat, whosmat

    with damage_reported(source, "a MATLAB file", "save it again with -v7"), warnings.catch_warnings():
        # Warnings mean damage, too.
        warnings.simplefilter("error", UserWarning)
        content = memoryview(path.read_bytes())
        # Files up to -v4 begin with a number, which has a zero byte, instead of a header.
        if 0 not in content[:4]:
            _check_elements(content, path, source)
        check_claim(sum(math.prod(shape) for _, shape, _ in whosmat(path)), path, source)
        contents = loadmat(path, simplify_cells=True)
    arrays = {key: value for key, value in contents.items() if not key.startswith("__")}
    return from_named(_flat(arrays), source)


def _flat(contents: Mapping[str, Any], prefix: str = "") -> dict[str, np.ndarray]:
    """Return arrays of nested structs by their dotted names."""
    flat: dict[str, np.ndarray] = {}
    for key, value in contents.items():
        if isinstance(value, Mapping):
            flat |= _flat(value, f"{prefix}{key}.")
        else:
            flat[prefix + key] = np.asarray(value)
    return flat


def _check_elements(content: memoryview, path: Path, source: Source) -> None:
    """Raise ValueError if an element has an invalid kind, which would crash the reading library."""
    order = "<" if content[_HEADER - 2 : _HEADER] == b"IM" else ">"
    claimed = 0
    for kind, payload in _elements(content[_HEADER:], order):
        if kind == _COMPRESSED:
            inflated = zlib.decompressobj().decompress(payload)
            claimed += len(inflated)
            check_claim(claimed, path, source)
            ((kind, payload),) = _elements(memoryview(inflated), order)
        if kind != _MATRIX:
            raise ValueError(f"an element of kind {kind} where an array is expected")
        _check_matrix(payload, order)


def _check_matrix(payload: memoryview, order: str) -> None:
    """Raise ValueError if an array, or a nested one, has an element of a kind its class does not allow."""
    elements = list(_elements(payload, order))
    if not elements:
        return
    flags = struct.unpack_from(f"{order}I", elements[0][1])[0]
    kind = flags & 0xFF
    names, allowed = _CLASSES.get(kind, (1, _NUMBERS | _TEXT | {_MATRIX}))
    # Elements with the numbers, of which a sparse array has two more for places, and a complex one twice.
    parts = 1 + bool(flags & _COMPLEX) + 2 * (kind == _SPARSE)
    if allowed <= _NUMBERS | _TEXT and len(elements) < names + parts:
        raise ValueError("an array without its numbers")
    for number, (kind, inner) in enumerate(elements):
        if kind not in (allowed if number >= names else _NUMBERS | _TEXT):
            raise ValueError(f"an element of kind {kind} in an array that does not allow it")
        if kind == _MATRIX:
            _check_matrix(inner, order)


def _elements(content: memoryview, order: str) -> Iterator[tuple[int, memoryview]]:
    """Yield kind and content of each element; for small ones, size and kind share four bytes."""
    place = 0
    while place + 8 <= len(content):
        kind, size = struct.unpack_from(f"{order}II", content, place)
        begin, step = place + 8, 8 + size
        if kind >> 16:
            kind, size = kind & 0xFFFF, kind >> 16
            begin, step = place + 4, 8
        if begin + size > len(content) or (step == 8 and size > 4):
            raise ValueError(f"an element of {size} bytes where only {len(content) - begin} remain")
        yield kind, content[begin : begin + size]
        place += step if kind == _COMPRESSED else (step + 7) // 8 * 8


def read_tdms(path: Path, source: Source) -> Table:
    """Return channels like the arrays of an .npz file, with their units and sample interval.

    If several groups have channels, these are named `group.channel`.
    """
    nptdms = optional_package("nptdms", "tdms", "a TDMS file", source)
    arrays: dict[str, np.ndarray] = {}
    damage: list[str] = []
    intervals = set()
    size = path.stat().st_size
    with (
        _warnings_kept(damage),
        damage_reported(source, "a TDMS file", "copy it again, or export it as CSV"),
        nptdms.TdmsFile.open(path) as file,
    ):
        groups = [group for group in file.groups() if any(len(channel) for channel in group.channels())]
        for group in groups:
            for channel in group.channels():
                if len(channel) > size:
                    raise source.error(
                        f"{channel.name!r} claims {len(channel)} samples in {size} bytes; copy it again"
                    )
                name = channel.name if len(groups) == 1 else f"{group.name}.{channel.name}"
                unit = str(channel.properties.get("unit_string", "")).strip()
                if len(channel):
                    arrays[with_unit(name, unit)] = channel[:]
                    intervals.add(float(channel.properties.get("wf_increment", 0.0)))
    if len(intervals) == 1 and min(intervals) > 0.0:
        arrays["dt"] = np.array(intervals.pop())
    table = from_named(arrays, source)
    notes = [f"the file is damaged: {warning}" for warning in damage[:1]]
    return replace(table, notes=(*notes, *table.notes))


@contextmanager
def _warnings_kept(kept: list[str]) -> Iterator[None]:
    """Context in which nptdms appends its warnings to a list instead of printing them."""
    from nptdms.log import log_manager

    def keep(record: logging.LogRecord) -> bool:
        kept.append(record.getMessage()[:200])
        return False

    log_manager.console_handler.addFilter(keep)
    try:
        yield
    finally:
        log_manager.console_handler.removeFilter(keep)


PARQUET = Format("parquet", b"PAR1", open_parquet, (".parquet",))
NPY = Format("npy", b"\x93NUMPY", open_npy, (".npy",))
NPZ = Format("npz", b"PK\x03\x04", read_npz, (".npz",), in_chunks=False)
HDF5 = Format(
    "hdf5",
    # MATLAB's -v7.3 has a text header of 512 bytes before the HDF5 file.
    lambda magic: b"\x89HDF\r\n\x1a\n" in (magic[:8], magic[512:520]),
    open_hdf5,
    (".h5", ".hdf5"),
)
MAT = Format("mat", b"MATLAB", read_mat, (".mat",), in_chunks=False)
TDMS = Format("TDMS", b"TDSm", read_tdms, (".tdms",), in_chunks=False)

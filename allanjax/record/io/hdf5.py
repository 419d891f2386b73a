"""Reader for HDF5 files, including MATLAB -v7.3; it requires h5py."""

import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from allanjax.record.io.binary import from_named
from allanjax.record.io.table import Columns, Format, Table, check_claim, damage_reported
from allanjax.record.validation import Source

# Remedy in messages: other formats for the data.
_SAVE_AGAIN = "or in MATLAB save it with save('file.mat', ..., '-v7'), or save it as CSV, Parquet or .npz"


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
                blocks = (_rows(datasets[name], slice(first, first + chunk)) for name in names)
                yield tuple(column for x in blocks for column in x.reshape(len(x), -1).T)

    return replace(table, rows=rows)


@contextmanager
def _opened(path: Path, source: Source) -> Iterator[Any]:
    """Context of an opened HDF5 file; RecordingError if it cannot be read."""
    try:
        import h5py
    except ModuleNotFoundError as error:
        raise source.error(
            'reading an HDF5 file (MATLAB -v7.3) requires h5py: pip install "allanjax[hdf5]", ' + _SAVE_AGAIN
        ) from error
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
            found[re.sub(r"/(?![^\[]*\])", ".", name)] = item

    file.visititems(visit)
    return found


def _rows(dataset: Any, rows: slice) -> np.ndarray:
    """Return rows of a dataset, [rows] or [rows, columns]."""
    return dataset[rows] if _row_axis(dataset) == 0 else dataset[:, rows].T


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


def _begins(magic: bytes) -> bool:
    # MATLAB's -v7.3 has a text header of 512 bytes before the HDF5 file.
    return b"\x89HDF\r\n\x1a\n" in (magic[:8], magic[512:520])


HDF5 = Format("hdf5", _begins, open_hdf5, (".h5", ".hdf5"))

"""Columns of a file as they were read, before their meaning is known."""

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Shaped

from allanjax.record.validation import Source, bad_cells_message


@dataclass(frozen=True)
class Table:
    """Columns of equal length, read from a file.

    Attributes:
        columns: numbers, datetime64, or objects where a text file has text.
        labels: labels of the columns, or None if the file has no names.
        source: origin of the columns.
        rate: sample rate in Hz that the file itself states, if any.
        notes: actions of the reader that the user should know.
    """

    columns: tuple[Shaped[np.ndarray, " samples"], ...]
    labels: tuple[str, ...] | None
    source: Source
    rate: float | None = None
    notes: tuple[str, ...] = ()

    def label(self, index: int) -> str:
        """Label of a column, or its place (from 1) if the file has no names."""
        return f"column {index + 1}" if self.labels is None else self.labels[index]


@dataclass(frozen=True)
class ChunkedTable:
    """Columns that are read some rows at a time.

    Attributes:
        rows: function of a number of rows: iterator over the columns of successive stretches, none longer.
        n: number of rows in all, if the file states it.
        labels, source, rate, notes: as in `Table`.
    """

    rows: Callable[[int], Iterator[tuple[Shaped[np.ndarray, " samples"], ...]]]
    n: int | None
    labels: tuple[str, ...] | None
    source: Source
    rate: float | None = None
    notes: tuple[str, ...] = ()

    def head(self, columns: tuple[Shaped[np.ndarray, " samples"], ...]) -> Table:
        """Table of the first rows, whose columns are given."""
        return Table(columns, self.labels, self.source, self.rate, self.notes)


@dataclass(frozen=True)
class Format:
    """A kind of file: how it is recognised and read.

    Attributes:
        name: what messages call it, a usual suffix.
        begins: whether a file with these first 520 bytes and this path is of the kind.
        read: its table; the second argument is what messages name the file.
        chunked: its table some rows at a time; None if it is read as a whole only.
    """

    name: str
    begins: Callable[[bytes, Path], bool]
    read: Callable[[Path, str], Table]
    chunked: Callable[[Path, str], ChunkedTable] | None = None


def is_numeric(values: Shaped[np.ndarray, " samples"]) -> bool:
    """Whether a column has a dtype of real numbers or booleans."""
    return values.dtype.kind in "fiub"


def as_float(values: Shaped[np.ndarray, " samples"], label: str, source: Source) -> np.ndarray:
    """Column as floats; NaN stays, as does a column without a single value.

    Raises:
        RecordingError: a cell is text that is no number.
    """
    if is_numeric(values):
        return values.astype(float)
    import pandas as pd

    numbers = np.asarray(pd.to_numeric(pd.Series(values, dtype=object), errors="coerce"), dtype=float)
    bad = np.flatnonzero(np.isnan(numbers))
    if bad.size and not pd.isna(values).all():
        cell = values[bad[0]]
        text = source.missing if pd.isna(cell) else repr(cell)
        if re.fullmatch(r"\s*[+-]?\d+,\d+\s*", str(cell)):
            text += " (write numbers with a decimal point)"
        raise source.error(bad_cells_message(label, bad.size, source.locate(int(bad[0])), text))
    return numbers

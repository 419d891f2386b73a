"""Columns of a file before they are identified."""

import re
import sys
from collections.abc import Callable, Container, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from jaxtyping import Float, Shaped

from allanjax.base.errors import AllanjaxError
from allanjax.record.columns import elements_of
from allanjax.record.io.options import ReadOptions
from allanjax.record.shapes import Cells
from allanjax.record.units import SENSORS, Sensor
from allanjax.record.validation import Source, bad_cells

#: Columns of equal length: numbers, datetime64, or objects where a text file has text.
Columns: TypeAlias = tuple[Shaped[np.ndarray, " rows"], ...]
#: Options that select one of several recordings in a file.
CHOICES = ("topic", "instance")
# Largest plausible factor of compression: that of deflate, the most common, is below 1033.
_EXPANSION = 1100
# In a file that claims so many bytes nothing but constant numbers is compressed by more than this factor.
_LARGE, _EXPANSION_OF_LARGE = 1 << 30, 100


@dataclass(frozen=True)
class Table:
    """Columns of equal length that are read some rows at a time.

    Attributes:
        rows: function of a number of rows: iterator over the columns of successive parts, none longer.
        labels: labels of the columns, or None if the file has no names.
        source: origin of the columns.
        n: total number of rows, if the file states it.
        rate: sample rate in Hz that the file states, if any.
        notes: actions of the reader that users should know; complete when all rows have been read.
        units: unit of each sensor as the format defines it, for use without a unit in labels or options.
        auxiliary: labels of columns that are no axes, whatever their names.
        complete: whether all axes were named by the caller, so that no unit is meant for an unknown column.
        is_apart: whether the format keeps sensors apart, so that no column names the sensors of rows.
    """

    rows: Callable[[int], Iterator[Columns]]
    labels: tuple[str, ...] | None
    source: Source
    n: int | None = None
    rate: float | None = None
    notes: Sequence[str] = ()
    units: Mapping[Sensor, str] = field(default_factory=dict)
    auxiliary: frozenset[str] = frozenset()
    complete: bool = False
    is_apart: bool = False

    @classmethod
    def of(
        cls,
        columns: Columns,
        labels: tuple[str, ...] | None,
        source: Source,
        rate: float | None = None,
        notes: tuple[str, ...] = (),
    ) -> "Table":
        """Return a table of columns in memory."""
        n = len(columns[0]) if columns else 0

        def rows(chunk: int) -> Iterator[Columns]:
            for first in range(0, n, chunk):
                yield tuple(column[first : first + chunk] for column in columns)

        return cls(rows, labels, source, n, rate, notes)

    def columns(self) -> Columns:
        """Return all rows."""
        parts = list(self.rows(sys.maxsize))
        if not parts:
            raise self.source.no_rows()
        return parts[0] if len(parts) == 1 else tuple(map(np.concatenate, zip(*parts, strict=True)))

    def units_with(self, options: ReadOptions, labelled: Container[Sensor]) -> dict[Sensor, str | None]:
        """Return the unit of each sensor: of the options, or of the file for one without labelled units."""
        given = {sensor: unit for sensor, unit in options.units.items() if unit is not None}
        own = {sensor: unit for sensor, unit in self.units.items() if sensor not in labelled}
        return {**dict.fromkeys(SENSORS), **own, **given}


@dataclass(frozen=True)
class Format:
    """A kind of file: how it is recognised and read.

    Attributes:
        name: name in messages, a usual suffix.
        begins: first bytes of such files, or whether a file with these first 520 bytes is of this kind.
        open: function that returns the table of a file; RecordingError if it is damaged.
        suffixes: suffixes that identify a binary file whose first bytes are unknown.
        in_chunks: whether the table can be read some rows at a time.
        choices: further options for `open`, since such files hold several recordings.
    """

    name: str
    begins: bytes | tuple[bytes, ...] | Callable[[bytes], bool]
    open: Callable[..., Table]
    suffixes: tuple[str, ...] = ()
    in_chunks: bool = True
    choices: tuple[str, ...] = ()

    def matches(self, magic: bytes) -> bool:
        """Return whether a file with these first 520 bytes is of this kind."""
        return self.begins(magic) if callable(self.begins) else magic.startswith(self.begins)

    def table(self, path: Path, source: Source, options: ReadOptions) -> Table:
        """Return the table of a file of this kind."""
        # Rows of a table may be of several sensors.
        refused = [name for name in CHOICES if name not in self.choices and (self.choices or name == "topic")]
        for name in refused:
            if getattr(options, name) is not None:
                raise source.error(f"a file of this kind ({self.name}) has no {name}s; omit {name}=")
        return self.open(path, source, **{name: getattr(options, name) for name in self.choices})


def optional_package(name: str, extra: str, kind: str, source: Source, otherwise: str = "") -> Any:
    """Return a package that reads a kind of file; RecordingError with the extra to install if missing."""
    try:
        return import_module(name)
    except ModuleNotFoundError as error:
        package = f'{name.partition(".")[0]}: pip install "allanjax[{extra}]"{otherwise}'
        raise source.error(f"reading {kind} requires {package}") from error


@contextmanager
def damage_reported(source: Source, kind: str, remedy: str) -> Iterator[None]:
    """Context that turns any error of a library about a damaged file into a RecordingError.

    Libraries raise nearly anything for damaged files: errors of indices, memory or arithmetic.
    """
    try:
        yield
    except AllanjaxError:
        raise
    except Exception as error:
        reason = " ".join(str(error).split())[:200].rstrip(".") or type(error).__name__
        raise source.error(f"cannot be read as {kind}: {reason}; {remedy}") from error


def spread(label: str, values: Cells) -> dict[str, Cells]:
    """Return the columns of an array [rows, elements] or of cells that are lists; another column as it is.

    Raises:
        ValueError: the lists differ in length, or hold other values than numbers.
    """
    first = next((cell for cell in values if cell is not None), None) if values.dtype.kind == "O" else None
    if isinstance(first, list | tuple | np.ndarray):
        missing = [np.nan] * len(first)
        values = np.array([missing if cell is None else cell for cell in values], float)
    if values.ndim != 2:
        return {label: values}
    return dict(zip(elements_of(label, values.shape[1]), values.T, strict=True))


def is_numeric(values: Cells) -> bool:
    """Return whether a column has a dtype of real numbers or booleans."""
    return values.dtype.kind in "fiub"


def check_claim(claimed: int, path: Path, source: Source) -> None:
    """Raise RecordingError if a file claims more bytes than it can hold, before memory is allocated."""
    size = path.stat().st_size
    if claimed > (_EXPANSION if claimed < _LARGE else _EXPANSION_OF_LARGE) * size:
        raise source.error(
            f"the file claims to hold {claimed} bytes but has only {size}: it is damaged, or its numbers are "
            "all equal; copy it again"
        )


def floats(values: Shaped[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
    """Return numbers as float64; a damaged one may be a nan whose conversion would warn."""
    with np.errstate(invalid="ignore"):
        return values.astype(float, copy=False)


def as_float(values: Cells, label: str, source: Source, gaps: bool = False) -> np.ndarray:
    """Return a column as floats; NaN is kept, and columns without any value; with `gaps`, empty cells."""
    if is_numeric(values):
        return floats(values)
    import pandas as pd

    numbers = np.asarray(pd.to_numeric(pd.Series(values, dtype=object), errors="coerce"), dtype=float)
    bad = np.flatnonzero(np.isnan(numbers) & ~pd.isna(values) if gaps else np.isnan(numbers))
    if bad.size and not pd.isna(values).all():
        cell = values[bad[0]]
        comma = re.fullmatch(r"\s*[+-]?\d+,\d+\s*", str(cell))
        text = repr(cell) + (" (write numbers with a decimal point)" if comma else "")
        raise bad_cells(label, bad.size, int(bad[0]), source, None if pd.isna(cell) else text)
    return numbers

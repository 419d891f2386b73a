"""Readers for text files: columns with or without a header, and lines of VectorNav sensors."""

import csv
import functools
import gzip
import io
import itertools
import re
import zlib
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import IO, TYPE_CHECKING

import numpy as np
from jaxtyping import Bool

from allanjax.record.columns import recognise, split_unit
from allanjax.record.io.table import Columns, Format, Table, damage_reported
from allanjax.record.units import is_unit
from allanjax.record.validation import Source

if TYPE_CHECKING:
    import pandas as pd

# First bytes of a gzip-compressed file, and marks at the start of comments.
_GZIP_MAGIC = b"\x1f\x8b"
_COMMENT_MARKS = ("#", "%", "//")
_SAVE_AGAIN = "copy, save or compress it again"
# Excel's line that names the delimiter, and a line before the data that states the sample rate.
_SEP = re.compile(r"\"?sep=(.)\"?\s*", re.IGNORECASE)
_RATE = re.compile(
    r"(?:(?:sampl\w*|update|output data)[\s_]*(?:rate|freq\w*)|\bodr)\W*(?:hz\W+)?"
    r"(\d+(?:\.\d+)?)\s*(k?)(?:hz|sps)?\W*$",
    re.IGNORECASE,
)
# Lines that are searched for the first row of numbers.
_LINES_BEFORE_DATA = 1000
# Lines between column names and data, one of which has units.
_LINES_OF_UNITS = 3
# Largest number of bytes in the last line.
_LONGEST_LINE = 1 << 16
# Lines of numbers with decimal commas, and possibly whole numbers.
_COMMA_NUMBER = r"[+-]?\d+(?:,\d+)?(?:[eE][+-]?\d+)?"
_DECIMAL_COMMA = re.compile(rf"\s*{_COMMA_NUMBER}(?:[\s;]+{_COMMA_NUMBER})*\s*;?\s*")
# Fields of VectorNav's messages.
_GYRO = tuple(f"gyro_{axis} [rad/s]" for axis in "xyz")
_ACCEL = tuple(f"accel_{axis} [m/s²]" for axis in "xyz")
_MAG = tuple(f"mag_{axis} [gauss]" for axis in "xyz")
_ANGLES = tuple(f"{angle} [deg]" for angle in ("yaw", "pitch", "roll"))
# Fields of messages with samples.
_FIELDS = {
    b"$VNYMR": (*_ANGLES, *_MAG, *_ACCEL, *_GYRO),
    b"$VNQMR": (*(f"quaternion_{k}" for k in range(4)), *_MAG, *_ACCEL, *_GYRO),
    b"$VNMAR": (*_MAG, *_ACCEL, *_GYRO),
    b"$VNIMU": (*_MAG, *_ACCEL, *_GYRO, "temperature [degC]", "pressure [kPa]"),
    b"$VNDTV": (
        "interval [s]",
        *(f"delta_theta_{axis} [deg]" for axis in "xyz"),
        *(f"delta_vel_{axis} [m/s]" for axis in "xyz"),
    ),
    b"$VNGYR": _GYRO,
    b"$VNACC": _ACCEL,
}
_VECTORNAV_LINE = re.compile(rb"(?:^|\n)\$VN[A-Z]{3},")
# Fields of sensor_msgs/Imu as `ros2 topic echo --csv` prints them, without names.
_ROS_IMU = (
    *("header.stamp.sec", "header.stamp.nanosec", "header.frame_id"),
    *(f"orientation.{part}" for part in "xyzw"),
    *(f"orientation_covariance_{k}" for k in range(9)),
    *(f"angular_velocity.{axis} [rad/s]" for axis in "xyz"),
    *(f"angular_velocity_covariance_{k}" for k in range(9)),
    *(f"linear_acceleration.{axis} [m/s²]" for axis in "xyz"),
    *(f"linear_acceleration_covariance_{k}" for k in range(9)),
)
# Exclusive or of the bytes after the $, in two hexadecimal digits at the end of a line.
_ENDED = re.compile(rb"\*([0-9A-Fa-f]{2})\s*$")


@dataclass(frozen=True)
class _Layout:
    """Layout of a text file; `start` is the index of the first line of data."""

    start: int
    labels: tuple[str, ...] | None
    fields: int
    delimiter: str | None
    comment: str
    encoding: str
    compressed: bool
    decimal: str = "."
    rate: float | None = None
    notes: tuple[str, ...] = ()


def open_text(path: Path, source: Source) -> Table:
    """Return the table of a text file, gzip-compressed or not."""
    import pandas as pd

    with damage_reported(source, "text", _SAVE_AGAIN):
        layout = _layout(path, source)
    # Samples are located by lines of the file.
    source = Source(
        source.label,
        lambda row: f"line {next(itertools.islice(_rows(path, layout), row, None))[0]}",
        "nan, an empty cell, or a row cut short",
    )

    cut, notes = _cut_line(path, layout), layout.notes
    if cut:
        notes += (f"the file ends within a line, which is left out: {cut[:60]!r}",)

    def rows(chunk: int) -> Iterator[Columns]:
        with damage_reported(source, "text", _SAVE_AGAIN):
            try:
                frames = pd.read_csv(
                    path,
                    chunksize=chunk,
                    sep=r"\s+" if layout.delimiter is None else layout.delimiter,
                    header=None,
                    skiprows=layout.start,
                    decimal=layout.decimal,
                    comment=layout.comment,
                    skipinitialspace=True,
                    low_memory=False,
                    encoding=layout.encoding,
                    encoding_errors="replace",
                    compression="gzip" if layout.compressed else None,
                )
                with frames:
                    held = next(frames, None)
                    while held is not None:
                        frame, held = held, next(frames, None)
                        columns = _columns(frame, path, layout, source)
                        if held is None and cut:
                            columns = tuple(column[:-1] for column in columns)
                        if len(columns[0]):
                            yield columns
            except pd.errors.ParserError as error:
                raise source.error(_ragged_row(path, layout) or f"cannot be read: {error}") from error

    return Table(rows, layout.labels, source, rate=layout.rate, notes=notes)


def growing_text(batches: Iterator[bytes], source: Source) -> Iterator[Table]:
    """Yield tables of text that comes in batches of whole lines, the first of which have the header.

    The rows of a table come as long as batches do. Where reading ended at an error, the next table begins
    with the next batch.
    """
    head = b""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "lines.txt"

        def table_of(lines: bytes) -> Table:
            path.write_bytes(head + lines)
            return open_text(path, source)

        def rows(first: Columns, _: int) -> Iterator[Columns]:
            yield first
            for batch in batches:
                yield table_of(batch).columns()

        for batch in batches:
            table = table_of(batch)
            if not head:
                head = b"".join(batch.splitlines(keepends=True)[: _layout(path, source).start])
            # A line is counted from the start of its batch, which nobody can look up.
            place = Source(source.label, missing="nan or an empty cell")
            yield replace(table, rows=functools.partial(rows, table.columns()), source=place)


def _cut_line(path: Path, layout: _Layout) -> str:
    """Return the last line if the file ends within it, as when a logger is switched off, else ""."""
    if layout.compressed or layout.encoding == "utf-16":
        return ""
    with path.open("rb") as stream:
        stream.seek(max(stream.seek(0, io.SEEK_END) - _LONGEST_LINE, 0))
        lines = stream.read().decode(layout.encoding, "replace").split("\n")
    fields = _split(lines[-1], layout.delimiter)
    short = len(lines) > layout.start + 1 and len(fields) < layout.fields
    return lines[-1].strip() if short and not _is_comment(lines[-1]) else ""


def _columns(frame: "pd.DataFrame", path: Path, layout: _Layout, source: Source) -> Columns:
    """Return as many columns of a data frame as the layout has."""
    columns = [frame[name].to_numpy() for name in frame.columns]
    # A delimiter at the end of every line adds an empty column.
    if len(columns) == layout.fields + 1 and frame[layout.fields].isna().all():
        columns.pop()
    if len(columns) != layout.fields:
        raise source.error(_ragged_row(path, layout) or f"{len(columns)} columns for {layout.fields} names")
    return tuple(columns)


def _layout(path: Path, source: Source) -> _Layout:
    """Return the layout of a file, from its first lines."""
    compressed, encoding = _encoding(path, source)
    lines = itertools.islice(_lines(path, compressed, encoding), _LINES_BEFORE_DATA)
    head = [(number, line) for number, line in enumerate(lines) if not _is_blank(line)]
    if not head:
        raise source.error("the file is empty; give a file with one row of numbers per sample")
    # Numbers with decimal commas are separated by semicolons, tabs or spaces.
    with_commas = [
        "," in line
        and _DECIMAL_COMMA.fullmatch(line) is not None
        and (_delimiter(line) != "," or re.search(r"\d\s+[+-]?\d", line) is not None)
        for _, line in head
    ]
    decimal = "," if any(with_commas) else "."
    head = [
        (number, line.replace(",", ".") if commas else line)
        for (number, line), commas in zip(head, with_commas, strict=True)
    ]
    sep = _SEP.fullmatch(head[0][1].rstrip("\r\n"))
    head = head[1:] if sep else head
    first = _first_row(head, sep and sep[1])
    notes: tuple[str, ...] = ("numbers with decimal commas",) if decimal == "," else ()
    if first is None:
        looked = (head or [(0, "")])[-1][0] + 1
        raise source.error(
            f"no row of numbers in its first {f'{looked} lines' if looked > 1 else 'line'}; give a file with "
            "one row of numbers per sample"
        )
    number, line = head[first]
    delimiter = sep[1] if sep else _delimiter(line)
    fields = _split(line, delimiter)
    comment = "%" if any(line.lstrip().startswith("%") for _, line in head[:first]) else "#"
    bare = _Layout(number, None, len(_trim(fields)), delimiter, comment, encoding, compressed, decimal)
    found = _with_header(bare, head[:first], fields)
    stated = [(text.strip(), match) for _, text in head[:first] if (match := _RATE.search(text.strip()))]
    rate = None
    for text, match in stated[:1]:
        rate = float(match[1]) * (1e3 if match[2] else 1.0)
        notes += (f"sample rate {rate:g} Hz from the line {text[:60]!r}",)
    return replace(found, notes=found.notes + notes, rate=rate)


def _first_row(head: list[tuple[int, str]], sep: str | None) -> int | None:
    """Return the index in `head` of the first row of data: after axis names, or else half numbers at least.

    A line of units and other lines may be between the names and the data.
    """
    plain = [k for k, (_, line) in enumerate(head) if not _is_comment(line)]
    for place, (before, k) in enumerate(itertools.pairwise(plain)):
        delimiter = sep or _delimiter(head[k][1])
        labels = _trim(_split(head[before][1], delimiter))
        names_axes = any(not _is_number(label) and recognise(label).role == "axis" for label in labels)
        if names_axes and _fits(_split(head[k][1], delimiter), len(labels)):
            below = [_split(head[i][1], delimiter) for i in plain[place + 1 : place + 2 + _LINES_OF_UNITS]]
            words = list(itertools.takewhile(lambda cells: not any(map(_is_number, cells)), below))
            return plain[place + 1 + len(words)] if _units(words) and len(words) < len(below) else k
    for k in plain:
        fields = _split(head[k][1], sep or _delimiter(head[k][1]))
        if 2 * sum(map(_is_number, fields)) >= len(fields):
            return k
    return None


def _with_header(bare: _Layout, before: list[tuple[int, str]], fields: list[str]) -> _Layout:
    """Return the layout with the header, which is searched before the first line with numbers."""
    plain = [(number, line) for number, line in before if not _is_comment(line)]
    comments = [line for _, line in before if _is_comment(line)]
    headers = [(number, line, _labels(line, bare.delimiter, fields)) for number, line in plain]
    named = [header for header in headers if any(recognise(label).role == "axis" for label in header[2])]
    for number, _, labels in named or headers:
        if _fits(fields, len(labels)):
            # All lines after the header are data, except a line of units and what precedes it.
            notes, start = _skipped([line for n, line in plain if n < number]), number + 1
            if units := _units([cells for n, _, cells in headers if n > number]):
                pairs = itertools.zip_longest(labels, units[: len(labels)], fillvalue="")
                labels = [f"{x} [{unit}]" if unit and not split_unit(x)[1] else x for x, unit in pairs]
                start = bare.start
            return replace(bare, start=start, labels=tuple(labels), fields=len(labels), notes=notes)
    for line in reversed(comments):
        # The % of `%time`, as ROS writes it, is part of the name.
        labels = _labels(re.sub(r"^\s*(?:[#/]+|%+\s)\s*", "", line), bare.delimiter, fields)
        if _fits(fields, len(labels)) and any(recognise(label).role != "auxiliary" for label in labels):
            return replace(bare, labels=tuple(labels), fields=len(labels))
    notes = _skipped([line for _, line in plain])
    if len(_trim(fields)) == len(_ROS_IMU) and not _is_number(fields[2]):
        notes += ("columns of ROS 2's sensor_msgs/Imu, as `ros2 topic echo --csv` prints it",)
        return replace(bare, labels=_ROS_IMU, notes=notes)
    return replace(bare, notes=notes)


def _units(lines: list[list[str]]) -> list[str]:
    """Return the units of the columns, if one of these lines below the header has any."""
    for cells in lines:
        units = [re.sub(r"^[\[(](.*)[\])]$", r"\1", cell) for cell in cells]
        if any(map(is_unit, units)):
            return units
    return []


def _skipped(lines: list[str]) -> tuple[str, ...]:
    """Return a note on skipped lines before the data, if any."""
    if not lines:
        return ()
    return (f"{len(lines)} lines before the data are skipped, the first is {lines[0].strip()[:60]!r}",)


def _encoding(path: Path, source: Source) -> tuple[bool, str]:
    """Return whether a file is gzip-compressed, and its encoding."""
    with path.open("rb") as stream:
        compressed = stream.read(2) == _GZIP_MAGIC
    try:
        with _opened(path, compressed) as stream:
            head = stream.read(1 << 16)
    except (EOFError, OSError, zlib.error) as error:
        raise source.error(f"cannot be read: {error}; copy or compress it again") from error
    if head.startswith((b"\xff\xfe", b"\xfe\xff")):
        return compressed, "utf-16"
    if b"\0" in head:
        raise source.error(
            "neither text nor a known binary format; save it as CSV, Parquet, .npy, .npz, or MATLAB -v7"
        )
    try:
        # The last bytes may be half a character.
        head[:-4].decode("utf-8")
    except UnicodeDecodeError:
        return compressed, "latin-1"
    return compressed, "utf-8-sig"


def _opened(path: Path, compressed: bool) -> IO[bytes]:
    """Return the decompressed bytes of a file."""
    return gzip.open(path) if compressed else path.open("rb")  # type: ignore[return-value]


def _lines(path: Path, compressed: bool, encoding: str) -> Iterator[str]:
    """Yield the lines of a file."""
    with io.TextIOWrapper(_opened(path, compressed), encoding, errors="replace") as stream:
        yield from stream


def _rows(path: Path, layout: _Layout) -> Iterator[tuple[int, str]]:
    """Yield line number (from 1) and text of each row of data."""
    for number, line in enumerate(_lines(path, layout.compressed, layout.encoding), start=1):
        if number > layout.start and not _is_blank(line) and not line.lstrip().startswith(layout.comment):
            yield number, line


def _ragged_row(path: Path, layout: _Layout) -> str | None:
    """Return an error message on the first row with another number of columns, or None."""
    for number, line in _rows(path, layout):
        fields = _split(line.split(layout.comment)[0], layout.delimiter)
        if not _fits(fields, layout.fields):
            return (
                f"line {number} has {len(fields)} columns where {layout.fields} are expected: "
                f"{line.strip()[:60]!r}; repair or delete that line"
            )
    return None


def _is_comment(line: str) -> bool:
    """Return whether a line is a comment."""
    return line.lstrip().startswith(_COMMENT_MARKS)


def _is_blank(line: str) -> bool:
    """Return whether a line is empty; tabs alone are empty cells."""
    return not line.strip(" \r\n")


def _delimiter(line: str) -> str | None:
    """Return the delimiter of a line; None for white space."""
    return next((mark for mark in "\t;," if mark in line), None)


def _split(line: str, delimiter: str | None) -> list[str]:
    """Return the fields of a line."""
    line = line.strip(" \r\n")
    if delimiter is None:
        # A unit belongs to the name before it and may contain spaces.
        return re.split(r"\s+(?![\[(]|[^\[\](]*[\])])", line.strip())
    fields = next(csv.reader([line], delimiter=delimiter, skipinitialspace=True), [])
    return [field.strip() for field in fields]


def _labels(line: str, delimiter: str | None, fields: list[str]) -> list[str]:
    """Return the names in a header; they may have blanks if two or more separate as many as the fields."""
    aligned = re.split(r"\s{2,}", line.strip()) if delimiter is None else []
    return aligned if len(aligned) == len(fields) else _trim(_split(line, delimiter))


def _trim(fields: list[str]) -> list[str]:
    """Return the fields without an empty one after a delimiter at the end of the line."""
    return fields[:-1] if len(fields) > 1 and not fields[-1] else fields


def _fits(fields: list[str], count: int) -> bool:
    """Return whether there are `count` fields, apart from a delimiter at the end of the line."""
    return len(fields) == count or (len(fields) == count + 1 and not fields[-1])


def _is_number(text: str) -> bool:
    """Return whether a field is a number."""
    try:
        float(text)
    except ValueError:
        return False
    return True


TEXT = Format("text", b"", open_text)


def read_vectornav(path: Path, source: Source) -> Table:
    """Return the lines of the most frequent message; a damaged line is a sample with nan."""
    import pandas as pd

    lines = path.read_bytes().split(b"\n")
    count = Counter(line[:6] for line in lines if line.startswith(b"$VN"))
    known = {kind: count[kind] for kind in _FIELDS if kind in count}
    if not known:
        there = ", ".join(sorted(kind.decode("latin-1") for kind in count))
        wanted = ", ".join(kind.decode() for kind in _FIELDS)
        raise source.error(f"no message with samples (only {there}); let the sensor write {wanted}")
    kind = max(known, key=lambda kind: known[kind])
    places = [k for k, line in enumerate(lines) if line.startswith(kind)]
    # Lines between messages that are not messages are damaged ones.
    torn = (
        k
        for k in range(places[0], places[-1])
        if lines[k].strip() and not lines[k].startswith((b"$VN", b"#"))
    )
    places = sorted([*places, *torn])
    rows = [lines[k] for k in places]
    labels = _FIELDS[kind]
    nothing = (len(labels) - 1) * b","
    intact = _are_intact(rows, len(labels))
    bodies = [
        row[7:].partition(b"*")[0].strip() if good else nothing
        for row, good in zip(rows, intact, strict=True)
    ]
    with damage_reported(source, "lines of numbers", "repair the lines, or save it as CSV"):
        text = io.BytesIO(b"\n".join(bodies))
        frame = pd.read_csv(text, header=None, encoding="latin-1", skip_blank_lines=False, low_memory=False)
    notes = [f"{known[kind]} lines of {kind.decode()}"]
    others = len(lines) - len(rows) - sum(not line.strip() for line in lines)
    if others:
        notes.append(f"{others} other lines are skipped")
    source = Source(source.label, lambda row: f"line {places[row] + 1}", "a damaged line")
    columns = tuple(frame[name].to_numpy() for name in frame.columns)
    return Table.of(columns, labels, source, notes=tuple(notes))


def _are_intact(rows: Sequence[bytes], fields: int) -> Bool[np.ndarray, " rows"]:
    """Return whether each line has so many fields and, if it states a check sum, the right one."""
    ends = [_ENDED.search(row) for row in rows]
    intact = np.array([row.count(b",") == fields for row in rows], bool)
    summed = [k for k, end in enumerate(ends) if end is not None and intact[k]]
    if summed:
        bodies = [rows[k][1:].partition(b"*")[0] for k in summed]
        starts = np.cumsum([0, *map(len, bodies[:-1])])
        sums = np.bitwise_xor.reduceat(np.frombuffer(b"".join(bodies), np.uint8), starts)
        intact[summed] = [int(rows[k].rpartition(b"*")[2], 16) for k in summed] == sums
    return intact


VECTORNAV = Format(
    "VectorNav", lambda magic: _VECTORNAV_LINE.search(magic) is not None, read_vectornav, in_chunks=False
)

"""Reader of text: lines of cells with or without a header, and messages of all kinds; see `grammar.py`."""

import codecs
import functools
import gzip
import io
import itertools
import re
import shlex
from bisect import bisect_right
from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from allanjax.base.wording import counted
from allanjax.record.io.grammar import FIRST_LINES, Grammar, grammar_of, names_axes
from allanjax.record.io.table import Columns, Format, Table, damage_reported
from allanjax.record.validation import Source

# First bytes of a gzip-compressed file.
_GZIP_MAGIC = b"\x1f\x8b"
_SAVE_AGAIN = "copy, save or compress it again"
# Bytes that are parsed at a time.
_BLOCK = 1 << 22
_NEWLINE = ord("\n")
# Characters with which lines of numbers begin.
_OF_NUMBERS = tuple("0123456789+-.")
# Zero bytes that a loss of power leaves in text, and the largest share of others.
_MOST_ZEROS = 1e-3
_ZEROS = re.compile(rb"\0{16,}|\0+$")
# What spreadsheets write in place of a number; # would begin a comment.
_NOT_AVAILABLE = re.compile(rb"#(?:N/A|DIV/0!|NUM!|VALUE!|REF!)")
# Codes by which terminals change the colour.
_COLOURS = re.compile(rb"\x1b\[[\d;]*[A-Za-z]")
# Bytes that are no ASCII, and Chinese characters among the most frequent in GB18030, of two bytes.
_NOT_ASCII = re.compile(rb"[\x80-\xff]+")
_CHINESE = re.compile(rb"[\xb0-\xd7][\xa1-\xfe]")
# The frame of a CAN bus before what it means, as `cantools decode --single-line` writes them.
_FRAME = re.compile(rb"\S*can\d+ +[\dA-Fa-f]+ +\[\d+\][ \dA-Fa-f]*:: ")
# Exponent of a number as Fortran writes it.
_FORTRAN = re.compile(rb"(\d\.?)[Dd]([+-]\d\d)")
# What stands for no number, beside what pandas knows.
_MISSING = [*("-", "--", "---", "*", "?"), *("none", "NONE", "nil", "NIL", "Null", "Nan", "NAN", "missing")]
# Lines that are no rows are left out up to this share of all, or up to so many.
_MOST_OTHERS, _FEW_OTHERS = 0.01, 5
# Lines that a message quotes.
_QUOTED = 3


class _Block(NamedTuple):
    """Whole lines or messages of a file, in UTF-8."""

    content: bytes
    may_be_cut: bool = False

    def texts(self) -> list[str]:
        """Its lines."""
        texts = self.content.decode(errors="replace").replace("\0", "").split("\n")
        return [text.rstrip("\r") for text in (texts if texts[-1] else texts[:-1])]


def open_text(path: Path, source: Source) -> Table:
    """Return the table of a text file, gzip-compressed or not."""

    def blocks(end: bytes, notes: list[str]) -> Iterator[_Block]:
        return _blocks(_pieces(path, source, notes), end)

    with damage_reported(source, "text", _SAVE_AGAIN):
        # A short file may be a block, and its last line another.
        head = [text for block in itertools.islice(blocks(b"\n", []), 2) for text in block.texts()]
        grammar = grammar_of(head[:FIRST_LINES], path.name, source)
        if grammar.labels is not None and not grammar.has_axes:
            grammar = _later(blocks(b"\n", []), grammar, path.name, source) or grammar
    reader = _Reader(grammar, source)

    def rows(chunk: int) -> Iterator[Columns]:
        reader.begin()
        with damage_reported(source, "text", _SAVE_AGAIN):
            for block in blocks(grammar.end, reader.notes):
                columns = reader.columns(block)
                for first in range(0, len(columns[0]), chunk):
                    yield tuple(column[first : first + chunk] for column in columns)
            reader.end()

    place = Source(
        source.label,
        lambda row: reader.locate(row, blocks(grammar.end, [])),
        "nan, an empty cell, a marker such as --, or a damaged row",
        grammar.sizes,
    )
    return Table(rows, grammar.labels, place, None, grammar.rate, reader.notes, grammar.units)


def growing_text(batches: Iterator[bytes], source: Source) -> Iterator[Table]:
    """Yield tables of text that comes in batches of whole lines, the first of which have the header.

    The rows of a table come as long as batches do. Where reading ended at an error, the next table begins
    with the next batch.
    """
    head = next(batches, b"")
    if not head:
        return
    grammar = grammar_of(_Block(head).texts()[:FIRST_LINES], source.label, source)
    reader = _Reader(grammar, source)
    # Unlike generators, `map` and `filter` go on after an error.
    every = map(reader.columns, _blocks(itertools.chain([head], batches), grammar.end, 0))
    parts = filter(lambda columns: len(columns[0]), every)
    # A line is counted from the start of its batch, which nobody can look up.
    place = Source(source.label, missing="nan or an empty cell", sizes=grammar.sizes)
    for part in parts:

        def rows(_: int, first: Columns = part) -> Iterator[Columns]:
            yield first
            yield from parts

        yield Table(rows, grammar.labels, place, None, grammar.rate, reader.notes, grammar.units)


def _later(blocks: Iterable[_Block], first: Grammar, file: str, source: Source) -> Grammar | None:
    """Return the grammar of a table that begins after a first one without axes; None if there is none."""
    lines = enumerate(itertools.chain.from_iterable(block.texts() for block in blocks))
    for number, text in itertools.islice(lines, first.start, None):
        # Most lines are rows.
        if text[:1] not in _OF_NUMBERS and names_axes(text):
            more = [line for _, line in itertools.islice(lines, FIRST_LINES)]
            found = grammar_of([text, *more], file, source)
            return found.after(number) if found.has_axes else None
    return None


def _pieces(path: Path, source: Source, notes: list[str]) -> Iterator[bytes]:
    """Yield pieces of a file in UTF-8, decompressed, with \\n at the end of lines."""
    raw = _decompressed(path, notes)
    first = next(raw, b"")
    encoding = _encoding(first[: 1 << 16], source)
    if encoding == "gb18030":
        notes.append("text in GB18030, the encoding of Chinese characters")
    errors = "replace" if encoding == "gb18030" else "strict"
    decoder = codecs.getincrementaldecoder(encoding)(errors)
    has_returns = b"\n" not in first and b"\r" in first
    is_fortran = _FORTRAN.search(first[: 1 << 16]) is not None
    for piece in itertools.chain([first.removeprefix(codecs.BOM_UTF8)], raw):
        text = piece if encoding == "utf-8" else decoder.decode(piece).encode()
        text = text.replace(b"\r", b"\n") if has_returns else text
        text = _cleaned(text)
        yield _FORTRAN.sub(rb"\1e\2", text) if is_fortran else text


def _cleaned(text: bytes) -> bytes:
    """Text without colours, errors of spreadsheets, wrongly decoded units, and frames with their meaning."""
    text = _NOT_AVAILABLE.sub(b"nan", text) if b"#" in text else text
    text = _COLOURS.sub(b"", text) if b"\x1b" in text else text
    text = _FRAME.sub(b"", text) if b"] " in text and b" :: " in text else text
    return text.replace("Â".encode() + b"\xc2", b"\xc2")


def _decompressed(path: Path, notes: list[str]) -> Iterator[bytes]:
    """Yield pieces of a file, of a compressed one up to where it is cut off, with a note."""
    with path.open("rb") as file:
        is_compressed = file.read(2) == _GZIP_MAGIC
    with gzip.open(path) if is_compressed else path.open("rb") as stream:
        try:
            yield from iter(functools.partial(stream.read1, _BLOCK), b"")
        except EOFError:
            if not stream.tell():
                raise
            notes.append("the compressed file is cut off; what comes before is read")


def _blocks(pieces: Iterable[bytes], end: bytes, size: int = _BLOCK) -> Iterator[_Block]:
    """Yield blocks of at least so many bytes, each from after one `end` of a line or message to another."""
    rest = b""
    for piece in pieces:
        rest += piece.replace(b"\r\n", b"\n") if b"\r" in piece else piece
        cut = rest.rfind(end) + 1
        if cut and len(rest) >= size:
            yield _Block(rest[:cut])
            rest = rest[cut:]
    cut = rest.rfind(end, 0, -1) + 1
    if cut:
        yield _Block(rest[:cut])
    if rest[cut:]:
        yield _Block(rest[cut:], may_be_cut=end != b"\n" or not rest.endswith(b"\n"))


def _encoding(head: bytes, source: Source) -> str:
    """Return the encoding of text from its first bytes."""
    if head.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return "utf-16"
    if _ZEROS.sub(b"", head).count(b"\0") > _MOST_ZEROS * len(head):
        raise source.error(
            "neither text nor a known binary format; save it as CSV, Parquet, .npy, .npz, or MATLAB -v7"
        )
    try:
        # The last bytes may be half a character.
        head[:-4].decode("utf-8")
    except UnicodeDecodeError:
        return "gb18030" if _is_chinese(head[: head.rfind(b"\n") + 1]) else "latin-1"
    return "utf-8"


def _is_chinese(lines: bytes) -> bool:
    """Return whether text that is no UTF-8 has words of Chinese characters in GB18030.

    They are runs of pairs of bytes, most of them frequent characters; in other encodings such as Latin-1
    letters with accents are single, and in those of Cyrillic letters small ones are no first byte.
    """
    runs = _NOT_ASCII.findall(lines)
    pairs = [run[k : k + 2] for run in runs for k in range(0, len(run), 2)]
    has_words = any(len(run) > 2 for run in runs) and all(len(run) % 2 == 0 for run in runs)
    return has_words and 2 * sum(map(bool, map(_CHINESE.fullmatch, pairs))) > len(pairs)


class _Place(NamedTuple):
    """What was read before a block: rows and lines; and whether its lines were judged one by one."""

    rows: int
    lines: int
    one_by_one: bool


class _Reader:
    """Reads block after block by a grammar, and knows where each row is in the file.

    Attributes:
        notes: what users should know; complete when all blocks have been read.
    """

    def __init__(self, grammar: Grammar, source: Source) -> None:
        self.notes: list[str] = []
        self._grammar, self._source = grammar, source
        self.begin()

    def begin(self) -> None:
        """Begin at the first block."""
        self.notes[:] = self._grammar.notes
        self._places: list[_Place] = []
        self._rows = self._lines = 0
        # Records that are no rows, by kind; strange ones after the last row; and the first strange ones.
        self._counts: Counter[str] = Counter()
        self._trailing = 0
        self._examples: list[str] = []
        self._is_in_table = True
        # Numbers and names of other tables.
        self._tables: list[tuple[int, str]] = []

    def columns(self, block: _Block) -> Columns:
        """Return the columns of the rows in the next block.

        Raises:
            RecordingError: too many lines are no rows; the message has examples and a remedy.
        """
        grammar = self._grammar
        columns = None
        if grammar.message is None and self._is_in_table and not block.may_be_cut:
            columns = self._parsed(block.content, max(grammar.start - self._lines, 0))
        self._places.append(_Place(self._rows, self._lines, columns is None))
        if columns is None:
            rows = "\n".join(self._judged(block))
            columns = self._parsed(rows.encode() + b"\n", as_it_is=True) if rows else None
        if columns is None:
            columns = tuple(np.zeros(0) for _ in range(grammar.fields))
        self._rows += len(columns[0])
        self._lines += int((np.frombuffer(block.content, np.uint8) == _NEWLINE).sum())
        strange = self._counts["strange"]
        if strange > _MOST_OTHERS * self._lines + _FEW_OTHERS:
            raise self._source.error(
                f"{strange} of {self._lines} lines are no rows of {grammar.fields} numbers: "
                f"{'; '.join(self._examples)}; {grammar.without(self._examples, self._source.label)}"
            )
        return columns

    def end(self) -> None:
        """Note what was left out."""
        self._counts["strange"] += self._trailing
        what = {
            "names": "with the names again",
            "known": "of other messages or tables",
            "strange": f"without a row of numbers: {'; '.join(self._examples)}",
        }
        for kind, words in what.items():
            if self._counts[kind]:
                self.notes.append(f"left out: {counted(self._counts[kind], 'line')} {words}")
        path = shlex.quote(self._source.label)
        opened = f"gzip -cd {path}" if path.rstrip("'").endswith(".gz") else f"cat {path}"
        for number, text in self._tables:
            command = f"{opened} | tail -n +{number} > table-{number}.csv"
            self.notes.append(
                f"another table from line {number} on, {text[:80]!r}: to read it, run {command}"
            )

    def locate(self, row: int, blocks: Iterable[_Block]) -> str:
        """Return the place of a row in words, with its text if it is damaged."""
        k = bisect_right([place.rows for place in self._places], row) - 1
        place = self._places[k]
        records = self._records(next(itertools.islice(blocks, k, None)), place.lines)
        if place.one_by_one:
            records = (x for x in records if self._grammar.row(x[1]) is not None)
        else:
            records = (x for x in records if not x[1].lstrip().startswith(self._grammar.comment))
        number, text = next(itertools.islice(records, row - place.rows, None))
        where = f"line {number + 1}"
        return where if self._grammar.is_whole(text) else f"{where}, {text.strip()[:60]!r},"

    def _parsed(self, rows: bytes, start: int = 0, as_it_is: bool = False) -> Columns | None:
        """Return the columns of lines that are rows; None if some seem to be none, unless all are known."""
        import pandas as pd

        grammar = self._grammar
        if b"\0" in rows:
            return None
        try:
            frame = pd.read_csv(
                io.BytesIO(rows),
                sep=r"\s+" if grammar.delimiter is None else grammar.delimiter,
                header=None,
                skiprows=start,
                decimal=grammar.decimal,
                comment=grammar.comment if grammar.message is None else None,
                skipinitialspace=True,
                na_values=_MISSING,
                low_memory=False,
            )
        except (pd.errors.ParserError, pd.errors.EmptyDataError, UnicodeDecodeError):
            if as_it_is:
                raise
            return None
        columns = [frame[name].to_numpy() for name in frame.columns]
        # Delimiters at the end of every line add empty columns.
        while len(columns) > grammar.fields and frame[len(columns) - 1].isna().all():
            columns.pop()
        if as_it_is:
            return tuple(columns)
        numeric = [columns[k] for k in grammar.numeric if k < len(columns)]
        if len(columns) != grammar.fields or any(column.dtype.kind == "O" for column in numeric):
            return None
        # A line without any number, where columns of text may hide it.
        is_hidden = len(numeric) < grammar.fields and np.isnan(numeric[-1].astype(float)).any()
        return None if is_hidden and np.isnan(np.array(numeric, float)).all(axis=0).any() else tuple(columns)

    def _records(self, block: _Block, lines: int) -> Iterator[tuple[int, str]]:
        """Yield number and text of the records of a block that is behind so many lines, except blank ones."""
        below = itertools.islice(enumerate(block.texts(), lines), max(self._grammar.start - lines, 0), None)
        return (x for x in self._grammar.records(below) if not self._grammar.is_blank(x[1]))

    def _judged(self, block: _Block) -> Iterator[str]:
        """Yield the rows of a block as lines of a table, and count what is none."""
        grammar = self._grammar
        records = list(self._records(block, self._lines))
        for number, text in records:
            row = grammar.row(text)
            kind = "row" if row is not None else grammar.kind(text)
            is_last = block.may_be_cut and number == records[-1][0]
            if is_last and kind in ("row", "strange") and not grammar.is_whole(text):
                self.notes.append(f"the file ends within a line, which is left out: {text.strip()[:60]!r}")
                return
            if kind in ("names", "end"):
                self._is_in_table = kind == "names"
            if kind == "end" and names_axes(text):
                self._tables.append((number + 1, text.strip()))
            if kind in ("row", "strange", "end") and not self._is_in_table:
                kind = "known"
            if kind == "strange":
                self._trailing += 1
                if len(self._examples) < _QUOTED:
                    self._examples.append(f"line {number + 1}, {text.strip()[:60]!r}")
            elif kind == "row" and row is not None:
                self._counts["strange"] += self._trailing
                self._trailing = 0
                yield row
            else:
                self._counts[kind] += 1


TEXT = Format("text", b"", open_text)

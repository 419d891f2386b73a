"""The grammar of text: how lines, or groups of lines, hold the cells of a row. Its first lines show it."""

import csv
import functools
import itertools
import re
import tomllib
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib.resources import files
from typing import Any, NamedTuple

from allanjax.record.columns import by_unit, recognise, split_unit
from allanjax.record.units import NUMBER, SENSORS, Sensor, is_unit
from allanjax.record.validation import Source

#: Lines in which the grammar is looked for.
FIRST_LINES = 1000
# Marks at the start of comments, and what else may be before the names in a line that is no row.
_COMMENT_MARKS = ("#", "%", "//")
_BEFORE_NAMES = re.compile(r"^\s*(?:[#/;!*>]+|%+\s|--+|REM\s)\s*")
# Excel's line that names the delimiter, and a line before the data that states the sample rate.
_SEP = re.compile(r"\"?sep=(.)\"?\s*", re.IGNORECASE)
_RATE = re.compile(
    r"(?:(?:sampl\w*|update|output data)[\s_]*(?:rate|freq\w*)|\bodr)\W*(?:hz\W+)?"
    r"(\d+(?:\.\d+)?)\s*(k?)(?:hz|sps)?\W*$",
    re.IGNORECASE,
)
# Lines with names or units between the first line of names and the data.
_LINES_OF_UNITS = 3
# Share of the first lines that are rows if each line is one, or messages of one shape if records are joined.
_REGULAR, _JOINED = 0.99, 0.8
# Lines of numbers with decimal commas, and possibly whole numbers.
_COMMA_NUMBER = r"[+-]?\d+(?:,\d+)?(?:[eE][+-]?\d+)?"
_DECIMAL_COMMA = re.compile(rf"\s*{_COMMA_NUMBER}(?:[\s;]+{_COMMA_NUMBER})*\s*;?\s*")
# What varies from one message to the next: dates, clocks, words of bits, numbers, and missing ones.
_TIME = (
    r"(?<![\w.])(?:\d{1,4}(?:-\d\d?-|/\d\d?/|\.\d\d?\.)\d{1,4}(?:[T ]\d\d?:\d\d(?::\d\d(?:[.,]\d+)?)?(?:Z|[+-]\d\d:?\d\d)?)?"
    r"|\d\d?:\d\d:\d\d(?:[.,]\d+)?)"
)
_NUMBER = rf"(?<![\w.^])(?<![A-Za-z^]-){NUMBER}(?![\dx])|\b(?:nan|null|none|inf(?:inity)?)\b"
_CELL = re.compile(rf"(?i:{_TIME}|\b(?=\d*[a-f])[\da-f]{{8}}\b|{_NUMBER})")
_IS_TIME = re.compile(_TIME)
# Marks at the ends of messages that may differ, as those of the elements of a list.
_ENDS = r"[\s\[\](){},;]*"
# Text of a value in quotes; the check sum at the end of a message, as many hexadecimal digits as it has.
_QUOTED = re.compile(r'"[^"\0]*"(?=[,}\]])')
_SUM = re.compile(r"\*([\da-fA-F]{2}|[\da-fA-F]{8})\s*$")
# A number beside anything but a delimiter: `x=0.1`, `[0.1`, `0.1 deg/s`.
_EMBEDDED = re.compile(r".*[\[({<=>|]\s*[-+]?\.?\d|:\s*[-+.\d]|[-+]?\.?\d.*[^\w.]|.*\d[.:]\d|\D*[:=]$")
_SENSORS: dict[Sensor, str] = {"gyro": "gyros", "accel": "accelerometers"}
# Marks at the start of messages with check sums, and of comments.
_MARKS = tuple("$#%!@/")
# A line that ends a table.
_SECTION = re.compile(r"\s*(?:[\[<]/?[A-Za-z][\w .-]*[\]>]|\w*END\w*)\s*")
# UNIX times in s, ms, µs and ns.
_DATED = re.compile(r"1[0-9]{9}(?:\.\d+|(?:\d{3}){0,3})")


@dataclass(frozen=True)
class Message:
    """Shape of messages, text in which numbers vary and words do not; each is a row.

    Attributes:
        shape: the text with \\0 in place of what varies.
        cells: numbers of the cells that are columns of the table.
        others: shapes of other messages in the file, which are left out.
        summed: whether messages end with a check sum.
        mark: line between messages, or text at the start of their first lines; None if each is a line.
    """

    shape: str
    cells: tuple[int, ...]
    others: frozenset[str] = frozenset()
    summed: bool = False
    mark: str | None = None

    @functools.cached_property
    def pattern(self) -> re.Pattern[str]:
        """Pattern of a message, whose groups are the cells."""
        cell = rf"\s*({_CELL.pattern})\s*"
        parts = {"\0": cell, "\1": r'[^"]*', " ": r"\s+"}
        whole = "".join(parts.get(c, c if c.isalnum() else rf"\s*{re.escape(c)}\s*") for c in self.shape)
        return re.compile(re.sub(r"(?:\\s\*)+", r"\\s*", rf"{_ENDS}{whole}{_ENDS}"))

    @property
    def opening(self) -> str:
        """Text at the start of messages, before the first number."""
        return self.shape.partition("\0")[0]

    def cells_of(self, text: str) -> tuple[str, ...] | None:
        """Cells of a message; none if it is damaged, None if the text is something else."""
        # Of several lines, the first ones may be of something else.
        matches = self.pattern.fullmatch if self.mark is None else self.pattern.search
        match = matches(_SUM.sub("", text))
        if match and (not self.summed or _has_right_sum(text)):
            groups = match.groups()
            return tuple(groups[k] for k in self.cells)
        if self.is_other(text):
            return None
        # Where messages have check sums, there is nothing else.
        is_part = self.summed or 2 * len(_CELL.findall(text)) >= self.pattern.groups > 2
        return () if is_part else None

    def is_other(self, text: str) -> bool:
        """Whether a text is a whole message of another shape, or a comment."""
        is_ours = text.lstrip().startswith(self.opening)
        is_marked = self.summed and text.lstrip()[:1] in _MARKS
        return not is_ours if is_marked else _shape(text) in self.others


@dataclass(frozen=True)
class Grammar:
    """How lines hold the cells of rows.

    Attributes:
        start: index of the first line of data.
        fields: number of columns.
        labels: their labels, or None.
        delimiter: what separates cells; None for white space.
        decimal: decimal mark.
        comment: mark at the start of comments.
        numeric: columns with numbers in the first row.
        message: the shape of messages; None if a line is its cells.
        rate: sample rate [Hz] stated before the data.
        notes: what users should know.
        units: unit of each sensor that a published format fixes.
        sizes: sizes of counts, by sensor, that messages propose.
    """

    start: int
    fields: int
    labels: tuple[str, ...] | None = None
    delimiter: str | None = None
    decimal: str = "."
    comment: str = "#"
    numeric: tuple[int, ...] = ()
    message: Message | None = None
    rate: float | None = None
    notes: tuple[str, ...] = ()
    units: Mapping[Sensor, str] = field(default_factory=dict)
    sizes: Mapping[Sensor, str] = field(default_factory=dict)

    @property
    def has_axes(self) -> bool:
        """Whether an axis is among its labels."""
        return any(map(_is_axis, self.labels or ()))

    @property
    def end(self) -> bytes:
        """What is between two records, up to the first byte of the second."""
        mark = self.message.mark if self.message else None
        return b"\n" if mark is None else b"\n" + (mark.encode() or b"\n")

    @property
    def expected(self) -> str:
        """A row in words."""
        return f"rows of {self.fields} numbers" if self.message is None else self.notes[-1]

    def filter(self, path: str) -> str:
        """A command that writes the rows alone."""
        if self.message is not None:
            return f"grep -aF '{self.message.opening}' '{path}' > rows.txt"
        mark = "" if self.delimiter is None else f" -F'{self.delimiter}'"
        return f"awk{mark} 'NF=={self.fields}' '{path}' > rows.csv"

    def after(self, lines: int) -> "Grammar":
        """Return the grammar of a table that begins after so many lines."""
        note = f"the table that begins in line {lines + 1} is read, as the first one has no axes"
        return replace(self, start=self.start + lines, notes=(note, *self.notes))

    def records(self, lines: Iterable[tuple[int, str]]) -> Iterator[tuple[int, str]]:
        """Yield number and text of each record, the lines between two marks or a line."""
        return _records(lines, self.message.mark if self.message else None)

    def row(self, text: str) -> str | None:
        """Cells of a record as a line of a table, nan where it is damaged; None if it is no row."""
        cells = self._plain_cells(text) if self.message is None else self.message.cells_of(text)
        # A damaged row is a sample that is missing, which stamps tell if there are any.
        if cells is None or (not cells and any(recognise(x).role == "time" for x in self.labels or ())):
            return None
        return (self.delimiter or " ").join(cells or ["nan"] * self.fields)

    def is_whole(self, text: str) -> bool:
        """Whether a record is a row that is not damaged."""
        if self.message is not None:
            return bool(self.message.cells_of(text))
        return _fits(_split(text.split(self.comment)[0], self.delimiter), self.fields)

    def is_blank(self, text: str) -> bool:
        """Whether a record is empty; tabs alone are empty cells."""
        return not (text.strip(" \r") if self.delimiter == "\t" else text.strip())

    def kind(self, text: str) -> str:
        """What a record is that is no row: a comment, names once more, the end, known, or strange."""
        if self.message is not None and self.message.is_other(text):
            return "known"
        cells = trimmed(_split(_BEFORE_NAMES.sub("", " ".join(text.split("\n"))), self.delimiter))
        bare = [split_unit(cell)[0] for cell in cells]
        if bare == [split_unit(label)[0] for label in self.labels or ()]:
            return "names"
        if _is_comment(text):
            return "comment"
        is_header = self.delimiter is not None and len(cells) > 1 and not any(map(_is_number, cells))
        names = is_header and any(recognise(cell).role != "auxiliary" for cell in cells)
        return "end" if names or _SECTION.fullmatch(text) else "strange"

    def _plain_cells(self, text: str) -> list[str] | None:
        """Cells of a line; none if it is damaged, None if it is something else."""
        cells = _split(text.split(self.comment)[0], self.delimiter)
        cells = cells[: self.fields] if _fits(cells, self.fields) else trimmed(cells)
        numbers = [k for k, cell in enumerate(cells) if _is_number(cell.replace(self.decimal, "."))]
        # A delimiter within quotes separates nothing.
        cells = [f'"{cell}"' if self.delimiter and self.delimiter in cell else cell for cell in cells]
        if _is_comment(text):
            return None
        if len(cells) == self.fields:
            return cells if {*numbers} & {*self.numeric} or not any(cells) else None
        words = [k for k, cell in enumerate(cells) if cell and k not in numbers and k in self.numeric]
        if len(cells) < self.fields:
            return None if words else [*cells, *["nan"] * (self.fields - len(cells))]
        return [] if len(numbers) > len(words) else None


def names_axes(text: str) -> bool:
    """Whether a line has names of axes, and no numbers."""
    cells = _split(text, _delimiter(text))
    return len(cells) > 1 and not any(map(_is_number, cells)) and any(map(_is_axis, cells))


def grammar_of(lines: Sequence[str], file: str, source: Source) -> Grammar:
    """Return the grammar of a file from its first lines and its name.

    Raises:
        RecordingError: they have no row of numbers; the message says what they have.
    """
    head = list(enumerate(lines[:FIRST_LINES]))
    if not any(text.strip() for _, text in head):
        raise source.error("the file is empty; give a file with one row of numbers per sample")
    found = _plain(head)
    if found is None or not _is_regular(found, head):
        found = _messages(head) or found
    if found is None:
        raise source.error(_without_rows(head))
    before = [text.strip() for _, text in head[: found.start]]
    stated = next(filter(None, map(_stated_rate, before)), None)
    if stated is not None:
        rate, text = stated
        note = f"sample rate {rate:g} Hz from the line {text[:60]!r}"
        found = replace(found, rate=rate, notes=(*found.notes, note))
    rows = found.records(head[found.start :])
    return _of_device(found, before, next(rows)[1], file)


def _stated_rate(text: str) -> tuple[float, str] | None:
    match = _RATE.search(text)
    return match and (float(match[1]) * (1e3 if match[2] else 1.0), text)


def _without_rows(head: Sequence[tuple[int, str]]) -> str:
    """What the first lines have in place of rows of numbers."""
    shown = [(number, text) for number, text in head if text.strip()]
    number, text = shown[len(shown) // 2]
    looked = f"{len(head)} lines" if len(head) > 1 else "line"
    return (
        f"no row of numbers in its first {looked}; line {number + 1} is {text.strip()[:80]!r}; write a line of "
        "names, such as time [s],gyro_x [deg/s],accel_x [g], and below it a row of numbers per sample"
    )


# --- A line is its cells -----------------------------------------------------------------------------------


class _Line(NamedTuple):
    """A line before or of the data, split at its own delimiter."""

    number: int
    text: str
    delimiter: str | None
    cells: list[str]

    @property
    def numbers(self) -> int:
        """How many of its cells are numbers; 0 if others have numbers within, beside something else."""
        if any(_EMBEDDED.match(x) and not (_is_number(x) or _CELL.fullmatch(x)) for x in self.cells):
            return 0
        if self.delimiter is None and not all(any(map(str.isalnum, x)) for x in self.cells):
            return 0
        return sum(map(_is_number, self.cells))


def _plain(head: Sequence[tuple[int, str]]) -> Grammar | None:
    """Return the grammar of lines that are their cells; None if there is no row among them."""
    head = [(number, text) for number, text in head if text.strip(" ")]
    # Numbers with decimal commas are separated by semicolons, tabs or spaces.
    with_commas = [
        "," in text
        and _DECIMAL_COMMA.fullmatch(text.replace('"', "")) is not None
        and (_delimiter(text) != "," or re.search(r"\d\s+[+-]?\d", text) is not None)
        for _, text in head
    ]
    decimal = "," if any(with_commas) else "."
    head = [(n, x.replace(",", ".") if c else x) for (n, x), c in zip(head, with_commas, strict=True)]
    sep = _SEP.fullmatch(head[0][1])
    head = head[1:] if sep else head
    lines = []
    for number, text in head:
        delimiter = sep[1] if sep else _delimiter(text)
        lines.append(_Line(number, text, delimiter, _split(text, delimiter)))
    first = _first_row([line for line in lines if not _is_comment(line.text)])
    if first is None:
        return None
    before = [line for line in lines if line.number < first.number]
    is_percent = any(line.text.lstrip().startswith("%") for line in before)
    bare = Grammar(
        first.number,
        len(first.cells),
        None,
        first.delimiter,
        decimal,
        "%" if is_percent else "#",
        tuple(k for k, cell in enumerate(first.cells) if _is_number(cell)),
        notes=("numbers with decimal commas",) if decimal == "," else (),
    )
    return _with_header(bare, before, first)


def _first_row(lines: Sequence[_Line]) -> _Line | None:
    """Return the first row: that below names of axes, or else of the most frequent size."""
    for k, line in enumerate(lines):
        if not line.numbers:
            continue
        for before in reversed(lines[max(k - _LINES_OF_UNITS - 1, 0) : k]):
            names = trimmed(_split(before.text, line.delimiter))
            if any(map(_is_number, names)):
                break
            # Names at the end may be without cells.
            is_steady = all(len(x.cells) == len(line.cells) for x in lines[k : k + 3])
            fits = _fits(line.cells, len(names)) or (len(line.cells) < len(names) and is_steady)
            if fits and any(map(_is_axis, names)):
                return line._replace(cells=line.cells[: len(names)])
    rows = [line._replace(cells=trimmed(line.cells)) for line in lines]
    rows = [line for line in rows if 0 < len(line.cells) <= 2 * line.numbers]
    sizes = Counter((line.delimiter, len(line.cells)) for line in rows)
    if not rows:
        return None
    usual = max(sizes, key=lambda size: sizes[size])
    return next(line for line in rows if (line.delimiter, len(line.cells)) == usual)


def _fits(cells: Sequence[str], count: int) -> bool:
    """Whether there are so many cells, apart from an empty one after a delimiter at the end of the line."""
    return len(cells) == count or (len(cells) == count + 1 and not cells[-1])


def _is_regular(found: Grammar, head: Sequence[tuple[int, str]]) -> bool:
    """Whether nearly all lines of the data are rows."""
    texts = [text for _, text in head[found.start :] if text.strip() and not _is_comment(text)]
    is_row = [found.is_whole(text) and found.row(text) is not None for text in texts]
    return sum(is_row) >= _REGULAR * len(is_row)


def _with_header(bare: Grammar, before: Sequence[_Line], first: _Line) -> Grammar:
    """Return the grammar with the labels that lines before the first row have, in up to three lines."""
    plain = [line for line in before if not _is_comment(line.text)]
    named = []
    for line in plain:
        cells = _labels(line.text, bare.delimiter, first.cells)
        stripped = _labels(_BEFORE_NAMES.sub("", line.text), bare.delimiter, first.cells)
        named.append((line.number, stripped if len(stripped) == bare.fields else cells))
    fitting = [(number, cells) for number, cells in named if len(cells) == bare.fields]
    header = next((x for x in fitting if "" not in x[1] and any(map(_is_axis, x[1]))), None)
    if header is None and fitting:
        # Names may be in two lines: the sensor, and the axis below.
        tail = fitting[-_LINES_OF_UNITS:]
        sensors, *rest = [cells for _, cells in tail]
        if rest:
            sensors = list(itertools.accumulate(sensors, lambda last, cell: cell or last))
        joined = [" ".join(filter(None, cells)) for cells in zip(sensors, *_without_units(rest), strict=True)]
        header = (tail[0][0], joined) if any(map(_is_axis, joined)) else fitting[0]
    if header is not None:
        number, labels = header
        units = _units([cells for n, cells in named if n > number])
        pairs = itertools.zip_longest(labels, units[: len(labels)], fillvalue="")
        labels = [f"{x} [{unit}]" if unit and not split_unit(x)[1] else x for x, unit in pairs]
        notes = _skipped([line.text for line in plain if line.number < number])
        # Without units, all lines after the header are data.
        start = bare.start if units else number + 1
        return replace(bare, start=start, labels=tuple(labels), notes=bare.notes + notes)
    for line in reversed(before):
        if _is_comment(line.text):
            # The % of `%time`, as ROS writes it, is part of the name.
            labels = _labels(_BEFORE_NAMES.sub("", line.text), bare.delimiter, first.cells)
            if len(labels) == bare.fields and any(recognise(x).role != "auxiliary" for x in labels):
                return replace(bare, labels=tuple(labels))
    return replace(bare, notes=bare.notes + _skipped([line.text for line in plain]))


def _units(lines: Iterable[Sequence[str]]) -> list[str]:
    """Return the units of the columns, blank where these lines below the header have none."""
    units: list[str] = []
    for cells in lines:
        bare = [re.sub(r"^[\[(](.*)[\])]$", r"\1", cell) for cell in cells]
        own = (cell if is_unit(cell) else "" for cell in bare)
        units = [one or other for one, other in itertools.zip_longest(own, units, fillvalue="")]
    return units if any(units) else []


def _without_units(lines: Sequence[Sequence[str]]) -> list[list[str]]:
    """Cells of lines of names, blank where they are units."""
    return [["" if is_unit(cell) else cell for cell in cells] for cells in lines]


def _skipped(lines: Sequence[str]) -> tuple[str, ...]:
    """Return a note on skipped lines before the data, if any."""
    if not lines:
        return ()
    return (f"{len(lines)} lines before the data are skipped, the first is {lines[0].strip()[:60]!r}",)


def _labels(text: str, delimiter: str | None, cells: Sequence[str]) -> list[str]:
    """Return the names in a header; they may have blanks if two or more separate as many as the cells."""
    aligned = re.split(r"\s{2,}", text.strip()) if delimiter is None else []
    names = _split(text, delimiter)
    count = len(cells)
    is_longer = len(names) > count and any(map(_is_axis, names[:count]))
    fitting = (x for x in (aligned, names) if _fits(x, count) or (is_longer and x is names))
    return next((x[:count] for x in fitting), trimmed(names))


def _is_comment(text: str) -> bool:
    return text.lstrip().startswith(_COMMENT_MARKS)


def _delimiter(text: str) -> str | None:
    """Return the delimiter of a line; None for white space."""
    return next((mark for mark in "\t;,|" if mark in text), None)


def _split(text: str, delimiter: str | None) -> list[str]:
    """Return the cells of a line."""
    text = text.strip(" \r\n\0")
    if delimiter is None:
        # A unit belongs to the name before it and may contain spaces.
        return re.split(r"\s+(?![\[(]|[^\[\](]*[\])])", text.strip())
    cells = next(csv.reader([text], delimiter=delimiter, skipinitialspace=True), [])
    return [cell.strip() for cell in cells]


def trimmed(cells: list[str]) -> list[str]:
    """Return the cells without an empty one after a delimiter at the end of the line."""
    return cells[:-1] if len(cells) > 1 and not cells[-1] else cells


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


@functools.cache
def _is_axis(label: str) -> bool:
    return not _is_number(label) and by_unit(recognise(label)).role == "axis"


# --- A line, or a group of lines, is a message ---------------------------------------------------------------


def _messages(head: Sequence[tuple[int, str]]) -> Grammar | None:
    """Return the grammar of messages: the most frequent one with axes; None if there is none with numbers."""
    best: tuple[int, Grammar] | None = None
    for mark in (None, "---", "", *_openings(head)):
        records = list(_records(head, mark))
        if mark is not None:
            # The last one may be cut.
            records = records[:-1]
        shapes = Counter(_shape(text) for _, text in records)
        for shape, count in shapes.most_common(10):
            is_rare = count < 3 or (mark is not None and count < _JOINED * len(records))
            examples = [(n, text) for n, text in records if _shape(text) == shape]
            # Numbers and delimiters alone are no messages.
            is_bare = not re.search(r"[^\s,;|]", _CELL.sub("", examples[0][1]))
            if is_rare or is_bare or "\0" not in shape:
                continue
            found = _message(shape, examples, head[: examples[0][0]], mark)
            axes = sum(map(_is_axis, found.labels or ()))
            if best is None or axes > best[0]:
                usual = (x for x in shapes if shapes[x] > 2 and re.search(r"[^\W\d]", x))
                others = frozenset(usual) - {shape}
                assert found.message is not None
                best = axes, replace(found, message=replace(found.message, others=others))
            if axes:
                break
    return best and best[1]


def _openings(head: Sequence[tuple[int, str]]) -> list[str]:
    """Text before the number in the first of the lines that recur, which may begin a message of several."""
    texts = [text.strip() for _, text in head]
    shapes = Counter(map(_shape, texts))
    for text in texts:
        opening = _CELL.split(text)[0].strip()
        if shapes[_shape(text)] > 2 and opening != text and re.search(r"[^\W\d]", opening):
            return [opening]
    return []


def _records(lines: Iterable[tuple[int, str]], mark: str | None) -> Iterator[tuple[int, str]]:
    """Yield number and text of each record, the lines from one mark to the next; or of each line."""
    if mark is None:
        yield from lines
        return
    number, held = 0, list[str]()
    for n, text in lines:
        is_between = text.strip() == mark
        if held and (is_between or (mark and text.lstrip().startswith(mark))):
            yield number, "\n".join(held)
            held = []
        if text.strip() and not is_between:
            number = number if held else n
            held.append(text.strip("\r"))
    if held:
        yield number, "\n".join(held)


def _shape(text: str) -> str:
    """Text with \\0 in place of what varies, and white space only between words."""
    shape = re.sub(r"\s+", " ", _CELL.sub("\0", _SUM.sub("", text)))
    shape = _QUOTED.sub('"\1"', re.sub(r" ?([^\w ]) ?", r"\1", shape))
    return re.sub(rf"^{_ENDS}|{_ENDS}$", "", shape)


def _has_right_sum(text: str) -> bool:
    """Whether a message has a check sum and, if it is the exclusive or of the bytes after the $, the right."""
    end = _SUM.search(text)
    if end is None or len(end[1]) != 2:
        return end is not None
    body = text.strip()[1:].rpartition("*")[0].encode()
    return functools.reduce(int.__xor__, body, 0) == int(end[1], 16)


def _message(
    shape: str, examples: Sequence[tuple[int, str]], before: Sequence[tuple[int, str]], mark: str | None
) -> Grammar:
    """Return the grammar of messages of a shape, of which there are examples."""
    number, text = examples[0]
    values = list(zip(*(_CELL.findall(_SUM.sub("", x)) for _, x in examples[:50]), strict=False))
    labels = _labels_of(_SUM.sub("", text), [line for _, line in before])
    if any(map(_is_axis, filter(None, labels))):
        for k, label in enumerate(labels):
            if label is None and len(set(values[k])) > 1:
                labels[k] = f"column {k + 1}"
        cells = tuple(k for k, label in enumerate(labels) if label is not None)
    else:
        cells = tuple(range(len(labels)))
        labels = labels if any(labels) else []
    named = tuple(labels[k] or f"column {k + 1}" for k in cells) if labels else None
    sums = [_SUM.search(x) is not None for _, x in examples]
    message = Message(shape, cells, summed=all(sums), mark=mark)
    kind = f"messages such as {' '.join(text.split())[:60]!r}"
    notes = (*_skipped([line for _, line in before if line.strip()]), kind)
    number = number if mark is None else 0
    return Grammar(number, len(cells), named, "\t", message=message, notes=notes)


class _Value(NamedTuple):
    """A number in a message: the words before it, its unit, and whether it goes on a group of numbers."""

    words: tuple[str, ...]
    unit: str
    follows: bool


def _labels_of(text: str, before: Sequence[str]) -> list[str | None]:
    """Return the label of each number in a message, from the words before it or a header; None if it has none."""
    values: list[_Value] = []
    pieces = _CELL.split(text)
    for piece, token in zip(pieces, _CELL.findall(text), strict=False):
        unit, piece = _unit_before(piece) if values else ("", piece)
        if unit:
            values[-1] = values[-1]._replace(unit=unit)
        words, own_unit = _words(piece)
        last = values[-1].words if values else ()
        follows = last not in ((), _CLOCK) and not words and not re.search(r"\w", piece)
        if _IS_TIME.fullmatch(token) or (not words and _DATED.fullmatch(token)):
            words, follows = _CLOCK, False
        elif len(last) > 1 and len(words) == 1 and words[0].lower() in _XYZ and last[-1].lower() in _XYZ:
            words, follows = (*last[:-1], *words), True
        values.append(_Value(words or (last if follows else ()), own_unit, follows))
    unit, _ = _unit_before(pieces[-1])
    if unit:
        values[-1] = values[-1]._replace(unit=unit)
    names = [*_names_of(values)]
    unnamed = len(list(itertools.takewhile(lambda name: name is None, reversed(names))))
    if unnamed > 1:
        header = _names_before(unnamed, _delimiter("".join(pieces[-unnamed:-1])), before)
        names[len(names) - len(header) :] = header
    return _with_units(names, values)


# The words of a date or a clock, and of the axes of a group.
_CLOCK, _XYZ = ("time",), ("x", "y", "z")
# Marks after names, and marks after values.
_AFTER_NAME, _AFTER_VALUE = ":=({[", r"[,;|)}\]>\n]"


def _unit_before(piece: str) -> tuple[str, str]:
    """Split text after a number into its unit, if it begins with one, and the rest."""
    match = re.match(r"[ \t]*([^\s,;|:=\[\](){}\"']+)(?=$|[\s,;|)\]}])(?!\s*[:=])", piece)
    return (match[1], piece[match.end() :]) if match and is_unit(match[1]) else ("", piece)


def _words(piece: str) -> tuple[tuple[str, ...], str]:
    """Return the words of the name before a number, from the outermost, and the unit in brackets if any."""
    brackets = re.findall(r"[\[(]([^\[\]()]*)[\])]", piece)
    unit = next(filter(is_unit, brackets), "")
    if unit:
        piece = re.sub(rf"[\[(]{re.escape(unit)}[\])]", "", piece)
    piece = re.sub(r"[\"']", "", _QUOTED.sub("?", piece))
    *parts, last = re.split(rf"{_AFTER_VALUE}|(?<=[{re.escape(_AFTER_NAME)}])", piece)
    named: list[str] = []
    for part in filter(str.strip, parts):
        is_name = part.strip()[-1] in _AFTER_NAME
        named = [*named, part.strip()[:-1]] if is_name else []
    words = re.findall(r"[^\W\d][\w.]*", " ".join([*named, last]))
    return tuple(words), unit


def _names_of(values: Sequence[_Value]) -> Iterator[str | None]:
    """Yield the name of each number: axes and times by the fewest words that tell them, others by all."""
    k = 0
    while k < len(values):
        end = k + 1
        while end < len(values) and values[end].follows and values[end].words == values[k].words:
            end += 1
        words, size = values[k].words, end - k
        elements = [""] if size == 1 else [f"[{i}]" for i in range(size)]
        for element in elements:
            names = [" ".join(words[-n:]) + element for n in range(1, len(words) + 1)]
            known = [name for name in names if recognise(name).role != "auxiliary" and size in (1, 3)]
            yield next(iter(known), names[-1] if names else None)
        k = end


def _with_units(names: Sequence[str | None], values: Sequence[_Value]) -> list[str | None]:
    """Labels with the units of numbers, or of the last one in a group."""
    units = [value.unit for value in values]
    for k in range(1, len(values)):
        units[k] = units[k] or (units[k - 1] if values[k].follows else "")
    for k in reversed(range(1, len(values))):
        units[k - 1] = units[k - 1] or (units[k] if values[k].follows else "")
    labels: list[str | None] = []
    for name, unit in zip(names, units, strict=True):
        label = f"{name} [{unit}]" if name and unit and not split_unit(name)[1] else name
        labels.append(f"{label} {len(labels) + 1}" if label in labels and label else label)
    return labels


def _names_before(count: int, delimiter: str | None, before: Sequence[str]) -> list[str]:
    """Return the names of the last numbers of a message in a line before the messages; none if there is none."""
    for text in reversed(before):
        bare = re.sub(r"\*\w+\s*$", "", _BEFORE_NAMES.sub("", text))
        cells = trimmed(_split(bare, delimiter))[-count:]
        if recognise(cells[0]).role == "auxiliary":
            cells[0] = cells[0].split()[-1] if cells[0] else ""
        if any(map(_is_axis, cells)):
            return cells
    return []


# --- Devices -------------------------------------------------------------------------------------------------


@functools.cache
def _devices() -> list[dict[str, Any]]:
    text = files(__package__).joinpath("devices.toml").read_text(encoding="utf-8")
    return tomllib.loads(text)["device"]


def _of_device(found: Grammar, before: Sequence[str], row: str, file: str) -> Grammar:
    """Return the grammar with what the published format of a device says, if the text is of one."""
    texts = {"head": "\n".join(before), "labels": ",".join(found.labels or ()), "row": row, "file": file}
    for device in _devices():
        fits = all(re.search(device[key], text) for key, text in texts.items() if key in device)
        columns = device.get("columns", ())
        if not fits or device.get("count", found.fields) != found.fields or len(columns) > found.fields:
            continue
        labels = found.labels
        if columns:
            if labels is not None and found.message is None:
                continue
            labels = tuple(columns)
        rename = device.get("rename", {})
        units = {sensor: device[sensor] for sensor in SENSORS if sensor in device}
        said = [f"{_SENSORS[sensor]} in {unit}" for sensor, unit in units.items()]
        note = f"{', '.join(['columns', *said]) if columns else ', '.join(said)} by the format of {device['name']}"
        message = found.message
        if message is not None and columns:
            every = range(message.pattern.groups)
            message = replace(message, cells=tuple(every)[-len(columns) :])
        return replace(
            found,
            fields=len(columns) or found.fields,
            labels=labels and tuple(rename.get(label, label) for label in labels),
            message=message,
            notes=(*found.notes, note),
            units=units,
            sizes=device.get("sizes", {}),
        )
    return found

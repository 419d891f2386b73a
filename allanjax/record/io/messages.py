"""Messages in text: what loggers, terminals and drivers print for a sample, in a line or in several.

The shape of a message is its text with a mark in place of each number; messages of one shape are the rows of
a table, and the words before a number name it.
"""

import functools
import itertools
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from allanjax.record.columns import recognise, split_unit
from allanjax.record.io.cells import (
    TIME,
    VALUE,
    delimiter_of,
    is_axis,
    is_number,
    is_unit_name,
    split,
    trimmed,
    without_mark,
)

#: A line, or lines of a message, with the number of the first one from 0.
Numbered = tuple[int, str]

# UNIX times in s, ms, µs and ns.
_DATED = re.compile(rf"1\d{{9}}(?:\.\d+|(?:\d{{3}}){{0,3}})|{TIME}")
# Marks at the ends of messages that may differ, as those of the elements of a list; and text in quotes.
_ENDS = r"[\s\[\](){},;]*"
_QUOTED = re.compile(r'"[^"\0]*"(?=[,}\]])')
# Roughly a number, a missing one or a word of bits, which is matched faster.
_ROUGHLY = r"[-+]?\.?\d[-+.\w]*|(?i:nan|null|none|inf\w*|[\da-f]{8})"
# A check sum, in hexadecimal digits, and marks at the start of messages that have one, or of comments.
_SUM, _MARKS = re.compile(r"\*([\da-fA-F]{2}|[\da-fA-F]{8})\s*$"), tuple("$#%!@/")
# Marks after names, and marks after values.
_AFTER_NAME, _AFTER_VALUE = ":=({[", r"[,;|)}\]>\n]"
# The words of a time without a name, and of the axes of a group.
_TIMES, _XYZ = ("time",), ("x", "y", "z")
# Shapes that are tried, the fewest messages of one, their share where several lines are one, and numbers if
# none is named.
_SHAPES, _FEWEST, _SHARE, _UNNAMED = 10, 3, 0.8, 3


@dataclass(frozen=True)
class Message:
    """Messages of one shape, whose numbers are rows.

    Attributes:
        shape: the text with \\0 in place of numbers.
        cells: which numbers are columns.
        others: shapes of other messages in the file, which are left out.
        is_summed: whether messages end with a check sum.
        mark: line between messages, or text at the start of their first lines; None if each is a line.
    """

    shape: str
    cells: tuple[int, ...]
    others: frozenset[str] = frozenset()
    is_summed: bool = False
    mark: str | None = None

    @functools.cached_property
    def pattern(self) -> re.Pattern[str]:
        """Pattern of a message, whose groups are the numbers."""
        cell = rf"\s*({_ROUGHLY}|{TIME})\s*"
        parts = {"\0": cell, "\1": r'[^"]*', " ": r"\s+"}
        whole = "".join(parts.get(c, c if c.isalnum() else rf"\s*{re.escape(c)}\s*") for c in self.shape)
        return re.compile(re.sub(r"(?:\\s\*)+", r"\\s*", rf"{_ENDS}{whole}{_ENDS}"))

    @property
    def opening(self) -> str:
        """Text at the start of messages, before the first number."""
        return self.shape.partition("\0")[0]

    def row(self, text: str) -> tuple[str, ...] | None:
        """Cells of a message; none if it is damaged, None if the text is something else."""
        # Of several lines, the first ones may be of something else.
        matches = self.pattern.fullmatch if self.mark is None else self.pattern.search
        match = matches(_SUM.sub("", text))
        if match and (not self.is_summed or _has_right_sum(text)):
            groups = match.groups()
            return tuple(groups[k] for k in self.cells)
        if self.is_other(text):
            return None
        # Where messages have check sums, there is nothing else.
        is_part = self.is_summed or 2 * len(VALUE.findall(text)) >= self.pattern.groups > 2
        return () if is_part else None

    def is_other(self, text: str) -> bool:
        """Whether a text is another message, or a comment."""
        bare = text.lstrip()
        if self.is_summed and bare.startswith(_MARKS):
            return not bare.startswith(self.opening)
        return _shape(text) in self.others


class Found(NamedTuple):
    """Messages found in the first lines: the first line, the labels if there are names, and an example."""

    start: int
    message: Message
    labels: tuple[str, ...] | None
    example: str

    @property
    def axes(self) -> int:
        """How many axes it names."""
        return sum(map(is_axis, self.labels or ()))


def messages_in(head: Sequence[Numbered]) -> Found | None:
    """Return the messages with most axes, in lines or in groups of them, the most frequent ones of these.

    None if there are none with numbers.
    """
    best: Found | None = None
    for mark in (None, "---", "", *_openings(head)):
        records = list(records_of(head, mark))
        # The last one of several lines may be cut.
        records = records if mark is None else records[:-1]
        shapes = Counter(_shape(text) for _, text in records)
        usual = {shape for shape in shapes if shapes[shape] >= _FEWEST}
        words = frozenset(shape for shape in usual if re.search(r"[^\W\d]", shape))
        for shape, count in shapes.most_common(_SHAPES):
            if shape not in usual or (mark is not None and count < _SHARE * len(records)):
                continue
            examples = [record for record in records if _shape(record[1]) == shape]
            found = _found(shape, examples, [text for n, text in head if n < examples[0][0]], mark)
            if found is not None and (best is None or found.axes > best.axes):
                best = found._replace(message=replace(found.message, others=words - {shape}))
    return best


def _openings(head: Sequence[Numbered]) -> list[str]:
    """Text before the number in the first of the lines that recur, which may begin a message of several."""
    shapes = Counter(_shape(text) for _, text in head)
    for _, text in head:
        opening = VALUE.split(text)[0].rstrip()
        if shapes[_shape(text)] >= _FEWEST and opening != text.rstrip() and re.search(r"[^\W\d]", opening):
            return [opening]
    return []


def records_of(lines: Iterable[Numbered], mark: str | None) -> Iterator[Numbered]:
    """Yield records: the lines between two marks, or from one text at the start to the next; or each line."""
    if mark is None:
        yield from lines
        return
    number, held = 0, list[str]()
    for n, text in lines:
        is_between = text.strip() == mark
        if held and (is_between or (mark and text.startswith(mark))):
            yield number, "\n".join(held)
            held = []
        if text.strip() and not is_between:
            number = number if held else n
            held.append(text)
    if held:
        yield number, "\n".join(held)


def _shape(text: str) -> str:
    """Text with \\0 in place of what varies, and white space only between words."""
    shape = re.sub(r"\s+", " ", VALUE.sub("\0", _SUM.sub("", text)))
    shape = _QUOTED.sub('"\1"', re.sub(r" ?([^\w ]) ?", r"\1", shape))
    return re.sub(rf"^{_ENDS}|{_ENDS}$", "", shape)


def _has_right_sum(text: str) -> bool:
    """Whether a message has a check sum: one of two digits is the exclusive or of what is between $ and *."""
    end = _SUM.search(text)
    if end is None or len(end[1]) != 2:
        return end is not None
    body = text.strip()[1:].rpartition("*")[0].encode()
    return np.bitwise_xor.reduce(np.frombuffer(body, np.uint8)) == int(end[1], 16)


def _found(shape: str, examples: Sequence[Numbered], before: Sequence[str], mark: str | None) -> Found | None:
    """Return messages of a shape; None if they are numbers and delimiters alone, or have too few numbers."""
    number, text = examples[0]
    columns = list(zip(*(VALUE.findall(_SUM.sub("", text)) for _, text in examples), strict=False))
    names = _labels_of(_SUM.sub("", text), before)
    numbers = sum(is_number(column[0]) for column in columns)
    has_axes = any(is_axis(name) for name in names if name)
    if not re.search(r"[^\s,;|]", VALUE.sub("", text)) or (numbers < _UNNAMED and not has_axes):
        return None
    # Beside axes, numbers that are the same in all messages tell nothing, unless they have a name.
    varies = [not has_axes or len(set(column)) > 1 for column in columns]
    cells = tuple(k for k, name in enumerate(names) if name or varies[k])
    labels = tuple(names[k] or f"column {k + 1}" for k in cells) if any(names) else None
    is_summed = all(_SUM.search(text) for _, text in examples)
    return Found(
        number if mark is None else 0, Message(shape, cells, is_summed=is_summed, mark=mark), labels, text
    )


class _Value(NamedTuple):
    """A number in a message: the words before it, its unit, and whether it goes on with a group."""

    words: tuple[str, ...]
    unit: str
    follows: bool


def _labels_of(text: str, before: Sequence[str]) -> list[str | None]:
    """Return the label of each number in a message; None if no words before it and no header name it."""
    values: list[_Value] = []
    pieces = VALUE.split(text)
    for piece, token in itertools.zip_longest(pieces, VALUE.findall(text), fillvalue=""):
        unit, piece = _unit_before(piece) if values else ("", piece)
        if unit:
            values[-1] = values[-1]._replace(unit=unit)
        words, unit = _words(piece)
        last = values[-1].words if values else ()
        follows = last not in ((), _TIMES) and not re.search(r"\w", piece)
        if not words and _DATED.fullmatch(token):
            words, follows = _TIMES, False
        elif words[:-1] == () != last[:-1] and {*words, last[-1]} <= {*_XYZ, *map(str.upper, _XYZ)}:
            words, follows = (*last[:-1], *words), True
        values.append(_Value(words or (last if follows else ()), unit, follows))
    # What follows the last number is but a unit.
    values.pop()
    names = [*_names_of(values)]
    # Where no number has the name of an axis, names such as that of a program say nothing.
    has_axes = any(is_axis(name) for name in names if name)
    says_nothing = (lambda name: name is None) if has_axes else _says_nothing
    unnamed = len(list(itertools.takewhile(says_nothing, reversed(names))))
    if unnamed > 1:
        delimiter = delimiter_of("".join(pieces[-unnamed:-1]))
        header = next(filter(None, (_names_in(line, delimiter, unnamed) for line in reversed(before))), [])
        names[len(names) - len(header) :] = header
    return _with_units(names, values)


def _says_nothing(name: str | None) -> bool:
    """Whether a number has no name, or one that is neither an axis nor a time, such as that of a program."""
    return name is None or recognise(name).role == "auxiliary"


def _unit_before(piece: str) -> tuple[str, str]:
    """Split text after a number into its unit, if it begins with one, and the rest."""
    match = re.match(r"[ \t]*([^\s,;|:=\[\](){}\"']+)(?=$|[\s,;|)\]}])(?!\s*[:=])", piece)
    return (match[1], piece[match.end() :]) if match and is_unit_name(match[1]) else ("", piece)


def _words(piece: str) -> tuple[tuple[str, ...], str]:
    """Return the words of the name before a number, from the outermost, and the unit in brackets if any."""
    unit = next(filter(is_unit_name, re.findall(r"[\[(]([^\[\]()]*)[\])]", piece)), "")
    if unit:
        piece = re.sub(rf"[\[(]{re.escape(unit)}[\])]", "", piece)
    piece = re.sub(r"[\"']", "", _QUOTED.sub("?", piece))
    *parts, last = re.split(rf"{_AFTER_VALUE}|(?<=[{re.escape(_AFTER_NAME)}])", piece)
    named: list[str] = []
    for part in filter(str.strip, parts):
        is_name = part.strip()[-1] in _AFTER_NAME
        named = [*named, part.strip()[:-1]] if is_name else []
    words = tuple(re.findall(r"[^\W\d][\w.]*", " ".join([*named, last])))
    # Without a mark after it, only what is known is a name.
    is_known = not re.search(r"\w", last) or _known(words, "") or _known(words, "[0]")
    return (words if is_known else ()), unit


def _known(words: Sequence[str], element: str) -> str | None:
    """The name of an axis, a time or a counter in the fewest last words; None if it is none."""
    names = (" ".join(words[-n:]) + element for n in range(1, len(words) + 1))
    return next((name for name in names if recognise(name).role != "auxiliary"), None)


def _names_of(values: Sequence[_Value]) -> Iterator[str | None]:
    """Yield the name of each number; three numbers after one name are axes."""
    k = 0
    while k < len(values):
        words = values[k].words
        size = 1
        while k + size < len(values) and values[k + size].follows and values[k + size].words == words:
            size += 1
        for place in range(size):
            element = f"[{place}]" if size > 1 else ""
            known = _known(words, element) if size in (1, len(_XYZ)) else None
            # A letter says little without what is before it.
            short = words if words and len(words[-1]) == 1 else words[-1:]
            yield known or (" ".join(short) + element if words else None)
        k += size


def _with_units(names: Sequence[str | None], values: Sequence[_Value]) -> list[str | None]:
    """Labels with the units of the numbers, or of another one in their group."""
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


def _names_in(line: str, delimiter: str | None, count: int) -> list[str]:
    """Return the names that a line before the messages has for their last numbers; none if it has none."""
    cells = trimmed(split(re.sub(r"\*\w+\s*$", "", without_mark(line)), delimiter))[-count:]
    if cells and cells[0] and recognise(cells[0]).role == "auxiliary":
        cells[0] = cells[0].split()[-1]
    return cells if any(map(is_axis, cells)) else []

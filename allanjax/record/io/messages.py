"""Messages: what loggers, terminals and drivers print for each sample, on one line or on several.

The shape of a message is its text with a placeholder for each number. Messages of the same shape are the rows
of a table, and the words before a number name its column.
"""

import functools
import itertools
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from allanjax.record.columns import elements_of, recognise, with_unit
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

#: The text of a line, or of a message of several lines, and the number of its first line, from 0.
Numbered = tuple[int, str]

# A UNIX time in s, ms, µs or ns, or a date.
_DATED = re.compile(rf"1\d{{9}}(?:\.\d+|(?:\d{{3}}){{0,3}})|{TIME}")
# Punctuation at both ends of a message, which may differ from one to the next: the last element of a list has
# no comma. And text in quotes, which may differ, too.
_ENDS = r"[\s\[\](){},;]*"
_QUOTED = re.compile(r'"[^"\0]*"(?=[,}\]])')
# A coarse pattern, which is fast, for a number, a missing one, or a word of hexadecimal digits.
_ROUGHLY = r"[-+]?\.?\d[-+.\w]*|(?i:nan|null|none|inf\w*|[\da-f]{8})"
# A checksum at the end of a line, and the first characters of lines that have one, or are comments.
_SUM, _MARKS = re.compile(r"\*([\da-fA-F]{2}|[\da-fA-F]{8})\s*$"), tuple("$#%!@/")
# Punctuation that follows a name, and punctuation that follows a value.
_AFTER_NAME, _AFTER_VALUE = ":=({[", r"[,;|)}\]>\n]"
# The name that a time without one is given, and the names of the axes in a group of three.
_TIMES, _XYZ = ("time",), ("x", "y", "z")
# How many of the most frequent shapes are tried, and how many messages a shape needs.
_SHAPES, _FEWEST = 10, 3
# Share of the messages that a shape needs where one has several lines; and numbers without an axis.
_SHARE, _UNNAMED = 0.8, 3


@dataclass(frozen=True)
class Message:
    """Messages of one shape; each is a row.

    Attributes:
        shape: the text, with \\0 for each number.
        cells: which of the numbers are columns.
        others: shapes of other messages in the file, which are left out.
        is_summed: whether messages end with a checksum.
        mark: the line between two messages, or the text that begins each; None if a message is one line.
    """

    shape: str
    cells: tuple[int, ...]
    others: frozenset[str] = frozenset()
    is_summed: bool = False
    mark: str | None = None

    @functools.cached_property
    def pattern(self) -> re.Pattern[str]:
        """Pattern of a message with a group for each number."""
        # A number of a damaged message must not count as two.
        cell = rf"\s*(?<![\d.])({_ROUGHLY}|{TIME})(?!\d)\s*"
        parts = {"\0": cell, "\1": r'[^"]*', " ": r"\s+"}
        whole = "".join(parts.get(c, c if c.isalnum() else rf"\s*{re.escape(c)}\s*") for c in self.shape)
        return re.compile(re.sub(r"(?:\\s\*)+", r"\\s*", rf"{_ENDS}{whole}{_ENDS}"))

    @property
    def opening(self) -> str:
        """Text at the start of messages, before the first number."""
        return self.shape.partition("\0")[0]

    def row(self, text: str) -> tuple[str, ...] | None:
        """The cells of a message: an empty tuple if it is damaged, None if the text is something else."""
        # Lines of something else may come before the first line of a message of several lines.
        matches = self.pattern.fullmatch if self.mark is None else self.pattern.search
        match = matches(_SUM.sub("", text))
        if match and (not self.is_summed or _has_right_sum(text)):
            groups = match.groups()
            return tuple(groups[k] for k in self.cells)
        if self.is_other(text):
            return None
        # Where messages have checksums, all other text is a damaged message.
        is_part = self.is_summed or 2 * len(VALUE.findall(text)) >= self.pattern.groups > 2
        return () if is_part else None

    def is_other(self, text: str) -> bool:
        """Whether a text is another message, or a comment."""
        bare = text.lstrip()
        if self.is_summed and bare.startswith(_MARKS):
            return not bare.startswith(self.opening)
        return _shape(text) in self.others


class Found(NamedTuple):
    """Messages found in the first lines of a file.

    Attributes:
        start: number of the line with the first message.
        message: their shape.
        labels: labels of the columns, if any has a name.
        example: the first message.
    """

    start: int
    message: Message
    labels: tuple[str, ...] | None
    example: str

    @property
    def axes(self) -> int:
        """How many axes it names."""
        return sum(map(is_axis, self.labels or ()))


def messages_in(head: Sequence[Numbered]) -> Found | None:
    """Return the messages that name the most axes, and of these the most frequent; None if there are none.

    A message may be a line, or several lines up to a mark.
    """
    best: Found | None = None
    for mark in (None, "---", "", *_openings(head)):
        records = list(records_of(head, mark))
        # The last message of several lines may be cut off.
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
                kinds = {_shape(text): text for _, text in records}
                others = frozenset(x for x in words if not _are_alike(x, kinds[x], shape, found))
                best = found._replace(message=replace(found.message, others=others))
    return best


def _are_alike(other: str, text: str, shape: str, found: Found) -> bool:
    """Whether a shape, of which a text is an example, is that of unusual messages like those found.

    These differ in digits of words alone, or name the same axes: to leave them out would leave gaps.
    """
    if re.sub(r"[\d_]+", "", other) == re.sub(r"[\d_]+", "", shape):
        return True
    axes = {label for label in found.labels or () if is_axis(label)}
    return bool(axes) and axes <= {*_labels_of(text, [])}


def _openings(head: Sequence[Numbered]) -> list[str]:
    """Text before the first number of the first line that recurs; it may begin a message of several lines."""
    shapes = Counter(_shape(text) for _, text in head)
    for _, text in head:
        opening = VALUE.split(text)[0].rstrip()
        if shapes[_shape(text)] >= _FEWEST and opening != text.rstrip() and re.search(r"[^\W\d]", opening):
            return [opening]
    return []


def records_of(lines: Iterable[Numbered], mark: str | None) -> Iterator[Numbered]:
    """Yield records: without a mark each line, else the lines between two marks, or from one to the next."""
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
    """The shape of a text: \\0 for each number, and white space only between words."""
    shape = re.sub(r"\s+", " ", VALUE.sub("\0", _SUM.sub("", text)))
    shape = _QUOTED.sub('"\1"', re.sub(r" ?([^\w ]) ?", r"\1", shape))
    return re.sub(rf"^{_ENDS}|{_ENDS}$", "", shape)


def _has_right_sum(text: str) -> bool:
    """Whether a message has a right checksum: two digits are the exclusive or of the bytes between $ and *.

    Longer ones are not checked.
    """
    end = _SUM.search(text)
    if end is None or len(end[1]) != 2:
        return end is not None
    body = text.strip()[1:].rpartition("*")[0].encode()
    return np.bitwise_xor.reduce(np.frombuffer(body, np.uint8)) == int(end[1], 16)


def _found(shape: str, examples: Sequence[Numbered], before: Sequence[str], mark: str | None) -> Found | None:
    """Return messages of a shape; None if it is but numbers and delimiters, or has too few numbers."""
    number, text = examples[0]
    columns = list(zip(*(VALUE.findall(_SUM.sub("", text)) for _, text in examples), strict=False))
    names = _labels_of(_SUM.sub("", text), before)
    numbers = sum(is_number(column[0]) for column in columns)
    has_axes = any(map(is_axis, filter(None, names)))
    if not re.search(r"[^\s,;|]", VALUE.sub("", text)) or (numbers < _UNNAMED and not has_axes):
        return None
    # Beside axes, a number without a name that is the same in all messages is no column.
    varies = [not has_axes or len(set(column)) > 1 for column in columns]
    cells = tuple(k for k, name in enumerate(names) if name or varies[k])
    labels = tuple(names[k] or f"column {k + 1}" for k in cells) if any(names) else None
    is_summed = all(_SUM.search(text) for _, text in examples)
    return Found(
        number if mark is None else 0, Message(shape, cells, is_summed=is_summed, mark=mark), labels, text
    )


class _Value(NamedTuple):
    """A number in a message: the words that name it, its unit, and whether it continues a group."""

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
    has_axes = any(map(is_axis, filter(None, names)))

    def says_nothing(name: str | None) -> bool:
        # Where no number has the name of an axis, names such as that of a program say nothing.
        return name is None or (not has_axes and recognise(name).role == "auxiliary")

    unnamed = len(list(itertools.takewhile(says_nothing, reversed(names))))
    if unnamed > 1:
        delimiter = delimiter_of("".join(pieces[-unnamed:-1]))
        sizes = [len(VALUE.findall(x)) if x[:1] in ("[", "(") else 1 for x in _cells(text, delimiter)]
        every = (_names_in(line, delimiter, unnamed, sizes) for line in reversed(before))
        header = next(filter(None, every), [])
        names[len(names) - len(header) :] = header
    return _with_units(names, values)


def _unit_before(piece: str) -> tuple[str, str]:
    """Split text after a number into its unit, if it begins with one, and the rest."""
    match = re.match(r"[ \t]*([^\s,;|:=\[\](){}\"']+)(?=$|[\s,;|)\]}])(?!\s*[:=])", piece)
    return (match[1], piece[match.end() :]) if match and is_unit_name(match[1]) else ("", piece)


def _words(piece: str) -> tuple[tuple[str, ...], str]:
    """Return the words that name a number, the outermost first, and the unit if one is there in brackets."""
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
    # Words without punctuation after them are a name only if it is a known one.
    is_known = not re.search(r"\w", last) or _known(words, "") or _known(words, "[0]")
    return (words if is_known else ()), unit


def _known(words: Sequence[str], element: str) -> str | None:
    """The fewest last words that name an axis, a time or a counter; None if there are none."""
    names = (" ".join(words[-n:]) + element for n in range(1, len(words) + 1))
    return next((name for name in names if recognise(name).role != "auxiliary"), None)


def _names_of(values: Sequence[_Value]) -> Iterator[str | None]:
    """Yield the name of each number; three numbers after the name of a sensor are its axes."""
    k = 0
    while k < len(values):
        words = values[k].words
        size = 1
        while k + size < len(values) and values[k + size].follows and values[k + size].words == words:
            size += 1
        for place in range(size):
            element = f"[{place}]" if size > 1 else ""
            known = _known(words, element) if size in (1, len(_XYZ)) else None
            # A single letter needs the word before it.
            short = words if words and len(words[-1]) == 1 else words[-1:]
            yield known or (" ".join(short) + element if words else None)
        k += size


def _with_units(names: Sequence[str | None], values: Sequence[_Value]) -> list[str | None]:
    """Labels with the unit of each number, or else that of another one in its group."""
    units = [value.unit for value in values]
    for k in range(1, len(values)):
        units[k] = units[k] or (units[k - 1] if values[k].follows else "")
    for k in reversed(range(1, len(values))):
        units[k - 1] = units[k - 1] or (units[k] if values[k].follows else "")
    # A unit behind the last axis of a sensor is that of all.
    sensors = [recognise(name or "").sensor for name in names]
    for k, sensor in enumerate(sensors):
        own = {unit for other, unit in zip(sensors, units, strict=True) if unit and other == sensor}
        units[k] = own.pop() if sensor and len(own) == 1 else units[k]
    labels: list[str | None] = []
    for name, unit in zip(names, units, strict=True):
        label = name and with_unit(name, unit)
        labels.append(f"{label} {len(labels) + 1}" if label in labels and label else label)
    return labels


def _cells(text: str, delimiter: str | None) -> list[str]:
    """The cells of a message, of which lists in brackets are one each."""
    if delimiter is None:
        return split(text, delimiter)
    lists = r"[\[(][^\[\]()]*[\])]"
    return split(re.sub(lists, lambda found: found[0].replace(delimiter, " "), text), delimiter)


def _names_in(line: str, delimiter: str | None, count: int, sizes: Sequence[int]) -> list[str]:
    """Return names of the last numbers of messages from a line before them; an empty list if it has none.

    The cells of a message have so many numbers each: those of a list are its elements.
    """
    cells = trimmed(split(re.sub(r"\*\w+\s*$", "", without_mark(line)), delimiter))
    if len(cells) == len(sizes) != sum(sizes) == count:
        pairs = zip(cells, sizes, strict=True)
        cells = [name for cell, size in pairs for name in ([cell] if size == 1 else elements_of(cell, size))]
    cells = cells[-count:] if len(cells) >= count else []
    if cells and cells[0] and recognise(cells[0]).role == "auxiliary":
        cells[0] = cells[0].split()[-1]
    return cells if any(map(is_axis, cells)) else []

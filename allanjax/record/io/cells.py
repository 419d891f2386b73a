"""Cells of lines of text: how they are separated, and what they are."""

import csv
import functools
import re

from allanjax.record.columns import by_unit, recognise
from allanjax.record.units import NUMBER, is_unit

# Dates and clocks; and with numbers, missing ones and words of bits, what varies from one line to the next.
_DATE = r"\d{1,4}(?:-\d\d?-|/\d\d?/|\.\d\d?\.)\d{1,4}"
# A colon may be before milliseconds; beside a date, dots may be in place of colons; hours may be left out.
_CLOCK, _DOTTED = r"\d\d?:\d\d:\d\d(?:[.,:]\d+)?", r"\d\d\.\d\d\.\d\d\.\d+"
_MINUTES = r"\d\d?:\d\d\.\d+(?![:\d])"
TIME = rf"(?<![\w.:])(?:{_DATE}(?:[T ](?:{_CLOCK}|{_DOTTED})(?:Z|[+-]\d\d:?\d\d)?)?|{_CLOCK}|{_MINUTES})"
_NUMBER = rf"(?<![\w.^])(?<![A-Za-z^]-){NUMBER}(?![\dx])|\b(?:nan|null|none|inf(?:inity)?)\b"
# A date with its offset after a blank, which between blanks might be a number.
_WITH_ZONE = re.compile(rf"{TIME} [+-]\d\d:?\d\d")
VALUE = re.compile(rf"(?i:{TIME}|\b(?=\d*[a-f])[\da-f]{{8}}\b|{_NUMBER})")
# A number beside anything but a delimiter: `x=0.1`, `[0.1`, `0.1 deg/s`; or a name before one.
_DECORATED = re.compile(r".*[\[({<=>|]\s*[-+]?\.?\d|:\s*[-+.\d]|[-+]?\.?\d.*[^\w.]|.*\d[.:]\d|\D*[:=]$")
# Numbers with a decimal comma, and numbers whose commas separate thousands.
_COMMA = re.compile(r"[+-]?\d+,\d+(?:[eE][+-]?\d+)?")
_THOUSANDS = re.compile(r"[+-]?[1-9]\d{0,2}(?:,\d{3})+(?:\.\d*)?")
# Rules that databases draw between rows, and the number of rows that they write below them.
_BORDER = re.compile(
    r"[\s|+:=─┼-]*(?:-{4}|={4}|-\+-|─)[\s|+:=─┼-]*|\s*\(?\d+ (?:rows?|Zeilen?|lignes?|filas?)\b.*"
)
# Marks at the start of comments.
_COMMENT = ("#", "%", "//")
_BEFORE_NAMES = re.compile(r"^\s*(?:[#/;!*>]+|%+\s|--+|REM\s)\s*")


def is_comment(text: str) -> bool:
    """Whether a line is a comment."""
    return text.lstrip().startswith(_COMMENT)


def is_border(text: str) -> bool:
    """Whether a line is a rule between the rows of a table, or says how many these are."""
    return _BORDER.fullmatch(text) is not None


def without_mark(text: str) -> str:
    """A line without a mark before its names; the % of `%time`, as ROS writes it, is part of the name."""
    return _BEFORE_NAMES.sub("", text)


def delimiter_of(text: str) -> str | None:
    """Return the delimiter of a line; None for white space."""
    return next((mark for mark in "\t;,|" if mark in text), None)


def delimiter_beside_commas(text: str) -> str | None:
    """Return the delimiter of a line of numbers with decimal commas, which are in quotes if it is a comma."""
    return next((mark for mark in "\t;" if mark in text), "," if '"' in text else None)


def has_decimal_commas(text: str) -> bool:
    """Whether a line has numbers with decimal commas; between blanks, all cells are numbers or times."""
    delimiter = delimiter_beside_commas(text)
    cells = split(text, delimiter) if "," in text else []
    numbers = [cell for cell in cells if _COMMA.fullmatch(cell)]
    if not numbers or any("." in cell and is_number(cell) for cell in cells):
        return False
    if delimiter is None:
        return len(cells) > 1 and all(cell in numbers or VALUE.fullmatch(cell) for cell in cells)
    return delimiter != "," or not all(map(_THOUSANDS.fullmatch, numbers))


def with_points(cells: list[str]) -> list[str]:
    """Return cells of which numbers have a decimal point in place of a comma."""
    return [cell.replace(",", ".") if _COMMA.fullmatch(cell) else cell for cell in cells]


def without_groups(cells: list[str], delimiter: str | None) -> list[str]:
    """Return cells between commas, of which numbers in quotes have lost the commas between thousands."""
    if delimiter != ",":
        return cells
    return [cell.replace(",", "") if _THOUSANDS.fullmatch(cell) else cell for cell in cells]


def split(text: str, delimiter: str | None) -> list[str]:
    """Return the cells of a line."""
    if delimiter is None:
        # A unit belongs to the name before it and may contain spaces.
        return re.split(r"\s+(?![\[(]|[^\[\](]*[\])])", text.strip())
    if delimiter == "|":
        # Bars may be around a row, too.
        text = re.sub(r"^\s*\|(.*)\|\s*$", r"\1", text)
    cells = next(csv.reader([text.strip(" \r\n")], delimiter=delimiter, skipinitialspace=True), [])
    return [cell.strip() for cell in cells]


def trimmed(cells: list[str]) -> list[str]:
    """Return the cells without empty ones at the end of the line."""
    size = max((k + 1 for k, cell in enumerate(cells) if cell), default=1)
    return cells[:size]


def fits(cells: list[str], count: int) -> bool:
    """Whether there are so many cells, apart from empty ones at the end of the line."""
    return len(cells) >= count and not any(cells[count:])


def is_number(text: str) -> bool:
    """Whether a cell is a number."""
    try:
        float(text)
    except ValueError:
        return False
    return True


def is_unit_name(text: str) -> bool:
    """Whether a text is a unit, and not a number."""
    return is_unit(text) and not is_number(text)


def is_decorated(cell: str, delimiter: str | None) -> bool:
    """Whether a cell is a number and something else, or, between blanks, a mark such as ->."""
    if is_number(cell) or VALUE.fullmatch(cell) or _WITH_ZONE.fullmatch(cell):
        return False
    is_mark = delimiter is None and not any(map(str.isalnum, cell))
    return is_mark or _DECORATED.match(cell) is not None


@functools.cache
def is_axis(label: str) -> bool:
    """Whether a label is that of an axis, by its name or its unit."""
    return not is_number(label) and by_unit(recognise(label)).role == "axis"

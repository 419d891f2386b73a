"""Tables of results as text and as HTML; and text in ASCII for an output without Unicode, `deg/sqrt(h)`.

Empty columns of tables are left out.
"""

from __future__ import annotations

import codecs
import html
import io
import re
import sys
import textwrap
import unicodedata
from collections.abc import Sequence
from typing import ClassVar, TextIO

ERRORS = "allanjax"
"""Name of the error handler that writes these replacements, for `str.encode` and for streams."""

# Roots and raised digits, which are written as a whole, and single characters.
_ROOT = re.compile(r"√([A-Za-z]+)")
_RAISED = re.compile("[⁰¹²³⁴⁵⁶⁷⁸⁹⁺⁻]+")
_LEVEL = str.maketrans("⁰¹²³⁴⁵⁶⁷⁸⁹⁺⁻", "0123456789+-")
_PAIRS = (
    "√ sqrt, ± +-, · *, × x, µ u, μ u, ° deg, … ..., – -, — -, − -, → ->, ← <-, ≤ <=, ≥ >=, ≪ <<, ≫ >>, ≈ ~, "
    "≠ !=, ∞ inf, ½ 1/2, ∑ sum, ∫ integral, ‘ ', ’ ', “ \", ” \""
)
_WORDS = dict(pair.split() for pair in _PAIRS.split(", "))


def _in_words(error: UnicodeError) -> tuple[str, int]:
    """Replacement for characters that cannot be encoded, and the index at which to go on."""
    if not isinstance(error, UnicodeEncodeError):
        raise error
    text, at = error.object, error.start
    if root := _ROOT.match(text, at):
        return f"sqrt({root[1]})", root.end()
    if raised := _RAISED.match(text, at):
        return f"^{raised[0].translate(_LEVEL)}", raised.end()
    return _word(text[at]), at + 1


def _word(character: str) -> str:
    """ASCII replacement of one character."""
    if character in _WORDS:
        return _WORDS[character]
    name = unicodedata.name(character, "")
    if found := re.fullmatch(r"GREEK (SMALL|CAPITAL) LETTER ([A-Z]+)", name):
        return found[2].lower() if found[1] == "SMALL" else found[2].capitalize()
    if name.startswith("BOX DRAWINGS"):
        corner = " AND " in name or not name.endswith(("HORIZONTAL", "VERTICAL"))
        return "+" if corner else "-" if name.endswith("HORIZONTAL") else "|"
    # It may be part of a name, which must not become another.
    return character.encode("ascii", "backslashreplace").decode()


codecs.register_error(ERRORS, _in_words)


def printable(text: str) -> str:
    """The text, with ASCII replacements for what the standard output cannot show."""
    encoding = getattr(sys.stdout, "encoding", None)
    try:
        return text.encode(encoding, ERRORS).decode(encoding) if encoding else text
    except LookupError:
        return text


def speak_plainly(stream: TextIO) -> None:
    """Make a stream write ASCII replacements for what it cannot show, instead of failing."""
    if isinstance(stream, io.TextIOWrapper):
        stream.reconfigure(errors=ERRORS)


def is_unicode(stream: TextIO) -> bool:
    """Whether a stream can show all of Unicode."""
    return (getattr(stream, "encoding", None) or "utf-8").lower().replace("-", "").startswith("utf")


WIDTH = 100
"""Width of printed tables, in characters."""


def text_table(
    title: str, headings: Sequence[str], rows: Sequence[Sequence[str]], right: Sequence[str] = ()
) -> str:
    """Table as text, with a line under the headings; a name in the first column is not repeated below itself.

    Cells are printed as they are, without markup. `right` are the headings of right-aligned columns.
    """
    from rich.box import SIMPLE_HEAD
    from rich.console import Console
    from rich.table import Table

    headings, rows = _filled(headings, rows)
    table = Table(box=SIMPLE_HEAD, pad_edge=False, show_edge=False)
    for heading in headings:
        table.add_column(printable(heading), justify="right" if heading in right else "left")
    previous = None
    for first, *others in rows:
        table.add_row(*map(printable, (first if first != previous else "", *others)))
        previous = first
    # In a notebook rich would show an empty block for each table that is made.
    console = Console(
        width=WIDTH, force_jupyter=False, color_system=None, markup=False, emoji=False, highlight=False
    )
    with console.capture() as capture:
        console.print(table)
    lines = [line.rstrip() for line in capture.get().rstrip("\n").splitlines()]
    return "\n".join([*([wrapped(title)] if title else []), *lines])


def wrapped(line: str) -> str:
    """The line broken at the width of printed tables, later lines indented."""
    kept = line.replace(" %", "\xa0%")
    text = textwrap.fill(kept, WIDTH, subsequent_indent="  ", break_on_hyphens=False)
    return printable(text.replace("\xa0", " "))


def html_table(title: str, headings: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Table as HTML for a notebook."""
    headings, rows = _filled(headings, rows)
    head = "".join(f"<th>{html.escape(heading)}</th>" for heading in headings)
    body = "".join(
        "<tr>" + "".join(f"<td style='text-align:left'>{html.escape(cell)}</td>" for cell in row) + "</tr>"
        for row in rows
    )
    return f"<p>{html.escape(title)}</p><table><tr>{head}</tr>{body}</table>"


class Tabled:
    """A result that prints as a table, with warnings above and notes below."""

    #: Headings of the printed table, and the headings of its right-aligned columns.
    HEADINGS: ClassVar[tuple[str, ...]] = ()
    RIGHT: ClassVar[tuple[str, ...]] = ()

    @property
    def warnings(self) -> tuple[str, ...]:
        """What a user should know before reading the numbers, in words."""
        return ()

    def _title(self) -> str:
        """Title of the printed table."""
        raise NotImplementedError

    def _cells(self) -> Sequence[Sequence[str]]:
        """The rows of the printed table."""
        raise NotImplementedError

    def _notes(self) -> Sequence[str]:
        """Lines below the printed table."""
        return ()

    def __str__(self) -> str:
        above = [wrapped(f"warning: {w}") for w in self.warnings]
        table = text_table(self._title(), self.HEADINGS, self._cells(), right=self.RIGHT)
        return "\n".join([*above, table, *map(wrapped, self._notes())])

    def __repr__(self) -> str:
        return str(self)

    def _repr_html_(self) -> str:
        above = "".join(f"<p><b>warning: {html.escape(w)}</b></p>" for w in self.warnings)
        below = "".join(f"<p>{html.escape(note)}</p>" for note in self._notes())
        return above + html_table(self._title(), self.HEADINGS, self._cells()) + below


def _filled(
    headings: Sequence[str], rows: Sequence[Sequence[str]]
) -> tuple[Sequence[str], Sequence[Sequence[str]]]:
    """Headings and rows without the columns that have nothing in any row."""
    kept = [k for k in range(len(headings)) if not rows or any(row[k] for row in rows)]
    return [headings[k] for k in kept], [[row[k] for k in kept] for row in rows]

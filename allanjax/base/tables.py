"""Results as text and HTML: tables, results of several axes, and ASCII for an output without Unicode."""

from __future__ import annotations

import codecs
import html
import io
import math
import re
import sys
import textwrap
import unicodedata
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, TextIO, TypeAlias, TypeVar

from allanjax.base.errors import AllanjaxError
from allanjax.base.wording import exponent, fixed, power_of, times_ten

if TYPE_CHECKING:
    import pandas as pd

ERRORS = "allanjax"
"""Name of the error handler that writes these replacements, for `str.encode` and for streams."""

# Roots, powers of ten and raised digits, which are written as a whole, and single characters.
_ROOT = re.compile(r"√([A-Za-z]+)")
_POWER = re.compile("×10([⁰¹²³⁴⁵⁶⁷⁸⁹⁻]+)")
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
    if power := _POWER.match(text, at):
        return f"e{int(power[1].translate(_LEVEL)):+03d}", power.end()
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
# Between the columns of a table.
_GAP = 3
# Spaces at which no line is broken: in "p = 0.1", "0.552 ± 0.001 Hz", "95 %" and "τ = 0.7 s".
_TOGETHER = re.compile(r" (?=[±%=<→×√])|(?<=[±=<>→]) |(?<=\d) (?=[A-Za-zµσ(²/°])|(?<=\b[A-Z]) (?=\d)")
_NUMERIC = re.compile(r"[-–<>()±…×⁻⁰¹²³⁴⁵⁶⁷⁸⁹\d., ]*")
# What marks of numbers mean.
_LEGEND = {
    r"< \d": "< x: not detected; 95 % upper limit",
    r"> \d": "> x: 95 % lower limit",
    r"\(\d": "(x): value of the fitted curve, not a measurement of the sensor",
}


def wrapped(text: str, width: int = WIDTH, first: str = "", rest: str = "  ") -> str:
    """Text in lines of a width, not broken within a word or between a number and its unit."""
    wrapper = textwrap.TextWrapper(width, first, rest, break_long_words=False, break_on_hyphens=False)
    return wrapper.fill(_TOGETHER.sub("\xa0", text)).replace("\xa0", " ")


class Number(NamedTuple):
    """A number in a column, with its error if it has one, and what is written before and after it."""

    value: float
    error: float = math.nan
    before: str = ""
    after: str = ""


Cell: TypeAlias = Number | float | str | None


class Column(NamedTuple):
    """Head and cells of a column. A column without text is not shown."""

    head: str
    cells: Sequence[str]

    @property
    def width(self) -> int:
        """Number of characters."""
        return max(len(line) for text in (self.head, *self.cells) for line in text.split("\n"))

    def broken(self) -> Column:
        """A copy with the unit in a second line of the head."""
        return self._replace(head=self.head.replace(" (", "\n("))


def column(name: str, unit: str, values: Sequence[Cell], digits: int = 3) -> Column:
    """Column of numbers with the decimals that their errors call for; without errors, of so many digits.

    Unit and power of ten are in the head. None and nan are empty cells; texts are kept, and right-aligned if
    all are numbers.
    """
    numbers = [Number(x) if isinstance(x, float) else x for x in values]
    known = [x for x in numbers if isinstance(x, Number) and math.isfinite(x.value)]
    largest = max((abs(x.value) for x in known), default=0.0)
    power = power_of(largest)
    by = 10.0**power
    places = sorted(1 - exponent(x.error / by) for x in known if 0.0 < x.error < math.inf)
    if places:
        # Two digits of the median error, and at least one of the smallest.
        decimals = max(places[len(places) // 2], places[-1] - 1)
    else:
        decimals = digits - 1 - exponent(largest / by)
    written = []
    for x in numbers:
        if isinstance(x, str):
            written.append((x, ""))
        elif x is None or not math.isfinite(x.value):
            written.append(("", ""))
        elif 0.0 < x.error < math.inf:
            own = min(decimals, 2 - exponent(x.error / by))
            written.append((x.before + fixed(x.value / by, own), f"{fixed(x.error / by, own)}{x.after}"))
        else:
            # A limit has two digits at least.
            own = max(decimals, 1 - exponent(x.value / by) if x.before and x.value else 0)
            written.append((f"{x.before}{fixed(x.value / by, own)}{x.after}", ""))
    left, right = (max((len(pair[k]) for pair in written), default=0) for k in (0, 1))
    aligned = "" if any(isinstance(x, str) and not _NUMERIC.fullmatch(x) for x in numbers) else ">"
    cells = [
        f"{value:{aligned}{left}} ± {error:>{right}}"
        if error
        else f"{value:{aligned}{left}}" + " " * (right and right + 3)
        for value, error in written
    ]
    unit = f"{times_ten(power)[1:]} {'' if unit == '1' else unit}".strip()
    head = f"{name} {unit if unit.startswith('(') else f'({unit})'}" if unit else name
    return Column(head, cells if any(map(any, written)) else [""] * len(cells))


def columns_from(heads: Sequence[str], rows: Iterable[Sequence[Cell]]) -> list[Column]:
    """Columns of the cells in these rows, with heads such as "N (deg/√h)"."""
    names = (head.removesuffix(")").partition(" (") for head in heads)
    cells = list(zip(*rows, strict=True)) or [()] * len(heads)
    return [column(name, unit, of, 3) for (name, _, unit), of in zip(names, cells, strict=True)]


def width_of(columns: Iterable[Column]) -> int:
    """Width of a table of these columns, in characters."""
    return sum(c.width + _GAP for c in columns) - _GAP


def tables_of(
    first: Sequence[Column], main: Sequence[Column], others: Sequence[Column], last: Sequence[Column] = ()
) -> list[list[Column]]:
    """Columns of as many tables as they need at the width of a page, the others being the first to move."""
    tables, others = [[*first, *main, *last]], [c for c in others if any(c.cells)]
    if width_of([*tables[0], *others]) > WIDTH:
        # Units in a second line of the head make columns narrower.
        tables = [[c.broken() for c in tables[0]]]
        others = [c.broken() for c in others]
    for one in others:
        if width_of([*tables[-1], one]) > WIDTH:
            tables.append(list(first))
        tables[-1].insert(len(tables[-1]) - (len(last) if len(tables) == 1 else 0), one)
    return tables


def as_text(title: str, tables: Sequence[Sequence[Column]], lines: Iterable[str] = ()) -> str:
    """Tables one below the other, and lines below them."""
    parts = [wrapped(title)] if title else []
    for k, columns in enumerate(tables):
        parts += ["", *_in_lines(columns)] if k else _in_lines(columns)
    return printable("\n".join([*parts, *map(wrapped, lines)]))


def _in_lines(columns: Sequence[Column]) -> list[str]:
    """Lines of a table; a text in the first column is not repeated below itself.

    If the table is too wide, units go into a second line of the head, columns move together, and at last
    cells are cut.
    """
    columns = [Column(printable(c.head), [*map(printable, c.cells)]) for c in columns if any(c.cells)]
    if width_of(columns) > WIDTH:
        columns = [c.broken() for c in columns]
    widths = [c.width for c in columns]
    between = len(widths) - 1
    gap = next((gap for gap in range(_GAP, 1, -1) if sum(widths) + gap * between <= WIDTH), 1)
    while sum(widths) + gap * between > WIDTH:
        widths[widths.index(max(widths))] -= 1

    def line(cells: Sequence[str]) -> str:
        cut = (x if len(x.rstrip()) <= n else f"{x[: n - 1]}…" for x, n in zip(cells, widths, strict=True))
        return (" " * gap).join(f"{x:{n}.{n}}" for x, n in zip(cut, widths, strict=True)).rstrip()

    heads = [c.head.split("\n") for c in columns]
    height = max(map(len, heads), default=0)
    above = zip(*([""] * (height - len(head)) + head for head in heads), strict=True)
    rows, previous = [], ""
    for name, *others in zip(*(c.cells for c in columns), strict=True):
        rows.append((name if name != previous else "", *others))
        previous = name
    return [*map(line, above), printable("─") * (sum(widths) + gap * between), *map(line, rows)]


def as_html(title: str, tables: Sequence[Sequence[Column]], lines: Iterable[str] = ()) -> str:
    """The same for a notebook."""
    parts = [f"<p>{html.escape(title)}</p>"] if title else []
    for columns in tables:
        shown = [c for c in columns if any(c.cells)]
        heads = "".join(f"<th>{html.escape(c.head)}</th>" for c in shown)
        cells = [
            [f"<td style='text-align:left'>{html.escape(text.strip())}</td>" for text in c.cells]
            for c in shown
        ]
        rows = "".join(f"<tr>{''.join(row)}</tr>" for row in zip(*cells, strict=True))
        parts.append(f"<table><tr>{heads}</tr>{rows}</table>")
    return "".join([*parts, *(f"<p>{html.escape(line)}</p>" for line in lines)])


class Tabled:
    """A result that prints as tables, with what their marks mean, warnings and notes below."""

    @property
    def warnings(self) -> tuple[str, ...]:
        """What a user should know about the numbers, in words."""
        return ()

    def _title(self) -> str:
        """Title of the printed tables, without the result's name, which stands before it."""
        raise NotImplementedError

    def _tables(self) -> Sequence[Sequence[Column]]:
        """The printed tables, each a sequence of columns."""
        raise NotImplementedError

    def _notes(self) -> Iterable[str]:
        """Further lines below the printed tables."""
        return ()

    def _heading(self) -> str:
        """Title of the printed tables with the result's name, if it has one."""
        return ": ".join(filter(None, (getattr(self, "name", ""), self._title())))

    def _printed(self) -> tuple[str, Sequence[Sequence[Column]], list[str]]:
        tables = self._tables()
        cells = [cell.strip() for columns in tables for c in columns for cell in c.cells]
        legend = [line for mark, line in _LEGEND.items() if any(re.match(mark, cell) for cell in cells)]
        return self._heading(), tables, [*legend, *(f"warning: {w}" for w in self.warnings), *self._notes()]

    def __str__(self) -> str:
        return as_text(*self._printed())

    def __repr__(self) -> str:
        return str(self)

    def _repr_html_(self) -> str:
        return as_html(*self._printed())


_T = TypeVar("_T", bound=Any)


class PerAxis(Tabled, Mapping[str, _T]):
    """A mapping from the names of axes to their results, in the recording's order.

    `for name in fit`, `fit["gyro_x"]`, `fit.values()` and `fit.items()` are those of a dictionary. A subclass
    is a dataclass with the field `results`, and says what its table shows.

    Attributes:
        results: one per axis.
    """

    #: Error that is raised for an unknown axis.
    ERROR: ClassVar[type[AllanjaxError]] = AllanjaxError

    results: tuple[_T, ...]

    @property
    def axes(self) -> tuple[str, ...]:
        """Names of the axes."""
        return tuple(result.axis.name for result in self.results)

    def __iter__(self) -> Iterator[str]:
        return iter(self.axes)

    def __len__(self) -> int:
        return len(self.results)

    def __contains__(self, axis: object) -> bool:
        return axis in self.axes

    def __getitem__(self, axis: str) -> _T:
        """The result of one axis, e.g. `fit["gyro_x"]`."""
        if axis not in self.axes:
            called = getattr(self, "name", "") or type(self).__name__
            raise self.ERROR(f"{called} has no axis {axis!r}; it has {', '.join(self.axes)}")
        return self.results[self.axes.index(axis)]

    def get(self, axis: str, default: Any = None) -> Any:
        """The result of one axis, or the default if there is no such axis."""
        # Not `Mapping.get`, which waits for a KeyError.
        return self[axis] if axis in self else default  # noqa: SIM401

    def to_dataframe(self) -> pd.DataFrame:
        """Table of all axes, one below the other."""
        import pandas as pd

        return pd.concat([result.to_dataframe() for result in self.results], ignore_index=True)

    def _tables(self) -> Sequence[Sequence[Column]]:
        of_sensor: dict[Any, list[Sequence[Cell]]] = {}
        for result in self.results:
            of_sensor.setdefault(result.axis.sensor, []).extend(result.rows())
        return [columns_from(self._heads(sensor), rows) for sensor, rows in of_sensor.items()]

    def _heads(self, sensor: Any) -> Sequence[str]:
        """Heads of the printed table of a sensor's axes, whose `rows()` have these columns."""
        raise NotImplementedError

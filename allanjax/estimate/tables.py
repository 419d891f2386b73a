"""Printed tables with one row per axis: numbers of one column share unit, digits and power of ten."""

from __future__ import annotations

import html
import math
import textwrap
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, NamedTuple, TypeAlias

from allanjax.base.tables import WIDTH, html_table, printable, text_table
from allanjax.base.wording import format_with_error, plain, significant
from allanjax.noise.estimate import Estimate
from allanjax.record.units import SENSORS, rate_unit_of

# Results print themselves by this module, which therefore does not import theirs.
Fit: TypeAlias = Any
AxisFit: TypeAlias = Any

#: Symbols of the basic terms, in the order of the columns; the first three have one even where not detected.
SYMBOLS = {
    "angle_random_walk": "N",
    "bias_instability": "B",
    "rate_random_walk": "K",
    "quantization": "Q",
    "drift_ramp": "R",
}
MAIN = tuple(SYMBOLS)[:3]
_SUPERSCRIPT = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
# What marks of numbers mean.
_LEGEND = {
    "< ": "< x: not detected; 95 % upper limit",
    "> ": "> x: 95 % lower limit",
    "(": "(x): value of the fitted curve, not a measurement of the sensor",
}
# Between the columns of a table.
_GAP = 3


class Number(NamedTuple):
    """A number in a column, with its error if it has one, and what is written before and after it."""

    value: float
    error: float = math.nan
    before: str = ""
    after: str = ""


class Column(NamedTuple):
    """Head and cells of a column."""

    head: str
    cells: list[str]

    @property
    def width(self) -> int:
        """Number of characters."""
        return max(len(line) for text in (self.head, *self.cells) for line in text.split("\n"))

    def broken(self) -> Column:
        """A copy with the unit in a second line of the head."""
        return self._replace(head=self.head.replace(" (", "\n("))


def column(name: str, unit: str, numbers: Sequence[Number | None], digits: int = 3) -> Column:
    """Column of numbers with the decimals that their errors call for; without errors, of so many digits."""
    there = [x for x in numbers if x is not None and math.isfinite(x.value)]
    largest = max((abs(x.value) for x in there), default=0.0)
    power = 0 if 1e-3 <= largest < 1e7 or largest == 0.0 else _exponent(largest)
    by = 10.0**power
    places = sorted(1 - _exponent(x.error / by) for x in there if 0.0 < x.error < math.inf)
    if places:
        # Two digits of the median error, and at least one of the smallest.
        decimals = max(places[len(places) // 2], places[-1] - 1)
    else:
        decimals = digits - 1 - _exponent(largest / by)
    written = []
    for x in numbers:
        if x is None or not math.isfinite(x.value):
            written.append(("", ""))
        elif 0.0 < x.error < math.inf:
            own = min(decimals, 2 - _exponent(x.error / by))
            written.append((x.before + _fixed(x.value / by, own), f"{_fixed(x.error / by, own)}{x.after}"))
        else:
            # A limit has two digits at least.
            own = max(decimals, 1 - _exponent(x.value / by) if x.before and x.value else 0)
            written.append((f"{x.before}{_fixed(x.value / by, own)}{x.after}", ""))
    left, right = (max((len(pair[k]) for pair in written), default=0) for k in (0, 1))
    cells = [
        f"{value:>{left}} ± {error:>{right}}" if error else f"{value:>{left}}" + " " * (right and right + 3)
        for value, error in written
    ]
    scale = f"10{str(power).translate(_SUPERSCRIPT)} " if power else ""
    unit = f"{scale}{'' if unit == '1' else unit}".strip()
    return Column(f"{name} ({unit})" if unit else name, cells)


def _exponent(x: float) -> int:
    return int(f"{abs(x):.1e}".partition("e")[2]) if x else 0


def _fixed(x: float, decimals: int) -> str:
    return f"{round(x, decimals) + 0.0:,.{max(decimals, 0)}f}"


def tables_of(
    first: Sequence[Column], main: Sequence[Column], others: Sequence[Column], last: Sequence[Column] = ()
) -> list[list[Column]]:
    """Columns of as many tables as they need at the width of a page, the others being the first to move."""
    tables = [[*first, *main, *last]]
    if _width([*tables[0], *others]) > WIDTH:
        # Units in a second line of the head make columns narrower.
        tables = [[c.broken() for c in tables[0]]]
        others = [c.broken() for c in others]
    for one in others:
        if _width([*tables[-1], one]) > WIDTH:
            tables.append(list(first))
        tables[-1].insert(len(tables[-1]) - (len(last) if len(tables) == 1 else 0), one)
    return tables


def _width(columns: Sequence[Column]) -> int:
    return sum(c.width + _GAP for c in columns) - _GAP


def as_text(title: str, tables: Sequence[Sequence[Column]], lines: Iterable[str]) -> str:
    """Tables one below the other, and lines below them."""
    parts = [title] if title else []
    for k, columns in enumerate(tables):
        rows = list(zip(*(c.cells for c in columns), strict=True))
        parts.append(("\n" if k else "") + text_table("", [c.head for c in columns], rows))
    wrapped = (printable(textwrap.fill(line, WIDTH, subsequent_indent="  ")) for line in lines)
    return "\n".join([*parts, *wrapped])


def as_html(title: str, tables: Sequence[Sequence[Column]], lines: Iterable[str]) -> str:
    """The same for a notebook."""
    parts = []
    for k, columns in enumerate(tables):
        rows = list(zip(*(c.cells for c in columns), strict=True))
        parts.append(html_table("" if k else title, [c.head for c in columns], rows))
    return "".join([*parts, *(f"<p>{html.escape(line)}</p>" for line in lines)])


# --- A fit --------------------------------------------------------------------------------------------------


def overview(fit: Fit) -> tuple[list[list[Column]], list[str]]:
    """Tables of a fit, one per sensor, with one row per axis; and the lines below them."""
    tables: list[list[Column]] = []
    rows = [(r.axis, r if r.converged else None) for r in fit.results]
    rows += [(dead.axis, None) for dead in fit.dead]
    for sensor in SENSORS:
        axes, results = [a for a, _ in rows if a.sensor == sensor], [r for a, r in rows if a.sensor == sensor]
        if not axes:
            continue
        unit, scale = rate_unit_of(axes[0].unit, sensor)
        columns = _coefficient_columns(results)
        means = [Number(math.nan if r is None else r.mean / scale) for r in results]
        tables += tables_of(
            [Column("axis", [axis.name for axis in axes])],
            [c for label, c in columns.items() if label in MAIN],
            [c for label, c in columns.items() if label not in MAIN],
            [column("mean", unit, means, 4), Column("verdict", list(map(_verdict, results)))],
        )
    shown = "".join(cell for columns in tables for c in columns for cell in c.cells)
    return tables, [line for mark, line in _LEGEND.items() if mark in shown] + list(_remarks(fit))


def _coefficient_columns(results: Sequence[AxisFit | None]) -> dict[str, Column]:
    """Columns of the main coefficients, and of others that some axis has, by their labels."""
    found: dict[str, dict[int, Estimate]] = {}
    for k, result in ((k, result) for k, result in enumerate(results) if result is not None):
        for label, c in result.coefficients.items():
            if c.term not in result.further:
                found.setdefault(label, {})[k] = c.in_unit()
    columns = {}
    for label in sorted(found, key=lambda name: [*SYMBOLS, name].index(name)):
        of = found[label]
        one = next(iter(of.values()))
        if label in MAIN or any(c.held or c.detected or not c.measured for c in of.values()):
            numbers = [_number(of[k]) if k in of else None for k in range(len(results))]
            columns[label] = column(SYMBOLS.get(label, one.title), one.unit, numbers)
    return columns


def _number(c: Estimate) -> Number | None:
    """An estimate as a number in a column; None where it is not determined."""
    if c.held:
        return Number(c.value, after=" held")
    if not c.measured:
        return Number(c.value, before="(", after=")") if c.value > 0.0 else None
    if not c.detected:
        return None if c.upper_limit is None else Number(c.upper_limit, before="< ")
    if not c.is_amplitude and c.lower_limit is not None:
        return Number(c.lower_limit, before="> ")
    if not c.is_amplitude and c.upper_limit is not None:
        return Number(c.upper_limit, before="< ")
    return Number(c.value, c.std) if math.isfinite(c.std) else None


def _verdict(result: AxisFit | None) -> str:
    """The verdict in one or two words, with p where the model fits."""
    if result is None:
        return "no result"
    if not result.measured:
        return "not a measurement"
    if result.incomplete:
        return "does not fit"
    p = result.p_value
    if not math.isfinite(p):
        return "fits"
    return f"{'doubtful' if result.doubtful else 'fits'}, p = {significant(p, 2)}"


def _remarks(fit: Fit) -> Iterator[str]:
    """Lines below the tables of a fit: corrections, misfits, axes without a result, warnings and notes."""
    warnings = fit.warnings
    for result in fit.results:
        if result.converged and result.correction:
            yield f"{result.axis.name} {result.correction}"
    for result in fit.results:
        if result.converged and result.misfits:
            yield f"{result.axis.name} does not fit: {result.misfits}"
    for name, reason in fit.without_result.items():
        if not any(reason in warning for warning in warnings):
            yield f"{name}: no result, {reason}"
    yield from (f"warning: {warning}" for warning in warnings)
    yield from (f"note: {note}" for note in fit.notes)


def details(title: str, results: Sequence[AxisFit]) -> str:
    """Table of all coefficients of these axes with intervals and limits, and a line below per axis."""
    headings = ("axis", "coefficient", "estimate ± 1σ", "95 % interval")
    rows = [
        row for r in results if r.converged for row in map(_detail, [r] * len(r.coefficients), r.coefficients)
    ]
    lines = [f"{r.axis.name}: {'; '.join(filter(None, (r.verdict, r.correction, r.level)))}" for r in results]
    table = [Column(head, list(cells)) for head, cells in zip(headings, zip(*rows, strict=True), strict=True)]
    return as_text(title, [table] if rows else [], lines)


def _detail(result: AxisFit, label: str) -> tuple[str, str, str, str]:
    """Row of a coefficient in the table of details; without an interval, the reason in its place."""
    c = result.coefficients[label].in_unit()
    number, reason = _number(c), ""
    if c.held:
        text, reason = plain(c.value), "held"
    elif number is None:
        text, reason = "", "not determined"
    elif number.error > 0.0:
        text, reason = format_with_error(*number[:2]), c.describe_interval()
    else:
        text = f"{number.before}{significant(number.value)}{number.after}"
        if not c.detected and c.measured:
            reason = "not detected"
            if c.rivals:
                reason = f"may be {' or '.join(SYMBOLS.get(term, term) for term in c.rivals)}"
    unit = "" if c.unit == "1" or not text else f" {c.unit}"
    return c.axis.name, c.title, text + unit, "; ".join(filter(None, (reason, c.remark)))

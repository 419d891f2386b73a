"""Printed tables with one row per axis: numbers of one column share unit, digits and power of ten."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any, TypeAlias

from allanjax.base.tables import Column, Number, as_text, column, columns_from, tables_of
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


def overview(fit: Fit) -> list[list[Column]]:
    """Tables of a fit, one per sensor, with one row per axis."""
    tables: list[list[Column]] = []
    rows = [(r.axis, r if r.converged else None) for r in fit.results]
    rows = (
        sorted(rows + [(dead.axis, None) for dead in fit.dead], key=lambda row: row[0].name)
        if fit.dead
        else rows
    )
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
    return tables


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
        if label in MAIN or any(c.held or (c.detected and c.measured) for c in of.values()):
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


def remarks(fit: Fit) -> Iterator[str]:
    """Lines below the tables of a fit: corrections, misfits, axes without a result, and notes."""
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
    undecided = {} if fit.selection is None else fit.selection.undecided()
    longer = fit.selection.ambiguities() if undecided else ()
    yield from (f"note: {note}" for note in fit.notes if note not in longer)
    if undecided:
        questions = (
            f"{question} ({_few([name for name, *_ in of])})" for (question, _), of in undecided.items()
        )
        yield f"undecided (probabilities: --verbose, details()): {'; '.join(questions)}"


def _few(names: Sequence[str]) -> str:
    return ", ".join(names) if len(names) < 3 else f"{len(names)} axes"


def details(title: str, results: Sequence[AxisFit], notes: Sequence[str] = ()) -> str:
    """Table of all coefficients with intervals and limits, a line below per axis, and these notes."""
    lines = [f"{r.axis.name}: {'; '.join(filter(None, (r.verdict, r.correction, r.level)))}" for r in results]
    return as_text(title, all_coefficients([r for r in results if r.converged]), [*lines, *notes])


def all_coefficients(results: Sequence[Any], estimate: str = "estimate") -> list[list[Column]]:
    """Table of all coefficients of these axes, one row each, if there are any."""
    rows = [_detail(c) for r in results for c in r.coefficients.values()]
    return [columns_from(("axis", "coefficient", f"{estimate} ± 1σ", "95 % interval"), rows)] if rows else []


def _detail(estimate: Estimate) -> tuple[str, str, str, str]:
    """Row of a coefficient in the table of details; without an interval, the reason in its place."""
    c = estimate.in_unit()
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

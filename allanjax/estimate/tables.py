"""Printed tables with one row per axis: numbers of one column share unit, digits and power of ten."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any, TypeAlias

from allanjax.base.tables import Column, as_text, column, columns_from, tables_of
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
    rows = [(r.axis, r if r.converged else None) for r in fit.results]
    if fit.dead:
        rows = sorted(rows + [(dead.axis, None) for dead in fit.dead], key=lambda row: row[0].name)
    tables: list[list[Column]] = []
    for sensor in SENSORS:
        if own := [row for row in rows if row[0].sensor == sensor]:
            axes, results = zip(*own, strict=True)
            unit, scale = rate_unit_of(axes[0].unit, sensor)
            means = [math.nan if r is None else float(r.mean / scale) for r in results]
            tables += tables_of(
                [Column("axis", [axis.name for axis in axes])],
                *_coefficient_columns(results),
                [column("mean", unit, means, 4), Column("verdict", list(map(_verdict, results)))],
            )
    return tables


def _coefficient_columns(results: Sequence[AxisFit | None]) -> tuple[list[Column], list[Column]]:
    """Columns of the main coefficients, and of others that some axis has."""
    found: list[dict[str, Estimate]] = []
    for r in results:
        plain_terms = () if r is None else (c for c in r.coefficients.values() if c.term not in r.further)
        found.append({c.label: c.in_unit() for c in plain_terms})
    main, others = list[Column](), list[Column]()
    labels = dict.fromkeys(label for of in found for label in of)
    for label in sorted(labels, key=lambda name: [*SYMBOLS, name].index(name)):
        known = [of[label] for of in found if label in of]
        if label in MAIN or any(c.held or (c.detected and c.measured) for c in known):
            numbers = [of[label].number if label in of else None for of in found]
            name = SYMBOLS.get(label, known[0].title)
            (main if label in MAIN else others).append(column(name, known[0].unit, numbers))
    return main, others


def _verdict(result: AxisFit | None) -> str:
    """The verdict in one or two words, with p where the model fits."""
    if result is None:
        return "no result"
    if not result.measured or result.incomplete:
        return "does not fit" if result.measured else "not a measurement"
    word = "doubtful" if result.doubtful else "fits"
    return f"{word}, p = {significant(result.p_value, 2)}" if math.isfinite(result.p_value) else word


def remarks(fit: Fit) -> Iterator[str]:
    """Lines below the tables of a fit: corrections, misfits, axes without a result, and notes."""
    known = [result for result in fit.results if result.converged]
    yield from (f"{r.axis.name} {r.correction}" for r in known if r.correction)
    yield from (f"{r.axis.name} does not fit: {r.misfits}" for r in known if r.misfits)
    for name, reason in fit.without_result.items():
        if not any(reason in warning for warning in fit.warnings):
            yield f"{name}: no result, {reason}"
    undecided = {} if fit.selection is None else fit.selection.undecided()
    longer = fit.selection.ambiguities() if undecided else ()
    yield from (f"note: {note}" for note in fit.notes if note not in longer)
    questions = []
    for (question, _), of in undecided.items():
        names = [name for name, *_ in of]
        questions.append(f"{question} ({', '.join(names) if len(names) < 3 else f'{len(names)} axes'})")
    if questions:
        yield f"undecided (probabilities: --verbose, details()): {'; '.join(questions)}"


def details(title: str, results: Sequence[AxisFit], notes: Sequence[str] = ()) -> str:
    """Table of all coefficients with intervals and limits, a line below per axis, and these notes."""
    lines = [f"{r.axis.name}: {'; '.join(filter(None, (r.verdict, r.correction, r.level)))}" for r in results]
    return as_text(title, all_coefficients([r for r in results if r.converged]), [*lines, *notes])


def all_coefficients(results: Sequence[Any], estimate: str = "estimate") -> list[list[Column]]:
    """Table of all coefficients of these axes, one row each, if there are any."""
    rows = [detail(c) for r in results for c in r.coefficients.values()]
    return [columns_from(("axis", "coefficient", f"{estimate} ± 1σ", "95 % interval"), rows)] if rows else []


def detail(estimate: Estimate, in_unit: str | None = None) -> tuple[str, str, str, str]:
    """Axis, title, value and interval of a coefficient; without an interval, the reason in its place."""
    c = estimate.in_unit(in_unit)
    number, reason = c.number, ""
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

"""Sections of a page about a recording, a comparison of sensors, or a fleet."""

from __future__ import annotations

import datetime
import platform
from collections.abc import Iterator, Mapping, Sequence
from importlib.metadata import version
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from allanjax.allan.deviation import dynamic_allan
from allanjax.base.errors import AllanjaxError
from allanjax.comparison.compare import Comparison, axes_of
from allanjax.comparison.specification import SpecCheck
from allanjax.critic.result import Critique
from allanjax.estimate.check import Check
from allanjax.estimate.result import MAIN, Fit, detail
from allanjax.fleet.fleet import FleetResult
from allanjax.fleet.limits import table_of_limits, verdict_of
from allanjax.fleet.table import ROWS, outlying_names, times
from allanjax.fleet.table import tables as fleet_tables
from allanjax.inspection.facts import listed
from allanjax.noise.estimate import SYMBOLS, Estimate, title_of
from allanjax.noise.terms import Sinusoid
from allanjax.presentation.draw import SENSORS
from allanjax.presentation.export.exporting import exported
from allanjax.presentation.export.targets import TARGETS
from allanjax.presentation.files import coefficients_csv, curve_csv
from allanjax.presentation.page import charts
from allanjax.presentation.page.blocks import (
    Block,
    Cell,
    Chart,
    Exports,
    Fold,
    Mark,
    Method,
    Row,
    Section,
    Table,
    Text,
    Trace,
    Units,
    View,
    texts,
)
from allanjax.record.recording import Axis, Recording
from allanjax.record.units import unit_scale
from allanjax.spectrum.psd import PowerSpectrum

if TYPE_CHECKING:
    import pandas as pd

# Fewest samples of a record that is shown through time.
_LONG = 10_000
# Cluster times at which models without a record are drawn [s].
_TIMES = np.geomspace(0.01, 1e4, 150)
# Classes of the style sheet for verdicts.
_STYLES = {"pass": "verdict good", "fail": "verdict bad", "undecided": "verdict care"}


class Reported(NamedTuple):
    """The results about one recording that a page shows; it leaves out what is None.

    Attributes:
        fit: its fit.
        critique: its critique.
        recording: its samples.
        spectrum: its spectrum.
        check: its check.
        limits: its check against a specification.
        conditions: serial number, temperature and others, in words by headings.
        origin: where it is from, in the same way.
    """

    fit: Fit
    critique: Critique | None = None
    recording: Recording | None = None
    spectrum: PowerSpectrum | None = None
    check: Check | None = None
    limits: SpecCheck | None = None
    conditions: Mapping[str, str] = {}
    origin: Mapping[str, str] = {}


def of_record(one: Reported) -> Iterator[Section]:
    """Sections about one recording; what is not given is left out."""
    fit, critique = one.fit, one.critique
    findings = () if critique is None else critique.findings
    shown = Row([*coefficients(fit), *charts.curves(fit)])
    yield Section("Result", [*verdict(one), shown, *warnings(fit, critique)])
    if one.limits is not None:
        tables = map(Table.of, one.limits._tables())
        yield Section("Limits", [*tables, *texts(one.limits._notes(), "note")])
    if one.spectrum is not None:
        yield Section("Spectrum", [Row(charts.densities(fit, one.spectrum, findings))])
    if one.recording is not None:
        # With a critique the recording is what was criticized.
        fitted = fit if critique is None else None
        yield Section("Record", [Row(charts.over_time(one.recording, fitted, findings))])
        if one.recording.n >= _LONG:
            dynamic = dynamic_allan(one.recording)
            yield Section("Through time", [Row(charts.through_time(dynamic, findings))], printed=False)
    residuals = charts.residuals(fit, one.spectrum)
    if residuals:
        yield Section("Residuals", [Row(residuals)], printed=False)
    if critique is not None:
        # Here, as the critic imports slow libraries.
        from allanjax.presentation.page.story import findings_in_full

        yield Section("What a simulation gets wrong", [*findings_in_full(critique)])
    if any(r.measured and not r.lacking for r in fit.results):
        yield Section("Predicted drift", [Row(charts.drifts(fit))], printed=False)
    yield Section("Exports", [*exports(fit)], printed=False)
    yield Section("Details", [*details(fit, one.check)], printed=False)
    yield Section("Method", [Method(fit.objective, "" if fit.chosen else str(fit.template))])
    yield Section("How this page was made", [made(one.origin)])


# --- Verdict and coefficients -------------------------------------------------------------------------------


def verdict(one: Reported) -> Iterator[Text]:
    """Whether limits are met, what was found, whether the model fits, and the conditions of the record."""
    fit, (disturbed, also) = one.fit, _found(one)
    good, off = ([r.axis.name for r in fit.results if r.measured and r.fits == fits] for fits in (1, 0))
    failed = [*fit.not_measured, *fit.without_result]
    if one.limits is not None:
        yield _against(one.limits)
    if failed:
        where = listed(failed, 6) if good or off else "any axis"
        yield Text(f"Not a measurement of the sensor on {where}.", "verdict bad")
    if disturbed:
        count = "One disturbance" if len(disturbed) == 1 else f"{len(disturbed)} disturbances"
        yield Text(f"{count}: {_first(disturbed)}.", "verdict care")
    if off:
        where = listed(off, 6) if good or failed else "any axis"
        yield Text(f"The noise model does not fit {where}; the intervals are wider for it.", "verdict care")
    if good:
        where = "all axes" if len(good) > 1 and not (off or failed) else listed(good, 6)
        alone = not (off or failed or disturbed or one.limits)
        yield Text(f"The noise model fits {where}.", "verdict good" if alone else "")
    if also:
        yield Text(f"Also found: {_first(also)}.")
    yield Text(" · ".join([fit._title(), *map(": ".join, one.conditions.items())]), "note")


def _first(told: Sequence[str]) -> str:
    """The first three texts, and how many there are more."""
    more = [f"and {len(told) - 3} more"] if len(told) > 3 else []
    return "; ".join([*told[:3], *more])


def _found(one: Reported) -> tuple[list[str], list[str]]:
    """Disturbances and properties of the sensor in words: by the critic, or lines of the models."""
    if one.critique is not None:
        from allanjax.presentation.page.story import in_words

        return in_words(one.critique, one.fit)
    known = [r for r in one.fit.results if r.converged]
    lines = [(r, term) for r in known for term in r.model.terms if isinstance(term, Sinusoid)]
    return [charts.line(term.frequency, r.axis.name, term.amplitude, r) for r, term in lines], []


def _against(judged: SpecCheck) -> Text:
    """Whether limits are met, and which are not."""
    word, axes = judged.verdict, dict[str, list[str]]()
    for r in judged.results:
        if r.verdict == word:
            axes.setdefault(r.limit.title, []).append(r.axis)
    which = listed([f"{title} of {listed(names)}" for title, names in axes.items()])
    text = "all limits are met" if word == "pass" else f"{word}, {which}"
    return Text(f"{judged.sheet}: {text}.", _STYLES[word])


def warnings(fit: Fit, critique: Critique | None) -> Iterator[Text]:
    """Warnings about the recording, and why an axis has no result."""
    known = dict.fromkeys((*fit.warnings, *(critique.warnings if critique is not None else ())))
    reasons = {**fit.not_measured, **fit.without_result}
    left = [f"{axis}: {why}" for axis, why in reasons.items() if not any(why in text for text in known)]
    yield from texts((*known, *left), "warning")


def coefficients(fit: Fit) -> list[Table]:
    """A table of each sensor's coefficients with 95 % intervals or limits, in usual units and in SI."""
    tables = list[Table]()
    for sensor, own in charts.by_sensor([r.axis for r in fit.results if r.converged]).items():
        results = [fit[axis.name] for axis in own]
        found = [{c.label: c for c in r.coefficients.values() if c.term not in r.further} for r in results]
        rows = []
        for label in dict.fromkeys((*SYMBOLS, *(label for of in found for label in of))):
            cells = [of.get(label) for of in found]
            known = [c for c in cells if c is not None]
            is_shown = label in MAIN or any(c.held or (c.detected and c.measured) for c in known)
            if known and is_shown:
                rows.append([_head(known[-1]), *map(_cell, cells)])
        rows.append([Cell("fit"), *(Cell(r.word) for r in results)])
        heads = (SENSORS[sensor].capitalize(), *(axis.name for axis in own))
        tables.append(Table([*map(Cell, heads)], rows, "± 1σ, with 95 % intervals below"))
    return tables


def _head(c: Estimate) -> Cell:
    """Symbol, name and units of a coefficient."""
    return Cell(c.symbol, remark=f"{c.title} [{c.usual_unit}]", si_remark=f"{c.title} [{c.si_unit}]")


def _cell(c: Estimate | None) -> Cell:
    """A coefficient and its interval, in usual units and in SI, without the units."""
    if c is None:
        return Cell("–")
    (*_, text, below), (*_, si, si_below) = detail(c), detail(c, c.si_unit)
    bare, bare_si = text.removesuffix(f" {c.usual_unit}"), si.removesuffix(f" {c.si_unit}")
    return Cell(bare or "–", bare_si or "–", below, si_below)


def details(fit: Fit, check: Check | None) -> Iterator[Block]:
    """Verdict of each axis, filters and lines that were fitted, how long to record, and notes."""
    for r in (r for r in fit.results if r.converged):
        yield Text(f"{r.axis.name}: {r.story}")
        if r.further:
            own = (c for c in r.coefficients.values() if c.term in r.further)
            yield Table([Cell("further term"), Cell("value")], [[_head(c), _cell(c)] for c in own])
    if check is not None:
        yield Text(f"Check: {check.summary()}.")
        lengths = [(n.coefficient.axis.name, n.coefficient.symbol, n.describe()) for n in check.lengths]
        table = Table.of_texts(("axis", "coefficient", "length"), lengths)
        yield Fold("How long to record", [table])
    yield from texts((f"Note: {note}" for note in fit.notes), "note")


# --- Exports and origin -------------------------------------------------------------------------------------


def exports(fit: Fit) -> Iterator[Block]:
    """What `export` writes for each target that takes this fit, and the tables as CSV."""
    found = []
    for name, target in TARGETS.items():
        try:
            found.append((f"{target.title} ({name})", exported(fit, name).text))
        except AllanjaxError:
            # The target needs what this recording does not have.
            continue
    found += [("Coefficients as CSV", coefficients_csv(fit)), ("Allan deviations as CSV", curve_csv(fit))]
    yield Text("Noise parameters for estimators, autopilots and simulators, with formulas in the comments.")
    yield Exports(found)


def made(origin: Mapping[str, str]) -> Table:
    """What is needed to make the page again."""
    known = {
        **origin,
        "made": datetime.datetime.now().astimezone().isoformat(timespec="seconds"),
        "allanjax": version("allanjax"),
        "with": ", ".join(f"{name} {version(name)}" for name in ("jax", "numpy", "scipy", "optimistix")),
        "Python": f"{platform.python_version()}, {platform.system()} {platform.machine()}",
    }
    return Table.of_texts(("what", "value"), known.items())


# --- Comparisons and fleets ---------------------------------------------------------------------------------


def of_comparison(comparison: Comparison) -> Iterator[Section]:
    """Curves over one another, the table of coefficients, drift and growth of errors."""
    every = [d.differs for row in comparison.rows for d in row.differences if d is not None]
    tested = [differs for differs in every if differs is not None]
    reference = comparison.labels[comparison.reference]
    verdict = f"{sum(tested)} of {len(tested)} coefficients differ from those of {reference}."
    if not tested:
        verdict = "Whether coefficients differ cannot be tested without their errors."
    tables = [*map(Table.of, comparison._tables())]
    axes = axes_of(comparison.sensors)
    over = charts.each(axes, "{}", lambda own: [_view(comparison, axis) for axis in own])
    yield Section("Comparison", [Text(verdict, "verdict"), Row(over), Row(tables[:2])])
    yield Section("Drift and growth of errors", [Row(tables[2:])])
    yield Section("Sensors", texts(comparison._notes(), "note"))


def _view(comparison: Comparison, axis: Axis) -> View:
    """Measured deviations with intervals, and models, of all sensors on an axis."""
    traces, name = list[Trace](), axis.name
    for group, one in enumerate(comparison.sensors):
        time = _TIMES
        if one.curve is not None and name in one.curve.names:
            k, time = one.curve.names.index(name), one.curve.cluster_time
            ends = one.curve.confidence_interval(0.95)
            traces.append(charts.measured(group, k, time, one.curve.deviation, ends))
        if one.model(name) is not None:
            kind = "at least" if one.curve is None and one.lacking(name) else "model"
            traces.append(Trace(group, kind, time, one.deviation(name, time), look="line"))
    return View(groups=comparison.labels, traces=traces, **charts.allan(axis, name))


def of_fleet(fleet: FleetResult, pages: Mapping[str, str]) -> Iterator[Section]:
    """Sections about a fleet; `pages` are the addresses of the units' own pages by their names."""
    table = fleet.table
    outlying = outlying_names(table)
    style = "care" if outlying or fleet.errors else "good"
    kind = "unit" if not table["odd_record"].any() else "unit or record"
    verdict = f"{len(outlying) or 'No'} outlying {kind}{'' if len(outlying) == 1 else 's'}"
    blocks: list[Block] = [Text(f"{verdict}; {fleet.summary}.", f"verdict {style}")]
    tables = (columns for columns in fleet_tables(table) if sum(any(c.cells) for c in columns) > 1)
    blocks.append(Row([*map(Table.of, tables)]))
    if fleet.checks:
        blocks += [Text(f"{verdict_of(fleet.checks)}."), Row([Table.of(table_of_limits(fleet.checks))])]
    blocks += texts((line for line in fleet.lines(ROWS) if line not in fleet.notes), "note")
    blocks += texts(fleet.notes, "warning")
    if fleet.errors:
        errors = (f"{error['file']}: {error['message']}" for error in fleet.errors)
        blocks.append(Fold(f"{len(fleet.errors)} errors", texts(errors, "warning")))
    yield Section("Result", blocks)
    distributions = [*_distributions(table)]
    if distributions:
        yield Section("Distributions", [Row(distributions)])
    yield Section("Units", [_units(table, pages)])


def _distributions(table: pd.DataFrame) -> Iterator[Chart]:
    """Values of each coefficient in ascending order, with their intervals; outlying units are named."""
    found = table[table["detected"] & table["measured"]]
    parts: Any = found.groupby(["sensor", "coefficient"], sort=False)
    for (sensor, coefficient), of in parts:
        traces, marks = list[Trace](), list[Mark]()
        unit, axes = of["unit"].iloc[0], list(of["axis"].unique())
        si, name = unit_scale(unit, sensor), title_of(coefficient, sensor)
        for group, axis in enumerate(axes):
            own = of[of["axis"] == axis].sort_values("value")
            share, names = 100.0 * (np.arange(len(own)) + 0.5) / len(own), own["recording"].tolist()
            value = si * own["value"].to_numpy()
            low, high = (si * own[key].to_numpy() for key in ("lower_95", "upper_95"))
            traces.append(Trace(group, "units", share, value, low, high, labels=range(len(own)), names=names))
            for k in np.flatnonzero(own["outlying"] | own["odd_record"]).tolist():
                text = f"{names[k]} {times(own['ratio'].iloc[k])}"
                marks.append(Mark(text, float(share[k]), float(value[k]), group))
        labels = coefficient, "units up to this value", "%", SYMBOLS.get(coefficient, "value")
        view = View(*labels, units=[(unit, si)], groups=axes, traces=traces, marks=marks, log="y")
        yield Chart(f"{name}, {SENSORS[sensor]}".capitalize(), [view])


def _units(table: pd.DataFrame, pages: Mapping[str, str]) -> Units:
    """One row per unit: its coefficients, which are limits where it has a "<", and its remarks."""
    shown = table[table["measured"]]
    known: Any = shown[shown["coefficient"].isin(shown.loc[shown["detected"], "coefficient"])]
    columns = list(known[["coefficient", "axis", "unit"]].drop_duplicates().itertuples(index=False))
    cells, parts = dict[Any, Any](), dict[str, dict[str, None]]()
    for c in known.itertuples():
        limit = None if np.isnan(c.upper_limit_95 or np.nan) else f"< {c.upper_limit_95:.3g}"
        cells[c.recording, c.coefficient, c.axis] = float(f"{c.value:.4g}") if c.detected else limit
    for unit, *said in zip(*(table[key] for key in ("recording", "remarks", "warnings")), strict=True):
        parts.setdefault(unit, {}).update(dict.fromkeys(filter(None, said)))
    rows = []
    for unit, remarks in parts.items():
        first = [unit, pages[unit]] if unit in pages else unit
        rows.append([first, *(cells.get((unit, *column[:2])) for column in columns), "; ".join(remarks)])
    heads = [f"{axis} {SYMBOLS.get(of, of.replace('_', ' '))} [{unit}]" for of, axis, unit in columns]
    outlying = set(table.loc[table["outlying"] | table["odd_record"], "recording"])
    marked = [k for k, unit in enumerate(parts) if unit in outlying]
    return Units(["unit", *heads, "remarks"], rows, marked)

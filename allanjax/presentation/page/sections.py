"""Sections of a page about one recording: verdict, coefficients, curves, the critic's story, origin."""

from __future__ import annotations

import datetime
import platform
from collections.abc import Iterator, Mapping, Sequence
from importlib.metadata import version

from allanjax.allan.deviation import dynamic_allan
from allanjax.base.errors import AllanjaxError
from allanjax.base.wording import record_size
from allanjax.critic.result import Critique
from allanjax.estimate.check import Check
from allanjax.estimate.result import MAIN, AxisFit, Fit, detail
from allanjax.inspection.facts import listed
from allanjax.noise.estimate import SYMBOLS, Estimate
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
    Row,
    Section,
    Table,
    Text,
)
from allanjax.record.recording import Recording
from allanjax.record.units import Sensor
from allanjax.spectrum.psd import PowerSpectrum

# Fewest samples of a record that is shown through time.
_LONG = 10_000


def of_record(
    fit: Fit,
    critique: Critique | None,
    recording: Recording | None,
    spectrum: PowerSpectrum | None,
    check: Check | None,
    origin: Mapping[str, str],
) -> Iterator[Section]:
    """Sections about one recording; what is not given is left out."""
    findings = () if critique is None else critique.findings
    tables, curves = coefficients(fit), charts.curves(fit, spectrum, findings)
    pairs = [Row([*([tables[s]] if s in tables else []), chart]) for s, chart in curves.items()]
    yield Section("Result", [*verdict(fit, critique), *pairs, *warnings(fit, critique)])
    if spectrum is not None:
        own = charts.by_sensor([r.axis for r in fit.results])
        views = [(SENSORS[sensor], charts.density(fit, spectrum, axes, findings)) for sensor, axes in own]
        densities = [Chart(f"{name.capitalize()}: power spectral density", [view]) for name, view in views]
        yield Section("Spectrum", [Row(densities)])
    if recording is not None:
        yield Section("Record", [Row(charts.over_time(recording, fit, critique))])
        if recording.n >= _LONG:
            dynamic = dynamic_allan(recording)
            yield Section("Through time", [Row(charts.through_time(dynamic, critique))])
    if residuals := charts.residuals(fit, spectrum):
        yield Section("Residuals", [Row(residuals)])
    if critique is not None:
        # Here, as the critic imports slow libraries.
        from allanjax.presentation.page.story import findings_in_full

        yield Section("What a simulation gets wrong", list(findings_in_full(critique)))
    if any(r.measured for r in fit.results):
        yield Section("Predicted drift", [Row(charts.drifts(fit))])
    yield Section("Exports", list(exports(fit)))
    yield Section("Details", list(details(fit, check)))
    yield Section("How this page was made", [made(fit, origin)])


# --- Verdict and coefficients -------------------------------------------------------------------------------


def verdict(fit: Fit, critique: Critique | None) -> Iterator[Text]:
    """Whether the coefficients are a measurement, and whether the model fits."""
    failed = [*fit.not_measured, *fit.without_result]
    off = [r.axis.name for r in fit.results if r.measured and r.incomplete]
    good = [r.axis.name for r in fit.results if r.measured and not r.incomplete]
    style, text = "good", f"Good: the noise model fits {'all axes' if len(good) > 1 else 'the axis'}."
    if failed:
        style = "bad"
        text = f"Not a measurement of the sensor on {listed(failed, 6) if good or off else 'any axis'}."
    if off:
        if not failed:
            style, text = "care", "Usable with care."
        which = listed(off, 6) if good or failed else "any axis"
        text += f" The model does not fit {which}; the intervals are wider for it."
    if good and style != "good":
        text += f" It fits {listed(good, 6)}."
    yield Text(text, f"verdict {style}")
    size = f"{record_size(fit.curve.n, fit.curve.rate)}{fit.curve.describe_others()}."
    yield Text(size, "note")
    if critique is not None:
        from allanjax.presentation.page.story import headline

        yield headline(critique)


def warnings(fit: Fit, critique: Critique | None) -> Iterator[Text]:
    """Warnings about the recording, and why an axis has no result."""
    known = dict.fromkeys((*fit.warnings, *(() if critique is None else critique.warnings)))
    reasons = {**fit.not_measured, **fit.without_result}
    left = [f"{axis}: {why}" for axis, why in reasons.items() if not any(why in text for text in known)]
    yield from (Text(text, "warning") for text in (*known, *left))


def coefficients(fit: Fit) -> dict[Sensor, Table]:
    """A table of each sensor's coefficients with 95 % intervals or limits, in usual units and in SI."""
    tables = dict[Sensor, Table]()
    for sensor, own in charts.by_sensor([r.axis for r in fit.results]):
        results = [r for k, *_ in own if (r := fit.results[k]).converged]
        found = [{c.label: c for c in r.coefficients.values() if c.term not in r.further} for r in results]
        every = {label: c for of in found for label, c in of.items()}
        known = [label for label in dict.fromkeys((*SYMBOLS, *every)) if label in every]
        labels = [label for label in known if label in MAIN or _shown(label, found)]
        heads = [Cell(every[label].symbol, remark=every[label].title) for label in labels]
        rows = [
            [Cell(r.axis.name), *(_cell(of.get(label)) for label in labels), Cell(_fits(r))]
            for r, of in zip(results, found, strict=True)
        ]
        if rows:
            caption = f"Noise coefficients of the {SENSORS[sensor]} ± 1σ, with 95 % intervals below"
            tables[sensor] = Table([Cell(SENSORS[sensor]), *heads, Cell("fit")], rows, caption)
    return tables


def _shown(label: str, found: Sequence[Mapping[str, Estimate]]) -> bool:
    """Whether a coefficient is detected on any axis."""
    return any(of[label].held or (of[label].detected and of[label].measured) for of in found if label in of)


def _cell(c: Estimate | None) -> Cell:
    """A coefficient and its interval, in usual units and in SI."""
    if c is None:
        return Cell("–")
    (*_, text, below), (*_, si, si_below) = detail(c), detail(c, c.si_unit)
    return Cell(text or "–", si or "–", below, si_below)


def _fits(result: AxisFit) -> str:
    if not result.measured:
        return "not a measurement"
    return "does not fit" if result.incomplete else "doubtful" if result.doubtful else "fits"


def details(fit: Fit, check: Check | None) -> Iterator[Block]:
    """Verdict of each axis, filters and lines that were fitted, how long to record, and notes."""
    for r in fit.results:
        if not r.converged:
            continue
        text = "; ".join(filter(None, (r.verdict, r.correction, r.level)))
        further = [[Cell(c.title), _cell(c)] for c in r.coefficients.values() if c.term in r.further]
        table = [Table([Cell("further term"), Cell("value")], further)] if further else []
        yield Fold(r.axis.name, [Text(text), *table])
    if check is not None:
        yield Text(f"Check: {check.summary()}.")
        lengths = [(n.coefficient.axis.name, n.coefficient.symbol, n.describe()) for n in check.lengths]
        rows = [[Cell(text) for text in row] for row in lengths]
        yield Fold("How long to record", [Table([Cell("axis"), Cell("coefficient"), Cell("length")], rows)])
    yield from (Text(f"Note: {note}", "note") for note in fit.notes)


# --- Exports and origin -------------------------------------------------------------------------------------


def exports(fit: Fit) -> Iterator[Block]:
    """What `export` writes for each target that takes this fit, and the tables as CSV."""
    texts = []
    for name, target in TARGETS.items():
        try:
            texts.append((f"{target.title} ({name})", exported(fit, name).text))
        except AllanjaxError:
            # The target needs what this recording does not have.
            continue
    texts += [("Coefficients as CSV", coefficients_csv(fit)), ("Allan deviations as CSV", curve_csv(fit))]
    yield Text("Noise parameters for estimators, autopilots and simulators, with formulas in the comments.")
    yield Exports(texts)


def made(fit: Fit, origin: Mapping[str, str]) -> Table:
    """What is needed to make the page again."""
    known = {
        **origin,
        "model": str(fit.template) if not fit.chosen else "chosen by evidence",
        "objective": fit.objective,
        "made": datetime.datetime.now().astimezone().isoformat(timespec="seconds"),
        "allanjax": version("allanjax"),
        "with": ", ".join(f"{name} {version(name)}" for name in ("jax", "numpy", "scipy", "optimistix")),
        "Python": f"{platform.python_version()}, {platform.system()} {platform.machine()}",
    }
    return Table([Cell("what"), Cell("value")], [[Cell(name), Cell(text)] for name, text in known.items()])

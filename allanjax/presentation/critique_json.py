"""Critiques as plain data that follow `schema("critique")`."""

from __future__ import annotations

from importlib.metadata import version
from typing import Any

from allanjax.critic.finding import Change, Detail, Discrepancy, Finding, written
from allanjax.critic.result import AxisCritique, Critique
from allanjax.estimate.as_json import in_json
from allanjax.noise.estimate import Estimate, usual_unit
from allanjax.noise.model import Model
from allanjax.record.recording import Axis
from allanjax.record.units import unit_scale

SCHEMA_VERSION = 2


def to_dict(critique: Critique) -> dict[str, Any]:
    """The critique as dictionaries, lists, numbers and strings; None for nan and infinite numbers."""
    n = critique.results[0].stages[0].n if critique.results else 0
    rate = float(critique.rate)
    results = {
        "gain_nats": critique.gain,
        "findings": [_recording_finding(finding, critique) for finding in critique.findings],
        "axes": [_axis(axis) for axis in critique.results],
        "shared_findings": [_finding(finding) for finding in critique.shared_findings],
        "notes": (
            *critique.notes,
            *(f"{dead.axis.name}: not compared: {dead.reason}" for dead in critique.dead),
        ),
        "warnings": critique.warnings,
    }
    return {
        "schema_version": SCHEMA_VERSION,
        "allanjax_version": version("allanjax"),
        "recording": {"name": critique.name, "n": n, "rate_hz": rate, "duration_s": n / rate},
        **in_json(results),
    }


def _fields(data: Any, *names: str) -> dict[str, Any]:
    return {name: getattr(data, name) for name in names}


def _axis(axis: AxisCritique) -> dict[str, Any]:
    after = {d.statistic: _discrepancy(d) for d in axis.after}
    return {
        "axis": axis.axis.name,
        **_fields(axis.axis, "sensor", "unit"),
        "baseline": _model(axis.baseline, axis.axis),
        "baseline_measured": axis.misfit is None or not axis.misfit.excessive,
        "discrepancies": [{**_discrepancy(d), "after": after.get(d.statistic)} for d in axis.before],
        "tests": axis.tests,
        "findings": [_finding(finding) for finding in axis.findings],
        "extended": _model(axis.model, axis.axis),
    }


def _recording_finding(finding: Finding, critique: Critique) -> dict[str, Any]:
    """A finding of the recording; its parts have the changes in each axis."""
    return {
        **_head(finding),
        "amplitudes": {
            axis: {**_parameter(e), "label": e.label, "remark": e.remark}
            for axis, e in finding.amplitudes.items()
        },
        "parts": [_part(member, critique) for member in finding.members or (finding,)],
    }


def _part(finding: Finding, critique: Critique) -> dict[str, Any]:
    """Place of a finding of one axis, or of noise that axes share, in the document."""
    if finding in critique.shared_findings:
        return {"axis": None, "index": critique.shared_findings.index(finding)}
    (axis,) = finding.axes
    return {"axis": axis, "index": critique[axis].findings.index(finding)}


def _head(finding: Finding) -> dict[str, Any]:
    """Properties of every finding."""
    return {
        **_fields(finding, "cause", "axes"),
        "parameters": {k: _parameter(x) for k, x in {**finding.parameters, **finding.details}.items()},
        "p_value": finding.p_value,
        "evidence_nats": finding.evidence,
        "gain_nats": finding.gain,
        "rivals": [_fields(rival, "cause", "odds") for rival in finding.rivals],
        **_fields(finding, "span", "domain", "is_event"),
        "change": finding.change and _change(finding.change),
    }


def _finding(finding: Finding) -> dict[str, Any]:
    return {**_head(finding), "rest": finding.rest and _discrepancy(finding.rest)}


def _change(change: Change) -> dict[str, Any]:
    return {
        "share": change.share,
        "time_s": change.time,
        "notable_s": [change.first, change.last],
        "psd_share": change.density,
        "frequency_hz": change.frequency,
    }


def _discrepancy(d: Discrepancy) -> dict[str, Any]:
    return {
        "statistic": d.statistic,
        "where": d.where if d.where_unit else None,
        **_fields(d, "where_unit", "channel", "measured", "simulated", "unit", "p_value"),
    }


def _parameter(x: Estimate | Detail) -> dict[str, Any]:
    value, std, unit, limit = written(x)
    return {"value": value, "std": std, "unit": unit, "limit": limit or None}


def _model(model: Model, axis: Axis) -> dict[str, Any]:
    """Terms of a model, and their parameters by label in usual units."""
    values: dict[str, dict[str, Any]] = {}
    for p in model.parameters:
        unit = usual_unit(p.parameter, axis.sensor)
        value = None if p.start is None else p.start / unit_scale(unit, axis.sensor)
        values[p.label] = {"value": value, "unit": unit}
    return {"terms": model.term_labels, "parameters": values}

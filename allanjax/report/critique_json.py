"""Critiques as plain data, after `critique.schema.json`."""

from __future__ import annotations

import json
import os
from importlib.metadata import version
from pathlib import Path
from typing import Any

from allanjax.base.wording import finite_or_none
from allanjax.critic.result import AxisCritique, Critique, Discrepancy, Finding
from allanjax.critic.view import Quantity
from allanjax.noise.estimate import usual_unit
from allanjax.noise.model import Model
from allanjax.record.recording import Axis
from allanjax.record.units import unit_scale

SCHEMA_VERSION = 1


def to_dict(critique: Critique) -> dict[str, Any]:
    """The critique as plain dictionaries, lists, numbers and strings; numbers that do not exist are None."""
    n = len(critique.results[0].stages[0].x) if critique.results else 0
    return {
        "schema_version": SCHEMA_VERSION,
        "allanjax_version": version("allanjax"),
        "recording": {
            "name": critique.name,
            "n": n,
            "rate_hz": float(critique.rate),
            "duration_s": n / critique.rate,
        },
        "gain_nats": finite_or_none(critique.gain),
        "axes": [_axis(axis) for axis in critique.results],
        "shared_findings": [_finding(finding) for finding in critique.shared_findings],
        "notes": list(critique.notes),
        "warnings": list(critique.warnings),
    }


def write_json(critique: Critique, path: str | os.PathLike[str]) -> None:
    """Write `to_dict(critique)` to a file of JSON."""
    text = json.dumps(to_dict(critique), indent=2, ensure_ascii=False, allow_nan=False)
    # A name may come from a file name that is no text.
    Path(path).write_text(text + "\n", encoding="utf-8", errors="backslashreplace")


def _axis(axis: AxisCritique) -> dict[str, Any]:
    after = {d.statistic: d for d in axis.after}
    return {
        "axis": axis.axis.name,
        "sensor": axis.axis.sensor,
        "unit": axis.axis.unit,
        "baseline": _model(axis.baseline, axis.axis),
        "baseline_measured": axis.misfit is None or not axis.misfit.excessive,
        "discrepancies": [
            {**_discrepancy(d), "after": _discrepancy(after[d.statistic]) if d.statistic in after else None}
            for d in axis.before
        ],
        "tests": {name: finite_or_none(p) for name, p in axis.tests.items()},
        "findings": [_finding(finding) for finding in axis.findings],
        "extended": _model(axis.model, axis.axis),
    }


def _finding(finding: Finding) -> dict[str, Any]:
    drift = finding.drift
    return {
        "cause": finding.cause,
        "axes": list(finding.axes),
        "parameters": {name: _quantity(q) for name, q in finding.parameters.items()},
        "p_value": finite_or_none(finding.p_value),
        "evidence_nats": finite_or_none(finding.evidence),
        "gain_nats": finite_or_none(finding.gain),
        "rivals": [{"cause": rival.cause, "odds": finite_or_none(rival.odds)} for rival in finding.rivals],
        "span": [finite_or_none(x) for x in finding.span],
        "domain": finding.domain,
        "coefficients": [
            {
                "label": c.label,
                "before": finite_or_none(c.before),
                "after": finite_or_none(c.after),
                "unit": c.unit,
            }
            for c in finding.coefficients
        ],
        "drift": None
        if drift is None
        else {
            "horizon_s": finite_or_none(drift.horizon),
            **{key: finite_or_none(getattr(drift, key)) for key in ("measured", "before", "after")},
            "unit": drift.unit,
        },
        "discrepancies": [
            {"before": _discrepancy(before), "after": _discrepancy(after)}
            for before, after in finding.discrepancies
        ],
    }


def _discrepancy(d: Discrepancy) -> dict[str, Any]:
    return {
        "statistic": d.statistic,
        "where": finite_or_none(d.where) if d.where_unit else None,
        "where_unit": d.where_unit,
        "channel": d.channel,
        "measured": finite_or_none(d.measured),
        "simulated": finite_or_none(d.simulated),
        "unit": d.unit,
        "p_value": finite_or_none(d.p_value),
    }


def _quantity(q: Quantity) -> dict[str, Any]:
    values = q.value if isinstance(q.value, tuple) else (q.value,)
    plain = [v if isinstance(v, str) else finite_or_none(v) for v in values]
    return {
        "value": plain if isinstance(q.value, tuple) else plain[0],
        "std": finite_or_none(q.std),
        "unit": q.unit,
        "limit": q.limit or None,
    }


def _model(model: Model, axis: Axis) -> dict[str, Any]:
    """Terms of a model, and their parameters by label in usual units."""
    values: dict[str, dict[str, Any]] = {}
    for p in model.parameters:
        unit = usual_unit(p.parameter, axis.sensor)
        scale = unit_scale(unit, axis.sensor)
        values[p.label] = {
            "value": None if p.start is None else finite_or_none(p.start / scale),
            "unit": unit,
        }
    return {"terms": list(model.term_labels), "parameters": values}

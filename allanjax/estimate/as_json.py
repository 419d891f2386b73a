"""Fits as plain dictionaries, which JSON files hold; `loading` makes fits of them again."""

from __future__ import annotations

import math
from collections.abc import Sequence
from importlib.metadata import version
from typing import Any

import numpy as np
from jaxtyping import Float

from allanjax.allan.deviation import AllanDeviation
from allanjax.base.wording import finite_or_none
from allanjax.estimate.averaged import Averaged
from allanjax.estimate.misfit import Misfit
from allanjax.estimate.result import AxisFit, Fit
from allanjax.estimate.selection import AxisSelection, TermSelection
from allanjax.noise.estimate import Estimate
from allanjax.noise.model import Model
from allanjax.noise.parameter import Parametrized
from allanjax.noise.terms import NoiseTerm
from allanjax.record.recording import DeadAxis

SCHEMA_VERSION = 1
#: What stands for an infinite parameter of a model, for which JSON has no number.
INFINITY = "Infinity"


def to_dict(fit: Fit) -> dict[str, Any]:
    """The fit as plain dictionaries, lists, numbers and strings; `fit.schema.json` says what each means.

    Numbers that do not exist, such as the χ² of an axis without result, are None; so are those that are not
    finite, the upper end of an interval without one, say. `load` makes the fit of them again.
    """
    return {
        "schema_version": SCHEMA_VERSION,
        "allanjax_version": version("allanjax"),
        "recording": {
            "name": fit.name,
            "n": int(fit.curve.n),
            "rate_hz": float(fit.curve.rate),
            "duration_s": fit.curve.n / fit.curve.rate,
        },
        "objective": fit.objective,
        "converged": fit.converged,
        "model": [_term(term) for term in fit.template],
        "response": None if fit.template.response is None else _response(fit.template),
        "curve": _curve(fit.curve, fit.axes),
        "axes": [*(_axis(result, fit.selection) for result in fit.results), *map(_dead_axis, fit.dead)],
        "facts": [fact.to_dict() for fact in fit.facts],
        "warnings": list(fit.warnings),
        "stretch_s": None if fit.stretch is None else list(fit.stretch),
        "parts_s": [list(part) for part in fit.parts],
        "notes": list(fit.notes),
    }


def _dead_axis(dead: DeadAxis) -> dict[str, Any]:
    """Entry of a dead axis, which has no result."""
    nan, nothing = math.nan, np.zeros((0, 0))
    none = AxisFit(
        dead.axis, False, dead.reason, nan, 0, nan, nan, {}, nothing, Model(()), not_measured=("dead axes",)
    )
    return {**_axis(none, None), "dead": True}


def _axis(result: AxisFit, selection: TermSelection | None) -> dict[str, Any]:
    coefficients = list(result.coefficients.values()) if result.converged else []
    covariance = result.covariance if result.converged else np.zeros((0, 0))
    return {
        "name": result.axis.name,
        "sensor": result.axis.sensor,
        "unit": result.axis.unit,
        "mean_si": finite_or_none(result.mean),
        "rms_si": finite_or_none(result.rms),
        "converged": result.converged,
        "dead": False,
        "reason": result.reason,
        "chi2": finite_or_none(result.chi2) if result.converged else None,
        "dof": int(result.dof),
        "p_value": finite_or_none(result.p_value) if result.converged else None,
        "discrepancy": finite_or_none(result.discrepancy) if result.converged else None,
        "widening": result.widening,
        "measured": result.measured,
        "moving": result.moving,
        "not_measured": list(result.not_measured),
        "misfit": None if result.misfit is None else _misfit(result.misfit),
        "allan_misfit": None if result.allan_misfit is None else _misfit(result.allan_misfit),
        "coefficients": [_coefficient(c) for c in coefficients],
        "covariance": {
            "labels": [c.label for c in coefficients],
            "units": [c.si_unit for c in coefficients],
            "values": [[finite_or_none(x) for x in row] for row in covariance],
        },
        "selection": None if selection is None else _ranking(selection[result.axis.name]),
        "selection_discrepancy": None if selection is None else selection[result.axis.name].discrepancy,
        "selection_averaged": None if selection is None else _averaged(selection[result.axis.name].averaged),
        "extension": None if result.own_template is None else _extension(result),
        "regression": {
            name: {"value": value, "std": std} for name, (value, std) in result.regression.items()
        },
    }


def _extension(result: AxisFit) -> dict[str, Any]:
    """The axis's own model, what it was corrected for in words, and the fit without that."""
    template, plain = result.own_template, result.plain
    assert template is not None
    assert plain is not None
    return {
        "model": [_term(term) for term in template],
        "response": None if template.response is None else _response(template),
        "further": list(result.further),
        "correction": result.correction,
        "plain": _axis(plain, None),
    }


def _misfit(misfit: Misfit) -> dict[str, Any]:
    return {
        "of": misfit.curve,
        "largest_deviation": finite_or_none(misfit.largest),
        "at": finite_or_none(misfit.at),
        "at_unit": misfit.unit,
        "rms_deviation": finite_or_none(misfit.rms),
        "octave_deviation": finite_or_none(misfit.sustained),
        "scatter": finite_or_none(misfit.scatter),
    }


def _term(term: NoiseTerm) -> dict[str, Any]:
    return {"term": term.name(), **_parameters(term)}


def _response(model: Model) -> dict[str, Any]:
    """The response of a model, and the terms that pass it."""
    response = model.response
    assert response is not None
    return {
        "response": response.name(),
        **_parameters(response),
        "inside": [label for label, inside in zip(model.term_labels, model.inside, strict=True) if inside],
    }


def _parameters(of: Parametrized) -> dict[str, Any]:
    values = {p.name: getattr(of, p.name) for p in of.parameters()}
    found: dict[str, Any] = {"parameters": {name: _start(x) for name, x in values.items()}}
    if of.options:
        found["options"] = of.options
    return {**found, "held": sorted(of.held)}


def _start(x: float | None) -> float | str | None:
    return x if x is None else float(x) if math.isfinite(x) else INFINITY


def _curve(curve: AllanDeviation, axes: Sequence[str]) -> dict[str, Any]:
    def by_axis(values: Float[np.ndarray, "m axes"]) -> dict[str, list[float | None]]:
        return {
            axis: [finite_or_none(x) for x in column] for axis, column in zip(axes, values.T, strict=True)
        }

    return {
        "kind": curve.kind,
        "overlapping": curve.overlapping,
        "estimator": curve.estimator,
        "other_stretches": list(curve.others),
        "cluster_time_s": curve.cluster_time.tolist(),
        "cluster_size": curve.cluster_size.tolist(),
        "count": curve.count.tolist(),
        "deviation": by_axis(curve.deviation),
        "degrees_of_freedom": by_axis(curve.edf),
    }


def _ranking(selection: AxisSelection) -> list[dict[str, Any]]:
    return [
        {
            "terms": list(s.terms),
            "parameters": s.parameters,
            "probability": s.probability,
            "log_evidence": finite_or_none(s.log_evidence),
            "chosen": s == selection.chosen,
        }
        for s in selection.ranking
    ]


def _averaged(averaged: Averaged | None) -> dict[str, Any] | None:
    if averaged is None:
        return None
    return {
        "coefficients": [_coefficient(c) for c in averaged.coefficients.values()],
        "cluster_time_s": averaged.cluster_time.tolist(),
        "deviation": averaged.deviation.tolist(),
        "interval_95": averaged.interval.tolist(),
    }


def _coefficient(c: Estimate) -> dict[str, Any]:
    return {
        "label": c.label,
        "term": c.term,
        "symbol": c.symbol,
        "kind": c.kind,
        "detected": c.detected,
        "rivals": list(c.rivals),
        "held": c.held,
        "measured": c.measured,
        **in_both_units(c),
    }


def in_both_units(c: Estimate) -> dict[str, Any]:
    """Value, scatter and intervals of an estimate in the unit in which it is shown, and in SI."""
    shown, si = c.in_unit(), c.in_unit(c.si_unit)
    return {"unit": shown.unit, **_numbers(shown), "si": {"unit": si.unit, **_numbers(si)}}


def _numbers(c: Estimate) -> dict[str, Any]:
    return {
        "value": finite_or_none(c.value),
        "std": finite_or_none(c.std),
        "interval_68": [finite_or_none(x) for x in c.interval_68],
        "interval_95": [finite_or_none(x) for x in c.interval],
        "upper_limit_95": None if c.upper_limit is None else finite_or_none(c.upper_limit),
        "lower_limit_95": c.lower_limit,
    }

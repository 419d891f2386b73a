"""A fit as JSON, and a fit loaded from that."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np
from jaxtyping import Float

from allanjax.allan.deviation import AllanDeviation
from allanjax.base.errors import AllanjaxError
from allanjax.base.wording import finite_or_none
from allanjax.estimate.result import AxisFit, Fit, Misfit, extended_model, fitted_model
from allanjax.estimate.selection import Averaged, AxisSelection, TermSelection, TermSet
from allanjax.inspection.facts import Fact
from allanjax.noise.estimate import Estimate
from allanjax.noise.model import Model
from allanjax.noise.notation import response_classes, term_classes
from allanjax.noise.parameter import Parametrized
from allanjax.noise.terms import NoiseTerm, Parameter
from allanjax.record.recording import Axis, DeadAxis

SCHEMA_VERSION = 1
#: Replacement for an infinite parameter of a model, for which JSON has no number.
INFINITY = "Infinity"
_Made = TypeVar("_Made", bound=Parametrized)


def to_dict(fit: Fit) -> dict[str, Any]:
    """The fit as plain dictionaries, lists, numbers and strings; `fit.schema.json` describes the keys.

    Numbers that do not exist, such as the χ² of an axis without a result, and numbers that are not finite,
    such as the upper end of an open interval, are None. `load` restores the fit.
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
        **_terms(fit.template),
        "curve": _curve(fit.curve, fit.axes),
        "axes": [*(_axis(result, fit.selection) for result in fit.results), *map(_dead_axis, fit.dead)],
        "facts": [fact.to_dict() for fact in fit.facts],
        "warnings": list(fit.warnings),
        "stretch_s": None if fit.longest_part is None else list(fit.longest_part),
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
        "misfit": _misfit(result.misfit),
        "allan_misfit": _misfit(result.allan_misfit),
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
    """The axis's own model, its correction in words, and the fit without that correction."""
    template, plain = result.own_template, result.plain
    assert template is not None
    assert plain is not None
    return {
        **_terms(template),
        "further": list(result.further),
        "correction": result.correction,
        "plain": _axis(plain, None),
    }


def _misfit(misfit: Misfit | None) -> dict[str, Any] | None:
    if misfit is None:
        return None
    return {
        "of": misfit.curve,
        "largest_deviation": finite_or_none(misfit.largest),
        "at": finite_or_none(misfit.at),
        "at_unit": misfit.unit,
        "rms_deviation": finite_or_none(misfit.rms),
        "octave_deviation": finite_or_none(misfit.sustained),
        "scatter": finite_or_none(misfit.scatter),
    }


def _terms(model: Model) -> dict[str, Any]:
    """The terms of a model, its response, and the terms that pass through it."""
    terms = [{"term": term.name(), **_parameters(term)} for term in model]
    if (response := model.response) is None:
        return {"model": terms, "response": None}
    inside = [label for label, inside in zip(model.term_labels, model.inside, strict=True) if inside]
    passed = {"response": response.name(), **_parameters(response), "inside": inside}
    return {"model": terms, "response": passed}


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
            "intervals_95_si": {label: list(ends) for label, ends in s.intervals.items()},
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
    """Value, standard deviation and intervals of an estimate in its usual unit and in SI."""
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


def load(path: str | os.PathLike[str], terms: Sequence[type[NoiseTerm]] = ()) -> Fit | dict[str, Fit]:
    """Load a fit with its curve from a JSON file; it prints and plots like the original.

    The file does not hold the spectrum of a fit by Whittle's likelihood, so such a fit cannot be sampled.

    Args:
        path: file written by `write_json`, `allanjax characterize`, `allanjax characterize --json` or
            `allanjax fleet` (`recordings/NAME.json`).
        terms: classes of user-defined noise terms in the model.

    Returns:
        The fit; for the output of `--json`, which may hold several, a dictionary of fits by file.

    Raises:
        AllanjaxError: the file does not exist, holds no fit, is damaged or of another version, or has a term
            that is neither built in nor among `terms`.
    """
    try:
        document = json.loads(Path(path).read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise AllanjaxError(f"{path}: no such file; check the path") from error
    except (OSError, ValueError) as error:
        raise AllanjaxError(
            f"{path}: not a JSON file, or damaged ({error}); give a NAME.json of allanjax characterize"
        ) from error
    classes = term_classes() | {term.name(): term for term in terms}
    try:
        if "fits" in document:
            return {entry["file"]: _fit(entry, classes) for entry in document["fits"]}
        return _fit(document.get("fit", document), classes)
    except AllanjaxError as error:
        raise AllanjaxError(f"{path}: {error}") from error
    except (KeyError, TypeError, ValueError, IndexError, AttributeError) as error:
        raise AllanjaxError(f"{path}: not a fit written by allanjax, or damaged: {error!r}") from error


def _fit(document: Mapping[str, Any], classes: Mapping[str, type[NoiseTerm]]) -> Fit:
    """Fit from its JSON document."""
    if "baseline" in document or "schema_version" not in document or "axes" not in document:
        raise AllanjaxError("not a fit written by allanjax; give a NAME.json of allanjax characterize")
    if document["schema_version"] != SCHEMA_VERSION:
        raise AllanjaxError(
            f"schema version {document['schema_version']}, but this allanjax reads version {SCHEMA_VERSION}; "
            f"load it with allanjax {document.get('allanjax_version', 'of the version that wrote it')}"
        )
    if "curve" not in document:
        raise AllanjaxError(
            f"written by allanjax {document.get('allanjax_version')} without the curve; characterize the "
            "recording again"
        )
    template = _model(document, classes)
    alive = [a for a in document["axes"] if not a["dead"]]
    axes = tuple(map(_loaded_axis, alive))
    name = document["recording"]["name"]
    return Fit(
        name=name,
        template=template,
        curve=_loaded_curve(document, axes),
        results=tuple(_result(a, axis, template, classes) for a, axis in zip(alive, axes, strict=True)),
        notes=tuple(document["notes"]),
        facts=tuple(map(Fact.from_dict, document["facts"])),
        parts=tuple((first, last) for first, last in document["parts_s"]),
        objective=document["objective"],
        selection=_selection(name, alive, axes, classes),
        dead=tuple(DeadAxis(_loaded_axis(a), a["reason"]) for a in document["axes"] if a["dead"]),
    )


def _model(document: Mapping[str, Any], classes: Mapping[str, type[NoiseTerm]]) -> Model:
    """The model that was fitted."""
    plain = Model(tuple(_loaded_term(term, classes) for term in document["model"]))
    if not (of := document.get("response")):
        return plain
    response = _parametrized(response_classes()[of["response"]], of)
    inside = tuple(label in of["inside"] for label in plain.term_labels)
    return Model(plain.terms, response, inside)


def _loaded_term(term: Mapping[str, Any], classes: Mapping[str, type[NoiseTerm]]) -> NoiseTerm:
    """Noise term of the fitted model."""
    if term["term"] not in classes:
        raise AllanjaxError(
            f"unknown term {term['term']!r}; pass the class of a user-defined term with load(path, terms=[…])"
        )
    return _parametrized(classes[term["term"]], term)


def _parametrized(made: type[_Made], of: Mapping[str, Any]) -> _Made:
    """Term or response of this class, with its parameters."""
    values: dict[str, Any] = {name: math.inf if x == INFINITY else x for name, x in of["parameters"].items()}
    return made(**values, **of.get("options", {})).hold(*of["held"])


def _loaded_curve(document: Mapping[str, Any], axes: tuple[Axis, ...]) -> AllanDeviation:
    """Allan deviations of all axes but the dead ones."""
    curve = document["curve"]
    return AllanDeviation(
        cluster_time=np.array(curve["cluster_time_s"], float),
        cluster_size=np.array(curve["cluster_size"], int),
        deviation=np.stack([_loaded_numbers(curve["deviation"][axis.name]) for axis in axes], axis=1),
        count=np.array(curve["count"], int),
        edf=np.stack([_loaded_numbers(curve["degrees_of_freedom"][axis.name]) for axis in axes], axis=1),
        n=document["recording"]["n"],
        rate=document["recording"]["rate_hz"],
        kind=curve["kind"],
        overlapping=curve["overlapping"],
        axes=axes,
        estimator=curve["estimator"],
        others=tuple(curve.get("other_stretches", ())),
    )


def _loaded_axis(a: Mapping[str, Any]) -> Axis:
    return Axis(a["name"], a["sensor"], a["unit"])


def _result(
    a: Mapping[str, Any], axis: Axis, template: Model, classes: Mapping[str, type[NoiseTerm]]
) -> AxisFit:
    """Result of one axis."""
    own = plain = None
    if extension := a.get("extension"):
        own = _model(extension, classes)
        template, plain = own, _result(extension["plain"], axis, template, classes)
    parameters = {p.label: p.parameter for p in template.parameters}
    coefficients = {c["label"]: _estimate(c, parameters[c["label"]], axis, "fit") for c in a["coefficients"]}
    return AxisFit(
        axis=axis,
        converged=a["converged"],
        reason=a["reason"],
        chi2=_number(a["chi2"]),
        dof=a["dof"],
        p_value=_number(a["p_value"]),
        discrepancy=_number(a["discrepancy"]),
        widening=a.get("widening", 1.0),
        _coefficients=coefficients,
        _covariance=_matrix(a["covariance"]["values"]),
        _model=(fitted_model if own is None else extended_model)(template, coefficients),
        regression={name: (x["value"], x["std"]) for name, x in a["regression"].items()},
        misfit=_loaded_misfit(a["misfit"]),
        allan_misfit=_loaded_misfit(a.get("allan_misfit")),
        mean=_number(a["mean_si"]),
        rms=_number(a["rms_si"]),
        not_measured=tuple(a["not_measured"]),
        own_template=own,
        plain=plain,
    )


def _estimate(c: Mapping[str, Any], p: Parameter, axis: Axis, source: Literal["fit", "averaged"]) -> Estimate:
    """Coefficient in SI."""
    si, limit = c["si"], c["si"]["upper_limit_95"]
    limited = p.is_amplitude and c["measured"] and not c["held"]
    return Estimate(
        label=c["label"],
        term=c["term"],
        parameter=p,
        axis=axis,
        unit=si["unit"],
        value=_number(si["value"]),
        std=_number(si["std"]),
        interval=_interval(si["interval_95"]),
        interval_68=_interval(si["interval_68"]),
        upper_limit=math.inf if limit is None and limited else limit,
        lower_limit=si["lower_limit_95"],
        detected=c["detected"],
        rivals=tuple(c.get("rivals", ())),
        held=c["held"],
        measured=c["measured"],
        source=source,
    )


def _loaded_misfit(m: Mapping[str, Any] | None) -> Misfit | None:
    if m is None:
        return None
    largest, rms, octave = (_number(m[f"{key}_deviation"]) for key in ("largest", "rms", "octave"))
    return Misfit(largest, _number(m["at"]), m["at_unit"], rms, octave, _number(m["scatter"]))


def _selection(
    name: str, documents: Sequence[Any], axes: tuple[Axis, ...], classes: Mapping[str, type[NoiseTerm]]
) -> TermSelection | None:
    """Ranking of the term sets, if the fit chose among them."""
    if any(a["selection"] is None for a in documents):
        return None

    def ranking(sets: Sequence[Mapping[str, Any]]) -> tuple[TermSet, ...]:
        evidence = [-math.inf if s["log_evidence"] is None else s["log_evidence"] for s in sets]
        return tuple(
            TermSet(
                tuple(s["terms"]),
                s["parameters"],
                e,
                s["probability"],
                {label: tuple(ends) for label, ends in s.get("intervals_95_si", {}).items()},
            )
            for s, e in zip(sets, evidence, strict=True)
        )

    def averaged(of: Mapping[str, Any] | None, axis: Axis) -> Averaged | None:
        if not of:
            return None
        coefficients = {}
        for c in of["coefficients"]:
            term = c["term"] if c["term"] in classes else c["term"].rpartition("_")[0]
            p = classes[term].amplitude_parameter()
            coefficients[c["label"]] = _estimate(c, p, axis, "averaged")
        time, deviation = _loaded_numbers(of["cluster_time_s"]), _loaded_numbers(of["deviation"])
        return Averaged(coefficients, time, deviation, np.array(of["interval_95"]))

    results = (
        AxisSelection(
            axis,
            ranking(a["selection"]),
            a["selection_discrepancy"],
            averaged(a.get("selection_averaged"), axis),
        )
        for a, axis in zip(documents, axes, strict=True)
    )
    return TermSelection(name, tuple(results))


def _number(x: float | None) -> float:
    """Number from JSON, NaN for null."""
    return math.nan if x is None else float(x)


def _matrix(rows: Sequence[Sequence[float | None]]) -> Float[np.ndarray, "params params"]:
    """Square matrix of these rows, which is empty if there are none."""
    return np.array([_loaded_numbers(row) for row in rows]).reshape(len(rows), len(rows))


def _loaded_numbers(values: Sequence[float | None]) -> Float[np.ndarray, " m"]:
    return np.array([_number(x) for x in values])


def _interval(ends: Sequence[float | None]) -> tuple[float, float]:
    """Ends of an interval from JSON; without an upper one it extends to infinity."""
    lower, upper = ends
    return _number(lower), math.inf if upper is None and lower is not None else _number(upper)

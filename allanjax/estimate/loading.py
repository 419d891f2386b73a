"""Loading of fits from JSON files that allanjax wrote; `fit.schema.json` describes these."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np
from jaxtyping import Float

from allanjax.allan.deviation import AllanDeviation
from allanjax.base.errors import AllanjaxError
from allanjax.estimate.as_json import INFINITY, SCHEMA_VERSION
from allanjax.estimate.averaged import Averaged
from allanjax.estimate.misfit import Misfit
from allanjax.estimate.result import AxisFit, Fit, extended_model, fitted_model
from allanjax.estimate.selection import AxisSelection, TermSelection, TermSet
from allanjax.inspection.facts import Fact
from allanjax.noise.estimate import Estimate
from allanjax.noise.model import Model
from allanjax.noise.notation import response_classes, term_classes
from allanjax.noise.parameter import Parametrized
from allanjax.noise.terms import NoiseTerm, Parameter
from allanjax.record.recording import Axis, DeadAxis

_Made = TypeVar("_Made", bound=Parametrized)


def load(path: str | os.PathLike[str], terms: Sequence[type[NoiseTerm]] = ()) -> Fit | dict[str, Fit]:
    """Load a fit with its curve from a JSON file: it prints and plots as the one that was written.

    The spectrum of a fit by Whittle's likelihood is not in the file, so that such a fit cannot be sampled.

    Args:
        path: what `write_json` or `allanjax characterize` wrote; the output of `allanjax characterize --json`
            or of `allanjax fleet` (`recordings/NAME.json`).
        terms: classes of user-defined noise terms in the model.

    Returns:
        The fit; for the output of `--json`, which may hold several, fits by their files.

    Raises:
        AllanjaxError: there is no such file, it holds no fit, is damaged, is of another version, or has a
            term that is not allanjax's and not among `terms`.
    """
    try:
        document = json.loads(Path(path).read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise AllanjaxError(f"{path}: no such file; check the path") from error
    except (OSError, ValueError) as error:
        raise AllanjaxError(f"{path}: not a file of JSON, or damaged: {error}") from error
    classes = term_classes() | {term.name(): term for term in terms}
    try:
        if "fits" in document:
            return {entry["file"]: _fit(entry, classes) for entry in document["fits"]}
        return _fit(document.get("fit", document), classes)
    except AllanjaxError as error:
        raise AllanjaxError(f"{path}: {error}") from error
    except (KeyError, TypeError, ValueError, IndexError, AttributeError) as error:
        raise AllanjaxError(f"{path}: not a fit that allanjax wrote, or damaged: {error!r}") from error


def _fit(document: Mapping[str, Any], classes: Mapping[str, type[NoiseTerm]]) -> Fit:
    """Fit from its JSON document."""
    if "baseline" in document or "schema_version" not in document or "axes" not in document:
        raise AllanjaxError("not a fit that allanjax wrote; such a file comes from allanjax characterize")
    if document["schema_version"] != SCHEMA_VERSION:
        raise AllanjaxError(
            f"of schema version {document['schema_version']}, this allanjax reads {SCHEMA_VERSION}; load it "
            f"with allanjax {document.get('allanjax_version', 'of its time')}"
        )
    if "curve" not in document:
        raise AllanjaxError(
            f"written by allanjax {document.get('allanjax_version')}, without its curve; characterize the "
            "recording again"
        )
    template = _model(document, classes)
    alive = [a for a in document["axes"] if not a["dead"]]
    axes = tuple(map(_axis, alive))
    name = document["recording"]["name"]
    return Fit(
        name=name,
        template=template,
        curve=_curve(document, axes),
        results=tuple(_result(a, axis, template, classes) for a, axis in zip(alive, axes, strict=True)),
        notes=tuple(document["notes"]),
        facts=tuple(map(Fact.from_dict, document["facts"])),
        parts=tuple((first, last) for first, last in document["parts_s"]),
        objective=document["objective"],
        selection=_selection(name, alive, axes, classes),
        dead=tuple(DeadAxis(_axis(a), a["reason"]) for a in document["axes"] if a["dead"]),
    )


def _model(document: Mapping[str, Any], classes: Mapping[str, type[NoiseTerm]]) -> Model:
    """The model that was fitted."""
    plain = Model(tuple(_term(term, classes) for term in document["model"]))
    if not (of := document.get("response")):
        return plain
    response = _parametrized(response_classes()[of["response"]], of)
    inside = tuple(label in of["inside"] for label in plain.term_labels)
    return Model(plain.terms, response, inside)


def _term(term: Mapping[str, Any], classes: Mapping[str, type[NoiseTerm]]) -> NoiseTerm:
    """Noise term of the fitted model."""
    if term["term"] not in classes:
        raise AllanjaxError(
            f"its term {term['term']!r} is none of allanjax's: give its class, load(path, terms=[…])"
        )
    return _parametrized(classes[term["term"]], term)


def _parametrized(made: type[_Made], of: Mapping[str, Any]) -> _Made:
    """Term or response of this class, with its parameters."""
    values: dict[str, Any] = {name: math.inf if x == INFINITY else x for name, x in of["parameters"].items()}
    return made(**values, **of.get("options", {})).hold(*of["held"])


def _curve(document: Mapping[str, Any], axes: tuple[Axis, ...]) -> AllanDeviation:
    """Allan deviations of the living axes."""
    curve = document["curve"]
    return AllanDeviation(
        cluster_time=np.array(curve["cluster_time_s"], float),
        cluster_size=np.array(curve["cluster_size"], int),
        deviation=np.stack([_numbers(curve["deviation"][axis.name]) for axis in axes], axis=1),
        count=np.array(curve["count"], int),
        edf=np.stack([_numbers(curve["degrees_of_freedom"][axis.name]) for axis in axes], axis=1),
        n=document["recording"]["n"],
        rate=document["recording"]["rate_hz"],
        kind=curve["kind"],
        overlapping=curve["overlapping"],
        axes=axes,
        estimator=curve["estimator"],
        others=tuple(curve.get("other_stretches", ())),
    )


def _axis(a: Mapping[str, Any]) -> Axis:
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
        misfit=_misfit(a["misfit"]),
        allan_misfit=_misfit(a.get("allan_misfit")),
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


def _misfit(m: Mapping[str, Any] | None) -> Misfit | None:
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
            TermSet(tuple(s["terms"]), s["parameters"], e, s["probability"])
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
        time, deviation = _numbers(of["cluster_time_s"]), _numbers(of["deviation"])
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
    return np.array([_numbers(row) for row in rows]).reshape(len(rows), len(rows))


def _numbers(values: Sequence[float | None]) -> Float[np.ndarray, " m"]:
    return np.array([_number(x) for x in values])


def _interval(ends: Sequence[float | None]) -> tuple[float, float]:
    """Ends of an interval from JSON; without an upper one it extends to infinity."""
    lower, upper = ends
    return _number(lower), math.inf if upper is None and lower is not None else _number(upper)

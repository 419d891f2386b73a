"""A fit as JSON, and a fit loaded from that; both follow one table of keys for each class."""

from __future__ import annotations

import dataclasses
import json
import math
import os
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any, TypeAlias, TypeVar

import numpy as np

from allanjax.allan.deviation import AllanDeviation
from allanjax.base.errors import AllanjaxError, expect
from allanjax.base.wording import finite_or_none
from allanjax.estimate.misfit import Misfit
from allanjax.estimate.result import AxisFit, Fit, extended_model, fitted_model
from allanjax.estimate.selection import AxisSelection, TermSelection, TermSet
from allanjax.inspection.facts import Fact
from allanjax.noise.estimate import Estimate, Variation
from allanjax.noise.model import Model
from allanjax.noise.notation import response_classes, term_classes
from allanjax.noise.parameter import Parametrized
from allanjax.noise.terms import NoiseTerm, Parameter
from allanjax.record.recording import Axis, DeadAxis

SCHEMA_VERSION = 1
#: Replacement for an infinite parameter of a model, for which JSON has no number.
INFINITY = "Infinity"
_Made = TypeVar("_Made")
_Own = TypeVar("_Own", bound=Parametrized)
_Classes: TypeAlias = Mapping[str, type[NoiseTerm]]


def _keys(text: str) -> dict[str, str]:
    """Keys, and the attribute behind each: `key=attribute`, or `key=` if a function writes it."""
    words = (word.partition("=") for word in text.split())
    return {key: name if equals else key for key, equals, name in words}


# Of an estimate in one unit.
_NUMBERS = _keys("""unit value std interval_68 interval_95=interval upper_limit_95=upper_limit
    lower_limit_95=lower_limit""")
_KEYS: Mapping[type, dict[str, str]] = {
    Fit: _keys("""schema_version= allanjax_version= recording= objective converged model= response= curve=
        axes= facts warnings stretch_s=longest_part parts_s=parts notes"""),
    AxisFit: _keys("""mean_si=mean rms_si=rms converged dead= reason chi2 dof p_value discrepancy widening
        measured moving not_measured verdict=word misfit other_misfit coefficients= covariance= selection=
        selection_discrepancy= extension= regression="""),
    Fact: _keys("kind text finding meaning remedy axes consequence size unit spans share"),
    Misfit: _keys("""of=curve largest_deviation=largest at at_unit=unit rms_deviation=rms
        octave_deviation=sustained scatter felt_by=felt"""),
    Estimate: _keys("label term symbol kind detected rivals held measured variation") | _NUMBERS,
    Variation: _keys("size interval_95=interval error louder excess"),
    AllanDeviation: _keys("""kind overlapping estimator other_stretches=others cluster_time_s=cluster_time
        determined cluster_size count deviation= degrees_of_freedom="""),
    TermSet: _keys("terms parameters probability log_evidence chosen= intervals_95_si=intervals"),
}


def in_json(value: Any) -> Any:
    """A value in types of JSON, which has neither NaN nor infinity: numbers that are not finite are None."""
    if isinstance(value, Estimate):
        return {**_written(value), **in_both_units(value)}
    if dataclasses.is_dataclass(value):
        return _written(value)
    if isinstance(value, Mapping):
        return {key: in_json(x) for key, x in value.items()}
    if isinstance(value, tuple | list | np.ndarray):
        return [in_json(x) for x in value]
    if isinstance(value, np.integer):
        return int(value)
    return finite_or_none(value) if isinstance(value, float) else value


def _keys_of(kind: Any) -> Mapping[str, str]:
    """Keys of a class, by default the names of its fields, and the attribute behind each."""
    return _KEYS.get(kind) or {field.name: field.name for field in dataclasses.fields(kind)}


def _written(of: Any, keys: Mapping[str, str] | None = None) -> dict[str, Any]:
    keys = _keys_of(type(of)) if keys is None else keys
    return {key: in_json(getattr(of, name)) if name else None for key, name in keys.items()}


def read(made: type[_Made], document: Mapping[str, Any], **given: Any) -> _Made:
    """The object of a class from its JSON, and as given what that does not hold; else fields have defaults.

    Null is NaN in a field that cannot be None.
    """
    keys = {name: key for key, name in _keys_of(made).items()}
    for field in dataclasses.fields(made):  # type: ignore[arg-type]
        key, kind = keys.get(field.name, ""), str(field.type)
        if field.name in given or key not in document:
            continue
        value = document[key]
        if "ndarray" in kind:
            value = np.array(value, int if "Int" in kind else float)
        elif value is None and "None" not in kind:
            value = math.nan
        given[field.name] = _tuples(value)
    return made(**given)


def _tuples(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _tuples(x) for key, x in value.items()}
    return tuple(map(_tuples, value)) if isinstance(value, list) else value


def to_dict(fit: Fit) -> dict[str, Any]:
    """The fit as plain dictionaries, lists, numbers and strings; `allanjax schema fit` describes the keys.

    Numbers that do not exist or are not finite are None. `load` restores the fit.
    """
    curve, n, rate = fit.curve, int(fit.curve.n), float(fit.curve.rate)
    columns = {"deviation": curve.deviation, "degrees_of_freedom": curve.edf}
    by_axis = {key: dict(zip(fit.axes, in_json(x.T), strict=True)) for key, x in columns.items()}
    rankings = [None] * len(fit.results) if fit.selection is None else fit.selection.results
    axes = [_axis(*pair) for pair in zip(fit.results, rankings, strict=True)]
    for d in fit.dead:
        axes.append(_axis(AxisFit(d.axis, False, d.reason, not_measured=("dead axes",)), dead=True))
    return {
        **_written(fit),
        "schema_version": SCHEMA_VERSION,
        "allanjax_version": version("allanjax"),
        "recording": {"name": fit.name, "n": n, "rate_hz": rate, "duration_s": n / rate},
        **_terms(fit.template),
        "curve": {**_written(curve), **by_axis},
        "axes": axes,
    }


def _axis(result: AxisFit, ranking: AxisSelection | None = None, dead: bool = False) -> dict[str, Any]:
    found = list(result._coefficients.values())
    more: dict[str, Any] = {
        "dead": dead,
        "coefficients": in_json(found),
        "covariance": {
            "labels": [c.label for c in found],
            "units": [c.si_unit for c in found],
            "values": in_json(result._covariance),
        },
        "regression": {name: {"value": x, "std": std} for name, (x, std) in result.regression.items()},
    }
    if ranking is not None:
        sets = [{**_written(s), "chosen": s == ranking.chosen} for s in ranking.ranking]
        more |= {"selection": sets, "selection_discrepancy": ranking.discrepancy}
    if result.own_template is not None and result.plain is not None:
        more["extension"] = {
            **_terms(result.own_template),
            "further": list(result.further),
            "correction": result.correction,
            "plain": _axis(result.plain),
        }
    return {**_written(result.axis), **_written(result), **more}


def in_both_units(c: Estimate) -> dict[str, Any]:
    """Value, standard deviation and intervals of an estimate in its usual unit and in SI."""
    return {**_written(c.in_unit(), _NUMBERS), "si": _written(c.in_unit(c.si_unit), _NUMBERS)}


def _terms(model: Model) -> dict[str, Any]:
    """The terms of a model, its response, and the terms that pass through it."""
    terms = [{"term": term.name(), **_parameters(term)} for term in model]
    if (response := model.response) is None:
        return {"model": terms, "response": None}
    inside = [label for label, inside in zip(model.term_labels, model.inside, strict=True) if inside]
    of_response = {"response": response.name(), **_parameters(response), "inside": inside}
    return {"model": terms, "response": of_response}


def _parameters(of: Parametrized) -> dict[str, Any]:
    values = {p.name: getattr(of, p.name) for p in of.parameters()}
    known = {name: INFINITY if x == math.inf else x if x is None else float(x) for name, x in values.items()}
    return {"parameters": known, **({"options": of.options} if of.options else {}), "held": sorted(of.held)}


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
    expect(path, (str, os.PathLike), "load takes the path of a JSON file")
    document = document_in(path, "a NAME.json of allanjax characterize")
    classes = term_classes() | {term.name(): term for term in terms}
    try:
        if "fits" in document:
            return {entry["file"]: _fit(entry, classes) for entry in document["fits"]}
        return _fit(document.get("fit", document), classes)
    except AllanjaxError as error:
        raise AllanjaxError(f"{path}: {error}") from error
    except (KeyError, TypeError, ValueError, IndexError, AttributeError) as error:
        raise AllanjaxError(f"{path}: not a fit written by allanjax, or damaged: {error!r}") from error


def fits_in(path: str | os.PathLike[str]) -> list[Fit]:
    """The fits in a file: one, or one per sensor; AllanjaxError as for `load`."""
    fits = load(path)
    return [*fits.values()] if isinstance(fits, dict) else [fits]


def load_one(path: str | os.PathLike[str]) -> Fit:
    """The fit in a file; AllanjaxError if there is none, or more than one."""
    fits = load(path)
    if not isinstance(fits, dict):
        return fits
    if len(fits) != 1:
        raise AllanjaxError(
            f"{path}: contains {len(fits)} fits ({', '.join(fits)}); run allanjax characterize without "
            "--json and give one NAME.json"
        )
    return next(iter(fits.values()))


def document_in(path: str | os.PathLike[str], wanted: str) -> Any:
    """What a JSON file holds; AllanjaxError that asks for what is wanted if there is no such file."""
    try:
        return json.loads(Path(path).read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise AllanjaxError(f"{path}: no such file; check the path") from error
    except (OSError, ValueError, RecursionError) as error:
        raise AllanjaxError(f"{path}: not a JSON file, or damaged ({error}); give {wanted}") from error


def _fit(document: Mapping[str, Any], classes: _Classes) -> Fit:
    written, version_of = document.get("allanjax_version"), document.get("schema_version")
    if "baseline" in document or version_of is None or "axes" not in document:
        raise AllanjaxError("not a fit written by allanjax; give a NAME.json of allanjax characterize")
    if version_of != SCHEMA_VERSION:
        raise AllanjaxError(
            f"schema version {version_of}, but this allanjax reads version {SCHEMA_VERSION}; load it with "
            f"allanjax {written or 'of the version that wrote it'}"
        )
    if "curve" not in document:
        raise AllanjaxError(
            f"written by allanjax {written} without the curve; characterize the recording again"
        )
    template, of, curve = _model(document, classes), document["recording"], document["curve"]
    alive = [(a, read(Axis, a)) for a in document["axes"] if not a["dead"]]
    axes, keys = tuple(axis for _, axis in alive), {"deviation": "deviation", "edf": "degrees_of_freedom"}
    known = {name: np.array([curve[key][x.name] for x in axes], float).T for name, key in keys.items()}
    chosen = all(a["selection"] is not None for a, _ in alive)
    rankings = tuple(_selection(*of_axis) for of_axis in alive) if chosen else ()
    measured = read(AllanDeviation, curve, **known, n=of["n"], rate=of["rate_hz"], axes=axes)
    results = tuple(_result(*of_axis, template, classes) for of_axis in alive)
    if not measured.determined:
        results = tuple(r.without_intervals() if r.measured else r for r in results)
    return read(
        Fit,
        document,
        name=of["name"],
        template=template,
        curve=measured,
        results=results,
        # Older files have the text as a whole.
        facts=tuple(read(Fact, {"finding": fact["text"], **fact}) for fact in document["facts"]),
        selection=TermSelection(of["name"], rankings) if chosen else None,
        dead=tuple(DeadAxis(read(Axis, a), a["reason"]) for a in document["axes"] if a["dead"]),
    )


def _model(document: Mapping[str, Any], classes: _Classes) -> Model:
    for name in (term["term"] for term in document["model"]):
        if name not in classes:
            raise AllanjaxError(
                f"unknown term {name!r}; pass the class of a user-defined term with load(path, terms=[…])"
            )
    plain = Model(tuple(_parametrized(classes[term["term"]], term) for term in document["model"]))
    if not (of := document.get("response")):
        return plain
    response = _parametrized(response_classes()[of["response"]], of)
    return Model(plain.terms, response, tuple(label in of["inside"] for label in plain.term_labels))


def _parametrized(made: type[_Own], of: Mapping[str, Any]) -> _Own:
    """Term or response of this class, with its parameters."""
    values: dict[str, Any] = {name: math.inf if x == INFINITY else x for name, x in of["parameters"].items()}
    return made(**values, **of.get("options", {})).hold(*of["held"])


def _result(a: Mapping[str, Any], axis: Axis, template: Model, classes: _Classes) -> AxisFit:
    own = plain = None
    if extension := a.get("extension"):
        own = _model(extension, classes)
        template, plain = own, _result(extension["plain"], axis, template, classes)
    misfit, other = a.get("misfit"), a.get("other_misfit")
    parameters = {p.label: p.parameter for p in template.parameters}
    found = {c["label"]: _estimate(c, parameters[c["label"]], axis) for c in a["coefficients"]}
    return read(
        AxisFit,
        a,
        axis=axis,
        _coefficients=found,
        _covariance=np.array(a["covariance"]["values"], float).reshape(len(found), len(found)),
        _model=(fitted_model if own is None else extended_model)(template, found),
        regression={name: (x["value"], x["std"]) for name, x in a["regression"].items()},
        misfit=misfit and read(Misfit, misfit),
        other_misfit=other and read(Misfit, other),
        own_template=own,
        plain=plain,
    )


def _estimate(c: Mapping[str, Any], p: Parameter, axis: Axis) -> Estimate:
    """Coefficient in SI."""
    si, more = c["si"], dict[str, Any]()
    for name, key in (("interval", "interval_95"), ("interval_68", "interval_68")):
        # Without an upper end it extends to infinity; without both there is none.
        low, high = (math.nan if x is None else x for x in si[key])
        more[name] = low, math.inf if math.isnan(high) and not math.isnan(low) else high
    if si["upper_limit_95"] is None and p.is_amplitude and c["measured"] and not c["held"]:
        more["upper_limit"] = math.inf
    if c.get("variation"):
        more["variation"] = read(Variation, c["variation"])
    return read(Estimate, {**c, **si}, axis=axis, parameter=p, **more)


def _selection(a: Mapping[str, Any], axis: Axis) -> AxisSelection:
    ranking = []
    for s in a["selection"]:
        evidence = -math.inf if s["log_evidence"] is None else s["log_evidence"]
        ranking.append(read(TermSet, s, log_evidence=evidence))
    return AxisSelection(axis, tuple(ranking), a["selection_discrepancy"])

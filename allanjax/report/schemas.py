"""JSON schemas of files and of `--json`: fits, critiques, horizons, the recordings of a fleet."""

import json
from dataclasses import fields
from importlib.resources import files
from typing import Any, Literal

from allanjax.estimate.horizon import SCHEMA_VERSION as HORIZON_VERSION
from allanjax.fleet.options import FitOptions

Name = Literal["check", "fit", "critique", "fleet", "horizon"]

_DRAFT = "https://json-schema.org/draft/2020-12/schema"
_FILE = {"type": "string", "description": "The file that was read, as it was given; stdin for -."}
_ERRORS = {
    "type": "array",
    "description": "What went wrong, file by file; axes without result among it.",
    "items": {
        "type": "object",
        "properties": {
            "file": _FILE,
            "message": {"type": "string", "description": "What is wrong, where, and what to do about it."},
        },
        "required": ["file", "message"],
        "additionalProperties": False,
    },
}


def schema(name: Name) -> dict[str, Any]:
    """JSON schema, draft 2020-12, of what `check`, `characterize` ("fit"), `critique`, … writes.

    "check": the document of `--json`. "fit": NAME.json, and the document of `--json`. "critique":
    NAME_critique.json, and the document of `--json`. "fleet": recordings/NAME.json.
    "horizon": the document of `--json`.
    """
    if name == "fleet":
        return _of_fleet()
    if name == "horizon":
        return _of_horizon()
    # A fit holds the check of its recording.
    path = files(__package__).joinpath(f"{'fit' if name == 'check' else name}.schema.json")
    document, plural = json.loads(path.read_text(encoding="utf-8")), f"{name}s"
    definitions = document.pop("$defs")
    if name == "check":
        document = definitions["check"]
        definitions = {"verdict": definitions["verdict"]}
    single = {key: value for key, value in document.items() if key not in ("$schema", "title")}
    properties = single["properties"]
    own = {key: value for key, value in properties.items() if key != "errors"}
    entry = {**single, "properties": {"file": _FILE, **own}, "required": ["file", *single["required"]]}
    entries = {
        "type": "array",
        "description": "One entry a file, without those that failed.",
        "items": entry,
    }
    bundle = _closed(
        f"What --json prints: the {plural} of all files, and the errors.",
        {"schema_version": properties["schema_version"], plural: entries, "errors": _ERRORS},
    )
    return {
        "$schema": _DRAFT,
        "title": f"allanjax {name}",
        "description": f"A {name}, as it is written to a file, or those that --json prints.",
        "if": {"required": [plural]},
        "then": {"$ref": "#/$defs/bundle"},
        "else": {"$ref": f"#/$defs/{name}"},
        "$defs": {name: single, "bundle": bundle, **definitions},
    }


def _closed(description: str, properties: dict[str, Any]) -> dict[str, Any]:
    """Schema of an object that has these properties and no others."""
    return {
        "type": "object",
        "description": description,
        "properties": properties,
        "required": list(properties),
        "additionalProperties": False,
    }


def _of_horizon() -> dict[str, Any]:
    """Schema of the numbers for a filter between its corrections."""
    text, number = {"type": "string"}, {"type": "number"}
    maybe = {"type": ["number", "null"]}
    interval = {"type": "array", "items": maybe, "minItems": 2, "maxItems": 2}
    numbers = {
        "unit": text,
        "value": number,
        "std": maybe,
        "interval_68": interval,
        "interval_95": interval,
        "upper_limit_95": maybe,
        "lower_limit_95": maybe,
    }
    estimate = _closed("In the unit for people, and in SI.", {**numbers, "si": _closed("In SI.", numbers)})
    pair = {"white": number, "walk": number}
    curve = {"type": "array", "items": number}
    curves = ("time", "error", "bound", "raw_error", "raw_prediction")
    axis = _closed(
        "An axis.",
        {
            "name": text,
            "sensor": {"enum": ["gyro", "accel"]},
            "white": {"description": "N of the filter.", **estimate},
            "walk": {"description": "K of the filter, or what drives its Gauss–Markov process.", **estimate},
            "correlation_time": {"description": "Null of a walk.", "anyOf": [estimate, {"type": "null"}]},
            "bias_std_si": {"description": "Standard deviation of the process; null of a walk.", **maybe},
            "mismatch": {"description": "Largest ratio of predicted and true error.", **number},
            "bounding_si": _closed(
                "The numbers that bound the error.", {**pair, "correlation_time": maybe, "bias_std": maybe}
            ),
            "raw_si": _closed("N and K of the fit; zero if it has none.", pair),
            "inflation": _closed(
                "Factors over the raw ones; null if there is none.", {"white": maybe, "walk": maybe}
            ),
            "raw_factor": {"description": "Error over what a filter with raw N, K predicts.", **maybe},
            "shares": {
                "description": "Shares of the terms in the variance at the horizon.",
                "type": "object",
                "additionalProperties": number,
            },
            "sets": {"description": "Likely sets of terms that were averaged.", "type": "integer"},
            "curves_si": _closed(
                "Standard deviations of the error by time [s].", dict.fromkeys(curves, curve)
            ),
        },
    )
    document = {
        "schema_version": {"const": HORIZON_VERSION},
        "recording": _closed("The recording.", {"name": text}),
        "horizon_s": {"description": "Time between corrections.", **number},
        "process": {"enum": ["walk", "markov"]},
        "probability": {"description": "That of the bounds.", **number},
        "axes": {"type": "array", "items": axis},
        "notes": {
            "description": "Of a data sheet, what was assumed and not given.",
            "type": "array",
            "items": text,
        },
    }
    about = "White noise and process of the bias for filters that are corrected every `horizon_s`."
    return {"$schema": _DRAFT, "title": "allanjax horizon", **_closed(about, document)}


def _of_fleet() -> dict[str, Any]:
    """Schema of a recording of a fleet."""
    fit = schema("fit")
    options = {
        "type": "object",
        "description": "How it was read and fitted; numbers as text.",
        "required": [option.name for option in fields(FitOptions)],
    }
    key = _closed(
        "What the result depends on: a later run takes it if all of this is the same.",
        {
            "path": {"type": "string", "description": "The file."},
            "size": {"type": "integer", "description": "Its size in bytes."},
            "modified_ns": {"type": "integer", "description": "When it was last changed, in UNIX ns."},
            "options": options,
            "allanjax_version": {"type": "string", "description": "Version of allanjax that fitted it."},
        },
    )
    return {
        "$schema": _DRAFT,
        "title": "allanjax recording of a fleet",
        **_closed(
            "One recording of a fleet, as recordings/NAME.json holds it.",
            {"key": key, "fit": {"$ref": "#/$defs/fit"}},
        ),
        "$defs": {name: part for name, part in fit["$defs"].items() if name != "bundle"},
    }

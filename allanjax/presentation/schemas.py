"""JSON schemas of files and of `--json`: fits, critiques, horizons, the recordings of a fleet."""

import json
from dataclasses import fields
from importlib.resources import files
from typing import Any, Literal

from allanjax.fleet.options import FitOptions

Name = Literal["check", "fit", "critique", "fleet", "horizon"]

_DRAFT = "https://json-schema.org/draft/2020-12/schema"
_FILE = {"type": "string", "description": "The file as given on the command line; stdin for -."}
_ERRORS = {
    "type": "array",
    "description": "Errors by file, including axes without a result.",
    "items": {
        "type": "object",
        "properties": {
            "file": _FILE,
            "message": {"type": "string", "description": "What is wrong, where, and what to do."},
        },
        "required": ["file", "message"],
        "additionalProperties": False,
    },
}


def schema(name: Name) -> dict[str, Any]:
    """JSON schema, draft 2020-12, of the output of `check`, `characterize` ("fit"), `critique`, ….

    "check" and "horizon": the output of `--json`. "fit": NAME.json, and the output of `--json`. "critique":
    NAME_critique.json, and the output of `--json`. "fleet": recordings/NAME.json.
    """
    if name == "fleet":
        return _of_fleet()
    # A fit holds the check of its recording.
    path = files(__package__).joinpath(f"{'fit' if name == 'check' else name}.schema.json")
    document: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    if name == "horizon":
        return document
    plural = f"{name}s"
    definitions = document.pop("$defs")
    if name == "check":
        document = definitions["check"]
        definitions = {"verdict": definitions["verdict"]}
    single = {key: value for key, value in document.items() if key not in ("$schema", "title")}
    properties = single["properties"]
    own = {key: value for key, value in properties.items() if key != "errors"}
    entry = {**single, "properties": {"file": _FILE, **own}, "required": ["file", *single["required"]]}
    about = "One entry per file, without those that failed."
    entries = {"type": "array", "description": about, "items": entry}
    bundle = _closed(
        f"Output of --json: the {plural} of all files, and the errors.",
        {"schema_version": properties["schema_version"], plural: entries, "errors": _ERRORS},
    )
    return {
        "$schema": _DRAFT,
        "title": f"allanjax {name}",
        "description": f"A {name} as written to a file, or the output of --json.",
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


def _of_fleet() -> dict[str, Any]:
    """Schema of a recording of a fleet."""
    fit = schema("fit")
    options = {
        "type": "object",
        "description": "Options of reading and fitting; numbers as text.",
        "required": [option.name for option in fields(FitOptions)],
    }
    key = _closed(
        "What the result depends on: a later run reuses it if all of this is the same.",
        {
            "path": {"type": "string", "description": "The file."},
            "size": {"type": "integer", "description": "Its size in bytes."},
            "modified_ns": {"type": "integer", "description": "Time of its last change, in UNIX ns."},
            "options": options,
            "allanjax_version": {"type": "string", "description": "Version of allanjax that made the fit."},
        },
    )
    fits = fit["$defs"]["bundle"]["properties"]["fits"] | {"description": "One per sensor, if rates differ."}
    properties = {"key": key, "fit": {"$ref": "#/$defs/fit"}, "fits": fits}
    return {
        "$schema": _DRAFT,
        "title": "allanjax recording of a fleet",
        **_closed("One recording of a fleet, as in recordings/NAME.json.", properties),
        "required": ["key"],
        "oneOf": [{"required": ["fit"]}, {"required": ["fits"]}],
        "$defs": {name: part for name, part in fit["$defs"].items() if name != "bundle"},
    }

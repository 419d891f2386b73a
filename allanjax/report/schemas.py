"""JSON schemas of files and of `--json`: fits, critiques, the recordings of a fleet."""

import json
from dataclasses import fields
from importlib.resources import files
from typing import Any, Literal

from allanjax.fleet.options import FitOptions

Name = Literal["check", "fit", "critique", "fleet"]

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
    """JSON schema, draft 2020-12, of what `check`, `characterize` ("fit"), `critique` or `fleet` writes.

    "check": the document of `--json`. "fit": NAME.json, and the document of `--json`. "critique":
    NAME_critique.json, and the document of `--json`. "fleet": recordings/NAME.json.
    """
    if name == "fleet":
        return _of_fleet()
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

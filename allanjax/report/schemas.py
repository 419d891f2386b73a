"""JSON schemas of files and of `--json`: fits, critiques, the recordings of a fleet."""

import json
from dataclasses import fields
from importlib.resources import files
from typing import Any, Literal

from allanjax.fleet.options import FitOptions

Name = Literal["fit", "critique", "fleet"]

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
    """JSON schema, draft 2020-12, of what `characterize` ("fit"), `critique` or `fleet` writes.

    "fit": NAME.json, and the document of `--json`. "critique": NAME_critique.json, and the document of
    `--json`. "fleet": recordings/NAME.json.
    """
    if name == "fleet":
        return _of_fleet()
    document, plural = _document(name), f"{name}s"
    definitions = document.pop("$defs")
    single = {key: value for key, value in document.items() if key not in ("$schema", "title")}
    return {
        "$schema": _DRAFT,
        "title": f"allanjax {name}",
        "description": f"A {name}, as it is written to a file, or those that --json prints.",
        "if": {"required": [plural]},
        "then": {"$ref": "#/$defs/bundle"},
        "else": {"$ref": f"#/$defs/{name}"},
        "$defs": {
            name: single,
            "bundle": _bundle(plural, single),
            **definitions,
        },
    }


def _bundle(plural: str, single: dict[str, Any]) -> dict[str, Any]:
    """Schema of several documents, each with its file, and of errors."""
    properties = {key: value for key, value in single["properties"].items() if key != "errors"}
    entry = {
        **single,
        "properties": {"file": _FILE, **properties},
        "required": ["file", *single["required"]],
    }
    return {
        "type": "object",
        "description": f"What --json prints: the {plural} of all files, and the errors.",
        "properties": {
            "schema_version": single["properties"]["schema_version"],
            plural: {
                "type": "array",
                "description": "One entry a file, without those that failed.",
                "items": entry,
            },
            "errors": _ERRORS,
        },
        "required": ["schema_version", plural, "errors"],
        "additionalProperties": False,
    }


def _of_fleet() -> dict[str, Any]:
    """Schema of a recording of a fleet."""
    fit = schema("fit")
    key = {
        "type": "object",
        "description": "What the result depends on: a later run takes it if all of this is the same.",
        "properties": {
            "path": {"type": "string", "description": "The file."},
            "size": {"type": "integer", "description": "Its size in bytes."},
            "modified_ns": {"type": "integer", "description": "When it was last changed, in UNIX ns."},
            "options": {
                "type": "object",
                "description": "How it was read and fitted; numbers as text.",
                "required": [option.name for option in fields(FitOptions)],
            },
            "allanjax_version": {"type": "string", "description": "Version of allanjax that fitted it."},
        },
        "additionalProperties": False,
    }
    key["required"] = list(key["properties"])  # type: ignore[call-overload]
    return {
        "$schema": _DRAFT,
        "title": "allanjax recording of a fleet",
        "description": "One recording of a fleet, as recordings/NAME.json holds it.",
        "type": "object",
        "properties": {"key": key, "fit": {"$ref": "#/$defs/fit"}},
        "required": ["key", "fit"],
        "additionalProperties": False,
        "$defs": {name: part for name, part in fit["$defs"].items() if name != "bundle"},
    }


def _document(name: str) -> dict[str, Any]:
    return json.loads(files(__package__).joinpath(f"{name}.schema.json").read_text(encoding="utf-8"))

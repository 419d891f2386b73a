"""JSON schemas of files and of `--json`: fits, critiques, comparisons, the recordings of a fleet, …."""

import functools
import json
import re
import tomllib
from collections.abc import Mapping
from dataclasses import fields
from importlib.resources import files
from typing import Any, Literal

from allanjax.fleet.options import FitOptions

Name = Literal[
    "check",
    "fit",
    "characterize",
    "watch",
    "critique",
    "report",
    "compare",
    "spec",
    "fleet",
    "repeat",
    "export",
    "horizon",
    "navigate",
    "statespace",
    "kalman",
    "calibrate",
    "simulate",
    "convert",
    "demo",
]
# Commands whose output is that of others.
_SAME = {"characterize": "fit", "watch": "fit"}
# Commands that print one document per file, or all of them in a list.
_PER_FILE = ("check", "fit", "critique")

_DRAFT = "https://json-schema.org/draft/2020-12/schema"
# A type of `schemas.toml`: its name, a bound of a number, and what makes lists of it.
_TYPE = re.compile(r"([\w.]+)(?:(>=?)(\d+))?((?:\?|\{\}|\[\w*\+?\])*)")
_LITERAL = re.compile(r'"[^"]*"|\d+|null')
_PLAIN = frozenset({"string", "number", "integer", "boolean", "object"})
_REFERENCE = re.compile(r'"#/\$defs/([\w.]+)"')


def schema(name: Name) -> dict[str, Any]:
    """JSON schema, draft 2020-12, of what a command writes: the output of `--json`, and files.

    "fit" is the output of `characterize` and `watch`, and NAME.json; "critique" is also NAME_critique.json,
    "repeat" repeat.json, and "calibrate" calibration.json. "fleet" is recordings/NAME.json.
    """
    of = _SAME.get(name, name)
    root: dict[str, Any] = {"$ref": f"#/$defs/{of}.{of}"}
    if of in _PER_FILE:
        root = {
            "description": f"A {of} as written to a file, or the output of --json.",
            "if": {"required": [f"{of}s"]},
            "then": {"$ref": f"#/$defs/{of}.bundle"},
            "else": root,
        }
    definitions: dict[str, Any] = {}
    pending = _REFERENCE.findall(json.dumps(root))
    while pending:
        found = pending.pop()
        if found not in definitions:
            group, _, table = found.partition(".")
            definitions[found] = _definition(_tables()[group][table], group)
            pending += _REFERENCE.findall(json.dumps(definitions[found]))
    return {"$schema": _DRAFT, "title": f"allanjax {name}", **root, "$defs": definitions}


@functools.cache
def _tables() -> dict[str, dict[str, Any]]:
    """The tables of `schemas.toml` by their groups, and those that follow from others."""
    tables = tomllib.loads(files(__package__).joinpath("schemas.toml").read_text(encoding="utf-8"))
    for name in _PER_FILE:
        rows = {key: row for key, row in tables[name][name].items() if key != "errors?"}
        tables[name]["entry"] = {"file": tables["output"]["error"]["file"], **rows}
        tables[name]["bundle"] = {
            "about": f"Output of --json: the {name}s of all files, and the errors.",
            "schema_version": rows["schema_version"],
            f"{name}s": ["entry[]", "One entry per file, without those that failed."],
            "errors": ["output.error[]", "Errors by file, including axes without a result."],
        }
    tables["fleet"]["options"] = {option.name: ["any"] for option in fields(FitOptions)}
    return tables


def _definition(of: Mapping[str, Any] | list[str], group: str) -> dict[str, Any]:
    """Schema of a row, or of an object that has the properties of a table of a group and no others."""
    if isinstance(of, list):
        kind, *about = of
        return {**({"description": about[0]} if about else {}), **_type(kind, group)}
    rows = {key: row for key, row in of.items() if key != "about"}
    return {
        "type": "object",
        **({"description": of["about"]} if "about" in of else {}),
        "properties": {key.removesuffix("?"): _definition(row, group) for key, row in rows.items()},
        "required": [key for key in rows if not key.endswith("?")],
        "additionalProperties": False,
    }


def _type(words: str, group: str) -> dict[str, Any]:
    """Schema of a type as `schemas.toml` writes it in this group."""
    if words == "any":
        return {}
    either = words.split(" | ")
    if all(map(_LITERAL.fullmatch, either)):
        values = [json.loads(one) for one in either]
        return {"enum": values} if len(values) > 1 else {"const": values[0]}
    if len(either) > 1:
        return {"anyOf": [_type(one, group) for one in either]}
    match = _TYPE.fullmatch(words)
    assert match is not None, words
    name, bound, limit, more = match.groups()
    found: dict[str, Any] = {"type": name}
    if name not in _PLAIN:
        found = {"$ref": f"#/$defs/{name if '.' in name else f'{group}.{name}'}"}
    if bound:
        found["minimum" if bound == ">=" else "exclusiveMinimum"] = int(limit)
    for end in re.findall(r"\?|\{\}|\[.*?\]", more):
        if end == "?":
            null = {"type": "null"}
            found = found | {"type": [found["type"], "null"]} if "type" in found else {"anyOf": [found, null]}
        elif end == "{}":
            found = {"type": "object", "additionalProperties": found}
        else:
            limits = {"[1+]": {"minItems": 1}, "[2]": {"minItems": 2, "maxItems": 2}}
            found = {"type": "array", "items": found, **limits.get(end, {})}
    return found

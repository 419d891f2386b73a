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

Name = Literal["check", "fit", "critique", "fleet", "horizon", "compare", "navigate"]
# Commands with one document for all that they are given.
_SINGLE = ("horizon", "compare", "navigate")

_DRAFT = "https://json-schema.org/draft/2020-12/schema"
# A type of `schemas.toml`: its name, a bound of a number, and what makes lists of it.
_TYPE = re.compile(r"(\w+)(?:(>=?)(\d+))?((?:\?|\{\}|\[\w*\+?\])*)")
_LITERAL = re.compile(r'"[^"]*"|\d+|null')
_PLAIN = frozenset({"string", "number", "integer", "boolean", "object"})


def schema(name: Name) -> dict[str, Any]:
    """JSON schema, draft 2020-12, of the output of `check`, `characterize` ("fit"), `critique`, ….

    "fit": NAME.json, and the output of `--json`. "critique": NAME_critique.json, and the output of `--json`.
    "fleet": recordings/NAME.json. All others: the output of `--json`.
    """
    if name == "fleet":
        return _of_fleet()
    tables = _tables()[name]
    if name == "fit":
        # A fit holds the check of its recording.
        tables = _tables()["check"] | tables
    definitions = {key: _definition(of) for key, of in tables.items()}
    if name in _SINGLE:
        title = f"allanjax {name}"
        return {"$schema": _DRAFT, "title": title, **definitions.pop(name), "$defs": definitions}
    plural, entry = f"{name}s", {key: row for key, row in tables[name].items() if key != "errors?"}
    bundle = {
        "about": f"Output of --json: the {plural} of all files, and the errors.",
        "schema_version": entry["schema_version"],
        plural: ["entry[]", "One entry per file, without those that failed."],
        "errors": ["error[]", "Errors by file, including axes without a result."],
    }
    error = _tables()["output"]["error"]
    definitions |= {"entry": _definition({"file": error["file"], **entry}), "error": _definition(error)}
    return {
        "$schema": _DRAFT,
        "title": f"allanjax {name}",
        "description": f"A {name} as written to a file, or the output of --json.",
        "if": {"required": [plural]},
        "then": {"$ref": "#/$defs/bundle"},
        "else": {"$ref": f"#/$defs/{name}"},
        "$defs": definitions | {"bundle": _definition(bundle)},
    }


def _of_fleet() -> dict[str, Any]:
    """Schema of a recording of a fleet."""
    document = {
        "about": "One recording of a fleet, as in recordings/NAME.json.",
        "key": ["key"],
        "fit?": ["fit"],
        "fits?": ["entry[]", "One per sensor, if rates differ."],
    }
    definitions = schema("fit")["$defs"] | {
        "key": _definition(_tables()["fleet"]["key"]),
        "options": {"type": "object", "required": [option.name for option in fields(FitOptions)]},
    }
    return {
        "$schema": _DRAFT,
        "title": "allanjax recording of a fleet",
        **_definition(document),
        "oneOf": [{"required": ["fit"]}, {"required": ["fits"]}],
        "$defs": {key: of for key, of in definitions.items() if key not in ("bundle", "error")},
    }


@functools.cache
def _tables() -> dict[str, dict[str, Any]]:
    """The tables of `schemas.toml` by their groups."""
    return tomllib.loads(files(__package__).joinpath("schemas.toml").read_text(encoding="utf-8"))


def _definition(of: Mapping[str, Any] | list[str]) -> dict[str, Any]:
    """Schema of a row, or of an object that has the properties of a table and no others."""
    if isinstance(of, list):
        kind, *about = of
        return {**({"description": about[0]} if about else {}), **_type(kind)}
    rows = {key: row for key, row in of.items() if key != "about"}
    return {
        "type": "object",
        **({"description": of["about"]} if "about" in of else {}),
        "properties": {key.removesuffix("?"): _definition(row) for key, row in rows.items()},
        "required": [key for key in rows if not key.endswith("?")],
        "additionalProperties": False,
    }


def _type(words: str) -> dict[str, Any]:
    """Schema of a type as `schemas.toml` writes it."""
    either = words.split(" | ")
    if all(map(_LITERAL.fullmatch, either)):
        values = [json.loads(one) for one in either]
        return {"enum": values} if len(values) > 1 else {"const": values[0]}
    if len(either) > 1:
        return {"anyOf": [*map(_type, either)]}
    match = _TYPE.fullmatch(words)
    assert match is not None, words
    name, bound, limit, more = match.groups()
    found: dict[str, Any] = {"type": name} if name in _PLAIN else {"$ref": f"#/$defs/{name}"}
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

"""Values in targets' own files, by the names of their keys."""

from __future__ import annotations

import json
import re
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterator, Mapping, Sequence

from allanjax.base.errors import AllanjaxError
from allanjax.report.export.targets import Key, Syntax, Target

#: The values at a place of a file: names of the levels, and one number or several.
Found = tuple[tuple[str, ...], tuple[float, ...]]

_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_LINE = re.compile(r"(?P<indent> *)(?:- )?(?P<name>[^#\s:][^#]*?)\s*:(?:\s+(?P<rest>.*))?$")


def values_in(target: Target, text: str) -> dict[str, tuple[float, ...]]:
    """Numbers of a target's file by the names of its keys, those that are there.

    A key may stand deeper in the file than in the table, as below `ros__parameters`.

    Raises:
        AllanjaxError: the file is damaged, or a key is in it twice.
    """
    try:
        found = list(_READERS[target.syntax](target, text))
    except (ValueError, ET.ParseError) as error:
        raise AllanjaxError(f"not a file of {target.title}, or damaged: {error}") from error
    values: dict[str, tuple[float, ...]] = {}
    for key in target.noise_keys:
        path = _path(key)
        matching = [numbers for place, numbers in found if place[-len(path) :] == path]
        if len(set(matching)) > 1:
            raise AllanjaxError(
                f"{key.called} stands in it {len(matching)} times, with different values: leave one"
            )
        if matching:
            values[key.name] = matching[0]
    return values


def _path(key: Key) -> tuple[str, ...]:
    """Names of a key's levels, without the attributes of XML; of a line, all of it."""
    if "{}" in key.name:
        return (key.name,)
    return tuple(level.split()[0] for level in key.name.split("/"))


def _numbers(text: str) -> tuple[float, ...]:
    """A number, or a list of them in brackets; () for anything else."""
    text = text.partition("#")[0].strip()
    inner = text[1:-1] if text.startswith("[") and text.endswith("]") else text
    parts = [part.strip().strip("\"'") for part in inner.split(",")]
    return tuple(map(float, parts)) if all(re.fullmatch(_NUMBER, part) for part in parts) else ()


def _yaml(target: Target, text: str) -> Iterator[Found]:
    """Numbers of a file of YAML that has each key in a line of its own, as files of parameters have."""
    above: list[tuple[int, str]] = []
    for line in text.splitlines():
        if not (match := _LINE.fullmatch(line.rstrip())):
            continue
        indent, name = len(match["indent"]), match["name"].strip("\"'")
        above = [level for level in above if level[0] < indent]
        if numbers := _numbers(match["rest"] or ""):
            yield (*(level for _, level in above), name), numbers
        above.append((indent, name))


def _json(target: Target, text: str) -> Iterator[Found]:
    yield from _of_json((), json.loads(text))


def _of_json(path: tuple[str, ...], value: object) -> Iterator[Found]:
    if isinstance(value, dict):
        for name, inner in value.items():
            yield from _of_json((*path, name), inner)
    else:
        several = value if isinstance(value, list) else [value]
        numbers = [x for x in several if isinstance(x, int | float) and not isinstance(x, bool)]
        if numbers and len(numbers) == len(several):
            yield path, tuple(map(float, numbers))


def _xml(target: Target, text: str) -> Iterator[Found]:
    yield from _of_xml((), ET.fromstring(text))


def _of_xml(path: tuple[str, ...], element: ET.Element) -> Iterator[Found]:
    path = (*path, element.tag)
    if numbers := _numbers(element.text or ""):
        yield path, numbers
    for child in element:
        yield from _of_xml(path, child)


def _lines(target: Target, text: str) -> Iterator[Found]:
    for key in target.noise_keys:
        pattern = re.escape(key.name).replace(re.escape("{}"), r"(\S+)").replace(",", r"[,\s]+")
        for match in re.finditer(rf"^\s*{pattern}\s*$", text, re.M):
            if numbers := _numbers(match[1]):
                yield (key.name,), numbers


_READERS: Mapping[Syntax, Callable[[Target, str], Iterator[Found]]] = {
    "json": _json,
    "lines": _lines,
    "xml": _xml,
    "yaml": _yaml,
}


def by_axis(key: Key, numbers: Sequence[float]) -> dict[str, float]:
    """Values of a key by axis: of x, y and z, or "" for one that is of all.

    Raises:
        AllanjaxError: there are not as many as the key has.
    """
    if key.of == "matrix" and len(numbers) == 9:
        numbers = numbers[::4]
    if key.of in ("three", "matrix") and len(numbers) == 3:
        return dict(zip("xyz", numbers, strict=True))
    if len(numbers) != 1 or key.of in ("three", "matrix"):
        raise AllanjaxError(f"{key.called} has {len(numbers)} numbers, which is not what it takes")
    return {key.of if key.of in ("x", "y", "z") else "": numbers[0]}

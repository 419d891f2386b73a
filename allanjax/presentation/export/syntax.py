"""Files of values in the syntaxes of the targets: written with comments, in ASCII, and read."""

from __future__ import annotations

import dataclasses
import functools
import itertools
import json
import re
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

from allanjax.base.errors import AllanjaxError
from allanjax.base.tables import ERRORS, wrapped
from allanjax.presentation.export.targets import Key, Syntax, Target
from allanjax.record.units import NUMBER

_WIDTH = 110

Value = float | str | bool | tuple[float, ...]


@dataclasses.dataclass(frozen=True)
class Entry:
    """A line of a file: where it stands (see `Key.name`), its value, and comments.

    A value that the target refuses is commented out, with the reason.
    """

    name: str
    value: Value
    comments: tuple[str, ...] = ()
    refused: str = ""


def written(target: Target, head: Sequence[str], entries: Sequence[Entry]) -> str:
    """The text of a target's file: comments that are its head, and its entries with theirs."""
    # Comments before they are broken into lines, for some become longer.
    plain = [
        dataclasses.replace(e, comments=tuple(map(_ascii, e.comments)))
        for e in entries
        # Lines alone can be commented out one by one.
        if not e.refused or target.syntax == "lines"
    ]
    return _ascii(_WRITERS[target.syntax](target, [*map(_ascii, head)], plain))


def _ascii(text: str) -> str:
    return text.encode("ascii", ERRORS).decode("ascii")


def number(x: float) -> str:
    """A number with six digits and a point in it, without which some YAML readers take 1e-05 for a text."""
    mantissa, e, power = f"{x:.6g}".partition("e")
    return (mantissa if "." in mantissa else f"{mantissa}.0") + e + power


def _literal(value: Value) -> str:
    if isinstance(value, tuple):
        return f"[{', '.join(map(number, value))}]"
    if isinstance(value, bool):
        return str(value).lower()
    return number(value) if isinstance(value, float) else str(value)


def _comments(lines: Sequence[str], begin: str, indent: str = "") -> list[str]:
    """Comments, broken into lines that begin so."""
    first, other = f"{indent}{begin} ", f"{indent}{begin}   "
    return [part for line in lines for part in wrapped(line, _WIDTH, first, other).split("\n")]


def _lines(target: Target, head: Sequence[str], entries: Sequence[Entry]) -> str:
    rows = [*_comments(head, target.comment), "", *target.before]
    for entry in entries:
        rows += _comments(entry.comments, target.comment)
        begin = f"{target.comment} " * bool(entry.refused)
        rows.append(begin + entry.name.replace("{}", _literal(entry.value)))
    return "\n".join(rows) + "\n"


def _yaml(target: Target, head: Sequence[str], entries: Sequence[Entry]) -> str:
    rows = [*_comments(head, "#"), ""]
    opened: list[str] = []
    for entry in entries:
        *groups, name = entry.name.split("/")
        same = _common(opened, groups)
        for depth, group in enumerate(groups[same:], same):
            rows.append(f"{'  ' * depth}{group}:")
        opened = groups
        indent = "  " * len(groups)
        rows += _comments(entry.comments, "#", indent)
        rows.append(f"{indent}{name}: {_literal(entry.value)}")
    return "\n".join(rows) + "\n"


def _xml(target: Target, head: Sequence[str], entries: Sequence[Entry]) -> str:
    rows = _xml_comments(head)
    opened: list[str] = []
    for entry in [*entries, None]:
        *groups, name = entry.name.split("/") if entry else [""]
        same = _common(opened, groups)
        for depth in range(len(opened) - 1, same - 1, -1):
            rows.append(f"{'  ' * depth}</{opened[depth].split()[0]}>")
        for depth, group in enumerate(groups[same:], same):
            rows.append(f"{'  ' * depth}<{group}>")
        opened = groups
        if entry:
            indent = "  " * len(groups)
            rows += _xml_comments(entry.comments, indent)
            rows.append(f"{indent}<{name}>{_literal(entry.value)}</{name}>")
    return "\n".join(rows) + "\n"


def _xml_comments(lines: Sequence[str], indent: str = "") -> list[str]:
    """Comments, in which XML has no two dashes one after the other."""
    return [f"{row} -->" for row in _comments([re.sub("-(?=-)", "- ", x) for x in lines], "<!--", indent)]


def _json(target: Target, head: Sequence[str], entries: Sequence[Entry]) -> str:
    """JSON, which has no comments: these are texts in "_comment", beside the values."""
    root: dict[str, Any] = {}
    comments = list(head)
    for entry in entries:
        comments += [f"{entry.name.rpartition('/')[2]}: {comment}" for comment in entry.comments]
    values = [(entry.name, _plain(entry.value)) for entry in entries]
    for place, value in [*values, (f"{target.comment_at}/_comment", comments)]:
        *groups, name = place.split("/")
        functools.reduce(lambda level, group: level.setdefault(group, {}), groups, root)[name] = value
    return json.dumps(root, indent=2) + "\n"


def _common(one: Sequence[str], other: Sequence[str]) -> int:
    """How many levels two paths share."""
    pairs = zip(one, other, strict=False)
    return len([*itertools.takewhile(lambda pair: pair[0] == pair[1], pairs)])


def _plain(value: Value) -> Any:
    """A value with as many digits as elsewhere."""
    if isinstance(value, tuple):
        return [float(number(x)) for x in value]
    return float(number(value)) if isinstance(value, float) else value


_WRITERS: Mapping[Syntax, Callable[[Target, Sequence[str], Sequence[Entry]], str]] = {
    "json": _json,
    "lines": _lines,
    "xml": _xml,
    "yaml": _yaml,
}


#: The values at a place of a file: names of the levels, and one number or several.
Found = tuple[tuple[str, ...], tuple[float, ...]]

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
            raise AllanjaxError(f"{key.called} occurs {len(matching)} times with different values; keep one")
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
    return tuple(map(float, parts)) if all(re.fullmatch(NUMBER, part) for part in parts) else ()


def _read_yaml(target: Target, text: str) -> Iterator[Found]:
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


def _of_json(path: tuple[str, ...], value: object) -> Iterator[Found]:
    if isinstance(value, dict):
        for name, inner in value.items():
            yield from _of_json((*path, name), inner)
    else:
        several = value if isinstance(value, list) else [value]
        numbers = [x for x in several if isinstance(x, int | float) and not isinstance(x, bool)]
        if numbers and len(numbers) == len(several):
            yield path, tuple(map(float, numbers))


def _of_xml(path: tuple[str, ...], element: ET.Element) -> Iterator[Found]:
    path = (*path, element.tag)
    if numbers := _numbers(element.text or ""):
        yield path, numbers
    for child in element:
        yield from _of_xml(path, child)


def _read_lines(target: Target, text: str) -> Iterator[Found]:
    for key in target.noise_keys:
        pattern = re.escape(key.name).replace(re.escape("{}"), r"(\S+)").replace(",", r"[,\s]+")
        for match in re.finditer(rf"^\s*{pattern}\s*$", text, re.M):
            if numbers := _numbers(match[1]):
                yield (key.name,), numbers


_READERS: Mapping[Syntax, Callable[[Target, str], Iterator[Found]]] = {
    "json": lambda _, text: _of_json((), json.loads(text)),
    "lines": _read_lines,
    "xml": lambda _, text: _of_xml((), ET.fromstring(text)),
    "yaml": _read_yaml,
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
        most = {"three": "3", "matrix": "3 or 9"}.get(key.of, "1")
        raise AllanjaxError(f"{key.called} has {len(numbers)} numbers instead of {most}")
    return {key.of if key.of in ("x", "y", "z") else "": numbers[0]}

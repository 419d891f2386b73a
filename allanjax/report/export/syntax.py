"""Files of values with comments, in the syntaxes of the targets; all ASCII, which every parser reads."""

from __future__ import annotations

import dataclasses
import json
import re
import textwrap
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from allanjax.base.plain import ERRORS
from allanjax.report.export.targets import Syntax, Target

_WIDTH = 110

Value = float | str | bool | tuple[float, ...]


@dataclasses.dataclass(frozen=True)
class Entry:
    """A line of a file: where it stands (see `Key.name`), its value, and comments."""

    name: str
    value: Value
    comments: tuple[str, ...] = ()


def written(target: Target, head: Sequence[str], entries: Sequence[Entry]) -> str:
    """The text of a target's file: comments that are its head, and its entries with theirs."""
    # Comments before they are broken into lines, for some become longer.
    plain = [dataclasses.replace(e, comments=tuple(map(_ascii, e.comments))) for e in entries]
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
    return [
        part
        for line in lines
        for part in textwrap.wrap(
            line, _WIDTH, initial_indent=first, subsequent_indent=other, break_on_hyphens=False
        )
    ]


def _lines(target: Target, head: Sequence[str], entries: Sequence[Entry]) -> str:
    rows = [*_comments(head, target.comment), "", *target.before]
    for entry in entries:
        rows += _comments(entry.comments, target.comment)
        rows.append(entry.name.replace("{}", _literal(entry.value)))
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
    told = list(head)
    for entry in entries:
        *groups, name = entry.name.split("/")
        _below(root, groups)[name] = _plain(entry.value)
        told += [f"{name}: {comment}" for comment in entry.comments]
    _below(root, target.comment_at.split("/"))["_comment"] = told
    return json.dumps(root, indent=2) + "\n"


def _below(root: dict[str, Any], groups: Sequence[str]) -> dict[str, Any]:
    for group in groups:
        root = root.setdefault(group, {})
    return root


def _plain(value: Value) -> Any:
    """A value with as many digits as elsewhere."""
    if isinstance(value, tuple):
        return [float(number(x)) for x in value]
    return float(number(value)) if isinstance(value, float) else value


def _common(one: Sequence[str], other: Sequence[str]) -> int:
    """How many levels two paths share."""
    same = 0
    for a, b in zip(one, other, strict=False):
        if a != b:
            break
        same += 1
    return same


_WRITERS: Mapping[Syntax, Callable[[Target, Sequence[str], Sequence[Entry]], str]] = {
    "json": _json,
    "lines": _lines,
    "xml": _xml,
    "yaml": _yaml,
}

"""Groups of a fleet's recordings, as its user names them: grades, types, batches."""

from __future__ import annotations

import csv
import os
import re
from collections import Counter
from collections.abc import Callable, Mapping
from pathlib import Path

from allanjax.base.errors import AllanjaxError

Groups = str | os.PathLike[str] | Mapping[str, str] | Callable[[Path], str]
"""Pattern, CSV file, mapping or function that gives each recording its group; see `group_names`."""

# Recordings that a message names at most.
_NAMED = 3
# Text that is the path of a CSV file rather than a pattern.
_PLAIN_PATH = re.compile(r"[\w\-./\\: ]+\.csv", re.ASCII)


def group_names(group: Groups | None, recordings: Mapping[str, Path]) -> dict[str, str]:
    """Group of each recording.

    Args:
        group: a regular expression that is searched in the given path, the recording's name and the whole
            path, e.g. `logs/(\\w+)/`. The group's name is the match of its parentheses, or the whole match
            without parentheses. Or a CSV file with the columns file (or recording) and group, a mapping from
            files (or names) to groups, or a function of the path. None: no groups.
        recordings: the files by the recordings' names.

    Returns:
        Group by name; "" for all if there are no groups.

    Raises:
        AllanjaxError: an invalid pattern; a CSV file without these columns; a recording without a group, or
            with two.
    """
    if group is None:
        return dict.fromkeys(recordings, "")
    if callable(group):
        found = {name: str(group(path)) for name, path in recordings.items()}
        remedy = "the function in group= must return a name for each recording"
    elif isinstance(group, Mapping):
        found = _looked_up(list(group.items()), recordings, Path())
        remedy = "add them to the mapping in group= by path, file name or recording name"
    elif Path(group).is_file():
        found = _looked_up(_pairs_of(Path(group)), recordings, Path(group).parent)
        remedy = f"add them to {group} by path, file name or recording name"
    elif _PLAIN_PATH.fullmatch(os.fspath(group)):
        raise AllanjaxError(f"group= (--group) {os.fspath(group)!r}: no such file; check the path")
    else:
        found = _matched(os.fspath(group), recordings)
        remedy = f"the pattern {os.fspath(group)!r} matches neither path nor name; change group= (--group)"
    without = [path for name, path in recordings.items() if not found.get(name)]
    if without:
        named = ", ".join(map(str, without[:_NAMED])) + (" ..." if len(without) > _NAMED else "")
        raise AllanjaxError(
            f"{len(without)} of {len(recordings)} recordings have no group ({named}); {remedy}"
        )
    return found


def _matched(pattern: str, recordings: Mapping[str, Path]) -> dict[str, str]:
    """Groups of the recordings that a regular expression matches."""
    try:
        expression = re.compile(pattern)
    except re.error as error:
        raise AllanjaxError(
            f"group= (--group) {pattern!r} is neither a file nor a regular expression ({error}); use e.g. "
            r"'logs/(\w+)/', with the group's name in parentheses"
        ) from error
    groups = {}
    for name, path in recordings.items():
        texts = (path.as_posix(), name, path.resolve().as_posix())
        found = next((match for text in texts if (match := expression.search(text))), None)
        if found is not None:
            groups[name] = " ".join(part for part in found.groups() if part) or found.group()
    return groups


def _pairs_of(path: Path) -> list[tuple[str, str]]:
    """File and group of each line of a CSV file."""
    try:
        with path.open(newline="", encoding="utf-8-sig") as stream:
            lines = list(csv.DictReader(stream, skipinitialspace=True))
            columns = [name.strip() for name in lines[0] if name] if lines else []
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise AllanjaxError(f"{path}: not a readable CSV file of groups: {error}") from error
    key = next((name for name in ("file", "recording") if name in columns), None)
    if key is None or "group" not in columns:
        raise AllanjaxError(
            f"{path}: the first line must name the columns file (or recording) and group, not "
            f"{', '.join(columns) or 'nothing'}"
        )
    texts = [{(name or "").strip(): value for name, value in line.items()} for line in lines]
    return [((line[key] or "").strip(), (line["group"] or "").strip()) for line in texts]


def _looked_up(pairs: list[tuple[str, str]], recordings: Mapping[str, Path], folder: Path) -> dict[str, str]:
    """Groups of the recordings that pairs name, by path (from here or from the folder), file or name."""
    shared = Counter(path.name for path in recordings.values())
    names: dict[str, str] = {}
    for name, path in recordings.items():
        if shared[path.name] == 1:
            names[path.name] = name
        names |= {name: name, str(path.resolve()): name}
    groups: dict[str, str] = {}
    for text, group in pairs:
        texts = (str(text), str(Path(text).resolve()), str((folder / text).resolve()))
        found = next((names[key] for key in texts if key in names), None)
        if found is None:
            continue
        if groups.setdefault(found, str(group)) != str(group):
            raise AllanjaxError(
                f"{recordings[found]}: two groups, {groups[found]!r} and {str(group)!r}; remove one"
            )
    return groups

"""Files of a fleet: its recordings, their names and groups, and the stored fits."""

from __future__ import annotations

import csv
import glob
import hashlib
import json
import os
import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

from allanjax.base.errors import AllanjaxError
from allanjax.base.wording import harmless
from allanjax.fleet.options import FitOptions
from allanjax.inspection.facts import listed
from allanjax.record.io.formats import is_bag, name_of, storable

Names = str | os.PathLike[str] | Mapping[str, str] | Callable[[Path], str]
"""Pattern, CSV file, mapping or function that gives each recording its group or unit; see `names_by`."""

#: All that a stored fit depends on.
Key = dict[str, Any]

# Text that is the path of a CSV file rather than a pattern.
_PLAIN_PATH = re.compile(r"[\w\-./\\: ]+\.csv", re.ASCII)


def matching_files(
    files: str | os.PathLike[str] | Sequence[str | os.PathLike[str]], out: Path
) -> tuple[Path, ...]:
    """The files that paths and patterns match, each once, without the results below `out`."""
    found: dict[Path, Path] = {}
    for pattern in [files] if isinstance(files, str | os.PathLike) else files:
        text = os.fspath(pattern)
        if not glob.has_magic(text) or os.path.exists(text):
            matches = [Path(text)]
        else:
            names = map(Path, sorted(glob.glob(text, recursive=True)))
            matches = [
                path
                for path in names
                if (path.is_file() or is_bag(path)) and _real(out) not in _real(path).parents
            ]
            # The files of a bag are not recordings of their own beside it.
            bags = {path for path in matches if path.is_dir()}
            matches = [path for path in matches if path.parent not in bags]
        if not matches:
            raise AllanjaxError(
                f"no file matches {text!r}; check the pattern and the folder in which it starts"
            )
        for path in matches:
            found.setdefault(_real(path), path)
    if not found:
        raise AllanjaxError("no recordings given; pass files or patterns such as 'logs/*.parquet'")
    return tuple(found.values())


def recording_names(paths: Sequence[Path]) -> list[str]:
    """Name of each recording: its file's without suffix, made unique.

    The suffix is added if the folder has another file of that name, and as many folders as are needed to
    make it unique, e.g. `unit_07_imu`.
    """
    stems = [name_of(path) for path in paths]
    # Some file systems ignore case.
    places = [
        str(path.absolute().with_name(stem)).casefold() for path, stem in zip(paths, stems, strict=True)
    ]
    shared = Counter(places)
    tails = [
        (*path.absolute().parts[1:-1], stem if shared[place] == 1 else path.name)
        for path, stem, place in zip(paths, stems, places, strict=True)
    ]
    names = [storable(tail[-1]) for tail in tails]
    for depth in range(2, max(map(len, tails)) + 1):
        count = Counter(name.casefold() for name in names)
        if len(count) == len(names):
            break
        for k, tail in enumerate(tails):
            if count[names[k].casefold()] > 1:
                names[k] = storable("_".join(tail[-depth:]))
    return names


def names_by(how: Names, recordings: Mapping[str, Path], of: str) -> dict[str, str]:
    """Group (or unit) of each recording, by the recording's name.

    Args:
        how: a regular expression that is searched in the given path, the recording's name and the whole
            path, e.g. `logs/(\\w+)/`. The group's name is the match of its parentheses, or the whole match
            without parentheses. Or a CSV file with the columns file (or recording) and group, a mapping from
            files (or names) to groups, or a function of the path.
        recordings: the files by the recordings' names.
        of: "group" or "unit": the option, and the column of a CSV file.

    Raises:
        AllanjaxError: an invalid pattern; a CSV file without these columns; a recording without a group, or
            with two.
    """
    option = f"{of}= (--{of})"
    if callable(how):
        found = {name: str(how(path)) for name, path in recordings.items()}
        remedy = f"the function in {of}= must return a name for each recording"
    elif isinstance(how, Mapping):
        found = _looked_up(list(how.items()), recordings, Path(), of)
        remedy = f"add them to the mapping in {of}= by path, file name or recording name"
    elif Path(how).is_file():
        found = _looked_up(_pairs_of(Path(how), of), recordings, Path(how).parent, of)
        remedy = f"add them to {how} by path, file name or recording name"
    elif _PLAIN_PATH.fullmatch(os.fspath(how)):
        raise AllanjaxError(f"{option} {os.fspath(how)!r}: no such file; check the path")
    else:
        found = _matched(os.fspath(how), recordings, option)
        remedy = f"the pattern {os.fspath(how)!r} matches neither path nor name; change {option}"
    without = [path for name, path in recordings.items() if not found.get(name)]
    if without:
        named = listed(list(map(str, without)))
        raise AllanjaxError(
            f"{len(without)} of {len(recordings)} recordings have no {of} ({named}); {remedy}"
        )
    return found


def _matched(pattern: str, recordings: Mapping[str, Path], option: str) -> dict[str, str]:
    """Names of the recordings that a regular expression matches."""
    try:
        expression = re.compile(pattern)
    except re.error as error:
        raise AllanjaxError(
            f"{option} {pattern!r} is neither a file nor a regular expression ({error}); use e.g. "
            r"'logs/(\w+)/', with the name in parentheses"
        ) from error
    groups = {}
    for name, path in recordings.items():
        texts = (path.as_posix(), name, _real(path).as_posix())
        found = next((match for text in texts if (match := expression.search(text))), None)
        if found is not None:
            groups[name] = " ".join(part for part in found.groups() if part) or found.group()
    return groups


def _pairs_of(path: Path, of: str) -> list[tuple[str, str]]:
    """File and group (or unit) of each line of a CSV file."""
    try:
        with path.open(newline="", encoding="utf-8-sig") as stream:
            lines = list(csv.DictReader(stream, skipinitialspace=True))
            columns = [name.strip() for name in lines[0] if name] if lines else []
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise AllanjaxError(f"{path}: not a readable CSV file of {of}s: {error}") from error
    key = next((name for name in ("file", "recording") if name in columns), None)
    if key is None or of not in columns:
        raise AllanjaxError(
            f"{path}: the first line must name the columns file (or recording) and {of}, not "
            f"{', '.join(columns) or 'nothing'}"
        )
    texts = [{(name or "").strip(): value for name, value in line.items()} for line in lines]
    return [((line[key] or "").strip(), (line[of] or "").strip()) for line in texts]


def _looked_up(
    pairs: list[tuple[str, str]], recordings: Mapping[str, Path], folder: Path, of: str
) -> dict[str, str]:
    """Groups or units of the recordings that pairs name, by path (from here or the folder), file, name."""
    shared = Counter(path.name for path in recordings.values())
    names: dict[str, str] = {}
    for name, path in recordings.items():
        if shared[path.name] == 1:
            names[path.name] = name
        names |= {name: name, str(_real(path)): name}
    groups: dict[str, str] = {}
    for text, group in pairs:
        texts = (str(text), str(_real(Path(text))), str(_real(folder / text)))
        found = next((names[key] for key in texts if key in names), None)
        if found is None:
            continue
        if groups.setdefault(found, str(group)) != str(group):
            raise AllanjaxError(
                f"{recordings[found]}: two {of}s, {groups[found]!r} and {str(group)!r}; remove one"
            )
    return groups


def _real(path: Path) -> Path:
    """The path without symbolic links, as far as they lead somewhere."""
    return Path(os.path.realpath(path))


def address(path: Path) -> str:
    """The whole path as text that can be written, whatever bytes it has."""
    return harmless(str(_real(path)))


def key_of(path: Path, options: FitOptions, piece: int) -> Key | None:
    """Key of a result: all that it depends on; None if there is no such file."""
    try:
        status = [part.stat() for part in (path.iterdir() if is_bag(path) else (path,))]
    except OSError:
        return None
    return {
        "path": address(path),
        "size": sum(part.st_size for part in status),
        "modified_ns": max(part.st_mtime_ns for part in status),
        "options": options.to_dict(),
        "piece": piece,
        "allanjax_version": version("allanjax"),
    }


def earlier(
    folder: Path, recordings: Mapping[str, Path], keys: Mapping[str, Key | None]
) -> tuple[list[str], list[Path]]:
    """Names of the recordings whose fits a folder has, and files of other recordings whose fits it has.

    Names are unique within one run only: stored fits are renamed to their new names, and those of other
    recordings make way for them.
    """
    paths = {name: address(path) for name, path in recordings.items()}
    found = {path.stem: document["key"] for path in folder.glob("*.json") if (document := _document(path))}
    names = {}
    for name, key in found.items():
        at = name
        if paths.get(name, key["path"]) != key["path"]:
            at = f"{name}-{hashlib.sha256(key['path'].encode()).hexdigest()[:8]}"
            _file(folder, name).replace(_file(folder, at))
        names[_text(key)] = at
    done = [name for name, key in keys.items() if key is not None and _text(key) in names]
    for name in done:
        _file(folder, names[_text(keys[name])]).replace(_file(folder, name))
    left_out = {key["path"] for key in found.values()} - set(paths.values())
    return done, [Path(path) for path in sorted(left_out)]


def stored(folder: Path, name: str) -> list[dict[str, Any]]:
    """Stored fits of the recording of this name: one, or one per sensor."""
    return _fits(json.loads(_file(folder, name).read_text(encoding="utf-8")))


def store(folder: Path, name: str, key: Key | None, fits: Sequence[dict[str, Any]]) -> None:
    """Store fits as a whole or not at all: they are written to another file, which is renamed."""
    sensors = [{"file": f"{name} ({fit['axes'][0]['sensor']})", **fit} for fit in fits]
    document = {"key": key} | ({"fit": fits[0]} if len(fits) == 1 else {"fits": sensors})
    path, draft = _file(folder, name), folder / f".{name}.{os.getpid()}"
    draft.write_text(json.dumps(document, ensure_ascii=False, allow_nan=False) + "\n", encoding="utf-8")
    draft.replace(path)


def _document(path: Path) -> dict[str, Any] | None:
    """Key and fit of a recording; None if the file holds something else."""
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
        has_axes = all(fit["axes"] for fit in _fits(document))
        return document if isinstance(document["key"]["path"], str) and has_axes else None
    except (OSError, ValueError, TypeError, KeyError, RecursionError):
        return None


def _fits(document: Mapping[str, Any]) -> list[dict[str, Any]]:
    return document["fits"] if "fits" in document else [document["fit"]]


def _file(folder: Path, name: str) -> Path:
    return folder / f"{name}.json"


def _text(key: Key | None) -> str:
    return json.dumps(key, sort_keys=True)

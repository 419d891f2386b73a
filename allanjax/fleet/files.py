"""Files of a fleet's recordings, and their names."""

from __future__ import annotations

import glob
import os
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from allanjax.base.errors import AllanjaxError
from allanjax.record.io.formats import is_bag, name_of


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
                if (path.is_file() or is_bag(path)) and out.resolve() not in path.resolve().parents
            ]
            # The files of a bag are not recordings of their own beside it.
            bags = {path for path in matches if path.is_dir()}
            matches = [path for path in matches if path.parent not in bags]
        if not matches:
            raise AllanjaxError(
                f"no file matches {text!r}; check the pattern and the folder in which it starts"
            )
        for path in matches:
            found.setdefault(path.resolve(), path)
    if not found:
        raise AllanjaxError("no recordings given; pass files or patterns such as 'logs/*.parquet'")
    return tuple(found.values())


def recording_names(paths: Sequence[Path]) -> list[str]:
    """Name of each recording: its file's without suffix, made unique.

    The suffix is added if the folder has another file of that name, and as many folders as are needed to
    make it unique, e.g. `unit_07_imu`.
    """
    stems = [name_of(path) for path in paths]
    # Some file systems do not tell case apart.
    places = [
        str(path.absolute().with_name(stem)).casefold() for path, stem in zip(paths, stems, strict=True)
    ]
    shared = Counter(places)
    tails = [
        (*path.absolute().parts[1:-1], stem if shared[place] == 1 else path.name)
        for path, stem, place in zip(paths, stems, places, strict=True)
    ]
    names = [tail[-1] for tail in tails]
    for depth in range(2, max(map(len, tails)) + 1):
        count = Counter(name.casefold() for name in names)
        if len(count) == len(names):
            break
        for k, tail in enumerate(tails):
            if count[names[k].casefold()] > 1:
                names[k] = "_".join(tail[-depth:])
    return names

"""Figures of vendors' data sheets that come with the package, `sheets.toml`."""

import difflib
import functools
import re
import tomllib
from collections.abc import Mapping
from importlib.resources import files
from typing import Any


@functools.cache
def sheets() -> Mapping[str, Mapping[str, Any]]:
    """What each data sheet says, by the name of its sensor, in the form that `datasheet` takes."""
    text = files(__package__).joinpath("sheets.toml").read_text(encoding="utf-8")
    return {name: {"name": name, **figures} for name, figures in tomllib.loads(text).items()}


def find(name: str) -> Mapping[str, Any] | None:
    """The data sheet of a sensor, however its name is hyphenated and capitalised; None if there is none."""
    return {_plain(known): figures for known, figures in sheets().items()}.get(_plain(name))


def closest(name: str) -> str:
    """Words on the names that are there, the most similar ones first."""
    known, own = {_plain(there): there for there in sheets()}, _plain(name)
    near = [there for plain, there in known.items() if own and plain.startswith(own)]
    near = near or [known[match] for match in difflib.get_close_matches(own, known, cutoff=0.8)]
    return (f"did you mean {' or '.join(near)}? " if near else "") + f"there are {', '.join(sheets())}"


def _plain(name: str) -> str:
    return re.sub(r"[\W_]", "", name).casefold()

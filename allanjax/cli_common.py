"""What commands share: files, progress, errors, and names of results."""

import os
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer

RESULTS = Path("allanjax-results")

Files = Annotated[
    list[Path],
    typer.Argument(help="Recordings: CSV and other text, Parquet, .npy, .npz or .mat.", metavar="FILE"),
]
Out = Annotated[
    Path | None,
    typer.Option(help=f"Folder for the results, by default {RESULTS}; with --json there is none by default."),
]


def epilog(*examples: str) -> str:
    """Examples and exit codes, a line each: typer breaks lines at empty ones only."""
    codes = "Exit codes: 0 success; 1 bad input, or an axis without result; 2 a wrong command line."
    return "\n\n".join(["Examples:", *(f"  {example}" for example in examples), codes])


def prepare() -> None:
    """What every command needs before it computes: compiled programs from earlier runs, no windows."""
    os.environ["MPLBACKEND"] = "Agg"
    from allanjax.cache import enable_compilation_cache

    enable_compilation_cache()


@contextmanager
def stage(text: str) -> Iterator[Callable[[str], None]]:
    """A spinner on stderr, where that is a terminal; what it gives changes the text."""
    from rich.console import Console
    from rich.text import Text

    console = Console(stderr=True)
    with console.status(Text(text)) as status:
        yield lambda words: status.update(Text(words))


def print_error(message: str) -> None:
    """On stderr."""
    print(f"error: {message}", file=sys.stderr)


def exit_if_failed(errors: Sequence[Mapping[str, str]], files: Sequence[Path]) -> None:
    """Say which files failed, if any did, and end the program."""
    if errors:
        failed = dict.fromkeys(error["file"] for error in errors)
        if len(files) > 1:
            print(f"{len(failed)} of {len(files)} files failed: {', '.join(failed)}", file=sys.stderr)
        raise typer.Exit(1)


def result_names(files: Sequence[Path]) -> list[str]:
    """A name for the results of each file: its own without suffix, numbered where several share it."""
    names: list[str] = []
    for file in files:
        stem = file.name.removesuffix(".gz").rsplit(".", 1)[0] or file.name
        name, number = stem, 1
        # Some file systems do not tell case apart.
        while name.casefold() in (taken.casefold() for taken in names):
            number += 1
            name = f"{stem}-{number}"
        names.append(name)
    return names

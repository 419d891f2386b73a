"""Files, progress, errors and names of results, for all commands."""

from __future__ import annotations

import json
import os
import sys
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer

from allanjax.base.errors import AllanjaxError, MixedRatesError
from allanjax.base.tables import is_unicode
from allanjax.fleet.files import matching_files
from allanjax.record.io import ReadOptions, read_recording

if TYPE_CHECKING:
    from allanjax.estimate.result import AxisFit, Fit
    from allanjax.fleet.stream import AllanAccumulator
    from allanjax.noise.datasheet import DataSheet
    from allanjax.record.recording import Recording

RESULTS = Path("allanjax-results")
_STDIN = "-"
INTERRUPTED = 130
"""Exit code of a command that was told to stop, as shells count it."""

Files = Annotated[
    list[str],
    typer.Argument(
        help="Recordings: CSV and other text, Parquet, .npy, .npz, HDF5, .mat, TDMS, ROS bags (.bag, .db3, "
        ".mcap, or a folder), PX4 .ulg, ArduPilot .bin; patterns of them in quotes, * for any name, ** for "
        "any folders; - for standard input.",
        metavar="FILE",
    ),
]
Out = Annotated[
    Path | None,
    typer.Option(help=f"Folder for the results, by default {RESULTS}; with --json there is none by default."),
]
Vibrating = Annotated[
    bool,
    typer.Option("--vibrating", help="The platform is meant to move or vibrate: it is not tested for rest."),
]


def epilog(*examples: str) -> str:
    """End of a command's help: examples and exit codes, apart since typer breaks lines at empty ones only."""
    codes = (
        "Exit codes: 0 success; 1 bad input, or an axis without result; 2 a wrong command line; "
        f"{INTERRUPTED} interrupted."
    )
    return "\n\n".join(["Examples:", *(f"  {example}" for example in examples), codes])


class Input(NamedTuple):
    """Recording that a command works on: its file, its name in messages, and that of its results alone.

    Of a table whose sensors have rates of their own it is one `sensor`.
    """

    path: Path
    label: str
    name: str
    sensor: str = ""

    def of(self, sensors: Iterable[str]) -> list[Input]:
        """Each of its sensors."""
        return [Input(self.path, f"{self.label} ({s})", f"{self.name}_{s}", s) for s in sensors]

    def options(self, reading: ReadOptions) -> ReadOptions:
        """How to read it."""
        return replace(reading, columns=self.sensor) if self.sensor else reading

    def read(self, reading: ReadOptions) -> Recording:
        """The recording."""
        found = read_recording(self.path, self.options(reading), self.label)
        return replace(found, name=f"{found.name}_{self.sensor}") if self.sensor else found


class Outcome(NamedTuple):
    """What a command has found in a file, in words and as JSON; what it wrote; which axes have no result."""

    told: str
    document: Mapping[str, Any]
    written: Sequence[Path]
    without_result: Sequence[str]


def work_through(
    files: Sequence[str],
    out: Path | None,
    as_json: bool,
    work: Callable[[Input, Path | None], Outcome],
    document: Callable[[list[dict[str, Any]], int], dict[str, Any]],
    writes: bool = True,
) -> None:
    """Do a command's `work` on files, of which bad ones do not stop the others, and print what comes of it.

    As JSON that is what `document` makes of the files' documents and of how many files there were. Ends the
    program if files failed. A command that writes no files has no folder for them.
    """
    directory = out if as_json or not writes else out or RESULTS
    prepare(directory)
    documents: list[dict[str, Any]] = []
    errors: list[dict[str, str]] = []
    with inputs(files, directory) as given:
        pending = deque(given)
        while pending:
            file = pending.popleft()
            try:
                done = work(file, directory)
            except MixedRatesError as mixed:
                pending.extendleft(reversed(file.of(mixed.sensors)))
                continue
            except FAILURES as failure:
                errors.append(_reported(file, _reason(failure, file.label)))
                continue
            if as_json:
                documents.append({"file": file.label, **done.document})
            else:
                print(done.told, flush=True)
            if done.written:
                told = ", ".join(map(str, done.written))
                print(f"wrote {told}", file=sys.stderr if as_json else sys.stdout)
            errors += [_reported(file, message) for message in done.without_result]
    if as_json:
        print_json({**document(documents, len(given)), "errors": errors})
    exit_if_failed(errors, len(given))


@contextmanager
def inputs(arguments: Sequence[str], out: Path | None) -> Iterator[tuple[Input, ...]]:
    """Recordings that arguments stand for: files, matches of patterns, standard input; each once.

    Patterns do not match results, which are below `out`. A pipe, which can be read only once, is copied to a
    file.
    """
    with TemporaryDirectory() as folder:
        files: dict[Path, tuple[Path, str]] = {}
        for text in arguments:
            if text == _STDIN or Path(text).is_fifo():
                name = "stdin" if text == _STDIN else Path(text).name
                kept = Path(folder) / f"{len(files)}" / name
                kept.parent.mkdir()
                with open(text, "rb") if text != _STDIN else nullcontext(sys.stdin.buffer) as pipe:
                    kept.write_bytes(pipe.read())
                files.setdefault(Path(text), (kept, name if text == _STDIN else text))
                continue
            try:
                found = matching_files(text, out or RESULTS)
            except AllanjaxError:
                # Reading it will say that there is none, and the others go on.
                found = (Path(text),)
            for path in found:
                files.setdefault(path.resolve(), (path, str(path)))
        given = list(files.values())
        names = result_names([path for path, _ in given])
        yield tuple(Input(*file, name) for file, name in zip(given, names, strict=True))


def prepare(out: Path | None = None) -> None:
    """Prepare a command: check the folder for results, open no windows, reuse compiled programs.

    Ends the program if the folder `out` can not be written to.
    """
    if out is not None:
        place = next(path for path in (out, *out.absolute().parents) if os.path.exists(path))
        wrong = ""
        if not place.is_dir():
            wrong = "is a file: give a folder"
        elif not os.access(place, os.W_OK | os.X_OK):
            wrong = "can not be written to: give another folder"
        if wrong:
            print_error(f"{place} {wrong} for the results by --out")
            raise typer.Exit(1)
    os.environ["MPLBACKEND"] = "Agg"
    from allanjax.base.cache import enable_compilation_cache

    enable_compilation_cache()


#: Failures by the input, the disk or the machine; any other exception is a bug and shows itself.
FAILURES = (AllanjaxError, OSError, MemoryError)


def _reason(failure: BaseException, label: str) -> str:
    """Message that says what went wrong with the file of this label."""
    if isinstance(failure, MemoryError):
        return f"{label}: not enough memory; take a stretch by --start and --stop, or --stream"
    if isinstance(failure, OSError) and failure.strerror:
        return f"{label if failure.filename is None else failure.filename}: {failure.strerror}"
    return str(failure)


@contextmanager
def failures_told() -> Iterator[None]:
    """End the program with a message on bad input and failing files; other exceptions show themselves."""
    try:
        yield
    except FAILURES as failure:
        print_error(_reason(failure, "allanjax"))
        raise typer.Exit(1) from failure


@contextmanager
def stage(text: str) -> Iterator[Callable[[str], None]]:
    """Show a spinner on stderr, where that is a terminal; yields a function that changes its text."""
    from rich.console import Console
    from rich.text import Text

    console = Console(stderr=True)
    with console.status(Text(text)) as status:
        yield lambda words: status.update(Text(words))


def fitting(file: Input, data: Recording | AllanAccumulator) -> AbstractContextManager[Callable[[str], None]]:
    """Show that a recording is being fitted, see `stage`."""
    size = f"{data.n:,} samples of {len(data.axes)} axes"
    return stage(f"{file.label}: fitting {size} (the first run on a machine also compiles)")


def print_json(document: Mapping[str, Any]) -> None:
    """Print a document on stdout, where nothing else is printed."""
    print(json.dumps(document, indent=2, ensure_ascii=not is_unicode(sys.stdout), allow_nan=False))


def print_error(message: str) -> None:
    """Print an error on stderr."""
    print(f"error: {message}", file=sys.stderr)


def _reported(file: Input, message: str) -> dict[str, str]:
    """Print an error of a file on stderr; returns it as the JSON has it."""
    begin = f"{file.label}: "
    print_error(message if message.startswith(begin) else begin + message)
    return {"file": file.label, "message": message}


def exit_if_failed(errors: Sequence[Mapping[str, str]], files: int) -> None:
    """End the program if files failed, and say which of how many."""
    if errors:
        failed = dict.fromkeys(error["file"] for error in errors)
        if files > 1:
            print(f"{len(failed)} of {files} files failed: {', '.join(failed)}", file=sys.stderr)
        raise typer.Exit(1)


def result_names(files: Sequence[Path]) -> list[str]:
    """Names for the results of each file: its own without suffix, numbered where several share it."""
    names: list[str] = []
    for file in files:
        stem = file.name.removesuffix(".gz").rsplit(".", 1)[0] or file.name
        # Some file systems do not tell case apart.
        taken = {name.casefold() for name in names}
        numbered = (f"{stem}-{number}" for number in range(2, len(files) + 1))
        names.append(next(name for name in (stem, *numbered) if name.casefold() not in taken))
    return names


SavedFit = Annotated[
    Path, typer.Argument(help="What allanjax characterize wrote: NAME.json.", metavar="RESULT.json")
]


OptionalFit = Annotated[
    Path | None,
    typer.Argument(help="What allanjax characterize wrote, or a data sheet .toml.", metavar="RESULT.json"),
]
Sheet = Annotated[
    str | None,
    typer.Option(help="A data sheet instead: a sensor of allanjax convert --list, or a file of TOML."),
]


def fit_or_sheet(path: Path | None, sheet: str | None) -> Fit | DataSheet:
    """The fit in a file, or a data sheet by its name or in a file; AllanjaxError if there is none."""
    from allanjax.noise.datasheet import datasheet

    if (path is None) == (sheet is None):
        raise AllanjaxError("give one: a result, such as allanjax-results/imu.json, or --sheet SENSOR")
    if sheet is not None:
        return datasheet(sheet)
    assert path is not None
    return datasheet(path) if path.suffix == ".toml" else saved_fit(path)


def saved_fit(path: Path) -> Fit:
    """The fit in a file; AllanjaxError if there is none, or more than one."""
    from allanjax.estimate.as_json import load

    found = load(path)
    if not isinstance(found, dict):
        return found
    if len(found) != 1:
        raise AllanjaxError(
            f"{path}: holds {len(found)} fits, {', '.join(found)}; characterize them without --json "
            "and give one NAME.json"
        )
    return next(iter(found.values()))


def measured_axis(fit: Fit, name: str, path: Path) -> AxisFit:
    """The fit of an axis; AllanjaxError if it is no measurement of the sensor."""
    axis = fit[name]
    if not axis.measured:
        raise AllanjaxError(f"{path}: {name}: {axis.verdict}")
    return axis

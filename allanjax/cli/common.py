"""Files, progress, errors and names of results, for all commands."""

from __future__ import annotations

import json
import os
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from dataclasses import replace
from itertools import chain, count
from pathlib import Path
from tempfile import TemporaryDirectory, TemporaryFile
from typing import TYPE_CHECKING, Any, NamedTuple, NoReturn, TypeVar

from allanjax.base.errors import AllanjaxError, MixedRatesError
from allanjax.base.tables import is_unicode
from allanjax.cli.interrupt import TEMPORARY
from allanjax.record.io import ReadOptions, read_recording

if TYPE_CHECKING:
    from allanjax.estimate.result import Fit
    from allanjax.fleet.stream import AllanAccumulator
    from allanjax.noise.datasheet import DataSheet
    from allanjax.record.recording import Recording

_T = TypeVar("_T")

RESULTS = Path("allanjax-results")
#: Of the documents that commands make.
SCHEMA_VERSION = 1
_STDIN = "-"
# Folders that a command made for its results, the inner ones first.
_MADE: list[Path] = []


class Input(NamedTuple):
    """Recording that a command processes: its file, its name in messages, and the name of its results.

    `sensor` is set if the sensors of a table have different rates and are processed one by one.
    """

    path: Path
    label: str
    name: str
    sensor: str = ""

    def of(self, sensors: Iterable[str]) -> list[Input]:
        """One input per sensor."""
        return [Input(self.path, f"{self.label} ({s})", f"{self.name}_{s}", s) for s in sensors]

    def options(self, reading: ReadOptions) -> ReadOptions:
        """Options to read it with."""
        return reading.of_sensor(self.sensor) if self.sensor else reading

    def read(self, reading: ReadOptions) -> Recording:
        """The recording."""
        recording = read_recording(self.path, self.options(reading), self.label)
        return replace(recording, name=f"{recording.name}_{self.sensor}") if self.sensor else recording


class Outcome(NamedTuple):
    """Result of a command for one file: as text, as JSON, the files written, and axes without a result."""

    text: str
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
    """Do a command's `work` on each file and print the results; a bad file does not stop the others.

    JSON is what `document` makes of the files' documents and the number of files. Ends the program with an
    error if a file failed. `writes` is whether the command writes files, which go into the folder `out`.
    """
    directory = out if as_json or not writes else out or RESULTS
    prepare(directory)
    documents: list[dict[str, Any]] = []
    errors: list[dict[str, str]] = []
    with inputs(files, directory) as given:
        for file, done in worked_through(given, lambda file: work(file, directory), errors):
            if as_json:
                documents.append({"file": file.label, **done.document})
            else:
                print(done.text, flush=True)
            print_written(done.written, as_json)
            errors += [reported(file, message) for message in done.without_result]
    if as_json:
        print_json({**document(documents, len(given)), "errors": errors})
    exit_if_failed(errors, len(given))


def worked_through(
    given: Sequence[Input], work: Callable[[Input], _T], errors: list[dict[str, str]]
) -> Iterator[tuple[Input, _T]]:
    """Yield each file with what the work makes of it; what fails is printed and added to the errors.

    Sensors of a file are files of their own if they have different rates.
    """
    pending = deque(given)
    while pending:
        file = pending.popleft()
        try:
            done = work(file)
        except MixedRatesError as mixed:
            pending.extendleft(reversed(file.of(mixed.sensors)))
        except FAILURES as failure:
            errors.append(reported(file, reason(failure, file.label)))
        else:
            yield file, done


@contextmanager
def inputs(arguments: Sequence[str], out: Path | None) -> Iterator[tuple[Input, ...]]:
    """Recordings that arguments name: files, matches of patterns, standard input; each once.

    Patterns do not match files below the folder of results, `out`. A pipe can be read only once, so it is
    copied to a file.
    """
    from allanjax.fleet.files import matching_files

    with TemporaryDirectory() as folder:
        TEMPORARY.append(folder)
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
                paths = matching_files(text, out or RESULTS)
            except AllanjaxError:
                # Reading it reports that it is missing, and the other files are still processed.
                paths = (Path(text),)
            for path in paths:
                files.setdefault(Path(os.path.realpath(path)), (path, str(path)))
        given = list(files.values())
        names = result_names([path for path, _ in given])
        yield tuple(Input(*file, name) for file, name in zip(given, names, strict=True))


def prepare(folder: Path | None = None, files: Sequence[Path] = ()) -> None:
    """Prepare a command: make places for results, draw without windows, reuse compiled programs.

    Ends the program if the folder or the files cannot be written, see `make_places`.
    """
    make_places(folder, files)
    os.environ["MPLBACKEND"] = "Agg"
    from allanjax.base.cache import enable_compilation_cache

    with stage("loading allanjax"):
        enable_compilation_cache()


def make_places(folder: Path | None = None, files: Sequence[Path] = ()) -> None:
    """Create the folder of results and the folders of the files to write, before any work is done.

    The program ends with an error if it cannot write to them. `remove_empty` removes those that stay empty.
    """
    for place in (*([] if folder is None else [folder]), *(file.parent for file in files)):
        made = [path for path in (place, *place.parents) if not path.exists()]
        try:
            place.mkdir(parents=True, exist_ok=True)
            with TemporaryFile(dir=place):
                _MADE.extend(made)
        except OSError as error:
            _cannot_write(place, error.strerror or str(error), "folder")
    for file in files:
        if file.is_dir():
            _cannot_write(file, "it is a folder", "file")
        elif file.exists() and not os.access(file, os.W_OK):
            _cannot_write(file, "it is read-only", "file")


def _cannot_write(place: Path, why: str, kind: str) -> NoReturn:
    print_error(f"{place}: cannot be written ({why}): choose another {kind} for the results with --out")
    sys.exit(1)


def remove_empty() -> None:
    """Remove the folders that were made for results if there are none."""
    while _MADE:
        with suppress(OSError):
            _MADE.pop(0).rmdir()


#: Failures caused by the input, the disk or the machine; any other exception is a bug.
FAILURES = (AllanjaxError, OSError, MemoryError)


def reason(failure: BaseException, label: str) -> str:
    """Message about the failure of the file with this label."""
    if isinstance(failure, MemoryError):
        return f"{label}: not enough memory; read a part with --start and --stop, or pass --stream"
    if isinstance(failure, OSError) and failure.strerror:
        return f"{label if failure.filename is None else failure.filename}: {failure.strerror}"
    return str(failure)


@contextmanager
def stage(text: str) -> Iterator[Callable[[str], None]]:
    """Show on stderr what is being done; yields a function that changes the text.

    A terminal shows a spinner. Any other stderr gets a line after 2 s and one every 10 s: a quick command
    prints nothing, and the log of a slow one shows that it is alive.
    """
    if sys.stderr.isatty():
        from rich.console import Console
        from rich.text import Text

        with Console(stderr=True).status(Text(text)) as status:
            yield lambda words: status.update(Text(words))
        return
    current, stream = [text], sys.stderr
    begin, ended = time.monotonic(), threading.Event()

    def report() -> None:
        for seconds in chain([2], count(10, 10)):
            if ended.wait(max(begin + seconds - time.monotonic(), 0.0)):
                return
            print(f"{current[0]}, {seconds} s", file=stream, flush=True)

    reporter = threading.Thread(target=report, daemon=True)
    reporter.start()
    try:
        yield lambda words: current.__setitem__(0, words)
    finally:
        ended.set()
        reporter.join()


def fitting(file: Input, data: Recording | AllanAccumulator) -> AbstractContextManager[Callable[[str], None]]:
    """Show that a recording is being fitted, see `stage`."""
    return stage(f"{file.label}: fitting {data.n:,} samples per axis (the first run also compiles)")


def print_json(document: Mapping[str, Any]) -> None:
    """Print a document on stdout, as the only output there."""
    print(json.dumps(document, indent=2, ensure_ascii=not is_unicode(sys.stdout), allow_nan=False))


def write_result(result: Any, directory: Path | None, name: str, figure_format: str) -> list[Path]:
    """Write a result as NAME.json and as a figure into a folder; nothing without one."""
    if directory is None:
        return []
    from allanjax.presentation.files import write_document

    paths = [directory / f"{name}.{kind}" for kind in ("json", figure_format)]
    write_document(result.to_dict(), paths[0])
    result.plot(path=paths[1])
    return paths


def print_result(result: Any, as_json: bool, written: Sequence[Path] = ()) -> None:
    """Print a result as text or as JSON, and which files were written."""
    if as_json:
        print_json(result.to_dict())
    else:
        print(result, flush=True)
    print_written(written, as_json)


def print_list(
    kind: str, entries: Sequence[Mapping[str, Any]], line: Callable[..., str], as_json: bool
) -> None:
    """Print what --list asks for: the line of each entry, or JSON."""
    if as_json:
        print_json({"schema_version": SCHEMA_VERSION, kind: entries})
    else:
        print(*(line(**entry) for entry in entries), sep="\n")


def print_written(paths: Sequence[Path], as_json: bool = False) -> None:
    """Print which files were written, and to which folder: on stderr if stdout has JSON."""
    for folder in dict.fromkeys(path.parent for path in paths):
        names = ", ".join(path.name for path in paths if path.parent == folder)
        print(f"wrote to {folder}: {names}", file=sys.stderr if as_json else sys.stdout)


def print_error(message: str) -> None:
    """Print an error on stderr."""
    print(f"error: {message}", file=sys.stderr)


def refuse(message: str) -> NoReturn:
    """End the program as its command line is invalid."""
    print_error(message)
    sys.exit(2)


def reported(file: Input, message: str) -> dict[str, str]:
    """Print an error of a file on stderr, and return it as in the JSON."""
    begin = f"{file.label}: "
    print_error(message if message.startswith(begin) else begin + message)
    return {"file": file.label, "message": message}


def exit_by(verdicts: Sequence[str]) -> None:
    """End the program with 1 if limits of a specification are not met, or else with 3 if one is undecided."""
    for verdict, code in (("fail", 1), ("undecided", 3)):
        if verdict in verdicts:
            sys.exit(code)


def exit_if_failed(errors: Sequence[Mapping[str, str]], files: int) -> None:
    """End the program if files failed, with a line on stderr that names them."""
    if errors:
        failed = dict.fromkeys(error["file"] for error in errors)
        if files > 1:
            print(f"{len(failed)} of {files} files failed: {', '.join(failed)}", file=sys.stderr)
        sys.exit(1)


def result_names(files: Sequence[Path]) -> list[str]:
    """Names for the results of each file: the file's without suffix, numbered if several files share it."""
    from allanjax.record.io.formats import name_of

    names: list[str] = []
    for file in files:
        stem = name_of(file)
        # Some file systems ignore case.
        taken = {name.casefold() for name in names}
        numbered = (f"{stem}-{number}" for number in range(2, len(files) + 1))
        names.append(next(name for name in (stem, *numbered) if name.casefold() not in taken))
    return names


def fit_or_sheet(path: Path | None, sheet: str | None) -> Fit | DataSheet:
    """The fit in a file, or a data sheet given by name or file; AllanjaxError if there is none."""
    from allanjax.noise.datasheet import datasheet

    if (path is None) == (sheet is None):
        raise AllanjaxError("give either a result, e.g. allanjax-results/imu.json, or --sheet SENSOR")
    if sheet is not None:
        return datasheet(sheet)
    assert path is not None
    return datasheet(path) if path.suffix == ".toml" else saved_fit(path)


def saved_fit(path: Path) -> Fit:
    """The fit in a file; AllanjaxError if there is none, or more than one."""
    from allanjax.estimate.as_json import load_one

    return load_one(path)

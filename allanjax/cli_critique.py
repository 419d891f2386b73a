"""The command `allanjax critique`."""

import dataclasses
import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from allanjax.cli_common import (
    RESULTS,
    Files,
    Out,
    epilog,
    exit_if_failed,
    prepare,
    print_error,
    result_names,
    stage,
)
from allanjax.cli_options import with_options
from allanjax.io import ReadOptions, read_recording

if TYPE_CHECKING:
    from allanjax.critique.result import Critique

HELP = (
    "Say what a simulation of static recordings from their noise terms gets wrong, and why. Prints a story a "
    "file, and writes NAME_critique.json and a picture of every finding. Where one of several files is bad, "
    "the others go on. With --json the document of one file (allanjax/critique.schema.json) is printed as it "
    "is, with a list of errors in it; those of several files come as {schema_version, critiques, errors}."
)
EPILOG = epilog(
    "allanjax critique imu.csv",
    "allanjax critique log.parquet --rate 100 --gyro-unit deg/s --accel-unit g --out findings",
    "allanjax critique *.csv --start 60 --json > critiques.json",
)


@with_options
def critique_command(
    files: Files,
    reading: ReadOptions,
    out: Out = None,
    as_json: Annotated[
        bool,
        typer.Option(
            "--json",
            help="Print JSON instead: of one file {schema_version, recording, axes, shared_findings, errors, "
            "...}, of several {schema_version, critiques, errors}.",
        ),
    ] = False,
) -> None:
    from allanjax.critique.export import SCHEMA_VERSION, to_dict
    from allanjax.errors import AllanjaxError

    directory = out if as_json else out or RESULTS
    prepare()
    critiques: list[dict[str, Any]] = []
    errors: list[dict[str, str]] = []
    for file, name in zip(files, result_names(files), strict=True):
        try:
            found = _read_and_criticize(file, reading)
            paths = [] if directory is None else _write(found, directory, name, file)
        except (AllanjaxError, OSError) as error:
            errors.append({"file": str(file), "message": str(error)})
            print_error(str(error))
            continue
        if as_json:
            critiques.append({"file": str(file), **to_dict(found)})
        else:
            print(found, flush=True)
        for dead in found.dead:
            message = f"{dead.axis.name}: not compared, {dead.reason}"
            errors.append({"file": str(file), "message": message})
            print_error(f"{file}: {message}")
        if paths:
            print(
                f"wrote {', '.join(str(path) for path in paths)}", file=sys.stderr if as_json else sys.stdout
            )
    if as_json:
        document: dict[str, Any] = {"schema_version": SCHEMA_VERSION}
        if len(files) > 1:
            document |= {"critiques": critiques}
        elif critiques:
            (document,) = critiques
            del document["file"]
        document["errors"] = errors
        print(json.dumps(document, indent=2, ensure_ascii=False, allow_nan=False))
    exit_if_failed(errors, files)


def _read_and_criticize(file: Path, reading: ReadOptions) -> "Critique":
    with stage(f"{file}: loading allanjax"):
        from allanjax.critique import critique
    with stage(f"{file}: reading"):
        recording = read_recording(file, reading)
    size = f"{recording.n:,} samples of {len(recording.axes)} axes"
    with stage(f"{file}: fitting {size} (the first run on a machine also compiles)") as tell:
        return critique(recording, progress=lambda text: tell(f"{file}: {text}"))


def _write(critique: "Critique", directory: Path, name: str, file: Path) -> list[Path]:
    """The JSON file and the pictures; returns their paths."""
    from matplotlib import pyplot as plt

    from allanjax.critique.export import write_json
    from allanjax.critique.plot import figure_names, plot_critique

    named = dataclasses.replace(critique, name=name)
    with stage(f"{file}: writing results"):
        directory.mkdir(parents=True, exist_ok=True)
        paths = [directory / f"{name}_critique.json"]
        write_json(critique, paths[0])
        for figure in plot_critique(named, directory):
            plt.close(figure)
    return paths + [directory / picture for picture in figure_names(named)]

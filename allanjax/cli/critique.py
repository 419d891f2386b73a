"""The command `allanjax critique`."""

import dataclasses
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from allanjax.cli.common import (
    FAILURES,
    RESULTS,
    Files,
    Input,
    Out,
    epilog,
    exit_if_failed,
    inputs,
    prepare,
    print_json,
    reason,
    reported,
    stage,
)
from allanjax.cli.options import with_options
from allanjax.record.io import ReadOptions, read_recording

if TYPE_CHECKING:
    from allanjax.critic.result import Critique

HELP = (
    "Say what a simulation of static recordings from their noise terms gets wrong, and why. Prints a story a "
    "file, and writes NAME_critique.json and a picture of every finding. Where one of several files is bad, "
    "the others go on. With --json (schema: allanjax schema critique) the document of one file is printed "
    "as it is, with a list of errors in it; those of several files, or of none that could be read, come as "
    "{schema_version, critiques, errors}."
)
EPILOG = epilog(
    "allanjax critique imu.csv",
    "allanjax critique log.parquet --rate 100 --gyro-unit deg/s --accel-unit g --out findings",
    "allanjax critique *.csv --start 60 --json > critiques.json",
)


@with_options
def command(
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
    from allanjax.report.critique_json import SCHEMA_VERSION, to_dict

    directory = out if as_json else out or RESULTS
    prepare(directory)
    critiques: list[dict[str, Any]] = []
    errors: list[dict[str, str]] = []
    with inputs(files, directory) as given:
        for file in given:
            try:
                found = _read_and_criticize(file, reading)
                paths = [] if directory is None else _write(found, directory, file)
            except FAILURES as failure:
                errors.append(reported(file, reason(failure, file.label)))
                continue
            if as_json:
                critiques.append({"file": file.label, **to_dict(found)})
            else:
                print(found, flush=True)
            if paths:
                told = ", ".join(str(path) for path in paths)
                print(f"wrote {told}", file=sys.stderr if as_json else sys.stdout)
            for dead in found.dead:
                errors.append(reported(file, f"{dead.axis.name}: not compared, {dead.reason}"))
    if as_json:
        document: dict[str, Any] = {"schema_version": SCHEMA_VERSION, "critiques": critiques}
        if len(given) == 1 and critiques:
            (document,) = critiques
            del document["file"]
        print_json({**document, "errors": errors})
    exit_if_failed(errors, len(given))


def _read_and_criticize(file: Input, reading: ReadOptions) -> "Critique":
    with stage(f"{file.label}: loading allanjax"):
        from allanjax.critic.critique import critique
    with stage(f"{file.label}: reading"):
        recording = read_recording(file.path, reading, file.label)
    size = f"{recording.n:,} samples of {len(recording.axes)} axes"
    with stage(f"{file.label}: fitting {size} (the first run on a machine also compiles)") as tell:
        return critique(recording, progress=lambda text: tell(f"{file.label}: {text}"))


def _write(critique: "Critique", directory: Path, file: Input) -> list[Path]:
    """Write the JSON file and the figures; returns their paths."""
    from allanjax.report.critique_figure import figure_names, plot_critique
    from allanjax.report.critique_json import write_json

    named = dataclasses.replace(critique, name=file.name)
    with stage(f"{file.label}: writing results"):
        directory.mkdir(parents=True, exist_ok=True)
        paths = [directory / f"{file.name}_critique.json"]
        write_json(critique, paths[0])
        plot_critique(named, directory)
    return paths + [directory / picture for picture in figure_names(named)]

"""The command `allanjax critique`."""

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from allanjax.cli.common import Files, Input, Out, Outcome, Vibrating, epilog, fitting, stage, work_through
from allanjax.cli.options import FigureFormat, with_options
from allanjax.record.io import ReadOptions

if TYPE_CHECKING:
    from allanjax.critic.result import Critique

HELP = (
    "Find what the noise model of static recordings misses, and why: spectral lines, bias steps, outliers, "
    "filters and others. Prints a summary of each file and writes NAME_critique.json and one figure per "
    "finding. If one file fails, the others are still processed. With --json (schema: allanjax schema "
    "critique), the output for one file is its document; with several files, or if none could be read, it is "
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
    vibrating: Vibrating = False,
    refit: Annotated[
        bool,
        typer.Option("--refit", help="Also print the coefficients after correction for the findings."),
    ] = False,
    out: Out = None,
    figure_format: FigureFormat = "png",
    as_json: Annotated[
        bool,
        typer.Option(
            "--json",
            help="Print JSON instead: {schema_version, recording, findings, axes, shared_findings, errors, "
            "...} for one file, {schema_version, critiques, errors} for several.",
        ),
    ] = False,
) -> None:
    from allanjax.report.critique_json import SCHEMA_VERSION, to_dict

    def work(file: Input, directory: Path | None) -> Outcome:
        result = _read_and_criticize(file, reading, vibrating)
        paths = [] if directory is None else _write(result, directory, file, figure_format)
        missing = [f"{dead.axis.name}: not compared, {dead.reason}" for dead in result.dead]
        missing += [f"{axis}: {why}" for axis, why in result.fit.not_measured.items()]
        text = f"{result}\n\n{result.refit()}" if refit else str(result)
        return Outcome(text, to_dict(result), paths, missing)

    def document(critiques: list[dict[str, Any]], count: int) -> dict[str, Any]:
        if count == len(critiques) == 1:
            return {key: value for key, value in critiques[0].items() if key != "file"}
        return {"schema_version": SCHEMA_VERSION, "critiques": critiques}

    work_through(files, out, as_json, work, document)


def _read_and_criticize(file: Input, reading: ReadOptions, vibrating: bool) -> "Critique":
    with stage(f"{file.label}: loading allanjax"):
        from allanjax.critic.critique import critique
    with stage(f"{file.label}: reading"):
        recording = file.read(reading)
    with fitting(file, recording) as show:
        return critique(recording, vibrating=vibrating, progress=lambda text: show(f"{file.label}: {text}"))


def _write(critique: "Critique", directory: Path, file: Input, suffix: str) -> list[Path]:
    """Write the JSON file and the figures, and return their paths."""
    from allanjax.report.critique_figure import critique_figures
    from allanjax.report.critique_json import to_dict
    from allanjax.report.files import write_document

    named = dataclasses.replace(critique, name=file.name)
    with stage(f"{file.label}: writing results"):
        directory.mkdir(parents=True, exist_ok=True)
        paths = [directory / f"{file.name}_critique.json"]
        write_document(to_dict(critique), paths[0])
        return paths + [directory / name for name in critique_figures(named, directory, suffix=suffix)]

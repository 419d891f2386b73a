"""The command `allanjax check`."""

from pathlib import Path
from typing import Annotated, Any

import typer

from allanjax.base.errors import MixedRatesError, RecordingError
from allanjax.cli.common import Files, Input, Outcome, Vibrating, epilog, stage, work_through
from allanjax.cli.options import with_options
from allanjax.record.io import ReadOptions

HELP = (
    "Say whether static recordings are fit for the estimation of noise coefficients: rate, gaps, resolution, "
    "saturation, motion, units, bandwidth and others, and how long to record for N, B and K. Each line is "
    "fine, worth a look, or a reason to stop; with one of these the exit code is 1."
)
EPILOG = epilog(
    "allanjax check imu.csv",
    "allanjax check log.parquet --rate 100 --gyro-unit deg/s --accel-unit g",
    "allanjax check *.csv --json > checks.json",
)


@with_options
def command(
    files: Files,
    reading: ReadOptions,
    vibrating: Vibrating = False,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print JSON instead of tables: {schema_version, checks, errors}.")
    ] = False,
) -> None:
    from allanjax.estimate.check import SCHEMA_VERSION, check, unreadable

    stopped: list[str] = []

    def work(file: Input, _: Path | None) -> Outcome:
        with stage(f"{file.label}: reading") as say:
            try:
                recording = file.read(reading)
            except MixedRatesError:
                raise
            except RecordingError as error:
                found = unreadable(error, file.name)
            else:
                say(f"{file.label}: fitting, to see how long to record (the first run also compiles)")
                found = check(recording, vibrating=vibrating)
        if found.stops:
            stopped.append(file.label)
        return Outcome(str(found), found.to_dict(), (), ())

    def document(checks: list[dict[str, Any]], _: int) -> dict[str, Any]:
        return {"schema_version": SCHEMA_VERSION, "checks": checks}

    work_through(files, None, as_json, work, document, writes=False)
    if stopped:
        raise typer.Exit(1)

"""The command `allanjax check`."""

from pathlib import Path
from typing import Annotated, Any

import typer

from allanjax.base.errors import MixedRatesError, RecordingError
from allanjax.cli.common import Files, Input, Outcome, Vibrating, epilog, stage, work_through
from allanjax.cli.options import with_options
from allanjax.record.io import ReadOptions

HELP = (
    "Check whether static recordings are suitable for estimating noise coefficients: rate, gaps, resolution, "
    "saturation, motion, units, bandwidth and more, and how long to record for N, B and K. Each line reads "
    "fine, look or stop; any 'stop' makes the exit code 1."
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
        with stage(f"{file.label}: reading") as show:
            try:
                recording = file.read(reading)
            except MixedRatesError:
                raise
            except RecordingError as error:
                result = unreadable(error, file.name)
            else:
                show(f"{file.label}: fitting, to estimate how long to record (the first run also compiles)")
                result = check(recording, vibrating=vibrating)
        if result.stops:
            stopped.append(file.label)
        return Outcome(str(result), result.to_dict(), (), ())

    def document(checks: list[dict[str, Any]], _: int) -> dict[str, Any]:
        return {"schema_version": SCHEMA_VERSION, "checks": checks}

    work_through(files, None, as_json, work, document, writes=False)
    if stopped:
        raise typer.Exit(1)

"""The command `allanjax kalman`."""

from pathlib import Path
from typing import Annotated

import typer

from allanjax.base.errors import AllanjaxError
from allanjax.cli.common import epilog, prepare, print_result, saved_fit, stage, user_errors
from allanjax.cli.options import with_options
from allanjax.record.io import ReadOptions, read_recording

HELP = (
    "Run a Kalman filter with a noise model on a recording: estimate the bias over time with its interval, "
    "and test whether the innovations are white and of the predicted size, as they should be."
)
EPILOG = epilog(
    "allanjax kalman imu.csv --fit allanjax-results/imu.json",
    "allanjax kalman imu.csv --terms 'N=0.1 deg/√h + K=1 deg/h/√h' --smooth --out bias.png --out bias.csv",
)


@with_options
def command(
    reading: ReadOptions,
    file: Annotated[Path, typer.Argument(help="Recording to filter.", metavar="FILE")],
    fit: Annotated[
        Path | None,
        typer.Option(
            help="Result of allanjax characterize with the model of each axis.", metavar="RESULT.json"
        ),
    ] = None,
    terms: Annotated[
        str | None,
        typer.Option(
            help="Alternatively a noise model with values, used for every axis (gyros only or accelerometers "
            "only)."
        ),
    ] = None,
    smooth: Annotated[
        bool, typer.Option("--smooth", help="Estimate the bias from all samples, not only earlier ones.")
    ] = False,
    out: Annotated[
        list[Path] | None,
        typer.Option("--out", "-o", help="Figure (e.g. .png) or table (.csv) to write; repeat for more."),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON, in SI units.")] = False,
) -> None:
    prepare()
    from allanjax.kalman.filtering import kalman_filter

    with user_errors():
        if (fit is None) == (terms is None):
            raise AllanjaxError("give the noise model, either with --fit RESULT.json or with --terms")
        models = str(terms) if fit is None else saved_fit(fit)
        with stage(f"{file}: filtering"):
            result = kalman_filter(read_recording(file, reading, str(file)), models, smooth=smooth)
        for path in out or ():
            if path.suffix == ".csv":
                result.to_dataframe().to_csv(path, index=False)
            else:
                result.plot(path=path)
    print_result(result, as_json, out or ())

"""The command `allanjax kalman`."""

import sys
from pathlib import Path
from typing import Annotated

import typer

from allanjax.base.errors import AllanjaxError
from allanjax.cli.common import epilog, failures_told, prepare, print_json, saved_fit, stage
from allanjax.cli.options import with_options
from allanjax.record.io import ReadOptions, read_recording

HELP = (
    "Filter a recording by its noise model: the bias over time with its interval, and whether innovations "
    "are white and of their size, as they are where the model is right."
)
EPILOG = epilog(
    "allanjax kalman imu.csv --fit allanjax-results/imu.json",
    "allanjax kalman imu.csv --terms 'N=0.1 deg/√h + K=1 deg/h/√h' --smooth --out bias.png --out bias.csv",
)


@with_options
def command(
    reading: ReadOptions,
    file: Annotated[Path, typer.Argument(help="A recording.", metavar="FILE")],
    fit: Annotated[
        Path | None,
        typer.Option(help="Fit with the model of each axis, NAME.json.", metavar="RESULT.json"),
    ] = None,
    terms: Annotated[
        str | None, typer.Option(help="Or a noise model with values, for all axes, which are of one sensor.")
    ] = None,
    smooth: Annotated[
        bool, typer.Option("--smooth", help="Estimate the bias from all samples, not those up to each.")
    ] = False,
    out: Annotated[
        list[Path] | None,
        typer.Option("--out", "-o", help="File to write: the picture (e.g. .png), or the table (.csv)."),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON instead of a table, in SI.")] = False,
) -> None:
    prepare()
    from allanjax.kalman.filtering import kalman_filter

    with failures_told():
        if (fit is None) == (terms is None):
            raise AllanjaxError("a filter needs one noise model: give --fit RESULT.json or --terms")
        models = str(terms) if fit is None else saved_fit(fit)
        with stage(f"{file}: filtering"):
            found = kalman_filter(read_recording(file, reading, str(file)), models, smooth=smooth)
        for path in out or ():
            if path.suffix == ".csv":
                found.to_dataframe().to_csv(path, index=False)
            else:
                found.plot(path=path)
    if as_json:
        print_json(found.to_dict())
    else:
        print(found)
    if out:
        print(f"wrote {', '.join(map(str, out))}", file=sys.stderr if as_json else sys.stdout)

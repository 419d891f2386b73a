"""The command `allanjax statespace`."""

from pathlib import Path
from typing import Annotated, Literal

import typer

from allanjax.base.errors import AllanjaxError
from allanjax.cli.common import epilog, prepare, print_result, saved_fit, user_errors

HELP = (
    "Write the matrices A, H, Q, R and P0 of a Kalman filter for the noise of a fitted axis: x' = A x + w, "
    "z = H x + v. The file also gives the names and SI units of the states."
)
EPILOG = epilog(
    "allanjax statespace allanjax-results/imu.json --axis gyro_x --out gyro_x.npz",
    "allanjax statespace imu.json --axis gyro_x --rate 200 --format c --out gyro_x.h",
)


def command(
    result: Annotated[
        Path, typer.Argument(help="Result of allanjax characterize: NAME.json.", metavar="RESULT.json")
    ],
    out: Annotated[Path, typer.Option("--out", "-o", help="File to write.")],
    axis: Annotated[str, typer.Option(help="Axis, e.g. gyro_x.")],
    rate: Annotated[
        float | None, typer.Option(help="Sample rate of the filter in Hz; by default the recording's.")
    ] = None,
    duration: Annotated[
        float | None,
        typer.Option(
            help="Time in s that the filter runs, by default the recording's length. Up to this time, bias "
            "instability is approximated by a sum of Gauss–Markov processes."
        ),
    ] = None,
    form: Annotated[
        Literal["npz", "matlab", "c"], typer.Option("--format", help="NumPy file, MATLAB script or C header.")
    ] = "npz",
) -> None:
    prepare()
    with user_errors():
        fit = saved_fit(result)
        measured = fit[axis]
        if not measured.measured:
            raise AllanjaxError(f"{result}: {axis}: {measured.verdict}")
        # A filter that precedes sampling depends on the recording's rate.
        length = fit.curve.n / fit.curve.rate if duration is None else duration
        rate = fit.curve.rate if rate is None else rate
        space = measured.model.state_space(rate, duration=length, sensor=measured.axis.sensor)
        if form == "npz":
            space.to_numpy(out)
        else:
            text = space.to_matlab() if form == "matlab" else space.to_c_header()
            out.write_text(text, encoding="utf-8")
    print_result(space, as_json=False, written=[out])

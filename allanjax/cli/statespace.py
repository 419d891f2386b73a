"""The command `allanjax statespace`."""

from pathlib import Path
from typing import Annotated, Literal

import typer

from allanjax.cli.common import SavedFit, epilog, failures_told, measured_axis, prepare, saved_fit

HELP = (
    "Write the matrices A, H, Q, R and P0 of a Kalman filter for the noise of a fitted axis: x' = A x + w, "
    "z = H x + v, with the states' names and units, in SI."
)
EPILOG = epilog(
    "allanjax statespace allanjax-results/imu.json --axis gyro_x --out gyro_x.npz",
    "allanjax statespace imu.json --axis gyro_x --rate 200 --format c --out gyro_x.h",
)


def command(
    result: SavedFit,
    out: Annotated[Path, typer.Option("--out", "-o", help="File to write.")],
    axis: Annotated[str, typer.Option(help="Which axis, e.g. gyro_x.")],
    rate: Annotated[
        float | None, typer.Option(help="Sample rate of the filter in Hz; by default that of the recording.")
    ] = None,
    duration: Annotated[
        float | None,
        typer.Option(
            help="How long the filter runs in s, by default the recording's length: bias instability is a "
            "sum of Gauss–Markov processes up to there."
        ),
    ] = None,
    form: Annotated[
        Literal["npz", "matlab", "c"], typer.Option("--format", help="NumPy file, MATLAB script or C header.")
    ] = "npz",
) -> None:
    prepare()
    with failures_told():
        fit = saved_fit(result)
        found = measured_axis(fit, axis, result)
        # A filter in front of the samples is that of the recording's rate.
        length = fit.curve.n / fit.curve.rate if duration is None else duration
        rate = fit.curve.rate if rate is None else rate
        space = found.model.state_space(rate, duration=length, sensor=found.axis.sensor)
        if form == "npz":
            space.to_numpy(out)
        else:
            text = space.to_matlab() if form == "matlab" else space.to_c_header()
            out.write_text(text, encoding="utf-8")
    print(space)
    print(f"wrote {out}")

"""The command `allanjax horizon`."""

from typing import Annotated

import typer

from allanjax.cli.common import epilog, failures_told, prepare
from allanjax.cli.saved_fits import SavedFit, saved_fit

HELP = (
    "Say which white noise N and random walk K a Kalman filter needs that is corrected every so many "
    "seconds: those that predict the error of the whole fitted model, and those that bound it."
)
EPILOG = epilog(
    "allanjax horizon allanjax-results/imu.json --horizon 10",
    "allanjax horizon imu.json --horizon 60 --axis gyro_x --probability 0.99",
)


def command(
    result: SavedFit,
    seconds: Annotated[float, typer.Option("--horizon", help="Time between corrections in s.")],
    axis: Annotated[str | None, typer.Option(help="One axis, e.g. gyro_x; by default all.")] = None,
    probability: Annotated[float, typer.Option(help="That of the bounds.")] = 0.95,
) -> None:
    prepare()
    from allanjax.estimate.horizon import horizon

    with failures_told():
        fit = saved_fit(result)
        print(horizon(fit, seconds, axes=axis, probability=probability))

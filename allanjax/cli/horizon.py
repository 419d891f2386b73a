"""The command `allanjax horizon`."""

from typing import Annotated, Literal

import typer

from allanjax.cli.common import OptionalFit, Sheet, epilog, failures_told, fit_or_sheet, prepare, print_json

HELP = (
    "Say which white noise N and random walk K (or Gauss–Markov process) a Kalman filter needs that is "
    "corrected every so many seconds: those that predict the error of the whole fitted model, and those that "
    "bound it."
)
EPILOG = epilog(
    "allanjax horizon allanjax-results/imu.json --horizon 10",
    "allanjax horizon imu.json --horizon 60 --axis gyro_x --probability 0.99",
    "allanjax horizon --sheet BMI088 --horizon 10",
    "allanjax horizon imu.json --horizon 10 --process markov --json",
)


def command(
    seconds: Annotated[float, typer.Option("--horizon", help="Time between corrections in s.")],
    result: OptionalFit = None,
    sheet: Sheet = None,
    axis: Annotated[str | None, typer.Option(help="One axis, e.g. gyro_x; by default all.")] = None,
    process: Annotated[
        Literal["walk", "markov"],
        typer.Option(help="What the bias is to the filter: a random walk, or a Gauss–Markov process."),
    ] = "walk",
    probability: Annotated[float, typer.Option(help="That of the bounds.")] = 0.95,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON instead of a table.")] = False,
) -> None:
    prepare()
    from allanjax.estimate.horizon import horizon

    with failures_told():
        fit = fit_or_sheet(result, sheet)
        found = horizon(fit, seconds, process=process, axes=axis, probability=probability)
    if as_json:
        print_json(found.to_dict())
    else:
        print(found)

"""The command `allanjax horizon`."""

from typing import Annotated, Literal

import typer

from allanjax.cli.common import OptionalFit, Sheet, epilog, fit_or_sheet, prepare, print_result, user_errors

HELP = (
    "Find the white noise N and random walk K to use in a Kalman filter that is corrected at regular "
    "intervals: values that predict the errors of the full noise model, and values that bound them. The bias "
    "can be a Gauss–Markov process instead of a random walk."
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
    axis: Annotated[str | None, typer.Option(help="Axis, e.g. gyro_x; by default all axes.")] = None,
    process: Annotated[
        Literal["walk", "markov"],
        typer.Option(help="How the filter models the bias: as a random walk or a Gauss–Markov process."),
    ] = "walk",
    probability: Annotated[float, typer.Option(help="Probability that the bounds hold.")] = 0.95,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON instead of a table.")] = False,
) -> None:
    prepare()
    from allanjax.estimate.horizon import horizon

    with user_errors():
        fit = fit_or_sheet(result, sheet)
        noise = horizon(fit, seconds, process=process, axes=axis, probability=probability)
    print_result(noise, as_json)

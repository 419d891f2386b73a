"""The command `allanjax calibrate`."""

import math
from pathlib import Path
from typing import Annotated

import typer
from typer import Argument, Option

from allanjax.base.errors import AllanjaxError
from allanjax.cli.common import RESULTS, Out, prepare, print_result, saved_fit, stage, write_result
from allanjax.cli.options import FigureFormat, command
from allanjax.record.io import ReadOptions, read_recording


@command(
    """Calibrate gyros and accelerometers from recordings at rest in several orientations, as in a
    six-position test. Estimates the bias, scale factor and misalignment of each axis; the intervals
    follow from the noise model and include drift between the positions. Writes calibration.json and
    calibration.png.""",
    "allanjax calibrate x_up.csv x_down.csv y_up.csv y_down.csv z_up.csv z_down.csv --latitude 51",
    "allanjax calibrate up.csv down.csv --gravity 9.8122 --fit allanjax-results/long.json",
    "allanjax calibrate --position x+=a.csv --position 'x down, y north=b.csv' --latitude 51 --json",
    "allanjax calibrate --position z+=calgary.csv --position z+=quito.csv --gravity 9.8082,9.7726",
)
def calibrate(
    reading: ReadOptions,
    files: Annotated[
        list[str] | None,
        Argument(
            metavar="FILE",
            help="Recordings in time order. File names give the axis that points up or down: "
            "imu_x_up.csv, or down.csv for z. If no name does, the orientations are estimated "
            "(accelerometers only, nine positions or more).",
        ),
    ] = None,
    position: Annotated[
        list[str] | None,
        Option(
            help="A recording with its orientation: x+=FILE, 'z down=FILE' or 'x up, y north=FILE'.",
        ),
    ] = None,
    latitude: Annotated[
        float | None,
        Option(help="Latitude in deg, for normal gravity and (gyros) the Earth's rotation rate."),
    ] = None,
    height: Annotated[float, Option(help="Height in m, for normal gravity.")] = 0.0,
    gravity: Annotated[
        str | None,
        Option(
            help="Local gravity in m/s^2, if known; of recordings at several places that of each, "
            "e.g. 9.8082,9.7726."
        ),
    ] = None,
    starts: Annotated[
        str | None,
        Option(
            help="Start time of each recording in s, e.g. 0,620,1240. By default each starts where "
            "the one before ends."
        ),
    ] = None,
    second_order: Annotated[
        bool,
        Option("--second-order", help="Estimate the second-order scale factor of accelerometers."),
    ] = False,
    orientation_error: Annotated[
        float,
        Option(help="Standard deviation of the orientations in deg, about each transverse axis."),
    ] = 0.0,
    fit: Annotated[
        Path | None,
        Option(
            "--fit",
            metavar="RESULT.json",
            help="Noise model: result of allanjax characterize for a long recording of the same "
            "sensor. By default the longest position is fitted.",
        ),
    ] = None,
    as_is: Annotated[
        bool, Option("--as-is", help="Use the whole recordings, including disturbed parts.")
    ] = False,
    out: Out = None,
    figure_format: FigureFormat = "png",
    as_json: Annotated[bool, Option("--json", help="Print JSON instead of the table.")] = False,
) -> None:
    directory = out if as_json else out or RESULTS
    prepare(directory)
    from allanjax.calibration.static_positions import calibrate, world_of

    named = [*((None, file) for file in files or ()), *map(_split, position or ())]
    if not named:
        raise typer.BadParameter("give recordings, as FILE or as --position x+=FILE")
    local = None if gravity is None else _numbers("--gravity", gravity, "9.8082,9.7726")
    world_of(latitude, height, local)
    with stage("reading"):
        recordings = [read_recording(Path(file), reading, file) for _, file in named]
        told = [o or r.name for (o, _), r in zip(named, recordings, strict=True)]
        noise = None if fit is None else saved_fit(fit)
    with stage("calibrating (without --fit the noise is fitted first)"):
        result = calibrate(
            recordings,
            told if position else None,
            latitude=latitude,
            height=height,
            gravity=local,
            fit=noise,
            starts=None if starts is None else _numbers("--starts", starts, "0,620,1240"),
            second_order=second_order,
            orientation_error=math.radians(orientation_error),
            as_is=as_is,
        )
    print_result(result, as_json, write_result(result, directory, "calibration", figure_format))


def _split(text: str) -> tuple[str, str]:
    """Orientation and file of `x+=FILE`."""
    orientation, equals, file = text.partition("=")
    if not (equals and file):
        raise AllanjaxError(f"--position {text!r}: give an orientation and a file, e.g. x+=FILE")
    return orientation, file


def _numbers(option: str, text: str, example: str) -> list[float]:
    try:
        return [float(part) for part in text.split(",")]
    except ValueError as error:
        message = f"{option} {text!r}: give numbers, separated by commas: {example}"
        raise AllanjaxError(message) from error

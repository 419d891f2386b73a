"""The command `allanjax calibrate`."""

import math
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from allanjax.base.errors import AllanjaxError
from allanjax.cli.common import RESULTS, prepare, print_result, refuse, saved_fit, stage, write_result
from allanjax.cli.options import Figures, Reading
from allanjax.record.io import read_recording


def calibrate(
    *files: Annotated[str, Parameter(name="FILE")],
    reading: Reading = Reading(),
    position: tuple[str, ...] = (),
    latitude: float | None = None,
    height: float = 0.0,
    gravity: str | None = None,
    starts: str | None = None,
    second_order: bool = False,
    orientation_error: float = 0.0,
    fit: Path | None = None,
    as_is: bool = False,
    out: Path | None = None,
    format: Figures = "png",
    json: bool = False,
) -> None:
    """Calibrate gyros and accelerometers from recordings at rest in several orientations.

    As in a six-position test, estimates the bias, scale factor and misalignment
    of each axis; the intervals follow from the noise model and include drift
    between the positions. Writes calibration.json and calibration.png.

    For example:
      allanjax calibrate x_up.csv x_down.csv y_up.csv y_down.csv z_up.csv \\
          z_down.csv --latitude 51
      allanjax calibrate up.csv down.csv --gravity 9.8122 --fit long.json
      allanjax calibrate --position x+=a.csv --position 'x down, y north=b.csv' \\
          --latitude 51 --json
      allanjax calibrate --position z+=calgary.csv --position z+=quito.csv \\
          --gravity 9.8082,9.7726

    Parameters
    ----------
    files
        Recordings in time order. File names give the axis that points up or down: imu_x_up.csv,
        or down.csv for z. If no name does, the orientations are estimated (accelerometers only,
        nine positions or more).
    position
        A recording with its orientation: x+=FILE, 'z down=FILE' or 'x up, y north=FILE'.
    latitude
        Latitude in deg, for normal gravity and (gyros) the Earth's rotation rate.
    height
        Height in m, for normal gravity.
    gravity
        Local gravity in m/s^2, if known; of recordings at several places that of each, e.g.
        9.8082,9.7726.
    starts
        Start time of each recording in s, e.g. 0,620,1240. By default each starts where the one
        before ends.
    second_order
        Estimate the second-order scale factor of accelerometers.
    orientation_error
        Standard deviation of the orientations in deg, about each transverse axis.
    fit
        Noise model: result of allanjax characterize (RESULT.json) for a long recording of the
        same sensor. By default the longest position is fitted.
    as_is
        Use the whole recordings, including disturbed parts.
    out
        Folder for the results. Default: allanjax-results, or none with --json.
    format
        Format and suffix of the figures.
    json
        Print JSON instead of the table.
    """
    directory = out if json else out or RESULTS
    prepare(directory)
    from allanjax.calibration.static_positions import calibrate, world_of

    named = [*((None, file) for file in files), *map(_split, position)]
    if not named:
        refuse("give recordings, as FILE or as --position x+=FILE")
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
    print_result(result, json, write_result(result, directory, "calibration", format))


def _split(text: str) -> tuple[str, str]:
    """Orientation and file of `x+=FILE`."""
    orientation, file = [*text.split("=", 1), ""][:2]
    if not file:
        raise AllanjaxError(f"--position {text!r}: give an orientation and a file, e.g. x+=FILE")
    return orientation, file


def _numbers(option: str, text: str, example: str) -> list[float]:
    try:
        return [float(part) for part in text.split(",")]
    except ValueError as error:
        message = f"{option} {text!r}: give numbers, separated by commas: {example}"
        raise AllanjaxError(message) from error

"""The command `allanjax navigate`."""

from pathlib import Path
from typing import Annotated, Any

import typer

from allanjax.cli.common import (
    OptionalFit,
    Sheet,
    epilog,
    fit_or_sheet,
    prepare,
    print_json,
    print_written,
    user_errors,
)

HELP = (
    "Estimate how fast the attitude, velocity and position errors of a navigation system with these sensors "
    "grow at rest, and how accurately and how soon the sensors can find level and north."
)
EPILOG = epilog(
    "allanjax navigate allanjax-results/imu.json --latitude 51",
    "allanjax navigate --sheet BMI088 --latitude 51",
    "allanjax navigate imu.json --latitude 51 --azimuth 0.1deg --out navigation.png",
)


def command(
    latitude: Annotated[float, typer.Option(help="Latitude of the sensor in deg.")],
    result: OptionalFit = None,
    sheet: Sheet = None,
    azimuth: Annotated[
        str | None, typer.Option(help="Required accuracy (1σ) of the azimuth, e.g. 0.1deg.")
    ] = None,
    time: Annotated[
        list[float] | None,
        typer.Option(help="Time in s to report; repeat for more. Default: 1 s to 1000 s."),
    ] = None,
    calibration: Annotated[
        float, typer.Option(help="Time at rest before the start, in s, over which biases are averaged.")
    ] = 600.0,
    gyro_bias: Annotated[str, typer.Option(help="Residual bias (1σ) of the gyros.")] = "0 deg/h",
    accel_bias: Annotated[str, typer.Option(help="Residual bias (1σ) of the accelerometers.")] = "0 m/s²",
    schuler: Annotated[bool, typer.Option("--schuler", help="Include the Schuler loop.")] = False,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Figure to write, e.g. a.png.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON, in SI units.")] = False,
) -> None:
    prepare()
    from allanjax.navigation.alignment import align
    from allanjax.navigation.navigator import navigate

    with user_errors():
        fit = fit_or_sheet(result, sheet)
        biases: dict[str, Any] = {"gyro_bias": gyro_bias, "accel_bias": accel_bias}
        aligned = align(fit, latitude, azimuth, **biases)
        growth = navigate(fit, time, calibration=calibration, schuler=schuler, **biases)
        if out is not None:
            growth.plot(out)
    if as_json:
        print_json({"navigation": growth.to_dict(), "alignment": aligned.to_dict()})
    else:
        print(f"{growth}\n{aligned}")
    print_written([] if out is None else [out], as_json)

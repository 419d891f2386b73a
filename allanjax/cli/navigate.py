"""The command `allanjax navigate`."""

import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from allanjax.cli.common import OptionalFit, Sheet, epilog, failures_told, fit_or_sheet, prepare, print_json

HELP = (
    "Say how fast the errors of attitude, velocity and position grow in a navigator at rest with these "
    "sensors, and how well, and how soon, they level and find north."
)
EPILOG = epilog(
    "allanjax navigate allanjax-results/imu.json --latitude 51",
    "allanjax navigate --sheet BMI088 --latitude 51",
    "allanjax navigate imu.json --latitude 51 --azimuth 0.1deg --out navigation.png",
)


def command(
    latitude: Annotated[float, typer.Option(help="Where the sensor stands, in deg.")],
    result: OptionalFit = None,
    sheet: Sheet = None,
    azimuth: Annotated[
        str | None, typer.Option(help="Accuracy of the azimuth that is wanted, 1σ, e.g. 0.1deg.")
    ] = None,
    time: Annotated[
        list[float] | None, typer.Option(help="A time in s; give several. By default 1 s to 1000 s.")
    ] = None,
    calibration: Annotated[
        float, typer.Option(help="Time at rest before the start over which biases are averaged, in s.")
    ] = 600.0,
    gyro_bias: Annotated[str, typer.Option(help="What is left of the gyros' bias, 1σ.")] = "0 deg/h",
    accel_bias: Annotated[str, typer.Option(help="The same of the accelerometers.")] = "0 m/s²",
    schuler: Annotated[bool, typer.Option("--schuler", help="Include the Schuler loop.")] = False,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Picture to write, e.g. a .png.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON, in SI.")] = False,
) -> None:
    prepare()
    from allanjax.navigation.alignment import align
    from allanjax.navigation.navigator import navigate

    with failures_told():
        fit = fit_or_sheet(result, sheet)
        biases: dict[str, Any] = {"gyro_bias": gyro_bias, "accel_bias": accel_bias}
        aligned = align(fit, latitude, azimuth, **biases)
        growth = navigate(fit, time, calibration=calibration, schuler=schuler, **biases)
        if out is not None:
            growth.plot(out)
    if as_json:
        print_json({"navigation": growth.to_dict(), "alignment": aligned.to_dict()})
    else:
        print(growth)
        print(aligned)
    if out is not None:
        print(f"wrote {out}", file=sys.stderr if as_json else sys.stdout)

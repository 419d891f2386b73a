"""The command `allanjax convert`."""

import math
from typing import Literal

import typer

from allanjax.cli.common import print_result, user_errors
from allanjax.cli.options import command


@command(
    "allanjax convert 0.003 deg/s/√Hz --to 'deg/sqrt(h)'",
    "allanjax convert 150 ug/rtHz --to m/s/√h --sided one",
    "allanjax convert --sheet BMI088",
    "allanjax convert --sheet my-sensor.toml",
    "allanjax convert --list",
)
def convert(
    value: float | None = None,
    unit: str | None = None,
    to: str | None = None,
    sided: Literal["one", "two"] | None = None,
    sheet: str | None = None,
    show_list: bool = False,
    as_json: bool = False,
) -> None:
    """Convert a value from one unit to another, or the values in a data sheet to noise coefficients. Write
    roots as √Hz, sqrt(Hz) or rt-Hz. A density per √Hz is one- or two-sided: without --sided, both results
    are printed.

    Args:
        value (VALUE): The number.
        unit (UNIT): Its unit.
        to: Unit to convert to.
        sided: Whether a density per √Hz is one-sided, as in data sheets, or two-sided.
        sheet: Data sheet to convert to noise coefficients: a sensor listed by --list, or a TOML file.
        show_list (--list): List the sensors with a built-in data sheet and exit.
        as_json (--json): Print JSON; needs --sheet.
    """
    if show_list:
        from allanjax.noise.datasheet import known_sheets

        for name, figures in known_sheets().items():
            print(f"{name:12} {figures['source']}")
        return
    if (sheet is None) == (value is None) or (sheet is not None and (to or sided)):
        raise typer.BadParameter("give VALUE UNIT --to UNIT, or --sheet SHEET")
    if sheet is not None:
        from allanjax.noise.datasheet import datasheet

        with user_errors():
            values = datasheet(sheet)
        print_result(values, as_json)
        return
    if unit is None or to is None or as_json:
        raise typer.BadParameter("give VALUE UNIT --to UNIT, e.g. 3 deg/s/√Hz --to deg/√h")
    with user_errors():
        for line in _converted(float(value or 0.0), unit, to, sided):
            print(line)


def _converted(value: float, unit: str, to: str, sided: Literal["one", "two"] | None) -> list[str]:
    """Lines with the value in the other unit: one, or one per kind of density if that is not given."""
    from allanjax.record.units import convert, density_power

    number = convert(value, unit, to)
    power = density_power(unit) - density_power(to)
    if power == 0.0:
        return [f"{value:g} {unit} = {number:.6g} {to}"]
    one = f"{value:g} {unit} = {number / math.sqrt(2.0) ** (2.0 * power):.6g} {to}"
    two = f"{value:g} {unit} = {number:.6g} {to}"
    if sided is not None:
        return [f"{one if sided == 'one' else two} ({sided}-sided density)"]
    return [
        f"{one} if the density is one-sided, as usual in data sheets (--sided one)",
        f"{two} if it is two-sided, as in IEEE 952 and in allanjax (--sided two)",
    ]

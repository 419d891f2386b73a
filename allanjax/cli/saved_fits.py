"""Axes of fits that a command reads from a file."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from allanjax.base.errors import AllanjaxError

if TYPE_CHECKING:
    from allanjax.estimate.result import AxisFit, Fit
    from allanjax.noise.datasheet import DataSheet

SavedFit = Annotated[
    Path, typer.Argument(help="What allanjax characterize wrote: NAME.json.", metavar="RESULT.json")
]


OptionalFit = Annotated[
    Path | None,
    typer.Argument(help="What allanjax characterize wrote, or a data sheet .toml.", metavar="RESULT.json"),
]
Sheet = Annotated[
    str | None,
    typer.Option(help="A data sheet instead: a sensor of allanjax convert --list, or a file of TOML."),
]


def fit_or_sheet(path: Path | None, sheet: str | None) -> "Fit | DataSheet":
    """The fit in a file, or a data sheet by its name or in a file; AllanjaxError if there is none."""
    from allanjax.noise.datasheet import datasheet

    if (path is None) == (sheet is None):
        raise AllanjaxError("give one: a result, such as allanjax-results/imu.json, or --sheet SENSOR")
    if sheet is not None:
        return datasheet(sheet)
    assert path is not None
    return datasheet(path) if path.suffix == ".toml" else saved_fit(path)


def saved_fit(path: Path) -> "Fit":
    """The fit in a file; AllanjaxError if there is none, or more than one."""
    from allanjax.estimate.as_json import load

    found = load(path)
    if not isinstance(found, dict):
        return found
    if len(found) != 1:
        raise AllanjaxError(
            f"{path}: holds {len(found)} fits, {', '.join(found)}; characterize them without --json "
            "and give one NAME.json"
        )
    return next(iter(found.values()))


def measured_axis(fit: "Fit", name: str, path: Path) -> "AxisFit":
    """The fit of an axis; AllanjaxError if it is no measurement of the sensor."""
    axis = fit[name]
    if not axis.measured:
        raise AllanjaxError(f"{path}: {name}: {axis.verdict}")
    return axis

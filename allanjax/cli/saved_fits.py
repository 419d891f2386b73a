"""Axes of fits that a command reads from a file."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from allanjax.base.errors import AllanjaxError

if TYPE_CHECKING:
    from allanjax.estimate.result import AxisFit, Fit

SavedFit = Annotated[
    Path, typer.Argument(help="What allanjax characterize wrote: NAME.json.", metavar="RESULT.json")
]


def saved_fit(path: Path) -> "Fit":
    """The fit in a file; AllanjaxError if there is none, or more than one."""
    from allanjax.estimate.loading import load

    found = load(path)
    if not isinstance(found, dict):
        return found
    if len(found) != 1:
        raise AllanjaxError(f"{path}: it holds {len(found)} fits; give the file of one of them")
    return next(iter(found.values()))


def measured_axis(fit: "Fit", name: str, path: Path) -> "AxisFit":
    """The fit of an axis; AllanjaxError if it is no measurement of the sensor."""
    axis = fit[name]
    if not axis.measured:
        raise AllanjaxError(f"{path}: {name}: {axis.verdict}")
    return axis

"""The command `allanjax compare`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from allanjax.base.errors import AllanjaxError
from allanjax.cli.common import Input, prepare, print_result, stage, user_errors
from allanjax.cli.options import command
from allanjax.cli.recordings import read_and_fit
from allanjax.fleet.options import FitOptions

if TYPE_CHECKING:
    from allanjax.estimate.result import Fit


@command(
    "allanjax compare cimu hg1700 motionpak2",
    "allanjax compare allanjax-results/imu.json BMI088 --out comparison.html",
    "allanjax compare before.csv after.csv --label before --label after",
)
def compare(
    sensors: Annotated[
        list[str],
        typer.Argument(
            help="Recordings, results of characterize (NAME.json), data sheets (.toml, or a name listed by "
            "allanjax convert --list), or presets: cimu, hg1700, motionpak2.",
            metavar="SENSOR",
        ),
    ],
    options: FitOptions,
    label: Annotated[
        list[str] | None, typer.Option(help="What to call a sensor; repeat for each, in their order.")
    ] = None,
    reference: Annotated[
        str | None, typer.Option(help="Sensor that the others are compared with. Default: the first.")
    ] = None,
    out: Annotated[
        list[Path] | None,
        typer.Option(
            "--out", "-o", help="Figure (.png, .svg, .pdf), page (.html) or table (.csv); repeat for more."
        ),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON instead of tables.")] = False,
) -> None:
    """Compare sensors of any grade: coefficients with intervals, ratios and whether they differ, Allan
    deviations over one another, drift after 1 min, 10 min and 1 h, and growth of heading and position errors.
    Two recordings of one sensor, before and after a change of the setup, are compared in the same way.
    """
    prepare()
    from allanjax.comparison.compare import compare as compared
    from allanjax.record.io.formats import name_of

    with user_errors():
        data = [_opened(name, options) for name in sensors]
        with stage("comparing"):
            names = label or [name_of(Path(name)) if Path(name).suffix else name for name in sensors]
            result = compared(*data, labels=names, reference=0 if reference is None else reference)
            for path in out or ():
                if path.suffix == ".csv":
                    result.to_dataframe().to_csv(path, index=False)
                elif path.suffix in (".html", ".htm"):
                    from allanjax.presentation.page.report import report

                    report(result, path)
                else:
                    result.plot(path)
    print_result(result, as_json, out or ())


def _opened(name: str, options: FitOptions) -> "str | Fit":
    """The fit of a recording with these options; anything else by its name."""
    from allanjax.record.io.formats import name_of

    path = Path(name)
    if path.suffix in (".json", ".toml", "") or not path.exists():
        return name
    found = read_and_fit(Input(path, name, name_of(path)), options)[-1]
    if not any(result.converged for result in found.results):
        raise AllanjaxError(f"{name}: no axis has a result; allanjax characterize prints the reasons")
    return found

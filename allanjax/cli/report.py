"""The command `allanjax report`."""

from pathlib import Path
from typing import TYPE_CHECKING

import typer

from allanjax.base.errors import MixedRatesError
from allanjax.cli.common import (
    FAILURES,
    Files,
    Input,
    exit_if_failed,
    fitting,
    inputs,
    prepare,
    print_written,
    reason,
    reported,
    saved_fit,
    stage,
)
from allanjax.cli.options import command
from allanjax.cli.pages import origin
from allanjax.cli.recordings import read_and_fit
from allanjax.fleet.options import FitOptions

if TYPE_CHECKING:
    from allanjax.presentation.page.report import Reported


@command(
    "allanjax report imu.csv --out report.html",
    "allanjax report imu.csv --quick --out report.html",
    "allanjax report allanjax-results/imu.json --out report.html",
)
def report(
    files: Files,
    options: FitOptions,
    out: Path = Path("report.html"),
    quick: bool = False,
) -> None:
    """Write one page of HTML about static recordings or saved results: verdict, coefficients with
    intervals, interactive curves, what a simulation of the sensor gets wrong, predicted drift and exports.
    The page needs no network, and prints to PDF.

    Args:
        out (--out, -o): Page to write.
        quick: Without the critique, which takes longer than all the rest.
    """
    if out.suffix.lower() not in (".html", ".htm"):
        raise typer.BadParameter(f"{str(out)!r}: a page is named .html", param_hint="--out")
    prepare(out.parent)
    errors: list[dict[str, str]] = []
    parts: list[Reported] = []
    with inputs(files, out.parent) as given:
        pending = list(given)
        while pending:
            file = pending.pop(0)
            try:
                parts.append(_reported(file, options, quick))
            except MixedRatesError as mixed:
                pending = [*file.of(mixed.sensors), *pending]
            except FAILURES as failure:
                errors.append(reported(file, reason(failure, file.label)))
    if parts:
        from allanjax.presentation.page.report import page_about

        with stage("writing the page"):
            page_about(parts).save(out)
        print_written([out])
    exit_if_failed(errors, len(given))


def _reported(file: Input, options: FitOptions, quick: bool) -> "Reported":
    """What is shown of a file: of a result its fit, of a recording everything."""
    from allanjax.presentation.page.report import Reported

    if file.path.suffix == ".json":
        return Reported(saved_fit(file.path), origin=origin(file))
    recording, check, spectrum, fit = read_and_fit(file, options)
    critique = None
    if not quick:
        with fitting(file, recording) as show:
            from allanjax.critic.critique import critique as criticize

            tell = lambda text: show(f"{file.label}: {text}")  # noqa: E731
            critique = criticize(recording, vibrating=options.vibrating, progress=tell)
    return Reported(fit, critique, recording, spectrum, check, origin(file))

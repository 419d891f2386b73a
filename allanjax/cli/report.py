"""The command `allanjax report`, and pages of the other commands."""

import hashlib
import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any
from urllib.parse import quote

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
from allanjax.fleet.options import FitOptions

if TYPE_CHECKING:
    from allanjax.fleet.fleet import FleetResult
    from allanjax.presentation.page.report import Reported

#: Whether a command writes a page, too.
Html = Annotated[bool, typer.Option("--html", help="Also write a page, NAME.html, to open in a browser.")]


@command(
    "allanjax report imu.csv --out report.html",
    "allanjax report imu.csv --quick --out report.html",
    "allanjax report allanjax-results/imu.json --out report.html",
)
def report(
    files: Files,
    options: FitOptions,
    out: Annotated[Path, typer.Option("--out", "-o", help="Page to write.")] = Path("report.html"),
    quick: Annotated[
        bool, typer.Option("--quick", help="Without the critique, which takes longer than all the rest.")
    ] = False,
) -> None:
    """Write one page of HTML about static recordings or saved results: verdict, coefficients with
    intervals, interactive curves, what a simulation of the sensor gets wrong, predicted drift and exports.
    The page needs no network, and prints to PDF.
    """
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
    from allanjax.cli.recordings import read_and_fit
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


def write_page(file: Input, folder: Path, *shown: Any) -> Path:
    """Write the page NAME.html of a file, given the fields of `Reported` but its origin."""
    from allanjax.presentation.page.report import Reported, page_about

    return page_about([Reported(*shown)._replace(origin=origin(file))]).save(folder / f"{file.name}.html")


def origin(file: Input) -> dict[str, str]:
    """What a page states about its origin: the command, and the file with its size and hash."""
    with file.path.open("rb") as stream:
        digest = hashlib.file_digest(stream, "sha256").hexdigest() if file.path.is_file() else "a folder"
    return {
        "command": shlex.join(["allanjax", *sys.argv[1:]]),
        "file": f"{file.label}, {file.path.stat().st_size:,} bytes",
        "SHA-256": digest,
    }


def fleet_page(result: "FleetResult", out: Path) -> list[Path]:
    """Write the page of a fleet, and of each unit with a result that has none yet."""
    from allanjax.estimate.as_json import load
    from allanjax.presentation.page.report import Reported, page_about, report

    folder, pages = out / "recordings", dict[str, str]()
    names = result.table["recording"].unique()
    with stage("fleet: writing pages") as show:
        for k, name in enumerate(names):
            own, made = folder / f"{name}.json", folder / f"{name}.html"
            if own.is_file() and not (made.is_file() and made.stat().st_mtime >= own.stat().st_mtime):
                show(f"fleet: {k} of {len(names)} pages written")
                fits = load(own)
                page_about(
                    [Reported(fit) for fit in (fits.values() if isinstance(fits, dict) else [fits])]
                ).save(made)
            if made.is_file():
                pages[name] = f"recordings/{quote(made.name)}"
        report(result, out / "fleet.html", pages=pages)
    return [out / "fleet.html"]

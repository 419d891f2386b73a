"""Pages of HTML that commands write beside their other files."""

import hashlib
import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

from allanjax.cli.common import Input, stage

if TYPE_CHECKING:
    from allanjax.fleet.fleet import FleetResult


def write_page(file: Input, folder: Path, *shown: Any) -> Path:
    """Write the page NAME.html of a file, given the fields of `Reported` but its origin."""
    from allanjax.presentation.page.report import page_about
    from allanjax.presentation.page.sections import Reported

    return page_about([Reported(*shown)._replace(origin=origin(file))]).save(folder / f"{file.name}.html")


def origin(file: Input) -> dict[str, str]:
    """What a page states about its origin: the command, and the file with its size and hash."""
    known = {"command": shlex.join(["allanjax", *sys.argv[1:]]), "file": file.label}
    if file.path.is_file():
        with file.path.open("rb") as stream:
            digest = hashlib.file_digest(stream, "sha256").hexdigest()
        known |= {"size": f"{file.path.stat().st_size:,} bytes", "SHA-256": digest}
    return known


def fleet_page(result: "FleetResult", out: Path) -> list[Path]:
    """Write the page of a fleet, and of each unit with a result that has none yet."""
    from allanjax.estimate.as_json import load
    from allanjax.presentation.page.report import report

    folder, pages = out / "recordings", dict[str, str]()
    names = result.table["recording"].unique()
    with stage("fleet: writing pages") as show:
        for k, name in enumerate(names):
            own, made = folder / f"{name}.json", folder / f"{name}.html"
            if own.is_file() and not (made.is_file() and made.stat().st_mtime >= own.stat().st_mtime):
                show(f"fleet: {k} of {len(names)} pages written")
                fits = load(own)
                report([*fits.values()] if isinstance(fits, dict) else fits, made)
            if made.is_file():
                pages[name] = f"recordings/{quote(made.name)}"
        report(result, out / "fleet.html", pages=pages)
    return [out / "fleet.html"]

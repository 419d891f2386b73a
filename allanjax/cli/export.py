"""The command `allanjax export`."""

import sys
from pathlib import Path
from typing import Annotated

import typer

from allanjax.base.errors import AllanjaxError
from allanjax.cli.common import Sheet, epilog, failures_told, fit_or_sheet
from allanjax.report.export.exporting import Axes, converted, exported
from allanjax.report.export.targets import TARGETS

HELP = (
    "Write a result, a data sheet or another target's file as an estimator's, autopilot's or simulator's "
    "parameters."
)
EPILOG = epilog(
    "allanjax export --list",
    "allanjax export allanjax-results/imu.json --to kalibr -o imu.yaml",
    "allanjax export allanjax-results/imu.json --to vins-mono --rate 200",
    "allanjax export --sheet BMI088 --to kalibr",
    "allanjax export allanjax-results/imu.json --to gz-sim --axes worst",
    "allanjax export imu.yaml --from kalibr --to vins-mono",
)


def command(
    result: Annotated[
        Path | None,
        typer.Argument(
            help="NAME.json that characterize or fleet wrote; with --from a target's own file.",
            metavar="RESULT.json",
        ),
    ] = None,
    to: Annotated[str | None, typer.Option(help="A target of --list.", metavar="TARGET")] = None,
    source: Annotated[
        str | None,
        typer.Option("--from", help="The target whose own file it is, to convert it.", metavar="TARGET"),
    ] = None,
    sheet: Sheet = None,
    axes: Annotated[
        Axes | None,
        typer.Option(
            help="The largest value of the axes, their mean, or each where the target holds three; by "
            "default each where it does, else the worst."
        ),
    ] = None,
    rate: Annotated[
        float | None,
        typer.Option(
            help="Rate in Hz of the target's steps or samples; by default that of the recording or the file, "
            "and of autopilots that of their filter."
        ),
    ] = None,
    force: Annotated[
        bool, typer.Option("--force", help="Export what is not a measurement of the sensor, too.")
    ] = False,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="File to write; by default the standard output.")
    ] = None,
    show_list: Annotated[bool, typer.Option("--list", help="List the targets and exit.")] = False,
) -> None:
    if show_list:
        for target in TARGETS.values():
            keys = dict.fromkeys(key.called for key in target.noise_keys)
            print(f"{target.name:19} {target.title}: {', '.join(keys)}")
        return
    if to is None:
        raise typer.BadParameter("give a target of --list, e.g. kalibr", param_hint="--to")
    with failures_told():
        if source is None:
            made = exported(fit_or_sheet(result, sheet), to, axes=axes, rate=rate, force=force)
        elif result is None:
            raise AllanjaxError("give the file that is to be converted")
        else:
            made = converted(_text(result), source, to, axes=axes, rate=rate, name=str(result))
        if out is None:
            print(made.text, end="")
        else:
            out.write_text(made.text, encoding="ascii")
            print(f"wrote {out}")
        for words in made.left_out:
            print(f"warning: {words}", file=sys.stderr)


def _text(path: Path) -> str:
    """The text of a file; AllanjaxError if it is none."""
    try:
        return path.read_text(encoding="utf-8")
    except ValueError as error:
        raise AllanjaxError(f"{path}: not a text: {error}") from error

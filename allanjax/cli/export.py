"""The command `allanjax export`."""

import sys
from pathlib import Path
from typing import Annotated, Literal

import typer

from allanjax.base.errors import AllanjaxError
from allanjax.cli.common import Sheet, epilog, fit_or_sheet, user_errors

HELP = (
    "Write noise parameters for an estimator, autopilot or simulator, from a result, a data sheet or another "
    "target's file."
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
            help="Result of characterize or fleet (NAME.json); with --from, that target's file.",
            metavar="RESULT.json",
        ),
    ] = None,
    to: Annotated[str | None, typer.Option(help="Target listed by --list.", metavar="TARGET")] = None,
    source: Annotated[
        str | None,
        typer.Option("--from", help="Convert a file of this target.", metavar="TARGET"),
    ] = None,
    sheet: Sheet = None,
    axes: Annotated[
        Literal["each", "worst", "mean"] | None,
        typer.Option(
            help="Value per axis (if the target has one per axis), largest value of the axes, or their mean. "
            "Default: each if the target has it, else worst."
        ),
    ] = None,
    rate: Annotated[
        float | None,
        typer.Option(
            help="Sample or step rate of the target in Hz. Default: the rate of the recording or file; for "
            "autopilots the rate of their filter."
        ),
    ] = None,
    force: Annotated[
        bool, typer.Option("--force", help="Also export axes that are not a measurement of the sensor.")
    ] = False,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="File to write. Default: standard output.")
    ] = None,
    show_list: Annotated[bool, typer.Option("--list", help="List the targets and exit.")] = False,
) -> None:
    from allanjax.report.export.targets import TARGETS

    if show_list:
        for target in TARGETS.values():
            keys = dict.fromkeys(key.called for key in target.noise_keys)
            print(f"{target.name:19} {target.title}: {', '.join(keys)}")
        return
    if to is None:
        raise typer.BadParameter("give a target, e.g. kalibr; --list shows them all", param_hint="--to")
    from allanjax.report.export.exporting import converted, exported

    with user_errors():
        if source is None:
            made = exported(fit_or_sheet(result, sheet), to, axes=axes, rate=rate, force=force)
        elif result is None:
            raise AllanjaxError("give the file to convert")
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
    """Text of a file; AllanjaxError if it is not text."""
    try:
        return path.read_text(encoding="utf-8")
    except ValueError as error:
        raise AllanjaxError(f"{path}: not a text file: {error}") from error

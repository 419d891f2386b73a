"""The command line: `allanjax check`, `characterize`, `critique`, `fleet` and others."""

import logging
import os
import sys
import warnings
from importlib import import_module
from typing import Annotated

import typer

from allanjax.base.errors import AllanjaxWarning
from allanjax.base.tables import speak_plainly
from allanjax.cli.common import INTERRUPTED, epilog

app = typer.Typer(
    name="allanjax",
    help="Noise coefficients of gyros and accelerometers from a static recording, with honest uncertainties.",
    epilog=epilog("allanjax demo", "allanjax characterize imu.csv", "allanjax characterize --help"),
    add_completion=False,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
)


# Without a handler Python prints what libraries log.
_SILENT = logging.NullHandler()


def main() -> None:
    """Entry point of the command `allanjax`."""
    for stream in (sys.stdout, sys.stderr):
        speak_plainly(stream)
    try:
        app(prog_name="allanjax")
    except SystemExit as end:
        if end.code == INTERRUPTED:
            print("interrupted", file=sys.stderr)
        raise


def _show_version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        print(f"allanjax {version('allanjax')}")
        raise typer.Exit


@app.callback()
def _common(
    version: Annotated[
        bool,
        typer.Option("--version", callback=_show_version, is_eager=True, help="Show the version and exit."),
    ] = False,
) -> None:
    # What libraries warn of, with paths and lines, is of no use to who runs a command.
    warnings.showwarning = _show_own
    logging.getLogger().addHandler(_SILENT)
    # Of processes that the command starts, too.
    os.environ.setdefault("PYTHONWARNINGS", "ignore")


def _show_own(message: Warning | str, category: type[Warning], *_: object, **__: object) -> None:
    """Print a warning of allanjax on stderr, and no other."""
    if issubclass(category, AllanjaxWarning):
        print(f"warning: {message}", file=sys.stderr)


# The order of `allanjax --help`; each is in the module of its name: its help, examples and function.
_COMMANDS = "check characterize critique fleet export horizon navigate statespace kalman calibrate"
for _name in f"{_COMMANDS} simulate convert schema demo".split():
    _module = import_module(f"allanjax.cli.{_name}")
    app.command(_name, help=_module.HELP, epilog=_module.EPILOG)(_module.command)

"""The command line: `allanjax check`, `characterize`, `critique`, `fleet` and others."""

import gc
import logging
import os
import sys
import warnings
from typing import Annotated

import typer

from allanjax.base.errors import AllanjaxWarning
from allanjax.base.tables import speak_plainly
from allanjax.cli import calibrate, compare, fleet, recordings, results, simulate  # noqa: F401
from allanjax.cli.interrupt import end_on_interrupt
from allanjax.cli.options import COMMANDS, epilog

app = typer.Typer(
    name="allanjax",
    help="Estimate noise coefficients of gyros and accelerometers, with intervals, from static recordings.",
    epilog=epilog("allanjax demo", "allanjax characterize imu.csv", "allanjax characterize --help"),
    add_completion=False,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
)


# Without a handler Python prints what libraries log.
_SILENT = logging.NullHandler()


def main() -> None:
    """Run the command line."""
    end_on_interrupt()
    # Libraries make so many objects that looking for unused ones would take a tenth of a command's time.
    gc.set_threshold(200_000)
    for stream in (sys.stdout, sys.stderr):
        speak_plainly(stream)
    app(prog_name="allanjax")


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
    # Warnings of libraries, with paths and line numbers, do not help users of a command.
    warnings.showwarning = _show_own
    logging.getLogger().addHandler(_SILENT)
    # For processes that the command starts, too.
    os.environ.setdefault("PYTHONWARNINGS", "ignore")


def _show_own(message: Warning | str, category: type[Warning], *_: object, **__: object) -> None:
    """Print warnings of allanjax on stderr, and no others."""
    if issubclass(category, AllanjaxWarning):
        print(f"warning: {message}", file=sys.stderr)


# In the order of `allanjax --help`.
_ORDER = (
    "check characterize critique report compare spec fleet repeat export horizon navigate statespace kalman "
    "calibrate simulate convert schema demo"
)
for _name in _ORDER.split():
    _command, _about = COMMANDS[_name]
    app.command(_name, **_about)(_command)

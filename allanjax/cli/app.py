"""The command line: `allanjax check`, `characterize`, `critique`, `fleet` and others."""

import gc
import logging
import os
import re
import sys
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cyclopts import (
    App,
    ArgumentCollection,
    CoercionError,
    CycloptsError,
    Group,
    Parameter,
    UnknownOptionError,
)

from allanjax.base.errors import AllanjaxError, AllanjaxWarning
from allanjax.base.tables import speak_plainly
from allanjax.cli.calibrate import calibrate
from allanjax.cli.common import FAILURES, print_error, reason, refuse, remove_empty
from allanjax.cli.compare import compare, repeat
from allanjax.cli.fleet import fleet
from allanjax.cli.interrupt import INTERRUPTED, end_on_interrupt
from allanjax.cli.recordings import characterize, check, critique, report
from allanjax.cli.results import export, horizon, kalman, navigate, schema, spec, statespace
from allanjax.cli.simulate import convert, demo, simulate
from allanjax.cli.watch import watch

if TYPE_CHECKING:
    from cyclopts.help import HelpPanel

# In the order of `allanjax --help`.
_COMMANDS: tuple[Callable[..., None], ...] = (
    *(check, characterize, watch, critique, report, compare, spec, fleet, repeat, export, horizon),
    *(navigate, statespace, kalman, calibrate, simulate, convert, schema, demo),
)
# Without a handler Python prints what libraries log.
_SILENT = logging.NullHandler()


def _version() -> None:
    """Show the version and exit."""
    from importlib.metadata import version

    print(f"allanjax {version('allanjax')}")


def _check(_app: App, _commands: object, arguments: ArgumentCollection) -> None:
    """Refuse an unknown option in the place of a file, a rounded number, and none as a number or choice.

    Values may begin with a hyphen, as standard input, -, and the number -3 do.
    """
    for argument in arguments:
        kind = argument.resolved_hint
        for token in argument.tokens:
            text = token.value
            if token.keyword is None and re.match("--?[a-zA-Z]", text) and not Path(text).exists():
                raise UnknownOptionError(token=token, argument_collection=arguments)
            rounded = kind is int and "." in text
            limited = kind in (int, float) or argument.get_choices()
            if rounded or (limited and text.casefold() in ("none", "null")):
                raise CoercionError(token=token, argument=argument, target_type=kind)


def _show(console: Any, options: Any, panel: "HelpPanel") -> None:
    """Print the help of options, with lines as wide as the terminal, not as in the docstrings."""
    from cyclopts.help import DefaultFormatter

    for entry in panel.entries:
        text = entry.description.primary_renderable
        text.plain = " ".join(text.plain.split())
    DefaultFormatter()(console, options, panel)


_OPTIONS = Group("Options", help_formatter=_show)
app = App(
    "allanjax",
    """Estimate noise coefficients of gyros and accelerometers, with intervals, from static recordings.

    For example:
      allanjax demo
      allanjax characterize imu.csv
      allanjax characterize --help
    """,
    version_flags=(),
    default_parameter=Parameter(
        negative=(),
        # As in `--turn-rate "-5 deg/s"`; the last value of an option counts.
        allow_leading_hyphen=True,
        allow_repeating=True,
        show_default=lambda value: None if value is False or value == () else value,
    ),
    config=_check,
    help_format="plaintext",
    help_epilogue="Exit codes: 0 success; 1 an error, an axis without a result, a check that says stop, or a "
    "limit that is not met; 2 invalid command line; 3 a limit (--spec) that is undecided, or an aim "
    f"(--until) that was not reached; {INTERRUPTED} interrupted.",
    group_arguments=Group("Arguments", help_formatter=_show),
    group_parameters=_OPTIONS,
)
app["--help"].group = _OPTIONS
app.command(_version, name="--version", group=_OPTIONS)
for _place, _command in enumerate(_COMMANDS):
    app.command(_command, sort_key=_place)
    _help = app[_command.__name__]["--help"]
    _help.show, _help.group = True, _OPTIONS


def main() -> None:
    """Run the command line."""
    end_on_interrupt()
    # Libraries make so many objects that looking for unused ones would take a tenth of a command's time.
    gc.set_threshold(200_000)
    for stream in (sys.stdout, sys.stderr):
        speak_plainly(stream)
    run(sys.argv[1:])


def run(words: Sequence[str]) -> None:
    """Run a command, given the words of its command line; ends the program unless it succeeds."""
    # Warnings of libraries, with paths and line numbers, do not help users of a command.
    warnings.showwarning = _show_own
    logging.getLogger().addHandler(_SILENT)
    # For processes that the command starts, too.
    os.environ.setdefault("PYTHONWARNINGS", "ignore")
    try:
        command, bound = app.parse_args(words, print_error=False, exit_on_error=False)[:2]
    except CycloptsError as error:
        asked = " ".join(["allanjax", *(error.command_chain or ()), "--help"])
        refuse(f"{error}\nTry `{asked}`.")
    except AllanjaxError as error:
        refuse(str(error))
    try:
        command(*bound.args, **bound.kwargs)
    except BrokenPipeError:
        # Nobody reads any more, nor what is still to be written.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)
    except FAILURES as failure:
        print_error(reason(failure, "allanjax"))
        sys.exit(1)
    finally:
        remove_empty()
    if not words:
        sys.exit(2)


def _show_own(message: Warning | str, category: type[Warning], *_: object, **__: object) -> None:
    """Print warnings of allanjax on stderr, and no others."""
    if issubclass(category, AllanjaxWarning):
        print(f"warning: {message}", file=sys.stderr)

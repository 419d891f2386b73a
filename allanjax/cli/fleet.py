"""The command `allanjax fleet`."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from allanjax.cli.common import RESULTS, epilog, exit_if_failed, failures_told, prepare, print_error, stage
from allanjax.cli.options import with_options
from allanjax.fleet.options import FitOptions

if TYPE_CHECKING:
    from allanjax.fleet.fleet import Progress

HELP = (
    "Estimate the noise coefficients of many static recordings on a Dask cluster. Prints a summary, and "
    "writes fleet.parquet (one row a recording, axis and coefficient), fleet.png (how each coefficient is "
    "distributed over the fleet, outlying units marked), errors.csv, notes.txt (what to know before reading "
    "the table), and each recording's fit to recordings/NAME.json as soon as it is done. Where one of the "
    "files is bad, the others go on. A later run with the same --out computes only what is not there yet; "
    "the table is of the files that are named."
)
EPILOG = epilog(
    "allanjax fleet 'logs/*.parquet' --out results",
    r"allanjax fleet 'logs/**/*.parquet' --out results --group 'logs/(\w+)/'",
    "allanjax fleet 'logs/**/imu.csv' --rate 100 --gyro-unit deg/s --accel-unit g --terms 'N + B + K'",
    "allanjax fleet 'logs/*.parquet' --out results --scheduler tcp://cluster:8786",
)

_WRITTEN = ("fleet.parquet", "fleet.png", "errors.csv", "notes.txt")


@with_options
def command(
    patterns: Annotated[
        list[str],
        typer.Argument(
            help="Recordings, or patterns of them in quotes: * for any name, ** for any folders.",
            metavar="PATTERN",
        ),
    ],
    options: FitOptions,
    group: Annotated[
        str | None,
        typer.Option(
            help=r"Which units are alike and compared: a regular expression whose parentheses match the "
            r"group's name in a file's path, e.g. 'logs/(\w+)/', or a CSV file with columns file and group."
        ),
    ] = None,
    out: Annotated[
        Path, typer.Option(help="Folder for the results, from which a later run goes on.")
    ] = RESULTS,
    workers: Annotated[
        int | None, typer.Option(help="Processes on this machine; by default one a core.", min=1)
    ] = None,
    piece: Annotated[
        int, typer.Option(help="Samples; longer recordings are divided, and never in memory as a whole.")
    ] = 20_000_000,
    scheduler: Annotated[
        str | None,
        typer.Option(help="Address of a running Dask scheduler to use instead, e.g. tcp://cluster:8786."),
    ] = None,
) -> None:
    prepare(out)
    with stage("loading allanjax"):
        from allanjax.fleet.fleet import characterize_fleet
    with failures_told(), _progress_bar() as progress:
        result = characterize_fleet(
            patterns,
            out,
            group=group,
            workers=workers,
            scheduler=scheduler,
            piece=piece,
            progress=progress,
            **options.arguments(),
        )
    print(result, flush=True)
    print(f"wrote {', '.join(str(out / name) for name in _WRITTEN)}")
    for error in result.errors:
        print_error(f"{error['file']}: {error['message']}")
    exit_if_failed(result.errors, len(result.files))


@contextmanager
def _progress_bar() -> Iterator["Progress"]:
    """Show a bar on stderr, where that is a terminal; yields what moves it."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    console = Console(stderr=True)
    counts = TextColumn("{task.completed} of {task.total} done, {task.fields[failed]} failed")
    columns = (BarColumn(), counts, TimeElapsedColumn(), TextColumn("left"), TimeRemainingColumn())
    with Progress(*columns, console=console, disable=not console.is_terminal) as bar:
        task = bar.add_task("", total=None, failed=0)
        yield lambda done, failed, total: bar.update(task, completed=done, failed=failed, total=total)

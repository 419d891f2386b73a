"""The command `allanjax fleet`."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter
from cyclopts.validators import Number

from allanjax.cli.common import RESULTS, exit_by, exit_if_failed, prepare, print_error, print_result, stage
from allanjax.cli.options import Figures, Fitting
from allanjax.cli.pages import fleet_page

if TYPE_CHECKING:
    from allanjax.fleet.fleet import Progress


def fleet(
    *patterns: Annotated[str, Parameter(name="PATTERN", required=True)],
    how: Fitting = Fitting(),
    group: str | None = None,
    unit: str | None = None,
    spec: Path | None = None,
    out: Path = RESULTS,
    format: Figures = "png",
    html: bool = False,
    workers: Annotated[int | None, Parameter(validator=Number(gte=1))] = None,
    piece: int = 20_000_000,
    scheduler: str | None = None,
    json: bool = False,
) -> None:
    r"""Estimate the noise coefficients of many static recordings on a Dask cluster.

    Prints a summary and writes fleet.parquet (one row per recording, axis and
    coefficient), fleet.png (distribution of each coefficient over the fleet,
    outlying units marked), errors.csv, notes.txt (outlying units and problems;
    read it first), and recordings/NAME.json as soon as each recording is fitted.
    If one file fails, the others are still processed. A later run with the same
    --out only fits recordings without a result; the table covers only the files
    given.

    For example:
      allanjax fleet 'logs/*.parquet' --out results
      allanjax fleet 'logs/**/*.parquet' --out results --group 'logs/(\w+)/'
      allanjax fleet 'U*_day*.csv' --unit '(U\d+)_day' --spec limits.yaml
      allanjax fleet 'logs/**/imu.csv' --rate 100 --gyro-unit deg/s --terms 'N + B'
      allanjax fleet 'logs/*.parquet' --scheduler tcp://cluster:8786

    Parameters
    ----------
    patterns
        Recordings, or quoted patterns with * (any name) and ** (any folders).
    group
        Which units are compared with each other: a regular expression whose parentheses match the
        group's name in a file's path, e.g. 'logs/(\w+)/', or a CSV file with columns file, group.
        By default all are, or each of two groups that lie far apart.
    unit
        Which unit each recording is of, likewise, e.g. '(U\d+)_day'. Several recordings of a unit are
        judged together, and one that differs from the others of its unit is named.
    spec
        Check each recording against the limits in this YAML file (help(allanjax.check_spec)), and write
        fleet_spec.csv and fleet_spec.xml, JUnit XML. Exit code 1: a limit is not met; 3: none, but one
        is undecided.
    out
        Folder for the results; a later run continues from it.
    format
        Format and suffix of the figures.
    html
        Also write a page, NAME.html, to open in a browser.
    workers
        Processes on this machine; by default one per core.
    piece
        Samples per piece: longer recordings are read and processed in pieces.
    scheduler
        Address of a running Dask scheduler to use, e.g. tcp://cluster:8786.
    json
        Print JSON: {schema_version, files, resumed, table, limits, errors, notes}.
    """
    prepare(out)
    with stage("loading allanjax"):
        from allanjax.fleet.fleet import characterize_fleet
    with _progress_bar() as progress:
        result = characterize_fleet(
            list(patterns),
            out,
            group=group,
            unit=unit,
            spec=spec,
            workers=workers,
            scheduler=scheduler,
            piece=piece,
            progress=progress,
            figure_format=format,
            **how.options.arguments(),
        )
    written = ("fleet.parquet", f"fleet.{format}", "errors.csv", "notes.txt")
    paths = [out / name for name in (*written, *(("fleet_spec.csv", "fleet_spec.xml") if spec else ()))]
    if html:
        paths += fleet_page(result, out)
    print_result(result, json, paths)
    for error in result.errors:
        print_error(f"{error['file']}: {error['message']}")
    exit_if_failed(result.errors, len(result.files))
    exit_by([check.verdict for check in result.checks])


@contextmanager
def _progress_bar() -> Iterator["Progress"]:
    """Show progress on stderr, as a bar on a terminal; yields a function that updates it."""
    if not sys.stderr.isatty():
        with stage("fleet: starting") as show:
            yield lambda done, failed, total: show(f"fleet: {done} of {total} done, {failed} failed")
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    counts = TextColumn("{task.completed} of {task.total} done, {task.fields[failed]} failed")
    columns = (BarColumn(), counts, TimeElapsedColumn(), TextColumn("left"), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True)) as bar:
        task = bar.add_task("", total=None, failed=0)
        yield lambda done, failed, total: bar.update(task, completed=done, failed=failed, total=total)

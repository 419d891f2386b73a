"""The command `allanjax watch`."""

import sys
import threading
from collections.abc import Iterator
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter
from cyclopts.validators import Number

from allanjax.base.errors import FitError
from allanjax.cli.common import (
    RESULTS,
    exit_by,
    exit_if_failed,
    prepare,
    print_error,
    print_json,
    print_written,
    refuse,
    stage,
)
from allanjax.cli.interrupt import ENDINGS
from allanjax.cli.options import Figures, Fitting

if TYPE_CHECKING:
    from allanjax.estimate.result import Fit

# Aims that are reported without --until.
_AIMS = ("N 1 %", "B 10 %")


def watch(
    file: str,
    /,
    *,
    how: Fitting = Fitting(),
    until: Annotated[tuple[str, ...], Parameter(negative=())] = (),
    every: Annotated[float, Parameter(validator=Number(gt=0))] = 5.0,
    out: Path | None = None,
    format: Figures = "png",
    json: bool = False,
) -> None:
    """Estimate the noise coefficients of a static recording while it is being made.

    Reads a text file that a logger writes, or lines from a pipe, in constant
    memory. Prints the table of coefficients again and again, how much longer to
    record, and warnings as they come. Ctrl-C, the end of the pipe or --until ends
    the command with the result, which is written as characterize --stream
    writes it. A gap or a disturbance begins a new piece of the record; the longest
    piece counts.

    For example:
      allanjax watch imu.csv
      allanjax watch imu.csv --until 'N 1 %' --until 'B 10 %' --json > fit.json
      ros2 topic echo --csv /imu/data | allanjax watch -

    Parameters
    ----------
    file
        Text file that is being written, or - for standard input.
    until
        End with exit code 0 as soon as N, B or K of every axis has this relative standard
        deviation, e.g. 'B 10 %'; may be repeated. Exit code 3: the record ended before.
    every
        Least time in s between two tables.
    out
        Folder for the results. Default: allanjax-results, or none with --json.
    format
        Format and suffix of the figures.
    json
        Print JSON at the end, and tables on stderr: {schema_version, fits, errors}.
    """
    options = how.options
    if options.regressors or options.reading.start is not None or options.reading.stop is not None:
        refuse("watch has no --regressors, --start and --stop: they need a record that has ended")
    directory = out if json else out or RESULTS
    prepare(directory)
    with stage("loading allanjax"):
        from allanjax.fleet.watch import Aim, Watch, lines_of
    aims = [Aim.parse(text) for text in until or _AIMS]
    ended = threading.Event()
    ENDINGS.append(ended.set)
    shown = sys.stderr if json else sys.stdout
    name = "stdin" if file == "-" else file
    pipe = file == "-" or Path(file).is_fifo()
    with nullcontext(sys.stdin.buffer) if file == "-" else open(file, "rb", buffering=0) as stream:
        lines: Iterator[bytes] = lines_of(stream, not pipe, every, ended.is_set)
        seen = Watch(lines, options, name, lambda text: print(f"warning: {text}", file=sys.stderr))
        fit, reached = None, False
        for fit in seen.fits():
            seconds = [aim.seconds(fit) for aim in aims]
            goals = "; ".join(aim.words(fit, needed) for aim, needed in zip(aims, seconds, strict=True))
            print(f"\n{fit}\n{goals}", file=shown, flush=True)
            reached = all(needed <= fit.curve.n / fit.curve.rate for needed in seconds)
            if until and reached:
                break
    if seen.longest is None:
        raise FitError(f"{name}: the record ended before there were enough samples for a fit")
    if seen.longest is not fit:
        print(f"\nthe longest piece:\n{seen.longest}", file=shown)
    _end(seen.longest, directory, format, json)
    if until and not reached:
        print(f"the record ended before {' and '.join(until)} was reached", file=sys.stderr)
        exit_by(["undecided"])


def _end(fit: "Fit", directory: Path | None, suffix: Figures, as_json: bool) -> None:
    """Write and print the result."""
    from allanjax.estimate.as_json import SCHEMA_VERSION
    from allanjax.presentation.files import with_checks, write_results

    if directory is not None:
        print_written(write_results(fit, None, directory, fit.name, figure_format=suffix), as_json)
    missing = {**fit.without_result, **fit.not_measured}
    errors = [{"file": fit.name, "message": f"{axis}: {why}"} for axis, why in missing.items()]
    for error in errors:
        print_error(f"{fit.name}: {error['message']}")
    if as_json:
        document = {"file": fit.name, **with_checks(fit, None)}
        print_json({"schema_version": SCHEMA_VERSION, "fits": [document], "errors": errors})
    exit_if_failed(errors, 1)

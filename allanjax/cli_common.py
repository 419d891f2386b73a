"""What commands share: options of reading and fitting, progress, errors, and names of results."""

import os
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

if TYPE_CHECKING:
    from allanjax.model import Model

Sensor = Literal["gyro", "accel"]

RESULTS = Path("allanjax-results")

Files = Annotated[
    list[Path],
    typer.Argument(help="Recordings: CSV and other text, Parquet, .npy, .npz or .mat.", metavar="FILE"),
]
Rate = Annotated[float | None, typer.Option(help="Sample rate in Hz; needed if the file has no time stamps.")]
GyroUnit = Annotated[
    str | None,
    typer.Option(
        help="Unit of the gyros if the header has none: deg/s, rad/s, deg/h, ...; rad for increments."
    ),
]
AccelUnit = Annotated[
    str | None,
    typer.Option(
        help="Unit of the accelerometers if the header has none: m/s^2, g, mg, ...; m/s for increments."
    ),
]
Columns = Annotated[
    str | None,
    typer.Option(
        help="Columns to read, or a name for each in order, - to skip one, e.g. time,gyro_x,-,gyro_z."
    ),
]
Time = Annotated[str | None, typer.Option(help="Column of time stamps; none to ignore them.")]
TimeUnit = Annotated[str | None, typer.Option(help="Unit of the time stamps: s, ms, us or ns.")]
Start = Annotated[float | None, typer.Option(help="Leave out what is before this time, in s.")]
Stop = Annotated[float | None, typer.Option(help="Leave out what is from this time on, in s.")]
Terms = Annotated[
    str | None,
    typer.Option(
        help="Noise terms to fit, e.g. 'N + B + K' or 'quantization, angle_random_walk, "
        "markov(correlation_time=100 s held)'. Without: those of the five basic terms and a Markov "
        "process that the data call for, by their evidence."
    ),
]
ObjectiveName = Annotated[
    Literal["allan", "whittle"],
    typer.Option(help="Fit the Allan variances, or the spectrum by Whittle's likelihood: better for lines."),
]
Regressors = Annotated[
    str | None,
    typer.Option(help="Auxiliary columns to regress on, with --objective whittle, e.g. temperature."),
]
Out = Annotated[
    Path | None,
    typer.Option(help=f"Folder for the results, by default {RESULTS}; with --json there is none by default."),
]


def epilog(*examples: str) -> str:
    """Examples and exit codes, a line each: typer breaks lines at empty ones only."""
    codes = "Exit codes: 0 success; 1 bad input, or an axis without result; 2 a wrong command line."
    return "\n\n".join(["Examples:", *(f"  {example}" for example in examples), codes])


def parsed_model(terms: str, sensor: Sensor | None = None) -> "Model":
    """The model that --terms writes down; a wrong command line if it writes down none."""
    from allanjax.errors import AllanjaxError
    from allanjax.notation import parse_model

    try:
        return parse_model(terms, sensor)
    except AllanjaxError as error:
        raise typer.BadParameter(str(error), param_hint="--terms") from error


def fit_model(terms: str) -> "Model":
    """The model that a fit is to start from: without amplitudes, which are what it estimates."""
    model = parsed_model(terms)
    for p in model.parameters:
        if p.parameter.kind == "amplitude" and p.start is not None:
            raise typer.BadParameter(
                f"{p.label} is what the fit estimates; leave out its value", param_hint="--terms"
            )
    return model


def names_in(text: str | None) -> list[str]:
    """The names of a comma-separated list."""
    return [] if text is None else [name.strip() for name in text.split(",")]


def prepare() -> None:
    """What every command needs before it computes: compiled programs from earlier runs, no windows."""
    os.environ["MPLBACKEND"] = "Agg"
    from allanjax.cache import enable_compilation_cache

    enable_compilation_cache()


@contextmanager
def stage(text: str) -> Iterator[Callable[[str], None]]:
    """A spinner on stderr, where that is a terminal; what it gives changes the text."""
    from rich.console import Console
    from rich.text import Text

    console = Console(stderr=True)
    with console.status(Text(text)) as status:
        yield lambda words: status.update(Text(words))


def print_error(message: str) -> None:
    """On stderr."""
    print(f"error: {message}", file=sys.stderr)


def exit_if_failed(errors: Sequence[Mapping[str, str]], files: Sequence[Path]) -> None:
    """Say which files failed, if any did, and end the program."""
    if errors:
        failed = dict.fromkeys(error["file"] for error in errors)
        if len(files) > 1:
            print(f"{len(failed)} of {len(files)} files failed: {', '.join(failed)}", file=sys.stderr)
        raise typer.Exit(1)


def result_names(files: Sequence[Path]) -> list[str]:
    """A name for the results of each file: its own without suffix, numbered where several share it."""
    names: list[str] = []
    for file in files:
        stem = file.name.removesuffix(".gz").rsplit(".", 1)[0] or file.name
        name, number = stem, 1
        # Some file systems do not tell case apart.
        while name.casefold() in (taken.casefold() for taken in names):
            number += 1
            name = f"{stem}-{number}"
        names.append(name)
    return names

"""The command `allanjax repeat`."""

from pathlib import Path
from typing import Any

from allanjax.base.errors import AllanjaxError
from allanjax.cli.common import (
    RESULTS,
    Files,
    fitting,
    inputs,
    prepare,
    print_result,
    saved_fit,
    stage,
    user_errors,
)
from allanjax.cli.options import FigureFormat, command
from allanjax.fleet.options import FitOptions


@command(
    "allanjax repeat monday.csv tuesday.csv wednesday.csv --rate 100 --gyro-unit deg/s --accel-unit g",
    "allanjax repeat results/day*.json --out together",
    "allanjax repeat 'logs/*.parquet' --terms 'N + B + K' --json > repeat.json",
)
def repeat(
    files: Files,
    options: FitOptions,
    out: Path | None = None,
    figure_format: FigureFormat = "png",
    as_json: bool = False,
) -> None:
    """Fit recordings of one unit on several days, or of units of one type, jointly: one set of terms per
    axis, the common value of each coefficient, the scatter between recordings beyond what their intervals
    explain, and which recording is the odd one out. Takes recordings or results NAME.json of characterize.
    Prints a table per axis and writes repeat.png.

    Args:
        out: Folder for the figure. Default: allanjax-results, or none with --json.
        as_json (--json): Print JSON instead of tables.
    """
    directory = None if as_json and out is None else out or RESULTS
    prepare(directory)
    from allanjax.comparison.joint import joint_fit

    with user_errors(), inputs(files, directory) as given:
        if len(given) < 2:
            raise AllanjaxError("repeat compares at least two recordings: give more files")
        fits = list[Any]()
        for file in given:
            if file.path.suffix == ".json":
                fits.append(saved_fit(file.path))
                continue
            with stage(f"{file.label}: reading"):
                recording = file.read(options.reading)
            with fitting(file, recording):
                fits.append(options.fit(recording))
        with stage("joint fit"):
            result = joint_fit(fits, options.model, names=[file.name for file in given])
        written = [] if directory is None else [directory / f"repeat.{figure_format}"]
        for path in written:
            path.parent.mkdir(parents=True, exist_ok=True)
            result.plot(path=path)
        print_result(result, as_json, written)

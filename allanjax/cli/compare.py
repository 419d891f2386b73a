"""The commands `allanjax compare` and `repeat`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from allanjax.base.errors import AllanjaxError
from allanjax.cli.common import (
    RESULTS,
    Input,
    fitting,
    inputs,
    prepare,
    print_result,
    saved_fit,
    stage,
    write_result,
)
from allanjax.cli.options import Figures, Fitting, Recordings
from allanjax.fleet.options import FitOptions

if TYPE_CHECKING:
    from allanjax.allan.deviation import AllanDeviation
    from allanjax.estimate.result import Fit


def compare(
    *sensors: Annotated[str, Parameter(name="SENSOR", required=True)],
    how: Fitting = Fitting(),
    curve: tuple[str, ...] = (),
    label: tuple[str, ...] = (),
    reference: str | None = None,
    out: Annotated[tuple[Path, ...], Parameter(alias="-o")] = (),
    json: bool = False,
) -> None:
    """Compare sensors of any grade.

    Compares coefficients with intervals, ratios and whether they differ, Allan
    deviations over one another, and errors after 1 min, 10 min and 1 h, but no
    more than three times the length of a record. Two recordings of one sensor,
    before and after a change of the setup, are compared in the same way.

    For example:
      allanjax compare cimu hg1700 motionpak2
      allanjax compare allanjax-results/imu.json BMI088 --out comparison.html
      allanjax compare before.csv after.csv --label before --label after
      allanjax compare cimu --curve 'ln200.csv, 400 Hz, 6 h' --gyro-unit rad/s \\
          --accel-unit m/s²

    Parameters
    ----------
    sensors
        Recordings, results of characterize (NAME.json), data sheets (.toml, or a name listed by
        allanjax convert --list), or presets: cimu, hg1700, motionpak2.
    curve
        'FILE, RATE, LENGTH' of a sensor of which only an Allan curve is known: its file, and the
        rate and length of the record; repeat for more.
    label
        What to call a sensor; repeat for each, in their order.
    reference
        Sensor that the others are compared with. Default: the first.
    out
        Figure (.png, .svg, .pdf), page (.html) or table (.csv); repeat for more.
    json
        Print JSON instead of tables.
    """
    prepare(files=out)
    from allanjax.comparison.compare import compare as compared
    from allanjax.record.io.formats import name_of

    options = how.options
    data = [*(_opened(name, options) for name in sensors), *(_curve(text, options) for text in curve)]
    with stage("comparing"):
        files = [*sensors, *(text.partition(",")[0] for text in curve)]
        names = label or [name_of(Path(name)) if Path(name).suffix else name for name in files]
        result = compared(*data, labels=names, reference=0 if reference is None else reference)
        for path in out:
            if path.suffix == ".csv":
                result.to_dataframe().to_csv(path, index=False)
            elif path.suffix in (".html", ".htm"):
                from allanjax.presentation.page.report import report

                report(result, path)
            else:
                result.plot(path)
    print_result(result, json, out)


def _curve(text: str, options: FitOptions) -> "AllanDeviation":
    """The Allan curve that an option describes by its file, rate and length."""
    from allanjax.allan.curve import read_curve

    path, *parts = (part.strip() for part in text.split(","))
    if len(parts) != 2:
        raise AllanjaxError(
            f"--curve {text!r}: give the file, the rate and the length, e.g. 'imu.csv, 100 Hz, 3 h'"
        )
    try:
        rate = float(parts[0].removesuffix("Hz"))
    except ValueError as error:
        raise AllanjaxError(f"--curve {text!r}: {parts[0]!r} is not a rate, e.g. 100 Hz") from error
    units = {"gyro_unit": options.reading.gyro_unit, "accel_unit": options.reading.accel_unit}
    return read_curve(path, rate, parts[1], **units)


def _opened(name: str, options: FitOptions) -> "str | Fit":
    """The fit of a recording with these options; anything else by its name."""
    from allanjax.record.io.formats import name_of

    path = Path(name)
    if path.suffix in (".json", ".toml", "") or not path.exists():
        return name
    found = _fitted(Input(path, name, name_of(path)), options)
    if not any(result.converged for result in found.results):
        raise AllanjaxError(f"{name}: no axis has a result; allanjax characterize prints the reasons")
    return found


def _fitted(file: Input, options: FitOptions) -> "Fit":
    """The fit of a recording with these options."""
    with stage(f"{file.label}: reading"):
        recording = file.read(options.reading)
    with fitting(file, recording):
        return options.fit(recording)


def repeat(
    *files: Recordings,
    how: Fitting = Fitting(),
    out: Path | None = None,
    format: Figures = "png",
    json: bool = False,
) -> None:
    """Fit recordings of one unit on several days, or of units of one type, jointly.

    Estimates one set of terms per axis, the common value of each coefficient,
    the scatter between recordings beyond what their intervals explain, and which
    recording is the odd one out. Takes recordings or results NAME.json of
    characterize. Prints a table per axis, and writes repeat.json, repeat.csv and
    repeat.png.

    For example:
      allanjax repeat monday.csv tuesday.csv --rate 100 --gyro-unit deg/s
      allanjax repeat results/day*.json --out together
      allanjax repeat 'logs/*.parquet' --terms 'N + B + K' --json > repeat.json

    Parameters
    ----------
    out
        Folder for the results. Default: allanjax-results, or none with --json.
    format
        Format and suffix of the figures.
    json
        Print JSON instead of tables.
    """
    directory = None if json and out is None else out or RESULTS
    options = how.options
    prepare(directory)
    from allanjax.comparison.joint import joint_fit

    with inputs(files, directory) as given:
        if len(given) < 2:
            raise AllanjaxError("repeat compares at least two recordings: give more files")
        fits = [
            saved_fit(file.path) if file.path.suffix == ".json" else _fitted(file, options) for file in given
        ]
        with stage("joint fit"):
            result = joint_fit(fits, options.model, names=[file.name for file in given])
        written = write_result(result, directory, "repeat", format)
        if directory is not None:
            written.insert(1, directory / "repeat.csv")
            result.to_dataframe().to_csv(written[1], index=False)
        print_result(result, json, written)

"""The command line: `allanjax characterize`, `critique`, `fleet`, `simulate`, `schema` and `demo`."""

import math
import sys
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from allanjax.base.plain import speak_plainly
from allanjax.cli import critique as cli_critique
from allanjax.cli import fleet as cli_fleet
from allanjax.cli.common import (
    FAILURES,
    INTERRUPTED,
    RESULTS,
    Files,
    Input,
    Out,
    epilog,
    exit_if_failed,
    inputs,
    prepare,
    print_error,
    print_json,
    reason,
    reported,
    stage,
)
from allanjax.cli.options import Sensor, parsed_model, with_options
from allanjax.fleet.options import FitOptions
from allanjax.fleet.stream import accumulate
from allanjax.record.io import read_recording
from allanjax.record.io.chunks import open_chunks
from allanjax.report import schemas
from allanjax.report.schemas import Name

if TYPE_CHECKING:
    from allanjax.estimate.result import Fit
    from allanjax.record.recording import Recording
    from allanjax.spectrum.psd import PowerSpectrum

app = typer.Typer(
    name="allanjax",
    help="Noise coefficients of gyros and accelerometers from a static recording, with honest uncertainties.",
    epilog=epilog("allanjax demo", "allanjax characterize imu.csv", "allanjax characterize --help"),
    add_completion=False,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
)


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
    pass


@app.command(
    help="Estimate the noise coefficients of static recordings. Prints a table a file, and writes NAME.json, "
    "NAME_allan.csv, NAME_coefficients.csv, NAME_allan.png and NAME_psd.png. Where one of several "
    "files is bad, the others go on.",
    epilog=epilog(
        "allanjax characterize imu.csv",
        "allanjax characterize log.parquet --rate 100 --gyro-unit deg/s --accel-unit g",
        "allanjax characterize imu.csv --terms 'N + B + markov(correlation_time=100 s)'",
        "allanjax characterize *.csv --start 60 --json > fits.json",
        "allanjax characterize week.parquet --stream",
    ),
)
@with_options
def characterize(
    files: Files,
    options: FitOptions,
    stream: Annotated[
        bool,
        typer.Option(
            "--stream",
            help="Read chunk by chunk, for recordings that do not fit into memory. The Allan variances are "
            "those of the pyramid estimator, at octaves; there is no NAME_psd.png.",
        ),
    ] = False,
    out: Out = None,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print JSON instead of tables: {schema_version, fits, errors}.")
    ] = False,
) -> None:
    from allanjax.estimate.as_json import SCHEMA_VERSION, to_dict
    from allanjax.report.files import write_results

    directory = out if as_json else out or RESULTS
    prepare(directory)
    fits: list[dict[str, Any]] = []
    errors: list[dict[str, str]] = []
    with inputs(files, directory) as given:
        for file in given:
            try:
                spectrum: Future[PowerSpectrum] | None = None
                if stream:
                    fit = _accumulate_and_fit(file, options)
                else:
                    spectrum, fit = _read_and_fit(file, options)
                if directory is not None:
                    with stage(f"{file.label}: writing results"):
                        drawn = None if spectrum is None else spectrum.result()
                        paths = write_results(fit, drawn, directory, file.name)
            except FAILURES as failure:
                errors.append(reported(file, reason(failure, file.label)))
                continue
            if as_json:
                fits.append({"file": file.label, **to_dict(fit)})
            else:
                _print_fit(fit)
            if directory is not None:
                told = ", ".join(str(path) for path in paths)
                print(f"wrote {told}", file=sys.stderr if as_json else sys.stdout)
            for axis, why in fit.without_result.items():
                errors.append(reported(file, f"{axis}: no result, {why}"))
    if as_json:
        print_json({"schema_version": SCHEMA_VERSION, "fits": fits, "errors": errors})
    exit_if_failed(errors, len(given))


app.command("critique", help=cli_critique.HELP, epilog=cli_critique.EPILOG)(cli_critique.critique_command)
app.command("fleet", help=cli_fleet.HELP, epilog=cli_fleet.EPILOG)(cli_fleet.fleet_command)


@app.command(
    help="Simulate a static recording of a known sensor or of noise terms, and write it to a file.",
    epilog=epilog(
        "allanjax simulate --list",
        "allanjax simulate hg1700 --duration 7200 --out hg1700.csv",
        "allanjax simulate --terms 'N=0.1 deg/sqrt(h) + B=3 deg/h' --rate 200 --out gyro.parquet",
        "allanjax simulate --sensor accel --out a.npz "
        "--terms 'N=0.02 m/s/sqrt(h) + markov(amplitude=9 m/s/h/sqrt(h), correlation_time=100 s)'",
    ),
)
def simulate(
    preset: Annotated[str | None, typer.Argument(help="A sensor of --list.", metavar="SENSOR")] = None,
    terms: Annotated[
        str | None,
        typer.Option(help="Noise terms with their values and units, instead of a sensor; sqrt(h) may be √h."),
    ] = None,
    sensor: Annotated[Sensor, typer.Option(help="What the terms are those of.")] = "gyro",
    duration: Annotated[float, typer.Option(help="Length in s.")] = 3600.0,
    rate: Annotated[
        float, typer.Option(help="Sample rate in Hz, with --terms: sensors have their own.")
    ] = 100.0,
    seed: Annotated[int, typer.Option(help="The same seed gives the same recording.")] = 0,
    out: Annotated[
        Path | None,
        typer.Option(
            help="File to write, .csv, .parquet or .npz; axes of another sample rate go to a file each, "
            "with the rate in its name."
        ),
    ] = None,
    show_list: Annotated[bool, typer.Option("--list", help="List the sensors and exit.")] = False,
) -> None:
    from allanjax.noise.sensors import SENSORS

    if show_list:
        for known in SENSORS.values():
            rates = ", ".join(f"{rate:g} Hz" for rate in dict.fromkeys(axis.rate for axis in known.axes))
            print(f"{known.name:12} {known.description}; {rates}")
        return
    if (preset is None) == (terms is None):
        raise typer.BadParameter("give either a sensor or --terms", param_hint="SENSOR")
    if out is None:
        raise typer.BadParameter("give a file to write, e.g. imu.csv", param_hint="--out")
    if preset is not None and preset not in SENSORS:
        raise typer.BadParameter(f"no sensor {preset!r}; there are {', '.join(SENSORS)}", param_hint="SENSOR")
    model = None if terms is None else parsed_model(terms, sensor)
    for name, value in (("--duration", duration), ("--rate", rate)):
        if not 0.0 < value < math.inf:
            raise typer.BadParameter(f"must be positive, not {value:g}", param_hint=name)
    prepare()
    from allanjax.noise.simulate import simulate_recording
    from allanjax.record.io import write
    from allanjax.record.recording import Recording

    recordings: tuple[Recording, ...]
    with _failures_told(), stage("simulating"):
        if model is not None:
            n = round(duration * rate)
            recordings = (simulate_recording({sensor: model}, n, rate, seed, name=out.stem),)
        else:
            recordings = SENSORS[str(preset)].simulate(duration, seed)
        for recording in recordings:
            path = out if len(recordings) == 1 else out.with_stem(f"{out.stem}_{recording.rate:g}Hz")
            write(recording, path)
            size = f"{recording.n:,} samples at {recording.rate:g} Hz"
            print(f"wrote {path}: {', '.join(recording.names)}; {size}")


@app.command(
    help="Print the JSON schema of what characterize (fit), critique or fleet writes: files and --json.",
    epilog=epilog("allanjax schema fit > fit.schema.json"),
)
def schema(name: Annotated[Name, typer.Argument(help="Of what.", metavar="fit|critique|fleet")]) -> None:
    print_json(schemas.schema(name))


@app.command(help="Characterize a simulated six-axis sensor, and compare what is found with what was put in.")
def demo(
    out: Annotated[Path, typer.Option(help="Folder for the recording and the results.")] = Path(
        "allanjax-demo"
    ),
) -> None:
    prepare(out)
    with stage("loading allanjax"):
        from allanjax.cli.demo_sensor import compare, comparison_table, demo_recording
        from allanjax.record.io import write
        from allanjax.report.files import write_results
    with _failures_told():
        out.mkdir(parents=True, exist_ok=True)
        file = out / "demo.csv"
        with stage("simulating 25 minutes of a six-axis sensor at 100 Hz"):
            recording = demo_recording()
            write(recording, file)
        print(f"wrote {file}: {recording.n:,} samples of {', '.join(recording.names)}")
        spectrum, fit = _read_and_fit(Input(file, str(file), file.stem), FitOptions())
        with stage("writing results"):
            paths = write_results(fit, spectrum.result(), out, file.stem)
    comparisons = compare(fit)
    print(comparison_table(comparisons))
    inside = sum(comparison.inside for comparison in comparisons)
    print(f"{inside} of {len(comparisons)} intervals hold the truth; of 95 % ones, one in twenty should not.")
    print(f"wrote {', '.join(str(path) for path in paths)}")
    print("\nFor a recording of your own:\n    allanjax characterize imu.csv")
    print("and if it has no time stamps and no units in its header:")
    print("    allanjax characterize imu.csv --rate 100 --gyro-unit deg/s --accel-unit m/s^2")


def _read_and_fit(file: Input, options: FitOptions) -> "tuple[Future[PowerSpectrum], Fit]":
    """The fit of a file's recording, and its spectrum, which is estimated while the fit compiles."""
    with stage(f"{file.label}: reading"):
        recording = read_recording(file.path, options.reading, file.label)
    size = f"{recording.n:,} samples of {len(recording.axes)} axes"
    with (
        stage(f"{file.label}: fitting {size} (the first run on a machine also compiles)"),
        ThreadPoolExecutor(1) as pool,
    ):
        spectrum = pool.submit(_spectrum, options.inspect(recording).quiet(recording))
        return spectrum, options.fit(recording)


def _accumulate_and_fit(file: Input, options: FitOptions) -> "Fit":
    """The fit of a file that is never in memory as a whole."""
    from allanjax.base.errors import AllanjaxError

    if options.regressors:
        raise AllanjaxError("--regressors needs the whole recording in memory: leave out --stream")
    with stage(f"{file.label}: reading") as say:

        def progress(done: int, total: int | None) -> None:
            share = f" of {total:,} ({100.0 * done / total:.0f} %)" if total else ""
            say(f"{file.label}: {done:,}{share} samples read")

        accumulator = accumulate(open_chunks(file.path, options.reading, label=file.label), progress=progress)
        seen = options.inspect(accumulator)
        if seen.stretch is not None:
            # What was handled cannot be taken out again, but the file can be read again without.
            reading = options.reading.within(seen.stretch)
            accumulator = accumulate(open_chunks(file.path, reading, label=file.label), progress=progress)
    size = f"{accumulator.n:,} samples of {len(accumulator.axes)} axes"
    with stage(f"{file.label}: fitting {size} (the first run on a machine also compiles)"):
        return options.fit_accumulated(accumulator, seen)


def _spectrum(recording: "Recording") -> "PowerSpectrum":
    import matplotlib.pyplot  # noqa: F401 - slow to load, and needed for the pictures

    from allanjax.spectrum.psd import power_spectrum

    return power_spectrum(recording)


def _print_fit(fit: "Fit") -> None:
    print(fit, flush=True)
    for note in fit.notes:
        print(f"note: {note}")


@contextmanager
def _failures_told() -> Iterator[None]:
    """Bad input and failing files end the program with a message; anything else is a bug and shows itself."""
    try:
        yield
    except FAILURES as failure:
        print_error(reason(failure, "allanjax"))
        raise typer.Exit(1) from failure

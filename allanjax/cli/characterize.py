"""The command `allanjax characterize`."""

from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from allanjax.base.errors import AllanjaxError
from allanjax.cli.common import Files, Input, Out, Outcome, epilog, fitting, stage, work_through
from allanjax.cli.options import FigureFormat, with_options
from allanjax.fleet.options import FitOptions

if TYPE_CHECKING:
    from allanjax.estimate.check import Check
    from allanjax.estimate.result import Fit
    from allanjax.record.recording import Recording
    from allanjax.spectrum.psd import PowerSpectrum

HELP = (
    "Estimate the noise coefficients of static recordings. Prints one table per file and writes NAME.json, "
    "NAME_allan.csv, NAME_coefficients.csv, NAME_allan.png and NAME_psd.png. If one file fails, the others "
    "are still processed."
)
EPILOG = epilog(
    "allanjax characterize imu.csv",
    "allanjax characterize log.parquet --rate 100 --gyro-unit deg/s --accel-unit g",
    "allanjax characterize imu.csv --terms 'N + B + markov(correlation_time=100 s)'",
    "allanjax characterize *.csv --start 60 --json > fits.json",
    "allanjax characterize week.parquet --stream",
)


@with_options
def command(
    files: Files,
    options: FitOptions,
    stream: Annotated[
        bool,
        typer.Option(
            "--stream",
            help="Read in chunks, for recordings that do not fit into memory. The Allan variances are "
            "estimated at octaves by the pyramid estimator; NAME_psd.png is not written.",
        ),
    ] = False,
    out: Out = None,
    figure_format: FigureFormat = "png",
    as_json: Annotated[
        bool, typer.Option("--json", help="Print JSON instead of tables: {schema_version, fits, errors}.")
    ] = False,
    verbose: Annotated[
        bool, typer.Option("--verbose", help="Print all coefficients with 95 % intervals, limits and χ².")
    ] = False,
) -> None:
    from allanjax.estimate.as_json import SCHEMA_VERSION
    from allanjax.report.files import with_check, write_results

    def work(file: Input, directory: Path | None) -> Outcome:
        check, spectrum = None, None
        if stream:
            fit = _accumulate_and_fit(file, options)
        else:
            check, spectrum, fit = read_and_fit(file, options)
        paths: tuple[Path, ...] = ()
        if directory is not None:
            with stage(f"{file.label}: writing results"):
                drawn = None if spectrum is None else spectrum.result()
                paths = write_results(fit, drawn, directory, file.name, check, figure_format)
        first = [] if check is None else [f"check: {check.summary()}"]
        text = "\n".join([*first, str(fit), *([fit.details()] if verbose else [])])
        missing = [f"{axis}: no result, {why}" for axis, why in fit.without_result.items()]
        missing += [f"{axis}: {why}" for axis, why in fit.not_measured.items()]
        return Outcome(text, with_check(fit, check), paths, missing)

    work_through(files, out, as_json, work, lambda fits, _: {"schema_version": SCHEMA_VERSION, "fits": fits})


def read_and_fit(file: Input, options: FitOptions) -> "tuple[Check, Future[PowerSpectrum], Fit]":
    """Check, spectrum and fit of a file's recording; the spectrum is estimated during the fit."""
    from allanjax.estimate.check import check_of

    with stage(f"{file.label}: reading"):
        recording = file.read(options.reading)
    with fitting(file, recording), ThreadPoolExecutor(1) as pool:
        inspection = options.inspect(recording)
        spectrum = pool.submit(_spectrum, inspection.quiet(recording))
        fit = options.fit(recording, inspection)
        return check_of(recording, inspection), spectrum, fit


def _accumulate_and_fit(file: Input, options: FitOptions) -> "Fit":
    """Fit of a file that is read in chunks."""
    from allanjax.fleet.stream import accumulate
    from allanjax.record.io.assembly import open_chunks

    if options.regressors:
        raise AllanjaxError("--regressors needs the whole recording in memory: leave out --stream")
    reading = file.options(options.reading)
    with stage(f"{file.label}: reading") as show:

        def progress(done: int, total: int | None) -> None:
            share = f" of {total:,}" if total else ""
            show(f"{file.label}: reading, {done:,} samples{share}")

        accumulator = accumulate(open_chunks(file.path, reading, label=file.label), progress=progress)
        inspection = options.inspect(accumulator)
        if inspection.stretch is not None:
            # Disturbed parts cannot be removed from the sums, so the file is read again without them.
            reading = reading.within(inspection.stretch)
            accumulator = accumulate(open_chunks(file.path, reading, label=file.label), progress=progress)
    with fitting(file, accumulator):
        return options.fit_accumulated(accumulator, inspection)


def _spectrum(recording: "Recording") -> "PowerSpectrum":
    import matplotlib.pyplot  # noqa: F401 - slow to load, and needed for the figures

    from allanjax.spectrum.psd import power_spectrum

    return power_spectrum(recording)

"""The command `allanjax characterize`."""

from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from allanjax.base.errors import AllanjaxError
from allanjax.cli.common import Files, Input, Out, Outcome, epilog, fitting, stage, work_through
from allanjax.cli.options import with_options
from allanjax.fleet.options import FitOptions
from allanjax.fleet.stream import accumulate
from allanjax.record.io.assembly import open_chunks

if TYPE_CHECKING:
    from allanjax.estimate.check import Check
    from allanjax.estimate.result import Fit
    from allanjax.record.recording import Recording
    from allanjax.spectrum.psd import PowerSpectrum

HELP = (
    "Estimate the noise coefficients of static recordings. Prints a table a file, and writes NAME.json, "
    "NAME_allan.csv, NAME_coefficients.csv, NAME_allan.png and NAME_psd.png. Where one of several "
    "files is bad, the others go on."
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
            help="Read chunk by chunk, for recordings that do not fit into memory. The Allan variances are "
            "those of the pyramid estimator, at octaves; there is no NAME_psd.png.",
        ),
    ] = False,
    out: Out = None,
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
                paths = write_results(fit, drawn, directory, file.name, check)
        first = [] if check is None else [f"check: {check.summary()}"]
        told = "\n".join([*first, str(fit), *([fit.details()] if verbose else [])])
        missing = [f"{axis}: no result, {why}" for axis, why in fit.without_result.items()]
        missing += [f"{axis}: {why}" for axis, why in fit.not_measured.items()]
        return Outcome(told, with_check(fit, check), paths, missing)

    work_through(files, out, as_json, work, lambda fits, _: {"schema_version": SCHEMA_VERSION, "fits": fits})


def read_and_fit(file: Input, options: FitOptions) -> "tuple[Check, Future[PowerSpectrum], Fit]":
    """Check, spectrum and fit of a file's recording; the spectrum is estimated while the fit compiles."""
    from allanjax.estimate.check import check_of

    with stage(f"{file.label}: reading"):
        recording = file.read(options.reading)
    with fitting(file, recording), ThreadPoolExecutor(1) as pool:
        seen = options.inspect(recording)
        spectrum = pool.submit(_spectrum, seen.quiet(recording))
        fit = options.fit(recording, seen)
        return check_of(recording, seen), spectrum, fit


def _accumulate_and_fit(file: Input, options: FitOptions) -> "Fit":
    """Fit of a file that is never in memory as a whole."""
    if options.regressors:
        raise AllanjaxError("--regressors needs the whole recording in memory: leave out --stream")
    reading = file.options(options.reading)
    with stage(f"{file.label}: reading") as say:

        def progress(done: int, total: int | None) -> None:
            share = f" of {total:,} ({100.0 * done / total:.0f} %)" if total else ""
            say(f"{file.label}: {done:,}{share} samples read")

        accumulator = accumulate(open_chunks(file.path, reading, label=file.label), progress=progress)
        seen = options.inspect(accumulator)
        if seen.stretch is not None:
            # What was handled cannot be taken out again, but the file can be read again without.
            reading = reading.within(seen.stretch)
            accumulator = accumulate(open_chunks(file.path, reading, label=file.label), progress=progress)
    with fitting(file, accumulator):
        return options.fit_accumulated(accumulator, seen)


def _spectrum(recording: "Recording") -> "PowerSpectrum":
    import matplotlib.pyplot  # noqa: F401 - slow to load, and needed for the pictures

    from allanjax.spectrum.psd import power_spectrum

    return power_spectrum(recording)

"""The commands `allanjax check`, `characterize`, `critique` and `report`, for one or more recordings."""

import dataclasses
import sys
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from allanjax.base.errors import AllanjaxError, RecordingError
from allanjax.cli.common import (
    Input,
    Outcome,
    exit_by,
    exit_if_failed,
    fitting,
    inputs,
    prepare,
    print_json,
    print_written,
    refuse,
    reported,
    saved_fit,
    stage,
    work_through,
    worked_through,
)
from allanjax.cli.options import Figures, Fitting, Reading, Recordings, Written
from allanjax.cli.pages import origin, write_page
from allanjax.fleet.options import FitOptions

if TYPE_CHECKING:
    from allanjax.critic.result import Critique
    from allanjax.estimate.check import Check
    from allanjax.estimate.result import Fit
    from allanjax.presentation.page.sections import Reported
    from allanjax.record.recording import Recording
    from allanjax.spectrum.psd import PowerSpectrum


def check(
    *files: Recordings, reading: Reading = Reading(), vibrating: bool = False, json: bool = False
) -> None:
    """Check whether static recordings are suitable for estimating noise coefficients.

    Tests rate, gaps, resolution, saturation, motion, units, bandwidth and more,
    and estimates how long to record for N, B and K. Each line reads fine, look
    (see the reason) or stop (not usable as it is; exit code 1).

    For example:
      allanjax check imu.csv
      allanjax check log.parquet --rate 100 --gyro-unit deg/s --accel-unit g
      allanjax check *.csv --json > checks.json

    Parameters
    ----------
    vibrating
        The platform is meant to move or vibrate: skip the test for rest.
    json
        Print JSON instead of tables: {schema_version, checks, errors}.
    """
    from allanjax.estimate.check import SCHEMA_VERSION, check, unreadable

    stopped: list[str] = []

    def work(file: Input, _: Path | None) -> Outcome:
        with stage(f"{file.label}: reading") as show:
            try:
                recording = file.read(reading)
            except RecordingError as error:
                # Unusable samples are a result; other errors, also about two rates, are raised again.
                result = unreadable(error, file.name)
            else:
                show(f"{file.label}: fitting, to estimate how long to record (the first run also compiles)")
                result = check(recording, vibrating=vibrating)
        if result.stops:
            stopped.append(file.label)
        return Outcome(str(result), result.to_dict(), (), ())

    document = {"schema_version": SCHEMA_VERSION}
    work_through(files, None, json, work, lambda checks, _: document | {"checks": checks}, writes=False)
    if stopped:
        sys.exit(1)


def characterize(
    *files: Recordings,
    how: Fitting = Fitting(),
    stream: bool = False,
    spec: Path | None = None,
    curve: bool = False,
    duration: str | None = None,
    out: Path | None = None,
    format: Figures = "png",
    html: bool = False,
    json: bool = False,
    verbose: bool = False,
) -> None:
    """Estimate the noise coefficients of static recordings.

    Prints one table per file and writes NAME.json, NAME_allan.csv,
    NAME_coefficients.csv, NAME_allan.png and NAME_psd.png. If one file fails,
    the others are still processed.

    For example:
      allanjax characterize imu.csv
      allanjax characterize log.parquet --rate 100 --gyro-unit deg/s \\
          --accel-unit g
      allanjax characterize imu.csv --terms 'N + B + markov(correlation_time=100 s)'
      allanjax characterize *.csv --start 60 --json > fits.json
      allanjax characterize week.parquet --stream
      allanjax characterize imu.csv --spec limits.yaml
      allanjax characterize curve.csv --curve --rate 100 --duration 3h \\
          --gyro-unit deg/h

    Parameters
    ----------
    stream
        Read in chunks, for recordings that do not fit into memory. The Allan variances are
        estimated by the pyramid estimator; NAME_psd.png is not written.
    spec
        Check the coefficients against the limits in this YAML file (help(allanjax.check_spec)),
        and write NAME_spec.xml, JUnit XML. Exit code 1: a limit is not met; 3: none, but one is
        undecided.
    curve
        The files are Allan curves (cluster times and a column per axis) without their recordings;
        needs --rate and --duration of these for intervals. NAME_psd.png is not written.
    duration
        Length of the recording of a curve: 3h, 20 min, or a number of seconds.
    out
        Folder for the results. Default: allanjax-results, or none with --json.
    format
        Format and suffix of the figures.
    html
        Also write a page, NAME.html, to open in a browser.
    json
        Print JSON instead of tables: {schema_version, fits, errors}.
    verbose
        Print all coefficients with 95 % intervals, limits and χ².
    """
    from allanjax.comparison.specification import check_spec, read_spec

    if spec is not None:
        # A wrong file ends the command before it reads recordings.
        read_spec(spec)
    if (stream and curve) or (duration and not curve):
        refuse("--duration is that of a --curve, which --stream cannot read")
    options = how.options
    verdicts: list[str] = []

    def work(file: Input, directory: Path | None) -> Outcome:
        recording = check = spectrum = None
        if curve:
            fit = _read_curve_and_fit(file, options, duration)
        elif stream:
            fit = _accumulate_and_fit(file, options)
        else:
            recording, check, spectrum, fit = read_and_fit(file, options)
        from allanjax.presentation.files import with_checks, write_results

        judged = None if spec is None else check_spec(fit, spec)
        verdicts.extend(() if judged is None else [judged.verdict])
        paths: tuple[Path, ...] = ()
        if directory is not None:
            with stage(f"{file.label}: writing results"):
                paths = write_results(fit, spectrum, directory, file.name, check, format, judged)
                if html:
                    shown = (fit, None, recording, spectrum, check, judged)
                    paths += (write_page(file, directory, *shown),)
        first = [] if check is None else [f"check: {check.summary()}"]
        last = [] if judged is None else [str(judged)]
        text = "\n".join([*first, str(fit), *([fit.details()] if verbose else []), *last])
        return Outcome(text, with_checks(fit, check, judged), paths, _missing(fit))

    def document(fits: list[dict[str, Any]], _: int) -> dict[str, Any]:
        from allanjax.estimate.as_json import SCHEMA_VERSION

        return {"schema_version": SCHEMA_VERSION, "fits": fits}

    work_through(files, out, json, work, document)
    exit_by(verdicts)


def _missing(fit: "Fit") -> list[str]:
    """What is to be reported of the axes that have no result, or no measurement of the sensor."""
    missing = [f"{axis}: no result, {why}" for axis, why in fit.without_result.items()]
    return missing + [f"{axis}: {why}" for axis, why in fit.not_measured.items()]


def read_and_fit(file: Input, options: FitOptions) -> "tuple[Recording, Check, PowerSpectrum, Fit]":
    """Recording of a file with its check, spectrum and fit; check and spectrum are made during the fit."""
    import allanjax.inspection  # noqa: F401

    with ThreadPoolExecutor(1) as pool:
        # What takes long to load, for units, fit and figures, is loaded while the file is read and inspected.
        for module in ("pint", "allanjax.estimate.fit", "matplotlib.figure"):
            pool.submit(import_module, module)
        with stage(f"{file.label}: reading"):
            recording = file.read(options.reading)
        with fitting(file, recording):
            inspection = options.inspect(recording)
            from allanjax.estimate.check import check_of
            from allanjax.spectrum.psd import power_spectrum

            spectrum = pool.submit(power_spectrum, inspection.quiet(recording))
            check = pool.submit(check_of, recording, inspection)
            fit = options.fit(recording, inspection)
            return recording, check.result(), spectrum.result(), fit


def _read_curve_and_fit(file: Input, options: FitOptions, duration: str | None) -> "Fit":
    """Fit of an Allan curve without its recording."""
    from allanjax.allan.curve import read_curve
    from allanjax.estimate.fit import fit_curve

    reading = options.reading
    with stage(f"{file.label}: fitting the curve (the first run also compiles)"):
        units = {"gyro_unit": reading.gyro_unit, "accel_unit": reading.accel_unit}
        found = read_curve(file.path, reading.rate, duration, **units, columns=reading.columns)
        return fit_curve(dataclasses.replace(found, name=file.name), options.model, options.objective)


def _accumulate_and_fit(file: Input, options: FitOptions) -> "Fit":
    """Fit of a file that is read in chunks."""
    from allanjax.fleet.stream import accumulate
    from allanjax.record.io.chunks import open_chunks

    if options.regressors:
        raise AllanjaxError("--regressors needs the whole recording in memory: leave out --stream")
    reading = file.options(options.reading)
    with stage(f"{file.label}: reading") as show:

        def progress(done: int, total: int | None) -> None:
            share = f" of {total:,}" if total else ""
            show(f"{file.label}: reading, {done:,} samples{share}")

        recording = open_chunks(file.path, reading, label=file.label)
        accumulator = accumulate(recording, progress=progress)
        inspection = accumulator.inspect(as_is=options.as_is, vibrating=options.vibrating)
        if inspection.longest_part is not None:
            # Disturbed parts cannot be removed from the sums, so the file is read again without them.
            reading = reading.within(inspection.longest_part)
            recording = open_chunks(file.path, reading, label=file.label)
            accumulator = accumulate(recording, progress=progress)
    with fitting(file, accumulator):
        found = accumulator.fit_inspected(inspection, options.model, options.objective)
    return dataclasses.replace(found, notes=recording.notes + found.notes)


def critique(
    *files: Recordings,
    reading: Reading = Reading(),
    vibrating: bool = False,
    refit: bool = False,
    each: bool = False,
    out: Path | None = None,
    format: Figures = "png",
    html: bool = False,
    json: bool = False,
) -> None:
    """Find what the noise model of static recordings misses, and why.

    Looks for spectral lines, bias steps, outliers, filters and others. Prints
    what the sensor is and what happened in each file, and writes
    NAME_critique.json and one figure per axis. If one file fails, the others are still processed. With --json
    (schema: allanjax schema critique), the output for one file is its document;
    with several files, or if none could be read, it is {schema_version,
    critiques, errors}.

    For example:
      allanjax critique imu.csv
      allanjax critique log.parquet --rate 100 --gyro-unit deg/s --accel-unit g \\
          --out findings
      allanjax critique *.csv --start 60 --json > critiques.json

    Parameters
    ----------
    vibrating
        The platform is meant to move or vibrate: skip the test for rest.
    refit
        Also print the coefficients after correction for the findings.
    each
        Also write one figure per finding.
    out
        Folder for the results. Default: allanjax-results, or none with --json.
    format
        Format and suffix of the figures.
    html
        Also write a page, NAME.html, to open in a browser.
    json
        Print JSON instead: {schema_version, recording, findings, axes, shared_findings, errors,
        ...} for one file, {schema_version, critiques, errors} for several.
    """
    from allanjax.presentation.critique_json import SCHEMA_VERSION, to_dict

    def work(file: Input, directory: Path | None) -> Outcome:
        with stage(f"{file.label}: loading allanjax"):
            import allanjax.critic.critique  # noqa: F401
        with stage(f"{file.label}: reading"):
            recording = file.read(reading)
        result = _criticize(file, recording, vibrating)
        paths = [] if directory is None else _write(result, directory, file, format, each)
        if directory is not None and html:
            with stage(f"{file.label}: writing the page"):
                paths.append(write_page(file, directory, result.fit, result))
        missing = [f"{dead.axis.name}: not compared, {dead.reason}" for dead in result.dead]
        missing += [f"{axis}: {why}" for axis, why in result.fit.not_measured.items()]
        text = f"{result}\n\n{result.refit()}" if refit else str(result)
        return Outcome(text, to_dict(result), paths, missing)

    def document(critiques: list[dict[str, Any]], count: int) -> dict[str, Any]:
        if count == len(critiques) == 1:
            return {key: value for key, value in critiques[0].items() if key != "file"}
        return {"schema_version": SCHEMA_VERSION, "critiques": critiques}

    work_through(files, out, json, work, document)


def _criticize(file: Input, recording: "Recording", vibrating: bool) -> "Critique":
    from allanjax.critic.critique import critique

    with fitting(file, recording) as show:
        return critique(recording, vibrating=vibrating, progress=lambda text: show(f"{file.label}: {text}"))


def _write(critique: "Critique", directory: Path, file: Input, suffix: str, each: bool) -> list[Path]:
    """Write the JSON file and the figures, and return their paths."""
    from allanjax.presentation.critique_figure import critique_figures
    from allanjax.presentation.critique_json import to_dict
    from allanjax.presentation.files import write_document

    named = dataclasses.replace(critique, name=file.name)
    with stage(f"{file.label}: writing results"):
        paths = [directory / f"{file.name}_critique.json"]
        write_document(to_dict(critique), paths[0])
        figures = critique_figures(named, directory, suffix=suffix)
        if each:
            figures |= critique_figures(named, directory, named.findings, suffix)
        return paths + [directory / name for name in figures]


def report(
    *files: Recordings,
    how: Fitting = Fitting(),
    out: Written = Path("report.html"),
    title: str | None = None,
    note: tuple[str, ...] = (),
    spec: Path | None = None,
    quick: bool = False,
    json: bool = False,
) -> None:
    """Write one page of HTML about static recordings or saved results.

    The page shows what was found, coefficients with intervals, interactive
    curves, whether limits are met, what a simulation of the sensor gets wrong,
    predicted drift, exports, and the method with definitions. It needs no
    network, and prints on two or three sheets.

    For example:
      allanjax report imu.csv --out report.html
      allanjax report imu.csv --quick --out report.html
      allanjax report allanjax-results/imu.json --out report.html
      allanjax report imu.csv --spec limits.yaml --title 'Acceptance test' \\
          --note 'serial number=0123' --note 'operator=A. Smith'

    Parameters
    ----------
    out
        Page to write.
    title
        Heading of the page. Default: the names of the recordings.
    note
        Condition of the records to state, NAME=VALUE, e.g. 'serial number=0123'; repeat for more.
    spec
        Check the coefficients against the limits in this YAML file (help(allanjax.check_spec)).
        Exit code 1: a limit is not met; 3: none, but one is undecided.
    quick
        Without the critique, which takes longer than all the rest.
    json
        Print JSON: {schema_version, written, fits, critiques, errors}.
    """
    if out.suffix.lower() not in (".html", ".htm"):
        refuse(f"--out {str(out)!r}: a page is named .html")
    for text in note:
        if not all(text.partition("=")):
            refuse(f"--note {text!r}: give NAME=VALUE, e.g. 'serial number=0123'")
    from allanjax.comparison.specification import check_spec, read_spec

    if spec is not None:
        # A wrong file ends the command before it reads recordings.
        read_spec(spec)
    prepare(files=[out])
    errors: list[dict[str, str]] = []
    known = dict(text.split("=", 1) for text in note)
    shown: dict[Input, Reported] = {}
    with inputs(files, out.parent) as given:
        for file, part in worked_through(given, lambda file: _reported(file, how.options, quick), errors):
            errors += [reported(file, message) for message in _missing(part.fit)]
            limits = None if spec is None else check_spec(part.fit, spec)
            shown[file] = part._replace(limits=limits, conditions=known)
    if shown:
        from allanjax.presentation.page.report import page_about

        with stage("writing the page"):
            page_about([*shown.values()], title).save(out)
        print_written([out], json)
    if json:
        print_json({**_told(shown), "written": [str(out)] if shown else [], "errors": errors})
    exit_if_failed(errors, len(given))
    exit_by([part.limits.verdict for part in shown.values() if part.limits is not None])


def _told(shown: "Mapping[Input, Reported]") -> dict[str, Any]:
    """The fits of a page with their checks, and its critiques, in types of JSON."""
    from allanjax.estimate.as_json import SCHEMA_VERSION
    from allanjax.presentation.critique_json import to_dict
    from allanjax.presentation.files import with_checks

    fits = [
        {"file": file.label, **with_checks(part.fit, part.check, part.limits)} for file, part in shown.items()
    ]
    critiques = {file: part.critique for file, part in shown.items() if part.critique is not None}
    told = [{"file": file.label, **to_dict(critique)} for file, critique in critiques.items()]
    return {"schema_version": SCHEMA_VERSION, "fits": fits, "critiques": told}


def _reported(file: Input, options: FitOptions, quick: bool) -> "Reported":
    """What is shown of a file: of a result its fit, of a recording everything."""
    from allanjax.presentation.page.sections import Reported

    if file.path.suffix == ".json":
        return Reported(saved_fit(file.path), origin=origin(file))
    recording, check, spectrum, fit = read_and_fit(file, options)
    critique = None if quick else _criticize(file, recording, options.vibrating)
    return Reported(fit, critique, recording, spectrum, check, origin=origin(file))

"""The commands for results: `allanjax export`, `horizon`, `navigate`, `statespace`, `kalman`, `spec`, …"""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

from cyclopts import Parameter

from allanjax.base.errors import AllanjaxError
from allanjax.cli.common import (
    SCHEMA_VERSION,
    exit_by,
    fit_or_sheet,
    make_places,
    prepare,
    print_json,
    print_list,
    print_result,
    print_written,
    refuse,
    saved_fit,
    stage,
)
from allanjax.cli.options import Reading, Written
from allanjax.presentation.schemas import Name
from allanjax.record.io import read_recording


def export(
    result: Path | None = None,
    /,
    *,
    to: str | None = None,
    from_: str | None = None,
    sheet: str | None = None,
    axes: Literal["each", "worst", "mean"] | None = None,
    rate: float | None = None,
    force: bool = False,
    out: Written | None = None,
    list_: bool = False,
    json: bool = False,
) -> None:
    """Write noise parameters for an estimator, autopilot or simulator.

    They are those of a result, a data sheet or another target's file. A value
    outside the range that the target documents is commented out, with a warning
    (exit code 1).

    For example:
      allanjax export --list
      allanjax export allanjax-results/imu.json --to kalibr -o imu.yaml
      allanjax export allanjax-results/imu.json --to vins-mono --rate 200
      allanjax export --sheet BMI088 --to kalibr
      allanjax export allanjax-results/imu.json --to gz-sim --axes worst
      allanjax export imu.yaml --from kalibr --to vins-mono

    Parameters
    ----------
    result
        Result of characterize or fleet (NAME.json); with --from, that target's file.
    to
        Name of the target; --list prints the names.
    from_
        Convert a file of this target.
    sheet
        Use a data sheet: a sensor listed by allanjax convert --list, or a TOML file.
    axes
        Value per axis (if the target has one per axis), largest value of the axes, or their mean.
        Default: each if the target has it, else worst.
    rate
        Sample or step rate of the target in Hz. Default: the rate of the recording or file; for
        autopilots the rate of their filter.
    force
        Also export axes that are not a measurement of the sensor.
    out
        File to write. Default: standard output.
    list_
        List the targets and exit.
    json
        Print JSON: {schema_version, target, text, warnings, written}.
    """
    from allanjax.presentation.export.targets import TARGETS

    if list_:
        targets = []
        for target in TARGETS.values():
            keys = [*dict.fromkeys(key.called for key in target.noise_keys)]
            targets.append({"name": target.name, "title": target.title, "keys": keys})
        print_list("targets", targets, _line, json)
        return
    if to is None:
        refuse("--to: give a target, e.g. kalibr; --list shows them all")
    written = [] if out is None else [out]
    make_places(files=written)
    from allanjax.presentation.export.exporting import converted, exported

    if from_ is None:
        made = exported(fit_or_sheet(result, sheet), to, axes=axes, rate=rate, force=force)
    elif result is None:
        raise AllanjaxError("give the file to convert")
    else:
        made = converted(_text(result), from_, to, axes=axes, rate=rate, name=str(result))
    if out is not None:
        out.write_text(made.text, encoding="ascii")
    elif not json:
        print(made.text, end="")
    print_written(written, json)
    warnings = [*made.left_out, *made.refused]
    for words in warnings:
        print(f"warning: {words}", file=sys.stderr)
    if json:
        known = {"target": to, "text": made.text, "warnings": warnings}
        print_json({"schema_version": SCHEMA_VERSION, **known, "written": [str(path) for path in written]})
    if made.refused:
        sys.exit(1)


def _line(name: str, title: str, keys: Sequence[str]) -> str:
    """Line of a target in the list."""
    return f"{name:19} {title}: {', '.join(keys)}"


def _text(path: Path) -> str:
    """Text of a file; AllanjaxError if it is not text."""
    try:
        return path.read_text(encoding="utf-8")
    except ValueError as error:
        raise AllanjaxError(f"{path}: not a text file: {error}") from error


def horizon(
    result: Path | None = None,
    /,
    *,
    horizon: float,
    sheet: str | None = None,
    axis: str | None = None,
    process: Literal["walk", "markov"] = "walk",
    probability: float = 0.95,
    json: bool = False,
) -> None:
    """Find the noise to use in a Kalman filter that is corrected at regular intervals.

    Finds one pair of a white noise N and a random walk K that predicts the errors
    of the full noise model, and one that bounds them. The bias can be a
    Gauss–Markov process instead of a random walk.

    For example:
      allanjax horizon allanjax-results/imu.json --horizon 10
      allanjax horizon imu.json --horizon 60 --axis gyro_x --probability 0.99
      allanjax horizon --sheet BMI088 --horizon 10
      allanjax horizon imu.json --horizon 10 --process markov --json

    Parameters
    ----------
    result
        Result of allanjax characterize (NAME.json), or a data sheet (.toml).
    horizon
        Time between corrections in s.
    sheet
        Use a data sheet: a sensor listed by allanjax convert --list, or a TOML file.
    axis
        Axis, e.g. gyro_x; by default all axes.
    process
        How the filter models the bias: as a random walk or a Gauss–Markov process.
    probability
        Probability that the bounds hold.
    json
        Print JSON instead of a table.
    """
    prepare()
    from allanjax.estimate.horizon import horizon as tuned

    fit = fit_or_sheet(result, sheet)
    print_result(tuned(fit, horizon, process=process, axes=axis, probability=probability), json)


def navigate(
    result: Path | None = None,
    /,
    *,
    latitude: float,
    sheet: str | None = None,
    azimuth: str | None = None,
    time: tuple[float, ...] = (),
    at_rest: float | None = None,
    calibration: Path | None = None,
    uncorrected: bool = False,
    turn_rate: str | None = None,
    acceleration: str | None = None,
    for_: str | None = None,
    gyro_bias: str = "0 deg/h",
    accel_bias: str = "0 m/s²",
    schuler: bool = False,
    out: Written | None = None,
    json: bool = False,
) -> None:
    """Estimate how fast the errors of a navigation system with these sensors grow.

    Predicts attitude, velocity and position errors at rest, or in a turn or an
    acceleration, and how accurately and how soon the sensors can find level and
    north.

    For example:
      allanjax navigate allanjax-results/imu.json --latitude 51
      allanjax navigate --sheet BMI088 --latitude 51
      allanjax navigate imu.json --latitude 51 --azimuth 0.1deg --out a.png
      allanjax navigate imu.json --latitude 51 --calibration calibration.json \\
          --turn-rate 10deg/s --for 9s

    Parameters
    ----------
    result
        Result of allanjax characterize (NAME.json), or a data sheet (.toml).
    latitude
        Latitude of the sensor in deg.
    sheet
        Use a data sheet: a sensor listed by allanjax convert --list, or a TOML file.
    azimuth
        Required accuracy (1σ) of the azimuth, e.g. 0.1deg.
    time
        Time in s to report; repeat for more. Default: 1 s to 1000 s.
    at_rest
        Time at rest before the start, in s, over which biases are averaged. Default: 600, or the
        biases of the calibration are used.
    calibration
        Include what a calibration (CALIBRATION.json) leaves of biases, scale factors and
        misalignments.
    uncorrected
        Include the errors that it found, as if not corrected.
    turn_rate
        Turn rate about z (down), or about x, y and z: 10 deg/s, or 5,0,10 deg/s.
    acceleration
        Acceleration along x, or along x, y and z: 0.5 g, or 0,0,1 g.
    for_
        How long the turn and the acceleration last, e.g. 20 s.
    gyro_bias
        Residual bias (1σ) of the gyros.
    accel_bias
        Residual bias (1σ) of the accelerometers.
    schuler
        Include the Schuler loop.
    out
        Figure to write, e.g. a.png.
    json
        Print JSON, in SI units.
    """
    written = [] if out is None else [out]
    prepare(files=written)
    from allanjax.calibration.result import load_calibration
    from allanjax.navigation.alignment import align
    from allanjax.navigation.navigator import Profile, navigate

    fit = fit_or_sheet(result, sheet)
    biases: dict[str, Any] = {"gyro_bias": gyro_bias, "accel_bias": accel_bias}
    aligned = align(fit, latitude, azimuth, **biases)
    known = None if calibration is None else load_calibration(calibration)
    moving = {"turn_rate": turn_rate, "acceleration": acceleration, "duration": for_}
    given = {name: text for name, text in moving.items() if text is not None}
    profile = Profile(**given) if given else None
    of: dict[str, Any] = {"calibration": known, "corrected": not uncorrected, "profile": profile}
    growth = navigate(fit, time or None, at_rest=at_rest, schuler=schuler, **biases, **of)
    if out is not None:
        growth.plot(out)
    if json:
        parts = {"navigation": growth.to_dict(), "alignment": aligned.to_dict()}
        print_json({"schema_version": SCHEMA_VERSION, **parts})
    else:
        print(f"{growth}\n{aligned}")
    print_written(written, json)


def statespace(
    result: Path,
    /,
    *,
    axis: str,
    out: Written | None = None,
    rate: float | None = None,
    duration: float | None = None,
    format: Literal["npz", "matlab", "c"] = "npz",
    json: bool = False,
) -> None:
    """Write the matrices A, H, Q, R and P0 of a Kalman filter for the noise of a fitted axis.

    In x' = A x + w, z = H x + v. The file also gives the names and SI units of
    the states.

    For example:
      allanjax statespace imu.json --axis gyro_x --out gyro_x.npz
      allanjax statespace imu.json --axis gyro_x --rate 200 --format c --out gyro_x.h

    Parameters
    ----------
    result
        Result of allanjax characterize: NAME.json.
    axis
        Axis, e.g. gyro_x.
    out
        File to write; needed without --json.
    rate
        Sample rate of the filter in Hz; by default the recording's.
    duration
        Time in s for which the filter runs, by default the recording's length. Up to this time,
        bias instability is approximated by a sum of Gauss–Markov processes.
    format
        NumPy file, MATLAB script or C header.
    json
        Print JSON, in SI units: {schema_version, model, rate_hz, names, units, A, H, Q, R, P0, ...}.
    """
    if out is None and not json:
        refuse("--out: give a file to write, e.g. gyro_x.npz; or --json")
    written = [] if out is None else [out]
    prepare(files=written)
    fit = saved_fit(result)
    measured = fit[axis]
    if not measured.measured:
        raise AllanjaxError(f"{result}: {axis}: {measured.verdict}")
    # A filter that precedes sampling depends on the recording's rate.
    length = fit.curve.n / fit.curve.rate if duration is None else duration
    rate = fit.curve.rate if rate is None else rate
    space = measured.model.state_space(rate, duration=length, sensor=measured.axis.sensor)
    if out is not None and format == "npz":
        space.to_numpy(out)
    elif out is not None:
        text = space.to_matlab() if format == "matlab" else space.to_c_header()
        out.write_text(text, encoding="utf-8")
    if json:
        print_json({**space.to_dict(), "written": [str(path) for path in written]})
    else:
        print(space)
    print_written(written, json)


def kalman(
    file: Path,
    /,
    *,
    reading: Reading = Reading(),
    fit: Path | None = None,
    terms: str | None = None,
    smooth: bool = False,
    out: Annotated[tuple[Path, ...], Parameter(alias="-o")] = (),
    json: bool = False,
) -> None:
    """Run a Kalman filter with a noise model on a recording.

    Estimates the bias over time with its interval, and tests whether the
    innovations are white and of the predicted size, as they should be.

    For example:
      allanjax kalman imu.csv --fit allanjax-results/imu.json
      allanjax kalman imu.csv --terms 'N=0.1 deg/√h + K=1 deg/h/√h' --smooth \\
          --out bias.png --out bias.csv

    Parameters
    ----------
    file
        Recording to filter.
    fit
        Result of allanjax characterize (RESULT.json) with the model of each axis.
    terms
        Alternatively a noise model with values, used for every axis (gyros only or accelerometers
        only).
    smooth
        Estimate the bias from all samples, not only earlier ones.
    out
        Figure (e.g. .png) or table (.csv) to write; repeat for more.
    json
        Print JSON, in SI units.
    """
    prepare(files=out)
    from allanjax.kalman.filtering import kalman_filter

    if (fit is None) == (terms is None):
        raise AllanjaxError("give the noise model, either with --fit RESULT.json or with --terms")
    models = str(terms) if fit is None else saved_fit(fit)
    with stage(f"{file}: filtering"):
        result = kalman_filter(read_recording(file, reading, str(file)), models, smooth=smooth)
    for path in out:
        if path.suffix == ".csv":
            result.to_dataframe().to_csv(path, index=False)
        else:
            result.plot(path=path)
    print_result(result, json, out)


def spec(result: Path, limits: Path, /, *, out: Written | None = None, json: bool = False) -> None:
    """Check a saved result against the limits of a specification.

    As characterize does with --spec: noise density, random walk, in-run bias and
    others, with the probability that the true value meets each limit (exit code
    1: a limit is not met; 3: none, but one is undecided).
    help(allanjax.check_spec) describes the file.

    For example:
      allanjax spec allanjax-results/imu.json limits.yaml
      allanjax spec imu.json limits.yaml --out imu_spec.xml --json

    Parameters
    ----------
    result
        Result of characterize: NAME.json.
    limits
        Limits, a YAML file.
    out
        File of JUnit XML to write.
    json
        Print JSON instead of a table.
    """
    written = [] if out is None else [out]
    prepare(files=written)
    from allanjax.comparison.specification import check_spec

    judged = check_spec(saved_fit(result), limits)
    for path in written:
        path.write_text(judged.to_junit(), encoding="utf-8")
    print_result(judged, json, written)
    exit_by([judged.verdict])


def schema(name: Name, /) -> None:
    """Print the JSON schema of what a command prints with --json.

    For example:
      allanjax schema characterize > fit.schema.json

    Parameters
    ----------
    name
        Which command; fit is what characterize and watch print, and a file NAME.json, and fleet a file
        recordings/NAME.json.
    """
    from allanjax.presentation.schemas import schema

    print_json(schema(name))

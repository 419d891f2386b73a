"""The commands for results: `allanjax export`, `horizon`, `navigate`, `statespace`, `kalman`, `spec`, …"""

import sys
from pathlib import Path
from typing import Any, Literal

import typer

from allanjax.base.errors import AllanjaxError
from allanjax.cli.common import (
    OptionalFit,
    Sheet,
    exit_by,
    fit_or_sheet,
    prepare,
    print_json,
    print_result,
    print_written,
    saved_fit,
    stage,
)
from allanjax.cli.options import command
from allanjax.record.io import ReadOptions, read_recording


@command(
    "allanjax export --list",
    "allanjax export allanjax-results/imu.json --to kalibr -o imu.yaml",
    "allanjax export allanjax-results/imu.json --to vins-mono --rate 200",
    "allanjax export --sheet BMI088 --to kalibr",
    "allanjax export allanjax-results/imu.json --to gz-sim --axes worst",
    "allanjax export imu.yaml --from kalibr --to vins-mono",
)
def export(
    result: Path | None = None,
    to: str | None = None,
    source: str | None = None,
    sheet: Sheet = None,
    axes: Literal["each", "worst", "mean"] | None = None,
    rate: float | None = None,
    force: bool = False,
    out: Path | None = None,
    show_list: bool = False,
) -> None:
    """Write noise parameters for an estimator, autopilot or simulator, from a result, a data sheet or
    another target's file.

    Args:
        result (RESULT.json): Result of characterize or fleet (NAME.json); with --from, that target's file.
        to (--to TARGET): Name of the target; --list prints the names.
        source (--from TARGET): Convert a file of this target.
        axes: Value per axis (if the target has one per axis), largest value of the axes, or their mean.
            Default: each if the target has it, else worst.
        rate: Sample or step rate of the target in Hz. Default: the rate of the recording or file; for
            autopilots the rate of their filter.
        force: Also export axes that are not a measurement of the sensor.
        out (--out, -o): File to write. Default: standard output.
        show_list (--list): List the targets and exit.
    """
    from allanjax.presentation.export.targets import TARGETS

    if show_list:
        for target in TARGETS.values():
            keys = dict.fromkeys(key.called for key in target.noise_keys)
            print(f"{target.name:19} {target.title}: {', '.join(keys)}")
        return
    if to is None:
        raise typer.BadParameter("give a target, e.g. kalibr; --list shows them all", param_hint="--to")
    from allanjax.presentation.export.exporting import converted, exported

    if source is None:
        made = exported(fit_or_sheet(result, sheet), to, axes=axes, rate=rate, force=force)
    elif result is None:
        raise AllanjaxError("give the file to convert")
    else:
        made = converted(_text(result), source, to, axes=axes, rate=rate, name=str(result))
    if out is None:
        print(made.text, end="")
    else:
        out.write_text(made.text, encoding="ascii")
        print(f"wrote {out}")
    for words in made.left_out:
        print(f"warning: {words}", file=sys.stderr)


def _text(path: Path) -> str:
    """Text of a file; AllanjaxError if it is not text."""
    try:
        return path.read_text(encoding="utf-8")
    except ValueError as error:
        raise AllanjaxError(f"{path}: not a text file: {error}") from error


@command(
    "allanjax horizon allanjax-results/imu.json --horizon 10",
    "allanjax horizon imu.json --horizon 60 --axis gyro_x --probability 0.99",
    "allanjax horizon --sheet BMI088 --horizon 10",
    "allanjax horizon imu.json --horizon 10 --process markov --json",
)
def horizon(
    seconds: float,
    result: OptionalFit = None,
    sheet: Sheet = None,
    axis: str | None = None,
    process: Literal["walk", "markov"] = "walk",
    probability: float = 0.95,
    as_json: bool = False,
) -> None:
    """Find the white noise N and random walk K to use in a Kalman filter that is corrected at regular
    intervals: one pair that predicts the errors of the full noise model, and one that bounds them. The
    bias can be a Gauss–Markov process instead of a random walk.

    Args:
        seconds (--horizon): Time between corrections in s.
        axis: Axis, e.g. gyro_x; by default all axes.
        process: How the filter models the bias: as a random walk or a Gauss–Markov process.
        probability: Probability that the bounds hold.
        as_json (--json): Print JSON instead of a table.
    """
    prepare()
    from allanjax.estimate.horizon import horizon

    fit = fit_or_sheet(result, sheet)
    noise = horizon(fit, seconds, process=process, axes=axis, probability=probability)
    print_result(noise, as_json)


@command(
    "allanjax navigate allanjax-results/imu.json --latitude 51",
    "allanjax navigate --sheet BMI088 --latitude 51",
    "allanjax navigate imu.json --latitude 51 --azimuth 0.1deg --out navigation.png",
    "allanjax navigate imu.json --latitude 51 --calibration calibration.json --turn-rate 10deg/s --for 9s",
)
def navigate(
    latitude: float,
    result: OptionalFit = None,
    sheet: Sheet = None,
    azimuth: str | None = None,
    time: list[float] | None = None,
    at_rest: float | None = None,
    calibration: Path | None = None,
    uncorrected: bool = False,
    turn_rate: str | None = None,
    acceleration: str | None = None,
    lasting: str | None = None,
    gyro_bias: str = "0 deg/h",
    accel_bias: str = "0 m/s²",
    schuler: bool = False,
    out: Path | None = None,
    as_json: bool = False,
) -> None:
    """Estimate how fast the attitude, velocity and position errors of a navigation system with these sensors
    grow at rest, or in a turn or an acceleration, and how accurately and how soon the sensors can find level
    and north.

    Args:
        latitude: Latitude of the sensor in deg.
        azimuth: Required accuracy (1σ) of the azimuth, e.g. 0.1deg.
        time: Time in s to report; repeat for more. Default: 1 s to 1000 s.
        at_rest: Time at rest before the start, in s, over which biases are averaged. Default: 600, or the
            biases of the calibration are used.
        calibration (--calibration CALIBRATION.json): Include what a calibration leaves of biases, scale
            factors and misalignments.
        uncorrected: Include the errors that it found, as if not corrected.
        turn_rate: Turn rate about z (down), or about x, y and z: 10 deg/s, or 5,0,10 deg/s.
        acceleration: Acceleration along x, or along x, y and z: 0.5 g, or 0,0,1 g.
        lasting (--for): How long the turn and the acceleration last, e.g. 20 s.
        gyro_bias: Residual bias (1σ) of the gyros.
        accel_bias: Residual bias (1σ) of the accelerometers.
        schuler: Include the Schuler loop.
        out (--out, -o): Figure to write, e.g. a.png.
        as_json (--json): Print JSON, in SI units.
    """
    prepare()
    from allanjax.calibration.result import load_calibration
    from allanjax.navigation.alignment import align
    from allanjax.navigation.navigator import Profile, navigate

    fit = fit_or_sheet(result, sheet)
    biases: dict[str, Any] = {"gyro_bias": gyro_bias, "accel_bias": accel_bias}
    aligned = align(fit, latitude, azimuth, **biases)
    known = None if calibration is None else load_calibration(calibration)
    moving = {"turn_rate": turn_rate, "acceleration": acceleration, "duration": lasting}
    given = {name: text for name, text in moving.items() if text is not None}
    profile = Profile(**given) if given else None
    of: dict[str, Any] = {"calibration": known, "corrected": not uncorrected, "profile": profile}
    growth = navigate(fit, time, at_rest=at_rest, schuler=schuler, **biases, **of)
    if out is not None:
        growth.plot(out)
    if as_json:
        print_json({"navigation": growth.to_dict(), "alignment": aligned.to_dict()})
    else:
        print(f"{growth}\n{aligned}")
    print_written([] if out is None else [out], as_json)


@command(
    "allanjax statespace allanjax-results/imu.json --axis gyro_x --out gyro_x.npz",
    "allanjax statespace imu.json --axis gyro_x --rate 200 --format c --out gyro_x.h",
)
def statespace(
    result: Path,
    out: Path,
    axis: str,
    rate: float | None = None,
    duration: float | None = None,
    form: Literal["npz", "matlab", "c"] = "npz",
) -> None:
    """Write the matrices A, H, Q, R and P0 of a Kalman filter for the noise of a fitted axis: x' = A x + w,
    z = H x + v. The file also gives the names and SI units of the states.

    Args:
        result (RESULT.json): Result of allanjax characterize: NAME.json.
        out (--out, -o): File to write.
        axis: Axis, e.g. gyro_x.
        rate: Sample rate of the filter in Hz; by default the recording's.
        duration: Time in s for which the filter runs, by default the recording's length. Up to this time,
            bias instability is approximated by a sum of Gauss–Markov processes.
        form (--format): NumPy file, MATLAB script or C header.
    """
    prepare()
    fit = saved_fit(result)
    measured = fit[axis]
    if not measured.measured:
        raise AllanjaxError(f"{result}: {axis}: {measured.verdict}")
    # A filter that precedes sampling depends on the recording's rate.
    length = fit.curve.n / fit.curve.rate if duration is None else duration
    rate = fit.curve.rate if rate is None else rate
    space = measured.model.state_space(rate, duration=length, sensor=measured.axis.sensor)
    if form == "npz":
        space.to_numpy(out)
    else:
        text = space.to_matlab() if form == "matlab" else space.to_c_header()
        out.write_text(text, encoding="utf-8")
    print_result(space, as_json=False, written=[out])


@command(
    "allanjax kalman imu.csv --fit allanjax-results/imu.json",
    "allanjax kalman imu.csv --terms 'N=0.1 deg/√h + K=1 deg/h/√h' --smooth --out bias.png --out bias.csv",
)
def kalman(
    reading: ReadOptions,
    file: Path,
    fit: Path | None = None,
    terms: str | None = None,
    smooth: bool = False,
    out: list[Path] | None = None,
    as_json: bool = False,
) -> None:
    """Run a Kalman filter with a noise model on a recording: estimate the bias over time with its interval,
    and test whether the innovations are white and of the predicted size, as they should be.

    Args:
        file (FILE): Recording to filter.
        fit (--fit RESULT.json): Result of allanjax characterize with the model of each axis.
        terms: Alternatively a noise model with values, used for every axis (gyros only or accelerometers
            only).
        smooth: Estimate the bias from all samples, not only earlier ones.
        out (--out, -o): Figure (e.g. .png) or table (.csv) to write; repeat for more.
        as_json (--json): Print JSON, in SI units.
    """
    prepare()
    from allanjax.kalman.filtering import kalman_filter

    if (fit is None) == (terms is None):
        raise AllanjaxError("give the noise model, either with --fit RESULT.json or with --terms")
    models = str(terms) if fit is None else saved_fit(fit)
    with stage(f"{file}: filtering"):
        result = kalman_filter(read_recording(file, reading, str(file)), models, smooth=smooth)
    for path in out or ():
        if path.suffix == ".csv":
            result.to_dataframe().to_csv(path, index=False)
        else:
            result.plot(path=path)
    print_result(result, as_json, out or ())


@command(
    "allanjax spec allanjax-results/imu.json limits.yaml",
    "allanjax spec imu.json limits.yaml --out imu_spec.xml --json",
)
def spec(result: Path, limits: Path, out: Path | None = None, as_json: bool = False) -> None:
    """Check a saved result against the limits of a specification, as characterize does with --spec: noise
    density, random walk, in-run bias and others, with the probability that the true value meets each limit
    (exit code 1: a limit is not met; 3: none, but one is undecided). help(allanjax.check_spec) describes the
    file.

    Args:
        result (RESULT.json): Result of characterize: NAME.json.
        limits (LIMITS.yaml): Limits, a YAML file.
        out (--out, -o): File of JUnit XML to write.
        as_json (--json): Print JSON instead of a table.
    """
    prepare()
    from allanjax.comparison.specification import check_spec

    judged = check_spec(saved_fit(result), limits)
    if out is not None:
        out.write_text(judged.to_junit(), encoding="utf-8")
    print_result(judged, as_json, () if out is None else (out,))
    exit_by([judged.verdict])


@command("allanjax schema fit > fit.schema.json")
def schema(name: Literal["check", "fit", "critique", "fleet", "horizon"]) -> None:
    """Print the JSON schema of what check, characterize, critique, fleet or horizon writes.

    Args:
        name (NAME): Which schema; fit is that of characterize.
    """
    from allanjax.presentation.schemas import schema

    print_json(schema(name))

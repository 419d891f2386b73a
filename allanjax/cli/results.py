"""The commands for results: `allanjax export`, `horizon`, `navigate`, `statespace`, `kalman`, `spec`, …"""

import sys
from pathlib import Path
from typing import Annotated, Any, Literal

import typer
from typer import Argument, Option

from allanjax.base.errors import AllanjaxError
from allanjax.cli.common import (
    JsonInSI,
    OptionalFit,
    Sheet,
    TableAsJson,
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
    """Write noise parameters for an estimator, autopilot or simulator, from a result, a data sheet
    or another target's file.""",
    "allanjax export --list",
    "allanjax export allanjax-results/imu.json --to kalibr -o imu.yaml",
    "allanjax export allanjax-results/imu.json --to vins-mono --rate 200",
    "allanjax export --sheet BMI088 --to kalibr",
    "allanjax export allanjax-results/imu.json --to gz-sim --axes worst",
    "allanjax export imu.yaml --from kalibr --to vins-mono",
)
def export(
    result: Annotated[
        Path | None,
        Argument(
            metavar="RESULT.json",
            help="Result of characterize or fleet (NAME.json); with --from, that target's file.",
        ),
    ] = None,
    to: Annotated[
        str | None,
        Option("--to", metavar="TARGET", help="Name of the target; --list prints the names."),
    ] = None,
    source: Annotated[
        str | None, Option("--from", metavar="TARGET", help="Convert a file of this target.")
    ] = None,
    sheet: Sheet = None,
    axes: Annotated[
        Literal["each", "worst", "mean"] | None,
        Option(
            help="Value per axis (if the target has one per axis), largest value of the axes, or "
            "their mean. Default: each if the target has it, else worst."
        ),
    ] = None,
    rate: Annotated[
        float | None,
        Option(
            help="Sample or step rate of the target in Hz. Default: the rate of the recording or "
            "file; for autopilots the rate of their filter."
        ),
    ] = None,
    force: Annotated[
        bool, Option("--force", help="Also export axes that are not a measurement of the sensor.")
    ] = False,
    out: Annotated[
        Path | None, Option("--out", "-o", help="File to write. Default: standard output.")
    ] = None,
    show_list: Annotated[bool, Option("--list", help="List the targets and exit.")] = False,
) -> None:
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
    """Find the white noise N and random walk K to use in a Kalman filter that is corrected at
    regular intervals: one pair that predicts the errors of the full noise model, and one that
    bounds them. The bias can be a Gauss–Markov process instead of a random walk.""",
    "allanjax horizon allanjax-results/imu.json --horizon 10",
    "allanjax horizon imu.json --horizon 60 --axis gyro_x --probability 0.99",
    "allanjax horizon --sheet BMI088 --horizon 10",
    "allanjax horizon imu.json --horizon 10 --process markov --json",
)
def horizon(
    seconds: Annotated[float, Option("--horizon", help="Time between corrections in s.")],
    result: OptionalFit = None,
    sheet: Sheet = None,
    axis: Annotated[str | None, Option(help="Axis, e.g. gyro_x; by default all axes.")] = None,
    process: Annotated[
        Literal["walk", "markov"],
        Option(help="How the filter models the bias: as a random walk or a Gauss–Markov process."),
    ] = "walk",
    probability: Annotated[float, Option(help="Probability that the bounds hold.")] = 0.95,
    as_json: TableAsJson = False,
) -> None:
    prepare()
    from allanjax.estimate.horizon import horizon

    fit = fit_or_sheet(result, sheet)
    noise = horizon(fit, seconds, process=process, axes=axis, probability=probability)
    print_result(noise, as_json)


@command(
    """Estimate how fast the attitude, velocity and position errors of a navigation system with
    these sensors grow at rest, or in a turn or an acceleration, and how accurately and how soon
    the sensors can find level and north.""",
    "allanjax navigate allanjax-results/imu.json --latitude 51",
    "allanjax navigate --sheet BMI088 --latitude 51",
    "allanjax navigate imu.json --latitude 51 --azimuth 0.1deg --out navigation.png",
    "allanjax navigate imu.json --latitude 51 --calibration calibration.json --turn-rate 10deg/s --for 9s",
)
def navigate(
    latitude: Annotated[float, Option(help="Latitude of the sensor in deg.")],
    result: OptionalFit = None,
    sheet: Sheet = None,
    azimuth: Annotated[
        str | None,
        Option(help="Required accuracy (1σ) of the azimuth, e.g. 0.1deg."),
    ] = None,
    time: Annotated[
        list[float] | None,
        Option(help="Time in s to report; repeat for more. Default: 1 s to 1000 s."),
    ] = None,
    at_rest: Annotated[
        float | None,
        Option(
            help="Time at rest before the start, in s, over which biases are averaged. Default: "
            "600, or the biases of the calibration are used."
        ),
    ] = None,
    calibration: Annotated[
        Path | None,
        Option(
            "--calibration",
            metavar="CALIBRATION.json",
            help="Include what a calibration leaves of biases, scale factors and misalignments.",
        ),
    ] = None,
    uncorrected: Annotated[
        bool, Option("--uncorrected", help="Include the errors that it found, as if not corrected.")
    ] = False,
    turn_rate: Annotated[
        str | None,
        Option(help="Turn rate about z (down), or about x, y and z: 10 deg/s, or 5,0,10 deg/s."),
    ] = None,
    acceleration: Annotated[
        str | None, Option(help="Acceleration along x, or along x, y and z: 0.5 g, or 0,0,1 g.")
    ] = None,
    lasting: Annotated[
        str | None, Option("--for", help="How long the turn and the acceleration last, e.g. 20 s.")
    ] = None,
    gyro_bias: Annotated[str, Option(help="Residual bias (1σ) of the gyros.")] = "0 deg/h",
    accel_bias: Annotated[str, Option(help="Residual bias (1σ) of the accelerometers.")] = "0 m/s²",
    schuler: Annotated[bool, Option("--schuler", help="Include the Schuler loop.")] = False,
    out: Annotated[Path | None, Option("--out", "-o", help="Figure to write, e.g. a.png.")] = None,
    as_json: JsonInSI = False,
) -> None:
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
    """Write the matrices A, H, Q, R and P0 of a Kalman filter for the noise of a fitted axis: x' =
    A x + w, z = H x + v. The file also gives the names and SI units of the states.""",
    "allanjax statespace allanjax-results/imu.json --axis gyro_x --out gyro_x.npz",
    "allanjax statespace imu.json --axis gyro_x --rate 200 --format c --out gyro_x.h",
)
def statespace(
    result: Annotated[
        Path, Argument(metavar="RESULT.json", help="Result of allanjax characterize: NAME.json.")
    ],
    out: Annotated[Path, Option("--out", "-o", help="File to write.")],
    axis: Annotated[str, Option(help="Axis, e.g. gyro_x.")],
    rate: Annotated[
        float | None, Option(help="Sample rate of the filter in Hz; by default the recording's.")
    ] = None,
    duration: Annotated[
        float | None,
        Option(
            help="Time in s for which the filter runs, by default the recording's length. Up to "
            "this time, bias instability is approximated by a sum of Gauss–Markov processes."
        ),
    ] = None,
    form: Annotated[
        Literal["npz", "matlab", "c"],
        Option("--format", help="NumPy file, MATLAB script or C header."),
    ] = "npz",
) -> None:
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
    """Run a Kalman filter with a noise model on a recording: estimate the bias over time with its
    interval, and test whether the innovations are white and of the predicted size, as they
    should be.""",
    "allanjax kalman imu.csv --fit allanjax-results/imu.json",
    "allanjax kalman imu.csv --terms 'N=0.1 deg/√h + K=1 deg/h/√h' --smooth --out bias.png --out bias.csv",
)
def kalman(
    reading: ReadOptions,
    file: Annotated[Path, Argument(metavar="FILE", help="Recording to filter.")],
    fit: Annotated[
        Path | None,
        Option(
            "--fit",
            metavar="RESULT.json",
            help="Result of allanjax characterize with the model of each axis.",
        ),
    ] = None,
    terms: Annotated[
        str | None,
        Option(
            help="Alternatively a noise model with values, used for every axis (gyros only or "
            "accelerometers only)."
        ),
    ] = None,
    smooth: Annotated[
        bool, Option("--smooth", help="Estimate the bias from all samples, not only earlier ones.")
    ] = False,
    out: Annotated[
        list[Path] | None,
        Option("--out", "-o", help="Figure (e.g. .png) or table (.csv) to write; repeat for more."),
    ] = None,
    as_json: JsonInSI = False,
) -> None:
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
    """Check a saved result against the limits of a specification, as characterize does with --spec:
    noise density, random walk, in-run bias and others, with the probability that the true value
    meets each limit (exit code 1: a limit is not met; 3: none, but one is undecided).
    help(allanjax.check_spec) describes the file.""",
    "allanjax spec allanjax-results/imu.json limits.yaml",
    "allanjax spec imu.json limits.yaml --out imu_spec.xml --json",
)
def spec(
    result: Annotated[
        Path,
        Argument(metavar="RESULT.json", help="Result of characterize: NAME.json."),
    ],
    limits: Annotated[Path, Argument(metavar="LIMITS.yaml", help="Limits, a YAML file.")],
    out: Annotated[Path | None, Option("--out", "-o", help="File of JUnit XML to write.")] = None,
    as_json: TableAsJson = False,
) -> None:
    prepare()
    from allanjax.comparison.specification import check_spec

    judged = check_spec(saved_fit(result), limits)
    if out is not None:
        out.write_text(judged.to_junit(), encoding="utf-8")
    print_result(judged, as_json, () if out is None else (out,))
    exit_by([judged.verdict])


@command(
    """Print the JSON schema of what check, characterize, critique, fleet or horizon writes.""",
    "allanjax schema fit > fit.schema.json",
)
def schema(
    name: Annotated[
        Literal["check", "fit", "critique", "fleet", "horizon"],
        Argument(metavar="NAME", help="Which schema; fit is that of characterize."),
    ],
) -> None:
    from allanjax.presentation.schemas import schema

    print_json(schema(name))

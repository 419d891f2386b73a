"""The commands that need no recording: `allanjax simulate`, `demo` and `convert`."""

import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Parameter
from cyclopts.validators import Number

from allanjax.base.errors import AllanjaxError
from allanjax.cli.common import (
    SCHEMA_VERSION,
    Input,
    prepare,
    print_json,
    print_list,
    print_result,
    print_written,
    refuse,
    stage,
)
from allanjax.cli.options import Written
from allanjax.cli.recordings import read_and_fit
from allanjax.fleet.options import FitOptions

if TYPE_CHECKING:
    from allanjax.estimate.result import Fit
    from allanjax.noise.estimate import Estimate
    from allanjax.noise.model import Model

_SEED = 952
_Positive = Annotated[float, Parameter(validator=Number(gt=0.0, lt=math.inf))]
# Terms of the order of a good MEMS unit, each visible in 25 minutes, so that a fit can find it.
_TRUTH = {
    "gyro_x": "Q=0.6 arcsec + N=0.20 deg/√h + B=6 deg/h",
    "gyro_y": "Q=0.5 arcsec + N=0.25 deg/√h + B=8 deg/h",
    "gyro_z": "Q=0.7 arcsec + N=0.15 deg/√h + B=5 deg/h",
    "accel_x": "N=0.05 m/s/√h + K=40 m/s/h/√h",
    "accel_y": "N=0.06 m/s/√h + K=50 m/s/h/√h",
    "accel_z": "N=0.08 m/s/√h + K=60 m/s/h/√h",
}


def simulate(
    preset: Annotated[str | None, Parameter(name="SENSOR")] = None,
    /,
    *,
    terms: str | None = None,
    sheet: str | None = None,
    sensor: Literal["gyro", "accel"] = "gyro",
    duration: _Positive = 3600.0,
    rate: _Positive = 100.0,
    seed: int = 0,
    out: Written | None = None,
    list_: bool = False,
    json: bool = False,
) -> None:
    """Simulate a static recording of a known sensor or of given noise terms.

    Writes it to a file.

    For example:
      allanjax simulate --list
      allanjax simulate hg1700 --duration 7200 --out hg1700.csv
      allanjax simulate --terms 'N=0.1 deg/sqrt(h) + B=3 deg/h' --out gyro.parquet
      allanjax simulate --sheet BMI088 --rate 200 --out bmi088.csv
      allanjax simulate --sensor accel --out a.npz --terms 'N=0.02 m/s/sqrt(h) +
          markov(amplitude=9 m/s/h/sqrt(h), correlation_time=100 s)'

    Parameters
    ----------
    preset
        Name of a sensor; --list prints the names.
    terms
        Noise terms with values and units, instead of a sensor; √h or sqrt(h) for roots.
    sheet
        Use a data sheet: a sensor listed by allanjax convert --list, or a TOML file.
    sensor
        Kind of sensor, with --terms.
    duration
        Length in s.
    rate
        Sample rate in Hz, with --terms or --sheet; a SENSOR has its own.
    seed
        The same seed gives the same recording.
    out
        File to write: .csv, .parquet or .npz. If axes have different sample rates, one file per
        rate is written, with the rate in its name.
    list_
        List the sensors and exit.
    json
        Print JSON: {schema_version, seed, recordings, warnings}.
    """
    from allanjax.noise.notation import parse_model
    from allanjax.noise.simulate import SENSORS

    if list_:
        sensors = []
        for known in SENSORS.values():
            rates = [*dict.fromkeys(axis.rate for axis in known.axes)]
            sensors.append({"name": known.name, "description": known.description, "rates_hz": rates})
        print_list("sensors", sensors, _line, json)
        return
    if [preset, terms, sheet].count(None) != 2:
        refuse("SENSOR: give exactly one: a sensor, --terms or --sheet")
    if out is None:
        refuse("--out: give a file to write, e.g. imu.csv")
    if preset is not None and preset not in SENSORS:
        refuse(f"SENSOR: no sensor {preset!r}; choose from {', '.join(SENSORS)}")
    try:
        model = None if terms is None else parse_model(terms, sensor)
    except AllanjaxError as error:
        refuse(f"--terms: {error}")
    prepare(files=[out])
    from allanjax.noise.datasheet import NOT_GIVEN, datasheet
    from allanjax.noise.simulate import simulate_recording
    from allanjax.record.io import write
    from allanjax.record.recording import Recording

    recordings: tuple[Recording, ...]
    with stage("simulating"):
        if model is not None or sheet is not None:
            models: Any = datasheet(str(sheet)) if model is None else {sensor: model}
            recordings = (simulate_recording(models, round(duration * rate), rate, seed, name=out.stem),)
        else:
            recordings = SENSORS[str(preset)].simulate(duration, seed)
        written = []
        for recording in recordings:
            path = out if len(recordings) == 1 else out.with_stem(f"{out.stem}_{recording.rate:g}Hz")
            write(recording, path)
            n, rate = recording.n, recording.rate
            told = f"wrote {path}: {', '.join(recording.names)}; {n:,} samples at {rate:g} Hz"
            print(told, file=sys.stderr if json else sys.stdout)
            sizes = {"n": n, "rate_hz": rate, "duration_s": n / rate}
            written.append({"file": str(path), "axes": recording.names, **sizes})
    warnings = [note for note in recordings[0].notes if NOT_GIVEN in note]
    for note in warnings:
        print(f"warning: {note}", file=sys.stderr)
    if json:
        print_json(
            {"schema_version": SCHEMA_VERSION, "seed": seed, "recordings": written, "warnings": warnings}
        )


def _line(name: str, description: str, rates_hz: Sequence[float]) -> str:
    """Line of a sensor in the list."""
    return f"{name:12} {description}; {', '.join(f'{rate:g} Hz' for rate in rates_hz)}"


def demo(*, out: Annotated[Path, Parameter(alias="-o")] = Path("allanjax-demo"), json: bool = False) -> None:
    """Characterize a simulated six-axis sensor and compare it with the true coefficients.

    Parameters
    ----------
    out
        Folder for the recording and the results.
    json
        Print JSON: {schema_version, fit, coefficients, written}.
    """
    prepare(out)
    with stage("loading allanjax"):
        from allanjax.base.earth import STANDARD_GRAVITY
        from allanjax.noise.notation import parse_model
        from allanjax.noise.simulate import simulate_recording
        from allanjax.presentation.files import with_checks, write_results
        from allanjax.record.io import write
    file = out / "demo.csv"
    with stage("simulating 25 minutes of a six-axis sensor at 100 Hz"):
        models = {a: parse_model(text, "gyro" if "gyro" in a else "accel") for a, text in _TRUTH.items()}
        gravity = {"accel_z": STANDARD_GRAVITY}
        recording = simulate_recording(models, 150_000, 100.0, _SEED, bias=gravity, name="demo")
        write(recording, file)
    _, check, spectrum, fit = read_and_fit(Input(file, str(file), file.stem), FitOptions())
    with stage("writing results"):
        paths = write_results(fit, spectrum, out, file.stem, check)
    written = [file, *paths]
    compared = _compared(fit, models)
    if json:
        keys = ("axis", "label", "true_si", "inside")
        rows = [dict(zip(keys, (c.axis.name, c.label, *told), strict=True)) for c, *told in compared]
        document = {"schema_version": SCHEMA_VERSION, "fit": with_checks(fit, check), "coefficients": rows}
        print_json({**document, "written": [str(path) for path in written]})
        print_written(written, json)
        return
    print(_as_table(compared))
    print_written(written)
    print("\nFor your own recording:\n    allanjax characterize imu.csv")
    print("If it has no time stamps and no units in its header:")
    print("    allanjax characterize imu.csv --rate 100 --gyro-unit deg/s --accel-unit m/s^2")


def _compared(fit: "Fit", models: "Mapping[str, Model]") -> "list[tuple[Estimate, float, bool]]":
    """Each coefficient of a fit, its true value in SI, and whether the 95 % interval contains that.

    Of a term that is not detected, whether the true value is below the upper limit.
    """
    compared = []
    for result in fit.results:
        for c in result.coefficients.values() if result.converged else ():
            truth = models[result.axis.name].values.get(c.label) or 0.0
            limit = None if c.detected else c.upper_limit
            lower, upper = c.interval if limit is None else (0.0, limit)
            compared.append((c, float(truth), bool(lower <= truth <= upper)))
    return compared


def _as_table(compared: "Sequence[tuple[Estimate, float, bool]]") -> str:
    """Estimates and true coefficients in usual units, and how many intervals contain the latter."""
    from allanjax.base.tables import as_text, columns_from
    from allanjax.base.wording import plain

    rows = []
    for c, truth, inside in compared:
        shown, true = c.in_unit(), replace(c, value=truth).in_unit()
        told = f"{plain(true.value, 4)} {true.unit}" if truth else "none"
        rows.append((c.axis.name, c.title, shown.describe(), told, "inside" if inside else "OUTSIDE"))
    headings = ("axis", "coefficient", "estimate", "true", "95 %")
    table = as_text("estimates and true coefficients", [columns_from(headings, rows)])
    held = sum(inside for _, _, inside in compared)
    return (
        f"{table}\n{held} of {len(rows)} 95 % intervals contain the true value; on average one in twenty "
        "does not."
    )


def convert(
    value: float | None = None,
    unit: str | None = None,
    /,
    *,
    to: str | None = None,
    sided: Literal["one", "two"] | None = None,
    sheet: str | None = None,
    list_: bool = False,
    json: bool = False,
) -> None:
    """Convert a value from one unit to another, or a data sheet to noise coefficients.

    Write roots as √Hz, sqrt(Hz) or rt-Hz. A density per √Hz is one- or two-sided:
    without --sided, both results are printed.

    For example:
      allanjax convert 0.003 deg/s/√Hz --to 'deg/sqrt(h)'
      allanjax convert 150 ug/rtHz --to m/s/√h --sided one
      allanjax convert --sheet BMI088
      allanjax convert --sheet my-sensor.toml
      allanjax convert --list

    Parameters
    ----------
    value
        The number.
    unit
        Its unit.
    to
        Unit to convert to.
    sided
        Whether a density per √Hz is one-sided, as in data sheets, or two-sided.
    sheet
        Data sheet to convert to noise coefficients: a TOML file, or a name that --list prints.
    list_
        List the sensors with a built-in data sheet and exit.
    json
        Print JSON: {schema_version, value, unit, converted}; of a data sheet {schema_version, name,
        coefficients, ...}.
    """
    if list_:
        from allanjax.noise.datasheet import known_sheets

        sheets = [{"name": name, "source": figures["source"]} for name, figures in known_sheets().items()]
        print_list("sheets", sheets, lambda name, source: f"{name:12} {source}", json)
        return
    if (sheet is None) == (value is None) or (sheet is not None and (to or sided)):
        refuse("give VALUE UNIT --to UNIT, or --sheet SHEET")
    if sheet is not None:
        from allanjax.noise.datasheet import datasheet

        print_result(datasheet(sheet), json)
        return
    if unit is None or to is None:
        refuse("give VALUE UNIT --to UNIT, e.g. 3 deg/s/√Hz --to deg/√h")
    given = float(value or 0.0)
    converted = _converted(given, unit, to, sided)
    if json:
        found = [{"value": x, "unit": to, "density": density} for density, x in converted.items()]
        print_json({"schema_version": SCHEMA_VERSION, "value": given, "unit": unit, "converted": found})
        return
    for density, number in converted.items():
        print(f"{given:g} {unit} = {number:.6g} {to}{_about(density, sided is not None)}")


def _converted(
    value: float, unit: str, to: str, sided: Literal["one", "two"] | None
) -> dict[str | None, float]:
    """The value in the other unit by the kind of density that it is: None if that makes no difference.

    Of a density of power it is the root, where the other unit is that of an amplitude.
    """
    from allanjax.base.errors import UnitError
    from allanjax.record.units import convert, density_power

    root = f"({unit})^0.5"
    try:
        number = convert(value, unit, to)
    except UnitError as error:
        if value < 0.0:
            raise
        try:
            number, unit = convert(math.sqrt(value), root, to), root
        except UnitError:
            raise error from None
    power = density_power(unit) - density_power(to)
    if power == 0.0:
        return {None: number}
    both = {"one-sided": number / math.sqrt(2.0) ** (2.0 * power), "two-sided": number}
    return {density: x for density, x in both.items() if sided is None or density.startswith(sided)}


def _about(density: str | None, chosen: bool) -> str:
    """What to add to a result about the kind of density, and whether the user chose it."""
    if density is None:
        return ""
    if chosen:
        return f" ({density} density)"
    if density == "one-sided":
        return " if the density is one-sided, as usual in data sheets (--sided one)"
    return " if it is two-sided, as in IEEE 952 and in allanjax (--sided two)"

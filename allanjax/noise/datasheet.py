"""Coefficients from the figures of a data sheet.

Data sheets give the same noise in several ways, often without stating the convention. If a figure is
ambiguous, the missing information is requested; assumptions are stated.

- N is √S with the two-sided density S: a one-sided density (from a spectrum analyser, as in most data sheets)
  is √2·N. A random walk in deg/√h is N itself.
- White noise has the rms √(2N²·W) in the equivalent noise bandwidth W; for a one-pole filter W is π/2 times
  the −3 dB bandwidth.
- The least Allan deviation of flicker noise is √(2 ln2/π)·B = 0.664 B (Hou 2004, eq. 4.48).
- Rounding to steps q adds q²/12 to the variance: for increments that is quantization noise, Q = q/√12; for
  rates at a sample rate f it is white noise, N = q/√(12 f), as long as the noise exceeds half a step.
"""

from __future__ import annotations

import dataclasses
import difflib
import functools
import math
import os
import re
import tomllib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from importlib.resources import files
from pathlib import Path
from typing import Any

from allanjax.base.equality import ByValue
from allanjax.base.errors import AllanjaxError, UnitError, expect
from allanjax.base.tables import Column, Tabled, columns_from
from allanjax.base.wording import percent, plain, significant
from allanjax.noise.estimate import Estimate
from allanjax.noise.model import Model
from allanjax.noise.terms import AngleRandomWalk, BiasInstability, Quantization, RateRandomWalk
from allanjax.record.columns import Axis
from allanjax.record.units import (
    SENSORS,
    SI,
    Sensor,
    convert,
    default_coefficient_unit,
    density_power,
    parse_quantity,
    parse_sample_unit,
    si_unit,
)

#: Terms that every sensor has, with their symbols; words for a term that a sheet lacks, and what to do.
USUAL = {"angle_random_walk": "N", "bias_instability": "B", "rate_random_walk": "K"}
NOT_GIVEN = "not given"
REMEDY = (
    "for a measurement, record the sensor at rest (allanjax check reports for how long) and characterize "
    "the recording; until then choose a value yourself"
)
SCHEMA_VERSION = 1
#: Label of the least Allan deviation, which is no coefficient.
LEAST = "least_allan_deviation"
#: Default sample rate [Hz] for a sheet's noise, which hardly depends on it.
RATE = 100.0
#: Least Allan deviation of flicker noise over B.
MINIMUM = math.sqrt(2.0 * math.log(2.0) / math.pi)
# Equivalent noise bandwidth of a one-pole filter over its −3 dB bandwidth.
_ONE_POLE = math.pi / 2.0
# Figures of a sensor, each with the information that it needs and the allowed answers.
_FIGURES: dict[str, dict[str, tuple[str, ...]]] = {
    "random_walk": {},
    "noise_density": {"sided": ("one", "two")},
    "rms_noise": {"bandwidth": (), "bandwidth_is": ("first-order", "noise")},
    "in_run_bias_instability": {"reading": ("minimum", "B")},
    "rate_random_walk": {},
    "lsb": {},
}
# Figures that give N, the first of which is used, with the exponents of time in their units, rate·s^exponent.
_WHITE = {"random_walk": 0.5, "noise_density": 0.5, "rms_noise": 0.0}
_WHY = {
    "sided": "densities in data sheets are usually one-sided (√2 times N), those in IEEE 952 two-sided (N)",
    "bandwidth": "the rms of white noise depends on it",
    "bandwidth_is": 'either the −3 dB bandwidth of a one-pole filter ("first-order") or the equivalent noise '
    'bandwidth, as of an ideal filter ("noise")',
    "reading": 'either the least Allan deviation ("minimum"), which is 0.664 B, or the coefficient ("B")',
    "rate": "the white noise of rounded rates depends on it",
}


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class DataSheet(ByValue, Tabled):
    """Noise models of the sensors of a data sheet, and what was assumed.

    Attributes:
        name: name of the unit.
        source: source of the figures.
        models: the model of each sensor, "gyro" or "accel", with the coefficients that the figures give.
        statements: assumptions, missing coefficients, and differences between figures.
    """

    name: str
    source: str
    models: Mapping[Sensor, Model]
    statements: tuple[str, ...]

    def __getitem__(self, sensor: Sensor) -> Model:
        """The model of a sensor; AllanjaxError if the data sheet has none."""
        if sensor not in self.models:
            raise AllanjaxError(f"{self.name} has no {sensor!r}; it has {', '.join(self.models)}")
        return self.models[sensor]

    def to_dict(self) -> dict[str, Any]:
        """The coefficients as plain dictionaries, for JSON."""
        coefficients = [
            {"sensor": sensor, "coefficient": c.label, "value": x.value, "unit": x.unit, "si": c.value}
            for sensor in self.models
            for c in self.coefficients(sensor).values()
            for x in (c.in_unit(),)
        ]
        return {
            "schema_version": SCHEMA_VERSION,
            "name": self.name,
            "source": self.source,
            "coefficients": coefficients,
            "statements": list(self.statements),
        }

    def lacking(self, sensor: Sensor) -> tuple[str, ...]:
        """Which of N, B and K the figures of a sensor do not give."""
        return tuple(symbol for label, symbol in USUAL.items() if label not in self[sensor].term_labels)

    def coefficients(self, sensor: Sensor) -> dict[str, Estimate]:
        """Coefficients of a sensor by label, in SI: values without an interval."""
        axis, model = Axis(sensor, sensor, SI[sensor]["rate"]), self[sensor]
        coefficients = {}
        for p in model.parameters:
            if p.parameter.is_amplitude:
                value = float(p.start or 0.0)
                coefficients[p.label] = Estimate(
                    axis=axis,
                    label=p.label,
                    term=p.term_label,
                    parameter=p.parameter,
                    value=value,
                    std=0.0,
                    interval=(value, value),
                    interval_68=(value, value),
                    held=True,
                )
        return coefficients

    def of_axes(self) -> dict[str, Model]:
        """The model of each of three axes of each sensor, by name: `gyro_x` to `accel_z`."""
        return {f"{sensor}_{letter}": model for sensor, model in self.models.items() for letter in "xyz"}

    def _title(self) -> str:
        return "" if self.name else "data sheet"

    def _tables(self) -> list[list[Column]]:
        tables = []
        for sensor in self.models:
            given = [c.in_unit() for c in self.coefficients(sensor).values()]
            cells = {"sensor": sensor} | dict.fromkeys(USUAL.values(), NOT_GIVEN)
            heads = {c.symbol: f"{c.symbol} ({c.unit})" for c in given}
            cells |= {c.symbol: significant(c.value) for c in given}
            tables.append(columns_from([heads.get(name, name) for name in cells], [list(cells.values())]))
        return tables

    def _notes(self) -> list[str]:
        source = [f"source: {self.source}"] if self.source else []
        return [*source, *(f"note: {line}" for line in self.statements)]


def datasheet(source: str | os.PathLike[str] | Mapping[str, Any]) -> DataSheet:
    """Noise models from the figures of a data sheet: of a known sensor, in a TOML file or in a dictionary.

    `datasheet("BMI088")` is that of a sensor of `datasheets()`. In a file, a figure is a text with its unit:

        name = "ADIS16470"
        [gyro]
        noise_density = "0.008 deg/s/√Hz"
        sided = "one"
        in_run_bias_instability = "8 deg/h"
        reading = "minimum"
        [accel]
        in_run_bias_instability = "13 µg"
        reading = "minimum"

    A sensor may have `random_walk` (deg/√h); `noise_density`, with `sided` "one" or "two"; `rms_noise`, with
    its `bandwidth`, and `bandwidth_is` "first-order" (−3 dB of one pole) or "noise" (the equivalent noise
    bandwidth); `in_run_bias_instability`, with `reading` "minimum" (of the Allan deviation, 0.664 B) or "B";
    `rate_random_walk`; and `lsb`, the step of the output, which for rates needs the sample `rate`. N is taken
    from the first of the first three; statements report how much the others differ. `conditions` is a text,
    e.g. "typical, 25 °C".

    Args:
        source: name of a sensor of `datasheets()`; path of a file; or its contents as a dictionary.

    Raises:
        AllanjaxError: an unknown name, a file that cannot be read, an unknown key, or an ambiguous figure.
        UnitError: a unit of another dimension.
    """
    expect(source, (str, os.PathLike, Mapping), "datasheet takes a name, a path or a dictionary")
    where, document = _document(source)
    unknown = [key for key in document if key not in ("name", "source", *SENSORS)]
    present = [sensor for sensor in SENSORS if sensor in document]
    if unknown or not present:
        problem = f"unknown key {unknown[0]!r}" if unknown else "no sensor"
        raise AllanjaxError(f"{where}: {problem}; the keys are name, source, [gyro] and [accel]")
    sheets = {sensor: Figures(sensor, document[sensor], f"{where}: [{sensor}]") for sensor in present}
    models = {sensor: sheet.model() for sensor, sheet in sheets.items()}
    statements = [f"{sensor}: {line}" for sensor, sheet in sheets.items() for line in sheet.statements]
    name = str(document.get("name", "" if isinstance(source, Mapping) else Path(source).stem))
    found = DataSheet(name, str(document.get("source", "")), models, ())
    for sensor in models:
        if lacking := found.lacking(sensor):
            statements.append(f"{sensor}: {' and '.join(lacking)} {NOT_GIVEN}; {REMEDY}")
    return dataclasses.replace(found, statements=tuple(dict.fromkeys(statements)))


def datasheets() -> tuple[str, ...]:
    """Names of the sensors whose data sheets `datasheet` knows; each sheet has its `source`."""
    return tuple(known_sheets())


@functools.cache
def known_sheets() -> Mapping[str, Mapping[str, Any]]:
    """Contents of each data sheet, by the name of its sensor, in the form that `datasheet` takes."""
    text = files(__package__).joinpath("sheets.toml").read_text(encoding="utf-8")
    return {name: {"name": name, **figures} for name, figures in tomllib.loads(text).items()}


def _plain(name: str) -> str:
    """A name without hyphens, spaces and case."""
    return re.sub(r"[\W_]", "", name).casefold()


def _document(source: str | os.PathLike[str] | Mapping[str, Any]) -> tuple[str, Mapping[str, Any]]:
    """Contents of a data sheet, and its name in messages."""
    if isinstance(source, Mapping):
        return "data sheet", source
    for name, sheet in known_sheets().items():
        if isinstance(source, str) and _plain(name) == _plain(source):
            return f"data sheet {name}", sheet
    try:
        return str(source), tomllib.loads(Path(source).read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        if isinstance(error, FileNotFoundError) and isinstance(source, str) and Path(source).suffix == "":
            known, own = {_plain(there): there for there in known_sheets()}, _plain(source)
            near = [there for plain, there in known.items() if own and plain.startswith(own)]
            near = near or [known[match] for match in difflib.get_close_matches(own, known, cutoff=0.8)]
            hint = f"; did you mean {' or '.join(near)}?" if near else ""
            names = f"known are {', '.join(known_sheets())}{hint}"
            raise AllanjaxError(f"{source!r} is neither a known data sheet nor a file; {names}") from None
        why = error.strerror if isinstance(error, OSError) else error
        raise AllanjaxError(f"{source}: {why}; give a TOML file with [gyro] or [accel]") from error


class Figures:
    """Figures of one sensor; collects the assumptions as statements while they are read.

    `others` are further figures, by name, with the exponent of time of their SI unit, rate·s^exponent.
    """

    def __init__(self, sensor: Sensor, figures: Any, where: str, others: Mapping[str, float] = {}) -> None:
        self.sensor, self.figures, self.where, self.others = sensor, figures, where, others
        self.statements: list[str] = []
        if not isinstance(figures, Mapping):
            raise AllanjaxError(f"{where} is not a table: write its figures below [{sensor}]")
        answers = [key for options in _FIGURES.values() for key in options]
        for key in figures:
            if key not in (*_FIGURES, *answers, "rate", "conditions", *others):
                known = ", ".join((*_FIGURES, *answers, "rate", "conditions"))
                more = ", and names of coefficients such as N or quantization" if others else ""
                raise AllanjaxError(f"{where}: unknown key {key!r}; the keys are {known}{more}")

    def model(self) -> Model:
        """Sum of the terms that the figures give."""
        if "conditions" in self.figures:
            self.statements.append(str(self.figures["conditions"]))
        Q, stepped = self._rounding()
        N, B, K = self._white(stepped), None, None
        if "in_run_bias_instability" in self.figures:
            label, B = self.one("in_run_bias_instability")
            B /= MINIMUM if label == LEAST else 1.0
        if "rate_random_walk" in self.figures:
            _, K = self.one("rate_random_walk")
        values = ((Quantization, Q), (AngleRandomWalk, N), (BiasInstability, B), (RateRandomWalk, K))
        terms = [
            term().replace(**{term.amplitude_parameter().name: value})
            for term, value in values
            if value is not None
        ]
        if not terms:
            raise AllanjaxError(f"{self.where}: no figure; give at least one of {', '.join(_FIGURES)}")
        return Model(tuple(terms))

    def one(self, key: str) -> tuple[str, float]:
        """What one figure gives [SI], with the label of its coefficient, or LEAST for the least deviation."""
        if key in ("random_walk", "noise_density"):
            with self._named(key):
                per_root_hz = density_power(self._quantity(self.figures[key], key)[1]) > 0.0
            if per_root_hz and key == "random_walk":
                raise self._error(key, "is per √Hz: give it as noise_density with sided, or in deg/√h")
            if not per_root_hz and key == "noise_density":
                raise self._error(key, "is not per √Hz: if it is a random walk, give it as random_walk")
        exponent = {**_WHITE, "in_run_bias_instability": 0.0, "rate_random_walk": -0.5, **self.others}[key]
        unit = si_unit(default_coefficient_unit(self.sensor, exponent))
        value = self._in_si(self.figures[key], unit, key)
        taken = f"{key} is taken as"
        if key == "in_run_bias_instability":
            if self._answer(key, "reading") == "B":
                self.statements.append(f"{taken} B; the least Allan deviation is 0.664 B")
                return "bias_instability", value
            upper = "N and K contribute to it, so this B is an upper limit"
            self.statements.append(f"{taken} the least Allan deviation, 0.664 B; {upper}")
            return LEAST, value
        if key == "noise_density":
            one_sided = self._answer(key, "sided") == "one"
            self.statements.append(f"{taken} {'one-sided, √2·N' if one_sided else 'two-sided, N'}")
            value /= math.sqrt(2.0) if one_sided else 1.0
        elif key == "rms_noise":
            bandwidth = self._in_si(self._answer(key, "bandwidth"), "Hz", "bandwidth")
            width, how = bandwidth, ""
            if self._answer(key, "bandwidth_is") == "first-order":
                width *= _ONE_POLE
                how = f" (1.57 times the −3 dB bandwidth, {bandwidth:g} Hz)"
            self.statements.append(f"{taken} white in a noise bandwidth of {plain(width, 4)} Hz{how}")
            value /= math.sqrt(2.0 * width)
        return "angle_random_walk" if key in _WHITE else key, value

    def _white(self, stepped: float | None) -> float | None:
        """N from the first figure that gives it, else from steps alone."""
        given = {key: self.one(key)[1] for key in _WHITE if key in self.figures}
        if not given:
            if stepped is not None:
                self.statements.append("N is from the quantization steps alone")
            return stepped
        (first, N), *others = given.items()
        for key, value in others:
            self.statements.append(f"N is from {first}; {key} would give {value / N:.2f} times as much")
        if stepped is not None:
            share = (stepped / N) ** 2
            self.statements.append(
                f"quantization steps would add {percent(share)} to the power of N; they are not added"
            )
        return N

    def _rounding(self) -> tuple[float | None, float | None]:
        """Q from steps of increments, or N from steps of rates."""
        if "lsb" not in self.figures:
            return None, None
        number, unit = self._quantity(self.figures["lsb"], "lsb")
        if inverse := re.fullmatch(r"LSB\s*/\s*\(?(.+?)\)?", unit):
            number, unit = 1.0 / number, inverse[1]
        unit = re.sub(r"\s*/\s*LSB$", "", unit)
        with self._named("lsb"):
            step = parse_sample_unit(unit, self.sensor)
        size = number * step.scale / math.sqrt(12.0)
        if step.quantity == "increment":
            self.statements.append("lsb is taken as a step of increments, Q = lsb/√12")
            return size, None
        if "rate" not in self.figures:
            raise self._error("lsb", f'needs rate, e.g. rate = "100 Hz": {_WHY["rate"]}')
        return None, size / math.sqrt(self._in_si(self.figures["rate"], "Hz", "rate"))

    def _answer(self, figure: str, key: str) -> str:
        """Information that a figure needs; AllanjaxError if it is missing."""
        options = _FIGURES[figure][key]
        value = self.figures.get(key)
        if value is None or (options and value not in options):
            choices = " or ".join(f'"{option}"' for option in options) or 'e.g. "100 Hz"'
            wrong = "" if value is None else f", not {value!r}"
            raise self._error(figure, f"needs {key} = {choices}{wrong}: {_WHY[key]}")
        return str(value)

    def _quantity(self, text: Any, key: str) -> tuple[float, str]:
        """Number and unit of a figure, whose unit may end in rms."""
        number, unit = parse_quantity(text) or (0.0, "")
        if not 0.0 < number < math.inf:
            raise self._error(
                key, f'must be a positive number with its unit, as in "0.1 deg/s", not {text!r}'
            )
        return number, re.sub(r"\s+rms$", "", unit)

    def _in_si(self, text: Any, si: str, key: str) -> float:
        """Figure in this SI unit; UnitError for a unit of another dimension."""
        number, unit = self._quantity(text, key)
        with self._named(key):
            return convert(number, unit, si, None if si == "Hz" else self.sensor)

    @contextmanager
    def _named(self, key: str) -> Iterator[None]:
        """Context in which a UnitError names the figure."""
        try:
            yield
        except UnitError as error:
            raise UnitError(f"{self.where} {key}: {error}") from error

    def _error(self, key: str, message: str) -> AllanjaxError:
        return AllanjaxError(f"{self.where} {key} {message}")

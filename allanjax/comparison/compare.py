"""`compare`: sensors of any grade side by side, in their coefficients, curves, drift and growth of errors.

Two coefficients differ if their ratio differs from one. Coefficients that were detected are compared by their
logarithms, whose errors are nearly normal; one that is not detected has a square that is normal about zero,
with a standard deviation by its limit. The p-values of all coefficients of a
comparison are corrected for their number (Holm 1979, Scand. J. Statist. 6:65), so that the probability of any
difference among equal sensors is 5 %. A figure without an error, as in data sheets, is taken as exact.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import math
import os
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Float
from scipy.special import ndtr

from allanjax.allan.deviation import AllanDeviation
from allanjax.base.equality import ByValue
from allanjax.base.errors import AllanjaxError
from allanjax.base.late import presented
from allanjax.base.normal import ONE_SIDED_95, TWO_SIDED_95
from allanjax.base.tables import Column, Tabled, columns_from
from allanjax.base.testing import holm
from allanjax.base.wording import duration, format_range, numbered, plain, significant
from allanjax.critic.result import Critique
from allanjax.estimate.as_json import in_json, load_one
from allanjax.estimate.fit import fit
from allanjax.estimate.least_deviation import least_deviation
from allanjax.estimate.result import Fit, detail
from allanjax.navigation.likely import NoiseLike, Sensors, sensors_of
from allanjax.navigation.navigator import navigate
from allanjax.noise.datasheet import LEAST, MINIMUM, NOT_GIVEN, USUAL, DataSheet, datasheet, datasheets
from allanjax.noise.estimate import SYMBOLS, Estimate, title_of, usual_unit
from allanjax.noise.model import Model
from allanjax.noise.simulate import SENSORS as PRESETS
from allanjax.noise.simulate import SensorPreset
from allanjax.noise.terms import AngleRandomWalk, BiasInstability
from allanjax.record.io.given import RecordingLike, as_recording
from allanjax.record.recording import Axis
from allanjax.record.units import SENSORS, SI, Sensor, parse_quantity, unit_scale

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

#: Horizons of the drift and the growth of errors [s]; probability of any difference among equal sensors.
HORIZONS, LEVEL = (60.0, 600.0, 3600.0), 0.05
SCHEMA_VERSION = 1
# Coefficients that every sensor has, and which of N, B and K they are or follow from.
_WANTED = {**USUAL, LEAST: "B"}
_GRADES = ("grade of", "sensor", "by random walk", "by drift")
# Longest time of an error as a multiple of the record, and what stands for longer ones; nodes of the mean
# over a normal law.
_BEYOND, _TOO_SHORT = 3.0, "record too short"
_NODES = 40


#: What can be compared: fits, critiques, recordings, data sheets, presets, curves, and their files or names.
Comparable: TypeAlias = Fit | Critique | DataSheet | SensorPreset | AllanDeviation | RecordingLike


class Compared(NamedTuple):
    """A sensor of a comparison.

    Attributes:
        label: what it is called; "" if it has no name.
        source: what is known of it, in words.
        coefficients: estimates by axis and label [SI]; a data sheet has those of "gyro" and "accel". Beside
            the amplitudes it is the least Allan deviation, `LEAST`.
        noise: its noise, for the growth of errors; None if no axis is a measurement.
        models: noise model of each axis that has one.
        rate: sample rate [Hz].
        curve: measured Allan deviations, if there are any.
    """

    label: str
    source: str
    coefficients: Mapping[str, Mapping[str, Estimate]]
    noise: NoiseLike | None
    models: Mapping[str, Model]
    rate: float
    curve: AllanDeviation | None = None

    def lacking(self, axis: str) -> list[str]:
        """Which of N, B and K a data sheet or the terms of a fit do not give; a preset is complete."""
        known = USUAL if isinstance(self.noise, dict) else self.of(axis) or USUAL
        return [symbol for label, symbol in USUAL.items() if label not in known]

    def of(self, axis: str) -> Mapping[str, Estimate]:
        """Coefficients of an axis, or in a data sheet of its sensor; empty if there are none."""
        return self._own(self.coefficients, axis) or {}

    def model(self, axis: str) -> Model | None:
        """Noise model of an axis, that of its sensor for a data sheet."""
        return self._own(self.models, axis)

    def _own(self, known: Mapping[str, Any], axis: str) -> Any:
        return known.get(axis) or known.get(axis.partition("_")[0])

    def deviation(self, axis: str, time: Float[np.ndarray, " t"]) -> Float[np.ndarray, " t"]:
        """Allan deviation of an axis's model at cluster times [s]; a fit states its own."""
        if isinstance(self.noise, Fit):
            return self.noise.model_deviation(axis, time)
        model = self.model(axis)
        assert model is not None
        return np.sqrt(np.asarray(model.sampled(self.rate).allan_variance(time)))


def compared(data: Comparable) -> Compared:
    """A sensor in the form of comparisons; recordings are read and fitted."""
    known = _opened(data)
    if isinstance(known, DataSheet):
        values = {str(sensor): _with_least(known.coefficients(sensor)) for sensor in known.models}
        models = {str(sensor): model for sensor, model in known.models.items()}
        source = f"data sheet: {known.source}" if known.source else "data sheet"
        return Compared(known.name, source, values, known, models, 100.0)
    if isinstance(known, SensorPreset):
        values = {axis.name: _with_least(axis.estimates) for axis in known.axes}
        models = {axis.name: axis.model for axis in known.axes}
        return Compared(known.name, known.description, values, models, models, known.axes[0].rate)
    found = known if isinstance(known, Fit) else fit(known)
    curve = found.curve
    measured = {r.axis.name: r for r in found.results if r.measured}
    values = {name: {**r.coefficients, LEAST: least_deviation(found, r)[0]} for name, r in measured.items()}
    models = {name: r.model for name, r in measured.items()}
    source = f"fit of {curve.n / curve.rate / 3600.0:.2g} h at {curve.rate:g} Hz"
    if not values:
        source += "; not a measurement of the sensor"
    if not curve.determined:
        source = f"fit of an Allan curve; {curve.unknown[0]}"
    return Compared(found.name, source, values, found if values else None, models, curve.rate, curve)


def _with_least(coefficients: dict[str, Estimate]) -> dict[str, Estimate]:
    """Coefficients with the least Allan deviation that follows from bias instability, 0.664 B."""
    B = coefficients.get(BiasInstability.name())
    if B is None:
        return coefficients
    return coefficients | {LEAST: dataclasses.replace(B.times(MINIMUM), label=LEAST, parameter=None)}


def _opened(data: Comparable) -> Any:
    """What a path or a name stands for, and the fit of a critique."""
    if isinstance(data, Critique):
        return data.fit
    if isinstance(data, Fit | DataSheet | SensorPreset | AllanDeviation):
        return data
    if not isinstance(data, str | os.PathLike):
        return as_recording(data)
    path, name = Path(data), str(data)
    if path.exists():
        readers: dict[str, Any] = {".json": load_one, ".toml": datasheet}
        return readers.get(path.suffix, as_recording)(path)
    if name in PRESETS:
        return PRESETS[name]
    if path.suffix:
        raise AllanjaxError(f"{name}: no such file; check the path")
    try:
        return datasheet(name)
    except AllanjaxError as error:
        presets = f"presets are {', '.join(PRESETS)}; data sheets are {', '.join(datasheets())}"
        raise AllanjaxError(f"{name!r} is neither a file nor a known sensor; {presets}") from error


#: Grade of what is beyond the limits of all others.
LAST = "consumer"


@functools.cache
def grades() -> tuple[Mapping[tuple[str, str], Mapping[str, float]], str]:
    """Limits [SI] by sensor and coefficient, and then by grade, the best first; and their source."""
    tables = tomllib.loads(files(__package__).joinpath("grades.toml").read_text(encoding="utf-8"))
    source, found = str(tables.pop("source")), dict[tuple[str, str], dict[str, float]]()
    for grade, of_sensor in tables.items():
        for sensor, quantities in of_sensor.items():
            for label, text in quantities.items():
                value, unit = parse_quantity(text) or (math.nan, "")
                found.setdefault((sensor, label), {})[grade] = value * unit_scale(unit, sensor)
    return found, source


class Difference(NamedTuple):
    """A coefficient of one sensor against that of the reference.

    Attributes:
        ratio: value over the reference's; nan where one of them is not detected.
        interval: its 95 % interval; an end is 0 or infinite where only a limit is known.
        p_value: of equality, not corrected; None if it cannot be tested.
        corrected: the p-value after Holm's correction for all coefficients of the comparison.
    """

    ratio: float
    interval: tuple[float, float]
    p_value: float | None
    corrected: float | None = None

    @property
    def differs(self) -> bool | None:
        """Whether the coefficients differ at 5 %; None if that cannot be tested."""
        return None if self.corrected is None else self.corrected < LEVEL

    @property
    def verdict(self) -> str:
        """ "larger", "smaller", "no" for no difference that is shown, or "" if that cannot be tested."""
        if self.corrected is None:
            return ""
        if not self.differs:
            return "no"
        # Of an amplitude and a limit, only an amplitude as numerator has a lower end.
        is_larger = self.interval[0] > 0.0 if math.isnan(self.ratio) else self.ratio > 1.0
        return "larger" if is_larger else "smaller"

    def cells(self) -> tuple[str, str, str, str]:
        """Ratio, interval, p-value and verdict of the printed table."""
        ratio = "" if math.isnan(self.ratio) else significant(self.ratio)
        p = ""
        if self.corrected is not None:
            p = plain(self.corrected, 2) if self.corrected >= 1e-4 else "< 10⁻⁴"
        return ratio, _between(self.interval), p, self.verdict


# Of the reference itself, and where one has no coefficient.
_UNTESTED = Difference(math.nan, (math.nan, math.nan), None)


def difference(one: Estimate, reference: Estimate) -> Difference:
    """Ratio of two amplitudes with its interval, and the p-value of their equality."""
    if one.detected and reference.detected:
        error = math.hypot(one.log_std, reference.log_std)
        log = math.log(one.value / reference.value)
        reach = TWO_SIDED_95 * error
        p = 2.0 * float(ndtr(-abs(log) / error)) if error > 0.0 else None
        return Difference(math.exp(log), (math.exp(log - reach), math.exp(log + reach)), p)
    low, high = 0.0, math.inf
    p = None
    if one.detected and reference.upper_limit:
        low = one.interval[0] / reference.upper_limit
        p = _beyond_chance(one, reference.upper_limit)
    elif reference.detected and one.upper_limit:
        if reference.interval[0] > 0.0:
            high = one.upper_limit / reference.interval[0]
        p = _beyond_chance(reference, one.upper_limit)
    return Difference(math.nan, (low, high), p)


def _beyond_chance(seen: Estimate, limit: float) -> float:
    """p-value of the equality of an amplitude that is detected and one of which a limit is known.

    The square of the second is normal about zero, with a standard deviation by its limit; the logarithm of
    the first is normal, and the probability is the mean over its law.
    """
    x, weight = np.polynomial.hermite_e.hermegauss(_NODES)
    square = seen.value**2 * np.exp(2.0 * seen.log_std * x)
    tail = 2.0 * ndtr(-square * ONE_SIDED_95 / limit**2)
    return float(weight @ tail / weight.sum())


class Row(NamedTuple):
    """A coefficient of an axis of all sensors.

    Attributes:
        axis: name of the axis.
        sensor: its sensor.
        label: the coefficient.
        estimates: of each sensor, None where it has none.
        differences: of each sensor against the reference, None for the reference and where one has none.
    """

    axis: str
    sensor: Sensor
    label: str
    estimates: tuple[Estimate | None, ...]
    differences: tuple[Difference | None, ...]

    @property
    def unit(self) -> str:
        """Unit in which all are shown: their own if it is the same, else the usual one."""
        known = [c for c in self.estimates if c is not None]
        parameter, differ = known[0].parameter, len({c.usual_unit for c in known}) > 1
        return usual_unit(parameter, self.sensor) if differ and parameter else known[0].usual_unit

    @property
    def symbol(self) -> str:
        """Symbol or short name of the coefficient."""
        symbols = {**SYMBOLS, LEAST: "min σ"}
        return symbols.get(self.label) or title_of(self.label, self.sensor)

    def is_lacking(self, one: Compared) -> bool:
        """Whether N, B or K, or what the coefficient follows from, is not given for a sensor."""
        return _WANTED.get(self.label) in one.lacking(self.axis)

    def entries(self, sensors: Sequence[Compared]) -> Iterator[tuple[Compared, Estimate | None, Difference]]:
        """Each sensor that has the coefficient, or lacks what others have, with its estimate."""
        for one, c, d in zip(sensors, self.estimates, self.differences, strict=True):
            if c is not None or self.is_lacking(one):
                yield one, c, d or _UNTESTED

    def cells(self, sensors: Sequence[Compared]) -> Iterator[tuple[str, ...]]:
        """Rows of the printed table; none if no sensor has the coefficient."""
        if any(self.estimates):
            for one, c, d in self.entries(sensors):
                value = NOT_GIVEN if c is None else detail(c, self.unit)[2]
                yield self.axis, self.symbol, one.label, value, *d.cells()


class Growth(NamedTuple):
    """A standard deviation after the `HORIZONS` with its 95 % interval, in SI.

    Attributes:
        sensor: number of the sensor in the comparison.
        name: an axis, whose error is that of the integrated rate; or "heading" or "position", the errors of a
            navigator at rest, see `navigate`.
        is_bound: whether the value is a lower bound, as not all of N, B and K are given.
        reasons: why there is no value: it is beyond three times the record, or neither B nor K is given for
            the axis; "" where there is.
        value, lower, upper: at each horizon; the ends are nan for what is taken as exact.
    """

    sensor: int
    name: str
    is_bound: bool
    reasons: tuple[str, ...]
    value: Float[np.ndarray, " t"]
    lower: Float[np.ndarray, " t"]
    upper: Float[np.ndarray, " t"]

    @property
    def kind(self) -> str:
        """Its key in `SHOWN`."""
        return next(begin for begin in SHOWN if self.name.startswith(begin))

    def cells(self) -> Iterator[str]:
        """Values with their intervals and units."""
        unit, size = SHOWN[self.kind]
        for value, low, high, why in zip(self.value, self.lower, self.upper, self.reasons, strict=True):
            to, by = ("km", 1e3) if unit == "m" and value > 1e5 else (unit, size)
            ends = f" ({format_range(low / by, high / by)})" if np.isfinite(high) else ""
            least = "≥ " if self.is_bound else ""
            yield why or f"{least}{significant(value / by)}{ends} {to}"


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Comparison(ByValue, Tabled):
    """Sensors side by side.

    Attributes:
        sensors: the sensors.
        reference: number of the one that the others are compared with.
        rows: coefficients with their differences.
    """

    sensors: tuple[Compared, ...]
    reference: int
    rows: tuple[Row, ...]

    @functools.cached_property
    def growths(self) -> tuple[Growth, ...]:
        """Errors after the `HORIZONS`: of each axis's integrated rate, and of a navigator at rest."""
        every = (g for k, one in enumerate(self.sensors) for g in _growths(k, one))
        # Of a data sheet, the drift of any axis stands below those of the axes.
        return tuple(sorted(every, key=lambda g: ([*SHOWN].index(g.kind), "_" not in g.name, g.name)))

    @property
    def labels(self) -> tuple[str, ...]:
        """What the sensors are called."""
        return tuple(one.label for one in self.sensors)

    def __getitem__(self, place: tuple[str, str]) -> Row:
        """The row of an axis and a coefficient, e.g. `comparison["gyro_x", "angle_random_walk"]`."""
        for row in self.rows:
            if (row.axis, row.label) == place or (row.axis, SYMBOLS.get(row.label)) == place:
                return row
        raise AllanjaxError(f"no coefficient {place!r}; there are {[(r.axis, r.label) for r in self.rows]}")

    def to_dataframe(self) -> pd.DataFrame:
        """One row per axis, coefficient and sensor, in usual units."""
        import pandas as pd

        return pd.DataFrame(self._records())

    def _records(self) -> Iterator[dict[str, Any]]:
        for row in self.rows:
            for one, c, d in row.entries(self.sensors):
                known = {"coefficient": row.label, "value": math.nan} if c is None else c.row()
                yield {
                    **known,
                    "axis": row.axis,
                    "sensor": one.label,
                    "reason": NOT_GIVEN if c is None else None,
                    "ratio": d.ratio,
                    "ratio_lower_95": d.interval[0],
                    "ratio_upper_95": d.interval[1],
                    "p_value": d.corrected,
                    "differs": d.differs,
                }

    def to_dict(self) -> dict[str, Any]:
        """The comparison as plain dictionaries and lists, for JSON; growth in SI."""
        growths = []
        for g in self.growths:
            reasons = [why or None for why in g.reasons]
            numbers = {name: getattr(g, name) for name in ("value", "lower", "upper", "is_bound")}
            growths.append({"sensor": self.labels[g.sensor], "of": g.name, "reasons": reasons, **numbers})
        return {
            "schema_version": SCHEMA_VERSION,
            "sensors": [{"name": one.label, "source": one.source} for one in self.sensors],
            "reference": self.labels[self.reference],
            "coefficients": in_json([*self._records()]),
            "horizons_s": list(HORIZONS),
            "grades": [dict(zip(_GRADES, row, strict=True)) for row in self.grades],
            "growth": in_json(growths),
        }

    @presented
    def plot(self, path: str | os.PathLike[str] | None = None) -> Figure:
        """Draw the Allan deviations of all sensors over one another, one panel per axis."""
        raise NotImplementedError

    def _title(self) -> str:
        return f"{', '.join(self.labels)}; ratios to {self.labels[self.reference]}"

    def _tables(self) -> list[list[Column]]:
        heads = ("axis", "of", "sensor", "value", "ratio", "95 %", "p", "differs")
        cells = [cell for row in self.rows for cell in row.cells(self.sensors)]
        times = [f"after {duration(t)}" for t in HORIZONS]
        tables = [columns_from(heads, cells), columns_from(_GRADES, self.grades)]
        rows = [(g.name, self.labels[g.sensor], *g.cells()) for g in self.growths]
        return [*tables, columns_from(("error of", "sensor", *times), rows)] if rows else tables

    @property
    def grades(self) -> list[tuple[str, str, str, str]]:
        """Sensor, what it is called, and its grades by random walk and by least Allan deviation."""
        found = []
        for kind, k in itertools.product(SENSORS, range(len(self.sensors))):
            walk, least = (self._grade(kind, k, label) for label in (AngleRandomWalk.name(), LEAST))
            if walk or least:
                found.append((str(kind), self.labels[k], walk, least))
        return found

    def _grade(self, kind: Sensor, k: int, label: str) -> str:
        """Grade of a sensor by the largest of its axes, e.g. "tactical" or "navigation to tactical".

        It is the first whose limit is not exceeded, at both ends of the 95 % interval; "" without limits.
        """
        limits = grades()[0].get((kind, label))
        if limits is None:
            return ""
        rows = [row for row in self.rows if (row.sensor, row.label) == (kind, label)]
        known = [c for c in (row.estimates[k] for row in rows) if c and (c.detected or c.upper_limit)]
        if not known:
            return NOT_GIVEN if any(row.is_lacking(self.sensors[k]) for row in rows) else ""
        # An interval that is nan, as of a curve of unknown length, leaves the value.
        low = max(np.fmin(c.interval[0], c.value) if c.detected else 0.0 for c in known)
        high = max(np.fmax(c.interval[1], c.value) if c.detected else c.upper_limit or 0.0 for c in known)
        names = [next((name for name, limit in limits.items() if x <= limit), LAST) for x in (low, high)]
        return " to ".join(dict.fromkeys(names))

    def _notes(self) -> Iterator[str]:
        yield from (f"{one.label}: {one.source}" for one in self.sensors)
        yield (
            "min σ: the least Allan deviation at any cluster time. not given: by the data sheet or the terms "
            f"of the fit; ≥: at least, without what is not given. {_TOO_SHORT}: the time is more than three "
            "times its length"
        )
        yield f"grade: the best whose limits no axis exceeds, of drift by min σ; limits: {grades()[1]}"


def _between(ends: tuple[float, float]) -> str:
    """Interval of a ratio, or its limit."""
    low, high = ends
    if not low < high:
        return ""
    if math.isinf(high):
        return f"> {significant(low)}" if low > 0.0 else ""
    return f"< {significant(high)}" if low == 0.0 else format_range(low, high)


#: Units in which drift and errors are shown, by the beginning of their names, and their sizes in SI.
SHOWN = {
    "gyro": ("deg", math.pi / 180.0),
    "accel": ("m/s", 1.0),
    "heading": ("deg", math.pi / 180.0),
    "position": ("m", 1.0),
}


def compare(*data: Comparable, labels: Sequence[str] | None = None, reference: int | str = 0) -> Comparison:
    """Compare sensors of any grade: recordings, fits, data sheets, presets and published curves.

    Coefficients that each sensor has are compared with those of the reference, with intervals, ratios and a
    test that is corrected for the number of coefficients. The drift of each axis after 1 min, 10 min and 1 h
    is that of the integrated rate, √2·t·σ_A(t), if the bias is the mean over an equally long time before;
    heading and position errors are those of a navigator at rest with the Schuler loop, see `navigate`. They
    are given up to three times the length of a record. What a data sheet or the terms of a fit do not give is
    not zero: a drift without B and K is not given, and other errors are lower bounds.

    Args:
        data: the sensors: what `fit`, `critique`, `datasheet` or `read_curve` returned, a recording or what
            `fit` takes, a preset of `SENSORS`, or their names and files: "BMI088", "cimu", "imu.json",
            "imu.csv".
        labels: what to call them.
        reference: number or label of the sensor that the others are compared with.

    Raises:
        AllanjaxError: fewer than two sensors, labels that do not match, an unknown sensor or reference.
    """
    if len(data) < 2:
        raise AllanjaxError("give two or more sensors to compare, e.g. compare(fit, 'BMI088')")
    if labels is not None and len(labels) != len(data):
        raise AllanjaxError(f"{len(labels)} labels for {len(data)} sensors: give one for each")
    sensors = [compared(one) for one in data]
    called = labels or [""] * len(data)
    names = numbered([own or one.label or "sensor" for own, one in zip(called, sensors, strict=True)])
    sensors = [one._replace(label=name) for one, name in zip(sensors, names, strict=True)]
    if isinstance(reference, str):
        if reference not in names:
            raise AllanjaxError(f"no sensor {reference!r}; the sensors are {', '.join(names)}")
        reference = names.index(reference)
    elif not 0 <= reference < len(sensors):
        raise AllanjaxError(f"reference= is the number of a sensor, 0 to {len(sensors) - 1}, not {reference}")
    return Comparison(tuple(sensors), reference, _rows(sensors, reference))


def axes_of(sensors: Sequence[Compared]) -> list[Axis]:
    """Axes of all sensors, gyros first; a sensor of a data sheet is one only where no one else has axes."""
    every = dict.fromkeys(axis for one in sensors for axis in one.coefficients)
    axes = list[Axis]()
    for sensor in SENSORS:
        own = [name for name in every if name.startswith(sensor)]
        own = [name for name in own if "_" in name] or own
        axes += [Axis(name, sensor, SI[sensor]["rate"]) for name in own]
    return axes


def _rows(sensors: Sequence[Compared], reference: int) -> tuple[Row, ...]:
    """Amplitudes of the terms that any sensor has on an axis, with corrected p-values."""
    rows = []
    for axis in axes_of(sensors):
        every = [one.of(axis.name) for one in sensors]
        lacking = {symbol for one in sensors for symbol in one.lacking(axis.name)}
        found = [c for of in every for c in of.values() if c.is_amplitude or c.label == LEAST]
        held = [c.label for c in found if c.detected or c.held or c.label in _WANTED]
        held += [label for label, symbol in _WANTED.items() if symbol in lacking]
        # Terms that only one sensor has are its structure, except for the basic ones.
        names = dict.fromkeys(n for n in held if n in (*SYMBOLS, LEAST) or held.count(n) > 1)
        for label in sorted(names, key=lambda name: [*SYMBOLS, *names].index(name)):
            estimates = tuple(of.get(label) for of in every)
            base = estimates[reference]
            pairs = [difference(c, base) if c and base else None for c in estimates]
            pairs[reference] = None
            rows.append(Row(axis.name, axis.sensor, label, estimates, tuple(pairs)))
    corrected = iter(holm([d.p_value for row in rows for d in row.differences if d is not None]))
    for k, row in enumerate(rows):
        tested = [d and d._replace(corrected=next(corrected)) for d in row.differences]
        rows[k] = row._replace(differences=tuple(tested))
    return tuple(rows)


def drift(
    sensors: Sensors, noise: Any, t: Float[np.ndarray, " t"]
) -> tuple[Float[np.ndarray, " t"], Float[np.ndarray, " t"], Float[np.ndarray, " t"]]:
    """Error of the integrated rate of an axis after times t [s], √2·t·σ_A(t), and its 95 % interval."""

    def variance(model: Model) -> Float[np.ndarray, " t"]:
        return 2.0 * t**2 * np.asarray(model.sampled(sensors.rate).allan_variance(t))

    drawn = noise.drawn(variance)
    low, high = (np.sqrt(end) for end in sensors.ends(drawn))
    return np.sqrt(drawn.total), low, high


def _growths(k: int, one: Compared) -> Iterator[Growth]:
    """Errors of a sensor's axes, and of heading and position as far as its axes allow."""
    if one.noise is None:
        return
    # Of other noise the rate is known.
    rate = one.rate if isinstance(one.noise, dict) else None
    sensors, t = sensors_of(one.noise, rate, 0), np.array(HORIZONS)
    far = t > _BEYOND * sensors.record

    def growth(name: str, absent: str, is_bound: bool, *numbers: Float[np.ndarray, " t"]) -> Growth:
        reasons = tuple(_TOO_SHORT if beyond else absent for beyond in far)
        return Growth(k, name, is_bound, reasons, *np.where(np.array(reasons) == "", numbers, np.nan))

    for name, noise in sensors.axes.items():
        absent = "" if noise.drifts else NOT_GIVEN
        yield growth(name, absent, bool(noise.lacking), *drift(sensors, noise, t))
    try:
        grown = navigate(one.noise, HORIZONS, rate=rate, schuler=True)
    except AllanjaxError:
        # Its axes make no navigator.
        return
    shown = {"attitude": ("heading", "down"), "position": ("position", "north")}
    for own in grown.values():
        name, channel = shown.get(own.quantity, ("", ""))
        if channel in own.channels:
            at = own.channels.index(channel)
            yield growth(name, "", channel in own.bounds, own.error[at], own.lower[at], own.upper[at])

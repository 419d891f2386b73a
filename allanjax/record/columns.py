"""Columns, recognised by their labels as axes, time stamps or others; axes and dead axes of a recording."""

import difflib
import os
import re
import unicodedata
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar, Literal, Self, cast

import numpy as np
from jaxtyping import Bool, Float

from allanjax.base.earth import STANDARD_GRAVITY
from allanjax.base.errors import AllanjaxError, UnitError
from allanjax.base.late import presented
from allanjax.base.wording import harmless
from allanjax.record.units import (
    COUNT_SIZES,
    SAMPLE_UNITS,
    SENSORS,
    SI,
    Sensor,
    is_unit,
    parse_sample_unit,
    same_unit,
    unit_scale,
)
from allanjax.record.validation import Source

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Roles of columns, explained at `Column`.
Role = Literal["axis", "time", "counter", "cluster time", "auxiliary"]

# Patterns of the sensors' names, in several languages, and of the names of increments.
_ALIASES: dict[Sensor, str] = {
    "gyro": r"gyro(?:scopes?|meter)?|gyr|omega|ang(?:ular|l)?_?vel(?:ocity)?|ang(?:ular)?_?rate"
    r"|rotation_?rate|velocidad_?angular|vitesse_?angulaire|velocita_?angolare|winkelgeschwindigkeit|drehrate|角速度",
    "accel": r"accel(?:eration|erometer)?|acc|lin(?:ear)?_?acc(?:el(?:eration)?)?|specific_?force"
    r"|aceleracion|accelerazione|beschleunigung|加速度",
}
_INCREMENTS: dict[Sensor, str] = {
    "gyro": r"delta_?(?:angle|theta)|d_?theta|d_?ang(?:le)?",
    "accel": r"delta_?v(?:el(?:ocity)?)?|d_?v(?:el(?:ocity)?)?",
}
# A letter is a sensor only alone before the axis: `gx`, not `mag_x`; or with EuRoC's frames, `w_RS_S_x`; or
# after the name of a unit, `imu0_gx`. Arduino's examples write `GyX` and `AcX`.
_LETTERS: dict[Sensor, str] = {
    "gyro": r"(?:imu_?\d*_)?(?:gy?|w(?:_rs_s)?)",
    "accel": r"(?:imu_?\d*_)?(?:ac?(?:_rs_s)?|g_f)",
}
# Words for x, y and z in names of columns that are axes by their units.
_DIRECTIONS = (
    (r"[a-z]?x(?:_|$)", r"[a-z]?y(?:_|$)", r"[a-z]?z(?:_|$)"),
    ("roll", "pitch", "yaw"),
    ("lon", "lat", "vert"),
    (r"p(?:_|$)", r"q(?:_|$)", r"r(?:_|$)"),
)
# Words for quantities about a sensor that are not samples; and accuracies, such as `hAcc`.
_NOT_A_SAMPLE = re.compile(
    r"(?:^|_)(?:bias|offset|scale|sigma|std|var|variance|cov|covariance|noise|accuracy|range|temp|temperature"
    r"|time|timestamp|stamp|abs|absolute|magnitude|norm|status|flags?|valid|health|error|errors|count|counter|clipping|clip|dt|id)(?:_|$)"
)
_ACCURACY = re.compile(r"(?!imu|sensor|lin|[xyz]_)[a-z]+_acc")
# Words at the end of a name that describe the processing.
_PROCESSED = re.compile(r"_(?:cal|calibrated|uncal|uncalibrated|raw|comp|compensated)$")
# Element of an array: `gyro_rad[0]`, or counted from 1 as in MATLAB, `gyro(1)`.
_ELEMENTS = {"[0]": "_x", "[1]": "_y", "[2]": "_z", "(1)": "_x", "(2)": "_y", "(3)": "_z"}
_ELEMENT = re.compile(r"(?:\[[012]\]|\([123]\))$")

# Patterns of units within a name, as in `gyro_x_dps`, `gyro_rad_x`; PX4's gyro_rad is in rad/s.
_UNIT_SUFFIXES = {
    "deg/s": "dps|degs|deg_?(?:per_?|p)?s(?:ec)?",
    "rad/s": "rps|rads|rad_?(?:per_?|p)?s(?:ec)?|(?<=gyro_)rad",
    "m/s²": "m_s2|mps2|ms2",
    "mg": "mg",
    "g": "g",
}
# Units of rates at the end of any name; `roll_degs` is an angle.
_RATE_SUFFIX = re.compile(r".+_(?:(dps|deg_s|degps)|rad_s|radps)")
# Names of time stamps, alone, with a unit at the end, and of one part of a pair of seconds and parts of them.
_TIME = re.compile(
    r"(?:.*_)?(?:time|timestamp|time_stamp|stamp)(?:_(?:fine|unix|utc|gps|sample|gyro|gyr|accel|acc|imu))*"
    r"|t|ts|\w*timestamp"
)
_TIME_SUFFIX = re.compile(
    r"(.+?)_(s|sec|secs|seconds|ms|msec|us|usec|ns|nsec|nanoseconds|min|minutes|h|hours|days)"
)
_TIME_PART = re.compile(r"(.*?)_?((?:n|u|m|nano|micro|milli)?sec(?:ond)?s?)")
# Names that say that three columns are of no gyro or accelerometer; and units that do not say so.
_SOMETHING_ELSE = re.compile(
    r"(?:.*_)?(?:mag|compass|quat|euler|angles?(?:_|$)|att|ori|heading|tilt|incl|rot(?:ation)?_?vec|temp"
    r"|grav|user|lin(?:ear)?_|free_?acc|pos|vel|speed|gps|gnss|ecef|utm|lat|lon|volt|curr|press|baro|light"
    r"|prox|motor|servo|rc(?:_|$)|setpoint|pid|axis_?[pidfs](?:_|$)|debug|unused|reserved).*"
    r"|(?:roll|pitch|yaw)(?:_?(?:deg|rad|degs|rads|degrees))?|(?:imu_?\d*_)?[bhmpqv]_?[xyz\d]"
    r"|.*(?:磁|角度|姿态|四元数|温度).*"
)
_OF_COUNTS = re.compile(r"(?i)lsb|counts?|raw|adc|digits?|ticks|-|1|")
# What alone may differ between names of three axes.
_ENDS = (("x", "y", "z"), ("0", "1", "2"), ("roll", "pitch", "yaw"))
# Names of sample counters, which are times if the rate is known; and clocks of a known unit.
_COUNTER = re.compile(r"(?:.*_)?(?:packet|sample|frame|message|msg)_?(?:counter|count|number|num|index|nr)")
_CLOCKS = {"sample_time_fine": "0.1 ms", "millis": "ms", "micros": "us", "nanos": "ns"}
_CLOCKS |= {"ms": "ms", "us": "us", "ns": "ns"}
# Words of names that may be those of times, if the values increase.
_MAYBE_TIME = re.compile(
    r"(?:^|_)(?:t|time|stamp|clock|epoch|unix|tow|sow|sod|elapsed|uptime|ticks?|millis|micros|nanos|seconds"
    r"|ms|us|ns|uhrzeit|zeit|zeitstempel|zeitpunkt|datum|temps|heure|horodatage|tiempo|hora|fecha|tempo|ora)"
    r"(?:_|$)"
)
# Names of the cluster times of Allan curves, which are no recordings.
_CLUSTER_TIME = re.compile(r"taus?|(?:cluster|averaging|correlation)_time")

# Names of three columns that are a sensor's axes only together, and sensors that must be beside them.
_TOGETHER: tuple[tuple[Sensor, tuple[Sensor, ...], tuple[str, str, str]], ...] = (
    ("gyro", (), ("p", "q", "r")),
    ("gyro", (), ("roll_?rate", "pitch_?rate", "yaw_?rate")),
    ("gyro", (), ("d_?roll", "d_?pitch", "d_?yaw")),
    ("gyro", ("accel",), ("rate_?x", "rate_?y", "rate_?z")),
    ("accel", ("gyro",), ("f_?x", "f_?y", "f_?z")),
)

# Units in examples of a header.
_USUAL: dict[Sensor, str] = {"gyro": "deg/s", "accel": "m/s^2"}
# Units in which accelerometers may show gravity, and to what part.
_GRAVITY_IN = ("m/s²", "g", "mg", "cm/s²", "mm/s²", "ft/s²", *(f"g/{2**bits}" for bits in range(10, 20)))
_ABOUT_GRAVITY = 0.1


@dataclass(frozen=True)
class Column:
    """Column of a file: its role and, for an axis, sensor and unit.

    Attributes:
        label: label in the file.
        role: `axis` of a sensor, `time` stamps, `counter` of samples, `cluster time` of an Allan curve, or
            `auxiliary`.
        name: `gyro_x` ... `accel_z`, `gyro`, `gyro_1` for an axis, else the label without its unit.
        sensor: sensor of an axis, else None.
        unit: unit that the label states, if any.
        increment: whether the label says that the samples are increments (`delta_angle_x`).
        time_part: for stamps split over two columns, (common prefix, `s`, `ms`, `us` or `ns`).
        index: place in the file, from 0.
    """

    label: str
    role: Role
    name: str
    sensor: Sensor | None = None
    unit: str | None = None
    increment: bool = False
    time_part: tuple[str, str] | None = None
    index: int = 0


def recognise(label: str) -> Column:
    """Recognise a column by its label, e.g. `gyro_x [deg/s]`, `field.linear_acceleration.z`, `%time`."""
    label = harmless(label)
    stem, unit = split_unit(label)
    words = _PROCESSED.sub("", _words_of(stem))
    for suffix_unit, suffixes in _UNIT_SUFFIXES.items() if unit is None else ():
        match = re.fullmatch(rf"(.+)_(?:{suffixes})(_[xyz]|)", words)
        axis = match and _axis(label, match[1] + match[2], suffix_unit)
        if axis:
            return axis
    known = _axis(label, words, unit) or _time(label, stem, words, unit)
    if known is None and unit is None:
        match = _RATE_SUFFIX.fullmatch(words)
        unit = ("deg/s" if match[1] else "rad/s") if match else None
    return known or Column(label, "auxiliary", stem, unit=unit)


def by_unit(column: Column) -> Column:
    """Return the column as an axis if its unit is a rate of a sensor, under its own name; else unchanged."""
    if column.role != "auxiliary" or column.unit is None or _NOT_A_SAMPLE.search(_words(column.name)):
        return column
    for sensor in SENSORS:
        with suppress(UnitError):
            if parse_sample_unit(column.unit, sensor).quantity == "rate":
                return replace(column, role="axis", sensor=sensor)
    return column


def together(columns: Sequence[Column]) -> list[Column]:
    """Return columns, of which three are a sensor's axes if they are so together and it has no other ones."""
    found = list(columns)
    for sensor, others, words in _TOGETHER:
        axes = {column.name for column in found if column.role == "axis"}
        beside = {f"{other}_{axis}" for other in others for axis in "xyz"}
        if not beside <= axes or any(name.startswith(sensor) for name in axes):
            continue
        free = [column for column in found if column.role == "auxiliary"]
        three = [next((c for c in free if re.fullmatch(word, _words(c.name))), None) for word in words]
        for axis, column in zip("xyz", three if None not in three else (), strict=False):
            if column is not None:
                own = replace(column, role="axis", sensor=sensor, name=f"{sensor}_{axis}")
                found[found.index(column)] = own if column.unit is None else by_unit(column)
    return found


def in_directions(columns: Sequence[Column]) -> list[Column]:
    """Return columns of axes; three of a sensor are x, y and z if their own names tell which is which."""
    found = list(columns)
    for sensor in SENSORS:
        own = [column for column in columns if column.sensor == sensor]
        for words in _DIRECTIONS if len(own) == len("xyz") else ():
            axes = [_direction(column.name, words) for column in own]
            if sorted(axes) == [*"xyz"]:
                for column, axis in zip(own, axes, strict=True):
                    found[found.index(column)] = replace(column, name=f"{sensor}_{axis}")
                break
    return found


def triads(columns: Sequence[Column]) -> list[Sequence[Column]]:
    """Return each three neighbours whose names tell x, y and z in this order."""
    threes = [columns[k : k + 3] for k in range(len(columns) - 2)]
    told = [[[_direction(c.name, words) for c in three] for words in _DIRECTIONS] for three in threes]
    return [three for three, axes in zip(threes, told, strict=True) if [*"xyz"] in axes]


def unclaimed(columns: Sequence[Column], sensor: Sensor) -> Sequence[Column]:
    """Return auxiliary columns that may be axes of a sensor: those that its name begins, or else three.

    Names of three differ in the axis alone, and neither they nor units say that they are something else.
    """
    named = [column for column in columns if begins_with(column, sensor)]
    unknown = [column for column in columns if _may_be_axis(column)]
    words = [_words_of(column.name) for column in unknown]
    threes = [unknown[k : k + 3] for k in range(len(unknown)) if _are_axes(words[k : k + 4])]
    return named[: len("xyz")] or next(iter(threes), [])


def begins_with(column: Column, sensor: Sensor) -> bool:
    """Return whether an auxiliary column of samples has a name that begins with that of a gyro."""
    words = _words(column.name)
    is_named = sensor == "gyro" and re.match(_ALIASES[sensor], words) is not None
    return column.role == "auxiliary" and is_named and not _NOT_A_SAMPLE.search(words)


def _may_be_axis(column: Column) -> bool:
    """Whether neither the name nor the unit of a column says that it is no axis."""
    words = _words_of(column.name)
    says = _SOMETHING_ELSE.fullmatch(words) or _NOT_A_SAMPLE.search(words)
    return not says and _OF_COUNTS.fullmatch(column.unit or "") is not None


def _are_axes(names: Sequence[str]) -> bool:
    """Whether the first three of four names differ in the axis alone; four numbers are another array."""
    for ends in _ENDS:
        for place in re.finditer(ends[0], names[0]):
            before, after = names[0][: place.start()], names[0][place.end() :]
            if [*names[:3]] == [f"{before}{end}{after}" for end in ends]:
                return f"{before}3{after}" not in names
    return False


def _direction(name: str, words: Sequence[str]) -> str:
    """The axes, of x, y and z, that words in a name tell."""
    told = (re.search(rf"(?:^|_){word}", _words(name)) for word in words)
    return "".join(axis for axis, match in zip("xyz", told, strict=True) if match)


def may_be_time(column: Column) -> Column | None:
    """Return an auxiliary column as one of times if its name allows that, with the unit in its name."""
    words = _words(column.name)
    if column.role != "auxiliary" or not _MAYBE_TIME.search(words):
        return None
    unit = column.unit or _CLOCKS.get(words)
    # Beside whole seconds they are parts of these.
    part = ("", str(unit)) if words in ("ms", "us", "ns") and unit == words else None
    return replace(column, role="time", unit=unit, time_part=part)


def split_unit(label: str) -> tuple[str, str | None]:
    """Split `gyro_x [deg/s]` or `gyro_x (deg/s)` into (`gyro_x`, `deg/s`); without a unit, (label, None).

    `gyro_x in deg/s` and `gyro_x, deg/s` are split, too.
    """
    label = label.strip()
    match = re.fullmatch(r"(.+?)\s*(?:\[([^\[\]]*)\]|\((.*)\))", label)
    if match is None:
        plain = re.fullmatch(r"(.+?)(?:,| in) +(\S+)", label)
        return (plain[1], plain[2]) if plain and is_unit(plain[2]) else (label, None)
    unit = (match[2] or match[3] or "").strip()
    # `covariance[0]` is an element of an array.
    return (label, None) if not unit or unit.isdigit() else (match[1].strip(), unit)


def with_unit(name: str, unit: str | None) -> str:
    """Return `gyro_x [deg/s]`; the name alone if it has a unit, or there is none."""
    return f"{name} [{unit}]" if unit and split_unit(name)[1] is None else name


def elements_of(label: str, count: int) -> list[str]:
    """Return labels of the elements of an array: `gyro_x [deg/s]` … of three, else `gyro_0 [deg/s]` …."""
    stem, unit = split_unit(label)
    return [with_unit(f"{stem}_{end}", unit) for end in ("xyz" if count == 3 else range(count))]


def _words(stem: str) -> str:
    """Return a name as lower-case words joined by underscores, e.g. for `GyroX`, `gyro.x` or `gyro[0]`.

    They are without accents; Chinese characters stay.
    """
    stem = re.sub(r"(?<=[a-z])(?=[A-Z])", "_", stem)
    if not stem.isascii():
        stem = re.sub(r"(?<=[a-z])[\u0300-\u036f]", "", unicodedata.normalize("NFD", stem.lower()))
    return re.sub(r"[^a-z0-9\u4e00-\u9fff]+", "_", stem.lower()).strip("_")


def _words_of(stem: str) -> str:
    """Return the words of a name whose element of an array is an axis: `gyro[0]` is `gyro_x`."""
    return _words(_ELEMENT.sub(lambda end: _ELEMENTS[end[0]], stem))


def _axis(label: str, words: str, unit: str | None) -> Column | None:
    """Return the column of an axis, or None if the name is not that of an axis."""
    if _NOT_A_SAMPLE.search(words) or _ACCURACY.fullmatch(words):
        return None
    for sensor, alias in _ALIASES.items():
        for names, increment in ((alias, False), (_INCREMENTS[sensor], True)):
            match = (
                re.fullmatch(rf"(?:.*_)?(?:{names})_?([xyz\d])", words)
                or re.fullmatch(rf"(?:.*_)?(?:{names})(?:\d+|_\w+)_?([xyz])", words)
                or re.fullmatch(rf"(?:.*_)?([xyz])_?(?:{names})", words)
                or re.fullmatch(rf"(?:.*_)?(?:{names})()", words)
                or (None if increment else re.fullmatch(rf"{_LETTERS[sensor]}_?([xyz])", words))
            )
            if match is not None:
                name = f"{sensor}_{match[1]}" if match[1] else sensor
                # Of a magnetometer it is gauss.
                unit = "g" if unit == "G" and sensor == "accel" else unit
                return Column(label, "axis", name, sensor, unit, increment)
    return None


def _time(label: str, stem: str, words: str, unit: str | None) -> Column | None:
    """Return the column of time stamps, or None if the name is not that of one."""
    if _CLUSTER_TIME.fullmatch(words.removesuffix("_s")):
        return Column(label, "cluster time", stem, unit=unit)
    if _TIME.fullmatch(words):
        return Column(label, "time", stem, unit=unit or _CLOCKS.get(words))
    if _COUNTER.fullmatch(words):
        return Column(label, "counter", stem)
    suffix, part = _TIME_SUFFIX.fullmatch(words), _TIME_PART.fullmatch(words)
    time_part = None
    if part is not None:
        time_part = part[1], _unit_of_part(part[2])
    if suffix is not None and _TIME.fullmatch(suffix[1]):
        if suffix[2] in ("s", "ms", "us", "ns"):
            time_part = suffix[1], suffix[2]
        return Column(label, "time", stem, unit=unit or suffix[2], time_part=time_part)
    if time_part is not None:
        return Column(label, "time", stem, unit=unit or time_part[1], time_part=time_part)
    return None


def _unit_of_part(name: str) -> str:
    """Return the unit of times with a name such as `usec` or `microseconds`."""
    prefix = name.partition("sec")[0]
    return f"{'u' if prefix == 'micro' else prefix[:1]}s"


@dataclass(frozen=True)
class Axis:
    """Axis of a gyro or an accelerometer.

    Attributes:
        name: name of the axis, e.g. `gyro_x`.
        sensor: `gyro` or `accel`.
        unit: unit of the samples in the recording, for display.
    """

    name: str
    sensor: Sensor
    unit: str


@dataclass(frozen=True)
class DeadAxis:
    """Axis without noise, and thus without result, and the reason: constant, or without numbers."""

    axis: Axis
    reason: str

    @property
    def note(self) -> str:
        """A note that it was left out."""
        return f"{self.axis.name} left out: {self.reason}"

    @classmethod
    def of(cls, axis: Axis, value: float) -> "DeadAxis":
        """Return the dead axis with this constant value [its own unit]; nan if it has no numbers."""
        if np.isnan(value):
            return cls(axis, "without any number")
        return cls(axis, f"constant at {value:.6g} {axis.unit}")


def axes_of(
    columns: Sequence[Column],
    units: Mapping[Sensor, str | None],
    source: Source,
    samples: Callable[[], Sequence[np.ndarray]] = tuple,
) -> tuple[tuple[Axis, ...], tuple[str, ...]]:
    """Return axes from columns, in the unit given for the sensor or else that of the label; and notes.

    Samples of the columns serve to propose a unit where it is missing or wrong.
    """
    axes, increments = [], []
    stated: dict[str, list[str]] = {}
    named = distinct(columns, source)
    nameless: dict[Sensor, Column] = {}
    for column in named:
        if column.sensor is None:
            raise source.error(
                f"{column.label!r} is not an axis of a gyro or an accelerometer; use names such as gyro_x or "
                "accel_z, and pass other columns with auxiliary="
            )
        if column.unit is None and units[column.sensor] is None:
            nameless.setdefault(column.sensor, column)
    if nameless:
        options = [_unit_option(sensor, "", columns, samples()) for sensor in nameless]
        raise source.unit_error(_without_unit(nameless, options, source))
    for column in named:
        sensor = cast(Sensor, column.sensor)
        given = units[sensor]
        text = (column.unit or "") if given is None else given
        try:
            unit = parse_sample_unit(text, sensor)
        except UnitError as error:
            option = _unit_option(sensor, text, columns, samples())
            ours = f"column {column.label!r}: {error}; pass {option}"
            wrong = ours if given is None else f"{option}: {error}"
            raise source.unit_error(wrong) from error
        if column.increment and unit.quantity == "rate" and given is None:
            usual = SI[sensor]["increment"]
            raise source.unit_error(
                f"column {column.label!r} holds increments by its name, but {unit.name} is a unit of rates; "
                f"pass the unit that it has, such as {sensor}_unit='{usual}'"
            )
        axes.append(Axis(column.name, sensor, unit.name))
        labelled = recognise(column.label).unit
        if labelled and not same_unit(labelled, unit.name):
            how = f"read in {unit.name} as requested, although labelled {labelled}"
            stated.setdefault(how, []).append(column.name)
        if unit.quantity == "increment":
            increments.append(column.name)
    notes = [f"{', '.join(names)} {how}" for how, names in stated.items()]
    if increments:
        notes.append(f"increments multiplied by the rate: {', '.join(increments)}")
    return tuple(axes), tuple(notes)


def _without_unit(columns: Mapping[Sensor, Column], options: Sequence[str], source: Source) -> str:
    """Return that these columns have no unit, and the options that state it, in words."""
    labels = " and ".join(repr(column.label) for column in columns.values())
    sizes = " and ".join(source.sizes.get(sensor, COUNT_SIZES[sensor]) for sensor in columns)
    headers = " and ".join(f"`{c.name} [{_USUAL[sensor]}]`" for sensor, c in columns.items())
    what = f"column {labels} has" if len(columns) == 1 else f"columns {labels} have"
    return (
        f"{what} no unit; pass {' and '.join(options)}, for counts the size of one such as {sizes}, or write "
        f"it in the header: {headers}"
    )


def _unit_option(sensor: Sensor, text: str, columns: Sequence[Column], samples: Sequence[np.ndarray]) -> str:
    """The option that states the unit of a sensor, with the unit that samples or a misspelt one suggest."""
    near = difflib.get_close_matches(text, SAMPLE_UNITS[sensor]["rate"], 1)
    found, why = "".join(near), "if that is meant"
    own = [x for column, x in zip(columns, samples, strict=False) if column.sensor == sensor]
    if sensor == "accel" and len(own) == len("xyz") and all(x.dtype.kind in "fiu" for x in own):
        # Of a damaged file values may overflow.
        with np.errstate(over="ignore", invalid="ignore"):
            mean = float(np.linalg.norm([np.nanmean(x) for x in own]))
        off = {unit: abs(unit_scale(unit) * mean / STANDARD_GRAVITY - 1.0) for unit in _GRAVITY_IN}
        best = min(off, key=lambda unit: off[unit])
        if off[best] < _ABOUT_GRAVITY:
            found, why = best, f"in which they average gravity ({mean:.4g})"
    found = found.replace("²", "^2")
    return f"{sensor}_unit=" + (f"'{found}', {why}" if found else "")


class OfAxes:
    """Base of curves with one column per axis; they iterate over names, and are indexed by them.

    Attributes:
        axes: the recording's axes, or None for an array.
    """

    #: Fields with one column or entry per axis.
    PER_AXIS: ClassVar[tuple[str, ...]] = ()

    axes: tuple[Axis, ...] | None

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the axes; "0", "1", … for an array."""
        return names_of(self.axes, getattr(self, self.PER_AXIS[0]).shape[1])

    def __iter__(self) -> Iterator[str]:
        return iter(self.names)

    def __getitem__(self, axis: str) -> Self:
        """The curve of one axis, e.g. `curve["gyro_x"]`."""
        if axis not in self.names:
            raise AllanjaxError(f"there is no axis {axis!r}; axes are {', '.join(self.names)}")
        k = self.names.index(axis)
        own: dict[str, Any] = {"axes": None if self.axes is None else (self.axes[k],)}
        for name in self.PER_AXIS:
            value = getattr(self, name)
            own[name] = value[:, [k]] if isinstance(value, np.ndarray) else (value[k],)
        return replace(cast(Any, self), **own)

    @presented
    def plot(
        self,
        axes: Sequence[str] | str | None = None,
        path: str | os.PathLike[str] | None = None,
        *,
        ax: "Axes | None" = None,
    ) -> "Figure":
        """Draw the curves with their intervals, one panel per axis, gyros above accelerometers.

        `plot_allan` and `plot_psd` draw Allan deviations and spectra, optionally with the model of a fit.

        Args:
            axes: names of the axes to draw; by default all.
            path: file for the figure, with the suffix .png, .svg or .pdf.
            ax: matplotlib axes for a single axis, without title and key.

        Raises:
            AllanjaxError: there is no such axis, or `ax` is given for more than one axis.
        """
        raise NotImplementedError


def names_of(axes: Iterable[Axis] | None, count: int = 0) -> tuple[str, ...]:
    """Names of the axes; "0", "1", … for the `count` columns of an array without axes."""
    return tuple(map(str, range(count)) if axes is None else (axis.name for axis in axes))


def scales_of(axes: Sequence[Axis], rate: float) -> Float[np.ndarray, " axes"]:
    """Factor of each axis from its own unit to the SI rate, at a sample rate [Hz]."""
    units = [parse_sample_unit(axis.unit, axis.sensor) for axis in axes]
    return np.array([unit.scale * (rate if unit.quantity == "increment" else 1.0) for unit in units])


def axes_by_sensor(columns: Sequence[Column]) -> dict[Sensor | None, Bool[np.ndarray, " axes"]]:
    """Return which columns are of each sensor."""
    sensors = [column.sensor for column in columns]
    return {sensor: np.array([other == sensor for other in sensors]) for sensor in sensors}


#: Names of columns in a message that asks for them.
EXAMPLE = ("time", *(f"{sensor}_{axis}" for sensor in SENSORS for axis in "xyz"))


def default_names(
    count: int, units: Mapping[Sensor, str | None], source: Source, seen: str = ""
) -> tuple[str, ...]:
    """Return names of `count` columns without any, implied by the sensors whose units are given.

    A message quotes what was `seen`.

    Raises:
        RecordingError: they imply none.
    """
    sensors = [sensor for sensor, unit in units.items() if unit is not None]
    if len(sensors) == 1 and count == 1:
        return (sensors[0],)
    if sensors and count == 3 * len(sensors):
        return tuple(f"{sensor}_{axis}" for sensor in sensors for axis in "xyz")
    stated = " and ".join(f"{sensor}_unit=" for sensor in sensors) or "no unit"
    raise source.error(
        f"{count} columns without names and {stated} given: the columns cannot be identified{seen}; "
        "name them with columns= (--columns; names= of an array), one entry per column, - skips one, e.g. "
        f"{','.join(_examples(count))}"
    )


def _examples(count: int) -> tuple[str, ...]:
    """Return likely names of so many columns: times are the first, and sensors have three axes."""
    first = EXAMPLE[: min(count // 3 * 3, 6) + 1] if count % 3 == 1 or count > 6 else EXAMPLE[1:]
    return (first + ("-",) * count)[:count]


def distinct(columns: Sequence[Column], source: Source) -> tuple[Column, ...]:
    """Return the columns of axes; axes of several sensors of one kind keep the names in their labels."""
    if not columns:
        raise source.error("no gyro or accelerometer column; name the columns with columns=")
    count = Counter(column.name for column in columns)
    own = [replace(c, name=split_unit(c.label)[0]) if count[c.name] > 1 else c for c in columns]
    named: dict[str, Column] = {}
    for column in own:
        other = named.setdefault(column.name, column)
        if other is not column:
            both = f"columns {other.label!r} and {column.label!r} are both {column.name}"
            raise source.error(f"{both}; choose one with columns=")
    return tuple(own)

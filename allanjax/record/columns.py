"""Recognition of a column by its label: sensor, axis and unit, or time stamps."""

import re
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Literal

from allanjax.base.errors import UnitError
from allanjax.record.units import SENSORS, Sensor, parse_sample_unit

#: Roles of columns, explained at `Column`.
Role = Literal["axis", "time", "counter", "auxiliary"]

# Patterns of the sensors' names, and of the names of increments.
_ALIASES: dict[Sensor, str] = {
    "gyro": r"gyro(?:scopes?|meter)?|gyr|omega|ang(?:ular)?_?vel(?:ocity)?|ang(?:ular)?_?rate|rotation_?rate",
    "accel": r"accel(?:eration|erometer)?|acc|lin(?:ear)?_?acc(?:el(?:eration)?)?|specific_?force",
}
_INCREMENTS: dict[Sensor, str] = {
    "gyro": r"delta_?(?:angle|theta)|d_?theta|d_?ang(?:le)?",
    "accel": r"delta_?v(?:el(?:ocity)?)?|d_?v(?:el(?:ocity)?)?",
}
# One letter is a sensor only when it stands alone before the axis: `gx`, but not `mag_x`; or with the frames
# that EuRoC writes, `w_RS_S_x`.
_LETTERS: dict[Sensor, str] = {"gyro": "(?:g|w(?:_rs_s)?)", "accel": "a(?:_rs_s)?"}
# Words of what is about a sensor or its samples, but no sample; and accuracies, such as `hAcc`.
_NOT_A_SAMPLE = re.compile(
    r"(?:^|_)(?:bias|offset|scale|sigma|std|var|variance|cov|covariance|noise|accuracy|range|temp|temperature"
    r"|time|timestamp|stamp|status|flags?|valid|health|error|errors|count|counter|clipping|clip|dt|id)(?:_|$)"
)
_ACCURACY = re.compile(r"(?!imu|sensor|lin|[xyz]_)[a-z]+_acc")
# Words at the end of a name that say how it was processed.
_PROCESSED = re.compile(r"_(?:cal|calibrated|uncal|uncalibrated|raw|comp|compensated)$")
# Element of an array: `gyro_rad[0]`, or as MATLAB counts `gyro(1)`.
_ELEMENTS = {"[0]": "_x", "[1]": "_y", "[2]": "_z", "(1)": "_x", "(2)": "_y", "(3)": "_z"}

# Patterns of units within a name, as in `gyro_x_dps`, `gyro_rad_x`; PX4's gyro_rad is in rad/s.
_UNIT_SUFFIXES = {
    "deg/s": "dps|deg_s|degps",
    "rad/s": "rad_s|radps|(?<=gyro_)rad",
    "m/s²": "m_s2|mps2|ms2",
    "mg": "mg",
    "g": "g",
}
# Names of time stamps, alone, with a unit at the end, and of one part of a pair of seconds and nanoseconds.
_TIME = re.compile(
    r"(?:.*_)?(?:time|timestamp|time_stamp|stamp)(?:_(?:fine|unix|utc|gps|sample|gyro|gyr|accel|acc|imu))*"
    r"|t|\w*timestamp"
)
_TIME_SUFFIX = re.compile(
    r"(.+?)_(s|sec|secs|seconds|ms|msec|us|usec|ns|nsec|nanoseconds|min|minutes|h|hours|days)"
)
_TIME_PART = re.compile(r"(.*?)_?(secs?|seconds|nsecs?|nanosecs?|nanoseconds)")
# Names of counters of samples, which are a time where the rate is known; and clocks of a known unit.
_COUNTER = re.compile(r"(?:.*_)?(?:packet|sample|frame|message|msg)_?(?:counter|count|number|num|index|nr)")
_CLOCKS = {"sample_time_fine": "0.1 ms"}


@dataclass(frozen=True)
class Column:
    """Column of a file: its role and, for an axis, sensor and unit.

    Attributes:
        label: label in the file.
        role: `axis` of a sensor, `time` stamps, `counter` of samples, or `auxiliary`.
        name: `gyro_x` ... `accel_z`, `gyro`, `gyro_1` for an axis, else the label without its unit.
        sensor: sensor of an axis, else None.
        unit: unit that the label states, if any.
        increment: whether the label says that the samples are increments (`delta_angle_x`).
        time_part: for stamps split over two columns, (common prefix, `s` or `ns`).
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
    stem, unit = split_unit(label)
    element = next((end for end in _ELEMENTS if stem.endswith(end)), None)
    words = _words(stem if element is None else stem.removesuffix(element) + _ELEMENTS[element])
    words = _PROCESSED.sub("", words)
    axis = None
    for suffix_unit, suffixes in _UNIT_SUFFIXES.items() if unit is None else ():
        if match := re.fullmatch(rf"(.+)_(?:{suffixes})(_[xyz])?", words):
            axis = axis or _axis(label, match[1] + (match[2] or ""), suffix_unit)
    axis = axis or _axis(label, words, unit)
    return axis or _time(label, stem, words, unit) or Column(label, "auxiliary", stem, unit=unit)


def by_unit(column: Column) -> Column:
    """The column as an axis of the sensor whose rates its unit is of, under its own name; else as it is."""
    if column.role != "auxiliary" or column.unit is None or _NOT_A_SAMPLE.search(_words(column.name)):
        return column
    for sensor in SENSORS:
        with suppress(UnitError):
            if parse_sample_unit(column.unit, sensor).quantity == "rate":
                return replace(column, role="axis", sensor=sensor)
    return column


def split_unit(label: str) -> tuple[str, str | None]:
    """Split `gyro_x [deg/s]` or `gyro_x (deg/s)` into (`gyro_x`, `deg/s`); without a unit, (label, None)."""
    label = label.strip()
    match = re.fullmatch(r"(.+?)\s*(?:\[([^\[\]]*)\]|\((.*)\))", label)
    if match is None:
        return label, None
    unit = (match[2] or match[3] or "").strip()
    # `covariance[0]` is an element of an array.
    return (label, None) if not unit or unit.isdigit() else (match[1].strip(), unit)


def _words(stem: str) -> str:
    """Name as lower-case words joined by underscores, from e.g. `GyroX`, `gyro.x` or `gyro[0]`."""
    stem = re.sub(r"(?<=[a-z])(?=[A-Z])", "_", stem)
    return re.sub(r"[^a-z0-9]+", "_", stem.lower()).strip("_")


def _axis(label: str, words: str, unit: str | None) -> Column | None:
    """Column of an axis, or None if the name is not that of one."""
    if _NOT_A_SAMPLE.search(words) or _ACCURACY.fullmatch(words):
        return None
    for sensor, alias in _ALIASES.items():
        for names, increment in ((alias, False), (_INCREMENTS[sensor], True)):
            match = (
                re.fullmatch(rf"(?:.*_)?(?:{names})(?:_?([xyz])|_?(\d))?", words)
                or re.fullmatch(rf"(?:.*_)?(?:{names})(?:\d+|_\w+)_?([xyz])()", words)
                or re.fullmatch(rf"(?:.*_)?([xyz])_?(?:{names})()", words)
                or (None if increment else re.fullmatch(rf"{_LETTERS[sensor]}_?([xyz])()", words))
            )
            if match is not None:
                axis = match[1] or match[2]
                name = f"{sensor}_{axis}" if axis else sensor
                return Column(label, "axis", name, sensor, unit, increment)
    return None


def _time(label: str, stem: str, words: str, unit: str | None) -> Column | None:
    """Column of time stamps, or None if the name is not that of one."""
    if _TIME.fullmatch(words):
        return Column(label, "time", stem, unit=unit or _CLOCKS.get(words))
    if _COUNTER.fullmatch(words):
        return Column(label, "counter", stem)
    suffix, part = _TIME_SUFFIX.fullmatch(words), _TIME_PART.fullmatch(words)
    time_part = None if part is None else (part[1], "ns" if part[2].startswith("n") else "s")
    if suffix is not None and _TIME.fullmatch(suffix[1]):
        return Column(label, "time", stem, unit=unit or suffix[2], time_part=time_part)
    if time_part is not None:
        return Column(label, "time", stem, unit=unit or time_part[1], time_part=time_part)
    return None

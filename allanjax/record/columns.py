"""Recognition of a column by its label: sensor, axis and unit, or time stamps."""

import re
from dataclasses import dataclass
from typing import Literal

from allanjax.record.units import Sensor

#: Roles of columns, explained at `Column`.
Role = Literal["axis", "time", "auxiliary"]

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
# Statistics of a sensor's samples are no axes.
_NOT_A_SAMPLE = re.compile(r"(?:^|_)(?:bias|sigma|std|var|variance|cov|covariance)(?:_|$)")

# Patterns of units at the end of a name, as in `gyro_x_dps`.
_UNIT_SUFFIXES = {
    "deg/s": "dps|deg_s|degps",
    "rad/s": "rad_s|radps",
    "m/s²": "m_s2|mps2|ms2",
    "mg": "mg",
    "g": "g",
}
# Names of time stamps, alone, with a unit at the end, and of one part of a pair of seconds and nanoseconds.
_TIME = re.compile(r"(?:.*_)?(?:time|timestamp|time_stamp|stamp)|t|\w*timestamp")
_TIME_SUFFIX = re.compile(r"(.+?)_(s|sec|secs|seconds|ms|msec|us|usec|ns|nsec|nanoseconds)")
_TIME_PART = re.compile(r"(.*?)_?(secs?|seconds|nsecs?|nanosecs?|nanoseconds)")


@dataclass(frozen=True)
class Column:
    """Column of a file: its role and, for an axis, sensor and unit.

    Attributes:
        label: label in the file.
        role: `axis` of a sensor, `time` stamps, or `auxiliary`.
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
    words = _words(stem)
    axis = _axis(label, words, unit)
    if axis is None and unit is None:
        for suffix_unit, suffixes in _UNIT_SUFFIXES.items():
            if match := re.fullmatch(rf"(.+)_(?:{suffixes})", words):
                axis = axis or _axis(label, match[1], suffix_unit)
    return axis or _time(label, stem, words, unit) or Column(label, "auxiliary", stem, unit=unit)


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
    if _NOT_A_SAMPLE.search(words):
        return None
    for sensor, alias in _ALIASES.items():
        for names, increment in ((alias, False), (_INCREMENTS[sensor], True)):
            match = (
                re.fullmatch(rf"(?:.*_)?(?:{names})(?:_?([xyz])|_?(\d))?", words)
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
        return Column(label, "time", stem, unit=unit)
    suffix, part = _TIME_SUFFIX.fullmatch(words), _TIME_PART.fullmatch(words)
    time_part = None if part is None else (part[1], "ns" if part[2].startswith("n") else "s")
    if suffix is not None and _TIME.fullmatch(suffix[1]):
        return Column(label, "time", stem, unit=unit or suffix[2], time_part=time_part)
    if time_part is not None:
        return Column(label, "time", stem, unit=unit or time_part[1], time_part=time_part)
    return None

"""Axes of a recording: their columns and units, and those that are dead."""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self, cast

import numpy as np
from jaxtyping import Float

from allanjax.base.errors import AllanjaxError, UnitError
from allanjax.record.columns import Column, recognise, split_unit
from allanjax.record.units import COUNT_SIZES, SampleUnit, Sensor, parse_sample_unit, same_unit
from allanjax.record.validation import Source


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
    """Axis without noise, for which there is no result, and the reason: constant, or without a number."""

    axis: Axis
    reason: str

    @classmethod
    def of(cls, axis: Axis, value: float) -> "DeadAxis":
        """Dead axis with this value [its own unit] throughout; nan for no number."""
        if np.isnan(value):
            return cls(axis, "not a single number in it, as of a sensor that is not connected")
        held = f"constant, {value:.6g} {axis.unit} throughout"
        return cls(axis, f"{held}, as of a sensor that is stuck or not connected")


def axes_of(
    columns: Sequence[Column], units: Mapping[Sensor, str | None], source: Source
) -> tuple[tuple[Axis, ...], tuple[str, ...]]:
    """Axes from columns, in the unit that is given for the sensor, else in that of the label; notes on them.

    Raises:
        RecordingError: there are none, two have the same name, or one is no axis.
        UnitError: a unit is missing or unknown, or that of rates for a column of increments.
    """
    axes, increments = [], []
    stated: dict[str, list[str]] = {}
    for column in distinct(columns, source):
        if column.sensor is None:
            raise source.error(
                f"{column.label!r} is no axis of a gyro or an accelerometer; use names such as gyro_x, "
                "accel_z, and pass other columns as auxiliary="
            )
        unit = _unit_of(column, column.sensor, units[column.sensor], source)
        axes.append(Axis(column.name, column.sensor, unit.name))
        if (own := recognise(column.label).unit) and not same_unit(own, unit.name):
            stated.setdefault(f"in {unit.name} as stated, not in {own} as labelled", []).append(column.name)
        if unit.quantity == "increment":
            increments.append(column.name)
    notes = [f"{', '.join(names)} {how}" for how, names in stated.items()]
    if increments:
        notes.append(f"increments multiplied by the rate: {', '.join(increments)}")
    return tuple(axes), tuple(notes)


class OfAxes:
    """Base of curves with a column an axis: they iterate over names, by which they have the axes' curves.

    Attributes:
        axes: the recording's axes, or None for an array.
    """

    #: Fields that have a column or an entry an axis.
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
            raise AllanjaxError(f"there is no axis {axis!r}; there are {', '.join(self.names)}")
        k = self.names.index(axis)
        own: dict[str, Any] = {"axes": None if self.axes is None else (self.axes[k],)}
        for name in self.PER_AXIS:
            value = getattr(self, name)
            own[name] = value[:, [k]] if isinstance(value, np.ndarray) else (value[k],)
        return replace(cast(Any, self), **own)


def names_of(axes: Sequence[Axis] | None, count: int) -> tuple[str, ...]:
    """Names of the axes; "0", "1", … for the columns of an array without axes."""
    return tuple(map(str, range(count)) if axes is None else (axis.name for axis in axes))


def scales_of(axes: Sequence[Axis], rate: float) -> Float[np.ndarray, " axes"]:
    """Factor of each axis from its own unit to the SI rate, at a sample rate [Hz]."""
    units = [parse_sample_unit(axis.unit, axis.sensor) for axis in axes]
    return np.array([unit.scale * (rate if unit.quantity == "increment" else 1.0) for unit in units])


def default_names(
    count: int, units: Mapping[Sensor, str | None], remedy: str, source: Source
) -> tuple[str, ...]:
    """Default names of `count` columns, as implied by the sensors whose units are given.

    If they imply none, a RecordingError says to use `remedy`.
    """
    sensors = [sensor for sensor, unit in units.items() if unit is not None]
    if len(sensors) == 1 and count == 1:
        return (sensors[0],)
    if sensors and count == 3 * len(sensors):
        return tuple(f"{sensor}_{axis}" for sensor in sensors for axis in "xyz")
    stated = " and ".join(f"{sensor}_unit=" for sensor in sensors) or "no unit"
    raise source.error(
        f"{count} columns without names and {stated} given: what each column is can not be told. "
        f"Name them by {remedy}, e.g. gyro_x,gyro_y,gyro_z,accel_x,accel_y,accel_z"
    )


def distinct(columns: Sequence[Column], source: Source) -> tuple[Column, ...]:
    """Columns of axes; those of several sensors of a kind, which would be the same axis, by their own names.

    Raises:
        RecordingError: there are none, or two have the same name.
    """
    if not columns:
        raise source.error("no gyro or accelerometer column; name the columns by columns= (--columns)")
    count = Counter(column.name for column in columns)
    own = [replace(c, name=split_unit(c.label)[0]) if count[c.name] > 1 else c for c in columns]
    seen: dict[str, Column] = {}
    for column in own:
        other = seen.setdefault(column.name, column)
        if other is not column:
            raise source.error(
                f"columns {other.label!r} and {column.label!r} are both {column.name}; choose one by "
                "columns= (--columns)"
            )
    return tuple(own)


def _unit_of(column: Column, sensor: Sensor, given: str | None, source: Source) -> SampleUnit:
    """Unit of the column, from the argument or its label."""
    option = f"{sensor}_unit= (--{sensor}-unit)"
    text = column.unit if given is None else given
    if text is None:
        example = "deg/s" if sensor == "gyro" else "m/s^2"
        raise UnitError(
            f"{source.label}: column {column.label!r} has no unit; pass {option}, for counts the size of one "
            f"such as {COUNT_SIZES[sensor]}, or write it in the header as `{column.name} [{example}]`"
        )
    try:
        unit = parse_sample_unit(text, sensor)
    except UnitError as error:
        raise UnitError(f"{source.label}: column {column.label!r}: {error}; state it by {option}") from error
    if column.increment and unit.quantity == "rate" and given is None:
        raise UnitError(
            f"{source.label}: column {column.label!r} holds increments by its name, but {unit.name} is "
            f"a unit of rates; state which by {option}"
        )
    return unit

"""Axes of a recording: their columns and units, and those that are dead."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self, cast

import numpy as np
from jaxtyping import Float

from allanjax.base.errors import AllanjaxError, UnitError
from allanjax.record.columns import Column
from allanjax.record.units import SampleUnit, Sensor, parse_sample_unit
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
    """Axes from columns, given each sensor's unit where the labels have none, and notes on them.

    Raises:
        RecordingError: there are none, two columns are the same axis, or one is no axis.
        UnitError: a unit is missing, unknown, or given twice and differently.
    """
    check_axes(columns, source)
    axes, increments = [], []
    for column in columns:
        if column.sensor is None:
            raise source.error(
                f"{column.label!r} is no axis of a gyro or an accelerometer; use names such as gyro_x"
            )
        unit = _unit_of(column, column.sensor, units[column.sensor], source)
        axes.append(Axis(column.name, column.sensor, unit.name))
        if unit.quantity == "increment":
            increments.append(column.name)
    return tuple(axes), (f"increments multiplied by the rate: {', '.join(increments)}",) if increments else ()


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


def check_axes(columns: Sequence[Column], source: Source) -> None:
    """Raise `RecordingError` if there is no axis, or if two columns are the same one."""
    if not columns:
        raise source.error("no gyro or accelerometer column; name the columns by columns= (--columns)")
    seen: dict[str, Column] = {}
    for column in columns:
        other = seen.setdefault(column.name, column)
        if other is not column:
            raise source.error(
                f"columns {other.label!r} and {column.label!r} are both {column.name}; choose one by "
                "columns= (--columns)"
            )


def _unit_of(column: Column, sensor: Sensor, given: str | None, source: Source) -> SampleUnit:
    """Unit of the column, from its label or the argument."""
    option = f"{sensor}_unit= (--{sensor}-unit)"
    text = column.unit or given
    if text is None:
        example = "deg/s" if sensor == "gyro" else "m/s^2"
        raise UnitError(
            f"{source.label}: column {column.label!r} has no unit; pass {option}, "
            f"or write it in the header as `{column.name} [{example}]`"
        )
    try:
        unit = parse_sample_unit(text, sensor)
        argument = unit if given is None else parse_sample_unit(given, sensor)
    except UnitError as error:
        raise UnitError(f"{source.label}: column {column.label!r}: {error}") from error
    if (unit.scale, unit.quantity) != (argument.scale, argument.quantity):
        raise UnitError(
            f"{source.label}: column {column.label!r} is in {unit.name} by its header but {option} says "
            f"{argument.name}; leave out {option} or correct the header"
        )
    if column.increment and unit.quantity == "rate":
        raise UnitError(
            f"{source.label}: column {column.label!r} holds increments by its name, but {unit.name} is "
            f"a unit of rates; give the increments' unit in {option}, or rename the column by columns= "
            "(--columns)"
        )
    return unit

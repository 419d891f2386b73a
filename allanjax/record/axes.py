"""Axes of a recording: their columns and units, and those that are dead."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from allanjax.base.errors import UnitError
from allanjax.record.columns import Column
from allanjax.record.units import SENSORS, Sensor, parse_sample_unit
from allanjax.record.validation import Source, dead_reason


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
    """Axis without noise, for which there is no result: constant, or without a single number.

    Attributes:
        axis: the axis.
        reason: why it is dead, in words.
    """

    axis: Axis
    reason: str

    @classmethod
    def of(cls, axis: Axis, value: float) -> "DeadAxis":
        """Dead axis with this value [its own unit] throughout; nan for no number."""
        return cls(axis, dead_reason(value, axis.unit))


def axes_of(
    columns: Sequence[Column], gyro_unit: str | None, accel_unit: str | None, source: Source
) -> tuple[tuple[Axis, ...], tuple[str, ...]]:
    """Axes from columns, and notes on them.

    Raises:
        RecordingError: there are none, or two columns are the same axis.
        UnitError: a unit is missing, unknown, or given twice and differently.
    """
    check_axes(columns, source)
    units = [
        _unit_of(column, gyro_unit if column.sensor == "gyro" else accel_unit, source) for column in columns
    ]
    axes = tuple(
        Axis(column.name, column.sensor, unit)
        for column, unit in zip(columns, units, strict=True)
        if column.sensor is not None
    )
    increments = [
        axis.name for axis in axes if parse_sample_unit(axis.unit, axis.sensor).quantity == "increment"
    ]
    return axes, (f"increments multiplied by the rate: {', '.join(increments)}",) if increments else ()


def names_of(axes: Sequence[Axis] | None, count: int) -> tuple[str, ...]:
    """Names of the axes; "0", "1", … for the columns of an array without axes."""
    return tuple(map(str, range(count)) if axes is None else (axis.name for axis in axes))


def scales_of(axes: Sequence[Axis], rate: float) -> Float[np.ndarray, " axes"]:
    """Factor of each axis from its own unit to the SI rate, at a sample rate [Hz]."""
    return np.array([_scale(axis.unit, axis.sensor, rate) for axis in axes])


def default_names(
    count: int, gyro_unit: str | None, accel_unit: str | None, remedy: str, source: Source
) -> tuple[str, ...]:
    """Default names of `count` columns, as implied by the units that are given.

    Raises:
        RecordingError: the units do not imply names; the message says to use `remedy`.
    """
    given = (gyro_unit, accel_unit)
    sensors = [sensor for sensor, unit in zip(SENSORS, given, strict=True) if unit is not None]
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


def _unit_of(column: Column, given: str | None, source: Source) -> str:
    """Display label of the column's unit, from its label or the argument."""
    sensor = column.sensor or "gyro"
    option = f"{sensor}_unit= (--{sensor}-unit)"
    example = "deg/s" if sensor == "gyro" else "m/s^2"
    text = column.unit or given
    if text is None:
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
    return unit.name


def _scale(unit: str, sensor: Sensor, rate: float) -> float:
    """Factor from a unit of samples to the SI rate, at a sample rate [Hz]."""
    sample_unit = parse_sample_unit(unit, sensor)
    return sample_unit.scale * (rate if sample_unit.quantity == "increment" else 1.0)

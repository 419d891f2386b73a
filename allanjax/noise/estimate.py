"""Estimates: numbers with the unit that they are in, and the coefficients of a fit."""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar, Self

import numpy as np

from allanjax.base.equality import ByValue
from allanjax.base.plain import printable
from allanjax.base.wording import format_interval, format_with_error, plain, significant
from allanjax.noise.terms import Parameter
from allanjax.record.recording import Axis
from allanjax.record.units import Sensor, convert, default_coefficient_unit, si_unit


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class Estimate(ByValue):
    """A value with its error, in a unit.

    Attributes:
        axis: whose it is.
        value: the estimate.
        std: its standard deviation.
        interval: 95 % interval.
        interval_68: 68 % interval.
        unit: the unit that all these numbers are in; the SI one if none is given.
    """

    #: The fields that are in `unit`.
    NUMBERS: ClassVar[tuple[str, ...]] = ("value", "std", "interval", "interval_68")

    axis: Axis
    value: float
    std: float
    interval: tuple[float, float]
    interval_68: tuple[float, float]
    unit: str = ""

    def __post_init__(self) -> None:
        if not self.unit:
            object.__setattr__(self, "unit", self.si_unit)

    @property
    def title(self) -> str:
        """Name for people."""
        raise NotImplementedError

    @property
    def usual_unit(self) -> str:
        """The unit for people, e.g. "deg/√h"."""
        raise NotImplementedError

    @property
    def si_unit(self) -> str:
        """The SI unit of such numbers, e.g. "rad/√s"."""
        return si_unit(self.usual_unit)

    def in_unit(self, unit: str | None = None) -> Self:
        """A copy in this unit (by default `usual_unit`): its numbers and its `unit` agree.

        Raises:
            UnitError: for an unknown unit or one of another dimension.
        """
        unit = self.usual_unit if unit is None else unit
        factor = convert(1.0, self.unit, unit, self.axis.sensor)
        numbers: dict[str, Any] = {name: _times(getattr(self, name), factor) for name in self.NUMBERS}
        return dataclasses.replace(self, unit=unit, **numbers)

    def describe(self, unit: str | None = None) -> str:
        """The estimate in words, in the unit that it is in or the one asked for; see `in_unit`.

        E.g. "0.512 ± 0.007 deg/√h", or "not detectable, below 3.2 deg/h (95 %)".
        """
        shown = self if unit is None else self.in_unit(unit)
        return shown._sentence(shown._amount())

    def describe_interval(self) -> str:
        """The 95 % interval, with as many decimals as the value has, e.g. "0.498 … 0.526"."""
        return format_interval(*self.interval, self.value, self.std)

    def __str__(self) -> str:
        amount = self._amount()
        if self.unit != self.usual_unit:
            amount += f" = {self.in_unit()._amount()}"
        return printable(f"{self.axis.name} {self.title}: {self._sentence(amount)}")

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {self}>"

    def _amount(self) -> str:
        """The number that matters and the unit."""
        return self._with_unit(format_with_error(self.value, self.std))

    def _with_unit(self, number: str) -> str:
        return number if self.unit == "1" else f"{number} {self.unit}"

    def _sentence(self, amount: str) -> str:
        """What is said of this amount."""
        return amount


def _times(numbers: float | tuple[float, float] | None, factor: float) -> Any:
    if isinstance(numbers, tuple):
        return tuple(x * factor for x in numbers)
    return None if numbers is None else numbers * factor


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class Coefficient(Estimate):
    """One estimated parameter of the model of one axis.

    In a fit all numbers are in SI; `in_unit` gives them in a unit for people.

    Attributes:
        label: name in the model, e.g. "angle_random_walk" or "markov_correlation_time".
        term: name of its term.
        parameter: what it is.
        value: the estimate; zero for an amplitude that the data do not call for.
        interval: 95 % interval; its lower end is zero where zero is not excluded.
        upper_limit: one-sided 95 % limit, of an amplitude; or of another parameter that may be anywhere
            below, down to what a record of this length and rate shows nothing of: then `std` is nan.
        lower_limit: the same of a parameter that may be anywhere above.
        detected: whether zero is excluded.
        held: whether the value was given and not estimated.
        measured: whether it is a measurement of the sensor. Where the fitted curve is off by too much (see
            `AxisFit.misfit`) it is not: the value is that of the curve; standard deviation and intervals are
            nan, there is no limit, and nothing is detected.
        axis, std, interval_68, unit: see `Estimate`.
    """

    NUMBERS: ClassVar[tuple[str, ...]] = (*Estimate.NUMBERS, "upper_limit", "lower_limit")

    label: str
    term: str
    parameter: Parameter
    upper_limit: float | None
    detected: bool
    held: bool = False
    measured: bool = True
    lower_limit: float | None = None

    @property
    def title(self) -> str:
        """Name for people: of an accelerometer, the angle random walk is a velocity random walk."""
        return title_of(self.label, self.axis)

    @property
    def usual_unit(self) -> str:
        """The unit of such a coefficient for people, e.g. "deg/√h"."""
        return usual_unit(self.parameter, self.axis.sensor)

    def unmeasured(self) -> Coefficient:
        """The same as the parameter of a curve only; what was held stays as it was given."""
        if self.held:
            return self
        nowhere = (float("nan"), float("nan"))
        return dataclasses.replace(
            self,
            std=float("nan"),
            interval=nowhere,
            interval_68=nowhere,
            upper_limit=None,
            lower_limit=None,
            detected=False,
            measured=False,
        )

    def _amount(self) -> str:
        if self.held:
            return self._with_unit(plain(self.value))
        if not self.measured:
            return self._with_unit(significant(self.value)) if self.value > 0.0 else "none"
        if not self.detected:
            return "" if self.upper_limit is None else self._with_unit(significant(self.upper_limit))
        if self._limit is not None:
            return self._with_unit(significant(self._limit))
        return super()._amount()

    @property
    def _limit(self) -> float | None:
        """That of a detected term's shape."""
        if self.parameter.kind == "amplitude":
            return None
        return self.upper_limit if self.lower_limit is None else self.lower_limit

    def _sentence(self, amount: str) -> str:
        if self.held:
            return f"{amount} (held)"
        if not self.measured:
            return f"not a measurement of this sensor (fitted: {amount})"
        if self.detected and self._limit is not None:
            return f"{'below' if self.lower_limit is None else 'above'} {amount} (95 %)"
        if self.detected and self.parameter.kind != "amplitude" and np.isnan(self.std):
            return "not determined by these data"
        if self.detected:
            return amount
        if self.upper_limit is None:
            return "not determined: its term is not detectable"
        return f"not detectable, below {amount} (95 %)"


def usual_unit(parameter: Parameter, sensor: Sensor) -> str:
    """The usual unit of a parameter of this sensor's noise, e.g. "deg/√h"."""
    if parameter.kind == "amplitude":
        return default_coefficient_unit(sensor, parameter.time_exponent)
    return {"time": "s", "frequency": "Hz", "line": "Hz"}.get(parameter.kind, "1")


def title_of(label: str, axis: Axis) -> str:
    """A term's or a coefficient's name for people, e.g. "velocity random walk" on an accelerometer."""
    words = label.replace("_", " ")
    return words.replace("angle random walk", "velocity random walk") if axis.sensor == "accel" else words

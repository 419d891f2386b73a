"""What is common to all estimates: numbers, and the unit that they are in."""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar, Self

from allanjax.equality import ByValue
from allanjax.plain import printable
from allanjax.recording import Axis
from allanjax.units import convert, si_unit
from allanjax.wording import format_interval, format_with_error


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

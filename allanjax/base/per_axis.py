"""Results of several axes: one container, whatever the result is of."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar, Protocol, TypeVar

from allanjax.base.errors import AllanjaxError
from allanjax.base.tables import Tabled

if TYPE_CHECKING:
    import pandas as pd


class AxisResult(Protocol):
    """Result of one axis, as `PerAxis` holds it."""

    @property
    def axis(self) -> Any:
        """The axis, whose `name` is the key."""

    def to_dataframe(self) -> pd.DataFrame:
        """Rows of this axis in the table of all axes."""


_T = TypeVar("_T", bound=AxisResult)


class PerAxis(Tabled, Mapping[str, _T]):
    """A mapping from the names of axes to their results, in the recording's order.

    `for name in fit`, `fit["gyro_x"]`, `fit.values()` and `fit.items()` are those of a dictionary. A subclass
    is a dataclass with the field `results`, and says what its table shows.

    Attributes:
        results: one an axis.
    """

    #: What messages call such a result, with its article.
    CALLED: ClassVar[str] = "the result"
    #: What is raised for an axis that there is not.
    ERROR: ClassVar[type[AllanjaxError]] = AllanjaxError

    results: tuple[_T, ...]

    @property
    def axes(self) -> tuple[str, ...]:
        """Names of the axes."""
        return tuple(result.axis.name for result in self.results)

    def __iter__(self) -> Iterator[str]:
        return iter(self.axes)

    def __len__(self) -> int:
        return len(self.results)

    def __contains__(self, axis: object) -> bool:
        return axis in self.axes

    def __getitem__(self, axis: str) -> _T:
        """The result of one axis, e.g. `fit["gyro_x"]`."""
        if axis not in self.axes:
            called = getattr(self, "name", "") or self.CALLED
            raise self.ERROR(f"{called} has no axis {axis!r}; it has {', '.join(self.axes)}")
        return self.results[self.axes.index(axis)]

    def get(self, axis: str, default: Any = None) -> Any:
        """The result of one axis, or the default if there is no such axis."""
        # Not `Mapping.get`, which waits for a KeyError.
        return self[axis] if axis in self else default  # noqa: SIM401

    def to_dataframe(self) -> pd.DataFrame:
        """Table of all axes, one below the other."""
        import pandas as pd

        return pd.concat([result.to_dataframe() for result in self.results], ignore_index=True)


def by_sensor(results: Sequence[Any], units: Callable[[Any], Sequence[str]]) -> list[tuple[str, ...]]:
    """Rows of a table of axes: for each sensor the units of its columns, then the rows of its axes.

    `units` are the units of all columns but the first; a column without values has no unit.
    """
    cells: list[tuple[str, ...]] = []
    for sensor in dict.fromkeys(r.axis.sensor for r in results):
        rows = [row for r in results if r.axis.sensor == sensor for row in r.rows()]
        filled = (any(column) for column in zip(*rows, strict=True))
        shown = zip(filled, ("", *units(sensor)), strict=True)
        cells += [tuple(unit if has else "" for has, unit in shown), *rows]
    return cells

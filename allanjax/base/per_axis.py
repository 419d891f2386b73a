"""Results of several axes: one container, whatever the result is of."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar

from allanjax.base.errors import AllanjaxError
from allanjax.base.tables import Cell, Column, Tabled, columns_from

if TYPE_CHECKING:
    import pandas as pd


_T = TypeVar("_T", bound=Any)


class PerAxis(Tabled, Mapping[str, _T]):
    """A mapping from the names of axes to their results, in the recording's order.

    `for name in fit`, `fit["gyro_x"]`, `fit.values()` and `fit.items()` are those of a dictionary. A subclass
    is a dataclass with the field `results`, and says what its table shows.

    Attributes:
        results: one an axis.
    """

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
            called = getattr(self, "name", "") or type(self).__name__
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

    def _tables(self) -> Sequence[Sequence[Column]]:
        of_sensor: dict[Any, list[Sequence[Cell]]] = {}
        for result in self.results:
            of_sensor.setdefault(result.axis.sensor, []).extend(result.rows())
        return [columns_from(self._heads(sensor), rows) for sensor, rows in of_sensor.items()]

    def _heads(self, sensor: Any) -> Sequence[str]:
        """Heads of the printed table of a sensor's axes, whose `rows()` have these columns."""
        raise NotImplementedError

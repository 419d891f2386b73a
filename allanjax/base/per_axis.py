"""Results of several axes: one container, whatever the result is of."""

from __future__ import annotations

import html
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar, Protocol, TypeVar

from allanjax.base.errors import AllanjaxError
from allanjax.base.tables import WIDTH, html_table, printable, text_table

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


class PerAxis(Mapping[str, _T]):
    """A mapping from the names of axes to their results, in the recording's order.

    `for name in fit`, `fit["gyro_x"]`, `fit.values()` and `fit.items()` are those of a dictionary. A subclass
    is a dataclass with the field `results`, and says what its table shows.

    Attributes:
        results: one an axis.
    """

    #: What messages call such a result, with its article.
    CALLED: ClassVar[str] = "the result"
    #: Headings of the printed table, and those of its columns that end at the right.
    HEADINGS: ClassVar[tuple[str, ...]] = ()
    RIGHT: ClassVar[tuple[str, ...]] = ()
    #: What is raised for an axis that there is not.
    ERROR: ClassVar[type[AllanjaxError]] = AllanjaxError

    results: tuple[_T, ...]

    @property
    def warnings(self) -> tuple[str, ...]:
        """What a user should know before reading the numbers, in words."""
        return ()

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

    def _title(self) -> str:
        """Title of the printed table."""
        raise NotImplementedError

    def _cells(self) -> Sequence[Sequence[str]]:
        """The rows of the printed table."""
        raise NotImplementedError

    def __str__(self) -> str:
        # Broken here, for they stand outside of the table.
        told = [textwrap.fill(f"warning: {w}", WIDTH, subsequent_indent="  ") for w in self.warnings]
        table = text_table(self._title(), self.HEADINGS, self._cells(), right=self.RIGHT)
        return "\n".join([*map(printable, told), table])

    def __repr__(self) -> str:
        return str(self)

    def _repr_html_(self) -> str:
        told = "".join(f"<p><b>warning: {html.escape(w)}</b></p>" for w in self.warnings)
        return told + html_table(self._title(), self.HEADINGS, self._cells())

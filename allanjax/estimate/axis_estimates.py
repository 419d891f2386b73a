"""The estimates of one axis, of a fit or of its posterior: by name, as a table, and in two lines."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, ClassVar

from allanjax.base.errors import AllanjaxError
from allanjax.base.late import TextProperty
from allanjax.noise.estimate import Estimate, called
from allanjax.record.columns import Axis

if TYPE_CHECKING:
    import pandas as pd

_COLUMNS: dict[str, Callable[[Estimate], Any]] = {
    "axis": lambda c: c.axis.name,
    "coefficient": lambda c: c.label,
    "value": lambda c: c.value,
    "median": lambda c: c.value,
    "std": lambda c: c.std,
    "lower_68": lambda c: c.interval_68[0],
    "upper_68": lambda c: c.interval_68[1],
    "lower_95": lambda c: c.interval[0],
    "upper_95": lambda c: c.interval[1],
    "unit": lambda c: c.unit,
    "detected": lambda c: c.detected,
    "upper_limit_95": lambda c: c.upper_limit,
    "measured": lambda c: c.measured,
}


class AxisEstimates:
    """Base of the fit and of the posterior of one axis: estimates by name, as a table, and in two lines.

    Attributes:
        axis: whose the estimates are.
        coefficients: each by its label, detected or not.
    """

    #: Columns of the table, each in the usual unit.
    COLUMNS: ClassVar[tuple[str, ...]] = ()
    #: What is raised for a coefficient that there is not.
    ERROR: ClassVar[type[AllanjaxError]] = AllanjaxError

    axis: Axis

    if TYPE_CHECKING:  # A property here would be taken for the default of a dataclass's field.

        @property
        def coefficients(self) -> Mapping[str, Estimate]: ...

    @TextProperty
    def verdict(self) -> str:
        """One line on how far the estimates can be trusted."""
        raise NotImplementedError

    def __getitem__(self, name: str) -> Estimate:
        """A coefficient by its label, its symbol or another usual name, e.g. "N" or "ARW" (`called`)."""
        label = called(name, self.coefficients)
        if label is None:
            raise self.ERROR(
                f"{self.axis.name} has no coefficient {name!r}; it has {', '.join(self.coefficients)}"
            )
        return self.coefficients[label]

    def to_dataframe(self) -> pd.DataFrame:
        """One row a coefficient, in its usual unit."""
        import pandas as pd

        shown = [c.in_unit() for c in self.coefficients.values()]
        rows = [{name: _COLUMNS[name](c) for name in self.COLUMNS} for c in shown]
        return pd.DataFrame(rows, columns=list(self.COLUMNS)).astype({"upper_limit_95": float})

    def __repr__(self) -> str:
        names: dict[bool, list[str]] = {True: [], False: []}
        for c in self.coefficients.values():
            names[c.detected].append(f"{c.title} {c.in_unit().describe()}" if c.detected else c.title)
        absent = f"; not detectable: {', '.join(names[False])}" if names[False] else ""
        found = ", ".join(names[True]) or "nothing found"
        return f"<{type(self).__name__} {self.axis.name}: {found}{absent};\n {self.verdict}>"

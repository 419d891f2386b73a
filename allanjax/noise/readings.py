"""Numbers read off a curve, beside a fit: one estimate a quantity, or why there is none."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING, ClassVar

from allanjax.base.equality import ByValue
from allanjax.base.per_axis import PerAxis
from allanjax.noise.estimate import Estimate, title_of
from allanjax.record.recording import Axis

if TYPE_CHECKING:
    import pandas as pd


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class AxisReadings(ByValue):
    """What is read off the curve of one axis.

    Attributes:
        axis: whose it is.
        estimates: by label; None where the curve does not show the quantity.
        reasons: by label, why there is none.
    """

    axis: Axis
    estimates: Mapping[str, Estimate | None]
    reasons: Mapping[str, str] = dataclasses.field(default_factory=lambda: MappingProxyType({}))

    def __getitem__(self, label: str) -> Estimate | None:
        """The estimate of this label, None where there is none."""
        return self.estimates[label]

    def rows(self) -> list[tuple[str, str, str, str]]:
        """Rows of the printed table."""
        found = []
        for label, estimate in self.estimates.items():
            title = title_of(label, self.axis.sensor)
            if estimate is None:
                found.append((self.axis.name, title, "", f"none: {self.reasons.get(label, '')}"))
                continue
            shown = estimate.in_unit()
            band = "" if shown.band is None else f", {shown.band[0]:.3g} to {shown.band[1]:.3g} Hz"
            interval = f"{shown.describe_interval()} (95 %){band}"
            found.append((self.axis.name, title, shown.describe().split(" (95 %")[0], interval))
        return found

    def to_dataframe(self) -> pd.DataFrame:
        """Table with one row a quantity, in usual units; numbers are missing where there is none."""
        import pandas as pd

        rows = []
        for label, estimate in self.estimates.items():
            row: dict[str, object] = {"axis": self.axis.name, "coefficient": label}
            if estimate is not None:
                shown = estimate.in_unit()
                lower, upper = shown.interval
                row |= {"value": shown.value, "std": shown.std, "lower_95": lower, "upper_95": upper}
                row |= {"unit": shown.unit}
            rows.append(row | {"reason": self.reasons.get(label, "")})
        columns = ["axis", "coefficient", "value", "std", "lower_95", "upper_95", "unit", "reason"]
        return pd.DataFrame(rows, columns=columns)

    def __repr__(self) -> str:
        told = [f"{label} {e.in_unit().describe()}" for label, e in self.estimates.items() if e is not None]
        return f"<AxisReadings {self.axis.name}: {', '.join(told) or 'none'}>"


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Readings(ByValue, PerAxis[AxisReadings]):
    """What is read off the curves of several axes.

    Attributes:
        title: what is read off what, and by which rule.
        results: one an axis.
    """

    CALLED: ClassVar[str] = "the reading"
    HEADINGS: ClassVar[tuple[str, ...]] = ("axis", "quantity", "read ± 1σ", "interval, or why there is none")

    title: str
    results: tuple[AxisReadings, ...]

    def _title(self) -> str:
        return self.title

    def _cells(self) -> list[tuple[str, str, str, str]]:
        return [row for result in self.results for row in result.rows()]

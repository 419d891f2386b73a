"""Result of a joint fit: what recordings of one unit, or of units of one type, have in common."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from allanjax.base.equality import ByValue
from allanjax.base.errors import AllanjaxError, FitError
from allanjax.base.late import presented
from allanjax.base.tables import Column, Number, PerAxis, column
from allanjax.base.wording import plain, significant
from allanjax.comparison.random_effects import RandomEffects
from allanjax.estimate.as_json import in_json
from allanjax.estimate.selection import AxisSelection
from allanjax.noise.estimate import Estimate, called
from allanjax.record.recording import Axis

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

SCHEMA_VERSION = 1


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class JointCoefficient(ByValue):
    """One coefficient of one axis in several recordings.

    Attributes:
        common: its common value, with the Bayes factor of its term if only all recordings together show it.
        records: its value in each recording, with the recording's own interval.
        scatter: standard deviation between recordings beyond what the intervals explain, in its own unit.
        effects: the statistics behind these, of what `scale` names.
        scale: "logarithm", or "square" of an amplitude that some recording does not determine to 10 %. The
            common value is the median of a log-normal scatter.
    """

    common: Estimate
    records: Mapping[str, Estimate]
    scatter: Estimate
    effects: RandomEffects
    scale: str

    @property
    def relative_scatter(self) -> float:
        """Scatter relative to the common value, or its upper limit if no scatter is detected."""
        size = self.scatter.value if self.scatter.detected else self.scatter.upper_limit
        return float("nan") if size is None or not self.common.value else size / self.common.value

    @property
    def sample_std(self) -> float:
        """Standard deviation of the recordings' values [SI], as in the thesis's tables 5.1 and 5.3."""
        return float(np.std([c.value for c in self.records.values()], ddof=1))

    def column(self) -> Column:
        """Column of the printed table: the recordings, and the statistics below them."""
        unit, e = self.common.usual_unit, self.effects
        factor = self.common.in_unit().value / self.common.value if self.common.value else 1.0
        limit = "" if self.scatter.detected else "< "
        relative = self.relative_scatter
        return column(
            f"{self.common.symbol or self.common.title}",
            unit,
            [
                *(c.in_unit().number for c in self.records.values()),
                self.common.in_unit().number,
                *(Number(end * factor) for end in self.common.interval),
                self.scatter.in_unit().number,
                f"{limit}{significant(100.0 * relative, 2)} %" if np.isfinite(relative) else "",
                Number(self.sample_std * factor),
                f"p = {plain(e.p_value, 2)}",
                f"{e.odd_one}, p = {plain(e.odd_p_value, 2)}" if e.odd_one else "",
            ],
        )

    def to_dict(self) -> dict[str, Any]:
        """The numbers in types of JSON."""
        return {
            "common": in_json(self.common),
            "bayes_factor": self.common.bayes_factor,
            "recordings": {name: in_json(c) for name, c in self.records.items()},
            "scatter": in_json(self.scatter),
            "relative_scatter": in_json(self.relative_scatter),
            "sample_std_si": self.sample_std,
            "scale": self.scale,
            "statistics": self.effects.to_dict(),
        }


_SUMMARY = ("common", "95 % from", "to", "scatter", "relative", "STD", "all alike", "odd one out")


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class AxisJoint(ByValue):
    """One axis of several recordings: the terms that they have in common, and their coefficients.

    Attributes:
        axis: the axis.
        names: names of the recordings that are compared.
        coefficients: coefficients by label.
        selection: ranking of the sets of terms by the product of the recordings' evidences; None for a model
            that was given.
        found_jointly: terms that no single recording detects, with ln of their Bayes factor [nats].
    """

    axis: Axis
    names: tuple[str, ...]
    coefficients: Mapping[str, JointCoefficient]
    selection: AxisSelection | None
    found_jointly: Mapping[str, float]

    def __getitem__(self, name: str) -> JointCoefficient:
        """A coefficient by its label, its symbol or another usual name, e.g. "N" or "ARW"."""
        label = called(name, {label: c.common for label, c in self.coefficients.items()})
        if label is None:
            raise FitError(
                f"{self.axis.name} has no coefficient {name!r}; it has {', '.join(self.coefficients)}"
            )
        return self.coefficients[label]

    def table(self) -> list[Column]:
        """Columns of the printed table: one per coefficient, with a row for each recording."""
        return [
            Column(self.axis.name, [*self.names, *_SUMMARY]),
            *(c.column() for c in self.coefficients.values()),
        ]

    def to_dataframe(self) -> pd.DataFrame:
        """One row per coefficient and recording, and one of what they have in common, in the usual unit."""
        import pandas as pd

        rows = []
        for c in self.coefficients.values():
            rows += [{"recording": name, **of.row()} for name, of in c.records.items()]
            scatter = c.scatter.row()
            statistics = {f"scatter_{key}": scatter[key] for key in ("value", "lower_95", "upper_95")}
            statistics |= {"relative_scatter": c.relative_scatter, "p_value": c.effects.p_value}
            statistics |= {"odd_one": c.effects.odd_one, "odd_p_value": c.effects.odd_p_value}
            rows.append({"recording": "common", **c.common.row(), **statistics})
        return pd.DataFrame(rows)

    def to_dict(self) -> dict[str, Any]:
        """The axis in types of JSON."""
        ranking = () if self.selection is None else self.selection.ranking
        return {
            **in_json(self.axis),
            "selection": [in_json(s) for s in ranking],
            "found_jointly": {term: {"log_bayes_factor": x} for term, x in self.found_jointly.items()},
            "coefficients": {label: c.to_dict() for label, c in self.coefficients.items()},
        }


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class JointFit(ByValue, PerAxis[AxisJoint]):
    """Joint fit of recordings of one unit, or of units of one type; see `joint_fit`.

    Attributes:
        names: names of the recordings.
        results: one per axis that all of them have.
        notes: what was left out, and why.
    """

    ERROR: ClassVar[type[AllanjaxError]] = FitError

    names: tuple[str, ...]
    results: tuple[AxisJoint, ...]
    notes: tuple[str, ...] = ()

    @presented
    def plot(self, axes: Any = None, path: str | os.PathLike[str] | None = None) -> Figure:
        """Draw each coefficient of every recording, the common value and the scatter; see `plot_joint`."""
        raise NotImplementedError

    def to_dict(self) -> dict[str, Any]:
        """The result in types of JSON; numbers that do not exist are None."""
        axes = [axis.to_dict() for axis in self.results]
        more = {"names": list(self.names), "axes": axes, "notes": list(self.notes)}
        return {"schema_version": SCHEMA_VERSION, **more}

    def _title(self) -> str:
        return f"joint fit of {len(self.names)} recordings"

    def _tables(self) -> list[list[Column]]:
        return [axis.table() for axis in self.results]

    def _notes(self) -> list[str]:
        found = [
            f"{axis.axis.name} {term.replace('_', ' ')}: only all recordings together show it, Bayes factor "
            f"{significant(float(np.exp(min(x, 700.0))), 2)}"
            for axis in self.results
            for term, x in axis.found_jointly.items()
        ]
        legend = "scatter: between recordings beyond what their intervals explain; all alike: p-value of none"
        return [*found, *(f"note: {note}" for note in self.notes), legend]

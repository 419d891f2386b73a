"""Result of a joint fit: what recordings of one unit, or of units of one type, have in common."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from allanjax.base.equality import ByValue
from allanjax.base.errors import AllanjaxError, FitError
from allanjax.base.late import presented
from allanjax.base.tables import Column, Number, PerAxis, column
from allanjax.base.wording import format_p_value, significant
from allanjax.comparison.random_effects import RandomEffects
from allanjax.estimate.as_json import in_json
from allanjax.estimate.selection import AxisSelection
from allanjax.noise.estimate import Estimate, called, title_of
from allanjax.record.recording import Axis
from allanjax.record.units import convert

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

SCHEMA_VERSION = 1
# ln of the largest Bayes factor that is printed as a number.
_PLENTY = 13.8
# Rows of the printed table below the recordings.
_SUMMARY = ("common", "95 % from", "to", "scatter", "relative", "STD", "all alike")


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class JointCoefficient(ByValue):
    """One coefficient of one axis in several recordings.

    Attributes:
        common: its common value, the median of log-normal scatter; with a Bayes factor if only all recordings
            together show its term.
        records: its value in each recording, with the recording's own interval.
        scatter: standard deviation between recordings beyond what the intervals explain, in its own unit.
        effects: the statistics of `scale`: its logarithm, or its square if a recording does not determine the
            amplitude to 10 %, as only squares are unbiased and may be averaged where a term hardly shows.
    """

    common: Estimate
    records: Mapping[str, Estimate]
    scatter: Estimate
    effects: RandomEffects
    scale: str

    @property
    def relative_scatter(self) -> float:
        """Scatter over the common value, or the scatter's upper limit if it is not detected."""
        size = self.scatter.value if self.scatter.detected else self.scatter.upper_limit
        return size / self.common.value if size and self.common.value else float("nan")

    @property
    def sample_std(self) -> float:
        """Standard deviation of the values [SI], as in Hou (2004), table 5.1; NaN unless all are detected."""
        values = [c.value if c.detected else np.nan for c in self.records.values()]
        return float(np.std(values, ddof=1))

    @property
    def difference(self) -> tuple[float, float, float]:
        """Of two recordings, the second value less the first [SI], and its 95 % interval from their own.

        See Zou & Donner (2008, Stat. Med. 27:1693). NaN for more recordings, or without an interval.
        """
        if len(self.records) != 2:
            return (float("nan"),) * 3
        known = self.records.values()
        ends = [(c.interval[0], c.interval[1] if c.detected else c.upper_limit) for c in known]
        (low, high), (low_2, high_2) = np.nan_to_num(np.array(ends, float))
        first, second = (c.value for c in known)
        size = second - first
        below, above = np.hypot(second - low_2, high - first), np.hypot(high_2 - second, first - low)
        return size, float(size - below), float(size + above)

    def _last(self) -> str:
        """Last cell of the printed table: the difference of two recordings, or the odd one of more."""
        e, c = self.effects, self.common
        if len(self.records) == 2:
            size, *ends = (significant(convert(x, c.unit, c.usual_unit), 2) for x in self.difference)
            return f"{size} ({' … '.join(ends)})"
        return f"{e.odd_one}, {format_p_value(e.odd_p_value)}" if e.odd_one else "none"

    def column(self, names: Sequence[str]) -> Column:
        """Column of the printed table: the recordings of these names, and the statistics below them."""
        common, scatter = self.common.in_unit(), self.scatter.in_unit()
        spread = f"{significant(100.0 * self.relative_scatter, 2)} %"
        ends = (significant(100.0 * x / common.value, 2) for x in scatter.interval if scatter.detected)
        spread = f"{spread} ({' … '.join(ends)})" if scatter.detected else f"< {spread}"
        cells = [
            *(self.records[name].in_unit().number if name in self.records else None for name in names),
            common.number,
            *map(Number, common.interval),
            Number(scatter.value) if scatter.detected else scatter.number,
            spread if np.isfinite(self.relative_scatter) else "",
            Number(convert(self.sample_std, self.common.unit, common.unit)),
            format_p_value(self.effects.p_value),
            self._last(),
        ]
        return column(common.symbol or common.title, common.unit, cells)

    def rows(self) -> Iterator[dict[str, Any]]:
        """Rows of the data frame: one per recording, and one of what they have in common."""
        yield from ({"recording": name, **c.row()} for name, c in self.records.items())
        scatter, e = self.scatter.row(), self.effects
        yield {
            "recording": "common",
            **self.common.row(),
            "relative_scatter": self.relative_scatter,
            **{f"scatter_{key}": scatter[key] for key in ("value", "lower_95", "upper_95", "upper_limit_95")},
            "p_value": e.p_value,
            "odd_one": e.odd_one,
            "odd_p_value": e.odd_p_value,
        }


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class AxisJoint(ByValue):
    """One axis of several recordings: the terms that they have in common, and their coefficients.

    Attributes:
        axis: the axis.
        names: names of the recordings.
        coefficients: coefficients by label.
        selection: ranking of the sets of terms by the product of the recordings' evidences; None for a model
            that was given.
        found_jointly: terms that no single recording detects, with ln of their Bayes factor [nats].
        rivals: terms from which the recordings together cannot distinguish one of these (Bayes factor < 20).
    """

    axis: Axis
    names: tuple[str, ...]
    coefficients: Mapping[str, JointCoefficient]
    selection: AxisSelection | None
    found_jointly: Mapping[str, float]
    rivals: Mapping[str, tuple[str, ...]]

    def __getitem__(self, name: str) -> JointCoefficient:
        """A coefficient by its label, its symbol or another usual name, e.g. "N" or "ARW"."""
        label = called(name, {label: c.common for label, c in self.coefficients.items()})
        if label is None:
            has = ", ".join(self.coefficients)
            raise FitError(f"{self.axis.name} has no common coefficient {name!r}; it has {has}")
        return self.coefficients[label]

    def to_dataframe(self) -> pd.DataFrame:
        """One row per coefficient and recording, and one of what they have in common, in the usual unit."""
        import pandas as pd

        return pd.DataFrame([row for c in self.coefficients.values() for row in c.rows()])

    def to_dict(self) -> dict[str, Any]:
        """The axis in types of JSON, as `JointFit.to_dict`."""
        coefficients = {}
        for label, c in self.coefficients.items():
            own = {"sample_std_si": c.sample_std, "difference_si": c.difference, "effects": vars(c.effects)}
            coefficients[label] = {**vars(c), **own}
        more = {
            "log_bayes_factors": self.found_jointly,
            "rivals": self.rivals,
            "selection": () if self.selection is None else self.selection.ranking,
            "coefficients": coefficients,
        }
        return {**in_json(self.axis), **in_json(more)}


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class JointFit(ByValue, PerAxis[AxisJoint]):
    """Joint fit of recordings of one unit, or of units of one type; see `joint_fit`.

    Attributes:
        names: names of the recordings.
        results: one per axis that at least two of them have.
        notes: what was left out, and why.
    """

    ERROR: ClassVar[type[AllanjaxError]] = FitError

    names: tuple[str, ...]
    results: tuple[AxisJoint, ...]
    notes: tuple[str, ...] = ()

    @presented
    def plot(
        self, axes: Sequence[str] | str | None = None, path: str | os.PathLike[str] | None = None
    ) -> Figure:
        """Draw each coefficient of every recording, the common value and the scatter; see `plot_joint`."""
        raise NotImplementedError

    def to_dict(self) -> dict[str, Any]:
        """The result in types of JSON; numbers that do not exist are None."""
        return {
            "schema_version": SCHEMA_VERSION,
            "names": list(self.names),
            "axes": [axis.to_dict() for axis in self.results],
            "notes": list(self.notes),
        }

    def _title(self) -> str:
        return f"joint fit of {len(self.names)} recordings"

    def _tables(self) -> list[list[Column]]:
        tables = []
        for a in self.results:
            rows = [*a.names, *_SUMMARY, "odd one" if len(a.names) > 2 else "difference"]
            columns = [c.column(a.names) for c in a.coefficients.values()]
            tables.append([Column(a.axis.name, rows), *columns])
        return tables

    def _notes(self) -> Iterator[str]:
        for axis in self.results:
            for term, gain in axis.found_jointly.items():
                factor = significant(float(np.exp(gain)), 2) if gain < _PLENTY else "above 10⁶"
                text = f"all recordings together show it, none of them alone (Bayes factor {factor})"
                yield f"{axis.axis.name} {title_of(term, axis.axis.sensor)}: {text}"
            for term, rivals in axis.rivals.items():
                name, *others = (title_of(t, axis.axis.sensor) for t in (term, *rivals))
                yield f"{axis.axis.name} {name}: it may be {' or '.join(others)} as well"
        yield from (f"note: {note}" for note in self.notes)
        yield (
            "scatter: standard deviation between recordings, beyond what their intervals explain; all alike: "
            "probability of such differences between recordings that do not scatter"
        )

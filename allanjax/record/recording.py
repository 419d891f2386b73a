"""Static recordings of gyros and accelerometers."""

import functools
import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from allanjax.base.equality import ByValue
from allanjax.base.errors import RecordingError
from allanjax.base.tables import as_html, columns_from, printable
from allanjax.base.wording import duration
from allanjax.record.columns import Axis, DeadAxis, scales_of, with_unit
from allanjax.record.completion import (
    Gap,
    bridged,
    completed,
    gaps_of,
    gaps_within,
    notes_on,
    rows_between,
)
from allanjax.record.io.kinds import of_one_sensor
from allanjax.record.io.layout import Layout
from allanjax.record.io.memory import columns_of, real_numbers, table_of_array, table_of_frame
from allanjax.record.io.options import GapChoice, ReadOptions
from allanjax.record.io.record import Record, notes_on_part
from allanjax.record.io.table import Table
from allanjax.record.units import SI, Sensor
from allanjax.record.validation import (
    MIN_SAMPLES,
    Source,
    check_values,
)

if TYPE_CHECKING:
    import pandas as pd

# A mapping that stays empty.
_NONE = functools.partial(MappingProxyType, {})


@dataclass(frozen=True, eq=False)
class Recording(ByValue):
    """Recording of a sensor at rest: samples of one or more axes at one rate.

    Attributes:
        values: rates in SI, rad/s and m/s²; increments have been multiplied by the rate.
        rate: sample rate in Hz.
        axes: axes, one per column of `values`.
        auxiliary: other columns by name, in the units of the file.
        name: name for display, e.g. that of the file without its suffix.
        notes: assumptions and findings of the reader that users should know.
        dead: axes that were left out because they have no noise, and why.
        jitter: rms jitter of the time stamps [s]; None without time stamps.
        missing: samples that were missing and have been filled in given the others, see `completion`; None
            if there are none.
        others: other segments of the same record, separated by missing samples (`gaps="segments"`), in SI:
            Allan deviations and noise coefficients use all segments, everything else uses `values`.
        gaps: where samples of the record are missing, either filled in or between segments; None if that is
            unknown without time stamps.
        begun: UNIX time of the first sample [s]; None if the time stamps do not tell it.
        given: sensors whose unit was given, and the factor from their labels' unit to it; 1 without labels.
        places: number of the first sample of each of `others`, counted from that of `values`; empty if
            unknown.
        auxiliary_units: units of the `auxiliary` columns by name, where the file states them.
    """

    values: Float[np.ndarray, "samples axes"]
    rate: float
    axes: tuple[Axis, ...]
    auxiliary: Mapping[str, Float[np.ndarray, " samples"]] = field(default_factory=_NONE)
    name: str = ""
    notes: tuple[str, ...] = ()
    dead: tuple[DeadAxis, ...] = ()
    jitter: float | None = None
    missing: Bool[np.ndarray, "samples axes"] | None = None
    others: tuple[Float[np.ndarray, "_ axes"], ...] = ()
    gaps: tuple[Gap, ...] | None = None
    begun: float | None = None
    given: Mapping[Sensor, float] = field(default_factory=_NONE)
    places: tuple[int, ...] = ()
    auxiliary_units: Mapping[str, str] = field(default_factory=_NONE)

    @classmethod
    def from_array(
        cls,
        values: Float[np.ndarray, "samples axes"] | Float[np.ndarray, " samples"],
        rate: float,
        *,
        gyro_unit: str | None = None,
        accel_unit: str | None = None,
        names: Sequence[str] | None = None,
        auxiliary: Mapping[str, Float[np.ndarray, " samples"]] | None = None,
        name: str = "",
        gaps: GapChoice = "error",
    ) -> "Recording":
        """Make a recording from an array, one column per axis.

        A column that is constant or has no finite number is left out: see `dead`.

        Args:
            values: samples, in `gyro_unit` and `accel_unit`.
            rate: sample rate in Hz.
            gyro_unit: unit of the gyros' samples, e.g. `deg/s`, or `rad` for increments.
            accel_unit: unit of the accelerometers' samples, e.g. `m/s²`, `g`, or `m/s` for increments.
            names: the columns' names, e.g. `["gyro_z", "accel_x"]`. Without them 3 columns with one unit
                are taken as x, y, z; 6 with both units as gyro x, y, z, accel x, y, z; 1 with one unit as
                that sensor; `notes` say so.
            auxiliary: other columns of the same length, e.g. a temperature.
            name: name for display.
            gaps: what to do about samples that are nan, as in `read`.

        Raises:
            RecordingError: wrong shape, names or rate, fewer than 16 samples, values that are not
                finite, or no column that is not constant.
            UnitError: a unit is missing or unknown.
        """
        options = ReadOptions(rate, gyro_unit, accel_unit, gaps=gaps)
        source = Source(name or "array")
        table = table_of_array(real_numbers(values, source), names, options, source, auxiliary)
        return recording_of(table, name, options)

    @property
    def n(self) -> int:
        """Number of samples."""
        return self.values.shape[0]

    @property
    def duration(self) -> float:
        """Length in s: the number of samples divided by the rate."""
        return self.n / self.rate

    @property
    def time(self) -> Float[np.ndarray, " samples"]:
        """Time of each sample in s from the first."""
        return np.arange(self.n) / self.rate

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the axes."""
        return tuple(axis.name for axis in self.axes)

    @property
    def recorded(self) -> tuple[Float[np.ndarray, " recorded"], ...]:
        """Samples of each axis without those that were missing and have been filled in."""
        missing = np.zeros_like(self.values, bool) if self.missing is None else self.missing
        return tuple(x[~lost] for x, lost in zip(self.values.T, missing.T, strict=True))

    @property
    def own_scales(self) -> Float[np.ndarray, " axes"]:
        """Factor of each axis from its own unit to the SI rate."""
        return scales_of(self.axes, self.rate)

    @property
    def own_values(self) -> Float[np.ndarray, "samples axes"]:
        """Samples, each axis in its own unit."""
        return self.values / self.own_scales

    @property
    def columns(self) -> dict[str, Float[np.ndarray, " samples"]]:
        """Times, samples in each axis's own unit, and auxiliary channels, by labels that state the units."""
        return self._columns(self.own_values, [axis.unit for axis in self.axes])

    def _columns(
        self, samples: Float[np.ndarray, "samples axes"], units: Sequence[str]
    ) -> dict[str, Float[np.ndarray, " samples"]]:
        labels = map(with_unit, self.names, units)
        columns = {"time [s]": self.time, **dict(zip(labels, samples.T, strict=True))}
        for name, column in self.auxiliary.items():
            columns[with_unit(name, self.auxiliary_units.get(name))] = column
        return columns

    def to_dataframe(self, si: bool = False) -> "pd.DataFrame":
        """Return a table with one row per sample and the `columns`, as input for `from_dataframe` or `fit`.

        Labels state the units; samples that were missing are nan.

        Args:
            si: whether samples are in rad/s and m/s² instead of the axes' own units.
        """
        import pandas as pd

        samples = self.values if si else self.own_values
        units = [SI[axis.sensor]["rate"] if si else axis.unit for axis in self.axes]
        if self.missing is not None:
            samples = np.where(self.missing, np.nan, samples)
        return pd.DataFrame(self._columns(samples, units))

    @classmethod
    def from_dataframe(
        cls,
        frame: "pd.DataFrame | Mapping[str, np.ndarray]",
        rate: float | None = None,
        *,
        gyro_unit: str | None = None,
        accel_unit: str | None = None,
        names: Sequence[str] | None = None,
        gaps: GapChoice | None = None,
    ) -> "Recording":
        """Make a recording from a data frame, whose columns are recognised by their names as in a file.

        Args:
            frame: columns such as `time [s]`, `gyro_x [deg/s]`, `temperature`; times may be the index. Or a
                mapping of columns by name.
            rate: sample rate [Hz], if there are no times.
            gyro_unit, accel_unit: units of the sensors, if labels have none.
            names: labels of the columns to use.
            gaps: what to do about missing samples, as in `read`.

        Raises:
            RecordingError, UnitError: as for `read`.
        """
        columns = columns_of(frame)
        if columns is None:
            raise RecordingError(f"a {type(frame).__name__} is no data frame; give columns by name")
        options = ReadOptions(rate, gyro_unit, accel_unit, names, gaps=gaps)
        return recording_of(table_of_frame(columns), "", options)

    def select(self, *keys: str) -> "Recording":
        """Recording of the named axes, in this order; `gyro` or `accel` is all axes of that sensor.

        Raises:
            RecordingError: there is no such axis, or it is dead.
        """
        chosen: list[int] = []
        source = Source(self.name or "recording")
        for key in keys:
            for dead in self.dead:
                if key == dead.axis.name:
                    raise source.error(f"{key} was left out: {dead.reason}")
            found = [i for i, axis in enumerate(self.axes) if axis.name == key]
            found = found or [i for i, axis in enumerate(self.axes) if axis.sensor == key]
            if not found:
                raise source.error(f"no axis {key!r}; axes are {', '.join(self.names)}")
            chosen += [i for i in found if i not in chosen]
        if not chosen:
            raise RecordingError(f"select at least one of {', '.join(self.names)}")
        return replace(
            self,
            values=self.values[:, chosen],
            missing=None if self.missing is None else self.missing[:, chosen],
            others=tuple(other[:, chosen] for other in self.others),
            axes=tuple(self.axes[i] for i in chosen),
            dead=tuple(dead for dead in self.dead if dead.axis.sensor in keys),
        )

    def __getitem__(self, key: str | Sequence[str]) -> "Recording":
        return self.select(key) if isinstance(key, str) else self.select(*key)

    def between(self, start: float | None = None, stop: float | None = None) -> "Recording":
        """Return the recording from `start` up to but not including `stop`, in s from the first sample.

        Other segments are cut in the same way.

        Raises:
            RecordingError: fewer than 16 samples are left, or every axis is constant there.
        """
        source = Source(self.name or "recording")
        rows = rows_between(self.n, self.rate, start, stop)
        notes = [*notes_on_part(rows, self.n, self.duration, source)]
        values = self.values[rows]
        living = _Living.of(values, self.axes, self.own_scales, self.names, source)
        kept, dead = living.kept, living.dead
        missing = None if self.missing is None else self.missing[rows, kept]
        others, places = [], []
        for place, segment in zip(self.places, self.others, strict=False):
            ends = (None if time is None else time - place / self.rate for time in (start, stop))
            own = rows_between(len(segment), self.rate, *ends)
            if own.stop - own.start >= MIN_SAMPLES:
                others.append(segment[own][:, kept])
                places.append(place + own.start - rows.start)
        first = min((0, *places))
        sizes = map(len, (values, *others))
        last = max(place + size for place, size in zip((0, *places), sizes, strict=True))
        if len(others) < len(self.others):
            notes.append(f"{len(self.others) - len(others)} of {len(self.others)} other segments left out")
        return replace(
            self,
            values=values[:, kept],
            axes=living.axes,
            missing=missing if missing is not None and missing.any() else None,
            others=tuple(others),
            places=tuple(places),
            gaps=gaps_within(self.gaps, rows.start + first, rows.start + last, rows.start),
            begun=None if self.begun is None else self.begun + rows.start / self.rate,
            auxiliary=MappingProxyType({key: column[rows] for key, column in self.auxiliary.items()}),
            notes=(*self.notes, *notes, *(axis.note for axis in dead)),
            dead=(*self.dead, *dead),
        )

    @property
    def _size(self) -> str:
        return f"{self.n} samples at {self.rate:g} Hz, {duration(self.duration)}"

    def __repr__(self) -> str:
        axes = ", ".join(f"{axis.name} [{axis.unit}]" for axis in self.axes)
        title = f" {self.name!r}" if self.name else ""
        dead = f"; without {', '.join(dead.axis.name for dead in self.dead)}" if self.dead else ""
        return printable(f"<Recording{title}: {axes}; {self._size}{dead}>")

    def _repr_html_(self) -> str:
        own = self.own_values
        every = zip(self.axes, own.mean(axis=0), own.std(axis=0), strict=True)
        rows = [(axis.name, axis.sensor, axis.unit, f"{mean:.6g}", f"{std:.6g}") for axis, mean, std in every]
        table = columns_from(("axis", "sensor", "unit", "mean", "std"), rows)
        return as_html(f"{self.name or 'Recording'}: {self._size}", [table], self.notes)


def recording_of(table: Table, name: str, options: ReadOptions) -> Recording:
    """Make a recording from a table, with the errors of `read`."""
    table, columns = of_one_sensor(table, table.columns(), options)
    layout = Layout.of(table, columns, options)
    record = Record.of(table, layout, columns, options)
    return _recording(table, layout, record, name)


def _recording(table: Table, layout: Layout, record: Record, name: str) -> Recording:
    """Make a recording of the axes that are not dead, with lost samples filled in given the others."""
    values, lost = record.rows.values, record.lost
    gaps = record.gaps
    if lost.any():
        values = np.array([bridged(*column) for column in zip(values.T, lost.T, strict=True)]).T
    labels = [column.label for column in layout.columns]
    living = _Living.of(values, layout.axes, np.ones(len(labels)), labels, record.rows.source)
    axes, kept = living.axes, living.kept
    values, lost = values[:, kept], lost[:, kept]
    scales = scales_of(axes, record.rate)
    notes = (*table.notes, *layout.notes, *record.notes)
    if lost.any():
        values = completed(values, lost)
        notes += notes_on(lost, record.rate, [axis.name for axis in axes])
        gaps = gaps_of(lost)
    others, places = [], []
    for place, other in zip(record.places, record.others, strict=True):
        samples = other.values[:, kept]
        if (np.ptp(samples, axis=0) > 0.0).all():
            others.append(samples * scales)
            places.append(place)
    return Recording(
        values=values * scales,
        rate=record.rate,
        axes=axes,
        auxiliary=MappingProxyType(dict(record.rows.auxiliary)),
        auxiliary_units=MappingProxyType({c.name: c.unit for c in layout.auxiliary if c.unit}),
        name=name,
        notes=(*notes, *(axis.note for axis in living.dead)),
        dead=living.dead,
        jitter=record.jitter,
        missing=lost if lost.any() else None,
        others=tuple(others),
        places=tuple(places),
        gaps=gaps,
        begun=record.begun,
        given=MappingProxyType(dict(layout.given)),
    )


class _Living(NamedTuple):
    """Axes that are alive, where they are among all (a slice if all are), and the dead ones."""

    axes: tuple[Axis, ...]
    kept: slice | Bool[np.ndarray, " axes"]
    dead: tuple[DeadAxis, ...]

    @classmethod
    def of(
        cls,
        values: Float[np.ndarray, "samples axes"],
        axes: Sequence[Axis],
        scales: Float[np.ndarray, " axes"],
        labels: Sequence[str],
        source: Source,
    ) -> "_Living":
        """Return which axes are alive; `scales` are the factors from the axes' own units to the samples'."""
        living = check_values(values, labels, source)
        every = zip(axes, values[0] / scales, living, strict=True)
        dead = tuple(DeadAxis.of(axis, float(value)) for axis, value, lives in every if not lives)
        return cls(tuple(itertools.compress(axes, living)), living if dead else slice(None), dead)

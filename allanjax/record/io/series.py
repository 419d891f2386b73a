"""Series of samples of a log's messages, and the joining of separate gyros and accelerometers."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float, Int

from allanjax.record.io.grid import regular_intervals
from allanjax.record.io.table import Table
from allanjax.record.io.times import MAX_RATE_DIFFERENCE
from allanjax.record.shapes import Places
from allanjax.record.units import Sensor
from allanjax.record.validation import Source

#: Units of the samples in all logs.
UNITS: dict[Sensor, str] = {"gyro": "rad/s", "accel": "m/s²"}
# Smallest share of samples with a partner in the other series.
_MATCHED = 0.9


@dataclass(frozen=True)
class Series:
    """Samples of one message or topic.

    Attributes:
        name: name of the message or topic.
        times: stamps in ns.
        gyro: angular rates in rad/s, or None if it has none.
        accel: accelerations in m/s², or None if it has none.
        auxiliary: other columns by label.
    """

    name: str
    times: Places
    gyro: Float[np.ndarray, "samples 3"] | None = None
    accel: Float[np.ndarray, "samples 3"] | None = None
    auxiliary: Mapping[str, np.ndarray] = field(default_factory=dict)

    @property
    def rate(self) -> float:
        """Sample rate in Hz from the stamps, without gaps; 0 if unknown."""
        intervals = seconds_between(self.times)
        mean = float(intervals.mean()) if intervals.size else 0.0
        return 1.0 / mean if mean > 0.0 else 0.0

    def taken(self, rows: np.ndarray) -> "Series":
        """Return the series of these rows."""
        gyro, accel = (None if half is None else half[rows] for half in (self.gyro, self.accel))
        others = {label: values[rows] for label, values in self.auxiliary.items()}
        return replace(self, times=self.times[rows], gyro=gyro, accel=accel, auxiliary=others)

    def in_order(self) -> "Series":
        """Return the series sorted by its stamps."""
        return self if (np.diff(self.times) >= 0).all() else self.taken(np.argsort(self.times, kind="stable"))

    def table(self, clock: str, source: Source, notes: Sequence[str]) -> Table:
        """Return a table with the stamps, labelled `clock` [ns], the axes and the auxiliary columns."""
        columns = {f"{clock} [ns]": self.times}
        for sensor, half in (("gyro", self.gyro), ("accel", self.accel)):
            if half is not None:
                columns |= {f"{sensor}_{axis}": half[:, k] for k, axis in enumerate("xyz")}
        columns |= self.auxiliary
        table = Table.of(tuple(columns.values()), tuple(columns), source, notes=tuple(notes))
        return replace(table, units=UNITS, is_apart=True)


def seconds_between(stamps: Int[np.ndarray, " n"]) -> Float[np.ndarray, " intervals"]:
    """Return intervals [s] between stamps [ns] in time order, without gaps."""
    ordered = np.sort(stamps)
    return regular_intervals(1e-9 * (ordered - ordered[:1]))


def joined(chosen: Sequence[Series], source: Source) -> Series:
    """Return a sorted series, or the gyros of one and the accelerometers of another with the gyros' stamps.

    A sample without partner is left out, which leaves a gap.
    """
    if len(chosen) == 1:
        return chosen[0]
    gyro, accel = chosen
    rates = gyro.rate, accel.rate
    choose = f"choose one with topic=, {gyro.name} or {accel.name}"
    if not all(rates) or abs(rates[0] / rates[1] - 1.0) > MAX_RATE_DIFFERENCE:
        raise source.error(
            f"the gyros of {gyro.name} are at {rates[0]:.6g} Hz and the accelerometers of {accel.name} at "
            f"{rates[1]:.6g} Hz, but a recording has one rate; {choose}"
        )
    half = round(0.5e9 / rates[0])
    partner = np.searchsorted(accel.times, gyro.times - half)
    paired = partner < len(accel.times)
    paired[paired] = accel.times[partner[paired]] < gyro.times[paired] + half
    rows = np.flatnonzero(paired)
    rows = rows[np.diff(partner[rows], prepend=-1) > 0]
    if len(rows) < _MATCHED * min(len(gyro.times), len(accel.times)):
        raise source.error(
            f"only {len(rows)} of {len(gyro.times)} samples of {gyro.name} have one of {accel.name} at the "
            f"same time; {choose}"
        )
    one, other = gyro.taken(rows), accel.taken(partner[rows])
    both = f"{gyro.name} and {accel.name}"
    return replace(one, name=both, accel=other.accel, auxiliary={**other.auxiliary, **one.auxiliary})

"""Results of `navigate`: errors over time, in each direction, with their causes."""

from __future__ import annotations

import dataclasses
import math
import os
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from jaxtyping import Float

from allanjax.base.earth import EARTH_RADIUS
from allanjax.base.equality import ByValue
from allanjax.base.errors import AllanjaxError
from allanjax.base.late import presented
from allanjax.base.tables import html_table, text_table
from allanjax.base.wording import duration, finite_or_none, plain, significant

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

#: Errors of a navigator.
Quantity = Literal["attitude", "velocity", "position"]
#: Units in which they are computed, and in which they are told with their size in SI.
UNITS: dict[str, str] = {"attitude": "rad", "velocity": "m/s", "position": "m"}
SHOWN: dict[str, tuple[str, float]] = {
    "attitude": ("deg", math.pi / 180.0),
    "velocity": ("m/s", 1.0),
    "position": ("m", 1.0),
}
_HEADINGS = ("error", "after", "1σ", "95 % interval", "mostly from")


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class ErrorGrowth(ByValue):
    """Standard deviation of an error over time, in each direction.

    Attributes:
        quantity: "attitude" (about the direction), "velocity" or "position" (along it).
        channels: the directions, of "north", "east" and "down".
        time: times [s] since the start.
        error: standard deviation [rad, m/s or m].
        lower, upper: ends of its 95 % interval; nan for models that are taken as exact.
        causes: by direction, standard deviations of what each cause does by itself.
    """

    quantity: Quantity
    channels: tuple[str, ...]
    time: Float[np.ndarray, " t"]
    error: Float[np.ndarray, "channels t"]
    lower: Float[np.ndarray, "channels t"]
    upper: Float[np.ndarray, "channels t"]
    causes: Mapping[str, Mapping[str, Float[np.ndarray, " t"]]]

    @property
    def unit(self) -> str:
        """SI unit of the errors."""
        return UNITS[self.quantity]

    def of(self, channel: str) -> Float[np.ndarray, " t"]:
        """Standard deviation in one direction.

        Raises:
            AllanjaxError: there is no such direction.
        """
        if channel not in self.channels:
            raise AllanjaxError(f"{self.quantity}: no error {channel}; there are {', '.join(self.channels)}")
        return self.error[self.channels.index(channel)]

    def __repr__(self) -> str:
        unit, scale = SHOWN[self.quantity]
        last = (f"{c} {significant(float(self.of(c)[-1]) / scale)} {unit}" for c in self.channels)
        return f"<ErrorGrowth {self.quantity} after {plain(float(self.time[-1]), 4)} s: {', '.join(last)}>"

    def largest(self, channel: str) -> list[str]:
        """The cause that contributes most, at each time."""
        causes = self.causes[channel]
        names = list(causes)
        return [names[k] for k in np.argmax(np.stack(list(causes.values())), axis=0)]

    def to_dataframe(self) -> pd.DataFrame:
        """One row a direction and time, in SI."""
        import pandas as pd

        tables = [
            pd.DataFrame(
                {
                    "quantity": self.quantity,
                    "channel": channel,
                    "time": self.time,
                    "error": self.error[k],
                    "lower_95": self.lower[k],
                    "upper_95": self.upper[k],
                    "unit": self.unit,
                    "largest cause": self.largest(channel),
                }
            )
            for k, channel in enumerate(self.channels)
        ]
        return pd.concat(tables, ignore_index=True)

    def to_dict(self) -> dict[str, Any]:
        """The numbers as plain dictionaries and lists, in SI; None where there is no interval."""

        def numbers(values: Float[np.ndarray, " t"]) -> list[float | None]:
            return [finite_or_none(x) for x in values]

        return {
            "unit": self.unit,
            "channels": {
                channel: {
                    "error": numbers(self.error[k]),
                    "lower_95": numbers(self.lower[k]),
                    "upper_95": numbers(self.upper[k]),
                    "causes": {cause: numbers(x) for cause, x in self.causes[channel].items()},
                }
                for k, channel in enumerate(self.channels)
            },
        }

    def rows(self, at: Sequence[int]) -> list[tuple[str, ...]]:
        """Rows of the printed table, at these indices of the times."""
        unit, scale = SHOWN[self.quantity]
        cells: list[tuple[str, ...]] = []
        for k, channel in enumerate(self.channels):
            largest = self.largest(channel)
            for j in at:
                value = self.error[k, j]
                share = (self.causes[channel][largest[j]][j] / value) ** 2 if value > 0.0 else 1.0
                low, high = (significant(float(x[k, j]) / scale) for x in (self.lower, self.upper))
                cells.append(
                    (
                        f"{self.quantity} {channel}",
                        f"{plain(float(self.time[j]), 4)} s",
                        f"{significant(float(value) / scale)} {unit}",
                        f"{low} … {high}" if np.isfinite(self.lower[k, j]) else "",
                        f"{largest[j]} {share:.0%}",
                    )
                )
        return cells


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Navigation(ByValue, Mapping[str, ErrorGrowth]):
    """Growth of a resting navigator's errors: `result["position"].of("north")`.

    Attributes:
        name: the recording's name.
        rate: sample rate [Hz].
        calibration: time at rest before the start [s], over which the biases were averaged.
        gravity: of the Earth [m/s²].
        schuler: whether the loop of gravity is in the errors; without it they hold for short times only.
        growths: of attitude, velocity and position, as far as there are sensors for them.
        notes: what to bear in mind.
    """

    name: str
    rate: float
    calibration: float
    gravity: float
    schuler: bool
    growths: tuple[ErrorGrowth, ...]
    notes: tuple[str, ...] = ()

    @property
    def quarter_period(self) -> float:
        """A quarter of the Schuler period 2π√(R/g) [s], up to which the short-term errors hold."""
        return math.pi / 2.0 * math.sqrt(EARTH_RADIUS / self.gravity)

    def __getitem__(self, quantity: str) -> ErrorGrowth:
        """The growth of "attitude", "velocity" or "position"."""
        for growth in self.growths:
            if growth.quantity == quantity:
                return growth
        raise AllanjaxError(f"no error of {quantity!r}; there are {', '.join(self)}")

    def __iter__(self) -> Iterator[str]:
        return iter([growth.quantity for growth in self.growths])

    def __len__(self) -> int:
        return len(self.growths)

    def to_dataframe(self) -> pd.DataFrame:
        """One row a quantity, direction and time, in SI."""
        import pandas as pd

        return pd.concat([growth.to_dataframe() for growth in self.growths], ignore_index=True)

    def to_dict(self) -> dict[str, Any]:
        """The result as plain dictionaries, lists and numbers, in SI."""
        return {
            "name": self.name,
            "rate_hz": self.rate,
            "calibration_s": self.calibration,
            "gravity_m_s2": self.gravity,
            "schuler": self.schuler,
            "time_s": [float(t) for t in self.growths[0].time],
            "errors": {growth.quantity: growth.to_dict() for growth in self.growths},
            "notes": list(self.notes),
        }

    @presented
    def plot(self, path: str | os.PathLike[str] | None = None) -> Figure:
        """Draw the errors against time with their causes, a panel a quantity and direction."""
        raise NotImplementedError

    def _title(self) -> str:
        name = f"{self.name}: " if self.name else ""
        loop = "with the Schuler loop" if self.schuler else "short-term"
        return (
            f"{name}errors of a navigator at rest, {loop}, biases averaged over {duration(self.calibration)}"
        )

    def _rows(self) -> list[tuple[str, ...]]:
        time = self.growths[0].time
        # The times nearest to powers of ten, and the end.
        decades = np.arange(math.ceil(math.log10(time[0])), math.log10(time[-1]))
        told = {int(np.argmin(np.abs(np.log10(time) - decade))) for decade in decades}
        at = sorted(told | {len(time) - 1}) if len(time) > 6 else list(range(len(time)))
        return [row for growth in self.growths for row in growth.rows(at)]

    def __str__(self) -> str:
        table = text_table(self._title(), _HEADINGS, self._rows(), right=_HEADINGS[1:3])
        return "\n".join([table, *(f"note: {note}" for note in self.notes)])

    def __repr__(self) -> str:
        return str(self)

    def _repr_html_(self) -> str:
        notes = "".join(f"<p>note: {note}</p>" for note in self.notes)
        return html_table(self._title(), _HEADINGS, self._rows()) + notes

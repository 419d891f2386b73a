"""Options of reading, in one object, so that no reader and no command can leave one out."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from typing import TYPE_CHECKING, Any, Literal, get_args

from allanjax.base.errors import RecordingError

if TYPE_CHECKING:
    from allanjax.record.units import Sensor

TimeChoice = str | Literal[False] | None
GapChoice = Literal["error", "segments", "fill"]


def _option(help: str) -> Any:
    """An option that is not given by default, and what the command line's help says of it."""
    return field(default=None, metadata={"help": help})


@dataclass(frozen=True)
class ReadOptions:
    """The arguments of `read` and `read_chunks`, whose meaning is told there; None where one is not given."""

    rate: float | None = _option(
        "Sample rate in Hz; needed if the file has no time stamps, else used instead of theirs."
    )
    gyro_unit: str | None = _option(
        "Unit of the gyros, whatever the header says: deg/s, rad/s, ...; rad for increments; of counts the "
        "size of one, 'deg/s/131'."
    )
    accel_unit: str | None = _option(
        "Unit of the accelerometers, whatever the header says: m/s^2, g, ...; m/s for increments; of counts "
        "the size of one, 'g/16384'."
    )
    columns: str | Sequence[str] | None = _option(
        "Columns to read, or a name for each in order, - to skip one, e.g. time,gyro_x,-,gyro_z."
    )
    time: TimeChoice = _option(
        "Column of time stamps; none to ignore them; uniform to take samples as even at their mean rate."
    )
    time_unit: str | None = _option("Unit of the time stamps: s, ms, us, ns, min, h, or '0.1 ms'.")
    start: float | None = _option("Leave out what is before this time, in s.")
    stop: float | None = _option("Leave out what is from this time on, in s.")
    topic: str | None = _option(
        "Topic of a ROS bag, or message of a flight log, e.g. /imu/data or sensor_gyro; or two: a,b."
    )
    instance: int | None = _option(
        "Number of the sensor in a flight log that has several; by default the first."
    )
    gaps: GapChoice | None = _option(
        "Missing samples: error; segments, the longest stretch without; fill, draw them given the others."
    )

    def __post_init__(self) -> None:
        start, stop = self.start, self.stop
        for name, time in (("start", start), ("stop", stop)):
            if time is not None and not math.isfinite(time):
                raise RecordingError(f"{name}= (--{name}) must be a time in s, not {time}")
        if self.gaps not in (None, *get_args(GapChoice)):
            raise RecordingError(f"gaps= (--gaps) must be error, segments or fill, not {self.gaps!r}")
        if start is not None and stop is not None and start >= stop:
            raise RecordingError(
                f"start= (--start) must be before stop= (--stop), and {start:g} s is not before {stop:g} s"
            )

    @property
    def allows_gaps(self) -> bool:
        """Whether missing samples are no error."""
        return self.gaps in ("segments", "fill")

    @property
    def uniform(self) -> bool:
        """Whether samples are evenly spaced whatever their stamps say."""
        return isinstance(self.time, str) and self.time.casefold() == "uniform"

    @property
    def units(self) -> dict[Sensor, str | None]:
        """Unit of each sensor's samples, where it is given."""
        return {"gyro": self.gyro_unit, "accel": self.accel_unit}

    def within(self, stretch: tuple[float, float]) -> ReadOptions:
        """Options for a stretch [s] of what these read, from its first sample."""
        origin = self.start or 0.0
        return replace(self, start=origin + stretch[0], stop=origin + stretch[1])

    def given(self) -> dict[str, Any]:
        """Names and values of the options that are given."""
        values = {option.name: getattr(self, option.name) for option in fields(self)}
        return {name: value for name, value in values.items() if value is not None}

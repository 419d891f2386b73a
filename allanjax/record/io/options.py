"""Options for reading, in one object shared by all readers and commands."""

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, Literal, get_args

import numpy as np

from allanjax.base.errors import RecordingError
from allanjax.record.units import Sensor

TimeChoice = str | Literal[False] | None
GapChoice = Literal["error", "segments", "fill"]


def _option(help: str) -> Any:
    """Return an option that is not given by default, with its help for the command line."""
    return field(default=None, metadata={"help": help})


@dataclass(frozen=True)
class ReadOptions:
    """Arguments of `read` and `read_chunks`, which describe them; None if an argument is not given."""

    rate: float | None = _option(
        "Sample rate in Hz; required without time stamps, else used instead of theirs."
    )
    gyro_unit: str | None = _option(
        "Unit of the gyros (overrides the header): deg/s, rad/s, ...; rad for increments; for counts the "
        "size of one, 'deg/s/131'."
    )
    accel_unit: str | None = _option(
        "Unit of the accelerometers (overrides the header): m/s^2, g, ...; m/s for increments; for counts "
        "the size of one, 'g/16384'."
    )
    columns: str | Sequence[str] | None = _option(
        "Columns to read, or one name per column, with - to skip one, e.g. time,gyro_x,-,gyro_z."
    )
    time: TimeChoice = _option(
        "Column of time stamps; none to ignore them; uniform for evenly spaced samples at the mean rate."
    )
    time_unit: str | None = _option("Unit of the time stamps: s, ms, us, ns, min, h, or '0.1 ms'.")
    start: float | None = _option("Start reading at this time, in s from the first sample.")
    stop: float | None = _option("Stop reading before this time, in s from the first sample.")
    topic: str | None = _option(
        "Topic of a ROS bag or message of a flight log, e.g. /imu/data or sensor_gyro; or two: a,b."
    )
    instance: int | None = _option("Number of the sensor in a flight log with several; by default the first.")
    gaps: GapChoice | None = _option(
        "Missing samples: error; segments (read the longest part without gaps); fill (simulate them)."
    )

    def __post_init__(self) -> None:
        start, stop = self.start, self.stop
        for name, time in (("start", start), ("stop", stop)):
            if time is not None and not np.isfinite(time):
                raise RecordingError(f"{name}= (--{name}) must be a time in s, not {time}")
        if self.gaps not in (None, *get_args(GapChoice)):
            raise RecordingError(f"gaps= (--gaps) must be error, segments or fill, not {self.gaps!r}")
        if start is not None and stop is not None and start >= stop:
            raise RecordingError(
                f"start= (--start) must be before stop= (--stop), but {start:g} s is not before {stop:g} s"
            )

    @property
    def allows_gaps(self) -> bool:
        """Whether missing samples are accepted."""
        return self.gaps in ("segments", "fill")

    @property
    def uniform(self) -> bool:
        """Whether samples are evenly spaced regardless of their stamps."""
        return isinstance(self.time, str) and self.time.casefold() == "uniform"

    @property
    def units(self) -> dict[Sensor, str | None]:
        """Unit of the samples of each sensor, if given."""
        return {"gyro": self.gyro_unit, "accel": self.accel_unit}

    def within(self, stretch: tuple[float, float]) -> "ReadOptions":
        """Return the options for a part [s] of the recording that these options read."""
        origin = self.start or 0.0
        return replace(self, start=origin + stretch[0], stop=origin + stretch[1])

    def given(self) -> dict[str, Any]:
        """Return names and values of the options that are given."""
        values = {option.name: getattr(self, option.name) for option in fields(self)}
        return {name: value for name, value in values.items() if value is not None}

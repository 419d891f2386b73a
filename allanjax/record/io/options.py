"""Reading options in one object, so that no reader and no command can leave one out."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any, Literal, get_args

from allanjax.base.errors import RecordingError
from allanjax.base.wording import with_commands

if TYPE_CHECKING:
    from allanjax.record.units import Sensor

TimeChoice = str | Literal[False] | None
GapChoice = Literal["error", "segments", "fill"]


@dataclass(frozen=True)
class ReadOptions:
    """The arguments of `read` and `read_chunks`, which are described there; None if not given.

    Attributes
    ----------
    rate
        Sample rate in Hz. Required if the file has no time stamps; otherwise it overrides their rate.
    gyro_unit
        Unit of the gyros, overriding the header: deg/s, rad/s, ...; rad for increments; for counts the
        size of one count, 'deg/s/131'.
    accel_unit
        Unit of the accelerometers, overriding the header: m/s^2, g, ...; m/s for increments; for counts
        the size of one count, 'g/16384'.
    columns
        Columns to read, or a name for each column in order with - to skip one: time,gyro_x,-,gyro_z.
    time
        Column of time stamps; none ignores them; uniform assumes even samples at their mean rate,
        also after a column: t_boot,uniform.
    time_unit
        Unit of the time stamps: s, ms, us, ns, min, h, or '0.1 ms'.
    start
        Leave out samples before this time in s.
    stop
        Leave out samples from this time on, in s.
    topic
        Topic of a ROS bag or message of a flight log, e.g. /imu/data or sensor_gyro; if gyros and
        accelerometers are in different ones, a,b.
    instance
        Number or name of the sensor if a file has several: of a flight log by default the first; of a
        table as a column such as sensor_id says.
    gaps
        What to do about missing samples: error (default); segments, fit the segments between gaps
        jointly; fill, replace them by simulated samples.
    force
        With --time uniform: take evenly spaced samples even where the stamps show that samples are
        missing, or that the rate changes.
    """

    rate: float | None = None
    gyro_unit: str | None = None
    accel_unit: str | None = None
    columns: str | Sequence[str] | None = None
    time: TimeChoice = None
    time_unit: str | None = None
    start: float | None = None
    stop: float | None = None
    topic: str | None = None
    instance: int | str | None = None
    gaps: GapChoice | None = None
    force: bool = False

    def __post_init__(self) -> None:
        start, stop = self.start, self.stop
        for name, time in (("start", start), ("stop", stop)):
            if time is not None and not math.isfinite(time):
                raise RecordingError(with_commands(f"{name}= must be a time in s, not {time}"))
        if self.gaps not in (None, *get_args(GapChoice)):
            wrong = f"gaps= is {self.gaps!r}, which is unknown; pass gaps='segments' or gaps='fill'"
            raise RecordingError(with_commands(wrong))
        if start is not None and stop is not None and start >= stop:
            wrong = f"start= must be before stop=, and {start:g} s is not before {stop:g} s"
            raise RecordingError(with_commands(wrong))

    @property
    def allows_gaps(self) -> bool:
        """Whether missing samples are allowed."""
        return self.gaps in ("segments", "fill")

    @property
    def timeless(self) -> bool:
        """Whether time stamps are ignored."""
        return self.time is False or self._time_words == ["none"]

    @property
    def uniform(self) -> bool:
        """Whether samples are assumed to be evenly spaced, whatever their time stamps."""
        return "uniform" in self._time_words

    @property
    def time_column(self) -> str | None:
        """Name of the column of time stamps, if it is given."""
        words = [word for word in self._time_words if word != "uniform"]
        return words[0] if words and not self.timeless else None

    @property
    def _time_words(self) -> list[str]:
        return [word.strip().casefold() for word in (self.time or "").split(",") if word.strip()]

    @property
    def units(self) -> "dict[Sensor, str | None]":
        """Unit of each sensor's samples, if given."""
        return {"gyro": self.gyro_unit, "accel": self.accel_unit}

    def within(self, part: tuple[float, float]) -> "ReadOptions":
        """Options for a part [s] of the recording that these read, counted from its first sample."""
        origin = self.start or 0.0
        return replace(self, start=origin + part[0], stop=origin + part[1])

    def of_sensor(self, sensor: str) -> "ReadOptions":
        """Options for one sensor of the recording that these read."""
        gyro, accel = (unit if kind == sensor else None for kind, unit in self.units.items())
        return replace(self, columns=sensor, gyro_unit=gyro, accel_unit=accel)

    def given(self) -> dict[str, Any]:
        """Names and values of the options that are given."""
        values = {option.name: getattr(self, option.name) for option in fields(self)}
        defaults = {option.name: option.default for option in fields(self)}
        return {name: value for name, value in values.items() if value is not defaults[name]}

"""Accuracy of leveling and gyro-compassing against the averaging time."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from allanjax.base.earth import EARTH_RATE, STANDARD_GRAVITY
from allanjax.base.equality import ByValue
from allanjax.base.errors import AllanjaxError
from allanjax.base.tables import PerAxis
from allanjax.base.wording import duration, format_range, percent, significant
from allanjax.estimate.as_json import in_json
from allanjax.navigation.likely import AxisNoise, NoiseLike, Sensors, biases_of, in_si, sensors_of
from allanjax.noise.datasheet import NOT_GIVEN
from allanjax.noise.model import Model
from allanjax.record.recording import Axis
from allanjax.record.units import Sensor, unit_scale

if TYPE_CHECKING:
    import pandas as pd

# Units of printed errors: of an azimuth and of a tilt.
_SHOWN: dict[Sensor, str] = {"gyro": "deg", "accel": "arcsec"}
# Latitude beyond which the horizontal part of the Earth's rate is below 1/50.
_POLAR = math.radians(89.0)
# Longest averaging time for models [s], times an octave, and error beyond which an angle is not small.
_LONGEST, _PER_OCTAVE, _LARGE = 1e5, 8, math.radians(30.0)
# An error above this share of its value one octave earlier no longer falls; for white noise it is 0.71.
_FALLING = 0.9
_DEG = math.pi / 180.0


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class AxisAlignment(ByValue):
    """Accuracy of the angle that one level axis measures: azimuth by a gyro, tilt by an accelerometer.

    Each interval has 95 % probability, and is nan for models that are taken as exact.

    Attributes:
        axis: the axis; a gyro's azimuth is measured while this axis points east.
        time: averaging times [s], half in each of two opposite positions.
        error, lower, upper: standard deviation of the angle [rad] and its interval.
        best: the least error [rad], and `best_interval`.
        best_time: the first averaging time [s] at which the error is within 1 % of the least, where it may
            stay; and `best_time_interval`.
        falling: whether the error still falls at the longest time, so that more time would help.
        wanted: the requested error [rad]; None if none was requested, or for an accelerometer.
        needed: time [s] after which the requested error is reached, infinite if it never is; and
            `needed_interval`.
        white_time: the same for white noise alone (2.53) [s].
        out_of_reach: probability that the requested error is not reached at any averaging time up to the
            longest.
        is_bound: whether all errors and times are lower bounds, as not all of N, B and K are given; the best
            time and the interval of the least error are then nan, and whether the error falls is unknown.
    """

    axis: Axis
    time: Float[np.ndarray, " t"]
    error: Float[np.ndarray, " t"]
    lower: Float[np.ndarray, " t"]
    upper: Float[np.ndarray, " t"]
    best: float
    best_interval: tuple[float, float]
    best_time: float
    best_time_interval: tuple[float, float]
    falling: bool
    wanted: float | None = None
    needed: float = math.nan
    needed_interval: tuple[float, float] = (math.nan, math.nan)
    white_time: float = math.nan
    out_of_reach: float = math.nan
    is_bound: bool = False

    @property
    def angle(self) -> str:
        """Name of the angle: "azimuth" or "tilt"."""
        return "azimuth" if self.axis.sensor == "gyro" else "tilt"

    def __repr__(self) -> str:
        best = f"{significant(self.best / _DEG)} deg after {duration(self.best_time)}"
        return f"<AxisAlignment {self.axis.name}: best {self.angle} {best}>"

    @property
    def verdict(self) -> str:
        """Whether and when the wanted error is reached, in words."""
        if self.best > _LARGE:
            return f"no {self.angle}: its error is never below {significant(self.best / _DEG)} deg"
        if self.is_bound and self.wanted is None:
            return "at least this, as N, B and K are not all given"
        if self.wanted is None:
            return f"the error still falls after {duration(float(self.time[-1]))}" if self.falling else ""
        wanted, longest = f"{significant(self.wanted / _DEG)} deg", duration(float(self.time[-1]))
        white = f"white noise alone would take {duration(self.white_time)}" if self.white_time > 0.0 else ""
        if math.isinf(self.needed):
            why = f"takes more than {longest} (the error still falls)" if self.falling else "is out of reach"
            doubtful = 0.0 < self.out_of_reach < 1.0
            doubt = f", with probability {percent(self.out_of_reach)}" if doubtful else ""
            reached = f"{wanted} {why}{doubt}"
        else:
            low, high = self.needed_interval
            latest = "never" if math.isinf(high) else duration(high)
            ends = "" if math.isnan(low) else f" (95 %: {duration(low)} … {latest})"
            least = "at least " if self.is_bound else ""
            reached = f"{wanted} takes {least}{duration(self.needed)}{ends}"
            if self.out_of_reach > 0.025:
                reached += f"; it is out of reach with probability {percent(self.out_of_reach)}"
        return f"{reached}; {white}" if white else reached

    def rows(self) -> list[tuple[str, ...]]:
        """The row of the printed table: axis, angle, least error and averaging time with intervals."""
        if self.best > _LARGE:
            return [(self.axis.name, self.angle, *[""] * 4)]
        cells = [self.axis.name, self.angle]
        for name, scale in (("best", unit_scale(_SHOWN[self.axis.sensor])), ("best_time", 1.0)):
            ends = (x / scale for x in getattr(self, f"{name}_interval"))
            value = getattr(self, name) / scale
            least = "≥ " if self.is_bound else ""
            cells += [NOT_GIVEN if math.isnan(value) else f"{least}{significant(value)}", format_range(*ends)]
        return [tuple(cells)]

    def to_dataframe(self) -> pd.DataFrame:
        """Error by averaging time, in SI."""
        import pandas as pd

        columns = {"time": self.time, "error": self.error, "lower_95": self.lower, "upper_95": self.upper}
        return pd.DataFrame({"axis": self.axis.name, "angle": self.angle, **columns})

    def to_dict(self) -> dict[str, Any]:
        """The numbers as plain dictionaries, in SI; None for undefined numbers."""
        names = ["wanted", "falling", "best", "best_time", "needed", "white_time", "out_of_reach"]
        names += ["best_interval", "best_time_interval", "needed_interval", "is_bound"]
        numbers = in_json({name: getattr(self, name) for name in names})
        return {"axis": self.axis.name, "angle": self.angle, **numbers, "verdict": self.verdict}


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Alignment(ByValue, PerAxis[AxisAlignment]):
    """Accuracy of leveling and gyro-compassing with the level axes of a sensor.

    Attributes:
        name: the recording's name.
        latitude: latitude of the sensor [rad].
        results: one per axis.
    """

    name: str
    latitude: float
    results: tuple[AxisAlignment, ...]

    def to_dict(self) -> dict[str, Any]:
        """The result as plain dictionaries, in SI."""
        axes = [result.to_dict() for result in self.results]
        return {"name": self.name, "latitude_rad": self.latitude, "axes": axes}

    def _title(self) -> str:
        done = {"tilt": "leveling", "azimuth": "gyro-compassing"}
        angles = {result.angle for result in self.results}
        what = " and ".join(what for angle, what in done.items() if angle in angles)
        return f"{what} at {self.latitude / _DEG:g}° latitude, in two opposite positions"

    def _heads(self, sensor: Sensor) -> tuple[str, ...]:
        error, time = (f"least error 1σ ({_SHOWN[sensor]})", "averaging time (s)")
        return "axis", "angle", error, f"95 % interval ({_SHOWN[sensor]})", time, "95 % interval (s)"

    def _notes(self) -> list[str]:
        verdicts = {r.axis.name: r.verdict for r in self.results}
        return [f"{name}: {verdict}" for name, verdict in verdicts.items() if verdict]


def align(
    data: NoiseLike,
    latitude: float,
    azimuth: float | str | None = None,
    *,
    rate: float | None = None,
    gyro_bias: float | str = 0.0,
    accel_bias: float | str = 0.0,
    gravity: float = STANDARD_GRAVITY,
    seed: int = 0,
) -> Alignment:
    """Accuracy of a static alignment against its duration, and the duration for a requested azimuth.

    The error of the tilt is an accelerometer's error over g (2.45, 2.46). That of the azimuth is the error of
    the gyro that points east over the horizontal part of the Earth's rate, ω_e cos φ (2.52). A bias is
    cancelled by averaging for half of the time T in one position and for the other half in the opposite one;
    half the difference of the two means has the variance σ²(T/2)/2, with the Allan variance σ². It is N²/T
    for white noise, as in (2.53); with all terms it has a minimum, so that an azimuth may be out of reach.

    Args:
        data: what `fit` or `load` returned, a posterior, or models by the names of axes, taken as exact.
        latitude: latitude of the sensor [deg].
        azimuth: requested standard deviation of the azimuth [rad], or a text such as "0.1 deg".
        rate: sample rate [Hz] of models.
        gyro_bias, accel_bias: standard deviation of biases that remain after turning, as in `navigate`.
        gravity: gravity of the Earth [m/s²].
        seed: seed of the draws of the coefficients.

    Raises:
        FitError: no axis has a measurement.
        AllanjaxError, UnitError: a latitude within 1° of a pole or beyond it; no level axis; a record of less
            than four samples; a value out of range or that cannot be read; a model without terms or values.
    """
    phi = math.radians(latitude)
    if not abs(phi) <= math.pi / 2.0:
        raise AllanjaxError(f"latitude= (--latitude) must be from -90 to 90 deg, not {latitude}")
    if abs(phi) > _POLAR:
        raise AllanjaxError(
            f"at {latitude} deg latitude the Earth's rotation has no horizontal part that shows north: "
            "gyro-compassing needs a latitude below 89 deg"
        )
    if not 0.0 < gravity < np.inf:
        raise AllanjaxError(f"gravity must be positive and finite, not {gravity}")
    wanted = None if azimuth is None else in_si(azimuth, "rad", "azimuth")
    if wanted == 0.0:
        raise AllanjaxError("the error of an azimuth cannot be zero: give a positive azimuth")
    sensors, biases = sensors_of(data, rate, seed), biases_of(gyro_bias, accel_bias)
    per_angle: dict[Sensor, float] = {"gyro": EARTH_RATE * math.cos(phi), "accel": gravity}
    level = [noise for noise in sensors.axes.values() if not noise.axis.name.endswith("_z")]
    if not level:
        raise AllanjaxError(f"alignment needs a level axis, x or y; there are {', '.join(sensors.axes)}")
    results = []
    for noise in level:
        s = noise.axis.sensor
        results.append(_of_axis(noise, sensors, per_angle[s], biases[s], wanted if s == "gyro" else None))
    return Alignment(sensors.name, phi, tuple(results))


def _of_axis(
    noise: AxisNoise, sensors: Sensors, per_angle: float, bias: float, wanted: float | None
) -> AxisAlignment:
    """Accuracy of one axis; `per_angle` is its rate for an angle of 1 rad."""
    rate, longest = sensors.rate, min(sensors.record, _LONGEST)
    octaves = math.log2(longest * rate / 2.0)
    if octaves < 1.0:
        raise AllanjaxError(f"{noise.axis.name}: alignment needs a record of at least four samples")
    size = np.unique(np.rint(2.0 ** np.arange(0.0, octaves, 1.0 / _PER_OCTAVE)).astype(int))
    half = size / rate

    def variance(term: Model) -> Float[np.ndarray, " t"]:
        return np.asarray(term.sampled(rate).allan_variance(half)) / 2.0

    drawn, time = noise.drawn(variance), 2.0 * half

    def angle(variance: Float[np.ndarray, ...]) -> Float[np.ndarray, ...]:
        return np.sqrt(variance + bias**2) / per_angle

    error, known, above = (angle(x) for x in (drawn.total, drawn.known, drawn.upper))
    lower, upper = (angle(end) for end in sensors.ends(drawn))

    def found(of: Callable[[np.ndarray], np.ndarray], low: np.ndarray, high: np.ndarray) -> tuple:
        """A property of the error, and its interval by draws of the error; these may be infinite."""
        ends = (math.nan, math.nan)
        if sensors.estimated:
            pair = ((of(low), 0.025), (of(high), 0.975))
            ends = tuple(float(np.quantile(x, q, method="nearest")) for x, q in pair)  # type: ignore[assignment]
        return float(of(error[None])[0]), ends

    def first(errors: Float[np.ndarray, "draws t"]) -> Float[np.ndarray, " draws"]:
        """The first times at which errors are within a per cent of the least."""
        return time[np.argmax(errors <= 1.01 * errors.min(axis=1, keepdims=True), axis=1)]

    best, best_interval = found(lambda errors: errors.min(axis=1), known, above)
    # Terms that are only known to be below a limit make an error rise sooner.
    best_time, best_time_interval = found(first, above, known)
    reached: dict[str, Any] = {}
    if wanted is not None:
        needed, interval = found(lambda x: np.array([_reached(time, e, wanted) for e in x]), known, above)
        white = drawn.mean.get(f"{noise.axis.name} angle random walk")
        reached = {
            "wanted": wanted,
            "needed": needed,
            "needed_interval": interval,
            "white_time": math.nan if white is None else white[-1] * time[-1] / (wanted * per_angle) ** 2,
            "out_of_reach": float((above > wanted).all(axis=1).mean()),
        }
    falling = bool(error[-1] < _FALLING * error[-min(len(error), _PER_OCTAVE + 1)])
    if drawn.is_bound:
        best_time, falling = math.nan, False
        best_interval = best_time_interval = (math.nan, math.nan)
    of_best = (best, best_interval, best_time, best_time_interval, falling)
    of_curve = (noise.axis, time, error, lower, upper)
    return AxisAlignment(*of_curve, *of_best, **reached, is_bound=drawn.is_bound)


def _reached(time: Float[np.ndarray, " t"], error: Float[np.ndarray, " t"], wanted: float) -> float:
    """First time with the requested error, by a power law between times; infinite if there is none."""
    below = np.flatnonzero(error <= wanted)
    if not below.size:
        return math.inf
    k = int(below[0])
    if k == 0:
        return float(time[0])
    share = math.log(error[k - 1] / wanted) / math.log(error[k - 1] / error[k])
    return float(time[k - 1] * (time[k] / time[k - 1]) ** share)

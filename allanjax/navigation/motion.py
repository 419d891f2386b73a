"""A simple motion, and what a calibration leaves of the errors that act in it."""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from allanjax.base.equality import ByValue
from allanjax.base.errors import AllanjaxError
from allanjax.base.wording import duration, plain
from allanjax.calibration.result import AxisCalibration, Calibration, place_of
from allanjax.navigation.likely import in_si
from allanjax.record.units import SI, Sensor, convert, parse_quantity

# Turn beyond which the directions of errors are not those at its start.
_SHORT = math.radians(30.0)


@dataclasses.dataclass(frozen=True, eq=False)
class Profile(ByValue):
    """A turn and an acceleration from the start on, both constant, and then neither.

    Attributes:
        turn_rate: rate about x, y and z (down) [rad/s]; given as a number it is about z, as a text it has a
            unit: "10 deg/s", or "5, 0, 10 deg/s" for three axes.
        acceleration: acceleration along x, y and z [m/s²]; a number or a text such as "0.5 g" is along x.
        duration: how long both last [s], or a text such as "20 s"; without end by default.

    Raises:
        AllanjaxError, UnitError: not numbers; a negative duration; a unit of another dimension.
    """

    turn_rate: Any = 0.0
    acceleration: Any = 0.0
    duration: Any = math.inf

    def __post_init__(self) -> None:
        given = self.duration
        seconds = given if given == math.inf else in_si(given, "s", "the duration of a profile (--for)")
        vectors = {
            "turn_rate": _vector(self.turn_rate, "gyro", "turn_rate (--turn-rate)", 2),
            "acceleration": _vector(self.acceleration, "accel", "acceleration (--acceleration)", 0),
        }
        for name, value in {**vectors, "duration": seconds}.items():
            object.__setattr__(self, name, value)

    def describe(self) -> str:
        """The motion in words, e.g. "turning by 10 deg/s for 9 s"."""
        parts = [
            f"{word} {', '.join(plain(convert(x, si, unit), 4) for x in vector)} {unit}"
            for word, vector, si, unit in (
                ("turning at", self.turn_rate, "rad/s", "deg/s"),
                ("accelerating at", self.acceleration, "m/s²", "g"),
            )
            if any(vector)
        ]
        end = f" for {duration(self.duration)}" if parts and math.isfinite(self.duration) else ""
        return (" and ".join(parts) or "at rest") + end

    def is_long(self, seconds: float) -> bool:
        """Whether after this time the craft has turned so far that the directions of errors matter."""
        return math.hypot(*self.turn_rate) * min(self.duration, seconds) > _SHORT

    def to_dict(self) -> dict[str, Any]:
        """The motion as plain dictionaries and lists, in SI; None for a duration without end."""
        return {
            "turn_rate_rad_s": list(self.turn_rate),
            "acceleration_m_s2": list(self.acceleration),
            "duration_s": self.duration if math.isfinite(self.duration) else None,
        }


def _vector(given: Any, sensor: Sensor, name: str, along: int) -> tuple[float, float, float]:
    """Three components in SI from three numbers or one, along this axis, or a text of these with a unit."""
    si, factor, numbers = SI[sensor]["rate"], 1.0, given
    try:
        if isinstance(given, str):
            *others, last = given.split(",")
            number, unit = parse_quantity(last) or (math.nan, si)
            numbers, factor = [*map(float, others), number], convert(1.0, unit, si, sensor)
        values = factor * np.atleast_1d(np.asarray(numbers, float))
    except AllanjaxError:
        raise
    except (TypeError, ValueError):
        values = np.full(1, np.nan)
    if values.shape not in ((1,), (3,)) or not np.isfinite(values).all():
        raise AllanjaxError(
            f"{name}: cannot read {given!r}; give one number or three, in {si}, or a text with a unit, "
            f"such as '1 {si}' or '0, 0, 1 {si}'"
        )
    x, y, z = values if len(values) == 3 else values[0] * np.eye(3)[along]
    return float(x), float(y), float(z)


class AxisErrors(NamedTuple):
    """Errors that remain in an axis: causes, second moments [SI], inputs at rest and, besides, in motion."""

    causes: tuple[str, ...]
    moment: Float[np.ndarray, "p p"]
    resting: Float[np.ndarray, " p"]
    moving: Float[np.ndarray, " p"]

    def variances(
        self, always: Float[np.ndarray, "orders t"], during: Float[np.ndarray, "orders t"]
    ) -> tuple[dict[str, Any], Float[np.ndarray, "orders t"]]:
        """Variances of the navigator's errors by cause, each alone, and of all together.

        "bias" is the error of the readings at rest, with what gravity makes of the other causes.

        Args:
            always: response to a unit input that lasts.
            during: response to a unit input that lasts as long as the motion.
        """
        resting, moving = self.resting[:, None, None] * always, self.moving[:, None, None] * during
        parts = {"bias": resting}
        for cause in dict.fromkeys(self.causes[1:]):
            parts[cause] = np.array([own == cause for own in self.causes])[:, None, None] * moving
        alone = {cause: _quadratic(self.moment, part) for cause, part in parts.items()}
        return alone, _quadratic(self.moment, resting + moving)


class Remaining(NamedTuple):
    """Errors that a calibration leaves, by sensor and direction of the axis, in a motion so long [s]."""

    axes: Mapping[tuple[Sensor, str], AxisErrors]
    notes: tuple[str, ...] = ()
    duration: float = math.inf


def _quadratic(
    moment: Float[np.ndarray, "p p"], x: Float[np.ndarray, "p orders t"]
) -> Float[np.ndarray, "orders t"]:
    """The quadratic form x'·moment·x, which rounding must not make negative."""
    return np.maximum(np.einsum("iot,ij,jot->ot", x, moment, x), 0.0)


def remaining(
    calibration: Calibration, profile: Profile, gravity: float, corrected: bool, rested: bool
) -> Remaining:
    """What a calibration leaves of the errors of each axis, for the inputs of a level craft in motion.

    Args:
        calibration: the calibration.
        profile: the motion.
        gravity: gravity [m/s²], along −z, as z points down.
        corrected: whether the samples are corrected; else the errors themselves count, too.
        rested: whether means at rest have replaced the biases, and what gravity adds to them.
    """
    found: dict[tuple[Sensor, str], AxisErrors] = {}
    notes = []
    for axis in calibration.results:
        rest = np.array([0.0, 0.0, -gravity]) if axis.axis.sensor == "accel" else np.zeros(3)
        motion = profile.acceleration if axis.axis.sensor == "accel" else profile.turn_rate
        resting = _inputs(axis, rest)
        moving = _inputs(axis, rest + np.array(motion)) - resting
        resting = resting * (not rested)
        coefficients = axis.coefficients.values()
        unknown = [
            c.label.replace("_", " ")
            for c, *inputs in zip(coefficients, resting, moving, strict=True)
            if math.isnan(c.value) and any(inputs)
        ]
        if unknown:
            notes.append(f"{axis.axis.name}: not included, as the calibration lacks it: {', '.join(unknown)}")
        # Errors that are not known well enough to be corrected stay, with all that is known of them.
        own = [0.0 if corrected and calibration.corrects(c) else c.value for c in coefficients]
        moment = np.nan_to_num(axis.covariance + np.outer(own, own))
        causes = tuple(re.sub("_[xyz]$", "", c.label).replace("_", " ") for c in coefficients)
        own_axis = axis.axis.sensor, "xyz"[place_of(axis.axis)]
        found[own_axis] = AxisErrors(causes, moment, resting, moving)
    return Remaining(found, tuple(notes), profile.duration)


def _inputs(axis: AxisCalibration, f: Float[np.ndarray, 3]) -> Float[np.ndarray, " p"]:
    """What each error of an axis is multiplied by at these inputs (2.22, 2.23)."""
    own = f[place_of(axis.axis)]
    known = {"bias": 1.0, "scale_factor": own, "second_order": own**2}
    known |= {f"misalignment_{letter}": x for letter, x in zip("xyz", f, strict=True)}
    return np.array([known[label] for label in axis.coefficients])

"""A simple motion, and what a calibration leaves of the errors that act in it."""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Float

from allanjax.base.equality import ByValue
from allanjax.base.errors import AllanjaxError
from allanjax.base.wording import duration, plain
from allanjax.calibration.result import AxisCalibration, Calibration, place_of
from allanjax.navigation.likely import in_si
from allanjax.record.units import SI, Sensor, convert, parse_quantity


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
        in_units: dict[str, Any] = {
            "turn_rate": _vector(self.turn_rate, "gyro", "turn_rate (--turn-rate)", 2),
            "acceleration": _vector(self.acceleration, "accel", "acceleration (--acceleration)", 0),
        }
        if (given := self.duration) != math.inf:
            in_units["duration"] = in_si(given, "s", "the duration of a profile (--for)")
        for name, value in in_units.items():
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

    def to_dict(self) -> dict[str, Any]:
        """The motion as plain dictionaries and lists, in SI; None for a duration without end."""
        return {
            "turn_rate_rad_s": list(self.turn_rate),
            "acceleration_m_s2": list(self.acceleration),
            "duration_s": self.duration if math.isfinite(self.duration) else None,
        }


def _vector(given: Any, sensor: Sensor, name: str, along: int) -> tuple[float, float, float]:
    """Three components in SI from three numbers or one, along this axis, or a text of these with a unit."""
    si, numbers = SI[sensor]["rate"], given
    try:
        if isinstance(given, str):
            *others, last = given.split(",")
            number, unit = parse_quantity(last) or (math.nan, si)
            numbers = convert(np.array([*others, number], float), unit, si, sensor)
        values = np.atleast_1d(np.asarray(numbers, float))
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
    """Errors of an axis besides its noise, the first of which is the bias.

    Attributes:
        causes: their names.
        moment: their second moments [SI].
        resting, moving: what each is multiplied by at rest, and what motion adds to that.
        duration: how long the motion lasts [s].
    """

    causes: tuple[str, ...] = ("bias",)
    moment: Float[np.ndarray, "p p"] = np.zeros((1, 1))
    resting: Float[np.ndarray, " p"] = np.ones(1)
    moving: Float[np.ndarray, " p"] = np.zeros(1)
    duration: float = math.inf

    def with_bias(self, std: float) -> AxisErrors:
        """With an independent part of the bias."""
        moment = self.moment.copy()
        moment[0, 0] += std**2
        return self._replace(moment=moment)

    def variances(
        self, response: Callable[[float], Float[np.ndarray, " t"]]
    ) -> tuple[dict[str, Float[np.ndarray, " t"]], Float[np.ndarray, " t"]]:
        """Variances of a navigator's error by cause, each alone, and of all together.

        "bias" is the error of the readings at rest, with what gravity makes of the other causes. `response`
        is the navigator's error for a unit input that lasts so many seconds.
        """
        resting = np.outer(self.resting, response(math.inf))
        moving = np.outer(self.moving, response(self.duration))
        parts = {"bias": resting}
        for cause in dict.fromkeys(self.causes[1:]):
            parts[cause] = moving * (np.array(self.causes) == cause)[:, None]

        def variance(x: Float[np.ndarray, "p t"]) -> Float[np.ndarray, " t"]:
            # Rounding must not make it negative.
            return np.maximum(np.einsum("it,ij,jt->t", x, self.moment, x), 0.0)

        return {cause: variance(part) for cause, part in parts.items()}, variance(resting + moving)


#: Errors of axes by sensor and direction.
AllErrors: TypeAlias = dict[tuple[Sensor, str], AxisErrors]


def remaining(
    calibration: Calibration, profile: Profile, gravity: float, corrected: bool, rested: bool
) -> tuple[AllErrors, list[str]]:
    """What a calibration leaves of the errors of each axis of a level craft in motion, and notes.

    Args:
        calibration: the calibration.
        profile: the motion.
        gravity: gravity [m/s²], along −z, as z points down.
        corrected: whether the samples are corrected; else the errors themselves count, too.
        rested: whether means at rest have replaced the biases, and what gravity adds to them.
    """
    found: AllErrors = {}
    notes = []
    for axis in calibration.results:
        accel = axis.axis.sensor == "accel"
        rest = np.array([0.0, 0.0, -gravity * accel])
        resting = _inputs(axis, rest)
        moving = _inputs(axis, rest + (profile.acceleration if accel else profile.turn_rate)) - resting
        # Errors that are not known well enough to be corrected stay, with all that is known of them.
        cs = axis.coefficients.values()
        left = [0.0 if corrected and calibration.corrects(c) else c.value for c in cs]
        moment = np.nan_to_num(axis.covariance + np.outer(left, left))
        acting = moving != 0.0
        if rested:
            resting = np.eye(len(cs))[0]
            moment[0] = moment[:, 0] = 0.0
        else:
            acting |= resting != 0.0
        names = [c.label.replace("_", " ") for c in cs]
        unknown = [names[k] for k, c in enumerate(cs) if acting[k] and math.isnan(c.value)]
        if unknown:
            notes.append(f"{axis.axis.name}: not included, as the calibration lacks it: {', '.join(unknown)}")
        causes = tuple(re.sub(" [xyz]$", "", name) for name in names)
        own = axis.axis.sensor, "xyz"[place_of(axis.axis)]
        found[own] = AxisErrors(causes, moment, resting, moving, profile.duration)
    return found, notes


def _inputs(axis: AxisCalibration, f: Float[np.ndarray, 3]) -> Float[np.ndarray, " p"]:
    """What each error of an axis is multiplied by at these inputs (2.22, 2.23)."""
    own = f[place_of(axis.axis)]
    known = {"bias": 1.0, "scale_factor": own, "second_order": own**2}
    known |= {f"misalignment_{letter}": x for letter, x in zip("xyz", f, strict=True)}
    return np.array([known[label] for label in axis.coefficients])

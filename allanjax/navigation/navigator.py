"""Growth of a navigator's attitude, velocity and position errors: at rest, and in a simple motion.

At rest they are those of the whole noise model; in motion also those that a calibration leaves.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import os
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, TypeAlias, get_args

import numpy as np
from jaxtyping import Float, Int

from allanjax.base.earth import EARTH_RADIUS, STANDARD_GRAVITY
from allanjax.base.equality import ByValue
from allanjax.base.errors import AllanjaxError
from allanjax.base.late import presented
from allanjax.base.tables import Column, Tabled, columns_from
from allanjax.base.wording import duration, format_range, plain, significant
from allanjax.calibration.result import AxisCalibration, Calibration, place_of
from allanjax.estimate.as_json import in_json
from allanjax.navigation.likely import Drawn, NoiseLike, Sensors, biases_of, in_si, sensors_of, together
from allanjax.noise.model import Model
from allanjax.record.units import SI, Sensor, convert, parse_quantity

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

#: Errors of a navigator.
Quantity = Literal["attitude", "velocity", "position"]
#: Units in which errors are computed, and those in which they are shown, with their size in SI.
UNITS: dict[str, str] = {"attitude": "rad", "velocity": "m/s", "position": "m"}
SHOWN: dict[str, tuple[str, float]] = {
    "attitude": ("deg", math.pi / 180.0),
    "velocity": ("m/s", 1.0),
    "position": ("m", 1.0),
}


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


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class ErrorGrowth(ByValue):
    """Standard deviation of an error over time, in each direction.

    Attributes:
        quantity: "attitude" (about the direction), "velocity" or "position" (along it).
        channels: the directions, of "north", "east" and "down".
        time: times [s] since the start.
        error: standard deviation [rad, m/s or m].
        lower, upper: ends of its 95 % interval; nan for models that are taken as exact.
        causes: by direction, standard deviations of the error from each cause alone. Those of a calibration
            may be correlated; the squares of all others add up to that of the error.
        bounds: the directions in which the error is at least this, as a sensor is missing or its N, B or K is
            not given (see the notes).
    """

    quantity: Quantity
    channels: tuple[str, ...]
    time: Float[np.ndarray, " t"]
    error: Float[np.ndarray, "channels t"]
    lower: Float[np.ndarray, "channels t"]
    upper: Float[np.ndarray, "channels t"]
    causes: Mapping[str, Mapping[str, Float[np.ndarray, " t"]]]
    bounds: tuple[str, ...] = ()

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
            raise AllanjaxError(f"no {self.quantity} error {channel!r}; there are {', '.join(self.channels)}")
        return self.error[self.channels.index(channel)]

    def __repr__(self) -> str:
        unit, scale = SHOWN[self.quantity]
        last = (f"{c} {self._shown(c, float(self.of(c)[-1]) / scale)} {unit}" for c in self.channels)
        return f"<ErrorGrowth {self.quantity} after {plain(float(self.time[-1]), 4)} s: {', '.join(last)}>"

    def _shown(self, channel: str, error: float) -> str:
        """An error, with a sign if it is a lower bound."""
        return f"{'≥ ' if channel in self.bounds else ''}{significant(error)}"

    def largest(self, channel: str) -> list[str]:
        """The largest cause at each time."""
        causes = self.causes[channel]
        names = list(causes)
        return [names[k] for k in np.argmax(np.stack(list(causes.values())), axis=0)]

    def to_dataframe(self) -> pd.DataFrame:
        """One row per direction and time, in SI."""
        import pandas as pd

        tables = []
        for channel, numbers in self._numbers().items():
            columns = {"quantity": self.quantity, "channel": channel, "time": self.time, **numbers}
            columns |= {"unit": self.unit, "largest cause": self.largest(channel)}
            columns["is_bound"] = channel in self.bounds
            tables.append(pd.DataFrame(columns))
        return pd.concat(tables, ignore_index=True)

    def to_dict(self) -> dict[str, Any]:
        """The numbers as plain dictionaries and lists, in SI; None for the ends of missing intervals."""
        channels = {
            c: numbers | {"is_bound": c in self.bounds, "causes": self.causes[c]}
            for c, numbers in self._numbers().items()
        }
        return {"unit": self.unit, "channels": in_json(channels)}

    def _numbers(self) -> dict[str, dict[str, Any]]:
        """Errors with their intervals by direction."""
        names = ("error", "lower_95", "upper_95")
        each = zip(self.channels, self.error, self.lower, self.upper, strict=True)
        return {channel: dict(zip(names, numbers, strict=True)) for channel, *numbers in each}

    def columns(self, at: Sequence[int]) -> list[Column]:
        """Columns of the printed table, with rows at these indices of the times."""
        unit, scale = SHOWN[self.quantity]
        cells = []
        for channel, numbers in self._numbers().items():
            largest = self.largest(channel)
            for j in at:
                error, *ends = (x[j] / scale for x in numbers.values())
                cause = self.causes[channel][largest[j]][j] / scale
                share = (cause / error) ** 2 if error > 0.0 else 1.0
                interval = format_range(*ends) if np.isfinite(ends[1]) else ""
                texts = (plain(self.time[j], 4), self._shown(channel, error), interval)
                most = "" if channel in self.bounds else f"{100.0 * share:.0f}"
                cells.append((f"{self.quantity} {channel}", *texts, largest[j], most))
        heads = ("error", "after (s)", f"1σ ({unit})", f"95 % interval ({unit})", "largest cause")
        return columns_from((*heads, "share (%)"), cells)


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Navigation(ByValue, Tabled, Mapping[str, ErrorGrowth]):
    """Growth of a resting navigator's errors: `result["position"].of("north")`.

    Attributes:
        name: the recording's name.
        rate: sample rate [Hz].
        at_rest: time at rest [s] over which the biases were averaged.
        gravity: gravity of the Earth [m/s²].
        schuler: whether the Schuler loop is included; without it the errors hold for short times only.
        growths: growth of attitude, velocity and position errors, as far as there are sensors for them.
        notes: limitations of the result.
        calibrated: whose errors of scale and mounting are included: of a sensor that is "corrected" by a
            calibration or "uncorrected"; "" for none.
        profile: the motion; None at rest.
    """

    name: str
    rate: float
    at_rest: float
    gravity: float
    schuler: bool
    growths: tuple[ErrorGrowth, ...]
    notes: tuple[str, ...] = ()
    calibrated: str = ""
    profile: Profile | None = None

    @property
    def quarter_period(self) -> float:
        """A quarter of the Schuler period 2π√(R/g) [s], up to which the short-term errors hold."""
        return math.pi / 2.0 * math.sqrt(EARTH_RADIUS / self.gravity)

    def __getitem__(self, quantity: str) -> ErrorGrowth:
        """The growth of "attitude", "velocity" or "position"."""
        for growth in self.growths:
            if growth.quantity == quantity:
                return growth
        raise AllanjaxError(f"no errors of {quantity!r}; there are errors of {', '.join(self)}")

    def __iter__(self) -> Iterator[str]:
        return iter([growth.quantity for growth in self.growths])

    def __len__(self) -> int:
        return len(self.growths)

    def to_dataframe(self) -> pd.DataFrame:
        """One row per quantity, direction and time, in SI."""
        import pandas as pd

        return pd.concat([growth.to_dataframe() for growth in self.growths], ignore_index=True)

    def to_dict(self) -> dict[str, Any]:
        """The result as plain dictionaries, lists and numbers, in SI."""
        return {
            "name": self.name,
            "rate_hz": self.rate,
            "at_rest_s": self.at_rest,
            "calibration": self.calibrated or None,
            "profile": self.profile and self.profile.to_dict(),
            "gravity_m_s2": self.gravity,
            "schuler": self.schuler,
            "time_s": [float(t) for t in self.growths[0].time],
            "errors": {growth.quantity: growth.to_dict() for growth in self.growths},
            "notes": list(self.notes),
        }

    @presented
    def plot(self, path: str | os.PathLike[str] | None = None) -> Figure:
        """Draw the errors and their causes against time, one panel per quantity and direction."""
        raise NotImplementedError

    def _title(self) -> str:
        loop = "with the Schuler loop" if self.schuler else "short-term"
        moving = self.profile.describe() if self.profile else "at rest"
        sensors = f", {self.calibrated} sensors" if self.calibrated else ""
        return f"errors of a navigator {moving}, {loop}{sensors}, after {duration(self.at_rest)} at rest"

    def _tables(self) -> list[list[Column]]:
        time = self.growths[0].time
        # The times nearest to powers of ten, and the end.
        decades = np.arange(math.ceil(math.log10(time[0])), math.log10(time[-1]))
        near = {int(np.argmin(np.abs(np.log10(time) - decade))) for decade in decades}
        at = sorted(near | {len(time) - 1}) if len(time) > 6 else list(range(len(time)))
        return [growth.columns(at) for growth in self.growths]

    def _notes(self) -> list[str]:
        return [f"note: {note}" for note in self.notes]


# Variance of the errors of a navigator at rest that integrates the noise of one sensor.
#
# A level navigator that is started without error integrates a constant error once (attitude from a gyro,
# velocity from an accelerometer), twice (position from an accelerometer; velocity from a gyro, times g) or
# three times (position from a gyro, times g): W(t) = t, t²/2, t³/6 (Hou 2004, 2.38–2.40). With the Schuler
# loop, ω² = g/R, it is sin(ωt)/ω, (1 − cos ωt)/ω², (ωt − sin ωt)/ω³; the vertical channel has −2g/R in the
# place of ω², and grows exponentially.
#
# That response to a bias is all that the errors need. The mean ε_k of the sensor's error over a sample
# interval h acts from its beginning to its end, and the bias was taken to be the mean over a duration C at
# rest before the start. With the phase θ, the integral of the error,
#
#     e(t) = Σ_k [W(t − kh) − W(t − kh − h)]/h · [θ(kh + h) − θ(kh)] − W(t)·[θ(0) − θ(−C)]/C,
#
# a sum of phases whose weights annihilate constants and lines, so that its variance is the sum of products of
# weights with the phase covariance G (`noise.process`), exactly, for any noise.

# Phase angle ωt below which the sine is taken by its series, and how many terms of it.
_SMALL, _TERMS = 1.0, 9


def bias_response(
    time: Float[np.ndarray, " t"], order: int, stiffness: float = 0.0
) -> Float[np.ndarray, " t"]:
    """Error W(t) [s^order] at times [s] from a constant unit error that is integrated `order` times.

    `stiffness` [1/s²] is ω² of the loop: 0 without it, g/R of Schuler's, −2g/R of the vertical channel.
    """
    x = stiffness * time**2
    series = np.zeros_like(time)
    for k in range(_TERMS, -1, -1):
        series = series * np.where(np.abs(x) < _SMALL, -x, 0.0) + 1.0 / math.factorial(2 * k + order)
    if np.all(np.abs(x) < _SMALL):
        return series * time**order
    # Imaginary along the vertical, where the sine is a hyperbolic one.
    w = np.emath.sqrt(stiffness)
    once = (np.sin(w * time) / w).real
    far = (once, (1.0 - np.cos(w * time).real) / stiffness, (time - once) / stiffness)
    return np.where(np.abs(x) < _SMALL, series * time**order, far[order - 1])


class ErrorVariances:
    """Variances of errors for the noise of any axis, whose common part is computed once."""

    def __init__(
        self, orders: int, steps: Int[np.ndarray, " t"], before: int, rate: float, stiffness: float = 0.0
    ) -> None:
        """Prepare the errors.

        Args:
            orders: how many times they are integrated at most: 1, 2 or 3.
            steps: numbers of samples since the start.
            before: number of samples before it over which the bias was averaged.
            rate: sample rate [Hz].
            stiffness: see `bias_response`.
        """
        self._time, self._rate, self._stiffness = steps / rate, rate, stiffness
        self._coefficients = [
            [_coefficients(order, int(n), before, rate, stiffness) for n in steps]
            for order in range(1, orders + 1)
        ]
        whole = np.arange(steps.max() + 1)
        self._lags = np.concatenate([whole, whole + before]) / rate
        # Axes and sets of terms share terms.
        self.of_term = functools.cache(self._of_term)

    def of_input(self, order: int, seconds: float) -> Float[np.ndarray, " t"]:
        """Errors after the steps from a unit input that ends after so many seconds."""
        after = np.maximum(self._time - seconds, 0.0)
        whole, rest = (bias_response(t, order, self._stiffness) for t in (self._time, after))
        return whole - rest

    def _of_term(self, one: Model) -> Float[np.ndarray, "orders t"]:
        """Variances for a model of one term."""
        # One call, since G is known up to c0 + c1·t², which each call may choose.
        near, far = np.split(np.asarray(one.sampled(self._rate).phase_covariance(self._lags)), 2)
        # Not `@`: BLAS would start threads for each of many short products.
        sums = [
            [np.einsum("i,i", a, near[: len(a)]) + np.einsum("i,i", b, far[: len(b)]) for a, b in row]
            for row in self._coefficients
        ]
        return np.maximum(np.array(sums), 0.0)


def _coefficients(
    order: int, n: int, before: int, rate: float, stiffness: float
) -> tuple[Float[np.ndarray, " lags"], Float[np.ndarray, " lags"]]:
    """Factors of G in the variance of the error after n samples.

    The first are those at lags among phases since the start, the second at lags to the first sample at rest.
    """
    response = bias_response(np.arange(n + 1) / rate, order, stiffness)
    of_samples = np.diff(response)[::-1] * rate
    weights = -np.diff(of_samples, prepend=0.0, append=0.0)
    bias = response[-1] * rate / before
    weights[0] -= bias
    size = 2 ** math.ceil(math.log2(2 * n + 2))
    products = np.fft.irfft(np.abs(np.fft.rfft(weights, size)) ** 2, size)[: n + 1]
    products[1:] *= 2.0
    products[0] += bias**2
    return products, 2.0 * bias * weights


# Turn beyond which the directions of errors are not those at its start [rad].
_SHORT_TURN = math.radians(30.0)
# Most samples from the start to the last time: their covariances are held in memory.
_MOST = 2**21


# Directions of errors, the sensors' axis along each, and the gyro's axis that tilts gravity into it.
_CHANNELS = (("north", "x", "y"), ("east", "y", "x"), ("down", "z", None))


def navigate(
    data: NoiseLike,
    times: Sequence[float] | None = None,
    *,
    rate: float | None = None,
    at_rest: float | None = None,
    calibration: Calibration | None = None,
    corrected: bool = True,
    profile: Profile | None = None,
    gyro_bias: float | str = 0.0,
    accel_bias: float | str = 0.0,
    gravity: float = STANDARD_GRAVITY,
    schuler: bool = False,
    seed: int = 0,
) -> Navigation:
    """Growth of the errors of a level strapdown navigator at rest, from all terms of its sensors' noise.

    The navigator has been at rest for `at_rest` seconds and has taken the means of its sensors as their
    biases (an accelerometer's by leveling, 2.45, which cancels it). Then it is on its own, with x pointing
    north and z down. A gyro's error tilts it, so that it takes a part of gravity for motion, and the errors
    of the accelerometers are integrated, too (2.38–2.40). All terms count, including lines, ramps and terms
    behind a response. Not included are the coupling by the Earth's rotation and transients, which happen once
    and are not noise.

    With a `calibration` the navigator starts with its biases instead, and what it leaves of bias, scale
    factor and misalignment counts, too: its covariance, and the errors themselves that it cannot correct. A
    scale factor acts as a bias in proportion to the input (2.41, 2.42), a misalignment in proportion to the
    input along another axis. Inputs are gravity and the `profile`. Directions are those of the sensor's axes,
    as if a turn were short; one of more than some 30 deg spreads the errors from misalignment over both level
    directions, in which together they are then smaller than given.

    Args:
        data: what `fit` or `load` returned, with intervals from the uncertainty of the coefficients and, if
            the data do not distinguish sets of terms, an average over the likely ones and intervals that
            hold for each of them; a posterior, with intervals from its draws; or a data sheet or models by
            the names of axes, taken as exact.
        times: times of the errors [s]; by default from 1 s to 1,000 s.
        rate: sample rate [Hz] of models; for a data sheet 100 Hz by default.
        at_rest: time at rest [s] over which the biases were averaged: before the start, by default 600 s; or
            during the calibration, if there is one, whose covariance then counts their noise a second time.
            If both are given, the means at rest replace the biases of the calibration, and with them what
            gravity makes of its other errors.
        calibration: what `calibrate` or `load_calibration` returned, of the same sensor.
        corrected: whether the samples are corrected by the calibration; else its errors count as they are.
        profile: turn and acceleration at the start; needs a calibration.
        gyro_bias, accel_bias: standard deviation of biases that the calibration leaves besides noise, e.g.
            from turn-on to turn-on if it was done earlier; rad/s and m/s², or a text such as "0.2 deg/h".
        gravity: gravity of the Earth [m/s²].
        schuler: whether gravity corrects horizontal errors, with the Schuler period of 84 min, and drives the
            vertical one; without it the errors hold up to a quarter of that period.
        seed: seed of the draws of the coefficients.

    Raises:
        FitError: no axis has a measurement.
        AllanjaxError, UnitError: a time, rate or bias is out of range or cannot be read; no axis can be used;
            more than two million samples; a model without terms or values.
    """
    sensors, biases = sensors_of(data, rate, seed), biases_of(gyro_bias, accel_bias)
    if not 0.0 < gravity < np.inf:
        raise AllanjaxError(f"gravity must be positive and finite, not {gravity}")
    given = np.geomspace(1.0, 1000.0, 19) if times is None else np.unique(np.asarray(times, float))
    left: AllErrors = {}
    notes, used, before = [*sensors.notes], "", 600.0
    if isinstance(calibration, Calibration):
        left, lacking = remaining(calibration, profile or Profile(), gravity, corrected, at_rest is not None)
        used = "corrected" if corrected else "uncorrected"
        before = sum(p.duration for p in calibration.positions)
        notes += [*lacking, *_without(sensors, left)]
    elif calibration is not None:
        raise AllanjaxError("calibration= is what calibrate returned; for the time at rest pass at_rest=")
    elif profile is not None:
        raise AllanjaxError("profile= needs the errors that act in motion: pass calibration= (--calibration)")
    samples = _whole_samples(given, before if at_rest is None else at_rest, sensors.rate)
    variances = _variances(sensors, samples, biases, gravity, schuler, left)
    if not any(variances.values()):
        raise AllanjaxError(
            f"no axis can be used; use names such as gyro_x or accel_z, not {', '.join(sensors.axes)}"
        )
    time, rested = samples[0] / sensors.rate, samples[1] / sensors.rate
    growths = tuple(_growth(q, of, time, sensors) for q, of in variances.items() if of)
    shared = (sensors.name, sensors.rate, rested, float(gravity), schuler, growths)
    result = Navigation(*shared, calibrated=used, profile=profile)
    return dataclasses.replace(result, notes=(*notes, *_notes(result, sensors)))


def _variances(
    sensors: Sensors,
    samples: tuple[Int[np.ndarray, " t"], int],
    biases: Mapping[Sensor, float],
    gravity: float,
    schuler: bool,
    left: AllErrors,
) -> dict[str, dict[str, Drawn]]:
    """Variances of the errors by quantity and direction, from all sensors that contribute."""
    stiffness = gravity / EARTH_RADIUS if schuler else 0.0
    level = ErrorVariances(3, *samples, sensors.rate, stiffness)
    # Along the vertical gravity drives errors, and about it nothing does.
    vertical = about = level
    if schuler:
        vertical = ErrorVariances(2, *samples, sensors.rate, -2.0 * stiffness)
        about = ErrorVariances(1, *samples, sensors.rate)

    def error(
        sensor: Sensor, letter: str | None, order: int, of: ErrorVariances, factor: float = 1.0
    ) -> list[Drawn]:
        """Variance of an axis's error after so many integrations; none without the axis."""
        noise = sensors.along(sensor, letter) if letter else None
        if noise is None or letter is None:
            return []
        errors = left.get((sensor, letter), AxisErrors()).with_bias(biases[sensor])
        alone, all_of_them = errors.variances(lambda seconds: factor * of.of_input(order, seconds))
        causes = {f"{noise.axis.name} {cause}": part for cause, part in alone.items()}
        return [noise.drawn(lambda term: factor**2 * of.of_term(term)[order - 1]).plus(causes, all_of_them)]

    variances: dict[str, dict[str, Drawn]] = {name: {} for name in get_args(Quantity)}
    for channel, along, tilting in _CHANNELS:
        turned, forced = (level, level) if tilting else (about, vertical)
        for quantity, parts in {
            "attitude": error("gyro", along, 1, turned),
            "velocity": error("accel", along, 1, forced) + error("gyro", tilting, 2, level, gravity),
            "position": error("accel", along, 2, forced) + error("gyro", tilting, 3, level, gravity),
        }.items():
            if parts:
                found = together(parts)
                lacks = tilting is not None and quantity != "attitude" and len(parts) < 2
                variances[quantity][channel] = found._replace(is_bound=found.is_bound or lacks)
    return variances


def _whole_samples(times: Float[np.ndarray, " t"], at_rest: float, rate: float) -> tuple[np.ndarray, int]:
    """Times and time at rest in samples; AllanjaxError if there is less than one, or too many."""
    for name, values in (("times", times), ("at_rest", np.array([float(at_rest)]))):
        if not (values.size and np.all(np.isfinite(values)) and np.all(values * rate >= 0.5)):
            raise AllanjaxError(f"{name} must be finite and at least one sample interval, {1 / rate:g} s")
    if times.max() * rate > _MOST:
        raise AllanjaxError(f"times must be at most {_MOST / rate:.0f} s at {rate:g} Hz, not {times.max():g}")
    return np.unique(np.rint(times * rate).astype(int)), round(at_rest * rate)


def _growth(
    quantity: Any, drawn: Mapping[str, Drawn], time: Float[np.ndarray, " t"], sensors: Sensors
) -> ErrorGrowth:
    lower, upper = np.sqrt(np.array([sensors.ends(own) for own in drawn.values()])).swapaxes(0, 1)
    return ErrorGrowth(
        quantity=quantity,
        channels=tuple(drawn),
        time=time,
        error=np.sqrt([own.total for own in drawn.values()]),
        lower=lower,
        upper=upper,
        causes={
            channel: {title: np.sqrt(part) for title, part in own.mean.items()}
            for channel, own in drawn.items()
        },
        bounds=tuple(channel for channel, own in drawn.items() if own.is_bound),
    )


def _without(sensors: Sensors, left: AllErrors) -> list[str]:
    """Note on axes with noise that a calibration lacks; AllanjaxError if it lacks all."""
    axes = [noise.axis for noise in sensors.axes.values()]
    lacking = [a.name for a in axes if "_" in a.name and (a.sensor, a.name[-1]) not in left]
    if len(lacking) == len(axes):
        raise AllanjaxError(
            f"the calibration has none of the axes {', '.join(lacking)}: give that of this sensor"
        )
    return [f"{', '.join(lacking)}: not calibrated, noise only"] if lacking else []


def _notes(result: Navigation, sensors: Sensors) -> Iterator[str]:
    """Limitations: sensors that are missing, and times for which the errors do not hold."""
    for channel, along, tilting in _CHANNELS:
        gyro = tilting and sensors.along("gyro", tilting)
        accel = sensors.along("accel", along)
        if tilting and (gyro is None) != (accel is None):
            only = "the accelerometer" if gyro is None else "the gyro's tilt"
            yield f"velocity and position {channel} contain the errors of {only} only"
    if any(growth.bounds for growth in result.growths):
        yield "≥: at least, as not all that the error comes from is given"
    last = float(result.growths[0].time[-1])
    if last > result.quarter_period:
        yield (
            "the vertical channel is unstable without a height sensor; the Earth's rotation is not included"
            if result.schuler
            else f"short-term errors hold up to {duration(result.quarter_period)}, a quarter of the Schuler "
            "period; for longer times pass schuler=True (--schuler)"
        )
    pairs = ((p, g.of(c)) for g in result.growths for c, of in g.causes.items() for p in of.values())
    if any((part > 1.01 * error).any() for part, error in pairs):
        yield "some errors that the calibration leaves cancel each other in part: shares exceed 100 %"
    moves = result.profile
    if moves is not None and math.hypot(*moves.turn_rate) * min(moves.duration, last) > _SHORT_TURN:
        yield (
            "the turn is long: it spreads errors from misalignment over both level directions, in which "
            "together they are smaller than given"
        )
    if last + result.at_rest > sensors.record / 2.0:
        yield (
            f"times plus time at rest exceed half the record ({duration(sensors.record / 2.0)}): the errors "
            "extrapolate the model"
        )

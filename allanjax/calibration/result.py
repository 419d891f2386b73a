"""Results of a calibration: errors of each axis, and the recording without them."""

from __future__ import annotations

import itertools
import math
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

import numpy as np
from jaxtyping import ArrayLike, Float

from allanjax.base.equality import ByValue
from allanjax.base.errors import AllanjaxError, RecordingError
from allanjax.base.late import presented
from allanjax.base.tables import Cell, Number, PerAxis
from allanjax.base.wording import chi_squared, plain, significant
from allanjax.estimate.as_json import document_in, in_json, read
from allanjax.estimate.result import AxisEstimates
from allanjax.noise.estimate import Estimate
from allanjax.record.recording import Axis, Recording
from allanjax.record.units import Sensor, unit_scale

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

_AXES = "xyz"
# An axis and its direction, as in `x up` or `imu_x-down_2`; `up` and `down` alone refer to z.
_UP = re.compile(r"(?<![a-z])(?:([xyz])[\s_-]*)?(up|down)(?![a-z])")
_NORTH = re.compile(r"(?<![a-z])([xyz])[\s_-]*(north|south|east|west)(?![a-z])")
_SIGNED = re.compile(r"([+-])([xyz])|([xyz])([+-])")
# How far a given matrix may be from a rotation, and a given direction from a unit vector.
_TOLERANCE = 1e-3


@dataclass(frozen=True, eq=False)
class Orientation(ByValue):
    """Orientation of a sensor's frame.

    Attributes:
        name: name for display, e.g. "x up".
        up: components along the sensor's axes of the unit vector that points up.
        north: components of the unit vector that points north; None if the heading is not known.
    """

    name: str
    up: Float[np.ndarray, 3]
    north: Float[np.ndarray, 3] | None = None


#: An orientation as functions take it: its name, the upward direction, or a rotation matrix.
OrientationLike: TypeAlias = Orientation | str | ArrayLike | Sequence


def as_orientation(given: OrientationLike) -> Orientation:
    """Orientation from a name, a direction or a matrix.

    Args:
        given: a name, "x up", "z down", "+x" or "x-" (the axis that points up or down), optionally with a
            heading, "x up, y north"; the upward direction, three components along the sensor's axes; or the
            matrix [3, 3] that turns such components into those along east, north and up.

    Raises:
        AllanjaxError: `given` is none of these.
    """
    if isinstance(given, Orientation):
        return given
    if isinstance(given, str):
        signed = _SIGNED.fullmatch(given.strip().lower())
        if signed is not None:
            given = f"{signed[2] or signed[3]} {'up' if '+' in given else 'down'}"
        named = orientation_in(given)
        if named is None:
            raise AllanjaxError(
                f"{given!r} is not an orientation: write 'x up', 'z down', '+x' or, with a heading, "
                "'x up, y north'; or give a direction or a matrix"
            )
        return named
    try:
        values = np.asarray(given, dtype=float)
    except (TypeError, ValueError):
        values = np.zeros(0)
    if values.shape == (3,) and abs(np.linalg.norm(values) - 1.0) < _TOLERANCE:
        up = values / np.linalg.norm(values)
        return Orientation("up " + _written(up), up)
    right_handed = values.shape == (3, 3) and np.linalg.det(values) > 0.0
    if right_handed and np.abs(values @ values.T - np.eye(3)).max() < _TOLERANCE:
        return Orientation(f"up {_written(values[2])}, north {_written(values[1])}", values[2], values[1])
    raise AllanjaxError(
        "an orientation must be a name such as 'x up', a unit vector (the components of up along x, y, z), "
        "or a rotation matrix [3, 3] from the sensor's frame to east, north, up"
    )


def orientation_in(text: str) -> Orientation | None:
    """Orientation in a text such as "x up, y north" or "imu_x_up"; None if there is none."""
    words = text.lower()
    vertical, heading = _UP.search(words), _NORTH.search(words)
    if vertical is None:
        return None
    letter, way = vertical[1] or "z", vertical[2]
    up = _along(letter, way == "up")
    if heading is None:
        return Orientation(f"{letter} {way}", up)
    other, where = heading.groups()
    if other == letter:
        raise AllanjaxError(f"{text!r}: {letter} cannot point {way} and {where}")
    north = _along(other, where in ("north", "east"))
    if where in ("east", "west"):
        # North is up × east.
        north = np.cross(up, north)
    return Orientation(f"{letter} {way}, {other} {where}", up, north)


def six_positions(with_heading: bool) -> tuple[Orientation, ...]:
    """Orientations with an axis up or down; with a heading, also with another axis north or south."""
    if not with_heading:
        return tuple(as_orientation(f"{a} {way}") for a, way in itertools.product(_AXES, ("up", "down")))
    every = itertools.product(itertools.permutations(_AXES, 2), ("up", "down"), ("north", "south"))
    return tuple(as_orientation(f"{a} {way}, {b} {where}") for (a, b), way, where in every)


def _along(letter: str, forwards: bool) -> Float[np.ndarray, 3]:
    """Unit vector along this axis or against it."""
    vector = np.eye(3)[_AXES.index(letter)]
    return vector if forwards else 0.0 - vector


def _written(vector: Float[np.ndarray, 3]) -> str:
    return "(" + ", ".join(f"{plain(x + 0.0, 3)}" for x in vector) + ")"


SCHEMA_VERSION = 1
# What a file of a calibration is, and the numbers of a parameter in it.
_WANTED = "a calibration.json of allanjax calibrate"
_NUMBERS = ("value", "std", "lower_95", "upper_95", "lower_68", "upper_68")
# Keys of a parameter in JSON.
_ROW = (
    *("axis", "parameter", "value", "std", "lower_68", "upper_68", "lower_95", "upper_95", "unit"),
    *("over_white_noise", "remark"),
)
#: Labels of the parameters of an axis, in the order of the printed table.
PARAMETERS = ("bias", "scale_factor", *(f"misalignment_{letter}" for letter in _AXES), "second_order")
#: Usual units of these parameters; "" if this sensor has no such parameter.
UNITS: dict[Sensor, dict[str, str]] = {
    "gyro": dict(zip(PARAMETERS, ("deg/h", "%", "mrad", "mrad", "mrad", ""), strict=True)),
    "accel": dict(zip(PARAMETERS, ("mg", "ppm", "µrad", "µrad", "µrad", "µg/g²"), strict=True)),
}
#: Scale factors and misalignments with a larger standard deviation are not used, as uncalibrated sensors are
#: more accurate than that.
USEFUL = 0.01


@dataclass(frozen=True, eq=False)
class Position(ByValue):
    """A recording at rest in one orientation.

    Attributes:
        name: name of the recording.
        orientation: the orientation; None if it is unknown.
        start: start of the recording [s after that of the first].
        duration: length of the recording [s].
        gravity: local gravity [m/s²].
    """

    name: str
    orientation: Orientation | None
    start: float
    duration: float
    gravity: float

    @property
    def label(self) -> str:
        """Orientation, or name, for display."""
        return self.name if self.orientation is None else self.orientation.name

    def to_dict(self) -> dict[str, Any]:
        """The position as a plain dictionary; None for unknown directions."""
        name, up, north = (getattr(self.orientation, key, None) for key in ("name", "up", "north"))
        return {
            "name": self.name,
            "orientation": name,
            "up": in_json(up),
            "north": in_json(north),
            "start_s": self.start,
            "duration_s": self.duration,
            "gravity_m_s2": self.gravity,
        }


@dataclass(frozen=True, eq=False, repr=False)
class AxisCalibration(ByValue, AxisEstimates):
    """Errors of one axis: I = f + b + S·f + N·f + S2·f² + e (2.22, 2.23).

    Attributes:
        axis: the axis.
        coefficients: "bias" [mg or deg/h], "scale_factor" [ppm, for gyros %], "misalignment_x" to "_z", the
            response to inputs along another axis [µrad, for gyros mrad], and, if requested, "second_order"
            [µg/g²]. A value that the positions do not determine is nan; its remark names the positions that
            would determine it.
        widening: ratio of each standard deviation to that for white noise alone; nan without white noise.
        covariance: covariance of the coefficients in their order, SI; nan for what is not determined.
    """

    axis: Axis
    coefficients: Mapping[str, Estimate]
    widening: Mapping[str, float]
    covariance: Float[np.ndarray, "p p"]

    @property
    def verdict(self) -> str:
        """How much wider intervals are than those for white noise alone; "" if they are not."""
        wider = significant(max((x for x in self.widening.values() if np.isfinite(x)), default=1.0))
        return "" if wider == "1.00" else f"intervals up to {wider} times as wide as for white noise alone"

    def rows(self) -> list[tuple[Cell, ...]]:
        """The row of the printed table: the parameters of the axis ± 1σ."""
        shown = {label: c.in_unit() for label, c in self.coefficients.items()}
        cells = {k: "–" if c.remark else Number(c.value, c.std) for k, c in shown.items()}
        return [(self.axis.name, *map(cells.get, PARAMETERS))]

    def to_dataframe(self) -> pd.DataFrame:
        """One row per parameter, in its usual unit."""
        import pandas as pd

        return pd.DataFrame(self.table(), columns=[key for key in _ROW if not key.endswith("68")])

    def table(self) -> list[dict[str, Any]]:
        """The parameters in their usual units, by the names of columns."""
        return [
            c.row() | {"parameter": label, "over_white_noise": self.widening[label], "remark": c.remark}
            for label, c in self.coefficients.items()
        ]


@dataclass(frozen=True, eq=False)
class Misfit(ByValue):
    """How well the means of a sensor agree with the noise model.

    Attributes:
        names: axes; a single norm if the orientations were not known.
        residuals: mean in each position less the fitted one [rad/s or m/s²]; nan for unused means.
        residual_std: standard deviation of the residuals under the noise model.
        chi2, dof, p_value: weighted squares of the residuals, degrees of freedom (means less parameters), and
            the probability of a larger χ²; nan without degrees of freedom.
        suspects: positions that fit worst, if p is below 0.1 %; several if they cannot be distinguished.
        wider: factor by which the intervals were widened for the scatter of the means.
    """

    names: tuple[str, ...]
    residuals: Float[np.ndarray, "positions names"]
    residual_std: Float[np.ndarray, "positions names"]
    chi2: float
    dof: int
    p_value: float
    suspects: tuple[str, ...]
    wider: float = 1.0

    def __str__(self) -> str:
        if not self.dof:
            return "there are as many parameters as means, so that the fit cannot be checked; add positions"
        text = chi_squared(self.chi2, self.dof, self.p_value)
        if not self.suspects:
            return text
        return (
            f"{text}: the means do not fit, worst at {' or '.join(self.suspects)}. Its orientation may be "
            "wrong by more than the noise (see orientation_error), or the noise model may lack a drift"
        )


class Triad(NamedTuple):
    """Errors of three axes: I = M·f + b + q·f² + e, by axis (2.22, 2.23)."""

    M: Float[np.ndarray, "3 3"]
    b: Float[np.ndarray, 3]
    q: Float[np.ndarray, 3]

    def inputs(self, readings: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """The inputs f that give these readings."""
        inverse = np.linalg.inv(self.M).T
        f = (readings - self.b) @ inverse
        if self.q.any():
            # Each round gains as many digits as the second-order part is small.
            for _ in range(8):
                f = (readings - self.b - self.q * f**2) @ inverse
        return f


@dataclass(frozen=True, eq=False, repr=False)
class Calibration(ByValue, PerAxis[AxisCalibration]):
    """Calibration of gyros and accelerometers from positions at rest.

    Attributes:
        results: one per axis.
        positions: the recordings, in time order.
        misfit: how well the means fit, by sensor.
        gravity, gravity_std: gravity [m/s²], the mean of the positions' if they were at several places, and
            its standard deviation, part of the scale factors' intervals.
        latitude: latitude [deg]; None if not given.
        noise: source of the noise model.
        notes: what was assumed, and what could not be done.
    """

    results: tuple[AxisCalibration, ...]
    positions: tuple[Position, ...]
    misfit: Mapping[Sensor, Misfit]
    gravity: float
    gravity_std: float
    latitude: float | None
    noise: str
    notes: tuple[str, ...] = ()

    def errors(self, sensor: Sensor) -> Triad:
        """Matrix M, biases b and second-order coefficients q, SI, of I = M·f + b + q·f², for `apply`.

        Parameters that are not determined, or not to 1 % (of gravity, for an accelerometer's bias), have the
        values of a perfect sensor.
        """
        M, b, q = np.eye(3), np.zeros(3), np.zeros(3)
        for result in (r for r in self.results if r.axis.sensor == sensor):
            i = place_of(result.axis)
            value = {label: c.value for label, c in result.coefficients.items() if self.corrects(c)}
            b[i], q[i] = value.get("bias", 0.0), value.get("second_order", 0.0)
            M[i] += [value.get(f"misalignment_{letter}", 0.0) for letter in _AXES]
            M[i, i] += value.get("scale_factor", 0.0)
        return Triad(M, b, q)

    def corrects(self, c: Estimate) -> bool:
        """Whether a parameter is known well enough to be used by `apply`."""
        most = {"bias": USEFUL * self.gravity if c.axis.sensor == "accel" else np.inf, "second_order": np.inf}
        return bool(c.std < most.get(c.label, USEFUL))

    def apply(self, recording: Recording) -> Recording:
        """The recording without these errors: its readings I become the inputs f.

        Axes that were not calibrated are unchanged.

        Raises:
            RecordingError: the recording has none of the axes, or not all axes of a sensor, which are needed
                to correct a misalignment.
        """
        values, done = recording.values.copy(), []
        for sensor in self.misfit:
            axes = [result.axis for result in self.results if result.axis.sensor == sensor]
            there = [axis.name for axis in axes if axis.name in recording.names]
            if not there:
                continue
            missing = ", ".join(axis.name for axis in axes if axis.name not in there)
            if missing:
                have = ", ".join(there)
                raise RecordingError(f"{recording.name or 'recording'} lacks {missing}; it has only {have}")
            columns = [recording.names.index(axis.name) for axis in axes]
            places = [place_of(axis) for axis in axes]
            M, b, q = self.errors(sensor)
            own = Triad(M[np.ix_(places, places)], b[places], q[places])
            values[:, columns] = own.inputs(recording.values[:, columns])
            done += there
        if not done:
            raise RecordingError(
                f"{recording.name or 'recording'} has none of the calibrated axes, {', '.join(self.axes)}"
            )
        note = f"calibrated: {', '.join(done)}"
        return replace(recording, values=values, others=(), notes=(*recording.notes, note))

    def to_dict(self) -> dict[str, Any]:
        """The calibration as plain dictionaries for JSON: estimates in usual units, matrices in SI.

        `load_calibration` restores it from a file.
        """
        rows = [row for result in self.results for row in result.table()]
        return {
            "schema_version": SCHEMA_VERSION,
            "gravity_m_s2": self.gravity,
            "gravity_std_m_s2": self.gravity_std,
            "latitude_deg": self.latitude,
            "noise": self.noise,
            "positions": [p.to_dict() for p in self.positions],
            "parameters": [in_json({key: row[key] for key in _ROW}) for row in rows],
            "axes": [in_json(r.axis) | {"covariance_si": in_json(r.covariance)} for r in self.results],
            "sensors": {
                sensor: in_json(vars(misfit) | self.errors(sensor)._asdict())
                for sensor, misfit in self.misfit.items()
            },
            "notes": list(self.notes),
        }

    @presented
    def plot(
        self, axes: Sequence[str] | str | None = None, path: str | os.PathLike[str] | None = None
    ) -> Figure:
        """Draw the residuals of each position with their scatter under the noise model."""
        raise NotImplementedError

    def _title(self) -> str:
        places = sorted({position.gravity for position in self.positions})
        g = " … ".join(f"{x:.5f}" for x in dict.fromkeys((places[0], places[-1])))
        return f"calibration from {len(self.positions)} positions, g = {g} m/s², ± 1σ"

    def _heads(self, sensor: Sensor) -> list[str]:
        return ["axis", *(f"{label.replace('_', ' ')} ({UNITS[sensor][label]})" for label in PARAMETERS)]

    def _notes(self) -> list[str]:
        # The positions that would determine the missing parameters, and the axes that lack them.
        lacking: dict[str, list[str]] = {}
        for result in self.results:
            for remark in dict.fromkeys(c.remark for c in result.coefficients.values() if c.remark):
                lacking.setdefault(remark, []).append(result.axis.name)
        lines = [f"{sensor}: {misfit}" for sensor, misfit in self.misfit.items()]
        lines += [f"{r.axis.name}: {r.verdict}" for r in self.results if r.verdict]
        lines += [f"not determined for {', '.join(axes)}: {what}" for what, axes in lacking.items()]
        return [*lines, f"noise model: {self.noise}", *(f"note: {note}" for note in self.notes)]


def place_of(axis: Axis) -> int:
    """Place of an axis among x, y, z; that of z for a single axis without a letter."""
    return max("xyz".find(axis.name[-1]), -1) % 3


def estimate(
    axis: Axis, label: str, value: float, std: float, remark: str, ends: Sequence[tuple[float, float]]
) -> Estimate:
    """A parameter with the ends of its 95 % and 68 % intervals; if it is nan, with a remark on what to do."""
    return Estimate(
        axis=axis,
        label=label,
        value=value,
        std=std,
        interval=ends[0],
        interval_68=ends[1],
        usual_unit=UNITS[axis.sensor][label],
        source="calibration",
        # Zero by convention, or by the definition of the axes.
        held=std == 0.0,
        remark=remark if math.isnan(value) else "",
    )


def load_calibration(path: str | os.PathLike[str]) -> Calibration:
    """Load a calibration from the JSON file that `allanjax calibrate` writes, or prints with `--json`.

    Raises:
        AllanjaxError: the file does not exist, holds no calibration, or is damaged or older than these files.
    """
    document = document_in(path, _WANTED)
    try:
        return read(
            Calibration,
            document,
            results=tuple(_axis(axis, document["parameters"]) for axis in document["axes"]),
            positions=tuple(map(_position, document["positions"])),
            misfit={sensor: read(Misfit, of) for sensor, of in document["sensors"].items()},
            gravity=document["gravity_m_s2"],
            gravity_std=document["gravity_std_m_s2"],
            latitude=document["latitude_deg"],
        )
    except (KeyError, TypeError, ValueError, AttributeError, IndexError) as error:
        raise AllanjaxError(
            f"{path}: not a calibration, damaged, or of an earlier allanjax ({error!r}); give {_WANTED}"
        ) from error


def _axis(of: Mapping[str, Any], rows: Sequence[Mapping[str, Any]]) -> AxisCalibration:
    axis, found, widening = read(Axis, of), {}, {}
    for row in (row for row in rows if row["axis"] == axis.name):
        label, numbers = row["parameter"], np.array([row[key] for key in _NUMBERS], float)
        value, std, *ends = (unit_scale(row["unit"]) * numbers).tolist()
        intervals = (ends[0], ends[1]), (ends[2], ends[3])
        found[label] = estimate(axis, label, value, std, row["remark"], intervals)
        widening[label] = float(np.array(row["over_white_noise"], float))
    return AxisCalibration(axis, found, widening, np.array(of["covariance_si"], float))


def _position(of: Mapping[str, Any]) -> Position:
    up, north = (None if of[key] is None else np.array(of[key], float) for key in ("up", "north"))
    orientation = None if up is None else Orientation(of["orientation"], up, north)
    return Position(of["name"], orientation, of["start_s"], of["duration_s"], of["gravity_m_s2"])

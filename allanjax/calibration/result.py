"""What a calibration found: errors of each axis, and the recording without them."""

from __future__ import annotations

import itertools
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar, TypeAlias

import numpy as np
from jaxtyping import ArrayLike, Float

from allanjax.base.equality import ByValue
from allanjax.base.errors import AllanjaxError, RecordingError
from allanjax.base.late import TextProperty, presented
from allanjax.base.per_axis import PerAxis
from allanjax.base.tables import printable
from allanjax.base.wording import finite_or_none, significant
from allanjax.calibration.least_squares import Triad
from allanjax.estimate.result import AxisEstimates
from allanjax.noise.estimate import Estimate
from allanjax.record.recording import Axis, Recording
from allanjax.record.units import Sensor

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

_AXES = "xyz"
# An axis and where it points, as in `x up` or `imu_x-down_2`; bare `up` and `down` are those of z.
_UP = re.compile(r"(?<![a-z])(?:([xyz])[\s_-]*)?(up|down)(?![a-z])")
_NORTH = re.compile(r"(?<![a-z])([xyz])[\s_-]*(north|south|east|west)(?![a-z])")
_SIGNED = re.compile(r"([+-])([xyz])|([xyz])([+-])")
# How far a given matrix may be from a rotation, and a given direction from a unit vector.
_TOLERANCE = 1e-3


@dataclass(frozen=True, eq=False)
class Orientation(ByValue):
    """Orientation of a sensor's frame.

    Attributes:
        name: for display, e.g. "x up".
        up: unit vector that points up, by its components along the sensor's axes.
        north: unit vector that points north, alike; None where the heading is not known.
    """

    name: str
    up: Float[np.ndarray, 3]
    north: Float[np.ndarray, 3] | None = None


#: An orientation as functions take it: its name, the upward direction, or a rotation matrix.
OrientationLike: TypeAlias = Orientation | str | ArrayLike | Sequence


def as_orientation(given: OrientationLike) -> Orientation:
    """Orientation from what a user gives.

    Args:
        given: a name, "x up", "z down", "+x" or "x-" (the axis that points up or down), perhaps with a
            heading, "x up, y north"; the direction that points up, three components along the sensor's
            axes; or the matrix [3, 3] that turns such components into those along east, north and up.

    Raises:
        AllanjaxError: none of these.
    """
    if isinstance(given, Orientation):
        return given
    if isinstance(given, str):
        found = orientation_in(given) or _signed(given)
        if found is None:
            raise AllanjaxError(
                f"{given!r} names no orientation: write 'x up', 'z down', '+x' or, with a heading, "
                "'x up, y north'; or give a direction or a matrix"
            )
        return found
    try:
        values = np.asarray(given, dtype=float)
    except (TypeError, ValueError):
        values = np.zeros(0)
    if values.shape == (3,) and abs(np.linalg.norm(values) - 1.0) < _TOLERANCE:
        up = values / np.linalg.norm(values)
        return Orientation("up " + _written(up), up)
    if values.shape == (3, 3) and _is_rotation(values):
        return Orientation(f"up {_written(values[2])}, north {_written(values[1])}", values[2], values[1])
    raise AllanjaxError(
        "an orientation is a name such as 'x up', a unit vector (the components of up along x, y, z), or a "
        "rotation matrix [3, 3] from the sensor's frame to east, north, up"
    )


def orientation_in(text: str) -> Orientation | None:
    """Orientation that a text such as "x up, y north" or "imu_x_up" names; None if it names none.

    Raises:
        AllanjaxError: an axis that points in two directions.
    """
    words = text.lower()
    found = _UP.search(words)
    if found is None:
        return None
    letter, way = found[1] or "z", found[2]
    up = _unit(letter) if way == "up" else 0.0 - _unit(letter)
    name, north = f"{letter} {way}", None
    heading = _NORTH.search(words)
    if heading is not None:
        if heading[1] == letter:
            raise AllanjaxError(f"{text!r}: {letter} points {way}, and cannot point {heading[2]}, too")
        pointing, where = _unit(heading[1]), heading[2]
        # North is up × east.
        north = np.cross(up, pointing) if where in ("east", "west") else pointing
        north = north if where in ("north", "east") else 0.0 - north
        name = f"{name}, {heading[1]} {where}"
    return Orientation(name, up, north)


def six_positions(with_heading: bool) -> tuple[Orientation, ...]:
    """Orientations with an axis up or down; with a heading, each with another axis north, south, too."""
    if not with_heading:
        return tuple(as_orientation(f"{a} {way}") for a, way in itertools.product(_AXES, ("up", "down")))
    every = itertools.product(itertools.permutations(_AXES, 2), ("up", "down"), ("north", "south"))
    return tuple(as_orientation(f"{a} {way}, {b} {where}") for (a, b), way, where in every)


def _signed(text: str) -> Orientation | None:
    found = _SIGNED.fullmatch(text.strip().lower())
    if found is None:
        return None
    sign, letter = found[1] or found[4], found[2] or found[3]
    return as_orientation(f"{letter} {'up' if sign == '+' else 'down'}")


def _is_rotation(C: Float[np.ndarray, "3 3"]) -> bool:
    return np.abs(C @ C.T - np.eye(3)).max() < _TOLERANCE and np.linalg.det(C) > 0.0


def _unit(letter: str) -> Float[np.ndarray, 3]:
    return np.eye(3)[_AXES.index(letter)]


def _written(vector: Float[np.ndarray, 3]) -> str:
    return "(" + ", ".join(f"{x + 0.0:.3g}" for x in vector) + ")"


SCHEMA_VERSION = 1
#: Scale factors and misalignments with a larger standard deviation are not used: sensors out of the box are
#: better than that.
USEFUL = 0.01


@dataclass(frozen=True, eq=False)
class Position(ByValue):
    """A recording at rest in one orientation.

    Attributes:
        name: that of the recording.
        orientation: None where it is unknown.
        start: its start [s from that of the first].
        duration: its length [s].
    """

    name: str
    orientation: Orientation | None
    start: float
    duration: float

    @property
    def label(self) -> str:
        """Orientation, or name, for display."""
        return self.name if self.orientation is None else self.orientation.name

    def to_dict(self) -> dict[str, Any]:
        """The position as a plain dictionary; directions that are not known are None."""
        up, north = (getattr(self.orientation, name, None) for name in ("up", "north"))
        return {
            "name": self.name,
            "up": None if up is None else up.tolist(),
            "north": None if north is None else north.tolist(),
            "start_s": self.start,
            "duration_s": self.duration,
        }


@dataclass(frozen=True, eq=False, repr=False)
class AxisCalibration(ByValue, AxisEstimates):
    """Errors of one axis: I = f + b + S·f + N·f + S2·f² + e (2.22, 2.23).

    Attributes:
        axis: whose they are.
        coefficients: "bias" [mg or deg/h], "scale_factor" [ppm, of gyros %], "misalignment_y" and its like,
            the response to what acts along another axis [µrad, of gyros mrad], and "second_order" [µg/g²], if
            asked for. A value that the positions do not determine is nan, and its remark says what it takes.
        widening: standard deviation of each over what white noise alone would give; nan without white noise.
    """

    axis: Axis
    coefficients: Mapping[str, Estimate]
    widening: Mapping[str, float]

    @TextProperty
    def verdict(self) -> str:
        """How much wider intervals are than those of white noise alone."""
        known = [x for x in self.widening.values() if np.isfinite(x)]
        return f"up to {significant(max(known))} times as wide as by white noise alone" if known else ""

    def rows(self) -> list[tuple[str, ...]]:
        """Rows of the printed table."""
        return [
            (
                self.axis.name,
                c.title,
                "not determined" if c.remark else c.in_unit().describe(),
                f"× {significant(wider)}" if wider > 0.0 else "",
            )
            for c, wider in zip(self.coefficients.values(), self.widening.values(), strict=True)
        ]

    def to_dataframe(self) -> pd.DataFrame:
        """One row a parameter, in its usual unit."""
        import pandas as pd

        rows = [
            {
                "axis": self.axis.name,
                "parameter": label,
                "value": c.value,
                "std": c.std,
                "lower_95": c.interval[0],
                "upper_95": c.interval[1],
                "unit": c.unit,
                "over_white_noise": self.widening[label],
                "remark": c.remark,
            }
            for label, c in ((label, e.in_unit()) for label, e in self.coefficients.items())
        ]
        return pd.DataFrame(rows)


@dataclass(frozen=True, eq=False)
class Misfit(ByValue):
    """How well the means of a sensor fit within the noise model.

    Attributes:
        names: axes; a single norm where orientations were not known.
        residuals: mean in each position less what was fitted [rad/s or m/s²]; nan where it was not used.
        residual_std: standard deviation that the noise gives them.
        chi2, dof, p_value: weighted squares of the residuals, means less parameters, and the probability of
            a larger χ²; nan without degrees of freedom, where any means would fit.
        suspects: positions that fit worst, where p is below 0.1 %; several where they are not told apart.
        wider: how many times the intervals were widened because the means scatter.
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
            return "as many parameters as means, which so are no check: add positions"
        text = f"χ² = {significant(self.chi2)} for {self.dof} degrees of freedom (p = {self.p_value:.2g})"
        if not self.suspects:
            return text
        return (
            f"{text}: the means do not fit. Worst is {' or '.join(self.suspects)}: its orientation may not "
            "be as told to within the noise (see orientation error), or the noise model lacks a drift"
        )


@dataclass(frozen=True, eq=False, repr=False)
class Calibration(ByValue, PerAxis[AxisCalibration]):
    """Calibration of gyros and accelerometers by positions at rest.

    Attributes:
        results: one an axis.
        positions: the recordings, in the order of time.
        misfit: how well the means fit, by sensor.
        gravity, gravity_std: gravity [m/s²] and its standard deviation, part of the scale factors' intervals.
        latitude: latitude [deg]; None if not given.
        noise: where the noise model comes from.
        notes: what was assumed, and what could not be done.
    """

    CALLED: ClassVar[str] = "the calibration"
    HEADINGS: ClassVar[tuple[str, ...]] = ("axis", "parameter", "estimate ± 1σ", "σ over white noise's")
    RIGHT: ClassVar[tuple[str, ...]] = ("σ over white noise's",)

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

        What is not determined, or known to no better than 1 %, is zero, as of a perfect sensor.
        """
        M, b, q = np.eye(3), np.zeros(3), np.zeros(3)
        for result in self.results:
            if result.axis.sensor != sensor:
                continue
            i = place_of(result.axis)
            for label, c in result.coefficients.items():
                value = float(np.nan_to_num(c.value))
                if label == "bias":
                    b[i] = value
                elif label == "second_order":
                    q[i] = value
                elif c.std < USEFUL:
                    M[i, i if label == "scale_factor" else "xyz".index(label[-1])] += value
        return Triad(M, b, q)

    def apply(self, recording: Recording) -> Recording:
        """The recording without these errors: its readings I become the inputs f.

        Axes that were not calibrated stay as they are.

        Raises:
            RecordingError: the recording has none of the axes, or not all of a sensor's, which it takes to
                undo a misalignment.
        """
        values, done = recording.values.copy(), []
        for sensor in self.misfit:
            axes = [result.axis for result in self.results if result.axis.sensor == sensor]
            there = [axis.name for axis in axes if axis.name in recording.names]
            if not there:
                continue
            missing = ", ".join(axis.name for axis in axes if axis.name not in there)
            if missing:
                raise RecordingError(f"{recording.name or 'recording'}: no {missing}, but {', '.join(there)}")
            columns = [recording.names.index(axis.name) for axis in axes]
            places = [place_of(axis) for axis in axes]
            M, b, q = self.errors(sensor)
            own = Triad(M[np.ix_(places, places)], b[places], q[places])
            values[:, columns] = own.inputs(recording.values[:, columns])
            done += there
        if not done:
            raise RecordingError(
                f"{recording.name or 'recording'} has none of the axes calibrated, {', '.join(self.axes)}"
            )
        note = f"calibrated: {', '.join(done)}"
        return replace(recording, values=values, others=(), notes=(*recording.notes, note))

    def to_dict(self) -> dict[str, Any]:
        """The calibration as plain dictionaries for JSON: estimates in usual units, matrices in SI."""
        table = self.to_dataframe().astype(object).to_dict("records")
        return {
            "schema_version": SCHEMA_VERSION,
            "gravity_m_s2": self.gravity,
            "gravity_std_m_s2": self.gravity_std,
            "latitude_deg": self.latitude,
            "noise": self.noise,
            "positions": [p.to_dict() for p in self.positions],
            "parameters": [
                {str(k): finite_or_none(v) if isinstance(v, float) else v for k, v in row.items()}
                for row in table
            ],
            "sensors": {
                sensor: {
                    "chi2": misfit.chi2,
                    "dof": misfit.dof,
                    "p_value": finite_or_none(misfit.p_value),
                    "suspects": list(misfit.suspects),
                    **{k: v.tolist() for k, v in self.errors(sensor)._asdict().items()},
                }
                for sensor, misfit in self.misfit.items()
            },
            "notes": list(self.notes),
        }

    @presented
    def plot(
        self, axes: Sequence[str] | str | None = None, path: str | os.PathLike[str] | None = None
    ) -> Figure:
        """Draw the residuals of each position with the scatter that the noise model gives them."""
        raise NotImplementedError

    def _remedies(self) -> dict[str, list[str]]:
        """What it takes to determine the parameters that are not, with the axes."""
        found: dict[str, list[str]] = {}
        for result in self.results:
            for remark in dict.fromkeys(c.remark for c in result.coefficients.values() if c.remark):
                found.setdefault(remark, []).append(result.axis.name)
        return found

    def _title(self) -> str:
        return f"calibration from {len(self.positions)} positions, g = {self.gravity:.5f} m/s²"

    def _cells(self) -> list[tuple[str, ...]]:
        return [row for result in self.results for row in result.rows()]

    def __str__(self) -> str:
        lines = [f"{sensor}: {misfit}" for sensor, misfit in self.misfit.items()]
        lines += [f"not determined of {', '.join(axes)}: {what}" for what, axes in self._remedies().items()]
        lines += [f"noise model: {self.noise}", *(f"note: {note}" for note in self.notes)]
        return "\n".join([super().__str__(), *map(printable, lines)])


def place_of(axis: Axis) -> int:
    """Place of an axis among x, y, z; that of z for a single axis without a letter."""
    return max("xyz".find(axis.name[-1]), -1) % 3

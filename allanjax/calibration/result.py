"""What a calibration found: errors of each axis, and the recording without them."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from jaxtyping import Float

from allanjax.base.equality import ByValue
from allanjax.base.errors import RecordingError
from allanjax.base.per_axis import PerAxis
from allanjax.base.plain import printable
from allanjax.base.presented import TextProperty, presented
from allanjax.base.wording import finite_or_none, significant
from allanjax.calibration.least_squares import Triad
from allanjax.calibration.orientation import Orientation
from allanjax.estimate.result import AxisEstimates
from allanjax.noise.estimate import Estimate
from allanjax.record.recording import Axis, Recording
from allanjax.record.units import Sensor

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

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

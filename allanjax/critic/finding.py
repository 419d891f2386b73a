"""Findings: causes that were found, what they change, and the discrepancies that they explain."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from allanjax.base.equality import ByValue
from allanjax.base.late import presented
from allanjax.critic.parameters import Detail
from allanjax.noise.estimate import Estimate, title_of
from allanjax.record.units import Sensor

#: Coefficients by whose change a finding's effect is measured, beside the drift and the Allan deviation.
MAIN_COEFFICIENTS = ("angle_random_walk", "rate_random_walk")
# Parameters that say how large an effect is in an axis, the first that a finding has.
_SIZES = (
    *("amplitude", "coefficient", "peak", "scale", "step", "ratio", "bandwidth"),
    *("upper_level", "lower_level", "fraction"),
)

# What people call causes whose names do not say it.
_TITLES = {
    "common_mode": "shared noise",
    "event": "outlier event",
    "low_pass": "low-pass filter",
    "markov": "Gauss-Markov process",
    "power_law": "power-law noise",
    "sinusoid": "spectral line",
    "telegraph": "telegraph noise",
    "temperature": "temperature effect",
    "warm_up": "warm-up",
}


@dataclasses.dataclass(frozen=True, eq=False)
class Discrepancy(ByValue):
    """Comparison of the measurement with its simulations in one statistic.

    Attributes:
        statistic: name of the statistic, e.g. "allan_deviation".
        where: place of the largest difference, e.g. 0.7.
        where_unit: its unit, "s" or "Hz", or "" where there is no place.
        measured, simulated: the statistic there, in `unit`; simulated is the ensemble's median.
        unit: of these two.
        p_value: probability of a difference as large anywhere, under the model.
        channel: the other axis or channel, of a correlation.
    """

    statistic: str
    where: float
    where_unit: str
    measured: float
    simulated: float
    unit: str
    p_value: float
    channel: str = ""

    @property
    def size(self) -> float:
        """Relative error of the simulation, simulated/measured − 1; nan where measured is zero."""
        return self.simulated / self.measured - 1.0 if self.measured else float("nan")


@dataclasses.dataclass(frozen=True)
class Rival:
    """Another cause that explains nearly as much.

    Attributes:
        cause: name of the cause.
        odds: odds of the finding's cause against it.
    """

    cause: str
    odds: float


@dataclasses.dataclass(frozen=True, eq=False)
class CoefficientChange(ByValue):
    """Basic coefficient before and after a finding, in `unit`; nan where the term is not in the model."""

    label: str
    before: float
    after: float
    unit: str


@dataclasses.dataclass(frozen=True, eq=False)
class DriftChange(ByValue):
    """Drift over a time: root mean square on held-out stretches, and predicted before and after a finding.

    The drift is the integrated rate less that of the mean rate of the stretch before, of equal length.
    """

    horizon: float
    measured: float
    before: float
    after: float
    unit: str


class Effect(NamedTuple):
    """Largest relative change that a finding makes in what a simulation is for.

    Attributes:
        size: the factor less one, 0.5 for half as much again or a third less; 1 where a term comes or goes.
        quantity: "angle_random_walk", "rate_random_walk", "drift" or "allan_deviation"; "sum" for what noise
            that axes share changes, the deviation of the sum of two of them; "" for none.
        time: time over which the drift or the Allan deviation is [s], else nan.
    """

    size: float
    quantity: str
    time: float = float("nan")


@dataclasses.dataclass(frozen=True, eq=False)
class Finding(ByValue):
    """A cause that was found, and the gain of taking it into the model.

    One that was found in several axes has `members`. Its coefficients, drift and discrepancies are then those
    of the axis in which it matters most, `shown`.

    Attributes:
        cause: name of the cause, see `causes`; "event" for outliers of several axes at one time.
        axes: axes that it concerns.
        parameters: estimates by label, in the recording's own units, times from its start [s].
        p_value: p-value of its statistic, corrected for the search; None where its odds are the test.
        evidence: log Bayes factor for it, trials and Occam factors included [nats]; None for what is seen in
            the samples themselves, such as rounding.
        gain: gain in log-likelihood on data that were used neither to find nor to fit it [nats]; None where
            it cannot be held out, or was not measured apart.
        rivals: causes against which its odds are shorter than 1000.
        span, domain: start and end, in s ("time") or Hz ("frequency").
        coefficients: changes of the basic coefficients.
        drift: change of the predicted drift.
        discrepancies: pairs of a statistic before and after this finding, at the place that it improved most.
        details: words and lists of numbers by name: a channel, the times of outliers, harmonics.
        members: findings of single axes that it tells together, as they were made.
        per_axis: how large it is in each axis, if it has members; see `amplitudes`.
    """

    cause: str
    axes: tuple[str, ...]
    parameters: Mapping[str, Estimate]
    p_value: float | None
    evidence: float | None
    gain: float | None
    rivals: tuple[Rival, ...]
    span: tuple[float, float]
    domain: str
    coefficients: tuple[CoefficientChange, ...] = ()
    drift: DriftChange | None = None
    discrepancies: tuple[tuple[Discrepancy, Discrepancy], ...] = ()
    details: Mapping[str, Detail] = dataclasses.field(default_factory=dict)
    members: tuple[Finding, ...] = ()
    per_axis: Mapping[str, Estimate] = dataclasses.field(default_factory=dict)

    @property
    def size(self) -> Estimate | None:
        """Parameter that says how large the effect is in its axis: an amplitude, a step, a ratio."""
        return next((self.parameters[label] for label in _SIZES if label in self.parameters), None)

    def named(self, cause: str) -> str:
        """Name of its own or of a rival's cause for people, e.g. "spectral line" for "sinusoid"."""
        sensors = {e.axis.sensor for e in self.parameters.values()}
        return cause_title(cause, "accel" if sensors == {"accel"} else "gyro")

    @property
    def amplitudes(self) -> dict[str, Estimate]:
        """How large the effect is in each axis, see `size`; nothing for noise that axes share."""
        if self.members:
            return dict(self.per_axis)
        return {self.axes[0]: self.size} if len(self.axes) == 1 and self.size is not None else {}

    @property
    def odds(self) -> float | None:
        """Odds for it, e^evidence; None where it has no evidence."""
        return None if self.evidence is None else float(np.exp(min(self.evidence, 700.0)))

    @property
    def shown(self) -> str:
        """Axis in which it matters most."""
        return self.strongest.axes[0]

    @property
    def strongest(self) -> Finding:
        """The member that changes most, or the finding itself."""
        return max(self.members, key=lambda f: (f.effect.size, f.gain or 0.0), default=self)

    @property
    def effect(self) -> Effect:
        """Largest relative change of N, K, the drift or the Allan deviation in any of its axes."""
        found = [
            Effect(_change(c.before, c.after), c.label)
            for c in self.coefficients
            if c.label in MAIN_COEFFICIENTS
        ]
        if self.drift is not None:
            found.append(Effect(_change(self.drift.before, self.drift.after), "drift", self.drift.horizon))
        for before, after in self.discrepancies:
            if before.statistic == "allan_deviation":
                # How much less wrong the simulation is: what is subtracted changes the measured one, too.
                mended = (1.0 + _off(before)) / (1.0 + _off(after)) - 1.0
                found.append(Effect(max(mended, 0.0), "allan_deviation", before.where))
        if "correlation" in self.parameters and len(self.axes) > 1:
            r = abs(self.parameters["correlation"].value)
            found.append(Effect(float(np.sqrt(1.0 + r)) - 1.0, "sum"))
        return max(found, key=lambda effect: effect.size, default=Effect(0.0, ""))

    @presented
    def __str__(self) -> str:
        raise NotImplementedError

    @presented
    def __repr__(self) -> str:
        raise NotImplementedError


def cause_title(cause: str, sensor: Sensor) -> str:
    """Name of a cause or a coefficient for people, e.g. "spectral line" for "sinusoid"."""
    return _TITLES.get(cause) or title_of(cause, sensor)


def _off(d: Discrepancy) -> float:
    """How far a simulated statistic is off, as `Effect.size` measures it."""
    return _change(d.measured, d.simulated)


def _change(before: float, after: float) -> float:
    """Factor between two values, less one: of one that comes or goes 1, of two that are not there 0."""
    known = [value for value in (before, after) if np.isfinite(value) and value > 0.0]
    if len(known) < 2:
        return float(len(known))
    return max(known) / min(known) - 1.0

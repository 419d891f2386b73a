"""Findings: detected causes, their parameters and effects, and the discrepancies that they explain."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Literal, NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Float

from allanjax.base.equality import ByValue
from allanjax.base.late import presented
from allanjax.base.normal import ONE_SIDED_95, TWO_SIDED_95
from allanjax.noise.estimate import Estimate, title_of
from allanjax.record.recording import Axis
from allanjax.record.units import Sensor

# Distance of a maximum from a bound, absolute and in standard deviations, below which it is at the bound.
_AT_BOUND, _NEAR_BOUND = 2e-2, 1.0
#: Side of its 95 % limit on which a parameter lies; "" if it has an estimate.
Limit: TypeAlias = Literal["", "above", "below"]
#: Detail of a finding besides its parameters: a word, several words, or a list of numbers.
Detail: TypeAlias = str | tuple[str, ...] | tuple[Estimate, ...]


def parameter_estimate(
    axis: Axis,
    label: str,
    value: float,
    std: float,
    unit: str,
    limit: Limit = "",
    log_normal: bool = False,
) -> Estimate:
    """Parameter of a finding, with intervals from a normal law of the value or of its logarithm.

    If the search ended at a bound of its range, or the effect may continue beyond the record, the value is a
    95 % `limit`: the parameter lies "above" or "below" it and has no standard deviation.
    """
    value, std = float(value), float("nan") if limit else float(std)

    def interval(deviations: float) -> tuple[float, float]:
        if log_normal:
            factor = float(np.exp(deviations * std / value))
            return value / factor, value * factor
        return value - deviations * std, value + deviations * std

    return Estimate(
        axis=axis,
        label=label,
        value=value,
        std=std,
        interval=interval(TWO_SIDED_95),
        interval_68=interval(1.0),
        unit=unit,
        usual_unit=unit,
        source="critique",
        upper_limit=value if limit == "below" else None,
        lower_limit=value if limit == "above" else None,
    )


def limited(
    u: float, std: float, bounds: Sequence[float] | Float[np.ndarray, " 2"]
) -> tuple[float, float, Limit]:
    """Estimate and its standard deviation, or a 95 % limit where it is at a bound."""
    if u > bounds[1] - max(_AT_BOUND, _NEAR_BOUND * std):
        return min(u, bounds[1]) - ONE_SIDED_95 * std, float("nan"), "above"
    if u < bounds[0] + max(_AT_BOUND, _NEAR_BOUND * std):
        return max(u, bounds[0]) + ONE_SIDED_95 * std, float("nan"), "below"
    return u, std, ""


def side_of_limit(e: Estimate) -> Limit:
    """Side of its 95 % limit on which a finding's parameter lies; "" if it has an estimate."""
    if e.lower_limit is not None:
        return "above"
    return "" if e.upper_limit is None else "below"


def values_of(detail: Detail) -> tuple[tuple[float, ...] | tuple[str, ...], float, str]:
    """Words or values of a detail, the standard deviation of the first value, and their unit."""
    words = (detail,) if isinstance(detail, str) else tuple(x for x in detail if isinstance(x, str))
    numbers = [x for x in detail if isinstance(x, Estimate)]
    return (tuple(x.value for x in numbers), numbers[0].std, numbers[0].unit) if numbers else (words, 0.0, "")


def written(x: Estimate | Detail) -> tuple[float | tuple[float, ...] | tuple[str, ...], float, str, Limit]:
    """Value, standard deviation and unit of a parameter or a detail, and the side of a limit."""
    return (x.value, x.std, x.unit, side_of_limit(x)) if isinstance(x, Estimate) else (*values_of(x), "")


def numbers_in(details: Mapping[str, Detail], name: str) -> list[float]:
    """Values of a list among details; none if there is no such list."""
    return [x.value for x in details.get(name, ()) if isinstance(x, Estimate)]


#: Cause of a discrepancy that no known effect explains.
UNEXPLAINED = "unexplained"
#: Coefficients whose change measures a finding's effect, beside the drift and the Allan deviation.
MAIN_COEFFICIENTS = ("angle_random_walk", "rate_random_walk")
# Parameters that may be the size of an effect in an axis; the first one of a finding counts.
_SIZES = (
    *("amplitude", "coefficient", "peak", "scale", "step", "ratio", "bandwidth"),
    *("upper_level", "lower_level", "fraction"),
)

# Usual names of causes, if they differ from their identifiers.
_TITLES = {
    "common_mode": "shared noise",
    "event": "outlier event",
    "low_pass": "low-pass filter",
    "markov": "Gauss-Markov process",
    "power_law": "power-law noise",
    "sinusoid": "spectral line",
    "spectral_shape": "filters and resonances",
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
        where_unit: unit of the place, "s" or "Hz"; "" if the statistic has no place.
        measured, simulated: the statistic at that place, in `unit`; the simulated one is the median.
        unit: unit of these two.
        p_value: probability under the model of a difference as large, at any place.
        channel: the other axis or channel of a correlation.
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
        """Relative error of the simulation, simulated/measured − 1; nan if the measured value is zero."""
        return self.simulated / self.measured - 1.0 if self.measured else float("nan")


@dataclasses.dataclass(frozen=True)
class Rival:
    """Another cause that explains the data nearly as well.

    Attributes:
        cause: name of the cause.
        odds: odds for the finding's cause against this one.
    """

    cause: str
    odds: float


@dataclasses.dataclass(frozen=True, eq=False)
class CoefficientChange(ByValue):
    """A basic coefficient before and after a finding, in `unit`; nan if its term is not in the model."""

    label: str
    before: float
    after: float
    unit: str


@dataclasses.dataclass(frozen=True, eq=False)
class DriftChange(ByValue):
    """RMS drift over a `horizon` [s]: of the record, and of simulations before and after a finding.

    The drift is the integrated rate, less the integral of the mean rate over an equally long time before. It
    shows what the finding changes and is no test of it, as the model was fitted to the same record; the gain
    is on held-out data. What the finding subtracts from the record is added to the simulations after it.

    Attributes:
        horizon: the time at which the finding changes the drift of simulations most, up to an eighth of the
            record [s].
        measured: drift of the record less the earlier findings and the ramp of the model before this one.
        before, after: drift of simulations.
        unit: unit of these three.
    """

    horizon: float
    measured: float
    before: float
    after: float
    unit: str


class Impact(NamedTuple):
    """The largest relative change by a finding in a quantity that simulations are used for.

    Attributes:
        size: the larger value over the smaller one, less 1; 1 if a term is added or removed.
        quantity: "angle_random_walk", "rate_random_walk", "drift" or "allan_deviation"; "sum" for shared
            noise, which changes the standard deviation of the sum of two axes; "" for none.
        time: time of the drift, or cluster time of the Allan deviation [s]; otherwise nan.
    """

    size: float
    quantity: str
    time: float = float("nan")


@dataclasses.dataclass(frozen=True, eq=False)
class Finding(ByValue):
    """A detected cause, and the gain from including it in the model.

    A finding in several axes has `members`. Its coefficients, drift and discrepancies are then those of the
    most affected axis, `shown`.

    Attributes:
        cause: name of the cause, see `causes`; "event" for outliers of several axes at one time.
        axes: names of the affected axes.
        parameters: estimates by label, in the recording's own units, times from its start [s].
        p_value: p-value of its statistic, corrected for the search; None if its odds are the test.
        evidence: log Bayes factor for it, including trials and Occam factors [nats]; None for effects that
            are visible directly in the samples, such as rounding.
        gain: gain in log-likelihood on data used neither to find nor to fit it [nats]; None if it cannot be
            tested on held-out data, or is included in that of another finding.
        rivals: other causes against which its odds are below 1000.
        span, domain: start and end, in s ("time") or Hz ("frequency").
        coefficients: changes of the basic coefficients.
        drift: change of the drift of simulations.
        discrepancies: pairs of a statistic before and after this finding, where it improved most.
        rest: discrepancy that is significant at its own place after all findings, which it explains in part.
        details: words and lists of numbers by name: a channel, the times of outliers, harmonics.
        members: the findings of single axes that it combines.
        per_axis: its size in each axis, if it has members; see `amplitudes`.
        stages: numbers of the stages before and after it, in `stages` of its axis.
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
    rest: Discrepancy | None = None
    details: Mapping[str, Detail] = dataclasses.field(default_factory=dict)
    members: tuple[Finding, ...] = ()
    per_axis: Mapping[str, Estimate] = dataclasses.field(default_factory=dict)
    stages: tuple[int, int] = (-1, -1)

    @property
    def size(self) -> Estimate | None:
        """The parameter that is the size of the effect in its axis: an amplitude, a step or a ratio."""
        return next((self.parameters[label] for label in _SIZES if label in self.parameters), None)

    def named(self, cause: str) -> str:
        """Usual name of its own or a rival's cause, e.g. "spectral line" for "sinusoid"."""
        sensors = {e.axis.sensor for e in self.parameters.values()}
        return cause_title(cause, "accel" if sensors == {"accel"} else "gyro")

    @property
    def amplitudes(self) -> dict[str, Estimate]:
        """Size of the effect in each axis, see `size`; empty for shared noise."""
        if self.members:
            return dict(self.per_axis)
        return {self.axes[0]: self.size} if len(self.axes) == 1 and self.size is not None else {}

    @property
    def odds(self) -> float | None:
        """Odds for the finding, e^evidence; None if it has no evidence."""
        return None if self.evidence is None else float(np.exp(min(self.evidence, 700.0)))

    @property
    def shown(self) -> str:
        """Name of the most affected axis."""
        return self.strongest.axes[0]

    @property
    def strongest(self) -> Finding:
        """The member with the largest effect, or the finding itself."""
        return max(self.members, key=lambda f: (f.impact.size, f.gain or 0.0), default=self)

    @property
    def impact(self) -> Impact:
        """The largest relative change of N, K, the drift or the Allan deviation in any axis."""
        main = (c for c in self.coefficients if c.label in MAIN_COEFFICIENTS)
        found = [Impact(_change(c.before, c.after), c.label) for c in main]
        if self.drift is not None:
            found.append(Impact(_change(self.drift.before, self.drift.after), "drift", self.drift.horizon))
        for before, after in self.discrepancies:
            if before.statistic == "allan_deviation":
                # Reduction of the simulation's error, as subtraction also changes the measured value.
                off, left = (1.0 + _change(d.measured, d.simulated) for d in (before, after))
                found.append(Impact(max(off / left - 1.0, 0.0), "allan_deviation", before.where))
        if "correlation" in self.parameters and len(self.axes) > 1:
            r = abs(self.parameters["correlation"].value)
            found.append(Impact(float(np.sqrt(1.0 + r)) - 1.0, "sum"))
        return max(found, key=lambda impact: impact.size, default=Impact(0.0, ""))

    @presented
    def __str__(self) -> str:
        raise NotImplementedError

    @presented
    def __repr__(self) -> str:
        raise NotImplementedError


def cause_title(cause: str, sensor: Sensor) -> str:
    """Usual name of a cause or a coefficient, e.g. "spectral line" for "sinusoid"."""
    return _TITLES.get(cause) or title_of(cause, sensor)


def _change(before: float, after: float) -> float:
    """Factor between two values, less one; 1 if one of them is missing, 0 if both are."""
    known = [value for value in (before, after) if np.isfinite(value) and value > 0.0]
    if len(known) < 2:
        return float(len(known))
    return max(known) / min(known) - 1.0

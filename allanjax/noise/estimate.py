"""Estimates: values with their uncertainty and unit."""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from allanjax.base.equality import ByValue
from allanjax.base.errors import UnitError
from allanjax.base.normal import ONE_SIDED_95, TWO_SIDED_68, TWO_SIDED_95
from allanjax.base.tables import Column, Number, PerAxis, columns_from, printable
from allanjax.base.wording import format_interval, format_with_error, percent, plain, significant
from allanjax.noise.terms import Parameter
from allanjax.record.recording import Axis
from allanjax.record.units import SENSORS, Sensor, convert, default_coefficient_unit, si_unit

if TYPE_CHECKING:
    import pandas as pd


@dataclasses.dataclass(frozen=True)
class Variation:
    """Variation of an amplitude over its record, beyond what sampling explains, relative to its mean.

    Attributes:
        size: standard deviation over the record; 0 if chance explains it.
        interval: 95 % interval of that.
        error: standard error that it adds to the mean, as an estimate with two degrees of freedom.
        louder: share of the record that is in louder bursts, which `size` leaves out.
        excess: relative amount by which these bursts increase the amplitude.
    """

    size: float = 0.0
    interval: tuple[float, float] = (0.0, 0.0)
    error: float = 0.0
    louder: float = 0.0
    excess: float = 0.0

    def __str__(self) -> str:
        words = []
        if self.size > 0.0:
            low, high = (percent(end, 2).removesuffix(" %") for end in self.interval)
            words.append(f"varies by {percent(self.size, 2)} over the record ({low} … {high})")
        if self.louder > 0.0:
            more = f", which add {percent(self.excess, 2)}" if self.excess > 0.0 else ""
            words.append(f"{percent(self.louder, 2)} of the record is in louder bursts{more}")
        return "; ".join(words)


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class Estimate(ByValue):
    """A value with its uncertainty and unit: a coefficient, a derived quantity, or a finding's parameter.

    The numbers of a fit or a posterior are in SI; `in_unit` converts them to the usual unit.

    Attributes:
        axis: the axis.
        label: name in the model, e.g. "angle_random_walk" or "markov_correlation_time"; or name of a derived
            quantity, e.g. "angle error after 60 s", or of a finding's parameter, e.g. "frequency".
        value: the estimate, for a posterior its median; zero for an amplitude without any sign in the data.
        std: standard deviation.
        interval: 95 % interval; for an amplitude its lower end is zero if zero is not excluded; nan if only a
            limit is known.
        interval_68: 68 % interval.
        unit: unit of all these numbers; SI by default.
        usual_unit: usual unit, e.g. "deg/√h"; for a model's parameter it follows from the parameter.
        source: "fit", "posterior", "spectrum", "critique" or "calibration"; or "curve", of the fit of a curve
            whose record's length is unknown, so that there are neither errors nor intervals nor limits.
        parameter: the parameter of the noise term, whose name is `term`; None for derived quantities and for
            a finding's parameters.
        upper_limit: one-sided 95 % limit of an amplitude; or of another parameter that may have any smaller
            value, too small to affect a record of this length and rate: then `std` is nan, and for a
            finding's parameter the limit is also the `value`.
        lower_limit: the same for a parameter that may have any larger value.
        detected: whether zero is excluded.
        rivals: for an amplitude that is not `detected` although zero is excluded: names of other terms from
            which the data cannot distinguish it.
        held: whether the value was given and not estimated.
        measured: whether it is a measurement of the sensor. It is not if the model does not fit (see
            `AxisFit.misfit`): the value is that of the fitted curve; standard deviation and intervals are
            nan, there is no limit, and nothing is detected.
        remark: limitation of the value, e.g. that it lies beyond the record.
        variation: how a fit's N, B or K varies over its record; None if unknown.
        bayes_factor: for an amplitude's posterior, see `posterior.sampling`; else None.
        sampled: for a posterior, whether there are draws.
        band, degrees_of_freedom, excess: for a spectrum's N, see `spectrum.psd`; else None.
    """

    axis: Axis
    label: str
    value: float
    std: float
    interval: tuple[float, float]
    interval_68: tuple[float, float]
    unit: str = ""
    usual_unit: str = ""
    source: Literal["fit", "curve", "posterior", "spectrum", "critique", "calibration"] = "fit"
    parameter: Parameter | None = None
    term: str = ""
    upper_limit: float | None = None
    lower_limit: float | None = None
    detected: bool = True
    rivals: tuple[str, ...] = ()
    held: bool = False
    measured: bool = True
    remark: str = ""
    variation: Variation | None = None
    bayes_factor: float | None = None
    sampled: bool = True
    band: tuple[float, float] | None = None
    degrees_of_freedom: float | None = None
    excess: float | None = None

    def __post_init__(self) -> None:
        if not self.usual_unit:
            if self.parameter is None:
                raise UnitError(f"{self.label}: an estimate without a parameter needs usual_unit=")
            object.__setattr__(self, "usual_unit", usual_unit(self.parameter, self.axis.sensor))
        if not self.unit:
            object.__setattr__(self, "unit", self.si_unit)

    @property
    def title(self) -> str:
        """Usual name of the quantity; an accelerometer's angle random walk is a velocity random walk."""
        return title_of(self.label, self.axis.sensor)

    @property
    def si_unit(self) -> str:
        """SI unit that corresponds to the usual unit, e.g. "rad/√s"."""
        return si_unit(self.usual_unit)

    @property
    def median(self) -> float:
        """Median of a posterior, which is its `value`."""
        return self.value

    @property
    def symbol(self) -> str:
        """Symbol of the parameter in the literature, e.g. "N"; "" for a derived quantity."""
        return self.parameter.symbol if self.parameter else ""

    @property
    def kind(self) -> str:
        """Kind of the parameter, e.g. "amplitude"; "" for a derived quantity."""
        return self.parameter.kind if self.parameter else ""

    @property
    def is_amplitude(self) -> bool:
        """Whether the estimate is a term's amplitude, not its shape or a derived quantity."""
        return self.kind == "amplitude"

    @property
    def log_errors(self) -> tuple[float, float]:
        """Standard deviations of a detected amplitude's logarithm, from the lower and the upper end of 95 %.

        They are zero for a value that was given.
        """
        low, high = self.interval
        if self.held or not low < high:
            return 0.0, 0.0
        below = math.log(self.value / low) / TWO_SIDED_95 if low > 0.0 else self.std / self.value
        return below, math.log(high / self.value) / TWO_SIDED_95

    @property
    def log_std(self) -> float:
        """Standard deviation of a detected amplitude's logarithm, the mean of both sides."""
        return sum(self.log_errors) / 2.0

    @property
    def power_std(self) -> float:
        """Standard deviation of an amplitude's square; by the limit, or infinite, if it is not detected."""
        if self.detected:
            return 2.0 * self.value * self.std
        most = math.inf if self.upper_limit is None else self.upper_limit
        return (most**2 - self.value**2) / ONE_SIDED_95

    def score(self, limit: float) -> float:
        """How many standard errors an amplitude is below a limit in its own unit.

        They are those of the logarithm on the side of the limit; of the square if it is not detected.
        """
        if not self.detected:
            return (limit**2 - self.value**2) / max(self.power_std, 1e-12 * limit**2)
        return math.log(limit / self.value) / max(self.log_errors[limit > self.value], 1e-12)

    def probability_below(self, limit: float) -> float:
        """Probability that the true amplitude is below a limit; nan if nothing is known of it."""
        from scipy.special import ndtr

        known = self.detected or self.power_std < math.inf
        return float(ndtr(self.score(limit))) if known else math.nan

    def in_unit(self, unit: str | None = None) -> Estimate:
        """A copy of the estimate in this unit, by default its `usual_unit`.

        Raises:
            UnitError: for an unknown unit or one of another dimension.
        """
        unit = self.usual_unit if unit is None else unit
        if unit == self.unit:
            return self
        # A quantity that is not a parameter may have a unit of the other sensor: a tilt, a misalignment.
        factor = convert(1.0, self.unit, unit, self.axis.sensor if self.parameter else None)
        return dataclasses.replace(self.times(factor), unit=unit)

    def times(self, factor: float) -> Estimate:
        """A copy whose numbers are multiplied by a factor."""
        numbers = {name: getattr(self, name) for name in _NUMBERS}
        scaled: dict[str, Any] = {
            name: tuple(x * factor for x in number) if isinstance(number, tuple) else number * factor
            for name, number in numbers.items()
            if number is not None
        }
        return dataclasses.replace(self, **scaled)

    def widened(self, factor: float) -> Estimate:
        """A copy whose standard deviation is larger by a factor, with intervals and limits to match.

        Intervals of positive values are widened in proportion: they stay positive. Zero stays an end.
        """

        def end(limit: float) -> float:
            if limit > 0.0 and self.value > 0.0:
                return self.value * (limit / self.value) ** factor
            return 0.0 if limit == 0.0 else self.value + factor * (limit - self.value)

        one, other = self.interval, self.interval_68
        above, below = self.upper_limit, self.lower_limit
        return dataclasses.replace(
            self,
            std=factor * self.std,
            interval=(end(one[0]), end(one[1])),
            interval_68=(end(other[0]), end(other[1])),
            upper_limit=None if above is None else above * factor,
            lower_limit=None if below is None else below / factor,
        )

    def varying(self, variation: Variation) -> Estimate:
        """A copy whose interval allows for a variation of the amplitude over the record.

        The error of the mean has two degrees of freedom, and Student's law.
        """
        by = variation.error

        def end(limit: float, quantile: float) -> float:
            if not (limit > 0.0 and self.value > 0.0):
                return limit
            log = math.log(limit / self.value)
            return self.value * math.exp(math.copysign(math.hypot(log, quantile * by), log))

        one, other, above = self.interval, self.interval_68, self.upper_limit
        return dataclasses.replace(
            self,
            std=math.hypot(self.std, by * self.value),
            interval=(end(one[0], _STUDENT_95), end(one[1], _STUDENT_95)),
            interval_68=(end(other[0], _STUDENT_68), end(other[1], _STUDENT_68)),
            upper_limit=None if above is None else end(above, _STUDENT_ONE_SIDED),
            variation=variation,
        )

    def covering(self, low: float, high: float) -> Estimate:
        """A copy whose 95 % interval covers another one, if that makes it notably wider."""
        low, high = min(low, self.interval[0]), max(high, self.interval[1])
        if high - low < _NOTABLY * (self.interval[1] - self.interval[0]):
            return self
        share, own = TWO_SIDED_68 / TWO_SIDED_95, self.interval_68
        ends = [self.value + share * (end - self.value) for end in (low, high)]
        return dataclasses.replace(
            self,
            std=max(self.std, (high - low) / 2.0 / TWO_SIDED_95),
            interval=(low, high),
            interval_68=(min(ends[0], own[0]), max(ends[1], own[1])),
        )

    def unmeasured(self) -> Estimate:
        """A copy without uncertainty, for a model that does not fit the data; held values stay."""
        if self.held:
            return self
        return dataclasses.replace(
            self,
            std=np.nan,
            interval=(np.nan, np.nan),
            interval_68=(np.nan, np.nan),
            upper_limit=None,
            lower_limit=None,
            detected=False,
            measured=False,
        )

    def without_interval(self) -> Estimate:
        """A copy without uncertainty, from a curve whose record's length is unknown; held values stay."""
        bare = self.unmeasured()
        return bare if self.held else dataclasses.replace(bare, **_OF_CURVE, detected=self.value > 0.0)

    def describe(self, unit: str | None = None) -> str:
        """The estimate in words, in its own unit or the given one; see `in_unit`.

        E.g. "0.512 ± 0.007 deg/√h", or "not detected (< 3.2 deg/h, 95 %)".
        """
        shown = self if unit is None else self.in_unit(unit)
        return shown._sentence(shown._amount())

    def row(self) -> dict[str, Any]:
        """The estimate in its usual unit, as a row of a data frame."""
        c = self.in_unit()
        return {
            "axis": c.axis.name,
            "coefficient": c.label,
            "value": c.value,
            "median": c.value,
            "std": c.std,
            "lower_68": c.interval_68[0],
            "upper_68": c.interval_68[1],
            "lower_95": c.interval[0],
            "upper_95": c.interval[1],
            "unit": c.unit,
            "detected": c.detected,
            "upper_limit_95": c.upper_limit,
            "measured": c.measured,
        }

    def describe_interval(self) -> str:
        """The 95 % interval, with as many decimals as the value has, e.g. "0.498 … 0.526"."""
        return format_interval(*self.interval, self.value, self.std if self.is_normal else np.nan)

    @property
    def is_normal(self) -> bool:
        """Whether 1σ lies within the 95 % interval and is about a quarter of it; else the latter is shown."""
        (low, high), value, std = self.interval, self.value, self.std
        if not (low < high and std > 0.0):
            return True
        within = low <= (max(value - std, 0.0) if value > 0.0 else value - std) and value + std <= high
        # Student's law of two degrees of freedom has 2.2 times the normal law's width.
        return within and (high - low) < 2.25 * 2.0 * TWO_SIDED_95 * std

    def __str__(self) -> str:
        amount = self._amount()
        if self.unit != self.usual_unit:
            amount += f" = {self.in_unit()._amount()}"
        return printable(f"{self.axis.name} {self.title}: {self._sentence(amount)}")

    def __repr__(self) -> str:
        return f"<Estimate {self}>"

    @property
    def number(self) -> Number | None:
        """What a table shows: the value with its error, or a limit; None where it is not determined."""
        if self.held:
            return Number(self.value, after=" held")
        if not self.measured:
            return Number(self.value, before="(", after=")") if self.value > 0.0 else None
        if self.source == "curve" and self.detected:
            return Number(self.value)
        sign, limit = self.limit
        if sign:
            return None if limit is None else Number(limit, before=f"{sign} ")
        return Number(self.value, self.std) if np.isfinite(self.std) else None

    @property
    def limit(self) -> tuple[str, float | None]:
        """Sign and value of the limit that stands for the value; "" if the value does."""
        if not self.detected:
            return "<", self.upper_limit
        if self.is_amplitude or (self.lower_limit is None and self.upper_limit is None):
            return "", None
        return ("<", self.upper_limit) if self.lower_limit is None else (">", self.lower_limit)

    def _amount(self) -> str:
        """The value or limit with its unit, and the interval where 1σ does not describe it."""
        shown, normal = self.number, True
        if self.held:
            number = plain(self.value)
        elif self.source == "curve":
            number = significant(self.value)
        elif self.measured and not self.limit[0]:
            normal = self.is_normal
            number = format_with_error(self.value, self.std) if normal else significant(self.value)
        elif shown is None:
            return "" if self.measured else "none"
        else:
            number = significant(shown.value)
        amount = number if self.unit == "1" else f"{number} {self.unit}"
        bare = (self.parameter is not None and normal) or not self.interval[0] < self.interval[1]
        return amount if bare else f"{amount} (95 %: {self.describe_interval()})"

    def _sentence(self, amount: str) -> str:
        """The amount in words, e.g. "not detected (< 3.2 deg/h, 95 %)"."""
        if self.held:
            return f"{amount} (held)"
        if not self.measured:
            return f"not a measurement of this sensor (the fitted curve has {amount})"
        if self.source == "curve" and self.detected:
            return amount
        if self.parameter is None and np.isnan(self.value):
            return f"not determined by these data{'; ' if self.remark else ''}{self.remark}"
        if not self.detected:
            if self.upper_limit is None:
                return "not determined, as its term is not detected"
            if self.rivals:
                names = " or ".join(title_of(name, self.axis.sensor) for name in self.rivals)
                return f"cannot be distinguished from {names} (< {amount}, 95 %)"
            return f"not detected (< {amount}, 95 %)"
        if self.limit[0]:
            return f"{self.limit[0]} {amount} (95 %)"
        if self.parameter and not self.is_amplitude and np.isnan(self.std):
            return "not determined by these data"
        return f"{amount}; {self.remark}" if self.remark else amount


# Fields of an estimate from a curve whose record's length is unknown.
_OF_CURVE: dict[str, Any] = {"source": "curve", "measured": True}
#: A fit's estimates are its coefficients.
Coefficient = Estimate

# Ends of the central 95 % and 68 % of Student's law of two degrees of freedom, and of its lower 95 %.
_STUDENT_95, _STUDENT_68, _STUDENT_ONE_SIDED = 4.303, 1.321, 2.920
# Factor from which on an interval counts as wider than another.
_NOTABLY = 1.1
#: The fields of an estimate that are in its `unit`.
_NUMBERS = ("value", "std", "interval", "interval_68", "upper_limit", "lower_limit", "excess")


def usual_unit(parameter: Parameter, sensor: Sensor) -> str:
    """The usual unit of a parameter of this sensor's noise, e.g. "deg/√h"."""
    if parameter.is_amplitude:
        return default_coefficient_unit(sensor, parameter.time_exponent)
    return {"time": "s", "frequency": "Hz", "line": "Hz"}.get(parameter.kind, "1")


def title_of(label: str, sensor: Sensor) -> str:
    """Usual name of a term or a coefficient: N of an accelerometer is a velocity random walk.

    Its K is an acceleration random walk. The text may contain several labels.
    """
    words = re.sub(r"\bmarkov\b", "Markov process", label.replace("_", " "))
    if sensor == "accel":
        words = words.replace("angle random walk", "velocity random walk")
        words = words.replace("rate random walk", "acceleration random walk")
    return words


#: Symbols of the basic terms, in the order of a table's columns.
SYMBOLS = {
    "angle_random_walk": "N",
    "bias_instability": "B",
    "rate_random_walk": "K",
    "quantization": "Q",
    "drift_ramp": "R",
}
# Usual names of the basic terms, besides their own and their symbols.
_CALLED: dict[str, dict[Sensor, str]] = {
    "angle_random_walk": {"gyro": "arw", "accel": "vrw velocity_random_walk"},
    "rate_random_walk": {"gyro": "rrw", "accel": "rrw acceleration_random_walk"},
    "bias_instability": dict.fromkeys(SENSORS, "bi flicker flicker_noise"),
    "quantization": dict.fromkeys(SENSORS, "qn quantization_noise"),
    "drift_ramp": dict.fromkeys(SENSORS, "ramp rate_ramp"),
}


def called(name: str, coefficients: Mapping[str, Estimate]) -> str | None:
    """Label of the coefficient with this usual name; None if there is none, or several.

    Names are labels, in any case and with spaces; symbols such as "N"; and abbreviations such as "ARW" of a
    gyro and "VRW" of an accelerometer. An accelerometer's "ARW" is ambiguous (angle or acceleration random
    walk) and therefore not a name.
    """
    if name in coefficients:
        return name
    by_symbol = [label for label, c in coefficients.items() if c.symbol == name]
    if len(by_symbol) == 1:
        return by_symbol[0]
    return next((label for label, c in coefficients.items() if is_called(name, label, c.axis.sensor)), None)


def is_called(name: str, label: str, sensor: Sensor) -> bool:
    """Whether this is the label of a coefficient, in any case and with spaces, or an abbreviation of it."""
    spelt = re.sub(r"[\s-]+", "_", name.strip().lower())
    return spelt in (label, *_CALLED.get(label, {}).get(sensor, "").split())


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class AxisReadings(ByValue):
    """Coefficients that are read off the curve of one axis.

    Attributes:
        axis: the axis.
        estimates: estimates by label; None if the curve does not show the quantity.
        reasons: reasons by label why there is no estimate.
    """

    axis: Axis
    estimates: Mapping[str, Estimate | None]
    reasons: Mapping[str, str] = dataclasses.field(default_factory=dict)

    def __getitem__(self, label: str) -> Estimate | None:
        """The estimate of this label, or None."""
        return self.estimates[label]

    def rows(self) -> list[tuple[str, ...]]:
        """Rows of the printed table: one per quantity that could be read."""
        rows: list[tuple[str, ...]] = []
        for label, shown in ((k, e.in_unit()) for k, e in self.estimates.items() if e is not None):
            value = format_with_error(shown.value, shown.std)
            band = " … ".join(plain(f, 3) for f in shown.band or ())
            title = title_of(label, self.axis.sensor)
            rows.append((self.axis.name, title, value, shown.describe_interval(), shown.unit, band))
        return rows

    def to_dataframe(self) -> pd.DataFrame:
        """Table with one row per quantity, in usual units; numbers are missing where there is none."""
        import pandas as pd

        rows = [
            ({} if estimate is None else estimate.row())
            | {"axis": self.axis.name, "coefficient": label, "reason": self.reasons.get(label, "")}
            for label, estimate in self.estimates.items()
        ]
        columns = ["axis", "coefficient", "value", "std", "lower_95", "upper_95", "unit", "reason"]
        return pd.DataFrame(rows, columns=columns)

    def __repr__(self) -> str:
        shown = [f"{label} {e.in_unit().describe()}" for label, e in self.estimates.items() if e is not None]
        return f"<AxisReadings {self.axis.name}: {', '.join(shown) or 'none'}>"


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Readings(ByValue, PerAxis[AxisReadings]):
    """Coefficients that are read off the curves of several axes.

    Attributes:
        title: title of the table.
        results: one per axis.
    """

    title: str
    results: tuple[AxisReadings, ...]

    def _title(self) -> str:
        return self.title

    def _tables(self) -> list[list[Column]]:
        heads = ("axis", "quantity", "value ± 1σ", "95 % interval", "unit", "band (Hz)")
        return [columns_from(heads, [row for result in self.results for row in result.rows()])]

    def _notes(self) -> list[str]:
        """The quantities that cannot be read, and why."""
        axes: dict[tuple[str, str], list[str]] = {}
        for result in self.results:
            for label, reason in result.reasons.items():
                axes.setdefault((label.replace("_", " "), reason), []).append(result.axis.name)
        labels: dict[str, list[str]] = {}
        for (label, reason), names in axes.items():
            labels.setdefault(f"({', '.join(names)}): {reason}", []).append(label)
        return [f"not read: {', '.join(names)} {reason}" for reason, names in labels.items()]

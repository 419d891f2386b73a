"""Results of `horizon`: the numbers for the filters of several axes, told and written."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from typing import Any, ClassVar, Literal

import numpy as np
from jaxtyping import Float

from allanjax.base.equality import ByValue
from allanjax.base.errors import AllanjaxError, FitError
from allanjax.base.per_axis import PerAxis
from allanjax.base.wording import duration as length
from allanjax.base.wording import finite_or_none, significant
from allanjax.estimate.as_json import in_both_units
from allanjax.noise.estimate import Estimate, title_of
from allanjax.record.recording import Axis
from allanjax.record.units import default_coefficient_unit, unit_scale

#: What the bias is to the filter.
Process = Literal["walk", "markov"]
SCHEMA_VERSION = 1
#: Exponents of time in the units of N and K, of the angle, and of the bias.
EXPONENTS = {"white": 0.5, "walk": -0.5, "integral": 1.0, "bias": 0.0}
# Share of the variance from which on a term is named.
_NAMED = 0.05


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class AxisHorizon(ByValue):
    """White noise and process of the bias for the filter of one axis, up to a horizon.

    The filter has estimated the bias from the sensor at rest, and integrates what it measures, less that
    bias. Its `error` is that of the angle (of the velocity). See `estimate.coasting`. To the filter the bias
    is a random walk, or a first-order Gauss–Markov process, which is a walk that returns to zero in the
    correlation time: K is then the root of the density of the noise that drives it.

    Attributes:
        axis: whose it is.
        horizon: time between corrections [s].
        probability: that of the bounds.
        white, walk: the N and K whose predicted variance is the true one at the horizon, and closest to it
            in the largest ratio at shorter times, from a hundredth of the horizon on.
        correlation_time: of the Gauss–Markov process, one of those that are
            compared, a factor of two apart or less; None for a walk.
        mismatch: how many times larger or smaller the predicted standard deviation is there at most.
        bounding_white, bounding_walk: the N and K, SI, whose prediction is at none of these times below the
            true variance, at each with this probability; of all such pairs the one with the least mean
            logarithm of the predicted variance.
        bounding_time: correlation time of the bounding process [s]; infinite for a walk.
        raw_white, raw_walk: N and K of the fitted model, SI; zero if it has none.
        time: times [s] since the last correction.
        error: standard deviation of the error [rad or m/s] with `white` and `walk`, all terms included.
        raw_error, raw_prediction: the same with the raw N and K, as a walk, and what these predict.
        bound: the standard deviation that the bounding pair predicts.
        shares: shares of the terms in the variance of the error at the horizon, the largest first.
        sets: how many likely sets of terms were averaged over.
    """

    axis: Axis
    horizon: float
    probability: float
    white: Estimate
    walk: Estimate
    correlation_time: Estimate | None
    mismatch: float
    bounding_white: float
    bounding_walk: float
    bounding_time: float
    raw_white: float
    raw_walk: float
    time: Float[np.ndarray, " t"]
    error: Float[np.ndarray, " t"]
    raw_error: Float[np.ndarray, " t"]
    raw_prediction: Float[np.ndarray, " t"]
    bound: Float[np.ndarray, " t"]
    shares: Mapping[str, float]
    sets: int = 1

    @property
    def inflation(self) -> dict[str, float]:
        """Factors N*/N and K*/K over the raw coefficients; infinite where the fit has none."""
        pairs = {
            "white": (self.white.value, self.raw_white),
            "walk": (self.walk.value, self.raw_walk),
        }
        return {name: new / raw if raw > 0.0 else math.inf for name, (new, raw) in pairs.items()}

    @property
    def raw_factor(self) -> float:
        """How many times the error at the horizon is what a filter with raw N and K predicts; inf without."""
        predicted = float(self.raw_prediction[-1])
        return float(self.raw_error[-1]) / predicted if predicted > 0.0 else math.inf

    @property
    def bias_std(self) -> float:
        """Standard deviation of the Gauss–Markov process, SI; infinite for a walk."""
        time = self.correlation_time
        return math.inf if time is None else self.walk.value * math.sqrt(time.value / 2.0)

    @property
    def bounding_bias_std(self) -> float:
        """The same of the bounding process."""
        return self.bounding_walk * math.sqrt(self.bounding_time / 2.0)

    def causes(self) -> str:
        """The terms that make up the variance of the error at the horizon, in words."""
        told = [f"{title_of(k, self.axis.sensor)} {x:.0%}" for k, x in self.shares.items() if x >= _NAMED]
        return ", ".join(told)

    def _shown(self, name: str, value: float) -> str:
        unit = default_coefficient_unit(self.axis.sensor, EXPONENTS[name])
        return f"{significant(value / unit_scale(unit, self.axis.sensor))} {unit}"

    def _times(self) -> str:
        """The correlation time and its interval in words; both are of a grid."""
        assert self.correlation_time is not None
        low, high = map(length, self.correlation_time.interval)
        return f"{length(self.correlation_time.value)} (95 %: {low} … {high})"

    def rows(self) -> list[tuple[str, str, str, str]]:
        """Rows of the printed table: axis, quantity, equal to the model's error, bound."""
        name, cells = self.axis.name, []
        bounds = {"white": self.bounding_white, "walk": self.bounding_walk}
        raw = {"white": self.raw_white, "walk": self.raw_walk}
        for key, symbol in (("white", "N"), ("walk", "K")):
            factor = self.inflation[key]
            own = self._shown(key, raw[key]) if raw[key] > 0.0 else "none"
            times = f" × {significant(factor)}" if math.isfinite(factor) else ""
            estimate = getattr(self, key).in_unit()
            cells.append(
                (name, f"{symbol}*: raw {own}{times}", estimate.describe(), self._shown(key, bounds[key]))
            )
        if self.correlation_time is not None:
            cells.append((name, "T*: correlation time", self._times(), length(self.bounding_time)))
            size, bound = (self._shown("bias", x) for x in (self.bias_std, self.bounding_bias_std))
            cells.append((name, "1σ of the process, K*·√(T*/2)", size, bound))
        error, bound = (self._shown("integral", float(x[-1])) for x in (self.error, self.bound))
        kind = "velocity" if self.axis.sensor == "accel" else "angle"
        cells.append((name, f"1σ of the {kind} after {length(self.horizon)}", error, bound))
        sets = f", averaged over {self.sets} likely sets of terms" if self.sets > 1 else ""
        told = "there are no raw N and K"
        if math.isfinite(self.raw_factor):
            told = f"with raw N and K it is {significant(self.raw_factor)} times what they predict"
        cells.append((name, f"{told}; it is made of {self.causes()}{sets}", "", ""))
        return cells

    def to_dict(self) -> dict[str, Any]:
        """The numbers of the axis as plain dictionaries, lists, numbers and strings, for JSON."""
        series = ("time", "error", "bound", "raw_error", "raw_prediction")
        time = self.correlation_time
        return {
            "name": self.axis.name,
            "sensor": self.axis.sensor,
            "white": in_both_units(self.white),
            "walk": in_both_units(self.walk),
            "correlation_time": None if time is None else in_both_units(time),
            "bias_std_si": finite_or_none(self.bias_std),
            "mismatch": self.mismatch,
            "bounding_si": {
                "white": self.bounding_white,
                "walk": self.bounding_walk,
                "correlation_time": finite_or_none(self.bounding_time),
                "bias_std": finite_or_none(self.bounding_bias_std),
            },
            "raw_si": {"white": self.raw_white, "walk": self.raw_walk},
            "inflation": {name: finite_or_none(factor) for name, factor in self.inflation.items()},
            "raw_factor": finite_or_none(self.raw_factor),
            "shares": dict(self.shares),
            "sets": self.sets,
            "curves_si": {name: getattr(self, name).tolist() for name in series},
        }

    def __repr__(self) -> str:
        white, walk = self.white.in_unit().describe(), self.walk.in_unit().describe()
        time = "" if self.correlation_time is None else f", T* {self.correlation_time.describe()}"
        return f"<AxisHorizon {self.axis.name}, {length(self.horizon)}: N* {white}, K* {walk}{time}>"

    def to_dataframe(self):  # type: ignore[no-untyped-def]  # pandas is imported late
        """Errors by time: of the matched pair, its prediction's bound, and with raw N and K, in SI."""
        import pandas as pd

        names = ("time", "error", "bound", "raw_error", "raw_prediction")
        return pd.DataFrame({"axis": self.axis.name, **{name: getattr(self, name) for name in names}})


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Horizon(ByValue, PerAxis[AxisHorizon]):
    """White noise and process of the bias for the filters of several axes, up to a horizon.

    Attributes:
        name: the recording's name.
        horizon: time between corrections [s].
        process: what the bias is to the filters, "walk" or "markov".
        probability: that of the bounds.
        results: one an axis.
        notes: of a data sheet, what was assumed and what it does not give.
    """

    CALLED: ClassVar[str] = "the horizon"
    HEADINGS: ClassVar[tuple[str, ...]] = ("axis", "for the filter", "equal ± 1σ", "bound")
    ERROR: ClassVar[type[AllanjaxError]] = FitError

    name: str
    horizon: float
    process: Process
    probability: float
    results: tuple[AxisHorizon, ...]
    notes: tuple[str, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """The horizon as plain dictionaries, lists, numbers and strings, as `--json` prints it.

        `allanjax schema horizon` says what each means.
        """
        return {
            "schema_version": SCHEMA_VERSION,
            "recording": {"name": self.name},
            "horizon_s": self.horizon,
            "process": self.process,
            "probability": self.probability,
            "axes": [result.to_dict() for result in self.results],
            "notes": list(self.notes),
        }

    def __str__(self) -> str:
        return "\n".join([super().__str__(), *(f"note: {note}" for note in self.notes)])

    def _title(self) -> str:
        name = f"{self.name}: " if self.name else ""
        process = ", Gauss–Markov bias" if self.process == "markov" else ""
        return (
            f"{name}corrections every {length(self.horizon)}{process}, bounds at {self.probability:.0%} "
            "probability"
        )

    def _cells(self) -> list[tuple[str, str, str, str]]:
        return [row for result in self.results for row in result.rows()]

"""Which white noise, and which walk or Gauss–Markov process, a filter needs between its corrections."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Literal, get_args

import numpy as np
from jaxtyping import Float

from allanjax.base.equality import ByValue
from allanjax.base.errors import AllanjaxError, FitError
from allanjax.base.per_axis import PerAxis
from allanjax.base.wording import duration as length
from allanjax.base.wording import finite_or_none, significant
from allanjax.estimate.as_json import in_both_units
from allanjax.estimate.coasting import (
    Filters,
    actual,
    bounding_pair,
    coasting_steps,
    equal_pair,
    memories,
    predicted,
)
from allanjax.estimate.likely_models import Likely, likely_models
from allanjax.estimate.result import AxisFit, Fit
from allanjax.noise.estimate import Estimate, title_of
from allanjax.noise.terms import Markov
from allanjax.record.recording import Axis
from allanjax.record.units import default_coefficient_unit, si_unit, unit_scale

#: What the bias is to the filter.
Process = Literal["walk", "markov"]
SCHEMA_VERSION = 1
_DRAWS = 400
# Memories and correlation times of the Gauss–Markov filters that are compared.
_MEMORIES, _TIMES = 25, 11
_QUANTILES = (0.025, 0.975, 0.16, 0.84)
# Exponents of time in the units of N and K, and of the angle.
_EXPONENTS = {"white": 0.5, "walk": -0.5, "integral": 1.0, "bias": 0.0}
_LABELS = {
    "white": "white noise of the filter",
    "walk": "random walk of the filter",
    "time": "correlation time of the filter",
}
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
        """How many times the error at the horizon is what a filter with the raw N and K predicts."""
        return float(self.raw_error[-1] / self.raw_prediction[-1])

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
        told = [f"{title_of(k, self.axis)} {x:.0%}" for k, x in self.shares.items() if x >= _NAMED]
        return ", ".join(told)

    def _shown(self, name: str, value: float) -> str:
        unit = default_coefficient_unit(self.axis.sensor, _EXPONENTS[name])
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
            "raw_factor": self.raw_factor,
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
    """

    CALLED: ClassVar[str] = "the horizon"
    HEADINGS: ClassVar[tuple[str, ...]] = ("axis", "for the filter", "equal ± 1σ", "bound")
    ERROR: ClassVar[type[AllanjaxError]] = FitError

    name: str
    horizon: float
    process: Process
    probability: float
    results: tuple[AxisHorizon, ...]

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
        }

    def _title(self) -> str:
        name = f"{self.name}: " if self.name else ""
        process = ", Gauss–Markov bias" if self.process == "markov" else ""
        return (
            f"{name}corrections every {length(self.horizon)}{process}, bounds at {self.probability:.0%} "
            "probability"
        )

    def _cells(self) -> list[tuple[str, str, str, str]]:
        return [row for result in self.results for row in result.rows()]


def horizon(
    fit: Fit,
    seconds: float,
    *,
    process: Process = "walk",
    axes: Sequence[str] | str | None = None,
    probability: float = 0.95,
    seed: int = 0,
) -> Horizon:
    """White noise and walk with which a filter's predicted error is that of the whole model, up to a horizon.

    A filter of two parameters estimates the bias from the sensor at rest and integrates its samples, less
    the bias, for up to `seconds`. The error of the angle (or velocity) then comes from all terms, the lines
    and those behind a response included. The pair `white` and `walk` predicts it as well as two numbers
    can; the bounding pair is at no time below it, with this probability of the coefficients. Where the
    data do not tell sets of terms apart, both are averaged over the likely ones.

    Args:
        fit: what `fit` or `load` returned.
        seconds: time between corrections [s], at least two samples and at most half the record.
        process: what the bias is to the filter: a random walk, or ("markov") a first-order Gauss–Markov
            process, whose correlation time is then found with the pair.
        axes: names of axes; by default all that have a measurement.
        probability: that of the bounds.
        seed: of the draws of the coefficients.

    Raises:
        FitError: an axis without a measurement that was asked for, or no axis with one.
        AllanjaxError: a horizon, a process or a probability out of range; a term that has no state space.
    """
    if process not in get_args(Process):
        raise AllanjaxError(f"process= (--process) must be walk or markov, not {process!r}")
    rate, record = fit.curve.rate, fit.curve.n / fit.curve.rate
    if not 2.0 / rate <= seconds <= record / 2.0:
        raise AllanjaxError(
            f"the horizon must be from two samples, {2.0 / rate:g} s, to half the record, "
            f"{record / 2.0:g} s; got {seconds}"
        )
    if not 0.5 <= probability < 1.0:
        raise AllanjaxError(f"the probability of a bound must be from 0.5 to below 1, got {probability}")
    asked = [axes] if isinstance(axes, str) else axes
    results = [fit[name] for name in asked] if asked else [r for r in fit.values() if r.measured]
    for result in results:
        if not result.measured:
            raise FitError(f"{result.axis.name}: {result.verdict()}")
    if not results:
        raise FitError("no axis has a measurement: the fit says why")
    found = (_of_axis(fit, result, float(seconds), process, probability, seed) for result in results)
    return Horizon(fit.name, float(seconds), process, probability, tuple(found))


def _of_axis(
    fit: Fit, result: AxisFit, seconds: float, process: Process, probability: float, seed: int
) -> AxisHorizon:
    rate, record = fit.curve.rate, fit.curve.n / fit.curve.rate
    raw_N, raw_K = (_raw(result, name) for name in ("angle_random_walk", "rate_random_walk"))
    raw = Filters.of_walk(
        np.array([np.clip(raw_N / raw_K if raw_K > 0.0 else record, 2 / rate, record)]), rate
    )
    filters, steps = _filters(result, seconds, process, rate, record), coasting_steps(seconds, rate)
    sets = likely_models(fit, result.axis.name, _DRAWS, np.random.default_rng(seed))
    unit, known, draws, each = _variances(sets, filters, steps, record)
    _, of_raw, _, _ = _variances(sets, raw, steps, record)
    # The prediction is to be right on average over what the coefficients may be.
    mean = known.mean(axis=0)
    best, N, ratio = equal_pair(mean, unit)
    drawn = [equal_pair(V, unit) for V in known]
    chosen, N_drawn = np.array([k for k, _, _ in drawn]), np.array([n for _, n, _ in drawn])
    bounding, bounding_N = bounding_pair(np.quantile(draws, probability, axis=0), unit)
    time = filters.correlation_time
    return AxisHorizon(
        axis=result.axis,
        horizon=seconds,
        probability=probability,
        white=_estimate(result.axis, "white", N, N_drawn),
        walk=_estimate(result.axis, "walk", N / filters.memory[best], N_drawn / filters.memory[chosen]),
        correlation_time=(
            _estimate(result.axis, "time", time[best], time[chosen]) if process == "markov" else None
        ),
        mismatch=math.sqrt(ratio),
        bounding_white=bounding_N,
        bounding_walk=bounding_N / float(filters.memory[bounding]),
        bounding_time=float(time[bounding]),
        raw_white=raw_N,
        raw_walk=raw_K,
        time=steps / rate,
        error=np.sqrt(mean[best]),
        raw_error=np.sqrt(of_raw.mean(axis=0)[0]),
        raw_prediction=_own_size(raw_N, raw_K, raw) * np.sqrt(predicted(raw, steps)[0]),
        bound=bounding_N * np.sqrt(unit[bounding]),
        shares=_shares(sets, each, best),
        sets=len(sets),
    )


def _filters(result: AxisFit, seconds: float, process: Process, rate: float, record: float) -> Filters:
    """The filters that are compared; that of the fitted model is one of them."""
    N, K = (_raw(result, name) for name in ("angle_random_walk", "rate_random_walk"))
    if process == "walk":
        return Filters.of_walk(memories(record, rate, [N / K] if K > 0.0 else []), rate)
    own = [term for term in result.model.terms if isinstance(term, Markov)]
    times = [float(term.correlation_time) for term in own]
    drives = [K, *(float(term.amplitude) for term in own)]
    memory = memories(record, rate, [N / q for q in drives if q > 0.0], _MEMORIES)
    # What returns sooner is white noise to a filter up to the horizon.
    grid = [*np.geomspace(max(seconds / 100.0, 2.0 / rate), record, _TIMES), *times]
    return Filters.of_markov(memory, np.unique(np.clip(grid, 2.0 / rate, record)), rate)


def _variances(
    sets: Sequence[Likely], filters: Filters, steps: Float[np.ndarray, " t"], record: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[np.ndarray]]:
    """Variances that filters predict with N = 1, and the true ones by draws: of what is known, of all.

    What is not known is only limited. The last are the true ones of each set, by terms of unit amplitude.
    """
    shared: dict[str, np.ndarray] = {}
    each = [actual(s.model, filters, steps, record, shared) for s in sets]
    pairs = list(zip(sets, each, strict=True))
    known = np.concatenate([_draws(s, V, s.limited) for s, V in pairs])
    draws = np.concatenate([_draws(s, V) for s, V in pairs])
    return predicted(filters, steps), known, draws, each


def _raw(result: AxisFit, label: str) -> float:
    """A coefficient of the fitted model, SI; zero if that has none."""
    found = result.coefficients.get(label)
    return float(found.value) if found is not None and found.value > 0.0 else 0.0


def _own_size(N: float, K: float, filters: Filters) -> float:
    """N of the filter with the raw coefficients; without N, what the walk is over its memory."""
    return N if N > 0.0 else K * float(filters.memory[0])


def _draws(
    likely: Likely, variance: Float[np.ndarray, "terms g t"], without: int = 0
) -> Float[np.ndarray, "draws g t"]:
    """Variances of the error by draws, without the last so many terms."""
    count = len(variance) - without
    return np.tensordot(likely.power[:, :count], variance[:count], axes=1)


def _shares(sets: Sequence[Likely], each: Sequence[np.ndarray], best: int) -> dict[str, float]:
    """Shares of the terms in the mean variance at the horizon, the largest first.

    `each` are the variances of the sets, (terms, filters, times), and `best` is the filter.
    """
    total: dict[str, float] = {}
    for likely, variance in zip(sets, each, strict=True):
        parts = likely.power.sum(axis=0) * variance[:, best, -1]
        count = len(variance) - likely.limited
        for label, part in zip(likely.labels[:count], parts, strict=False):
            total[label] = total.get(label, 0.0) + float(part)
    ordered = sorted(total.items(), key=lambda item: -item[1])
    whole = sum(total.values())
    return {label: part / whole for label, part in ordered}


def _estimate(axis: Axis, name: str, value: float, drawn: Float[np.ndarray, " draws"]) -> Estimate:
    low, high, low_68, high_68 = (float(x) for x in np.quantile(drawn, _QUANTILES))
    unit = "s" if name == "time" else default_coefficient_unit(axis.sensor, _EXPONENTS[name])
    return Estimate(
        axis=axis,
        label=_LABELS[name],
        value=float(value),
        std=(high_68 - low_68) / 2.0,
        interval=(low, high),
        interval_68=(low_68, high_68),
        unit=si_unit(unit),
        usual_unit=unit,
    )

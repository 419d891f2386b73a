"""Which white noise and random walk a filter needs that is corrected every so many seconds."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import ClassVar

import numpy as np
from jaxtyping import Float

from allanjax.base.equality import ByValue
from allanjax.base.errors import AllanjaxError, FitError
from allanjax.base.per_axis import PerAxis
from allanjax.base.wording import duration as length
from allanjax.base.wording import significant
from allanjax.estimate.coasting import (
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
from allanjax.record.recording import Axis
from allanjax.record.units import default_coefficient_unit, si_unit, unit_scale

_DRAWS = 400
_QUANTILES = (0.025, 0.975, 0.16, 0.84)
# Exponents of time in the units of N and K, and of the angle.
_EXPONENTS = {"white": 0.5, "walk": -0.5, "integral": 1.0}
# Share of the variance from which on a term is named.
_NAMED = 0.05


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class AxisHorizon(ByValue):
    """White noise and random walk for the filter of one axis, up to a horizon.

    The filter has estimated the bias from the sensor at rest, and integrates what it measures, less that
    bias. Its `error` is that of the angle (of the velocity). See `estimate.coasting`.

    Attributes:
        axis: whose it is.
        horizon: time between corrections [s].
        probability: that of the bounds.
        white, walk: the N and K whose predicted variance is the true one at the horizon, and closest to it
            in the largest ratio at shorter times, from a hundredth of the horizon on.
        mismatch: how many times larger or smaller the predicted standard deviation is there at most.
        bounding_white, bounding_walk: the N and K, SI, whose prediction is at none of these times below the
            true variance, at each with this probability; of all such pairs the one with the least mean
            logarithm of the predicted variance.
        raw_white, raw_walk: N and K of the fitted model, SI; zero if it has none.
        time: times [s] since the last correction.
        error: standard deviation of the error [rad or m/s] with `white` and `walk`, all terms included.
        raw_error, raw_prediction: the same with the raw N and K, and what these predict.
        bound: the standard deviation that the bounding pair predicts.
        shares: shares of the terms in the variance of the error at the horizon, the largest first.
        sets: how many likely sets of terms were averaged over.
    """

    axis: Axis
    horizon: float
    probability: float
    white: Estimate
    walk: Estimate
    mismatch: float
    bounding_white: float
    bounding_walk: float
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

    def causes(self) -> str:
        """The terms that make up the variance of the error at the horizon, in words."""
        told = [f"{title_of(k, self.axis)} {x:.0%}" for k, x in self.shares.items() if x >= _NAMED]
        return ", ".join(told)

    def _shown(self, name: str, value: float) -> str:
        unit = default_coefficient_unit(self.axis.sensor, _EXPONENTS[name])
        return f"{significant(value / unit_scale(unit, self.axis.sensor))} {unit}"

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
        error, bound = (self._shown("integral", float(x[-1])) for x in (self.error, self.bound))
        kind = "velocity" if self.axis.sensor == "accel" else "angle"
        cells.append((name, f"1σ of the {kind} after {length(self.horizon)}", error, bound))
        sets = f", averaged over {self.sets} likely sets of terms" if self.sets > 1 else ""
        told = f"with raw N and K it is {significant(self.raw_factor)} times what they predict"
        cells.append((name, f"{told}; it is made of {self.causes()}{sets}", "", ""))
        return cells

    def __repr__(self) -> str:
        white, walk = self.white.in_unit().describe(), self.walk.in_unit().describe()
        return f"<AxisHorizon {self.axis.name}, {length(self.horizon)}: N* {white}, K* {walk}>"

    def to_dataframe(self):  # type: ignore[no-untyped-def]  # pandas is imported late
        """Errors by time: of the matched pair, its prediction's bound, and with raw N and K, in SI."""
        import pandas as pd

        names = ("time", "error", "bound", "raw_error", "raw_prediction")
        return pd.DataFrame({"axis": self.axis.name, **{name: getattr(self, name) for name in names}})


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Horizon(ByValue, PerAxis[AxisHorizon]):
    """White noise and random walk for the filters of several axes, up to a horizon.

    Attributes:
        name: the recording's name.
        horizon: time between corrections [s].
        probability: that of the bounds.
        results: one an axis.
    """

    CALLED: ClassVar[str] = "the horizon"
    HEADINGS: ClassVar[tuple[str, ...]] = ("axis", "for the filter", "equal ± 1σ", "bound")
    ERROR: ClassVar[type[AllanjaxError]] = FitError

    name: str
    horizon: float
    probability: float
    results: tuple[AxisHorizon, ...]

    def _title(self) -> str:
        name = f"{self.name}: " if self.name else ""
        return f"{name}corrections every {length(self.horizon)}, bounds at {self.probability:.0%} probability"

    def _cells(self) -> list[tuple[str, str, str, str]]:
        return [row for result in self.results for row in result.rows()]


def horizon(
    fit: Fit,
    seconds: float,
    *,
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
        axes: names of axes; by default all that have a measurement.
        probability: that of the bounds.
        seed: of the draws of the coefficients.

    Raises:
        FitError: an axis without a measurement that was asked for, or no axis with one.
        AllanjaxError: a horizon or a probability out of range; a term that has no state space.
    """
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
    found = (_of_axis(fit, result, float(seconds), probability, seed) for result in results)
    return Horizon(fit.name, float(seconds), probability, tuple(found))


def _of_axis(fit: Fit, result: AxisFit, seconds: float, probability: float, seed: int) -> AxisHorizon:
    rate, record = fit.curve.rate, fit.curve.n / fit.curve.rate
    raw_N, raw_K = (_raw(result, name) for name in ("angle_random_walk", "rate_random_walk"))
    raw_memory = raw_N / raw_K if raw_K > 0.0 else record
    grid = memories(record, rate, [raw_memory])
    steps = coasting_steps(seconds, rate)
    unit = predicted(grid, steps, rate)
    sets = likely_models(fit, result.axis.name, _DRAWS, np.random.default_rng(seed))
    shared: dict[str, np.ndarray] = {}
    each = [actual(s.model, grid, steps, rate, record, shared) for s in sets]
    # The prediction is to be right on average over what the coefficients may be.
    draws = np.concatenate([_draws(s, V) for s, V in zip(sets, each, strict=True)])
    known = np.concatenate([_draws(s, V, s.limited) for s, V in zip(sets, each, strict=True)])
    mean = known.mean(axis=0)
    best, N, ratio = equal_pair(mean, unit)
    drawn = [equal_pair(V, unit) for V in known]
    pairs = np.array([(n, n / grid[k]) for k, n, _ in drawn])
    bounding, bounding_N = bounding_pair(np.quantile(draws, probability, axis=0), unit)
    raw = int(np.argmin(np.abs(np.log(grid / max(raw_memory, grid[0])))))
    return AxisHorizon(
        axis=result.axis,
        horizon=seconds,
        probability=probability,
        white=_estimate(result.axis, "white", N, pairs[:, 0]),
        walk=_estimate(result.axis, "walk", N / grid[best], pairs[:, 1]),
        mismatch=math.sqrt(ratio),
        bounding_white=bounding_N,
        bounding_walk=bounding_N / float(grid[bounding]),
        raw_white=raw_N,
        raw_walk=raw_K,
        time=steps / rate,
        error=np.sqrt(mean[best]),
        raw_error=np.sqrt(mean[raw]),
        raw_prediction=np.sqrt(_of_pair(raw_N, raw_K, grid[raw], steps, rate)),
        bound=bounding_N * np.sqrt(unit[bounding]),
        shares=_shares(sets, each, best),
        sets=len(sets),
    )


def _raw(result: AxisFit, label: str) -> float:
    """A coefficient of the fitted model, SI; zero if that has none."""
    found = result.coefficients.get(label)
    return float(found.value) if found is not None and found.value > 0.0 else 0.0


def _of_pair(
    N: float, K: float, memory: float, steps: Float[np.ndarray, " t"], rate: float
) -> Float[np.ndarray, " t"]:
    """Variance that a filter of N and K predicts; without K its memory is the record."""
    if N > 0.0:
        return N**2 * predicted(np.array([memory]), steps, rate)[0]
    return K**2 * memory**2 * predicted(np.array([memory]), steps, rate)[0]


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
    unit = default_coefficient_unit(axis.sensor, _EXPONENTS[name])
    return Estimate(
        axis=axis,
        label={"white": "white noise of the filter", "walk": "random walk of the filter"}[name],
        value=float(value),
        std=(high_68 - low_68) / 2.0,
        interval=(low, high),
        interval_68=(low_68, high_68),
        unit=si_unit(unit),
        usual_unit=unit,
    )

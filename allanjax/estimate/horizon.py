"""How long a sensor coasts: the bias model that a filter may use, and for how long it holds.

The filter has seen the sensor at rest for long, and has an estimate of the bias by a steady-state Kalman
filter for samples z_k = b_k + v_k with b_{k+1} = φ b_k + w_k, variances R = N²·rate and Q. The bias is a
random walk, φ = 1 and Q = K²/rate, or a first-order Gauss–Markov process of correlation time T driven by
noise of density K², φ = e^{−1/(T·rate)} and Q = K²T/2·(1 − φ²):

    P = φ²PR/(P + R) + Q,    g = P/(P + R),    b̂_k = φ b̂_{k−1} + g(z_k − φ b̂_{k−1}).

Then it integrates for n samples of h seconds, less φ^j b̂. It predicts for the integral the variance

    h²[s_n² PR/(P + R) + Q Σ_{k≤n} (s_k/φ)² + nR],    s_k = φ + … + φ^k,

which is right if the noise is as it believes. What it is for any other noise follows from the states of the
noise and b̂ together (Gelb, Applied Optimal Estimation, 1974, 7.2: the suboptimal filter's true covariance).

A Gauss–Markov process returns to zero. To its filter the bias is counted from its mean over the record of
length D, which is known; about it a random walk has the variance K²D/6.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, ClassVar, Literal, NamedTuple, cast, get_args

import numpy as np
from jaxtyping import Float

from allanjax.base.equality import ByValue
from allanjax.base.errors import AllanjaxError, FitError
from allanjax.base.per_axis import PerAxis
from allanjax.base.wording import duration as length
from allanjax.base.wording import finite_or_none, significant
from allanjax.estimate.as_json import in_both_units
from allanjax.estimate.likely_models import Likely, exact_model, likely_models
from allanjax.estimate.result import Fit
from allanjax.estimate.tables import Column, Number, as_html, as_text, column, tables_of
from allanjax.noise.datasheet import RATE, DataSheet
from allanjax.noise.estimate import Estimate, title_of
from allanjax.noise.model import Model
from allanjax.noise.state_space import Block, StateSpace, filtered_block, settled
from allanjax.noise.terms import DriftRamp, Markov, Sinusoid
from allanjax.record.recording import Axis
from allanjax.record.units import SENSORS, SI, Sensor, default_coefficient_unit, si_unit, unit_scale

#: How the filter models the bias.
Process = Literal["walk", "markov"]
SCHEMA_VERSION = 1
#: Exponents of time in the units of N and K, of the angle, and of the bias.
EXPONENTS = {"white": 0.5, "walk": -0.5, "integral": 1.0, "bias": 0.0}
# Share of the variance from which on a term is named.
_NAMED = 0.05
_SERIES = ("time", "error", "bound", "raw_error", "raw_prediction")
_DRAWS = 400
# Time at rest over which a filter by a data sheet has estimated the bias [s], if the horizon is no longer.
_AT_REST = 3600.0
# Memories and correlation times of the Gauss–Markov filters that are compared.
_MEMORIES, _TIMES = 25, 11
# Those whose true error is larger than the least by more than this factor are no filters to take.
_WORSE = 1.1
_QUANTILES = (0.025, 0.975, 0.16, 0.84)
_LABELS = {
    "white": "white noise of the filter",
    "walk": "random walk of the filter",
    "time": "correlation time of the filter",
}


class Filters(NamedTuple):
    """Filters of white noise and a process of the bias.

    Attributes:
        memory: N/K [s], over which a filter without mean reversion averages.
        correlation_time: that of the Gauss–Markov process [s], infinite of a walk.
        rate: sample rate [Hz].
    """

    memory: Float[np.ndarray, " g"]
    correlation_time: Float[np.ndarray, " g"]
    rate: float

    @classmethod
    def of_walk(cls, memory: Float[np.ndarray, " g"], rate: float) -> Filters:
        """Filters of a random walk."""
        return cls(memory, np.full(len(memory), np.inf), rate)

    @property
    def kept(self) -> Float[np.ndarray, " g"]:
        """φ, what is left of a bias after a sample."""
        return np.exp(-1.0 / (self.correlation_time * self.rate))

    @property
    def drive(self) -> Float[np.ndarray, " g"]:
        """Q/R, the variance of the bias's noise over that of a sample."""
        walk = (1.0 / (self.memory * self.rate)) ** 2
        x = 2.0 / (self.correlation_time * self.rate)
        return walk * np.where(x > 0.0, -np.expm1(-x) / np.where(x > 0.0, x, 1.0), 1.0)

    @property
    def gain(self) -> Float[np.ndarray, " g"]:
        """The gain g."""
        half = (self.drive + np.expm1(-2.0 / (self.correlation_time * self.rate))) / 2.0
        root = np.sqrt(half**2 + self.drive)
        # Of two forms the one without cancellation.
        P = np.where(half > 0.0, half + root, self.drive / (root - np.minimum(half, 0.0)))
        return P / (P + 1.0)

    def sums(
        self, steps: Float[np.ndarray, " t"]
    ) -> tuple[Float[np.ndarray, "g t"], Float[np.ndarray, "g t"]]:
        """s_n, and Σ_{k≤n} (s_k/φ)², after so many samples."""
        count, at = int(steps[-1]), steps.astype(int) - 1
        unique, which = np.unique(self.correlation_time, return_inverse=True)
        shares, squares = np.empty((2, len(unique), len(steps)))
        for k, time in enumerate(unique):
            kept = np.exp(-np.arange(count) / (time * self.rate))
            one = np.cumsum(kept)
            shares[k] = one[at] * np.exp(-1.0 / (time * self.rate))
            squares[k] = np.cumsum(one**2)[at]
        return shares[which], squares[which]


def predicted(filters: Filters, steps: Float[np.ndarray, " t"]) -> Float[np.ndarray, "g t"]:
    """Variance of the integral that filters of N = 1 predict after so many samples."""
    share, squares = filters.sums(steps)
    # The variance of b̂ after its update is PR/(P + R) = gR.
    own = share**2 * filters.gain[:, None] + filters.drive[:, None] * squares + steps
    return own / filters.rate


def actual(
    model: Model,
    filters: Filters,
    steps: Float[np.ndarray, " t"],
    duration: float,
    known: dict[str, np.ndarray] | None = None,
) -> Float[np.ndarray, "terms g t"]:
    """Variance of the integral's error [rad² or (m/s)²] after so many samples, of each term by itself.

    Args:
        model: the noise that there is.
        filters: whose error it is.
        steps: how many samples they integrate, in rising order.
        duration: how long the noise has gone on [s], for bias instability and the mean that is known.
        known: variances of terms that other sets have, too, for the same filters and times; it is added to.

    Raises:
        AllanjaxError: a term that has no state space.
    """
    labels = model.term_labels
    known = {} if known is None else known
    # One term at a time, and what it becomes after the response.
    alone = [model.without([*labels[:k], *labels[k + 1 :]]) for k in range(len(labels))]
    for one in alone:
        if repr(one) not in known:
            known[repr(one)] = _of_term(one, filters, steps, duration)
    return np.stack([known[repr(one)] for one in alone])


def _of_term(
    model: Model, filters: Filters, steps: Float[np.ndarray, " t"], duration: float
) -> Float[np.ndarray, "g t"]:
    """Variance of the integral's error for a model of one term."""
    (term,), rate = model.terms, filters.rate
    if isinstance(term, Sinusoid):
        return term.amplitude**2 / 2.0 * _line(term.frequency / rate, filters, steps) / rate**2
    if isinstance(term, DriftRamp):
        return (term.coefficient / rate**2) ** 2 * _ramp(filters, steps, duration)
    return _of_block(model.state_block(rate, duration), filters, steps, duration)


def _line(cycles: float, filters: Filters, steps: Float[np.ndarray, " t"]) -> Float[np.ndarray, "g t"]:
    """Squared response of the integral, in samples, to a line of so many cycles a sample."""
    z = np.exp(2j * np.pi * cycles)
    gain, share = filters.gain, filters.sums(steps)[0]
    estimate = gain / z / (1.0 - filters.kept * (1.0 - gain) / z)
    return np.abs((z**steps - 1.0) / (z - 1.0) - share * estimate[:, None]) ** 2


def _ramp(filters: Filters, steps: Float[np.ndarray, " t"], duration: float) -> Float[np.ndarray, "g t"]:
    """Mean square of the integral, in samples, of a ramp of one a sample about its mean over the record."""
    share, again = filters.sums(steps)[0], filters.kept * (1.0 - filters.gain)
    followed = (filters.gain / (1.0 - again))[:, None]
    # The estimate of a drifting bias lags behind.
    slope = steps * (steps + 1.0) / 2.0 + share * followed * (again / (1.0 - again))[:, None]
    # A walk's filter follows in full, but for rounding.
    missed = np.where(np.isinf(filters.correlation_time)[:, None], 0.0, steps - share * followed)
    return slope**2 + missed**2 * (duration * filters.rate) ** 2 / 12.0


def _of_block(
    block: Block, filters: Filters, steps: Float[np.ndarray, " t"], duration: float
) -> Float[np.ndarray, "g t"]:
    """Variance of the integral's error for noise of these states."""
    space = StateSpace.of(block, filters.rate, "gyro", "")
    sums = [space.sum_covariance(int(n)) for n in steps]
    seen = np.stack([transition[-1, :-1] for transition, _ in sums])
    added = np.array([noise[-1, -1] for _, noise in sums])
    A, n, found = block.transition, block.size, []
    # About its mean over the record a walk has the variance of a process that is forgotten in a third of it;
    # and so has, nearly, what is slower than the record.
    forgotten = np.append(np.full(n, np.exp(-3.0 / (duration * filters.rate))), 1.0)
    shares, again = filters.sums(steps)[0], filters.kept * (1.0 - filters.gain)
    for g, a, share, time in zip(filters.gain, again, shares, filters.correlation_time, strict=True):
        joint = filtered_block(block, np.array([g]), np.array([1.0, -a]), "estimate")
        if np.isinf(time):
            P = settled(joint.transition, joint.noise, joint.level)
        else:
            transition = joint.transition.copy()
            np.fill_diagonal(transition, np.diag(transition) * forgotten)
            P = settled(transition, joint.noise, np.zeros_like(joint.level))
        states = A @ P[:n, :n] @ A.T + block.noise
        shared = A @ P[:n, n]
        found.append(
            np.einsum("ti,ij,tj->t", seen, states, seen)
            - 2.0 * share * (seen @ shared)
            + share**2 * P[n, n]
            + added
        )
    return np.stack(found) / filters.rate**2


def equal_pair(truth: Float[np.ndarray, "g t"], unit: Float[np.ndarray, "g t"]) -> tuple[int, float, float]:
    """The filter whose prediction is closest to its true variance, its N, and the largest ratio of the two.

    At the last time they are equal; closest is in the largest ratio, either way, at the others. `unit` are
    the predictions for N = 1.
    """
    ratio = np.log(truth / unit)
    worst = np.abs(ratio - ratio[:, -1:]).max(axis=1)
    best = int(np.argmin(worst))
    return best, math.exp(ratio[best, -1] / 2.0), math.exp(worst[best])


def bounding_pair(truth: Float[np.ndarray, "g t"], unit: Float[np.ndarray, "g t"]) -> tuple[int, float]:
    """The filter whose prediction is nowhere below its true variance and least above it, and its N.

    Least in the mean of the logarithm over the times of their predicted variance.
    """
    scale = (truth / unit).max(axis=1)
    mean = np.log(scale) + np.log(unit).mean(axis=1)
    best = int(np.argmin(mean))
    return best, math.sqrt(float(scale[best]))


def memories(duration: float, rate: float, terms: Sequence[float] = (), count: int = 61) -> np.ndarray:
    """Times over which filters may average [s], from two samples to the record, and some given ones."""
    grid = np.geomspace(2.0 / rate, max(duration, 4.0 / rate), count)
    return np.unique(np.clip([*grid, *terms], grid[0], grid[-1]))


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class AxisHorizon(ByValue):
    """White noise and process of the bias for the filter of one axis, up to a horizon.

    The filter has estimated the bias from the sensor at rest and integrates the samples less that bias. Its
    `error` is that of the angle (or velocity). The filter models the bias as a random walk, or as a
    first-order Gauss–Markov process; K² is then the density of the noise that drives it.

    Attributes:
        axis: the axis.
        horizon: time between corrections [s].
        probability: probability of the bounds.
        white, walk: the N and K whose predicted variance equals the true one at the horizon and is closest to
            it, in the largest ratio, at shorter times down to a hundredth of the horizon.
        correlation_time: correlation time of the Gauss–Markov process, from a grid with steps of at most a
            factor of two; None for a walk.
        mismatch: largest ratio of the predicted standard deviation to the true one, either way.
        bounding_white, bounding_walk: the N and K [SI] whose predicted variance is nowhere below the true
            one, with this probability at each time; the pair with the least mean log variance.
        bounding_time: correlation time of the bounding process [s]; infinite for a walk.
        raw_white, raw_walk: N and K of the fitted model [SI]; zero if it has none.
        time: times [s] since the last correction.
        error: standard deviation of the error [rad or m/s] with `white` and `walk`, all terms included.
        raw_error, raw_prediction: the same with the raw N and K as a walk, and what these predict.
        bound: the standard deviation that the bounding pair predicts.
        shares: shares of the terms in the variance of the error at the horizon, the largest first.
        sets: number of likely sets of terms that were averaged over.
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
        """Ratio of the error at the horizon to what a filter with the raw N and K predicts; inf without."""
        predicted = float(self.raw_prediction[-1])
        return float(self.raw_error[-1]) / predicted if predicted > 0.0 else math.inf

    @property
    def bias_std(self) -> float:
        """Standard deviation of the Gauss–Markov process, SI; infinite for a walk."""
        time = self.correlation_time
        return math.inf if time is None else self.walk.value * math.sqrt(time.value / 2.0)

    @property
    def bounding_bias_std(self) -> float:
        """The same for the bounding process."""
        return self.bounding_walk * math.sqrt(self.bounding_time / 2.0)

    def causes(self) -> str:
        """The terms that make up the variance of the error at the horizon, in words."""
        shares = [
            f"{title_of(k, self.axis.sensor)} {100.0 * x:.0f} %"
            for k, x in self.shares.items()
            if x >= _NAMED
        ]
        return ", ".join(shares)

    def describe(self) -> str:
        """What a filter with the raw N and K gets wrong, and what the error is made of, in words."""
        sets = f"; averaged over {self.sets} likely sets of terms" if self.sets > 1 else ""
        raw = ""
        if math.isfinite(self.raw_factor):
            raw = f"with the raw N and K the error is ×{significant(self.raw_factor)} what they predict; "
        return f"{self.axis.name}: {raw}error from {self.causes()}{sets}"

    def to_dict(self) -> dict[str, Any]:
        """The numbers of the axis as plain dictionaries, lists, numbers and strings, for JSON."""
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
            "curves_si": {name: getattr(self, name).tolist() for name in _SERIES},
        }

    def __repr__(self) -> str:
        white, walk = self.white.in_unit().describe(), self.walk.in_unit().describe()
        time = "" if self.correlation_time is None else f", T* {self.correlation_time.describe()}"
        return f"<AxisHorizon {self.axis.name}, {length(self.horizon)}: N* {white}, K* {walk}{time}>"

    def to_dataframe(self):  # type: ignore[no-untyped-def]  # pandas is imported late
        """Errors by time, SI: of the matched pair, its bound, and with the raw N and K."""
        import pandas as pd

        return pd.DataFrame({"axis": self.axis.name, **{name: getattr(self, name) for name in _SERIES}})


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Horizon(ByValue, PerAxis[AxisHorizon]):
    """White noise and process of the bias for the filters of several axes, up to a horizon.

    Attributes:
        name: the recording's name.
        horizon: time between corrections [s].
        process: how the filters model the bias, "walk" or "markov".
        probability: probability of the bounds.
        results: one per axis.
        notes: for a data sheet, what was assumed and what it does not state.
    """

    CALLED: ClassVar[str] = "the horizon"
    ERROR: ClassVar[type[AllanjaxError]] = FitError

    name: str
    horizon: float
    process: Process
    probability: float
    results: tuple[AxisHorizon, ...]
    notes: tuple[str, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """The horizon as plain dictionaries, lists, numbers and strings, as `--json` prints it.

        `allanjax schema horizon` describes the keys.
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
        return as_text(self._title(), *self._printed())

    def _repr_html_(self) -> str:
        return as_html(self._title(), *self._printed())

    def _title(self) -> str:
        name = f"{self.name}: " if self.name else ""
        process = ", Gauss–Markov bias" if self.process == "markov" else ""
        probability = f"{100.0 * self.probability:.0f} %"
        return f"{name}corrections every {length(self.horizon)}{process}, bounds at {probability} probability"

    def _printed(self) -> tuple[list[list[Column]], list[str]]:
        """Tables with one row per axis, one per sensor, and the lines below them."""
        tables = []
        for sensor in SENSORS:
            of = [r for r in self.results if r.axis.sensor == sensor]
            error = f"{'velocity' if sensor == 'accel' else 'angle'} after {length(self.horizon)}"

            def numbers(head: str, name: str, values: Iterable[float], sensor: Sensor = sensor) -> Column:
                unit = default_coefficient_unit(sensor, EXPONENTS[name])
                return column(head, unit, [Number(x / unit_scale(unit, sensor)) for x in values])

            def estimates(head: str, values: Iterable[Estimate]) -> Column:
                shown = [c.in_unit() for c in values]
                return column(head, shown[0].unit, [Number(c.value, c.std) for c in shown])

            if of:
                times = [r.correlation_time for r in of if r.correlation_time is not None]
                main = [estimates("N*", (r.white for r in of)), estimates("K*", (r.walk for r in of))]
                if times:
                    main.append(column("T*", "s", [Number(c.value) for c in times]))
                    main.append(numbers("1σ of the bias", "bias", (r.bias_std for r in of)))
                others = [
                    numbers(error, "integral", (r.error[-1] for r in of)),
                    numbers("bound N", "white", (r.bounding_white for r in of)),
                    numbers("bound K", "walk", (r.bounding_walk for r in of)),
                    *([column("bound T", "s", [Number(r.bounding_time) for r in of])] if times else []),
                    numbers("bound error", "integral", (r.bound[-1] for r in of)),
                ]
                tables += tables_of([Column("axis", [r.axis.name for r in of])], main, others)
        about = (
            "N*, K*: with these the filter's predicted error is that of the model; bound: nowhere below it"
        )
        return tables, [about, *(r.describe() for r in self.results), *(f"note: {n}" for n in self.notes)]


class _Noise(NamedTuple):
    """Noise of an axis: N and K of the fitted model, SI, and the likely sets of terms."""

    axis: Axis
    raw: tuple[float, float]
    model: Model
    sets: Sequence[Likely]


def horizon(
    fit: Fit | DataSheet,
    seconds: float,
    *,
    process: Process = "walk",
    rate: float | None = None,
    axes: Sequence[str] | str | None = None,
    probability: float = 0.95,
    seed: int = 0,
) -> Horizon:
    """White noise and walk with which a filter's predicted error is that of the whole model, up to a horizon.

    A filter with two parameters estimates the bias from the sensor at rest and integrates its samples, less
    the bias, for up to `seconds`. The error of the angle (or velocity) then comes from all terms, including
    lines and terms behind a response. `white` and `walk` predict it as well as two numbers can; with the
    given probability, the bounding pair is never below it. Where the data cannot distinguish sets of terms,
    both are averaged over the likely sets.

    Args:
        fit: a result of `fit` or `load`; or a data sheet, taken as exact, with the bias estimated over one
            hour at rest, or over two horizons if that is longer.
        seconds: time between corrections [s], at least two samples and at most half the record.
        process: how the filter models the bias: as a random walk ("walk"), or as a first-order Gauss–Markov
            process ("markov"). Its correlation time is then estimated with the pair, among filters whose true
            error at the horizon is at most a tenth above the least. (A filter that soon forgets the bias may
            predict as well, but leaves the drift in the error.)
        rate: sample rate [Hz] for a data sheet, by default 100 Hz; a fit has its own.
        axes: names of axes; by default all with a measurement. The axes of a data sheet are its sensors.
        probability: probability of the bounds.
        seed: seed of the draws of the coefficients.

    Raises:
        FitError: a requested axis has no measurement, or no axis has one.
        AllanjaxError: the horizon, process or probability is out of range; a term has no state space.
    """
    if process not in get_args(Process):
        raise AllanjaxError(f"process (--process) must be walk or markov, not {process!r}")
    if isinstance(fit, DataSheet):
        rate, record = rate or RATE, max(_AT_REST, 2.0 * seconds)
    elif rate is not None:
        raise AllanjaxError("a fit has its own rate: leave out rate")
    else:
        rate, record = fit.curve.rate, fit.curve.n / fit.curve.rate
    if not 2.0 / rate <= seconds <= record / 2.0:
        raise AllanjaxError(
            f"the horizon must be from two samples, {2.0 / rate:g} s, to half the record, "
            f"{record / 2.0:g} s; got {seconds}"
        )
    if not 0.5 <= probability < 1.0:
        raise AllanjaxError(f"the probability of a bound must be from 0.5 to below 1, got {probability}")
    asked = [axes] if isinstance(axes, str) else axes
    noises = _noises(fit, asked, seed)
    if not noises:
        raise FitError("no axis has a measurement; print the fit to see why")
    found = (_of_axis(noise, float(seconds), process, probability, rate, record) for noise in noises)
    notes = fit.statements if isinstance(fit, DataSheet) else ()
    return Horizon(fit.name, float(seconds), process, probability, tuple(found), notes)


def _noises(fit: Fit | DataSheet, asked: Sequence[str] | None, seed: int) -> list[_Noise]:
    """Noise of the axes that are asked for, or of all that have a measurement."""
    if isinstance(fit, DataSheet):
        sensors = cast(Sequence[Sensor], asked or tuple(fit.models))
        axes = {s: Axis(s, s, SI[s]["rate"]) for s in sensors}
        return [_Noise(axes[s], _raw(fit.coefficients(s)), fit[s], [exact_model(fit[s])]) for s in sensors]
    results = [fit[name] for name in asked] if asked else [r for r in fit.values() if r.measured]
    for r in results:
        if not r.measured:
            raise FitError(f"{r.axis.name}: {r.verdict}")
    likely = (likely_models(fit, r.axis.name, _DRAWS, np.random.default_rng(seed)) for r in results)
    return [_Noise(r.axis, _raw(r.coefficients), r.model, s) for r, s in zip(results, likely, strict=True)]


def _of_axis(
    noise: _Noise, seconds: float, process: Process, probability: float, rate: float, record: float
) -> AxisHorizon:
    axis, (raw_N, raw_K), _, sets = noise
    raw = Filters.of_walk(
        np.array([np.clip(raw_N / raw_K if raw_K > 0.0 else record, 2 / rate, record)]), rate
    )
    filters, last = _filters(noise, seconds, process, rate, record), max(round(seconds * rate), 1)
    # From a hundredth of the horizon on.
    steps = np.unique(np.round(np.geomspace(max(last / 100.0, 1.0), last, 13)))
    # N of the filter with the raw coefficients; without N, what the walk is over its memory.
    raw_size = raw_N if raw_N > 0.0 else raw_K * float(raw.memory[0])
    unit, known, draws, each = _variances(sets, filters, steps, record)
    _, of_raw, _, _ = _variances(sets, raw, steps, record)
    # The prediction is to be right on average over what the coefficients may be.
    mean = known.mean(axis=0)
    good = np.arange(len(mean))
    if process == "markov":
        good = np.flatnonzero(mean[:, -1] <= _WORSE**2 * mean[:, -1].min())
    best, N, ratio = equal_pair(mean[good], unit[good])
    best = int(good[best])
    drawn = [equal_pair(V[good], unit[good]) for V in known]
    chosen, N_drawn = np.array([good[k] for k, _, _ in drawn]), np.array([n for _, n, _ in drawn])
    bounding, bounding_N = bounding_pair(np.quantile(draws, probability, axis=0), unit)
    time = filters.correlation_time
    return AxisHorizon(
        axis=axis,
        horizon=seconds,
        probability=probability,
        white=_estimate(axis, "white", N, N_drawn),
        walk=_estimate(axis, "walk", N / filters.memory[best], N_drawn / filters.memory[chosen]),
        correlation_time=(_estimate(axis, "time", time[best], time[chosen]) if process == "markov" else None),
        mismatch=math.sqrt(ratio),
        bounding_white=bounding_N,
        bounding_walk=bounding_N / float(filters.memory[bounding]),
        bounding_time=float(time[bounding]),
        raw_white=raw_N,
        raw_walk=raw_K,
        time=steps / rate,
        error=np.sqrt(mean[best]),
        raw_error=np.sqrt(of_raw.mean(axis=0)[0]),
        raw_prediction=raw_size * np.sqrt(predicted(raw, steps)[0]),
        bound=bounding_N * np.sqrt(unit[bounding]),
        shares=_shares(sets, each, best),
        sets=len(sets),
    )


def _filters(noise: _Noise, seconds: float, process: Process, rate: float, record: float) -> Filters:
    """The filters that are compared; that of the fitted model is one of them."""
    N, K = noise.raw
    if process == "walk":
        return Filters.of_walk(memories(record, rate, [N / K] if K > 0.0 else []), rate)
    own = [term for term in noise.model.terms if isinstance(term, Markov)]
    times = [float(term.correlation_time) for term in own]
    drives = [K, *(float(term.amplitude) for term in own)]
    memory = memories(record, rate, [N / q for q in drives if q > 0.0], _MEMORIES)
    # What returns sooner is white noise to a filter up to the horizon.
    grid = [*np.geomspace(max(seconds / 100.0, 2.0 / rate), record, _TIMES), *times]
    pairs = np.meshgrid(memory, np.unique(np.clip(grid, 2.0 / rate, record)), indexing="ij")
    return Filters(pairs[0].ravel(), pairs[1].ravel(), rate)


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


def _raw(coefficients: Mapping[str, Estimate]) -> tuple[float, float]:
    """N and K of the fitted model, SI; zero where it has none."""
    N, K = (coefficients.get(label) for label in ("angle_random_walk", "rate_random_walk"))
    return 0.0 if N is None else max(N.value, 0.0), 0.0 if K is None else max(K.value, 0.0)


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
    unit = "s" if name == "time" else default_coefficient_unit(axis.sensor, EXPONENTS[name])
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

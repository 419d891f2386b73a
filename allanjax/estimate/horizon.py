"""Coasting of a sensor: the model of the bias that a filter may use, and how long that model holds.

The filter has observed the sensor at rest for long, and has estimated the bias by a steady-state Kalman
filter for samples z_k = b_k + v_k with b_{k+1} = φ b_k + w_k, variances R = N²·rate and Q. The bias is a
random walk, φ = 1 and Q = K²/rate, or a first-order Gauss–Markov process of correlation time T driven by
noise of density K², φ = e^{−1/(T·rate)} and Q = K²T/2·(1 − φ²):

    P = φ²PR/(P + R) + Q,    g = P/(P + R),    b̂_k = φ b̂_{k−1} + g(z_k − φ b̂_{k−1}).

Then it integrates n samples of h seconds, less φ^j b̂. The variance that it predicts for the integral is

    h²[s_n² PR/(P + R) + Q Σ_{k≤n} (s_k/φ)² + nR],    s_k = φ + … + φ^k,

which is right if the noise is as the filter assumes. For any other noise it follows from the states of the
noise and b̂ together (Gelb, Applied Optimal Estimation, 1974, 7.2: the suboptimal filter's true covariance).

A Gauss–Markov process returns to zero. Its filter counts the bias from the known mean over the record of
length D; about that mean a random walk has the variance K²D/6.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, ClassVar, Literal, NamedTuple, cast, get_args

import numpy as np
from jaxtyping import Float, Int

from allanjax.base.equality import ByValue
from allanjax.base.errors import AllanjaxError, FitError
from allanjax.base.tables import PerAxis
from allanjax.base.wording import duration as length
from allanjax.base.wording import finite_or_none, percent, significant
from allanjax.estimate.as_json import in_both_units
from allanjax.estimate.likely_models import Likely, exact_model, likely_models, one_by_one
from allanjax.estimate.result import Fit
from allanjax.noise.datasheet import RATE, DataSheet
from allanjax.noise.estimate import Estimate, title_of
from allanjax.noise.model import Model, NoiseTerm
from allanjax.noise.state_space import Block, StateSpace, filtered_block, settled
from allanjax.noise.terms import DriftRamp, Markov, Sinusoid
from allanjax.noise.terms.deterministic import Transient
from allanjax.record.recording import Axis
from allanjax.record.units import SI, Sensor, default_coefficient_unit, si_unit, unit_scale

#: How the filter models the bias.
Process = Literal["walk", "markov"]
SCHEMA_VERSION = 1
# Exponents of time in the units of N and K, of the angle, and of the bias.
_EXPONENTS = {"white": 0.5, "walk": -0.5, "integral": 1.0, "bias": 0.0}
# Share of the variance above which a term is named.
_NAMED = 0.05
_SERIES = ("time", "error", "bound", "raw_error", "raw_prediction")
_DRAWS = 400
# Time at rest [s] over which the bias is estimated for a data sheet, unless the horizon is longer.
_AT_REST = 3600.0
# Memories of the walk's filters that are compared, and those and correlation times of Gauss–Markov filters.
_MEMORIES, _MARKOV_MEMORIES, _TIMES = 61, 25, 11
# Filters whose true error exceeds the smallest one by more than this factor are not chosen.
_WORSE = 1.1
_QUANTILES = (0.025, 0.975, 0.16, 0.84)


class Filters(NamedTuple):
    """Filters of a memory N/K and a correlation time [s], infinite for a walk, that integrate some steps.

    `gain` is g, `again` φ(1 − g), which is left of an estimate after a sample, `share` s_n, and `unit` the
    variance of the integral that filters of N = 1 predict.
    """

    memory: Float[np.ndarray, " g"]
    time: Float[np.ndarray, " g"]
    rate: float
    steps: Float[np.ndarray, " t"]
    gain: Float[np.ndarray, " g"]
    again: Float[np.ndarray, " g"]
    share: Float[np.ndarray, "g t"]
    unit: Float[np.ndarray, "g t"]

    @classmethod
    def of(cls, pairs: Float[np.ndarray, "g 2"], steps: Float[np.ndarray, " t"], rate: float) -> Filters:
        """Filters of these memories and correlation times [s]."""
        memory, time = pairs.T
        kept, x = np.exp(-1.0 / (time * rate)), 2.0 / (time * rate)
        lost = -np.expm1(-x)
        # Q/R, the variance of the bias's noise over that of a sample.
        drive = np.where(x > 0.0, lost / np.where(x > 0.0, x, 1.0), 1.0) / (memory * rate) ** 2
        half = (drive - lost) / 2.0
        root = np.sqrt(half**2 + drive)
        # P/R by the one of two forms that avoids cancellation.
        P = np.where(half > 0.0, half + root, drive / (root - np.minimum(half, 0.0)))
        gain, at = P / (P + 1.0), steps.astype(int) - 1
        # Sums over k of φ^(k−1), and of their squares; one correlation time after the other.
        unique, which = np.unique(kept, return_inverse=True)
        sums = (np.cumsum(phi ** np.arange(at[-1] + 1)) for phi in unique)
        both = np.array([(one[at], np.cumsum(one**2)[at]) for one in sums])[which]
        share = kept[:, None] * both[:, 0]
        # The variance of b̂ after its update is PR/(P + R) = gR.
        predicted = share**2 * gain[:, None] + drive[:, None] * both[:, 1] + steps
        return cls(memory, time, rate, steps, gain, kept * (1.0 - gain), share, predicted / rate)


def _variance(model: Model, filters: Filters, duration: float) -> Float[np.ndarray, "g t"]:
    """Variance of the integral's error [rad² or (m/s)²] for a model of one term, of this duration [s]."""
    (term,), rate, steps, share = model.terms, filters.rate, filters.steps, filters.share
    gain, again = filters.gain[:, None], filters.again[:, None]
    if isinstance(term, Transient):
        raise AllanjaxError(f"{term.name()} is not noise: leave out that part of the data, and the term")
    if isinstance(term, Sinusoid):
        z = np.exp(2j * np.pi * term.frequency / rate)
        error = (z**steps - 1.0) / (z - 1.0) - share * gain / (z - again)
        return term.amplitude**2 / 2.0 * np.abs(error / rate) ** 2
    if isinstance(term, DriftRamp):
        followed = share * gain / (1.0 - again)
        # The estimate of a drifting bias lags behind.
        slope = steps * (steps + 1.0) / 2.0 + followed * again / (1.0 - again)
        # About its mean over the record; a walk's filter follows that in full, except for rounding.
        missed = np.where(np.isinf(filters.time)[:, None], 0.0, steps - followed)
        error = slope**2 + missed**2 * (duration * rate) ** 2 / 12.0
        return (term.coefficient / rate**2) ** 2 * error
    block = _states(term, rate, duration)
    if model.response is not None:
        block = filtered_block(block, *model.response.sampled(rate).transfer(rate), "")
    return _of_states(block, filters, duration)


@functools.lru_cache(maxsize=64)
def _states(term: NoiseTerm, rate: float, duration: float) -> Block:
    """States of a term before its response; those of bias instability are found by a fit."""
    return term.sampled(rate).state_block(rate, duration)


def _of_states(block: Block, filters: Filters, duration: float) -> Float[np.ndarray, "g t"]:
    """Variance of the integral's error for noise of these states, from those and b̂ together."""
    space = StateSpace.of(block, filters.rate, "gyro", "")
    sums = [space.sum_covariance(int(n)) for n in filters.steps]
    observed = np.stack([transition[-1, :-1] for transition, _ in sums])
    added = np.array([noise[-1, -1] for _, noise in sums])
    A, H, n, gain = block.transition, block.observation, block.size, filters.gain[:, None]
    joint = np.zeros((len(gain), n + 1, n + 1))
    joint[:, :n, :n], joint[:, n, :n], joint[:, n, n] = A, gain * (H @ A), filters.again
    enters = np.concatenate([np.broadcast_to(np.eye(n), (len(gain), n, n)), (gain * H)[:, None]], axis=1)
    noise = enters @ block.noise @ enters.swapaxes(1, 2)
    noise[:, n, n] += filters.gain**2 * block.white
    # About its mean over the record a walk has the variance of a process with a correlation time of a third
    # of it; so has, nearly, anything slower than the record.
    walks, states = np.isinf(filters.time), np.arange(n)
    joint[:, states, states] *= np.where(walks, 1.0, math.exp(-3.0 / (duration * filters.rate)))[:, None]
    P, level = np.empty_like(joint), np.append(block.level, False)
    for own, walk in ((walks, level), (~walks, np.zeros_like(level))):
        P[own] = settled(joint[own], noise[own], walk)
    first = A @ P[:, :n, :n] @ A.T + block.noise
    shared = P[:, n, :n] @ A.T @ observed.T
    found = np.einsum("ti,gij,tj->gt", observed, first, observed, optimize=True) + added
    share = filters.share
    return (found - 2.0 * share * shared + share**2 * P[:, n, n, None]) / filters.rate**2


def _equal_pairs(
    truth: Float[np.ndarray, "draws g t"], unit: Float[np.ndarray, "g t"]
) -> tuple[Int[np.ndarray, " draws"], Float[np.ndarray, " draws"], Float[np.ndarray, " draws"]]:
    """The filter whose prediction is closest to its true variance, its N, and the largest ratio of the two.

    At the last time they are equal; at the others the largest ratio, either way, is smallest.
    """
    ratio = np.log(truth / unit)
    worst = np.abs(ratio - ratio[..., -1:]).max(axis=-1)
    best, draws = worst.argmin(axis=-1), np.arange(len(truth))
    return best, np.exp(ratio[draws, best, -1] / 2.0), np.exp(worst[draws, best])


def _bounding_pair(truth: Float[np.ndarray, "g t"], unit: Float[np.ndarray, "g t"]) -> tuple[int, float]:
    """The filter whose prediction is nowhere below its true variance and least in mean logarithm; its N."""
    scale = (truth / unit).max(axis=1)
    best = int(np.argmin(np.log(scale) + np.log(unit).mean(axis=1)))
    return best, math.sqrt(float(scale[best]))


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class AxisHorizon(ByValue):
    """White noise and process of the bias for the filter of one axis, up to a horizon.

    The filter has estimated the bias from the sensor at rest, and integrates the samples less that bias. Its
    `error` is that of the angle (of the velocity); see `estimate.horizon`. It models the bias as a random
    walk, or as a first-order Gauss–Markov process, which is a walk that returns to zero within the
    correlation time: K is then the root of the density of the noise that drives it.

    Attributes:
        axis: the axis.
        horizon: time between corrections [s].
        probability: probability of the bounds.
        white, walk: the N and K whose predicted variance is the true one at the horizon, and whose largest
            ratio to it at shorter times, from a hundredth of the horizon on, is closest to one.
        correlation_time: correlation time of the Gauss–Markov process, from a grid of values that are a
            factor of two apart or less; None for a walk.
        mismatch: largest factor between the predicted and the true standard deviation at these times.
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
        pairs = {"white": (self.white.value, self.raw_white), "walk": (self.walk.value, self.raw_walk)}
        return {name: new / raw if raw > 0.0 else math.inf for name, (new, raw) in pairs.items()}

    @property
    def raw_factor(self) -> float:
        """Error at the horizon over the one that a filter with raw N and K predicts; infinite without."""
        predicted = float(self.raw_prediction[-1])
        return float(self.raw_error[-1]) / predicted if predicted > 0.0 else math.inf

    @property
    def bias_std(self) -> float:
        """Standard deviation of the Gauss–Markov process, SI; infinite for a walk."""
        time = self.correlation_time
        return math.inf if time is None else self.walk.value * math.sqrt(time.value / 2.0)

    @property
    def bounding_bias_std(self) -> float:
        """Standard deviation of the bounding process, SI; infinite for a walk."""
        return self.bounding_walk * math.sqrt(self.bounding_time / 2.0)

    def causes(self) -> str:
        """The terms that make up the variance of the error at the horizon, in words."""
        named = {k: x for k, x in self.shares.items() if x >= _NAMED}
        return ", ".join(f"{title_of(k, self.axis.sensor)} {percent(x)}" for k, x in named.items())

    def rows(self) -> list[tuple[str, ...]]:
        """Rows of the printed table: the equal pair, the bound, and the fitted N and K."""
        # The table has no space for an interval of N beside a correlation time.
        T_c, N_ends = (0.0, self.white.interval) if (T := self.correlation_time) is None else (T.value, ())
        N, K, N_raw, K_raw = self.white.value, self.walk.value, self.raw_white, self.raw_walk
        N_max, K_max, T_max = self.bounding_white, self.bounding_walk, self.bounding_time
        error, bound, bias = self.error[-1], self.bound[-1], self.bounding_bias_std
        kinds = ("white", "white", "walk", "walk", "time", "bias", "integral", "integral")
        table: dict[str, tuple[Any, ...]] = {
            "equal": (N, N_ends, K, self.walk.interval, T_c, self.bias_std, error, error),
            "bound": (N_max, (), K_max, (), T_max, bias, bound, ()),
            "fitted": (N_raw, (), K_raw, (), (), (), self.raw_prediction[-1], self.raw_error[-1]),
        }
        return [(self.axis.name, pair, *map(self._shown, kinds, row)) for pair, row in table.items()]

    def _shown(self, kind: str, value: Any) -> str:
        """A value, or the ends of an interval, in the usual unit; nothing for those that are not positive."""
        unit, ends = _unit(self.axis.sensor, kind), np.atleast_1d(value)
        if not np.isfinite(ends).all() or not (np.diff(ends, prepend=0.0) > 0.0).all():
            return ""
        return " … ".join(significant(x / unit_scale(unit, self.axis.sensor)) for x in ends)

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
        """Errors over time in SI: of the matched pair, of the bound, and with raw N and K."""
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
        notes: for a data sheet, what was assumed and what it does not give.
    """

    ERROR: ClassVar[type[AllanjaxError]] = FitError

    name: str
    horizon: float
    process: Process
    probability: float
    results: tuple[AxisHorizon, ...]
    notes: tuple[str, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """The horizon as plain dictionaries, lists, numbers and strings, as `--json` prints it.

        `allanjax schema horizon` describes each of them.
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

    def _title(self) -> str:
        process = ", Gauss–Markov bias" if self.process == "markov" else ""
        return f"N and K for a filter that is corrected every {length(self.horizon)}{process}"

    def _heads(self, sensor: Sensor) -> list[str]:
        N, K, bias, error = (f"({_unit(sensor, x)})" for x in ("white", "walk", "bias", "integral"))
        pairs = [f"N {N}", f"95 % {N}", f"K {K}", f"95 % {K}", "T (s)", f"bias\n1σ {bias}"]
        return ["axis", "pair", *pairs, f"predicted\nerror {error}", f"true\nerror {error}"]

    def _notes(self) -> list[str]:
        kinds = {"gyro": "angle", "accel": "velocity"}
        errors = " or ".join(kinds[s] for s in dict.fromkeys(r.axis.sensor for r in self.results))
        explained = (
            f"error: 1σ of the {errors} after {length(self.horizon)}. equal: N and K that predict the true "
            "error. bound: N and K that predict at least the true error, with a probability of "
            f"{percent(self.probability)}. fitted: N and K of the fit without its other terms"
        )
        notes = [explained]
        for r in self.results:
            averaged = f"; averaged over {r.sets} likely sets of terms" if r.sets > 1 else ""
            notes.append(f"{r.axis.name}: true error from {r.causes()}{averaged}")
        return [*notes, *(f"note: {note}" for note in self.notes)]


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
    """White noise and random walk with which a filter predicts the whole model's error, up to a horizon.

    A filter with two parameters estimates the bias from the sensor at rest and integrates the samples, less
    the bias, for up to `seconds`. The error of the angle (or velocity) then comes from all terms, including
    lines and terms behind a response. The pair `white` and `walk` predicts it as well as two numbers can;
    the bounding pair is at no time below it, with the given probability of the coefficients. If the data do
    not distinguish sets of terms, both are averaged over the likely ones.

    Args:
        fit: what `fit` or `load` returned; or a data sheet, taken as exact, with the bias estimated over an
            hour at rest, or over two horizons if these are longer.
        seconds: time between corrections [s], at least two samples and at most half the record.
        process: how the filter models the bias: as a random walk, or ("markov") as a first-order Gauss–Markov
            process, whose correlation time is then chosen with the pair, among filters whose true error at
            the horizon is at most a tenth above the least. (A bias that is soon forgotten may predict as
            well, but leaves the drift in the error, which depends on how the model goes on for much longer.)
        rate: sample rate [Hz] for a data sheet, by default 100 Hz; a fit has its own.
        axes: names of axes; by default all that are a measurement. The axes of a data sheet are its sensors.
        probability: probability of the bounds.
        seed: seed of the draws of the coefficients.

    Raises:
        FitError: a requested axis, or every axis, is not a measurement of the sensor.
        AllanjaxError: a horizon, a process or a probability out of range; a term that has no state space.
    """
    if process not in get_args(Process):
        raise AllanjaxError(f"process= (--process) must be walk or markov, not {process!r}")
    if isinstance(fit, DataSheet):
        rate, record = rate or RATE, max(_AT_REST, 2.0 * seconds)
    elif rate is not None:
        raise AllanjaxError("rate= is for data sheets only, as a fit has its own sample rate; leave it out")
    else:
        rate, record = fit.curve.rate, fit.curve.n / fit.curve.rate
    if not 2.0 / rate <= seconds <= record / 2.0:
        raise AllanjaxError(
            f"seconds (--horizon) must be from {2.0 / rate:g} s (two samples) to {record / 2.0:g} s "
            f"(half the record), not {seconds:g} s"
        )
    if not 0.5 <= probability < 1.0:
        raise AllanjaxError(f"probability= (--probability) must be in [0.5, 1), not {probability}")
    question = _Question(float(seconds), process, probability, rate, record)
    noises = _noises(fit, [axes] if isinstance(axes, str) else axes, seed)
    found = tuple(_of_axis(question, *noise) for noise in noises)
    if not found:
        raise FitError("no axis is a measurement of the sensor; allanjax characterize prints the reasons")
    notes = fit.statements if isinstance(fit, DataSheet) else ()
    return Horizon(fit.name, float(seconds), process, probability, found, notes)


class _Question(NamedTuple):
    """The horizon [s], how a filter models the bias, and the rate [Hz] and length [s] of the record."""

    seconds: float
    process: Process
    probability: float
    rate: float
    record: float


def _noises(
    fit: Fit | DataSheet, asked: Sequence[str] | None, seed: int
) -> Iterator[tuple[Axis, Mapping[str, Estimate], Model, Sequence[Likely]]]:
    """Coefficients, model and likely sets of the axes that are asked for, or of all with a measurement."""
    if isinstance(fit, DataSheet):
        for s in cast(Sequence[Sensor], asked or tuple(fit.models)):
            yield Axis(s, s, SI[s]["rate"]), fit.coefficients(s), fit[s], [exact_model(fit[s])]
        return
    results = [fit[name] for name in asked] if asked else [r for r in fit.values() if r.measured]
    if missing := [r for r in results if not r.measured]:
        raise FitError(f"{missing[0].axis.name}: {missing[0].verdict}")
    for r in results:
        sets = likely_models(fit, r.axis.name, _DRAWS, np.random.default_rng(seed))
        yield r.axis, r.coefficients, r.model, sets


def _of_axis(
    question: _Question,
    axis: Axis,
    coefficients: Mapping[str, Estimate],
    model: Model,
    sets: Sequence[Likely],
) -> AxisHorizon:
    """Horizon of one axis."""
    seconds, process, probability, rate, record = question
    labels = ("angle_random_walk", "rate_random_walk")
    N, K = (max(coefficients[x].value, 0.0) if x in coefficients else 0.0 for x in labels)
    last = max(round(seconds * rate), 1)
    # From a hundredth of the horizon on.
    steps = np.unique(np.round(np.geomspace(max(last / 100.0, 1.0), last, 13)))
    filters = Filters.of(_pairs(question, N, K, model), steps, rate)
    memory, time, unit = filters.memory, filters.time, filters.unit
    # Sets share terms.
    variance = functools.cache(lambda one: _variance(one, filters, record))
    known, draws, shares = list[np.ndarray](), list[np.ndarray](), Counter[str]()
    each = [(s, np.stack([variance(one) for one in one_by_one(s.model)])) for s in sets]
    for s, V in each:
        detected = len(V) - s.limited
        known.append(np.tensordot(s.power[:, :detected], V[:detected], axes=1))
        # Undetected terms have limits only; these are in the bound.
        draws.append(np.tensordot(s.power, V, axes=1))
    # The prediction must be right on average over the likely coefficients.
    every = np.concatenate(known)
    mean = every.mean(axis=0)
    # The last filter is that of the raw coefficients; without N, the walk over its memory.
    good, raw_size = np.arange(len(mean) - 1), N or K * float(memory[-1])
    if process == "markov":
        good = np.flatnonzero(mean[:-1, -1] <= _WORSE**2 * mean[:-1, -1].min())
    place, white, ratio = _equal_pairs(np.concatenate([mean[None], every])[:, good], unit[good])
    chosen = good[place]
    for s, V in each:
        parts = s.power.sum(axis=0) * V[:, chosen[0], -1] / len(every) / mean[chosen[0], -1]
        shares.update(dict(zip(s.labels[: len(V) - s.limited], parts.tolist(), strict=False)))
    bounding, bounding_N = _bounding_pair(
        np.quantile(np.concatenate(draws)[:, :-1], probability, axis=0), unit[:-1]
    )
    return AxisHorizon(
        axis=axis,
        horizon=seconds,
        probability=probability,
        white=_estimate(axis, "white", white),
        walk=_estimate(axis, "walk", white / memory[chosen]),
        correlation_time=_estimate(axis, "time", time[chosen]) if process == "markov" else None,
        mismatch=math.sqrt(ratio[0]),
        bounding_white=bounding_N,
        bounding_walk=bounding_N / float(memory[bounding]),
        bounding_time=float(time[bounding]),
        raw_white=N,
        raw_walk=K,
        time=steps / rate,
        error=np.sqrt(mean[chosen[0]]),
        raw_error=np.sqrt(mean[-1]),
        raw_prediction=raw_size * np.sqrt(unit[-1]),
        bound=bounding_N * np.sqrt(unit[bounding]),
        shares=dict(shares.most_common()),
        sets=len(sets),
    )


def _pairs(question: _Question, N: float, K: float, model: Model) -> Float[np.ndarray, "g 2"]:
    """Memory and correlation time [s] of filters that are compared, and at last those of N and K."""
    seconds, process, _, rate, record = question
    shortest, own = 2.0 / rate, [term for term in model.terms if isinstance(term, Markov)]
    count, drives, times = _MEMORIES, [K], np.array([math.inf])
    if process == "markov":
        count, drives = _MARKOV_MEMORIES, [K, *(float(term.amplitude) for term in own)]
        # A process that returns sooner is white noise for a filter up to the horizon.
        grid = np.geomspace(max(seconds / 100.0, shortest), record, _TIMES)
        times = np.unique(np.clip([*grid, *(float(t.correlation_time) for t in own)], shortest, record))
    memories = [*np.geomspace(shortest, record, count), *(N / q for q in drives if q > 0.0)]
    compared = np.meshgrid(np.unique(np.clip(memories, shortest, record)), times, indexing="ij")
    raw = np.clip(N / K if K > 0.0 else record, shortest, record)
    return np.append(np.reshape(compared, (2, -1)).T, [[raw, math.inf]], axis=0)


def _unit(sensor: Sensor, name: str) -> str:
    """Usual unit of N, K, an angle, a bias or a time."""
    return "s" if name == "time" else default_coefficient_unit(sensor, _EXPONENTS[name])


def _estimate(axis: Axis, name: str, values: Float[np.ndarray, " draws+1"]) -> Estimate:
    """A value, the first one, with intervals from draws."""
    low, high, low_68, high_68 = np.quantile(values[1:], _QUANTILES).tolist()
    unit = _unit(axis.sensor, name)
    label = {"white": "white noise", "walk": "random walk", "time": "correlation time"}[name]
    return Estimate(
        axis=axis,
        label=f"{label} of the filter",
        value=float(values[0]),
        std=(high_68 - low_68) / 2.0,
        interval=(low, high),
        interval_68=(low_68, high_68),
        unit=si_unit(unit),
        usual_unit=unit,
    )

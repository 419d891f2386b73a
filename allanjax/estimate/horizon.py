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
from typing import Any, ClassVar, Literal, NamedTuple, TypeAlias, cast, get_args

import numpy as np
from jaxtyping import Float

from allanjax.base.equality import ByValue
from allanjax.base.errors import AllanjaxError, FitError, expect
from allanjax.base.tables import PerAxis
from allanjax.base.wording import duration as length
from allanjax.base.wording import percent, significant
from allanjax.estimate.as_json import in_both_units, in_json
from allanjax.estimate.likely_models import Likely, exact_model, side_by_side
from allanjax.estimate.result import Fit
from allanjax.noise.datasheet import NOT_GIVEN, RATE, DataSheet
from allanjax.noise.estimate import Estimate, title_of
from allanjax.noise.model import Model
from allanjax.noise.state_space import StateSpace, settled
from allanjax.noise.terms import DriftRamp, Markov
from allanjax.record.recording import Axis
from allanjax.record.units import SI, Sensor, default_coefficient_unit, unit_scale

#: How the filter models the bias.
Process = Literal["walk", "markov"]
SCHEMA_VERSION = 1
# Exponents of time in the units of N and K, of the angle, and of the bias.
_EXPONENTS = {"white": 0.5, "walk": -0.5, "integral": 1.0, "bias": 0.0}
_SERIES = ("time", "error", "bound", "raw_error", "raw_prediction")
# Share of the variance above which a term is named.
_NAMED = 0.05
_DRAWS = 400
# Time at rest [s] over which the bias is estimated for a data sheet, unless the horizon is longer.
_AT_REST = 3600.0
# Memories of the walk's filters that are compared, and those and correlation times of Gauss–Markov filters.
_MEMORIES, _MARKOV_MEMORIES, _TIMES = 61, 25, 11
# Filters whose true error exceeds the smallest one by more than this factor are not chosen.
_WORSE = 1.1
_QUANTILES = (0.025, 0.975, 0.16, 0.84)
_Times: TypeAlias = Float[np.ndarray, " t"]


class _Noise(NamedTuple):
    """An axis: its coefficients, model and likely sets of terms, and which of N, B and K are not given."""

    axis: Axis
    coefficients: Mapping[str, Estimate]
    model: Model
    sets: Sequence[Likely]
    lacking: tuple[str, ...]


class _Filters:
    """Filters of a memory N/K and a correlation time [s], infinite for a walk, that integrate some steps.

    `gain` is g, `again` φ(1 − g), which is left of an estimate after a sample, `share` s_n, and `unit` the
    variance of the integral that filters of N = 1 predict.
    """

    @np.errstate(invalid="ignore")
    def __init__(self, pairs: Float[np.ndarray, "g 2"], steps: _Times, rate: float) -> None:
        """Filters of these memories and correlation times [s]."""
        self.steps, self.rate = steps, rate
        self.memory, self.time = pairs.T
        log = -1.0 / (self.time * rate)
        twice, kept = np.expm1(2.0 * log), np.exp(log)
        # Q/R, the variance of the bias's noise over that of a sample.
        drive = np.where(log < 0.0, twice / (2.0 * log), 1.0) / (self.memory * rate) ** 2
        half = (drive + twice) / 2.0
        root = np.sqrt(half**2 + drive)
        # P/R by the one of two forms that avoids cancellation.
        P = np.where(half > 0.0, half + root, drive / (root - np.minimum(half, 0.0)))
        self.gain = P / (P + 1.0)
        self.again = kept * (1.0 - self.gain)
        # s_k/φ at the steps, and the sums of their squares; one correlation time after the other.
        unique, which = np.unique(kept, return_inverse=True)
        at = steps.astype(int) - 1
        partial = (np.cumsum(phi ** np.arange(at[-1] + 1)) for phi in unique)
        sums, squares = np.array([(s[at], np.cumsum(s**2)[at]) for s in partial])[which].swapaxes(0, 1)
        self.share = kept[:, None] * sums
        # The variance of b̂ after its update is PR/(P + R) = gR.
        self.unit = (self.share**2 * self.gain[:, None] + drive[:, None] * squares + steps) / rate

    def variance(self, model: Model, duration: float) -> Float[np.ndarray, "g t"]:
        """True variance of the integral [rad² or (m/s)²] for a model of one term, of this duration [s]."""
        (term,), gain, steps = model.terms, self.gain[:, None], self.steps.astype(int).tolist()
        block = _states(model, self.rate, duration)
        A, H, n = block.transition, block.observation, block.size
        space = StateSpace.of(block, self.rate, "gyro", "")
        sums, states, followed = [space.sum_covariance(n) for n in steps], np.arange(n), gain * (H @ A)
        observed = np.stack([transition[-1, :-1] for transition, _ in sums])
        # The error is linear in the states and b̂ at the last sample, and in the noise after it.
        ahead = np.broadcast_to(observed @ A, (len(gain), *observed.shape))
        if term.deterministic:
            # The estimate follows the states of a line, or of a ramp that is somewhere about its mean.
            joint = A.T - self.again[:, None, None] * np.eye(n)
            rows = ahead - self.share[:, :, None] * np.linalg.solve(joint, followed[..., None])[:, None, :, 0]
            ramp = isinstance(term, DriftRamp)
            P = block.start[1, 1] * np.diag([duration**2 / 12.0, 1.0]) if ramp else block.start
            return np.einsum("gti,ij,gtj->gt", rows, P, rows, optimize=True) / self.rate**2
        rows = np.concatenate([ahead, -self.share[:, :, None]], axis=2)
        joint = np.zeros((len(gain), n + 1, n + 1))
        joint[:, :n, :n], joint[:, n, :n], joint[:, n, n] = A, followed, self.again
        enters = np.concatenate([np.broadcast_to(np.eye(n), (len(gain), n, n)), (gain * H)[:, None]], axis=1)
        noise = enters @ block.noise @ enters.swapaxes(1, 2)
        noise[:, n, n] += self.gain**2 * block.white
        # About its mean over the record a walk has the variance of a process with a correlation time of a
        # third of it; so has, nearly, anything slower than the record.
        walks = np.isinf(self.time)
        joint[:, states, states] *= np.where(walks, 1.0, math.exp(-3.0 / (duration * self.rate)))[:, None]
        P, level = np.empty_like(joint), np.append(block.level, False)
        for own, walk in ((walks, level), (~walks, np.zeros_like(level))):
            P[own] = settled(joint[own], noise[own], walk)
        later = np.einsum("ti,ij,tj->t", observed, block.noise, observed) + [Q[-1, -1] for _, Q in sums]
        return (np.einsum("gti,gij,gtj->gt", rows, P, rows, optimize=True) + later) / self.rate**2


# States of models, kept for other axes, since those of bias instability are found by a fit.
_states = functools.lru_cache(maxsize=64)(Model.state_block)


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class AxisHorizon(ByValue):
    """White noise and process of the bias for the filter of one axis, up to a horizon; see `horizon`.

    Attributes:
        axis, horizon, probability: the axis, time between corrections [s], and probability of the bounds.
        white, walk: the N and K whose predicted variance is the true one at the horizon, and whose largest
            ratio to it at shorter times, from a hundredth of the horizon on, is closest to one. K² is the
            density of the noise that drives the bias.
        correlation_time: correlation time of the Gauss–Markov process; None for a walk.
        mismatch: largest factor between the predicted and the true standard deviation at these times.
        bounding_white, bounding_walk, bounding_time: the N and K, SI, and the time [s], infinite for a walk,
            whose prediction is at none of these times below the true variance, at each with this probability,
            and has the least mean logarithm.
        raw_white, raw_walk: N and K of the fitted model, SI; zero if it has none.
        time: times [s] since the last correction.
        error: standard deviation of the angle or velocity [rad or m/s], of all terms, with that pair.
        raw_error, raw_prediction: the same with the raw N and K, as a walk, and what these predict.
        bound: the standard deviation that the bounding pair predicts.
        shares: shares of the terms in the variance of the error at the horizon, the largest first.
        sets: how many likely sets of terms were averaged over.
        lacking: which of N, B and K are not given. Then the errors are lower bounds and nothing bounds them
            from above; `mismatch`, the bounding and the missing raw values are nan, without B and K the
            `walk` and `correlation_time`, too, and `shares` is empty.
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
    time: _Times
    error: _Times
    raw_error: _Times
    raw_prediction: _Times
    bound: _Times
    shares: Mapping[str, float]
    sets: int = 1
    lacking: tuple[str, ...] = ()

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
        time = self.bounding_time
        return math.inf if math.isinf(time) else self.bounding_walk * math.sqrt(time / 2.0)

    def causes(self) -> str:
        """The terms that make up the variance of the error at the horizon, in words."""
        named = {k: x for k, x in self.shares.items() if x >= _NAMED}
        return ", ".join(f"{title_of(k, self.axis.sensor)} {percent(x)}" for k, x in named.items())

    def rows(self) -> list[tuple[str, ...]]:
        """Rows of the printed table: the equal pair, the bound, and the fitted N and K."""
        # The table has no space for an interval of N beside a correlation time.
        T_c, N_ends = (0.0, self.white.interval) if (T := self.correlation_time) is None else (T.value, ())
        error, bound, *raw = (x[-1] for x in (self.error, self.bound, self.raw_prediction, self.raw_error))
        N, K, N_max, K_max = self.white.value, self.walk, self.bounding_white, self.bounding_walk
        kinds = ("white", "white", "walk", "walk", "time", "bias", "integral", "integral")
        table: dict[str, tuple[Any, ...]] = {
            "equal": (N, N_ends, K.value, K.interval, T_c, self.bias_std, error, error),
            "bound": (N_max, (), K_max, (), self.bounding_time, self.bounding_bias_std, bound, ()),
            "fitted": (self.raw_white, (), self.raw_walk, (), (), (), *raw),
        }
        return [(self.axis.name, pair, *map(self._shown, kinds, row)) for pair, row in table.items()]

    def _shown(self, kind: str, value: Any) -> str:
        """A value, or the ends of an interval, in the usual unit; nothing for those that are not positive."""
        unit, ends = _unit(self.axis.sensor, kind), np.atleast_1d(value)
        if len(ends) == 1 and np.isnan(ends[0]):
            return NOT_GIVEN
        if not np.isfinite(ends).all() or not (np.diff(ends, prepend=0.0) > 0.0).all():
            return ""
        least = "≥ " if self.lacking and kind == "integral" and len(ends) else ""
        return least + " … ".join(significant(x / unit_scale(unit, self.axis.sensor)) for x in ends)

    def to_dict(self) -> dict[str, Any]:
        """The numbers of the axis as plain dictionaries, lists, numbers and strings, for JSON."""
        pair = {"white": self.white, "walk": self.walk, "correlation_time": self.correlation_time}
        bounding = {"correlation_time": self.bounding_time, "bias_std": self.bounding_bias_std}
        numbers = {
            "bias_std_si": self.bias_std,
            "mismatch": self.mismatch,
            "bounding_si": {"white": self.bounding_white, "walk": self.bounding_walk, **bounding},
            "raw_si": {"white": self.raw_white, "walk": self.raw_walk},
            "inflation": self.inflation,
            "raw_factor": self.raw_factor,
            "shares": self.shares,
            "sets": self.sets,
            "not_given": self.lacking,
            "curves_si": {name: getattr(self, name) for name in _SERIES},
        }
        both = {name: x and in_both_units(x) for name, x in pair.items()}
        return {"name": self.axis.name, "sensor": self.axis.sensor, **both, **in_json(numbers)}

    def __repr__(self) -> str:
        walk = NOT_GIVEN if math.isnan(self.walk.value) else self.walk.in_unit().describe()
        white = self.white.in_unit().describe()
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
        name, horizon, probability: the recording's name, and as in `AxisHorizon`.
        process: how the filters model the bias, "walk" or "markov".
        results: one per axis.
        notes: for a data sheet, what was assumed and what it does not give; for a curve of unknown length,
            that there are no intervals and no bound.
    """

    ERROR: ClassVar[type[AllanjaxError]] = FitError

    name: str
    horizon: float
    process: Process
    probability: float
    results: tuple[AxisHorizon, ...]
    notes: tuple[str, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """The horizon as plain dictionaries, lists, numbers and strings; see `allanjax schema horizon`."""
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
        notes = [
            f"error: 1σ of the {errors} after {length(self.horizon)}. equal: N and K that predict the true "
            "error. bound: N and K that predict at least the true error, with a probability of "
            f"{percent(self.probability)}. fitted: N and K as fitted, "
            "without allowing for the other terms"
        ]
        for r in self.results:
            averaged = f"; averaged over {r.sets} likely sets of terms" if r.sets > 1 else ""
            told = f"true error from {r.causes()}{averaged}"
            if r.lacking:
                told = f"error at least this (≥), as {' and '.join(r.lacking)} {NOT_GIVEN}; no bound"
            notes.append(f"{r.axis.name}: {told}")
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
            the horizon is at most a tenth above the least (a bias that is soon forgotten may predict as well,
            but leaves the drift in the error).
        rate: sample rate [Hz] for a data sheet, by default 100 Hz; a fit has its own.
        axes: names of axes; by default all that are a measurement. The axes of a data sheet are its sensors.
        probability: probability of the bounds.
        seed: seed of the draws of the coefficients.

    Raises:
        FitError: a requested axis, or every axis, is not a measurement of the sensor.
        AllanjaxError: a horizon, a process or a probability out of range; a term that has no state space.
    """
    expect(fit, (Fit, DataSheet), "horizon takes a fit or a data sheet, e.g. allanjax.datasheet('BMI088')")
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
    found = tuple(map(question.answered, _noises(fit, [axes] if isinstance(axes, str) else axes, seed)))
    if not found:
        raise FitError("no axis is a measurement of the sensor; allanjax characterize prints the reasons")
    if isinstance(fit, Fit) and not fit.curve.determined:
        found = tuple(map(_without_bound, found))
    notes = fit.statements if isinstance(fit, DataSheet) else fit.curve.unknown
    return Horizon(fit.name, float(seconds), process, probability, found, notes)


def _noises(fit: Fit | DataSheet, asked: Sequence[str] | None, seed: int) -> Iterator[_Noise]:
    """The axes that are asked for, or all with a measurement."""
    if isinstance(fit, DataSheet):
        for s in cast(Sequence[Sensor], asked or tuple(fit.models)):
            axis, sets = Axis(s, s, SI[s]["rate"]), [exact_model(fit[s])]
            yield _Noise(axis, fit.coefficients(s), fit[s], sets, fit.lacking(s))
        return
    results = [fit[name] for name in asked] if asked else [r for r in fit.values() if r.measured]
    if missing := [r for r in results if not r.measured]:
        raise FitError(f"{missing[0].axis.name}: {missing[0].verdict}")
    for r in results:
        sets = fit.stated(r.axis.name).models(_DRAWS, np.random.default_rng(seed))
        yield _Noise(r.axis, r.coefficients, r.model, sets, r.lacking)


class _Question(NamedTuple):
    """The horizon [s], how a filter models the bias, and the rate [Hz] and length [s] of the record."""

    seconds: float
    process: Process
    probability: float
    rate: float
    record: float

    def pairs(self, N: float, K: float, model: Model) -> Float[np.ndarray, "g 2"]:
        """Memory and correlation time [s] of filters that are compared, and at last those of N and K."""
        shortest, record, count = 2.0 / self.rate, self.record, _MEMORIES
        drives, times = [K], np.array([math.inf])
        if self.process == "markov":
            own = [term for term in model.terms if isinstance(term, Markov)]
            count, drives = _MARKOV_MEMORIES, [K, *(float(term.amplitude) for term in own)]
            # A process that returns sooner is white noise for a filter up to the horizon.
            grid = np.geomspace(max(self.seconds / 100.0, shortest), record, _TIMES)
            times = np.unique(np.clip([*grid, *(float(t.correlation_time) for t in own)], shortest, record))
        memories = [*np.geomspace(shortest, record, count), *(N / q for q in drives if q > 0.0)]
        compared = np.meshgrid(np.unique(np.clip(memories, shortest, record)), times, indexing="ij")
        raw = np.clip(N / K if K > 0.0 else record, shortest, record)
        return np.append(np.reshape(compared, (2, -1)).T, [[raw, math.inf]], axis=0)

    def answered(self, noise: _Noise) -> AxisHorizon:
        """Horizon of one axis."""
        axis = noise.axis
        raw = (noise.coefficients.get(x) for x in ("angle_random_walk", "rate_random_walk"))
        N, K = (0.0 if c is None else max(c.value, 0.0) for c in raw)
        last = max(round(self.seconds * self.rate), 1)
        # From a hundredth of the horizon on.
        steps = np.unique(np.round(np.geomspace(max(last / 100.0, 1.0), last, 13)))
        # The last filter is that of the raw coefficients; without N, the walk over its memory.
        filters = _Filters(self.pairs(N, K, noise.model), steps, self.rate)
        memory, time, unit = filters.memory, filters.time, filters.unit
        labels, terms, power, detected, _ = side_by_side(noise.sets)
        # Sets share terms.
        variance = functools.cache(lambda one: filters.variance(one, self.record))
        V = np.stack([variance(one) for one in terms])
        draws = np.tensordot(power[:, detected], V[detected], axes=1)
        # The prediction must be right on average over the likely coefficients.
        mean = draws.mean(axis=0)
        good = np.arange(len(mean) - 1)
        if self.process == "markov":
            good = np.flatnonzero(mean[:-1, -1] <= _WORSE**2 * mean[:-1, -1].min())
        # Where prediction and truth are equal at the last time, their largest ratio, either way, is smallest.
        ratio = np.log(np.concatenate([mean[None], draws])[:, good] / unit[good])
        worst = np.abs(ratio - ratio[..., -1:]).max(axis=-1)
        place, each = worst.argmin(axis=-1), np.arange(len(ratio))
        white, chosen, best = np.exp(ratio[each, place, -1] / 2.0), good[place], good[place[0]]
        shares: Any = Counter()
        for k in np.flatnonzero(detected).tolist():
            shares[labels[k]] += float(power[:, k].mean() * V[k, best, -1] / mean[best, -1])
        # The bound is nowhere below the truth, and least in mean logarithm. It includes undetected terms,
        # which have limits only.
        upper = np.quantile(np.tensordot(power, V[:, :-1], axes=1), self.probability, axis=0)
        most = (upper / unit[:-1]).max(axis=1)
        outer = int(np.argmin(np.log(most) + np.log(unit[:-1]).mean(axis=1)))
        N_max = math.sqrt(float(most[outer]))
        found = AxisHorizon(
            axis=axis,
            horizon=self.seconds,
            probability=self.probability,
            white=_estimate(axis, "white", white),
            walk=_estimate(axis, "walk", white / memory[chosen]),
            correlation_time=_estimate(axis, "time", time[chosen]) if self.process == "markov" else None,
            mismatch=math.exp(worst[0, place[0]] / 2.0),
            bounding_white=N_max,
            bounding_walk=N_max / float(memory[outer]),
            bounding_time=float(time[outer]),
            raw_white=N,
            raw_walk=K,
            time=steps / self.rate,
            error=np.sqrt(mean[best]),
            raw_error=np.sqrt(mean[-1]),
            raw_prediction=(N or K * float(memory[-1])) * np.sqrt(unit[-1]),
            bound=N_max * np.sqrt(unit[outer]),
            shares=dict(shares.most_common()),
            sets=len(noise.sets),
        )
        return _without_unknown(found, noise.lacking) if noise.lacking else found


def _without_unknown(r: AxisHorizon, lacking: tuple[str, ...]) -> AxisHorizon:
    """The horizon without what depends on coefficients that are not given."""
    names = [name for symbol, name in (("N", "raw_white"), ("K", "raw_walk")) if symbol in lacking]
    unknown: dict[str, Any] = dict.fromkeys(["mismatch", *names], math.nan)
    if {"B", "K"} <= {*lacking}:
        unknown["walk"] = r.walk.times(math.nan)
        unknown["correlation_time"] = r.correlation_time and r.correlation_time.times(math.nan)
    return dataclasses.replace(_without_bound(r), **unknown, shares={}, lacking=lacking)


def _without_bound(r: AxisHorizon) -> AxisHorizon:
    """The horizon where nothing is known that bounds the errors from above."""
    time = math.inf if math.isinf(r.bounding_time) else math.nan
    bound = np.full_like(r.bound, np.nan)
    nothing: dict[str, Any] = {"bounding_white": math.nan, "bounding_walk": math.nan, "bounding_time": time}
    return dataclasses.replace(r, **nothing, bound=bound)


def _unit(sensor: Sensor, name: str) -> str:
    """Usual unit of N, K, an angle, a bias or a time."""
    return "s" if name == "time" else default_coefficient_unit(sensor, _EXPONENTS[name])


def _estimate(axis: Axis, name: str, values: Float[np.ndarray, " draws+1"]) -> Estimate:
    """A value, the first one, with intervals from draws."""
    low, high, low_68, high_68 = np.quantile(values[1:], _QUANTILES).tolist()
    label = {"white": "white noise", "walk": "random walk", "time": "correlation time"}[name]
    return Estimate(
        axis=axis,
        label=f"{label} of the filter",
        value=float(values[0]),
        std=(high_68 - low_68) / 2.0,
        interval=(low, high),
        interval_68=(low_68, high_68),
        usual_unit=_unit(axis.sensor, name),
    )

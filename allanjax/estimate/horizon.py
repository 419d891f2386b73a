"""Which white noise, and which walk or Gauss–Markov process, a filter needs between its corrections."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple, cast, get_args

import numpy as np
from jaxtyping import Float

from allanjax.base.errors import AllanjaxError, FitError
from allanjax.estimate.coasting import (
    Filters,
    actual,
    bounding_pair,
    coasting_steps,
    equal_pair,
    memories,
    predicted,
)
from allanjax.estimate.horizon_result import EXPONENTS, AxisHorizon, Horizon, Process
from allanjax.estimate.likely_models import Likely, exact_model, likely_models
from allanjax.estimate.result import Fit
from allanjax.noise.datasheet import RATE, DataSheet
from allanjax.noise.estimate import Estimate
from allanjax.noise.model import Model
from allanjax.noise.terms import Markov
from allanjax.record.recording import Axis
from allanjax.record.units import SI, Sensor, default_coefficient_unit, si_unit

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

    A filter of two parameters estimates the bias from the sensor at rest and integrates its samples, less
    the bias, for up to `seconds`. The error of the angle (or velocity) then comes from all terms, the lines
    and those behind a response included. The pair `white` and `walk` predicts it as well as two numbers
    can; the bounding pair is at no time below it, with this probability of the coefficients. Where the
    data do not tell sets of terms apart, both are averaged over the likely ones.

    Args:
        fit: what `fit` or `load` returned; or a data sheet, taken as exact, with the bias estimated over an
            hour at rest, or over two horizons if these are longer.
        seconds: time between corrections [s], at least two samples and at most half the record.
        process: what the bias is to the filter: a random walk, or ("markov") a first-order Gauss–Markov
            process, whose correlation time is then found with the pair, among filters whose true error at
            the horizon is at most a tenth above the least. (A bias that is soon forgotten may predict as
            well, but leaves the drift in the error, which depends on how the model goes on for much longer.)
        rate: sample rate [Hz] of a data sheet, by default 100 Hz; a fit has its own.
        axes: names of axes; by default all that have a measurement. Those of a data sheet are its sensors.
        probability: that of the bounds.
        seed: of the draws of the coefficients.

    Raises:
        FitError: an axis without a measurement that was asked for, or no axis with one.
        AllanjaxError: a horizon, a process or a probability out of range; a term that has no state space.
    """
    if process not in get_args(Process):
        raise AllanjaxError(f"process= (--process) must be walk or markov, not {process!r}")
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
        raise FitError("no axis has a measurement: the fit says why")
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
    filters, steps = _filters(noise, seconds, process, rate, record), coasting_steps(seconds, rate)
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
        raw_prediction=_own_size(raw_N, raw_K, raw) * np.sqrt(predicted(raw, steps)[0]),
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


def _raw(coefficients: Mapping[str, Estimate]) -> tuple[float, float]:
    """N and K of the fitted model, SI; zero where it has none."""
    N, K = (coefficients.get(label) for label in ("angle_random_walk", "rate_random_walk"))
    return 0.0 if N is None else max(N.value, 0.0), 0.0 if K is None else max(K.value, 0.0)


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

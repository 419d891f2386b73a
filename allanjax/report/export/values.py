"""Noise quantities that targets take, of each axis of a fit and of three axes together.

They are N and K, the density `q` that drives a bias with the correlation time `T`, and B; all in SI.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Literal

from allanjax.base.wording import format_interval, significant
from allanjax.estimate.result import AxisFit, Fit
from allanjax.noise.datasheet import NOT_GIVEN, REMEDY, DataSheet
from allanjax.noise.estimate import Estimate
from allanjax.record.units import Sensor

#: A sensor in words.
CALLED: dict[Sensor, str] = {"gyro": "gyro", "accel": "accelerometer"}
#: What becomes of several axes where the target holds one number.
OneOf = Literal["worst", "mean"]

_TERMS = {"N": "angle_random_walk", "K": "rate_random_walk", "B": "bias_instability"}
#: Least correlation time [s] that a walk has for a target that takes one; of longer recordings their length.
LONG = 3600.0


@dataclasses.dataclass(frozen=True)
class Number:
    """A quantity in SI that a formula takes.

    Attributes:
        symbol: "N", "K", "q", "T" or "B".
        value: an estimate, or the 95 % limit of what was not detected.
        said: value with interval, or limit, and whose it is; in words.
        unit: SI unit of the value.
        is_limit: whether it is a limit, or a mean over axes of which one has only a limit.
        axis: name of the axis.
        label: the coefficient that it is; "" for the correlation time that a walk is given.
        interval: 95 % interval, of an estimate.
    """

    symbol: str
    value: float
    said: str
    unit: str
    is_limit: bool = False
    axis: str = ""
    label: str = ""
    interval: tuple[float, float] | None = None


@dataclasses.dataclass(frozen=True)
class Missing:
    """A quantity that the fit does not have, and why, with the remedy."""

    why: str


#: Quantities of one axis by their symbols.
Quantities = Mapping[str, Number | Missing]


def completed(of: Mapping[str, Number], why: str, no_walk: str = "") -> Quantities:
    """All quantities of an axis of which some are given: a walk is also what drives a bias.

    `why` says after its symbol why one is missing, and `no_walk` why there is no K beside a Markov process.
    """
    found: dict[str, Number | Missing] = {s: of.get(s) or Missing(f"{s} {why}") for s in "NKqTB"}
    walk = found["K"]
    if isinstance(walk, Number):
        found["q"], found["T"] = _driven_by(walk, LONG)
    elif isinstance(found["q"], Number):
        found["K"] = Missing(no_walk)
    else:
        found["q"] = found["T"] = walk
    return found


def of_sheet(sheet: DataSheet, sensor: Sensor) -> Quantities:
    """N, K, B, q and T of a sensor by its data sheet."""
    given: dict[str, Number] = {}
    for c in sheet.coefficients(sensor).values():
        shown, amount = c.in_unit(), f"{significant(c.value, 5)} {c.si_unit}"
        said = f"{c.symbol} = {amount}, {significant(shown.value)} {shown.unit}, {sensor}, by the data sheet"
        given[c.symbol] = Number(c.symbol, c.value, said, c.si_unit, axis=sensor, label=c.label)
    return completed(given, f"of the {CALLED[sensor]} is {NOT_GIVEN} by the data sheet; {REMEDY}")


def _driven_by(walk: Number, T: float) -> tuple[Number, Number]:
    """Density q that drives a bias that is a walk, and the correlation time [s] that it is given."""
    q = dataclasses.replace(walk, symbol="q", said=f"q = K: {walk.said}")
    said = f"T = {significant(T, 5)} s: no Markov process but a walk, which the bias is for much less than T"
    return q, Number("T", T, said, "s", axis=walk.axis)


def usable_axes(fit: Fit, sensor: Sensor, force: bool) -> tuple[list[AxisFit], list[str]]:
    """Axes of a sensor whose coefficients are measurements; and what is wrong with its others, in words.

    With `force` those that are not measurements are among the axes.
    """
    results = [r for r in fit.results if r.axis.sensor == sensor]
    left_out = [r for r in results if not r.measured and not (force and r.converged)]
    wrong = [f"without {r.axis.name}: {r.verdict}" for r in left_out]
    wrong += [f"{r.axis.name}: {r.verdict}" for r in results if not r.measured and r not in left_out]
    wrong += [
        f"without {dead.axis.name}: no result, {dead.reason}"
        for dead in fit.dead
        if dead.axis.sensor == sensor
    ]
    return [r for r in results if r not in left_out], wrong


def quantities(result: AxisFit, duration: float) -> Quantities:
    """N, K, B, q and T of an axis of a recording of this duration [s]."""
    found: dict[str, Number | Missing] = {symbol: _basic(result, symbol) for symbol in _TERMS}
    found["q"], found["T"] = _drive(result, found["K"], duration)
    return found


def _basic(result: AxisFit, symbol: str) -> Number | Missing:
    label = _TERMS[symbol]
    if label not in result.coefficients:
        terms = ", ".join(dict.fromkeys(c.term for c in result.coefficients.values()))
        return Missing(f"no {symbol} in the fitted model ({terms}); fit one that has it")
    return number(symbol, result.coefficients[label])


def number(symbol: str, c: Estimate) -> Number | Missing:
    """An amplitude, or its 95 % limit where it is not detected."""
    if c.detected or c.held or not c.measured:
        if not c.value > 0.0:
            return Missing(f"{c.title} of {c.axis.name} is zero in a fit that is not a measurement")
        if c.held or not math.isfinite(c.std):
            known, interval = " (held)" if c.held else "", None
        else:
            known, interval = f" (95 %: {format_interval(*c.interval, c.value, c.std)})", c.interval
        amount = f"{significant(c.value, 5)} {c.si_unit}{known}"
        said = f"{symbol} = {amount}, {c.in_unit().describe()}, {c.axis.name}"
        return Number(symbol, c.value, said, c.si_unit, False, c.axis.name, c.label, interval)
    limit = c.upper_limit
    if limit is None or not (math.isfinite(limit) and limit > 0.0):
        return Missing(f"{c.title} of {c.axis.name} is not detected, and there is no limit of it")
    said = (
        f"{symbol} NOT DETECTED: this is its 95 % upper limit {significant(limit, 5)} {c.si_unit} "
        f"({c.in_unit().describe()}), {c.axis.name}"
    )
    return Number(symbol, limit, said, c.si_unit, True, c.axis.name, c.label)


def markov_terms(result: AxisFit) -> list[tuple[Estimate, Estimate]]:
    """Amplitude and correlation time of each Markov process that is detected, the longest one first."""
    by_term: dict[str, dict[str, Estimate]] = {}
    for c in result.coefficients.values():
        by_term.setdefault(c.term, {})[c.symbol] = c
    pairs = [(of["q_c"], of["T_c"]) for of in by_term.values() if {"q_c", "T_c"} <= set(of)]
    found = [(q, T) for q, T in pairs if q.detected and q.value > 0.0 and math.isfinite(T.value)]
    return sorted(found, key=lambda pair: -pair[1].value)


def _drive(
    result: AxisFit, walk: Number | Missing, duration: float
) -> tuple[Number | Missing, Number | Missing]:
    """Density q that drives the bias, and its correlation time T: of a Markov process, or of the walk.

    Where both are there, what drives the bias more.
    """
    name = result.axis.name
    processes = markov_terms(result)
    if processes:
        amplitude, time = processes[0]
        weaker = isinstance(walk, Missing) or walk.is_limit or walk.value < amplitude.value
        if weaker:
            q = number("q", amplitude)
            said = f"T = {significant(time.value, 5)} s, {time.describe()}, {name}"
            return q, Number("T", time.value, said, "s", axis=name, label=time.label)
    if isinstance(walk, Missing):
        return walk, walk
    return _driven_by(walk, max(duration, LONG))


def together(
    formula: Callable[[Mapping[str, float]], float], axes: Sequence[Mapping[str, Number]], how: OneOf
) -> tuple[float, tuple[Number, ...]]:
    """What a formula gives for several axes: the worst, i.e. largest value, or that of the mean quantities.

    A correlation time is that of the axis whose bias is driven most.

    Args:
        formula: of the quantities' values by symbol.
        axes: the quantities that it takes, of each axis.
        how: "worst" or "mean".

    Returns:
        The value and the numbers that it was made of.
    """
    driven = "q" in axes[0]
    sizes = [axis["q"].value if driven else _value(formula, axis) for axis in axes]
    worst = axes[sizes.index(max(sizes))]
    if len(axes) == 1:
        return _value(formula, worst), tuple(worst.values())
    if how == "worst":
        told = f", the worst of {len(axes)} axes"
        numbers = [n if s == "T" else dataclasses.replace(n, said=n.said + told) for s, n in worst.items()]
    else:
        numbers = [n if s == "T" else _mean([axis[s] for axis in axes]) for s, n in worst.items()]
    return _value(formula, worst if how == "worst" else {n.symbol: n for n in numbers}), tuple(numbers)


def _value(formula: Callable[[Mapping[str, float]], float], axis: Mapping[str, Number]) -> float:
    return formula({symbol: number.value for symbol, number in axis.items()})


def _mean(numbers: Sequence[Number]) -> Number:
    """Arithmetic mean over axes, whose errors are taken as independent."""
    first, value = numbers[0], math.fsum(n.value for n in numbers) / len(numbers)
    limits = [n.axis for n in numbers if n.is_limit]
    said = f"{first.symbol} = {significant(value, 5)} {first.unit}"
    interval = None
    if not limits and all(n.interval is not None for n in numbers):
        # Intervals of an axis need not be symmetric: their halves add up in squares on each side.
        below, above = (
            math.hypot(*(n.interval[side] - n.value for n in numbers if n.interval)) / len(numbers)
            for side in (0, 1)
        )
        interval = (value - below, value + above)
        said += f" (95 %: {format_interval(*interval, value, (above + below) / 3.92)})"
    said += f", the mean of {', '.join(n.axis for n in numbers)}"
    if limits:
        said += f"; NOT DETECTED in {', '.join(limits)}, of which the 95 % upper limit is in the mean"
    return Number(first.symbol, value, said, first.unit, bool(limits), "mean", first.label, interval)

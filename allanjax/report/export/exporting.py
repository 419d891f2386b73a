"""`export`: a fit as the file of a program that takes noise parameters."""

from __future__ import annotations

import dataclasses
import math
import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Literal, NamedTuple, get_args

from allanjax.base.errors import AllanjaxError, FitError
from allanjax.base.wording import significant
from allanjax.estimate.result import AxisFit, Fit
from allanjax.noise.estimate import Estimate
from allanjax.record.units import SENSORS, Sensor
from allanjax.report.export.syntax import Entry, written
from allanjax.report.export.table import TARGETS
from allanjax.report.export.targets import Key, Target, Text, target_of
from allanjax.report.export.values import (
    Missing,
    Number,
    OneOf,
    Quantities,
    quantities,
    together,
    usable_axes,
)

#: What is written of several axes: each where the target holds three, the worst, or the mean.
Axes = Literal["each", "worst", "mean"]

_CALLED: dict[Sensor, str] = {"gyro": "gyro", "accel": "accelerometer"}


class Exported(NamedTuple):
    """The text for a target, and what had to be left out of it, in words."""

    text: str
    left_out: tuple[str, ...]


def export(
    fit: Fit,
    target: str,
    *,
    axes: Axes | None = None,
    rate: float | None = None,
    path: str | os.PathLike[str] | None = None,
) -> str:
    """The noise of a fitted sensor as the configuration of an estimator, autopilot or simulator.

    Every value has its formula, unit, the estimate with its 95 % interval and the source of the formula in a
    comment. What is not detected is exported as its 95 % limit, and says so; what the fit or the target
    cannot hold is said and left out. The text is ASCII; comments of JSON are in "_comment".

    Args:
        fit: the fit of a recording, from `fit` or `load`.
        target: its name, e.g. "kalibr", "vins-mono", "gz-sim"; `allanjax export --list` lists all.
        axes: what becomes of several axes: "worst" is the largest value, "mean" the mean, "each" one for
            each axis, for targets that hold three; by default "each" for these and "worst" for others.
        rate: rate of the target's steps or samples [Hz]; by default that of the recording (of an autopilot
            that of its filter).
        path: file to write the text to.

    Raises:
        AllanjaxError: there is no such target, it does not hold three values, or the rate is not positive.
        FitError: no axis has a result that is a measurement of the sensor.
    """
    text = exported(fit, target, axes=axes, rate=rate).text
    if path is not None:
        Path(path).write_text(text, encoding="ascii")
    return text


def exported(fit: Fit, target: str, *, axes: Axes | None = None, rate: float | None = None) -> Exported:
    """What `export` writes, and what had to be left out of it."""
    to = target_of(target, TARGETS)
    if axes is not None and axes not in get_args(Axes):
        raise AllanjaxError(f"axes={axes!r}: it is one of {', '.join(get_args(Axes))}")
    if axes == "each" and all(key.of == "one" for key in to.noise_keys):
        raise AllanjaxError(f"{to.title} holds one value for all axes: take the worst or the mean of them")
    r = rate if rate is not None else to.rate if to.rate is not None else fit.curve.rate
    if not 0.0 < r < math.inf:
        raise AllanjaxError(f"the rate must be positive, not {r:g} Hz; give it by rate= (--rate)")
    sensors = {sensor: _Sensor.of(fit, sensor) for sensor in SENSORS}
    if not any(s.axes for s in sensors.values()):
        why = "; ".join(text for s in sensors.values() for text in s.wrong)
        raise FitError(f"{fit.name or 'the fit'}: no axis to export; {why or 'it has no axes'}")
    if to.one_time:
        sensors = _with_one_time(sensors)
    entries: list[Entry] = []
    without: dict[str, list[str]] = {}
    for key in to.keys:
        if isinstance(key, Text):
            if key.sensor is None or sensors[key.sensor].axes:
                entries.append(Entry(key.name, key.value, (key.note,) if key.note else ()))
            continue
        try:
            entries.append(_entry(key, to, sensors, axes, float(r)))
        except _LeftOutError as why:
            without.setdefault(str(why), []).append(key.called)
    left_out = [f"{', '.join(dict.fromkeys(keys))} left out: {why}" for why, keys in without.items()]
    wrong = [text for s in sensors.values() for text in s.wrong]
    head = [
        f"{to.title}: noise of {fit.name or 'a recording'} as fitted by allanjax ({_length(fit)})",
        f"follows {to.source}",
        *([f"r = {significant(float(r), 6)} Hz, {to.rate_name}"] if _needs_rate(to) else []),
        "N, K: densities, two-sided, in SI; intervals are of 95 %",
        *to.notes,
        *wrong,
        *_not_held(to, sensors),
        *left_out,
    ]
    return Exported(written(to, head, entries), (*wrong, *left_out))


def _needs_rate(to: Target) -> bool:
    return any("r" in re.findall(r"\w+", key.formula) for key in to.noise_keys)


class _LeftOutError(Exception):
    """Why a key is left out."""


@dataclasses.dataclass(frozen=True)
class _Sensor:
    """The axes of a sensor, those with a result that counts: the fits, their quantities; what is wrong."""

    results: tuple[AxisFit, ...]
    axes: tuple[Quantities, ...]
    wrong: tuple[str, ...]

    @classmethod
    def of(cls, fit: Fit, sensor: Sensor) -> _Sensor:
        results, wrong = usable_axes(fit, sensor)
        duration = fit.curve.n / fit.curve.rate
        return cls(tuple(results), tuple(quantities(r, duration) for r in results), tuple(wrong))


def _length(fit: Fit) -> str:
    return f"{fit.curve.n:,} samples at {fit.curve.rate:g} Hz"


def _with_one_time(sensors: Mapping[Sensor, _Sensor]) -> dict[Sensor, _Sensor]:
    """The sensors with one correlation time for all axes: that of a Markov process, of a gyro if it has one.

    Of several it is that of the process that is driven most.
    """
    driven: list[tuple[Number, Number]] = []
    for s in sensors.values():
        pairs = [(of["q"], of["T"]) for of in s.axes]
        found = [(q, T) for q, T in pairs if isinstance(q, Number) and isinstance(T, Number)]
        processes = [(q, T) for q, T in found if T.label]
        driven = processes or driven or found
        if processes:
            break
    if not driven:
        return dict(sensors)
    _, T = max(driven, key=lambda pair: pair[0].value)
    return {
        name: dataclasses.replace(
            s, axes=tuple({**of, "T": T} if isinstance(of["T"], Number) else of for of in s.axes)
        )
        for name, s in sensors.items()
    }


def _entry(key: Key, to: Target, sensors: Mapping[Sensor, _Sensor], axes: Axes | None, rate: float) -> Entry:
    """The line of a key; _LeftOutError says why there is none."""
    if key.sensor is None:
        return Entry(key.name, key.value({}, rate), (f"= {key.formula} [{key.unit}]",))
    s = sensors[key.sensor]
    if not s.axes:
        raise _LeftOutError(
            f"the fit has no {_CALLED[key.sensor]} with a result; fit a recording that has one"
        )
    found, lacking = [], []
    for result, of in zip(s.results, s.axes, strict=True):
        own = {symbol: of[symbol] for symbol in key.symbols}
        missing = [x.why for x in own.values() if isinstance(x, Missing)]
        if missing:
            lacking += missing
        else:
            found.append((result, {k: x for k, x in own.items() if isinstance(x, Number)}))
    if not found:
        raise _LeftOutError("; ".join(dict.fromkeys(lacking)))
    if key.optional and all(n.is_limit for _, of in found for n in of.values()):
        raise _LeftOutError("; ".join(dict.fromkeys(n.said for _, of in found for n in of.values())))
    values, numbers = _values(key, found, axes, rate)
    comments = [f"= {key.formula} [{key.unit}]; source: {to.source.partition(':')[0]}"]
    comments += dict.fromkeys(n.said for n in numbers if n.symbol in key.formula)
    comments += dict.fromkeys(lacking)
    if key.note:
        comments.append(key.note)
    if any(not key.least <= x <= key.most for x in values):
        comments.append(f"OUTSIDE of the {key.least:g} to {key.most:g} {key.unit} that {to.title} accepts")
    value = {"three": values, "matrix": _diagonal(values)}.get(key.of, values[0])
    return Entry(key.name, value, tuple(comments))


def _values(
    key: Key, found: Sequence[tuple[AxisFit, Mapping[str, Number]]], axes: Axes | None, rate: float
) -> tuple[tuple[float, ...], tuple[Number, ...]]:
    """Values of a key, one or of x, y and z, and the numbers that they are made of."""
    how: OneOf = "mean" if axes == "mean" or key.of == "mean" else "worst"
    every = [of for _, of in found]
    all_axes = together(lambda q: key.value(q, rate), every, how)
    if key.of in ("one", "mean"):
        return (all_axes[0],), all_axes[1]
    by_letter = {result.axis.name[-1]: of for result, of in found}
    letters = "xyz" if key.of in ("three", "matrix") else key.of
    values, numbers = [], []
    for letter in letters:
        own = axes in (None, "each") and letter in by_letter
        value, made_of = together(lambda q: key.value(q, rate), [by_letter[letter]], how) if own else all_axes
        values.append(value)
        instead = not own and axes in (None, "each")
        place = f" (in the place of {letter}, which has no result)" if instead else ""
        numbers += [dataclasses.replace(n, said=n.said + place) for n in made_of]
    return tuple(values), tuple(numbers)


def _diagonal(values: Sequence[float]) -> tuple[float, ...]:
    """A covariance matrix of 3 × 3, row by row."""
    if len(values) != 3:
        return tuple(values)
    x, y, z = values
    return (x, 0.0, 0.0, 0.0, y, 0.0, 0.0, 0.0, z)


def _not_held(to: Target, sensors: Mapping[Sensor, _Sensor]) -> list[str]:
    """What was found in the axes and the target cannot hold, in words."""
    told: list[str] = []
    for sensor, s in sensors.items():
        symbols = {symbol for key in to.noise_keys if key.sensor == sensor for symbol in key.symbols}
        largest: dict[str, Estimate] = {}
        for result, of in zip(s.results, s.axes, strict=True):
            held = {number.label for x in symbols if isinstance(number := of[x], Number)}
            for c in result.coefficients.values():
                if not (c.is_amplitude and c.detected and c.value > 0.0) or c.label in held:
                    continue
                if c.label not in largest or c.value > largest[c.label].value:
                    largest[c.label] = c
        for c in largest.values():
            told.append(
                f"NOT HELD by {to.title}: {c.title} {c.symbol} = {c.in_unit().describe()} of {c.axis.name}"
            )
            if c.symbol == "q_c":
                told[-1] += "; for less than its correlation time it walks as K = q_c does"
        corrected = [f"{r.axis.name}: {r.correction}" for r in s.results if r.correction]
        told += [f"N is the density at low frequencies; NOT HELD: {text}" for text in corrected]
    return told

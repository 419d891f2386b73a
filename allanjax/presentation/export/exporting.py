"""`export`: a fit, a data sheet or another program's file as the file of one that takes noise parameters."""

from __future__ import annotations

import dataclasses
import math
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Literal, NamedTuple, get_args

import numpy as np

from allanjax.base.errors import AllanjaxError, FitError, expect
from allanjax.base.wording import format_interval, significant
from allanjax.estimate.result import AxisFit, Fit
from allanjax.noise.datasheet import NOT_GIVEN, REMEDY, DataSheet
from allanjax.noise.estimate import Estimate
from allanjax.presentation.export.syntax import Entry, by_axis, values_in, written
from allanjax.presentation.export.targets import Key, Target, Text, target_of
from allanjax.record.units import SENSORS, Sensor

# Noise quantities that targets take, of each axis of a fit and of three axes together.
#
# They are N and K, the density `q` that drives a bias with the correlation time `T`, and B; all in SI.

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
        text: value with interval, or limit, and whose it is; in words.
        unit: SI unit of the value.
        is_limit: whether it is a limit, or a mean over axes of which one has only a limit.
        axis: name of the axis.
        label: the coefficient that it is; "" for the correlation time that a walk is given.
        interval: 95 % interval, of an estimate.
    """

    symbol: str
    value: float
    text: str
    unit: str
    is_limit: bool = False
    axis: str = ""
    label: str = ""
    interval: tuple[float, float] | None = None


#: Quantities of one axis by their symbols; of one that is missing why, with the remedy.
Quantities = Mapping[str, Number | str]


def completed(
    of: Mapping[str, Number | str], why: str = "", no_walk: str = "", duration: float = LONG
) -> Quantities:
    """All quantities of an axis of which some are given: a walk is also what drives a bias, if q is not.

    `why` says after its symbol why one is missing, and `no_walk` why there is no K beside a Markov process.
    A walk gets the correlation time of the record's duration [s], if that is longer than others' `LONG`.
    """
    found = {s: of.get(s) or f"{s} {why}" for s in "NKqTB"}
    walk = found["K"]
    if "q" in of:
        found["K"] = no_walk or walk
    elif isinstance(walk, str):
        found["q"] = found["T"] = walk
    else:
        T = max(duration, LONG)
        found["q"] = dataclasses.replace(walk, symbol="q", text=f"q = K: {walk.text}")
        text = f"T = {significant(T, 5)} s stands for a random walk: the bias is one for times much below T"
        found["T"] = Number("T", T, text, "s", axis=walk.axis)
    return found


def of_sheet(sheet: DataSheet, sensor: Sensor) -> Quantities:
    """N, K, B, q and T of a sensor by its data sheet."""
    given: dict[str, Number] = {}
    for c in sheet.coefficients(sensor).values():
        shown, amount = c.in_unit(), f"{significant(c.value, 5)} {c.si_unit}"
        text = f"{c.symbol} = {amount}, {significant(shown.value)} {shown.unit}, {sensor}, by the data sheet"
        given[c.symbol] = Number(c.symbol, c.value, text, c.si_unit, axis=sensor, label=c.label)
    return completed(given, f"of the {CALLED[sensor]} is {NOT_GIVEN} by the data sheet; {REMEDY}")


def usable_axes(fit: Fit, sensor: Sensor, force: bool) -> tuple[list[AxisFit], list[str]]:
    """Axes of a sensor whose coefficients are measurements; and what is wrong with its others, in words.

    With `force` those that are not measurements are among the axes.
    """
    results = [r for r in fit.results if r.axis.sensor == sensor]
    left_out = [r for r in results if not r.measured and not (force and r.converged)]
    wrong = [f"without {r.axis.name}: {r.verdict}" for r in left_out]
    kept = [r for r in results if r not in left_out]
    wrong += [f"{r.axis.name}: {r.verdict}" for r in kept if not (r.measured and r.fits)]
    wrong += [
        f"without {dead.axis.name}: no result, {dead.reason}"
        for dead in fit.dead
        if dead.axis.sensor == sensor
    ]
    return kept, wrong


def quantities(result: AxisFit, duration: float) -> Quantities:
    """N, K, B, q and T of an axis of a recording of this duration [s]."""
    terms = ", ".join(dict.fromkeys(c.term for c in result.coefficients.values()))
    of: dict[str, Number | str] = {
        symbol: number(symbol, result.coefficients[label])
        if label in result.coefficients
        else f"no {symbol} in the fitted model ({terms}); fit one that has it"
        for symbol, label in _TERMS.items()
    }
    walk, process = of["K"], longest_process(result)
    # Of a walk and a process, what drives the bias more.
    if process and (isinstance(walk, str) or walk.is_limit or walk.value < process[0].value):
        amplitude, time = process
        text = f"T = {significant(time.value, 5)} s, {time.describe()}, {result.axis.name}"
        of["q"] = number("q", amplitude)
        of["T"] = Number("T", time.value, text, "s", axis=result.axis.name, label=time.label)
    return completed(of, duration=duration)


def number(symbol: str, c: Estimate) -> Number | str:
    """An amplitude, or its 95 % limit where it is not detected."""
    is_limit = c.measured and not (c.detected or c.held)
    value = (c.upper_limit or 0.0) if is_limit else c.value
    if is_limit and not 0.0 < value < math.inf:
        return f"{c.title} of {c.axis.name} is not detected, and there is no limit of it"
    if not value > 0.0:
        return f"{c.title} of {c.axis.name} is zero in a fit that is not a measurement"
    known, interval = " (95 % upper limit)" if is_limit else " (held)" if c.held else "", None
    if not known and math.isfinite(c.std):
        known, interval = f" (95 %: {format_interval(*c.interval, c.value, c.std)})", c.interval
    amount = f"{significant(value, 5)} {c.si_unit}{known}"
    text = f"{symbol} = {amount}, {c.in_unit().describe()}, {c.axis.name}"
    return Number(symbol, value, text, c.si_unit, is_limit, c.axis.name, c.label, interval)


def longest_process(result: AxisFit) -> tuple[Estimate, Estimate] | None:
    """Amplitude and correlation time of the longest Markov process that is detected, if there is one."""
    by_term: dict[str, dict[str, Estimate]] = {}
    for c in result.coefficients.values():
        by_term.setdefault(c.term, {})[c.symbol] = c
    pairs = [(of["q_c"], of["T_c"]) for of in by_term.values() if {"q_c", "T_c"} <= set(of)]
    found = [(q, T) for q, T in pairs if q.detected and q.value > 0.0 and math.isfinite(T.value)]
    return max(found, key=lambda pair: pair[1].value, default=None)


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
        end = f", the worst of {len(axes)} axes"
        numbers = [n if s == "T" else dataclasses.replace(n, text=n.text + end) for s, n in worst.items()]
    else:
        numbers = [n if s == "T" else _mean([axis[s] for axis in axes]) for s, n in worst.items()]
    return _value(formula, worst if how == "worst" else {n.symbol: n for n in numbers}), tuple(numbers)


def _value(formula: Callable[[Mapping[str, float]], float], axis: Mapping[str, Number]) -> float:
    return formula({symbol: number.value for symbol, number in axis.items()})


def _mean(numbers: Sequence[Number]) -> Number:
    """Arithmetic mean over axes, whose errors are taken as independent."""
    first, value = numbers[0], math.fsum(n.value for n in numbers) / len(numbers)
    limits = [n.axis for n in numbers if n.is_limit]
    text = f"{first.symbol} = {significant(value, 5)} {first.unit}"
    interval = None
    if not limits and all(n.interval is not None for n in numbers):
        # Intervals of an axis need not be symmetric: their halves add up in squares on each side.
        below, above = (
            math.hypot(*(n.interval[side] - n.value for n in numbers if n.interval)) / len(numbers)
            for side in (0, 1)
        )
        interval = (value - below, value + above)
        text += f" (95 %: {format_interval(*interval, value, (above + below) / 3.92)})"
    text += f", the mean of {', '.join(n.axis for n in numbers)}"
    if limits:
        text += f"; not detected on {', '.join(limits)}, with 95 % upper limits in the mean"
    return Number(first.symbol, value, text, first.unit, bool(limits), "mean", first.label, interval)


#: What is written of several axes: each where the target holds three, the worst, or the mean.
Axes = Literal["each", "worst", "mean"]


class Exported(NamedTuple):
    """The text for a target, and what its user should know: warnings, and what had to be left out of it.

    `refused` are values beyond the ranges that the target documents, which are commented out.
    """

    text: str
    left_out: tuple[str, ...]
    refused: tuple[str, ...] = ()


@dataclasses.dataclass(frozen=True)
class SensorNoise:
    """The noise of a sensor's axes, by their names; and in words what is wrong with others."""

    axes: Mapping[str, Quantities] = dataclasses.field(default_factory=dict)
    wrong: Sequence[str] = ()


def checked_axes(to: Target, axes: Axes | None) -> None:
    """Raise AllanjaxError if a target can not be given what is asked for several axes."""
    if axes is not None and axes not in get_args(Axes):
        raise AllanjaxError(f"axes= (--axes) must be one of {', '.join(get_args(Axes))}, not {axes!r}")
    if axes == "each" and all(key.of == "one" for key in to.noise_keys):
        raise AllanjaxError(f"{to.title} has one value for all axes; pass axes='worst' or 'mean' (--axes)")


def checked_rate(rate: float) -> float:
    """The rate [Hz] as a float; AllanjaxError if it is not positive."""
    if not 0.0 < rate < math.inf:
        raise AllanjaxError(f"the rate must be positive, not {rate:g} Hz; give it by rate= (--rate)")
    return float(rate)


def rate_of_target(to: Target, rate: float | None, own: float | None) -> float:
    """Rate of a target's steps [Hz]: the one given, unless it has its own, or that of the source.

    It is nan if it is not known and no noise depends on it.
    """
    found = rate if rate is not None and to.rate is None else to.rate if to.rate is not None else own
    if found is None and any("r" in key.names for key in to.noise_keys if key.sensor):
        raise AllanjaxError(f"{to.title} takes the rate of the IMU, which is not known: give rate= (--rate)")
    return math.nan if found is None else checked_rate(found)


def assembled(
    to: Target,
    sensors: Mapping[Sensor, SensorNoise],
    axes: Axes | None,
    rate: float,
    head: Sequence[str],
    not_held: Sequence[str] = (),
) -> Exported:
    """The file of a target.

    Args:
        to: the target.
        sensors: the noise of gyros and of accelerometers; without axes where there are none.
        axes: see `exporting.export`.
        rate: of the target's steps [Hz].
        head: what the values are, for the first lines.
        not_held: what the target can not hold, in words.
    """
    if to.one_time:
        sensors = _with_one_time(sensors)
    needs_rate = math.isfinite(rate) and any("r" in key.names for key in to.noise_keys)
    entries: list[Entry] = []
    without: dict[str, list[str]] = {}
    for key in to.keys:
        if isinstance(key, Text):
            if key.sensor is None or sensors[key.sensor].axes:
                entries.append(Entry(key.name, key.value, (key.note,) if key.note else ()))
            continue
        try:
            entries.append(_entry(key, to, sensors, axes, rate))
        except _LeftOutError as why:
            without.setdefault(str(why), []).append(key.called)
    left_out = [f"{', '.join(dict.fromkeys(keys))} left out: {why}" for why, keys in without.items()]
    wrong = [text for s in sensors.values() for text in s.wrong]
    refused = tuple(entry.refused for entry in entries if entry.refused)
    lines = [
        *head,
        f"follows {to.source}",
        *([f"r = {significant(rate, 6)} Hz, {to.rate_name}"] if needs_rate else []),
        "N, K: densities, two-sided, in SI",
        *to.notes,
        *wrong,
        *not_held,
        *left_out,
        *refused,
    ]
    return Exported(written(to, lines, entries), (*wrong, *left_out), refused)


class _LeftOutError(Exception):
    """Why a key is left out."""


def _with_one_time(sensors: Mapping[Sensor, SensorNoise]) -> dict[Sensor, SensorNoise]:
    """The sensors with one correlation time for all axes: that of a Markov process, of a gyro if it has one.

    Of several it is that of the process that is driven most.
    """
    driven: list[tuple[Number, Number]] = []
    for s in sensors.values():
        pairs = [(of["q"], of["T"]) for of in s.axes.values()]
        found = [(q, T) for q, T in pairs if isinstance(q, Number) and isinstance(T, Number)]
        processes = [(q, T) for q, T in found if T.label]
        driven = processes or driven or found
        if processes:
            break
    if not driven:
        return dict(sensors)
    _, T = max(driven, key=lambda pair: pair[0].value)
    timed = {
        sensor: {name: {**of, "T": T} if isinstance(of["T"], Number) else of for name, of in s.axes.items()}
        for sensor, s in sensors.items()
    }
    return {sensor: dataclasses.replace(s, axes=timed[sensor]) for sensor, s in sensors.items()}


def _entry(
    key: Key, to: Target, sensors: Mapping[Sensor, SensorNoise], axes: Axes | None, rate: float
) -> Entry:
    """The line of a key; _LeftOutError says why there is none."""
    if key.sensor is None:
        if "r" in key.names and math.isnan(rate):
            raise _LeftOutError("the rate of the IMU is not known: give rate= (--rate)")
        return Entry(key.name, key.value({}, rate), (f"= {key.formula} [{key.unit}]",))
    s = sensors[key.sensor]
    if not s.axes:
        raise _LeftOutError(f"there is no {CALLED[key.sensor]} with a result; take a recording that has one")
    found, lacking = [], []
    for name, of in s.axes.items():
        own = {symbol: of[symbol] for symbol in key.symbols}
        missing = [x for x in own.values() if isinstance(x, str)]
        if missing:
            lacking += missing
        else:
            found.append((name, {k: x for k, x in own.items() if isinstance(x, Number)}))
    if not found:
        raise _LeftOutError("; ".join(dict.fromkeys(lacking)))
    if key.optional and all(n.is_limit for _, of in found for n in of.values()):
        raise _LeftOutError("; ".join(dict.fromkeys(n.text for _, of in found for n in of.values())))
    values, numbers = _values(key, found, axes, rate)
    comments = [f"= {key.formula} [{key.unit}]; source: {to.source.partition(':')[0]}"]
    comments += dict.fromkeys(n.text for n in numbers if n.symbol in key.formula)
    comments += dict.fromkeys(lacking)
    if key.note:
        comments.append(key.note)
    refused = ""
    if any(not key.least <= x <= key.most for x in values):
        shown = key.called.replace("...", ", ".join(map(significant, values)))
        between = f"{key.least:g} to {key.most:g} {key.unit}"
        refused = f"{shown} is commented out: the range that {to.title} documents is {between}"
        comments.append(refused)
    if key.of == "matrix":
        # Of 3 × 3, row by row.
        values = tuple(np.diag(values).ravel().tolist())
    return Entry(key.name, values if key.of in ("three", "matrix") else values[0], tuple(comments), refused)


def _values(
    key: Key, found: Sequence[tuple[str, Mapping[str, Number]]], axes: Axes | None, rate: float
) -> tuple[tuple[float, ...], tuple[Number, ...]]:
    """Values of a key, one or of x, y and z, and the numbers that they are made of."""
    how: OneOf = "mean" if axes == "mean" or key.of == "mean" else "worst"
    every = [of for _, of in found]
    all_axes = together(lambda q: key.value(q, rate), every, how)
    if key.of in ("one", "mean"):
        return (all_axes[0],), all_axes[1]
    by_letter = {name[-1]: of for name, of in found}
    letters = "xyz" if key.of in ("three", "matrix") else key.of
    values, numbers = [], []
    for letter in letters:
        own = axes in (None, "each") and letter in by_letter
        value, made_of = together(lambda q: key.value(q, rate), [by_letter[letter]], how) if own else all_axes
        values.append(value)
        instead = not own and axes in (None, "each")
        place = f" (in place of {letter}, which has no value)" if instead else ""
        numbers += [dataclasses.replace(n, text=n.text + place) for n in made_of]
    return tuple(values), tuple(numbers)


def export(
    fit: Fit | DataSheet,
    target: str,
    *,
    axes: Axes | None = None,
    rate: float | None = None,
    force: bool = False,
    path: str | os.PathLike[str] | None = None,
) -> str:
    """The noise of a fitted sensor as the configuration of an estimator, autopilot or simulator.

    Every value has its formula, unit, the estimate with its 95 % interval and the source of the formula in a
    comment. What is not detected is exported as its 95 % limit, and says so; what the fit or the target
    cannot hold is noted and left out; a value beyond the range that the target documents is commented out.
    The text is ASCII; comments of JSON are in "_comment".

    Args:
        fit: the fit of a recording, from `fit` or `load`; or a data sheet, whose K, which data sheets do not
            have, is left out with the remedy.
        target: its name, e.g. "kalibr", "vins-mono", "gz-sim"; `allanjax export --list` lists all.
        axes: what becomes of several axes: "worst" is the largest value, "mean" the mean, "each" one for
            each axis, for targets that hold three; by default "each" for these and "worst" for others.
        rate: rate of the target's steps or samples [Hz]; by default that of the recording (of an autopilot
            that of its filter). A data sheet has none.
        force: whether to export what is not a measurement of the sensor, too.
        path: file to write the text to.

    Raises:
        AllanjaxError: there is no such target, it does not hold three values, or the rate is not positive.
        FitError: no axis has a result that is a measurement of the sensor.
    """
    expect(fit, (Fit, DataSheet), "export takes a fit or a data sheet, e.g. allanjax.datasheet('BMI088')")
    text = exported(fit, target, axes=axes, rate=rate, force=force).text
    if path is not None:
        Path(path).write_text(text, encoding="ascii")
    return text


def exported(
    fit: Fit | DataSheet,
    target: str,
    *,
    axes: Axes | None = None,
    rate: float | None = None,
    force: bool = False,
) -> Exported:
    """What `export` writes, and what had to be left out of it."""
    to = target_of(target)
    checked_axes(to, axes)
    if isinstance(fit, DataSheet):
        of = {s: SensorNoise({s: of_sheet(fit, s)} if s in fit.models else {}) for s in SENSORS}
        head = f"{to.title}: noise of {fit.name or 'a sensor'} by its data sheet, not from a recording"
        source = [f"data sheet: {fit.source}"] if fit.source else []
        return assembled(to, of, axes, rate_of_target(to, rate, None), [head, *source, *fit.statements])
    r = checked_rate(rate if rate is not None else to.rate if to.rate is not None else fit.curve.rate)
    results = {sensor: usable_axes(fit, sensor, force) for sensor in SENSORS}
    if not any(usable for usable, _ in results.values()):
        why = "; ".join(text for _, wrong in results.values() for text in wrong)
        remedy = "; --force (force=True) exports it nevertheless" if fit.not_measured else ""
        raise FitError(f"{fit.name or 'the fit'}: no axis to export; {why or 'it has no axes'}{remedy}")
    duration = fit.curve.n / fit.curve.rate
    sensors = {
        sensor: SensorNoise({r.axis.name: quantities(r, duration) for r in usable}, wrong)
        for sensor, (usable, wrong) in results.items()
    }
    size = f"{fit.curve.n:,} samples at {fit.curve.rate:g} Hz"
    what = f"{to.title}: noise of {fit.name or 'a recording'} as fitted by allanjax"
    head = f"{what} ({size}), intervals of 95 %"
    if not fit.curve.determined:
        head = f"{what} to an Allan curve, {fit.curve.unknown[0]}"
    not_held = [
        text
        for sensor, (usable, _) in results.items()
        for text in _not_held(to, sensor, usable, sensors[sensor].axes.values())
    ]
    warnings = [f"WARNING: {text}" for text in fit.warnings]
    made = assembled(to, sensors, axes, r, [head, *warnings], not_held)
    return made._replace(left_out=(*fit.warnings, *made.left_out))


def _not_held(
    to: Target, sensor: Sensor, results: Sequence[AxisFit], axes: Iterable[Quantities]
) -> list[str]:
    """What was found in the axes of a sensor and the target cannot hold, in words."""
    symbols = {symbol for key in to.noise_keys if key.sensor == sensor for symbol in key.symbols}
    largest: dict[str, Estimate] = {}
    for result, of in zip(results, axes, strict=True):
        held = {number.label for x in symbols if isinstance(number := of[x], Number)}
        for c in result.coefficients.values():
            if not (c.is_amplitude and c.detected and c.value > 0.0) or c.label in held:
                continue
            if c.label not in largest or c.value > largest[c.label].value:
                largest[c.label] = c
    texts = []
    for c in largest.values():
        walks = "; for times well below T_c it is a random walk with K = q_c" * (c.symbol == "q_c")
        amount = c.in_unit().describe()
        texts.append(f"{to.title} has no {c.title}: {c.symbol} = {amount} of {c.axis.name}{walks}")
    corrected = [f"{r.axis.name}: {r.correction}" for r in results if r.correction]
    return texts + [f"N is the density at low frequencies; not in the model: {text}" for text in corrected]


_UNITS: dict[Sensor, dict[str, str]] = {
    "gyro": {"N": "rad/√s", "K": "rad/s/√s", "q": "rad/s/√s", "B": "rad/s", "T": "s"},
    "accel": {"N": "m/s/√s", "K": "m/s²/√s", "q": "m/s²/√s", "B": "m/s²", "T": "s"},
}


def converted(
    text: str,
    source: str,
    target: str,
    *,
    axes: Axes | None = None,
    rate: float | None = None,
    name: str = "",
) -> Exported:
    """The file of one target as that of another.

    Args:
        text: of the file.
        source: the target that the file is of.
        target: the one to write.
        axes: see `export`.
        rate: rate of the steps [Hz], which a file whose values are per step does not always have.
        name: of the file, for messages and the first line.

    Raises:
        AllanjaxError: there is no such target; the file of `source` is ambiguous, damaged, or has none of its
            keys; or the rate is needed.
    """
    from_, to = target_of(source), target_of(target)
    if from_.unreadable:
        raise AllanjaxError(f"a file of {from_.title} can not be converted: {from_.unreadable}")
    checked_axes(to, axes)
    try:
        values = values_in(from_, text)
        own = _rate_of(from_, values, rate)
        sensors = {sensor: _noise(from_, sensor, values, own) for sensor in SENSORS}
    except AllanjaxError as error:
        raise AllanjaxError(f"{name or 'the text'}: {error}") from error
    if not any(s.axes for s in sensors.values()):
        keys = ", ".join(dict.fromkeys(key.called for key in from_.noise_keys if key.sensor))
        raise AllanjaxError(f"{name or 'the text'}: not a file of {from_.title}: none of {keys} is in it")
    head = f"{to.title}: converted by allanjax from {name or 'a file'} of {from_.title}, not from a recording"
    return assembled(to, sensors, axes, rate_of_target(to, rate, own), [head])


def _rate_of(from_: Target, values: Mapping[str, tuple[float, ...]], rate: float | None) -> float | None:
    """Rate of the steps that the file's values are of [Hz]; None if they are of none and it is not known."""
    if from_.rate is not None:
        return from_.rate
    own = [values[key.name][0] for key in from_.noise_keys if key.formula == "r" and key.name in values]
    found = rate if rate is not None else own[0] if own else None
    if found is None and any("r" in key.names for key in from_.noise_keys if key.sensor):
        raise AllanjaxError(
            f"values of {from_.title} are per step, but its file lacks the rate; pass rate= (--rate)"
        )
    return None if found is None else checked_rate(found)


def _noise(
    from_: Target, sensor: Sensor, values: Mapping[str, tuple[float, ...]], rate: float | None
) -> SensorNoise:
    """Quantities of a sensor's axes, from the values of its keys."""
    keys = [key for key in from_.noise_keys if key.name in values]
    letters: dict[str, dict[str, Number]] = {}
    # Correlation times come first, since other formulas need them.
    for key in sorted(keys, key=lambda key: key.formula != "T"):
        shared = from_.one_time and key.formula == "T"
        if key.sensor != sensor and not shared:
            continue
        for letter, value in by_axis(key, values[key.name]).items():
            known = letters.get(letter, {}) | {s: n for s, n in letters.get("", {}).items() if s == "T"}
            number = _number(from_, key, sensor, value, known, rate)
            letters.setdefault(letter, {})[number.symbol] = number
    common = letters.pop("", {})
    if not (common.keys() - {"T"} or letters):
        return SensorNoise()
    of_axes = {letter: common | of for letter, of in letters.items()} or {"": common}
    no_walk = f"the bias of {from_.title} is a Markov process: no random walk beyond its correlation time"
    why = f"is not in a file of {from_.title}"
    return SensorNoise(
        {
            f"{sensor}_{letter}" if letter else sensor: completed(of, why, no_walk)
            for letter, of in of_axes.items()
        }
    )


def _number(
    from_: Target, key: Key, sensor: Sensor, value: float, known: Mapping[str, Number], rate: float | None
) -> Number:
    """The quantity that a value of the file is of."""
    if not 0.0 < value < math.inf:
        raise AllanjaxError(f"{key.called} is {value:g}, but must be positive and finite")
    symbol = "q" if {"q", "T"} <= key.names else next(s for s in "NKqBT" if s in key.names)
    others = {s: n.value for s, n in known.items() if s != symbol}
    if "T" in key.names - {symbol} and "T" not in others:
        raise AllanjaxError(f"{key.called} needs the correlation time, which is not in it")
    unit = _UNITS[sensor][symbol]
    x = key.solved(value, symbol, others, rate if rate is not None else 1.0)
    text = f"{symbol} = {significant(x, 5)} {unit}, from {key.called} = {value:g} {key.unit} of {from_.title}"
    return Number(symbol, x, text, unit, axis=sensor, label=symbol)

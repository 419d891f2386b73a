"""`export`: a fit, a data sheet or another program's file as the file of one that takes noise parameters."""

from __future__ import annotations

import dataclasses
import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Literal, NamedTuple, get_args

from allanjax.base.errors import AllanjaxError, FitError
from allanjax.base.wording import significant
from allanjax.estimate.result import AxisFit, Fit
from allanjax.noise.datasheet import DataSheet
from allanjax.noise.estimate import Estimate
from allanjax.record.units import SENSORS, Sensor
from allanjax.report.export.syntax import Entry, by_axis, values_in, written
from allanjax.report.export.targets import Key, Target, Text, target_of
from allanjax.report.export.values import (
    CALLED,
    Missing,
    Number,
    OneOf,
    Quantities,
    completed,
    of_sheet,
    quantities,
    together,
    usable_axes,
)

#: What is written of several axes: each where the target holds three, the worst, or the mean.
Axes = Literal["each", "worst", "mean"]


class Exported(NamedTuple):
    """The text for a target, and what its user should know: warnings, and what had to be left out of it."""

    text: str
    left_out: tuple[str, ...]


@dataclasses.dataclass(frozen=True)
class SensorNoise:
    """The noise of a sensor's axes, by their names; and in words what is wrong with others."""

    names: tuple[str, ...]
    axes: tuple[Quantities, ...]
    wrong: tuple[str, ...] = ()


def checked_axes(to: Target, axes: Axes | None) -> None:
    """Raise AllanjaxError if a target can not be given what is asked for several axes."""
    if axes is not None and axes not in get_args(Axes):
        raise AllanjaxError(f"axes={axes!r}: it is one of {', '.join(get_args(Axes))}")
    if axes == "each" and all(key.of == "one" for key in to.noise_keys):
        raise AllanjaxError(f"{to.title} holds one value for all axes: take the worst or the mean of them")


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
    lines = [
        *head,
        f"follows {to.source}",
        *([f"r = {significant(rate, 6)} Hz, {to.rate_name}"] if needs_rate else []),
        "N, K: densities, two-sided, in SI",
        *to.notes,
        *wrong,
        *not_held,
        *left_out,
    ]
    return Exported(written(to, lines, entries), (*wrong, *left_out))


class _LeftOutError(Exception):
    """Why a key is left out."""


def _with_one_time(sensors: Mapping[Sensor, SensorNoise]) -> dict[Sensor, SensorNoise]:
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
    for name, of in zip(s.names, s.axes, strict=True):
        own = {symbol: of[symbol] for symbol in key.symbols}
        missing = [x.why for x in own.values() if isinstance(x, Missing)]
        if missing:
            lacking += missing
        else:
            found.append((name, {k: x for k, x in own.items() if isinstance(x, Number)}))
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
        place = f" (in the place of {letter}, which has no value of its own)" if instead else ""
        numbers += [dataclasses.replace(n, said=n.said + place) for n in made_of]
    return tuple(values), tuple(numbers)


def _diagonal(values: Sequence[float]) -> tuple[float, ...]:
    """A covariance matrix of 3 × 3, row by row."""
    if len(values) != 3:
        return tuple(values)
    x, y, z = values
    return (x, 0.0, 0.0, 0.0, y, 0.0, 0.0, 0.0, z)


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
    cannot hold is said and left out. The text is ASCII; comments of JSON are in "_comment".

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
        of = {s: SensorNoise((s,), (of_sheet(fit, s),)) for s in fit.models}
        of = {s: of.get(s, SensorNoise((), ())) for s in SENSORS}
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
        sensor: SensorNoise(
            tuple(r.axis.name for r in usable),
            tuple(quantities(r, duration) for r in usable),
            tuple(wrong),
        )
        for sensor, (usable, wrong) in results.items()
    }
    size = f"{fit.curve.n:,} samples at {fit.curve.rate:g} Hz"
    head = (
        f"{to.title}: noise of {fit.name or 'a recording'} as fitted by allanjax ({size}), intervals of 95 %"
    )
    not_held = [
        text
        for sensor, (usable, _) in results.items()
        for text in _not_held(to, sensor, usable, sensors[sensor].axes)
    ]
    warnings = [f"WARNING: {text}" for text in fit.warnings]
    made = assembled(to, sensors, axes, r, [head, *warnings], not_held)
    return made._replace(left_out=(*fit.warnings, *made.left_out))


def _not_held(
    to: Target, sensor: Sensor, results: Sequence[AxisFit], axes: Sequence[Quantities]
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
    told = []
    for c in largest.values():
        walks = "; for less than its correlation time it walks as K = q_c does" if c.symbol == "q_c" else ""
        amount = c.in_unit().describe()
        told.append(f"NOT HELD by {to.title}: {c.title} {c.symbol} = {amount} of {c.axis.name}{walks}")
    corrected = [f"{r.axis.name}: {r.correction}" for r in results if r.correction]
    return told + [f"N is the density at low frequencies; NOT HELD: {text}" for text in corrected]


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
            f"values of {from_.title} are per step, and its file does not have the rate: give --rate"
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
        return SensorNoise((), ())
    of_axes = {letter: common | of for letter, of in letters.items()} or {"": common}
    names = tuple(f"{sensor}_{letter}" if letter else sensor for letter in of_axes)
    return SensorNoise(names, tuple(_quantities(from_, of) for of in of_axes.values()))


def _number(
    from_: Target, key: Key, sensor: Sensor, value: float, known: Mapping[str, Number], rate: float | None
) -> Number:
    """The quantity that a value of the file is of."""
    if not 0.0 < value < math.inf:
        raise AllanjaxError(f"{key.called} is {value:g}, which no noise has; give a positive value")
    symbol = "q" if {"q", "T"} <= key.names else next(s for s in "NKqBT" if s in key.names)
    others = {s: n.value for s, n in known.items() if s != symbol}
    if "T" in key.names - {symbol} and "T" not in others:
        raise AllanjaxError(f"{key.called} needs the correlation time, which is not in it")
    unit = _UNITS[sensor][symbol]
    x = key.solved(value, symbol, others, rate if rate is not None else 1.0)
    said = f"{symbol} = {significant(x, 5)} {unit}, from {key.called} = {value:g} {key.unit} of {from_.title}"
    return Number(symbol, x, said, unit, axis=sensor, label=symbol)


def _quantities(from_: Target, of: Mapping[str, Number]) -> Quantities:
    """All quantities of an axis: those of the file, a walk also as what drives a bias."""
    no_walk = f"the bias of {from_.title} is a Markov process, which is no walk beyond its correlation time"
    return completed(of, f"is not in a file of {from_.title}", no_walk)

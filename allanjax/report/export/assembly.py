"""The file of a target from the quantities of axes, wherever these are from."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Literal, NamedTuple, get_args

from allanjax.base.errors import AllanjaxError
from allanjax.base.wording import significant
from allanjax.record.units import Sensor
from allanjax.report.export.syntax import Entry, written
from allanjax.report.export.targets import Key, Target, Text
from allanjax.report.export.values import CALLED, Missing, Number, OneOf, Quantities, together

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

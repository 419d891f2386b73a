"""A target's own file as that of another, by the formulas of the table backwards."""

from __future__ import annotations

import math
from collections.abc import Mapping

from allanjax.base.errors import AllanjaxError
from allanjax.base.wording import significant
from allanjax.record.units import SENSORS, Sensor
from allanjax.report.export.assembly import (
    Axes,
    Exported,
    SensorNoise,
    assembled,
    checked_axes,
    checked_rate,
    rate_of_target,
)
from allanjax.report.export.reading import by_axis, values_in
from allanjax.report.export.table import TARGETS
from allanjax.report.export.targets import Key, Target, target_of
from allanjax.report.export.values import Number, Quantities, completed

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
    from_, to = target_of(source, TARGETS), target_of(target, TARGETS)
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

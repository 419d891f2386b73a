"""What a target is: its keys, the formula of each, and how its file is written. Each is in `targets.toml`."""

from __future__ import annotations

import dataclasses
import functools
import itertools
import math
import re
import tomllib
from collections.abc import Callable, Iterator, Mapping, Sequence
from importlib.resources import files
from typing import Any, Literal

from allanjax.base.errors import AllanjaxError
from allanjax.record.units import SENSORS, Sensor, unit_scale

#: Which axes a key is of: one value for all, each axis in a list, their covariance matrix, the mean, or one.
Of = Literal["one", "three", "matrix", "mean", "x", "y", "z"]
Syntax = Literal["yaml", "json", "xml", "lines"]

_SYMBOLS = frozenset("NKqTB")
_AXES: tuple[Of, ...] = ("x", "y", "z")


@dataclasses.dataclass(frozen=True)
class Key:
    """One value of a target's file.

    Attributes:
        name: where it stands: names of the levels with "/" between them; of lines the whole line, with {}
            for the value.
        formula: of N, K, q, T, B (see `exporting`), in SI, and the rate r [Hz]; as Python has it.
        unit: the target's unit.
        sensor: whose value it is; None for one of the recording.
        of: of which axes it is.
        optional: whether it is left out where the quantity is not detected, and not given its limit.
        least, most: range that the target's documentation gives, in its unit.
        note: what there is to say of this value.
    """

    name: str
    formula: str
    unit: str
    sensor: Sensor | None = None
    of: Of = "one"
    optional: bool = False
    least: float = 0.0
    most: float = math.inf
    note: str = ""

    @property
    def called(self) -> str:
        """Its name without the levels above."""
        return self.name.rpartition("/")[2].replace("{}", "...")

    @property
    def names(self) -> set[str]:
        """Names in its formula: quantities, the rate r, functions."""
        return set(re.findall(r"[A-Za-z]+", self.formula))

    @property
    def symbols(self) -> tuple[str, ...]:
        """Quantities of the fit that are needed; with a correlation time the density that it belongs to."""
        names = self.names & _SYMBOLS
        return tuple(sorted(names | ({"q"} if "T" in names else set())))

    def value(self, quantities: Mapping[str, float], rate: float) -> float:
        """The value in the target's unit, of quantities in SI."""
        return float(_compiled(self.formula)({**quantities, "r": rate})) / unit_scale(self.unit, self.sensor)

    def solved(self, value: float, symbol: str, known: Mapping[str, float], rate: float) -> float:
        """The quantity in SI that gives this value in the target's unit, the others being known.

        Formulas are products of powers, so that two values of one tell its power.
        """
        one, two = (self.value({**known, symbol: x}, rate) for x in (1.0, 2.0))
        return float((value / one) ** (1.0 / math.log2(two / one)))


@dataclasses.dataclass(frozen=True)
class Text:
    """A line of a target's file that is no noise: `value` as it stands, or a number that was chosen.

    It is left out where it belongs to a `sensor` that the fit does not have.
    """

    name: str
    value: str | float | bool
    note: str = ""
    sensor: Sensor | None = None


@dataclasses.dataclass(frozen=True)
class Target:
    """A program that takes noise parameters, and the file that it takes them from.

    Attributes:
        name: as users give it, e.g. "kalibr".
        title: as its authors write it.
        syntax: of its file.
        source: where its formulas are from.
        keys: its values in their order.
        notes: what users have to know.
        rate: the rate r of its steps [Hz], if that is not the recording's; and `rate_name` what it is.
        one_time: whether all axes have one correlation time T.
        comment: what begins a comment, of lines.
        comment_at: the object, of JSON, that holds the comments, as its reader skips names it does not know.
        before: lines before the values, of lines.
        also: other names.
        unreadable: why its files cannot be converted into those of others; "" if they can.
    """

    name: str
    title: str
    syntax: Syntax
    source: str
    keys: tuple[Key | Text, ...]
    notes: tuple[str, ...] = ()
    rate: float | None = None
    rate_name: str = "rate of the IMU"
    one_time: bool = False
    comment: str = "#"
    comment_at: str = ""
    before: tuple[str, ...] = ()
    also: tuple[str, ...] = ()
    unreadable: str = ""

    @property
    def noise_keys(self) -> tuple[Key, ...]:
        """Its keys with a formula."""
        return tuple(key for key in self.keys if isinstance(key, Key))


@functools.cache
def _compiled(formula: str) -> Callable[[Mapping[str, float]], float]:
    """A formula of our own table as a function."""
    code = compile(formula, "formula", "eval")
    return lambda names: eval(code, {"__builtins__": {}, "sqrt": math.sqrt}, dict(names))


def _table() -> dict[str, Target]:
    """The targets of `targets.toml` by name."""
    text = files(__package__).joinpath("targets.toml").read_text(encoding="utf-8")
    tables = tomllib.loads(text)
    notes = tables.pop("NOTES")
    return {
        name: _target(name, tables.get(of.pop("like", ""), {}) | of, notes) for name, of in tables.items()
    }


def _target(name: str, of: Mapping[str, Any], common: Mapping[str, str]) -> Target:
    """Target of a table; notes that several have are named."""
    fields: dict[str, Any] = {k: tuple(x) if isinstance(x, list) else x for k, x in of.items()}
    fields["keys"] = tuple(key for row in of["keys"] for key in _keys(**row))
    fields["notes"] = tuple(common.get(note, note) for note in of.get("notes", ()))
    return Target(name, **fields)


def _keys(
    key: str = "", text: str = "", units: Sequence[str] = (), each: Sequence[Any] = (), **row: Any
) -> Iterator[Key | Text]:
    """Keys of a row: a text, a key, those of both sensors with the same formula, or those of each axis."""
    if text:
        yield Text(text, **row)
        return
    if key:
        yield Key(key, **row)
        return
    names = {sensor: row.pop(sensor) for sensor in SENSORS}
    if not each:
        for (sensor, name), unit in zip(names.items(), units, strict=True):
            yield Key(name, sensor=sensor, unit=unit, **row)
    for (k, sensor), axis, of in itertools.product(enumerate(SENSORS), _AXES, each):
        place = names[sensor].format(axis)
        if "text" in of:
            yield Text(f"{place}/{of['text']}", of["value"], sensor=sensor)
        else:
            yield Key(f"{place}/{of['key']}", of["formula"], of["units"][k], sensor, axis)


#: Targets by name.
TARGETS: Mapping[str, Target] = _table()


def target_of(name: str) -> Target:
    """The target that is called so; case, spaces, dashes and underscores do not matter.

    Raises:
        AllanjaxError: there is none; the message lists those there are.
    """
    wanted = _spelt(name)
    for target in TARGETS.values():
        if wanted in map(_spelt, (target.name, target.title, *target.also)):
            return target
    raise AllanjaxError(f"no target {name!r} to export to; there are {', '.join(TARGETS)}")


def _spelt(name: str) -> str:
    return re.sub(r"[\s_./-]+", "", name).lower()

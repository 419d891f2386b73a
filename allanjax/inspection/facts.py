"""Facts about a record: found once when it is inspected, and asked by everything that uses the record."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping
from typing import Any, Literal

from allanjax.base.equality import ByValue

#: What a fact means for the coefficients of its axes.
Consequence = Literal["none", "widened", "not a measurement"]

NOT_A_MEASUREMENT: Consequence = "not a measurement"
# The gravest first.
_ORDER = {"not a measurement": 0, "widened": 1, "none": 2}
# Why coefficients are no measurement of the sensor, by the kind of fact.
_WHY = {
    "at rest": "it was not at rest",
    "saturation": "its range was exceeded",
    "resolution": "its noise is below its resolution",
    "interpolation": "its samples are interpolated",
    "disturbances": "it was disturbed",
    "accel unit": "its unit is not plausible",
    "gyro unit": "its unit is not plausible",
    "rate": "the sample rate is not plausible",
}
# Kinds that a fit does not warn of: it corrects for them, or says so elsewhere.
_QUIET = ("lines", "jitter", "gaps", "dead axes")


@dataclasses.dataclass(frozen=True, eq=False)
class Fact(ByValue):
    """Something about a record that bears on what is estimated from it.

    Attributes:
        kind: what was looked at, by the name of its line in `check`, e.g. "saturation" or "accel unit".
        text: the fact in words: what was found, where, and what to do about it.
        axes: names of the axes that it concerns.
        consequence: what it means for their coefficients: "none"; "widened", for intervals that allow for it;
            "not a measurement" of the sensor, for coefficients without standard deviation and interval.
        size, unit: how large it is; None and "" where no single number says it.
        spans: where it is, as times in s from the first sample; empty for all of the record.
    """

    kind: str
    text: str
    axes: tuple[str, ...]
    consequence: Consequence = "none"
    size: float | None = None
    unit: str = ""
    spans: tuple[tuple[float, float], ...] = ()

    @property
    def grave(self) -> bool:
        """Whether the coefficients of its axes are not a measurement of the sensor."""
        return self.consequence == NOT_A_MEASUREMENT

    def to_dict(self) -> dict[str, Any]:
        """The fact in JSON's types."""
        return dataclasses.asdict(self) | {"axes": list(self.axes), "spans": [list(x) for x in self.spans]}

    @classmethod
    def from_dict(cls, of: Mapping[str, Any]) -> Fact:
        """The fact that `to_dict` wrote."""
        spans = tuple((first, last) for first, last in of["spans"])
        return cls(**{**of, "axes": tuple(of["axes"]), "spans": spans})


def ordered(facts: Iterable[Fact]) -> tuple[Fact, ...]:
    """Facts, the gravest first."""
    return tuple(sorted(facts, key=lambda fact: _ORDER[fact.consequence]))


def warnings_of(facts: Iterable[Fact]) -> tuple[str, ...]:
    """The facts that a user of the coefficients should know, in words, each once."""
    return tuple(dict.fromkeys(fact.text for fact in facts if fact.kind not in _QUIET))


def why_no_measurement(kinds: Iterable[str]) -> str:
    """Why coefficients are no measurement of the sensor, given the kinds of the grave facts, in words."""
    return ", ".join(dict.fromkeys(_WHY.get(kind, kind) for kind in kinds))

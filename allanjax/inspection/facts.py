"""Facts about a recording from its inspection, with helpers that write numbers, times and lists."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence
from typing import Literal, get_args

import numpy as np

from allanjax.base.equality import ByValue
from allanjax.base.wording import clauses, plain
from allanjax.record.recording import Axis
from allanjax.record.units import rate_unit_of

#: What a fact means for the coefficients of its axes, the gravest first.
Consequence = Literal["not a measurement", "widened", "none"]

NOT_A_MEASUREMENT: Consequence = "not a measurement"
# Why coefficients are not a measurement of the sensor, by kind of fact.
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
# Number of items that are listed; further ones are counted.
_NAMED = 3
# Kinds that a fit reports elsewhere, and one that it corrects for unless it widens the intervals.
_QUIET, _CORRECTED = ("jitter", "gaps", "dead axes"), "lines"


@dataclasses.dataclass(frozen=True, eq=False)
class Fact(ByValue):
    """Finding about a recording that affects the estimates from it.

    Attributes:
        kind: name of the check, as in `check`, e.g. "saturation" or "accel unit".
        finding: what was found and where, in words.
        axes: names of the affected axes.
        consequence: effect on their coefficients: "none"; "widened" intervals; or "not a measurement" of the
            sensor, with coefficients that have no standard deviation and no interval.
        size, unit: how large it is; None and "" if no single number describes it.
        spans: where it is, as times in s from the first sample; empty for the whole recording.
        share: share of spectral lines in the power of the axis, drift excluded.
        meaning: what follows for the samples or the estimates, in words.
        remedy: what to do about it, in words.
    """

    kind: str
    finding: str
    axes: tuple[str, ...]
    consequence: Consequence = "none"
    size: float | None = None
    unit: str = ""
    spans: tuple[tuple[float, float], ...] = ()
    share: float | None = None
    meaning: str = ""
    remedy: str = ""

    @property
    def advice(self) -> str:
        """Meaning and remedy."""
        return clauses(self.meaning, self.remedy)

    @property
    def text(self) -> str:
        """Finding, meaning and remedy."""
        return clauses(self.finding, self.advice)

    @property
    def grave(self) -> bool:
        """Whether the coefficients of the affected axes are not a measurement of the sensor."""
        return self.consequence == NOT_A_MEASUREMENT


def ordered(facts: Iterable[Fact]) -> tuple[Fact, ...]:
    """Return the facts, the gravest first."""
    return tuple(sorted(facts, key=lambda fact: get_args(Consequence).index(fact.consequence)))


def warnings_of(facts: Iterable[Fact]) -> tuple[str, ...]:
    """Return the texts of the facts that matter to users of the coefficients, each once."""
    shown = (f for f in facts if f.kind not in _QUIET and (f.kind != _CORRECTED or f.consequence != "none"))
    return tuple(dict.fromkeys(fact.text for fact in shown))


def why_no_measurement(kinds: Iterable[str]) -> str:
    """Return why coefficients are not a measurement of the sensor, given the kinds of the grave facts."""
    return ", ".join(dict.fromkeys(_WHY.get(kind, kind) for kind in kinds))


def grid(duration: float) -> float:
    """Rounding of times [s] for a recording of this length: a power of ten, 1 s for 300 to 3000 s."""
    return float(10.0 ** np.floor(np.log10(duration / 300.0)))


def seconds(time: float, step: float) -> str:
    """Return a time in s, rounded to a multiple of this step."""
    digits = max(0, -int(np.floor(np.log10(step))))
    return f"{round(time / step) * step:.{digits}f}"


def span(first: float, last: float, step: float) -> str:
    """Return a time span as text, e.g. "6–596 s"."""
    return f"{seconds(first, step)}–{seconds(last, step)} s"


def amount(value: float, axis: Axis, digits: int = 2) -> str:
    """Return a rate in the unit of the recording, e.g. "0.21 deg/s"."""
    unit, scale = rate_unit_of(axis.unit, axis.sensor)
    return f"{plain(value / scale, digits)} {unit}"


def listed(words: Sequence[str], most: int = _NAMED) -> str:
    """Return words as a list, e.g. "a, b and c" or "a, b, c and 4 more"."""
    if len(words) > most:
        return f"{', '.join(words[:most])} and {len(words) - most} more"
    return " and ".join(part for part in (", ".join(words[:-1]), *words[-1:]) if part)

"""Interface of the effects that a critique looks for, and places at which weaker ones are sought.

Vibration, interference and knocks affect several axes of a sensor. A frequency or a time that is known from
another axis need not be searched for.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from typing import ClassVar, Literal, NamedTuple

import numpy as np

from allanjax.critic.finding import side_of_limit
from allanjax.critic.policy import judged
from allanjax.critic.view import Candidate, View
from allanjax.noise.estimate import Estimate

_NARROW = judged("line", "quality")
# Reach of a line: in resolved frequencies [1/duration], and in standard deviations of its frequency.
_RESOLVED, _DEVIATIONS = 2.0, 4.0


class Place(NamedTuple):
    """Name of an effect, and the part of the spectrum [Hz] or of the record [s] that it is in."""

    effect: str
    start: float
    end: float

    def meets(self, other: Place) -> bool:
        """Whether both are of one effect, and the middle of one is within the other."""
        middles = 0.5 * (self.start + self.end), 0.5 * (other.start + other.end)
        inside = other.start <= middles[0] <= other.end or self.start <= middles[1] <= self.end
        return self.effect == other.effect and inside


def places_in(view: View, candidates: Iterable[Candidate]) -> list[Place]:
    """Places of the lines and the disturbances among these, and of the view's narrow resonances."""
    found, resolved = [], _RESOLVED / view.duration
    for c in candidates:
        if c.cause == "disturbance":
            found.append(Place(c.cause, *c.support))
        elif c.cause == "sinusoid" and np.isfinite(c.parameters["frequency"].std):
            line = c.parameters["frequency"]
            reach = max(resolved, _DEVIATIONS * line.std)
            found.append(Place(c.cause, line.value - reach, line.value + reach))
    if view.structure is not None:
        for own in (view.structure.components[k] for k in view.structure.oscillators):
            f = own.frequency * view.rate / (2.0 * np.pi)
            reach = max(resolved, f / own.quality)
            if own.quality > _NARROW:
                found.append(Place("spectral_shape", f - reach, f + reach))
    return found


def elsewhere(own: Sequence[Place], others: Sequence[Place]) -> list[Place]:
    """Places of other axes, without duplicates, at which this axis has no finding yet."""
    found: list[Place] = []
    for place in sorted(others, key=lambda place: place.end - place.start):
        if not any(place.meets(known) for known in (*own, *found)):
            found.append(place)
    return found


class Range(NamedTuple):
    """Where a parameter makes sense: beyond it, the effect is another one, or no record shows it.

    Attributes:
        least, most: ends of the range, in the unit of the parameter or as a property of the view.
        may_be_a_limit: whether it may be at an end of its search, where the finding tells a limit.
    """

    least: float | Literal["interval", "resolution"]
    most: float | Literal["duration", "nyquist"]
    may_be_a_limit: bool = False

    def holds(self, e: Estimate, view: View) -> bool:
        """Whether an estimate in a view makes sense."""
        scales = {
            "interval": 1.0 / view.rate,
            "duration": view.duration,
            "resolution": 1.0 / view.duration,
            "nyquist": 0.5 * view.rate,
        }
        least, most = (scales[end] if isinstance(end, str) else end for end in self[:2])
        return least <= e.value <= most and (self.may_be_a_limit or side_of_limit(e) == "")


#: A time between the sample interval and the length of the record; a frequency that the record resolves.
TIMES, FREQUENCIES = Range("interval", "duration"), Range("resolution", "nyquist")


class Effect(ABC):
    """An effect that a sensor's model may lack; `critic.search` has the rule for accepting it."""

    name: str
    #: Whether it is visible directly in the samples and must be undone before the search for others.
    is_preprocessing: ClassVar[bool] = False
    #: When it is refitted if later findings change its conditions: "at once", if its misfit would be mistaken
    #: for other effects, or "at last".
    refit: ClassVar[Literal["", "at once", "at last"]] = ""

    #: Where its parameters make sense, by label; a candidate outside is not accepted.
    sensible: ClassVar[Mapping[str, Range]] = {}

    def __repr__(self) -> str:
        return f"<Effect {self.name}>"

    @abstractmethod
    def detect(self, view: View) -> Candidate | None:
        """Best candidate of this effect in a view, or None."""

    def again(self, view: View, found: Candidate) -> Candidate | None:
        """The finding refitted in a view with other findings; None if nothing remains of it."""
        return self.detect(view)

    def at(self, places: Sequence[Place]) -> Effect:
        """This effect, searching only at places of its own cause that are known from other axes."""
        return self

    def p_value(self, view: View) -> float | None:
        """p-value of this effect's statistic under noise alone, corrected for the search over places.

        None if the effect has no such statistic.
        """
        return None

"""Places of lines and disturbances in one axis, at which weaker ones are detected in the others.

Vibration, interference and knocks affect several axes of a sensor. A frequency or a time that is known from
another axis need not be searched for.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from allanjax.critic.view import Candidate, View

# Reach of a line: in resolved frequencies [1/duration], and in standard deviations of its frequency.
_RESOLVED, _DEVIATIONS = 2.0, 4.0


class Place(NamedTuple):
    """Cause, and the part of the spectrum [Hz] or of the record [s] that it is in."""

    cause: str
    start: float
    end: float

    def meets(self, other: Place) -> bool:
        """Whether both are the same cause, and the middle of one is within the other."""
        middles = 0.5 * (self.start + self.end), 0.5 * (other.start + other.end)
        inside = other.start <= middles[0] <= other.end or self.start <= middles[1] <= self.end
        return self.cause == other.cause and inside


def places_in(view: View, candidates: Iterable[Candidate]) -> list[Place]:
    """Places of the lines and the disturbances among these."""
    found = []
    for c in candidates:
        if c.cause == "disturbance":
            found.append(Place(c.cause, *c.support))
        elif c.cause == "sinusoid" and np.isfinite(c.parameters["frequency"].std):
            line = c.parameters["frequency"]
            reach = max(_RESOLVED / view.duration, _DEVIATIONS * line.std)
            found.append(Place(c.cause, line.value - reach, line.value + reach))
    return found


def elsewhere(own: Sequence[Place], others: Sequence[Place]) -> list[Place]:
    """Places of other axes, without duplicates, at which this axis has no finding yet."""
    found: list[Place] = []
    for place in sorted(others, key=lambda place: place.end - place.start):
        if not any(place.meets(known) for known in (*own, *found)):
            found.append(place)
    return found

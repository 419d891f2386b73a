"""Places of lines, narrow resonances and disturbances in one axis, at which weaker ones are found in others.

Vibration, interference and knocks affect several axes of a sensor. A frequency or a time that is known from
another axis need not be searched for.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from allanjax.critic.policy import judged
from allanjax.critic.view import Candidate, View

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

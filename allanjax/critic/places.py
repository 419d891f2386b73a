"""Frequencies of lines and resonances in one axis, at which the other axes are searched again.

Vibration and interference affect several axes of a sensor. If the frequency is known from one axis, only this
one is tried in the others, so that weaker effects are detected.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from allanjax.critic.policy import judged
from allanjax.critic.view import Candidate, View

_SHARP = judged("line", "quality")
# Reach of a place: in resolved frequencies [1/duration], and in standard deviations of its frequency.
_RESOLVED, _DEVIATIONS = 2.0, 4.0


class Place(NamedTuple):
    """Frequency of a line or a narrow resonance [Hz], its largest error [Hz], and its quality factor."""

    frequency: float
    reach: float
    quality: float

    def holds(self, frequency: float) -> bool:
        """Whether a frequency [Hz] is at this place."""
        return abs(frequency - self.frequency) <= self.reach


def places_in(view: View, candidates: Iterable[Candidate]) -> list[Place]:
    """Places of the lines among these, and of the view's narrow resonances."""
    resolved = _RESOLVED / view.duration
    lines = [c.parameters["frequency"] for c in candidates if c.cause == "sinusoid"]
    found = [
        Place(line.value, max(resolved, _DEVIATIONS * line.std), line.value * view.duration)
        for line in lines
        if np.isfinite(line.std)
    ]
    if view.structure is not None:
        for k in view.structure.oscillators:
            own = view.structure.components[k]
            quality, f = own.quality, own.frequency * view.rate / (2.0 * np.pi)
            if quality > _SHARP:
                found.append(Place(f, max(resolved, f / quality), quality))
    return found


def elsewhere(own: Sequence[Place], others: Sequence[Place]) -> tuple[Place, ...]:
    """Places of other axes, without duplicates, at which this axis has no finding yet."""
    found: list[Place] = []
    for place in sorted(others, key=lambda place: place.reach):
        if not any(place.holds(known.frequency) or known.holds(place.frequency) for known in (*own, *found)):
            found.append(place)
    return tuple(found)

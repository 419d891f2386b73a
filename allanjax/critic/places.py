"""Frequencies of lines in one axis, at which weaker ones are detected in the others.

Vibration and interference affect several axes of a sensor. A frequency that is known from another axis need
not be searched for.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from allanjax.critic.view import Candidate, View

# Reach of a place: in resolved frequencies [1/duration], and in standard deviations of its frequency.
_RESOLVED, _DEVIATIONS = 2.0, 4.0


class Place(NamedTuple):
    """Frequency of a line and its largest error [Hz]."""

    frequency: float
    reach: float

    def holds(self, frequency: float) -> bool:
        """Whether a frequency [Hz] is at this place."""
        return abs(frequency - self.frequency) <= self.reach


def places_in(view: View, candidates: Iterable[Candidate]) -> list[Place]:
    """Places of the lines among these."""
    resolved = _RESOLVED / view.duration
    lines = (c.parameters["frequency"] for c in candidates if c.cause == "sinusoid")
    return [
        Place(line.value, max(resolved, _DEVIATIONS * line.std)) for line in lines if np.isfinite(line.std)
    ]


def elsewhere(own: Sequence[Place], others: Sequence[Place]) -> tuple[Place, ...]:
    """Places of other axes, without duplicates, at which this axis has no finding yet."""
    found: list[Place] = []
    for place in sorted(others, key=lambda place: place.reach):
        if not any(place.holds(known.frequency) or known.holds(place.frequency) for known in (*own, *found)):
            found.append(place)
    return tuple(found)

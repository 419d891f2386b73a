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
    lines = (c.parameters["frequency"] for c in candidates if c.cause == "sinusoid")
    found = [(e.value, _DEVIATIONS * e.std, e.value * view.duration) for e in lines if np.isfinite(e.std)]
    if view.structure is not None:
        shapes = (view.structure.components[k] for k in view.structure.oscillators)
        own = [(shape.frequency * view.rate / (2.0 * np.pi), shape.quality) for shape in shapes]
        found += [(f, f / quality, quality) for f, quality in own if quality > _SHARP]
    return [Place(f, max(error, _RESOLVED / view.duration), quality) for f, error, quality in found]


def elsewhere(own: Sequence[Place], others: Sequence[Place]) -> tuple[Place, ...]:
    """Places of other axes, without duplicates, at which this axis has no finding yet."""
    known = list(own)
    for place in sorted(others, key=lambda place: place.reach):
        if not any(place.holds(other.frequency) or other.holds(place.frequency) for other in known):
            known.append(place)
    return tuple(known[len(own) :])

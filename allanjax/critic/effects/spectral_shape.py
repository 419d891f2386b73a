"""A filter of all noise, and resonances: the structure of the spectrum besides the basic noise terms.

They are searched for together and fitted jointly with the noise (`estimate.spectral`); the findings are
described after the search, from the final model.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import numpy as np

from allanjax.critic.effect import FREQUENCIES, Effect
from allanjax.critic.places import Place
from allanjax.critic.shape import candidate_structure, chance_of_peak, held_out_gain, structure_at
from allanjax.critic.view import Candidate, View
from allanjax.estimate.spectral.model import response_of


class SpectralShape(Effect):
    """A low-pass filter and resonances, or narrow resonances at given places."""

    name = "spectral_shape"
    sensible: ClassVar = {"bandwidth": FREQUENCIES}

    def __init__(self, places: Sequence[Place] = ()) -> None:
        self._places = tuple(places)

    def at(self, places: Sequence[Place]) -> SpectralShape:
        return SpectralShape(places)

    def p_value(self, view: View) -> float:
        return chance_of_peak(view.squared_whitened)

    def detect(self, view: View) -> Candidate | None:
        found = structure_at(view, self._places) if self._places else candidate_structure(view)
        if found is None:
            return None
        after, gain = found
        structure = after.structure
        assert structure is not None
        response = response_of(structure, view.rate)
        corner = [] if response is None else [view.estimate("bandwidth", response.half_power, np.nan, "Hz")]
        # For a filter, and at a known place, the odds are the only statistic.
        p_value = None if self._places or response is not None else self.p_value(view)
        return Candidate(
            self.name,
            corner,
            gain,
            p_value,
            after,
            lambda: held_out_gain(view, structure),
            domain="frequency",
            bound=float(np.exp(-gain)),
            is_shared=bool(self._places),
        )

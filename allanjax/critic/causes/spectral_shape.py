"""A filter of all noise, and resonances: the structure of the spectrum besides the basic noise terms.

They are searched for together and fitted jointly with the noise (`estimate.structure`); the findings are
described after the search, from the final model.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from allanjax.critic.cause import Cause
from allanjax.critic.places import Place
from allanjax.critic.shape import candidate_structure, conspicuous, structure_at
from allanjax.critic.view import Candidate, View
from allanjax.estimate.spectral.components import NONE


class SpectralShape(Cause):
    """A low-pass filter and resonances, or narrow resonances at given frequencies."""

    name = "spectral_shape"

    def __init__(self, places: Sequence[Place] = ()) -> None:
        self._places = tuple(places)

    def at(self, places: Sequence[Place]) -> SpectralShape:
        return SpectralShape(places)

    def p_value(self, view: View) -> float:
        return conspicuous(view.squared_whitened).p_value

    def detect(self, view: View) -> Candidate | None:
        found = structure_at(view, self._places) if self._places else candidate_structure(view)
        if found is None:
            return None
        after, gain = found
        # For a filter, and at a known place, the odds are the only statistic.
        has_odds_only = bool(self._places) or after.structure is None or after.structure.kind != NONE
        p_value = None if has_odds_only else self.p_value(view)
        bound = float(np.exp(-gain))
        return Candidate(self.name, (), gain, p_value, after, lambda: gain, domain="frequency", bound=bound)

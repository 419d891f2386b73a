"""A filter that all noise passes, and resonances: what the spectrum has besides the basic noise terms.

They are looked for together and fitted jointly with the noise (`estimate.structure`); the findings are told
once the search is over, from the model that is handed over.
"""

from __future__ import annotations

import numpy as np

from allanjax.critic.shape import candidate_structure
from allanjax.critic.view import Candidate, Cause, View
from allanjax.critic.windows import conspicuous
from allanjax.estimate.spectral.components import NONE


class SpectralShape(Cause):
    """A low-pass filter and resonances."""

    name = "spectral_shape"

    def p_value(self, view: View) -> float:
        return conspicuous(view.squared_whitened).p_value

    def detect(self, view: View) -> Candidate | None:
        found = candidate_structure(view)
        if found is None:
            return None
        after, gain = found
        # Of a filter there is no statistic but its odds.
        has_filter = after.structure is None or after.structure.kind != NONE
        p_value = None if has_filter else self.p_value(view)
        bound = float(np.exp(-gain))
        return Candidate(self.name, (), gain, p_value, after, lambda: gain, domain="frequency", bound=bound)

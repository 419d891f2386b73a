"""A filter of all noise, and resonances: the structure of the spectrum besides the basic noise terms.

They are searched for together and fitted jointly with the noise (`estimate.structure`); the findings are
described after the search, from the final model.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import numpy as np

from allanjax.critic.cause import FREQUENCIES, Cause
from allanjax.critic.noise import FIXED, MARKOV, coefficient_folds
from allanjax.critic.places import Place
from allanjax.critic.shape import candidate_structure, conspicuous, structure_at
from allanjax.critic.view import Candidate, View
from allanjax.estimate.spectral.components import MARKOV as KIND_OF_MARKOV
from allanjax.estimate.spectral.model import response_of
from allanjax.estimate.structure.search import Record
from allanjax.estimate.structure.structure import Spectrum, Structure, markov


class SpectralShape(Cause):
    """A low-pass filter and resonances, or narrow resonances at given frequencies."""

    name = "spectral_shape"
    sensible: ClassVar = {"bandwidth": FREQUENCIES}

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
            lambda: _held_out(view, structure),
            domain="frequency",
            bound=float(np.exp(-gain)),
        )


def _held_out(view: View, structure: Structure) -> float:
    """Gain in log-likelihood [nats] on each half of the coefficients with the structure from the other half.

    The noise without it has all terms that it may have.
    """
    squares = view.residual**2 if view.base is None else view.residual**2 / view.base
    before = structure.with_shape_of(view.structure or Structure.plain(()))
    for name in set(FIXED) & set(view.allowed):
        before = before.with_column(FIXED.index(name), view.noise.power.get(name, 0.0))
    if MARKOV in view.noise.power and not any(c.kind == KIND_OF_MARKOV for c in before.components):
        time = view.noise.shape * view.rate
        before = before.plus(markov(time, 0.5 * view.noise.power[MARKOV] * view.noise.shape))
    bins = Record(squares, view.rate, structure.further).binned(structure).bins
    gain = 0.0
    for fold in coefficient_folds(view.n):
        mine, other = (
            Spectrum.of(squares, bins, structure.further, half.astype(float)) for half in (fold, ~fold)
        )
        gain += other.loss_of(mine.fit(before)) - other.loss_of(mine.fit(structure))
    return gain

"""Expectations of noise terms, of unit amplitude, at the nodes of a record's levels."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Array, Float

from allanjax.base.arrays import namespace
from allanjax.noise.terms import NoiseTerm
from allanjax.spectrum.cosine import Bins, Part, exact_expectation

# Lags are padded to a multiple of this, so that compiled functions are used again.
_LAGS = 256


class Place(NamedTuple):
    """Where the expectations of a part of a spectrum are evaluated.

    Attributes:
        frequency: nodes of the bins [Hz] (2, m).
        rate: rate of the values that were transformed [Hz].
        length: number of values in a transform.
        lags, weights: lags [s], and weights of G there whose sums are the exact expectations of the lowest
            coefficients; none where these are no part of the spectrum.
    """

    frequency: Any
    rate: Any
    length: Any
    lags: Any
    weights: Any

    @classmethod
    def of(cls, part: Part) -> Place:
        """Place of a part of a spectrum."""
        lags, weights = np.zeros(0), np.zeros((0, 0))
        if part.low:
            lags, weights = exact_expectation(part.n, part.rate, part.low)
            pad = -len(lags) % _LAGS
            lags, weights = np.pad(lags, (0, pad)), np.pad(weights, ((0, 0), (0, pad)))
        return cls(part.node_frequencies, np.asarray(part.rate), np.asarray(float(part.n)), lags, weights)

    def expected(self, term: NoiseTerm) -> Float[Array, "2 m"]:
        """Expected squares [rate²] of the coefficients at the nodes, exact for the lowest ones."""
        xp = namespace(self, term)
        above = self._from_density(term)
        # An oscillating covariance needs too many lags; its difference from a smooth one has a short memory.
        smooth = term.at_low_frequencies() if term.oscillates else term
        if smooth is None or not len(self.lags):
            return above
        low = self.weights @ xp.asarray(smooth.phase_covariance(xp.asarray(self.lags)))
        count = len(low)
        if smooth is not term:
            low = low + (above - self._from_density(smooth))[:, :count]
        return xp.concatenate([xp.broadcast_to(low, (2, count)), above[:, count:]], axis=1)

    def _from_density(self, term: NoiseTerm) -> Float[Array, "2 m"]:
        """Expected squares [rate²] from the density of the samples, but for the record's finite length."""
        ends = term.end_effect(self.frequency, self.rate) / self.length
        return term.sampled_psd(self.frequency, self.rate) * self.rate + ends


def columns_of(terms: Sequence[NoiseTerm], bins: Bins) -> Float[np.ndarray, "terms 2 m"]:
    """Expected squares [rate²] of random terms of unit amplitude at two nodes of each bin.

    The terms' other parameters must have values.
    """
    places = [Place.of(part) for part in bins.parts]
    found = np.zeros((len(terms), 2, len(bins.size)))
    for column, term in zip(found, terms, strict=True):
        unit = term.with_unit_amplitude().sampled(bins.rate)
        column[:] = np.concatenate([np.asarray(place.expected(unit)) for place in places], axis=1)
    return found

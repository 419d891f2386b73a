"""The structure of a spectrum as a factor of the basic terms' spectrum."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from allanjax.critic.noise import NoiseFamily
from allanjax.estimate.spectral.model import FULL
from allanjax.estimate.structure.as_model import markov_of, resonance_of, response_of
from allanjax.estimate.structure.structure import FIXED, OUTSIDE, Structure


def spectrum_factor(structure: Structure, family: NoiseFamily) -> Float[np.ndarray, " n-1"]:
    """Ratio of the whole spectrum to that of the slow terms and white noise before the response."""
    f, rate = family.frequency, family.rate
    inside, after = np.zeros(len(f)), np.zeros(len(f))
    for k in np.flatnonzero(structure.active[: len(FIXED)]):
        part = inside if structure.inside[k] else after
        part += structure.power[k] * family.spectra[k]
    for k in structure.markovs:
        inside += rate * np.asarray(markov_of(structure, int(k), rate).sampled_psd(f, rate))
    noise = inside + after
    for k in structure.oscillators:
        part = inside if structure.inside[FULL.first_oscillator + k] else after
        part += rate * np.asarray(resonance_of(structure, int(k), rate).sampled(rate).sampled_psd(f, rate))
    response = response_of(structure, rate)
    if response is not None:
        inside *= np.asarray(response.power(f, rate))
    after += structure.power[OUTSIDE] * rate
    return (inside + after) / np.maximum(noise, 1e-300)

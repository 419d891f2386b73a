"""The structure of a spectrum as a factor of the basic terms' spectrum, and records behind steep filters.

The cosine transform continues a record by its mirror image, which has kinks at the ends. In a stop band they
may dominate.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import uniform_filter1d

from allanjax.critic.noise import NoiseFamily
from allanjax.estimate.spectral.components import COLUMN, MARKOV, NONE, Levels, passed
from allanjax.estimate.spectral.model import response_of
from allanjax.estimate.structure.structure import FIXED, OUTSIDE, Structure, term_of

# Response below which the record's ends are modelled, and number of coefficients in a local mean.
_DEEP, _LOCAL = 0.01, 401
# Least share of the noise in the whole spectrum.
_LEAST = 1e-12
# Number of frequencies between which what the ends add is interpolated.
_POINTS = 4096


def spectrum_factor(
    structure: Structure, family: NoiseFamily, squares: Float[np.ndarray, " n-1"]
) -> Float[np.ndarray, " n-1"]:
    """Ratio of the whole spectrum to that of the slow terms, a power law and white noise before the response.

    Where the record's ends exceed the filtered noise, it follows the record's own squared coefficients, so
    that these carry no information.
    """
    inside, after, noise = _spectra(structure, family)
    response = response_of(structure, family.rate)
    if response is None:
        return (inside + after) / noise
    factor = (inside * np.asarray(response.power(family.frequency, family.rate)) + after) / noise
    if len(deep := np.flatnonzero(factor < _DEEP)):
        ends = inside[deep] * _of_ends(structure, family.n, deep) / noise[deep]
        own = uniform_filter1d(squares / noise, _LOCAL, mode="nearest")[deep]
        factor[deep] = np.where(ends > factor[deep], np.maximum(own, 1e-9), factor[deep] + ends)
    return factor


def stop_band(
    structure: Structure, family: NoiseFamily, factor: Float[np.ndarray, " n-1"]
) -> tuple[Bool[np.ndarray, " n-1"], Float[np.ndarray, " n-1"]] | None:
    """Where the kinks at a record's ends matter, and the share of the spectrum without them; or None."""
    deep, share = factor < _DEEP, np.ones(len(factor))
    if structure.kind == NONE or not deep.any():
        return None
    share[deep] -= _of_ends(structure, family.n, np.flatnonzero(deep)) / factor[deep]
    return deep, np.clip(share, 1e-9, 1.0)


def _spectra(structure: Structure, family: NoiseFamily) -> Float[np.ndarray, "3 n-1"]:
    """Spectra of all that passes through the response, of all after it, and of the basic terms."""
    found, rate = np.zeros((3, family.n - 1)), family.rate
    for k, own in enumerate(structure.components):
        if own.kind == COLUMN and own.which < len(FIXED):
            spectrum = own.power * family.spectra[own.which]
        else:
            spectrum = family.spectrum(term_of(structure, k, rate).sampled(rate))
        found[0 if own.inside else 1] += spectrum
        if own.kind == MARKOV or (own.kind == COLUMN and own.which != OUTSIDE):
            found[2] += spectrum
    # There may be resonances only.
    np.maximum(found[2], _LEAST * (found[0] + found[1]), out=found[2])
    return found


def _of_ends(structure: Structure, n: int, rows: Int[np.ndarray, " some"]) -> Float[np.ndarray, " some"]:
    """What the ends of a record add to the response of white noise, at some of its coefficients."""
    j = np.linspace(1.0, n - 1.0, min(_POINTS, n - 1))
    angle, no, (wc, Q) = np.pi * j[None] / n, np.zeros(len(j)), structure.bandwidth
    levels = Levels(no, no, angle, np.sin(angle / 2.0) ** 2, 1.0, float(n), no, no)
    whole, without = (
        passed(x, structure.kind, np.full((1, 1), wc), np.full((1, 1), Q))[0]
        for x in (levels, levels.endless)
    )
    return np.interp(rows + 1.0, j, np.maximum(whole - without, 0.0))

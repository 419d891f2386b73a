"""The structure of a spectrum as a factor of the basic terms' spectrum, and records behind steep filters.

The cosine transform continues a record by its mirror image, which has kinks at the ends. In a stop band they
may dominate.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import uniform_filter1d

from allanjax.critic.noise import NoiseFamily, density
from allanjax.estimate.spectral.components import COLUMN, MARKOV, NONE, Levels, passed
from allanjax.estimate.spectral.model import response_of
from allanjax.estimate.structure.structure import FIXED, OUTSIDE, Structure, term_of

# Response below which the record's ends are modelled, and number of coefficients in a local mean.
_DEEP, _LOCAL = 0.01, 401
# Least share of the noise in the whole spectrum.
_LEAST = 1e-12
# Number of frequencies between which what the ends add is interpolated.
_POINTS = 4096
# Distance of knots as a share of that from the lowest frequency or a resonance; number of even ones.
_STEP, _LINEAR = 0.01, 8192


def spectrum_factor(
    structure: Structure, family: NoiseFamily, squares: Float[np.ndarray, " n-1"]
) -> Float[np.ndarray, " n-1"]:
    """Ratio of the whole spectrum to that of the slow terms, a power law and white noise before the response.

    It is evaluated at knots, between which it is linear. Where the record's ends exceed the filtered noise,
    it follows the record's own squared coefficients, so that these carry no information.
    """
    knots, every = _knots(structure, family.n), np.arange(family.n - 1)
    inside, after, noise = _spectra(structure, family, knots)
    response = response_of(structure, family.rate)
    if response is None:
        return np.interp(every, knots, (inside + after) / noise)
    power = np.asarray(response.power(family.frequency[knots], family.rate))
    factor = np.interp(every, knots, (inside * power + after) / noise)
    if len(deep := np.flatnonzero(factor < _DEEP)):
        ends = np.interp(deep, knots, inside / noise) * _of_ends(structure, family.n, deep)
        own = squares / np.interp(every, knots, noise)
        own = uniform_filter1d(own, _LOCAL, mode="nearest")[deep]
        factor[deep] = np.where(ends > factor[deep], np.maximum(own, 1e-9), factor[deep] + ends)
    return factor


def _knots(structure: Structure, n: int) -> Int[np.ndarray, " knots"]:
    """Places of coefficients, from 0, so dense that a spectrum is linear in between to some 10⁻⁵.

    Their distance is a share of that from the lowest one, and of the width of a resonance and the distance
    from it.
    """
    low = np.geomspace(1.0, n - 1.0, int(np.log(n) / _STEP) + 2)
    found = [low, np.linspace(1.0, n - 1.0, _LINEAR)]
    for own in map(structure.components.__getitem__, structure.oscillators):
        middle = own.frequency / np.pi * n
        width = middle / own.quality
        away = np.concatenate([np.arange(0.0, 1.0, _STEP), np.geomspace(1.0, n / width + 2.0, len(low))])
        found += [middle - width * away, middle + width * away]
    places = np.rint(np.concatenate(found)).astype(int) - 1
    return np.unique(np.concatenate([[0, n - 2], places[(places >= 0) & (places <= n - 2)]]))


def stop_band(
    structure: Structure, family: NoiseFamily, factor: Float[np.ndarray, " n-1"]
) -> tuple[Bool[np.ndarray, " n-1"], Float[np.ndarray, " n-1"]] | None:
    """Where the kinks at a record's ends matter, and the share of the spectrum without them; or None."""
    deep, share = factor < _DEEP, np.ones(len(factor))
    if structure.kind == NONE or not deep.any():
        return None
    share[deep] -= _of_ends(structure, family.n, np.flatnonzero(deep)) / factor[deep]
    return deep, np.clip(share, 1e-9, 1.0)


def _spectra(
    structure: Structure, family: NoiseFamily, some: Int[np.ndarray, " knots"]
) -> Float[np.ndarray, "3 knots"]:
    """Spectra of all that passes through the response, of all after it, and of the basic terms, at places."""
    found, rate, frequency = np.zeros((3, len(some))), family.rate, family.frequency[some]
    for k, own in enumerate(structure.components):
        if own.kind == COLUMN and own.which < len(FIXED):
            spectrum = own.power * family.unit(FIXED[own.which], 0)[some]
        else:
            spectrum = rate * density(term_of(structure, k, rate).sampled(rate), frequency, rate)
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

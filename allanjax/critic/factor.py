"""The structure of a spectrum as a factor of the basic terms' spectrum, and records behind steep filters.

The cosine transform continues a record by its mirror image, which has kinks at the ends. In a stop band they
may dominate.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int
from scipy.ndimage import uniform_filter1d

from allanjax.critic.noise import NoiseFamily
from allanjax.estimate.spectral.components import COLUMN, MARKOV, NONE, Levels, passed
from allanjax.estimate.spectral.model import OUTSIDE, Structure, response_of, term_of

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
    knots, every, rate = _knots(structure, family.n), np.arange(family.n - 1), family.rate
    frequency, own = family.frequency[knots], [structure.components[k] for k in structure.there]
    each = np.stack(
        [
            rate * np.asarray(term_of(structure, k, rate).sampled(rate).sampled_psd(frequency, rate))
            for k in structure.there
        ]
    )
    inside, after = (np.array([c.inside == side for c in own]) @ each for side in (True, False))
    noise = np.array([c.kind == MARKOV or (c.kind == COLUMN and c.which != OUTSIDE) for c in own]) @ each
    # There may be resonances only.
    noise = np.maximum(noise, _LEAST * (inside + after))
    response = response_of(structure, rate)
    power = 1.0 if response is None else np.asarray(response.power(frequency, rate))
    factor = np.interp(every, knots, (inside * power + after) / noise)
    if response is not None and len(deep := np.flatnonzero(factor < _DEEP)):
        ends = np.interp(deep, knots, inside / noise) * _of_ends(structure, family.n, deep)
        own_level = squares / np.interp(every, knots, noise)
        own_level = uniform_filter1d(own_level, _LOCAL, mode="nearest")[deep]
        factor[deep] = np.where(ends > factor[deep], np.maximum(own_level, 1e-9), factor[deep] + ends)
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


def share_of_noise(
    structure: Structure, family: NoiseFamily, factor: Float[np.ndarray, " n-1"]
) -> Float[np.ndarray, " n-1"]:
    """Share of the spectrum that is not from the kinks at a record's ends, below 1 in a stop band only."""
    share, deep = np.ones(len(factor)), np.flatnonzero(factor < _DEEP)
    if structure.kind != NONE and len(deep):
        share[deep] -= _of_ends(structure, family.n, deep) / factor[deep]
    return np.clip(share, 1e-9, 1.0)


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

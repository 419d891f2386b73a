"""Conditional simulation of missing samples, given all others."""

from __future__ import annotations

import itertools

import numpy as np
from jaxtyping import Bool, Float

from allanjax.critic.noise import centred
from allanjax.critic.view import View
from allanjax.record.completion import in_time, predicted

# Most draws, and the change of the log spectrum between two draws below which they end.
_DRAWS, _SETTLED = 12, 0.1
# Bins of the record's own spectrum: most per octave, fewest coefficients per bin, and the number of standard
# deviations up to which a difference from the model is chance.
_PARTS, _LEAST, _CHANCE = 32, 64, 3.0


def impute_gaussian(view: View, missing: Bool[np.ndarray, " n"]) -> View:
    """View in which these samples are redrawn, given all others and the record's spectrum.

    A simulated record is corrected by the best prediction of its difference from this one (conditional
    simulation). That is repeated until the spectrum, to which interpolated samples contribute at first, is
    that of the other samples. Samples that were imputed before start from their values.
    """
    rng = np.random.default_rng([int(missing.sum()), int(np.argmax(missing))])
    fresh, known = np.flatnonzero(missing & ~view.imputed), np.flatnonzero(~missing)
    x = view.samples.copy()
    x[fresh] = np.interp(fresh, known, x[known])
    first = view.with_samples(x, missing)
    c, model = first.coefficients, first.variance()
    v, changed = _own_variance(c, model), np.inf
    for _ in range(_DRAWS):
        draw = in_time(np.sqrt(v) * rng.standard_normal(view.n - 1)) + x.mean()
        x = np.where(missing, draw + predicted(x - draw, missing, v), x)
        c = centred(x)
        before, v = v, _own_variance(c, model)
        last, changed = changed, float(np.max(abs(np.log(v / before))))
        # A change no smaller than the last one is chance, e.g. from redrawing a long gap.
        if changed < _SETTLED or changed > last:
            break
    return view.with_samples(x, missing, c)


def _own_variance(c: Float[np.ndarray, " n-1"], v: Float[np.ndarray, " n-1"]) -> Float[np.ndarray, " n-1"]:
    """Expected squared coefficients: a model's, or the record's own in bins where it differs beyond chance.

    This allows for effects that have not been found yet, such as a filter.
    """
    n = len(c) + 1
    octaves = np.append(2 ** np.arange(int(np.log2(n - 1)) + 1) - 1, n - 1)
    parts = [
        np.linspace(low, high, int(np.clip((high - low) // _LEAST, 1, _PARTS)) + 1)
        for low, high in itertools.pairwise(octaves)
    ]
    first = np.unique(np.concatenate(parts).astype(int))
    count = np.diff(first)
    level = np.log(np.maximum(np.add.reduceat(c**2 / v, first[:-1]), 1e-300) / count)
    # Gradually, as bins at the edge of chance would otherwise switch from draw to draw.
    level *= np.clip(abs(level) / np.sqrt(2.0 / count) - _CHANCE, 0.0, 1.0)
    middle = 0.5 * (first[:-1] + first[1:] - 1)
    return v * np.exp(np.interp(np.arange(n - 1), middle, level))

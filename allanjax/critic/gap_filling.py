"""Conditional simulation of missing samples, given all others."""

from __future__ import annotations

import itertools

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.fft import dct

from allanjax.critic.view import View, in_time

# Most draws, and the change of the log spectrum between two of them that ends them.
_DRAWS, _SETTLED = 12, 0.1
# Bins of the record's own spectrum: most in an octave, fewest coefficients in one, and the standard
# deviations up to which its difference from the model is chance.
_PARTS, _LEAST, _CHANCE = 32, 64, 3.0
# Conjugate gradients: most steps, the part of d'C⁻¹d that does not matter, samples that are solved for at
# once.
_CONJUGATE, _EXACT, _BLOCK = 60, 1e-2, 256


def impute_gaussian(view: View, missing: Bool[np.ndarray, " n"]) -> View:
    """View in which these samples are drawn anew, given all others and the record's spectrum.

    A simulated record is corrected by the best prediction of its difference from this one (conditional
    simulation). That is repeated until the spectrum, to which interpolated samples contribute at first, is
    that of the other samples. Samples that were imputed before begin as they are.
    """
    rng = np.random.default_rng([int(missing.sum()), int(np.argmax(missing))])
    fresh, known = np.flatnonzero(missing & ~view.imputed), np.flatnonzero(~missing)
    x = view.samples.copy()
    x[fresh] = np.interp(fresh, known, x[known])
    after = view.with_samples(x, missing)
    v, changed = _own_variance(after), np.inf
    for _ in range(_DRAWS):
        draw = in_time(np.sqrt(v) * rng.standard_normal(view.n - 1)) + after.samples.mean()
        after = after.with_samples(
            np.where(missing, draw + _predicted(after.samples - draw, missing, v), after.samples)
        )
        before, v = v, _own_variance(after)
        last, changed = changed, float(np.max(abs(np.log(v / before))))
        # What changes no less than the last time is chance, as of a long gap that is drawn anew.
        if changed < _SETTLED or changed > last:
            break
    return after


def _own_variance(view: View) -> Float[np.ndarray, " n-1"]:
    """Expected squared coefficients: the model's, or the record's own in bins where it differs beyond chance.

    So effects that have not been found yet, such as a filter, are allowed for.
    """
    n, v = view.n, view.variance()
    octaves = np.append(2 ** np.arange(int(np.log2(n - 1)) + 1) - 1, n - 1)
    parts = [
        np.linspace(low, high, int(np.clip((high - low) // _LEAST, 1, _PARTS)) + 1)
        for low, high in itertools.pairwise(octaves)
    ]
    first = np.unique(np.concatenate(parts).astype(int))
    count = np.diff(first)
    level = np.log(np.maximum(np.add.reduceat(view.coefficients**2 / v, first[:-1]), 1e-300) / count)
    # Gradually: what is at the edge of chance would come and go from draw to draw.
    level *= np.clip(abs(level) / np.sqrt(2.0 / count) - _CHANCE, 0.0, 1.0)
    middle = 0.5 * (first[:-1] + first[1:] - 1)
    return v * np.exp(np.interp(np.arange(n - 1), middle, level))


def _predicted(
    d: Float[np.ndarray, " n"], missing: Bool[np.ndarray, " n"], v: Float[np.ndarray, " n-1"]
) -> Float[np.ndarray, " n"]:
    """Best prediction of the missing samples of d, which minimizes d'C⁻¹d, by conjugate gradients.

    The preconditioner solves neighbouring gaps together, which depend on each other behind a filter. For a
    long gap it is the covariance, which is nearly the inverse but for the gap's ends.
    """
    gaps, full = np.flatnonzero(missing), np.zeros(len(d))
    long, weight = _long(missing)[gaps], 1.0 / v
    short = np.flatnonzero(~long)

    def filtered(y: Float[np.ndarray, " n"], by: Float[np.ndarray, " n-1"]) -> Float[np.ndarray, " gaps"]:
        return in_time(dct(y, norm="ortho", workers=-1)[1:] * by)[gaps]

    def precision(y: Float[np.ndarray, " n"]) -> Float[np.ndarray, " gaps"]:
        return filtered(y, weight)

    blocks = _inverses(gaps[short], v)

    def nearly_solved(residual: Float[np.ndarray, " gaps"]) -> Float[np.ndarray, " gaps"]:
        solved = residual.copy()
        if long.any():
            full[gaps] = np.where(long, residual, 0.0)
            solved = filtered(full, v)
        parts = np.split(residual[short], range(_BLOCK, len(short), _BLOCK))
        solved[short] = np.concatenate([inverse @ part for inverse, part in zip(blocks, parts, strict=True)])
        return solved

    y = np.interp(np.arange(len(d)), np.flatnonzero(~missing), d[~missing])
    residual = -precision(y)
    direction = nearly_solved(residual)
    square = float(residual @ direction)
    for _ in range(_CONJUGATE):
        if square <= _EXACT:
            break
        full[gaps] = direction
        image = precision(full)
        a = square / float(direction @ image)
        y[gaps] += a * direction
        residual -= a * image
        conditioned = nearly_solved(residual)
        square, old = float(residual @ conditioned), square
        direction = conditioned + square / old * direction
    return y


def _long(missing: Bool[np.ndarray, " n"]) -> Bool[np.ndarray, " n"]:
    """Whether a sample is in a gap longer than a block of the preconditioner."""
    first, end = np.flatnonzero(np.diff(missing, prepend=False, append=False)).reshape(-1, 2).T
    long = np.zeros(len(missing), bool)
    for k in np.flatnonzero(end - first > _BLOCK):
        long[first[k] : end[k]] = True
    return long


def _inverses(
    gaps: Int[np.ndarray, " gaps"], v: Float[np.ndarray, " n-1"]
) -> list[Float[np.ndarray, "block block"]]:
    """Inverses of the precision between missing samples, block by block: ½[r(i − k) + r(i + k + 1)]."""
    n = len(v) + 1
    r = dct(np.concatenate([[0.0], 1.0 / v, [0.0]]), type=1, workers=-1) / n
    found = []
    for some in np.split(gaps, range(_BLOCK, len(gaps), _BLOCK)):
        total = some[:, None] + some + 1
        precision = 0.5 * (r[abs(some[:, None] - some)] + r[np.minimum(total, 2 * n - total)])
        found.append(np.linalg.inv(precision))
    return found

"""What causes that change the spectrum have in common: a likelihood of the whitened levels in fine bins."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from allanjax.critique.view import View

_PER_OCTAVE = 64
_NEAR = 400


def fine_bins(n: int, centre: float | None = None, width: float = 1.0) -> np.ndarray:
    """First indices (of coefficients 1 … n−1, from 0) of bins: 64 an octave, finer around a place."""
    log = np.unique(np.rint(2.0 ** (np.arange(0.0, np.log2(n) * _PER_OCTAVE) / _PER_OCTAVE)))
    edges = log
    if centre is not None:
        step = max(width / 16.0, 1.0)
        near = centre + step * np.arange(-_NEAR, _NEAR + 1)
        edges = np.concatenate([log[(log < near[0]) | (log > near[-1])], np.rint(near)])
    edges = np.unique(edges.astype(int) - 1)
    return edges[(edges >= 0) & (edges < n - 1)]


def sums(values: Float[np.ndarray, " n-1"], first: np.ndarray) -> Float[np.ndarray, " bins"]:
    """Over bins."""
    return np.add.reduceat(values, first)


def log_likelihood(
    squares: Float[np.ndarray, " bins"], size: Float[np.ndarray, " bins"], ratio: Float[np.ndarray, " bins"]
) -> float:
    """Of sums of whitened squares whose expectation is `ratio` times their number."""
    return float(-0.5 * np.sum(size * np.log(ratio) + squares / ratio))


def predictive(
    c: Float[np.ndarray, " n-1"],
    v: Float[np.ndarray, " n-1"],
    fold: Bool[np.ndarray, " n-1"],
) -> float:
    """Log-likelihood of the coefficients in a fold."""
    return float(-0.5 * np.sum((np.log(v) + c**2 / v)[fold]))


def coefficient_folds(n: int) -> tuple[np.ndarray, np.ndarray]:
    """Every other pair of coefficients, and the others: independent, and both see the whole spectrum.

    Pairs, since a shape that is odd about the record's middle has odd coefficients only.
    """
    some = np.arange(n - 1) // 2 % 2 == 0
    return some, ~some


def baseline_predictive(view: View, fold: Bool[np.ndarray, " n-1"]) -> float:
    """Log-likelihood outside a fold of the best basic noise in it."""
    noise = view.family.of(view.c, view.factor, fold).best(view.allowed)
    return predictive(view.c, view.variance(noise), ~fold)

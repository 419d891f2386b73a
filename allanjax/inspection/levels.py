"""Levels of an output: the step that all samples are multiples of, and whether it is clipped at its range."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

#: Distance from a multiple of the step, in steps, up to which a sample is on the lattice.
TOLERANCE = 1e-3
# Least share of the gaps between values that are multiples of the step.
_SHARE = 0.999
# Number of different values up to which there may be a lattice although most samples differ.
_FEW = 20000
# Fewest runs of samples at the largest value, or fewest such samples, that are not by chance: judgements.
_LEAST, _MANY = 4, 100
# Fewest steps of a rounded output between its extremes for it to have a tail.
_FEW_LEVELS = 4


def lattice(x: Float[np.ndarray, " n"]) -> float | None:
    """Step between the samples' values, if these are on a lattice, else None."""
    values = np.unique(x)
    least = 1e-9 * float(np.max(abs(values))) + 1e-300
    gaps = np.diff(values)
    gaps = gaps[gaps > least]
    if len(gaps) < 1 or (len(values) > max(len(x) / 2.0, 3) and len(values) > _FEW):
        return None
    q = float(gaps.min())
    for _ in range(3):
        steps = np.rint(gaps / q)
        q = float(np.sum(gaps) / np.sum(steps))
    off = abs(gaps / q - np.rint(gaps / q))
    return q if np.mean(off < TOLERANCE * np.maximum(np.rint(gaps / q), 1.0)) > _SHARE else None


def is_piled_up(raw: Float[np.ndarray, " n"], q: float | None) -> bool:
    """Whether more samples are at the largest value than a tail would leave there."""
    top = raw.max()
    at_top = int(np.sum(raw == top))
    if q is None:
        clipped = np.concatenate([[0], (raw == top).astype(int), [0]])
        # Copies of one extreme sample are another matter.
        return int(np.sum(np.diff(clipped) == 1)) >= _LEAST or at_top >= _MANY
    if np.ptp(raw) < _FEW_LEVELS * q:
        return False
    below = int(np.sum(abs(raw - (top - q)) < q / 2.0))
    return at_top > below + 6.0 * np.sqrt(below + 1.0) and at_top >= 5 * _LEAST

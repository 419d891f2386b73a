"""Levels of a cosine spectrum as the joint spectral model takes them: always of one shape."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from allanjax.base.errors import FitError

#: Number of levels, the last of which only pad the arrays: one compiled program serves every record.
LEVELS = 640
#: Columns for the terms without a free shape.
COLUMNS = 8
# Single coefficients at the low end, and levels an octave above them.
_SINGLE = 64
_PER_OCTAVE = 24
# Levels on either side of a resonance; they begin with an eighth of its width, and grow by this factor.
_AROUND = 12
_GROWTH = 1.25


class Levels(NamedTuple):
    """Levels of the cosine spectrum with what their expectations depend on, in sample intervals.

    A level is χ² around its expectation with 2·shape degrees of freedom; one with shape 0 only pads.

    Attributes:
        level: mean squares of coefficients [rate²].
        shape: half the degrees of freedom of each.
        angle: frequencies in radians per sample interval at two nodes of each level, whose mean and variance
            are those of its coefficients (2, m).
        interval: number of samples that each value was averaged from before the transform, 1 of a record.
        length: number of values in the transform that it comes from.
        parity: (−1)^j of a single coefficient j, else 0.
        columns: expectations [rate²] of the terms without a free shape at the nodes, for unit power
            (columns, 2, m).
    """

    level: Any
    shape: Any
    angle: Any
    interval: Any
    length: Any
    parity: Any
    columns: Any


def level_edges(n: int, resonances: tuple[tuple[float, float], ...] = ()) -> Int[np.ndarray, " m+1"]:
    """First coefficients of the levels of a transform of n values, and the one after the last.

    Single coefficients up to 64, then up to 24 levels an octave, finer around resonances, each given by its
    frequency in cycles per value and its width in the same unit.

    Raises:
        FitError: fewer than 16 values.
    """
    if n < 16:
        raise FitError(f"{n} samples are too few for a spectrum; record at least 16")
    top = min(_SINGLE, n - 1)
    per_octave = min(_PER_OCTAVE, (LEVELS - top - 2 * _AROUND * len(resonances)) / np.log2(n / top + 1e-9))
    growing = top * 2.0 ** (np.arange(1.0, np.floor(per_octave * np.log2(n / top))) / per_octave)
    edges = [np.arange(1, top + 2), np.rint(growing) + 1.0, [n]]
    for frequency, width in resonances:
        j, step = 2.0 * n * frequency, max(2.0 * n * width / 8.0, 1.0)
        away = np.cumsum(step * _GROWTH ** np.arange(_AROUND)) - step / 2.0
        edges += [np.rint(j - away), np.rint(j + away)]
    found = np.unique(np.concatenate(edges)).astype(int)
    return found[(found <= top + 1) & (found >= 1) | (found > top + 1) & (found <= n)]


def padded(x: Float[np.ndarray, "... m"], fill: float) -> Float[np.ndarray, "... levels"]:
    """Values of m levels followed by `fill` for the levels that pad."""
    return np.pad(x, [(0, 0)] * (x.ndim - 1) + [(0, LEVELS - x.shape[-1])], constant_values=fill)


def node_angles(edges: Int[np.ndarray, " m+1"], n: int) -> Float[np.ndarray, "2 m"]:
    """Angles at two nodes of each level, which have the mean and the variance of its coefficients' angles."""
    first, size = edges[:-1], np.diff(edges)
    away = np.sqrt((size**2 - 1.0) / 12.0)
    return np.pi / n * (first + (size - 1.0) / 2.0 + np.stack([-away, away]))


def levels_of(
    level: Float[np.ndarray, " m"],
    dof: Float[np.ndarray, " m"],
    edges: Int[np.ndarray, " m+1"],
    n: int,
    columns: Float[np.ndarray, "columns 2 m"],
) -> Levels:
    """Padded levels of the transform of n samples.

    Args:
        level, dof: mean square of each level's coefficients [rate²], and its degrees of freedom.
        edges: first coefficients of the levels, see `level_edges`.
        n: number of samples.
        columns: expectations of at most eight terms without a free shape at the nodes, for unit power.
    """
    first, size = edges[:-1], np.diff(edges)
    parity = np.where(size == 1, 1.0 - 2.0 * (first % 2), 0.0)
    m = len(level)
    return Levels(
        level=padded(level, 1.0),
        shape=padded(dof / 2.0, 0.0),
        angle=padded(node_angles(edges, n), np.pi / 2.0),
        interval=padded(np.ones(m), 1.0),
        length=padded(np.full(m, float(n)), float(n)),
        parity=padded(parity, 0.0),
        columns=padded(np.pad(columns, [(0, COLUMNS - len(columns)), (0, 0), (0, 0)]), 0.0),
    )

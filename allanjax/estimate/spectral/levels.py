"""Levels of a cosine spectrum as the joint spectral model takes them: in arrays of few different lengths."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Shaped

from allanjax.spectrum.cosine import Bins

#: Numbers of levels of which the last only pad the arrays: few compiled programs serve every record.
CAPACITIES = (256, 640, 1280)


class Levels(NamedTuple):
    """Levels of the cosine spectrum with what their expectations depend on, in sample intervals.

    A level is χ² around its expectation with 2·shape degrees of freedom; one with shape 0 only pads.

    Attributes:
        level: mean squares of coefficients [rate²].
        shape: half the degrees of freedom of each.
        angle: frequencies in radians per sample interval at two nodes of each level, whose mean and variance
            are those of its coefficients (2, m).
        interval: number of samples that each value was averaged from before the transform, 1 of a record;
            one number for a record, one for each level of a stream.
        length: number of values in the transform that it comes from, likewise.
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

    def with_data(self, level: Float[np.ndarray, " m"], dof: Float[np.ndarray, " m"]) -> Levels:
        """Copy with these mean squares [rate²] and degrees of freedom, without padding."""
        capacity = len(self.shape)
        return self._replace(level=padded(level, capacity, 1.0), shape=padded(dof / 2.0, capacity, 0.0))


def capacity_of(count: int) -> int:
    """Number of levels that arrays have room for, of which so many are needed."""
    fitting = [capacity for capacity in CAPACITIES if capacity >= count]
    return fitting[0] if fitting else -(-count // CAPACITIES[-1]) * CAPACITIES[-1]


def padded(x: Shaped[np.ndarray, "... m"], capacity: int, fill: float) -> Shaped[np.ndarray, "... capacity"]:
    """Values of m levels, terms or shapes followed by `fill` for those that pad."""
    return np.pad(x, [(0, 0)] * (x.ndim - 1) + [(0, capacity - x.shape[-1])], constant_values=fill)


def levels_of(
    bins: Bins, columns: Float[np.ndarray, "terms 2 m"], slots: int, capacity: int | None = None
) -> Levels:
    """Levels of bins, without data yet.

    Args:
        bins: the bins.
        columns: expectations of terms without a free shape at the nodes, for unit power.
        slots: number of columns that there is room for.
        capacity: number of levels that there is room for; the least that fits if not given.
    """
    angle, interval, length, parity = ([] for _ in range(4))
    for part in bins.parts:
        first, size = part.edges[:-1], np.diff(part.edges)
        angle.append(2.0 * np.pi * part.node_frequencies / bins.rate)
        interval.append(np.full(len(size), np.rint(bins.rate / part.rate)))
        length.append(np.full(len(size), float(part.n)))
        parity.append(np.where(size == 1, 1.0 - 2.0 * (first % 2), 0.0))
    m, parts, whole = len(bins.size), len(bins.parts), float(bins.parts[0].n)
    capacity = capacity_of(m) if capacity is None else capacity
    room = [(0, slots - len(columns)), (0, 0), (0, 0)]
    return Levels(
        level=padded(np.ones(m), capacity, 1.0),
        shape=np.zeros(capacity),
        angle=padded(np.concatenate(angle, axis=1), capacity, np.pi / 2.0),
        interval=padded(np.concatenate(interval), capacity, 1.0) if parts > 1 else np.asarray(1.0),
        length=padded(np.concatenate(length), capacity, whole) if parts > 1 else np.asarray(whole),
        parity=padded(np.concatenate(parity), capacity, 0.0),
        columns=padded(np.pad(columns, room), capacity, 0.0),
    )

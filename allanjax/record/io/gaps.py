"""Stretches without gaps, and samples on the even grid of times that gaps leave places in."""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Bool, Float, Int

from allanjax.record.io.timestamps import after_gaps


def without_repeats(
    values: Float[np.ndarray, "samples axes"], times: Float[np.ndarray, " samples"]
) -> Bool[np.ndarray, " samples"]:
    """Which samples are not those before them once more, with the same time."""
    same = (values[1:] == values[:-1]) | (np.isnan(values[1:]) & np.isnan(values[:-1]))
    return np.concatenate([[True], ~(same.all(axis=1) & (np.diff(times) == 0.0))])


def longest_stretch(
    values: Float[np.ndarray, "samples axes"], times: Float[np.ndarray, " samples"] | None
) -> tuple[slice, int]:
    """Rows of the longest stretch in which no sample is missing, and how many stretches there are.

    An axis that has no value at all is not counted.
    """
    lost = np.isnan(values)
    whole = ~lost[:, ~lost.all(axis=0)].any(axis=1)
    begins = whole & ~np.concatenate([[False], whole[:-1]])
    if times is not None:
        begins |= whole & after_gaps(times)
    first = np.flatnonzero(begins)
    if not first.size:
        return slice(0, 0), 0
    # A stretch ends where the next begins, or at the first sample after it that is not whole.
    ends = np.append(first[1:], len(values))
    lengths = np.add.reduceat(whole.astype(int), first)
    k = int(np.argmax(lengths))
    return slice(int(first[k]), int(min(first[k] + lengths[k], ends[k]))), len(first)


def on_grid(
    values: Float[np.ndarray, "samples axes"],
    auxiliary: Mapping[str, Float[np.ndarray, " samples"]],
    places: Int[np.ndarray, " samples"],
) -> tuple[Float[np.ndarray, "n axes"], dict[str, Float[np.ndarray, " n"]]]:
    """Samples at their places on an even grid, nan at the others; auxiliary channels are interpolated."""
    n = int(places[-1]) + 1
    if n == len(values):
        return values, dict(auxiliary)
    full = np.full((n, values.shape[1]), np.nan)
    full[places] = values
    grid = np.arange(n)
    return full, {name: np.interp(grid, places, column) for name, column in auxiliary.items()}

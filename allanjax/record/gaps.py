"""Stretches without gaps, and samples on the even grid of times that gaps leave places in."""

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Bool, Float, Int

from allanjax.record.validation import Source


def without_repeats(
    values: Float[np.ndarray, "samples axes"], times: Float[np.ndarray, " samples"]
) -> Bool[np.ndarray, " samples"]:
    """Which samples are not those before them once more, with the same time."""
    same = (values[1:] == values[:-1]) | (np.isnan(values[1:]) & np.isnan(values[:-1]))
    return np.concatenate([[True], ~(same.all(axis=1) & (np.diff(times) == 0.0))])


def longest_stretch(
    values: Float[np.ndarray, "samples axes"], after_gap: Bool[np.ndarray, " samples"]
) -> tuple[slice, int]:
    """Rows of the longest stretch in which no sample is missing, and how many stretches there are.

    An axis that has no value at all is not counted. `after_gap` are samples before which others are missing.

    Others are left out: a difference of clusters of length T needs a stretch of 2T, so that slow terms are
    those of the longest one in any case, and between stretches they are not independent, as a sum of
    likelihoods would take them to be. All samples are used where the missing ones are drawn.
    """
    lost = np.isnan(values)
    whole = ~lost[:, ~lost.all(axis=0)].any(axis=1)
    begins = whole & (after_gap | ~np.concatenate([[False], whole[:-1]]))
    first = np.flatnonzero(begins)
    if not first.size:
        return slice(0, 0), 0
    # A stretch ends where the next begins, or at the first sample after it that is not whole.
    ends = np.append(first[1:], len(values))
    lengths = np.add.reduceat(whole.astype(int), first)
    k = int(np.argmax(lengths))
    return slice(int(first[k]), int(min(first[k] + lengths[k], ends[k]))), len(first)


def stretch_told(rows: slice, n: int, count: int) -> str:
    """Which samples were taken, in a note."""
    return (
        f"samples {rows.start} to {rows.stop - 1} of {n} taken, the longest of {count} stretches without "
        "gaps; gaps='fill' (--gaps fill) uses all"
    )


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


def runs_of(missing: Bool[np.ndarray, "samples axes"], labels: Sequence[str]) -> dict[str, list[int]]:
    """First sample and the one after the last of every gap, in turn, by the axes' labels."""
    edges = (np.flatnonzero(np.diff(lost, prepend=False, append=False)).tolist() for lost in missing.T)
    return dict(zip(labels, edges, strict=True))


def check_choice(gaps: str, source: Source) -> None:
    """Raise RecordingError if `gaps` is no choice of what to do about missing samples."""
    if gaps not in ("error", "segments", "fill"):
        raise source.error(f"gaps= must be error, segments or fill, not {gaps!r}")

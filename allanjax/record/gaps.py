"""Stretches without gaps, and samples on the even grid of times that gaps leave places in."""

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from allanjax.record.validation import Source


def without_repeats(
    values: Float[np.ndarray, "samples axes"], times: Float[np.ndarray, " samples"]
) -> Bool[np.ndarray, " samples"]:
    """Which samples are not those before them once more, with the same time."""
    same = (values[1:] == values[:-1]) | (np.isnan(values[1:]) & np.isnan(values[:-1]))
    return np.concatenate([[True], ~(same.all(axis=1) & (np.diff(times) == 0.0))])


# Tolerance, in samples, within which a time is that of a sample: room for rounding.
_TIME_SLACK = 1e-6
# Samples of a stretch that has a spectrum of its own, and stretches that are fitted together.
_LEAST, _MOST = 64, 16


class Gap(NamedTuple):
    """Samples that are missing, as places on the recording's grid of times, whose first sample is number 0.

    Attributes:
        first: number of the first one; negative before the stretch that was taken.
        samples: how many there are; 0 where the clock was set back, so that this is unknown.
    """

    first: int
    samples: int


class Stretches(NamedTuple):
    """Stretches of a record in which no sample is missing.

    Attributes:
        every: rows of each, in the order of time.
        longest: rows of the longest.
        others: rows of others of 64 samples and more, the longest fifteen of them, in the order of time.
    """

    every: tuple[slice, ...]
    longest: slice
    others: tuple[slice, ...]

    def gaps(self, times: Float[np.ndarray, " samples"], rate: float) -> tuple[Gap, ...]:
        """Gaps between the stretches, given all samples' times [s] and their rate [Hz]."""
        places = np.rint((times - times[self.longest.start]) * rate).astype(int)
        ends = places[[rows.stop - 1 for rows in self.every[:-1]]] + 1
        lost = places[[rows.start for rows in self.every[1:]]] - ends
        return tuple(map(Gap, ends.tolist(), np.maximum(lost, 0).tolist()))

    def told(self, n: int) -> tuple[str, ...]:
        """Which samples of n were taken, in notes; none if all of them."""
        if len(self.every) < 2:
            return ()
        others = f"; {len(self.others)} others are kept for Allan deviations and fits" if self.others else ""
        return (
            f"samples {self.longest.start} to {self.longest.stop - 1} of {n} taken, the longest of "
            f"{len(self.every)} stretches without gaps{others}; gaps='fill' (--gaps fill) uses all",
        )


def stretches_of(
    values: Float[np.ndarray, "samples axes"], after_gap: Bool[np.ndarray, " samples"]
) -> Stretches:
    """Stretches in which no sample is missing.

    An axis that has no value at all is not counted. `after_gap` are samples before which others are missing.
    """
    lost = np.isnan(values)
    whole = ~lost[:, ~lost.all(axis=0)].any(axis=1)
    begins = whole & (after_gap | ~np.concatenate([[False], whole[:-1]]))
    first = np.flatnonzero(begins)
    if not first.size:
        return Stretches((), slice(0, 0), ())
    # A stretch ends where the next begins, or at the first sample after it that is not whole.
    ends = np.append(first[1:], len(values))
    lengths = np.add.reduceat(whole.astype(int), first)
    rows = [
        slice(begin, min(begin + length, end))
        for begin, length, end in zip(first.tolist(), lengths.tolist(), ends.tolist(), strict=True)
    ]
    order = sorted(range(len(rows)), key=lambda k: rows[k].start - rows[k].stop)
    kept = [k for k in order[1:_MOST] if rows[k].stop - rows[k].start >= _LEAST]
    return Stretches(tuple(rows), rows[order[0]], tuple(rows[k] for k in sorted(kept)))


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


def gaps_of(missing: Bool[np.ndarray, "samples axes"]) -> tuple[Gap, ...]:
    """Gaps in which samples of at least one axis are missing."""
    edges = np.diff(missing.any(axis=1), prepend=False, append=False)
    return tuple(Gap(a, b - a) for a, b in np.flatnonzero(edges).reshape(-1, 2).tolist())


def gaps_within(gaps: Iterable[Sequence[int]] | None, first: int, last: int) -> tuple[Gap, ...] | None:
    """The parts of gaps that are between two samples, numbered from the former."""
    if gaps is None:
        return None
    inner = ((max(begin, first), min(begin + samples, last)) for begin, samples in gaps)
    return tuple(Gap(begin - first, end - begin) for begin, end in inner if begin < end)


def check_choice(gaps: str, source: Source) -> None:
    """Raise RecordingError if `gaps` is no choice of what to do about missing samples."""
    if gaps not in ("error", "segments", "fill"):
        raise source.error(f"gaps= must be error, segments or fill, not {gaps!r}")


def rows_between(samples: int, rate: float, start: float | None, stop: float | None) -> slice:
    """Rows of the samples at times in [start, stop), in s from the first sample."""
    first = 0 if start is None else int(np.ceil(start * rate - _TIME_SLACK))
    last = samples if stop is None else int(np.ceil(stop * rate - _TIME_SLACK))
    first = min(max(first, 0), samples)
    return slice(first, max(first, min(last, samples)))

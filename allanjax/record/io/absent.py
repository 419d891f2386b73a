"""What stands in a table where a sensor has no sample: markers, failed reads, held values, padding, wraps."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from allanjax.base.wording import plain
from allanjax.record.columns import Column, axes_by_sensor
from allanjax.record.completion import runs_of
from allanjax.record.shapes import Channel, Chosen, Values, Which

# A marker is farther from all other samples than so many of their standard deviations (or steps, if these are
# larger), and occurs so often.
_FAR, _LEAST = 20.0, 3
# All other samples are nearer to their middle than this share of its distance.
_HALF = 0.5
# Share of the rows with a marker in which other axes have it, too, if all are written at once.
_AT_ONCE = 0.9
# So many samples that are zero on all axes may be expected by chance.
_BY_CHANCE = 1e-3
# Equal samples in a row are held ones if there are so many, and a sensor that is alive has them in a record
# with less than this probability.
_SHORTEST, _CHANCE = 32, 1e-9
# Least probability of equal neighbours that is assumed.
_EQUAL = 1e-3
# Largest share of held samples within a record that are left out.
_MOST_HELD = 0.05
# Share of equal neighbours above which a sensor is slower than its rows.
_SLOWER = 0.5
# Bits of the numbers that wrap, and the least distance of the wrapped samples, in standard deviations.
_BITS, _APART = (8, 12, 16, 24, 32), 10.0
# Share of the range about its middle in which there is none of them.
_BETWEEN = 0.1
# Samples from which the smallest step between values is determined.
_LOOKED_AT = 1 << 15


class Absent(NamedTuple):
    """Which values are no samples.

    Attributes:
        values: the values, with wrapped ones shifted back.
        at: where there is no sample.
        notes: what was found, for users.
    """

    values: Values
    at: Which
    notes: tuple[str, ...]

    @property
    def ends(self) -> slice:
        """Rows without those at the ends in which a sensor has no sample."""
        there = np.flatnonzero(~self.at.any(axis=1))
        if not len(there):
            return slice(0, len(self.at))
        return slice(int(there[0]), int(there[-1]) + 1)


def without_samples(values: Values, columns: Sequence[Column]) -> Absent:
    """Find the values that are no samples, and shift back those that have wrapped.

    Args:
        values: samples in the units of the table; nan where one is missing.
        columns: columns of the axes.
    """
    at = np.zeros(values.shape, bool)
    notes = []
    for k, column in enumerate(columns):
        marker = _marker(values[:, k])
        if marker is None:
            continue
        rows = values[:, k] == marker
        # The others have it in the same rows if all were written at once.
        same = (values == marker) & rows[:, None]
        at |= same & (same.sum(axis=0) > _AT_ONCE * rows.sum())
        what = "failed reads" if marker == 0.0 else "markers of no sample"
        notes.append(
            f"{column.label!r}: {np.count_nonzero(rows):,} samples are exactly {marker:.6g}, far from all "
            f"others: {what}; left out"
        )
    shifted, wrapped_notes = unwrapped(np.where(at, np.nan, values) if at.any() else values, columns)
    notes += wrapped_notes
    for sensor, own in axes_by_sensor(columns).items():
        failed = _failed(shifted[:, own])
        if failed.any():
            at[:, own] |= failed[:, None]
            notes.append(
                f"{sensor}: {failed.sum():,} samples are exactly 0 on all axes: failed reads; left out"
            )
        held = _held(shifted[:, own])
        if held.any():
            at[:, own] |= held[:, None]
            lengths = np.diff(runs_of(held))[:, 0]
            notes.append(
                f"{sensor}: {held.sum():,} samples repeat those before exactly on all axes, "
                f"{plain(float(lengths.max()), 6)} at most in a row: held values or padding; left out"
            )
    return Absent(shifted, at, tuple(notes))


def _marker(x: Channel) -> float | None:
    """Return the value that marks a missing sample of an axis; None if there is none."""
    low, high = _ends(x)
    if not low < high:
        return None
    for marker in (low, high):
        is_marker = x == marker
        count = np.count_nonzero(is_marker)
        if count < _LEAST:
            continue
        rest = x[~is_marker & np.isfinite(x)]
        if len(rest) < _LEAST:
            continue
        center = float(np.median(rest[: 10 * _LOOKED_AT]))
        spread = max(float(rest.std()), _step(rest))
        far = abs(marker - center)
        if spread > 0.0 and far > _FAR * spread and abs(rest - center).max() < _HALF * far:
            return marker
    return None


def _ends(x: Channel) -> tuple[float, float]:
    """Return the least and the largest number; equal ones if there is none, or one is not finite."""
    low, high = float(np.fmin.reduce(x)), float(np.fmax.reduce(x))
    return (low, high) if np.isfinite(high - low) else (0.0, 0.0)


def _step(x: Channel) -> float:
    """Return the smallest difference between values; 0 if all are equal."""
    gaps = np.diff(np.unique(x[:_LOOKED_AT]))
    return float(gaps.min()) if len(gaps) else 0.0


def _failed(values: Values) -> Chosen:
    """Return which samples of a sensor are zero on all axes, if that is no chance; a few of all at most."""
    zero = values[:, np.fmax.reduce(values, axis=0) > np.fmin.reduce(values, axis=0)] == 0.0
    failed = zero.all(axis=1) & (zero.shape[1] > 1)
    count, n = int(failed.sum()), len(failed)
    if not _LEAST <= count <= _MOST_HELD * n:
        return np.zeros(n, bool)
    # Zeros of single axes tell how often all of them would be zero.
    share = np.maximum(zero[~failed].mean(axis=0), 1.0 / n)
    return failed if n * float(np.prod(share)) < _BY_CHANCE else np.zeros(n, bool)


def _held(values: Values) -> Chosen:
    """Return which samples of a sensor repeat those before so often in a row that it was not sampled."""
    same = np.concatenate([[False], (values[1:] == values[:-1]).all(axis=1)])
    runs = runs_of(same)
    held = np.zeros(len(values), bool)
    if not len(runs) or same.mean() > _SLOWER:
        return held
    lengths = np.diff(runs)[:, 0]
    # Long runs themselves are no chance.
    usual = lengths[lengths < _SHORTEST].sum() / len(values)
    chance = max(float(usual), _EQUAL)
    least = max(_SHORTEST, int(np.ceil(np.log(_CHANCE / len(values)) / np.log(chance))))
    long = runs[lengths >= least]
    # A sensor that often holds its output may do so on purpose, so that these are its samples. What is held
    # at an end of the record is none.
    at_end = (long[:, 0] <= 1) | (long[:, 1] == len(values))
    many = np.diff(long[~at_end]).sum() > _MOST_HELD * len(values)
    for (first, end), outer in zip(long.tolist(), at_end.tolist(), strict=True):
        if outer:
            # Also the first of these values, which may be padding.
            held[first - 1 : end] = True
        elif not many:
            held[first:end] = True
    return held


def unwrapped(values: Values, columns: Sequence[Column]) -> tuple[Values, list[str]]:
    """Return samples with wrapped ones shifted back, and notes on them."""
    turns = np.array([_turn(x) for x in values.T])
    if not turns.any():
        return values, []
    low = np.fmin.reduce(values, axis=0)
    # Counts of both signs that were written as positive ones are so on all axes, also where none wraps.
    is_count = (low >= 0.0) & ~((values % 1.0 > 0.0).any(axis=0))
    of_file = float(max(turns[is_count], default=0.0))
    is_count &= np.fmax.reduce(values, axis=0) < of_file
    notes = []
    shifted = values
    for sensor, own in axes_by_sensor(columns).items():
        turn = float(turns[own].max()) or (of_file if is_count[own].all() else 0.0)
        if not turn:
            continue
        part = shifted[:, own]
        positive = low[own].min() >= 0.0
        beyond = part >= 0.5 * turn if positive else part > 0.0
        beyond &= positive | (turns[own] > 0.0)
        count = int(np.count_nonzero(beyond))
        if not count:
            continue
        step = min((_step(x) for x, k in zip(part.T, turns[own], strict=True) if k), default=1.0)
        bits = int(np.log2(turn / step))
        shifted = shifted.copy() if shifted is values else shifted
        shifted[:, own] = np.where(beyond, part - turn, part)
        notes.append(f"{sensor}: {count:,} samples have wrapped at {bits} bits; shifted back")
    return shifted, notes


def _turn(x: Channel) -> float:
    """Return the range of the numbers of an axis if some of its samples have wrapped; else 0."""
    low, high = _ends(x)
    middle = 0.5 * (low + high)
    # Most noise is in between.
    if low == high or (abs(x[:_LOOKED_AT] - middle) < _BETWEEN * (high - low)).any():
        return 0.0
    is_high = x > middle
    above, below = x[is_high], x[~is_high & np.isfinite(x)]
    if len(above) < _LEAST or len(below) < _LEAST:
        return 0.0
    spread = float(max(above.std(), below.std()))
    if not 0.0 < _APART * spread < float(above.mean() - below.mean()):
        return 0.0
    step = _step(x)
    for bits in _BITS:
        turn = 2.0**bits * step
        in_range = (low >= 0.0 and high < turn) or (low >= -0.5 * turn and high < 0.5 * turn)
        if in_range and float(below.min()) + turn - float(above.max()) < max(spread, 2.0 * step):
            return turn
    return 0.0

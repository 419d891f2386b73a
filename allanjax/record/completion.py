"""Completion of records with missing samples, by draws from their distribution given the other samples.

The distribution is that of a Gaussian process with the spectrum of the record itself. With that spectrum,
completed records are distributed as if no sample had been lost, and estimates have the expectation that they
would have had. (Zeros, straight lines across gaps, or closing the gaps change the spectrum: less noise at
high frequencies, or steps.)

The spectrum is that of the completed record, so both are computed in turn: data augmentation, M. A. Tanner
and W. H. Wong, J. Am. Stat. Assoc. 82, 528 (1987), with a single draw at the end. A draw is one of all
samples, plus the conditional mean of its difference from the observed samples: Y. Hoffman and E. Ribak,
Astrophys. J. Lett. 380, L5 (1991).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.fft import dct, idct, rfft

from allanjax.base.arrays import seed_of
from allanjax.base.errors import RecordingError
from allanjax.base.wording import duration, percent, plain
from allanjax.record.shapes import Channel, Chosen, Places, Values, Which


def without_repeats(values: Values, times: Channel) -> Chosen:
    """Return which samples do not repeat the previous sample with the same time."""
    same = (values[1:] == values[:-1]) | (np.isnan(values[1:]) & np.isnan(values[:-1]))
    return np.concatenate([[True], ~(same.all(axis=1) & (np.diff(times) == 0.0))])


# Tolerance, in samples, within which a time is that of a sample: padding for rounding.
_TIME_SLACK = 1e-6
# Fewest samples of a segment with a spectrum of its own, and most segments that are fitted together.
_LEAST, _MOST = 64, 16


class Gap(NamedTuple):
    """Missing samples, as places on the recording's time grid, whose first sample has number 0.

    Attributes:
        first: number of the first one; negative before the segment that was read.
        samples: number of missing samples; 0 if it is unknown because the clock was set back.
    """

    first: int
    samples: int


class Segments(NamedTuple):
    """Segments of a record without missing samples.

    Attributes:
        every: rows of each, in time order.
        longest: rows of the longest.
        others: rows of the longest fifteen others with 64 samples or more, in time order.
    """

    every: tuple[slice, ...]
    longest: slice
    others: tuple[slice, ...]

    def gaps(self, times: Channel, rate: float) -> tuple[Gap, ...]:
        """Return the gaps between the segments, given the times [s] of all samples and their rate [Hz]."""
        places = np.rint((times - times[self.longest.start]) * rate).astype(int)
        ends = places[[rows.stop - 1 for rows in self.every[:-1]]] + 1
        lost = places[[rows.start for rows in self.every[1:]]] - ends
        return tuple(map(Gap, ends.tolist(), np.maximum(lost, 0).tolist()))

    def notes(self, n: int) -> tuple[str, ...]:
        """Return a note on which of n samples were read; none if all were."""
        if len(self.every) < 2:
            return ()
        used = 1 + len(self.others)
        others = f" ({used} of them are used in fits and Allan deviations)" if used > 1 else ""
        return (
            f"samples {self.longest.start:,} to {self.longest.stop - 1:,} of {n:,} read, the longest of "
            f"{len(self.every)} segments without gaps{others}; gaps='fill' (--gaps fill) makes one of all",
        )


def segments_of(values: Values, after_gap: Chosen) -> Segments:
    """Return the segments without missing samples.

    An axis without any value is ignored. `after_gap` are the samples that follow missing ones.
    """
    lost = np.isnan(values)
    whole = ~lost[:, ~lost.all(axis=0)].any(axis=1)
    begins = whole & (after_gap | ~np.concatenate([[False], whole[:-1]]))
    first = np.flatnonzero(begins)
    if not first.size:
        return Segments((), slice(0, 0), ())
    # A segment ends where the next begins, or at the first incomplete sample after it.
    ends = first + np.add.reduceat(whole.astype(int), first)
    rows = tuple(map(slice, first.tolist(), ends.tolist()))
    order = np.argsort(first - ends, kind="stable").tolist()
    kept = sorted(k for k in order[1:_MOST] if ends[k] - first[k] >= _LEAST)
    return Segments(rows, rows[order[0]], tuple(rows[k] for k in kept))


def on_grid(
    values: Values,
    auxiliary: Mapping[str, Channel],
    places: Places,
) -> tuple[Float[np.ndarray, "n axes"], dict[str, Float[np.ndarray, " n"]]]:
    """Return samples on an even grid, nan where missing; auxiliary channels are interpolated."""
    n = int(places[-1]) + 1
    if n == len(values):
        return values, dict(auxiliary)
    full = np.full((n, values.shape[1]), np.nan)
    full[places] = values
    grid = np.arange(n)
    return full, {name: np.interp(grid, places, column) for name, column in auxiliary.items()}


def gaps_of(missing: Which) -> tuple[Gap, ...]:
    """Return the gaps in which samples of at least one axis are missing."""
    return tuple(Gap(first, end - first) for first, end in runs_of(np.asarray(missing.any(axis=1))).tolist())


def runs_of(mask: Bool[np.ndarray, " n"]) -> Int[np.ndarray, "runs 2"]:
    """Return the first and the end index of each run of true values."""
    return np.flatnonzero(np.diff(mask, prepend=False, append=False)).reshape(-1, 2)


def gaps_within(
    gaps: Iterable[Sequence[int]] | None, first: int, last: int, origin: int
) -> tuple[Gap, ...] | None:
    """Return the parts of gaps between two samples, numbered from the sample `origin`."""
    if gaps is None:
        return None
    inner = ((max(begin, first), min(begin + samples, last)) for begin, samples in gaps)
    return tuple(Gap(begin - origin, end - begin) for begin, end in inner if begin < end)


def rows_between(samples: int, rate: float, start: float | None, stop: float | None) -> slice:
    """Return the rows of samples at times in [start, stop), in s from the first sample."""
    first = 0 if start is None else int(np.ceil(start * rate - _TIME_SLACK))
    last = samples if stop is None else int(np.ceil(stop * rate - _TIME_SLACK))
    first = min(max(first, 0), samples)
    return slice(first, max(first, min(last, samples)))


#: Largest share of an axis's samples that is completed.
MOST_MISSING = 0.3
# Spectrum and samples are computed in turn, at most so often, until the logarithm of the spectrum changes by
# less than this. Behind a filter, the straight lines of the first turn are far above it.
_TURNS, _SETTLED = 20, 0.05
# Bands over which the logarithm is averaged.
_BANDS = 64
# Frequencies on either side over which the spectrum is averaged: so many, and this share of the frequency.
_FEWEST, _SHARE = 4, 0.01
# Conjugate gradients: most steps, and the negligible part of d'C⁻¹d.
_STEPS, _EXACT = 100, 1e-3
#: Neighbouring missing samples that are solved for at once.
GAPS_AT_ONCE = 256


def widening(missing: Which) -> Float[np.ndarray, " axes"]:
    """Return the factor for each axis by which standard deviations exceed those of a complete record.

    With a share f missing, n(1 − f) samples determine the noise level; the draws at that level add the
    scatter of n·f samples: √(1/(1 − f) + f). This is exact for white noise, and an upper bound for terms
    slower than the gaps, on which the missing samples hold less information.
    """
    share = missing.mean(axis=0)
    return np.sqrt(1.0 / (1.0 - share) + share)


def completed(values: Values, missing: Which) -> Values:
    """Return the samples with the missing ones drawn given the others, which are unchanged.

    The same record is always completed in the same way.

    Args:
        values: samples, with any value where they are missing.
        missing: which are missing; at most 30 % of an axis.

    Raises:
        RecordingError: more are missing.
    """
    full = values.copy()
    n = len(values)
    for k in np.flatnonzero(missing.any(axis=0)):
        lost = np.flatnonzero(missing[:, k])
        if len(lost) > MOST_MISSING * n:
            raise RecordingError(
                f"{percent(len(lost) / n)} of the samples are missing, but at most {percent(MOST_MISSING)} "
                "can be filled in; read the longest segment without gaps with gaps='segments' "
                "(--gaps segments)"
            )
        x = bridged(full[:, k], missing[:, k])
        rng = np.random.default_rng(seed_of(x))
        x, v = _begun(x, missing[:, k])
        changed = np.inf
        for _ in range(_TURNS):
            draw = in_time(np.sqrt(v) * rng.standard_normal(n - 1)) + x.mean()
            x[lost] = draw[lost] + predicted(x - draw, missing[:, k], v)[lost]
            before, v = v, _spectrum(x)
            bands = np.array_split(np.log(v / before), min(_BANDS, len(v)))
            last, changed = changed, max(abs(float(band.mean())) for band in bands)
            # A change no smaller than the previous one is chance, as for a long gap that is drawn again.
            if changed < _SETTLED or changed > last:
                break
        full[:, k] = x
    return full


def bridged(x: Float[np.ndarray, " n"], missing: Bool[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Return samples with straight lines across gaps; unchanged if none or all are missing."""
    if not missing.any() or missing.all():
        return x
    full, there = x.astype(float), np.flatnonzero(~missing)
    full[missing] = np.interp(np.flatnonzero(missing), there, x[there])
    return full


def _begun(
    x: Float[np.ndarray, " n"], missing: Bool[np.ndarray, " n"]
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n-1"]]:
    """Return samples with lines across long gaps that begin and end at means, and their first spectrum.

    A line between two samples has their noise, but lasts as long as the gap: it is power at low frequencies
    that would be drawn anew in every turn. What the gaps lack of the whole power is allowed for.
    """
    runs = runs_of(missing)
    long = runs[np.diff(runs)[:, 0] > GAPS_AT_ONCE]
    share, n, begun = 0.0, len(x), x.copy()
    window = _window(n) ** 2
    for first, end in long.tolist():
        size = end - first
        sides = slice(max(first - size, 0), first), slice(end, end + size)
        means = [float(x[side][~missing[side]].mean()) for side in sides if not missing[side].all()]
        # From the middle of one side to that of the other.
        rise = (np.arange(size) + 0.5 + 0.5 * size) / (2.0 * size)
        begun[first:end] = means[0] + (means[-1] - means[0]) * rise
        share += float(window[first:end].sum() / window.sum())
    return begun, _spectrum(begun) / (1.0 - share)


def _window(n: int) -> Float[np.ndarray, " n"]:
    """Return Hann's window, of mean one."""
    return 1.0 - np.cos(2.0 * np.pi * (np.arange(n) + 0.5) / n)


def notes_on(missing: Which, rate: float, names: Sequence[str]) -> tuple[str, ...]:
    """Return notes on how many samples were missing and filled in, and on the lengths of the gaps."""
    groups: dict[bytes, list[int]] = {}
    for k in np.flatnonzero(missing.any(axis=0)):
        groups.setdefault(missing[:, k].tobytes(), []).append(int(k))
    notes = []
    for axes in groups.values():
        lost = missing[:, axes[0]]
        lengths = np.diff(runs_of(lost))
        count = f"{len(lengths)} gaps of at most" if len(lengths) > 1 else "a gap of"
        wider = 100.0 * (widening(missing)[axes[0]] - 1.0)
        notes.append(
            f"{', '.join(names[k] for k in axes)}: {lost.sum()} of {len(lost)} samples "
            f"({plain(100.0 * lost.mean(), 2)} %) are missing in {count} "
            f"{duration(float(lengths.max()) / rate)}; they are filled in, which widens the fit's "
            f"intervals by {plain(wider, 2)} %"
        )
    return tuple(notes)


def in_time(coefficients: Float[np.ndarray, " n-1"]) -> Float[np.ndarray, " n"]:
    """Return samples of zero mean with these cosine coefficients."""
    return idct(np.concatenate([[0.0], coefficients]), norm="ortho", workers=-1)


def predicted(
    d: Float[np.ndarray, " n"], missing: Bool[np.ndarray, " n"], v: Float[np.ndarray, " n-1"]
) -> Float[np.ndarray, " n"]:
    """Return d with the best prediction of the missing samples given the others, which minimizes d'C⁻¹d.

    It uses conjugate gradients. The preconditioner solves neighbouring gaps together, which depend on each
    other behind a filter. For long gaps it is the covariance, which is nearly the inverse except at the ends
    of the gap, which remove everything slower than the gap.

    Args:
        d: samples, with any value where they are missing.
        missing: which are missing.
        v: expected squared cosine coefficients, the spectrum; that of the mean is infinite.
    """
    gaps, full = np.flatnonzero(missing), np.zeros(len(d))
    # The length of the gap of each missing sample.
    lengths = np.diff(runs_of(missing))[:, 0]
    long, weight = np.repeat(lengths > GAPS_AT_ONCE, lengths), 1.0 / v
    short = np.flatnonzero(~long)
    blocks = inverses(gaps[short], lags_of(weight))
    slowest = min(2 * len(d) // int(lengths.max()), len(v) - 1)
    within = np.concatenate([np.full(slowest, v[slowest]), v[slowest:]])

    def filtered(y: Float[np.ndarray, " n"], by: Float[np.ndarray, " n-1"]) -> Float[np.ndarray, " gaps"]:
        return in_time(dct(y, norm="ortho", workers=-1)[1:] * by)[gaps]

    def nearly_solved(residual: Float[np.ndarray, " gaps"]) -> Float[np.ndarray, " gaps"]:
        solved = residual.copy()
        if long.any():
            full[gaps] = np.where(long, residual, 0.0)
            solved = filtered(full, within)
        parts = np.split(residual[short], range(GAPS_AT_ONCE, len(short), GAPS_AT_ONCE))
        solved[short] = np.concatenate([inverse @ part for inverse, part in zip(blocks, parts, strict=True)])
        return solved

    y = bridged(d, missing)
    residual = -filtered(y, weight)
    direction, square = np.zeros(len(gaps)), np.inf
    for _ in range(_STEPS):
        conditioned = nearly_solved(residual)
        square, old = float(residual @ conditioned), square
        if square <= _EXACT:
            break
        direction = conditioned + square / old * direction
        full[gaps] = direction
        image = filtered(full, weight)
        a = square / float(direction @ image)
        y[gaps] += a * direction
        residual -= a * image
    return y


def lags_of(v: Float[np.ndarray, " n-1"]) -> Float[np.ndarray, " n+1"]:
    """Return the circular covariances at lags 0 … n of twice as long a record with this spectrum."""
    return dct(np.concatenate([[0.0], v, [0.0]]), type=1, workers=-1) / (len(v) + 1)


def inverses(
    gaps: Int[np.ndarray, " gaps"], r: Float[np.ndarray, " n+1"]
) -> list[Float[np.ndarray, "block block"]]:
    """Return inverses of the precision between missing samples, per block: ½[r(i − k) + r(i + k + 1)].

    Here r are the lags of the inverse spectrum.
    """
    n = len(r) - 1
    found = []
    for some in np.split(gaps, range(GAPS_AT_ONCE, len(gaps), GAPS_AT_ONCE)):
        total = some[:, None] + some + 1
        precision = 0.5 * (r[abs(some[:, None] - some)] + r[np.minimum(total, 2 * n - total)])
        found.append(np.linalg.inv(precision))
    return found


def _spectrum(x: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n-1"]:
    """Return the smooth spectrum of a record, as the expected squares of its cosine coefficients.

    Hann's window limits the leakage of lines and slow changes. Averages of the logarithm follow the steep
    flanks of a filter; averages of the remainder preserve the power of a line.
    """
    n = len(x)
    power = np.abs(rfft((x - x.mean()) * _window(n), workers=-1)) ** 2 / (1.5 * n)
    power[0] = power[1]
    power = np.maximum(power, 1e-18 * power.max())
    flanks = np.exp(_averaged(np.log(power), n))
    smooth = flanks * _averaged(power / flanks, n)
    return np.interp(0.5 * np.arange(1, n), np.arange(len(power)), smooth)


def _averaged(y: Float[np.ndarray, " frequencies"], n: int) -> Float[np.ndarray, " frequencies"]:
    """Return averages over frequencies on either side; y is symmetric about zero and half the sample rate."""
    k = np.arange(len(y))
    half = np.minimum(np.maximum(_FEWEST, (_SHARE * k).astype(int)), len(y) // 4)
    most = int(half[-1])
    below, beyond = y[1 : most + 1][::-1], y[: n - len(y) + 1][: -most - 1 : -1]
    sums = np.concatenate([[0.0], np.cumsum(np.concatenate([below, y, beyond]))])
    return (sums[most + k + half + 1] - sums[most + k - half]) / (2 * half + 1)

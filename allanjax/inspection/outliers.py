"""Outlying samples: single ones, which are left out, and those of noise with heavy tails, which is kept."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from allanjax.base.wording import plain
from allanjax.inspection.events import TRIFLE
from allanjax.inspection.facts import Fact, amount, listed
from allanjax.inspection.windows import Samples, Values, Which, runs
from allanjax.record.completion import bridged
from allanjax.record.recording import Axis, Recording

# Standard deviations beyond which a sample is an outlier: Gaussian noise has one in 10⁹ samples.
_FAR = 6.0
# Samples on either side that are compared, and the most outliers within that distance.
_AROUND, _CLOSE = 3, 3
# Standard deviations beyond which Gaussian noise has this share of samples; so many times more is no chance.
_OUTLYING, _GAUSSIAN_BEYOND = 4.0, 6.3e-5
_ENOUGH = 5
# Share of the smallest distances from which the scale is estimated, and their rms for normal variates.
_INNER, _INNER_RMS = 0.7, 0.5565
# Share of zero distances beyond which the rounding is too coarse for that estimate.
_EQUAL = 0.35
# Largest share of outlying samples on an axis: with more, the noise itself has heavy tails.
_MOST = 0.1


def spikes_in(x: Samples, filled: Which) -> Which:
    """Return isolated outliers of an axis that change its Allan variance by more than its own error.

    Samples that were filled in are not outliers of the sensor.
    """
    at = _isolated(x) & ~filled
    without = bridged(x, at)
    off = (x - without)[at]
    return np.zeros_like(at) if _is_trifle(float(off @ off) / len(x), without) else at


def spike_facts(recording: Recording, without: Values, spikes: Sequence[Which]) -> Iterator[Fact]:
    """Yield facts about isolated outliers that are left out, given the samples without them."""
    rate, columns = recording.rate, zip(recording.values.T, without.T, strict=True)
    for axis, (x, calm), at in zip(recording.axes, columns, spikes, strict=True):
        times = (np.flatnonzero(at) / rate).tolist()
        if not times:
            continue
        size = float(abs(x - calm).max())
        count = f"{len(times)} outlying samples" if len(times) > 1 else "1 outlying sample"
        share = f" ({plain(100.0 * float(at.mean()), 1)} %)" if at.mean() >= TRIFLE else ""
        text = f"{count} on {axis.name}{share}, up to {amount(size, axis, 3)} off"
        spans = tuple((time, time + 1.0 / rate) for time in times)
        where = listed([f"{plain(time, 6)} s" for time in times])
        means = f"left out and filled in at {where}"
        yield Fact("spikes", text, (axis.name,), "widened", size, spans=spans, meaning=means)


def heavy_tails(x: Samples, axis: Axis, step: float) -> tuple[float, list[Fact]]:
    """Return the variance that samples beyond Gaussian noise add, and the fact about them.

    It is zero if chance explains their number. Deviations up to a rounding `step` do not count.
    """
    distance, scale = _distances(x)
    beyond = distance[distance * scale > _OUTLYING * scale + step]
    if len(beyond) <= _ENOUGH * (1.0 + len(x) * _GAUSSIAN_BEYOND):
        return 0.0, []
    variance = float(np.sum(beyond**2 - 1.0)) * scale**2 / len(x)
    if _is_trifle(variance, x):
        return variance, []
    rms, share = float(np.sqrt(variance)), plain(100.0 * len(beyond) / len(x), 2)
    text = f"{len(beyond)} samples of {axis.name} ({share} %) are too large for Gaussian noise"
    added = amount(rms, axis)
    means = f"they are kept, and the interval of N is widened for the {added} rms that they add"
    return variance, [Fact("spikes", text, (axis.name,), "widened", rms, meaning=means)]


def _is_trifle(variance: float, x: Samples) -> bool:
    """Return whether additional variance changes the Allan variance by less than its own error."""
    return variance <= max(TRIFLE, np.sqrt(2.0 / len(x))) * np.mean(np.diff(x) ** 2) / 2.0


def _isolated(x: Samples) -> Which:
    """Return which samples are isolated outliers, up to three close together; none if there are too many.

    An outlier is far both from the mean of its two neighbours and from the median of the seven samples around
    it, in standard deviations of Gaussian noise. A step is not far from the median; a knock or a burst has
    more such samples close together.
    """
    distance, scale = _distances(x)
    far, places = np.zeros(len(x), bool), np.flatnonzero(distance > _FAR)
    if len(places) > 3.0 * _MOST * len(x):
        return far
    around = np.pad(x, _AROUND, mode="reflect")[places[:, None] + np.arange(2 * _AROUND + 1)]
    far[places[abs(x[places] - np.median(around, axis=1)) > _FAR * scale]] = True
    for first, last in runs(far, _AROUND):
        far[first:last] &= far[first:last].sum() <= _CLOSE
    return far if far.mean() <= _MOST else np.zeros_like(far)


def _distances(x: Samples) -> tuple[Samples, float]:
    """Return distances from the mean of the two neighbours in robust standard deviations, and that deviation.

    Distances are zero if many samples equal that mean: the output is rounded, and its steps are not outliers.
    """
    left = np.zeros(len(x))
    np.abs(x[1:-1] - 0.5 * (x[:-2] + x[2:]), out=left[1:-1])
    # Of long records an odd fraction of the samples suffices. The median itself would be coarse where the
    # output is rounded.
    some = left[:: 1 + 2 * (len(x) >> 19)]
    most = int(_INNER * len(some))
    inner = np.partition(some, most)[:most]
    scale = float(np.sqrt(inner @ inner / max(most, 1))) / _INNER_RMS
    rounded = np.count_nonzero(left[1:-1] == 0.0) > _EQUAL * (len(x) - 2)
    return (np.zeros(len(x)) if rounded or not scale > 0.0 else left / scale), scale

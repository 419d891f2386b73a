"""Two levels of noise in a recording, where a long part is louder than another; which is the sensor at rest.

Vibration only adds noise, and adds structure to its spectrum. So the quiet part is the sensor if the loud
one is nowhere quieter and its spectrum is less even. Where a range or a unit changed, both have the same
shape; where samples are held, the output is nulled, or a filter was set, the quiet part is not the sensor:
then it is unclear which part is meant.
"""

from __future__ import annotations

from collections import Counter
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from allanjax.inspection.windows import WhichWindows, Windows, lattice_power, mean_square, runs

# Length [s] of the stretches that are compared; that as a share of the record at most; fewest samples of one.
_STRETCH = 1.0
_SHARE = 1.0 / 240.0
_SAMPLES = 64
# Fewest stretches of a level, and in a row; least share of the record in the longest loud part.
_FEWEST, _ROW = 10, 3
_LOUD = 0.1
# Ratio of the deviations of two levels, and their distance in standard deviations of the stretches.
_APART, _CLEAR = 1.5, 3.0
# Number of axes and cluster sizes by which the stretches are divided, and the index of these sizes.
_CLEAREST, _SIZES = 4, [0, 2]
# Longest cluster time [s] at which spectra are compared: drift is above it.
_SHORTEST_DRIFT = 0.2
# A loud part is quieter if the logarithm of its power is lower by this and so many of its errors.
_QUIETER, _ERRORS_QUIETER = 0.1, 4.0
# Ratios are the same if their logarithms differ from the middle by this, or so many errors.
_SAME, _ERRORS_SAME = 0.1, 3.0
# Spectra are as even if the standard deviations of their logarithms differ by this.
_EVEN = 0.1
# Share of repeated samples of an output that is held, and factor by which the other repeats less often.
_HELD, _LESS = 0.5, 2.0
# Share of the axes that must agree.
_AGREED = 0.75
# Why a quiet part may not be the sensor at rest.
_OTHER = "the rest is quieter at other frequencies"


class Levels(NamedTuple):
    """Two levels of noise.

    Attributes:
        loud: which windows are louder.
        ratio: ratio of the deviations where it is largest; `axis` is the index of that axis.
        doubt: why the quiet part may not be the sensor at rest, in words; "" if it is.
    """

    loud: WhichWindows
    ratio: float
    axis: int
    doubt: str


def levels_of(windows: Windows, rate: float) -> Levels | None:
    """Two levels of a recording sampled at `rate` [Hz]; None if it has one."""
    wanted = max(min(_STRETCH, _SHARE * windows.n / rate), _SAMPLES / rate)
    each = max(round(wanted * rate / windows.size), 1)
    count = len(windows) // each
    times = 2.0 ** np.arange(len(windows.power)) / rate
    sizes = times <= max(_SHORTEST_DRIFT, times[0])
    if count < 2 * _FEWEST or sizes.sum() <= max(_SIZES):
        return None
    floor, used = lattice_power(windows) + 1e-300, windows.between(0, count * each)
    power = used.power[_SIZES].reshape(len(_SIZES), count, each, -1).sum(axis=2)
    pairs = used.pairs[_SIZES].reshape(len(_SIZES), count, each, 1).sum(axis=2)
    level = np.log(power / np.maximum(pairs, 1) + floor)
    repeated = used.repeated.reshape(count, each, -1).mean(axis=1)
    # A constant axis says nothing about the others; if nearly all are constant, the output is.
    alone = (repeated == 1.0) & ((repeated == 1.0).mean(axis=1) < _AGREED)[:, None]
    loud = _louder(np.where(alone, np.median(level, axis=1)[:, None], level))
    if loud is None:
        return None
    rows = np.repeat(loud, each)
    quiet, louder = (np.log(mean_square(used, of)[sizes] + floor) for of in (~rows, rows))
    error = np.sqrt(sum(2.0 / used.pairs[sizes][:, of].sum(axis=1) for of in (~rows, rows)))
    largest = (louder - quiet).max(axis=0)
    differ = np.flatnonzero(largest > 2.0 * np.log(_APART)).tolist()
    if not differ:
        return None
    doubts: Counter[str] = Counter()
    for k in differ:
        again, rest = float(repeated[~loud, k].mean()), float(repeated[loud, k].mean())
        doubts[_doubt(quiet[:, k], louder[:, k], error, again, rest)] += 1
    doubt, votes = doubts.most_common(1)[0]
    if not doubt and votes < _AGREED * len(differ):
        doubt = _OTHER
    axis = int(np.argmax(largest))
    every = np.pad(rows, (0, len(windows) - len(rows)), "edge")
    return Levels(every, float(np.exp(0.5 * largest[axis])), axis, doubt)


def _louder(log: Float[np.ndarray, "sizes stretches axes"]) -> Bool[np.ndarray, " stretches"] | None:
    """Which stretches belong to the louder of two levels, given logarithms of power; None if there is one."""
    every = log.transpose(0, 2, 1).reshape(-1, log.shape[1])
    # What differs most between the halves of the ordered stretches.
    apart = np.array([_divided(x)[1] for x in every])
    clearest = np.argsort(-apart)[:_CLEAREST]
    mean = every[clearest].mean(axis=0)
    limit, distance = _divided(mean)
    loud = mean > limit
    for first, last in runs(~loud, 0):
        loud[first:last] |= last - first < _ROW
    longest = max((last - first for first, last in runs(loud, 0)), default=0)
    if min(longest, (~loud).sum()) < _FEWEST or longest < _LOUD * len(loud):
        return None
    scatter = np.sqrt(0.5 * (mean[loud].var() + mean[~loud].var()))
    clear = distance > max(2.0 * np.log(_APART), _CLEAR * scatter)
    return loud if clear else None


def _divided(x: Float[np.ndarray, " stretches"]) -> tuple[float, float]:
    """Limit that divides values into two classes that differ most, and the distance of their means (Otsu)."""
    ordered = np.sort(x)
    below = np.arange(1, len(x))
    total = np.cumsum(ordered)
    low, high = total[:-1] / below, (total[-1] - total[:-1]) / (len(x) - below)
    best = int(np.argmax(below * (len(x) - below) * (high - low) ** 2))
    return float(0.5 * (ordered[best] + ordered[best + 1])), float(high[best] - low[best])


def _doubt(
    quiet: Float[np.ndarray, " sizes"],
    loud: Float[np.ndarray, " sizes"],
    error: Float[np.ndarray, " sizes"],
    repeated: float,
    rest: float,
) -> str:
    """Why the quiet part of an axis may not be the sensor at rest; "" if it is.

    The logarithms of both levels are of mean square differences at cluster sizes 1, 2, 4, …; `repeated` and
    `rest` are the shares of repeated samples in the quiet part and in the rest.
    """
    ratio, white = loud - quiet, np.log(2.0) * np.arange(len(quiet))
    if repeated > _HELD and repeated > _LESS * rest:
        return "its samples repeat or do not change"
    if (ratio < -_QUIETER - _ERRORS_QUIETER * error).any():
        return _OTHER
    if np.ptp(ratio) < 2.0 * max(_SAME, _ERRORS_SAME * error.max()):
        return "the spectra have one shape, as if a range or unit had changed"
    # Means of white noise over twice as many samples have half the power.
    if np.std(quiet + white) < np.std(loud + white) - _EVEN:
        return ""
    return "its spectrum is less even, as if it were filtered"

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

from allanjax.inspection.windows import OfAxes, WhichWindows, Windows, lattice_power, runs

# Length [s] of the stretches that are compared, as a share of the record at most, and their fewest samples.
_STRETCH, _SHARE, _SAMPLES = 1.0, 1.0 / 240.0, 64
# Fewest stretches of a level, least share of the record in the longest loud part, and fewest in a row.
_FEWEST, _LOUD, _ROW = 10, 0.1, 3
# Ratio of the deviations of two levels, and their distance in standard deviations of the stretches.
_APART, _CLEAR = 1.5, 3.0
# Number of axes and cluster sizes by which the stretches are divided, and the index of these sizes.
_CLEAREST, _SIZES = 4, (0, 2)
# Longest cluster time [s] at which spectra are compared: drift is above it.
_SHORTEST_DRIFT = 0.2
# Logarithms of power: a loud part that is quieter by this, ratios that are the same, and spectra that are as
# even. Errors of the first two are added so many times.
_QUIETER, _SAME, _EVEN, _ERRORS = 0.1, 0.1, 0.1, (4.0, 3.0)
# Share of repeated samples of an output that is held, and factor by which the other repeats less often.
_HELD, _LESS = 0.5, 2.0
# Share of the axes that must agree.
_AGREED = 0.75
_QUIET = ""
#: Why a quiet part may not be the sensor at rest.
REASONS = {
    "held": "its samples repeat or do not change",
    "other": "the rest is quieter at other frequencies",
    "gain": "the spectra have one shape, as if a range or unit had changed",
    "smooth": "its spectrum is less even, as if it were filtered",
}


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
    sizes = [k for k in range(len(windows.power)) if k == 0 or 2**k / rate <= _SHORTEST_DRIFT]
    if count < 2 * _FEWEST or len(sizes) <= max(_SIZES):
        return None
    shape = len(windows.power), count, each, -1
    power = windows.power[:, : count * each].reshape(shape).sum(axis=2)[sizes]
    pairs = windows.pairs[:, : count * each].reshape(shape[:3]).sum(axis=2)[sizes][..., None]
    level = np.log(_mean(power, pairs, lattice_power(windows))[list(_SIZES)])
    repeated = windows.repeated[: count * each].reshape(count, each, -1).mean(axis=1)
    # A constant axis says nothing about the others; if nearly all are constant, the output is.
    alone = (repeated == 1.0) & ((repeated == 1.0).mean(axis=1) < _AGREED)[:, None]
    loud = _louder(np.where(alone, np.median(level, axis=1)[:, None], level))
    if loud is None:
        return None
    means, errors = [], []
    for part in (~loud, loud):
        total = pairs[:, part].sum(axis=1)
        means.append(np.log(_mean(power[:, part].sum(axis=1), total, lattice_power(windows))))
        errors.append(2.0 / total)
    quiet, louder = means
    ratio, error = louder - quiet, np.sqrt(errors[0] + errors[1])
    differ = np.flatnonzero(ratio.max(axis=0) > 2.0 * np.log(_APART))
    kinds = Counter(
        _kind(quiet[:, k], louder[:, k], error[:, 0], repeated[~loud, k].mean(), repeated[loud, k].mean())
        for k in differ.tolist()
    )
    if not kinds:
        return None
    kind, votes = kinds.most_common(1)[0]
    doubt = "" if kind == _QUIET and votes >= _AGREED * len(differ) else REASONS.get(kind, REASONS["other"])
    whole = np.append(np.repeat(loud, each), np.full(len(windows) - count * each, loud[-1]))
    axis = int(np.argmax(ratio.max(axis=0)))
    return Levels(whole, float(np.exp(0.5 * ratio[:, axis].max())), axis, doubt)


def _mean(
    power: Float[np.ndarray, ...], pairs: Float[np.ndarray, ...], floor: OfAxes
) -> Float[np.ndarray, ...]:
    """Mean square differences, with what rounding may cause."""
    return power / np.maximum(pairs, 1) + floor + 1e-300


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


def _kind(
    quiet: Float[np.ndarray, " sizes"],
    loud: Float[np.ndarray, " sizes"],
    error: Float[np.ndarray, " sizes"],
    repeated: float,
    rest: float,
) -> str:
    """What the quiet part of an axis is: the sensor, or why that is unclear.

    The logarithms of both levels are of mean square differences at cluster sizes 1, 2, 4, …; `repeated` and
    `rest` are the shares of repeated samples in the quiet part and in the rest.
    """
    ratio, white = loud - quiet, np.log(2.0) * np.arange(len(quiet))
    if repeated > _HELD and repeated > _LESS * rest:
        return "held"
    if (ratio < -_QUIETER - _ERRORS[0] * error).any():
        return "other"
    if np.ptp(ratio) < max(2.0 * _SAME, 2.0 * _ERRORS[1] * error.max()):
        return "gain"
    # Means of white noise over twice as many samples have half the power.
    uneven = [np.std(level + white) for level in (quiet, loud)]
    return _QUIET if uneven[0] < uneven[1] - _EVEN else "smooth"

"""Spectral lines, bandwidth and interpolated samples from the spectrum of a record, without a fit."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from itertools import compress
from typing import NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Bool, Float
from scipy.fft import irfft, rfft

from allanjax.base.chi_squared import quantile
from allanjax.base.threads import for_each
from allanjax.base.wording import plain
from allanjax.inspection.facts import Fact, listed
from allanjax.inspection.plausible import lattice
from allanjax.inspection.windows import Samples, Values, runs
from allanjax.record.columns import names_of
from allanjax.record.recording import Axis

# Samples of the longest segment, and fewest of one that shows lines; fewest segments.
_SEGMENT, _SHORTEST = 4096, 64
_FEWEST = 8
# Bins on either side with which a line is compared, beyond the first number up to the second; false alarms.
_NEAR, _FAR = 6, 24
_CHANCE = 1e-6
# Lowest bins: those with drift, and those too close to zero to be compared on both sides.
_DRIFT, _LOWEST = 3, 12
# Least share of the power for a line to be reported.
_SLIGHT = 1e-3
# Bands per octave for the bandwidth; limits of its passband as shares of the frequency; flatness of that.
_BANDS = 4
_PASSBAND = 1 / 16, 1 / 4
_FLAT = 2.0
# Samples that are examined for interpolation.
_LOOKED_AT = 1 << 16
# How far the line of interpolated samples must exceed its surroundings.
_CLEAR = 60.0
# Share of second differences that are zero if the rate is more than twice that of the sensor; if it is twice.
_STRAIGHT, _TWICE = 0.05, 0.3
# Size of a second difference that counts as zero, in rms of the first differences.
_ZERO = 0.02
# Largest squares, in medians, so that single outliers do not matter.
_TAIL = 20.0

_Levels: TypeAlias = Float[np.ndarray, " m"]


class Spectrum(NamedTuple):
    """Mean of the periodograms of overlapping segments (Welch 1967), with Hann's window.

    Attributes:
        frequency: of each bin [Hz].
        level: power of each bin and axis.
        segments: how many independent ones there are.
    """

    frequency: _Levels
    level: Float[np.ndarray, "m axes"]
    segments: float


def spectral_facts(
    values: Values, rate: float, axes: Sequence[Axis], held: Collection[str]
) -> Iterator[Fact]:
    """Yield facts about lines and interpolated samples; `held` are names of axes with repeated samples."""
    for sensor in dict.fromkeys(axis.sensor for axis in axes):
        own = np.array([axis.sensor == sensor and axis.name not in held for axis in axes])
        native = interpolated_from(values, rate, own)
        if native is not None:
            text = f"the {sensor} samples are interpolated from about {plain(native, 4)} Hz to {rate:g} Hz"
            names = names_of(compress(axes, own))
            remedy = "read the sensor's own samples at its own rate"
            yield Fact("interpolation", text, names, "not a measurement", native, "Hz", remedy=remedy)
    spectrum = spectrum_of(values, rate)
    if spectrum is not None:
        yield from _lines(spectrum, axes)


def spectrum_of(values: Values, rate: float) -> Spectrum | None:
    """Return the spectrum of samples; None for fewer than 512."""
    size = min(_SEGMENT, 1 << int(np.log2(max(len(values) // _FEWEST, 1))))
    if size < _SHORTEST:
        return None
    window = np.hanning(size + 1)[:-1]
    count = 2 * len(values) // size - 1

    def level(x: Samples) -> _Levels:
        segments = np.lib.stride_tricks.sliding_window_view(x, size)[:: size // 2]
        c = rfft((segments - segments.mean(axis=1, keepdims=True)) * window)
        parts = c.view(float).reshape(count, -1, 2)
        return np.einsum("smi,smi->m", parts, parts) / count

    # Segments that overlap by a half are worth 18/19 as many independent ones.
    levels = np.stack(for_each(level, values.T), axis=1)
    return Spectrum(np.fft.rfftfreq(size, 1.0 / rate), levels, 18.0 / 19.0 * count)


def _lines(spectrum: Spectrum, axes: Sequence[Axis]) -> Iterator[Fact]:
    """Facts about peaks that are narrower than anything filters or noise terms make."""
    for axis, level in zip(axes, spectrum.level.T, strict=True):
        around, many = _around(level), 2.0 * spectrum.segments
        # The median of so many bins is known to about ten per cent.
        above = level > 1.2 * float(quantile(1.0 - _CHANCE / len(level), many)) / many * around
        above[:_LOWEST] = False
        excess = np.where(above, level - around, 0.0)
        whole, lines = level[_DRIFT:].sum(), []
        for a, b in runs(above, 1):
            power = excess[a:b].sum()
            if power > _SLIGHT * whole:
                centre = spectrum.frequency[a:b] @ excess[a:b] / power
                lines.append((float(power / whole), float(centre)))
        if lines:
            lines.sort(key=lambda line: -line[0])
            places = [f"{plain(at, 4)} Hz ({plain(100.0 * share, 2)} % of the power)" for share, at in lines]
            text = f"spectral line{'s' * (len(lines) > 1)} on {axis.name} at {listed(places)}"
            total = sum(share for share, _ in lines)
            yield Fact("lines", text, (axis.name,), size=lines[0][1], unit="Hz", share=total)


def bandwidth_in(spectrum: Spectrum, axis: int) -> float | None:
    """Return the frequency [Hz] above which the spectrum of an axis is below half of its passband.

    inf if there is none below half the sample rate; None if drift or a short record hides the passband.
    """
    frequency, level = spectrum.frequency[_DRIFT:-1], spectrum.level[_DRIFT:-1, axis]
    band = np.floor(_BANDS * np.log2(frequency / spectrum.frequency[-1])).astype(int)
    bands, first = np.unique(band, return_index=True)
    parts = np.split(np.arange(len(frequency)), first[1:])
    # Lines occupy few bins of a band and do not change its median.
    middle = np.array([np.exp(np.mean(np.log(frequency[part]))) for part in parts])
    power = np.array([np.median(level[part]) for part in parts])
    crossing = None
    for k in range(len(bands) - 1, 0, -1):
        low, high = (share * middle[k] for share in _PASSBAND)
        inside = power[(middle >= low) & (middle <= high)]
        if len(inside) < _BANDS:
            break
        flat = float(np.median(inside))
        if power[k] >= 0.5 * flat:
            if crossing is None:
                return np.inf if inside.max() < _FLAT * inside.min() else None
            before, after = (np.log(power[j] / flat) for j in (k, k + 1))
            share = (np.log(0.5) - before) / (after - before)
            return float(middle[k] * (middle[k + 1] / middle[k]) ** share)
        crossing = k
    return None


def interpolated_from(values: Values, rate: float, eligible: Bool[np.ndarray, " axes"]) -> float | None:
    """Return the rate [Hz] of a sensor's samples before they were interpolated; None if they were not.

    The variance of interpolated samples is periodic, with minima halfway between two samples of the sensor.
    So the squares of their second differences have a line at the sensor's own rate or its alias.
    """
    if not eligible.any() or len(values) < _SHORTEST * _FEWEST:
        return None
    x = values[:_LOOKED_AT, eligible]
    # Of slow samples that are rounded to coarse steps only the steps would show.
    steps, second = np.array([lattice(own) or 0.0 for own in x.T]), np.diff(x, 2, axis=0)
    fine = steps < np.std(second, axis=0)
    if not fine.any():
        return None
    x, second = x[:, fine], second[:, fine]
    straight = float(np.mean(abs(second) < _ZERO * np.sqrt(np.mean(np.diff(x, axis=0) ** 2, axis=0))))
    total: _Levels | float = 0.0
    for own in second.T * np.hanning(len(second)):
        # A line in the samples causes one at twice its frequency in their squares.
        c = rfft(own)
        power = abs(c) ** 2
        c[power > _CLEAR / 4.0 * _around(power)] = 0.0
        square = irfft(c, len(own)) ** 2
        square = np.minimum(square, _TAIL * np.median(square))
        total = total + abs(rfft(square / square.mean() - 1.0)) ** 2
    total = np.asarray(total)
    total[0] = total[1]
    ratio, ends = total / _around(total), max(len(total) // 50, _FAR)
    slow = ratio[_NEAR:ends].max()
    ratio[:ends] = 0.0
    # With one sample between two of the sensor, half of the second differences are zero.
    ratio[-ends : None if straight < _TWICE else -1] = 0.0
    k = int(np.argmax(ratio))
    # Periodic bursts cause a line with harmonics, the lowest of which are strongest.
    if ratio[k] < max(_CLEAR, slow):
        return None
    line = k * rate / len(second)
    return line if straight > _STRAIGHT else rate - line


def _around(level: _Levels) -> _Levels:
    """Return the level beside each bin: the geometric mean of the medians on either side, for any slope.

    Bins too close to an end have the median of the other side.
    """
    import pandas as pd

    logs = np.log(np.maximum(level, 1e-300))
    # The median of each bin and those before it, the last of which end beyond the spectrum.
    beyond = np.append(logs, np.full(_FAR, np.nan))
    median = pd.Series(beyond).rolling(_FAR - _NEAR, min_periods=1).median()
    sides = np.stack([median.shift(_NEAR + 1)[: len(logs)], median[_FAR:]])
    return np.exp(np.nanmean(sides, axis=0))

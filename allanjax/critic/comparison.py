"""Comparison of an axis with its simulations, before its first finding, after it, and so on to the last.

Descriptions that name nothing are a free level of the spectrum or of the noise over time, and free values.
What they gain over a model, on data that they were not estimated from, is what the model leaves unexplained.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.special import ndtr

from allanjax.critic.finding import Discrepancy, DriftChange
from allanjax.critic.noise import centred
from allanjax.critic.profiles import (
    Profile,
    allan_weights,
    autocorrelation,
    cross_correlation,
    drift_scale,
    drift_sizes,
    of_samples,
    profiles_of,
)
from allanjax.critic.stage import Stage, narrow_bins
from allanjax.inspection.plausible import lattice

# Ordinates of one half in the narrowest window of a free level, number of intervals of a free distribution.
_NARROWEST, _INTERVALS = 16, 24
# Share of the gain outside a place, at either end.
_OUTSIDE = 0.05


class Free(NamedTuple):
    """What a description that names nothing gains over a model [nats], in windows of a width [s or Hz]."""

    gain: Float[np.ndarray, " windows"]
    width: float

    @property
    def total(self) -> float:
        """Gain of all windows."""
        return float(self.gain.sum())

    def place(self) -> tuple[float, float]:
        """Part of the record or of the spectrum with most of the gain."""
        share = np.cumsum(np.maximum(self.gain, 0.0))
        first, last = np.searchsorted(share, share[-1] * np.array([_OUTSIDE, 1.0 - _OUTSIDE]))
        return float(first * self.width), float((last + 1) * self.width)

    def within(self, start: float, end: float) -> float:
        """Gain of the windows that overlap a part of the record or of the spectrum."""
        first, last = int(max(start, 0.0) / self.width), int(np.ceil(end / self.width))
        return float(np.sum(self.gain[first : max(last, first + 1)]))


def descriptions(stage: Stage, step: float | None) -> dict[str, Free]:
    """Descriptions of an axis at one stage, by the domain that they describe: one window for the values.

    The `step` between the values as recorded, if any, is not described: it is a finding if it matters.
    """
    e, rate = stage.whitened, stage.rate
    width = 0.0 if step is None else step * float(np.exp(-0.5 * np.mean(np.log(stage.variance))))
    return {
        "spectrum": free_level(stage.whitened_coefficients**2, rate / (2.0 * stage.n)),
        "level": free_level(e**2 / np.mean(e**2), 1.0 / rate),
        "values": Free(np.array([free_distribution(e, width)]), stage.n / rate),
    }


def free_level(squares: Float[np.ndarray, " n"], spacing: float) -> Free:
    """Gain of a free level of squares of mean 1: every other pair under the best level of the rest.

    The level is constant in windows of 2^k times the narrowest one. The best partition follows from the
    bottom up, each window at the price of having been chosen among all (a regression tree, Donoho 1997).
    """
    length = 2 * _NARROWEST
    windows = len(squares) // length
    pairs = squares[: windows * length].reshape(windows, -1, 2, 2)
    halves = pairs[:, :, 0].sum(axis=(1, 2)), pairs[:, :, 1].sum(axis=(1, 2))
    gain = np.zeros(windows)
    for one, other in (halves, halves[::-1]):
        level = _levels(one, float(_NARROWEST))
        gain += 0.5 * (other - other / level - _NARROWEST * np.log(level))
    return Free(gain, length * spacing)


def _levels(sums: Float[np.ndarray, " windows"], count: float) -> Float[np.ndarray, " windows"]:
    """Best level of each window, given the sums over its `count` squares."""
    finest = 1 << (len(sums) - 1).bit_length()
    total, size = (np.pad(x, (0, finest - len(sums))) for x in (sums, np.full(len(sums), count)))
    price = np.log(2.0 * finest) + 1.0
    level, best = np.ones(finest), np.zeros(finest)
    while True:
        ratio = np.maximum(total, 1e-12) / np.maximum(size, 1e-12)
        own = np.where(size > 0.0, 0.5 * (total - size - size * np.log(ratio)) - price, 0.0)
        whole, width = own > best, finest // len(total)
        level = np.where(np.repeat(whole, width), np.repeat(ratio, width), level)
        if len(total) == 1:
            return level[: len(sums)]
        best, total, size = (x.reshape(-1, 2).sum(axis=1) for x in (np.maximum(own, best), total, size))


def free_distribution(values: Float[np.ndarray, " n"], width: float) -> float:
    """Gain of a free distribution of standardized values over the normal one [nats].

    The shares of intervals that are equally probable under the normal law come from every other pair, the
    gain from the rest. Values rounded to this width are drawn within it by the normal law.
    """
    # The variance without that of rounding (Sheppard), which does not hold if it is most of it.
    variance = np.var(values)
    deviation = np.sqrt(max(variance - width**2 / 12.0, 0.1 * variance))
    low, high = (ndtr((values - values.mean() + side * width) / deviation) for side in (-0.5, 0.5))
    share = low + (high - low) * np.random.default_rng(0).random(len(values))
    place = np.minimum((share * _INTERVALS).astype(int), _INTERVALS - 1)
    pairs = place[: len(place) // 4 * 4].reshape(-1, 2, 2)
    one, other = (np.bincount(pairs[:, k].ravel(), minlength=_INTERVALS) + 0.5 for k in (0, 1))
    logs = (np.log(x * _INTERVALS / x.sum()) for x in (other, one))
    return float(sum((x - 0.5) @ log for x, log in zip((one, other), logs, strict=True)))


# Order of the discrepancies in a critique.
_ORDER = (
    *("allan_deviation", "drift", "psd", "psd_line", "autocorrelation", "skewness", "tails"),
    *("largest_residual", "lattice", "repeated_values", "window_mean", "window_variance"),
    *("cross_correlation", "auxiliary_correlation"),
)
# What other axes need of the first stage and of the last.
_SHARED = ("whitened_coefficients",)
# The drift that a finding changes is over this share of the record at most: longer ones scatter too much.
_SHARE = 1.0 / 8.0


class Comparison(NamedTuple):
    """Discrepancies of an axis from its simulations before the first finding and after the last one.

    Attributes:
        before, after: in every statistic, also where p is near 1.
        pairs: for each finding a statistic before and after it, at the place of the largest improvement.
        drifts: for each finding the drift that it changes most; None if the record is too short.
        last: profiles after the last finding by statistic, those whose places have an extent.
        free: what descriptions that name nothing gain over the model by domain, before the first finding and
            after the last one; once if there is none.
    """

    before: tuple[Discrepancy, ...]
    after: tuple[Discrepancy, ...]
    pairs: list[tuple[tuple[Discrepancy, Discrepancy], ...]]
    drifts: list[DriftChange | None]
    last: Mapping[str, Profile]
    free: tuple[Mapping[str, Free], ...]

    def rest(self, span: tuple[float, float], domain: str) -> Discrepancy:
        """Largest discrepancy after the last finding in a part of the record [s] or of the spectrum [Hz]."""
        unit = {"time": "s", "frequency": "Hz"}[domain]
        places = [p for p in self.last.values() if p.where_unit == unit]
        return min((p.within(*span) for p in places), key=lambda d: d.p_value)


def compared(
    stages: Sequence[Stage],
    raw: tuple[Float[np.ndarray, " recorded"], Float[np.ndarray, " recorded"]],
    others: tuple[Mapping[str, Stage], Mapping[str, Stage]],
    auxiliary: Mapping[str, Float[np.ndarray, " n"]],
) -> Comparison:
    """Comparison of an axis with simulations, at the stages before the first finding and after each.

    Args:
        stages: the axis at these stages.
        raw: its samples as recorded [SI], without missing ones, before the first finding and after the last;
            then with imputed ones if a finding explains their distribution, such as rounding.
        others: other axes by name, at their first stage and at their last.
        auxiliary: other channels by name.
    """
    channels, step = _varying(auxiliary), lattice(raw[0])
    steps = step, step if raw[1] is raw[0] else lattice(raw[1])
    profiles: list[Profile] = []
    pairs, drifts, free, ends = [], [], [], []
    for k, stage in enumerate(stages):
        former = profiles
        if k:
            stage.reuse(stages[k - 1])
        profiles = profiles_of(stage, channels)
        if k:
            pairs.append(_improved(former, profiles))
            drifts.append(_drift_change(stages[k - 1], stage))
            stages[k - 1].forget(*(_SHARED if k == 1 else ()))
        if k in (0, len(stages) - 1):
            free.append(descriptions(stage, steps[min(k, 1)]))
            worst = (p.worst() for p in (*profiles, autocorrelation(stage)))
            ends.append([*worst, *of_samples(stage, raw[min(k, 1)], steps[min(k, 1)])])
    stages[-1].forget(*_SHARED)
    before, after = (
        sorted(
            [*found, cross_correlation(stage, axes).worst()] if axes else found,
            key=lambda d: _ORDER.index(d.statistic),
        )
        for found, stage, axes in zip((ends[0], ends[-1]), (stages[0], stages[-1]), others, strict=True)
    )
    last = {p.statistic: p for p in profiles if p.extent}
    return Comparison(tuple(before), tuple(after), pairs, drifts, last, tuple(free))


def _improved(
    before: Sequence[Profile], after: Sequence[Profile]
) -> tuple[tuple[Discrepancy, Discrepancy], ...]:
    """Pairs of a statistic at two stages, at the place of the largest improvement."""
    pairs = []
    for old, new in zip(before, after, strict=True):
        # A finding has a drift of its own.
        if old.statistic == "drift":
            continue
        change = old.score**2
        change -= new.score**2
        place = int(np.argmax(change))
        pairs.append((old.at(place), new.at(place)))
    return tuple(pairs)


def _drift_change(before: Stage, after: Stage) -> DriftChange | None:
    """Drift of the record and of simulations before and after a finding; None if the record is too short.

    It is given at the time at which the finding changes that of simulations most. What the finding subtracts
    from the samples is in the record still, and so it is added to the simulations after it.
    """
    sizes = drift_sizes(before.n, before.rate)
    count = np.count_nonzero(sizes <= _SHARE * before.n)
    if count == 0:
        return None
    weights = allan_weights(before.n, tuple(sizes.tolist()))
    old, _, measured, _ = before.sums
    new = after.sums[0]
    if not before.same_record(after):
        path = before.residual - after.residual
        new = new + np.add.reduceat(path * path, narrow_bins(before.n)[:-1] - 1)
    scale, unit = drift_scale(before, sizes)
    drifts = (scale * np.sqrt(np.stack([measured, old, new]) @ weights.T))[:, :count]
    k = int(np.argmax(abs(np.log(np.maximum(drifts[2], 1e-300) / np.maximum(drifts[1], 1e-300)))))
    record, was, now = map(float, drifts[:, k])
    return DriftChange(float(sizes[k] / before.rate), record, was, now, unit)


def _varying(auxiliary: Mapping[str, Float[np.ndarray, " n"]]) -> dict[str, Float[np.ndarray, " n-1"]]:
    """Cosine coefficients of the channels that are finite and not constant."""
    channels = {name: np.asarray(h, float) for name, h in auxiliary.items()}
    return {name: centred(h) for name, h in channels.items() if np.isfinite(h).all() and np.ptp(h) > 0.0}

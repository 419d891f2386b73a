"""Comparison of an axis with its simulations, before its first finding, after it, and so on to the last."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from allanjax.critic.finding import Discrepancy, DriftChange
from allanjax.critic.free import Free, descriptions
from allanjax.critic.law import allan_weights
from allanjax.critic.noise import centred
from allanjax.critic.profiles import (
    Profile,
    autocorrelation,
    cross_correlation,
    drift_scale,
    drift_sizes,
    of_samples,
    profiles_of,
)
from allanjax.critic.stage import Stage, narrow_bins
from allanjax.inspection.plausible import lattice

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

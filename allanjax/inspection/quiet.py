"""The quiet parts of a recording, and the events between and within them."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float

from allanjax.inspection.events import Stretch, beside, excesses, quiet_runs, touched_by, unlike
from allanjax.inspection.windows import Windows

# An event matters if it changes the Allan variance by more than this, in standard deviations of the estimate.
_MATTERS = 1.0
# Many small events matter if their changes add up to the first; then each that is above the second does.
_TOGETHER, _COUNTS = 2.0, 0.1
# Standard deviations of a stretch's own excess beyond which it is no chance on an axis.
_CHANCE = 3.0
# An excess of the Allan variance by less than this share changes a coefficient by 0.25 % at most.
_TRIFLE = 0.005
# Fewer windows than this are too few to compare with each other.
_FEWEST = 32
# Rounds of search, each in the quiet parts that the last one left.
_ROUNDS = 8
# A stretch whose noise is another by less than this factor is better kept.
_MUCH_NOISIER = 1.5
# Ratio of mean square differences up to which the noise is unchanged and only the mean has moved.
_SAME_NOISE = 1.5
# Share of the sum of squared differences beyond which a single sample makes the event.
_SINGLE = 0.5
# Standard deviations by which the mean must have changed for a step.
_CHANGED = 8.0
# Least share of the range of the mean that lies between the first window and the settled mean of a warm-up.
_ONE_WAY = 0.6
# Number of windows up to which an event is sudden, and share of the record up to which it is short.
_SUDDEN, _SHORT = 6, 0.02

#: Kinds of events.
Kind = Literal["noisier", "quieter", "silent", "knock", "spike", "step", "warm-up", "shift"]


@dataclasses.dataclass(frozen=True)
class Event:
    """Disturbance of a recording: handling, motion, a fault, or a change of the bias.

    Attributes:
        first, last: index of its first sample, and of the one after its last.
        kind: its kind.
        axis: index of the axis where it is largest.
        size: ratio of the deviations if the noise has changed; else the excursion [rad/s or m/s²].
        shares: of each axis, the clearest excess of the Allan variance that it causes, as a share of it.
        axes: indices of the axes where that is more than the estimates' own error.
    """

    first: int
    last: int
    kind: Kind
    axis: int
    size: float
    shares: tuple[float, ...]
    axes: tuple[int, ...]

    @property
    def matters(self) -> bool:
        """Whether it changes an Allan variance by more than the estimate's own error."""
        return bool(self.axes)

    @property
    def is_slight(self) -> bool:
        """Whether the noise is another, but so little that the samples are better kept than left out."""
        return self.kind in ("noisier", "quieter") and self.size < _MUCH_NOISIER

    @property
    def share(self) -> float:
        """The largest excess of the Allan variance on any axis, as a share of it."""
        return max(self.shares)

    @property
    def is_of_one_axis(self) -> bool:
        """Whether it is on one axis of several, and leaves its mean as it was: no motion of the body."""
        return len(self.axes) == 1 < len(self.shares) and self.kind not in MOVES

    @property
    def is_cut(self) -> bool:
        """Whether it has to be cut out on all axes."""
        return self.matters and not self.is_slight and not self.is_of_one_axis


#: Kinds of events that change the mean alone.
MOVES = ("step", "shift", "warm-up")


def quiet_parts(
    windows: Windows, sensors: Sequence[str], may_move: bool = False
) -> tuple[tuple[Event, ...], tuple[tuple[int, int], ...]]:
    """Events of a recording in order, and the parts without those that matter, as sample indices.

    Events on one axis alone leave the others' samples as they are, and so do those that are slight. Each part
    that is left is searched again: the faint end of an event shows beside quiet windows only. Where the mean
    may move, as in a model with a step, such moves are no events.
    """
    pending, parts, found = [(0, len(windows), 0)], [], []
    while pending:
        first, last, rounds = pending.pop()
        part = windows.between(first, last)
        stretches = _of_part(part, sensors, may_move) if len(part) >= _FEWEST else []
        events = zip(stretches, _events(part, stretches), strict=True)
        cuts = [s for s, e in events if e.is_cut]
        split = bool(cuts) and rounds < _ROUNDS
        # What is not cut out is found again in a part of this one.
        found += [
            dataclasses.replace(s, first=first + s.first, last=first + s.last)
            for s in (cuts if split else stretches)
        ]
        if not split:
            parts.append((first, last))
            continue
        runs = quiet_runs(len(part), cuts)
        longest = max(b - a for a, b in runs) if runs else 0
        pending += [(first + a, first + b, rounds + 1) for a, b in runs if b - a >= min(_FEWEST, longest)]
    edges = windows.edges
    quiet = tuple((int(edges[a]), int(edges[b])) for a, b in sorted(parts))
    return tuple(_events(windows, _joined(sorted(found, key=lambda s: s.first)))), quiet


def _of_part(part: Windows, sensors: Sequence[str], may_move: bool) -> list[Stretch]:
    """Stretches of a part that are unlike the rest, with the axes where they matter."""
    stretches = unlike(part, sensors)
    if may_move:
        stretches = [s for s in stretches if _what(part, s, stretches)[0] not in MOVES]
    sigmas, shares = excesses(part, stretches)
    limit, found = _MATTERS if sigmas.max(axis=1, initial=0.0).sum() < _TOGETHER else _COUNTS, []
    for s, sigma, share in zip(stretches, sigmas, shares, strict=True):
        # By chance a stretch is in excess by the root of its share of the part.
        clear = max(_MATTERS, _CHANCE * np.sqrt((s.last - s.first) / len(part)))
        axes = (share > _TRIFLE) & (sigma > min(clear, max(limit, float(sigma.max()) * (1.0 - 1e-9))))
        found.append(
            dataclasses.replace(s, shares=tuple(share.tolist()), axes=tuple(np.flatnonzero(axes).tolist()))
        )
    return found


def _events(windows: Windows, stretches: Sequence[Stretch]) -> list[Event]:
    """Events that the stretches are."""
    edges, events = windows.edges, []
    for s in stretches:
        kind, axis, size = _what(windows, s, stretches)
        axes = tuple(sorted({axis, *s.axes})) if s.matters else ()
        events.append(Event(int(edges[s.first]), int(edges[s.last]), kind, axis, size, s.shares, axes))
    return events


def _joined(found: Sequence[Stretch]) -> list[Stretch]:
    """Stretches with adjacent ones that matter joined to one."""
    joined: list[Stretch] = []
    for s in found:
        o = joined[-1] if joined else None
        if o is not None and s.matters and o.matters and s.first <= o.last + 1 + (s.last - s.first):
            larger = max((o, s), key=lambda x: max(x.shares))
            axes = tuple(sorted({*o.axes, *s.axes}))
            joined[-1] = dataclasses.replace(larger, first=o.first, last=max(o.last, s.last), axes=axes)
        else:
            joined.append(s)
    return joined


def _what(windows: Windows, s: Stretch, events: Sequence[Stretch]) -> tuple[Kind, int, float]:
    """Kind of an event, the axis where it is largest, and its size there."""
    inside = slice(s.first, s.last)
    if s.kind == "silent":
        constant = windows.low[inside] == windows.high[inside]
        return "silent", int(np.argmax(constant.sum(axis=0))), 0.0
    usual, ratio = _levels(windows, inside, events)
    if s.kind == "quieter":
        quietest = int(np.argmin(ratio.min(axis=0)))
        return "quieter", quietest, float(np.sqrt(1.0 / max(ratio[:, quietest].min(), 1e-12)))
    if s.kind == "moved" or ratio[0].max() < _SAME_NOISE or _single(windows, inside) > _SINGLE:
        moved = _moved(windows, s, events)
        if moved is not None:
            return moved
    length = s.last - s.first
    at_end = s.first <= 1 or s.last >= len(windows) - 1
    if not at_end and length <= max(_SHORT * len(windows), _SUDDEN):
        middle = np.median(windows.mean, axis=0)
        high, low = windows.high[inside].max(axis=0), windows.low[inside].min(axis=0)
        reach = np.maximum(high - middle, middle - low)
        axis = int(np.argmax(reach / np.sqrt(usual[0])))
        kind: Kind = "spike" if length <= 3 and _single(windows, inside) > _SINGLE else "knock"
        return kind, axis, float(reach[axis])
    axis = int(np.argmax(ratio.max(axis=0)))
    return "noisier", axis, float(np.sqrt(ratio[:, axis].max()))


def _levels(
    windows: Windows, inside: slice, events: Sequence[Stretch]
) -> tuple[Float[np.ndarray, "scales axes"], Float[np.ndarray, "scales axes"]]:
    """Usual mean square differences, and the factor by which those inside are larger; one if unknown.

    Usual are the windows outside of all events; all windows if none is.
    """

    def level(rows: slice | Bool[np.ndarray, " w"]) -> Float[np.ndarray, "scales axes"]:
        return windows.power[:, rows].sum(axis=1) / np.maximum(windows.pairs[:, rows].sum(axis=1), 1)[:, None]

    untouched = ~touched_by(windows, events)
    usual = level(untouched if untouched.any() else slice(None))
    usual = np.where(usual > 0.0, usual, np.inf)
    known = (windows.pairs[:, inside].sum(axis=1) > 0)[:, None] & np.isfinite(usual)
    return usual, np.where(known, level(inside) / usual, 1.0)


def _single(windows: Windows, inside: slice) -> float:
    """Share of the largest difference between neighbouring samples in the sum of their squares."""
    power = windows.power[0, inside].max(axis=0)
    return float(np.max(windows.peak[inside].max(axis=0) ** 2 / np.where(power > 0.0, power, np.inf)))


def _moved(windows: Windows, s: Stretch, events: Sequence[Stretch]) -> tuple[Kind, int, float] | None:
    """Step, warm-up or other change of the mean; None where the mean is the same before and after."""
    usual = np.maximum(abs(np.diff(windows.mean, axis=0)).mean(axis=0), 1e-300)
    span = np.ptp(windows.mean[s.first : s.last], axis=0)
    if s.first <= 1:
        after = windows.mean[s.last : s.last + max(s.last - s.first, 4)]
        away = windows.mean[0] - (after.mean(axis=0) if len(after) else windows.mean[-1])
        axis = int(np.argmax(abs(away) / usual))
        if abs(away[axis]) > max(_CHANGED * usual[axis], _ONE_WAY * span[axis]):
            return "warm-up", axis, float(away[axis])
    else:
        jump, scatter = beside(windows, s, events)
        far = abs(jump) / np.where(scatter > 0.0, scatter, np.inf)
        axis = int(np.argmax(far))
        if far[axis] > _CHANGED:
            return ("step" if s.last - s.first <= _SUDDEN else "shift"), axis, float(jump[axis])
    if s.kind != "moved":
        return None
    # With its neighbours, since a single window has no span of its own.
    span = np.ptp(windows.mean[max(s.first - 1, 0) : s.last + 1], axis=0)
    axis = int(np.argmax(span / usual))
    return "shift", axis, float(span[axis])

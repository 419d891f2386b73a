"""Which part of a recording its coefficients can be of, and what happened in the others."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float

from allanjax.inspection.events import Stretch, beside, excesses, longest_quiet, unlike
from allanjax.inspection.windows import Windows

# Excess of the Allan variance at any cluster time, in standard deviations of its estimate, that matters.
_MATTERS = 1.0
# Of many events together, of which each alone would not matter, and the least of one that counts.
_TOGETHER, _COUNTS = 2.0, 0.1
# An excess of the Allan variance by less than this share changes a coefficient by 0.25 % at most.
_TRIFLE = 0.005
# Fewer windows than this have no scatter to speak of.
_FEWEST = 32
_ROUNDS = 8
# Ratio of mean squares from sample to sample up to which the noise is the same, and the mean moves.
_SAME_NOISE = 1.5
# Share of a window's differences that the largest of them has where it is the only one.
_SINGLE = 0.5
# Standard deviations by which the mean must have changed for a step.
_CHANGED = 8.0
# Share of the range of the mean that a warm-up goes from its first window to where it settles.
_ONE_WAY = 0.6
# Windows, and share of the record, up to which something is sudden, or short.
_SUDDEN, _SHORT = 6, 0.02

Kind = Literal["noisier", "quieter", "silent", "knock", "spike", "step", "warm-up", "shift"]


@dataclasses.dataclass(frozen=True)
class Event:
    """Something that happened to the sensor, or was done to it.

    Attributes:
        first, last: samples, from and up to.
        kind: what it was.
        axis: index of the axis where it is largest.
        size: of other noise, how many times the usual deviation; else how far the axis went [rad/s or m/s²].
        share: largest excess of the Allan variance that it makes, as a share of it.
        matters: whether that is more than the estimates' own error.
    """

    first: int
    last: int
    kind: Kind
    axis: int
    size: float
    share: float
    matters: bool


@dataclasses.dataclass(frozen=True)
class Quiet:
    """The events of a recording, in order, and the samples of its longest part without those that matter."""

    events: tuple[Event, ...]
    first: int
    last: int


@dataclasses.dataclass(frozen=True)
class _Found(Stretch):
    share: float = 0.0
    matters: bool = False


#: Events that are of the mean.
MOVES = ("step", "shift", "warm-up")


def quiet_part(windows: Windows, sensors: Sequence[str], may_move: bool = False) -> Quiet:
    """Find what is unlike the rest, what of it matters, and the longest part without.

    What is left is looked at again: the faint end of an event shows beside quiet windows only. Where the mean
    may move, as a model with a step in it says, such moves are no events.
    """
    first, last = 0, len(windows)
    found: list[_Found] = []
    for _ in range(_ROUNDS):
        part = windows.between(first, last)
        stretches = unlike(part, sensors) if len(part) >= _FEWEST else []
        if may_move:
            stretches = [s for s in stretches if _what(part, s, stretches)[0] not in MOVES]
        sigmas, shares = excesses(part, stretches)
        matters = sigmas > (_MATTERS if sigmas.sum() < _TOGETHER else _COUNTS)
        matters &= shares > _TRIFLE
        found += [
            _Found(first + s.first, first + s.last, s.kind, float(share), bool(m))
            for s, share, m in zip(stretches, shares, matters, strict=True)
        ]
        if not matters.any():
            break
        a, b = longest_quiet(len(part), [s for s, m in zip(stretches, matters, strict=True) if m])
        first, last = first + a, first + b
    joined = _joined(sorted(found, key=lambda s: s.first))
    edges = windows.edges
    events = [
        Event(int(edges[s.first]), int(edges[s.last]), *_what(windows, s, joined), s.share, s.matters)
        for s in joined
    ]
    return Quiet(tuple(events), int(edges[first]), int(edges[last]))


def _joined(found: Sequence[_Found]) -> list[_Found]:
    """As one what is adjacent and matters, found one after the other."""
    joined: list[_Found] = []
    for s in found:
        o = joined[-1] if joined else None
        if o is not None and s.matters and o.matters and s.first <= o.last + 1 + (s.last - s.first):
            larger = max((o, s), key=lambda x: x.share)
            joined[-1] = dataclasses.replace(larger, first=o.first, last=max(o.last, s.last))
        else:
            joined.append(s)
    return joined


def _what(windows: Windows, s: Stretch, events: Sequence[Stretch]) -> tuple[Kind, int, float]:
    """The kind of an event, the axis where it is largest, and its size there."""
    inside = slice(s.first, s.last)
    if s.kind == "silent":
        constant = windows.low[inside] == windows.high[inside]
        return "silent", int(np.argmax(constant.sum(axis=0))), 0.0
    usual, ratio = _levels(windows, inside, _untouched(windows, events))
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


def _untouched(windows: Windows, events: Sequence[Stretch]) -> Bool[np.ndarray, " w"]:
    untouched = np.ones(len(windows), bool)
    for s in events:
        untouched[s.first : s.last] = False
    return untouched if untouched.any() else ~untouched


def _levels(
    windows: Windows, inside: slice, untouched: Bool[np.ndarray, " w"]
) -> tuple[Float[np.ndarray, "scales axes"], Float[np.ndarray, "scales axes"]]:
    """Usual mean squares of the differences, and by what factor those inside are larger; one if unknown."""

    def level(rows: slice | Bool[np.ndarray, " w"]) -> Float[np.ndarray, "scales axes"]:
        return windows.power[:, rows].sum(axis=1) / np.maximum(windows.pairs[:, rows].sum(axis=1), 1)[:, None]

    usual = level(untouched)
    usual = np.where(usual > 0.0, usual, np.inf)
    known = (windows.pairs[:, inside].sum(axis=1) > 0)[:, None] & np.isfinite(usual)
    return usual, np.where(known, level(inside) / usual, 1.0)


def _single(windows: Windows, inside: slice) -> float:
    """Share of the largest difference of neighbours in the sum of the squares of all."""
    power = windows.power[0, inside].max(axis=0)
    return float(np.max(windows.peak[inside].max(axis=0) ** 2 / np.where(power > 0.0, power, np.inf)))


def _moved(windows: Windows, s: Stretch, events: Sequence[Stretch]) -> tuple[Kind, int, float] | None:
    """A step, a warm-up or another change of the mean; None where it is the same before and after."""
    usual = np.maximum(abs(np.diff(windows.mean, axis=0)).mean(axis=0), 1e-300)
    if s.first <= 1:
        after = windows.mean[s.last : s.last + max(s.last - s.first, 4)]
        settled = after.mean(axis=0) if len(after) else windows.mean[-1]
        away = windows.mean[0] - settled
        axis = int(np.argmax(abs(away) / usual))
        span = np.ptp(windows.mean[s.first : s.last], axis=0)
        if abs(away[axis]) > _CHANGED * usual[axis] and abs(away[axis]) > _ONE_WAY * span[axis]:
            return "warm-up", axis, float(away[axis])
        if s.kind != "moved":
            return None
        axis = int(np.argmax(span / usual))
        return "shift", axis, float(span[axis])
    jump, scatter = beside(windows, s, events)
    far = abs(jump) / np.where(scatter > 0.0, scatter, np.inf)
    axis = int(np.argmax(far))
    if far[axis] > _CHANGED:
        return ("step" if s.last - s.first <= _SUDDEN else "shift"), axis, float(jump[axis])
    if s.kind != "moved":
        return None
    span = np.ptp(windows.mean[s.first : s.last], axis=0)
    axis = int(np.argmax(span / usual))
    return "shift", axis, float(span[axis])

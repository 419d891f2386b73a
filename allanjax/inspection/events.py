"""Events, in which a recording differs from its rest: their effect, and the quiet parts between them."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from allanjax.inspection.levels import Levels
from allanjax.inspection.windows import (
    LENGTHS,
    Groups,
    OfAxes,
    Scores,
    Steps,
    WhichWindows,
    Windows,
    mean_square,
    mean_squares,
    noise_scores,
    runs,
    shortest_half,
    steps_of,
)

# Scores beyond which windows differ from the rest. In the clean records on which they were set (see
# benchmarks/studies/first_look.py) the largest were 6.8 except for telegraph noise, and 10.2 for steps.
_UNLIKE = 8.0
_STEP = 11.0
# The same beside windows that differ from the rest, where few averages are compared.
_BESIDE_UNLIKE = 5.0
# Score down to which a run of such windows is extended.
_STILL = 3.0
# Standard deviations of a step down to which a slow change is extended.
_STILL_MOVING = 4.0
# So many jumps of at least this share of the largest are telegraph noise, not steps.
_COMPARABLE = 0.4
_TELEGRAPH = 3
# Share of the size of a sudden step that is also observed over fewer windows.
_SAME_SIZE = 0.7
# So many constant windows are not chance on an axis whose samples repeat less often than this share.
_STUCK, _MOSTLY_NEW = 3, 0.5
# Runs at most so many windows apart are joined.
_GAP = 3
# Quiet windows on either side of a run over which the mean is taken.
_BESIDE = 16
# An event matters if it changes the Allan variance by more than this, in standard deviations of the estimate.
_MATTERS = 1.0
# Many small events matter if their changes add up to the first number; then each above the second matters.
_TOGETHER, _COUNTS = 2.0, 0.1
# Standard deviations of a run's own excess beyond which it is not chance on an axis.
_CHANCE = 3.0
#: A change of the Allan variance by less than this share changes a coefficient by 0.25 % at most.
TRIFLE = 0.005
# Fewer windows than this are too few to compare with each other.
_FEWEST = 32
# Rounds of search, each in the quiet parts that remain after the previous one.
_ROUNDS = 8
# A run whose noise differs by less than this factor is kept.
_MUCH_NOISIER = 1.5
# Ratio of mean square differences up to which the noise is unchanged and only the mean has moved.
_SAME_NOISE = 1.5
# Share of the sum of squared differences beyond which a single sample is the event.
_SINGLE = 0.5
# Standard deviations by which the mean must have changed for a step.
_CHANGED = 8.0
# Least share of the range of the mean that lies between the first window and the settled mean of a warm-up.
_ONE_WAY = 0.6
# Number of windows up to which an event is sudden, and share of the record up to which it is short.
_SUDDEN, _SHORT = 6, 0.02
#: Kinds of events, and those that change the mean only.
Kind = Literal["noisier", "quieter", "silent", "knock", "spike", "step", "warm-up", "shift"]
MOVES = ("step", "shift", "warm-up")


@dataclasses.dataclass(frozen=True)
class Run:
    """Run of windows, `first` up to but not including `last`, that differ from the rest.

    Attributes:
        kind: "silent", "noisier", "quieter", or "moved" if only the mean changes.
        effects: for each axis, the clearest change of an Allan variance due to it, in standard errors.
        axes: indices of the axes where that matters; empty until it is known.
    """

    first: int
    last: int
    kind: str
    effects: tuple[float, ...] = ()
    axes: tuple[int, ...] = ()

    @property
    def matters(self) -> bool:
        """Whether it changes an Allan variance by more than the error of the estimate."""
        return bool(self.axes)


def unusual(windows: Windows, groups: Groups) -> list[Run]:
    """Return runs with unusual noise or an unusual change of the mean, in order, without overlap."""
    # An axis that usually changes but is constant is stuck or switched off.
    stuck = (windows.low == windows.high) & (np.median(windows.repeated, axis=0) < _MOSTLY_NEW)
    disturbed = [Run(a, b, "silent") for a, b in runs(stuck.any(axis=1), _GAP) if b - a >= _STUCK]
    # Runs detected over few windows are left out of the averages over more.
    for length in LENGTHS:
        touched = touched_by(windows, disturbed)
        scores = list(noise_scores(windows, groups, length, touched))
        louder, quieter = (_runs([sign * x for x in scores], length, touched) for sign in (1.0, -1.0))
        disturbed += [Run(a, b, "noisier") for a, b in louder]
        disturbed += [Run(a, b, "quieter") for a, b in quieter if not _overlaps(a, b, disturbed)]
    steps = list(steps_of(windows, touched_by(windows, disturbed)))
    moved: list[Run] = []
    for k, of in enumerate(steps):
        for a, b in _moves(steps[: k + 1], groups):
            # A change detected over few windows is detected over more windows, too.
            if not _overlaps(a - of.lag, b + of.lag, moved):
                moved.append(Run(a, b, "moved"))
    return _merged(sorted(disturbed + moved, key=lambda s: s.first))


def touched_by(windows: Windows, disturbed: Sequence[Run]) -> WhichWindows:
    """Return which windows are in one of these runs."""
    touched = np.zeros(len(windows), bool)
    for s in disturbed:
        touched[s.first : s.last] = True
    return touched


def _runs(scores: Sequence[Scores], length: int, unusual: WhichWindows) -> list[tuple[int, int]]:
    """Return runs of windows with a score beyond the threshold, extended by neighbours beyond a lower one.

    Beside windows that are known to be unusual, the threshold is lower.
    """
    if not scores:
        return []
    score = np.concatenate(scores)
    # The loud part is about in the middle window of an average. At the ends of the record, no average has
    # the first and last windows in its middle.
    ends = (length - 1) // 2, length // 2
    peak, likely = (np.pad((score > x).any(axis=0), ends, "edge") for x in (_UNLIKE, _BESIDE_UNLIKE))
    still = np.pad((score[score.max(axis=1) > _UNLIKE] > _STILL).any(axis=0), ends)
    near = np.convolve(unusual, np.ones(2 * _GAP + 1), "same") > 0.5
    beside = [(a, b) for a, b in runs(likely, _GAP) if near[a:b].any()]
    return [(a, b) for a, b in runs(peak | still, _GAP) if peak[a:b].any()] + beside


def _moves(steps: Sequence[Steps], groups: Groups) -> list[tuple[int, int]]:
    """Return runs of windows in which the mean moves as nowhere else, according to the last of the steps.

    There are none if it jumps by a similar size three times or more: that is telegraph noise of the sensor.
    """
    last = steps[-1]
    scores = last.scores(groups)
    alarmed = scores.max(axis=1) > _STEP
    if not alarmed.any():
        return []
    sizes = np.sqrt(last.mean_squares(groups)[alarmed].max(axis=0))
    peaks, left = 0, sizes.copy()
    while peaks < _TELEGRAPH and left.max() > _COMPARABLE * sizes.max():
        place = int(np.argmax(left))
        peaks += 1
        left[max(place - 2 * last.lag, 0) : place + 2 * last.lag + 1] = 0.0
    if peaks >= _TELEGRAPH:
        return []
    strength = scores[alarmed].max(axis=0)
    clear = [(a, b) for a, b in runs(sizes > _STILL_MOVING, _GAP) if strength[a:b].max() > _STEP]
    return [_where(steps, a, b, a + int(np.argmax(strength[a:b]))) for a, b in clear]


def _where(steps: Sequence[Steps], first: int, last: int, place: int) -> tuple[int, int]:
    """Run of windows in which the mean moves, given the run of places that show it and the clearest."""
    *finer, coarsest = steps
    lag, places = coarsest.lag, coarsest.step.shape[1]
    # Place p compares windows p … p+lag−1 with as many that follow: it shows a change around p + lag.
    end = places + 2 * lag - 1
    if first == 0:
        return 0, last + lag
    if last == places:
        return first + lag, end
    axis = int(np.argmax((coarsest.step[:, place] / coarsest.scatter) ** 2))
    size, middle = abs(coarsest.step[axis, place]), place + lag
    slow = first + lag, last + lag
    # A sudden step has the same size over fewer windows.
    for fine in reversed(finer):
        near = abs(fine.step[axis, max(middle - 3 * fine.lag, 0) : middle + fine.lag + 1])
        if len(near) == 0 or near.max() < _SAME_SIZE * size:
            return slow if lag == coarsest.lag else (max(middle - lag, 0), middle + lag)
        lag, middle = fine.lag, max(middle - 3 * fine.lag, 0) + int(np.argmax(near)) + fine.lag
    return max(middle - lag, 0), min(middle + lag, end)


def _overlaps(first: int, last: int, others: Sequence[Run]) -> bool:
    """Return whether a run of windows overlaps one of the others."""
    return any(o.first < last and first < o.last for o in others)


def _merged(disturbed: Sequence[Run]) -> list[Run]:
    """Runs with overlapping ones joined, of the first kind of silent, noisier, quieter, moved."""
    merged: list[Run] = []
    for s in disturbed:
        if merged and s.first <= merged[-1].last:
            o = merged[-1]
            kind = min(o.kind, s.kind, key=("silent", "noisier", "quieter", "moved").index)
            merged[-1] = Run(o.first, max(o.last, s.last), kind)
        else:
            merged.append(s)
    return merged


def effects_of(windows: Windows, disturbed: Sequence[Run]) -> Float[np.ndarray, "runs axes"]:
    """Change of the Allan variance of each axis by each run, in standard errors, where that is largest.

    A trifling change of the variance is none.
    """
    count = np.concatenate([[0], np.cumsum(touched_by(windows, disturbed))])
    effects = np.zeros((len(disturbed), windows.mean.shape[1]))
    # Mean square differences at each cluster size, their weights, and how many windows each spans.
    within = zip(np.nan_to_num(mean_squares(windows)), windows.pairs.astype(float), strict=True)
    squares = [(square, pairs, 1) for square, pairs in within]
    squares += [((of.step**2).T, np.ones(of.step.shape[1]), 2 * of.lag) for of in steps_of(windows)]
    for square, weight, width in squares:
        # A place is not quiet if one of its windows is in a run.
        quiet = (count[width:] == count[: len(count) - width]) & (weight > 0)
        if quiet.sum() < 4:
            continue
        level = np.average(square[quiet], axis=0, weights=weight[quiet])
        level = np.where(level > 0.0, level, np.inf)
        # Neighbouring places share windows: only as many as fit side by side are independent.
        independent = max(quiet.sum() / width, 1.0) * (len(square) / quiet.sum())
        scatter = np.sqrt(np.average((square[quiet] / level - 1.0) ** 2, axis=0, weights=weight[quiet]))
        error = np.maximum(scatter / np.sqrt(independent), 1e-12)
        gain = (square / level - 1.0) * (weight / weight.sum())[:, None]
        for k, s in enumerate(disturbed):
            share = abs(gain[max(s.first - width + 1, 0) : s.last].sum(axis=0))
            effects[k] = np.maximum(effects[k], np.where(share > TRIFLE, share / error, 0.0))
    return effects


def beside(windows: Windows, run: Run, others: Sequence[Run]) -> tuple[OfAxes, OfAxes]:
    """Change of the mean across a run, and its usual scatter; zero at the ends of the record."""
    before = max([s.last for s in others if s.last <= run.first], default=0)
    after = min([s.first for s in others if s.first >= run.last], default=len(windows))
    left = windows.mean[max(before, run.first - _BESIDE) : run.first]
    right = windows.mean[run.last : min(after, run.last + _BESIDE)]
    zero = np.zeros(windows.mean.shape[1])
    if len(left) == 0 or len(right) == 0:
        return zero, zero
    # The same difference of means wherever it exists.
    apart, k = run.last - run.first, min(len(left), len(right))
    total = np.concatenate([[zero], np.cumsum(windows.mean, axis=0)])
    level = (total[k:] - total[:-k]) / k
    usual = level[k + apart :] - level[: len(level) - k - apart]
    scatter = shortest_half(usual.T)[1] if len(usual) > _BESIDE else zero
    return right.mean(axis=0) - left.mean(axis=0), scatter


@dataclasses.dataclass(frozen=True)
class Event(Run):
    """Disturbance of a recording: handling, motion, a fault, or a change of the bias.

    Attributes:
        first, last: index of its first sample, and of the one after its last.
        kind: its kind.
        axis: index of the axis where it is largest.
        size: ratio of the deviations if the noise changes; else the excursion [rad/s or m/s²].
    """

    kind: Kind
    axis: int = 0
    size: float = 0.0

    @property
    def is_slight(self) -> bool:
        """Whether the noise differs, but so little that this is how the sensor's noise varies."""
        return self.kind in ("noisier", "quieter") and self.size < _MUCH_NOISIER

    @property
    def is_of_one_axis(self) -> bool:
        """Whether it affects one axis of several and not its mean: it is not motion of the body."""
        return len(self.axes) == 1 < len(self.effects) and self.kind not in MOVES

    @property
    def is_cut(self) -> bool:
        """Whether it must be cut out on all axes."""
        return self.matters and not self.is_slight and not self.is_of_one_axis


def quiet_parts(
    windows: Windows, groups: Groups, may_move: bool, levels: Levels | None
) -> tuple[tuple[Event, ...], list[tuple[int, int]]]:
    """Return the events of a recording in order, and the parts without those that matter, as runs of windows.

    `groups` are the groups of axes to score. Events on a single axis and slight events do not affect the
    samples of other axes. Each remaining part is searched again, since the faint end of an event is only
    detected beside quiet windows. If the mean may move, as in a model with a step, changes of the mean are
    not events. The louder of two levels is cut out.
    """
    cut: list[Run] = []
    kept: list[Run] = []
    loud = [] if levels is None else [Run(a, b, "noisier") for a, b in runs(levels.loud, 0)]
    pending = _between(loud, len(windows))
    parts: list[tuple[int, int]] = []
    for search in range(_ROUNDS + 1):
        pieces, pending = pending, []
        for first, last in pieces:
            part = windows.between(first, last)
            disturbed = _of_part(part, groups, may_move) if len(part) >= _FEWEST else []
            events = list(zip(disturbed, _events(part, disturbed), strict=True))
            cuts = [s for s, e in events if e.is_cut]
            split = bool(cuts) and search < _ROUNDS
            # Harmless events may be detected again in a part; one that is kept is not, if it fills the part.
            for s, e in events:
                if not split or e.matters:
                    moved = dataclasses.replace(s, first=first + s.first, last=first + s.last)
                    (cut if e.is_cut else kept).append(moved)
            calm = _between(cuts, len(part)) if split else [(0, len(part))]
            longest = max((b - a for a, b in calm), default=0)
            remaining = [(first + a, first + b) for a, b in calm if b - a >= min(_FEWEST, longest)]
            (pending if split else parts).extend(remaining)
    found = _events(windows, _joined(cut) + _joined(kept))
    for s in loud:
        assert levels is not None
        first, last = windows.edges[[s.first, s.last]].tolist()
        every = tuple(range(windows.mean.shape[1]))
        found.append(Event(first, last, "noisier", (), every, levels.axis, levels.ratio))
    return tuple(sorted(found, key=lambda event: event.first)), sorted(parts)


def _between(cut: Sequence[Run], count: int) -> list[tuple[int, int]]:
    """Return runs of windows, `count` in all, that are at least one window away from all that is cut."""
    edges = [0, *(edge for s in cut for edge in (max(s.first - 1, 0), min(s.last + 1, count)))]
    return [(a, b) for a, b in zip(edges[::2], [*edges[1::2], count], strict=True) if b > a]


def _of_part(part: Windows, groups: Groups, may_move: bool) -> list[Run]:
    """Return the unusual runs of a part, with the axes where they matter."""
    disturbed = unusual(part, groups)
    if may_move:
        disturbed = [s for s in disturbed if _what(part, s, disturbed).kind not in MOVES]
    effects, found = effects_of(part, disturbed), []
    limit = _MATTERS if effects.max(axis=1, initial=0.0).sum() < _TOGETHER else _COUNTS
    for s, effect in zip(disturbed, effects, strict=True):
        # By chance, the effect of a run is the root of its share of the part.
        clear = max(_MATTERS, _CHANCE * np.sqrt((s.last - s.first) / len(part)))
        axes = np.flatnonzero(effect > min(clear, max(limit, float(effect.max()) * (1.0 - 1e-9))))
        found.append(dataclasses.replace(s, effects=tuple(effect.tolist()), axes=tuple(axes.tolist())))
    return found


def _events(windows: Windows, disturbed: Sequence[Run]) -> list[Event]:
    """Return disturbed runs as events."""
    edges, events = windows.edges.tolist(), []
    for s in disturbed:
        what = _what(windows, s, disturbed)
        axes = tuple(sorted({what.axis, *s.axes})) if s.matters else ()
        events.append(Event(edges[s.first], edges[s.last], what.kind, s.effects, axes, what.axis, what.size))
    return events


def _joined(disturbed: Sequence[Run]) -> list[Run]:
    """Return the runs in order, with adjacent ones that matter joined."""
    joined: list[Run] = []
    for s in sorted(disturbed, key=lambda s: s.first):
        o = joined[-1] if joined else None
        if o is not None and s.matters and o.matters and s.first <= o.last + 1 + (s.last - s.first):
            larger = max((o, s), key=lambda x: max(x.effects))
            axes = tuple(sorted({*o.axes, *s.axes}))
            joined[-1] = dataclasses.replace(larger, first=o.first, last=max(o.last, s.last), axes=axes)
        else:
            joined.append(s)
    return joined


class _What(NamedTuple):
    """What an event is: its kind, the axis where it is largest, and its size there; see `Event`."""

    kind: Kind
    axis: int
    size: float


def _what(windows: Windows, s: Run, events: Sequence[Run]) -> _What:
    """Return what an event is."""
    inside = slice(s.first, s.last)
    if s.kind == "silent":
        constant = windows.low[inside] == windows.high[inside]
        return _What("silent", int(np.argmax(constant.sum(axis=0))), 0.0)
    usual, ratio = _levels(windows, inside, events)
    if s.kind == "quieter":
        return _changed("quieter", 1.0 / np.maximum(ratio, 1e-12))
    single = _single(windows, inside) > _SINGLE
    if s.kind == "moved" or ratio[0].max() < _SAME_NOISE or single:
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
        kind: Kind = "spike" if length <= 3 and single else "knock"
        return _What(kind, axis, float(reach[axis]))
    return _changed("noisier", ratio)


def _changed(kind: Kind, ratio: Float[np.ndarray, "scales axes"]) -> _What:
    """Return a change of the noise, of which mean square differences change by this factor."""
    largest = ratio.max(axis=0)
    axis = int(np.argmax(largest))
    return _What(kind, axis, float(np.sqrt(largest[axis])))


def _levels(
    windows: Windows, inside: slice, events: Sequence[Run]
) -> tuple[Float[np.ndarray, "scales axes"], Float[np.ndarray, "scales axes"]]:
    """Return typical mean square differences, and the factor by which those inside are larger (1 if unknown).

    The typical ones are from the windows outside all events, or from all windows if there are none.
    """
    untouched = ~touched_by(windows, events)
    usual = mean_square(windows, untouched if untouched.any() else slice(None))
    usual = np.where(usual > 0.0, usual, np.inf)
    known = (windows.pairs[:, inside].sum(axis=1) > 0)[:, None] & np.isfinite(usual)
    return usual, np.where(known, mean_square(windows, inside) / usual, 1.0)


def _single(windows: Windows, inside: slice) -> float:
    """Return the share of the largest difference between neighbouring samples in the sum of squares."""
    power = windows.power[0, inside].max(axis=0)
    return float(np.max(windows.peak[inside].max(axis=0) ** 2 / np.where(power > 0.0, power, np.inf)))


def _moved(windows: Windows, s: Run, events: Sequence[Run]) -> _What | None:
    """Return a step, warm-up or other change of the mean; None if the mean is the same before and after."""
    usual = np.maximum(abs(np.diff(windows.mean, axis=0)).mean(axis=0), 1e-300)
    span = np.ptp(windows.mean[s.first : s.last], axis=0)
    if s.first <= 1:
        after = windows.mean[s.last : s.last + max(s.last - s.first, 4)]
        away = windows.mean[0] - (after.mean(axis=0) if len(after) else windows.mean[-1])
        axis = int(np.argmax(abs(away) / usual))
        if abs(away[axis]) > max(_CHANGED * usual[axis], _ONE_WAY * span[axis]):
            return _What("warm-up", axis, float(away[axis]))
    else:
        jump, scatter = beside(windows, s, events)
        far = abs(jump) / np.where(scatter > 0.0, scatter, np.inf)
        axis = int(np.argmax(far))
        if far[axis] > _CHANGED:
            return _What("step" if s.last - s.first <= _SUDDEN else "shift", axis, float(jump[axis]))
    if s.kind != "moved":
        return None
    # Neighbours are included, since a single window has no range.
    span = np.ptp(windows.mean[max(s.first - 1, 0) : s.last + 1], axis=0)
    axis = int(np.argmax(span / usual))
    return _What("shift", axis, float(span[axis]))

"""Events: outliers, disturbances and short changes of the variance that are one thing that happened.

A knock is felt by all axes, by one as outliers, by another as a disturbance, by a third as a loud stretch.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from scipy.special import gammainc

from allanjax.critic.finding import Finding
from allanjax.critic.parameters import parameter_estimate
from allanjax.critic.together import together
from allanjax.noise.estimate import Estimate

#: Names of the cause of single samples, and of an event that nothing but such samples show.
OUTLIERS, EVENT = "outliers", "event"
#: What is an event as long as it is short, and what an event is called of which it is a part.
STRETCHES = ("disturbance", "variance_change")
# Longest change of the variance that is an event, as a share of the record: a judgement.
_SHORT = 0.05
# Pause [s] after which another event begins: a judgement.
_PAUSE = 0.5
# Share of a finding's outliers below which those outside of its event are not told apart: a judgement.
_FEW = 0.1
# Expected number of chance coincidences of outliers from which on they are no event: a judgement.
_CHANCE = 1e-3


class _Mark(NamedTuple):
    """Stretch of an axis [s]: all of a finding, or its outlier number `place`."""

    start: float
    end: float
    finding: int
    place: int | None = None


def events(findings: Sequence[Finding], duration: float) -> tuple[list[Finding], list[Finding]]:
    """Events that several of these findings are, and the findings without what is in these.

    Outliers belong to an event if there are more of them than by chance.
    """
    marks = sorted(mark for k, f in enumerate(findings) for mark in _marks(k, f, duration))
    clusters = _clusters(marks)
    rate = _rate(marks, duration)
    found = [c for cluster in clusters if (c := _crowd(cluster, rate, duration))]
    if not found:
        return [], list(findings)
    # Where most of a finding is, there its evidence and its gain are told.
    home = [_home(k, f, found) for k, f in enumerate(findings)]
    happened = [
        _event(cluster, findings, [k for k, place in enumerate(home) if place == number])
        for number, cluster in enumerate(found)
    ]
    taken = {(mark.finding, mark.place) for cluster in found for mark in cluster}
    left = [_without(k, f, taken, home[k] is None) for k, f in enumerate(findings)]
    return happened, [f for f in left if f is not None]


def _marks(k: int, f: Finding, duration: float) -> list[_Mark]:
    """Stretches of a finding that may be part of an event."""
    if f.cause == OUTLIERS:
        return [_Mark(t.value, t.value, k, place) for place, t in enumerate(_numbers(f, "times"))]
    start, end = f.span
    if f.cause not in STRETCHES or (f.cause == "variance_change" and end - start > _SHORT * duration):
        return []
    errors = [f.parameters[label].std if label in f.parameters else 0.0 for label in ("start", "end")]
    before, after = (error if np.isfinite(error) else 0.0 for error in errors)
    return [_Mark(start - before, end + after, k)]


def _clusters(marks: Sequence[_Mark]) -> list[list[_Mark]]:
    """Marks, in order, that follow each other without a pause."""
    found: list[list[_Mark]] = []
    end = -np.inf
    for mark in marks:
        if mark.start - end > _PAUSE:
            found.append([])
        found[-1].append(mark)
        end = max(end, mark.end)
    return found


def _rate(marks: Sequence[_Mark], duration: float) -> float:
    """Rate of outliers outside of events [1/s], by the share of the record's parts that have none.

    An event, with however many outliers, is in a few of these parts, and one does not count.
    """
    parts = max(int(duration / _PAUSE), 2)
    seen = {int(mark.start / _PAUSE) for mark in marks if mark.place is not None}
    return -float(np.log1p(-min(max(len(seen) - 1, 0), parts - 1) / parts)) / _PAUSE


def _crowd(cluster: Sequence[_Mark], rate: float, duration: float) -> list[_Mark]:
    """Marks of a cluster that are no chance coincidence; none if they are all of one finding."""
    stretches = [mark for mark in cluster if mark.place is None]
    points = [mark for mark in cluster if mark.place is not None]
    if stretches:
        length = max(m.end for m in cluster) - min(m.start for m in cluster) + 2.0 * _PAUSE
        # Of a Poisson process: so many or more.
        by_chance = float(gammainc(len(points), rate * length)) if points else 0.0
    else:
        # So many, each within the pause after the one before.
        by_chance = (1.0 + rate * duration) * float(-np.expm1(-rate * _PAUSE)) ** (len(points) - 1)
    kept = [*cluster] if by_chance < _CHANCE else stretches
    return kept if len({mark.finding for mark in kept}) > 1 else []


def _home(k: int, f: Finding, found: Sequence[Sequence[_Mark]]) -> int | None:
    """Number of the event in which most of a finding is, None if that is none."""
    inside = [sum(mark.finding == k for mark in cluster) for cluster in found]
    whole = len(_numbers(f, "times")) if f.cause == OUTLIERS else 1
    most = int(np.argmax(inside))
    return most if inside[most] > 0 and inside[most] >= whole - sum(inside) else None


def _event(cluster: Sequence[_Mark], findings: Sequence[Finding], counted: Sequence[int]) -> Finding:
    """One event of several marks; `counted` are the findings that are told here."""
    places = sorted({mark.finding for mark in cluster})
    members = [findings[k] for k in places]
    causes = tuple(dict.fromkeys(f.cause for f in members))
    start, end = min(cluster, key=lambda m: m.start), max(cluster, key=lambda m: m.end)
    per_axis: dict[str, Estimate] = {}
    for mark in cluster:
        size, (axis,) = _loudness(mark, findings[mark.finding]), findings[mark.finding].axes
        if size is not None and (axis not in per_axis or _louder(size, per_axis[axis])):
            per_axis[axis] = size
    one = together(
        next((cause for cause in STRETCHES if cause in causes), EVENT),
        members,
        {"start": _end(start, findings, "start"), "end": _end(end, findings, "end")},
        {
            axis: per_axis[axis]
            for axis in dict.fromkeys(a for f in members for a in f.axes)
            if axis in per_axis
        },
        {"seen_as": causes} if len(causes) > 1 else {},
        [findings[k] for k in places if k in counted],
    )
    return dataclasses.replace(one, span=(one.parameters["start"].value, one.parameters["end"].value))


def _numbers(f: Finding, name: str) -> tuple[Estimate, ...]:
    """Numbers of a detail, none if there is no such detail."""
    return tuple(e for e in f.details.get(name, ()) if isinstance(e, Estimate))


def _loudness(mark: _Mark, f: Finding) -> Estimate | None:
    """How large the effect is at a mark."""
    sizes = _numbers(f, "sizes")
    if mark.place is None or mark.place >= len(sizes):
        return f.size
    size = sizes[mark.place]
    return parameter_estimate(size.axis, "peak", abs(size.value), size.std, size.unit)


def _louder(one: Estimate, other: Estimate) -> bool:
    """Whether one says more of how loud an event is: what is no ratio, then what is larger."""
    return (one.unit != "1", abs(one.value)) > (other.unit != "1", abs(other.value))


def _end(mark: _Mark, findings: Sequence[Finding], label: str) -> Estimate:
    """Start or end of a mark as a parameter."""
    f = findings[mark.finding]
    if mark.place is not None:
        return dataclasses.replace(_numbers(f, "times")[mark.place], label=label)
    return f.parameters[label]


def _without(k: int, f: Finding, taken: set[tuple[int, int | None]], is_home: bool) -> Finding | None:
    """Finding without what is in events, None if hardly anything is left.

    It keeps its evidence and its gain if most is left.
    """
    if (k, None) in taken:
        return None
    whole = len(_numbers(f, "times"))
    kept = {place for place in range(whole) if (k, place) not in taken}
    if f.cause != OUTLIERS or len(kept) == whole:
        return f
    return _of_places(f, kept.__contains__, is_home) if is_home or len(kept) > _FEW * whole else None


def _of_places(f: Finding, wanted: Callable[[int], bool], is_counted: bool) -> Finding:
    """Outliers of a finding that are wanted, by their number in its list."""
    details = {
        name: tuple(e for place, e in enumerate(_numbers(f, name)) if wanted(place))
        for name in f.details
        if _numbers(f, name)
    }
    count = len(details["times"])
    parameters = {
        label: parameter_estimate(e.axis, label, count, e.std, e.unit) if label == "count" else e
        for label, e in f.parameters.items()
    }
    span = (details["times"][0].value, details["times"][-1].value)
    one = together(
        f.cause, [f], parameters, f.amplitudes, {**f.details, **details}, [f] if is_counted else []
    )
    return dataclasses.replace(one, span=span)

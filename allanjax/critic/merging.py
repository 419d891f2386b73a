"""Findings of a recording: those of single axes, with each cause reported once.

A kind of cause determines which findings are one, and describes them. A cause without a kind is not merged.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import NamedTuple, TypeAlias

import numpy as np
from scipy.special import gammainc

from allanjax.critic.finding import UNEXPLAINED, CoefficientChange, Finding, Rival
from allanjax.critic.parameters import Detail, Limit, parameter_estimate, side_of_limit, values_of
from allanjax.critic.policy import judged
from allanjax.noise.estimate import Estimate

_ODDS = judged("search", "rivals")

# --- Several findings reported as one -----------------------------------------------------------------------


def together(
    cause: str,
    members: Sequence[Finding],
    parameters: Mapping[str, Estimate],
    per_axis: Mapping[str, Estimate],
    details: Mapping[str, Detail] | None = None,
    counted: Sequence[Finding] | None = None,
    span: tuple[float, float] | None = None,
) -> Finding:
    """Several findings joined into one; p-value, evidence and gain come from the `counted` ones.

    The p-value is the smallest one times their number; evidence and gain are sums, as the findings are in
    different axes or were found one after the other. Rivals are those of all of them. Coefficients, drift and
    discrepancies are those of the finding with the largest impact.
    """
    counted = members if counted is None else counted
    p = [f.p_value for f in counted if f.p_value is not None]
    start, end = zip(*(f.span for f in members), strict=True)
    axes = tuple(dict.fromkeys(axis for f in members for axis in f.axes))
    whole = Finding(
        cause=cause,
        axes=axes,
        parameters=parameters,
        p_value=min(1.0, min(p) * len(counted)) if p else None,
        evidence=_sum(f.evidence for f in counted),
        gain=_sum(f.gain for f in counted),
        rivals=_rivals(counted),
        span=span or (min(start), max(end)),
        domain=members[0].domain,
        details=details or {},
        # The rest of a finding represents it.
        members=tuple(made for f in members for made in f.members or (f,)),
        per_axis={axis: per_axis[axis] for axis in axes if axis in per_axis},
    )
    if not counted:
        return whole
    main = max(counted, key=lambda f: (f.impact.size, f.gain or 0.0))
    return dataclasses.replace(
        whole,
        coefficients=main.coefficients,
        drift=main.drift,
        discrepancies=main.discrepancies,
        rest=min((f.rest for f in counted if f.rest), key=lambda rest: rest.p_value, default=None),
    )


def shared(members: Sequence[Finding], labels: Iterable[str]) -> dict[str, Estimate]:
    """Parameters that all members have in common."""
    means = {label: mean_of(each) for label in labels if (each := _each(members, label))}
    return {label: mean for label, mean in means.items() if mean is not None}


def summed(members: Sequence[Finding], labels: Iterable[str]) -> dict[str, Estimate]:
    """Sums of parameters over the members that have them."""
    found = {}
    for label in labels:
        if each := _each(members, label):
            std = float(np.linalg.norm([e.std for e in each]))
            found[label] = _changed(each[0], sum(e.value for e in each), std)
    return found


def _each(members: Sequence[Finding], label: str) -> list[Estimate]:
    """A parameter in the members that have it."""
    return [f.parameters[label] for f in members if label in f.parameters]


def _changed(e: Estimate, value: float, std: float, limit: Limit = "") -> Estimate:
    """Estimate of another value."""
    return parameter_estimate(e.axis, e.label, value, std, e.unit, limit)


def mean_of(each: Sequence[Estimate]) -> Estimate | None:
    """Mean of estimates, weighted by their errors; if they scatter more, its error is larger.

    None if they are exact and differ, or have different units.
    """
    if len({e.unit for e in each}) > 1:
        return None
    if len({(e.value, e.std) for e in each}) == 1:
        return each[0]
    known = [e for e in each if np.isfinite(e.std)]
    if not known:
        # Limits: the weakest one holds for all.
        return max(each, key=lambda e: e.value if e.lower_limit is None else -e.value)
    value, std = (np.array([getattr(e, name) for e in known]) for name in ("value", "std"))
    if not np.all(std > 0.0):
        return None
    weight = 1.0 / std**2
    mean = float(weight @ value / weight.sum())
    scatter = float(np.sqrt(weight @ (value - mean) ** 2 / max(len(known) - 1, 1)))
    error = max(scatter, 1.0) / float(np.sqrt(weight.sum()))
    return _changed(known[0], mean, error)


def largest(members: Sequence[Finding]) -> dict[str, Estimate]:
    """Size of the effect in each axis; the largest if an axis has several members."""
    found: dict[str, Estimate] = {}
    for f in members:
        for axis, size in f.amplitudes.items():
            if axis not in found or abs(size.value) > abs(found[axis].value):
                found[axis] = size
    return found


def _sum(values: Iterable[float | None]) -> float | None:
    """Sum of the numbers that are not None; None if there are none."""
    known = [value for value in values if value is not None]
    return float(sum(known)) if known else None


def _rivals(members: Sequence[Finding]) -> tuple[Rival, ...]:
    """Causes that are rivals in all members, with the product of their odds."""
    each = [{rival.cause: rival.odds for rival in f.rivals} for f in members]
    if not each:
        return ()
    odds = {
        name: float(np.prod([own[name] for own in each])) for name in each[0] if all(name in o for o in each)
    }
    return tuple(Rival(name, value) for name, value in odds.items() if value < _ODDS)


#: Names of the cause of single samples, and of an event of such samples only.
OUTLIERS, EVENT = "outliers", "event"
#: Causes that are events if they are short, and names of the events of which they are a part.
STRETCHES = ("disturbance", "variance_change")
_SHORT, _PAUSE, _FEW, _CHANCE = (judged("event", name) for name in ("short", "pause", "few", "chance"))


class _Mark(NamedTuple):
    """Stretch of an axis [s]: all of a finding, or its outlier number `place`.

    `ends` are its start and end as parameters, `size` is the size of the effect there.
    """

    start: float
    end: float
    finding: int
    place: int | None
    ends: tuple[Estimate, Estimate]
    size: Estimate | None


def events(findings: Sequence[Finding], duration: float) -> tuple[list[Finding], list[Finding]]:
    """Events formed by several of these findings, and the findings without the parts in events.

    Outliers belong to an event if there are more of them than by chance.
    """
    marks = [mark for k, f in enumerate(findings) for mark in _marks(k, f, duration)]
    marks.sort(key=lambda mark: mark[:3])
    clusters = _clusters(marks)
    rate = _rate(marks, duration)
    found = [c for cluster in clusters if (c := _crowd(cluster, rate, duration))]
    if not found:
        return [], list(findings)
    # The evidence and gain of a finding are reported where most of it is.
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
    start, end = f.span
    if f.cause == OUTLIERS:
        each = enumerate(zip(_numbers(f, "times"), _numbers(f, "sizes"), strict=True))
        return [_Mark(t.value, t.value, k, place, (t, t), _peak(size)) for place, (t, size) in each]
    if f.cause not in STRETCHES or (f.cause == "variance_change" and end - start > _SHORT * duration):
        return []
    ends = f.parameters["start"], f.parameters["end"]
    before, after = (e.std if np.isfinite(e.std) else 0.0 for e in ends)
    return [_Mark(start - before, end + after, k, None, ends, f.size)]


def _clusters(marks: Sequence[_Mark]) -> list[list[_Mark]]:
    """Ordered marks that follow each other without a pause."""
    found: list[list[_Mark]] = []
    end = -np.inf
    for mark in marks:
        if mark.start - end > _PAUSE:
            found.append([])
        found[-1].append(mark)
        end = max(end, mark.end)
    return found


def _rate(marks: Sequence[_Mark], duration: float) -> float:
    """Rate of outliers outside events [1/s], from the share of the record's parts without any.

    An event, with however many outliers, is in few of these parts, one of which does not count.
    """
    parts = max(int(duration / _PAUSE), 2)
    seen = {int(mark.start / _PAUSE) for mark in marks if mark.place is not None}
    return -float(np.log1p(-min(max(len(seen) - 1, 0), parts - 1) / parts)) / _PAUSE


def _crowd(cluster: Sequence[_Mark], rate: float, duration: float) -> list[_Mark]:
    """Marks of a cluster that are not a chance coincidence; none if all belong to one finding."""
    stretches = [mark for mark in cluster if mark.place is None]
    points = [mark for mark in cluster if mark.place is not None]
    if stretches:
        length = max(m.end for m in cluster) - min(m.start for m in cluster) + 2.0 * _PAUSE
        # Poisson process: probability of so many or more.
        by_chance = float(gammainc(len(points), rate * length)) if points else 0.0
    else:
        # So many, each within one pause after the last.
        by_chance = (1.0 + rate * duration) * float(-np.expm1(-rate * _PAUSE)) ** (len(points) - 1)
    kept = [*cluster] if by_chance < _CHANCE else stretches
    return kept if len({mark.finding for mark in kept}) > 1 else []


def _home(k: int, f: Finding, found: Sequence[Sequence[_Mark]]) -> int | None:
    """Number of the event with most of a finding; None if there is none."""
    inside = [sum(mark.finding == k for mark in cluster) for cluster in found]
    whole = len(_numbers(f, "times")) if f.cause == OUTLIERS else 1
    most = int(np.argmax(inside))
    return most if inside[most] > 0 and inside[most] >= whole - sum(inside) else None


def _event(cluster: Sequence[_Mark], findings: Sequence[Finding], counted: Sequence[int]) -> Finding:
    """One event from several marks; `counted` are the findings that are reported here."""
    places = sorted({mark.finding for mark in cluster})
    members = [findings[k] for k in places]
    causes = tuple(dict.fromkeys(f.cause for f in members))
    first, last = min(cluster, key=lambda m: m.start), max(cluster, key=lambda m: m.end)
    start = dataclasses.replace(first.ends[0], label="start")
    end = dataclasses.replace(last.ends[1], label="end")
    per_axis: dict[str, Estimate] = {}
    for mark in cluster:
        size, (axis,) = mark.size, findings[mark.finding].axes
        if size is not None and (axis not in per_axis or _louder(size, per_axis[axis])):
            per_axis[axis] = size
    return together(
        next((cause for cause in STRETCHES if cause in causes), EVENT),
        members,
        {"start": start, "end": end},
        per_axis,
        {"seen_as": causes} if len(causes) > 1 else {},
        [findings[k] for k in places if k in counted],
        (start.value, end.value),
    )


def _numbers(f: Finding, name: str) -> tuple[Estimate, ...]:
    """Numbers of a detail; empty if there is no such detail."""
    return tuple(e for e in f.details.get(name, ()) if isinstance(e, Estimate))


def _peak(size: Estimate) -> Estimate:
    """Magnitude of an outlier."""
    return parameter_estimate(size.axis, "peak", abs(size.value), size.std, size.unit)


def _louder(one: Estimate, other: Estimate) -> bool:
    """Whether one describes the size of an event better: a value other than a ratio, then a larger one."""
    return (one.unit != "1", abs(one.value)) > (other.unit != "1", abs(other.value))


def _without(k: int, f: Finding, taken: set[tuple[int, int | None]], is_home: bool) -> Finding | None:
    """Finding without its parts in events, or None; it keeps evidence and gain if most of it is left."""
    if (k, None) in taken:
        return None
    whole = len(_numbers(f, "times"))
    kept = {place for place in range(whole) if (k, place) not in taken}
    if f.cause != OUTLIERS or len(kept) == whole:
        return f
    return _of_places(f, kept.__contains__, is_home) if is_home or len(kept) > _FEW * whole else None


def _of_places(f: Finding, wanted: Callable[[int], bool], is_counted: bool) -> Finding:
    """Selected outliers of a finding, by their number in its list."""
    details = {
        name: tuple(e for place, e in enumerate(_numbers(f, name)) if wanted(place))
        for name in f.details
        if _numbers(f, name)
    }
    times, count = details["times"], f.parameters["count"]
    return together(
        f.cause,
        [f],
        {**f.parameters, "count": _changed(count, len(times), count.std)},
        f.amplitudes,
        {**f.details, **details},
        [f] if is_counted else [],
        (times[0].value, times[-1].value),
    )


# Standard deviations within which values count as the same: of a line, a place in time, a shape.
_LINE, _TIME, _SHAPE = 4.0, 4.0, 3.0
_NARROW, _STEADY, _ORDERS, _BY_CHANCE = (
    judged("line", name) for name in ("quality", "steady", "orders", "near")
)
_BANDWIDTH, _FACTOR = judged("low_pass", "same"), judged("warm_up", "same")
_DAMPING = judged("resonance", "same")
_STEP_TIME, _APART = judged("bias_step", "at once"), judged("bias_step", "apart")
_NESTED, _SAME, _ALIKE = (judged("event", name) for name in ("nested", "same", "alike"))

#: Whether two findings of a kind are one, in a record of this length [s].
Same: TypeAlias = Callable[[Finding, Finding, float], bool]


class Kind(NamedTuple):
    """Kind of findings of which several are reported as one.

    Attributes:
        applies: whether a finding is of this kind.
        same: whether a finding is one with the strongest one.
        combine: combines several findings into one.
        is_once: whether only one finding of each axis is meant.
        grows: whether a finding joins if it is the same as any member, not only as the strongest one.
        anchor: the finding that is compared with the others, instead of the strongest one.
    """

    applies: Callable[[Finding], bool]
    same: Same
    combine: Callable[[Sequence[Finding]], Finding]
    is_once: bool = False
    grows: bool = False
    anchor: Callable[[Finding, Sequence[Finding], float], Finding] = lambda first, findings, duration: first

    def family(self, findings: Sequence[Finding], duration: float) -> list[Finding]:
        """Those of these findings of this kind that are one with the strongest, itself included."""
        by_weight = sorted(findings, key=_weight, reverse=True)
        anchor = self.anchor(by_weight[0], findings, duration)
        family = [by_weight[0]] if anchor is by_weight[0] else [by_weight[0], anchor]
        for known in family if self.grows else [anchor]:
            for f in by_weight:
                taken = _among(f, family) or (self.is_once and f.axes in [g.axes for g in family])
                if not taken and self.same(known, f, duration):
                    family.append(f)
        return [f for f in findings if _among(f, family)]


def merged(
    findings: Sequence[Finding], of_several: Sequence[Finding], duration: float
) -> tuple[Finding, ...]:
    """Findings of a recording of this length [s], the largest change first, unexplained ones last.

    `findings` are those of the single axes, axis by axis; `of_several` those that several axes share.
    """
    happened, left = events(findings, duration)
    found, left = [], [*happened, *left]
    for kind in KINDS:
        own = [f for f in left if kind.applies(f)]
        left = [f for f in left if not kind.applies(f)]
        while own:
            family = kind.family(own, duration)
            own = [f for f in own if not _among(f, family)]
            found.append(kind.combine(family) if len(family) > 1 else family[0])
    return tuple(sorted([*found, *left, *of_several], key=_place))


def _place(f: Finding) -> tuple[bool, float, float]:
    """Sorting key of findings."""
    return f.cause == UNEXPLAINED, -f.impact.size, -_weight(f)


def _weight(f: Finding) -> float:
    return f.gain or 0.0


def _among(f: Finding, family: Sequence[Finding]) -> bool:
    """Whether it is identical, not only equal, to one of these."""
    return any(f is other for other in family)


# --- Values that are the same -------------------------------------------------------------------------------


def _value(f: Finding, label: str) -> tuple[float, float]:
    """A parameter and its error, 0 if that is unknown; nan if there is no such parameter."""
    e = f.parameters.get(label)
    if e is None:
        return float("nan"), 0.0
    return e.value, e.std if np.isfinite(e.std) else 0.0


def _near(one: Finding, other: Finding, label: str, deviations: float, least: float, most: float) -> bool:
    """Whether two parameters agree within their errors; `least` is always allowed, `most` never."""
    (a, a_std), (b, b_std) = _value(one, label), _value(other, label)
    return bool(abs(a - b) <= max(min(deviations * np.hypot(a_std, b_std), most), least))


def _similar(one: Finding, other: Finding, label: str, factor: float) -> bool:
    """Whether two positive parameters agree within a factor or within their errors."""
    (a, a_std), (b, b_std) = _value(one, label), _value(other, label)
    if not (a > 0.0 and b > 0.0):
        return False
    return bool(abs(np.log(a / b)) <= max(_SHAPE * np.hypot(a_std / a, b_std / b), np.log(factor)))


def _sensor(f: Finding) -> str:
    """Sensor of a finding's axis, if its parameters determine it."""
    return next((e.axis.sensor for e in f.parameters.values()), "")


def _same_filter(one: Finding, other: Finding, duration: float) -> bool:
    return _sensor(one) == _sensor(other) and _similar(one, other, "bandwidth", 1.0 + _BANDWIDTH)


def _same_resonance(one: Finding, other: Finding, duration: float) -> bool:
    """Whether two resonances overlap for the most part and are about equally wide."""
    widths = sorted(_width(f) for f in (one, other))
    return _near(one, other, "frequency", _SHAPE, 0.5 * widths[0], widths[1]) and _similar(
        one, other, "quality_factor", _DAMPING
    )


def _overlap(one: Finding, other: Finding) -> float:
    """Common length of two stretches, as a share of the longer one."""
    (a, b), (c, d) = one.span, other.span
    return (min(b, d) - max(a, c)) / max(b - a, d - c, 1e-300)


# --- Kinds --------------------------------------------------------------------------------------------------


def _simple(
    causes: Sequence[str],
    same: Same,
    parameters: Sequence[str] = (),
    totals: Sequence[str] = (),
    is_once: bool = True,
) -> Kind:
    """Kind of causes of which several findings are merged if they are `same`.

    The `parameters` are those that the axes share; for the `totals` the sum is reported.
    """

    def combine(members: Sequence[Finding]) -> Finding:
        words = {
            name: detail
            for name, detail in members[0].details.items()
            if isinstance(detail, str) and all(f.details.get(name) == detail for f in members)
        }
        own = shared(members, parameters) | summed(members, totals)
        return together(members[0].cause, members, own, largest(members), words)

    return Kind(lambda f: f.cause in causes, same, combine, is_once)


def _same_stretch(one: Finding, other: Finding, duration: float) -> bool:
    """Whether two stretches last as long, or overlap on one axis: one is then the rest of the event."""
    return _overlap(one, other) > (_NESTED if set(one.axes) & set(other.axes) else _SAME)


def _stretch(members: Sequence[Finding]) -> Finding:
    """One stretch, with the times of the strongest finding, and the changes from the first to the last."""
    first = max(members, key=_weight)
    alike = [f for f in members if _overlap(first, f) > _ALIKE]
    causes = {cause: None for cause in STRETCHES if any(f.cause == cause for f in members)}
    seen: dict[str, Detail] = {"seen_as": tuple(causes)} if len(causes) > 1 else {}
    whole = together(next(iter(causes)), members, shared(alike, ["start", "end"]), _sizes(members), seen)
    before: dict[str, CoefficientChange] = {}
    after: dict[str, float] = {}
    for change in (c for f in whole.members if f.axes == whole.strongest.axes for c in f.coefficients):
        before.setdefault(change.label, change)
        after[change.label] = change.after
    changes = tuple(dataclasses.replace(c, after=after[label]) for label, c in before.items())
    return dataclasses.replace(whole, coefficients=changes)


def _sizes(members: Sequence[Finding]) -> dict[str, Estimate]:
    """Size of an event in each axis: its peak, or the product of ratios that were found in turn."""
    found = largest(members)
    for axis, size in found.items():
        each = [f.amplitudes[axis] for f in members if axis in f.amplitudes]
        peaks = [e for e in each if e.unit != "1"]
        if peaks:
            found[axis] = max(peaks, key=lambda e: abs(e.value))
        elif len(each) > 1:
            value = float(np.prod([e.value for e in each]))
            std = value * float(np.linalg.norm([e.std / e.value for e in each]))
            limit = max(map(side_of_limit, each), key=bool)
            found[axis] = _changed(size, value, std, limit)
    return found


def _is_line(f: Finding) -> bool:
    """Whether a finding is a line: one that keeps its phase, or a narrow resonance."""
    return "frequency" in f.parameters and (
        f.cause == "sinusoid" or (f.cause == "resonance" and _value(f, "quality_factor")[0] > _NARROW)
    )


def _order(low: Finding, high: Finding, duration: float) -> int:
    """Order of one line as a harmonic of another, 1 if they are the same; 0 if it is none."""
    (f, std), (other, other_std) = (_value(one, "frequency") for one in (low, high))
    order = int(np.rint(other / f))
    reach = max(_LINE * float(np.hypot(other_std, order * std)), 1.0 / duration)
    if abs(other - f) <= max(reach, _STEADY / duration, *(0.5 * _width(one) for one in (low, high))):
        return 1
    if not 2 <= order <= _ORDERS or abs(other - order * f) > reach:
        return 0
    return order if reach < _BY_CHANCE * f else 0


def _width(f: Finding) -> float:
    """Width of a resonance [Hz]; None for a line that keeps its phase."""
    return _value(f, "frequency")[0] / _value(f, "quality_factor")[0] if f.cause == "resonance" else 0.0


def _fundamental(first: Finding, findings: Sequence[Finding], duration: float) -> Finding:
    """Lowest line of which the strongest one is a harmonic, or itself."""

    def frequency(f: Finding) -> float:
        return f.parameters["frequency"].value

    below = (f for f in findings if frequency(f) <= frequency(first) and _order(f, first, duration))
    return min([first, *below], key=frequency)


def _line(members: Sequence[Finding]) -> Finding:
    """One line with its harmonics, and its amplitude in each axis at the lowest frequency found there."""
    lowest = min(f.parameters["frequency"].value for f in members)
    orders = [max(round(f.parameters["frequency"].value / lowest), 1) for f in members]
    each = zip((f.parameters["frequency"] for f in members), orders, strict=True)
    fundamental = [e if order == 1 else _changed(e, e.value / order, e.std / order) for e, order in each]
    frequency, cause = mean_of(fundamental), max(members, key=_weight).cause
    per_axis: dict[str, Estimate] = {}
    for f, order in sorted(zip(members, orders, strict=True), key=lambda pair: (pair[1], -_weight(pair[0]))):
        for axis, size in f.amplitudes.items():
            # The amplitude of a resonance is a standard deviation.
            remarks = [f"harmonic {order}" if order > 1 else "", "" if f.cause == cause else f"as {f.cause}"]
            remark = ", ".join(text for text in remarks if text)
            per_axis.setdefault(axis, dataclasses.replace(size, remark=remark))
    every = sorted({k for f in members for k in _harmonics(f, lowest)})
    whose = fundamental[0].axis
    return together(
        cause,
        members,
        ({} if frequency is None else {"frequency": frequency}) | shared(members, ["quality_factor"]),
        per_axis,
        {"harmonics": tuple(parameter_estimate(whose, "harmonic", k, 0.0, "1") for k in every)}
        if every
        else {},
    )


def _harmonics(f: Finding, fundamental: float) -> set[int]:
    """Orders of the harmonics in a finding of a line, its own included."""
    own = f.parameters["frequency"].value / fundamental
    each = [own, *(own * float(k) for k in values_of(f.details.get("harmonics", ()))[0])]
    each += [float(x) / fundamental for x in values_of(f.details.get("further_frequencies", ()))[0]]
    return {round(k) for k in each if abs(k - round(k)) < _BY_CHANCE * k and round(k) > 1}


#: Kinds of findings that are reported once for several axes.
KINDS: tuple[Kind, ...] = (
    Kind(_is_line, lambda one, other, duration: _order(one, other, duration) > 0, _line, anchor=_fundamental),
    _simple(["low_pass"], _same_filter, ["bandwidth", "order"]),
    _simple(["resonance"], _same_resonance, ["frequency", "quality_factor"]),
    _simple(
        ["bias_step"],
        lambda one, other, duration: _near(
            one, other, "time", _TIME, _STEP_TIME * duration, _APART * duration
        ),
        ["time"],
    ),
    _simple(
        ["warm_up"], lambda one, other, _: _similar(one, other, "time_constant", _FACTOR), ["time_constant"]
    ),
    _simple(
        ["temperature"],
        lambda one, other, _: one.details.get("channel") == other.details.get("channel"),
        ["lag"],
    ),
    Kind(lambda f: f.cause in STRETCHES, _same_stretch, _stretch, grows=True),
    _simple(
        [OUTLIERS], lambda one, other, _: _sensor(one) == _sensor(other), totals=["count"], is_once=False
    ),
    _simple(("rounding", "saturation", "repeated_samples"), lambda one, other, _: one.cause == other.cause),
)

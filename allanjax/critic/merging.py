"""Findings of a recording: those of single axes, with each cause reported once.

Outliers and short stretches that happen together become events; `RULES` tell which other findings are one.
"""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from scipy.special import gammainc

from allanjax.critic.finding import UNEXPLAINED, Finding, Rival
from allanjax.critic.grouping import order_of
from allanjax.critic.parameters import Detail, Limit, parameter_estimate, side_of_limit, values_of
from allanjax.critic.policy import judged
from allanjax.noise.estimate import Estimate

#: Names of the cause of single samples, and of an event of such samples only.
OUTLIERS, EVENT = "outliers", "event"
# Causes that are events if they are short, and names of the events of which they are a part.
_STRETCHES = ("disturbance", "variance_change")
# Parameters that the axes have in common; all others belong to one axis.
_SHARED = ("frequency", "quality_factor", "bandwidth", "order", "time", "time_constant", "lag")
# Standard deviations within which values count as the same.
_DEVIATIONS = 4.0
_ODDS = judged("search", "rivals")
_SHORT, _PAUSE, _FEW, _CHANCE = (judged("event", name) for name in ("short", "pause", "few", "chance"))
_NESTED, _SAME, _ALIKE = (judged("event", name) for name in ("nested", "same", "alike"))
_NARROW, _STEADY, _BY_CHANCE = (judged("line", name) for name in ("quality", "steady", "near"))
_FILTER, _DAMPING, _WARMING = (judged(cause, "same") for cause in ("low_pass", "resonance", "warm_up"))
_AT_ONCE, _APART = judged("bias_step", "at once"), judged("bias_step", "apart")


def merged(
    findings: Sequence[Finding], of_several: Sequence[Finding], duration: float
) -> tuple[Finding, ...]:
    """Findings of a recording of this length [s], the largest change first, unexplained ones last.

    `findings` are those of the single axes, axis by axis; `of_several` those that several axes share.
    """
    by_kind: dict[tuple[str, str], list[Finding]] = {}
    for f in _with_events(findings, duration):
        by_kind.setdefault(_kind(f), []).append(f)
    found = [*of_several]
    for (name, _), own in by_kind.items():
        rule = RULES.get(name)
        for family in rule.families(own, duration) if rule else [[f] for f in own]:
            found.append(rule.combine(family) if rule and len(family) > 1 else family[0])
    return tuple(sorted(found, key=lambda f: (f.cause == UNEXPLAINED, -f.impact.size, -_weight(f))))


def _weight(f: Finding) -> float:
    return f.gain or 0.0


# --- Several findings reported as one -----------------------------------------------------------------------


def together(
    members: Sequence[Finding],
    cause: str = "",
    parameters: Mapping[str, Estimate] | None = None,
    per_axis: Mapping[str, Estimate] | None = None,
    details: Mapping[str, Detail] | None = None,
) -> Finding:
    """Several findings joined into one, by default with all that they have in common.

    The p-value is the smallest one times their number; evidence and gain are sums, as the findings are in
    different axes or were found one after the other. Rivals are those of all of them. Coefficients, drift and
    discrepancies are those of the finding with the largest impact.
    """
    # Of a finding that is split, one part has these.
    counted = [f for f in members if (f.p_value, f.evidence, f.gain) != (None, None, None)] or members
    p = [f.p_value for f in counted if f.p_value is not None]
    odds = [{rival.cause: rival.odds for rival in f.rivals} for f in counted]
    product = {name: float(np.prod([own.get(name, np.inf) for own in odds])) for name in odds[0]}
    start, end = zip(*(f.span for f in members), strict=True)
    axes = tuple(dict.fromkeys(axis for f in members for axis in f.axes))
    sizes = _largest(members) if per_axis is None else per_axis
    words: Iterable[set[tuple[str, Detail]]] = (
        {(name, x) for name, x in f.details.items() if isinstance(x, str)} for f in members
    )
    return dataclasses.replace(
        max(counted, key=lambda f: (f.impact.size, _weight(f))),
        cause=cause or members[0].cause,
        axes=axes,
        parameters=_means(members) if parameters is None else parameters,
        p_value=min(1.0, min(p) * len(counted)) if p else None,
        evidence=_sum(f.evidence for f in counted),
        gain=_sum(f.gain for f in counted),
        rivals=tuple(Rival(name, value) for name, value in product.items() if value < _ODDS),
        span=(min(start), max(end)),
        rest=min((f.rest for f in counted if f.rest), key=lambda rest: rest.p_value, default=None),
        details=dict(sorted(set.intersection(*words))) if details is None else details,
        members=tuple(made for f in members for made in f.members or (f,)),
        per_axis={axis: sizes[axis] for axis in axes if axis in sizes},
        stages=(-1, -1),
    )


def _sum(values: Iterable[float | None]) -> float | None:
    """Sum of the numbers that are not None; None if there are none."""
    known = [value for value in values if value is not None]
    return float(sum(known)) if known else None


def _largest(members: Sequence[Finding]) -> dict[str, Estimate]:
    """The largest size in each axis; one that is not a ratio describes an event better."""
    sizes = (size for f in members for size in f.amplitudes.items())
    return dict(sorted(sizes, key=lambda size: (size[1].unit != "1", abs(size[1].value))))


def _means(members: Sequence[Finding], labels: Sequence[str] = _SHARED) -> dict[str, Estimate]:
    """Means of parameters that the members have in common, and the sum of their counts."""
    each = {
        name: [f.parameters[name] for f in members if name in f.parameters] for name in (*labels, "count")
    }
    found = {name: mean for name in labels if (mean := _mean(each[name]))}
    if counts := each["count"]:
        std = float(np.linalg.norm([e.std for e in counts]))
        found["count"] = _changed(counts[0], sum(e.value for e in counts), std)
    return found


def _mean(each: Sequence[Estimate]) -> Estimate | None:
    """Mean of estimates, weighted by their errors; if they scatter more, its error is larger.

    None if they are exact and differ, or have different units.
    """
    if len({e.unit for e in each}) != 1:
        return None
    if len({(e.value, e.std) for e in each}) == 1:
        return each[0]
    known = [e for e in each if np.isfinite(e.std)]
    if not known:
        # Limits: the weakest one holds for all.
        return max(each, key=lambda e: e.value if e.lower_limit is None else -e.value)
    value, std = np.array([(e.value, e.std) for e in known]).T
    if not np.all(std > 0.0):
        return None
    weight = 1.0 / std**2
    mean = float(weight @ value / weight.sum())
    scatter = float(np.sqrt(weight @ (value - mean) ** 2 / max(len(known) - 1, 1)))
    return _changed(known[0], mean, max(scatter, 1.0) / float(np.sqrt(weight.sum())))


def _changed(e: Estimate, value: float, std: float, limit: Limit = "") -> Estimate:
    """Estimate of another value."""
    return parameter_estimate(e.axis, e.label, value, std, e.unit, limit)


# --- Events -------------------------------------------------------------------------------------------------


class _Mark(NamedTuple):
    """Stretch of an axis [s]: all of finding number `finding`, or its outlier number `place`."""

    start: float
    end: float
    finding: int
    place: int | None


def _with_events(findings: Sequence[Finding], duration: float) -> list[Finding]:
    """Findings whose parts that happen together are events instead."""
    events = _events(findings, duration)
    event_of = {(mark.finding, mark.place): number for number, event in enumerate(events) for mark in event}
    parts: list[list[Finding]] = [[] for _ in events]
    left = []
    for k, f in enumerate(findings):
        places = [mark.place for mark in _marks(k, f, duration)] or [None]
        inside = [event_of.get((k, place)) for place in places]
        count = Counter(inside)
        # Evidence and gain are reported where most of it is.
        home = max(count, key=lambda number: (count[number], number is not None))
        for number in count:
            own = [k for k, event in zip(places, inside, strict=True) if event == number and k is not None]
            is_whole = len(own) == 0 or (number is None and len(count) == 1)
            part = f if is_whole else _part(f, own, number == home, number is not None)
            if number is not None:
                parts[number].append(part)
            elif home is None or len(own) > _FEW * len(places):
                left.append(part)
    return [*map(_event, parts), *left]


def _events(findings: Sequence[Finding], duration: float) -> list[list[_Mark]]:
    """Marks of each event, which follow each other without a pause."""
    marks = [mark for k, f in enumerate(findings) for mark in _marks(k, f, duration)]
    marks.sort(key=lambda mark: mark[:2])
    clusters: list[list[_Mark]] = []
    end = -np.inf
    for mark in marks:
        if mark.start - end > _PAUSE:
            clusters.append([])
        clusters[-1].append(mark)
        end = max(end, mark.end)
    # Rate of other outliers [1/s], from the share of the record's parts without any: an event, with however
    # many outliers, is in few of these parts, one of which does not count.
    parts = max(int(duration / _PAUSE), 2)
    seen = {int(mark.start / _PAUSE) for mark in marks if mark.place is not None}
    rate = -float(np.log1p(-min(max(len(seen) - 1, 0), parts - 1) / parts)) / _PAUSE
    return [kept for cluster in clusters if (kept := _crowd(cluster, rate, duration))]


def _marks(k: int, f: Finding, duration: float) -> list[_Mark]:
    """Marks of finding number k that may be part of an event."""
    if f.cause == OUTLIERS:
        times = [float(t) for t in values_of(f.details.get("times", ()))[0]]
        return [_Mark(t, t, k, place) for place, t in enumerate(times)]
    start, end = f.span
    if f.cause not in _STRETCHES or (f.cause == "variance_change" and end - start > _SHORT * duration):
        return []
    return [_Mark(start - _value(f, "start")[1], end + _value(f, "end")[1], k, None)]


def _crowd(cluster: Sequence[_Mark], rate: float, duration: float) -> list[_Mark]:
    """Marks of a cluster that are not a chance coincidence; none if all belong to one finding."""
    stretches = [mark for mark in cluster if mark.place is None]
    points = len(cluster) - len(stretches)
    if stretches:
        length = max(mark.end for mark in cluster) - cluster[0].start + 2.0 * _PAUSE
        # Poisson process: probability of so many or more.
        by_chance = float(gammainc(points, rate * length)) if points else 0.0
    else:
        # So many, each within one pause after the last.
        by_chance = (1.0 + rate * duration) * float(-np.expm1(-rate * _PAUSE)) ** (points - 1)
    kept = [*cluster] if by_chance < _CHANCE else stretches
    return kept if len({mark.finding for mark in kept}) > 1 else []


def _part(f: Finding, places: Sequence[int], is_home: bool, is_event: bool) -> Finding:
    """Some outliers of a finding, as a stretch if they are in an event; it keeps the evidence in its home."""
    nothing = Finding(f.cause, f.axes, {}, None, None, None, (), f.span, f.domain)
    lists = {name: [e for e in x if isinstance(e, Estimate)] for name, x in f.details.items()}
    details = {name: tuple(own[k] for k in places) for name, own in lists.items() if own}
    times, peak = details["times"], max(details["sizes"], key=lambda e: abs(e.value))
    count = _changed(f.parameters["count"], len(times), f.parameters["count"].std)
    peak = parameter_estimate(peak.axis, "peak", abs(peak.value), peak.std, peak.unit)
    as_event = {
        "start": dataclasses.replace(times[0], label="start"),
        "end": dataclasses.replace(times[-1], label="end"),
        "peak": peak,
    }
    return dataclasses.replace(
        f if is_home else nothing,
        parameters=as_event if is_event else {**f.parameters, "count": count},
        span=(times[0].value, times[-1].value),
        details={**f.details, **details},
        members=(f,),
        per_axis={f.axes[0]: peak} if is_event else f.amplitudes,
        stages=(-1, -1),
    )


def _event(
    members: Sequence[Finding],
    ends: Mapping[str, Estimate] | None = None,
    sizes: Mapping[str, Estimate] | None = None,
) -> Finding:
    """One event, by default from the start of the first member to the end of the last one."""
    if ends is None:
        start = min((f.parameters["start"] for f in members), key=lambda e: e.value)
        end = max((f.parameters["end"] for f in members), key=lambda e: e.value)
        ends = {"start": start, "end": end}
    causes = tuple(dict.fromkeys(f.cause for f in members))
    cause = next((cause for cause in _STRETCHES if cause in causes), EVENT)
    return together(members, cause, ends, sizes, {"seen_as": causes} if len(causes) > 1 else {})


# --- Rules --------------------------------------------------------------------------------------------------


class Rule(NamedTuple):
    """Rule by which findings of one kind are one.

    Attributes:
        same: whether two findings are one, in a record of this length [s].
        combine: describes several findings as one.
        is_once: whether only one finding of each axis is meant.
        grows: whether a finding joins if it is the same as any member, not only as the first one.
    """

    same: Callable[[Finding, Finding, float], bool] = lambda one, other, duration: True
    combine: Callable[[Sequence[Finding]], Finding] = together
    is_once: bool = True
    grows: bool = False

    def families(self, findings: Sequence[Finding], duration: float) -> list[list[Finding]]:
        """Findings that are one, together."""

        def rank(k: int) -> float:
            """The strongest finding comes first, but of lines the lowest, which may be the fundamental."""
            tone = None if self.is_once else findings[k].parameters.get("frequency")
            return tone.value if tone else -_weight(findings[k])

        left = sorted(range(len(findings)), key=rank)
        found = []
        while left:
            family = [left.pop(0)]
            for known in family if self.grows else family[:1]:
                for k in left[:]:
                    taken = self.is_once and findings[k].axes in [findings[i].axes for i in family]
                    if not taken and self.same(findings[known], findings[k], duration):
                        family.append(k)
                        left.remove(k)
            found.append([findings[k] for k in sorted(family)])
        return found


def _kind(f: Finding) -> tuple[str, str]:
    """Rule of a finding, and what else findings must have in common to be one: a sensor or a channel."""
    if f.cause in _STRETCHES:
        return "stretch", ""
    is_narrow = f.cause == "resonance" and _value(f, "quality_factor")[0] > _NARROW
    if "frequency" in f.parameters and (f.cause == "sinusoid" or is_narrow):
        return "line", ""
    if f.cause in ("low_pass", OUTLIERS):
        return f.cause, next((e.axis.sensor for e in f.parameters.values()), "")
    return f.cause, str(f.details.get("channel", ""))


def _value(f: Finding, label: str) -> tuple[float, float]:
    """A parameter and its error, 0 if that is unknown; nan if there is no such parameter."""
    e = f.parameters.get(label)
    return (np.nan, 0.0) if e is None else (e.value, float(np.nan_to_num(e.std)))


def _agree(one: Finding, other: Finding, label: str, least: float, most: float = np.inf) -> bool:
    """Whether two parameters agree within their errors; `least` is always allowed, more than `most` never."""
    (a, a_std), (b, b_std) = _value(one, label), _value(other, label)
    return bool(abs(a - b) <= max(min(_DEVIATIONS * float(np.hypot(a_std, b_std)), most), least))


def _similar(one: Finding, other: Finding, label: str, factor: float) -> bool:
    """Whether two positive parameters agree within a factor or within their errors."""
    (a, a_std), (b, b_std) = _value(one, label), _value(other, label)
    error = _DEVIATIONS * np.hypot(a_std / a, b_std / b)
    return bool(a > 0.0 and b > 0.0 and abs(np.log(a / b)) <= max(error, np.log(factor)))


def _width(f: Finding) -> float:
    """Width of a resonance [Hz]; 0 for a line that keeps its phase."""
    return _value(f, "frequency")[0] / _value(f, "quality_factor")[0] if f.cause == "resonance" else 0.0


def _same_line(low: Finding, high: Finding, duration: float) -> bool:
    """Whether two lines are one that is not steady, or the higher one is a harmonic of the lower one."""
    f, tone = (line.parameters["frequency"] for line in (low, high))
    if _agree(low, high, "frequency", max(_STEADY / duration, 0.5 * _width(low), 0.5 * _width(high))):
        return True
    return order_of(tone, f, least=1.0 / duration, most=_BY_CHANCE * f.value) > 0


def _same_resonance(one: Finding, other: Finding, duration: float) -> bool:
    """Whether two resonances overlap for the most part and are about equally wide."""
    widths = sorted(_width(f) for f in (one, other))
    is_near = _agree(one, other, "frequency", 0.5 * widths[0], widths[1])
    return is_near and _similar(one, other, "quality_factor", _DAMPING)


def _overlap(one: Finding, other: Finding) -> float:
    """Common length of two stretches, as a share of the longer one."""
    (a, b), (c, d) = one.span, other.span
    return (min(b, d) - max(a, c)) / max(b - a, d - c, 1e-300)


def _same_stretch(one: Finding, other: Finding, duration: float) -> bool:
    """Whether two stretches last as long, or overlap on one axis: one is then the rest of the event."""
    return _overlap(one, other) > (_NESTED if set(one.axes) & set(other.axes) else _SAME)


def _line(members: Sequence[Finding]) -> Finding:
    """One line with its harmonics, and its amplitude in each axis at the lowest frequency found there."""
    cause, tones = max(members, key=_weight).cause, [f.parameters["frequency"] for f in members]
    lowest = min(tone.value for tone in tones)
    orders = [max(round(tone.value / lowest), 1) for tone in tones]
    frequency = _mean([tone.times(1.0 / order) for tone, order in zip(tones, orders, strict=True)])
    sizes: dict[str, Estimate] = {}
    for order, f in sorted(zip(orders, members, strict=True), key=lambda pair: (-pair[0], _weight(pair[1]))):
        # The amplitude of a resonance is a standard deviation.
        remarks = [f"harmonic {order}"] * (order > 1) + [f"as {f.cause}"] * (f.cause != cause)
        sizes |= {axis: dataclasses.replace(e, remark=", ".join(remarks)) for axis, e in f.amplitudes.items()}
    heard = [tone.value / lowest for tone in tones]
    for f, own in zip(members, tuple(heard), strict=True):
        heard += [own * float(k) for k in values_of(f.details.get("harmonics", ()))[0]]
        heard += [float(x) / lowest for x in values_of(f.details.get("further_frequencies", ()))[0]]
    multiples = sorted({round(k) for k in heard if abs(k - round(k)) < _BY_CHANCE * k and round(k) > 1})
    harmonics = tuple(parameter_estimate(tones[0].axis, "harmonic", k, 0.0, "1") for k in multiples)
    return together(
        members,
        cause,
        ({"frequency": frequency} if frequency else {}) | _means(members, ["quality_factor"]),
        sizes,
        {"harmonics": harmonics} if harmonics else {},
    )


def _stretch(members: Sequence[Finding]) -> Finding:
    """One stretch, with the times of the strongest finding, and the changes from the first to the last."""
    first, sizes = max(members, key=_weight), _largest(members)
    for axis, size in sizes.items():
        each = [f.amplitudes[axis] for f in members if axis in f.amplitudes]
        if size.unit == "1" and len(each) > 1:
            # Ratios that were found in turn.
            ratio = float(np.prod([e.value for e in each]))
            std = ratio * float(np.linalg.norm([e.std / e.value for e in each]))
            sizes[axis] = _changed(size, ratio, std, max(map(side_of_limit, each), key=bool))
    alike = [f for f in members if _overlap(first, f) > _ALIKE]
    whole = _event(members, _means(alike, ["start", "end"]), sizes)
    changes = [c for f in whole.members if f.axes == whole.strongest.axes for c in f.coefficients]
    before, after = {c.label: c for c in reversed(changes)}, {c.label: c.after for c in changes}
    whole_change = tuple(dataclasses.replace(before[label], after=value) for label, value in after.items())
    return dataclasses.replace(whole, coefficients=whole_change)


#: Rules for findings that are reported once for several axes.
RULES: Mapping[str, Rule] = {
    "line": Rule(_same_line, _line, is_once=False),
    "stretch": Rule(_same_stretch, _stretch, is_once=False, grows=True),
    "low_pass": Rule(lambda one, other, _: _similar(one, other, "bandwidth", 1.0 + _FILTER)),
    "resonance": Rule(_same_resonance),
    "bias_step": Rule(lambda one, other, T: _agree(one, other, "time", _AT_ONCE * T, _APART * T)),
    "warm_up": Rule(lambda one, other, _: _similar(one, other, "time_constant", _WARMING)),
    **dict.fromkeys(("temperature", OUTLIERS, "rounding", "saturation", "repeated_samples"), Rule()),
}

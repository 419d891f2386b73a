"""Findings of a recording: those of single axes, with each cause reported once.

Outliers and short stretches that happen together become events; `RULES` tell which other findings are one.
"""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.special import gammainc

from allanjax.critic.finding import (
    UNEXPLAINED,
    Detail,
    Finding,
    Limit,
    Rival,
    numbers_in,
    parameter_estimate,
    side_of_limit,
)
from allanjax.critic.policy import judged
from allanjax.noise.estimate import Estimate

#: Names of the cause of single samples, and of an event of such samples only.
OUTLIERS, EVENT = "outliers", "event"
# Causes that are events if they are short, and names of the events of which they are a part.
_STRETCHES = ("disturbance", "variance_change")
# Parameters that the axes have in common; all others belong to one axis.
_SHARED = (
    *("frequency", "quality_factor", "bandwidth", "order"),
    *("time", "time_constant", "lag", "start", "end"),
)
# Parameters of something unexplained that tell its place and a discrepancy there.
_PLACES = ("where", "measured", "simulated", "start", "end", "lowest", "highest")
# Standard deviations within which values count as the same: frequencies and times, and shapes.
_PLACE, _SHAPE = 4.0, 3.0
_ODDS = judged("search", "rivals")
_SHORT, _PAUSE, _FEW, _CHANCE = (judged("event", name) for name in ("short", "pause", "few", "chance"))
_NESTED, _SAME, _ALIKE = (judged("event", name) for name in ("nested", "same", "alike"))
_NARROW, _STEADY, _ORDERS, _BY_CHANCE = (
    judged("line", name) for name in ("quality", "steady", "orders", "near")
)
_FILTER, _DAMPING, _WARMING = (judged(cause, "same") for cause in ("low_pass", "resonance", "warm_up"))
_AT_ONCE, _APART = judged("bias_step", "at once"), judged("bias_step", "apart")


def merged(
    findings: Sequence[Finding], of_several: Sequence[Finding], duration: float
) -> tuple[Finding, ...]:
    """Findings of a recording of this length [s], the largest change first, unexplained ones last.

    `findings` contains the findings of single axes, axis by axis; `of_several`, the noise that axes share.
    """
    found = [*_families(_with_events(findings, duration), duration), *of_several]
    return tuple(sorted(found, key=lambda f: (f.cause == UNEXPLAINED, -f.impact.size, -_weight(f))))


def _families(findings: Sequence[Finding], duration: float) -> Iterator[Finding]:
    """Findings, with those that are one joined."""
    kinds: dict[tuple[str, str], list[Finding]] = {}
    for f in findings:
        kinds.setdefault(_kind(f, findings), []).append(f)
    for (name, _), alike in kinds.items():
        rule = RULES.get(name, _ALONE)
        # The strongest finding comes first, but of lines the lowest, which may be the fundamental of others.
        rank = [f.parameters["frequency"].value if name == "line" else -_weight(f) for f in alike]
        left = sorted(range(len(alike)), key=rank.__getitem__)
        while left:
            family = [left.pop(0)]
            for known in family if rule.grows else family[:1]:
                for k in [*left]:
                    taken = rule.combine is together and alike[k].axes in [alike[i].axes for i in family]
                    if not taken and rule.same(alike[known], alike[k], duration):
                        family.append(k)
                        left.remove(k)
            members = [alike[k] for k in sorted(family)]
            yield rule.combine(members) if len(members) > 1 else members[0]


def _weight(f: Finding) -> float:
    return f.gain or 0.0


# --- Several findings reported as one -----------------------------------------------------------------------


def together(members: Sequence[Finding]) -> Finding:
    """Several findings joined into one, with the parameters that they have in common.

    The p-value is the smallest one times their number; evidence and gain are sums, as the findings are in
    different axes or were found one after the other. Rivals are those of all of them. Coefficients, drift and
    discrepancies are those of the finding with the largest impact.
    """
    # Of a finding that is split, one part has these.
    counted = [f for f in members if (f.p_value, f.evidence, f.gain) != (None, None, None)] or members
    p, evidence, gain = (
        [x for x in own if x is not None]
        for own in zip(*((f.p_value, f.evidence, f.gain) for f in counted), strict=True)
    )
    odds = [{rival.cause: rival.odds for rival in f.rivals} for f in counted]
    product = {name: float(np.prod([own.get(name, np.inf) for own in odds])) for name in odds[0]}
    start, end = zip(*(f.span for f in members), strict=True)
    axes = tuple(dict.fromkeys(axis for f in members for axis in f.axes))
    # The largest size in each axis; one that is not a ratio describes an event better.
    amplitudes = (size for f in members for size in f.amplitudes.items())
    sizes = dict(sorted(amplitudes, key=lambda size: (size[1].unit != "1", abs(size[1].value))))
    return dataclasses.replace(
        max(counted, key=lambda f: (f.impact.size, _weight(f))),
        cause=members[0].cause,
        axes=axes,
        parameters=_means(members),
        p_value=min(1.0, min(p) * len(counted)) if p else None,
        evidence=sum(evidence) if evidence else None,
        gain=sum(gain) if gain else None,
        rivals=tuple(Rival(name, value) for name, value in product.items() if value < _ODDS),
        span=(min(start), max(end)),
        rest=min((f.rest for f in counted if f.rest), key=lambda rest: rest.p_value, default=None),
        details={name: x for name, x in members[0].details.items() if name == "channel"},
        members=tuple(made for f in members for made in f.members or (f,)),
        per_axis={axis: sizes[axis] for axis in axes if axis in sizes},
        stages=(-1, -1),
    )


def _means(members: Sequence[Finding]) -> dict[str, Estimate]:
    """Means of the parameters that members have in common, and the sum of their counts."""
    each = {name: [f.parameters[name] for f in members if name in f.parameters] for name in _SHARED}
    found = {name: mean for name, own in each.items() if (mean := _mean(own))}
    if counts := [f.parameters["count"] for f in members if "count" in f.parameters]:
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


def _with_events(findings: Sequence[Finding], duration: float) -> list[Finding]:
    """Findings whose parts that happen together are events instead."""
    events: dict[int, list[Finding]] = {}
    left = []
    for f, numbers in zip(findings, _event_numbers(findings, duration), strict=True):
        count = Counter(numbers.tolist() or [-1])
        # Evidence and gain are reported where most of it is.
        home = max(count, key=lambda number: (count[number], number >= 0))
        for number, size in count.items():
            part, is_event = f, number >= 0
            if f.cause == OUTLIERS and (is_event or size < len(numbers)):
                part = _part(f, np.flatnonzero(numbers == number), number == home, is_event)
            if is_event:
                events.setdefault(number, []).append(part)
            elif home < 0 or size > _FEW * len(numbers):
                left.append(part)
    return [*map(_event, events.values()), *left]


def _event_numbers(findings: Sequence[Finding], duration: float) -> list[Int[np.ndarray, " parts"]]:
    """Number of the event of each part of each finding; -1 for none.

    Parts of an event follow each other within a pause, belong to several findings, and are no coincidence.
    """
    parts = [_spans(f, duration) for f in findings]
    owner = np.repeat(np.arange(len(parts)), [len(own) for own in parts])
    is_point = np.array([f.cause == OUTLIERS for f in findings], bool)[owner]
    if len(owner) == 0:
        return [owner] * len(parts)
    spans = np.concatenate(parts)
    order = np.argsort(spans[:, 0], kind="stable")
    start, end = spans[order, 0], np.maximum.accumulate(spans[order, 1])
    breaks = np.flatnonzero(start[1:] - end[:-1] > _PAUSE) + 1
    number = np.empty(len(owner), int)
    number[order] = np.searchsorted(breaks, np.arange(len(owner)), side="right")
    length = end[np.append(breaks, 0) - 1] - start[np.append(0, breaks)] + 2.0 * _PAUSE
    # Rate of other outliers [1/s], from the share of the record's blocks without any: an event, with however
    # many outliers, is in few of these blocks, one of which does not count.
    blocks = max(int(duration / _PAUSE), 2)
    loud = max(len(np.unique(spans[is_point, 0] // _PAUSE)) - 1, 0)
    rate = -float(np.log1p(-min(loud, blocks - 1) / blocks)) / _PAUSE
    points, stretches = (np.bincount(number, weights=some) for some in (is_point, ~is_point))
    # Probability of so many beside a stretch, and number of so many of which each is near the one before.
    beside = gammainc(points, rate * length)
    alone = (1.0 + rate * duration) * (-np.expm1(-rate * _PAUSE)) ** np.maximum(points - 1.0, 0.0)
    kept = ~is_point | (np.where(stretches > 0, beside, alone) < _CHANCE)[number]
    pairs = np.unique(np.stack([number[kept], owner[kept]]), axis=1)
    is_event = np.bincount(pairs[0], minlength=len(points)) > 1
    number = np.where(kept & is_event[number], number, -1)
    return [number[owner == k] for k in range(len(parts))]


def _spans(f: Finding, duration: float) -> Float[np.ndarray, "parts 2"]:
    """Starts and ends of the parts of a finding that may belong to an event: outliers, or a short stretch."""
    if f.cause == OUTLIERS:
        times = numbers_in(f.details, "times")
        return np.transpose([times, times])
    start, end = f.span
    if f.cause == "disturbance" or (f.cause == "variance_change" and end - start <= _SHORT * duration):
        return np.array([[start - _value(f, "start")[1], end + _value(f, "end")[1]]])
    return np.zeros((0, 2))


def _part(f: Finding, places: Int[np.ndarray, " some"], is_home: bool, is_event: bool) -> Finding:
    """Some outliers of a finding, with its evidence if they are its home; those of an event as a stretch."""
    nothing = Finding(f.cause, f.axes, {}, None, None, None, (), f.span, f.domain)
    lists = {name: [e for e in x if isinstance(e, Estimate)] for name, x in f.details.items()}
    details = {name: tuple(own[k] for k in places) for name, own in lists.items() if own}
    times, loudest = details["times"], max(details["sizes"], key=lambda e: abs(e.value))
    count = _changed(f.parameters["count"], len(times), f.parameters["count"].std)
    parameters, sizes = {**f.parameters, "count": count}, f.amplitudes
    if is_event:
        start, end = (dataclasses.replace(times[k], label=name) for k, name in ((0, "start"), (-1, "end")))
        peak = parameter_estimate(loudest.axis, "peak", abs(loudest.value), loudest.std, loudest.unit)
        parameters, sizes = {"start": start, "end": end}, {f.axes[0]: peak}
    return dataclasses.replace(
        f if is_home else nothing,
        parameters=parameters,
        span=(times[0].value, times[-1].value),
        details={**f.details, **details},
        members=(f,),
        per_axis=sizes,
        stages=(-1, -1),
    )


def _event(members: Sequence[Finding]) -> Finding:
    """One event, from the start of the first member to the end of the last one."""
    start = min((f.parameters["start"] for f in members), key=lambda e: e.value)
    end = max((f.parameters["end"] for f in members), key=lambda e: e.value)
    causes = tuple(dict.fromkeys(f.cause for f in members))
    cause = next((cause for cause in _STRETCHES if cause in causes), EVENT)
    seen_as: dict[str, Detail] = {"seen_as": causes} if len(causes) > 1 else {}
    ends = {"start": start, "end": end}
    return dataclasses.replace(together(members), cause=cause, parameters=ends, details=seen_as)


# --- Rules --------------------------------------------------------------------------------------------------


class Rule(NamedTuple):
    """Rule by which findings of one kind are one.

    Attributes:
        same: whether two findings are one, in a record of this length [s].
        combine: describes several findings as one; `together` has one of each axis, others may have more.
        grows: whether a finding joins if it is the same as any member, not only as the first one.
    """

    same: Callable[[Finding, Finding, float], bool] = lambda one, other, duration: True
    combine: Callable[[Sequence[Finding]], Finding] = together
    grows: bool = False


def _kind(f: Finding, findings: Sequence[Finding]) -> tuple[str, str]:
    """Rule of a finding, and what else findings must have in common to be one: a sensor or a channel."""
    if f.cause in _STRETCHES:
        return "stretch", ""
    if f.cause == "resonance" and "quality_factor" in f.parameters:
        # How narrow resonances at one place are is known best from the strongest of them.
        there = [g for g in findings if g.cause == f.cause and _agree(f, g, "frequency", 0.5 * _width(f))]
        is_line = _value(max(there, key=_weight), "quality_factor")[0] > _NARROW
    else:
        is_line = f.cause == "sinusoid" and "frequency" in f.parameters
    if is_line:
        return "line", ""
    if f.cause == UNEXPLAINED:
        sensors = {e.axis.sensor for e in f.parameters.values()}
        return f.cause, str((f.details["domain"], f.details.get("resembles"), *sensors))
    if f.cause in ("low_pass", OUTLIERS):
        return f.cause, next((e.axis.sensor for e in f.parameters.values()), "")
    return f.cause, str(f.details.get("channel", ""))


def _value(f: Finding, label: str) -> tuple[float, float]:
    """A parameter and its error, 0 if that is unknown; nan if there is no such parameter."""
    e = f.parameters.get(label)
    return (np.nan, 0.0) if e is None else (e.value, e.std if np.isfinite(e.std) else 0.0)


def _agree(
    one: Finding, other: Finding, label: str, least: float, most: float = np.inf, deviations: float = _PLACE
) -> bool:
    """Whether two parameters agree within their errors; `least` is always allowed, more than `most` never."""
    (a, a_std), (b, b_std) = _value(one, label), _value(other, label)
    return bool(abs(a - b) <= max(min(deviations * float(np.hypot(a_std, b_std)), most), least))


def _similar(one: Finding, other: Finding, label: str, factor: float) -> bool:
    """Whether two positive parameters agree within a factor or within their errors."""
    (a, a_std), (b, b_std) = _value(one, label), _value(other, label)
    if not (a > 0.0 and b > 0.0):
        return False
    return bool(abs(np.log(a / b)) <= max(_SHAPE * np.hypot(a_std / a, b_std / b), np.log(factor)))


def _width(f: Finding) -> float:
    """Width of a resonance [Hz]; 0 for a line that keeps its phase."""
    return _value(f, "frequency")[0] / _value(f, "quality_factor")[0] if f.cause == "resonance" else 0.0


def order_of(high: Estimate, low: Estimate, least: float = 0.0, most: float = np.inf) -> int:
    """Order of a line as a harmonic of a lower one, from their frequencies; 0 if it is none.

    They agree within their errors or `least` [Hz]; with an error above `most` [Hz] that may be chance.
    """
    order = round(high.value / low.value)
    reach = max(_PLACE * float(np.hypot(high.std, order * low.std)), least)
    is_multiple = abs(high.value - order * low.value) <= reach < most
    return order if is_multiple and 2 <= order <= _ORDERS else 0


def _same_line(low: Finding, high: Finding, duration: float) -> bool:
    """Whether two lines are one that is not steady, or the higher one is a harmonic of the lower one."""
    f, tone = (line.parameters["frequency"] for line in (low, high))
    if _agree(low, high, "frequency", max(_STEADY / duration, 0.5 * _width(low), 0.5 * _width(high))):
        return True
    return order_of(tone, f, least=1.0 / duration, most=_BY_CHANCE * f.value) > 0


def _same_resonance(one: Finding, other: Finding, duration: float) -> bool:
    """Whether two resonances overlap for the most part and are about equally wide."""
    widths = sorted(_width(f) for f in (one, other))
    is_near = _agree(one, other, "frequency", 0.5 * widths[0], widths[1], _SHAPE)
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
    heard = [tone.value for tone in tones]
    for f, tone in zip(members, tones, strict=True):
        heard += [tone.value * k for k in numbers_in(f.details, "harmonics")]
        heard += numbers_in(f.details, "further_frequencies")
    ratios = [x / lowest for x in heard]
    multiples = sorted({round(k) for k in ratios if abs(k - round(k)) < _BY_CHANCE * k and round(k) > 1})
    harmonics = tuple(parameter_estimate(tones[0].axis, "harmonic", k, 0.0, "1") for k in multiples)
    whole = together(members)
    return dataclasses.replace(
        whole,
        cause=cause,
        parameters={**whole.parameters, **({"frequency": frequency} if frequency else {})},
        per_axis={axis: sizes[axis] for axis in whole.axes if axis in sizes},
        details={"harmonics": harmonics} if harmonics else {},
    )


def _stretch(members: Sequence[Finding]) -> Finding:
    """One event, with the times of the strongest finding, and the changes from the first to the last."""
    whole, first = _event(members), max(members, key=_weight)
    sizes = dict(whole.per_axis)
    for axis, size in whole.per_axis.items():
        each = [f.amplitudes[axis] for f in members if axis in f.amplitudes]
        if size.unit == "1" and len(each) > 1:
            # Ratios that were found in turn.
            ratio = float(np.prod([e.value for e in each]))
            std = ratio * float(np.linalg.norm([e.std / e.value for e in each]))
            sizes[axis] = _changed(size, ratio, std, max(map(side_of_limit, each), key=bool))
    changes = [c for f in whole.members if f.axes == whole.strongest.axes for c in f.coefficients]
    before, after = {c.label: c for c in reversed(changes)}, {c.label: c.after for c in changes}
    return dataclasses.replace(
        whole,
        parameters=_means([f for f in members if _overlap(first, f) > _ALIKE]),
        per_axis=sizes,
        coefficients=tuple(dataclasses.replace(before[label], after=x) for label, x in after.items()),
    )


def _unexplained(members: Sequence[Finding]) -> Finding:
    """What is unexplained at one place on several axes, described as on the most affected one."""
    whole = together(members)
    own = whole.strongest
    places = {name: e for name, e in own.parameters.items() if name in _PLACES}
    return dataclasses.replace(
        whole, parameters=places, discrepancies=own.discrepancies, details=own.details, span=own.span
    )


#: Rules for findings that are reported once for several axes.
RULES: Mapping[str, Rule] = {
    "line": Rule(_same_line, _line),
    "stretch": Rule(_same_stretch, _stretch, grows=True),
    "low_pass": Rule(lambda one, other, _: _similar(one, other, "bandwidth", 1.0 + _FILTER)),
    "resonance": Rule(_same_resonance),
    UNEXPLAINED: Rule(lambda one, other, _: _overlap(one, other) > _SAME, _unexplained),
    "bias_step": Rule(lambda one, other, T: _agree(one, other, "time", _AT_ONCE * T, _APART * T)),
    "warm_up": Rule(lambda one, other, _: _similar(one, other, "time_constant", _WARMING)),
    **dict.fromkeys(("temperature", OUTLIERS, "rounding", "saturation", "repeated_samples"), Rule()),
}
_ALONE = Rule(lambda one, other, duration: False)

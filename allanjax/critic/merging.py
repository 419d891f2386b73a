"""Findings of a recording: those of single axes, of which each cause is told once.

A rule says of one kind of cause which findings are one, and what is told of them. A cause without a rule is
not merged.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import NamedTuple, TypeAlias

import numpy as np

from allanjax.critic.events import OUTLIERS, STRETCHES, events
from allanjax.critic.finding import CoefficientChange, Finding
from allanjax.critic.parameters import Detail, parameter_estimate, side_of_limit, values_of
from allanjax.critic.together import largest, mean_of, shared, summed, together
from allanjax.noise.estimate import Estimate

#: What is left over, which has no cause.
UNEXPLAINED = "unexplained"
# Standard deviations within which values are the same: of a line, a place in time, a shape.
_LINE, _TIME, _SHAPE = 4.0, 4.0, 3.0
# Resolved frequencies [1/duration] within which two lines are one that is not quite steady: a judgement.
_STEADY = 3.0
# Quality factor from which on a resonance is a line; highest order of a harmonic, and the largest share of
# the fundamental within which it is looked for, so that chance makes few: judgements.
_NARROW, _ORDERS, _BY_CHANCE = 50.0, 20, 0.02
# Relative difference of bandwidths that is none, since nominally equal filters differ by their parts: a
# judgement.
_BANDWIDTH = 0.1
# Factors of a warm-up's time constant, and of a resonance's quality factor, since a structure is damped
# differently along each axis, within which they are the same: judgements.
_FACTOR, _DAMPING = 2.0, 4.0
# Shares of the record within which steps, and the ends of loud stretches, are simultaneous, and beyond which
# nothing is, however large its error: judgements.
_STEP_TIME, _STRETCH_TIME, _APART = 1e-3, 1e-2, 2e-2
# Overlaps, as shares of the longer one, from which on stretches are one event: those of one axis, of different
# axes, and those whose ends are those of the event: judgements.
_NESTED, _SAME, _ALIKE = 0.2, 0.7, 0.9

#: Whether a finding is one with the strongest of a kind, in a record of this length [s].
Same: TypeAlias = Callable[[Finding, Finding, float], bool]


class Rule(NamedTuple):
    """Rule for one kind of cause.

    Attributes:
        applies: whether a finding is of this kind.
        family: findings of this kind that are one with the strongest one, itself among them.
        told: one finding of several.
    """

    applies: Callable[[Finding], bool]
    family: Callable[[Finding, Sequence[Finding], float], list[Finding]]
    told: Callable[[Sequence[Finding]], Finding]


def merged(
    findings: Sequence[Finding], of_several: Sequence[Finding], duration: float
) -> tuple[Finding, ...]:
    """Findings of a recording of this length [s], what changes most first, what is unexplained last.

    `findings` are those of the single axes, axis by axis; `of_several` those that several axes share.
    """
    happened, left = events(findings, duration)
    found, left = [], [*happened, *left]
    for rule in RULES:
        kind = [f for f in left if rule.applies(f)]
        left = [f for f in left if not rule.applies(f)]
        while kind:
            family = rule.family(max(kind, key=_weight), kind, duration)
            kind = [f for f in kind if not _among(f, family)]
            found.append(rule.told(family) if len(family) > 1 else family[0])
    return tuple(sorted([*found, *left, *of_several], key=_place))


def _place(f: Finding) -> tuple[bool, float, float]:
    """What findings are sorted by."""
    return f.cause == UNEXPLAINED, -f.effect.size, -_weight(f)


def _weight(f: Finding) -> float:
    return f.gain or 0.0


def _among(f: Finding, family: Sequence[Finding]) -> bool:
    """Whether it is one of these, and not only equal to one of them."""
    return any(f is other for other in family)


# --- Values that are the same -------------------------------------------------------------------------------


def _value(f: Finding, label: str) -> tuple[float, float]:
    """A parameter and its error, 0 where that is not known; nan if there is no such parameter."""
    e = f.parameters.get(label)
    if e is None:
        return float("nan"), 0.0
    return e.value, e.std if np.isfinite(e.std) else 0.0


def _near(one: Finding, other: Finding, label: str, deviations: float, least: float, most: float) -> bool:
    """Whether two parameters differ by no more than their errors; by `least` they may, by `most` not."""
    (a, a_std), (b, b_std) = _value(one, label), _value(other, label)
    return bool(abs(a - b) <= max(min(deviations * np.hypot(a_std, b_std), most), least))


def _similar(one: Finding, other: Finding, label: str, factor: float) -> bool:
    """Whether two positive parameters differ by less than a factor, or no more than their errors."""
    (a, a_std), (b, b_std) = _value(one, label), _value(other, label)
    if not (a > 0.0 and b > 0.0):
        return False
    return bool(abs(np.log(a / b)) <= max(_SHAPE * np.hypot(a_std / a, b_std / b), np.log(factor)))


def _sensor(f: Finding) -> str:
    """Sensor of a finding's axis, as far as its parameters say."""
    return next((e.axis.sensor for e in f.parameters.values()), "")


def _same_sensor(one: Finding, other: Finding, duration: float) -> bool:
    return _sensor(one) == _sensor(other)


def _always(one: Finding, other: Finding, duration: float) -> bool:
    return True


def _same_bandwidth(one: Finding, other: Finding, duration: float) -> bool:
    return _sensor(one) == _sensor(other) and _similar(one, other, "bandwidth", 1.0 + _BANDWIDTH)


def _same_resonance(one: Finding, other: Finding, duration: float) -> bool:
    """Whether most of a resonance lies where another one lies, which is about as wide."""
    widths = sorted(_width(f) for f in (one, other))
    return _near(one, other, "frequency", _SHAPE, 0.5 * widths[0], widths[1]) and _similar(
        one, other, "quality_factor", _DAMPING
    )


def _same_step(one: Finding, other: Finding, duration: float) -> bool:
    return _near(one, other, "time", _TIME, _STEP_TIME * duration, _APART * duration)


def _same_stretch(one: Finding, other: Finding, duration: float) -> bool:
    least, most = _STRETCH_TIME * duration, _APART * duration
    return all(_near(one, other, label, _TIME, least, most) for label in ("start", "end"))


def _overlap(one: Finding, other: Finding) -> float:
    """Length that two stretches have in common, as a share of the longer one."""
    (a, b), (c, d) = one.span, other.span
    return (min(b, d) - max(a, c)) / max(b - a, d - c, 1e-300)


def _same_warm_up(one: Finding, other: Finding, duration: float) -> bool:
    return _similar(one, other, "time_constant", _FACTOR)


def _same_channel(one: Finding, other: Finding, duration: float) -> bool:
    return one.details.get("channel") == other.details.get("channel")


# --- Rules --------------------------------------------------------------------------------------------------


def _rule(
    causes: Sequence[str],
    same: Same,
    parameters: Sequence[str] = (),
    totals: Sequence[str] = (),
    is_once: bool = True,
) -> Rule:
    """Rule for causes that are one where `same` says so; `is_once`: if there is one of them in an axis.

    The `parameters` are those that the axes share, of the `totals` the sum is told.
    """

    def family(first: Finding, findings: Sequence[Finding], duration: float) -> list[Finding]:
        found = {first.axes: first} if is_once else {}
        others = sorted((f for f in findings if f is not first), key=_weight, reverse=True)
        alike = [f for f in others if f.cause == first.cause and same(first, f, duration)]
        if not is_once:
            chosen = [first, *alike]
        else:
            for f in alike:
                found.setdefault(f.axes, f)
            chosen = list(found.values())
        return [f for f in findings if _among(f, chosen)]

    def told(members: Sequence[Finding]) -> Finding:
        words = {
            name: detail
            for name, detail in members[0].details.items()
            if isinstance(detail, str) and all(f.details.get(name) == detail for f in members)
        }
        own = shared(members, parameters) | summed(members, totals)
        return together(members[0].cause, members, own, largest(members), words)

    return Rule(lambda f: f.cause in causes, family, told)


def _stretches(first: Finding, findings: Sequence[Finding], duration: float) -> list[Finding]:
    """Stretches that are one event with the strongest one: they last as long, or overlap on one axis.

    What is found again within a stretch of the same axis is what a first finding has left of the event.
    """
    family, left = [first], [f for f in findings if f is not first]
    for known in family:
        again = [
            f
            for f in left
            if _same_stretch(known, f, duration)
            or _overlap(known, f) > (_NESTED if set(known.axes) & set(f.axes) else _SAME)
        ]
        family += again
        left = [f for f in left if not _among(f, again)]
    return [f for f in findings if _among(f, family)]


def _stretch(members: Sequence[Finding]) -> Finding:
    """One stretch, with the times of the strongest finding, and the changes from the first to the last."""
    first = max(members, key=_weight)
    alike = [f for f in members if _overlap(first, f) > _ALIKE]
    causes = {cause: None for cause in STRETCHES if any(f.cause == cause for f in members)}
    seen: dict[str, Detail] = {"seen_as": tuple(causes)} if len(causes) > 1 else {}
    whole = together(next(iter(causes)), members, shared(alike, ["start", "end"]), _loudness(members), seen)
    before: dict[str, CoefficientChange] = {}
    after: dict[str, float] = {}
    for change in (c for f in whole.members if f.axes == whole.strongest.axes for c in f.coefficients):
        before.setdefault(change.label, change)
        after[change.label] = change.after
    changes = tuple(dataclasses.replace(c, after=after[label]) for label, c in before.items())
    return dataclasses.replace(whole, coefficients=changes)


def _loudness(members: Sequence[Finding]) -> dict[str, Estimate]:
    """How large an event is in each axis: its peak, or the product of the ratios that were found in turn."""
    found: dict[str, Estimate] = {}
    for axis, size in ((axis, size) for f in members for axis, size in f.amplitudes.items()):
        known = found.get(axis, size)
        if known is size or (known.unit == "1") > (size.unit == "1"):
            found[axis] = size
        elif known.unit == size.unit == "1":
            value = known.value * size.value
            std = value * float(np.hypot(known.std / known.value, size.std / size.value))
            limit = side_of_limit(known) or side_of_limit(size)
            found[axis] = parameter_estimate(size.axis, size.label, value, std, "1", limit)
        elif abs(size.value) > abs(known.value) and size.unit != "1":
            found[axis] = size
    return found


def _is_line(f: Finding) -> bool:
    """Whether a finding is a line: one that keeps its phase, or a resonance that is narrow."""
    return "frequency" in f.parameters and (
        f.cause == "sinusoid" or (f.cause == "resonance" and _value(f, "quality_factor")[0] > _NARROW)
    )


def _order(low: Finding, high: Finding, duration: float) -> int:
    """Order of the harmonic of a line that another one is, 1 if they are the same; 0 if it is none."""
    (f, std), (other, other_std) = (_value(one, "frequency") for one in (low, high))
    order = int(np.rint(other / f))
    reach = max(_LINE * float(np.hypot(other_std, order * std)), 1.0 / duration)
    if abs(other - f) <= max(reach, _STEADY / duration, *(0.5 * _width(one) for one in (low, high))):
        return 1
    if not 2 <= order <= _ORDERS or abs(other - order * f) > reach:
        return 0
    return order if reach < _BY_CHANCE * f else 0


def _width(f: Finding) -> float:
    """Width of a resonance [Hz], none of a line that keeps its phase."""
    return _value(f, "frequency")[0] / _value(f, "quality_factor")[0] if f.cause == "resonance" else 0.0


def _lines(first: Finding, findings: Sequence[Finding], duration: float) -> list[Finding]:
    """Lines with the frequency of the strongest one, of its fundamental, or of harmonics of that."""

    def frequency(f: Finding) -> float:
        return f.parameters["frequency"].value

    below = [
        f
        for f in findings
        if f is not first and frequency(f) <= frequency(first) and _order(f, first, duration)
    ]
    lowest = min([first, *below], key=frequency)
    return [f for f in findings if f is first or f is lowest or _order(lowest, f, duration)]


def _line(members: Sequence[Finding]) -> Finding:
    """One line with its harmonics, and its amplitude in each axis, at the lowest frequency seen there."""
    lowest = min(f.parameters["frequency"].value for f in members)
    orders = [max(round(f.parameters["frequency"].value / lowest), 1) for f in members]
    fundamental = [
        _divided(f.parameters["frequency"], order) for f, order in zip(members, orders, strict=True)
    ]
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
        {
            axis: per_axis[axis]
            for axis in dict.fromkeys(a for f in members for a in f.axes)
            if axis in per_axis
        },
        {"harmonics": tuple(parameter_estimate(whose, "harmonic", k, 0.0, "1") for k in every)}
        if every
        else {},
    )


def _harmonics(f: Finding, fundamental: float) -> set[int]:
    """Orders of the harmonics of a line that a finding has, its own among them."""
    own = f.parameters["frequency"].value / fundamental
    each = [own, *(own * float(k) for k in values_of(f.details.get("harmonics", ()))[0])]
    each += [float(x) / fundamental for x in values_of(f.details.get("further_frequencies", ()))[0]]
    return {round(k) for k in each if abs(k - round(k)) < _BY_CHANCE * k and round(k) > 1}


def _divided(e: Estimate, order: int) -> Estimate:
    """Frequency of the fundamental by that of a harmonic."""
    if order == 1:
        return e
    return parameter_estimate(e.axis, e.label, e.value / order, e.std / order, e.unit)


#: Rules of all causes that are told once for several axes.
RULES: tuple[Rule, ...] = (
    Rule(_is_line, _lines, _line),
    _rule(["low_pass"], _same_bandwidth, ["bandwidth", "order"]),
    _rule(["resonance"], _same_resonance, ["frequency", "quality_factor"]),
    _rule(["bias_step"], _same_step, ["time"]),
    _rule(["warm_up"], _same_warm_up, ["time_constant"]),
    _rule(["temperature"], _same_channel, ["lag"]),
    Rule(lambda f: f.cause in STRETCHES, _stretches, _stretch),
    _rule([OUTLIERS], _same_sensor, totals=["count"], is_once=False),
    _rule(["rounding", "saturation", "repeated_samples"], _always),
)

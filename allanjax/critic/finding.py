"""Findings: detected causes, their parameters and effects, and the discrepancies that they explain.

Outliers and short stretches that happen together become events; `RULES` tell which other findings are one.
"""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Literal, NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Float, Int
from scipy.special import gammainc

from allanjax.base.equality import ByValue
from allanjax.base.late import presented
from allanjax.base.normal import ONE_SIDED_95, TWO_SIDED_95
from allanjax.critic.policy import judged
from allanjax.noise.estimate import Estimate, title_of
from allanjax.record.recording import Axis
from allanjax.record.units import Sensor

# Distance of a maximum from a bound, absolute and in standard deviations, below which it is at the bound.
_AT_BOUND, _NEAR_BOUND = 2e-2, 1.0
#: Side of its 95 % limit on which a parameter lies; "" if it has an estimate.
Limit: TypeAlias = Literal["", "above", "below"]
#: Detail of a finding besides its parameters: a word, several words, or a list of numbers.
Detail: TypeAlias = str | tuple[str, ...] | tuple[Estimate, ...]


def parameter_estimate(
    axis: Axis,
    label: str,
    value: float,
    std: float,
    unit: str,
    limit: Limit = "",
    log_normal: bool = False,
) -> Estimate:
    """Parameter of a finding, with intervals from a normal law of the value or of its logarithm.

    If the search ended at a bound of its range, or the effect may continue beyond the record, the value is a
    95 % `limit`: the parameter lies "above" or "below" it and has no standard deviation.
    """
    value, std = float(value), float("nan") if limit else float(std)

    def interval(deviations: float) -> tuple[float, float]:
        if log_normal:
            factor = float(np.exp(deviations * std / value))
            return value / factor, value * factor
        return value - deviations * std, value + deviations * std

    return Estimate(
        axis=axis,
        label=label,
        value=value,
        std=std,
        interval=interval(TWO_SIDED_95),
        interval_68=interval(1.0),
        unit=unit,
        usual_unit=unit,
        source="critique",
        upper_limit=value if limit == "below" else None,
        lower_limit=value if limit == "above" else None,
    )


def limited(
    u: float, std: float, bounds: Sequence[float] | Float[np.ndarray, " 2"]
) -> tuple[float, float, Limit]:
    """Estimate and its standard deviation, or a 95 % limit where it is at a bound."""
    if u > bounds[1] - max(_AT_BOUND, _NEAR_BOUND * std):
        return min(u, bounds[1]) - ONE_SIDED_95 * std, float("nan"), "above"
    if u < bounds[0] + max(_AT_BOUND, _NEAR_BOUND * std):
        return max(u, bounds[0]) + ONE_SIDED_95 * std, float("nan"), "below"
    return u, std, ""


def side_of_limit(e: Estimate) -> Limit:
    """Side of its 95 % limit on which a finding's parameter lies; "" if it has an estimate."""
    if e.lower_limit is not None:
        return "above"
    return "" if e.upper_limit is None else "below"


def values_of(detail: Detail) -> tuple[tuple[float, ...] | tuple[str, ...], float, str]:
    """Words or values of a detail, the standard deviation of the first value, and their unit."""
    words = (detail,) if isinstance(detail, str) else tuple(x for x in detail if isinstance(x, str))
    numbers = [x for x in detail if isinstance(x, Estimate)]
    return (tuple(x.value for x in numbers), numbers[0].std, numbers[0].unit) if numbers else (words, 0.0, "")


def written(x: Estimate | Detail) -> tuple[float | tuple[float, ...] | tuple[str, ...], float, str, Limit]:
    """Value, standard deviation and unit of a parameter or a detail, and the side of a limit."""
    return (x.value, x.std, x.unit, side_of_limit(x)) if isinstance(x, Estimate) else (*values_of(x), "")


def numbers_in(details: Mapping[str, Detail], name: str) -> list[float]:
    """Values of a list among details; none if there is no such list."""
    return [x.value for x in details.get(name, ()) if isinstance(x, Estimate)]


#: Cause of a discrepancy that no known effect explains.
UNEXPLAINED = "unexplained"
#: Share of the Allan variance from which a finding matters, and gain [nats] from which it has its own row.
NOTABLE, TELLING = judged("telling", "share"), judged("telling", "nats")
# Parameters that may be the size of an effect in an axis; the first one of a finding counts.
_SIZES = (
    *("amplitude", "coefficient", "peak", "scale", "step", "ratio", "bandwidth"),
    *("upper_level", "lower_level", "fraction"),
)

# Usual names of causes, if they differ from their identifiers.
_TITLES = {
    "common_mode": "shared noise",
    "event": "outlier event",
    "level": "varying level",
    "low_pass": "low-pass filter",
    "markov": "Gauss-Markov process",
    "power_law": "power-law noise",
    "sinusoid": "spectral line",
    "spectral_shape": "filters and resonances",
    "telegraph": "telegraph noise",
    "temperature": "temperature effect",
    "warm_up": "warm-up",
}


@dataclasses.dataclass(frozen=True, eq=False)
class Discrepancy(ByValue):
    """Comparison of the measurement with its simulations in one statistic.

    Attributes:
        statistic: name of the statistic, e.g. "allan_deviation".
        where: place of the largest difference, e.g. 0.7.
        where_unit: unit of the place, "s" or "Hz"; "" if the statistic has no place.
        measured, simulated: the statistic at that place, in `unit`; the simulated one is the median.
        unit: unit of these two.
        p_value: probability under the model of a difference as large, at any place.
        channel: the other axis or channel of a correlation.
    """

    statistic: str
    where: float
    where_unit: str
    measured: float
    simulated: float
    unit: str
    p_value: float
    channel: str = ""

    @property
    def size(self) -> float:
        """Relative error of the simulation, simulated/measured − 1; nan if the measured value is zero."""
        return self.simulated / self.measured - 1.0 if self.measured else float("nan")


class Rival(NamedTuple):
    """Name of another cause that explains the data nearly as well, and the odds against it."""

    cause: str
    odds: float


@dataclasses.dataclass(frozen=True, eq=False)
class Change(ByValue):
    """What a finding alone changes: the noise with it and without it, the rest of the model held.

    A share is |with − without| over the larger of the two; it is negative if the finding lowers the noise, as
    a filter does. The measured noise without a finding has chance in common with that with it.

    Attributes:
        share, time: largest share of the Allan variance, and its cluster time [s].
        first, last: cluster times between which the share is notable (`NOTABLE`) [s]; nan if it is nowhere.
        density, frequency: largest share of the PSD in a sixth of an octave, and where [Hz].
    """

    share: float
    time: float
    first: float
    last: float
    density: float
    frequency: float

    @property
    def size(self) -> float:
        """Magnitude of the share of the Allan variance."""
        return abs(self.share)


@dataclasses.dataclass(frozen=True, eq=False)
class Finding(ByValue):
    """A detected cause, and the gain from including it in the model.

    A finding in several axes has `members`. Its change is then that of the most affected axis, `shown`.

    Attributes:
        cause: name of the cause, see `causes`; "event" for outliers of several axes at one time.
        axes: names of the affected axes.
        parameters: estimates by label, in the recording's own units, times from its start [s].
        p_value: p-value of its statistic, corrected for the search; None if its odds are the test.
        evidence: log Bayes factor for it, including trials and Occam factors [nats]; None for effects that
            are visible directly in the samples, such as rounding.
        gain: gain in log-likelihood on data used neither to find nor to fit it [nats]; None if it cannot be
            tested on held-out data, or is included in that of another finding.
        rivals: other causes against which its odds are below 1000.
        span, domain: start and end, in s ("time") or Hz ("frequency").
        is_event: whether it happened in this record; other findings are what the sensor is.
        change: what it alone changes; None for shared noise, and for what is unexplained and not described.
        rest: discrepancy that is significant at its own place after all findings, which it explains in part;
            of something unexplained the discrepancy that it is about.
        details: words and lists of numbers by name: a channel, the times of outliers, harmonics.
        members: the findings of single axes that it combines.
        per_axis: its size in each axis, if it has members; see `amplitudes`.
        stage: number of the stage without it in `stages` of its axis; −1 if there is none.
    """

    cause: str
    axes: tuple[str, ...]
    parameters: Mapping[str, Estimate]
    p_value: float | None
    evidence: float | None
    gain: float | None
    rivals: tuple[Rival, ...]
    span: tuple[float, float]
    domain: str
    is_event: bool = False
    change: Change | None = None
    rest: Discrepancy | None = None
    details: Mapping[str, Detail] = dataclasses.field(default_factory=dict)
    members: tuple[Finding, ...] = ()
    per_axis: Mapping[str, Estimate] = dataclasses.field(default_factory=dict)
    stage: int = -1

    @property
    def size(self) -> Estimate | None:
        """The parameter that is the size of the effect in its axis: an amplitude, a step or a ratio."""
        return next((self.parameters[label] for label in _SIZES if label in self.parameters), None)

    def named(self, cause: str) -> str:
        """Usual name of its own or a rival's cause, e.g. "spectral line" for "sinusoid"."""
        sensors = {e.axis.sensor for e in self.parameters.values()}
        return cause_title(cause, "accel" if sensors == {"accel"} else "gyro")

    @property
    def amplitudes(self) -> dict[str, Estimate]:
        """Size of the effect in each axis, see `size`; empty for shared noise."""
        if self.members:
            return dict(self.per_axis)
        return {self.axes[0]: self.size} if len(self.axes) == 1 and self.size is not None else {}

    @property
    def odds(self) -> float | None:
        """Odds for the finding, e^evidence; None if it has no evidence."""
        return None if self.evidence is None else float(np.exp(min(self.evidence, 700.0)))

    @property
    def shown(self) -> str:
        """Name of the most affected axis."""
        return self.strongest.axes[0]

    @property
    def strongest(self) -> Finding:
        """The member with the largest effect, or the finding itself."""
        return max(self.members, key=_effect, default=self)

    @property
    def is_weak(self) -> bool:
        """Whether it changes the Allan variance nowhere by a notable share, and gains little."""
        tells_little = self.gain is not None and self.gain < TELLING
        return tells_little and self.change is not None and self.change.size < NOTABLE

    @presented
    def __str__(self) -> str:
        raise NotImplementedError

    @presented
    def __repr__(self) -> str:
        raise NotImplementedError


def cause_title(cause: str, sensor: Sensor) -> str:
    """Usual name of a cause or a coefficient, e.g. "spectral line" for "sinusoid"."""
    return _TITLES.get(cause) or title_of(cause, sensor)


def _effect(f: Finding) -> tuple[float, float]:
    """Share of the Allan variance and gain of a finding, by which findings are ranked."""
    return 0.0 if f.change is None else f.change.size, f.gain or 0.0


# --- Findings of a recording, each cause once ---------------------------------------------------------------

#: Names of the cause of single samples, of an event of such samples only, and of noise whose level varies.
OUTLIERS, EVENT, LEVEL = "outliers", "event", "level"
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
_SMALL = judged("level", "small")
_FILTER, _DAMPING, _WARMING = (judged(cause, "same") for cause in ("low_pass", "resonance", "warm_up"))
_AT_ONCE, _APART = judged("bias_step", "at once"), judged("bias_step", "apart")


def merged(
    findings: Sequence[Finding], of_several: Sequence[Finding], duration: float
) -> tuple[Finding, ...]:
    """Findings of a record of this length [s] from those of single and of several axes.

    What the sensor is comes first, then what happened, each by the change that it makes, and at last what is
    unexplained.
    """
    found = [*_families(_with_events(findings, duration), duration), *of_several]
    found.sort(key=_effect, reverse=True)
    return tuple(sorted(found, key=lambda f: (f.cause == UNEXPLAINED, f.is_event)))


def _families(findings: Sequence[Finding], duration: float) -> Iterator[Finding]:
    """Findings, with those that are one joined."""
    kinds: dict[tuple[str, str], list[Finding]] = {}
    for f in findings:
        kinds.setdefault(_kind(f, findings, duration), []).append(f)
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
    different axes or were found one after the other. Rivals are those of all of them. The change is that of
    the finding with the largest one.
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
        max(counted, key=_effect),
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
        stage=-1,
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
    """Mean, with the larger of error and scatter; None if values are exact and differ, or units differ."""
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
        stage=-1,
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


def _kind(f: Finding, findings: Sequence[Finding], duration: float) -> tuple[str, str]:
    """Rule of a finding, and what else findings must have in common to be one: a sensor or a channel."""
    ratio = _ratio(f)
    if ratio is not None and abs(np.log(ratio.value)) < _SMALL and np.ptp(f.span) > _SHORT * duration:
        return LEVEL, ""
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
    """One event, with the times of the strongest finding."""
    whole, first = _event(members), max(members, key=_weight)
    sizes = dict(whole.per_axis)
    for axis, size in whole.per_axis.items():
        each = [f.amplitudes[axis] for f in members if axis in f.amplitudes]
        if size.unit == "1" and len(each) > 1:
            # Ratios that were found in turn.
            ratio = float(np.prod([e.value for e in each]))
            std = ratio * float(np.linalg.norm([e.std / e.value for e in each]))
            sizes[axis] = _changed(size, ratio, std, max(map(side_of_limit, each), key=bool))
    times = _means([f for f in members if _overlap(first, f) > _ALIKE])
    return dataclasses.replace(whole, parameters=times, per_axis=sizes)


def _ratio(f: Finding) -> Estimate | None:
    """Ratio of amplitudes by which the level of the noise differs for a while; None for other findings."""
    if f.cause == "variance_change":
        return f.size
    if f.cause != UNEXPLAINED or f.details["domain"] != LEVEL or f.rest is None:
        return None
    axis = next(iter(f.parameters.values())).axis
    # That of the level which a finding without a cause is about is one of powers.
    ratio = float(np.sqrt(f.rest.measured / f.rest.simulated))
    return parameter_estimate(axis, "ratio", ratio, np.nan, "1")


def _level(members: Sequence[Finding]) -> Finding:
    """Small changes of the level as one finding: the level varies, by the largest of them in each axis."""
    sizes: dict[str, Estimate] = {}
    for f in members:
        ratio = _ratio(f)
        known = sizes.get(f.axes[0])
        if ratio and (known is None or abs(np.log(ratio.value)) > abs(np.log(known.value))):
            sizes[f.axes[0]] = ratio
    whole = together(members)
    return dataclasses.replace(
        whole, cause=LEVEL, parameters={}, per_axis=sizes, rest=None, details={}, rivals=(), is_event=True
    )


def _unexplained(members: Sequence[Finding]) -> Finding:
    """What is unexplained at one place on several axes, described as on the most affected one."""
    whole = together(members)
    own = whole.strongest
    places = {name: e for name, e in own.parameters.items() if name in _PLACES}
    return dataclasses.replace(whole, parameters=places, rest=own.rest, details=own.details, span=own.span)


#: Rules for findings that are reported once for several axes.
RULES: Mapping[str, Rule] = {
    "line": Rule(_same_line, _line),
    "stretch": Rule(_same_stretch, _stretch, grows=True),
    LEVEL: Rule(combine=_level),
    "low_pass": Rule(lambda one, other, _: _similar(one, other, "bandwidth", 1.0 + _FILTER)),
    "resonance": Rule(_same_resonance),
    UNEXPLAINED: Rule(lambda one, other, _: _overlap(one, other) > _SAME, _unexplained),
    "bias_step": Rule(lambda one, other, T: _agree(one, other, "time", _AT_ONCE * T, _APART * T)),
    "warm_up": Rule(lambda one, other, _: _similar(one, other, "time_constant", _WARMING)),
    **dict.fromkeys(("temperature", OUTLIERS, "rounding", "saturation", "repeated_samples"), Rule()),
}
_ALONE = Rule(lambda one, other, duration: False)

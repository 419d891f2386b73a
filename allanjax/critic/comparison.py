"""Comparison of an axis with its simulations, and which findings are named by it: the limit of knowing.

Every finding competes with a description that names nothing: a free level of the spectrum, a free level of
the noise over time, a free distribution of the values. Each is estimated from one half of the data and judged
on the other. A finding keeps its name if little is left for such a description at its place, if it is no part
of something larger that is unexplained, and if its effect has no doubt about it, for instance because a
filter's spectrum does not fall above its corner. Otherwise it stays in the extended model as a description,
and is reported as unexplained: where it is in time or frequency, how large and how significant it is, and
what it resembles.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.special import ndtr

from allanjax.critic.finding import UNEXPLAINED, Detail, Discrepancy, Finding, parameter_estimate
from allanjax.critic.noise import centred
from allanjax.critic.policy import judged
from allanjax.critic.profiles import (
    Profile,
    autocorrelation,
    cross_correlation,
    of_samples,
    profiles_of,
)
from allanjax.critic.stage import Stage
from allanjax.inspection.plausible import lattice

# Ordinates of one half in the narrowest window of a free level, number of intervals of a free distribution.
_NARROWEST, _INTERVALS = 16, 24
# Share of the gain outside a place, at either end.
_OUTSIDE = 0.05


class Free(NamedTuple):
    """What a description that names nothing gains over a model [nats], in windows of a width [s or Hz]."""

    gain: Float[np.ndarray, " windows"]
    width: float

    def place(self) -> tuple[float, float]:
        """Part of the record or of the spectrum with most of the gain."""
        share = np.cumsum(np.maximum(self.gain, 0.0))
        first, last = np.searchsorted(share, share[-1] * np.array([_OUTSIDE, 1.0 - _OUTSIDE]))
        return float(first * self.width), float((last + 1) * self.width)

    def within(self, start: float, end: float) -> float:
        """Gain of the windows that overlap a part of the record or of the spectrum."""
        first, last = int(max(start, 0.0) / self.width), int(np.ceil(end / self.width))
        return float(np.sum(self.gain[first : max(last, first + 1)]))


def descriptions(stage: Stage, step: float | None) -> dict[str, Free]:
    """Descriptions of an axis by their domain; steps between values as recorded are not described."""
    e, rate = stage.whitened, stage.rate
    width = 0.0 if step is None else step * float(np.exp(-0.5 * np.mean(np.log(stage.variance))))
    return {
        "spectrum": free_level(stage.whitened_coefficients**2, rate / (2.0 * stage.n)),
        "level": free_level(e**2 / np.mean(e**2), 1.0 / rate),
        "values": Free(np.array([free_distribution(e, width)]), stage.n / rate),
    }


def free_level(squares: Float[np.ndarray, " n"], spacing: float) -> Free:
    """Gain of a free level of squares of mean 1: every other pair under the best level of the rest.

    The level is constant in windows of 2^k times the narrowest one. The best partition follows from the
    bottom up, each window at the price of having been chosen among all (a regression tree, Donoho 1997).
    """
    length = 2 * _NARROWEST
    windows = len(squares) // length
    pairs = squares[: windows * length].reshape(windows, -1, 2, 2)
    halves = pairs[:, :, 0].sum(axis=(1, 2)), pairs[:, :, 1].sum(axis=(1, 2))
    gain = np.zeros(windows)
    for one, other in (halves, halves[::-1]):
        level = _best_levels(one, float(_NARROWEST))
        gain += 0.5 * (other - other / level - _NARROWEST * np.log(level))
    return Free(gain, length * spacing)


def _best_levels(sums: Float[np.ndarray, " windows"], count: float) -> Float[np.ndarray, " windows"]:
    """Best level of each window, given the sums over its `count` squares."""
    finest = 1 << (len(sums) - 1).bit_length()
    total, size = (np.pad(x, (0, finest - len(sums))) for x in (sums, np.full(len(sums), count)))
    price = np.log(2.0 * finest) + 1.0
    level, best = np.ones(finest), np.zeros(finest)
    while True:
        ratio = np.maximum(total, 1e-12) / np.maximum(size, 1e-12)
        own = np.where(size > 0.0, 0.5 * (total - size - size * np.log(ratio)) - price, 0.0)
        whole, width = own > best, finest // len(total)
        level = np.where(np.repeat(whole, width), np.repeat(ratio, width), level)
        if len(total) == 1:
            return level[: len(sums)]
        best, total, size = (x.reshape(-1, 2).sum(axis=1) for x in (np.maximum(own, best), total, size))


def free_distribution(values: Float[np.ndarray, " n"], width: float) -> float:
    """Gain of a free distribution of standardized values over the normal one [nats].

    The shares of intervals that are equally probable under the normal law come from every other pair, the
    gain from the rest. Values rounded to this width are drawn within it by the normal law.
    """
    # The variance without that of rounding (Sheppard), which does not hold if it is most of it.
    variance = np.var(values)
    deviation = np.sqrt(max(variance - width**2 / 12.0, 0.1 * variance))
    low, high = (ndtr((values - values.mean() + side * width) / deviation) for side in (-0.5, 0.5))
    share = low + (high - low) * np.random.default_rng(0).random(len(values))
    place = np.minimum((share * _INTERVALS).astype(int), _INTERVALS - 1)
    pairs = place[: len(place) // 4 * 4].reshape(-1, 2, 2)
    one, other = (np.bincount(pairs[:, k].ravel(), minlength=_INTERVALS) + 0.5 for k in (0, 1))
    logs = (np.log(x * _INTERVALS / x.sum()) for x in (other, one))
    return float(sum((x - 0.5) @ log for x, log in zip((one, other), logs, strict=True)))


# Order of the discrepancies in a critique.
_ORDER = (
    *("allan_deviation", "drift", "psd", "psd_line", "autocorrelation", "skewness", "tails"),
    *("largest_residual", "lattice", "repeated_values", "window_mean", "window_variance"),
    *("cross_correlation", "auxiliary_correlation"),
)


class Comparison(NamedTuple):
    """Discrepancies of an axis from its simulations without any finding and with all of them.

    Attributes:
        before, after: in every statistic, also where p is near 1.
        last: profiles with all findings by statistic, those whose places have an extent.
        free: what descriptions that name nothing gain over the model by domain, without any finding and with
            all of them; once if there is none.
    """

    before: tuple[Discrepancy, ...]
    after: tuple[Discrepancy, ...]
    last: Mapping[str, Profile]
    free: tuple[Mapping[str, Free], ...]

    def rest(self, span: tuple[float, float], domain: str) -> Discrepancy:
        """Largest discrepancy with all findings in a part of the record [s] or of the spectrum [Hz]."""
        unit = {"time": "s", "frequency": "Hz"}[domain]
        places = [p for p in self.last.values() if p.where_unit == unit]
        return min((p.within(*span) for p in places), key=lambda d: d.p_value)


def compared(
    stages: Sequence[Stage],
    raw: tuple[Float[np.ndarray, " recorded"], Float[np.ndarray, " recorded"]],
    others: tuple[Mapping[str, Stage], Mapping[str, Stage]],
    auxiliary: Mapping[str, Float[np.ndarray, " n"]],
) -> Comparison:
    """Comparison of an axis with simulations, without any finding and with all of them.

    Args:
        stages: the axis without any finding, and with all of them if there are some.
        raw: its samples as recorded [SI], without missing ones, at both stages; at the second with imputed
            ones if a finding explains their distribution, such as rounding.
        others: other axes by name, at both stages.
        auxiliary: other channels by name; those that are constant or not finite do not count.
    """
    other = {name: np.asarray(h, float) for name, h in auxiliary.items()}
    channels = {k: centred(h) for k, h in other.items() if np.isfinite(h).all() and np.ptp(h) > 0.0}
    step = lattice(raw[0])
    steps = step, step if raw[1] is raw[0] else lattice(raw[1])
    free, ends = [], []
    last: dict[str, Profile] = {}
    for k, stage in enumerate(stages):
        profiles = profiles_of(stage, channels)
        last = {p.statistic: p for p in profiles if p.extent}
        free.append(descriptions(stage, steps[k]))
        profiles.append(autocorrelation(stage))
        if others[k]:
            profiles.append(cross_correlation(stage, others[k]))
        found = [*(p.worst() for p in profiles), *of_samples(stage, raw[k], steps[k])]
        ends.append(sorted(found, key=lambda d: _ORDER.index(d.statistic)))
        # Other axes need the transform.
        stage.forget(keep_transform=True)
    return Comparison(tuple(ends[0]), tuple(ends[-1]), last, tuple(free))


#: Statistics by the domain in which they show a discrepancy, the one that places it best first.
DOMAINS: Mapping[str, tuple[str, ...]] = {
    "spectrum": ("psd", "psd_line", "autocorrelation", "allan_deviation", "drift"),
    "level": ("window_variance",),
    "values": ("skewness", "tails", "largest_residual", "lattice", "repeated_values"),
    "bias": ("window_mean",),
    "channels": ("cross_correlation", "auxiliary_correlation"),
}
# Domains in which a free description competes with a cause, its own first; of all others it is the bias.
_OF_CAUSES: Mapping[str, tuple[str, ...]] = {
    "low_pass": ("spectrum",),
    "resonance": ("spectrum",),
    # A change of the bias has a spectrum, and a louder part of the record has large values.
    "power_law": ("spectrum", "bias"),
    "outliers": ("values", "level"),
    "variance_change": ("level",),
}
# Causes that tell all of what they are about: the law of the spectrum, of the values, or of the bias.
_WHOLE = ("power_law", "outliers", "telegraph")
# Causes that may be a part of a larger description wherever they are.
_ANYWHERE = (*_WHOLE, "bias_step", "warm_up")
# Score of neighbouring places that belong to a discrepancy, as a share of the largest.
_BESIDE = 0.3
# The Allan deviation at τ is that of the noise in this band, times 1/τ.
_BAND = (0.2, 0.9)
#: p-value below which a discrepancy is beyond doubt.
CERTAIN = judged(UNEXPLAINED, "p_value")
_LEFT, _NATS = judged(UNEXPLAINED, "left"), judged(UNEXPLAINED, "nats")
_MORE = judged("variance_change", "more")
# Gain of a free description that it exceeds by chance with that probability, for each half (Markov).
_SURE = -2.0 * float(np.log(CERTAIN))
_BROAD, _MOST_BROAD = judged("resonance", "broad"), judged("resonance", "most")


# --- Findings that lose their name --------------------------------------------------------------------------


def reported(
    findings: Sequence[Finding],
    reasons: Sequence[str],
    stage: Stage,
    made: Comparison,
    ignored: Collection[str],
) -> list[Finding]:
    """Findings that keep their names, and one without a cause for each domain where others or a rest are.

    Args:
        findings: those of an axis.
        reasons: why their effects doubt them, "" for none.
        stage: the axis before the first of them.
        made: its comparison with simulations.
        ignored: domains in which what remains has another explanation.
    """
    doubts = _doubted(findings, reasons, made.free)
    named = [f for f in findings if not any(f is d.finding for d in doubts)]
    for domain in DOMAINS:
        mine = [d for d in doubts if d.domain == domain]
        # Those that are about this domain come first, the largest of them before the others.
        mine.sort(key=lambda d: (_domains(d.finding)[0] != domain, -(d.finding.gain or 0.0)))
        left = None if domain in ignored else _left(domain, made)
        # Values of noise whose level varies have long tails.
        varies = any(f.details.get("domain") == "level" for f in named)
        if mine or (left and not (varies and left.worst.statistic in ("tails", "largest_residual"))):
            named.append(_unexplained(stage, domain, made, mine, left))
    return named


class _Doubted(NamedTuple):
    """A finding that is not named, the domain of the free description that is its rival, and the reason."""

    finding: Finding
    domain: str
    reason: str


def _doubted(
    findings: Sequence[Finding], reasons: Sequence[str], free: Sequence[Mapping[str, Free]]
) -> list[_Doubted]:
    """Findings that only describe, given `free` descriptions before the first finding and after the last."""
    each = []
    for f, doubt in zip(findings, reasons, strict=True):
        domain, reason = _beside(f, free[0], free[-1])
        each.append(_Doubted(f, domain, doubt or _of_several(f, findings) or reason))
    found = [d for d in each if d.reason]
    while part := _part(each, found, free):
        found.append(part)
    return found


def _part(
    each: Sequence[_Doubted], found: Sequence[_Doubted], free: Sequence[Mapping[str, Free]]
) -> _Doubted | None:
    """Another finding that is part of something that doubted findings describe; None if there is none."""
    for finding in (d.finding for d in each):
        for domain in () if any(finding is d.finding for d in found) else _domains(finding):
            others = [d for d in found if d.domain == domain]
            if others and _is_part(finding, others, free[0]):
                return _Doubted(finding, domain, others[0].reason)
    return None


def _domains(f: Finding) -> tuple[str, ...]:
    """Domains in which a free description competes with a finding."""
    return _OF_CAUSES.get(f.cause, ("bias",))


def _beside(f: Finding, before: Mapping[str, Free], after: Mapping[str, Free]) -> tuple[str, str]:
    """Domain and reason of doubt if a free description gains much beside a finding; its own, "" if not."""
    own, *others = _domains(f)
    # Where the level varies, some stretch has another level, and large values are more frequent.
    if "level" in (own, *others) and _level_left(before, after) > (f.gain or 0.0):
        return "level", "the level varies in another way"
    if own in after and after[own].within(*f.span) > max(_NATS, _LEFT * before[own].within(*f.span)):
        return own, "much of what is there remains"
    return own, ""


def _level_left(before: Mapping[str, Free], after: Mapping[str, Free]) -> float:
    """Gain of a free level after the last finding [nats]; 0 unless beyond doubt and much of that before."""
    first, gain = (float(free["level"].gain.sum()) for free in (before, after))
    return gain if gain > max(_SURE, _LEFT * first) else 0.0


def _of_several(f: Finding, findings: Sequence[Finding]) -> str:
    """Why several findings of one cause together are hardly that cause."""
    alike = [other for other in findings if other.cause == f.cause]
    if f.cause == "variance_change":
        gains = sorted((other.gain or 0.0 for other in alike), reverse=True)
        if sum(gains[2:]) > _MORE * sum(gains):
            return "the level changes more often than twice"
        if any(_continues(f, other) or _continues(other, f) for other in alike):
            return "the level changes step by step"
    if _is_broad(f) and sum(map(_is_broad, alike)) > _MOST_BROAD:
        return "the spectrum has many broad peaks"
    return ""


def _is_broad(f: Finding) -> bool:
    """Whether a finding is a broad resonance."""
    quality = f.parameters.get("quality_factor")
    return quality is not None and quality.value < _BROAD


def _continues(f: Finding, other: Finding) -> bool:
    """Whether the level of the noise is higher, or lower, in a stretch that follows another such stretch."""
    (start, end), (begin, stop) = f.span, other.span
    louder = [each.size is not None and each.size.value > 1.0 for each in (f, other)]
    return louder[0] == louder[1] and end <= begin < end + _BESIDE * max(end - start, stop - begin)


def _is_part(f: Finding, others: Sequence[_Doubted], before: Mapping[str, Free]) -> bool:
    """Whether a finding is a part of a larger description of one domain, at its place."""
    in_bias = others[0].domain == "bias"
    if in_bias and f.cause not in (*_ANYWHERE, "disturbance"):
        return False
    start, end = _place(others, before) or (0.0, np.inf)
    inside = start <= (f.span[0] if in_bias else 0.5 * sum(f.span)) <= end
    # Nothing else is beside what tells all, or within a change of the bias.
    least = _LEFT if f.cause in _WHOLE or (in_bias and inside) else 1.0
    larger = sum(other.finding.gain or 0.0 for other in others) > least * (f.gain or 0.0)
    return larger and (inside or f.cause in _ANYWHERE)


def _place(doubts: Sequence[_Doubted], before: Mapping[str, Free]) -> tuple[float, float] | None:
    """Part of the record [s] or spectrum [Hz] that doubts of one domain are about; None if nothing tells."""
    whole, domain = _whole(doubts), doubts[0].domain
    if domain not in ("spectrum", "level"):
        return whole
    return before[domain].place() if before[domain].within(*whole) > _NATS else None


def _whole(doubts: Sequence[_Doubted]) -> tuple[float, float]:
    """From the first start to the last end of these findings; a power law is beside a change of the bias."""
    own = [d.finding.span for d in doubts if _domains(d.finding)[0] == d.domain]
    starts, ends = zip(*(own or [d.finding.span for d in doubts]), strict=True)
    return min(starts), max(ends)


# --- Findings without a cause -------------------------------------------------------------------------------


class _Left(NamedTuple):
    """Discrepancy that remains, its part of the record [s] or spectrum [Hz]; a free level's gain [nats]."""

    worst: Discrepancy
    place: tuple[float, float] | None
    gain: float


def _left(domain: str, made: Comparison) -> _Left | None:
    """What remains beyond doubt after the last finding in a domain, if anything."""
    mine = [d for d in made.after if d.statistic in DOMAINS[domain]]
    sure = [d for d in mine if d.p_value < CERTAIN]
    # Windows of a free level are as narrow as needed. A free spectrum would also find a stop band's ends.
    gain = _level_left(made.free[0], made.free[-1]) if domain == "level" else 0.0
    if not (sure or gain):
        return None
    # A part of the spectrum is placed best by statistics of it.
    narrow = [d for d in sure if d.statistic in ("psd", "psd_line")]
    worst = min(narrow or sure or mine, key=lambda d: (d.p_value, DOMAINS[domain].index(d.statistic)))
    place = made.free[-1][domain].place() if gain else _span(worst, made.last.get(worst.statistic))
    return _Left(worst, place, gain)


def _span(d: Discrepancy, profile: Profile | None) -> tuple[float, float] | None:
    """Part of the record or of the spectrum that a discrepancy is in; None if it has no place."""
    if d.statistic in ("allan_deviation", "drift"):
        return _BAND[0] / d.where, _BAND[1] / d.where
    if profile is None or profile.extent is None:
        return None
    start, end = profile.extent
    first = last = int(np.argmax(abs(profile.score)))
    if d.statistic == "psd":
        alike = profile.score * np.sign(profile.score[first]) > _BESIDE * abs(profile.score[first])
        others = np.flatnonzero(~alike)
        first = int(np.max(others[others < first], initial=-1)) + 1
        last = int(np.min(others[others > last], initial=len(alike))) - 1
    return float(start[first]), float(end[last])


def _unexplained(
    stage: Stage, domain: str, made: Comparison, doubts: Sequence[_Doubted], left: _Left | None
) -> Finding:
    """Finding without a cause: of what is `left` in a domain, and of doubts about it, the largest first.

    The extended model describes it by the findings that are doubted.
    """
    axis, in_time = stage.axis, domain in ("level", "bias", "values")
    first = min((d for d in made.before if d.statistic in DOMAINS[domain]), key=lambda d: d.p_value)
    worst, place, gain = left or (first, None, 0.0)
    members = [d.finding for d in doubts]
    if doubts:
        place = _place(doubts, made.free[0]) or _span(first, None) or _whole(doubts)
    numbers = {
        "where": (worst.where, worst.where_unit),
        "measured": (worst.measured, worst.unit),
        "simulated": (worst.simulated, worst.unit),
    }
    if place and domain != "values":
        names, unit = (("start", "end"), "s") if in_time else (("lowest", "highest"), "Hz")
        numbers |= {name: (x, unit) for name, x in zip(names, place, strict=True)}
    # A statistic without places has none.
    known = {k: parameter_estimate(axis, k, x, 0.0, unit) for k, (x, unit) in numbers.items() if unit}
    details: dict[str, Detail] = {"domain": domain, "statistic": worst.statistic}
    main = max(members, key=lambda f: f.gain or 0.0, default=None)
    if doubts:
        resembles = tuple(dict.fromkeys(f.cause for f in members))
        details |= {"resembles": resembles, "reason": doubts[0].reason}
    return Finding(
        UNEXPLAINED,
        (axis.name,),
        known | {f.size.label: f.size for f in members if len(members) == 1 and f.size is not None},
        members[0].p_value if members else min(worst.p_value, float(np.exp(-0.5 * gain))),
        sum((f.evidence or 0.0 for f in members), 0.0),
        sum((f.gain or 0.0 for f in members), 0.0),
        (),
        place or (0.0, stage.n / stage.rate if in_time else 0.5 * stage.rate),
        "time" if in_time else "frequency",
        is_event=main.is_event if main else domain in ("level", "bias"),
        change=main.change if main else None,
        rest=worst,
        details=details,
        stage=main.stage if main else -1,
    )

"""The limit of knowing: which findings are named, and where something is that no known effect describes.

Every finding competes with a description that names nothing: a free level of the spectrum, a free level of
the noise over time, a free distribution of the values. Each is estimated from one half of the data and judged
on the other. A finding keeps its name if little is left for such a description at its place, and if its
effect has no doubt about it, for instance because a filter's spectrum does not fall above its corner.
Otherwise it stays in the extended model as a description, and is reported as unexplained: where it is in time
or frequency, how large and how significant it is, and what it resembles.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from allanjax.critic.comparison import StageResiduals
from allanjax.critic.finding import UNEXPLAINED, Discrepancy, Finding
from allanjax.critic.free import Free
from allanjax.critic.parameters import parameter_estimate
from allanjax.critic.policy import judged
from allanjax.critic.profiles import Comparison, Profile

#: Statistics by the domain in which they show a discrepancy, the one that places it best first.
DOMAINS: Mapping[str, tuple[str, ...]] = {
    "spectrum": ("psd", "psd_line", "autocorrelation", "allan_deviation", "drift"),
    "level": ("window_variance",),
    "values": ("skewness", "tails", "largest_residual", "lattice", "repeated_values"),
    "bias": ("window_mean",),
    "channels": ("cross_correlation", "auxiliary_correlation"),
}
# Domains of the findings of known causes, as far as a free description competes with them.
_OF_CAUSES = {
    **dict.fromkeys(("low_pass", "resonance", "power_law"), "spectrum"),
    "variance_change": "level",
    "outliers": "values",
    "slow_change": "bias",
}
# Causes of a bias that jumps.
_JUMPS = ("bias_step", "telegraph")
# Score of neighbouring places that belong to a discrepancy, as a share of the largest.
_BESIDE = 0.3
# The Allan deviation at τ is that of the noise in this band, times 1/τ.
_BAND = (0.2, 0.9)
#: p-value below which a discrepancy is beyond doubt.
CERTAIN = judged(UNEXPLAINED, "p_value")
_LEFT, _NATS = judged(UNEXPLAINED, "left"), judged(UNEXPLAINED, "nats")
_MORE = judged("variance_change", "more")


# --- Findings that lose their name --------------------------------------------------------------------------


def reported(
    findings: Sequence[Finding],
    reasons: Sequence[str],
    record: StageResiduals,
    made: Comparison,
    ignored: Collection[str],
) -> list[Finding]:
    """Findings that keep their names, and one without a cause for each domain where others or a rest are.

    Args:
        findings: those of an axis.
        reasons: why their effects doubt them, "" for none.
        record: the axis before the first of them.
        made: its comparison with simulations.
        ignored: domains in which what remains has another explanation.
    """
    doubts = _doubted(findings, reasons, made.free, record)
    named = [f for f in findings if not any(f is d.finding for d in doubts)]
    return [*named, *_unexplained(record, made, doubts, _left(made, ignored))]


class _Doubted(NamedTuple):
    """A finding that is not named, the domain of the free description that is its rival, and the reason."""

    finding: Finding
    domain: str
    reason: str


def _doubted(
    findings: Sequence[Finding], reasons: Sequence[str], free: tuple[Free, Free], record: StageResiduals
) -> list[_Doubted]:
    """Findings that are only a description.

    `free` are the descriptions that name nothing before the first finding and after the last one.
    """
    changes = sorted((f.gain or 0.0 for f in findings if f.cause == "variance_change"), reverse=True)
    often = sum(changes[2:]) > _MORE * sum(changes)

    def reason_of(f: Finding, domain: str) -> str:
        if f.cause == "variance_change" and often:
            return "the level changes more often than twice"
        if domain == "bias":
            return ""
        before, after = (each.within(domain, f.span, record) for each in free)
        return "much of what is there remains" if after > max(_NATS, _LEFT * before) else ""

    domains = [_OF_CAUSES.get(f.cause, "bias") for f in findings]
    each = [
        _Doubted(f, domain, reason or reason_of(f, domain))
        for f, domain, reason in zip(findings, domains, reasons, strict=True)
    ]
    found = [d for d in each if d.reason]
    for d in each:
        # What lies at the place of a larger description is a part of it, as are jumps beside other changes.
        others = [other for other in found if other.domain == d.domain]
        if d.reason or not others:
            continue
        start, end = _place(others, d.domain, free[0], record) or (0.0, np.inf)
        inside = start <= 0.5 * sum(d.finding.span) <= end
        larger = sum(other.finding.gain or 0.0 for other in others) > (d.finding.gain or 0.0)
        if larger and (inside if d.domain != "bias" else d.finding.cause in _JUMPS):
            found.append(d._replace(reason=others[0].reason))
    return found


def _place(
    doubts: Sequence[_Doubted], domain: str, before: Free, record: StageResiduals
) -> tuple[float, float] | None:
    """Part of the record [s] or of the spectrum [Hz] that doubts of a domain are about.

    None if the descriptions that name nothing do not tell.
    """
    if domain not in ("spectrum", "level"):
        return _whole(doubts)
    gains = before.within(domain, _whole(doubts), record) > _NATS
    return before.place(domain, record) if gains else None


def _whole(doubts: Sequence[_Doubted]) -> tuple[float, float]:
    """From the first start to the last end of these findings."""
    starts, ends = zip(*(d.finding.span for d in doubts), strict=True)
    return min(starts), max(ends)


# --- Findings without a cause -------------------------------------------------------------------------------


class _Left(NamedTuple):
    """A discrepancy that remains, and the part of the record [s] or of the spectrum [Hz] that it is in."""

    discrepancy: Discrepancy
    span: tuple[float, float] | None


def _left(made: Comparison, ignored: Collection[str]) -> dict[str, _Left]:
    """What remains beyond doubt after the last finding, by domain; some domains are `ignored`."""
    found = {}
    sure = {d.statistic: d for d in made.after if d.p_value < CERTAIN}
    last = {profile.statistic: profile for profile in made.last}
    for domain, statistics in DOMAINS.items():
        mine = [_Left(sure[s], _span(sure[s], last.get(s))) for s in statistics if s in sure]
        if mine and domain not in ignored:
            # A part of the spectrum is placed best by statistics of it.
            narrow = [each for each in mine if each.discrepancy.statistic in ("psd", "psd_line")]
            found[domain] = min(narrow or mine, key=lambda each: each.discrepancy.p_value)
    return found


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
        while first and alike[first - 1]:
            first -= 1
        while last + 1 < len(alike) and alike[last + 1]:
            last += 1
    return float(start[first]), float(end[last])


def _unexplained(
    record: StageResiduals, made: Comparison, doubts: Sequence[_Doubted], left: Mapping[str, _Left]
) -> list[Finding]:
    """Findings without a cause, one for each domain where there are doubts or something is left."""
    found = []
    for domain, statistics in DOMAINS.items():
        mine = [d for d in doubts if d.domain == domain]
        if mine:
            first = min((d for d in made.before if d.statistic in statistics), key=lambda d: d.p_value)
            place = _place(mine, domain, made.free[0], record) or _span(first, None) or _whole(mine)
            worst = left[domain].discrepancy if domain in left else first
            found.append(_described(mine, _unnamed(record, domain, worst, place)))
        elif domain in left:
            found.append(_unnamed(record, domain, *left[domain]))
    return found


def _unnamed(
    record: StageResiduals, domain: str, worst: Discrepancy, place: tuple[float, float] | None
) -> Finding:
    """Finding of a discrepancy without a cause, at a place [s or Hz] if that is known."""
    axis, in_time = record.axis, domain in ("level", "bias", "values")
    numbers = {
        "where": (worst.where, worst.where_unit),
        "measured": (worst.measured, worst.unit),
        "simulated": (worst.simulated, worst.unit),
    }
    if place and domain != "values":
        names, unit = (("start", "end"), "s") if in_time else (("lowest", "highest"), "Hz")
        numbers |= {name: (x, unit) for name, x in zip(names, place, strict=True)}
    return Finding(
        UNEXPLAINED,
        (axis.name,),
        # A statistic without places has none.
        {name: parameter_estimate(axis, name, x, 0.0, unit) for name, (x, unit) in numbers.items() if unit},
        worst.p_value,
        0.0,
        0.0,
        (),
        place or (0.0, record.n / record.rate if in_time else 0.5 * record.rate),
        "time" if in_time else "frequency",
        discrepancies=((worst, worst),),
        details={"domain": domain, "statistic": worst.statistic},
    )


def _described(doubts: Sequence[_Doubted], unnamed: Finding) -> Finding:
    """Finding without a cause that the extended model describes by other findings, which are not named."""
    ordered = sorted(doubts, key=lambda d: -(d.finding.gain or 0.0))
    members, main = [d.finding for d in ordered], ordered[0].finding
    size = {e.label: e for e in [main.size] if e is not None and len(members) == 1}
    resembles = tuple(dict.fromkeys(f.cause for f in members))
    return dataclasses.replace(
        unnamed,
        parameters={**unnamed.parameters, **size},
        p_value=main.p_value,
        evidence=sum(f.evidence or 0.0 for f in members),
        gain=sum(f.gain or 0.0 for f in members),
        details={**unnamed.details, "resembles": resembles, "reason": ordered[0].reason},
        coefficients=main.coefficients,
        drift=main.drift,
        # From the first of these findings on: they are hardly apart.
        stages=(min(f.stages[0] for f in members), max(f.stages[1] for f in members)),
    )

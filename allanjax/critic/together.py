"""Findings of single axes told as one: their numbers together, and the parameters that they share."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from allanjax.critic.finding import Finding, Rival
from allanjax.critic.parameters import Detail, parameter_estimate
from allanjax.noise.estimate import Estimate

# Rivals with longer odds against them than this are not reported, as in the search.
_ODDS = 1000.0


def together(
    cause: str,
    members: Sequence[Finding],
    parameters: Mapping[str, Estimate],
    per_axis: Mapping[str, Estimate],
    details: Mapping[str, Detail] | None = None,
    counted: Sequence[Finding] | None = None,
) -> Finding:
    """One finding of several; `counted` are those whose p-value, evidence and gain are its own.

    The p-value is the smallest one times their number, evidence and gain are sums: they are of different
    axes, or were found one after the other. A rival is one in all of them.
    """
    counted = members if counted is None else counted
    p = [f.p_value for f in counted if f.p_value is not None]
    start, end = zip(*(f.span for f in members), strict=True)
    whole = Finding(
        cause=cause,
        axes=tuple(dict.fromkeys(axis for f in members for axis in f.axes)),
        parameters=parameters,
        p_value=min(1.0, min(p) * len(counted)) if p else None,
        evidence=_sum(f.evidence for f in counted),
        gain=_sum(f.gain for f in counted),
        rivals=_rivals(counted),
        span=(min(start), max(end)),
        domain=members[0].domain,
        details=details or {},
        # What is left of a finding stands for it.
        members=tuple(made for f in members for made in f.members or (f,)),
        per_axis=per_axis,
    )
    if not counted:
        return whole
    main = max(counted, key=lambda f: f.effect.size)
    return dataclasses.replace(
        whole, coefficients=main.coefficients, drift=main.drift, discrepancies=main.discrepancies
    )


def shared(members: Sequence[Finding], labels: Iterable[str]) -> dict[str, Estimate]:
    """Parameters that all members have in common, where they have any."""
    found = {}
    for label in labels:
        each = [f.parameters[label] for f in members if label in f.parameters]
        if each and (mean := mean_of(each)) is not None:
            found[label] = mean
    return found


def summed(members: Sequence[Finding], labels: Iterable[str]) -> dict[str, Estimate]:
    """Sums of parameters over the members that have them."""
    found = {}
    for label in labels:
        each = [f.parameters[label] for f in members if label in f.parameters]
        if each:
            value, std = sum(e.value for e in each), float(np.sqrt(sum(e.std**2 for e in each)))
            found[label] = parameter_estimate(each[0].axis, label, value, std, each[0].unit)
    return found


def mean_of(each: Sequence[Estimate]) -> Estimate | None:
    """Mean of estimates, weighted by their errors; where they scatter by more, its error is larger.

    None where they are exact and differ, or have different units.
    """
    if len({e.unit for e in each}) > 1:
        return None
    if len({(e.value, e.std) for e in each}) == 1:
        return each[0]
    known = [e for e in each if np.isfinite(e.std)]
    if not known:
        # Limits: the mildest one holds for all.
        return max(each, key=lambda e: e.value if e.lower_limit is None else -e.value)
    value, std = (np.array([getattr(e, name) for e in known]) for name in ("value", "std"))
    if not np.all(std > 0.0):
        return None
    weight = 1.0 / std**2
    mean = float(weight @ value / weight.sum())
    scatter = float(np.sqrt(weight @ (value - mean) ** 2 / max(len(known) - 1, 1)))
    error = max(scatter, 1.0) / float(np.sqrt(weight.sum()))
    return parameter_estimate(known[0].axis, known[0].label, mean, error, known[0].unit)


def largest(members: Sequence[Finding]) -> dict[str, Estimate]:
    """How large the effect is in each axis, the largest where an axis has several members."""
    found: dict[str, Estimate] = {}
    for f in members:
        for axis, size in f.amplitudes.items():
            if axis not in found or abs(size.value) > abs(found[axis].value):
                found[axis] = size
    return found


def _sum(values: Iterable[float | None]) -> float | None:
    """Sum of the numbers that there are, None if there are none."""
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

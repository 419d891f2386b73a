"""Steps of a search that belong together as one finding: harmonics of a line, and outliers."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np

from allanjax.critic.parameters import Detail
from allanjax.critic.step import Step
from allanjax.noise.estimate import Estimate
from allanjax.noise.model import Model


def grouped(steps: Sequence[Step]) -> list[Step]:
    """Steps in which the harmonics of a fundamental are one finding, and all outliers are one."""
    left, grouped = list(steps), []
    while left:
        first, others = left[0], []
        if first.candidate.cause == "sinusoid":
            family = [s for s in left if s is first or _harmonic(first, s)]
            first = min(family, key=lambda s: s.candidate.parameters["frequency"].value)
            others = [s for s in left if s is not first and _harmonic(first, s)]
            grouped.append(_with_harmonics(first, others) if others else first)
        elif first.candidate.cause == "outliers":
            others = [s for s in left[1:] if s.candidate.cause == "outliers"]
            grouped.append(_with_outliers(first, others) if others else first)
        else:
            grouped.append(first)
        left = [s for s in left if s is not first and s not in others]
    return grouped


def _harmonic(one: Step, other: Step) -> bool:
    """Whether two steps are lines, the higher frequency being a small multiple of the lower one."""
    if one is other or {one.candidate.cause, other.candidate.cause} != {"sinusoid"}:
        return False
    both = (s.candidate.parameters["frequency"] for s in (one, other))
    low, high = sorted(both, key=lambda frequency: frequency.value)
    order = np.rint(high.value / low.value)
    error = 4.0 * np.hypot(high.std, order * low.std)
    return bool(2 <= order <= 20 and abs(high.value - order * low.value) < error)


def _with_harmonics(step: Step, others: Sequence[Step]) -> Step:
    """Fundamental and harmonics as one finding."""
    found = [s.candidate.parameters for s in others]
    view, fundamental = step.before, step.candidate.parameters["frequency"].value
    orders = (np.rint(one["frequency"].value / fundamental) for one in found)
    details: dict[str, Detail] = {
        "harmonics": tuple(view.estimate("harmonic", order, 0.0, "1") for order in orders),
        "harmonic_amplitudes": tuple(one["amplitude"] for one in found),
    }
    return _together(step, others, step.candidate.estimates, details)


def _with_outliers(step: Step, others: Sequence[Step]) -> Step:
    """Outliers that were found one after the other as one finding."""
    each = [s.candidate.details for s in (step, *others)]
    found = [
        (time, size)
        for own in each
        for time, size in zip(own["times"], own["sizes"], strict=True)
        if isinstance(time, Estimate) and isinstance(size, Estimate)
    ]
    times, sizes = zip(*sorted(found, key=lambda pair: pair[0].value), strict=True)
    count, *rest = step.candidate.estimates
    count = step.before.estimate("count", len(times), count.std, "1")
    return _together(step, others, [count, *rest], {"times": times, "sizes": sizes})


def _together(
    step: Step, others: Sequence[Step], estimates: Sequence[Estimate], details: Mapping[str, Detail]
) -> Step:
    """Several steps as one, with these parameters and details."""

    def add_to_model(model: Model) -> Model:
        for s in (step, *others):
            model = s.candidate.add_to_model(model)
        return model

    candidate = dataclasses.replace(
        step.candidate,
        estimates=estimates,
        details=details,
        gain=step.candidate.gain + sum(s.candidate.gain for s in others),
        add_to_model=add_to_model,
    )
    return dataclasses.replace(step, candidate=candidate, gain=step.gain + sum(s.gain for s in others))

"""Steps of a search that belong together as one finding: harmonics of a line, and outliers."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping, Sequence

import numpy as np

from allanjax.critic.merging import OUTLIERS, order_of
from allanjax.critic.parameters import Detail
from allanjax.critic.step import Step
from allanjax.noise.estimate import Estimate


def grouped(steps: Sequence[Step]) -> list[Step]:
    """Steps in which the harmonics of a fundamental are one finding, and all outliers are one."""
    groups: dict[Step, list[Step]] = {}
    for step in steps:
        groups.setdefault(_first(step, steps), []).append(step)
    return [_together(first, group) if len(group) > 1 else first for first, group in groups.items()]


def _first(step: Step, steps: Sequence[Step]) -> Step:
    """Step to which another one belongs: its fundamental, the first outliers, or itself."""
    alike = [s for s in steps if s.candidate.cause == step.candidate.cause]
    if step.candidate.cause == "sinusoid":
        lower = [s for s in alike if order_of(_frequency(step), _frequency(s))]
        return _first(min(lower, key=lambda s: _frequency(s).value), steps) if lower else step
    return alike[0] if step.candidate.cause == OUTLIERS else step


def _frequency(step: Step) -> Estimate:
    return step.candidate.parameters["frequency"]


def _together(first: Step, group: Sequence[Step]) -> Step:
    """A group of steps as one, with what the first of them has and lists of what the others add."""
    others = [s for s in group if s is not first]
    every, estimates, details = (first, *others), first.candidate.estimates, _lists(first, others)
    if "times" in details:
        count, *rest = estimates
        estimates = [first.before.estimate("count", len(details["times"]), count.std, "1"), *rest]
    candidate = dataclasses.replace(
        first.candidate,
        estimates=estimates,
        details=details,
        gain=sum(s.candidate.gain for s in every),
        add_to_model=lambda model: functools.reduce(lambda m, s: s.candidate.add_to_model(m), every, model),
    )
    return dataclasses.replace(first, candidate=candidate, gain=sum(s.gain for s in every))


def _lists(first: Step, others: Sequence[Step]) -> Mapping[str, Detail]:
    """Harmonics of a line with their amplitudes, or times and sizes of all outliers."""
    if first.candidate.cause == "sinusoid":
        orders = (round(_frequency(s).value / _frequency(first).value) for s in others)
        return {
            "harmonics": tuple(first.before.estimate("harmonic", order, 0.0, "1") for order in orders),
            "harmonic_amplitudes": tuple(s.candidate.parameters["amplitude"] for s in others),
        }
    each = [s.candidate.details for s in (first, *others)]
    lists = {name: [e for own in each for e in own[name] if isinstance(e, Estimate)] for name in each[0]}
    order = np.argsort([e.value for e in lists["times"]], kind="stable")
    return {name: tuple(own[k] for k in order) for name, own in lists.items()}

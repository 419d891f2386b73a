"""What was found is fitted again when later findings have changed what it was fitted beside.

A filter that was fitted with a bump still in the spectrum, a warm-up with a step still in the record: each is
looked for again in the record without all the others, whose amplitudes are free if they have a shape.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from allanjax.critic.bank import FINEST, SLOW
from allanjax.critic.noise import centred
from allanjax.critic.step import Step
from allanjax.critic.view import Cause, View

# Times around, for those that lean on each other.
_ROUNDS = 3
# Frequencies at which the noise is looked at; what the logarithm of its level may change by, and any
# parameter of the others in its standard deviations.
_PLACES, _LEVEL, _DEVIATION = 64, 0.2, 0.3
# Log-evidence [nats] of what is not dropped, and what fitting again may lose: greed explains noise, too.
_SURE, _LOST = 20.0, 2.5


def refitted(
    steps: Sequence[Step], view: View, causes: Sequence[Cause], last: bool = False
) -> tuple[list[Step], View]:
    """The steps, each fitted beside the others if these have changed what it was fitted beside, and the end.

    What gains nothing beside the others is dropped, unless the record is not to be explained without it.

    Args:
        steps: all findings.
        view: without them.
        causes: those that are `refit` are fitted again.
        last: whether nothing else is to be found; else nothing is done until one is to be fitted `at once`.
    """
    again = {cause.name: cause for cause in causes if cause.refit}
    found = [s if s.beside is not None else dataclasses.replace(s, beside=_levels(s, view)) for s in steps]
    end, lost = view, set()
    for _ in range(_ROUNDS):
        stale = [k for k in range(len(found)) if found[k].candidate.cause in again and _stale(k, found, end)]
        if not (last or any(again[found[k].candidate.cause].refit == "at once" for k in stale)):
            break
        for k in stale:
            cause = found[k].candidate.cause
            without = _without(found[k], end)
            beside = without.with_findings(*without.found, beside=_shapes(found, k))
            candidate = again[cause].again(beside, found[k].candidate)
            if candidate is None or not candidate.gain > 0.0:
                lost.add(k)
                continue
            lost.discard(k)
            # What overlaps in time shares what it gains; what is in the spectrum has been measured once.
            gain = candidate.held_out() if candidate.has_waveform else found[k].gain
            end = candidate.after.with_findings(*without.found, cause)
            candidate = dataclasses.replace(candidate, after=end)
            step = Step.of(candidate, gain, found[k].rivals, without)
            found[k] = dataclasses.replace(step, beside=_beside(k, found, end))
    if end.noise.log_evidence < view.noise.log_evidence - _LOST:
        return list(steps), view
    # One at a time: what is left when it is gone may explain the others.
    for k in sorted(lost, key=lambda k: found[k].candidate.gain)[:1]:
        without = _without(found[k], end)
        if end.noise.log_evidence - without.noise.log_evidence < _SURE:
            found.pop(k)
            end = without
    return found, end


def _without(step: Step, end: View) -> View:
    """The view as it would be had this step not been made."""
    names = list(end.found)
    names.remove(step.candidate.cause)
    return step.change.put_back(end).with_findings(*names)


def _stale(k: int, steps: Sequence[Step], end: View) -> bool:
    """Whether the noise or the others are not what the step was fitted beside."""
    old, new = steps[k].beside, _beside(k, steps, end)
    return old is None or len(old) != len(new) or bool(np.max(abs(new - old)) > 1.0)


def _beside(k: int, steps: Sequence[Step], end: View) -> Float[np.ndarray, " k"]:
    """What a step is fitted beside, in units of what matters: the noise, and others with a shape."""
    values = [
        float(q.value) / (_DEVIATION * q.std)
        for other in _others(k, steps)
        for q in other.candidate.parameters.values()
        if isinstance(q.value, float) and q.std > 0.0
    ]
    return np.concatenate([_levels(steps[k], end), values])


def _levels(step: Step, view: View) -> Float[np.ndarray, " places"]:
    """Logarithms of the spectrum over the model's where the finding is; of low noise, if it has a shape."""
    if step.candidate.has_waveform:
        places = np.geomspace(1.0, min(SLOW, view.n - 1.0), _PLACES)
        return np.log(view.variance()[np.unique(np.rint(places).astype(int)) - 1]) / _LEVEL
    low, high = 1.0, view.n - 1.0
    if step.candidate.domain == "frequency":
        low, high = (2.0 * view.n * f / view.rate for f in step.candidate.support)
    places = np.geomspace(np.clip(low / 2.0, 1.0, view.n / 2.0), min(high, view.n - 1.0), _PLACES + 1)
    edges = np.unique(np.rint(places).astype(int)) - 1
    squares = (view.coefficients**2 / view.variance())[: edges[-1]]
    return np.log(np.add.reduceat(squares, edges[:-1]) / np.diff(edges)) / _LEVEL


def _others(k: int, steps: Sequence[Step]) -> list[Step]:
    """Others with a shape, if this step has one."""
    mine = steps[k].candidate.has_waveform
    return [s for i, s in enumerate(steps) if mine and i != k and s.candidate.has_waveform]


def _shapes(steps: Sequence[Step], k: int) -> tuple[Float[np.ndarray, " slow"], ...]:
    """The lowest coefficients of what the others take out."""
    paths = [other.change.path for other in _others(k, steps)]
    return tuple(centred(path)[:FINEST] for path in paths if path is not None)

"""Steps of the search: a finding and its change of a view."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from allanjax.critic.bank import FINEST, SLOW
from allanjax.critic.effect import Candidate, Effect, View
from allanjax.critic.finding import Rival
from allanjax.critic.noise import centred
from allanjax.critic.policy import judged


@dataclasses.dataclass(frozen=True, eq=False)
class Step:
    """One finding as the search made it.

    It has a candidate, its gain on held-out data [nats], rivals with the odds against them, and the view that
    it was found in. `conditions` are the noise and the other findings that its fit depends on, in units of
    changes that matter.
    """

    candidate: Candidate
    gain: float
    rivals: tuple[Rival, ...]
    before: View
    conditions: Float[np.ndarray, " k"] | None = None

    @classmethod
    def of(cls, candidate: Candidate, gain: float, rivals: tuple[Rival, ...], view: View) -> Step:
        """Step that keeps only the necessary parts of its views."""
        candidate = dataclasses.replace(
            candidate, after=candidate.after.without_caches(), held_out=lambda: gain
        )
        return cls(candidate, gain, rivals, view.without_caches())

    @property
    def path(self) -> Float[np.ndarray, " n"] | None:
        """Samples that are subtracted, if any."""
        before, after = self.before.samples, self.candidate.after.samples
        return None if after is before else before - after

    def made(self, view: View, undone: bool = False) -> View:
        """View after the finding, from one before it, or `undone` the other way round.

        Waveforms, basic terms and imputed samples change, the structure of the spectrum does not.
        """
        before, after = self.before, self.candidate.after
        names = [*view.found] if undone else [*view.found, self.candidate.cause]
        if undone:
            names.remove(self.candidate.cause)
        if (path := self.path) is not None:
            view = view.with_samples(view.samples + path if undone else view.samples - path)
        one, other = (after, before) if undone else (before, after)
        if set(one.allowed) != set(other.allowed):
            kept = [t for t in view.allowed if t in other.allowed or t not in one.allowed]
            view = view.allowing([*kept, *(t for t in other.allowed if t not in one.allowed)])
        if after.imputed is not before.imputed:
            own = after.imputed & ~before.imputed
            view = dataclasses.replace(view, imputed=view.imputed & ~own if undone else view.imputed | own)
        return view.with_findings(*names)


# Most rounds at last, for findings that depend on each other.
_ROUNDS = 3
# Number of frequencies at which noise is compared.
_PLACES = 64
_LEVEL, _DEVIATION, _SURE, _LOST = (judged("refit", name) for name in ("level", "parameter", "sure", "lost"))


def refitted(
    steps: Sequence[Step], view: View, effects: Sequence[Effect], last: bool = False
) -> tuple[list[Step], View]:
    """Steps, refitted if later ones changed their conditions, and the final view.

    A finding that gains nothing given the others is dropped, unless much evidence would be lost without it.
    Before the search is over (`last`), nothing is done unless a finding is to be refitted "at once".
    """
    again = {effect.name: effect for effect in effects if effect.refit}
    found = list(steps)
    for k, s in enumerate(found):
        if s.conditions is None:
            found[k] = dataclasses.replace(s, conditions=_levels(s, view))
    end, lost = view, set()
    for _ in range(_ROUNDS if last else 1):
        stale = [k for k in range(len(found)) if found[k].candidate.cause in again and _stale(k, found, end)]
        if not (last or any(again[found[k].candidate.cause].refit == "at once" for k in stale)):
            break
        for k in stale:
            cause = found[k].candidate.cause
            without = found[k].made(end, undone=True)
            given_others = without.with_findings(*without.found, nuisances=_shapes(found, k))
            candidate = again[cause].again(given_others, found[k].candidate)
            if candidate is None or not candidate.gain > 0.0:
                lost.add(k)
                continue
            lost.discard(k)
            # Overlapping waveforms share their gain; for spectral effects the gain was measured for good.
            gain = candidate.held_out() if candidate.has_waveform else found[k].gain
            end = candidate.after.accepted().with_findings(*without.found, cause)
            candidate = dataclasses.replace(candidate, after=end)
            step = Step.of(candidate, gain, found[k].rivals, without)
            found[k] = dataclasses.replace(step, conditions=_conditions(k, found, end))
    if end.noise.log_evidence < view.noise.log_evidence - _LOST:
        return list(steps), view
    # Only the weakest one, as the rest after its removal may explain the others.
    for k in sorted(lost, key=lambda k: found[k].candidate.gain)[:1]:
        without = found[k].made(end, undone=True)
        if end.noise.log_evidence - without.noise.log_evidence < _SURE:
            found.pop(k)
            end = without
    return found, end


def _stale(k: int, steps: Sequence[Step], end: View) -> bool:
    """Whether the noise or the other findings have changed since the step was fitted."""
    old, new = steps[k].conditions, _conditions(k, steps, end)
    return old is None or len(old) != len(new) or bool(np.max(abs(new - old)) > 1.0)


def _conditions(k: int, steps: Sequence[Step], end: View) -> Float[np.ndarray, " k"]:
    """Noise and other waveforms that a step is conditional on, in units of changes that matter."""
    values = [
        q.value / (_DEVIATION * q.std)
        for other in _others(k, steps)
        for q in other.candidate.estimates
        if q.std > 0.0
    ]
    return np.concatenate([_levels(steps[k], end), values])


def _levels(step: Step, view: View) -> Float[np.ndarray, " places"]:
    """Log levels of the noise that matters to a step: low frequencies for a waveform, else around it."""
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
    """Other steps with a waveform, if this step has one."""
    mine = steps[k].candidate.has_waveform
    return [s for i, s in enumerate(steps) if mine and i != k and s.candidate.has_waveform]


def _shapes(steps: Sequence[Step], k: int) -> tuple[Float[np.ndarray, " slow"], ...]:
    """Lowest coefficients of the waveforms of the other steps."""
    paths = [other.path for other in _others(k, steps)]
    return tuple(centred(path)[:FINEST] for path in paths if path is not None)

"""Steps of the search: a finding, and the change that it makes in a view."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Iterable, Sequence

import numpy as np
from jaxtyping import Bool, Float

from allanjax.critic.view import Candidate, View


@dataclasses.dataclass(frozen=True, eq=False)
class Step:
    """One finding, as the search made it.

    Attributes:
        candidate: candidate that was accepted.
        gain: gain in log-likelihood on held-out data [nats].
        rivals: other causes and the odds against them.
        before: view that it was found in.
        beside: quantities that its fit was conditional on, see `critic.refit`.
    """

    candidate: Candidate
    gain: float
    rivals: tuple[tuple[str, float], ...]
    before: View
    beside: Float[np.ndarray, " k"] | None = None

    @classmethod
    def of(cls, candidate: Candidate, gain: float, rivals: Sequence[tuple[str, float]], view: View) -> Step:
        """Step that keeps no more of its views than is needed."""
        candidate = dataclasses.replace(
            candidate, after=candidate.after.without_caches(), held_out=lambda: gain
        )
        return cls(candidate, gain, tuple(rivals), view.without_caches())

    @property
    def change(self) -> Change:
        """Change that it makes in a view."""
        return Change.of(self.before, self.candidate.after)


@dataclasses.dataclass(frozen=True, eq=False)
class Change:
    """Change that a finding makes in a view.

    Attributes:
        path: samples that are subtracted.
        factor: factor of the spectrum.
        passes: power response, if the factor is a filter's.
        added, removed: basic terms of the noise.
        restored: samples that are imputed since.
    """

    path: Float[np.ndarray, " n"] | None
    factor: Float[np.ndarray, " n-1"] | None
    passes: Float[np.ndarray, " n-1"] | None
    added: Collection[str]
    removed: Collection[str]
    restored: Bool[np.ndarray, " n"] | None

    @classmethod
    def of(cls, before: View, after: View) -> Change:
        """Change from one view to another."""
        factor = None
        if after.factor is not None and after.factor is not before.factor:
            factor = after.factor if before.factor is None else after.factor / before.factor
        return cls(
            None if after.samples is before.samples else before.samples - after.samples,
            factor,
            None if after.passes is before.passes else after.passes,
            [t for t in after.allowed if t not in before.allowed],
            [t for t in before.allowed if t not in after.allowed],
            None if after.restored is before.restored else after.restored & ~before.restored,
        )

    def taken_out(self, view: View) -> View:
        """View without the finding, of one that has it."""
        after = view if self.path is None else view.with_samples(view.samples - self.path)
        after = after if self.factor is None else after.with_factor(self.factor)
        after = after if self.passes is None else dataclasses.replace(after, passes=self.passes)
        after = _with_terms(after, self.added, self.removed)
        if self.restored is None:
            return after
        return dataclasses.replace(after, restored=after.restored | self.restored)

    def put_back(self, view: View) -> View:
        """View as it would be had the finding not been made."""
        before = view if self.path is None else view.with_samples(view.samples + self.path)
        before = before if self.factor is None else before.with_factor(1.0 / self.factor)
        before = before if self.passes is None else dataclasses.replace(before, passes=None)
        before = _with_terms(before, self.removed, self.added)
        if self.restored is None:
            return before
        return dataclasses.replace(before, restored=before.restored & ~self.restored)


def _with_terms(view: View, more: Collection[str], less: Collection[str]) -> View:
    """View with more of the basic terms, or with less."""
    return view.allowing([*(t for t in view.allowed if t not in less), *more]) if more or less else view


def replay(start: View, steps: Iterable[Step]) -> list[Step]:
    """Steps made again one after the other, each in the view that the one before has left."""
    view, found = start, []
    for step in steps:
        after = step.change.taken_out(view).with_findings(*view.found, step.candidate.cause)
        candidate = dataclasses.replace(step.candidate, after=after)
        found.append(Step.of(candidate, step.gain, step.rivals, view))
        view = after
    return found

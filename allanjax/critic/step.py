"""Steps of the search: a finding, and the change that it makes in a view."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Iterable, Sequence

import numpy as np
from jaxtyping import Bool, Float

from allanjax.critic.view import Candidate, View


@dataclasses.dataclass(frozen=True, eq=False)
class Step:
    """One finding as the search made it.

    It has a candidate, its gain on held-out data [nats], rivals with the odds against them, and the view that
    it was found in. `conditions` are the quantities that its fit was conditional on, see `critic.refit`.
    """

    candidate: Candidate
    gain: float
    rivals: tuple[tuple[str, float], ...]
    before: View
    conditions: Float[np.ndarray, " k"] | None = None

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

    What is in the structure of the spectrum is no part of it.

    Attributes:
        path: samples that are subtracted.
        added, removed: basic terms of the noise.
        imputed: samples that are imputed since.
    """

    path: Float[np.ndarray, " n"] | None
    added: Collection[str]
    removed: Collection[str]
    imputed: Bool[np.ndarray, " n"] | None

    @classmethod
    def of(cls, before: View, after: View) -> Change:
        """Change from one view to another."""
        return cls(
            None if after.samples is before.samples else before.samples - after.samples,
            [t for t in after.allowed if t not in before.allowed],
            [t for t in before.allowed if t not in after.allowed],
            None if after.imputed is before.imputed else after.imputed & ~before.imputed,
        )

    def apply(self, view: View) -> View:
        """View without the finding, of one that has it."""
        return self._made(view)

    def undo(self, view: View) -> View:
        """View as it would be had the finding not been made."""
        return self._made(view, undone=True)

    def _made(self, view: View, undone: bool = False) -> View:
        if self.path is not None:
            view = view.with_samples(view.samples + self.path if undone else view.samples - self.path)
        more, less = (self.removed, self.added) if undone else (self.added, self.removed)
        if more or less:
            view = view.allowing([*(t for t in view.allowed if t not in less), *more])
        if self.imputed is not None:
            now = view.imputed & ~self.imputed if undone else view.imputed | self.imputed
            view = dataclasses.replace(view, imputed=now)
        return view


def replay(start: View, steps: Iterable[Step]) -> list[Step]:
    """Steps made again one after the other, each in the view that the one before has left.

    The structure of the spectrum is that of the last step that has changed it.
    """
    view, found = start, []
    for step in steps:
        after = step.change.apply(view).with_findings(*view.found, step.candidate.cause)
        if (
            step.candidate.domain == "frequency"
            and step.candidate.after.structure is not step.before.structure
        ):
            after = after.with_structure(step.candidate.after.structure).with_findings(*after.found)
        candidate = dataclasses.replace(step.candidate, after=after)
        found.append(Step.of(candidate, step.gain, step.rivals, view))
        view = after
    return found

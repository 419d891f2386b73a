"""Interface of the causes that a critique looks for."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import TYPE_CHECKING, ClassVar, Literal

from allanjax.critic.view import Candidate, View

if TYPE_CHECKING:
    from allanjax.critic.places import Place


class Cause(ABC):
    """An effect that a sensor's model may lack; `critic.policy` has the rule for accepting it."""

    name: str
    #: Whether it is visible directly in the samples and must be undone before the search for others.
    is_preprocessing: ClassVar[bool] = False
    #: Whether it is refitted when later findings change what it was conditional on: "at once", if its misfit
    #: would be mistaken for other effects, or "at last".
    refit: ClassVar[Literal["", "at once", "at last"]] = ""

    def __repr__(self) -> str:
        return f"<Cause {self.name}>"

    @abstractmethod
    def detect(self, view: View) -> Candidate | None:
        """Best candidate of this cause in a view, or None."""

    def again(self, view: View, found: Candidate) -> Candidate | None:
        """The finding refitted in a view with other findings; None if nothing remains of it."""
        return self.detect(view)

    def at(self, places: Sequence[Place]) -> Cause | None:
        """The cause that searches only at places known from other axes; None if there is no such search."""
        return None

    def p_value(self, view: View) -> float | None:
        """p-value of this cause's statistic under noise alone, corrected for the search over places.

        None if the cause has no such statistic.
        """
        return None

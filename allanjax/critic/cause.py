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
    #: When it is refitted if later findings change its conditions: "at once", if its misfit would be mistaken
    #: for other effects, or "at last".
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
        """This cause, searching only at places known from other axes; None if it has no such search."""
        return None

    def p_value(self, view: View) -> float | None:
        """p-value of this cause's statistic under noise alone, corrected for the search over places.

        None if the cause has no such statistic.
        """
        return None

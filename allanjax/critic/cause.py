"""Interface of the causes that a critique looks for."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import TYPE_CHECKING, ClassVar, Literal

from allanjax.critic.view import Candidate, View

if TYPE_CHECKING:
    from allanjax.critic.places import Place


class Cause(ABC):
    """An effect that a sensor's model may lack; what is asked of a candidate is in `critic.policy`."""

    name: str
    #: Whether it is seen in the samples themselves and must be undone before anything else is looked for.
    is_preprocessing: ClassVar[bool] = False
    #: Whether it is refitted when later findings change what it was conditional on: at once, since its misfit
    #: would be taken for other effects, or at last.
    refit: ClassVar[Literal["", "at once", "at last"]] = ""

    def __repr__(self) -> str:
        return f"<Cause {self.name}>"

    @abstractmethod
    def detect(self, view: View) -> Candidate | None:
        """Best candidate of this cause in a view, or None."""

    def again(self, view: View, found: Candidate) -> Candidate | None:
        """Finding refitted in a view with other findings than before; None if nothing is left of it."""
        return self.detect(view)

    def at(self, places: Sequence[Place]) -> Cause | None:
        """The same cause, looked for only at places known from other axes; None if it never is."""
        return None

    def p_value(self, view: View) -> float | None:
        """p-value of this cause's statistic if the view has noise only, corrected for the search over places.

        None where the cause has no such statistic.
        """
        return None

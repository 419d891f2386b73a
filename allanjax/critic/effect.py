"""Interface of the effects that a critique looks for."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, ClassVar, Literal, NamedTuple

from allanjax.critic.parameters import side_of_limit
from allanjax.critic.view import Candidate, View
from allanjax.noise.estimate import Estimate

if TYPE_CHECKING:
    from allanjax.critic.places import Place


class Range(NamedTuple):
    """Where a parameter makes sense: beyond it, the effect is another one, or no record shows it.

    Attributes:
        least, most: ends of the range, in the unit of the parameter or as a property of the view.
        may_be_a_limit: whether it may be at an end of its search, where the finding tells a limit.
    """

    least: float | Literal["interval", "resolution"]
    most: float | Literal["duration", "nyquist"]
    may_be_a_limit: bool = False

    def holds(self, e: Estimate, view: View) -> bool:
        """Whether an estimate in a view makes sense."""
        scales = {
            "interval": 1.0 / view.rate,
            "duration": view.duration,
            "resolution": 1.0 / view.duration,
            "nyquist": 0.5 * view.rate,
        }
        least, most = (scales[end] if isinstance(end, str) else end for end in self[:2])
        return least <= e.value <= most and (self.may_be_a_limit or side_of_limit(e) == "")


#: A time between the sample interval and the length of the record; a frequency that the record resolves.
TIMES, FREQUENCIES = Range("interval", "duration"), Range("resolution", "nyquist")


class Effect(ABC):
    """An effect that a sensor's model may lack; `critic.acceptance` has the rule for accepting it."""

    name: str
    #: Whether it is visible directly in the samples and must be undone before the search for others.
    is_preprocessing: ClassVar[bool] = False
    #: When it is refitted if later findings change its conditions: "at once", if its misfit would be mistaken
    #: for other effects, or "at last".
    refit: ClassVar[Literal["", "at once", "at last"]] = ""

    #: Where its parameters make sense, by label; a candidate outside is not accepted.
    sensible: ClassVar[Mapping[str, Range]] = {}

    def __repr__(self) -> str:
        return f"<Effect {self.name}>"

    @abstractmethod
    def detect(self, view: View) -> Candidate | None:
        """Best candidate of this effect in a view, or None."""

    def again(self, view: View, found: Candidate) -> Candidate | None:
        """The finding refitted in a view with other findings; None if nothing remains of it."""
        return self.detect(view)

    def at(self, places: Sequence[Place]) -> Effect:
        """This effect, searching only at places of its own cause that are known from other axes."""
        return self

    def p_value(self, view: View) -> float | None:
        """p-value of this effect's statistic under noise alone, corrected for the search over places.

        None if the effect has no such statistic.
        """
        return None

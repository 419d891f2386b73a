"""How a recording is read and fitted: one object that commands and fleets hand on as a whole."""

from dataclasses import dataclass, fields
from typing import Any

from allanjax.accumulator import AllanAccumulator
from allanjax.fit import Objective, fit
from allanjax.io.options import ReadOptions
from allanjax.model import Model
from allanjax.recording import Recording
from allanjax.result import Fit


@dataclass(frozen=True)
class FitOptions:
    """How recordings are read and fitted.

    Attributes:
        reading: how they are read.
        model, objective, regressors: as `fit` takes them.
    """

    reading: ReadOptions = ReadOptions()
    model: Model | None = None
    objective: Objective = "allan"
    regressors: tuple[str, ...] = ()

    def arguments(self) -> dict[str, Any]:
        """All options by name, as `characterize_fleet` takes them."""
        own = {option.name: getattr(self, option.name) for option in fields(self) if option.name != "reading"}
        return own | self.reading.given()

    def fit(self, recording: Recording) -> Fit:
        """The fit of a recording.

        Raises:
            AllanjaxError: as `fit`.
        """
        return fit(recording, self.model, self.objective, regressors=self.regressors)

    def fit_accumulated(self, accumulator: AllanAccumulator) -> Fit:
        """The fit of what was accumulated, which has no channels to regress on.

        Raises:
            AllanjaxError: as `AllanAccumulator.fit`.
        """
        return accumulator.fit(self.model, self.objective)

    def to_dict(self) -> dict[str, Any]:
        """The options in JSON's types; equal if, and only if, the options are."""
        # As text: JSON has no infinity.
        model = self.model and [[p.label, p.free, repr(p.start)] for p in self.model.parameters]
        return {
            "reading": self.reading.given(),
            "model": model,
            "objective": self.objective,
            "regressors": list(self.regressors),
        }

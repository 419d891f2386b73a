"""Options of reading and fitting, in one object that commands and fleets pass on."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, is_dataclass
from typing import TYPE_CHECKING, Any

from allanjax.record.io.options import ReadOptions

if TYPE_CHECKING:
    from allanjax.estimate.fit import Objective
    from allanjax.estimate.result import Fit
    from allanjax.inspection import Inspection
    from allanjax.noise.model import Model
    from allanjax.record.recording import Recording


@dataclass(frozen=True)
class FitOptions:
    """Options of reading and fitting recordings.

    Attributes:
        reading: how they are read.
        model, objective, regressors, as_is, vibrating, plain: as `fit` takes them.
    """

    reading: ReadOptions = ReadOptions()
    model: Model | None = None
    objective: Objective = "allan"
    regressors: tuple[str, ...] = ()
    as_is: bool = False
    vibrating: bool = False
    plain: bool = False

    def arguments(self) -> dict[str, Any]:
        """All options by name, as `characterize_fleet` takes them."""
        own = {option.name: getattr(self, option.name) for option in fields(self) if option.name != "reading"}
        return own | self.reading.given()

    def fit(self, recording: Recording, inspection: Inspection | None = None) -> Fit:
        """Fit of a recording with these options, given its inspection if that is known."""
        from allanjax.estimate.fit import fit_inspected

        inspection = self.inspect(recording) if inspection is None else inspection
        options = self.model, self.objective, self.regressors, self.plain
        return fit_inspected(recording, inspection, *options, as_is=self.as_is)

    def inspect(self, recording: Recording) -> Inspection:
        """Inspection of a recording, as used by its fit."""
        if self.model is None:
            # Without the modules of fits, which may still be loading.
            from allanjax.inspection import inspect

            moves = bool(self.regressors)
            return inspect(recording, as_is=self.as_is, vibrating=self.vibrating, may_move=moves)
        from allanjax.estimate.fit import inspected

        return inspected(recording, self.model, self.regressors, self.as_is, self.vibrating)

    def to_dict(self) -> dict[str, Any]:
        """All options in types of JSON; equal if and only if the options are equal."""
        return {option.name: _plain(getattr(self, option.name)) for option in fields(self)}


def _plain(value: Any) -> Any:
    """A value in types of JSON: an object as its type and fields, and numbers as text, to allow infinity."""
    if value is None or isinstance(value, bool | str):
        return value
    if is_dataclass(value) and not isinstance(value, type):
        kind = f"{type(value).__module__}.{type(value).__qualname__}"
        return {"type": kind} | {part.name: _plain(getattr(value, part.name)) for part in fields(value)}
    if isinstance(value, Mapping):
        return {str(name): _plain(part) for name, part in value.items()}
    if isinstance(value, set | frozenset):
        return sorted(map(_plain, value))
    if isinstance(value, list | tuple):
        return [_plain(part) for part in value]
    import numpy as np

    number = np.asarray(value)
    return repr(float(number)) if number.ndim == 0 else _plain(number.tolist())

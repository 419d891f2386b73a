"""Noise models as functions of earlier rooms take them: a model for all axes, or a fit with one an axis."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Protocol, TypeAlias

from allanjax.base.errors import AllanjaxError
from allanjax.noise.model import Model
from allanjax.noise.notation import ModelLike, as_model


class Modelled(Protocol):
    """The result of an axis that has a noise model, such as an axis of a fit."""

    @property
    def model(self) -> Model:
        """The model with its values."""


#: A noise model of all axes, or a fit, which has one of each axis.
Modelling: TypeAlias = ModelLike | Mapping[str, Modelled]


def models_of(given: Modelling, names: Sequence[str]) -> list[Model]:
    """Model of each of these axes, complete with values.

    Raises:
        AllanjaxError: the fit lacks an axis or has no result for one; a parameter has no value.
    """
    if isinstance(given, Mapping):
        missing = [name for name in names if name not in given]
        if missing:
            raise AllanjaxError(f"the fit has no axis {missing[0]!r}; it has {', '.join(given)}")
        models = [given[name].model for name in names]
    else:
        models = [as_model(given)] * len(names)
    for model in models:
        model.check_complete()
    return models

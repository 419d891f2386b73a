"""Likelihood of a record of which samples were missing, as wide as the intervals of its fit."""

from __future__ import annotations

import numpy as np
from jaxtyping import Array, Float

from allanjax.posterior.likelihood import Likelihood


class WiderLikelihood(Likelihood):
    """Likelihood of a complete record for one of which samples were missing: wider by a factor."""

    complete: Likelihood
    factor: Float[np.ndarray, ""]

    @classmethod
    def of(cls, complete: Likelihood, factor: float) -> WiderLikelihood:
        """Likelihood whose standard deviations, that of the powers among them, are wider by this factor."""
        return cls(
            complete.parameters,
            complete.start,
            complete.scatter * factor,
            complete.lower,
            complete.upper,
            complete.prior_scale * np.sqrt(factor),
            complete.found,
            complete,
            np.array(factor),
        )

    def __call__(self, values: Float[Array, " params"]) -> Float[Array, ""]:
        return self.complete(values) / self.factor**2

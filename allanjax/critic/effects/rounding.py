"""Rounding: the output's resolution is coarser than the noise."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from allanjax.critic.effect import Candidate, Effect, View
from allanjax.critic.imputation import draw_between, draw_unrounded, local_deviation
from allanjax.critic.policy import judged
from allanjax.inspection.plausible import TOLERANCE, lattice

# Step, in deviations of the samples, above which its errors depend on the samples.
_COARSE = 2.0


def is_harmless(step: float, samples: Float[np.ndarray, " n"]) -> bool:
    """Whether a resolution is so fine, compared with the samples' scatter, that rounding does no harm.

    It adds white noise of step²/12. Compared with the samples, not with their spectrum, of which a filter
    leaves parts that are weaker than any rounding.
    """
    return step < judged("rounding", "harmless") * local_deviation(samples)


class Rounding(Effect):
    """A resolution of which all samples are multiples."""

    name = "rounding"
    is_preprocessing = True

    def detect(self, view: View) -> Candidate | None:
        recorded = view.recorded(view.raw)
        q = lattice(recorded)
        if q is None or is_harmless(q, recorded) or not np.array_equal(view.samples, view.raw):
            return None
        fine = q < _COARSE * local_deviation(recorded)
        x = draw_unrounded(view.samples, q, view.n) if fine else None
        if x is None:
            x, _ = draw_between(view.samples, view.samples - q / 2.0, view.samples + q / 2.0, view.n)
        # Missing samples were drawn without rounding and need none.
        x = np.where(view.drawn, view.samples, x)
        # It is visible directly in the samples: all are so close to multiples that chance is excluded.
        return Candidate(
            self.name,
            [view.amplitude_estimate("step", q, q * TOLERANCE / np.sqrt(view.n))],
            float("nan"),
            None,
            view.with_samples(x),
            lambda: float("nan"),
            bound=0.0,
        )

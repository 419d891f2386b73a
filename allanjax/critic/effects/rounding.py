"""Rounding: the output's resolution is coarser than the noise."""

from __future__ import annotations

import numpy as np

from allanjax.critic.effect import Candidate, Effect, View
from allanjax.critic.imputation import draw_between
from allanjax.critic.policy import judged
from allanjax.inspection.plausible import TOLERANCE, lattice

#: Resolution, relative to the noise's standard deviation, below which rounding is harmless.
HARMLESS = judged("rounding", "harmless")


class Rounding(Effect):
    """A resolution of which all samples are multiples."""

    name = "rounding"
    is_preprocessing = True

    def detect(self, view: View) -> Candidate | None:
        q = lattice(view.recorded(view.raw))
        if q is None or not np.array_equal(view.samples, view.raw):
            return None
        # The variance of any noise around its local mean is at least half that of its differences.
        if q < HARMLESS * 0.5 * float(np.std(np.diff(view.samples))):
            return None
        # Missing samples were drawn without rounding and need none.
        half = np.where(view.drawn, 0.0, q / 2.0)
        x, sigma = draw_between(view.samples, view.samples - half, view.samples + half, view.n)
        if q < HARMLESS * sigma:
            return None
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

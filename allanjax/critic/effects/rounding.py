"""Rounding: the output's resolution is coarser than the noise."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from allanjax.critic.effect import Candidate, Effect, View
from allanjax.critic.imputation import draw_between, local_deviation, local_mean
from allanjax.critic.policy import judged
from allanjax.inspection.plausible import TOLERANCE, lattice
from allanjax.spectrum.cosine import cosine_transform

# Parts into which the band is divided.
_BINS = 64


def is_harmless(step: float, samples: Float[np.ndarray, " n"]) -> bool:
    """Whether a resolution is so fine, compared with the samples' scatter, that rounding does no harm.

    It adds white noise of step²/12. Compared with the samples, not with their spectrum, of which a filter
    leaves parts that are weaker than any rounding.
    """
    return step < judged("rounding", "harmless") * local_deviation(samples)


def _part_of_band(x: Float[np.ndarray, " n"]) -> float:
    """Part of the band in which samples have their noise; 1 for white noise."""
    squares = cosine_transform(x) ** 2
    # Medians leave lines out.
    levels = np.median(squares[: len(squares) // _BINS * _BINS].reshape(_BINS, -1), axis=1)
    return float(np.mean(levels) ** 2 / np.mean(levels**2))


class Rounding(Effect):
    """A resolution of which all samples are multiples."""

    name = "rounding"
    is_preprocessing = True

    def detect(self, view: View) -> Candidate | None:
        recorded = view.recorded(view.raw)
        q = lattice(recorded)
        if q is None or is_harmless(q, recorded) or not np.array_equal(view.samples, view.raw):
            return None
        # Missing samples were drawn without rounding and need none.
        half = np.where(view.drawn, 0.0, q / 2.0)
        limits = view.samples - half, view.samples + half
        (x, deviation), (other, _) = (draw_between(view.samples, *limits, view.n + k) for k in range(2))
        # Two draws have this share in common, to which noise that is faster than the local mean is damped.
        # The rest is white, so that white noise keeps its level, and noise in a part of the band does not.
        share = 1.0 - 0.5 * float(np.mean((x - other) ** 2)) / deviation**2
        slow = local_mean(x)
        kept = share + (1.0 - share) * _part_of_band(x - slow)
        x = slow + (x - slow) / np.sqrt(kept)
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

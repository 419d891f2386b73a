"""Rounding: a resolution of the output that is coarser than the noise."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from allanjax.critic.causes.imputation import draw_between
from allanjax.critic.view import Candidate, Cause, View

# Distance from a multiple of the step, in steps, up to which a sample is on the lattice.
_TOLERANCE = 1e-3
# Least share of the gaps between values that are multiples of the step.
_SHARE = 0.999
# Number of different values up to which there may be a lattice although most samples differ.
_FEW = 20000
#: Resolution over the deviation of the noise below which rounding does no harm: a judgement.
HARMLESS = 0.35


class Rounding(Cause):
    """A step of which all samples are multiples."""

    name = "rounding"
    is_preprocessing = True

    def detect(self, view: View) -> Candidate | None:
        q = lattice(view.raw)
        if q is None or not np.array_equal(view.samples, view.raw):
            return None
        # No noise has less than half of its differences' variance around its local mean.
        if q < HARMLESS * 0.5 * float(np.std(np.diff(view.samples))):
            return None
        x, sigma = draw_between(view.samples, view.samples - q / 2.0, view.samples + q / 2.0, view.n)
        if q < HARMLESS * sigma:
            return None
        # It is in the samples themselves: that all of them are so close to multiples is no chance.
        return Candidate(
            self.name,
            [view.amplitude_estimate("step", q, q * _TOLERANCE / np.sqrt(view.n))],
            float("nan"),
            None,
            view.with_samples(x),
            lambda: float("nan"),
            bound=0.0,
        )


def lattice(x: Float[np.ndarray, " n"]) -> float | None:
    """Step between the samples' values, if these are on a lattice, else None."""
    values = np.unique(x)
    least = 1e-9 * float(np.max(abs(values))) + 1e-300
    gaps = np.diff(values)
    gaps = gaps[gaps > least]
    if len(gaps) < 1 or (len(values) > max(len(x) / 2.0, 3) and len(values) > _FEW):
        return None
    q = float(gaps.min())
    for _ in range(3):
        steps = np.rint(gaps / q)
        q = float(np.sum(gaps) / np.sum(steps))
    off = abs(gaps / q - np.rint(gaps / q))
    return q if np.mean(off < _TOLERANCE * np.maximum(np.rint(gaps / q), 1.0)) > _SHARE else None

"""Saturation: an output that is clipped at its range."""

from __future__ import annotations

import numpy as np

from allanjax.critic.causes.imputation import draw_between
from allanjax.critic.causes.rounding import lattice
from allanjax.critic.view import Candidate, Cause, View
from allanjax.noise.estimate import Estimate

# Fewest runs of samples at the largest value, or fewest such samples, that are not by chance: judgements.
_LEAST, _MANY = 4, 100
# Fewest steps of a rounded output between its extremes for it to have a tail.
_FEW_LEVELS = 4


class Saturation(Cause):
    """An excess of samples at the largest value, at the smallest, or at both."""

    name = "saturation"
    is_preprocessing = True

    def detect(self, view: View) -> Candidate | None:
        raw = view.raw
        q = lattice(raw)
        sides = [side for side in (1.0, -1.0) if _piled_up(side * raw, q)]
        if not sides:
            return None
        lower, upper = view.samples.copy(), view.samples.copy()
        far = 1e3 * float(np.std(raw)) + 1e-300
        count = 0
        levels: list[Estimate] = []
        for side in sides:
            level = side * float(np.max(side * raw))
            clipped = raw == level
            count += int(clipped.sum())
            (upper if side > 0.0 else lower)[clipped] += side * far
            name = "upper_level" if side > 0.0 else "lower_level"
            levels.append(view.amplitude_estimate(name, level, 0.0))
        if count > 0.9 * view.n:
            return None
        x, sigma = draw_between(view.samples, lower, upper, count)
        # Each clipped sample repeats a value that a continuous output (or a step of it) would rarely hit: the
        # odds of this are a judgement, by which it is accepted, and not told.
        odds = count * float(np.log(max(sigma / (q or 1e-3 * sigma), 2.0)))
        return Candidate(
            self.name,
            [*levels, view.estimate("fraction", count / view.n, 0.0, "1")],
            float("nan"),
            None,
            view.with_samples(x, (raw == raw.max()) | (raw == raw.min())),
            lambda: float("nan"),
            bound=float(np.exp(-min(odds, 700.0))),
        )


def _piled_up(raw: np.ndarray, q: float | None) -> bool:
    """Whether more samples are at the largest value than a tail would leave there."""
    top = raw.max()
    at_top = int(np.sum(raw == top))
    if q is None:
        clipped = np.concatenate([[0], (raw == top).astype(int), [0]])
        # Copies of one extreme sample are another matter.
        return int(np.sum(np.diff(clipped) == 1)) >= _LEAST or at_top >= _MANY
    if np.ptp(raw) < _FEW_LEVELS * q:
        return False
    below = int(np.sum(abs(raw - (top - q)) < q / 2.0))
    return at_top > below + 6.0 * np.sqrt(below + 1.0) and at_top >= 5 * _LEAST

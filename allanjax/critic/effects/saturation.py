"""Saturation: an output that is clipped at its range."""

from __future__ import annotations

import numpy as np

from allanjax.critic.effect import Candidate, Effect, View
from allanjax.critic.imputation import draw_between
from allanjax.critic.policy import judged
from allanjax.inspection.plausible import Ends, lattice
from allanjax.noise.estimate import Estimate


class Saturation(Effect):
    """Too many samples at the largest value, at the smallest, or at both."""

    name = "saturation"
    is_preprocessing = True

    def detect(self, view: View) -> Candidate | None:
        raw, recorded = view.raw, view.recorded(view.raw)
        q = lattice(recorded)
        piled_up = Ends.of(recorded[:, None]).piled_up(np.array([q or 0.0]))[:, 0]
        sides = [side for side, is_there in zip((1.0, -1.0), piled_up, strict=True) if is_there]
        if not sides:
            return None
        lower, upper = view.samples.copy(), view.samples.copy()
        far = 1e3 * float(np.std(raw)) + 1e-300
        every = np.zeros(view.n, bool)
        levels: list[Estimate] = []
        for side in sides:
            level = side * float(np.max(side * recorded))
            clipped = raw == level
            every |= clipped
            (upper if side > 0.0 else lower)[clipped] += side * far
            name = "upper_level" if side > 0.0 else "lower_level"
            levels.append(view.amplitude_estimate(name, level, 0.0))
        count = int(every.sum())
        if count > judged("saturation", "share") * view.n:
            return None
        x, sigma = draw_between(view.samples, lower, upper, count)
        # Each clipped sample repeats a value that a continuous output (or a step of it) would rarely hit: the
        # odds are a judgement; they serve to accept the finding and are not reported.
        odds = count * float(np.log(max(sigma / (q or 1e-3 * sigma), 2.0)))
        return Candidate(
            self.name,
            [*levels, view.estimate("fraction", count / view.n, 0.0, "1")],
            float("nan"),
            None,
            view.with_samples(x, every),
            lambda: float("nan"),
            bound=float(np.exp(-min(odds, 700.0))),
        )

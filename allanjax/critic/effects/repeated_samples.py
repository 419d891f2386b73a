"""Repeated samples: values that were held, or replaced by the previous one when they were lost."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float
from scipy.stats import norm

from allanjax.critic.effect import Candidate, Effect, View
from allanjax.critic.imputation import impute_gaussian
from allanjax.critic.policy import judged
from allanjax.inspection.plausible import lattice

_LEAST, _DOUBTLESS, _PREDICTED, _APART = (
    judged("repeated_samples", name) for name in ("count", "deviations", "share", "apart")
)


class RepeatedSamples(Effect):
    """More samples equal to the previous one than rounding explains."""

    name = "repeated_samples"
    is_preprocessing = True

    def detect(self, view: View) -> Candidate | None:
        raw, recorded = view.raw, view.recorded(view.raw)
        same = np.concatenate([[False], raw[1:] == raw[:-1]])
        # The limits of a clipped output repeat; missing samples have been drawn and repeat none.
        same &= (raw < recorded.max()) & (raw > recorded.min())
        count, n = int(same.sum()), len(recorded)
        if count < _LEAST:
            return None
        chance = _by_chance(recorded)
        z = (count - n * chance) / np.sqrt(n * chance * (1.0 - chance) + 1.0)
        share = count / n
        if chance > 0.0 and (z < _DOUBTLESS or share < chance + _PREDICTED):
            return None
        # In a continuous output no sample repeats another, so the probability is zero.
        known = chance > 0.0
        longest = int(np.max(np.diff(np.flatnonzero(np.diff(np.concatenate([[0], same, [0]]))))[::2]))
        return Candidate(
            self.name,
            [
                view.estimate("fraction", share, np.sqrt(share * (1.0 - share) / n), "1"),
                view.estimate("longest", longest, 0.0, "samples"),
            ],
            _gain(count, n, share, chance) if known else float("nan"),
            float(norm.sf(z)) if known else None,
            impute_gaussian(view, same),
            lambda: _held_out(same, chance) if known else float("nan"),
            bound=1.0 if known else 0.0,
        )


def _by_chance(raw: Float[np.ndarray, " n"]) -> float:
    """Share of repeats by rounding alone."""
    q = lattice(raw)
    if q is None:
        return 0.0
    # Rounding to steps of q adds q²/6 to the variance of differences. Two samples that differ by d round to
    # the same value with the probability 1 − |d|/q, that no border lies between them.
    sigma = float(np.sqrt(np.maximum(np.var(np.diff(raw)) - q**2 / 6.0, 1e-4 * q**2)))
    d = np.linspace(0.0, q, 401)
    fine = float(np.trapezoid((1.0 - d / q) * 2.0 * norm.pdf(d / sigma) / sigma, d))
    # This does not hold for coarse steps, where samples farther apart are equal as often.
    coarse = float(np.mean(raw[_APART:] == raw[:-_APART]))
    return max(fine, coarse)


def _gain(count: float, n: float, share: float, chance: float) -> float:
    """Log-likelihood ratio [nats] of a number of repeats: with this share of repeated samples, to chance."""
    floor = max(chance, 1e-12)
    return float(count * np.log(share / floor) + (n - count) * np.log((1.0 - share) / (1.0 - floor)))


def _held_out(same: Bool[np.ndarray, " n"], chance: float) -> float:
    """Gain in log-likelihood [nats] on each half of the record with the share from the other half."""
    first, second = np.array_split(same, [len(same) // 2])
    return sum(
        _gain(other.sum(), len(other), (one.sum() + 0.5) / (len(one) + 1.0), chance)
        for one, other in ((first, second), (second, first))
    )

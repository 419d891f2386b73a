"""Samples that are copies of the one before: a value held, a dropped one filled in."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float
from scipy.stats import norm

from allanjax.critic.causes.rounding import lattice
from allanjax.critic.gap_filling import impute_gaussian
from allanjax.critic.view import Candidate, Cause, Quantity, View

# Fewer are no matter.
_LEAST = 3
_DOUBTLESS = 8.0
# Where rounding makes repeats, their share is predicted no better than this.
_PREDICTED = 0.03
# Samples so far apart have been held together rarely.
_APART = 12


class RepeatedSamples(Cause):
    """More samples equal to their predecessor than rounding explains."""

    name = "repeated_samples"
    is_preprocessing = True

    def detect(self, view: View) -> Candidate | None:
        same = repeats(view.raw)
        count = int(same.sum())
        if count < _LEAST:
            return None
        chance = _by_chance(view.raw)
        z = (count - view.n * chance) / np.sqrt(view.n * chance * (1.0 - chance) + 1.0)
        share = count / view.n
        if chance > 0.0 and (z < _DOUBTLESS or share < chance + _PREDICTED):
            return None
        gain = _gain(count, view.n, chance)
        longest = int(np.max(np.diff(np.flatnonzero(np.diff(np.concatenate([[0], same, [0]]))))[::2]))
        return Candidate(
            self.name,
            {
                "fraction": Quantity(share, float(np.sqrt(share * (1.0 - share) / view.n)), "1"),
                "longest": Quantity(float(longest), 0.0, "samples"),
            },
            gain,
            float(norm.sf(z)) if chance > 0.0 else 0.0,
            impute_gaussian(view, same),
            lambda: _held_out(same, chance),
            (0.0, view.duration),
            "time",
        )


def repeats(raw: Float[np.ndarray, " n"]) -> Bool[np.ndarray, " n"]:
    """Which samples equal the one before; a clipped output does so at its limits, which do not count."""
    same = np.concatenate([[False], raw[1:] == raw[:-1]])
    return same & (raw < raw.max()) & (raw > raw.min())


def _by_chance(raw: Float[np.ndarray, " n"]) -> float:
    """The share of repeats that rounding alone makes."""
    q = lattice(raw)
    if q is None:
        return 0.0
    # Rounding to steps of q adds q²/6 to the variance of differences. Two samples that differ by d are
    # rounded alike if no border is between them: with the probability 1 − |d|/q.
    sigma = float(np.sqrt(np.maximum(np.var(np.diff(raw)) - q**2 / 6.0, 1e-4 * q**2)))
    d = np.linspace(0.0, q, 401)
    fine = float(np.trapezoid((1.0 - d / q) * 2.0 * norm.pdf(d / sigma) / sigma, d))
    # Of coarse steps that is not true; there, samples farther apart are alike as often.
    coarse = float(np.mean(raw[_APART:] == raw[:-_APART]))
    return max(fine, coarse)


def _gain(count: float, n: float, chance: float) -> float:
    """Log-likelihood of so many repeats under their own share over that under chance."""
    share, floor = count / n, max(chance, 1e-12)
    return float(count * np.log(share / floor) + (n - count) * np.log((1.0 - share) / (1.0 - floor)))


def _held_out(same: Bool[np.ndarray, " n"], chance: float) -> float:
    """Gain on each half of the record by the share in the other."""
    gain, half, floor = 0.0, len(same) // 2, max(chance, 1e-12)
    for one, other in ((same[:half], same[half:]), (same[half:], same[:half])):
        share = (one.sum() + 0.5) / (len(one) + 1.0)
        k = other.sum()
        gain += float(k * np.log(share / floor) + (len(other) - k) * np.log((1.0 - share) / (1.0 - floor)))
    return gain

"""Tests of a filter's innovations: are they white, and of the size that the filter says?"""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float

from allanjax.base.chi_squared import upper_tail

# Lags of the portmanteau test: at most so many, and this share of the samples.
_LAGS, _SHARE = 40, 0.2


@dataclasses.dataclass(frozen=True)
class ChiSquared:
    """A statistic with a χ² law where the model is right.

    Attributes:
        statistic, dof: its value and its degrees of freedom.
        p_value: probability of a value as extreme: of a larger one (whiteness), or two-sided (size).
    """

    statistic: float
    dof: int
    p_value: float


def whiteness(u: Float[np.ndarray, " n"]) -> ChiSquared:
    """Portmanteau test of Ljung and Box (1978, Biometrika 65:297) of standardized innovations.

    Q = n(n + 2) Σ r_d²/(n − d) over lags d up to 40. Where there is no sample, u is NaN; n − d is then the
    number of pairs that are there.
    """
    there = np.isfinite(u)
    n = int(there.sum())
    lags = min(_LAGS, int(_SHARE * n))
    if lags < 1:
        return ChiSquared(float("nan"), 0, float("nan"))
    value, count = np.where(there, u, 0.0), there.astype(float)
    power = float(value @ value)
    total = 0.0
    for d in range(1, lags + 1):
        pairs = max(float(count[d:] @ count[:-d]), 1.0)
        total += (float(value[d:] @ value[:-d]) / power) ** 2 / pairs
    statistic = n * (n + 2.0) * total
    return ChiSquared(statistic, lags, float(upper_tail(statistic, lags)))


def normalized_square(u: Float[np.ndarray, " n"]) -> ChiSquared:
    """Normalized innovations squared (NIS) Σ e²/s, χ² with a degree of freedom a sample; two-sided."""
    u = u[np.isfinite(u)]
    statistic = float(u @ u)
    above = float(upper_tail(statistic, len(u)))
    return ChiSquared(statistic, len(u), min(2.0 * min(above, 1.0 - above), 1.0))

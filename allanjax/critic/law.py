"""The law of Allan deviations and spectra in simulations.

A simulation draws cosine coefficients c_j ~ N(0, v_j), where the levels v themselves are known only as well
as the record determines them. The Allan variance of the record continued by its mirror image at both ends,
known as the total variance (Greenhall, Howe & Percival 1999, IEEE Trans. UFFC 46:1183), is diagonal in them:

    σ²(m) = (1/n) Σ_j c_j² w_j(m),    w_j(m) = 2 sin⁴(m a_j/2)/(m² sin²(a_j/2)),    a_j = πj/n.

So the scatter of simulations follows without simulating: it is that of a weighted sum of χ² variates.
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.stats import chi2

from allanjax.allan.estimators import cluster_sizes
from allanjax.critic.stage import Stage, narrow_bins, octave_bins

# Phase m·a_j/2 beyond which sin⁴ counts by its mean, 3/8; up to there it changes little in a narrow bin.
_FAST = 80.0
# Relative precision of such sums: the variance that remains after fitting the levels is not smaller.
_ROUNDING = 1e-3
# Cluster times of a curve per octave.
_PER_OCTAVE = 4


class Law(NamedTuple):
    """Weighted sums of the squared coefficients of a record, and their distribution in simulations.

    Attributes:
        measured: sums over the record's coefficients.
        mean: means of the sums in simulations.
        covariance: covariance of the simulated ones over their means, including errors of the levels.
        fitted: covariance of the measured ones over the means if the model is right, given that its levels
            were fitted to the same record.
    """

    measured: Float[np.ndarray, " m"]
    mean: Float[np.ndarray, " m"]
    covariance: Float[np.ndarray, "m m"]
    fitted: Float[np.ndarray, "m m"]

    @classmethod
    def of(cls, stage: Stage, weights: Float[np.ndarray, "m bins"]) -> Law:
        """Law of the sums with these weights, each for a narrow bin of coefficients."""
        v, square, measured, _ = stage.sums
        edges = narrow_bins(stage.n)
        size = np.diff(edges)
        middle = edges[:-1] - 1 + size // 2
        q = np.reshape([stage.share(term, middle) for term in stage.powers], (-1, len(size)))
        # No power is more uncertain than 100 %, hence the 1 beside the Fisher information ½ Σ_j q_k q_l.
        information = 0.5 * (q * size) @ q.T
        errors = np.linalg.inv(information + np.eye(len(q)))
        mean = weights @ v
        known = 2.0 * (weights * square) @ weights.T / np.outer(mean, mean)
        slope = weights @ (q * v).T / mean[:, None]
        # The errors of the levels, L·score, are correlated with the record: their covariance with it is
        # slope·L, and that of the score is its Fisher information.
        followed = 2.0 * errors - errors @ information @ errors
        return cls(
            weights @ measured,
            mean,
            known + slope @ errors @ slope.T,
            known - slope @ followed @ slope.T + _ROUNDING * np.diag(np.diag(known)),
        )

    def quantile(self, probability: float) -> Float[np.ndarray, " m"]:
        """Quantile of the simulations' sums, χ² variates of as many degrees of freedom as fit."""
        dof = 2.0 / np.diag(self.covariance)
        return self.mean * chi2.ppf(probability, dof) / dof


@functools.lru_cache(maxsize=4)
def allan_weights(n: int, sizes: tuple[int, ...]) -> Float[np.ndarray, "m bins"]:
    """Weights w_j(m)/n of the squared coefficients of n samples in Allan variances, in narrow bins."""
    edges = narrow_bins(n)
    a = np.pi * 0.5 * (edges[1:] + edges[:-1] - 1) / (2.0 * n)
    weights = np.empty((len(sizes), len(a)))
    for row, m in zip(weights, sizes, strict=True):
        # Where the weight oscillates fast in j it is replaced by its mean.
        np.copyto(row, np.where(m * a > _FAST, 0.375, np.sin(m * a) ** 4))
        row *= 2.0 / (n * (m * np.sin(a)) ** 2)
    return weights


class Curve(NamedTuple):
    """A measured curve and the band in which 95 % of simulations lie.

    Attributes:
        place: cluster times [s] or frequencies [Hz].
        measured: Allan deviations [rate, SI], or one-sided densities [rate²/Hz, SI].
        low, median, high: 2.5, 50 and 97.5 % of simulations.
    """

    place: Float[np.ndarray, " m"]
    measured: Float[np.ndarray, " m"]
    low: Float[np.ndarray, " m"]
    median: Float[np.ndarray, " m"]
    high: Float[np.ndarray, " m"]


def summaries(stage: Stage) -> tuple[Curve, Curve]:
    """Allan deviation and power spectral density of a record, each with the band of its simulations."""
    n, rate = stage.n, stage.rate
    sizes, edges = cluster_sizes(n, rate, _PER_OCTAVE), octave_bins(n)
    inside = np.digitize(narrow_bins(n)[:-1], edges) == np.arange(1, len(edges))[:, None]
    curves = []
    for place, weights in (
        (sizes / rate, allan_weights(n, tuple(sizes.tolist()))),
        ((edges[:-1] + edges[1:] - 1) * rate / (4.0 * n), inside * (2.0 / rate / np.diff(edges))[:, None]),
    ):
        law = Law.of(stage, weights)
        curves.append(Curve(place, law.measured, *(law.quantile(p) for p in (0.025, 0.5, 0.975))))
    allan, density = curves
    return Curve(allan.place, *map(np.sqrt, allan[1:])), density

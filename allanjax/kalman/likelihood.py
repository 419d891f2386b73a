"""Exact Gaussian likelihood of samples under several noise models, by the innovations of their filters."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import jax
import numpy as np
from jaxtyping import Bool, Float

from allanjax.kalman.recursion import in_blocks, padded, padded_size, run_innovations, stacked
from allanjax.noise.model import Model

# The unknown constant of a record, beside a filter for noise about zero (de Jong 1991, Ann. Stat. 19:1073).
#
# A filter without the constant b is run over the samples and over ones. Innovations are linear in both, so
# that those of samples less b are e − b·e₁: what is known of b after k samples has the information Σ e₁²/s
# and the mean Σ e·e₁/s over it, cumulative sums. The covariances of the filter itself keep converging,
# which with a state for the constant they would not; and a constant of which nothing is known before costs
# no large number.


@dataclasses.dataclass(frozen=True, eq=False)
class Constant:
    """Constant after each sample, and the innovations of the samples without it.

    Attributes:
        value, variance: of the constant after each sample; the variance is infinite before the first.
        innovation, innovation_std: of the samples; NaN where there is none, or nothing predicts it.
        log_likelihood: of all samples [nats]; of a constant of which nothing is known before, the density
            of the differences of successive samples (which do not depend on it).
    """

    value: Float[np.ndarray, " n"]
    variance: Float[np.ndarray, " n"]
    innovation: Float[np.ndarray, " n"]
    innovation_std: Float[np.ndarray, " n"]
    log_likelihood: float

    @classmethod
    def of(
        cls,
        innovation: Float[np.ndarray, "n 2"],
        std: Float[np.ndarray, " n"],
        there: Bool[np.ndarray, " n"],
        prior_std: float | None,
        offset: float = 0.0,
    ) -> Constant:
        """Constant from the innovations of samples and ones.

        Args:
            innovation, std: of both columns, their common standard deviation.
            there: where there is a sample.
            prior_std: standard deviation of the constant about zero before the first sample; None if nothing
                is known, 0 if there is no constant.
            offset: what was subtracted from the samples; `value` is without it.
        """
        e, ones = innovation.T
        s = np.where(there, std, 1.0) ** 2
        known = prior_std == 0.0
        precision = 0.0 if prior_std is None or known else prior_std**-2.0
        with np.errstate(divide="ignore", invalid="ignore"):
            information = precision + np.cumsum(ones**2 / s)
            weighted = -offset * precision + np.cumsum(e * ones / s)
            value = np.where(information > 0.0, weighted / information, 0.0)
            variance = np.where(information > 0.0, 1.0 / information, np.inf)
        if known:
            value, variance = np.full(len(e), -offset), np.zeros(len(e))
        prior = (-offset, np.inf if prior_std is None else prior_std**2)
        before, uncertain = (
            np.concatenate([[p], x[:-1]]) for p, x in zip(prior, (value, variance), strict=True)
        )
        predicted = there & np.isfinite(uncertain)
        with np.errstate(invalid="ignore"):
            spread = np.sqrt(s + np.where(predicted, uncertain, 0.0) * ones**2)
        found = np.where(predicted, e - before * ones, np.nan)
        spread = np.where(predicted, spread, np.nan)
        terms = np.log(2.0 * math.pi * spread**2) + (found / spread) ** 2
        return cls(value, variance, found, spread, float(-0.5 * np.sum(terms[predicted])))


def innovations_under(
    models: Sequence[Model],
    z: Float[np.ndarray, " n"],
    rate: float,
    missing: Bool[np.ndarray, " n"] | None = None,
) -> tuple[Float[np.ndarray, "models n1"], Float[np.ndarray, "models n1"]]:
    """Innovations of the samples under each model, and their variances, except for the first sample.

    The mean of the samples is unknown; missing samples are left out.
    """
    n = len(z)
    there = np.ones(n, bool) if missing is None else ~missing
    spaces = [model.state_space(rate, duration=n / rate) for model in models]
    most = padded_size(spaces)
    systems = stacked([padded(space, np.zeros((0, space.size)), most) for space in spaces])
    found = jax.device_get(run_innovations(systems, in_blocks(z - z[there].mean(), missing)))
    each = [Constant.of(e[:n], std[:n], there, None) for e, std in zip(found.value, found.std, strict=True)]
    used = np.flatnonzero(there)[1:]
    return np.stack([c.innovation[used] for c in each]), np.stack([c.innovation_std[used] ** 2 for c in each])


def log_likelihoods(
    innovation: Float[np.ndarray, "models n1"], variance: Float[np.ndarray, "models n1"]
) -> Float[np.ndarray, " models"]:
    """Log-likelihood [nats] of each model, from its innovations; NaN if a sample has no variance."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return -0.5 * np.sum(np.log(2.0 * math.pi * variance) + innovation**2 / variance, axis=1)

"""Exact Gaussian likelihood of samples under several noise models, by the innovations of their filters."""

from __future__ import annotations

import math
from collections.abc import Sequence

import jax
import numpy as np
from jaxtyping import Bool, Float

from allanjax.kalman.constant import Constant
from allanjax.kalman.recursion import run_innovations
from allanjax.kalman.system import in_blocks, padded, room_for, stacked
from allanjax.noise.model import Model


def innovations_under(
    models: Sequence[Model],
    z: Float[np.ndarray, " n"],
    rate: float,
    missing: Bool[np.ndarray, " n"] | None = None,
) -> tuple[Float[np.ndarray, "models n1"], Float[np.ndarray, "models n1"]]:
    """Innovations of the samples under each model, and their variances, but for the first sample's.

    The mean of the samples is unknown, and nothing is known of it before; missing samples are left out.
    """
    n = len(z)
    there = np.ones(n, bool) if missing is None else ~missing
    spaces = [model.state_space(rate, duration=n / rate) for model in models]
    room = room_for(spaces)
    systems = stacked([padded(space, np.zeros((0, space.size)), room) for space in spaces])
    found = jax.device_get(run_innovations(systems, in_blocks(z - z[there].mean(), missing)))
    each = [Constant.of(e[:n], std[:n], there, None) for e, std in zip(found.value, found.std, strict=True)]
    seen = np.flatnonzero(there)[1:]
    return np.stack([c.innovation[seen] for c in each]), np.stack([c.innovation_std[seen] ** 2 for c in each])


def log_likelihoods(
    innovation: Float[np.ndarray, "models n1"], variance: Float[np.ndarray, "models n1"]
) -> Float[np.ndarray, " models"]:
    """Log-likelihood [nats] of each model, from its innovations; NaN if a sample has no variance."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return -0.5 * np.sum(np.log(2.0 * math.pi * variance) + innovation**2 / variance, axis=1)

"""Powers of noise terms of fixed shapes, fitted to levels that follow χ² laws about the sum of the terms.

Levels are those of a spectrum, or Allan variances at octaves. Many models are fitted in one batch.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

# Damping of a step, and the longest one in ln.
_DAMPING, _LONGEST = 0.01, 2.0


def power_fits(
    level: Float[np.ndarray, "*models m"],
    shape: Float[np.ndarray, " m"],
    rough: Float[np.ndarray, "*models m"],
    unit: Float[np.ndarray, "models p m"],
    start: Float[np.ndarray, "models p"] | None = None,
    used: Bool[np.ndarray, "models p"] | None = None,
    steps: int = 12,
) -> tuple[Float[np.ndarray, "models p"], Float[np.ndarray, " models"]]:
    """Most likely powers ≥ 0 of the terms of each model, and minus the log-likelihood [nats].

    Fisher scoring with the curvature of the deviances, in ln(p + s), s being one standard deviation in the
    smooth levels.

    Args:
        level: the levels, of all models or of each.
        shape: half the degrees of freedom of each; 0 for one that is left out.
        rough: smooth levels, a first guess.
        unit: levels of each term for unit power.
        start: powers to start from; by default each is the largest that nowhere exceeds the smooth levels.
        used: which terms are part of a model; all by default.
        steps: number of steps; the default suffices unless the terms do not describe the levels.
    """
    rough = rough[..., None, :]
    start = (rough / unit).min(axis=-1) if start is None else start
    used = np.ones(start.shape, bool) if used is None else used
    scale = 1.0 / np.sqrt(np.maximum((unit / rough) ** 2 @ shape, 1e-300))
    p, best, least = np.where(used, start, 0.0), np.where(used, start, 0.0), np.full(len(unit), np.inf)
    for _ in range(steps):
        mean = np.maximum(np.einsum("cp,cpm->cm", p, unit), 1e-300)
        value = (np.log(mean) + level / mean) @ shape
        better = value < least
        best[better], least = p[better], np.minimum(value, least)
        excess = np.maximum(level / mean, 1e-12) - 1.0
        apart = np.where(abs(excess) < 1e-4, 1e-4, excess)
        weight = shape * apart**2 / (2.0 * (apart - np.log1p(apart)))
        slope = unit / mean[:, None] * (p + scale)[..., None]
        gradient = np.einsum("cpm,cm->cp", slope, shape * excess)
        moves = used & ~((p <= 0.0) & (gradient < 0.0))
        slope *= moves[..., None]
        curvature = (slope * weight[:, None]) @ slope.swapaxes(1, 2)
        size = 1.0 / np.sqrt(np.maximum(np.einsum("cpp->cp", curvature), 1e-12))
        scaled = curvature * size[:, :, None] * size[:, None]
        scaled += np.eye(p.shape[1]) * np.where(moves, _DAMPING, 1.0)[:, None]
        move = size * np.linalg.solve(scaled, (gradient * moves * size)[..., None])[..., 0]
        p = np.maximum((p + scale) * np.exp(np.clip(move, -_LONGEST, _LONGEST)) - scale, 0.0)
    return best, least


def information(
    unit: Float[np.ndarray, "p m"], mean: Float[np.ndarray, " m"], shape: Float[np.ndarray, " m"]
) -> Float[np.ndarray, "p p"]:
    """Fisher information of levels with these means about the powers of terms."""
    relative = unit / mean
    return (relative * shape) @ relative.T


def bounds(information: Float[np.ndarray, "p p"], present: Bool[np.ndarray, " p"]) -> Float[np.ndarray, " p"]:
    """Cramér–Rao bound of the standard deviation of each power, if only it and those present are unknown."""
    found = np.empty(len(present))
    for k in range(len(present)):
        own = present | (np.arange(len(present)) == k)
        F, at = information[np.ix_(own, own)], own[:k].sum()
        size = np.sqrt(np.diag(F))
        values, vectors = np.linalg.eigh(F / np.outer(size, size))
        found[k] = np.sqrt((vectors[at] ** 2 / np.maximum(values, 1e-12)).sum()) / size[at]
    return found

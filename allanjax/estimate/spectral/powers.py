"""Powers of noise terms of fixed shapes, fitted to levels that follow χ² laws about the sum of the terms.

Levels are those of a spectrum, or Allan variances at octaves. Many models are fitted in one batch.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

# Damping of the first step, its least and largest values, its factor after each step that gains or loses; and
# the longest step in ln.
_DAMPING, _DAMPINGS, _LESS, _MORE, _LONGEST = 0.1, (0.01, 1e6), 0.25, 10.0, 2.0
# How many times what its next step should gain a model may still gain.
_GAINS = 10.0
# Fewest degrees of freedom of a level from which a ramp was removed.
_FEWEST = 1e-3


class Ramps(NamedTuple):
    """Ramps of unknown slope in a record, which are projected out of its levels under each model's noise.

    Attributes:
        cross: sums over the bin of each level of the coefficients times those of a ramp.
        gram: sums of the ramp's squared coefficients.
        present: which models have a ramp; the first axes of the methods' results.
    """

    cross: Float[np.ndarray, " m"]
    gram: Float[np.ndarray, " m"]
    present: Bool[np.ndarray, " models"]

    def removed(
        self,
        level: Float[np.ndarray, " m"],
        shape: Float[np.ndarray, " m"],
        mean: Float[np.ndarray, "models m"],
    ) -> tuple[Float[np.ndarray, "models m"], Float[np.ndarray, "models m"], Float[np.ndarray, " models"]]:
        """Levels less the ramps, half of their degrees of freedom, and the information about each slope."""
        slope, precision = self.slope(mean)
        beta, share = slope[:, None], (self.present / precision)[:, None]
        squares = 2.0 * shape * level - beta * (2.0 * self.cross) + beta**2 * self.gram
        dof = np.maximum(2.0 * shape - share * self.gram / mean, _FEWEST)
        return np.maximum(squares, 0.0) / dof, 0.5 * dof, precision

    def slope(
        self, mean: Float[np.ndarray, "models m"]
    ) -> tuple[Float[np.ndarray, " models"], Float[np.ndarray, " models"]]:
        """Slopes under noise of these levels, 0 without a ramp, and their information, 1 without."""
        inverse = 1.0 / mean
        precision = np.where(self.present, inverse @ self.gram, 1.0)
        return np.where(self.present, inverse @ self.cross / precision, 0.0), precision


@np.errstate(all="ignore")
def power_fits(
    level: Float[np.ndarray, "*models m"],
    shape: Float[np.ndarray, " m"],
    rough: Float[np.ndarray, "*models m"],
    unit: Float[np.ndarray, "models p m"],
    start: Float[np.ndarray, "models p"] | None = None,
    used: Bool[np.ndarray, "models p"] | None = None,
    steps: int = 30,
    ramps: Ramps | None = None,
    far: float = np.inf,
    tolerance: float = 1e-6,
) -> tuple[Float[np.ndarray, "models p"], Float[np.ndarray, " models"]]:
    """Most likely powers ≥ 0 of the terms of each model, and minus the log-likelihood [nats].

    Scoring with the mean of the expected and the observed curvature, damped (Levenberg–Marquardt), in
    ln(p + s), s being one standard deviation in the smooth levels. The likelihood is integrated over the
    slope of a ramp.

    Args:
        level: the levels, of all models or of each.
        shape: half the degrees of freedom of each; 0 for one that is left out.
        rough: smooth levels, a first guess.
        unit: levels of each term for unit power.
        start: powers to start from; by default each is the largest that nowhere exceeds the smooth levels.
        used: which terms are part of a model; all by default.
        steps: largest number of steps.
        ramps: which models have a ramp besides; none by default.
        far: models that will remain farther behind the best one than this [nats] are not fitted to the end.
        tolerance: the fit of a model ends if the next step would gain less than this [nats].
    """
    rough = rough[..., None, :]
    start = (rough / unit).min(axis=-1) if start is None else start
    used = np.ones(start.shape, bool) if used is None else used
    scale = 1.0 / np.sqrt(np.maximum((unit / rough) ** 2 @ shape, 1e-300))
    power, loss, going = np.where(used, start, 0.0), np.full(len(unit), np.inf), np.arange(len(unit))
    trial, damping, gradient = power.copy(), np.full(len(unit), _DAMPING), np.zeros(power.shape)
    curvature, own_unit = np.zeros((*power.shape, power.shape[1])), unit
    for _ in range(steps):
        own = ramps and ramps._replace(present=ramps.present[going])
        data = level if level.ndim == 1 else level[going]
        value, *slopes = _likelihood(data, shape, trial[going], own_unit, own)
        better = value < loss[going]
        best = (power, loss, gradient, curvature)
        for state, new in zip(best, (trial[going], value, *slopes), strict=True):
            state[going[better]] = new[better]
        damping[going] = np.clip(damping[going] * np.where(better, _LESS, _MORE), *_DAMPINGS)
        p, s, uphill = power[going], scale[going], gradient[going]
        reach = (p + s) * (used[going] & ~((p <= 0.0) & (uphill < 0.0)))
        bent = curvature[going] * reach[:, :, None] * reach[:, None]
        move, gain = _move(uphill * reach, bent, damping[going])
        trial[going] = np.maximum((p + s) * np.exp(np.clip(move, -_LONGEST, _LONGEST)) - s, 0.0)
        still = (gain > tolerance) & (loss[going] - _GAINS * gain < loss.min() + far)
        if not still.any():
            break
        if not still.all():
            going, own_unit = going[still], own_unit[still]
    return power, loss


def _likelihood(
    level: Float[np.ndarray, "*models m"],
    shape: Float[np.ndarray, " m"],
    power: Float[np.ndarray, "models p"],
    unit: Float[np.ndarray, "models p m"],
    ramps: Ramps | None,
) -> tuple[Float[np.ndarray, " models"], Float[np.ndarray, "models p"], Float[np.ndarray, "models p p"]]:
    """Minus the log-likelihood of each model, its gradient by the powers, uphill, and its curvature."""
    mean = np.maximum((power[:, None] @ unit)[:, 0], 1e-300)
    value = np.log(mean) @ shape
    if ramps is not None:
        level, shape, precision = ramps.removed(level, shape, mean)
        value += 0.5 * np.log(precision)
    inverse = 1.0 / mean
    ratio = level * inverse
    value += np.sum(ratio * shape, axis=1)
    relative = unit * inverse[:, None]
    gradient = (relative @ (shape * (ratio - 1.0))[..., None])[..., 0]
    # The mean of the expected and the observed one.
    weight = shape * (1.0 + ratio) / 2.0
    return value, gradient, (relative * weight[:, None]) @ relative.swapaxes(1, 2)


def _move(
    gradient: Float[np.ndarray, "models p"],
    curvature: Float[np.ndarray, "models p p"],
    damping: Float[np.ndarray, " models"],
) -> tuple[Float[np.ndarray, "models p"], Float[np.ndarray, " models"]]:
    """Damped Newton step of each model, and what it should gain [nats]."""
    size = 1.0 / np.sqrt(np.maximum(np.einsum("cpp->cp", curvature), 1e-12))
    scaled = curvature * size[:, :, None] * size[:, None]
    # Powers that do not move have no curvature.
    still = np.einsum("cpp->cp", scaled) < 0.5
    scaled += np.eye(gradient.shape[1]) * (damping[:, None] + still)[:, None]
    move = size * np.linalg.solve(scaled, (gradient * size)[..., None])[..., 0]
    return move, np.sum(gradient * move, axis=1)


def information(
    unit: Float[np.ndarray, "... p m"], mean: Float[np.ndarray, "... m"], shape: Float[np.ndarray, " m"]
) -> Float[np.ndarray, "... p p"]:
    """Fisher information of levels with these means about the powers of terms."""
    relative = unit / mean[..., None, :]
    return (relative * shape) @ relative.swapaxes(-1, -2)


def bounds(information: Float[np.ndarray, "p p"], present: Bool[np.ndarray, " p"]) -> Float[np.ndarray, " p"]:
    """Cramér–Rao bound of the standard deviation of each power, if only it and those present are unknown."""
    return np.array([bound(information, gradient, present) for gradient in np.eye(len(present))])


def bound(
    information: Float[np.ndarray, "p p"], gradient: Float[np.ndarray, " p"], present: Bool[np.ndarray, " p"]
) -> float:
    """Cramér–Rao bound of the standard deviation of a quantity with this gradient by the powers.

    Unknown are the powers that it depends on, and those present.
    """
    own = present | (gradient != 0.0)
    F = information[np.ix_(own, own)]
    size = np.sqrt(np.diag(F))
    values, vectors = np.linalg.eigh(F / np.outer(size, size))
    turned = (gradient[own] / size) @ vectors
    return float(np.sqrt((turned**2 / np.maximum(values, 1e-12)).sum()))

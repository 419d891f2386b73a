"""Powers of noise terms of fixed shapes, many models in one batch, and the evidence for sets of terms.

The levels that are fitted follow χ² laws about the sum of the terms: those of a spectrum, or Allan variances
at octaves. The evidence is Whittle's likelihood integrated over the amplitudes of each set.

An amplitude c has the prior 1/[(c + c0)·Y], uniform where the term could not be detected, and uniform in ln c
above (the modified Jeffreys prior, Gregory 2005, ApJ 631:1198). Its scale c0 is the amplitude whose power
would be one standard deviation in these data; Y = ln(1 + 10⁴): four decades. So a term's Occam factor
depends on how sharply the data determine it, not on units, and is two to five nats. (The scale of a ramp's
prior is the standard deviation of the ramp under each set's own noise.)

The integral over the powers is Laplace's approximation, with the exact Fisher information; the factor of
each amplitude along its own axis is a quadrature, which keeps it right next to and at the boundary c = 0. A
correlation time is integrated over a grid, uniform in its logarithm. The sign of a ramp is averaged.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Bool, Float, Int

from allanjax.spectrum.cosine import SpectralStatistics

# Damping of the first step, its least and largest values, its factor after each step that gains or loses; and
# the longest step in ln.
_DAMPING, _DAMPINGS, _LESS, _MORE, _LONGEST = 0.1, (0.01, 1e6), 0.25, 10.0, 2.0
# How many times what its next step should gain a model may still gain.
_GAINS = 10.0
# Fewest degrees of freedom of a level from which a ramp was removed.
_FEWEST = 1e-3
_Levels: TypeAlias = Float[np.ndarray, " m"]
_OfModels: TypeAlias = Float[np.ndarray, " models"]
_ModelLevels: TypeAlias = Float[np.ndarray, "models m"]
_Powers: TypeAlias = Float[np.ndarray, "models p"]
_Square: TypeAlias = Float[np.ndarray, "models p p"]
_Flags: TypeAlias = Bool[np.ndarray, "models p"]
_Column: TypeAlias = Float[np.ndarray, "k 1"]
_Points: TypeAlias = Float[np.ndarray, "k points"]


class Ramps(NamedTuple):
    """Ramps of unknown slope in a record, which are projected out of its levels under each model's noise.

    In the bin of each level `cross` is the sum of the coefficients times those of a ramp, `gram` that of the
    ramp's squared coefficients; `present` tells which models have a ramp.
    """

    cross: _Levels
    gram: _Levels
    present: Bool[np.ndarray, " models"]

    def removed(
        self, level: _Levels, shape: _Levels, mean: _ModelLevels
    ) -> tuple[_ModelLevels, _ModelLevels, _OfModels]:
        """Levels less the ramps, half of their degrees of freedom, and the information about each slope."""
        slope, precision = self.slope(mean)
        beta, share = slope[:, None], (self.present / precision)[:, None]
        squares = 2.0 * shape * level - beta * (2.0 * self.cross) + beta**2 * self.gram
        dof = np.maximum(2.0 * shape - share * self.gram / mean, _FEWEST)
        return np.maximum(squares, 0.0) / dof, 0.5 * dof, precision

    def slope(self, mean: _ModelLevels) -> tuple[_OfModels, _OfModels]:
        """Slopes under noise of these levels, 0 without a ramp, and their information, 1 without."""
        inverse = 1.0 / mean
        precision = np.where(self.present, inverse @ self.gram, 1.0)
        return np.where(self.present, inverse @ self.cross / precision, 0.0), precision


@np.errstate(all="ignore")
def power_fits(
    level: Float[np.ndarray, "*models m"],
    shape: _Levels,
    rough: Float[np.ndarray, "*models m"],
    unit: Float[np.ndarray, "models p m"],
    start: _Powers | None = None,
    used: _Flags | None = None,
    steps: int = 30,
    ramps: Ramps | None = None,
    far: float = np.inf,
    tolerance: float = 1e-6,
) -> tuple[_Powers, _OfModels]:
    """Most likely powers ≥ 0 of the terms of each model, and minus the log-likelihood [nats].

    Scoring with the mean of the expected and the observed curvature, damped (Levenberg–Marquardt), in
    ln(p + s), s being one standard deviation in the smooth levels. The likelihood is integrated over the
    slope of a ramp.

    Half the degrees of freedom of a level is its `shape`, 0 for one that is left out; `rough` are smooth
    levels, and `unit` those of each term for unit power. By default every term is used, and its start is the
    largest power that nowhere exceeds the smooth levels. The fit of a model ends if the next step would gain
    less than the tolerance [nats], or if the model will remain farther behind the best one than `far` [nats].
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
    shape: _Levels,
    power: _Powers,
    unit: Float[np.ndarray, "models p m"],
    ramps: Ramps | None,
) -> tuple[_OfModels, _Powers, _Square]:
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


def _move(gradient: _Powers, curvature: _Square, damping: _OfModels) -> tuple[_Powers, _OfModels]:
    """Damped Newton step of each model, and what it should gain [nats]."""
    size = 1.0 / np.sqrt(np.maximum(np.einsum("cpp->cp", curvature), 1e-12))
    scaled = curvature * size[:, :, None] * size[:, None]
    # Powers that do not move have no curvature.
    still = np.einsum("cpp->cp", scaled) < 0.5
    scaled += np.eye(gradient.shape[1]) * (damping[:, None] + still)[:, None]
    move = size * np.linalg.solve(scaled, (gradient * size)[..., None])[..., 0]
    return move, np.sum(gradient * move, axis=1)


def information(
    unit: Float[np.ndarray, "... p m"], mean: Float[np.ndarray, "... m"], shape: _Levels
) -> Float[np.ndarray, "... p p"]:
    """Fisher information of levels with these means about the powers of terms."""
    relative = unit / mean[..., None, :]
    return (relative * shape) @ relative.swapaxes(-1, -2)


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


#: Largest amplitude that the prior allows, over the prior's scale, and the normalization ln(1 + that).
PRIOR_RANGE = 1e4
LOG_PRIOR_RANGE = np.log1p(PRIOR_RANGE)
# Steps to the maximum of the likelihood, of which few sets need more than ten.
_STEPS = 60
# Points of the integral over one amplitude: within 10⁻⁷ nats.
_QUADRATURE = 48
# Sets fitted together, which bounds the memory; how far behind the best of them a fit is not finished; and
# what a step gains at the end of the others [nats].
_BLOCK, _FAR, _TOLERANCE = 512, 200.0, 1e-5


class TermSets(NamedTuple):
    """Sets of terms: the `columns` of expected levels that each may have, which are `used`, and ramps.

    The columns are those of terms without a free shape, and at last one for each term with a free shape. Sets
    whose evidence is known have its logarithm [nats], and the most likely powers of their terms.
    """

    columns: Int[np.ndarray, "sets places"]
    used: _Flags
    ramp: Bool[np.ndarray, " sets"]
    log_evidence: Any = None
    power: Any = None

    def of(self, rows: Any) -> TermSets:
        """Some of the sets."""
        return TermSets._make(None if x is None else x[rows] for x in self)


def term_sets(fixed: int, grid: int, ramp: bool) -> TermSets:
    """All sets: first those of terms without a free shape, then each of them with every shape of a grid."""
    choices = np.array(list(itertools.product([False, True], repeat=fixed + 1)))
    choices = choices if ramp else choices[~choices[:, -1]]
    plain = choices[choices[:, :-1].any(axis=1)]
    rows = np.concatenate([plain, np.repeat(choices, grid, axis=0)])
    shape = np.append(np.zeros(len(plain), int), np.tile(np.arange(grid), len(choices)))
    columns = np.column_stack([np.tile(np.arange(fixed), (len(rows), 1)), fixed + shape])
    used = np.column_stack([rows[:, :-1], np.arange(len(rows)) >= len(plain)])
    places = fixed + (grid > 0)
    return TermSets(columns[:, :places], used[:, :places], rows[:, -1])


def evidence(
    sets: TermSets,
    columns: Float[np.ndarray, "columns m"],
    statistics: SpectralStatistics,
    size: _Levels,
    far: float = _FAR,
) -> TermSets:
    """Sets of terms with their evidence for an axis, starting from their powers, if they have any.

    Of sets that are farther behind the best one than `far` [nats] the evidence is too low by some amount.
    `columns` are expected levels [rate²] of terms of unit amplitude. Where the model has an error of its own,
    the statistics and the size of the bins are multiplied by the share of their weight that bins keep.
    """
    around, squares = (np.convolve(x, np.ones(7), "same") for x in (size, statistics.squares))
    smooth = np.where(around > 0.0, squares / np.maximum(around, 1e-300), 1.0)
    level, shape = np.where(size > 0.0, statistics.squares / np.maximum(size, 1e-300), smooth), size / 2.0
    scale = np.sum(shape * (columns / smooth) ** 2, axis=1) ** -0.25
    found = []
    for begin in range(0, len(sets.ramp), _BLOCK):
        some = sets.of(slice(begin, begin + _BLOCK))
        unit, ramps = columns[some.columns], Ramps(statistics.cross, statistics.gram, some.ramp)
        power, _ = power_fits(
            level, shape, smooth, unit, some.power, some.used, _STEPS, ramps, far, _TOLERANCE
        )
        mean = np.maximum((power[:, None] @ unit)[:, 0], 1e-300)
        left, freedom, _ = ramps.removed(level, shape, mean)
        slope = ((unit / mean[:, None]) @ (freedom * (left / mean - 1.0))[..., None])[..., 0]
        value = _around(power, some.used, information(unit, mean, shape), slope, scale[some.columns])
        value[some.ramp] += _of_ramps(*(x[some.ramp] for x in ramps.slope(mean)))
        value -= (np.log(mean) + level / mean) @ shape
        found.append((value, power))
    values, powers = map(np.concatenate, zip(*found, strict=True))
    return sets._replace(log_evidence=values, power=powers)


def _around(power: _Powers, used: _Flags, information: _Square, slope: _Powers, scale: _Powers) -> _OfModels:
    """ln ∫ prior · exp(ln L − max ln L) over the amplitudes of each set, by Laplace's approximation."""
    present, own = used & (power > 0.0), np.einsum("spp->sp", information)
    scaled = information / np.sqrt(own[:, :, None] * own[:, None])
    scaled = np.where(present[:, :, None] & present[:, None], scaled, 0.0)
    scaled += np.eye(used.shape[1]) * np.where(present, 1e-12, 1.0)[:, None]
    # Each power is less certain when the others are unknown too; the determinant holds their correlation.
    spread = np.einsum("spp->sp", np.linalg.inv(scaled))
    value = -0.5 * (np.linalg.slogdet(scaled)[1] + np.sum(np.log(spread), axis=1))
    slope = np.where(present, 0.0, np.minimum(slope, 0.0))
    h, p, g, c0 = (x[used][:, None] for x in (own / spread, power, slope, scale))
    low, high = np.sqrt(np.maximum(p - 8.0 / np.sqrt(h), 0.0)), np.sqrt(p + 8.0 / np.sqrt(h))
    factors = np.zeros(power.shape)
    factors[used] = over_prior(lambda c: g * c**2 - 0.5 * h * (c**2 - p) ** 2, low, high, c0)
    return value + factors.sum(axis=1)


def _of_ramps(slope: _OfModels, precision: _OfModels) -> _OfModels:
    """ln ∫ prior(R) cosh(R·slope·precision) exp(−½ precision R²) dR for ramps of either sign."""
    R0, u = abs(slope)[:, None], precision[:, None]
    std, p = 1.0 / np.sqrt(u), R0 * u
    exponent = lambda R: np.logaddexp(R * p, -R * p) - np.log(2.0) - 0.5 * u * R**2  # noqa: E731
    return over_prior(exponent, np.maximum(R0 - 8.0 * std, 0.0), R0 + 8.0 * std, std)


def over_prior(
    exponent: Callable[[_Points], _Points], low: _Column, high: _Column, scale: _Column
) -> _OfModels:
    """ln ∫ prior(c) exp(exponent(c)) dc between two ends, beyond which there is nothing."""
    # Uniform in y = ln(1 + c/scale), as the prior is.
    bottom, top = np.log1p(low / scale), np.log1p(high / scale)
    step = (top - bottom) / _QUADRATURE
    logs = exponent(scale * np.expm1(bottom + step * (np.arange(_QUADRATURE) + 0.5)))
    return np.logaddexp.reduce(logs, axis=1) + np.log(step[:, 0] / LOG_PRIOR_RANGE)

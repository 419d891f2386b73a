"""The evidence for sets of noise terms: Whittle's likelihood integrated over the amplitudes of each set.

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

from allanjax.estimate.spectral.powers import Ramps, information, power_fits
from allanjax.spectrum.cosine import SpectralStatistics

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

_PerSet: TypeAlias = Float[np.ndarray, " sets"]
_Places: TypeAlias = Float[np.ndarray, "sets places"]
_Flags: TypeAlias = Bool[np.ndarray, "sets places"]
_Square: TypeAlias = Float[np.ndarray, "sets places places"]
_Column: TypeAlias = Float[np.ndarray, "k 1"]
_Points: TypeAlias = Float[np.ndarray, "k points"]


class TermSets(NamedTuple):
    """Sets of terms: the `columns` of expected levels that each may have, which are `used`, and ramps.

    The columns are those of terms without a free shape, and at last one for each term with a free shape. Sets
    whose evidence is known have its logarithm [nats], and the most likely powers of their terms.
    """

    columns: Int[np.ndarray, "sets places"]
    used: Bool[np.ndarray, "sets places"]
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
    size: Float[np.ndarray, " m"],
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


def _around(power: _Places, used: _Flags, information: _Square, slope: _Places, scale: _Places) -> _PerSet:
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


def _of_ramps(slope: Float[np.ndarray, " k"], precision: Float[np.ndarray, " k"]) -> Float[np.ndarray, " k"]:
    """ln ∫ prior(R) cosh(R·slope·precision) exp(−½ precision R²) dR for ramps of either sign."""
    R0, u = abs(slope)[:, None], precision[:, None]
    std, p = 1.0 / np.sqrt(u), R0 * u
    exponent = lambda R: np.logaddexp(R * p, -R * p) - np.log(2.0) - 0.5 * u * R**2  # noqa: E731
    return over_prior(exponent, np.maximum(R0 - 8.0 * std, 0.0), R0 + 8.0 * std, std)


def over_prior(
    exponent: Callable[[_Points], _Points], low: _Column, high: _Column, scale: _Column
) -> Float[np.ndarray, " k"]:
    """ln ∫ prior(c) exp(exponent(c)) dc between two ends, beyond which there is nothing."""
    # Uniform in y = ln(1 + c/scale), as the prior is.
    bottom, top = np.log1p(low / scale), np.log1p(high / scale)
    step = (top - bottom) / _QUADRATURE
    logs = exponent(scale * np.expm1(bottom + step * (np.arange(_QUADRATURE) + 0.5)))
    return np.logaddexp.reduce(logs, axis=1) + np.log(step[:, 0] / LOG_PRIOR_RANGE)

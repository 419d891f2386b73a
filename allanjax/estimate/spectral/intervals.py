"""Inference from the levels of a spectrum: covariance, and tests of hypothetical powers of each term.

The method is that of `inference.infer`. The levels are independent, and their relative scatter is the same
under all hypotheses, so that many hypotheses are one batch of small matrices.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.optimize import nnls
from scipy.special import gammaln, ndtri

from allanjax.estimate.gls import Solution
from allanjax.estimate.inference import CHANCE, DOWN, FAR_ENOUGH, UP, Inference, gamma_score


class Tangent(NamedTuple):
    """Levels of a spectrum around a fit: independent, χ² around expectations that are linear in the shapes.

    Attributes:
        base: levels of each term of unit amplitude at the solution [rate²].
        by_shape: their derivatives by the free shapes there, in ln.
        owner: term of each free shape.
        level: the measured levels [rate²].
        degrees: degrees of freedom of each level; 0 for one that does not count.
        per_octave: number of levels in the octave around each, which share an error of the model.
    """

    base: Float[np.ndarray, "terms m"]
    by_shape: Float[np.ndarray, "terms m shapes"]
    owner: Int[np.ndarray, " shapes"]
    level: Float[np.ndarray, " m"]
    degrees: Float[np.ndarray, " m"]
    per_octave: Float[np.ndarray, " m"]

    def inference(
        self, free: Bool[np.ndarray, " terms"], active: Bool[np.ndarray, " terms"], solution: Solution
    ) -> Inference:
        """Inference around a solution of one axis, as `inference.infer` returns it for several.

        Args:
            free: terms whose power is estimated.
            active: terms in use.
            solution: the solution, each array [1, …].
        """
        power, error = np.asarray(solution.power)[0], float(np.asarray(solution.power_error)[0])
        known = self.degrees > 0.0
        here = self._replace(base=self.base[:, known], by_shape=self.by_shape[:, known])
        level, degrees, per_octave = (x[known] for x in (self.level, self.degrees, self.per_octave))
        weight = 1.0 / (2.0 / degrees + error**2 * per_octave)
        tests = _Tests(here.base, here.by_shape, self.owner, level, weight, free, active, power)
        each = [tests.of_term(k) for k in range(len(power))]
        estimated = np.concatenate([active & free, tests.has_shape])
        # Beyond this power one of the levels would be improbably small, whatever the other terms.
        half = degrees / 2.0
        least = (np.log(CHANCE / (2.0 * len(half))) + gammaln(half + 1.0)) / half - np.log(half)
        least += error * ndtri(CHANCE / (2.0 * len(half)))
        with np.errstate(divide="ignore", over="ignore"):
            ceiling = np.min(np.where(here.base > 0.0, level / here.base * np.exp(-least), np.inf), axis=1)
        power_at, pivot_at = (np.stack(rows)[None] for rows in zip(*each, strict=True))
        covariance = tests.covariance(power, estimated)
        found: Any = (covariance[None], np.zeros((1, 0)), power_at, pivot_at, ceiling[None])
        return Inference(*found)


class _Tests(NamedTuple):
    """Score tests of the terms' powers; see `Tangent`. `weight`: inverse relative variances of the levels."""

    base: Float[np.ndarray, "terms m"]
    by_shape: Float[np.ndarray, "terms m shapes"]
    owner: Int[np.ndarray, " shapes"]
    level: Float[np.ndarray, " m"]
    weight: Float[np.ndarray, " m"]
    free: Bool[np.ndarray, " terms"]
    active: Bool[np.ndarray, " terms"]
    power: Float[np.ndarray, " terms"]

    @property
    def has_shape(self) -> Bool[np.ndarray, " shapes"]:
        """Which shapes the data determine; a term without power has none."""
        return self.active[self.owner] & (self.power[self.owner] > 0.0)

    def _normal(
        self, power: Float[np.ndarray, "b terms"], estimated: Bool[np.ndarray, "b params"]
    ) -> tuple[
        Float[np.ndarray, "b m"], Float[np.ndarray, "b params m"], Float[np.ndarray, "b params params"]
    ]:
        """Expectations, their relative slopes, and the inverse information about what is estimated."""
        mean = np.maximum(power @ self.base, 1e-300)
        moved = np.tensordot(power, self.by_shape, 1).swapaxes(1, 2)
        slopes = np.concatenate([np.broadcast_to(self.base, (len(power), *self.base.shape)), moved], axis=1)
        slopes = slopes / mean[:, None] * estimated[..., None]
        root = slopes * np.sqrt(self.weight)
        size = np.sqrt(np.sum(root**2, axis=2))
        size = np.where(size > 0.0, size, 1.0)[..., None]
        root /= size
        # What is not estimated gets a unit on the diagonal, and no variance.
        normal = root @ root.swapaxes(1, 2) + np.eye(len(size[0])) * (1.0 - estimated + 1e-12)[:, None]
        inverse = np.linalg.inv(normal) / (size * size.swapaxes(1, 2))
        return mean, slopes, inverse * (estimated[..., None] & estimated[:, None])

    def covariance(
        self, power: Float[np.ndarray, " terms"], estimated: Bool[np.ndarray, " params"]
    ) -> Float[np.ndarray, "params params"]:
        """Covariance of the powers and shapes that are estimated."""
        return self._normal(power[None], estimated[None])[2][0]

    def scores(
        self, k: int, power: Float[np.ndarray, "b terms"], estimated: Bool[np.ndarray, "b params"]
    ) -> Float[np.ndarray, " b"]:
        """Distances of the data from hypothetical powers as normal scores, for the power of term k."""
        mean, slopes, inverse = self._normal(power, estimated)
        # The weight of each residual in a one-step estimate of this power.
        through = np.einsum("bp,bpm->bm", inverse[:, k], slopes)
        step = (through * (self.level / mean - 1.0)) @ self.weight
        variance = inverse[:, k, k]
        # Levels are independent: the third cumulant of χ² is a sum. See `inference` for the skewness.
        skewness = 2.0 * through**3 @ self.weight / variance**1.5
        skewness = np.minimum(skewness, 2.0 * np.sqrt(variance) / np.maximum(power[:, k], 1e-300))
        return np.asarray(gamma_score(step / np.sqrt(variance), skewness))

    def of_term(self, k: int) -> tuple[Float[np.ndarray, " grid"], Float[np.ndarray, " grid"]]:
        """Hypothetical powers of a term, and the data's distance from each; NaN where none was needed."""
        power, active, owner = self.power, self.active, self.owner
        alone, own = np.arange(len(power)) == k, owner == k
        tested = np.concatenate([(active & self.free) | alone, self.has_shape & ~own])
        local = self.covariance(power, tested)
        sd = np.sqrt(local[k, k])
        slope = np.where(tested[: len(power)], local[: len(power), k] / local[k, k], 0.0)
        down, up = np.maximum(power[k] + DOWN * sd, 0.0), power[k] + UP * sd
        # The only term cannot vanish altogether.
        v = np.maximum(down, 1e-9 * power[k])
        others = np.maximum(power + slope * (v - power[k])[:, None], 0.05 * power)
        at = np.where(alone, v[:, None], np.where(active, others, 0.0))
        below = self.scores(k, at, self._estimated(tested, own, at, self.has_shape[None]))
        above = np.full(len(UP), np.nan)
        last = power * active
        for i, v_i in enumerate(np.maximum(up, 1e-9 * power[k])):
            # The other powers are fitted anew.
            last = self._profiled(np.where(alone, v_i, last), active & self.free & ~alone)
            there = self.has_shape & (last[owner] > 0.0)
            estimated = self._estimated(tested, own, last[None], there[None])
            above[i] = self.scores(k, last[None], estimated)[0]
            if not above[i] - min(above[0], 0.0) >= FAR_ENOUGH:
                break
        return np.concatenate([down, up]), np.concatenate([below, above])

    def _estimated(
        self,
        tested: Bool[np.ndarray, " params"],
        own: Bool[np.ndarray, " shapes"],
        power: Float[np.ndarray, "b terms"],
        others: Bool[np.ndarray, "_ shapes"],
    ) -> Bool[np.ndarray, "b params"]:
        """Which parameters are estimated; the term's own shapes are only if it has power."""
        shapes = np.where(own, (power[:, self.owner] > 0.0) & self.active[self.owner], others)
        terms = np.broadcast_to(tested[: power.shape[1]], power.shape)
        return np.concatenate([terms, shapes], axis=1)

    def _profiled(
        self, power: Float[np.ndarray, " terms"], allowed: Bool[np.ndarray, " terms"]
    ) -> Float[np.ndarray, " terms"]:
        """Powers, of which the allowed ones are fitted to the data."""
        if not allowed.any():
            return power
        columns = self.base / np.maximum(power @ self.base, 1e-300) * np.sqrt(self.weight)
        data = self.level / np.maximum(power @ self.base, 1e-300) * np.sqrt(self.weight)
        size = np.sqrt(np.sum(columns[allowed] ** 2, axis=1))
        fitted, found = power.copy(), data - power[~allowed] @ columns[~allowed]
        fitted[allowed] = nnls((columns[allowed] / size[:, None]).T, found)[0] / size
        return fitted

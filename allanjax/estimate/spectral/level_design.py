"""Designs of levels of the cosine spectrum, χ² around their expectations."""

from __future__ import annotations

import abc

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Shaped

from allanjax.base.linalg import CholeskyWhitened
from allanjax.estimate.design import Design
from allanjax.estimate.spectral.levels import padded


class LevelDesign(Design):
    """Model of levels of a spectrum, which are independent, each χ² around its expectation.

    A relative error of the model is taken to be common to the bins of an octave.

    Attributes:
        moves: which shapes there are; the others only pad.
        per_octave: number of bins in the octave around each bin.
    """

    moves: Bool[np.ndarray, " shapes"]
    per_octave: Float[np.ndarray, " m"]

    @property
    @abc.abstractmethod
    def degrees(self) -> Float[np.ndarray, " m"]:
        """Degrees of freedom of each level; 0 of those that only pad."""

    @property
    @abc.abstractmethod
    def room(self) -> int:
        """Number of terms that arrays have room for."""

    @property
    def movable(self) -> Bool[np.ndarray, " shapes"]:
        return self.moves

    @property
    def has_shapes(self) -> bool:
        return True

    def padded_estimates(self, V: Float[np.ndarray, "axes m"]) -> Float[np.ndarray, "axes capacity"]:
        return padded(V, len(self.per_octave), 1.0)

    def padded_terms(self, values: Shaped[np.ndarray, "... terms"]) -> Shaped[np.ndarray, "... slots"]:
        return padded(values, self.room, 0)

    def padded_shapes(self, values: Float[np.ndarray, "... shapes"]) -> Float[np.ndarray, "... slots"]:
        return padded(values, len(self.moves), 0)

    def mean(self, power: Float[Array, " terms"], means: Float[Array, "terms m"]) -> Float[Array, " m"]:
        there = jnp.arange(means.shape[1]) < self.rows
        return jnp.where(there, power @ means, 1.0)

    def products(self, shape: Float[Array, " shapes"]) -> Array:
        return self.means(shape)

    def covariance(self, power: Float[Array, " terms"], products: Array) -> Array:
        return self.mean(power, products) ** 2 / jnp.maximum(self.degrees / 2.0, 1e-9)

    def variances(self, covariance: Array) -> Float[Array, " m"]:
        return covariance

    def whiten(
        self,
        covariance: Array,
        mean: Float[Array, " m"],
        power_error: Float[Array, ""],
        X: Float[Array, "m k"],
    ) -> CholeskyWhitened:
        relative = covariance / mean**2 + power_error**2 * self.per_octave
        known = jnp.asarray(self.degrees) / 2.0 > 0.0
        scale = jnp.where(known, 1.0 / jnp.sqrt(relative), 0.0)
        return CholeskyWhitened(X * scale[:, None], 0.5 * jnp.sum(jnp.where(known, jnp.log(relative), 0.0)))

    def whiten_and_weigh(
        self,
        covariance: Array,
        mean: Float[Array, " m"],
        power_error: Float[Array, ""],
        X: Float[Array, "m k"],
    ) -> tuple[Float[Array, "m k"], Float[Array, "k m"]]:
        scale = self.whiten(covariance, mean, power_error, jnp.ones((len(mean), 1))).values
        return X * scale, (X * scale**2).T

    @property
    def weight(self) -> Float[Array, " m"]:
        return jnp.asarray(self.degrees)


class TangentDesign(LevelDesign):
    """Levels whose expectations are linear in the shapes around a solution.

    Attributes:
        base: levels of each term of unit amplitude at the solution.
        by_shape: their derivatives by the shapes there.
        centre: the shapes there.
        degrees_of_freedom: of each level.
    """

    base: Float[ArrayLike, "terms m"]
    by_shape: Float[ArrayLike, "terms m shapes"]
    centre: Float[ArrayLike, " shapes"]
    degrees_of_freedom: Float[np.ndarray, " m"]

    @property
    def degrees(self) -> Float[np.ndarray, " m"]:
        return self.degrees_of_freedom

    @property
    def room(self) -> int:
        return int(np.shape(self.base)[0])

    def means(self, shape: Float[Array, " shapes"]) -> Float[Array, "terms m"]:
        return jnp.asarray(self.base) + jnp.asarray(self.by_shape) @ (shape - jnp.asarray(self.centre))

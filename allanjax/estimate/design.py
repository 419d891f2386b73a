"""Statistical model of estimates of power: their means and covariance as functions of the parameters.

Amplitudes enter by their squares v (the "power" of a term): the mean is linear in them, the covariance
bilinear. Other free parameters ("shapes") enter by ln(value − lower bound). The estimates are Allan variances
at given cluster sizes (`AllanDesign`) or levels of the cosine spectrum (`SpectralDesign`).
"""

from __future__ import annotations

import abc
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Shaped

from allanjax.base.errors import FitError
from allanjax.base.linalg import CholeskyWhitened
from allanjax.noise.model import Model, ModelParameter
from allanjax.noise.notation import ModelLike, as_model
from allanjax.noise.terms import NoiseTerm, Parameter
from allanjax.record.columns import Column
from allanjax.record.recording import Axis


class FreeShape(NamedTuple):
    """Free parameter that is no amplitude: of which of the terms, its declaration, and whether it is fitted.

    Those of lines are not: their frequencies are known from the record.
    """

    term: int
    parameter: Parameter
    moves: bool


class Design(eqx.Module):
    """Model of the estimates as the inference sees it: see the module's docstring.

    Attributes:
        owner: the term that each of the free parameters other than amplitudes ("shapes") is of.
        terms: number of terms.
        rows: number of estimates.
    """

    owner: Int[np.ndarray, " shapes"]
    terms: Int[np.ndarray, ""]
    rows: Int[np.ndarray, ""]

    @property
    @abc.abstractmethod
    def movable(self) -> Bool[np.ndarray, " shapes"]:
        """Which shapes are fitted to these estimates."""

    @property
    @abc.abstractmethod
    def has_shapes(self) -> bool:
        """Whether there may be any; known when a program is compiled."""

    @abc.abstractmethod
    def padded_estimates(self, V: Float[np.ndarray, "axes m"]) -> Float[np.ndarray, "axes capacity"]:
        """Estimates in arrays of the design's length."""

    @abc.abstractmethod
    def padded_terms(self, values: Shaped[np.ndarray, "... terms"]) -> Shaped[np.ndarray, "... slots"]:
        """Values of terms in arrays of the design's length."""

    @abc.abstractmethod
    def padded_shapes(self, values: Float[np.ndarray, "... shapes"]) -> Float[np.ndarray, "... slots"]:
        """Values of shapes in arrays of the design's length."""

    @abc.abstractmethod
    def means(self, shape: Float[Array, " shapes"]) -> Float[Array, "terms m"]:
        """Expectation of the estimates for each term of unit amplitude."""

    def mean(self, power: Float[Array, " terms"], means: Float[Array, "terms m"]) -> Float[Array, " m"]:
        """Expectation of the estimates for these powers of the terms."""
        return power @ means

    @abc.abstractmethod
    def products(self, shape: Float[Array, " shapes"]) -> Array:
        """Part of the covariance that depends on the shapes alone."""

    @abc.abstractmethod
    def covariance(self, power: Float[Array, " terms"], products: Array) -> Array:
        """Covariance of the estimates for these powers of the terms: a matrix, or variances alone."""

    @abc.abstractmethod
    def variances(self, covariance: Array) -> Float[Array, " m"]:
        """Variances of the estimates, from their covariance."""

    @abc.abstractmethod
    def whiten(
        self,
        covariance: Array,
        mean: Float[Array, " m"],
        power_error: Float[Array, ""],
        X: Float[Array, "m k"],
    ) -> CholeskyWhitened:
        """Whitened columns X for relative residuals with a relative error `power_error` of the model."""

    def whiten_and_weigh(
        self,
        covariance: Array,
        mean: Float[Array, " m"],
        power_error: Float[Array, ""],
        X: Float[Array, "m k"],
    ) -> tuple[Float[Array, "m k"], Float[Array, "k m"]]:
        """Whitened columns L⁻¹X, and X'C⁻¹, for relative residuals of covariance C = LL'."""
        k = X.shape[1]
        both = jnp.concatenate([X, jnp.eye(len(mean))], axis=1)
        values = self.whiten(covariance, mean, power_error, both).values
        return values[:, :k], values[:, :k].T @ values[:, k:]

    @property
    @abc.abstractmethod
    def weight(self) -> Float[Array, " m"]:
        """Rough relative weight of each estimate, where no model is known."""


def model_to_fit(model: ModelLike, axes: Iterable[Axis | Column] = (), with_response: bool = False) -> Model:
    """Model as `as_model` makes it, for a fit to these axes.

    Raises:
        FitError: the model has a response, and that can not be fitted here.
    """
    found = as_model(model, axes)
    if found.response is not None and not with_response:
        raise FitError(
            f"a response ({found.response!r}) is estimated from the spectrum of a recording only: give "
            'objective="whittle" (--objective whittle), or leave it out'
        )
    return found


def of_owners(model: Model, of_terms: Bool[np.ndarray, "... terms"]) -> Bool[np.ndarray, "... owners"]:
    """Flags of what has parameters: of the terms, then of the response if any term that passes it has one."""
    if model.response is None:
        return of_terms
    passing = of_terms[..., np.array(model.inside, bool)]
    return np.concatenate([of_terms, passing.any(axis=-1, keepdims=True)], axis=-1)


def free_shapes(model: Model) -> tuple[ModelParameter, ...]:
    """Free parameters of a model that are not amplitudes."""
    return tuple(p for p in model.parameters if p.free and not p.parameter.is_amplitude)


def free_powers(model: Model) -> Bool[np.ndarray, " terms"]:
    """Which terms of a model have an amplitude to be estimated."""
    return np.array([term.has_free_amplitude for term in model.terms])


def with_shapes(
    terms: Sequence[NoiseTerm], shapes: Sequence[FreeShape], values: Float[Array, " shapes"]
) -> list[NoiseTerm]:
    """Terms with these transformed shapes."""
    found = list(terms)
    for shape, u in zip(shapes, values, strict=True):
        value = shape.parameter.lower + jnp.exp(u)
        found[shape.term] = found[shape.term].replace(**{shape.parameter.name: value})
    return found

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
    """Model of the estimates as the solver and the inference see it: see the module's docstring.

    Attributes:
        shapes: the free parameters that are not amplitudes.
        owner: the term that each of these is of.
        terms: number of terms.
        rows: number of estimates.
    """

    shapes: tuple[FreeShape, ...] = eqx.field(static=True)
    owner: Int[np.ndarray, " shapes"]
    terms: Int[np.ndarray, ""]
    rows: Int[np.ndarray, ""]

    @property
    def movable(self) -> Bool[np.ndarray, " shapes"]:
        """Which shapes are fitted to these estimates."""
        return np.array([shape.moves for shape in self.shapes], bool)

    def padded_estimates(self, V: Float[np.ndarray, "axes m"]) -> Float[np.ndarray, "axes capacity"]:
        """Estimates in arrays of the design's length."""
        return V

    def padded_terms(self, values: Shaped[np.ndarray, "... terms"]) -> Shaped[np.ndarray, "... slots"]:
        """Values of terms in arrays of the design's length."""
        return values

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
    def residual(self, ratio: Float[Array, " m"], variance: Float[Array, " m"]) -> Float[Array, " m"]:
        """Residuals for χ² of the ratios of estimates to their means, with zero mean and this variance."""

    @abc.abstractmethod
    def whiten(
        self,
        covariance: Array,
        mean: Float[Array, " m"],
        power_error: Float[Array, ""],
        X: Float[Array, "m k"],
    ) -> CholeskyWhitened:
        """Whitened columns X for relative residuals with a relative error `power_error` of the model."""

    @abc.abstractmethod
    def cost(
        self,
        V: Float[Array, " m"],
        mean: Float[Array, " m"],
        covariance: Array,
        power_error: Float[Array, ""],
        misfit: Float[Array, ""],
    ) -> Float[Array, ""]:
        """Minus twice the log-likelihood, to choose among solutions; `misfit` is χ² + ln det."""

    @property
    @abc.abstractmethod
    def weight(self) -> Float[Array, " m"]:
        """Rough relative weight of each estimate, where no model is known."""

    @property
    @abc.abstractmethod
    def count(self) -> Float[Array, ""]:
        """Number of estimates, as far as they have degrees of freedom."""


def model_to_fit(model: ModelLike, axes: Iterable[Axis | Column] = ()) -> Model:
    """Model as `as_model` makes it, for a fit to these axes.

    Raises:
        FitError: the model has a response.
    """
    found = as_model(model, axes)
    if found.response is not None:
        raise FitError(
            f"a fit does not estimate a response yet ({found.response!r}): fit the terms without it, or "
            "simulate the model"
        )
    return found


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

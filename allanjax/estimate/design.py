"""Statistical model of estimates of power: their means and covariance as functions of the parameters.

Amplitudes enter by their squares v (the "power" of a term): the mean is linear in them, the covariance
bilinear. Other free parameters ("shapes") enter by ln(value − lower bound). The estimates are Allan variances
at given cluster sizes (`AllanDesign`) or levels of the cosine spectrum (`SpectralDesign`).
"""

from __future__ import annotations

import abc

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from allanjax.allan.covariance import AllanCovariance
from allanjax.base.linalg import CholeskyWhitened, whiten
from allanjax.noise.model import Model, ModelParameter
from allanjax.noise.terms import NoiseTerm

# Ridge added to the covariance, relative to its diagonal: rounding and quadrature errors stay below it, and
# no direction of the data is trusted more. Oscillating terms need more quadrature nodes, and have larger
# errors.
_RIDGE = 1e-4
_OSCILLATING_RIDGE = 5e-3
_OSCILLATING_ORDER = 32


class _Constants(eqx.Module):
    """Parts of the terms without a free shape, computed once for all iterations."""

    means: tuple[Float[Array, " m"] | None, ...]
    kernels: tuple[Float[Array, "pairs lags"] | None, ...]
    products: Float[Array, "pairs terms terms"] | None


class Design(eqx.Module):
    """Model of the estimates as the solver and the inference see it: see the module's docstring."""

    model: eqx.AbstractVar[Model]

    @property
    def shapes(self) -> tuple[ModelParameter, ...]:
        """Free parameters that are not amplitudes."""
        return free_shapes(self.model)

    @property
    def free(self) -> Bool[np.ndarray, " terms"]:
        """Which terms have an amplitude to be estimated."""
        return np.array([term.has_free_amplitude for term in self.model.terms])

    @property
    def movable(self) -> Bool[np.ndarray, " shapes"]:
        """Which shapes are fitted to these estimates: frequencies of lines are known from the record."""
        return np.array([not self.model.terms[p.term].deterministic for p in self.shapes], bool)

    def units(self, shape: Float[Array, " shapes"]) -> list[NoiseTerm]:
        """Terms of unit amplitude with these shapes."""
        terms = [t.with_unit_amplitude() for t in self.model.terms]
        for p, u in zip(self.shapes, shape, strict=True):
            value = p.parameter.lower + jnp.exp(u)
            terms[p.term] = terms[p.term].replace(**{p.parameter.name: value})
        return terms

    @abc.abstractmethod
    def means(self, shape: Float[Array, " shapes"]) -> Float[Array, "terms m"]:
        """Expectation of the estimates for each term of unit amplitude."""

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
        """Number of estimates."""


class AllanDesign(Design):
    """Model of the Allan variances at the cluster sizes of `geometry`."""

    model: Model = eqx.field(static=True)
    geometry: AllanCovariance
    octaves: Float[np.ndarray, "m m"]
    ridge: Float[np.ndarray, ""]
    constants: _Constants

    @classmethod
    def of(
        cls,
        model: Model,
        n: int,
        rate: float,
        sizes: Int[np.ndarray, " m"],
        strides: Int[np.ndarray, " m"] | None = None,
    ) -> AllanDesign:
        """Design of a noise model for Allan variances at these cluster sizes of n samples.

        `strides`: samples between the starts of successive clusters, see `AllanCovariance.of`.
        """
        model = model.sampled(rate)
        oscillates = any(term.oscillates for term in model.terms)
        order = {"order": _OSCILLATING_ORDER} if oscillates else {}
        geometry = AllanCovariance.of(n, rate, sizes, strides=strides, **order)
        distance = np.abs(np.subtract.outer(*2 * [np.log2(geometry.sizes)]))
        ridge = np.asarray(_OSCILLATING_RIDGE if oscillates else _RIDGE)
        return cls(model, geometry, np.exp(-distance), ridge, _constants(model, geometry))

    def means(self, shape: Float[Array, " shapes"]) -> Float[Array, "terms m"]:
        """Allan variance of each term of unit amplitude."""
        T = self.geometry.cluster_time
        pairs = zip(self.units(shape), self.constants.means, strict=True)
        return jnp.stack([t.allan_variance(T) if b is None else b for t, b in pairs])

    def products(self, shape: Float[Array, " shapes"]) -> Float[Array, "pairs terms terms"]:
        """Covariance of the estimates as a bilinear form in the powers, for each pair of estimates."""
        if self.constants.products is not None:
            return self.constants.products
        units = self.units(shape)
        pairs = zip(units, self.constants.kernels, strict=True)
        kernels = [self.geometry.kernel(t) if k is None else k for t, k in pairs]
        return _products(units, self.geometry, kernels)

    def covariance(
        self, power: Float[Array, " terms"], products: Float[Array, "pairs terms terms"]
    ) -> Float[Array, "m m"]:
        """Covariance of the estimates for these powers of the terms."""
        return self.geometry.symmetric(jnp.einsum("pkj,k,j->p", products, power, power))

    def variances(self, covariance: Array) -> Float[Array, " m"]:
        return jnp.diag(covariance)

    def residual(self, ratio: Float[Array, " m"], variance: Float[Array, " m"]) -> Float[Array, " m"]:
        """Relative residuals as they are: normal scores of each would not be jointly normal."""
        return ratio - 1.0

    def whiten(
        self,
        covariance: Array,
        mean: Float[Array, " m"],
        power_error: Float[Array, ""],
        X: Float[Array, "m k"],
    ) -> CholeskyWhitened:
        """Whitened columns, with a model error that is correlated over about an octave."""
        relative = covariance / (mean[:, None] * mean)
        relative += self.ridge * jnp.diag(jnp.diag(relative)) + power_error**2 * self.octaves
        return whiten(relative, X)

    def cost(
        self,
        V: Float[Array, " m"],
        mean: Float[Array, " m"],
        covariance: Array,
        power_error: Float[Array, ""],
        misfit: Float[Array, ""],
    ) -> Float[Array, ""]:
        """Minus twice the log-likelihood of a normal law."""
        return misfit + 2.0 * jnp.sum(jnp.log(mean))

    @property
    def weight(self) -> Float[Array, " m"]:
        """Weight proportional to the number of clusters."""
        return 1.0 / self.geometry.cluster_time

    @property
    def count(self) -> Float[Array, ""]:
        return jnp.asarray(float(len(self.geometry.sizes)))


def free_shapes(model: Model) -> tuple[ModelParameter, ...]:
    """Free parameters of a model that are not amplitudes."""
    return tuple(p for p in model.parameters if p.free and not p.parameter.is_amplitude)


def _products(
    terms: list[NoiseTerm], geometry: AllanCovariance, kernels: list[Float[Array, "pairs lags"]]
) -> Float[Array, "pairs terms terms"]:
    """Covariance of the estimates as a bilinear form in the powers, from the kernels of the terms."""
    # A line or a ramp is the same in every record: its own square does not scatter. That of a narrow-band
    # term does, but its kernel oscillates too fast for the quadrature.
    own_scatter = np.array([not (t.deterministic or t.narrow_band) for t in terms])
    stacked = jnp.stack(kernels)
    products = jnp.einsum("kpl,pl,jpl->pkj", stacked, geometry.weights, stacked)
    products = products * (own_scatter[:, None] | own_scatter)
    for k, term in enumerate(terms):
        if term.narrow_band:
            products = products.at[:, k, k].set(_narrow_band_scatter(term, geometry))
    return products


def _narrow_band_scatter(term: NoiseTerm, geometry: AllanCovariance) -> Float[Array, " pairs"]:
    """Covariance of the estimates of a narrow-band term alone.

    Its power fluctuates as one, which all estimates share; an estimate's own overlaps of differences add as
    much once more (70/36 − 1 when clusters outlast the oscillation), and long clusters see it as white noise.
    """
    i, j = geometry.pairs
    mean = term.allan_variance(geometry.cluster_time)
    common = term.power_scatter(geometry.duration)
    clusters = geometry.cluster_time[i] / geometry.duration
    return mean[i] * mean[j] * (common + jnp.where(i == j, common + 1.5 * clusters, 0.0))


@eqx.filter_jit
def _constants(model: Model, geometry: AllanCovariance) -> _Constants:
    """Means, kernels and products of the terms without a free shape."""
    with_shape = {p.term for p in free_shapes(model)}
    units = [t.with_unit_amplitude() for t in model.terms]
    steady = [k not in with_shape for k in range(len(units))]
    T = geometry.cluster_time
    means = tuple(t.allan_variance(T) if s else None for t, s in zip(units, steady, strict=True))
    if all(steady):
        return _Constants(means, (), _products(units, geometry, [geometry.kernel(t) for t in units]))
    kernels = tuple(geometry.kernel(t) if s else None for t, s in zip(units, steady, strict=True))
    return _Constants(means, kernels, None)

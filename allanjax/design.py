"""A model at given cluster sizes: the means and the covariance of the Allan variances as functions of parameters.

Amplitudes enter by their squares v (the "power" of a term): the mean is linear in them, the covariance
bilinear. Other free parameters ("shapes") enter by ln(value − lower bound).
"""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from allanjax.covariance import AllanCovariance
from allanjax.model import Model, ModelParameter
from allanjax.terms import NoiseTerm

# Relative to the estimates' own variance: rounding and quadrature errors stay below it, and no direction
# of the data is trusted more than that.
_RIDGE = 1e-4


class _Constants(eqx.Module):
    """What no iteration need repeat: parts of the terms whose shape is not free."""

    means: tuple[Float[Array, " m"] | None, ...]
    kernels: tuple[Float[Array, "pairs lags"] | None, ...]
    products: Float[Array, "pairs terms terms"] | None


class Design(eqx.Module):
    """See the module's docstring."""

    model: Model = eqx.field(static=True)
    geometry: AllanCovariance
    octaves: Float[np.ndarray, "m m"]
    constants: _Constants

    @classmethod
    def of(cls, model: Model, geometry: AllanCovariance) -> Design:
        """The design of a model (as sampled) for overlapping Allan variances of this geometry."""
        distance = np.abs(np.subtract.outer(*2 * [np.log2(geometry.sizes)]))
        return cls(model, geometry, np.exp(-distance), _constants(model, geometry))

    @property
    def shapes(self) -> tuple[ModelParameter, ...]:
        """The free parameters that are not amplitudes."""
        return free_shapes(self.model)

    def _units(self, shape: Float[Array, " shapes"]) -> list[NoiseTerm]:
        """The terms with unit amplitude at these shapes."""
        terms = [_unit(t) for t in self.model.terms]
        for p, u in zip(self.shapes, shape, strict=True):
            value = p.parameter.lower + jnp.exp(u)
            terms[p.term] = terms[p.term].replace(**{p.parameter.name: value})
        return terms

    def means(self, shape: Float[Array, " shapes"]) -> Float[Array, "terms m"]:
        """Allan variance of each term with unit amplitude."""
        T = self.geometry.cluster_time
        pairs = zip(self._units(shape), self.constants.means, strict=True)
        return jnp.stack([t.allan_variance(T) if b is None else b for t, b in pairs])

    def products(self, shape: Float[Array, " shapes"]) -> Float[Array, "pairs terms terms"]:
        """Covariance of the estimates as a bilinear form in the powers, for each pair of estimates."""
        if self.constants.products is not None:
            return self.constants.products
        pairs = zip(self._units(shape), self.constants.kernels, strict=True)
        return _products(
            self.model, self.geometry, [self.geometry.kernel(t) if k is None else k for t, k in pairs]
        )

    def covariance(
        self, power: Float[Array, " terms"], products: Float[Array, "pairs terms terms"]
    ) -> Float[Array, "m m"]:
        """Covariance of the estimates where each term has this power."""
        return self.geometry.symmetric(jnp.einsum("pkj,k,j->p", products, power, power))

    def relative(
        self, covariance: Float[Array, "m m"], mean: Float[Array, " m"], discrepancy: Float[Array, ""]
    ) -> Float[Array, "m m"]:
        """Covariance of V/mean, with a relative model error correlated over about an octave."""
        relative = covariance / (mean[:, None] * mean)
        return relative + _RIDGE * jnp.diag(jnp.diag(relative)) + discrepancy**2 * self.octaves


def free_shapes(model: Model) -> tuple[ModelParameter, ...]:
    """The free parameters of a model that are not amplitudes."""
    return tuple(p for p in model.parameters if p.free and p.parameter.kind != "amplitude")


def _unit(term: NoiseTerm) -> NoiseTerm:
    return term.replace(**{term.parameters()[0].name: 1.0})


def _products(
    model: Model, geometry: AllanCovariance, kernels: list[Float[Array, "pairs lags"]]
) -> Float[Array, "pairs terms terms"]:
    # A line or a ramp is the same in every record: its own square does not scatter.
    steady = np.array([t.deterministic for t in model.terms])
    stacked = jnp.stack(kernels)
    products = jnp.einsum("kpl,pl,jpl->pkj", stacked, geometry.weights, stacked)
    return products * ~(steady[:, None] & steady)


@eqx.filter_jit
def _constants(model: Model, geometry: AllanCovariance) -> _Constants:
    with_shape = {p.term for p in free_shapes(model)}
    units = [None if k in with_shape else _unit(t) for k, t in enumerate(model.terms)]
    means = tuple(None if t is None else t.allan_variance(geometry.cluster_time) for t in units)
    kernels = tuple(None if t is None else geometry.kernel(t) for t in units)
    if with_shape:
        return _Constants(means, kernels, None)
    return _Constants(means, (), _products(model, geometry, list(kernels)))

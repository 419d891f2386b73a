"""Design of a fit to levels of the cosine spectrum: their expectations and scatter under a model."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import gammaln
from jaxtyping import Array, Float

from allanjax.base.chi_squared import exact_cube_root_score
from allanjax.base.linalg import CholeskyWhitened
from allanjax.estimate.design import Design, FreeShape, free_shapes, with_shapes
from allanjax.noise.model import Model
from allanjax.spectrum.cosine import Bins


class SpectralDesign(Design):
    """Model of levels of the cosine spectrum, χ² with `dof` degrees of freedom around their expectations.

    Deterministic terms have been projected out of the levels, at the cost of degrees of freedom, and are no
    part of `model`. A relative error of the model is taken to be common to the bins of an octave.
    """

    model: Model = eqx.field(static=True)
    bins: Bins
    dof: Float[np.ndarray, " m"]
    per_octave: Float[np.ndarray, " m"]
    constants: tuple[Float[Array, " m"] | None, ...]

    @classmethod
    def of(cls, model: Model, bins: Bins, dof: Float[np.ndarray, " m"]) -> SpectralDesign:
        """Design of a noise model of random terms only."""
        model = model.sampled(bins.rate)
        return cls(
            shapes=tuple(FreeShape(p.term, p.parameter, True) for p in free_shapes(model)),
            owner=np.array([p.term for p in free_shapes(model)], int),
            terms=np.asarray(len(model)),
            rows=np.asarray(len(dof)),
            model=model,
            bins=bins,
            dof=dof,
            per_octave=bins_per_octave(bins),
            constants=_constants(model, bins),
        )

    def means(self, shape: Float[Array, " shapes"]) -> Float[Array, "terms m"]:
        units = with_shapes([t.with_unit_amplitude() for t in self.model.terms], self.shapes, shape)
        pairs = zip(units, self.constants, strict=True)
        return jnp.stack([self.bins.expected(t) if b is None else b for t, b in pairs])

    def products(self, shape: Float[Array, " shapes"]) -> Array:
        return self.means(shape)

    def covariance(self, power: Float[Array, " terms"], products: Array) -> Array:
        return 2.0 * (power @ products) ** 2 / jnp.maximum(self.dof, 1e-9)

    def variances(self, covariance: Array) -> Float[Array, " m"]:
        return covariance

    def residual(self, ratio: Float[Array, " m"], variance: Float[Array, " m"]) -> Float[Array, " m"]:
        return exact_cube_root_score(ratio, self.dof) * jnp.sqrt(variance)

    def whiten(
        self,
        covariance: Array,
        mean: Float[Array, " m"],
        power_error: Float[Array, ""],
        X: Float[Array, "m k"],
    ) -> CholeskyWhitened:
        relative = covariance / mean**2 + power_error**2 * self.per_octave
        known = jnp.asarray(self.dof) > 0.0
        scale = jnp.where(known, 1.0 / jnp.sqrt(relative), 0.0)
        return CholeskyWhitened(X * scale[:, None], 0.5 * jnp.sum(jnp.where(known, jnp.log(relative), 0.0)))

    def cost(
        self,
        V: Float[Array, " m"],
        mean: Float[Array, " m"],
        covariance: Array,
        power_error: Float[Array, ""],
        misfit: Float[Array, ""],
    ) -> Float[Array, ""]:
        """Minus twice the exact log-likelihood of χ² laws."""
        known = jnp.asarray(self.dof) > 0.0
        shape = 1.0 / jnp.where(known, covariance / mean**2 + power_error**2 * self.per_octave, 1.0)
        log_density = shape * (jnp.log(shape * V / mean) - V / mean) - gammaln(shape) - jnp.log(V)
        return -2.0 * jnp.sum(jnp.where(known, log_density, 0.0))

    @property
    def weight(self) -> Float[Array, " m"]:
        return jnp.asarray(self.dof)

    @property
    def count(self) -> Float[Array, ""]:
        return jnp.sum(jnp.minimum(self.dof, 1.0))


@eqx.filter_jit
def _constants(model: Model, bins: Bins) -> tuple[Float[Array, " m"] | None, ...]:
    """Expectations of the terms whose shape is not free, with unit amplitude."""
    with_shape = {p.term for p in free_shapes(model)}
    return tuple(
        None if k in with_shape else bins.expected(t.with_unit_amplitude()) for k, t in enumerate(model.terms)
    )


def bins_per_octave(bins: Bins) -> Float[np.ndarray, " m"]:
    """Number of bins in the octave around each bin."""
    f = bins.frequency
    inside = abs(np.log2(f[:, None] / f)) <= 0.5
    return (inside & (bins.size > 0)).sum(axis=1).astype(float)

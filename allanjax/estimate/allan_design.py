"""Design of a fit to Allan variances: their expectations and covariance under a model."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int, Shaped

from allanjax.allan.covariance import AllanCovariance
from allanjax.base.linalg import CholeskyWhitened, whiten
from allanjax.estimate.design import Design, FreeShape, free_shapes, with_shapes
from allanjax.noise.model import Model
from allanjax.noise.process import Process, numbers_as_data
from allanjax.noise.terms import NoiseTerm, basic_terms

# Ridge added to the covariance, relative to its diagonal: rounding and quadrature errors stay below it, and
# no direction of the data is trusted more. Oscillating terms need more quadrature nodes, and have larger
# errors.
_RIDGE = 1e-4
_OSCILLATING_RIDGE = 5e-3
_OSCILLATING_ORDER = 32
# Terms whose rows every Allan design has, so that any choice among them is data.
_BASIC = tuple(term.with_unit_amplitude() for term in basic_terms())


class _Constants(NamedTuple):
    """Parts of the terms without a free shape, computed once for all iterations; zero for the others."""

    means: Float[Array, "basis m"]
    kernels: Float[Array, "basis lags pairs"] | None
    products: Float[Array, "basis basis pairs"]


class AllanDesign(Design):
    """Model of Allan variances at the cluster sizes of `geometry`, or of wavelet variances at its levels.

    Lengths, rates, cluster sizes, and which of the basic terms the model has, are data. Other terms are part
    of the structure, not their values: a program is compiled once for each set of these.

    Attributes:
        shapes: the free parameters that are not amplitudes.
        others: the terms that are not basic ones, of unit amplitude; free shapes are None.
        columns: row of each term among the basic ones and these.
    """

    shapes: tuple[FreeShape, ...] = eqx.field(static=True)
    geometry: AllanCovariance
    octaves: Float[np.ndarray, "m m"]
    ridge: Float[np.ndarray, ""]
    others: tuple[NoiseTerm, ...]
    columns: Int[np.ndarray, " terms"]
    constants: _Constants

    @classmethod
    def of(
        cls,
        model: Model,
        n: int,
        rate: float,
        sizes: Int[np.ndarray, " m"],
        strides: Int[np.ndarray, " m"] | None = None,
        capacity: tuple[int, int] = (0, 0),
    ) -> AllanDesign:
        """Design of a noise model for Allan variances at these cluster sizes of n samples.

        `strides`: samples between the starts of successive clusters, see `AllanCovariance.of`. Arrays
        have a `capacity` of so many cluster sizes and terms at least: compiled functions serve others, too.
        """
        oscillates = any(term.oscillates for term in model.terms)
        order = {"order": _OSCILLATING_ORDER} if oscillates else {}
        geometry = AllanCovariance.of(n, rate, sizes, strides=strides, capacity=capacity[0], **order)
        return cls.of_geometry(model, rate, geometry, capacity[1])

    @classmethod
    def of_geometry(cls, model: Model, rate: float, geometry: AllanCovariance, slots: int = 0) -> AllanDesign:
        """Design of a noise model for the estimates of a quadrature, with room for so many terms at least."""
        others: list[NoiseTerm] = []
        columns = np.full(max(slots, len(model)), -1)
        for k, term in enumerate(model.sampled(rate).terms):
            row = [type(basic) for basic in _BASIC].index(type(term)) if _is_basic(term) else -1
            if row < 0 or row in columns:
                row = len(_BASIC) + len(others)
                others.append(_structure(term))
            columns[k] = row
        shapes = tuple(
            FreeShape(int(columns[p.term]) - len(_BASIC), p.parameter, not model.terms[p.term].deterministic)
            for p in free_shapes(model)
        )
        oscillates = any(term.oscillates for term in model.terms)
        distance = np.abs(np.subtract.outer(*2 * [np.log2(geometry.sizes)]))
        # What pads is beyond all rows.
        columns = np.where(columns < 0, len(_BASIC) + len(others), columns)
        return cls(
            shapes=shapes,
            owner=np.array([p.term for p in free_shapes(model)], int),
            terms=np.asarray(len(model)),
            rows=geometry.count,
            geometry=geometry,
            octaves=np.exp(-distance),
            ridge=np.asarray(_OSCILLATING_RIDGE if oscillates else _RIDGE),
            others=tuple(others),
            columns=columns,
            constants=_constants(tuple(others), shapes, columns, geometry),
        )

    @property
    def movable(self) -> Bool[np.ndarray, " shapes"]:
        return np.array([shape.moves for shape in self.shapes], bool)

    @property
    def has_shapes(self) -> bool:
        return bool(self.movable.any())

    def padded_estimates(self, V: Float[np.ndarray, "axes m"]) -> Float[np.ndarray, "axes capacity"]:
        more = np.shape(self.geometry.sizes)[0] - V.shape[1]
        return np.pad(V, ((0, 0), (0, more)), constant_values=1.0)

    def padded_terms(self, values: Shaped[np.ndarray, "... terms"]) -> Shaped[np.ndarray, "... slots"]:
        more = np.shape(self.columns)[0] - values.shape[-1]
        return np.pad(values, [(0, 0)] * (values.ndim - 1) + [(0, more)])

    def padded_shapes(self, values: Float[np.ndarray, "... shapes"]) -> Float[np.ndarray, "... slots"]:
        return values

    def means(self, shape: Float[Array, " shapes"]) -> Float[Array, "terms m"]:
        """Allan variance of each term of unit amplitude."""
        means = jnp.asarray(self.constants.means)
        if not self.shapes:
            return means
        for k, term in self._moving(shape).items():
            means = means.at[k].set(self.geometry.mean(term))
        return _chosen(means, self.columns)

    def mean(self, power: Float[Array, " terms"], means: Float[Array, "terms m"]) -> Float[Array, " m"]:
        """Expected Allan variances; one where there is no estimate."""
        return self.geometry.known(power @ means, 1.0)

    def products(self, shape: Float[Array, " shapes"]) -> Float[Array, "terms terms pairs"]:
        """Covariance of the estimates as a bilinear form in the powers, for each pair of estimates."""
        products = jnp.asarray(self.constants.products)
        if not self.shapes:
            return products
        moving, rows = self._moving(shape), np.array(list(self._moving(shape)))

        def of_moving(part: AllanCovariance, kernels: Array) -> Array:
            own = jnp.stack([part.kernel(term) for term in moving.values()])
            return _products(own, kernels.at[rows].set(own), part)

        found = self.geometry.over_pairs(of_moving, jnp.asarray(self.constants.kernels))
        products = products.at[rows].set(found).at[:, rows].set(found.swapaxes(0, 1))
        terms = [moving.get(k, t) for k, t in enumerate((*_BASIC, *self.others))]
        return _bilinear(terms, self.geometry, products, self.columns)

    def covariance(
        self, power: Float[Array, " terms"], products: Float[Array, "terms terms pairs"]
    ) -> Float[Array, "m m"]:
        """Covariance of the estimates for these powers of the terms."""
        by_pair = products.reshape(-1, products.shape[-1])
        return self.geometry.symmetric(jnp.outer(power, power).ravel() @ by_pair)

    def variances(self, covariance: Array) -> Float[Array, " m"]:
        return jnp.diag(covariance)

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
        return whiten(relative, X, self.rows)

    @property
    def weight(self) -> Float[Array, " m"]:
        """Weight proportional to the number of clusters."""
        return self.geometry.known(1.0 / self.geometry.cluster_time, 0.0)

    def _moving(self, shape: Float[Array, " shapes"]) -> dict[int, NoiseTerm]:
        """Terms with free shapes, which they have here, by their row among all."""
        terms = with_shapes(self.others, self.shapes, shape)
        return {len(_BASIC) + k: terms[k] for k in sorted({s.term for s in self.shapes})}


def _is_basic(term: NoiseTerm) -> bool:
    """Whether a term is one of the basic ones, flicker noise without a cutoff."""
    return type(term) in {type(basic) for basic in _BASIC} and not term.oscillates


def _structure(term: NoiseTerm) -> NoiseTerm:
    """Term of unit amplitude whose free shapes are None and whose held ones are arrays, to be data."""
    held: dict[str, Any] = {}
    for p in term.parameters()[1:]:
        value = getattr(term, p.name)
        if term.is_free(p):
            held[p.name] = None
        elif np.isfinite(value):
            held[p.name] = np.asarray(value, float)
    return term.replace(**held, held=frozenset()).with_unit_amplitude()


@eqx.filter_jit
def _constants(
    others: tuple[NoiseTerm, ...],
    shapes: tuple[FreeShape, ...],
    columns: Int[ArrayLike, " terms"],
    geometry: AllanCovariance,
) -> _Constants:
    """Means, kernels and products of the terms without a free shape."""
    terms = (*_BASIC, *others)
    moving = {len(_BASIC) + shape.term for shape in shapes}

    def of_part(part: AllanCovariance) -> tuple[Array, Array | None]:
        nothing = jnp.zeros(part.lags.shape)
        kernels = jnp.stack([nothing if k in moving else part.kernel(t) for k, t in enumerate(terms)])
        return _products(kernels, kernels, part), kernels if moving else None

    products, kernels = geometry.over_pairs(of_part)
    nothing = jnp.zeros(geometry.cluster_time.shape)
    means = jnp.stack([nothing if k in moving else geometry.mean(t) for k, t in enumerate(terms)])
    if moving:
        return _Constants(means, kernels, products)
    return _Constants(_chosen(means, columns), None, _bilinear(terms, geometry, products, columns))


def moments_behind(
    model: Model, geometry: AllanCovariance
) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, " m"]]:
    """Expectation and variance of Allan variances under a sampled model with values, response included."""
    mean, variance = jax.device_get(_moments_behind(numbers_as_data(model.seen), geometry))
    rows = int(geometry.count)
    return mean[:rows], variance[:rows]


@eqx.filter_jit
def _moments_behind(
    seen: tuple[Process, ...], geometry: AllanCovariance
) -> tuple[Float[Array, " capacity"], Float[Array, " capacity"]]:
    def of_part(part: AllanCovariance) -> Array:
        kernels = jnp.stack([part.kernel(process) for process in seen])
        return _products(kernels, kernels, part)

    products = _bilinear(seen, geometry, geometry.over_pairs(of_part), np.arange(len(seen)))
    mean = sum(geometry.mean(process) for process in seen)
    return jnp.asarray(mean), jnp.diag(geometry.symmetric(jnp.sum(products, axis=(0, 1))))


def _products(
    some: Float[Array, "some lags pairs"], every: Float[Array, "basis lags pairs"], part: AllanCovariance
) -> Float[Array, "some basis pairs"]:
    """Sums over the lags of the products of two terms' kernels."""
    return jnp.sum((some * part.weights)[:, None] * every, axis=2)


def _bilinear(
    terms: Sequence[Process],
    geometry: AllanCovariance,
    products: Float[Array, "basis basis pairs"],
    columns: Int[ArrayLike, " terms"],
) -> Float[Array, "terms terms pairs"]:
    """Covariance of the estimates as a bilinear form in the powers of a model's terms, from all products."""
    # A line or a ramp is the same in every record: its own square does not scatter. That of a narrow-band
    # term does, but its kernel oscillates too fast for the quadrature.
    own_scatter = np.array([not (t.deterministic or t.narrow_band) for t in terms])
    products = products * (own_scatter[:, None] | own_scatter)[..., None]
    for k, term in enumerate(terms):
        if term.narrow_band:
            products = products.at[k, k].set(_narrow_band_scatter(term, geometry))
    return _chosen(_chosen(products, columns).swapaxes(0, 1), columns)


def _chosen(rows: Float[Array, "basis ..."], columns: Int[ArrayLike, " terms"]) -> Float[Array, "terms ..."]:
    """Rows of a model's terms among those of all; zero where there is no term."""
    return rows.at[jnp.asarray(columns)].get(mode="fill", fill_value=0.0)


def _narrow_band_scatter(term: Process, geometry: AllanCovariance) -> Float[Array, " pairs"]:
    """Covariance of the estimates of a narrow-band term alone.

    Its power fluctuates as one, which all estimates share; an estimate's own overlaps of differences add as
    much once more (70/36 − 1 when clusters outlast the oscillation), and long clusters see it as white noise.
    """
    i, j = geometry.pairs
    mean = geometry.mean(term)
    common = term.power_scatter(geometry.duration)
    clusters = geometry.cluster_time[i] / geometry.duration
    return mean[i] * mean[j] * (common + jnp.where(i == j, common + 1.5 * clusters, 0.0))

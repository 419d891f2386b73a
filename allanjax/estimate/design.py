"""Statistical model of estimates of power, as a function of the parameters, and start values of these.

Amplitudes enter by their squares v (the "power" of a term): the mean is linear in them, the covariance
bilinear. Other free parameters ("shapes") enter by ln(value − lower bound). The estimates are Allan variances
at given cluster sizes (`AllanDesign`, `AllanTangent`) or levels of the cosine spectrum (`LevelTangent`).
"""

from __future__ import annotations

import abc
import dataclasses
import itertools
from collections.abc import Iterable, Sequence
from typing import Any, TypeAlias, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from allanjax.allan.covariance import AllanCovariance
from allanjax.allan.deviation import AllanDeviation
from allanjax.base.arrays import namespace
from allanjax.base.errors import FitError
from allanjax.base.linalg import CholeskyWhitened, whiten
from allanjax.estimate.deterministic import Peaks
from allanjax.estimate.spectral.powers import power_fits
from allanjax.noise.model import Model, ModelParameter
from allanjax.noise.notation import ModelLike, as_model
from allanjax.noise.process import Process, numbers_as_data
from allanjax.noise.terms import NoiseTerm, Parameter
from allanjax.record.columns import Column
from allanjax.record.recording import Axis

#: Farthest that a shape moves from its start, in ln: the record or dense starts locate it better than that;
#: and the margin kept from its upper bound, which is open.
REACH, INSIDE = {"line": 0.1, "time": 4.0, "frequency": 4.0, "number": 3.0}, 1e-2
# Order of the quadrature, and ridge added to the covariance, relative to its diagonal: errors of rounding and
# quadrature stay below it, and no direction of the data is trusted more. The same for terms that oscillate.
_ORDER, _RIDGE, _OSCILLATING_ORDER, _OSCILLATING_RIDGE = 8, 1e-4, 32, 5e-3
# Pairs of estimates that are computed together: few enough to stay in a core's cache.
_FEW_PAIRS = 256
# Number of shapes that are evaluated roughly, and of those at a time; and number of starts of a fit.
_CANDIDATES, _BLOCK, _STARTS = 512, 512, 4
# Starts that differ by less than this in ln lead to the same solution; 1 for unlisted kinds of shapes.
_APART = {"line": 0.02}

_Power: TypeAlias = Float[np.ndarray, "axes terms"]
_PerAxis: TypeAlias = Float[np.ndarray, " axes"]
_Curves: TypeAlias = Float[np.ndarray, "axes m"]
_Columns: TypeAlias = Float[np.ndarray, "axes m k"]
_Candidates: TypeAlias = Float[np.ndarray, "candidates shapes"]
_Shapes: TypeAlias = Float[Array, " shapes"]


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class Tangent(abc.ABC):
    """Model of estimates around the solutions of several axes, linear in the shapes; of one axis for all.

    `means` are expectations for each term of unit amplitude, `owner` is the term of each shape.
    """

    means: Float[np.ndarray, "axes terms m"]
    by_shape: Float[np.ndarray, "axes terms m shapes"]
    owner: Int[np.ndarray, " shapes"]

    def mean(self, power: _Power) -> _Curves:
        """Expectation of the estimates for these powers of the terms."""
        return (power[:, None] @ self.means)[:, 0]

    @abc.abstractmethod
    def variances(self, power: _Power) -> _Curves:
        """Variances of the estimates for these powers of the terms."""

    @abc.abstractmethod
    def weighed(self, power: _Power, error: _PerAxis, X: _Columns) -> _Columns:
        """Columns C⁻¹X for relative residuals of covariance C, with a relative error of the model."""

    def of_axes(self, axes: Int[np.ndarray, " few"]) -> Tangent:
        """The same for these axes only."""
        arrays = {name: getattr(self, name, ()) for name in ("means", "by_shape", "products")}
        return dataclasses.replace(self, **{name: x[axes] for name, x in arrays.items() if len(x) > 1})


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class AllanTangent(Tangent):
    """Allan variances around a solution, see `AllanDesign`; an error of the model is common to an octave.

    `products` are the covariance as a bilinear form in the powers.
    """

    products: Float[np.ndarray, "axes terms*terms m*m"]
    octaves: Float[np.ndarray, "m m"]
    ridge: float

    def covariance(self, power: _Power) -> Float[np.ndarray, "axes m m"]:
        squares = (power[:, :, None] * power[:, None]).reshape(len(power), 1, -1)
        return (squares @ self.products).reshape(-1, *self.octaves.shape)

    def variances(self, power: _Power) -> _Curves:
        return np.einsum("aii->ai", self.covariance(power))

    def relative(self, power: _Power, error: _PerAxis) -> Float[np.ndarray, "axes m m"]:
        """Covariance of the ratios to the expectations, with the ridge and a relative error of the model."""
        return _relative(self.mean(power), self.covariance(power), error, self)

    def weighed(self, power: _Power, error: _PerAxis, X: _Columns) -> _Columns:
        return np.linalg.solve(self.relative(power, error), X)


def _relative(mean: Any, covariance: Any, error: Any, of: AllanTangent | AllanDesign) -> Any:
    """Covariance [*b m m] of the ratios to the mean, with the ridge and a relative error of the model."""
    ridged = covariance * (1.0 + of.ridge * np.eye(len(of.octaves)))
    return ridged / (mean[..., None] * mean[..., None, :]) + error[..., None, None] ** 2 * of.octaves


def model_to_fit(model: ModelLike, axes: Iterable[Axis | Column] = (), with_response: bool = False) -> Model:
    """Model as `as_model` makes it, for a fit to these axes.

    Raises:
        FitError: the model has a response, which cannot be fitted here.
    """
    found = as_model(model, axes)
    if found.response is not None and not with_response:
        raise FitError(
            f"a response ({found.response!r}) can only be estimated from a recording's spectrum; use "
            'objective="whittle" (--objective whittle), or leave it out'
        )
    return found


def of_owners(model: Model, of_terms: Bool[np.ndarray, "... terms"]) -> Bool[np.ndarray, "... owners"]:
    """Flags of these terms, then of the response: whether any of the terms passes through it."""
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


class AllanDesign(eqx.Module):
    """Model of Allan variances at the cluster sizes of `geometry`, or of wavelet variances at its levels.

    All but the terms with free shapes is data, padded, so that a program is compiled once for each set of
    such terms: lengths, rates, cluster sizes and all other terms.

    Attributes:
        shapes: free parameters that are not amplitudes, and the place of each one's term among `moving`.
        octaves, ridge: what two estimates share of a relative error of the model, and relative addition to
            the variances.
        fixed, products, kernels: expectations of the `terms` of unit amplitude, covariance as a bilinear form
            in the powers, and kernels; zero for terms with free shapes.
        scatters: whether a term's own square scatters: not that of a line or a ramp, which are the same in
            every record, and that of a narrow-band term by `narrow_band_scatter`.
        moving, places: terms with free shapes, of unit amplitude, and their places among all.
    """

    shapes: tuple[tuple[Parameter, int], ...] = eqx.field(static=True)
    geometry: AllanCovariance
    octaves: Float[np.ndarray, "m m"]
    ridge: Float[np.ndarray, ""]
    terms: Int[np.ndarray, ""]
    fixed: Float[np.ndarray, "terms m"]
    products: Float[np.ndarray, "terms terms pairs"]
    kernels: Float[np.ndarray, "terms lags pairs"] | None
    scatters: Bool[np.ndarray, " terms"]
    moving: tuple[NoiseTerm, ...]
    places: Int[np.ndarray, " moving"]

    @classmethod
    def of(cls, model: Model, curve: AllanDeviation, capacity: tuple[int, int] = (0, 0)) -> AllanDesign:
        """Design of a noise model for a curve, padded to at least so many cluster sizes and terms."""
        return cls.of_geometry(model, geometry_of(curve, model, capacity[0]), capacity[1])

    @classmethod
    def of_geometry(cls, model: Model, geometry: AllanCovariance, slots: int) -> AllanDesign:
        """Design of a noise model for the estimates of a quadrature, padded to at least so many terms."""
        free, slots = free_shapes(model), max(slots, len(model))
        places = sorted({p.term for p in free})
        terms = [term.with_unit_amplitude() for term in model.sampled(geometry.rate).terms]
        still = {k: term for k, term in enumerate(terms) if k not in places}
        fixed, kernels, products = _parts(still, geometry, slots)
        return cls(
            shapes=tuple((p.parameter, places.index(p.term)) for p in free),
            geometry=geometry,
            octaves=np.exp(-np.abs(np.subtract.outer(*2 * [np.log2(geometry.sizes)]))),
            ridge=np.asarray(_OSCILLATING_RIDGE if _order(model) > _ORDER else _RIDGE),
            terms=np.asarray(len(model)),
            fixed=fixed,
            products=products,
            kernels=kernels if free else None,
            scatters=np.pad(_scatters(terms), (0, slots - len(terms))),
            moving=tuple(_structure(terms[k]) for k in places),
            places=np.array(places, int),
        )

    @property
    def owner(self) -> Int[np.ndarray, " shapes"]:
        """The term of each shape."""
        return self.places[np.array([place for _, place in self.shapes], int)]

    def means(self, shape: _Shapes | Float[np.ndarray, " shapes"]) -> Float[Array, "terms m"]:
        """Expectation of the estimates for each term of unit amplitude; of NumPy if the shapes are."""
        means: Any = self.fixed
        terms = np.arange(len(means))[:, None]
        for place, term in zip(self.places, self._moving(shape), strict=True):
            means = namespace(shape).where(terms == place, self.geometry.mean(term), means)
        return means

    def moments(
        self, power: Float[Array, " terms"], shape: _Shapes
    ) -> tuple[Float[Array, " m"], Float[Array, "m m"]]:
        """Expectation and covariance of the estimates; one and zero where there is none."""
        means, products = self.means(shape), self.products_at(shape)
        mean = jnp.where(jnp.arange(means.shape[1]) < self.geometry.count, power @ means, 1.0)
        by_pair = jnp.outer(power, power).ravel() @ products.reshape(-1, products.shape[-1])
        return mean, by_pair[jnp.asarray(self.geometry.place)]

    def products_at(self, shape: _Shapes) -> Float[Array, "terms terms pairs"]:
        """Covariance of the estimates as a bilinear form in the powers, for each pair of estimates."""
        products, terms, place = jnp.asarray(self.products), self._moving(shape), jnp.asarray(self.places)
        if not terms:
            return products
        total, rows = products.shape[-1], jnp.asarray(self.geometry.count)
        few = min(_FEW_PAIRS, total)

        def of_some(k: Array, found: Array) -> Array:
            first = jnp.minimum(k * few, total - few)
            part = self.geometry.of_pairs(first, few)
            own = jnp.stack([part.kernel(term) for term in terms])
            every = jax.lax.dynamic_slice_in_dim(jnp.asarray(self.kernels), first, few, 2).at[place].set(own)
            sums = jnp.sum((own * part.weights)[:, None] * every, axis=2)
            return jax.lax.dynamic_update_slice_in_dim(found, sums, first, 2)

        blocks = -(-(rows * (rows + 1) // 2) // few)
        found = jax.lax.fori_loop(0, blocks, of_some, jnp.zeros((len(terms), *products.shape[1:])))
        scatters = jnp.asarray(self.scatters)
        found = found * (scatters[place][:, None] | scatters)[..., None]
        products = products.at[place].set(found).at[:, place].set(found.swapaxes(0, 1))
        for k, term in enumerate(terms):
            if term.narrow_band:
                products = products.at[place[k], place[k]].set(self.geometry.narrow_band_scatter(term))
        return products

    def whiten(
        self, mean: Array, covariance: Array, power_error: Array, X: Float[Array, "m k"]
    ) -> CholeskyWhitened:
        """Whitened columns X for relative residuals, with a model error that is common to about an octave."""
        return whiten(_relative(mean, covariance, power_error, self), X, self.geometry.count)

    def tangent(self, shape: Float[np.ndarray, "axes shapes"]) -> AllanTangent:
        """The model around these shapes of each axis, without padding."""
        means, products = self.fixed[None], self.products[None]
        by_shape = np.zeros((*means.shape, shape.shape[1]))
        if self.shapes:
            means, by_shape, products = jax.device_get(_around(self, shape))
        terms, m, axes = int(self.terms), int(self.geometry.count), len(means)
        pairs = np.asarray(self.geometry.place)[:m, :m].ravel()
        return AllanTangent(
            means=means[:, :terms, :m],
            by_shape=by_shape[:, :terms, :m],
            owner=self.owner,
            products=products[:, :terms, :terms, pairs].reshape(axes, terms**2, m**2),
            octaves=self.octaves[:m, :m],
            ridge=float(self.ridge),
        )

    def _moving(self, shape: Float[Array | np.ndarray, " shapes"]) -> list[NoiseTerm]:
        """Terms with free shapes, which they have here."""
        terms, xp = list(self.moving), namespace(shape)
        for (p, k), u in zip(self.shapes, shape, strict=True):
            terms[k] = terms[k].replace(**{p.name: p.lower + xp.exp(u)})
        return terms


@eqx.filter_jit
def _around(design: AllanDesign, shape: Float[ArrayLike, "axes shapes"]) -> tuple[Array, Array, Array]:
    """Means, their derivatives by the shapes, and products for each axis."""
    slope = jax.jacfwd(design.means)
    return jax.lax.map(lambda u: (design.means(u), slope(u), design.products_at(u)), jnp.asarray(shape))


def geometry_of(curve: AllanDeviation, model: Model, capacity: int = 0) -> AllanCovariance:
    """Quadrature of the covariance of a curve's Allan variances for a model."""
    place = curve.n, curve.rate, curve.cluster_size
    return AllanCovariance.of(*place, _order(model), curve.strides, capacity)


def _order(model: Model) -> int:
    """Order of the quadrature; terms that oscillate need more nodes."""
    return _OSCILLATING_ORDER if any(term.oscillates for term in model.terms) else _ORDER


def _structure(term: NoiseTerm) -> NoiseTerm:
    """Term with None for its free shapes and arrays for its numbers, so that these are data."""
    free = {p.name: None for p in term.parameters()[1:] if term.is_free(p)}
    (found,) = numbers_as_data((term.replace(**free, held=frozenset()),))
    return cast(NoiseTerm, found)


def _scatters(terms: Iterable[Process]) -> Bool[np.ndarray, " terms"]:
    return np.array([not (term.deterministic or term.narrow_band) for term in terms], bool)


def _parts(
    terms: dict[int, Any], geometry: AllanCovariance, slots: int
) -> tuple[Float[np.ndarray, "slots m"], Float[np.ndarray, "slots lags pairs"], np.ndarray]:
    """Expectations, kernels and products of the terms in these slots; zero for the others."""
    lags, pairs = geometry.lags.shape
    means, kernels = np.zeros((slots, len(geometry.sizes))), np.zeros((slots, lags, pairs))
    products = np.zeros((slots, slots, pairs))
    here, m, scatters = list(terms), int(geometry.count), _scatters(terms.values())
    real, both = min(m * (m + 1) // 2, pairs), (scatters[:, None] | scatters)[..., None]
    for first in range(0, real, _FEW_PAIRS):
        some = slice(first, min(first + _FEW_PAIRS, real))
        part = geometry.chosen(some)
        own = np.array([part.kernel(term) for term in terms.values()]).reshape(-1, *part.lags.shape)
        kernels[here, :, some] = own
        products[np.array(here)[:, None], here, some] = both * np.einsum(
            "klp,jlp->kjp", own * part.weights, own
        )
    for k, term in terms.items():
        means[k] = geometry.mean(term)
        if term.narrow_band:
            products[k, k, :real] = geometry.chosen(slice(real)).narrow_band_scatter(term)
    return means, kernels, products


@np.errstate(all="ignore")
def find_starts(
    model: Model,
    candidates: _Candidates,
    unit: Float[np.ndarray, "candidates terms m"],
    level: _Curves,
    degrees: Float[np.ndarray, " m"],
    active: Bool[np.ndarray, "axes terms"],
) -> tuple[Float[np.ndarray, "axes starts terms"], Float[np.ndarray, "axes starts shapes"]]:
    """Start values for every axis: powers, and the best few candidates of shapes, with which they fit best.

    `unit` are expectations for each candidate and term of unit amplitude, `level` smooth estimates, taken to
    be independent, with their `degrees` of freedom.
    """
    amplitudes = (p.start for p in model.parameters if p.parameter.is_amplitude)
    free, held = free_powers(model), np.array([float(value or 0.0) ** 2 for value in amplitudes])
    axes, count = len(level), len(candidates)
    axis, candidate = (x.ravel() for x in np.indices((axes, count)))
    power, loss = np.empty((axes * count, len(model))), np.empty(axes * count)
    for some in np.array_split(np.arange(axes * count), -(-axes * count // _BLOCK)):
        own, of_terms = level[axis[some]], unit[candidate[some]]
        largest = np.min(own[:, None] / np.maximum(of_terms, 1e-300), axis=-1)
        start = np.where(free, largest, held)
        power[some], loss[some] = power_fits(own, degrees / 2.0, own, of_terms, start, active[axis[some]])
    powers = np.where(free, power, held).reshape(axes, count, -1)
    apart = np.array([_APART.get(p.parameter.kind, 1.0) for p in free_shapes(model)])
    best = np.stack([_different(apart, candidates, x) for x in loss.reshape(axes, count)])
    return powers[np.arange(axes)[:, None], best], candidates[best]


def _different(
    apart: Float[np.ndarray, " shapes"], candidates: _Candidates, loss: Float[np.ndarray, " candidates"]
) -> Int[np.ndarray, " starts"]:
    """Indices of the best candidates that are not next to a better one, then of the best others."""
    # Of two orders of like terms, which fit equally well, that of ascending shapes comes first.
    order = np.lexsort((*candidates.T[::-1], np.round(loss - loss.min(), 2))).tolist()
    chosen: list[int] = []
    for i in order:
        if all(np.any(abs(candidates[i] - candidates[k]) > apart) for k in chosen):
            chosen.append(i)
    return np.array((chosen + [i for i in order if i not in chosen])[:_STARTS])


def correlation_times(duration: float, rate: float) -> Float[np.ndarray, " grid"]:
    """Sixteen correlation times [s] that are observable in a record of this duration [s]."""
    return np.geomspace(4.0 / rate, duration / 4.0, 16)


def shape_candidates(model: Model, duration: float, rate: float, peaks: Peaks = ()) -> _Candidates:
    """Transformed values of a model's free shapes to try in a record of this duration [s].

    These are the given ones, or a grid; `peaks` are the frequencies [Hz] to try for narrow features.
    """

    def choices(p: ModelParameter) -> Sequence[float] | Float[np.ndarray, " values"]:
        own = p.parameter
        if p.start is not None:
            return [p.start]
        if own.starts:
            return rate * np.array(own.starts)
        if own.name == "bandwidth":
            return np.geomspace(rate / 200.0, rate / 3.0, 8)
        if own.kind == "number" and own.upper < np.inf:
            return np.linspace(own.lower, own.upper, 9)[1:-1]
        if own.kind == "frequency":
            return np.geomspace(4.0 / duration, rate / 4.0, 16)
        by_kind = {"time": correlation_times(duration, rate), "line": peaks}
        return by_kind.get(own.kind, own.lower + np.array([1.0, 5.0, 25.0]))

    shapes = free_shapes(model)
    grid = np.array(list(itertools.product(*map(choices, shapes))))
    if len(grid) > _CANDIDATES:
        grid = grid[np.random.default_rng(0).choice(len(grid), _CANDIDATES, replace=False)]
    return np.log(grid - np.array([p.parameter.lower for p in shapes]))

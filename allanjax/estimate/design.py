"""Iterated generalized least squares on estimates of power, and the statistical model of these estimates.

Amplitudes enter by their squares v (the "power" of a term): the mean is linear in them, the covariance
bilinear. Other free parameters ("shapes") enter by ln(value − lower bound). The estimates are Allan variances
at given cluster sizes (`AllanDesign`, `AllanTangent`) or levels of the cosine spectrum (`LevelTangent`).

The estimating equation is D'C⁻¹(V − μ) = 0 with mean μ, its derivatives D and the covariance C of the
estimates V, all under the current model: it is unbiased for any law of V, and nearly as efficient as the
likelihood of the whole record. Internally, each variance is in units of its mean under the model.

If a model cannot follow the curve within the scatter (p < 1e-6), the covariance gains a relative error s of
the model's powers, correlated over about an octave, that brings χ² to its degrees of freedom. The intervals
then allow for an incomplete model instead of being absurdly narrow.
"""

from __future__ import annotations

import abc
import dataclasses
import itertools
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple, TypeAlias, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import optimistix as optx
from jaxtyping import Array, ArrayLike, Bool, Float, Int, Shaped

from allanjax.allan.covariance import AllanCovariance
from allanjax.allan.deviation import AllanDeviation
from allanjax.base.arrays import namespace
from allanjax.base.chi_squared import beyond_doubt
from allanjax.base.errors import FitError
from allanjax.base.linalg import CholeskyWhitened, non_negative_least_squares, whiten
from allanjax.estimate.deterministic import InUse, Peaks
from allanjax.estimate.evidence import power_fits
from allanjax.noise.model import Model, ModelParameter
from allanjax.noise.process import Process, numbers_as_data
from allanjax.noise.terms import NoiseTerm, Parameter

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
_Starts: TypeAlias = Float[np.ndarray, "axes starts _"]


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


def check_no_response(model: Model) -> None:
    """Raise FitError if a model has a response, which Allan variances do not determine."""
    if model.response is not None:
        raise FitError(
            f"a response ({model.response!r}) can only be estimated from a recording's spectrum; use "
            'objective="whittle" (--objective whittle), or leave it out'
        )


def of_owners(model: Model, of_terms: InUse) -> Bool[np.ndarray, "*axes owners"]:
    """Flags of these terms, then of the response: whether any of the terms passes through it."""
    if model.response is None:
        return of_terms
    passing = of_terms[..., np.array(model.inside, bool)]
    return np.concatenate([of_terms, passing.any(axis=-1, keepdims=True)], axis=-1)


def free_shapes(model: Model) -> tuple[ModelParameter, ...]:
    """Free parameters of a model that are not amplitudes."""
    return tuple(p for p in model.parameters if p.free and not p.parameter.is_amplitude)


def free_powers(model: Model) -> InUse:
    """Which terms of a model have an amplitude to be estimated."""
    return np.array([term.has_free_amplitude for term in model.terms])


class AllanDesign(eqx.Module):
    """Model of Allan variances at the cluster sizes of `geometry`, or of wavelet variances at its levels.

    All but the terms with free shapes is data, padded, so that a program is compiled once for each set of
    such terms. These are `moving`, of unit amplitude, at their `places` among all; `shapes` are their free
    parameters, with the place of each one's term among them. For the other terms, of unit amplitude, `fixed`
    are the expectations, `products` the covariance as a bilinear form in the powers, and `kernels` those of
    the covariance. `octaves` is what two estimates share of a relative error of the model, and the variances
    are larger by a `ridge`. A term's own square `scatters` unless it is a line or a ramp, which are the same
    in every record, or a narrow-band term (see `narrow_band_scatter`).
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
    active: InUse,
) -> tuple[_Starts, _Starts]:
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


# Errors of the model in the first steps, nearly log-log fits, which converge from anywhere; of a model that
# is tried without an error, and of one that needs one.
_WARM_UP = np.array([[0.5, 0.2, 0.05, 0.0], [0.5, 0.2, 0.05, 0.1]])
_WARM = _WARM_UP.shape[1]
# Largest number of reweightings, and of steps of the shapes within each.
_STEPS, _INNER_STEPS = _WARM + 100, 20
# Largest factor by which the acceleration extrapolates the last move.
_MAX_EXTRAPOLATION = 5.0
# A step that moves the fitted curve by less than this, in standard deviations, ends the iteration.
_TOLERANCE = 1e-3
_LEAST_ERROR = 1e-4
# Difference of minus twice the log-likelihood below which two solutions are the same.
_AS_LIKELY = 0.02


class Solution(NamedTuple):
    """Estimate of one axis in arrays of JAX or NumPy, or of several along a first dimension.

    Powers (squared amplitudes) [terms]; shapes, ln(value − lower bound) [shapes]; χ² without an error of the
    model; the relative error of its powers that explains the misfit, 0 if the model suffices; whether the
    iteration converged; and minus twice the log-likelihood, to choose among solutions.
    """

    power: Any
    shape: Any
    chi2: Any
    power_error: Any
    converged: Any
    cost: Any

    @property
    def discrepancy(self) -> Any:
        """Relative error of the model's deviations, which is half of that of its powers."""
        return self.power_error / 2.0


class _State(NamedTuple):
    """State of the iteration: powers and shapes, expectation and covariance there, the last place and move.

    `tolerant`: whether the model is given an error; `step` counts from the start with or without one.
    """

    at: tuple[Array, Array]
    mean: Float[Array, " m"]
    covariance: Float[Array, "m m"]
    last: tuple[Array, Array]
    last_move: tuple[Array, Array]
    power_error: Float[Array, ""]
    tolerant: Bool[Array, ""]
    step: Int[Array, ""]
    chi2: Float[Array, ""]
    cost: Float[Array, ""]
    ended: Bool[Array, ""]


class _Problem(NamedTuple):
    """Data of one axis, the model that is fitted to them, and the start; see `solve`."""

    design: AllanDesign
    V: Float[Array, " m"]
    free: Bool[Array, " terms"]
    active: Bool[Array, " terms"]
    power: Float[Array, " terms"]
    shape: Float[Array, " shapes"]

    @property
    def moves(self) -> Bool[Array, " shapes"]:
        return self.active[jnp.asarray(self.design.owner)]

    @property
    def dof(self) -> Float[Array, ""]:
        estimated = jnp.sum(self.active & self.free) + jnp.sum(self.moves)
        return jnp.maximum(self.design.geometry.count - estimated, 1.0)

    def within(self, u: Array) -> Float[Array, " shapes"]:
        """Shapes clipped to their bounds; those that are not fitted stay at their start."""
        reach = jnp.asarray([REACH[p.kind] for p, _ in self.design.shapes])
        end = jnp.asarray([np.log(p.upper - p.lower) for p, _ in self.design.shapes]) - INSIDE
        clipped = jnp.clip(u, self.shape - reach, jnp.minimum(self.shape + reach, end))
        return jnp.where(self.moves, clipped, self.shape)

    def misfit(self, mean: Array, covariance: Array, power_error: Array) -> tuple[Array, Array]:
        """χ² of the residuals, and ln det of their covariance."""
        # Plain relative residuals, since normal scores of each would not be jointly normal.
        residual, log_det = self.design.whiten(mean, covariance, power_error, (self.V / mean - 1.0)[:, None])
        return jnp.sum(residual**2), log_det

    def powers(self, shape: Array, W: Array, reference: Array) -> tuple[Array, Array]:
        """Best powers for given shapes, and the whitened residual (variable projection)."""
        A = W @ (self.design.means(shape) / reference).T
        target = W @ (self.V / reference) - A @ jnp.where(self.free, 0.0, self.power)
        v = non_negative_least_squares(A, target, self.active & self.free)
        return jnp.where(self.free, v, self.power), target - A @ jnp.where(self.free, v, 0.0)

    def reweighted(self, state: _State, W: Array) -> tuple[Array, Array]:
        """Powers and shapes by one generalized least squares fit with the weights of the present estimate."""
        shape = state.at[1]
        if self.design.shapes:

            def residual(u: Array, _: None) -> Array:
                return self.powers(self.within(u), W, state.mean)[1]

            # Not the default QR: see `linalg` about batches of LAPACK calls.
            linear: Any = lx.Normal(lx.CG(rtol=1e-9, atol=1e-12))
            solver: Any = optx.LevenbergMarquardt(rtol=1e-6, atol=1e-6, linear_solver=linear)
            found: Any = optx.least_squares(residual, solver, shape, max_steps=_INNER_STEPS, throw=False)
            shape = jnp.where(jnp.isfinite(found.value), self.within(found.value), shape)
        return self.powers(shape, W, state.mean)[0], shape

    def accelerated(self, state: _State, W: Array, move: tuple[Array, Array]) -> tuple[Array, Array]:
        """Powers and shapes after a longer or shorter move than this one, by Anderson's (1965) method.

        Reweighting converges linearly, sometimes slowly or with alternating sign. The acceleration remedies
        that, with one step of memory and moves measured by how far they move the curve.
        """
        to_curve = W @ (self.design.means(state.at[1]) / state.mean).T
        here, last = to_curve @ move[0], to_curve @ state.last_move[0]
        change = here - last
        gamma = jnp.vdot(change, here) / jnp.maximum(jnp.vdot(change, change), 1e-30)
        # Moves that grow in one direction lead away from a near solution: extrapolate, do not return.
        gamma = jnp.where((jnp.vdot(here, last) > 0.0) & (gamma > 0.0), -_MAX_EXTRAPOLATION, gamma)
        # The first steps each solve another problem.
        gamma = jnp.where(state.step > _WARM, jnp.clip(gamma, -_MAX_EXTRAPOLATION, 0.5), 0.0)
        power, shape = (
            x + f - gamma * (x - x_last + f - f_last)
            for x, f, x_last, f_last in zip(state.at, move, state.last, state.last_move, strict=True)
        )
        return jnp.where(self.free, jnp.maximum(power, 0.0), self.power), self.within(shape)

    def next(self, state: _State, again: _State) -> _State:
        """State after one step; a model that does not suffice without an error begins `again` with one."""
        k, error, tolerant = state.step, state.power_error, state.tolerant
        W = self.design.whiten(state.mean, state.covariance, error, jnp.eye(len(self.V))).values
        move = jax.tree.map(jnp.subtract, self.reweighted(state, W), state.at)
        at = self.accelerated(state, W, move)
        mean, covariance = self.design.moments(*at)
        # Move of the curve in standard deviations.
        moved = jnp.linalg.norm(W @ (mean / state.mean - 1.0))
        errors = jnp.stack([jnp.zeros(()), error])
        (chi2, with_error), (_, log_det) = jax.vmap(lambda s: self.misfit(mean, covariance, s))(errors)
        limit, excess = beyond_doubt(self.dof), with_error / self.dof
        # With few clusters the tail is heavier than that of χ².
        suffices = chi2 < limit
        known = ~tolerant | (jnp.abs(excess - 1.0) < 0.02) | (error <= _LEAST_ERROR) & suffices
        settled = (k >= _WARM) & (moved < _TOLERANCE) & known
        ended = settled | (k + 1 == _STEPS)
        # Where the model's error dominates the covariance, χ² is proportional to its inverse square.
        adapted = jnp.where(tolerant, jnp.clip(error * jnp.sqrt(excess), _LEAST_ERROR, 10.0), 0.0)
        warm = jnp.asarray(_WARM_UP)[tolerant.astype(int), jnp.minimum(k + 1, _WARM - 1)]
        wanted = jnp.where(ended, error, jnp.where(k + 1 < _WARM, warm, adapted))
        # Minus twice the Gaussian log-likelihood, to choose among starts.
        cost = with_error + 2.0 * log_det + 2.0 * jnp.sum(jnp.log(mean))
        moments, before = (mean, covariance), (state.at, move)
        new = _State(at, *moments, *before, wanted, tolerant, k + 1, chi2, cost, ended)
        anew = ended & ~tolerant & ~(settled & suffices)
        return jax.tree.map(lambda a, b: jnp.where(anew, a, b), again, new)

    def solution(self) -> Solution:
        error, infinite, no = map(jnp.asarray, (_WARM_UP[0, 0], jnp.inf, False))
        at, moments = (self.power, self.shape), self.design.moments(self.power, self.shape)
        first = _State(at, *moments, at, at, error, no, jnp.asarray(0), infinite, infinite, no)
        again = first._replace(tolerant=~no)
        end = jax.lax.while_loop(lambda state: ~state.ended, lambda state: self.next(state, again), first)
        vanished = (end.power_error <= _LEAST_ERROR) & (end.chi2 < beyond_doubt(self.dof))
        error = jnp.where(vanished, 0.0, end.power_error)
        return Solution(*end.at, end.chi2, error, (end.step < _STEPS) & jnp.isfinite(end.cost), end.cost)


def solve(
    design: AllanDesign,
    V: Float[np.ndarray, "axes m"],
    free: InUse,
    active: InUse,
    power: _Starts,
    shape: _Starts,
) -> Solution:
    """Best fit to the estimates V of power [rate²] of every axis from its starts, in arrays of NumPy.

    `active` are the terms in use, and `free` those whose power is estimated.
    """
    padding, slots, count = len(design.octaves) - V.shape[1], len(design.scatters) - len(free), len(free)
    V = np.pad(V, ((0, 0), (0, padding)), constant_values=1.0)
    of_terms = free, active, np.where(active[:, None], power, 0.0)
    free, active, power = (np.pad(x, [(0, 0)] * (x.ndim - 1) + [(0, slots)]) for x in of_terms)
    found: Any = jax.device_get(_solutions(design, free, V, active, power, shape))
    return found._replace(power=found.power[:, :count])


@eqx.filter_jit
def _solutions(
    design: AllanDesign, free: Bool[ArrayLike, " terms"], *of_axes: Shaped[ArrayLike, "axes ..."]
) -> Solution:
    def of(axis: Any) -> Solution:
        V, active, *starts = axis
        each: Any = jax.lax.map(
            lambda at: _Problem(design, V, jnp.asarray(free), active, *at).solution(), starts
        )
        # The cost may have several minima in a correlation time: the best one counts, of equals the first.
        cost = jnp.where(each.converged, each.cost, jnp.inf)
        best = jnp.argmax(cost <= cost.min() + _AS_LIKELY)
        return jax.tree.map(lambda x: x[best], each)

    # With shapes one after another, for then no axis waits for the slowest.
    return jax.lax.map(of, of_axes) if design.shapes else jax.vmap(of)(of_axes)

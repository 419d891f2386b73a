"""Statistical model of estimates of power, as a function of the parameters, and start values of these.

Amplitudes enter by their squares v (the "power" of a term): the mean is linear in them, the covariance
bilinear. Other free parameters ("shapes") enter by ln(value − lower bound). The estimates are Allan variances
at given cluster sizes (`AllanDesign`) or levels of the cosine spectrum (`LevelDesign`).
"""

from __future__ import annotations

import abc
import itertools
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int, Shaped

from allanjax.allan.covariance import AllanCovariance
from allanjax.base.errors import FitError
from allanjax.base.linalg import CholeskyWhitened, whiten
from allanjax.noise.model import Model, ModelParameter
from allanjax.noise.notation import ModelLike, as_model
from allanjax.noise.process import Process, numbers_as_data
from allanjax.noise.terms import NoiseTerm, Parameter, basic_terms
from allanjax.record.columns import Column
from allanjax.record.recording import Axis

# Ridge added to the covariance, relative to its diagonal: rounding and quadrature errors stay below it, and
# no direction of the data is trusted more. Oscillating terms need more quadrature nodes, and have larger
# errors.
_RIDGE = 1e-4
_OSCILLATING_RIDGE = 5e-3
_OSCILLATING_ORDER = 32
# Terms whose rows every Allan design has, so that any choice among them is data.
_BASIC = tuple(term.with_unit_amplitude() for term in basic_terms())
# Number of shapes that are evaluated roughly at a time, number of starts of a fit, and number of frequencies
# that are tried for lines.
_CANDIDATES = 512
_BLOCK = 16
_STARTS = 4
_PEAKS = 4
# Starts that differ by less than this in ln lead to the same solution; 1 for unlisted kinds of shapes.
_APART = {"line": 0.02}


class FreeShape(NamedTuple):
    """Free parameter that is not an amplitude: its term, its declaration, and whether it is fitted.

    Frequencies of lines are not fitted, as they are known from the record.
    """

    term: int
    parameter: Parameter
    moves: bool


class Design(eqx.Module):
    """Model of the estimates for the inference: see the module's docstring.

    Attributes:
        owner: the term of each free parameter that is not an amplitude ("shape").
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
        """Whether there may be shapes; known when a program is compiled."""

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
        """Part of the covariance that depends only on the shapes."""

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


def random_terms(model: Model) -> Model:
    """Model without its deterministic terms."""
    terms = zip(model.term_labels, model.terms, strict=True)
    return model.without([label for label, term in terms if term.deterministic])


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
        others: the terms that are not basic ones, with unit amplitude; free shapes are None.
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

        `strides`: samples between the starts of successive clusters, see `AllanCovariance.of`. Arrays are
        padded to at least the `capacity` of cluster sizes and terms, so that compiled functions are reused.
        """
        oscillates = any(term.oscillates for term in model.terms)
        order = {"order": _OSCILLATING_ORDER} if oscillates else {}
        geometry = AllanCovariance.of(n, rate, sizes, strides=strides, capacity=capacity[0], **order)
        return cls.of_geometry(model, rate, geometry, capacity[1])

    @classmethod
    def of_geometry(cls, model: Model, rate: float, geometry: AllanCovariance, slots: int = 0) -> AllanDesign:
        """Design of a noise model for the estimates of a quadrature, padded to at least so many terms."""
        others: list[NoiseTerm] = []
        columns, basic = np.full(max(slots, len(model)), -1), [type(term) for term in _BASIC]
        for k, term in enumerate(model.sampled(rate).terms):
            # Flicker noise with a cutoff is none of the basic terms.
            row = basic.index(type(term)) if type(term) in basic and not term.oscillates else -1
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
        # Padding is beyond all rows.
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
        terms = list(self.others)
        for s, u in zip(self.shapes, shape, strict=True):
            value = s.parameter.lower + jnp.exp(u)
            terms[s.term] = terms[s.term].replace(**{s.parameter.name: value})
        return {len(_BASIC) + k: terms[k] for k in sorted({s.term for s in self.shapes})}


def _structure(term: NoiseTerm) -> NoiseTerm:
    """Term of unit amplitude: its free shapes are None, and its held ones arrays, so that they are data."""
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
    mean, variance = jax.device_get(_moments_behind(numbers_as_data(model.processes), geometry))
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
    """Rows of a model's terms among all rows; zero where there is no term."""
    return rows.at[jnp.asarray(columns)].get(mode="fill", fill_value=0.0)


def _narrow_band_scatter(term: Process, geometry: AllanCovariance) -> Float[Array, " pairs"]:
    """Covariance of the estimates of a narrow-band term alone.

    Its power fluctuates as a whole, which all estimates share; the overlaps within an estimate add as much
    again (70/36 − 1 when clusters outlast the oscillation), and long clusters see it as white noise.
    """
    i, j = geometry.pairs
    mean = geometry.mean(term)
    common = term.power_scatter(geometry.duration)
    clusters = geometry.cluster_time[i] / geometry.duration
    return mean[i] * mean[j] * (common + jnp.where(i == j, common + 1.5 * clusters, 0.0))


class Starts(NamedTuple):
    """Start values: powers [axes, starts, terms] and transformed shapes [axes, starts, shapes]."""

    power: Float[np.ndarray, "axes starts terms"]
    shape: Float[np.ndarray, "axes starts shapes"]


def find_starts(
    model: Model,
    design: AllanDesign,
    V: Float[np.ndarray, "axes m"],
    active: Bool[np.ndarray, "axes terms"],
    records: Iterable[Float[np.ndarray, " samples"] | None],
    n: int,
    rate: float,
) -> Starts:
    """Start values for every axis, from its Allan variances and, for lines, its record of n samples.

    Shape parameters without a value of their own are tried on a grid (`shape_candidates`); see `best_starts`.
    """
    shapes = free_shapes(model)
    searched = any(p.parameter.kind == "line" and p.start is None for p in shapes)
    peaks = (find_lines(x, rate) if searched and x is not None else () for x in records)
    candidates = [shape_candidates(shapes, n / rate, rate, of_axis) for of_axis in peaks]
    return best_starts(model, design, V, active, np.stack(candidates))


def best_starts(
    model: Model,
    design: AllanDesign,
    V: Float[np.ndarray, "axes m"],
    active: Bool[np.ndarray, "axes terms"],
    shape: Float[np.ndarray, "axes candidates shapes"],
) -> Starts:
    """Start values for every axis from candidate shapes: the best few, with the powers that fit best.

    The powers come from a non-negative least squares fit weighted by the number of clusters.
    """
    from scipy.ndimage import median_filter

    given = [getattr(t, t.amplitude_parameter().name) for t in model.terms]
    # A single estimate that is small by chance must not lower all powers.
    smooth = np.exp(median_filter(np.log(np.maximum(V, 1e-300)), (1, 5), mode="nearest"))
    data = design.padded_estimates(smooth), design.padded_terms(active)
    count = shape.shape[1]
    # In blocks of one size: one program serves any number of candidates.
    shapes, block = design.padded_shapes(shape), min(count, _BLOCK)
    order = np.arange(-(-count // block) * block) % count
    found = (_rough_powers(design, *data, shapes[:, rows]) for rows in order.reshape(-1, block))
    rough, misfit = (np.concatenate(part, axis=1) for part in zip(*map(jax.device_get, found), strict=True))
    power, misfit = rough[:, :count, : len(model)], misfit[:, :count]
    for k, (term, value) in enumerate(zip(model.terms, given, strict=True)):
        if value is not None and not term.has_free_amplitude:
            power[:, :, k] = value**2
    of_axes = zip(shape, misfit, strict=True)
    best = np.stack([different(*of_axis, free_shapes(model)) for of_axis in of_axes])
    axis = np.arange(len(V))[:, None]
    return Starts(power[axis, best], shape[axis, best])


def different(
    shape: Float[np.ndarray, "candidates shapes"],
    misfit: Float[np.ndarray, " candidates"],
    shapes: Sequence[ModelParameter],
) -> Int[np.ndarray, " starts"]:
    """Indices of the best candidates that are not next to a better one, then of the best others."""
    apart = np.array([_APART.get(p.parameter.kind, 1.0) for p in shapes])
    order = list(np.argsort(misfit))
    chosen: list[int] = []
    for i in order:
        if all(np.any(abs(shape[i] - shape[k]) > apart) for k in chosen):
            chosen.append(i)
    return np.array((chosen + [i for i in order if i not in chosen])[:_STARTS])


@eqx.filter_jit
def _rough_powers(
    design: AllanDesign,
    V: Float[ArrayLike, "axes m"],
    active: Bool[ArrayLike, "axes terms"],
    shape: Float[ArrayLike, "axes candidates shapes"],
) -> tuple[Float[Array, "axes candidates terms"], Float[Array, "axes candidates"]]:
    """Non-negative powers that fit each candidate's shapes best, and their weighted misfit."""
    weight = design.weight
    # One after another, for what is idle costs nothing then.
    means = jax.lax.map(lambda of_axis: jax.lax.map(design.means, of_axis), jnp.asarray(shape))

    def at(V: Array, active: Array, means: Array) -> tuple[Array, Array]:
        A = means / V
        normal, target = (A * weight) @ A.T, A @ weight

        # Lee & Seung's (2001) multiplicative steps keep powers positive and never increase the misfit.
        def step(_: int, v: Array) -> Array:
            return jnp.where(active, v * target / (normal @ v), 0.0)

        # The start is so low that no term alone exceeds the curve.
        start = jnp.where(active, 1.0 / jnp.max(A, axis=1) / design.terms, 0.0)
        v = jax.lax.fori_loop(0, 500, step, start)
        return v, jnp.sum(weight * (v @ A - 1.0) ** 2)

    of_axis = jax.vmap(at, (None, None, 0))
    return jax.vmap(of_axis)(jnp.asarray(V), jnp.asarray(active), means)


def correlation_times(duration: float, rate: float) -> Float[np.ndarray, " grid"]:
    """Sixteen correlation times [s] that are observable in a record of this duration [s]."""
    return np.geomspace(4.0 / rate, duration / 4.0, 16)


def shape_candidates(
    shapes: tuple[ModelParameter, ...],
    duration: float,
    rate: float,
    peaks: Float[np.ndarray, " peaks"] | Sequence[float],
) -> Float[np.ndarray, "candidates shapes"]:
    """Transformed shape values to try in a record of this duration [s]: the given ones, or a grid.

    `peaks` are the frequencies [Hz] to try for lines (`find_lines`).
    """
    if not shapes:
        return np.zeros((1, 0))
    choices = []
    for p in shapes:
        if p.start is not None:
            choices.append(np.array([p.start]))
        elif p.parameter.kind == "time":
            choices.append(correlation_times(duration, rate))
        elif p.parameter.starts:
            choices.append(rate * np.array(p.parameter.starts))
        elif p.parameter.name == "bandwidth":
            choices.append(np.geomspace(rate / 200.0, rate / 3.0, 8))
        elif p.parameter.kind == "frequency":
            choices.append(np.geomspace(4.0 / duration, rate / 4.0, 16))
        elif p.parameter.kind == "line":
            choices.append(np.asarray(peaks))
        elif p.parameter.upper < np.inf:
            choices.append(np.linspace(p.parameter.lower, p.parameter.upper, 9)[1:-1])
        else:
            choices.append(p.parameter.lower + np.array([1.0, 5.0, 25.0]))
    grid = np.array(list(itertools.product(*choices)))
    if len(grid) > _CANDIDATES:
        grid = grid[np.random.default_rng(0).choice(len(grid), _CANDIDATES, replace=False)]
    return np.log(grid - np.array([p.parameter.lower for p in shapes]))


def find_lines(x: Float[np.ndarray, " samples"], rate: float) -> Float[np.ndarray, " peaks"]:
    """Frequencies [Hz] of the most conspicuous peaks of the spectrum, sharp lines and broad bumps alike.

    A peak is the excess of the periodogram over its running median, weighed by its likelihood, at each of
    several resolutions; a peak found at one resolution is not counted again at another.
    """
    from scipy.ndimage import median_filter
    from scipy.signal import welch

    found: list[tuple[float, float, float]] = []
    for length in {len(x), min(len(x), 8192), min(len(x), 512)}:
        f, S = welch(x, rate, nperseg=length, detrend="linear")
        f, S = f[2:-1], S[2:-1]
        ratio = S / median_filter(S, min(101, len(S) // 4 * 2 + 1))
        # Gain in log-likelihood from a free level of a mean of len(x)/length periodograms.
        excess = len(x) / length * np.where(ratio > 1.0, ratio - 1.0 - np.log(ratio), 0.0)
        for i in np.argsort(excess)[::-1][:40]:
            found.append((excess[i], f[i], 2.0 * rate / length))
    found.sort(reverse=True)
    chosen: list[float] = []
    for _, f, width in found:
        if all(abs(f - g) > width for g in chosen):
            chosen.append(f)
        if len(chosen) == _PEAKS:
            break
    return np.array(chosen + [rate / 8.0] * (_PEAKS - len(chosen)))

"""Likelihood of a fit's data as a function of its parameters, and priors of these, for sampling.

It is that of the cosine spectrum (Whittle's; see `cosine`) or that of the Allan variances. The latter
transforms each variance by its χ² law under the model to a normal score (Wilson & Hilferty 1931); the scores
are jointly normal with the correlations of the variances.
"""

from __future__ import annotations

import abc
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import i0e
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from allanjax.base.arrays import namespace
from allanjax.base.chi_squared import cube_root_score
from allanjax.base.errors import AllanjaxError, FitError
from allanjax.base.linalg import whiten
from allanjax.estimate.design import AllanDesign, Design, free_shapes, of_owners
from allanjax.estimate.deterministic import LINE_REACH, AxisSpectrum, line_columns
from allanjax.estimate.evidence import PRIOR_RANGE
from allanjax.estimate.result import AxisFit, Fit
from allanjax.estimate.spectral.fit import SpectralDesign, share_with_error
from allanjax.noise.model import Model, ModelParameter

# Largest distance of a resonance's frequency from its fit, in ln.
_LINE_RANGE = 0.3
# The likelihood of the Allan variances uses every second cluster time of the fit, which has four per octave.
_THINNED = 2
# Arrays are padded to multiples of this number of cluster sizes, and to at least this number of terms.
_SIZES, _TERMS = 16, 6
# Priors of amplitudes extend by at least this factor beyond the largest value that the data allow.
_CEILING = 1e2


class Prior(eqx.Module):
    """Prior of one parameter, in SI.

    A subclass defines `lower`, `upper` and the two methods.

    Attributes:
        lower, upper: ends of its support.
    """

    if (
        TYPE_CHECKING
    ):  # Fields in some subclasses, which a property here would hide, and properties in others.

        @property
        def lower(self) -> float: ...

        @property
        def upper(self) -> float: ...

    def log_density(self, x: Float[ArrayLike, ...]) -> Float[Array, ...]:
        """Natural logarithm of the density [1/SI unit] at x, traceable by JAX; −inf outside the support."""
        raise NotImplementedError(f"{type(self).__name__} defines no log_density(x)")

    def quantile(self, u: Float[ArrayLike, ...]) -> Float[np.ndarray, ...]:
        """Value below which the share u of the prior lies; a draw from the prior if u is uniform."""
        raise NotImplementedError(f"{type(self).__name__} defines no quantile(u)")

    def _inside(self, x: Array, log_density: Array) -> Array:
        """Log density, set to −inf outside the support."""
        inside = (x >= self.lower) & (x <= self.upper)
        return namespace(inside, log_density).where(inside, log_density, -np.inf)

    def _require(self, condition: bool, wanted: str) -> None:
        """Raise AllanjaxError unless the condition holds."""
        if not condition:
            raise AllanjaxError(f"{self}: {wanted}")


class Uniform(Prior):
    """Uniform prior between `lower` and `upper`."""

    lower: float
    upper: float

    def __check_init__(self) -> None:
        finite = math.isfinite(self.lower) and math.isfinite(self.upper)
        self._require(finite and self.lower < self.upper, "give finite bounds, lower < upper")

    def log_density(self, x: Float[ArrayLike, ...]) -> Float[Array, ...]:
        xp = namespace(self, x)
        at = xp.asarray(x, float)
        return self._inside(at, xp.full(at.shape, -xp.log(self.upper - self.lower)))

    def quantile(self, u: Float[ArrayLike, ...]) -> Float[np.ndarray, ...]:
        return self.lower + np.asarray(u) * (self.upper - self.lower)


class LogUniform(Prior):
    """Prior uniform in ln(x − origin) between `lower` and `upper`: all factors are equally likely."""

    lower: float
    upper: float
    origin: float = 0.0

    def __check_init__(self) -> None:
        ordered = self.origin < self.lower < self.upper < math.inf
        self._require(ordered, f"give finite bounds, {self.origin:g} < lower < upper")

    def log_density(self, x: Float[ArrayLike, ...]) -> Float[Array, ...]:
        xp = namespace(self, x)
        at = xp.asarray(x, float)
        # Outside the support the logarithm only needs a valid argument.
        distance = xp.maximum(at, self.lower) - self.origin
        ratio = (self.upper - self.origin) / (self.lower - self.origin)
        return self._inside(at, -xp.log(distance) - xp.log(xp.log(ratio)))

    def quantile(self, u: Float[ArrayLike, ...]) -> Float[np.ndarray, ...]:
        nearest, farthest = self.lower - self.origin, self.upper - self.origin
        return self.origin + nearest * (farthest / nearest) ** np.asarray(u)


class LogNormal(Prior):
    """Log-normal prior: 68 % of it lies between `median`/`factor` and `median`·`factor`."""

    median: float
    factor: float

    def __check_init__(self) -> None:
        self._require(0.0 < self.median < math.inf, "give a finite median above 0")
        self._require(1.0 < self.factor < math.inf, "give a finite factor above 1")

    @property
    def lower(self) -> float:
        return 0.0

    @property
    def upper(self) -> float:
        return math.inf

    def log_density(self, x: Float[ArrayLike, ...]) -> Float[Array, ...]:
        xp = namespace(self, x)
        at = xp.asarray(x, float)
        width = xp.log(self.factor)
        positive = xp.where(at > 0.0, at, 1.0)
        z = xp.log(positive / self.median) / width
        density = -0.5 * z**2 - xp.log(positive * width) - 0.5 * math.log(2.0 * math.pi)
        return xp.where(at > 0.0, density, -np.inf)

    def quantile(self, u: Float[ArrayLike, ...]) -> Float[np.ndarray, ...]:
        from scipy.special import ndtri

        return self.median * self.factor ** ndtri(np.asarray(u, float))


class ModifiedLogUniform(Prior):
    """Modified Jeffreys prior on [0, upper]: p(x) = 1/[(x + scale)·ln(1 + upper/scale)].

    It is uniform in ln(x + scale) (Gregory 2005, ApJ 631:1198): uniform below the scale, where an amplitude
    cannot be distinguished from zero, and uniform in ln x far above it. Unlike 1/x it is proper, and it
    allows zero.
    """

    scale: float
    upper: float

    def __check_init__(self) -> None:
        self._require(0.0 < self.scale < math.inf, "give a finite scale above 0")
        self._require(0.0 < self.upper < math.inf, "give a finite upper above 0")

    @property
    def lower(self) -> float:
        return 0.0

    def log_density(self, x: Float[ArrayLike, ...]) -> Float[Array, ...]:
        xp = namespace(self, x)
        at = xp.asarray(x, float)
        density = -xp.log(xp.maximum(at, 0.0) + self.scale) - xp.log(xp.log1p(self.upper / self.scale))
        return self._inside(at, density)

    def quantile(self, u: Float[ArrayLike, ...]) -> Float[np.ndarray, ...]:
        return self.scale * np.expm1(np.asarray(u) * np.log1p(self.upper / self.scale))


def default_priors(likelihood: Likelihood) -> dict[str, Prior]:
    """Default priors of `sample`, by label, in SI.

    Amplitudes: `ModifiedLogUniform`, with the smallest amplitude that these data distinguish from zero as
    its scale. Times, frequencies and numbers: `LogUniform` in the distance from the parameter's lower bound.
    Frequencies of lines: `Uniform`. Supports are those of the likelihood, far wider than needed.
    """
    priors: dict[str, Prior] = {}
    for i, p in enumerate(likelihood.parameters):
        lower, upper = float(likelihood.lower[i]), float(likelihood.upper[i])
        if p.parameter.is_amplitude:
            priors[p.label] = ModifiedLogUniform(float(likelihood.prior_scale[i]), upper)
        elif p.parameter.kind == "line":
            priors[p.label] = Uniform(lower, upper)
        else:
            priors[p.label] = LogUniform(lower, upper, p.parameter.lower)
    return priors


def start_of(result: AxisFit, parameters: tuple[ModelParameter, ...]) -> Float[np.ndarray, " params"]:
    """Values of the fit; shapes of absent terms have some value in their range."""
    values = np.array([result[p.label].value for p in parameters])
    return np.where(np.isfinite(values), values, [p.parameter.lower + 1.0 for p in parameters])


def ranges_of(
    parameters: tuple[ModelParameter, ...], result: AxisFit, fit: Fit, ceiling: Float[np.ndarray, " params"]
) -> tuple[Float[np.ndarray, " params"], Float[np.ndarray, " params"]]:
    """Lower and upper ends of the parameters' ranges, given those of the amplitudes."""
    n, rate = fit.curve.n, fit.curve.rate
    lower, upper = np.zeros(len(parameters)), ceiling.copy()
    seen = {"time": (2.0 / rate, n / rate), "frequency": (rate / n, rate / 2.0)}
    for k, p in enumerate(parameters):
        if p.parameter.kind in seen:
            lower[k], upper[k] = seen[p.parameter.kind]
        elif p.parameter.kind == "number":
            lowest = p.parameter.lower
            lower[k], upper[k] = lowest + 1e-2, min(lowest + 1e4, p.parameter.upper - 1e-2)
        elif p.parameter.kind == "line":
            f = result[p.label].value
            if fit.template.terms[p.term].deterministic:
                reach = LINE_REACH / 2.0 * rate / (2.0 * n)
                lower[k], upper[k] = max(f - reach, 0.1 * rate / n), min(f + reach, rate / 2.0)
            else:
                lower[k], upper[k] = f * np.exp(-_LINE_RANGE), min(f * np.exp(_LINE_RANGE), rate / 2.0)
    return lower, upper


class Likelihood(eqx.Module):
    """Log-likelihood of the free parameters of a model, in SI and in the model's order.

    Attributes:
        parameters: the free parameters.
        start, scatter: the fit's estimate (zero for amplitudes of absent terms) and its rough standard
            deviation.
        lower, upper: a range that contains all reasonable values.
        prior_scale: the amplitude whose power would be one standard deviation in these data; NaN for other
            parameters.
        found: which parameters belong to terms that the fit detected.
    """

    parameters: tuple[ModelParameter, ...] = eqx.field(static=True)
    start: Float[np.ndarray, " params"]
    scatter: Float[np.ndarray, " params"]
    lower: Float[np.ndarray, " params"]
    upper: Float[np.ndarray, " params"]
    prior_scale: Float[np.ndarray, " params"]
    found: Bool[np.ndarray, " params"]

    @abc.abstractmethod
    def __call__(self, values: Float[Array, " params"]) -> Float[Array, ""]:
        """Log-likelihood [nats] up to a constant; NaN or −inf where the noise has no power."""


def likelihood_of(fit: Fit, axis: str) -> Likelihood:
    """Likelihood of one axis of a fit: Whittle's for `objective="whittle"`, else that of its Allan variances.

    It is for a complete record; see `WiderLikelihood` for one with missing samples.

    Raises:
        FitError: the axis did not converge, or was loaded from a file that does not hold its spectrum, or
            was fitted to wavelet variances.
    """
    result = fit[axis]
    parameters = tuple(p for p in fit.template.parameters if p.free)
    if not result.converged:
        raise FitError(f"{axis}: the fit failed, so that there is no posterior to sample: {result.reason}")
    if result.spectrum is not None:
        return _whittle(fit, result, parameters)
    if fit.objective == "whittle":
        raise FitError(
            f"{axis}: the fit was loaded from a file without the fitted spectrum; "
            "fit the recording again before sampling"
        )
    if fit.objective == "wavelet":
        raise FitError(
            f'{axis}: a fit of wavelet variances has no likelihood to sample; use objective="whittle"'
        )
    # The Allan variances do not determine the frequency of a line.
    lines = [k for k, term in enumerate(fit.template.terms) if term.deterministic]
    parameters = tuple(p for p in parameters if p.term not in lines or p.parameter.is_amplitude)
    return _allan(fit, result, parameters, fit.axes.index(axis))


class _ParameterLayout(eqx.Module):
    """Map from a vector of free parameters to the powers and shapes of a design's terms.

    `amplitude` and `shape` are indices among the free parameters, −1 for those held at `held` and
    `held_shape` (transformed); `bound` are lower bounds of the shapes.
    """

    amplitude: Int[np.ndarray, " terms"]
    held: Float[np.ndarray, " terms"]
    shape: Int[np.ndarray, " shapes"]
    bound: Float[np.ndarray, " shapes"]
    held_shape: Float[np.ndarray, " shapes"]

    @classmethod
    def of(
        cls, model: Model, parameters: Sequence[ModelParameter], result: AxisFit, design: Design
    ) -> _ParameterLayout:
        """Layout of these free parameters of a model for a design; the others are as in the fit."""
        labels = [p.label for p in parameters]
        shapes = free_shapes(model)
        amplitudes = [p for p in model.parameters if p.parameter.is_amplitude]
        # Places are counted from one while padded with zeros.
        amplitude = [labels.index(p.label) + 1 if p.free else 0 for p in amplitudes]
        shape = [labels.index(p.label) + 1 if p.label in labels else 0 for p in shapes]
        apart = [1.0 if p.label in labels else result[p.label].value - p.parameter.lower for p in shapes]
        return cls(
            design.padded_terms(np.array(amplitude, int)) - 1,
            design.padded_terms(np.array([0.0 if p.free else float(p.start or 0.0) for p in amplitudes])),
            design.padded_shapes(np.array(shape, float)).astype(int) - 1,
            design.padded_shapes(np.array([p.parameter.lower for p in shapes])),
            design.padded_shapes(np.log(apart)),
        )

    def power(self, values: Float[Array, " params"]) -> Float[Array, " terms"]:
        """Powers of the terms."""
        amplitude = jnp.where(self.amplitude >= 0, values[self.amplitude], self.held)
        return amplitude**2

    def shapes(self, values: Float[Array, " params"]) -> Float[Array, " shapes"]:
        """Transformed shapes of the terms."""
        moved = self.shape >= 0
        return jnp.where(
            moved, jnp.log(jnp.where(moved, values[self.shape] - self.bound, 1.0)), self.held_shape
        )


class _Lines(eqx.Module):
    """Cosine coefficients around each line, padded to one length, and the line's parameters.

    `index`, `coefficients` and `bin` are per coefficient, and `known` is false for padding; `amplitude` and
    `frequency` are indices among the free parameters, −1 for those held at `held`.
    """

    index: Int[np.ndarray, "lines k"]
    coefficients: Float[np.ndarray, "lines k"]
    bin: Int[np.ndarray, "lines k"]
    known: Bool[np.ndarray, "lines k"]
    amplitude: Int[np.ndarray, " lines"]
    frequency: Int[np.ndarray, " lines"]
    held: Float[np.ndarray, "lines 2"]


class WhittleLikelihood(Likelihood):
    """Whittle's likelihood: independent χ² levels of the cosine spectrum.

    The sign of ramps, the phase of lines and the amplitudes of regressors are averaged.
    """

    design: SpectralDesign
    layout: _ParameterLayout
    squares: Float[np.ndarray, " m"]
    cross: Float[np.ndarray, "m columns"]
    gram: Float[np.ndarray, "m columns columns"]
    share: Float[np.ndarray, " m"]
    ramps: Int[np.ndarray, " ramps"]
    lines: _Lines
    n: Int[np.ndarray, ""]
    rate: Float[np.ndarray, ""]

    def __call__(self, values: Float[Array, " params"]) -> Float[Array, ""]:
        design = self.design
        mean = design.mean(self.layout.power(values), design.means(self.layout.shapes(values)))
        weight = jnp.asarray(self.share) / mean
        total = -jnp.sum(design.levels.shape * jnp.log(mean)) - 0.5 * jnp.sum(self.squares * weight)
        p, U = weight @ self.cross, jnp.einsum("m,mab->ab", weight, self.gram)
        q = len(p) - len(self.ramps)
        if q:
            # The regressors' amplitudes have a flat prior and are integrated out.
            half = whiten(U[:q, :q], jnp.concatenate([p[:q, None], U[:q, q:]], axis=1))
            total += 0.5 * jnp.sum(half.values[:, 0] ** 2) - half.log_det
            p = p[q:] - half.values[:, 1:].T @ half.values[:, 0]
            U = U[q:, q:] - half.values[:, 1:].T @ half.values[:, 1:]
        for k in range(len(self.ramps)):
            R = jnp.where(self.ramps[k] >= 0, values[self.ramps[k]], 0.0)
            x = jnp.abs(R * p[k])
            total += x + jnp.log1p(jnp.exp(-2.0 * x)) - jnp.log(2.0) - 0.5 * R**2 * U[k, k]
        for k in range(len(self.lines.amplitude)):
            total += self._line(k, values, weight)
        return total

    def _line(self, k: int, values: Float[Array, " params"], weight: Float[Array, " m"]) -> Float[Array, ""]:
        """Logarithm of a line's likelihood ratio, averaged over its phase (Rice's law)."""
        lines = self.lines
        A = jnp.where(lines.amplitude[k] >= 0, values[lines.amplitude[k]], lines.held[k, 0])
        f = jnp.where(lines.frequency[k] >= 0, values[lines.frequency[k]], lines.held[k, 1])
        columns = line_columns(f, lines.index[k], self.n, self.rate).T
        weighted = columns * jnp.where(lines.known[k], weight[lines.bin[k]], 0.0)
        p = weighted @ lines.coefficients[k]
        u = jnp.sum(weighted * columns) / 2.0
        x = A * jnp.sqrt(jnp.sum(p**2))
        return jnp.log(i0e(x)) + x - 0.5 * A**2 * u


class AllanLikelihood(Likelihood):
    """Likelihood of the Allan variances: correlated χ² laws, whose covariance follows the powers only."""

    design: AllanDesign
    layout: _ParameterLayout
    variance: Float[np.ndarray, " m"]
    products: Float[np.ndarray, "terms terms pairs"]
    power_error: Float[np.ndarray, ""]

    def __call__(self, values: Float[Array, " params"]) -> Float[Array, ""]:
        power = self.layout.power(values)
        mean = self.design.mean(power, self.design.means(self.layout.shapes(values)))
        covariance = self.design.covariance(power, jnp.asarray(self.products))
        known = jnp.arange(len(mean)) < self.design.rows
        own = jnp.where(known, self.design.variances(covariance) / mean**2 + self.power_error**2, 1.0)
        ratio = jnp.where(known, self.variance / mean, 1.0)
        score = cube_root_score(ratio, own)
        whitened = self.design.whiten(
            covariance, mean, jnp.asarray(self.power_error), (score * jnp.sqrt(own))[:, None]
        )
        # The density of V is that of the scores times their derivatives by V.
        slope = -2.0 / 3.0 * jnp.log(ratio) - 0.5 * jnp.log(own) - jnp.log(mean)
        normal = -0.5 * jnp.sum(whitened.values**2) - whitened.log_det + 0.5 * jnp.sum(jnp.log(own))
        return normal + jnp.sum(slope)


def _whittle(fit: Fit, result: AxisFit, parameters: tuple[ModelParameter, ...]) -> WhittleLikelihood:
    """Whittle's likelihood of one axis of a fit."""
    spectrum = result.spectrum
    assert spectrum is not None
    labels = [label for label in fit.template.term_labels if fit.template[label].deterministic]
    noise, size = fit.template.without(labels), spectrum.bins.size.astype(float)
    design = SpectralDesign.of(noise, spectrum.bins, tight=True)
    layout = _ParameterLayout.of(noise, parameters, result, design)
    labels = [p.label for p in parameters]
    # The error of powers is twice that of deviations.
    share = share_with_error(size, spectrum.bins.per_octave(), 2.0 * result.discrepancy)
    columns = np.array([k not in spectrum.lines for k in spectrum.owners], bool)
    ramps = [owner for owner in spectrum.owners if isinstance(owner, int) and owner not in spectrum.lines]
    own = {p.term: [labels.index(q.label) for q in parameters if q.term == p.term] for p in parameters}
    start = start_of(result, parameters)
    level = spectrum.squares / size
    design = design.with_data(level, share * size)
    prior_scale, ceiling, mean, _ = _amplitude_scales(design, layout, start, level, 0.0)
    for k, owner in enumerate(spectrum.owners):
        if isinstance(owner, int) and fit.template.terms[owner].has_free_amplitude:
            place = own[owner][0]
            u = float(np.sum(share * spectrum.gram[:, k, k] / mean))
            prior_scale[place] = 1.0 / np.sqrt(u)
            ceiling[place] = max(PRIOR_RANGE * prior_scale[place], _CEILING * start[place])
    return WhittleLikelihood(
        **_common(fit, result, parameters, prior_scale, ceiling),
        design=design,
        layout=layout,
        # The likelihood ratio of each line neglects the other lines.
        squares=_padded(spectrum.squares - spectrum.overlap, design),
        cross=_padded(spectrum.cross[:, columns], design),
        gram=_padded(spectrum.gram[:, columns][:, :, columns], design),
        share=_padded(share, design),
        ramps=np.array([own[k][0] if k in own else -1 for k in ramps], int),
        lines=_lines(fit, spectrum, labels),
        n=np.asarray(spectrum.bins.n),
        rate=np.asarray(spectrum.bins.rate),
    )


def _padded(x: Float[np.ndarray, "m ..."], design: SpectralDesign) -> Float[np.ndarray, "capacity ..."]:
    """Values of the bins, padded with zeros."""
    return np.pad(x, [(0, len(design.per_octave) - len(x))] + [(0, 0)] * (x.ndim - 1))


def _lines(fit: Fit, spectrum: AxisSpectrum, labels: list[str]) -> _Lines:
    """Coefficients and parameters of the lines of one axis."""
    bins, lines = spectrum.bins, spectrum.lines
    width = 2 * LINE_REACH + 1
    index = np.ones((len(lines), width), int)
    coefficients, known = np.zeros((len(lines), width)), np.zeros((len(lines), width), bool)
    amplitude, frequency = np.full(len(lines), -1), np.full(len(lines), -1)
    held = np.zeros((len(lines), 2))
    for row, (term, line) in enumerate(lines.items()):
        k = len(line.coefficients)
        index[row, :k], coefficients[row, :k], known[row, :k] = line.indices, line.coefficients, True
        own = [p for p in fit.template.parameters if p.term == term]
        held[row] = own[0].start or 0.0, own[1].start or 0.0
        amplitude[row] = labels.index(own[0].label) if own[0].free else -1
        frequency[row] = labels.index(own[1].label) if own[1].free else -1
    own_bin = np.searchsorted(np.cumsum(bins.size), index - 1, side="right")
    return _Lines(index, coefficients, own_bin, known, amplitude, frequency, held)


def _allan(fit: Fit, result: AxisFit, parameters: tuple[ModelParameter, ...], k: int) -> AllanLikelihood:
    """Likelihood of the Allan variances of axis k of a fit."""
    curve = fit.curve
    chosen = slice(0, None, _THINNED)
    sizes, strides = curve.cluster_size[chosen], curve.strides[chosen]
    capacity = (-(-len(sizes) // _SIZES) * _SIZES, _TERMS)
    design = AllanDesign.of(fit.template, curve.n, curve.rate, sizes, strides, capacity)
    layout = _ParameterLayout.of(fit.template, parameters, result, design)
    V, power_error = curve.variance[chosen, k], 2.0 * result.discrepancy
    start = start_of(result, parameters)
    prior_scale, ceiling, _, products = _amplitude_scales(design, layout, start, V, power_error)
    return AllanLikelihood(
        **_common(fit, result, parameters, prior_scale, ceiling),
        design=design,
        layout=layout,
        variance=design.padded_estimates(V[None])[0],
        products=products,
        power_error=np.asarray(power_error),
    )


def _common(
    fit: Fit,
    result: AxisFit,
    parameters: tuple[ModelParameter, ...],
    prior_scale: Float[np.ndarray, " params"],
    ceiling: Float[np.ndarray, " params"],
) -> dict[str, Any]:
    """The fields of `Likelihood`, given prior scales and upper ends of the amplitudes."""
    start = start_of(result, parameters)
    std = np.nan_to_num([result[p.label].std for p in parameters])
    # If the fit has none, it is a share of the prior's scale or of the start.
    rough = np.where(np.isnan(prior_scale), 0.1 * start, 0.5 * prior_scale)
    there = np.array([label in result.term_labels for label in fit.template.term_labels], bool)
    found = of_owners(fit.template, there)[[p.term for p in parameters]]
    lower, upper = ranges_of(parameters, result, fit, ceiling)
    return {
        "parameters": parameters,
        "start": start,
        "scatter": np.where(std > 0.0, std, rough),
        "lower": lower,
        "upper": upper,
        "prior_scale": prior_scale,
        "found": found,
    }


def _amplitude_scales(
    design: Design,
    layout: _ParameterLayout,
    start: Float[np.ndarray, " params"],
    estimates: Float[np.ndarray, " m"],
    power_error: float,
) -> tuple[
    Float[np.ndarray, " params"],
    Float[np.ndarray, " params"],
    Float[np.ndarray, " m"],
    Float[np.ndarray, ...],
]:
    """Prior scale and upper end of the amplitudes, NaN for others; means and products at the start."""
    prior_scale, ceiling = np.full((2, len(start)), np.nan)
    at_start = jax.device_get(_at_start(design, layout, start, np.asarray(power_error)))
    means, mean = (x[..., : len(estimates)] for x in at_start[:2])
    with np.errstate(divide="ignore"):
        own = at_start[2] ** -0.25
        # The largest amplitude with which a term's curve is nowhere above the data.
        fits = np.sqrt(np.min(np.maximum(mean, estimates) / means, axis=1))
    for term, place in enumerate(layout.amplitude):
        if place >= 0:
            prior_scale[place] = own[term]
            ceiling[place] = max(PRIOR_RANGE * own[term], _CEILING * fits[term])
    return prior_scale, ceiling, mean, at_start[3]


@eqx.filter_jit
def _at_start(
    design: Design,
    layout: _ParameterLayout,
    start: Float[ArrayLike, " params"],
    power_error: Float[ArrayLike, ""],
) -> tuple[Array, Array, Array, Array]:
    """Means of unit amplitudes, expected estimates, each amplitude's information on its power, products."""
    values = jnp.asarray(start)
    power, shapes = layout.power(values), layout.shapes(values)
    means, products = design.means(shapes), design.products(shapes)
    mean = design.mean(power, means)
    covariance = design.covariance(power, products)
    whitened = design.whiten(covariance, mean, jnp.asarray(power_error), (means / mean).T).values
    return means, mean, jnp.sum(whitened**2, axis=0), products


class WiderLikelihood(Likelihood):
    """Likelihood of a complete record, widened by a factor for missing samples."""

    complete: Likelihood
    factor: Float[np.ndarray, ""]

    @classmethod
    def of(cls, complete: Likelihood, factor: float) -> WiderLikelihood:
        """Likelihood whose standard deviations, including that of the powers, are wider by this factor."""
        return cls(
            complete.parameters,
            complete.start,
            complete.scatter * factor,
            complete.lower,
            complete.upper,
            complete.prior_scale * np.sqrt(factor),
            complete.found,
            complete,
            np.array(factor),
        )

    def __call__(self, values: Float[Array, " params"]) -> Float[Array, ""]:
        return self.complete(values) / self.factor**2

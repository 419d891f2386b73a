"""Likelihood of a fit's data as a function of its parameters, for sampling, in NumPy.

It is that of the cosine spectrum (Whittle's; see `cosine`) or that of the Allan variances. The latter
transforms each variance by its χ² law under the model to a normal score (Wilson & Hilferty 1931); the scores
are jointly normal with the correlations of the variances.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.special import i0e

from allanjax.base.chi_squared import cube_root_score
from allanjax.base.errors import FitError
from allanjax.estimate.axis_fits import ALLAN_CAPACITY
from allanjax.estimate.design import AllanDesign, of_owners
from allanjax.estimate.deterministic import LINE_REACH, Line, line_columns
from allanjax.estimate.evidence import PRIOR_RANGE
from allanjax.estimate.result import AxisFit, Fit
from allanjax.estimate.spectral.expected import ExpectedLevels, in_batches
from allanjax.estimate.spectral.fit import share_with_error
from allanjax.noise.model import Model, ModelParameter
from allanjax.posterior.priors import LogUniform, ModifiedLogUniform, Prior, Uniform

# Largest distance of a resonance's frequency from its fit, in ln.
_LINE_RANGE = 0.3
# The likelihood of the Allan variances uses every second cluster time of the fit, which has four per octave.
_THINNED = 2
# Priors of amplitudes extend by at least this factor beyond the largest value that the data allow.
_CEILING = 1e2
# Rows of values that are evaluated at a time, few enough for a core's cache.
_ROWS = 64


@dataclasses.dataclass(frozen=True)
class Likelihood:
    """Log-likelihood of the free parameters of a model, in SI and in the model's order.

    Attributes:
        parameters: the free parameters.
        start, scatter: the fit's estimate (zero for amplitudes of absent terms) and its rough standard
            deviation.
        lower, upper: a range that contains all reasonable values.
        prior_scale: the amplitude whose power would be one standard deviation in these data; NaN for other
            parameters.
        found: which parameters belong to terms that the fit detected.
        density: the likelihood of a complete record, from values of all parameters of the model.
        widening: factor by which missing samples widen it.
        held: values of all parameters of the model.
        places: which of these are the free ones.
    """

    parameters: tuple[ModelParameter, ...]
    start: Float[np.ndarray, " params"]
    scatter: Float[np.ndarray, " params"]
    lower: Float[np.ndarray, " params"]
    upper: Float[np.ndarray, " params"]
    prior_scale: Float[np.ndarray, " params"]
    found: Bool[np.ndarray, " params"]
    density: WhittleDensity | AllanDensity
    widening: float
    held: Float[np.ndarray, " all"]
    places: Int[np.ndarray, " params"]

    def __call__(self, values: Float[np.ndarray, "b params"]) -> Float[np.ndarray, " b"]:
        """Log-likelihood [nats] up to a constant; NaN or −inf where the noise has no power."""
        every = np.tile(self.held, (len(values), 1))
        every[:, self.places] = values
        with np.errstate(all="ignore"):
            parts = [self.density(every[k : k + _ROWS]) for k in range(0, len(every), _ROWS)]
        return np.concatenate(parts) / self.widening**2

    def default_priors(self) -> dict[str, Prior]:
        """Default priors of `sample`, by label, in SI.

        Amplitudes: `ModifiedLogUniform`, with the smallest amplitude that these data distinguish from zero as
        its scale. Times, frequencies and numbers: `LogUniform` in the distance from the parameter's lower
        bound. Frequencies of lines: `Uniform`. Supports are those of the likelihood, far wider than needed.
        """
        priors: dict[str, Prior] = {}
        ends = zip(self.parameters, self.lower.tolist(), self.upper.tolist(), self.prior_scale, strict=True)
        for p, lower, upper, scale in ends:
            if p.parameter.is_amplitude:
                priors[p.label] = ModifiedLogUniform(float(scale), upper)
            elif p.parameter.kind == "line":
                priors[p.label] = Uniform(lower, upper)
            else:
                priors[p.label] = LogUniform(lower, upper, p.parameter.lower)
        return priors


def likelihood_of(fit: Fit, axis: str) -> Likelihood:
    """Likelihood of one axis of a fit: Whittle's for `objective="whittle"`, else that of its Allan variances.

    Raises:
        FitError: the axis did not converge, or was loaded from a file that does not hold its spectrum, or
            was fitted to wavelet variances.
    """
    result, every = fit[axis], fit.template.parameters
    if not result.converged:
        raise FitError(f"{axis}: the fit failed, so that there is no posterior to sample: {result.reason}")
    if result.spectrum is None and fit.objective == "whittle":
        raise FitError(
            f"{axis}: the fit was loaded from a file without the fitted spectrum; "
            "fit the recording again before sampling"
        )
    if result.spectrum is None and fit.objective == "wavelet":
        raise FitError(
            f'{axis}: a fit of wavelet variances has no likelihood to sample; use objective="whittle"'
        )
    # The Allan variances do not determine the frequency of a line.
    lines = [k for k, term in enumerate(fit.template.terms) if term.deterministic and result.spectrum is None]
    places = [k for k, p in enumerate(every) if p.free and (p.parameter.is_amplitude or p.term not in lines)]
    values = np.array([result[p.label].value if p.free else p.start or 0.0 for p in every], float)
    # Shapes of absent terms have some value in their range.
    held = np.where(np.isfinite(values), values, [p.parameter.lower + 1.0 for p in every])
    density = (AllanDensity if result.spectrum is None else WhittleDensity)(fit, result, held)
    parameters, start = tuple(every[k] for k in places), held[places]
    scale, ceiling = np.full((2, len(every)), np.nan)
    for k, (own, largest) in density.scales(held).items():
        scale[k], ceiling[k] = own, max(PRIOR_RANGE * own, _CEILING * largest)
    scale, std = scale[places], np.nan_to_num([result[p.label].std for p in parameters])
    # If the fit has none, it is a share of the prior's scale or of the start.
    rough = np.where(np.isnan(scale), 0.1 * start, 0.5 * scale)
    there = np.array([label in result.term_labels for label in fit.template.term_labels], bool)
    lower, upper = _ranges(parameters, fit, start, ceiling[places])
    return Likelihood(
        parameters=parameters,
        start=start,
        scatter=np.where(std > 0.0, std, rough) * result.widening,
        lower=lower,
        upper=upper,
        prior_scale=scale * np.sqrt(result.widening),
        found=of_owners(fit.template, there)[[p.term for p in parameters]],
        density=density,
        widening=result.widening,
        held=held,
        places=np.array(places, int),
    )


def _ranges(
    parameters: tuple[ModelParameter, ...],
    fit: Fit,
    start: Float[np.ndarray, " params"],
    ceiling: Float[np.ndarray, " params"],
) -> tuple[Float[np.ndarray, " params"], Float[np.ndarray, " params"]]:
    """Lower and upper ends of the parameters' ranges, given those of the amplitudes."""
    n, rate = fit.curve.n, fit.curve.rate
    lower, upper = np.zeros(len(parameters)), ceiling.copy()
    observable = {"time": (2.0 / rate, n / rate), "frequency": (rate / n, rate / 2.0)}
    for k, (p, f) in enumerate(zip(parameters, start, strict=True)):
        if p.parameter.kind in observable:
            lower[k], upper[k] = observable[p.parameter.kind]
        elif p.parameter.kind == "number":
            lowest = p.parameter.lower
            lower[k], upper[k] = lowest + 1e-2, min(lowest + 1e4, p.parameter.upper - 1e-2)
        elif p.parameter.kind == "line" and fit.template.terms[p.term].deterministic:
            reach = LINE_REACH / 2.0 * rate / (2.0 * n)
            lower[k], upper[k] = max(f - reach, 0.1 * rate / n), min(f + reach, rate / 2.0)
        elif p.parameter.kind == "line":
            lower[k], upper[k] = f * np.exp(-_LINE_RANGE), min(f * np.exp(_LINE_RANGE), rate / 2.0)
    return lower, upper


class WhittleDensity:
    """Whittle's likelihood: independent χ² levels of the cosine spectrum.

    The sign of ramps, the phase of lines and the amplitudes of regressors are averaged.
    """

    def __init__(self, fit: Fit, result: AxisFit, _: Float[np.ndarray, " all"]) -> None:
        spectrum, model = result.spectrum, fit.template
        assert spectrum is not None
        self._bins, self._spectrum = spectrum.bins, spectrum
        random = [k for k, term in enumerate(model.terms) if not term.deterministic]
        labels = [model.term_labels[k] for k in range(len(model)) if k not in random]
        #: Places of the parameters of the random terms, and of each term's amplitude among all.
        self._own = [k for k, p in enumerate(model.parameters) if p.term in random or p.term == len(model)]
        self._amplitude = _amplitudes(model)
        self._random = self._amplitude[random]
        self._levels = ExpectedLevels(model.without(labels), spectrum.bins)
        size = spectrum.bins.size.astype(float)
        # The error of powers is twice that of deviations.
        self._share = share_with_error(size, spectrum.bins.per_octave(), 2.0 * result.discrepancy)
        self._shape = 0.5 * self._share * size
        # The likelihood ratio of each line neglects the other lines.
        self._squares = self._share * (spectrum.squares - spectrum.overlap)
        columns = [k for k, owner in enumerate(spectrum.owners) if owner not in spectrum.lines]
        self._cross = self._share[:, None] * spectrum.cross[:, columns]
        self._gram = self._share[:, None, None] * spectrum.gram[:, columns][:, :, columns]
        owners = [spectrum.owners[k] for k in columns]
        self._ramps = [self._amplitude[owner] for owner in owners if isinstance(owner, int)]
        ends = np.cumsum(size)
        #: Each line, the bins of its coefficients, and the place of its amplitude before its frequency.
        self._lines = [
            (line, np.searchsorted(ends, line.indices - 1, side="right"), self._amplitude[k])
            for k, line in spectrum.lines.items()
        ]

    def __call__(self, values: Float[np.ndarray, "b all"]) -> Float[np.ndarray, " b"]:
        inverse = 1.0 / self._mean(values)
        total = np.log(inverse) @ self._shape - 0.5 * inverse @ self._squares
        p, U = inverse @ self._cross, np.einsum("bm,mij->bij", inverse, self._gram)
        q = p.shape[1] - len(self._ramps)
        if q:
            # The regressors' amplitudes have a flat prior and are integrated out.
            beside = np.concatenate([p[:, :q, None], U[:, :q, q:]], axis=2)
            solved = np.linalg.solve(U[:, :q, :q], beside)
            explained = np.einsum("bqi,bqj->bij", beside, solved)
            total += 0.5 * explained[:, 0, 0] - 0.5 * np.linalg.slogdet(U[:, :q, :q])[1]
            p, U = p[:, q:] - explained[:, 0, 1:], U[:, q:, q:] - explained[:, 1:, 1:]
        for k, place in enumerate(self._ramps):
            ramp = values[:, place]
            x = abs(ramp * p[:, k])
            total += np.logaddexp(x, -x) - np.log(2.0) - 0.5 * ramp**2 * U[:, k, k]
        for line, of, place in self._lines:
            total += self._line(line, of, values[:, place : place + 2], inverse)
        return total

    def scales(self, values: Float[np.ndarray, " all"]) -> dict[int, tuple[float, float]]:
        """By the place of each amplitude: that of one standard deviation, and the largest the data allow."""
        found, level = {}, self._spectrum.squares / self._bins.size
        mean = self._mean(values[None])[0]
        with np.errstate(divide="ignore"):
            for place, unit in zip(self._random, self._levels(values[None, self._own])[0], strict=True):
                scale = float(np.sum(self._shape * (unit / mean) ** 2)) ** -0.25
                # The largest amplitude with which a term's curve is nowhere above the data.
                found[int(place)] = scale, float(np.sqrt(np.min(np.maximum(mean, level) / unit)))
        for k, owner in enumerate(self._spectrum.owners):
            if isinstance(owner, int):
                place = int(self._amplitude[owner])
                scale = float(np.sum(self._share * self._spectrum.gram[:, k, k] / mean)) ** -0.5
                found[place] = scale, values[place]
        return found

    def _mean(self, values: Float[np.ndarray, "b all"]) -> Float[np.ndarray, "b m"]:
        """Expected levels [rate²]."""
        power, units = values[:, self._random] ** 2, self._levels(values[:, self._own])
        return power @ units[0] if len(units) == 1 else np.einsum("bk,bkm->bm", power, units)

    def _line(
        self, line: Line, of: Any, values: Float[np.ndarray, "b 2"], inverse: Float[np.ndarray, "b m"]
    ) -> Float[np.ndarray, " b"]:
        """Logarithm of a line's likelihood ratio, averaged over its phase (Rice's law).

        `of`: the bins of its coefficients; `values`: its amplitude and frequency.
        """
        columns = line_columns(values[:, 1:], line.indices, self._bins.n, self._bins.rate)
        weighted = columns * (self._share * inverse)[:, of, None]
        p = np.einsum("bki,k->bi", weighted, line.coefficients)
        u = np.sum(weighted * columns, axis=(1, 2)) / 2.0
        x = values[:, 0] * np.hypot(*p.T)
        return np.log(i0e(x)) + x - 0.5 * values[:, 0] ** 2 * u


class AllanDensity:
    """Likelihood of the Allan variances: correlated χ² laws, whose covariance follows the powers only."""

    def __init__(self, fit: Fit, result: AxisFit, values: Float[np.ndarray, " all"]) -> None:
        curve, model = fit.curve, fit.template
        # The fit's own design, whose programs are there.
        design = AllanDesign.of(model, curve.n, curve.rate, curve.cluster_size, curve.strides, ALLAN_CAPACITY)
        rows = np.arange(0, len(curve.cluster_size), _THINNED)
        self._variance = curve.variance[rows, fit.axes.index(result.axis.name)]
        self._error = 2.0 * result.discrepancy
        self._amplitude = _amplitudes(model)
        self._shapes = [k for k, p in enumerate(model.parameters) if p.free and not p.parameter.is_amplitude]
        self._lower = np.array([model.parameters[k].parameter.lower for k in self._shapes])
        shape = np.log(values[self._shapes] - self._lower)
        tangent, m = design.tangent(shape[None]), len(curve.cluster_size)
        products = tangent.products.reshape(len(model), len(model), m, m)
        self._products = products[:, :, rows[:, None], rows]
        self._ridge, self._octaves = tangent.ridge, tangent.octaves[np.ix_(rows, rows)]
        self._design, self._rows, self._constant = design, rows, tangent.means[:, :, rows]

    def __call__(self, values: Float[np.ndarray, "b all"]) -> Float[np.ndarray, " b"]:
        _, mean, relative = self._moments(values)
        # Of a relative error of the model, too, which an octave has in common.
        own = np.einsum("bii->bi", relative) + self._error**2
        correlated = self._correlated(relative)
        ratio = self._variance / mean
        score = np.asarray(cube_root_score(ratio, own)) * np.sqrt(own)
        # The density of V is that of the scores times their derivatives by V.
        slope = -2.0 / 3.0 * np.log(ratio) - np.log(mean)
        squares = np.sum(score * np.linalg.solve(correlated, score[..., None])[..., 0], axis=1)
        return np.sum(slope, axis=1) - 0.5 * squares - 0.5 * np.linalg.slogdet(correlated)[1]

    def scales(self, values: Float[np.ndarray, " all"]) -> dict[int, tuple[float, float]]:
        units, (mean,), relative = self._moments(values[None])
        found, solved = {}, np.linalg.solve(self._correlated(relative)[0], (units[0] / mean).T)
        with np.errstate(divide="ignore"):
            for k, (place, unit) in enumerate(zip(self._amplitude, units[0], strict=True)):
                fits = float(np.sqrt(np.min(np.maximum(mean, self._variance) / unit)))
                found[int(place)] = float(unit / mean @ solved[:, k]) ** -0.25, fits
        return found

    def _moments(
        self, values: Float[np.ndarray, "b all"]
    ) -> tuple[Float[np.ndarray, "_ terms m"], Float[np.ndarray, "b m"], Float[np.ndarray, "b m m"]]:
        """Variances of unit amplitudes, expected variances, and the covariance of their ratios to these."""
        power = values[:, self._amplitude] ** 2
        units = self._constant
        if self._shapes:
            shape = np.log(values[:, self._shapes] - self._lower)
            units = in_batches(AllanDesign.means, self._design, shape)[:, : power.shape[1], self._rows]
        mean = np.einsum("bk,bkm->bm", power, np.broadcast_to(units, (len(values), *units.shape[1:])))
        covariance = np.einsum("bk,bl,klij->bij", power, power, self._products, optimize=True)
        return units, mean, covariance / (mean[:, :, None] * mean[:, None])

    def _correlated(self, relative: Float[np.ndarray, "b m m"]) -> Float[np.ndarray, "b m m"]:
        """Covariance with the ridge of the quadrature's errors and the model's error."""
        return relative * (1.0 + self._ridge * np.eye(relative.shape[-1])) + self._error**2 * self._octaves


def _amplitudes(model: Model) -> Int[np.ndarray, " terms"]:
    """Place of each term's amplitude among the parameters of a model."""
    return np.array([k for k, p in enumerate(model.parameters) if p.parameter.is_amplitude], int)

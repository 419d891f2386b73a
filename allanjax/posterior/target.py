"""Log-posterior of one axis: the likelihood of the fit's data [nats], priors and coordinates, in NumPy.

Likelihoods are those of the cosine spectrum (Whittle's; see `cosine`) and of the Allan variances, for many
values of all parameters of the model at once.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import TypeAlias

import numpy as np
from jaxtyping import Float
from scipy.special import i0e

from allanjax.base.chi_squared import cube_root_score
from allanjax.base.errors import AllanjaxError, FitError
from allanjax.estimate.axis_fits import ALLAN_CAPACITY
from allanjax.estimate.design import AllanDesign, AllanTangent, free_shapes, of_owners
from allanjax.estimate.deterministic import LINE_REACH, Line, line_columns
from allanjax.estimate.evidence import PRIOR_RANGE
from allanjax.estimate.result import AxisFit, Fit
from allanjax.estimate.spectral.components import in_batches
from allanjax.estimate.spectral.fit import Arrangement, share_with_error
from allanjax.noise.model import Model, ModelParameter
from allanjax.posterior.priors import LogUniform, ModifiedLogUniform, Prior

# The likelihood of the Allan variances uses every second cluster time of the fit, which has four per octave.
_THINNED = 2
# Largest ratio of a resonance's frequency and its fit.
_LINE_RANGE = 1.35
# The prior of an amplitude extends by at least this factor beyond the fit's.
_CEILING = 1e2
# Scatter of the first walkers over the fit's standard deviations, and attempts to place them.
_OVERDISPERSION, _ATTEMPTS = 1.5, 20

_All: TypeAlias = Float[np.ndarray, " all"]
_Values: TypeAlias = Float[np.ndarray, "b all"]
_Levels: TypeAlias = Float[np.ndarray, "b m"]
_Logs: TypeAlias = Float[np.ndarray, " b"]


class _Density:
    """Indices of all amplitudes of a model, of those of some `terms` (`own`), and of the free shapes."""

    def __init__(self, model: Model, terms: Sequence[int]) -> None:
        self.amplitude = np.array([k for k, p in enumerate(model.parameters) if p.parameter.is_amplitude])
        self.own, owners = self.amplitude[np.array(terms, int)], (*terms, len(model))
        shapes = [p for p in free_shapes(model) if p.term in owners]
        self._shapes = [model.parameters.index(p) for p in shapes]
        self._lower = np.array([p.parameter.lower for p in shapes])

    def shape(self, values: _Values) -> Float[np.ndarray, "b shapes"]:
        """The free shapes in ln of the distance from their bounds."""
        return np.log(values[:, self._shapes] - self._lower)


class WhittleDensity(_Density):
    """Whittle's likelihood: independent χ² levels of the cosine spectrum.

    The sign of ramps, the phase of lines and the amplitudes of regressors are averaged.
    """

    def __init__(self, fit: Fit, result: AxisFit, values: _All) -> None:
        spectrum, model = result.spectrum, fit.template
        assert spectrum is not None
        self._spectrum, self._bins, size = spectrum, spectrum.bins, spectrum.bins.size.astype(float)
        random = [k for k, term in enumerate(model.terms) if not term.deterministic]
        super().__init__(model, random)
        others = [label for k, label in enumerate(model.term_labels) if k not in random]
        self._of, self._last = Arrangement.of(model.without(others), self._bins), (b"", np.zeros((0, 0, 0)))
        level = np.where(size > 0.0, spectrum.squares / np.maximum(size, 1.0), 1.0)
        ends = self._of.with_data(level, size).error_of_ends(
            self.shape(values[None])[0], values[self.own] ** 2
        )
        # The error of powers is twice that of deviations.
        error = self._bins.per_octave() * (2.0 * result.discrepancy) ** 2 + ends
        self._share = share_with_error(size, error)
        self._half = 0.5 * self._share * size
        # The likelihood ratio of each line neglects the other lines.
        self._squares = self._share * (spectrum.squares - spectrum.overlap)
        columns = [k for k, owner in enumerate(spectrum.owners) if owner not in spectrum.lines]
        self._cross = self._share[:, None] * spectrum.cross[:, columns]
        self._gram = self._share[:, None, None] * spectrum.gram[:, columns][:, :, columns]
        #: Places of the amplitudes of the last columns; those before are of regressors.
        owners = [spectrum.owners[k] for k in columns]
        self._ramps = [self.amplitude[owner] for owner in owners if isinstance(owner, int)]

    def __call__(self, values: _Values) -> _Logs:
        inverse = 1.0 / self._mean(values)
        total = np.log(inverse) @ self._half - 0.5 * inverse @ self._squares
        p, U = inverse @ self._cross, np.einsum("bm,mij->bij", inverse, self._gram)
        if q := p.shape[1] - len(self._ramps):
            # The regressors' amplitudes have a flat prior and are integrated out.
            beside = np.concatenate([p[:, :q, None], U[:, :q, q:]], axis=2)
            explained = np.swapaxes(beside, 1, 2) @ np.linalg.solve(U[:, :q, :q], beside)
            total += 0.5 * explained[:, 0, 0] - 0.5 * np.linalg.slogdet(U[:, :q, :q])[1]
            p, U = p[:, q:] - explained[:, 0, 1:], U[:, q:, q:] - explained[:, 1:, 1:]
        for k, place in enumerate(self._ramps):
            x = abs(values[:, place] * p[:, k])
            total += np.logaddexp(x, -x) - np.log(2.0) - 0.5 * values[:, place] ** 2 * U[:, k, k]
        for k, line in self._spectrum.lines.items():
            place = self.amplitude[k]
            total += self._line(line, values[:, place], values[:, place + 1], inverse)
        return total

    def scales(self, values: _All) -> dict[int, float]:
        """By index, the amplitude of each term whose power is one standard deviation about these values."""
        mean, units = self._mean(values[None])[0], self._levels(values[None])[0]
        information = np.sum(self._half * (units / mean) ** 2, axis=1)
        found = dict(zip(self.own.tolist(), (information**-0.25).tolist(), strict=True))
        for k, owner in enumerate(self._spectrum.owners):
            if isinstance(owner, int):
                power = np.sum(self._share * self._spectrum.gram[:, k, k] / mean)
                found[int(self.amplitude[owner])] = float(power**-0.5)
        return found

    def _levels(self, values: _Values) -> Float[np.ndarray, "_ terms m"]:
        """Levels of the random terms of unit amplitude, which walkers with the same shapes have in common."""
        shapes = self.shape(values)
        if not (shapes == shapes[:1]).all():
            return self._of.expected(shapes)
        if (key := b"|" + shapes[0].tobytes()) != self._last[0]:
            self._last = key, self._of.expected(shapes[:1])
        return self._last[1]

    def _mean(self, values: _Values) -> _Levels:
        """Expected levels [rate²]."""
        power, units = values[:, self.own] ** 2, self._levels(values)
        return power @ units[0] if len(units) == 1 else np.einsum("bk,bkm->bm", power, units)

    def _line(self, line: Line, amplitude: _Logs, frequency: _Logs, inverse: _Levels) -> _Logs:
        """Logarithm of a line's likelihood ratio, averaged over its phase (Rice's law)."""
        columns = line_columns(frequency[:, None], line.indices, self._bins.n, self._bins.rate)
        of = np.searchsorted(np.cumsum(self._bins.size), line.indices - 1, side="right")
        weighted = columns * (self._share * inverse)[:, of, None]
        x = amplitude * np.hypot(*np.einsum("bki,k->ib", weighted, line.coefficients))
        return np.log(i0e(x)) + x - 0.25 * amplitude**2 * np.sum(weighted * columns, axis=(1, 2))


class AllanDensity(_Density):
    """Likelihood of the Allan variances: correlated χ² laws, whose covariance follows the powers only.

    Each variance is transformed by its χ² law under the model to a normal score (Wilson & Hilferty 1931); the
    scores are jointly normal with the correlations of the variances.
    """

    def __init__(self, fit: Fit, result: AxisFit, values: _All) -> None:
        model, names = fit.template, ("cluster_time", "cluster_size", "deviation", "count", "edf")
        super().__init__(model, range(len(model)))
        thinned = {name: getattr(fit.curve, name)[::_THINNED] for name in names}
        curve = dataclasses.replace(fit.curve, **thinned)
        # Padded as the fit's own design, whose programs are there.
        self._design = AllanDesign.of(model, curve, ALLAN_CAPACITY)
        self._tangent = self._design.tangent(self.shape(values[None]))
        self._variance = curve.variance[:, fit.axes.index(result.axis.name)]
        self._error = np.full(1, 2.0 * result.discrepancy)

    def _around(self, values: _Values) -> tuple[AllanTangent, Float[np.ndarray, "b terms"]]:
        """The model with these shapes, and powers; its covariance follows the powers only."""
        units, (_, terms, m) = self._tangent.means, self._tangent.means.shape
        if self._shapes:
            units = in_batches(AllanDesign.means, self._design, self.shape(values))[:, :terms, :m]
        return dataclasses.replace(self._tangent, means=units), values[:, self.own] ** 2

    def __call__(self, values: _Values) -> _Logs:
        at, power = self._around(values)
        mean, correlated = at.mean(power), at.relative(power, self._error)
        own = np.einsum("bii->bi", correlated)
        ratio = self._variance / mean
        score = np.asarray(cube_root_score(ratio, own)) * np.sqrt(own)
        # The density of V is that of the scores times their derivatives by V.
        slope = -2.0 / 3.0 * np.log(ratio) - np.log(mean)
        squares = np.sum(score * np.linalg.solve(correlated, score[..., None])[..., 0], axis=1)
        return np.sum(slope, axis=1) - 0.5 * squares - 0.5 * np.linalg.slogdet(correlated)[1]

    def scales(self, values: _All) -> dict[int, float]:
        """As of `WhittleDensity`."""
        at, power = self._around(values[None])
        columns = (at.means / at.mean(power)[:, None]).swapaxes(1, 2)
        information = np.sum(columns * at.weighed(power, self._error, columns), axis=1)[0]
        return dict(zip(self.own.tolist(), (information**-0.25).tolist(), strict=True))


class Target:
    """Log-posterior of one axis of a fit, in coordinates y of the sampled parameters x = origin + e^y.

    Default priors are uniform in y: an amplitude's origin is −(scale of its prior). `given` are the user's
    priors by label.

    Attributes:
        parameters: all parameters of the model.
        priors: the priors of the free parameters, by their index.
        sampled: indices of the sampled ones.
        base: values of all [SI], where amplitudes that are not sampled are 0.
        std, origin: rough standard deviations [SI], and origins of the coordinates.

    Raises:
        AllanjaxError: `given` names no parameter, or is no prior.
        FitError: the fit has no likelihood, or nothing to sample.
    """

    def __init__(self, fit: Fit, axis: str, given: Mapping[str, Prior]) -> None:
        result, model, self.parameters = fit[axis], fit.template, fit.template.parameters
        start = [result[p.label].value if p.free else p.start or 0.0 for p in self.parameters]
        self.axis, self.widening = axis, result.widening
        self.origin = np.array([p.parameter.lower for p in self.parameters])
        # Shapes of absent terms have some value in their range.
        self.base = np.where(np.isfinite(start), start, self.origin + 1.0)
        self._density, self.std = _density_of(fit, result, self.base), 0.1 * self.base
        self.priors, scales = dict[int, Prior](), self._density.scales(self.base)
        for k, p in enumerate(self.parameters):
            deterministic = p.term < len(model) and model.terms[p.term].deterministic
            if p.free and p.parameter.is_amplitude:
                upper = max(PRIOR_RANGE * scales[k], _CEILING * float(self.base[k]))
                self.origin[k], self.std[k] = -scales[k] * self.widening**0.5, 0.5 * scales[k]
                self.priors[k] = ModifiedLogUniform(-float(self.origin[k]), upper)
            elif p.free and not (result.spectrum is None and deterministic):
                # The Allan variances do not determine the frequency of a line.
                self.priors[k] = _prior_of_shape(p, float(self.base[k]), fit, deterministic)
        labels = {self.parameters[k].label: k for k in self.priors}
        for label, prior in given.items():
            if label not in labels or not isinstance(prior, Prior):
                wanted = f"give priors such as LogUniform(1e-6, 1e-4), of {', '.join(labels)}"
                raise AllanjaxError(f"priors has {prior!r} of {label!r}; {wanted}")
            self.priors[labels[label]] = prior
        found = of_owners(model, np.array([label in result.term_labels for label in model.term_labels], bool))
        self.sampled = np.array([k for k in self.priors if found[self.parameters[k].term] or not fit.chosen])
        if not self.sampled.size:
            raise FitError(f"{axis}: no posterior: the fit detected no term and has no free parameter")
        for k, prior in self.priors.items():
            own = result[self.parameters[k].label].std
            self.std[k] = self.widening * (own if own > 0.0 else self.std[k])
            kept = k in self.sampled or not self.parameters[k].parameter.is_amplitude
            self.base[k] = np.clip(self.base[k], prior.lower, prior.upper) if kept else 0.0

    def values(self, y: Float[np.ndarray, "*batch sampled"]) -> Float[np.ndarray, "*batch all"]:
        """Values of all parameters [SI] at these coordinates."""
        values = np.tile(self.base, (*y.shape[:-1], 1))
        values[..., self.sampled] = self.drawn(y)
        return values

    def drawn(self, y: Float[np.ndarray, "*batch sampled"]) -> Float[np.ndarray, "*batch sampled"]:
        """Values of the sampled parameters [SI] at these coordinates."""
        return self.origin[self.sampled] + np.exp(y)

    def log_prior(self, x: Float[np.ndarray, ...], index: int) -> Float[np.ndarray, ...]:
        """Logarithm of the prior density of a parameter's coordinate at the value x [SI]."""
        return self.priors[index].log_density(x) + np.log(x - self.origin[index])

    def log_density(self, values: Float[np.ndarray, "b all"]) -> Float[np.ndarray, " b"]:
        """Log-likelihood plus log prior density of the sampled coordinates; −inf outside the support."""
        with np.errstate(all="ignore"):
            total = np.sum([self.log_prior(values[:, i], i) for i in self.sampled], axis=0)
            # Outside the support the likelihood may be undefined.
            inside = np.isfinite(total)
            if inside.any():
                total[inside] += self._density(values[inside]) / self.widening**2
        return np.where(np.isfinite(total), total, -np.inf)

    def __call__(self, y: Float[np.ndarray, "b sampled"]) -> Float[np.ndarray, " b"]:
        """Log-posterior density of the sampled coordinates."""
        return self.log_density(self.values(y))

    def first_walkers(self, count: int, random: np.random.RandomState) -> Float[np.ndarray, "count sampled"]:
        """Coordinates of a cloud around the fit, a little wider than its errors, inside the support.

        Raises:
            FitError: the posterior is zero there.
        """
        origin, found = self.origin[self.sampled], np.empty((0, len(self.sampled)))
        distance = self.base[self.sampled] - origin
        spread = _OVERDISPERSION * np.minimum(self.std[self.sampled] / distance, 1.0)
        for _ in range(_ATTEMPTS):
            cloud = origin + distance * np.exp(spread * random.standard_normal((count, len(origin))))
            cloud = np.where(origin < 0.0, abs(cloud), cloud)
            for x, prior in zip(cloud.T, [self.priors[i] for i in self.sampled], strict=True):
                outside = (x < prior.lower) | (x > prior.upper)
                x[outside] = prior.quantile(random.uniform(size=outside.sum()))
            y = np.log(cloud - origin)
            found = np.concatenate([found, y[np.isfinite(self(y))]])
            if len(found) >= count:
                return found[:count]
        raise FitError(f"{self.axis}: the posterior has no density near the fit; check the priors")


def _density_of(fit: Fit, result: AxisFit, values: _All) -> WhittleDensity | AllanDensity:
    """Likelihood of the data that the axis was fitted to."""
    if result.spectrum is not None:
        return WhittleDensity(fit, result, values)
    refused = {
        "whittle": "the fit was loaded from a file without the fitted spectrum; fit the recording again",
        "wavelet": 'a fit of wavelet variances has no likelihood to sample; use objective="whittle"',
    }
    if fit.objective in refused:
        raise FitError(f"{result.axis.name}: {refused[fit.objective]}")
    return AllanDensity(fit, result, values)


def _prior_of_shape(p: ModelParameter, start: float, fit: Fit, deterministic: bool) -> Prior:
    """Default prior of a parameter that is not an amplitude, over a range far wider than needed."""
    own, n, rate = p.parameter, fit.curve.n, fit.curve.rate
    lowest, highest = start / _LINE_RANGE, start * _LINE_RANGE
    if deterministic:
        reach = LINE_REACH / 4.0 * rate / n
        lowest, highest = max(start - reach, 0.1 * rate / n), start + reach
    ends = {
        "time": (2.0 / rate, n / rate),
        "frequency": (rate / n, rate / 2.0),
        "number": (own.lower + 1e-2, min(own.lower + 1e4, own.upper - 1e-2)),
        "line": (lowest, min(highest, rate / 2.0)),
    }
    return LogUniform(*ends[own.kind], own.lower)

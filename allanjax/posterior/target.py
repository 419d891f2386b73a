"""What is sampled of one axis: its likelihood, priors and coordinates."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float

from allanjax.base.errors import AllanjaxError, FitError
from allanjax.estimate.design import of_owners
from allanjax.estimate.deterministic import LINE_REACH
from allanjax.estimate.evidence import PRIOR_RANGE
from allanjax.estimate.result import AxisFit, Fit
from allanjax.noise.model import Model, ModelParameter
from allanjax.posterior.likelihood import AllanDensity, WhittleDensity
from allanjax.posterior.priors import LogUniform, ModifiedLogUniform, Prior

# Largest ratio of a resonance's frequency and its fit.
_LINE_RANGE = 1.35
# The prior of an amplitude extends by at least this factor beyond the fit's.
_CEILING = 1e2
# Scatter of the first walkers over the fit's standard deviations, and attempts to place them.
_OVERDISPERSION, _ATTEMPTS = 1.5, 20


class Target:
    """Log-posterior of one axis of a fit, in coordinates y of the sampled parameters x = origin + e^y.

    Default priors are uniform in y: an amplitude's origin is −(scale of its prior).

    Args:
        fit, axis: the fit, whose model is that of the axis.
        given: the user's priors by label.

    Attributes:
        parameters: all parameters of the model.
        priors: priors of the free ones, by their index.
        sampled: indices of the sampled ones.
        base: values of all [SI], where amplitudes that are not sampled are 0.
        std, origin: rough standard deviations [SI], and origins of the coordinates.

    Raises:
        AllanjaxError: `given` names no parameter, or is no prior.
        FitError: the fit was loaded without its spectrum, or is of wavelet variances, or has nothing to
            sample.
    """

    def __init__(self, fit: Fit, axis: str, given: Mapping[str, Prior]) -> None:
        result, model, self.parameters = fit[axis], fit.template, fit.template.parameters
        start = [result[p.label].value if p.free else p.start or 0.0 for p in self.parameters]
        # Shapes of absent terms have some value in their range.
        rough = [p.parameter.lower + 1.0 for p in self.parameters]
        self.base = np.where(np.isfinite(start), start, rough)
        self.axis, self.widening = axis, result.widening
        self._density = _density_of(fit, result, self.base)
        self.origin, self.std = np.array([p.parameter.lower for p in self.parameters]), 0.1 * self.base
        self.priors, scales = dict[int, Prior](), self._density.scales(self.base)
        for k, p in enumerate(self.parameters):
            if p.free and p.parameter.is_amplitude:
                upper = max(PRIOR_RANGE * scales[k], _CEILING * float(self.base[k]))
                self.origin[k], self.std[k] = -scales[k] * self.widening**0.5, 0.5 * scales[k]
                self.priors[k] = ModifiedLogUniform(-float(self.origin[k]), upper)
            elif p.free and not (result.spectrum is None and _is_deterministic(p, model)):
                # The Allan variances do not determine the frequency of a line.
                self.priors[k] = _prior_of_shape(p, float(self.base[k]), fit)
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
        values[..., self.sampled] = self.origin[self.sampled] + np.exp(y)
        return values

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


def _is_deterministic(p: ModelParameter, model: Model) -> bool:
    return p.term < len(model) and model.terms[p.term].deterministic


def _density_of(
    fit: Fit, result: AxisFit, values: Float[np.ndarray, " all"]
) -> WhittleDensity | AllanDensity:
    """Likelihood of the data that the axis was fitted to."""
    if result.spectrum is not None:
        return WhittleDensity(fit, result)
    refused = {
        "whittle": "the fit was loaded from a file without the fitted spectrum; fit the recording again",
        "wavelet": 'a fit of wavelet variances has no likelihood to sample; use objective="whittle"',
    }
    if fit.objective in refused:
        raise FitError(f"{result.axis.name}: {refused[fit.objective]}")
    return AllanDensity(fit, result, values)


def _prior_of_shape(p: ModelParameter, start: float, fit: Fit) -> Prior:
    """Default prior of a parameter that is not an amplitude, over a range far wider than needed."""
    own, n, rate = p.parameter, fit.curve.n, fit.curve.rate
    ends = {
        "time": (2.0 / rate, n / rate),
        "frequency": (rate / n, rate / 2.0),
        "number": (own.lower + 1e-2, min(own.lower + 1e4, own.upper - 1e-2)),
        "line": (start / _LINE_RANGE, min(start * _LINE_RANGE, rate / 2.0)),
    }
    if _is_deterministic(p, fit.template):
        reach = LINE_REACH / 4.0 * rate / n
        ends["line"] = max(start - reach, 0.1 * rate / n), min(start + reach, rate / 2.0)
    return LogUniform(*ends[own.kind], own.lower)

"""Views of an axis, in which effects are searched for, and the candidates that they return."""

from __future__ import annotations

import copy
import dataclasses
import functools
from collections.abc import Callable, Collection, Hashable, Mapping, Sequence
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Bool, Float
from scipy.fft import dct, idct

from allanjax.base.normal import ONE_SIDED_95
from allanjax.critic.factor import spectrum_factor
from allanjax.critic.model_evidence import ModelEvidence
from allanjax.critic.noise import FIXED, MARKOV, RAMP, Noise, NoiseFamily, centred, coefficient_folds
from allanjax.critic.parameters import Detail, Limit, parameter_estimate
from allanjax.estimate.spectral.model import Structure
from allanjax.noise.estimate import Estimate
from allanjax.noise.model import Model
from allanjax.record.completion import in_time, widening
from allanjax.record.recording import Axis

_T = TypeVar("_T")

# Steadier subsets of the terms, which are also searched, as drifting noise may be a disguised effect.
_STEADY: tuple[tuple[str, ...], ...] = (
    ("quantization", "angle_random_walk"),
    ("quantization", "angle_random_walk", "bias_instability"),
    ("quantization", "angle_random_walk", "bias_instability", "rate_random_walk", RAMP),
)
#: Names of all basic terms.
EVERYTHING = (*FIXED, MARKOV, RAMP)


@dataclasses.dataclass(frozen=True, eq=False)
class View:
    """One axis with earlier findings subtracted, in which effects search for the next one.

    Attributes:
        axis, scale: the axis; the factor from its own unit to SI.
        rate: sample rate [Hz].
        raw: samples as recorded [SI].
        samples: samples less the earlier findings [SI].
        base: ratio of the spectrum to that of the basic terms in the baseline; None for 1.
        auxiliary: other channels.
        allowed: basic terms that the noise may have.
        family: noise family for records of this length and rate.
        imputed: whether each sample was filled in and carries no information.
        found: effects detected so far.
        structure: the detected filter and resonances, with the noise fitted jointly.
        nuisances: coefficients of subtracted waveforms, whose amplitudes are nuisances.
        drawn: whether each sample was missing and has been filled in: `imputed` from the start.
    """

    axis: Axis
    scale: float
    rate: float
    raw: Float[np.ndarray, " n"]
    samples: Float[np.ndarray, " n"]
    base: Float[np.ndarray, " n-1"] | None
    auxiliary: Mapping[str, Float[np.ndarray, " n"]]
    allowed: Collection[str]
    family: NoiseFamily
    imputed: Bool[np.ndarray, " n"]
    found: tuple[str, ...] = ()
    structure: Structure | None = None
    nuisances: tuple[Float[np.ndarray, " slow"], ...] = ()
    drawn: Bool[np.ndarray, " n"] | None = None

    def recorded(self, samples: Float[np.ndarray, " n"]) -> Float[np.ndarray, " recorded"]:
        """The samples of the record that were not missing."""
        return samples if self.drawn is None else samples[~self.drawn]

    @functools.cached_property
    def _wide(self) -> float:
        return 1.0 if self.drawn is None else float(widening(self.drawn[:, None])[0])

    @property
    def n(self) -> int:
        """Number of samples."""
        return len(self.samples)

    @property
    def duration(self) -> float:
        """Length of the record [s]."""
        return self.n / self.rate

    @functools.cached_property
    def factor(self) -> Float[np.ndarray, " n-1"] | None:
        """Ratio of the spectrum to that of the basic terms; None for 1."""
        if self.structure is None:
            return self.base
        base = 1.0 if self.base is None else self.base
        return base * spectrum_factor(self.structure, self.family, self.coefficients**2 / base)

    @functools.cached_property
    def coefficients(self) -> Float[np.ndarray, " n-1"]:
        """Cosine coefficients of the samples."""
        return centred(self.samples)

    @functools.cached_property
    def model_evidence(self) -> ModelEvidence:
        """Evidence of every subset of the basic noise terms, given this view's samples."""
        if self._like is not None:
            return self._like.of_similar(self.coefficients)
        return ModelEvidence.of(self.family, self.coefficients, self.factor)

    def model_evidence_of(
        self, fold: Bool[np.ndarray, " n-1"] | None, factor: Float[np.ndarray, " n-1"] | None = None
    ) -> ModelEvidence:
        """Evidence of every subset, given the coefficients in a fold and a further factor of the spectrum."""
        factor = self.factor if factor is None else self.combined(factor)
        return ModelEvidence.of(self.family, self.coefficients, factor, fold, self.model_evidence)

    @functools.cached_property
    def log_evidence(self) -> float:
        """Log evidence of the samples, averaged over the subsets of the allowed basic terms [nats]."""
        return self.model_evidence.total(self.allowed)

    @functools.cached_property
    def log_evidence_all_terms(self) -> float:
        """Log evidence averaged over the subsets of all basic terms, including those that the model lacks."""
        return self.model_evidence.total({*EVERYTHING, *self.allowed})

    @functools.cached_property
    def _like(self) -> ModelEvidence | None:
        """Evidence of the subsets in the similar view that this one was made from, if any."""
        return None

    @functools.cached_property
    def noise(self) -> Noise:
        """Most probable subset of the allowed basic terms."""
        return self.model_evidence.best(self.allowed)

    @functools.cached_property
    def slope(self) -> float:
        """Slope of the ramp in the noise [rate/s], 0 if there is none."""
        return self.family.slope(self.coefficients, self.variance())[0] if self.noise.ramp else 0.0

    def combined(self, spectrum: Float[np.ndarray, " n-1"]) -> Float[np.ndarray, " n-1"]:
        """Product of a spectrum, or of a factor of it, and the factor of earlier findings."""
        return spectrum if self.factor is None else spectrum * self.factor

    def variance(self, noise: Noise | None = None) -> Float[np.ndarray, " n-1"]:
        """Expected squared coefficients [rate²], earlier findings included."""
        return self._variance if noise is None else self.combined(noise.variance)

    @functools.cached_property
    def _variance(self) -> Float[np.ndarray, " n-1"]:
        return self.combined(self.noise.variance)

    def lowest(self, noise: Noise, count: int) -> Float[np.ndarray, " count"]:
        """Expected squares of the lowest coefficients [rate²]."""
        v = noise.lowest(count)
        return v if self.factor is None else v * self.factor[:count]

    @functools.cached_property
    def noises(self) -> tuple[Noise, ...]:
        """Most probable subset, and the best steadier ones, as an effect may have been taken for drift."""
        found = {frozenset(self.noise.terms): self.noise}
        for steady in _STEADY:
            if set(steady) & set(self.allowed) - {"quantization"}:
                other = self.model_evidence.best([t for t in steady if t in self.allowed])
                found.setdefault(frozenset(other.terms), other)
        return tuple(found.values())

    @functools.cached_property
    def cv_log_likelihood(self) -> float:
        """Log-likelihood of each half of the coefficients under the best noise of the other half."""
        return self.cross_validated(lambda fold: self.model_evidence_of(fold).best(self.allowed))

    def cross_validated(
        self,
        fitted: Callable[[Bool[np.ndarray, " n-1"]], Noise | tuple[Noise, Float[np.ndarray, " n-1"]]],
    ) -> float:
        """Log-likelihood of each half of the coefficients under a fit to the other half.

        The fit is of noise, or of noise and a further factor of the spectrum.
        """
        total = 0.0
        for fold in coefficient_folds(self.n):
            found = fitted(fold)
            noise, factor = found if isinstance(found, tuple) else (found, None)
            v = self.variance(noise) if factor is None else self.variance(noise) * factor
            total -= 0.5 * float(np.sum((np.log(v) + self.coefficients**2 / v)[~fold]))
            # The slope of a ramp is nearly all in one coefficient, so both halves are averaged over it.
            for sign, part in ((1.0, None), (-1.0, fold)) if noise.ramp else ():
                slope, std = self.family.slope(self.coefficients, v, part)
                total += sign * (0.5 * (slope / std) ** 2 + float(np.log(std)))
        return total

    def log_likelihood(self, noise: Noise) -> float:
        """Log-likelihood of the coefficients under noise, with the most likely slope of its ramp, if any."""
        v, c = self.variance(noise), self.coefficients
        if noise.ramp:
            c = c - self.family.slope(c, v)[0] * self.family.ramp
        return -0.5 * float(np.sum(np.log(v) + c**2 / v))

    @property
    def expected_likelihood(self) -> float:
        """Expected log-likelihood of another such record: this one's less one nat per parameter (Akaike
        1973)."""
        shaped = bool(np.isfinite(self.noise.shape))
        return self.log_likelihood(self.noise) - len(self.noise.terms) - shaped

    def held_out_gain(self, after: View, in_sample: float, cross_validated: float) -> float:
        """Gain in log-likelihood [nats] on data that were not used to estimate the effect.

        It is the expected gain of the noise without the effect (`after`) over the noise with it, in which the
        effect's in-sample gain is replaced by the cross-validated one: on parts of the record with the effect
        from the other parts.
        """
        return after.expected_likelihood - self.expected_likelihood - (in_sample - cross_validated)

    @property
    def squared_whitened(self) -> Float[np.ndarray, " n-1"]:
        """Squared coefficients over their expectation."""
        return self.coefficients**2 / self.variance()

    @property
    def residual(self) -> Float[np.ndarray, " n-1"]:
        """Cosine coefficients without the ramp of the noise."""
        return self.coefficients - self.slope * self.family.ramp if self.noise.ramp else self.coefficients

    @functools.cached_property
    def whitened(self) -> Float[np.ndarray, " n"]:
        """Whitened residuals in time order: independent and standard normal if the model is right."""
        return in_time(self.residual / np.sqrt(self.variance()))

    @functools.cached_property
    def loo_residuals(self) -> tuple[Float[np.ndarray, " n"], float]:
        """Leave-one-out residuals: samples less their predictions by all others, and their deviation [SI]."""
        v = self.variance()
        precision = float(np.mean(1.0 / v))
        return in_time(self.residual / v) / precision, float(1.0 / np.sqrt(precision))

    def with_samples(
        self,
        samples: Float[np.ndarray, " n"],
        imputed: Bool[np.ndarray, " n"] | None = None,
        coefficients: Float[np.ndarray, " n-1"] | None = None,
    ) -> View:
        """View of other samples, of which these are newly `imputed`; their coefficients may be known."""
        imputed = self.imputed if imputed is None else self.imputed | imputed
        like = self._like or self.model_evidence
        kept = {"factor": self.factor, "_like": like, "coefficients": coefficients}
        return self._changed(kept, samples=samples, imputed=imputed)

    def noise_without(self, lowest: Float[np.ndarray, " slow"]) -> Noise:
        """Approximately most probable noise without an effect that has these lowest coefficients."""
        return self.model_evidence.of_rest(self.coefficients, lowest).best(self.allowed)

    def with_structure(self, structure: Structure | None) -> View:
        """View whose spectrum has this structure."""
        return self._changed(self._known("coefficients"), structure=structure)

    def with_findings(self, *found: str, nuisances: tuple[Float[np.ndarray, " slow"], ...] = ()) -> View:
        """View with these effects found, keeping everything computed for it.

        `nuisances` are coefficients of subtracted waveforms, whose amplitudes are nuisances.
        """
        view = copy.copy(self)
        vars(view).update(found=found, nuisances=nuisances)
        return view

    def accepted(self) -> View:
        """View in which all subsets of terms compete, not only those that were likely before."""
        if self._like is None:
            return self
        return self._changed(self._known("factor", "coefficients"))

    def without_caches(self) -> View:
        """View without cached values, except its noise and the slope of that."""
        kept = {"noise": dataclasses.replace(self.noise), "slope": self.slope}
        return self._changed(kept | self._known("factor"))

    def _known(self, *names: str) -> dict[str, Any]:
        """Cached values of these names; None for what has not been computed."""
        return {name: vars(self).get(name) for name in names}

    def _changed(self, kept: Mapping[str, Any], **changes: Any) -> View:
        """View with changes, and with these cached values, except those that are None."""
        view = dataclasses.replace(self, **changes)
        vars(view).update({name: value for name, value in kept.items() if value is not None})
        return view

    def forget(self) -> None:
        """Drop cached arrays as long as the record, e.g. for a view that has to wait."""
        for name in ("coefficients", "whitened", "loo_residuals", "_variance"):
            vars(self).pop(name, None)
        for noise in {*vars(self).get("noises", ()), vars(self).get("noise")} - {None}:
            vars(noise).pop("variance", None)

    def allowing(self, terms: Collection[str]) -> View:
        """View in which the noise may have these basic terms."""
        # In a view of similar samples only few subsets were compared.
        kept = self._known("coefficients", *(("factor", "model_evidence") if self._like is None else ()))
        return self._changed(kept, allowed=tuple(terms))

    def recoloured(self, whitened: Float[np.ndarray, " n"]) -> View:
        """View of samples with these whitened residuals and the ramp of this view's samples."""
        c = dct(whitened, norm="ortho", workers=-1)
        c[1:] *= np.sqrt(self.variance())
        c[1:] += self.coefficients - self.residual
        c[0] = np.sqrt(self.n) * self.samples.mean()
        return self.with_samples(idct(c, norm="ortho", workers=-1), coefficients=c[1:])

    def once(self, work: Callable[..., _T], *arguments: Hashable) -> _T:
        """Result of work on this view with arguments, which is small and is kept for the next time."""
        results: dict[tuple[Hashable, ...], Any] = vars(self).setdefault("_results", {})
        if (key := (work, *arguments)) not in results:
            results[key] = work(self, *arguments)
        return results[key]

    def estimate(self, label: str, value: float, std: float, unit: str, limit: Limit = "") -> Estimate:
        """Parameter of a finding in this axis, see `parameter_estimate`."""
        return parameter_estimate(self.axis, label, value, std * self._wide, unit, limit)

    def log_estimate(self, label: str, log: float, std: float, limit: Limit, unit: str) -> Estimate:
        """Parameter, given its logarithm and the standard deviation of that."""
        value = float(np.exp(log))
        std *= value * self._wide
        return parameter_estimate(self.axis, label, value, std, unit, limit, log_normal=True)

    def time_estimate(self, label: str, sample: float, std: float) -> Estimate:
        """Time of a sample; a limit if it is within one standard deviation of an end of the record."""
        limit: Limit = ""
        if sample <= std:
            sample, limit = sample and sample + ONE_SIDED_95 * std, "below"
        elif sample >= self.n - std:
            sample, limit = self.n if sample >= self.n else sample - ONE_SIDED_95 * std, "above"
        return self.estimate(label, sample / self.rate, std / self.rate, "s", limit)

    def amplitude_estimate(
        self, label: str, value: float, std: float, per: str = "", limit: Limit = ""
    ) -> Estimate:
        """Amplitude in the recording's own unit, given in SI."""
        return self.estimate(label, value / self.scale, std / self.scale, self.axis.unit + per, limit)


@dataclasses.dataclass(frozen=True, eq=False)
class Candidate:
    """An explanation for a part of a view.

    Attributes:
        cause: name of the cause.
        estimates: its parameters, in the recording's units.
        gain: log Bayes factor for it, including trials and Occam factors [nats]; nan for an effect that is
            visible directly in the samples, which no model predicts.
        p_value: p-value of its statistic, corrected for the search; None if there is no such statistic.
        after: view without the effect.
        held_out: computes the gain in log-likelihood on held-out data [nats]; nan if that is not possible.
        support: start and end in time [s], by default of the record, or low and high frequency [Hz].
        domain: "time" or "frequency".
        add_to_model: adds it to a model of noise terms.
        has_waveform: whether it subtracts a known waveform from the lowest coefficients.
        parts: the single effects, in order, if only several together are significant.
        details: words and lists of numbers by name.
        bound: upper bound of the probability of such odds under noise alone, e.g. e^−gain.
        doubt: why it may describe the data without being the cause, "" if nothing speaks for that.
        is_shared: whether its place is known from another axis.
    """

    cause: str
    estimates: Sequence[Estimate]
    gain: float
    p_value: float | None
    after: View
    held_out: Callable[[], float]
    support: tuple[float, float] = (0.0, np.inf)
    domain: str = "time"
    add_to_model: Callable[[Model], Model] = lambda model: model
    has_waveform: bool = False
    parts: tuple[Candidate, ...] = ()
    details: Mapping[str, Detail] = dataclasses.field(default_factory=dict)
    bound: float = 1.0
    doubt: str = ""
    is_shared: bool = False

    @property
    def chance(self) -> float:
        """Probability that decides on acceptance: the p-value or the bound, whichever is smaller."""
        return self.bound if self.p_value is None else min(self.p_value, self.bound)

    def doubted(self, reason: str) -> Candidate:
        """Candidate that describes the data, but for this `reason` ("" for none) need not be the cause."""
        return dataclasses.replace(self, doubt=reason)

    @property
    def parameters(self) -> dict[str, Estimate]:
        """The estimates by their labels."""
        return {estimate.label: estimate for estimate in self.estimates}

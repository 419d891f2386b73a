"""Effects that a critique looks for, the views in which they are sought, and the candidates they return.

Vibration, interference and knocks affect several axes of a sensor. A frequency or a time that is known from
another axis need not be searched for, so that weaker ones are found at such places.
"""

from __future__ import annotations

import copy
import dataclasses
import functools
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Hashable, Iterable, Mapping, Sequence
from typing import Any, ClassVar, Literal, NamedTuple, TypeVar

import numpy as np
from jaxtyping import Bool, Float
from scipy.fft import dct, idct

from allanjax.base.normal import ONE_SIDED_95
from allanjax.critic.finding import Detail, Limit, parameter_estimate, side_of_limit
from allanjax.critic.noise import (
    FIXED,
    MARKOV,
    RAMP,
    ModelEvidence,
    Noise,
    NoiseFamily,
    centred,
    coefficient_folds,
    family_of,
    spectrum_factor,
)
from allanjax.critic.policy import judged
from allanjax.estimate.spectral.components import NONE
from allanjax.estimate.spectral.model import OUTSIDE, Structure
from allanjax.inspection.plausible import lattice
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
        drawn: whether each sample was missing and has been filled in.
        imputed: whether each sample was filled in and carries no information; the `drawn` ones and others.
        found: effects detected so far.
        fitted: filter and resonances of the fit from which the critique starts, if it has any.
        structure: the detected filter and resonances, with the noise fitted jointly.
        nuisances: coefficients of subtracted waveforms, whose amplitudes are nuisances.
    """

    axis: Axis
    scale: float
    rate: float
    raw: Float[np.ndarray, " n"]
    samples: Float[np.ndarray, " n"]
    base: Float[np.ndarray, " n-1"] | None
    auxiliary: Mapping[str, Float[np.ndarray, " n"]]
    allowed: Collection[str]
    drawn: Bool[np.ndarray, " n"]
    imputed: Bool[np.ndarray, " n"]
    found: tuple[str, ...] = ()
    fitted: Structure | None = None
    structure: Structure | None = None
    nuisances: tuple[Float[np.ndarray, " slow"], ...] = ()

    def recorded(self, samples: Float[np.ndarray, " n"]) -> Float[np.ndarray, " recorded"]:
        """The samples of the record that were not missing."""
        return samples[~self.drawn]

    @functools.cached_property
    def _wide(self) -> float:
        return float(widening(self.drawn[:, None])[0])

    @property
    def n(self) -> int:
        """Number of samples."""
        return len(self.samples)

    @property
    def duration(self) -> float:
        """Length of the record [s]."""
        return self.n / self.rate

    @property
    def family(self) -> NoiseFamily:
        """Noise family of records of this length and rate."""
        return family_of(self.n, self.rate)

    @functools.cached_property
    def factor(self) -> Float[np.ndarray, " n-1"] | None:
        """Ratio of the spectrum to that of the basic terms; None for 1."""
        if self.structure is None:
            return self.base
        base = 1.0 if self.base is None else self.base
        return base * spectrum_factor(self.structure, self.family)[0]

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

    def model_evidence_of(self, fold: Bool[np.ndarray, " n-1"]) -> ModelEvidence:
        """Evidence of every subset, given the coefficients in a fold."""
        return ModelEvidence.of(self.family, self.coefficients, self.factor, fold, self.model_evidence)

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

    def variance(self, noise: Noise | None = None) -> Float[np.ndarray, " n-1"]:
        """Expected squared coefficients [rate²], earlier findings included."""
        if noise is None:
            return self._variance
        return noise.variance if self.factor is None else noise.variance * self.factor

    @functools.cached_property
    def _variance(self) -> Float[np.ndarray, " n-1"]:
        return self.variance(self.noise)

    def lowest(self, noise: Noise, count: int) -> Float[np.ndarray, " count"]:
        """Expected squares of the lowest coefficients [rate²]."""
        v = self.family.expected(noise.power, noise.index, count)
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

    def cross_validated(self, fitted: Callable[[Bool[np.ndarray, " n-1"]], Noise]) -> float:
        """Log-likelihood of each half of the coefficients under noise that is fitted to the other half."""
        total = 0.0
        for fold in coefficient_folds(self.n):
            noise = fitted(fold)
            v = self.variance(noise)
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
        """View whose spectrum has this structure, with the noise of harmless rounding after a response."""
        if structure is not None and structure.kind != NONE:
            least = max(self.rounding, structure.column(OUTSIDE).power)
            structure = structure.with_column(OUTSIDE, least) if least else structure
        return self._changed(self._known("coefficients"), structure=structure)

    @functools.cached_property
    def rounding(self) -> float:
        """Square of the white noise by which rounding adds to the samples, step²/12; 0 if it was undone."""
        step = None if "rounding" in self.found else lattice(self.recorded(self.raw))
        return 0.0 if step is None else step**2 / (12.0 * self.rate)

    def with_findings(self, *found: str, nuisances: tuple[Float[np.ndarray, " slow"], ...] = ()) -> View:
        """View with these findings and `nuisances` (coefficients of subtracted waveforms); caches stay."""
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


_NARROW = judged("line", "quality")
# Reach of a line: in resolved frequencies [1/duration], and in standard deviations of its frequency.
_RESOLVED, _DEVIATIONS = 2.0, 4.0


class Place(NamedTuple):
    """Name of an effect, and the part of the spectrum [Hz] or of the record [s] that it is in."""

    effect: str
    start: float
    end: float

    def meets(self, other: Place) -> bool:
        """Whether both are of one effect, and the middle of one is within the other."""
        middles = 0.5 * (self.start + self.end), 0.5 * (other.start + other.end)
        inside = other.start <= middles[0] <= other.end or self.start <= middles[1] <= self.end
        return self.effect == other.effect and inside


def places_in(view: View, candidates: Iterable[Candidate]) -> list[Place]:
    """Places of the lines and the disturbances among these, and of the view's narrow resonances."""
    found, resolved = [], _RESOLVED / view.duration
    for c in candidates:
        if c.cause == "disturbance":
            found.append(Place(c.cause, *c.support))
        elif c.cause == "sinusoid" and np.isfinite(c.parameters["frequency"].std):
            line = c.parameters["frequency"]
            reach = max(resolved, _DEVIATIONS * line.std)
            found.append(Place(c.cause, line.value - reach, line.value + reach))
    if view.structure is not None:
        for own in (view.structure.components[k] for k in view.structure.oscillators):
            f = own.frequency * view.rate / (2.0 * np.pi)
            reach = max(resolved, f / own.quality)
            if own.quality > _NARROW:
                found.append(Place("spectral_shape", f - reach, f + reach))
    return found


def elsewhere(own: Sequence[Place], others: Sequence[Place]) -> list[Place]:
    """Places of other axes, without duplicates, at which this axis has no finding yet."""
    found: list[Place] = []
    for place in sorted(others, key=lambda place: place.end - place.start):
        if not any(place.meets(known) for known in (*own, *found)):
            found.append(place)
    return found


class Range(NamedTuple):
    """Where a parameter makes sense: beyond it, the effect is another one, or no record shows it.

    Attributes:
        least, most: ends of the range, in the unit of the parameter or as a property of the view.
        may_be_a_limit: whether it may be at an end of its search, where the finding tells a limit.
    """

    least: float | Literal["interval", "resolution"]
    most: float | Literal["duration", "nyquist"]
    may_be_a_limit: bool = False

    def holds(self, e: Estimate, view: View) -> bool:
        """Whether an estimate in a view makes sense."""
        scales = {
            "interval": 1.0 / view.rate,
            "duration": view.duration,
            "resolution": 1.0 / view.duration,
            "nyquist": 0.5 * view.rate,
        }
        least, most = (scales[end] if isinstance(end, str) else end for end in self[:2])
        return least <= e.value <= most and (self.may_be_a_limit or side_of_limit(e) == "")


#: A time between the sample interval and the length of the record; a frequency that the record resolves.
TIMES, FREQUENCIES = Range("interval", "duration"), Range("resolution", "nyquist")


class Effect(ABC):
    """An effect that a sensor's model may lack; `critic.search` has the rule for accepting it."""

    name: str
    #: Whether it is visible directly in the samples and must be undone before the search for others.
    is_preprocessing: ClassVar[bool] = False
    #: Whether it happened in a record; other effects are properties of the sensor.
    is_event: ClassVar[bool] = False
    #: When it is refitted if later findings change its conditions: "at once", if its misfit would be mistaken
    #: for other effects, or "at last".
    refit: ClassVar[Literal["", "at once", "at last"]] = ""
    #: Where its parameters make sense, by label; a candidate outside is not accepted.
    sensible: ClassVar[Mapping[str, Range]] = {}
    #: Places at which alone it is searched for, see `at`; everywhere if there are none.
    places: tuple[Place, ...] = ()

    def __repr__(self) -> str:
        return f"<Effect {self.name}>"

    @abstractmethod
    def detect(self, view: View) -> Candidate | None:
        """Best candidate of this effect in a view, or None."""

    def again(self, view: View, found: Candidate) -> Candidate | None:
        """The finding refitted in a view with other findings; None if nothing remains of it."""
        return self.detect(view)

    def at(self, places: Sequence[Place]) -> Effect:
        """This effect, searching only at places of its own cause that are known from other axes."""
        effect = copy.copy(self)
        effect.places = tuple(places)
        return effect

    def p_value(self, view: View) -> float | None:
        """p-value of its statistic, if any, under noise alone, corrected for the search over places."""
        return None

"""What a cause sees, and what it may answer: one axis of a recording, whitened, and candidates."""

from __future__ import annotations

import copy
import dataclasses
import functools
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Mapping
from typing import ClassVar, Literal

import numpy as np
from jaxtyping import Bool, Float
from scipy.fft import dct, idct

from allanjax.base.equality import ByValue
from allanjax.critic.model_evidence import ModelEvidence, SpectralMask
from allanjax.critic.noise import FIXED, MARKOV, RAMP, Noise, NoiseFamily, centred
from allanjax.noise.model import Model
from allanjax.record.recording import Axis

# Noise that drifts may be an effect in disguise: these sets are looked through too.
_STEADY: tuple[tuple[str, ...], ...] = (
    ("quantization", "angle_random_walk"),
    ("quantization", "angle_random_walk", "bias_instability"),
    ("quantization", "angle_random_walk", "bias_instability", "rate_random_walk", RAMP),
)
#: Log-evidence that a cause must gain beyond the basic terms [nats]: odds of twenty to one.
MARGIN = 3.0
#: Probability of a false finding in a record of one axis, for which margins and levels are.
FALSE_ALARMS = 0.01
#: The normal law's point of one-sided 95 % limits.
ONE_SIDED = 1.645
EVERYTHING = (*FIXED, MARKOV, RAMP)


@dataclasses.dataclass(frozen=True, eq=False)
class Quantity(ByValue):
    """A parameter of a finding: value (a number, or several), standard deviation, unit.

    Where the search ended at a bound of what it looks through, or the record ends where something may go on,
    the value is a `limit`: the parameter is "above" or "below" it (with 95 %), and has no standard deviation.
    """

    value: float | tuple[float, ...] | tuple[str, ...]
    std: float
    unit: str
    limit: Literal["", "above", "below"] = ""

    @classmethod
    def beyond(cls, value: float, limit: Literal["above", "below"], unit: str) -> Quantity:
        """A limit."""
        return cls(value, float("nan"), unit, limit)


@dataclasses.dataclass(frozen=True, eq=False)
class View:
    """One axis as the critic sees it: what was found before has been taken out.

    Attributes:
        axis, scale: whose it is; factor from its own unit to SI.
        rate: sample rate [Hz].
        raw: the samples as recorded [SI].
        samples: the samples without what was found before.
        factor: ratio of the spectrum to that of the basic terms, 1 if there is nothing else.
        noise: the best set of basic terms for x.
        auxiliary: other channels.
        allowed: basic terms that the noise may have.
        family: to weigh other sets and other records with.
        restored: samples that were filled in, which tell nothing.
        found: causes found so far.
        passes: power response of a filter that was found before, which the factor has in it.
        beside: coefficients of shapes that were taken out, of which the amplitudes are free.
    """

    axis: Axis
    scale: float
    rate: float
    raw: Float[np.ndarray, " n"]
    samples: Float[np.ndarray, " n"]
    factor: Float[np.ndarray, " n-1"] | None
    auxiliary: Mapping[str, Float[np.ndarray, " n"]]
    allowed: Collection[str]
    family: NoiseFamily
    restored: Bool[np.ndarray, " n"]
    found: tuple[str, ...] = ()
    passes: Float[np.ndarray, " n-1"] | None = None
    beside: tuple[Float[np.ndarray, " slow"], ...] = ()

    @property
    def n(self) -> int:
        """Number of samples."""
        return len(self.samples)

    @property
    def duration(self) -> float:
        """Length [s]."""
        return self.n / self.rate

    @functools.cached_property
    def coefficients(self) -> Float[np.ndarray, " n-1"]:
        """Cosine coefficients of x."""
        return centred(self.samples)

    @functools.cached_property
    def model_evidence(self) -> ModelEvidence:
        """Of the sets of basic terms, for x."""
        return self._mask.evidence(self.coefficients)

    def model_evidence_of(
        self, fold: Bool[np.ndarray, " n-1"] | None, factor: Float[np.ndarray, " n-1"] | None = None
    ) -> ModelEvidence:
        """The same of the coefficients in a fold, behind a further factor of the spectrum."""
        factor = self.factor if factor is None else self.combined(factor)
        return SpectralMask.of(self.family, factor, fold).evidence(self.coefficients)

    @functools.cached_property
    def log_evidence(self) -> float:
        """Log-evidence of x whichever allowed basic terms there are."""
        return self.model_evidence.sets(self.allowed).total

    @functools.cached_property
    def log_evidence_all_terms(self) -> float:
        """The same whichever basic terms there are, also those that the model lacks."""
        return self.model_evidence.sets({*EVERYTHING, *self.allowed}).total

    @functools.cached_property
    def _mask(self) -> SpectralMask:
        return SpectralMask.of(self.family, self.factor)

    @functools.cached_property
    def noise(self) -> Noise:
        """The best set of basic terms."""
        return self.model_evidence.best(self.allowed)

    @functools.cached_property
    def squares(self) -> Float[np.ndarray, " n-1"]:
        """Squared coefficients, as if all that was found before were not there."""
        return self.coefficients**2 if self.factor is None else self.coefficients**2 / self.factor

    @property
    def slope(self) -> float:
        """Of the ramp in the noise [rate/s], 0 if there is none."""
        return self.family.slope(self.coefficients, self.variance())[0] if self.noise.ramp else 0.0

    @functools.cached_property
    def basic(self) -> Noise:
        """The best set of any basic terms, also of those that the model lacks."""
        return self.model_evidence.best([*EVERYTHING, *self.allowed])

    def combined(self, spectrum: Float[np.ndarray, " n-1"]) -> Float[np.ndarray, " n-1"]:
        """A spectrum, or a factor of it, with the factor of what was found before."""
        return spectrum if self.factor is None else spectrum * self.factor

    def variance(self, noise: Noise | None = None) -> Float[np.ndarray, " n-1"]:
        """Expected squared coefficients [rate²], all that was found before included."""
        return self._variance if noise is None else self.combined(noise.variance)

    @functools.cached_property
    def _variance(self) -> Float[np.ndarray, " n-1"]:
        return self.combined(self.noise.variance)

    def lowest(self, noise: Noise, count: int) -> Float[np.ndarray, " count"]:
        """The same of the lowest coefficients."""
        v = noise.lowest(count)
        return v if self.factor is None else v * self.factor[:count]

    @functools.cached_property
    def noises(self) -> tuple[Noise, ...]:
        """The best set, and the best among steadier ones: an effect may have been taken for drift."""
        found = [self.noise]
        for allowed in _STEADY:
            if not set(allowed) & set(self.allowed) - {"quantization"}:
                continue
            other = self.model_evidence.best([t for t in allowed if t in self.allowed])
            if all(set(other.terms) != set(known.terms) for known in found):
                found.append(other)
        return tuple(found)

    @functools.cached_property
    def cv_log_likelihood(self) -> float:
        """Log-likelihood of half of the coefficients under the best basic noise of the others, both ways."""
        return self.cv_log_likelihood_with(self.allowed)

    def cv_log_likelihood_with(self, allowed: Collection[str]) -> float:
        """The same with these basic terms to choose from."""
        total = 0.0
        for fold in coefficient_folds(self.n):
            noise = self.model_evidence_of(fold).approximate_map(allowed, self.model_evidence)
            total += self.log_likelihood(noise, ~fold)
        return total

    def log_likelihood(
        self,
        noise: Noise,
        some: Bool[np.ndarray, " n-1"] | None = None,
        factor: Float[np.ndarray, " n-1"] | None = None,
    ) -> float:
        """Of some of the coefficients, under noise behind a further factor.

        A ramp of the noise is projected out: nearly all of it is in one coefficient, and the others do not
        foretell that one.
        """
        v = self.variance(noise) if factor is None else self.variance(noise) * factor
        c = (
            self.coefficients - self.family.slope(self.coefficients, v, some)[0] * self.family.ramp
            if noise.ramp
            else self.coefficients
        )
        each = np.log(v) + c**2 / v
        return -0.5 * float(np.sum(each if some is None else each[some]))

    @property
    def expected_likelihood(self) -> float:
        """Of another such record under this noise: this one's, less a nat a parameter (Akaike 1973)."""
        shaped = bool(np.isfinite(self.noise.shape))
        return self.log_likelihood(self.noise) - len(self.noise.terms) - shaped

    def held_out_gain(self, after: View, in_sample: float, cross_validated: float) -> float:
        """Log-likelihood that data gain which an effect was not estimated from [nats].

        What is explained by the noise with the effect in it and by the noise without it differs by the effect
        and by the noise's own parameters: the effect counts by what it is worth on held-out data.

        Args:
            after: the view without the effect.
            in_sample: log-likelihood that the effect gains on the data it was fitted to, in `after`'s noise.
            cross_validated: the same on parts of the record, by the effect that the other parts show.
        """
        return after.expected_likelihood - self.expected_likelihood - (in_sample - cross_validated)

    @property
    def residual(self) -> Float[np.ndarray, " n-1"]:
        """Cosine coefficients of x without the ramp that the noise has."""
        return self.coefficients - self.slope * self.family.ramp if self.noise.ramp else self.coefficients

    @functools.cached_property
    def whitened(self) -> Float[np.ndarray, " n"]:
        """Whitened residuals in time order: independent and standard normal if the model is right."""
        return in_time(self.residual / np.sqrt(self.variance()))

    @functools.cached_property
    def loo_residuals(self) -> tuple[Float[np.ndarray, " n"], float]:
        """What each sample is above its best prediction from all others [SI], and that one's error."""
        v = self.variance()
        precision = float(np.mean(1.0 / v))
        return in_time(self.residual / v) / precision, float(1.0 / np.sqrt(precision))

    def with_samples(self, samples: Float[np.ndarray, " n"]) -> View:
        """The view of other samples."""
        view = dataclasses.replace(self, samples=samples)
        vars(view)["_mask"] = self._mask
        return view

    def noise_without(self, lowest: Float[np.ndarray, " slow"]) -> Noise:
        """About the best set of basic terms without something that has these lowest coefficients."""
        c = self.coefficients.copy()
        c[: len(lowest)] -= lowest
        return self._mask.evidence(c).approximate_map(self.allowed, self.model_evidence)

    def with_factor(self, factor: Float[np.ndarray, " n-1"]) -> View:
        """The view of a spectrum with a further factor."""
        view = dataclasses.replace(self, factor=self.combined(factor))
        # The coefficients are what they were: a transform saved.
        vars(view)["coefficients"] = self.coefficients
        return view

    def with_findings(self, *found: str, beside: tuple[Float[np.ndarray, " slow"], ...] = ()) -> View:
        """The same view and all that is computed of it, for which these causes have been found.

        Args:
            found: causes.
            beside: coefficients of shapes that were taken out, of which the amplitudes are free.
        """
        view = copy.copy(self)
        vars(view).update(found=found, beside=beside)
        return view

    def without_caches(self) -> View:
        """The same view without what it has at hand but could compute anew; the noise stays."""
        view = dataclasses.replace(self)
        vars(view)["noise"] = dataclasses.replace(self.noise)
        return view

    def allowing(self, terms: Collection[str]) -> View:
        """The view with these basic terms in the noise."""
        return dataclasses.replace(self, allowed=tuple(terms))

    def recoloured(self, whitened: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        """The samples whose whitened residuals are e, with the ramp that x has."""
        c = dct(whitened, norm="ortho", workers=-1)
        c[1:] *= np.sqrt(self.variance())
        c[1:] += self.coefficients - self.residual
        c[0] = np.sqrt(self.n) * self.samples.mean()
        return idct(c, norm="ortho", workers=-1)

    def time(self, sample: float, std: float) -> Quantity:
        """A place in time [samples]; at an end of the record, it may as well be beyond that."""
        if sample <= std:
            return Quantity.beyond((sample and sample + ONE_SIDED * std) / self.rate, "below", "s")
        if sample >= self.n - std:
            beyond = self.n if sample >= self.n else sample - ONE_SIDED * std
            return Quantity.beyond(beyond / self.rate, "above", "s")
        return Quantity(sample / self.rate, std / self.rate, "s")

    def own(self, value: float, std: float, per: str = "") -> Quantity:
        """An amplitude in the recording's own unit."""
        return Quantity(value / self.scale, std / self.scale, self.axis.unit + per)


def coefficient_folds(n: int) -> tuple[np.ndarray, np.ndarray]:
    """Every other pair of coefficients, and the others: independent, and both see the whole spectrum.

    Pairs, since a shape that is odd about the record's middle has odd coefficients only.
    """
    some = np.arange(n - 1) // 2 % 2 == 0
    return some, ~some


def in_time(coefficients: Float[np.ndarray, " n-1"]) -> Float[np.ndarray, " n"]:
    """The samples with these cosine coefficients c_1 … c_{n−1}, without mean."""
    return idct(np.concatenate([[0.0], coefficients]), norm="ortho", workers=-1)


@dataclasses.dataclass(frozen=True, eq=False)
class Candidate:
    """An explanation for something in a view.

    Attributes:
        cause: its name.
        parameters: with standard deviations, in the recording's units.
        gain: by how much the log-evidence grows [nats], the price of the search paid.
        p_value: of its statistic where there is no such effect, the search included.
        after: the view without it.
        held_out: log-likelihood gained on data that it was not estimated from [nats].
        support: where it is: start and end in time [s], or low and high frequency [Hz]; `domain` says which.
        add_to_model: adds it to a model of noise terms.
        has_waveform: whether it takes a known shape out of the lowest coefficients.
        parts: where only several together explain anything: each of them, in order, as a finding of its own.
    """

    cause: str
    parameters: Mapping[str, Quantity]
    gain: float
    p_value: float
    after: View
    held_out: Callable[[], float]
    support: tuple[float, float]
    domain: str
    add_to_model: Callable[[Model], Model] = lambda model: model
    has_waveform: bool = False
    parts: tuple[Candidate, ...] = ()


class Cause(ABC):
    """Something that a sensor's model may lack.

    A subclass has a `name` and looks for itself in a view: the best candidate, or None where there is nothing
    worth testing.
    """

    name: str
    #: Whether it is read off the samples themselves and must be undone before anything else is looked at.
    is_preprocessing: ClassVar[bool] = False
    #: Log-evidence that it must gain beyond the basic terms [nats], all prices paid, at `FALSE_ALARMS`.
    min_log_odds: ClassVar[float] = MARGIN
    #: Its own probability of a false finding at these; None for a share of what the critique may have.
    max_p: ClassVar[float | None] = None
    #: Whether it is fitted again when later findings change what it was fitted beside: at once, since others
    #: would be taken for what it lacks, or at last.
    refit: ClassVar[Literal["", "at once", "at last"]] = ""

    def __repr__(self) -> str:
        return f"<Cause {self.name}>"

    @abstractmethod
    def detect(self, view: View) -> Candidate | None:
        """The best candidate of this cause."""

    def again(self, view: View, found: Candidate) -> Candidate | None:
        """What was found, fitted again in a view where others are that were not there; None if it is lost."""
        return self.detect(view)

    def p_value(self, view: View) -> float | None:
        """Probability of a statistic as large as the view's, if its noise is all there is.

        Uniform then; the search over places is part of it. None where the cause has no such statistic.
        """
        return None

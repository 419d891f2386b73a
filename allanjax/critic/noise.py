"""Noise of one axis, for whitening: the basic terms and their powers, estimated anew for every hypothesis.

An effect that is not in the model looks like noise: a step like a random walk, an influence of temperature
like a Markov process. So no cause can be judged against noise that was estimated with the effect in it. Each
hypothesis gets the noise that fits it best (`ModelEvidence.best`), and hypotheses are compared by evidence.
"""

from __future__ import annotations

import dataclasses
import functools

import numpy as np
from jaxtyping import Bool, Float, Int

from allanjax.estimate.design import correlation_times
from allanjax.estimate.evidence import TermSets, evidence, term_sets
from allanjax.estimate.spectral.components import columns_of
from allanjax.noise.model import Model
from allanjax.noise.terms import Markov, NoiseTerm, PowerLaw, basic_terms
from allanjax.spectrum.cosine import Bins, SpectralStatistics, cosine_transform, ramp_column

#: Terms without a free shape, and names of terms that are treated separately.
FIXED = ("quantization", "angle_random_walk", "bias_instability", "rate_random_walk")
WHITE, MARKOV, POWER_LAW, RAMP = "angle_random_walk", "markov", "power_law", "drift_ramp"
#: Share of white noise in all noise above which the two are not distinguished.
NEARLY_ALL = 0.9
# Number of frequencies that are evaluated at a time.
_BLOCK = 1 << 14
#: Number of values of the free shape (a correlation time or an exponent) that are compared.
GRID = 16
# Exponents that no basic term has; the grid keeps its distance from those of basic terms.
EXPONENTS = np.array(
    [-0.6, -0.4, 0.25, 0.35, 0.45, 0.55, 0.65, 0.75, 1.25, 1.35, 1.5, 1.65, 1.75, 2.3, 2.5, 2.8]
)


@dataclasses.dataclass(frozen=True, eq=False)
class Noise:
    """Subset of the noise terms with their coefficients.

    Attributes:
        power: squared coefficient of each term, by name.
        shape: correlation time [s] or exponent of the term that has one, nan if there is none.
        ramp: whether a ramp was projected out.
        log_evidence: log evidence of this subset [nats], up to a constant common to all subsets.
        family: family of the subset.
        index: place of the shape in its grid.
    """

    power: dict[str, float]
    shape: float
    ramp: bool
    log_evidence: float
    family: NoiseFamily
    index: int

    @functools.cached_property
    def variance(self) -> Float[np.ndarray, " n-1"]:
        """Expected squared cosine coefficients c_1 … c_{n−1} [rate²]."""
        return self.family.expected(self.power, self.index)

    def lowest(self, count: int) -> Float[np.ndarray, " count"]:
        """Expected squares of the lowest coefficients, without computing the others."""
        if "variance" in vars(self):
            return self.variance[:count]
        return self.family.expected(self.power, self.index, count)

    @property
    def terms(self) -> tuple[str, ...]:
        """Names of the terms, the ramp included."""
        return (*self.power, RAMP) if self.ramp else tuple(self.power)

    def model(self) -> Model:
        """Model of the random terms with their values."""
        terms: list[NoiseTerm] = []
        for name, power in self.power.items():
            value = float(np.sqrt(power))
            if name == MARKOV:
                terms.append(Markov(value, self.shape))
            elif name == POWER_LAW:
                terms.append(PowerLaw(value, self.shape))
            else:
                terms.append(basic_terms()[name].replace(coefficient=value))
        return Model(tuple(terms))


class NoiseFamily:
    """All subsets of the basic terms for records of n samples at a rate.

    A power law takes the place of the Markov process in a subset.
    """

    def __init__(self, n: int, rate: float) -> None:
        self.n, self.rate = n, rate
        self.bins = Bins.of(n, rate)
        self.size = self.bins.size.astype(float)
        self.times = correlation_times(n / rate, rate)
        self.frequency = np.arange(1, n) * rate / (2.0 * n)
        unit = [basic_terms()[name].replace(coefficient=1.0) for name in FIXED]
        self.spectra = np.stack([self.spectrum(term) for term in unit])
        unit += [Markov(1.0, float(time)) for time in self.times]
        self.columns = columns_of(unit, self.bins).mean(axis=1)
        self.jobs = term_sets(len(FIXED), GRID, True)
        self.places = self.jobs.columns[:, -1] - len(FIXED)
        self.ramp = ramp_column(n, rate)

    def spectrum(self, term: NoiseTerm) -> Float[np.ndarray, " n-1"]:
        """Expected squared coefficients of a term [rate²], from its density."""
        return self.rate * density(term, self.frequency, self.rate)

    @functools.cached_property
    def power_laws(self) -> Float[np.ndarray, "grid m"]:
        """Levels of power laws of unit amplitude."""
        return columns_of([PowerLaw(1.0, float(x)) for x in EXPONENTS], self.bins).mean(axis=1)

    def slope(
        self,
        c: Float[np.ndarray, " n-1"],
        variance: Float[np.ndarray, " n-1"],
        fold: Bool[np.ndarray, " n-1"] | None = None,
    ) -> tuple[float, float]:
        """Slope of a record's ramp [rate/s], from all coefficients or those in a fold, and its standard
        deviation."""
        weight = self.ramp / variance if fold is None else fold * self.ramp / variance
        gram = float(weight @ self.ramp)
        return float(weight @ c) / gram, float(1.0 / np.sqrt(gram))

    def run(
        self,
        levels: SpectralStatistics,
        size: Float[np.ndarray, " m"],
        grid: Float[np.ndarray, "grid m"],
        rows: Int[np.ndarray, " jobs"],
        first: Float[np.ndarray, "jobs terms"] | None = None,
    ) -> TermSets:
        """Evidence and powers of some subsets, with powers to start from."""
        columns = np.concatenate([self.columns[: len(FIXED)], grid])
        return evidence(self.jobs.of(rows)._replace(power=first), columns, levels, size)

    @functools.lru_cache(maxsize=6)  # noqa: B019 - families are few and cached; spectra are long
    def shaped(self, name: str, index: int) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, " n-1"]]:
        """Levels and spectrum of a Markov process or a power law of unit amplitude, by place in its grid."""
        if name == MARKOV:
            return self.columns[len(FIXED) + index], self.spectrum(Markov(1.0, self.times[index]))
        return self.power_laws[index], self.spectrum(PowerLaw(1.0, float(EXPONENTS[index])))

    def unit(self, name: str, index: int) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, " n-1"]]:
        """Levels in the bins and spectrum of a term of unit amplitude."""
        if name not in FIXED:
            return self.shaped(name, index)
        k = FIXED.index(name)
        return self.columns[k], self.spectra[k]

    def expected(
        self, power: dict[str, float], index: int, count: int | None = None
    ) -> Float[np.ndarray, " count"]:
        """Expected squared coefficients of a subset, all or the lowest.

        They follow from the density, but are exact if a bin has a single coefficient.
        """
        count = self.n - 1 if count is None else count
        variance, term = np.zeros(count), np.empty(count)
        low = np.zeros(len(self.columns[0]))
        for name, p in power.items():
            level, spectrum = self.unit(name, index)
            variance += np.multiply(p, spectrum[:count], out=term)
            low += p * level
        single = min(int(np.sum(np.cumprod(self.size == 1.0))), count)
        variance[:single] = low[:single]
        return variance


def density(term: NoiseTerm, frequency: Float[np.ndarray, " k"], rate: float) -> Float[np.ndarray, " k"]:
    """Sampled PSD of a term, evaluated in parts that a processor's cache holds."""
    parts = (frequency[first : first + _BLOCK] for first in range(0, len(frequency), _BLOCK))
    return np.concatenate([np.asarray(term.sampled_psd(part, rate)) for part in parts])


@functools.lru_cache(maxsize=2)
def family_of(n: int, rate: float) -> NoiseFamily:
    """Noise family of records of n samples; the axes of a recording share it."""
    return NoiseFamily(n, rate)


def centred(x: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n-1"]:
    """Cosine coefficients c_1 … c_{n−1} of a record without its mean."""
    return cosine_transform(x - x.mean())


def coefficient_folds(n: int) -> tuple[np.ndarray, np.ndarray]:
    """Every other pair of coefficients, and the rest: independent halves that both cover the whole spectrum.

    They are pairs because a shape that is odd about the record's middle has odd coefficients only.
    """
    some = np.arange(n - 1) // 2 % 2 == 0
    return some, ~some

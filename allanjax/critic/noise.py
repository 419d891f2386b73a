"""Noise of one axis, for whitening: the basic terms and their powers, estimated anew for every hypothesis.

An effect that is not in the model looks like noise: a step like a random walk, an influence of temperature
like a Markov process. So no cause can be judged against noise that was estimated with the effect in it. Each
hypothesis gets the noise that fits it best (`ModelEvidence.best`), and hypotheses are compared by evidence.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping

import numpy as np
from jaxtyping import Bool, Float

from allanjax.estimate.design import correlation_times
from allanjax.estimate.evidence import term_sets
from allanjax.estimate.spectral.components import columns_of
from allanjax.noise.model import Model
from allanjax.noise.terms import Markov, NoiseTerm, PowerLaw, basic_terms
from allanjax.spectrum.cosine import Bins, cosine_transform, ramp_column

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
        return self.family.expected(self.power, self.index, count)

    @property
    def terms(self) -> tuple[str, ...]:
        """Names of the terms, the ramp included."""
        return (*self.power, RAMP) if self.ramp else tuple(self.power)

    def model(self) -> Model:
        """Model of the random terms with their values."""
        return Model(tuple(term_of(name, np.sqrt(p), self.shape) for name, p in self.power.items()))


def term_of(name: str, coefficient: float = 1.0, shape: float = float("nan")) -> NoiseTerm:
    """Term of a name with a coefficient, and with a correlation time [s] or an exponent if it has one."""
    if name == MARKOV:
        return Markov(float(coefficient), float(shape))
    if name == POWER_LAW:
        return PowerLaw(float(coefficient), float(shape))
    return basic_terms()[name].replace(coefficient=float(coefficient))


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
        self.sets = term_sets(len(FIXED), GRID, True)
        self.places = self.sets.columns[:, -1] - len(FIXED)
        self.ramp = ramp_column(n, rate)

    def shapes(self, name: str) -> Float[np.ndarray, " grid"]:
        """Correlation times [s] of a Markov process, or exponents of a power law, that are compared."""
        return EXPONENTS if name == POWER_LAW else self.times

    @functools.lru_cache(maxsize=4)  # noqa: B019 - families are few and cached
    def columns(self, shaped: str) -> Float[np.ndarray, "columns m"]:
        """Levels in the bins of the terms without a free shape, and of one term with each of its shapes."""
        terms = [*map(term_of, FIXED), *(term_of(shaped, 1.0, x) for x in self.shapes(shaped))]
        return columns_of(terms, self.bins).mean(axis=1)

    def spectrum(self, term: NoiseTerm) -> Float[np.ndarray, " n-1"]:
        """Expected squared coefficients of a term [rate²], from its density."""
        # In parts that a processor's cache holds.
        parts = np.split(self.frequency, range(_BLOCK, self.n - 1, _BLOCK))
        return self.rate * np.concatenate([np.asarray(term.sampled_psd(f, self.rate)) for f in parts])

    def unit(self, name: str, index: int) -> Float[np.ndarray, " n-1"]:
        """Expected squared coefficients of a term of unit amplitude.

        Its shape is given by its place in the grid. They follow from the density, but are exact if a bin has
        a single coefficient.
        """
        return self._unit(name, 0 if name in FIXED else index)

    @functools.lru_cache(maxsize=14)  # noqa: B019 - families are few and cached; spectra are long
    def _unit(self, name: str, index: int) -> Float[np.ndarray, " n-1"]:
        term = term_of(name) if name in FIXED else term_of(name, 1.0, self.shapes(name)[index])
        found, single = self.spectrum(term), self.bins.parts[0].low
        found[:single] = columns_of([term], self.bins)[0, 0, :single]
        return found

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

    def expected(
        self, power: Mapping[str, float], index: int, count: int | None = None
    ) -> Float[np.ndarray, " count"]:
        """Expected squared coefficients of a subset, all or the lowest."""
        count = self.n - 1 if count is None else count
        variance, term = np.zeros(count), np.empty(count)
        for name, p in power.items():
            variance += np.multiply(p, self.unit(name, index)[:count], out=term)
        return variance


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

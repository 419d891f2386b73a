"""Noise of one axis, for whitening: the basic terms and their powers, estimated anew for every hypothesis.

An effect that is not in the model looks like noise: a step like a random walk, an influence of temperature
like a Markov process. So no cause can be judged against noise that was estimated with the effect in it. Each
hypothesis leaves a different record, and gets the noise that explains that best (`ModelEvidence.best`);
hypotheses are compared by evidence. The structure of a spectrum is a factor of that of the basic terms.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Collection, Mapping, Sequence

import numpy as np
from jaxtyping import Bool, Float, Int

from allanjax.estimate.design import correlation_times
from allanjax.estimate.evidence import TermSets, evidence, term_sets
from allanjax.estimate.spectral import as_model
from allanjax.estimate.spectral import components as kinds
from allanjax.estimate.spectral import model as structures
from allanjax.estimate.spectral.components import columns_of
from allanjax.estimate.spectral.model import Structure, response_of
from allanjax.noise.model import Model
from allanjax.noise.terms import Markov, NoiseTerm, PowerLaw, basic_terms
from allanjax.spectrum.cosine import Bins, SpectralStatistics, cosine_transform, ramp_column

#: Terms without a free shape, and names of terms that are treated separately.
FIXED = ("quantization", "angle_random_walk", "bias_instability", "rate_random_walk")
WHITE, MARKOV, POWER_LAW, RAMP = "angle_random_walk", "markov", "power_law", "drift_ramp"
#: Share of white noise in all noise above which the two are not distinguished.
NEARLY_ALL = 0.9
# Number of frequencies that are evaluated at a time.
_AT_ONCE = 1 << 14
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
    """All subsets of the basic terms, with a Markov process or a power law, for n samples at a rate."""

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
        parts = np.split(self.frequency, range(_AT_ONCE, self.n - 1, _AT_ONCE))
        return self.rate * np.concatenate([np.asarray(term.sampled_psd(f, self.rate)) for f in parts])

    def unit(self, name: str, index: int) -> Float[np.ndarray, " n-1"]:
        """Expected squared coefficients of a unit term with a shape of the grid; exact in the lowest bins."""
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
        """Slope of the ramp [rate/s], by all coefficients or those in a fold, and its standard deviation."""
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
    """Every other pair of coefficients, as odd shapes have odd ones only, and the rest; both cover all."""
    some = np.arange(n - 1) // 2 % 2 == 0
    return some, ~some


#: Largest number of subsets over which estimates are averaged, and how much less likely than the best one
#: they may be [nats].
SETS, _LESS = 4, 3.0
# Largest number of subsets that are maximized: a quarter of all, and those for a first guess; and how far one
# may be behind the best one [nats], twice as far as all Occam factors together reach.
_NEAR, _FEW, _FAR = 143, 48, 60.0


@dataclasses.dataclass(frozen=True, eq=False)
class ModelEvidence:
    """Evidence of all subsets of the basic noise terms, given the cosine coefficients of one record.

    Attributes:
        family: family of the subsets.
        factor: ratio of the record's spectrum to that of the family; None for 1.
        fold: coefficients that count; None for all.
        size: number of coefficients in each bin.
        constant: the part of the log evidence that all subsets have in common [nats].
        levels: statistics of the coefficients in the bins.
        like: evidence for a similar record. If it is known, only the subsets that were best there are
            evaluated, and all without a free shape.
        near: largest number of subsets that are evaluated to the end.
        known: what has been computed.
    """

    family: NoiseFamily
    factor: Float[np.ndarray, " n-1"] | None
    fold: Bool[np.ndarray, " n-1"] | None
    size: Float[np.ndarray, " m"]
    constant: float
    levels: SpectralStatistics
    like: ModelEvidence | None = None
    near: int = _NEAR
    known: dict = dataclasses.field(default_factory=dict)

    @classmethod
    def of(
        cls,
        family: NoiseFamily,
        c: Float[np.ndarray, " n-1"],
        factor: Float[np.ndarray, " n-1"] | None = None,
        fold: Bool[np.ndarray, " n-1"] | None = None,
        like: ModelEvidence | None = None,
    ) -> ModelEvidence:
        """Evidence given coefficients whose spectrum is the family's times `factor`, of those in a `fold`."""
        every = np.True_ if fold is None else fold
        constant = 0.0 if factor is None else -0.5 * float(np.log(factor).sum(where=every))
        size = family.size if fold is None else family.bins.sums(fold.astype(float))
        ramp = _weighted(family.ramp, factor, fold)
        levels = SpectralStatistics(0.0, 0.0, family.bins.sums(ramp * family.ramp))
        found = cls(family, factor, fold, size, constant, levels, like)
        return dataclasses.replace(found, levels=found._statistics(c))

    def of_similar(self, c: Float[np.ndarray, " n-1"]) -> ModelEvidence:
        """Evidence of few subsets, given the coefficients of a similar record."""
        levels, like = self._statistics(c), self.like or self
        return dataclasses.replace(self, levels=levels, like=like, near=_FEW, known={})

    def of_rest(self, c: Float[np.ndarray, " n-1"], lowest: Float[np.ndarray, " slow"]) -> ModelEvidence:
        """Evidence of few subsets, given the coefficients of this record less these lowest ones."""
        # Only the bins of these change.
        count = int(np.searchsorted(self.family.bins.edges, len(lowest) + 1))
        rest = c[: self.family.bins.edges[count] - 1].copy()
        rest[: len(lowest)] -= lowest
        old, new = self.levels, self._statistics(rest, count)
        squares, cross = (np.append(few, all_[count:]) for few, all_ in zip(new[:2], old[:2], strict=True))
        levels = SpectralStatistics(squares, cross, old.gram)
        return dataclasses.replace(self, levels=levels, like=self.like or self, near=_FEW, known={})

    def _statistics(self, c: Float[np.ndarray, " some"], count: int | None = None) -> SpectralStatistics:
        """Statistics of the coefficients in the first `count` bins, or in all."""
        own, first = slice(len(c)), self.family.bins.edges[:-1][:count] - 1
        factor, fold = (None if x is None else x[own] for x in (self.factor, self.fold))
        weighted = _weighted(c, factor, fold)
        squares, cross = (np.add.reduceat(weighted * x, first) for x in (c, self.family.ramp[own]))
        return SpectralStatistics(squares, cross, self.levels.gram)

    def best(self, allowed: Collection[str], required: Sequence[str] = ()) -> Noise:
        """Most probable subset of the `allowed` terms with the `required` ones."""
        return self.likely(allowed, required, 1)[0]

    def likely(self, allowed: Collection[str], required: Sequence[str] = (), most: int = 1) -> list[Noise]:
        """Most probable subsets of the `allowed` terms with the `required` ones, the best one first."""
        found = self._maximized(allowed, required)
        # That of a subset with a free shape is the mean over its grid.
        total = found.log_evidence.copy()
        grid = total[~self._plain].reshape(-1, GRID)
        best = grid.argmax(axis=1)[:, None]
        mean = np.logaddexp.reduce(grid, axis=1, keepdims=True) - np.log(GRID)
        total[~self._plain] = np.where(best == np.arange(GRID), mean, -np.inf).ravel()
        order = np.argsort(-total, kind="stable")[: min(most, np.sum(total > -np.inf))]
        return [self._noise(int(k), found.power[k], float(total[k]), _shaped(allowed)) for k in order]

    def total(self, allowed: Collection[str], required: Sequence[str] = ()) -> float:
        """Log evidence of the record, summed over all subsets with the `required` terms [nats].

        Each term that is not required has the prior probability ½; all values of a free shape the same one.
        """
        values = self._maximized(allowed, required).log_evidence - np.where(self._plain, 0.0, np.log(GRID))
        optional = len({*FIXED, _shaped(allowed), RAMP} & set(allowed) - set(required))
        return float(np.logaddexp.reduce(values) - optional * np.log(2.0) + self.constant)

    @property
    def _plain(self) -> Bool[np.ndarray, " sets"]:
        """Which subsets have no free shape: the first ones. The others are in the order of its grid."""
        return ~self.family.sets.used[:, -1]

    def _maximized(self, allowed: Collection[str], required: Sequence[str]) -> TermSets:
        """Subsets of the allowed terms that may be the best ones; the evidence of all others is 0."""
        if (asked := (frozenset(allowed), frozenset(required))) not in self.known:
            shaped, sets = _shaped(allowed), self.family.sets
            names, has = (*FIXED, shaped, RAMP), np.column_stack([sets.used, sets.ramp])
            may, must = (np.isin(names, [*some]) for some in (allowed, required))
            possible, rough = np.all((may | ~has) & (has | ~must), axis=1), self._screened(shaped)
            always = self._plain & (self.like is not None)
            rank = np.where(possible, np.where(always, np.inf, rough.log_evidence), -np.inf)
            near = np.argsort(-rank)[: min(self.near, np.sum(possible))]
            found = self._evaluated(shaped, rough.of(near))
            values, powers = np.full(len(rank), -np.inf), rough.power.copy()
            values[near], powers[near] = found.log_evidence, found.power
            self.known[asked] = sets._replace(log_evidence=values, power=powers)
        return self.known[asked]

    def _screened(self, shaped: str) -> TermSets:
        """All subsets, of which every second shape is evaluated, and the others are interpolated."""
        if self.like is not None:
            return self.like._screened(shaped)
        if shaped not in self.known:
            sets, places = self.family.sets, self.family.places
            between = ~self._plain & (places % 2 == 1)
            k = np.flatnonzero(between)
            found = self._evaluated(shaped, sets.of(~between))
            values, powers = np.empty(len(between)), np.empty(sets.used.shape)
            values[~between], powers[~between] = found.log_evidence, found.power
            after = np.where(places[k] < GRID - 1, k + 1, k - 1)
            values[k], powers[k] = 0.5 * (values[k - 1] + values[after]), powers[k - 1]
            self.known[shaped] = sets._replace(log_evidence=values, power=powers)
        return self.known[shaped]

    def _evaluated(self, shaped: str, sets: TermSets) -> TermSets:
        """Subsets with their evidence and powers, starting from their powers, if they have any."""
        return evidence(sets, self.family.columns(shaped), self.levels, self.size, _FAR)

    def _noise(self, k: int, powers: Float[np.ndarray, " terms"], log_evidence: float, shaped: str) -> Noise:
        """Noise with the terms and powers of subset k."""
        sets, index = self.family.sets, int(self.family.places[k])
        names = (*FIXED, shaped)
        power = {names[i]: float(powers[i]) for i in np.flatnonzero(sets.used[k]) if powers[i] > 0.0}
        shape = float(self.family.shapes(shaped)[index]) if shaped in power else float("nan")
        return Noise(power, shape, bool(sets.ramp[k]), log_evidence + self.constant, self.family, index)


def _weighted(
    c: Float[np.ndarray, " n-1"],
    factor: Float[np.ndarray, " n-1"] | None,
    fold: Bool[np.ndarray, " n-1"] | None,
) -> Float[np.ndarray, " n-1"]:
    """Coefficients over a factor of their expected squares, and without those that do not count."""
    c = c if factor is None else c / factor
    return c if fold is None else c * fold


def _shaped(allowed: Collection[str]) -> str:
    """Name of the term with a free shape; a power law takes the place of the Markov process."""
    return POWER_LAW if POWER_LAW in allowed else MARKOV


def odds(sets: Sequence[Noise]) -> Float[np.ndarray, " sets"]:
    """Posterior probability of each subset, the best one first; 0 if it is far less likely."""
    less = np.array([sets[0].log_evidence - noise.log_evidence for noise in sets])
    likely = np.where(less < _LESS, np.exp(-less), 0.0)
    return likely / likely.sum()


# Response below which the record's ends are modelled.
_DEEP = 0.01
# Least share of the noise in the whole spectrum.
_LEAST_SHARE = 1e-12
# Number of frequencies between which what the ends add is interpolated.
_POINTS = 4096
# Distance of knots as a share of that from the lowest frequency or a resonance; number of even ones.
_STEP, _LINEAR = 0.01, 8192


def spectrum_factor(
    structure: Structure, family: NoiseFamily
) -> tuple[Float[np.ndarray, " n-1"], Float[np.ndarray, " n-1"]]:
    """Ratio of the whole spectrum to that of the slow terms, a power law and white noise before the response.

    Also the spectrum of the latter [rate²]. Both are evaluated at knots, between which they are linear. What
    the record's ends add is the floor below which no response falls.
    """
    knots, every, rate = _knots(structure, family.n), np.arange(family.n - 1), family.rate
    frequency, own = family.frequency[knots], [structure.components[k] for k in structure.there]
    each = np.stack(
        [
            rate * np.asarray(as_model.term_of(structure, k, rate).sampled(rate).sampled_psd(frequency, rate))
            for k in structure.there
        ]
    )
    inside, after = (np.array([c.inside == side for c in own]) @ each for side in (True, False))
    noise = (
        np.array(
            [
                c.kind == kinds.MARKOV or (c.kind == kinds.COLUMN and c.which != structures.OUTSIDE)
                for c in own
            ]
        )
        @ each
    )
    # There may be resonances only.
    noise = np.maximum(noise, _LEAST_SHARE * (inside + after))
    response = response_of(structure, rate)
    power = 1.0 if response is None else np.asarray(response.power(frequency, rate))
    factor, below = (np.interp(every, knots, x) for x in ((inside * power + after) / noise, noise))
    if response is not None and len(deep := np.flatnonzero(factor < _DEEP)):
        factor[deep] += np.interp(deep, knots, inside / noise) * _of_ends(structure, family.n, deep)
    return factor, below


def _knots(structure: Structure, n: int) -> Int[np.ndarray, " knots"]:
    """Places of coefficients, from 0, so dense that a spectrum is linear in between to some 10⁻⁵.

    Their distance is a share of that from the lowest one, and of the width of a resonance and the distance
    from it.
    """
    low = np.geomspace(1.0, n - 1.0, int(np.log(n) / _STEP) + 2)
    found = [low, np.linspace(1.0, n - 1.0, _LINEAR)]
    for own in map(structure.components.__getitem__, structure.oscillators):
        middle = own.frequency / np.pi * n
        width = middle / own.quality
        away = np.concatenate([np.arange(0.0, 1.0, _STEP), np.geomspace(1.0, n / width + 2.0, len(low))])
        found += [middle - width * away, middle + width * away]
    places = np.rint(np.concatenate(found)).astype(int) - 1
    return np.unique(np.concatenate([[0, n - 2], places[(places >= 0) & (places <= n - 2)]]))


def share_of_noise(
    structure: Structure, family: NoiseFamily, factor: Float[np.ndarray, " n-1"]
) -> Float[np.ndarray, " n-1"]:
    """Share of the spectrum that is not from the kinks at a record's ends, below 1 in a stop band only."""
    share, deep = np.ones(len(factor)), np.flatnonzero(factor < _DEEP)
    if structure.kind != kinds.NONE and len(deep):
        share[deep] -= _of_ends(structure, family.n, deep) / factor[deep]
    return np.clip(share, 1e-9, 1.0)


def _of_ends(structure: Structure, n: int, rows: Int[np.ndarray, " some"]) -> Float[np.ndarray, " some"]:
    """What the ends of a record add to the response of white noise, at some of its coefficients."""
    j = np.linspace(1.0, n - 1.0, min(_POINTS, n - 1))
    angle, no, (wc, Q) = np.pi * j[None] / n, np.zeros(len(j)), structure.bandwidth
    levels = kinds.Levels(no, no, angle, np.sin(angle / 2.0) ** 2, 1.0, float(n), no, no)
    whole, without = (
        kinds.passed(x, structure.kind, np.full((1, 1), wc), np.full((1, 1), Q))[0]
        for x in (levels, levels.endless)
    )
    return np.interp(rows + 1.0, j, np.maximum(whole - without, 0.0))

"""Evidence of every subset of the basic noise terms, for the record under a hypothesis.

Each hypothesis leaves a different record, which different terms explain best.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Sequence

import numpy as np
from jaxtyping import Bool, Float

from allanjax.critic.noise import FIXED, GRID, MARKOV, POWER_LAW, RAMP, Noise, NoiseFamily
from allanjax.estimate.evidence import TermSets, evidence
from allanjax.spectrum.cosine import SpectralStatistics

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
        return cls(family, factor, fold, size, constant, levels)._given(c, like)

    def of_similar(self, c: Float[np.ndarray, " n-1"]) -> ModelEvidence:
        """Evidence of few subsets, given the coefficients of a similar record."""
        return dataclasses.replace(self._given(c, self.like or self), near=_FEW)

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

    def _given(self, c: Float[np.ndarray, " n-1"], like: ModelEvidence | None) -> ModelEvidence:
        return dataclasses.replace(self, levels=self._statistics(c), like=like, known={})

    def _statistics(self, c: Float[np.ndarray, " some"], count: int | None = None) -> SpectralStatistics:
        """Statistics of the coefficients in the first `count` bins, or in all."""
        own, first = slice(len(c)), self.family.bins.edges[:-1][:count] - 1
        factor, fold = (None if x is None else x[own] for x in (self.factor, self.fold))
        weighted = _weighted(c, factor, fold)
        squares, cross = (np.add.reduceat(weighted * x, first) for x in (c, self.family.ramp[own]))
        return SpectralStatistics(squares, cross, self.levels.gram)

    def best(
        self,
        allowed: Collection[str] = (*FIXED, MARKOV, RAMP),
        required: Sequence[str] = (),
    ) -> Noise:
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

"""Evidence of every subset of the basic noise terms, for the record under a hypothesis.

Each hypothesis leaves a different record, which different terms explain best.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Collection, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from allanjax.critic.noise import EXPONENTS, FIXED, GRID, MARKOV, POWER_LAW, RAMP, Noise, NoiseFamily
from allanjax.estimate.evidence import TermSets
from allanjax.spectrum.cosine import SpectralStatistics

#: Largest number of subsets over which estimates are averaged, and how much less likely than the best one
#: they may be [nats].
SETS, _LESS = 4, 3.0
# Largest number of subsets that are maximized: a quarter of all.
_NEAR = 143


class _Evidences(NamedTuple):
    """Evidence and powers of all subsets, and which of them were maximized."""

    log_evidence: Float[np.ndarray, " jobs"]
    power: Float[np.ndarray, "jobs terms"]
    near: Int[np.ndarray, " near"]


@dataclasses.dataclass(frozen=True, eq=False)
class SpectralMask:
    """Spectral factor and fold of coefficients under which the evidence of a record is computed."""

    family: NoiseFamily
    weight: Float[np.ndarray, " n-1"] | None
    ramp: Float[np.ndarray, " n-1"]
    gram: Float[np.ndarray, " m"]
    size: Float[np.ndarray, " m"]
    constant: float

    @classmethod
    def of(
        cls,
        family: NoiseFamily,
        factor: Float[np.ndarray, " n-1"] | None = None,
        fold: Bool[np.ndarray, " n-1"] | None = None,
    ) -> SpectralMask:
        """Mask for records whose spectrum is the family's times `factor`, in the coefficients of a `fold`."""
        weight, constant, size = None if fold is None else fold.astype(float), 0.0, family.size
        if weight is not None:
            size = family.bins.sums(weight)
        if factor is not None:
            log = np.log(factor)
            constant = -0.5 * float(log.sum() if fold is None else log.sum(where=fold))
            weight = 1.0 / factor if weight is None else weight / factor
        ramp = family.ramp if weight is None else weight * family.ramp
        gram = family.bins.sums(ramp * family.ramp)
        return cls(family, weight, ramp, gram, size, constant)

    def evidence(self, c: Float[np.ndarray, " n-1"], like: ModelEvidence | None = None) -> ModelEvidence:
        """Evidence of all subsets, given a record's cosine coefficients, and that of a similar record."""
        squares = c * c
        if self.weight is not None:
            squares *= self.weight
        sums = self.family.bins.sums
        levels = SpectralStatistics(sums(squares), sums(self.ramp * c), self.gram)
        return ModelEvidence(self.family, levels, self.size, self.constant, like)


@dataclasses.dataclass(frozen=True, eq=False)
class ModelEvidence:
    """Evidence of all subsets of the basic noise terms, given the statistics of one hypothetical record.

    If that of a similar record is known, only the subsets that were best there are evaluated, and all without
    a free shape.
    """

    family: NoiseFamily
    levels: SpectralStatistics
    size: Float[np.ndarray, " m"]
    constant: float
    like: ModelEvidence | None = None

    @functools.cached_property
    def _basic(self) -> TermSets:
        return self._screen(MARKOV)

    @functools.cached_property
    def _with_power_law(self) -> TermSets:
        return self._screen(POWER_LAW)

    def _screen(self, grid: str) -> TermSets:
        """Coarse evidence of all subsets: every second shape is evaluated, the others are interpolated."""
        jobs, places = self.family.jobs, self.family.places
        between = jobs.used[:, -1] & (places % 2 == 1)
        rows, k = np.flatnonzero(~between), np.flatnonzero(between)
        found = self.family.run(self.levels, self.size, self._columns(grid), rows)
        values, powers = np.empty(len(between)), np.empty((len(between), len(FIXED) + 1))
        values[rows], powers[rows] = found.log_evidence, found.power
        after = np.where(places[k] < GRID - 1, k + 1, k - 1)
        values[k], powers[k] = 0.5 * (values[k - 1] + values[after]), powers[k - 1]
        return jobs._replace(log_evidence=values, power=powers)

    def best(
        self,
        allowed: Collection[str] = (*FIXED, MARKOV, RAMP),
        required: Sequence[str] = (),
    ) -> Noise:
        """Most probable subset of the `allowed` terms with the `required` ones."""
        return self.likely(allowed, required, 1)[0]

    def likely(self, allowed: Collection[str], required: Sequence[str] = (), most: int = 1) -> list[Noise]:
        """Most probable subsets of the `allowed` terms with the `required` ones, the best one first."""
        values, powers, _ = self._evidence_of(allowed, required)
        return self._ranked(values, powers, _grid(allowed), most)

    def total(self, allowed: Collection[str], required: Sequence[str] = ()) -> float:
        """Log evidence of the record, summed over all subsets with the `required` terms [nats].

        Each term that is not required has the prior probability ½; all values of a free shape the same one.
        """
        values, _, near = self._evidence_of(allowed, required)
        names = {name for name, _ in self._members(_grid(allowed))}
        optional = len(names & set(allowed) - set(required))
        shaped = np.where(self.family.jobs.used[near, -1], np.log(GRID), 0.0)
        return float(np.logaddexp.reduce(values[near] - shaped) - optional * np.log(2.0) + self.constant)

    def _evidence_of(self, allowed: Collection[str], required: Sequence[str]) -> _Evidences:
        """Evidence of all subsets, −∞ for impossible ones, kept; only possible best ones are maximized."""
        asked = frozenset(allowed), frozenset(required)
        if asked not in self._known:
            self._known[asked] = self._refine(allowed, required)
        return self._known[asked]

    @functools.cached_property
    def _known(self) -> dict[tuple[frozenset[str], frozenset[str]], _Evidences]:
        return {}

    def _refine(self, allowed: Collection[str], required: Sequence[str]) -> _Evidences:
        """Coarse evidence, with that of the most probable subsets maximized."""
        grid = _grid(allowed)
        possible, rough = self._possible(allowed, required), self._of(grid)
        values, powers = np.where(possible, rough.log_evidence, -np.inf), rough.power.copy()
        plain = possible & ~self.family.jobs.used[:, -1] & (self.like is not None)
        near = np.argsort(-np.where(plain, np.inf, values))[: min(_NEAR, np.sum(possible))]
        found = self.family.run(self.levels, self.size, self._columns(grid), near, powers[near])
        if self.like is not None:
            values[:] = -np.inf
        values[near], powers[near] = found.log_evidence, found.power
        return _Evidences(values, powers, near)

    def _of(self, grid: str) -> TermSets:
        if self.like is not None:
            return self.like._of(grid)
        return self._with_power_law if grid == POWER_LAW else self._basic

    def _columns(self, grid: str) -> Float[np.ndarray, "grid m"]:
        return self.family.power_laws if grid == POWER_LAW else self.family.columns[len(FIXED) :]

    def _possible(self, allowed: Collection[str], required: Sequence[str] = ()) -> Bool[np.ndarray, " jobs"]:
        """Whether each subset consists of `allowed` terms and has the `required` ones."""
        possible = np.ones(len(self.family.jobs.ramp), bool)
        for name, has in self._members(_grid(allowed)):
            if name not in allowed:
                possible &= ~has
            if name in required:
                possible &= has
        return possible

    def _ranked(
        self,
        values: Float[np.ndarray, " jobs"],
        powers: Float[np.ndarray, "jobs terms"],
        grid: str,
        most: int,
    ) -> list[Noise]:
        """Subsets of largest evidence; that of a subset with a free shape is the mean over its grid."""
        jobs, possible = self.family.jobs, values > -np.inf
        in_grid, total = jobs.used[:, -1], values.copy()
        keys = np.column_stack([jobs.used[:, :-1], jobs.ramp]).astype(int) @ 2 ** np.arange(len(FIXED) + 1)
        for key in np.unique(keys[in_grid & possible]):
            rows = in_grid & (keys == key)
            mean = np.logaddexp.reduce(values[rows]) - np.log(rows.sum())
            total[rows] = np.where(values[rows] == values[rows].max(), mean, -np.inf)
        order = np.argsort(-total, kind="stable")[: min(most, np.sum(total > -np.inf))]
        return [self._noise(int(k), powers[k], float(total[k]), grid) for k in order]

    def _noise(self, k: int, powers: Float[np.ndarray, " terms"], log_evidence: float, grid: str) -> Noise:
        """Noise with the terms and powers of subset k."""
        jobs, names = self.family.jobs, [*FIXED, grid]
        power = {names[i]: float(powers[i]) for i in np.flatnonzero(jobs.used[k]) if powers[i] > 0.0}
        shape = float("nan")
        if grid in power:
            values_of = EXPONENTS if grid == POWER_LAW else self.family.times
            shape = float(values_of[self.family.places[k]])
        log_evidence += self.constant
        return Noise(power, shape, bool(jobs.ramp[k]), log_evidence, self.family, int(self.family.places[k]))

    def _members(self, grid: str) -> list[tuple[str, Bool[np.ndarray, " jobs"]]]:
        """Each term, with a flag per subset that has it."""
        jobs = self.family.jobs
        members = [(name, jobs.used[:, i]) for i, name in enumerate((*FIXED, grid))]
        return [*members, (RAMP, jobs.ramp)]


def _grid(allowed: Collection[str]) -> str:
    """Name of the term with a free shape; a power law takes the place of the Markov process."""
    return POWER_LAW if POWER_LAW in allowed else MARKOV


def odds(sets: Sequence[Noise]) -> Float[np.ndarray, " sets"]:
    """Posterior probability of each subset, the best one first; 0 if it is far less likely."""
    less = np.array([sets[0].log_evidence - noise.log_evidence for noise in sets])
    likely = np.where(less < _LESS, np.exp(-less), 0.0)
    return likely / likely.sum()

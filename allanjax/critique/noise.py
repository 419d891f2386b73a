"""The noise of one axis, for whitening: the basic terms and their powers, chosen anew for every hypothesis.

An effect that is not in the model is taken for noise: a step for a random walk, a temperature's influence for
a Markov process. So no cause can be judged against noise estimated with the effect still in it. Each
hypothesis gets the noise that suits it best (`NoiseFamily.best`), and what is compared is their evidence.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Collection, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from allanjax.cosine import CosineBins, cosine_transform
from allanjax.deterministic import ramp_column
from allanjax.evidence import BLOCK, FURTHER, ROUGH, Evidence, Job, Levels, evidences
from allanjax.model import Model
from allanjax.selection import basic_terms, jobs_of
from allanjax.terms import Markov, NoiseTerm, PowerLaw

FIXED = ("quantization", "angle_random_walk", "bias_instability", "rate_random_walk")
WHITE, MARKOV, POWER_LAW, RAMP = "angle_random_walk", "markov", "power_law", "drift_ramp"
#: White noise that is so much of all noise is not told from it.
NEARLY_ALL = 0.9
# Lengths of spectra are rounded up to multiples of this.
_PADDED = 4096
#: Sets of noise terms of which one may be the right one, and how much less likely they may be [nats].
SETS, _LESS = 4, 3.0
#: Values of the free shape (a correlation time or an exponent) that are compared.
GRID = 16
# Slopes that no basic term has; the grid keeps its distance from those that have one.
_EXPONENTS = np.array(
    [-0.6, -0.4, 0.25, 0.35, 0.45, 0.55, 0.65, 0.75, 1.25, 1.35, 1.5, 1.65, 1.75, 2.3, 2.5, 2.8]
)


@dataclasses.dataclass(frozen=True, eq=False)
class Noise:
    """A set of noise terms with their coefficients.

    Attributes:
        power: squared coefficient of each term, by name.
        shape: correlation time [s] or exponent of the term that has one, nan if there is none.
        ramp: whether a ramp was projected out.
        log_evidence: of the record under this set [nats], up to a constant common to all sets.
        family: of which it is a set.
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
        """Of the lowest coefficients; the others are not computed for these."""
        if "variance" in vars(self):
            return self.variance[:count]
        return self.family.expected(self.power, self.index, count)

    @property
    def terms(self) -> tuple[str, ...]:
        """Names of the terms, the ramp included."""
        return (*self.power, RAMP) if self.ramp else tuple(self.power)

    def model(self) -> Model:
        """The random terms with their values."""
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
    """All sets of basic terms for records of n samples at a rate.

    A set with a power law has it in the Markov process's place.
    """

    def __init__(self, n: int, rate: float) -> None:
        self.n, self.rate = n, rate
        self.bins = CosineBins.of(n, rate)
        self.keep = self.bins.size > 0
        self.size = self.bins.size[self.keep].astype(float)
        self.times = np.geomspace(4.0 / rate, n / rate / 4.0, GRID)
        self.frequency = np.arange(1, n) * rate / (2.0 * n)
        self._padded = jnp.asarray(_padded(self.frequency))
        unit = [basic_terms()[name].replace(coefficient=1.0) for name in FIXED]
        self.spectra = np.stack([self.spectrum(term) for term in unit])
        self.columns = np.asarray(_levels(tuple(unit), self.bins, Markov, self.times))[:, self.keep]
        self.jobs = jobs_of(len(FIXED), GRID, True)
        self.ramp = ramp_column(n, rate)

    def spectrum(self, term: NoiseTerm) -> Float[np.ndarray, " n-1"]:
        """Expected squared coefficients [rate²] of a term of any amplitude, from its density."""
        return self.rate * _evaluated(term, self._padded, self.rate)[: self.n - 1]

    @functools.cached_property
    def power_laws(self) -> Float[np.ndarray, "grid m"]:
        """Levels of power laws of unit amplitude."""
        return np.asarray(_levels((), self.bins, PowerLaw, _EXPONENTS))[:, self.keep]

    def of(
        self,
        c: Float[np.ndarray, " n-1"],
        factor: Float[np.ndarray, " n-1"] | None = None,
        fold: Bool[np.ndarray, " n-1"] | None = None,
    ) -> Weighing:
        """Weigh all sets for a record with these coefficients, its spectrum being theirs times `factor`.

        With a `fold` only its coefficients are looked at.
        """
        return self.behind(factor, fold).weigh(c)

    def behind(
        self, factor: Float[np.ndarray, " n-1"] | None = None, fold: Bool[np.ndarray, " n-1"] | None = None
    ) -> Behind:
        """To weigh all sets for any record whose spectrum is theirs times `factor`."""
        weight, constant, size = None if fold is None else fold.astype(float), 0.0, self.size
        if weight is not None:
            size = self.bins.sums(weight)[self.keep]
        if factor is not None:
            log = np.log(factor)
            constant = -0.5 * float(log.sum() if fold is None else log.sum(where=fold))
            weight = 1.0 / factor if weight is None else weight / factor
        ramp = self.ramp if weight is None else weight * self.ramp
        gram = self.bins.sums(ramp * self.ramp)[self.keep]
        return Behind(self, weight, ramp, gram, size, constant)

    def slope(
        self,
        c: Float[np.ndarray, " n-1"],
        variance: Float[np.ndarray, " n-1"],
        fold: Bool[np.ndarray, " n-1"] | None = None,
    ) -> tuple[float, float]:
        """Ramp [rate/s] of the record with these coefficients, or with those in a fold; and its deviation."""
        weight = self.ramp / variance if fold is None else fold * self.ramp / variance
        gram = float(weight @ self.ramp)
        return float(weight @ c) / gram, float(1.0 / np.sqrt(gram))

    def run(
        self,
        levels: Levels,
        size: Float[np.ndarray, " m"],
        grid: Float[np.ndarray, "grid m"],
        rows: Int[np.ndarray, " jobs"],
        first: Float[np.ndarray, "jobs terms"] | None = None,
        steps: int = FURTHER,
    ) -> Evidence:
        """Evidence and powers of these jobs after so many steps, from powers to start with."""
        jobs, share = Job(*(x[rows] for x in self.jobs)), np.ones((1, len(self.size)))
        known = self.columns[: len(FIXED)]
        first = None if first is None else first[None]
        found = evidences(jobs, levels, known, grid, size, share, first, steps)
        return Evidence(*(x[0] for x in found))

    @functools.lru_cache(maxsize=2 * GRID)  # noqa: B019 - families are few, and themselves cached
    def shaped(self, name: str, index: int) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, " n-1"]]:
        """Levels and spectrum of a Markov process or a power law of unit amplitude, by place in its grid."""
        if name == MARKOV:
            return self.columns[len(FIXED) + index], self.spectrum(Markov(1.0, self.times[index]))
        return self.power_laws[index], self.spectrum(PowerLaw(1.0, float(_EXPONENTS[index])))

    def unit(self, name: str, index: int) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, " n-1"]]:
        """Levels in the bins and spectrum of a term of unit amplitude."""
        if name not in FIXED:
            return self.shaped(name, index)
        k = FIXED.index(name)
        return self.columns[k], self.spectra[k]

    def expected(
        self, power: dict[str, float], index: int, count: int | None = None
    ) -> Float[np.ndarray, " count"]:
        """Expected squared coefficients of a set (all, or the lowest): from the density but for the first."""
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


@dataclasses.dataclass(frozen=True, eq=False)
class Behind:
    """What weighing records needs that does not depend on them: a factor of the spectrum, a fold."""

    family: NoiseFamily
    weight: Float[np.ndarray, " n-1"] | None
    ramp: Float[np.ndarray, " n-1"]
    gram: Float[np.ndarray, " m"]
    size: Float[np.ndarray, " m"]
    constant: float

    def weigh(self, c: Float[np.ndarray, " n-1"]) -> Weighing:
        """The statistics of the record with these coefficients."""
        squares = c * c
        if self.weight is not None:
            squares *= self.weight
        found = (self.family.bins.sums(z)[self.family.keep] for z in (squares, self.ramp * c))
        levels = Levels(*(z[None] for z in (*found, self.gram)))
        return Weighing(self.family, levels, self.size, self.constant)


@dataclasses.dataclass(frozen=True, eq=False)
class Weighing:
    """The statistics of one hypothetical record, from which sets of noise terms are weighed."""

    family: NoiseFamily
    levels: Levels
    size: Float[np.ndarray, " m"]
    constant: float

    @functools.cached_property
    def _basic(self) -> Evidence:
        return self._rough(MARKOV)

    @functools.cached_property
    def _with_power_law(self) -> Evidence:
        return self._rough(POWER_LAW)

    def _rough(self, grid: str) -> Evidence:
        """Of all sets: with every other shape, and between these what is between."""
        jobs = self.family.jobs
        between = jobs.terms[:, -1] & (jobs.column % 2 == 1)
        rows, k = np.flatnonzero(~between), np.flatnonzero(between)
        found = self.family.run(self.levels, self.size, self._columns(grid), rows, steps=ROUGH)
        values, powers = np.empty(len(between)), np.empty((len(between), len(FIXED) + 1))
        values[rows], powers[rows] = found.log_evidence, found.power
        after = np.where(jobs.column[k] < GRID - 1, k + 1, k - 1)
        values[k], powers[k] = 0.5 * (values[k - 1] + values[after]), powers[k - 1]
        return Evidence(values, powers)

    def best(
        self,
        allowed: Collection[str] = (*FIXED, MARKOV, RAMP),
        required: Sequence[str] = (),
    ) -> Noise:
        """The most probable set of `allowed` terms that has the `required` ones."""
        return self.likely(allowed, required, 1)[0]

    def likely(self, allowed: Collection[str], required: Sequence[str] = (), most: int = 1) -> list[Noise]:
        """The most probable sets of `allowed` terms that have the `required` ones, the best one first."""
        grid = _grid(allowed)
        possible, rough = self._possible(allowed, required), self._of(grid)
        values, powers = np.where(possible, rough.log_evidence, -np.inf), rough.power.copy()
        # Only those that may be the best one are carried to their maximum.
        near = np.argsort(-values)[: min(BLOCK, np.sum(possible))]
        found = self.family.run(self.levels, self.size, self._columns(grid), near, powers[near])
        values[near], powers[near] = found.log_evidence, found.power
        return self._ranked(values, powers, grid, most)

    def roughly(self, allowed: Collection[str], like: Weighing) -> Noise:
        """About the most probable set, to go on from.

        Looked at are those without a free shape and those that were best for a record like this.
        """
        grid = _grid(allowed)
        possible, shaped = self._possible(allowed), self.family.jobs.terms[:, -1]
        known = np.where(possible & shaped, like._of(grid).log_evidence, -np.inf)
        plain = np.flatnonzero(possible & ~shaped)
        best = np.argsort(-known)[: min(BLOCK - len(plain), np.sum(known > -np.inf))]
        near = np.concatenate([plain, best])
        found = self.family.run(self.levels, self.size, self._columns(grid), near)
        values, powers = np.full(len(possible), -np.inf), np.zeros((len(possible), len(FIXED) + 1))
        values[near], powers[near] = found.log_evidence, found.power
        return self._ranked(values, powers, grid, 1)[0]

    def _of(self, grid: str) -> Evidence:
        return self._with_power_law if grid == POWER_LAW else self._basic

    def _columns(self, grid: str) -> Float[np.ndarray, "grid m"]:
        return self.family.power_laws if grid == POWER_LAW else self.family.columns[len(FIXED) :]

    def _possible(self, allowed: Collection[str], required: Sequence[str] = ()) -> Bool[np.ndarray, " jobs"]:
        """Sets of `allowed` terms that have the `required` ones."""
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
        """The sets of largest evidence: that of one with a free shape is the mean over its grid."""
        jobs, possible = self.family.jobs, values > -np.inf
        in_grid, total = jobs.terms[:, -1], values.copy()
        keys = np.column_stack([jobs.terms[:, :-1], jobs.ramp]).astype(int) @ 2 ** np.arange(len(FIXED) + 1)
        for key in np.unique(keys[in_grid & possible]):
            rows = in_grid & (keys == key)
            mean = np.logaddexp.reduce(values[rows]) - np.log(rows.sum())
            total[rows] = np.where(values[rows] == values[rows].max(), mean, -np.inf)
        order = np.argsort(-total, kind="stable")[: min(most, np.sum(total > -np.inf))]
        return [self._noise(int(k), powers[k], float(total[k]), grid) for k in order]

    def _noise(self, k: int, powers: Float[np.ndarray, " terms"], log_evidence: float, grid: str) -> Noise:
        """The set of that job."""
        jobs, names = self.family.jobs, [*FIXED, grid]
        power = {names[i]: float(powers[i]) for i in np.flatnonzero(jobs.terms[k]) if powers[i] > 0.0}
        shape = float("nan")
        if grid in power:
            values_of = _EXPONENTS if grid == POWER_LAW else self.family.times
            shape = float(values_of[jobs.column[k]])
        log_evidence += self.constant
        return Noise(power, shape, bool(jobs.ramp[k]), log_evidence, self.family, int(jobs.column[k]))

    def _members(self, grid: str) -> list[tuple[str, Bool[np.ndarray, " jobs"]]]:
        jobs = self.family.jobs
        members = [(name, jobs.terms[:, i]) for i, name in enumerate((*FIXED, grid))]
        return [*members, (RAMP, jobs.ramp)]


def _grid(allowed: Collection[str]) -> str:
    """The term with a free shape: a power law is in the Markov process's place."""
    return POWER_LAW if POWER_LAW in allowed else MARKOV


def odds(sets: Sequence[Noise]) -> Float[np.ndarray, " sets"]:
    """Probability of each of these sets of terms, the best one first; 0 if it is far less likely."""
    less = np.array([sets[0].log_evidence - noise.log_evidence for noise in sets])
    likely = np.where(less < _LESS, np.exp(-less), 0.0)
    return likely / likely.sum()


def density(term: NoiseTerm, frequency: Float[np.ndarray, " k"], rate: float) -> Float[np.ndarray, " k"]:
    """`sampled_psd`, compiled once for all values of the parameters and lengths that are nearly the same."""
    return _evaluated(term, _padded(frequency), rate)[: len(frequency)]


def _padded(frequency: Float[np.ndarray, " k"]) -> Float[np.ndarray, " more"]:
    return np.append(frequency, np.full(-len(frequency) % _PADDED, frequency[-1]))


def _evaluated(term: NoiseTerm, frequency: Float[ArrayLike, " k"], rate: float) -> Float[np.ndarray, " k"]:
    values = {p.name: getattr(term, p.name) for p in term.parameters()}
    term = term.replace(**{name: np.asarray(x, float) for name, x in values.items() if np.isfinite(x)})
    return np.asarray(_density(term, frequency, rate))


@eqx.filter_jit
def _density(term: NoiseTerm, frequency: Float[ArrayLike, " k"], rate: float) -> Float[Array, " k"]:
    return term.sampled_psd(frequency, rate)


@functools.lru_cache(maxsize=2)
def family_of(n: int, rate: float) -> NoiseFamily:
    """The family for such records; the axes of a recording share it."""
    return NoiseFamily(n, rate)


@eqx.filter_jit
def _levels(
    terms: tuple[NoiseTerm, ...],
    bins: CosineBins,
    shaped: Callable[[float, Any], NoiseTerm],
    shapes: Float[ArrayLike, " grid"],
) -> Float[Array, "rows m"]:
    """Levels in the bins of these terms, and of one with each of its shapes, amplitude 1."""
    rows = [bins.expected(term) for term in terms]
    rows += list(jax.lax.map(lambda shape: bins.expected(shaped(1.0, shape)), jnp.asarray(shapes)))
    return jnp.stack(rows)


def centred(x: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n-1"]:
    """Coefficients c_1 … c_{n−1} of a record."""
    return cosine_transform(x - x.mean())

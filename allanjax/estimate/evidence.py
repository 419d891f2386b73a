"""The evidence for sets of noise terms: Whittle's likelihood integrated over the amplitudes of each set.

An amplitude c has the prior 1/[(c + c0)·Y], uniform where the term could not be detected, and uniform in ln c
above (the modified Jeffreys prior, Gregory 2005, ApJ 631:1198). Its scale c0 is the amplitude whose power
would be one standard deviation in these data; Y = ln(1 + 10⁴): four decades. So a term's Occam factor
depends on how sharply the data determine it, not on units, and is two to five nats. (The scale of a ramp's
prior is the standard deviation of the ramp under each set's own noise.)

The integral over the powers is Laplace's approximation, with the exact Fisher information; the factor of
each amplitude along its own axis is a quadrature, which keeps it right next to and at the boundary c = 0. A
correlation time is integrated over a grid, uniform in its logarithm. The sign of a ramp is averaged.
"""

from __future__ import annotations

import dataclasses
import itertools
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from allanjax.base.arrays import namespace
from allanjax.base.cache import compiled_once
from allanjax.base.errors import AllanjaxError
from allanjax.base.linalg import inverse, whiten
from allanjax.base.threads import for_each
from allanjax.estimate.design import correlation_times
from allanjax.estimate.spectral.components import columns_of
from allanjax.noise.model import Model
from allanjax.noise.terms import NoiseTerm
from allanjax.spectrum.cosine import Bins, SpectralStatistics

#: Largest amplitude that the prior allows, over the prior's scale, and the normalization ln(1 + that).
PRIOR_RANGE = 1e4
LOG_PRIOR_RANGE = np.log1p(PRIOR_RANGE)
#: Steps of Fisher scoring: from zero to the maximum; to separate relevant sets from the others; and from
#: there to the maximum (within 10⁻⁵ nats).
STEPS, ROUGH, FURTHER = 20, 3, 6
# Sweeps over the powers within a step, each of which goes on from the last.
_SWEEPS = 40
# Points of the integral over one amplitude: within 10⁻⁷ nats, for half of the time that the evidence takes.
_QUADRATURE = 48
#: Sets computed together in one compiled program: a quarter of the sets of six basic terms.
BLOCK = 143
# Numbers of bins are rounded up to multiples of this.
_BINS = 192


class TermSubset(NamedTuple):
    """A subset of the candidate terms, or several, stacked [subsets].

    Attributes:
        terms: which terms without a free shape it has, and whether it has one with a free shape, or two.
        column: index of the latter's shape in its grid, 0 without one; an array for two.
        ramp: whether it has a ramp.
    """

    terms: Any
    column: Any
    ramp: Any


def term_subsets(fixed: int, grid: int, ramp: bool) -> TermSubset:
    """All subsets: first those of the terms without a free shape, then those with each shape of the grid."""
    subsets = [
        (*terms, r)
        for terms in itertools.product([False, True], repeat=fixed)
        for r in (False, True)[: 1 + ramp]
    ]
    rows = [((*s[:-1], False), 0, s[-1]) for s in subsets if any(s[:-1])]
    rows += [((*s[:-1], True), column, s[-1]) for s in subsets for column in range(grid)]
    terms, columns, with_ramp = (np.array(values) for values in zip(*rows, strict=True))
    return TermSubset(terms, columns, with_ramp)


def term_pairs(
    some: Bool[np.ndarray, "sets fixed"], ramp: Bool[np.ndarray, " sets"], grid: int
) -> TermSubset:
    """Subsets of two terms with different free shapes: all pairs, combined with each of these sets."""
    pairs = np.array(list(itertools.combinations(range(grid), 2))).reshape(-1, 2)
    rows, each = np.repeat(np.arange(len(some)), len(pairs)), np.tile(pairs, (len(some), 1))
    both = np.ones((len(rows), 2), bool)
    return TermSubset(np.concatenate([some[rows], both], axis=1), each, ramp[rows])


class Evidence(NamedTuple):
    """Log-evidence [nats] of a subset, and the powers of its terms at the maximum of the likelihood."""

    log_evidence: Any
    power: Any


def without_ramp(
    statistics: SpectralStatistics, size: ArrayLike, mean: ArrayLike, ramp: ArrayLike
) -> tuple[Array, Array]:
    """Sums of squares and degrees of freedom in each bin with the ramp, if there is one, projected out."""
    xp = namespace(statistics, size, mean, ramp)
    u = xp.sum(statistics.gram / mean)
    beta = xp.where(ramp, xp.sum(statistics.cross / mean) / u, 0.0)
    squares = statistics.squares - 2.0 * beta * statistics.cross + beta**2 * statistics.gram
    return xp.maximum(squares, 0.0), xp.asarray(size) - xp.where(ramp, statistics.gram / (mean * u), 0.0)


def _log_likelihood(
    statistics: SpectralStatistics, size: Array, share: Array, mean: Array, ramp: Array
) -> Array:
    """Whittle log-likelihood, integrated over all amplitudes of the ramp, up to a constant that depends on
    its unit."""
    base = -0.5 * jnp.sum(share * (size * jnp.log(mean) + statistics.squares / mean))
    u, p = jnp.sum(share * statistics.gram / mean), jnp.sum(share * statistics.cross / mean)
    return base + jnp.where(ramp, 0.5 * p**2 / u - 0.5 * jnp.log(u), 0.0)


def _non_negative_powers(normal: Array, target: Array, allowed: Array, start: Array) -> Array:
    """Powers x ≥ 0 that minimize x'Ax/2 − x'b, approached by coordinate descent from `start`."""

    def sweep(_: int, x: Array) -> Array:
        for k in range(len(target)):
            new = jnp.maximum(x[k] + (target[k] - normal[k] @ x) / normal[k, k], 0.0)
            x = x.at[k].set(jnp.where(allowed[k], new, 0.0))
        return x

    return jax.lax.fori_loop(0, _SWEEPS, sweep, start)


def _marginal_factor(precision: Array, power: Array, score: Array, prior_scale: Array) -> Array:
    """Factor of one amplitude in the evidence: ln ∫ prior(c) exp[score·c² − ½ precision (c² − power)²] dc."""
    # Uniform in y = ln(1 + c/prior_scale), as the prior is, from zero to where the integrand has ended.
    width = 1.0 / jnp.sqrt(precision)
    top = jnp.log1p(jnp.sqrt(power + 8.0 * width) / prior_scale)
    # If the power is well determined, only values near it are needed.
    bottom = jnp.log1p(jnp.sqrt(jnp.maximum(power - 8.0 * width, 0.0)) / prior_scale)
    y = bottom + (top - bottom) * (jnp.arange(_QUADRATURE) + 0.5) / _QUADRATURE
    v = (prior_scale * jnp.expm1(y)) ** 2
    exponent = score * v - 0.5 * precision * (v - power) ** 2
    return jax.nn.logsumexp(exponent) + jnp.log((top - bottom) / _QUADRATURE / LOG_PRIOR_RANGE)


def _ramp_evidence(statistics: SpectralStatistics, share: Array, mean: Array) -> Array:
    """Factor of the ramp, ln ∫ prior(R) cosh(Rp) exp(−½R²u) dR, less the part in `_log_likelihood`."""
    u, p = jnp.sum(share * statistics.gram / mean), jnp.sum(share * statistics.cross / mean)
    prior_scale = 1.0 / jnp.sqrt(u)
    centre = jnp.abs(p) / u
    top = jnp.log1p((centre + 8.0 * prior_scale) / prior_scale)
    bottom = jnp.log1p(jnp.maximum(centre - 8.0 * prior_scale, 0.0) / prior_scale)
    y = bottom + (top - bottom) * (jnp.arange(_QUADRATURE) + 0.5) / _QUADRATURE
    R = prior_scale * jnp.expm1(y)
    log_cosh = jnp.abs(R * p) + jnp.log1p(jnp.exp(-2.0 * jnp.abs(R * p))) - jnp.log(2.0)
    integral = jax.nn.logsumexp(log_cosh - 0.5 * R**2 * u) + jnp.log(
        (top - bottom) / _QUADRATURE / LOG_PRIOR_RANGE
    )
    return integral - (0.5 * p**2 / u - 0.5 * jnp.log(u))


def _evidence(
    subset: TermSubset,
    first: Array,
    statistics: SpectralStatistics,
    fixed: Array,
    grid: Array,
    size: Array,
    share: Array,
    smooth: Array,
    prior_scales: Array,
    steps: Array,
) -> Evidence:
    """Evidence of one subset: Fisher scoring to the maximum, then the integral around it."""
    shaped = jnp.atleast_1d(subset.column)
    columns = jnp.concatenate([fixed, grid[shaped]])
    start = jnp.where(jnp.any(first > 0.0), jnp.maximum(first @ columns, 1e-300), smooth)
    prior_scale = prior_scales[jnp.append(jnp.arange(len(fixed)), len(fixed) + shaped)]

    def step(_: int, state: tuple[Array, Array]) -> tuple[Array, Array]:
        power, mean = state
        squares, dof = without_ramp(statistics, size, mean, subset.ramp)
        level = jnp.where(dof > 1e-3, squares / jnp.maximum(dof, 1e-3), mean)
        weight = share * dof / 2.0 / mean**2
        new = _non_negative_powers(
            columns * weight @ columns.T, columns @ (weight * level), subset.terms, power
        )
        # Fisher scoring may overshoot; then half the step is taken.
        tried = jnp.stack([new, 0.5 * (power + new)])
        means = jnp.maximum(tried @ columns, 1e-300)
        values = jax.vmap(lambda mean: _log_likelihood(statistics, size, share, mean, subset.ramp))(means)
        best = jnp.argmax(values)
        return tried[best], means[best]

    power, mean = jax.lax.fori_loop(0, steps, step, (first, start))
    likelihood = _log_likelihood(statistics, size, share, mean, subset.ramp)
    present = subset.terms & (power > 0.0)
    relative = columns / mean
    information = (relative * (0.5 * share * size)) @ relative.T
    both = present[:, None] & present
    scale = 1.0 / jnp.sqrt(jnp.diag(information))
    scaled = jnp.where(both, information * scale[:, None] * scale, 0.0) + jnp.diag(
        jnp.where(present, 0.0, 1.0)
    )
    spread = jnp.diag(inverse(scaled + 1e-12 * jnp.eye(len(scale))))
    log_det = 2.0 * whiten(scaled + 1e-12 * jnp.eye(len(scale)), jnp.eye(len(scale))).log_det
    precision = jnp.diag(information) / jnp.where(present, spread, 1.0)
    squares, dof = without_ramp(statistics, size, mean, subset.ramp)
    score = columns @ (0.5 * share * (squares / mean - dof) / mean)
    each = jax.vmap(_marginal_factor)(
        precision, power, jnp.where(present, 0.0, jnp.minimum(score, 0.0)), prior_scale
    )
    correlation = -0.5 * (log_det + jnp.sum(jnp.where(present, jnp.log(spread), 0.0)))
    log_evidence = likelihood + jnp.sum(jnp.where(subset.terms, each, 0.0)) + correlation
    log_evidence += jnp.where(subset.ramp, _ramp_evidence(statistics, share, mean), 0.0)
    return Evidence(log_evidence, power)


@eqx.filter_jit
def _evidences(
    subsets: TermSubset,
    first: Float[Any, "subsets terms"],
    statistics: SpectralStatistics,
    fixed: Float[Any, "fixed m"],
    grid: Float[Any, "grid m"],
    size: Float[Any, " m"],
    share: Float[Any, " m"],
    steps: Any,
) -> Evidence:
    """Evidence of a block of subsets for one axis."""

    columns = jnp.concatenate([fixed, grid])
    window = jnp.ones(7)
    around = jnp.convolve(size, window, "same")
    smooth = jnp.convolve(statistics.squares, window, "same") / jnp.maximum(around, 1.0)
    smooth = jnp.where(around > 0.0, smooth, 1.0)
    information = jnp.sum(0.5 * share * size * (columns / smooth) ** 2, axis=1)
    prior_scales = information**-0.25
    of_subset = lambda subset, first: _evidence(  # noqa: E731
        subset, first, statistics, fixed, grid, size, share, smooth, prior_scales, steps
    )
    return jax.vmap(of_subset)(subsets, first)


def evidences(
    subsets: TermSubset,
    statistics: SpectralStatistics,
    fixed: Float[np.ndarray, "fixed m"],
    grid: Float[np.ndarray, "grid m"],
    size: Float[np.ndarray, " m"],
    share: Float[np.ndarray, "axes m"],
    first: Float[np.ndarray, "axes subsets terms"] | None = None,
    steps: int = STEPS,
) -> Evidence:
    """Evidence of every subset of terms for every axis, [axes, subsets].

    Args:
        subsets: their fields stacked [subsets].
        statistics: sums over the bins, stacked [axes].
        fixed: expectations [rate²] of the terms without a free shape, of unit amplitude.
        grid: expectations of the term with a free shape, for each shape of the grid.
        size: coefficients in each bin.
        share: weight of each bin, less than one where the model has an error of its own.
        first: powers to start from.
        steps: number of scoring steps.
    """
    count, blocks = len(subsets.ramp), []
    # Padding bins have no coefficients, so that few programs serve all lengths.
    more = -len(size) % _BINS
    fixed, grid = (np.pad(x, ((0, 0), (0, more)), constant_values=1.0) for x in (fixed, grid))
    size, share = np.pad(size, (0, more)), np.pad(share, ((0, 0), (0, more)))
    statistics = SpectralStatistics(*(np.pad(x, ((0, 0), (0, more))) for x in statistics))
    if first is None:
        first = np.zeros((len(share), *np.shape(subsets.terms)))
    for begin in range(0, count, BLOCK):
        # The last block is padded, so that all have one shape and are compiled once.
        rows = np.minimum(np.arange(begin, begin + BLOCK), count - 1)
        block = TermSubset(*(x[rows] for x in subsets))
        # One axis after another: the program is the same for any number of them.
        program = ("evidence", len(fixed), len(grid), block.column.shape, len(size))

        def of_axis(k: int, block: TermSubset = block, rows: Any = rows, program: Any = program) -> Evidence:
            own = SpectralStatistics(*(x[k] for x in statistics))
            with compiled_once(program):
                at = first[k][rows]
                return jax.device_get(
                    _evidences(block, at, own, fixed, grid, size, share[k], np.asarray(steps))
                )

        each = for_each(of_axis, range(len(share)))
        blocks.append(Evidence(*map(np.stack, zip(*each, strict=True))))
    return Evidence(*(np.concatenate(part, axis=1)[:, :count] for part in zip(*blocks, strict=True)))


class Row(NamedTuple):
    """Subset of the candidates for one axis, with a value for each free time.

    Attributes:
        members: which of the candidates' columns it has.
        power: their powers at the maximum of the likelihood.
        ramp: whether it has a ramp.
        log_evidence: logarithm of its evidence [nats].
    """

    members: Int[np.ndarray, " some"]
    power: Float[np.ndarray, " some"]
    ramp: bool
    log_evidence: float

    def key(self, cut: int) -> tuple[int, ...]:
        """Which of the first `cut` columns it has, those without a free shape."""
        return tuple(int(m) for m in self.members if m < cut)


@dataclasses.dataclass(frozen=True, eq=False)
class Candidates:
    """Candidate terms with their expectations in the bins of a spectrum.

    Attributes:
        model: the terms.
        bins: the bins.
        fixed, shaped, ramps: indices of the random terms without a free shape, of those with a free time (two
            of one kind at most), and of the ramp.
        units: a term of unit amplitude for each column: those without a free shape, then each free one at
            each of its times.
        owner: index of the term that each column is of.
        columns: its expected levels [rate²].
    """

    model: Model
    bins: Bins
    fixed: tuple[int, ...]
    shaped: tuple[int, ...]
    ramps: tuple[int, ...]
    units: tuple[NoiseTerm, ...]
    owner: Int[np.ndarray, " columns"]
    columns: Float[np.ndarray, "columns m"]

    @classmethod
    def of(cls, model: Model, bins: Bins) -> Candidates:
        """Candidates as sampled. Raises AllanjaxError as `sorted_terms` does."""
        fixed, shaped, ramps = sorted_terms(model)
        times = correlation_times(bins.n / bins.rate, bins.rate)
        units, owner = [model.terms[k] for k in fixed], list(fixed)
        for k in shaped:
            term = model.terms[k]
            name = next(p.name for p in term.parameters()[1:] if term.is_free(p))
            units += [term.replace(**{name: float(time)}) for time in times]
            owner += [k] * len(times)
        units = [term.with_unit_amplitude() for term in units]
        once = columns_of(units[: len(fixed) + len(times) * min(len(shaped), 1)], bins).mean(axis=1)
        # A second one is of the same kind.
        columns = np.concatenate([once, once[len(fixed) :]]) if len(shaped) > 1 else once
        return cls(model, bins, fixed, shaped, ramps, tuple(units), np.array(owner, int), columns)

    @property
    def size(self) -> Float[np.ndarray, " m"]:
        """Number of coefficients in each bin."""
        return self.bins.size.astype(float)

    @property
    def grid(self) -> Float[np.ndarray, "grid m"]:
        """Columns of the first term with a free time; arbitrary levels if there is none."""
        if not self.shaped:
            return np.ones((1, self.columns.shape[1]))
        count = (len(self.columns) - len(self.fixed)) // len(self.shaped)
        return self.columns[len(self.fixed) :][:count]

    def subsets(self) -> TermSubset:
        """All subsets with at most one free time, those without one first."""
        return term_subsets(len(self.fixed), len(self.grid) if self.shaped else 0, bool(self.ramps))

    def evidence(
        self, subsets: TermSubset, statistics: SpectralStatistics, share: Float[np.ndarray, "axes m"]
    ) -> Evidence:
        """Evidence [axes, subsets] of some subsets, and their powers."""
        fixed = self.columns[: len(self.fixed)]
        found = evidences(subsets, statistics, fixed, self.grid, self.size, share)
        return Evidence(*(np.array(x) for x in found))

    def rows(self, subsets: TermSubset, found: Evidence, axis: int) -> list[Row]:
        """The compared subsets for one axis."""
        cut, count = len(self.fixed), len(self.grid)
        rows = []
        for k in np.flatnonzero(found.log_evidence[axis] > -np.inf):
            places = np.flatnonzero(subsets.terms[k])
            shapes = np.append(np.arange(cut), cut + np.atleast_1d(subsets.column[k]))
            shapes[cut + 1 :] += count
            power = found.power[axis, k, places]
            rows.append(Row(shapes[places], power, bool(subsets.ramp[k]), float(found.log_evidence[axis, k])))
        return rows


def sorted_terms(model: Model) -> tuple[tuple[int, ...], tuple[int, ...], tuple[int, ...]]:
    """Indices of the random terms without a free shape, of those with a free time, and of the ramp.

    Raises:
        AllanjaxError: candidates that cannot be compared.
    """
    fixed: list[int] = []
    shaped: list[int] = []
    ramps: list[int] = []
    for k, term in enumerate(model.terms):
        free = [p for p in term.parameters()[1:] if term.is_free(p)]
        if not term.has_free_amplitude:
            raise AllanjaxError(
                f"{term.name()}: a term with a held amplitude cannot be ranked; leave it free"
            )
        if term.deterministic and len(term.parameters()) == 1:
            ramps.append(k)
        elif term.deterministic or term.narrow_band or len(free) > 1 or any(p.kind != "time" for p in free):
            raise AllanjaxError(
                f"{term.name()} cannot be compared by evidence; fit with and without it, and compare the fits"
            )
        else:
            (shaped if free else fixed).append(k)
    kinds = {type(model.terms[k]) for k in shaped}
    few = 1 <= len(fixed) + len(ramps) + len(kinds) <= 6
    if len(shaped) > 2 or len(kinds) > 1 or len(ramps) > 1 or not few:
        raise AllanjaxError(
            "select_terms takes at most six terms, with at most one ramp and one term with a free time (or "
            "two of one kind); hold the other times, e.g. Markov().hold(correlation_time=100.0)"
        )
    return tuple(fixed), tuple(shaped), tuple(ramps)

"""The evidence for sets of noise terms: Whittle's likelihood integrated over the amplitudes of each set.

An amplitude c has the prior 1/[(c + knee)·Y], uniform where the term could not be seen and uniform in ln c
above (the modified Jeffreys prior, Gregory 2005, ApJ 631:1198). The knee is the amplitude whose power
would be one standard deviation in these data; Y = ln(1 + 10⁴): four decades. So the price of a term
depends on how sharply the data determine it, not on units, and is two to five nats. (The knee of a ramp is
its standard deviation under each set's own noise.)

The integral is Laplace's over the powers, where the Fisher information is exact; the factor of each
amplitude along its own axis is a quadrature, which keeps it right next to and at the boundary
c = 0. A correlation time is integrated over a grid, uniform in its logarithm. The sign of a ramp is averaged.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from allanjax.base.linalg import inverse, whiten
from allanjax.spectrum.cosine import Levels

_DECADES = np.log1p(1e4)
#: Steps of scoring to the maximum. After the few of `ROUGH` sets that matter can be told from others, and
#: these are `FURTHER` ones from it (less than 10⁻⁵ nats).
STEPS, ROUGH, FURTHER = 20, 3, 6
_SWEEPS = 40
# Within 10⁻⁷ nats where a set matters; half of what weighing costs is these.
_QUADRATURE = 48
#: Sets looked at together: a fourth of those of six basic terms, half of those with every other shape.
BLOCK = 143


class Job(NamedTuple):
    """A set of terms: which of the fixed ones, which column of the grid if any, and whether a ramp."""

    terms: Any
    column: Any
    ramp: Any


class Evidence(NamedTuple):
    """Log-evidence [nats] of a set, and the powers of its terms."""

    log_evidence: Any
    power: Any


def taken_out(levels: Levels, size: ArrayLike, mean: ArrayLike, ramp: ArrayLike) -> tuple[Array, Array]:
    """Sums of squares and degrees of freedom without the ramp, if there is one."""
    u = jnp.sum(levels.gram / mean)
    beta = jnp.where(ramp, jnp.sum(levels.cross / mean) / u, 0.0)
    squares = levels.squares - 2.0 * beta * levels.cross + beta**2 * levels.gram
    return jnp.maximum(squares, 0.0), jnp.asarray(size) - jnp.where(ramp, levels.gram / (mean * u), 0.0)


def _log_likelihood(levels: Levels, size: Array, share: Array, mean: Array, ramp: Array) -> Array:
    """With the ramp integrated over all amplitudes, but for a constant of its unit."""
    base = -0.5 * jnp.sum(share * (size * jnp.log(mean) + levels.squares / mean))
    u, p = jnp.sum(share * levels.gram / mean), jnp.sum(share * levels.cross / mean)
    return base + jnp.where(ramp, 0.5 * p**2 / u - 0.5 * jnp.log(u), 0.0)


def _fisher(columns: Array, size: Array, share: Array, mean: Array) -> Array:
    scaled = columns / mean
    return (scaled * (0.5 * share * size)) @ scaled.T


def _positive(normal: Array, target: Array, allowed: Array, start: Array) -> Array:
    """x ≥ 0 that minimizes x'Ax/2 − x'b, one entry after the other (the next step goes on from here)."""

    def sweep(_: int, x: Array) -> Array:
        for k in range(len(target)):
            new = jnp.maximum(x[k] + (target[k] - normal[k] @ x) / normal[k, k], 0.0)
            x = x.at[k].set(jnp.where(allowed[k], new, 0.0))
        return x

    return jax.lax.fori_loop(0, _SWEEPS, sweep, start)


def _along(precision: Array, power: Array, score: Array, knee: Array) -> Array:
    """ln ∫ prior(c) exp[score·c² − ½ precision (c² − power)²] dc."""
    # Uniform in y = ln(1 + c/knee), as the prior is, from zero to where the integrand has ended.
    width = 1.0 / jnp.sqrt(precision)
    top = jnp.log1p(jnp.sqrt(power + 8.0 * width) / knee)
    # Where the power is known well, only its surroundings.
    bottom = jnp.log1p(jnp.sqrt(jnp.maximum(power - 8.0 * width, 0.0)) / knee)
    y = bottom + (top - bottom) * (jnp.arange(_QUADRATURE) + 0.5) / _QUADRATURE
    v = (knee * jnp.expm1(y)) ** 2
    exponent = score * v - 0.5 * precision * (v - power) ** 2
    return jax.nn.logsumexp(exponent) + jnp.log((top - bottom) / _QUADRATURE / _DECADES)


def _ramp_evidence(levels: Levels, share: Array, mean: Array) -> Array:
    """ln ∫ prior(R) cosh(Rp) exp(−½R²u) dR, less what `_log_likelihood` has of it."""
    u, p = jnp.sum(share * levels.gram / mean), jnp.sum(share * levels.cross / mean)
    knee = 1.0 / jnp.sqrt(u)
    centre = jnp.abs(p) / u
    top = jnp.log1p((centre + 8.0 * knee) / knee)
    bottom = jnp.log1p(jnp.maximum(centre - 8.0 * knee, 0.0) / knee)
    y = bottom + (top - bottom) * (jnp.arange(_QUADRATURE) + 0.5) / _QUADRATURE
    R = knee * jnp.expm1(y)
    log_cosh = jnp.abs(R * p) + jnp.log1p(jnp.exp(-2.0 * jnp.abs(R * p))) - jnp.log(2.0)
    integral = jax.nn.logsumexp(log_cosh - 0.5 * R**2 * u) + jnp.log((top - bottom) / _QUADRATURE / _DECADES)
    return integral - (0.5 * p**2 / u - 0.5 * jnp.log(u))


def _evidence(
    job: Job,
    first: Array,
    levels: Levels,
    fixed: Array,
    grid: Array,
    size: Array,
    share: Array,
    smooth: Array,
    knees: Array,
    steps: Array,
) -> Evidence:
    columns = jnp.concatenate([fixed, grid[job.column][None]])
    start = jnp.where(jnp.any(first > 0.0), jnp.maximum(first @ columns, 1e-300), smooth)
    knee = knees[jnp.append(jnp.arange(len(fixed)), len(fixed) + job.column)]

    def step(_: int, state: tuple[Array, Array]) -> tuple[Array, Array]:
        power, mean = state
        squares, dof = taken_out(levels, size, mean, job.ramp)
        level = jnp.where(dof > 1e-3, squares / jnp.maximum(dof, 1e-3), mean)
        weight = share * dof / 2.0 / mean**2
        new = _positive(columns * weight @ columns.T, columns @ (weight * level), job.terms, power)
        # Fisher's scoring overshoots now and then; half the step is for that.
        tried = jnp.stack([new, 0.5 * (power + new)])
        means = jnp.maximum(tried @ columns, 1e-300)
        values = jax.vmap(lambda mean: _log_likelihood(levels, size, share, mean, job.ramp))(means)
        best = jnp.argmax(values)
        return tried[best], means[best]

    power, mean = jax.lax.fori_loop(0, steps, step, (first, start))
    likelihood = _log_likelihood(levels, size, share, mean, job.ramp)
    present = job.terms & (power > 0.0)
    information = _fisher(columns, size, share, mean)
    both = present[:, None] & present
    scale = 1.0 / jnp.sqrt(jnp.diag(information))
    scaled = jnp.where(both, information * scale[:, None] * scale, 0.0) + jnp.diag(
        jnp.where(present, 0.0, 1.0)
    )
    spread = jnp.diag(inverse(scaled + 1e-12 * jnp.eye(len(scale))))
    log_det = 2.0 * whiten(scaled + 1e-12 * jnp.eye(len(scale)), jnp.eye(len(scale))).log_det
    precision = jnp.diag(information) / jnp.where(present, spread, 1.0)
    squares, dof = taken_out(levels, size, mean, job.ramp)
    score = columns @ (0.5 * share * (squares / mean - dof) / mean)
    each = jax.vmap(_along)(precision, power, jnp.where(present, 0.0, jnp.minimum(score, 0.0)), knee)
    correlation = -0.5 * (log_det + jnp.sum(jnp.where(present, jnp.log(spread), 0.0)))
    log_evidence = likelihood + jnp.sum(jnp.where(job.terms, each, 0.0)) + correlation
    log_evidence += jnp.where(job.ramp, _ramp_evidence(levels, share, mean), 0.0)
    return Evidence(log_evidence, power)


@eqx.filter_jit
def _evidences(
    jobs: Job,
    first: Float[Any, "axes jobs terms"],
    levels: Levels,
    fixed: Float[Any, "fixed m"],
    grid: Float[Any, "grid m"],
    size: Float[Any, " m"],
    share: Float[Any, "axes m"],
    steps: Any,
) -> Evidence:
    def of_axis(first: Array, levels: Levels, share: Array) -> Evidence:
        columns = jnp.concatenate([fixed, grid])
        window = jnp.ones(7)
        smooth = jnp.convolve(levels.squares, window, "same") / jnp.convolve(size, window, "same")
        information = jnp.sum(0.5 * share * size * (columns / smooth) ** 2, axis=1)
        knees = information**-0.25
        of_job = lambda job, first: _evidence(  # noqa: E731
            job, first, levels, fixed, grid, size, share, smooth, knees, steps
        )
        return jax.vmap(of_job)(jobs, first)

    return jax.lax.map(lambda of: of_axis(*of), (first, levels, share))


def evidences(
    jobs: Job,
    levels: Levels,
    fixed: Float[np.ndarray, "fixed m"],
    grid: Float[np.ndarray, "grid m"],
    size: Float[np.ndarray, " m"],
    share: Float[np.ndarray, "axes m"],
    first: Float[np.ndarray, "axes jobs terms"] | None = None,
    steps: int = STEPS,
) -> Evidence:
    """The evidence of every set of terms for every axis, [axes, jobs].

    Args:
        jobs: the sets, their fields stacked [jobs].
        levels: statistics, stacked [axes].
        fixed: expectations of the terms without a free shape, unit amplitude.
        grid: those of the term with one, at each of its values.
        size: coefficients in each bin.
        share: what a bin counts, less than one where the model has an error of its own.
        first: powers to start from.
        steps: of scoring.
    """
    count, blocks = len(jobs.ramp), []
    if first is None:
        first = np.zeros((len(share), count, len(fixed) + 1))
    for begin in range(0, count, BLOCK):
        # The last block is filled up: one shape, one compilation.
        rows = np.minimum(np.arange(begin, begin + BLOCK), count - 1)
        block = Job(*(x[rows] for x in jobs))
        found = _evidences(block, first[:, rows], levels, fixed, grid, size, share, np.asarray(steps))
        blocks.append(jax.device_get(found))
    return Evidence(*(np.concatenate(part, axis=1)[:, :count] for part in zip(*blocks, strict=True)))

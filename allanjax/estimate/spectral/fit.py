"""Fit of a model to levels of a cosine spectrum, by the maximum of the joint spectral model's likelihood.

Where a model cannot follow the levels within their scatter (χ² beyond all doubt, p < 1e-6), all of them are
given a relative error, common to about an octave, with which χ² equals its degrees of freedom.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import gammaln
from jaxtyping import Array, ArrayLike, Bool, Float

from allanjax.base.chi_squared import beyond_doubt, exact_cube_root_score, normal_score
from allanjax.estimate.gls import Solution
from allanjax.estimate.inference import Inference, infer, without_padding
from allanjax.estimate.spectral.design import SpectralDesign
from allanjax.estimate.spectral.level_design import LevelDesign, TangentDesign
from allanjax.estimate.spectral.model import expected, power_scales
from allanjax.estimate.spectral.scoring import maximize

# Number of times that the error of a model is estimated anew, and when it has settled.
_ROUNDS, _SETTLED = 8, 0.02
# Levels with fewer degrees of freedom say nothing about how well a model fits.
_FEW = 0.05
# Difference of minus twice the log-likelihood below which two solutions are the same.
_AS_LIKELY = 0.02


def solve_levels(
    design: SpectralDesign,
    free: Bool[np.ndarray, " terms"],
    active: Bool[np.ndarray, " terms"],
    power: Float[ArrayLike, " terms"],
    shape: Float[ArrayLike, " shapes"],
    noise: Float[np.ndarray, " m"],
) -> Solution:
    """Maximum of the likelihood of one axis from a start.

    Args:
        design: the model, with data.
        free: terms whose power is estimated.
        active: terms in use.
        power, shape: start values.
        noise: rough levels of the noise [rate²].
    """
    terms, shapes = len(free), np.size(shape)
    of_terms = design.padded_terms(free), design.padded_terms(active)

    def fitted(error: float, power: ArrayLike, shape: ArrayLike) -> tuple[Solution, np.ndarray]:
        return jax.device_get(_maximum(design, *of_terms, power, shape, noise, np.asarray(error)))

    noise = design.padded_estimates(noise[None])[0]
    start = design.padded_terms(np.asarray(power)), design.padded_shapes(np.asarray(shape))
    found, mean = fitted(0.0, *start)
    parameters = np.sum(free & active) + np.sum(active[design.owner[design.moves]])
    dof = 2.0 * np.asarray(design.levels.shape)
    degrees = max(float(np.sum(np.minimum(dof, 1.0))) - parameters, 1.0)
    if np.isfinite(found.cost) and not (found.converged and found.chi2 < beyond_doubt(degrees)):
        error = 0.0
        for _ in range(_ROUNDS):
            wanted = error_of_powers(design.levels.level / mean, dof, design.per_octave, degrees)
            if abs(wanted - error) <= _SETTLED * wanted:
                break
            error = wanted
            found, mean = fitted(error, found.power, found.shape)
    return found._replace(power=found.power[:terms], shape=found.shape[:shapes])


def chi_squared(ratio: Float[ArrayLike, " m"], dof: Float[ArrayLike, " m"], share: ArrayLike = 1.0) -> float:
    """χ² of levels, given their ratios to their expectations, each with a share of its weight."""
    square = normal_score(ratio, dof) ** 2
    return float(np.sum((square * share)[np.asarray(dof) > _FEW]))


def share_with_error(dof: Any, per_octave: Any, error: Any) -> Any:
    """Share of the weight that levels keep where their model has a relative error, common to an octave.

    The relative variance 2/dof of each becomes 2/dof + per_octave·error². For arrays of NumPy or JAX.
    """
    return 1.0 / (1.0 + 0.5 * dof * per_octave * error**2)


def error_of_powers(
    ratio: Float[ArrayLike, " m"],
    dof: Float[ArrayLike, " m"],
    per_octave: Float[np.ndarray, " m"],
    degrees: float,
) -> float:
    """Relative error of a model's levels with which χ² equals its degrees of freedom; 0 if it is below.

    Args:
        ratio: levels over their expectations.
        dof: degrees of freedom of the levels.
        per_octave: number of levels in an octave, to which the error is common.
        degrees: degrees of freedom of χ².
    """
    from scipy.optimize import brentq

    def excess(error: float) -> float:
        return chi_squared(ratio, dof, share_with_error(np.asarray(dof), per_octave, error)) - degrees

    return float(brentq(excess, 0.0, 1e3)) if excess(0.0) > 0.0 else 0.0


@eqx.filter_jit
def _maximum(
    design: SpectralDesign,
    free: Bool[ArrayLike, " terms"],
    active: Bool[ArrayLike, " terms"],
    power: Float[ArrayLike, " terms"],
    shape: Float[ArrayLike, " shapes"],
    noise: Float[ArrayLike, " m"],
    error: Float[ArrayLike, ""],
) -> tuple[Solution, Float[Array, " m"]]:
    """Maximum of the likelihood with this relative error of the model, and the expected levels there."""
    levels, slots = design.levels, design.slots
    at, component = slots.layout, jnp.asarray(design.component)
    dof = 2.0 * jnp.asarray(levels.shape)
    active, free, error = jnp.asarray(active), jnp.asarray(free), jnp.asarray(error)
    less = levels._replace(shape=levels.shape * share_with_error(dof, design.per_octave, error))
    start = design.parameters(jnp.asarray(shape))
    used = jnp.where(active, power, 0.0) * design.unit_power(start)
    scale = power_scales(start, slots, levels, jnp.asarray(noise))
    by_slot = jnp.zeros(at.components).at[component].add(used)
    start = start.at[: at.components].set(jnp.log1p(by_slot / scale))
    there = jnp.arange(len(component)) < design.terms
    moves = jnp.asarray(design.moves) & active[jnp.asarray(design.owner)]
    estimated = jnp.asarray(slots.free)
    estimated = estimated.at[jnp.where(there, component, at.parameters)].set(free & active, mode="drop")
    estimated = estimated.at[design.parameter].set(moves, mode="drop")
    centre = jnp.asarray(shape) + design.offset
    top = jnp.minimum(centre + design.reach, design.top + design.offset)
    slots = dataclasses.replace(
        slots,
        scale=scale,
        free=estimated,
        lower=jnp.asarray(slots.lower).at[design.parameter].max(centre - design.reach, mode="drop"),
        upper=jnp.asarray(slots.upper).at[design.parameter].set(top, mode="drop"),
    )
    found = maximize(start, slots, less)
    theta = found.theta
    mean = expected(theta, slots, levels).mean
    amplitude = (scale * jnp.expm1(theta[: at.components]))[component] / design.unit_power(theta)
    score = exact_cube_root_score(levels.level / mean, dof)
    solution = Solution(
        power=jnp.where(there & active, amplitude, 0.0),
        shape=theta.at[design.parameter].get(mode="fill", fill_value=0.0) - design.offset,
        chi2=jnp.sum(jnp.where(dof > _FEW, score**2, 0.0)),
        power_error=jnp.asarray(error),
        converged=found.converged & jnp.isfinite(found.loss),
        cost=-2.0 * jnp.sum(_log_densities(levels.level, mean, less.shape)),
    )
    return solution, mean


def _log_densities(
    level: Float[Array, " m"], mean: Float[Array, " m"], shape: Float[Array, " m"]
) -> Float[Array, " m"]:
    """Logarithm of each level's density, a Gamma law of this mean and shape; 0 of levels that only pad.

    With its normalization, so that solutions with different errors of the model compare.
    """
    known, k = shape > 0.0, jnp.where(shape > 0.0, shape, 1.0)
    level = jnp.where(known, jnp.maximum(level, 1e-300), 1.0)
    ratio = level / jnp.where(known, mean, 1.0)
    return jnp.where(known, k * (jnp.log(k * ratio) - ratio) - gammaln(k) - jnp.log(level), 0.0)


def best_of(solutions: Sequence[Solution]) -> Solution:
    """Most likely one of some solutions, if it converged or none that is as likely did."""
    cost = [float(np.nan_to_num(s.cost, nan=np.inf)) for s in solutions]
    close = [s for s, c in zip(solutions, cost, strict=True) if c <= min(cost) + _AS_LIKELY]
    return next((s for s in close if s.converged), close[0])


def levels_under(design: SpectralDesign, solution: Solution) -> Float[np.ndarray, " m"]:
    """Expected levels [rate²] of one axis under a solution."""
    padded = _padded(design, solution)
    return np.asarray(_levels_under(design, padded.power, padded.shape))[: int(design.rows)]


@eqx.filter_jit
def _levels_under(
    design: SpectralDesign, power: Float[ArrayLike, " terms"], shape: Float[ArrayLike, " shapes"]
) -> Float[Array, " m"]:
    return design.mean(jnp.asarray(power), design.means(jnp.asarray(shape)))


def tangent_of(design: SpectralDesign, shape: Float[np.ndarray, " shapes"]) -> TangentDesign:
    """Design that is linear in the shapes around these, which is all that an inference needs."""
    centre = design.padded_shapes(np.asarray(shape))
    base, by_shape = _tangent(design, centre)
    return TangentDesign(
        owner=design.owner,
        terms=design.terms,
        rows=design.rows,
        moves=design.moves,
        per_octave=design.per_octave,
        base=base,
        by_shape=by_shape,
        centre=centre,
        degrees_of_freedom=design.degrees,
    )


@eqx.filter_jit
def _tangent(
    design: SpectralDesign, shape: Float[ArrayLike, " shapes"]
) -> tuple[Float[Array, "terms m"], Float[Array, "terms m shapes"]]:
    at = jnp.asarray(shape)
    return design.means(at), jax.jacfwd(design.means)(at)


def infer_levels(
    design: LevelDesign,
    level: Float[np.ndarray, " m"],
    free: Bool[np.ndarray, " terms"],
    active: Bool[np.ndarray, " terms"],
    solution: Solution,
) -> Inference:
    """Inference of one axis around its solution, [1, …]; see `infer`."""
    padded = _padded(design, solution)
    V = design.padded_estimates(level[None])
    of_terms = design.padded_terms(free), design.padded_terms(active[None])
    found = jax.device_get(infer(design, V, *of_terms, padded))
    return without_padding(found, len(level), len(free), np.shape(solution.shape)[-1])


def _padded(design: LevelDesign, solution: Solution) -> Solution:
    """Solution in arrays of the design's length."""
    padded: dict[str, Any] = {
        "power": design.padded_terms(np.asarray(solution.power)),
        "shape": design.padded_shapes(np.asarray(solution.shape)),
    }
    return solution._replace(**padded)

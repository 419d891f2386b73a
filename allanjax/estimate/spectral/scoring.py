"""Maximum of the likelihood of the joint spectral model, by damped Gauss–Newton steps within bounds.

The deviance residuals of the levels, r = sign(x − 1)·√(2k(x − 1 − ln x)) with x = level/mean, make the
log-likelihood a sum of squares, whose Gauss–Newton matrix is nearly Fisher's information. Parameters are
known with very different precision, a resonance's frequency to 10⁻⁴ and a long correlation time to a factor;
so the damping is proportional to the diagonal of that matrix (Marquardt 1963), not to the identity.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from allanjax.base.linalg import inverse, solve
from allanjax.estimate.spectral.levels import Levels
from allanjax.estimate.spectral.model import Slots, expected, loss

# Damping of the first step, relative to the information, and the longest step of a parameter.
_DAMPING = 0.01
_LONGEST = 2.0
# Share of the gain that the matrix promises from which on a step is taken, and from which on it is good; by
# which factors steps get longer after a good one and shorter after one that is not taken.
_WORTH, _GOOD = 0.01, 0.5
_LONGER, _SHORTER = 6.0, 0.15
# Tolerance of a fit.
_TOLERANCE = 1e-5
# Most steps of a fit.
_STEPS = 400
# Smallest ratio of a level to its expectation that counts, and excess over 1 below which a series is used.
_LEAST_RATIO = 1e-12
_NEAR = 1e-4


class Maximum(NamedTuple):
    """Maximum of the likelihood.

    Attributes:
        theta: the parameters there.
        loss: minus the log-likelihood, see `model.loss`, prior included.
        information: Fisher's information of the parameters that are estimated and not at a bound, prior
            included; the others have a unit on the diagonal.
        interior: which parameters these are.
        steps: number of steps taken.
        converged: whether the iteration ended by itself.
    """

    theta: Float[Array, " parameters"]
    loss: Float[Array, ""]
    information: Float[Array, "parameters parameters"]
    interior: Bool[Array, " parameters"]
    steps: Int[Array, ""]
    converged: Bool[Array, ""]


class _Problem(NamedTuple):
    """What the residuals depend on besides the parameters."""

    slots: Slots
    levels: Levels
    tolerance: Any


@eqx.filter_jit
def maximize(
    theta: Float[Array, " parameters"], slots: Slots, levels: Levels, tolerance: ArrayLike = _TOLERANCE
) -> Maximum:
    """Maximum of the likelihood from a start, compiled once for all records and models.

    The iteration ends where neither a parameter nor a residual moves by more than the tolerance.
    Differentiable in the levels, their columns and the prior, by the implicit function theorem.
    """
    problem = _Problem(slots, levels, jnp.asarray(tolerance))
    found, steps, converged = _peak(problem, jnp.clip(theta, slots.lower, slots.upper))
    interior = _interior(found, slots, levels)
    model = expected(found, slots, levels)
    slope = jnp.where(interior[:, None], model.slope, 0.0)
    information = (slope * levels.shape) @ slope.T + jnp.diag(jnp.where(interior, slots.precision, 1.0))
    prior = 0.5 * jnp.sum(jnp.where(slots.free, slots.precision * (found - slots.centre) ** 2, 0.0))
    return Maximum(found, loss(model.mean, levels) + prior, information, interior, steps, converged)


def covariance(maximum: Maximum) -> Float[Array, "parameters parameters"]:
    """Covariance of the estimates; zero for parameters that are held or at a bound."""
    scale = 1.0 / jnp.sqrt(jnp.diag(maximum.information))
    both = maximum.interior[:, None] & maximum.interior
    spread = inverse(maximum.information * scale[:, None] * scale) * scale[:, None] * scale
    return jnp.where(both, spread, 0.0)


class _Place(NamedTuple):
    """A point of the iteration: parameters, residuals, half the sum of their squares, its derivatives.

    The second derivatives are those of the Gauss–Newton matrix.
    """

    theta: Array
    residuals: Array
    value: Array
    gradient: Array
    matrix: Array


class _Iteration(NamedTuple):
    """State of the iteration: the best place, where the next step leads, and how far steps go.

    The damping is inverse to the length of the steps.
    """

    best: _Place
    trial: Array
    length: Array
    steps: Array
    converged: Array


@eqx.filter_custom_jvp
def _peak(problem: _Problem, start: Array) -> tuple[Array, Array, Array]:
    """Parameters at the maximum, number of steps, and whether the iteration converged."""

    def goes_on(at: _Iteration) -> Array:
        return ~at.converged & (at.steps < _STEPS)

    def step(at: _Iteration) -> _Iteration:
        best = at.best
        residuals, slope, stiffness = _residuals(at.trial, problem)
        value, move = 0.5 * jnp.sum(residuals**2), at.trial - best.theta
        gained, promised = value - best.value, move @ best.gradient + 0.5 * move @ best.matrix @ move
        first = at.steps == 0
        accepted = first | (gained <= _WORTH * promised)
        good = ~first & (gained < _GOOD * promised) & (promised < 0.0)
        length = at.length * jnp.where(accepted, jnp.where(good, _LONGER, 1.0), _SHORTER)

        def moved() -> _Place:
            data, away = jnp.split(residuals, [slope.shape[1]])
            matrix = slope @ slope.T + jnp.diag(stiffness**2)
            return _Place(at.trial, residuals, value, slope @ data + stiffness * away, matrix)

        place = jax.lax.cond(accepted, moved, lambda: best)
        still = jnp.maximum(jnp.max(jnp.abs(move)), jnp.max(jnp.abs(residuals - best.residuals)))
        converged = accepted & (still < problem.tolerance)
        trial = place.theta + _move(place, length, problem.slots)
        return _Iteration(place, trial, length, at.steps + 1, converged)

    nowhere = jnp.zeros(len(start) + len(problem.levels.shape))
    nothing = _Place(start, nowhere, jnp.zeros(()), 0.0 * start, jnp.zeros((len(start), len(start))))
    at = _Iteration(nothing, start, jnp.ones(()), jnp.asarray(0), jnp.asarray(False))
    at = jax.lax.while_loop(goes_on, step, at)
    return at.best.theta, at.steps, at.converged


def _move(place: _Place, length: Array, slots: Slots) -> Array:
    """Levenberg–Marquardt step with damping proportional to the diagonal of the matrix, within bounds."""
    theta, matrix = place.theta, place.matrix
    movable = _movable(theta, place.gradient, slots.lower, slots.upper)
    scale = 1.0 / jnp.sqrt(jnp.maximum(jnp.diag(matrix), 1e-12))
    scaled = jnp.where(movable[:, None] & movable, matrix * scale[:, None] * scale, 0.0)
    damped = scaled + jnp.diag(jnp.where(movable, _DAMPING / length + 1e-12, 1.0))
    move = -scale * solve(damped, jnp.where(movable, place.gradient * scale, 0.0))
    return jnp.clip(theta + jnp.clip(move, -_LONGEST, _LONGEST), slots.lower, slots.upper) - theta


@_peak.def_jvp
def _peak_jvp(primals: Any, tangents: Any) -> tuple[Any, Any]:
    """The maximum moves by −H⁻¹ times the change of the gradient; H is the second derivative of the loss."""
    problem, start = primals
    theta, steps, converged = _peak(problem, start)
    interior = _interior(theta, problem.slots, problem.levels)
    differentiable, fixed = eqx.partition(
        problem, jax.tree.map(lambda t: t is not None, tangents[0], is_leaf=_none)
    )
    moved = jax.tree.leaves(tangents[0])
    leaves, structure = jax.tree.flatten(differentiable)

    def gradient_of(leaves: list[Array]) -> Array:
        of: _Problem = eqx.combine(jax.tree.unflatten(structure, leaves), fixed)
        return _gradient(theta, of.slots, of.levels)

    _, change = jax.jvp(gradient_of, (leaves,), (moved,))
    hessian = jax.jacfwd(lambda theta: _gradient(theta, problem.slots, problem.levels))(theta)
    both = interior[:, None] & interior
    system = jnp.where(both, hessian, 0.0) + jnp.diag(jnp.where(interior, 0.0, 1.0))
    return (theta, steps, converged), (-solve(system, jnp.where(interior, change, 0.0)), None, None)


def _none(x: Any) -> bool:
    return x is None


def _gradient(theta: Array, slots: Slots, levels: Levels) -> Float[Array, " parameters"]:
    """Gradient of the loss, prior included."""
    model = expected(theta, slots, levels)
    prior = slots.precision * (theta - slots.centre)
    return model.slope @ (levels.shape * (1.0 - levels.level / model.mean)) + prior


def _interior(theta: Array, slots: Slots, levels: Levels) -> Bool[Array, " parameters"]:
    """Parameters that are estimated and not kept at a bound by the data."""
    return slots.free & _movable(theta, _gradient(theta, slots, levels), slots.lower, slots.upper)


def _movable(theta: Array, gradient: Array, lower: Array, upper: Array) -> Bool[Array, " parameters"]:
    """Parameters that are not at a bound beyond which the likelihood would still rise."""
    return ~((theta <= lower) & (gradient > 0.0)) & ~((theta >= upper) & (gradient < 0.0))


def _residuals(theta: Array, problem: _Problem) -> tuple[Array, Array, Array]:
    """Deviance residuals of the levels, then those of the prior, and derivatives by the parameters.

    Those of the levels' residuals are a matrix (parameters, levels), each of the prior's has its own.
    """
    slots, levels, _ = problem
    model = expected(theta, slots, levels)
    excess = jnp.maximum(levels.level / model.mean, _LEAST_RATIO) - 1.0
    near = jnp.abs(excess) < _NEAR
    apart = jnp.where(near, 1.0, excess)
    root = jnp.where(near, jnp.abs(excess) * (1.0 - excess / 3.0), jnp.sqrt(2.0 * (apart - jnp.log1p(apart))))
    weight = jnp.where(near, 1.0 + excess / 3.0, jnp.abs(apart) / root)
    k = jnp.sqrt(levels.shape)
    by_data = jnp.where(slots.free[:, None], -(k * weight) * model.slope, 0.0)
    # A parameter that is not estimated is kept where it is by a prior of its own.
    stiffness = jnp.where(slots.free, jnp.sqrt(slots.precision), 1.0)
    away = jnp.where(slots.free, theta - slots.centre, 0.0)
    return jnp.concatenate([k * jnp.sign(excess) * root, stiffness * away]), by_data, stiffness

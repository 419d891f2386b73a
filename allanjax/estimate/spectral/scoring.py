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
import optimistix as optx
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from allanjax.base.linalg import inverse, solve
from allanjax.estimate.spectral.levels import Levels
from allanjax.estimate.spectral.model import Slots, expected, loss

# Damping of the first step, relative to the information, and the longest step of a parameter.
_DAMPING = 0.01
_LONGEST = 2.0
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


@eqx.filter_custom_jvp
def _peak(problem: _Problem, start: Array) -> tuple[Array, Array, Array]:
    """Parameters at the maximum, number of steps, and whether the iteration converged."""
    found: optx.Solution = optx.least_squares(
        _residuals,
        _Scoring(problem.slots.lower, problem.slots.upper, problem.tolerance),
        start,
        args=problem,
        max_steps=_STEPS,
        throw=False,
    )
    converged = jnp.asarray(found.result == optx.RESULTS.successful)
    return found.value, found.stats["num_steps"], converged


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


@jax.custom_jvp
def _residuals(theta: Float[Array, " parameters"], problem: _Problem) -> Float[Array, " rows"]:
    """Deviance residuals of the levels, and those of the prior."""
    return _residuals_and_slope(theta, problem)[0]


@_residuals.defjvp
def _residuals_jvp(primals: Any, tangents: Any) -> tuple[Array, Array]:
    # One matrix serves the tangents of all parameters.
    residuals, slope = _residuals_and_slope(*primals)
    return residuals, tangents[0] @ slope


def _residuals_and_slope(theta: Array, problem: _Problem) -> tuple[Array, Array]:
    """Residuals, and their derivatives by the parameters (parameters, rows)."""
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
    return (
        jnp.concatenate([k * jnp.sign(excess) * root, stiffness * away]),
        jnp.concatenate([by_data, jnp.diag(stiffness)], axis=1),
    )


class _Place(NamedTuple):
    """A point of the descent: its parameters, the gradient, and the Gauss–Newton matrix."""

    theta: Any
    gradient: Any
    matrix: Any


class _ScaledDescent(optx.AbstractDescent):
    """Levenberg–Marquardt steps with damping λ·diag(JᵀJ), within bounds."""

    lower: Float[Array, " parameters"]
    upper: Float[Array, " parameters"]

    def init(self, y: Any, f_info_struct: Any) -> _Place:
        return _Place(y, jnp.zeros_like(y), jnp.zeros((len(y), len(y))))

    def query(self, y: Any, f_info: Any, state: _Place) -> _Place:
        J = f_info.jac.as_matrix()
        return _Place(y, J.T @ f_info.residual, J.T @ J)

    def step(self, step_size: Any, state: _Place) -> tuple[Any, Any]:
        theta, gradient, matrix = state
        movable = _movable(theta, gradient, self.lower, self.upper)
        scale = 1.0 / jnp.sqrt(jnp.maximum(jnp.diag(matrix), 1e-12))
        scaled = jnp.where(movable[:, None] & movable, matrix * scale[:, None] * scale, 0.0)
        damped = scaled + jnp.diag(jnp.where(movable, _DAMPING / step_size + 1e-12, 1.0))
        move = -scale * solve(damped, jnp.where(movable, gradient * scale, 0.0))
        moved = jnp.clip(theta + jnp.clip(move, -_LONGEST, _LONGEST), self.lower, self.upper)
        return moved - theta, optx.RESULTS.successful


class _Scoring(optx.AbstractGaussNewton):
    """Gauss–Newton iteration with scaled damping."""

    rtol: float
    atol: Any
    norm: Any
    descent: _ScaledDescent
    search: optx.ClassicalTrustRegion
    verbose: Any

    def __init__(self, lower: Array, upper: Array, tolerance: Array):
        self.rtol, self.atol, self.norm = 0.0, tolerance, optx.max_norm
        self.descent = _ScaledDescent(lower, upper)
        self.search = optx.ClassicalTrustRegion(0.5, 0.01, 6.0, 0.15)
        self.verbose = lambda **_: None

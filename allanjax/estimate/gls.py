"""Iterated generalized least squares on estimates of power, compiled and vectorised over axes.

The estimating equation is D'C⁻¹(V − μ) = 0 with mean μ, its derivatives D and the covariance C of the
estimates V all at the current model: unbiased whatever the shape of V's law, and nearly as good as the whole
record's likelihood. Inside, each variance is written in units of its model mean.

Where a model cannot follow the curve within the scatter (χ² beyond all doubt, p < 1e-6), the covariance
gains a relative error s of the model's powers, correlated over about an octave, such that χ²
equals its degrees of freedom. Intervals then say how well the coefficients are known *given that the model is
incomplete*, instead of being absurdly narrow.
"""

from __future__ import annotations

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import optimistix as optx
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from allanjax.base.chi_squared import beyond_doubt
from allanjax.base.linalg import non_negative_least_squares
from allanjax.estimate.design import Design

# Bound of a shape's distance from its start, in ln: the spectrum locates a line better than the Allan curve
# does; the starts of other shapes are two to a decade or denser.
_SHAPE_BOUND = {"line": 0.1, "time": 4.0, "frequency": 4.0, "number": 3.0}
# Margin kept from a shape's upper bound, which is open, in ln.
_INSIDE = 1e-2
# Largest number of reweightings, and of steps of the shapes within each.
_OUTER_STEPS = 100
_INNER_STEPS = 50
# Largest factor by which the acceleration extrapolates the last move.
_MAX_EXTRAPOLATION = 5.0
# Number of full steps; from then on shapes move by at most _LATE in ln, times _SHORTER after each step.
_DAMPING_AFTER_STEP = 25
_LATE, _SHORTER = 0.5, 0.92
# A step that moves the fitted curve by less than this, in standard deviations, ends the iteration.
_TOLERANCE = 1e-3
# The same after the last step: where a direction is poorly determined, as that of a long correlation time,
# steps stay longer, and so much of a standard deviation is good enough.
_CLOSE = 0.05
# Phases of the iteration: first with large errors of the model, nearly a log-log fit, which converges from
# anywhere; then without; then, if χ² is too large, with the error that makes it equal its degrees of freedom.
_WARM_UP, _PLAIN, _WITH_ERROR, _DONE = range(4)
_FIRST_ERROR = 0.1
_WARM_UP_ERROR = np.array([0.5, 0.2, 0.05, 0.0])


class Solution(NamedTuple):
    """Estimate of one axis.

    Attributes:
        power: powers (squared amplitudes) of the terms.
        shape: transformed shapes, ln(value − lower bound).
        chi2: χ² without an error of the model.
        power_error: relative error of the model's powers that the misfit calls for; 0 if the model
            suffices.
        converged: whether the iteration converged.
        cost: minus twice the log-likelihood, to choose among solutions.
    """

    power: Float[Array, " terms"]
    shape: Float[Array, " shapes"]
    chi2: Float[Array, ""]
    power_error: Float[Array, ""]
    converged: Bool[Array, ""]
    cost: Float[Array, ""]

    @property
    def discrepancy(self) -> Float[Array, "*axes"]:
        """Relative error of the model's deviations, which is half of that of its powers."""
        return self.power_error / 2.0


class _State(NamedTuple):
    """State of the iteration: the current estimate, the last one, and the phase."""

    power: Float[Array, " terms"]
    shape: Float[Array, " shapes"]
    mean: Float[Array, " m"]
    covariance: Array
    robust: tuple[Array, Array, Array, Array]
    last: tuple[Array, Array]
    last_step: tuple[Array, Array]
    power_error: Float[Array, ""]
    phase: Int[Array, ""]
    step: Int[Array, ""]
    chi2: Float[Array, ""]
    cost: Float[Array, ""]
    at_rest: Bool[Array, ""]


def _solve(
    design: Design,
    V: Float[Array, " m"],
    free: Bool[Array, " terms"],
    active: Bool[Array, " terms"],
    power: Float[Array, " terms"],
    shape: Float[Array, " shapes"],
) -> Solution:
    """Estimate of one axis from one start; inactive terms have zero power, held ones keep theirs."""
    owner = jnp.asarray([p.term for p in design.shapes], int)
    power = jnp.where(active, power, 0.0)
    start = shape
    reach = jnp.asarray([_SHAPE_BOUND[p.parameter.kind] for p in design.shapes])
    end = jnp.asarray([np.log(p.parameter.upper - p.parameter.lower) for p in design.shapes]) - _INSIDE
    moves = active[owner] & design.movable
    dof = jnp.maximum(design.count - jnp.sum(active & free) - jnp.sum(moves), 1.0)
    # The tail is heavier than that of χ² where few clusters remain.
    limit = beyond_doubt(dof)

    def within(u: Array) -> Array:
        """Shapes clipped to their bounds; those that are not fitted stay at their start."""
        return jnp.where(moves, jnp.clip(u, start - reach, jnp.minimum(start + reach, end)), start)

    # Where no shape moves, what depends on shapes alone is computed once.
    moving = design.movable.any()
    still = (design.means(start), design.products(start)) if not moving else None

    def means(shape: Array) -> Array:
        return design.means(shape) if still is None else still[0]

    def products(shape: Array) -> Array:
        return design.products(shape) if still is None else still[1]

    def scatter(power: Array, shape: Array) -> tuple[Array, Array]:
        return power @ means(shape), design.covariance(power, products(shape))

    def misfit(mean: Array, covariance: Array, power_error: Array) -> tuple[Array, Array]:
        """χ² of the residuals, and ln det of their covariance."""
        score = design.residual(V / mean, design.variances(covariance) / mean**2)
        residual, log_det = design.whiten(covariance, mean, power_error, score[:, None])
        return jnp.sum(residual**2), log_det

    def best_powers(shape: Array, W: Array, reference: Array) -> tuple[Array, Array]:
        """Powers for a shape, and the whitened residual they leave (variable projection)."""
        A = W @ (means(shape) / reference).T
        target = W @ (V / reference) - A @ jnp.where(free, 0.0, power)
        v = jnp.where(free, non_negative_least_squares(A, target, active & free), power)
        return v, target - A @ jnp.where(free, v, 0.0)

    def improve(state: _State) -> tuple[Array, Array, Array, tuple[Array, Array]]:
        """One generalized least squares fit, and by how many standard deviations it moved the curve."""
        reference, covariance = state.mean, state.covariance
        W = design.whiten(covariance, reference, state.power_error, jnp.eye(len(V))).values
        shape = state.shape
        if moving:

            def residual(u: Array, _: None) -> Array:
                return best_powers(within(u), W, reference)[1]

            # Not the default QR: see `linalg` about batches of LAPACK calls.
            linear: lx.AbstractLinearSolver = lx.Normal(lx.CG(rtol=1e-9, atol=1e-12))
            solver: optx.AbstractLeastSquaresSolver = optx.LevenbergMarquardt(
                rtol=1e-6, atol=1e-6, linear_solver=linear
            )
            found: optx.Solution = optx.least_squares(
                residual, solver, shape, max_steps=_INNER_STEPS, throw=False
            )
            shape = jnp.where(jnp.isfinite(found.value), within(found.value), shape)
            late = state.step - _DAMPING_AFTER_STEP
            longest = jnp.where(late >= 0, _LATE * _SHORTER**late, jnp.inf)
            shape = state.shape + jnp.clip(shape - state.shape, -longest, longest)
        step = (best_powers(shape, W, reference)[0] - state.power, shape - state.shape)
        # Reweighting converges linearly, sometimes slowly or with alternating sign. Anderson's (1965)
        # acceleration
        # remedies that, with one step of memory and steps measured by how far they move the curve.
        to_curve = W @ (means(state.shape) / reference).T
        here_step, last_step = to_curve @ step[0], to_curve @ state.last_step[0]
        change = here_step - last_step
        gamma = jnp.vdot(change, here_step) / jnp.maximum(jnp.vdot(change, change), 1e-30)
        # Steps that grow in one direction lead away from what is almost a solution: extrapolate, do not
        # return.
        leaving = (jnp.vdot(here_step, last_step) > 0.0) & (gamma > 0.0)
        gamma = jnp.where(leaving, -_MAX_EXTRAPOLATION, gamma)
        # No extrapolation while warming up, when each step solves another problem, nor after many steps, when
        # the iteration cycles.
        steady = (state.step > 0) & (state.phase != _WARM_UP) & (state.step < _DAMPING_AFTER_STEP)
        gamma = jnp.where(steady, jnp.clip(gamma, -_MAX_EXTRAPOLATION, 0.5), 0.0)
        here = (state.power, state.shape)
        power, shape = (
            x + f - gamma * (x - x_last + f - f_last)
            for x, f, x_last, f_last in zip(here, step, state.last, state.last_step, strict=True)
        )
        power, shape = jnp.where(free, jnp.maximum(power, 0.0), state.power), within(shape)
        moved = W @ (power @ means(shape) / reference - 1.0)
        return power, shape, jnp.linalg.norm(moved), step

    def step(state: _State) -> _State:
        power, shape, moved, last_step = improve(state)
        k = state.step + 1
        at_rest = moved < jnp.where(k == _OUTER_STEPS, _CLOSE, _TOLERANCE)
        reference, covariance = scatter(power, shape)
        (chi2, with_error), (_, log_det) = jax.vmap(lambda s: misfit(reference, covariance, s))(
            jnp.stack([jnp.zeros(()), state.power_error])
        )
        # Minus twice the Gaussian log-likelihood, to choose among starts.
        cost = design.cost(V, reference, covariance, state.power_error, with_error + 2.0 * log_det)
        # Where the model's error dominates the covariance, χ² is proportional to its inverse square.
        excess = with_error / dof
        s = jnp.clip(state.power_error * jnp.sqrt(excess), 1e-4, 10.0)
        warmed = (state.phase == _WARM_UP) & (k == len(_WARM_UP_ERROR))
        # A model that is far off is not iterated further without an error.
        hopeless = (chi2 > 4.0 * limit) & (k >= 5)
        plain_ends = (state.phase == _PLAIN) & (at_rest | hopeless | (k == _OUTER_STEPS))
        incomplete = plain_ends & ~(at_rest & (chi2 < limit))
        settled = at_rest & (jnp.abs(excess - 1.0) < 0.02)
        last_ends = (state.phase == _WITH_ERROR) & (settled | (k == _OUTER_STEPS))
        phase = jnp.select(
            [warmed, incomplete, plain_ends | last_ends], [_PLAIN, _WITH_ERROR, _DONE], state.phase
        )
        power_error = jnp.select(
            [phase == _WARM_UP, phase == _WITH_ERROR, phase == _DONE],
            [
                jnp.asarray(_WARM_UP_ERROR)[k % 4],
                jnp.where(incomplete, _FIRST_ERROR, s),
                state.power_error,
            ],
            0.0,
        )
        new = (power, shape, reference, covariance)
        robust = jax.tree.map(lambda new, old: jnp.where(warmed, new, old), new, state.robust)
        new = jax.tree.map(lambda new, old: jnp.where(incomplete, old, new), new, robust)
        return _State(
            power=new[0],
            shape=new[1],
            mean=new[2],
            covariance=new[3],
            robust=robust,
            last=(state.power, state.shape),
            last_step=last_step,
            power_error=power_error,
            phase=phase,
            step=jnp.where(phase == state.phase, k, 0),
            chi2=chi2,
            cost=cost,
            at_rest=jnp.where(state.phase == _WITH_ERROR, settled, at_rest),
        )

    first = (power, shape, *scatter(power, shape))
    state = _State(
        power=first[0],
        shape=first[1],
        mean=first[2],
        covariance=first[3],
        robust=first,
        last=(power, shape),
        last_step=(power, shape),
        power_error=jnp.asarray(_WARM_UP_ERROR[0]),
        phase=jnp.asarray(_WARM_UP),
        step=jnp.asarray(0),
        chi2=jnp.asarray(jnp.inf),
        cost=jnp.asarray(jnp.inf),
        at_rest=jnp.asarray(False),
    )
    state = jax.lax.while_loop(lambda state: state.phase != _DONE, step, state)
    converged = state.at_rest & jnp.isfinite(state.cost)
    return Solution(state.power, state.shape, state.chi2, state.power_error, converged, state.cost)


@eqx.filter_jit
def solve(
    design: Design,
    V: Float[ArrayLike, "axes m"],
    free: Bool[ArrayLike, " terms"],
    active: Bool[ArrayLike, "axes terms"],
    power: Float[ArrayLike, "axes terms"],
    shape: Float[ArrayLike, "axes shapes"],
) -> Solution:
    """Estimate of every axis from its start.

    Args:
        design: the model of the estimates.
        V: the estimates of power, such as Allan variances [rate²].
        free: the terms whose power is estimated.
        active: the terms in use, for each axis.
        power, shape: start values.
    """
    return jax.vmap(lambda *of_axis: _solve(design, of_axis[0], jnp.asarray(free), *of_axis[1:]))(
        V, active, power, shape
    )

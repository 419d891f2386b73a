"""Iterated generalized least squares on estimates of power, compiled and vectorised over axes.

The estimating equation is D'C⁻¹(V − μ) = 0 with mean μ, its derivatives D and the covariance C of the
estimates V, all under the current model: it is unbiased for any law of V, and nearly as efficient as the
likelihood of the whole record. Internally, each variance is in units of its mean under the model.

If a model cannot follow the curve within the scatter (p < 1e-6), the covariance gains a relative error s of
the model's powers, correlated over about an octave, that brings χ² to its degrees of freedom. The intervals
then allow for an incomplete model instead of being absurdly narrow.
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
from allanjax.estimate.design import AllanDesign

# Bound of a shape's distance from its start, in ln: the spectrum locates a line better than the Allan curve
# does; the starts of other shapes are two to a decade or denser.
_SHAPE_BOUND = {"line": 0.1, "time": 4.0, "frequency": 4.0, "number": 3.0}
# Margin kept from a shape's upper bound in ln, since the bound is open.
_INSIDE = 1e-2
# Largest number of reweightings, and of steps of the shapes within each.
_OUTER_STEPS = 100
_INNER_STEPS = 50
# Largest factor by which the acceleration extrapolates the last move.
_MAX_EXTRAPOLATION = 5.0
# Number of full steps; afterwards shapes move by at most _LATE in ln, times _SHORTER after each step.
_DAMPING_AFTER_STEP = 25
_LATE, _SHORTER = 0.5, 0.92
# A step that moves the fitted curve by less than this, in standard deviations, ends the iteration.
_TOLERANCE = 1e-3
# The same after the last step: in a poorly determined direction, such as a long correlation time, steps stay
# longer, and this share of a standard deviation suffices.
_CLOSE = 0.05
# Phases of the iteration: first with large errors of the model, nearly a log-log fit, which converges from
# anywhere; then without; then, if χ² is too large, with the error that brings it to its degrees of freedom.
_WARM_UP, _PLAIN, _WITH_ERROR, _DONE = range(4)
_FIRST_ERROR, _LEAST_ERROR, _LESS_ERROR = 0.1, 1e-4, 0.5
_WARM_UP_ERROR = np.array([0.5, 0.2, 0.05, 0.0])


class Solution(NamedTuple):
    """Estimate of one axis.

    Attributes:
        power: powers (squared amplitudes) of the terms.
        shape: transformed shapes, ln(value − lower bound).
        chi2: χ² without an error of the model.
        power_error: relative error of the model's powers that explains the misfit; 0 if the model suffices.
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


class _Place(NamedTuple):
    """An estimate, and the expectation and covariance of the data there."""

    power: Float[Array, " terms"]
    shape: Float[Array, " shapes"]
    mean: Float[Array, " m"]
    covariance: Array


class _State(NamedTuple):
    """State of the iteration: the estimate, the one of the robust phase, the last move, and the phase."""

    here: _Place
    robust: _Place
    last: tuple[Array, Array]
    last_step: tuple[Array, Array]
    power_error: Float[Array, ""]
    phase: Int[Array, ""]
    step: Int[Array, ""]
    chi2: Float[Array, ""]
    cost: Float[Array, ""]
    at_rest: Bool[Array, ""]


class _Problem(NamedTuple):
    """Data of one axis, the part of the model that is fitted to them, and the start.

    Attributes:
        design, V, free, active: as in `solve`.
        power, shape: where the fit starts; inactive terms have zero power, held ones keep theirs.
        moves: which shapes are fitted; the others stay at their start.
        lower, upper: bounds of these.
        still: means and products if no shape moves, computed once.
        dof: degrees of freedom of χ².
    """

    design: AllanDesign
    V: Float[Array, " m"]
    free: Bool[Array, " terms"]
    active: Bool[Array, " terms"]
    power: Float[Array, " terms"]
    shape: Float[Array, " shapes"]
    moves: Bool[Array, " shapes"]
    lower: Float[Array, " shapes"]
    upper: Float[Array, " shapes"]
    still: tuple[Array, Array] | None
    dof: Float[Array, ""]

    @classmethod
    def of(
        cls, design: AllanDesign, V: Array, free: Array, active: Array, power: Array, shape: Array
    ) -> _Problem:
        declared = [s.parameter for s in design.shapes]
        reach = jnp.asarray([_SHAPE_BOUND[p.kind] for p in declared])
        end = jnp.asarray([np.log(p.upper - p.lower) for p in declared]) - _INSIDE
        moves = active[jnp.asarray(design.owner)] & design.movable
        dof = jnp.maximum(design.rows - jnp.sum(active & free) - jnp.sum(moves), 1.0)
        still = None if design.has_shapes else (design.means(shape), design.products(shape))
        bounds = (shape - reach, jnp.minimum(shape + reach, end))
        return cls(design, V, free, active, jnp.where(active, power, 0.0), shape, moves, *bounds, still, dof)

    def within(self, u: Array) -> Float[Array, " shapes"]:
        """Shapes clipped to their bounds; those that are not fitted stay at their start."""
        return jnp.where(self.moves, jnp.clip(u, self.lower, self.upper), self.shape)

    def means(self, shape: Array) -> Float[Array, "terms m"]:
        """Expectations for unit powers."""
        return self.design.means(shape) if self.still is None else self.still[0]

    def place(self, power: Array, shape: Array) -> _Place:
        """Expectation and covariance of the data under these parameters."""
        products = self.design.products(shape) if self.still is None else self.still[1]
        mean = self.design.mean(power, self.means(shape))
        return _Place(power, shape, mean, self.design.covariance(power, products))

    def misfit(self, place: _Place, power_error: Array) -> tuple[Array, Array]:
        """χ² of the residuals, and ln det of their covariance."""
        # Plain relative residuals, since normal scores of each would not be jointly normal.
        residual = (self.V / place.mean - 1.0)[:, None]
        residual, log_det = self.design.whiten(place.covariance, place.mean, power_error, residual)
        return jnp.sum(residual**2), log_det

    def project_powers(self, shape: Array, W: Array, reference: Array) -> tuple[Array, Array]:
        """Best powers for given shapes, and the whitened residual (variable projection)."""
        A = W @ (self.means(shape) / reference).T
        target = W @ (self.V / reference) - A @ jnp.where(self.free, 0.0, self.power)
        v = non_negative_least_squares(A, target, self.active & self.free)
        v = jnp.where(self.free, v, self.power)
        return v, target - A @ jnp.where(self.free, v, 0.0)


def _reweighted(problem: _Problem, state: _State, W: Array) -> tuple[Array, Array]:
    """Powers and shapes by one generalized least squares fit with the weights of the present estimate."""
    here = state.here
    shape = here.shape
    if problem.still is None:

        def residual(u: Array, _: None) -> Array:
            return problem.project_powers(problem.within(u), W, here.mean)[1]

        # Not the default QR: see `linalg` about batches of LAPACK calls.
        linear: lx.AbstractLinearSolver = lx.Normal(lx.CG(rtol=1e-9, atol=1e-12))
        solver: optx.AbstractLeastSquaresSolver = optx.LevenbergMarquardt(
            rtol=1e-6, atol=1e-6, linear_solver=linear
        )
        found: optx.Solution = optx.least_squares(
            residual, solver, shape, max_steps=_INNER_STEPS, throw=False
        )
        shape = jnp.where(jnp.isfinite(found.value), problem.within(found.value), shape)
        late = state.step - _DAMPING_AFTER_STEP
        longest = jnp.where(late >= 0, _LATE * _SHORTER**late, jnp.inf)
        shape = here.shape + jnp.clip(shape - here.shape, -longest, longest)
    return problem.project_powers(shape, W, here.mean)[0], shape


def _accelerated(
    problem: _Problem, state: _State, W: Array, step: tuple[Array, Array]
) -> tuple[Array, Array]:
    """Powers and shapes after a step that is longer or shorter than this one, by Anderson's (1965) method.

    Reweighting converges linearly, sometimes slowly or with alternating sign. The acceleration remedies that,
    with one step of memory and steps measured by how far they move the curve.
    """
    here = state.here
    to_curve = W @ (problem.means(here.shape) / here.mean).T
    here_step, last_step = to_curve @ step[0], to_curve @ state.last_step[0]
    change = here_step - last_step
    gamma = jnp.vdot(change, here_step) / jnp.maximum(jnp.vdot(change, change), 1e-30)
    # Steps that grow in one direction lead away from a near solution: extrapolate, do not return.
    leaving = (jnp.vdot(here_step, last_step) > 0.0) & (gamma > 0.0)
    gamma = jnp.where(leaving, -_MAX_EXTRAPOLATION, gamma)
    # No extrapolation while warming up, as each step solves another problem, nor after many steps, as the
    # iteration cycles.
    steady = (state.step > 0) & (state.phase != _WARM_UP) & (state.step < _DAMPING_AFTER_STEP)
    gamma = jnp.where(steady, jnp.clip(gamma, -_MAX_EXTRAPOLATION, 0.5), 0.0)
    power, shape = (
        x + f - gamma * (x - x_last + f - f_last)
        for x, f, x_last, f_last in zip(here[:2], step, state.last, state.last_step, strict=True)
    )
    return jnp.where(problem.free, jnp.maximum(power, 0.0), here.power), problem.within(shape)


def _next(problem: _Problem, state: _State) -> _State:
    """State after one step, and the next phase."""
    here, k = state.here, state.step + 1
    W = problem.design.whiten(here.covariance, here.mean, state.power_error, jnp.eye(len(problem.V))).values
    power, shape = _reweighted(problem, state, W)
    step = (power - here.power, shape - here.shape)
    new = problem.place(*_accelerated(problem, state, W, step))
    # Move of the curve in standard deviations.
    moved = jnp.linalg.norm(W @ (new.mean / here.mean - 1.0))
    at_rest = moved < jnp.where(k == _OUTER_STEPS, _CLOSE, _TOLERANCE)
    (chi2, with_error), (_, log_det) = jax.vmap(lambda s: problem.misfit(new, s))(
        jnp.stack([jnp.zeros(()), state.power_error])
    )
    # Minus twice the Gaussian log-likelihood, to choose among starts.
    cost = with_error + 2.0 * log_det + 2.0 * jnp.sum(jnp.log(new.mean))
    # Where the model's error dominates the covariance, χ² is proportional to its inverse square.
    excess = with_error / problem.dof
    settled = at_rest & ((jnp.abs(excess - 1.0) < 0.02) | _needless(problem, state.power_error, chi2))
    # If the first steps led far off but the model suffices, its error must vanish in the end.
    late = state.step >= _DAMPING_AFTER_STEP
    change = jnp.where(late & _suffices(problem, chi2), _LESS_ERROR, jnp.sqrt(excess))
    phase, warmed, incomplete = _phase_after(problem, state, at_rest, settled, chi2)
    power_error = jnp.select(
        [phase == _WARM_UP, phase == _WITH_ERROR, phase == _DONE],
        [
            jnp.asarray(_WARM_UP_ERROR)[k % 4],
            jnp.where(incomplete, _FIRST_ERROR, jnp.clip(state.power_error * change, _LEAST_ERROR, 10.0)),
            state.power_error,
        ],
        0.0,
    )
    robust = jax.tree.map(lambda new, old: jnp.where(warmed, new, old), new, state.robust)
    return _State(
        here=jax.tree.map(lambda new, old: jnp.where(incomplete, old, new), new, robust),
        robust=robust,
        last=here[:2],
        last_step=step,
        power_error=power_error,
        phase=phase,
        step=jnp.where(phase == state.phase, k, 0),
        chi2=chi2,
        cost=cost,
        at_rest=jnp.where(state.phase == _WITH_ERROR, settled, at_rest),
    )


def _phase_after(
    problem: _Problem, state: _State, at_rest: Array, settled: Array, chi2: Array
) -> tuple[Array, Array, Array]:
    """Phase after a step, and whether the step ended the warm-up or showed that the model is incomplete."""
    k = state.step + 1
    warmed = (state.phase == _WARM_UP) & (k == len(_WARM_UP_ERROR))
    # A model that is far off is not iterated further without a model error.
    hopeless = (chi2 > 4.0 * beyond_doubt(problem.dof)) & (k >= 5)
    plain_ends = (state.phase == _PLAIN) & (at_rest | hopeless | (k == _OUTER_STEPS))
    incomplete = plain_ends & ~(at_rest & _suffices(problem, chi2))
    last_ends = (state.phase == _WITH_ERROR) & (settled | (k == _OUTER_STEPS))
    phase = jnp.select(
        [warmed, incomplete, plain_ends | last_ends], [_PLAIN, _WITH_ERROR, _DONE], state.phase
    )
    return phase, warmed, incomplete


def _suffices(problem: _Problem, chi2: Array) -> Array:
    """Whether the model follows the curve; with few clusters the tail is heavier than that of χ²."""
    return chi2 < beyond_doubt(problem.dof)


def _needless(problem: _Problem, power_error: Array, chi2: Array) -> Array:
    """Whether the model's error has shrunk to nothing, and the model suffices without it."""
    return (power_error <= _LEAST_ERROR) & _suffices(problem, chi2)


def _solve(problem: _Problem) -> Solution:
    """Estimate of one axis from one start."""
    first = problem.place(problem.power, problem.shape)
    start = _State(
        here=first,
        robust=first,
        last=first[:2],
        last_step=first[:2],
        power_error=jnp.asarray(_WARM_UP_ERROR[0]),
        phase=jnp.asarray(_WARM_UP),
        step=jnp.asarray(0),
        chi2=jnp.asarray(jnp.inf),
        cost=jnp.asarray(jnp.inf),
        at_rest=jnp.asarray(False),
    )
    end = jax.lax.while_loop(lambda state: state.phase != _DONE, lambda s: _next(problem, s), start)
    converged = end.at_rest & jnp.isfinite(end.cost)
    power_error = jnp.where(_needless(problem, end.power_error, end.chi2), 0.0, end.power_error)
    return Solution(*end.here[:2], end.chi2, power_error, converged, end.cost)


@eqx.filter_jit
def solve(
    design: AllanDesign,
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
    return jax.vmap(lambda V, *of_axis: _solve(_Problem.of(design, V, jnp.asarray(free), *of_axis)))(
        V, active, power, shape
    )

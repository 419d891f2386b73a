"""Iterated generalized least squares on estimates of power, compiled and vectorised over axes.

The estimating equation is D'C⁻¹(V − μ) = 0 with mean μ, its derivatives D and the covariance C of the
estimates V, all under the current model: it is unbiased for any law of V, and nearly as efficient as the
likelihood of the whole record. Internally, each variance is in units of its mean under the model.

If a model cannot follow the curve within the scatter (p < 1e-6), the covariance gains a relative error s of
the model's powers, correlated over about an octave, that brings χ² to its degrees of freedom. The intervals
then allow for an incomplete model instead of being absurdly narrow.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import optimistix as optx
from jaxtyping import Array, ArrayLike, Bool, Float, Int, Shaped

from allanjax.base.chi_squared import beyond_doubt
from allanjax.base.linalg import non_negative_least_squares
from allanjax.estimate.design import INSIDE, REACH, AllanDesign

# Errors of the model in the first steps, nearly log-log fits, which converge from anywhere; of a model that
# is tried without an error, and of one that needs one.
_WARM_UP = np.array([[0.5, 0.2, 0.05, 0.0], [0.5, 0.2, 0.05, 0.1]])
_WARM = _WARM_UP.shape[1]
# Largest number of reweightings, and of steps of the shapes within each.
_STEPS, _INNER_STEPS = _WARM + 100, 20
# Largest factor by which the acceleration extrapolates the last move.
_MAX_EXTRAPOLATION = 5.0
# A step that moves the fitted curve by less than this, in standard deviations, ends the iteration.
_TOLERANCE = 1e-3
_LEAST_ERROR = 1e-4
# Difference of minus twice the log-likelihood below which two solutions are the same.
_AS_LIKELY = 0.02


class Solution(NamedTuple):
    """Estimate of one axis in arrays of JAX or NumPy, or of several along a first dimension.

    Powers (squared amplitudes) [terms]; shapes, ln(value − lower bound) [shapes]; χ² without an error of the
    model; the relative error of its powers that explains the misfit, 0 if the model suffices; whether the
    iteration converged; and minus twice the log-likelihood, to choose among solutions.
    """

    power: Any
    shape: Any
    chi2: Any
    power_error: Any
    converged: Any
    cost: Any

    @property
    def discrepancy(self) -> Any:
        """Relative error of the model's deviations, which is half of that of its powers."""
        return self.power_error / 2.0


class _State(NamedTuple):
    """State of the iteration: powers and shapes, expectation and covariance there, the last place and move.

    `tolerant`: whether the model is given an error; `step` counts from the start with or without one.
    """

    at: tuple[Array, Array]
    mean: Float[Array, " m"]
    covariance: Float[Array, "m m"]
    last: tuple[Array, Array]
    last_move: tuple[Array, Array]
    power_error: Float[Array, ""]
    tolerant: Bool[Array, ""]
    step: Int[Array, ""]
    chi2: Float[Array, ""]
    cost: Float[Array, ""]
    ended: Bool[Array, ""]


class _Problem(NamedTuple):
    """Data of one axis, the model that is fitted to them, and the start; see `solve`."""

    design: AllanDesign
    V: Float[Array, " m"]
    free: Bool[Array, " terms"]
    active: Bool[Array, " terms"]
    power: Float[Array, " terms"]
    shape: Float[Array, " shapes"]

    @property
    def moves(self) -> Bool[Array, " shapes"]:
        """Which shapes are fitted."""
        return self.active[jnp.asarray(self.design.owner)]

    @property
    def dof(self) -> Float[Array, ""]:
        """Degrees of freedom of χ²."""
        estimated = jnp.sum(self.active & self.free) + jnp.sum(self.moves)
        return jnp.maximum(self.design.geometry.count - estimated, 1.0)

    def within(self, u: Array) -> Float[Array, " shapes"]:
        """Shapes clipped to their bounds; those that are not fitted stay at their start."""
        reach = jnp.asarray([REACH[p.kind] for p, _ in self.design.shapes])
        end = jnp.asarray([np.log(p.upper - p.lower) for p, _ in self.design.shapes]) - INSIDE
        clipped = jnp.clip(u, self.shape - reach, jnp.minimum(self.shape + reach, end))
        return jnp.where(self.moves, clipped, self.shape)

    def misfit(self, mean: Array, covariance: Array, power_error: Array) -> tuple[Array, Array]:
        """χ² of the residuals, and ln det of their covariance."""
        # Plain relative residuals, since normal scores of each would not be jointly normal.
        residual, log_det = self.design.whiten(mean, covariance, power_error, (self.V / mean - 1.0)[:, None])
        return jnp.sum(residual**2), log_det

    def powers(self, shape: Array, W: Array, reference: Array) -> tuple[Array, Array]:
        """Best powers for given shapes, and the whitened residual (variable projection)."""
        A = W @ (self.design.means(shape) / reference).T
        target = W @ (self.V / reference) - A @ jnp.where(self.free, 0.0, self.power)
        v = non_negative_least_squares(A, target, self.active & self.free)
        return jnp.where(self.free, v, self.power), target - A @ jnp.where(self.free, v, 0.0)

    def reweighted(self, state: _State, W: Array) -> tuple[Array, Array]:
        """Powers and shapes by one generalized least squares fit with the weights of the present estimate."""
        shape = state.at[1]
        if self.design.shapes:

            def residual(u: Array, _: None) -> Array:
                return self.powers(self.within(u), W, state.mean)[1]

            # Not the default QR: see `linalg` about batches of LAPACK calls.
            linear: Any = lx.Normal(lx.CG(rtol=1e-9, atol=1e-12))
            solver: Any = optx.LevenbergMarquardt(rtol=1e-6, atol=1e-6, linear_solver=linear)
            found: Any = optx.least_squares(residual, solver, shape, max_steps=_INNER_STEPS, throw=False)
            shape = jnp.where(jnp.isfinite(found.value), self.within(found.value), shape)
        return self.powers(shape, W, state.mean)[0], shape

    def accelerated(self, state: _State, W: Array, move: tuple[Array, Array]) -> tuple[Array, Array]:
        """Powers and shapes after a longer or shorter move than this one, by Anderson's (1965) method.

        Reweighting converges linearly, sometimes slowly or with alternating sign. The acceleration remedies
        that, with one step of memory and moves measured by how far they move the curve.
        """
        to_curve = W @ (self.design.means(state.at[1]) / state.mean).T
        here, last = to_curve @ move[0], to_curve @ state.last_move[0]
        change = here - last
        gamma = jnp.vdot(change, here) / jnp.maximum(jnp.vdot(change, change), 1e-30)
        # Moves that grow in one direction lead away from a near solution: extrapolate, do not return.
        gamma = jnp.where((jnp.vdot(here, last) > 0.0) & (gamma > 0.0), -_MAX_EXTRAPOLATION, gamma)
        # The first steps each solve another problem.
        gamma = jnp.where(state.step > _WARM, jnp.clip(gamma, -_MAX_EXTRAPOLATION, 0.5), 0.0)
        power, shape = (
            x + f - gamma * (x - x_last + f - f_last)
            for x, f, x_last, f_last in zip(state.at, move, state.last, state.last_move, strict=True)
        )
        return jnp.where(self.free, jnp.maximum(power, 0.0), self.power), self.within(shape)

    def next(self, state: _State, again: _State) -> _State:
        """State after one step; a model that does not suffice without an error begins `again` with one."""
        k, error, tolerant = state.step, state.power_error, state.tolerant
        W = self.design.whiten(state.mean, state.covariance, error, jnp.eye(len(self.V))).values
        move = jax.tree.map(jnp.subtract, self.reweighted(state, W), state.at)
        at = self.accelerated(state, W, move)
        mean, covariance = self.design.moments(*at)
        # Move of the curve in standard deviations.
        moved = jnp.linalg.norm(W @ (mean / state.mean - 1.0))
        errors = jnp.stack([jnp.zeros(()), error])
        (chi2, with_error), (_, log_det) = jax.vmap(lambda s: self.misfit(mean, covariance, s))(errors)
        limit, excess = beyond_doubt(self.dof), with_error / self.dof
        # With few clusters the tail is heavier than that of χ².
        suffices = chi2 < limit
        known = ~tolerant | (jnp.abs(excess - 1.0) < 0.02) | (error <= _LEAST_ERROR) & suffices
        settled = (k >= _WARM) & (moved < _TOLERANCE) & known
        ended = settled | (k + 1 == _STEPS)
        # Where the model's error dominates the covariance, χ² is proportional to its inverse square.
        adapted = jnp.where(tolerant, jnp.clip(error * jnp.sqrt(excess), _LEAST_ERROR, 10.0), 0.0)
        warm = jnp.asarray(_WARM_UP)[tolerant.astype(int), jnp.minimum(k + 1, _WARM - 1)]
        wanted = jnp.where(ended, error, jnp.where(k + 1 < _WARM, warm, adapted))
        # Minus twice the Gaussian log-likelihood, to choose among starts.
        cost = with_error + 2.0 * log_det + 2.0 * jnp.sum(jnp.log(mean))
        moments, before = (mean, covariance), (state.at, move)
        new = _State(at, *moments, *before, wanted, tolerant, k + 1, chi2, cost, ended)
        anew = ended & ~tolerant & ~(settled & suffices)
        return jax.tree.map(lambda a, b: jnp.where(anew, a, b), again, new)

    def solution(self) -> Solution:
        error, infinite, no = map(jnp.asarray, (_WARM_UP[0, 0], jnp.inf, False))
        at, moments = (self.power, self.shape), self.design.moments(self.power, self.shape)
        first = _State(at, *moments, at, at, error, no, jnp.asarray(0), infinite, infinite, no)
        again = first._replace(tolerant=~no)
        end = jax.lax.while_loop(lambda state: ~state.ended, lambda state: self.next(state, again), first)
        vanished = (end.power_error <= _LEAST_ERROR) & (end.chi2 < beyond_doubt(self.dof))
        error = jnp.where(vanished, 0.0, end.power_error)
        return Solution(*end.at, end.chi2, error, (end.step < _STEPS) & jnp.isfinite(end.cost), end.cost)


def solve(
    design: AllanDesign,
    V: Float[np.ndarray, "axes m"],
    free: Bool[np.ndarray, " terms"],
    active: Bool[np.ndarray, "axes terms"],
    power: Float[np.ndarray, "axes starts terms"],
    shape: Float[np.ndarray, "axes starts shapes"],
) -> Solution:
    """Best fit to the estimates V of power [rate²] of every axis from its starts, in arrays of NumPy.

    `active` are the terms in use, and `free` those whose power is estimated.
    """
    padding, slots, count = len(design.octaves) - V.shape[1], len(design.scatters) - len(free), len(free)
    V = np.pad(V, ((0, 0), (0, padding)), constant_values=1.0)
    of_terms = free, active, np.where(active[:, None], power, 0.0)
    free, active, power = (np.pad(x, [(0, 0)] * (x.ndim - 1) + [(0, slots)]) for x in of_terms)
    found: Any = jax.device_get(_solutions(design, free, V, active, power, shape))
    return found._replace(power=found.power[:, :count])


@eqx.filter_jit
def _solutions(
    design: AllanDesign, free: Bool[ArrayLike, " terms"], *of_axes: Shaped[ArrayLike, "axes ..."]
) -> Solution:
    def of(axis: Any) -> Solution:
        V, active, *starts = axis
        each: Any = jax.lax.map(
            lambda at: _Problem(design, V, jnp.asarray(free), active, *at).solution(), starts
        )
        # The cost may have several minima in a correlation time: the best one counts, of equals the first.
        cost = jnp.where(each.converged, each.cost, jnp.inf)
        best = jnp.argmax(cost <= cost.min() + _AS_LIKELY)
        return jax.tree.map(lambda x: x[best], each)

    # With shapes one after another, for then no axis waits for the slowest.
    return jax.lax.map(of, of_axes) if design.shapes else jax.vmap(of)(of_axes)

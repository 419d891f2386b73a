"""Small dense linear algebra that is safe to batch.

A batched LAPACK call of jaxlib waits in a worker thread for tasks on the same thread pool, so two such calls
deadlock on a machine with two cores (observed with jaxlib 0.10.2 for a vmapped Cholesky factorization). The
loops of vector operations below do not use LAPACK and are as fast for the sizes in this package.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float, Int


class CholeskyWhitened(NamedTuple):
    """Columns X whitened by a Cholesky factorization C = LL': L⁻¹X, and ln det L."""

    values: Float[Array, "m k"]
    log_det: Float[Array, ""]


def whiten(
    C: Float[Array, "m m"], X: Float[Array, "m k"], rows: Int[ArrayLike, ""] | None = None
) -> CholeskyWhitened:
    """Whiten the columns of X by C = LL', positive definite: L⁻¹X and ln det L, NaN if it is not.

    Row k of [L' | L⁻¹X] is row k of [C | X] less the part explained by the rows above it. This takes one pass
    over memory per row and is several times faster than eliminating the row from all rows below it. If `rows`
    is less than the size of C, the remaining rows of L⁻¹X are zero.
    """
    m = C.shape[0]
    both = jnp.concatenate([C, X], axis=1)

    def row(k: Array, carry: tuple[Array, Array]) -> tuple[Array, Array]:
        done, log_det = carry
        rest = both[k] - done[:, k] @ done
        pivot = jnp.sqrt(rest[k])
        return done.at[k].set(rest / pivot), log_det + jnp.log(pivot)

    done, log_det = jax.lax.fori_loop(
        0, m if rows is None else rows, row, (jnp.zeros_like(both), jnp.zeros(()))
    )
    return CholeskyWhitened(done[:, m:], log_det)


def non_negative_least_squares(
    A: Float[Array, "m terms"], b: Float[Array, " m"], allowed: Bool[Array, " terms"]
) -> Float[Array, " terms"]:
    """Non-negative x that minimizes |Ax − b|, zero where not allowed; differentiable in A and b.

    Principal pivoting (Portugal, Júdice & Vicente 1994): the set of positive entries is changed until all of
    them are positive and no gradient calls for another one. Exchanging all offending entries at once is fast;
    after a few rounds Murty's rule takes over, which exchanges only the last one and always terminates.
    """
    size = jnp.sqrt(jnp.sum(A**2, axis=0))
    # A column of zeros belongs to no term.
    size = jnp.where(size > 0.0, size, 1.0)
    A = A / size
    normal, target = A.T @ A, A.T @ b

    # The set of positive entries has no derivative.
    still_normal, still_target = jax.lax.stop_gradient((normal, target))

    def solution(
        positive: Bool[Array, " terms"], normal: Float[Array, "terms terms"], target: Float[Array, " terms"]
    ) -> Float[Array, " terms"]:
        both = positive[:, None] & positive
        system = jnp.where(both, normal, 0.0) + jnp.diag(jnp.where(positive, 1e-12, 1.0))
        half = whiten(system, jnp.eye(len(system))).values
        return half.T @ (half @ jnp.where(positive, target, 0.0))

    def offenders(positive: Bool[Array, " terms"]) -> Bool[Array, " terms"]:
        x = solution(positive, still_normal, still_target)
        wanted = still_target - still_normal @ x > 1e-12 * jax.lax.stop_gradient(jnp.linalg.norm(b))
        return allowed & jnp.where(positive, x < 0.0, wanted)

    def exchange(state: tuple[Array, Array]) -> tuple[Array, Array]:
        positive, k = state
        bad = offenders(positive)
        last = jnp.arange(len(bad)) == len(bad) - 1 - jnp.argmax(bad[::-1])
        return positive ^ jnp.where(k < 5, bad, bad & last), k + 1

    def goes_on(state: tuple[Array, Array]) -> Bool[Array, ""]:
        return jnp.any(offenders(state[0])) & (state[1] < 100)

    positive, _ = jax.lax.while_loop(goes_on, exchange, (allowed, jnp.asarray(0)))
    return jnp.maximum(solution(positive, normal, target), 0.0) / size

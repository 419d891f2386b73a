"""First-order linear recurrences over long records, in blocks rather than sample by sample."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Num


def linear_recurrence(factor: Num[ArrayLike, ""], drive: Num[Array, " n"]) -> Num[Array, " n"]:
    """Solution of y[k] = factor·y[k−1] + drive[k], y[−1] = 0; real or complex.

    The record is cut into many short blocks that recur side by side (one vector operation a step); then
    the blocks' last values recur, and each block receives what its predecessors carried into it.
    """
    n = drive.shape[0]
    length = max(1, int(n**0.5))
    blocks = -(-n // length)
    columns = jnp.pad(drive, (0, blocks * length - n)).reshape(blocks, length).T
    factor = jnp.asarray(factor, drive.dtype)

    def step(y: Array, x: Array) -> tuple[Array, Array]:
        y = factor * y + x
        return y, y

    last, within = jax.lax.scan(step, jnp.zeros(blocks, drive.dtype), columns)
    powers = jnp.cumprod(jnp.full(length, factor))

    def carry_on(carried: Array, end: Array) -> tuple[Array, Array]:
        return powers[-1] * carried + end, carried

    _, carried = jax.lax.scan(carry_on, jnp.zeros((), drive.dtype), last)
    return (within + powers[:, None] * carried).T.reshape(-1)[:n]

"""A pass up the pyramid of block means (see `pyramid`): four levels at once, compiled.

The pass goes in chunks that stay in a core's cache. A chunk sees a little of the next one, so that chunks do
not depend on each other. Where there are no blocks there is NaN, and differences that meet it do not count:
one program, of one shape, serves sequences of any length and alignment.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from itertools import product
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

LEVELS = 4
"""Levels of the pyramid that one pass computes."""
WINDOWS = (1, 2, 4, 8)
"""Blocks in a window at the lowest level; every other level has windows of the largest size only."""

_WINDOW = WINDOWS[-1]
# Blocks of the lowest level that the differences starting in a chunk reach beyond it.
_REACH = 2 * _WINDOW << (LEVELS - 1)
# Partial sums: reductions to a scalar are not vectorised on a CPU.
_LANES = 1 << 13


def climb(
    rows: Float[np.ndarray, "axes n"] | Float[Array, "axes n"], first: int, pool: ThreadPoolExecutor
) -> tuple[Float[np.ndarray, "sizes axes"], Float[np.ndarray, "axes above"] | Float[Array, "axes above"]]:
    """Sums of squared differences of window means at four levels, and the blocks of the level above them.

    Args:
        rows: consecutive blocks of the lowest level; copied piece by piece only.
        first: index of the first of them.
        pool: the threads that compute pieces at the same time.

    Returns:
        Sums for windows of 1, 2, 4 and 8 blocks of the lowest level and of 8 of each of the others, and the
        whole blocks of the fifth level, from index ⌈first / 16⌉ on, which stay on a device that is no CPU.
    """
    axes, n = rows.shape
    chunk, piece = _shape()
    base = first >> LEVELS << LEVELS
    tasks = list(product(range(base - first, n, piece), range(axes)))

    def run(task: tuple[int, int]) -> tuple[Any, Any]:
        begin, axis = task
        blocks = _padded(rows[axis], begin, piece + _REACH)
        chunks = -(-min(n - begin, piece) // chunk)
        sums, above = _climb_piece(blocks, chunks, chunk=chunk)
        return np.asarray(sums), np.asarray(above) if _on_cpu() else above

    sums, above = zip(*pool.map(run, tasks), strict=True)
    total = np.sum(np.reshape(sums, (-1, axes, len(sums[0]))), axis=0).T
    xp: Any = np if _on_cpu() else jnp
    joined = xp.stack([xp.concatenate(above[axis::axes]) for axis in range(axes)])
    start, end = -(-first >> LEVELS), (first + n) >> LEVELS
    return total, joined[:, start - (base >> LEVELS) : max(end, start) - (base >> LEVELS)]


def _on_cpu() -> bool:
    return jax.default_backend() == "cpu"


def _shape() -> tuple[int, int]:
    """Number of blocks in a chunk (a core's cache, or a large share of a device) and in a compiled piece."""
    return (_LANES, 16 * _LANES) if _on_cpu() else (1 << 24, 1 << 24)


def _padded(row: Any, begin: int, length: int) -> Any:
    """A stretch of `length` values from `begin` on, which may be negative; NaN where there are none."""
    found = row[max(begin, 0) : begin + length]
    before = max(-begin, 0)
    after = length - before - len(found)
    if isinstance(row, jax.Array):
        return jnp.pad(found.astype(float), (before, after), constant_values=np.nan)
    found = np.ascontiguousarray(found, dtype=float)
    return np.pad(found, (before, after), constant_values=np.nan) if before or after else found


@partial(jax.jit, static_argnames="chunk")
def _climb_piece(
    blocks: Float[Array, " piece"], chunks: Int[Array, ""], *, chunk: int
) -> tuple[Float[Array, " sizes"], Float[Array, " above"]]:
    """Sums of squared differences and the blocks of the level above, for one axis of one piece."""

    def stored(function: Callable[[Array], Array], x: Array) -> Array:
        """Result of the function, forced into an array of its own by a branch.

        Otherwise XLA repeats the arithmetic wherever the result is used, and then does not vectorise it.
        """
        return lax.cond(chunks > 0, function, lambda x: jnp.zeros_like(function(x)), x)

    def fetch(c: Array) -> Array:
        return lax.dynamic_slice(blocks, (c * chunk,), (chunk + _REACH,))

    def square_sum(sums: Array, window: int, starts: int) -> Array:
        d = differences(sums, window)[:starts]
        squares = jnp.where(d == d, d**2, 0.0)
        return squares.reshape(-1, min(starts, _LANES)).sum(axis=0)

    def add(c: Array, state: tuple[list[Array], Array]) -> tuple[list[Array], Array]:
        sums, above = state
        found = []
        level = stored(fetch, c)
        for k in range(LEVELS):
            halves = stored(partial(window_sums, window=_WINDOW // 2), level)
            if k == 0:
                found += [square_sum(window_sums(level, w), w, chunk) for w in WINDOWS[:-2]]
                found.append(square_sum(halves, _WINDOW // 2, chunk))
            whole = window_sums(halves, _WINDOW, of=_WINDOW // 2)
            found.append(square_sum(whole, _WINDOW, chunk >> k))
            level = stored(pair_means, level)
        above = lax.dynamic_update_slice(above, level[: chunk >> LEVELS], (c * (chunk >> LEVELS),))
        return [s + f for s, f in zip(sums, found, strict=True)], above

    starts = [chunk] * len(WINDOWS) + [chunk >> k for k in range(1, LEVELS)]
    nothing = [jnp.zeros(min(s, _LANES)) for s in starts]
    above = jnp.full((len(blocks) - _REACH) >> LEVELS, jnp.nan)
    sums, above = lax.fori_loop(0, chunks, add, (nothing, above))
    windows = np.array([*WINDOWS, *[_WINDOW] * (LEVELS - 1)])
    return jnp.stack([s.sum() for s in sums]) / windows**2, above


def pair_means(blocks: Any) -> Any:
    """Means of blocks 0 and 1, 2 and 3, … along the last dimension."""
    pairs = blocks.reshape(*blocks.shape[:-1], -1, 2)
    return (pairs[..., 0] + pairs[..., 1]) * 0.5


def window_sums(blocks: Any, window: int, of: int = 1) -> Any:
    """Sums over windows from every start along the last dimension, given sums over windows of `of` blocks."""
    while of < window:
        blocks = blocks[..., :-of] + blocks[..., of:]
        of *= 2
    return blocks


def differences(sums: Any, window: int) -> Any:
    """Differences of the sums of adjacent windows, from every start along the last dimension."""
    return sums[..., window:] - sums[..., :-window]

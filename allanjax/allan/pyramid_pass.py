"""A pass up the pyramid of block means (see `pyramid`): four levels at once, compiled.

The pass goes in chunks that stay in a core's cache. A chunk sees a little of the next one, so that chunks do
not depend on each other. Where there are no blocks there is NaN, and differences that meet it do not count:
one program, of one shape, serves sequences of any length and alignment.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from allanjax.allan.stretches import stretch

LEVELS = 4
"""Levels of the pyramid that one pass computes."""
WINDOWS = (1, 2, 4, 8)
"""Blocks in a window at the lowest level; every other level has windows of the largest size only."""

_WINDOW = WINDOWS[-1]
# Blocks of the lowest level that the differences starting in a chunk reach beyond it.
_REACH = 2 * _WINDOW << (LEVELS - 1)
# Partial sums: reductions to a scalar are not vectorised on a CPU.
_LANES = 1 << 11
# Values of all axes in a piece.
_PIECE = 1 << 18


def climb(
    table: Float[np.ndarray, "n axes"] | Float[Array, "n axes"], first: int, pool: ThreadPoolExecutor
) -> tuple[Float[np.ndarray, "sizes axes"], Float[np.ndarray, "above axes"] | Float[Array, "above axes"]]:
    """Sums of squared differences of window means at four levels, and the blocks of the level above them.

    Args:
        table: consecutive blocks of the lowest level; read where they lie, or copied piece by piece.
        first: index of the first of them.
        pool: the threads that compute pieces at the same time.

    Returns:
        Sums for windows of 1, 2, 4 and 8 blocks of the lowest level and of 8 of each of the others, and the
        whole blocks of the fifth level, from index ⌈first / 16⌉ on, which stay on a device that is no CPU.
    """
    n, axes = table.shape
    chunk, piece = _shape(axes)
    base = first >> LEVELS << LEVELS
    begins = range(base - first, n, piece)

    def run(begin: int) -> tuple[Any, Any]:
        chunks = -(-min(n - begin, piece) // chunk)
        blocks = _stretch(table, begin, piece + _REACH, chunks * chunk + _REACH)
        sums, above = _climb_piece(*blocks, chunks, axes=axes, chunk=chunk)
        return np.asarray(sums), np.asarray(above) if _on_cpu() else above

    # A thread of its own for a single piece would take longer than the piece.
    found = pool.map(run, begins) if len(begins) > 1 else map(run, begins)
    sums, above = zip(*found, strict=True)
    joined: Any = (np if _on_cpu() else jnp).concatenate(above)
    start, end = (-(-first >> LEVELS)) - (base >> LEVELS), ((first + n) >> LEVELS) - (base >> LEVELS)
    return np.sum(sums, axis=0), joined[start : max(start, end)]


def _on_cpu() -> bool:
    return jax.default_backend() == "cpu"


def _shape(axes: int) -> tuple[int, int]:
    """Blocks of an axis in a chunk, which a core's cache holds (or a device), and in a compiled piece."""
    return (_LANES, max(_PIECE >> (axes - 1).bit_length(), _LANES)) if _on_cpu() else (1 << 24, 1 << 24)


def _stretch(table: Any, begin: int, rows: int, read: int) -> tuple[Any, int]:
    """Rows of a table as `stretch` gives them, on a device too; NaN where there are none."""
    if isinstance(table, jax.Array) and not _on_cpu():
        found = table[max(begin, 0) : begin + rows].astype(float)
        before = max(-begin, 0)
        outside = ((before, rows - before - len(found)), (0, 0))
        return jnp.pad(found, outside, constant_values=np.nan).reshape(-1), 0
    return stretch(np.asarray(table), begin, rows, np.nan, read)


@partial(jax.jit, static_argnames=("axes", "chunk"))
def _climb_piece(
    flat: Float[Array, " values"],
    offset: int | Int[Array, ""],
    chunks: int | Int[Array, ""],
    *,
    axes: int,
    chunk: int,
) -> tuple[Float[Array, "sizes axes"], Float[Array, "above axes"]]:
    """Sums of squared differences and the blocks of the level above, for every axis of one piece."""

    def stored(function: Callable[[], Array]) -> Array:
        """Result of the function, forced into an array of its own by a branch.

        Otherwise XLA repeats the arithmetic wherever the result is used, and then does not vectorise it.
        """
        return lax.cond(chunks > 0, function, lambda: jnp.zeros_like(function()))

    def square_sum(sums: Array, windows_on: Array) -> Array:
        d = windows_on - sums
        squares = jnp.where(d == d, d**2, 0.0)
        return squares.reshape(-1, min(len(d), _LANES)).sum(axis=0)

    def of_axis(axis: Array) -> tuple[Array, Array]:
        def add(c: Array, state: tuple[list[Array], Array]) -> tuple[list[Array], Array]:
            blocks, begin = flat, offset + c * chunk
            if axes > 1:
                length, first = chunk + _REACH, offset + c * chunk * axes + axis
                span = (length - 1) * axes + 1
                blocks = stored(lambda: lax.dynamic_slice(flat, (first,), (span,))[::axes])
                begin = jnp.asarray(0)

            def window(width: int, start: int, starts: int) -> Array:
                """Sums over windows of the lowest level from successive starts, by slices: they vectorise."""
                if width == 1:
                    return lax.dynamic_slice(blocks, (begin + start,), (starts,))
                halves = (window(width // 2, start + k, starts) for k in (0, width // 2))
                return sum(halves, jnp.zeros(()))

            found = [square_sum(window(w, 0, chunk), window(w, w, chunk)) for w in WINDOWS[:-2]]
            half = stored(lambda: window(_WINDOW // 2, 0, chunk + _REACH - _WINDOW // 2 + 1))
            found.append(square_sum(half[:chunk], half[_WINDOW // 2 :][:chunk]))
            sums = stored(lambda: half[: -_WINDOW // 2] + half[_WINDOW // 2 :])
            for k in range(LEVELS):
                starts = chunk >> k
                found.append(square_sum(sums[:starts], sums[_WINDOW:][:starts]))
                sums = stored(partial(next_windows, sums))
                if _WINDOW << (k + 1) == 1 << LEVELS:
                    above = sums[: starts // 2 : _WINDOW] / (1 << LEVELS)
            totals, joined = state
            joined = lax.dynamic_update_slice(joined, above, (c * len(above),))
            return [t + f for t, f in zip(totals, found, strict=True)], joined

        nothing = [jnp.zeros(min(s, _LANES)) for s in starts]
        sums, above = lax.fori_loop(0, chunks, add, (nothing, jnp.full(rows >> LEVELS, jnp.nan)))
        return jnp.stack([s.sum() for s in sums]) / sizes**2, above

    rows = (len(flat) // axes - _REACH) >> LEVELS << LEVELS
    starts = [chunk] * len(WINDOWS) + [chunk >> k for k in range(1, LEVELS)]
    sizes = np.array([*WINDOWS, *(_WINDOW << k for k in range(1, LEVELS))])
    sums, above = lax.map(of_axis, jnp.arange(axes))
    return sums.T, above.T


def next_windows(sums: Any) -> Any:
    """Sums over 16 blocks from every other start: over windows of 8 blocks of the next level."""
    return sums[:-_WINDOW:2] + sums[_WINDOW::2]

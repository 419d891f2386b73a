"""Estimators of the Allan, modified and Hadamard variances at any cluster sizes, compiled.

All are sums of squared differences of the phase. They are taken in chunks that a core's cache holds, for all
cluster sizes on one block of chunks before the next, so that a record is read from memory a few times only.
"""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from itertools import product
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, ArrayLike, Float, Int

from allanjax.allan.clusters import WEIGHTS, Kind, difference_count

#: Quantities that samples may be of: rates, or phases (angles or velocities).
DataType = Literal["rate", "phase"]

# Differences are taken this many at a time: few enough to stay in cache, enough to hide the loop's overhead.
_CHUNK = 8192
# Chunks for which all cluster sizes are computed before the next block is read.
_BLOCK = 16
# Records up to this length are padded to a power of two, so that one program serves all lengths of an octave.
_PADDED = 1 << 22
# Cluster sizes are padded to a multiple of this number.
_SIZES = 64
# Running sums inside a chunk are products with a triangular matrix of this size, which XLA vectorises.
_ROW = 32


def allan_variance_estimates(
    values: Float[ArrayLike, "samples axes"],
    sizes: Int[ArrayLike, " m"],
    rate: Float[ArrayLike, ""] = 1.0,
    *,
    kind: Kind = "allan",
    overlapping: bool = True,
    data_type: DataType = "rate",
) -> Float[Array, "m axes"]:
    """Variances at the given cluster sizes, in the square of the rate's unit.

    Compiled once for each octave of lengths up to 2²² samples, and for each length beyond.

    With x_k the phase after k samples and t0 the sample interval, averages over all starts k (every m-th, if
    not overlapping) of

    - allan: (x_{k+2m} - 2x_{k+m} + x_k)² / (2 m² t0²), Hou (2004) eq. (4.9); with rates eq. (4.5);
    - hadamard: (x_{k+3m} - 3x_{k+2m} + 3x_{k+m} - x_k)² / (6 m² t0²), SP 1065 section 5.2.9;
    - modified: (mean over k..k+m-1 of the second difference)² / (2 m² t0²), SP 1065 section 5.2.4.

    Args:
        values: rates, or phases (one more than the rate samples) in the rate's unit times seconds.
        sizes: cluster sizes in samples; unchecked: each must leave a difference, see `cluster_sizes`.
        rate: sample rate [Hz]; used with phases only.
        kind, overlapping, data_type: as in `allan_deviation`.

    The cores share out the axes and blocks of long records. Differentiable in `values` in forward mode
    (`jax.jvp`, `jax.jacfwd`); not in reverse mode, since the loop over the differences is only as long as
    each cluster size needs.
    """
    n = np.shape(values)[0] - (data_type == "phase")
    sizes = np.asarray(sizes)
    if not isinstance(values, jax.Array):
        values = _padded(np.asarray(values, dtype=float))
    # Sizes that leave no difference cost nothing.
    every = np.pad(sizes, (0, -len(sizes) % _SIZES), constant_values=n + 1)
    if isinstance(values, jax.core.Tracer) or n < _BLOCK * _CHUNK:
        sums = _sums_of_axes(values, every, n, rate, kind=kind, overlapping=overlapping, data_type=data_type)
    else:
        sums = _shared_sums_of_axes(values, every, n, rate, kind, overlapping, data_type)
    if not isinstance(sums, jax.core.Tracer):
        sums = np.asarray(sums)
    sums = sums[: len(sizes)]
    scale = 6.0 if kind == "hadamard" else 2.0
    return sums / (scale * difference_count(n, sizes, kind, overlapping) * sizes**2.0)[:, None]


def _padded(table: Float[np.ndarray, "samples axes"]) -> Float[np.ndarray, "padded axes"]:
    """Table with zeros after the samples, to the next power of two."""
    room = 1 << (len(table) - 1).bit_length()
    return table if room > _PADDED else np.pad(table, ((0, room - len(table)), (0, 0)))


@partial(jax.jit, static_argnames=("kind", "overlapping", "data_type"))
def _sums_of_axes(
    values: Float[ArrayLike, "padded axes"],
    sizes: Int[ArrayLike, " m"],
    n: int | Int[Array, ""],
    rate: ArrayLike,
    *,
    kind: Kind,
    overlapping: bool,
    data_type: DataType,
) -> Float[Array, "m axes"]:
    """Sums of squared differences of every axis, one axis after the other in one compiled program."""

    def of_axis(x: Array) -> Array:
        phases = _phases(x, n, rate, data_type)
        return _square_sums(phases, sizes, n, 0, 1, kind=kind, overlapping=overlapping)

    return lax.map(of_axis, jnp.asarray(values, dtype=float).T).T


def _shared_sums_of_axes(
    values: Float[Array | np.ndarray, "padded axes"],
    sizes: Int[ArrayLike, " m"],
    n: int,
    rate: ArrayLike,
    kind: Kind,
    overlapping: bool,
    data_type: DataType,
) -> Float[np.ndarray, "m axes"]:
    """Sums of squared differences of every axis, blocks of the record shared out among all cores."""
    cores = os.cpu_count() or 1
    # The running sums of a modified variance go through the whole record in one piece.
    shares = 1 if kind == "modified" else cores

    def sums_of(task: tuple[Array, int]) -> Float[np.ndarray, " m"]:
        phases, share = task
        return np.asarray(_square_sums(phases, sizes, n, share, shares, kind=kind, overlapping=overlapping))

    with ThreadPoolExecutor(cores) as pool:
        phases = list(pool.map(lambda x: _phases(x, n, rate, data_type), values.T))
        sums = list(pool.map(sums_of, product(phases, range(shares))))
    return np.reshape(sums, (len(phases), shares, -1)).sum(axis=1).T


def _chunk(room: int) -> int:
    """Differences taken at a time in a record for which there is so much room."""
    return min(_CHUNK, max(_ROW, 1 << room.bit_length()))


@partial(jax.jit, static_argnames="data_type")
def _phases(
    values: Float[ArrayLike, " padded"], n: int | Int[Array, ""], rate: ArrayLike, data_type: DataType
) -> Float[Array, " phases"]:
    """The n + 1 phases in the rate's unit times the sample interval, and values of no meaning after them.

    The straight line between their ends is subtracted: no estimator sees it, and the differences keep more
    digits without it.
    """
    x = jnp.asarray(values)
    room = len(x) - (data_type == "phase")
    chunk = _chunk(room)
    if data_type == "phase":
        line = jnp.arange(room + 1) * ((x[n] - x[0]) / n)
        return jnp.pad((x - x[0] - line) * rate, (0, _CHUNK))
    mean = x.sum() / n

    def add(start: ArrayLike, rates: Array, state: tuple[Array, Array]) -> tuple[Array, Array]:
        total, phases = state
        sums = total + _running_sum(rates - mean)
        return sums[-1], lax.dynamic_update_slice(phases, sums, (start + 1,))

    def add_chunk(k: Array, state: tuple[Array, Array]) -> tuple[Array, Array]:
        return add(k * chunk, lax.dynamic_slice(x, (k * chunk,), (chunk,)), state)

    whole = room // chunk * chunk
    state = (jnp.zeros(()), jnp.zeros(room + 1 + _CHUNK))
    if whole:
        state = lax.fori_loop(0, room // chunk, add_chunk, state)
    return add(whole, jnp.pad(x[whole:], (0, whole + chunk - room)), state)[1]


@partial(jax.jit, static_argnames=("kind", "overlapping"))
def _square_sums(
    phases: Float[Array, " phases"],
    sizes: Int[ArrayLike, " m"],
    n: int | Int[Array, ""],
    share: int | Int[Array, ""],
    shares: int | Int[Array, ""],
    *,
    kind: Kind,
    overlapping: bool,
) -> Float[Array, " m"]:
    """Sums of squared differences of every `shares`-th block from number `share` on (all, if modified)."""
    x, weights, chunk = phases, WEIGHTS[kind], _chunk(len(phases) - 1 - _CHUNK)
    lane = jnp.arange(chunk)
    sizes = jnp.asarray(sizes, dtype=int)

    def differences(start: Array, m: Array) -> Array:
        if overlapping:
            parts = [lax.dynamic_slice(x, (start + p * m,), (chunk,)) for p in range(len(weights))]
        else:
            parts = [x.at[(start + lane + p) * m].get(mode="clip") for p in range(len(weights))]
        return sum((w * part for w, part in zip(weights, parts, strict=True)), jnp.zeros(chunk))

    def of_block(block: Array, m: Array) -> Array:
        count = difference_count(n, m, kind, overlapping)

        def add(k: Array, total: Array) -> Array:
            d = jnp.where(lane < count - k * chunk, differences(k * chunk, m), 0)
            return total + d**2

        end = jnp.minimum((block + 1) * _BLOCK, -(-count // chunk))
        # One partial sum per lane: XLA does not vectorise a reduction of doubles to a scalar.
        return lax.fori_loop(block * _BLOCK, end, add, jnp.zeros(chunk)).sum()

    if kind == "modified":
        return _square_sums_of_sums(x, sizes, n, differences)

    def add_block(k: Array, totals: Array) -> Array:
        return totals + lax.map(lambda m: of_block(k * shares + share, m), sizes)

    blocks = -(-(n + 1) // (_BLOCK * chunk))
    return lax.fori_loop(0, -(-(blocks - share) // shares), add_block, jnp.zeros(len(sizes)))


def _square_sums_of_sums(
    x: Float[Array, " phases"],
    sizes: Int[Array, " m"],
    n: int | Int[Array, ""],
    differences: Callable[[Array, Array], Float[Array, " chunk"]],
) -> Float[Array, " m"]:
    """Sums of squared means of m consecutive second differences, given the third differences."""
    x_sums = jnp.pad(jnp.cumsum(x), (1, 0))
    chunk = _chunk(len(x) - 1 - _CHUNK)
    lane = jnp.arange(chunk)

    def of_size(m: Array) -> Array:
        # The first sum of m second differences comes from sums of the phases, the others by their increments:
        # sums of phases grow so fast that they would lose their digits far into the record.
        first = x_sums[3 * m] - 3 * x_sums[2 * m] + 3 * x_sums[m]
        count = difference_count(n, m, "modified")

        def add(k: Array, carry: tuple[Array, Array]) -> tuple[Array, Array]:
            total, previous = carry
            inside = lane < count - 1 - k * chunk
            s = previous + _running_sum(jnp.where(inside, differences(k * chunk, m), 0))
            return total + jnp.where(inside, s**2, 0), s[-1]

        total, _ = lax.fori_loop(0, -(-(count - 1) // chunk), add, (jnp.zeros(chunk), first))
        return (total.sum() + first**2) / m.astype(float) ** 2

    return lax.map(of_size, sizes)


def _running_sum(x: Float[Array, " chunk"]) -> Float[Array, " chunk"]:
    """Cumulative sum of a chunk, by products with triangular matrices."""
    rows = x.reshape(-1, _ROW) @ jnp.triu(jnp.ones((_ROW, _ROW)))
    return (rows + jnp.tri(len(rows), k=-1) @ rows[:, -1:]).reshape(-1)

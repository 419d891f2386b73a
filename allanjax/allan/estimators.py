"""Estimators of the Allan, modified and Hadamard variances, compiled; the cluster sizes that a record allows.

All are sums of squared differences of the phase. They are taken in chunks that a core's cache holds, for all
cluster sizes on one block of chunks before the next, so that a record is read from memory only a few times.

The pyramid is one pass over the rates, mergeable, at the memory's speed. Its level k holds the means of
blocks of 2^k samples; block b is samples b·2^k … (b+1)·2^k − 1 of the recording. Clusters of m = 1 to 7
samples are windows of so many blocks of level 0, those of m = 8, 10, 12 and 14 times 2^k samples are windows
of 8, 10, 12 and 14 blocks of level k. Every block starts a window: every sample below m = 16, every m/8-th to
m/14-th beyond. The variance is the mean of ½(difference of two adjacent windows)², eq. (4.5) of Hou (2004),
over these starts. Except for strong quantization it is less than 1 % less precise than with every start.

Block means keep their digits however long the recording is, which a running sum of its rates would not.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial, reduce
from itertools import product
from typing import Any, Literal, TypeVar, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from allanjax.base.cache import compiled_once
from allanjax.base.errors import AllanjaxError

#: Kinds of variances.
Kind = Literal["allan", "modified", "hadamard"]
#: Spacings of cluster sizes, explained at `cluster_sizes`.
Spacing = Literal["octave", "decade", "all"] | int | Sequence[float] | Float[np.ndarray, " m"]

_Sizes = TypeVar("_Sizes", np.ndarray, Array)

#: Weights of the phases one cluster time apart in the difference whose mean square is the variance. The
#: modified variance averages sums of second differences; its weights are those of the third differences by
#: which these sums are updated.
WEIGHTS = {"allan": (1, -2, 1), "modified": (-1, 3, -3, 1), "hadamard": (-1, 3, -3, 1)}
# Largest distance of a cluster time from a whole number of samples, in samples, to allow for rounding.
_CLUSTER_SIZE_TOLERANCE = 1e-3


def difference_count(n: Any, sizes: _Sizes, kind: Kind = "allan", overlapping: bool = True) -> _Sizes:
    """Number of differences that `n` rate samples (n + 1 phases) allow at each cluster size m.

    Overlapping: n + 1 - 2m (Allan), n + 1 - 3m (Hadamard), n + 2 - 3m (modified). Non-overlapping: one less
    (Allan) or two less (Hadamard) than the whole clusters. Hou (2004) eq. (4.5) has N - 2n for the first: it
    leaves out the last difference. Same shape as `sizes`; not positive where there is none.
    """
    if kind == "modified":
        return n + 2 - 3 * sizes
    spans = len(WEIGHTS[kind]) - 1
    return n + 1 - spans * sizes if overlapping else n // sizes - (spans - 1)


def cluster_sizes(
    n: int, rate: float, spacing: Spacing = "octave", kind: Kind = "allan"
) -> Int[np.ndarray, " m"]:
    """Cluster sizes in samples, [m], increasing and distinct, for which n samples have a difference.

    The spacing is "octave" (1, 2, 4, ...), "decade" (1, 2, 4, 10, 20, 40, ...), "all", a number of sizes per
    octave, or the cluster times themselves [s], each a multiple of the sample interval to within a thousandth
    of it; only these need the rate [Hz]. AllanjaxError if it is none of these, or `n` is too small.
    """
    check_member(kind, Kind, "kind")
    check_enough(n, kind)
    largest = {"allan": n // 2, "modified": (n + 1) // 3, "hadamard": n // 3}[kind]
    if isinstance(spacing, str):
        known = {
            "octave": lambda: 2 ** np.arange(largest.bit_length()),
            "decade": lambda: np.outer(10 ** np.arange(len(str(largest))), [1, 2, 4]).ravel(),
            "all": lambda: np.arange(1, largest + 1),
        }
        if spacing not in known:
            raise AllanjaxError(
                f"unknown spacing {spacing!r}: expected 'octave', 'decade', 'all', "
                "a number per octave or cluster times in seconds"
            )
        sizes = known[spacing]()
    elif isinstance(spacing, int | np.integer):
        if spacing < 1:
            raise AllanjaxError(f"the number of cluster sizes per octave must be at least 1, not {spacing}")
        steps = np.arange(spacing * largest.bit_length())
        sizes = np.rint(2.0 ** (steps / spacing)).astype(int)
    else:
        times = np.asarray(spacing, dtype=float)
        if times.ndim != 1 or times.size == 0:
            raise AllanjaxError("cluster times must be a non-empty sequence of seconds")
        for time in times:
            if not time * rate <= largest + _CLUSTER_SIZE_TOLERANCE:
                raise AllanjaxError(
                    f"cluster time {time:.9g} s is too long: "
                    f"the longest the recording allows is {largest / rate:.9g} s"
                )
            nearest = max(round(time * rate), 1)
            if abs(time * rate - nearest) > _CLUSTER_SIZE_TOLERANCE:
                raise AllanjaxError(
                    f"cluster time {time:.9g} s is not a multiple of the sample interval {1 / rate:.9g} s: "
                    f"the nearest is {nearest / rate:.9g} s"
                )
        sizes = np.rint(times * rate).astype(int)
    return np.unique(sizes[sizes <= largest])


def check_enough(n: int, kind: Kind) -> None:
    """Raise AllanjaxError if n samples have no difference at any cluster size."""
    shortest = 3 if kind == "hadamard" else 2
    if n < shortest:
        raise AllanjaxError(f"{n} samples are too few for the {kind} variance: it needs at least {shortest}")


def check_member(value: str, literal: object, name: str) -> None:
    """Raise AllanjaxError if an option is not one of the values of a Literal type."""
    known = get_args(literal)
    if value not in known:
        raise AllanjaxError(f"unknown {name} {value!r}: expected one of {', '.join(map(repr, known))}")


# JAX uses a NumPy array in place if it begins at a multiple of so many bytes, and copies any other.
_ALIGNMENT = 64
# Values that may precede the first row, so that the array begins at such a multiple.
_SPARE = _ALIGNMENT // 8


def _aligned(*shape: int) -> Float[np.ndarray, ...]:
    """Array of this shape, with values not yet set, that JAX uses in place."""
    size = int(np.prod(shape))
    memory = np.empty(size + _SPARE)
    first = -memory.ctypes.data % _ALIGNMENT // 8
    return memory[first : first + size].reshape(shape)


#: Quantities that samples may be of: rates, or phases (angles or velocities).
DataType = Literal["rate", "phase"]

# Differences and blocks are taken this many at a time: few enough to stay in cache, enough to hide the loop's
# overhead. There are as many partial sums, as reductions to a scalar are not vectorised.
_CHUNK = 2048
# Chunks for which all cluster sizes are computed before the next block is read.
_BLOCK = 32
# Numbers of phases that memory is reserved for at least, so that records of many lengths share a program: of
# short records, of which there may be thousands, and of others.
_LEAST = 1 << 16, 1 << 20
# Axes that are worked through at a time, which bounds the memory.
_TOGETHER = 16
# Cluster sizes are padded to a multiple of this number.
_SIZES = 128
# Running sums are products with triangular matrices of this size, which XLA vectorises.
_ROW = 16


def allan_variance_estimates(
    values: Float[np.ndarray, "samples axes"],
    sizes: Int[np.ndarray, " m"],
    rate: float = 1.0,
    *,
    kind: Kind = "allan",
    overlapping: bool = True,
    data_type: DataType = "rate",
) -> Float[np.ndarray, "m axes"]:
    """Variances at the given cluster sizes, in the square of the rate's unit.

    Compiled once for all lengths below 65,536 samples, below 10⁶, and for each octave above.

    With x_k the phase after k samples and t0 the sample interval, averages over all starts k (every m-th, if
    not overlapping) of

    - allan: (x_{k+2m} - 2x_{k+m} + x_k)² / (2 m² t0²), Hou (2004) eq. (4.9); with rates eq. (4.5);
    - hadamard: (x_{k+3m} - 3x_{k+2m} + 3x_{k+m} - x_k)² / (6 m² t0²), SP 1065 section 5.2.9;
    - modified: (mean over k..k+m-1 of the second difference)² / (2 m² t0²), SP 1065 section 5.2.4.

    The values are rates, or phases (one more than the rate samples) in the rate's unit times seconds, which
    need the rate [Hz]. Each cluster size [samples] must leave a difference, which is not checked. Blocks of
    the record are shared out among the cores. Besides the samples, their phases take memory.

    Raises:
        AllanjaxError: a sample that is not finite.
    """
    table = np.asarray(values)
    n, axes = len(table) - (data_type == "phase"), table.shape[1]
    every = np.pad(sizes, (0, -len(sizes) % _SIZES))
    cores = os.cpu_count() or 1
    shares = range(min(cores, 1 + n // (_BLOCK * _CHUNK)))
    capacity = _LEAST[0] if n < _LEAST[0] else max(1 << n.bit_length(), _LEAST[1])
    # Memory that is never written costs nothing.
    phases, parts = _aligned(min(axes, _TOGETHER), capacity + _CHUNK), list[np.ndarray]()

    def sums_of(task: tuple[int, int]) -> Float[np.ndarray, " m"]:
        arguments = phases[task[0]], every, len(sizes), n, task[1], len(shares)
        with compiled_once((_square_sums, phases.shape[1], len(every), kind, overlapping)):
            return np.asarray(_square_sums(*arguments, kind=kind, overlapping=overlapping))

    with ThreadPoolExecutor(cores) as pool:
        for first in range(0, axes, _TOGETHER):
            rows = np.ascontiguousarray(table[:, first : first + _TOGETHER].T)
            list(pool.map(partial(_integrate, data_type), rows, phases))
            parts += pool.map(sums_of, product(range(len(rows)), shares))
    sums = np.reshape(parts, (axes, len(shares), -1)).sum(axis=1).T[: len(sizes)]
    sums = sums * (rate**2 if data_type == "phase" else 1.0)
    scale = 6.0 if kind == "hadamard" else 2.0
    variance = sums / (scale * difference_count(n, sizes, kind, overlapping) * sizes**2.0)[:, None]
    # A sample that is not finite makes variances of its axis NaN: checking the samples first would take
    # longer.
    if not np.isfinite(variance).all():
        check_finite(values)
    return variance


# Samples may be infinite; all phases are NaN then.
@np.errstate(invalid="ignore")
def _integrate(
    data_type: DataType, x: Float[np.ndarray, " samples"], phases: Float[np.ndarray, " capacity"]
) -> None:
    """Write the phases of an axis, with meaningless values after them.

    A straight line is subtracted, about the one through the ends: it changes no variance, and the differences
    keep more digits without it.
    """
    n = len(x)
    if data_type == "phase":
        slope = (x[-1] - x[0]) / (n - 1)
        np.subtract(x - x[0], slope * np.arange(n), out=phases[:n])
        return
    own, phases[0] = phases[1 : n + 1], 0.0
    np.subtract(x, np.mean(x, dtype=float), out=own)
    np.cumsum(own, out=own)


@partial(jax.jit, static_argnames=("kind", "overlapping"))
def _square_sums(
    phases: Float[Array, " phases"],
    sizes: Int[ArrayLike, " m"],
    used: int | Int[Array, ""],
    n: int | Int[Array, ""],
    share: int | Int[Array, ""],
    shares: int | Int[Array, ""],
    *,
    kind: Kind,
    overlapping: bool,
) -> Float[Array, " m"]:
    """Sums of squared differences of every `shares`-th block from number `share` on.

    For the modified variance, of every `shares`-th size: its running sums go through the entire record.
    """
    x, weights, chunk = phases, WEIGHTS[kind], _CHUNK
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

    def of_sizes(first: Any, step: Any, of_size: Callable[[Array], Array], totals: Array) -> Array:
        def add(k: Array, totals: Array) -> Array:
            i = first + k * step
            return totals.at[i].add(of_size(sizes[i]))

        return lax.fori_loop(0, -(-(used - first) // step), add, totals)

    nothing = jnp.zeros(len(sizes))
    if kind == "modified":
        return of_sizes(share, shares, partial(_square_sum_of_sums, x, n, differences), nothing)

    def add_block(k: Any, totals: Array) -> Array:
        return of_sizes(0, 1, partial(of_block, k * shares + share), totals)

    blocks: Any = -(-(n + 1) // (_BLOCK * chunk))
    return lax.fori_loop(0, -(-(blocks - share) // shares), add_block, nothing)


def _square_sum_of_sums(
    x: Float[Array, " phases"],
    n: int | Int[Array, ""],
    differences: Callable[[Array, Array], Float[Array, " chunk"]],
    m: Int[Array, ""],
) -> Float[Array, ""]:
    """Sum of squared means of m consecutive second differences, given the third differences."""
    chunk = _CHUNK
    lane = jnp.arange(chunk)

    # The first sum of m second differences comes from the phases, the others by their increments: sums of
    # phases grow so fast that they would lose their digits far into the record.
    def add_second(k: Array, total: Array) -> Array:
        a, b, c = (lax.dynamic_slice(x, (k * chunk + p * m,), (chunk,)) for p in range(3))
        return total + jnp.where(lane < m - k * chunk, a - 2 * b + c, 0)

    first = lax.fori_loop(0, -(-m // chunk), add_second, jnp.zeros(chunk)).sum()
    count = difference_count(n, m, "modified")

    def add(k: Array, carry: tuple[Array, Array]) -> tuple[Array, Array]:
        total, previous = carry
        inside = lane < count - 1 - k * chunk
        s = previous + _running_sums(jnp.where(inside, differences(k * chunk, m), 0)[None])[0]
        return total + jnp.where(inside, s**2, 0), s[-1]

    total, _ = lax.fori_loop(0, -(-(count - 1) // chunk), add, (jnp.zeros(chunk), first))
    return (total.sum() + first**2) / m.astype(float) ** 2


def _running_sums(x: Float[Array, "axes chunk"]) -> Float[Array, "axes chunk"]:
    """Cumulative sums of chunks by products with triangular matrices: of rows, their ends, the ends' ends."""
    rows = x.reshape(-1, _ROW) @ jnp.triu(jnp.ones((_ROW, _ROW)))
    before = rows[:, -1].reshape(-1, _ROW) @ jnp.triu(jnp.ones((_ROW, _ROW + 1)), 1)
    ends = before[:, -1].reshape(len(x), -1)
    earlier = ends @ jnp.triu(jnp.ones((ends.shape[1],) * 2), 1)
    offsets = before[:, :-1] + earlier.reshape(-1, 1)
    return (rows + offsets.reshape(-1, 1)).reshape(x.shape)


# A pass up the pyramid of block means: four levels at once, compiled.
#
# The pass goes in chunks that stay in a core's cache. A chunk includes a little of the next one, so that
# chunks do not depend on each other. Missing blocks are NaN, and differences with them do not count: one
# program, of one shape, serves sequences of any length and alignment.

# Levels of the pyramid that one pass computes; blocks in its windows, so that cluster times are as close
# together as those of `fit`; and at the lowest level.
_LEVELS, _WINDOWS = 4, (8, 10, 12, 14)
_LOWEST = (*range(1, 8), *_WINDOWS)
# Blocks of the lowest level that the differences starting in a chunk reach beyond it.
_REACH = 2 * _WINDOWS[-1] << (_LEVELS - 1)
# Values of all axes in a piece.
_PIECE = 1 << 18


def _climb(
    table: Float[np.ndarray, "n axes"], first: int, pool: ThreadPoolExecutor
) -> tuple[Float[np.ndarray, "sizes axes"], Float[np.ndarray, "above axes"]]:
    """Sums of squared differences of window means at four levels, and the blocks of the level above them.

    The table has consecutive blocks of the lowest level from number `first` on, read in place or copied piece
    by piece. The sums are those of a pyramid's first levels; the complete blocks of the fifth level begin
    with number ⌈first / 16⌉.
    """
    n, axes = table.shape
    piece, base = max(_PIECE >> (axes - 1).bit_length(), _CHUNK), first >> _LEVELS << _LEVELS
    begins = range(base - first, n, piece)

    def run(begin: int) -> tuple[Any, Any]:
        chunks = -(-min(n - begin, piece) // _CHUNK)
        blocks = _flat_rows(table, begin, piece + _REACH, chunks * _CHUNK + _REACH)
        sums, above = _climb_piece(*blocks, chunks, axes=axes)
        return np.asarray(sums), np.asarray(above)

    # A thread of its own for a single piece would take longer than the piece.
    found = pool.map(run, begins) if len(begins) > 1 else map(run, begins)
    sums, above = zip(*found, strict=True)
    start, end = (-(-first >> _LEVELS)) - (base >> _LEVELS), ((first + n) >> _LEVELS) - (base >> _LEVELS)
    return np.sum(sums, axis=0), np.concatenate(above)[start : max(start, end)]


def _flat_rows(table: Any, begin: int, rows: int, read: int) -> tuple[Float[np.ndarray, " values"], int]:
    """Rows of a table [n, axes] of numbers, one after the other, in an array that JAX uses in place.

    The first may be negative and the last beyond the table; such rows are NaN, as far as they are read. The
    table is copied if it is not float64 in C order, or if the rows are at its ends. There are up to eight
    values more; the second result is the place of the first row's first value among them.
    """
    table, axes = np.asarray(table), table.shape[1]
    size = rows * axes + _SPARE
    if table.dtype == np.float64 and table.flags.c_contiguous and table.flags.aligned:
        values = table.reshape(-1)
        spare = (values.ctypes.data // 8 + begin * axes) % _SPARE
        first = begin * axes - spare
        if 0 <= first <= len(values) - size:
            return values[first : first + size], spare
    copied = _aligned(size)
    filled = copied[: rows * axes].reshape(rows, axes)
    start, end = (min(max(k, 0), len(table)) for k in (begin, begin + rows))
    filled[: start - begin] = filled[end - begin : read] = np.nan
    filled[start - begin : end - begin] = table[start:end]
    return copied, 0


@partial(jax.jit, static_argnames="axes")
def _climb_piece(
    flat: Float[Array, " values"],
    offset: int | Int[Array, ""],
    chunks: int | Int[Array, ""],
    *,
    axes: int,
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
        return squares.reshape(-1, min(len(d), _CHUNK)).sum(axis=0)

    def of_axis(axis: Array) -> tuple[Array, Array]:
        def add(c: Array, state: tuple[list[Array], Array]) -> tuple[list[Array], Array]:
            blocks, begin = flat, offset + c * _CHUNK
            if axes > 1:
                length, first = _CHUNK + _REACH, offset + c * _CHUNK * axes + axis
                span = (length - 1) * axes + 1
                blocks = stored(lambda: lax.dynamic_slice(flat, (first,), (span,))[::axes])
                begin = jnp.asarray(0)

            one = lax.dynamic_slice(blocks, (begin,), (_CHUNK + _REACH,))
            # Sums over windows of 1, 2, 4 and 8 blocks of a level, from every start.
            doubled = {1: one}
            for width in (1, 2, 4):
                doubled[2 * width] = stored(partial(_joined, doubled[width], width))
            found = list[Array]()
            for k in range(_LEVELS):
                starts = _CHUNK >> k
                for width in _rows(k)[1]:
                    near, next_to = (_window(doubled, width, begin, starts) for begin in (0, width))
                    found.append(square_sum(near, next_to))
                # The windows of the next level have twice as many blocks, from every other start.
                wide = partial(lambda eight: _joined(eight, 8)[::2], doubled[8])
                doubled = {2: doubled[4][::2], 4: doubled[8][::2], 8: stored(wide)}
                if k == 0:
                    above = doubled[8][: starts // 2 : 8] / (1 << _LEVELS)
            totals, joined = state
            joined = lax.dynamic_update_slice(joined, above, (c * len(above),))
            return [t + f for t, f in zip(totals, found, strict=True)], joined

        nothing = [jnp.zeros(min(s, _CHUNK)) for s in starts]
        sums, above = lax.fori_loop(0, chunks, add, (nothing, jnp.full(rows >> _LEVELS, jnp.nan)))
        return jnp.stack([s.sum() for s in sums]) / sizes**2, above

    rows = (len(flat) // axes - _REACH) >> _LEVELS << _LEVELS
    pairs = [(k, width) for k in range(_LEVELS) for width in _rows(k)[1]]
    starts, sizes = [_CHUNK >> k for k, _ in pairs], np.array([width << k for k, width in pairs])
    sums, above = lax.map(of_axis, jnp.arange(axes))
    return sums.T, above.T


def _joined(windows: Array, blocks: int) -> Array:
    """Sums over windows of so many blocks, each with the window that follows it."""
    return windows[:-blocks] + windows[blocks:]


def _window(doubled: dict[int, Array], width: int, begin: int, starts: int) -> Array:
    """Sums over windows of a width from so many starts on, given those of 1, 2, 4 and 8 blocks."""
    total = jnp.zeros(())
    for part in sorted(doubled, reverse=True):
        if width & part:
            total, begin = total + doubled[part][begin : begin + starts], begin + part
    return total


# Blocks kept at either end of a level: one fewer than two adjacent windows have.
_HELD = 2 * _WINDOWS[-1] - 1
# Samples of each axis that are processed at once, which bounds the memory that their upper levels take.
_PART = 1 << 24

_Blocks = Float[np.ndarray, "axes blocks"]


def pyramid_strides(sizes: Int[np.ndarray, " m"]) -> Int[np.ndarray, " m"]:
    """Samples between the starts of successive clusters, [m], at a pyramid's cluster sizes."""
    return 2 ** np.maximum(np.log2(np.asarray(sizes) // _WINDOWS[0] + 0.5).astype(int), 0)


def _rows(level: int) -> tuple[slice, tuple[int, ...]]:
    """Rows of a level in a pyramid's sums, and the blocks in its windows."""
    last = len(_LOWEST) + level * len(_WINDOWS)
    windows = _WINDOWS if level else _LOWEST
    return slice(last - len(windows), last), windows


@dataclass(frozen=True, eq=False)
class Pyramid:
    """Sums of squared differences of a piece of a recording, and the block means at its ends for merging.

    Attributes:
        start, n: index of the piece's first sample in the recording, and number of its samples.
        sums: [sizes, axes] sums of squared differences of window means [unit²] at m = 1, …, 8, 10, 12, …
        head: [levels, axes, 27] first blocks of each level [unit]; NaN after them where there are fewer.
        tail: [levels, axes, 27] last blocks of each level [unit]; NaN before them where there are fewer.
    """

    start: int
    n: int
    sums: Float[np.ndarray, "sizes axes"]
    head: Float[np.ndarray, "levels axes held"]
    tail: Float[np.ndarray, "levels axes held"]

    @classmethod
    def of(cls, values: Float[np.ndarray, "n axes"], start: int = 0) -> Pyramid:
        """Pyramid of n samples of each axis, the first of them number `start` of the recording.

        The values are read piece by piece, so they may be a memory map. The compiled program is the same for
        every n; each core runs it on pieces of its own. AllanjaxError if a value is not finite.
        """
        if values.ndim != 2 or values.shape[1] == 0:
            raise AllanjaxError(f"data must have the shape [samples, axes], not {values.shape}")
        if start < 0:
            raise AllanjaxError(f"the index of the first sample must not be negative: start is {start}")
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            parts = (
                _pyramid_of_part(values[i : i + _PART], start + i, i, pool)
                for i in range(0, max(len(values), 1), _PART)
            )
            return reduce(cls.merge, parts)

    def merge(self, right: Pyramid) -> Pyramid:
        """Pyramid of this piece and the next one together: that of both in one, to rounding."""
        border, axes = self.start + self.n, self.sums.shape[1]
        if right.start != border:
            raise AllanjaxError(
                f"only adjacent pieces can be merged: the left one ends before sample {border}, "
                f"the right one starts at sample {right.start}"
            )
        if right.sums.shape[1] != axes:
            raise AllanjaxError(f"pieces with {axes} and {right.sums.shape[1]} axes are not of one recording")
        merged = _empty(self.start, self.n + right.n, axes)
        for piece in (self, right):
            merged.sums[: len(piece.sums)] += piece.sums
        junction, first = np.empty((axes, 0)), border
        for k in range(len(merged.head)):
            (left_head, left_tail), (right_head, right_tail) = self._held(k), right._held(k)
            # A block across the border is the mean of two blocks of the level below.
            block = border >> k
            begin, end = block << k, (block + 1) << k
            across = np.empty((axes, 0))
            if self.start <= begin < border and end <= right.start + right.n:
                across = junction[:, 2 * block - first :][:, :2].mean(axis=1, keepdims=True)
            junction = np.concatenate([left_tail, across, right_head], axis=1)
            first = block - left_tail.shape[1]
            rows, windows = _rows(k)
            for sums, window in zip(merged.sums[rows], windows, strict=True):
                near = [left_tail[:, 1 - 2 * window :], across, right_head[:, : 2 * window - 1]]
                sums += _square_sum(np.concatenate(near, axis=1), window)
            merged._hold(
                k,
                np.concatenate([left_head, across, right_head], axis=1),
                np.concatenate([left_tail, across, right_tail], axis=1),
            )
        return merged

    def of_axes(self, keep: Bool[np.ndarray, " axes"]) -> Pyramid:
        """Pyramid of some of the axes."""
        return Pyramid(self.start, self.n, self.sums[:, keep], self.head[:, keep], self.tail[:, keep])

    def _windows(self) -> Iterator[tuple[int, int]]:
        """Yield level and number of blocks of the windows in each row of the sums."""
        for level in range(len(self.head)):
            yield from ((level, window) for window in _rows(level)[1])

    @property
    def cluster_size(self) -> Int[np.ndarray, " m"]:
        """Cluster sizes at which there is a difference, increasing: 1, …, 8, 10, 12, 14, 16, 20, …"""
        sizes = np.array([window << level for level, window in self._windows()], int)
        return sizes[: len(self.count)]

    @property
    def count(self) -> Int[np.ndarray, " m"]:
        """Differences averaged at each of these."""
        pairs = self._windows()
        counts = [_block_count(self.start, self.n, level) + 1 - 2 * window for level, window in pairs]
        return np.array([count for count in counts if count > 0], int)

    def variance(self) -> Float[np.ndarray, "m axes"]:
        """Allan variances at these, in the square of the samples' unit; AllanjaxError if there are none."""
        check_enough(self.n, "allan")
        return self.sums[: len(self.count)] / (2 * self.count[:, None])

    def _held(self, k: int) -> tuple[_Blocks, _Blocks]:
        """First and last blocks of a level, none if the piece does not reach it."""
        if k >= len(self.head):
            return (np.empty((self.sums.shape[1], 0)),) * 2
        held = min(_block_count(self.start, self.n, k), _HELD)
        return self.head[k, :, :held], self.tail[k, :, _HELD - held :]

    def _hold(self, k: int, first: _Blocks, last: Float[np.ndarray, "axes others"]) -> None:
        """Store the outermost of these blocks of a level; only while the pyramid is being built."""
        held = min(_block_count(self.start, self.n, k), _HELD)
        self.head[k, :, :held] = first[:, :held]
        self.tail[k, :, _HELD - held :] = last[:, last.shape[1] - held :]


def _empty(start: int, n: int, axes: int) -> Pyramid:
    """Pyramid of n samples whose sums are zero and whose blocks are not yet known."""
    levels = n.bit_length()
    held, rows = (levels, axes, _HELD), _rows(levels - 1)[0].stop if levels else 0
    return Pyramid(start, n, np.zeros((rows, axes)), np.full(held, np.nan), np.full(held, np.nan))


def _block_count(start: int, n: int, k: int) -> int:
    """Number of whole blocks of level k among n samples from `start` on."""
    return max(((start + n) >> k) - -(-start >> k), 0)


def _square_sum(blocks: _Blocks, window: int) -> Float[np.ndarray, " axes"]:
    """Sum of squared differences between the means of adjacent windows of `window` blocks."""
    # A window of 14 blocks is one of 2, one of 4 and one of 8, which are sums of two halves.
    starts = max(blocks.shape[1] - window + 1, 0)
    sums = np.zeros((len(blocks), starts))
    begin, size = 0, 1
    while size <= window:
        if window & size:
            sums = sums + blocks[:, begin : begin + starts]
            begin += size
        blocks = blocks[:, :-size] + blocks[:, size:]
        size *= 2
    return ((sums[:, window:] - sums[:, :-window]) ** 2).sum(axis=1) / window**2


def _pyramid_of_part(values: Any, start: int, origin: int, pool: ThreadPoolExecutor) -> Pyramid:
    """Pyramid of samples that fit into memory with their upper levels; error messages count from `origin`."""
    n, axes = values.shape
    pyramid = _empty(start, n, axes)
    table, first = values, start
    for k in range(0, len(pyramid.head), _LEVELS):
        if len(table) == 0:
            break
        _hold_ends(pyramid, k, table, first)
        sums, above = _climb(table, first, pool)
        rows = slice(_rows(k)[0].start, _rows(k + _LEVELS - 1)[0].stop)
        own = sums if k == 0 else sums[len(_LOWEST) - len(_WINDOWS) :]
        pyramid.sums[rows] = own[: len(pyramid.sums[rows])]
        # Every sample is in a block that the first pass returns, or among the samples beside these blocks.
        if k == 0 and not all(np.isfinite(x).all() for x in (above, values[:_HELD], values[-_HELD:])):
            check_finite(values, origin)
        table, first = above, -(-first >> _LEVELS)
    return pyramid


def _hold_ends(pyramid: Pyramid, k: int, table: Any, first: int) -> None:
    """Store the outermost blocks of the levels that a pass from level k computes, given all of level k."""
    enough = (_HELD + 1) << (_LEVELS - 1)
    head, tail = np.asarray(table[:enough], float).T, np.asarray(table[-enough:], float).T
    head_first, tail_first = first, first + len(table) - tail.shape[1]
    for level in range(k, min(k + _LEVELS, len(pyramid.head))):
        pyramid._hold(level, head, tail)
        head, head_first = _next_level(head, head_first)
        tail, tail_first = _next_level(tail, tail_first)


def _next_level(blocks: _Blocks, first: int) -> tuple[Float[np.ndarray, "axes halves"], int]:
    """Whole blocks of the next level, and the index of the first of them."""
    odd = first % 2
    pairs = max(blocks.shape[1] - odd, 0) // 2
    return blocks[:, odd : odd + 2 * pairs].reshape(len(blocks), pairs, 2).mean(axis=2), (first + odd) // 2


def check_finite(values: Any, origin: int = 0) -> None:
    """Raise AllanjaxError if a sample [n, axes] is not finite; the first is number `origin` of the data."""
    bad = ~np.isfinite(np.asarray(values))
    if bad.any():
        row, axis = np.argwhere(bad)[0]
        raise AllanjaxError(
            f"{bad.sum()} values are not finite, the first at sample {origin + row}, axis {axis}: "
            "use samples without gaps, or one segment"
        )

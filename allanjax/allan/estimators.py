"""Estimators of the Allan, modified and Hadamard variances, compiled; the cluster sizes that a record allows.

All are sums of squared differences of the phase. They are taken in chunks that a core's cache holds, for all
cluster sizes on one block of chunks before the next, so that a record is read from memory only a few times.
"""

import os
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from itertools import product
from typing import Any, Literal, TypeVar, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, ArrayLike, Float, Int

from allanjax.base.cache import compiled_once
from allanjax.base.errors import AllanjaxError

#: Kinds of variances.
Kind = Literal["allan", "modified", "hadamard"]
#: Spacings of cluster sizes, explained at `cluster_sizes`.
Spacing = Literal["octave", "decade", "all"] | int | Sequence[float] | Float[np.ndarray, " m"]

_Sizes = TypeVar("_Sizes", np.ndarray, Array)

WEIGHTS = {"allan": (1, -2, 1), "modified": (-1, 3, -3, 1), "hadamard": (-1, 3, -3, 1)}
"""Weights of the phases one cluster time apart in the difference whose mean square is the variance.

The modified variance averages sums of second differences; its weights are those of the third differences by
which these sums are updated.
"""

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
    """Cluster sizes in samples, [m], increasing and distinct, that leave at least one difference.

    Args:
        n: number of rate samples.
        rate: sample rate [Hz]; used with cluster times only.
        spacing: "octave" (1, 2, 4, ...), "decade" (1, 2, 4, 10, 20, 40, ...), "all", a number of sizes per
            octave, or the cluster times themselves [s], each a multiple of the sample interval to within a
            thousandth of it.
        kind: the variance, which sets the largest size.

    Raises:
        AllanjaxError: `n` too small, an unknown spacing or kind, a cluster time between samples or too long.
    """
    check_member(kind, Kind, "kind")
    largest = {"allan": n // 2, "modified": (n + 1) // 3, "hadamard": n // 3}[kind]
    if largest < 1:
        raise AllanjaxError(too_few(n, kind))
    if isinstance(spacing, str):
        decades = 10 ** np.arange(len(str(largest)))
        sizes = {
            "octave": 2 ** np.arange(largest.bit_length()),
            "decade": np.outer(decades, [1, 2, 4]).ravel(),
            "all": np.arange(1, largest + 1),
        }.get(spacing)
        if sizes is None:
            raise AllanjaxError(
                f"unknown spacing {spacing!r}: expected 'octave', 'decade', 'all', "
                "a number per octave or cluster times in seconds"
            )
    elif isinstance(spacing, int | np.integer):
        if spacing < 1:
            raise AllanjaxError(f"the number of cluster sizes per octave must be at least 1, not {spacing}")
        steps = np.arange(spacing * largest.bit_length())
        sizes = np.rint(2.0 ** (steps / spacing)).astype(int)
    else:
        return _sizes_of_times(np.asarray(spacing, dtype=float), rate, largest)
    return np.unique(sizes[sizes <= largest])


def _sizes_of_times(times: Float[np.ndarray, " times"], rate: float, largest: int) -> Int[np.ndarray, " m"]:
    """Cluster sizes in samples of the given cluster times [s]."""
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
    return np.unique(np.rint(times * rate).astype(int))


def too_few(n: int, kind: Kind) -> str:
    """Error message for a record too short for a single difference."""
    shortest = 3 if kind == "hadamard" else 2
    return f"{n} samples are too few for the {kind} variance: it needs at least {shortest}"


def check_member(value: str, literal: object, name: str) -> None:
    """Raise AllanjaxError if an option is not one of the values of a Literal type."""
    known = get_args(literal)
    if value not in known:
        raise AllanjaxError(f"unknown {name} {value!r}: expected one of {', '.join(map(repr, known))}")


# JAX uses a NumPy array in place if it begins at a multiple of so many bytes, and copies any other.
_ALIGNMENT = 64
# Values that may precede the first row, so that the array begins at such a multiple.
_SPARE = _ALIGNMENT // 8


def aligned(*shape: int) -> Float[np.ndarray, "..."]:
    """Array of this shape, with values not yet set, that JAX uses in place."""
    size = int(np.prod(shape))
    memory = np.empty(size + _SPARE)
    first = -memory.ctypes.data % _ALIGNMENT // 8
    return memory[first : first + size].reshape(shape)


def flat_rows(
    table: Any, begin: int, rows: int, fill: float | Float[np.ndarray, " axes"], read: int | None = None
) -> tuple[Float[np.ndarray, " values"], int]:
    """Rows of a table [n, axes] of numbers, one after the other, in an array that JAX uses in place.

    Args:
        table: the samples; copied if they are not float64 in C order, or if the rows are at its ends.
        begin: index of the first row, which may be negative.
        rows: number of rows, which may go beyond the table.
        fill: value of rows that the table does not have.
        read: how many of the rows are used, if not all.

    Returns:
        The rows with up to eight values more, and the index of the first row's first value among them.
    """
    axes = table.shape[1]
    size = rows * axes + _SPARE
    if table.dtype == np.float64 and table.flags.c_contiguous and table.flags.aligned:
        values = table.reshape(-1)
        spare = (values.ctypes.data // 8 + begin * axes) % _SPARE
        first = begin * axes - spare
        if 0 <= first <= len(values) - size:
            return values[first : first + size], spare
    copied = aligned(size)
    filled = copied[: rows * axes].reshape(rows, axes)
    start, end = (min(max(k, 0), len(table)) for k in (begin, begin + rows))
    filled[: start - begin] = filled[end - begin : read] = fill
    filled[start - begin : end - begin] = table[start:end]
    return copied, 0


#: Quantities that samples may be of: rates, or phases (angles or velocities).
DataType = Literal["rate", "phase"]

# Differences are taken this many at a time: few enough to stay in cache, enough to hide the loop's overhead.
_CHUNK = 2048
# Chunks for which all cluster sizes are computed before the next block is read.
_BLOCK = 32
# Numbers of phases that memory is reserved for at least, so that records of many lengths share a program: of
# short records, of which there may be thousands, and of others.
_LEAST = 1 << 16, 1 << 20
# Samples from which one axis is integrated by several cores.
_LONG = 1 << 18
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

    Args:
        values: rates, or phases (one more than the rate samples) in the rate's unit times seconds.
        sizes: cluster sizes in samples; each must leave a difference (`cluster_sizes`), which is not checked.
        rate: sample rate [Hz]; used with phases only.
        kind, overlapping, data_type: as in `allan_deviation`.

    Blocks of the record are shared out among the cores. Besides the samples, their phases take memory.
    """
    table = np.asarray(values)
    n, axes = len(table) - (data_type == "phase"), table.shape[1]
    every = np.pad(sizes, (0, -len(sizes) % _SIZES))
    cores = os.cpu_count() or 1
    shares = range(min(cores, 1 + n // (_BLOCK * _CHUNK)))
    capacity = _LEAST[0] if n < _LEAST[0] else max(1 << n.bit_length(), _LEAST[1])
    # Memory that is never written costs nothing.
    phases, parts = aligned(min(axes, _TOGETHER), capacity + _CHUNK), list[np.ndarray]()

    def sums_of(task: tuple[int, int]) -> Float[np.ndarray, " m"]:
        arguments = phases[task[0]], every, len(sizes), n, task[1], len(shares)
        with compiled_once((_square_sums, phases.shape[1], len(every), kind, overlapping)):
            return np.asarray(_square_sums(*arguments, kind=kind, overlapping=overlapping))

    with ThreadPoolExecutor(cores) as pool:
        for first in range(0, axes, _TOGETHER):
            rows = np.ascontiguousarray(table[:, first : first + _TOGETHER].T)
            if len(rows) < cores and n > _LONG:
                for x, into in zip(rows, phases, strict=False):
                    _integrate(x, into, data_type, pool.map, len(shares))
            else:
                list(pool.map(lambda x, into: _integrate(x, into, data_type, map, 1), rows, phases))
            parts += pool.map(sums_of, product(range(len(rows)), shares))
    sums = np.reshape(parts, (axes, len(shares), -1)).sum(axis=1).T[: len(sizes)]
    sums = sums * (rate**2 if data_type == "phase" else 1.0)
    scale = 6.0 if kind == "hadamard" else 2.0
    return sums / (scale * difference_count(n, sizes, kind, overlapping) * sizes**2.0)[:, None]


def _integrate(
    x: Float[np.ndarray, " samples"],
    phases: Float[np.ndarray, " capacity"],
    data_type: DataType,
    each: Callable[..., Iterable[Any]],
    stretches: int,
) -> None:
    """Write the phases of an axis, with meaningless values after them; `each` maps over so many stretches.

    A straight line is subtracted, about the one through the ends: it changes no variance, and the differences
    keep more digits without it.
    """
    n = len(x)
    edges = np.linspace(0, n, stretches + 1).astype(int).tolist()

    # Samples may be infinite; all phases are NaN then.
    @np.errstate(invalid="ignore")
    def total(first: int, stop: int) -> float:
        return float(np.sum(x[first:stop], dtype=float))

    @np.errstate(invalid="ignore")
    def add_up(first: int, stop: int, phase: float) -> None:
        own = phases[first + 1 : stop + 1]
        np.subtract(x[first:stop], mean, out=own)
        own[0] += phase
        np.cumsum(own, out=own)

    with np.errstate(invalid="ignore"):
        if data_type == "phase":
            slope = (x[-1] - x[0]) / (n - 1)
            np.subtract(x - x[0], slope * np.arange(n), out=phases[:n])
            return
        sums = list(each(total, edges[:-1], edges[1:]))
        mean, phases[0] = sum(sums) / n, 0.0
        before = np.cumsum([0.0, *sums[:-1]]) - mean * np.array(edges[:-1])
        list(each(add_up, edges[:-1], edges[1:], before))


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

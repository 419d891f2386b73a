"""Allan variance and its relatives: cluster analysis of a static recording.

The estimators are those of Hou (2004), eqs. (4.1)-(4.9), and of NIST SP 1065, section 5. All are the mean
square of a difference of the phase (angle or velocity, the running integral of the rate): the second
difference (Allan), the third (Hadamard), or the second averaged over one cluster time (modified Allan).
"""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Literal, TypeVar, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, ArrayLike, Float, Int

from allanjax.covariance import equivalent_degrees_of_freedom
from allanjax.errors import AllanjaxError
from allanjax.recording import Axis, Recording

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Kind = Literal["allan", "modified", "hadamard"]
DataType = Literal["rate", "phase"]
Spacing = Literal["octave", "decade", "all"] | int | Sequence[float] | Float[np.ndarray, " m"]

_Sizes = TypeVar("_Sizes", np.ndarray, Array)

# Weights of the phases one cluster time apart. The modified variance sums its second differences by their
# increments, which are third differences.
_WEIGHTS = {"allan": (1, -2, 1), "modified": (-1, 3, -3, 1), "hadamard": (-1, 3, -3, 1)}

# Differences are taken this many at a time: few enough to stay in cache, enough to hide the loop's overhead.
_CHUNK = 8192
# Running sums inside a chunk are products with a triangular matrix of this size, which XLA vectorises.
_ROW = 32

# A cluster time may be this far from a whole number of samples, in samples.
_CLUSTER_SIZE_TOLERANCE = 1e-3


# --- Cluster sizes ------------------------------------------------------------------------------------------


def difference_count(n: int, sizes: _Sizes, kind: Kind = "allan", overlapping: bool = True) -> _Sizes:
    """Number of differences that `n` rate samples (n + 1 phases) allow at each cluster size m.

    Overlapping: n + 1 - 2m (Allan), n + 1 - 3m (Hadamard), n + 2 - 3m (modified). Non-overlapping: one less
    (Allan) or two less (Hadamard) than the whole clusters. Hou (2004) eq. (4.5) has N - 2n for the first: it
    leaves out the last difference. Same shape as `sizes`; not positive where there is none.
    """
    if kind == "modified":
        return n + 2 - 3 * sizes
    spans = len(_WEIGHTS[kind]) - 1
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
    _check_member(kind, Kind, "kind")
    largest = {"allan": n // 2, "modified": (n + 1) // 3, "hadamard": n // 3}[kind]
    if largest < 1:
        shortest = 3 if kind == "hadamard" else 2
        raise AllanjaxError(f"{n} samples are too few for the {kind} variance: it needs at least {shortest}")
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


def _sizes_of_times(times: Float[np.ndarray, " m"], rate: float, largest: int) -> Int[np.ndarray, " m"]:
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


# --- The compiled estimator ---------------------------------------------------------------------------------


@partial(jax.jit, static_argnames=("kind", "overlapping", "data_type"))
def allan_variance_estimates(
    values: Float[ArrayLike, "samples axes"],
    sizes: Int[ArrayLike, " m"],
    rate: Float[ArrayLike, ""] = 1.0,
    *,
    kind: Kind = "allan",
    overlapping: bool = True,
    data_type: DataType = "rate",
) -> Float[Array, "m axes"]:
    """Variances at the given cluster sizes, in the square of the rate's unit; compiled once per shape.

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

    Differentiable in `values` in forward mode (`jax.jvp`, `jax.jacfwd`); not in reverse mode, since the loop
    over the differences is only as long as each cluster size needs.
    """
    phases = _phases(jnp.asarray(values, dtype=float), rate, data_type)
    n = phases.shape[0] - 1
    chunk = min(_CHUNK, max(_ROW, 1 << n.bit_length()))
    weights = _WEIGHTS[kind]
    lane = jnp.arange(chunk)
    sizes = jnp.asarray(sizes, dtype=int)

    def differences(x: Array, start: Array, m: Array) -> Array:
        if overlapping:
            parts = [lax.dynamic_slice(x, (start + p * m,), (chunk,)) for p in range(len(weights))]
        else:
            parts = [x.at[(start + lane + p) * m].get(mode="clip") for p in range(len(weights))]
        return sum((w * part for w, part in zip(weights, parts, strict=True)), jnp.zeros(chunk))

    def mean_square(x: Array, m: Array) -> Array:
        count = difference_count(n, m, kind, overlapping)

        def add(k: Array, total: Array) -> Array:
            d = jnp.where(lane < count - k * chunk, differences(x, k * chunk, m), 0)
            return total + d**2

        # One partial sum per lane: XLA does not vectorise a reduction of doubles to a scalar.
        return lax.fori_loop(0, -(-count // chunk), add, jnp.zeros(chunk)).sum() / count

    def mean_square_of_sums(x: Array, x_sums: Array, m: Array) -> Array:
        # The first sum of m second differences comes from sums of the phases, the others by their increments:
        # sums of phases grow so fast that far into the record they would lack the digits.
        first = x_sums[3 * m] - 3 * x_sums[2 * m] + 3 * x_sums[m]
        count = difference_count(n, m, kind)

        def add(k: Array, carry: tuple[Array, Array]) -> tuple[Array, Array]:
            total, previous = carry
            inside = lane < count - 1 - k * chunk
            s = previous + _running_sum(jnp.where(inside, differences(x, k * chunk, m), 0))
            return total + jnp.where(inside, s**2, 0), s[-1]

        total, _ = lax.fori_loop(0, -(-(count - 1) // chunk), add, (jnp.zeros(chunk), first))
        return (total.sum() + first**2) / (count * m.astype(float) ** 2)

    def one_axis(x: Array) -> Array:
        padded = jnp.pad(x, (0, chunk))
        if kind == "modified":
            x_sums = jnp.pad(jnp.cumsum(x), (1, 0))
            return lax.map(lambda m: mean_square_of_sums(padded, x_sums, m), sizes)
        return lax.map(lambda m: mean_square(padded, m), sizes)

    scale = 6 if kind == "hadamard" else 2
    return lax.map(one_axis, phases.T).T / (scale * sizes.astype(float)[:, None] ** 2)


def _phases(values: Array, rate: ArrayLike, data_type: DataType) -> Float[Array, "n+1 axes"]:
    """Phases in the rate's unit times the sample interval, from which the end-to-end line has been taken.

    No estimator sees a straight line, and without it the phases keep more digits for the differences.
    """
    if data_type == "phase":
        samples = values.shape[0] - 1
        line = jnp.arange(samples + 1)[:, None] * ((values[-1] - values[0]) / samples)
        return (values - values[0] - line) * rate
    return jnp.pad(jnp.cumsum(values - values.mean(axis=0), axis=0), ((1, 0), (0, 0)))


def _running_sum(x: Float[Array, " chunk"]) -> Float[Array, " chunk"]:
    rows = x.reshape(-1, _ROW) @ jnp.triu(jnp.ones((_ROW, _ROW)))
    return (rows + jnp.tri(len(rows), k=-1) @ rows[:, -1:]).reshape(-1)


# --- Results ------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class AllanDeviation:
    """Estimated Allan (or modified, or Hadamard) deviation of each axis against the cluster time.

    Attributes:
        cluster_time: [m] cluster times T [s].
        cluster_size: [m] samples per cluster.
        deviation: [m, axes] square root of the variance [rad/s or m/s², or the unit of the array analysed].
        count: [m] differences averaged.
        edf: [m, axes] equivalent degrees of freedom of the variance.
        kind: "allan", "modified" or "hadamard".
        overlapping: whether the clusters overlap.
        n: rate samples per axis.
        rate: sample rate [Hz].
        axes: the recording's axes, or None for an array.
    """

    cluster_time: Float[np.ndarray, " m"]
    cluster_size: Int[np.ndarray, " m"]
    deviation: Float[np.ndarray, "m axes"]
    count: Int[np.ndarray, " m"]
    edf: Float[np.ndarray, "m axes"]
    n: int
    rate: float
    kind: Kind = "allan"
    overlapping: bool = True
    axes: tuple[Axis, ...] | None = None

    @property
    def variance(self) -> Float[np.ndarray, "m axes"]:
        """Square of the deviation."""
        return self.deviation**2

    @property
    def standard_error(self) -> Float[np.ndarray, "m axes"]:
        """Standard error of the deviation, to first order: deviation / √(2 edf)."""
        return self.deviation / np.sqrt(2 * self.edf)

    @property
    def thesis_relative_error(self) -> Float[np.ndarray, " m"]:
        """Relative error of the deviation by Hou (2004) eq. (4.66): 1 / √(2 (n/m − 1)).

        It holds for non-overlapping clusters, whereas eqs. (4.5) and (4.9) average overlapping ones: it
        overstates their error. `standard_error` is the better figure.
        """
        return 1 / np.sqrt(2 * (self.n / self.cluster_size - 1))

    def confidence_interval(
        self, level: float = 0.95
    ) -> tuple[Float[np.ndarray, "m axes"], Float[np.ndarray, "m axes"]]:
        """Lower and upper end of the central interval of the deviation, as if edf · s²/σ² had the χ² law.

        Raises:
            AllanjaxError: `level` not between 0 and 1.
        """
        from scipy.stats import chi2

        if not 0 < level < 1:
            raise AllanjaxError(f"the confidence level must lie between 0 and 1, not {level}")
        lower = self.deviation * np.sqrt(self.edf / chi2.ppf((1 + level) / 2, self.edf))
        upper = self.deviation * np.sqrt(self.edf / chi2.ppf((1 - level) / 2, self.edf))
        return lower, upper

    def plot(self, axes: Sequence[str] | None = None, path: str | os.PathLike[str] | None = None) -> "Figure":
        """Draw the deviations with their 68 % intervals; see `plot_allan`."""
        from allanjax.plot import plot_allan

        return plot_allan(self, axes, path)

    def __repr__(self) -> str:
        overlap = "overlapping" if self.overlapping else "non-overlapping"
        names = ", ".join(axis.name for axis in self.axes) if self.axes else f"{self.deviation.shape[1]} axes"
        first, last = self.cluster_time[[0, -1]]
        return (
            f"AllanDeviation({self.kind}, {overlap}; {names}; {self.n} samples at {self.rate:.6g} Hz; "
            f"{len(self.cluster_time)} cluster times from {first:.4g} s to {last:.4g} s)"
        )


def allan_deviation(
    data: Recording | Float[ArrayLike, " samples"] | Float[ArrayLike, "samples axes"],
    rate: float | None = None,
    *,
    data_type: DataType = "rate",
    kind: Kind = "allan",
    overlapping: bool = True,
    cluster_times: Spacing = "octave",
) -> AllanDeviation:
    """Allan deviation of every axis, Hou (2004) eqs. (4.5) and (4.9), or its modified or Hadamard variant.

    Args:
        data: a recording, or equally spaced samples of one or several axes.
        rate: sample rate [Hz], for an array only: a recording has its own.
        data_type: "rate", or "phase" for an array of angles or velocities.
        kind: "allan", "modified" (always overlapping) or "hadamard".
        overlapping: average over every start of a cluster, or only over every m-th.
        cluster_times: spacing of the cluster times, or these times [s]; see `cluster_sizes`.

    The degrees of freedom are those of white noise, the noise that most of the curve's short end shows.

    Raises:
        AllanjaxError: no rate or not a positive one, samples that are not finite, too few of them, an unknown
            option, or a cluster time that the data do not allow.
    """
    _check_member(kind, Kind, "kind")
    _check_member(data_type, DataType, "data_type")
    if kind == "modified" and not overlapping:
        raise AllanjaxError("the modified Allan variance is defined for overlapping clusters only")
    if isinstance(data, Recording):
        if rate is not None or data_type != "rate":
            raise AllanjaxError("a recording has its own rate and holds rates: leave out rate and data_type")
        samples, rate, axes = data.values, data.rate, data.axes
    else:
        samples, axes = np.asarray(data, dtype=float), None
    if rate is None:
        raise AllanjaxError("an array needs its sample rate: give rate in Hz")
    if not 0 < rate < np.inf:
        raise AllanjaxError(f"the sample rate must be positive and finite, not {rate}")
    values = _checked_values(samples)
    n = values.shape[0] - (data_type == "phase")
    sizes = cluster_sizes(n, rate, cluster_times, kind)
    variance = allan_variance_estimates(
        values, sizes, rate, kind=kind, overlapping=overlapping, data_type=data_type
    )
    edf = np.asarray(equivalent_degrees_of_freedom(n, rate, sizes, kind, overlapping))
    return AllanDeviation(
        cluster_time=sizes / rate,
        cluster_size=sizes,
        deviation=np.sqrt(np.asarray(variance)),
        count=difference_count(n, sizes, kind, overlapping),
        edf=np.broadcast_to(edf.reshape(len(sizes), -1), variance.shape),
        n=n,
        rate=float(rate),
        kind=kind,
        overlapping=overlapping,
        axes=axes,
    )


def _checked_values(values: Float[np.ndarray, "..."]) -> Float[np.ndarray, "samples axes"]:
    if values.ndim == 1:
        values = values[:, None]
    if values.ndim != 2 or values.shape[1] == 0:
        raise AllanjaxError(f"data must have the shape [samples] or [samples, axes], not {values.shape}")
    bad = ~np.isfinite(values)
    if bad.any():
        row, column = np.argwhere(bad)[0]
        raise AllanjaxError(
            f"{bad.sum()} values are not finite, the first at sample {row}, axis {column}: "
            "the cluster averages need every sample"
        )
    return values


def _check_member(value: str, literal: object, name: str) -> None:
    known = get_args(literal)
    if value not in known:
        raise AllanjaxError(f"unknown {name} {value!r}: expected one of {', '.join(map(repr, known))}")

"""Cluster sizes that a record allows, and the number of differences that each leaves."""

from collections.abc import Sequence
from typing import Any, Literal, TypeVar, get_args

import numpy as np
from jaxtyping import Array, Float, Int

from allanjax.base.errors import AllanjaxError

#: Kinds of variances.
Kind = Literal["allan", "modified", "hadamard"]
#: Spacings of cluster sizes, explained at `cluster_sizes`.
Spacing = Literal["octave", "decade", "all"] | int | Sequence[float] | Float[np.ndarray, " m"]

_Sizes = TypeVar("_Sizes", np.ndarray, Array)

WEIGHTS = {"allan": (1, -2, 1), "modified": (-1, 3, -3, 1), "hadamard": (-1, 3, -3, 1)}
"""Weights of the phases one cluster time apart in the difference that each variance is the mean square of.

The modified variance sums second differences; these sums are updated by third differences, given here.
"""

# Largest distance of a cluster time from a whole number of samples, in samples: room for rounding.
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

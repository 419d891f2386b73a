"""Covariance and degrees of freedom of Allan variance estimates under a noise model.

For a Gaussian process with phase covariance G, the overlapping estimates V_i at cluster sizes m_i, of
M_i = N + 1 − 2m_i differences each (N rate samples), have

    cov(V_i, V_j) = [1/(4 T_i² T_j² M_i M_j)] Σ_s w_ij(s)·2 C_ij(s)²,
    C_ij(s) = Σ_{p,q∈{0,1,2}} a_p a_q G((s + p·m_i − q·m_j)·t0),    a = (1, −2, 1),

where w_ij(s) counts the pairs of differences at lag s. Both C_ij and w_ij are even about s = m_j − m_i; with
u the distance from there,

    C_ij(u) = 4G(u) − 2G(u ± m_i) − 2G(u ± m_j) + G(u ± m_i ± m_j),
    w_ij(u) = min(M_i, M_j, N + 1 − m_i − m_j − u).

Between the points u = 0, m_i, m_j − m_i, m_j, m_i + m_j both are smooth (polynomials for quantization, random
walks and ramps), so the sum over the integers between two such points is a Gauss quadrature of the counting
measure: exact for those terms, and of the same cost for any cluster size.

Estimates that take every s_i-th start only (the pyramid's) have M_i = ⌊(N − 2m_i)/s_i⌋ + 1 differences. Where
s_i divides m_i, and the stride s_j of the larger clusters, the lags are the multiples of s_i, and

    w_ij(u) = M_j − ⌈(u − m_j + m_i − d)/s_j⌉ where that is less than M_j,

with d = 0 for the lags on one side of m_j − m_i and d = (N mod s_j) − (N mod s_i) for those on the other.

A deterministic part μ of the differences (a ramp, a line) adds 4μμ'C and no 2μ²μ'²: its own square does not
scatter from record to record.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any, TypeAlias

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from allanjax.base.arrays import namespace
from allanjax.noise.process import Process

# Quadrature nodes between two neighbouring kinks; 8 sum polynomials up to degree 15 exactly.
_ORDER = 8
# Longer sums than this are approximated by an integral where more than twice as many nodes are asked for.
_LONG_SUM = 256
# Terms with a memory longer than a cluster (resonances, flicker with a cutoff) leave C_ij a tail. It is
# summed over ever longer intervals that end at these multiples of m_i + m_j; the rest is left out.
_TAIL = (2, 5, 20, 80, 320)


def discrete_gauss(
    count: Int[np.ndarray, ...], order: int = _ORDER
) -> tuple[Float[np.ndarray, "... order"], Float[np.ndarray, "... order"]]:
    """Quadrature nodes and weights for the sum of a function over the integers 0 … count−1.

    Gauss quadrature of the counting measure (Golub & Welsch 1969, with the recurrence of the discrete
    Chebyshev polynomials): exact for polynomials up to degree 2·order − 1, and for every function where
    count ≤ order. Weights are zero where count ≤ 0.
    """
    counts, which = np.unique(np.maximum(np.asarray(count), 0), return_inverse=True)
    N = counts[:, None].astype(float)
    x, w = np.polynomial.legendre.leggauss(order)
    nodes, weights = (N * (x + 1.0) - 1.0) / 2.0, N * w / 2.0
    # A long sum is an integral, to 1/(24·count²), which saves large eigenvalue problems.
    exact = counts <= (_LONG_SUM if order > 2 * _ORDER else np.inf)
    k, N = np.arange(1, order), N[exact]
    beta = np.maximum(k**2 * (N**2 - k**2) / (4.0 * (4.0 * k**2 - 1.0)), 0.0)
    jacobi = np.zeros((len(N), order, order))
    jacobi[:, k - 1, k] = jacobi[:, k, k - 1] = np.sqrt(beta)
    values, vectors = np.linalg.eigh(jacobi)
    few, integers = order >= N, np.arange(order)
    nodes[exact] = np.where(few, integers, values + (N - 1.0) / 2.0)
    weights[exact] = np.where(few, integers < N, N * vectors[:, 0, :] ** 2)
    shape = (*np.shape(count), order)
    return nodes[which].reshape(shape), weights[which].reshape(shape)


def _sum_over_lags(
    kinks: Int[np.ndarray, "pairs k"], support: Int[np.ndarray, " pairs"], order: int = _ORDER
) -> tuple[Float[np.ndarray, "pairs lags"], Float[np.ndarray, "pairs lags"]]:
    """Quadrature nodes u ≥ 0 and weights for the sum of an even function over integers |u| < support.

    The function is smooth between `kinks` (which include 0); the last kink ends the sum.
    """
    ends = np.sort(np.minimum(kinks, support[:, None] - 1), axis=1)
    first_of_its_kind = np.diff(ends, axis=1, prepend=-1) > 0
    nodes, weights = discrete_gauss(np.diff(ends, axis=1) - 1, order)
    nodes = nodes + ends[:, :-1, None] + 1
    u = np.concatenate([ends, nodes.reshape(len(ends), -1)], axis=1)
    w = np.concatenate([first_of_its_kind, weights.reshape(len(ends), -1)], axis=1)
    return u, np.where(u > 0, 2.0, 1.0) * w


def padded_quadrature(
    n: int,
    rate: float,
    sizes: Int[np.ndarray, " m"],
    capacity: int,
    lags: Float[np.ndarray, "lags pairs"],
    weights: Float[np.ndarray, "lags pairs"],
) -> dict[str, Any]:
    """Fields of an `AllanCovariance` with these sizes, lags and weights, padded to a capacity of sizes."""
    i, j = np.triu_indices(len(sizes))
    size = max(capacity, len(sizes))
    # What is padded has no weight.
    place = np.full((size, size), min(len(i), size * (size + 1) // 2 - 1))
    place[i, j] = place[j, i] = np.arange(len(i))
    more = ((0, 0), (0, size * (size + 1) // 2 - len(i)))
    return {
        "sample_interval": np.asarray(1.0 / rate),
        "duration": np.asarray(n / rate),
        "count": np.asarray(len(sizes)),
        "sizes": np.pad(sizes.astype(float), (0, size - len(sizes)), constant_values=1.0),
        "pairs": np.pad(np.stack([i, j]), more),
        "place": place,
        "lags": np.pad(lags, more),
        "weights": np.pad(weights, more),
    }


class AllanCovariance(eqx.Module):
    """Quadrature for the covariance of Allan variance estimates: its part that is common to all models.

    All fields are data: a program compiled for one record serves every record with any number of cluster
    sizes up to `capacity`, to which the arrays are padded.

    Attributes:
        sample_interval, duration: t0, and the length of the record [s].
        count, sizes: number of cluster sizes, and these in samples, increasing; the rest is padding.
        pairs: row and column of each pair with i ≤ j.
        place: index of the pair for each two estimates.
        lags, weights: distances u of the quadrature nodes, in samples, and their weights, which include w_ij
            and the factors before the sum.
    """

    sample_interval: Float[np.ndarray, ""]
    duration: Float[np.ndarray, ""]
    count: Int[np.ndarray, ""]
    sizes: Float[np.ndarray, " m"]
    pairs: Int[np.ndarray, "2 pairs"]
    place: Int[np.ndarray, "m m"]
    lags: Float[np.ndarray, "lags pairs"]
    weights: Float[np.ndarray, "lags pairs"]

    @classmethod
    def of(
        cls,
        n: int,
        rate: float,
        sizes: Int[np.ndarray, " m"],
        order: int = _ORDER,
        strides: Int[np.ndarray, " m"] | None = None,
        capacity: int = 0,
    ) -> AllanCovariance:
        """Quadrature for estimates at these cluster sizes [samples] of n rate samples at `rate` [Hz].

        The order is the number of nodes between two neighbouring kinks. Strides are samples from one start of
        a cluster to the next, each a divisor of its cluster size and of the strides after it; by default 1,
        for overlapping estimates.
        """
        sizes = np.asarray(sizes, np.int64)
        strides = np.ones_like(sizes) if strides is None else np.asarray(strides, np.int64)
        # Counts of pairs have steps, which only a node for each lag within a cluster sums exactly.
        order = max(order, int(np.max(sizes // strides, initial=0, where=strides > 1)))
        i, j = np.triu_indices(len(sizes))
        mi, mj, si, sj = sizes[i], sizes[j], strides[i], strides[j]
        Mi, Mj = (n - 2 * mi) // si + 1, (n - 2 * mj) // sj + 1
        both, shift = mi + mj, n % sj - n % si
        kinks = np.stack([0 * mi, mi, mj - mi, mj, both, *(reach * both for reach in _TAIL)], axis=1)
        support = mj - mi + shift + (Mj - 1) * sj + si
        u, w = _sum_over_lags(kinks // si[:, None], support // si, order)
        u, factor = (u * si[:, None]).T, 2.0 / (4.0 * (mi / rate) ** 2 * (mj / rate) ** 2 * Mi * Mj)
        # In the tail nodes are far apart and stand for the mean of the steps; equal strides have no steps.
        stepped, overlaps = (si < sj) & (u <= both), 0.0
        for shifted in (0 * shift, shift):
            beyond = (u - (mj - mi) - shifted) / sj
            steps = np.where(stepped, np.ceil(beyond), beyond + (1.0 - si / sj) / 2.0)
            overlaps += np.clip(Mj - steps, 0.0, Mj)
        return cls(**padded_quadrature(n, rate, sizes, capacity, u, factor * w.T * overlaps / 2.0))

    @property
    def rate(self) -> float:
        """Sample rate [Hz]."""
        return float(1.0 / self.sample_interval)

    @property
    def n(self) -> int:
        """Number of samples."""
        return round(float(self.duration / self.sample_interval))

    @property
    def cluster_time(self) -> Float[np.ndarray, " m"]:
        """Cluster times [s]."""
        return self.sizes * self.sample_interval

    def of_pairs(self, first: ArrayLike, count: int) -> AllanCovariance:
        """The quadrature for a few pairs only, from this one on."""
        arrays = (jax.lax.dynamic_slice_in_dim(x, first, count, 1) for x in self._by_pair)
        return eqx.tree_at(lambda of: of._by_pair, self, tuple(arrays))

    def chosen(self, pairs: Bool[np.ndarray, " pairs"] | slice) -> AllanCovariance:
        """The quadrature for these pairs only, in arrays of NumPy."""
        return eqx.tree_at(lambda of: of._by_pair, self, tuple(x[:, pairs] for x in self._by_pair))

    @property
    def _by_pair(self) -> tuple[np.ndarray, ...]:
        return self.pairs, self.lags, self.weights

    def kernel(self, term: Process) -> Float[Array, "lags pairs"]:
        """C_ij(u) of one noise term at the quadrature's lags; of NumPy or JAX, as the lags are."""
        xp = namespace(self.lags, self.pairs, term)
        mi, mj = xp.asarray(self.sizes)[xp.asarray(self.pairs)]
        offsets = xp.stack([0 * mi, mi, -mi, mj, -mj, mi + mj, mi - mj, mj - mi, -mi - mj], axis=-1)
        coefficient = xp.asarray([4.0, -2.0, -2.0, -2.0, -2.0, 1.0, 1.0, 1.0, 1.0])
        # A row for each lag: the constants of G are those of a row.
        lag = abs(xp.asarray(self.lags)[..., None] + offsets) * self.sample_interval
        return term.phase_covariance(lag) @ coefficient

    def mean(self, term: Process) -> Float[Array, " m"]:
        """Allan variance of a term [rate²]; zero where there is no estimate."""
        xp = namespace(self.sizes, term)
        there = xp.arange(len(self.sizes)) < self.count
        return xp.where(there, term.allan_variance(self.cluster_time), 0.0)

    def moments(self, terms: Sequence[Process]) -> tuple[Float[Array, " m"], Float[Array, " pairs"]]:
        """Expectation [rate²] of the estimates for a sum of sampled terms, and covariance of each pair."""
        still = [term.deterministic or term.narrow_band for term in terms]
        kernels = [self.kernel(term) for term in terms]
        total, alone = sum(kernels, np.zeros(self.lags.shape)), sum(itertools.compress(kernels, still))
        by_pair = (self.weights * (total**2 - alone**2)).sum(axis=0)
        by_pair += sum(self.narrow_band_scatter(term) for term in terms if term.narrow_band)
        mean: Any = sum(map(self.mean, terms), np.zeros(len(self.sizes)))
        return mean, by_pair

    def narrow_band_scatter(self, term: Process) -> Float[Array, " pairs"]:
        """Covariance of the estimates of a narrow-band term alone.

        Its power fluctuates as a whole, which all estimates share; the overlaps within an estimate add as
        much again (70/36 − 1 when clusters outlast the oscillation), and long clusters see it as white noise.
        """
        i, j = self.pairs
        mean = self.mean(term)
        common = term.power_scatter(self.duration)
        clusters = self.cluster_time[i] / self.duration
        return mean[i] * mean[j] * (common + (i == j) * (common + 1.5 * clusters))


_Lags: TypeAlias = Float[np.ndarray, "*lags"]
# Autocorrelation of the weights (1, −2, 1) and (1, −3, 3, −1) at 0, 1, … clusters.
_FILTERS = {"allan": (6.0, -4.0, 1.0), "modified": (6.0, -4.0, 1.0), "hadamard": (20.0, -15.0, 6.0, -1.0)}
# Samples per cluster beyond which a record is thinned for the degrees of freedom of the modified variance.
_FINEST_MODIFIED = 64


def equivalent_degrees_of_freedom(
    n: int, sizes: Int[np.ndarray, " m"], kind: str = "allan", strides: Int[np.ndarray, " m"] | None = None
) -> Float[np.ndarray, " m"]:
    """Degrees of freedom 2·E[V]²/Var[V] of Allan, modified or Hadamard variances V of white rate noise.

    Strides are samples from one start of a cluster to the next, each a divisor of its size; by default 1.
    The lag sum is that of this module's covariance. For a modified variance with more than 64 samples per
    cluster, the record is thinned to 64 (exact for self-similar noise, close for others).
    """
    if kind == "modified":
        return np.array([_modified_edf(n, m) for m in sizes.tolist()])
    if strides is None:
        strides = np.ones_like(sizes)
    reach = len(_FILTERS[kind])
    M = (n - (reach - 1) * sizes) // strides + 1
    kinks = np.array([*range(reach), *(multiple * reach for multiple in _TAIL)])
    u, w = _sum_over_lags(kinks * (sizes // strides)[:, None], np.maximum(M, 1))
    total = _differenced(u * strides[:, None], sizes[:, None], kind)
    return M**2 * total[:, 0] ** 2 / (w * (M[:, None] - u) * total**2).sum(axis=1)


def _differenced(lag: _Lags, m: Int[np.ndarray, "*lags"] | int, kind: str) -> _Lags:
    """Covariance of two differences at a lag, up to a factor, under white rate noise: G(s) ∝ −|s|."""
    alpha = _FILTERS[kind]
    steps = range(1 - len(alpha), len(alpha))
    return sum((-alpha[abs(d)] * np.abs(lag + d * m) for d in steps), np.zeros(lag.shape))


def _modified_edf(n: int, m: int) -> float:
    """Equivalent degrees of freedom of the modified variance at one cluster size m."""
    thin = max(1.0, m / _FINEST_MODIFIED)
    n, m = round(n / thin), round(m / thin)
    M = n + 2 - 3 * m
    u = np.arange(min(M, 4 * m)).astype(float)
    inner = np.arange(-m + 1.0, m)
    total = _differenced(u[:, None] + inner, m, "modified") @ ((m - np.abs(inner)) / m**2)
    scatter = (np.where(u > 0, 2.0, 1.0) * (M - u) * total**2).sum()
    return float(M**2 * total[0] ** 2 / scatter)

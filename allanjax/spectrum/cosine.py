"""The cosine spectrum of a record: levels whose law, under any model, is known almost exactly.

The orthonormal cosine transform (DCT-II) of n rate samples has coefficients

    c_j = √(2/n) Σ_k x_k cos(a_j (k + ½)),    a_j = πj/n,    j = 1 … n−1,

at frequencies j·rate/2n. The bias is in c_0 alone and leaves with it. White noise and a random walk have
uncorrelated coefficients exactly (the mean-free random walk's principal components *are* cosines), flicker
and Markov noise almost: the squared correlations of a coefficient with all others sum to 3 % (flicker) and at
most 9 % (Markov) at the lowest frequency, to 0.1 % at the sixtieth. Quantization is an exception: its first
and its last reading are in all coefficients, which matters where hardly any other noise is. So this is
Whittle's likelihood without what makes it approximate for drifting sensors: the periodogram of the
differenced record, its usual form, has leakage from the record's ends that is common to all low frequencies.

The expectation of c_j² follows from the phase covariance G (`noise.model`) without approximation,

    E c_j² = −(1/h²) Σ_s G(s·h) δ²r_j(s),   r_j(d) = (1 − d/n) cos(a_j d) − sin(a_j d)/(n sin a_j),

h being the sample interval, r_j the autocorrelation of the cosine and δ² its second difference. That is
done for the lowest frequencies, where the record's finite length matters; above, E c_j² is rate times the
PSD of the samples, aliases included. High frequencies are averaged in bins: c_j² over its expectation is
χ² with one degree of freedom, and the mean of k of them has k.
"""

from __future__ import annotations

import abc
from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from allanjax.allan.covariance import discrete_gauss
from allanjax.base.errors import FitError
from allanjax.noise.parameter import Value
from allanjax.noise.terms import DriftRamp, NoiseTerm

# Coefficients up to this one are a bin each, and have their exact expectation.
_SINGLE = 64
#: Bins an octave above these.
PER_OCTAVE = 6
# Nodes of the quadratures over lags, between two of their edges, and over a bin.
_LAG_ORDER = 12
_BIN_ORDER = 3
# Lags of pooled spectra are padded to a multiple of this, so that compiled functions are used again.
_LAGS = 128
# Single coefficients on either side of a line, and the factor by which bins grow beyond.
_AROUND = 12
_GROWTH = 1.25


def cosine_transform(x: Float[np.ndarray, "n ..."]) -> Float[np.ndarray, "n-1 ..."]:
    """Cosine coefficients c_1 … c_{n−1} of samples, along the first axis."""
    from scipy.fft import dct

    return dct(x, type=2, norm="ortho", axis=0, workers=-1)[1:]


class Bins(eqx.Module):
    """Bins of cosine coefficients, of one transform or pooled over several.

    Attributes:
        n: number of samples.
        rate: sample rate [Hz].
        size: number of coefficients in each bin; 0 for bins that only pad the array.
    """

    n: eqx.AbstractVar[Any]
    rate: eqx.AbstractVar[float]
    size: eqx.AbstractVar[Int[np.ndarray, " m"]]

    @property
    @abc.abstractmethod
    def frequency(self) -> Float[np.ndarray, " m"]:
        """Middle of each bin [Hz]."""

    @abc.abstractmethod
    def expected(self, term: NoiseTerm) -> Float[Array, " m"]:
        """Mean expected square [rate²] of the coefficients in each bin; zero for a deterministic term."""


class CosineBins(Bins):
    """Bins of the coefficients of n samples, and the quadratures for their expectation under a noise term.

    Attributes:
        n: number of samples.
        rate: sample rate [Hz].
        size: number of coefficients in each bin; 0 for bins that only pad the array.
        first: index j of each bin's first coefficient.
        lags, lag_weights: lags [s], and weights of G there in the expectation of the single coefficients.
        nodes, node_weights: frequencies [Hz] in each bin, and weights of the density there.
    """

    n: int = eqx.field(static=True)
    rate: float = eqx.field(static=True)
    size: Int[np.ndarray, " m"]
    first: Int[np.ndarray, " m"]
    lags: Float[np.ndarray, " lags"]
    lag_weights: Float[np.ndarray, "low lags"]
    nodes: Float[np.ndarray, "m order"]
    node_weights: Float[np.ndarray, "m order"]

    @classmethod
    def of(cls, n: int, rate: float, around: tuple[float, ...] = ()) -> CosineBins:
        """Bins of single coefficients, then six an octave; finer ones around lines at `around` [Hz]."""
        top = min(_SINGLE, n - 1)
        octaves = np.log2(n / top)
        growing = top * 2.0 ** (np.arange(1, np.floor(PER_OCTAVE * octaves)) / PER_OCTAVE)
        edges = np.concatenate([np.arange(1, top + 2), np.rint(growing) + 1.0])
        steps = np.arange(1.0, _AROUND + 1.0)
        while steps[-1] * (_GROWTH - 1.0) < n / 16.0:
            steps = np.append(steps, np.ceil(steps[-1] * _GROWTH))
        for f in around:
            j = np.rint(2.0 * n * f / rate)
            # Farther out they would be wider than the logarithmic bins.
            near = steps[steps < max(0.6 * j, _AROUND + 1.0)]
            edges = np.concatenate([edges, j - near + 1.0, j + near])
        edges = np.unique(edges[(edges > top + 1) & (edges < n)])
        edges = np.concatenate([np.arange(1, top + 2), edges, [n]]).astype(int)
        first, size = edges[:-1], np.diff(edges)
        first, size = first[size > 0], size[size > 0]
        # The number of bins does not depend on where the lines are, so that compiled functions are used
        # again.
        most = top + int(PER_OCTAVE * octaves) + 1 + 2 * len(steps) * len(around)
        pad = most - len(first)
        first, size = np.append(first, np.full(pad, n // 2)), np.append(size, np.zeros(pad, int))
        nodes, weights = discrete_gauss(np.maximum(size, 1), _BIN_ORDER)
        lags, lag_weights = exact_expectation(n, rate, top)
        nodes = (first[:, None] + nodes) * rate / (2.0 * n)
        weights = weights * rate / np.maximum(size, 1)[:, None]
        return cls(n, rate, size, first, lags, lag_weights, nodes, weights)

    @property
    def frequency(self) -> Float[np.ndarray, " m"]:
        """Middle of each bin [Hz]."""
        return (self.first + (self.size - 1) / 2.0) * self.rate / (2.0 * self.n)

    def expected(self, term: NoiseTerm) -> Float[Array, " m"]:
        return _expected(term, self)

    def sums(self, products: Float[np.ndarray, "n-1 ..."]) -> Float[np.ndarray, "m ..."]:
        """Sums of products of coefficients over each bin."""
        real = self.size > 0
        found = np.zeros((len(self.first), *products.shape[1:]))
        found[real] = np.add.reduceat(products, self.first[real] - 1, axis=0)
        return found

    def statistics(
        self, c: Float[np.ndarray, "n-1 axes"], ramp: Float[np.ndarray, " n-1"]
    ) -> SpectralStatistics:
        """Statistics [axes, m] of axes with these coefficients, and of a ramp with these."""
        squares, cross, gram = (self.sums(x) for x in (c**2, c * ramp[:, None], ramp**2))
        return SpectralStatistics(squares.T, cross.T, np.broadcast_to(gram, squares.T.shape))


class _Transform(eqx.Module):
    """Quadratures of one transform as in `CosineBins`, with length and rate as data, not compiled in."""

    n: Value
    rate: Value
    lags: Float[np.ndarray, " lags"]
    lag_weights: Float[np.ndarray, "low lags"]
    nodes: Float[np.ndarray, "m order"]
    node_weights: Float[np.ndarray, "m order"]

    @classmethod
    def of(cls, n: int, rate: float, edges: Int[np.ndarray, " m+1"]) -> _Transform:
        """Quadratures for bins with these edges of the transform of n samples."""
        size = np.diff(edges)
        nodes, weights = discrete_gauss(size, _BIN_ORDER)
        nodes = (edges[:-1, None] + nodes) * rate / (2.0 * n)
        lags, lag_weights = np.zeros(0), np.zeros((0, 0))
        if edges[0] == 1:
            lags, lag_weights = exact_expectation(n, rate, _SINGLE)
            pad = -len(lags) % _LAGS
            lags, lag_weights = np.pad(lags, (0, pad)), np.pad(lag_weights, ((0, 0), (0, pad)))
        return cls(
            np.asarray(float(n)), np.asarray(rate), lags, lag_weights, nodes, weights * rate / size[:, None]
        )


class PooledBins(Bins):
    """Bins of several transforms, each of many segments that share its bins.

    Attributes:
        n: number of samples of the stream.
        rate: its sample rate [Hz].
        size: number of coefficients in each bin, of all segments together.
        middle: middle of each bin [Hz], increasing.
        transforms: the quadratures of each transform.
    """

    n: Int[np.ndarray, ""]
    rate: float = eqx.field(static=True)
    size: Int[np.ndarray, " m"]
    middle: Float[np.ndarray, " m"]
    transforms: tuple[_Transform, ...]

    @classmethod
    def of(cls, n: int, rate: float, parts: Sequence[Part]) -> PooledBins:
        """Bins of these parts of the spectrum, the lowest frequencies first."""
        size = np.concatenate([part.segments * np.diff(part.edges) for part in parts])
        middle = [(p.edges[:-1] + p.edges[1:] - 1) * p.rate / (4.0 * p.n) for p in parts]
        transforms = tuple(_Transform.of(part.n, part.rate, part.edges) for part in parts)
        return cls(np.asarray(n), rate, size, np.concatenate(middle), transforms)

    @property
    def frequency(self) -> Float[np.ndarray, " m"]:
        return self.middle

    def expected(self, term: NoiseTerm) -> Float[Array, " m"]:
        return jnp.concatenate([_expected(term, transform) for transform in self.transforms])


class Part(NamedTuple):
    """Part of a pooled spectrum: the transforms of segments of one length and rate.

    Attributes:
        n: number of values in a segment.
        rate: their rate [Hz].
        edges: first coefficients of the bins, and the one after the last. They begin at 1, with bins of
            single coefficients up to 64, or well above.
        segments: number of segments.
    """

    n: int
    rate: float
    edges: Int[np.ndarray, " m+1"]
    segments: int


def bin_edges(first: int, stop: int, bins: int) -> Int[np.ndarray, " bins+1"]:
    """Edges of logarithmic bins of the coefficients first … stop−1; single up to 64 if first is 1."""
    single = np.arange(1, _SINGLE + 1) if first == 1 else np.zeros(0, int)
    rest = np.rint(np.geomspace(first + len(single), stop, bins - len(single) + 1)).astype(int)
    return np.append(single, rest)


def _expected(term: NoiseTerm, of: CosineBins | _Transform) -> Float[Array, " m"]:
    """Mean expected square [rate²] of the coefficients in each bin: exact for the lowest ones."""
    above = _from_density(term, of)
    # An oscillating covariance needs too many lags; its difference from a smooth one has a short memory.
    smooth = term.at_low_frequencies() if term.oscillates else term
    if smooth is None or term.deterministic or not of.lags.size:
        return above
    low = jnp.asarray(of.lag_weights) @ smooth.phase_covariance(jnp.asarray(of.lags))
    if smooth is not term:
        low += (above - _from_density(smooth, of))[: len(low)]
    return above.at[: len(low)].set(low)


def _from_density(term: NoiseTerm, of: CosineBins | _Transform) -> Float[Array, " m"]:
    """Mean expected square [rate²] from the density of the samples, but for the record's finite length."""
    density = term.sampled_psd(of.nodes, of.rate)
    density += term.end_effect(of.nodes, of.rate) / (of.n * of.rate)
    return jnp.sum(of.node_weights * density, axis=1)


def exact_expectation(
    n: int, rate: float, top: int
) -> tuple[Float[np.ndarray, " lags"], Float[np.ndarray, "top lags"]]:
    """Lags [s], and weights of G there whose sum is the exact E c_j² for j = 1 … top."""
    spacing = max(n // (top // 2), 1)
    edges = np.concatenate([2.0 ** np.arange(np.log2(spacing)), np.linspace(spacing, n, max(top // 2, 1))])
    edges = np.unique(np.rint(edges)).astype(int)
    nodes, weights = discrete_gauss(np.diff(edges), _LAG_ORDER)
    s = (edges[:-1, None] + nodes).ravel()
    used = weights.ravel() > 0.0
    s, w = s[used], weights.ravel()[used]
    j = np.arange(1, top + 1)[:, None]
    a = np.pi * j / n
    curvature = 4.0 * np.sin(a / 2.0) ** 2
    # δ²r_j(s) between its kinks at 0 and n, where a one-sided difference is left.
    inside = -curvature * (1.0 - s / n) * np.cos(a * s)
    inside += (2.0 * np.sin(a) + curvature / np.sin(a)) / n * np.sin(a * s)
    at_zero = 2.0 * ((1.0 - 1.0 / n) * np.cos(a) - 1.0 / n - 1.0)
    at_end = np.where(j % 2, -1.0, 1.0) * (1.0 + np.cos(a)) / n
    all_weights = -(rate**2) * np.concatenate([at_zero, 2.0 * w * inside, 2.0 * at_end], axis=1)
    return np.concatenate([[0.0], s, [n]]) / rate, all_weights


class SpectralStatistics(NamedTuple):
    """Sufficient statistics of an axis (or of several, stacked) for Whittle's likelihood, as sums over bins.

    Attributes:
        squares: sums of c_j².
        cross: sums of c_j times the coefficient of a ramp.
        gram: sums of the ramp's squared coefficients.
    """

    squares: Any
    cross: Any
    gram: Any


def term_column(term: NoiseTerm, n: int, rate: float) -> Float[np.ndarray, " n-1"]:
    """Cosine coefficients of a deterministic term of unit amplitude (`NoiseTerm.column`) in n samples.

    Raises:
        FitError: it does not vary within the record, and so is part of the bias.
    """
    column = np.asarray(term.column((np.arange(n) + 0.5) / rate))
    if not np.ptp(column) > 0.0:
        raise FitError(
            f"{term.name()} does not vary within the record of {n / rate:g} s; leave it out, or give times "
            "since the record's start"
        )
    return cosine_transform(column)


def ramp_column(n: int, rate: float) -> Float[np.ndarray, " n-1"]:
    """Cosine coefficients of a ramp of 1 per second in n samples."""
    return term_column(DriftRamp(), n, rate)

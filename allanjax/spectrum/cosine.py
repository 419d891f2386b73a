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

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from allanjax.allan.covariance import discrete_gauss
from allanjax.base.equality import ByValue
from allanjax.base.errors import FitError
from allanjax.noise.terms import DriftRamp, NoiseTerm

# Coefficients up to this one are a bin each, and have their exact expectation.
_SINGLE = 64
#: Bins an octave above these.
PER_OCTAVE = 6
# Nodes of the quadratures over lags, between two of their edges.
_LAG_ORDER = 12
# Bins on either side of a line that are of one width; and the factor by which they grow beyond.
_AROUND = 12
_GROWTH = 1.25


def cosine_transform(x: Float[np.ndarray, "n ..."]) -> Float[np.ndarray, "n-1 ..."]:
    """Cosine coefficients c_1 … c_{n−1} of samples, along the first axis."""
    from scipy.fft import dct

    return dct(x, type=2, norm="ortho", axis=0, workers=-1)[1:]


class Part(NamedTuple):
    """Part of a spectrum: the transforms of segments of one length and rate, of a record the whole.

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

    @property
    def middle(self) -> Float[np.ndarray, " m"]:
        """Middle of each bin [Hz]."""
        return (self.edges[:-1] + self.edges[1:] - 1) * self.rate / (4.0 * self.n)

    @property
    def low(self) -> int:
        """Number of lowest coefficients that feel the record's finite length, each of which is a bin."""
        if self.edges[0] > 1:
            return 0
        return min(int(np.argmax(np.append(np.diff(self.edges) > 1, True))), _SINGLE)

    @property
    def node_frequencies(self) -> Float[np.ndarray, "2 m"]:
        """Two frequencies [Hz] in each bin, which have the mean and the variance of its coefficients'."""
        away = np.sqrt((np.diff(self.edges) ** 2 - 1.0) / 12.0)
        return self.middle + np.stack([-away, away]) * self.rate / (2.0 * self.n)


@dataclasses.dataclass(frozen=True, eq=False)
class Bins(ByValue):
    """Bins of the cosine coefficients of a record, or of the parts of a stream's spectrum.

    Attributes:
        n: number of samples.
        rate: sample rate [Hz].
        parts: the transforms, those of the lowest frequencies first.
    """

    n: int
    rate: float
    parts: tuple[Part, ...]

    @functools.cached_property
    def size(self) -> Int[np.ndarray, " m"]:
        """Number of coefficients in each bin, of all segments together."""
        return np.concatenate([part.segments * np.diff(part.edges) for part in self.parts])

    @functools.cached_property
    def frequency(self) -> Float[np.ndarray, " m"]:
        """Middle of each bin [Hz], increasing."""
        return np.concatenate([part.middle for part in self.parts])

    @classmethod
    def of(
        cls,
        n: int,
        rate: float,
        around: Sequence[tuple[float, float]] = (),
        per_octave: int = PER_OCTAVE,
    ) -> Bins:
        """Bins of single coefficients, then so many an octave; finer ones around lines and resonances.

        Each of these is given by its frequency and its width [Hz]; a width of 0 stands for any.
        """
        top = min(_SINGLE, n - 1)
        growing = top * 2.0 ** (np.arange(1, np.ceil(per_octave * np.log2(n / top))) / per_octave)
        edges = [np.rint(growing) + 1.0]
        for frequency, width in around:
            j = 2.0 * n * frequency / rate
            unit = max(2.0 * n * width / rate / 8.0, 1.0)
            steps = unit * np.arange(1.0, _AROUND + 1.0)
            # Farther out they would be wider than the logarithmic bins.
            while steps[-1] * (_GROWTH - 1.0) < j * np.log(2.0) / per_octave:
                steps = np.append(steps, np.ceil(steps[-1] * _GROWTH))
            near = steps[steps < max(0.6 * j, _AROUND + 1.0)] - unit / 2.0
            edges += [np.rint(np.rint(j) + 0.5 - near), np.rint(np.rint(j) + 0.5 + near)]
        above = np.unique(np.concatenate(edges))
        above = above[(above > top + 1) & (above < n)]
        every = np.unique(np.concatenate([np.arange(1, top + 2), above, [n]]).astype(int))
        return cls(n, rate, (Part(n, rate, every, 1),))

    @property
    def edges(self) -> Int[np.ndarray, " m+1"]:
        """First coefficient of each bin of a record, and the one after the last."""
        (whole,) = self.parts
        return whole.edges

    def sums(self, products: Float[np.ndarray, "n-1 ..."]) -> Float[np.ndarray, "m ..."]:
        """Sums of products of a record's coefficients over each bin."""
        return np.add.reduceat(products, self.edges[:-1] - 1, axis=0)

    def statistics(
        self, c: Float[np.ndarray, "n-1 axes"], ramp: Float[np.ndarray, " n-1"]
    ) -> SpectralStatistics:
        """Statistics [axes, m] of axes with these coefficients, and of a ramp with these."""
        squares, cross, gram = (self.sums(x) for x in (c**2, c * ramp[:, None], ramp**2))
        return SpectralStatistics(squares.T, cross.T, np.broadcast_to(gram, squares.T.shape))

    def per_octave(self) -> Float[np.ndarray, " m"]:
        """Number of bins in the octave around each bin."""
        inside = abs(np.log2(self.frequency[:, None] / self.frequency)) <= 0.5
        return inside.sum(axis=1).astype(float)


def bin_edges(first: int, stop: int, bins: int) -> Int[np.ndarray, " bins+1"]:
    """Edges of logarithmic bins of the coefficients first … stop−1; single up to 64 if first is 1."""
    single = np.arange(1, _SINGLE + 1) if first == 1 else np.zeros(0, int)
    rest = np.rint(np.geomspace(first + len(single), stop, bins - len(single) + 1)).astype(int)
    return np.append(single, rest)


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


def joint_statistics(
    stretches: Sequence[Float[np.ndarray, "_ axes"]], rate: float
) -> tuple[Bins, SpectralStatistics]:
    """Bins and statistics [axes, m] of stretches of a record, one after the other, each less its own mean.

    Between stretches the coefficients of white noise and random walks are independent, those of flicker and
    Markov noise nearly. The bins are those of the first stretch, the longest, as far as they say how long.
    """
    parts: list[Part] = []
    sums = []
    for x in stretches:
        bins = Bins.of(len(x), rate)
        parts += bins.parts
        sums.append(bins.statistics(cosine_transform(x - x.mean(axis=0)), ramp_column(len(x), rate)))
    joint = SpectralStatistics(*(np.concatenate(some, axis=1) for some in zip(*sums, strict=True)))
    return Bins(len(stretches[0]), rate, tuple(parts)), joint


def ramp_column(n: int, rate: float) -> Float[np.ndarray, " n-1"]:
    """Cosine coefficients of a ramp of 1 per second in n samples."""
    return term_column(DriftRamp(), n, rate)

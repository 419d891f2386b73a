"""Whitened residuals of a record, and the law of Allan deviations in its simulations.

A simulation draws cosine coefficients c_j ~ N(0, v_j), where the levels v themselves are known only as well
as the record determines them. The Allan variance of the record continued by its mirror image at both ends,
known as the total variance (Greenhall, Howe & Percival 1999, IEEE Trans. UFFC 46:1183), is diagonal in them:

    σ²(m) = (1/n) Σ_j c_j² w_j(m),    w_j(m) = 2 sin⁴(m a_j/2)/(m² sin²(a_j/2)),    a_j = πj/n.

So the scatter of simulations follows without simulating: it is that of a weighted sum of χ² variates.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.stats import chi2

from allanjax.critic.noise import centred
from allanjax.critic.result import Snapshot
from allanjax.record.completion import in_time
from allanjax.record.recording import Axis

# Largest number of coefficients in bins of one width.
_CHUNK = 1 << 16
# Phase m·a_j/2 beyond which sin⁴ counts by its mean, 3/8.
_FAST = 40.0
# Phase [rad] over which a weight is taken as constant.
_TURN = 0.04
# Relative precision of such sums: the variance that remains after fitting the levels is not smaller.
_ROUNDING = 1e-3
# Bins of a spectrum and cluster times of a curve per octave.
_PER_OCTAVE = 6
_CURVE_PER_OCTAVE = 4


@dataclasses.dataclass(frozen=True, eq=False)
class StageResiduals:
    """One axis at one stage of the critique; `scale` converts its own unit to SI.

    Arrays as long as the record are made when they are needed, and kept until `forget`.
    """

    axis: Axis
    scale: float
    stage: Snapshot

    @property
    def n(self) -> int:
        """Number of samples."""
        return len(self.stage.x)

    @property
    def rate(self) -> float:
        """Sample rate [Hz]."""
        return self.stage.rate

    @functools.cached_property
    def variance(self) -> Float[np.ndarray, " n-1"]:
        """Expected squares of the cosine coefficients."""
        return self.stage.variance

    @functools.cached_property
    def _transform(self) -> Float[np.ndarray, " n-1"]:
        """Cosine coefficients of the samples less the findings, the model's ramp included."""
        return centred(self.stage.x)

    @functools.cached_property
    def whitened_coefficients(self) -> Float[np.ndarray, " n-1"]:
        """Whitened coefficients, independent and standard normal if the model is right."""
        root, ramp = np.sqrt(self.variance), self.stage.ramp
        if not (ramp and np.isfinite(ramp)):
            return self._transform / root
        return (self._transform - ramp * self.stage.family.ramp) / root

    @functools.cached_property
    def whitened(self) -> Float[np.ndarray, " n"]:
        """Whitened residuals in time order."""
        return in_time(self.whitened_coefficients)

    def shares(
        self, places: Int[np.ndarray, " some"] | slice = slice(None)
    ) -> Float[np.ndarray, "terms some"]:
        """Share of each noise term in some of the expected squares; no rows if the terms are unknown."""
        rows = [p * x[places] for p, x in self.stage.spectra]
        if not rows:
            return np.zeros((0, len(self.stage.family.frequency[places])))
        return np.stack(rows) / np.maximum(np.sum(rows, axis=0), 1e-300)

    def share(self, term: str) -> Float[np.ndarray, " n-1"] | None:
        """Share of one noise term in the expected squares; None if there is no such term."""
        family, powers = self.stage.family, dict(self.stage.powers)
        if term not in powers:
            return None
        total = family.expected(powers, self.stage.index)
        return family.expected({term: powers[term]}, self.stage.index) / np.maximum(total, 1e-300)

    @functools.cached_property
    def level_covariance(self) -> Float[np.ndarray, "terms terms"]:
        """Covariance of the relative errors of the terms' powers.

        The inverse of the Fisher information plus 1, so that no power is more uncertain than 100 %.
        """
        return np.linalg.inv(self.level_information + np.eye(len(self.stage.powers)))

    @functools.cached_property
    def level_information(self) -> Float[np.ndarray, "terms terms"]:
        """Fisher information about the logarithms of the terms' powers: ½ Σ_j q_k q_l, q the shares."""
        bins = NarrowBins.of(self.n)
        q = self.shares(bins.middle)
        return 0.5 * (q * bins.size) @ q.T

    def reuse(self, other: StageResiduals) -> None:
        """Take what another stage of the axis has computed of the same samples."""
        if self.stage.x is other.stage.x and "_transform" in vars(other):
            vars(self)["_transform"] = other._transform

    def forget(self) -> None:
        """Drop arrays as long as the record that can be recomputed, except the whitened coefficients."""
        for name in ("_transform", "variance", "whitened"):
            vars(self).pop(name, None)

    def keep_whitened(self) -> None:
        """Compute the whitened coefficients, for other axes, and drop all else."""
        if "whitened_coefficients" not in vars(self):
            _ = self.whitened_coefficients
            self.forget()

    def simulate(self, seed: int) -> Float[np.ndarray, " n"]:
        """Simulated record of the model [SI], without mean and ramp."""
        draw = np.random.default_rng(seed).standard_normal(self.n - 1)
        draw *= np.sqrt(self.variance)
        return in_time(draw)


class NarrowBins(NamedTuple):
    """Bins of coefficients in which the noise and Allan weights hardly change, the lowest ones a bin each.

    Attributes:
        first, size: place of the first coefficient in each, counted from 0; their number.
        chunk: first coefficient of a stretch of bins of one width.
    """

    first: Int[np.ndarray, " bins"]
    size: Int[np.ndarray, " bins"]
    chunk: Int[np.ndarray, " bins"]

    @classmethod
    @functools.lru_cache(maxsize=4)
    def of(cls, n: int) -> NarrowBins:
        """Bins of the coefficients of n samples."""
        first, chunk = [], []
        for part in _chunks(n - 1):
            # No weight changes phase by more than a small angle within a bin, unless it oscillates fast.
            edges = np.arange(part.start, part.stop, max(int(part.start * _TURN / _FAST), 1))
            first.append(edges)
            chunk.append(np.full(len(edges), part.start))
        edges = np.concatenate(first)
        return cls(edges, np.diff(edges, append=n - 1), np.concatenate(chunk))

    @property
    def middle(self) -> Int[np.ndarray, " bins"]:
        """Place of a coefficient in the middle of each bin."""
        return self.first + self.size // 2

    def sums(self, x: Float[np.ndarray, " n-1"]) -> Float[np.ndarray, " bins"]:
        """Sums over the coefficients in each bin."""
        return np.add.reduceat(x, self.first)


@functools.lru_cache(maxsize=4)
def allan_weights(n: int, sizes: tuple[int, ...]) -> Float[np.ndarray, "m bins"]:
    """Weights w_j(m)/n of squared coefficients of n samples in Allan variances, in narrow bins."""
    bins = NarrowBins.of(n)
    a = np.pi * (bins.first + 0.5 * (bins.size + 1)) / (2.0 * n)
    start = np.pi * (bins.chunk + 1) / (2.0 * n)
    weights = np.empty((len(sizes), len(a)))
    for row, m in zip(weights, sizes, strict=True):
        # Where the weight oscillates fast in j it is replaced by its mean.
        np.copyto(row, np.where(m * start > _FAST, 0.375, np.sin(m * a) ** 4))
        row *= 2.0 / (n * (m * np.sin(a)) ** 2)
    return weights


@dataclasses.dataclass(frozen=True, eq=False)
class AllanLaw:
    """Allan variances of a record, and their distribution in simulations.

    Attributes:
        time: cluster times [s].
        measured, mean: Allan variances of the record, and the mean of the simulations' [rate²].
        covariance: covariance of the simulated variances over their means, including errors of the levels.
        fitted: covariance of the measured variances over the means if the model is right, given that its
            levels were fitted to the same record.
    """

    time: Float[np.ndarray, " m"]
    measured: Float[np.ndarray, " m"]
    mean: Float[np.ndarray, " m"]
    covariance: Float[np.ndarray, "m m"]
    fitted: Float[np.ndarray, "m m"]

    def at(self, some: slice) -> AllanLaw:
        """Law at selected cluster times."""
        both = some, some
        return AllanLaw(
            self.time[some], self.measured[some], self.mean[some], self.covariance[both], self.fitted[both]
        )

    def quantile(self, probability: float) -> Float[np.ndarray, " m"]:
        """Quantile of the simulations' Allan variances."""
        dof = degrees_of_freedom(self.covariance)
        return self.mean * chi2.ppf(probability, dof) / dof


def degrees_of_freedom(covariance: Float[np.ndarray, "m m"]) -> Float[np.ndarray, " m"]:
    """Degrees of freedom of χ² laws with mean 1 and these variances."""
    return 2.0 / np.diag(covariance)


def allan_law(record: StageResiduals, sizes: Int[np.ndarray, " m"]) -> AllanLaw:
    """Allan law of a record for clusters of these sizes [samples]."""
    bins, weights = NarrowBins.of(record.n), allan_weights(record.n, tuple(sizes.tolist()))
    v, z = record.variance, record.whitened_coefficients
    level = bins.sums(v)
    measured, mean = weights @ bins.sums(z * z * v), weights @ level
    known = 2.0 * (weights * bins.sums(v * v)) @ weights.T / np.outer(mean, mean)
    slope = weights @ (record.shares(bins.middle) * level).T / mean[:, None]
    # The errors of the levels, L·score, are correlated with the record: their covariance with it is slope·L,
    # and that of the score is its Fisher information.
    L = record.level_covariance
    followed = 2.0 * L - L @ record.level_information @ L
    return AllanLaw(
        sizes / record.rate,
        measured,
        mean,
        known + slope @ L @ slope.T,
        known - slope @ followed @ slope.T + _ROUNDING * np.diag(np.diag(known)),
    )


def _chunks(size: int) -> Iterator[slice]:
    """Slices of an array that double in length, as the lowest coefficients differ most."""
    first, length = 0, 1024
    while first < size:
        yield slice(first, min(first + length, size))
        first, length = first + length, min(2 * length, _CHUNK)


def octave_bins(n: int) -> Int[np.ndarray, " bins+1"]:
    """Edges of logarithmic bins of the coefficients 1 … n−1, six an octave once that makes more than one."""
    edges = [1]
    while (last := edges[-1]) < n:
        edges.append(last + max(1, int(last * (2.0 ** (1.0 / _PER_OCTAVE) - 1.0))))
    # The rest at the end belongs to the last whole bin.
    return np.append(edges[:-2], n)


@dataclasses.dataclass(frozen=True, eq=False)
class SimulationEnvelope:
    """A measured curve and the band in which 95 % of simulations lie.

    Attributes:
        statistic: "allan_deviation" [rate, SI] over cluster time [s], or "psd", one-sided [rate²/Hz, SI],
            over frequency [Hz].
        place: cluster times or frequencies.
        measured: the curve.
        low, median, high: 2.5, 50 and 97.5 % of simulations.
    """

    statistic: str
    place: Float[np.ndarray, " m"]
    measured: Float[np.ndarray, " m"]
    low: Float[np.ndarray, " m"]
    median: Float[np.ndarray, " m"]
    high: Float[np.ndarray, " m"]


def summaries(record: StageResiduals) -> tuple[SimulationEnvelope, SimulationEnvelope]:
    """Allan deviation and power spectral density of a record, with those of its simulations."""
    n = record.n
    sizes = np.unique(
        np.rint(2.0 ** (np.arange(_CURVE_PER_OCTAVE * np.log2(n // 2) + 1) / _CURVE_PER_OCTAVE))
    )
    law = allan_law(record, sizes.astype(int))
    allan = SimulationEnvelope(
        "allan_deviation",
        law.time,
        np.sqrt(law.measured),
        *(np.sqrt(law.quantile(p)) for p in (0.025, 0.5, 0.975)),
    )
    edges = octave_bins(n)
    first, count = edges[:-1] - 1, np.diff(edges)
    q = np.add.reduceat(record.shares() * record.variance, first, axis=1)
    expected = np.add.reduceat(record.variance, first)
    q = q / expected
    spread = 2.0 / count + np.einsum("kb,kl,lb->b", q, record.level_covariance, q)
    dof = 2.0 / spread
    density = 2.0 / record.rate / count
    low, median, high = (density * expected * chi2.ppf(p, dof) / dof for p in (0.025, 0.5, 0.975))
    middle = (edges[:-1] + edges[1:] - 1) * record.rate / (4.0 * n)
    measured = density * np.add.reduceat(record.whitened_coefficients**2 * record.variance, first)
    return allan, SimulationEnvelope("psd", middle, measured, low, median, high)

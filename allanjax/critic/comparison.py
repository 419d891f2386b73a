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
from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Float, Int
from scipy.stats import chi2

from allanjax.critic.noise import FIXED, MARKOV, POWER_LAW, centred, family_of
from allanjax.critic.result import Snapshot
from allanjax.noise.terms import Markov, PowerLaw
from allanjax.record.completion import in_time
from allanjax.record.recording import Axis

# Largest number of coefficients whose weights are in memory at once.
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
    """One axis at one stage of the critique; `scale` converts its own unit to SI."""

    axis: Axis
    scale: float
    rate: float
    stage: Snapshot

    @property
    def n(self) -> int:
        """Number of samples."""
        return len(self.stage.x)

    @property
    def variance(self) -> Float[np.ndarray, " n-1"]:
        """Expected squares of the cosine coefficients."""
        return self.stage.variance

    @functools.cached_property
    def samples(self) -> Float[np.ndarray, " n"]:
        """Samples less the findings and the model's ramp, as in simulations [SI]."""
        x, ramp = self.stage.x, self.stage.ramp
        if ramp and np.isfinite(ramp):
            x = x - ramp * (np.arange(len(x)) - (len(x) - 1) / 2.0) / self.rate
        return x

    @functools.cached_property
    def coefficients(self) -> Float[np.ndarray, " n-1"]:
        """Cosine coefficients of the samples."""
        return centred(self.samples)

    @functools.cached_property
    def whitened_coefficients(self) -> Float[np.ndarray, " n-1"]:
        """Whitened coefficients, independent and standard normal if the model is right."""
        return self.coefficients / np.sqrt(self.variance)

    @functools.cached_property
    def whitened(self) -> Float[np.ndarray, " n"]:
        """Whitened residuals in time order."""
        return in_time(self.whitened_coefficients)

    @functools.cached_property
    def _spectra(self) -> list[Float[np.ndarray, " n-1"]]:
        """Spectra of the noise terms at unit amplitude."""
        family, shaped = family_of(self.n, self.rate), {MARKOV: Markov, POWER_LAW: PowerLaw}
        return [
            family.spectra[FIXED.index(name)]
            if name in FIXED
            else family.spectrum(shaped[name](1.0, self.stage.shape))
            for name in self.stage.powers
        ]

    def shares(self, part: slice = slice(None)) -> Float[np.ndarray, "terms some"]:
        """Share of each noise term in some of the expected squares; no rows if the terms are unknown.

        The shares of all coefficients at all stages would take gigabytes.
        """
        rows = [p * x[part] for p, x in zip(self.stage.powers.values(), self._spectra, strict=True)]
        if not rows:
            return np.zeros((0, len(self.variance[part])))
        return np.stack(rows) / np.maximum(np.sum(rows, axis=0), 1e-300)

    def share(self, term: str) -> Float[np.ndarray, " n-1"] | None:
        """Share of one noise term in the expected squares; None if there is no such term."""
        names = list(self.stage.powers)
        return self.shares()[names.index(term)] if term in names else None

    @functools.cached_property
    def level_covariance(self) -> Float[np.ndarray, "terms terms"]:
        """Covariance of the relative errors of the terms' powers.

        The inverse of the Fisher information plus 1, so that no power is more uncertain than 100 %.
        """
        return np.linalg.inv(self.level_information + np.eye(len(self.stage.powers)))

    @functools.cached_property
    def level_information(self) -> Float[np.ndarray, "terms terms"]:
        """Fisher information about the logarithms of the terms' powers: ½ Σ_j q_k q_l, q the shares."""
        k = len(self.stage.powers)
        return 0.5 * sum((q @ q.T for q in map(self.shares, _chunks(self.n - 1))), start=np.zeros((k, k)))

    def forget(self) -> None:
        """Drop arrays as long as the record that can be recomputed, except those that are needed outside."""
        for name in ("samples", "coefficients", "whitened", "_spectra"):
            vars(self).pop(name, None)

    def simulate(self, seed: int) -> Float[np.ndarray, " n"]:
        """Simulated record of the model [SI], without mean and ramp."""
        draw = np.random.default_rng(seed).standard_normal(self.n - 1)
        return in_time(draw * np.sqrt(self.variance))


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
    (law,) = allan_laws([record], sizes)
    return law


def allan_laws(records: Sequence[StageResiduals], sizes: Int[np.ndarray, " m"]) -> list[AllanLaw]:
    """Allan laws of several records of one length, for which the weights are computed once."""
    n = records[0].n
    m, sums = len(sizes), []
    for record in records:
        terms = len(record.stage.powers)
        sums.append((np.zeros(m), np.zeros(m), np.zeros((m, m)), np.zeros((m, terms))))
    for part in _chunks(n - 1):
        # Neighbours between which no weight changes phase by more than a small angle count only by their sum.
        edges = np.arange(0, part.stop - part.start, max(int(part.start * _TURN / _FAST), 1))
        last = np.append(edges[1:], part.stop - part.start)
        a = np.pi * (part.start + 0.5 * (edges + last + 1)) / (2.0 * n)
        # Where the weight oscillates fast in j it is replaced by its mean: one row for all such clusters.
        fast = sizes * a[0] > _FAST
        weight = np.ones((np.sum(~fast) + 1, len(a)))
        weight[:-1] = np.sin(np.outer(sizes[~fast], a)) ** 2
        weight *= weight
        weight /= np.sin(a) ** 2
        rows = np.zeros((len(sizes), len(weight)))
        rows[~fast, :-1] = np.diag(2.0 / sizes[~fast] ** 2.0)
        rows[fast, -1] = 0.75 / sizes[fast] ** 2.0
        for record, (measured, mean, square, slope) in zip(records, sums, strict=True):
            v = record.variance[part]
            c2, v2 = (np.add.reduceat(y**2, edges) for y in (record.coefficients[part], v))
            measured += rows @ (weight @ c2)
            mean += rows @ (weight @ np.add.reduceat(v, edges))
            square += rows @ ((weight * v2) @ weight.T) @ rows.T
            slope += rows @ (weight @ np.add.reduceat(record.shares(part) * v, edges, axis=1).T)
    return [_law(record, sizes, *total) for record, total in zip(records, sums, strict=True)]


def _law(
    record: StageResiduals,
    sizes: Int[np.ndarray, " m"],
    measured: Float[np.ndarray, " m"],
    mean: Float[np.ndarray, " m"],
    square: Float[np.ndarray, "m m"],
    slope: Float[np.ndarray, "m terms"],
) -> AllanLaw:
    """Allan law by sums over all coefficients: weighted squares, their mean and covariance, parts by term."""
    slope = slope / mean[:, None]
    known = 2.0 * square / np.outer(mean, mean)
    L = record.level_covariance
    # The errors of the levels, L·score, are correlated with the record: their covariance with it is slope·L,
    # and that of the score is its Fisher information.
    followed = 2.0 * L - L @ record.level_information @ L
    return AllanLaw(
        sizes / record.rate,
        measured / record.n,
        mean / record.n,
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
    measured = density * np.add.reduceat(record.coefficients**2, first)
    return allan, SimulationEnvelope("psd", middle, measured, low, median, high)

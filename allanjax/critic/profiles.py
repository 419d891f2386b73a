"""Statistics in which measurement and simulation are compared, at all their places, and their laws.

A simulation draws cosine coefficients c_j ~ N(0, v_j) with the model's v, so the scatter of simulations
follows without simulating. Each p-value allows for all places searched (cluster times, frequencies, lags,
windows, channels). The Allan variance of the record continued by its mirror image at both ends, known as the
total variance (Greenhall, Howe & Percival 1999, IEEE Trans. UFFC 46:1183), is diagonal in the coefficients:

    σ²(m) = (1/n) Σ_j c_j² w_j(m),    w_j(m) = 2 sin⁴(m a_j/2)/(m² sin²(a_j/2)),    a_j = πj/n.

So its law is that of a weighted sum of χ² variates. That of the Allan deviation and the drift, which depend
on slow noise that few data determine, allows for levels v that were fitted to the same record.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Mapping
from typing import NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Float, Int, Real
from scipy.fft import dct, rfft
from scipy.stats import binom, chi2, kurtosistest, norm, skewtest

from allanjax.allan.estimators import cluster_sizes
from allanjax.critic.bank import any_of, extrapolated
from allanjax.critic.effects.rounding import is_harmless
from allanjax.critic.finding import Discrepancy
from allanjax.critic.stage import Stage, narrow_bins, octave_bins
from allanjax.record.completion import in_time
from allanjax.record.units import unit_scale

# Phase m·a_j/2 beyond which sin⁴ counts by its mean, 3/8; up to there it changes little in a narrow bin.
_FAST = 80.0
# Relative precision of such sums: the variance that remains after fitting the levels is not smaller.
_ROUNDING = 1e-3
# Cluster times of a curve per octave.
_PER_OCTAVE = 4


class Law:
    """Weighted sums of the squared coefficients of a record, and their distribution in simulations.

    Attributes:
        measured: sums over the record's coefficients.
        mean: means of the sums in simulations.
        covariance: covariance of the simulated ones over their means, including errors of the levels.
        fitted: covariance of the measured ones over the means if the model is right, given that its levels
            were fitted to the same record.
    """

    def __init__(self, stage: Stage, weights: Float[np.ndarray, "m bins"]) -> None:
        """Law of the sums with these weights, each for a narrow bin of coefficients."""
        v, square, measured, _ = stage.sums
        edges = narrow_bins(stage.n)
        size = np.diff(edges)
        middle = edges[:-1] - 1 + size // 2
        q = np.reshape([stage.share(term, middle) for term in stage.powers], (-1, len(size)))
        # No power is more uncertain than 100 %, hence the 1 beside the Fisher information ½ Σ_j q_k q_l.
        information = 0.5 * (q * size) @ q.T
        errors = np.linalg.inv(information + np.eye(len(q)))
        self.measured, self.mean = weights @ measured, weights @ v
        known = 2.0 * (weights * square) @ weights.T / np.outer(self.mean, self.mean)
        slope = weights @ (q * v).T / self.mean[:, None]
        # The errors of the levels, L·score, are correlated with the record: their covariance with it is
        # slope·L, and that of the score is its Fisher information.
        followed = 2.0 * errors - errors @ information @ errors
        self.covariance = known + slope @ errors @ slope.T
        self.fitted = known - slope @ followed @ slope.T + _ROUNDING * np.diag(np.diag(known))

    def quantile(self, probability: float) -> Float[np.ndarray, " m"]:
        """Quantile of the simulations' sums, χ² variates of as many degrees of freedom as fit."""
        dof = 2.0 / np.diag(self.covariance)
        return self.mean * chi2.ppf(probability, dof) / dof


@functools.lru_cache(maxsize=4)
def allan_weights(n: int, sizes: tuple[int, ...]) -> Float[np.ndarray, "m bins"]:
    """Weights w_j(m)/n of the squared coefficients of n samples in Allan variances, in narrow bins."""
    edges = narrow_bins(n)
    a = np.pi * 0.5 * (edges[1:] + edges[:-1] - 1) / (2.0 * n)
    weights = np.empty((len(sizes), len(a)))
    for row, m in zip(weights, sizes, strict=True):
        # Where the weight oscillates fast in j it is replaced by its mean.
        np.copyto(row, np.where(m * a > _FAST, 0.375, np.sin(m * a) ** 4))
        row *= 2.0 / (n * (m * np.sin(a)) ** 2)
    return weights


class Curve(NamedTuple):
    """A measured curve and the band in which 95 % of simulations lie.

    Attributes:
        place: cluster times [s] or frequencies [Hz].
        measured: Allan deviations [rate, SI], or one-sided densities [rate²/Hz, SI].
        low, median, high: 2.5, 50 and 97.5 % of simulations.
    """

    place: Float[np.ndarray, " m"]
    measured: Float[np.ndarray, " m"]
    low: Float[np.ndarray, " m"]
    median: Float[np.ndarray, " m"]
    high: Float[np.ndarray, " m"]


def summaries(stage: Stage) -> tuple[Curve, Curve]:
    """Allan deviation and power spectral density of a record, each with the band of its simulations."""
    n, rate = stage.n, stage.rate
    sizes, edges = cluster_sizes(n, rate, _PER_OCTAVE), octave_bins(n)
    inside = np.digitize(narrow_bins(n)[:-1], edges) == np.arange(1, len(edges))[:, None]
    curves = []
    for place, weights in (
        (sizes / rate, allan_weights(n, tuple(sizes.tolist()))),
        ((edges[:-1] + edges[1:] - 1) * rate / (4.0 * n), inside * (2.0 / rate / np.diff(edges))[:, None]),
    ):
        law = Law(stage, weights)
        curves.append(Curve(place, law.measured, *(law.quantile(p) for p in (0.025, 0.5, 0.975))))
    allan, density = curves
    return Curve(allan.place, *map(np.sqrt, allan[1:])), density


# Smallest p-value that is reported; smaller ones are beyond floating point.
_TINY = 1e-300
# Most lags of the autocorrelation, most windows, fewest samples in one.
_LAGS, _WINDOWS, _SHORTEST = 200, 64, 16
# Draws from which the law of a largest score is extrapolated.
_DRAWS = 2000
# Normal scores beyond this are computed from the deviance: their probabilities underflow.
_FAR = 35.0

Places = Float[np.ndarray, " places"]
_Numbers: TypeAlias = Callable[[int], tuple[float, float, float]]


@dataclasses.dataclass(frozen=True, eq=False)
class Profile:
    """A statistic at all places where it is compared with simulations: times, frequencies, lags, channels.

    Attributes:
        score: difference between measurement and simulations at each place: standard normal under the model,
            or a magnitude that grows like one.
        numbers: place, measured value, and median of simulations, by the number of the place.
        law: p-value of the largest magnitude among the scores; None if they are independent normal ones.
        channels: other axes or channels, one place each, for correlations.
        extent: start and end of each place, of windows in time and bands of frequencies.
    """

    statistic: str
    where_unit: str
    unit: str
    score: Places
    numbers: _Numbers
    law: Callable[[float], float] | None = None
    channels: tuple[str, ...] = ()
    extent: tuple[Places, Places] | None = None

    def within(self, start: float, end: float) -> Discrepancy:
        """Largest discrepancy at the places mostly in a span, or at the smallest one that overlaps it."""
        low, high = self.extent or (np.zeros(1), np.zeros(1))
        length, overlap = high - low, np.minimum(high, end) - np.maximum(low, start)
        own = np.flatnonzero(overlap >= 0.5 * length)
        if not len(own):
            own = np.array([np.argmin(np.where(overlap > 0.0, length, np.inf))])
        return self.at(int(own[np.argmax(abs(self.score[own]))]))

    def at(self, place: int) -> Discrepancy:
        """Discrepancy at one place; its p-value is corrected for having searched all places."""
        where, measured, simulated = map(float, self.numbers(place))
        score = float(abs(self.score[place]))
        p = self.law(score) if self.law else any_of(float(2.0 * norm.sf(score)), len(self.score))
        return Discrepancy(
            *(self.statistic, where, self.where_unit, measured, simulated, self.unit),
            p_value=float(np.clip(p, _TINY, 1.0)),
            channel=self.channels[place] if self.channels else "",
        )

    def worst(self) -> Discrepancy:
        """Discrepancy at the place where measurement and simulation differ most."""
        return self.at(int(np.argmax(abs(self.score))))


def _listed(where: Places | float, measured: Places, simulated: Places | float) -> _Numbers:
    """Numbers of a profile from arrays, or of all places alike."""
    table = np.broadcast_arrays(where, measured, simulated)
    return lambda place: (table[0][place], table[1][place], table[2][place])


def _largest(root: Float[np.ndarray, "places k"]) -> Callable[[float], float]:
    """p-value of the largest of standard normal magnitudes whose correlations are root·root'."""
    draws = root @ np.random.default_rng(0).standard_normal((root.shape[1], _DRAWS))
    return functools.partial(extrapolated, abs(draws).max(axis=0))


def _chi2_score(value: Places, dof: Real[np.ndarray, " places"]) -> Places:
    """Standard normal variates as improbable as these χ² ones."""
    below, above = chi2.cdf(value, dof), chi2.sf(value, dof)
    z = np.where(below < 0.5, norm.ppf(np.maximum(below, _TINY)), norm.isf(np.maximum(above, _TINY)))
    ratio = np.maximum(value / dof, 1e-300)
    deviance = np.sqrt(np.maximum(dof * (ratio - 1.0 - np.log(ratio)), _FAR**2))
    return np.where(abs(z) < _FAR, z, np.sign(z) * deviance)


# --- Slow noise: cluster times ------------------------------------------------------------------------------


def allan_deviation(stage: Stage) -> Profile:
    """Profile of the Allan deviation at octaves."""
    sizes = cluster_sizes(stage.n, stage.rate)
    return _of_law("allan_deviation", stage, sizes, np.full(len(sizes), 1.0 / stage.scale), stage.axis.unit)


def drift(stage: Stage) -> Profile:
    """Profile of the drift of the integrated rate at round times.

    The drift over T, less that at the mean rate over an equally long time before, is √2·T times the Allan
    deviation at T.
    """
    sizes = drift_sizes(stage.n, stage.rate)
    return _of_law("drift", stage, sizes, *drift_scale(stage, sizes))


def drift_scale(stage: Stage, sizes: Int[np.ndarray, " m"]) -> tuple[Places, str]:
    """Ratio of drifts to the Allan deviations for clusters of these sizes [SI], and the drifts' unit."""
    unit = {"gyro": "deg", "accel": "m/s"}[stage.axis.sensor]
    return np.sqrt(2.0) * sizes / stage.rate / unit_scale(unit, stage.axis.sensor), unit


def drift_sizes(n: int, rate: float) -> Int[np.ndarray, " m"]:
    """Times at which drifts are compared, in samples: 1, 2, 4, … s, up to a quarter of the record."""
    times = 2.0 ** np.arange(np.floor(np.log2(max(n / rate / 4.0, 1.0))) + 1)
    return np.unique(np.clip(np.rint(times * rate), 1, n // 2)).astype(int)


def _of_law(statistic: str, stage: Stage, sizes: Int[np.ndarray, " m"], factor: Places, unit: str) -> Profile:
    """Profile of a statistic that is the Allan deviation for clusters of these sizes, times a factor."""
    law = Law(stage, allan_weights(stage.n, tuple(sizes.tolist())))
    variance = np.diag(law.fitted)
    z = _chi2_score(2.0 / variance * law.measured / law.mean, 2.0 / variance)
    values, vectors = np.linalg.eigh(law.fitted / np.sqrt(np.outer(variance, variance)))
    measured, simulated = (factor * np.sqrt(v) for v in (law.measured, law.quantile(0.5)))
    numbers = _listed(sizes / stage.rate, measured, simulated)
    return Profile(statistic, "s", unit, z, numbers, _largest(vectors * np.sqrt(np.maximum(values, 0.0))))


# --- Frequencies --------------------------------------------------------------------------------------------


def psd(stage: Stage) -> Profile:
    """Profile of the one-sided PSD in logarithmic bins."""
    edges, spacing = octave_bins(stage.n), stage.rate / (2.0 * stage.n)
    count = np.diff(edges)
    first = np.searchsorted(narrow_bins(stage.n), edges[:-1])
    variance, _, _, squares = np.add.reduceat(stage.sums, first, axis=1)
    z = _chi2_score(squares, count)
    level = 2.0 / stage.rate * variance / count / stage.scale**2
    numbers = _listed(
        (edges[:-1] + edges[1:] - 1) * spacing / 2.0,
        *(level * x / count for x in (squares, chi2.median(count))),
    )
    between, unit = (edges - 0.5) * spacing, f"({stage.axis.unit})²/Hz"
    return Profile("psd", "Hz", unit, z, numbers, extent=(between[:-1], between[1:]))


def line(stage: Stage) -> Profile:
    """Profile of the amplitude at the Fourier frequencies, where white noise is independent."""
    n, spacing = stage.n, stage.rate / stage.n
    spectrum = rfft(stage.whitened, workers=-1)[1 : (n + 1) // 2]
    power = spectrum.real**2
    power += spectrum.imag**2
    score = np.sqrt(np.multiply(power, 2.0 / n, out=power), out=power)
    count = len(score)
    # Median of the largest of so many: half of all simulations stay below it.
    typical = np.sqrt(-2.0 * np.log(-np.expm1(np.log(0.5) / count)))

    def numbers(place: int) -> tuple[float, float, float]:
        noise = float(np.sqrt(2.0 * stage.variance[2 * place + 1] / n)) / stage.scale
        return (place + 1) * spacing, noise * score[place], noise * typical

    def law(score: float) -> float:
        return any_of(float(np.exp(-0.5 * score**2)), count)

    lowest = np.arange(count) * spacing
    extent = lowest, lowest + 2.0 * spacing
    return Profile("psd_line", "Hz", stage.axis.unit, score, numbers, law, extent=extent)


def autocorrelation(stage: Stage) -> Profile:
    """Profile of the autocorrelation of the whitened residuals.

    It is that of the record continued by its mirror image: (1/n) Σ z_j² cos(a_j k), of variance 1/n.
    """
    n = stage.n
    squares = np.concatenate([[0.0], stage.whitened_coefficients**2 - 1.0, [0.0]])
    lags = min(_LAGS, n // 10)
    r = dct(squares, type=1, workers=-1)[1 : lags + 1] / (2.0 * n)
    numbers = _listed(np.arange(1, lags + 1) / stage.rate, r, 0.0)
    return Profile("autocorrelation", "s", "1", r * np.sqrt(n), numbers)


# --- Values -------------------------------------------------------------------------------------------------


def shape(stage: Stage) -> list[Profile]:
    """Skewness and excess kurtosis of residuals; scores of D'Agostino (1970), Anscombe & Glynn (1983)."""
    e, n = stage.whitened, stage.n
    second, squares = float(e @ e) / n, e * e
    found = []
    for statistic, value, test in (
        ("skewness", e @ squares / n / second**1.5, skewtest),
        ("tails", squares @ squares / n / second**2 - 3.0, kurtosistest),
    ):
        score = np.array([test(e).statistic])
        found.append(Profile(statistic, "", "1", score, _listed(0.0, np.array([value]), 0.0)))
    return found


def largest_residual(stage: Stage) -> Profile:
    """Profile of the magnitudes of the whitened residuals."""
    n, e = stage.n, stage.whitened
    typical = float(norm.isf(-0.5 * np.expm1(np.log(0.5) / n)))

    return Profile("largest_residual", "s", "σ", e, lambda k: (k / stage.rate, abs(float(e[k])), typical))


# --- Time ---------------------------------------------------------------------------------------------------


def windows(stage: Stage) -> list[Profile]:
    """Profiles of the mean and the mean square of the whitened residuals in 2, 4, … 64 windows."""
    n, e = stage.n, stage.whitened
    finest = 2 ** int(np.log2(np.clip(n / _SHORTEST, 2, _WINDOWS)))
    edges = np.rint(np.linspace(0.0, n, finest + 1)).astype(int)
    within = _within(finest)
    total, square = (within @ np.add.reduceat(x, edges[:-1]) for x in (e, e**2))
    length = within @ np.diff(edges)
    # Windows of each length follow one another through the record.
    start, duration = (np.cumsum(length) - length) % n / stage.rate, length / stage.rate
    found = []
    for statistic, unit, z, value, expected in (
        # All residuals together have no mean.
        ("window_mean", "σ", total / np.sqrt(length * (1.0 - length / n)), total / length, 0.0),
        ("window_variance", "1", _chi2_score(square, length), square / length, 1.0),
    ):
        law = _window_law(finest, statistic == "window_mean")
        numbers = _listed(start + 0.5 * duration, value, expected)
        found.append(Profile(statistic, "s", unit, z, numbers, law, extent=(start, start + duration)))
    return found


def _within(finest: int) -> Float[np.ndarray, "windows finest"]:
    """Which of the finest windows are in each: in one, in two, in four, … in half of them."""
    steps = (2**k for k in range(finest.bit_length() - 1))
    return np.concatenate([np.repeat(np.eye(finest // step), step, axis=1) for step in steps])


@functools.lru_cache(maxsize=8)
def _window_law(finest: int, without_mean: bool) -> Callable[[float], float]:
    """p-value of the largest magnitude among the normal scores of all windows."""
    root = _within(finest)
    if without_mean:
        root -= root.mean(axis=1, keepdims=True)
    return _largest(root / np.linalg.norm(root, axis=1, keepdims=True))


# --- Other channels -----------------------------------------------------------------------------------------


def cross_correlation(stage: Stage, others: Mapping[str, Stage]) -> Profile:
    """Profile of the correlations with the whitened residuals of other axes."""
    score, _ = _matched(stage, {name: other.whitened_coefficients for name, other in others.items()})
    numbers = _listed(0.0, score / np.sqrt(stage.n), 0.0)
    return Profile("cross_correlation", "", "1", score, numbers, channels=tuple(others))


def auxiliary_correlation(stage: Stage, channels: Mapping[str, Float[np.ndarray, " n-1"]]) -> Profile:
    """Profile of the outputs of filters matched to other channels, given as cosine coefficients.

    An output is an rms in the axis's unit. A slow channel has few independent samples; their number follows
    from the noise at its frequencies.
    """
    score, length = _matched(stage, {name: h / stage.deviation for name, h in channels.items()})
    rms = np.array([np.linalg.norm(h) for h in channels.values()])
    error = rms / length / np.sqrt(stage.n) / stage.scale
    numbers = _listed(0.0, abs(score) * error, float(norm.isf(0.25)) * error)
    return Profile("auxiliary_correlation", "", stage.axis.unit, score, numbers, channels=tuple(channels))


def _matched(stage: Stage, filters: Mapping[str, Float[np.ndarray, " n-1"]]) -> tuple[Places, Places]:
    """Outputs of matched filters, standard normal without the effects, and the filters' norms."""
    length = np.array([max(float(np.linalg.norm(h)), 1e-300) for h in filters.values()])
    return np.array([stage.whitened_coefficients @ h for h in filters.values()]) / length, length


# --- The samples themselves ---------------------------------------------------------------------------------


def of_samples(
    stage: Stage, raw: Float[np.ndarray, " recorded"], step: float | None, seed: int = 0
) -> tuple[Discrepancy, Discrepancy]:
    """Discrepancies of the samples as recorded: of a lattice of this `step`, if any, and of repetitions.

    The first is the share of the samples on a lattice; one finer than the noise only reflects the number
    format of the file. The second is the share of samples equal to the one before; simulations have the
    recording's resolution.
    """
    coarse = step is not None and not is_harmless(step, raw)
    on_lattice = Discrepancy("lattice", 0.0, "", float(coarse), 0.0, "1", _TINY if coarse else 1.0)
    count, simulated = int(np.count_nonzero(raw[1:] == raw[:-1])), 0
    if count and np.ptp(raw) > 0.0:
        # The noise includes that of rounding.
        before = np.sqrt(np.maximum(stage.variance - (step or 0.0) ** 2 / 12.0, 0.0))
        x = in_time(np.random.default_rng(seed).standard_normal(stage.n - 1) * before)[: len(raw)]
        x += np.mean(raw)
        x /= step or np.min(np.diff(np.unique(raw)))
        np.rint(x, out=x)
        simulated = int(np.count_nonzero(x[1:] == x[:-1]))
    # Two counts with the same expectation: an event is in either of them by chance.
    p, n = max(float(binom.sf(count - 1, count + simulated, 0.5)), _TINY), len(raw) - 1
    return on_lattice, Discrepancy("repeated_values", 0.0, "", count / n, simulated / n, "1", p)


# --- All of them --------------------------------------------------------------------------------------------


def profiles_of(stage: Stage, channels: Mapping[str, Float[np.ndarray, " n-1"]]) -> list[Profile]:
    """Profiles of an axis at a stage, except those that take long compared with the transforms."""
    found = [allan_deviation(stage), drift(stage), psd(stage), line(stage), *shape(stage)]
    found += [largest_residual(stage), *windows(stage)]
    return [*found, auxiliary_correlation(stage, channels)] if channels else found

"""Statistics in which measurement and simulation are compared, at all their places.

Each has a law on records of the model, and its p-value allows for all places searched (cluster times,
frequencies, lags, windows, channels). Laws are those of coefficients c_j ~ N(0, v_j) with the model's v as
given. Those of the Allan deviation and the drift, which depend on slow noise that few data determine, allow
for levels that were fitted to the same record.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
from collections.abc import Callable, Mapping, Sequence

import numpy as np
from jaxtyping import Float, Real
from scipy.fft import dct, rfft
from scipy.stats import binom, chi2, kurtosistest, norm

from allanjax.allan.estimators import cluster_sizes
from allanjax.critic import profiles
from allanjax.critic.bank import any_of, extrapolated
from allanjax.critic.causes.rounding import HARMLESS
from allanjax.critic.comparison import (
    AllanLaw,
    StageResiduals,
    allan_laws,
    degrees_of_freedom,
    octave_bins,
)
from allanjax.critic.finding import Discrepancy
from allanjax.critic.noise import centred
from allanjax.inspection.plausible import lattice
from allanjax.record.units import unit_scale

#: Smallest p-value that is reported; smaller ones are beyond floating point.
TINY = 1e-300
# Most lags of the autocorrelation, most windows, fewest samples in one: judgements.
_LAGS, _WINDOWS, _SHORTEST = 200, 64, 16
# Draws from which the law of a largest score is extrapolated.
_DRAWS = 2000
# Normal scores beyond this are computed from the deviance: their probabilities underflow.
_FAR = 35.0
#: Unit of the integrated rate of each sensor.
ANGLE = {"gyro": "deg", "accel": "m/s"}

Places = Float[np.ndarray, " places"]


@dataclasses.dataclass(frozen=True, eq=False)
class Profile:
    """A statistic at all places where it is compared with simulations: times, frequencies, lags, channels.

    Attributes:
        simulated: its median in simulations.
        score: difference of the two: standard normal under the model, or a magnitude that grows like one.
        law: p-value of the largest magnitude among the scores.
        channels: other axes or channels, one place each, for correlations.
    """

    statistic: str
    where: Places
    where_unit: str
    measured: Places
    simulated: Places
    unit: str
    score: Places
    law: Callable[[float], float]
    channels: tuple[str, ...] = ()

    def at(self, place: int) -> Discrepancy:
        """Discrepancy at one place; its p-value is corrected for having searched all places."""
        return Discrepancy(
            self.statistic,
            float(self.where[place]),
            self.where_unit,
            float(self.measured[place]),
            float(self.simulated[place]),
            self.unit,
            float(np.clip(self.law(float(abs(self.score[place]))), TINY, 1.0)),
            self.channels[place] if self.channels else "",
        )

    def worst(self) -> Discrepancy:
        """Discrepancy at the place where measurement and simulation differ most."""
        return self.at(int(np.argmax(abs(self.score))))


def _independent(count: int) -> Callable[[float], float]:
    """p-value of the largest of `count` independent standard normal magnitudes, as a function of its size."""
    return lambda score: any_of(float(2.0 * norm.sf(score)), count)


def _chi2_score(value: Places, dof: Real[np.ndarray, " places"]) -> Places:
    """Standard normal variates as improbable as these χ² ones."""
    below, above = chi2.cdf(value, dof), chi2.sf(value, dof)
    z = np.where(below < 0.5, norm.ppf(np.maximum(below, TINY)), norm.isf(np.maximum(above, TINY)))
    ratio = np.maximum(value / dof, 1e-300)
    deviance = np.sqrt(np.maximum(dof * (ratio - 1.0 - np.log(ratio)), _FAR**2))
    return np.where(abs(z) < _FAR, z, np.sign(z) * deviance)


# --- Slow noise: cluster times ------------------------------------------------------------------------------


def cluster_times(record: StageResiduals) -> list[Profile]:
    """Profiles of the Allan deviation at octaves, and of the drift of the integrated rate.

    The drift over T, less that at the mean rate over an equally long time before, is √2·T times the Allan
    deviation at T; it is given at round times.
    """
    octaves = cluster_sizes(record.n, record.rate)
    horizons = 2.0 ** np.arange(np.floor(np.log2(max(record.n / record.rate / 4.0, 1.0))) + 1)
    stretches = np.unique(np.clip(np.rint(horizons * record.rate), 1, record.n // 2)).astype(int)
    (law,) = allan_laws([record], np.concatenate([octaves, stretches]))
    k = len(octaves)
    allan, drift = law.at(slice(k)), law.at(slice(k, None))
    angle = ANGLE[record.axis.sensor]
    factors = np.sqrt(2.0) * drift.time / unit_scale(angle, record.axis.sensor)
    return [allan_deviation(record, allan), _of_law("drift", drift, factors, angle)]


def allan_deviation(record: StageResiduals, law: AllanLaw) -> Profile:
    """Profile of the Allan deviation at the cluster times of a law."""
    return _of_law("allan_deviation", law, np.full(len(law.time), 1.0 / record.scale), record.axis.unit)


def _of_law(statistic: str, law: AllanLaw, factor: Places, unit: str) -> Profile:
    """Profile of a statistic that is the Allan deviation times a factor."""
    dof = degrees_of_freedom(law.fitted)
    z = _chi2_score(dof * law.measured / law.mean, dof)
    spread = np.sqrt(np.diag(law.fitted))
    values, vectors = np.linalg.eigh(law.fitted / np.outer(spread, spread))
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    draws = abs(root @ np.random.default_rng(0).standard_normal((len(z), _DRAWS))).max(axis=0)
    measured, simulated = (factor * np.sqrt(v) for v in (law.measured, law.quantile(0.5)))
    return Profile(
        statistic, law.time, "s", measured, simulated, unit, z, lambda score: extrapolated(draws, score)
    )


# --- Frequencies --------------------------------------------------------------------------------------------


def psd(record: StageResiduals) -> Profile:
    """Profile of the one-sided PSD in logarithmic bins."""
    edges = octave_bins(record.n)
    first, count = edges[:-1] - 1, np.diff(edges)
    squares = np.add.reduceat(record.whitened_coefficients**2, first)
    z = _chi2_score(squares, count)
    level = 2.0 / record.rate * np.add.reduceat(record.variance, first) / count / record.scale**2
    middle = (edges[:-1] + edges[1:] - 1) * record.rate / (4.0 * record.n)
    measured, simulated = (level * x / count for x in (squares, chi2.median(count)))
    unit = f"({record.axis.unit})²/Hz"
    return Profile("psd", middle, "Hz", measured, simulated, unit, z, _independent(len(z)))


def line(record: StageResiduals) -> Profile:
    """Profile of the amplitude at the Fourier frequencies, where white noise is independent."""
    n = record.n
    spectrum = rfft(record.whitened, workers=-1)[1 : (n + 1) // 2]
    power = (spectrum.real**2 + spectrum.imag**2) / n
    count = len(power)
    noise = np.sqrt(record.variance[1 : 2 * count : 2]) / record.scale
    # Median of the largest of so many: half of all simulations stay below it.
    typical = -np.log(-np.expm1(np.log(0.5) / count))
    measured, simulated = (2.0 * np.sqrt(u / n) * noise for u in (power, typical))
    return Profile(
        "psd_line",
        np.arange(1, count + 1) * record.rate / n,
        "Hz",
        measured,
        simulated,
        record.axis.unit,
        np.sqrt(2.0 * power),
        lambda score: any_of(float(np.exp(-0.5 * score**2)), count),
    )


def autocorrelation(record: StageResiduals) -> Profile:
    """Profile of the autocorrelation of the whitened residuals.

    It is that of the record continued by its mirror image: (1/n) Σ z_j² cos(a_j k), of variance 1/n.
    """
    n = record.n
    squares = np.concatenate([[1.0], record.whitened_coefficients**2 - 1.0, [0.0]])
    squares[0] = 0.0
    lags = min(_LAGS, n // 10)
    r = dct(squares, type=1, workers=-1)[1 : lags + 1] / (2.0 * n)
    lag = np.arange(1, lags + 1) / record.rate
    return Profile("autocorrelation", lag, "s", r, np.zeros(lags), "1", r * np.sqrt(n), _independent(lags))


# --- Values -------------------------------------------------------------------------------------------------


def tails(record: StageResiduals) -> Profile:
    """Profile of the excess kurtosis of the whitened residuals (Anscombe & Glynn 1983)."""
    squares = record.whitened**2
    excess = float(np.mean(squares**2) / np.mean(squares) ** 2 - 3.0)
    p = max(float(kurtosistest(record.whitened).pvalue), TINY)
    nowhere, measured, score = np.zeros(1), np.array([excess]), np.array([float(norm.isf(0.5 * p))])
    return Profile("tails", nowhere, "", measured, np.zeros(1), "1", score, lambda _: p)


def largest_residual(record: StageResiduals) -> Profile:
    """Profile of the magnitudes of the whitened residuals."""
    n = record.n
    typical = float(norm.isf(-0.5 * np.expm1(np.log(0.5) / n)))
    return Profile(
        "largest_residual",
        np.arange(n) / record.rate,
        "s",
        abs(record.whitened),
        np.full(n, typical),
        "σ",
        record.whitened,
        _independent(n),
    )


# --- Time ---------------------------------------------------------------------------------------------------


def windows(record: StageResiduals) -> list[Profile]:
    """Profiles of the mean and the mean square of the whitened residuals in 2, 4, … 64 windows."""
    n, e = record.n, record.whitened
    finest = 2 ** int(np.log2(np.clip(n / _SHORTEST, 2, _WINDOWS)))
    edges = np.rint(np.linspace(0.0, n, finest + 1)).astype(int)
    sums, squares = (np.add.reduceat(x, edges[:-1]) for x in (e, e**2))
    length = _merged(np.diff(edges).astype(float))
    start = np.concatenate([edges[:-1:step] for step in _steps(finest)]).astype(float)
    total, square = _merged(sums), _merged(squares)
    # All residuals together have no mean.
    means = total / np.sqrt(length * (1.0 - length / n))
    variances = _chi2_score(square, length)
    found = []
    for statistic, z, value, expected in (
        ("window_mean", means, total / length, 0.0),
        ("window_variance", variances, square / length, 1.0),
    ):
        null = _window_null(finest, statistic == "window_mean")
        middle = (start + 0.5 * length) / record.rate
        unit = "σ" if statistic == "window_mean" else "1"
        simulated = np.full(len(z), expected)
        law = functools.partial(extrapolated, null)
        found.append(Profile(statistic, middle, "s", value, simulated, unit, z, law))
    return found


def _steps(finest: int) -> list[int]:
    """Numbers of finest windows in a window: 1, 2, 4, … half of them."""
    return [2**k for k in range(int(np.log2(finest)))]


def _merged(x: Float[np.ndarray, "windows ..."]) -> Float[np.ndarray, "all ..."]:
    """Sums over the finest windows, over pairs of them, …, over halves."""
    return np.concatenate([x.reshape(-1, step, *x.shape[1:]).sum(axis=1) for step in _steps(len(x))])


@functools.lru_cache(maxsize=8)
def _window_null(finest: int, without_mean: bool) -> Float[np.ndarray, " draws"]:
    """Draws of the largest magnitude among the normal scores of all windows."""
    z = np.random.default_rng(0).standard_normal((finest, _DRAWS))
    if without_mean:
        z -= z.mean(axis=0)
    share = _merged(np.full(finest, 1.0 / finest))[:, None]
    spread = np.sqrt(finest * share * ((1.0 - share) if without_mean else 1.0))
    return abs(_merged(z) / spread).max(axis=0)


# --- Other channels -----------------------------------------------------------------------------------------


def cross_correlation(record: StageResiduals, others: Mapping[str, StageResiduals]) -> Profile:
    """Profile of the correlations with the whitened residuals of other axes."""
    score = np.array(
        [_matched(record.whitened_coefficients, other.whitened_coefficients)[0] for other in others.values()]
    )
    none, r = np.zeros(len(score)), score / np.sqrt(record.n)
    return Profile(
        "cross_correlation", none, "", r, none, "1", score, _independent(len(score)), tuple(others)
    )


def auxiliary_correlation(
    record: StageResiduals, channels: Mapping[str, Float[np.ndarray, " n-1"]]
) -> Profile:
    """Profile of the outputs of filters matched to other channels, given as cosine coefficients.

    An output is an rms in the axis's unit. A slow channel has few independent samples; their number follows
    from the noise at its frequencies.
    """
    root = np.sqrt(record.variance)
    found = [
        (*_matched(record.whitened_coefficients, h / root), float(np.linalg.norm(h)))
        for h in channels.values()
    ]
    score = np.array([z for z, _, _ in found])
    error = np.array([rms / length for _, length, rms in found]) / np.sqrt(record.n) / record.scale
    typical = float(norm.isf(0.25)) * error
    return Profile(
        "auxiliary_correlation",
        np.zeros(len(score)),
        "",
        abs(score) * error,
        typical,
        record.axis.unit,
        score,
        _independent(len(score)),
        tuple(channels),
    )


def _matched(z: Float[np.ndarray, " n-1"], h: Float[np.ndarray, " n-1"]) -> tuple[float, float]:
    """Output of a matched filter, standard normal without the effect, and the filter's norm."""
    length = float(np.linalg.norm(h))
    return float(z @ h) / max(length, 1e-300), max(length, 1e-300)


def discrepancies(
    record: StageResiduals,
    raw: Float[np.ndarray, " recorded"],
    others: Mapping[str, StageResiduals] | None = None,
    auxiliary: Mapping[str, Float[np.ndarray, " n"]] | None = None,
    seed: int = 0,
) -> tuple[Discrepancy, ...]:
    """Discrepancy of one axis at one stage from its simulations in every statistic, also where p is near 1.

    Args:
        record: the axis.
        raw: its samples as recorded [SI], without missing ones; imputed ones after a finding that explains
            their distribution, such as rounding.
        others, auxiliary: other axes and other channels, by name.
        seed: seed of the simulation in which repeated values are counted.
    """
    of_samples = [_lattice(record, raw), _repeated(record, raw, seed)]
    first = [*profiles.cluster_times(record), profiles.psd(record), profiles.line(record)]
    first += [of(record) for of in (profiles.autocorrelation, profiles.tails, profiles.largest_residual)]
    last = profiles.windows(record)
    if others:
        last.append(profiles.cross_correlation(record, others))
    if channels := _varying(auxiliary):
        last.append(profiles.auxiliary_correlation(record, channels))
    return (*(p.worst() for p in first), *of_samples, *(p.worst() for p in last))


def before_and_after(
    records: Sequence[StageResiduals], auxiliary: Mapping[str, Float[np.ndarray, " n"]] | None = None
) -> list[tuple[tuple[Discrepancy, Discrepancy], ...]]:
    """Pairs of a statistic before and after each finding, at the place of the largest improvement.

    The records are those of an axis before its first finding and after each.
    """
    laws = allan_laws(records, cluster_sizes(records[0].n, records[0].rate))
    channels = _varying(auxiliary)
    stages = []
    for record, law in zip(records, laws, strict=True):
        # Those that cost little compared with the transforms.
        cheap = (profiles.psd, profiles.line, profiles.tails, profiles.largest_residual)
        of_record = [profiles.allan_deviation(record, law), *(of(record) for of in cheap)]
        of_record += profiles.windows(record)
        if channels:
            of_record.append(profiles.auxiliary_correlation(record, channels))
        stages.append(of_record)
        record.forget()
    found = []
    for before, after in itertools.pairwise(stages):
        pairs = []
        for old, new in zip(before, after, strict=True):
            place = int(np.argmax(abs(old.score) ** 2 - abs(new.score) ** 2))
            pairs.append((old.at(place), new.at(place)))
        found.append(tuple(pairs))
    return found


def _varying(
    auxiliary: Mapping[str, Float[np.ndarray, " n"]] | None,
) -> dict[str, Float[np.ndarray, " n-1"]]:
    """Cosine coefficients of the channels that are finite and not constant."""
    channels = {name: np.asarray(h, float) for name, h in (auxiliary or {}).items()}
    return {name: centred(h) for name, h in channels.items() if np.isfinite(h).all() and np.ptp(h) > 0.0}


def _lattice(record: StageResiduals, raw: Float[np.ndarray, " recorded"]) -> Discrepancy:
    """Share of the samples on a lattice; one finer than the noise only reflects the number format of the
    file."""
    q = lattice(raw)
    if q is None or q < HARMLESS / np.sqrt(np.mean(1.0 / record.variance)):
        return Discrepancy("lattice", 0.0, "", 0.0, 0.0, "1", 1.0)
    return Discrepancy("lattice", 0.0, "", 1.0, 0.0, "1", TINY)


def _repeated(record: StageResiduals, raw: Float[np.ndarray, " recorded"], seed: int) -> Discrepancy:
    """Share of samples equal to the one before, also in simulations with the recording's resolution."""
    gaps = np.diff(np.unique(raw))
    q = float(gaps.min()) if len(gaps) else 0.0
    count = int(np.sum(raw[1:] == raw[:-1]))
    simulated = 0
    if q > 0.0:
        x = np.rint((record.simulate(seed)[: len(raw)] + float(np.mean(raw))) / q)
        simulated = int(np.sum(x[1:] == x[:-1]))
    # Two counts with the same expectation: an event is in either of them by chance.
    p = max(float(binom.sf(count - 1, count + simulated, 0.5)), TINY)
    n = len(raw) - 1
    return Discrepancy("repeated_values", 0.0, "", count / n, simulated / n, "1", p)

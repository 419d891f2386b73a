"""Statistics in which measurement and simulation are compared, at all their places.

Each has a law on records of the model, and its p-value allows for all places searched (cluster times,
frequencies, lags, windows, channels). Laws are those of coefficients c_j ~ N(0, v_j) with the model's v as
given. Those of the Allan deviation and the drift, which depend on slow noise that few data determine, allow
for levels that were fitted to the same record.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Real
from scipy.fft import dct, rfft
from scipy.stats import binom, chi2, kurtosistest, norm, skew, skewtest

from allanjax.allan.estimators import cluster_sizes
from allanjax.critic.bank import any_of, extrapolated
from allanjax.critic.comparison import (
    AllanLaw,
    StageResiduals,
    allan_law,
    degrees_of_freedom,
    octave_bins,
)
from allanjax.critic.effects.rounding import HARMLESS
from allanjax.critic.finding import Discrepancy
from allanjax.critic.free import Free
from allanjax.critic.noise import centred
from allanjax.inspection.plausible import lattice
from allanjax.record.units import unit_scale

#: Smallest p-value that is reported; smaller ones are beyond floating point.
TINY = 1e-300
# Most lags of the autocorrelation, most windows, fewest samples in one.
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
        score: difference between measurement and simulations at each place: standard normal under the model,
            or a magnitude that grows like one.
        law: p-value of the largest magnitude among the scores.
        numbers: place, measured value, and median of simulations, by the number of the place.
        channels: other axes or channels, one place each, for correlations.
        extent: start and end of each place, of windows in time and bands of frequencies.
    """

    statistic: str
    where_unit: str
    unit: str
    score: Places
    law: Callable[[float], float]
    numbers: Callable[[int], tuple[float, float, float]]
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
        p_value = float(np.clip(self.law(float(abs(self.score[place]))), TINY, 1.0))
        channel = self.channels[place] if self.channels else ""
        return Discrepancy(
            self.statistic, where, self.where_unit, measured, simulated, self.unit, p_value, channel
        )

    def worst(self) -> Discrepancy:
        """Discrepancy at the place where measurement and simulation differ most."""
        return self.at(int(np.argmax(abs(self.score))))


def _listed(
    where: Places, measured: Places, simulated: Places
) -> Callable[[int], tuple[float, float, float]]:
    """Numbers of a profile from arrays."""
    return lambda place: (where[place], measured[place], simulated[place])


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
    law, k = allan_law(record, np.concatenate([octaves, stretches])), len(octaves)
    allan, drift = law.at(slice(k)), law.at(slice(k, None))
    angle = ANGLE[record.axis.sensor]
    factors = np.sqrt(2.0) * drift.time / unit_scale(angle, record.axis.sensor)
    scale = np.full(k, 1.0 / record.scale)
    return [
        _of_law("allan_deviation", allan, scale, record.axis.unit),
        _of_law("drift", drift, factors, angle),
    ]


def _of_law(statistic: str, law: AllanLaw, factor: Places, unit: str) -> Profile:
    """Profile of a statistic that is the Allan deviation times a factor."""
    dof = degrees_of_freedom(law.fitted)
    z = _chi2_score(dof * law.measured / law.mean, dof)
    spread = np.sqrt(np.diag(law.fitted))
    values, vectors = np.linalg.eigh(law.fitted / np.outer(spread, spread))
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    draws = abs(root @ np.random.default_rng(0).standard_normal((len(z), _DRAWS))).max(axis=0)
    measured, simulated = (factor * np.sqrt(v) for v in (law.measured, law.quantile(0.5)))
    p_value = functools.partial(extrapolated, draws)
    return Profile(statistic, "s", unit, z, p_value, _listed(law.time, measured, simulated))


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
    between = (edges - 0.5) * record.rate / (2.0 * record.n)
    numbers = _listed(middle, measured, simulated)
    return Profile("psd", "Hz", unit, z, _independent(len(z)), numbers, extent=(between[:-1], between[1:]))


def line(record: StageResiduals) -> Profile:
    """Profile of the amplitude at the Fourier frequencies, where white noise is independent."""
    n = record.n
    spectrum = rfft(record.whitened, workers=-1)[1 : (n + 1) // 2]
    power = spectrum.real**2
    power += spectrum.imag**2
    score = np.sqrt(np.multiply(power, 2.0 / n, out=power), out=power)
    count = len(score)
    # Median of the largest of so many: half of all simulations stay below it.
    typical = np.sqrt(-2.0 * np.log(-np.expm1(np.log(0.5) / count)))

    def numbers(place: int) -> tuple[float, float, float]:
        noise = float(np.sqrt(2.0 * record.variance[2 * place + 1] / n)) / record.scale
        return (place + 1) * record.rate / n, noise * score[place], noise * typical

    def law(score: float) -> float:
        return any_of(float(np.exp(-0.5 * score**2)), count)

    middle, half = np.arange(1, count + 1) * record.rate / n, record.rate / n
    return Profile(
        "psd_line", "Hz", record.axis.unit, score, law, numbers, extent=(middle - half, middle + half)
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
    numbers = _listed(lag, r, np.zeros(lags))
    return Profile("autocorrelation", "s", "1", r * np.sqrt(n), _independent(lags), numbers)


# --- Values -------------------------------------------------------------------------------------------------


def tails(record: StageResiduals) -> Profile:
    """Profile of the excess kurtosis of the whitened residuals (Anscombe & Glynn 1983)."""
    squares = record.whitened**2
    excess = float(np.mean(squares**2) / np.mean(squares) ** 2 - 3.0)
    return _of_shape("tails", excess, float(kurtosistest(record.whitened).pvalue))


def skewness(record: StageResiduals) -> Profile:
    """Profile of the skewness of the whitened residuals (D'Agostino 1970)."""
    return _of_shape("skewness", float(skew(record.whitened)), float(skewtest(record.whitened).pvalue))


def _of_shape(statistic: str, value: float, p_value: float) -> Profile:
    """Profile of a property of the whole distribution that is 0 for a normal one."""
    p = max(p_value, TINY)
    score = np.array([float(norm.isf(0.5 * p))])
    return Profile(statistic, "", "1", score, lambda _: p, lambda _: (0.0, value, 0.0))


def largest_residual(record: StageResiduals) -> Profile:
    """Profile of the magnitudes of the whitened residuals."""
    n, e = record.n, record.whitened
    typical = float(norm.isf(-0.5 * np.expm1(np.log(0.5) / n)))

    def numbers(place: int) -> tuple[float, float, float]:
        return place / record.rate, abs(float(e[place])), typical

    return Profile("largest_residual", "s", "σ", e, _independent(n), numbers)


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
        law = functools.partial(extrapolated, _window_null(finest, statistic == "window_mean"))
        middle, simulated = (start + 0.5 * length) / record.rate, np.full(len(z), expected)
        unit = "σ" if statistic == "window_mean" else "1"
        ends = start / record.rate, (start + length) / record.rate
        found.append(Profile(statistic, "s", unit, z, law, _listed(middle, value, simulated), extent=ends))
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
    none, r, law = np.zeros(len(score)), score / np.sqrt(record.n), _independent(len(score))
    return Profile("cross_correlation", "", "1", score, law, _listed(none, r, none), tuple(others))


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
    numbers = _listed(np.zeros(len(score)), abs(score) * error, float(norm.isf(0.25)) * error)
    law = _independent(len(score))
    return Profile("auxiliary_correlation", "", record.axis.unit, score, law, numbers, tuple(channels))


def _matched(z: Float[np.ndarray, " n-1"], h: Float[np.ndarray, " n-1"]) -> tuple[float, float]:
    """Output of a matched filter, standard normal without the effect, and the filter's norm."""
    length = float(np.linalg.norm(h))
    return float(z @ h) / max(length, 1e-300), max(length, 1e-300)


# --- The samples themselves ---------------------------------------------------------------------------------


class Resolution(NamedTuple):
    """What the samples as recorded tell of their resolution.

    Attributes:
        length: number of samples.
        mean: their mean [SI].
        lattice: step of which all are multiples; None if there is none.
        gap: smallest difference of two values; 0 if all are equal.
        repeated: number of samples equal to the one before.
    """

    length: int
    mean: float
    lattice: float | None
    gap: float
    repeated: int

    @classmethod
    def of(cls, raw: Float[np.ndarray, " recorded"]) -> Resolution:
        """Resolution of these samples."""
        gaps = np.diff(np.unique(raw))
        repeated = int(np.count_nonzero(raw[1:] == raw[:-1]))
        gap = float(gaps.min()) if len(gaps) else 0.0
        return cls(len(raw), float(np.mean(raw)), lattice(raw), gap, repeated)


def _lattice(record: StageResiduals, raw: Resolution) -> Discrepancy:
    """Share of the samples on a lattice; one finer than the noise only reflects the number format of the
    file."""
    q = raw.lattice
    if q is None or q < HARMLESS / np.sqrt(np.mean(1.0 / record.variance)):
        return Discrepancy("lattice", 0.0, "", 0.0, 0.0, "1", 1.0)
    return Discrepancy("lattice", 0.0, "", 1.0, 0.0, "1", TINY)


def _repeated(record: StageResiduals, raw: Resolution, seed: int = 0) -> Discrepancy:
    """Share of samples equal to the one before, also in simulations with the recording's resolution."""
    count, simulated, q = raw.repeated, 0, raw.gap
    if q > 0.0:
        x = record.simulate(seed)[: raw.length]
        x += raw.mean
        x /= q
        np.rint(x, out=x)
        simulated = int(np.count_nonzero(x[1:] == x[:-1]))
    # Two counts with the same expectation: an event is in either of them by chance.
    p = max(float(binom.sf(count - 1, count + simulated, 0.5)), TINY)
    n = raw.length - 1
    return Discrepancy("repeated_values", 0.0, "", count / n, simulated / n, "1", p)


# --- All of them --------------------------------------------------------------------------------------------

# Their order in a critique.
_ORDER = (
    *("allan_deviation", "drift", "psd", "psd_line", "autocorrelation", "skewness", "tails"),
    *("largest_residual", "lattice", "repeated_values", "window_mean", "window_variance"),
    *("cross_correlation", "auxiliary_correlation"),
)


class Comparison(NamedTuple):
    """Discrepancies of an axis from its simulations before the first finding and after the last one.

    Attributes:
        before, after: in every statistic, also where p is near 1.
        pairs: for each finding a statistic before and after it, at the place of the largest improvement.
        last: profiles after the last finding whose places have an extent.
        free: what descriptions that name nothing gain over the model, at the first and the last stage.
    """

    before: tuple[Discrepancy, ...]
    after: tuple[Discrepancy, ...]
    pairs: list[tuple[tuple[Discrepancy, Discrepancy], ...]]
    last: tuple[Profile, ...]
    free: tuple[Free, Free]

    def rest(self, span: tuple[float, float], domain: str) -> Discrepancy | None:
        """Largest discrepancy after the last finding in a part of the record [s] or of the spectrum [Hz]."""
        unit = {"time": "s", "frequency": "Hz"}[domain]
        return min((p.within(*span) for p in self.last if p.where_unit == unit), key=lambda d: d.p_value)


def compared(
    stages: Sequence[StageResiduals],
    raw: tuple[Float[np.ndarray, " recorded"], Float[np.ndarray, " recorded"]],
    others: tuple[Mapping[str, StageResiduals], Mapping[str, StageResiduals]],
    auxiliary: Mapping[str, Float[np.ndarray, " n"]],
) -> Comparison:
    """Comparison of an axis with simulations, at the stages before the first finding and after each.

    Args:
        stages: the axis at these stages.
        raw: its samples as recorded [SI], without missing ones, before the first finding and after the last;
            then with imputed ones if a finding explains their distribution, such as rounding.
        others: other axes by name, at their first stage and at their last.
        auxiliary: other channels by name.
    """
    channels, last = _varying(auxiliary), len(stages) - 1
    ends: list[tuple[Discrepancy, ...]] = []
    pairs: list[tuple[tuple[Discrepancy, Discrepancy], ...]] = []
    former: list[Profile] = []
    free: list[Free] = []
    resolution = Resolution.of(raw[0])
    for k, record in enumerate(stages):
        if k:
            record.reuse(stages[k - 1])
        profiles = _profiles(record, channels)
        if k:
            pairs.append(_improved(former, profiles))
            stages[k - 1].forget()
        former = profiles
        if k in (0, last):
            free.append(Free.of(record))
            if k and raw[1] is not raw[0]:
                resolution = Resolution.of(raw[1])
            found = [p.worst() for p in (*profiles, autocorrelation(record))]
            found += [_lattice(record, resolution), _repeated(record, resolution)]
            for end in {0: others[:1], last: others[1:]}[k] if last else others:
                axes = [cross_correlation(record, end).worst()] if end else []
                ends.append(tuple(sorted([*found, *axes], key=lambda d: _ORDER.index(d.statistic))))
    stages[-1].forget()
    return Comparison(ends[0], ends[1], pairs, tuple(p for p in former if p.extent), (free[0], free[-1]))


def _profiles(record: StageResiduals, channels: Mapping[str, Float[np.ndarray, " n-1"]]) -> list[Profile]:
    """Profiles of an axis at a stage, except those that take long compared with the transforms."""
    found = [*cluster_times(record), psd(record), line(record), skewness(record), tails(record)]
    found += [largest_residual(record), *windows(record)]
    return [*found, auxiliary_correlation(record, channels)] if channels else found


def _improved(
    before: Sequence[Profile], after: Sequence[Profile]
) -> tuple[tuple[Discrepancy, Discrepancy], ...]:
    """Pairs of a statistic at two stages, at the place of the largest improvement."""
    pairs = []
    for old, new in zip(before, after, strict=True):
        # A finding has a drift of its own, see `gain`.
        if old.statistic == "drift":
            continue
        change = old.score**2
        change -= new.score**2
        place = int(np.argmax(change))
        pairs.append((old.at(place), new.at(place)))
    return tuple(pairs)


def _varying(auxiliary: Mapping[str, Float[np.ndarray, " n"]]) -> dict[str, Float[np.ndarray, " n-1"]]:
    """Cosine coefficients of the channels that are finite and not constant."""
    channels = {name: np.asarray(h, float) for name, h in auxiliary.items()}
    return {name: centred(h) for name, h in channels.items() if np.isfinite(h).all() and np.ptp(h) > 0.0}

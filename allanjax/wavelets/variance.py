"""Wavelet variance of a static recording: its power in octaves of frequency, unaffected by its ends.

At level j it is the mean square of the coefficients of the maximal overlap transform (MODWT), with unit
scaling gain, without those that depend on samples beyond the record (Percival & Walden 2000,
section 8.3: the unbiased estimate). Level j covers the octave from rate/2^(j+1) to rate/2^j nominally, and
has the scale 2^(j−1) samples. With the Haar wavelet it is half the overlapping Allan variance at clusters as
long as the scale, up to rounding.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from types import ModuleType
from typing import TYPE_CHECKING, ClassVar

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float, Int

from allanjax.allan.covariance import AllanCovariance, padded_quadrature
from allanjax.base.arrays import namespace
from allanjax.base.chi_squared import chi_squared_factors
from allanjax.base.equality import ByValue
from allanjax.base.errors import AllanjaxError
from allanjax.base.wording import plain
from allanjax.noise.model import Model
from allanjax.noise.notation import ModelLike, as_model
from allanjax.noise.process import Process, numbers_as_data
from allanjax.noise.terms import AngleRandomWalk
from allanjax.record.columns import OfAxes
from allanjax.record.io.given import RecordingLike, living_samples
from allanjax.record.recording import Axis
from allanjax.spectrum.autocorrelation import square_unit

if TYPE_CHECKING:
    import pandas as pd


def pywavelets() -> ModuleType:
    """PyWavelets' module; AllanjaxError with the remedy if it is not installed."""
    try:
        import pywt
    except ImportError as error:
        raise AllanjaxError('this needs PyWavelets: pip install "allanjax[wavelets]"') from error
    return pywt


@dataclasses.dataclass(frozen=True)
class WaveletFilter:
    """Filters of the maximal overlap transform (MODWT), those of an orthogonal wavelet over √2.

    Attributes:
        name: the wavelet's name in PyWavelets, e.g. "haar" or "sym4".
        low: scaling filter, of sum 1.
        high: wavelet filter, of sum 0; square sums of both are 1/2.
    """

    name: str
    low: tuple[float, ...]
    high: tuple[float, ...]

    @classmethod
    def of(cls, name: str) -> WaveletFilter:
        """Filters of the wavelet of this name.

        Raises:
            AllanjaxError: no such wavelet, one that is not orthogonal, or PyWavelets is not installed ("haar"
                does not need it).
        """
        if name == "haar":
            return cls(name, (0.5, 0.5), (0.5, -0.5))
        pywt = pywavelets()
        if name not in pywt.wavelist(kind="discrete") or not pywt.Wavelet(name).orthogonal:
            raise AllanjaxError(
                f"{name!r} is not an orthogonal wavelet of PyWavelets; use e.g. haar, db2, db4, sym4, coif1"
            )
        wavelet = pywt.Wavelet(name)
        low, high = (tuple(np.array(f) / np.sqrt(2.0)) for f in (wavelet.dec_lo, wavelet.dec_hi))
        return cls(name, low, high)

    def length(self, level: int) -> int:
        """Samples that a coefficient at this level depends on, (2^level − 1)(L − 1) + 1."""
        return (2**level - 1) * (len(self.low) - 1) + 1

    def most_levels(self, n: int) -> int:
        """Highest level with a coefficient that depends on no sample beyond the n samples.

        Raises:
            AllanjaxError: there is none.
        """
        levels = int(np.log2(max((n - 1) / (len(self.low) - 1) + 1.0, 1.0)) + 1e-9)
        if levels < 1:
            raise AllanjaxError(f"{n} samples are too few for {self.name}, which needs {self.length(1)}")
        return levels

    def impulse(self, level: int) -> Float[np.ndarray, " length"]:
        """Equivalent wavelet filter of a level."""
        impulse = _spread(self.high, level - 1)
        for k in range(level - 1):
            impulse = np.convolve(impulse, _spread(self.low, k))
        return impulse

    def gain(
        self, levels: int, frequency: Float[np.ndarray, "octaves points"], resolved: int
    ) -> Float[np.ndarray, "levels octaves points"]:
        """Squared gains of the wavelet filters of levels 1 … `levels`, at frequencies [cycles per sample].

        Points are in octaves, the highest first. In octave k, which ends at 2^−(k+1), the filters of the
        cascade's steps up to k + `resolved` vary slowly from point to point. Later ones vary so fast that
        their mean is taken, which is the energy of the rest of the cascade.
        """
        octave = np.arange(len(frequency))[:, None]
        passed, gains = np.ones_like(frequency), []
        for k in range(levels):
            slow = k <= octave + resolved
            gains.append(np.where(slow, passed * self._step(self.high, 2**k * frequency), passed / 2.0))
            passed = np.where(slow, passed * self._step(self.low, 2**k * frequency), passed / 2.0)
        return np.stack(gains)

    @staticmethod
    def _step(
        coefficients: tuple[float, ...], frequency: Float[np.ndarray, "octaves points"]
    ) -> Float[np.ndarray, "octaves points"]:
        """Squared gain of a filter, from its autocorrelation."""
        r = np.correlate(coefficients, coefficients, "full")[len(coefficients) - 1 :]
        cosines = np.cos(2.0 * np.pi * np.arange(1, len(r))[:, None, None] * frequency)
        return np.maximum(r[0] + 2.0 * np.tensordot(r[1:], cosines, 1), 0.0)


def _spread(coefficients: tuple[float, ...], step: int) -> Float[np.ndarray, " length"]:
    """Coefficients with 2^step − 1 zeros between neighbours."""
    found = np.zeros(2**step * (len(coefficients) - 1) + 1)
    found[:: 2**step] = coefficients
    return found


# Expectation and covariance of wavelet variances under a noise model.
#
# A coefficient W_j at level j is a sum of samples whose weights h_j sum to zero, that is, of phases whose
# weights annihilate a constant and a trend: its covariance follows from the phase covariance G, or from the
# spectrum S of the samples, which is the cosine sum of −δ²G (`noise.process`). With H_j the transfer function
# of h_j, frequencies in cycles per sample and R the sample rate,
#
#     E V_j = 2R ∫₀^½ |H_j|² S df,    Σ_s C_jk(s)² = 2R² ∫₀^½ |H_j|² |H_k|² S² df,
#
# where V_j is the mean of W_j² over the M_j coefficients that the record's ends do not affect, and C_jk(s)
# the covariance of W_j and W_k at lag s. For many coefficients cov(V_j, V_k) is 2 Σ_s C_jk(s)²/max(M_j, M_k)
# (Percival & Walden 2000, section 8.3). At the highest levels they are few: there it is multiplied by the
# ratio of the exact sum over pairs of coefficients to this one under white noise, which all noise resembles
# within the octave of a level.
#
# S is smooth: it enters by its values at a few frequencies per octave, whose weights are integrals of the
# gains times Lagrange polynomials. They are data, so that one program serves records of any length and
# rate. The Haar wavelet has another formula, which is exact: its variance is half the Allan variance
# (`allan.covariance`).

# Octaves of frequency with nodes, so many nodes each, and the points at which their weights are integrated.
_OCTAVES, _NODES, _POINTS = 32, 8, 2048
# Steps of the cascade beyond a point's octave whose gains these points resolve.
_RESOLVED = 6
# Highest levels for which the pairs of coefficients are counted one by one, on a record thinned to these.
_COUNTED = 8


class WaveletCovariance(AllanCovariance):
    """Quadrature for the covariance of wavelet variance estimates: its part that is common to all models.

    `lags` are frequencies [Hz] here, the same for all pairs of levels.

    Attributes:
        gains: weights of the spectrum at the frequencies in the expectation of each level.
    """

    gains: Float[np.ndarray, "lags m"]

    @classmethod
    def of_levels(
        cls, n: int, rate: float, wavelet: WaveletFilter, levels: Int[np.ndarray, " m"], capacity: int = 0
    ) -> WaveletCovariance:
        """Quadrature for estimates at these levels, 1 and up, of n rate samples at `rate` [Hz].

        Arrays are padded to `capacity` levels, if there are fewer.
        """
        m = len(levels)
        i, j = np.triu_indices(m)
        count = n - np.array([wavelet.length(k) for k in levels]) + 1
        nodes, points, basis = _quadrature()
        gain = wavelet.gain(int(levels[-1]), points, _RESOLVED)[levels - 1].swapaxes(0, 1)
        # Widths of the points' cells, octave by octave.
        width = 0.5 ** np.arange(2, _OCTAVES + 2)[:, None, None] / _POINTS
        gains = 2.0 * rate * width * (basis @ gain.swapaxes(1, 2))
        squares = np.stack([(gain * polynomial) @ gain.swapaxes(1, 2) for polynomial in basis], axis=1)
        products = 2.0 * rate**2 * width * squares[..., i, j]
        few = _few_coefficients(count, wavelet, levels)[i, j]
        weights = (2.0 * few / np.maximum(count[i], count[j]) * products).reshape(-1, len(i))
        lags = np.repeat(rate * nodes.reshape(-1, 1), len(i), axis=1)
        gains = np.pad(gains.reshape(-1, m), ((0, 0), (0, max(capacity - m, 0))))
        return cls(**padded_quadrature(n, rate, 2 ** (levels - 1), capacity, lags, weights), gains=gains)

    def kernel(self, term: Process) -> Float[Array, "lags pairs"]:
        """Spectrum of one noise term at the quadrature's frequencies, the same for all pairs."""
        density = self._density(term)
        return namespace(density).broadcast_to(density[:, None], self.lags.shape)

    def mean(self, term: Process) -> Float[Array, " m"]:
        """Expected wavelet variances of one term [rate²]; zero where there is no estimate."""
        return self._density(term) @ self.gains

    def _density(self, term: Process) -> Float[Array, " lags"]:
        return term.sampled_psd(self.lags[:, 0], 1.0 / self.sample_interval)  # type: ignore[arg-type]


def _quadrature() -> tuple[
    Float[np.ndarray, "octaves nodes"], Float[np.ndarray, "octaves points"], Float[np.ndarray, "nodes points"]
]:
    """Nodes and points [cycles per sample] in every octave, the highest first, and Lagrange polynomials."""
    x = (1.0 - np.cos(np.pi * (np.arange(_NODES) + 0.5) / _NODES)) / 2.0
    t = (np.arange(_POINTS) + 0.5) / _POINTS
    basis = np.ones((_NODES, _POINTS))
    for k in range(_NODES):
        for other in np.delete(x, k):
            basis[k] *= (t - other) / (x[k] - other)
    low = 0.5 ** np.arange(2, _OCTAVES + 2)[:, None]
    return low * (1.0 + x), low * (1.0 + t), basis


def _few_coefficients(
    count: Int[np.ndarray, " m"], wavelet: WaveletFilter, levels: Int[np.ndarray, " m"]
) -> Float[np.ndarray, "m m"]:
    """Factor of the covariance where coefficients are few, exact under white noise; 1 at lower levels.

    With r the cross-correlation of two filters, it is Σ_s w(s) r(s)²/(M_j M_k) over Σ_s r(s)²/max(M_j, M_k),
    w(s) being the number of pairs of coefficients at lag s.
    """
    found = np.ones((len(levels), len(levels)))
    thin = max(int(levels[-1]) - _COUNTED, 0)
    counted = np.flatnonzero(levels > thin)
    impulses = [wavelet.impulse(int(levels[k]) - thin) for k in counted]
    size = 1 << (2 * len(impulses[-1])).bit_length()
    transforms = [np.fft.rfft(h, size) for h in impulses]
    lag = np.rint(np.fft.fftfreq(size) * size)
    for a, (k, H) in enumerate(zip(counted, transforms, strict=True)):
        for other, G in zip(counted[a:], transforms[a:], strict=True):
            squares = np.fft.irfft(H * G.conj(), size) ** 2
            Mh, Mg = count[[k, other]] / 2**thin
            pairs = np.clip(np.minimum(Mh + lag, Mg) - np.maximum(lag, 0), 0.0, None)
            exact = (pairs * squares).sum() / (Mh * Mg)
            found[k, other] = found[other, k] = exact / squares.sum() * max(Mh, Mg)
    return found


# Levels that compiled functions are padded to: those of 10⁷ samples.
_CAPACITY = 24


@dataclass(frozen=True, eq=False)
class WaveletVariance(ByValue, OfAxes):
    """Estimated wavelet variance of each axis by level.

    Attributes:
        level: [m] levels, from 1 on.
        variance: [m, axes] wavelet variances [rate²: (rad/s)² or (m/s²)², or the array's unit squared].
        count: [m] coefficients averaged.
        edf: [m, axes] equivalent degrees of freedom, 2·E[V]²/Var[V]; under white noise unless a model was
            given.
        n: rate samples per axis.
        rate: sample rate [Hz].
        wavelet: its name in PyWavelets.
        axes: the recording's axes, or None for an array.
    """

    PER_AXIS: ClassVar[tuple[str, ...]] = ("variance", "edf")

    level: Int[np.ndarray, " m"]
    variance: Float[np.ndarray, "m axes"]
    count: Int[np.ndarray, " m"]
    edf: Float[np.ndarray, "m axes"]
    n: int
    rate: float
    wavelet: str = "haar"
    axes: tuple[Axis, ...] | None = None

    @property
    def scale(self) -> Float[np.ndarray, " m"]:
        """Scales 2^(level − 1)/rate [s], which are the cluster times of the Allan variance."""
        return 2.0 ** (self.level - 1) / self.rate

    @property
    def band(self) -> Float[np.ndarray, "m 2"]:
        """Nominal lowest and highest frequency of each level [Hz]."""
        return bands(self.level, self.rate)

    @property
    def standard_error(self) -> Float[np.ndarray, "m axes"]:
        """Standard error of the variance: variance · √(2/edf)."""
        return self.variance * np.sqrt(2.0 / self.edf)

    def confidence_interval(
        self, level: float = 0.95
    ) -> tuple[Float[np.ndarray, "m axes"], Float[np.ndarray, "m axes"]]:
        """Lower and upper end of the central interval of the variance, by the χ² law.

        Raises:
            AllanjaxError: `level` not between 0 and 1.
        """
        lower, upper = chi_squared_factors(self.edf, level)
        return self.variance * lower, self.variance * upper

    def expectation(self, model: ModelLike) -> Float[np.ndarray, " m"]:
        """Expected wavelet variances [rate²] under a noise model with values."""
        return self._moments(model)[0]

    def covariance(self, model: ModelLike) -> Float[np.ndarray, "m m"]:
        """Covariance of the estimates of one axis [rate⁴] under a noise model with values.

        Raises:
            AllanjaxError: a parameter without a value; a line or a narrow resonance, whose wavelet variances
                have no such covariance.
        """
        return self._moments(model)[1]

    def _moments(self, model: ModelLike) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, "m m"]]:
        return moments(as_model(model), WaveletFilter.of(self.wavelet), self.level, self.n, self.rate)

    def to_dataframe(self) -> pd.DataFrame:
        """Table with one row per level: band, and each axis's variance, 68 % interval and degrees of freedom.

        Headings state the units, (deg/h)² or µg²; an array without units keeps its own.
        """
        import pandas as pd

        columns = {"level": self.level, "scale [s]": self.scale}
        columns |= {f"{end} [Hz]": x for end, x in zip(("from", "to"), self.band.T, strict=True)}
        lower, upper = self.confidence_interval(0.68)
        for k, name in enumerate(self.names):
            unit, scale = ("", 1.0) if self.axes is None else square_unit(self.axes[k])
            for label, x in (("", self.variance), (" lower_68", lower), (" upper_68", upper)):
                columns[f"{name}{label}" + (f" [{unit}]" if unit else "")] = x[:, k] / scale
            columns[f"{name} degrees of freedom"] = self.edf[:, k]
        return pd.DataFrame(columns)

    def __repr__(self) -> str:
        names = ", ".join(self.names) if self.axes else f"{self.variance.shape[1]} axes"
        first, last = self.scale[[0, -1]]
        return (
            f"WaveletVariance({self.wavelet}; {names}; {self.n} samples at {plain(self.rate, 6)} Hz; "
            f"{len(self.level)} levels of scales from {plain(first, 4)} s to {plain(last, 4)} s)"
        )


def bands(level: Int[np.ndarray, " m"], rate: float) -> Float[np.ndarray, "m 2"]:
    """Nominal lowest and highest frequency of the details at each level [Hz]."""
    return rate / 2.0 ** np.stack([level + 1.0, level], axis=1)


def wavelet_variance(
    data: RecordingLike,
    rate: float | None = None,
    *,
    wavelet: str = "haar",
    levels: int | None = None,
    model: ModelLike | None = None,
    gyro_unit: str | None = None,
    accel_unit: str | None = None,
    names: Sequence[str] | None = None,
) -> WaveletVariance:
    """Wavelet variance of every axis by the unbiased estimate of the maximal overlap transform.

    Args:
        data: a recording, or equally spaced samples [samples, axes] or [samples]; a data frame, or a path.
        rate: sample rate [Hz], for an array only: a recording has its own.
        wavelet: an orthogonal wavelet by its name in PyWavelets, such as "db2" or "sym4". Longer filters
            let less of neighbouring octaves into a level, but have fewer levels. All but "haar" remove a
            drift ramp.
        levels: number of levels; by default all with a coefficient that the record determines.
        model: a noise model with values, for the degrees of freedom; by default white noise.
        gyro_unit, accel_unit, names: units and names of an array, as for `Recording.from_array`; without a
            unit the variances are in the square of the array's unit.

    Raises:
        AllanjaxError: no positive rate, samples that are not finite or constant, too few for the levels, an
            unknown wavelet; PyWavelets is not installed ("haar" does not need it).
    """
    found = living_samples(data, rate, gyro_unit, accel_unit, names)
    values, rate = found.values, found.rate
    filters, n = WaveletFilter.of(wavelet), len(values)
    most = filters.most_levels(n)
    if levels is not None and not 1 <= levels <= most:
        raise AllanjaxError(f"{n} samples allow 1 to {most} levels of {wavelet}, not {levels}")
    level = np.arange(1, (levels or most) + 1)
    variance = np.stack([mean_squares(x, filters, level[-1]) for x in values.T], axis=1)
    noise = Model((AngleRandomWalk(1.0),)) if model is None else as_model(model)
    expected, covariance = moments(noise, filters, level, n, rate)
    edf = 2.0 * expected**2 / np.diag(covariance)
    return WaveletVariance(
        level=level,
        variance=variance,
        count=n - np.array([filters.length(int(j)) for j in level]) + 1,
        edf=np.broadcast_to(edf[:, None], variance.shape),
        n=n,
        rate=rate,
        wavelet=wavelet,
        axes=found.axes,
    )


def mean_squares(
    x: Float[np.ndarray, " n"], wavelet: WaveletFilter, levels: int
) -> Float[np.ndarray, " levels"]:
    """Mean squares of the coefficients of each level that the record's ends do not affect."""
    smooth, powers = x - x.mean(), []
    for k in range(levels):
        powers.append(np.mean(_filtered(smooth, wavelet.high, 2**k) ** 2))
        smooth = _filtered(smooth, wavelet.low, 2**k)
    return np.array(powers)


def _filtered(
    x: Float[np.ndarray, " n"], coefficients: tuple[float, ...], step: int
) -> Float[np.ndarray, " valid"]:
    """Samples after a filter with `step` samples between its coefficients, where it is within the record."""
    valid = len(x) - step * (len(coefficients) - 1)
    found = np.zeros(valid)
    for k, c in enumerate(reversed(coefficients)):
        found += c * x[k * step : k * step + valid]
    return found


def wavelet_geometry(
    wavelet: WaveletFilter, levels: Int[np.ndarray, " m"], n: int, rate: float
) -> AllanCovariance:
    """Quadrature for the covariance of estimates at these levels, of twice the estimates for "haar"."""
    if wavelet.name == "haar":
        return AllanCovariance.of(n, rate, 2 ** (levels - 1), capacity=_CAPACITY)
    return WaveletCovariance.of_levels(n, rate, wavelet, levels, _CAPACITY)


def moments(
    model: Model, wavelet: WaveletFilter, levels: Int[np.ndarray, " m"], n: int, rate: float
) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, "m m"]]:
    """Expectation and covariance of wavelet variances under a noise model with values."""
    model.check_complete()
    for term in model.terms:
        if term.narrow_band or (term.deterministic and term.oscillates):
            raise AllanjaxError(f"wavelet variances do not support {term.name()}: leave it out of the model")
    geometry = wavelet_geometry(wavelet, levels, n, rate)
    mean, covariance = _moments(geometry, numbers_as_data(model.sampled(rate).processes))
    m, scale = len(levels), 0.5 if wavelet.name == "haar" else 1.0
    return scale * np.asarray(mean)[:m], scale**2 * np.asarray(covariance)[geometry.place[:m, :m]]


_moments = eqx.filter_jit(AllanCovariance.moments)

"""Power spectral density of a static recording, averaged over frequency as Hou (2004) does in section 3.4.2.

The periodogram is eq. (3.39), one-sided, but of the record without its straight line and under a Hann window.
Otherwise a drift would leak: the periodogram of a random walk is twice its density at every frequency, and
a ramp or a strong line can bury the floor. The cost of the window: neighbouring ordinates are correlated
(by 4/9 in power, and 1/36 two apart), so that a mean of many has 1/1.94 of the degrees of freedom.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar, Literal, get_args

import numpy as np
from jaxtyping import ArrayLike, Float, Int

from allanjax.base.chi_squared import chi_squared_factors, upper_tail
from allanjax.base.equality import ByValue
from allanjax.base.errors import AllanjaxError
from allanjax.base.wording import plain
from allanjax.noise.estimate import AxisReadings, Estimate, Readings
from allanjax.noise.terms import (
    AngleRandomWalk,
    BiasInstability,
    DriftRamp,
    NoiseTerm,
    Quantization,
    RateRandomWalk,
)
from allanjax.record.columns import OfAxes
from allanjax.record.io.given import RecordingLike, living_samples
from allanjax.record.recording import Axis
from allanjax.spectrum.autocorrelation import square_unit

if TYPE_CHECKING:
    import pandas as pd

# Distance from which on ordinates are taken as uncorrelated under any window.
_CORRELATED = 32
# Correlations of ordinates depend on the window's shape alone: a short one shows them.
_SHORT_WINDOW = 4096


def window_weights(name: str, length: int) -> Float[np.ndarray, " length"]:
    """Weights of a window by its name in `scipy.signal`; AllanjaxError if there is none."""
    if name == "hann":
        # As in `scipy.signal`, which takes half a second to load.
        return np.sin(np.pi * np.arange(length) / length) ** 2
    from scipy.signal import get_window

    try:
        return get_window(name, length)
    except (ValueError, TypeError) as error:
        raise AllanjaxError(
            f"unknown window {name!r}: expected one that scipy.signal.get_window knows by name, e.g. 'hann'"
        ) from error


def without_line(x: Float[np.ndarray, " samples"]) -> Float[np.ndarray, " samples"]:
    """Samples minus their least-squares straight line, in far less time than `scipy.signal.detrend`."""
    t = np.arange(len(x)) - (len(x) - 1) / 2.0
    x = x - x.mean()
    return x - (t @ x) / (t @ t) * t


def ordinate_correlation(window: str, length: int, segments: int) -> Float[np.ndarray, " lags"]:
    """Squared correlation of ordinates d = 0, 1, 2, … apart, summed over the segments.

    c(d) = Σ_m (1 − |m|/segments) |Σ_t w(t) w(t + m·step) e^{2πi·d·t/length}|² / (Σ w²)² with a step of half
    the length. Welch (1967) has d = 0. Only neighbouring segments overlap, m = ±1.
    """
    short = min(length, _SHORT_WINDOW) // 2 * 2
    w = window_weights(window, short)
    half = short // 2
    squares = abs(np.fft.rfft(w**2)) ** 2
    if segments > 1:
        squares = squares + 2.0 * (1.0 - 1.0 / segments) * abs(np.fft.rfft(w[:half] * w[half:], short)) ** 2
    return squares[:_CORRELATED] / (w @ w) ** 2


# The flat band of a power spectral density, and the noise in it that is not white.
#
# The flat part of real spectra is a shallow valley between noise that falls and noise that rises with
# frequency. Their contribution raises its mean above the white noise's density, which no test on the valley
# alone can detect. So a rough sum of white and other noise is fitted to the entire spectrum.

# A flat part spans this factor in frequency, has so many points, and a slope known to be less than this.
_OCTAVE = 2.0
_FEWEST_POINTS = 5
_STEEPEST = 0.5
# Slope and curvature together lower χ² by no more than they do on average where there is neither.
_BENT = 2.0
# The points scatter around one level as their degrees of freedom say.
_SCATTER_P_VALUE = 1e-3

# Points this many standard deviations off the sum, such as lines, weigh less.
_OUTLYING = 3.0
_REWEIGHTINGS = 12


def coloured_density(
    frequency: Float[np.ndarray, " m"],
    density: Float[np.ndarray, " m"],
    dof: Float[np.ndarray, " m"],
    rate: float,
) -> Float[np.ndarray, " m"]:
    """Contribution of flicker, random walk and quantization to the density [its unit] at each frequency [Hz].

    That is c₁/f + c₂/f² + c₃ sin²(πf/rate) of their sum with a constant, see `component_densities`.
    """
    shapes = np.stack(
        [np.ones_like(frequency), 1.0 / frequency, frequency**-2.0, np.sin(np.pi * frequency / rate) ** 2],
        axis=1,
    )
    return component_densities(density, dof, shapes)[:, 1:].sum(axis=1)


def component_densities(
    density: Float[np.ndarray, " m"], dof: Float[np.ndarray, " m"], shapes: Float[np.ndarray, "m k"]
) -> Float[np.ndarray, "m k"]:
    """Contributions of these shapes to a density, from a rough fit of their sum.

    It is a fit with non-negative coefficients, weighted with the degrees of freedom at the sum itself, and
    robust to lines.
    """
    from scipy.optimize import nnls

    precision = np.sqrt(dof / 2.0)
    model, outlying = density, np.zeros_like(density)
    for _ in range(_REWEIGHTINGS):
        weight = precision / model / np.sqrt(np.maximum(outlying / _OUTLYING, 1.0))
        scaled = shapes * weight[:, None]
        size = np.linalg.norm(scaled, axis=0)
        coefficients = nnls(scaled / size, density * weight)[0] / size
        model = shapes @ coefficients
        outlying = abs(density / model - 1.0) * precision
    return shapes * coefficients


def flattest(
    s: PowerSpectrum, density: Float[np.ndarray, " m"], coloured: Float[np.ndarray, " m"], skip: int = 0
) -> slice | None:
    """Points of the band that `PowerSpectrum.flat_band` describes; None if there is none.

    Args:
        s: the spectrum, averaged.
        density: density of an axis at its points, which may be divided by that of a term.
        coloured: contribution of other noise to that.
        skip: number of lowest points to leave out.

    The logarithm of χ² over its ν degrees of freedom has the mean ψ(ν/2) − ln(ν/2) and the variance ψ'(ν/2).
    """
    from scipy.special import digamma, polygamma

    frequency, count, dof = s.frequency[skip:], s.count[skip:], s.dof[skip:]
    density, coloured = density[skip:], coloured[skip:]
    # Neighbours are correlated, so that a band has fewer degrees of freedom than its points together.
    share = s.degrees_of_freedom(s.count.sum()) * count / s.count.sum()
    x = np.log(frequency / frequency[-1])
    y = np.log(density) - digamma(dof / 2.0) + np.log(dof / 2.0)
    w = share / dof / polygamma(1, dof / 2.0)
    first, last = np.triu_indices(len(x), _FEWEST_POINTS - 1)
    wide = frequency[last] >= _OCTAVE * frequency[first]
    first, last = first[wide], last[wide]
    if not first.size:
        return None

    def sums(v: Float[np.ndarray, " m"]) -> Float[np.ndarray, " bands"]:
        total = np.append(0.0, np.cumsum(v))
        return total[last + 1] - total[first]

    # Weighted sums of powers of x over every band at once, and what the fits of constant and parabola leave.
    moments = np.stack([sums(w * x**p) for p in range(5)], axis=1)
    right = np.stack([sums(w * x**p * y) for p in range(3)], axis=1)
    degree = np.arange(3)
    parabola = np.linalg.solve(moments[:, degree[:, None] + degree], right[:, :, None])[:, :, 0]
    around_level = sums(w * y**2) - right[:, 0] ** 2 / moments[:, 0]
    around_parabola = sums(w * y**2) - (parabola * right).sum(axis=1)
    spread = moments[:, 2] - moments[:, 1] ** 2 / moments[:, 0]
    slope = (right[:, 1] - moments[:, 1] * right[:, 0] / moments[:, 0]) / spread
    flat = abs(slope) + 2.0 / np.sqrt(spread) < _STEEPEST
    flat &= around_level - around_parabola <= _BENT
    flat &= upper_tail(around_level, last - first) > _SCATTER_P_VALUE
    if not flat.any():
        return None
    error = 2.0 / sums(share) + (sums(count * coloured) / sums(count * density)) ** 2
    best = np.argmin(np.where(flat, error, np.inf))
    return slice(int(first[best]) + skip, int(last[best]) + skip + 1)


def spectral_coefficient(
    term: type[NoiseTerm], square: float, others: float, dof: float, axis: Axis, band: tuple[float, float]
) -> Estimate:
    """Coefficient of a noise term from the mean of a density over that of the term with coefficient 1.

    For white noise N = √(density / 2), Hou (2004) eq. (3.41).

    Args:
        term: the term's class.
        square: that mean, the coefficient's square [SI].
        others: contribution of other noise to it.
        dof: degrees of freedom of that mean.
        axis: the axis.
        band: lowest and highest frequency [Hz] averaged.
    """
    from scipy.special import ndtri

    value = float(np.sqrt(square))
    excess = value * (1.0 - float(np.sqrt(max(1.0 - others / square, 0.0))))

    def interval(level: float) -> tuple[float, float]:
        lower, upper = (value * float(np.sqrt(factor)) for factor in chi_squared_factors(dof, level))
        uncertainty = ndtri((1.0 + level) / 2.0) * excess / 2.0
        return max(value - excess - float(np.hypot(value - lower, uncertainty)), 0.0), upper

    return Estimate(
        source="spectrum",
        label=term.name(),
        term=term.name(),
        parameter=term.amplitude_parameter(),
        axis=axis,
        value=value,
        std=float(np.hypot(value / np.sqrt(2.0 * dof), excess)),
        interval=interval(0.95),
        interval_68=interval(0.68),
        band=(float(band[0]), float(band[1])),
        degrees_of_freedom=dof,
        excess=excess,
    )


# Coefficients of noise terms read off a spectrum, each where the spectrum has the term's slope.
#
# IEEE Std 952 and Hou (2004) section 3.4.2 identify terms by the slopes of the log-log plot: +2
# quantization, 0 angle (velocity) random walk, −1 bias instability, −2 rate random walk, −3 the flicker
# rate ramp that stands for a drift ramp (4.58). A coefficient is the value of a line of that slope at the
# term's frequency: the density over that of the term with coefficient 1, (4.28), (3.41), (4.38), (4.52),
# (4.58), averaged where it is constant.

#: The terms that slopes identify, by falling slope, and these slopes.
SLOPES: dict[type[NoiseTerm], int] = {
    Quantization: 2,
    AngleRandomWalk: 0,
    BiasInstability: -1,
    RateRandomWalk: -2,
    DriftRamp: -3,
}
# Lowest ordinates that removing the record's straight line has reduced.
_TAKEN = 2
# A term is read where it contributes more than this share.
_SHARE = 0.5


def unit_densities(frequency: Float[np.ndarray, " m"], rate: float) -> Float[np.ndarray, "m terms"]:
    """One-sided density of each of these terms with coefficient 1, at frequencies [Hz].

    It is that of samples, which are means over their intervals, with aliases: near the Nyquist frequency it
    leaves the straight line, as a real spectrum does. Quantization has 8 sin²(πf/rate)·rate (4.28).
    """
    terms = [term().with_unit_amplitude() for term in SLOPES]
    densities = [t.psd(frequency) if t.deterministic else t.sampled_psd(frequency, rate) for t in terms]
    return np.stack([2.0 * np.asarray(density) for density in densities], axis=1)


def slope_band(s: PowerSpectrum, term: type[NoiseTerm]) -> tuple[slice, float, float] | None:
    """Band of a spectrum of one axis, averaged, that has a term's slope, by the rule of `readings`.

    Returns:
        The points of the band, and the means in it of the squared coefficient and of what other terms
        contribute to that; None if there is no such band.
    """
    density, shapes = s.density[:, 0], unit_densities(s.frequency, s.rate)
    parts = component_densities(density, s.dof, shapes)
    k = list(SLOPES).index(term)
    square = density / shapes[:, k]
    others = (parts.sum(axis=1) - parts[:, k]) / shapes[:, k]
    band = flattest(s, square, others, _TAKEN)
    if band is None:
        return None
    weight = s.count[band] / s.count[band].sum()
    mean, rest = float(weight @ square[band]), float(weight @ others[band])
    return (band, mean, rest) if rest < _SHARE * mean else None


#: Estimators of the density, explained at `power_spectrum`.
Method = Literal["logarithmic", "welch"]

# Table 3.4: ordinates that stay single, and points an octave above them.
_SINGLE = 32
_PER_OCTAVE = 16
# By default a record is as long as so many of Welch's segments; no segment has fewer samples.
_SEGMENTS = 8
_NO_UNIT = (
    "{} the unit of the samples, which an array lacks: make a recording, "
    "Recording.from_array(values, rate, gyro_unit=…)"
)


def octave_groups(m: int) -> Int[np.ndarray, " groups"]:
    """Index of the first ordinate of each group of Hou (2004) table 3.4, of m ordinates.

    The first 32 stay single; of 33-64 two are averaged each, of 65-128 four, and so on: 16 groups an octave.
    The rest of a broken octave is a group of its own, or joins the last one if it is less than half a group.
    """
    octaves = max(int(np.ceil(np.log2(max(m, 1) / _SINGLE))), 0)
    width = 2 ** np.arange(1, octaves + 1)
    starts = (width * _PER_OCTAVE)[:, None] + width[:, None] * np.arange(_PER_OCTAVE)
    starts = np.concatenate([np.arange(_SINGLE), starts.ravel()])
    starts = starts[starts < m]
    if len(starts) > _SINGLE:
        full = width[np.searchsorted(width * _PER_OCTAVE, starts[-1], side="right") - 1]
        if m - starts[-1] < full / 2:
            starts = starts[:-1]
    return starts


@dataclass(frozen=True, eq=False)
class PowerSpectrum(ByValue, OfAxes):
    """Estimated one-sided power spectral density of each axis against frequency.

    Attributes:
        frequency: [m] mean frequency of the ordinates averaged [Hz].
        density: [m, axes] one-sided density [(rad/s)²/Hz or (m/s²)²/Hz, or the array's unit squared a Hz].
        count: [m] adjacent ordinates averaged.
        dof: [m] degrees of freedom: dof · estimate / density has the χ² law, nearly.
        correlation: [lags] squared correlation of ordinates 0, 1, 2 … apart, summed over the segments.
        n: rate samples per axis.
        rate: sample rate [Hz].
        method: "logarithmic" or "welch".
        window: its name in `scipy.signal`.
        segments: segments of the record that were averaged; 1 for "logarithmic".
        axes: the recording's axes, or None for an array.
    """

    PER_AXIS: ClassVar[tuple[str, ...]] = ("density",)

    frequency: Float[np.ndarray, " m"]
    density: Float[np.ndarray, "m axes"]
    count: Int[np.ndarray, " m"]
    dof: Float[np.ndarray, " m"]
    correlation: Float[np.ndarray, " lags"]
    n: int
    rate: float
    method: Method = "logarithmic"
    window: str = "hann"
    segments: int = 1
    axes: tuple[Axis, ...] | None = None

    @property
    def standard_error(self) -> Float[np.ndarray, "m axes"]:
        """Standard error of the density: density · √(2/dof)."""
        return self.density * np.sqrt(2.0 / self.dof)[:, None]

    def confidence_interval(
        self, level: float = 0.95
    ) -> tuple[Float[np.ndarray, "m axes"], Float[np.ndarray, "m axes"]]:
        """Lower and upper end of the central interval of the density, by the χ² law.

        Raises:
            AllanjaxError: `level` not between 0 and 1.
        """
        lower, upper = chi_squared_factors(self.dof, level)
        return self.density * lower[:, None], self.density * upper[:, None]

    def degrees_of_freedom(self, count: ArrayLike) -> Float[np.ndarray, ...]:
        """Degrees of freedom of the mean of `count` adjacent ordinates (Percival & Walden 1993, section 6).

        2·count·segments / Σ_d (1 − |d|/count) c(|d|), with c the `correlation` and |d| < count.
        """
        B = np.asarray(count, dtype=float)
        lag = np.arange(1, len(self.correlation))
        share = np.maximum(1.0 - lag / B[..., None], 0.0)
        return 2.0 * B * self.segments / (self.correlation[0] + 2.0 * share @ self.correlation[1:])

    def averaged(self) -> PowerSpectrum:
        """The spectrum averaged over frequency after Hou (2004) table 3.4; itself, if it is already."""
        if self.count.max() > 1:
            return self
        starts = octave_groups(len(self.frequency))
        count = np.diff(starts, append=len(self.frequency))
        return replace(
            self,
            frequency=np.add.reduceat(self.frequency, starts) / count,
            density=np.add.reduceat(self.density, starts, axis=0) / count[:, None],
            count=count,
            dof=self.degrees_of_freedom(count),
        )

    def flat_band(self, axis: str) -> tuple[float, float]:
        """Frequencies [Hz] between which the density is flat, as white noise is.

        Candidates are all contiguous bands of an octave or more of the spectrum averaged after table 3.4. To
        the logarithm of the density in each, weighted with its degrees of freedom, a constant, a line and a
        parabola are fitted against ln f. A band is flat if

        - its log-log slope is within ±0.5 by two standard errors, nearer to white noise than to flicker;
        - line and parabola together lower χ² by at most 2, which is what they do where nothing is bent;
        - the points scatter around the constant as their degrees of freedom allow (p > 0.001): no line in it.

        Of the flat bands it is the one whose mean has the least expected square error: 2 over its degrees of
        freedom, plus the square of what other noise seems to contribute (`coloured_density`).

        Raises:
            AllanjaxError: there is no such axis, or no flat band.
        """
        s = self[axis].averaged()
        band = flattest(s, s.density[:, 0], s._coloured())
        if band is None:
            raise AllanjaxError(
                f"{axis}: the power spectral density has no flat octave from "
                f"{plain(s.frequency[0], 3)} Hz to {plain(s.frequency[-1], 3)} Hz; "
                "give the band of the white noise, band=(low, high) in Hz"
            )
        return s._ends(band)

    def random_walk(self, axis: str, band: tuple[float, float] | None = None) -> Estimate:
        """Angle (velocity) random walk N of an axis, Hou (2004) eq. (3.41): √(mean density in the band / 2).

        In (3.41) N is in deg/√h and the density in (deg/h)²/Hz; here both are SI, see `in_unit`. Intervals
        follow from the mean's χ² law, and extend below it by the apparent contribution of flicker, rate
        random walk and quantization to the band (see `spectral_coefficient`).

        Args:
            axis: the axis's name.
            band: lowest and highest frequency [Hz] to average over; by default `flat_band(axis)`.

        Raises:
            AllanjaxError: no such axis, no flat part, no frequency in the band, or samples without a unit.
        """
        own = self[axis]
        if own.axes is None:
            raise AllanjaxError(_NO_UNIT.format("N needs"))
        low, high = own.flat_band(axis) if band is None else band
        inside = (low <= self.frequency) & (self.frequency <= high)
        if not inside.any():
            raise AllanjaxError(
                f"{axis}: the spectrum has no frequency from {low:g} Hz to {high:g} Hz; give (low, high) "
                f"between {plain(self.frequency[0], 3)} Hz and {plain(self.frequency[-1], 3)} Hz"
            )
        count = self.count[inside]
        density = count @ own.density[inside, 0] / count.sum()
        coloured = count @ own._coloured()[inside] / count.sum()
        dof = float(self.degrees_of_freedom(count.sum()))
        halves = float(density) / 2.0, float(coloured) / 2.0
        return spectral_coefficient(AngleRandomWalk, *halves, dof, own.axes[0], (low, high))

    def readings(self) -> Readings:
        """Coefficients of quantization, N, B, K and R of every axis read off the slopes of the density.

        A term is read off a contiguous band of an octave or more of the spectrum averaged as in table 3.4,
        if the density over that of the term alone is flat there by the rule of `flat_band` (its log-log slope
        is within ±0.5 of the term's by two standard errors, it is not bent and has no line), and if the term
        makes up more than half of a rough sum of all five terms. The lowest two ordinates are left out. Of
        such bands the one whose mean has the least expected square error is used; N is that of `random_walk`.
        If there is none, the estimate is None, with a reason. R stands for a flicker rate ramp (4.58): a
        straight drift ramp is removed before and has no density.

        Raises:
            AllanjaxError: samples without a unit.
        """
        if self.axes is None:
            raise AllanjaxError(_NO_UNIT.format("coefficients need"))
        title = "coefficients from slopes of the power spectral density, each over an octave or more"
        averaged = self.averaged()
        return Readings(title, tuple(averaged[axis.name]._readings(axis) for axis in self.axes))

    def _readings(self, axis: Axis) -> AxisReadings:
        """Readings of a spectrum of one axis, averaged."""
        estimates: dict[str, Estimate | None] = {}
        for term in SLOPES:
            found = slope_band(self, term)
            if found is None or term is AngleRandomWalk:
                estimates[term.name()] = None if found is None else self.random_walk(axis.name)
                continue
            band, square, others = found
            dof = float(self.degrees_of_freedom(self.count[band].sum()))
            estimates[term.name()] = spectral_coefficient(term, square, others, dof, axis, self._ends(band))
        reason = "no octave has the slope of the term and is dominated by it"
        return AxisReadings(axis, estimates, {k: reason for k, e in estimates.items() if e is None})

    def _ends(self, band: slice) -> tuple[float, float]:
        """Lowest and highest frequency [Hz] of the ordinates in a band of points."""
        edges = (np.append(0, np.cumsum(self.count)) + 0.5) * self.frequency[0]
        return float(edges[band.start]), float(edges[band.stop])

    def _coloured(self) -> Float[np.ndarray, " m"]:
        """Density of one axis that is not white noise, at this spectrum's frequencies."""
        s = self.averaged()
        coloured = coloured_density(s.frequency, s.density[:, 0], s.dof, s.rate)
        return coloured if s is self else np.interp(self.frequency, s.frequency, coloured)

    def to_dataframe(self) -> pd.DataFrame:
        """Table with one row per frequency: its degrees of freedom, and each axis's density.

        Headings state the units, (deg/h)²/Hz or µg²/Hz; an array without units keeps its own.
        """
        import pandas as pd

        columns = {"frequency [Hz]": self.frequency, "degrees of freedom": self.dof}
        for k, name in enumerate(self.names):
            unit, scale = ("", 1.0) if self.axes is None else density_unit(self.axes[k])
            columns[f"{name} [{unit}]" if unit else name] = self.density[:, k] / scale
        return pd.DataFrame(columns)

    def __repr__(self) -> str:
        names = ", ".join(self.names) if self.axes else f"{self.density.shape[1]} axes"
        first, last = self.frequency[[0, -1]]
        segments = f" of {self.segments} segments" if self.segments > 1 else ""
        return (
            f"PowerSpectrum({self.method}{segments}, {self.window}; {names}; "
            f"{self.n} samples at {plain(self.rate, 6)} Hz; "
            f"{len(self.frequency)} frequencies from {plain(first, 4)} Hz to {plain(last, 4)} Hz)"
        )


def density_unit(axis: Axis) -> tuple[str, float]:
    """Display unit of an axis's power spectral density, and its factor to SI."""
    name, scale = square_unit(axis)
    return f"{name}/Hz", scale


def power_spectrum(
    data: RecordingLike,
    rate: float | None = None,
    *,
    method: Method = "logarithmic",
    window: str = "hann",
    segment_time: float | None = None,
    gyro_unit: str | None = None,
    accel_unit: str | None = None,
    names: Sequence[str] | None = None,
) -> PowerSpectrum:
    """One-sided power spectral density of every axis, Hou (2004) section 3.4.2.

    "logarithmic" is one periodogram (3.39) of the entire record without its straight line, averaged over
    frequency as in table 3.4. "welch" is the mean over segments that overlap by half, each without its mean,
    as in `scipy.signal.welch`. The ordinates at zero and at the Nyquist frequency are left out: they have
    half the bandwidth and one degree of freedom. Removing the straight line (the mean) lowers the lowest two
    of the others, under a Hann window by 29 % and 5 % (17 % and 4 %) for white noise.

    Args:
        data: a recording, or equally spaced samples [samples, axes] or [samples]; a data frame, or a path.
        rate: sample rate [Hz], for an array only: a recording has its own.
        method: "logarithmic" or "welch".
        window: name of a window of `scipy.signal.get_window`. "boxcar" is eq. (3.39) itself: it has twice as
            many degrees of freedom, and leakage from drifts and lines.
        segment_time: length of Welch's segments [s]; by default the largest power of two of samples that fits
            into the record eight times.
        gyro_unit, accel_unit, names: units and names of an array, as for `Recording.from_array`; without a
            unit the densities are in the array's own unit.

    Raises:
        AllanjaxError: no positive rate, samples that are not finite or constant, fewer than 16 samples, an
            unknown method or window, or segments that do not fit.
    """
    from scipy.fft import rfft

    if method not in get_args(Method):
        raise AllanjaxError(f"unknown method {method!r}: expected 'logarithmic' or 'welch'")
    found = living_samples(data, rate, gyro_unit, accel_unit, names)
    values, rate = found.values, found.rate
    n = len(values)
    length = n
    if method == "welch":
        length = _segment_length(n, rate, segment_time)
    elif segment_time is not None:
        raise AllanjaxError("segment_time needs method='welch': the logarithmic average has one segment")
    overlap = length // 2
    weights = window_weights(window, length)

    def periodogram(x: Float[np.ndarray, " samples"]) -> Float[np.ndarray, " frequencies"]:
        if method == "welch":
            from scipy.signal import welch

            return welch(x, rate, window=weights, noverlap=overlap)[1]
        # The periodogram of scipy.signal takes seven times as long.
        return 2.0 * abs(rfft(without_line(x) * weights)) ** 2 / (rate * (weights @ weights))

    # Axis by axis: transforms of all axes of a long record would fill the memory.
    count = (length + 1) // 2 - 1
    segments = 1 + (n - length) // (length - overlap)
    raw = PowerSpectrum(
        frequency=np.arange(1, count + 1) * (rate / length),
        density=np.stack([periodogram(x)[1 : count + 1] for x in values.T], axis=1),
        count=np.ones(count, dtype=int),
        dof=np.zeros(count),
        n=n,
        rate=rate,
        method="welch",
        window=window,
        segments=segments,
        correlation=ordinate_correlation(window, length, segments),
        axes=found.axes,
    )
    if method == "logarithmic":
        return replace(raw.averaged(), method=method)
    return replace(raw, dof=raw.degrees_of_freedom(raw.count))


def _segment_length(n: int, rate: float, segment_time: float | None) -> int:
    """Number of samples in one of Welch's segments."""
    if segment_time is None:
        return max(1 << ((n // _SEGMENTS).bit_length() - 1), _SEGMENTS)
    if not _SEGMENTS <= segment_time * rate <= n:
        raise AllanjaxError(
            f"segment_time must be from {_SEGMENTS / rate:g} s ({_SEGMENTS} samples) to {n / rate:g} s (the "
            f"record), not {segment_time:g} s"
        )
    return round(segment_time * rate)

"""Autocorrelation of a static recording, and the Gauss–Markov process read off it: Hou (2004) section 3.4.1.

The estimate at lag τ = k/rate is R̂(τ) = Σ_t x_t x_{t+k}/(n − k), where x is the samples without their mean:
(3.29), unbiased except that the mean's variance is subtracted with the mean. Its scatter under a stationary
Gaussian model with autocovariance R follows from Bartlett (1946),

    Var R̂(k) ≈ Σ_m [(1 − |m|/(n − k)) R(m)² + R(m + k) R(m − k)]/(n − k),

of which (3.32), (4/T) ∫₀^∞ R² dt, is the bound for any lag. R is minus the second difference of the phase
covariance G over the squared sample interval. Terms that are not stationary have no R: with them there is no
standard error.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from jaxtyping import Float

from allanjax.base.equality import ByValue
from allanjax.base.errors import AllanjaxError
from allanjax.base.normal import TWO_SIDED_68, TWO_SIDED_95
from allanjax.base.tables import Column, Tabled, columns_from
from allanjax.base.wording import duration, plain, significant
from allanjax.noise.estimate import AxisReadings, Estimate, Readings
from allanjax.noise.model import Model
from allanjax.noise.notation import Modelling, model_of
from allanjax.record.columns import OfAxes, names_of
from allanjax.record.io.given import RecordingLike, living_samples
from allanjax.record.recording import Axis
from allanjax.record.units import default_coefficient_unit, unit_scale

if TYPE_CHECKING:
    import pandas as pd

# Longest lag by default, as a share of the record.
_LONGEST = 0.1
# Autocovariance at the end of the record, relative to lag zero, above which it outlasts the record.
_ENDED = 0.05


@dataclass(frozen=True, eq=False)
class Autocorrelation(ByValue, OfAxes, Tabled):
    """Estimated autocorrelation of each axis, mean subtracted, against the lag.

    Attributes:
        lag: [m] lags [s], from 0 on.
        value: [m, axes] autocorrelation [(rad/s)² or (m/s²)², or the array's unit squared].
        standard_error: [m, axes] standard errors under the models, nan if there are none; they describe the
            scatter from record to record, in which neighbouring lags go up and down together.
        remarks: for each axis, the meaning of its standard errors or the reason why there are none.
        n: rate samples per axis.
        rate: sample rate [Hz].
        axes: the recording's axes, or None for an array.
    """

    PER_AXIS: ClassVar[tuple[str, ...]] = ("value", "standard_error", "remarks")

    lag: Float[np.ndarray, " m"]
    value: Float[np.ndarray, "m axes"]
    standard_error: Float[np.ndarray, "m axes"]
    remarks: tuple[str, ...]
    n: int
    rate: float
    axes: tuple[Axis, ...] | None = None

    def markov(self) -> Readings:
        """Variance σ² and correlation time 1/β of a Gauss–Markov process (3.30), as the thesis reads them.

        σ² is the value at lag zero and 1/β the lag at which it has fallen to σ²/e (3.31). Both have the
        relative standard error √(2/(βT)) of (3.34), T being the record's length: a bound for the
        autocorrelation of the process itself. It does not include other noise, which must be removed before
        (`wavelet_decomposition`), nor the bias from subtracting the mean and from reading off one lag; see
        `benchmarks/results/chapter3.md`. There is no reading if the autocorrelation does not fall to σ²/e, or
        does so within one sample.

        Raises:
            AllanjaxError: samples without a unit.
        """
        if self.axes is None:
            raise AllanjaxError(
                "σ² needs the unit of the samples, which an array lacks: give gyro_unit= or accel_unit="
            )
        title = "Gauss–Markov process read off the autocorrelation, with the accuracy of (3.34)"
        return Readings(title, tuple(self._markov(k, axis) for k, axis in enumerate(self.axes)))

    def _markov(self, k: int, axis: Axis) -> AxisReadings:
        R = self.value[:, k]
        below = np.flatnonzero(math.e * R < R[0])
        labels = ("markov variance", "markov correlation time")
        i = below[0] if below.size else 0
        reasons = {
            0: f"the autocorrelation does not fall to 1/e within lags up to {duration(self.lag[-1])}",
            1: "the autocorrelation falls to 1/e within one sample, as for white noise: remove it first",
        }
        if i in reasons:
            return AxisReadings(axis, dict.fromkeys(labels), dict.fromkeys(labels, reasons[i]))
        time = float(np.interp(-R[0] / math.e, -R[[i - 1, i]], self.lag[[i - 1, i]]))
        accuracy = math.sqrt(2.0 * time / (self.n / self.rate))
        remark = f"accuracy {100.0 * accuracy:.2f} % (3.34)"
        estimates: dict[str, Estimate | None] = {}
        units = (square_unit(axis)[0], "s")
        for label, value, unit in zip(labels, (float(R[0]), time), units, strict=True):
            std = accuracy * value
            wide, narrow = (
                (max(value - z * std, 0.0), value + z * std) for z in (TWO_SIDED_95, TWO_SIDED_68)
            )
            estimates[label] = Estimate(
                axis=axis,
                label=label,
                value=value,
                std=std,
                interval=wide,
                interval_68=narrow,
                usual_unit=unit,
                source="spectrum",
                remark=remark,
            )
        return AxisReadings(axis, estimates)

    def to_dataframe(self) -> pd.DataFrame:
        """Table with one row per lag: each axis's autocorrelation and its standard error.

        Headings state the units, (deg/h)² or µg²; an array without units keeps its own.
        """
        import pandas as pd

        columns = {"lag [s]": self.lag}
        for k, name in enumerate(self.names):
            unit, scale = ("", 1.0) if self.axes is None else square_unit(self.axes[k])
            unit = f" [{unit}]" if unit else ""
            columns[f"{name}{unit}"] = self.value[:, k] / scale
            columns[f"{name} standard error{unit}"] = self.standard_error[:, k] / scale
        return pd.DataFrame(columns)

    def _title(self) -> str:
        return repr(self)

    def _tables(self) -> list[list[Column]]:
        rows = []
        for k, name in enumerate(self.names):
            unit, scale = ("", 1.0) if self.axes is None else square_unit(self.axes[k])
            error = float(self.standard_error[0, k]) / scale
            shown = "" if np.isnan(error) else significant(error, 2)
            rows.append((name, significant(float(self.value[0, k]) / scale), shown, unit))
        return [columns_from(("axis", "at lag 0", "1σ", "unit"), rows)]

    def _notes(self) -> list[str]:
        axes: dict[str, list[str]] = {}
        for name, remark in zip(self.names, self.remarks, strict=True):
            axes.setdefault(remark, []).append(name)
        return [f"{', '.join(names)}: {remark}" for remark, names in axes.items()]

    def __repr__(self) -> str:
        names = ", ".join(self.names) if self.axes else f"{self.value.shape[1]} axes"
        return (
            f"Autocorrelation({names}; {self.n} samples at {plain(self.rate, 6)} Hz; "
            f"lags up to {duration(self.lag[-1])})"
        )


def square_unit(axis: Axis) -> tuple[str, float]:
    """Display unit of the square of an axis's rate, and its factor to SI."""
    unit = default_coefficient_unit(axis.sensor, 0.0)
    name = f"({unit})²" if "/" in unit else f"{unit}²"
    return name, unit_scale(unit, axis.sensor) ** 2


def autocorrelation(
    data: RecordingLike,
    rate: float | None = None,
    *,
    model: Modelling | None = None,
    longest_lag: float | None = None,
    gyro_unit: str | None = None,
    accel_unit: str | None = None,
    names: Sequence[str] | None = None,
) -> Autocorrelation:
    """Autocorrelation of every axis, Hou (2004) eq. (3.29), with its standard error under a model.

    Args:
        data: a recording, or equally spaced samples [samples, axes] or [samples]; a data frame, or a path.
        rate: sample rate [Hz], for an array only: a recording has its own.
        model: the noise model of these samples with its values, or a fit of them, for the standard errors.
            It must be stationary: bias instability, random walks of the rate, ramps and other terms without
            an autocovariance leave their axis without standard errors; see `remarks`.
        longest_lag: longest lag [s]; by default a tenth of the record.
        gyro_unit, accel_unit, names: units and names of an array, as for `Recording.from_array`; without a
            unit the autocorrelation is in the square of the array's unit.

    Raises:
        AllanjaxError: no positive rate, samples that are not finite or constant, a longest lag beyond the
            record; a fit without a result for an axis, a model without a value.
    """
    found = living_samples(data, rate, gyro_unit, accel_unit, names)
    values, rate = found.values, found.rate
    labels = names_of(found.axes, values.shape[1])
    n = len(values)
    longest = _LONGEST * n / rate if longest_lag is None else longest_lag
    lags = int(np.floor(longest * rate * (1.0 + 1e-9))) + 1
    if not 2 <= lags <= n - 1:
        raise AllanjaxError(
            f"longest_lag must be from {1.0 / rate:g} s to {(n - 2) / rate:g} s here, not {longest:g} s"
        )
    pairs = n - np.arange(lags)
    value = np.stack([_sums(x - x.mean(), lags) / pairs for x in values.T], axis=1)
    models = [None if model is None else model_of(model, axis) for axis in found.axes or labels]
    errors, remarks = zip(*(_standard_error(m, n, rate, lags) for m in models), strict=True)
    return Autocorrelation(
        np.arange(lags) / rate, value, np.stack(errors, axis=1), remarks, n, rate, found.axes
    )


def _sums(x: Float[np.ndarray, " n"], lags: int) -> Float[np.ndarray, " lags"]:
    """Sums of products of values 0, 1, 2 … apart, by the fast Fourier transform."""
    from scipy.fft import irfft, next_fast_len, rfft

    size = next_fast_len(len(x) + lags, real=True)
    return irfft(abs(rfft(x, size)) ** 2, size)[:lags]


def _standard_error(
    model: Model | None, n: int, rate: float, lags: int
) -> tuple[Float[np.ndarray, " lags"], str]:
    """Standard error at each lag under a model, and a remark on it; nan if there is none."""
    nothing = np.full(lags, np.nan)
    if model is None:
        return nothing, "no standard error without a model"
    R, unstable = autocovariance(model, n, rate)
    if unstable:
        return (
            nothing,
            f"no standard error: the correlation of {' and '.join(unstable)} outlasts the record",
        )
    # Both sums are over positive and negative m.
    m, pairs = np.arange(n), n - np.arange(lags)
    squares = R**2
    both = np.where(m > 0, 2.0, 1.0)
    sums, moments = np.cumsum(both * squares), np.cumsum(both * m * squares)
    tapered = sums[pairs - 1] - moments[pairs - 1] / pairs
    # Σ_m R(m + k) R(m − k) is the convolution of R with itself at lag 2k.
    full = np.concatenate([R[:0:-1], R])
    again = _sums(full, min(2 * lags - 1, len(full)))[::2]
    variance = (tapered + np.pad(again, (0, lags - len(again)))) / pairs
    return np.sqrt(np.maximum(variance, 0.0)), "standard errors from Bartlett's formula under the model"


def autocovariance(model: Model, n: int, rate: float) -> tuple[Float[np.ndarray, " n"], tuple[str, ...]]:
    """Autocovariance of n samples under the stationary terms of a model, and the names of the others.

    It is −δ²G/h², h being the sample interval. G is known up to a multiple of t², so that R is known up to a
    constant, which is taken from the end of the record, where a stationary term has R = 0. A term whose R has
    not decayed there is one of the others.
    """
    sampled = model.sampled(rate)
    total, others = np.zeros(n), []
    for term, label in zip(sampled.processes, sampled.term_labels, strict=True):
        lag: Any = np.arange(2 * n + 1) / rate
        G = np.asarray(term.phase_covariance(lag))
        H = -(rate**2) * (np.append(G[1], G[:-2]) - 2.0 * G[:-1] + G[1:])
        R = H[:n] - H[-1]
        if term.deterministic or not abs(R[n // 2 :]).max() <= _ENDED * abs(R[0]):
            others.append(label.replace("_", " "))
        total += R
    return total, tuple(others)

"""Results of Kalman filters: bias, states and innovations of each axis over time."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from jaxtyping import Bool, Float

from allanjax.base.chi_squared import upper_tail
from allanjax.base.equality import ByValue
from allanjax.base.late import presented
from allanjax.base.normal import TWO_SIDED_95
from allanjax.base.tables import Cell, Number, PerAxis
from allanjax.base.wording import duration, finite_or_none, format_with_error
from allanjax.noise.model import Model
from allanjax.record.recording import Axis
from allanjax.record.units import Sensor, default_coefficient_unit, unit_scale

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

# Lags of the portmanteau test: at most so many, and this share of the samples.
_LAGS, _SHARE = 40, 0.2
_TESTS_EXPLAINED = (
    "whiteness p: Ljung–Box test of the innovations; NIS/n: normalized innovations squared per sample, 1 if "
    "their size is right. A p below 0.01 means that the model does not fit."
)


@dataclasses.dataclass(frozen=True)
class ChiSquared:
    """A statistic with a χ² law where the model is right.

    Attributes:
        statistic, dof: its value and its degrees of freedom.
        p_value: probability of a value as extreme: of a larger one (whiteness), or two-sided (size).
    """

    statistic: float
    dof: int
    p_value: float


def whiteness(u: Float[np.ndarray, " n"]) -> ChiSquared:
    """Portmanteau test of Ljung and Box (1978, Biometrika 65:297) of standardized innovations.

    Q = n(n + 2) Σ r_d²/(n − d) over lags d up to 40. Where there is no sample, u is NaN; n − d is then the
    number of pairs that are there.
    """
    there = np.isfinite(u)
    n = int(there.sum())
    lags = min(_LAGS, int(_SHARE * n))
    if lags < 1:
        return ChiSquared(float("nan"), 0, float("nan"))
    value, count = np.where(there, u, 0.0), there.astype(float)
    power = float(value @ value)
    total = 0.0
    for d in range(1, lags + 1):
        pairs = max(float(count[d:] @ count[:-d]), 1.0)
        total += (float(value[d:] @ value[:-d]) / power) ** 2 / pairs
    statistic = n * (n + 2.0) * total
    return ChiSquared(statistic, lags, float(upper_tail(statistic, lags)))


def normalized_square(u: Float[np.ndarray, " n"]) -> ChiSquared:
    """Normalized innovations squared (NIS) Σ e²/s, χ² with one degree of freedom per sample; two-sided."""
    u = u[np.isfinite(u)]
    statistic = float(u @ u)
    above = float(upper_tail(statistic, len(u)))
    return ChiSquared(statistic, len(u), min(2.0 * min(above, 1.0 - above), 1.0))


def _p_value(test: ChiSquared) -> str:
    if not test.dof:
        return ""
    return f"{test.p_value:.3f}" if test.p_value >= 0.001 else "< 0.001"


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class BiasTrack(ByValue):
    """Bias of one axis over time, by one filter or several. Arrays are in SI, [samples].

    Attributes:
        axis: the axis.
        rate: sample rate [Hz].
        samples: what was filtered.
        bias, bias_std: what the filter would remove in each sample, and its standard deviation.
        log_likelihood: of the samples [nats].
    """

    axis: Axis
    rate: float
    samples: Float[np.ndarray, " n"]
    bias: Float[np.ndarray, " n"]
    bias_std: Float[np.ndarray, " n"]
    log_likelihood: float

    @property
    def time(self) -> Float[np.ndarray, " n"]:
        """Time of each sample in s from the first."""
        return np.arange(len(self.samples)) / self.rate

    @property
    def bias_interval(self) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
        """Ends of the 95 % interval of the bias at each sample."""
        half = TWO_SIDED_95 * self.bias_std
        return self.bias - half, self.bias + half

    def to_dataframe(self) -> pd.DataFrame:
        """Table in SI with one row per sample: axis, time, sample, bias with std and interval, and more."""
        import pandas as pd

        return pd.DataFrame(self._columns())

    def _columns(self) -> dict[str, Any]:
        low, high = self.bias_interval
        return {
            "axis": self.axis.name,
            "time": self.time,
            "sample": self.samples,
            "bias": self.bias,
            "bias_std": self.bias_std,
            "bias_lower_95": low,
            "bias_upper_95": high,
        }

    def _last_bias(self) -> Number:
        """The bias in the last sample with its standard deviation, in the usual unit."""
        scale = unit_scale(default_coefficient_unit(self.axis.sensor, 0.0))
        return Number(float(self.bias[-1]) / scale, float(self.bias_std[-1]) / scale)

    def __repr__(self) -> str:
        bias, unit = self._last_bias(), default_coefficient_unit(self.axis.sensor, 0.0)
        at_end = format_with_error(bias.value, bias.error)
        return f"<{type(self).__name__} {self.axis.name}: bias at the end {at_end} {unit}>"


_T = TypeVar("_T", bound=BiasTrack)


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class BiasTracks(ByValue, PerAxis[_T]):
    """Bias of every axis of a recording over time.

    Attributes:
        name: the recording's name.
        results: one per axis.
    """

    name: str
    results: tuple[_T, ...]

    @presented
    def plot(
        self,
        axes: Sequence[str] | str | None = None,
        path: str | os.PathLike[str] | None = None,
    ) -> Figure:
        """Draw the bias with its 95 % band over the samples, and innovations or models below.

        See `plot_bias_tracks`.
        """
        raise NotImplementedError

    def _heads(self, sensor: Sensor) -> tuple[str, ...]:
        return "axis", f"bias at the end ± 1σ ({default_coefficient_unit(sensor, 0.0)})"


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class FilteredAxis(BiasTrack):
    """Result of a Kalman filter for one axis. Arrays are in SI, [samples] or [samples, states].

    Attributes:
        axis, rate, samples: see `BiasTrack`.
        bias, bias_std: of the constant and the sum of the slow terms (`slow`).
        log_likelihood: exact; of an unknown constant that of the samples' differences.
        model: the noise model.
        missing: samples that the filter did not use.
        constant, constant_std: the constant after all samples (of a walk, where it began).
        states, state_stds: states of the noise model.
        names, units: names and units of the states.
        slow: labels of the terms that are drift.
        innovation, innovation_std: samples less their predictions from earlier ones, and their standard
            deviation; NaN where a sample is missing, and at the first one if the constant is unknown.
        smoothed: whether bias and states are estimated from all samples, not only from those up to each.
    """

    model: Model
    missing: Bool[np.ndarray, " n"]
    constant: float
    constant_std: float
    states: Float[np.ndarray, "n states"]
    state_stds: Float[np.ndarray, "n states"]
    names: tuple[str, ...]
    units: tuple[str, ...]
    slow: tuple[str, ...]
    innovation: Float[np.ndarray, " n"]
    innovation_std: Float[np.ndarray, " n"]
    smoothed: bool = False

    @property
    def standardized(self) -> Float[np.ndarray, " n"]:
        """Innovations over their standard deviations: unit white noise where the model is right."""
        return self.innovation / self.innovation_std

    @property
    def whiteness(self) -> ChiSquared:
        """Ljung and Box's test that innovations are white, with up to 40 lags."""
        return whiteness(self.standardized)

    @property
    def nis(self) -> ChiSquared:
        """Test that innovations are as large as the filter predicts, from their normalized squares."""
        return normalized_square(self.standardized)

    def _columns(self) -> dict[str, Any]:
        own = {
            "sample": np.where(self.missing, np.nan, self.samples),
            "innovation": self.innovation,
            "innovation_std": self.innovation_std,
        }
        for name, x, std in zip(self.names, self.states.T, self.state_stds.T, strict=True):
            own |= {name: x, f"{name}_std": std}
        return super()._columns() | own

    def rows(self) -> list[tuple[Cell, ...]]:
        """The row of the printed table: bias at the end, tests, log-likelihood, missing samples."""
        size, lost = self.nis, int(self.missing.sum())
        tests = (_p_value(self.whiteness), f"{size.statistic / max(size.dof, 1):.3f}", _p_value(size))
        others = (f"{self.log_likelihood:,.2f}", f"{lost:,}" if lost else "")
        return [(self.axis.name, self._last_bias(), *tests, *others)]

    def to_dict(self) -> dict[str, Any]:
        """Bias in the last sample and tests as plain dictionaries, in SI; None for undefined numbers."""
        tests = {"whiteness": self.whiteness, "nis": self.nis}
        return {
            "axis": self.axis.name,
            "smoothed": self.smoothed,
            "bias": float(self.bias[-1]),
            "bias_std": finite_or_none(self.bias_std[-1]),
            "drift": list(self.slow),
            **{
                name: {k: finite_or_none(v) for k, v in dataclasses.asdict(test).items()}
                for name, test in tests.items()
            },
            "log_likelihood": self.log_likelihood,
            "missing": int(self.missing.sum()),
            "samples": len(self.samples),
        }


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Filtered(BiasTracks[FilteredAxis]):
    """Results of a Kalman filter for every axis of a recording."""

    @property
    def log_likelihood(self) -> float:
        """Log-likelihood of all axes [nats], which are taken as independent."""
        return sum(result.log_likelihood for result in self.results)

    def to_dict(self) -> dict[str, Any]:
        """The result of each axis as plain dictionaries, in SI."""
        axes = [result.to_dict() for result in self.results]
        return {"name": self.name, "rate_hz": self.results[0].rate, "axes": axes}

    def _heads(self, sensor: Sensor) -> tuple[str, ...]:
        tests = ("whiteness p", "NIS/n", "NIS p")
        return *super()._heads(sensor), *tests, "log-likelihood (nats)", "missing samples"

    def _title(self) -> str:
        first = self.results[0]
        length = duration(len(first.samples) / first.rate)
        kind = "smoother" if first.smoothed else "filter"
        return f"Kalman {kind}, {length} at {first.rate:g} Hz"

    def _notes(self) -> list[str]:
        drifts: dict[str, list[str]] = {}
        for result in self.results:
            terms = " + ".join(["constant", *result.slow]).replace("_", " ")
            drifts.setdefault(terms, []).append(result.axis.name)
        bias = "; ".join(f"{terms} ({', '.join(axes)})" for terms, axes in drifts.items())
        return [f"bias: {bias}", _TESTS_EXPLAINED]

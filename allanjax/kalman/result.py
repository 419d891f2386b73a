"""Results of Kalman filters: bias, states and innovations of each axis over time."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar

import numpy as np
from jaxtyping import Bool, Float

from allanjax.base.chi_squared import upper_tail
from allanjax.base.equality import ByValue
from allanjax.base.late import presented
from allanjax.base.normal import TWO_SIDED_95
from allanjax.base.per_axis import PerAxis
from allanjax.base.wording import duration, finite_or_none, format_interval, format_with_error
from allanjax.noise.model import Model
from allanjax.record.recording import Axis
from allanjax.record.units import rate_unit_of

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

# Lags of the portmanteau test: at most so many, and this share of the samples.
_LAGS, _SHARE = 40, 0.2


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
    """Normalized innovations squared (NIS) Σ e²/s, χ² with a degree of freedom a sample; two-sided."""
    u = u[np.isfinite(u)]
    statistic = float(u @ u)
    above = float(upper_tail(statistic, len(u)))
    return ChiSquared(statistic, len(u), min(2.0 * min(above, 1.0 - above), 1.0))


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class BiasTrack(ByValue):
    """Bias of one axis over time, by one filter or several. All is in SI, [samples].

    Attributes:
        axis: whose it is.
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
        """Table of a row a sample: axis, time, sample, bias with std and interval, what else is told; SI."""
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

    def _last_bias(self) -> str:
        """The bias in the last sample, in words."""
        unit, scale = rate_unit_of(self.axis.unit, self.axis.sensor)
        value, std = float(self.bias[-1]) / scale, float(self.bias_std[-1]) / scale
        ends = (value - TWO_SIDED_95 * std, value + TWO_SIDED_95 * std)
        return f"{format_with_error(value, std)} {unit} (95 %: {format_interval(*ends, value, std)})"

    def _told(self) -> list[tuple[str, str]]:
        """What is told of the axis, a quantity and its value in words each."""
        raise NotImplementedError

    def __str__(self) -> str:
        return "\n".join(f"{self.axis.name} {what}: {value}" for what, value in self._told())


_T = TypeVar("_T", bound=BiasTrack)


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class BiasTracks(ByValue, PerAxis[_T]):
    """Bias of every axis of a recording over time.

    Attributes:
        name: the recording's name.
        results: one an axis.
    """

    HEADINGS: ClassVar[tuple[str, ...]] = ("axis", "quantity", "value")

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

    def _cells(self) -> list[tuple[str, str, str]]:
        return [(result.axis.name, *row) for result in self.results for row in result._told()]


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class FilteredAxis(BiasTrack):
    """What a Kalman filter says of one axis. All is in SI, [samples] or [samples, states].

    Attributes:
        axis, rate, samples: see `BiasTrack`.
        bias, bias_std: of the constant and the sum of the slow terms (`slow`).
        log_likelihood: exact; of an unknown constant that of the samples' differences.
        model: the noise model.
        missing: samples that the filter did not see.
        constant, constant_std: the constant after all samples (of a walk, where it began).
        states, state_stds: of the noise model.
        names, units: of the states.
        slow: labels of the terms that are drift.
        innovation, innovation_std: samples less what those before predict, and their standard deviation; NaN
            where there is no sample, and at the first one of an unknown constant.
        smoothed: whether bias and states are estimates by all samples, and not by those up to each.
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
        """Test that innovations are white: of Ljung and Box, with up to 40 lags."""
        return whiteness(self.standardized)

    @property
    def nis(self) -> ChiSquared:
        """Test that innovations have the size that the filter says: of their normalized squares."""
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

    def _told(self) -> list[tuple[str, str]]:
        drift = " + ".join(["constant", *self.slow]).replace("_", " ")
        kind = "smoothed" if self.smoothed else "filtered"
        w, s = self.whiteness, self.nis
        lost = int(self.missing.sum())
        rows = [
            (f"bias at the end ({drift}), {kind}", self._last_bias()),
            (
                "innovations white (Ljung–Box)",
                f"χ² = {w.statistic:.1f} for {w.dof} lags, p = {w.p_value:.2g}",
            ),
            (
                "innovations of their size (NIS)",
                f"χ² = {s.statistic:,.1f} for {s.dof:,} samples, p = {s.p_value:.2g}",
            ),
            ("log-likelihood", f"{self.log_likelihood:,.2f} nats"),
        ]
        return [*rows, ("missing samples", f"{lost:,} of {len(self.samples):,}")] if lost else rows

    def to_dict(self) -> dict[str, Any]:
        """Bias in the last sample and tests as plain dictionaries, in SI; None where there is none."""
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

    def __repr__(self) -> str:
        return f"<FilteredAxis {self.axis.name}: {self._told()[0][1]}>"


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Filtered(BiasTracks[FilteredAxis]):
    """What a Kalman filter says of every axis of a recording."""

    CALLED: ClassVar[str] = "the filter"

    @property
    def log_likelihood(self) -> float:
        """Log-likelihood of all axes [nats], which are independent of each other."""
        return sum(result.log_likelihood for result in self.results)

    def to_dict(self) -> dict[str, Any]:
        """The result of each axis as plain dictionaries, in SI."""
        axes = [result.to_dict() for result in self.results]
        return {"name": self.name, "rate_hz": self.results[0].rate, "axes": axes}

    def _title(self) -> str:
        first = self.results[0]
        length = duration(len(first.samples) / first.rate)
        return f"{self.name or 'recording'}: Kalman filter, {length} at {first.rate:g} Hz"

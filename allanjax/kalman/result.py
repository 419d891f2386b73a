"""Results of a Kalman filter: bias, states and innovations of each axis over time."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Sequence
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from jaxtyping import Bool, Float

from allanjax.base.equality import ByValue
from allanjax.base.per_axis import PerAxis
from allanjax.base.presented import presented
from allanjax.base.wording import duration, format_interval, format_with_error
from allanjax.kalman.innovations import ChiSquared, normalized_square, whiteness
from allanjax.noise.model import Model
from allanjax.record.recording import Axis
from allanjax.record.units import rate_unit_of

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

#: Normal quantile of two-sided 95 % intervals.
TWO_SIDED_95 = 1.959964


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class FilteredAxis(ByValue):
    """What a Kalman filter says of one axis. All is in SI, [samples] or [samples, states].

    Attributes:
        axis: whose it is.
        rate: sample rate [Hz].
        model: the noise model.
        samples: what was filtered, and `missing` those that the filter did not see.
        bias, bias_std: what the filter would remove: the constant and the sum of the slow terms (`slow`) in
            each sample, and its standard deviation.
        constant, constant_std: the constant after all samples (of a walk, where it began).
        states, state_stds: of the noise model.
        names, units: of the states.
        slow: labels of the terms that are drift.
        innovation, innovation_std: samples less what those before predict, and their standard deviation; NaN
            where there is no sample, and at the first one of an unknown constant.
        log_likelihood: of the samples [nats], exact; of an unknown constant that of their differences.
        smoothed: whether bias and states are estimates by all samples, and not by those up to each.
    """

    axis: Axis
    rate: float
    model: Model
    samples: Float[np.ndarray, " n"]
    missing: Bool[np.ndarray, " n"]
    bias: Float[np.ndarray, " n"]
    bias_std: Float[np.ndarray, " n"]
    constant: float
    constant_std: float
    states: Float[np.ndarray, "n states"]
    state_stds: Float[np.ndarray, "n states"]
    names: tuple[str, ...]
    units: tuple[str, ...]
    slow: tuple[str, ...]
    innovation: Float[np.ndarray, " n"]
    innovation_std: Float[np.ndarray, " n"]
    log_likelihood: float
    smoothed: bool = False

    @property
    def time(self) -> Float[np.ndarray, " n"]:
        """Time of each sample in s from the first."""
        return np.arange(len(self.samples)) / self.rate

    @property
    def bias_interval(self) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
        """Ends of the 95 % interval of the bias at each sample."""
        half = TWO_SIDED_95 * self.bias_std
        return self.bias - half, self.bias + half

    @property
    def standardized(self) -> Float[np.ndarray, " n"]:
        """Innovations over their standard deviations: unit white noise where the model is right."""
        return self.innovation / self.innovation_std

    @property
    def whiteness(self) -> ChiSquared:
        """Test that innovations are white, see `innovations.whiteness`."""
        return whiteness(self.standardized)

    @property
    def nis(self) -> ChiSquared:
        """Test that innovations have the size that the filter says, see `innovations.normalized_square`."""
        return normalized_square(self.standardized)

    def to_dataframe(self) -> pd.DataFrame:
        """Table of a row a sample: axis, time, sample, bias with std and interval, innovation, states; SI."""
        import pandas as pd

        low, high = self.bias_interval
        columns = {
            "axis": self.axis.name,
            "time": self.time,
            "sample": np.where(self.missing, np.nan, self.samples),
            "bias": self.bias,
            "bias_std": self.bias_std,
            "bias_lower_95": low,
            "bias_upper_95": high,
            "innovation": self.innovation,
            "innovation_std": self.innovation_std,
        }
        of_states = zip(self.names, self.states.T, self.state_stds.T, strict=True)
        return pd.DataFrame(
            columns | {k: v for name, x, s in of_states for k, v in ((name, x), (f"{name}_std", s))}
        )

    def _told(self) -> list[tuple[str, str]]:
        """What is told of the axis, a quantity and its value in words each."""
        unit, scale = rate_unit_of(self.axis.unit, self.axis.sensor)

        def amount(value: float, std: float) -> str:
            ends = (value - TWO_SIDED_95 * std, value + TWO_SIDED_95 * std)
            number = format_with_error(value / scale, std / scale)
            interval = format_interval(ends[0] / scale, ends[1] / scale, value / scale, std / scale)
            return f"{number} {unit} (95 %: {interval})"

        drift = " + ".join(["constant", *self.slow]).replace("_", " ")
        kind = "smoothed" if self.smoothed else "filtered"
        w, s = self.whiteness, self.nis
        lost = int(self.missing.sum())
        rows = [
            (f"bias at the end ({drift}), {kind}", amount(float(self.bias[-1]), float(self.bias_std[-1]))),
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

    def __str__(self) -> str:
        return "\n".join(f"{self.axis.name} {what}: {value}" for what, value in self._told())

    def __repr__(self) -> str:
        return f"<FilteredAxis {self.axis.name}: {self._told()[0][1]}>"


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Filtered(ByValue, PerAxis[FilteredAxis]):
    """What a Kalman filter says of every axis of a recording.

    Attributes:
        name: the recording's name.
        results: one an axis.
    """

    CALLED: ClassVar[str] = "the filter"
    HEADINGS: ClassVar[tuple[str, ...]] = ("axis", "quantity", "value")

    name: str
    results: tuple[FilteredAxis, ...]

    @property
    def log_likelihood(self) -> float:
        """Log-likelihood of all axes [nats], which are independent of each other."""
        return sum(result.log_likelihood for result in self.results)

    @presented
    def plot(
        self,
        axes: Sequence[str] | str | None = None,
        path: str | os.PathLike[str] | None = None,
    ) -> Figure:
        """Draw bias with its 95 % band over the samples, and the innovations; see `plot_filtered`."""
        raise NotImplementedError

    def _title(self) -> str:
        first = self.results[0]
        length = duration(len(first.samples) / first.rate)
        return f"{self.name or 'recording'}: Kalman filter, {length} at {first.rate:g} Hz"

    def _cells(self) -> list[tuple[str, str, str]]:
        return [(result.axis.name, *row) for result in self.results for row in result._told()]

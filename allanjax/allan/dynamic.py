"""`dynamic_allan`: the Allan deviation in successive windows of a long record.

A stationary sensor has the same Allan deviation in every window; warm-up, ageing and changes of regime show
as a change over time (Galleani & Tavella 2009, IEEE Trans. UFFC 56:450). The logarithm of an estimate with ν
degrees of freedom has the variance ψ′(ν/2)/4 about that of the deviation, so that over windows that do not
overlap the scatter of the logarithms, weighted, has a χ² law if nothing changes.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float
from scipy.special import polygamma

from allanjax.allan.deviation import allan_deviation, rate_unit
from allanjax.base.chi_squared import chi_squared_factors, upper_tail
from allanjax.base.equality import ByValue
from allanjax.base.errors import AllanjaxError
from allanjax.base.late import presented
from allanjax.base.tables import Column, Tabled, columns_from
from allanjax.base.wording import duration, plain, significant
from allanjax.record.io.given import RecordingLike, samples_of
from allanjax.record.recording import Axis

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

# Windows of a record by default, fewest samples of one, and least degrees of freedom that are kept.
_WINDOWS, _SHORTEST, _LEAST_EDF = 24, 64, 4.0
# Rows of the printed table per axis.
_ROWS = 5


@dataclass(frozen=True, eq=False, repr=False)
class DynamicAllan(ByValue, Tabled):
    """Allan deviations of each axis in windows over time.

    Attributes:
        name: the recording's name.
        time: [w] middles of the windows [s].
        window: length of a window [s].
        cluster_time: [m] cluster times [s].
        deviation: [w, m, axes] deviations [rad/s or m/s²].
        edf: [m] degrees of freedom of each variance under white noise.
        axes: the axes.
    """

    name: str
    time: Float[np.ndarray, " w"]
    window: float
    cluster_time: Float[np.ndarray, " m"]
    deviation: Float[np.ndarray, "w m axes"]
    edf: Float[np.ndarray, " m"]
    axes: tuple[Axis, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the axes."""
        return tuple(axis.name for axis in self.axes)

    def confidence_interval(
        self, level: float = 0.95
    ) -> tuple[Float[np.ndarray, "w m axes"], Float[np.ndarray, "w m axes"]]:
        """Lower and upper end of the central interval of each deviation, by the χ² law.

        Raises:
            AllanjaxError: `level` not between 0 and 1.
        """
        lower, upper = (np.sqrt(end)[None, :, None] for end in chi_squared_factors(self.edf, level))
        return self.deviation * lower, self.deviation * upper

    @property
    def constancy(self) -> Float[np.ndarray, "m axes"]:
        """p-value of the hypothesis that the deviation is the same in all windows."""
        log = np.log(self.deviation)
        variance = polygamma(1, self.edf / 2.0)[:, None] / 4.0
        spread = ((log - log.mean(axis=0)) ** 2).sum(axis=0) / variance
        return upper_tail(spread, len(self.time) - 1.0)

    def to_dataframe(self) -> pd.DataFrame:
        """One row per window, cluster time and axis, in SI, with 95 % intervals."""
        import pandas as pd

        low, high = self.confidence_interval()
        t, tau, axis = np.meshgrid(self.time, self.cluster_time, np.arange(len(self.axes)), indexing="ij")
        names = np.array(self.names)[axis.ravel()]
        columns = {"axis": names, "time [s]": t.ravel(), "cluster time [s]": tau.ravel()}
        numbers = {"deviation": self.deviation, "lower_95": low, "upper_95": high}
        return pd.DataFrame(columns | {name: x.ravel() for name, x in numbers.items()})

    def to_dict(self) -> dict[str, Any]:
        """The deviations as plain lists and numbers, in SI."""
        own = {name: getattr(self, name).tolist() for name in ("time", "cluster_time", "deviation", "edf")}
        return {"name": self.name, "window_s": self.window, "axes": list(self.names)} | own

    @presented
    def plot(self, path: str | os.PathLike[str] | None = None, *, critique: Any = None) -> Figure:
        """Draw the deviations over time and cluster time, with a critique's steps and changes marked."""
        raise NotImplementedError

    def _title(self) -> str:
        return f"Allan deviation in {len(self.time)} windows of {duration(self.window)}"

    def _tables(self) -> list[list[Column]]:
        some = np.unique(np.linspace(0, len(self.cluster_time) - 1, _ROWS).astype(int)).tolist()
        cells, p_values = [], self.constancy
        for k, axis in enumerate(self.axes):
            unit, scale = rate_unit(axis)
            for m in some:
                x = self.deviation[:, m, k] / scale
                ends = (significant(float(end)) for end in (x.min(), np.median(x), x.max()))
                at = f"{plain(float(self.time[np.argmax(x)]), 3)} s"
                p = plain(max(float(p_values[m, k]), 1e-300), 2)
                cells.append((axis.name, plain(float(self.cluster_time[m]), 3), *ends, unit, at, p))
        heads = ("axis", "τ (s)", "least", "median", "largest", "unit", "largest at", "p of constancy")
        return [columns_from(heads, cells)]


def dynamic_allan(
    data: RecordingLike,
    rate: float | None = None,
    *,
    window: float | None = None,
    gyro_unit: str | None = None,
    accel_unit: str | None = None,
    names: Sequence[str] | None = None,
) -> DynamicAllan:
    """Allan deviation of every axis in successive windows of a record, to show warm-up, ageing and changes.

    Args:
        data: a recording, samples, a data frame or a path, as for `allan_deviation`.
        rate: sample rate [Hz], for an array only.
        window: length of a window [s]; by default a 24th of the record. Windows do not overlap, and samples
            at the end that fill no window are left out.
        gyro_unit, accel_unit, names: units and names of an array.

    Raises:
        AllanjaxError: windows of fewer than 64 samples, or fewer than two of them.
    """
    values, rate, axes = samples_of(data, rate, gyro_unit, accel_unit, names)
    if axes is None:
        raise AllanjaxError("dynamic_allan needs units: give gyro_unit= or accel_unit= for an array")
    length = len(values) // _WINDOWS if window is None else round(window * rate)
    count = len(values) // max(length, 1)
    if length < _SHORTEST or count < 2:
        raise AllanjaxError(
            f"{length} samples per window and {count} windows: a window needs {_SHORTEST} samples or more, "
            "and there must be two windows or more; change window="
        )
    # Windows are columns: one shape for all axes.
    columns = [np.ascontiguousarray(x[: count * length].reshape(count, length).T) for x in values.T]
    curves = [allan_deviation(x, rate) for x in columns]
    kept = curves[0].edf[:, 0] >= _LEAST_EDF
    return DynamicAllan(
        getattr(data, "name", ""),
        (np.arange(count) + 0.5) * length / rate,
        length / rate,
        curves[0].cluster_time[kept],
        np.stack([curve.deviation[kept].T for curve in curves], axis=-1),
        curves[0].edf[kept, 0],
        tuple(axes),
    )

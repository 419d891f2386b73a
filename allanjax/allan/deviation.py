"""Allan variance and its relatives: cluster analysis of a static recording, and of windows of it.

The estimators are those of Hou (2004), eqs. (4.1)-(4.9), and of NIST SP 1065, section 5. All are the mean
square of a difference of the phase (angle or velocity, the running integral of the rate): the second
difference (Allan), the third (Hadamard), or the second averaged over one cluster time (modified Allan).

A stationary sensor has the same Allan deviation in every window of a long record; warm-up, ageing and changes
of regime show as a change over time (Galleani & Tavella 2009, IEEE Trans. UFFC 56:450). The logarithm of an
estimate with ν degrees of freedom has the variance ψ′(ν/2)/4 about that of the deviation, so that over
windows that do not overlap the scatter of the logarithms, weighted, has a χ² law if nothing changes.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar, Literal, get_args

import numpy as np
from jaxtyping import Float, Int
from scipy.special import polygamma

from allanjax.allan import estimators
from allanjax.allan.covariance import equivalent_degrees_of_freedom
from allanjax.allan.estimators import DataType, Kind, Pyramid, Spacing
from allanjax.base.chi_squared import chi_squared_factors, upper_tail
from allanjax.base.equality import ByValue
from allanjax.base.errors import AllanjaxError
from allanjax.base.late import presented
from allanjax.base.tables import Column, Tabled, columns_from
from allanjax.base.wording import duration as in_words
from allanjax.base.wording import plain, significant
from allanjax.record.columns import OfAxes
from allanjax.record.completion import widening
from allanjax.record.io.given import RecordingLike, Samples, samples_of
from allanjax.record.recording import Axis, Recording
from allanjax.record.units import (
    Sensor,
    default_coefficient_unit,
    unit_scale,
)

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

#: Estimators of the variance, explained at `allan_deviation`.
Estimator = Literal["exact", "pyramid"]


@dataclass(frozen=True, eq=False)
class AllanDeviation(ByValue, OfAxes):
    """Estimated Allan (or modified, or Hadamard) deviation of each axis against the cluster time.

    Attributes:
        cluster_time: [m] cluster times T [s].
        cluster_size: [m] samples per cluster.
        deviation: [m, axes] square root of the variance [rad/s or m/s², or the unit of the array analysed].
        count: [m] differences averaged.
        edf: [m, axes] equivalent degrees of freedom of the variance.
        kind: "allan", "modified" or "hadamard".
        overlapping: whether the clusters overlap.
        estimator: "exact" if every start of a cluster counts, "pyramid" if some do; see `Pyramid`.
        n, rate: rate samples per axis, in the longest segment, and sample rate [Hz].
        axes: the recording's axes, or None for an array.
        others: rate samples of each other segment whose differences are averaged, too.
        name, notes: name of the file and what was assumed, if the curve was read from one (`read_curve`).
        determined: whether rate and length are known, without which a fit has no intervals.
        given: sensors whose unit the user gave when the curve was read.
    """

    PER_AXIS: ClassVar[tuple[str, ...]] = ("deviation", "edf")

    cluster_time: Float[np.ndarray, " m"]
    cluster_size: Int[np.ndarray, " m"]
    deviation: Float[np.ndarray, "m axes"]
    count: Int[np.ndarray, " m"]
    edf: Float[np.ndarray, "m axes"]
    n: int
    rate: float
    kind: Kind = "allan"
    overlapping: bool = True
    axes: tuple[Axis, ...] | None = None
    estimator: Estimator = "exact"
    others: tuple[int, ...] = ()
    name: str = ""
    notes: tuple[str, ...] = ()
    determined: bool = True
    given: tuple[Sensor, ...] = ()

    @property
    def unknown(self) -> tuple[str, ...]:
        """A note if rate or length of the record is not known."""
        return () if self.determined else ("no intervals without the rate and the length of its record",)

    @classmethod
    def under_white_noise(
        cls,
        deviation: Float[np.ndarray, "m axes"],
        cluster_size: Int[np.ndarray, " m"],
        n: int,
        rate: float,
        **more: Any,
    ) -> AllanDeviation:
        """Curve of n samples at `rate` [Hz] with the degrees of freedom that it has under white noise."""
        bare = cls(
            cluster_size / rate, cluster_size, deviation, cluster_size, deviation, n, float(rate), **more
        )
        count, edf = bare._differences(n)
        return replace(bare, count=count, edf=np.broadcast_to(edf[:, None], deviation.shape))

    def _differences(self, n: int) -> tuple[Int[np.ndarray, " some"], Float[np.ndarray, " some"]]:
        """Differences in n samples and their degrees of freedom, at the cluster sizes where there are any."""
        count = estimators.difference_count(n, self.cluster_size, self.kind, self.overlapping)
        if self.estimator == "pyramid":
            count = (n - 2 * self.cluster_size) // self.strides + 1
        sizes, strides = self.cluster_size[count > 0], self.strides[count > 0]
        return count[count > 0], equivalent_degrees_of_freedom(n, sizes, self.kind, strides)

    @property
    def strides(self) -> Int[np.ndarray, " m"]:
        """Samples between the starts of successive clusters, [m]."""
        if self.estimator == "pyramid":
            return estimators.pyramid_strides(self.cluster_size)
        return np.ones_like(self.cluster_size) if self.overlapping else self.cluster_size

    def describe_others(self) -> str:
        """The other segments in words, to append to a text about the longest; "" if there are none."""
        if not self.others:
            return ""
        segments = "another segment" if len(self.others) == 1 else f"{len(self.others)} other segments"
        return f" and {sum(self.others):,} in {segments}"

    @property
    def gain(self) -> Float[np.ndarray, " m"]:
        """Factor by which other segments raise the degrees of freedom, under white noise, [m]."""
        if not self.others:
            return np.ones(len(self.cluster_size))
        total, scatter = np.zeros((2, len(self.cluster_size)))
        for n in (*self.others, self.n):
            count, edf = self._differences(n)
            total[: len(count)] += count
            scatter[: len(count)] += count**2 / edf
        # The last one has all cluster times.
        return total**2 / scatter / edf

    @property
    def variance(self) -> Float[np.ndarray, "m axes"]:
        """Variances [rate²], the squares of the deviations."""
        return self.deviation**2

    @property
    def standard_error(self) -> Float[np.ndarray, "m axes"]:
        """Standard error of the deviation, to first order: deviation / √(2 edf)."""
        return self.deviation / np.sqrt(2 * self.edf)

    @property
    def thesis_relative_error(self) -> Float[np.ndarray, " m"]:
        """Relative error of the deviation by Hou (2004) eq. (4.66): 1 / √(2 (n/m − 1)).

        It counts the differences of clusters that do not overlap as independent. Neighbours share a cluster:
        for white noise the error is √1.5 times that. Eqs. (4.5) and (4.9) average overlapping clusters, for
        which it is too large except at the shortest times. `standard_error` is right for both.
        """
        return 1 / np.sqrt(2 * (self.n / self.cluster_size - 1))

    def confidence_interval(
        self, level: float = 0.95
    ) -> tuple[Float[np.ndarray, "m axes"], Float[np.ndarray, "m axes"]]:
        """Lower and upper end of the central interval of the deviation, as if edf · s²/σ² had the χ² law.

        They are nan if the curve is not `determined`.

        Raises:
            AllanjaxError: `level` not between 0 and 1.
        """
        lower, upper = chi_squared_factors(self.edf if self.determined else np.nan * self.edf, level)
        return self.deviation * np.sqrt(lower), self.deviation * np.sqrt(upper)

    def to_dataframe(self) -> pd.DataFrame:
        """Table with one row per cluster time: each axis's deviation, 68 % interval and degrees of freedom.

        Headings state the units, deg/h or µg; an array without units keeps its own.
        """
        import pandas as pd

        columns = {"cluster time [s]": self.cluster_time, "cluster size": self.cluster_size}
        lower, upper = self.confidence_interval(0.68)
        for k, name in enumerate(self.names):
            unit, scale = ("", 1.0) if self.axes is None else rate_unit(self.axes[k])
            for label, x in (("", self.deviation), (" lower_68", lower), (" upper_68", upper)):
                columns[f"{name}{label}" + (f" [{unit}]" if unit else "")] = x[:, k] / scale
            columns[f"{name} degrees of freedom"] = self.edf[:, k]
        return pd.DataFrame(columns)

    def __repr__(self) -> str:
        overlap = "overlapping" if self.overlapping else "non-overlapping"
        overlap = "pyramid" if self.estimator == "pyramid" else overlap
        names = ", ".join(self.names) if self.axes else f"{self.deviation.shape[1]} axes"
        first, last = self.cluster_time[[0, -1]]
        return (
            f"AllanDeviation({self.kind}, {overlap}; {names}; {self.n} samples at {plain(self.rate, 6)} Hz; "
            f"{len(self.cluster_time)} cluster times from {plain(first, 4)} s to {plain(last, 4)} s)"
        )


def rate_unit(axis: Axis) -> tuple[str, float]:
    """Display unit of an axis's Allan deviation, and its factor to SI."""
    unit = default_coefficient_unit(axis.sensor, 0.0)
    return unit, unit_scale(unit, axis.sensor)


def allan_deviation(
    data: RecordingLike,
    rate: float | None = None,
    *,
    data_type: DataType = "rate",
    kind: Kind = "allan",
    overlapping: bool = True,
    cluster_times: Spacing = "octave",
    estimator: Estimator = "exact",
    gyro_unit: str | None = None,
    accel_unit: str | None = None,
    names: Sequence[str] | None = None,
) -> AllanDeviation:
    """Allan deviation of every axis, Hou (2004) eqs. (4.5) and (4.9), or its modified or Hadamard variant.

    Args:
        data: a recording, or equally spaced samples [samples, axes] or [samples]; a data frame, or a path.
        rate: sample rate [Hz], for an array only: a recording has its own.
        data_type: "rate", or "phase" for an array of angles or velocities.
        kind: "allan", "modified" (always overlapping) or "hadamard".
        overlapping: average over every start of a cluster, or only over every m-th.
        cluster_times: spacing of the cluster times, or these times [s]; see `cluster_sizes`.
        estimator: "exact", or "pyramid" for long records: several times faster, and except for strong
            quantization less than 1 % less precise. Overlapping Allan variances of rates only, at
            about four cluster times an octave.
        gyro_unit, accel_unit, names: units and names of an array, as for `Recording.from_array`; without a
            unit the deviations are in the array's own unit.

    The degrees of freedom are those under white noise, which dominates most curves at short cluster times.
    If missing samples were filled in (`gaps="fill"`), all clusters are used, and the degrees of freedom are
    fewer: ν/(1/(1 − f) + f) for a missing share f. Means over incomplete clusters would have more white noise
    than complete ones. If a recording has segments (`gaps="segments"`), the differences of complete clusters
    within one segment are averaged, M_s of segment s, and the degrees of freedom are M²/Σ(M_s²/ν_s) with
    M = ΣM_s, as for independent segments; the longest one determines the cluster times.

    Raises:
        AllanjaxError: no positive rate, samples that are not finite, too few samples, an unknown option, one
            that the pyramid does not support, or a cluster time that the data do not allow.
    """
    options = CurveOptions(kind, overlapping, cluster_times, estimator, data_type)
    if isinstance(data, Recording) and data_type != "rate":
        raise AllanjaxError("a recording holds rates: leave out data_type")
    found = samples_of(data, rate, gyro_unit, accel_unit, names)
    return allan_of(found, options) if isinstance(found, Recording) else _curve(found, options)


@dataclass(frozen=True)
class CurveOptions:
    """Kind of variance, cluster times and estimator of a curve, as for `allan_deviation`.

    Raises:
        AllanjaxError: an unknown option, or some that exclude each other.
    """

    kind: Kind = "allan"
    overlapping: bool = True
    cluster_times: Spacing = "octave"
    estimator: Estimator = "exact"
    data_type: DataType = "rate"

    def __post_init__(self) -> None:
        estimators.check_member(self.kind, Kind, "kind")
        estimators.check_member(self.data_type, DataType, "data_type")
        if self.estimator in get_args(Kind):
            raise AllanjaxError(
                f'the {self.estimator} variance is a kind, not an estimator: give kind="{self.estimator}"'
            )
        estimators.check_member(self.estimator, Estimator, "estimator")
        if self.kind == "modified" and not self.overlapping:
            raise AllanjaxError("the modified Allan variance is defined for overlapping clusters only")
        usual = (self.kind, self.data_type, self.overlapping) == ("allan", "rate", True)
        at_octaves = isinstance(self.cluster_times, str) and self.cluster_times == "octave"
        if self.estimator == "pyramid" and not (usual and at_octaves):
            raise AllanjaxError(
                "the pyramid supports only overlapping Allan variances of rates at its own sizes: leave out "
                'kind, data_type, overlapping and cluster_times, or use estimator="exact"'
            )


def allan_of(recording: Recording, options: CurveOptions = CurveOptions()) -> AllanDeviation:
    """Allan deviation of all segments of a recording, allowing for missing samples; see `allan_deviation`."""
    curve = _curve(recording, options)
    if recording.others:
        curve = _with_segments(curve, recording, options)
    if recording.missing is not None:
        curve = replace(curve, edf=curve.edf / widening(recording.missing) ** 2)
    return curve


def _with_segments(curve: AllanDeviation, recording: Recording, options: CurveOptions) -> AllanDeviation:
    """The longest segment's curve, with the differences within the other segments averaged in."""
    squares, total = curve.variance * curve.count[:, None], curve.count.copy()
    for values in recording.others:
        own = options
        if curve.estimator == "exact":
            there = len(curve._differences(len(values))[0])
            own = replace(options, cluster_times=curve.cluster_time[:there])
        found = _curve(Samples(values, recording.rate), own)
        there = len(found.count)
        squares[:there] += found.variance * found.count[:, None]
        total[:there] += found.count
    others = tuple(map(len, recording.others))
    whole = replace(curve, deviation=np.sqrt(squares / total[:, None]), count=total, others=others)
    return replace(whole, edf=curve.edf * whole.gain[:, None])


def _curve(data: Recording | Samples, options: CurveOptions) -> AllanDeviation:
    """Allan deviation of samples without gaps, of a recording the longest segment's."""
    n = len(data.values) - (options.data_type == "phase")
    kind: dict[str, Any] = {"kind": options.kind, "overlapping": options.overlapping}
    if options.estimator == "pyramid":
        pyramid = Pyramid.of(data.values)
        sizes, variance = pyramid.cluster_size, pyramid.variance()
    else:
        sizes = estimators.cluster_sizes(n, data.rate, options.cluster_times, options.kind)
        variance = estimators.allan_variance_estimates(
            data.values, sizes, data.rate, data_type=options.data_type, **kind
        )
    return AllanDeviation.under_white_noise(
        np.sqrt(variance), sizes, n, data.rate, axes=data.axes, estimator=options.estimator, **kind
    )


# Windows of a record by default, fewest samples of one, and least degrees of freedom that are kept.
_WINDOWS, _SHORTEST, _LEAST_EDF = 24, 64, 4.0
# Rows of the printed table per axis.
_ROWS = 5


@dataclass(frozen=True, eq=False, repr=False)
class DynamicAllan(ByValue, Tabled):
    """Allan deviations of each axis in windows over time.

    Attributes:
        name, axes: the recording's name and axes.
        time, window: [w] middles of the windows, and length of each [s].
        cluster_time: [m] cluster times [s].
        deviation: [w, m, axes] deviations [rad/s or m/s²].
        edf: [m] degrees of freedom of each variance under white noise.
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
        return f"Allan deviation in {len(self.time)} windows of {in_words(self.window)}"

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
    found = samples_of(data, rate, gyro_unit, accel_unit, names)
    values, rate = found.values, found.rate
    if found.axes is None:
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
    curves = [_curve(Samples(x, rate), CurveOptions()) for x in columns]
    kept = curves[0].edf[:, 0] >= _LEAST_EDF
    return DynamicAllan(
        getattr(data, "name", ""),
        (np.arange(count) + 0.5) * length / rate,
        length / rate,
        curves[0].cluster_time[kept],
        np.stack([curve.deviation[kept].T for curve in curves], axis=-1),
        curves[0].edf[kept, 0],
        found.axes,
    )

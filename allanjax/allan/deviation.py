"""Allan variance and its relatives: cluster analysis of a static recording or its windows; curves from files.

The estimators are those of Hou (2004), eqs. (4.1)-(4.9), and of NIST SP 1065, section 5. All are the mean
square of a difference of the phase (angle or velocity, the running integral of the rate): the second
difference (Allan), the third (Hadamard), or the second averaged over one cluster time (modified Allan).

A stationary sensor has the same Allan deviation in every window of a long record; warm-up, ageing and changes
of regime show as a change over time (Galleani & Tavella 2009, IEEE Trans. UFFC 56:450). The logarithm of an
estimate with ν degrees of freedom has the variance ψ′(ν/2)/4 about that of the deviation, so that over
windows that do not overlap the scatter of the logarithms, weighted, has a χ² law if nothing changes.

Of a curve from a file (published, digitised, or exported by other programs) the estimator, the sample rate
and the length of the record must be known for the covariance of its points. allantools, MATLAB's `allanvar`,
Stable32 ("overlapping") and `characterize` itself average overlapping clusters.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal, get_args

import numpy as np
from jaxtyping import Float, Int
from scipy.special import polygamma

from allanjax.allan import estimators
from allanjax.allan.covariance import equivalent_degrees_of_freedom
from allanjax.allan.estimators import DataType, Kind, Pyramid, Spacing
from allanjax.base.chi_squared import chi_squared_factors, upper_tail
from allanjax.base.equality import ByValue
from allanjax.base.errors import AllanjaxError, UnitError
from allanjax.base.late import presented
from allanjax.base.tables import Column, Tabled, columns_from
from allanjax.base.wording import duration as in_words
from allanjax.base.wording import percent, plain, significant
from allanjax.record.columns import OfAxes, recognise, split_unit
from allanjax.record.completion import widening
from allanjax.record.io import ReadOptions
from allanjax.record.io.formats import format_of, name_of
from allanjax.record.io.given import RecordingLike, samples_of
from allanjax.record.recording import Axis, Recording
from allanjax.record.units import (
    SENSORS,
    SI,
    Sensor,
    convert,
    default_coefficient_unit,
    parse_quantity,
    parse_sample_unit,
    rate_unit_of,
    unit_scale,
)
from allanjax.record.validation import Source, check_rate

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
        estimator: "exact" if every start of a cluster counts, "pyramid" if every m/8-th does; see `Pyramid`.
        n, rate: rate samples per axis, in the longest segment, and sample rate [Hz].
        axes: the recording's axes, or None for an array.
        others: rate samples of each other segment whose differences are averaged, too.
        name, notes: name of the file and what was assumed, if the curve was read from one (`read_curve`).
        determined: whether rate and length are known, without which a fit has no intervals.
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

    @classmethod
    def of_pyramid(
        cls, pyramid: Pyramid, rate: float, axes: tuple[Axis, ...] | None = None
    ) -> AllanDeviation:
        """Allan deviations from the sums of a pyramid over samples at `rate` [Hz]."""
        sizes = estimators.cluster_sizes(pyramid.n, rate)[: len(pyramid.count)]
        of = np.sqrt(pyramid.variance()), sizes, pyramid.n, rate
        return replace(cls.under_white_noise(*of, axes=axes, estimator="pyramid"), count=pyramid.count)

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

        Raises:
            AllanjaxError: `level` not between 0 and 1.
        """
        lower, upper = chi_squared_factors(self.edf, level)
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
            quantization less than 1 % less precise. Overlapping Allan variances of rates at octaves only.
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
    estimators.check_member(kind, Kind, "kind")
    estimators.check_member(data_type, DataType, "data_type")
    if estimator in get_args(Kind):
        raise AllanjaxError(f'the {estimator} variance is a kind, not an estimator: give kind="{estimator}"')
    estimators.check_member(estimator, Estimator, "estimator")
    if kind == "modified" and not overlapping:
        raise AllanjaxError("the modified Allan variance is defined for overlapping clusters only")
    if isinstance(data, Recording) and data_type != "rate":
        raise AllanjaxError("a recording holds rates: leave out data_type")
    values, rate, axes = samples_of(data, rate, gyro_unit, accel_unit, names)
    if estimator == "pyramid":
        plain = (kind, data_type, overlapping) == ("allan", "rate", True)
        if not (plain and isinstance(cluster_times, str) and cluster_times == "octave"):
            raise AllanjaxError(
                "the pyramid supports only overlapping Allan variances of rates at octaves: leave out kind, "
                'data_type, overlapping and cluster_times, or use estimator="exact"'
            )
        return _of_recording(AllanDeviation.of_pyramid(Pyramid.of(values), rate, axes), data)
    n = values.shape[0] - (data_type == "phase")
    sizes = estimators.cluster_sizes(n, rate, cluster_times, kind)
    options: dict[str, Any] = {"kind": kind, "overlapping": overlapping}
    variance = estimators.allan_variance_estimates(values, sizes, rate, data_type=data_type, **options)
    # A sample that is not finite makes variances of its axis NaN: checking the samples first would take
    # longer.
    if not np.isfinite(variance).all():
        estimators.check_finite(values)
    curve = AllanDeviation.under_white_noise(np.sqrt(variance), sizes, n, rate, axes=axes, **options)
    return _of_recording(curve, data)


def _of_recording(curve: AllanDeviation, data: RecordingLike) -> AllanDeviation:
    """Curve of a recording's longest segment, allowing for missing samples, with its other segments."""
    if not isinstance(data, Recording):
        return curve
    if data.missing is not None:
        curve = replace(curve, edf=curve.edf / widening(data.missing) ** 2)
    if not data.others:
        return curve
    squares, total = curve.variance * curve.count[:, None], curve.count.copy()
    for values in data.others:
        times: Spacing = curve.cluster_time[: len(curve._differences(len(values))[0])]
        found = allan_deviation(
            Recording(values, data.rate, data.axes),
            kind=curve.kind,
            overlapping=curve.overlapping,
            cluster_times="octave" if curve.estimator == "pyramid" else times,
            estimator=curve.estimator,
        )
        there = len(found.count)
        squares[:there] += found.variance * found.count[:, None]
        total[:there] += found.count
    others = tuple(map(len, data.others))
    whole = replace(curve, deviation=np.sqrt(squares / total[:, None]), count=total, others=others)
    return replace(whole, edf=curve.edf * whole.gain[:, None])


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


# Words that name a deviation or a variance, and others that tell a column of something else.
_KIND = re.compile(
    r"(?:^|_)(?:(?P<variance>o?avar|variances?|var|sigma_?2|σ2)|allan|overlapping|o?adev|deviations?|dev|ad|std"
    r"|sigma|σ)(?=_|$)"
)
_OTHER = re.compile(
    r"(?:^|_)(?:lower|upper|min|max|low|high|ci|err|errors?|edf|freedom|dof|count|model|alpha|type|n|m|af"
    r"|size|fit|uncertainty)(?=_|$)"
)
_OTHER_KINDS = re.compile(
    r"(?:^|_)(?:mdev|mvar|hdev|ohdev|tdev|totdev|mod|modified|hadamard|total|theo1|time_sigma)(?=_|$)"
)
_TIME = re.compile(r"taus?|τ|period|t|time|(?:cluster|averaging|correlation)_time|tau_?s")
_SIZES, _COUNTS = ("cluster_size", "size", "m", "af"), ("count", "n", "number")
# Relative change of a cluster time by rounding to whole samples that a note reports.
_ROUNDED = 1e-3
# Most cluster times per octave that are used.
_PER_OCTAVE = 4
# Columns of allan_variance_ros, whose files have no header.
_ROS = "period [s],accel_x [m/s²],accel_y [m/s²],accel_z [m/s²],gyro_x [deg/s],gyro_y [deg/s],gyro_z [deg/s]"


@dataclass(frozen=True)
class _Column:
    """A column of a curve: cluster times, counts of differences, sizes, deviations or variances.

    `values` are its numbers; None for a column of other things, which may have text.
    """

    label: str
    role: Literal["time", "count", "size", "deviation", "variance", "other"]
    name: str = ""
    sensor: Sensor | None = None
    unit: str | None = None
    values: Any = None

    @classmethod
    def of(cls, label: str, source: Source) -> _Column:
        stem, unit = split_unit(label)
        words = re.sub(r"[\W_]+", "_", stem.lower().replace("²", "2")).strip("_")
        if _TIME.fullmatch(words):
            return cls(label, "time", unit=unit)
        if words in _SIZES:
            return cls(label, "size")
        if words in _COUNTS or stem == "#":
            return cls(label, "count")
        if _OTHER_KINDS.search(words):
            raise source.error(
                f"column {label!r} is no Allan deviation; export the overlapping one (oadev, avar)"
            )
        variance = any(found["variance"] for found in _KIND.finditer(words))
        named = _KIND.sub("", words).strip("_")
        axis = recognise(named)
        if _OTHER.search(named) or (named and axis.sensor is None):
            return cls(label, "other")
        if variance and unit:
            unit = re.sub(r"^\((.+)\)(?:\^2|²)$|^(\w+)(?:\^2|²)$", r"\1\2", unit.strip())
        role: Any = "variance" if variance else "deviation"
        return cls(label, role, axis.name if named else "", axis.sensor, unit)

    def filled(self, values: Any, source: Source) -> _Column:
        """The column with its numbers; RecordingError if they are text."""
        try:
            return self if self.role == "other" else replace(self, values=np.asarray(values, float))
        except (TypeError, ValueError) as error:
            remedy = "correct it, or skip it with columns= (--columns)"
            raise source.error(f"column {self.label!r} has text: {error}; {remedy}") from error


def read_curve(
    path: str | os.PathLike[str],
    rate: float | None = None,
    duration: float | str | None = None,
    *,
    gyro_unit: str | None = None,
    accel_unit: str | None = None,
    columns: str | Sequence[str] | None = None,
) -> AllanDeviation:
    """Read overlapping Allan deviations from a table: cluster times and one column per axis.

    Columns are recognised by their names, e.g. `tau`, `period`; `gyro_x`, `gyro_x adev [deg/s]`, `avar`,
    `sigma^2`; other columns are left out. Rate and length may follow from columns of cluster sizes and of
    counts. If they are not known, the shortest time is taken for a sample, and twice the longest for the
    record, and a fit has no intervals. `notes` of the curve list what was assumed. Errors of reading a
    picture are not known and in no interval.

    Args:
        path: text, e.g. of allantools, MATLAB, Stable32 or `characterize` (NAME_allan.csv), or any other file
            that `read` takes. Seven columns without names are those of allan_variance_ros.
        rate: sample rate of the record [Hz].
        duration: its length [s], or text such as "3 h" or "20 min".
        gyro_unit, accel_unit: units of the deviations, e.g. "deg/h", overriding those in the header; one that
            is given also names a deviation without an axis.
        columns: one name per column in order, with - to skip one, as for `read`.

    Raises:
        RecordingError: no cluster times or deviations, of another kind, or not positive; cluster times that
            do not fit the rate or the length. The message gives the file, the column and the remedy.
        UnitError: a unit is unknown.
    """
    source = Source(str(path))
    every = _columns(Path(path), source, columns)
    times = [c for c in every if c.role == "time"]
    chosen = [c for c in every if c.role in ("deviation", "variance")]
    if not times or not chosen:
        wanted = "deviations, e.g. gyro_x [deg/s]" if times else "cluster times, e.g. tau [s]"
        labels = ", ".join(c.label for c in every)
        raise source.error(f"no column of {wanted}, among {labels}; name them with columns= (--columns)")
    tau = convert(times[0].values, times[0].unit or "s", "s")
    axes = _axes(chosen, {"gyro": gyro_unit, "accel": accel_unit}, source)
    scale = [rate_unit_of(axis.unit, axis.sensor)[1] for axis in axes]
    values = [np.sqrt(c.values) if c.role == "variance" else c.values for c in chosen]
    deviation, notes = np.stack(values, axis=1) * scale, ["overlapping Allan deviations are assumed"]
    known = np.isfinite(deviation).all(axis=1) & (deviation > 0.0).all(axis=1) & (tau > 0.0)
    if not known.all():
        notes.append(f"{np.sum(~known)} rows without a positive deviation of every axis are left out")
    order = np.flatnonzero(known)[np.argsort(tau[known], kind="stable")]
    if len(order) < 2:
        raise source.error("fewer than two rows with positive deviations of every axis")
    extra = {c.role: c.values[order] for c in every if c.role in ("size", "count")}
    found = _curve(tau[order], deviation[order], axes, rate, duration, extra, notes, source)
    return replace(found, name=name_of(Path(path)))


def _columns(path: Path, source: Source, columns: str | Sequence[str] | None) -> list[_Column]:
    """Columns of a file, named by the user, in the header, or as those of allan_variance_ros."""
    table = format_of(path, source).table(path, source, ReadOptions())
    data, labels = table.columns(), table.labels
    given = columns.split(",") if isinstance(columns, str) else columns
    if given is None and labels is None and len(data) == 7:
        given = _ROS.split(",")
    if given is not None:
        if len(given) != len(data):
            raise source.error(
                f"{len(data)} columns, but columns= (--columns) names {len(given)}; use - to skip"
            )
        labels = tuple(x.strip() for x in given)
    if labels is None:
        raise source.error("the columns have no names; give columns=, e.g. 'tau,gyro_x'")
    named = [_Column(x, "other") if x == "-" else _Column.of(x, source) for x in labels]
    return [c.filled(x, source) for c, x in zip(named, data, strict=True)]


def _axes(named: Sequence[_Column], units: dict[Sensor, str | None], source: Source) -> tuple[Axis, ...]:
    """Axes of the columns; one without a name is that of the only sensor whose unit is given or fits."""
    axes = []
    for column in named:
        sensor, name = column.sensor, column.name
        if sensor is None:
            given = [s for s in SENSORS if units[s]] or [s for s in SENSORS if _fits(column.unit, s)]
            if len(given) != 1 or len(named) > 1:
                raise source.error(
                    f"column {column.label!r} does not say which axis it is; give gyro_unit= or accel_unit= "
                    "(--gyro-unit, --accel-unit), or name it with columns=, e.g. 'tau,gyro_x'"
                )
            sensor = name = given[0]
        unit = units[sensor] or column.unit
        if unit is None:
            header = f"{column.label} [{'deg/h' if sensor == 'gyro' else 'µg'}]"
            raise source.error(
                f"column {column.label!r} has no unit; give {sensor}_unit= (--{sensor}-unit), or write it in "
                f"the header: `{header}`"
            )
        if not _fits(unit, sensor):
            told = f"{unit!r} is not a unit of deviations; give {sensor}_unit= (--{sensor}-unit), e.g. "
            raise UnitError(f"{source.label}: column {column.label!r}: {told}{SI[sensor]['rate']}")
        axes.append(Axis(name, sensor, rate_unit_of(unit, sensor)[0]))
    if len({axis.name for axis in axes}) < len(axes):
        raise source.error("two columns are of the same axis; skip one with columns= (--columns)")
    return tuple(axes)


def _fits(unit: str | None, sensor: Sensor) -> bool:
    """Whether a unit is one of a sensor's rates."""
    try:
        return unit is not None and parse_sample_unit(unit, sensor).quantity == "rate"
    except UnitError:
        return False


def _curve(
    tau: Float[np.ndarray, " m"],
    deviation: Float[np.ndarray, "m axes"],
    axes: tuple[Axis, ...],
    rate: float | None,
    duration: float | str | None,
    extra: dict[Any, Float[np.ndarray, " m"]],
    notes: list[str],
    source: Source,
) -> AllanDeviation:
    """The curve at whole numbers of samples, with the degrees of freedom of its record's length."""
    assumed = []
    if rate is None and "size" in extra:
        rate = float(np.median(extra["size"] / tau))
        notes.append(f"the rate, {plain(rate, 6)} Hz, follows from the cluster sizes")
    elif rate is None:
        rate = 1.0 / float(tau[0])
        assumed.append(f"rate= (--rate): {plain(rate, 4)} Hz, one sample in the shortest cluster, is assumed")
    rate = check_rate(rate, source)
    sizes = np.maximum(np.rint(tau * rate), 1.0).astype(int)
    moved = np.abs(sizes / (tau * rate) - 1.0)
    if moved.max() > 0.5:
        raise source.error(
            f"cluster time {tau[0]:.6g} s is shorter than a sample at {rate:g} Hz; correct rate="
        )
    if moved.max() > _ROUNDED:
        notes.append(f"cluster times are rounded to whole samples, by up to {percent(float(moved.max()))}")
    if "count" in extra and np.ptp(lengths := extra["count"] + 2 * sizes - 1) <= 2.0:
        if duration is None:
            duration = float(np.median(lengths)) / rate
            notes.append(f"the length, {in_words(duration)}, follows from the counts")
    elif "count" in extra and max((extra["count"] + 1) * sizes) < min((extra["count"] + 2) * sizes):
        raise source.error(
            "its counts are those of clusters that do not overlap; export the overlapping deviation (oadev)"
        )
    if duration is None:
        duration = 2.0 * float(sizes[-1]) / rate
        assumed.append(f"duration= (--duration): {in_words(duration)}, twice the longest cluster, is assumed")
    n = round(seconds(duration) * rate)
    if 2 * sizes[-1] > n + 1:
        raise source.error(
            f"cluster time {tau[-1]:.6g} s needs a record of {2.0 * tau[-1]:.6g} s, longer than "
            f"{n / rate:.6g} s; correct duration= (--duration) or rate= (--rate)"
        )
    notes += [f"no intervals without {text}" for text in assumed]
    keep = _kept(sizes, rate)
    if len(keep) < len(sizes):
        notes.append(f"{len(keep)} of {len(sizes)} cluster times are used, at most {_PER_OCTAVE} per octave")
    of = deviation[keep], sizes[keep], n, rate
    return AllanDeviation.under_white_noise(*of, axes=axes, notes=tuple(notes), determined=not assumed)


def _kept(sizes: Int[np.ndarray, " m"], rate: float) -> Int[np.ndarray, " kept"]:
    """Indices of the sizes to use: of equal ones the first, and no more than a fit of a record takes."""
    keep = np.unique(sizes, return_index=True)[1]
    grid = estimators.cluster_sizes(2 * int(sizes[-1]), rate, _PER_OCTAVE)
    grid = grid[grid >= sizes[0]]
    # Neighbours are nearly the same estimate.
    if len(keep) > len(grid):
        keep = np.unique([np.argmin(abs(np.log(sizes / size))) for size in grid])
    return keep


def seconds(time: float | str) -> float:
    """A time in s, from a number or text such as "3h", "20 min" or "7200"; AllanjaxError if it is none."""
    value, unit = parse_quantity(time) or (time, "s")
    try:
        found = convert(float(value), unit, "s")
    except (ValueError, UnitError):
        found = math.nan
    if not 0.0 < found < math.inf:
        raise AllanjaxError(f"duration= (--duration) must be a time such as 3h, 20 min or 7200, not {time!r}")
    return found

"""Allan curves from files: published, digitised, or exported by other programs, without their records.

Of such a curve the estimator, the sample rate and the length of the record must be known for the covariance
of its points. allantools, MATLAB's `allanvar`, Stable32 ("overlapping") and `characterize` itself average
overlapping clusters.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float, Int

from allanjax.allan.deviation import AllanDeviation
from allanjax.allan.estimators import cluster_sizes
from allanjax.base.errors import AllanjaxError, UnitError, expect
from allanjax.base.wording import duration as in_words
from allanjax.base.wording import percent, plain
from allanjax.record.columns import recognise, split_unit
from allanjax.record.io import ReadOptions
from allanjax.record.io.formats import format_of, name_of
from allanjax.record.recording import Axis
from allanjax.record.units import (
    SENSORS,
    SI,
    Sensor,
    convert,
    parse_quantity,
    parse_sample_unit,
    rate_unit_of,
)
from allanjax.record.validation import Source, check_rate

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
    expect(path, (str, os.PathLike), "read_curve takes the path of a file")
    source = Source(str(path))
    every = _columns(Path(path), source, columns)
    times = [c for c in every if c.role == "time"]
    chosen = [c for c in every if c.role in ("deviation", "variance")]
    if not times or not chosen:
        wanted = "deviations, e.g. gyro_x [deg/s]" if times else "cluster times, e.g. tau [s]"
        labels = ", ".join(c.label for c in every)
        raise source.error(f"no column of {wanted}, among {labels}; name them with columns= (--columns)")
    tau = convert(times[0].values, times[0].unit or "s", "s")
    units: dict[Sensor, str | None] = {"gyro": gyro_unit, "accel": accel_unit}
    axes = _axes(chosen, units, source)
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
    given = tuple(sensor for sensor in SENSORS if units[sensor] is not None)
    return replace(found, name=name_of(Path(path)), given=given)


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
                    f"column {column.label!r} does not say which axis it is; give gyro_unit= or accel_unit=, "
                    "or name it with columns=, e.g. 'tau,gyro_x'"
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
    grid = cluster_sizes(2 * int(sizes[-1]), rate, _PER_OCTAVE)
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

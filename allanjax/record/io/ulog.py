"""Reader for PX4's ULog files; it requires pyulog."""

import contextlib
import io
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from allanjax.record.io.series import Series, choose, describe_choice, recording_of
from allanjax.record.io.table import Format, Table, damage_reported, floats
from allanjax.record.validation import Source

_REMEDY = "copy it again from the vehicle"
_LOG_MORE = "log sensor_gyro and sensor_accel at full rate (SDLOG_PROFILE)"
# Marks a missing time of accelerations in sensor_combined.
_NO_SAMPLE = 0x7FFFFFFF
# Relative deviation of the interval between FIFO messages within which no sample is lost.
_WHOLE = 0.5

Fields = Mapping[str, np.ndarray]


def open_ulog(path: Path, source: Source, topic: str | None, instance: int | None) -> Table:
    """Return the samples of the messages with the highest rate, or of those chosen.

    Gyros and accelerometers with separate messages are read as one recording.

    Raises:
        RecordingError: pyulog is not installed; the log is damaged or lacks samples of an IMU, or those
            chosen; the rates of gyros and accelerometers differ.
    """
    try:
        from pyulog import ULog
    except ModuleNotFoundError as error:
        raise source.error('reading a PX4 log requires pyulog: pip install "allanjax[px4]"') from error
    # It prints messages on damage; damaged numbers are detected later.
    quiet = contextlib.redirect_stdout(io.StringIO())
    damaged = damage_reported(source, "a ULog file", _REMEDY)
    with damaged, quiet, np.errstate(all="ignore"), _BoundedFile(path) as stream:
        log = ULog(stream, list(_READERS))
        found = {(data.name, data.multi_id): _series(data.name, data.data, source) for data in log.data_list}
    found = {key: series for key, series in found.items() if len(series.times)}
    if not found:
        raise source.error(f"no samples of an IMU ({', '.join(_READERS)}); {_LOG_MORE}")
    chosen = choose(found, _GROUPS, topic, instance, source)
    notes = [describe_choice(found, chosen)]
    if chosen[0].name == "sensor_combined":
        notes.append(
            f"sensor_combined is averaged and corrected by the autopilot; for raw samples {_LOG_MORE}"
        )
    if log.dropouts:
        count, lost = len(log.dropouts), sum(dropout.duration for dropout in log.dropouts)
        notes.append(f"{count} logging dropout{'s' * (count > 1)}, {lost} ms in total")
    if log.file_corruption:
        notes.append("damaged parts of the log are left out")
    return recording_of(chosen, source).table("timestamp", source, notes)


class _BoundedFile(io.BufferedReader):
    """File with a limited number of reads, since pyulog may go back forever in a damaged one.

    It advances by at least one byte at a time, with two calls each.
    """

    def __init__(self, path: Path) -> None:
        super().__init__(io.FileIO(path))
        self._calls = 4 * path.stat().st_size + 1000

    def read(self, size: int | None = -1, /) -> bytes:
        self._calls -= 1
        if self._calls < 0:
            # An error that pyulog does not catch.
            raise RuntimeError("damage prevents reading from ending")
        return super().read(size)


def _series(name: str, fields: Fields, source: Source) -> Series:
    """Return the samples of a message."""
    try:
        return _READERS[name](name, fields).in_order()
    except KeyError as error:
        raise source.error(f"{name} has no field {error} (another PX4 version?); {_LOG_MORE}") from error


def _times(fields: Fields) -> Int[np.ndarray, " n"]:
    """Return the sampling times in ns, or else the times of the messages."""
    sampled = fields.get("timestamp_sample")
    stamps = fields["timestamp"] if sampled is None or not sampled.all() else sampled
    return stamps.astype(np.int64) * 1000


def _array(fields: Fields, name: str, size: int = 3) -> Float[np.ndarray, "n size"]:
    """Return the elements of an array."""
    return np.column_stack([floats(fields[f"{name}[{k}]"]) for k in range(size)])


def _combined(name: str, fields: Fields) -> Series:
    """Return the samples of sensor_combined; accelerations without a time are nan."""
    accel = _array(fields, "accelerometer_m_s2")
    accel[fields["accelerometer_timestamp_relative"] == _NO_SAMPLE] = np.nan
    return Series(name, _times(fields), _array(fields, "gyro_rad"), accel)


def _vehicle_imu(name: str, fields: Fields) -> Series:
    """Return increments of angle and velocity divided by their intervals."""

    def mean_rate(increment: str) -> Float[np.ndarray, "n 3"]:
        interval = 1e-6 * fields["dt" if "dt" in fields else f"{increment}_dt"].astype(float)
        return _array(fields, increment) / np.where(interval > 0.0, interval, np.nan)[:, None]

    return Series(name, _times(fields), mean_rate("delta_angle"), mean_rate("delta_velocity"))


def _sensor(name: str, fields: Fields) -> Series:
    """Return the samples of sensor_gyro or sensor_accel, with the temperature."""
    others = {"temperature [degC]": floats(fields["temperature"])} if "temperature" in fields else {}
    return _half(name, _times(fields), np.column_stack([floats(fields[axis]) for axis in "xyz"]), others)


def _fifo(name: str, fields: Fields) -> Series:
    """Return the samples of sensor_gyro_fifo or sensor_accel_fifo in sequence.

    The time of a message is that of its last sample. If none is lost, the earlier ones are spread evenly from
    the last sample of the previous message; else they have the interval that the message states.
    """
    ends = _times(fields)
    size = sum(field.startswith("x[") for field in fields)
    count = np.minimum(fields["samples"].astype(np.int64), size)
    stated = floats(fields["dt"]) * 1e3
    measured = np.diff(ends, prepend=ends[:1]) / np.maximum(count, 1)
    interval = np.where(np.abs(measured - stated) < _WHOLE * stated, measured, stated)
    number = np.arange(size)
    valid = number < count[:, None]
    ages = np.nan_to_num((count[:, None] - 1 - number) * interval[:, None])
    times = ends[:, None] - np.round(ages).astype(np.int64)
    scale = floats(fields["scale"])[:, None]
    values = np.stack([_array(fields, axis, size) * scale for axis in "xyz"], axis=-1)
    return _half(name, times[valid], values[valid], {})


def _half(name: str, times: np.ndarray, values: np.ndarray, others: Mapping[str, np.ndarray]) -> Series:
    """Return the series of gyros or accelerometers, according to the name of the message."""
    if "gyro" in name:
        return Series(name, times, gyro=values, auxiliary=others)
    return Series(name, times, accel=values, auxiliary=others)


_READERS: dict[str, Callable[[str, Any], Series]] = {
    "sensor_gyro_fifo": _fifo,
    "sensor_accel_fifo": _fifo,
    "sensor_gyro": _sensor,
    "sensor_accel": _sensor,
    "vehicle_imu": _vehicle_imu,
    "sensor_combined": _combined,
}
# Messages that form one recording, gyros first.
_GROUPS = (
    ("sensor_gyro_fifo", "sensor_accel_fifo"),
    ("sensor_gyro", "sensor_accel"),
    ("vehicle_imu",),
    ("sensor_combined",),
)

ULOG = Format(
    "ULog",
    lambda magic: magic.startswith(b"ULog\x01\x12\x35"),
    open_ulog,
    (".ulg",),
    in_chunks=False,
    choices=("topic", "instance"),
)

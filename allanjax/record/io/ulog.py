"""Reader of PX4's ULog files; it needs pyulog."""

import contextlib
import io
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from allanjax.record.io.series import Series, choose, recording_of, told_choice
from allanjax.record.io.table import Format, Table, damage_told, floats
from allanjax.record.validation import Source

_REMEDY = "copy it again from the vehicle"
_LOG_MORE = "log sensor_gyro and sensor_accel at full rate by SDLOG_PROFILE"
# What stands for a time of accelerations that there is not, in sensor_combined.
_NO_SAMPLE = 0x7FFFFFFF
# Interval between FIFO messages, relative to that of their samples, within which none is lost.
_WHOLE = 0.5

Fields = Mapping[str, np.ndarray]


def open_ulog(path: Path, source: Source, topic: str | None, instance: int | None) -> Table:
    """Samples of the messages that have the highest rate, or of those chosen.

    Gyros and accelerometers that have messages of their own are read as one recording.

    Raises:
        RecordingError: pyulog is not installed; the log is damaged, has no samples of an IMU, or not those
            that are chosen; the rates of gyros and accelerometers differ.
    """
    try:
        from pyulog import ULog
    except ModuleNotFoundError as error:
        raise source.error('a PX4 log, for which pyulog is needed: pip install "allanjax[px4]"') from error
    # It prints what it finds damaged; damaged numbers are found later.
    quiet = contextlib.redirect_stdout(io.StringIO())
    damaged = damage_told(source, "a ULog file", _REMEDY)
    with damaged, quiet, np.errstate(all="ignore"), _BoundedFile(path) as stream:
        log = ULog(stream, list(_READERS))
        found = {(data.name, data.multi_id): _series(data.name, data.data, source) for data in log.data_list}
    found = {key: series for key, series in found.items() if len(series.times)}
    if not found:
        raise source.error(f"no samples of an IMU ({', '.join(_READERS)}); {_LOG_MORE}")
    chosen = choose(found, _GROUPS, topic, instance, source)
    notes = [told_choice(found, chosen)]
    if chosen[0].name == "sensor_combined":
        notes.append(
            "sensor_combined is what the autopilot has averaged and corrected; for the sensor's own noise "
            f"{_LOG_MORE}"
        )
    if log.dropouts:
        lost = sum(dropout.duration for dropout in log.dropouts)
        notes.append(f"{len(log.dropouts)} dropouts of the log, of {lost} ms in all")
    if log.file_corruption:
        notes.append("damaged parts of the log are left out")
    return recording_of(chosen, source).table("timestamp", source, notes)


class _BoundedFile(io.BufferedReader):
    """File that is read so often and no more: in a damaged one pyulog may go back for ever.

    It goes on by a byte at a time at the least, with two calls each.
    """

    def __init__(self, path: Path) -> None:
        super().__init__(io.FileIO(path))
        self._calls = 4 * path.stat().st_size + 1000

    def read(self, size: int | None = -1, /) -> bytes:
        self._calls -= 1
        if self._calls < 0:
            # Of a kind that pyulog does not catch.
            raise RuntimeError("its parts are damaged so that reading it does not end")
        return super().read(size)


def _series(name: str, fields: Fields, source: Source) -> Series:
    """Samples of a message."""
    try:
        return _READERS[name](name, fields).in_order()
    except KeyError as error:
        raise source.error(
            f"{name} has no field {error}, as of another version of PX4; {_LOG_MORE}"
        ) from error


def _times(fields: Fields) -> Int[np.ndarray, " n"]:
    """Times in ns at which samples were taken, or if they are not told, of the message."""
    sampled = fields.get("timestamp_sample")
    stamps = fields["timestamp"] if sampled is None or not sampled.all() else sampled
    return stamps.astype(np.int64) * 1000


def _array(fields: Fields, name: str, size: int = 3) -> Float[np.ndarray, "n size"]:
    """Elements of an array."""
    return np.column_stack([floats(fields[f"{name}[{k}]"]) for k in range(size)])


def _combined(name: str, fields: Fields) -> Series:
    """Samples of sensor_combined; accelerations that have no time are nan."""
    accel = _array(fields, "accelerometer_m_s2")
    accel[fields["accelerometer_timestamp_relative"] == _NO_SAMPLE] = np.nan
    return Series(name, _times(fields), _array(fields, "gyro_rad"), accel)


def _vehicle_imu(name: str, fields: Fields) -> Series:
    """Increments of angle and velocity over the times in which they were gained."""

    def mean_rate(increment: str) -> Float[np.ndarray, "n 3"]:
        interval = 1e-6 * fields["dt" if "dt" in fields else f"{increment}_dt"].astype(float)
        return _array(fields, increment) / np.where(interval > 0.0, interval, np.nan)[:, None]

    return Series(name, _times(fields), mean_rate("delta_angle"), mean_rate("delta_velocity"))


def _sensor(name: str, fields: Fields) -> Series:
    """Samples of sensor_gyro or sensor_accel, with the temperature."""
    others = {"temperature [degC]": floats(fields["temperature"])} if "temperature" in fields else {}
    return _half(name, _times(fields), np.column_stack([floats(fields[axis]) for axis in "xyz"]), others)


def _fifo(name: str, fields: Fields) -> Series:
    """Samples of sensor_gyro_fifo or sensor_accel_fifo, one after the other.

    The time of a message is that of its last sample. Where none is lost, those before it are spread evenly
    from the last of the message before; else they are at the interval that the message tells.
    """
    ends = _times(fields)
    size = sum(field.startswith("x[") for field in fields)
    count = np.minimum(fields["samples"].astype(np.int64), size)
    told = floats(fields["dt"]) * 1e3
    measured = np.diff(ends, prepend=ends[:1]) / np.maximum(count, 1)
    interval = np.where(np.abs(measured - told) < _WHOLE * told, measured, told)
    number = np.arange(size)
    valid = number < count[:, None]
    ages = np.nan_to_num((count[:, None] - 1 - number) * interval[:, None])
    times = ends[:, None] - np.round(ages).astype(np.int64)
    scale = floats(fields["scale"])[:, None]
    values = np.stack([_array(fields, axis, size) * scale for axis in "xyz"], axis=-1)
    return _half(name, times[valid], values[valid], {})


def _half(name: str, times: np.ndarray, values: np.ndarray, others: Mapping[str, np.ndarray]) -> Series:
    """Series of gyros or accelerometers, as the message's name tells."""
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
# Messages that are one recording, gyros first.
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

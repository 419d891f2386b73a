"""Readers for logs of PX4 (ULog, with pyulog) and ArduPilot (DataFlash, which defines its messages)."""

import contextlib
import io
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int, Shaped, UInt8

from allanjax.base.wording import duration
from allanjax.record.io.series import Series, joined
from allanjax.record.io.table import CHOICES, Format, Table, damage_reported, floats, optional_package
from allanjax.record.validation import Source

_COPY_AGAIN = "copy it again from the vehicle"
_LOG_MORE = "log sensor_gyro and sensor_accel at full rate (SDLOG_PROFILE)"
# Marks a missing time of accelerations in sensor_combined.
_NO_SAMPLE = 0x7FFFFFFF
# Relative deviation of the interval between FIFO messages within which no sample is lost.
_WHOLE = 0.5

Fields = Mapping[str, np.ndarray]
# A message begins with two bytes and its type; type 128 defines another message in 89 bytes.
_HEAD = 3
_FMT, _FMT_SIZE = 128, 89
# Characters for types of numbers; others are texts and numbers that do not occur in samples.
_TYPES = {"b": "i1", "B": "u1", "M": "u1", "h": "<i2", "H": "<u2", "i": "<i4", "I": "<u4", "q": "<i8"}
_TYPES |= {"Q": "<u8", "g": "<f2", "f": "<f4", "d": "<f8", "n": "S4", "N": "S16", "Z": "S64", "L": "<i4"}
_TYPES |= {"a": "(32,)<i2", "c": "<i2", "C": "<u2", "e": "<i4", "E": "<u4"}
# Messages with samples, with a number for further sensors; and groups that form one recording.
_SAMPLES = re.compile(r"(IMU|ACC|GYR)(\d?)")
_DATAFLASH_GROUPS = (("GYR", "ACC"), ("IMU",))
_BATCHES = ("ISBH", "ISBD")
# Bytes that are searched at a time.
_BLOCK = 1 << 26
_LOG_IMU = "set IMU_FAST or IMU_RAW in LOG_BITMASK, and LOG_DISARMED to 1"


def open_ulog(path: Path, source: Source, topic: str | None, instance: int | str | None) -> Table:
    """Return the samples of the messages with the highest rate, or of those chosen.

    Gyros and accelerometers with separate messages are read as one recording.
    """
    pyulog = optional_package("pyulog", "px4", "a PX4 log", source)
    # It prints messages on damage; damaged numbers are detected later.
    quiet = contextlib.redirect_stdout(io.StringIO())
    damaged = damage_reported(source, "a ULog file", _COPY_AGAIN)
    with damaged, quiet, np.errstate(all="ignore"), _BoundedFile(path) as stream:
        log = pyulog.ULog(stream, list(_READERS))
        found = {}
        for data in log.data_list:
            try:
                series = _READERS[data.name](data.name, data.data).in_order()
            except KeyError as error:
                other = f"{data.name} has no field {error} (another PX4 version?); {_LOG_MORE}"
                raise source.error(other) from error
            if len(series.times):
                found[data.name, data.multi_id] = series
    if not found:
        raise source.error(f"no samples of an IMU ({', '.join(_READERS)}); {_LOG_MORE}")
    chosen, note = _chosen(found, _ULOG_GROUPS, topic, instance, source)
    notes = [note]
    if chosen[0].name == "sensor_combined":
        notes.append(
            f"sensor_combined is averaged and corrected by the autopilot; for raw samples {_LOG_MORE}"
        )
    if log.dropouts:
        count, lost = len(log.dropouts), sum(dropout.duration for dropout in log.dropouts)
        notes.append(f"{count} logging dropout{'s' * (count > 1)}, {lost} ms in total")
    if log.file_corruption:
        notes.append("damaged parts of the log are left out")
    if stream.is_cut:
        end = float(chosen[0].times[-1] - chosen[0].times[0]) * 1e-9
        notes.append(f"the log ends within a message after {duration(end)}, as when power is lost")
    return joined(chosen, source).table("timestamp", source, notes)


class _BoundedFile(io.BufferedReader):
    """File with a limited number of reads, since pyulog may go back forever in a damaged one.

    It advances by at least one byte at a time, with two calls each.

    Attributes:
        is_cut: whether a read has met the end of the file before its last byte.
    """

    is_cut = False

    def __init__(self, path: Path) -> None:
        super().__init__(io.FileIO(path))
        self._calls = 4 * path.stat().st_size + 1000

    def read(self, size: int | None = -1, /) -> bytes:
        self._calls -= 1
        if self._calls < 0:
            # An error that pyulog does not catch.
            raise RuntimeError("reading does not end, as the file is damaged")
        content = super().read(size)
        self.is_cut |= 0 < len(content) < (size or 0)
        return content


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
    half: dict[str, Any] = {"gyro" if "gyro" in name else "accel": values}
    return Series(name, times, **half, auxiliary=others)


_READERS: dict[str, Callable[[str, Any], Series]] = {
    "sensor_gyro_fifo": _fifo,
    "sensor_accel_fifo": _fifo,
    "sensor_gyro": _sensor,
    "sensor_accel": _sensor,
    "vehicle_imu": _vehicle_imu,
    "sensor_combined": _combined,
}
# Messages that form one recording, gyros first.
_ULOG_GROUPS = (
    ("sensor_gyro_fifo", "sensor_accel_fifo"),
    ("sensor_gyro", "sensor_accel"),
    ("vehicle_imu",),
    ("sensor_combined",),
)

ULOG = Format("ULog", b"ULog\x01\x12\x35", open_ulog, (".ulg",), in_chunks=False, choices=CHOICES)


def open_dataflash(path: Path, source: Source, topic: str | None, instance: int | str | None) -> Table:
    """Return the samples of IMU, or of GYR and ACC, whichever has the higher rate or is chosen."""
    data = np.memmap(path, np.uint8, "r")
    heads = _heads(data)
    definitions = _definitions(data, heads)
    if not definitions:
        raise source.error(
            "cannot be read as a DataFlash log: it defines no messages; copy it again, or save the data as "
            "CSV, Parquet or NumPy .npy"
        )
    lengths = np.zeros(256, np.int64)
    lengths[_FMT] = _FMT_SIZE
    for kind, (_, dtype) in definitions.items():
        if dtype is not None:
            lengths[kind] = _HEAD + dtype.itemsize
    starts = _messages(data, heads, lengths)
    kinds = data[starts + 2]
    found: dict[tuple[str, int], Series] = {}
    batches = False
    for kind, (name, dtype) in definitions.items():
        rows = starts[kinds == kind]
        batches |= name in _BATCHES and len(rows) > 0
        if _SAMPLES.fullmatch(name) and dtype is not None and len(rows):
            payload = data[rows[:, None] + np.arange(_HEAD, lengths[kind])]
            found |= _series(name, payload.view(dtype)[:, 0], source)
    if batches and (not found or topic in _BATCHES):
        raise source.error(
            f"batches with pauses (ISBH, ISBD) are unsuitable for Allan deviations; {_LOG_IMU}"
        )
    if not found:
        raise source.error(f"no samples of an IMU (IMU, or GYR and ACC); {_LOG_IMU}")
    chosen, note = _chosen(found, _DATAFLASH_GROUPS, topic, instance, source)
    notes = [note]
    skipped = len(data) - int(lengths[kinds].sum())
    if skipped:
        notes.append(f"{skipped} of {len(data)} bytes are incomplete messages, which are left out")
    if batches:
        notes.append("batches of samples with pauses (ISBH, ISBD) are left out")
    return joined(chosen, source).table("time", source, notes)


def _heads(data: UInt8[np.ndarray, " bytes"]) -> Int[np.ndarray, " heads"]:
    """Return the places where a message may begin."""
    found = [np.zeros(0, np.int64)]
    for first in range(0, len(data) - 2, _BLOCK):
        block = data[first : first + _BLOCK + 1]
        found.append(first + np.flatnonzero((block[:-1] == 0xA3) & (block[1:] == 0x95)))
    places = np.concatenate(found)
    return places[places < len(data) - 2]


def _definitions(
    data: UInt8[np.ndarray, " bytes"], heads: Int[np.ndarray, " heads"]
) -> dict[int, tuple[str, np.dtype | None]]:
    """Return name and fields of the messages by type; the fields are None if the definition is damaged."""
    definitions = {}
    for start in heads[data[heads + 2] == _FMT]:
        message = data[start : start + _FMT_SIZE].tobytes()
        if len(message) == _FMT_SIZE:
            name, characters = _text(message[5:9]), _text(message[9:25])
            fields = [field.strip() for field in _text(message[25:]).split(",")]
            dtype = None
            if set(characters) <= {*_TYPES} and len(fields) == len({*fields} - {""}) == len(characters):
                dtype = np.dtype([(x, _TYPES[c]) for x, c in zip(fields, characters, strict=True)])
            intact = dtype is not None and dtype.itemsize == message[4] - _HEAD
            definitions[message[3]] = name, dtype if intact else None
    return definitions


def _text(part: bytes) -> str:
    """Return the text in a part of a message."""
    return part.partition(b"\0")[0].decode("latin-1")


def _messages(
    data: UInt8[np.ndarray, " bytes"], heads: Int[np.ndarray, " heads"], lengths: Int[np.ndarray, "256"]
) -> Int[np.ndarray, " messages"]:
    """Return the places of messages: heads of a known type, with another head where the message ends."""
    size = lengths[data[heads + 2]]
    ends = heads + size
    is_head = np.isin(ends, heads) | (ends == len(data))
    starts, ends = heads[(size > 0) & is_head], ends[(size > 0) & is_head]
    # The bytes of a head may occur within a message: a head within a kept message is not one.
    while len(starts):
        within = np.append(False, starts[1:] < ends[:-1])
        within &= ~np.append(False, within[:-1])
        if not within.any():
            break
        starts, ends = starts[~within], ends[~within]
    return starts


def _series(
    name: str, rows: Shaped[np.ndarray, " messages"], source: Source
) -> Mapping[tuple[str, int], Series]:
    """Return series by message and sensor number, which is in a field or in the name of the message."""
    match = _SAMPLES.fullmatch(name)
    assert match is not None
    fields = [name for name in rows.dtype.names or () if rows.dtype[name].kind in "iuf"]
    clock = next((clock for clock in ("SampleUS", "TimeUS", "TimeMS") if clock in fields), None)
    halves: dict[str, Any] = {}
    for sensor, label in (("gyro", "Gyr"), ("accel", "Acc")):
        own = [f"{label}{axis}" for axis in "XYZ"]
        if {*own} <= {*fields}:
            halves[sensor] = np.column_stack([floats(rows[field]) for field in own])
    if clock is None or not halves:
        raise source.error(f"{name} lacks times or samples (it has {', '.join(fields)}); {_LOG_IMU}")
    times = rows[clock].astype(np.int64) * (10**6 if clock == "TimeMS" else 10**3)
    others = {"temperature [degC]": floats(rows["T"])} if "T" in fields else {}
    whole = Series(match[1], times, **halves, auxiliary=others)
    numbers = rows["I"] if "I" in fields else np.full(len(rows), max(int(match[2] or 1) - 1, 0))
    return {(match[1], int(i)): whole.taken(numbers == i).in_order() for i in np.unique(numbers)}


DATAFLASH = Format("DataFlash", b"\xa3\x95", open_dataflash, (".bin",), in_chunks=False, choices=CHOICES)


def _chosen(
    found: Mapping[tuple[str, int], Series],
    groups: Sequence[tuple[str, ...]],
    topic: str | None,
    instance: int | str | None,
    source: Source,
) -> tuple[list[Series], str]:
    """Return the series to read, one or one per sensor (gyros first), and a note on the choice.

    `found` are the series by message and number of the sensor, and `groups` are messages that form one
    recording. By default, it is the first instance in the group with the highest rate.
    """
    kept = {key: series for key, series in found.items() if str(instance) in ("None", str(key[1]))}
    if not kept:
        numbers = sorted({number for _, number in found})
        raise source.error(f"no instance {instance}; choose {', '.join(map(str, numbers))} with instance=")
    names = {name for name, _ in kept}
    if topic is None:
        fastest = max(kept, key=lambda key: kept[key].rate)[0]
        wanted = next({*group} & names for group in groups if fastest in group)
    else:
        wanted = {name.strip() for name in topic.split(",")}
        if not wanted <= names or not any(wanted <= {*group} for group in groups):
            raise source.error(
                f"topic {topic!r} is not an IMU topic of this log; topics are "
                f"{', '.join(f'{name} {number}' for name, number in sorted(found))}"
            )
    first = [min(key for key in kept if key[0] == name) for name in sorted(wanted, reverse=True)]
    words = {key: f"{key[0]} {key[1]} at {series.rate:.4g} Hz" for key, series in found.items()}
    note = " and ".join(words.pop(key) for key in first)
    if words:
        note += f"; topic= and instance= (--topic, --instance) choose {', '.join(sorted(words.values()))}"
    return [kept[key] for key in first], note

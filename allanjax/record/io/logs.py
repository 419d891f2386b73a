"""Readers for logs with separate messages of gyros and accelerometers, which are joined into one table.

ROS bags (with rosbags), PX4's ULog (with pyulog), and ArduPilot's DataFlash, which defines its messages.
"""

import contextlib
import io
import itertools
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int, Shaped, UInt8

from allanjax.record.io.table import CHOICES, Format, Table, damage_reported, floats, optional_package
from allanjax.record.io.timestamps import MAX_RATE_DIFFERENCE, format_jitter, regular_intervals
from allanjax.record.units import Sensor
from allanjax.record.validation import Source

# Units of the samples in all logs.
_UNITS: dict[Sensor, str] = {"gyro": "rad/s", "accel": "m/s²"}
# Smallest share of samples with a partner in the other series.
_MATCHED = 0.9


@dataclass(frozen=True)
class Series:
    """Samples of one message or topic.

    Attributes:
        name: name of the message or topic.
        times: stamps in ns.
        gyro: angular rates in rad/s, or None if it has none.
        accel: accelerations in m/s², or None if it has none.
        auxiliary: other columns by label.
    """

    name: str
    times: Int[np.ndarray, " samples"]
    gyro: Float[np.ndarray, "samples 3"] | None = None
    accel: Float[np.ndarray, "samples 3"] | None = None
    auxiliary: Mapping[str, np.ndarray] = field(default_factory=dict)

    @property
    def rate(self) -> float:
        """Sample rate in Hz from the stamps, without gaps; 0 if unknown."""
        intervals = seconds_between(self.times)
        mean = float(intervals.mean()) if intervals.size else 0.0
        return 1.0 / mean if mean > 0.0 else 0.0

    def taken(self, rows: np.ndarray) -> "Series":
        """Return the series of these rows."""
        gyro, accel = (None if half is None else half[rows] for half in (self.gyro, self.accel))
        others = {label: values[rows] for label, values in self.auxiliary.items()}
        return replace(self, times=self.times[rows], gyro=gyro, accel=accel, auxiliary=others)

    def in_order(self) -> "Series":
        """Return the series sorted by its stamps."""
        return self if (np.diff(self.times) >= 0).all() else self.taken(np.argsort(self.times, kind="stable"))

    def table(self, clock: str, source: Source, notes: Sequence[str]) -> Table:
        """Return a table with the stamps, labelled `clock` [ns], the axes and the auxiliary columns."""
        columns = {f"{clock} [ns]": self.times}
        for sensor, half in (("gyro", self.gyro), ("accel", self.accel)):
            if half is not None:
                columns |= {f"{sensor}_{axis}": half[:, k] for k, axis in enumerate("xyz")}
        columns |= self.auxiliary
        table = Table.of(tuple(columns.values()), tuple(columns), source, notes=tuple(notes))
        return replace(table, units=_UNITS)


def seconds_between(stamps: Int[np.ndarray, " n"]) -> Float[np.ndarray, " intervals"]:
    """Return intervals [s] between stamps [ns] in time order, without gaps."""
    ordered = np.sort(stamps)
    return regular_intervals(1e-9 * (ordered - ordered[:1]))


def joined(chosen: Sequence[Series], source: Source) -> Series:
    """Return a sorted series, or the gyros of one and the accelerometers of another with the gyros' stamps.

    A sample without partner is left out, which leaves a gap.
    """
    if len(chosen) == 1:
        return chosen[0]
    gyro, accel = chosen
    rates = gyro.rate, accel.rate
    choose = f"choose one with topic= (--topic), {gyro.name} or {accel.name}"
    if not all(rates) or abs(rates[0] / rates[1] - 1.0) > MAX_RATE_DIFFERENCE:
        raise source.error(
            f"the gyros of {gyro.name} are at {rates[0]:.6g} Hz and the accelerometers of {accel.name} at "
            f"{rates[1]:.6g} Hz, but a recording has one rate; {choose}"
        )
    half = round(0.5e9 / rates[0])
    partner = np.searchsorted(accel.times, gyro.times - half)
    paired = partner < len(accel.times)
    paired[paired] = accel.times[partner[paired]] < gyro.times[paired] + half
    rows = np.flatnonzero(paired)
    rows = rows[np.diff(partner[rows], prepend=-1) > 0]
    if len(rows) < _MATCHED * min(len(gyro.times), len(accel.times)):
        raise source.error(
            f"only {len(rows)} of {len(gyro.times)} samples of {gyro.name} have one of {accel.name} at the "
            f"same time; {choose}"
        )
    one, other = gyro.taken(rows), accel.taken(partner[rows])
    both = f"{gyro.name} and {accel.name}"
    return replace(one, name=both, accel=other.accel, auxiliary={**other.auxiliary, **one.auxiliary})


# Flight logs: PX4 and ArduPilot.

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


def open_ulog(path: Path, source: Source, topic: str | None, instance: int | None) -> Table:
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
    return joined(chosen, source).table("timestamp", source, notes)


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
            raise RuntimeError("reading does not end, as the file is damaged")
        return super().read(size)


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


def open_dataflash(path: Path, source: Source, topic: str | None, instance: int | None) -> Table:
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
            name, characters, labels = (
                message[part].partition(b"\0")[0].decode("latin-1")
                for part in (slice(5, 9), slice(9, 25), slice(25, None))
            )
            names = [label.strip() for label in labels.split(",")]
            dtype = None
            if set(characters) <= {*_TYPES} and len(names) == len({*names} - {""}) == len(characters):
                dtype = np.dtype([(x, _TYPES[c]) for x, c in zip(names, characters, strict=True)])
            intact = dtype is not None and dtype.itemsize == message[4] - _HEAD
            definitions[message[3]] = name, dtype if intact else None
    return definitions


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
    halves = {
        sensor: np.column_stack([floats(rows[f"{label}{axis}"]) for axis in "XYZ"])
        for sensor, label in (("gyro", "Gyr"), ("accel", "Acc"))
        if {f"{label}{axis}" for axis in "XYZ"} <= {*fields}
    }
    if clock is None or not halves:
        raise source.error(f"{name} lacks times or samples (it has {', '.join(fields)}); {_LOG_IMU}")
    times = rows[clock].astype(np.int64) * (10**6 if clock == "TimeMS" else 10**3)
    others = {"temperature [degC]": floats(rows["T"])} if "T" in fields else {}
    whole = Series(match[1], times, halves.get("gyro"), halves.get("accel"), others)
    numbers = rows["I"] if "I" in fields else np.full(len(rows), max(int(match[2] or 1) - 1, 0))
    return {(match[1], int(i)): whole.taken(numbers == i).in_order() for i in np.unique(numbers)}


DATAFLASH = Format("DataFlash", b"\xa3\x95", open_dataflash, (".bin",), in_chunks=False, choices=CHOICES)


def _chosen(
    found: Mapping[tuple[str, int], Series],
    groups: Sequence[tuple[str, ...]],
    topic: str | None,
    instance: int | None,
    source: Source,
) -> tuple[list[Series], str]:
    """Return the series to read, one or one per sensor (gyros first), and a note on the choice.

    `found` are the series by message and number of the sensor, and `groups` are messages that form one
    recording. By default, it is the first instance in the group with the highest rate.
    """
    kept = {key: series for key, series in found.items() if instance in (None, key[1])}
    if not kept:
        numbers = sorted({number for _, number in found})
        raise source.error(
            f"no instance {instance}; choose {', '.join(map(str, numbers))} with instance= (--instance)"
        )
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


# Bags of ROS 1 and ROS 2: messages of sensor_msgs/Imu.

_IMU = "sensor_msgs/msg/Imu"
# The frame's text begins after 16 bytes, the last of which are seconds, nanoseconds and its length.
_TEXT = 16
# A message ends with 37 float64: orientation 4 + 9 (covariance), angular velocity 3 + 9, acceleration 3 + 9.
_TAIL = 37 * 8
_GYRO, _ACCEL = slice(13, 16), slice(25, 28)
# Messages decoded at a time, and messages from which a topic is described.
_AT_ONCE = 1 << 15
_FIRST = 1000
_BEGINNINGS = (b"#ROSBAG V", b"\x89MCAP0\r\n", b"SQLite format 3\0")
_REINDEX = "copy it again, or repair it by `rosbag reindex`, `ros2 bag reindex` or `mcap recover`"


class _Topic(NamedTuple):
    """Messages of a topic: stamps of their headers and times in the bag [ns], gyros and accelerometers."""

    name: str
    stamps: Int[np.ndarray, " n"]
    arrivals: Int[np.ndarray, " n"]
    values: Float[np.ndarray, "n 6"]
    frame: str

    @property
    def clock(self) -> str:
        """Name of the times that are used: the stamps, or those in the bag if the stamps never change."""
        constant = len(self.stamps) > 0 and (self.stamps == self.stamps[0]).all()
        return "bag_time" if constant else "header.stamp"

    @property
    def series(self) -> Series:
        """The samples, without a sensor that is zero throughout."""
        gyro, accel = (half if half.any() else None for half in (self.values[:, :3], self.values[:, 3:]))
        times = self.arrivals if self.clock == "bag_time" else self.stamps
        return Series(self.name, times, gyro, accel)


def open_ros(path: Path, source: Source, topic: str | None) -> Table:
    """Return the sensor_msgs/Imu messages of a topic, sorted by the stamps of their headers.

    Two topics, one with only gyros and one with only accelerometers, are read as one recording.
    """
    reader = _reader(path, source)
    with damage_reported(source, "a ROS bag", _REINDEX), reader(path) as bag:
        topics = _imu_topics(bag, source)

        def read(name: str, count: int | None = None) -> _Topic:
            return _topic(bag, topics[name], source, count)

        def described() -> str:
            return ", ".join(_described(read(name, _FIRST), topics[name]) for name in topics)

        names = list(topics) if topic is None else [name.strip() for name in topic.split(",")]
        if topic is None and len(names) > 1:
            if len(names) > 2 or not _are_halves([read(name, _FIRST).series for name in names]):
                raise source.error(
                    f"{len(names)} topics of sensor_msgs/Imu; choose one with topic= (--topic): {described()}"
                )
        elif len(names) > 2 or len(set(names)) < len(names) or not set(names) <= set(topics):
            raise source.error(
                f"topic {topic!r} is not a topic of sensor_msgs/Imu, or two separated by a comma; topics "
                f"are: {described()}"
            )
        chosen = [read(name) for name in names]
    return _table(chosen, source)


def _reader(path: Path, source: Source) -> Any:
    """Return the class that reads such a bag."""
    readers = [optional_package(f"rosbags.rosbag{k}", "ros", "a ROS bag", source).Reader for k in (1, 2)]
    if path.is_dir():
        return readers[1]
    with path.open("rb") as stream:
        magic = stream.read(16)
    if magic.startswith(_BEGINNINGS[1:]):
        suffix = ".mcap" if magic.startswith(b"\x89MCAP") else ".db3"
        if path.suffix != suffix:
            raise source.error(f"the name of this ROS 2 bag does not end in {suffix}; rename it")
        return readers[1]
    return readers[0]


def _imu_topics(bag: Any, source: Source) -> dict[str, list[Any]]:
    """Return the connections of each topic of sensor_msgs/Imu."""
    topics: dict[str, list[Any]] = {}
    for connection in bag.connections:
        if connection.msgtype == _IMU:
            topics.setdefault(connection.topic, []).append(connection)
    if not topics:
        others = sorted({f"{connection.topic} ({connection.msgtype})" for connection in bag.connections})
        raise source.error(
            f"no topic of sensor_msgs/Imu (topics: {', '.join(others[:20]) or 'none'}); record the IMU"
        )
    return topics


def _described(first: _Topic, connections: Sequence[Any]) -> str:
    """Return a topic in words, by its first messages: number of messages, rate, and frame."""
    series, count = first.series, sum(connection.msgcount for connection in connections)
    alone = {(False, True): ", gyros only", (True, False): ", accelerometers only"}
    half = alone.get((series.gyro is None, series.accel is None), "")
    return f"{first.name} ({count} messages at {series.rate:.4g} Hz, frame {first.frame!r}{half})"


def _topic(bag: Any, connections: Sequence[Any], source: Source, count: int | None) -> _Topic:
    """Return the messages of a topic in the order of the bag, or the first `count` of them."""
    name = connections[0].topic
    stamps: list[np.ndarray] = []
    arrivals, values, frame = [], [], ""
    messages = itertools.islice(bag.messages(connections=connections), count)
    while block := list(itertools.islice(messages, _AT_ONCE)):
        raw = [message for _, _, message in block]
        frame = frame or raw[0][_TEXT:-_TAIL].partition(b"\0")[0].decode("utf-8", "replace")
        decoded = _decoded(raw, name, len(stamps) * _AT_ONCE, source)
        stamps.append(decoded[0])
        values.append(decoded[1])
        arrivals.append(np.array([time for _, time, _ in block], dtype=np.int64))
    if not stamps:
        return _Topic(name, np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 6)), frame)
    return _Topic(name, np.concatenate(stamps), np.concatenate(arrivals), np.concatenate(values), frame)


def _decoded(
    raw: Sequence[bytes], topic: str, first: int, source: Source
) -> tuple[Int[np.ndarray, " n"], Float[np.ndarray, "n 6"]]:
    """Return stamps [ns] and values of serialized messages; the first is message `first` of the topic.

    The layout is fixed up to the frame's text, whose length is stated before it, and again after it: 12
    bytes, the text, in ROS 2 up to seven bytes more, and the numbers. All numbers have the same byte order.
    """
    lengths = np.fromiter(map(len, raw), int, len(raw))
    stamps, values = np.zeros(len(raw), np.int64), np.zeros((len(raw), 6))
    intact = np.zeros(len(raw), bool)
    for length in np.unique(lengths[lengths >= _TEXT + _TAIL]):
        same = np.flatnonzero(lengths == length)
        block = np.frombuffer(b"".join([raw[i] for i in same.tolist()]), np.uint8).reshape(len(same), length)
        header, tail = (np.ascontiguousarray(x) for x in (block[:, 4:_TEXT], block[:, length - _TAIL :]))
        for order in "<>":
            seconds, nanoseconds, text = header.view(f"{order}u4").astype(np.int64).T
            end = _TEXT + text
            fits = (length == end + _TAIL) | (length == 4 + (end + 3) // 8 * 8 + _TAIL)
            # A length of zero is the same in both byte orders.
            fits &= ~intact[same]
            rows = same[fits]
            stamps[rows] = (seconds * 10**9 + nanoseconds)[fits]
            numbers = tail.view(f"{order}f8")[fits]
            values[rows, :3], values[rows, 3:] = numbers[:, _GYRO], numbers[:, _ACCEL]
            intact[rows] = True
    if not intact.all():
        raise source.error(
            f"message {first + int(np.argmin(intact))} of the topic {topic} (from 0) is damaged; {_REINDEX}"
        )
    return stamps, values


def _are_halves(series: Sequence[Series]) -> bool:
    """Return whether one of two series has only gyros and the other only accelerometers."""
    return sorted((one.gyro is None, one.accel is None) for one in series) == [(False, True), (True, False)]


def _table(topics: Sequence[_Topic], source: Source) -> Table:
    """Return the table of the chosen topic, or of two."""
    found, notes = [], []
    for topic in topics:
        series, name = topic.series, topic.name
        if not len(series.times):
            raise source.error(f"the topic {name} has no messages; choose another with topic= (--topic)")
        if series.gyro is None and series.accel is None:
            raise source.error(f"the topic {name} has only zeros; record it while its sensor is running")
        notes += _notes(topic, series)
        found.append(series.in_order())
    if len(found) > 1 and not _are_halves(found):
        names = " and ".join(topic.name for topic in topics)
        raise source.error(f"{names} are not gyros and accelerometers; choose one with topic= (--topic)")
    gyros_first = sorted(found, key=lambda series: series.gyro is None)
    return joined(gyros_first, source).table(topics[0].clock, source, notes)


def _notes(topic: _Topic, series: Series) -> list[str]:
    """Return notes on a topic: its frame, its stamps and missing sensors."""
    name, clock = topic.name, topic.clock
    notes = [f"{name}: {len(series.times)} messages, frame {topic.frame!r}"]
    late = int(np.count_nonzero(np.diff(series.times) < 0))
    if late:
        notes.append(f"{name}: {late} messages out of order, sorted by {clock}")
    between = [seconds_between(stamps) for stamps in (topic.stamps, topic.arrivals)]
    if clock == "bag_time":
        notes.insert(1, "header.stamp never changes; the time of the bag is used")
    elif all(len(intervals) for intervals in between):
        jitters = [format_jitter(float(np.std(intervals))) for intervals in between]
        notes.append(f"{name}: jitter of header.stamp {jitters[0]}, of the bag time {jitters[1]}")
    for what, half in (("angular velocities", series.gyro), ("accelerations", series.accel)):
        if half is None:
            notes.append(f"{name}: {what} are zero throughout and left out")
    return notes


_SUFFIXES = (".bag", ".mcap", ".db3")
ROS = Format("ROS bag", _BEGINNINGS, open_ros, _SUFFIXES, in_chunks=False, choices=("topic",))

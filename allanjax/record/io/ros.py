"""Reader for bags of ROS 1 and ROS 2 (with rosbags): messages of sensor_msgs/Imu."""

import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from allanjax.record.io.grid import format_jitter
from allanjax.record.io.series import Series, joined, seconds_between
from allanjax.record.io.table import Format, Table, damage_reported, optional_package
from allanjax.record.validation import Source

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
                    f"{len(names)} topics of sensor_msgs/Imu; choose one with topic=: {described()}"
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
    stamps, arrivals = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)]
    values, frame = [np.zeros((0, 6))], ""
    messages = itertools.islice(bag.messages(connections=connections), count)
    for block in iter(lambda: list(itertools.islice(messages, _AT_ONCE)), []):
        raw = [message for _, _, message in block]
        frame = frame or raw[0][_TEXT:-_TAIL].partition(b"\0")[0].decode("utf-8", "replace")
        decoded = _decoded(raw, name, (len(values) - 1) * _AT_ONCE, source)
        stamps.append(decoded[0])
        values.append(decoded[1])
        arrivals.append(np.array([time for _, time, _ in block], np.int64))
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
            numbers = header.view(f"{order}u4").astype(np.int64)
            end = _TEXT + numbers[:, 2]
            fits = (length == end + _TAIL) | (length == 4 + (end + 3) // 8 * 8 + _TAIL)
            # A length of zero is the same in both byte orders.
            fits &= ~intact[same]
            rows = same[fits]
            stamps[rows] = numbers[fits, :2] @ [10**9, 1]
            samples = tail.view(f"{order}f8")[fits]
            values[rows, :3], values[rows, 3:] = samples[:, _GYRO], samples[:, _ACCEL]
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
            raise source.error(f"the topic {name} has no messages; choose another with topic=")
        if series.gyro is None and series.accel is None:
            raise source.error(f"the topic {name} has only zeros; record it while its sensor is running")
        notes += _notes(topic, series)
        found.append(series.in_order())
    if len(found) > 1 and not _are_halves(found):
        names = " and ".join(topic.name for topic in topics)
        raise source.error(f"{names} are not gyros and accelerometers; choose one with topic=")
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

"""ROS 1 and ROS 2 bags of sensor_msgs/Imu, written message by message by rosbags."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

KINDS = ("ros1", "sqlite3", "mcap")


@dataclass(frozen=True)
class Topic:
    """Messages of a topic: stamps of their headers [ns], samples [n, 6], times in the bag [ns], frames."""

    stamps: Sequence[int]
    samples: np.ndarray
    arrivals: Sequence[int] | None = None
    frames: Sequence[str] = ("imu_link",)


def write_bag(path: Path, kind: str, topics: Mapping[str, Topic], **how: bool) -> Path:
    """Write a bag at `path`, a file of ROS 1 or a folder of ROS 2.

    `other` adds a topic that is no Imu; `small` compresses, by LZ4 or Zstandard; `big`
    writes numbers with their largest byte first.
    """
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
    from rosbags.rosbag2 import Writer as Writer2
    from rosbags.typesys import Stores, get_typestore

    other, small, big = (how.get(key, False) for key in ("other", "small", "big"))
    store = get_typestore(Stores.ROS1_NOETIC if kind == "ros1" else Stores.ROS2_HUMBLE)
    cdr = partial(store.serialize_cdr, little_endian=not big)
    serialize = store.serialize_ros1 if kind == "ros1" else cdr
    types, messages, bag = store.types, [], Writer1(path) if kind == "ros1" else None
    if bag is None:
        bag = Writer2(path, version=9, storage_plugin=StoragePlugin[kind.upper()])
    if small and kind == "ros1":
        bag.set_compression(Writer1.CompressionFormat.LZ4)
    elif small:
        mode = CompressionMode.STORAGE if kind == "mcap" else CompressionMode.MESSAGE
        bag.set_compression(mode, CompressionFormat.ZSTD)
    vector, covariance = types["geometry_msgs/msg/Vector3"], np.arange(9.0)
    with bag:
        for name, topic in topics.items():
            connection = bag.add_connection(name, "sensor_msgs/msg/Imu", typestore=store)
            arrivals = topic.stamps if topic.arrivals is None else topic.arrivals
            samples = zip(topic.stamps, arrivals, topic.samples, strict=True)
            for k, (stamp, arrival, sample) in enumerate(samples):
                time = types["builtin_interfaces/msg/Time"](int(stamp) // 10**9, int(stamp) % 10**9)
                frame, number = topic.frames[k % len(topic.frames)], {"seq": k} if kind == "ros1" else {}
                header = types["std_msgs/msg/Header"](**number, stamp=time, frame_id=frame)
                turn = types["geometry_msgs/msg/Quaternion"](0.1, 0.2, 0.3, 0.4)
                halves = vector(*sample[:3]), covariance, vector(*sample[3:]), covariance
                message = types["sensor_msgs/msg/Imu"](header, turn, -covariance, *halves)
                messages.append((int(arrival), connection, serialize(message, "sensor_msgs/msg/Imu")))
        if other:
            connection = bag.add_connection("/words", "std_msgs/msg/String", typestore=store)
            words = types["std_msgs/msg/String"]("moving")
            messages.append((1, connection, serialize(words, "std_msgs/msg/String")))
        for arrival, connection, raw in sorted(messages, key=lambda message: message[0]):
            bag.write(connection, arrival, raw)
    return path

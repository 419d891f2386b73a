"""Bags of sensor_msgs/Imu, by rosbags; flight logs, PX4's ULog and ArduPilot's DataFlash, byte by byte."""

import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

KINDS = ("ros1", "sqlite3", "mcap")
# Of ULog, and the characters of DataFlash, by the types of NumPy.
_ULOG = {"f4": "float", "f8": "double", "u8": "uint64_t", "u4": "uint32_t", "i4": "int32_t"}
_ULOG |= {"u1": "uint8_t", "i2": "int16_t", "u2": "uint16_t"}
_BIN = {"f4": "f", "f8": "d", "u8": "Q", "u4": "I", "u2": "H", "u1": "B", "i2": "h", "[32]i2": "a"}


@dataclass(frozen=True)
class Topic:
    """Messages of a topic: stamps of their headers [ns], samples [n, 6], times in the bag [ns], frames."""

    stamps: Sequence[int]
    samples: np.ndarray
    arrivals: Sequence[int] | None = None
    frames: Sequence[str] = ("imu_link",)


def write_bag(path: Path, kind: str, topics: Mapping[str, Topic], **how: bool) -> Path:
    """Write a bag at `path`, a file of ROS 1 or a folder of ROS 2."""
    # `other` adds a topic that is no Imu; `small` compresses, by LZ4 or Zstandard; `big` writes numbers with
    # their largest byte first.
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


def structured(**columns: np.ndarray) -> np.ndarray:
    """Structured array of columns, packed."""
    dtype = [(name, column.dtype.str, column.shape[1:]) for name, column in columns.items()]
    return np.array([*zip(*columns.values(), strict=True)], dtype)


def _fields(rows: np.ndarray) -> list[tuple[str, str, str]]:
    """Name, type and shape of each field."""
    types = [(name, rows.dtype[name].base.str[1:], rows.dtype[name].shape) for name in rows.dtype.names]
    return [(name, kind, f"[{shape[0]}]" if shape else "") for name, kind, shape in types]


def _ulog_message(kind: str, payload: bytes) -> bytes:
    return struct.pack("<HB", len(payload), ord(kind)) + payload


def write_ulog(
    path: Path, messages: Mapping[tuple[str, int], np.ndarray], dropouts: Sequence[int] = ()
) -> Path:
    """Write a ULog file of structured arrays by message name and instance; dropouts [ms] come last."""
    parts = [b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 1), _ulog_message("B", bytes(40))]
    for name, rows in {name: rows for (name, _), rows in messages.items()}.items():
        fields = "".join(f"{_ULOG[kind]}{shape} {field};" for field, kind, shape in _fields(rows))
        parts.append(_ulog_message("F", f"{name}:{fields}".encode()))
    for number, (name, instance) in enumerate(messages):
        parts.append(_ulog_message("A", struct.pack("<BH", instance, number) + name.encode()))
    for number, rows in enumerate(messages.values()):
        parts += [_ulog_message("D", struct.pack("<H", number) + row.tobytes()) for row in rows]
    parts += [_ulog_message("O", struct.pack("<H", length)) for length in dropouts]
    path.write_bytes(b"".join(parts))
    return path


def write_dataflash(path: Path, messages: Mapping[str, np.ndarray], junk: bytes = b"") -> Path:
    """Write a DataFlash log of structured arrays by message name; rows of all take turns, junk is between."""

    def packet(number: int, payload: bytes) -> bytes:
        return b"\xa3\x95" + bytes([number]) + payload

    parts, longest = [], max(map(len, messages.values()))
    defined = [(128, 89, "FMT", "BBnNZ", "Type,Length,Name,Format,Columns")]
    for number, (name, rows) in enumerate(messages.items(), start=130):
        characters = "".join(_BIN[shape + kind] for _, kind, shape in _fields(rows))
        defined.append((number, rows.dtype.itemsize + 3, name, characters, ",".join(rows.dtype.names)))
    for number, size, *words in defined:
        parts.append(packet(128, struct.pack("<BB4s16s64s", number, size, *map(str.encode, words))))
    for k in range(longest):
        parts.append(junk if k == longest // 2 else b"")
        for number, rows in enumerate(messages.values(), start=130):
            parts.append(packet(number, rows[k].tobytes()) if k < len(rows) else b"")
    path.write_bytes(b"".join(parts))
    return path

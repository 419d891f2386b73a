"""Which files are read, what is said of half of one, and how long do a million samples take?

A small file of every format, 200 samples of six axes at 100 Hz, is written, read, and read again when it is
cut in half; so are real logs, where ALLANJAX_DATA has them. Then a file of many samples is read of each kind
of log: the samples must come back exactly.
"""

from __future__ import annotations

import resource
import struct
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

import allanjax as aj
from benchmarks.common.damaged_files import SIX, dataflash, sample_files, ulog
from benchmarks.common.study import UnavailableError, data, table

PACKAGES = ("pandas", "pyarrow", "h5py", "rosbags", "pyulog", "nptdms")
QUICK: dict[str, Any] = {"samples": 1000}
REAL = ("phidgets_imu.bag", "sparkfun_razor.bag", "px4_small.ulg", "ardupilot_test.bin", "euroc_slice.csv")
REAL += ("xio_sensor_data.csv",)
RATE = 400.0


def run(*, samples: int = 1_000_000) -> Iterator[str]:
    with tempfile.TemporaryDirectory() as name:
        folder, small = Path(name), []
        for kind, sample in sample_files(folder).items():
            whole, content = told(sample.path, **sample.options), sample.part.read_bytes()
            sample.part.write_bytes(content[: len(content) // 2])
            small.append([kind, whole, told(sample.path, **sample.options)])
        yield "## A small file of each, and half of it"
        yield table(["format", "whole", "cut in half"], small)
        try:
            real = [[log, told(data(log))] for log in REAL]
            yield "## Real logs\n\n" + table(["file", "what comes of it"], real)
        except UnavailableError as reason:
            yield f"No real logs: {reason}."
        yield f"## {samples:,} samples\n\nThe memory is the largest of the process so far."
        head = ["format", "size [MB]", "time [s]", "µs a sample", "memory [MB]"]
        yield table(head, many_samples(folder, samples))


def told(path: Path, **options: object) -> str:
    """What reading a file gives, in words."""
    try:
        recording = aj.read(path, **options)  # type: ignore[arg-type]
    except aj.AllanjaxError as error:
        return "refused: " + str(error).removeprefix(f"{path}: ").replace("|", "\\|")
    return f"{recording.n} samples of {len(recording.axes)} axes at {recording.rate:.6g} Hz"


def bag(kind: str) -> Callable[[Path, np.ndarray], Path]:
    """What writes a bag: one message is serialized, and its stamp and samples are replaced."""

    def write(folder: Path, values: np.ndarray) -> Path:
        from rosbags.rosbag1 import Writer as Writer1
        from rosbags.rosbag2 import StoragePlugin
        from rosbags.rosbag2 import Writer as Writer2
        from rosbags.typesys import Stores, get_typestore

        old = kind == "ros1"
        store = get_typestore(Stores.ROS1_NOETIC if old else Stores.ROS2_HUMBLE)
        path = folder / ("imu.bag" if old else kind)
        plugin = None if old else StoragePlugin[kind.upper()]
        writer = Writer1(path) if old else Writer2(path, version=9, storage_plugin=plugin)
        # The message's number or its encoding; the frame, in ROS 2 with a zero and filled up to eight bytes.
        head, frame = (b"\0\0\0\0", b"imu_link") if old else (b"\0\1\0\0", b"imu_link\0")
        length = len(frame)
        frame += b"" if old else bytes(-(12 + length) % 8)
        with writer as bag:
            connection = bag.add_connection("/imu", "sensor_msgs/msg/Imu", typestore=store)
            for k, row in enumerate(values):
                time_ns = 1_700_000_000 * 10**9 + round(k * 1e9 / RATE)
                stamp = struct.pack("<III", *divmod(time_ns, 10**9), length)
                gyro, accel = row[:3].tobytes(), row[3:].tobytes()
                message = (head, stamp, frame, bytes(104), gyro, bytes(72), accel, bytes(72))
                bag.write(connection, time_ns, b"".join(message))
        return path

    return write


def csv(folder: Path, values: np.ndarray) -> Path:
    path = folder / "imu.csv"
    aj.write(aj.Recording.from_array(values, RATE, names=SIX, gyro_unit="rad/s", accel_unit="m/s^2"), path)
    return path


MANY: dict[str, Callable[[Path, np.ndarray], Path]] = {
    "ROS 1 bag": bag("ros1"),
    "ROS 2 .db3": bag("sqlite3"),
    "ROS 2 .mcap": bag("mcap"),
    "ULog (gyro and accel)": lambda folder, values: ulog(folder / "imu.ulg", values, RATE, []),
    "DataFlash": lambda folder, values: dataflash(folder / "imu.bin", values, RATE),
    "CSV": csv,
}


def many_samples(folder: Path, count: int) -> list[list[str]]:
    values = np.random.default_rng(0).normal([0, 0, 0, 0, 0, 9.81], 0.01, (count, 6))
    values = values.astype("f4").astype(float)
    rows = []
    for name, write in MANY.items():
        path = write(folder, values)
        size = sum(x.stat().st_size for x in ([path] if path.is_file() else path.iterdir()))
        begun = time.perf_counter()
        recording = aj.read(path)
        seconds = time.perf_counter() - begun
        np.testing.assert_array_equal(recording[["gyro", "accel"]].values, values)
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        times = f"{seconds:.1f}", f"{seconds / count * 1e6:.1f}"
        rows.append([name, f"{size / 1e6:.0f}", *times, f"{peak:.0f}"])
    return rows

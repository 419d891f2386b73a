"""Which files are read, which are refused and why, and how long a million samples take.

    python benchmarks/studies/formats.py [--samples 1000000] [--data FOLDER] [--results PATH]

A small file of every format is written, read, and read again when it is cut in half; so are the real logs in
the folder that is given or named by ALLANJAX_DATA. Then a file of many samples is read of each kind of log.
"""

from __future__ import annotations

import argparse
import resource
import struct
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import paths
from flight_logs import structured, write_dataflash, write_ulog
from mutated_files import SIX, sample_files

import allanjax as aj
from benchmarks.common.machine import describe
from benchmarks.common.report import publish, table

REAL = ("phidgets_imu.bag", "sparkfun_razor.bag", "px4_small.ulg", "ardupilot_test.bin")
REAL += ("euroc_slice.csv", "xio_sensor_data.csv")
RATE = 400.0
PACKAGES = ("numpy", "pandas", "pyarrow", "scipy", "h5py", "rosbags", "pyulog", "nptdms", "allanjax")


def told(path: Path, **options: object) -> str:
    """What reading a file gives, in words."""
    try:
        recording = aj.read(path, **options)  # type: ignore[arg-type]
    except aj.AllanjaxError as error:
        return "refused: " + str(error).removeprefix(f"{path}: ").replace("|", "\\|")
    return f"{recording.n} samples of {len(recording.axes)} axes at {recording.rate:.6g} Hz"


def small_files(folder: Path) -> list[list[str]]:
    """Rows of the table of small files: format, what is read, what is said of half of it."""
    rows = []
    for name, sample in sample_files(folder).items():
        whole = told(sample.path, **sample.options)
        content = sample.part.read_bytes()
        sample.part.write_bytes(content[: len(content) // 2])
        rows.append([name, whole, told(sample.path, **sample.options)])
    return rows


def real_files(data: Path | None) -> list[list[str]]:
    """Rows of the table of real files, as far as they are there."""
    return [[name, told(data / name)] for name in REAL if data and (data / name).is_file()]


# --- Many samples ------------------------------------------------------------------------------------------


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
        writer = (
            Writer1(path) if old else Writer2(path, version=9, storage_plugin=StoragePlugin[kind.upper()])
        )
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


def ulog(folder: Path, values: np.ndarray) -> Path:
    times = (5_000_000 + np.arange(len(values)) * 2500).astype("u8")
    messages = {}
    for name, half in (("sensor_gyro", values[:, :3]), ("sensor_accel", values[:, 3:])):
        axes = dict(zip("xyz", half.astype("f4").T, strict=True))
        messages[name, 0] = structured(timestamp=times, timestamp_sample=times, **axes)
    return write_ulog(folder / "imu.ulg", messages)


def dataflash(folder: Path, values: np.ndarray) -> Path:
    names = (f"{sensor}{axis}" for sensor in ("Gyr", "Acc") for axis in "XYZ")
    times = (5_000_000 + np.arange(len(values)) * 2500).astype("u8")
    columns = dict(zip(names, values.astype("f4").T, strict=True))
    return write_dataflash(folder / "imu.bin", {"IMU": structured(TimeUS=times, **columns)})


def csv(folder: Path, values: np.ndarray) -> Path:
    path = folder / "imu.csv"
    aj.write(aj.Recording.from_array(values, RATE, names=SIX, gyro_unit="rad/s", accel_unit="m/s^2"), path)
    return path


MANY: dict[str, Callable[[Path, np.ndarray], Path]] = {
    "ROS 1 bag": bag("ros1"),
    "ROS 2 .db3": bag("sqlite3"),
    "ROS 2 .mcap": bag("mcap"),
    "ULog (gyro and accel)": ulog,
    "DataFlash": dataflash,
    "CSV": csv,
}


def many_samples(folder: Path, count: int) -> list[list[str]]:
    """Rows of the table of large files: format, size, time, time a sample, largest memory so far."""
    values = (
        np.random.default_rng(0).normal([0, 0, 0, 0, 0, 9.81], 0.01, (count, 6)).astype("f4").astype(float)
    )
    rows = []
    for name, write in MANY.items():
        path = write(folder, values)
        size = sum(x.stat().st_size for x in ([path] if path.is_file() else path.iterdir()))
        begin = time.perf_counter()
        recording = aj.read(path)
        seconds = time.perf_counter() - begin
        np.testing.assert_array_equal(recording[["gyro", "accel"]].values, values)
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        rows.append(
            [name, f"{size / 1e6:.0f}", f"{seconds:.1f}", f"{seconds / count * 1e6:.1f}", f"{peak:.0f}"]
        )
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--samples", type=int, default=10**6)
    parser.add_argument("--data", type=Path, default=paths.DATA, help="by default $ALLANJAX_DATA")
    parser.add_argument("--results", type=Path, default=paths.RESULTS / "formats.md")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        small = small_files(Path(folder))
        real = real_files(args.data)
        many = many_samples(Path(folder), args.samples)
    report = f"""# Formats that are read

Reproduce with `python benchmarks/studies/formats.py --samples {args.samples}`.

{describe(PACKAGES)}

## A small file of each, and half of it

200 samples of six axes at 100 Hz. Cut in half, a file is refused, or what is left of it is read.

{table(["format", "whole", "cut in half"], small)}

## Real logs

{table(["file", "what comes of it"], real) if real else "The folder of real recordings was not given."}

## {args.samples} samples

Written with the same samples, which are read exactly. The memory is the largest of the process so far.

{table(["format", "size [MB]", "time [s]", "µs a sample", "memory [MB]"], many)}
"""
    publish(report, args.results, quick=args.samples < 10**6)


if __name__ == "__main__":
    main()

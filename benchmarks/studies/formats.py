"""Which files are read, what is said of half of one, and how long do a million samples take?

A small file of every format, 200 samples of six axes at 100 Hz, is written, read, and read again when it is
cut in half; so are real logs, where ALLANJAX_DATA has them. Then a file of many samples is read of each kind
of log: the samples must come back exactly.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from logs import Topic, write_bag

import allanjax as aj
from benchmarks.common.damaged_files import SIX, dataflash, sample_files, ulog
from benchmarks.common.study import UnavailableError, data, process, table

PACKAGES = ("pandas", "pyarrow", "h5py", "rosbags", "pyulog", "nptdms")
QUICK: dict[str, Any] = {"samples": 1000}
REAL = ("phidgets_imu.bag", "sparkfun_razor.bag", "px4_small.ulg", "ardupilot_test.bin", "euroc_slice.csv")
REAL += ("xio_sensor_data.csv",)
RATE = 400.0
READ = """
import sys, time, numpy as np
from allanjax import read
begun = time.perf_counter()
recording = read(sys.argv[1])
print(time.perf_counter() - begun)
np.testing.assert_array_equal(recording[["gyro", "accel"]].values, np.load(sys.argv[2], mmap_mode="r"))
"""


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
        yield f"## {samples:,} samples\n\nEach is read by a process of its own."
        head = ["format", "size [MB]", "time [s]", "µs a sample", "memory [MB]"]
        yield table(head, many_samples(folder, samples))


def told(path: Path, **options: object) -> str:
    """What reading a file gives, in words."""
    try:
        recording = aj.read(path, **options)  # type: ignore[arg-type]
    except aj.AllanjaxError as error:
        return "refused: " + str(error).removeprefix(f"{path}: ").replace("|", "\\|")
    return f"{recording.n} samples of {len(recording.axes)} axes at {recording.rate:.6g} Hz"


def bag(path: Path, kind: str, values: np.ndarray) -> Path:
    stamps = 1_700_000_000 * 10**9 + np.round(np.arange(len(values)) * 1e9 / RATE).astype(np.int64)
    return write_bag(path, kind, {"/imu": Topic(stamps, values)})


def csv(folder: Path, values: np.ndarray) -> Path:
    path = folder / "imu.csv"
    aj.write(aj.Recording.from_array(values, RATE, names=SIX, gyro_unit="rad/s", accel_unit="m/s^2"), path)
    return path


MANY: dict[str, Callable[[Path, np.ndarray], Path]] = {
    "ROS 1 bag": lambda folder, values: bag(folder / "imu.bag", "ros1", values),
    "ROS 2 .db3": lambda folder, values: bag(folder / "db3", "sqlite3", values),
    "ROS 2 .mcap": lambda folder, values: bag(folder / "mcap", "mcap", values),
    "ULog (gyro and accel)": lambda folder, values: ulog(folder / "imu.ulg", values, RATE, []),
    "DataFlash": lambda folder, values: dataflash(folder / "imu.bin", values, RATE),
    "CSV": csv,
}


def many_samples(folder: Path, count: int) -> list[list[str]]:
    values = np.random.default_rng(0).normal([0, 0, 0, 0, 0, 9.81], 0.01, (count, 6))
    values = values.astype("f4").astype(float)
    np.save(folder / "values.npy", values)
    rows = []
    for name, write in MANY.items():
        path = write(folder, values)
        size = sum(x.stat().st_size for x in ([path] if path.is_file() else path.iterdir()))
        printed, _, _, peak = process(READ, path, folder / "values.npy")
        times = f"{float(printed):.1f}", f"{float(printed) / count * 1e6:.1f}"
        rows.append([name, f"{size / 1e6:.0f}", *times, f"{peak:.0f}"])
    return rows

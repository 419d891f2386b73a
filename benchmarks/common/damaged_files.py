"""A small file of every format that is read, what damages one, and what must come of reading it then."""

import gzip
import math
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import reduce
from pathlib import Path
from typing import Any

import numpy as np
from logs import Topic, structured, write_bag, write_dataflash, write_ulog

from allanjax.base.errors import AllanjaxError
from allanjax.record.io import read
from allanjax.record.recording import Recording

N, RATE = 200, 100.0
SIX = ("gyro_x", "gyro_y", "gyro_z", "accel_x", "accel_y", "accel_z")
UNITS = {"gyro_unit": "rad/s", "accel_unit": "m/s^2"}
LABELS = ("time [s]", *(f"{name} [{'rad/s' if name[0] == 'g' else 'm/s^2'}]" for name in SIX))
#: Seconds that reading a small file may take.
SLOWEST = 20.0


@dataclass(frozen=True)
class Sample:
    """A file of a format: its path, that of the part which is damaged, and what reading it takes."""

    path: Path
    part: Path
    options: dict[str, Any] = field(default_factory=dict)


# --- A file of every format --------------------------------------------------------------------------------


def _values() -> np.ndarray:
    return np.random.default_rng(0).normal([0, 0, 0, 0.1, 0.2, 9.81], 0.01, (N, 6)).astype("f4").astype(float)


def _file(write: Callable[[Path], object], name: str, **options: Any) -> Callable[[Path], Sample]:
    """What writes a file of this name into a folder; reading it takes these options."""

    def written(folder: Path) -> Sample:
        write(folder / name)
        return Sample(folder / name, folder / name, options)

    return written


def _text(path: Path) -> None:
    """Values with a mark between them that the name tells."""
    mark = "\t" if ".tsv" in path.name else ","
    rows = np.column_stack([np.arange(N) / RATE, _values()]).tolist()
    content = "\n".join([mark.join(LABELS), *(mark.join(map(repr, row)) for row in rows), ""]).encode()
    path.write_bytes(gzip.compress(content, mtime=0) if path.name.endswith(".gz") else content)


def _euroc(path: Path) -> None:
    sensors = ("w", "rad s^-1"), ("a", "m s^-2")
    names = [f"{sensor}_RS_S_{axis} [{unit}]" for sensor, unit in sensors for axis in "xyz"]
    times = (1_403_715_273_262_142_976 + 10_000_000 * np.arange(N)).tolist()
    rows = [map(str, [t, *row]) for t, row in zip(times, _values().tolist(), strict=True)]
    path.write_text("\n".join(map(",".join, [["#timestamp [ns]", *names], *rows])) + "\n")


def _vectornav(path: Path) -> None:
    lines = []
    for row in _values().tolist():
        body = ",".join(["VNMAR", *(f"{x:+.5f}" for x in [0.1, 0.2, 0.3, *row[3:], *row[:3]])])
        lines.append(f"${body}*{reduce(lambda a, b: a ^ b, body.encode()):02X}")
    path.write_text("\r\n".join(lines) + "\r\n")


def _structured_npy(path: Path) -> None:
    np.save(path, structured(**dict(zip(SIX, _values().T, strict=True))))


def _npz(path: Path) -> None:
    save = np.savez if path.stem == "savez" else np.savez_compressed
    save(path, gyro=_values()[:, :3], accel=_values()[:, 3:], rate=RATE)


def _mat(**how: Any) -> Callable[[Path], None]:
    from scipy.io import savemat

    halves = {"gyro": _values()[:, :3], "accel": _values()[:, 3:]}
    return lambda path: savemat(path, {**halves, "fs": RATE}, **how)


def _hdf5(**how: Any) -> Callable[[Path], None]:
    def write(path: Path) -> None:
        import h5py

        with h5py.File(path, "w") as file:
            file["fs"] = RATE
            file.create_dataset("imu/gyro", data=_values()[:, :3], **how)
            file.create_dataset("imu/accel", data=_values()[:, 3:], **how)

    return write


def _parquet(path: Path) -> None:
    import pyarrow
    import pyarrow.parquet

    columns = np.column_stack([np.arange(N) / RATE, _values()]).T
    pyarrow.parquet.write_table(pyarrow.table(dict(zip(LABELS, columns, strict=True))), path)


def _tdms(path: Path) -> None:
    from nptdms import ChannelObject, TdmsWriter

    units = 3 * ["rad/s"] + 3 * ["m/s^2"]
    channels = [
        ChannelObject("imu", name, x, {"wf_increment": 1 / RATE, "unit_string": unit})
        for name, x, unit in zip(SIX, _values().T, units, strict=True)
    ]
    with TdmsWriter(path) as writer:
        writer.write_segment(channels)


def _bag(kind: str, name: str, part: str = "", small: bool = False) -> Callable[[Path], Sample]:
    def write(folder: Path) -> Sample:
        stamps = 1_700_000_000 * 10**9 + np.round(np.arange(N) * 1e9 / RATE).astype(np.int64)
        path = write_bag(folder / name, kind, {"/imu": Topic(stamps, _values())}, other=True, small=small)
        if kind == "ros1":
            return Sample(path, path)
        file = next(file for file in path.iterdir() if file.name.endswith(part))
        return Sample(path if part.endswith("yaml") else file, file)

    return write


def ulog(path: Path, values: np.ndarray, rate: float, dropouts: list[int]) -> Path:
    """A log of PX4's with these samples, in single precision."""
    times, messages = stamps(len(values), rate), {}
    for name, half in (("sensor_gyro", values[:, :3]), ("sensor_accel", values[:, 3:])):
        axes = dict(zip("xyz", half.astype("f4").T, strict=True))
        messages[name, 0] = structured(timestamp=times, timestamp_sample=times, **axes)
    return write_ulog(path, messages, dropouts)


def dataflash(path: Path, values: np.ndarray, rate: float) -> Path:
    """A log of ArduPilot's with these samples, in single precision."""
    names = [f"{sensor}{axis}" for sensor in ("Gyr", "Acc") for axis in "XYZ"]
    columns = dict(zip(names, values.astype("f4").T, strict=True))
    return write_dataflash(path, {"IMU": structured(TimeUS=stamps(len(values), rate), **columns)})


def stamps(n: int, rate: float) -> np.ndarray:
    """In microseconds."""
    return (5_000_000 + np.arange(n) * round(1e6 / rate)).astype("u8")


def _fifo(path: Path) -> None:
    """Messages of eight samples each; every half has messages of its own."""
    fields = ("timestamp", "u8"), ("timestamp_sample", "u8"), ("dt", "f4"), ("scale", "f4"), ("samples", "u1")
    dtype = np.dtype([*fields, *((axis, "i2", 32) for axis in "xyz")])
    messages = {}
    for name, first in (("sensor_gyro_fifo", 0), ("sensor_accel_fifo", 3)):
        rows = np.zeros(N // 8, dtype)
        rows["timestamp_sample"] = rows["timestamp"] = 5_000_000 + np.arange(N // 8) * 80_000
        rows["dt"], rows["scale"], rows["samples"] = 10_000.0, 1e-4, 8
        for k, axis in enumerate("xyz"):
            rows[axis][:, :8] = np.round(_values()[:, first + k] * 1e3).reshape(-1, 8)
        messages[name, 0] = rows
    write_ulog(path, messages)


#: What writes a file of each format into a folder.
WRITERS: dict[str, Callable[[Path], Sample]] = {
    "CSV": _file(_text, "imu.csv"),
    "TSV": _file(_text, "imu.tsv"),
    "CSV, gzip": _file(_text, "imu.csv.gz"),
    "EuRoC": _file(_euroc, "euroc.csv"),
    "VectorNav": _file(_vectornav, "vectornav.txt", rate=RATE),
    ".npy": _file(lambda path: np.save(path, _values()), "imu.npy", rate=RATE, **UNITS),
    ".npy, structured": _file(_structured_npy, "structured.npy", rate=RATE, **UNITS),
    ".npz": _file(_npz, "savez.npz", **UNITS),
    ".npz, compressed": _file(_npz, "savez_compressed.npz", **UNITS),
    "MATLAB -v4": _file(_mat(format="4"), "imu4.mat", **UNITS),
    "MATLAB -v6": _file(_mat(format="5"), "imu5.mat", **UNITS),
    "MATLAB -v7": _file(_mat(do_compression=True), "imuTrue.mat", **UNITS),
    "HDF5": _file(_hdf5(), "imu0.h5", **UNITS),
    "HDF5, compressed": _file(_hdf5(compression="gzip", chunks=(64, 3)), "imu2.h5", **UNITS),
    "Parquet": _file(_parquet, "imu.parquet"),
    "TDMS": _file(_tdms, "imu.tdms"),
    "ROS 1 bag": _bag("ros1", "imu.bag"),
    "ROS 1 bag, LZ4": _bag("ros1", "lz4.bag", small=True),
    "ROS 2 .db3": _bag("sqlite3", "sqlite", ".db3"),
    "ROS 2 .mcap": _bag("mcap", "mcap", ".mcap"),
    "ROS 2 .mcap, Zstandard": _bag("mcap", "small", ".mcap", small=True),
    "ROS 2 metadata.yaml": _bag("sqlite3", "folder", "metadata.yaml"),
    "ULog": _file(lambda path: ulog(path, _values(), RATE, [20]), "imu.ulg"),
    "ULog, FIFO": _file(_fifo, "fifo.ulg"),
    "DataFlash": _file(lambda path: dataflash(path, _values(), RATE), "imu.bin"),
}


def sample_files(folder: Path) -> dict[str, Sample]:
    """A file of every format, in a folder of its own."""
    samples = {}
    for number, (name, write) in enumerate(WRITERS.items()):
        place = folder / str(number)
        place.mkdir()
        samples[name] = write(place)
    return samples


# --- Damage ------------------------------------------------------------------------------------------------


def damaged(content: bytes, rng: np.random.Generator) -> bytes:
    """Content with one kind of damage, at times two, each somewhere in it, often near an end."""
    for _ in range(1 + (rng.random() < 0.3)):
        content = _DAMAGES[rng.integers(len(_DAMAGES))](bytearray(content), rng)
    return bytes(content)


def _place(content: bytearray, rng: np.random.Generator) -> int:
    """A place; headers are at the beginning, and indices at the end."""
    size = len(content)
    if not size:
        return 0
    near = int(min(rng.exponential(200.0), size - 1))
    return (near, size - 1 - near, int(rng.integers(size)))[rng.integers(3)]


def _flipped(content: bytearray, rng: np.random.Generator) -> bytearray:
    for _ in range(rng.integers(1, 4)):
        if content:
            content[_place(content, rng)] ^= 1 << int(rng.integers(8))
    return content


def _overwritten(content: bytearray, rng: np.random.Generator) -> bytearray:
    first, size = _place(content, rng), int(rng.integers(1, 40))
    fill = rng.integers(3)
    new = bytes(size) if fill == 0 else b"\xff" * size if fill == 1 else rng.bytes(size)
    content[first : first + size] = new[: max(len(content) - first, 0)]
    return content


def _another_number(content: bytearray, rng: np.random.Generator) -> bytearray:
    """A number of four or eight bytes that is none usual, as of a length that is a lie."""
    first, size = _place(content, rng), (4, 8)[rng.integers(2)]
    numbers = (0, 1, 2**31 - 1, 2**32 - 1, 2**40, 2**62, 2**63 - 1, 2**64 - 1, 10**6, 10**9)
    number = numbers[rng.integers(len(numbers))] % 2 ** (8 * size)
    content[first : first + size] = number.to_bytes(size, ("little", "big")[rng.integers(2)])
    return content


def _another_text(content: bytearray, rng: np.random.Generator) -> bytearray:
    """Text that means something somewhere."""
    texts = *b"nan inf -1e307 1e400 [ ( \xff # , \0 ".split(b" "), b'"', b"\n", b"9" * 30
    first = _place(content, rng)
    content[first : first + int(rng.integers(4))] = texts[rng.integers(len(texts))]
    return content


def _cut(content: bytearray, rng: np.random.Generator) -> bytearray:
    return content[: _place(content, rng)]


def _without(content: bytearray, rng: np.random.Generator) -> bytearray:
    first = _place(content, rng)
    del content[first : first + int(rng.integers(1, 100))]
    return content


def _repeated(content: bytearray, rng: np.random.Generator) -> bytearray:
    first, other = _place(content, rng), _place(content, rng)
    content[other:other] = content[first : first + int(rng.integers(1, 300))]
    return content


_DAMAGES = (_flipped, _flipped, _overwritten, _another_number, _another_text, _cut, _without, _repeated)


# --- What comes of it --------------------------------------------------------------------------------------


def outcome(sample: Sample, whole: Recording) -> str:
    """What comes of reading a damaged file: `as before`, `otherwise`, `refused`, or what is wrong.

    `otherwise` are other samples than those of the undamaged file, which is what the damaged one says.
    """
    begin = time.perf_counter()
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("error", category=RuntimeWarning)
            recording = read(sample.path, **sample.options)
    except AllanjaxError as error:
        message = str(error)
        told = message.removeprefix(f"{sample.path}: ")
        if told == message or len(told) < 15:
            return f"WRONG: a message without name or reason: {message}"
        result = "refused"
    except BaseException as error:
        return f"WRONG: {type(error).__name__}: {error}"
    else:
        result = _judged(recording, whole)
    if time.perf_counter() - begin > SLOWEST:
        return f"WRONG: it took {time.perf_counter() - begin:.0f} s"
    return result


def _judged(recording: Recording, whole: Recording) -> str:
    """Whether what was read is a recording, and that of the undamaged file."""
    values = recording.values
    if values.shape != (recording.n, len(recording.axes)) or recording.n < 16 or not recording.axes:
        return f"WRONG: values of shape {values.shape}"
    if not np.isfinite(values).all() or not (math.isfinite(recording.rate) and recording.rate > 0):
        return f"WRONG: values that are not finite, or the rate {recording.rate}"
    if any(np.shape(x) != (recording.n,) for x in recording.auxiliary.values()):
        return "WRONG: auxiliary columns of another length"
    same = recording.names == whole.names and np.array_equal(values, whole.values)
    return "as before" if same and abs(recording.rate / whole.rate - 1) < 1e-3 else "otherwise"

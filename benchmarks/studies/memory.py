"""How much memory do Allan deviations take, and records that are longer than memory?

Each run is a process of its own, whose peak memory is the operating system's figure, interpreter, libraries
and record included; beside it that of a process that makes the record and takes its first 1,000 samples.
Streams are files of one axis (.npy, float64), read in chunks, both statistics (Allan pyramid and averaged
spectra) in one reading, terms selected and fitted; beside it one pass (`np.sum`) over the same chunks.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pyarrow
import pyarrow.csv
from pyarrow import parquet

from benchmarks.common.study import process, table

PACKAGES = ("allantools", "allan-variance")
QUICK: dict[str, Any] = {"samples": 100_000, "lengths": (100_000,), "rows": 200_000}
RATE, WHITE, WALK, PIECE = 1000.0, 1e-3, 1e-6, 10_000_000
START = "import sys, numpy as np\n{}\nx = np.random.default_rng(0).standard_normal(int(sys.argv[1]))\n"
OURS, TAUS = "import allanjax as aj", "2.0 ** np.arange((len(x) // 2).bit_length())"
RUNS = {
    "allanjax, exact": (OURS, "aj.allan_deviation(x, 1.0)"),
    "allanjax, pyramid": (OURS, "aj.allan_deviation(x, 1.0, estimator='pyramid')"),
    "allantools oadev": ("import allantools", f"allantools.oadev(x, data_type='freq', taus={TAUS})"),
    "allan-variance": (
        "from allan_variance import compute_avar",
        "compute_avar(x, 1.0, tau_max=len(x) / 2.0, n_clusters=(len(x) // 2).bit_length())",
    ),
    "np.sum": ("", "np.sum(x)"),
}
FEW = "whole, x = x, x[:1000]\n"
FORMATS, AXES, SHORT = ("Parquet", "NumPy", "HDF5", "CSV"), 5, 300_000
FORMAT = """
import resource, sys, time, allanjax as aj
aj.enable_compilation_cache(sys.argv[2])
begun = time.perf_counter()
found = aj.accumulate(aj.read_chunks(sys.argv[1], rate=1000.0))
print(time.perf_counter() - begun, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)
"""
COLUMNS = """
import sys
from pathlib import Path
from benchmarks.studies.memory import write_columns
print(write_columns(Path(sys.argv[1]), sys.argv[2], int(sys.argv[3])))
"""
STREAM = """
import resource, sys, time, numpy as np, allanjax as aj
aj.enable_compilation_cache(sys.argv[2])
def chunks():
    return aj.read_chunks(sys.argv[1], rate=1000.0, gyro_unit="rad/s", columns="gyro")
begun = time.perf_counter()
total = sum(float(np.sum(x)) for x in chunks())
summed = time.perf_counter()
accumulator = aj.accumulate(chunks())
read = time.perf_counter()
streaming = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
found = accumulator.fit()["gyro"].coefficients
print(summed - begun, read - summed, time.perf_counter() - read, streaming,
      *(x for k in ("angle_random_walk", "rate_random_walk") for x in (found[k].value, found[k].std)))
"""


def run(
    *,
    samples: int = 10_000_000,
    lengths: tuple[int, ...] = (100_000, 1_000_000, 10_000_000, 100_000_000, 1_000_000_000),
    rows: int = 20_000_000,
    folder: str = tempfile.gettempdir(),
) -> Iterator[str]:
    """Folder: for the files of the streams, 8 bytes a sample."""
    record, runs = 8e-6 * samples, []
    for name, (imports, work) in RUNS.items():
        whole, before = (process(START.format(imports) + part + work, samples)[3] for part in ("", FEW))
        runs.append([name, f"{before:.0f}", f"{whole:.0f}", f"{(whole - before) / record:.1f}"])
    yield f"## Allan deviations at octaves, {samples:,} samples ({record:.0f} MB)"
    yield table(["", "first 1,000 samples [MB]", "all [MB]", "more, in records"], runs)
    yield "## Streams"
    head = ["samples", "one pass (np.sum)", "Allan and spectrum", "passes", "selection and fit"]
    yield table([*head, "peak: streaming", "peak: fit", "N, K off [σ]"], streams(lengths, folder))
    yield f"## Files of {AXES} axes, {SHORT:,} and {rows:,} rows, one group in Parquet"
    head = [f"peak [MB]: {SHORT:,} rows", f"{rows:,} rows", "more", "file [MB]", "time"]
    yield table(["", *head], [of_format(kind, rows, folder) for kind in FORMATS])


def of_format(kind: str, rows: int, folder: str) -> list[str]:
    """Peak memory of a stream of a short and of a long file of one kind."""
    peaks = []
    with tempfile.TemporaryDirectory(dir=folder) as name:
        path, cache = Path(name) / "imu", Path(name) / "cache"
        for count in (SHORT, rows):
            # A process begins with the peak memory of the one that starts it: this one makes no columns.
            written = Path(process(COLUMNS, path, kind, count)[0].strip())
            # The second run finds compiled programs.
            for _ in range(2 if count == SHORT else 1):
                printed = process(FORMAT, written, cache)[0]
            elapsed, peak = map(float, printed.split())
            peaks.append(peak)
            size = written.stat().st_size / 1e6
    short, long = peaks
    return [kind, f"{short:.0f}", f"{long:.0f}", f"{long - short:.0f}", f"{size:.0f}", f"{elapsed:.0f} s"]


def write_columns(path: Path, kind: str, n: int) -> Path:
    """White noise in columns with names and units, in a file of this kind; its path."""
    rng = np.random.default_rng(0)
    names = [*(f"gyro_{x} [rad/s]" for x in "xyz"), *(f"accel_{x} [m/s^2]" for x in "xy")]
    columns = {name: rng.standard_normal(n) for name in names}
    if kind == "NumPy":
        np.save(path.with_suffix(".npy"), np.rec.fromarrays([*columns.values()], names=names))
        return path.with_suffix(".npy")
    if kind == "HDF5":
        with h5py.File(path.with_suffix(".h5"), "w") as file:
            for name, column in columns.items():
                file[name] = column
        return path.with_suffix(".h5")
    table = pyarrow.table(columns)
    if kind == "Parquet":
        parquet.write_table(table, path.with_suffix(".parquet"), row_group_size=n)
        return path.with_suffix(".parquet")
    pyarrow.csv.write_csv(table, path.with_suffix(".csv"))
    return path.with_suffix(".csv")


def streams(lengths: tuple[int, ...], folder: str) -> list[list[str]]:
    truth, rows = (WHITE / np.sqrt(RATE), WALK * np.sqrt(RATE)), []
    with tempfile.TemporaryDirectory(dir=folder) as name:
        path, cache = Path(name) / "long.npy", Path(name) / "cache"
        for n in lengths:
            write(path, n)
            printed, _, _, peak = process(STREAM, path, cache)
            summed, read, fitted, streaming, *found = map(float, printed.split())
            path.unlink()
            off = [f"{(found[2 * k] - truth[k]) / found[2 * k + 1]:+.1f}" for k in (0, 1)]
            times = f"{summed:.2f} s", f"{read:.2f} s", f"{read / summed:.1f}", f"{fitted:.1f} s"
            rows.append([f"{n:,}", *times, f"{streaming:.0f} MB", f"{peak:.0f} MB", ", ".join(off)])
    return rows


def write(path: Path, n: int) -> None:
    """White noise and a random walk, written piece by piece."""
    rng, level = np.random.default_rng(0), 0.0
    with path.open("wb") as stream:
        header = {"descr": "<f8", "fortran_order": False, "shape": (n, 1)}
        np.lib.format.write_array_header_1_0(stream, header)
        for first in range(0, n, PIECE):
            count = min(PIECE, n - first)
            walk = level + WALK * np.cumsum(rng.standard_normal(count))
            level = walk[-1]
            (walk + WHITE * rng.standard_normal(count)).tofile(stream)

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

import numpy as np

from benchmarks.common.study import process, table

PACKAGES = ("allantools", "allan-variance")
QUICK: dict[str, Any] = {"samples": 100_000, "lengths": (100_000,)}
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
    folder: str = tempfile.gettempdir(),
) -> Iterator[str]:
    """Folder: for the files of the streams, 8 bytes a sample."""
    record, rows = 8e-6 * samples, []
    for name, (imports, work) in RUNS.items():
        whole, before = (process(START.format(imports) + part + work, samples)[3] for part in ("", FEW))
        rows.append([name, f"{before:.0f}", f"{whole:.0f}", f"{(whole - before) / record:.1f}"])
    yield f"## Allan deviations at octaves, {samples:,} samples ({record:.0f} MB)"
    yield table(["", "first 1,000 samples [MB]", "all [MB]", "more, in records"], rows)
    yield "## Streams"
    head = ["samples", "one pass (np.sum)", "Allan and spectrum", "passes", "selection and fit"]
    yield table([*head, "peak: streaming", "peak: fit", "N, K off [σ]"], streams(lengths, folder))


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

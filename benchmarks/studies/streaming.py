"""Records longer than memory: time and peak memory from file to coefficients, 10⁵ to 10⁹ samples.

    python benchmarks/studies/streaming.py [--lengths 100000,…,1000000000] [--folder DIR] [--results PATH]

Each length is a file of one axis (.npy, float64) and a process of its own, which reads it in chunks, selects
the terms and fits them. Its peak memory is the operating system's figure for the process, interpreter and
libraries included. Beside it the same process's time for one pass (`np.sum`) over the same chunks. Compiled
programs are kept from length to length, as between runs of the command; the first length compiles them.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import paths

from benchmarks.common.machine import describe
from benchmarks.common.report import publish, table

LENGTHS = "100000,1000000,10000000,100000000,1000000000"
RATE = 1000.0
WHITE, WALK = 1e-3, 1e-6
_WRITTEN = 10_000_000

PROGRAM = """
import resource, sys, time
import numpy as np
import allanjax as aj
aj.enable_compilation_cache(sys.argv[2])
def chunks():
    return aj.read_chunks(sys.argv[1], rate=1000.0, gyro_unit="rad/s", columns="gyro")
def peak():
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
loaded, begun = peak(), time.perf_counter()
total = sum(float(np.sum(x)) for x in chunks())
summed = time.perf_counter()
accumulator = aj.accumulate(chunks())
read = time.perf_counter()
streaming = peak()
fit = accumulator.fit()
found = fit["gyro"].coefficients
print(summed - begun, read - summed, time.perf_counter() - read, loaded, streaming, peak(),
      *(x for k in ("angle_random_walk", "rate_random_walk") for x in (found[k].value, found[k].std)))
"""


def write(path: Path, n: int) -> None:
    """White noise and a random walk, written piece by piece."""
    rng, level = np.random.default_rng(0), 0.0
    with path.open("wb") as stream:
        np.lib.format.write_array_header_1_0(
            stream, {"descr": "<f8", "fortran_order": False, "shape": (n, 1)}
        )
        for first in range(0, n, _WRITTEN):
            count = min(_WRITTEN, n - first)
            walk = level + WALK * np.cumsum(rng.standard_normal(count))
            level = walk[-1]
            (walk + WHITE * rng.standard_normal(count)).tofile(stream)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--lengths", default=LENGTHS)
    parser.add_argument("--folder", type=Path, help="for the files, 8 bytes a sample")
    parser.add_argument("--results", type=Path, default=paths.RESULTS / "streaming.md")
    options = parser.parse_args()
    truth = WHITE / np.sqrt(RATE), WALK * np.sqrt(RATE)
    rows = []
    with tempfile.TemporaryDirectory(dir=options.folder) as name:
        path, cache = Path(name) / "long.npy", Path(name) / "cache"
        for n in (int(text) for text in options.lengths.split(",")):
            write(path, n)
            command = [sys.executable, "-c", PROGRAM, str(path), str(cache)]
            run = subprocess.run(command, check=True, capture_output=True, text=True)
            summed, read, fitted, loaded, streaming, peak, *found = map(float, run.stdout.split())
            path.unlink()
            off = [f"{(found[2 * k] - truth[k]) / found[2 * k + 1]:+.1f}" for k in (0, 1)]
            rows.append(
                [
                    f"{n:.0e}".replace("e+0", "e"),
                    f"{summed:.2f} s",
                    f"{read:.2f} s",
                    f"{read / summed:.1f}",
                    f"{1e9 * read / n:.0f} ns",
                    f"{fitted:.1f} s",
                    f"{loaded:.0f} MB",
                    f"{streaming:.0f} MB",
                    f"{peak:.0f} MB",
                    ", ".join(off),
                ]
            )
            print(*rows[-1], flush=True)
    head = [
        "samples",
        "one pass (np.sum)",
        "Allan and spectrum",
        "passes",
        "a sample",
        "selection and fit",
        "peak: imports",
        "peak: streaming",
        "peak: fit",
        "N, K off [σ]",
    ]
    text = f"# Streaming: from file to coefficients\n\n{describe()}\n\n"
    text += "One axis, .npy on disk, both statistics (Allan pyramid and averaged spectra) in one reading.\n\n"
    publish(f"{text}{table(head, rows)}\n", options.results)


if __name__ == "__main__":
    main()

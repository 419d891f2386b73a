"""Does a fleet use its workers?

Recordings of six axes at 100 Hz, Parquet, terms chosen by the fit; every run is a process with a local
cluster of its own, started and closed within the time. Which units are outlying is asked by `outlying`.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from benchmarks.common.study import UnavailableError, table

PACKAGES = ("pandas", "dask", "distributed")
QUICK: dict[str, Any] = {"recordings": 0}
AXES = [f"{sensor}_{axis}" for sensor in ("gyro", "accel") for axis in "xyz"]


def run(*, recordings: int = 200, samples: int = 60_000) -> Iterator[str]:
    if not recordings:
        raise UnavailableError("no recordings")
    yield f"## Workers: {recordings} recordings of six axes × {samples:,} samples"
    with tempfile.TemporaryDirectory() as folder:
        os.environ["ALLANJAX_CACHE"] = str(Path(folder) / "cache")
        yield from workers(Path(folder), recordings, samples)


def workers(folder: Path, recordings: int, samples: int) -> Iterator[str]:
    (folder / "logs").mkdir()
    for k in range(recordings):
        noise = np.random.default_rng(k).standard_normal((2, samples, 6))
        x = np.repeat([0.35, 4e-3], 3) * (noise[0] + 5e-3 * np.cumsum(noise[1], axis=0))
        pd.DataFrame(x, columns=AXES).to_parquet(folder / "logs" / f"unit_{k:03d}.parquet")
    # The first run compiles.
    runs = (("unit_00[01].parquet", 2), ("*.parquet", 1), ("*.parquet", 2))
    taken = []
    for k, (pattern, count) in enumerate(runs):
        options = {"--out": folder / str(k), "--workers": count, "--rate": 100}
        options |= {"--gyro-unit": "deg/s", "--accel-unit": "g"}
        program = [str(Path(sys.executable).with_name("allanjax")), "fleet", str(folder / "logs" / pattern)]
        begun = time.perf_counter()
        command = program + [str(part) for option in options.items() for part in option]
        subprocess.run(command, check=True, capture_output=True)
        taken.append(time.perf_counter() - begun)
    names = ["two recordings, nothing compiled yet", "1 worker", "2 workers"]
    yield table(["run", "seconds"], [[n, f"{s:.1f}"] for n, s in zip(names, taken, strict=True)])

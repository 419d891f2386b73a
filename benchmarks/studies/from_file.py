"""How long does it take from a file to a result: the first run on a machine, later ones, another length?

`allanjax characterize` and `aj.critique` of six axes, each run a process of its own, from the file on disk;
the first run finds no compiled program, the others those of the runs before. "Another length" is nine tenths
of the file. The recordings: noise alone, noise with lines, a louder stretch, outliers and a step, and a real
unit where ALLANJAX_DATA has it. The peers do what they do: allantools' `oadev` at the same cluster times and
allan-variance's fit of five terms, values only.
"""

from __future__ import annotations

import contextlib
import itertools
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from benchmarks.common.study import UnavailableError, data, process, table

PACKAGES = ("allantools", "allan-variance")
QUICK: dict[str, Any] = {"samples": (16_384,), "critiques": False, "kinds": 1}
RATE, AXES = 100.0, [f"{sensor}_{axis}" for sensor in ("gyro", "accel") for axis in "xyz"]
CHARACTERIZE = """
import sys
from allanjax.cli.app import main
file, out = sys.argv[1:]
options = ["--rate", "100", "--gyro-unit", "deg/s", "--accel-unit", "g", "--out", out]
sys.argv[1:] = ["characterize", file, *options]
sys.exit(main())
"""
CRITICIZE = """
import sys, allanjax as aj
aj.enable_compilation_cache()
print(len(aj.critique(aj.read(sys.argv[1], rate=100, gyro_unit="deg/s", accel_unit="g")).findings))
"""
PEERS = """
import sys, allan_variance, allantools, numpy as np, pandas as pd
table = pd.read_parquet(sys.argv[1])
sizes = np.unique(np.round(2.0 ** np.arange(0, np.log2(len(table) // 2), 0.25)).astype(int))
for name in table.columns[:6]:
    rates = table[name].to_numpy()
    tau, deviation, _, _ = allantools.oadev(rates, rate=100.0, data_type="freq", taus=sizes / 100.0)
    allan_variance.estimate_parameters(tau, deviation**2)
"""


def run(
    *, samples: tuple[int, ...] = (1_000_000, 60_000), critiques: bool = True, kinds: int = 3
) -> Iterator[str]:
    rows = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for called, values in itertools.islice(recordings(), kinds):
            for n in samples:
                files = folder / "whole.parquet", folder / "shorter.parquet"
                for file, count in zip(files, (n, 9 * n // 10), strict=True):
                    pd.DataFrame(values[:count], columns=AXES).to_parquet(file)
                works = {"characterize": CHARACTERIZE} | ({"critique": CRITICIZE} if critiques else {})
                for work, code in works.items():
                    rows.append([f"{called}, {n:,}", work, *measured(code, files, folder)])
                _, seconds, used, peak = process(PEERS, files[0])
                numbers = f"{seconds:.1f}", "", f"{used:.1f}", f"{peak / 1024.0:.1f}"
                rows.append([f"{called}, {n:,}", "allantools, allan-variance", "", *numbers])
    head = ["recording", "", "first run [s]", "later [s]", "another length [s]", "later, processor [s]"]
    yield table([*head, "peak memory [GB]"], rows)


def recordings() -> Iterator[tuple[str, np.ndarray]]:
    """Names and samples, gyros in deg/s and accelerometers in g."""
    rng, n = np.random.default_rng(3), 1_000_000
    scale, t = np.repeat([0.35, 4e-3], 3), np.arange(n) / RATE
    x = scale * (rng.standard_normal((n, 6)) + 3e-4 * np.cumsum(rng.standard_normal((n, 6)), axis=0))
    yield "noise alone", x
    x[:, 0] += 0.02 * scale[0] * np.sin(2.0 * np.pi * 7.3 * t)
    x[:, 1] += 0.3 * scale[1] * (t > 0.4 * t[-1])
    x[n // 10 : n // 6, 3] *= 1.1
    x[:, 4] += 0.03 * scale[4] * np.sin(2.0 * np.pi * 20.0 * t + 1.0)
    x[rng.integers(0, n, 15), 5] += 30.0 * scale[5] * rng.standard_normal(15)
    yield "five effects", x
    with contextlib.suppress(UnavailableError):
        yield "ADIS16405", pd.read_parquet(data("adis16405_unit1.parquet"))[AXES].to_numpy()


def measured(code: str, files: tuple[Path, Path], folder: Path) -> list[str]:
    """Of a first run, the better of two later ones, one of another length; processors, memory."""
    with tempfile.TemporaryDirectory(dir=folder) as cache:
        apart = {
            "ALLANJAX_CACHE": cache,
            "JAX_COMPILATION_CACHE_DIR": cache,
            "TERM": os.environ.get("TERM", ""),
        }
        runs = [
            process(code, file, folder / "out", **apart)[1:]
            for file in (files[0], files[0], files[0], files[1])
        ]
    first, later, other = runs[0], min(runs[1:3]), runs[3]
    return [*(f"{s:.1f}" for s in (first[0], later[0], other[0], later[1])), f"{later[2] / 1024.0:.1f}"]

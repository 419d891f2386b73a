"""How long does it take from the file of a real unit to its numbers, and to a posterior, beside others?

Six axes × 10⁶ samples of an ADIS16405 at 100 Hz, Parquet. Commands are processes of their own, from their
start to their end, with the package's modules compiled to bytecode; their memory is the operating system's
peak, interpreter and libraries included; their programs are those that the cache of compiled programs has
more than before. Calls are timed within a process that has imported the package and read or simulated the
samples, in the order of the table; their programs are those compiled or loaded, and the memory of the last
one is that of the process.

The peers compute what they do: allantools the overlapping Allan deviation at octaves, allan-variance from
these the values of five terms. They tell neither uncertainty nor which terms there are.
"""

from __future__ import annotations

import compileall
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pandas as pd

from benchmarks.common.study import ROOT, data, process, table

PACKAGES = ("allantools", "allan-variance", "pandas")
QUICK: dict[str, Any] = {"samples": 16_384, "critiques": False}
SHORTER, SIMULATED = 0.6, 60_000
PEERS = """
import sys, allan_variance, allantools, pandas as pd
samples = pd.read_parquet(sys.argv[1])
for name in samples.columns[:6]:
    rates = samples[name].to_numpy()
    tau, deviation, _, _ = allantools.oadev(rates, rate=100.0, data_type="freq", taus="octave")
    allan_variance.estimate_parameters(tau, deviation**2)
"""
CHARACTERIZE = """
import sys
from allanjax.cli.app import main
file, out, *more = sys.argv[1:]
options = ["--rate", "100", "--gyro-unit", "deg/s", "--accel-unit", "g", "--out", out]
sys.argv[1:] = ["characterize", file, *options, *more]
sys.exit(main())
"""
CRITICIZE = """
import sys, allanjax as aj
aj.enable_compilation_cache()
aj.critique(aj.read(sys.argv[1], rate=100, gyro_unit="deg/s", accel_unit="g"))
"""
CALLS = """
import sys, time, numpy as np, allanjax as aj, benchmarks.common
from compilations import compilations
aj.enable_compilation_cache()
def timed(call):
    begun, used = time.perf_counter(), time.process_time()
    with compilations() as programs:
        found = call()
    print(time.perf_counter() - begun, time.process_time() - used, len(programs))
    return found
"""
FITS = """
recording = aj.read(sys.argv[1], rate=100, gyro_unit="deg/s", accel_unit="g")
timed(lambda: aj.fit(recording))
timed(lambda: aj.fit(recording.between(0.0, float(sys.argv[2]) * recording.duration)))
"""
ALONE = """
steps = np.random.default_rng(38).standard_normal((2, int(sys.argv[1])))
samples = 1e-3 * steps[0] + 3e-6 * np.cumsum(steps[1])
recording = aj.Recording.from_array(samples[:, None], 100.0, gyro_unit="rad/s", names=["gyro_x"])
fit = timed(lambda: aj.fit(recording, as_is=True))
timed(lambda: aj.sample(fit, progress=False))
"""
#: Most seconds and memory [MB] that are allowed, and what is aimed at.
TARGETS = {
    "`characterize`, fresh cache": ("20 s", "10 s"),
    "`characterize`, cached": ("7 s, 1,200 MB", "4 s, 800 MB"),
    "`characterize --plain`, cached": ("5 s", "3 s"),
    "`aj.fit` again, another length": ("3 s, 0 programs", "2 s"),
    f"`aj.fit` of {SIMULATED:,} × 1, fresh cache": ("5 s", "3 s"),
    "its posterior, fresh cache": ("5 s", "2 s"),
}
HEAD = ("", "seconds", "processor s", "MB", "programs", "at most", "aim")


def run(*, samples: int = 1_000_000, critiques: bool = True) -> Iterator[str]:
    """Samples: the first so many of the recording."""
    # As pip leaves a package.
    compileall.compile_dir(str(ROOT / "allanjax"), quiet=2)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        file = folder / "unit.parquet"
        pd.read_parquet(data("adis16405_unit1.parquet")).iloc[:samples].to_parquet(file)
        rows = [["allantools, allan-variance", *command(PEERS, folder / "peers", file)]]
        cache, out = folder / "cache", folder / "out"
        for how in ("fresh cache", "cached"):
            rows.append([f"`characterize`, {how}", *command(CHARACTERIZE, cache, file, out)])
        plain = CHARACTERIZE, cache, file, out, "--plain"
        command(*plain)
        rows.append(["`characterize --plain`, cached", *command(*plain)])
        names = "`aj.fit`, cached", "`aj.fit` again, another length"
        rows += calls(names, FITS, cache, file, SHORTER)
        names = f"`aj.fit` of {SIMULATED:,} × 1, fresh cache", "its posterior, fresh cache"
        rows += calls(names, ALONE, folder / "another", min(SIMULATED, samples))
        for how in ("characterized before", "cached") if critiques else ():
            rows.append([f"`aj.critique`, {how}", *command(CRITICIZE, cache, file)])
    yield table(HEAD, [[*row, *TARGETS.get(row[0], ("", ""))] for row in rows])


def around(cache: Path) -> dict[str, str]:
    """Environment of a process that keeps its compiled programs in a folder."""
    cache.mkdir(exist_ok=True)
    return dict.fromkeys(("ALLANJAX_CACHE", "JAX_COMPILATION_CACHE_DIR"), str(cache))


def command(code: str, cache: Path, *arguments: object) -> list[str]:
    """Cells of a process: seconds, processor seconds, memory and new programs."""
    before = programs(cache)
    _, seconds, used, peak = process(code, *arguments, **around(cache))
    return [f"{seconds:.1f}", f"{used:.1f}", f"{peak:,.0f}", str(programs(cache) - before)]


def programs(cache: Path) -> int:
    """Number of programs in a cache."""
    return len(list(cache.rglob("*-cache")))


def calls(names: tuple[str, ...], code: str, cache: Path, *arguments: object) -> list[list[str]]:
    """Rows of the calls that a process has timed; the memory of the process stands in the last."""
    printed, _, _, peak = process(CALLS + code, *arguments, **around(cache))
    rows = []
    for name, line in zip(names, printed.splitlines(), strict=True):
        seconds, used, count = line.split()
        rows.append([name, f"{float(seconds):.1f}", f"{float(used):.1f}", "", count])
    rows[-1][3] = f"{peak:,.0f}"
    return rows

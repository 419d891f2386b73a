"""From file to coefficients: the first run on a machine, later ones, and one of another length.

    python benchmarks/studies/characterize.py [FILE] [--before CHECKOUT] [--results PATH]

Six axes × 10⁶ samples and six × 60,000 (the first ones of these), through the command line, each run a
process of its own. The first run finds no compiled program, the others those of the runs before them. Without
FILE (Parquet, gyros in deg/s, accelerometers in g, 100 Hz) a record is simulated. Beside it, in the same run,
another CHECKOUT of allanjax, and the peers doing what they do: allantools' `oadev` at the same cluster times
and allan-variance's five-term fit, from the file as read by pandas.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
import paths

from benchmarks.common.machine import describe
from benchmarks.common.report import publish, table

PEERS = """
import sys, time
import allan_variance, allantools, numpy as np, pandas as pd
table = pd.read_parquet(sys.argv[1])
sizes = np.unique(np.round(2.0 ** np.arange(0, np.log2(len(table) // 2), 0.25)).astype(int))
for name in table.columns[:6]:
    rates = table[name].to_numpy()
    tau, deviation, _, _ = allantools.oadev(rates, rate=100.0, data_type="freq", taus=sizes / 100.0)
    allan_variance.estimate_parameters(tau, deviation**2)
"""


def simulated(folder: Path) -> Path:
    import pandas as pd

    rng = np.random.default_rng(1)
    white = rng.standard_normal((1_000_000, 6)) * [0.35, 0.35, 0.35, 4e-3, 4e-3, 4e-3]
    walk = np.cumsum(rng.standard_normal((1_000_000, 6)), axis=0) * [1e-4, 1e-4, 1e-4, 1e-6, 1e-6, 1e-6]
    names = [f"{sensor}_{axis}" for sensor in ("gyro", "accel") for axis in "xyz"]
    path = folder / "simulated.parquet"
    pd.DataFrame(white + walk, columns=names).to_parquet(path)
    return path


class Taken(NamedTuple):
    """Of a process: wall-clock and processor seconds, and its peak memory [GB]."""

    seconds: float
    processor: float
    memory: float


def taken(command: list[str], **environment: str) -> Taken:
    start = time.perf_counter()
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, env={**os.environ, **environment})
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise subprocess.CalledProcessError(process.returncode, command)
    processor = usage.ru_utime + usage.ru_stime
    return Taken(time.perf_counter() - start, processor, usage.ru_maxrss / 2**20)


def runs(path: Path, folder: Path, rows: int, checkout: Path) -> list[str]:
    """Seconds of a first run, the least of two later ones, and of one of another length, nine tenths.

    With the processor seconds and the peak memory of the later one.
    """
    import pandas as pd

    table_of = pd.read_parquet(path)
    files = [folder / f"{rows}.parquet", folder / f"{9 * rows // 10}.parquet"]
    for file, count in zip(files, (rows, 9 * rows // 10), strict=True):
        table_of.iloc[:count].to_parquet(file)
    start = "import sys; from allanjax.cli.app import main; sys.exit(main())"
    options = ["--rate", "100", "--gyro-unit", "deg/s", "--accel-unit", "g", "--out", str(folder / "out")]
    cache = tempfile.mkdtemp(dir=folder)
    apart = {"ALLANJAX_CACHE": cache, "JAX_COMPILATION_CACHE_DIR": cache, "PYTHONPATH": str(checkout)}

    def run(file: Path) -> Taken:
        return taken([sys.executable, "-c", start, "characterize", str(file), *options], **apart)

    first, later, other = run(files[0]), min(run(files[0]) for _ in range(2)), run(files[1])
    seconds = (first.seconds, later.seconds, other.seconds, later.processor)
    return [*(f"{x:.1f}" for x in seconds), f"{later.memory:.1f}"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("file", nargs="?", type=Path)
    parser.add_argument("--before", type=Path, help="another checkout of allanjax, to compare with")
    parser.add_argument("--results", type=Path, default=paths.RESULTS / "characterize.md")
    arguments = parser.parse_args()
    checkouts = {"": Path(__file__).parents[2]}
    if arguments.before:
        checkouts["before: "] = arguments.before
    with tempfile.TemporaryDirectory() as folder_name:
        folder = Path(folder_name)
        path = arguments.file or simulated(folder)
        rows = []
        for count in (1_000_000, 60_000):
            for name, checkout in checkouts.items():
                rows.append([f"{name}six axes × {count:,}", *runs(path, folder, count, checkout)])
        peers = [sys.executable, "-c", PEERS, str(path)]
        own = taken(peers)
        numbers = [f"{own.seconds:.1f}", "", f"{own.processor:.1f}", f"{own.memory:.1f}"]
        rows.append(["allantools and allan-variance, six axes × 1,000,000", "", *numbers])
    head = ["recording", "first run on a machine", "later", "another length"]
    head += ["later, processor s", "later, peak memory, GB"]
    lines = [
        "# From file to coefficients",
        "",
        f"`allanjax characterize` of {path.name} and of its first samples, wall-clock seconds of processes.",
        "It writes a table with intervals, JSON, CSV and two pictures; the peers end with the numbers of",
        "`oadev` and a fit of five terms.",
        "",
        table(head, rows),
        "",
        "## Machine",
        "",
        describe(),
        "",
    ]
    publish("\n".join(lines), arguments.results)


if __name__ == "__main__":
    main()

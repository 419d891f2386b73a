"""From file to coefficients, cold and warm: six axes × 10⁶ samples through the command line.

    python benchmarks/studies/characterize.py [FILE] [--results PATH]

Each run is a process of its own. Cold: no compiled program is reused. Warm: the compilation cache of the run
before. Without FILE (Parquet, gyros in deg/s, accelerometers in g, 100 Hz) a record is simulated. Beside it,
in the same run, the peers doing what they do: allantools' `oadev` at the same cluster times and
allan-variance's five-term fit, from the file as read by pandas.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import paths
from common.machine import describe
from common.report import publish, table

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


def seconds(command: list[str], **environment: str) -> float:
    start = time.perf_counter()
    subprocess.run(command, check=True, capture_output=True, env={**os.environ, **environment})
    return time.perf_counter() - start


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("file", nargs="?", type=Path)
    parser.add_argument("--results", type=Path, default=paths.RESULTS / "characterize.md")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder_name:
        folder = Path(folder_name)
        path = arguments.file or simulated(folder)
        ours = [str(Path(sys.executable).with_name("allanjax")), "characterize", str(path), "--rate", "100"]
        ours += ["--gyro-unit", "deg/s", "--accel-unit", "g", "--out", str(folder / "out")]
        peers = [sys.executable, "-c", PEERS, str(path)]
        cache = str(folder / "cache")
        rows = [
            ("allanjax characterize, cold", seconds(ours, ALLANJAX_CACHE=cache)),
            ("allanjax characterize, warm", min(seconds(ours, ALLANJAX_CACHE=cache) for _ in range(3))),
            ("allantools oadev + allan-variance: values only", min(seconds(peers) for _ in range(3))),
        ]
    lines = [
        "# From file to coefficients",
        "",
        f"Six axes × 10⁶ samples ({path.name}), each run a process of its own, wall-clock time. allanjax",
        "writes a table with intervals, JSON, CSV and a picture; the peers' processes end with the numbers.",
        "",
        table(["what", "seconds"], [[what, f"{value:.1f}"] for what, value in rows]),
        "",
        "## Machine",
        "",
        describe(),
        "",
    ]
    publish("\n".join(lines), arguments.results)


if __name__ == "__main__":
    main()

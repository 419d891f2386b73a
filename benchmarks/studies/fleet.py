"""A fleet of recordings on one and on two workers, with a killed worker, a corrupt file and a second run.

    python benchmarks/studies/fleet.py [--recordings 200] [--samples 60000] [--results PATH]

Six axes at 100 Hz a recording, Parquet, terms chosen by the fit. Every run is a process of its own with a
local cluster of its own, started and closed within the time given. Programs are compiled before the first
run, by a fleet of two recordings, whose time says what that costs.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import pandas as pd
import paths

from benchmarks.common.machine import PACKAGES, describe
from benchmarks.common.report import publish, table

AXES = [f"{sensor}_{axis}" for sensor in ("gyro", "accel") for axis in "xyz"]
# White noise and random walk a sample, deg/s and g; units scatter by 10 %, and one has five times the walk.
WHITE = np.repeat([0.35, 4e-3], 3)
WALK = np.repeat([2e-3, 2e-5], 3)
ODD = 5.0
POLL_SECONDS = 0.05


def simulate(folder: Path, recordings: int, samples: int) -> None:
    folder.mkdir()
    for k in range(recordings):
        rng = np.random.default_rng(k)
        white, walk = (scale * np.exp(0.1 * rng.standard_normal(6)) for scale in (WHITE, WALK))
        if k == recordings // 2:
            walk[0] *= ODD
        values = rng.standard_normal((samples, 6)) * white
        values += np.cumsum(rng.standard_normal((samples, 6)), axis=0) * walk
        pd.DataFrame(values, columns=AXES).to_parquet(folder / f"unit_{k:03d}.parquet")


def command(pattern: str, out: Path, workers: int) -> list[str]:
    program = [str(Path(sys.executable).with_name("allanjax")), "fleet", pattern, "--out", str(out)]
    return [*program, "--workers", str(workers), "--rate", "100", "--gyro-unit", "deg/s", "--accel-unit", "g"]


def run(pattern: str, out: Path, workers: int, kill_after: int | None = None) -> tuple[float, int]:
    """Seconds and exit code; a worker is killed once so many recordings are done."""
    start = time.perf_counter()
    process = subprocess.Popen(
        command(pattern, out, workers), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    if kill_after is not None:
        while process.poll() is None and len(done(out)) < kill_after:
            time.sleep(POLL_SECONDS)
        os.kill(busiest_worker(process.pid), signal.SIGKILL)
    code = process.wait()
    return time.perf_counter() - start, code


def busiest_worker(pid: int) -> int:
    """The descendant that has computed most: a worker, and not a helper of multiprocessing."""
    import psutil

    return max(psutil.Process(pid).children(recursive=True), key=lambda child: child.cpu_times().user).pid


def done(out: Path) -> dict[str, int]:
    """Results that are there, with the time of their writing."""
    return {path.name: path.stat().st_mtime_ns for path in (out / "recordings").glob("*.json")}


def same(one: Path, other: Path) -> bool:
    """Whether two runs found the same."""
    tables = [json.loads(pd.read_parquet(out / "fleet.parquet").to_json()) for out in (one, other)]
    return tables[0] == tables[1]


def measured(folder: Path, recordings: int, samples: int) -> tuple[list[list[str]], list[str]]:
    """Rows of the table, and what the runs show beyond times."""
    logs = folder / "logs"
    simulate(logs, recordings, samples)
    everything = str(logs / "*.parquet")
    cold, _ = run(str(logs / "unit_00[01].parquet"), folder / "cold", 2)
    one, _ = run(everything, folder / "one", 1)
    two, _ = run(everything, folder / "two", 2)
    killed, killed_code = run(everything, folder / "killed", 2, kill_after=recordings // 2)
    (logs / "corrupt.parquet").write_bytes((logs / "unit_000.parquet").read_bytes()[:1000])
    before = done(folder / "two")
    again, again_code = run(everything, folder / "two", 2)
    errors = pd.read_csv(folder / "two" / "errors.csv")
    kept = sum(before[name] == written for name, written in done(folder / "two").items())
    found = pd.read_parquet(folder / "two" / "fleet.parquet")
    marks = found.loc[found["outlying"], ["recording", "axis", "coefficient"]].drop_duplicates()
    rows = [
        ["two recordings, nothing compiled yet, 2 workers", f"{cold:.1f}", ""],
        ["1 worker", f"{one:.1f}", "1.00"],
        ["2 workers", f"{two:.1f}", f"{one / two:.2f}"],
        ["2 workers, one killed half-way", f"{killed:.1f}", f"{one / killed:.2f}"],
        ["second run, with a corrupt file added", f"{again:.1f}", f"{one / again:.2f}"],
    ]
    whole = len(done(folder / "killed"))
    remarks = [
        f"Worker killed half-way (SIGKILL): {whole} of {recordings} recordings have a result, exit code "
        f"{killed_code}; the table {'is' if same(folder / 'two', folder / 'killed') else 'IS NOT'} the "
        "same as without.",
        f"Second run: {kept} of {recordings} results kept as they were; exit code {again_code}; "
        f"{len(errors)} error: {'; '.join(errors['message'])}.",
        f"Marked as outlying: {'; '.join(' '.join(row) for row in marks.values) or 'none'}. Put in: "
        f"unit_{recordings // 2:03d} gyro_x with {ODD:g} times the random walk.",
    ]
    return rows, remarks


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--recordings", type=int, default=200)
    parser.add_argument("--samples", type=int, default=60_000)
    parser.add_argument("--results", type=Path, default=paths.RESULTS / "fleet.md")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        os.environ["ALLANJAX_CACHE"] = str(Path(folder) / "cache")
        rows, remarks = measured(Path(folder), arguments.recordings, arguments.samples)
    text = "\n".join(
        [
            "# Fleets",
            "",
            describe((*PACKAGES, "dask", "distributed")),
            "",
            f"{arguments.recordings} recordings of six axes × {arguments.samples:,} samples, Parquet, terms",
            "chosen by the fit; from the command to the last file written, the local cluster's start and end",
            "included.",
            "",
            table(["run", "seconds", "speed-up over 1 worker"], rows),
            "",
            *(f"- {remark}" for remark in remarks),
            "",
        ]
    )
    publish(text, arguments.results)


if __name__ == "__main__":
    main()

"""Peak memory of Allan deviations: allanjax and others, each in a process of its own.

    python benchmarks/studies/peak_memory.py [--samples 10000000] [--results PATH]

The operating system's figure for the process, interpreter, libraries and the record itself included; beside
it that of a process that only imports the library and makes the record.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from pathlib import Path

import paths

from benchmarks.common.machine import describe
from benchmarks.common.report import publish, table

START = """import resource, sys, numpy as np
{}
x = np.random.default_rng(0).standard_normal(int(sys.argv[1]))
"""
END = "\nprint(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)"
OURS = "import allanjax as aj"
TAUS = "2.0 ** np.arange((len(x) // 2).bit_length())"
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


def peak(imports: str, work: str, samples: int) -> float:
    """Peak memory [MB] of a process that does this."""
    program = START.format(imports) + work + END
    run = [sys.executable, "-c", program, str(samples)]
    return float(subprocess.run(run, check=True, capture_output=True, text=True).stdout.split()[-1])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--samples", type=int, default=10_000_000)
    parser.add_argument("--results", type=Path, default=paths.RESULTS / "peak_memory.md")
    options = parser.parse_args()
    record = 8e-6 * options.samples
    rows = []
    for name, (imports, work) in RUNS.items():
        whole, before = (peak(imports, part, options.samples) for part in (work, "pass"))
        rows.append([name, f"{before:.0f}", f"{whole:.0f}", f"{(whole - before) / record:.1f}"])
    text = f"# Peak memory\n\n{describe()}\n\n{options.samples:,} samples ({record:.0f} MB), octaves.\n\n"
    head = ["", "before [MB]", "with the Allan deviation [MB]", "more, in records"]
    publish(f"{text}{table(head, rows)}\n", options.results)


if __name__ == "__main__":
    main()

"""Damaged files of every format: each is read right, or refused by its name with a reason.

    python benchmarks/studies/fuzz_files.py [--count 100000] [--seed 0] [--only TEXT] [--results PATH]

A small file of every format is damaged at random, and read in a process of its own memory limit, so that a
crash, a hang or a hunger for memory is seen, too. What is found wrong is printed with the number of the file,
which --seed makes again. Exits with 1 if anything is wrong.
"""

from __future__ import annotations

import argparse
import multiprocessing
import resource
import sys
import tempfile
import threading
import time
from collections import Counter, defaultdict
from pathlib import Path
from queue import Queue
from typing import Any

import numpy as np
import paths
from mutated_files import SLOWEST, Sample, damaged, outcome, sample_files

from allanjax.record.io import read
from benchmarks.common.machine import describe
from benchmarks.common.report import publish, table

#: Files that a process reads, and bytes of memory that it may take beyond those it begins with.
BATCH = 2000
MEMORY = 4 * 2**30
#: A process that tells nothing for so many seconds hangs.
PATIENCE = 60.0
OUTCOMES = ("as before", "otherwise", "refused", "WRONG")

Counts = dict[str, Counter[str]]
Wrong = list[tuple[int, str, str]]


def read_damaged(folder: Path, seeds: range, only: str, results: Any) -> None:
    """Work of a process: damage a file for each seed and read it."""
    samples = {name: sample for name, sample in sample_files(folder).items() if only in name}
    wholes = {name: read(sample.path, **sample.options) for name, sample in samples.items()}
    contents = {name: sample.part.read_bytes() for name, sample in samples.items()}
    names = list(samples)
    limit = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize() + MEMORY
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for seed in seeds:
        name = names[seed % len(names)]
        results.put((seed, name, None))
        sample: Sample = samples[name]
        sample.part.write_bytes(damaged(contents[name], np.random.default_rng(seed)))
        results.put((seed, name, outcome(sample, wholes[name])))
        sample.part.write_bytes(contents[name])
    results.put((-1, "memory", resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before))


def work(batches: Queue[range], only: str, found: Counts, wrong: Wrong) -> None:
    """Work of a thread: have batches read by processes, and go on after one that ended before its time."""
    spawn = multiprocessing.get_context("spawn")
    while not batches.empty():
        seeds = batches.get()
        while seeds:
            with tempfile.TemporaryDirectory() as folder:
                results = spawn.SimpleQueue()
                process = spawn.Process(target=read_damaged, args=(Path(folder), seeds, only, results))
                process.start()
                seed, name, told, since = seeds.start, "", "", time.monotonic()
                while process.is_alive() or not results.empty():
                    if results.empty():
                        time.sleep(0.02)
                        if time.monotonic() - since > PATIENCE:
                            process.kill()
                        continue
                    seed, name, told = results.get()
                    since = time.monotonic()
                    if seed < 0:
                        found["memory"]["peak"] = max(found["memory"]["peak"], told)
                    elif told is not None:
                        count(found, wrong, seed, name, told)
                process.join()
                if process.exitcode and seed >= 0:
                    count(found, wrong, seed, name, f"WRONG: the process ended by {process.exitcode}")
                seeds = range(seed + 1, seeds.stop) if process.exitcode and seed >= 0 else range(0)


def count(found: Counts, wrong: Wrong, seed: int, name: str, told: str) -> None:
    if told.startswith("WRONG"):
        wrong.append((seed, name, told))
        print(f"{seed} {name}: {told}", flush=True)
        told = "WRONG"
    found[name][told] += 1


def told(found: Counts, wrong: Wrong, memory: int, args: argparse.Namespace, seconds: float) -> str:
    """Report of what was found."""
    rows = [
        [name, str(counts.total()), *(str(counts[each]) for each in OUTCOMES)]
        for name, counts in sorted(found.items())
    ]
    every = sum(found.values(), Counter())
    rows.append(["all", str(every.total()), *(str(every[each]) for each in OUTCOMES)])
    listed = "\n".join(f"- {seed}, {name}: {what}" for seed, name, what in wrong[:50])
    return f"""# Damaged files

A small file of every format (200 samples of six axes) is damaged in one or two ways at places drawn at
random, often near an end: bits, runs of bytes, lengths that are lies, text such as `nan` and `-1e307`, parts
cut off, left out or repeated. Reading it must give a recording with finite values, or refuse it by an
`AllanjaxError` that begins with the file's name and tells a reason; without a warning of allanjax's own, in
{SLOWEST:.0f} s, and with at most {MEMORY // 2**30} GiB.
Seeds {args.seed} to {args.seed + args.count - 1}. Reproduce with
`python benchmarks/studies/fuzz_files.py --count {args.count} --seed {args.seed}`.

{describe(("numpy", "pandas", "pyarrow", "scipy", "h5py", "rosbags", "pyulog", "nptdms", "allanjax"))}
- {seconds / 60:.0f} minutes; a process took at most {memory / 1024:.0f} MiB beyond what it began with

"as before": the samples of the undamaged file. "otherwise": other samples, or fewer, which is what the
damaged file says: most formats have no check sums, and a digit that is another one can not be seen. "WRONG":
anything else.

{table(["format", "files", *OUTCOMES], rows)}

{listed or "Nothing was wrong."}
"""


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--count", type=int, default=100_000)
    parser.add_argument("--seed", type=int, default=0, help="number of the first file")
    parser.add_argument("--only", default="", help="formats whose names have this text")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--results", type=Path, default=paths.RESULTS / "fuzz_files.md")
    args = parser.parse_args()
    begin = time.monotonic()
    batches: Queue[range] = Queue()
    end = args.seed + args.count
    for first in range(args.seed, end, BATCH):
        batches.put(range(first, min(first + BATCH, end)))
    found: Counts = defaultdict(Counter)
    wrong: Wrong = []
    threads = [
        threading.Thread(target=work, args=(batches, args.only, found, wrong)) for _ in range(args.workers)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    memory = found.pop("memory", Counter())["peak"]
    report = told(found, wrong, memory, args, time.monotonic() - begin)
    publish(report, args.results, quick=args.count < 100_000)
    sys.exit(bool(wrong))


if __name__ == "__main__":
    main()

"""What comes of damaged files: is each read right, or refused by its name with a reason?

A small file of every format (200 samples of six axes) is damaged in one or two ways at places drawn at
random, often near an end: bits, runs of bytes, lengths that are lies, text such as `nan` and `-1e307`, parts
cut off, left out or repeated. It is read in a process with a limit of memory, 4 GiB, so that a crash, a hang
or a hunger for memory is seen, too. Reading must give a recording with finite values, or refuse the file by
an `AllanjaxError` that begins with its name and tells a reason, without a warning of allanjax's own.

"As before": the samples of the undamaged file. "Otherwise": other samples, or fewer, which is what the
damaged file says: most formats have no check sums. "WRONG": anything else; `--seed` of its number makes it
again.
"""

from __future__ import annotations

import multiprocessing
import resource
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

import allanjax as aj
from benchmarks.common.damaged_files import damaged, outcome, sample_files
from benchmarks.common.study import WrongError, settings, table

PACKAGES = ("pandas", "pyarrow", "h5py", "rosbags", "pyulog", "nptdms")
QUICK: dict[str, Any] = {"count": 200}
#: Files that a process reads, bytes beyond those it begins with, seconds after which a silent process hangs.
BATCH, MEMORY, PATIENCE = 2000, 4 * 2**30, 60.0
OUTCOMES = ("as before", "otherwise", "refused", "WRONG")

Told = list[tuple[int, str, str]]


def run(*, count: int = 100_000, seed: int = 0, only: str = "") -> Iterator[str]:
    end = seed + count
    batches = [range(first, min(first + BATCH, end)) for first in range(seed, end, BATCH)]
    with ThreadPoolExecutor(settings.workers) as pool:
        told = [each for batch in pool.map(lambda seeds: read_all(seeds, only), batches) for each in batch]
    found: dict[str, Counter[str]] = defaultdict(Counter)
    for _, name, what in told:
        found[name]["WRONG" if what.startswith("WRONG") else what] += 1
    found = {**dict(sorted(found.items())), "all": sum(found.values(), Counter())}
    rows = [[name, c.total(), *(c[each] for each in OUTCOMES)] for name, c in found.items()]
    yield f"Seeds {seed} to {end - 1}."
    yield table(["format", "files", *OUTCOMES], rows)
    wrong = [f"- {k}, {name}: {what}" for k, name, what in told if what.startswith("WRONG")]
    yield "\n".join(wrong[:50]) or "Nothing was wrong."
    if wrong:
        raise WrongError(f"{len(wrong)} files")


def read_all(seeds: range, only: str) -> Told:
    """What came of all seeds; another process goes on after one that ended before its time."""
    spawn, told = multiprocessing.get_context("spawn"), []
    while seeds:
        with tempfile.TemporaryDirectory() as folder:
            results = spawn.SimpleQueue()
            process = spawn.Process(target=read_damaged, args=(Path(folder), seeds, only, results))
            process.start()
            k, name, what, since = seeds.start, "", None, time.monotonic()
            while process.is_alive() or not results.empty():
                if results.empty():
                    time.sleep(0.02)
                    if time.monotonic() - since > PATIENCE:
                        process.kill()
                    continue
                (k, name, what), since = results.get(), time.monotonic()
                if what is not None:
                    told.append((k, name, what))
            process.join()
            ended = bool(process.exitcode)
            if ended and what is None:
                told.append((k, name, f"WRONG: the process ended by {process.exitcode}"))
            seeds = range(k + 1, seeds.stop) if ended else range(0)
    return told


def read_damaged(folder: Path, seeds: range, only: str, results: Any) -> None:
    """Work of a process: damage a file for each seed and read it."""
    samples = {name: sample for name, sample in sample_files(folder).items() if only in name}
    wholes = {name: aj.read(sample.path, **sample.options) for name, sample in samples.items()}
    contents = {name: sample.part.read_bytes() for name, sample in samples.items()}
    names = list(samples)
    limit = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize() + MEMORY
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    for seed in seeds:
        name = names[seed % len(names)]
        results.put((seed, name, None))
        sample = samples[name]
        sample.part.write_bytes(damaged(contents[name], np.random.default_rng(seed)))
        results.put((seed, name, outcome(sample, wholes[name])))
        sample.part.write_bytes(contents[name])

"""How long do the tests take, and do they pass?

The commit is cloned into an empty folder. `pytest` runs there without compiled programs, then with them,
then room by room, then `pytest -m study`, whose tests draw many records, damage files, end workers
and check the shapes of arrays. Seconds are those of the clock and of the processor, all processes together.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from benchmarks.common.study import ROOT, WrongError, table

QUICK = {"rooms": ("kalman",), "whole": False, "study": False}
PACKAGES = ("pytest", "pytest-xdist", "optimistix")
# Longest lines of failures that are worth telling.
_SHOWN = 20


def run(*, rooms: tuple[str, ...] = (), whole: bool = True, study: bool = True) -> Iterator[str]:
    """Tables of the runs; WrongError if a test failed."""
    failed: list[str] = []
    with tempfile.TemporaryDirectory() as folder:
        clone = Path(folder) / "main"
        subprocess.run(["git", "clone", "--quiet", ROOT, clone], check=True)
        runs = [("all, nothing compiled before", ()), ("all, again", ())] if whole else []
        folders = sorted(p.name for p in (clone / "tests").iterdir() if list(p.glob("test_*.py")))
        alone = rooms or tuple(name for name in folders if name not in ("notebooks", "studies"))
        runs += [(f"{name} alone", (f"tests/{name}",)) for name in alone]
        if study:
            runs.append(("-m study", ("-m", "study", "--numprocesses=0")))
        rows = []
        for label, words in runs:
            seconds, cpu, text = timed(clone, words)
            failed += re.findall(r"^(?:FAILED|ERROR) .*", text, re.MULTILINE)
            summary = re.findall(r"\d+ (?:passed|failed|skipped|errors?)", text)
            programs = re.search(r"compiled (\d+) programs", text)
            new = programs[1] if programs else ""
            rows.append((label, f"{seconds:.0f} s", f"{cpu:.0f} s", ", ".join(summary), new))
            print(f"{label}: {seconds:.0f} s, {', '.join(summary)}", file=sys.stderr, flush=True)
        yield table(("run", "wall", "processor", "outcome", "programs compiled"), rows)
    if failed:
        yield "\n".join(f"- `{line}`" for line in failed[:_SHOWN])
        raise WrongError(f"{len(failed)} tests failed")


def timed(clone: Path, words: tuple[str, ...]) -> tuple[float, float, str]:
    """Seconds, processor seconds, and what pytest printed."""
    inherited = {k: v for k, v in os.environ.items() if not k.startswith(("JAX_", "XLA_", "ALLANJAX_TEST"))}
    begun, before = time.perf_counter(), os.times()
    done = subprocess.run(
        [sys.executable, "-m", "pytest", *words], cwd=clone, env=inherited, capture_output=True, text=True
    )
    after = os.times()
    cpu = after.children_user + after.children_system - before.children_user - before.children_system
    return time.perf_counter() - begun, cpu, done.stdout + done.stderr

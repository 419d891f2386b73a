"""What studies have in common: tables, work in processes, recordings of real sensors, the writer of results.

A study is a module of `benchmarks/studies`. Its docstring asks a question in one line and then tells how it
is answered; `run(*, option=default, …)` yields parts of the answer in Markdown; `QUICK` has the options with
which it only shows that it runs. `PACKAGES` names libraries whose versions matter beside the usual ones.
"""

from __future__ import annotations

import dataclasses
import datetime
import hashlib
import importlib
import inspect
import multiprocessing
import os
import pickle
import platform
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
RESULTS = ROOT / "benchmarks" / "results"
PACKAGES = ("allanjax", "jax", "numpy", "scipy")


class UnavailableError(Exception):
    """The study needs what this machine lacks."""


class WrongError(Exception):
    """The study found what must not be; what it told before is written all the same."""


@dataclasses.dataclass
class Settings:
    """How studies run: processes, and the folder of finished tasks, from which a later run goes on."""

    workers: int = 2
    keep: Path | None = None


settings = Settings()


# --- Studies -----------------------------------------------------------------------------------------------


def names() -> list[str]:
    """All studies."""
    folder = ROOT / "benchmarks" / "studies"
    return sorted(path.stem for path in folder.glob("*.py") if path.stem != "__init__")


def study(name: str) -> ModuleType:
    """The module of a study."""
    return importlib.import_module(f"benchmarks.studies.{name}")


def question(name: str) -> str:
    """The first line of a study's docstring, read without its imports."""
    text = (ROOT / "benchmarks" / "studies" / f"{name}.py").read_text(encoding="utf-8")
    return text.removeprefix('"""').splitlines()[0].removesuffix('"""')


def perform(name: str, quick: bool = False, results: Path | None = None, **given: Any) -> str:
    """Run a study and write what it tells; a quick run is only written where `results` says so."""
    module, parts, wrong = study(name), [], None
    options = (getattr(module, "QUICK", {}) if quick else {}) | given
    commit, begun = commit_of(ROOT), time.perf_counter()
    try:
        for part in filter(None, module.run(**options)):
            parts.append(part)
            print(part, end="\n\n", flush=True)
    except WrongError as error:
        wrong = error
    title, _, about = (inspect.getdoc(module) or "").partition("\n")
    command = " ".join(["python -m benchmarks", name, *["--quick"] * quick, *map(written, given.items())])
    head = [
        f"`{command}` at commit {commit}, {datetime.date.today():%Y-%m-%d}, "
        f"{time.perf_counter() - begun:.0f} s  \n{machine((*PACKAGES, *getattr(module, 'PACKAGES', ())))}"
    ]
    text = "\n\n".join([f"# {title}", *head, about.strip(), *parts]) + "\n"
    path = results or (None if quick else RESULTS / f"{name}.md")
    if path:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
    if wrong:
        raise wrong
    return text


def written(option: tuple[str, Any]) -> str:
    """An option as the command line has it."""
    name, value = option
    told = ",".join(map(str, value)) if isinstance(value, tuple) else str(value)
    return f"--{name.replace('_', '-')}" + ("" if value is True else f" {told}")


# --- Where and on what it ran ------------------------------------------------------------------------------


def commit_of(root: Path) -> str:
    """The commit of a checkout, and whether anything but results has been changed since."""

    def git(*arguments: str) -> str:
        return subprocess.run(["git", *arguments], cwd=root, capture_output=True, text=True).stdout.strip()

    if not (commit := git("rev-parse", "--short=12", "HEAD")):
        return "unknown"
    changed = git("status", "--porcelain", "--", ".", ":!benchmarks/results")
    return commit + (" with changes that are not committed" if changed else "")


def machine(packages: Sequence[str] = PACKAGES) -> str:
    """Processor, cores, memory, operating system, Python and versions."""
    found = []
    for package in packages:
        try:
            found.append(f"{package} {version(package)}")
        except PackageNotFoundError:
            found.append(f"{package} not installed")
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    processor = platform.processor() or "unknown processor"
    if Path("/proc/cpuinfo").exists():
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        processor = next((x.split(":", 1)[1].strip() for x in lines if x.startswith("model name")), processor)
    load = f", load {os.getloadavg()[0]:.1f}" if hasattr(os, "getloadavg") else ""
    return (
        f"{processor}, {cores} cores{load}; {platform.system()} {platform.release()}; "
        f"Python {platform.python_version()}, {', '.join(found)}"
    )


def data(name: str) -> Path:
    """A file of a real sensor, in the folder that ALLANJAX_DATA names; these are not in the repository."""
    path = Path(os.environ.get("ALLANJAX_DATA", ROOT.parent / "shared" / "data")) / name
    if not path.exists():
        raise UnavailableError(f"{name} is not there; ALLANJAX_DATA names the folder of the real recordings")
    return path


# --- Work --------------------------------------------------------------------------------------------------


def run_tasks(function: Callable[..., Any], tasks: Sequence[tuple]) -> list[Any]:
    """`function(*task)` of every task, in the order of the tasks, in `settings.workers` processes.

    Workers compile and compute on one thread each, which together do more than one process with all threads.
    """
    found, begun = {}, time.perf_counter()
    shown = [begun]
    kept = [_kept(function, task) for task in tasks]
    for k, path in enumerate(kept):
        if path and path.exists():
            found[k] = pickle.loads(path.read_bytes())
    waiting = [k for k in range(len(tasks)) if k not in found]

    def done(k: int, result: Any) -> None:
        found[k] = result
        if path := kept[k]:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(pickle.dumps(result))
        now = time.perf_counter()
        if now - shown[0] > 5.0:
            shown[0] = now
            told = f"{len(found)} of {len(tasks)}, {now - begun:.0f} s: {tasks[k]}"
            print(told[:110], file=sys.stderr, flush=True)

    if settings.workers == 1 or len(waiting) < 2:
        for k in waiting:
            done(k, function(*tasks[k]))
    else:
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
        flags = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"
        os.environ.setdefault("XLA_FLAGS", flags)
        with ProcessPoolExecutor(settings.workers, multiprocessing.get_context("spawn")) as pool:
            futures = {pool.submit(function, *tasks[k]): k for k in waiting}
            for future in as_completed(futures):
                done(futures[future], future.result())
    return [found[k] for k in range(len(tasks))]


def _kept(function: Callable[..., Any], task: tuple) -> Path | None:
    """The file of a task's result: of this commit, this function and these arguments."""
    if settings.keep is None:
        return None
    key = f"{commit_of(ROOT)} {function.__module__}.{function.__qualname__} {task!r}"
    return settings.keep / f"{hashlib.sha256(key.encode()).hexdigest()[:24]}.pickle"


def process(code: str, *arguments: object, **environment: str) -> tuple[str, float, float, float]:
    """What Python code prints in a process of its own; its seconds, processor seconds, peak memory [MB]."""
    begun = time.perf_counter()
    command, around = [sys.executable, "-c", code, *map(str, arguments)], {**os.environ, **environment}
    own = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=around, cwd=ROOT)
    assert own.stdout is not None
    printed = own.stdout.read()
    _, status, usage = os.wait4(own.pid, 0)
    own.returncode = os.waitstatus_to_exitcode(status)
    if own.returncode:
        raise subprocess.CalledProcessError(own.returncode, code)
    taken = time.perf_counter() - begun
    return printed, taken, usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 1024.0


# --- Tables and shares -------------------------------------------------------------------------------------


def table(head: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """A Markdown table whose columns line up."""
    cells = [[str(cell) for cell in row] for row in rows]
    widths = [max(len(row[k]) for row in [head, *cells]) for k in range(len(head))]
    rule = ["-" * w for w in widths]
    return "\n".join(
        "| " + " | ".join(cell.ljust(w) for cell, w in zip(row, widths, strict=True)) + " |"
        for row in [head, rule, *cells]
    )


def rms(errors: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(errors))))


def percent(hits: Iterable[bool]) -> str:
    """E.g. "95"."""
    hits = list(hits)
    return f"{100.0 * np.mean(hits):.0f}" if hits else "–"


def share(hits: Any) -> str:
    """E.g. "0.953 ± 0.012"; of none or all of the records the error is that of half a record."""
    hits = np.asarray(hits, float)
    if not len(hits):
        return "–"
    p = (hits.sum() + 0.5) / (len(hits) + 1.0)
    return f"{hits.mean():.3f} ± {np.sqrt(p * (1.0 - p) / len(hits)):.3f}"

"""What the studies' reports have in common: tables, standard errors, files, work shared among processes."""

from __future__ import annotations

import multiprocessing
import os
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Any

import numpy as np
import paths


def table(head: list[str], rows: list[list[str]]) -> str:
    """A Markdown table whose columns line up."""
    widths = [max(len(row[k]) for row in [head, *rows]) for k in range(len(head))]
    rule = ["-" * w for w in widths]
    return "\n".join(
        "| " + " | ".join(cell.ljust(w) for cell, w in zip(row, widths, strict=True)) + " |"
        for row in [head, rule, *rows]
    )


def standard_error(rate: float, count: int) -> float:
    """Of a rate seen in so many records; where it is 0 or 1, that of half a record more or less."""
    p = (rate * count + 0.5) / (count + 1.0)
    return float(np.sqrt(p * (1.0 - p) / count))


def share(hits: np.ndarray) -> str:
    """E.g. "0.953 ± 0.012"."""
    rate = float(np.mean(hits))
    return f"{rate:.3f} ± {standard_error(rate, len(hits)):.3f}"


def publish(text: str, path: Path, quick: bool = False) -> None:
    """Print a report and write it to a file; a quick run never replaces one of the committed results."""
    print(text)
    if not (quick and path.parent == paths.RESULTS):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")


def run_tasks(
    function: Callable[..., Any], tasks: Sequence[tuple], workers: int
) -> Iterator[tuple[tuple, Any, float]]:
    """`function(*task)` of every task in so many processes; yields task, result and seconds as they end.

    Workers compile and compute on one thread each, which together do more than one process with all threads.
    """
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    os.environ.setdefault("XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1")
    with ProcessPoolExecutor(workers, multiprocessing.get_context("spawn")) as pool:
        futures = {pool.submit(_timed, function, task): task for task in tasks}
        for future in as_completed(futures):
            yield (futures[future], *future.result())


def _timed(function: Callable[..., Any], task: tuple) -> tuple[Any, float]:
    begun = time.perf_counter()
    return function(*task), time.perf_counter() - begun

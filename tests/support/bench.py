"""Records, fits, critiques and posteriors that many tests look at, made once per run for all processes.

`fit("small")` is the fit of the golden record "small" (see `golden_records`). The first process that asks
makes it under a lock and leaves a pickle for the others.
"""

# Annotations would load what few tests need.
from __future__ import annotations

import contextlib
import functools
import hashlib
import os
import pickle
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeVar

import golden_records

import allanjax as aj

_T = TypeVar("_T")
#: The folder of this run, which `conftest` makes and its workers inherit.
RUN = "ALLANJAX_TEST_RUN"
# Longest time that one result may take [s]; a lock that is older belongs to a process that has died.
_LONGEST = 600.0


def once(name: str, make: Callable[[], _T]) -> _T:
    """What `make` returns, made by the first process of the run that asks for this name."""
    # Everybody gets the object anew from the pickle, also who made it: no test depends on being the first.
    path = Path(os.environ[RUN]) / f"{hashlib.sha256(name.encode()).hexdigest()[:24]}.pickle"
    if not path.exists():
        with _locked(path.with_suffix(".lock")):
            if not path.exists():
                partial = path.with_suffix(f".{os.getpid()}")
                partial.write_bytes(pickle.dumps(make()))
                partial.replace(path)
    return pickle.loads(path.read_bytes())


@contextlib.contextmanager
def _locked(path: Path) -> Iterator[None]:
    """Hold a lock file, waiting for whoever has it."""
    while True:
        try:
            os.close(os.open(path, os.O_CREAT | os.O_EXCL))
            break
        except FileExistsError:
            with contextlib.suppress(FileNotFoundError):
                if time.time() - path.stat().st_mtime > _LONGEST:
                    path.unlink()
            time.sleep(0.05)
    try:
        yield
    finally:
        path.unlink(missing_ok=True)


@functools.cache
def truth(name: str) -> golden_records.Record:
    return golden_records.record(name)


@functools.cache
def recording(name: str) -> aj.Recording:
    return truth(name).recording()


@functools.cache
def fit(name: str, model: str | None = None, objective: str = "allan", **options: Any) -> aj.Fit:
    label = f"fit {name} {model} {objective} {sorted(options.items())}"
    return once(label, lambda: aj.fit(recording(name), model, objective, **options))


@functools.cache
def selection(name: str) -> Any:
    return once(f"selection {name}", lambda: aj.select_terms(recording(name)))


@functools.cache
def critique(name: str) -> aj.Critique:
    return once(f"critique {name}", lambda: aj.critique(recording(name)))


@functools.cache
def posterior(name: str, axes: Any = None, model: str | None = None, **options: Any) -> aj.Posterior:
    """A posterior by Whittle's likelihood, with `seed=1` unless `options` give another."""
    label = f"posterior {name} {axes} {model} {sorted(options.items())}"
    options = {"seed": 1, "progress": False} | options
    return once(label, lambda: aj.sample(fit(name, model, "whittle"), axes and list(axes), **options))

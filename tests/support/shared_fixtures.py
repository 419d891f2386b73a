"""Bounded memory; an empty folder for commands; figures that are neither rendered nor left open."""

import contextlib
import ctypes
import functools
import gc
import os
import sys
from collections.abc import Iterator
from importlib.abc import MetaPathFinder
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import jax
import jaxtyping
import pytest

from allanjax.base.cache import release_programs

# Least and most memory [bytes] at which a process forgets its compiled programs: to trace them again takes
# seconds each, so that of a large machine half is used.
_LEAST, _MOST = 800_000_000, 3_000_000_000
_kept = [0]


@pytest.fixture(autouse=True)
def bounded_memory() -> Iterator[None]:
    """Keep the processes that run tests within the machine's memory: JAX holds every program it compiles."""
    yield
    release_programs(0.75)
    allowed = _allowed()
    if _memory() > max(allowed, _kept[0] + allowed // 4):
        jax.clear_caches()
        gc.collect()
        # The C library of Linux would keep memory that is free.
        with contextlib.suppress(OSError, AttributeError):
            ctypes.CDLL("libc.so.6").malloc_trim(0)
        _kept[0] = _memory()


@functools.cache
def _allowed() -> int:
    """Memory at which this process forgets its programs: half of the machine's is shared out to all."""
    workers = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
    total = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") if hasattr(os, "sysconf") else 0
    with contextlib.suppress(OSError, ValueError):
        total = min(total, int(Path("/sys/fs/cgroup/memory.max").read_text()))
    return min(max(total // 2 // workers, _LEAST), _MOST)


def _memory() -> int:
    """Memory of this process [bytes]; 0 where the system does not tell."""
    with contextlib.suppress(OSError):
        return 4096 * int(Path("/proc/self/statm").read_text().split()[1])
    return 0


@pytest.fixture
def unchecked_shapes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing but the package itself says what is wrong with the shape of an array, as for a user."""
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)


@pytest.fixture
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Commands run in an empty folder, and leave the user's cache alone."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("ALLANJAX_CACHE", "off")
    monkeypatch.setenv("COLUMNS", "200")
    monkeypatch.setenv("MPLBACKEND", "agg")


class _Unrendered(MetaPathFinder):
    """Figures are saved as the signature of a PNG: tests look at artists, and to render takes seconds.

    As soon as a test loads matplotlib, which takes a second, too.
    """

    def find_spec(self, name: str, path: Any, target: Any = None) -> Any:
        """Find the module of figures, and change how they are saved once it is loaded."""
        if name != "matplotlib.figure":
            return None
        sys.meta_path.remove(self)
        spec: Any = find_spec(name)
        load = spec.loader.exec_module

        def loaded(module: Any) -> None:
            load(module)
            _save.original = module.Figure.savefig  # type: ignore[attr-defined]
            module.Figure.savefig = _save

        spec.loader.exec_module = loaded
        return spec


def _save(figure: Any, path: str | os.PathLike[str], **options: Any) -> None:
    Path(path).write_bytes(b"\x89PNG\r\n\x1a\n")


sys.meta_path.insert(0, _Unrendered())


@pytest.fixture
def no_windows() -> Iterator[None]:
    """Figures that pyplot shows nowhere, and forgets after the test."""
    import matplotlib
    from matplotlib import pyplot as plt

    matplotlib.use("Agg")
    yield
    plt.close("all")

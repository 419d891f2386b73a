"""Disk cache of compiled programs, so that only the first run on a machine compiles; memory that is freed."""

import ctypes
import os
import stat
import sys
import tempfile
import threading
import warnings
from collections.abc import Hashable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from allanjax.base.errors import AllanjaxWarning


def enable_compilation_cache(directory: str | os.PathLike[str] | None = None) -> Path | None:
    """Store compiled programs in a directory for later processes.

    Args:
        directory: the directory; by default the environment variable ALLANJAX_CACHE (`off`: no cache), else
            `allanjax/jax` in the user's cache directory or, if that is not writable, a private directory of
            the user among the temporary files.

    Returns:
        The directory, or None without a cache: it is switched off, or the directory is not writable, with a
        warning if the user chose it.
    """
    chosen = os.environ.get("ALLANJAX_CACHE", "") if directory is None else os.fspath(directory)
    if chosen.lower() == "off":
        return None
    path = Path(chosen).expanduser() if chosen else _usual()
    problem = _problem(path) if path is not None else ""
    if path is None or problem:
        if chosen:
            advice = "so that every run compiles anew; set ALLANJAX_CACHE to another directory or to off"
            warnings.warn(f"{path}: {problem}, {advice}", AllanjaxWarning, stacklevel=2)
        return None
    # Small programs, too: reading them is faster than compiling them.
    settings = {"jax_compilation_cache_dir": str(path), "jax_persistent_cache_min_compile_time_secs": 0.0}
    if "jax" in sys.modules:
        import jax

        for name, value in settings.items():
            jax.config.update(name, value)
    else:
        # JAX, which takes long to load, reads them when it is.
        os.environ.update({name.upper(): str(value) for name, value in settings.items()})
    return path


def _problem(path: Path) -> str:
    """Why a directory, created if needed, is not writable; "" if it is."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        return error.strerror or "not writable"
    return "" if os.access(path, os.W_OK | os.X_OK) else "not writable"


def _usual() -> Path | None:
    """Default directory: the user's, else one among the temporary files, else None.

    A missing or read-only home directory is usual in containers and is not an error.
    """
    for place in (_user_cache, _temporary):
        # There may be no home directory.
        with suppress(OSError, RuntimeError):
            path = place()
            if path is not None and not _problem(path):
                return path
    return None


def _temporary() -> Path | None:
    """Directory among the temporary files that only this user can write to; None if it belongs to another.

    Programs from the cache are executed, so nobody else may have written them.
    """
    posix = os.name == "posix"
    path = Path(tempfile.gettempdir()) / (f"allanjax-{os.getuid()}" if posix else "allanjax")
    path.mkdir(mode=0o700, exist_ok=True)
    status = path.lstat()
    own = not posix or (status.st_uid == os.getuid() and not status.st_mode & (stat.S_IWGRP | stat.S_IWOTH))
    return path if stat.S_ISDIR(status.st_mode) and own else None


def _user_cache() -> Path:
    """Directory in the user's cache directory, by the convention of the operating system."""
    if sys.platform == "win32":
        users = Path(os.environ.get("LOCALAPPDATA") or Path.home() / "AppData" / "Local")
    elif sys.platform == "darwin":
        users = Path.home() / "Library" / "Caches"
    else:
        users = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return users / "allanjax" / "jax"


_compiled: set[Hashable] = set()
_compiling: dict[Hashable, threading.Lock] = {}


@contextmanager
def compiled_once(program: Hashable) -> Iterator[None]:
    """Context of a call that may compile a program, for which other threads wait that need the same one."""
    if program in _compiled:
        yield
        return
    with _compiling.setdefault(program, threading.Lock()):
        yield
    _compiled.add(program)


def release_memory() -> None:
    """Return freed memory to the system, where the C library is glibc.

    Freed arrays of several megabytes leave gaps that later ones of other lengths do not fill.
    """
    with suppress(OSError, AttributeError):
        ctypes.CDLL("libc.so.6").malloc_trim(0)


def release_programs(share: float) -> None:
    """Drop all compiled programs if this process uses more than a share of its allowed memory mappings.

    Each program takes many mappings, and Linux allows a process 65,530 by default (vm.max_map_count), so a
    process that fits recordings of many lengths would fail after some dozens of them. Programs that are
    needed again are loaded from the cache or compiled.
    """
    try:
        limit = int(Path("/proc/sys/vm/max_map_count").read_text())
        with open("/proc/self/maps", "rb") as file:
            used = sum(1 for _ in file)
    except OSError:
        # Only Linux has this limit.
        return
    if used > share * limit:
        import jax

        jax.clear_caches()

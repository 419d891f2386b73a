"""Cache of compiled programs on disk, so that only the first run on a machine compiles."""

import os
import stat
import sys
import tempfile
import warnings
from pathlib import Path

from allanjax.base.errors import AllanjaxWarning


def enable_compilation_cache(directory: str | os.PathLike[str] | None = None) -> Path | None:
    """Keep compiled programs in a directory for later processes.

    Args:
        directory: where; by default as the environment variable ALLANJAX_CACHE says (`off` for nowhere), else
            `allanjax/jax` in the user's cache directory; where that is not writable, a directory among the
            temporary files that is the user's alone.

    Returns:
        The directory, or None if there is no cache: it was switched off or is not writable, which brings a
        warning if that directory was asked for.
    """
    chosen = os.environ.get("ALLANJAX_CACHE", "") if directory is None else os.fspath(directory)
    if chosen.lower() == "off":
        return None
    path = Path(chosen).expanduser() if chosen else _usual()
    problem = _problem(path) if path is not None else ""
    if path is None or problem:
        if chosen:
            advice = "programs are compiled anew every time; set ALLANJAX_CACHE to a directory or to off"
            warnings.warn(f"{path}: {problem}; {advice}", AllanjaxWarning, stacklevel=2)
        return None
    import jax

    jax.config.update("jax_compilation_cache_dir", str(path))
    # Also small programs: to read them takes less time than to compile them.
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    return path


def _problem(path: Path) -> str:
    """Why a directory, which is made if there is none, cannot be written to; "" if it can."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        return error.strerror or "not writable"
    return "" if os.access(path, os.W_OK | os.X_OK) else "not writable"


def _usual() -> Path | None:
    """The user's directory for compiled programs, or one among the temporary files; None if there is neither.

    A home that is not there or not writable, as in a container, is not the user's mistake.
    """
    try:
        path = _user_cache() / "allanjax" / "jax"
        if not _problem(path):
            return path
    except RuntimeError:
        # There is no home.
        pass
    try:
        return _temporary()
    except OSError:
        return None


def _temporary() -> Path | None:
    """Directory among the temporary files that only this user can write to; None if it is another's.

    Programs that are read from a cache are run: they must not be somebody else's.
    """
    posix = os.name == "posix"
    path = Path(tempfile.gettempdir()) / (f"allanjax-{os.getuid()}" if posix else "allanjax")
    path.mkdir(mode=0o700, exist_ok=True)
    about = path.lstat()
    own = not posix or (about.st_uid == os.getuid() and not about.st_mode & (stat.S_IWGRP | stat.S_IWOTH))
    return path if stat.S_ISDIR(about.st_mode) and own and not _problem(path) else None


def _user_cache() -> Path:
    """Directory for cached data of the user, as the operating system has it."""
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA") or Path.home() / "AppData" / "Local")
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches"
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")


def release_programs(share: float) -> None:
    """Drop all compiled programs if this process uses more than a share of its allowed memory mappings.

    A program takes many mappings, of which Linux allows a process 65,530 by default (vm.max_map_count): a
    process that fits recordings of many lengths would fail after some dozens of them. Programs that are
    needed again are loaded from the cache, or compiled.
    """
    used, limit = _mapped()
    if used > share * limit:
        import jax

        jax.clear_caches()


def _mapped() -> tuple[int, float]:
    """Number of memory mappings that this process has, and the number that it may have."""
    try:
        limit = int(Path("/proc/sys/vm/max_map_count").read_text())
        with open("/proc/self/maps", "rb") as file:
            return sum(1 for _ in file), limit
    except OSError:
        # Not Linux: there is no such limit.
        return 0, float("inf")

"""Cache of compiled programs on disk, so that only the first run on a machine compiles."""

import os
import sys
import warnings
from pathlib import Path

# Programs that compile in less time [s] are not kept: reading them back would take as long.
_MIN_COMPILE_SECONDS = 0.1


def enable_compilation_cache(directory: str | os.PathLike[str] | None = None) -> Path | None:
    """Keep compiled programs in a directory for later processes.

    Args:
        directory: where; by default as the environment variable ALLANJAX_CACHE says (`off` for nowhere), else
            `allanjax/jax` in the user's cache directory.

    Returns:
        The directory, or None if there is no cache: it was switched off or is not writable, which brings a
        warning if that directory was asked for.
    """
    chosen = os.environ.get("ALLANJAX_CACHE", "") if directory is None else os.fspath(directory)
    if chosen.lower() == "off":
        return None
    path = Path(chosen).expanduser() if chosen else _user_cache() / "allanjax" / "jax"
    why: str | None = "not writable"
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        why = error.strerror
    if not os.access(path, os.W_OK | os.X_OK):
        # A home directory that is not writable, as in a container, is not the user's mistake.
        if chosen:
            _warn(path, why)
        return None
    import jax

    jax.config.update("jax_compilation_cache_dir", str(path))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", _MIN_COMPILE_SECONDS)
    return path


def _warn(path: Path, why: str | None) -> None:
    """Warn that the directory that was asked for cannot be used."""
    warnings.warn(
        f"{path}: {why}; programs are compiled anew every time; set ALLANJAX_CACHE to a directory or to off",
        stacklevel=3,
    )


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

"""Programs that JAX compiles, or loads from its cache, while something runs."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from jax import monitoring

_COMPILED = "/jax/core/compile/backend_compile_duration"
_NEW = "/jax/compilation_cache/cache_misses"
_open: list[list[str]] = []
#: Programs of this process that nobody had compiled before, and the seconds that all compilation took.
totals = {"new": 0, "requests": 0, "seconds": 0.0}


def _timed(event: str, seconds: float, **about: Any) -> None:
    if event == _COMPILED:
        totals["requests"] += 1
        totals["seconds"] += seconds
        for names in _open:
            names.append(str(about.get("fun_name", "")))


def _counted(event: str, **about: Any) -> None:
    totals["new"] += event == _NEW


monitoring.register_event_duration_secs_listener(_timed)
monitoring.register_event_listener(_counted)


@contextmanager
def compilations() -> Iterator[list[str]]:
    """Names of the functions that are compiled within, in order; what had been compiled before is not."""
    names: list[str] = []
    _open.append(names)
    try:
        yield names
    finally:
        _open.remove(names)

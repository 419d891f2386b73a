"""Programs that JAX compiles, or loads from its cache, while something runs."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from jax import monitoring

_all: list[str] = []
#: Programs of this process that nobody had compiled before, and the seconds that all compilation took.
totals = {"new": 0, "requests": 0, "seconds": 0.0}


def _timed(event: str, seconds: float, **about: Any) -> None:
    if event == "/jax/core/compile/backend_compile_duration":
        totals["requests"] += 1
        totals["seconds"] += seconds
        _all.append(str(about.get("fun_name", "")))


def _counted(event: str, **about: Any) -> None:
    totals["new"] += event == "/jax/compilation_cache/cache_misses"


monitoring.register_event_duration_secs_listener(_timed)
monitoring.register_event_listener(_counted)


@contextmanager
def compilations() -> Iterator[list[str]]:
    """Names of the functions that were compiled within, in order; what had been compiled before is not."""
    names, begin = [], len(_all)
    yield names
    names += _all[begin:]

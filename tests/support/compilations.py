"""What JAX compiles, or reads from its cache, while something runs."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from jax import monitoring

_EVENT = "/jax/core/compile/backend_compile_duration"
_open: list[list[str]] = []


def _note(event: str, _: float, **about: Any) -> None:
    if event == _EVENT:
        for names in _open:
            names.append(str(about.get("fun_name", "")))


monitoring.register_event_duration_secs_listener(_note)


@contextmanager
def compilations() -> Iterator[list[str]]:
    """Names of the functions that are compiled within, in order; what had been compiled before is not."""
    names: list[str] = []
    _open.append(names)
    try:
        yield names
    finally:
        _open.remove(names)
